"""Forces from a phone against force plates, and against those of the exact motion.

    python -m research.benchmarks.kinetics_phone
    python -m research.benchmarks.kinetics_phone --walks recorded --detector metrabs-87
    python -m research.benchmarks.kinetics_phone --tilt 1

Known walks are seen by a phone that stands, from the front, the side and obliquely, with the measured errors of a
detector (`research.walker.detectors`), the body height stated:

- plates: the children's walks of `research.benchmarks.kinetics`; a measure is compared with that of the plates'
  forces, so its interval is judged as a whole. Events are the labels: the walks are too short for a cycle without ends;
- recorded: walks of other laboratories (`research.corpus`); synthetic: `pbl synth`. Fit and exact motion both go
  through the stage, so the interval is judged without the part of the method, which cancels.

With `--tilt` the fit's vertical is off by so many degrees, along the way to both sides.

For persons on whom numbers were chosen and for the others: the mean true measure, the error's mean and root mean square
over both sides and all views, the stated standard deviation, how many of the 90 % intervals hold the truth, and, of
the whole interval, how often the visit shows the measure. The same of the asymmetry (percent) from the front and
obliquely, where it may be shown, and the correlation of the errors of left and right there and from the side. Exit code
1 where the vertical force of the others is further off than the bar.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from collections.abc import Iterator, Mapping
from typing import NamedTuple
from unittest import mock

import click
import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, load_body, stature_m
from pbl_pipeline.fit import TrialFit, default_fit, fit_session
from pbl_pipeline.gait import GaitCycle, GaitEvents, find_cycles, gait_metrics
from pbl_pipeline.gait.events import SIDES
from pbl_pipeline.gait.laboratory import read_lab_trial
from pbl_pipeline.kinetics import MEASURES, METHODS, Kinetics, visit_kinetics
from pbl_pipeline.kinetics.compute import CYCLE_SD, HEALTHY_SD, MAX_ASYMMETRY_SD, METHOD_SD, too_uncertain, trial_series
from pbl_pipeline.kinetics.dynamics import GRID_HZ
from pbl_pipeline.results.measures import Z90
from research.benchmarks.kinetics import FOLDER, TUNING, fit_walk, read_walk, steps_of
from research.corpus.walks import Case, Walk, detector_model, recorded_walks, synthetic_walk
from research.paths import SHARED
from research.walker.detectors import DETECTORS

VIEWS = ("frontal", "sagittal", "oblique")
#: Marker set -> largest root mean square of the vertical force (% BW).
BARS = {"bml_movi_87": 6.0, "blazepose_33": 10.0}
#: How many synthetic walkers, and frames a second that a phone takes.
N_SYNTHETIC, RATE_HZ = 8, 30.0


class Labelled(NamedTuple):
    """Labelled gait of a walk (`kinetics.Walk`)."""

    events: GaitEvents
    cycles: tuple[GaitCycle, ...]
    pooled: bool = True


class Known(NamedTuple):
    """A known walk; of one with plates also its labels and the plates' measures of each side."""

    walk: Walk
    tuning: bool
    labels: Labelled | None = None
    plates: Mapping[str, Mapping[str, float]] | None = None


def known_walks(kind: str) -> Iterator[Known]:
    """Yield the walks of a kind: plates, recorded or synthetic."""
    if kind == "plates":
        for path in sorted(FOLDER.glob("Straight_*.c3d.gz")):
            lab = read_walk(path)
            fit = fit_walk(lab)
            seen = np.isfinite(fit.qpos).all(axis=1)
            time = np.arange(fit.time_s[seen][0], fit.time_s[seen][-1] - 1e-6, 1 / RATE_HZ)
            qpos = CubicSpline(fit.time_s[seen], fit.qpos[seen])(time)
            events = read_lab_trial(path).events
            walk = Walk(f"kid {lab.name[:-2]}", "recorded", kind, 0.0, time, qpos, fit.scale, events.events)
            plates = {SIDES[s.side]: s.true_measured for s in steps_of(lab, fit, METHODS.find().params.cutoff_hz)}
            labels = Labelled(events, tuple(find_cycles(events.events, keep_ends=True)))
            yield Known(walk, lab.name.startswith(TUNING), labels, plates)
    elif kind == "recorded":
        yield from (Known(w, not w.held_out) for w in recorded_walks(SHARED / "real" / "motions"))
    else:
        yield from (Known(w, not w.held_out) for w in map(synthetic_walk, range(N_SYNTHETIC)))


