"""Filming with a phone: its link, the upload in parts, and what it may not do. Without a browser."""

import contextlib
import dataclasses
import hashlib
import json
import os
import random
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from click.testing import CliRunner
from pymysql.err import OperationalError
from starlette.testclient import TestClient

from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import framing
from pbl_pipeline.qc import Check
from pbl_pipeline.records import to_row
from pbl_pipeline.words import UNUSABLE
from pbl_schemas import gait, keypoints, session, tables_version, video
from pbl_schemas.capture import PhoneLink, PhoneRecording
from pbl_schemas.cli.capture import capture
from pbl_schemas.intake import Sensors, phone_recordings
from pbl_schemas.intake.phone_recordings import MOST_PARTS, PART_BYTES, Sent, phone_of
from pbl_schemas.intake.protocols import ProtocolStep, add_protocol, read_protocol, steps_of
from pbl_schemas.jobs import jobs_of
from pbl_schemas.operations.archive import note_placed
from pbl_schemas.reading import usable as module_usable
from pbl_schemas.reading.usable import Next, Usable, usable, usual_seconds
from pbl_schemas.review import Decision
from pbl_workers import browser_uploads, incoming, phone_uploads, queue
from pbl_workers.cli.cron import cron
from pbl_workers.populate import populate
from pbl_workers.web import Options, Where, create_app, registration
from pbl_workers.web.phone import next_words, usual_words, verdict
from tests import Environment, Faults, Limits, Machine, StandIn, not_none, refused
from tests.integration import web
from tests.integration.chain import computed_once, small_video
from tests.integration.compute_target import nothing
from tests.rows import new_visit, register
from tests.worn_sensor import Swing

Killed = Callable[[], AbstractContextManager[None]]


@pytest.fixture
def visit(tables: None, tmp_path: Path, environment: Environment, limits: Limits) -> int:
    """A visit without recordings; the archive is a folder of the test, and its parts are small."""
    environment(PBL_ARCHIVE=tmp_path / "archive")
    for module in (phone_recordings, phone_uploads):
        limits(module, PART_BYTES=4096)
    return new_visit("2026-01-10")


@computed_once
def walks(folder: Path) -> dict[str, int]:
    """A computed walk for each activity that was stated of it, a visit each; its video_id."""
    stated = ("walking", "tug", "sit_to_stand", "squat", "stairs", "standing", "fsst")
    numbers = {
        activity: register(small_video(folder, activity), session_label=activity, activity=activity)[0]
        for activity in stated
    }
    populate()
    return numbers


def stranger() -> TestClient:
    return web.client(signed_in=False, target=nothing)


def link_of(visit: int, **fields: object) -> str:
    """The key of a new link, as the page of the visit makes it."""
    answer = web.post(web.client(target=nothing), f"/visits/{visit}/film", **{"hours": 2, **fields})
    assert answer.status_code == 200, answer.text
    found = re.search(r"/phone/open\?key=([\w-]+)", answer.text)
    assert found
    assert 'class="qr"' in answer.text
    return found[1]


def phone(visit: int, **fields: object) -> TestClient:
    """A phone that has opened a new link of the visit."""
    browser = stranger()
    answer = take(browser, link_of(visit, **fields))
    assert (answer.status_code, answer.headers["location"]) == (303, "/phone")
    return browser


def take(browser: TestClient, key: str) -> Any:
    """Open a link, as the page behind its address does."""
    return browser.post("/phone/open", data={"key": key}, follow_redirects=False)


def parts_of(body: bytes) -> list[bytes]:
    return [body[i : i + 4096] for i in range(0, len(body), 4096)]


def identity(body: bytes) -> str:
    """As the page of the phone names a recording: the SHA-256 of the sums of its parts."""
    return hashlib.sha256(b"".join(hashlib.sha256(part).digest() for part in parts_of(body))).hexdigest()


def stated(film: bytes, log: bytes = b"", **about: Any) -> dict[str, Any]:
    return {"sha256": identity(film + log), "video_bytes": len(film), "log_bytes": len(log), **about}


def begin(browser: TestClient, film: bytes, log: bytes = b"", **about: Any) -> dict[str, Any]:
    answer = browser.post("/phone/recordings.json", json=stated(film, log, **about))
    assert answer.status_code == 200, answer.text
    return answer.json()


def put(browser: TestClient, number: int, start: int, part: bytes, total: int, **headers: str) -> Any:
    own = {
        "content-type": "application/octet-stream",
        "content-range": f"bytes {start}-{start + len(part) - 1}/{total}",
        "x-sha256": hashlib.sha256(part).hexdigest(),
    }
    return browser.put(f"/phone/recordings/{number}.json", content=part, headers={**own, **headers})


def send_all(browser: TestClient, film: bytes, log: bytes = b"", **about: Any) -> Any:
    """Send a whole recording; the answer to its end."""
    told = begin(browser, film, log, **about)
    for n in told["missing"]:
        part = parts_of(film + log)[n]
        assert put(browser, told["number"], n * 4096, part, len(film + log)).status_code == 204
    return finish(browser, told["number"])


def send(browser: TestClient, film: bytes, log: bytes = b"", **about: Any) -> dict[str, Any]:
    return send_all(browser, film, log, **about).json()


def finish(browser: TestClient, number: int) -> Any:
    return browser.post(f"/phone/finish/{number}.json", json={})


def film(tmp_path: Path, name: str = "walk") -> bytes:
    folder = tmp_path / "films"
    folder.mkdir(exist_ok=True)
    return small_video(folder, name, n=60).read_bytes()


def attitude_log() -> bytes:
    time_s = [i / 60 for i in range(150)]
    half = 0.5**0.5
    values = {"qw": half, "qx": half, "qy": 0.0, "qz": 0.0}
    sensor = {"time_s": time_s, **{name: [v] * len(time_s) for name, v in values.items()}}
    return json.dumps({"frame": "device", "phone": {"make": "T", "model": "One"}, "orientation": sensor}).encode()


