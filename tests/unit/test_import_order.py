"""Every module of the tables can be the first that a command imports."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

_FIRST = """
import importlib, pathlib, sys
import schemas.reading, workers.web
root = pathlib.Path(schemas.__file__).parents[1]
for room in ("schemas", "workers"):
    for file in sorted((root / room).rglob("*.py")):
        name = ".".join(file.relative_to(root).with_suffix("").parts).removesuffix(".__init__")
        if not file.stem[:1].isdigit():
            for loaded in [n for n in sys.modules if n.partition(".")[0] in ("schemas", "workers")]:
                del sys.modules[loaded]
            try:
                importlib.import_module(name)
            except ImportError as error:
                print(name, error)
"""


@pytest.mark.slow
def test_no_module_needs_another_to_be_imported_before_it():
    root = Path(__file__).parents[2]
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", _FIRST], cwd=root, capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-1000:]
