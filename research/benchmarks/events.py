"""Gait events against force plates, against synthetic people, and how long they take.

    python -m research.benchmarks.events
    python -m research.benchmarks.events --part lab --part time --method zeni-2008

Parts:
- `lab`: `../shared/data/real/gait_lab_c3d` (see the README there), 11 walks of children with labels from force plates,
  from all markers, and from 17 joints at 30 Hz with 20 mm noise. With the event model also the cross-validation of its
  one constant: the delay of each child from the other ten.
- `markers`: true markers of synthetic people (`pbl synth`), healthy and impaired, without and with noise.
- `chain`: synthetic people seen by a phone in the hand -> `pbl fit` (gauss-newton) -> events ->
  cadence, double support.
- `slow`: double support of people on a treadmill from 0.3 to 1.4 m/s, exact motions; and the speed of heel and toe at
  contact and toe-off, in fractions of the walking speed, of the laboratory's children by the force plates and of the
  synthetic people by the generator's own labels. People of three sets of seeds (`PEOPLE`), one of which was held out.
- `time`: a six-minute walk.

Exit code 1 where a bar is missed (only the default method has bars).
"""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence

import click
import numpy as np

from pbl_pipeline.fit import METHODS as FIT_METHODS
from pbl_pipeline.fit import SessionInput, fit_sessions
from pbl_pipeline.gait import (
    FootTrajectories,
    GaitEvents,
    LabTrial,
    detect_events,
    feet_from_fit,
    feet_from_markers,
    find_cycles,
    read_lab_trial,
    spatiotemporal,
)
from pbl_pipeline.gait.events import EVENTS, METHODS, SIDES, GaitEvent, PhaseParams
from pbl_pipeline.synthetic import IMPAIRMENTS, Impairment, SynthSpec, Truth, synthesise
from research.paths import SHARED

#: A label and an event of its kind that are no further apart are the same event (s).
NEAR_S = 0.1
#: Walking speeds (m/s) of the part `slow`, and its people.
SPEEDS = (0.3, 0.5, 0.8, 1.1, 1.4)
PEOPLE = {"looked at": range(900, 912), "seeds 0 to 6": range(7), "held out": range(1900, 1912)}
VIEWS = ("frontal", "oblique", "sagittal", "follow")
KINDS: dict[str, tuple[Impairment, ...]] = {"healthy": (), **{n: (Impairment(n, 0.7),) for n in IMPAIRMENTS}}


@dataclasses.dataclass
class Tally:
    """Errors (s) of found events by kind, labels in all, events between first and last label that match none."""

    errors: dict[str, list[float]] = dataclasses.field(default_factory=lambda: {e: [] for e in EVENTS})
    labels: int = 0
    invented: int = 0

    def add(self, found: GaitEvents, truth: Sequence[GaitEvent]) -> None:
        first, last = min(t.time_s for t in truth), max(t.time_s for t in truth)
        self.labels += len(truth)
        for side in SIDES:
            for event in EVENTS:
                true = [t.time_s for t in truth if (t.side, t.event) == (side, event)]
                times = found.times(side, event)
                for t in true:
                    if near := [f - t for f in times if abs(f - t) < NEAR_S]:
                        self.errors[event].append(min(near, key=abs))
                self.invented += sum(first < f < last and all(abs(f - t) >= NEAR_S for t in true) for f in times)

    @property
    def matched(self) -> float:
        return sum(map(len, self.errors.values())) / max(self.labels, 1)

    def ms(self, event: str) -> tuple[float, float]:
        """Mean and standard deviation of the error."""
        ms = 1000 * np.array(self.errors[event])
        return float(ms.mean()), float(ms.std(ddof=1))

    def __str__(self) -> str:
        parts = [f"{e} {self.ms(e)[0]:+.1f} +- {self.ms(e)[1]:.1f} ms" for e in EVENTS if len(self.errors[e]) > 1]
        n = sum(map(len, self.errors.values()))
        return f"{n} of {self.labels} ({self.matched:.1%}), {self.invented} invented; {'; '.join(parts)}"


