"""The pelvis of a person who sits or squats, as the marker augmenter has it."""

import dataclasses
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import PELVIS_TURNS, body_poses, load_body, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, augmented_pelvis, per_frame
from pbl_pipeline.fit.augmented_pelvis import folds, inclination_of, pelvis_of, with_augmented_pelvis
from pbl_pipeline.fit.checks import _pelvis_told
from pbl_pipeline.fit.joint_terms import inclination
from pbl_pipeline.fit.lanes import Task
from pbl_pipeline.fit.session import make_session
from pbl_pipeline.keypoints import AnatomicalMarkers, MarkerAugmenter
from pbl_pipeline.synthetic import SynthSpec, synthesise

BODY, SPINES = load_body(), marker_set("opencap_35")


def test_inclination_is_that_of_the_prior():
    rng = np.random.default_rng(0)
    qpos = np.zeros((20, 40))
    at = [BODY.joint_names.index(n) for n in PELVIS_TURNS]
    qpos[:, at] = rng.uniform(-0.7, 0.7, (20, 3))
    rotation = np.asarray(body_poses(BODY, qpos, np.ones(8))[1])[:, BODY.body_names.index("pelvis")]
    np.testing.assert_allclose(inclination_of(rotation), inclination(jnp.asarray(qpos[:, at])), atol=1e-5)


def test_a_pelvis_is_found_from_its_spines_and_unknown_without_one():
    rotation = Rotation.random(5, rng=np.random.default_rng(1)).as_matrix()
    markers = np.einsum("tij,nj->tni", rotation, SPINES.position_m) + 3.0
    markers[4, SPINES.names.index("l_PSIS")] = np.nan
    found = pelvis_of(markers)
    np.testing.assert_allclose(found[:4], rotation[:4], atol=1e-9)
    assert np.isnan(found[4]).all()


def test_a_crouch_is_no_squat_however_far_the_knees_bend():
    """Both legs as in mid-stance of a deep crouch: knees at 80 deg under thighs at 40."""
    qpos = np.zeros((100, 40))
    at = BODY.joint_names.index
    qpos[:, [at("knee_angle_r"), at("knee_angle_l")]] = -np.deg2rad(80.0)
    qpos[:, [at("hip_flexion_r"), at("hip_flexion_l")]] = np.deg2rad(55.0)
    qpos[:, at("pelvis_tilt")] = -np.deg2rad(15.0)
    assert not folds(BODY, qpos)
    qpos[:5, at("pelvis_tilt")] = 0.0
    assert not folds(BODY, qpos)
    qpos[5, at("pelvis_tilt")] = 0.0
    assert folds(BODY, qpos)
    qpos[:, at("hip_flexion_r")] = 0.0  # one knee lifted
    assert not folds(BODY, qpos)


def test_inclination_of_the_thighs_is_that_of_the_body():
    rng = np.random.default_rng(2)
    turns = [*PELVIS_TURNS, *(f"hip_{n}_{s}" for n in ("flexion", "adduction", "rotation") for s in "rl")]
    qpos = np.zeros((200, 40))
    qpos[:, [BODY.joint_names.index(n) for n in turns]] = rng.uniform(-0.9, 0.9, (200, len(turns)))
    thighs = [BODY.body_names.index(n) for n in ("femur_r", "femur_l")]
    up = np.asarray(body_poses(BODY, qpos, np.ones(8))[1])[:, thighs, 2, 1]
    both = np.degrees(np.arccos(up)).min(axis=1) > 50.0
    assert 20 < both.sum() < 180
    assert [folds(BODY, frame[None]) for frame in qpos] == both.tolist()


class Tipped:
    """In the augmenter's place: a pelvis tipped forwards by 0.4 rad in every frame."""

    points = MarkerAugmenter.points

    def __init__(self, problem: PblError | None = None):
        self.problem = problem

    def __call__(self, time_s, points_world_m):
        if self.problem is not None:
            raise self.problem
        assert points_world_m.shape == (len(time_s), 15, 3)
        # Forward axis down by 0.4, y up, z to the right.
        turn = np.array([[np.cos(0.4), np.sin(0.4), 0], [0, 0, -1], [-np.sin(0.4), np.cos(0.4), 0]])
        markers = np.tile(SPINES.position_m @ turn.T, (len(time_s), 1, 1))
        markers[~np.isfinite(points_world_m).all(axis=(1, 2))] = np.nan
        return AnatomicalMarkers(SPINES.names, markers, 1.8, 75.0, (), "")