# ----------------------------------------------------------------------------------------------------------- the link
def test_a_link_opens_for_one_phone_until_it_is_ended(visit: int):
    key = link_of(visit)
    mine, other = stranger(), stranger()
    for look in (other.get, other.head, mine.get):  # a preview, a phone that has not gone on yet
        assert look("/phone/open", params={"key": key}, follow_redirects=False).status_code == 200
        assert "pbl_phone" not in other.cookies
    assert take(mine, key).status_code == 303
    page = mine.get("/phone")
    assert page.status_code == 200
    assert "P001" in page.text
    assert "camera=(self)" in page.headers["permissions-policy"]
    # The same phone may scan it again; another one may not, and neither can take it by a wrong key.
    assert mine.get("/phone/open", params={"key": key}, follow_redirects=False).status_code == 303
    for answer in (take(other, key), other.get("/phone/open", params={"key": key}, follow_redirects=False)):
        assert answer.status_code == 403
        assert "PHONE_LINK" in answer.text
    assert other.get("/phone").status_code == 401
    assert other.get("/phone/open", params={"key": key + "x"}, follow_redirects=False).status_code == 403
    # No key and no cookie is in the tables.
    row = PhoneLink().fetch1()
    assert key not in str(row)
    assert mine.cookies["pbl_phone"] not in str(row)
    reviewer = web.client(target=nothing)
    made = web.post(reviewer, f"/visits/{visit}/film", hours="2").text
    address = not_none(re.search(r'<a href="(http[^"]+)"><code>([^<]+)</code></a>', made))
    assert address[1] == address[2]
    assert "opened by a phone" in reviewer.get(f"/visits/{visit}").text
    web.post(reviewer, f"/visits/{visit}/film/end", link=row["phone_link"])
    ended = mine.get("/phone/state.json")
    assert (ended.status_code, ended.json()["error"]["code"]) == (403, "PHONE_LINK")
    assert "opened by a phone" not in reviewer.get(f"/visits/{visit}").text


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_link_as_text_can_be_tapped(visit: int, language: str):
    browser = web.client(target=nothing)
    browser.headers["accept-language"] = language
    page = web.post(browser, f"/visits/{visit}/film", hours=2).text
    tapped = not_none(re.search(r'<a href="(http[^"]*/phone/open\?key=[\w-]+)">(?:<code>)?\1', page))
    assert stranger().get(tapped[1]).status_code == 200


def test_a_link_ends_by_its_time(visit: int):
    browser = phone(visit)
    assert browser.get("/phone/state.json").json()["visit"] == visit
    PhoneLink.connection.query(
        f"UPDATE {PhoneLink.full_table_name} SET link_expires = UTC_TIMESTAMP() - INTERVAL 1 SECOND"
    )
    assert browser.get("/phone/state.json").json()["error"]["code"] == "PHONE_LINK"
    assert browser.post("/phone/recordings.json", json=stated(b"x")).status_code == 403


def test_the_link_of_another_visit_cannot_be_ended_from_here(visit: int):
    browser, other = phone(visit), new_visit("2026-02-01")
    number = PhoneLink().fetch1("phone_link")
    web.post(web.client(target=nothing), f"/visits/{other}/film/end", link=number)
    assert browser.get("/phone/state.json").status_code == 200


# --------------------------------------------------------------------------------------------------------- the upload
def test_a_recording_arrives_with_its_log_in_the_visit_and_is_computed_first(visit: int, tmp_path: Path):
    register(small_video(tmp_path, "waiting", n=30), session_label="2026-03-01")
    queue.fill(video.VideoInfo)
    whole = film(tmp_path)
    told = send(phone(visit), whole, attitude_log(), activity="walking", pace="fast", aid="cane", frames=60, dropped=1)
    assert told["state"] == "received"
    row = (video.Video & {"session_id": visit}).fetch1()
    assert Path(row["video_path"]).read_bytes() == whole
    assert (row["activity"], row["camera_motion"]) == ("walking", "handheld")
    assert (video.Pace & {"video_id": row["video_id"]}).fetch1("pace") == "fast"
    log = (video.PhoneAttitude & {"video_id": row["video_id"]}).fetch1()
    assert (log["attitude_n"], log["attitude_device"]) == (150, "T One")
    assert PhoneRecording().fetch1("video_id") == row["video_id"]
    # Its job is the first in the queue, and nothing of the parts is left.
    waiting = jobs_of(video.VideoInfo).pending.to_dicts(order_by="priority")
    assert waiting[0]["video_id"] == row["video_id"]
    assert len(waiting) == 2
    assert not list((tmp_path / "archive" / "_phone").rglob("*"))


def test_the_same_recording_twice_arrives_once(visit: int, tmp_path: Path):
    browser, whole = phone(visit), film(tmp_path)
    first = send(browser, whole)
    again = begin(browser, whole)
    assert (again["number"], again["state"], again["missing"]) == (first["number"], "received", [])
    assert finish(browser, first["number"]).json()["state"] == "received"
    answer = put(browser, first["number"], 0, parts_of(whole)[0], len(whole))
    assert (answer.status_code, code(answer)) == (422, "UPLOAD_REFUSED")
    assert send(phone(visit), whole)["number"] == first["number"]  # by a new link as well
    assert len(video.Video()) == len(PhoneRecording()) == 1


@pytest.mark.parametrize("subject", ["P001", "P002"])
def test_the_recording_of_another_visit_is_refused_without_saying_whose(visit: int, tmp_path: Path, subject: str):
    whole = film(tmp_path)
    assert send(phone(visit), whole)["state"] == "received"
    told = send(phone(new_visit("2026-02-01", subject)), whole)
    assert told["state"] == "refused"
    assert told["error"].startswith("VIDEO_DUPLICATE")
    assert "P001" not in told["error"]
    assert "2026-01" not in told["error"]
    assert video.Video().fetch1("session_id") == visit


def test_two_phones_at_one_visit_are_both_kept_and_the_page_says_so(visit: int, tmp_path: Path):
    for name in ("walk", "other"):
        assert send(phone(visit), film(tmp_path, name))["state"] == "received"
    assert len(video.Video & {"session_id": visit}) == 2
    assert "More than one phone" in web.client(target=nothing).get(f"/visits/{visit}").text


