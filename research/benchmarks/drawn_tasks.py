"""Counts and times of tasks on drawn movements whose times are known by construction.

    python -m research.benchmarks.drawn_tasks                        # 500 cases of each task, held out
    python -m research.benchmarks.drawn_tasks --seeds 0 99 --list    # those that were looked at, with each miss

A case draws a person, a seat, the movement and the error of a fit, and makes joint centres in 3D: angles of both legs,
trunk and heading of the pelvis with an error that is smooth in time and one that is not, a drift of the vertical, and
points that err by millimetres. Sit-to-stand: seats of 0.30 to 0.55 m, feet forward or drawn back, hesitations, attempts
that end at 50 to 90 % of the way, touch-and-go, use of arms, fidgeting. Timed up and go: seats up to 40 deg askew at
both ends, turns of 140 to 220 deg either way, ways that bend, 0.3 to 1.4 m/s. Squats of several depths.

Prints for each count how often it is right and for each time its root mean square error, mean and largest error and in
how many cases it is unknown. Exit code 1 where a bar is missed.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Callable

import click
import numpy as np
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.gait import TaskMotion, task_measures

#: The smooth error's sd (deg) and time constant (s), the other error's sd (deg), and of points (m).
SMOOTH_DEG, SMOOTH_S, JITTER_DEG, JITTER_M = 2.5, 0.4, 0.8, 0.004
#: Error of the height of the hips by the vertical's drift: sd (m), time constant (s).
DRIFT_M, DRIFT_S = 0.008, 2.0
#: Bars: counts right, rms of five rises and of the parts of a TUG (s), unknown.
RIGHT, FIVE_S, PART_S, UNKNOWN = 0.99, 0.10, 0.15, 0.05


@dataclasses.dataclass(frozen=True)
class DrawnTask:
    """A movement and its true values: counts, and mean times (s) by the names of `TASK_MEASURES`."""

    task: str
    seed: int
    motion: TaskMotion
    truth: dict[str, float | None]


def drawn_task(task: str, seed: int) -> DrawnTask:
    """Return the movement of a task that a seed draws."""
    return DRAWN[task](seed)


def ease(x: np.ndarray, sharp: float = 1.0) -> np.ndarray:
    """Return the way from 0 to 1 with the least jerk; `sharp` above 1 starts slowly."""
    x = np.clip(x, 0.0, 1.0) ** sharp
    return 10 * x**3 - 15 * x**4 + 6 * x**5


def _crossing(t: np.ndarray, way: np.ndarray, fraction: float) -> float:
    """Return when a way from its first to its last value has first covered a fraction (s)."""
    done = (way - way[0]) / (way[-1] - way[0])
    return float(t[int(np.argmax(done >= fraction))])


@dataclasses.dataclass(frozen=True)
class _Seat:
    """A person's segments (m) and angles (deg) seated and standing."""

    thigh_m: float
    shank_m: float
    shank_deg: tuple[float, float]
    stand_thigh_deg: float
    hip_m: tuple[float, float]

    @classmethod
    def draw(cls, rng: np.random.Generator, seat_m: tuple[float, float] = (0.30, 0.55)) -> _Seat:
        size = rng.uniform(0.9, 1.1)
        thigh, shank, ankle = 0.43 * size, 0.42 * size, 0.08
        sits, stands = rng.uniform(-8, 20), rng.uniform(1, 6)
        crouch = rng.uniform(1, 5) if rng.random() < 0.8 else rng.uniform(5, 16)
        top = shank * np.cos(np.radians(stands)) + thigh * np.cos(np.radians(crouch))
        # The hips' centres are some 8 cm over a seat; the lowest seats leave a rise of a tenth of the body at least.
        bottom = min(rng.uniform(*seat_m) + 0.08 * size - ankle, top - 0.15)
        return cls(thigh, shank, (sits, stands), crouch, (bottom, top))

    def legs(self, up: np.ndarray, bump_deg: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
        """Return inclinations of thigh and shank (deg) with the hips at a fraction of the way up."""
        sits, stands = self.shank_deg
        shank = stands + (sits - stands) * (1 - up) + bump_deg * 4 * up * (1 - up) * (up < 1)
        height = self.hip_m[0] + up * (self.hip_m[1] - self.hip_m[0])
        cosine = (height - self.shank_m * np.cos(np.radians(shank))) / self.thigh_m
        return np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))), shank


