"""Walking aids, orthoses, roles and groups that were typed as words of a language, as their codes.

Forces that were refused because of a word for no aid are deleted, and computed again.
"""

# The names are those of our own schemas and columns.
# ruff: noqa: S608

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from pbl_pipeline.texts import code_of
from pbl_schemas import connection
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.operations import catalog
from pbl_schemas.operations.backup_files import literal

#: Schema, table, column, kind of its codes.
_COLUMNS = (
    ("study", "visit", "assistive_device", "aid"),
    ("study", "visit", "orthosis", "orthosis"),
    ("study", "visit", "visit_role", "role"),
    ("lab", "subject", "population", "population"),
    ("kinetics", "__kinetics", "forces_aid", "aid"),
)


def _words(conn: Any) -> Iterator[tuple[str, str, dict[str, str]]]:
    """Yield table, column, and code by word of the words that it has and that have a code."""
    there = catalog.names()
    for stage, name, column, kind in _COLUMNS:
        schema = connection.schema_name(stage)
        if (schema, name) not in there:
            continue
        table = catalog.quote(schema, name)
        words = [str(word) for (word,) in conn.query(f"SELECT DISTINCT {column} FROM {table}").fetchall()]
        yield table, column, {word: code for word in words if (code := code_of(kind, word)) != word}


def restated(conn: Any) -> set[int]:
    """Numbers of the visits whose words become codes."""
    visits, out = catalog.quote(connection.schema_name("session"), "session"), set()
    for table, column, coded in _words(conn):
        if coded and column != "forces_aid":
            key, words = "subject" if column == "population" else "session_id", ", ".join(map(literal, coded))
            of_words = f"SELECT session_id FROM {visits} JOIN {table} USING ({key}) WHERE {column} IN ({words})"
            out |= {int(number) for (number,) in conn.query(of_words).fetchall()}
    return out


def statements(conn: Any) -> list[str]:
    """Updates of the words that have a code, and deletions of the forces."""
    out = []
    for table, column, coded in _words(conn):
        if coded and column == "forces_aid":
            of_none = ", ".join(literal(word) for word, code in coded.items() if code == "none")
            conn.dependencies.load(force=True)
            refused = dj.FreeTable(conn, table) & f"forces_code = 'AID' AND forces_aid IN ({of_none or 'NULL'})"
            below = dj.Diagram.cascade(refused, part_integrity="cascade") if len(refused) else ()
            deleted = [f"DELETE FROM {t.full_table_name}{t.where_clause()}" for t in reversed(list(below)) if len(t)]
            out += ["START TRANSACTION", *deleted, "COMMIT"] if deleted else []
        for word, code in coded.items():
            out.append(f"UPDATE {table} SET {column} = {literal(code)} WHERE {column} = {literal(word)}")
    return out
