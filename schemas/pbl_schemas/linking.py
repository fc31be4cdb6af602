"""A laboratory's own Subject and Session, linked with ours as DataJoint's Elements link a laboratory's tables.

A part `Link` of `lab.Subject` and of `session.Session`, made in linked databases only, refers to the laboratory's row:
all other definitions, keys and databases stay as they are, and deleting a laboratory's row deletes ours with
`part_integrity="cascade"` and is refused without it. A foreign key in our tables would need a migration of every
database; one in a table elsewhere would leave our rows behind.
"""

from __future__ import annotations

import functools
import importlib
import os
from collections.abc import Collection, Iterable, Mapping
from types import ModuleType
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import normalised_label

from . import connection, lab, session
from .datajoint_setup import MySQLOrMariaDB, dj
from .rows import insert_in_parts, parts, rows_inside
from .transactions import in_transaction

_usage = functools.partial(PblError, "USAGE", next_step='see docs/add_table.md, "Link your laboratory\'s tables"')


class Linked:
    """The tables of a linking module, and the names that it gives their rows."""

    def __init__(self, module: ModuleType) -> None:
        """Check the tables. Raises `PblError` USAGE where they cannot be linked."""
        self.module = module.__name__
        self.subject, self.session = (self._table(module, name) for name in ("Subject", "Session"))
        parents = self.session().parents(foreign_key_info=True)
        references = [how for parent, how in parents if parent == self.subject.full_table_name]
        if not references:
            raise _usage("Session does not refer to Subject", "a foreign key from it", key=self.module)
        #: Columns of its Session that refer to its Subject -> the columns there.
        self.owner: dict[str, str] = max(references, key=lambda how: how["primary"])["attr_map"]
        label = [name for name in self.session.primary_key if name not in self.owner] or self.session.primary_key
        self.subject_code = getattr(module, "subject_code", functools.partial(_joined, self.subject.primary_key))
        self.session_label = getattr(module, "session_label", functools.partial(_joined, label))

    def _table(self, module: ModuleType, name: str) -> Any:
        table, ours, prefix = getattr(module, name, None), connection.connect(), f"{connection.prefix()}_"
        if not (isinstance(table, type) and issubclass(table, dj.Table)):
            raise _usage(f"{name} is {table!r}", "the laboratory's DataJoint class of that name", key=self.module)
        if not table.database or not table().is_declared:
            raise _usage(f"{name} has no table on the server", "a schema that is activated", key=self.module)
        if table.database.startswith(prefix):
            found = f"{name} is in {table.database}, where columns such as session_id are taken for ours"
            raise _usage(found, f"a schema whose name does not begin with {prefix}", key=self.module)
        if table.connection is not ours or not isinstance(ours.adapter, MySQLOrMariaDB):
            next_step = "pass the module's name, or call pbl_schemas.connection.connect() before you import it"
            raise _usage("it connected before pbl_schemas did", "one connection", next_step=next_step, key=self.module)
        return table

    def people(self) -> dict[str, dict[str, Any]]:
        """Return the key of each person by our code. Raises `PblError` USAGE for a code of two."""
        return self._named((normalised_label(str(self.subject_code(key))), key) for key in self.subject.keys())  # noqa: SIM118

    def visits(self, people: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        """Return the key of each visit of these people by `code/label`. Raises `PblError` USAGE for a name of two."""
        codes = {tuple(key[name] for name in self.owner.values()): code for code, key in people.items()}
        owners = (dict(zip(self.owner, values, strict=True)) for values in codes)
        found = []
        for row in (r for some in parts(owners) for r in (self.session & some).proj(*self.owner).to_dicts()):
            key = {name: row[name] for name in self.session.primary_key}
            label = normalised_label(str(self.session_label(key)))
            found.append((f"{codes[tuple(row[name] for name in self.owner)]}/{label}", key))
        return self._named(found)

    def _named(self, pairs: Iterable[tuple[str, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
        out: dict[str, dict[str, Any]] = {}
        for name, key in pairs:
            if out.setdefault(name, key) is not key:
                raise _usage(f"{name} for {out[name]} and {key}", "one row of each name", key=self.module)
        return out


_linked: Linked | None = None


def _joined(columns: Iterable[str], key: Mapping[str, Any]) -> str:
    values = [key[column] for column in columns]
    return "_".join(v.isoformat() if hasattr(v, "isoformat") else str(v) for v in values)


def load(module: ModuleType | str) -> Linked:
    """Return the tables of a linking module; a name is imported. Raises `PblError` USAGE where it cannot be linked."""
    connection.connect()
    if isinstance(module, str):
        try:
            module = importlib.import_module(module)
        except Exception as error:
            found = f"it cannot be imported ({type(error).__name__}: {error})"
            raise _usage(found, "an installed module, or one in a folder of PYTHONPATH", key=module) from error
    return Linked(module)


def schemas() -> list[str]:
    """Return the schemas of the tables that PBL_LINKING_MODULE links. Raises what `load` raises."""
    module = os.environ.get("PBL_LINKING_MODULE")
    tables = [linked for named in [load(module)] for linked in (named.subject, named.session)] if module else []
    return sorted({table.database for table in tables})


def link(module: ModuleType | str | None, create_tables: bool = True) -> None:
    """Bind the links to the tables of a linking module; None: of PBL_LINKING_MODULE, unless one is linked already.

    Where the links are made here, people and visits that both have already are linked. Raises what `load` raises;
    `PblError` USAGE for a name of two rows, or links that refer to other tables. Nothing is made then.
    """
    global _linked
    chosen = module or (None if _linked else os.environ.get("PBL_LINKING_MODULE"))
    if not chosen or (_linked and _linked.module == getattr(chosen, "__name__", chosen)):
        return
    linked = load(chosen)
    pairs = ((lab, lab.Subject, linked.subject), (session, session.Session, linked.session))
    new = not _links(session.Session).is_declared
    if new:
        linked.visits(linked.people())
    elif wrong := [t for _, t, theirs in pairs if theirs.full_table_name not in _links(t).parents()]:
        found = f"links of {wrong[0].__name__} refer to {_links(wrong[0]).parents()}"
        raise _usage(found, "the tables of this module", key=linked.module)
    for stage, table, theirs in pairs:
        table.Link = _part(theirs)
        stage.schema(table, context={**vars(stage), "theirs": theirs})
    _linked = linked
    if new and create_tables:
        link_registered()


def _part(theirs: Any) -> Any:
    class Link(dj.Part):
        definition = f"""
        # row of the laboratory's own table
        -> master
        ---
        -> [unique] theirs.proj({", ".join(f"{new}='{old}'" for new, old in columns_of(theirs).items())})
        """

    return Link


def columns_of(theirs: Any) -> dict[str, str]:
    """Columns by which a link refers to a laboratory's table, with names that none of ours has -> the columns there."""
    return {f"linked_{name}": name for name in theirs.primary_key}


def visits_of(sessions: Any) -> Any:
    """Return the keys of our visits of rows of the laboratory's Session, by which our tables are restricted. Raises
    `PblError` DB_REFUSED where none is linked."""
    return session.Session.proj() & (session.Session.Link & sessions.proj(**columns_of(_required().session)))


def link_registered() -> None:
    """Link people and visits that were registered before the laboratory's tables had them."""

    def work() -> None:
        link_people(lab.Subject.to_arrays("subject"), only_known=True)
        rows = session.Session.to_dicts()
        link_visits({(r["subject"], r["session_label"]): r["session_id"] for r in rows}, only_known=True)

    in_transaction(work)


def link_people(codes: Iterable[str], only_known: bool = False) -> None:
    """Link registered people, in a linked database, with the laboratory's. Call it in a transaction.

    Raises `PblError` DB_NOT_FOUND for a person whom the laboratory does not have (unless `only_known`); DB_REFUSED in a
    process without the linking module.
    """
    if lacking := _without_link(lab.Subject, codes):
        linked = _required()
        _insert(lab.Subject, linked.subject, dict(zip(lacking, lacking, strict=True)), linked.people(), only_known)


def link_visits(numbers: Mapping[tuple[str, str], int], only_known: bool = False) -> None:
    """Link registered visits (code and label -> session_id) with the laboratory's, as `link_people` does people."""
    lacking = set(_without_link(session.Session, numbers.values()))
    names = {number: f"{code}/{normalised_label(label)}" for (code, label), number in numbers.items()}
    if wanted := {name: number for number, name in names.items() if number in lacking}:
        linked, codes = _required(), {code for code, _ in numbers}
        visits = linked.visits({code: key for code, key in linked.people().items() if code in codes})
        _insert(session.Session, linked.session, wanted, visits, only_known)


def _insert(master: Any, theirs: Any, wanted: Mapping[str, Any], found: Mapping[str, Any], only_known: bool) -> None:
    absent = [name for name in wanted if name not in found]
    if absent and not only_known:
        raise PblError(
            "DB_NOT_FOUND",
            found=f"no row of the laboratory's {theirs.__name__} is named {', '.join(absent[:5])}",
            expected="people and visits of the laboratory's tables, which this database is linked with",
            next_step=f"enter it in {theirs.full_table_name.replace('`', '')} first, or correct code and label",
        )
    columns, (ours,) = columns_of(theirs).items(), master.primary_key
    rows = ((number, found[name]) for name, number in wanted.items() if name in found)
    insert_in_parts(master.Link, ({ours: number, **{new: key[old] for new, old in columns}} for number, key in rows))


def _without_link(master: Any, keys: Iterable[Any]) -> Collection[Any]:
    """Keys of a table that have no link; none in a database that is not linked."""
    links, (column,), keys = _links(master), master.primary_key, list(keys)
    if not links.is_declared:
        return []
    there = {row[column] for row in rows_inside(links.proj(), column, keys)}
    return [key for key in keys if key not in there]


def _links(master: Any) -> Any:
    """The table of links, for processes without the linking module."""
    return dj.FreeTable(connection.connect(), f"`{master.database}`.`{master.table_name}__link`")


def _required() -> Linked:
    if _linked is None:
        raise PblError(
            "DB_REFUSED",
            found="this database is linked with a laboratory's tables, and this process does not know them",
            expected="the linking module, so that new people and visits are those of the laboratory",
            next_step="set PBL_LINKING_MODULE to its name, or call pbl_schemas.activate(linking_module=...)",
        )
    return _linked
