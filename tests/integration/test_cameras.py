"""A calibration registered once for a phone's lens serves its videos, and a change makes exactly those pending."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_schemas import fit, keypoints, lab, video
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers.populate import populate
from tests.command import pbl
from tests.integration import chain
from tests.integration.test_tables import errors
from tests.quicktime import insert, meta
from tests.rows import outcomes, register
from tests.videos import constant_rate, numbered_frames, write_video

pytestmark = pytest.mark.usefixtures("tables")

SEEN = ["VideoInfo", "Tracking", "SubjectChoice", "Keypoints"]
APPLE = {"com.apple.quicktime.make": "Apple", "com.apple.quicktime.model": "iPhone 13"}
PIXEL = {"com.android.manufacturer": "Google", "com.android.model": "Pixel 8"}
LENS = "com.apple.quicktime.camera.lens_model"
FILM = "com.apple.quicktime.camera.focal_length.35mm_equivalent"


def recording(folder: Path, name: str, tags: dict, of_track: dict | None = None) -> Path:
    """A landscape video of 128x72 px, 30 frames a second."""
    return insert(chain.small_video(folder, name), of_track=meta(of_track or {}), of_file=meta(tags))


def upright(folder: Path, name: str, tags: dict) -> Path:
    """The same phone held upright: 72x128 px, stored as 128x72 with a flag of 90 deg."""
    path = write_video(folder / f"{name}.mov", numbered_frames(240, 128, 72), constant_rate(240), rotation_deg=90)
    return insert(path, of_file=meta(tags))


def calibration(path: Path, focal: float = 100.0, **phone) -> Path:
    """A camera file as `pbl calibrate` writes it from a landscape video."""
    fields = {
        "camera_matrix": [[focal, 0, 60], [0, focal + 1, 34], [0, 0, 1]],
        "distortion": [0.01, 0, 0.002, 0.001, 0],
        "image_size_px": [128, 72],
        "focal_sd_px": 0.5,
        "video": {"rotation_deg": 0},
        "phone": {"make": "Apple", "model": "iPhone 13", "lens": None, "focal_35mm": None, "rate": 30, **phone},
    }
    path.write_text(json.dumps(fields))
    return path


def by_video(column: str) -> dict[int, Any]:
    return {r["video_id"]: r[column] for r in keypoints.Keypoints.proj(column).to_dicts()}


def sources() -> dict[int, str]:
    """First word of the camera's source by video."""
    return by_video("camera_kind")


def matrix_of(video_id: int) -> np.ndarray:
    ref = file_ref((keypoints.Keypoints & {"video_id": video_id}).fetch1("keypoints_file"))
    with stored_file(ref) as path, np.load(path) as found:
        return found["camera_matrix"]


def added(file: Path, *more: object) -> str:
    done = pbl("camera", "add", file, *more)
    assert done.code == 0, done.err
    return done.out


