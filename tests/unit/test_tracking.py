"""Tiles, merging, association over time and the choice of the subject, against hand-worked and synthetic truth."""

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.models import box_iou
from pbl_pipeline.tracking import (
    AssociationParams,
    Detection,
    JoinParams,
    PersonTrack,
    Tracking,
    TrackingParams,
    body_box,
    choose_subject,
    circle_roi,
    contact_sheet,
    save_contact_sheet,
    time_in_view_s,
    track_people,
)
from pbl_pipeline.tracking.associate import Associator, Trail
from pbl_pipeline.tracking.detection_schedule import WatchParams, window_around
from pbl_pipeline.tracking.reidentify import join_trails
from pbl_pipeline.tracking.tiling import detect_in, merge, tile_starts, tiles
from pbl_pipeline.video import probe
from tests import refused
from tests.videos import constant_rate, write_as_they_are, write_video

HEIGHT = 400.0


def person(x: float, y: float, side: float = HEIGHT, score: float = 0.95, turn: float = 0.0) -> Detection:
    roi = np.array([x, y, side, turn])
    return Detection(box_px=body_box(roi), score=score, roi_px=roi)


# --- geometry ---------------------------------------------------------------------------------------------------


def test_box_iou_by_hand():
    box = np.array([0.0, 0.0, 2.0, 2.0])
    others = np.array([[0, 0, 2, 2], [1, 0, 3, 2], [2, 2, 3, 3], [1, 1, 1, 1]], float)
    np.testing.assert_allclose(box_iou(box, others), [1, 2 / 6, 0, 0])


@pytest.mark.parametrize(
    ("rim", "turn"), [((0, -5), 0.0), ((5, 0), np.pi / 2), ((-5, 0), -np.pi / 2), ((3, -4), np.arctan2(3, 4))]
)
def test_circle_rotation_is_clockwise_and_zero_when_upright(rim, turn):
    centre = np.array([10.0, 20.0])
    np.testing.assert_allclose(circle_roi(centre, centre + rim), [10, 20, 10, turn], atol=1e-12)


def test_body_box_turns_with_the_body():
    np.testing.assert_allclose(body_box(np.array([100, 200, 50, 0.0])), [90, 175, 110, 225])
    np.testing.assert_allclose(body_box(np.array([100, 200, 50, np.pi / 2])), [75, 190, 125, 210])


def test_rounding_of_a_network_moves_no_window_around_a_person():
    rng, n = np.random.default_rng(5), 4000
    states = np.column_stack([rng.uniform(0, 1920, n), rng.uniform(0, 1080, n), np.log(rng.uniform(60, 1000, n))])
    other = states + rng.normal(0, 1, (n, 3)) * [4e-4, 4e-4, 1e-6]

    def windows(states: np.ndarray, grid: float) -> np.ndarray:
        return np.array([window_around(s, WatchParams(window_grid=grid)) for s in states])

    found = windows(states, 1 / 16)
    assert np.mean((found != windows(other, 1 / 16)).any(axis=1)) < 5e-4
    assert np.mean((windows(states, 0.0) != windows(other, 0.0)).any(axis=1)) > 1e-3
    half = 0.5 * np.exp(states[:, 2:])
    assert (found[:, :2] < states[:, :2] - half).all()
    assert (found[:, 2:] > states[:, :2] + half).all()
    twice = windows(np.column_stack([2 * states[:, :2], states[:, 2] + np.log(2)]), 1 / 16)  # in a larger picture
    assert np.mean(np.abs(twice - 2 * found).max(axis=1) <= 2) > 0.999


@pytest.mark.parametrize(("width", "height"), [(1768, 994), (1080, 1920), (720, 1280), (64, 64), (4000, 500)])
@pytest.mark.parametrize("overlap", [0.25, 0.5])
def test_tiles_cover_the_frame_and_overlap(width, height, overlap):
    windows = tiles(width, height, 0.7, overlap)
    assert windows[0] == (0, 0, width, height)
    covered = np.zeros((height, width), int)
    side = round(0.7 * min(width, height))
    for x0, y0, x1, y1 in windows[1:]:
        assert (x1 - x0, y1 - y0) == (side, side)
        covered[y0:y1, x0:x1] += 1
    assert covered.min() >= 1
    for starts in (tile_starts(width, side, overlap), tile_starts(height, side, overlap)):
        assert np.all(np.diff(starts) <= side * (1 - overlap) + 1)


