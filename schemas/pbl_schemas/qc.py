"""Quality checks of a visit in one place; the worst outcome wins."""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Sequence
from typing import Any

from pbl_pipeline.names import shortened
from pbl_pipeline.qc import OUTCOME_TYPE
from pbl_pipeline.qc import Check as Quality
from pbl_pipeline.records import from_row

from . import fit, gait, gdi, keypoints, session  # noqa: F401  a definition refers to session
from .datajoint_setup import dj
from .origin import Origin, computes, origin_columns
from .rows import one

schema = dj.Schema()

#: Stage and part table that holds its checks.
SOURCES = (
    ("keypoints", keypoints.Keypoints.Check),
    ("fit", fit.SessionFit.Check),
    ("gait", gait.GaitEvents.Check),
    ("gdi", gdi.SessionGdi.Check),
)

#: Columns of `SessionQc.Check` with the values of a check.
COLUMNS = ("qc_check", "qc_check_outcome", "qc_value", "qc_threshold", "qc_advice")


@schema
class SessionQc(dj.Computed):
    definition = f"""
    # worst outcome of all checks of a visit; a recording without gait beside others with gait counts as WARN
    -> gdi.SessionGdi
    ---
    -> session.Session
    qc_outcome : {OUTCOME_TYPE}
    qc_n       : int16                         # how many checks
    qc_worst   : varchar(1000)                 # names of the checks with that outcome, empty for PASS
    {origin_columns("qc")}
    """

    class Check(dj.Part):
        definition = f"""
        -> master
        qc_no             : int16              # from 1, in the order of the chain
        ---
        qc_stage          : varchar(16)        # part of the chain
        qc_video_id=null  : int32              # trial it is about, null for the session
        qc_check          : varchar(64)        # name, with its unit
        qc_check_outcome  : {OUTCOME_TYPE}
        qc_value=null     : float64            # in the unit (see qc_check)
        qc_threshold=null : float64            # in the unit (see qc_check)
        qc_advice         : varchar(1000)      # what to do about it
        """

    def make_fetch(self, key: dict) -> tuple:
        found = []
        corrected = (gait.GaitCycle & key & "correction_no IS NOT NULL").keys()
        for stage, table in SOURCES:
            of_set: Any = key
            if table is keypoints.Keypoints.Check:  # keypoints are the members of a set
                names = keypoints.Keypoints.primary_key
                of_set = [{k: row[k] for k in names} for row in (fit.FitSet.Video & key).to_dicts()]
            rows = (table & of_set) - (corrected if table is gait.GaitEvents.Check else [])
            checks = [
                (row.get("video_id"), from_row(Quality, row, table.prefix)) for row in rows.to_dicts(order_by="KEY")
            ]
            if table is gait.GaitEvents.Check:
                checks += [(k["video_id"], c) for k in corrected for c in gait.load_events(k).qc]
            for video_id, check in checks:
                values = dict(zip(COLUMNS, dataclasses.astuple(check), strict=True))
                found.append({"qc_stage": stage, "qc_video_id": video_id, **values})
        used = {int(v) for v in (gait.GaitCycle & key & "n_cycles_used > 0").to_arrays("video_id")}
        return found, one(gdi.SessionGdi & key, "session_status"), used

    @computes
    def make_compute(
        self, key: dict, rows: Sequence[dict[str, Any]], session_status: str, used: Collection[int]
    ) -> tuple[str, list[str], Sequence[dict[str, Any]]]:
        from pbl_pipeline import qc

        counts = [r["qc_video_id"] is None or r["qc_video_id"] in used for r in rows]
        measured = session_status == qc.PASS
        outcomes = [qc.in_session(r["qc_check_outcome"], measured, c) for r, c in zip(rows, counts, strict=True)]
        outcome = max(outcomes, key=qc.OUTCOMES.index, default=qc.PASS)
        named = [r["qc_check"] for r, o in zip(rows, outcomes, strict=True) if o == outcome != qc.PASS]
        return outcome, named, rows

    def make_insert(
        self, key: dict, outcome: str, named: Sequence[str], rows: Sequence[dict[str, Any]], origin: Origin
    ) -> None:
        row = {"qc_outcome": outcome, "qc_n": len(rows), "qc_worst": shortened(", ".join(dict.fromkeys(named)), 1000)}
        self.insert1({**fit.of_session(key), **row, **origin.row("qc")})
        self.Check.insert({**key, "qc_no": i, **row} for i, row in enumerate(rows, 1))
