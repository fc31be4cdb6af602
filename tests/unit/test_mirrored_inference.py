"""Two looks as one answer: at one frame, and shared by frames that follow each other. Walkers of known movement."""

import dataclasses

import numpy as np

from pbl_pipeline.keypoints import METHODS, PersonKeypoints
from pbl_pipeline.keypoints.blazepose import MIRROR, NAMES
from pbl_pipeline.keypoints.flips import leg_points
from pbl_pipeline.keypoints.mirrored_inference import UNDECIDED, MirroredInference

LOOKS = MirroredInference(NAMES, 100.0, 20.0)
REGION = np.array([500.0, 400.0, 300.0, 0.0])
LEGS = leg_points(NAMES)
OWN = np.arange(33)


def person(xy_px: np.ndarray, xyz_m: np.ndarray, confidence: float = 0.9, presence: float = 1.0) -> PersonKeypoints:
    return PersonKeypoints(xy_px, xyz_m, np.full(33, confidence), presence, REGION)


def walker(n: int = 61, rate_hz: float = 30.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (T,), pixels (T, 33, 2) and metres (T, 33, 3): every point swings by 30 px and 0.1 m at 1 Hz about a
    place of its own; the sides lie 60 px apart."""
    rng = np.random.default_rng(3)
    time_s = np.arange(n) / rate_hz
    place = rng.uniform([400, 300], [600, 500], (33, 2))
    place += np.where(MIRROR == OWN, 0, np.sign(MIRROR - OWN))[:, None] * [30.0, 0]
    swing = np.sin(2 * np.pi * time_s[:, None] + rng.uniform(0, 2 * np.pi, 33))
    xy = place + 30 * swing[..., None] * [1.0, 0.3]
    xyz = np.concatenate([(place - [500, 400]) / 250, np.zeros((33, 1))], axis=1) + 0.1 * swing[..., None]
    return time_s, xy, xyz


def looks(xy: np.ndarray, xyz: np.ndarray, half_px: np.ndarray, half_m: np.ndarray):
    """Frames seen in turn as they are and mirrored, by a network that is off by `half` one way or the other."""
    mirrored = np.arange(len(xy)) % 2 == 1
    sign = np.where(mirrored, -1.0, 1.0)[:, None, None]
    return [person(p, m) for p, m in zip(xy + sign * half_px, xyz + sign * half_m, strict=True)], mirrored


def shared(found, mirrored, time_s) -> list[PersonKeypoints]:
    """Of frames that all have somebody."""
    people = [p for p in LOOKS.shared(found, mirrored, time_s, 0.5) if p is not None]
    assert len(people) == len(time_s)
    return people


def test_shared_looks_are_as_good_as_two_a_frame():
    time_s, xy, xyz = walker()
    rng = np.random.default_rng(1)
    half_px, half_m = rng.normal(0, 6, (33, 2)), rng.normal(0, 0.02, (33, 3))
    found, mirrored = looks(xy, xyz, half_px, half_m)
    people = shared(found, mirrored, time_s)
    error = np.array([p.xy_px for p in people]) - xy
    # One look alone is off by 6 px; what is left comes from the movement between the looks.
    assert np.sqrt(np.mean((np.array([p.xy_px for p in found]) - xy) ** 2)) > 5
    assert np.sqrt(np.mean(error**2)) < 0.3
    assert np.sqrt(np.mean((np.array([p.xyz_cam_m for p in people]) - xyz) ** 2)) < 0.001
    twice = LOOKS.averaged(person(xy[30] + half_px, xyz[30] + half_m), person(xy[30] - half_px, xyz[30] - half_m))
    np.testing.assert_allclose(twice.xy_px, xy[30], atol=1e-9)
    np.testing.assert_allclose(people[30].confidence, twice.confidence, atol=0.01)


def test_the_movement_itself_is_not_smoothed():
    time_s, xy, xyz = walker()
    found, mirrored = looks(xy, xyz, np.zeros((33, 2)), np.zeros((33, 3)))
    people = shared(found, mirrored, time_s)
    swing = np.ptp([p.xy_px[:, 0] for p in people], axis=0) / np.ptp(xy[..., 0], axis=0)
    np.testing.assert_allclose(swing, 1.0, atol=0.01)


def test_points_on_which_the_looks_contradict_each_other_count_little():
    time_s, xy, xyz = walker()
    half_m = np.zeros((33, 3))
    half_m[25, 2] = 0.3
    found, mirrored = looks(xy, xyz, np.zeros((33, 2)), half_m)
    confidence = np.array([p.confidence for p in shared(found, mirrored, time_s)])
    assert np.all(confidence[:, 25] < 0.001)
    assert np.all(np.delete(confidence, 25, axis=1) > 0.88)


def test_a_mirrored_look_with_exchanged_legs_is_renamed():
    time_s, xy, xyz = walker()
    found, mirrored = looks(xy, xyz, np.zeros((33, 2)), np.zeros((33, 3)))
    for i in range(21, 32, 2):
        p, order = found[i], np.where(LEGS, MIRROR, OWN)
        found[i] = dataclasses.replace(p, xy_px=p.xy_px[order], xyz_cam_m=p.xyz_cam_m[order])
    people = shared(found, mirrored, time_s)
    assert np.abs(np.array([p.xy_px for p in people]) - xy).max() < 1.0
    confidence = np.array([p.confidence for p in people])
    np.testing.assert_allclose(confidence[21:32, LEGS], UNDECIDED * 0.9 / (1 + np.exp(-5)), rtol=0.02)
    np.testing.assert_allclose(confidence[:20], 0.9 / (1 + np.exp(-5)), rtol=0.02)


def test_gaps_and_frames_without_a_person_take_no_part():
    time_s, xy, xyz = walker()
    half_px, half_m = np.full((33, 2), 6.0), np.zeros((33, 3))
    seen, mirrored = looks(xy, xyz, half_px, half_m)
    found: list[PersonKeypoints | None] = list(seen)
    found[10] = person(xy[10] + 500, xyz[10], presence=0.1)
    found[30:45] = [None] * 15
    found[47:] = [None] * (len(found) - 47)
    out = LOOKS.shared(found, mirrored, time_s, 0.5)
    assert out[10] is found[10]
    assert out[30:45] == [None] * 15
    # Two frames alone have but one look of a kind: they stay as they were seen.
    assert out[45] is found[45]
    assert out[46] is found[46]
    kept = [i for i in range(30) if i != 10]
    points = [p.xy_px for i in kept if (p := out[i]) is not None]
    assert np.abs(np.array(points) - xy[kept]).max() < 2.0


def test_answers_of_exchanged_sides_are_not_averaged():
    rng = np.random.default_rng(0)
    points = rng.uniform(50, 200, (33, 2))
    np.testing.assert_array_equal(LOOKS.same_sides(points, points + rng.normal(0, 3, points.shape), 205.0), OWN)
    for group in (LEGS, ~LEGS, np.ones(33, bool)):
        other = points.copy()
        other[group] = points[MIRROR][group]
        found = LOOKS.same_sides(points, other + rng.normal(0, 3, points.shape), 205.0)
        np.testing.assert_array_equal(found, np.where(group, MIRROR, OWN))
    # Legs one before the other, seen from the side: nothing to tell, nothing is renamed.
    points[LEGS] = points[MIRROR][LEGS] + 2
    np.testing.assert_array_equal(LOOKS.same_sides(points, points + rng.normal(0, 3, points.shape), 205.0), OWN)


def test_looks_are_shared_from_24_frames_a_second():
    assert 1 / 23.976 <= METHODS["blazepose-heavy"].params.share_looks_s < 1 / 23
