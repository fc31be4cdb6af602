"""Trials seen by several calibrated cameras, and the check that they see the same person."""

from __future__ import annotations

import dataclasses
import functools
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.video import CameraPose, load_camera, load_camera_poses, undistort_px

from .types import Keypoints

#: Largest difference between cameras started by one trigger; a frame of 60 Hz is 17 ms.
SAME_TIME_S = 1e-3
_view_error = functools.partial(
    PblError,
    "FIT_INPUT",
    next_step="synchronise and cut the recordings to the same frames, and detect each with the same method",
)


@dataclasses.dataclass(frozen=True)
class MultiView:
    """Keypoints of the same moments from at least two cameras that stand still.

    Raises `PblError` FIT_INPUT: fewer than two views, or views that differ in names or times. CAMERA_INVALID: another
    number of poses.
    """

    #: Keypoints of each camera: equal time stamps (within 1 ms), names and marker set. `xyz_cam_m` may be all NaN.
    views: tuple[Keypoints, ...]
    poses: tuple[CameraPose, ...]  # pose of each camera, in the same order and one world
    cameras: tuple[str, ...] = ()  # their names, for messages; may be empty

    def __post_init__(self) -> None:
        object.__setattr__(self, "views", tuple(self.views))
        object.__setattr__(self, "poses", tuple(self.poses))
        if len(self.views) < 2:
            raise _view_error(f"{len(self.views)} views", "at least two cameras; fit one alone without --cameras")
        if len(self.poses) != len(self.views):
            raise PblError(
                "CAMERA_INVALID",
                found=f"{len(self.poses)} camera poses for {len(self.views)} views",
                expected="one for each",
                next_step="pass the keypoints of each camera of the calibration, or take out cameras",
            )
        first = self.views[0]
        for number, view in enumerate(self.views[1:], 2):
            if (view.marker_set, view.names) != (first.marker_set, first.names):
                found = f"{view.marker_set} with {len(view.names)} names in view {number}, other than in the first"
                raise _view_error(found, f"{first.marker_set} and the same names in the same order")
        check_same_times([view.time_s for view in self.views])

    @property
    def time_s(self) -> np.ndarray:
        """(T,) time stamps, of the first view."""
        return self.views[0].time_s

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the J markers of each view."""
        return self.views[0].names

    @property
    def marker_set(self) -> str:
        """The marker set of each view."""
        return self.views[0].marker_set

    @classmethod
    def from_calibration(cls, views: Sequence[Keypoints], calibration: str | Path, cameras: Sequence[str]) -> MultiView:
        """Views with lens and pose from a calibration file of several cameras (Pose2Sim's TOML).

        `cameras` names each view's camera in the file. The lens of the calibration replaces that of the keypoints.

        Raises `PblError` FIT_INPUT, CAMERA_INVALID (see `load_camera` and `load_camera_poses`).
        """
        poses = load_camera_poses(calibration)
        unknown = [n for n in cameras if n not in poses]
        if unknown or len(cameras) != len(views):
            raise _calibration_error(calibration, list(poses), [str(n) for n in unknown or cameras], len(views))
        lenses = [load_camera(calibration, v.image_size_px, n) for v, n in zip(views, cameras, strict=True)]
        seen = [dataclasses.replace(v, camera=lens) for v, lens in zip(views, lenses, strict=True)]
        return cls(tuple(seen), tuple(poses[n] for n in cameras), tuple(cameras))


def check_same_times(times_s: Sequence[np.ndarray], key: object = None) -> None:
    """Raise `PblError` FIT_INPUT unless all cameras have as many time stamps (s), which agree within `SAME_TIME_S`."""
    first = np.asarray(times_s[0])
    for number, other in enumerate(times_s[1:], 2):
        if len(other) != len(first):
            found = said("{n} frames in view {view}, {first} in the first", n=len(other), view=number, first=len(first))
            raise _view_error(found, "the same frames in all", key=key)
        apart = float(np.max(np.abs(np.asarray(other) - first), initial=0.0))
        if not apart <= SAME_TIME_S:
            found = said("time stamps of view {view} up to {ms:.3g} ms from the first's", view=number, ms=1000 * apart)
            raise _view_error(found, f"at most {1000 * SAME_TIME_S:g} ms: cameras that were started together", key=key)


def cameras_of_files(stems: Sequence[str], calibration: str | Path) -> tuple[str, list[str]]:
    """Find the trial's name and the camera of each file.

    A file belongs to the camera that its stem names, alone or after the trial's name and a dot ("cam_01",
    "walk.cam_01"; case, `_` and `-` are ignored). If no stem names one, the files are in the order of the cameras. The
    trial is called "trial" if the stems have no common name for it.

    Raises `PblError` CAMERA_INVALID if only some stems name a camera, or the numbers differ.
    """
    cameras = list(load_camera_poses(calibration))
    plain = {_plain(name): name for name in cameras}
    parts = [stem.rsplit(".", 1) for stem in stems]
    found = [plain.get(_plain(p[-1])) for p in parts]
    named = [c for c in found if c is not None]
    if not named and len(stems) == len(cameras):
        return "trial", cameras
    if len(named) != len(stems) or len(set(named)) != len(named):
        raise _calibration_error(calibration, cameras, list(stems), len(stems))
    titles = {p[0] for p in parts if len(p) > 1}
    same = len(titles) == 1 and all(len(p) > 1 for p in parts)
    return (titles.pop() if same else "trial"), named


def _plain(name: str) -> str:
    return re.sub(r"[_\-\s]", "", name).casefold()


def _calibration_error(path: str | Path, cameras: list[str], views: list[str], n_views: int) -> PblError:
    return PblError(
        "CAMERA_INVALID",
        found=f"cameras {', '.join(cameras)} for {n_views} views ({', '.join(views)})",
        expected="a camera for each view",
        next_step="name the keypoints files like their cameras, or pass one for each camera in the file's order",
        key=str(path),
    )


#: Largest mean distance (m) of rays to the points of one person from the triangulated points (docs/accuracy.md).
MOST_MISS_M = 0.1
#: Least fraction of the points that two cameras must see in a frame for it to be compared.
_COMPARED_SHARE = 0.5


def ray_miss_m(trial: MultiView) -> Float[np.ndarray, " V"]:
    """Distance of each camera's rays to the person's points from the triangulated points (m): the mean over the points
    of a frame, the median over the frames. NaN for a camera that shares no frame with another.

    A point is triangulated if two cameras see it, at the position with the least sum of squared distances to their
    rays, each weighted with its confidence (Hartley & Zisserman 2004, chapter 12; the midpoint method for two views).
    If two cameras of one height see two different people, only the heights of the points differ.
    """
    return meeting_points(trial)[0]


def meeting_points(trial: MultiView) -> tuple[Float[np.ndarray, " V"], Float[np.ndarray, "T J 3"]]:
    """`ray_miss_m`, and the triangulated points (m), NaN where fewer than two cameras see one."""
    origin = np.stack([p.p_nc for p in trial.poses])
    seen = np.stack([v.confidence > 0 for v in trial.views], axis=2)  # (T, J, V)
    weight = np.where(seen, np.stack([v.confidence for v in trial.views], axis=2), 0.0)
    ray = np.stack([_rays(trial, i) for i in range(len(trial.views))], axis=2)  # (T, J, V, 3)
    across = np.eye(3) - ray[..., :, None] * ray[..., None, :]
    twice = seen.sum(axis=2) >= 2
    a = np.einsum("tjv,tjvab->tjab", weight, across)
    b = np.einsum("tjv,tjvab,vb->tja", weight, across, origin)
    a = np.where(twice[..., None, None], a, np.eye(3))
    place = np.linalg.solve(a + 1e-9 * np.eye(3), b[..., None])[..., 0]
    to = place[:, :, None] - origin
    miss = np.linalg.norm(np.einsum("tjvab,tjvb->tjva", across, to), axis=-1)
    # A camera cannot see a point behind it: its distance counts as the miss.
    behind = np.einsum("tjva,tjva->tjv", to, ray) < 0
    miss = np.where(behind, np.linalg.norm(to, axis=-1), miss)
    counted = seen & twice[..., None]
    n = counted.sum(axis=1)  # (T, V)
    mean = np.where(counted, miss, 0.0).sum(axis=1) / np.maximum(n, 1)
    compared = n >= _COMPARED_SHARE * len(trial.names)
    misses = [np.median(mean[c, i]) if (c := compared[:, i]).any() else np.nan for i in range(n.shape[1])]
    return np.array(misses), np.where(twice[..., None], place, np.nan)


def check_views_agree(trial: MultiView, name: str) -> float:
    """Return the largest of `ray_miss_m` (m), NaN if no two cameras see the person in one frame.

    Raises `PblError` VIEWS_DISAGREE: more than `MOST_MISS_M`.
    """
    miss = ray_miss_m(trial)
    most = float(np.max(miss, initial=-np.inf, where=np.isfinite(miss)))
    if not np.isfinite(most):
        return float("nan")
    if most > MOST_MISS_M:
        names = trial.cameras or tuple(f"view {i}" for i in range(1, len(miss) + 1))
        cells = ", ".join(f"{n} {100 * m:.0f} cm" for n, m in zip(names, miss, strict=True) if np.isfinite(m))
        raise PblError(
            "VIEWS_DISAGREE",
            found=said(
                "trial {name}: rays of the cameras to the person's points miss each other ({cells})",
                name=name,
                cells=cells,
            ),
            expected=f"at most {100 * MOST_MISS_M:.0f} cm: one person, cameras that stand where the calibration says",
            next_step="look at the numbered people of each view (`pbl choose VIDEO_ID --sheet FILE`) and choose the "
            "same person in all; where they are the same, check the order of the cameras and calibrate again",
            key=name,
        )
    return most


def _rays(trial: MultiView, i: int) -> Float[np.ndarray, "T J 3"]:
    """Unit vectors in the world to each point of a view."""
    view, camera = trial.views[i], trial.views[i].camera
    xy = undistort_px(np.where((view.confidence > 0)[..., None], view.xy_px, 0.0), camera)
    ones = np.ones((*xy.shape[:2], 1))
    ray = np.concatenate([xy, ones], axis=2) @ np.linalg.inv(camera.matrix).T @ trial.poses[i].R_nc.T
    return ray / np.linalg.norm(ray, axis=-1, keepdims=True)
