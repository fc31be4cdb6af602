"""Intrinsics from a video of a board: sharp and different views, the lens by least squares, and a picture of both.

The formal standard deviation of a least-squares fit treats every corner as an independent measurement. They are not: a
bent board or a lens that refocuses shifts all corners of a view together. So the lens is also fitted without one group
of views at a time (delete-a-group jackknife); the larger of the two deviations is reported.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.errors import PblError
from pbl_pipeline.results.video_facts import VideoInfo

from .boards import Board
from .camera import reaches_corners
from .file_facts import probe
from .frames import read_frames
from .types import Camera

#: The sharpest frame of each part of the video is a candidate: largest number of parts, and their least length (s).
MOST_CANDIDATES, SHORTEST_PART_S = 160, 0.2
#: Views that are used: more take time and improve nothing.
MOST_VIEWS, FEWEST_VIEWS = 40, 8
#: Cells of the picture, and the fraction of them in which a corner must lie: elsewhere the lens is not known.
CELLS, LEAST_COVERAGE = (6, 6), 0.5
#: Views must differ by this much in tilt (deg), or focal length and distance cannot be told apart.
LEAST_TILT_DEG = 15.0
#: Largest deviation (rms) of corners from the fitted lens, px in a picture 1000 px long; and of the focal length.
MOST_RMS_PX, MOST_REL_SD = 1.0, 0.01
#: A view that fits worse than this many times the median view has a misplaced corner or is blurred.
_OUTLIER = 3.0
_GROUPS = 8
_STOP = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 100, 1e-9)
_poor = functools.partial(PblError, "CALIBRATION_POOR")


@dataclasses.dataclass(frozen=True)
class View:
    """One picture of the board: frame number, numbers of the corners (K,), their positions (K, 2) in px."""

    frame: int
    ids: np.ndarray
    xy_px: np.ndarray


@dataclasses.dataclass(frozen=True)
class Calibration:
    """A fitted lens."""

    camera: Camera
    image_size_px: tuple[int, int]
    sd: np.ndarray  # (9,) standard deviations of fx, fy, cx, cy (px) and of k1, k2, p1, p2, k3
    rms_px: float  # of all corners of the used views
    views: tuple[View, ...]
    residual_px: tuple[np.ndarray, ...]  # (K, 2) of each view, seen minus fitted
    coverage: float  # fraction of the picture's cells with a corner
    tilt_deg: float  # largest angle between two views of the board
    n_found: int
    n_tried: int

    @property
    def focal_sd_px(self) -> float:
        """The larger standard deviation of the two focal lengths."""
        return float(self.sd[:2].max())

    def save(self, path: str | Path, about: dict[str, Any]) -> None:
        """Write the camera file that `load_camera` reads, with how it was made and `about` (video, board, phone)."""
        names = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
        content = {
            "camera_matrix": [[round(float(v), 4) for v in row] for row in self.camera.matrix],
            "distortion": [round(float(v), 7) for v in self.camera.distortion],
            "image_size_px": list(self.image_size_px),
            "focal_sd_px": round(self.focal_sd_px, 4),
            "sd": {n: float(f"{v:.3g}") for n, v in zip(names, self.sd, strict=True)},
            "rms_px": round(self.rms_px, 4),
            "n_views": len(self.views),
            "coverage": round(self.coverage, 3),
            "tilt_deg": round(self.tilt_deg, 1),
            **about,
        }
        Path(path).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def calibrate_video(path: str | Path, board: Board, info: VideoInfo | None = None) -> Calibration:
    """Calibrate the camera that filmed `board`. Reads the video twice; memory does not grow with its length.

    Raises `PblError` of the VIDEO_ codes; CALIBRATION_NO_BOARD, CALIBRATION_FEW_VIEWS, CALIBRATION_POOR.
    """
    info = info or probe(path)
    candidates = sharpest_frames(path, info)
    other, is_other = board.by_corners(), False
    views, tried = [], 0
    for frame in progress.track(read_frames(path, stop=candidates[-1] + 1), "board", total=candidates[-1] + 1):
        if frame.index not in candidates:
            continue
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        found = board.find(grey)
        if found is not None:
            views.append(View(frame.index, *found))
        elif other is not None and not is_other and tried % 4 == 0:
            is_other = other.find(grey) is not None
        tried += 1
    # A part of a larger board is also found now and then.
    if not views or (is_other and len(views) < FEWEST_VIEWS):
        raise _no_board(path, board, tried, other if is_other else None)
    return calibrate(views, board, (info.width_px, info.height_px), tried, key=path)


def sharpest_frames(path: str | Path, info: VideoInfo) -> list[int]:
    """Numbers of the frames with the strongest edges, one of each part of the video."""
    # A single picture has no length.
    n_parts = int(np.clip(np.nan_to_num(info.duration_s) / SHORTEST_PART_S, 1, MOST_CANDIDATES))
    part = np.minimum((np.arange(info.n_frames) * n_parts) // max(info.n_frames, 1), n_parts - 1)
    best: dict[int, tuple[float, int]] = {}
    for frame in progress.track(read_frames(path), "sharpness", total=info.n_frames):
        grey = cv2.cvtColor(frame.image, cv2.COLOR_BGR2GRAY)
        small = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        sharp = float(cv2.Laplacian(small, cv2.CV_32F).var())
        best[part[frame.index]] = max(best.get(part[frame.index], (-1.0, 0)), (sharp, frame.index))
    return sorted(index for _, index in best.values())


def calibrate(
    views: Sequence[View], board: Board, image_size_px: tuple[int, int], n_tried: int | None = None, key: object = None
) -> Calibration:
    """Fit the lens to views of the board in upright pictures of one size (width, height).

    Raises `PblError` CALIBRATION_FEW_VIEWS, CALIBRATION_POOR (coverage, tilt, residual, uncertainty).
    """
    n_found, n_tried = len(views), len(views) if n_tried is None else n_tried
    _check_number(n_found, n_tried, key)
    chosen = different_views(views, image_size_px, MOST_VIEWS)
    coverage = covered(chosen, image_size_px)
    if coverage < LEAST_COVERAGE:
        raise _poor(
            f"corners in {coverage:.0%} of the picture's {CELLS[0] * CELLS[1]} cells",
            f"{LEAST_COVERAGE:.0%} or more: the lens is not known elsewhere",
            "bring the board into the corners and to the edges of the picture, and close enough to fill it",
            key,
        )
    fit = _fit(chosen, board, image_size_px)
    kept = [v for v, rms in zip(chosen, fit.view_rms, strict=True) if rms <= _OUTLIER * np.median(fit.view_rms)]
    if len(kept) < len(chosen):
        _check_number(len(kept), n_tried, key)
        fit = _fit(kept, board, image_size_px)
    sd = np.maximum(fit.sd, _jackknife(kept, board, image_size_px, fit))
    tilt = _largest_tilt(fit.rvecs)
    limit = MOST_RMS_PX * max(image_size_px) / 1000
    focal = float(fit.matrix[0, 0] + fit.matrix[1, 1]) / 2
    rel_sd = float(sd[:2].max()) / focal
    if tilt < LEAST_TILT_DEG:
        raise _poor(
            f"views of the board that differ by at most {tilt:.0f} deg in tilt",
            f"{LEAST_TILT_DEG:.0f} deg or more: from the front, a long lens far away looks like a short one near by",
            "tilt the board (or walk around it) to all four sides by 20 to 45 deg while filming",
            key,
        )
    if fit.rms > limit:
        raise _poor(
            f"corners {fit.rms:.2f} px (rms) off the fitted lens",
            f"{limit:.2f} px or less in a picture of this size",
            "check --squares, glue the board onto something flat and stiff, film slowly in good light with the focus "
            "locked; this model does not describe a fisheye or ultra-wide lens",
            key,
        )
    if not rel_sd <= MOST_REL_SD:
        raise _poor(
            f"a focal length of {focal:.0f} px with a standard deviation of {100 * rel_sd:.1f} %",
            f"{100 * MOST_REL_SD:g} % or less",
            "film the board larger, in more places and more strongly tilted; lock the focus",
            key,
        )
    if not reaches_corners(fit.matrix, fit.distortion, image_size_px):
        raise _poor(
            "a distortion that folds back before the corners of the picture",
            "a lens that is described over the whole picture",
            "bring the board into the corners of the picture",
            key,
        )
    camera = Camera(fit.matrix, fit.distortion, f"measured: {board.kind}, {len(kept)} views", rel_sd)
    return Calibration(camera, image_size_px, sd, fit.rms, tuple(kept), fit.residuals, coverage, tilt, n_found, n_tried)


def different_views(views: Sequence[View], image_size_px: tuple[int, int], most: int) -> list[View]:
    """Choose at most `most` views, each to differ most from the previous ones in position, size and slant."""
    features = np.array([_features(v, image_size_px) for v in views])
    order = [int(np.argmax([len(v.ids) for v in views]))]
    distance = np.full(len(views), np.inf)
    while len(order) < min(most, len(views)):
        distance = np.minimum(distance, np.linalg.norm(features - features[order[-1]], axis=1))
        distance[order] = -1.0
        order.append(int(np.argmax(distance)))
    return [views[i] for i in sorted(order)]


def covered(views: Sequence[View], image_size_px: tuple[int, int]) -> float:
    """Fraction of the picture's cells in which a corner was seen."""
    return len(_cells(views, image_size_px)) / (CELLS[0] * CELLS[1])