def test_torn_down_a_hundred_times_every_recording_arrives_once(visit: int, tmp_path: Path):
    """Connections cut within a request and before its answer, pages that forget what they sent, servers that end."""
    rng = random.Random(37)
    films = [film(tmp_path, name) for name in ("walk", "other", "third")]
    log, browser = attitude_log(), phone(visit)
    cookie = f"pbl_phone={browser.cookies['pbl_phone']}"
    torn = 0
    with contextlib.ExitStack() as stack:
        port = stack.enter_context(serving())

        def request(method: str, path: str, body: bytes, kind: str, cut: bool = False, **headers: str) -> Any:
            lines = [f"{method} {path} HTTP/1.1", f"Host: 127.0.0.1:{port}", f"Cookie: {cookie}", "Connection: close",
                     f"Content-Type: {kind}", f"Content-Length: {len(body)}"]  # fmt: skip
            raw = "\r\n".join([*lines, *(f"{k.replace('_', '-')}: {v}" for k, v in headers.items()), "", ""]).encode()
            with socket.create_connection(("127.0.0.1", port), timeout=30) as sent:
                if cut:
                    sent.sendall((raw + body)[: rng.randrange(1, len(raw) + len(body) + 1)])
                    return None
                sent.sendall(raw + body)
                answer = b"".join(iter(lambda: sent.recv(65536), b""))
            status = int(answer.split(b" ")[1])
            assert status in (200, 204), answer
            return json.loads(answer.split(b"\r\n\r\n", 1)[1]) if status == 200 else None

        waiting = list(films)
        while waiting:
            whole = rng.choice(waiting)
            body = json.dumps(stated(whole, log)).encode()
            cut = torn < 100 and rng.random() < 0.1
            told = request("POST", "/phone/recordings.json", body, "application/json", cut)
            if told is None:
                torn += 1
                continue
            if not told["missing"] and (torn >= 100 or rng.random() < 0.3):
                end = request("POST", f"/phone/finish/{told['number']}.json", b"{}", "application/json")
                assert end["state"] == "received"
                waiting.remove(whole)
                if not waiting and torn < 100:
                    films.append(film(tmp_path, f"walk{len(films)}"))
                    waiting.append(films[-1])
                continue
            for n in rng.sample(told["missing"], len(told["missing"])):
                part = parts_of(whole + log)[n]
                ranged = f"bytes {n * 4096}-{n * 4096 + len(part) - 1}/{len(whole + log)}"
                cut = torn < 100 and rng.random() < 0.7
                request("PUT", f"/phone/recordings/{told['number']}.json", part, "application/octet-stream", cut,
                        content_range=ranged, x_sha256=hashlib.sha256(part).hexdigest())  # fmt: skip
                if cut:
                    torn += 1
                    break  # the page is loaded again: it knows nothing but the file
            if not told["missing"]:
                request("POST", f"/phone/finish/{told['number']}.json", b"{}", "application/json", True)
                torn += 1
            if torn < 100 and rng.random() < 0.05:
                stack.pop_all().close()
                port = stack.enter_context(serving())
    assert torn >= 100
    paths = [Path(p) for p in (video.Video & {"session_id": visit}).to_arrays("video_path")]
    assert sorted(p.read_bytes() for p in paths) == sorted(films)
    assert len(video.PhoneAttitude()) == len(PhoneRecording()) == len(films)
    assert not list((tmp_path / "archive" / "_phone").rglob("*"))


def serving() -> contextlib.AbstractContextManager[int]:
    return web.running(create_app(Options(target=nothing)), Where())


def test_the_phone_and_the_visits_page_say_whether_it_can_be_used(visit: int, tmp_path: Path):
    browser, reviewer = phone(visit), web.client(target=nothing)
    send(browser, small_video(tmp_path, "walk").read_bytes())
    told = browser.get("/phone/state.json").json()
    assert told["recordings"][0]["verdict"] == "The server has it and is checking it."
    assert told["next"] == ""
    send(browser, small_video(tmp_path, "empty", people="nobody").read_bytes())
    populate()
    walked, empty = sorted(browser.get("/phone/state.json").json()["recordings"], key=lambda r: r["number"])
    assert re.fullmatch(r"Usable.*[1-9]\d* gait cycles left, \d+ right\.", walked["verdict"]), walked["verdict"]
    assert walked["verdict"] in reviewer.get(f"/visits/{visit}").text
    german = browser.get("/phone/state.json", headers={"accept-language": "de"}).json()["recordings"]
    assert any("Doppelschritte links" in r["verdict"] for r in german)
    assert empty["state"] == "received"


def test_a_recording_of_one_frame_is_to_be_filmed_again(visit: int, tmp_path: Path):
    browser = phone(visit)
    assert send(browser, small_video(tmp_path, "short", n=1).read_bytes(), attitude_log())["state"] == "received"
    populate()
    said = browser.get("/phone/state.json").json()["recordings"][0]["verdict"]
    assert said.startswith("Film again: "), said


def test_what_cannot_be_used_is_said_with_what_to_do(visit: int, tmp_path: Path):
    browser = phone(visit)
    send(browser, film(tmp_path))
    populate()
    key = keypoints.Keypoints().fetch1("KEY")
    (keypoints.Keypoints.Check & key).delete_quick()
    check = Check("feet_cut_share", "FAIL", 0.4, 0.3, "the feet leave the picture below: tilt the phone or step back")
    keypoints.Keypoints.Check.insert1({**key, **to_row(check, "keypoints")})
    said = browser.get("/phone/state.json").json()["recordings"][0]["verdict"]
    assert said.startswith("Film again: the feet leave the picture below: tilt the phone or step back (40%)")


def test_a_protocol_is_ticked_off(visit: int, tmp_path: Path):
    sheet = tmp_path / "clinic.csv"
    sheet.write_text("activity,pace,view,passes\nwalking,self_selected,left,1\ntug,,any,2\n")
    steps = read_protocol(sheet)
    assert add_protocol("clinic", steps)
    assert not add_protocol("clinic", steps)
    with pytest.raises(PblError, match="USAGE"):
        add_protocol("clinic", steps[:1])
    reviewer = web.client(target=nothing)
    assert "<option>clinic</option>" in reviewer.get(f"/visits/{visit}").text
    browser = phone(visit, protocol="clinic")
    assert "<li>Timed Up and Go, from any side" in reviewer.get(f"/visits/{visit}").text

    def counted() -> list[tuple[int, int]]:
        return [(s["done"], s["waiting"]) for s in browser.get("/phone/state.json").json()["protocol"]]

    for n, step in enumerate((1, 2, 2)):
        assert counted() == [(0, min(n, 1)), (0, max(0, n - 1))]
        whole = small_video(tmp_path, f"walk{n}").read_bytes()
        send(browser, whole, activity=steps[step - 1].activity, step=str(step))
    page = reviewer.get(f"/visits/{visit}").text
    assert "0 of 2; 2 arrived, being checked" in page
    assert "complete by its protocol" not in page  # a tick means usable
    assert sorted((video.Video & {"session_id": visit}).to_arrays("activity")) == ["tug", "tug", "walking"]
    populate()
    assert counted() == [(1, 0), (0, 0)]  # they are walks
    assert "complete by its protocol" not in reviewer.get(f"/visits/{visit}").text
    server, rows = gait.Spatiotemporal.Measure.connection, gait.Spatiotemporal.Measure.full_table_name
    server.query(f"UPDATE {rows} SET measure_mean = 9 WHERE measure IN ('tug_time_s', 'turn_time_s')")
    server.query(f"UPDATE {gait.Spatiotemporal.full_table_name} SET measures_seconds = measures_seconds + 1")
    assert counted() == [(1, 0), (2, 0)]
    assert "complete by its protocol" in reviewer.get(f"/visits/{visit}").text
    # What cannot be used does not count.
    video.NotUsable.insert1(
        {
            "video_id": 1,
            "unusable_reason": next(iter(UNUSABLE)),
            "unusable_by": "R",
            "unusable_created": "2026-01-01 00:00:00",
        }
    )
    assert counted() == [(0, 0), (2, 0)]
    assert "complete by its protocol" not in reviewer.get(f"/visits/{visit}").text
    answer = web.post(reviewer, f"/visits/{visit}/film", hours=2, protocol="unknown")
    assert answer.status_code == 404


