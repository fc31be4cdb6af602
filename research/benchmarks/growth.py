"""Time and statements of commands as the tables grow: figures of research/reports/2026-11-29_operations.md.

    python -m research.benchmarks.growth                                      # 10,000 and 100,000 videos
    python -m research.benchmarks.growth --videos 3000 --videos 30000

The rows are copies of one recorded visit (six videos, five visits a person) in a separate database, with decisions,
errors and marks in proportion. Each command runs in this process; client and server time are processor time.
"""

from __future__ import annotations

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator
from unittest import mock

import click
import pymysql

from research.benchmarks import visit_list
from research.benchmarks import workers as queue
from tests.command import pbl

#: Commands of `pbl` that are measured, one of them for a page.
COMMANDS = (
    ("cron", "refresh", "--all"),
    ("cron", "refresh"),
    ("cron", "release"),
    ("cron", "reprocess"),
    ("cron", "summary"),
    ("status",),
    ("status", "--exact"),
    ("why", "1"),
    ("list", "subjects"),
    ("list", "visits"),
    ("list", "videos"),
    ("list", "changes"),
    ("list", "decisions"),
    ("list", "visits", "--subject", "S0000001"),
    ("list", "changes", "--subject", "S0000001"),
    ("reprocess", "--table", "SessionFit"),
    ("reprocess", "--table", "SessionFit", "--new-method", "paper-2025"),
)


@dataclasses.dataclass
class Cost:
    """Cost of a call: statements, the longest (bytes) and slowest (s), processor time of client and server (s)."""

    statements: int = 0
    longest: int = 0
    slowest_s: float = 0.0
    client_s: float = 0.0
    server_s: float = 0.0
    texts: list[str] = dataclasses.field(default_factory=list)
    text: str = ""  # the longest statement
    slow: str = ""  # the slowest one


@contextlib.contextmanager
def counted() -> Iterator[Cost]:
    """Count the statements that the driver sends within the block, on all connections."""
    cost, send = Cost(), pymysql.connections.Connection.query

    def query(self: pymysql.connections.Connection, sql: str | bytes, unbuffered: bool = False) -> int:
        cost.statements += 1
        cost.texts.append(str(sql))
        size = len(sql if isinstance(sql, (bytes, bytearray)) else sql.encode("utf-8", "surrogateescape"))
        if size > cost.longest:
            cost.longest, cost.text = size, str(sql)
        begin = time.monotonic()
        try:
            return send(self, sql, unbuffered)
        finally:
            if (seconds := time.monotonic() - begin) > cost.slowest_s:
                cost.slowest_s, cost.slow = seconds, str(sql)

    with mock.patch.object(pymysql.connections.Connection, "query", query):
        yield cost


def measured(call: Callable[[], object], server_s: Callable[[], float] = lambda: 0.0) -> Cost:
    """Return what a call costs. server_s: processor time of the server so far (s)."""
    with counted() as cost:
        of_server, of_client = server_s(), time.process_time()
        call()
        cost.client_s, cost.server_s = time.process_time() - of_client, server_s() - of_server
    return cost


def walk() -> dict[str, Callable[[], object]]:
    """Return the calls that are measured, by name."""
    from pbl_schemas.reading.visit_list import visit_page

    calls: dict[str, Callable[[], object]] = {"pbl " + " ".join(c): lambda c=c: _pbl(*c) for c in COMMANDS}
    for name, wanted in visit_list.filters().items():
        calls[f"a page of {name}"] = lambda w=wanted: visit_page(w)
    return calls


def _pbl(*command: str) -> None:
    done = pbl(*command)
    assert done.code == 0, done.err


def grow(visits: int, before: int = 0, work: Callable[[], object] = lambda: queue.work(1)) -> None:
    """Make rows of so many visits, of which there are `before` already. work: computes the first."""
    from pbl_schemas.operations import catalog
    from pbl_workers import refresh
    from research.benchmarks.many_recordings import register_many

    if not before:
        register_many(visit_list.recordings(1))
        work()  # the visit whose rows are copied
    register_many(one for i, one in enumerate(visit_list.recordings(visits)) if i >= before * queue.EACH)
    queue.copy_results(max(before, 1), visits, parts=True)
    visit_list.spread(visits)
    catalog.analyse()  # as `db restore` and large imports do
    _decide()
    refresh.refresh(True)  # plans the visits that were decided about: work that grows with the decisions


