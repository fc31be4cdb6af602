"""From the link of a visit to its index: a Chromium films the demo recording, with orientations as sensors. Minutes,
and two idle cores: a loaded machine loses frames. `pytest -m machine tests/end_to_end/test_phone.py`."""

import json
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation, Slerp

import pbl_schemas
from pbl_pipeline.video import PhoneLog, camera_in_device, probe, read_frames, read_phone_log
from pbl_schemas import fit, gdi, session, video
from pbl_schemas.capture import PhoneRecording
from pbl_schemas.intake import Sensors, VisitRecord, ingest
from pbl_schemas.intake.calibrations import add_calibration
from pbl_schemas.reading.objects import load_keypoints, load_trial_fit
from pbl_workers.populate import populate
from tests.inputs import LEVEL
from tests.integration.test_web_phone import new_visit
from tests.integration.test_web_phone_browser import arrived, filming, turn, with_camera
from tests.phone_film import device_quat, hand
from tests.rows import remove_all
from tests.videos import constant_rate, write_video

pytestmark = [pytest.mark.slow, pytest.mark.machine]
FPS = 30
#: Frames in which the first picture stands still before the walk, and the last one after it.
BEFORE, AFTER = 120, 60
#: The number of a picture stands in its upper left corner: bits, and the side of the square of each (px).
BITS, SQUARE = 10, 24
#: Pixels of the demo recording's focal length (`Calib_demo.toml` beside it), and of the window that turns over it.
FOCAL, WINDOW = 2520.0, (1120, 994)
#: In the page: number of the picture that the camera shows, and the page's time (ms) at which it was captured.
SHOWN = """
() => new Promise((known) => {
  const video = document.querySelector("video");
  const c = Object.assign(document.createElement("canvas"), {width: 240, height: 24});
  const context = c.getContext("2d", {willReadFrequently: true});
  const read = (now, about) => {
    context.drawImage(video, 0, 0, 240, 24, 0, 0, 240, 24);
    const bits = Array.from({length: 10}, (_, i) => context.getImageData(24 * i + 12, 12, 1, 1).data[1] > 127);
    globalThis.shown = [bits.reduce((sum, bit, i) => sum + bit * 2 ** i, 0), about.captureTime ?? now];
    known();
    setTimeout(() => video.requestVideoFrameCallback(read), 500);
  };
  video.requestVideoFrameCallback(read);
})
"""


class Walked(NamedTuple):
    """A walk that the page filmed. times_s: of its frames, as the camera delivered them; pictures: their numbers; file:
    the same clip as a file."""

    visit: int
    path: Path
    file: Path
    times_s: np.ndarray
    pictures: np.ndarray


def walk(demo: Path) -> Iterator[np.ndarray]:
    last = None
    for frame in read_frames(demo):
        for _ in range(1 + BEFORE * (last is None)):
            yield frame.image
        last = frame.image
    for _ in range(AFTER):
        assert last is not None
        yield last