def drawn_take(rng: random.Random) -> tuple[str, Usable]:
    """The activity that was stated of a take, and the verdict on what was filmed."""
    activity = rng.choice(("walking", "tug", "sit_to_stand", "squat", "stairs", "standing"))
    checks = [{"keypoints_check": "x", "keypoints_check_value": None, "keypoints_check_advice": "step back"}]
    checks[0]["keypoints_check_outcome"] = rng.choice(("PASS", "PASS", "WARN", "FAIL"))
    steps = rng.choice((0, 0, 3))
    needed = {name: rng.choice((0.0, None, 5.0)) for name in ("rise_count", "tug_time_s", "turn_time_s", "squat_count")}
    measures = {name: (value, "" if value is not None else "not found") for name, value in needed.items()}
    found = rng.choice((None, module_usable._Found((steps, 0), "" if steps else "nobody walks", measures)))
    state = SimpleNamespace(stops=rng.random() < 0.3, verdict="it failed")
    judged = module_usable._verdict(activity, checks, found, state)  # pyright: ignore[reportArgumentType]
    shows = {
        "walking": steps > 0,
        "stairs": steps > 0,
        "standing": steps == 0,
        "tug": bool(needed["tug_time_s"] and needed["turn_time_s"]),
        "sit_to_stand": bool(needed["rise_count"]),
        "squat": bool(needed["squat_count"]),
    }[activity]
    good = found is not None and shows and checks[0]["keypoints_check_outcome"] != "FAIL"
    assert (judged.state in ("usable", "remarks")) == good, (activity, found, judged)
    assert judged.said or judged.state in ("usable", "pending"), "what is wrong is said"
    if judged.state == "unusable" and found is not None and not shows and activity not in ("walking", "stairs"):
        assert any("correct its activity" in said for said in judged.said) or "step back" in judged.said
    return activity, dataclasses.replace(judged, activity=activity)


def test_drawn_mixes_of_takes_are_complete_by_usable_ones_alone(visit: int):
    wanted = {"1": ("walking", 2), "2": ("tug", 1), "3": ("sit_to_stand", 1)}
    add_protocol("drawn", [ProtocolStep(int(n), activity, "", "any", k) for n, (activity, k) in wanted.items()])
    link_of(visit, protocol="drawn")
    rng, complete = random.Random(65), 0
    for _ in range(200):
        sent: list[tuple[Sent, Usable | None]] = []
        good: dict[str, set[int]] = {n: set() for n in wanted}
        for number in range(rng.randint(0, 40)):
            activity, judged = drawn_take(rng)
            if rng.random() < 0.5:  # most people follow the protocol
                judged = dataclasses.replace(judged, state=rng.choice(("usable", "usable", "pending")))
            fits = [n for n, (of_step, _) in wanted.items() if of_step == activity]
            step = rng.choice(fits or list(wanted)) if rng.random() < 0.8 else rng.choice([*wanted, ""])
            times = 2 if rng.random() < 0.2 else 1  # a walk that was sent with two logs is one video
            about = {"step": step} if step else {}
            for _ in range(times):
                sent.insert(0, (Sent(number, visit, "", 1, 0, about, "received", None, number), judged))
            if step and wanted[step][0] == activity and judged.state in ("usable", "remarks"):
                good[step].add(number)
            if rng.random() < 0.1:
                sent.append((Sent(1000 + number, visit, "", 1, 0, about, "uploading", None, None), None))
        steps = steps_of(visit, sent)
        assert {str(s.number): s.done for s in steps} == {n: len(found) for n, found in good.items()}
        assert all(s.complete for s in steps) == all(len(good[n]) >= k for n, (_, k) in wanted.items())
        complete += all(s.complete for s in steps)
    assert 5 < complete < 195  # both were drawn


@pytest.mark.parametrize(("stated", "state"), [
    ("sit_to_stand", "unusable"), ("tug", "unusable"), ("squat", "unusable"), ("standing", "unusable"),
    ("walking", "usable"), ("stairs", "usable"), ("fsst", "usable"),
])  # fmt: skip
def test_a_walk_is_usable_as_a_walk_alone(walks: dict[str, int], stated: str, state: str):
    browser = web.client(target=nothing)
    number = walks[stated]
    judged = usable(number)
    assert (judged.state.replace("remarks", "usable"), judged.activity) == (state, stated)
    if state == "unusable":
        assert verdict("en", judged).startswith("Film again: ")
        assert "if something else was filmed, correct its activity" in verdict("en", judged)
        assert "die Aktivität auf der Seite des Termins berichtigen" in verdict("de", judged)
    if stated == "sit_to_stand":
        assert "five rises are needed, 0 were found" in judged.said
        assert "fünfmal Aufstehen ist nötig, gefunden: 0" in verdict("de", judged)
    assert browser.get(f"/recordings/{number}").status_code == 200


def test_nothing_is_usable_before_it_is_measured(visit: int, tmp_path: Path):
    """Neither before its cycles are known, nor while the fit waits for another recording of the visit."""
    browser = phone(visit)
    send(browser, small_video(tmp_path, "walk").read_bytes())
    populate(["VideoInfo", "Tracking", "SubjectChoice", "Keypoints"])
    assert len(keypoints.Keypoints()) == 1
    assert usable(1).state == "pending"
    populate(["TrialInput"])
    register(small_video(tmp_path, "later", n=60), session_label="2026-01-10")
    populate(["SessionFit"])  # waits until the other one is decided
    assert usable(1).state == "pending"
    populate()
    assert usable(1).state in ("usable", "remarks")
    cycles = usable(1).cycles
    register(small_video(tmp_path, "third"), session_label="2026-01-10")
    populate()  # a second set of the visit
    assert usable(1).cycles == cycles  # counted once


