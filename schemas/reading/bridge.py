"""Results of the tables by two methods of one stage: of which visits, and which comparisons a change touches."""

from __future__ import annotations

from typing import TYPE_CHECKING

from pbl_pipeline import methods
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import MEASURES
from pbl_pipeline.validation import touched

from .. import connection, gdi
from .frames import current_sets, frame_of

if TYPE_CHECKING:
    import pandas as pd

#: Column of SessionGdi -> stage of its methods.
COLUMNS = {"fit_method": "fit", "gait_method": "gait", "gdi_method": "gdi"}


def values_by(old: str, new: str) -> tuple[list[pd.DataFrame], pd.DataFrame]:
    """Return index and measures of the current results by each of two methods, whose other methods are the same, as
    `validation.bridge_pairs` takes them, and the comparisons of visits that the change touches (`validation.touched`).

    old, new: keys of methods, such as "blazepose-v6". Raises `PblError` SOLVER_UNKNOWN where no column has both.
    """
    import pandas as pd

    rows = frame_of(current_sets() * gdi.SessionGdi.proj("session_gdi"))
    column = next((c for c in COLUMNS if {old, new} <= set(rows[c])), "")
    if not column:
        found = sorted({str(key) for c in COLUMNS for key in rows[c]})
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"no results by both {old} and {new}",
            expected=f"keys of two methods of one stage with results: {', '.join(found) or 'there are none'}",
            next_step="compute some visits by both methods, or leave out --tables and compare folders",
        )
    others = ["session_id", "fit_set_kind", *(c for c in (*COLUMNS, "norm") if c != column)]
    keys = gdi.SessionGdi.primary_key
    measures = frame_of((gdi.SessionGdi.Measure & [{column: m} for m in (old, new)]).proj("session_measure_mean"))
    measures = measures.rename(columns={"session_measure": "measure", "session_measure_mean": "value"})
    index = rows[[*keys, "session_gdi"]].rename(columns={"session_gdi": "value"}).assign(measure="gdi")
    long = pd.concat([index, measures[[*keys, "value", "measure"]]]).dropna(subset=["value"])
    long = long.merge(rows[[*keys, "session_id", "fit_set_kind", "subject", "session_label"]], on=keys)
    # One name for a visit and the rest of its chain: two kinds of recordings of a visit are two pairs.
    long["visit"] = long["session_label"] + ", " + long[others[1:]].astype(str).agg(", ".join, axis=1)
    long = long[long["measure"].isin(["gdi", *MEASURES])]
    long["value"] = long["value"].astype(float)
    sides = [long.loc[long[column] == m, ["subject", "visit", "measure", "value"]] for m in (old, new)]
    visits = rows.sort_values(["subject", "session_date", "session_id"])
    visits = visits.assign(old=visits[column] == old, new=visits[column] == new, visit=visits["session_label"])
    visits = visits.groupby(["subject", "session_id", "visit"], sort=False)[["old", "new"]].any().reset_index()
    return sides, touched(visits[visits["old"] | visits["new"]])


def default_methods() -> dict[str, tuple[str, str, str]]:
    """Stage, name and key of the default method of this version, by the column of SessionGdi."""
    known = {column: methods.of_stage(stage) for column, stage in COLUMNS.items()}
    return {column: (stage.name, stage.default, stage[stage.default].key) for column, stage in known.items()}


def changed_defaults() -> list[str]:
    """Return a sentence for each default method of this version of which visits have results by another version alone,
    with the command that shows what the change does. Plain SQL: the tables need not be bound."""
    query, schema = connection.connect().query, connection.schema_name("gdi")
    named = "SELECT 1 FROM information_schema.tables WHERE table_schema = %s AND table_name = '__session_gdi'"
    there = query(named, args=(schema,)).fetchone()
    out = []
    for column, (stage, name, default) in default_methods().items() if there else ():
        counted = f"SELECT {column}, COUNT(DISTINCT session_id) FROM `{schema}`.`__session_gdi` GROUP BY {column}"  # noqa: S608
        for key, n in sorted(query(counted).fetchall()):
            if key != default and key.rpartition("-v")[0] == name:
                out.append(
                    f"The default {stage} method is {default}; {n} visits have results by {key}. "
                    f"pbl validate bridge {key} {default} --tables shows the shift once some have both."
                )
    return out
