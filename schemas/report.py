"""Results of a visit from the tables as files for people: report, overlay, angles (what `pbl run` writes)."""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Any

from . import fit, privacy, video
from .results import load_session, not_finished
from .rows import Rows, stored_rows

if TYPE_CHECKING:
    from pbl_pipeline.pipeline import Session


@dataclasses.dataclass(frozen=True)
class Loaded:
    """A visit as `pbl_pipeline.pipeline.write_results` and `write_session_report` take it; `words`: what its report
    says of it (title, subject_code, date, origin)."""

    session: Session
    words: dict[str, Any]


def write_session(restriction: Any, out: Path) -> list[Path]:
    """Write the files of `pbl_pipeline.pipeline.write_results` for one session; nothing is computed anew.

    Raises
    ------
    PblError
        What `load_session_files` raises; VIDEO_MISSING when a recording is no longer where it was.
    """
    # The library's drawing half is heavy; commands that only look at rows do not pay for it.
    from pbl_pipeline.pipeline import write_results

    with contextlib.ExitStack() as open_files:
        loaded = load_session_files(restriction, open_files)
        return write_results(out, loaded.session, **loaded.words)


def load_session_files(restriction: Any, open_files: contextlib.ExitStack) -> Loaded:
    """Everything that a report of one session is written from. Only this half reads tables.

    Parameters
    ----------
    restriction
        As `results.load_session` takes it.
    open_files
        Holds the de-identified copies that are shown, where PBL_DEIDENTIFY is set: close it when all is written.

    Raises
    ------
    PblError
        DB_NOT_FOUND when the session is unknown or not fitted yet, USAGE when several match. Where PBL_DEIDENTIFY is
        set: DB_NOT_FOUND without a de-identified copy, HEAD_NOT_FOUND where nothing was covered in it.
    """
    from pbl_pipeline.pipeline import Session, Trial

    found = load_session(restriction)
    if found.fit is None or found.metrics is None:
        raise not_finished(found, "fit and measures")
    trials = tuple(
        Trial(t.name, t.path, t.info, t.choice, t.keypoints, open_files.enter_context(privacy.shown(t.video_id)))
        for t in found.fitted
    )
    left_out = {t.name: t.problem for t in found.trials if t.fit is None}
    words = {
        "title": "Gait report",
        "subject_code": found.subject,
        "date": str(found.session_date or found.session_label),
        "origin": {"Methods": methods_of(found.key)},
    }
    return Loaded(Session(trials, found.fit, found.metrics, left_out=left_out), words)


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
