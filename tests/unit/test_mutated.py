"""A few files of each kind of `research.benchmarks.mutated`, and those whose fault chance seldom finds."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_workers.web import accounts
from research.benchmarks import mutated_files as files
from research.benchmarks.mutated import kinds, outcomes
from tests import Limits, refused
from tests.guard import guarded

KINDS = {kind.name: kind for kind in kinds()}


@pytest.mark.parametrize("name", [pytest.param(k, marks=[pytest.mark.slow] * (k == "board.mp4")) for k in KINDS])
def test_mutated_files_have_a_result_or_a_code(tmp_path: Path, name: str, limits: Limits):
    limits(accounts, LOG_N=4)  # a hash that costs little
    n = 2 if name in ("walk.fit.npz", "session.json", "norm.json", "board.mp4") else 5
    found = list(outcomes(KINDS[name], range(n), tmp_path))
    assert not [o for o in found if o.what.startswith("!")]


def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    with np.load(path) as f:
        arrays = {k: f[k] for k in f.files}
    change(arrays)
    np.savez(path, **arrays)
    return path


def last_stamp(value: float) -> Callable[[dict[str, Any]], object]:
    def change(arrays: dict[str, Any]) -> None:
        arrays["time_s"][-1] = value

    return change


def put(**values: Any) -> Callable[[dict[str, Any]], object]:
    return lambda arrays: arrays.update(values)


def scaled(name: str, by: float) -> Callable[[dict[str, Any]], object]:
    return lambda arrays: arrays.update({name: arrays[name] * by})


@pytest.mark.parametrize(
    ("kind", "change", "code"),
    [
        ("walk.keypoints.npz", scaled("xyz_cam_m", 0.0), "GAIT_INPUT"),  # all joints at one place: a leg of length 0
        ("walk.keypoints.npz", scaled("time_s", 0.0), "FIT_INPUT"),
        ("walk.keypoints.npz", put(image_size_px=np.array([np.nan, 1.0])), "FILE_FORMAT"),
        ("walk.keypoints.npz", put(names=np.asarray(["a\x1b[2J"] * 33)), "FILE_FORMAT"),
        ("walk.keypoints.npz", put(marker_set=np.asarray(["blazepose_33"])), "FILE_FORMAT"),
        ("lab.markers.npz", scaled("xyz_world_m", 0.0), "GAIT_INPUT"),
        ("walk.keypoints.npz", last_stamp(1e9), "FILE_FORMAT"),  # its even grid would have 10^11 moments
        ("lab.markers.npz", last_stamp(1e5), "FILE_FORMAT"),
        ("walk.fit.npz", put(scale=np.ones(3)), "FILE_FORMAT"),
        ("walk.fit.npz", put(scale=np.zeros(8)), "GAIT_INPUT"),
        ("walk.fit.npz", last_stamp(1e9), "GAIT_INPUT"),
        ("walk.fit.npz", put(name=np.asarray("a\nb")), "FILE_FORMAT"),
        ("walk.fit.npz", put(joint_names=np.asarray("a")), "FILE_FORMAT"),
        ("walk.fit.npz", put(camera_matrix=np.array([[9.0, 1, 1], [0, 9, 1], [0, 0, 1]])), "CAMERA_INVALID"),
        ("walk.truth.npz", put(joint_names=np.asarray(["a"] * 30)), "FILE_FORMAT"),
        ("walk.truth.npz", put(qpos=np.zeros((90, 39))), "FILE_FORMAT"),
        ("walk.truth.npz", put(pelvis_m=np.zeros((90, 2))), "FILE_FORMAT"),
        ("walk.truth.npz", put(outlier=np.asarray(1)), "FILE_FORMAT"),
        ("walk.truth.npz", put(spec=np.asarray('{"a":' * 5000)), "FILE_FORMAT"),
        ("walk.kinetics.npz", put(cycle_no=np.array([np.inf])), "FILE_FORMAT"),
        ("tracking.npz", put(person_id=np.array([0.0, np.inf])), "FILE_FORMAT"),
        ("tracking.npz", put(box_px=np.zeros(4)), "FILE_FORMAT"),
        ("walk.reference.npz", put(source=np.asarray("\x1b[2J")), "FILE_FORMAT"),
        ("walk.reference.npz", put(names=np.asarray([["a", "b"], ["c", "d"]])), "FILE_FORMAT"),
    ],
)
def test_faults_in_arrays(tmp_path: Path, kind: str, change: Callable[[dict[str, Any]], object], code: str):
    KINDS[kind].write(tmp_path / kind)
    path = changed(tmp_path / kind, change)
    with guarded() as peak:
        refused(code, KINDS[kind].use, path)
    assert peak.grown_mib < 256


@pytest.mark.parametrize(
    ("kind", "field"),
    [
        ("walk.keypoints.npz", "names"),
        ("lab.markers.npz", "confidence"),
        ("walk.fit.npz", "qpos"),
        ("walk.truth.npz", "spec"),
        ("walk.kinetics.npz", "curve"),
        ("tracking.npz", "observed"),
        ("walk.reference.npz", "source"),
    ],
)
def test_a_missing_array_is_named(tmp_path: Path, kind: str, field: str):
    KINDS[kind].write(tmp_path / kind)
    path = changed(tmp_path / kind, lambda arrays: arrays.pop(field))
    assert field in refused("FILE_FORMAT", KINDS[kind].use, path).found


@pytest.mark.parametrize(
    ("kind", "content", "code"),
    [
        ("metrics.json", '{"session": 3}', "FILE_FORMAT"),
        ("metrics.json", '{"session": {"gdi": {"mean": "x"}}}', "FILE_FORMAT"),
        ("store.sha256", "\udcff  a.npz", "BACKUP_INVALID"),
        ("store.sha256", f"{0:064}  {'a' * 256}", "BACKUP_INVALID"),
        ("server.json", "\udcff", "FILE_FORMAT"),
        ("server.json", '{"pid": {}}', "FILE_FORMAT"),
        ("forgotten.json", '["files"]', "FILE_FORMAT"),
        ("accounts.json", '{"accounts": {"a": {"roles": [], "password": "x", "changed": ""}}}', "WEB_ACCOUNT"),
    ],
)
def test_files_of_an_installation_that_make_no_sense(tmp_path: Path, kind: str, content: str, code: str):
    (tmp_path / kind).write_bytes(content.encode("utf-8", "surrogateescape"))
    refused(code, KINDS[kind].use, tmp_path / kind)


@pytest.mark.slow
def test_of_an_hour_the_legs_on_an_even_grid_stay_small(tmp_path: Path):
    files.fit(tmp_path / "a.fit.npz")
    path = changed(tmp_path / "a.fit.npz", last_stamp(3590.0))
    with guarded() as peak:
        files.use_fit(path)
    assert peak.grown_mib < 512


@pytest.mark.parametrize(
    ("time_s", "start_utc"),
    [([0, 0.02, 1e9], ""), ([1e12, 1e12 + 1, 1e12 + 2], ""), ([0, 1, 2], "9999-12-31T23:59:59Z"), ([-1e300, 0, 1], "")],
)
def test_logs_of_times_that_cannot_be(tmp_path: Path, time_s: list[float], start_utc: str):
    path = tmp_path / "log.csv"
    rows = [f"{t!r},0.5,-0.5,0.5,-0.5,{start_utc}" for t in time_s]
    path.write_text("\n".join(["time_s,qw,qx,qy,qz,start_utc", *rows]))
    refused("PHONE_LOG", files.use_log, path)


CHECK = {"check": "a", "outcome": "WARN", "value": 1.0, "threshold": None, "advice": ""}
WITH_CHECKS = {"trials": ["walk"], "params_hash": ""}


@pytest.mark.parametrize(
    "value",
    [
        *(None, 3, "text", [1], {"trials": 3}, {"trials": None, "params_hash": 1, "qc": []}),
        *(
            WITH_CHECKS | {"qc": [CHECK | change]}
            for change in ({"value": np.inf}, {"threshold": np.nan}, {"value": "x"})
        ),
    ],
)
def test_a_session_file_that_makes_no_sense(tmp_path: Path, value: object):
    path = tmp_path / "session.json"
    path.write_text(json.dumps(value))
    refused("FILE_FORMAT", files.use_session, path)
