"""The uniform grid, its filter and the refinement of extrema."""

from __future__ import annotations

import numpy as np
import pytest

from pbl_pipeline.gait import EventParams
from pbl_pipeline.gait.events.coordinates import _walks, prominence
from pbl_pipeline.gait.events.order import Candidate
from pbl_pipeline.gait.events.signal import Segment, refine_extremum, uniform_segments

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
