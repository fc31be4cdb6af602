"""Origin of the data of a file (taken, computed, assumed), and checks of them against a person.

Assumed of the person: 0.75 to 3.4 m tall; a stride takes 0.4 to 8 s. A file states its unit and its times, or a reader
assumes them; a body shows them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np

from .errors import PblError, said
from .qc import WARN, Check
from .sampling import interval_of

#: Size of the body relative to an adult's, seconds of a frame and of a stride.
SIZES, STEPS_S, STRIDES_S = (0.45, 2.0), (1 / 5000, 0.25), (0.4, 8.0)
#: Least amplitude (m) of the distance between the feet that shows strides.
_SWING_M = 0.15
UNITS = {"metres": 1.0, "feet": 0.3048, "inches": 0.0254, "centimetres": 0.01, "millimetres": 0.001}
#: An error of a name: found, expected, next step.
Refusal = Callable[[str, str, str], PblError]


@dataclasses.dataclass
class Origin:
    """Origin of a reader's data, as phrases: taken from the file, computed from the data, assumed or left out."""

    taken: list[str] = dataclasses.field(default_factory=list)
    computed: list[str] = dataclasses.field(default_factory=list)
    assumed: list[str] = dataclasses.field(default_factory=list)

    def checks(self, name: str) -> tuple[Check, ...]:
        """The check `input_assumptions` of the file `name`: a warning that lists all; none if nothing was assumed."""
        if not self.assumed:
            return ()
        parts = (("", self.assumed), ("computed: ", self.computed), ("from the file: ", self.taken))
        text = ". ".join(label + "; ".join(phrases) for label, phrases in parts if phrases)
        return (Check("input_assumptions", WARN, float(len(self.assumed)), 0.0, f"{name}: {text}"),)


def check_size(size: float, refuse: Refusal) -> None:
    """Raise unless a body is of a person's size. size: its length over that of an adult, NaN or 0 if not known."""
    if not size > 0 or SIZES[0] <= size <= SIZES[1]:
        return
    names = ((own, read) for own in UNITS for read in ("metres", "centimetres", "millimetres"))
    own, read = min(names, key=lambda n: abs(np.log(size * UNITS[n[0]] / UNITS[n[1]])))
    times = said("{x:.4g} times", x=size) if size > 1 else said("1/{x:.3g} of", x=1 / size)
    raise refuse(
        said(
            "a body {times} that of an adult, such as {own} read as {read}", times=times, own=said(own), read=said(read)
        ),
        f"{SIZES[0]:g} to {SIZES[1]:g} times an adult's size",
        "correct the unit: of a .trc or .c3d that of its header; metres in all other files",
    )


def check_steps(time_s: np.ndarray, refuse: Refusal) -> None:
    """Raise unless the frames of time_s (T,) are as far apart as those of a recording."""
    step = interval_of(time_s) if len(time_s) > 1 else STEPS_S[1]
    if STEPS_S[0] <= step <= STEPS_S[1]:
        return
    guess = (
        said("frame numbers")
        if np.allclose(np.diff(time_s), 1)
        else said("milliseconds")
        if step > 0.25
        else said("another unit")
    )
    raise refuse(
        said("{step:.3g} s from frame to frame, such as {guess} read as seconds", step=step, guess=said(guess)),
        f"{STEPS_S[0]:g} to {STEPS_S[1]:g} s",
        "write the time of each frame in seconds",
    )


def check_strides(apart_m: np.ndarray, time_s: np.ndarray, refuse: Refusal) -> None:
    """Raise if the strides of a walk are not a person's. The horizontal distance (T, 2) from one foot to the other,
    NaN where it is not known, changes its sign along the way twice a stride."""
    known = np.isfinite(apart_m).all(axis=1)
    if known.sum() < 3:
        return
    apart = apart_m[known] - apart_m[known].mean(axis=0)
    along = apart @ np.linalg.eigh(apart.T @ apart)[1][:, -1]
    high = np.percentile(np.abs(along), 90)
    far = np.abs(along) > max(0.3 * high, 0.3 * _SWING_M)
    change = time_s[known][far][1:][np.diff(np.sign(along[far])) != 0]
    if len(change) < 3 or high < _SWING_M:
        return
    stride = 2 * float(np.median(np.diff(change)))
    if not STRIDES_S[0] <= stride <= STRIDES_S[1]:
        raise refuse(
            said("strides of {s:.2g} s", s=stride),
            f"{STRIDES_S[0]:g} to {STRIDES_S[1]:g} s",
            "correct the times of the frames, in seconds (the rate of the recording)",
        )
