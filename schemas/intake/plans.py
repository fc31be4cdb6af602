"""Methods of new recordings: the defaults, and the selections and plans that they are entered into."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from pbl_pipeline.methods import of_stage

from .. import fit, gait, gdi, keypoints, kinetics, tracking, video
from ..datajoint_setup import dj
from ..method_rows import resolve_method
from ..plan import default_fit
from .records import Methods

#: Key of a selection or plan -> field of `Methods` that names it.
METHOD_FIELDS = {
    "tracking_method": "tracking",
    "keypoint_method": "keypoint",
    "fit_method": "fit",
    "gait_method": "gait",
    "gdi_method": "gdi",
    "norm": "norm",
    "kinetics_method": "kinetics",
}
#: Method of the fit that markers get where none is named (`pbl_pipeline.fit.default_fit`).
DEFAULT_MARKER_FIT = "markers"


def named_keys(methods: Methods) -> set[str]:
    """Keys of the selections and plans whose methods are named."""
    return {key for key, field in METHOD_FIELDS.items() if getattr(methods, field) is not None}


def resolve(named: Methods, markers: bool = False) -> dict[str, str]:
    """Keys of the method rows of a video, or of laboratory markers; defaults filled in.

    Raises `PblError` SOLVER_UNKNOWN, NORM_UNKNOWN.
    """

    def key(table: Any, name: str | None) -> str:
        return resolve_method(table, name or of_stage(table.stage).default)

    after_fit = {
        "gait_method": key(gait.GaitEventMethod, named.gait),
        **gdi.resolve(named.gdi, named.norm),
        "kinetics_method": key(kinetics.KineticsMethod, named.kinetics),
    }
    if markers:
        return {"fit_method": resolve_method(fit.FitMethod, named.fit or DEFAULT_MARKER_FIT), **after_fit}
    points = key(keypoints.KeypointMethod, named.keypoint)
    return {
        "tracking_method": key(tracking.TrackingMethod, named.tracking),
        "subject_method": key(tracking.SubjectMethod, named.subject),
        "keypoint_method": points,
        "fit_method": resolve_method(fit.FitMethod, named.fit) if named.fit else default_fit(points),
        **after_fit,
    }


def plan_all(videos: Sequence[int], sessions: Collection[int], chosen: Mapping[str, str]) -> None:
    """Enter new recordings into the selections and plans of all their methods (keys, from `resolve`)."""
    for table, rows in _selections(videos, sessions, chosen, set(METHOD_FIELDS)):
        table.insert(rows, skip_duplicates=True)  # the session may have its plans already


def plan_named(video_id: int, session_id: int, chosen: Mapping[str, str], named: Collection[str]) -> list[str]:
    """Enter a registered recording into those of the methods whose keys are `named`; returns what is new, in words."""
    added = []
    for table, rows in _selections([video_id], [session_id], chosen, set(named)):
        for values in rows:
            key = {k: v for k, v in values.items() if k in table.primary_key}
            if not table & key:
                table.insert1(values)
                names = [str(v) for k, v in key.items() if k not in ("video_id", "session_id")]
                added.append(f"{table.__name__} {', '.join(names)} was added")
    return added


def _selections(
    videos: Sequence[int], sessions: Collection[int], chosen: Mapping[str, str], named: set[str]
) -> Iterable[tuple[Any, list[dict[str, Any]]]]:
    """(table, rows) that recordings and their sessions need for the methods `named`; without a tracking method in
    `chosen` the recordings are laboratory markers."""
    if "tracking_method" in chosen:
        yield from _of_videos(videos, sessions, chosen, named)
    elif "fit_method" in named:
        yield fit.MarkerPlan, [{"video_id": v, "fit_method": chosen["fit_method"]} for v in videos]
    for table in (gait.GaitPlan, gdi.GdiPlan, kinetics.KineticsPlan):
        keys = [k for k in table.primary_key if k != "session_id"]
        if named & set(keys):
            yield table, [{"session_id": s, **{k: chosen[k] for k in keys}} for s in sessions]


def _of_videos(
    videos: Sequence[int], sessions: Collection[int], chosen: Mapping[str, str], named: set[str]
) -> Iterable[tuple[Any, list[dict[str, Any]]]]:
    """Keypoints are selected for the tracking that is selected with them, or else for every tracking of the videos."""
    points = {"keypoint_method": chosen["keypoint_method"]}
    trackings: list[Any] = [{"video_id": v, "tracking_method": chosen["tracking_method"]} for v in videos]
    if "tracking_method" in named:
        subject = {"subject_method": chosen["subject_method"]}
        yield tracking.TrackingSelection, [{**t, **subject} for t in trackings]
    elif "keypoint_method" in named:
        trackings = (tracking.TrackingSelection & [{"video_id": v} for v in videos]).keys()
    if named & {"tracking_method", "keypoint_method"}:
        yield keypoints.KeypointSelection, [{**t, **points} for t in trackings]
    if named & {"keypoint_method", "fit_method"}:
        yield (
            fit.FitPlan,
            [
                {"session_id": s, "fit_method": chosen["fit_method"], "keypoint_method": method}
                for s in sessions
                for method in (points.values() if "keypoint_method" in named else _keypoint_methods(s))
            ],
        )


def _keypoint_methods(session_id: int) -> list[str]:
    selected = keypoints.KeypointSelection & (video.Video & {"session_id": session_id})
    return sorted((dj.U("keypoint_method") & selected).to_arrays("keypoint_method"))
