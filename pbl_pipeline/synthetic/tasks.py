"""Plans of the tasks: walking, standing, sit-to-stand, squat, timed up and go, four-square steps.

Every plan starts at the origin and faces along x; `Plan.moved` places it before a camera.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait.normative import GRAVITY, gait_norm

from .impair import Style
from .plan import GRID_STEP_S, MARGIN_S, Plan, Step, ease, grid, wander, within

#: How strides differ within a walk: step time (fraction), footprint along and across (m). The project's own numbers, of
#: the size that is usual in healthy adults (a few percent).
STEP_TIME_SD, ALONG_SD_M, ACROSS_SD_M = 0.018, 0.008, 0.008
#: Distance between the heels' lines, and by how much the feet point outwards, of a person (mean, sd).
WIDTH_M, TOE_OUT_DEG = (0.11, 0.015), (6.0, 2.0)
#: Standing: distance between the heels.
STANCE_WIDTH_M = 0.20
#: The pelvis is over the foot at this fraction of the stride after initial contact.
OVER_FOOT = 0.29
#: How the speed differs between people, dimensionless (Schwartz et al. 2008, "free").
SPEED_SD = 0.026
#: The way of a timed up and go, and a square of the four-square step test (m).
TUG_WAY_M, SQUARE_M = 3.0, 0.65


@dataclasses.dataclass(frozen=True)
class Walker:
    """Data of a person for the plans: leg length, pelvis to calcaneus ahead when standing (m), seed, style."""

    leg_m: float
    heel_ahead_m: float
    seed: int
    style: Style
    speed_m_per_s: float | None = None

    def speed(self) -> float:
        """Speed (m/s): asked for, or the person's own with what the impairments take from it."""
        rng = np.random.default_rng([self.seed, 12])
        own = within(rng, float(gait_norm().speed[2]), SPEED_SD) * np.sqrt(GRAVITY * self.leg_m)
        if self.speed_m_per_s is not None:
            return self.speed_m_per_s
        return own * self.style.step_length * self.style.cadence

    def step_s(self) -> float:
        """Mean step time (s) at that speed."""
        healthy = self.speed() / (self.style.step_length * self.style.cadence)
        cadence = gait_norm().cadence_at(healthy / np.sqrt(GRAVITY * self.leg_m)) * self.style.cadence
        return float(np.sqrt(self.leg_m / GRAVITY) / cadence)

    def foot_off(self) -> float:
        """Fraction of the stride that a foot stands."""
        return gait_norm().foot_off_at(self.speed() / np.sqrt(GRAVITY * self.leg_m))

    def base(self) -> tuple[float, float]:
        """Distance between the heels (m) and toe-out (rad)."""
        rng = np.random.default_rng([self.seed, 13])
        return within(rng, *WIDTH_M) + self.style.width_m, float(np.radians(within(rng, *TOE_OUT_DEG)))


def walk(walker: Walker, seconds: float) -> Plan:
    """Steady walking straight ahead."""
    t = grid(seconds)
    v = np.full(len(t), walker.speed())
    xy = np.column_stack([walker.speed() * t, np.zeros(len(t))])
    steps = _steps(walker, t, xy, np.zeros(len(t)), t[0] - 3.0, t[-1] + 3.0)
    return Plan(t, xy, np.zeros(len(t)), np.ones(len(t)), v, steps, {})


def standing(walker: Walker, seconds: float) -> Plan:
    """Quiet standing with the sway of a healthy person."""
    t = grid(seconds)
    rng = np.random.default_rng([walker.seed, 14])
    sway = {
        "ankle_angle": wander(rng, t, 0.5, 0.05, 0.8),
        "hip_flexion": -1.0 + wander(rng, t, 0.5, 0.05, 0.8),
        "lumbar_extension": wander(rng, t, 0.7, 0.05, 0.8),
    }
    sway["ankle_angle"] += 2.0
    return _in_place(walker, t, sway)