def session_of(task):
    made = synthesise(SynthSpec(task, 0, marker_set="blazepose_33", seconds=4.0))
    session = make_session([made.keypoints], [task], METHODS.find("blazepose").params)
    qpos = np.zeros((len(session.problem.weight), 40), np.float32)
    qpos[: len(made.truth.qpos)] = made.truth.qpos
    return session, qpos


def test_a_squat_is_asked_about_and_a_walk_is_not(monkeypatch):
    monkeypatch.setattr(augmented_pelvis, "_augmenter", Tipped)
    session, qpos = session_of("squat")
    p = with_augmented_pelvis(session, session.problem, qpos, np.ones(8))
    known = np.asarray(p.c_pelvis) > 0
    np.testing.assert_array_equal(known, np.asarray(p.weight) > 0)
    np.testing.assert_allclose(np.asarray(p.pelvis)[known], [[-0.4, 0.0]] * known.sum(), atol=2e-3)
    walk, qpos = session_of("walk")
    assert with_augmented_pelvis(walk, walk.problem, qpos, np.ones(8)) is walk.problem


def test_a_person_that_the_network_does_not_know_is_fitted_without(monkeypatch):
    session, qpos = session_of("squat")
    unknown = PblError("AUGMENTER_INPUT", found="a child", expected="an adult", next_step="none")
    monkeypatch.setattr(augmented_pelvis, "_augmenter", lambda: Tipped(unknown))
    assert not np.any(with_augmented_pelvis(session, session.problem, qpos, np.ones(8)).c_pelvis)
    gone = PblError("ASSET_MISSING", found="no network", expected="a file", next_step="fetch it")
    monkeypatch.setattr(augmented_pelvis, "_augmenter", lambda: Tipped(gone))
    with pytest.raises(PblError, match="ASSET_MISSING"):
        with_augmented_pelvis(session, session.problem, qpos, np.ones(8))


def test_without_the_network_those_who_do_not_sit_are_fitted_all_the_same(monkeypatch: pytest.MonkeyPatch):
    """The solutions are those of stand-ins."""
    given = [session_of(task) for task in ("squat", "walk")]
    sessions = [session for session, _ in given]
    starts = [dataclasses.replace(per_frame.start_of(session), qpos=qpos) for session, qpos in given]

    def fit(body, ready, *_) -> Iterator[tuple[Task, Any]]:
        while tasks := ready(2):
            for task in tasks:
                yield task, SimpleNamespace(end=SimpleNamespace(state=task.start), trace=np.zeros((0, 2)))

    monkeypatch.setattr(per_frame, "fit_many", fit)
    monkeypatch.setattr(per_frame, "_on_floor", lambda session, f: (session.problem, f.end.state))
    monkeypatch.setattr(per_frame, "_solution", lambda *_: "a solution")
    gone = PblError("ASSET_MISSING", found="no network", expected="a file", next_step="fetch it")
    monkeypatch.setattr(augmented_pelvis, "_augmenter", lambda: Tipped(gone))
    method = METHODS["blazepose"]
    assert list(method.function(sessions, method.params, starts)) == [gone, "a solution"]


def test_who_sits_and_could_not_be_asked_about_is_told():
    session, qpos = session_of("squat")
    trial, frames = SimpleNamespace(qpos=qpos[session.frames(0)]), len(qpos)
    (silent,) = _pelvis_told(session, [trial], np.zeros(frames))  # type: ignore[list-item]
    assert (silent.outcome, silent.value) == ("WARN", 1.0)
    (told,) = _pelvis_told(session, [trial], np.ones(frames))  # type: ignore[list-item]
    assert told.outcome == "PASS"
    walk, qpos = session_of("walk")
    trial = SimpleNamespace(qpos=qpos[walk.frames(0)])
    assert _pelvis_told(walk, [trial], np.zeros(len(qpos))) == []  # type: ignore[list-item]
