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
        """Pip's last error, or the end of its traceback (of a full disk, for one)."""
        errors = _lines(done.stderr, "ERROR")
        reason = errors[-1] if errors else f"pip ended with code {done.returncode} and brought another file"
        return _explained(
            done.stderr.strip().splitlines()[-1] if reason.endswith("Exception:") else reason, done.stderr
        )

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
        # Node keeps compiled modules among the temporary files as well, and nothing removes them.
        return {"npm_config_cache": str(scratch), "TMPDIR": str(scratch)}

    def reason(self, done: subprocess.CompletedProcess[str]) -> str:
        """Npm's first sentence after its codes."""
        lines = _lines(done.stderr, "npm ERR!", "npm error", "ERROR")
        errors = [line for line in lines if line and not line.startswith(("code ", "syscall ", "errno "))]
        reason = errors[0] if errors else f"npm ended with code {done.returncode} and brought another file"
        return _explained(reason, done.stderr)

    def read(self, path: Path, member: str) -> bytes:
        with tarfile.open(path, "r:gz") as archive:
            file = archive.extractfile(member)
            assert file is not None  # a member of a file whose hash was checked
            return file.read()


#: Client -> the kind of package that it downloads.
CLIENTS: dict[str, type[Package]] = {"pip": Wheel, "npm": NpmPackage}


#: Of a failed connection, and of an answer without packages: a network shows its page to sign in at every address.
_UNREACHABLE = "ENOTFOUND|ECONNREFUSED|EAI_AGAIN|ETIMEDOUT|ECONNRESET|connection broken|ConnectionError"
_UNTRUSTED = "CERTIFICATE_VERIFY_FAILED|SELF_SIGNED_CERT|self-signed certificate|UNABLE_TO_(?:GET_ISSUER|VERIFY)"
_OTHER_ANSWER = "invalid json response|from versions: none"


def _explained(reason: str, printed: str) -> str:
    """The error of pip or npm with its cause: after either of the two, pip says only that nothing matches."""
    if re.search(_UNTRUSTED, printed):
        advice = "name the file with the certificate of your proxy's authority in PIP_CERT and NODE_EXTRA_CA_CERTS"
        return f"the registry's certificate is not trusted: {advice} ({reason})"
    if re.search(_UNREACHABLE, printed):
        causes = re.findall("connection broken by (.*): /", printed)
        return f"no connection to the package registry ({'; '.join([reason, *causes[-1:]])})"
    advice = "open a page in a browser, where the network may ask you to sign in, and check the proxy or mirror in use"
    other = re.search(_OTHER_ANSWER, printed)
    return f"the registry answered, but not with this package: {advice} ({reason})" if other else reason


def _lines(text: str, *starts: str) -> list[str]:
    found = [line.strip() for line in text.splitlines() if line.strip().startswith(starts)]
    return [line.removeprefix("npm ERR!").removeprefix("npm error").strip() for line in found]
