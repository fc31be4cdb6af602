"""Commands over many visits: statements do not grow with the rows, and end with the command that sent them."""

import signal
import subprocess
import sys
import time
from contextlib import closing
from pathlib import Path

import pandas as pd
import pytest

from pbl_schemas import computed_tables, connection, fit, rows, session, video
from pbl_schemas.chain import ON_REQUEST
from pbl_schemas.datajoint_setup import LIMIT_S
from pbl_schemas.jobs import jobs_of
from pbl_schemas.operations import catalog
from pbl_schemas.plan import plan_fit_sets
from pbl_schemas.reading import registered
from pbl_schemas.reading.status import pipeline_status
from pbl_schemas.studies import study_sheets
from pbl_workers import queue, requeue
from pbl_workers.populate import populate
from research.benchmarks import growth, many_recordings, worker_standins, workers
from tests import Environment, Limits, mysql, not_none
from tests.command import pbl
from tests.database import embedded_only
from tests.integration import chain
from tests.rows import register

pytestmark = pytest.mark.database

#: Visits of the small and the large database, and values in a restriction.
FEW, MANY, PART = 30, 90, 10
#: Pages of the list of visits that are looked at.
PAGES = ("everything", "WARN", "ACCEPTED", "computed", "pending")
#: Most statements of a command for each part of its visits.
EACH_PART = 16
#: Most statements of a populate of a visit with one walk: so many for each job, and for two looks at all tables.
EACH_JOB, LOOKS = 32, 75


def test_all_queues_are_asked_at_once(tables: None, tmp_path: Path):
    of_all = [jobs_of(t).full_table_name for t in computed_tables()]
    for name in ("first", "second", "third"):
        register(chain.small_video(tmp_path, name), session_label=name)
        visit = max(int(s) for s in session.Session.to_arrays("session_id"))
        with growth.counted() as cost:
            run = populate(visit=visit if name == "third" else None)
        done = sum(table.done for table in run.tables)
        assert done == len(of_all) - len(ON_REQUEST) + 1  # forces are planned
        if name != "first":  # that reads the columns
            assert cost.statements <= LOOKS + EACH_JOB * done
            taken = [sql for sql in cost.texts if "status='pending'" in sql and sql.startswith("(SELECT")]
            assert sum(all(queue in sql for queue in of_all) for sql in taken) <= done + 2
            assert len(taken) <= 2 * done
    assert growth.measured(populate).statements <= LOOKS


def test_statements_stay_as_short_as_they_are(
    tables: None,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    environment: Environment,
    capsys: pytest.CaptureFixture,
    limits: Limits,
):
    limits(rows, PART=PART)
    limits(requeue, CHUNK=PART)
    limits(workers, EACH=1)  # a video a visit
    environment(**{worker_standins.RECORDED: chain.small_video(tmp_path, "recorded")})
    worker_standins.install(monkeypatch)
    first = [t.__name__ for t in computed_tables() if t.__name__ not in ON_REQUEST]
    costs: list[dict[str, growth.Cost]] = []
    for before, visits in ((0, FEW), (FEW, MANY)):
        growth.grow(visits, before, lambda: populate(first))
        calls = {name: call for name, call in growth.walk().items() if "page" not in name or name.endswith(PAGES)}
        calls["pbl cron refresh --all"]()  # queues the jobs of the new rows
        costs.append({name: growth.measured(call) for name, call in calls.items()})
        assert len(fit.FitSet()) >= visits
    few, many = costs
    # A page has at most 50 visits.
    longer = {n: many[n].text for n in few if many[n].longest > max(few[n].longest + 100, 8_000)}
    assert longer == {}
    most = EACH_PART * (MANY - FEW) // PART
    more = {n: many[n].statements - few[n].statements for n in few}
    assert {name: n for name, n in more.items() if n > most} == {}
    # Of what was planned before the server knew of the rows, nothing is looked up anew for each of them.
    with growth.counted() as cost:
        plan_fit_sets()
    planned = [sql for sql in cost.texts if "__trial_input" in sql]
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        for sql in planned:
            cursor.execute(f"EXPLAIN {sql}")
            found = [(row[1], row[2]) for row in cursor.fetchall()]
            assert not [table for kind, table in found if kind == "DEPENDENT SUBQUERY" and "fit_s" in str(table)], found
    assert planned


