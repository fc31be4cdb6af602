"""Registering in the browser: a visit, its recordings and what is stated of them, from the form to the row."""

import asyncio
import errno
import os
import re
import weakref
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pymysql
import pytest
from datajoint.storage import StorageBackend

from pbl_pipeline import texts
from pbl_pipeline.names import HEIGHT_M, MASS_KG
from pbl_pipeline.sensors import SEGMENTS, read_samples
from pbl_schemas import lab, session, study, video
from pbl_schemas.operations.archive import remove_unfinished, unfinished
from pbl_schemas.reading.shown import shown_visit
from pbl_schemas.reading.visit_list import STATES, Filter, visit_page
from pbl_schemas.review import Decision
from pbl_schemas.studies.visit_forms import FACTS, NEW, facts_form
from pbl_workers import browser_uploads, refresh
from pbl_workers.populate import populate
from pbl_workers.web import multipart
from tests import Environment, Faults
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import everything, register
from tests.worn_sensor import Swing

VISIT = {"subject": "P001", "visit": "2026-01-10"}


@pytest.fixture(autouse=True)
def archive(tables: None, tmp_path: Path, environment: Environment) -> Path:
    environment(PBL_ARCHIVE=tmp_path / "archive")
    return tmp_path / "archive"


def new(browser: Any, **values: str):
    return web.post(browser, "/visits/new", **{**VISIT, **values})


def correct(browser: Any, number: int | str = 1, seen: str = "", **values: str):
    return web.post(browser, f"/visits/{number}/facts", seen=seen or facts_form(int(number)).seen, **values)


def upload(browser: Any, *files: Path | tuple[str, bytes], number: int | str = 1, **values: str):
    given = [(f.name, f.read_bytes()) if isinstance(f, Path) else f for f in files]
    fields = {"token": web.token(browser), "activity": "walking", "pace": "", **values}
    parts = [("files", file) for file in given]
    return browser.post(f"/visits/{number}/upload", data=fields, files=parts, follow_redirects=False)


def decided() -> list[tuple[str, object, object]]:
    rows = Decision().to_dicts(order_by="decision_id")
    return [(r["decision_what"], r["decision_before"].get("value"), r["decision_after"].get("value")) for r in rows]


# ------------------------------------------------------------------------------------------------------------- a visit
def test_a_visit_is_registered_with_its_person(archive: Path):
    browser = web.client(name="A. First")
    assert "/visits/new" in browser.get("/visits").text
    answer = new(browser, role="baseline", height_m="1,72", population="patient")
    assert (answer.status_code, answer.headers["location"]) == (303, "/visits/1")
    assert (lab.Subject & VISIT).fetch1("population", "subject_height") == ("patient", 1.72)
    assert str(session.Session.fetch1("session_date")) == "2026-01-10"
    assert study.Visit.fetch1("visit_role") == "baseline"
    assert decided() == [("visit", None, None), ("height", None, 1.72)]
    assert {r["decision_by"] for r in Decision().to_dicts()} == {"A. First"}
    page = browser.get("/visits/1")
    assert page.status_code == 200
    assert "/visits/1/upload" in page.text
    # The next visit of the person, of the same height, by a label and a day in the German form.
    assert (
        new(browser, visit="after surgery", date="9.3.2026", role="6_weeks", height_m="1.720").headers["location"]
        == "/visits/2"
    )
    assert str((session.Session & {"session_id": 2}).fetch1("session_date")) == "2026-03-09"
    assert [what for what, _, _ in decided()] == ["visit", "height", "visit"]