def sit_to_stand(walker: Walker, seconds: float) -> Plan:
    """Up from a chair and down again, about every four seconds, starting seated."""
    t = grid(seconds)
    rng = np.random.default_rng([walker.seed, 15])
    seated, lean = np.ones(len(t)), np.zeros(len(t))
    at = 0.5 + within(rng, 0.1, 0.1)
    while at < t[-1]:
        rise = within(rng, 1.7, 0.15)
        down = at + rise + within(rng, 0.6, 0.1)
        _rise(t, seated, lean, at, rise, up=True)
        _rise(t, seated, lean, down, rise + 0.2, up=False)
        at = down + rise + 0.2 + within(rng, 0.6, 0.1)
    return _in_place(walker, t, _seat(seated, lean))


def squat(walker: Walker, seconds: float) -> Plan:
    """Squats of about 2.6 s with a pause between, arms forward."""
    t = grid(seconds)
    rng = np.random.default_rng([walker.seed, 16])
    depth = np.zeros(len(t))
    deep = within(rng, 0.9, 0.07)
    at = 0.5
    while at < t[-1]:
        one_way = within(rng, 1.3, 0.1)
        depth += deep * (ease((t - at) / one_way) - ease((t - at - one_way) / one_way))
        at += 2 * one_way + within(rng, 0.4, 0.1)
    thigh, shank = 2 + 83 * depth, 2 + 28 * depth
    tilt = 1 - 16 * depth
    angles = {
        "hip_flexion": thigh - tilt,
        "knee_flexion": thigh + shank,
        "ankle_angle": shank,
        "tilt": tilt,
        "lumbar_extension": -24 * depth,
        "arm_flex": -5 + 85 * depth,
        "elbow_flex": 15 + 0 * depth,
    }
    return _in_place(walker, t, angles, width_m=0.28)


def timed_up_and_go(walker: Walker, seconds: float | None) -> Plan:
    """Up from a chair, 3 m ahead, turn by half, back, turn by half, down. It lasts as long as it lasts."""
    rng = np.random.default_rng([walker.seed, 17])
    rise, down_s = within(rng, 1.7, 0.15), within(rng, 1.9, 0.15)
    v, turn_s, slow = walker.speed(), within(rng, 2.2, 0.15), 0.28
    # The speed is smoothed below: the way begins half a second before `start` and ends as long after `stop`.
    start = 1.0 + rise
    straight_s = TUG_WAY_M / v + 0.5
    first = start + straight_s
    second = first + turn_s + straight_s
    stop = second + turn_s
    end = stop + 1.0 + down_s + 0.5
    t = grid(end)
    raw = np.where((t > start) & (t < stop), v, 0.0)
    for corner in (first, second):
        raw = np.where((t >= corner) & (t < corner + turn_s), slow, raw)
    speed = gaussian_filter1d(raw, 0.25 / GRID_STEP_S, mode="nearest")
    heading = np.pi * (ease((t - first) / turn_s) + ease((t - second) / turn_s))
    step = GRID_STEP_S * speed[:, None] * np.column_stack([np.cos(heading), np.sin(heading)])
    xy = np.cumsum(step, axis=0) - step[0]
    steps = _steps(walker, t, xy, heading, start, stop, stands=True)
    seated, lean = np.ones(len(t)), np.zeros(len(t))
    _rise(t, seated, lean, 0.5, rise, up=True)
    _rise(t, seated, lean, stop + 1.0, down_s, up=False)
    on_path = ease((t - start + 0.9) / 0.6) * (1 - ease((t - stop - 0.4) / 0.6))
    return _cut(Plan(t, xy, heading, on_path, speed, steps, _seat(seated, lean)), seconds, end)


