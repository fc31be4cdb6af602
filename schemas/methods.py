"""The method, body and norm rows of this version of the code."""

from __future__ import annotations

from pbl_pipeline import methods

from . import fit, gait, gdi, keypoints, study, tracking
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
)


def insert_all() -> None:
    """Insert what the lookup tables lack; nothing is ever edited. Loads the numerical libraries."""
    from pbl_pipeline.gait import norm_names

    for table in METHOD_TABLES:
        insert_methods(table, methods.of_stage(table.stage).values())
    # DataJoint compares only the numbers of rows: a laboratory's own instruments would hide those that are new here.
    study.ClinicalInstrument.insert(INSTRUMENTS, skip_duplicates=True)
    _body()
    for name in norm_names():
        _norm(name)


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
