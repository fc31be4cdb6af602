"""Results of a visit from the tables as files for people: report, overlay, angles (what `pbl run` writes)."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from . import fit, privacy, video
from .results import load_session, not_finished
from .rows import Rows, stored_rows


def write_session(restriction: Any, out: Path) -> list[Path]:
    """Write the files of `pbl_pipeline.pipeline.write_results` for one session; nothing is computed anew.

    Raises
    ------
    PblError
        DB_NOT_FOUND when the session is unknown or not fitted yet, USAGE when several match, VIDEO_MISSING when a
        recording is no longer where it was. Where PBL_DEIDENTIFY is set: DB_NOT_FOUND without a de-identified copy,
        HEAD_NOT_FOUND where nothing was covered in it.
    """
    # The library's drawing half is heavy; commands that only look at rows do not pay for it.
    from pbl_pipeline.pipeline import Session, Trial, write_results

    found = load_session(restriction)
    if found.fit is None or found.metrics is None:
        raise not_finished(found, "fit and measures")
    with contextlib.ExitStack() as open_files:
        trials = tuple(
            Trial(t.name, t.path, t.info, t.choice, t.keypoints, open_files.enter_context(privacy.shown(t.video_id)))
            for t in found.fitted
        )
        left_out = {t.name: t.problem for t in found.trials if t.fit is None}
        return write_results(
            out,
            Session(trials, found.fit, found.metrics, left_out=left_out),
            title="Gait report",
            subject_code=found.subject,
            date=str(found.session_date or found.session_label),
            origin={"Methods": methods_of(found.key)},
        )


def methods_of(key: Any, rows: Rows = stored_rows) -> dict[str, str]:
    """Name and version of the method behind each stage, of a key of `SessionResults`; of those that it names. Of
    several cameras also their names."""
    members = rows(fit.FitSet.Video, {"fit_set": key["fit_set"]})
    member = members[0]
    cameras = sorted({r["rig_camera"] for m in members for r in rows(video.RigView, {"video_id": m["video_id"]})})
    before = {"Tracking": member["tracking_method"], "Keypoints": member["keypoint_method"]}
    found = {stage: method or fit.LABORATORY for stage, method in before.items()} | {"Fit": key["fit_method"]}
    if cameras:
        found = {"Cameras": ", ".join(cameras), **found}
    if "gdi_method" in key:
        found |= {"Gait events": key["gait_method"], "Index": f"{key['gdi_method']}, norm {key['norm']}"}
    return found