def _cells(views: Sequence[View], image_size_px: tuple[int, int]) -> set[tuple[int, ...]]:
    """Columns and rows of the cells in which a corner was seen."""
    xy = np.concatenate([v.xy_px for v in views])
    cell = np.clip((xy + 0.5) / image_size_px * CELLS, 0, np.array(CELLS) - 1).astype(int)
    return set(map(tuple, cell.tolist()))


# ------------------------------------------------------------------------------------------------------------ the fit
@dataclasses.dataclass(frozen=True)
class _Fit:
    matrix: np.ndarray
    distortion: np.ndarray
    sd: np.ndarray
    rms: float
    view_rms: np.ndarray
    residuals: tuple[np.ndarray, ...]
    rvecs: list[np.ndarray]
    flags: int


def _fit(views: Sequence[View], board: Board, size: tuple[int, int]) -> _Fit:
    """Fit with k3 only if the model then holds up to the picture's corners: few board corners there leave k3 free."""
    fit = _fit_with(views, board, size, 0)
    if not reaches_corners(fit.matrix, fit.distortion, size):
        fit = _fit_with(views, board, size, cv2.CALIB_FIX_K3)
    return fit


def _fit_with(
    views: Sequence[View], board: Board, size: tuple[int, int], flags: int, start: _Fit | None = None
) -> _Fit:
    points = [board.corners_m[v.ids].astype(np.float32) for v in views]
    places = [v.xy_px.astype(np.float32) for v in views]
    if start is None:
        focal = 0.75 * max(size)
        matrix = np.array([[focal, 0, (size[0] - 1) / 2], [0, focal, (size[1] - 1) / 2], [0, 0, 1.0]])
        distortion = np.zeros(5)
    else:
        matrix, distortion = start.matrix.copy(), start.distortion.copy()
    _, matrix, distortion, rvecs, tvecs, sd, _, _ = cv2.calibrateCameraExtended(
        points, places, size, matrix, distortion, flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS, criteria=_STOP
    )
    distortion = np.asarray(distortion, np.float64).ravel()[:5]
    residuals = []
    for p, xy, r, t in zip(points, places, rvecs, tvecs, strict=True):
        fitted, _ = cv2.projectPoints(p.astype(np.float64), r, t, matrix, distortion)
        residuals.append(xy - fitted.reshape(-1, 2))
    view_rms = np.array([math.sqrt(np.mean(np.sum(r**2, axis=1))) for r in residuals])
    rms = math.sqrt(np.mean(np.sum(np.concatenate(residuals) ** 2, axis=1)))
    return _Fit(matrix, distortion, np.asarray(sd).ravel()[:9], rms, view_rms, tuple(residuals), list(rvecs), flags)