def lab_walks() -> list[LabTrial]:
    """The 11 walks: `feet` from their markers, `events` the labels."""
    return [read_lab_trial(p) for p in sorted((SHARED / "real" / "gait_lab_c3d").glob("Straight_*.c3d.gz"))]


def reduced(feet: FootTrajectories, seed: int, fps: float = 30.0, noise_m: float = 0.02) -> FootTrajectories:
    """The 17 joints of MeTRAbs (the legs end at the ankles) at `fps` with noise; the ankle stands for heel and toe."""
    assert feet.legs_m is not None
    rng = np.random.default_rng(seed)
    wanted = np.arange(feet.time_s[0], feet.time_s[-1], 1 / fps)
    at = np.clip(np.searchsorted(feet.time_s, wanted), 0, len(feet.time_s) - 1)
    legs = feet.legs_m[at, :3]
    legs = legs + noise_m * rng.standard_normal(legs.shape)
    points = legs.reshape(len(at), 6, 3)
    names = ("left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")
    return feet_from_markers(feet.time_s[at], names, "mpi_inf_3dhp_17", points)


def laboratory(method: str, say=click.echo) -> dict[str, Tally]:
    """Both reductions of the laboratory walks."""
    walks = lab_walks()
    out = {"all markers": Tally(), "17 joints, 30 Hz, 20 mm": Tally()}
    for walk in walks:
        assert walk.feet is not None
        out["all markers"].add(detect_events(walk.feet, method), walk.events.events)
        for seed in range(5):
            out["17 joints, 30 Hz, 20 mm"].add(detect_events(reduced(walk.feet, seed), method), walk.events.events)
    for name, tally in out.items():
        say(f"lab, {name}: {tally}")
    return out


def delay_of(walks: Sequence[LabTrial], params: PhaseParams) -> list[Tally]:
    """Errors of each child's walk without the delay."""
    params = dataclasses.replace(params, event_delay_s=0.0)
    out = []
    for walk in walks:
        assert walk.feet is not None
        out.append(Tally())
        out[-1].add(detect_events(walk.feet, params), walk.events.events)
    return out


def cross_validated(say=click.echo) -> tuple[float, dict[str, tuple[float, float]]]:
    """The delay that fits all children (s), and mean and sd (ms) of the errors of each event where each child's delay
    comes from the others: minus the mean over children of their mean error over all four events. Printed as well: half
    of that delay, which is the rule behind the method's constant."""
    each = delay_of(lab_walks(), METHODS["phase-transformer"].params)
    means = np.array([np.mean([x for e in EVENTS for x in t.errors[e]]) for t in each])
    whole = -float(means.mean())
    left_out = [-float(np.delete(means, i).mean()) for i in range(len(means))]
    result = {}
    for event in EVENTS:
        raw = 1000 * np.concatenate([t.errors[event] for t in each])
        ms = 1000 * np.concatenate([np.array(t.errors[event]) + d for t, d in zip(each, left_out, strict=True)])
        result[event] = (float(ms.mean()), float(ms.std(ddof=1)))
        say(
            f"delay, {event}: without {raw.mean():+.1f} +- {raw.std(ddof=1):.1f} ms, "
            f"with that of the other children {result[event][0]:+.1f} +- {result[event][1]:.1f} ms"
        )
        ms = 1000 * np.concatenate([np.array(t.errors[event]) + d / 2 for t, d in zip(each, left_out, strict=True)])
        say(f"delay, {event}: with half of it {ms.mean():+.1f} +- {ms.std(ddof=1):.1f} ms")
    say(
        f"delay over all children {1000 * whole:.1f} ms, leaving one out {1000 * min(left_out):.1f} to "
        f"{1000 * max(left_out):.1f} ms; children's means {1000 * means.min():.0f} to {1000 * means.max():.0f} ms"
    )
    return whole, result