def tilted(fit: TrialFit, tilt_deg: float) -> TrialFit:
    """The fit in a world that is turned by an angle about the horizontal axis across the way, rising ahead."""
    names = (("pelvis_tx", "pelvis_ty", "pelvis_tz"), PELVIS_TURNS)
    place, turns = (np.array([fit.joint_names.index(n) for n in of]) for of in names)
    qpos, seen = fit.qpos.copy(), np.flatnonzero(np.isfinite(fit.qpos).all(axis=1))
    at, angles = qpos[np.ix_(seen, place)], qpos[np.ix_(seen, turns)]
    way = (at[-1] - at[0]) * [1.0, 0.0, 1.0]
    world = Rotation.from_rotvec(np.radians(tilt_deg) * np.cross(way / np.linalg.norm(way), [0.0, 1.0, 0.0]))
    turned = (world * Rotation.from_euler("ZXY", angles)).as_euler("ZXY")
    qpos[np.ix_(seen, place)] = world.apply(at)
    qpos[np.ix_(seen, turns)] = turned + 2 * np.pi * np.round((angles - turned) / (2 * np.pi))
    return dataclasses.replace(fit, qpos=qpos)


def forces(
    known: Known, view: str, detector: str, tilt_deg: float = 0.0
) -> tuple[TrialFit, TrialFit, Kinetics, Kinetics]:
    """Return the fit of what the phone saw, its vertical off by `tilt_deg`, the exact motion in the form of a fit, and
    the kinetics of both with every measure; without the error of the method where the exact motion is the truth."""
    walk, method = known.walk, METHODS.find()
    points = Case(walk, view, "static", detector).keypoints()
    chosen = default_fit((points.marker_set, points.root_relative))
    height = stature_m(load_body(), walk.scale)
    session = fit_session([points], [walk.person], chosen, "static", height_m=height)
    fit = dataclasses.replace(tilted(session.trials[0], tilt_deg), orientation_source="measured: phone")
    unknown = np.full_like(walk.qpos, np.nan)  # the exact motion has no error to draw
    exact = dataclasses.replace(walk.fit(), orientation_source="measured: phone", qpos_sd=unknown)
    gait = [known.labels] * 2 if known.labels else [gait_metrics([f]).trials[0] for f in (fit, exact)]
    with (
        mock.patch.dict(HEALTHY_SD, dict.fromkeys(MEASURES, np.inf)),
        mock.patch.dict(METHOD_SD, {} if known.plates else dict.fromkeys(MEASURES, 0.0)),
        mock.patch.dict(CYCLE_SD, dict.fromkeys(MEASURES, 0.0)),  # the truth is of the same cycles
        mock.patch("pbl_pipeline.kinetics.compute.MAX_ASYMMETRY_SD", np.inf),
    ):
        seen, true = (visit_kinetics([f], [g], method) for f, g in zip((fit, exact), gait, strict=True))
    return fit, exact, seen, true


def vertical_rms(walk: Walk, fit: TrialFit, exact: TrialFit) -> float:
    """Return the root mean square error of the vertical force of a foot on the floor (% BW), under the true events,
    over the times at which the phone saw the walker."""
    body, params = load_body(), METHODS.find().params
    ours, true = (trial_series(body, f, np.asarray(f.qpos, float), walk.events, params) for f in (fit, exact))
    assert ours is not None
    assert true is not None
    up = np.stack([np.interp(true.time_s, ours.time_s, ours.force_bw[:, k, 2]) for k in (0, 1)], axis=1)
    seen = np.abs(ours.time_s[:, None] - true.time_s).min(axis=0) < 1.0 / GRID_HZ
    on = (true.force_bw[..., 2] > 0.02) & seen[:, None]
    return float(100.0 * np.sqrt(np.nanmean((up - true.force_bw[..., 2])[on] ** 2)))