def _smooth_noise(rng: np.random.Generator, n: int, fps: float, sd: float, time_s: float) -> np.ndarray:
    pad = int(6 * time_s * fps)
    noise = gaussian_filter1d(rng.standard_normal(n + 2 * pad), time_s * fps)[pad : pad + n]
    return sd * noise * np.sqrt(2 * np.sqrt(np.pi) * time_s * fps)


def _motion(
    rng: np.random.Generator,
    t: np.ndarray,
    seat: _Seat,
    legs: tuple[np.ndarray, np.ndarray],
    lean: np.ndarray,
    heading: np.ndarray,
    swing: np.ndarray,
) -> TaskMotion:
    """Return the motion of points of a person with the errors of a fit; `swing` (T, 2, 2) adds to thigh and shank of
    the left and the right leg (deg)."""
    n, fps = len(t), 1 / (t[1] - t[0])

    def err(scale: float = 1.0) -> np.ndarray:
        jitter = JITTER_DEG * rng.standard_normal(n)
        return scale * (_smooth_noise(rng, n, fps, SMOOTH_DEG, SMOOTH_S) + jitter)

    faces = np.radians(heading + err())
    ahead = np.stack([np.cos(faces), np.sin(faces), 0 * t], axis=1)
    left = np.stack([-np.sin(faces), np.cos(faces), 0 * t], axis=1)
    up = np.array([0.0, 0.0, 1.0])

    def segment(deg: np.ndarray, length_m: float) -> np.ndarray:
        """From the lower to the upper end; positive angles lean the upper end backwards."""
        a = np.radians(deg)[:, None]
        return length_m * (np.cos(a) * up - np.sin(a) * ahead)

    hips, knees, ankles = (np.empty((n, 2, 3)) for _ in range(3))
    both = [err(0.55), err(0.85)]  # as in fits, the height of the hips errs less than independent angles would say
    for s, sign in enumerate((1.0, -1.0)):
        hips[:, s] = 0.085 * sign * left
        thigh = legs[0] + swing[:, s, 0] + both[0] + err(0.55)
        shank = legs[1] + swing[:, s, 1] + both[1] + err(0.85)
        # A shank leans forwards where a thigh leans backwards.
        knees[:, s] = hips[:, s] - segment(thigh, seat.thigh_m)
        ankles[:, s] = knees[:, s] - segment(-shank, seat.shank_m)
    ankles += _smooth_noise(rng, n, fps, DRIFT_M, DRIFT_S)[:, None, None] * up
    trunk = np.radians(lean + err())[:, None]
    shoulders = hips + 0.5 * (np.cos(trunk) * up + np.sin(trunk) * ahead)[:, None]
    points = [p + JITTER_M * rng.standard_normal(p.shape) for p in (hips, knees, ankles, shoulders)]
    return TaskMotion.of_points(t, *points)


class _Height:
    """Fraction of the way up over time, drawn move by move."""

    def __init__(self, rng: np.random.Generator, fps: float):
        self.rng, self.fps, self.parts = rng, fps, [np.zeros(0)]

    @property
    def now_s(self) -> float:
        return sum(map(len, self.parts)) / self.fps

    def stay(self, level: float, time_s: float) -> None:
        self.parts.append(np.full(int(time_s * self.fps), level))

    def move(self, begin: float, end: float, time_s: float, pause: tuple[float, float] | None = None) -> tuple:
        """Move, with a pause (fraction, s) if there is one; return when it begins and ends: at 15 and 85 % (s).

        An attempt begins as a rise does, at 15 % of the way to standing.
        """
        x = np.linspace(0, 1, max(3, int(time_s * self.fps)))
        way = begin + (end - begin) * ease(x, self.rng.uniform(0.85, 1.2))
        if pause is not None:
            at = int(np.argmax(ease(x) >= pause[0]))
            # It slows down to a stop and goes on: two movements.
            first = begin + (way[at] - begin) * ease(np.linspace(0, 1, max(3, at)))
            second = way[at] + (end - way[at]) * ease(np.linspace(0, 1, max(3, len(x) - at)))
            way = np.concatenate([first, np.full(int(pause[1] * self.fps), way[at]), second])
        t = self.now_s + np.arange(len(way)) / self.fps
        self.parts.append(way)
        return _crossing(t, way, 0.15 / (abs(end) if begin == 0.0 else 1.0)), _crossing(t, way, 0.85)

    def way(self) -> np.ndarray:
        return np.concatenate(self.parts)


