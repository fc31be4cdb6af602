"""True positions of a person's points in the picture: of a synthetic trial, of calibrated cameras, of marker mocap.

A laboratory's motion capture knows nothing of the phone that filmed beside it. But the person moved, and the phone did
not: thousands of pairs of a place in the room and a pixel say where the phone stood and how long its lens is
(`resect`), and seven numbers cannot follow the errors of thousands of points.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, read_trc
from pbl_pipeline.render import to_pixels
from pbl_pipeline.synthetic import Truth
from pbl_pipeline.validation.sources import load_bodies
from pbl_pipeline.video import Camera, CameraPose, undistort_px

#: Names of shoulders and hips, left and right, in the marker sets: the ends of the trunk.
TRUNK = (
    ("left_shoulder", "right_shoulder", "left_hip", "right_hip"),
    ("LShoulder", "RShoulder", "LHip", "RHip"),
)
#: Points of OpenPose's body models under BlazePose's names, those that mean the same place. (Its foot index lies
#: between the big toe and the second.)
_OPENPOSE = {
    "nose": "Nose",
    **{
        f"{side}_{ours}": f"{side[0].upper()}{theirs}"
        for side in ("left", "right")
        for ours, theirs in {
            "shoulder": "Shoulder",
            "elbow": "Elbow",
            "wrist": "Wrist",
            "hip": "Hip",
            "knee": "Knee",
            "ankle": "Ankle",
            "heel": "Heel",
            "foot_index": "BigToe",
        }.items()
    },
}
#: Lags (s) of a video behind the mocap that are tried, and how robust the resection is (px of a picture whose longer
#: side is `_SOFT_SIDE_PX`).
_LAGS_S = np.arange(-0.15, 0.151, 0.01)
_SOFT_PX, _SOFT_SIDE_PX = 10.0, 1280
_FRAMES = 60
_LEAST_PAIRS = 200


@dataclasses.dataclass(frozen=True)
class PointTruth:
    """True points of one recording by one camera.

    Attributes
    ----------
    xy_px : (T, J, 2)
        Pixels, NaN where not known.
    xyz_cam_m : (T, J, 3)
        Camera frame (x right, y down, z forward).
    trunk_m, trunk_px : (T,)
        Length of the trunk, and that length in the picture at its depth as if seen from the side.
    note
        How it was found, in words.
    """

    xy_px: np.ndarray
    xyz_cam_m: np.ndarray
    trunk_m: np.ndarray
    trunk_px: np.ndarray
    note: str


def truth_of_synthetic(keypoints: Keypoints, truth: Truth) -> PointTruth:
    """Return the truth of a trial of `pbl synth`. Raises `PblError` REFERENCE_INPUT where the two are not of one
    trial."""
    if truth.markers_world_m.shape[:2] != keypoints.confidence.shape:
        raise _refused(
            f"truth of {truth.markers_world_m.shape[:2]} frames and points for {keypoints.confidence.shape}",
            "the truth.npz that was written beside the keypoints",
        )
    return _seen_by(keypoints, np.einsum("tij,tki->tkj", truth.R_nc, truth.markers_world_m), keypoints.camera, "known")


def truth_of_trc(
    keypoints: Keypoints, path: str | Path, camera: Camera | None = None, pose: CameraPose | None = None
) -> PointTruth:
    """Return the truth of markers that several calibrated cameras triangulated (TRC), frame by frame from the first, in
    the picture of one of these cameras: `camera` and `pose`, with (x, y, z)_trc = (y, z, x)_world as Pose2Sim writes
    it. Without a pose the camera is found from the points (`resect`), with the lens of `camera` or of the keypoints.

    Raises `PblError` FILE_MISSING, FILE_FORMAT, REFERENCE_INPUT (other frames, or too few points in common).
    """
    trc = read_trc(path)
    if len(trc.time_s) != len(keypoints.time_s):
        raise _refused(f"{len(trc.time_s)} frames in {path}, {len(keypoints.time_s)} in the keypoints", "the same")
    world = np.full((*keypoints.confidence.shape, 3), np.nan)
    for j, name in enumerate(keypoints.names):
        theirs = name if name in trc.names else _OPENPOSE.get(name)
        if theirs in trc.names:
            world[:, j] = trc.xyz_m[:, trc.names.index(theirs)][:, [2, 0, 1]]
    lens = camera or keypoints.camera
    if pose is None:
        seen = dataclasses.replace(keypoints, camera=lens)
        known = camera is not None
        return resect(seen, keypoints.time_s, world, np.zeros(1), known, "points of several cameras")
    return _seen_by(keypoints, (world - pose.p_nc) @ pose.R_nc, lens, "points of several cameras, as calibrated")


def truth_of_bodies(keypoints: Keypoints, path: str | Path) -> PointTruth:
    """Return the truth of marker mocap (`reference_of_bodies`' file) beside a camera that stood still: the points of
    the marker set on the bodies of the mocap's model, scaled as these are, in the camera that `resect` finds.

    Raises `PblError` FILE_MISSING, FILE_FORMAT, REFERENCE_INPUT (no camera explains the points).
    """
    bodies = load_bodies(path)
    markers = marker_set(keypoints.marker_set)
    markers.check_names(keypoints.names)
    room = np.full((len(bodies.time_s), len(markers), 3), np.nan)
    for j, body in enumerate(markers.body_names):
        if body in bodies.rotation:
            room[:, j] = bodies.rotation[body].apply(markers.position_m[j] * bodies.scale[body])
            room[:, j] += bodies.position_m[body]
    return resect(keypoints, bodies.time_s, room)


def resect(
    keypoints: Keypoints,
    time_s: np.ndarray,
    room_m: np.ndarray,
    lags_s: np.ndarray = _LAGS_S,
    lens_known: bool = False,
    what: str = "marker mocap",
) -> PointTruth:
    """Find a camera at rest from the points it saw, and put the true points into its picture.

    Place, orientation and focal length (7 numbers; principal point and distortion are those of the keypoints' camera)
    and the lag of the video, by robust least squares over `_FRAMES` frames.

    Parameters
    ----------
    time_s, room_m
        (N,) and (N, J, 3): the true points in the room, in the time of the video less the lag.
    lags_s
        Lags to try.
    lens_known
        The focal length is that of the keypoints' camera.
    what
        What the truth is, for the note.

    Raises
    ------
    PblError
        REFERENCE_INPUT: fewer than 200 pairs, or no camera that sees the room in front of it.
    """
    best: tuple[float, float, np.ndarray] | None = None
    rows = np.unique(np.linspace(0, len(keypoints.time_s) - 1, _FRAMES).astype(int))
    seen = keypoints.confidence[rows] > 0
    matrix = np.asarray(keypoints.camera.matrix, float)
    soft_px = _SOFT_PX * max(keypoints.image_size_px) / _SOFT_SIDE_PX
    xy = undistort_px(np.where(seen[..., None], keypoints.xy_px[rows], 0.0), keypoints.camera)
    for lag in lags_s:
        at = _at(time_s, room_m, keypoints.time_s[rows] - lag)
        known = seen & np.isfinite(at[..., 0])
        if known.sum() < _LEAST_PAIRS:
            continue
        places, pixels = at[known], xy[known]
        cv2.setRNGSeed(0)
        found, turn, shift, _ = cv2.solvePnPRansac(
            places, pixels, matrix, None, reprojectionError=4 * soft_px, iterationsCount=500
        )
        if not found:
            continue
        start = np.concatenate([turn.ravel(), shift.ravel(), [] if lens_known else [0.0]])
        solution = least_squares(_misses, start, args=(places, pixels, matrix), loss="soft_l1", f_scale=soft_px)
        cost = float(solution.cost) / len(places)
        if best is None or cost < best[0]:
            best = (cost, float(lag), solution.x)
    if best is None:
        raise _refused(
            "no camera at rest that sees these points",
            f"{_LEAST_PAIRS} points or more that both know, and clocks within {np.max(np.abs(lags_s)):g} s",
        )
    _, lag, x = best
    lens = matrix.copy()
    lens[[0, 1], [0, 1]] *= _zoom(x)
    room = _at(time_s, room_m, keypoints.time_s - lag)
    in_camera = Rotation.from_rotvec(x[:3]).apply(room.reshape(-1, 3)).reshape(room.shape) + x[3:6]
    note = f"{what} in a camera found from the points (focal length {lens[0, 0]:.0f} px, lag {1000 * lag:.0f} ms)"
    return _seen_by(keypoints, in_camera, Camera(lens, keypoints.camera.distortion, "resected"), note)


def _misses(x: np.ndarray, places: np.ndarray, pixels: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    p = Rotation.from_rotvec(x[:3]).apply(places) + x[3:6]
    focal = _zoom(x) * np.diag(matrix)[:2]
    return (focal * p[:, :2] / np.maximum(p[:, 2:], 0.1) + matrix[:2, 2] - pixels).ravel()


def _zoom(x: np.ndarray) -> float:
    """The focal length found over the one stated; 1 where it is known."""
    return float(np.exp(x[6])) if len(x) > 6 else 1.0


def _at(time_s: np.ndarray, points: np.ndarray, at_s: np.ndarray) -> np.ndarray:
    """(N, J, 3) points at other times, linear; NaN outside."""
    flat = points.reshape(len(time_s), -1)
    out = [np.interp(at_s, time_s, column, left=np.nan, right=np.nan) for column in flat.T]
    return np.stack(out, axis=-1).reshape(len(at_s), *points.shape[1:])


def _seen_by(keypoints: Keypoints, in_camera: np.ndarray, camera: Camera, note: str) -> PointTruth:
    ends = next((t for t in TRUNK if set(t) <= set(keypoints.names)), None)
    if ends is None:
        raise _refused(f"marker set {keypoints.marker_set}", "points on both shoulders and hips: the trunk is the unit")
    shoulder, hip = (
        in_camera[:, [keypoints.names.index(n) for n in pair]].mean(axis=1) for pair in (ends[:2], ends[2:])
    )
    trunk_m = np.linalg.norm(shoulder - hip, axis=1)
    trunk_px = trunk_m * float(camera.matrix[0, 0]) / hip[:, 2]
    return PointTruth(to_pixels(in_camera, camera), in_camera, trunk_m, trunk_px, note)


def _refused(found: str, expected: str) -> PblError:
    return PblError(
        "REFERENCE_INPUT",
        found=found,
        expected=expected,
        next_step="see research/reports, section What it is compared with",
    )
