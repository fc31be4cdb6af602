"""Method rows: one frozen paramset each, never edited."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

from pbl_pipeline import __version__
from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import Paramset

from .rows import one, plain

P = TypeVar("P")


def method_columns(prefix: str) -> str:
    """Definition of a method table: one frozen paramset per row, `<name>-v<version>` as its readable short key."""
    return f"""
    {prefix}_method          : varchar(48)       # name and version, such as demo-v1
    ---
    {prefix}_method_name     : varchar(40)       # name without the version
    {prefix}_method_version  : int16             # counts up when parameters change
    {prefix}_params          : json              # every parameter
    {prefix}_method_sha      : char(16)          # hash over stage, name, version and parameters
    unique index ({prefix}_method_sha)
    """


def method_key(paramset: Paramset) -> str:
    """Short readable key of a paramset: `<name>-v<version>`."""
    return f"{paramset.name}-v{paramset.version}"


def insert_methods(table: Any, prefix: str, paramsets: Mapping[str, Paramset]) -> None:
    """Insert the paramsets that the method table lacks. A row is never edited.

    Raises
    ------
    PblError
        FILE_FORMAT when code holds other parameters under a name and version that the table already knows.
    """
    for paramset in paramsets.values():
        row = {
            f"{prefix}_method": method_key(paramset),
            f"{prefix}_method_name": paramset.name,
            f"{prefix}_method_version": paramset.version,
            f"{prefix}_params": plain(paramset.params),
            f"{prefix}_method_sha": paramset.hash,
        }
        known = (table & {f"{prefix}_method": row[f"{prefix}_method"]}).proj(f"{prefix}_method_sha").to_dicts()
        if not known:
            table.insert1(row, skip_duplicates=True)
        elif known[0][f"{prefix}_method_sha"] != paramset.hash:
            raise PblError(
                "FILE_FORMAT",
                found=f"other parameters under the name {method_key(paramset)} than the database holds",
                expected="a method that never changes once it has a name and version",
                next_step="give the changed parameters a new version in PARAMSETS",
                key=table.full_table_name,
            )


def resolve_method(table: Any, prefix: str, name: str) -> str:
    """Key of a method named by key (`demo-v1`) or by name (`demo`: its newest version). Raises SOLVER_UNKNOWN."""
    # Of one version the shorter key first: a migration may have put an old row aside as `demo-v1-<hash>`.
    rows = table.proj(f"{prefix}_method_name", f"{prefix}_method_version").to_dicts(
        order_by=[f"{prefix}_method_version DESC", f"{prefix}_method"]
    )
    for row in rows:
        if name in (row[f"{prefix}_method"], row[f"{prefix}_method_name"]):
            return row[f"{prefix}_method"]
    raise PblError(
        "SOLVER_UNKNOWN",
        found=f"no {prefix} method {name!r}",
        expected="one of " + ", ".join(sorted({r[f"{prefix}_method_name"] for r in rows})),
        next_step="choose one of the names above",
    )


def method_of_model(table: Any, prefix: str, found: Paramset) -> str:
    """Key of the method of a registered model, which becomes one when it is first asked for. Other parameters (another
    graph or `model.json`) under the same name are its next version."""
    rows = (table & {f"{prefix}_method_name": found.name}).to_dicts(order_by=f"{prefix}_method_version")
    versions = [row[f"{prefix}_method_version"] for row in rows]
    for version in versions:
        known = dataclasses.replace(found, version=version)
        if table & {f"{prefix}_method_sha": known.hash}:
            return method_key(known)
    new = dataclasses.replace(found, version=max(versions, default=0) + 1)
    insert_methods(table, prefix, {new.name: new})
    return method_key(new)


def method_arguments(table: Any, prefix: str, stage: str, method: str) -> dict[str, Any]:
    """A method row as the arguments of `rebuild_params`: what `make_fetch` hands on."""
    row = one(table & {f"{prefix}_method": method})
    return {
        "stage": stage,
        "name": row[f"{prefix}_method_name"],
        "version": row[f"{prefix}_method_version"],
        "params": row[f"{prefix}_params"],
        "sha": row[f"{prefix}_method_sha"],
    }


def stored_paramset(method: Mapping[str, Any]) -> Paramset:
    """The `Paramset` of a method row (`method_arguments`), checked against its hash. Raises SOLVER_UNKNOWN."""
    paramset = Paramset(method["stage"], method["name"], method["version"], method["params"])
    if paramset.hash != method["sha"]:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"method {method_key(paramset)} with hash {method['sha']}, whose parameters hash to {paramset.hash}",
            expected="a method row that nobody edited",
            next_step="restore the method table from the backup",
        )
    return paramset


def rebuild_params(cls: type[P], params: Mapping[str, Any], stage: str, name: str, version: int, sha: str) -> P:
    """The parameter dataclass of a method row, checked against the row's hash.

    Raises
    ------
    PblError
        SOLVER_UNKNOWN when this version of the code no longer has these parameters.
    """
    try:
        value = Paramset(stage, name, version, params).to(cls)
        same = Paramset.of(stage, name, version, value).hash == sha
    except (TypeError, KeyError):
        same, value = False, None
    if not same or value is None:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"method {name}-v{version} with hash {sha}, whose parameters this code does not understand",
            expected=f"parameters of {cls.__name__} of pbl-pipeline {__version__}",
            next_step="use the version of pbl-pipeline that wrote the method, or select a newer method",
        )
    return value
