"""The commands that read the inputs of the fit: what they hand to it. Detection and the fit are stand-ins."""

from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline import pipeline
from pbl_pipeline.body import load_marker_set
from pbl_pipeline.cli.options import fit_paramset
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import GaussNewtonParams, ImplicitAdamParams, Params, default_fit, points_of
from pbl_pipeline.keypoints import METHODS, Keypoints, ModelKeypointParams, ModelParams, MultiView, WorldMarkers
from pbl_pipeline.methods import Stage
from pbl_pipeline.video import load_attitude
from tests.command import Done, pbl
from tests.inputs import (
    CALIBRATION,
    LEVEL,
    PHONE_T,
    ROWS,
    UPRIGHT,
    about,
    changed,
    code_of,
    csv_log,
    keypoints,
    markers,
    trc_text,
)
from tests.integration import chain


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    (tmp_path / "Calib.toml").write_text(CALIBRATION)
    return tmp_path / "Calib.toml"


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> list[dict]:
    """What `fit_session` was called with; the fit is a stand-in."""
    calls: list[dict] = []

    def fit(trials, names, paramset=None, camera_motion="static", **more):
        calls.append({"trials": trials, "names": names, "paramset": paramset, "motion": camera_motion, **more})
        return chain.fit_session(trials, names, paramset)

    monkeypatch.setattr("pbl_pipeline.fit.fit_session", fit)
    monkeypatch.setattr("pbl_pipeline.pipeline.fit_session", fit)
    return calls


def succeeds(done: Done) -> None:
    assert done.code == 0, done.err


TABLE = "name,body,x,y,z\nHead,head,0,0.1,0\nHip,pelvis,0,0,0.1\nToe,toes_r,0,0,0\n"


def test_pbl_fit_reads_markers(fits, tmp_path):
    (tmp_path / "walk.trc").write_text(trc_text(ROWS))
    (tmp_path / "lab.csv").write_text(TABLE)
    WorldMarkers.from_trc(tmp_path / "walk.trc", "lab").save(tmp_path / "two.npz")
    files = (tmp_path / "walk.trc", tmp_path / "two.npz")
    done = pbl("fit", *files, "--out", tmp_path / "out", "--marker-set", tmp_path / "lab.csv")
    succeeds(done)
    assert "2 of 3 markers of lab" in done.out
    assert "not in the file: Toe" in done.out
    (call,) = fits
    assert (call["names"], call["motion"]) == (["walk", "two"], "static")
    assert call["markers"].names == ("Head", "Hip", "Toe")
    for trial in call["trials"]:
        assert trial.names == ("Head", "Hip", "Toe")
        assert trial.confidence.tolist() == [[1, 1, 0], [0, 1, 0], [0, 1, 0]]
        np.testing.assert_allclose(trial.xyz_world_m[0, 1], [0.1, -0.2, 0.9], atol=1e-6)
    assert (tmp_path / "out" / "walk.fit.npz").exists()
    succeeds(pbl("fit", files[0], "--out", tmp_path / "z", "--marker-set", tmp_path / "lab.csv", "--up", "z"))
    np.testing.assert_allclose(fits[1]["trials"][0].xyz_world_m[0, 1], [0.1, 0.9, 0.2], atol=1e-6)


def test_pbl_fit_refuses_markers_it_cannot_place(fits, tmp_path):
    (tmp_path / "walk.trc").write_text(trc_text(ROWS))
    out = ("--out", tmp_path / "out")
    assert pbl("fit", tmp_path / "walk.trc", *out).error_code == "USAGE"
    assert pbl("fit", tmp_path / "walk.trc", *out, "--marker-set", "nobody's").error_code == "MARKER_SET_UNKNOWN"
    assert pbl("fit", tmp_path / "walk.trc", *out, "--marker-set", "blazepose_33").error_code == "MARKER_SET_UNKNOWN"
    assert pbl("fit", tmp_path / "walk.trc", *out, "--marker-set", tmp_path / "no.csv").error_code == "FILE_FORMAT"
    markers().save(tmp_path / "m.npz")
    assert pbl("fit", tmp_path / "m.npz", *out).error_code == "MARKER_SET_UNKNOWN"
    assert not fits


