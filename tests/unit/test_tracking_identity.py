"""Nobody becomes somebody else: crossings, hiding, leaving and coming back."""

from dataclasses import replace

import numpy as np
import pytest

from pbl_pipeline.tracking import JoinParams, UncrossParams, appearance_of, appearance_similarity
from pbl_pipeline.tracking.associate import Trail
from pbl_pipeline.tracking.identity_swaps import undo_swaps
from pbl_pipeline.tracking.reidentify import join_trails
from tests.unit.crossings import Walker, clothes, identities, scene
from tests.unit.test_tracking import person

BODY = 400.0
PARAMS = UncrossParams()


def pure(tracks: list[list[int]], n: int) -> bool:
    """Whether there is one track for each of `n` people, and each holds one person only."""
    return (
        sorted({k for t in tracks for k in t}) == list(range(n))
        and all(len(set(t)) == 1 for t in tracks)
        and len(tracks) == n
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(("fast", "slow"), [(0.3, -0.3), (0.6, -0.6), (0.9, -0.9), (1.3, -1.0), (0.7, 0.0), (1.0, 0.5)])
def test_two_who_cross_at_any_speed(seed, fast, slow):
    """Speeds in body heights per second, from a shuffle to a fast walk, against each other, past one who stands, and
    overtaking. While they overlap the one behind is not seen."""
    meet = 3.0
    back = Walker(lambda t: 900 + fast * BODY * (t - meet))
    front = Walker(lambda t: 900 + slow * BODY * (t - meet), height=430.0)
    seconds = 6.0
    assert pure(identities(scene([back, front], seconds, seed=seed)), 2)


@pytest.mark.parametrize("seed", range(5))
def test_two_who_meet_and_turn_back_are_told_by_their_clothes(seed):
    """The movement says that they passed each other."""

    def to_and_fro(side: int):
        return lambda t: 950 + side * (30 + 0.8 * BODY * abs(t - 2.5))

    left = Walker(to_and_fro(-1), appearance=clothes(1))
    right = Walker(to_and_fro(1), appearance=clothes(2))
    assert pure(identities(scene([left, right], 5.0, seed=seed, hide=0.7)), 2)


@pytest.mark.parametrize("seed", range(5))
def test_hidden_for_a_second_behind_somebody_or_a_pillar(seed):
    walker = Walker(lambda t: 300 + 0.6 * BODY * t, seen=lambda t: not 2.0 <= t < 3.0)
    assert pure(identities(scene([walker], 6.0, seed=seed)), 1)
    stander = Walker(lambda t: 850.0, height=600.0, y=600.0)
    walker = Walker(lambda t: 200 + 0.7 * BODY * t)
    assert pure(identities(scene([walker, stander], 5.0, seed=seed, hide=0.3)), 2)


def test_three_people_in_a_corridor():
    patient = Walker(lambda t: 300 + 0.5 * BODY * t, appearance=clothes(1))
    therapist = Walker(lambda t: 120 + 0.5 * BODY * t, height=440.0, appearance=clothes(2))
    passer = Walker(lambda t: 1800 - 0.9 * BODY * t, appearance=clothes(3))
    for seed in range(5):
        assert pure(identities(scene([passer, patient, therapist], 5.0, seed=seed, hide=0.8)), 3)


def away(t: float) -> bool:
    return not 2.0 <= t < 7.0


def test_who_leaves_and_comes_back_is_known_by_the_clothes():
    patient = Walker(lambda t: 1200 + 500 * t if t < 4.5 else 1200 + 500 * (9 - t), appearance=clothes(1))
    other = Walker(lambda t: 300.0, appearance=clothes(2))
    frames = scene([patient, other], 9.0)
    assert pure(identities(frames), 2)
    # Without looks nobody knows, and none is joined.
    bare = [Walker(patient.x), Walker(other.x)]
    assert sorted(len(set(t)) for t in identities(scene(bare, 9.0))) == [1, 1, 1]


def test_somebody_else_who_comes_in_is_somebody_else():
    first = Walker(lambda t: 1200 + 500 * t, seen=lambda t: t < 2, appearance=clothes(1))
    second = Walker(lambda t: 1900 - 500 * (t - 5), seen=lambda t: t > 5, appearance=clothes(2))
    assert pure(identities(scene([first, second], 8.0)), 2)


def test_two_in_the_same_clothes_are_not_joined():
    """She leaves, and one of two in the same white coats comes in: who is not known."""
    coat = clothes(1)
    first = Walker(lambda t: 1200 + 500 * t, seen=lambda t: t < 2, appearance=coat)
    colleague = Walker(lambda t: 300.0, appearance=coat)
    second = Walker(lambda t: 1900 - 500 * (t - 5), seen=lambda t: t > 5, appearance=coat)
    assert pure(identities(scene([first, colleague, second], 8.0)), 3)


def test_coming_back_after_too_long_is_somebody_new():
    late = 3.0 + JoinParams().return_gap_s
    patient = Walker(lambda t: 900.0, seen=lambda t: t < 2 or t > late, appearance=clothes(1))
    assert len(identities(scene([patient], late + 2))) == 2


# --- exchange after an encounter, by hand -------------------------------------------------------------------------


def trail(x, appearance=None, side=BODY, n: int = 41) -> Trail:
    t = [0.1 * i for i in range(n)]
    return Trail(list(range(n)), t, [replace(person(x(s), 500, side), appearance=appearance) for s in t], np.zeros(3))


def places(t: Trail) -> list[float]:
    return [float(d.roi_px[0]) for d in t.detections]


def test_a_mistaken_exchange_is_undone_and_a_right_track_is_left_alone():
    def right(t):
        return 100 + 400 * t

    def left(t):
        return 1700 - 400 * t

    a, b = undo_swaps([trail(right), trail(left)], PARAMS)
    assert places(a) == pytest.approx([right(0.1 * i) for i in range(41)])
    mixed = trail(lambda t: right(t) if t < 2 else left(t)), trail(lambda t: left(t) if t < 2 else right(t))
    a, b = undo_swaps(mixed, PARAMS)
    assert places(a) == pytest.approx([right(0.1 * i) for i in range(41)], abs=45)
    assert places(b)[-1] == pytest.approx(left(4.0))


def test_size_alone_tells_them_apart():
    """A child and an adult stand beside each other, come close for a second and part again."""

    def beside(side: int):
        return lambda t: 900.0 + side * (40 if 1.5 < t < 2.5 else 200)

    adult, child = trail(beside(1), side=500), trail(beside(-1), side=300)
    mixed = [
        Trail(adult.frames, adult.times, [*adult.detections[:20], *child.detections[20:]], np.zeros(3)),
        Trail(child.frames, child.times, [*child.detections[:20], *adult.detections[20:]], np.zeros(3)),
    ]
    for tracks in (mixed, [adult, child]):
        sizes = [
            {float(d.roi_px[2]) for d in (*t.detections[:15], *t.detections[26:])} for t in undo_swaps(tracks, PARAMS)
        ]
        assert sizes == [{500.0}, {300.0}]


def test_an_encounter_without_an_end_changes_nothing():
    """They are together to the last frame: nothing is known of what comes after."""
    a, b = trail(lambda t: 300 + 300 * min(t, 2.0)), trail(lambda t: 1500 - 290 * min(t, 2.0))
    assert [places(t) for t in undo_swaps([a, b], PARAMS)] == [places(a), places(b)]


# --- looks --------------------------------------------------------------------------------------------------------


def test_clothes_of_which_nothing_is_known_decide_nothing():
    """Of one the look is known, for the other's nobody asked."""
    known, unknown = trail(lambda t: 100 + 400 * t, clothes(1)), trail(lambda t: 1700 - 400 * t)
    assert [places(t) for t in undo_swaps([known, unknown], PARAMS)] == [places(known), places(unknown)]
    later = Trail([f + 200 for f in unknown.frames], [t + 20 for t in unknown.times], unknown.detections, np.zeros(3))
    assert len(join_trails([known, later], (1920, 1080), JoinParams())) == 2


def test_look_tells_clothes_and_not_place_size_or_light():
    def figure(x: int, size: int, shirt, trousers, light: float = 1.0) -> np.ndarray:
        image = np.full((600, 1200, 3), 128, np.uint8)
        image[300 - size // 4 : 300, x - size // 8 : x + size // 8] = np.array(shirt) * light
        image[300 : 300 + size // 3, x - size // 8 : x + size // 8] = np.array(trousers) * light
        return appearance_of(image, np.array([x, 300.0, np.log(size)]), 0.0)

    red, blue, dark = (40, 40, 200), (200, 80, 40), (40, 40, 40)
    same = figure(300, 400, red, dark)
    assert same.shape == (140,)
    assert appearance_similarity(same, same) == pytest.approx(1.0)
    assert appearance_similarity(same, figure(800, 300, red, dark)) > 0.97
    assert appearance_similarity(same, figure(800, 400, red, dark, light=0.9)) > 0.8
    assert appearance_similarity(same, figure(300, 400, blue, dark)) < 0.7
    assert appearance_similarity(same, figure(300, 400, red, blue)) < 0.7
    outside = appearance_of(np.zeros((50, 50, 3), np.uint8), np.array([-5.0, 20.0, 3.0]), 0.0)
    assert np.isnan(outside).all()
    assert np.isnan(appearance_similarity(same, outside))
