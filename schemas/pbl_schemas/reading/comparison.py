"""Two to six results side by side: of visits of a person, of people, or of one visit by several chains of methods."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from pbl_pipeline import methods
from pbl_pipeline.change import Change, change_since, measure_changes, not_alike, usual_chain
from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import Difference
from pbl_pipeline.gait import MEASURES
from pbl_pipeline.validation import touched

from .. import connection, fit, gait, gdi, study, video
from . import frames
from .frames import current_sets, frame_of
from .shown import ShownVisit, shown_visit
from .visit_list import results_of

if TYPE_CHECKING:
    import pandas as pd

#: Column of SessionGdi -> stage of its methods.
COLUMNS = {"fit_method": "fit", "gait_method": "gait", "gdi_method": "gdi"}


def values_by(old: str, new: str) -> tuple[list[pd.DataFrame], pd.DataFrame]:
    """Return index and measures of the current results by each of two methods, whose other methods are the same, as
    `validation.bridge_pairs` takes them, and the comparisons of visits that the change touches (`validation.touched`).

    old, new: keys of methods, such as "blazepose-v6". Raises `PblError` SOLVER_UNKNOWN if no column has both.
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


#: Fewest and most results that are compared.
FEWEST, MOST = 2, 6


@dataclasses.dataclass(frozen=True)
class Cycle:
    """A gait cycle of a recording that counts: from an initial contact of a side to its next (s)."""

    video_id: int
    video_name: str
    side: str
    start_s: float
    end_s: float


@dataclasses.dataclass(frozen=True)
class Score:
    """A clinical score. change: against the reference; important: whether that is at least the minimal important change
    of the instrument for a score like that of the reference, None if none is taken over."""

    value: float
    change: float | None
    important: bool | None


@dataclasses.dataclass(frozen=True)
class Side:
    """One of the visits that are compared, with its changes against the reference."""

    about: ShownVisit
    curves: pd.DataFrame  # of `frames.cycle_curves`
    cycles: tuple[Cycle, ...]
    scores: dict[str, Score]
    change: Change | None  # of the index; None for the reference itself
    changes: dict[str, Change]  # of `ShownVisit.all_measures`
    differs: tuple[Difference, ...]  # what was not made or filmed like the reference

    @property
    def far_leg(self) -> str:
        """The leg whose curves are less certain, as one camera saw it behind the other; empty if there is none."""
        filming = None if self.about.result is None else self.about.result.filming
        return "" if filming is None else filming.far_leg


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The results in the order of their days; `reference`: the place of the one that the others are compared with.
    instruments: rows of ClinicalInstrument of which any visit has a score, by name."""

    compared: tuple[Side, ...]
    reference: int
    instruments: dict[str, dict[str, Any]]

    @property
    def same_methods(self) -> bool:
        """True if one chain of methods made all results."""
        return len({r.chain for c in self.compared if (r := c.about.result) is not None}) <= 1


def compare(chosen: Sequence[tuple[int, int | None]], reference: tuple[int, int | None] | None = None) -> Comparison:
    """Compare results.

    Raises `PblError` USAGE for fewer than two or more than six, DB_NOT_FOUND for an unknown visit or result.

    `chosen`: `session_id` of each, and which of its results (the order of `visit_list.results_of`); None: by the chain
    of methods that most of the visits have. `reference`: one of `chosen`; None: the earliest.
    """
    chosen = list(dict.fromkeys(chosen))
    if not FEWEST <= len(chosen) <= MOST:
        raise PblError(
            "USAGE",
            found=f"{len(chosen)} chosen" if len(chosen) != 1 else "one chosen",
            expected=f"{FEWEST} to {MOST} visits, or results of one visit by several methods",
            next_step="tick them in the list of a person's visits, on the page of any of them",
        )
    results = results_of({i for i, _ in chosen})
    usual = usual_chain(results)
    pages: list[tuple[tuple[int, int | None], ShownVisit]] = []
    for one in chosen:
        session_id, number = one
        if number is None:
            chains = [r.chain for r in results[session_id]]
            number = chains.index(usual) if usual in chains else 0
        page = shown_visit(session_id, number)
        if all((p.row.session_id, p.shown) != (session_id, page.shown) for _, p in pages):
            pages.append((one, page))
    pages.sort(key=lambda p: (p[1].row.day is not None, p[1].row.day, p[1].row.session_id))  # as `visit_before`
    at = next((i for i, (one, _) in enumerate(pages) if one == reference), 0)
    first = pages[at][1]
    ids = {p.row.session_id for _, p in pages}
    scores = _scores(ids)
    names = {n for of_visit in scores.values() for n in of_visit}
    known = (study.ClinicalInstrument & [{"instrument": n} for n in names]).to_dicts() if names else []
    instruments = {r["instrument"]: r for r in sorted(known, key=lambda r: r["instrument"])}
    out = tuple(_compared(page, first, scores, instruments) for _, page in pages)
    return Comparison(out, at, instruments)


def _compared(
    about: ShownVisit, first: ShownVisit, scores: dict[int, dict[str, float]], instruments: dict[str, dict[str, Any]]
) -> Side:
    change, changes, differs = None, {}, ()
    if about is not first:
        if about.result is not None and first.result is not None:
            change, differs = change_since(about.result, first.result), not_alike(about.result, first.result)
        mine, old = ({n: m for n, (m, _) in v.all_measures.items()} for v in (about, first))
        changes = measure_changes(mine, old, differs)
    before = scores[first.row.session_id] if about is not first else {}
    return Side(
        about=about,
        curves=frames.cycle_curves(about.key or False),
        cycles=_cycles(about.key) if about.key else (),
        scores={n: _score(v, before.get(n), instruments[n]) for n, v in scores[about.row.session_id].items()},
        change=change,
        changes=changes,
        differs=differs,
    )


def _scores(ids: set[int]) -> dict[int, dict[str, float]]:
    out: dict[int, dict[str, float]] = {i: {} for i in ids}
    for row in (study.ClinicalScore & [{"session_id": i} for i in ids]).to_dicts():
        out[int(row["session_id"])][row["instrument"]] = float(row["score_value"])
    return out


def _score(value: float, before: float | None, instrument: dict[str, Any]) -> Score:
    if before is None:
        return Score(value, None, None)
    least = study.important_change(instrument, before)
    return Score(value, value - before, None if least is None else abs(value - before) >= least)


def _cycles(key: Mapping[str, Any]) -> tuple[Cycle, ...]:
    """The cycles of a result that count, in the order of recordings and time; those without pictures left out."""
    cycles = gait.GaitCycle.Cycle * fit.FitSet.proj() * video.Video.proj("video_name", "camera_motion")
    of_result = {k: key[k] for k in ("fit_set", "fit_method", "gait_method")}
    rows = (cycles & of_result & {"cycle_used": True} & f"camera_motion != '{video.NO_CAMERA}'").to_dicts()
    found = [
        Cycle(int(r["video_id"]), r["video_name"], r["cycle_side"], float(r["cycle_start"]), float(r["cycle_end"]))
        for r in rows
    ]
    return tuple(sorted(found, key=lambda c: (c.video_id, c.start_s)))
