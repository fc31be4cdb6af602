"""A drop folder into which anybody puts anything: the good is taken, the rest is named, and nothing is followed."""

import json
import os
import secrets
import signal
import socket
import stat
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest

from pbl_pipeline import temporary
from pbl_pipeline.bench.detect import numbered
from pbl_schemas import connection, lab, session, video, worker
from pbl_schemas.intake import VisitRecord, ingest, uploads
from pbl_schemas.operations import archive as layout
from pbl_schemas.operations import backup, forget
from pbl_workers import incoming
from tests import Faults, Limits
from tests.command import pbl

from . import chain
from .drop import codes, files, look, twice, upload

SECRET = "a password of somebody else"
PBL = "from pbl_pipeline.cli import main; main()"
#: The same, and the process's state at its end beside its output: `ru_maxrss` would begin with the memory of the tests.
PBL_AND_STATE = (
    "import atexit, shutil, sys; atexit.register(shutil.copy, '/proc/self/status', sys.argv.pop(1) + '.state'); " + PBL
)


def hostile(drop: Path, outside: Path, known: bytes) -> dict[str, str]:
    """Entries that must not be taken: name -> part of what is printed of it."""
    said: dict[str, str] = {}

    def place(what: str, ending: str = "mp4", subject: str = "", visit: str = "1") -> Path:
        name = f"{subject or f'H{len(said):02}'}/{visit}/walk.{ending}"
        said[name] = what
        (drop / name).parent.mkdir(parents=True, exist_ok=True)
        return drop / name

    def video_with_log(what: str, ending: str = "csv") -> Path:
        path = place(what)
        path.write_bytes(known + secrets.token_bytes(8))
        return path.with_suffix(f".{ending}")

    (outside / "credentials.json").write_text(SECRET)
    # what is no file of its own
    place("a symbolic link").symlink_to(outside / "credentials.json")
    place("a symbolic link to /dev/zero").symlink_to("/dev/zero")
    place("a symbolic link to nothing").symlink_to("nothing")
    (loop := place("a symbolic link to walk.mp4")).symlink_to(loop.name)
    place("a symbolic link").symlink_to("../../P001/1/walk.mp4")
    os.mkfifo(place("a named pipe"))
    with socket.socket(socket.AF_UNIX) as pipe:
        pipe.bind(str(place("a socket")))
    os.link(outside / "credentials.json", place("hard links"))
    with place("21.0 GB").open("wb") as sparse:
        sparse.truncate(uploads.LARGEST + 10**9)
    place("0 bytes").touch()
    if os.geteuid() == 0:
        os.mknod(place("a device"), 0o666 | stat.S_IFCHR, os.makedev(1, 5))
        path = place("a file of account 12345")
        path.write_bytes(known + b"1")
        os.chown(path, 12345, -1)
    # names
    for subject in ("Jane Doe", "J" * 100, "\x1b[2J", "-rf", "\u202egnp"):
        place("a pseudonymous code", subject=subject).write_bytes(known + subject.encode())
    place("a pseudonymous code", subject=os.fsdecode(b"P\xff")).write_bytes(known + b"2")
    for visit in ("v" * 200, "\u6b65" * 80):
        place("visit", visit=visit).write_bytes(known + visit.encode())
    place("visit", visit=os.fsdecode(b"no\xfftext")).write_bytes(known + b"3")
    # the same recording for another person
    place("VIDEO_DUPLICATE").write_bytes(known)
    # logs
    video_with_log("a symbolic link").symlink_to(outside / "credentials.json")
    os.mkfifo(video_with_log("a named pipe", "json"))
    os.link(outside / "credentials.json", video_with_log("hard links", "json"))
    video_with_log("PHONE_LOG", "json").write_text("[" * 200_000)
    video_with_log("PHONE_LOG").write_bytes(secrets.token_bytes(5000))
    bomb = zipfile.ZipFile(video_with_log("PHONE_LOG", "zip"), "w", zipfile.ZIP_DEFLATED)
    with bomb, bomb.open("Orientation.csv", "w") as member:
        for _ in range(100):
            member.write(b"9" * 2**20)
    with video_with_log("0.5 GB").open("wb") as sparse:
        sparse.truncate(uploads.LARGEST_LOG + 10**8)
    # what has no place
    for name in ("loose.mp4", "P001/loose.mp4", "P001/1/program.exe", "P001/1/.hidden.mp4", "_x/1/walk.mp4"):
        said[name] = "ignored"
        (drop / name).parent.mkdir(parents=True, exist_ok=True)
        (drop / name).write_bytes(known)
    deep = drop / "P002/1/deep"
    for _ in range(200):
        deep /= "d"
    deep.mkdir(parents=True)
    place("ignored").mkdir()
    (drop / "linked").symlink_to(outside)
    return {**said, "P002/1/deep": "ignored", "linked": "ignored"}


