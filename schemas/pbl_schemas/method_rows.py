"""Method rows: one frozen method each, never edited.

A method table states its `stage` (`pbl_pipeline.methods.STAGES`); its columns carry a prefix, that of its key.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from typing import Any

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError
from pbl_pipeline.records import column, definition, from_row, record, to_row

from .datajoint_setup import dj
from .rows import one


@record
class _Row:
    name: str = column("{}_method_name", "name without the version", "varchar(40)")
    version: int = column("{}_method_version", "counts up when parameters change", "int16")
    params: dict = column("{}_params", "every parameter", "json")
    sha: str = column("{}_method_sha", "hash over stage, name, version and parameters", "char(16)")


def method_columns(prefix: str) -> str:
    """Definition of a method table: one frozen paramset per row, `<name>-v<version>` as its readable short key."""
    return f"""
    {prefix}_method : varchar(48)  # name and version, such as demo-v1
    ---
    {definition(_Row, prefix)}
    unique index ({prefix}_method_sha)
    """


def method_table(name: str, stage: str, prefix: str, about: str) -> Any:
    """Return the lookup table of the methods of a stage. `about`: what their frozen parameters are of."""
    text = f"# frozen parameters of {about}{method_columns(prefix)}"
    return type(dj.Lookup)(name, (dj.Lookup,), {"definition": text, "stage": stage})


def insert_methods(table: Any, found: Iterable[methods.Method[Any]]) -> None:
    """Insert the methods that the table lacks. A row is never edited. Raises `PblError` FILE_FORMAT when code holds
    other parameters under a name and version that the table already knows."""
    prefix = _prefix(table)
    for method in found:
        own = _Row(method.name, method.version, dict(method.paramset.params), method.hash)
        row = {f"{prefix}_method": method.key, **to_row(own, prefix)}
        known = (table & {f"{prefix}_method": method.key}).proj(f"{prefix}_method_sha").to_dicts()
        if not known:
            table.insert1(row, skip_duplicates=True)
        elif known[0][f"{prefix}_method_sha"] != method.hash:
            raise PblError(
                "FILE_FORMAT",
                found=f"other parameters under the name {method.key} than the database holds",
                expected="a method that never changes once it has a name and version",
                next_step="register the changed parameters under a new version (docs/extending.md)",
                key=table.full_table_name,
            )


def resolve_method(table: Any, name: str) -> str:
    """Return the key of a method: a row by key (`demo-v1`) or name (`demo`: its newest version), or what this machine
    offers under that name, such as a registered model. That becomes a row on first use; other parameters (another graph
    or `model.json`) under the same name become its next version.

    Raises `PblError` SOLVER_UNKNOWN; for a registered model MODEL_INVALID, MARKER_SET_UNKNOWN.
    """
    offered = methods.of_stage(table.stage).offered(name)
    return stored_keys(table, name)[0] if offered is None else register(table, offered)[0]


def stored_keys(table: Any, name: str) -> list[str]:
    """Return the keys of the rows with this key or name, the newest version first. Raises `PblError` SOLVER_UNKNOWN if
    there is none."""
    prefix = _prefix(table)
    rows = table.proj(f"{prefix}_method_name", f"{prefix}_method_version").to_dicts(
        order_by=[f"{prefix}_method_version DESC", f"{prefix}_method"]
    )
    if found := [r[f"{prefix}_method"] for r in rows if name in (r[f"{prefix}_method"], r[f"{prefix}_method_name"])]:
        return found
    raise PblError(
        "SOLVER_UNKNOWN", found=f"no {prefix} method {name!r}", **one_of({r[f"{prefix}_method_name"] for r in rows})
    )


def one_of(names: Collection[str], list_of_them: str = "pbl list methods") -> dict[str, str]:
    """`expected` and `next_step` of an error for an unknown name, where these are known."""
    if not names:
        return {
            "expected": "the methods and norms of this version, of which the tables have none",
            "next_step": "`pbl db init`, with an account that may insert",
        }
    return {
        "expected": "one of " + ", ".join(sorted(names)),
        "next_step": f"choose one of the names above (`{list_of_them}`)",
    }


def register(table: Any, offered: methods.Method[Any]) -> tuple[str, bool]:
    """Key of the row with these parameters under this name, and whether it is new: then as the name's next version.
    Raises what `insert_methods` raises."""
    prefix, stage = _prefix(table), methods.of_stage(table.stage)
    rows = (table & {f"{prefix}_method_name": offered.name}).to_dicts(order_by=f"{prefix}_method_version")
    versions = [row[f"{prefix}_method_version"] for row in rows]
    for version in versions:
        known = stage.make(offered.name, version, offered.params)
        if table & {f"{prefix}_method_sha": known.hash}:
            return known.key, False
    new = stage.make(offered.name, max(versions, default=0) + 1, offered.params)
    insert_methods(table, [new])
    return new.key, True


def method_row(table: Any, key: Mapping[str, Any]) -> dict[str, Any]:
    """The method row of a key as the arguments of `methods.stored`: what `make_fetch` hands on."""
    prefix = _prefix(table)
    row = one(table & {f"{prefix}_method": key[f"{prefix}_method"]})
    return {"stage": table.stage, **vars(from_row(_Row, row, prefix))}


def _prefix(table: Any) -> str:
    return table.primary_key[0].removesuffix("_method")