def _fidget(rng: np.random.Generator, height: _Height, level: float, time_s: float) -> None:
    """Stay, with a small movement of the hips now and then."""
    if time_s > 0.8 and rng.random() < 0.5:
        before, size = rng.uniform(0, time_s - 0.6), rng.uniform(0.02, 0.12) * (1 if level < 0.5 else -0.6)
        height.stay(level, before)
        height.move(level, level + size, rng.uniform(0.2, 0.5))
        height.move(level + size, level, rng.uniform(0.2, 0.5))
        time_s -= before
    height.stay(level, time_s)


def _sit_to_stand(seed: int) -> DrawnTask:
    rng = np.random.default_rng([seed, 501])
    fps = float(rng.choice([30.0, 60.0]))
    seat, height = _Seat.draw(rng), _Height(rng, fps)
    full = int(rng.choice([0, 1, 3, 4, 5, 6, 7], p=[0.02, 0.08, 0.1, 0.1, 0.5, 0.1, 0.1]))
    n_attempts = int(rng.choice([0, 0, 0, 1, 1, 2, 3]))
    items = rng.permutation([True] * full + [False] * n_attempts)
    pace = rng.uniform(0.7, 2.6)
    stay, arms, goes = rng.uniform(0.05, 1.5), rng.random() < 0.3, rng.random() < 0.3
    rises, sits, first, leans = [], [], None, []
    if rng.random() < 0.1:
        height.stay(1.0, rng.uniform(0.5, 2.0))
        sits.append(height.move(1.0, 0.0, pace))
    _fidget(rng, height, 0.0, rng.uniform(0.6, 3.0))
    for k, whole in enumerate(items):
        top = rng.uniform(0.98, 1.0) if whole else rng.uniform(0.5, 0.9)
        long = pace * rng.uniform(0.8, 1.25) * (1.2 if arms else 1.0) * (1.0 if whole else rng.uniform(0.5, 1.0))
        pause = (rng.uniform(0.2, 0.8), rng.uniform(0.2, 1.0)) if whole and rng.random() < 0.12 else None
        leans.append((height.now_s, long))
        move = height.move(0.0, top, long, pause)
        first = move[0] if first is None else first
        if whole:
            rises.append(move)
            _fidget(rng, height, top, stay * rng.uniform(0.5, 1.5))
            if k == len(items) - 1 and rng.random() < 0.3:
                height.stay(top, rng.uniform(0.2, 1.5))
                break
        else:
            height.stay(top, rng.uniform(0, 0.3))
        sit = height.move(top, 0.0, long * rng.uniform(0.7, 1.3))
        if whole:
            sits.append(sit)
        _fidget(rng, height, 0.0, rng.uniform(0.02, 0.3) if goes else rng.uniform(0.2, 2.0))
    else:
        height.stay(0.0, rng.uniform(0.4, 2.0))
    up = height.way()
    t = np.arange(len(up)) / fps
    lean = np.full(len(t), rng.uniform(0, 8))
    for at, long in leans:
        lean += (15.0 if arms else 35.0) * np.exp(-((t - at - 0.3 * long) ** 2) / (2 * (0.25 * long) ** 2))
    motion = _motion(rng, t, seat, seat.legs(up), lean, 0 * t, np.zeros((len(t), 2, 2)))
    truth: dict[str, float | None] = {
        "rise_count": float(full),
        "attempt_count": float(n_attempts),
        "five_rises_time_s": rises[4][1] - float(first or 0.0) if full >= 5 else None,
        "rise_time_s": float(np.mean([b - a for a, b in rises])) if rises else None,
        "sit_time_s": float(np.mean([b - a for a, b in sits])) if sits else None,
    }
    return DrawnTask("sit_to_stand", seed, motion, truth)