@pytest.mark.parametrize(
    ("values", "field", "code"),
    [
        ({"subject": ""}, "subject", "SHEET_FORMAT"),
        ({"subject": "Anna Müller"}, "subject", "USAGE"),
        ({"subject": "P" * 33}, "subject", "USAGE"),
        ({"visit": " "}, "visit", "SHEET_FORMAT"),
        ({"visit": "x" * 65}, "visit", "USAGE"),
        ({"visit": "first", "date": "03/09/2026"}, "date", "SHEET_FORMAT"),
        ({"visit": "first", "date": "31.2.2026"}, "date", "SHEET_FORMAT"),
        ({"role": "After Surgery"}, "role", "SHEET_FORMAT"),
        ({"role": "x" * 33}, "role", "SHEET_FORMAT"),
        ({"height_m": "172"}, "height_m", "FIT_INPUT"),
        ({"height_m": "0"}, "height_m", "FIT_INPUT"),
        ({"height_m": "tall"}, "height_m", "SHEET_FORMAT"),
        ({"height_m": "nan"}, "height_m", "SHEET_FORMAT"),
        ({"height_m": "1,720"}, "height_m", "SHEET_FORMAT"),
        ({"height_m": "9" * 500}, "height_m", "FIT_INPUT"),
        ({"population": "x" * 33}, "population", "USAGE"),
        *(({"visit": text}, "visit", "SHEET_FORMAT") for text in ("9/3/2026", "28.11.26", "31.2.2026")),
    ],
)
@pytest.mark.parametrize("language", ["en", "de"])
def test_a_wrong_field_is_said_beside_it_and_keeps_what_was_typed(
    values: dict[str, str], field: str, code: str, language: str
):
    browser, before = web.client(), everything()
    browser.headers["accept-language"] = language
    given = {"role": "baseline", "height_m": "1.8", "population": "healthy", **values}
    answer = new(browser, **given)
    assert answer.status_code == 200
    page = answer.text
    assert page.count("aria-invalid") == 1
    at = page.index('aria-invalid="true"')
    beside = page[page.rindex('<div class="one">', 0, at) : page.index("</div>", at)]
    assert f'id="{field}"' in beside
    assert code in beside
    assert ('lang="en"' in beside) is False  # said in the language of the page
    for name, text in {**VISIT, **given}.items():
        assert f'name="{name}" value="{text}"' in page
    assert everything() == before


def test_a_visit_is_registered_once_and_codes_that_are_alike_are_asked_about():
    browser = web.client()
    asked = "resembles another one"
    assert asked not in browser.get("/visits/new").text
    assert new(browser).status_code == 303
    before = everything()
    again = new(browser).text
    assert "SHEET_CONFLICT" in again
    assert 'id="visit"' in again
    assert asked not in again
    alike = new(browser, subject="p1")
    assert alike.status_code == 200
    assert "the codes p1 and P001" in alike.text
    assert asked in alike.text
    assert "--" not in re.sub(r"<!--|-->", "", alike.text)
    assert everything() == before
    assert new(browser, subject="p1", distinct="yes").status_code == 303


@pytest.mark.parametrize(
    ("language", "empty", "none"),
    [("en", "No visits yet.", "No visit matches."), ("de", "Noch keine Termine.", "Kein Termin passt.")],
)
def test_an_empty_list_says_what_comes_first(language: str, empty: str, none: str):
    browser = web.client()
    browser.headers["accept-language"] = language
    assert empty in browser.get("/visits").text
    assert none in browser.get("/visits?state=failed").text
    new(browser)
    assert none in browser.get("/visits?state=failed").text


@pytest.mark.parametrize(("language", "anew"), [("en", "being computed anew"), ("de", "wird neu berechnet")])
def test_the_index_stays_while_that_with_an_added_recording_is_computed(tmp_path: Path, language: str, anew: str):
    register(small_video(tmp_path, "one"), session_label="2026-01-10")
    populate()
    index = f'<span class="big">{shown_visit(1).results[0].index:.1f}'.replace(".", "," if language == "de" else ".")
    browser = web.client()
    browser.headers["accept-language"] = language
    assert anew not in browser.get("/visits/1").text
    register(small_video(tmp_path, "two"), session_label="2026-01-10")
    populate(["VideoInfo", "Tracking", "SubjectChoice", "Keypoints", "TrialInput"])
    populate(["SessionFit"])
    page = browser.get("/visits/1").text
    assert anew in page
    assert index in page
    # Not one of which a recording does not count any more.
    fields = web.form_of(browser, "/recordings/1", "/recordings/1/usable")
    web.post(browser, "/recordings/1/usable", **fields, usable="no", reason="interrupted")
    populate(["TrialInput"])
    assert shown_visit(1).earlier is None
    assert anew not in browser.get("/visits/1").text
    populate()
    assert anew not in browser.get("/visits/1").text


