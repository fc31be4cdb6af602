"""Whether two visits were filmed alike, and a change of the index between them."""

import dataclasses
import math

import pytest

from pbl_pipeline import charts
from pbl_pipeline.change import Change, Result, change_since
from pbl_pipeline.filming import Difference, Filming, differences, height_word, picture_class, stated, views_of
from pbl_pipeline.gait import Z90
from pbl_pipeline.render import SIDE_COLOUR
from pbl_pipeline.study_report import figures
from tests import not_none

FROM_LEFT = Filming(("left",), (), (), ("self_selected",), ("stated",), ("measured",), ("1080p",), "right")
CHAIN = ("fit", "events", "index", "norm")
BEFORE = Result("single", CHAIN, "PASS", "", 93.6, 4.0, 5.0, "PASS", (), False, FROM_LEFT)
MIRRORED = dataclasses.replace(FROM_LEFT, views=("right",), far_leg="left")


def after(index: float, filming: Filming, **fields) -> Result:
    return dataclasses.replace(BEFORE, index=index, filming=filming, **fields)


def test_a_mirrored_walk_is_not_called_changed():
    """Indices of a recording and its mirror image, further apart than the minimal change of visits filmed alike."""
    found = not_none(change_since(after(98.8, MIRRORED), BEFORE))
    assert found.by == pytest.approx(5.2)
    assert found.sure is False
    assert found.least == pytest.approx(Z90 * math.hypot(4.0, 4.0))
    assert found.differs == (Difference("view", ("right",), ("left",)),)
    alike = not_none(change_since(after(98.8, FROM_LEFT), BEFORE))
    assert (alike.sure, alike.least, alike.differs) == (True, 5.0, ())


def test_results_of_other_keypoints_are_not_alike():
    """As of a visit from before the default changed, whose fit, events and index are by the same methods."""
    earlier = dataclasses.replace(BEFORE, detection=("tiles-v5", "heavy-v4"))
    found = not_none(change_since(after(98.8, FROM_LEFT, detection=("tiles-v5", "heavy-v5")), earlier))
    assert (found.sure, found.real, found.differs) == (None, None, (Difference("methods"),))


def test_a_large_change_is_one_from_any_side():
    assert not_none(change_since(after(104.0, MIRRORED), BEFORE)).sure is True
    unknown = not_none(change_since(after(104.0, MIRRORED, sd=None), BEFORE))
    assert unknown.sure is None
    assert [d.what for d in unknown.differs] == ["view", "error"]


@pytest.mark.parametrize(
    ("what", "changed"),
    [
        ("aid", {"aid": ("cane",)}),
        ("orthosis", {"orthosis": ("ankle foot",)}),
        ("pace", {"paces": ("fast",)}),
        ("height", {"height": ("not_stated",)}),
        ("camera", {"cameras": ("guess",)}),
        ("picture", {"pictures": ("480p",)}),
    ],
)
def test_visits_that_were_not_filmed_alike_are_not_judged(what: str, changed: dict):
    other = dataclasses.replace(FROM_LEFT, **changed)
    for now, before in ((after(60.0, other), BEFORE), (BEFORE, after(60.0, other))):
        found = not_none(change_since(now, before))
        assert found.sure is None
        assert [d.what for d in found.differs] == [what]


def test_other_methods_and_corrected_events_are_named():
    other = dataclasses.replace(BEFORE, methods=("another", *CHAIN[1:]), corrected=True)
    assert change_since(other, BEFORE) == Change(0.0, None, None, (Difference("methods"), Difference("corrected")))


def test_what_is_not_known_is_not_compared():
    assert differences(FROM_LEFT, Filming()) == ()
    assert differences(FROM_LEFT, dataclasses.replace(Filming(), aid=("cane",))) == (Difference("aid", (), ("cane",)),)


def test_views_of_a_visit():
    one_pass = [("a", "right")] * 7 + [("a", "")]  # turned at the end
    assert views_of(one_pass) == ("left",)
    assert views_of([("a", "right")] * 4 + [("a", "")] * 3) == ("left",)  # oblique at first and at last
    assert views_of([*one_pass, ("b", "left")]) == ("left", "right")
    assert views_of([("a", "right"), ("a", "left")] * 4) == ("left", "right")  # there and back in one recording
    assert views_of([("a", "")] * 5) == ("front_or_back",)
    assert views_of([]) == ()


def test_words_of_what_is_stated():
    words = ("", " None ", "keine", "Rollator", "My  own")
    assert [stated("aid", t) for t in words] == [(), ("none",), ("none",), ("walker",), ("my own",)]
    none, unknown = dataclasses.replace(FROM_LEFT, aid=("none",)), FROM_LEFT
    assert differences(none, unknown) == differences(unknown, none) == ()
    cane = dataclasses.replace(FROM_LEFT, aid=("cane",))
    assert [str(d) for d in differences(cane, none)] == ["aid (cane, before: none)"]
    assert [str(d) for d in differences(cane, unknown)] == ["aid (cane, before: not stated)"]
    assert [height_word(h, False) for h in (None, math.nan, 1.7)] == ["not_stated", "not_stated", "stated"]
    sizes = [(1920, 1080), (1080, 1920), (1728, 972), (960, 540), (1280, 720), (3840, 2160), (0, 0)]
    assert [picture_class(*s) for s in sizes] == ["1080p", "1080p", "1080p", "480p", "720p", "2160p", ""]


def test_orange_and_blue_are_the_sides_alone():
    of_sides = {SIDE_COLOUR[side] for side in ("left", "right")} | {"#56b4e9", "#e69f00"}  # and their lighter shades
    used = {colour for colour, _ in charts.SERIES} | {*figures.GROUP_COLOURS, figures.BEFORE, figures.AFTER}
    assert not used & of_sides
    assert len({colour for colour, _ in charts.SERIES}) == len(charts.SERIES)
