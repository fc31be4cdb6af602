"""Wearable sensors: their orientation, where a fit with them starts, and what is said of them."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import body_frames, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit, fit_session
from pbl_pipeline.fit.checks import _sensors
from pbl_pipeline.fit.wearables import FLOOR_SHARES, _mount, floor_shares, shares_of_floors
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.qc import FAIL, PASS, WARN
from pbl_pipeline.records import plain
from pbl_pipeline.results.fits import SensorFit
from pbl_pipeline.sensors import places
from pbl_pipeline.sensors.log import SEGMENTS, SensorLog
from pbl_pipeline.sensors.orientation import oriented
from pbl_pipeline.sensors.pairing import better_pairing
from pbl_pipeline.sensors.start import BODY_OF, Moved, clock_of, moved, vectors, wahba
from pbl_pipeline.sensors.worn import worn
from pbl_pipeline.synthetic import SynthSpec, Truth, synthesise
from research.walker import sensors as synthetic
from tests import not_none


@pytest.fixture(scope="module")
def truth() -> Truth:
    return synthesise(SynthSpec(seed=21, seconds=2.5)).truth


@pytest.fixture(scope="module")
def seen(truth) -> Moved:
    """The segments as a camera that errs nowhere sees them."""
    body = load_body()
    frames = body_frames(body, truth.qpos, truth.scale)
    index = {k: body.body_names.index(b) for k, b in BODY_OF.items()}
    rotation, position = ({k: a[:, i] for k, i in index.items()} for a in (frames.rotation, frames.position_m))
    return moved(truth.time_s, rotation, position)


def turning(seconds: float, gap: slice = slice(0), bias=(0.0, 0.0, 0.0)) -> tuple[SensorLog, Rotation]:
    """A sensor that swings about two axes, and its rotations."""
    time = np.arange(0, seconds, 0.01)
    angle = np.stack([0.4 * np.sin(3 * time), 0.3 * np.sin(2 * time), 0 * time], axis=1)
    turns = Rotation.from_euler("xyz", angle)
    rate = (turns[:-2].inv() * turns[2:]).as_rotvec() / 0.02
    rate = np.concatenate([rate[:1], rate, rate[-1:]]) + np.deg2rad(bias)
    rate[gap] = np.nan
    return SensorLog("a", "thigh_r", time, rate, turns.inv().apply([0, 0, 9.81]), None), turns


@pytest.mark.parametrize("seconds", [4.0, 20.0])
def test_orientation_is_that_of_the_sensor_but_for_its_heading(seconds):
    log, turns = turning(seconds)
    found = Rotation.from_quat(oriented(log).at(log.time)[0], scalar_first=True)
    off = (found * turns.inv()).as_matrix()
    assert np.rad2deg(np.arccos(np.clip(off[:, 2, 2], -1, 1))).max() < 1.0
    heading = np.unwrap(np.arctan2(off[:, 1, 0], off[:, 0, 0]))
    assert np.rad2deg(np.ptp(heading)) < 1.0


def test_a_short_gap_is_bridged_and_a_long_one_splits():
    whole, split = (oriented(turning(20.0, gap)[0]) for gap in (slice(500, 504), slice(500, 550)))
    assert len(whole.runs) == 1
    assert [len(t) for t, _ in split.runs] == [500, 1450]
    known = split.at(np.arange(0, 20, 0.1))[1]
    assert (known.sum(), known[:55].sum()) == (145, 0)


def test_a_log_without_samples_is_refused_and_a_segment_twice_too():
    log, _ = turning(4.0, slice(None))
    with pytest.raises(PblError, match="FIT_INPUT"):
        oriented(log)
    log, _ = turning(4.0)
    for logs in ([log, log], [dataclasses.replace(log, segment="knee")]):
        with pytest.raises(PblError, match="FIT_INPUT"):
            worn(logs, None, 1)
    with pytest.raises(PblError, match="FIT_INPUT"):
        worn([log], [0.0, 0.0], 1)
    assert worn([], None, 1) is None
    stated = worn([log], [2, (1.0, 5.0), None], 3)
    assert stated is not None
    assert stated.clock_s == (2.0, (1.0, 5.0), None)
    assert isinstance(stated.clock_s[0], float)  # not looked for in the whole log


@pytest.mark.parametrize("stated", [0.0, None])
def test_clock_and_mounting_are_found(truth, seen, stated):
    logs, mounts = synthetic.worn(truth, 3, clock_s=0.21)
    sensors = [oriented(log) for log in logs]
    clock, agreement = clock_of(seen, sensors, stated)
    assert clock == pytest.approx(0.21, abs=0.005)
    assert agreement > 0.9
    for sensor in sensors:
        found = Rotation.from_matrix(wahba(vectors(seen, clock, sensor, sensor.log.segment)))
        assert np.rad2deg((found * mounts[sensor.log.segment].inv()).magnitude()) < 12


def test_a_stated_mounting_starts_the_pelvis_and_must_not_contradict_gravity(truth, seen):
    """Also without acceleration: the walking direction is not needed."""
    logs, mounts = synthetic.worn(truth, 3, ("pelvis",), clock_s=0.1)
    given = oriented(logs[0]).at(logs[0].time)[0]
    alone = dataclasses.replace(logs[0], rate=None, acceleration=None, orientation=given)
    for turn, refused in (("y", False), ("x", True)):  # of a person who stands: about the vertical, to the side
        stated = Rotation.from_euler(turn, 60, degrees=True) * mounts["pelvis"]
        log = dataclasses.replace(alone, mounting=stated.as_quat(scalar_first=True))
        if refused:
            with pytest.raises(PblError, match="off gravity in trial walk2") as wrong:
                _mount(["walk1", "walk2"], [seen, seen], [1e3, 0.1], oriented(log))
            assert wrong.value.code == "FIT_INPUT"
        else:
            np.testing.assert_allclose(_mount(["walk"], [seen], [0.1], oriented(log)), stated.as_matrix(), atol=1e-9)


def test_orientation_alone_is_enough(truth, seen):
    logs, _ = synthetic.worn(truth, 3, ("shank_r",), clock_s=0.1)
    given = oriented(logs[0]).at(logs[0].time)[0]
    alone = dataclasses.replace(logs[0], rate=None, acceleration=None, orientation=2 * given)
    assert clock_of(seen, [oriented(alone)], 0.0)[0] == pytest.approx(0.1, abs=0.01)


def test_strides_that_are_alike_need_a_stated_clock(truth, seen):
    """A log that repeats the recording."""
    log = synthetic.worn(truth, 3, ("shank_r",), rest_s=0, beyond_s=0, clock_s=0)[0][0]
    twice = np.concatenate([log.time, log.time + 3.0])
    repeated = dataclasses.replace(
        log,
        time=twice,
        rate=np.tile(not_none(log.rate), (2, 1)),
        acceleration=np.tile(not_none(log.acceleration), (2, 1)),
    )
    with pytest.raises(ValueError, match="several times"):
        clock_of(seen, [oriented(repeated)], None)
    assert clock_of(seen, [oriented(repeated)], 3.1)[0] == pytest.approx(3.0, abs=0.02)
    assert clock_of(seen, [oriented(repeated)], (1.5, 9.0))[0] == pytest.approx(3.0, abs=0.02)
    with pytest.raises(ValueError, match="several times"):
        clock_of(seen, [oriented(repeated)], (-9.0, 9.0))
    # The wall clocks are wrong: the movement tells.
    assert clock_of(seen, [oriented(log)], (100.0, 120.0))[0] == pytest.approx(0.0, abs=0.02)


def test_wall_clocks_bound_the_place_of_a_video():
    log = dataclasses.replace(turning(4.0)[0], started_utc=1772356530.0)  # 2026-03-01T09:15:30Z
    video: Any = SimpleNamespace(time_s=np.array([0.0, 3.0]))
    recorded = ["2026-03-01T09:16:10Z", None]
    assert places([log], recorded, [video] * 2) == [(40 - 3 - 10, 40 + 10), None]
    assert places([turning(4.0)[0]], recorded, [video] * 2) == [None, None]


def test_another_log_is_refused(truth, seen):
    log = synthetic.worn(truth, 3, ("shank_r",), clock_s=500.0)[0][0]
    with pytest.raises(ValueError, match="does not reach"):
        clock_of(seen, [oriented(log)], 0.0)


def test_a_log_that_ends_within_the_recording_or_rests_all_the_time(truth, seen):
    """The video goes on 0.9 s after the log, which a stride would hide."""
    (log,) = synthetic.worn(truth, 3, ("shank_r",), clock_s=0.0)[0]
    sensor = oriented(cut(log, log.time < truth.time_s[-1] - 0.9))
    assert clock_of(seen, [sensor], None)[0] == pytest.approx(0.0, abs=0.02)
    with pytest.raises(ValueError, match="nowhere"):
        clock_of(seen, [oriented(cut(log, log.time < -0.6))], -3.5)


def cut(log: SensorLog, rows: np.ndarray) -> SensorLog:
    assert log.rate is not None
    assert log.acceleration is not None
    return dataclasses.replace(log, time=log.time[rows], rate=log.rate[rows], acceleration=log.acceleration[rows])


def test_an_acceleration_that_is_missing_does_not_change_the_heading(truth, seen):
    """A pelvis' sensor that states its orientation."""
    (log,), _ = synthetic.worn(truth, 3, ("pelvis",), clock_s=0.0)
    own = dataclasses.replace(log, orientation=oriented(log).at(log.time)[0], rate=None)
    assert own.acceleration is not None
    lacking = own.acceleration.copy()
    lacking[len(lacking) // 2] = np.nan
    a, b = (
        wahba(vectors(seen, 0.0, oriented(dataclasses.replace(own, acceleration=acc)), "pelvis"))
        for acc in (own.acceleration, lacking)
    )
    assert np.rad2deg(Rotation.from_matrix(a @ b.T).magnitude()) < 2
    none = dataclasses.replace(own, acceleration=np.full_like(lacking, np.nan))
    assert len(vectors(seen, 0.0, oriented(none), "pelvis")) == 2


def test_the_length_of_a_run_counts_not_that_of_the_log():
    sensor = oriented(turning(20.0, slice(500, 550))[0])
    late, early = sensor.part(np.arange(6, 9, 0.1)), sensor.part(np.arange(1, 3, 0.1))
    assert (late.settled, early.settled) == (True, False)
    assert early.span == pytest.approx((0.0, 4.99))


def test_a_first_solution_has_no_variances(monkeypatch):
    from pbl_pipeline.fit import lanes

    monkeypatch.setattr(lanes, "_finish_one", lambda *_: pytest.fail("variances of a solution that is not the last"))
    monkeypatch.setattr(lanes, "_kept", lambda end: end)
    end: Any = SimpleNamespace(latest=SimpleNamespace(x=np.zeros(1), dispersion=np.ones(1)))
    found = lanes.fetch(end, end, last=False)
    assert (found.variance, found.x) == (None, [0.0])


@pytest.mark.parametrize("exchanged", [(), ("shank_r", "shank_l"), ("thigh_r", "thigh_l"), ("shank_l", "foot_l")])
def test_exchanged_sensors_are_named(truth, seen, exchanged):
    to = dict(zip(exchanged, reversed(exchanged), strict=True))
    logs, _ = synthetic.worn(truth, 5)
    sensors = [oriented(dataclasses.replace(log, segment=to.get(log.segment, log.segment))) for log in logs]
    clock = clock_of(seen, sensors, 0.0)[0]
    assert better_pairing(seen, clock, sensors) == SEGMENTS


def fitted(**more) -> SensorFit:
    values = {
        **dict.fromkeys(("heading_rad", "tilt_rad", "clock_s", "off_s", "gain", "dropped", "slip"), 0.0),
        "name": "a",
        "segment": "shank_r",
        "moves_with": "shank_r",
        "mounting": np.array([1.0, 0, 0, 0]),
        "bias_rad_s": np.zeros(3),
        "z": 0.8,
        "rate_rad_s": 2.0,
    }
    return SensorFit(**{**values, **more})


@pytest.mark.parametrize(
    ("more", "check", "outcome"),
    [
        ({}, "", PASS),
        ({"moves_with": "shank_l"}, "sensors_on_another_segment", FAIL),
        ({"z": 2.5}, "sensor_misfit_sd", WARN),
        ({"slip": 3.0}, "sensor_slip_sd", WARN),
        ({"dropped": 0.5}, "sensor_share_dropped", WARN),
        ({"bias_rad_s": np.array([0.0, -0.1, 0.0])}, "sensor_bias", WARN),
        ({"rate_rad_s": 0.1}, "sensor_rate", WARN),
        ({"off_s": -40.0}, "sensor_wall_clock_s", WARN),
        ({"off_s": 0.3}, "", PASS),  # "0 s" off
    ],
)
def test_what_is_wrong_is_said(more, check, outcome):
    of_all = {k: v for k, v in more.items() if k in ("moves_with", "bias_rad_s")}
    unknown = dict.fromkeys(("z", "off_s", "clock_s", "slip", "rate_rad_s"), np.nan)
    lost = fitted(**unknown, dropped=1.0, **of_all)
    for trials in ((fitted(**more),), (lost, fitted(**more), fitted(**of_all))):
        checks = {c.check: c for c in _sensors(trials)}
        allowed = (check, "sensor_share_dropped") if len(trials) > 1 else (check,)
        assert all(c.outcome == PASS for name, c in checks.items() if name not in allowed)
        if check and not (check == "sensor_rate" and len(trials) > 1):
            assert checks[check].outcome == outcome
            assert "shank_r" in checks[check].advice or check in ("sensor_rate", "sensor_wall_clock_s")
    assert _sensors(()) == []
    assert {c.check for c in _sensors((lost,)) if c.outcome != PASS} >= {"sensor_misfit_sd", "sensor_share_dropped"}


def test_least_standard_deviations_fall_where_both_segments_have_sensors():
    names = ("hip_flexion_r", "hip_flexion_l", "knee_angle_r", "ankle_angle_r", "lumbar_bending")
    shares = floor_shares(names, ["pelvis", "thigh_r", "shank_r"])
    hip, knee, ankle = (FLOOR_SHARES[name][1] for name in ("hip_flexion", "knee_", "ankle_"))
    assert shares.tolist() == [hip[2], hip[1], knee[2], ankle[1], 1.0]
    assert all(np.all(np.diff(of) < 0) for _, of in FLOOR_SHARES.values())


def test_a_sensor_that_measured_nothing_in_a_trial_leaves_its_floors():
    names, n = ("knee_angle_r",), 4
    sensors = [SimpleNamespace(log=SimpleNamespace(segment=s)) for s in ("thigh_r", "shank_r")]
    count = np.ones((2 * n, 2))
    count[n:, 1] = 0
    session: Any = SimpleNamespace(
        worn=SimpleNamespace(sensors=sensors),
        body=SimpleNamespace(joint_names=names),
        arrays=[SimpleNamespace(used=np.ones(n, bool))] * 2,
        frames=lambda i: slice(i * n, (i + 1) * n),
    )
    problem: Any = SimpleNamespace(wearables=SimpleNamespace(count=count))
    _, (_, one, both) = FLOOR_SHARES["knee_"]
    assert shares_of_floors(session, problem)[:, 0].tolist() == [both] * n + [one] * n


def part(whole: Keypoints, at: slice) -> Keypoints:
    """Some frames of a recording, its time from 0."""
    n = len(whole.time_s)
    fields = {f.name: getattr(whole, f.name) for f in dataclasses.fields(whole)}
    rows = {k: v[at] for k, v in fields.items() if isinstance(v, np.ndarray) and len(v) == n}
    return dataclasses.replace(whole, **{**rows, "time_s": rows["time_s"] - rows["time_s"][0]})


def later(log: SensorLog, start_s: float) -> SensorLog:
    """A log without its samples before a time."""
    at = log.time >= start_s
    values = {k: v[at] for k in ("time", "rate", "acceleration", "orientation") if (v := getattr(log, k)) is not None}
    return dataclasses.replace(log, **values)


@pytest.mark.long
def test_one_log_of_two_recordings_makes_knees_better(tmp_path: Path):
    """Two parts of a walk seen from the front, whose places in the log are known to some tenths of a second."""
    made = synthesise(SynthSpec(seed=22, seconds=3.6, marker_set="blazepose_33", noise="memory"))
    truth, parts = made.truth, (slice(0, 45), slice(60, 108))
    trials = [part(made.keypoints, at) for at in parts]
    logs, mounts = synthetic.worn(truth, 4, ("thigh_r", "shank_r"))
    without = fit_session(trials, ["a", "b"], "blazepose")
    with_them = fit_session(trials, ["a", "b"], "blazepose", sensors=logs, sensor_clock_s=[0.3, 1.9])
    knee = truth.joint_names.index("knee_angle_r")

    def error(fit):
        each = [t.qpos[:, knee] - truth.qpos[at, knee] for t, at in zip(fit.trials, parts, strict=True)]
        return np.rad2deg(np.sqrt(np.nanmean(np.concatenate(each) ** 2)))

    assert error(with_them) < 0.9 * error(without)
    assert all(t.sensors == () for t in without.trials)
    for trial, at in zip(with_them.trials, parts, strict=True):
        assert [s.segment for s in trial.sensors] == ["thigh_r", "shank_r"]
        for sensor in trial.sensors:
            assert sensor.clock_s == pytest.approx(0.08 + truth.time_s[at.start], abs=0.02)
            assert sensor.moves_with == sensor.segment
            assert sensor.z < 1.5
            assert sensor.dropped < 0.1
            found = Rotation.from_quat(sensor.mounting, scalar_first=True) * mounts[sensor.segment].inv()
            assert np.rad2deg(found.magnitude()) < 25
        trial.save(tmp_path / "a.fit.npz")
        assert plain(TrialFit.load(tmp_path / "a.fit.npz").sensors) == plain(trial.sensors)
    failed = [c for c in with_them.qc if c.check.startswith("sensor") and c.outcome != PASS]
    assert failed == []
    # Sensors that were started after the first recording: it is fitted without them, and that is said.
    late = [later(log, truth.time_s[55] + 0.08) for log in logs]
    from_second = fit_session(trials, ["a", "b"], "blazepose", sensors=late, sensor_clock_s=[0.3, 1.9])
    first, second = (t.sensors for t in from_second.trials)
    assert all(np.isnan(s.clock_s) and s.dropped == 1 for s in first)
    assert all(np.isfinite(s.clock_s) and s.dropped < 0.1 for s in second)
    assert {c.check: c.outcome for c in from_second.qc}["sensor_share_dropped"] == WARN
    with pytest.raises(PblError, match="gauss-newton"):
        fit_session(trials, ["a", "b"], "paper-2025", sensors=logs)