@click.command()
@click.option("--walks", "kind", type=click.Choice(("plates", "recorded", "synthetic")), default="plates")
@click.option("--detector", type=click.Choice(tuple(DETECTORS)), default="blazepose-heavy", show_default=True)
@click.option("--tilt", default=0.0, metavar="DEG", help="Error of the vertical along the way, to both sides.")
def main(kind: str, detector: str, tilt: float) -> None:
    """Print the tables."""
    rows: dict[tuple[bool, str], list[tuple[float, ...]]] = {}
    rms: dict[bool, list[float]] = {True: [], False: []}
    sides: dict[tuple[bool, str, bool], list[tuple[float, ...]]] = {}
    for known in known_walks(kind):
        for view, tilt_deg in itertools.product(VIEWS, sorted({-tilt, tilt})):
            fit, exact, seen, true = forces(known, view, detector, tilt_deg)
            if not seen.measures or not true.measures:
                click.echo(f"{known.walk.person} {view}: {seen.code or true.code}")
                continue
            rms[known.tuning].append(vertical_rms(known.walk, fit, exact))
            for name, measure in seen.measures.items():
                shown, both = not too_uncertain(name, measure.sd or 0.0), []
                for side in SIDES:
                    value, truth = getattr(measure, side), getattr(true.measures.get(name), side, None)
                    truth = known.plates.get(side, {}).get(name) if known.plates else truth
                    if value is not None and truth is not None:
                        row = (truth, value - truth, getattr(measure, f"sd_{side}"), shown)
                        rows.setdefault((known.tuning, name), []).append(row)
                        both.append(row)
                if len(both) == len(SIDES):
                    (left, off_left, *_), (right, off_right, *_) = both
                    asymmetry, stated = measure.asymmetry_percent, measure.asymmetry_sd
                    off = np.nan if asymmetry is None else asymmetry - 200.0 * (right - left) / abs(right + left)
                    row = (off, np.nan if stated is None else stated, off_left, off_right)
                    sides.setdefault((known.tuning, name, view == "sagittal"), []).append(row)
    bar = BARS[detector_model(detector).marker_set]
    for tuning in (True, False):
        click.echo(f"\n{kind}, {detector}, {'tuning' if tuning else 'held out'}: {len(rms[tuning])} clips")
        click.echo(f"vertical force against the exact motion {np.mean(rms[tuning]):.1f} % BW (bar {bar:g})")
        columns = ("true", "mean", "rms", "sd")
        shares = ("held", "shown") if kind == "plates" else ("held",)
        click.echo(f"{'':42}" + "".join(f"{c:>9}" for c in columns) + "".join(f"{c:>7}" for c in shares))
        for name in MEASURES:
            truth, error, sd, shown = np.array(rows[tuning, name]).T
            cells = (truth.mean(), error.mean(), np.sqrt(np.mean(error**2)), np.sqrt(np.mean(sd**2)))
            found = (np.mean(np.abs(error) < Z90 * sd), shown.mean())[: len(shares)]
            click.echo(f"{name:42}" + "".join(f"{c:9.3f}" for c in cells) + "".join(f"{s:7.0%}" for s in found))
        click.echo(f"\n{'asymmetry (percent)':42}{'rms':>9}{'sd':>9}{'held':>7}{'shown':>7}{'together':>10}{'side':>9}")
        for name in MEASURES:
            alike, unlike = (np.array(sides.get((tuning, name, side), np.zeros((0, 4)))) for side in (False, True))
            if not np.isfinite(alike[:, 1]).any():
                continue
            off, sd = alike[np.isfinite(alike[:, 1]), :2].T
            cells = (np.sqrt(np.mean(off**2)), np.sqrt(np.mean(sd**2)))
            found = (np.mean(np.abs(off) < Z90 * sd), np.mean(sd <= MAX_ASYMMETRY_SD))
            alone = [np.mean(v[:, 2] * v[:, 3]) / np.mean(v[:, 2:] ** 2) if len(v) else np.nan for v in (alike, unlike)]
            click.echo(
                f"{name:42}" + "".join(f"{c:9.1f}" for c in cells) + "".join(f"{s:7.0%}" for s in found)
                + f"{alone[0]:10.2f}{alone[1]:9.2f}"
            )  # fmt: skip
    sys.exit(int(np.mean(rms[False]) > bar))


if __name__ == "__main__":
    main()
