"""The project's own source as tests of its shape read it: files of a package, parsed once in a process."""

import ast
import functools
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def files(*packages: str) -> list[Path]:
    """The Python files of these packages, in the order of their names."""
    return [f for package in packages for f in sorted((ROOT / package).rglob("*.py"))]


@functools.cache
def nodes(file: Path) -> tuple[ast.AST, ...]:
    """Every node of a file, the module first."""
    return tuple(ast.walk(ast.parse(file.read_text("utf-8"))))
