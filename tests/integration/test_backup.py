"""Backups: what comes back is what was there, and nothing is ever written over."""

import contextlib
import gzip
import json
import random
import shutil
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbl_schemas
from pbl_pipeline.depth import DepthFile
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_schemas import connection, fit, gait, lab, load_visit, migrations, video
from pbl_schemas.intake import Sensors, VisitRecord, ingest
from pbl_schemas.operations import backup, backup_files, embedded
from pbl_schemas.operations.declare import declare_all
from pbl_schemas.reading import frames
from pbl_workers import backups
from pbl_workers.populate import populate
from tests import Environment, Faults, Limits
from tests.command import PBL, pbl
from tests.database import installation
from tests.rows import everything, everything_but_refreshes

from . import chain

#: A number that needs all 17 digits, and a text with everything that has to be escaped.
HEIGHT = 1.7345678901234567
TITLE = "knee ' \" \\ % `\n\t\0 \u00e4\u20ac\U0001f6b6 $(rm -rf /); --"


@chain.computed_once
def filled(folder: Path) -> None:
    """One visit through the whole chain, one error row, and awkward values."""
    declare_all()
    (folder / "notes.mp4").write_text("not a video")
    depth = Sensors(depth=DepthFile(chain.depth_pictures(folder / "depth"), 0.001))
    paths = chain.small_video(folder, "walk"), folder / "notes.mp4"
    ingest(paths, VisitRecord(subject="P001", project="gait"), files=[depth, Sensors()])
    populate()
    assert len(fit.SessionFit.Depth()) == 1
    lab.Project.update1({"project": "gait", "project_title": TITLE})
    lab.Subject.update1({"subject": "P001", "subject_height": HEIGHT})


@pytest.fixture
def elsewhere(filled: None) -> Iterator[Any]:
    """A call that starts an empty server and makes it the one in use; afterwards the old one is again."""
    with contextlib.ExitStack() as stack:
        yield lambda: stack.enter_context(installation())
    connection.connect()


def test_there_and_back(elsewhere: Any, tmp_path: Path, limits: Limits):
    limits(backup_files, STATEMENT=500)  # several inserts of a table
    saved = tmp_path / "backup"
    before = everything()
    done = pbl("db", "backup", "--recordings", saved)
    assert done.code == 0, done.err
    films = registered()
    content = films[0].read_bytes()
    films[0].unlink()
    films[1].write_text("another film")
    assert before["pbl_video.~~video_info"]
    assert f"{sum(map(len, before.values()))} rows of {len(before)} tables" in done.out
    assert saved.stat().st_mode & 0o077 == 0
    # sha256sum understands the list, and the programs of the server the statements.
    check = ["sha256sum", "--check", "--quiet", "../store.sha256"]
    assert subprocess.run(check, cwd=saved / "store", check=False).returncode == 0
    assert gzip.decompress((saved / "database.sql.gz").read_bytes()).count(b"\n") > 2 * len(before)
    elsewhere()
    assert pbl("db", "restore", "--check", saved).code == 0
    done = pbl("db", "restore", saved, "--recordings-below", films[0].parent)
    assert done.code == 0, done.err
    assert everything() == before
    # Recordings are where they were registered, and what is there is not touched.
    assert "1 recordings" in done.out
    assert (films[0].read_bytes(), films[0].stat().st_mode & 0o077) == (content, 0)
    assert f"left out: {films[1]}: another file is there" in done.err
    assert films[1].read_text() == "another film"
    # The tables work: what was computed is there, with its arrays, and nothing is computed anew.
    pbl_schemas.activate()
    assert lab.Subject.fetch1("subject_height") == HEIGHT
    assert lab.Project.fetch1("project_title") == TITLE
    assert frames.session_summary()["subject"].tolist() == ["P001"]
    results = load_visit({"subject": "P001"})
    fits = [r.fit for r in results.fitted if r.fit is not None]
    assert np.isfinite(fits[0].qpos).any()
    kept = everything_but_refreshes()
    assert not populate().did_something
    # Never over another.
    again = pbl("db", "restore", saved)
    assert again.error_code == "DB_REFUSED"
    assert "nothing is ever restored over another" in again.err
    assert everything_but_refreshes() == kept