def test_pbl_fit_reads_views(fits, calibration, tmp_path):
    for name in ("walk.cam_02", "walk.cam_01"):
        side = 500 if name.endswith("2") else 1000
        keypoints(image_size_px=(side, side)).save(tmp_path / f"{name}.keypoints.npz")
    files = [tmp_path / f"walk.cam_0{i}.keypoints.npz" for i in (2, 1)]
    (tmp_path / "lab.csv").write_text(TABLE)
    done = pbl("fit", *files, "--cameras", calibration, "--marker-set", tmp_path / "lab.csv", "--out", tmp_path / "out")
    succeeds(done)
    (call,) = fits
    assert (call["names"], call["motion"]) == (["walk"], "static")
    (trial,) = call["trials"]
    assert isinstance(trial, MultiView)
    assert trial.marker_set == load_marker_set(tmp_path / "lab.csv").name
    assert trial.poses[0].p_nc.tolist() == [0, 0, -2]  # the first file is of the second camera
    done = pbl("fit", files[0], "--cameras", calibration, "--out", tmp_path / "out")
    assert done.error_code == "FIT_INPUT"
    markers(marker_set="blazepose_33", names=("nose", "left_hip", "right_hip")).save(tmp_path / "cam_01.npz")
    done = pbl("fit", tmp_path / "cam_01.npz", files[0], "--cameras", calibration, "--out", tmp_path / "out")
    assert done.error_code == "USAGE"


def test_keypoints_with_orientation_are_fitted_as_handheld(fits, tmp_path):
    keypoints().save(tmp_path / "still.npz")
    phone = keypoints(phone_time_s=PHONE_T, phone_quat_wxyz=np.tile(LEVEL, (3, 1)))
    phone.save(tmp_path / "phone.npz")
    out = ("--out", tmp_path / "out")
    succeeds(pbl("fit", tmp_path / "phone.npz", *out))
    succeeds(pbl("fit", tmp_path / "still.npz", *out))
    succeeds(pbl("fit", tmp_path / "phone.npz", tmp_path / "still.npz", *out))
    succeeds(pbl("fit", tmp_path / "phone.npz", *out, "--camera-motion", "static"))
    assert [c["motion"] for c in fits] == ["handheld", "static", ["handheld", "static"], "static"]
    assert all("markers" not in c for c in fits)


def test_events_of_markers(tmp_path):
    """Two feet that swing past each other in front of and behind the hips, one cycle a second, toes after heels."""
    time = np.arange(500) / 100
    names = ("LASI", "RASI", "LHEE", "RHEE", "LTOE", "RTOE")
    xyz = np.zeros((len(time), 6, 3))
    xyz[:, :2, 2], xyz[:, 0::2, 1], xyz[:, 1::2, 1] = 0.9, 0.1, -0.1
    for marker, (sign, late_s) in {2: (1, 0), 3: (-1, 0), 4: (1, 0.1), 5: (-1, 0.1)}.items():
        xyz[:, marker, 0] = 0.4 * sign * np.sin(2 * np.pi * (time - late_s))
    xyz[..., 0] += time[:, None]
    walk = WorldMarkers(time, names, "plug_in_gait", xyz, np.ones(xyz.shape[:2]))
    walk.save(tmp_path / "m.npz")
    succeeds(pbl("events", tmp_path / "m.npz", "--out", tmp_path / "e.csv"))
    assert (tmp_path / "e.csv").read_text().count("foot_down") >= 7
    with np.load(tmp_path / "m.npz") as f:
        fields = {k: f[k] for k in f.files}
    for changes in ({"xyz_world_m": changed(xyz, np.nan)}, {"names": np.array(["LASI"] * 6)}, {"time_s": time[1:]}):
        np.savez(tmp_path / "bad.npz", **{**fields, **changes})
        assert pbl("events", tmp_path / "bad.npz", "--out", tmp_path / "x.csv").error_code == "FILE_FORMAT"


@pytest.fixture
def paramsets(monkeypatch: pytest.MonkeyPatch) -> None:
    methods: Stage[Params] = Stage("fit", "solver", "usual")
    methods.register("paper", 1, ImplicitAdamParams(), len)
    methods.register("usual", 1, GaussNewtonParams(), len)
    methods.register("other", 1, GaussNewtonParams(max_iterations=7))
    methods.register("markers", 1, GaussNewtonParams(max_iterations=8))
    for module in ("fit", "fit.method_choice"):
        monkeypatch.setattr(f"pbl_pipeline.{module}.METHODS", methods)