@pytest.mark.slow
def test_thirty_kinds_of_hostile_entries_between_thirty_good_ones(drop: Path, tmp_path: Path, archive: Path):
    """The real command: everything good is taken, everything else is named, in at most 1 GiB."""
    before = chain.small_video(tmp_path, "before", n=5)
    ingest([before], VisitRecord(subject="P099", session_label="first"))
    outside = tmp_path / "outside"
    outside.mkdir()
    good = {f"P{i:03}/1/walk.mp4": numbered(before.read_bytes(), i) for i in range(30)}
    for name, content in good.items():
        (drop / name).parent.mkdir(parents=True)
        (drop / name).write_bytes(content)
    bad = hostile(drop, outside, before.read_bytes())
    assert len(bad) >= 30
    look(drop, archive)
    command = [sys.executable, "-c", PBL_AND_STATE, str(tmp_path / "import"), "--quiet", "cron", "import"]
    with (tmp_path / "printed").open("wb") as out:
        process = subprocess.run([*command, "--settled", "0"], stdout=out, stderr=out, check=False)
    printed = (tmp_path / "printed").read_text()
    assert process.returncode == 1, printed
    state = dict(line.split(":", 1) for line in (tmp_path / "import.state").read_text().splitlines())
    assert int(state["VmHWM"].split()[0]) < 2**20, state["VmHWM"]
    # every good one, as it was
    rows = (video.Video * session.Session & "subject LIKE 'P0%'" & "subject <> 'P099'").to_dicts()
    assert {f"{r['subject']}/{r['session_label']}/walk.mp4" for r in rows} == set(good), printed
    assert all(Path(r["video_path"]).read_bytes() == good[f"{r['subject']}/1/walk.mp4"] for r in rows)
    assert len(video.Video()) == 31
    # every other one by its name
    lines = printed.splitlines()
    for name, what in bad.items():
        shown = "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in name)
        at = [
            i
            for i, line in enumerate(lines)
            if line.endswith((f" {shown}", f" {shown[:-4]}.csv", f" {shown[:-4]}.json"))
        ]
        assert at, (name, printed)
        assert what in "\n".join(lines[at[0] - 1 : at[0] + 3]), (name, lines[at[0] - 1 : at[0] + 3])
    assert "INTERNAL" not in printed
    # nothing outside was read, copied, changed or removed, and what is kept is nobody else's to read
    assert SECRET not in "".join(
        p.read_text("latin-1") for p in archive.rglob("*") if p.is_file() and p.stat().st_size < 999
    )
    assert (outside / "credentials.json").read_text() == SECRET
    assert not [p for p in archive.rglob("*") if p.is_symlink() or p.stat().st_mode & 0o077]
    assert not [p for p in archive.rglob("*") if not (p.is_dir() or p.is_file())]
    assert set(files(drop)) == {n for n, what in bad.items() if what == "ignored" and (drop / n).is_file()}
    # each refused one with its reason
    refused = [p for p in (archive / "_refused").rglob("*") if p.suffix != ".txt" and p.is_file()]
    assert all(next(p.parent.glob(f"{p.name.split('.log')[0]}.txt")).read_text() for p in refused)


@pytest.mark.usefixtures("archive")
def test_a_lock_that_is_held_is_reported(drop: Path):
    other = connection.another()
    with worker.installation_lock(layout.LOCK, other) as obtained:
        assert obtained
        held = pbl("cron", "import")
        assert (held.code, held.out) == (75, "")
        assert "are being taken over" in held.err
        upload(drop, "P017/1/walk.mp4")
        assert pbl("forget", "P017", "--yes").error_code == "DB_REFUSED"
    other.close()
    assert pbl("cron", "import").code == 0


def test_a_run_that_hangs_is_ended():
    """Also where nothing answers: whatever it was doing, the next run goes on."""
    hangs = "import pbl_schemas, time; pbl_schemas.activate = lambda: time.sleep(600)"
    run = [
        sys.executable,
        "-c",
        f"{hangs}; from pbl_workers.cli import cron; cron.AT_MOST_S = 1; cron.cron(['import'])",
    ]
    assert subprocess.run(run, timeout=300, check=False).returncode == -signal.SIGALRM