@pytest.mark.parametrize("language", ["en", "de"])
def test_a_day_typed_as_the_label_is_the_day(language: str):
    browser = web.client()
    browser.headers["accept-language"] = language
    assert new(browser, visit="28.11.2026").status_code == 303
    visit = session.Session.fetch1()
    assert (visit["session_label"], str(visit["session_date"])) == ("2026-11-28", "2026-11-28")
    assert 'id="visit"' in new(browser, visit="28.11.2026").text  # the same visit again is refused
    assert new(browser, visit="8.12.2026").headers["location"] == "/visits/2"
    assert "2026-12-08" in browser.get("/visits").text


def test_a_day_that_is_missing_is_stated_on_the_page():
    browser = web.client(name="A. First")
    new(browser, visit="before surgery", role="pre")
    new(browser, visit="2026-04-01", role="6_weeks")
    assert 'name="date"' not in browser.get("/visits/2/facts").text  # its label is the day
    browser.headers["accept-language"] = "de"
    assert "ohne Tag" in browser.get("/visits").text
    page = browser.get("/visits/1/facts").text
    assert 'name="date" value=""' in page
    assert "Tag des Termins" in page
    for wrong, code in (("03/09/2026", "SHEET_FORMAT"), ("1.5.2026", "SHEET_CONFLICT")):  # pre after 6 weeks
        refused = correct(browser, date=wrong)
        assert refused.status_code == 200
        assert code in refused.text, refused.text
    assert (session.Session & {"session_id": 1}).fetch1("session_date") is None
    assert correct(browser, date="9.3.2026").status_code == 303
    assert str((session.Session & {"session_id": 1}).fetch1("session_date")) == "2026-03-09"
    assert decided()[-1] == ("date", None, "9.3.2026")
    assert "Tag des Termins" in browser.get("/visits/1").text
    assert 'value="2026-03-09"' in browser.get("/visits/1/facts").text
    assert correct(browser, date="").status_code == 200  # a day is corrected, not removed


def test_a_second_visit_of_a_role_is_taken_and_said():
    browser = web.client()
    new(browser, role="pre")
    assert "same role" not in browser.get("/visits/1").text
    assert new(browser, visit="2026-01-20", role="pre").status_code == 303
    assert study.Visit().to_arrays("visit_role").tolist() == ["pre", "pre"]
    assert "Another visit of this person has the same role" in browser.get("/visits/2").text
    german = browser.get("/visits/2", headers={"accept-language": "de"}).text
    assert "Ein anderer Termin dieser Person hat dieselbe Rolle" in german


def test_a_visit_without_recordings_is_not_being_computed(tmp_path: Path):
    browser = web.client()
    new(browser)
    register(small_video(tmp_path, "walk", n=30), session_label="2026-02-01")
    by_state = {s: [v.session_id for v in visit_page(Filter(state=s)).visits] for s in STATES}
    assert {s: n for s, n in by_state.items() if n} == {"pending": [2], "unrecorded": [1]}
    for language, words, wrong in (
        ("en", "no recordings yet", "being computed or queued"),
        ("de", "noch keine Aufnahmen", "in Arbeit oder in der Warteschlange"),
    ):
        page = browser.get("/visits/1", headers={"accept-language": language}).text
        heading = page[page.index("<h1>") : page.index("<h2>")]
        assert words in heading
        assert wrong not in heading


