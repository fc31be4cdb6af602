"""Trials that several calibrated cameras film: one fit of all views, beside the phone's and never pooled with it."""

import dataclasses
import functools
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pbl_pipeline.depth import DepthFile
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints, MultiView
from pbl_pipeline.synthetic import NO_NOISE, plain_walk
from pbl_schemas import fit, gait, gdi, jobs, load_visit, norms, validation, video
from pbl_schemas.decisions.review_decisions import decide_person
from pbl_schemas.intake import Sensors, SeveralCameras, VisitRecord, ingest, register
from pbl_schemas.job_errors import error_code
from pbl_schemas.operations.forget import forget
from pbl_schemas.plan import fit_set_hash
from pbl_schemas.reading import frames
from pbl_schemas.reading.visits import methods_of
from pbl_schemas.reading.why import why
from pbl_schemas.studies import slices
from pbl_schemas.studies.study_sheets import import_sheets
from pbl_workers.populate import populate
from research.walker.views import observe_views
from tests import StandIn, worn_sensor
from tests.command import pbl
from tests.rows import outcomes
from tests.videos import constant_rate, numbered_frames, write_video
from tests.walking_fit import CYCLE_S
from tests.worn_sensor import Swing

from . import chain

CAMERAS = ("cam_01", "cam_02", "cam_03")
REFUSED = PblError("FIT_INPUT", found="x", expected="y", next_step="z")


@functools.cache
def rig_views(n_frames: int, backwards: bool = False) -> MultiView:
    """The walk of the stand-in's fit of a video, seen by three cameras without noise; or somebody who goes its way the
    other way round."""
    time = np.arange(n_frames) / 30
    walk = plain_walk(time, stride_s=CYCLE_S, speed_m_per_s=1.2, start_m=(6.0, -2.2), camera_height_m=0)
    walk = walk[::-1] if backwards else walk
    return observe_views(walk, time, n_views=3, marker_set="blazepose_33", noise=NO_NOISE, with_3d=True)


def calibration(path: Path, cameras: tuple[str, ...] = CAMERAS) -> Path:
    """A file of these cameras as Pose2Sim writes it."""
    seen, text = rig_views(chain.N_FRAMES), ""
    for name, view, pose in zip(cameras, seen.views, seen.poses, strict=False):
        R_cn = pose.R_nc.T
        text += f"[{name}]\nsize = {list(map(float, view.image_size_px))}\n"
        text += f"matrix = {view.camera.matrix.tolist()}\ndistortions = {view.camera.distortion.tolist()}\n"
        text += f"rotation = {Rotation.from_matrix(R_cn).as_rotvec().tolist()}\n"
        text += f"translation = {(-R_cn @ pose.p_nc).tolist()}\n"
    path.write_text(text)
    return path


def rig_videos(
    folder: Path, trial: str = "", n: int = chain.N_FRAMES, cameras: tuple[str, ...] = CAMERAS
) -> list[Path]:
    """A video of each camera, named after it."""
    folder.mkdir(exist_ok=True)
    out = []
    for i, camera in enumerate(cameras):
        frames = (np.roll(f, 40 * i + sum(map(ord, trial)) % 40, axis=1) for f in numbered_frames(n, 72, 128))
        out.append(write_video(folder / f"{trial}{camera}.mp4", frames, constant_rate(n)))
    return out


def detect_keypoints(video_path, tracking, person_id, camera, params=None) -> Keypoints:
    """A camera of the rig sees its view; person 2 walks backwards. Others as the chain's stand-in."""
    camera_name = next((c for c in CAMERAS if c in Path(video_path).stem), None)
    if camera_name is None:
        return chain.detect_keypoints(video_path, tracking, person_id, camera, params)
    seen = rig_views(len(tracking.time_s), backwards=person_id == 2).views[CAMERAS.index(camera_name)]
    return dataclasses.replace(seen, time_s=tracking.time_s)


def fit_none(trials, names, paramset=None, camera_motion="static"):
    """The movement that was put in, whatever the cameras saw; all of one session are of one kind."""
    assert len({type(t) for t in trials}) == 1
    return chain.fit_session(trials, names, paramset, camera_motion)


