"""Getting the server's Debian packages: installed by root, or unpacked into a folder by any user.

By hand, because apt installs for root only; for other users its packages are downloaded and unpacked into a folder.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import threading
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from pathlib import Path

from pbl_pipeline.progress import bar

#: The bare programs: no service, no system user, nothing started.
PACKAGES = ("mariadb-server-core", "mariadb-client-core")
TIMEOUT_S = 600.0

Say = Callable[[str], None]


def install(say: Say) -> str | None:
    """Install the packages on the system, as root or with a sudo that asks no password.

    Returns
    -------
    str | None
        None when they are installed, else why not.
    """
    prefix = _privilege()
    if prefix is None:
        return "you are not root and sudo asks for a password"
    # A fresh machine may be installing its own updates: wait for the lock.
    command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get", "-q", "-o", "DPkg::Lock::Timeout=120"]
    add = [*command, "install", "-y", "--no-install-recommends", *PACKAGES]
    say(f"  {' '.join([*prefix, 'apt-get install --no-install-recommends', *PACKAGES])}")
    failure = _run(add, label="apt-get install")
    if failure is None:
        return None
    say(f"  the package list may be missing or old ({failure}): apt-get update")
    return _run([*command, "update"], label="apt-get update") or _run(add, label="apt-get install")


def unpack(folder: Path, say: Say, apt_options: Sequence[str] = ()) -> str | None:
    """Download the packages, with the libraries the system lacks, and unpack them into `folder`. Needs no root.

    Parameters
    ----------
    folder
        Becomes the root of the unpacked tree (`folder/usr/sbin/mariadbd`).
    apt_options
        Further `-o` options of apt, e.g. another package status in a test.

    Returns
    -------
    str | None
        None when done, else why not.
    """
    work = folder.with_name(folder.name + ".tmp")
    try:
        shutil.rmtree(work, ignore_errors=True)
        (work / "lists" / "partial").mkdir(parents=True)
        (work / "archives" / "partial").mkdir(parents=True)
        failure = _download_and_unpack(work, say, apt_options)
        if failure is None:
            shutil.rmtree(folder, ignore_errors=True)
            (work / "root").rename(folder)
        return failure
    except OSError as error:
        return f"{error.strerror or error} ({error.filename or work})"
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _download_and_unpack(work: Path, say: Say, apt_options: Sequence[str]) -> str | None:
    # The system's package lists are used as they are; where they are missing, own ones are fetched beside them.
    own_lists = ["-o", f"Dir::State::Lists={work / 'lists'}", "-o", f"Dir::Cache={work}", "-o", "Debug::NoLocking=1"]
    for lists in ([], own_lists):
        options = [*apt_options, *lists]
        if lists:
            say("  fetching a package list of our own")
            failure = _run(["apt-get", *options, "-q", "update"], label="apt-get update")
            if failure:
                return failure
        wanted, failure = _missing(options)
        if failure is None:
            say(f"  downloading {', '.join(wanted)}")
            failure = _run(["apt-get", *options, "-q", "download", *wanted], work / "archives", "apt-get download")
        if failure is None:
            break
    else:
        return failure
    for package in sorted((work / "archives").glob("*.deb")):
        failure = _run(["dpkg", "-x", str(package), str(work / "root")])
        if failure:
            return failure
    return None


def _missing(options: Sequence[str]) -> tuple[list[str], str | None]:
    """The packages an installation would add: ours and the libraries that are not there, as `name=version`."""
    simulate = ["apt-get", *options, "-s", "-q", "install", "--no-install-recommends", *PACKAGES]
    done = subprocess.run(simulate, capture_output=True, text=True, timeout=TIMEOUT_S, env=_env(), check=False)
    if done.returncode != 0:
        return [], _reason(done.stderr or done.stdout) or "apt-get failed"
    names = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("Inst ")]
    return sorted({*names, *PACKAGES}), None


def _privilege() -> list[str] | None:
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and _run(["sudo", "-n", "true"]) is None:
        return ["sudo", "-n"]
    return None


def _run(command: Sequence[str], cwd: Path | None = None, label: str = "") -> str | None:
    """Run to the end, with a bar that moves with each line when `label` is given; None when well, else why not."""
    try:
        child = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            env=_env(),
            cwd=cwd,
        )
    except FileNotFoundError:
        return f"{command[0]} is not installed"
    watchdog = threading.Timer(TIMEOUT_S, child.kill)
    watchdog.start()
    said = ""
    try:
        with bar(label, unit="line") if label else nullcontext() as update:
            for line in child.stdout or ():
                said += line
                if update is not None:
                    update(1, line.strip()[:50])
        child.wait()
    finally:
        watchdog.cancel()
        child.kill()
    if child.returncode == 0:
        return None
    return _reason(said) or f"{command[0]} ended with code {child.returncode}"


def _env() -> dict[str, str]:
    # In the C locale, because the output is read here.
    return {**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}


def _reason(text: str) -> str:
    """The line that says why: apt's first error (E: ...), else the last line."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return next((line for line in lines if line.startswith("E: ")), lines[-1] if lines else "")
