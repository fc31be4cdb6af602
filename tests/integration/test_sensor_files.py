"""Files that come with a video, in the tables: the phone's log reaches keypoints and fit, the others are kept."""

import dataclasses
import errno
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datajoint.storage import StorageBackend

from pbl_pipeline import sensors, settings
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.records import from_row, plain
from pbl_pipeline.results import SensorFit
from pbl_pipeline.sensors import Given, SensorLog, named, read_samples
from pbl_pipeline.sensors.formats.samples import Samples
from pbl_schemas import fit, keypoints, lab, load_visit, qc, video
from pbl_schemas.intake import Sensors, VisitRecord, ingest
from pbl_schemas.intake.sensors import attach_worn
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers.populate import populate
from tests import Faults, StandIn, not_none, worn_sensor
from tests.command import pbl
from tests.integration import chain
from tests.integration.test_tables import errors
from tests.phone_film import as_zip, film, sensor_logger
from tests.quicktime import insert, meta
from tests.rows import late_fit, outcomes, register
from tests.worn_sensor import Swing

pytestmark = pytest.mark.usefixtures("tables")

BEGIN_S, SECONDS = 2.0, 8.0
#: The chain as far as most of these tests need it.
SEEN = ["VideoInfo", "Tracking", "SubjectChoice", "Keypoints"]


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A video that a hand held, and the log of the phone, which began two seconds before."""
    folder = tmp_path_factory.mktemp("capture")
    return film(folder / "walk.mov", BEGIN_S, SECONDS), sensor_logger(folder / "log", 12.0)


def stored_keypoints() -> Keypoints:
    ref = file_ref(keypoints.Keypoints.fetch1("keypoints_file"))
    with stored_file(ref) as path:
        return Keypoints.load(path)


def test_the_log_reaches_keypoints_and_fit(capture, stand_in: StandIn):
    seen = []

    def fit_session(trials, names, paramset=None, camera_motion="static"):
        seen.append((trials[0].phone_time_s, camera_motion))
        return chain.fit_session(trials, names, paramset)

    stand_in(fit_session=fit_session)
    path, log = capture
    (result,) = ingest([path], VisitRecord("P001"), files=[Sensors(attitude=log)])
    assert result.status == "registered"
    assert "the phone's log of 1200 orientations" in result.note
    assert video.Video.fetch1("camera_motion") == "handheld"
    row = video.PhoneAttitude.fetch1()
    assert (row["attitude_name"], row["attitude_form"], row["attitude_n"]) == ("log", "Sensor Logger folder", 1200)
    assert row["attitude_sensors"] == {"gravity": 1200, "gyroscope": 1200}
    assert row["attitude_start_utc"] == "2026-03-01T09:15:30.013Z"
    assert row["attitude_rate"] == pytest.approx(100, rel=1e-3)
    assert not errors(populate())
    assert "by the pictures' movement" in keypoints.Keypoints.fetch1("phone_log")
    kept = stored_keypoints()
    assert kept.phone_time_s is not None
    # The log's first row is 13 ms after its beginning, and that 2 s before the video.
    assert kept.phone_time_s[0] == pytest.approx(0.013 - BEGIN_S, abs=0.02)
    ((times, motions),) = seen
    np.testing.assert_array_equal(times, kept.phone_time_s)
    assert motions == ["handheld"]
    # The same log again, as a zip of the same files too, changes nothing.
    assert outcomes(ingest([path], VisitRecord("P001"), files=[Sensors(attitude=log)])) == ["known"]
    assert len(fit.SessionFit()) == 1


def test_a_known_video_takes_and_gives_back_a_log(capture):
    path, log = capture
    (number,) = register(path)
    assert video.Video.fetch1("camera_motion") == "static"
    populate(SEEN)
    assert keypoints.Keypoints.fetch1("phone_log") is None
    packed = as_zip(log)
    told = pbl("ingest", path, "--subject", "P001", "--attitude", packed)
    assert told.code == 0, told.err
    assert "was attached" in told.out
    assert "handheld now" in told.out
    assert len(keypoints.Keypoints()) == 0
    assert not errors(populate(SEEN))
    assert video.PhoneAttitude.fetch1("attitude_form") == "Sensor Logger zip"
    assert keypoints.Keypoints.fetch1("phone_log").startswith("log.zip (Sensor Logger zip)")
    told = pbl("ingest", path, "--subject", "P001", "--attitude", "none")
    assert "the phone's log was removed" in told.out
    assert len(video.PhoneAttitude()) == 0
    populate(SEEN)
    assert keypoints.Keypoints.fetch1("phone_log") is None
    assert number == 1


def test_a_log_of_another_time_is_an_error_of_its_video_only(capture, tmp_path: Path):
    path, _ = capture
    other = film(tmp_path / "other.mov", 60.0, SECONDS)
    short = sensor_logger(tmp_path / "short", 4.0)
    none = Sensors(attitude=Path("none"))
    results = ingest([path, other], VisitRecord("P001"), files=[none, Sensors(attitude=short)])
    assert outcomes(results) == ["registered", "registered"]
    assert errors(populate()) == {"Keypoints": {"PHONE_LOG": 1}}
    # The other recording of the visit is measured all the same.
    assert len(fit.SessionFit()) == 1
    assert outcomes(ingest([other], VisitRecord("P001"), files=[none])) == ["updated"]
    assert not errors(populate(SEEN))
    assert len(keypoints.Keypoints()) == 2


def test_a_log_that_cannot_be_read_registers_nothing(capture, tmp_path: Path):
    path, log = capture
    bad = tmp_path / "log.csv"
    bad.write_text("time_s,qw,qx,qy,qz\n0,1,0,0,0\n0,1,0,0,0\n")
    told = pbl("ingest", path, "--subject", "P001", "--attitude", bad)
    assert (told.code, told.error_code) == (1, "PHONE_LOG")
    assert len(video.Video()) == 0
    told = pbl("ingest", path, path, "--subject", "P001", "--attitude", log)
    assert told.error_code == "USAGE"


def test_depth_video_and_wearables_are_kept(capture, tmp_path: Path):
    path, _ = capture
    depth, left, right, empty = (tmp_path / n for n in ("depth.mov", "left.csv", "right.csv", "empty.csv"))
    for file, content in ((depth, b"depth"), (left, b"left"), (right, b"right"), (empty, b"")):
        file.write_bytes(content)
    told = pbl("ingest", path, "--subject", "P001", "--depth", depth, "--imu", left, "--imu", right)
    assert told.code == 0, told.err
    assert "kept and not read" in told.out
    told = pbl("ingest", path, "--subject", "P001", "--depth", depth, "--imu", right)
    assert "nothing was inserted" in told.out
    assert video.DepthVideo.fetch1("depth_name") == "depth.mov"
    assert list(video.WearableImu.to_arrays("imu_name", order_by="imu")) == ["left.csv", "right.csv"]
    for number, content in ((1, b"left"), (2, b"right")):
        row = (video.WearableImu & {"imu": number}).fetch1()
        assert row["imu_sha256"] == sha256_of(left if number == 1 else right)
        with stored_file(file_ref(row["imu_file"])) as kept:
            assert kept.read_bytes() == content
    assert set(video.WearableImu.to_arrays("imu_segments")) == {None}
    two = pbl("ingest", path, depth, "--subject", "P001", "--imu", left)
    assert (two.error_code, "--imu left.csv for 2 videos" in two.err) == ("USAGE", True)
    assert pbl("ingest", path, "--subject", "P001", "--imu", empty).error_code == "FILE_FORMAT"
    assert pbl("ingest", path, "--subject", "P001", "--imu", tmp_path / "none").error_code == "FILE_MISSING"


def test_sensors_of_a_visit_reach_its_fit(tmp_path: Path, stand_in: StandIn):
    given = []

    def fit_session(trials, names, paramset=None, camera_motion="static", sensors=(), sensor_clock_s=None):
        given.append((len(trials), {log.segment: log for log in sensors}, sensor_clock_s))
        return chain.fit_session(trials, names, paramset)

    def fitted() -> tuple[int, dict[str, SensorLog], object]:
        given.clear()
        assert not errors(populate())
        (one,) = given
        return one

    stand_in(fit_session=fit_session)
    videos = [chain.small_video(tmp_path, name) for name in ("a", "b")]
    shank = worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt")
    thigh = worn_sensor.xsens(Swing(phase=1), tmp_path / "MT_1-000_00B42D4C.txt", rate=False)
    (tmp_path / "worn.csv").write_text(f"segment,file,rate_hz,mount\nthigh_r,{thigh.name},100,x down z right\n")
    told = pbl("ingest", *videos, "--subject", "P001", "--imu", f"shank_r={shank}")
    assert told.code == 0, told.err
    assert "sensors on shank_r" in told.out
    assert len(video.WearableImu()) == 1
    n, logs, clocks = fitted()
    assert (n, list(logs), clocks) == (2, ["shank_r"], [None, None])
    np.testing.assert_allclose(logs["shank_r"].rate, Swing().rate, atol=1e-5)  # type: ignore[arg-type]
    # Another segment: the fit is computed again, with the clock of both.
    told = pbl("ingest", videos[1], "--subject", "P001", "--imu", tmp_path / "worn.csv")
    assert "what was fitted without them was deleted: 1 of `pbl_fit`.`__session_fit`" in told.out
    _, logs, _ = fitted()
    assert {k: log.name for k, log in logs.items()} == {"shank_r": "00B42D4B", "thigh_r": "00B42D4C"}
    assert (logs["shank_r"].mounting, not_none(logs["thigh_r"].mounting).shape) == (None, (4,))
    assert "nothing was inserted" in pbl("ingest", videos[1], "--subject", "P001", "--imu", tmp_path / "worn.csv").out
    # Another mounting of the same file, and none.
    (tmp_path / "worn.csv").write_text(f"segment,file,rate_hz\nthigh_r,{thigh.name},100\n")
    assert "deleted: 1 of" in pbl("ingest", videos[1], "--subject", "P001", "--imu", tmp_path / "worn.csv").out
    assert fitted()[1]["thigh_r"].mounting is None
    other = worn_sensor.xsens(Swing(phase=2), tmp_path / "MT_1-000_00B42D4D.txt")
    told = pbl("ingest", videos[1], "--subject", "P001", "--imu", f"thigh_r={other}")
    assert f"{other.name} was attached instead of {thigh.name}, sensors on thigh_r" in told.out
    # A sensor was on the other side; a file with several sensors takes the place of one.
    told = pbl("ingest", videos[0], "--subject", "P001", "--imu", f"shank_l={shank}")
    assert f"{shank.name} was attached, sensors on shank_l" in told.out  # not instead of another file
    assert set(fitted()[1]) == {"shank_l", "thigh_r"}
    several = worn_sensor.apdm({"Left Ankle": Swing(phase=2), "Lumbar": Swing(phase=3)}, tmp_path / "apdm.csv")
    told = pbl("ingest", videos[0], "--subject", "P001", "--imu", several, "--imu", "none")
    assert told.code == 0, told.err
    told = pbl("ingest", videos[0], "--subject", "P001", "--imu", several)
    assert "sensors on pelvis, shank_l" in told.out
    assert set(fitted()[1]) == {"pelvis", "shank_l"}
    assert [r["imu_segments"] for r in video.WearableImu.to_dicts()] == [{"pelvis": "Lumbar", "shank_l": "Left Ankle"}]
    assert "were removed" in pbl("ingest", videos[0], "--subject", "P001", "--imu", "none").out
    assert len(video.WearableImu()) == 0
    assert fitted()[1:] == ({}, None)


def with_sensors(trials, names, paramset=None, camera_motion="static", sensors=(), sensor_clock_s=None):
    """A fit, and what would have been found of the sensors: the clock is the earliest that the wall clocks allow."""
    result = chain.fit_session(trials, names, paramset)
    if not sensors:
        return result
    made = [
        dataclasses.replace(trial, sensors=tuple(found_of(log, clock) for log in sensors))
        for trial, clock in zip(result.trials, sensor_clock_s or (), strict=True)
    ]
    return dataclasses.replace(result, trials=tuple(made))


def found_of(log: SensorLog, clock: tuple[float, float] | None) -> SensorFit:
    turn, rest = np.array([0.6, 0.8, 0.0, 0.0]), dict.fromkeys(("heading_rad", "tilt_rad", "gain", "slip"), 0.1)
    known = {"bias_rad_s": np.zeros(3), "dropped": 0.0, "z": 0.9, "rate_rad_s": 1.0, **rest}
    start = np.nan if clock is None else clock[0]
    return SensorFit(log.segment, log.name, log.segment, turn, clock_s=start, off_s=np.nan, **known)


def test_what_a_fit_found_of_sensors_is_stored(tmp_path: Path, stand_in: StandIn):
    stand_in(fit_session=with_sensors)
    path = chain.small_video(tmp_path, "a")
    insert(path, of_file=meta({"com.apple.quicktime.creationdate": "2026-03-01T09:16:10Z"}))
    table = Swing().own().assign(start_utc="2026-03-01T09:15:30Z")
    given = f"shank_r={Swing().write(tmp_path / 'shank.csv', table)}"
    assert pbl("ingest", path, "--subject", "P001", "--imu", given).code == 0
    assert not errors(populate())
    row = fit.SessionFit.Sensor.fetch1()
    assert (row["sensor_segment"], row["sensor_name"], row["sensor_z"]) == ("shank_r", "shank", 0.9)
    assert (row["sensor_mounting"], row["sensor_clock_off"]) == ([0.6, 0.8, 0.0, 0.0], None)
    # The video ended or began 40 s after the sensors, give or take 10.
    assert 40 - 10 - 15 < row["sensor_clock"] < 40 - 10
    (trial,) = load_visit({"subject": "P001"}).fitted
    assert plain(not_none(trial.fit).sensors) == plain([from_row(SensorFit, row)])


def test_a_fit_that_failed_by_its_sensors_is_tried_again(tmp_path: Path, stand_in: StandIn):
    def fails(trials, names, paramset=None, camera_motion="static", sensors=(), sensor_clock_s=None):
        if sensors:
            raise PblError("FIT_INPUT", found="a log of another walk", expected="this one", next_step="leave it out")
        return chain.fit_session(trials, names, paramset)

    stand_in(fit_session=fails)
    path, shank = chain.small_video(tmp_path, "a"), worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt")
    assert pbl("ingest", path, "--subject", "P001", "--imu", f"shank_r={shank}").code == 0
    for how in (f"shank_l={shank}", "none"):
        assert errors(populate()) == {"SessionFit": {"FIT_INPUT": 1}}
        assert pbl("ingest", path, "--subject", "P001", "--imu", how).code == 0
    assert not errors(populate())
    assert len(fit.SessionFit()) == 1


def test_sensors_of_one_file_are_named_one_by_one(tmp_path: Path):
    path = chain.small_video(tmp_path, "a")
    both = {"shank_r": "Right Ankle", "thigh_r": "Right Thigh"}
    swings = {name: Swing(phase=i) for i, name in enumerate(("Right Ankle", "Right Thigh", "Lumbar"))}
    several = worn_sensor.apdm(swings, tmp_path / "apdm.csv")
    (tmp_path / "list.csv").write_text("segment,file,rate_hz\npelvis,apdm.csv,128\n")
    for how in (f"shank_r={several}", f"thigh_r={several}", tmp_path / "list.csv"):
        told = pbl("ingest", path, "--subject", "P001", "--imu", how)
        assert told.code == 0, told.err
    (row,) = video.WearableImu.to_dicts()
    assert row["imu_segments"] == {"shank_r": "Right Ankle", "thigh_r": "Right Thigh", "pelvis": "Lumbar"}
    assert row["imu_rate"] == 128
    # A mount goes with its segment to another file; the same sensor again changes nothing.
    (tmp_path / "mounts.toml").write_text(
        "".join(f"{s}={{file='apdm.csv', sensor='{n}', rate_hz=128, mount='x up, z back'}}\n" for s, n in both.items())
    )
    other = worn_sensor.apdm({"Right Thigh": Swing(phase=5)}, tmp_path / "other.csv")
    for how in (tmp_path / "mounts.toml", f"thigh_r={other}"):
        assert pbl("ingest", path, "--subject", "P001", "--imu", how).code == 0
    row = video.WearableImu.to_dicts()[0]
    assert list(row["imu_mounts"]) == ["shank_r"]
    text = (tmp_path / "mounts.toml").read_text()
    (tmp_path / "mounts.toml").write_text(text.split("\n")[0])
    assert "nothing was inserted" in pbl("ingest", path, "--subject", "P001", "--imu", tmp_path / "mounts.toml").out
    assert pbl("ingest", path, "--subject", "P001", "--imu", f"thigh_r={several}").code == 0
    # A sensor with another clock is refused here, not by the fit.
    foot = worn_sensor.xsens(Swing(phase=4), tmp_path / "MT_1-000_00B42D4B.txt")
    told = pbl("ingest", path, "--subject", "P001", "--imu", f"foot_r={foot}")
    assert (told.code, told.error_code, "different clocks" in told.err) == (1, "SENSOR_LOG", True)
    assert len(video.WearableImu()) == 1


def test_logs_are_read_once_and_outside_of_transactions(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """And what comes to the visit meanwhile is not passed over."""
    path, reads = chain.small_video(tmp_path, "a"), []

    def counted(file: Path, *more: Any) -> list[Samples]:
        reads.append((file, lab.schema.connection.in_transaction))
        return read_samples(file, *more)

    monkeypatch.setattr(sensors, "read_samples", counted)
    shank, thigh, foot = (
        worn_sensor.apdm({name: Swing(phase=i)}, tmp_path / f"{name}.csv")
        for i, name in enumerate(("Right Ankle", "Right Thigh", "Left Foot"))
    )
    assert pbl("ingest", path, "--subject", "P001", "--imu", shank).code == 0
    assert reads == [(shank, False)]
    late = Sensors(imu=named(Given(foot))).read()[0].at_visit(*fit.worn_logs({"session_id": 1}))
    reads.clear()
    assert pbl("ingest", path, "--subject", "P001", "--imu", thigh).code == 0
    assert [(file == thigh, inside) for file, inside in reads] == [(True, False), (False, False)]  # and the stored one
    with pytest.raises(PblError) as meanwhile:
        attach_worn(1, late)
    assert (meanwhile.value.code, len(video.WearableImu())) == ("DECIDED_MEANWHILE", 2)


def test_a_fit_without_the_sensors_is_not_inserted_after_them(tmp_path: Path, stand_in: StandIn):
    stand_in(fit_session=with_sensors)
    path, shank = chain.small_video(tmp_path, "a"), worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt")
    assert pbl("ingest", path, "--subject", "P001", "--imu", f"shank_r={shank}").code == 0
    assert not errors(populate())
    late_fit(video.WearableImu, "other wearable sensors")
    assert not errors(populate())
    assert len(fit.SessionFit()) == 1


def test_sensors_stay_at_their_visit_when_their_video_moves(tmp_path: Path, stand_in: StandIn):
    stand_in(fit_session=with_sensors)
    videos = [chain.small_video(tmp_path, name) for name in ("a", "b", "c")]
    shank = worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt")
    register(videos[2], subject="P002", session_label="1")
    assert pbl("ingest", *videos[:2], "--subject", "P001", "--imu", f"shank_r={shank}").code == 0
    first, second = (int((video.Video & {"video_name": v.name}).fetch1("video_id")) for v in videos[:2])
    assert not errors(populate())
    assert pbl("move", first, "--to", "P002/1", "--yes").code == 0
    assert video.WearableImu.fetch1("video_id") == second
    assert not errors(populate())
    # The last video of the visit takes them along; what was fitted there without them is deleted.
    assert "would be deleted: 3 rows of `pbl_fit`.`__session_fit`" in pbl("move", second, "--to", "P002/1").out
    assert pbl("move", second, "--to", "P002/1", "--yes").code == 0
    assert video.WearableImu.fetch1("video_id") == second
    assert len(fit.SessionFit()) == 0


def test_a_sensor_log_that_cannot_be_read_registers_nothing(tmp_path: Path):
    path = chain.small_video(tmp_path, "a")
    table = Swing().own()
    table[["acc_x", "acc_y", "acc_z"]] /= 9.81
    told = pbl("ingest", path, "--subject", "P001", "--imu", f"shank_r={Swing().write(tmp_path / 'g.csv', table)}")
    assert (told.code, told.error_code) == (1, "SENSOR_LOG")
    assert len(video.Video()) == 0


def test_the_lens_of_the_file_and_slow_motion(tmp_path: Path):
    path = chain.small_video(tmp_path, "walk")
    tags = {"com.apple.quicktime.model": "iPhone 13", "com.android.capture.fps": 240.0}
    insert(path, of_track=meta({"com.apple.quicktime.camera.focal_length.35mm_equivalent": 27}), of_file=meta(tags))
    register(path)
    assert not errors(populate())
    info = video.VideoInfo.fetch1()
    assert (info["phone_model"], info["focal_35mm"], info["capture_fps"]) == ("iPhone 13", 27.0, 240.0)
    row = keypoints.Keypoints.fetch1()
    assert row["camera_source"].startswith("metadata: 27 mm on 35 mm film")
    assert row["focal_rel_sd"] == pytest.approx(0.03)
    assert stored_keypoints().camera.focal_rel_sd == pytest.approx(0.03)
    assert "intrinsics of the keypoints: 1 metadata" in pbl("status").out
    found = load_visit({"subject": "P001"}).recordings[0].video
    assert found is not None
    assert (found.focal_35mm, found.capture_fps) == (27.0, 240.0)
    # Every duration is eight times too long: nobody may take the visit's measures for good.
    assert "time_stretch" in {r["keypoints_check"] for r in keypoints.Keypoints.Check.to_dicts()}
    assert qc.SessionQc.fetch1("qc_outcome") == "FAIL"
    assert "time_stretch" in qc.SessionQc.fetch1("qc_worst")


def test_the_uncertainty_of_a_calibration_is_stored(tmp_path: Path):
    path = chain.small_video(tmp_path, "walk")
    camera = chain.camera_file(tmp_path, focal_sd_px=4.5)
    ingest([path], VisitRecord("P001", camera_file=camera))
    assert lab.CameraCalibration.fetch1("camera_focal_sd") == pytest.approx(4.5)
    populate(SEEN)
    row = keypoints.Keypoints.fetch1()
    assert row["focal_rel_sd"] == pytest.approx(0.005)
    assert row["camera_source"].startswith("measured: camera.json")
    # The same file again is the same calibration.
    assert outcomes(ingest([path], VisitRecord("P001", camera_file=camera))) == ["known"]
    assert len(lab.CameraCalibration()) == 1


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), "STORE_FULL"),
        (OSError(errno.EIO, "Input/output error"), "STORE_UNAVAILABLE"),
        (PermissionError(errno.EACCES, "Permission denied", "in the store"), "STORE_UNAVAILABLE"),
        (FileNotFoundError(errno.ENOENT, "No such file", "/tmp/shank.csv"), "FILE_MISSING"),
        (FileNotFoundError(errno.ENOENT, "No such file", "shank.csv"), "FILE_MISSING"),
        (OSError(errno.EMFILE, "Too many open files", "shank.csv"), "MACHINE_SHORT"),
        (OSError(errno.EBADF, "Bad file descriptor", 7), "STORE_UNAVAILABLE"),
        (type("EndpointConnectionError", (Exception,), {"__module__": "botocore.exceptions"})(), "STORE_UNAVAILABLE"),
    ],
)
def test_a_store_that_takes_no_copy_is_named(tmp_path: Path, faults: Faults, error: Exception, code: str):
    """Of one that registers and of one that adds to a video; the other recordings are registered."""
    if isinstance(error, PermissionError):
        error.filename = str(settings.store_dir() / "pbl_video")
    one, two = (chain.small_video(tmp_path, name) for name in ("a", "b"))
    given = f"shank_r={worn_sensor.xsens(Swing(), tmp_path / 'MT_1-000_00B42D4B.txt')}"
    with faults(StorageBackend, "put_buffer", error):
        told = pbl("ingest", one, two, "--subject", "P001", "--imu", given)
    assert (told.code, told.error_code) == (1, code)
    assert [str(name) for name in video.Video.to_arrays("video_name")] == ["b.mp4"]
    with faults(StorageBackend, "put_buffer", error):
        assert pbl("ingest", two, "--subject", "P001", "--imu", given).error_code == code
    assert len(video.WearableImu()) == 0
    assert "was attached" in pbl("ingest", two, "--subject", "P001", "--imu", given).out


def test_names_that_are_not_utf8_have_a_code(tmp_path: Path):
    path, odd = chain.small_video(tmp_path, "a"), os.fsdecode(b"odd\xff")
    depth = chain.depth_pictures(tmp_path / "depth")
    (depth / "3.png").rename(depth / f"3{odd}.png")
    shank = Swing().write(tmp_path / f"{odd}.csv")
    log = sensor_logger(tmp_path / "log", 12.0)
    (log / f"{odd}.csv").write_text("")
    for option, given, code in (
        ("--depth", f"0.001={depth}", "FILE_FORMAT"),
        ("--attitude", log, "FILE_FORMAT"),
        ("--imu", f"shank_r={shank}", "USAGE"),
    ):
        told = pbl("ingest", path, "--subject", "P001", option, given)
        assert (told.code, told.error_code) == (1, code)
        assert "\\udcff" in told.err
    assert len(video.Video()) == 0
