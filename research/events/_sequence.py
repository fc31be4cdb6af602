"""A sequence of the training corpus: where the points of both legs are, and when the feet come down and leave."""

from __future__ import annotations

import dataclasses

import numpy as np
from jaxtyping import Float

#: Sequences are at this rate, which is also the model's.
GRID_HZ = 50.0
#: Points of a leg. `mtp` is the middle of the toes' joints, `tip` the end of the toes: what marker sets call the toe
#: lies between them.
POINTS = ("hip", "knee", "ankle", "heel", "mtp", "tip")
#: The four events in the order of walking, as everywhere in this package.
ORDER = (("left", "foot_down"), ("right", "foot_up"), ("right", "foot_down"), ("left", "foot_up"))


@dataclasses.dataclass(frozen=True, eq=False)
class Bout:
    """Walking without a stop: times (s) of each of the four events, in `ORDER`; `open_ends`: the walk goes on
    beyond the sequence."""

    events_s: tuple[np.ndarray, ...]
    open_ends: bool


@dataclasses.dataclass(frozen=True, eq=False)
class Sequence:
    """`xyz_m` (T, 6, 2, 3): points, [left, right], x y z with z up, at `GRID_HZ` from time 0; the pelvis may stand
    still. `bouts`: walking; `kind`: what it is."""

    xyz_m: Float[np.ndarray, "T 6 2 3"]
    bouts: tuple[Bout, ...]
    kind: str

    @property
    def time_s(self) -> np.ndarray:
        return np.arange(len(self.xyz_m)) / GRID_HZ

    def phases(self) -> tuple[np.ndarray, np.ndarray]:
        """Phase (T, 4) in turns of each event, 0 modulo 1 where it happens, NaN where it is not defined; and whether
        the person walks (T,).

        Between two events of a kind the phase grows evenly. Beyond the first and the last of a bout it goes on at
        the same rate for at most `BEYOND` turns.
        """
        time = self.time_s
        phase, walks = np.full((len(time), 4), np.nan), np.zeros(len(time), bool)
        for bout in self.bouts:
            known = np.concatenate(bout.events_s)
            if len(known) == 0:
                continue
            first, last = float(known.min()), float(known.max())
            if bout.open_ends:
                first, last = -np.inf, np.inf
            inside = (time >= first) & (time <= last)
            walks |= inside
            stride = [np.median(np.diff(e)) for e in bout.events_s if len(e) > 1]
            if not stride:
                continue
            for k, e in enumerate(bout.events_s):
                if len(e) == 0:
                    continue
                own = float(np.median(np.diff(e))) if len(e) > 1 else float(np.median(stride))
                before, after = (e[1] - e[0], e[-1] - e[-2]) if len(e) > 1 else (own, own)
                knots = np.concatenate([[e[0] - BEYOND * before], e, [e[-1] + BEYOND * after]])
                turns = np.concatenate([[-BEYOND], np.arange(len(e)), [len(e) - 1 + BEYOND]])
                use = inside & (time >= knots[0]) & (time <= knots[-1])
                phase[use, k] = np.interp(time[use], knots, turns)
        return phase, walks


BEYOND = 0.75
