"""The phone's page in a Chromium that takes a film of numbered frames as its camera. Skips where there is none."""

import contextlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from pbl_pipeline import assets
from pbl_pipeline.keypoints.framing import Framing
from pbl_pipeline.video import VideoInfo, probe, read_frames, read_phone_log
from pbl_schemas import connection, video
from pbl_schemas.capture import PhoneRecording
from pbl_schemas.intake import phone_recordings
from pbl_schemas.intake.protocols import ProtocolStep, add_protocol
from pbl_schemas.reading.usable import Usable
from pbl_workers import phone_uploads
from pbl_workers.web import Options, Where, certificates, create_app, phone
from tests import Environment, Limits, StandIn
from tests.integration import web
from tests.integration.compute_target import nothing
from tests.integration.test_web_phone import link_of
from tests.rows import new_visit
from tests.videos import numbered_frames
from tests.worn_sensor import Swing

PHONE = {"viewport": {"width": 390, "height": 844}, "device_scale_factor": 2, "is_mobile": True, "has_touch": True}
#: Quaternions (w, x, y, z) of a phone upright in portrait, and turned by 10 deg about the vertical.
UPRIGHT, TURNED = (0.7071, 0.7071, 0.0, 0.0), (0.7044, 0.7044, 0.0616, 0.0616)
#: In the page: a camera of 640 x 480 that is the element `canvas`.
CANVAS = """
() => {
  const canvas = globalThis.canvas = Object.assign(document.createElement("canvas"), {width: 640, height: 480});
  let n = 0;
  setInterval(() => {
    const c = canvas.getContext("2d");
    c.fillStyle = `rgb(${n++ % 256}, 90, 90)`;
    c.fillRect(0, 0, 640, 640);
  }, 33);
  navigator.mediaDevices.getUserMedia = async () => canvas.captureStream(30);
}
"""


#: In the page: a file that was removed after it was chosen.
GONE = """
() => {
  const slice = Blob.prototype.slice;
  Blob.prototype.slice = function (...at) {
    return this.name === "gone.csv" ? {arrayBuffer: () => Promise.reject()} : slice.apply(this, at);
  };
}
"""
#: In the page: the next three texts of the hint, and when each came (ms).
CUT_WHEN = """
() => new Promise((done) => {
  const found = [];
  new MutationObserver(() => {
    found.push([document.querySelector(".cut").textContent, performance.now()]);
    if (found.length === 3) done(found);
  }).observe(document.querySelector(".cut"), {childList: true});
})
"""


