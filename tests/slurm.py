"""A Slurm cluster of one node on this machine: munge, slurmctld and slurmd in a folder of their own, on 127.0.0.1.

Debian's packages: `apt-get install slurm-wlm munge`. No service of the machine and no file of /etc is touched.
"""

import contextlib
import dataclasses
import os
import platform
import pwd
import shutil
import socket
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tests import until

#: Without these there is no cluster.
PROGRAMS = ("munged", "mungekey", "slurmctld", "slurmd", "sbatch", "scontrol", "scancel", "squeue")

#: Jobs are counted by processor only; `config_overrides` lets the node have more processors than the machine.
_CONFIGURATION = """
ClusterName=test
SlurmctldHost={node}(127.0.0.1)
SlurmUser={user}
SlurmdUser={user}
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
AuthInfo=socket={folder}/munge.socket
StateSaveLocation={folder}/controller
SlurmdSpoolDir={folder}/node
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
SlurmdParameters=config_overrides
CommunicationParameters=NoCtldInAddrAny,NoInAddrAny
JobCompType=jobcomp/filetxt
JobCompLoc={folder}/finished
ReturnToService=1
NodeName={node} NodeAddr=127.0.0.1 CPUs={processors} RealMemory=65536
PartitionName=all Nodes=ALL Default=YES MaxTime=INFINITE State=UP
"""


@dataclasses.dataclass(frozen=True)
class Cluster:
    """A running cluster. node: the name of its only node."""

    folder: Path
    node: str

    def run(self, *words: object) -> str:
        """Run one of Slurm's commands; what it printed."""
        environment = os.environ | {"SLURM_CONF": str(self.folder / "slurm.conf")}
        done = subprocess.run([*map(str, words)], env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, f"{words}: {done.stdout}{done.stderr}"
        return done.stdout

    def submit(self, script: Path, *options: object) -> str:
        """Submit a script; the job's number."""
        return self.run("sbatch", "--parsable", *options, script).strip()

    def tasks(self, state: str) -> list[str]:
        """The jobs in a state ("R" running, "PD" pending, "CG" completing), elements of an array one by one."""
        return self.run("squeue", "--noheader", "--array", "--states", state, "--format", "%i").split()

    def set_node(self, state: str) -> None:
        """Drain, resume or take down the node."""
        self.run("scontrol", "update", f"nodename={self.node}", f"state={state}", "reason=test")

    def accounting(self) -> list[dict[str, str]]:
        """The jobs that ended, each as Slurm recorded it (`JobId`, `JobState`, `ExitCode`, ...)."""
        path = self.folder / "finished"
        lines = path.read_text().splitlines() if path.exists() else []
        return [dict(word.split("=", 1) for word in line.split() if "=" in word) for line in lines]


def missing() -> str:
    """The programs that are not installed, "" where a cluster can be started."""
    path = os.environ.get("PATH", "") + ":/usr/sbin:/sbin"
    return ", ".join(name for name in PROGRAMS if shutil.which(name, path=path) is None)


@contextlib.contextmanager
def cluster(processors: int) -> Iterator[Cluster]:
    """Start a cluster whose node has so many processors, whatever the machine has; ended and removed after."""
    folder, node = Path(tempfile.mkdtemp(prefix="pbl-slurm-")), platform.node().split(".")[0]
    for name in ("controller", "node"):
        (folder / name).mkdir()
    user = pwd.getpwuid(os.geteuid()).pw_name
    text = _CONFIGURATION.format(folder=folder, node=node, user=user, processors=processors, ports=_free_ports(2))
    (folder / "slurm.conf").write_text(text)
    environment = os.environ | {"SLURM_CONF": str(folder / "slurm.conf"), "PATH": os.environ["PATH"] + ":/usr/sbin"}
    subprocess.run(["mungekey", "--create", "--keyfile", folder / "munge.key"], check=True, env=environment)
    files = [f"--{name}={folder}/munge.{end}" for name, end in _MUNGE.items()]
    with contextlib.ExitStack() as running:
        running.callback(shutil.rmtree, folder, ignore_errors=True)
        for command in (["munged", "--foreground", "--force", *files], ["slurmctld", "-D"], ["slurmd", "-D"]):
            log = running.enter_context((folder / f"{command[0]}.log").open("w"))
            process = subprocess.Popen(command, env=environment, stdout=log, stderr=log)
            running.callback(process.wait, timeout=30)
            running.callback(process.terminate)
            if command[0] == "munged":
                until(lambda: (folder / "munge.socket").exists(), 10)
        found = Cluster(folder, node)
        until(lambda: found.run("sinfo", "--noheader", "--format", "%t").strip() == "idle", 30)
        running.callback(until, lambda: not found.run("squeue", "--noheader"), 60)
        running.callback(found.run, "scancel", "--user", user)
        yield found


_MUNGE = {"key-file": "key", "socket": "socket", "pid-file": "pid", "log-file": "log", "seed-file": "seed"}


def _free_ports(n: int) -> list[int]:
    with contextlib.ExitStack() as held:
        sockets = [held.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(n)]
        return [s.getsockname()[1] for s in sockets]
