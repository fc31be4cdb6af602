"""Workers as jobs of a real Slurm: `workers/deploy/slurm/worker.sbatch` on a node that is drained, taken down, and
where jobs are cancelled.

    apt-get install slurm-wlm munge && pytest -m machine -s tests/integration/test_slurm.py
"""

import json
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from pbl_pipeline.bench.detect import numbered
from pbl_schemas import tracking, video
from pbl_schemas.operations import embedded
from pbl_schemas.operations.orphans import orphans
from tests import Environment, slurm, until
from tests.rows import register

from . import chain
from .jobs import jobs_left

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "workers" / "deploy" / "slurm" / "worker.sbatch"
#: Videos, each of so many frames: the real detector sees all of them, and finds nobody.
VIDEOS, FRAMES = 200, 8

pytestmark = [
    pytest.mark.machine,
    pytest.mark.skipif(bool(slurm.missing()), reason=f"apt-get install slurm-wlm munge (missing: {slurm.missing()})"),
]


@pytest.fixture
def cluster() -> Iterator[slurm.Cluster]:
    """A node on which four workers have room."""
    with slurm.cluster(processors=4) as running:
        yield running


@pytest.fixture
def settings(declared: None, database: Path, tmp_path: Path, environment: Environment) -> None:
    """The file that the script reads, as docs/deployment.md has it, and the script's own variables."""
    folder = embedded.Folder(database / "db")
    (tmp_path / "password").write_text(folder.credentials().app_password)
    written = {
        "DJ_HOST": embedded.HOST,
        "DJ_PORT": folder.state()["port"],
        "DJ_USER": embedded.APP_USER,
        "DJ_PASS_FILE": tmp_path / "password",
        "PBL_STORE": database / "store",
        "PYTHONPATH": ROOT,
    }
    (tmp_path / "worker.env").write_text("".join(f"{name}={value}\n" for name, value in written.items()))
    environment(PBL_SETTINGS=tmp_path / "worker.env", PBL_VENV=sys.prefix)


def videos(folder: Path, n: int) -> Iterator[Path]:
    """One small video so many times, each with other bytes: a box of its container that readers skip."""
    film = chain.small_video(folder, "film", FRAMES).read_bytes()
    for i in range(n):
        path = folder / f"walk{i}.mp4"
        path.write_bytes(numbered(film, i))
        yield path


def done_by(logs: Path) -> Counter[str]:
    """How often each job was reported as done in the workers' logs."""
    events = (json.loads(line) for log in logs.glob("*.log") for line in log.open() if line.startswith("{"))
    return Counter(f"{e['table']} {e['key']['video_id']}" for e in events if e["event"] == "done")


def test_an_array_of_workers_does_every_job_once(
    settings: None, cluster: slurm.Cluster, database: Path, tmp_path: Path
):
    register(*videos(database, VIDEOS))
    began = time.monotonic()

    def have_done(n: int) -> bool:
        return len(tracking.SubjectChoice()) >= n

    array = cluster.submit(SCRIPT, "--array=1-12", *options(tmp_path))
    until(lambda: have_done(VIDEOS // 8), 300)

    cluster.set_node("drain")
    *cancelled, requeued = cluster.tasks("R")
    cluster.run("scancel", *cancelled)
    cluster.run("scontrol", "requeue", requeued)  # Slurm starts it again after two minutes
    until(lambda: not cluster.tasks("R,CG"), 60)
    assert len(cluster.tasks("PD")) == 12 - len(cancelled)  # nothing starts on a drained node

    cluster.set_node("resume")
    until(lambda: have_done(VIDEOS // 2), 300)
    cluster.set_node("down")  # its jobs are killed, and are to run again
    cluster.set_node("resume")
    until(lambda: have_done(VIDEOS), 300)
    cluster.run("scancel", array)
    until(lambda: not cluster.tasks("R,CG,PD"), 60)

    states = Counter(job["JobState"] for job in cluster.accounting())
    summary = f"{time.monotonic() - began:.0f} s; elements that ended: {dict(states)}; jobs left: {jobs_left()}\n"
    sys.stdout.write(cluster.run("sacct", "--completion") + summary)
    times = done_by(tmp_path)
    assert set(times.values()) == {1}
    assert len(times) >= 3 * VIDEOS - 4  # a worker that is killed may not have reported what it inserted
    assert [len(t()) for t in (video.VideoInfo, tracking.Tracking, tracking.SubjectChoice)] == [VIDEOS] * 3
    assert jobs_left() == {}
    assert orphans().lost == []


def test_a_worker_ends_by_itself_before_its_time_limit(settings: None, cluster: slurm.Cluster, tmp_path: Path):
    # Slurm may send the signal up to a minute earlier than the minute that the script names.
    cluster.submit(SCRIPT, "--time=3", *options(tmp_path))
    until(lambda: bool(cluster.accounting()), 300)
    (job,) = cluster.accounting()
    assert (job["JobState"], job["ExitCode"]) == ("COMPLETED", "0:0")  # not TIMEOUT
    (log,) = tmp_path.glob("*.log")
    assert '"worker ended"' in log.read_text()


def options(folder: Path) -> tuple[str, ...]:
    """For a small node: one processor a worker."""
    return ("--cpus-per-task=1", f"--output={folder}/%A_%a.log")