@pytest.fixture
def rig(tables: None, stand_in: StandIn) -> None:
    stand_in(detect_keypoints=detect_keypoints, fit_session=fit_none)


def errors_of(table) -> list[tuple[int, str]]:
    rows = jobs.jobs_of(table).errors.to_dicts(order_by="KEY")
    return [(int(r["video_id"]), error_code(r["error_message"])) for r in rows]


@pytest.mark.long
def test_a_phone_and_three_cameras_measure_the_same_walk(rig: None, tmp_path: Path, stand_in: StandIn):
    stand_in(fit_session=chain.fit_either)
    visit = ("--subject", "P001", "--session", "2026-03-01")
    assert pbl("ingest", chain.small_video(tmp_path, "walk"), *visit).code == 0
    toml = calibration(tmp_path / "Calib.toml")
    said = pbl("ingest", *rig_videos(tmp_path / "lab"), "--rig", toml, *visit)
    assert said.code == 0, said
    assert "trial 2, camera cam_03" in said.out
    toml.unlink()  # the store has its own
    populate()
    assert errors_of(fit.TrialInput) == []
    row = (fit.TrialInput & {"video_id": 2}).fetch1()
    assert row["ray_miss"] < 0.1
    assert sorted(fit.TrialInput().to_arrays("video_id").tolist()) == [1, 2]
    # One trial of the rig, with an index of its own, whose only cycles are its own.
    found = {r["fit_set_kind"]: r for r in frames.session_summary().to_dict("records")}
    assert set(found) == {"single", "rig"}
    used = {int(r["video_id"]): int(r["n_cycles_used"]) for r in gait.GaitCycle().to_dicts()}
    assert set(used) == {1, 2}
    assert found["single"]["session_cycles"] == used[1] > 0
    assert found["rig"]["session_cycles"] == used[2] > 0
    assert found["rig"]["session_cadence"] == pytest.approx(120 / CYCLE_S, rel=0.01)
    trial = (fit.SessionFit.Trial & {"video_id": 2}).fetch1()
    assert trial["trial_residual_2d"] < 3.0
    assert trial["trial_orientation"] == "measured: calibration"
    assert (trial["trial_name"], len(fit.SessionFit.Trial())) == ("cam_01", 2)
    # The stand-in gives the phone's movement exactly, so what differs is the error of the fit of the views.
    by_kind = {k: load_visit({"subject": "P001", "fit_set_kind": k}) for k in ("single", "rig")}
    truth, seen = (r.fit for s in by_kind.values() for r in s.fitted if r.fit is not None)
    for joint in ("knee_angle_r", "hip_flexion_l"):
        column = truth.joint_names.index(joint)
        assert np.degrees(np.nanmedian(np.abs(seen.qpos - truth.qpos)[:, column])) < 2.0, joint
    assert methods_of(by_kind["rig"].key)["Cameras"] == "cam_01, cam_02, cam_03"
    assert "Cameras" not in methods_of(by_kind["single"].key)
    assert [[r.name for r in s.recordings] for s in by_kind.values()] == [["walk"], ["cam_01"]]
    with pytest.raises(PblError, match="USAGE"):
        load_visit({"subject": "P001"})
    # What was computed is not planned again.
    populate()
    assert len(fit.SessionFit()) == 2
    for number in (1, 2, 4):
        assert why(number).verdict == "everything is computed"
    # A norm and a slice are of one kind, or they say that there are two.
    with pytest.raises(PblError, match="rig, "):
        norms.build_norm("both", populations=(), subjects=("P001",))
    sheet = tmp_path / "visits.csv"
    sheet.write_text("subject,visit,date,role\nP001,2026-03-01,2026-03-01,baseline\n")
    assert import_sheets([sheet]).done
    with pytest.raises(PblError, match="rig, "):
        slices.freeze("both")
    for kind, name in (("single", "phone"), ("rig", "lab")):
        frozen = pbl("study", "slice", name, "--kind", kind)
        assert frozen.code == 0, frozen
        data = slices.study_data(name)
        assert data.visits["gdi"].tolist() == [found[kind]["session_gdi"]]
        assert data.description.methods["fit_set_kind"] == kind
        assert slices.changes(name) == []
    # The cameras' angles as the reference of the phone's, from the tables.
    added = pbl("validate", "add", 1, "--of-trial", 3, "--dataset", "OURS")  # any camera of the trial
    assert added.code == 0, added
    assert "source several cameras" in added.out
    populate()
    (error,) = validation.KinematicError().to_dicts()
    joints = {r["error_joint"]: r["joint_median_abs"] for r in validation.KinematicError.Joint().to_dicts()}
    assert abs(error["error_lag"]) < 0.02
    assert joints["knee_flexion_r"] < 2.0
    assert frames.validation_frame()["dataset"].unique().tolist() == ["OURS"]
    for wrong, code in ((("--of-trial", 1), "USAGE"), (("--of-trial", 99), "DB_NOT_FOUND")):
        assert pbl("validate", "add", 1, *wrong).error_code == code
    assert pbl("validate", "add", 1).code == 2
    # As docs/study.md says it.
    wide = frames.session_summary().pivot_table("session_gdi", ["subject", "session_label"], "fit_set_kind")
    assert wide["rig"].tolist() == [found["rig"]["session_gdi"]]