@pytest.mark.usefixtures("paramsets")
def test_solver_and_paramset():
    expected = {
        (None, None): "usual",
        ("gauss-newton", None): "usual",
        ("implicit-adam", None): "paper",
        (None, "other"): "other",
        ("gauss-newton", "other"): "other",
    }
    assert {k: fit_paramset(*k).name for k in expected} == expected
    assert fit_paramset(None, None, [None]).name == "markers"
    assert fit_paramset("implicit-adam", None, [None]).name == "paper"
    for solver, params in (("newton", None), ("implicit-adam", "other"), (None, "none")):
        with pytest.raises(PblError, match=r"^SOLVER_UNKNOWN: "):
            fit_paramset(solver, params)


@pytest.mark.usefixtures("paramsets")
def test_markers_have_a_paramset_of_their_own(fits, tmp_path):
    (tmp_path / "walk.trc").write_text(trc_text(ROWS))
    (tmp_path / "lab.csv").write_text(TABLE)
    keypoints().save(tmp_path / "k.npz")
    more = ("--out", tmp_path / "out", "--marker-set", tmp_path / "lab.csv")
    succeeds(pbl("fit", tmp_path / "walk.trc", *more))
    succeeds(pbl("fit", tmp_path / "k.npz", "--out", tmp_path / "out"))
    succeeds(pbl("fit", tmp_path / "walk.trc", *more, "--solver", "implicit-adam"))
    assert [c["paramset"].name for c in fits] == ["markers", "usual", "paper"]


@pytest.mark.parametrize(
    ("markers", "root_relative", "expected"),
    [
        ("bml_movi_87", False, "gauss-newton"),
        ("bml_movi_87", True, "blazepose"),
        ("blazepose_33", True, "blazepose"),
        ("mpi_inf_3dhp_17", False, "blazepose"),
    ],
)
def test_the_fit_follows_from_the_points(fits, tmp_path, markers, root_relative, expected):
    """As in the tables (tests/integration/test_model_tables.py)."""
    path = tmp_path / "walk.keypoints.npz"
    seen = keypoints(marker_set=markers, root_relative=root_relative)
    seen.save(path)
    succeeds(pbl("fit", path, "--out", tmp_path / "out"))
    succeeds(pbl("fit", path, "--out", tmp_path / "out", "--params", "markers"))
    assert [c["paramset"].name for c in fits] == [expected, "markers"]
    other = keypoints(marker_set="bml_movi_87", root_relative=False)
    assert default_fit(*points_of([seen, other])) == ("gauss-newton" if expected == "gauss-newton" else "blazepose")


def test_changes_to_a_named_paramset(tmp_path):
    from pbl_pipeline.fit import METHODS

    (tmp_path / "mine.json").write_text('{"base": "paper-2025", "steps": 8000, "cost": {"weight_2d": 0.05}}')
    mine, paper = fit_paramset(None, str(tmp_path / "mine.json")).params, METHODS["paper-2025"].params
    assert isinstance(mine, ImplicitAdamParams)
    assert isinstance(paper, ImplicitAdamParams)
    assert (mine.steps, mine.cost.weight_2d) == (8000, 0.05)
    assert (mine.samples_per_trial, mine.cost.huber_2d_px) == (paper.samples_per_trial, paper.cost.huber_2d_px)
    wrong = {
        '{"base": "nobody"}': "nobody",
        '{"base": ["paper-2025"]}': "base",
        '{"base": "paper-2025", "step": 3}': "step",
        '{"cost": {"weight_2D": 1.0}}': "weight_2D",
        '{"cost": {"weight_2d": "0.1"}}': "no float @ $.cost.weight_2d",
        '{"cost": {"weight_2d": -0.1}}': "weight_2d = -0.1",
        '{"cost": {"weight_2d": NaN}}': "weight_2d",
        '{"cost": {"weight_2d": true}}': "no float @ $.cost.weight_2d",
        '{"cost": 3}': "cost",
        '{"max_iterations": 0}': "max_iterations",
        '{"max_iterations": -3}': "max_iterations",
        '{"max_iterations": "many"}': "max_iterations",
        '{"base": "paper-2025", "steps": 0}': "steps",
        '{"max_iterations": 1.5}': "no int @ $.max_iterations",
        '{"sd_floor": [["knee"]]}': "sd_floor",
        '{"solver": "implicit-adam"}': "solver",
        "[]": "object",
    }
    for text, words in wrong.items():
        (tmp_path / "bad.json").write_text(text)
        with pytest.raises(PblError) as error:
            fit_paramset(None, str(tmp_path / "bad.json"))
        assert code_of(error) == "FILE_FORMAT"
        assert words in error.value.found, text


