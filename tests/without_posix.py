"""`pbl` as far as this system can stand in for Windows.

Modules of this project find none of the modules, and none of the names of `os`, that only POSIX systems have. Other
packages find them: what they do on another system is theirs. Printed text has the encoding of Windows (cp1252), which
lacks most letters. What this cannot show: paths with drive letters and backslashes, files that
cannot be removed while they are open, and whether the dependencies work there.
"""

from __future__ import annotations

import builtins
import contextlib
import io
import json
import os
import subprocess
import sys
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.command import Done

ROOT = Path(__file__).resolve().parents[1]
ENCODING = "cp1252"

ABSENT_MODULES = ("fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty")
_NAMES = """
    O_CLOEXEC O_DIRECTORY O_NOFOLLOW O_NONBLOCK chown chroot confstr fchmod fchown fork forkpty getegid geteuid
    getgid getgroups getloadavg getpgid getpgrp getsid getuid getxattr initgroups killpg lchown listxattr mkfifo
    mknod nice openpty pathconf posix_fadvise posix_fallocate pread pwrite readv removexattr sched_getaffinity
    sched_setaffinity setegid seteuid setgid setpgid setpriority setsid setuid setxattr statvfs sync sysconf
    uname wait3 wait4
"""
ABSENT_NAMES = frozenset(_NAMES.split())
OURS = ("pbl_pipeline", "pbl_schemas", "pbl_workers")


class WithoutPosix(types.ModuleType):
    """The module `os` without the names that Windows lacks."""

    def __getattr__(self, name: str) -> Any:
        if name in ABSENT_NAMES:
            raise AttributeError(f"module 'os' has no attribute {name!r}")
        return getattr(os, name)


def install() -> None:
    """From here on modules of the project are imported without POSIX."""
    real_import, stand_in = builtins.__import__, WithoutPosix("os")

    def imported(name: str, globals: Any = None, locals: Any = None, fromlist: Any = (), level: int = 0) -> Any:
        module = (globals or {}).get("__name__", "")
        if module.split(".")[0] in OURS and level == 0:
            if name in ABSENT_MODULES:
                raise ModuleNotFoundError(f"No module named {name!r} (imported by {module})", name=name)
            if name == "os":
                return stand_in
        return real_import(name, globals, locals, fromlist, level)

    builtins.__import__ = imported


def main() -> None:
    """Calls of `pbl`, one after the other; their arguments come as JSON, and their ends go as JSON."""
    install()
    from pbl_pipeline.cli import main as pbl_main

    ends, calls = [], json.loads(sys.argv[1])
    for sys.argv[1:] in calls:
        files = io.BytesIO(), io.BytesIO()
        out, err = (io.TextIOWrapper(f, ENCODING, "strict", write_through=True) for f in files)
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            try:
                pbl_main()
            except SystemExit as end:
                ends.append([end.code or 0, *(f.getvalue().decode(ENCODING) for f in files)])
    sys.stdout.write(json.dumps(ends))


def each(*calls: Iterable[object], packages: Path = ROOT, variables: Mapping[str, str] | None = None) -> list[Done]:
    """Run `pbl --quiet` with the arguments of each call in one process without POSIX, in which these variables are set.

    `packages` is the folder that the project's packages are imported from: this checkout, or an installed wheel.
    """
    from tests.command import Done

    words = [sys.executable, "-P", __file__, json.dumps([["--quiet", *map(str, call)] for call in calls])]
    env = {**os.environ, "PYTHONPATH": str(packages), **(variables or {})}
    done = subprocess.run(words, capture_output=True, env=env, timeout=300, check=False)
    assert done.returncode == 0, done.stderr.decode()
    ends = json.loads(done.stdout)
    assert len(ends) == len(calls), done.stderr.decode()
    return [Done(*end) for end in ends]


def pbl(*arguments: object, **options: Any) -> Done:
    """`each` of one call."""
    return each(arguments, **options)[0]


if __name__ == "__main__":
    main()