class Spots:
    """A detector that finds square spots: a spot of brightness 200 + n is a person n tens of px high."""

    name, model_sha256 = "spots", "0" * 64

    def detect(self, image: np.ndarray) -> list[Detection]:
        found = []
        for value in np.unique(image[image[:, :, 1] > 200][:, 1]) if image.size else []:
            y, x = np.nonzero(image[:, :, 1] == value)
            found.append(person(x.mean(), y.mean(), 10.0 * (float(value) - 200)))
        return found


def test_detection_in_windows_is_in_frame_pixels_and_counted_once():
    image = np.zeros((994, 1768, 3), np.uint8)
    image[600:611, 1000:1011] = 240
    (found,) = detect_in(Spots(), image, tiles(1768, 994, 0.7, 0.3))
    np.testing.assert_allclose(found.roi_px, [1005, 605, 400, 0])


def test_merge_averages_agreement_and_drops_the_wrong_size():
    agreeing = [(0.9, person(100, 300)), (0.6, person(110, 300)), (0.1, person(150, 300))]
    wrong_size = (0.8, person(160, 350, side=800, score=0.8))
    neighbour = (0.7, person(300, 300, score=0.7))
    found = merge([*agreeing, wrong_size, neighbour])
    assert len(found) == 2
    # 0.9 and 0.6 are averaged; the one trusted less than half as much only confirms.
    np.testing.assert_allclose(found[0].roi_px, [104, 300, 400, 0])
    np.testing.assert_allclose(found[1].roi_px, [300, 300, 400, 0])


def test_merge_averages_angles_on_the_circle():
    (found,) = merge([(0.9, person(0, 0, turn=3.1)), (0.9, person(0, 0, turn=-3.1))])
    assert abs(abs(found.roi_px[3]) - np.pi) < 1e-9


# --- association ------------------------------------------------------------------------------------------------


def follow(frames: list[list[Detection]], step_s: float = 0.1) -> list:
    associator = Associator(AssociationParams())
    for i, detections in enumerate(frames):
        for new in associator.step(i, i * step_s, detections):
            associator.begin(Trail.of(i, i * step_s, new))
    return associator.trails()


def test_two_people_who_pass_each_other_keep_their_identity():
    # They meet at 500; each moves 40 px per frame, so the nearest old place is often the other's.
    frames = [[person(100 + 40 * i, 500), person(900 - 40 * i, 520, side=380)] for i in range(21)]
    rng = np.random.default_rng(0)
    frames = [[f[k] for k in rng.permutation(2)] for f in frames]
    trails = follow(frames)
    assert len(trails) == 2
    for trail, (start, slope, side) in zip(
        sorted(trails, key=lambda t: t.state()[0], reverse=True), [(100, 40, 400), (900, -40, 380)], strict=True
    ):
        assert [d.roi_px[2] for d in trail.detections] == [side] * 21
        np.testing.assert_allclose([d.roi_px[0] for d in trail.detections], start + slope * np.arange(21))


def test_a_short_gap_is_bridged_and_a_long_one_is_not():
    here = [person(500, 500)]
    assert len(follow([here] * 5 + [[]] * 9 + [here] * 5)) == 1
    assert len(follow([here] * 5 + [[]] * 11 + [here] * 5)) == 2


def test_a_weak_or_upside_down_detection_does_not_take_over_a_track():
    walk = [[person(500 + 10 * i, 500)] for i in range(5)]
    trails = follow([*walk, [], [], [person(700, 600, score=0.6)], [person(600, 620, score=0.84, turn=np.pi)]])
    assert [d.roi_px[0] for d in trails[0].detections] == [500, 510, 520, 530, 540]
    # The weak one begins nothing either.
    assert len(trails) == 2


def test_one_who_was_missed_does_not_take_over_somebody_else_who_is_not_looked_for():
    """As when somebody jumps off a wall while another walks below: the window around where he was shows the other."""
    associator = Associator(AssociationParams())
    for i in range(5):
        for new in associator.step(i, 0.1 * i, [person(500, 300), person(600, 600)]):
            associator.begin(Trail.of(i, 0.1 * i, new))
    missed, other = associator.live
    assert associator.step(11, 1.2, [person(610, 610)], among=[missed])
    assert (missed.frames[-1], other.frames[-1]) == (4, 4)
    # Where nobody else is expected he is taken up again.
    assert associator.step(12, 1.25, [person(450, 450)], among=[missed]) == []
    assert missed.frames[-1] == 12