def _jackknife(views: Sequence[View], board: Board, size: tuple[int, int], fit: _Fit) -> np.ndarray:
    """Standard deviations (9,) from leaving out one stretch of the video after the other, so that slow changes, such as
    of the focus, count."""
    groups = min(_GROUPS, len(views))
    values = []
    for left_out in progress.track(np.array_split(np.arange(len(views)), groups), "uncertainty", total=groups):
        rest = [v for i, v in enumerate(views) if i not in left_out]
        again = _fit_with(rest, board, size, fit.flags, fit)
        m = again.matrix
        values.append([m[0, 0], m[1, 1], m[0, 2], m[1, 2], *again.distortion])
    off = np.array(values) - np.mean(values, axis=0)
    return np.sqrt((groups - 1) / groups * np.sum(off**2, axis=0))


def _largest_tilt(rvecs: Sequence[np.ndarray]) -> float:
    """Largest angle (deg) between the board's normals in two views."""
    normals = np.array([cv2.Rodrigues(np.asarray(r, np.float64))[0][:, 2] for r in rvecs])
    return float(np.degrees(np.arccos(np.clip(normals @ normals.T, -1, 1).min())))


def _features(view: View, size: tuple[int, int]) -> np.ndarray:
    """(5,) centre of the corners, their spread along both axes (all in picture sides), and its correlation."""
    xy = view.xy_px / max(size)
    middle = xy.mean(axis=0)
    off = xy - middle
    (xx, xy_), (_, yy) = np.cov(off.T)
    # The spread is the size of the board, its covariance shows turn and slant.
    return np.array([*middle, 2 * math.sqrt(xx), 2 * math.sqrt(yy), xy_ / max(math.sqrt(xx * yy), 1e-9)])


