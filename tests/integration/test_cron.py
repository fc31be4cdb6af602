"""Regular jobs: uploads that are taken over whole or not at all, the summary, the report of disk and store."""

import contextlib
import errno
import os
import re
import time
from pathlib import Path, PurePosixPath

import pytest
from datajoint.storage import StorageBackend

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_schemas import connection, lab, session, tracking, video, worker
from pbl_schemas.datajoint_setup import full_path
from pbl_schemas.intake import VisitRecord, uploads
from pbl_schemas.operations.archive import PHONE, folder_of, note_placed
from pbl_schemas.operations.orphans import orphans, remove
from pbl_workers import incoming
from pbl_workers.heartbeat import Silent
from pbl_workers.loop import Worker
from pbl_workers.populate import populate
from tests import Faults
from tests.command import pbl
from tests.rows import register

from . import chain
from .drop import codes, files, look, twice, upload

#: A phone's log of four seconds.
LOG = "time_s,qw,qx,qy,qz\n" + "".join(f"{0.02 * i},1,0,0,0\n" for i in range(200))


def test_whole_files_are_taken_checked_and_registered(drop: Path, archive: Path):
    content = upload(drop, "P001/2026-11-20/walk.mp4").read_bytes()
    upload(drop, "P002/2026-11-20/walk.MOV", "other")
    (drop / "notes.txt").write_text("no place in the layout")
    (drop / "P001/2026-11-20/.walk2.mp4.part").write_bytes(b"hidden: still being uploaded")
    taken = twice(drop, archive)
    assert taken.registered == ["P001/2026-11-20/walk.mp4", "P002/2026-11-20/walk.MOV"]
    assert sorted(taken.ignored) == ["P001/2026-11-20/.walk2.mp4.part", "notes.txt"]
    assert "begins with ." in taken.ignored["P001/2026-11-20/.walk2.mp4.part"]
    assert "0 folders deep" in taken.ignored["notes.txt"]
    assert not taken.refused
    rows = (video.Video * session.Session).to_dicts(order_by="subject")
    assert [(r["subject"], r["session_label"]) for r in rows] == [("P001", "2026-11-20"), ("P002", "2026-11-20")]
    assert Path(rows[0]["video_path"]).read_bytes() == content
    assert files(drop) == ["P001/2026-11-20/.walk2.mp4.part", "notes.txt"]
    assert len(files(archive)) == 2
    one = Worker(pbl_schemas.computed_tables(), Silent())
    one.run(once=True)
    assert (len(video.VideoInfo()), one.failed) == (2, 0)


def test_a_file_that_grows_is_left_until_it_is_whole(drop: Path, archive: Path):
    path = upload(drop, "P001/1/walk.mp4")
    content = path.read_bytes()
    path.write_bytes(content[:1000])
    assert look(drop, archive, settled_s=0.05).uploading == 1
    time.sleep(0.1)
    path.write_bytes(content)
    assert look(drop, archive, settled_s=0.05).uploading == 1
    assert look(drop, archive, settled_s=60.0).uploading == 1
    time.sleep(0.1)
    assert look(drop, archive, settled_s=0.05).registered == ["P001/1/walk.mp4"]


def test_the_phones_log_comes_along(drop: Path, archive: Path):
    upload(drop, "P001/1/walk.mp4")
    (drop / "P001/1/walk.csv").write_text(LOG)
    assert twice(drop, archive).registered == ["P001/1/walk.mp4"]
    assert files(drop) == []
    stored, log = sorted(files(archive), key=lambda name: name.endswith(".csv"))
    assert log == stored.removesuffix(".mp4") + ".csv"
    assert video.PhoneAttitude.fetch1("attitude_n") == 200
    assert video.Video.fetch1("camera_motion") == "handheld"


def test_a_video_waits_for_the_log_that_is_on_its_way(drop: Path, archive: Path):
    upload(drop, "P001/1/walk.mp4")
    look(drop, archive, settled_s=0.0)
    log = drop / "P001/1/walk.csv"
    log.write_text(LOG[:20])  # still being uploaded
    assert look(drop, archive, settled_s=0.0).registered == []
    log.write_text(LOG)
    assert twice(drop, archive).registered == ["P001/1/walk.mp4"]
    assert len(video.PhoneAttitude()) == 1


