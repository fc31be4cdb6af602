"""A laboratory's own Subject and Session, linked with ours: a visit through all tables, what is refused, deleting."""

import datetime
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from datajoint import DataJointError

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_schemas import connection, gdi, lab, linking, migrations, session, video
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.operations import backup, catalog, embedded, forget
from pbl_schemas.stages import STAGES
from pbl_workers.populate import populate
from tests import Environment, mysql, pages
from tests.command import pbl
from tests.database import installation
from tests.rows import everything_but_refreshes, new_visit, register

from . import chain

#: The examples of docs/add_table.md: the laboratory's module, whose `subject` is a number, and its use.
MYLAB, USE = (block.code for block in pages.blocks("docs/add_table.md"))
MORNING, NOON = datetime.datetime(2026, 3, 1, 9, 30), datetime.datetime(2026, 3, 1, 12)
#: Visits of the same day, by the labels that they get.
FIRST, SECOND = "2026-03-01T09:30:00", "2026-03-01T12:00:00"


def row(person: int, when: datetime.datetime) -> dict[str, Any]:
    """A row of the laboratory's Session."""
    return {"subject": person, "session_datetime": when}


def python(folder: Path, code: str, **environment: str) -> str:
    """What another process prints, which knows nothing that this one has set."""
    out = ("PBL_LINKING_MODULE", "DJ_PASS" if "DJ_PASS_FILE" in environment else "")
    variables = {k: v for k, v in os.environ.items() if k not in out} | environment
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def may_create(name: str) -> None:
    """Let the account of the tables make schemas that begin with a name, as `pbl db config` does for its user."""
    if not mysql.chosen():
        embedded.allow_prefix(name)


@pytest.fixture(scope="module")
def folder(database: Path, tmp_path_factory: pytest.TempPathFactory, module_patch: pytest.MonkeyPatch) -> Path:
    """The folder of the laboratory's module `mylab`, from which it is imported."""
    out = tmp_path_factory.mktemp("mylab")
    (out / "mylab.py").write_text(MYLAB)
    (out / "renamed.py").write_text(RENAMED)
    module_patch.syspath_prepend(out)
    may_create("mylab")
    return out


