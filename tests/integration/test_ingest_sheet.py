"""`pbl ingest --sheet`: every row or none, and what is refused."""

import datetime
import os
import re
import tempfile
from pathlib import Path

import av
import pymysql
import pytest

from pbl_pipeline import depth
from pbl_schemas import lab, session, video
from pbl_schemas.intake import videos
from pbl_schemas.intake.recording_sheet import COLUMNS, ingest_sheet
from pbl_schemas.intake.sheets import read_sheets
from tests import worn_sensor
from tests.command import pbl
from tests.rows import everything
from tests.worn_sensor import Swing

from . import chain

HEADER = "file,subject,visit,date,pace,activity,camera,camera_motion,population,project,height_m"


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with three videos and a calibration."""
    folder = tmp_path_factory.mktemp("recordings")
    for i, name in enumerate(("one", "two", "three")):
        chain.small_video(folder, name, n=30 + i)
    (folder / "copy.mp4").write_bytes((folder / "one.mp4").read_bytes())
    (folder / "empty.mp4").touch()
    text = (
        "[phone]\nsize = [128, 72]\nmatrix = [[100.0, 0, 64], [0, 100.0, 36], [0, 0, 1]]\ndistortions = [0, 0, 0, 0]\n"
    )
    (folder / "phone.toml").write_text(text, encoding="utf-8")
    return folder


def sheet(folder: Path, *rows: str, header: str = HEADER, name: str = "visits.csv") -> Path:
    path = folder / name
    path.write_text("\n".join((header, *rows)) + "\n", encoding="utf-8")
    return path


GOOD = (
    "one.mp4,P001,2026-03-01,,fast,,phone.toml,handheld,patient,spine,1.72",
    "two.mp4,P001,2026-03-01,,,tug,,,,,",
    "three.mp4,P002,first,2026-03-02,,,,,,,",
)


def test_a_sheet_registers_people_visits_pace_and_cameras_once(tables, recordings):
    path = sheet(recordings, *GOOD)
    before = everything()
    tried = pbl("ingest", "--sheet", path, "--dry-run")
    assert tried.code == 0, tried.err
    assert "visits.csv, row 2: one.mp4: new: P001/2026-03-01" in tried.out
    assert "3 videos would be registered, 0 known, 0 rows refused" in tried.out
    assert everything() == before
    done = pbl("ingest", "--sheet", path)
    assert done.code == 0, done.err
    assert "3 videos registered" in done.out
    registered = video.Video * session.Session.proj("subject", "session_label", "session_date")
    rows = registered.to_dicts(order_by="video_id")
    columns = ("subject", "session_label", "session_date", "activity", "camera_motion")
    assert [tuple(str(r[c]) for c in columns) for r in rows] == [
        ("P001", "2026-03-01", "2026-03-01", "walking", "handheld"),
        ("P001", "2026-03-01", "2026-03-01", "tug", "static"),
        ("P002", "first", "2026-03-02", "walking", "static"),
    ]
    assert video.conditions({"video_id": rows[0]["video_id"]})[rows[0]["video_id"]].pace == "fast"
    focal = (lab.CameraCalibration & {"camera_id": rows[0]["camera_id"]}).fetch1("camera_fx")
    assert focal == pytest.approx(100.0)
    person = (lab.Subject & {"subject": "P001"}).fetch1()
    assert (person["population"], person["project"], person["subject_height"]) == ("patient", "spine", 1.72)
    before = everything()
    again = pbl("ingest", "--sheet", path)
    assert "0 videos registered, 3 known, 0 rows refused" in again.out
    assert everything() == before


@pytest.mark.parametrize(
    ("row", "code", "words"),
    [
        ("nobody.mp4,P003,1,,,,,,,,", "VIDEO_MISSING", "nobody.mp4"),
        ("empty.mp4,P003,1,,,,,,,,", "VIDEO_EMPTY", "empty.mp4"),
        ("copy.mp4,P003,1,,,,,,,,", "SHEET_CONFLICT", "row 2"),
        ("three.mp4,Anna Meier,1,,,,,,,,", "USAGE", "pseudonymous"),
        ("three.mp4,p-1,1,,,,,,,,", "SHEET_CONFLICT", "P001"),
        (f"three.mp4,{'P' * 33},1,,,,,,,,", "USAGE", "subject"),
        (f"three.mp4,P003,{'x' * 65},,,,,,,,", "USAGE", "65 characters"),
        (f"three.mp4,P003,1,,,,,,{'x' * 33},,", "USAGE", "population"),
        ("one.mp4,P001,2026-03-02,,,,,,,,", "SHEET_CONFLICT", "row 2"),
        (",P003,1,,,,,,,,", "SHEET_FORMAT", "no file"),
        ("three.mp4,P003,,,,,,,,,", "SHEET_FORMAT", "no visit"),
        ("three.mp4,P003,1,03/02/2026,,,,,,,", "SHEET_FORMAT", "YYYY-MM-DD"),
        ("three.mp4,P001,2026-03-01,2026-03-09,,,,,,,", "SHEET_CONFLICT", "2026-03-09"),
        ("three.mp4,P002,first,2026-03-09,,,,,,,", "SHEET_CONFLICT", "two visits need two labels"),
        ("three.mp4,P001,2026-03-01,,,,,,healthy,,", "SHEET_CONFLICT", "patient"),
        ("three.mp4,P001,2026-03-01,,,,,,,,1.80", "SHEET_CONFLICT", "1.72"),
        ("three.mp4,P003,1,,,,,,,,1.7 m", "SHEET_FORMAT", "height_m"),
        ("three.mp4,P003,1,,,,,,,,172", "FIT_INPUT", "172"),
        ("three.mp4,P003,1,,,,,flying,,,", "SHEET_FORMAT", "static"),
        ("three.mp4,P003,1,,,,no.toml,,,,", "CAMERA_INVALID", "no.toml"),
    ],
)
def test_one_bad_row_and_nothing_is_registered(tables, recordings, row, code, words):
    second = "two.mp4,P002,first,2026-03-02,,,,,,,"
    path = sheet(recordings, GOOD[0], second, row, name="bad.csv")
    before = everything()
    for more in ((), ("--dry-run",)):
        done = pbl("ingest", "--sheet", path, *more)
        assert (done.code, done.error_code) == (1, code), done.err
        assert "bad.csv, row 4" in done.err
        assert words in done.err
        assert "not registered" in done.out
    assert everything() == before


def test_a_person_is_a_number_of_few_digits(tables, recordings):
    rows = [f"{name}.mp4,P003,1,{text}" for name, text in (("one", "9" * 5000), ("two", "0"), ("three", "x"))]
    done = pbl("ingest", "--sheet", sheet(recordings, *rows, header="file,subject,visit,person", name="people.csv"))
    assert (done.code, done.error_code) == (1, "SHEET_FORMAT")
    assert all(f"people.csv, row {n}" in done.err for n in (2, 3, 4))


def test_all_errors_of_all_rows_at_once(tables, recordings):
    """Wrong, empty, too long, out of range, of another language, twice, contradicting, of one row and of several."""
    long = [letter * n for letter, n in (("P", 33), ("v", 65), ("f", 33), ("a", 33), ("x", 33), ("y", 33))]
    subject, visit, pace, activity, population, project = long
    rows = {
        "nobody.mp4,Anna Meier,1,03/02/2026,,,,flying,,,1.7 m": "USAGE VIDEO_MISSING" + 3 * " SHEET_FORMAT",
        "empty.mp4,P003,,,,,,,,,": "SHEET_FORMAT VIDEO_EMPTY",
        "three.mp4,P003,1,,,,no.toml,,,,172": "FIT_INPUT CAMERA_INVALID",
        ",,,2.13.2026,,,,,,,": 4 * " SHEET_FORMAT",
        "one.mp4,P004,1,,,,,,,,1,72": "SHEET_FORMAT",
        f'one.mp4,{subject},{visit},,{pace},{activity},,,{population},{project},"1,234"': 6 * " USAGE"
        + " SHEET_FORMAT SHEET_CONFLICT",
        "two.mp4,P005,1,2026-03-01,,,,,healthy,a,1.70": "SHEET_CONFLICT",
        "copy.mp4,P005,1,2026-03-02,,,no.toml,,patient,b,1.80": "SHEET_CONFLICT " * 6 + "CAMERA_INVALID",
        "two.mp4,P006,2,30.2.2026,,,,,,,0": "SHEET_CONFLICT SHEET_FORMAT FIT_INPUT",
        "three.mp4,p5,3,,,,,,,,": "SHEET_CONFLICT " * 2,
    }
    before = everything()
    done = pbl("ingest", "--sheet", sheet(recordings, *rows, name="bad.csv"))
    where = [f"bad.csv, row {n}" for n in range(2, len(rows) + 2)]
    said = re.findall(r"^([A-Z_]+): .*\n  about: +(bad\.csv, row \d+)", done.err, re.MULTILINE)
    codes = {row: sorted(code for code, about in said if about == row) for row in where}
    assert codes == {row: sorted(expected.split()) for row, expected in zip(where, rows.values(), strict=True)}
    assert "12 cells under 11 columns" in done.err
    assert "0 videos not registered, 0 known, 10 rows refused" in done.out
    assert everything() == before


def test_days_and_decimals_in_the_german_form(tables, recordings):
    path = sheet(recordings, "one.mp4;P001;1;9.3.2026;1,72", header="file;subject;visit;date;height_m", name="de.csv")
    assert pbl("ingest", "--sheet", path).code == 0
    assert session.Session().fetch1("session_date") == datetime.date(2026, 3, 9)
    assert lab.Subject().fetch1("subject_height") == 1.72


def test_a_mass_is_that_of_a_visit(tables, recordings):
    header = "file;subject;visit;mass_kg"
    for rows, code in (
        (("one.mp4;P001;1;71", "two.mp4;P001;1;72"), "SHEET_CONFLICT"),
        (("one.mp4;P001;1;715",), "FIT_INPUT"),
    ):
        refused = pbl("ingest", "--sheet", sheet(recordings, *rows, header=header, name="bad.csv"))
        assert refused.error_code == code, refused.err
    two = ("one.mp4;P001;1;71,5", "two.mp4;P001;2;75", "three.mp4;P001;2;")
    assert pbl("ingest", "--sheet", sheet(recordings, *two, header=header)).code == 0
    masses = session.Session.proj("session_label") * session.BodyMass
    assert {r["session_label"]: r["body_mass"] for r in masses.to_dicts()} == {"1": 71.5, "2": 75.0}


def test_the_files_own_day_against_the_visits(tables, recordings):
    video_file = recordings / "dated.mp4"
    with av.open(str(recordings / "one.mp4")) as old, av.open(str(video_file), "w") as new:
        new.metadata["creation_time"] = "2026-03-09T20:00:00Z"
        stream = new.add_stream_from_template(old.streams.video[0])
        for packet in old.demux(video=0):
            if packet.dts is not None:
                packet.stream = stream
                new.mux(packet)
    for day, doubted in (("2026-03-09", False), ("2026-03-10", False), ("2026-03-08", True), ("2025-03-09", True)):
        path = sheet(recordings, f"dated.mp4,P001,{day}", header="file,subject,visit", name="days.csv")
        done = pbl("ingest", "--sheet", path, "--dry-run")
        assert done.code == 0, done.err
        assert ("dated.mp4 says that it was recorded on 2026-03-09" in done.err) == doubted


def test_the_template_is_a_sheet(tmp_path):
    assert pbl("ingest", "--template", tmp_path / "new.xlsx").code == 0
    (made,) = read_sheets(tmp_path / "new.xlsx")
    assert made.columns == COLUMNS
    assert pbl("ingest", "--template", tmp_path / "new.xlsx").error_code == "FILE_UNWRITABLE"


def test_other_columns_are_refused_whole(tables, recordings):
    before = everything()
    for header, words in (
        ("file,subject,visit,mJOA", "unknown column 'mJOA'"),
        ("file,subject", "file, subject, visit"),
        ("File,file,subject,visit", "columns"),
    ):
        done = pbl("ingest", "--sheet", sheet(recordings, "one.mp4,P001", header=header, name="columns.csv"))
        assert done.error_code == "SHEET_FORMAT"
        assert words in done.err
    assert pbl("ingest", "--sheet", sheet(recordings, header=HEADER, name="none.csv")).error_code == "SHEET_FORMAT"
    assert pbl("ingest", "--sheet", recordings / "absent.csv").error_code == "FILE_MISSING"
    assert everything() == before


def test_a_database_that_fails_in_the_middle_leaves_nothing(tables, recordings, faults):
    faults(videos.OneCamera, "insert", None, None, pymysql.err.OperationalError(2013, "the connection is gone"))
    with pytest.raises(pymysql.err.OperationalError, match="gone"):
        ingest_sheet(sheet(recordings, *GOOD))
    assert (len(video.Video()), len(session.Session()), len(lab.Subject())) == (0, 0, 0)


def test_what_a_row_states_is_no_option(tables, recordings):
    path = sheet(recordings, *GOOD)
    for words in (("--subject", "P001"), ("--pace", "fast"), (recordings / "one.mp4",)):
        assert pbl("ingest", "--sheet", path, *words).code == 2
    assert pbl("ingest", recordings / "one.mp4", "--subject", "P001", "--dry-run").code == 2


def test_a_recording_of_another_visit_or_person_is_named_with_the_way_out(tables, recordings):
    assert pbl("ingest", recordings / "one.mp4", "--subject", "P001", "--session", "1").code == 0
    for row, code in (("one.mp4,P001,2,", "SHEET_CONFLICT"), ("one.mp4,P009,1,", "VIDEO_DUPLICATE")):
        done = pbl("ingest", "--sheet", sheet(recordings, row, header="file,subject,visit", name="other.csv"))
        assert done.error_code == code, done.err
        assert "pbl move" in done.err


def test_depths_and_sensors_of_a_sheet(tables, recordings, monkeypatch: pytest.MonkeyPatch):
    """Paths are relative to the sheet; a visit's sensors may stand in each of its rows; nothing is left over."""
    chain.depth_pictures(recordings / "depth")
    several = {"Right Ankle": Swing(), "Right Thigh": Swing(phase=1)}
    worn_sensor.apdm(several, recordings / "apdm.csv")
    (recordings / "worn.csv").write_text("segment,file\nshank_r,apdm.csv\nthigh_r,apdm.csv\n")
    header = "file,subject,visit,depth,imu"
    wrong = {
        "1e-3=no": "FILE_MISSING",
        "1e-3=worn.csv": "DEPTH_FILE",
        "depth": "DEPTH_FILE",
        ",foot=apdm.csv": "USAGE",
        ",foot_r=no.csv": "FILE_MISSING",
        ",foot_r=apdm.csv": "USAGE",
    }
    rows = [f"one.mp4,P001,1,{cells}" for cells in wrong]
    told = pbl("ingest", "--sheet", sheet(recordings, *rows, header=header, name="wrong.csv"))
    assert told.code == 1
    said = re.findall(r"^([A-Z_]+): .*\n  about: +wrong\.csv, row (\d)", told.err, re.MULTILINE)
    assert said == [(code, str(n)) for n, code in enumerate(wrong.values(), 2)]
    assert len(video.Video()) == 0
    rows = ["one.mp4,P001,1,,shank_r=apdm.csv", "two.mp4,P001,1,,thigh_r=apdm.csv"]
    told = pbl("ingest", "--sheet", sheet(recordings, *rows, header=header, name="two.csv"))
    assert (told.error_code, "imu shank_r=apdm.csv and thigh_r=apdm.csv" in told.err) == ("SHEET_CONFLICT", True)
    # Copies of depths lie there one at a time; "none" is an empty cell, and paths are compared as what they lead to.
    chain.depth_pictures(recordings / "depth2")
    copies, pack = Path(tempfile.gettempdir()), depth.pack
    at_once: list[int] = []

    def counted(folder: Path, copy: Path) -> Path:
        assert not lab.schema.connection.in_transaction
        pack(folder, copy)
        at_once.append(len(list(copies.glob(f"pbl-tmp-{os.getpid()}-*/*.zip"))))
        return copy

    monkeypatch.setattr(depth, "pack", counted)
    rows = ['one.mp4,P001,1,"0,001=depth",worn.csv', "two.mp4,P001,1,0.001=depth2,./worn.csv"]
    rows.append("three.mp4,P001,1,none,none")
    told = pbl("ingest", "--sheet", sheet(recordings, *rows, header=header, name="paths.csv"), "--dry-run")
    assert told.code == 0, told.err
    assert at_once == [1, 1]
    rows = ['one.mp4,P001,1,"0,001=depth",worn.csv', "two.mp4,P001,1,none,worn.csv", "three.mp4,P002,1,,none"]
    path = sheet(recordings, *rows, header=header, name="beside.csv")
    for more, found in (("--dry-run",), 0), ((), 1):
        told = pbl("ingest", "--sheet", path, *more)
        assert told.code == 0, told.err
        assert len(video.DepthVideo()) == len(video.WearableImu()) == found
    assert "depth recording depth was attached" in told.out
    row = video.DepthVideo.fetch1()
    assert (row["video_id"], row["depth_name"], row["depth_scale"]) == (1, "depth", 0.001)
    row = video.WearableImu.fetch1()
    assert (row["video_id"], row["imu_segments"]) == (1, {"shank_r": "Right Ankle", "thigh_r": "Right Thigh"})
    assert at_once == [1, 1, 1, 1]  # once for each command
    again = pbl("ingest", "--sheet", path, "--dry-run").out
    assert again.count("left as it is, without the sensor files of this row") == 2
    assert not list(Path(tempfile.gettempdir()).glob(f"pbl-tmp-{os.getpid()}-*/*.zip"))