def four_square(walker: Walker, seconds: float | None) -> Plan:
    """Ahead, right, back, left through four squares, then the same way back, always facing ahead."""
    rng = np.random.default_rng([walker.seed, 18])
    moves = [(1, 0), (0, -1), (-1, 0), (0, 1), (0, -1), (1, 0), (0, 1), (-1, 0)]
    at, where, t_moves = 0.6, np.zeros(2), []
    for move in moves:
        length = within(rng, 1.25, 0.06)
        t_moves.append((at, length, np.array(move, float)))
        at += length + within(rng, 0.12, 0.03)
    end = at + 0.5
    t = grid(end)
    xy = np.zeros((len(t), 2))
    half = 0.5 * (STANCE_WIDTH_M + walker.style.width_m)
    standing_at = {"r": (-np.inf, np.zeros(2)), "l": (-np.inf, np.zeros(2))}
    _, toe_out = walker.base()
    steps = []

    def stance(side: str, up_s: float) -> None:
        down_s, place = standing_at[side]
        steps.append(_footprint(walker, side, down_s, up_s, place, 0.0, half, toe_out, 0.6))

    for begin, length, move in t_moves:
        target = where + SQUARE_M * move + rng.normal(0, 0.015, 2)
        xy += ease((t - begin) / length)[:, None] * (target - where)
        lead = "r" if move[0] > 0 or move[1] < 0 else "l"
        for side, up, down in ((lead, 0.04, 0.42), ("l" if lead == "r" else "r", 0.54, 0.94)):
            stance(side, begin + up * length)
            standing_at[side] = (begin + down * length, target)
        where = target
    for side in "rl":
        stance(side, np.inf)
    speed = np.zeros(len(t))
    steps.sort(key=lambda s: s.down_s)
    return _cut(Plan(t, xy, np.zeros(len(t)), np.ones(len(t)), speed, tuple(steps), {}), seconds, end)


def _steps(walker, t, xy, heading, start_s: float, stop_s: float, *, stands: bool = False) -> tuple[Step, ...]:
    """Footprints of a walk along a way; where it `stands` at the ends, both feet start and end side by side."""
    rng = np.random.default_rng([walker.seed, 19])
    mean, foot_off = walker.step_s(), walker.foot_off()
    width, toe_out = walker.base()
    first = 0.1 if stands else mean * rng.random()
    n = max(2, int(np.ceil((stop_s - start_s - first) / mean)) + (1 if stands else 0))
    ideal = start_s + first + mean * np.arange(n)
    # Independent of each other about an even beat, so that a walk keeps its cadence; sqrt(2): of the time between two.
    down = ideal + np.clip(rng.standard_normal(n), -2, 2) * STEP_TIME_SD * mean / np.sqrt(2)
    right_first = int(rng.random() < 0.5)
    side = ["r" if (k + right_first) % 2 else "l" for k in range(n)]
    down = down + np.array([2 * mean * walker.style.late_down[s] for s in side])
    swing = (1 - foot_off) * 2 * mean
    along, across = (np.clip(rng.standard_normal((2, n)), -2, 2).T * [ALONG_SD_M, ACROSS_SD_M]).T
    over = OVER_FOOT * 2 * mean

    def place(when: float) -> tuple[np.ndarray, float]:
        # Beyond the grid the walk goes on as it was at its end.
        inside = float(np.clip(when, t[0], t[-1]))
        edge = 0 if when < t[0] else -1
        ahead = np.array([np.cos(heading[edge]), np.sin(heading[edge])])
        v = 0.0 if stands else walker.speed()
        point = np.array([np.interp(inside, t, xy[:, i]) for i in range(2)]) + (when - inside) * v * ahead
        return point, float(np.interp(inside, t, heading))

    lifts = {s: [] for s in "rl"}
    for s, d in zip(side, down, strict=True):
        late = 2 * mean * walker.style.late_down[s]
        lifts[s].append(d - swing - late)
    out = []
    rest = 0.5 * (STANCE_WIDTH_M + walker.style.width_m)
    nominal = foot_off * 2 * mean
    if stands:
        for s in "rl":
            out.append(_footprint(walker, s, -np.inf, lifts[s][0], xy[0], heading[0], rest, toe_out, nominal))
    seen = {"r": 0, "l": 0}
    for k, (s, d) in enumerate(zip(side, down, strict=True)):
        seen[s] += 1
        last = seen[s] == len(lifts[s])
        up = lifts[s][seen[s]] if not last else (np.inf if stands else d + nominal)
        # Where a foot lands late it lands where it would have landed: the way does not wait.
        point, faces = place(d - 2 * mean * walker.style.late_down[s] + over)
        half = rest if stands and last else 0.5 * width
        ahead, left = np.array([np.cos(faces), np.sin(faces)]), np.array([-np.sin(faces), np.cos(faces)])
        spot = point + along[k] * ahead + across[k] * left
        out.append(_footprint(walker, s, d, up, spot, faces, half, toe_out, nominal))
    return tuple(sorted(out, key=lambda x: x.down_s))


