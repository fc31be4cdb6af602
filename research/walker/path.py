"""Ways of walking in front of a camera that stands still: straight, on a treadmill, in a figure of eight."""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline

from pbl_pipeline.errors import PblError
from pbl_pipeline.synthetic.plan import within

#: Where the middle of the walk lies ahead of the camera (m).
MIDDLE_M = 5.4
#: Half the length and half the width of the figure of eight (m). It lies along the line of sight, so that a person is
#: never cut by the border of an upright picture (18 degrees to either side at most).
EIGHT_LENGTH_M, EIGHT_WIDTH_M = 2.0, 0.7
#: The longest straight way from the nearest (2.2 m) to the furthest point whose mean is still within 6 m.
STRAIGHT_NEAREST_M, STRAIGHT_LONGEST_M = 2.2, 7.0

PATHS = ("straight", "treadmill", "eight")


def choose_path(rng: np.random.Generator, way_m: float) -> str:
    """A figure of eight in half of the cases, else straight where it fits and on a treadmill where not."""
    eight = rng.random() < 0.5
    if eight:
        return "eight"
    return "straight" if way_m <= STRAIGHT_LONGEST_M else "treadmill"


def floor_path(rng: np.random.Generator, path: str, along_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points (T, 2) in m on the floor and headings (T,) in rad about world z after `along_m` (T,) of way.

    The camera stands at the origin and looks along x. The heading is continuous and stays within one turn of 0; in a
    figure of eight left and right turns cancel, so it does not wind up however long the walk.

    Raises
    ------
    PblError
        FIT_INPUT: no such path, or a straight one too long to stay in the picture.
    """
    if path == "treadmill":
        heading = rng.uniform(-np.pi, np.pi)
        place = np.array([within(rng, 5.0, 0.3), within(rng, 0.0, 0.1)])
        return np.tile(place, (len(along_m), 1)), np.full(len(along_m), heading)
    if path == "straight":
        return _straight(rng, along_m)
    if path == "eight":
        return _eight(rng, along_m)
    raise PblError(
        "FIT_INPUT", found=f"path {path!r}", expected=f"one of {', '.join(PATHS)}", next_step="pass one of these"
    )


def _straight(rng: np.random.Generator, along_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    length = float(along_m[-1] - along_m[0])
    if length > STRAIGHT_LONGEST_M + 1.0:
        raise PblError(
            "FIT_INPUT",
            found=f"a straight walk of {length:.1f} m",
            expected=f"at most {STRAIGHT_LONGEST_M + 1.0:.0f} m, so that the person is in the picture and near",
            next_step="take a shorter time, or path='eight' or 'treadmill'",
        )
    away = rng.random() < 0.5
    slant = within(rng, 0.0, np.radians(2.0))
    heading = slant if away else slant + np.pi * (1 if slant < 0 else -1)
    middle = np.array([max(5.0, STRAIGHT_NEAREST_M + length / 2), within(rng, 0.0, 0.1)])
    ahead = np.array([np.cos(heading), np.sin(heading)])
    return middle + (along_m - along_m[0] - length / 2)[:, None] * ahead, np.full(len(along_m), heading)


def _eight(rng: np.random.Generator, along_m: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """x = length sin(s), y = width sin(2 s), walked at the speed asked for by its arc length, either way round."""
    s = np.linspace(0, 2 * np.pi, 2001)
    dx, dy = EIGHT_LENGTH_M * np.cos(s), 2 * EIGHT_WIDTH_M * np.cos(2 * s)
    speed = CubicSpline(s, np.hypot(dx, dy), bc_type="periodic")
    arc = speed.antiderivative()(s)
    parameter_of_arc = CubicSpline(arc, s - 2 * np.pi * arc / arc[-1], bc_type="periodic")  # the periodic part
    turn = np.unwrap(np.arctan2(dy, dx))
    turn[-1] = turn[0]  # equal but for rounding: the figure has no net turn
    turn_of_s = CubicSpline(s, turn, bc_type="periodic")

    way = along_m + rng.uniform(0, arc[-1])
    at = parameter_of_arc(way % arc[-1]) + 2 * np.pi * (way % arc[-1]) / arc[-1]
    point = np.column_stack([EIGHT_LENGTH_M * np.sin(at), EIGHT_WIDTH_M * np.sin(2 * at)])
    heading = turn_of_s(at)
    # Four ways to walk it: mirrored in x, mirrored in y. Each mirror changes the sense of the turns.
    if rng.random() < 0.5:
        point[:, 1], heading = -point[:, 1], -heading
    if rng.random() < 0.5:
        point[:, 0], heading = -point[:, 0], np.pi - heading
    heading -= 2 * np.pi * np.round(np.median(heading) / (2 * np.pi))
    return point + np.array([MIDDLE_M, 0.0]), heading