PICTURE = (1920, 1080)


def joined(frames: list[list[Detection]]) -> list[list[int]]:
    """The frames in which each person was seen, after joining."""
    return [t.frames for t in join_trails(follow(frames), PICTURE, JoinParams())]


def walker(i: int, hidden: range, x: float = 300.0, speed: float = 25.0, side: float = HEIGHT) -> list[Detection]:
    return [] if i in hidden else [person(x + speed * i, 500 + 3 * (i % 2), side)]


def test_a_walker_hidden_for_two_seconds_stays_one_person():
    # 250 px/s of a body of 400 px: 1.1 m/s. Behind a pillar from 1.5 to 3.4 s.
    hidden = range(15, 34)
    frames = [walker(i, hidden) for i in range(50)]
    assert len(follow(frames)) == 2
    assert joined(frames) == [[i for i in range(50) if i not in hidden]]
    # Longer out of sight than the limit: nobody knows.
    assert len(joined([walker(i, range(12, 40), speed=20) for i in range(60)])) == 2


def test_somebody_else_is_not_joined():
    def then(first: Callable[[int], list[Detection]], second: Callable[[int], list[Detection]]) -> int:
        return len(joined([first(i) if i < 15 else second(i) if i >= 34 else [] for i in range(50)]))

    nobody = range(0)
    assert then(lambda i: walker(i, nobody), lambda i: walker(i, nobody)) == 1
    # A child, somebody coming back the way the other went, somebody elsewhere, somebody who stands there.
    assert then(lambda i: walker(i, nobody), lambda i: walker(i, nobody, side=280)) == 2
    assert then(lambda i: walker(i, nobody), lambda i: walker(i, nobody, x=2000, speed=-25)) == 2
    assert then(lambda i: walker(i, nobody), lambda i: walker(i, nobody, x=800)) == 2
    assert then(lambda i: walker(i, nobody), lambda i: [person(1150, 500)]) == 2


def test_who_leaves_the_picture_is_not_who_comes_in():
    frames = [[person(1700 + 12 * i, 500)] if i < 15 else [person(1860, 500)] if i >= 30 else [] for i in range(45)]
    assert len(joined(frames)) == 2


def test_two_who_could_both_be_the_hidden_one_are_not_joined():
    frames = [
        walker(i, range(50)) if 15 <= i < 34 else [person(300 + 25 * i + d, 500) for d in ((0, 60) if i > 33 else (0,))]
        for i in range(50)
    ]
    assert len(joined(frames)) == 3


# --- a whole video ----------------------------------------------------------------------------------------------


Spot = tuple[Callable[[int], bool], int, Callable[[int], int], int]


def film(path: Path, numbers: range, *spots: Spot, fps: int = 25) -> Path:
    """640x360. A spot: whether it is in a frame, its row, its column in a frame, its brightness."""

    def frames() -> Iterator[np.ndarray]:
        for i in numbers:
            image = np.zeros((360, 640, 3), np.uint8)
            for shown, row, column, brightness in spots:
                if shown(i):
                    image[row : row + 20, column(i) : column(i) + 20] = brightness
            yield image

    return write_as_they_are(path, frames(), fps)


@pytest.fixture
def spots_video(tmp_path):
    """4 s. Person A (140 px) walks right, hidden for 0.6 s; B (100 px) stands, from 2 s on; C is one frame of glare."""
    a = lambda i: not 40 <= i < 55, 170, lambda i: 100 + 4 * i, 214
    b = lambda i: i >= 50, 90, lambda _: 300, 210
    c = lambda i: i == 20, 250, lambda _: 50, 206
    return film(tmp_path / "spots.avi", range(100), a, b, c)


def test_track_people_numbers_bridges_and_drops(spots_video):
    tracking = track_people(spots_video, detector=Spots())
    assert tracking.image_size_px == (640, 360)
    assert tracking.detector == "spots"
    assert [p.person_id for p in tracking.persons] == [1, 2]
    a, b = tracking.persons
    assert np.isfinite(a.roi_px[:100]).all()
    np.testing.assert_allclose(a.roi_px[:, 0], 109.5 + 4 * np.arange(100), atol=1.5)
    assert not a.observed[40:55].any()
    assert a.observed[:40].sum() >= 10
    seen = np.flatnonzero(np.isfinite(b.box_px[:, 0]))
    assert (seen[0], seen[-1]) == (50, 99)
    assert np.isnan(b.roi_px[:50]).all()
    assert (b.score[:50] == 0).all()
    assert not b.observed[:50].any()
    assert time_in_view_s(a, tracking.time_s) == pytest.approx(4.0)


