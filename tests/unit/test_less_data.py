"""Properties of everything that pools: less data has no smaller error, and names, order and labels do not matter."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from click.testing import CliRunner

from pbl_pipeline.body import load_body
from pbl_pipeline.cli.gait import gait as gait_command
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import (
    MEASURES,
    GaitCycle,
    GaitParams,
    Lengths,
    Measure,
    SessionMetrics,
    gait_metrics,
    load_norm,
    pool_trials,
)
from pbl_pipeline.gait.measurement import load_model
from pbl_pipeline.gait.metrics import TrialCycles
from pbl_pipeline.kinetics import MEASURES as FORCES
from pbl_pipeline.kinetics import METHODS, Kinetics, visit_kinetics
from pbl_pipeline.kinetics.compute import METHOD_SD, ONE_CAMERA_SD
from tests import not_none
from tests.walking_fit import walking_fit

NORM, PARAMS = load_norm(), GaitParams()
#: Largest difference by rounding.
CLOSE = 1e-9


def drawn_trial(rng: np.random.Generator, name: str, n: int, far_leg: str, spread: float) -> TrialCycles:
    """A pass of n cycles of alternating sides; with `spread` 1 times and lengths vary as those of recorded people."""
    time, cycles = 0.0, []
    angles = NORM.mean_deg + rng.normal(0.0, 10.0, 3) @ NORM.components[:3]
    for i in range(n):
        stride, stance, both = (
            rng.normal(mean, spread * sd) for mean, sd in ((1.1, 0.015), (0.66, 0.01), (0.1, 0.005))
        )
        down = time + 0.5 * stride + rng.normal(0.0, 0.005 * spread)
        lengths = Lengths(rng.normal(1.3, 0.03 * spread), rng.normal(0.65, 0.04 * spread))
        seen = np.split(angles + rng.normal(0.0, 2.0) * NORM.components[4], len(NORM.variables))
        curves = {v: np.append(c, c[0]) for v, c in zip(NORM.variables, seen, strict=True)}
        at = time, time + both, down, time + stance, time + stride
        more = {"lengths": lengths, "far_leg": far_leg, "error_model": "blazepose-33", "curves": curves}
        cycles.append(GaitCycle(name, i, 0, ("left", "right")[i % 2], *at, **more))
        time += 0.5 * stride
    return TrialCycles(name, "", tuple(cycles))


def drawn_visit(rng: np.random.Generator, spread: float) -> list[TrialCycles]:
    legs = ("left", "right", "")
    return [
        drawn_trial(rng, f"pass {i}", int(rng.integers(2, 10)), legs[int(rng.integers(3))], spread)
        for i in range(int(rng.integers(1, 4)))
    ]


def less(rng: np.random.Generator, trials: list[TrialCycles]) -> list[TrialCycles]:
    """The visit without a pass, without the cycles of some seconds of one, or without cycles here and there."""
    what = int(rng.integers(3))
    if what == 0 and len(trials) > 1:
        return [t for i, t in enumerate(trials) if i != rng.integers(len(trials))] or trials[:1]
    lost = rng.uniform(0.0, 3.0)

    def kept(c: GaitCycle) -> bool:
        return not lost < c.end_s < lost + 1.5 if what == 1 else rng.random() < 0.7

    out = [dataclasses.replace(t, cycles=tuple(c for c in t.cycles if kept(c))) for t in trials]
    return out if any(t.cycles for t in out) else trials


def pooled(trials: Sequence[TrialCycles]) -> SessionMetrics:
    return pool_trials(trials, NORM, PARAMS)


def errors(found: SessionMetrics) -> dict[str, tuple[float, ...]]:
    """Standard deviation, minimal change and width of the interval of each measure that states them."""
    return {name: of_measure(m) for name, m in found.spatiotemporal.measures.items() if m is not None}


def of_measure(m: Measure) -> tuple[float, ...]:
    low, high = not_none(m.interval)
    return not_none(m.error_sd), not_none(m.minimal_change), high - low


@pytest.mark.parametrize(("spread", "tolerance"), [(1.0, 0.0), (2.0, 0.2)])
def test_no_measure_has_a_smaller_error_with_less_data(spread: float, tolerance: float):
    """Exactly so for people who vary as recorded ones; with twice that they may by chance look steadier without a
    cycle, but not on average."""
    rng, ratios = np.random.default_rng(1), {}
    for _ in range(60):
        visit = drawn_visit(rng, spread)
        whole, part = errors(pooled(visit)), errors(pooled(less(rng, visit)))
        for name in whole.keys() & part.keys():
            ratios.setdefault(name, []).append(np.array(part[name]) / np.array(whole[name]))
    assert ratios.keys() == set(MEASURES) - {"step_width_m"}
    for name, of_errors in ratios.items():
        assert np.min(of_errors) >= 1.0 - tolerance - 1e-9, name
        assert np.min(np.mean(of_errors, axis=0)) >= 1.0, name


def relabelled(rng: np.random.Generator, trials: list[TrialCycles]) -> list[TrialCycles]:
    """The same passes in another order and with other names, their cycles renumbered."""
    out = []
    for i in rng.permutation(len(trials)):
        own, name = trials[i].cycles, f"film {rng.integers(1000)} {i}"
        cycles = tuple(dataclasses.replace(c, trial=name, number=40 + c.number) for c in own)
        out.append(TrialCycles(name, "", cycles))
    return out


def numbers(found: object) -> dict[str, float]:
    """All numbers of a result but those of single cycles and checks."""
    told = {k: v for k, v in dataclasses.asdict(found).items() if k not in ("cycles", "qc", "trials")}  # type: ignore[call-overload]
    flat = pd.json_normalize(told).iloc[0]
    return {k: v for k, v in flat.items() if isinstance(v, float) and np.isfinite(v)}


def test_order_and_names_of_passes_do_not_matter():
    rng = np.random.default_rng(2)
    for _ in range(8):
        visit = drawn_visit(rng, 1.0)
        one, other = pooled(visit), pooled(relabelled(rng, visit))
        assert numbers(other.spatiotemporal) == pytest.approx(numbers(one.spatiotemporal), abs=CLOSE)
        assert numbers(other.gdi) == pytest.approx(numbers(one.gdi), abs=CLOSE)
        assert [(c.check, c.outcome) for c in other.qc] == [(c.check, c.outcome) for c in one.qc]


def test_two_passes_may_have_one_name():
    rng = np.random.default_rng(2)
    visit = [drawn_trial(rng, name, 6, "", 1.0) for name in "ab"]
    same = [
        dataclasses.replace(t, name="x", cycles=tuple(dataclasses.replace(c, trial="x") for c in t.cycles))
        for t in visit
    ]
    assert numbers(pooled(same).spatiotemporal) == pytest.approx(numbers(pooled(visit).spatiotemporal), abs=CLOSE)


# ------------------------------------------------------------------------------------------------------------- kinetics
BODY = load_body()
#: Fewer drawn motions, for speed.
METHOD = dataclasses.replace(METHODS.find(), params=dataclasses.replace(METHODS.find().params, samples=8))
#: How much smaller an error may be by the chance of so few drawn motions.
BY_CHANCE = 0.06


@pytest.fixture(scope="module")
def walks() -> list[TrialFit]:
    of_both = [walking_fit(BODY.joint_names, BODY.sha256, n_frames=n, start_m=(6.0, -2.5, -0.2)) for n in (170, 130)]
    sd = {"orientation_source": "measured: phone", "height_m": 1.8}
    return [
        dataclasses.replace(f, qpos_sd=np.full_like(f.qpos, 0.005), name=n, **sd)
        for n, f in zip("ab", of_both, strict=True)
    ]


def forces(fits: Sequence[TrialFit], trials: Sequence) -> Kinetics:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pbl_pipeline.kinetics.compute.HEALTHY_RANGE", np.inf)  # a wide interval is stated as well
        return visit_kinetics(fits, trials, METHOD)


def test_no_force_has_a_smaller_error_with_less_data_nor_by_names(walks: list[TrialFit]):
    trials = gait_metrics(walks).trials
    whole = forces(walks, trials)
    assert whole.measures.keys() == set(FORCES)
    renamed = [dataclasses.replace(f, name="x") for f in walks[::-1]]
    same = forces(renamed, trials[::-1])
    for name, m in whole.measures.items():
        assert numbers(same.measures[name]) == pytest.approx(numbers(m), abs=CLOSE), name
    rng = np.random.default_rng(0)
    some = [dataclasses.replace(t, cycles=tuple(c for c in t.cycles if rng.random() < 0.5)) for t in trials]
    left = [dataclasses.replace(t, cycles=tuple(c for c in t.cycles if c.side == "left")) for t in trials]
    for fits, kept in ((walks[:1], trials[:1]), (walks, some), (walks, left)):
        part = forces(fits, kept)
        for name, m in part.measures.items():
            for of_part, of_whole in (
                (m.sd, whole.measures[name].sd),
                (m.asymmetry_sd, whole.measures[name].asymmetry_sd),
            ):
                if of_part is not None and of_whole is not None:
                    assert of_part >= (1.0 - BY_CHANCE) * of_whole, name


def test_sides_that_were_not_seen_alike_are_not_compared(walks: list[TrialFit]):
    """Neither of gait nor of forces, and for the same reason; the error of a difference contains one camera's of both
    sides."""
    gait = gait_metrics(walks[:1]).trials[0]
    alike, unlike = (
        dataclasses.replace(gait, cycles=tuple(dataclasses.replace(c, far_leg=leg) for c in gait.cycles))
        for leg in ("", "left")
    )
    shown, withheld = (forces(walks[:1], [t]) for t in (alike, unlike))
    impulse = shown.measures["vertical_impulse_bw_s"]
    assert impulse.asymmetry_percent is not None
    of_camera = 100.0 * np.sqrt(2.0) * ONE_CAMERA_SD["blazepose_33"]["vertical_impulse_bw_s"] / impulse.mean
    of_method = 100.0 * np.sqrt(2.0) * METHOD_SD["vertical_impulse_bw_s"] / impulse.mean
    assert not_none(impulse.asymmetry_sd) > np.hypot(of_camera, of_method)
    assert {m.asymmetry_percent for m in withheld.measures.values()} == {None}
    check = next(c for c in withheld.qc if c.check == "legs_seen_alike")
    assert check == next(c for c in pooled([unlike]).qc if c.check == "legs_seen_alike")
    assert check.outcome == "WARN"


def test_pbl_gait_measures_the_same_from_files_in_another_order_and_of_one_name(tmp_path: Path, walks: list[TrialFit]):
    found = []
    for names, order in (("ab", 1), ("xx", -1)):
        files = [tmp_path / f"{names} {i}" / f"{name}.fit.npz" for i, name in enumerate(names)]
        for file, fit in zip(files, walks, strict=True):
            file.parent.mkdir()
            dataclasses.replace(fit, name=file.name.removesuffix(".fit.npz")).save(file)
        done = CliRunner().invoke(gait_command, [*map(str, files[::order]), "--out", str(tmp_path / f"{names}.json")])
        assert done.exit_code == 0, done.output
        found.append(json.loads((tmp_path / f"{names}.json").read_text())["session"])
    for name in MEASURES:
        assert found[1][name] == found[0][name], name
    assert found[1]["cycles"] == found[0]["cycles"]


def test_no_measure_has_a_smaller_error_without_frames(walks: list[TrialFit]):
    fit = dataclasses.replace(walks[0], params_hash=load_model("blazepose-33").fits[0], height_m=float("nan"))
    whole = errors(gait_metrics([fit]))
    assert whole.keys() == set(MEASURES) - {"step_width_m"}
    for lost in (slice(0, 60), slice(70, 90), slice(110, None)):
        qpos = fit.qpos.copy()
        qpos[lost] = np.nan
        part = errors(gait_metrics([dataclasses.replace(fit, qpos=qpos)]))
        assert part
        for name, of_part in part.items():
            assert np.all(np.array(of_part) >= np.array(whole[name]) - CLOSE), (name, lost)
