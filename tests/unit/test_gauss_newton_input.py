"""What cannot be fitted is refused with a code before anything is computed, never fitted to nonsense."""

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, SessionInput, fit_sessions, problem
from pbl_pipeline.keypoints import Keypoints
from research.walker.observe import observe
from research.walker.views import observe_markers
from research.walker.walk import walk_qpos

pytestmark = pytest.mark.slow

TIME_S = np.arange(60) / 30


@pytest.fixture(scope="module")
def trial() -> Keypoints:
    return observe(walk_qpos(TIME_S, 1), TIME_S, seed=1, camera_motion="handheld").keypoints


def put(a: np.ndarray, at: tuple[int, ...], value: float) -> np.ndarray:
    out = np.array(a, float)
    out[at] = value
    return out


def seen(k: Keypoints) -> tuple[int, ...]:
    """A place where something was seen."""
    return tuple(np.argwhere(k.confidence > 0)[50])


def first(k: Keypoints, n: int) -> Keypoints:
    names = ("time_s", "xy_px", "xyz_cam_m", "confidence", "box_px")
    return dataclasses.replace(k, **{name: getattr(k, name)[:n] for name in names})


BAD: dict[str, tuple[str, Callable[[Any], dict]]] = {
    "NaN pixel": ("FIT_INPUT: NaN", lambda k: {"xy_px": put(k.xy_px, seen(k), np.nan)}),
    "infinite 3D point": ("FIT_INPUT: NaN", lambda k: {"xyz_cam_m": put(k.xyz_cam_m, seen(k), np.inf)}),
    "NaN confidence": ("FILE_FORMAT", lambda k: {"confidence": put(k.confidence, (3, 4), np.nan)}),
    "negative confidence": ("FILE_FORMAT", lambda k: {"confidence": put(k.confidence, (3, 4), -1)}),
    "nothing seen": ("FIT_INPUT: in view", lambda k: {"confidence": np.zeros_like(k.confidence)}),
    "repeated stamp": ("FIT_INPUT: time stamps", lambda k: {"time_s": put(k.time_s, (5,), k.time_s[4])}),
    "backward stamps": ("FIT_INPUT: time stamps", lambda k: {"time_s": k.time_s[::-1]}),
    "NaN stamp": ("FIT_INPUT", lambda k: {"time_s": put(k.time_s, (5,), np.nan)}),
    "unknown marker set": ("MARKER_SET_UNKNOWN: unheard_of", lambda k: {"marker_set": "unheard_of"}),
    "names in another order": ("MARKER_SET_UNKNOWN", lambda k: {"names": k.names[::-1]}),
    "other names": ("MARKER_SET_UNKNOWN: m0", lambda k: {"names": tuple(f"m{i}" for i in range(len(k.names)))}),
    "one zero quaternion": ("PHONE_LOG", lambda k: {"phone_quat_wxyz": put(k.phone_quat_wxyz, (5,), 0)}),
    "zero quaternions": ("PHONE_LOG", lambda k: {"phone_quat_wxyz": np.zeros_like(k.phone_quat_wxyz)}),
    "backward phone": ("PHONE_LOG", lambda k: {"phone_time_s": k.phone_time_s[::-1]}),
    "phone of another time": ("PHONE_LOG", lambda k: {"phone_time_s": k.phone_time_s + 30}),
    "phone without turns": ("PHONE_LOG", lambda k: {"phone_quat_wxyz": None}),
}


def refusal(make: Callable[[], SessionInput]) -> PblError:
    """The error with which a session is refused: at its construction or as the result of the fit."""
    try:
        result = fit_sessions([make()], METHODS["gauss-newton"])[0]
    except PblError as error:
        return error
    assert isinstance(result, PblError)
    return result


def code_of(make: Callable[[], SessionInput]) -> str:
    return refusal(make).code


@pytest.mark.parametrize("name", BAD)
def test_bad_keypoints_have_a_code(trial, name):
    (code, _, found), change = BAD[name][0].partition(": "), BAD[name][1]
    error = refusal(lambda: SessionInput([dataclasses.replace(trial, **change(trial))], ["a"], "handheld"))
    assert error.code == code
    assert found in error.found


@pytest.mark.parametrize("n", [0, 1, 20])
def test_too_few_frames(trial, n):
    assert code_of(lambda: SessionInput([first(trial, n)], ["a"], "handheld")) == "FIT_INPUT"


@pytest.mark.parametrize("matrix", [np.zeros((3, 3)), np.full((3, 3), np.nan), -np.eye(3)])
def test_a_camera_that_cannot_be(trial, matrix):
    def with_matrix() -> SessionInput:
        camera = dataclasses.replace(trial.camera, matrix=matrix)
        return SessionInput([dataclasses.replace(trial, camera=camera)], ["a"], "handheld")

    assert code_of(with_matrix) == "CAMERA_INVALID"


def test_sessions_that_do_not_fit_together(trial):
    markers = observe_markers(walk_qpos(TIME_S, 1), TIME_S)
    assert code_of(lambda: SessionInput([trial, markers], ["a", "b"])) == "FIT_INPUT"
    assert code_of(lambda: SessionInput([trial], ["a", "b"])) == "FIT_INPUT"
    assert code_of(lambda: SessionInput([], [])) == "FIT_INPUT"
    assert code_of(lambda: SessionInput([trial], ["a"], ["static", "static"])) == "FIT_INPUT"
    assert code_of(lambda: SessionInput([trial], ["a"], "shaky")) == "FIT_INPUT"


def test_each_bad_session_has_its_own_error(trial):
    bad = [
        dataclasses.replace(trial, **change(trial))
        for n, (c, change) in BAD.items()
        if n in ("NaN pixel", "nothing seen")
    ]
    found = fit_sessions([SessionInput([k], [n], "handheld") for k, n in zip(bad, "ab", strict=True)], batch=3)
    assert [e.key for e in found if isinstance(e, PblError)] == ["a", "b"]


@pytest.mark.parametrize(
    ("frames", "trials", "samples", "sizes"),
    [(100, 1, 300, (256, 1, 2048)), (100, 2, 300, (256, 4, 2048)), (700, 5, 3000, (768, 8, 4096))],
)
def test_a_gpu_is_given_few_sizes(frames, trials, samples, sizes):
    pads = problem.pad_frames, problem.pad_trials, problem.pad_samples
    assert tuple(pad(n, coarse=True) for pad, n in zip(pads, (frames, trials, samples), strict=True)) == sizes
