"""The project's own source as tests of its shape read it: files of a package, parsed once in a process."""

import ast
import functools
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
#: What is installed, and the folder that has it on the path.
PACKAGES = {"pbl_pipeline": ROOT, "pbl_schemas": ROOT / "schemas", "pbl_workers": ROOT / "workers"}


def files(*packages: str) -> list[Path]:
    """The Python files of these packages, in the order of their names."""
    return [f for package in packages for f in sorted((PACKAGES.get(package, ROOT) / package).rglob("*.py"))]


def module_name(file: Path) -> str:
    """The name by which a file of the project is imported."""
    inside = next((folder for folder in (ROOT / "schemas", ROOT / "workers") if file.is_relative_to(folder)), ROOT)
    return ".".join(file.relative_to(inside).with_suffix("").parts).removesuffix(".__init__")


@functools.cache
def nodes(file: Path) -> tuple[ast.AST, ...]:
    """Every node of a file, the module first."""
    return tuple(ast.walk(ast.parse(file.read_text("utf-8"))))
