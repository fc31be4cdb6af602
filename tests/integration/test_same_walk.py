"""One walk, changed in nothing that matters, is no change: the demo recording through the whole chain, each variant a
visit of its own, and every pair of them compared as the page compares visits."""

import itertools
from collections.abc import Iterator

import numpy as np
import pytest

from pbl_pipeline.video import read_frames
from pbl_schemas import gdi, qc
from pbl_schemas.reading import comparison
from pbl_workers.populate import populate
from research.benchmarks.same_walk import VARIANTS, encoded
from tests.rows import register, remove_all
from tests.unit.test_blazepose import asset
from tests.videos import write_video

pytestmark = [pytest.mark.long, pytest.mark.slow]

#: The variants of `research.benchmarks.same_walk`, and the picture as it is in another container.
KINDS = (*VARIANTS, "other container")
#: Here the detector sees the legs so badly that steps are missing between those found: no complete cycle, no number.
BLURRED = "a tenth"
#: The recording played faster: more steps a minute than walking has, as where each step of a slow walk counts twice.
HASTY, TIME_SHARE = "hasty", 0.6
#: Root mean square difference (deg) of two mean curves from which on a reader would see a change.
SEEN_DEG = 5.0


@pytest.fixture(scope="module")
def visits(declared: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, int]]:
    """A visit of each variant; its number by the variant's name. The stages are the real ones."""
    folder = tmp_path_factory.mktemp("videos")
    demo = asset("demo_video")
    for i, kind in enumerate(KINDS):
        name = folder / f"{i}.{'mkv' if kind == 'other container' else 'mp4'}"
        register(encoded(demo, kind if kind in VARIANTS else "as it is", name), session_label=kind)
    faster = [TIME_SHARE * f.time_s for f in read_frames(demo)]
    register(write_video(folder / "hasty.mp4", (f.image for f in read_frames(demo)), faster), session_label=HASTY)
    populate()
    yield {kind: i + 1 for i, kind in enumerate((*KINDS, HASTY))}
    remove_all()


def test_no_pair_is_called_changed_and_curves_that_are_apart_have_their_reason(visits: dict[str, int]):
    called, unexplained = {}, {}
    for a, b in itertools.combinations(visits, 2):
        one, other = comparison.compare([(visits[a], None), (visits[b], None)]).compared
        assert (other.change is None) == bool({BLURRED, HASTY} & {a, b}), (a, b)
        changes = {"index": other.change, **other.changes} if other.change else other.changes
        called |= {(a, b, name): change for name, change in changes.items() if change.sure}
        keys = ["angle", "side", "percent"]
        both = one.curves.merge(other.curves, on=keys, suffixes=("", "_other"))
        seen = {}
        for curve, points in both.groupby(["angle", "side"]):
            apart = points["mean_deg"].to_numpy(float) - points["mean_deg_other"].to_numpy(float)
            if (rms := float(np.sqrt(np.mean(apart**2)))) > SEEN_DEG:
                seen[curve] = rms
        if seen and not other.differs:
            unexplained[a, b] = seen
    assert not called
    assert not unexplained


def test_no_number_is_given_where_the_steps_are_too_many_for_walking(visits: dict[str, int]):
    about = {"session_id": visits[HASTY]}
    numbers = (gdi.SessionGdi & about).fetch1("session_gdi", "session_cadence", "session_gdi_reason")
    assert numbers == (None, None, "the cadence is unusual for walking, and no one has accepted it")
    value = (qc.SessionQc.Check * qc.SessionQc & about & {"qc_check": "cadence_plausible"}).fetch1("qc_value")
    assert value > 150


def test_no_number_is_given_where_steps_are_missed(visits: dict[str, int]):
    measures = (gdi.SessionGdi & {"session_id": visits[BLURRED]}).fetch1()
    assert (measures["session_gdi"], measures["session_cadence"]) == (None, None)
    assert measures["session_gdi_reason"].endswith("this recording has 0 left and 0 right ones of 0 cycles in all")