@pytest.mark.slow
def test_a_long_time_out_of_sight_has_no_boxes(tmp_path):
    walker = lambda i: not 40 <= i < 80, 170, lambda i: 100 + 3 * i, 214  # hidden for 1.6 s
    tracking = track_people(film(tmp_path / "hidden.avi", range(120), walker), detector=Spots())
    (only,) = tracking.persons
    assert np.isnan(only.box_px[40:80]).all()
    assert np.isnan(only.roi_px[40:80]).all()
    assert not only.score[40:80].any()
    assert np.isfinite(only.box_px[:40]).all()
    assert np.isfinite(only.box_px[80:]).all()


@pytest.mark.parametrize("first", range(6))
def test_a_track_begins_and_ends_with_the_person_wherever_the_recording_begins(tmp_path, first):
    """The schedule of looks counts from the recording's first frame; another person stands there all the time."""
    stands = lambda _: True, 90, lambda _: 500, 210
    walks = lambda i: 31 <= i < 67, 170, lambda i: 100 + 4 * i, 214
    path = film(tmp_path / "spots.avi", range(first, 90), stands, walks, fps=30)
    walker = next(p for p in track_people(path, detector=Spots()).persons if np.isnan(p.box_px[0, 0]))
    inside = first + np.flatnonzero(np.isfinite(walker.box_px[:, 0]))
    assert (inside[0], inside[-1]) == (31, 66)


def test_track_people_finds_nobody_in_noise(tmp_path):
    video = write_video(tmp_path / "dark.mkv", [np.zeros((64, 64, 3), np.uint8)] * 30, constant_rate(30), "ffv1")
    tracking = track_people(video, detector=Spots())
    assert tracking.persons == ()
    assert choose_subject(tracking).status == "NO_PERSON"


def test_unknown_detector_is_refused(spots_video):
    refused("SOLVER_UNKNOWN", track_people, spots_video, TrackingParams(detector="none"))


@pytest.mark.slow
def test_contact_sheet_shows_everybody(spots_video, tmp_path):
    import cv2

    tracking = track_people(spots_video, detector=Spots())
    sheet = cv2.imread(str(save_contact_sheet(spots_video, tracking, tmp_path / "sheet.png", [1, 2])))
    assert sheet is not None
    # Four moments, two by two.
    assert sheet.shape == (720, 1280, 3)
    colours = [np.all(sheet == c, axis=2).sum() for c in ((80, 220, 80), (60, 120, 255))]
    assert min(colours) > 500
    # Only the candidates are shown where they are named, and a JPEG where the name says so.
    small = save_contact_sheet(spots_video, tracking, tmp_path / "one.jpg", [2])
    assert small.read_bytes()[:2] == b"\xff\xd8"
    assert not np.all(contact_sheet(spots_video, tracking, [2]) == (80, 220, 80), axis=2).any()
    with pytest.raises(ValueError, match="at least one person"):
        contact_sheet(spots_video, tracking, [7])


# --- the subject ------------------------------------------------------------------------------------------------

SIZE = (1000, 1000)
FPS = 30.0


Course = float | Callable[[np.ndarray], np.ndarray]


def track(
    person_id: int,
    x: Course,
    y: Course = 500.0,
    side: Course = HEIGHT,
    turn: Course = 0.0,
    start: int = 0,
    n: int = 180,
    jitter: float = 0.0,
) -> PersonTrack:
    """A person in frames start.. of a video of `n` frames; x, y, side may be functions of the seconds since then."""
    t = np.arange(n - start) / FPS
    rng = np.random.default_rng(person_id)
    values = [np.array(v(t) if callable(v) else np.full(t.shape, v), float) for v in (x, y, side, turn)]
    values[0] = values[0] + rng.normal(0, jitter * HEIGHT, len(t))
    values[2] = values[2] * np.exp(rng.normal(0, 2 * jitter, len(t)))
    roi = np.full((n, 4), np.nan)
    roi[start:] = np.stack(values, axis=1)
    seen = np.isfinite(roi[:, 0])
    box = np.full((n, 4), np.nan)
    box[seen] = np.clip(body_box(roi[seen]), 0, 1000)
    return PersonTrack(person_id, box, roi, seen.astype(float), seen)


