"""Anatomical markers from 15 points of a video: OpenCap's marker augmenter, an LSTM of OpenCap's version 0.3.

Two hip points do not determine the tilt of the pelvis, but the whole movement does. The network was trained on motion
capture of 1176 people to predict the positions of 35 skin markers, including the iliac spines (Falisse et al. 2025,
"Marker Data Enhancement for Markerless Motion Capture", IEEE Trans Biomed Eng 72:2013, doi:10.1101/2024.07.13.603382).
Its input is the points, y up, relative to the middle of the hips and divided by the person's height, then height and
mass, all standardised by the mean and standard deviation that are stored next to it; its markers are relative to the
same point and divided by the same height. The walking direction should not matter but does, so the predictions for
several headings are averaged.
"""

from __future__ import annotations

import dataclasses
import functools

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline import assets
from pbl_pipeline.errors import PblError
from pbl_pipeline.runs import runs

#: Input of the network, in its order: names of the marker set `halpe_26`, whose hips, knees and ankles are joints.
POINTS: tuple[str, ...] = (
    "neck",
    *(
        f"{side}_{point}"
        for point in ("shoulder", "hip", "knee", "ankle", "heel", "small_toe", "big_toe")
        for side in ("right", "left")
    ),
)
#: Output, in its order: the marker set `opencap_35`. OpenCap's names, with `l_` for its `L` and without "_study".
MARKERS: tuple[str, ...] = (
    *("r_ASIS", "l_ASIS", "r_PSIS", "l_PSIS"),
    *("r_knee", "r_mknee", "r_ankle", "r_mankle", "r_toe", "r_5meta", "r_calc"),
    *("l_knee", "l_mknee", "l_ankle", "l_mankle", "l_toe", "l_calc", "l_5meta"),
    *("r_shoulder", "l_shoulder", "C7"),
    *("r_thigh1", "r_thigh2", "r_thigh3", "l_thigh1", "l_thigh2", "l_thigh3"),
    *("r_sh1", "r_sh2", "r_sh3", "l_sh1", "l_sh2", "l_sh3", "r_HJC", "l_HJC"),
)
_HIPS = [POINTS.index("right_hip"), POINTS.index("left_hip")]
_KNEES = [POINTS.index("right_knee"), POINTS.index("left_knee")]
_ANKLES = [POINTS.index("right_ankle"), POINTS.index("left_ankle")]
#: From z up to y up: (x, y, z) to (x, z, -y).
_Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
#: Hip to knee and knee to ankle as a fraction of the height: 0.824 of 1.783 m on our body (figures of Hamner, Seth and
#: Delp 2010, J Biomech 43:2709), whose points are the input. OpenCap's points of a man of 1.79 m have 0.45 to 0.46; the
#: 0.491 of Drillis and Contini 1966 are from the trochanter to the ankle joint.
_LEG_OF_HEIGHT = 0.462
#: Heights (m) of the people that the network is meant for; and of any person, beyond which the unit must be wrong.
_ADULT_M, _PERSON_M = (1.35, 2.15), (0.5, 2.6)
#: Relative difference between the height that the legs imply and the stated one above which it is reported.
_MISMATCH = 0.08
_unsuitable = functools.partial(PblError, "AUGMENTER_INPUT")


@dataclasses.dataclass(frozen=True)
class AugmenterParams:
    """Parameters of `MarkerAugmenter`."""

    model_sha256: str = assets.ASSETS["augmenter_network"].sha256
    headings: int = 8  # predictions that are averaged, evenly spread over a turn
    rate_hz: float = 60.0  # rate of the points, that of OpenCap's videos; the network's memory counts in frames
    min_time_s: float = 0.25  # shortest stretch without a gap for which it predicts


@dataclasses.dataclass(frozen=True)
class AnatomicalMarkers:
    """Predicted markers, and the assumptions behind them."""

    names: tuple[str, ...]  # (35,)
    xyz_world_m: np.ndarray  # (T, 35, 3) z up, NaN where a point was unknown
    height_m: float  # these two: as used
    mass_kg: float
    assumed: tuple[str, ...]  # a sentence for each of them that was not stated, or is outside the network's range
    origin: str  # network, licence and hash