@pytest.mark.long
def test_a_backup_of_an_older_version_is_restored_and_migrated(database: Path):
    """Made at commit 2e66321: one visit through the stand-ins of the chain, the tables alone."""
    with installation() as home:
        embedded.stop()
        shutil.rmtree(home / "db")  # a new place: no server is there yet
        found = backup.restore(Path(__file__).parent / "backup_of_2e66321")
        assert (sum(found.rows.values()), len(found.rows)) == (493, 110)
        migrations.migrate()
        pbl_schemas.activate()
        assert lab.Subject.fetch1("subject_height") == HEIGHT
        assert lab.Project.fetch1("project_title") == TITLE.partition(" $(")[0]
        assert len(gait.GaitCycle()) == found.rows["pbl_gait.__gait_cycle"] > 0
        assert [r["video_path"] for r in video.Video.to_dicts()] == ["/tmp/oldwork/walk.mp4", "/tmp/oldwork/notes.mp4"]
    connection.connect()


def test_a_restore_that_was_broken_off_is_repeated_on_demand(
    elsewhere: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    before = everything()
    backup.backup(tmp_path / "backup")
    elsewhere()
    lines = backup_files.read_lines

    def broken(path: Path) -> Iterator[str]:
        for i, line in enumerate(lines(path)):
            if i == 60:
                raise KeyboardInterrupt
            yield line

    with monkeypatch.context() as patch:
        patch.setattr(backup_files, "read_lines", broken)
        with pytest.raises(KeyboardInterrupt):
            backup.restore(tmp_path / "backup")
    assert pbl("db", "restore", tmp_path / "backup").error_code == "DB_REFUSED"
    assert pbl("db", "restore", "--again", tmp_path / "backup").code == 0
    assert everything() == before
    # The marker is gone: --again is no way to write over a database.
    assert pbl("db", "restore", "--again", tmp_path / "backup").error_code == "DB_REFUSED"


def test_it_is_of_one_moment_while_others_write(filled: None, tmp_path: Path, faults: Faults):
    late: list[str] = []

    def writes(*_: object) -> None:
        if not late:
            late.append("P999")
            writer = threading.Thread(target=_insert_subject)
            writer.start()
            writer.join(20)
            assert not writer.is_alive(), "the backup holds up who writes"

    faults(backup_files, "create_statement", before=writes)
    rows = backup.backup(tmp_path / "backup").rows
    assert len(lab.Subject()) == 2
    assert rows["pbl_lab.subject"] == 1


def _insert_subject() -> None:
    with contextlib.closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute(
            "INSERT INTO pbl_lab.subject (subject, population, subject_created) VALUES ('P999', 'unknown', NOW())"
        )


def test_a_changed_backup_is_refused_before_anything_is_written(elsewhere: Any, tmp_path: Path):
    saved = tmp_path / "backup"
    backup.backup(saved)
    elsewhere()
    one = next(p for p in sorted((saved / "store").rglob("*")) if p.is_file())
    content = one.read_bytes()
    one.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    done = pbl("db", "restore", saved)
    assert done.error_code == "BACKUP_INVALID"
    assert one.name in done.err
    one.write_bytes(content)
    sql = (saved / "database.sql.gz").read_bytes()
    (saved / "database.sql.gz").write_bytes(sql[:-9])
    assert pbl("db", "restore", saved).error_code == "BACKUP_INVALID"
    (saved / "database.sql.gz").write_bytes(sql)
    listing = (saved / "store.sha256").read_text()
    # A path that leaves the store is refused even where there is such a file, with the right bytes.
    path = listing.splitlines()[0].split("  ", 1)[1]
    (saved / "outside").write_bytes((saved / "store" / path).read_bytes())
    (saved / "store.sha256").write_text(listing.replace(path, "../outside", 1))
    manifest = json.loads((saved / "manifest.json").read_text())
    manifest["sha256"]["store.sha256"] = sha256_of(saved / "store.sha256")
    (saved / "manifest.json").write_text(json.dumps(manifest))
    assert pbl("db", "restore", saved).error_code == "BACKUP_INVALID"
    (saved / "manifest.json").unlink()
    assert pbl("db", "restore", saved).error_code == "BACKUP_INVALID"
    assert everything() == {}
    # One of before recordings were saved is whole without their number.
    (saved / "store.sha256").write_text(listing)
    manifest["sha256"]["store.sha256"] = sha256_of(saved / "store.sha256")
    del manifest["n_recordings"]
    (saved / "manifest.json").write_text(json.dumps(manifest))
    assert backup.check(saved)["n_recordings"] == 0


def test_a_lost_file_and_a_full_folder_are_said(filled: None, tmp_path: Path):
    saved = tmp_path / "backup"
    saved.mkdir()
    (saved / "something").touch()
    assert pbl("db", "backup", saved).error_code == "FILE_UNWRITABLE"
    connection.store_backend().remove(video.VideoInfo.fetch1("frame_time").path)
    done = pbl("db", "backup", tmp_path / "other")
    assert done.error_code == "BACKUP_INVALID"
    assert "frame_time" in done.err
    assert not (tmp_path / "other" / "manifest.json").exists()
    assert pbl("db", "backup", "--database-only", tmp_path / "tables").code == 0


def test_a_row_that_names_a_file_outside_of_the_store_is_refused(filled: None, tmp_path: Path):
    """Whoever can write rows must not make a backup read or write elsewhere."""
    store = Path(connection.store_backend().spec["location"])
    (store.parent / "secret").write_text("of somebody else")
    column = '{"path": "../secret", "store": "arrays", "shape": [1], "dtype": "float64"}'
    query = connection.connect().query
    query(f"UPDATE {video.VideoInfo.full_table_name} SET frame_time = %s", args=(column,))
    done = pbl("db", "backup", tmp_path / "backup")
    assert done.error_code == "BACKUP_INVALID"
    assert "leaves the store" in done.err
    assert not list(tmp_path.rglob("secret"))


def test_a_backup_of_another_prefix_and_other_bytes_in_the_store_are_refused(
    elsewhere: Any, tmp_path: Path, environment: Environment
):
    saved = tmp_path / "backup"
    backup.backup(saved)
    elsewhere()
    environment(PBL_DB_PREFIX="other")
    assert pbl("db", "restore", saved).error_code == "DB_REFUSED"
    environment(PBL_DB_PREFIX=None)
    path = (saved / "store.sha256").read_text().split("  ", 1)[1].splitlines()[0]
    connection.connect()
    connection.store_backend().put_buffer(b"other bytes", path)
    done = pbl("db", "restore", saved)
    assert done.error_code == "DB_REFUSED"
    assert path in done.err
    assert connection.store_backend().get_buffer(path) == b"other bytes"
    connection.store_backend().remove(path)
    # Not every row came back: of that, too, nobody is told that it is whole.
    manifest = json.loads((saved / "manifest.json").read_text())
    manifest["rows"]["pbl_lab.subject"] += 1
    (saved / "manifest.json").write_text(json.dumps(manifest))
    short = pbl("db", "restore", "--again", saved)
    assert short.error_code == "DB_REFUSED"
    assert "1 rows in pbl_lab.subject" in short.err
    manifest["rows"]["pbl_lab.subject"] -= 1
    (saved / "manifest.json").write_text(json.dumps(manifest))
    assert pbl("db", "restore", "--again", saved).code == 0


@pytest.fixture
def backup_with_films(tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """A backup of three recordings of /FOLDER/archive, which are gone, and their sums by path."""
    archive, saved = tmp_path / "archive", tmp_path / "backup"
    archive.mkdir()
    saved.mkdir()
    sums = {}
    for name in "abc":
        (archive / f"{name}.mp4").write_text(name)
        sums[str(archive / f"{name}.mp4")] = sha256_of(archive / f"{name}.mp4")
    assert len(backup_files.save_recordings(sums.items(), saved).paths) == 3
    for path in sums:
        Path(path).unlink()
    return saved, sums


def test_recordings_come_back_below_the_folders_that_were_told_alone(
    backup_with_films: tuple[Path, dict[str, str]], tmp_path: Path
):
    saved, sums = backup_with_films
    a, b, c = map(Path, sums)
    other = backup_files.restore_recordings(saved, sums, [tmp_path / "other"])
    assert (other.paths, list(other.left)) == ([], [str(a), str(b), str(c)])
    assert "--recordings-below" in other.left[str(a)]
    b.symlink_to(tmp_path / "outside")
    done = backup_files.restore_recordings(saved, {**sums, str(c): "0" * 64}, [tmp_path / "archive"])
    assert (done.paths, list(done.left)) == ([str(a)], [str(b), str(c)])
    assert not (tmp_path / "outside").exists()


def test_a_manipulated_backup_writes_nothing_elsewhere(backup_with_films: tuple[Path, dict[str, str]], tmp_path: Path):
    """Drawn: names, links, and sums that agree with them."""
    saved, sums = backup_with_films
    outside, archive = tmp_path / "outside", tmp_path / "archive"
    outside.mkdir()
    (outside / "secret").write_text("secret")
    (archive / "way").symlink_to(outside)
    listing, draw = (saved / "recordings.sha256").read_text(), random.Random(0)
    for _ in range(200):
        name = draw.choice(["way/x.mp4", "../outside/x.mp4", "./a.mp4", "a.mp4", "n.mp4", "way/../way/x.mp4"])
        whole = str(archive / name).lstrip("/")
        source = saved / "recordings" / whole
        if draw.random() < 0.5 and not source.exists():
            source.parent.mkdir(parents=True, exist_ok=True)
            source.write_text("planted") if draw.random() < 0.5 else source.symlink_to(outside / "secret")
        sha = sha256_of(source) if source.exists() else "0" * 64
        (saved / "recordings.sha256").write_text(f"{listing}{sha}  {whole}\n")
        with contextlib.suppress(PblError):
            backup_files.restore_recordings(saved, sums, [archive])
        assert [p.name for p in outside.iterdir()] == ["secret"]
        assert {p.name for p in archive.iterdir()} <= {"a.mp4", "b.mp4", "c.mp4", "way"}


def test_a_link_in_a_backup_is_a_changed_file(filled: None, tmp_path: Path):
    saved = tmp_path / "backup"
    backup.backup(saved)
    one = next(p for p in sorted((saved / "store").rglob("*")) if p.is_file())
    one.rename(tmp_path / "elsewhere")
    one.symlink_to(tmp_path / "elsewhere")
    done = pbl("db", "restore", "--check", saved)
    assert (done.error_code, one.name in done.err) == ("BACKUP_INVALID", True)


@pytest.mark.parametrize("path", ["/etc/passwd", "../x", "a/../../x", "", "a\nb", "..\\x"])
def test_paths_that_leave_the_store_are_refused(path: str):
    with pytest.raises(PblError, match=r"^BACKUP_INVALID: "):
        backup_files.safe_path(path)


def test_regular_backups_hold_recordings_once_and_the_oldest_go(
    filled: None, tmp_path: Path, environment: Environment, limits: Limits
):
    films, root = registered(), tmp_path / "backups"
    environment(PBL_BACKUP=root)
    for name in ("notes", "2026-01-01T000000Z"):  # somebody's, and an interrupted one
        (root / name).mkdir(parents=True)
    # As cron starts it: in a process that knows no table yet.
    alone = subprocess.run([*PBL, "cron", "backup"], capture_output=True, text=True, check=False)
    assert alone.returncode == 0, alone.stderr
    for second in (1, 2):
        limits(backups, _NAME=f"2099-01-01T00000{second}Z")
        done = pbl("cron", "backup", "--keep", "2")
        assert done.code == 0, done.err
        assert "2 recordings" in done.out
    first, second, notes = sorted(root.iterdir())
    assert [first.name, second.name, notes.name] == ["2099-01-01T000001Z", "2099-01-01T000002Z", "notes"]
    names = [Path("recordings") / film.relative_to("/") for film in films]
    assert all((first / name).samefile(second / name) for name in names)  # takes room once
    # One is gone, one is another file: both are named, and the rest is saved.
    films[0].unlink()
    films[1].write_text("another film")
    done = pbl("db", "backup", "--recordings", tmp_path / "third")
    assert done.code == 0
    assert all(f"left out: {film}: " in done.err for film in films)
    assert pbl("db", "restore", "--check", tmp_path / "third").code == 0
    # A recording that was changed in the backup is found.
    (second / names[0]).write_bytes(b"x")
    assert pbl("db", "restore", "--check", second).error_code == "BACKUP_INVALID"


def registered() -> list[Path]:
    """The video files of `filled`."""
    return [Path(path) for path in video.Video.to_arrays("video_path")]
