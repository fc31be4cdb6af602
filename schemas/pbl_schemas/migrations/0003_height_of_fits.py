"""The body height that a fit was told."""

from __future__ import annotations

from typing import Any

from pbl_schemas import connection


def statements(conn: Any) -> list[str]:
    """The column `fit_height` of SessionFit: null, because no fit of before was told one."""
    schema = connection.schema_name("fit")
    there = conn.query(
        "SELECT 1 FROM information_schema.columns "
        "WHERE table_schema = %s AND table_name = '__session_fit' AND column_name = 'fit_height'",
        args=(schema,),
    ).fetchone()
    if there is not None:
        return []
    comment = ":float64:(m) body height of the person that the fit was told, null: not known"
    column = f"fit_height DOUBLE NULL COMMENT '{comment}' AFTER fit_scale"
    return [f"ALTER TABLE `{schema}`.`__session_fit` ADD COLUMN {column}"]