def test_a_visit_with_an_index_is_not_headed_failed(tmp_path: Path):
    register(small_video(tmp_path, "walk"), session_label="2026-02-01")
    populate()
    gone = small_video(tmp_path, "gone")
    register(gone, session_label="2026-02-01")
    gone.unlink()
    populate()
    (row,) = visit_page(Filter()).visits
    assert row.result is not None
    assert row.result.index is not None
    assert (row.state, row.problem) == ("computed", "VIDEO_MISSING")
    assert [s for s in STATES if visit_page(Filter(state=s)).visits] == ["computed", "failed"]  # it is found by both
    browser = web.client()
    for language, words, failed in (
        ("en", "computed, but a part failed", ">failed"),
        ("de", "berechnet, aber ein Teil ist fehlgeschlagen", ">fehlgeschlagen"),
    ):
        for address in ("/visits/1", "/visits"):
            page = browser.get(address, headers={"accept-language": language}).text
            assert words in page
            heading = page[page.index("<h1>") :].partition("<h2>" if address != "/visits" else "</h1>")[0]
            assert failed not in heading


def test_roles_against_their_days_are_refused_as_those_of_a_sheet():
    browser = web.client()
    new(browser, role="baseline")
    answer = new(browser, visit="2025-12-01", role="6_weeks")
    assert answer.status_code == 200
    assert "roles in the order of their dates" not in answer.text  # found and next step are said
    assert "role 6_weeks on 2025-12-01" in answer.text
    assert len(session.Session()) == 1


# ------------------------------------------------------------------------------------------------- what is stated of it
def test_what_is_stated_is_corrected_with_what_was_before(tmp_path: Path):
    browser = web.client(name="A. First")
    new(browser, role="baseline", height_m="1.8")
    upload(browser, small_video(tmp_path, "walk", n=30))
    answer = correct(
        browser, height_m="1,72", mass_kg="71,5", population="patient", assistive_device="cane", orthosis="none",
        reason="measured again", **{"activity:1": "tug", "pace:1": "fast"},
    )  # fmt: skip
    assert (answer.status_code, answer.headers["location"]) == (303, "/visits/1")
    assert lab.Subject.fetch1("subject_height", "population") == (1.72, "patient")
    assert session.BodyMass.fetch1("body_mass") == 71.5
    assert study.Visit.fetch1("assistive_device", "orthosis", "visit_role") == ("cane", "none", "baseline")
    condition = video.conditions({"video_id": 1})[1]
    assert (condition.activity, condition.pace) == ("tug", "fast")
    rows = {what: (before, after) for what, before, after in decided()}
    assert rows["height"] == (1.8, 1.72)
    assert rows["mass"] == (None, 71.5)
    assert rows["aid"] == (None, "cane")
    assert rows["activity"] == ("walking", "tug")
    page = browser.get("/visits/1").text
    assert "measured again" in page
    assert "71.5" in page
    browser.headers["accept-language"] = "de"
    german = browser.get("/visits/1").text
    assert "1,72" in german
    assert "Timed Up and Go" in german[german.index("measured again") :]
    assert all(f'value="{v}"' in browser.get("/visits/1/facts").text for v in ("1,72", "71,5"))
    # The same again changes nothing; an empty field removes.
    n = len(Decision())
    assert correct(browser, height_m="1.720", mass_kg="71.5").status_code == 303
    assert len(Decision()) == n
    assert correct(browser, height_m="", mass_kg="", orthosis="").status_code == 303
    assert lab.Subject.fetch1("subject_height") is None
    assert len(session.BodyMass()) == 0
    assert study.Visit.fetch1("orthosis", "assistive_device") == ("", "cane")


