"""The method, body and norm rows of this version of the code."""

from __future__ import annotations

from pbl_pipeline import methods
from pbl_pipeline.errors import suppress_codes

from . import connection, fit, gait, gdi, keypoints, kinetics, study, tracking
from .instruments import INSTRUMENTS
from .method_rows import insert_methods

#: Every table of methods, in the order of the chain.
METHOD_TABLES = (
    tracking.TrackingMethod,
    tracking.SubjectMethod,
    keypoints.KeypointMethod,
    fit.FitMethod,
    gait.GaitEventMethod,
    gdi.GdiModel,
    kinetics.KineticsMethod,
)

#: Prefixes under which this process has inserted the rows of this version.
_done: set[str] = set()


def insert_once() -> None:
    """`insert_all`, once in a process."""
    if connection.prefix() not in _done:
        insert_all()
        _done.add(connection.prefix())


def insert_if_none() -> None:
    """`insert_once` if a table has no row, which one query finds out; else the missing instruments. Nothing if the
    account may not insert."""
    tables = (*METHOD_TABLES, fit.BodyModel, gdi.NormativeSet)
    filled = " AND ".join(f"EXISTS (SELECT 1 FROM {table.full_table_name})" for table in tables)  # noqa: S608
    if connection.connect().query(f"SELECT {filled}").fetchone()[0]:
        add_instruments()
        return
    with suppress_codes("DB_REFUSED"):
        insert_once()


def insert_all() -> None:
    """Insert what the lookup tables lack; nothing is ever edited. Loads the numerical libraries."""
    from pbl_pipeline.gait import norm_names

    for table in METHOD_TABLES:
        insert_methods(table, methods.of_stage(table.stage).values())
    add_instruments()
    _body()
    for name in norm_names():
        _norm(name)


def add_instruments() -> None:
    """Insert the missing clinical instruments that ship, if the account may.

    They are not the table's `contents`: DataJoint would insert these while it binds tables of an older version, before
    they are migrated, and compares only the numbers of rows, so that a laboratory's own would hide new ones.
    """
    there = set(study.ClinicalInstrument().to_arrays("instrument"))
    if lacking := [row for row in INSTRUMENTS if row["instrument"] not in there]:
        with suppress_codes("DB_REFUSED"):
            study.ClinicalInstrument.insert(lacking, skip_duplicates=True)


def _body() -> None:
    from pbl_pipeline.body import SCALE_NAMES, load_body

    body = load_body()
    row = {
        "body_model": f"{body.name}-{body.version}",
        "body_name": body.name,
        "body_version": body.version,
        "body_sha256": body.sha256,
        "joint_names": list(body.joint_names),
        "scale_names": list(SCALE_NAMES),
    }
    if not fit.BodyModel & {"body_sha256": body.sha256}:
        fit.BodyModel.insert1(row, skip_duplicates=True)


def _norm(name: str) -> None:
    from pbl_pipeline.gait import load_norm

    norm = load_norm(name)
    if gdi.NormativeSet & {"norm_sha256": norm.sha256}:
        return
    gdi.NormativeSet.insert1(gdi.norm_row(norm), skip_duplicates=True)