def test_the_page_says_how_long_a_check_usually_takes(visit: int, tmp_path: Path):
    reviewer = web.client(target=nothing)
    assert usual_seconds() is None
    browser = phone(visit)
    for name in "abc":
        send(browser, small_video(tmp_path, name).read_bytes())
    populate()
    server = video.Video.connection
    for number, seconds in ((1, 12), (2, 14), (3, 300)):
        server.query(
            f"UPDATE {video.Video.full_table_name} SET video_created = (SELECT MIN(measures_computed) FROM"
            f" {gait.Spatiotemporal.full_table_name} m WHERE m.video_id = {number}) - INTERVAL {seconds} SECOND"
            f" WHERE video_id = {number}"
        )
    assert usual_seconds() == 14
    send(browser, small_video(tmp_path, "waits").read_bytes())
    assert browser.get("/phone/state.json").json()["checked"] == 1
    for language, told in (("en", "A check usually takes 15 s."), ("de", "Eine Prüfung dauert meist 15 s.")):
        headers = {"accept-language": language}
        assert told in browser.get("/phone", headers=headers).text
        assert told in reviewer.get(f"/visits/{visit}", headers=headers).text
    assert [usual_words("en", s) for s in (None, 2.0, 91.0)] == ["", "A check usually takes 5 s.",
                                                                "A check usually takes 2 min."]  # fmt: skip


@pytest.mark.parametrize(
    "text",
    ["activity,view\nwalking,above\n", "view\nleft\n", "activity\n"]
    + [f"activity,passes\nwalking,{n}\n" for n in ("0", "1.5", "x")]
    + ["activity\n" + "walking\n" * 101],
)
def test_a_protocol_that_cannot_be_is_refused(text: str, tmp_path: Path):
    (tmp_path / "p.csv").write_text(text)
    with pytest.raises(PblError, match="SHEET_FORMAT"):
        read_protocol(tmp_path / "p.csv")


def test_the_command_prints_a_link_that_opens(visit: int):
    done = CliRunner().invoke(capture, ["link", "--visit", str(visit), "--url", "https://gait.example:8484/"])
    assert done.exit_code == 0, done.output
    address = done.output.splitlines()[-1]
    assert address.startswith("https://gait.example:8484/phone/open?key=")
    assert take(stranger(), address.partition("key=")[2]).status_code == 303


@pytest.mark.parametrize(("now", "then", "side", "words"), [
    (9.0, 6.0, "right", "Index so far: ±9 (90 %). One more pass filmed from the right side makes it ±6."),
    (9.0, 6.2, "", "Index so far: ±9 (90 %). One more pass filmed from the front or back makes it ±6."),
    (5.2, 5.0, "left", "Index so far: ±5 (90 %)."),
])  # fmt: skip
def test_what_to_film_next(now: float, then: float, side: str, words: str):
    assert next_words("en", Next(side, now, then)) == words
    assert next_words("de", Next(side, now, then)).startswith("Index bisher")
    empty = Usable("unusable", ("No person was found in the video.",))
    assert verdict("de", empty) == "Neu filmen: Im Video wurde keine Person gefunden."


# ------------------------------------------------------------------------------------------------------------ attacks
def code(answer: Any) -> str:
    return answer.json()["error"]["code"]


def test_a_phone_reaches_nothing_but_its_own_visit(visit: int, tmp_path: Path):
    mine, other = phone(visit), phone(new_visit("2026-02-01", "P002"))
    number = begin(mine, film(tmp_path))["number"]
    part = parts_of(film(tmp_path))[0]
    assert code(put(other, number, 0, part, len(film(tmp_path)))) == "DB_NOT_FOUND"
    assert code(finish(other, number)) == "DB_NOT_FOUND"
    assert other.get("/phone/state.json").json()["recordings"] == []
    for path in ("/visits", f"/visits/{visit}", "/operate", "/visits.json", "/compare"):
        assert mine.get(path).status_code == 401, path
    # A visit that is named in the statement is not looked at.
    assert begin(mine, b"x" * 10, session_id=999, visit=999)["number"]
    assert {int(n) for n in PhoneRecording().to_arrays("session_id")} == {visit}


def test_the_session_of_a_reader_is_no_phone(visit: int, tmp_path: Path):
    reader, whole = web.client("reader", target=nothing), film(tmp_path)
    assert web.post(reader, f"/visits/{visit}/film", hours=2).status_code == 403
    number = begin(phone(visit), whole)["number"]
    for answer in (
        reader.get("/phone"), reader.get("/phone/state.json"), finish(reader, number),
        reader.post("/phone/recordings.json", json=stated(whole)),
        put(reader, number, 0, parts_of(whole)[0], len(whole)),
    ):  # fmt: skip
        assert answer.status_code == 403, answer.request.url
    assert len(PhoneLink()) == 1


def test_what_is_not_a_recording_is_refused(visit: int, tmp_path: Path):
    browser, whole = phone(visit), film(tmp_path)
    most = phone_recordings.PART_BYTES * MOST_PARTS
    for wrong in (
        {"video_bytes": 10 * 10**9}, {"video_bytes": most + 1},
        {"video_bytes": 1000 * phone_recordings.PART_BYTES}, {"log_bytes": most}, {"video_bytes": 0},
        {"video_bytes": -1}, {"video_bytes": True}, {"video_bytes": "1"}, {"log_bytes": None}, {"sha256": "x" * 64},
        {"sha256": "../../etc/passwd"}, {"sha256": 3},
    ):  # fmt: skip
        answer = browser.post("/phone/recordings.json", json={**stated(whole), **wrong})
        assert (answer.status_code, code(answer)) == (422, "UPLOAD_REFUSED"), wrong
    for wrong in ({"note": "a\x00b"}, {"note": "x" * 501}, {"pace": {"a": 1}}, {"activity": "y" * 33}):
        assert code(browser.post("/phone/recordings.json", json={**stated(whole), **wrong})) == "USAGE", wrong
    for body in (b"[]", b"3", b"null"):
        answer = browser.post("/phone/recordings.json", content=body, headers={"content-type": "application/json"})
        assert code(answer) == "UPLOAD_REFUSED"
    for body in (b"{", b"[" * 60_000, b"\xff"):
        answer = browser.post("/phone/recordings.json", content=body, headers={"content-type": "application/json"})
        assert (answer.status_code, code(answer)) == (415, "WEB_REFUSED")
    assert len(PhoneRecording()) == 0