def test_pbl_run_wants_a_log_for_each_video(tmp_path):
    videos = [chain.small_video(tmp_path, name, n=10) for name in ("a", "b")]
    log = csv_log(tmp_path / "a.csv", UPRIGHT, {"frame": "device"})
    done = pbl("run", *videos, "--attitude", log, "--out", tmp_path / "out")
    assert (done.code, done.error_code) == (1, "USAGE")
    assert "1 times --attitude for 2 videos" in done.err


@pytest.fixture
def detection(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tracking and keypoints are stand-ins; the walker is seen at 1920x1080."""
    chain.install(monkeypatch)
    monkeypatch.setattr("pbl_pipeline.pipeline.track_people", chain.track_people)
    monkeypatch.setattr("pbl_pipeline.pipeline.detect_keypoints", chain.detect_keypoints)


@pytest.mark.slow
@pytest.mark.usefixtures("detection")
def test_logs_go_with_their_videos_into_the_fit(fits, monkeypatch, tmp_path):
    monkeypatch.setattr(pipeline, "check_trial", lambda *_: None)
    videos = [chain.small_video(tmp_path, name) for name in ("a", "b")]
    logs = [csv_log(tmp_path / f"{a}.csv", about(0, a), {"frame": "device"}, n=400) for a in (90, 70)]
    visit, _ = pipeline.run_visit(videos, tmp_path / "out", attitude_files=logs)
    (call,) = fits
    assert call["motion"] == "handheld"
    for recording, log in zip(visit.fitted, logs, strict=True):
        assert recording.keypoints is not None
        np.testing.assert_array_equal(recording.keypoints.phone_quat_wxyz, load_attitude(log).quat_wxyz)
    pipeline.run_visit(videos, tmp_path / "out")
    assert fits[1]["motion"] == "static"
    assert all(k.phone_time_s is None for k in fits[1]["trials"])
    logs[1].write_text("nothing")
    monkeypatch.setattr(pipeline, "track_people", lambda *a, **k: pytest.fail("work was begun"))
    with pytest.raises(PblError, match=r"^PHONE_LOG: "):
        pipeline.run_visit(videos, tmp_path / "out", attitude_files=logs)


@pytest.mark.slow
@pytest.mark.usefixtures("detection")
@pytest.mark.parametrize(("markers", "expected"), [("bml_movi_87", "gauss-newton"), ("mpi_inf_3dhp_17", "blazepose")])
def test_a_session_is_fitted_as_its_points_want(fits, monkeypatch, tmp_path, markers, expected):
    monkeypatch.setattr(pipeline, "check_trial", lambda *_: None)
    monkeypatch.setattr(ModelKeypointParams, "points", lambda _: (markers, False))
    model = ModelParams("still", "1" * 64, "2" * 64, "MIT", 10)
    method = METHODS.make("still", 1, ModelKeypointParams(model_sha256=model.sha256, model=model))
    video = chain.small_video(tmp_path, "a")
    pipeline.run_visit([video], tmp_path / "out", keypoints=method)
    pipeline.run_visit([video], tmp_path / "out", keypoints=method, paramset="markers")
    assert [c["paramset"].name for c in fits] == [expected, "markers"]


@pytest.mark.usefixtures("detection")
def test_pbl_detect_keeps_the_log(tmp_path):
    video = chain.small_video(tmp_path, "a", n=60)
    log = csv_log(tmp_path / "a.csv", UPRIGHT, {"frame": "device"})
    done = pbl("detect", video, "--out", tmp_path / "k.npz", "--attitude", log)
    succeeds(done)
    assert "3 samples" in done.out
    np.testing.assert_array_equal(Keypoints.load(tmp_path / "k.npz").phone_quat_wxyz, load_attitude(log).quat_wxyz)
    assert pbl("detect", video, "--out", tmp_path / "k.npz", "--attitude", video).error_code == "PHONE_LOG"
    assert pbl("detect", video, "--out", tmp_path / "k.npz", "--attitude", tmp_path / "no").error_code == "FILE_MISSING"
