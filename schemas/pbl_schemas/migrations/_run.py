"""Plan and apply migrations."""

from __future__ import annotations

import dataclasses
import functools
import importlib
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from typing import Any

import pymysql

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_schemas import connection
from pbl_schemas.chain import tables
from pbl_schemas.datajoint_setup import dj, read_heading_again
from pbl_schemas.operations import catalog
from pbl_schemas.operations.catalog import quote
from pbl_schemas.operations.declare import declare_all
from pbl_schemas.rows import inside, parts
from pbl_schemas.stages import STAGES, modules
from pbl_schemas.tables_version import applied, numbered, record, refuse_newer, title

_error = functools.partial(PblError, "DB_MIGRATION")

#: Age of the last heartbeat up to which a worker counts as running (s).
SEEN_S = 120.0
#: Time for which a migration waits for the end of another one (s).
LOCK_S = 5


@dataclasses.dataclass(frozen=True)
class Difference:
    """A difference between a table and its definition. table: its full name on the server. known: False if the
    definition refers to something that the server lacks, so that the rest is unknown."""

    table: str
    what: str
    known: bool = True

    def __str__(self) -> str:
        return f"{self.table}: {self.what}"


def differences() -> list[Difference]:
    """Differences of all tables that exist, by DataJoint's own comparison; the schemas must be bound."""
    conn = connection.connect()
    conn.dependencies.load()
    return [d for cls in tables().values() if cls.database and cls().is_declared for d in _compare(conn, cls)]


def _compare(conn: Any, cls: Any) -> list[Difference]:
    name, context = cls.full_table_name, cls.declaration_context
    try:
        # FreeTable reads the columns anew; the class keeps those from before a migration.
        on_server = dj.FreeTable(conn, name).describe(context=context)
        return [
            Difference(name, what) for what in dj.declare.alter(cls.definition, on_server, context, conn.adapter)[0]
        ]
    except NotImplementedError as error:  # DataJoint compares keys, foreign keys and indexes, but does not list them
        return [Difference(name, f"its key, foreign keys or indexes differ ({error})")]
    except dj.DataJointError as error:
        return [Difference(name, f"it cannot be compared ({error})", known=False)]


Say = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Migration:
    """A module of migrations/. `statements(conn)` returns what is still to be done; `changed(conn)` set and gait_method
    ("": all) of the results that have other numbers then, or none until they are computed again; `restated(conn)` the
    visits about which the same is said in other words."""

    number: int
    name: str
    statements: Callable[[Any], list[str]]
    changed: Callable[[Any], list[tuple[str, str]]] = lambda _: []
    restated: Callable[[Any], set[int]] = lambda _: set()

    @property
    def title(self) -> str:
        return title(self.number, self.name)


@dataclasses.dataclass(frozen=True)
class Migrated:
    """Result of a run, or of a dry run. open: differences that no migration removes, as text. touched: visits, slices
    and accepted checks whose results change, in words."""

    steps: list[tuple[str, list[str]]]
    created: list[str]
    open: list[str]
    touched: list[str] = dataclasses.field(default_factory=list)


def available() -> list[Migration]:
    """Return all migrations, in the order of their numbers. Raises ValueError as `tables_version.numbered`."""
    loaded = ((n, name, importlib.import_module(f"pbl_schemas.migrations.{n:04d}_{name}")) for n, name in numbered())
    own = ("statements", "changed", "restated")
    return [Migration(n, name, **{f: getattr(m, f) for f in own if hasattr(m, f)}) for n, name, m in loaded]


def workers_of_other_versions() -> list[str]:
    """Return the live workers of another version of the code, in words."""
    if (connection.schema_name("worker"), "worker") not in catalog.names():
        return []
    rows = connection.connect().query(
        f"SELECT worker_host, worker_pid, worker_version FROM `{connection.schema_name('worker')}`.worker"  # noqa: S608
        " WHERE worker_stopped IS NULL AND worker_resource <> 'cron' AND worker_version <> %s"
        " AND worker_seen > NOW(3) - INTERVAL %s SECOND",
        args=(code_version()[:64], SEEN_S),
    )
    return [f"process {pid} on {host}, pbl-pipeline {version}" for host, pid, version in rows.fetchall()]


def migrate(dry_run: bool = False, say: Say = lambda _: None, force: bool = False) -> Migrated:
    """Bring the tables on the server to their definitions in this version of the code. Safe to repeat.

    Needs an account that may create and alter tables.

    Raises `PblError` DB_MIGRATION when the plan leaves differences that no migration removes (before anything is done),
    when workers of another version are running, when the database has seen a newer version of the code, or when another
    process is migrating it; DB_REFUSED when the account may not alter tables.

    Parameters
    ----------
    dry_run
        Change nothing, return what would be done.
    force
        Go on beside workers of another version, which write rows as their version does until they end.
    """
    refuse_newer()
    if dry_run:
        return _plan()
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute("SELECT GET_LOCK(%s, %s)", (f"{connection.prefix()}_migrate", LOCK_S))
        if (cursor.fetchone() or (0,))[0] != 1:
            raise _error("another process is migrating this database", "one at a time", "wait until it has ended")
        plan = _plan()
        if plan.open:
            raise _differs(plan.open)
        running = workers_of_other_versions() if plan.created or any(s for _, s in plan.steps) else []
        if running and not force:
            raise _error(
                f"workers of another version are running: {'; '.join(running)}",
                "no process that writes rows as another version does",
                "stop them (they end after the job in hand), or repeat with --force",
            )
        for line in plan.touched:
            say(f"  {line}")
        created = _bind(create=True)
        steps = _apply(cursor, say)
    _reread()  # also where nothing was left to do: an earlier run may have ended before it came to this
    if left := list(map(str, differences())):
        raise _differs(left)
    declare_all()
    return Migrated(steps, created, [], plan.touched)