def markers(method: str, say=click.echo) -> None:
    """Synthetic people's true markers."""
    for noise in (0.0, 0.02):
        tally = Tally()
        for k, impairments in enumerate(KINDS.values()):
            for seed in range(2):
                truth = synthesise(SynthSpec("walk", 20 * k + seed, impairments, noise="none", seconds=6.0)).truth
                xyz = truth.markers_world_m
                xyz = xyz + noise * np.random.default_rng(seed).standard_normal(xyz.shape)
                tally.add(detect_events(feet_of_truth(truth, xyz), method), truth.events)
        say(f"synthetic markers, {1000 * noise:.0f} mm noise: {tally}")


def feet_of_truth(truth: Truth, xyz_m: np.ndarray) -> FootTrajectories:
    from pbl_pipeline.body import marker_set

    names = marker_set(truth.spec.marker_set).names
    return feet_from_markers(truth.time_s, names, truth.spec.marker_set, xyz_m)


@dataclasses.dataclass(frozen=True)
class Walked:
    """Error of the measures of one trial (found minus true), and its events' tally."""

    name: str
    cadence: float
    double_support: float
    tally: Tally


def chain(methods: Sequence[str], seeds: int, say=click.echo) -> dict[str, list[Walked]]:
    """From keypoints of a phone in the hand over the fit to cadence and double support, of each method."""
    out: dict[str, list[Walked]] = {m: [] for m in methods}
    for k, (kind, impairments) in enumerate(KINDS.items()):
        made = []
        for n in range(seeds):
            view = VIEWS[(k + n) % len(VIEWS)]
            ground = "treadmill" if view == "sagittal" else "overground"
            spec = SynthSpec("walk", 100 * k + n, impairments, view, "handheld", seconds=8.0, ground=ground)
            made.append(synthesise(spec))
        given = [SessionInput([m.keypoints], [m.truth.spec.name], "handheld") for m in made]
        for one, fit in zip(made, fit_sessions(given, FIT_METHODS["gauss-newton"]), strict=True):
            name = f"{kind}, {one.truth.spec.view}, seed {one.truth.spec.seed}"
            if isinstance(fit, Exception):
                say(f"chain, {name}: {fit}")
                continue
            trial = fit.trials[0]
            true = spatiotemporal(find_cycles(one.truth.events, trial))
            for method in methods:
                found = detect_events(feet_from_fit(trial), method)
                tally = Tally()
                tally.add(found, one.truth.events)
                got = spatiotemporal(find_cycles(found, trial))
                cadence, support = (
                    float("nan") if (a := got[m]) is None or (b := true[m]) is None else a.mean - b.mean
                    for m in ("cadence_steps_per_min", "double_support_percent")
                )
                out[method].append(Walked(name, cadence, support, tally))
                w = out[method][-1]
                say(
                    f"chain, {method}, {name}: cadence {w.cadence:+.2f}/min, "
                    f"double support {w.double_support:+.2f} %, {tally}"
                )
    for method in methods:
        say(f"chain, {method}: {summary(out[method])}")
    return out


def summary(walked: Sequence[Walked]) -> str:
    cadence = np.array([w.cadence for w in walked])
    support = np.array([w.double_support for w in walked])
    n = sum(sum(map(len, w.tally.errors.values())) for w in walked)
    labels = sum(w.tally.labels for w in walked)

    def sizes(values: np.ndarray) -> str:
        size = np.abs(values[np.isfinite(values)])
        return f"median {np.median(size):.2f}, 95th percentile {np.percentile(size, 95):.2f}, greatest {size.max():.2f}"

    return (
        f"{len(walked)} walks, matched {n / labels:.1%}, invented {sum(w.tally.invented for w in walked)}; error of "
        f"the cadence: {sizes(cadence)} per min; of double support: mean {np.nanmean(support):+.2f}, {sizes(support)} "
        f"% of the cycle; without a measure: {int(np.isnan(cadence).sum())}"
    )


