"""Kinds of decisions of people as words, so that a new kind changes no table."""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection


def statements(conn: Any) -> list[str]:
    """`decision_what` from an enum to a text."""
    schema = connection.schema_name("review")
    column = conn.query(
        "SELECT data_type FROM information_schema.columns "
        "WHERE table_schema = %s AND table_name = 'decision' AND column_name = 'decision_what'",
        args=(schema,),
    ).fetchone()
    if column is None or column[0] != "enum":
        return []
    about = {"about": "what it is about: names to values, by its kind", "before": "what was before, likewise"}
    about["after"] = "what was decided, likewise"
    what = "its kind, such as person, check, role, score (schemas.decide)"
    return [
        f"ALTER TABLE `{schema}`.`decision`"
        f" MODIFY COLUMN `decision_what` VARCHAR(16) NOT NULL COMMENT ':varchar(16):{what}', "
        + ", ".join(f"MODIFY COLUMN `decision_{k}` JSON NOT NULL COMMENT ':json:{c}'" for k, c in about.items())
    ]