def test_what_is_not_a_part_is_refused(visit: int, tmp_path: Path):
    browser, whole = phone(visit), film(tmp_path)
    number, part, size = begin(browser, whole)["number"], parts_of(whole)[0], len(whole)
    for content_range in (f"bytes 1-4096/{size}", f"bytes 0-4094/{size}", f"bytes 0-4095/{size + 1}", "bytes 0-4095/*",
                          f"bytes {size // 4096 * 4096 + 4096}-{size + 4096}/{size}", "", "bytes -1-4095/9",
                          f"bytes 00-4095/{size}", f"bytes 0-{size - 1}/{size}",
                          f"bytes 0-4095/{size}, 0-1/2"):  # fmt: skip
        answer = put(browser, number, 0, part, size, **{"content-range": content_range})
        assert code(answer) in ("UPLOAD_REFUSED", "WEB_REFUSED"), content_range
    assert code(put(browser, number, 0, part[:-1] + b"?", size, **{"x-sha256": "0" * 64})) == "UPLOAD_REFUSED"
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        assert put(browser, number, 0, part, size, **{"content-type": kind}).status_code == 415
    # A body of 10 GB is refused by what it announces, one that announces nothing by what comes.
    assert put(browser, number, 0, part, size, **{"content-length": str(10 * 2**30)}).status_code == 413
    endless = (b"x" * 4096 for _ in range(1000))
    own = {"content-type": "application/octet-stream", "content-range": f"bytes 0-4095/{size}"}
    answer = browser.put(f"/phone/recordings/{number}.json", content=endless, headers=own)
    assert answer.status_code in (413, 422)
    assert begin(browser, whole)["missing"] == list(range(len(parts_of(whole))))
    assert code(finish(browser, number)) == "UPLOAD_REFUSED"
    for path in ("/phone/recordings/..%2f1.json", "/phone/recordings/01.json", "/phone/finish/-1.json"):
        assert browser.put(path, content=part).status_code in (403, 404), path


def test_no_page_from_elsewhere_makes_a_phone_send(visit: int, tmp_path: Path):
    browser, whole = phone(visit), film(tmp_path)
    for headers in ({"origin": "https://evil.example"}, {"sec-fetch-site": "cross-site"}, {"origin": "null"}):
        answer = browser.post("/phone/recordings.json", json=stated(whole), headers=headers)
        assert answer.status_code == 403, headers
    assert len(PhoneRecording()) == 0


def test_what_is_no_video_or_comes_with_a_bad_log_is_refused_by_its_code(visit: int, tmp_path: Path):
    browser = phone(visit)
    told = send(browser, b"no video at all" * 1000)
    assert told["state"] == "refused"
    assert told["error"].startswith("VIDEO_NOT_A_VIDEO")
    assert told["verdict"].startswith("cannot be used: ")
    assert "VIDEO_NOT_A_VIDEO" not in told["verdict"]
    told = send(browser, film(tmp_path), b'{"time_s": [1]}')
    assert told["state"] == "refused"
    assert told["error"].startswith("PHONE_LOG")
    assert len(video.Video()) == 0
    assert not list((tmp_path / "archive" / "_phone").rglob("*"))
    assert "cannot be used" in web.client(target=nothing).get(f"/visits/{visit}").text


@pytest.fixture
def killed_at_the_end(monkeypatch: pytest.MonkeyPatch) -> Killed:
    """A server that is killed before it removes the parts of what it registered or refused."""

    @contextmanager
    def killed() -> Iterator[None]:
        with monkeypatch.context() as patch:
            patch.setattr(phone_uploads, "discard", lambda *_: None)
            yield

    return killed


@pytest.mark.parametrize("limit", ["_OPEN_S", "LOG_S"])
def test_a_server_that_is_short_of_time_or_memory_says_try_again(
    visit: int, tmp_path: Path, limit: str, limits: Limits
):
    """The recording is not at fault: its parts stay, and the same bytes are taken later."""
    browser, whole, log = phone(visit), film(tmp_path), attitude_log()
    with limits(incoming, **{limit: 0}):
        for tried in (1, 2):
            answer = send_all(browser, whole, log)
            assert (answer.status_code, code(answer)) == (503, "MACHINE_SHORT")
            row = PhoneRecording().fetch1()
            assert row["phone_state"] == "uploading"
            assert row["phone_error"].startswith(f"{tried} x MACHINE_SHORT")
    left = [p.name for p in (tmp_path / "archive" / "_phone").rglob("*") if p.is_file()]
    assert sorted(left, key=int) == [str(n) for n in range(len(parts_of(whole + log)))]
    assert send(browser, whole, log)["state"] == "received"
    assert PhoneRecording().fetch1("phone_error") == ""


def test_the_recording_of_one_visit_does_not_wait_for_that_of_another(visit: int, tmp_path: Path, faults: Faults):
    """One server: while a file of the first visit is being opened, that of the second is taken."""
    slow, quick = film(tmp_path, "slow"), film(tmp_path, "quick")
    other, opened, go_on = new_visit("2026-02-10"), threading.Event(), threading.Event()

    def waits(path: Path) -> None:
        if path.read_bytes() == slow:
            opened.set()
            assert go_on.wait(60.0)

    faults(phone_uploads, "check_opens", before=waits)
    first = phone(visit)
    second = TestClient(first.app, base_url=web.BASE)
    take(second, link_of(other))
    with first, ThreadPoolExecutor(1) as thread:
        second.portal = first.portal  # of one loop, as in the server
        waiting = thread.submit(send, first, slow)
        assert opened.wait(60.0)
        assert send(second, quick)["state"] == "received"
        assert not waiting.done()
        go_on.set()
        assert waiting.result()["state"] == "received"


def of_another(act: Callable[[], None]) -> Callable[..., None]:
    """The work of another process, whose tables no thread of ours asks."""

    def acted(*_: Any) -> None:
        with ThreadPoolExecutor(1) as other:
            other.submit(act).result()

    return acted


def test_a_part_that_comes_again_while_the_recording_is_registered_is_not_kept(
    visit: int, tmp_path: Path, faults: Faults
):
    browser, whole = phone(visit), film(tmp_path)
    told = begin(browser, whole)
    for n, part in enumerate(parts_of(whole)):
        put(browser, told["number"], n * 4096, part, len(whole))

    def registered_first() -> None:
        owner = phone_of(browser.cookies["pbl_phone"])
        sent = phone_recordings.recording(owner, told["number"])
        phone_uploads.register(owner, sent, phone_uploads.put_together(owner, sent))

    faults(phone_uploads, "keep_part", before=of_another(registered_first))
    assert put(browser, told["number"], 0, parts_of(whole)[0], len(whole)).status_code == 204
    assert not list((tmp_path / "archive" / "_phone").rglob("*"))