def double_support_error(speed: float, seed: int, method: str) -> tuple[float, Truth]:
    """Error of the double support (% of the cycle) of one person's exact motion, NaN without a measure; the truth."""
    how = {"noise": "none", "ground": "treadmill", "fps": 100.0, "seconds": max(7.0, 4.0 / speed)}
    truth = synthesise(SynthSpec("walk", seed, speed_m_per_s=speed, **how)).truth
    found = detect_events(feet_of_truth(truth, truth.markers_world_m), method)
    got, true = (spatiotemporal(find_cycles(e))["double_support_percent"] for e in (found, truth.events))
    return (float("nan") if got is None or true is None else got.mean - true.mean), truth


def foot_speed(feet: FootTrajectories, events: Sequence[GaitEvent], belt_m_per_s: np.ndarray) -> dict[str, float]:
    """Speed (m/s) against the floor of the heel at initial contact and of the toe at toe-off: median over events."""
    out = {}
    for event, points in (("foot_down", feet.heel_m), ("foot_up", feet.toe_m)):
        found = []
        for e in events:
            if e.event == event and feet.time_s[0] + 0.05 < e.time_s < feet.time_s[-1] - 0.05:
                moves = np.gradient(points[:, SIDES.index(e.side)], feet.time_s, axis=0) - belt_m_per_s
                found.append(float(np.interp(e.time_s, feet.time_s, np.linalg.norm(moves, axis=1))))
        out[event] = float(np.median(found)) if found else float("nan")
    return out


def slow(method: str, say=click.echo) -> dict[str, float]:
    """Root mean square (% of the cycle) of the double support's error at the worst speed, of each set of people."""
    lab, plates = [], []
    for walk in lab_walks():
        assert walk.feet is not None
        found = detect_events(walk.feet, method)
        got, true = (
            spatiotemporal(find_cycles(e, keep_ends=True))["double_support_percent"] for e in (found, walk.events)
        )
        plates.append(float("nan") if got is None or true is None else got.mean - true.mean)
        seen = np.flatnonzero(np.isfinite(walk.feet.pelvis_m).all(axis=1))[[0, -1]]
        way, duration = np.diff(walk.feet.pelvis_m[seen], axis=0)[0, :2], np.diff(walk.feet.time_s[seen])[0]
        speed = float(np.linalg.norm(way) / duration)
        lab.append([v / speed for v in foot_speed(walk.feet, walk.events.events, np.zeros(3)).values()])
    heel, toe = np.array(lab).T
    say(
        f"force plates, {len(lab)} children: heel at contact {heel.mean():.2f} +- {heel.std(ddof=1):.2f} of the "
        f"walking speed, toe at toe-off {toe.mean():.2f} +- {toe.std(ddof=1):.2f}"
    )
    off = np.array(plates)
    say(
        f"double support, force plates, {np.isfinite(off).sum()} children: rms {_rms(off):.1f}, mean "
        f"{np.nanmean(off):+.1f}, worst {off[np.nanargmax(np.abs(off))]:+.1f} % of the cycle"
    )
    rms = {}
    for name, seeds in PEOPLE.items():
        every = []
        for speed in SPEEDS:
            errors, moves = [], []
            for seed in seeds:
                error, truth = double_support_error(speed, seed, method)
                errors.append(error)
                feet, belt = feet_of_truth(truth, truth.markers_world_m), np.array([*truth.belt_m_per_s, 0.0])
                moves.append([v / speed for v in foot_speed(feet, truth.events, belt).values()])
            e, (heel, toe) = np.array(errors), np.nanmedian(moves, axis=0)
            every.append(e)
            say(
                f"double support, {name}, {speed:.1f} m/s, {len(seeds)} people: rms {_rms(e):.1f}, mean "
                f"{np.nanmean(e):+.1f}, worst {e[np.nanargmax(np.abs(e))]:+.1f} % of the cycle; labels: heel at "
                f"contact {heel:.2f} of the walking speed, toe at toe-off {toe:.2f}"
            )
        rms[name] = max(_rms(e) for e in every)
        say(f"double support, {name}, all speeds: rms {_rms(np.concatenate(every)):.2f} % of the cycle")
    return rms


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(values**2)))


