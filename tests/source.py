"""The project's own source as tests of its shape read it: files of a package, parsed once in a process."""

import ast
import functools
import gc
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def files(*packages: str) -> list[Path]:
    """The Python files of these packages, in the order of their names."""
    return [f for package in packages for f in sorted((ROOT / package).rglob("*.py"))]


@functools.cache
def nodes(file: Path) -> tuple[ast.AST, ...]:
    """Every node of a file, the module first."""
    try:
        gc.disable()  # a million objects that live as long as the process: nothing is found among them
        return tuple(ast.walk(ast.parse(file.read_text("utf-8"))))
    finally:
        gc.enable()
