"""Ground reaction of each foot, and its point of application.

The motion determines the vertical force of both feet together well. Its second derivatives determine the horizontal
force less well and the moment poorly, so that the centre of pressure of one foot would be off by 5 cm. Three properties
of walking, each measured on force plates (`python -m research.benchmarks.kinetics`), add information:

- the centre of pressure moves from heel to toes in a typical way over the stance of a foot (`PROGRESS`), and lies under
  the forefoot while the heel is off the floor;
- each force points from there nearly at the centre of mass; the offset turns the body. The centre of mass is moved by a
  constant of the recording, so that the mean of the horizontal forces agrees with the change of velocity;
- in double support, the vertical force of the foot behind falls as `trailing_share` (the motion alone does not
  determine it: two feet and the body are a closed loop), and a foot that has just landed does not yet push backwards
  (`LEANS`).

The horizontal force is the mean of this one and of that of the accelerations, whose weight is `BELIEVED`. Forces that
feet on a floor cannot carry are the residual.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import Body
from pbl_pipeline.gait.events import FOOT_DOWN, SIDES, GaitEvent
from pbl_pipeline.runs import runs

from .dynamics import GRAVITY, Dynamics

#: Points of a sole in the frames of calcaneus and toes (m, unscaled): below the heel, the ball and the tip of the toes.
_HEEL_M, _BALL_M, _TIP_M = (-0.015, -0.016, 0.0), (0.19, -0.016, 0.0), (0.06, -0.012, 0.0)
#: Phase of a foot's stance (0 to 1), centre of pressure then from heel (0) to tip (1) and across (towards the outside),
#: in lengths of the sole: means over 12 steps of the six tuning children of the benchmark.
PROGRESS = np.array(
    [
        (0.0, 0.12, -0.03),
        (0.1, 0.24, -0.03),
        (0.2, 0.34, -0.03),
        (0.35, 0.52, -0.02),
        (0.5, 0.70, -0.02),
        (0.6, 0.77, -0.03),
        (0.8, 0.86, -0.07),
        (1.0, 0.99, -0.10),
    ]
)
#: Where the centre of pressure is at least while the heel is off the floor, and the heights of the heel (lengths of the
#: sole) between which that begins to hold.
_FOREFOOT, _HEEL_OFF = 0.65, (0.1, 0.2)
#: Share of the vertical force under the foot behind at 0, 10, ..., 100 % of double support: means over the same
#: children.
TRAILING = (0.90, 0.71, 0.59, 0.51, 0.42, 0.34, 0.26, 0.18, 0.12, 0.07, 0.04)
#: Horizontal force of the foot behind and of the one in front at 0, 20, ..., 100 % of double support, where 1 points at
#: the centre of mass: fitted to the same children's plates, rounded.
LEANS = ((0.7, 0.8, 0.9, 1.0, 1.0, 0.9), (0.3, 0.3, 0.65, 0.85, 1.0, 1.1))
#: How much of the horizontal accelerations is believed: chosen on the same children.
BELIEVED = 0.2
#: The part that low-passed motion lacks of the sharp changes of force as feet land and leave: added to the vertical
#: force over double and over single support, in ranges (5 to 95 %) of that force. Means over the same children, less a
#: constant, so that nothing is added to the mean of a step, which is the weight.
# fmt: off
TRANSIENT = (
    (-0.10, 0.30, 0.36, 0.15, -0.12, -0.17, -0.13),
    (-0.24, -0.07, 0.08, 0.13, 0.12, 0.07, 0.01, -0.01, -0.01, 0.01, 0.01,
     0.00, 0.00, -0.01, -0.01, 0.01, 0.04, 0.04, -0.04, -0.21, -0.37),
)
# fmt: on
#: Largest horizontal against vertical force.
FRICTION = 0.8


@dataclasses.dataclass(frozen=True)
class GroundReaction:
    """Ground reaction of [left, right] at N times, per kilogram, world frame (z up); NaN where contact is not known."""

    contact: np.ndarray  # (N, 2) 1 on the floor, 0 in the air
    force_n: np.ndarray  # (N, 2, 3) 0 in the air
    centre_m: np.ndarray  # (N, 2, 3) of pressure, NaN in the air
    residual_n: np.ndarray  # (N, 3) force that no foot carries
    residual_nm: np.ndarray  # (N, 3) moment about the centre of mass that no foot carries


@dataclasses.dataclass(frozen=True)
class _Sole:
    """A foot on the floor over N times: the heel's place (N, 2) and height over the floor (N,), unit axis from heel to
    tip (N, 2), length, and the height of the floor (N,)."""

    heel: np.ndarray
    lifted: np.ndarray
    along: np.ndarray
    length: float
    floor: np.ndarray

    def point(self, s: np.ndarray, left: np.ndarray) -> np.ndarray:
        """Return the points (N, 3) of the floor at these places along the sole and to the left of its axis, in
        lengths."""
        normal = np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)
        xy = self.heel + self.length * (s[:, None] * self.along + left[:, None] * normal)
        return np.column_stack([xy, self.floor])


def contact_of(time_s: np.ndarray, events: Sequence[GaitEvent]) -> Float[np.ndarray, "N 2"]:
    """Return 1 where [left, right] is on the floor, 0 where it is in the air, NaN where the events do not tell.

    A foot's state is known between two events of a bout that follow each other (initial contact, toe-off); before its
    first event it is the other one, from the first event of the bout on, and after its last likewise.
    """
    contact = np.full((len(time_s), 2), np.nan)
    for bout in sorted({e.bout for e in events}):
        inside = sorted((e for e in events if e.bout == bout), key=lambda e: e.time_s)
        start, end = inside[0].time_s, inside[-1].time_s
        for k, side in enumerate(SIDES):
            own = [e for e in inside if e.side == side]
            for a, b in zip([None, *own], [*own, None], strict=True):
                known = a is None or b is None or a.event != b.event
                on = (a.event == FOOT_DOWN) if a is not None else (b is not None and b.event != FOOT_DOWN)
                if known and own:
                    at = (time_s >= (start if a is None else a.time_s)) & (time_s < (end if b is None else b.time_s))
                    contact[at, k] = float(on)
    return contact


def ground_reaction(
    body: Body,
    scale: np.ndarray,
    d: Dynamics,
    contact: Float[np.ndarray, "N 2"],
    vertical_n: Float[np.ndarray, " N"] | None = None,
) -> GroundReaction:
    """Return each foot's ground reaction of the motion `d`. `contact` (N, 2): `contact_of` its times. `vertical_n`: the
    vertical force of both feet, where it is not `needed_vertical`."""
    known = np.all(np.isfinite(contact), axis=1)
    stands = (contact == 1) & known[:, None]
    centre = np.stack([_pressure(body, scale, d, contact[:, k], k) for k in (0, 1)], axis=1)
    whole = needed_vertical(d, stands) if vertical_n is None else vertical_n
    vertical = _shares(stands) * np.maximum(whole, 0.0)[:, None]
    turns = d.moment_nm - np.cross(d.centre_m, d.force_n)
    past = np.stack([-turns[:, 1], turns[:, 0]], axis=1) / np.maximum(d.force_n[:, 2:], 0.1 * GRAVITY)
    level = _leans(stands)[..., None] * _towards(d, centre, vertical, past, stands)
    level += _mean_shift(body, d, level, vertical, stands.any(axis=1))
    share = vertical / np.maximum(vertical.sum(axis=1, keepdims=True), 1e-9)
    level += BELIEVED * share[..., None] * (d.force_n[:, None, :2] - level.sum(axis=1, keepdims=True))
    size = np.linalg.norm(level, axis=-1)
    level *= np.minimum(1.0, FRICTION * vertical / np.maximum(size, 1e-9))[..., None]
    force = np.concatenate([level, vertical[..., None]], axis=-1)
    force[~known] = np.nan
    centre[~stands] = np.nan
    left = d.force_n - force.sum(axis=1)
    moment = d.moment_nm - np.cross(np.nan_to_num(centre), force).sum(axis=1) - np.cross(d.centre_m, left)
    return GroundReaction(np.where(known[:, None], contact, np.nan), force, centre, left, moment)


def trailing_share(phase: np.ndarray) -> np.ndarray:
    """Return the share of the vertical force that the foot behind carries at the phase (0 to 1) of double support."""
    return _course(phase, TRAILING)


def _course(phase: np.ndarray, values: Sequence[float]) -> np.ndarray:
    return np.interp(phase, np.linspace(0.0, 1.0, len(values)), values)


def needed_vertical(d: Dynamics, stands: np.ndarray) -> Float[np.ndarray, " N"]:
    """Return the vertical force (N/kg) of both feet that the motion needs, with the sharp changes that it lacks
    (`TRANSIENT`). `stands` (N, 2): whether [left, right] is on the floor."""
    return d.force_n[:, 2] + _transient(d.force_n[:, 2], stands)


def _transient(vertical: np.ndarray, stands: np.ndarray) -> np.ndarray:
    """Return `TRANSIENT` over each double and single support that is seen from its first to its last moment, 0
    elsewhere."""
    out = np.zeros(len(vertical))
    feet = stands.sum(axis=1)
    if feet.any():
        size = float(np.subtract(*np.percentile(vertical[feet > 0], [95, 5])))
        for n, values in zip((2, 1), TRANSIENT, strict=True):
            for run in runs(feet == n):
                if run.start > 0 and run.stop < len(vertical):
                    out[run] = size * _course(_phase(run), values)
    return out


def phases(there: np.ndarray, known: np.ndarray) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield the rows of each run of `there` (N,) and the phase (0 to 1) in each. A run of which the frame before or
    after it is not `known` (N,) is seen in part: it is taken to last as long as the others (the median)."""
    seen = np.concatenate([[False], known, [False]])
    found = [(run, run.stop - run.start, seen[run.start], seen[run.stop + 1]) for run in runs(there)]
    whole = [n for _, n, began, ended in found if began and ended]
    for run, n, began, ended in found:
        full = n if (began and ended) or not whole else max(n, int(np.median(whole)))
        yield run, (np.arange(n) + 0.5 + (0 if began else full - n)) / full


