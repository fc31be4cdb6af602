"""A page for each package of the library and for the modules that the docs tell an analyst or contributor to import."""

from __future__ import annotations

import ast
from pathlib import Path

FOLDER = "reference/api"
#: Modules whose public names the pages of docs/ use. The packages of the library need not be listed.
MODULES = (
    "pbl_pipeline.errors", "pbl_pipeline.method_file", "pbl_pipeline.methods", "pbl_pipeline.paramset", "pbl_pipeline.pipeline",
    "schemas", "schemas.bulk", "schemas.method_rows", "schemas.origin", "schemas.results", "schemas.rows", "schemas.views",
)  # fmt: skip


def public(root: Path) -> dict[str, list[str]]:
    """Package or module -> its public names: `__all__`, or what it defines without an underscore."""
    found = {}
    for file in sorted((root / "pbl_pipeline").rglob("__init__.py")):
        name = ".".join(file.parent.relative_to(root).parts)
        names = _all(file)
        if names and name != "pbl_pipeline.cli":  # the commands have pages of their own
            found[name] = names
    for name in MODULES:
        path = root.joinpath(*name.split("."))
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        found[name] = _all(file) or _defined(file)
    return found


def pages(root: Path) -> dict[str, str]:
    """Path in the site -> Markdown with the directives of mkdocstrings."""
    modules = public(root)
    found = {}
    for name, names in modules.items():
        elsewhere = {n: below for below in modules if below.startswith(f"{name}.") for n in modules[below] if n in names}
        members = "".join(f"        - {n}\n" for n in names if n not in elsewhere)
        also = ", ".join(f"[`{n}`]({below}.md#{below}.{n})" for n, below in elsewhere.items())
        found[f"{FOLDER}/{name}.md"] = f"# {name}\n\n{f'Also here: {also}.' if also else ''}\n\n::: {name}\n    options:\n      members:\n{members}"
    listed = "\n".join(f"- [`{name}`]({name}.md): {len(names)} names" for name, names in modules.items())
    found[f"{FOLDER}/index.md"] = (
        "# API\n\nThe public names of the library's packages, and of the modules that these pages tell you to import. Made from their "
        f"docstrings.\n\n{listed}\n"
    )
    return found


def _all(file: Path) -> list[str]:
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign) and any(isinstance(t, ast.Name) and t.id == "__all__" for t in node.targets):
            return list(ast.literal_eval(node.value))
    return []


def _defined(file: Path) -> list[str]:
    kinds = (ast.FunctionDef, ast.ClassDef)
    body = ast.parse(file.read_text(encoding="utf-8")).body
    return [node.name for node in body if isinstance(node, kinds) and not node.name.startswith("_")]
