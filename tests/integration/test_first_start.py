"""The first use of an empty database, whichever it is, leaves the tables as `pbl db init` does."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import of_stage
from pbl_schemas import gait, methods, video
from pbl_schemas.method_rows import one_of, stored_keys
from tests import database
from tests.integration import web
from tests.integration.chain import small_video
from tests.integration.compute_target import nothing
from tests.integration.test_web_register import upload
from tests.source import ROOT

#: Starts the embedded database of an empty home, runs a program, prints (table, number of rows).
FIRST = """
import json, sys
from pbl_schemas import connection
from pbl_schemas.operations import catalog, embedded
embedded.start()
exec(sys.argv[1])
query = connection.connect().query
counts = {f"{s}.{t}": query(f"SELECT COUNT(*) FROM `{s}`.`{t}`").fetchone()[0] for s, t in catalog.names()}
print(json.dumps(counts))
"""
INIT = "from pbl_schemas.operations.declare import declare_all; declare_all()"
LOOK = "import pbl_schemas; pbl_schemas.activate(methods=False)"
#: A person, a visit and a recording in the browser, of a page that nothing but itself has connected.
PAGE = """
from pathlib import Path
from tests.integration import web
browser = web.client()
assert web.post(browser, "/visits/new", subject="P001", visit="2026-01-10").status_code == 303
fields, clip = {"token": web.token(browser), "activity": "walking", "pace": ""}, Path(sys.argv[2])
files = [("files", (clip.name, clip.read_bytes()))]
answer = browser.post("/visits/1/upload", data=fields, files=files, follow_redirects=False)
assert answer.status_code == 303, answer.text
"""
#: Names of the numerical libraries that are loaded after a command that only looks.
LOADED = LOOK + "; print([n for n in ('jax', 'mujoco', 'cv2', 'scipy', 'onnxruntime') if n in sys.modules])"


def child(home: Path, *arguments: object) -> list[str]:
    """Lines that the program printed in a separate process, with this PBL_HOME."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PBL_HOME", str(home))
        command = [sys.executable, "-c", FIRST, *map(str, arguments)]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout.splitlines()


@pytest.fixture
def home() -> Iterator[Path]:
    made = database.new_home()
    yield made
    database.remove_home(made)


@pytest.fixture(scope="module")
def initialised() -> Iterator[tuple[Path, dict[str, int]]]:
    """A home in which all tables were declared, with the number of rows of each."""
    made = database.new_home()
    yield made, json.loads(child(made, INIT)[-1])
    database.remove_home(made)


@database.embedded_only
@pytest.mark.slow
@pytest.mark.parametrize("first", [LOOK, PAGE], ids=["command", "page"])
def test_the_first_leaves_what_init_does(
    first: str, home: Path, initialised: tuple[Path, dict[str, int]], tmp_path: Path
):
    found = json.loads(child(home, first, small_video(tmp_path, "walk", n=30))[-1])
    assert found.keys() == initialised[1].keys()
    rows = {table: n for table, n in initialised[1].items() if n}
    assert {table: found[table] for table in rows} == rows
    assert len(rows) > 10
    assert (found["pbl_video.video"], found["pbl_video.~~video_info"]) == ((1, 1) if first == PAGE else (0, 0))


@database.embedded_only
@pytest.mark.slow
def test_a_command_that_looks_loads_no_numerical_library_later(initialised: tuple[Path, dict[str, int]]):
    assert child(initialised[0], LOADED)[0] == "[]"


def test_a_page_of_a_new_version_registers_with_its_methods(
    tables: None, archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """After an upgrade without a migration the tables have methods, but not those of this version."""
    default = {"gait_method_name": of_stage("gait").default}
    (gait.GaitEventMethod & default).delete_quick()
    monkeypatch.setattr(methods, "_done", set())
    browser = web.client(target=nothing)
    assert web.post(browser, "/visits/new", subject="P001", visit="2026-01-10").status_code == 303
    assert not gait.GaitEventMethod & default
    assert upload(browser, small_video(tmp_path, "walk", n=30)).status_code == 303
    assert len(gait.GaitEventMethod & default) == 1
    assert len(video.Video()) == 1


def test_without_names_the_error_asks_for_db_init(tables: None):
    with pytest.raises(PblError, match=r"next: +`pbl db init`"):
        raise PblError("SOLVER_UNKNOWN", found="no gait method 'x'", **one_of(()))
    with pytest.raises(PblError, match=r"next: +choose one of the names above \(`pbl list methods`\)"):
        stored_keys(gait.GaitEventMethod, "x")
