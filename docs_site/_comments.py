"""A griffe extension for what the library's docstrings look like."""

from __future__ import annotations

from typing import Any

import griffe


class OurDocstrings(griffe.Extension):
    """A constant is documented by the `#:` comment above it, the fields of a dataclass by its docstring and signature."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Called by griffe for every attribute that it has collected."""
        if attr.docstring or not attr.lineno or not isinstance(attr.parent, griffe.Module):
            return
        lines = attr.parent.lines_collection[attr.parent.filepath]
        comment: list[str] = []
        for line in reversed(lines[: attr.lineno - 1]):
            if not line.startswith("#:"):
                break
            comment.insert(0, line.removeprefix("#:").strip())
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
        elif isinstance(scope, griffe.Class) and "dataclass" in scope.labels and member.is_attribute and not member.docstring:
            scope.del_member(name)