def numbered(pictures: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    for n, picture in enumerate(pictures):
        marked = np.array(picture)
        for bit in range(BITS):
            marked[:SQUARE, SQUARE * bit : SQUARE * (bit + 1)] = 255 * (n >> bit & 1)
        yield marked


def numbers_in(path: Path) -> np.ndarray:
    at = SQUARE // 2 + SQUARE * np.arange(BITS)
    return np.array(
        [int((frame.image[SQUARE // 2, at, 1] > 127) @ (1 << np.arange(BITS))) for frame in read_frames(path)]
    )


def held(number: ArrayLike) -> Rotation:
    """R_nc of a camera that a hand turns after her from right to left, at the moments of pictures."""
    number = np.asarray(number, float)
    to_left = np.clip((number - BEFORE - 30) / 180, 0, 1)
    return hand(number / FPS, deg=0.5) * Rotation.from_euler("y", 7 * np.cos(np.pi * to_left)[:, None], degrees=True)


def seen(pictures: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """Return what that camera sees of pictures that a level one took."""
    level = Rotation.from_quat(LEVEL, scalar_first=True)
    for n, picture in enumerate(pictures):
        wide, own = (camera_matrix(*size) for size in (picture.shape[1::-1], WINDOW))
        turned = wide @ (level.inv() * held([n])[0]).as_matrix() @ np.linalg.inv(own)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        yield cv2.warpPerspective(picture, turned, WINDOW, flags=flags, borderMode=cv2.BORDER_REPLICATE)


def camera_matrix(width: int, height: int) -> np.ndarray:
    return np.array([[FOCAL, 0, width / 2 - 0.5], [0, FOCAL, height / 2 - 0.5], [0, 0, 1]])


def film(page: Any, n: int) -> np.ndarray:
    """Film until shortly before the last of `n` pictures, with the orientation in which each was taken; the times (s)
    at which the camera delivered the frames."""
    page.locator(".said", has_text="Ready").wait_for()
    page.evaluate(SHOWN)

    def turn_until(number: float) -> None:
        shown = 0.0
        while shown < number:
            (last, at_ms), now_ms = page.evaluate("() => [shown, performance.now()]")
            shown = last + (now_ms - at_ms) * FPS / 1000
            turn(page, tuple(device_quat(held([shown]))[0]))
            page.wait_for_timeout(15)

    turn_until(60)
    page.locator(".record").click()
    turn_until(n - 30)
    page.locator(".record").click()
    page.wait_for_selector(".after:not([hidden])")
    times_s = np.array(json.loads(page.locator("main").get_attribute("data-times")), float) / 1e6
    page.locator(".keep").click()
    arrived(page, seconds=180)
    return times_s - times_s[0]


@pytest.fixture(scope="module")
def walked(
    database: Path, chromium: Any, demo_files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Walked]:
    pbl_schemas.activate()
    remove_all()
    yield take(chromium, demo_files["demo_video"], tmp_path_factory.mktemp("walked"))
    remove_all()


def take(chromium: Any, demo: Path, folder: Path) -> Walked:
    """The walk, filmed by the page and as a file with the log of an ideal phone, each computed as a visit."""
    clip = list(numbered(seen(walk(demo))))
    with pytest.MonkeyPatch.context() as patch, with_camera(chromium, folder / "walk.mjpeg", clip) as browser:
        patch.setenv("PBL_ARCHIVE", str(folder / "archive"))
        visit = new_visit("2026-01-10")
        with filming(browser, visit) as page:
            times_s = film(page, len(clip))
        path = Path((video.Video & {"session_id": visit}).fetch1("video_path"))
        camera = {"camera_matrix": camera_matrix(*WINDOW).tolist(), "distortion": [0] * 5, "image_size_px": WINDOW}
        (folder / "camera.json").write_text(json.dumps(camera))
        add_calibration(folder / "camera.json", like=path)  # of this phone, as its recordings name it
        pictures = numbers_in(path)
        shown = clip[pictures[0] : pictures[-1] + 1]
        file = write_video(folder / "walk.mp4", shown, constant_rate(len(shown)))
        log_s = np.arange(-0.5, len(shown) / FPS + 0.5, 0.01)
        quat = device_quat(held(pictures[0] + FPS * log_s))
        log: dict[str, Any] = {"frame": "device", "clock": "pictures"}
        log |= {"orientation": dict(zip(("qw", "qx", "qy", "qz"), quat.T.tolist(), strict=True))}
        log["orientation"]["time_s"] = log_s.tolist()
        (folder / "log.json").write_text(json.dumps(log))
        other = VisitRecord("P001", "2026-02-01", camera_file=folder / "camera.json")
        ingest([file], other, files=[Sensors(attitude=folder / "log.json")])
        populate()
        return Walked(visit, path, file, times_s, pictures)


def trial_of(label: str) -> dict[str, Any]:
    visit = (session.Session & {"session_label": label}).proj()
    return (fit.SessionFit.Trial * video.Video.proj("session_id") * gdi.SessionGdi & visit).fetch1()


def offset_s(log: PhoneLog, number: np.ndarray, time_s: np.ndarray) -> float:
    """By how much the log is ahead of the pictures, each of which shows where the camera was."""
    turns = Slerp(log.time_s, Rotation.from_quat(log.quat_wxyz, scalar_first=True) * camera_in_device())
    at = (time_s > 0.2) & (time_s < time_s[-1] - 0.2)
    true, shifts = held(number[at]).inv(), np.arange(-0.1, 0.1, 0.002)
    return float(min(shifts, key=lambda shift: np.sum((turns(time_s[at] + shift) * true).magnitude() ** 2)))


def clocks_s(walked: Walked) -> tuple[float, float]:
    """By how much the page's log is ahead of the pictures, and the error of the fit's clock."""
    (path,) = walked.path.parent.glob("*.json")
    log, trial = read_phone_log(path), trial_of("2026-01-10")
    ahead = offset_s(log, walked.pictures, walked.times_s)
    moved = load_keypoints({"video_id": trial["video_id"]}).phone_time_s
    assert moved is not None
    return ahead, trial["trial_clock_offset"] - ahead - (moved[0] - log.time_s[0])


def test_each_picture_has_the_time_at_which_the_camera_delivered_it(walked: Walked):
    info = probe(walked.path)
    about = PhoneRecording().fetch1("phone_about")
    assert (info.width_px, info.height_px) == WINDOW
    assert info.n_frames == len(walked.times_s) == about["frames"]
    assert np.abs(info.time_s - walked.times_s).max() < 0.002
    # It is that picture: the camera shows 30 of them a second.
    assert np.ptp(walked.times_s - walked.pictures / FPS) < 1.5 / FPS
    # A loaded machine loses frames: then they are counted.
    assert about["frames"] + about["dropped"] == pytest.approx(np.ptp(walked.pictures) + 1, abs=2)


def test_the_pictures_are_those_of_the_file(walked: Walked):
    numbered_frames = enumerate(read_frames(walked.file), walked.pictures[0])
    of_file = (frame.image for n, frame in numbered_frames if n in walked.pictures)
    frames = zip(read_frames(walked.path), of_file, strict=True)
    assert np.mean([cv2.PSNR(np.asarray(frame.image), np.asarray(image)) for frame, image in frames]) > 33  # dB


def test_the_index_of_a_phone_is_that_of_the_same_clip_as_a_file(walked: Walked):
    phone, file = trial_of("2026-01-10"), trial_of("2026-02-01")
    assert phone["trial_orientation"] == file["trial_orientation"] == "measured: phone"
    assert phone["session_gdi"] == pytest.approx(file["session_gdi"], abs=1.0)


def test_the_log_is_on_the_clock_of_the_pictures(walked: Walked):
    assert np.abs(clocks_s(walked)).max() <= 0.01
    # The fit estimates the same offset with an ideal log.
    estimated = [trial_of(label)["trial_clock_offset"] for label in ("2026-01-10", "2026-02-01")]
    assert estimated[0] == pytest.approx(estimated[1], abs=0.01)


def test_the_fit_follows_a_phone_that_is_turned_after_the_person(walked: Walked):
    key = {name: trial_of("2026-01-10")[name] for name in fit.SessionFit.Trial.primary_key}
    true = held(walked.pictures)
    error = Rotation.from_quat(load_trial_fit(key).phone_quat_wxyz, scalar_first=True) * true.inv()
    assert np.rad2deg((true * true[0].inv()).magnitude()).max() > 13
    assert np.rad2deg(error.magnitude()).max() < 1.0