# ------------------------------------------------------------------------------------------------------------- errors
def _check_number(n: int, tried: int, key: object) -> None:
    if n < FEWEST_VIEWS:
        raise PblError(
            "CALIBRATION_FEW_VIEWS",
            found=f"{n} usable views of the board in {tried} sharp pictures",
            expected=f"{FEWEST_VIEWS} or more",
            next_step="film for 30 to 60 s, slowly, the whole board in the picture (of a ChArUco board a part is "
            "enough), without glare",
            key=key,
        )


def _no_board(path: str | Path, board: Board, tried: int, other: Board | None) -> PblError:
    hint = "check --board and --squares (squares are counted, not corners), and that the whole board is seen, in light"
    if other is not None:
        hint = f"the board has {other.squares[0]}x{other.squares[1]} squares: pass --squares with these"
    return PblError(
        "CALIBRATION_NO_BOARD",
        found=f"no {board.kind} of {board.squares[0]}x{board.squares[1]} squares in {tried} sharp pictures",
        expected="a video in which the board is seen",
        next_step=hint,
        key=path,
    )


#: Longer side of the picture (px), and magnification of the residuals.
_SIDE_PX, _ENLARGED = 900, 50.0
_INK, _GRID, _SEEN, _OFF = (60, 60, 60), (225, 225, 225), (170, 120, 40), (40, 60, 200)


def draw_calibration(found: Calibration) -> np.ndarray:
    """(H, W, 3) uint8 BGR: corners as dots, residuals as strokes 50 times longer, empty cells shaded, and a grid that
    would be straight without distortion."""
    scale = _SIDE_PX / max(found.image_size_px)
    width, height = (round(n * scale) for n in found.image_size_px)
    picture = np.full((height, width, 3), 255, np.uint8)
    for i, j in set(np.ndindex(CELLS)) - _cells(found.views, found.image_size_px):
        low = (round(i * width / CELLS[0]), round(j * height / CELLS[1]))
        high = (round((i + 1) * width / CELLS[0]), round((j + 1) * height / CELLS[1]))
        cv2.rectangle(picture, low, high, (235, 235, 250), -1)
    _draw_grid(picture, found, scale)
    for view, residual in zip(found.views, found.residual_px, strict=True):
        for place, off in zip(view.xy_px, residual, strict=True):
            start = _at(place, scale)
            cv2.line(picture, start, _at(place + _ENLARGED * off, scale), _OFF, 1, cv2.LINE_AA)
            cv2.circle(picture, start, 2, _SEEN, -1, cv2.LINE_AA)
    cv2.rectangle(picture, (0, 0), (width - 1, height - 1), _INK, 1)
    foot = np.full((64, width, 3), 255, np.uint8)
    focal, sd = found.camera.focal_px, found.focal_sd_px
    for row, text in enumerate(
        (
            f"{len(found.views)} views, corners in {found.coverage:.0%} of the cells (shaded: none)",
            f"focal length {focal:.1f} +- {sd:.1f} px, rms {found.rms_px:.2f} px (strokes x{_ENLARGED:.0f})",
        )
    ):
        cv2.putText(foot, text, (10, 26 + 26 * row), cv2.FONT_HERSHEY_SIMPLEX, 0.5, _INK, 1, cv2.LINE_AA)
    return np.vstack([picture, foot])


def _draw_grid(picture: np.ndarray, found: Calibration, scale: float) -> None:
    matrix, distortion = found.camera.matrix, found.camera.distortion
    width, height = found.image_size_px
    for fixed, count, length in ((0, 9, height), (1, 9, width)):
        for place in np.linspace(0, (width, height)[fixed], count):
            line = np.empty((60, 2))
            line[:, fixed], line[:, 1 - fixed] = place, np.linspace(0, length, 60)
            rays = np.column_stack([(line - matrix[:2, 2]) / np.diag(matrix)[:2], np.ones(60)])
            bent, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, distortion)
            points = np.round(bent.reshape(-1, 2) * scale).astype(np.int32)
            cv2.polylines(picture, [points.reshape(-1, 1, 2)], False, _GRID, 1, cv2.LINE_AA)


def _at(place: np.ndarray, scale: float) -> tuple[int, int]:
    return round(float(place[0]) * scale), round(float(place[1]) * scale)