def test_a_run_has_a_time_limit_and_the_next_one_goes_on(drop: Path, archive: Path):
    names = {str(upload(drop, f"P00{i}/1/walk.mp4", f"v{i}").relative_to(drop)) for i in range(3)}
    look(drop, archive)
    none = incoming.import_uploads(str(drop), archive, 0.0, run_s=-1.0)
    assert none is not None
    assert (none.later, none.registered) == (3, [])
    assert set(look(drop, archive).registered) == names


def test_an_error_that_nobody_foresaw_leaves_one_upload_and_takes_the_others(drop: Path, archive: Path, faults: Faults):
    """It is a fault of the program, not of the recording, which a later run takes."""
    bad, good = upload(drop, "P001/1/walk.mp4"), upload(drop, "P002/1/walk.mp4", "other")
    content = bad.read_bytes()

    def fails(recordings):
        if recordings[0].visit.subject == "P001":
            raise ZeroDivisionError("a defect")

    with faults(incoming, "register", before=fails):
        taken = twice(drop, archive)
    assert (taken.registered, codes(taken)) == ([str(good.relative_to(drop))], {})
    assert "a defect" in taken.left["P001/1/walk.mp4"].text()
    assert bad.read_bytes() == content
    assert not list((archive / "P001").rglob("*.mp4")) + list((archive / "_refused").rglob("*"))
    assert look(drop, archive).registered == ["P001/1/walk.mp4"]


def test_an_upload_whose_log_could_not_be_read_in_time_is_left(drop: Path, archive: Path, limits: Limits):
    video_file = upload(drop, "P001/1/walk.mp4")
    video_file.with_suffix(".csv").write_text("time_s,qw,qx,qy,qz\n")
    with limits(incoming, LOG_S=0.0):
        taken = twice(drop, archive)
        assert {name: error.code for name, error in taken.left.items()} == {"P001/1/walk.mp4": "MACHINE_SHORT"}
        assert video_file.exists()
    assert codes(look(drop, archive)) == {"P001/1/walk.mp4": "PHONE_LOG"}  # now it was read


def test_the_same_bytes_for_another_person_are_kept_and_named(drop: Path, archive: Path):
    content = upload(drop, "P001/2026-01-10/walk.mp4").read_bytes()
    assert twice(drop, archive).registered
    (drop / "P002/2026-04-10").mkdir(parents=True)
    (drop / "P002/2026-04-10/walk.mp4").write_bytes(content)
    taken = twice(drop, archive)
    assert codes(taken) == {"P002/2026-04-10/walk.mp4": "VIDEO_DUPLICATE"}
    said = taken.refused["P002/2026-04-10/walk.mp4"].text()
    for part in ("P001", "2026-01-10", "P002", "2026-04-10"):
        assert part in said
    (kept,) = (archive / "_refused" / "P002").glob("*.mp4")
    assert kept.read_bytes() == content
    assert Path(video.Video.fetch1("video_path")).read_bytes() == content
    # and by hand: nothing of the other person's video is changed
    row = video.Video.fetch1()
    again = pbl("ingest", kept, "--subject", "P002", "--activity", "running")
    assert again.error_code == "VIDEO_DUPLICATE"
    assert video.Video.fetch1() == row
    assert len(lab.Subject()) == 1


def test_a_registered_recording_stays_when_it_comes_again_with_a_bad_log(drop: Path, archive: Path):
    content = upload(drop, "P001/1/walk.mp4").read_bytes()
    assert twice(drop, archive).registered
    (drop / "P001/1/walk.mp4").write_bytes(content)
    (drop / "P001/1/walk.csv").write_text("no log")
    assert codes(twice(drop, archive)) == {"P001/1/walk.mp4": "PHONE_LOG"}
    assert Path(video.Video.fetch1("video_path")).read_bytes() == content


def test_a_damaged_archive_gets_its_recording_back(drop: Path, archive: Path):
    content = upload(drop, "P001/1/walk.mp4").read_bytes()
    assert twice(drop, archive).registered
    Path(video.Video.fetch1("video_path")).write_bytes(b"damaged")
    (drop / "P001/1/again.mp4").write_bytes(content)
    assert twice(drop, archive).known
    assert content in [p.read_bytes() for p in archive.rglob("*.mp4")]