def test_statements_of_sheets_do_not_grow_with_their_rows(tables: None, tmp_path: Path, limits: Limits):
    limits(rows, PART=PART)
    longest = []
    for n in (FEW, MANY):
        for score in ("11", "-"):  # stated, and removed again
            lines = (f"P{i:03d},{2000 + n}-01-10,baseline,dcm,surgery,yes,{score}" for i in range(n))
            sheet = tmp_path / "visits.csv"
            sheet.write_text("\n".join(("subject,visit,role,cohort,group,included,mJOA", *lines)))
            with growth.counted() as cost:
                assert study_sheets.import_sheets([sheet]).done
            longest.append((cost.longest, cost.text))
    assert longest[2][0] <= longest[0][0] + 100, longest[2][1][:300]
    assert longest[3][0] <= longest[1][0] + 100, longest[3][1][:300]


def test_a_printed_list_ends_and_says_what_it_leaves_out(tables: None):
    many_recordings.register_many(workers.recordings(0, 3 * workers.EACH))  # three people with a visit each
    for name, most, n in (("subjects", 2, 3), ("visits", 2, 3), ("videos", 4, 18)):
        done = pbl("list", name, "--limit", most)
        assert len(done.out.splitlines()) == 1 + most
        assert f"{n - most} further rows left out" in done.err
        whole = pbl("list", name, "--limit", 0)
        assert (len(whole.out.splitlines()), whole.err) == (1 + n, "")
        assert len(pbl("list", name, "--csv", "--limit", most).out.splitlines()) == 1 + n
        first = getattr(registered, name)(True, most)
        pd.testing.assert_frame_equal(first, getattr(registered, name)().head(most))


def test_status_asks_for_names_once(tables: None):
    many_recordings.register_many(workers.recordings(0, workers.EACH))
    numbers = [int(v) for v in video.Video.to_arrays("video_id")]
    mark = {"unusable_reason": "other", "unusable_by": "A", "unusable_created": rows.utc_now()}
    statements, jobs = [], jobs_of(video.VideoInfo)
    assert queue.fill(video.VideoInfo) == workers.EACH
    for some in (numbers[:1], numbers[1:]):
        for v in some:
            jobs.reserve({"video_id": v})
            jobs.error({"video_id": v}, error_message="VIDEO_MISSING: gone")
        video.NotUsable.insert({"video_id": v, **mark} for v in some)
        state = pipeline_status()  # reads the columns of the tables
        assert {m.about for m in state.not_usable} == {e.about for e in state.errors}
        assert all(e.about.endswith(".mp4") for e in state.errors)
        statements.append(growth.measured(pipeline_status).statements)
    assert len(state.errors) == len(state.not_usable) == workers.EACH
    assert statements[1] <= statements[0]


@embedded_only
def test_a_server_knows_how_many_rows_came_at_once(tables: None):
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        (table,) = [name for name in catalog.names() if name[1] == "#clinical_instrument"]
        asked = "SELECT table_rows FROM information_schema.tables WHERE table_schema = %s AND table_name = %s"
        name = catalog.quote(*table)
        cursor.execute(f"ALTER TABLE {name} STATS_AUTO_RECALC = 0")
        try:
            cursor.execute(f"SELECT COUNT(*) FROM {name}")
            before = not_none(cursor.fetchone())[0]
            catalog.analyse()
            cursor.execute(asked, table)
            assert cursor.fetchone() == (before,)
        finally:
            cursor.execute(f"ALTER TABLE {name} STATS_AUTO_RECALC = DEFAULT")


SLOW = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where a shell runs the tests in the background
import pbl_schemas
from pbl_pipeline.cli import main
from pbl_schemas import connection
pbl_schemas.activate = lambda **_: connection.connect().query("SELECT SLEEP(60) /* of an interrupted command */")
import sys
sys.argv = ["pbl", "list", "visits"]
main()
"""


def test_the_query_of_an_interrupted_command_ends_and_no_query_goes_on_for_ever(tables: None):
    asked = "SELECT COUNT(*) FROM information_schema.processlist WHERE info LIKE 'SELECT SLEEP(60)%'"
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:

        def there(wanted: int) -> bool:
            end = time.monotonic() + 60
            while time.monotonic() < end:
                cursor.execute(asked)
                if cursor.fetchone() == (wanted,):
                    return True
                time.sleep(0.05)
            return False

        with subprocess.Popen([sys.executable, "-c", SLOW], stderr=subprocess.PIPE) as command:
            assert there(1)
            command.send_signal(signal.SIGINT)
            assert command.wait(30) == 130
        cursor.execute(asked)
        assert cursor.fetchone() == (0,)
    name = "max_execution_time" if mysql.chosen() else "max_statement_time"
    (limit,) = connection.connect().query(f"SELECT @@SESSION.{name}").fetchone()
    assert float(limit) == (1000 if mysql.chosen() else 1) * LIMIT_S
