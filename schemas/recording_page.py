"""What the tables say of one recording, for people to look at: facts and events at once, the fit's files when asked."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from pbl_pipeline.errors import PblError

from . import fit, gait, keypoints, session, video
from .fit import trial_key
from .reading.objects import load_keypoints, load_trial_fit
from .video import unknown_video
from .why import why

if TYPE_CHECKING:
    from pbl_pipeline import gait as lib
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.keypoints import Keypoints


@dataclasses.dataclass(frozen=True)
class RecordingPage:
    """A recording.

    width, height (px), duration (s), n_frames: of the upright video, None before it is probed or without pictures.
    key: of the row of SessionFit.Trial that is shown, None where nothing is fitted; `problem` says why. lead: the
    recording with the fit, where several cameras filmed the trial and this is another of them. hidden_heads: how they
    are hidden in what is shown, empty for the original.
    """

    video_id: int
    name: str
    session_id: int
    subject: str
    label: str
    codec: str
    width: int | None
    height: int | None
    duration: float | None
    n_frames: int | None
    has_pictures: bool
    hidden_heads: str
    key: dict[str, Any] | None
    problem: str
    lead: int | None
    events: tuple[lib.GaitEvent, ...]


@dataclasses.dataclass(frozen=True)
class RecordingFit:
    """The fitted movement of a recording, its events and cycles, and the points it was fitted to (None: markers)."""

    fit: TrialFit
    events: tuple[lib.GaitEvent, ...]
    cycles: tuple[lib.GaitCycle, ...]
    keypoints: Keypoints | None


def recording_about(video_id: int) -> RecordingPage:
    """A recording by its number, without opening a file. Raises `PblError` DB_NOT_FOUND for a number that none has."""
    from pbl_pipeline import settings

    named = video.Video * session.Session.proj("subject", "session_label") & {"video_id": video_id}
    rows = named.to_dicts()
    if not rows:
        raise unknown_video(video_id)
    row = rows[0]
    columns = ("codec", "width", "height", "duration", "n_frames")
    probed = (video.VideoInfo & {"video_id": video_id}).proj(*columns).to_dicts()
    info: dict[str, Any] = probed[0] if probed else dict.fromkeys(columns)
    lead = fit.trial_of(video_id)
    key = trial_key(video_id)
    has_pictures = row["camera_motion"] != video.NO_CAMERA
    return RecordingPage(
        video_id=video_id,
        name=row["video_name"],
        session_id=int(row["session_id"]),
        subject=row["subject"],
        label=row["session_label"],
        codec=str(info["codec"] or ""),
        width=None if info["width"] is None else int(info["width"]),
        height=None if info["height"] is None else int(info["height"]),
        duration=None if info["duration"] is None else float(info["duration"]),
        n_frames=None if info["n_frames"] is None else int(info["n_frames"]),
        has_pictures=has_pictures,
        hidden_heads=settings.deidentify_how() if has_pictures else "",
        key=key,
        problem="" if key else why(video_id).verdict,
        lead=lead if lead != video_id else None,
        events=_events(key) if key else (),
    )


def fitted_key(video_id: int) -> dict[str, Any]:
    """`trial_key` of a recording that has a fit. Raises `PblError` DB_NOT_FOUND for one that has none, or none now."""
    key = trial_key(video_id)
    if key is None:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no fit of video_id {video_id}: {recording_about(video_id).problem}",
            expected="a recording to which a body is fitted",
            next_step="`pbl populate`; `pbl why` says what stops it",
        )
    return key


def computed(key: dict[str, Any]) -> tuple[Any, ...]:
    """What tells the computations apart that a recording's fit of `trial_key` and its newest events come from."""
    fitted = (fit.SessionFit & key).to_arrays("fit_computed")
    found = gait.newest_events(key)
    events = () if found is None else (gait.GaitEvents & found).to_arrays("events_computed")
    correction = None if found is None else gait.correction_of(found)
    return (*key.values(), *map(str, fitted), *(found or {}).values(), *map(str, (*events, correction)))


def recording_fit(key: dict[str, Any]) -> RecordingFit:
    """The files of the fit of `trial_key`. Raises `PblError` FILE_FORMAT where one is lost or damaged."""
    trial = load_trial_fit(key)
    members = (fit.FitSet.Video & key).to_dicts()
    points = None
    if members and members[0]["keypoint_method"]:
        points = load_keypoints({k: members[0][k] for k in keypoints.Keypoints.primary_key})
    found = gait.newest_events(key)
    cycles = () if found is None else tuple(
        gait.cycle_of_row(r, trial.name) for r in (gait.GaitCycle.Cycle & found).to_dicts(order_by="cycle_no")
    )  # fmt: skip
    return RecordingFit(trial, _events(key), cycles, points)


def _events(key: dict[str, Any]) -> tuple[lib.GaitEvent, ...]:
    """The events that count: corrected ones at once, before anything is computed from them."""
    found = gait.newest_events(key)
    if found is None:
        return ()
    return gait.events_of((gait.GaitEvents & found).fetch1(), gait.correction_of(found)).events