@pytest.mark.parametrize(("name", "bounds"), [("height_m", HEIGHT_M), ("mass_kg", MASS_KG)])
def test_the_hint_of_a_field_states_the_bounds_of_the_library(name: str, bounds: tuple[float, float]):
    low, high = (f"{b:g}" for b in bounds)
    assert f"{low} to {high}" in texts.text("en", f"expects.{name}")
    assert f"{low} bis {high}".replace(".", ",") in texts.text("de", f"expects.{name}")


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ({"height_m": "172"}, "FIT_INPUT"),
        ({"height_m": "1_7"}, "SHEET_FORMAT"),
        ({"mass_kg": "4"}, "FIT_INPUT"),
        ({"mass_kg": "1e9"}, "FIT_INPUT"),
        ({"mass_kg": "heavy"}, "SHEET_FORMAT"),
        ({"mass_kg": "inf"}, "SHEET_FORMAT"),
        ({"population": "x" * 33}, "USAGE"),
        ({"assistive_device": "x" * 65}, "USAGE"),
        ({"orthosis": "x" * 65}, "USAGE"),
        ({"activity:1": "x" * 33}, "USAGE"),
        ({"pace:1": "x" * 33}, "USAGE"),
    ],
)
def test_a_wrong_statement_is_said_beside_its_field(tmp_path: Path, values: dict[str, str], code: str):
    browser = web.client()
    new(browser, role="baseline")
    register(small_video(tmp_path, "walk", n=30), session_label=VISIT["visit"])
    before = everything()
    answer = correct(browser, **{"population": "patient", **values})
    assert answer.status_code == 200
    assert code in answer.text
    (text,) = values.values()
    assert f'value="{text}"' in answer.text
    assert everything() == before


def test_an_aid_asks_for_the_role_of_the_visit():
    browser = web.client()
    new(browser)
    answer = correct(browser, assistive_device="cane", height_m="1.7")
    assert answer.status_code == 200
    assert "SHEET_FORMAT" in answer.text
    assert lab.Subject.fetch1("subject_height") is None


def test_the_second_of_two_and_forged_forms_change_nothing(tmp_path: Path):
    browser, reader = web.client(name="A. First"), web.client(role="reader")
    new(browser)
    seen = facts_form(1).seen
    assert correct(browser, height_m="1.7").status_code == 303
    before = everything()
    late = correct(web.client(name="B. Second"), seen=seen, height_m="1.8")
    assert late.status_code == 409
    assert "A. First changed the height" in late.text
    assert correct(browser, **{"nothing'--": "x"}).status_code == 400
    assert correct(browser, 999, seen="x").status_code == 404
    assert correct(reader, height_m="1.8").status_code == 403
    assert new(reader, visit="x").status_code == 403
    assert reader.get("/visits/1/facts").status_code == 200
    assert reader.get("/visits/1/upload").status_code == 403
    assert upload(reader, small_video(tmp_path, "walk", n=30)).status_code == 403
    assert everything() == before


# ---------------------------------------------------------------------------------------------------------- recordings
def test_recordings_are_taken_into_the_archive_and_queued(tmp_path: Path, archive: Path):
    browser = web.client(name="A. First")
    new(browser)
    first, second = (small_video(tmp_path, name, n=30 + i) for i, name in enumerate(("walk", "fast walk")))
    answer = upload(browser, first, second, activity="walking", pace="fast")
    assert (answer.status_code, answer.headers["location"]) == (303, "/visits/1")
    rows = video.Video().to_dicts(order_by="video_id")
    for row, sent in zip(rows, (first, second), strict=True):
        assert row["video_path"].startswith(f"{archive}/P001/2026-01-10/")
        assert Path(row["video_path"]).read_bytes() == sent.read_bytes()
    assert {c.pace for c in video.conditions(video.Video().proj()).values()} == {"fast"}
    assert decided().count(("recording", None, None)) == 2
    page = browser.get("/visits/1").text
    assert "Compute now" in page
    assert re.search(r">walk-[0-9a-f]{8}\.mp4</a>", page)
    assert ">registered<" not in page  # the word of the row
    assert not list(archive.rglob("browser-*"))
    # The same again is not stored twice.
    again = upload(browser, first)
    assert "was registered before" in again.text
    assert len(video.Video()) == 2
    # With the phone's log beside it, that is added: where the check of the vertical sends a reader.
    log = "time_s,qw,qx,qy,qz\n" + "".join(f"{0.02 * i},1,0,0,0\n" for i in range(200))
    upload(browser, first, ("walk.csv", log.encode()))
    (kept,) = video.PhoneAttitude().to_dicts()
    assert (kept["video_id"], kept["attitude_n"], len(video.Video())) == (rows[0]["video_id"], 200, 2)
    assert kept["attitude_size"] == len(log)


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("IMG_0001.HEIC", b"\0" * 500, "UPLOAD_REFUSED"),
        ("notes.txt", b"text", "UPLOAD_REFUSED"),
        ("noending", b"text", "UPLOAD_REFUSED"),
        ("walk.mp4", b"", "VIDEO_EMPTY"),
        ("walk.mp4", b"no video at all" * 50, "VIDEO_NOT_A_VIDEO"),
        ("walk.json", b"{}", "UPLOAD_REFUSED"),
    ],
)
def test_what_is_no_recording_is_named_and_leaves_nothing(archive: Path, name: str, content: bytes, code: str):
    browser = web.client()
    new(browser)
    before = everything()
    answer = upload(browser, (name, content))
    assert answer.status_code == 200
    assert code in answer.text
    assert ("This is a photo" in answer.text) == name.endswith("HEIC")
    assert everything() == before
    assert not [p for p in archive.rglob("*") if p.is_file()]


