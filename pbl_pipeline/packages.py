"""Pinned packages of public registries: how their own clients download them, and how files are read out of them.

Pip fetches wheels, npm fetches tarballs, each through the index, mirror or proxy that this machine is configured for.
Nothing of a package is installed or run.
"""

from __future__ import annotations

import abc
import dataclasses
import importlib.util
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path
from typing import ClassVar

from . import npm_by_pip


@dataclasses.dataclass(frozen=True)
class Package(abc.ABC):
    """A pinned package: the request to its client, and the hash of the file that is to come."""

    requirement: str
    filename: str
    sha256: str
    size_bytes: int
    kind: ClassVar[str]  # the registry's word for a package

    @abc.abstractmethod
    def command(self, into: str | Path) -> list[str]:
        """The client's call that downloads exactly this package into a folder."""

    @abc.abstractmethod
    def absent(self) -> str:
        """Reason why this machine cannot run `command`, and how to install the client; empty if it can."""

    @abc.abstractmethod
    def environment(self, scratch: Path) -> dict[str, str]:
        """Variables that make the client collect the download in the folder `scratch`."""

    def client_bytes(self) -> int:
        """Space for the client itself, where it has to be fetched."""
        return 0

    @abc.abstractmethod
    def reason(self, done: subprocess.CompletedProcess[str]) -> str:
        """The client's error in one line."""

    @abc.abstractmethod
    def read(self, path: Path, member: str) -> bytes:
        """One file of the downloaded package."""

    def remedy(self) -> str:
        """The call for another machine, as a line of a shell."""
        program, *arguments = self.command(".")
        return shlex.join([Path(program).stem if program != sys.executable else "python", *arguments])


@dataclasses.dataclass(frozen=True)
class Wheel(Package):
    """Of a Python package index. `pip_options` select the same file on every machine."""

    pip_options: tuple[str, ...]
    kind: ClassVar[str] = "wheel"

    def command(self, into: str | Path) -> list[str]:
        quiet = ("--quiet", "--no-input", "--disable-pip-version-check")
        return [
            *(sys.executable, "-m", "pip", "download", "--no-deps", *quiet),
            *("--dest", str(into), *self.pip_options, self.requirement),
        ]

    def absent(self) -> str:
        return "" if importlib.util.find_spec("pip") else "this Python has no pip; `python -m ensurepip` adds it"

    def environment(self, scratch: Path) -> dict[str, str]:
        return {"TMPDIR": str(scratch)}

    def reason(self, done: subprocess.CompletedProcess[str]) -> str:
        """Pip's last error. Where the index could not be reached, or sent no list of files, that is only that nothing
        matches, so the cause comes first."""
        errors = _lines(done.stderr, "ERROR")
        reason = errors[-1] if errors else f"pip ended with code {done.returncode} and brought another file"
        if reason.endswith("Exception:"):  # of pip itself, a full disk for one: the traceback ends with it
            reason = done.stderr.strip().splitlines()[-1]
        if broken := re.findall("connection broken by (.*): /", done.stderr):
            return f"no connection to the package index ({reason}; {broken[-1]})"
        if "ConnectionError" in done.stderr:
            return f"no connection to the package index ({reason})"
        return f"{_NOT_AN_INDEX} ({reason})" if "from versions: none" in done.stderr else reason

    def read(self, path: Path, member: str) -> bytes:
        with zipfile.ZipFile(path) as archive:
            return archive.read(member)


@dataclasses.dataclass(frozen=True)
class NpmPackage(Package):
    """Of an npm registry; `npm pack` downloads the tarball as it was published. Where npm is absent, pip brings it."""

    kind: ClassVar[str] = "npm package"

    def command(self, into: str | Path) -> list[str]:
        npm = shutil.which("npm")
        return [*([npm] if npm else [sys.executable, "-m", npm_by_pip.__name__]), *self._pack(into)]

    def _pack(self, into: str | Path) -> list[str]:
        quiet = ("--ignore-scripts", "--loglevel=error")
        return ["pack", *quiet, "--pack-destination", str(into), self.requirement]

    def absent(self) -> str:
        if shutil.which("npm") or importlib.util.find_spec("pip"):
            return ""
        remedy = "the system's package manager has it (Debian: `apt-get install npm`)"
        return f"this machine has neither npm, which fetches it, nor pip, which brings npm; {remedy}"

    def remedy(self) -> str:
        return shlex.join(["npm", *self._pack(".")])

    def environment(self, scratch: Path) -> dict[str, str]:
        # Node keeps compiled modules among the temporary files as well, and nobody removes them.
        return {"npm_config_cache": str(scratch), "TMPDIR": str(scratch)}

    def client_bytes(self) -> int:
        return 0 if shutil.which("npm") else npm_by_pip.SIZE_BYTES

    def reason(self, done: subprocess.CompletedProcess[str]) -> str:
        """Npm's first sentence after its codes; a failed connection comes first."""
        lines = _lines(done.stderr, "npm ERR!", "npm error", "ERROR")
        errors = [line for line in lines if line and not line.startswith(("code ", "syscall ", "errno "))]
        reason = errors[0] if errors else f"npm ended with code {done.returncode} and brought another file"
        codes = "ENOTFOUND|ECONNREFUSED|EAI_AGAIN|ETIMEDOUT|ECONNRESET|connection broken|ConnectionError"
        if re.search(codes, done.stderr):
            return f"no connection to the package registry ({reason})"
        other = "invalid json response" in done.stderr or "from versions: none" in done.stderr
        return f"{_NOT_AN_INDEX} ({reason})" if other else reason

    def read(self, path: Path, member: str) -> bytes:
        with tarfile.open(path, "r:gz") as archive:
            file = archive.extractfile(member)
            assert file is not None  # a member of a file whose hash was checked
            return file.read()


#: The likely cause, which pip and npm do not name: a network shows its page to sign in at every address.
_NOT_AN_INDEX = (
    "the registry answered, but not with this package: open a page in a browser of this machine, where the network may "
    "ask you to sign in, and check the proxy or mirror that is configured"
)

#: Client -> the kind of package that it downloads.
CLIENTS: dict[str, type[Package]] = {"pip": Wheel, "npm": NpmPackage}


def _lines(text: str, *starts: str) -> list[str]:
    found = [line.strip() for line in text.splitlines() if line.strip().startswith(starts)]
    return [line.removeprefix("npm ERR!").removeprefix("npm error").strip() for line in found]
