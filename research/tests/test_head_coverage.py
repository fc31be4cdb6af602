"""Coverage of heads in recordings."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.deidentify import (
    find_heads,
)
from pbl_pipeline.deidentify.types import HELD
from pbl_pipeline.video import read_frames, write_h264
from research.heads.coverage import HeadCoverage, LocatedClip, LocatedHead, frame_coverage, head_coverage, located_clips
from tests.unit.test_blazepose import asset
from tests.unit.test_deidentify import SIZE, a_head, heads_of
from tests.videos import constant_rate


def test_coverage_by_hand():
    """A box of 20 px: wholly inside the circle, half inside, outside; and one that is hardly in the picture."""
    boxes = np.array([[90, 90, 110, 110], [125, 90, 145, 110], [300, 90, 320, 110], [-18, 90, 2, 110.0]])
    located = LocatedHead("a", False, np.arange(4), boxes)
    heads = heads_of(4, SIZE, a_head([(100, 100, 35)] * 4))
    heads.heads[0].source[1] = HELD
    (found,) = head_coverage(LocatedClip("c", "c.mp4", False, (located,)), heads)
    assert found.frames.tolist() == [0, 1, 2]
    assert found.fraction == pytest.approx([1, 0.5, 0], abs=0.03)
    assert found.certain.tolist() == [True, False, True]
    assert frame_coverage([found]) == (3, 1, 1)
    other = HeadCoverage("c", "b", np.array([0, 9]), np.array([0.2, 1.0]), np.array([True, True]))
    assert frame_coverage([found, other]) == (4, 1, 2)


@pytest.mark.long
@pytest.mark.slow
def test_the_heads_of_two_real_people_are_covered(tmp_path):
    """Some frames of the demo: one walks in the foreground, one stands on a wall behind."""
    video = asset("demo_video")
    asset("face_detector")
    first, n = 94, 12
    times = constant_rate(n)
    frames = ((t, f.image) for t, f in zip(times, read_frames(video, start=first, stop=first + n), strict=True))
    cut = tmp_path / "cut.mp4"
    write_h264(cut, frames, (1768, 994), times, 18)
    heads = find_heads(cut)
    clip = next(c for c in located_clips() if c.name == "demo")
    shifted = tuple(
        dataclasses.replace(h, frames=np.array(list(at)), boxes_px=np.array(list(at.values())), interpolate=False)
        for h in clip.heads
        if (at := {t - first: box for t, box in h.boxes().items() if first <= t < first + n})
    )
    found = head_coverage(dataclasses.replace(clip, heads=shifted), heads)
    assert {f.who: len(f.frames) for f in found} == {"walker": n, "man on the wall": 1}
    assert all(f.covered.all() for f in found)
    assert len(heads.heads) <= 4