def _footprint(walker, side, down_s, up_s, point, faces, half_m, toe_out, nominal_s) -> Step:
    sign = -1.0 if side == "r" else 1.0
    ahead, left = np.array([np.cos(faces), np.sin(faces)]), np.array([-np.sin(faces), np.cos(faces)])
    at = point + walker.heel_ahead_m * ahead + sign * half_m * left
    forefoot = walker.style.forefoot[side] if np.isfinite(down_s) else 0.0
    return Step(
        side, float(down_s), float(up_s), (float(at[0]), float(at[1])), faces + sign * toe_out, nominal_s, forefoot
    )


def _in_place(walker: Walker, t: np.ndarray, posture: dict[str, np.ndarray], width_m: float = STANCE_WIDTH_M) -> Plan:
    half = 0.5 * (width_m + walker.style.width_m)
    _, toe_out = walker.base()
    steps = tuple(_footprint(walker, s, -np.inf, np.inf, np.zeros(2), 0.0, half, toe_out, 0.6) for s in "rl")
    still = np.zeros(len(t))
    return Plan(t, np.zeros((len(t), 2)), still, still, still, steps, posture)


def _rise(t, seated: np.ndarray, lean: np.ndarray, at_s: float, length_s: float, *, up: bool) -> None:
    """Add one rise or one sitting down: the hips move in the later (earlier) part, the trunk leans around it."""
    fraction = (t - at_s) / length_s
    if up:
        seated -= ease((fraction - 0.3) / 0.7)
        lean += ease(fraction / 0.45) - ease((fraction - 0.45) / 0.5)
    else:
        seated += ease(fraction / 0.75)
        lean += ease(fraction / 0.55) - ease((fraction - 0.55) / 0.45)


def _seat(seated: np.ndarray, lean: np.ndarray) -> dict[str, np.ndarray]:
    thigh, shank = 2 + 83 * seated, 2 + 4 * seated + 12 * lean * (1 - seated)
    tilt = 1 + 9 * seated - 22 * lean
    return {
        "hip_flexion": thigh - tilt,
        "knee_flexion": thigh + shank,
        "ankle_angle": shank,
        "tilt": tilt,
        "lumbar_extension": -6 * seated - 16 * lean - 12 * (1 - (1 - seated) * (1 - lean)),
        "arm_flex": -5 + 30 * seated + 12 * lean,
        "elbow_flex": 15 + 35 * seated,
    }


def _cut(plan: Plan, seconds: float | None, end_s: float) -> Plan:
    """Only the first seconds, or a refusal of more than the task lasts."""
    if seconds is not None and seconds > end_s:
        raise PblError(
            "USAGE",
            found=f"{seconds:g} s of a task that lasts {end_s:.1f} s with this seed",
            expected=f"at most {end_s:.1f} s",
            next_step="leave --seconds out for the whole task",
        )
    return plan


def duration_s(plan: Plan) -> float:
    """Duration of the motion of a plan (s), without the margins of its grid."""
    return float(plan.grid_s[-1] - MARGIN_S)
