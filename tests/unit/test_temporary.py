"""Temporary folders: gone with their process, or with the next command where it was killed."""

import json
import multiprocessing
import os
import re
import stat
import subprocess
import sys
import tempfile
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline import temporary
from pbl_pipeline.files import complete_file
from pbl_schemas.operations.folders import write_json
from tests import Environment
from tests.command import pbl
from tests.source import PACKAGES, files

ROOT = Path(__file__).parents[2]
KILLED = {
    "page": "from pbl_workers.process_queue import ProcessQueue; q = ProcessQueue(1, 1)",
    "row": "from pbl_pipeline.temporary import new_folder; f = new_folder()",
}


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: Environment) -> Path:
    """The folder of temporary files, of this process and of those that it starts."""
    environment(TMPDIR=tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


@pytest.mark.parametrize("what", KILLED)
def test_what_a_killed_process_left_goes_with_the_next_command(folder: Path, what: str):
    code = f"import os, signal; {KILLED[what]}; os.kill(os.getpid(), signal.SIGKILL)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False)
    assert len(list(folder.iterdir())) == 1
    (next(folder.iterdir()) / "overlay.mp4").write_bytes(b"a person")
    with temporary.new_folder() as used:
        assert pbl("models", "--help").code == 0
        assert list(folder.iterdir()) == [used]
    assert not list(folder.iterdir())


@pytest.mark.parametrize("how", [m for m in multiprocessing.get_all_start_methods() if m != "fork"])
def test_a_process_that_ends_leaves_none(how: str):
    """Python runs `atexit` at the end of a forked process from 3.13 on."""
    context: Any = multiprocessing.get_context(how)
    here, there = context.Pipe()
    process = context.Process(target=_keeps, args=[there])
    process.start()
    left = here.recv()
    process.join()
    assert (left.exists(), process.exitcode) == (False, 0)


_KEPT: list[object] = []


def _keeps(pipe: Connection) -> None:
    _KEPT.append(folder := temporary.new_folder())
    pipe.send(folder.path)


def test_what_is_not_ours_or_in_use_stays(folder: Path, tmp_path_factory: pytest.TempPathFactory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (folder / "pbl-tmp-999999999-abc").symlink_to(elsewhere)
    for name in ("pbl-tmp-x-abc", "other-999999999-abc", f"pbl-tmp-{os.getppid()}-abc"):
        (folder / name).mkdir()
    for name in ("pbl-tmp-999999999-abc-1", f"pbl-tmp-{os.getpid()}-abc", "pbl-files-999999999-a", "pbl-web-abcdefgh"):
        (folder / name).mkdir()
    # Earlier versions of the page gave no number: whether it runs cannot be known.
    (folder / "pbl-web-older").mkdir()
    os.utime(folder / "pbl-web-older", (0, 0))
    assert not temporary.sweep()
    left = {"pbl-tmp-999999999-abc", "pbl-tmp-x-abc", "other-999999999-abc", f"pbl-tmp-{os.getppid()}-abc"}
    assert {p.name for p in folder.iterdir()} == left | {"pbl-web-abcdefgh"}
    assert elsewhere.is_dir()


def test_beside_a_target_what_killed_processes_left_goes_with_the_next(tmp_path: Path):
    (tmp_path / ".pbl-tmp-999999999-abc-1").mkdir()
    with temporary.new_folder(tmp_path) as used:
        assert list(tmp_path.iterdir()) == [used]
        assert used.name.startswith(".")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("package", PACKAGES)
def test_temporary_files_with_a_name_are_made_at_one_place_alone(package: str):
    named = re.compile(r"\b(mkdtemp|mkstemp|NamedTemporaryFile|TemporaryDirectory|SpooledTemporaryFile|gettempdir)\b")
    found = [
        str(path.relative_to(ROOT))
        for path in files(package)
        if named.search(path.read_text("utf-8")) and path != Path(temporary.__file__)
    ]
    assert not found


# --- JSON files that are never half written.


def test_a_file_is_replaced_with_its_permissions(tmp_path: Path):
    path = tmp_path / "secret.json"
    write_json(path, {"a": 1})
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    before = os.umask(0o077)
    try:
        write_json(path, {"a": 2}, 0o644)  # whatever the umask
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o644
    assert json.loads(path.read_text()) == {"a": 2}
    assert list(tmp_path.iterdir()) == [path]


def test_what_cannot_be_written_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    path = tmp_path / "list.json"
    write_json(path, {"a": 1})

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        write_json(path, {"a": 2})
    assert json.loads(path.read_text()) == {"a": 1}
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_that_two_write_at_once_is_whole(tmp_path: Path):
    path = tmp_path / "a.txt"
    with complete_file(path) as first:
        first.write_text("half ")
        with complete_file(path) as second:
            second.write_text("the second")
        with first.open("a") as file:
            file.write("of the first")
    assert path.read_text() == "half of the first"
    assert list(tmp_path.iterdir()) == [path]
