"""A person who is forgotten leaves no row, no job and no file; everybody else stays."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from pbl_pipeline.depth import DepthFile
from pbl_schemas import connection, fit, keypoints, lab, session, video
from pbl_schemas.intake import Sensors, VisitRecord, ingest
from pbl_schemas.operations import forget
from pbl_schemas.operations.declare import declare_all
from pbl_workers.populate import populate
from tests import Environment, Faults
from tests.command import pbl
from tests.rows import everything_but_refreshes, register, remove_all

from . import chain


def camera(folder: Path, name: str, focal_px: float) -> Path:
    """A file with a lens."""
    path = folder / f"{name}.json"
    matrix = [[focal_px, 0, 64], [0, focal_px, 36], [0, 0, 1]]
    path.write_text(json.dumps({"camera_matrix": matrix, "distortion": [0] * 5, "image_size_px": [128, 72]}))
    return path


def stored() -> set[str]:
    """Every file of the store."""
    root = Path(connection.store_backend().spec["location"])
    return {str(p.relative_to(root)) for p in root.rglob("*") if p.is_file()}


@pytest.fixture
def two(database: Path, tmp_path: Path, stand_ins: None) -> Iterator[tuple[dict, set[str], list[Path]]]:
    """P001 alone through the chain; then P017 as well, with everything a person can have. What was there before P017,
    the files, and P017's videos."""
    declare_all()
    shutil.rmtree(Path(connection.store_backend().spec["location"]) / "_schema", ignore_errors=True)
    shared, own = camera(tmp_path, "shared", 900), camera(tmp_path, "own", 905)
    ingest([chain.small_video(tmp_path, "other")], VisitRecord(subject="P001", camera_file=shared))
    populate()
    rows, files = everything_but_refreshes(), stored()
    videos = [chain.small_video(tmp_path, "walk"), chain.small_video(tmp_path, "waits", people="two alike")]
    (tmp_path / "notes.mp4").write_text("not a video")
    videos.append(tmp_path / "notes.mp4")
    depth = Sensors(depth=DepthFile(chain.depth_pictures(tmp_path / "depth"), 0.001))
    numbers = [
        register(path, subject="P017", session_label="2026-03-01", camera_file=lens)[0]
        for path, lens in zip(videos, (own, shared, None), strict=True)
    ]
    assert len(lab.CameraCalibration()) == 2
    ingest(videos[:1], VisitRecord(subject="P017", session_label="2026-03-01"), files=[depth])
    populate()
    assert len(fit.SessionFit.Depth()) == 1
    # The queues have finished rows of this person, too; and a computation that was killed left a file without a row.
    number = numbers[0]
    _queue(video.VideoInfo, "error", number)
    _queue(keypoints.Keypoints, "pending", number)
    connection.store_backend().put_buffer(
        b"x", f"_schema/pbl_keypoints/__keypoints/video_id={number}/a=b/left_over.npz"
    )
    yield rows, files, videos
    remove_all()
    forget.manifest_path("P017").unlink(missing_ok=True)


def _queue(table: type, status: str, number: int | None) -> None:
    jobs = table.jobs  # type: ignore[attr-defined]
    key = {"video_id": number, "tracking_method": "m", "keypoint_method": "m"}
    row = {k: v for k, v in key.items() if k in jobs.primary_key} | {"status": status, "priority": 5}
    jobs.insert1(row, skip_duplicates=True)


def test_nothing_of_the_person_is_left_and_nothing_else_is_touched(
    two: tuple[dict, set[str], list[Path]], tmp_path: Path, environment: Environment
):
    rows, files, videos = two
    full, all_files = everything_but_refreshes(), stored()
    dry = pbl("forget", "P017", "--videos")
    assert dry.code == 0, dry.err
    assert "this is a dry run" in dry.out
    assert "left_over.npz" in dry.out
    for table in ("subject", "__session_fit", "~~video_info"):
        assert f".{table}\n" in dry.out
    assert everything_but_refreshes() == full
    assert stored() == all_files
    done = pbl("forget", "P017", "--yes")
    assert done.code == 0, done.err + done.out
    assert everything_but_refreshes() == rows
    assert stored() == files
    assert all(v.exists() for v in videos)
    # The proof names what went; folders whose names carried the person's numbers are gone as well.
    proof = json.loads(forget.manifest_path("P017").read_text())
    assert proof["state"] == "done"
    assert set(proof["files"]) == all_files - files
    assert proof["left"] == []
    root = Path(connection.store_backend().spec["location"])
    assert not list(root.rglob(f"video_id={proof['ids']['video_id'][0]}"))
    # Later the videos are to go as well, with what `pbl cron import` keeps; nothing else is left to do.
    archive = tmp_path / "archive"
    for path in ("P017/visit/ab-walk.csv", "P0171/visit/cd-walk.csv"):
        (archive / path).parent.mkdir(parents=True)
        (archive / path).write_text("log")
    environment(PBL_ARCHIVE=archive)
    again = pbl("forget", "P017", "--yes", "--videos")
    assert again.code == 0, again.err
    assert not any(v.exists() for v in videos)
    assert [p.name for p in archive.rglob("*")] == ["P0171", "visit", "cd-walk.csv"]
    assert everything_but_refreshes() == rows
    # Where numbers are given anew (a database that was rebuilt), the next person keeps what is theirs.
    lab.Numbered.delete(prompt=False)
    ingest([chain.small_video(tmp_path, "next")], VisitRecord(subject="P018"))
    assert set(video.Video.to_arrays("video_id")) & set(proof["ids"]["video_id"])
    populate()
    theirs, their_files = everything_but_refreshes(), stored()
    assert pbl("forget", "P017", "--yes", "--videos").code == 0
    assert everything_but_refreshes() == theirs
    assert stored() == their_files