def test_what_grows_while_it_is_copied_is_left(drop: Path, archive: Path, monkeypatch):
    path = upload(drop, "P001/1/walk.mp4")
    look(drop, archive, settled_s=0.0)
    real = uploads.Folder.open

    @contextlib.contextmanager
    def grows(self, upload):  # asked after the files were listed
        with real(self, upload) as source:
            with path.open("ab") as file:
                file.write(b"more")
            yield source

    with monkeypatch.context() as patch:
        patch.setattr(uploads.Folder, "open", grows)
        taken = look(drop, archive)
    assert (taken.registered, taken.uploading) == ([], 1)
    assert (files(drop), len(video.Video())) == (["P001/1/walk.mp4"], 0)
    assert [p.name for p in archive.rglob("*") if p.is_file()] == ["seen.json"]


def test_the_same_bytes_under_another_name_are_kept_once(drop: Path, archive: Path):
    content = upload(drop, "P001/1/walk.mp4").read_bytes()
    twice(drop, archive)
    (drop / "P001/2").mkdir()
    (drop / "P001/2/again.mp4").write_bytes(content)
    known = twice(drop, archive).known
    assert list(known) == ["P001/2/again.mp4"]
    assert "subject P001, session 1" in known["P001/2/again.mp4"]
    assert (len(video.Video()), len(files(archive))) == (1, 1)
    assert Path(video.Video.fetch1("video_path")).read_bytes() == content
    assert files(drop) == []


def test_breaking_off_anywhere_loses_nothing_and_registers_once(drop: Path, archive: Path, faults: Faults):
    upload(drop, "P001/1/walk.mp4")
    # After the row was committed, before the upload is removed.
    with faults(incoming, "register", KeyboardInterrupt(), after=True), pytest.raises(KeyboardInterrupt):
        twice(drop, archive)
    assert files(drop) == ["P001/1/walk.mp4"]
    assert len(video.Video()) == 1
    again = look(drop, archive, settled_s=0.05)
    assert list(again.known) == ["P001/1/walk.mp4"]
    assert (len(video.Video()), files(drop), len(files(archive))) == (1, [], 1)


@pytest.mark.parametrize("n", [2, 3], ids=["at the video", "at its log"])  # the first is the list of what lies there
def test_an_archive_that_is_full_leaves_the_upload_and_keeps_no_half(drop: Path, archive: Path, n: int, faults: Faults):
    upload(drop, "P001/1/walk.mp4")
    (drop / "P001/1/walk.csv").write_text(LOG)
    look(drop, archive)
    full = OSError(errno.ENOSPC, "No space left on device")
    with faults(os, "fsync", *[None] * (n - 1), full) as calls:
        taken = look(drop, archive)
    assert "No space left" in taken.left["P001/1/walk.mp4"].found
    assert len(calls) == n
    assert files(drop) == ["P001/1/walk.csv", "P001/1/walk.mp4"]
    assert [p.name for p in archive.rglob("*") if p.is_file()] == ["seen.json"]
    assert look(drop, archive).registered == ["P001/1/walk.mp4"]


def test_a_full_store_ends_the_run_and_every_upload_stays(drop: Path, archive: Path, faults: Faults):
    for subject in ("P001", "P002"):
        upload(drop, f"{subject}/1/walk.mp4", subject)
        (drop / f"{subject}/1/walk.csv").write_text(LOG)
    look(drop, archive)
    there = files(drop)
    full = OSError(errno.ENOSPC, "No space left on device")
    with faults(StorageBackend, "put_buffer", full) as calls, pytest.raises(PblError) as error:
        look(drop, archive)
    assert (error.value.code, len(calls), files(drop)) == ("STORE_FULL", 1, there)
    assert sorted(look(drop, archive).registered) == ["P001/1/walk.mp4", "P002/1/walk.mp4"]