def _tug(seed: int) -> DrawnTask:
    rng = np.random.default_rng([seed, 502])
    fps = float(rng.choice([30.0, 60.0]))
    seat, height = _Seat.draw(rng), _Height(rng, fps)
    speed = rng.uniform(0.3, 1.4)
    slow = 1.4 - speed  # slow people rise and turn slowly, too
    _fidget(rng, height, 0.0, rng.uniform(0.6, 3.0))
    first = None
    if rng.random() < 0.1:
        top, long = rng.uniform(0.5, 0.85), rng.uniform(0.7, 1.5)
        first = height.move(0.0, top, long)[0]
        height.move(top, 0.0, long)
        height.stay(0.0, rng.uniform(0.3, 1.5))
    begin = height.now_s
    rise = height.move(0.0, 1.0, rng.uniform(0.8, 1.6) + slow * rng.uniform(0, 1.0))
    up_s = height.now_s
    way_s = rng.uniform(2.6, 3.2) / speed
    start = up_s + rng.uniform(-0.2, 0.8)  # of walking
    turn_1, turn_2 = start + way_s + 0.5, 0.0
    long_1, long_2 = (rng.uniform(1.0, 2.2) + slow * rng.uniform(0, 2.2) for _ in range(2))
    turn_2 = turn_1 + long_1 + way_s + 0.5
    sit_at = turn_2 + long_2 + rng.uniform(-0.3, 1.0)
    height.stay(1.0, sit_at - height.now_s)
    sit = height.move(1.0, 0.0, rng.uniform(0.9, 1.8) + slow * rng.uniform(0, 1.0))
    _fidget(rng, height, 0.0, rng.uniform(0.5, 2.5))
    up = height.way()
    t = np.arange(len(up)) / fps
    heading = np.full(len(t), rng.uniform(-180, 180))
    askew = rng.uniform(-40, 40)
    heading += askew * (1 - ease((t - begin - 0.5 * (up_s - begin)) / (start + rng.uniform(0.3, 1.0) - begin - 0.5)))
    way, parts = rng.choice([-1, 1]), []
    for at, long, sign in ((turn_1, long_1, way), (turn_2, long_2, way if rng.random() < 0.7 else -way)):
        turn = ease((t - at) / long, rng.uniform(0.85, 1.2))
        parts += [_crossing(t, turn, 0.15), _crossing(t, turn, 0.85)]
        heading += sign * rng.uniform(140, 220) * turn
    for a, b in ((start + 0.8, turn_1), (turn_1 + long_1, turn_2)):
        kind, size = rng.integers(4), rng.uniform(-25, 25)
        x = np.clip((t - a) / (b - a), 0, 1)
        # Straight, a bend, around something, an arc.
        heading += size * (0 * x, ease(x), np.sin(2 * np.pi * x), x)[kind]
    walks = ease((t - start) / 0.6) * (1 - ease((t - turn_2 - long_2 + 0.5) / 0.6))
    turning = ease((t - turn_1) / 0.4) - ease((t - turn_1 - long_1 + 0.4) / 0.4) + ease((t - turn_2) / 0.4)
    phase = 2 * np.pi * ((0.45 + 0.4 * speed) * t + rng.random()) + _smooth_noise(rng, len(t), fps, 0.3, 1.0)
    heading += walks * (1 - 0.5 * turning) * rng.uniform(2, 9) * np.sin(phase)
    swing = np.zeros((len(t), 2, 2))
    reach = (8 + 16 * speed / 1.4) * walks * (1 - 0.6 * turning)
    for s, shift in enumerate((0.0, np.pi)):
        swing[:, s, 0] = reach * np.sin(phase + shift)
        swing[:, s, 1] = -reach * np.sin(phase + shift) + 1.2 * reach * (1 + np.cos(phase + shift)) / 2
    lean = 5 + 35 * np.exp(-((t - begin - 0.4) ** 2) / 0.2)
    truth: dict[str, float | None] = {
        "tug_time_s": sit[1] - (rise[0] if first is None else first),
        "rise_time_s": rise[1] - rise[0],
        "walk_out_time_s": parts[0] - rise[1],
        "turn_time_s": parts[1] - parts[0],
        "walk_back_time_s": parts[2] - parts[1],
        "turn_to_sit_time_s": parts[3] - parts[2],
        "sit_time_s": sit[1] - sit[0],
    }
    return DrawnTask("tug", seed, _motion(rng, t, seat, seat.legs(up), lean, heading, swing), truth)