@pytest.mark.parametrize("values", [{"activity": "x" * 300}, {"activity": "two\nlines"}, {"pace": "x" * 33}])
def test_a_wrong_statement_of_an_upload_takes_nothing(tmp_path: Path, archive: Path, values: dict[str, str]):
    browser = web.client()
    new(browser)
    before = everything()
    answer = upload(browser, small_video(tmp_path, "walk", n=30), **values)
    assert answer.status_code == 200
    assert "USAGE" in answer.text
    assert everything() == before
    assert not [p for p in archive.rglob("*") if p.is_file()]


@pytest.mark.parametrize("queued", [True, False])
def test_a_good_file_beside_a_bad_one_is_taken(tmp_path: Path, faults: Faults, queued: bool):
    """Also where only the queue fails: what is registered is found by the next look at all tables."""
    browser = web.client()
    new(browser)
    if not queued:
        faults(refresh, "refresh_scope", pymysql.err.OperationalError(1114, "The table is full"))
    answer = upload(browser, ("../../etc/passwd", b"x"), small_video(tmp_path, "walk", n=30), pace="slow")
    assert answer.status_code == 200
    assert "UPLOAD_REFUSED" in answer.text
    assert ">walk.mp4</a>: registered" in answer.text
    assert '<a href="/visits/1">Go on to the visit' in answer.text
    assert '<option value="slow" selected>' in answer.text
    assert len(video.Video()) == 1
    assert "Go on to the visit" not in upload(browser, ("a.mp4", b"x")).text  # nothing arrived
    assert upload(browser).status_code in (200, 415)  # nothing was chosen


def test_no_file_is_written_without_the_token_of_the_session(tmp_path: Path, archive: Path):
    browser = web.client()
    new(browser)
    film = small_video(tmp_path, "walk", n=30)
    for token in ("", "x"):
        assert upload(browser, film, token=token).status_code == 403
    assert upload(browser, film, number=9).status_code == 404
    broken = {"content-type": "multipart/form-data; boundary=b"}
    for body in (b"", b"--b\r\n", b"--b\r\nx: y\r\n\r\nz\r\n--b--", b"--b\r\n" + b"x" * 9999, b"--b--\r\n"):
        assert browser.post("/visits/1/upload", content=body, headers=broken).status_code in (403, 415), body
    assert not archive.exists() or not [p for p in archive.rglob("*") if p.is_file()]
    assert len(video.Video()) == 0


