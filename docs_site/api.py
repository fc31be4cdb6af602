"""A page for each package of the library and for the modules that the docs tell an analyst or contributor to import."""

from __future__ import annotations

import ast
from pathlib import Path

FOLDER = "reference/api"
#: Modules that the pages and notebooks of docs/ import from, and which of their names are for that; none: all without
#: an underscore. The packages of the library need not be listed.
MODULES: dict[str, tuple[str, ...]] = {
    "pbl_pipeline.assets": (),
    "pbl_pipeline.charts": (),
    "pbl_pipeline.errors": (),
    "pbl_pipeline.method_file": (),
    "pbl_pipeline.methods": (),
    "pbl_pipeline.paramset": (),
    "pbl_pipeline.pipeline": (),
    "pbl_schemas": (),
    "pbl_schemas.connection": ("connect", "schema_name"),
    "pbl_schemas.intake": (),
    "pbl_schemas.method_rows": ("insert_methods", "method_columns"),
    "pbl_schemas.origin": (),
    "pbl_schemas.reading": (),
    "pbl_schemas.rows": ("InputChanged", "one"),
    "pbl_schemas.reading.status": ("pipeline_status",),
    "pbl_schemas.reading.frames": (),
}


def public(root: Path) -> dict[str, list[str]]:
    """Package or module -> its public names: what it defines or a package imports from here, without an underscore."""
    found: dict[str, list[str]] = {}
    for file in sorted((root / "pbl_pipeline").rglob("__init__.py")):
        name = ".".join(file.parent.relative_to(root).parts)
        names = _offered(file)
        if names and name != "pbl_pipeline.cli":  # the commands have pages of their own
            found[name] = names
    for name, names in MODULES.items():
        path = _path(root, name)
        file = path / "__init__.py" if path.is_dir() else path.with_suffix(".py")
        found[name] = list(names) or _offered(file)
    return dict(sorted(found.items()))


def pages(root: Path) -> dict[str, str]:
    """Path in the site -> Markdown with the directives of mkdocstrings."""
    modules = public(root)
    listed = "\n".join(f"- [`{name}`]({name}.md): {len(names)} names" for name, names in modules.items())
    start = "The public names of the library's packages and of the modules that these pages import from."
    found = {f"{FOLDER}/index.md": f"# API\n\n{start}\n\n{listed}\n"}
    for name, names in modules.items():
        below = {n: m for m in modules if m.startswith(f"{name}.") for n in modules[m] if n in names}
        # A function with the name of its module: asked for the name, mkdocstrings would show the module.
        hidden = [n for n in names if (_path(root, name) / f"{n}.py").is_file()]
        parts = [f"# {name}"]
        if below:
            parts.append(f"Also here: {', '.join(f'[`{n}`]({m}.md#{m}.{n})' for n, m in below.items())}.")
        members = "".join(f"\n        - {n}" for n in names if n not in below and n not in hidden)
        parts.append(f"::: {name}\n    options:\n      members:{members}")
        options = "options:\n      show_root_heading: true\n      show_root_toc_entry: true"
        parts += [f"::: {name}.{n}.{n}\n    {options}" for n in hidden]
        found[f"{FOLDER}/{name}.md"] = "\n\n".join(parts) + "\n"
    return found


def _path(root: Path, name: str) -> Path:
    """Where a module or package of the project lies, without ending."""
    inside = {"pbl_schemas": "schemas", "pbl_workers": "workers"}.get(name.partition(".")[0], "")
    return root.joinpath(inside, *name.split("."))


def _offered(file: Path) -> list[str]:
    offered = []
    for node in ast.parse(file.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            offered.append(node.name)
        elif not isinstance(node, ast.ImportFrom) or file.name != "__init__.py":
            continue
        elif node.level or str(node.module).startswith("pbl_pipeline."):
            offered += [alias.asname or alias.name for alias in node.names]
    return [n for n in offered if not n.startswith("_")]