def test_what_cannot_be_registered_is_kept_with_its_reason(drop: Path, archive: Path):
    upload(drop, "Jane Doe/1/walk.mp4")
    (drop / "P001/1").mkdir(parents=True)
    (drop / "P001/1/empty.mp4").touch()
    upload(drop, "P002/1/walk.mp4").with_suffix(".csv").write_text("time_s,qw,qx,qy,qz\nnan,1,0,0,0\n")
    expected = {"Jane Doe/1/walk.mp4": "USAGE", "P001/1/empty.mp4": "VIDEO_EMPTY", "P002/1/walk.mp4": "PHONE_LOG"}
    assert codes(twice(drop, archive)) == expected
    assert files(drop) == []
    assert len(video.Video()) == 0
    names = files(archive)
    assert all(n.startswith("_refused/") for n in names)
    assert not (archive / "Jane Doe").exists()  # a folder would keep a name
    assert len([n for n in names if n.endswith(".txt")]) == 3
    assert [Path(n).suffix for n in names if "P002" in n] == [".mp4", ".csv", ".txt"]  # with its log


def test_names_from_outside_do_not_leave_the_archive(drop: Path, tmp_path: Path, archive: Path):
    hostile = drop / "P001" / "a..%2f..%2fetc" / "b..\\..\\x;rm -rf $(touch hacked) \x1b[2J.mp4"
    hostile.parent.mkdir(parents=True)
    chain.small_video(tmp_path, "x", n=60).rename(hostile)
    taken = twice(drop, archive)
    assert taken.registered == [str(hostile.relative_to(drop))]
    (kept,) = files(archive)
    assert re.fullmatch(r"P001/[\w. -]+/[\w. -]+-[0-9a-f]{8}\.mp4", kept), kept
    assert sorted(p.name for p in tmp_path.iterdir()) == ["archive", "uploads"]


@pytest.mark.parametrize(
    "name", ["P001/../x.mp4", "../1/x.mp4", "P001/1/.x.mp4", "P001/_1/x.mp4", "x.mp4", "P001/1/2/x.mp4", "P001/1/x.exe"]
)
def test_places_that_an_object_store_can_hold_but_the_layout_does_not(name: str):
    assert not incoming._misplaced(uploads.Upload(PurePosixPath("P001/1/x.mp4")))
    assert incoming._misplaced(uploads.Upload(PurePosixPath(name)))


def test_the_command_says_what_it_needs(tables: None, environment):
    environment(PBL_INCOMING=None)
    assert pbl("cron", "import").error_code == "USAGE"


def test_all_other_jobs_run(tables: None, tmp_path: Path):
    register(chain.small_video(tmp_path, "walk"))
    for words, said in (
        (("refresh",), "1 of VideoInfo"),
        (("release",), "no dead"),
        (("reprocess",), "nothing to try again"),
        (("summary", "--out", tmp_path / "out"), "new videos"),
        (("disk", "--least-free", 0), "files without a row: 0"),
    ):
        done = pbl("cron", *words)
        assert done.code == 0, done.err
        assert said in done.out
    (page,) = (tmp_path / "out").glob("*.html")
    assert "<script" not in page.read_text()
    with worker.installation_lock("refresh", connection.another()):  # a worker looks
        done = pbl("cron", "refresh")
        assert (done.code, done.out) == (0, "another process is doing this now\n")


def test_files_without_a_row_are_found_and_rows_without_a_file(tables: None, tmp_path: Path):
    before = orphans(young_s=0.0)
    register(chain.small_video(tmp_path, "walk"))
    populate(["VideoInfo", "Tracking"])
    found = orphans(young_s=0.0)
    assert (found.lost, len(found.orphans)) == ([], len(before.orphans))
    assert found.n_files > before.n_files
    (tracks,) = connection.connect().query(f"SELECT tracks FROM {tracking.Tracking.full_table_name}").fetchall()
    lab.Subject.delete(prompt=False, part_integrity="cascade")
    left = orphans(young_s=0.0)
    assert len(left.orphans) > len(before.orphans)
    assert tracks
    assert remove(left, older_than_s=1e6) == 0
    assert remove(left, older_than_s=0.0) == len(left.orphans)
    assert orphans(young_s=0.0).orphans == []


