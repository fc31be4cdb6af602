"""The units of the cost: its pixel and its metre, defined only here.

A detector cuts the person out of the picture, looks at the crop at a fixed size, and errs by a fraction of that crop:
in pixels of the file the same error is four times as large at 4K as at 540p, or when the person is four times nearer.
So residuals of the picture, their weight and their Huber width are in pixels of a crop of 256 pixels, frame by frame.
On recordings with a truth, at several sizes each, that unit predicts the error as well as the person's box or distance
does, and far better than the file's pixel (research/reports); it needs neither depth nor focal length.

In the same way the metres of a single camera's 3D points depend on the body size that the detector assumes. They are
scaled to the size of the unscaled body, so that a detector that assumes a taller person yields the same angles.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.ndimage import median_filter

from pbl_pipeline.body import Body, MarkerSet
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.sampling import interval_of

from .params import CostParams
from .standing import standing_markers, trunk_of

#: Pixel of the cost (`CostParams.pixel`): one of the file; one of a picture of 1080 x 1920, as the paper's were; one of
#: a crop of `CROP_SIZE`.
PIXELS = FILE, PAPER, CROP = "file", "1080x1920", "crop"
#: Metre of the cost (`CostParams.metre`): the detector's, or that of a person as large as the unscaled body.
METRES = DETECTOR, BODY = "detector", "body"
#: Side of a crop that is not resized: the input of BlazePose's landmark networks.
CROP_SIZE = 256
#: Longer side of the paper's pictures.
PAPER_SIDE_PX = 1920
#: The crop of keypoints that do not state it: so many times the longer side of the box that holds all but the outermost
#: 5 % of the points on each side (`blazepose-heavy`: 1.45 to 1.50 on phone clips, 1.54 to 1.73 on a person who balances
#: with raised arms), as a median over a time (s) in which legs swing.
CROP_OF_BOX, BOX_PERCENT, BOX_S = 1.48, (5.0, 95.0), 1.0


def check_units(cost: CostParams) -> None:
    """Raise `PblError` FIT_INPUT if the parameters name an unknown unit."""
    for name, value, known in (("pixel", cost.pixel, PIXELS), ("metre", cost.metre, METRES)):
        if value not in known:
            raise PblError(
                "FIT_INPUT",
                found=f"cost.{name} {value!r}",
                expected=f"one of {', '.join(known)}",
                next_step="correct the paramset",
                key=name,
            )


def pixel_px(view: Keypoints, pixel: str) -> Float[np.ndarray, " T"]:
    """Size of the cost's pixel in pixels of the file, in each frame of a view."""
    if pixel == FILE:
        return np.ones(len(view.time_s))
    if pixel == PAPER:
        return np.full(len(view.time_s), max(view.image_size_px) / PAPER_SIDE_PX)
    return crop_px(view) / CROP_SIZE


def crop_px(view: Keypoints) -> Float[np.ndarray, " T"]:
    """Side (px) of the crop in which the detector saw the person, in each frame: as stated, else from the points.

    Frames in which nothing was seen are interpolated from their neighbours.
    """
    stated = None if view.crop_px is None else np.asarray(view.crop_px, np.float64)
    side = stated if stated is not None and np.isfinite(stated).any() else CROP_OF_BOX * box_side_px(view)
    known = np.isfinite(side)
    if not known.any():
        return np.full(len(side), float(max(view.image_size_px)))
    return np.interp(view.time_s, view.time_s[known], side[known])


def box_side_px(view: Keypoints) -> Float[np.ndarray, " T"]:
    """Longer side (px) of the box around the points that were seen (`CROP_OF_BOX`), NaN where there are fewer than two
    places."""
    seen = view.confidence > 0
    side = np.full(len(seen), np.nan)
    enough = np.flatnonzero(np.count_nonzero(seen, axis=1) >= 2)
    if not len(enough):
        return side
    low, high = _percentiles(np.ascontiguousarray(np.moveaxis(view.xy_px[enough], -1, 0)), seen[enough], BOX_PERCENT)
    step = interval_of(view.time_s) if len(view.time_s) > 1 else BOX_S
    side[enough] = median_filter(np.max(high - low, axis=1), max(1, round(BOX_S / step)), mode="nearest")
    return np.where(side > 0, side, np.nan)


def _percentiles(x: Float[np.ndarray, "D T J"], seen: np.ndarray, percent: Sequence[float]) -> list[np.ndarray]:
    """Percentiles (T, D) of the points `seen` (T, J) bool in each frame, in a third of the time of
    scipy's `quantile`; numpy's takes frames one by one."""
    ordered, last = np.sort(np.where(seen, x, np.inf), axis=-1), np.count_nonzero(seen, axis=-1) - 1
    frames = np.arange(len(seen))
    found = []
    for share in np.asarray(percent) / 100:
        below = np.floor(share * last).astype(int)
        low, high = (ordered[:, frames, i] for i in (below, np.minimum(below + 1, last)))
        found.append((low + (share * last - below) * (high - low)).T)
    return found


def body_metres(
    body: Body, markers: MarkerSet, x_cam: Sequence[Float[np.ndarray, "T 1 J 3"]], c: Sequence[np.ndarray]
) -> float:
    """Metres of the unscaled body in one of the detector's: by the points of the trunk, whose distances from their
    middle (root mean square) hardly change with the posture; the median over the frames of all trials.

    1 if no frame shows three of them in different places.
    """
    trunk = trunk_of(markers)
    template, ratios = standing_markers(body, markers)[trunk], []
    for points, confidence in zip(x_cam, c, strict=True):
        weight = np.where(confidence[:, 0, trunk] > 0, 1.0, 0.0)
        enough = weight.sum(axis=1) >= 3
        seen, own = (_spread(x, weight[enough]) for x in (points[enough, 0][:, trunk], template[None]))
        ratios.append(own[seen > 0] / seen[seen > 0])
    found = np.concatenate(ratios)
    return float(np.median(found)) if len(found) else 1.0


def _spread(points: Float[np.ndarray, "#T J 3"], weight: Float[np.ndarray, "T J"]) -> Float[np.ndarray, " T"]:
    """Root mean square distance of weighted points from their middle."""
    total = weight.sum(axis=1)
    away = points - ((weight[:, None] @ points) / total[:, None, None])
    return np.sqrt(np.einsum("tj,tji,tji->t", weight, away, away) / total)