def _squat(seed: int) -> DrawnTask:
    rng = np.random.default_rng([seed, 503])
    fps = float(rng.choice([30.0, 60.0]))
    seat, height = _Seat.draw(rng), _Height(rng, fps)
    count, pace, depth = int(rng.integers(0, 9)), rng.uniform(0.7, 2.0), rng.uniform(0.32, 0.6)
    shallow = rng.random() < 0.15  # less than a quarter of the leg: none counts
    depth = rng.uniform(0.08, 0.18) if shallow else depth
    leg_m = seat.thigh_m + seat.shank_m
    seat = dataclasses.replace(seat, hip_m=(seat.hip_m[1] - leg_m, seat.hip_m[1]), shank_deg=(30.0, seat.shank_deg[1]))
    height.stay(1.0, rng.uniform(0.4, 2.0))
    times = []
    for _ in range(count):
        low = 1.0 - depth * rng.uniform(0.9, 1.1)
        down = height.move(1.0, low, pace * rng.uniform(0.8, 1.2))
        height.stay(low, rng.uniform(0, 0.8) if rng.random() < 0.5 else 0.0)
        up = height.move(low, 1.0, pace * rng.uniform(0.8, 1.2))
        times.append(up[1] - down[0])
        height.stay(1.0, rng.uniform(0.0, 1.0))
    height.stay(1.0, rng.uniform(0.2, 1.5))
    way = height.way()
    t = np.arange(len(way)) / fps
    motion = _motion(rng, t, seat, seat.legs(way), 5 + 60 * (1 - way), 0 * t, np.zeros((len(t), 2, 2)))
    truth = {
        "squat_count": 0.0 if shallow else float(count),
        "squat_time_s": float(np.mean(times)) if times and not shallow else None,
    }
    return DrawnTask("squat", seed, motion, truth)


DRAWN: dict[str, Callable[[int], DrawnTask]] = {"sit_to_stand": _sit_to_stand, "tug": _tug, "squat": _squat}


@dataclasses.dataclass(frozen=True)
class Found:
    """A measure of a drawn case: its error, None where it is unknown for the reason."""

    seed: int
    true: float
    error: float | None
    reason: str


def errors_of(task: str, seeds: range) -> dict[str, list[Found]]:
    """Return what was found by measure, for each case that has a true value."""
    found: dict[str, list[Found]] = {}
    for seed in seeds:
        case = drawn_task(task, seed)
        measures, reasons = task_measures(case.motion, task)
        for name, true in case.truth.items():
            mine = measures.get(name)
            if true is not None:
                error = None if mine is None else mine.mean - true
                found.setdefault(name, []).append(Found(seed, true, error, reasons.get(name, "")))
    return found


@click.command()
@click.option("--seeds", type=int, nargs=2, default=(2000, 2499), show_default=True, help="First and last seed.")
@click.option("--task", "tasks", type=click.Choice(list(DRAWN)), multiple=True, default=list(DRAWN))
@click.option("--list", "listed", is_flag=True, help="Also list each case that is off by more than a bar.")
def main(seeds: tuple[int, int], tasks: tuple[str, ...], listed: bool) -> None:
    """Print the errors; exit code 1 where a bar is missed."""
    missed = []
    click.echo(f"{'':36}{'n':>5}{'rms':>8}{'mean':>8}{'largest':>9}{'unknown':>9}{'right':>8}")
    for task in tasks:
        for name, cases in errors_of(task, range(seeds[0], seeds[1] + 1)).items():
            e = np.array([f.error for f in cases if f.error is not None])
            unknown, right = 1 - len(e) / len(cases), float(np.mean(e == 0))
            rms = float(np.sqrt(np.mean(e**2)))
            text = f"{rms:8.3f}{e.mean():8.3f}{np.abs(e).max():9.3f}{100 * unknown:8.1f}%"
            count, bar = name.endswith("_count"), FIVE_S if name.startswith("five") else PART_S
            click.echo(f"{f'{task}, {name}':36}{len(cases):5}{text}{f'{100 * right:7.1f}%' if count else ''}")
            if unknown > UNKNOWN or (right < RIGHT if count else rms > bar):
                missed.append(f"{task} {name}")
            for f in cases if listed else ():
                if f.error is None or abs(f.error) > (0 if count else 2 * bar):
                    error = "unknown" if f.error is None else f"{f.error:+.2f}"
                    click.echo(f"    seed {f.seed}: {error} of {f.true:.2f} {f.reason}")
    click.echo(f"missed: {', '.join(missed)}" if missed else "PASS")
    sys.exit(1 if missed else 0)


if __name__ == "__main__":
    main()