@pytest.mark.parametrize("step", [1, 2, 7, 64, 10_000])
def test_a_form_with_files_is_read_the_same_in_pieces_of_any_length(step: int):
    content = b"\r\n--b" + bytes(range(256)) * 3 + b"\r\n--"
    token = b'--bound\r\nContent-Disposition: form-data; name="token"\r\n\r\nabc\r\n'
    named = 'name="files"; filename="a \u00e4.mp4"'.encode()
    file = b"--bound\r\nContent-Disposition: form-data; " + named + b"\r\nContent-Type: video/mp4\r\n\r\n" + content
    body = b"ignored\r\n" + token + file + b"\r\n--bound--\r\n"

    class Sent:
        headers = {"content-type": "multipart/form-data; boundary=bound"}  # noqa: RUF012

        async def stream(self):
            for i in range(0, len(body), step):
                yield body[i : i + step]

    async def read() -> list[Any]:
        return [found async for found in multipart.parts(Sent())]  # type: ignore[arg-type]

    found: dict[Any, bytes] = {}
    last = None
    with ThreadPoolExecutor(1) as pool:  # a browser test before this one has a loop in this thread
        pieces = pool.submit(asyncio.run, read()).result()
    for one in pieces:
        if isinstance(one, bytes):
            found[last] += one
        else:
            last, found[one] = one, b""
    assert found == {multipart.Part("token", None): b"abc", multipart.Part("files", "a \u00e4.mp4"): content}


def test_each_form_is_also_json():
    browser = web.client()
    new(browser, height_m="1.7")
    assert set(browser.get("/visits/new.json").json()["values"]) == {*NEW, "height_m", "distinct"}
    assert set(FACTS) <= set(browser.get("/visits/1/facts.json").json()["values"])
    assert browser.get("/visits/1/upload.json").json()["to"]["subject"] == "P001"


def test_logs_of_wearable_sensors_go_with_the_visit(tmp_path: Path, archive: Path):
    """A log that cannot be taken is named with its own words, beside one that is; all are of one visit."""
    browser, names = web.client(name="A. First"), ("right shank.csv", "none.csv")
    new(browser)
    shank, none = (tmp_path / name for name in names)
    Swing().write(shank)
    none.write_text("frame,x\n1,2\n")

    def send(*files: Path, segment: str = "shank_r"):
        fields = {"token": web.token(browser), "segment": segment}
        parts = [("worn", (f.name, f.read_bytes())) for f in files]
        return browser.post("/visits/1/upload", data=fields, files=parts, follow_redirects=False)

    assert "without a recording" in send(shank).text
    assert upload(browser, small_video(tmp_path, "walk")).status_code == 303
    page = send(none, shank).text
    assert "no known format" in page
    assert "Choose at least one video" not in page
    assert f"{shank.name}: registered" in page
    page = send(shank, segment="thigh_l").text
    assert "sensors on left thigh" in page
    assert '<option value="thigh_l" selected>' in page
    assert '<option value="walking" selected>' in page
    assert "registered before" in send(shank, segment="thigh_l").text  # and nothing was decided
    (row,) = video.WearableImu.to_dicts()
    assert (row["imu_name"], row["imu_segments"]) == (shank.name, {"thigh_l": "right shank"})
    sensors = [one for one in Decision().to_dicts() if one["decision_what"] == "sensors"]
    assert [one["decision_after"] for one in sensors] == [{"sensors": ["shank_r"]}, {"sensors": ["thigh_l"]}]
    assert re.search(r"sensors added.*?left thigh", browser.get("/visits/1").text, re.DOTALL)
    assert send(shank, segment="knee").status_code == 415
    assert not list(archive.rglob("browser-*"))