@pytest.fixture(scope="module")
def mylab(folder: Path, module_patch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Two people and three visits of the laboratory, linked after two of ours were registered, one of them unknown to
    it."""
    chain.install(module_patch)
    pbl_schemas.activate()
    import mylab  # type: ignore[import-not-found]

    mylab.Subject.insert([{"subject": 1, "ward": "east"}, {"subject": 2, "ward": "west"}])
    mylab.Session.insert([row(1, MORNING), row(1, NOON), row(2, NOON)])
    new_visit(FIRST)
    new_visit("2019", "P009")
    pbl_schemas.activate(linking_module=mylab)
    yield mylab
    for table in (lab.Subject, session.Session):  # other files of this process have the same database
        table.Link().drop_quick()
        del table.Link
    connection.connect().dependencies.clear()
    linking._linked = None


def linked() -> list[tuple[Any, ...]]:
    """The links of visits: subject, label, and the key there."""
    rows = (session.Session * session.Session.Link).to_dicts(order_by="session_id")
    return [(r["subject"], r["session_label"], r["linked_subject"], r["linked_session_datetime"]) for r in rows]


def test_what_was_registered_before_is_linked_as_far_as_the_laboratory_has_it(mylab: Any):
    assert linked() == [("P001", FIRST, 1, MORNING)]
    assert lab.Subject.Link.to_dicts() == [{"subject": "P001", "linked_subject": 1}]
    assert len(session.Session()) == 2


def test_a_database_is_linked_with_the_same_tables_only(mylab: Any):
    with pytest.raises(PblError, match=r"links of Session refer to .*mylab_core.*session"):
        pbl_schemas.activate(linking_module="renamed")
    assert session.Session.Link.heading.names[1:] == ["linked_subject", "linked_session_datetime"]


def test_migrations_find_nothing_to_do(mylab: Any):
    assert migrations.migrate(dry_run=True) == migrations.Migrated([], [], [])


@pytest.mark.parametrize(
    ("subject", "label"), [("P003", FIRST), ("P001", "2026-03-02"), ("P009", "2019"), ("P001", "2019")]
)
def test_people_and_visits_that_the_laboratory_lacks_are_refused(mylab: Any, tmp_path: Path, subject: str, label: str):
    before = everything_but_refreshes()
    (refused,) = ingest([chain.small_video(tmp_path, "walk")], VisitRecord(subject, label, project="other"))
    assert refused.error is not None
    assert refused.error.code == "DB_NOT_FOUND"
    assert "mylab_core." in refused.error.next_step
    assert subject in refused.error.found
    assert everything_but_refreshes() == before


@pytest.fixture(scope="module")
def visits(mylab: Any, tmp_path_factory: pytest.TempPathFactory) -> list[int]:
    """Two visits of the laboratory's, computed."""
    videos = tmp_path_factory.mktemp("videos")
    numbers = register(chain.small_video(videos, "one"), session_label=FIRST)
    numbers += register(chain.small_video(videos, "two"), session_label=SECOND, subject="P002")
    populate()
    return numbers


def test_a_visit_goes_through_all_tables_and_joins_with_the_laboratorys(mylab: Any, visits: list[int]):
    counts = {t.__name__: len(t()) for t in pbl_schemas.computed_tables() if t.__name__ not in ON_REQUEST}
    assert all(n == 2 for n in counts.values()), counts
    assert linked() == [("P001", FIRST, 1, MORNING), ("P002", SECOND, 2, NOON)]
    assert (session.Session & {"session_label": FIRST}).fetch1("session_date") == MORNING.date()
    names: dict[str, Any] = {}
    exec(USE, names)
    assert (gdi.SessionGdi * session.Session & names["afternoon"]).to_arrays("subject").tolist() == ["P002"]
    assert len(gdi.SessionGdi & names["afternoon"]) == 1
    assert len(gdi.SessionGdi * session.Session * session.Session.Link * names["theirs"]) == 2
    wards = session.Session * lab.Subject.Link * mylab.Subject.proj("ward", linked_subject="subject")
    assert {r["subject"]: r["ward"] for r in (wards * gdi.SessionGdi).to_dicts()} == {"P001": "east", "P002": "west"}


#: Reads and registers in a process that knows no linking module; then a command that knows it by its variable.
WITHOUT = """
import os, sys
from pathlib import Path
from pbl_pipeline.cli import main
from pbl_schemas import activate, load_visit
from pbl_schemas.intake import VisitRecord, ingest
from tests.integration.chain import small_video

def register(name, label):
    (done,) = ingest([small_video(Path.cwd(), name)], VisitRecord("P001", label))
    print(done.error.code if done.error else done.status)

activate(methods=False)
print(load_visit({"subject": "P001"}).subject)
register("new", SECOND)
register("of a known visit", FIRST)
os.environ["PBL_LINKING_MODULE"] = "mylab"
sys.argv[1:] = ["--quiet", "ingest", "new.mp4", "--subject", "P001", "--session", SECOND]
main()
"""


def test_without_the_module_nothing_unlinked_is_registered(
    mylab: Any, visits: list[int], folder: Path, tmp_path: Path, environment: Environment
):
    """As a worker's account, which may not change the laboratory's tables."""
    environment(PBL_LINKING_MODULE="mylab")
    assert pbl("db", "roles", "--role", "worker", "--from", "127.0.0.1", "--secrets", tmp_path).code == 0
    port = str(connection.connect().conn_info["port"])
    login = {"DJ_HOST": "127.0.0.1", "DJ_PORT": port, "DJ_USER": "pbl_worker"}
    login["DJ_PASS_FILE"] = str(tmp_path / "pbl_worker")
    code = WITHOUT.replace("FIRST", repr(FIRST)).replace("SECOND", repr(SECOND))
    path = f"{Path(__file__).resolve().parents[2]}{os.pathsep}{folder}"
    assert python(tmp_path, code, PYTHONPATH=path, **login).splitlines()[:3] == ["P001", "DB_REFUSED", "registered"]
    assert linked()[-1] == ("P001", SECOND, 1, NOON)


#: Deletes a visit of the laboratory's with plain DataJoint, which knows nothing of ours.
PLAIN = """
import datajoint as dj
mine = dj.VirtualModule("mine", "mylab_core")
one = mine.Session & {"subject": 2}
try:
    one.delete(prompt=False)
except dj.DataJointError as error:
    print(str(error).split("`.")[0])
print(len(one), one.delete(prompt=False, part_integrity="cascade"))
import mylab, pbl_schemas
try:
    pbl_schemas.activate(linking_module=mylab)
except Exception as error:
    print(error.code, error.found)
"""


def test_deleting_the_laboratorys_visit_deletes_ours_if_told_to(
    mylab: Any, visits: list[int], folder: Path, tmp_path: Path
):
    assert pbl("db", "config", "--out", tmp_path).code == 0
    plain = {"DJ_IGNORE_CONFIG_FILE": "false", "PYTHONPATH": str(folder)}
    assert python(tmp_path, PLAIN, **plain) == (
        "Attempt to delete part table `pbl_session\n1 1\nUSAGE it connected before pbl_schemas did\n"
    )
    assert len(video.Video & {"video_id": visits[1]}) == 0
    assert (gdi.SessionGdi * session.Session).to_arrays("subject").tolist() == ["P001"]
    assert len(lab.Subject & {"subject": "P002"}) == 1
    with pytest.raises(DataJointError, match="Attempt to delete part table"):
        (mylab.Subject & {"subject": 2}).delete(prompt=False)
    (mylab.Subject & {"subject": 2}).delete(prompt=False, part_integrity="cascade")
    assert len(lab.Subject & {"subject": "P002"}) == 0


@pytest.mark.skipif(mysql.chosen(), reason="two servers of one process")
def test_a_backup_comes_back_where_the_laboratorys_tables_are_not(mylab: Any, visits: list[int], tmp_path: Path):
    saved = backup.backup(tmp_path / "backup")
    assert "mylab_core" not in str(saved.rows)
    try:
        with installation():
            with pytest.raises(PblError, match="REFERENCES command denied"):
                backup.restore(tmp_path / "backup")
            may_create("mylab")
            assert backup.restore(tmp_path / "backup", again=True).rows == saved.rows
            assert "mylab_core" not in catalog.schemas()
            assert linked()
    finally:
        connection.connect()


def test_forgetting_a_person_leaves_the_laboratorys_row(mylab: Any, visits: list[int]):
    assert forget.forget("P001").left == []
    assert len(lab.Subject.Link()) == len(session.Session.Link()) == 0
    assert mylab.Subject.to_arrays("subject").tolist() == [1]


#: Modules that cannot be linked, and the beginning of what is said of them.
WRONG = {
    "import nothing_of_this_name": "it cannot be imported (ModuleNotFoundError: ",
    "Subject = 3": "Subject is 3",
    "import mylab; Subject = mylab.Subject; Session = str": "Session is <class 'str'>",
    "import mylab; Subject = Session = mylab.Subject": "Session does not refer to Subject",
    "from pbl_schemas.lab import Subject; from pbl_schemas.session import Session": "Subject is in other_lab",
    "from mylab import Session, Subject; subject_code = lambda key: 'P001'": "P001 for {",
    "from mylab import Session, Subject; session_label = lambda key: 'a'": "1/a for {",
}
REFUSE = """
import datetime
from pbl_pipeline.errors import PblError
import pbl_schemas
pbl_schemas.activate("other", methods=False)
import mylab
mylab.Subject.insert([{"subject": i, "ward": ""} for i in (1, 2)], skip_duplicates=True)
days = [datetime.datetime(2026, 3, day) for day in (1, 2)]
mylab.Session.insert([{"subject": 1, "session_datetime": day} for day in days], skip_duplicates=True)
for i in range(NUMBER):
    try:
        pbl_schemas.activate(linking_module=f"wrong{i}", methods=False)
    except PblError as error:
        print(error.code, error.found)
from pbl_schemas.operations import catalog
print([table for _, table in catalog.names() if table.endswith("__link")])
from pbl_schemas import linking
import renamed
renamed.Session.insert([{"visit": 7, "patient": 2}], skip_duplicates=True)
theirs = linking.load("renamed")
print(theirs.visits(theirs.people()))
"""
#: A Session with a key of its own that names its Subject otherwise.
RENAMED = """
import datajoint as dj
from mylab import Subject, schema

@schema
class Visit(dj.Manual):
    definition = "visit : int32\\n---\\n-> Subject.proj(patient='subject')"

Session = Visit
"""


def test_a_module_that_cannot_be_linked_is_refused_and_nothing_is_made(folder: Path):
    for i, text in enumerate(WRONG):
        (folder / f"wrong{i}.py").write_text(text)
    may_create("other")
    *said, links, visits = python(
        folder, REFUSE.replace("NUMBER", str(len(WRONG))), PYTHONPATH=str(folder)
    ).splitlines()
    for line, expected in zip(said, WRONG.values(), strict=True):
        assert line.startswith(f"USAGE {expected}")
    assert links == "[]"
    assert visits == "{'2/7': {'visit': 7}}"


NOTHING_MADE = """
import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_schemas import connection, lab
from pbl_schemas.operations import catalog
for prefix, options in (("0", {}), ("none", {"create_schema": False}), ("none", {"create_tables": False})):
    try:
        pbl_schemas.activate(prefix, **options)
    except PblError as error:
        print(error.code, connection.prefix(), [name for name in catalog.schemas() if name.startswith("none")])
print(len(catalog.schemas()), catalog.names(), lab.Subject().is_declared)
try:
    pbl_schemas.activate("another")
except PblError as error:
    print(error.code, connection.prefix())
"""
MADE_BEFORE = """
import pbl_schemas
from pbl_schemas import fit
from pbl_schemas.operations import catalog
pbl_schemas.activate("none", create_schema=False, methods=False)
print(bool(catalog.names()), fit.FitMethod().is_declared)
"""


def test_schemas_and_tables_are_made_unless_told_not_to(database: Path, tmp_path: Path):
    assert python(tmp_path, NOTHING_MADE).splitlines() == [
        "USAGE pbl []",
        "DB_NOT_FOUND none []",
        f"{len(STAGES)} [] False",
        "USAGE none",
    ]
    assert python(tmp_path, MADE_BEFORE) == "True True\n"