def test_a_file_that_a_killed_process_was_writing_is_removed(tables: None):
    before = len(orphans(young_s=0.0).orphans)
    store = connection.store_backend()
    paths = [f"{connection.store_root()}/pbl_tracking/tracking/{n}.npy{end}" for n, end in ((1, ".saving"), (2, ""))]
    for path in paths:
        file = Path(full_path(store, path))
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(b"0")
        os.utime(file, times=(old := time.time() - 8 * 86_400, old))
    done = pbl("cron", "disk", "--least-free", 0)
    assert "removed 1 that a killed process was writing" in done.out
    assert [f.path for f in orphans(young_s=0.0).orphans if f.path in paths] == paths[1:]
    assert remove(orphans(), 86_400.0) == 1
    assert len(orphans(young_s=0.0).orphans) == before


def test_a_recording_of_a_killed_page_is_said_and_its_room_given_back(
    tables: None, tmp_path: Path, archive: Path, faults: Faults
):
    """Killed between the move to its place and the row, by a sender that never returns."""

    class Killed(BaseException):
        pass

    def take(name: str, *, killed: bool) -> None:
        came = [folder_of(archive, PHONE, "P001") / f"browser-{name}{end}" for end in (".mp4", ".csv")]
        came[0].write_bytes(chain.small_video(tmp_path, name).read_bytes())
        came[1].write_text(LOG)
        copies = [incoming.Copy(came[0], sha256_of(came[0])), incoming.Copy(came[1], "")]
        die = [Killed()] if killed else []
        with faults(incoming, "register", *die), pytest.raises(Killed) if killed else contextlib.nullcontext():
            incoming.register_copies(VisitRecord("P001", "1"), f"{name}.mp4", copies, archive)

    def age() -> None:
        for note in (archive / PHONE).rglob("*"):
            os.utime(note, times=(old := time.time() - 8 * 86_400, old))

    take("walk", killed=False)
    whole = files(archive)
    take("lost", killed=True)
    left = sorted({*files(archive)} - {*whole})
    assert [Path(name).suffix for name in left] == [".csv", ".mp4", ".placed"]
    n = sum((archive / name).stat().st_size for name in left[:2])
    assert f"1 recordings begun and not registered: {n / 1e9:.1f} GB" in pbl("status").out
    assert "removed" not in pbl("cron", "release").out
    age()
    assert f"removed 1 recordings that were begun and did not go on ({n / 1e6:.0f} MB)" in pbl("cron", "release").out
    assert files(archive) == whole
    take("lost", killed=True)
    take("lost", killed=False)  # it was sent again
    assert len(files(archive)) == len(whole) + 2
    with faults(incoming, "register", Killed(), after=True), pytest.raises(Killed):  # once the row was there
        take("third", killed=False)
    there = files(archive)
    age()
    pbl("cron", "release")
    assert [name for name in there if not name.endswith(".placed")] == files(archive)


def test_a_note_of_the_same_bytes_under_another_ending_removes_no_registered_film(
    tables: None, tmp_path: Path, archive: Path
):
    came = folder_of(archive, PHONE, "P001") / "browser-1.mp4"
    content = chain.small_video(tmp_path, "walk").read_bytes()
    copies = [placed(came, content), placed(came.with_suffix(".csv"), LOG.encode())]
    incoming.register_copies(VisitRecord("P001", "1"), "a.mp4", copies, archive)
    before = files(archive)
    (film,) = (archive / name for name in before if name.endswith(".mp4"))
    note_placed(archive, film.with_suffix(".mov"))  # its process was killed before it could tell
    for note in (archive / PHONE).rglob("*"):
        os.utime(note, times=(old := time.time() - 8 * 86_400, old))
    pbl("cron", "release")
    assert files(archive) == before


def test_a_recording_that_is_refused_leaves_nothing_in_the_archive(tables: None, tmp_path: Path, archive: Path):
    came = folder_of(archive, PHONE, "P001") / "browser-1.mp4"
    content = chain.small_video(tmp_path, "walk").read_bytes()
    incoming.register_copies(VisitRecord("P001", "1"), "a.mp4", [placed(came, content)], archive)
    before = files(archive)
    with pytest.raises(PblError, match="VIDEO_DUPLICATE"):
        incoming.register_copies(VisitRecord("P002", "1"), "a.mp4", [placed(came, content)], archive)
    assert came.read_bytes() == content  # its sender removes it
    came.unlink()
    assert files(archive) == before


def placed(path: Path, content: bytes) -> incoming.Copy:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return incoming.Copy(path, sha256_of(path))
