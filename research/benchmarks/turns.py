"""Cycles of a bent path that count as walking, in slow and fast walks.

    python -m research.benchmarks.turns
    python -m research.benchmarks.turns --limit 0 --limit 20 --limit 30 --limit 40   # 0: by time, as version 1

Three parts, all by the default event method with the limit of `WalkingParams.max_turn_deg_per_stride` changed:
- straight walks: how far the heading seems to turn within a cycle where no one turns (90th and 99th percentile,
  largest), of synthetic people (`pbl synth`, true markers, and with 20 mm of noise) and of the laboratory's children
  (`../shared/data/real/gait_lab_c3d`). A limit below would lose them.
- circles on which a stride turns by so many degrees, at four speeds: the fraction of the strides that is kept.
- figures of eight of 4 by 1.4 m: fraction kept, and the true turn of the cycles that are kept (mean, largest).

Exit code 1 where the fraction kept on a circle differs by more than 0.15 between speeds, more than 15 degrees from the
limit.
"""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence

import click
import numpy as np

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.gait import FootTrajectories, detect_events, feet_from_markers, find_cycles
from pbl_pipeline.gait.events import METHODS, PhaseParams
from pbl_pipeline.gait.normative import GRAVITY, gait_norm
from pbl_pipeline.synthetic import SynthSpec, synthesise, true_markers
from pbl_pipeline.synthetic.plan import plain_walk
from research.benchmarks.events import feet_of_truth, lab_walks
from research.walker.path import floor_path
from research.walker.turns import turned

SPEEDS = (0.35, 0.7, 1.1, 1.6)
TURNS_DEG = (0, 10, 20, 30, 40, 50, 60, 80)
LEG_M = 0.9
MARKERS = "bml_movi_87"
FPS = 50.0


def stride_s(speed_m_per_s: float) -> float:
    """Stride time (s) of the norm at a speed."""
    cadence = gait_norm().cadence_at(speed_m_per_s / np.sqrt(GRAVITY * LEG_M))
    return float(2 * np.sqrt(LEG_M / GRAVITY) / cadence)


def on_way(time_s: np.ndarray, floor_m: np.ndarray, heading_rad: np.ndarray, stride: float) -> FootTrajectories:
    """Feet of a plain walk along points (T, 2) of the floor."""
    still = plain_walk(time_s, stride_s=stride, speed_m_per_s=0.0, heading_rad=0.0, start_m=(0.0, 0.0))
    qpos = turned(still, heading_rad)
    names = load_body().joint_names
    qpos[:, names.index("pelvis_tx")] += floor_m[:, 0]
    qpos[:, names.index("pelvis_tz")] -= floor_m[:, 1]
    markers = marker_set(MARKERS)
    return feet_from_markers(time_s, markers.names, MARKERS, true_markers(qpos, MARKERS))


def circle(speed: float, turn_deg: float, strides: int = 14) -> tuple[FootTrajectories, np.ndarray]:
    """Feet and headings (T,) of a walk whose every stride turns by so many degrees to the left."""
    stride = stride_s(speed)
    time = np.arange(0, strides * stride, 1 / FPS)
    heading = np.radians(turn_deg) * time / stride
    step = speed / FPS * np.column_stack([np.cos(heading), np.sin(heading)])
    return on_way(time, np.cumsum(step, axis=0), heading, stride), heading


def eight(speed: float, seed: int, strides: int = 40) -> tuple[FootTrajectories, np.ndarray]:
    """Feet and headings (T,) of a figure of eight."""
    stride = stride_s(speed)
    time = np.arange(0, strides * stride, 1 / FPS)
    floor, heading = floor_path(np.random.default_rng(seed), "eight", speed * time)
    return on_way(time, floor, heading, stride), heading


def method(limit_deg: float) -> PhaseParams:
    """The default event method with another limit; 0: that of version 1, by time."""
    params = METHODS["phase-transformer"].params
    return dataclasses.replace(params, walking=dataclasses.replace(params.walking, max_turn_deg_per_stride=limit_deg))


def turns_deg(feet: FootTrajectories, limit_deg: float, heading_rad: np.ndarray | None = None) -> np.ndarray:
    """Turn (deg) of each cycle that is found; of the heading that the feet show where the true one is not given."""
    if heading_rad is None:
        heading_rad = np.unwrap(np.arctan2(feet.forward[:, 1], feet.forward[:, 0]))
    cycles = find_cycles(detect_events(feet, method(limit_deg)))
    at = [np.interp([c.start_s, c.end_s], feet.time_s, heading_rad) for c in cycles]
    return np.degrees(np.abs([b - a for a, b in at]))


def straight_walks() -> dict[str, list[FootTrajectories]]:
    """Feet of people who walk straight ahead, by kind."""
    out: dict[str, list[FootTrajectories]] = {"synthetic": [], "synthetic, 20 mm of noise": []}
    for seed in range(700, 706):
        for speed in SPEEDS:
            spec = SynthSpec("walk", seed, noise="none", seconds=8.0, speed_m_per_s=speed, ground="treadmill")
            truth = synthesise(spec).truth
            noise = 0.02 * np.random.default_rng(seed).standard_normal(truth.markers_world_m.shape)
            out["synthetic"].append(feet_of_truth(truth, truth.markers_world_m))
            out["synthetic, 20 mm of noise"].append(feet_of_truth(truth, truth.markers_world_m + noise))
    out["laboratory"] = [walk.feet for walk in lab_walks() if walk.feet is not None]
    return out


@click.command()
@click.option("--limit", "limits", multiple=True, type=float, help="Degrees per stride; 0: by time.")
def main(limits: Sequence[float]) -> None:
    """Print which cycles count; exit code 1 where the fraction kept follows the speed."""
    default = METHODS["phase-transformer"].params.walking.max_turn_deg_per_stride
    limits, good = limits or (0.0, default), True
    click.echo("straight walks, turn of a cycle (deg): 90 %, 99 %, largest; cycles")
    for kind, walks in straight_walks().items():
        found = np.concatenate([turns_deg(feet, 360.0) for feet in walks])
        low, high = np.percentile(found, [90, 99])
        click.echo(f"  {kind:28}{low:7.1f}{high:7.1f}{found.max():7.1f}{len(found):6d}")
    for limit in limits:
        click.echo(f"limit {limit:g} deg per stride" if limit else "limit by time (version 1): 50 deg/s")
        click.echo("  circle, turn of a stride    " + "".join(f"{t:7d}" for t in TURNS_DEG))
        kept = {(v, t): len(turns_deg(circle(v, t)[0], limit)) / 26 for v in SPEEDS for t in TURNS_DEG}
        for v in SPEEDS:
            click.echo(f"    {v:4.2f} m/s, fraction kept    " + "".join(f"{kept[v, t]:7.2f}" for t in TURNS_DEG))
        spread = {t: np.ptp([kept[v, t] for v in SPEEDS]) for t in TURNS_DEG}
        if limit == default:
            good = all(s <= 0.15 for t, s in spread.items() if abs(t - limit) > 15)
        for v in SPEEDS:
            turn = np.concatenate([turns_deg(feet, limit, heading) for feet, heading in (eight(v, s) for s in (1, 2))])
            shown = f"{turn.mean():5.0f}{turn.max():5.0f}" if len(turn) else "    -    -"
            click.echo(f"  eight, {v:4.2f} m/s: kept {len(turn) / 156:5.2f}, their turn (deg) mean and largest{shown}")
    click.echo(f"bar: what is kept does not follow the speed: {'PASS' if good else 'FAIL'}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