def video_of(*persons: PersonTrack) -> Tracking:
    n = len(persons[0].score)
    return Tracking(np.arange(n) / FPS, SIZE, persons, "test", "")


def test_the_walker_is_chosen_not_the_one_who_stays():
    walker = track(2, x=lambda t: 100 + 130 * t, jitter=0.03)
    stander = track(1, x=500.0, jitter=0.03)
    choice = choose_subject(video_of(stander, walker))
    assert (choice.status, choice.person_id, choice.runner_up_id) == ("CHOSEN", 2, 1)
    assert "walks" in choice.reason
    assert "stays in place" in choice.reason


def test_walking_towards_the_camera_counts_as_walking():
    # 1.2 m/s from 9 m to 1.8 m away, a person of 1.7 m, focal length 720 px; and somebody sits down and gets up.
    walker = track(2, x=480.0, side=lambda t: 720 * 1.7 / (9 - 1.2 * t), jitter=0.03)
    sitter = track(1, x=600.0, side=lambda t: 330 + 60 * np.sin(2 * np.pi * t / 3), jitter=0.03)
    choice = choose_subject(video_of(sitter, walker))
    assert choice.person_id == 2


def test_jumping_off_a_wall_is_not_walking():
    jumper = track(1, x=lambda t: 300 + 100 * t, y=lambda t: 200 + 130 * t)
    walker = track(2, x=lambda t: 900 - 100 * t, y=600.0)
    choice = choose_subject(video_of(jumper, walker))
    assert choice.person_id == 2


def test_a_patient_who_walks_slowly_wins_over_a_larger_bystander():
    # 0.25 m/s for a person of 1.7 m: 0.15 body heights per second.
    patient = track(1, x=lambda t: 300 + 0.15 * HEIGHT * t, jitter=0.02)
    bystander = track(2, x=900.0, side=500.0, jitter=0.02)
    assert choose_subject(video_of(patient, bystander)).person_id == 1


def test_two_alike_need_a_choice_and_a_human_decides():
    side_by_side = video_of(track(1, x=lambda t: 100 + 100 * t), track(2, x=lambda t: 300 + 100 * t))
    choice = choose_subject(side_by_side)
    assert (choice.status, choice.person_id) == ("NEEDS_CHOICE", None)
    assert "person 1" in choice.reason
    assert "person 2" in choice.reason
    by_hand = choose_subject(side_by_side, override=1)
    assert (by_hand.status, by_hand.person_id, by_hand.runner_up_id) == ("MANUAL", 1, 2)


def test_an_override_wins_over_a_clear_choice_but_must_exist():
    clear = video_of(track(1, x=500.0), track(2, x=lambda t: 100 + 130 * t))
    assert choose_subject(clear, override=1).person_id == 1
    refused("SUBJECT_UNKNOWN_PERSON", choose_subject, clear, override=3)


def test_who_is_in_view_for_under_a_second_is_no_candidate_beside_others():
    stander, passer = track(1, x=500.0), track(2, x=lambda t: 300 + 300 * t, start=155)
    choice = choose_subject(video_of(stander, passer))
    assert (choice.person_id, choice.runner_up_id) == (1, None)
    # Alone he is chosen; that his time is too short is said where keypoints would be computed.
    assert choose_subject(video_of(track(1, x=500.0, start=160))).person_id == 1


def test_scores_do_not_depend_on_the_size_of_the_picture():
    def scaled(p: PersonTrack, k: float) -> PersonTrack:
        return PersonTrack(p.person_id, p.box_px * k, p.roi_px * [k, k, k, 1], p.score, p.observed)

    people = (track(1, x=500.0, jitter=0.02), track(2, x=lambda t: 100 + 130 * t, jitter=0.02))
    small = video_of(*people)
    large = Tracking(small.time_s, (3000, 3000), tuple(scaled(p, 3.0) for p in people), "test", "")
    assert choose_subject(small).scores == pytest.approx(choose_subject(large).scores)


def test_a_probe_of_another_video_is_refused(spots_video):
    info = probe(spots_video)
    known = track_people(spots_video, detector=Spots(), info=info)
    assert len(known.persons) == len(track_people(spots_video, detector=Spots()).persons)
    other = dataclasses.replace(info, n_frames=info.n_frames - 1)
    refused("VIDEO_CHANGED", track_people, spots_video, detector=Spots(), info=other)