@pytest.mark.long
def test_people_of_the_cameras(rig: None, tmp_path: Path, stand_in: StandIn):
    """Somebody else in one camera, or nobody, takes a trial out with a reason; the other trials are fitted."""

    def track_people(video_path, params=None, info=None):
        nobody = Path(video_path).name == "w2.cam_02.mp4"
        return chain.track_people(
            Path("x_nobody.mp4") if nobody else video_path, params, info or chain.probe(video_path)
        )

    stand_in(track_people=track_people)
    toml = calibration(tmp_path / "Calib.toml")
    for trial in ("w1.", "w2."):
        made = register([SeveralCameras(rig_videos(tmp_path, trial), toml, VisitRecord("P001"))])
        assert outcomes(made) == ["registered"] * 3, made
    populate()
    assert len(video.Rig()) == 1
    (first,) = fit.FitSet().to_dicts()
    assert (first["fit_set_kind"], first["fit_set_n"]) == ("rig", 3)
    assert fit.SessionFit.Trial().to_arrays("video_id").tolist() == [1]
    # A worker with a GPU hands a batch over.
    batch: list = []
    stand_in(fit_sessions=lambda given, *_, **__: batch.extend(given) or [REFUSED])
    (key,) = fit.FitSelection().keys()
    assert fit.SessionFit().make_computes([key], [fit.SessionFit().make_fetch(key)]) == [None]
    assert [t.cameras for t in batch[0].trials] == [CAMERAS]
    for number in (4, 6):
        assert why(number).verdict.startswith(
            "choice of the person of its camera, video_id 5, ran well and found nothing"
        )
    # Another person in one camera: what was computed of the trial goes, and the check says it.
    decide_person(3, 2)
    assert len(fit.SessionFit()) == len(fit.FitSet()) == len(fit.TrialInput()) == 0
    populate()
    assert len(fit.FitSet()) == 0
    assert errors_of(fit.TrialInput) == [(1, "VIEWS_DISAGREE")]
    verdict = why(2).verdict
    assert "VIEWS_DISAGREE" in verdict
    assert "cam_03" in verdict
    decide_person(3, 1)
    populate()
    assert errors_of(fit.TrialInput) == []
    assert fit.FitSet().to_arrays("fit_set").tolist() == [first["fit_set"]]
    assert fit.SessionFit.Trial().to_arrays("video_id").tolist() == [1]
    keys = [{"video_id": 2, "tracking_method": "t", "keypoint_method": "k"}]
    assert fit.TrialInput.with_trials(keys) == [*keys, {**keys[0], "video_id": 1}]
    # The pace of one camera is that of the trial.
    assert ingest([tmp_path / "w1.cam_02.mp4"], VisitRecord("P001", pace="fast"))[0].status == "updated"
    assert {c.pace for v, c in video.conditions(True).items() if v < 4} == {"fast"}
    assert len(gdi.SessionGdi()) == 0
    files = {r["rig_file"].path for r in video.Rig().to_dicts()}
    forgotten = forget("P001")
    assert (forgotten.left, len(video.RigView()), len(video.Video())) == ([], 0, 0)
    assert len(video.Rig()) == 1  # the laboratory's, nobody's
    assert not files & set(forgotten.files)


