"""Minimal important changes by the score before, and the classes and bounds of two instruments that ship."""

# The names are those of our own schemas and columns.
# ruff: noqa: S608

from __future__ import annotations

from typing import Any

from pbl_schemas import connection
from pbl_schemas.instruments import INSTRUMENTS

#: Instrument -> column -> the value that shipped until now. A value that a laboratory has changed stays.
_SHIPPED: dict[str, dict[str, Any]] = {
    "mJOA": {
        "minimal_change_source": "ROC analysis, degenerative cervical myelopathy 12 months after surgery, depends on "
        "severity: Tetreault et al. 2015, Spine 40:1653-1659"
    },
    "BBS": {
        "instrument_source": "the scale: Berg et al. 1992, Can J Public Health 83 Suppl 2:S7-11",
        "instrument_classes": "0 high risk; 21 medium risk; 41 low risk",
    },
    "mRS": {
        "instrument_source": "the scale: van Swieten et al. 1988, Stroke 19:604-607",
        "instrument_high": 6,
    },
}


def statements(conn: Any) -> list[str]:
    """The column `minimal_change_classes`, the one of mJOA, and what shipped of BBS and mRS in its new form.

    mRS ends at 5 where no visit has a 6 (dead), which then would lie outside.
    """
    schema = connection.schema_name("study")
    table = f"`{schema}`.`#clinical_instrument`"
    rows = conn.query(
        "SELECT column_name FROM information_schema.columns WHERE table_schema = %s"
        " AND table_name = '#clinical_instrument'",
        args=(schema,),
    )
    there = {str(row[0]) for row in rows.fetchall()}
    if not there:  # a server without tables, of which a dry run asks
        return []
    new = {row["instrument"]: row for row in INSTRUMENTS}
    out = []
    if "minimal_change_classes" not in there:
        classes = "classes by lowest value, such as: 0 high risk; 41 at risk; 51 low risk"
        changes = "minimal_change by lowest value before, such as: 0 3; 12 2; 15 1; empty: at all values"
        out = [
            f"ALTER TABLE {table} MODIFY COLUMN instrument_classes VARCHAR(255) NOT NULL DEFAULT ''"
            f" COMMENT '{classes}', ADD COLUMN minimal_change_classes VARCHAR(255) NOT NULL DEFAULT ''"
            f" COMMENT '{changes}' AFTER instrument_classes",
        ]
    of_mjoa = "instrument = 'mJOA' AND minimal_change = 2"
    unfilled = f"SELECT 1 FROM {table} WHERE {of_mjoa} AND minimal_change_classes = ''"
    if out or conn.query(unfilled).fetchone() is not None:  # also after a run that ended between the two statements
        out.append(
            f"UPDATE {table} SET minimal_change_classes = '{new['mJOA']['minimal_change_classes']}' WHERE {of_mjoa}"
        )
    for name, columns in _SHIPPED.items():
        for column, value in columns.items():
            where = f"instrument = '{name}' AND {column} = '{value}'"
            if column == "instrument_high":
                where += f" AND NOT EXISTS (SELECT 1 FROM `{schema}`.clinical_score"
                where += f" WHERE instrument = '{name}' AND score_value > {new[name][column]:g})"
            if conn.query(f"SELECT 1 FROM {table} WHERE {where}".replace("%", "%%")).fetchone() is not None:
                out.append(f"UPDATE {table} SET {column} = '{new[name][column]}' WHERE {where}")
    return out
