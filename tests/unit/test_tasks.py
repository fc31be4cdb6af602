"""Measures of tasks against movements whose times are known."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.gait import (
    TASK_MEASURES,
    TRIAL_MEASURES,
    Condition,
    TaskMotion,
    gait_metrics,
    task_measures,
    task_motion,
)
from pbl_pipeline.gait.metrics_file import metrics_of
from pbl_pipeline.qc import FAIL, Check
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.words import TASKS
from tests import not_none
from tests.walking_fit import walking_fit

FPS = 50.0


def ease(x: np.ndarray) -> np.ndarray:
    """From 0 to 1 with the least jerk (Flash & Hogan 1985)."""
    x = np.clip(x, 0.0, 1.0)
    return 10 * x**3 - 15 * x**4 + 6 * x**5


#: Fraction of such a movement's time between 15 % and 85 % of its way.
_X = np.linspace(0.0, 1.0, 100_001)
MIDDLE = float(np.interp(0.85, ease(_X), _X) - np.interp(0.15, ease(_X), _X))


def motion(rises: list[tuple[float, float]], sits: list[tuple[float, float]], until_s: float) -> TaskMotion:
    """Somebody who sits first; each rise and sitting is (begin, length) in s. The trunk leans by 40 deg at seat-off."""
    t = np.arange(0.0, until_s, 1 / FPS)
    lowered = np.full(len(t), 0.5)
    for at, length in rises:
        lowered -= 0.45 * ease((t - at) / length)
    for at, length in sits:
        lowered += 0.45 * ease((t - at) / length)
    lean = np.full(len(t), 5.0)
    for at, _ in rises:
        lean += 35.0 * np.exp(-((t - at - 0.2) ** 2) / (2 * 0.3**2))
    return TaskMotion(t, lowered, lean, 180.0 * lowered, np.zeros(len(t)))


def five_times() -> TaskMotion:
    starts = [1.0 + 3.0 * k for k in range(5)]
    return motion([(s, 1.0) for s in starts], [(s + 1.4, 1.2) for s in starts], 17.0)


def test_five_rises_have_the_times_that_they_were_made_with():
    found, reasons = task_measures(five_times(), "sit_to_stand")
    assert reasons == {}
    assert tuple(found) == TASK_MEASURES["sit_to_stand"]
    begin = float(np.interp(0.15, ease(_X), _X))
    mean = {name: m.mean for name, m in found.items() if m is not None}
    # From 15 % of the first rise to 85 % of the fifth, 12 s later; smoothing lengthens a movement a little.
    assert mean["five_rises_time_s"] == pytest.approx(12.0 + MIDDLE, abs=0.02)
    assert mean["rise_time_s"] == pytest.approx(1.0 * MIDDLE, abs=0.02)
    assert mean["sit_time_s"] == pytest.approx(1.2 * MIDDLE, abs=0.02)
    assert mean["peak_trunk_lean_deg"] == pytest.approx(40.0, abs=1.0)
    assert (mean["rise_count"], 0 < begin < 0.5) == (5.0, True)


def test_what_was_not_done_is_unknown_with_the_reason():
    four = motion([(1.0 + 3 * k, 1.0) for k in range(4)], [(2.4 + 3 * k, 1.2) for k in range(4)], 14.0)
    found, reasons = task_measures(four, "sit_to_stand")
    assert found["five_rises_time_s"] is None
    assert reasons["five_rises_time_s"] == "five rises are needed, 4 were found"
    assert found["rise_time_s"] is not None
    found, reasons = task_measures(motion([], [], 5.0), "tug")
    assert not any(found.values())
    assert reasons["tug_time_s"] == "no rising from a seat was found"
    found, reasons = task_measures(motion([(1.0, 1.0)], [(6.0, 1.0)], 9.0), "tug")
    assert found["tug_time_s"] is not None
    assert reasons["turn_time_s"] == "two half turns are needed, 0 were found"
    found, reasons = task_measures(motion([], [], 5.0), "squat")
    assert not_none(found["squat_count"]).mean == 0.0
    assert "no squat" in reasons["squat_time_s"]


def test_a_person_out_of_view_has_no_total():
    whole = five_times()
    away = (whole.time_s > 8.3) & (whole.time_s < 9.6)  # sitting between two rises
    hidden = dataclasses.replace(whole, lowered=np.where(away, np.nan, whole.lowered))
    found, reasons = task_measures(hidden, "sit_to_stand")
    assert found["five_rises_time_s"] is None
    assert "out of view for 1.3 s" in reasons["five_rises_time_s"]
    short = (whole.time_s > 8.3) & (whole.time_s < 8.5)
    found, _ = task_measures(dataclasses.replace(whole, lowered=np.where(short, np.nan, whole.lowered)), "sit_to_stand")
    assert found["five_rises_time_s"] is not None


def test_a_failed_fit_is_not_measured():
    found, reasons = task_measures(five_times(), "sit_to_stand", [Check("residual_3d_cm", FAIL, 9.0, 7.0, "")])
    assert not any(found.values())
    assert set(reasons) == set(TASK_MEASURES["sit_to_stand"])
    assert task_measures(five_times(), "walking") == ({}, {})


@pytest.mark.parametrize("way", [1, -1])
def test_half_turns_are_found_either_way_round(way: int):
    plain = motion([(1.0, 1.0)], [(12.0, 1.0)], 15.0)
    t = plain.time_s
    sway = 6 * np.sin(2 * np.pi * t / 1.1)
    heading = way * 180.0 * (ease((t - 4.0) / 2.0) + ease((t - 9.0) / 2.0)) + 30.0 + sway
    found, reasons = task_measures(dataclasses.replace(plain, heading_deg=heading), "tug")
    assert reasons == {}
    mean = {name: m.mean for name, m in found.items() if m is not None}
    assert mean["tug_time_s"] == pytest.approx(11.0 + MIDDLE, abs=0.02)
    assert mean["turn_time_s"] == pytest.approx(2.0 * MIDDLE, abs=0.15)
    assert mean["walk_back_time_s"] == pytest.approx(5.0 - 2.0 * MIDDLE, abs=0.2)
    parts = ("rise_time_s", "walk_out_time_s", "turn_time_s", "walk_back_time_s", "turn_to_sit_time_s")
    assert sum(mean[p] for p in parts) < mean["tug_time_s"]


def parts(heading: np.ndarray, plain: TaskMotion) -> tuple[list[float | None], dict[str, str]]:
    """Walk out, turn, walk back and turn before sitting."""
    found, reasons = task_measures(dataclasses.replace(plain, heading_deg=heading), "tug")
    names = ("walk_out_time_s", "turn_time_s", "walk_back_time_s", "turn_to_sit_time_s")
    return [None if (m := found[name]) is None else m.mean for name in names], reasons


@pytest.mark.parametrize(
    ("seat", "turned", "bend"),
    [(0.0, 180.0, 0.0), (28.0, 180.0, 0.0), (-40.0, 180.0, 0.0), (0.0, 152.0, 0.0), (40.0, 220.0, 0.0), (0, 180, 25.0)],
)
def test_parts_do_not_depend_on_how_the_person_sits_or_on_the_angle_of_a_turn(seat: float, turned: float, bend: float):
    plain = motion([(1.0, 1.0)], [(12.0, 1.0)], 15.0)
    t = plain.time_s
    heading = seat * (1 - ease((t - 1.5) / 1.0)) + turned * ease((t - 4.5) / 1.5) + 200.0 * ease((t - 9.5) / 1.5)
    heading += bend * ease((t - 6.0) / 3.5)
    found, reasons = parts(heading, plain)
    rise_end = 1.0 + float(np.interp(0.85, ease(_X), _X))
    begin = 1.5 * float(np.interp(0.15, ease(_X), _X))
    wanted = [4.5 + begin - rise_end, 1.5 * MIDDLE, 5.0 - 1.5 * MIDDLE, 1.5 * MIDDLE]
    assert (found, reasons) == (pytest.approx(wanted, abs=0.08), {})


def test_what_is_not_two_half_turns_has_no_parts():
    plain = motion([(1.0, 1.0)], [(16.0, 1.0)], 19.0)
    t = plain.time_s
    found, reasons = parts(180.0 * np.sum([ease((t - at) / 1.5) for at in (4.0, 8.0, 12.0)], axis=0), plain)
    assert (found, reasons["turn_time_s"]) == ([None] * 4, "the person turned more often than twice")
    found, reasons = parts(180.0 * ease((t - 4.0) / 1.5) + 60.0 * ease((t - 12.0) / 1.5), plain)
    assert (found, reasons["turn_time_s"]) == ([None] * 4, "two half turns are needed, 1 were found")


def after_an_attempt(height: float, attempt_s: float, rises: int) -> TaskMotion:
    """Rises every four seconds and, at a time, one that ends at a fraction of the way."""
    starts = [4.0 * (k + 1) for k in range(rises)]
    plain = motion([(s, 1.0) for s in starts], [(s + 1.4, 1.0) for s in starts], 4.0 * rises + 5.0)
    t = plain.time_s
    lowered = plain.lowered - 0.45 * height * (ease((t - attempt_s) / 0.6) - ease((t - attempt_s - 0.7) / 0.6))
    return dataclasses.replace(plain, lowered=lowered, knee_deg=180.0 * lowered)


@pytest.mark.parametrize("height", [0.5, 0.8, 0.9])
def test_an_attempt_is_not_a_rise_and_its_time_counts(height: float):
    between, before = (
        {n: m and m.mean for n, m in task_measures(after_an_attempt(height, at, 5), "sit_to_stand")[0].items()}
        for at in (10.6, 2.0)
    )
    assert (
        (between["rise_count"], between["attempt_count"]) == (before["rise_count"], before["attempt_count"]) == (5, 1)
    )
    assert between["rise_time_s"] == pytest.approx(MIDDLE, abs=0.02)
    assert between["five_rises_time_s"] == pytest.approx(16.0 + MIDDLE, abs=0.02)
    assert before["five_rises_time_s"] == pytest.approx(18.0 + MIDDLE, abs=0.15)  # the clock runs from the first
    _, reasons = task_measures(after_an_attempt(height, 10.6, 3), "sit_to_stand")
    assert reasons["five_rises_time_s"] == (
        "five rises are needed, 3 were found (sat back before standing: 1, rose again before sitting: 0)"
    )


def test_a_high_seat_has_rises_and_a_doubtful_or_cut_one_is_not_counted():
    high = dataclasses.replace(five_times(), lowered=0.05 + (five_times().lowered - 0.05) / 3, knee_deg=np.zeros(850))
    assert not_none(task_measures(high, "sit_to_stand")[0]["rise_count"]).mean == 5.0
    found, reasons = task_measures(after_an_attempt(0.95, 10.6, 5), "sit_to_stand")
    assert found["rise_count"] is None
    assert reasons["five_rises_time_s"] == "a rise came 95 percent of the way up: whether the person stood is not known"
    late = {f.name: getattr(five_times(), f.name)[five_times().time_s > 1.5] for f in dataclasses.fields(TaskMotion)}
    assert task_measures(TaskMotion(**late), "sit_to_stand")[1] == {
        "five_rises_time_s": "the recording begins during a rise"
    }
    crouched = dataclasses.replace(five_times(), knee_deg=five_times().knee_deg + 40.0)
    found, reasons = task_measures(crouched, "sit_to_stand")
    assert not any(found.values())
    assert (
        reasons["rise_count"] == "the knees are never straighter than 49 degrees: whether the person stood is not known"
    )


def test_synthetic_squats_are_counted():
    truth = synthesise(SynthSpec("squat", 3, seconds=9.0)).truth
    names = ("time_s", "joint_names", "qpos", "scale")
    made: object = SimpleNamespace(name="squat", **{n: getattr(truth, n) for n in names})
    found, reasons = task_measures(task_motion(made), "squat")  # pyright: ignore[reportArgumentType]
    assert reasons == {}
    knee = np.degrees(-np.asarray(truth.qpos)[:, list(truth.joint_names).index("knee_angle_r")])
    peaks = np.sum((knee[1:-1] > 70) & (knee[1:-1] >= knee[:-2]) & (knee[1:-1] > knee[2:]))
    assert abs(not_none(found["squat_count"]).mean - peaks) <= 1  # the recording may end in a squat
    assert not_none(found["squat_knee_flexion_deg"]).mean == pytest.approx(knee.max(), abs=8.0)


def test_every_measure_of_a_task_has_a_name():
    assert set(TASKS) == {n for names in TASK_MEASURES.values() for n in names}


def test_a_trial_of_a_task_has_them_in_its_metrics_and_in_the_file():
    body = load_body()
    stands = walking_fit(body.joint_names, body.sha256, walks=False)
    metrics = gait_metrics([stands], conditions=[Condition("Sit-to-stand")])
    of_task = metrics.trials[0].spatiotemporal.of_task
    assert tuple(of_task) == tuple(n for n in TRIAL_MEASURES if n in TASK_MEASURES["sit_to_stand"])
    assert not_none(of_task["rise_count"]).mean == 0.0
    assert "five_rises_time_s" in metrics.table()
    again = metrics_of(json.loads(json.dumps(metrics.to_dict())), {}, {})
    assert again.trials[0].spatiotemporal.of_task == of_task
    assert again.trials[0].spatiotemporal.reasons == metrics.trials[0].spatiotemporal.reasons
    assert gait_metrics([stands]).trials[0].spatiotemporal.of_task == {}