def six_minutes() -> FootTrajectories:
    """A walk on a treadmill, six minutes at 30 Hz: a short one's markers again and again, pace and noise varying."""
    truth = synthesise(SynthSpec("walk", 5, ground="treadmill", noise="none", seconds=20.0)).truth
    rng = np.random.default_rng(0)
    down = [e.time_s for e in truth.events if (e.side, e.event) == ("left", "foot_down")]
    first, last = down[2], down[-3]
    stamps = np.arange(0, 360, 1 / 30)
    at = first + np.mod(stamps, last - first)
    xyz = truth.markers_world_m.reshape(len(truth.time_s), -1)
    xyz = np.stack([np.interp(at, truth.time_s, column) for column in xyz.T], axis=1).reshape(len(at), -1, 3)
    return dataclasses.replace(
        feet_of_truth(dataclasses.replace(truth, time_s=stamps), xyz + rng.normal(0, 0.01, xyz.shape))
    )


def how_long(method: str, say=click.echo) -> tuple[float, float]:
    """Seconds of the first detection in this process (with import and compilation) and of the next one."""
    feet = six_minutes()
    took = []
    for name in ("first", "next"):
        began = time.perf_counter()
        found = detect_events(feet, method)
        took.append(time.perf_counter() - began)
        say(f"six minutes, {name}: {took[-1]:.2f} s, {len(found.events)} events")
    return took[0], took[1]


@click.command()
@click.option("--part", "parts", multiple=True, type=click.Choice(["lab", "markers", "chain", "slow", "time"]))
@click.option("--method", "methods", multiple=True, type=click.Choice(sorted(METHODS)))
@click.option("--seeds", default=4, show_default=True, help="Walks of each kind in the chain.")
def main(parts: Sequence[str], methods: Sequence[str], seeds: int) -> None:
    """Print all figures; exit code 1 where the default method misses a bar."""
    parts, methods = parts or ("lab", "markers", "slow", "time", "chain"), methods or tuple(METHODS)
    default = METHODS.default
    bars: list[tuple[str, bool]] = []
    if "time" in parts:
        for method in methods:
            click.echo(method)
            _, warm = how_long(method)
            if method == default:
                bars.append(("six minutes in 5 s", warm <= 5.0))
    if "lab" in parts:
        for method in methods:
            click.echo(method)
            found = laboratory(method)
            if method == default:
                full, few = found.values()
                bars += [("lab: 97 % matched, none invented", full.matched >= 0.97 and full.invented == 0)]
                bars += [
                    (f"lab: {e} within 15 ms, sd 25 ms", abs(full.ms(e)[0]) <= 15 and full.ms(e)[1] <= 25)
                    for e in EVENTS
                ]
                bars += [("17 joints: 95 % matched", few.matched >= 0.95)]
                bars += [(f"17 joints: {e} sd 35 ms", few.ms(e)[1] <= 35) for e in EVENTS]
        if default in methods:
            cross_validated()
    if "markers" in parts:
        for method in methods:
            click.echo(method)
            markers(method)
    if "slow" in parts:
        for method in methods:
            click.echo(method)
            rms = slow(method)
            if method == default:
                bars += [
                    (f"double support, {name}: rms 2 % at every speed", value <= 2.0) for name, value in rms.items()
                ]
    if "chain" in parts:
        walked = chain(methods, seeds).get(default)
        if walked:
            n = sum(sum(map(len, w.tally.errors.values())) for w in walked)
            bars += [("chain: 95 % matched", n >= 0.95 * sum(w.tally.labels for w in walked))]
            bars += [("chain: cadence within 1.5 per min", max(abs(w.cadence) for w in walked) <= 1.5)]
            bars += [("chain: double support within 3 %", max(abs(w.double_support) for w in walked) <= 3.0)]
    for name, good in bars:
        click.echo(f"bar: {name}: {'PASS' if good else 'FAIL'}")
    sys.exit(0 if all(good for _, good in bars) else 1)


if __name__ == "__main__":
    main()