def _bind(create: bool) -> list[str]:
    """Bind the classes to the server's tables; returns what is missing, and creates it if `create`."""
    there, absent = catalog.schemas(), []
    with dj.config.override(database__create_tables=False):
        for stage, module in zip(STAGES, modules(), strict=True):
            name = connection.schema_name(stage)
            if name not in there:
                absent.append(f"{name}: the schema is created")
                if not create:
                    continue
            connection.bind(stage, module.schema)
    for cls in tables().values():
        if cls.database and not cls().is_declared:
            absent.append(f"{cls.full_table_name}: the table is created")
            if create:
                cls().declare(cls.declaration_context)
    return absent


def _reread() -> None:
    """Read the tables' columns anew, and where they come from: DataJoint keeps both from before the migrations."""
    for module in modules():
        module.schema.rebuild_lineage()
    for cls in tables().values():
        read_heading_again(cls)


def _plan() -> Migrated:
    conn, created = connection.connect(), _bind(create=False)
    done = {a.number for a in applied()}
    due = [m for m in available() if m.number not in done]
    steps = [(m.title, m.statements(conn)) for m in due]
    planned = " ".join(s for _, statements in steps for s in statements)
    # What a planned statement changes, and what refers to a table that is still to be created, is compared afterwards.
    left = [str(d) for d in differences() if d.table not in planned and (d.known or not created)]
    return Migrated(steps, created, left, _touched(conn, [m for m, (_, s) in zip(due, steps, strict=True) if s]))


def _touched(conn: Any, due: Sequence[Migration]) -> list[str]:
    """Return the visits, slices and accepted checks whose results these migrations change, in words."""
    if not {(connection.schema_name(s), t) for s, t in _READ} <= set(catalog.names()):
        return []  # a server without results
    sets, visits, slices, members, decisions = (quote(connection.schema_name(s), t) for s, t in _READ)
    of_method = "(%s = '' OR JSON_VALUE(decision_about, '$.gait_method') = %s)"
    queries = (
        f"SELECT subject, session_label FROM {sets} JOIN {visits} USING (session_id) WHERE fit_set = %s LIMIT 1",  # noqa: S608
        f"SELECT JSON_VALUE(decision_about, '$.check'), decision_by FROM {decisions} WHERE decision_what = 'check'"  # noqa: S608
        f" AND JSON_VALUE(decision_about, '$.fit_set') = %s AND {of_method} ORDER BY decision_id",
        f"SELECT study_slice, session_id FROM {members} JOIN {slices} USING (study_slice) WHERE slice_fit_set = %s"  # noqa: S608
        " AND (%s = '' OR gait_method = %s)",
    )
    out, of_slices = list[str](), set[tuple[str, int]]()
    for fit_set, method in sorted({pair for m in due for pair in m.changed(conn)}):
        args = (fit_set, method, method)
        visit, checks, names = (conn.query(q, args=args[: q.count("%s")]).fetchall() for q in queries)
        said = "".join(f"visit {label} of {subject}" for subject, label in visit)
        out.append(f"changes: the results of {said}{f' by {method}' if method else ''}")
        out += [f"changes: the check {c} of {said}, which {who} accepted, is to be accepted again" for c, who in checks]
        of_slices.update(names)
    for some in parts({number for m in due for number in m.restated(conn)}):
        frozen = f"SELECT study_slice, session_id FROM {members} WHERE {inside('session_id', some)}"  # noqa: S608
        of_slices.update(conn.query(frozen).fetchall())
    counts = sorted(Counter(name for name, _ in of_slices).items())
    slices = [f"changes: {n} visits of the slice {name}" for name, n in counts]
    return out + [f"{line}; a backup of before has its numbers" for line in slices]


#: Tables that `_touched` reads.
_READ = (
    ("fit", "fit_set"),
    ("session", "session"),
    ("study", "study_slice"),
    ("study", "study_slice_visit"),
    ("review", "decision"),
)


def _apply(cursor: Any, say: Say) -> list[tuple[str, list[str]]]:
    conn = connection.connect()
    done = {a.number for a in applied()}
    steps = []
    for migration in available():
        if migration.number in done:
            continue
        statements = migration.statements(conn)
        for statement in statements:
            say(f"  {statement}")
            try:
                cursor.execute(statement)
            except pymysql.err.Error as error:
                raise PblError(
                    "DB_REFUSED",
                    key=f"{migration.title}: {statement[:200]}",
                    found=str(error.args[-1]),
                    expected="an account that may alter the tables, and tables that nobody uses at the moment",
                    next_step="stop the workers, use the account pbl_owner (pbl db roles), then repeat: it goes on",
                ) from error
        record(cursor.execute, migration.number, migration.name, statements)
        steps.append((migration.title, statements))
    return steps


def _differs(left: Sequence[str]) -> PblError:
    """DB_MIGRATION, which names one difference a line."""
    lines = "".join(f"\n    {line}" for line in left)
    return _error(
        f"{len(left)} differences that no migration removes:{lines}",
        "tables as this version defines them",
        "they need a migration: see docs/deployment.md, section Upgrade",
    )
