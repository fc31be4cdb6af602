"""Calling `pbl` as its script does, but in this process: exit code and what was printed; programs of a test's own."""

import contextlib
import dataclasses
import io
import sys
from pathlib import Path
from unittest import mock

from pbl_pipeline.cli import main

#: `pbl` in a separate process.
PBL = [sys.executable, "-c", "from pbl_pipeline.cli import main; main()"]


@dataclasses.dataclass(frozen=True)
class Done:
    """What a call of `pbl` left."""

    code: int
    out: str
    err: str

    @property
    def error_code(self) -> str:
        """The code of the error on stderr, "" where there is none."""
        coded = [line for line in self.err.splitlines() if line.split(":")[0].replace("_", "").isupper()]
        return coded[-1].split(":")[0] if coded else ""


def pbl(*arguments: object) -> Done:
    """Run `pbl --quiet ARGUMENTS` through the entry point of the script, with its treatment of errors."""
    out, err = io.StringIO(), io.StringIO()
    with (
        mock.patch.object(sys, "argv", ["pbl", "--quiet", *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        try:
            main()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
        else:
            code = 0
    return Done(code, out.getvalue(), err.getvalue())


def program(folder: Path, name: str, text: str) -> Path:
    """A shell script that stands in for a program of this name."""
    path = folder / name
    path.unlink(missing_ok=True)  # written into a link, it would replace a program of the system
    path.write_text("#!/bin/sh\n" + text)
    path.chmod(0o755)
    return path