def test_parts_that_were_changed_on_the_way_are_sent_again(visit: int, tmp_path: Path):
    """Each part has the sum that its request states, but together they are another recording than was announced."""
    browser, whole = phone(visit), film(tmp_path)
    number = begin(browser, whole)["number"]
    for n, part in enumerate(parts_of(whole)):
        assert put(browser, number, n * 4096, bytes(len(part)), len(whole)).status_code == 204
    assert code(finish(browser, number)) == "UPLOAD_REFUSED"
    assert send(browser, whole)["state"] == "received"


def test_a_link_takes_so_many_recordings(visit: int, limits: Limits):
    limits(phone_recordings, MOST_RECORDINGS=3)
    browser = phone(visit)
    for n in range(3):
        begin(browser, bytes([n]))
    assert code(browser.post("/phone/recordings.json", json=stated(b"more"))) == "UPLOAD_REFUSED"
    assert begin(browser, bytes([1]))["number"]  # one that is known goes on


def test_a_visit_that_was_removed_meanwhile_is_not_made_again(visit: int, tmp_path: Path):
    browser, whole = phone(visit), film(tmp_path)
    told = begin(browser, whole)
    owner = phone_of(browser.cookies["pbl_phone"])
    for n, part in enumerate(parts_of(whole)):
        put(browser, told["number"], n * 4096, part, len(whole))
    sent = phone_recordings.recording(owner, told["number"])
    (session.Session & {"session_id": visit}).delete(prompt=False)
    assert code(finish(browser, told["number"])) == "PHONE_LINK"
    with pytest.raises(Exception, match="DB_NOT_FOUND"):  # between the two
        phone_uploads.register(owner, sent, phone_uploads.put_together(owner, sent))
    assert len(session.Session()) == len(video.Video()) == 0


def test_a_part_that_was_on_its_way_while_the_person_was_forgotten_is_not_kept(
    visit: int, tmp_path: Path, faults: Faults
):
    browser, whole = phone(visit), film(tmp_path)
    told = begin(browser, whole)

    def forgotten_first() -> None:
        (session.Session & {"session_id": visit}).delete(prompt=False)

    faults(phone_uploads, "keep_part", before=of_another(forgotten_first))
    answer = put(browser, told["number"], 0, parts_of(whole)[0], len(whole))
    assert (answer.status_code, code(answer)) == (404, "DB_NOT_FOUND")
    assert not [p for p in (tmp_path / "archive").rglob("*") if "P001" in p.parts]


def test_the_archive_has_to_have_room(visit: int, tmp_path: Path, limits: Limits):
    limits(incoming, KEPT_FREE=10**18)
    answer = phone(visit).post("/phone/recordings.json", json=stated(film(tmp_path)))
    assert (answer.status_code, code(answer)) == (507, "FILE_UNWRITABLE")


def test_room_is_promised_to_all_recordings_that_were_begun(visit: int, tmp_path: Path, machine: Machine):
    """Twice its length for each: the parts, and the whole beside them."""
    one, two = film(tmp_path, "one"), film(tmp_path, "two")
    machine(free_bytes=incoming.KEPT_FREE + 3 * len(one))
    browser = phone(visit)
    first = begin(browser, one)
    answer = browser.post("/phone/recordings.json", json=stated(two))
    assert (answer.status_code, code(answer)) == (507, "FILE_UNWRITABLE")
    assert [row["phone_recording"] for row in PhoneRecording().to_dicts()] == [first["number"]]
    assert send(browser, one)["state"] == "received"
    assert send(browser, two)["state"] == "received"


def test_what_is_left_of_others_makes_no_room(visit: int, tmp_path: Path, killed_at_the_end: Killed, machine: Machine):
    """Neither the upload of a browser nor parts that a killed server left count as those of what was begun."""
    whole, sent = film(tmp_path), film(tmp_path, "sent")
    browser = phone(visit)
    with killed_at_the_end():
        assert send(browser, sent)["state"] == "received"
    (tmp_path / "archive" / "_phone" / "P001" / "browser-1.mp4").write_bytes(bytes(9 * len(whole)))
    machine(free_bytes=incoming.KEPT_FREE + len(whole))
    answer = browser.post("/phone/recordings.json", json=stated(whole))
    assert (answer.status_code, code(answer)) == (507, "FILE_UNWRITABLE")


def test_a_reader_is_told_of_missing_logs_without_the_way_to_send_them(visit: int, tmp_path: Path):
    begin(phone(visit), film(tmp_path), worn="on")
    for role, links in (("reader", 0), ("reviewer", 2)):
        page = web.client(role=role).get(f"/visits/{visit}").text
        assert "none of their logs" in page
        assert page.count(f"/visits/{visit}/upload") == links


def test_logs_of_wearable_sensors_are_one_set(visit: int, tmp_path: Path):
    """As on the page of a visit: one that is refused is named, the others stay, and a set is a decision."""
    browser, none = phone(visit), tmp_path / "none.csv"
    none.write_text("frame,x\n1,2\n")
    logs = [Swing(phase=i).write(tmp_path / f"{name}.csv") for i, name in enumerate(("right shank", "left thigh"))]

    def sent(*files: Path, segment: str = "", what: str = "worn", **headers: str) -> Any:
        parts = [(what, (f.name, f.read_bytes())) for f in files] or {"worn": ("", b"")}
        return browser.post("/phone/sensors.json", data={"segment": segment}, files=parts, headers=headers)

    def told(*files: Path, segment: str = "", language: str = "en") -> dict[str, tuple[bool, str]]:
        answer = sent(*files, segment=segment, **{"accept-language": language})
        assert answer.status_code == 200, answer.text
        return {one["name"]: (one["taken"], one["said"]) for one in answer.json()["outcomes"]}

    both = ", ".join(log.name for log in logs)
    assert "without a recording" in told(*logs)[both][1]
    send(browser, film(tmp_path))
    found = told(none, *logs)
    assert (found[none.name][0], found[both][0], len(found)) == (False, True, 2)
    assert "no known format" in found[none.name][1]
    assert "right shank" in found[both][1]
    decision = Decision.fetch1()
    assert (decision["decision_what"], decision["decision_by"]) == ("sensors", "R. Viewer")
    assert (decision["decision_after"], decision["decision_about"]) == (
        {"sensors": ["shank_r", "thigh_l"]},
        {"phone_link": 1},
    )
    taken, said = told(*logs, segment="foot_r")[both]
    assert (taken, "one of them twice" in said, all(log.name in said for log in logs)) == (False, True, True)
    assert "in keinem bekannten Format" in told(none, language="de")[none.name][1]
    assert told(language="de") == {"": (False, "Keine Datei. Die Protokolle wählen, alle zusammen.")}
    assert "registered before" in told(*logs)[both][1]
    assert {str(name) for name in video.WearableImu.to_arrays("imu_name")} == {log.name for log in logs}
    refused = [sent(*logs, what="files"), sent(*logs, segment="knee"), sent(*logs, origin="https://evil.example")]
    assert [answer.status_code for answer in refused] == [415, 415, 403]
    assert (len(video.Video()), len(Decision())) == (1, 1)
    assert not list((tmp_path / "archive").rglob("browser-*"))


