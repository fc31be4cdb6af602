"""Getting the server's Debian packages: installed by root, or unpacked into a folder by anybody."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path

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
    command = [*prefix, "env", "DEBIAN_FRONTEND=noninteractive", "apt-get"]
    add = [*command, "install", "-y", "-q", "--no-install-recommends", *PACKAGES]
    say(f"  {' '.join(add)}")
    if _run(add) is None:
        return None
    say("  the package list is missing or old: apt-get update")
    return _run([*command, "update", "-q"]) or _run(add)


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
        options = [*lists, *apt_options]
        if lists:
            say("  fetching a package list of our own")
            failure = _run(["apt-get", *options, "update", "-q"])
            if failure:
                return failure
        wanted, failure = _missing(options)
        if failure is None:
            say(f"  downloading {', '.join(wanted)}")
            failure = _run(["apt-get", *options, "download", "-q", *wanted], cwd=work / "archives")
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
        return [], _last_line(done.stderr or done.stdout)
    names = [line.split()[1] for line in done.stdout.splitlines() if line.startswith("Inst ")]
    return sorted({*names, *PACKAGES}), None


def _privilege() -> list[str] | None:
    if os.geteuid() == 0:
        return []
    if shutil.which("sudo") and _run(["sudo", "-n", "true"]) is None:
        return ["sudo", "-n"]
    return None


def _run(command: Sequence[str], cwd: Path | None = None) -> str | None:
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            stdin=subprocess.DEVNULL,
            env=_env(),
            cwd=cwd,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return f"{command[0]} did not end within {TIMEOUT_S:.0f} s"
    except FileNotFoundError:
        return f"{command[0]} is not installed"
    if done.returncode == 0:
        return None
    return _last_line(done.stderr or done.stdout) or f"{command[0]} ended with code {done.returncode}"


def _env() -> dict[str, str]:
    # In the C locale, because the output is read here.
    return {**os.environ, "LC_ALL": "C", "DEBIAN_FRONTEND": "noninteractive"}


def _last_line(text: str) -> str:
    lines = [line for line in text.splitlines() if line.strip()]
    return lines[-1].strip() if lines else ""
