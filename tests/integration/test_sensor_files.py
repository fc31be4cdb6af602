"""Files that come with a video, in the tables: the phone's log reaches keypoints and fit, the others are kept."""

from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.files import sha256_of
from pbl_pipeline.keypoints import Keypoints
from pbl_schemas import fit, keypoints, lab, load_visit, qc, video
from pbl_schemas.intake import Sensors, VisitRecord, ingest
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers.populate import populate
from tests.command import pbl
from tests.integration import chain
from tests.integration.test_tables import errors
from tests.phone_film import as_zip, film, sensor_logger
from tests.quicktime import insert, meta
from tests.rows import outcomes, register

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


def test_the_log_reaches_keypoints_and_fit(capture, stand_in: chain.StandIn):
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
    told = pbl("ingest", path, "--subject", "P001", "--depth", depth, "--imu", right)
    assert "nothing was inserted" in told.out
    assert video.DepthVideo.fetch1("depth_name") == "depth.mov"
    assert list(video.WearableImu.to_arrays("imu_name", order_by="imu")) == ["left.csv", "right.csv"]
    for number, content in ((1, b"left"), (2, b"right")):
        row = (video.WearableImu & {"imu": number}).fetch1()
        assert row["imu_sha256"] == sha256_of(left if number == 1 else right)
        with stored_file(file_ref(row["imu_file"])) as kept:
            assert kept.read_bytes() == content
    assert pbl("ingest", path, "--subject", "P001", "--imu", empty).error_code == "FILE_FORMAT"
    assert pbl("ingest", path, "--subject", "P001", "--imu", tmp_path / "none").error_code == "FILE_MISSING"


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
