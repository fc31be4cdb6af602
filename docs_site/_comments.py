"""A griffe extension for what the library's docstrings look like."""

from __future__ import annotations

import ast
from typing import Any

import griffe


class OurDocstrings(griffe.Extension):
    """The `#:` comment above a constant or field documents it, or what stands behind the field; docstring and signature
    of a dataclass document its other fields."""

    def on_module_members(self, *, node: ast.AST | griffe.ObjectNode, mod: griffe.Module, **_: Any) -> None:
        """Adds what griffe leaves out: the names of `LEFT, RIGHT = "left", "right"`."""
        for line in node.body if isinstance(node, ast.Module) else ():
            if isinstance(line, ast.Assign) and isinstance(line.targets[0], ast.Tuple):
                names = [e.id for e in line.targets[0].elts if isinstance(e, ast.Name)]
                same = isinstance(line.value, ast.Tuple) and len(line.value.elts) == len(names)
                values = [ast.unparse(v) for v in line.value.elts] if same else [None] * len(names)  # type: ignore[attr-defined]
                for name, value in zip(names, values, strict=True):
                    attribute = griffe.Attribute(name, lineno=line.lineno, endlineno=line.end_lineno, value=value)
                    mod.set_member(name, attribute)
                    self.on_attribute_instance(attr=attribute)

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Called by griffe for every attribute that it has collected."""
        if attr.docstring or not attr.lineno or not isinstance(attr.parent, griffe.Module | griffe.Class):
            return
        path = attr.parent.filepath
        lines = attr.parent.lines_collection[path] if not isinstance(path, list) else []
        comment: list[str] = []
        for line in map(str.strip, reversed(lines[: attr.lineno - 1])):
            if not line.startswith("#:"):
                break
            comment.insert(0, line.removeprefix("#:").strip())
        if isinstance(attr.parent, griffe.Class) and not comment:
            behind = lines[attr.lineno - 1].partition("  # ")[2]
            comment = [behind] if behind and not behind.startswith(("pyright", "type:", "noqa")) else []
        if comment:
            attr.docstring = griffe.Docstring("\n".join(comment), lineno=attr.lineno - len(comment), parent=attr)

    def on_package(self, *, pkg: griffe.Module, **_: Any) -> None:
        """Called once all is collected, after griffe's own extension has made the signatures of dataclasses."""
        _without_fields(pkg)


def _without_fields(scope: griffe.Module | griffe.Class) -> None:
    for name, member in list(scope.members.items()):
        if member.is_alias:
            continue
        if isinstance(member, griffe.Module | griffe.Class):
            _without_fields(member)
        elif (
            isinstance(scope, griffe.Class)
            and "dataclass" in scope.labels
            and member.is_attribute
            and not member.docstring
        ):
            scope.del_member(name)