def _phase(run: slice) -> np.ndarray:
    return (np.arange(run.stop - run.start) + 0.5) / (run.stop - run.start)


def _double_support(stands: np.ndarray) -> Iterator[tuple[slice, int | None]]:
    """Yield the rows of each double support and the foot behind: the one that stood alone before; if that was not seen,
    the one that does not stand alone after; None if neither was."""
    for run in runs(np.all(stands, axis=1)):
        if run.start > 0 and stands[run.start - 1].any():
            yield run, int(stands[run.start - 1, 1])
        elif run.stop < len(stands) and stands[run.stop].any():
            yield run, int(stands[run.stop, 0])
        else:
            yield run, None


def _shares(stands: np.ndarray) -> np.ndarray:
    """Return the fraction (N, 2) of the vertical force of each foot; 0 where none stands."""
    share = stands.astype(float)
    for run, behind in _double_support(stands):
        falls = 0.5 if behind is None else trailing_share(_phase(run))
        share[run, behind or 0], share[run, 1 - (behind or 0)] = falls, 1.0 - falls
    return share


def _leans(stands: np.ndarray) -> np.ndarray:
    """Return `LEANS` (N, 2) of each foot over each double support, 1 elsewhere."""
    lean = np.ones(stands.shape)
    for run, behind in _double_support(stands):
        if behind is not None:
            for foot, values in zip((behind, 1 - behind), LEANS, strict=True):
                lean[run, foot] = _course(_phase(run), values)
    return lean