def test_trials_that_cannot_be_are_refused(rig: None, tmp_path: Path):
    toml = calibration(tmp_path / "Calib.toml")
    one, two, three = rig_videos(tmp_path, n=30)

    def codes(paths: list[Path], *more: object, by: Path = toml) -> set[str]:
        said = pbl("ingest", *paths, "--rig", by, "--subject", "P001", *more)
        assert said.code == 1, said
        return {line.split(":")[0] for line in said.err.splitlines() if line[:1].isupper()}

    assert codes([one]) == {"FIT_INPUT"}
    (tmp_path / "copy").mkdir()
    again = tmp_path / "copy" / "cam_02.mp4"
    again.write_bytes(one.read_bytes())
    assert codes([one, again]) == {"USAGE"}  # one video as two cameras
    other = rig_videos(tmp_path / "other", cameras=("cam_01", "cam_04"), n=30)
    assert codes(other) == {"CAMERA_INVALID"}  # not in the calibration
    assert codes([one, tmp_path / "cam_02_absent.mp4", three]) == {"CAMERA_INVALID"}
    assert codes([one, tmp_path / "absent" / "cam_02.mp4"]) == {"USAGE", "VIDEO_MISSING"}
    assert codes([one, rig_videos(tmp_path / "short", n=29)[1]]) == {"FIT_INPUT"}
    slow = write_video(tmp_path / "copy" / "cam_03.mp4", numbered_frames(30, 72, 128), constant_rate(30, 25.0))
    assert codes([one, slow]) == {"FIT_INPUT"}
    text = write_video(tmp_path / "copy" / "cam_01.mp4", numbered_frames(30, 72, 72), constant_rate(30))
    assert codes([text, two]) == {"CAMERA_INVALID", "USAGE"}  # another shape than was calibrated
    assert codes([one, two], by=tmp_path / "absent.toml") == {"CAMERA_INVALID"}
    assert codes([one, two], "--camera-motion", "handheld") == {"USAGE"}
    assert codes([one, two], "--person", "1") == {"USAGE"}
    for wrong in (("--markers", tmp_path / "a.trc"), ("--attitude", "none", "--attitude", "none")):
        assert pbl("ingest", one, two, "--rig", toml, "--subject", "P001", *wrong).code == 2
    assert len(video.Video()) == len(video.Rig()) == 0
    # Registered: the same again is known; anything else of these files is refused.
    assert outcomes(ingest([three], VisitRecord("P001"))) == ["registered"]
    assert codes([one, two, three]) == {"USAGE"}
    made = register([SeveralCameras([one, two], toml, VisitRecord("P001"))])
    assert outcomes(made) == ["registered"] * 2
    shank = worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt")
    said = pbl("ingest", one, two, "--rig", toml, "--subject", "P001", "--imu", f"shank_r={shank}")
    assert (said.code, video.WearableImu.fetch1("imu_segments")) == (0, {"shank_r": "00B42D4B"})
    assert codes([two, one, *rig_videos(tmp_path / "more", n=30)[2:]]) == {"USAGE"}
    assert codes(rig_videos(tmp_path / "more", "w.", n=30)) == {"USAGE"}  # three cameras in a session with two
    assert outcomes(ingest([one], VisitRecord("P001", camera_file=toml))) == ["USAGE"]
    depth = Sensors(depth=DepthFile(chain.depth_pictures(tmp_path / "depth"), 0.001))
    assert outcomes(ingest([one], VisitRecord("P001"), files=[depth])) == ["USAGE"]
    assert len(video.Video()) == 3


def test_the_hash_of_a_set_knows_camera_trial_and_calibration():
    row = {"video_sha256": "a", "keypoints_person_id": 1}
    view = {**row, "rig_trial": 1, "trial_sha256": "a", "rig_camera": "cam_01", "rig_sha256": "c"}
    group = {"session_id": 1, "tracking_method": "t", "keypoint_method": "k"}
    other = [{**view, name: "x"} for name in ("rig_camera", "rig_sha256", "trial_sha256", "keypoints_person_id")]
    found = [fit_set_hash(group, [r]) for r in (row, view, *other)]
    assert len(set(found)) == len(found)