class MarkerAugmenter:
    """The loaded network, with the names of its inputs (`points`) and outputs (`markers`). Not to be shared by threads.

    Raises those of `assets.fetch`, and `PblError` SOLVER_UNKNOWN if `params` name another network.
    """

    points = POINTS
    markers = MARKERS

    def __init__(self, params: AugmenterParams | None = None) -> None:
        self.params = params or AugmenterParams()
        asset = assets.ASSETS["augmenter_network"]
        if self.params.model_sha256 != asset.sha256:
            raise PblError(
                "SOLVER_UNKNOWN",
                found=f"a marker augmenter with SHA-256 {self.params.model_sha256}",
                expected=asset.sha256,
                next_step="use the version of pbl-pipeline that the parameters were made with",
            )
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3
        path = assets.fetch(asset.name)
        # Small, and a loop over time: a GPU is not faster.
        self._session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        self._mean, self._std = (np.load(assets.fetch(f"augmenter_{which}")) for which in ("mean", "std"))
        self.origin = f"{asset.what}, SHA-256 {asset.sha256}, licence: {asset.licence}; {asset.source}"

    def __call__(
        self,
        time_s: np.ndarray,
        points_world_m: np.ndarray,
        height_m: float | None = None,
        mass_kg: float | None = None,
    ) -> AnatomicalMarkers:
        """Predict the markers of one person.

        Raises `PblError` AUGMENTER_INPUT: other shapes, a point that is never known (a foot out of view), too short a
        stretch, an impossible height (another unit), or a body upside down (another axis up).

        Parameters
        ----------
        time_s : (T,)
            Strictly increasing seconds.
        points_world_m : (T, 15, 3)
            `POINTS` in a world with z up, metres; NaN where unknown. A frame counts if all 15 are known.
        height_m, mass_kg
            Of the person. None: the height that the legs imply, and the mass of that height by the mean body mass index
            of the network's people, as stated in `assumed`. Pass the height only with positions of true size: one
            camera hardly determines it, and each centimetre by which height and positions disagree tilts the pelvis by
            0.2 to 0.5 deg (docs/models.md).
        """
        points = np.asarray(points_world_m, float)
        time_s = np.asarray(time_s, float)
        _check(time_s, points)
        known = np.asarray(np.isfinite(points).all(axis=(1, 2)))
        stretches = [s for s in runs(known) if time_s[s][-1] - time_s[s][0] >= self.params.min_time_s]
        if not stretches:
            raise _unsuitable(
                f"no stretch of {self.params.min_time_s:g} s in which all points are known",
                "all 15 points in frames without a gap",
                "film the whole person, with both feet in the picture",
            )
        used = np.concatenate([points[s] for s in stretches])
        height, mass, assumed = self._size(used, height_m, mass_kg)
        out = np.full((len(points), len(MARKERS), 3), np.nan)
        for s in stretches:
            steady = np.arange(time_s[s][0], time_s[s][-1] + 1e-9, 1 / self.params.rate_hz)
            found = self._predict(_resampled(steady, time_s[s], points[s]), height, mass)
            out[s] = _resampled(time_s[s], steady, found)
        return AnatomicalMarkers(MARKERS, out, height, mass, assumed, self.origin)

    def _predict(self, points: np.ndarray, height_m: float, mass_kg: float) -> np.ndarray:
        """(N, 35, 3) of points (N, 15, 3) at `rate_hz`: the mean over the headings, all in one call."""
        n, k = len(points), self.params.headings
        turns = _Y_UP @ Rotation.from_rotvec(np.outer(2 * np.pi * np.arange(k) / k, [0.0, 0.0, 1.0])).as_matrix()
        root = points[:, _HIPS].mean(axis=1, keepdims=True)
        seen = np.einsum("kij,npj->knpi", turns, (points - root) / height_m).reshape(k, n, -1)
        size = np.broadcast_to([height_m, mass_kg], (k, n, 2))
        inputs = (np.concatenate([seen, size], axis=2) - self._mean) / self._std
        (answer,) = self._session.run(None, {"inputs": inputs.astype(np.float32)})
        markers = np.asarray(answer, float).reshape(k, n, len(MARKERS), 3) * height_m
        return np.einsum("kji,knpj->npi", turns, markers) / k + root

    def _size(
        self, points: np.ndarray, height_m: float | None, mass_kg: float | None
    ) -> tuple[float, float, tuple[str, ...]]:
        assumed = []
        leg = np.linalg.norm(points[:, _HIPS] - points[:, _KNEES], axis=2)
        leg += np.linalg.norm(points[:, _KNEES] - points[:, _ANKLES], axis=2)
        implied = float(np.median(leg)) / _LEG_OF_HEIGHT
        height = implied if height_m is None else float(height_m)
        for what, value in (("legs imply", implied), ("stated height is", height)):
            if not _PERSON_M[0] <= value <= _PERSON_M[1]:
                raise _unsuitable(f"a person whose {what} {value:.3g} m", "metres", "convert positions and height")
        if height_m is None:
            assumed.append(f"height not known: {height:.2f} m from the length of the legs")
        elif abs(implied / height - 1) > _MISMATCH:
            assumed.append(f"stated height {height:.2f} m, but legs of {implied:.2f} m: the pelvis is tipped by it")
        if mass_kg is None:
            mass = float(self._mean[-1] / self._mean[-2] ** 2) * height**2
            assumed.append(f"mass not known: {mass:.0f} kg, usual at {height:.2f} m")
        else:
            mass = float(mass_kg)
        if not 5 < mass < 400:
            raise _unsuitable(f"a mass of {mass:g} kg", "kilograms of a person", "correct the mass")
        if not _ADULT_M[0] <= height <= _ADULT_M[1]:
            assumed.append(f"height {height:.2f} m: the network knows adults only")
        return height, mass, tuple(assumed)


def _check(time_s: np.ndarray, points: np.ndarray) -> None:
    if points.ndim != 3 or points.shape[1:] != (len(POINTS), 3) or time_s.shape != points.shape[:1]:
        raise _unsuitable(
            f"points of shape {points.shape}, times of shape {time_s.shape}",
            f"(T, {len(POINTS)}, 3) and (T,): {', '.join(POINTS)}",
            "pass these points in this order",
        )
    if not np.isfinite(time_s).all() or np.any(np.diff(time_s) <= 0):
        raise _unsuitable("times that are missing, repeat or run backwards", "increasing seconds", "correct the times")
    seen = np.asarray(np.isfinite(points).all(axis=2).any(axis=0))
    never = [n for n, there in zip(POINTS, seen, strict=True) if not there]
    if never:
        raise _unsuitable(
            f"never known: {', '.join(never)}",
            f"{', '.join(POINTS)}",
            "film the whole person, with both feet in the picture; without the markers the fit uses the points alone",
        )
    if np.nanmedian(points[:, 0, 2] - points[:, _ANKLES, 2].mean(axis=1)) <= 0:
        raise _unsuitable("a neck below the ankles", "a world with z up", "turn the positions")


def _resampled(to_s: np.ndarray, from_s: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(N, P, 3) at the times `to_s`, linear between `from_s` and constant beyond."""
    flat = values.reshape(len(values), -1)
    return np.stack([np.interp(to_s, from_s, v) for v in flat.T], axis=1).reshape(len(to_s), *values.shape[1:])