def test_a_form_of_logs_is_bounded_and_is_of_a_link_that_lasts(
    visit: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its bytes are counted as they come; a link that ended meanwhile attaches nothing."""
    browser, sent = phone(visit), [("worn", (f"{i}.csv", b"x" * 60_000)) for i in range(2)]
    with monkeypatch.context() as patch:
        patch.setattr(registration, "LARGEST_LOG", 100_000)
        answer = browser.post("/phone/sensors.json", files=sent, headers={"accept-language": "de"})
    assert (answer.status_code, code(answer)) == (422, "UPLOAD_REFUSED")
    assert answer.json()["error"]["found"] == "Protokolle von mehr als 0 MB"
    assert not list((tmp_path / "archive").rglob("browser-*"))
    phone_recordings.end_link(visit, 1)
    to = browser_uploads.Place(visit, "P001", "2026-01-10", "R. Viewer", 1)
    refused("PHONE_LINK", browser_uploads.register, to, [], Sensors(), "", "")


def test_room_is_promised_while_a_recording_without_its_row_is_in_the_archive(visit: int, tmp_path: Path):
    """Its log beside it could be that of a registered one: the tables know, and no thread of files asks them."""
    target = tmp_path / "archive" / "P001" / "2026-01-10" / "0123-walk.mp4"
    note_placed(tmp_path / "archive", target)
    target.parent.mkdir(parents=True)
    for ending in (".mp4", ".mov", ".json"):
        target.with_suffix(ending).touch()
    assert send(phone(visit), film(tmp_path))["state"] == "received"


def test_a_database_that_goes_away_before_the_question_is_not_running(visit: int, faults: Faults):
    browser = phone(visit)
    refused = "Can't connect to MySQL server on '127.0.0.1' ([Errno 111] Connection refused)"
    faults(tables_version, "refuse_newer", OperationalError(2003, refused))
    answer = browser.get("/phone/state.json")
    assert (answer.status_code, code(answer)) == (503, "DB_NOT_RUNNING")


@pytest.mark.parametrize("whole", [True, False])
def test_a_server_that_is_killed_at_the_end_leaves_no_parts(
    visit: int, tmp_path: Path, killed_at_the_end: Killed, whole: bool
):
    """The phone, which got no answer, asks again."""
    browser, sent = phone(visit), film(tmp_path) if whole else b"no video at all" * 1000
    with killed_at_the_end():
        send(browser, sent)
    assert list((tmp_path / "archive" / "_phone").rglob("0"))
    assert begin(browser, sent)["state"] == ("received" if whole else "refused")
    assert not list((tmp_path / "archive" / "_phone").rglob("*"))


def test_no_part_takes_the_room_that_is_kept_free(visit: int, tmp_path: Path, limits: Limits):
    browser, whole = phone(visit), film(tmp_path)
    told = begin(browser, whole)
    with limits(incoming, KEPT_FREE=10**18):
        answer = put(browser, told["number"], 0, parts_of(whole)[0], len(whole))
        assert (answer.status_code, code(answer)) == (507, "FILE_UNWRITABLE")
        to = browser_uploads.place(visit)
        arriving = browser_uploads.Arriving(to, "walk.mp4")
        with pytest.raises(OSError, match="kept free"):
            arriving.write(b"a piece, whatever length was announced")
        arriving.discard()
    assert begin(browser, whole)["missing"] == list(range(len(parts_of(whole))))
    assert send(browser, whole)["state"] == "received"


def test_parts_of_a_recording_that_did_not_go_on_give_their_room_back(visit: int, tmp_path: Path):
    browser, whole, other = phone(visit), film(tmp_path), film(tmp_path, "other")
    for one in (whole, other):
        put(browser, begin(browser, one)["number"], 0, parts_of(one)[0], len(one))
    old, new = sorted((tmp_path / "archive" / "_phone" / "P001").iterdir())
    week_ago = time.time() - 8 * 86_400
    for path in (old / "0", old):
        os.utime(path, times=(week_ago, week_ago))
    done = CliRunner().invoke(cron, ["release"])
    assert "removed 1 recordings" in done.output
    assert (old.exists(), new.exists()) == (False, True)
    assert send(browser, whole)["state"] == "received"  # the phone has it still


def test_the_size_of_a_part_is_that_of_the_page(visit: int):
    page = phone(visit).get("/phone").text
    assert f'data-part="{PART_BYTES}"' in page


def test_a_picture_is_looked_at_while_filming(visit: int, stand_in: StandIn):
    """The networks have their own test; here, who is answered, and what is refused."""
    seen = []
    looks = SimpleNamespace(cut_off=lambda image: seen.append(image.shape) or framing.FEET)
    stand_in(Framing=lambda: looks)
    picture = cv2.imencode(".jpg", np.zeros((90, 160, 3), np.uint8))[1].tobytes()
    jpeg, path = {"content-type": "image/jpeg"}, "/phone/look.json"
    browser = phone(visit)
    assert browser.post(path, content=picture, headers=jpeg).json() == {"cut": "feet"}
    assert seen == [(90, 160, 3)]
    for content, headers in (
        (b"", jpeg),
        (b"text", jpeg),
        (picture, {"content-type": "image/png"}),
        (bytes(300_000), jpeg),
    ):
        assert browser.post(path, content=content, headers=headers).status_code in (400, 413, 415)
    assert stranger().post(path, content=picture, headers=jpeg).status_code in (401, 403)
    assert web.client(target=nothing).post(path, content=picture, headers=jpeg).status_code == 403

    tried = []

    def absent() -> None:
        tried.append(1)
        raise PblError("ASSET_MISSING", "no network", "one", "connect")

    stand_in(Framing=absent)
    browser = phone(visit)
    for _ in range(2):  # a network that cannot be fetched is not fetched at each look
        assert browser.post(path, content=picture, headers=jpeg).json() == {"cut": None}
    assert (len(seen), len(tried)) == (1, 1)