def test_what_a_killed_import_left_goes_with_the_next_run_and_with_the_person(
    drop: Path, tmp_path: Path, archive: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))

    def kill() -> Path:
        left = layout.folder_of(archive, layout.COPIES, "P017") / "0123456789ab.mp4"
        left.write_bytes(b"a person")
        return left

    left = kill()
    look(drop, archive)
    assert not left.exists()
    # The person is known by nothing but such files: what was left, refused, and not taken yet.
    left = kill()
    upload(drop, "P017/1/walk.mp4")
    (drop / "P017/1/empty.mp4").touch()
    look(drop, archive)
    (drop / "P017/1/walk.mp4").touch()  # again not whole
    assert codes(look(drop, archive)) == {"P017/1/empty.mp4": "VIDEO_EMPTY"}
    left = kill()
    ended = subprocess.Popen(["true"])
    ended.wait()
    (tmp_path / f"pbl-tmp-{ended.pid}-abc").mkdir()
    (tmp_path / f"pbl-tmp-{ended.pid}-abc" / "keypoints.npz").write_bytes(b"a person")
    # A container that was started again has a process of the number that left this one.
    (tmp_path / f"pbl-tmp-{os.getpid()}-abc").mkdir()
    dry = pbl("forget", "P017", "--videos")
    assert dry.code == 0, dry.err
    for name in (left.name, "empty.mp4", "walk.mp4"):
        assert name in dry.out
    some = pbl("forget", "P017", "--yes")
    assert some.code == 0, some.err + some.out
    assert "and no recording" not in some.out
    assert "3 recordings stay" in some.out  # the upload, the refused one and its reason
    assert not left.exists()
    done = pbl("forget", "P017", "--yes", "--videos")
    assert done.code == 0, done.err + done.out
    assert "and no recording" in done.out
    with temporary.new_folder() as used:
        assert not temporary.sweep()
        assert [p.name for p in tmp_path.glob("pbl-tmp-*")] == [used.name]
    assert f"the archive {archive}, the drop folder: {drop}" in done.out
    assert not [p for p in [*drop.rglob("*"), *archive.rglob("*")] if "P017" in str(p.relative_to(tmp_path))]
    assert "P017" not in (archive / ".incoming" / "seen.json").read_text()
    proof = json.loads(forget.manifest_path("P017").read_text())
    assert (proof["state"], proof["kept"], proof["left"]) == ("done", {}, [])


@pytest.mark.usefixtures("archive")
def test_the_proof_names_what_could_not_be_removed(drop: Path, tmp_path: Path):
    ingest([upload(tmp_path, "walk.mp4")], VisitRecord(subject="P017"))
    (drop / "P017/1/deeper").mkdir(parents=True)
    done = pbl("forget", "P017", "--yes", "--videos")
    assert done.code == 1
    assert f"{drop}/P017/1/deeper" in done.err
    assert "no recording" not in done.out


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077], ids=oct)
def test_store_and_archive_are_private_under_any_umask(
    drop: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, umask: int
):
    archive, store = tmp_path / "a/archive", tmp_path / "s/store"
    upload(drop, "P001/1/walk.mp4")
    (drop / "P001/1/empty.mp4").touch()
    with monkeypatch.context() as patch:
        patch.setenv("PBL_STORE", str(store))
        before = os.umask(umask)
        try:
            connection.connect()
            twice(drop, archive)
            backend = connection.store_backend()
            backend.put_buffer(b"x", "_schema/a/b/c.npz")
            backend.put_file(next(archive.rglob("*.mp4")), "_schema/a/d/e.mp4")
        finally:
            os.umask(before)
    connection.connect()
    made = [p for folder in (archive, store) for p in (folder, *folder.rglob("*"))]
    assert len([p for p in made if p.is_file()]) == 6
    assert not [(p, oct(p.stat().st_mode)) for p in made if p.stat().st_mode & 0o077]


def test_a_backup_is_private_under_any_umask(tables: None, tmp_path: Path):
    folder = tmp_path / "backup"
    folder.mkdir()  # an administrator's, open to all as they usually are
    folder.chmod(0o755)
    before = os.umask(0)
    try:
        backup.backup(folder, store=False)
    finally:
        os.umask(before)
    made = [folder, *folder.rglob("*")]
    assert {"manifest.json", "database.sql.gz"} < {p.name for p in made}
    assert not [(p, oct(p.stat().st_mode)) for p in made if p.stat().st_mode & 0o077]
