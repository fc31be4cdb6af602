"""The coordinate-based events against a walker of known events, and everything that is not walking."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline import gait
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import EventParams, load_events
from pbl_pipeline.gait.events import METHODS, GaitEvent
from pbl_pipeline.gait.events.coordinates import _walks, prominence
from pbl_pipeline.gait.events.order import Candidate, best_sequence
from pbl_pipeline.gait.events.signal import Segment, refine_extremum, uniform_segments

from .gait_walker import Walker, errors_s, make_feet

DURATION_S = 9.0


def detect_events(feet: gait.FootTrajectories, params: str | EventParams = "zeni-2008") -> gait.GaitEvents:
    return gait.detect_events(feet, params)


def regular(fps: float) -> np.ndarray:
    return np.arange(int(DURATION_S * fps)) / fps


def irregular(fps: float, seed: int = 1) -> np.ndarray:
    """Stamps with 30 % jitter of the interval and every 17th frame dropped, as phones write them."""
    rng = np.random.default_rng(seed)
    time = np.cumsum((1 + 0.3 * rng.uniform(-1, 1, int(DURATION_S * fps))) / fps)
    return np.delete(time, np.arange(5, len(time), 17))


def errors_of(feet: gait.FootTrajectories, walker: Walker) -> np.ndarray:
    """Errors (s) of the events of a walker, without those at the ends."""
    found, last_s = detect_events(feet), feet.time_s[-1]
    assert found.status == "PASS"
    return errors_s(found, walker.events(last_s), 0.5, last_s)


@pytest.mark.parametrize("fps", [30.0, 60.0, 120.0])
@pytest.mark.parametrize("make_time", [regular, irregular])
def test_events_within_half_a_frame(fps, make_time):
    walker = Walker()
    error = errors_of(make_feet(make_time(fps), walker), walker)
    assert len(error) > 20
    assert np.abs(error).max() < 0.5 / 30.0
    assert np.abs(error).mean() < 0.010


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 180.0, -47.0])
@pytest.mark.parametrize("speed", [1.2, 0.0])
def test_any_heading_and_a_pelvis_that_stands_still(heading_deg, speed):
    walker = Walker()
    feet = make_feet(regular(30), walker, heading_deg=heading_deg, speed_m_per_s=speed)
    expected = [np.cos(np.radians(heading_deg)), np.sin(np.radians(heading_deg)), 0.0]
    np.testing.assert_allclose(feet.forward[30:-30].mean(axis=0), expected, atol=0.03)
    assert np.abs(errors_of(feet, walker)).max() < 0.5 / 30
    if speed == 0:
        assert np.isnan(feet.heading_agreement)
    else:
        assert feet.heading_agreement > 0.98


def test_a_turn_by_180_degrees():
    time = regular(60)
    walker = Walker()
    turn = 180 / (1 + np.exp(-(time - 4.5) / 0.4))
    assert np.abs(errors_of(make_feet(time, walker, heading_deg=turn), walker)).max() < 1 / 60


def test_noise_and_scale():
    walker = Walker()
    error = errors_of(make_feet(irregular(30), walker, noise_m=0.012, scale=37.0), walker)
    assert np.sqrt(np.mean(error**2)) < 0.03
    assert np.abs(error).max() < 0.08


def test_asymmetric_walking_keeps_both_sides():
    walker = Walker(right_delay=0.58)
    assert np.abs(errors_of(make_feet(regular(30), walker), walker)).max() < 0.5 / 30


def test_probability_falls_with_the_size_of_the_movement():
    time = regular(30)
    feet = make_feet(time, Walker())
    large = detect_events(feet)
    small = detect_events(make_feet(time, Walker(amplitude_m=0.08)))
    unsure = detect_events(dataclasses.replace(feet, confidence=np.full((len(time), 2), 0.4)))
    assert np.median([e.probability for e in large.events]) > 0.85
    assert np.mean([e.probability for e in small.events]) < np.mean([e.probability for e in large.events]) - 0.02
    assert max(e.probability for e in unsure.events) <= 0.4


def test_a_long_gap_splits_the_bout_a_short_one_does_not():
    time = regular(30)
    walker = Walker()
    feet = make_feet(time, walker)

    def without(start, stop):
        heel = feet.heel_m.copy()
        heel[(time > start) & (time < stop)] = np.nan
        return detect_events(dataclasses.replace(feet, heel_m=heel))

    short, long = without(4.0, 4.08), without(4.0, 5.5)
    assert len(short.walking_s) == 1
    assert len(short.events) == len(detect_events(feet).events)
    assert len(long.walking_s) == 2
    assert not [e for e in long.events if 4.0 < e.time_s < 5.5]
    assert {e.bout for e in long.events} == {0, 1}
    for e in long.events:
        assert min(abs(e.time_s - t) for t, s, k in walker.events(time[-1]) if (s, k) == (e.side, e.event)) < 0.02


def test_standing_is_empty():
    found = detect_events(make_feet(irregular(30), None, speed_m_per_s=0.0, noise_m=0.01))
    assert found.status == "EMPTY"
    assert found.events == ()
    assert "no walking" in found.reason
    assert found.qc[0].outcome == "EMPTY"


def test_sit_to_stand_is_empty():
    """The pelvis moves over the feet and back: large movement of both feet against it, together."""
    time = regular(30)
    feet = make_feet(time, None, speed_m_per_s=0.0, noise_m=0.004)
    shift = 0.2 * np.sin(2 * np.pi * time / 2.4)
    moved = feet.pelvis_m + shift[:, None] * np.array([1.0, 0, 0])
    found = detect_events(dataclasses.replace(feet, pelvis_m=moved))
    assert found.status == "EMPTY"
    assert "pass each other" in found.reason


def test_one_leg_swinging_is_empty():
    time = regular(30)
    feet = make_feet(time, Walker(), speed_m_per_s=0.0)
    standing = make_feet(time, None, speed_m_per_s=0.0)
    heel, toe = feet.heel_m.copy(), feet.toe_m.copy()
    heel[:, 1], toe[:, 1] = standing.heel_m[:, 1], standing.toe_m[:, 1]
    found = detect_events(dataclasses.replace(feet, heel_m=heel, toe_m=toe))
    assert found.status == "EMPTY"
    assert "order" in found.reason


def test_too_fast_for_walking_is_empty():
    assert detect_events(make_feet(regular(60), Walker(stride_s=0.5))).status == "EMPTY"


def test_short_view_is_empty():
    found = detect_events(make_feet(regular(30)[:25], Walker()))
    assert found.status == "EMPTY"
    assert "1 s at a time" in found.reason


def test_standing_then_walking_gives_only_the_walk():
    time = regular(30)
    walker = Walker()
    walking, standing = make_feet(time, walker), make_feet(time, None)
    gain = np.clip((time - 3.0) / 0.5, 0, 1)[:, None, None]
    heel = standing.heel_m + gain * (walking.heel_m - standing.heel_m)
    toe = standing.toe_m + gain * (walking.toe_m - standing.toe_m)
    found = detect_events(dataclasses.replace(walking, heel_m=heel, toe_m=toe))
    assert len(found.walking_s) == 1
    assert found.walking_s[0][0] > 2.8


def test_walking_backwards_is_empty():
    found = detect_events(make_feet(regular(30), Walker(), speed_m_per_s=-1.0))
    assert (found.status, found.events) == ("EMPTY", ())
    assert "backwards" in found.reason
    assert "left and right" in found.qc[0].advice


def test_a_way_that_is_not_where_the_pelvis_faces_warns():
    feet = dataclasses.replace(make_feet(regular(30), Walker()), heading_agreement=0.1)
    found = detect_events(feet)
    assert found.status == "PASS"
    assert next(c for c in found.qc if c.check == "heading_agreement").outcome == "WARN"


def test_no_frame_is_an_error():
    feet = make_feet(regular(30), Walker())
    with pytest.raises(PblError, match="GAIT_INPUT"):
        detect_events(dataclasses.replace(feet, heel_m=np.full_like(feet.heel_m, np.nan)))


def test_time_out_of_order_is_an_error():
    feet = make_feet(regular(30), Walker())
    time = feet.time_s.copy()
    time[10] = time[9]
    with pytest.raises(PblError, match="GAIT_INPUT"):
        dataclasses.replace(feet, time_s=time)


def test_offsets_move_events_and_change_the_hash():
    feet = make_feet(regular(30), Walker())
    plain, moved = detect_events(feet), detect_events(feet, EventParams(foot_down_offset_s=0.03))
    shift = np.array(moved.times("left", "foot_down")) - plain.times("left", "foot_down")
    np.testing.assert_allclose(shift, 0.03)
    assert moved.times("left", "foot_up") == plain.times("left", "foot_up")
    assert plain.params_hash == METHODS["zeni-2008"].hash != moved.params_hash


def test_unknown_method_is_an_error():
    with pytest.raises(PblError, match="SOLVER_UNKNOWN"):
        detect_events(make_feet(regular(30), Walker()), "psychic")


def sequence(*weights: float) -> list[Candidate]:
    """Left down at 0, right up, right down, left up, left down, ... every 0.1 (up) and 0.45 s (down)."""
    kinds = [("left", "foot_down"), ("right", "foot_up"), ("right", "foot_down"), ("left", "foot_up")]
    time, out = 0.0, []
    for i, w in enumerate(weights):
        out.append(Candidate(time, *kinds[i % 4], w))
        time += 0.1 if i % 2 == 0 else 0.45
    return out


def test_order_drops_a_spurious_event():
    good = sequence(*[0.9] * 12)
    spurious = Candidate(good[4].time_s + 0.3, "left", "foot_down", 0.6)
    assert best_sequence([*good, spurious], EventParams()) == [good]


def test_order_splits_at_a_missing_event():
    good = sequence(*[0.9] * 16)
    parts = best_sequence(good[:7] + good[8:], EventParams())
    assert parts == [good[:7], good[8:]]


def test_order_splits_outside_the_cadence():
    good = sequence(*[0.9] * 8)
    late = [dataclasses.replace(c, time_s=c.time_s + 1.1) for c in good[4:]]  # step of 1.65 s, 36 steps/min
    assert best_sequence(good[:4] + late, EventParams()) == [good[:4], late]
    assert best_sequence([], EventParams()) == []


def test_file_round_trip(tmp_path):
    found = detect_events(make_feet(regular(30), Walker()))
    path = tmp_path / "events.csv"
    found.save(path)
    assert path.read_text().splitlines()[0] == "time_s,side,event,probability"
    again = load_events(path)
    assert [(e.side, e.event) for e in again] == [(e.side, e.event) for e in found.events]
    np.testing.assert_allclose([e.time_s for e in again], [e.time_s for e in found.events], atol=1e-4)


def test_the_order_in_the_file_does_not_matter(tmp_path):
    path = tmp_path / "events.csv"
    path.write_text("time_s,side,event,probability\n2.0,left,foot_down,1\n1.0,right,foot_up,1\n")
    assert [e.time_s for e in load_events(path)] == [1.0, 2.0]


@pytest.mark.parametrize(
    "text",
    [
        "",
        "time,side\n",
        "time_s,side,event,probability\n1.0,middle,foot_down,0.5\n",
        "time_s,side,event,probability\nnan,left,foot_down,0.5\n",
        "time_s,side,event,probability\ninf,left,foot_down,0.5\n",
        "time_s,side,event,probability\n1.0,left,foot_down,1.5\n",
        "time_s,side,event,probability\n1.0,left,foot_down,nan\n",
    ],
)
def test_broken_file_is_an_error(tmp_path, text):
    path = tmp_path / "events.csv"
    path.write_text(text)
    with pytest.raises(PblError, match="FILE_FORMAT"):
        load_events(path)


def test_an_event_knows_its_words():
    with pytest.raises(ValueError, match="not one of"):
        GaitEvent(0.0, "left", "heel_strike", 1.0)


# --- The uniform grid, its filter and the refinement of extrema.


ABOUT = {"grid_hz": 100.0, "cutoff_hz": 6.0, "filter_order": 4, "max_gap_s": 0.15, "min_segment_s": 1.0}


def gain(hz: float) -> float:
    time = np.arange(0, 10, 0.005)
    (segment,) = uniform_segments(time, np.sin(2 * np.pi * hz * time)[:, None], **ABOUT)
    middle = (segment.time_s > 2) & (segment.time_s < 8)
    return float(np.ptp(segment.values[middle, 0]) / 2)


def test_filter():
    assert gain(1.0) == pytest.approx(1.0, abs=0.005)
    assert gain(6.0) == pytest.approx(2**-0.5, abs=0.01)  # -3 dB over both passes
    assert gain(24.0) < 0.02


def test_filter_has_no_lag():
    time = np.arange(0, 6, 1 / 60)
    (segment,) = uniform_segments(time, np.cos(2 * np.pi * time)[:, None], **ABOUT)
    at = 200 + int(np.argmax(segment.values[150:250, 0])) - 50
    assert segment.time_s[at] == pytest.approx(2.0, abs=0.006)


def test_segments_end_at_gaps():
    time = np.arange(300) / 30
    values = np.sin(time)[:, None].repeat(2, axis=1)
    values[100:104, 0] = np.nan  # five intervals, 0.167 s: a gap
    values[200:203, 1] = np.nan  # four intervals, 0.133 s: interpolated
    values[290:294, 0] = np.nan  # what follows is too short
    segments = uniform_segments(time, values, **ABOUT)
    assert [s.frames for s in segments] == [(0, 99), (104, 289)]
    assert segments[1].time_s[0] == pytest.approx(time[104])
    assert np.all(np.diff(segments[1].time_s) == pytest.approx(0.01))


def test_a_parabola_is_found_exactly():
    time = np.arange(20) / 10
    for vertex in (0.93, 1.0, 1.049):
        values = 3 - 2 * (time - vertex) ** 2
        assert refine_extremum(time, values, int(np.argmax(values))) == pytest.approx(vertex, abs=1e-12)
    assert refine_extremum(time, -time, 0) == 0.0


def test_a_drop_cut_short_by_the_end_does_not_count():
    signal = np.array([0.0, 5, 10, 4, 8, 7])
    assert prominence(signal, 4, 3, 5) == 4.0  # right side cut short at the end: the left drop
    assert prominence(signal, 2, 0, 3) == 10.0  # left side reaches the start, the larger drop
    assert prominence(np.array([9.0, 0, 5, 3, 9]), 2, 1, 3) == 2.0


def test_feet_that_do_not_pass_each_other_do_not_walk():
    time = np.arange(0, 3, 0.01)
    run = [Candidate(0.5 + 0.5 * k, ("left", "right")[k % 2], "foot_down", 0.9) for k in range(4)]

    def segment(apart):
        values = np.zeros((len(time), 4))
        values[:, 0] = apart * np.sin(2 * np.pi * time)
        return Segment(time, values, (0, 90))

    assert _walks(run, segment(0.2), 1.0, EventParams())
    assert not _walks(run, segment(0.05), 1.0, EventParams())
    assert not _walks(run[:1], segment(0.2), 1.0, EventParams())