def _towards(d: Dynamics, centre: np.ndarray, vertical: np.ndarray, past: np.ndarray, stands: np.ndarray) -> np.ndarray:
    """Return horizontal forces (N, 2, 2) that point from each centre of pressure at the centre of mass, and past it."""
    lever = d.centre_m[:, None] - centre
    level = vertical[..., None] * (lever[..., :2] + past[:, None]) / np.maximum(lever[..., 2:], 0.1)
    return np.where(stands[..., None], level, 0.0)


def _mean_shift(body: Body, d: Dynamics, level: np.ndarray, vertical: np.ndarray, use: np.ndarray) -> np.ndarray:
    """Return what to add to `level` (N, 2, 2) so that its sum has the mean of the motion's force forward and aside."""
    if not use.any():
        return np.zeros_like(level)
    ahead = d.xmat[:, body.body_names.index("pelvis"), :2, 0]
    ahead = ahead / np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-9)
    axes = np.stack([ahead, np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)], axis=1)  # (N, 2, 2): forward, left
    missing = np.einsum("nij,nj->ni", axes, d.force_n[:, :2] - level.sum(axis=1))[use].mean(axis=0)
    per_vertical = missing / vertical.sum(axis=1)[use].mean()
    return vertical[..., None] * np.einsum("nij,i->nj", axes, per_vertical)[:, None]


def _pressure(body: Body, scale: np.ndarray, d: Dynamics, contact: np.ndarray, k: int) -> np.ndarray:
    """Return the centre of pressure (N, 3) of foot `k` [left, right] by `PROGRESS`; NaN where it does not stand."""
    sole = _sole(body, scale, d, contact, "lr"[k])
    place = np.full((len(contact), 2), np.nan)
    for run, phase in phases(contact == 1, np.isfinite(contact)):
        for i in (0, 1):
            place[run, i] = np.interp(phase, PROGRESS[:, 0], PROGRESS[:, i + 1])
    forefoot = _FOREFOOT * np.clip(np.interp(sole.lifted / sole.length, _HEEL_OFF, (0.0, 1.0)), 0.0, 1.0)
    return sole.point(np.maximum(place[:, 0], forefoot), place[:, 1] * (1 if k == 0 else -1))


def _sole(body: Body, scale: np.ndarray, d: Dynamics, contact: np.ndarray, side: str) -> _Sole:
    calcn, toes = (body.body_names.index(f"{name}_{side}") for name in ("calcn", "toes"))
    own = float(np.asarray(scale)[body.scale_index[calcn]])
    heel, ball = (d.xpos[:, calcn] + d.xmat[:, calcn] @ (own * np.array(p)) for p in (_HEEL_M, _BALL_M))
    tip = d.xpos[:, toes] + d.xmat[:, toes] @ (own * np.array(_TIP_M))
    axis = (tip - heel)[:, :2]
    length = own * float(np.linalg.norm(np.array(_TIP_M) + body.mj_model.body_pos[toes + 1] - _HEEL_M))
    lowest = np.minimum(np.minimum(heel[:, 2], ball[:, 2]), tip[:, 2])
    floor = np.full(len(heel), np.nan)
    for run in runs(contact == 1):
        floor[run] = np.median(lowest[run])
    along = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
    # A foot on its toes keeps its length: its tip stays in place.
    return _Sole(tip[:, :2] - length * along, heel[:, 2] - floor, along, length, floor)
