"""The image and the containers of this repository without Docker: `workers/deploy/Dockerfile` carried out step by step
in a Debian root folder, and its services of `docker-compose.yml` run in it by chroot.

Debian's packages: `apt-get install debootstrap`; root. A container here has the image's read-only root, the service's
user, environment, volumes, secrets and tmpfs, no capabilities and no new privileges, and the network of the machine.
The base image is Debian with its own Python of the same minor version, in the place of python:3.11-slim-bookworm.
"""

import contextlib
import dataclasses
import fnmatch
import os
import re
import shlex
import shutil
import subprocess
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = ROOT / "workers" / "deploy" / "Dockerfile"
#: What the base image has, and where.
_BASE = ("python3", "python3-venv", "ca-certificates")
_PATH = "/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


def missing() -> str:
    """What keeps images from being made here, "" where nothing does."""
    if os.geteuid() != 0:
        return "root"
    return ", ".join(p for p in ("debootstrap", "unshare", "setpriv") if shutil.which(p) is None)


@dataclasses.dataclass
class Image:
    """A root folder, and what its Dockerfile says of containers."""

    folder: Path
    environment: dict[str, str]
    entrypoint: list[str]
    user: str


# ---------------------------------------------------------------------------------------------------------- building
def build(folder: Path, flavour: str = "cpu") -> Image:
    """Carry out the Dockerfile below `folder`: one root folder for each of its stages."""
    base = folder / "base"
    subprocess.run(
        ["debootstrap", "--variant=minbase", f"--include={','.join(_BASE)}", "bookworm", base],
        check=True,
        stdout=subprocess.DEVNULL,
    )
    (base / "usr" / "local" / "bin" / "python").symlink_to("/usr/bin/python3")
    arguments = {"FLAVOUR": flavour, "COMMIT": "0123456789ab"}
    stages: dict[str, Path] = {}
    stage, image = base, Image(base, {"PATH": _PATH}, [], "0:0")
    for word, rest in _steps():
        text = _filled(rest, r"\$\{(\w+)\}", arguments)
        if word == "FROM":
            begins, _, name = text.partition(" AS ")
            stage = folder / (name or "image")
            stages[name] = stage
            subprocess.run(["mkdir", stage] if begins == "scratch" else ["cp", "-a", base, stage], check=True)
            image = Image(stage, {"PATH": _PATH}, [], "0:0")
        elif word == "ENV":
            image.environment |= _pairs(_filled(text, r"\$(\w+)", image.environment))
        elif word == "RUN":
            with _build_secret(stage if "id=build_ca" in text else None):
                _run(stage, re.sub(r"--mount=\S+ ", "", text), image.environment)
        elif word == "COPY":
            _copy(stage, text.split(), stages)
        elif word == "USER":
            image.user = text
        elif word == "ENTRYPOINT":
            image.entrypoint = yaml.safe_load(text)
        else:
            assert word in ("ARG", "LABEL", "STOPSIGNAL", "CMD"), word
            arguments |= {k: v for k, v in _pairs(text).items() if word == "ARG" and k not in arguments}
    return image


@contextlib.contextmanager
def _build_secret(stage: Path | None) -> Iterator[None]:
    """The authority of this machine's proxy, if it has one, as the build secret `build_ca` of a step."""
    if stage is None or not (authority := os.environ.get("NODE_EXTRA_CA_CERTS")):
        yield
        return
    secret = stage / "run" / "secrets" / "build_ca"
    secret.parent.mkdir(exist_ok=True)
    shutil.copyfile(authority, secret)
    try:
        yield
    finally:
        secret.unlink()


def _steps() -> list[tuple[str, str]]:
    lines = [line for line in DOCKERFILE.read_text().splitlines() if not line.lstrip().startswith("#")]
    whole = "\n".join(lines).replace("\\\n", " ")
    return [(word, rest.strip()) for word, _, rest in (line.partition(" ") for line in whole.splitlines() if line)]


def _filled(text: str, pattern: str, values: Mapping[str, str]) -> str:
    return re.sub(pattern, lambda m: values.get(m.group(1), m.group(0)), text)


def _pairs(text: str) -> dict[str, str]:
    return dict(word.split("=", 1) for word in shlex.split(text) if "=" in word)