@pytest.mark.long
def test_a_phone_is_registered_once(tmp_path: Path):
    apple = recording(tmp_path, "apple", APPLE)
    stands = upright(tmp_path, "stands", APPLE)
    ultra = recording(tmp_path, "ultra", APPLE, {LENS: "iPhone 13 back ultra wide camera 1.54mm f/2.4"})
    pixel = recording(tmp_path, "pixel", PIXEL)
    # Four visits, so that one video's change leaves the others' fits alone.
    ids = [register(path, session_label=path.stem)[0] for path in (apple, stands, ultra, pixel)]
    own = calibration(tmp_path / "own.json", 90.0)
    ids += register(recording(tmp_path, "own", APPLE), session_label="own", camera_file=own)
    assert not errors(populate())
    assert sources() == dict(zip(ids, ["preset", "preset", "guess", "guess", "measured"], strict=True))
    before = by_video("keypoints_computed")
    fits = len(fit.SessionFit())

    said = added(calibration(tmp_path / "camera.json"))
    assert "apple-iphone-13 has calibration 2 now" in said
    assert "deleted 2 rows of" in said
    assert set(sources()) == set(ids[2:])
    assert len(fit.SessionFit()) == fits - 2
    assert not errors(populate())
    assert sources() == dict(zip(ids, ["measured", "measured", "guess", "guess", "measured"], strict=True))
    row = (keypoints.Keypoints & {"video_id": ids[0]}).fetch1()
    assert row["camera_source"].startswith("measured: camera.json")
    assert row["camera_source"].endswith(", of apple-iphone-13")
    assert (row["keypoints_camera_id"], row["focal_rel_sd"]) == (2, pytest.approx(0.5 / 100.5))
    # The stand-in detector's picture has 1920 x 1080 px, and the lens at the same place of it.
    np.testing.assert_allclose(matrix_of(ids[0]), [[100, 0, 60 * 1920 / 128], [0, 101, 34 * 1080 / 72], [0, 0, 1]])
    # Turned clockwise: x is what was counted from below, y what was counted from the left.
    turned = [[101, 0, (71 - 34) * 1920 / 72], [0, 100, 60 * 1080 / 128], [0, 0, 1]]
    np.testing.assert_allclose(matrix_of(ids[1]), turned)
    after = by_video("keypoints_computed")
    assert [after[i] == before[i] for i in ids[2:]] == [True] * 3

    # The same again changes nothing; a corrected one takes its place, and the same videos are computed again.
    assert "deleted" not in added(tmp_path / "camera.json")
    assert "in the place of 2" in added(calibration(tmp_path / "camera.json", 110.0))
    assert set(sources()) == set(ids[2:])
    assert not errors(populate(SEEN))
    assert matrix_of(ids[0])[0, 0] == pytest.approx(110)
    listed = pbl("camera", "list").out
    assert "apple-iphone-13: Apple iPhone 13, 128x72 px as stored, about 30 frames a second" in listed
    assert "focal length 110.5 px +- 0.5" in listed
    assert "keypoints made with it: 2" in listed
    # A video that is recorded later has it at once.
    ids += register(recording(tmp_path, "later", APPLE), session_label="later")
    populate(SEEN)
    assert sources()[ids[-1]] == "measured"

    assert "apple-iphone-13 has no calibration now" in pbl("camera", "remove", 3).out
    assert set(sources()) == set(ids[2:5])
    populate(SEEN)
    assert sources()[ids[0]] == "preset"
    assert pbl("camera", "remove", 3).error_code == "DB_NOT_FOUND"
    assert "no calibration of a phone" in pbl("camera", "list").out
    # The calibration of a person's own video is hers, the phone's is not.
    assert len(lab.CameraCalibration()) == 3


def test_another_rate_zoom_or_size_is_another_view(tmp_path: Path):
    plain = recording(tmp_path, "plain", APPLE, {FILM: 27})
    zoomed = recording(tmp_path, "zoomed", APPLE, {FILM: 54})
    fast = write_video(tmp_path / "fast.mov", numbered_frames(480, 72, 128), constant_rate(480, 60))
    small = write_video(tmp_path / "small.mov", numbered_frames(240, 36, 64), constant_rate(240))
    ids = register(plain, zoomed, insert(fast, of_file=meta(APPLE)), insert(small, of_file=meta(APPLE)))
    added(calibration(tmp_path / "camera.json", focal_35mm=27.0))
    populate(SEEN)
    assert sources() == dict(zip(ids, ["measured", "metadata", "preset", "preset"], strict=True))
    # A file that names no phone, with a recording that does; the zoomed one's is registered in the place of the other.
    fields = json.loads((tmp_path / "camera.json").read_text())
    (tmp_path / "plain.json").write_text(json.dumps({k: v for k, v in fields.items() if k not in ("phone", "video")}))
    assert pbl("camera", "add", tmp_path / "plain.json").error_code == "CAMERA_INVALID"
    added(tmp_path / "plain.json", "--like", zoomed)
    assert set(sources()) == set(ids[2:])
    populate(SEEN)
    assert sources() == dict(zip(ids, ["metadata", "measured", "preset", "preset"], strict=True))
    added(tmp_path / "plain.json", "--like", fast)
    populate(SEEN)
    assert sources()[ids[2]] == "measured"
    assert len(lab.DeviceCalibration()) == 2
    assert len(lab.Device()) == 1


def test_a_calibration_of_another_phone_is_refused(tmp_path: Path):
    path, file = recording(tmp_path, "pixel", PIXEL), calibration(tmp_path / "camera.json")
    assert outcomes(ingest([path], VisitRecord("P001", camera_file=file))) == ["CAMERA_INVALID"]
    assert not video.Video()


def test_a_phones_calibration_outlives_a_person_whose_video_has_it(tmp_path: Path):
    file = calibration(tmp_path / "camera.json")
    register(recording(tmp_path, "apple", APPLE), camera_file=file)
    added(file)
    assert len(lab.CameraCalibration()) == 1
    done = pbl("forget", "P001", "--yes")
    assert done.code == 0, done.err
    assert not video.Video()
    assert len(lab.DeviceCalibration()) == 1


def test_devices_of_one_short_name(tmp_path: Path):
    for model in ("Pixel 8", "Pixel-8"):
        added(calibration(tmp_path / "camera.json", make="Google", model=model))
    assert sorted(lab.Device.to_arrays("device")) == ["google-pixel-8", "google-pixel-8-2"]
    assert video.Video.to_dicts() == []
