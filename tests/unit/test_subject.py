"""Who of several people is measured: what a clinic films, as made tracks."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.tracking import PersonTrack, carried_choice, choose_subject, same_person
from tests.unit.test_tracking import FPS, HEIGHT, track, video_of

N = 360  # 12 s


def only(person: PersonTrack, first: int, last: int) -> PersonTrack:
    """The person in view in frames first..last only."""
    keep = (np.arange(len(person.score)) >= first) & (np.arange(len(person.score)) <= last)
    box = np.where(keep[:, None], person.box_px, np.nan)
    roi = np.where(keep[:, None], person.roi_px, np.nan)
    return PersonTrack(person.person_id, box, roi, person.score * keep, person.observed & keep)


def depth(far_m: float, speed: float, height_m: float = 1.7):
    """Height in px over time of somebody who walks towards the camera (focal length 720 px)."""
    return lambda t: 720 * height_m / np.maximum(far_m - speed * t, 1.5)


@pytest.mark.slow
@pytest.mark.parametrize("nearer", [1.1, 1.3, 1.6, 1.9])
@pytest.mark.parametrize("small", [0.15, 0.3, 0.5])
@pytest.mark.parametrize("beside", [150.0, 300.0])
def test_a_therapist_who_walks_alongside_nearer_and_larger_is_never_taken(nearer, small, beside):
    """Either the patient is chosen or nobody: whatever the distance to the camera."""
    size = 1000 * small
    patient = track(1, x=lambda t: 480 + 4 * t, side=lambda t: size * np.exp(0.05 * t), n=N, jitter=0.02)
    therapist = track(2, x=lambda t: 480 + beside + 4 * t, side=lambda t: nearer * size * np.exp(0.05 * t), n=N)
    for people in ((patient, therapist), (therapist, patient)):
        assert choose_subject(video_of(*people)).person_id in (1, None)
    across = [
        track(1, x=lambda t: 200 + 60 * t, side=size, n=N, jitter=0.02),
        track(2, x=lambda t: 200 + 60 * t + beside / 4, side=size * nearer, n=N, jitter=0.02),
    ]
    assert choose_subject(video_of(*across)).person_id in (1, None)


def test_a_therapist_beside_the_patient_leaves_the_choice_to_a_person():
    patient = track(1, x=480.0, side=depth(9, 0.6), n=N)
    therapist = track(2, x=620.0, side=depth(8.4, 0.6, 1.85), n=N)
    choice = choose_subject(video_of(patient, therapist))
    assert (choice.status, choice.person_id) == ("NEEDS_CHOICE", None)
    assert "walks towards the camera" in choice.reason
    assert choice.runner_up_id is not None


def test_a_decision_is_carried_to_another_tracking():
    """By another detector's boxes: larger, with a gap, numbered anew."""
    patient, therapist = track(2, x=lambda t: 300 + 40 * t, n=N), track(1, x=lambda t: 380 + 40 * t, side=460.0, n=N)
    decided = video_of(therapist, patient)
    grown = patient.box_px + np.array([-10.0, -20.0, 10.0, 20.0])
    grown[40:90] = np.nan
    here = dataclasses.replace(patient, person_id=3, box_px=grown)
    beside = dataclasses.replace(therapist, person_id=7)
    assert same_person(decided, 2, video_of(beside, here)) == 3
    assert same_person(decided, 1, video_of(beside, here)) == 7
    choice = carried_choice(decided, 2, "old-v1", video_of(beside, here))
    assert (choice.status, choice.person_id) == ("CHOSEN", 3)
    assert choice.reason == "Person 3 was recognised: chosen by hand in the tracking old-v1."
    # Who walks close beside her is not she, and of her of whom a quarter is left nobody can say it.
    near = dataclasses.replace(therapist, box_px=patient.box_px + np.array([25.0, 0.0, 25.0, 0.0]))
    assert same_person(video_of(near, patient), 2, video_of(near)) is None
    grown[90:] = np.nan
    for people in ((beside, here), (beside,), (here,)):
        choice = carried_choice(decided, 2, "old-v1", video_of(*people))
        assert (choice.status, choice.person_id) == ("NEEDS_CHOICE", None)
        assert choice.reason.startswith("Person 2 of the tracking old-v1 was chosen by hand and cannot be recognised")
    empty = dataclasses.replace(decided, persons=())
    assert carried_choice(decided, 2, "old-v1", empty).status == "NO_PERSON"
    assert same_person(decided, 2, video_of(track(1, x=300.0, n=N // 2))) is None


def test_of_a_crowd_the_first_few_are_described():
    crowd = [track(k + 1, x=300.0 + 20 * k, side=400.0, n=60) for k in range(30)]
    choice = choose_subject(video_of(*crowd))
    assert choice.status == "NEEDS_CHOICE"
    assert choice.reason.count("stays in place") == 6
    assert "30 people are too alike" in choice.reason
    assert "; and 24 others. A person has to choose." in choice.reason
    assert len(choice.scores) == 30


def test_somebody_who_crosses_is_not_taken():
    patient = track(1, x=480.0, side=depth(11, 0.7), n=N, jitter=0.01)
    crossing = only(track(2, x=lambda t: 300 * (t - 5), side=600.0, n=N), round(5 * FPS), round(8.3 * FPS))
    for people in ((patient, crossing), (crossing, patient)):
        choice = choose_subject(video_of(*people))
        assert (choice.status, choice.person_id) == ("CHOSEN", 1)


def test_somebody_who_sits_and_waits_in_the_middle_is_not_taken():
    """The patient walks through the picture in 5 of 12 s; the other one sits there all the time, nearer."""
    patient = only(track(1, x=lambda t: -200 + 200 * (t - 2), n=N, jitter=0.02), 90, 240)
    seated = track(2, x=500.0, y=600.0, side=0.8 * HEIGHT, n=N, jitter=0.02)
    choice = choose_subject(video_of(patient, seated))
    assert (choice.status, choice.person_id) == ("CHOSEN", 1)
    assert "across the picture" in choice.reason
    assert "person 2, is in view for 12.0 s, stays in place" in choice.reason


def test_who_walks_away_and_comes_back_is_said():
    away = depth(-1, -0.8)

    def there_and_back(t):
        return np.where(t < 6, away(np.minimum(t, 6) + 3), away(np.maximum(12 - t, 0) + 3))

    choice = choose_subject(video_of(track(1, x=500.0, side=there_and_back, n=N)))
    assert "to and from the camera" in choice.reason
    only_away = only(track(1, 500.0, side=there_and_back, n=N), 0, 170)
    assert "away from the camera" in choose_subject(video_of(only_away)).reason


def test_appearances_are_counted():
    walker = track(1, x=lambda t: 100 + 60 * t, n=N)
    gap = np.arange(N)
    gone = (gap > 100) & (gap < 200)
    box, roi = walker.box_px.copy(), walker.roi_px.copy()
    box[gone], roi[gone] = np.nan, np.nan
    twice = PersonTrack(1, box, roi, walker.score, walker.observed & ~gone)
    assert "(2 times)" in choose_subject(video_of(twice)).reason


def test_a_third_person_close_behind_the_second_is_named():
    alike = [track(k, x=lambda t, k=k: 100 * k + 50 * t, n=N) for k in (1, 2, 3)]
    choice = choose_subject(video_of(*alike))
    assert choice.status == "NEEDS_CHOICE"
    assert all(f"person {k}" in choice.reason for k in (1, 2, 3))


def test_one_frame_and_no_movement():
    single = track(1, x=500.0, n=1)
    choice = choose_subject(video_of(single))
    assert (choice.status, choice.person_id) == ("CHOSEN", 1)
    assert np.isfinite(choice.score)