@pytest.fixture(scope="module")
def camera(chromium: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """A Chromium whose camera is a film of 640 x 480."""
    path = tmp_path_factory.mktemp("camera") / "camera.mjpeg"
    with with_camera(chromium, path, numbered_frames(60, 480, 640)) as browser:
        yield browser


@contextlib.contextmanager
def with_camera(chromium: Any, path: Path, frames: Iterable[np.ndarray]) -> Iterator[Any]:
    """A Chromium whose camera shows these frames (BGR) at 30 a second, from the first when it is opened."""
    with av.open(str(path), "w", format="mjpeg") as out:
        stream = out.add_stream("mjpeg", rate=30, options={"qmin": "2", "qmax": "2"})
        stream.pix_fmt = "yuvj420p"
        for frame in frames:
            if not stream.codec_context.is_open:
                stream.height, stream.width = frame.shape[:2]
            planes = av.VideoFrame.from_ndarray(frame, format="bgr24").to_ndarray(format="yuv420p")
            # Of 16 to 235, as Chromium takes them, whatever the JPEG says.
            out.mux(stream.encode(av.VideoFrame.from_ndarray(planes, format="yuvj420p")))
        out.mux(stream.encode(None))
    args = ["--no-sandbox", "--use-fake-ui-for-media-stream", "--use-fake-device-for-media-stream",
            f"--use-file-for-fake-video-capture={path}"]  # fmt: skip
    executable = shutil.which("chromium") or shutil.which("google-chrome")
    browser = getattr(chromium, "browser_type", chromium).launch(executable_path=executable, args=args)
    yield browser
    browser.close()


@pytest.fixture
def visit(tables: None, tmp_path: Path, environment: Environment, limits: Limits) -> int:
    environment(PBL_ARCHIVE=tmp_path / "archive")
    for module in (phone_recordings, phone_uploads, phone):
        limits(module, PART_BYTES=65536)
    return new_visit("2026-01-10")


@contextlib.contextmanager
def filming(
    browser: Any,
    visit: int,
    orientation: bool = True,
    torn: bool = False,
    refused: bool = False,
    denied: bool = False,
    protocol: str = "",
    tls: bool = False,
    script: str = "",
    **context: Any,
) -> Iterator[Any]:
    """The phone's page, opened by the link of the visit. No error of a script; `torn`: but of the network;
    `refused`: but of answers that refuse. script: a function that runs before those of the page."""
    where, scheme = Where(), "https" if tls else "http"
    if tls:
        cert, key = certificates.server_certificate(("127.0.0.1",))
        where = Where(tls_cert=cert, tls_key=key)
        context["ignore_https_errors"] = True  # the authority is not installed here
    with web.running(create_app(Options(target=nothing, secure=tls)), where) as port:
        base = f"{scheme}://127.0.0.1:{port}"
        made = browser.new_context(base_url=base, **{"locale": "en", **PHONE, **context})
        try:
            if not denied:
                made.grant_permissions(["camera", "accelerometer", "gyroscope"], origin=base)
            page, errors = made.new_page(), []
            if script:
                page.add_init_script(f"({script})()")
            page.on("pageerror", lambda error: errors.append(str(error)))
            page.on("console", lambda said: errors.append(said.text) if said.type == "error" else None)
            if orientation:
                sensor(page, "setSensorOverrideEnabled", enabled=True)
                turn(page, UPRIGHT)
            page.goto(f"/phone/open?key={link_of(visit, protocol=protocol)}")
            page.wait_for_selector("main[data-ready]")
            yield page
            # A service worker needs a certificate that the browser trusts.
            known = ("net::ERR",) * torn + ("status of 4",) * refused + ("fetching the script",) * tls
            assert not [e for e in errors if not any(k in e for k in known)]
        finally:
            made.close()


def sensor(page: Any, what: str, **values: Any) -> None:
    if not hasattr(page, "cdp"):
        page.cdp = page.context.new_cdp_session(page)
    page.cdp.send(f"Emulation.{what}", {"type": "relative-orientation", **values})


def turn(page: Any, wxyz: tuple[float, ...]) -> None:
    reading = dict(zip("wxyz", wxyz, strict=True))
    sensor(page, "setSensorOverrideReadings", reading={"quaternion": reading})


def film(page: Any, seconds: float = 3.0) -> None:
    """From the opened page to the end of a take: one tap to begin, one to end."""
    start(page)
    page.wait_for_timeout(1000 * seconds)
    page.locator(".record").click()
    page.wait_for_selector(".after:not([hidden])")


def start(page: Any) -> None:
    page.locator(".record").click()
    page.wait_for_selector("main[data-filming='yes']")


def keep(page: Any) -> None:
    page.locator(".keep").click()
    arrived(page)


def film_of(visit: int) -> VideoInfo:
    """The one recording of the visit."""
    return probe((video.Video & {"session_id": visit}).fetch1("video_path"))


def arrived(page: Any, seconds: float = 30) -> None:
    """The server has one recording."""
    page.wait_for_function(
        "n => [...document.querySelectorAll('.takes li')].filter((e) => /server has/.test(e.textContent)).length === n",
        arg=1,
        timeout=1000 * seconds,
    )


def about_the_recording() -> dict[str, Any]:
    """What the page said of the one recording."""
    about = PhoneRecording().fetch1("phone_about")
    return about if isinstance(about, dict) else json.loads(about)


def test_from_the_link_to_the_recording_in_the_visit(camera: Any, visit: int):
    with filming(camera, visit) as page:
        page.get_by_label("fast").check()
        start(page)
        page.wait_for_timeout(1500)
        before = page.evaluate("performance.now()")
        turn(page, TURNED)
        page.wait_for_timeout(50)
        after = page.evaluate("performance.now()")
        page.wait_for_timeout(1500)
        page.locator(".record").click()
        page.wait_for_selector(".after:not([hidden])")
        times = np.array(json.loads(page.locator("main").get_attribute("data-times")), float) / 1e6
        start_ms = float(page.locator("main").get_attribute("data-start"))
        page.locator("[name=note]").fill("first pass")
        keep(page)
        assert (
            page.evaluate("(async () => (await Array.fromAsync((await navigator.storage.getDirectory()).keys())))()")
            == []
        )
    about = about_the_recording()
    assert about["note"] == "first pass"
    assert about["sensor"] == "RelativeOrientationSensor"
    assert about["dropped"] <= 0.1 * about["frames"], about
    row = (video.Video & {"session_id": visit}).fetch1()
    assert row["camera_motion"] == "handheld"
    assert (video.Pace & row).fetch1("pace") == "fast"
    # Every frame has the time at which the camera delivered it.
    info = probe(row["video_path"])
    assert info.n_frames == len(times) == about["frames"] > 45
    assert (info.width_px, info.height_px) == (640, 480)
    assert (bool(info.make), bool(info.model)) == (True, True)  # by which a calibration of the phone is found
    assert (info.lens or "").endswith("camera.mjpeg")
    assert (info.recorded_utc or "").startswith(f"{datetime.now(UTC):%Y-%m-%d}")
    assert np.abs(info.time_s - (times - times[0])).max() < 0.002
    # The turn stands in the log at its moment of the video's clock.
    (path,) = Path(row["video_path"]).parent.glob("*.json")
    log = read_phone_log(path)
    moved = log.time_s[np.argmax(np.abs(log.quat_wxyz - log.quat_wxyz[0]).max(axis=1) > 0.01)]
    assert (before - start_ms) / 1000 - 0.01 <= moved <= (after - start_ms) / 1000 + 0.01


@pytest.mark.long
def test_at_1080p_hardly_a_frame_is_lost(chromium: Any, tmp_path: Path, visit: int):
    """30 frames a second for 10 s: at most one of a hundred, on two idle cores."""
    camera = with_camera(chromium, tmp_path / "camera.mjpeg", numbered_frames(60, 1080, 1920))
    with camera as browser, filming(browser, visit) as page:
        film(page, 10.0)
        keep(page)
    about = about_the_recording()
    assert about["frames"] > 285, about
    assert about["dropped"] <= 0.01 * about["frames"], about
    info = film_of(visit)
    assert (info.width_px, info.height_px, info.n_frames) == (1920, 1080, about["frames"])


def test_cut_feet_are_said_while_filming(chromium: Any, tmp_path: Path, visit: int, stand_in: StandIn):
    """The woman of the demo, whole and then without feet, in turns of 5 s: within 2 s the page says which."""
    (frame,) = read_frames(assets.fetch("demo_video"), start=110, stop=111)
    x, pictures = 915, []
    for top, bottom in ((430, 980), (430, 830)):
        half = (bottom - top) * 2 // 3
        pictures.append(cv2.resize(frame.image[top:bottom, x - half : x + half], (640, 480)))
    looked = Framing()
    assert [looked.cut_off(p) for p in pictures] == ["", "feet"]
    turns = [p for p in pictures for _ in range(150)]
    stand_in(Framing=lambda: looked)
    with with_camera(chromium, tmp_path / "camera.mjpeg", turns) as browser, filming(browser, visit) as page:
        start(page)
        said = page.evaluate(CUT_WHEN)
        page.locator(".record").click()
        page.wait_for_selector(".after:not([hidden])")
        keep(page)
    assert [text.startswith("The feet are cut off") for text, _ in said] == [True, False, True]
    # Each turn lasts 5 s: a hint that came late in one turn and early in the other is off by more than that.
    assert abs(said[1][1] - said[0][1] - 5000) < 2000
    about = about_the_recording()
    assert about["dropped"] <= 0.1 * about["frames"], about


def test_reloads_in_the_middle_of_an_upload(camera: Any, visit: int):
    with filming(camera, visit, torn=True) as page:
        film(page)
        sent = []

        def tear(route: Any) -> None:
            """One part arrives, then the network is gone."""
            sent.append(route.request.url)
            route.continue_() if len(sent) == 1 else route.abort()

        page.route("**/phone/recordings/*.json", tear)
        page.locator(".keep").click()
        page.wait_for_function("() => document.querySelector('.said').textContent.startsWith('No network')")
        assert len(sent) > 1
        page.unroute("**/phone/recordings/*.json")
        page.reload()
        arrived(page)
    assert len(video.Video() & {"session_id": visit}) == len(PhoneRecording()) == 1
    assert film_of(visit).n_frames > 45


def test_films_without_network_and_sends_when_it_is_back(camera: Any, visit: int):
    with filming(camera, visit, torn=True) as page:
        page.wait_for_function("() => navigator.serviceWorker.ready.then(() => true)")
        page.reload()  # now the service worker serves it
        page.wait_for_selector("main[data-ready]")
        page.context.set_offline(True)
        page.reload()
        page.wait_for_selector("main[data-ready]")
        film(page, 1.5)
        page.locator(".keep").click()
        page.get_by_text("No network").wait_for()
        page.context.set_offline(False)
        arrived(page)
    assert len(video.Video() & {"session_id": visit}) == 1


#: In the page: as if it had been killed between writing the facts of a take and cutting off what they replace.
FACTS_FOLLOWED_BY_OLDER_ONES = """
async () => {
  for await (const [name, file] of (await navigator.storage.getDirectory()).entries()) {
    if (!name.endsWith(".json")) continue;
    const writable = await file.createWritable({keepExistingData: true});
    await writable.seek((await file.getFile()).size);
    await writable.write('"older": 1}}');
    await writable.close();
  }
}
"""


def test_a_take_whose_page_was_killed_is_still_there(camera: Any, visit: int):
    with filming(camera, visit) as page:
        start(page)
        page.wait_for_timeout(4500)
        page.evaluate("window.addEventListener('pagehide', (e) => e.stopImmediatePropagation(), true)")
        page.evaluate(FACTS_FOLLOWED_BY_OLDER_ONES)
        page.reload()
        page.wait_for_selector("main[data-ready]")
        # A slow finger: the page asks the server every 3 s meanwhile, and does not make the button anew.
        page.get_by_role("button", name="Keep and send").last.click(delay=4000)
        arrived(page)
    assert film_of(visit).n_frames > 30


#: Begins a function for the page, with a recording of nine bytes and its facts.
WITH_A_RECORDING = """
async () => {
  const { all, keep, newFile, remove } = await import("/static/capture_takes.js");
  const facts = {name: "take-test", visit: -1, made: 1, about: {}, log: null, complete: false};
  const file = await newFile(facts.name);
  await file.write(0, new Uint8Array(9));
  await file.close();
  await keep(facts);
"""
#: In the page: a recording is listed whenever that is asked for, also while its facts are written.
FACTS_READ_WHILE_WRITTEN = (
    WITH_A_RECORDING
    + """
  let missing = 0;
  for (let n = 0; n < 300; n++) {
    const written = keep({...facts, log: "x".repeat(1e5 * (n % 3))});
    const found = await Promise.all([all(), all()]);
    missing += found.filter((takes) => !takes.some((take) => take.name === facts.name)).length;
    await written;
  }
  await remove(facts.name);
  return missing;
}
"""
)


def test_a_recording_whose_facts_are_read_while_they_are_written_stays(camera: Any, visit: int):
    with filming(camera, visit) as page:
        assert page.evaluate(FACTS_READ_WHILE_WRITTEN) == 0


#: In the page, on a full phone: facts that do not fit are refused, and the recording is listed with those before.
FACTS_THAT_DO_NOT_FIT = (
    WITH_A_RECORDING
    + """
  const refused = await keep({...facts, visit: 7, log: "x".repeat(1e7)}).then(() => "", (error) => error.name);
  const kept = (await all()).filter((take) => take.name === facts.name).map((take) => take.visit);
  await remove(facts.name);
  return [refused, ...kept];
}
"""
)


def test_on_a_full_phone_a_recording_keeps_the_facts_it_had(camera: Any, visit: int):
    with filming(camera, visit) as page:
        origin, cdp = page.evaluate("location.origin"), page.context.new_cdp_session(page)
        cdp.send("Storage.overrideQuotaForOrigin", {"origin": origin, "quotaSize": 1_000_000})
        assert page.evaluate(FACTS_THAT_DO_NOT_FIT) == ["QuotaExceededError", -1]


def test_films_without_sensors_and_says_what_is_lost(camera: Any, visit: int):
    with filming(camera, visit, orientation=False) as page:
        page.get_by_text("does not report its orientation").wait_for()
        film(page, 1.5)
        page.locator(".again").click()
        page.get_by_text("None yet").wait_for()
        film(page, 1.5)
        keep(page)
    assert (video.Video & {"session_id": visit}).fetch1("camera_motion") == "static"
    assert len(video.PhoneAttitude()) == 0
    assert len(PhoneRecording()) == 1


def test_the_page_leads_through_a_protocol(camera: Any, visit: int, monkeypatch: pytest.MonkeyPatch):
    add_protocol("clinic", [ProtocolStep(1, "walking", "fast", "left", 1), ProtocolStep(2, "tug", "", "any", 1)])
    monkeypatch.setattr(phone, "usual_seconds", lambda: 14.0)
    with filming(camera, visit, protocol="clinic") as page:
        pressed = page.locator(".steps [aria-pressed='true']")
        assert pressed.inner_text() == "Walk, fast, from the left side: 0 of 1"
        usual = page.locator(".usual")
        assert usual.is_hidden()
        film(page, 1.5)
        page.locator(".keep").click()
        # It leads on while the server checks, and ticks off what is usable.
        page.locator(".steps [aria-pressed='true']", has_text="TUG").wait_for()
        first = page.locator(".steps button").first
        assert first.inner_text() == "Walk, fast, from the left side: 0 of 1; 1 arrived, being checked"
        film(page, 1.5)
        page.locator(".keep").click()
        page.get_by_text("TUG, from any side: 0 of 1; 1 arrived, being checked").wait_for()
        assert page.locator(".complete").inner_text() == ""
        assert usual.inner_text() == "A check usually takes 15 s."
        activities = ("walking", "tug")

        def judged(videos: list[int]) -> dict[int, Usable]:
            return {v: Usable("usable", activity=a) for v, a in zip(sorted(videos), activities, strict=True)}

        monkeypatch.setattr(phone_recordings, "verdicts", judged)
        with contextlib.closing(connection.plain_connection()) as server, server.cursor() as cursor:
            cursor.execute(f"UPDATE {video.Video.full_table_name} SET video_name = CONCAT(video_name, '.mp4')")
            server.commit()
        page.get_by_text("complete by its protocol").wait_for()
        assert first.inner_text().startswith("\u2713")
        assert usual.is_hidden()
    assert list((video.Video & {"session_id": visit}).to_arrays("activity", order_by="video_id")) == ["walking", "tug"]
    assert list(video.Pace().to_arrays("pace")) == ["fast"]


def test_sensors_on_takes_their_log_after_filming(camera: Any, visit: int, tmp_path: Path):
    shank, none = Swing().write(tmp_path / "shank.csv"), tmp_path / "none.csv"
    none.write_text("frame,x\n1,2\n")
    with filming(camera, visit, refused=True) as page:
        log = page.get_by_label("Log of the sensors")
        assert log.is_hidden()
        page.get_by_label("Sensors on").check()
        for file, said in ((none, "no known format"), (shank, "which segment")):
            log.set_input_files(file)
            page.locator(".worn li", has_text=said).wait_for()
        page.get_by_label("Worn on").select_option("shank_r")
        log.set_input_files(shank)
        page.locator(".worn li", has_text="without a recording").wait_for()
        film(page, 1.0)
        keep(page)
        missing = page.get_by_text("none of their logs has arrived")
        missing.wait_for()
        assert phone_recordings.filming(visit)["log_missing"]
        log.set_input_files(shank)
        page.locator(".worn li", has_text="right shank").wait_for()
        missing.wait_for(state="detached")
        page.get_by_label("Worn on").select_option("")
        thigh = Swing(phase=1).write(tmp_path / "left thigh.csv")
        gone = shutil.copy(shank, tmp_path / "gone.csv")
        page.evaluate(GONE)
        log.set_input_files([none, thigh, gone])
        for named in ("none.csv", "\u2713", "gone.csv This device cannot read"):
            page.locator(".worn li", has_text=named).first.wait_for()
    assert not phone_recordings.filming(visit)["log_missing"]
    rows = {row["imu_name"]: row["imu_segments"] for row in video.WearableImu.to_dicts()}
    assert rows == {"shank.csv": {"shank_r": "shank"}, "left thigh.csv": {"thigh_l": "left thigh"}}
    assert about_the_recording()["worn"] == "on"


def test_films_over_tls_with_cookies_of_this_host(camera: Any, visit: int):
    with filming(camera, visit, tls=True) as page:
        (cookie,) = (c for c in page.context.cookies() if "pbl_phone" in c["name"])
        assert (cookie["name"], cookie["secure"], cookie["httpOnly"]) == ("__Host-pbl_phone", True, True)
        film(page, 1.5)
        keep(page)
        answer = page.request.get("/phone/authority.crt")
        assert answer.body() == certificates.authority().read_bytes()
    assert len(video.Video() & {"session_id": visit}) == 1


def test_a_call_and_a_turned_phone_end_a_take(camera: Any, visit: int):
    with filming(camera, visit, script=CANVAS) as page:  # a camera whose picture can be turned
        for why, act in (
            ("interrupted", "() => { Object.defineProperty(document, 'hidden', {get: () => true, configurable: true});"
                            " document.dispatchEvent(new Event('visibilitychange')); delete document.hidden; }"),
            ("turned", "() => { canvas.width = 480; canvas.height = 640; }"),
        ):  # fmt: skip
            start(page)
            page.wait_for_timeout(1200)
            page.evaluate(act)
            page.locator(".said", has_text=why).wait_for()
            page.locator(".keep" if why == "interrupted" else ".again").click()
        arrived(page)
    assert len(video.Video() & {"session_id": visit}) == 1


#: In the page: `jump_us` is added to the times of the camera's frames.
JUMPING = """
() => {
  globalThis.jump_us = 0;
  const Processor = MediaStreamTrackProcessor;
  globalThis.MediaStreamTrackProcessor = class {
    constructor(about) {
      this.readable = new Processor(about).readable.pipeThrough(new TransformStream({
        transform: (frame, out) => {
          out.enqueue(new VideoFrame(frame, {timestamp: frame.timestamp + jump_us}));
          frame.close();
        },
      }));
    }
  };
}
"""


@pytest.mark.parametrize("jump_s", [5.0, -5.0])
def test_times_that_jump_end_a_take_which_is_good_up_to_there(camera: Any, visit: int, jump_s: float):
    with filming(camera, visit) as page:
        page.evaluate(JUMPING)
        start(page)
        page.wait_for_timeout(2000)
        page.evaluate("us => { jump_us = us; }", 1e6 * jump_s)
        page.locator(".said", has_text="jumped").wait_for()
        keep(page)
    info = film_of(visit)
    assert np.diff(info.time_s).max() < 2.0
    assert info.n_frames > 10


def test_a_full_phone_says_so_before_a_take_and_keeps_what_it_has_during_one(camera: Any, visit: int):
    with filming(camera, visit) as page:
        page.locator(".said", has_text="Ready").wait_for()
        page.evaluate(
            "() => { globalThis.estimate = navigator.storage.estimate.bind(navigator.storage);"
            " navigator.storage.estimate = async () => ({quota: 1e9, usage: 9e8}); }"
        )
        page.locator(".record").click()
        page.locator(".said", has_text="no room").wait_for()
        assert page.locator("main").get_attribute("data-filming") != "yes"
        page.evaluate("() => { navigator.storage.estimate = estimate; }")
        start(page)
        page.wait_for_timeout(3000)
        (writer,) = page.workers
        writer.evaluate(
            "() => { const written = FileSystemSyncAccessHandle.prototype.write;"
            " FileSystemSyncAccessHandle.prototype.write = function (...more) {"
            " if (globalThis.isFull) throw new DOMException('', 'QuotaExceededError');"
            " return written.apply(this, more); }; globalThis.isFull = true; }"
        )
        page.locator(".said", has_text="no room").wait_for()
        page.locator(".after .keep").click()
        again = page.locator(".takes button", has_text="Keep")
        again.wait_for()
        assert "no room" in (page.locator(".said").text_content() or "")
        writer.evaluate("() => { globalThis.isFull = false; }")  # there is room again, and what was filmed is sent
        again.click()
        arrived(page)
    assert film_of(visit).n_frames > 10


#: In the page: the person does not allow the camera; a phone that asks for its sensors within a tap, as iOS does.
REFUSING = """
() => { navigator.mediaDevices.getUserMedia = async () => { throw new DOMException("", "NotAllowedError"); }; }
"""
ASKING = """
() => {
  delete globalThis.RelativeOrientationSensor;
  DeviceOrientationEvent.requestPermission = async () => "granted";
}
"""


#: In the page: what it says aloud and how long it vibrates.
CUES = """() => {
  window.cues = [];
  navigator.vibrate = (ms) => { window.cues.push(ms); return true; };
  speechSynthesis.speak = (said) => window.cues.push(`${said.lang} ${said.text}`);
}"""


@pytest.mark.parametrize(("language", "go", "end"), [("en", "en Go", "en Stop"), ("de", "de Los", "de Stopp")])
def test_filming_starts_after_a_countdown_with_cues_that_are_heard_and_felt(
    camera: Any, visit: int, language: str, go: str, end: str
):
    with filming(camera, visit, script=CUES, locale=language) as page:
        page.locator(".record").click()
        page.wait_for_selector("main[data-filming='soon']")
        page.locator(".record").click()  # another tap ends it
        page.wait_for_timeout(2300)
        assert page.locator("main").get_attribute("data-filming") == "no"
        page.evaluate("cues.length = 0")
        began = page.evaluate("performance.now()")
        page.locator(".record").click()
        page.wait_for_selector("main[data-filming='yes']")
        assert page.evaluate("performance.now()") - began >= 1900
        page.wait_for_timeout(800)
        page.locator(".record").click()
        page.wait_for_selector(".after:not([hidden])")
        two, one = (f"{language} {n}" for n in (2, 1))
        assert page.evaluate("cues") == [60, two, 60, one, 200, go, 400, end]


def test_says_what_to_do_where_there_is_no_camera(chromium: Any, camera: Any, visit: int):
    with filming(chromium, visit, denied=True) as page:  # has none
        page.locator(".said", has_text="camera").wait_for()
    with filming(camera, visit, denied=True, script=REFUSING) as page:
        page.locator(".said", has_text="Permissions").wait_for()
        page.locator(".allow").click()
        page.locator(".said", has_text="Permissions").wait_for()


def test_without_an_encoder_the_browsers_recorder_films(camera: Any, visit: int):
    with filming(camera, visit) as page:
        page.evaluate("delete globalThis.VideoEncoder")
        film(page)
        page.locator(".said", has_text="less exact").wait_for()
        keep(page)
    assert film_of(visit).n_frames > 30


def test_frames_of_the_shown_video_count_by_their_capture_and_not_by_when_they_are_shown(camera: Any, visit: int):
    """A browser that hands out no frames of the track."""
    with filming(camera, visit, script="() => { delete globalThis.MediaStreamTrackProcessor; }") as page:
        film(page)
        times_us = json.loads(page.locator("main").get_attribute("data-times"))
        assert len(times_us) > 10
        assert float(page.locator("main").get_attribute("data-start")) == pytest.approx(times_us[0] / 1000, abs=0.01)


#: In the page: a camera that delivers a frame, by which the encoder is chosen, and one more.
ONE_FRAME = """
() => {
  const Processor = MediaStreamTrackProcessor;
  globalThis.MediaStreamTrackProcessor = class {
    constructor(about) {
      let n = 0;
      this.readable = new Processor(about).readable.pipeThrough(new TransformStream({
        transform: (frame, out) => { if (n++ < 2) out.enqueue(frame); else frame.close(); },
      }));
    }
  };
}
"""


def test_a_recording_of_one_frame_arrives(camera: Any, visit: int):
    with filming(camera, visit) as page:
        page.evaluate(ONE_FRAME)
        film(page, 1.0)
        keep(page)
    assert about_the_recording()["frames"] == 1
    assert film_of(visit).n_frames == 1


def test_the_longest_take_ends_by_itself_and_is_kept(camera: Any, visit: int):
    with filming(camera, visit) as page:
        assert page.locator("main").get_attribute("data-most") == "600"
        page.evaluate("() => { document.querySelector('main').dataset.most = '2'; }")
        page.locator(".record").click()
        page.locator(".said", has_text="Ten minutes").wait_for()
        keep(page)
    assert 2 <= film_of(visit).time_s[-1] < 5


def test_the_first_load_is_small(camera: Any, visit: int):
    with filming(camera, visit) as page:
        sizes = page.evaluate("() => performance.getEntries().map((e) => [e.name, e.transferSize ?? 0])")
    assert any("mediabunny" in name and size for name, size in sizes)
    assert sum(size for _, size in sizes) < 300_000, sizes


#: Widths and heights of phones (CSS px), upright and on their side.
SIZES = [(360, 740), (390, 844), (430, 932), (740, 360), (844, 390), (932, 430)]


def look(page: Any, picture: Path) -> None:
    """At each size nothing sticks out, the button of this step is in view, and axe finds nothing serious."""
    from axe_playwright_python.sync_playwright import Axe

    for width, height in SIZES:
        page.set_viewport_size({"width": width, "height": height})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        page.evaluate("scrollTo(0, 0)")
        for button in page.locator(":is(.film, .after) button:visible").all():
            box = button.bounding_box()
            assert box["height"] >= 44, (picture, width)
            assert box["y"] + box["height"] <= height, (picture, width)
        page.screenshot(path=picture.with_name(f"{picture.name}-{width}.png"), full_page=True)
    found = Axe().run(page).response["violations"]
    assert not [v["id"] for v in found if v["impact"] in ("serious", "critical")], found


@pytest.mark.parametrize(("scheme", "language"), [("light", "en"), ("dark", "de")])
def test_nothing_keeps_anybody_from_the_page(camera: Any, visit: int, scheme: str, language: str, tmp_path: Path):
    folder = Path(os.environ.get("PBL_PICTURES") or tmp_path)
    with filming(camera, visit, torn=True, script=ASKING, color_scheme=scheme, locale=language) as page:
        look(page, folder / f"phone-{scheme}-opened")
        page.locator(".allow").click()
        page.wait_for_function("() => document.querySelector('main').style.getPropertyValue('--shape')")
        look(page, folder / f"phone-{scheme}-ready")
        # The frame for the person lies in the picture: its box has the picture's shape.
        box = page.locator(".view").bounding_box()
        assert box["width"] / box["height"] == pytest.approx(640 / 480, rel=0.01)
        start(page)
        look(page, folder / f"phone-{scheme}-filming")
        page.locator(".record").click()
        page.wait_for_selector(".after:not([hidden])")
        look(page, folder / f"phone-{scheme}-after")
        page.context.set_offline(True)
        page.locator(".keep").click()
        page.wait_for_function("() => document.querySelector('.latest').textContent")
        look(page, folder / f"phone-{scheme}-waits")
        page.context.set_offline(False)
        page.wait_for_function("() => document.querySelector('.takes b')?.textContent === '1'", timeout=30_000)
        look(page, folder / f"phone-{scheme}-sent")