def test_logs_of_one_form_are_of_one_recording(tmp_path: Path, archive: Path, faults: Faults):
    """Two on one segment are refused; new ones take the place of the old ones, with which they have no time in common;
    an error of this machine is not one of the files."""
    browser = web.client(name="A. First")
    new(browser)
    assert upload(browser, small_video(tmp_path, "walk")).status_code == 303

    def send(turn: int, segment: str = "", later_s: float = 0.0):
        files = []
        for i, name in enumerate(("right shank", "left thigh")):
            swing = Swing(phase=i + 2 * turn)
            table = swing.own()
            table["time_s"] += later_s
            files.append(("worn", (f"{name}.{turn}.csv", swing.write(tmp_path / f"{i}.csv", table).read_bytes())))
        fields = {"token": web.token(browser), "segment": segment}
        return browser.post("/visits/1/upload", data=fields, files=files, follow_redirects=False)

    assert "one of them twice" in send(0, "shank_r").text
    assert len(video.WearableImu()) == 0
    assert "sensors on right shank" in send(0).text
    with faults(StorageBackend, "put_buffer", OSError(errno.ENOSPC, "No space left on device")):
        assert send(1, later_s=9000.0).status_code == 507
    assert "was attached instead of right shank.0.csv" in send(1, later_s=9000.0).text
    names = {str(name) for name in video.WearableImu().to_arrays("imu_name")}
    assert names == {"right shank.1.csv", "left thigh.1.csv"}
    assert not list(archive.rglob("browser-*"))


def test_logs_alone_leave_the_folders_of_the_archive(tmp_path: Path, archive: Path):
    """An import, for which they do not wait, may have made one for what it moves there next."""
    browser = web.client(name="A. First")
    new(browser)
    assert upload(browser, small_video(tmp_path, "walk")).status_code == 303
    made = archive / "P001" / "next"
    made.mkdir()
    log = Swing().write(tmp_path / "right shank.csv").read_bytes()
    fields = {"token": web.token(browser), "segment": ""}
    page = browser.post("/visits/1/upload", data=fields, files={"worn": ("right shank.csv", log)}).text
    assert ("right shank.csv: registered" in page, made.is_dir()) == (True, True)


def test_many_logs_are_not_in_memory_together(tmp_path: Path, archive: Path, monkeypatch: pytest.MonkeyPatch):
    """Neither those that are refused nor those that are one too many; each has its name in the outcome."""
    browser, made, most = web.client(name="A. First"), [], 0
    new(browser)

    def counted(path: Path, *more: Any):
        nonlocal most
        samples = read_samples(path, *more)
        made.extend(weakref.ref(one) for one in samples)
        most = max(most, sum(one() is not None for one in made))
        return samples

    monkeypatch.setattr(browser_uploads, "samples_of", counted)
    names = [*(f"right shank {i}.csv" for i in range(12)), *(f"{i}.csv" for i in range(12))]
    logs = [Swing(seconds=3.0, phase=i).write(tmp_path / name) for i, name in enumerate(names)]
    parts = [("worn", (log.name, log.read_bytes())) for log in logs]
    fields = {"token": web.token(browser), "segment": ""}
    page = browser.post("/visits/1/upload", data=fields, files=parts).text
    assert ("one of them twice" in page, [name for name in names if name not in page]) == (True, [])
    assert most <= len(SEGMENTS) + 2  # with one that was just read


def test_a_log_of_any_ending_is_no_note_of_the_archive(tmp_path: Path, archive: Path):
    """Not while it arrives, and a note of another place removes nothing."""
    browser = web.client(name="A. First")
    new(browser)
    kept = tmp_path / "kept.txt"
    kept.write_text("kept")
    arriving = browser_uploads.Arriving(browser_uploads.place(1), "a.placed", worn=True)
    arriving.write(os.fsencode(kept))
    arriving.finish()
    (begun,) = unfinished(archive)
    assert (begun.path.suffix, begun.n_bytes) == ("", len(os.fsencode(kept)))
    for place in (kept, Path("../../kept.txt"), Path("1/../../../kept.txt"), Path("../kept.txt")):
        note = begun.path.parent / "walk.mp4.placed"
        note.write_bytes(os.fsencode(place))
        assert len(remove_unfinished(archive, days=-1.0)) in (1, 2)
        assert kept.exists()
        begun.path.parent.mkdir(parents=True, exist_ok=True)
    arriving.discard()
