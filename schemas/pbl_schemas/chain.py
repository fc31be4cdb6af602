"""The tables in the order of dependency, read from their definitions: one order for populating, status, planning, docs.

DataJoint refuses a definition that refers to a table which is not declared yet, so the order of declaration is one in
which every table comes after those that it needs.
"""

from __future__ import annotations

import functools
import inspect
import re
from typing import Any

from .datajoint_setup import dj
from .stages import STAGES, modules

_REFERENCE = re.compile(r"\s*->\s*(?:\[[^\]]*\]\s*)?([\w.]+?)(?:\.proj\((\w+)=.*)?\s*$")


def tables() -> dict[str, Any]:
    """Return every table class by its name, such as `fit.SessionFit.Trial`, in the order of declaration."""
    out: dict[str, Any] = {}
    for stage, module in zip(STAGES, modules(), strict=True):
        for cls, _ in module.schema.declare_list:
            out[f"{stage}.{cls.__name__}"] = cls
            for name, part in vars(cls).items():
                if inspect.isclass(part) and issubclass(part, dj.Part):
                    out[f"{stage}.{cls.__name__}.{name}"] = part
    return out


def references(name: str, cls: Any) -> list[str]:
    """Return the names of the tables that a table refers to by a foreign key."""
    stage, master = name.split(".")[0], ".".join(name.split(".")[:2])
    out = []
    for line in cls.definition.splitlines():
        if match := _REFERENCE.match(line):
            target = match[1]
            known = master if target == "master" else target
            out.append(known if known.split(".")[0] in STAGES else f"{stage}.{known}")
    return out


def renamed(cls: Any) -> list[str | None]:
    """Return for each of `references` the name of its column here, None if it is unchanged."""
    return [match[2] for line in cls.definition.splitlines() if (match := _REFERENCE.match(line))]


def computed_tables() -> list[Any]:
    """The computed tables in the order of the chain."""
    return [cls for cls in tables().values() if issubclass(cls, dj.Computed)]


#: Computed tables with rows on request only: a reference was registered, a setting asks for copies, forces were planned
#: (visits that were registered before forces existed have no plan of them).
ON_REQUEST = ("KinematicError", "Deidentified", "Kinetics")


def is_wanted(table: Any) -> bool:
    """Return whether the settings ask for this table (its `wanted`, if it has one), without a query."""
    return getattr(table, "wanted", lambda: True)()


@functools.cache
def before(table: Any) -> tuple[Any, ...]:
    """The computed tables before this one."""
    chain = computed_tables()
    return tuple(chain[: chain.index(table)])


def needs(table: Any) -> list[Any]:
    """The computed tables that this one reads: those that its foreign keys name, and those of its parts. A row of them
    can make a key of this one computable, and its deletion also deletes dependent rows."""
    found = tables()
    name = next(n for n, cls in found.items() if cls is table)
    parts = [n for n in found if n == name or n.startswith(f"{name}.")]
    wanted = {found[".".join(target.split(".")[:2])] for n in parts for target in references(n, found[n])} - {table}
    return [t for t in computed_tables() if t in wanted]


@functools.cache
def followers(table: Any) -> tuple[Any, ...]:
    """The computed tables that need this one."""
    return tuple(t for t in computed_tables() if table in needs(t))
