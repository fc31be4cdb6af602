"""Candidates for the measured person of a video. `review_decisions.decide_person` records the choice."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

from pbl_pipeline.errors import PblError

from .. import tracking, video
from ..method_rows import stored_keys
from ..reading.objects import load_tracking
from ..stored_files import file_ref, stored_file


@dataclasses.dataclass(frozen=True)
class Candidates:
    """One tracked video: the persons with their scores, best first, and the current decision.

    status "TRACKED" stands for a choice that is not computed yet; `chosen` is then the person of a decision that waits
    to be computed. `key` is that of the tracking.
    """

    key: dict[str, Any]
    name: str
    status: str
    chosen: int | None
    reason: str
    scores: dict[int, float | None]


def candidates(video_id: int, tracking_method: str | None = None) -> list[Candidates]:
    """Return the people who can be chosen in a video, once for each tracking method (or for one of them). Raises
    `PblError` DB_NOT_FOUND for a video that is not registered or not tracked yet, SOLVER_UNKNOWN."""
    key, name = _key(video_id, tracking_method), video.registered_video(video_id)["video_name"]
    out, found = [], (tracking.Tracking & key).keys()
    for tracked in found:
        persons = sorted(int(p) for p in (tracking.Tracking.Person & tracked).to_arrays("person_id"))
        status, reason, scores = "TRACKED", "", {}
        if rows := (tracking.SubjectChoice & tracked).to_dicts():
            status, reason, chosen = (rows[0][k] for k in ("choice_status", "choice_reason", "chosen_person_id"))
            scores = {int(k): v for k, v in rows[0]["choice_scores"].items()}
        else:
            chosen = next(iter((tracking.SubjectOverride & tracked).to_arrays("override_person_id")), None)
        ranked = sorted(persons, key=lambda p: -(scores.get(p) or 0.0))
        out.append(
            Candidates(
                key=dict(tracked),
                name=name,
                status=status,
                chosen=None if chosen is None else int(chosen),
                reason=reason,
                scores={p: scores.get(p) for p in ranked},
            )
        )
    if not out:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"video_id {video_id} is not tracked yet",
            expected="a video in which people were searched",
            next_step="`pbl populate`; `pbl status` says what failed",
        )
    return out


def write_sheet(about: Candidates, out_path: Path) -> Path:
    """Write the picture of the people of a video, boxed and numbered, as JPEG, or as PNG where `out_path` says so.

    The stored picture of an open choice is copied (JPEG only); otherwise it is drawn from the video.

    Raises `PblError` TRACK_NO_PERSON, FILE_UNWRITABLE, FILE_FORMAT (the stored picture is lost), VIDEO_MISSING,
    VIDEO_CHANGED.
    """
    from pbl_pipeline.tracking import FILM_THE_WHOLE_BODY, save_contact_sheet

    if not about.scores:
        raise PblError(
            "TRACK_NO_PERSON",
            found="no one in the video",
            expected="at least one person",
            next_step=FILM_THE_WHOLE_BODY,
            key=about.name,
        )
    stored = [s for s in (tracking.SubjectChoice & about.key).to_arrays("contact_sheet") if s is not None]
    try:
        if stored and out_path.suffix.lower() != ".png":
            with stored_file(file_ref(stored[0])) as path:
                shutil.copyfile(path, out_path)
            return out_path
        path, sha256 = (video.Video & about.key).fetch1("video_path", "video_sha256")
        file = video.registered_file(path, sha256, about.key)
        tracks = load_tracking(about.key)
        return save_contact_sheet(file, tracks, out_path, list(about.scores))
    except OSError as error:
        raise PblError(
            "FILE_UNWRITABLE",
            found=str(error),
            expected="a picture file that can be written",
            next_step="pass another path to --sheet",
            key=str(out_path),
        ) from error


def _key(video_id: int, tracking_method: str | None) -> dict[str, Any]:
    """Restriction to a registered video and, where named, one tracking method."""
    video.registered_video(video_id)  # raises for an unknown one
    key: dict[str, Any] = {"video_id": video_id}
    if tracking_method is not None:
        key["tracking_method"] = stored_keys(tracking.TrackingMethod, tracking_method)[0]
    return key


def selection_of(video_id: int, tracking_method: str | None = None) -> dict[str, Any]:
    """Return the key of the only TrackingSelection that matches. Raises `PblError` DB_NOT_FOUND for a video that is not
    registered, SOLVER_UNKNOWN; USAGE where several methods track the video and none is named, or another one."""
    selections = (tracking.TrackingSelection & _key(video_id, tracking_method)).keys()
    if len(selections) == 1:
        return dict(selections[0])
    # Each tracking method numbers the people separately: a number is ambiguous.
    there = sorted((tracking.TrackingSelection & {"video_id": video_id}).to_arrays("tracking_method"))
    raise PblError(
        "USAGE",
        found=f"video_id {video_id} is tracked by {len(there)} methods"
        + (f", not by {tracking_method}" if tracking_method else ", each with its own numbers"),
        expected=f"one of {', '.join(there)}" if there else "a video that is to be tracked",
        next_step=f"`pbl choose {video_id}` shows the numbers; pass --tracking-method with one of these",
        key=f"video_id={video_id}",
    )