def _decide() -> None:
    """Let people decide about some visits and videos, and let some jobs fail."""
    from pbl_schemas import kinetics, qc, session, video
    from pbl_schemas.jobs import jobs_of, keys_of
    from pbl_schemas.review import Decision

    query = session.Session.connection.query
    about = (
        "JSON_OBJECT('fit_set', q.fit_set, 'fit_method', q.fit_method, 'gait_method', q.gait_method,"
        " 'gdi_method', q.gdi_method, 'norm', q.norm, 'check', 'residual_3d_cm', 'qc_no', 1,"
        " 'computed', CAST(q.qc_computed AS CHAR))"
    )
    query(f"DELETE FROM {Decision.full_table_name}")
    query(
        f"INSERT INTO {Decision.full_table_name} (decision_id, session_id, video_id, decision_what, decision_by,"
        " decision_at, decision_about, decision_before, decision_after, decision_reason)"
        " SELECT ROW_NUMBER() OVER (), q.session_id, NULL, 'check', 'A. First', UTC_TIMESTAMP(),"
        f" {about}, '{{}}', '{{}}', ''"
        f" FROM {qc.SessionQc.full_table_name} q WHERE q.session_id %% 10 = 3"
    )
    query(
        f"INSERT IGNORE INTO {video.NotUsable.full_table_name} (video_id, unusable_reason, unusable_note, unusable_by,"
        f" unusable_created) SELECT video_id, 'other', '', 'A. First', UTC_TIMESTAMP() FROM"
        f" {video.Video.full_table_name} WHERE video_id %% 211 = 8"
    )
    jobs = jobs_of(kinetics.Kinetics)
    key = ",".join(jobs.primary_key)
    query(
        f"INSERT IGNORE INTO {jobs.full_table_name} ({key}, status, priority, error_message)"
        f" SELECT {key}, 'error', 5, 'PblError: MACHINE_SHORT: x' FROM ({keys_of(kinetics.Kinetics).make_sql()}) k"
        " WHERE CRC32(fit_set) %% 31 = 7"
    )


@click.command()
@click.option("--videos", multiple=True, type=click.IntRange(60), default=(10_000, 100_000), show_default=True)
@click.option("--only", default="", help="Only calls whose name has this.")
def main(videos: tuple[int, ...], only: str) -> None:
    """Print what each call costs at each size."""
    from pbl_schemas.operations import embedded

    with queue.installation() as home:
        pid = embedded.Folder(home / "db").state()["pid"]
        before, found = 0, []
        for n in sorted(videos):
            visits, begin = n // queue.EACH, time.monotonic()
            grow(visits, before)
            before = visits
            click.echo(f"{n} videos, {visits} visits, made in {time.monotonic() - begin:.0f} s")
            measured(walk()["pbl status"])  # connects, and reads the columns
            found.append({})
            for name, call in walk().items():
                if only in name:
                    begin = time.monotonic()
                    cost = found[-1][name] = measured(call, lambda: queue._processor_s(pid))
                    click.echo(
                        f"{name[:60]:<62}{cost.client_s:8.2f} s client {cost.server_s:8.2f} s server"
                        f" {time.monotonic() - begin:8.2f} s passed {cost.statements:6d} statements, longest"
                        f" {cost.longest:9,d} bytes"
                    )
                    if cost.longest > 1e5:
                        click.echo(f"    longest: {cost.text[:300]}")
                    if cost.slowest_s > 2:
                        click.echo(f"    {cost.slowest_s:.1f} s: {cost.slow[:1500]}")
        for name in found[0] if len(found) > 1 else ():
            few, many = found[0][name], found[-1][name]
            click.echo(f"{name[:60]:<62}client {many.client_s / few.client_s:6.1f} times, server"
                       f" {many.server_s / max(few.server_s, 0.01):6.1f} times")  # fmt: skip


if __name__ == "__main__":
    main()
