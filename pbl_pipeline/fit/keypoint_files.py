"""2D keypoints of another program as a trial: the person to measure, times, picture, camera, and the marker set."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pbl_pipeline.body import MarkerSet, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import SEEN_SHARE, Keypoints
from pbl_pipeline.keypoints.pose_files import Poses, read_poses
from pbl_pipeline.keypoints.types import box_of_points
from pbl_pipeline.video import check_timing, find_camera, guess_camera, load_camera, probe

from .params import ViewParams
from .world_checks import check_picture

#: Sets that a file's names may choose without --marker-set, if they name at least `SEEN_SHARE` of it: of detectors.
_DETECTORS = ("halpe_26", "body25b", "blazepose_33", "bml_movi_87", "mpi_inf_3dhp_17")
#: Largest relative difference between the file's rate and the stated one: programs round 29.97 to 30.
_SAME_RATE = 0.05
#: Keypoints of a smaller copy of the picture lie within this fraction of its width and height.
_UPPER_LEFT = 2 / 3
_usage = functools.partial(PblError, "USAGE")


@dataclasses.dataclass(frozen=True)
class RecordingFacts:
    """Properties of a recording that files of 2D keypoints lack: a video, or rate and size of its upright picture."""

    video: Path | None = None
    rate_hz: float | None = None
    size_px: tuple[int, int] | None = None  # width, height
    camera: Path | None = None  # calibration; None: the video's, else a phone's (`guess_camera`)
    person: str | None = None  # name of the person to measure


def read_keypoints(path: Path, recording: RecordingFacts, table: MarkerSet | None = None) -> tuple[Keypoints, str]:
    """Return the keypoints of one person, in the order of a marker set, and a line on what was read.

    `table` says where the points sit on the body; None: the detectors' set that has most of the file's names. Points
    beyond the picture count as not seen. There are no 3D points.

    Raises `PblError` USAGE: no rate or size, or several people and none chosen. FIT_INPUT: a picture or times that
    contradict the body or the video (`check_picture`). MARKER_SET_UNKNOWN; CAMERA_INVALID; as `read_poses` and `probe`.
    """
    info = probe(recording.video) if recording.video else None
    size = (info.width_px, info.height_px) if info else recording.size_px
    rate = info.fps if info else recording.rate_hz
    poses = read_poses(path, rate or 30.0, table)
    if size is None or (info and (recording.size_px or recording.rate_hz)):
        raise _usage(
            "a video together with a rate or a size" if size else "no size of the picture",
            "--video, or --width and --height (and --fps)",
            f"pass the video of {path.name}, or its rate and size",
            key=str(path),
        )
    stated = poses.rate_hz if np.isfinite(poses.rate_hz) else None
    if (rate or stated) is None or (stated and rate and abs(rate / stated - 1) > _SAME_RATE):
        found = f"{rate:g} frames a second, {stated:g} in the file" if rate and stated else "no frame rate"
        raise _usage(found, "the rate of the recording", "pass --fps or --video", key=str(path))
    if info and poses.frame[-1] >= info.n_frames:
        found = f"frames {poses.frame[0]} to {poses.frame[-1]}, {Path(info.path).name} has {info.n_frames}"
        raise PblError(
            "FIT_INPUT", found, "keypoints of this video", "pass the video they were found in", key=str(path)
        )
    time_s = info.time_s[poses.frame] if info else poses.frame / (rate or stated)
    chosen = _person(path, poses, recording.person, rate or stated or 30.0)
    markers, column = _points(path, poses.names, table)
    order = [column.get(name, -1) for name in markers.names]
    xy, confidence = poses.xy_px[chosen][:, order], poses.confidence[chosen][:, order]
    confidence = np.where(np.array(order) < 0, 0.0, confidence)
    file = recording.camera
    camera = find_camera(info, file) if info else load_camera(file, size) if file else guess_camera(size)
    trial = Keypoints(
        time_s=time_s,
        names=markers.names,
        marker_set=markers.name,
        xy_px=np.where((confidence > 0)[..., None], xy, np.nan),
        xyz_cam_m=np.full((*xy.shape[:2], 3), np.nan),
        root_relative=True,
        confidence=confidence,
        image_size_px=size,
        camera=camera,
        box_px=box_of_points(xy, confidence),
        origin=f"{poses.program}, {path.name}",
    )
    check_picture(trial, path.name, markers)
    inside = np.all((trial.xy_px >= -0.5) & (trial.xy_px <= np.array(size) - 0.5), axis=2)
    trial = dataclasses.replace(
        trial,
        xy_px=np.where(inside[..., None], trial.xy_px, np.nan),
        confidence=np.where(inside, confidence, 0.0),
    )
    absent, unused = set(markers.names) - set(column), set(poses.names) - {poses.names[i] for i in column.values()}
    text = f"{poses.program}, person {poses.people[chosen]}, {len(column)} of {len(markers)} points of {markers.name}"
    for what, names in (("not in the file", absent), ("not in the marker set", unused)):
        text += f"\n  {what}: {', '.join(sorted(names))}" if names else ""
    if (np.nanmax(trial.xy_px, axis=(0, 1)) < _UPPER_LEFT * np.array(size)).all():
        text += f"\n  all points are in the upper left {_UPPER_LEFT:.0%} of the picture: is its size right?"
    for check in check_timing(info) if info else ():
        text += f"\n  {check.outcome} {check.check}: {check.advice}" if check.advice else ""
    return trial, text


def _person(path: Path, poses: Poses, wanted: str | None, rate_hz: float) -> int:
    """Number of the person to measure: the only one who is seen for as long as a fit needs, or the wanted one."""
    seen = np.asarray((poses.confidence > 0).any(axis=2))
    if wanted in poses.people:
        return poses.people.index(wanted)
    step = int(poses.frame[1] - poses.frame[0]) if len(poses.frame) > 1 else 1
    for least_s in (ViewParams().min_in_view_s, step / rate_hz):
        long = np.flatnonzero(seen.sum(axis=1) * step / rate_hz >= least_s)
        if wanted is None and len(long) == 1:
            return int(long[0])
    spans = [poses.frame[s][[0, -1]] if s.any() else None for s in seen]
    listed = [f"{n} (frames {s[0]} to {s[1]})" for n, s in zip(poses.people, spans, strict=True) if s is not None]
    raise _usage(
        f"people {', '.join(listed[:20])}" + f" and {len(listed) - 20} more" * (len(listed) > 20)
        if listed
        else "no person in any frame",
        f"one of them: {wanted!r} is none"
        if wanted
        else f"a single person who is in view for {ViewParams().min_in_view_s:g} s and more",
        "pass --person with the name of one; where a person has several numbers, track the people first",
        key=str(path),
    )


def _points(path: Path, names: Sequence[str], table: MarkerSet | None) -> tuple[MarkerSet, dict[str, int]]:
    """The marker set and the column of each of its points that the file has."""
    fits = [(t, _columns(t, names)) for t in ([table] if table else map(marker_set, _DETECTORS))]
    best, column = max(fits, key=lambda fit: (len(fit[1]), len(fit[1]) == len(fit[0])))
    if len(column) >= SEEN_SHARE * len(best):
        return best, column
    raise PblError(
        "MARKER_SET_UNKNOWN",
        found=f"points {', '.join(names)}: {len(column)} of {len(best)} of {best.name}",
        expected=f"at least {SEEN_SHARE:.0%} of the points of a marker set",
        next_step="pass --marker-set with a table (CSV: name, body, x, y, z) of the file's points; see docs/files.md",
        key=str(path),
    )


def _columns(markers: MarkerSet, names: Sequence[str]) -> dict[str, int]:
    """Column of each point, by its name or the other one that the set knows, without regard to case, - and _."""
    known = {_bare(other): name for other, name in markers.also.items()} | {_bare(n): n for n in markers.names}
    return {known[_bare(name)]: i for i, name in enumerate(names) if _bare(name) in known}


def _bare(name: str) -> str:
    return "".join(c for c in name.casefold() if c.isalnum())