def test_broken_off_it_is_repeated_until_done(two: tuple[dict, set[str], list[Path]], tmp_path: Path, faults: Faults):
    rows, files, _ = two
    broken_off = (None, None, None, KeyboardInterrupt())
    with faults(type(connection.store_backend()), "remove", *broken_off), pytest.raises(KeyboardInterrupt):
        forget.forget("P017")
    assert everything_but_refreshes() == rows
    assert stored() != files
    assert json.loads(forget.manifest_path("P017").read_text())["state"] == "begun"
    # The rows are gone and somebody else has the numbers by now: still the command knows what to remove, and what not.
    left = stored()
    lab.Numbered.delete(prompt=False)
    ingest([chain.small_video(tmp_path, "next")], VisitRecord(subject="P018"))
    video.VideoInfo.populate()
    theirs = stored() - left
    numbers = json.loads(forget.manifest_path("P017").read_text())["ids"]["video_id"]
    assert any(f"video_id={n}/" in path for n in numbers for path in theirs)
    done = pbl("forget", "P017", "--yes")
    assert done.code == 0, done.err
    assert stored() == files | theirs


def test_an_unknown_code_removes_nothing_and_a_running_computation_holds_it_up(
    two: tuple[dict, set[str], list[Path]],
):
    before = everything_but_refreshes()
    for subject in ("nobody", "P01", "p017"):
        assert pbl("forget", subject, "--yes").error_code == "DB_NOT_FOUND", subject
    for subject in ("../P017", "P017/../x", ""):
        assert pbl("forget", subject, "--yes").error_code == "USAGE", subject
    assert everything_but_refreshes() == before
    jobs = keypoints.Keypoints.jobs
    jobs.update1({**jobs.pending.keys()[0], "status": "reserved", "host": "node7", "pid": 4711})
    held = pbl("forget", "P017", "--yes")
    assert held.error_code == "DB_REFUSED"
    assert "node7, process 4711" in held.err
    assert {t: len(r) for t, r in everything_but_refreshes().items()} == {t: len(r) for t, r in before.items()}


def test_a_video_in_whose_place_another_lies_stays(two: tuple[dict, set[str], list[Path]]):
    _, _, videos = two
    videos[0].write_bytes(b"somebody else's")
    done = pbl("forget", "P017", "--yes", "--videos")
    assert done.code == 0, done.err
    assert "another file took its place" in done.out
    assert videos[0].read_bytes() == b"somebody else's"
    assert not videos[1].exists()


def test_a_file_that_somebody_elses_row_names_stays(
    two: tuple[dict, set[str], list[Path]], tmp_path: Path, environment: Environment
):
    _, _, videos = two
    other = (video.Video & (session.Session & {"subject": "P001"})).fetch1("video_id")
    video.Video.update1({"video_id": other, "video_path": str(videos[0])})
    done = pbl("forget", "P017", "--yes", "--videos")
    assert [v.exists() for v in videos] == [True, False, False]
    assert "another row names this path" in done.out
    assert done.code == 1
    assert "1 rows of pbl_video.video name it in video_path" in done.err
    archived = tmp_path / "archive" / "P017" / "visit" / "ab-walk.mp4"
    archived.parent.mkdir(parents=True)
    archived.write_bytes(b"another recording")
    environment(PBL_ARCHIVE=tmp_path / "archive")
    video.Video.update1({"video_id": other, "video_path": str(archived)})
    assert pbl("forget", "P017", "--yes", "--videos").code == 0
    assert archived.exists()
    assert not videos[0].exists()


def test_every_table_of_a_person_says_whose_its_rows_are(database: Path):
    """A new table that depends on a person, but has none of the columns that `pbl forget` looks at, fails here."""
    declare_all()
    conn = connection.connect()
    edges = conn.query(
        "SELECT table_schema, table_name, column_name, referenced_table_schema, referenced_table_name, "
        "referenced_column_name FROM information_schema.key_column_usage "
        "WHERE referenced_table_name IS NOT NULL AND table_schema LIKE %s",
        args=(r"pbl\_%",),
    ).fetchall()
    personal = {("pbl_lab", "subject")}
    while True:
        more = {(s, t) for s, t, _, ps, pt, _ in edges if (ps, pt) in personal}
        if more <= personal:
            break
        personal |= more
    assert len(personal) > 30
    known = {(s, t): {c.name for c in columns} for s, t, columns in forget.personal_tables()}
    assert not [t for t in personal if not set(forget.IDENTITIES) & known.get(t, set())]
    # Another name only beside its own: the cameras of a trial are of one person.
    renamed = [e for e in edges if e[5] in forget.IDENTITIES and e[2] != e[5] and e[5] not in known.get(e[:2], set())]
    assert not renamed
    # The queues of these tables as well.
    queues = {(s, "~~" + t.lstrip("_")) for s, t in personal if t.startswith("__") and "__" not in t[2:]}
    assert queues
    assert not [q for q in queues if q not in known]