def _run(stage: Path, command: str, environment: Mapping[str, str]) -> None:
    """A RUN step, with this machine's name servers, certificates and settings of pip, which may name a mirror."""
    settings = {name: value for name, value in os.environ.items() if name.startswith("PIP_")}
    mounts = ["-t proc proc /proc", "--bind /etc/ssl /etc/ssl", "--bind /etc/resolv.conf /etc/resolv.conf"]
    steps = [f"mount {' '.join(words[:-1])} {stage}{words[-1]}" for words in map(str.split, mounts)]
    script = " && ".join([*steps, f"exec chroot {stage} /bin/sh -c {shlex.quote(command)}"])
    for path in (Path("/etc/pip.conf"), Path.home() / ".config" / "pip" / "pip.conf"):
        if path.is_file():
            shutil.copyfile(path, stage / "etc" / "pip.conf")
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", script],
        env={"HOME": "/root", **settings, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"RUN {command}\n{done.stdout[-2000:]}{done.stderr[-2000:]}"


def _copy(stage: Path, words: list[str], stages: Mapping[str, Path]) -> None:
    options = [w for w in words if w.startswith("--")]
    *sources, target = (w for w in words if not w.startswith("--"))
    for source in sources:
        from_stage = next((stages[o.removeprefix("--from=")] for o in options if o.startswith("--from=")), None)
        path = ROOT / source if from_stage is None else from_stage / source.lstrip("/")
        assert from_stage is not None or sent_to_builder(source), f"{source} is kept from the builder by dockerignore"
        into = stage / target.lstrip("/")
        if target.endswith("/"):
            into = into / path.name
        into.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            shutil.copytree(path, into, symlinks=True, dirs_exist_ok=True, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copyfile(path, into)
        for option in options:
            if option.startswith("--chmod="):
                into.chmod(int(option.removeprefix("--chmod="), 8))


def sent_to_builder(source: str) -> bool:
    """Whether the list of ignored files lets a path through: the last pattern that fits decides."""
    sent = True
    for line in (DOCKERFILE.parent / "Dockerfile.dockerignore").read_text().splitlines():
        pattern = line.removeprefix("!")
        if line and not line.startswith("#") and (fnmatch.fnmatch(source, pattern) or source.startswith(pattern + "/")):
            sent = line.startswith("!")
    return sent


# -------------------------------------------------------------------------------------------------------- containers
def service(name: str, variables: Mapping[str, str]) -> dict[str, Any]:
    """A service of the compose file, with the values of these variables."""
    text = (ROOT / "docker-compose.yml").read_text()
    innermost = re.compile(r"\$\{(\w+)(?::([-?])([^{}$]*))?\}")
    while innermost.search(text):
        text = innermost.sub(lambda m: variables.get(m.group(1)) or (m.group(3) if m.group(2) == "-" else ""), text)
    return yaml.safe_load(text)["services"][name]


@dataclasses.dataclass
class Container:
    """What a service's processes find. volumes: named volume -> folder. changes: variables that differ here."""

    image: Image
    service: dict[str, Any]
    secrets: Path
    volumes: Mapping[str, Path]
    changes: Mapping[str, str]

    def start(self, command: list[str] | None = None) -> subprocess.Popen[str]:
        """Run the service: its entrypoint (else the image's) and command, or another command behind the entrypoint."""
        entrypoint = self.service.get("entrypoint", self.image.entrypoint)
        return self._launch([*entrypoint, *(command if command is not None else self.service.get("command", []))])

    def execute(self, *command: str) -> subprocess.CompletedProcess[str]:
        """A command beside it, as `docker compose exec` runs it: without the entrypoint."""
        process = self._launch([*command])
        out, err = process.communicate()
        return subprocess.CompletedProcess(command, process.returncode, out, err)

    def finish(self, command: list[str] | None = None) -> str:
        """`start`, to its end, which must be a success; what it printed."""
        process = self.start(command)
        out, _ = process.communicate()
        assert process.returncode == 0, out
        return out

    def _launch(self, words: list[str]) -> subprocess.Popen[str]:
        root, steps = self.image.folder, []

        def mount(path: str, how: Callable[[str], str]) -> None:
            (root / path.lstrip("/")).mkdir(parents=True, exist_ok=True)
            steps.append(how(f"{root}/{path.lstrip('/')}"))

        mount("/", lambda at: f"mount --rbind {root} {root}")
        for entry in self.service["volumes"]:
            source, path, *mode = entry.split(":")
            folder = self.volumes.get(source, Path(source))
            mount(path, lambda at, folder=folder: f"mount --bind {folder} {at}")
            if mode == ["ro"]:
                steps.append(f"mount -o remount,bind,ro {root}{path}")
        for entry in self.service["tmpfs"]:
            path, _, options = entry.partition(":")
            mount(path, lambda at, options=options: f"mount -t tmpfs -o {options} tmpfs {at}")
        mount("/run/secrets", lambda at: f"mount -t tmpfs -o mode=755 tmpfs {at}")
        for name in self.service["secrets"]:
            steps.append(
                f"touch {root}/run/secrets/{name} && mount --bind {self.secrets}/{name} {root}/run/secrets/{name}"
            )
        steps += [f"mount -t proc proc {root}/proc", f"mount --rbind /dev {root}/dev"]
        (root / "etc" / "hosts").touch()
        steps.append(f"mount --bind {self.secrets.parent}/hosts {root}/etc/hosts")
        assert self.service["read_only"] is True
        steps.append(f"mount -o remount,bind,ro {root}")
        user, group = self.service["user"].split(":")
        environment = self.image.environment | self.service["environment"] | dict(self.changes)
        assert self.service["cap_drop"] == ["ALL"]
        assert self.service["security_opt"] == ["no-new-privileges:true"]
        drop = ["--reuid", user, "--regid", group, "--clear-groups", "--no-new-privs"]
        drop += ["--bounding-set=-all", "--inh-caps=-all", "--ambient-caps=-all"]
        variables = [f"{name}={value}" for name, value in environment.items()]
        inside = ["chroot", str(root), "setpriv", *drop, "--", "env", "-i", *variables, *words]
        script = " && ".join([*steps, "exec " + shlex.join(inside)])
        return subprocess.Popen(
            ["unshare", "--mount", "--", "sh", "-c", script],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
