"""Values of a study for its statistics: one row per visit, and the plan of comparisons."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.study import CURVE_POINTS, FIRST_ROLES, StudyData
from pbl_pipeline.words import ANGLES, FOOT_ANGLES, MEASURES, PELVIS_ANGLES

INDEX = "gdi"
_KEY = ["subject", "visit"]


@dataclasses.dataclass(frozen=True)
class Plan:
    """Comparisons of a study."""

    roles: tuple[str, ...]  # by the days of the visits
    groups: tuple[str, ...]  # the changing group first, then by name
    measures: tuple[str, ...]  # names of gait measures, the index first
    scores: tuple[str, ...]  # names of clinical scores
    angles: tuple[str, ...]  # names of joint angles
    change_from: str  # this and the following as in `StudyDescription`, resolved
    change_to: str  # "" in a study of one role
    change_group: str


def visit_table(study: StudyData) -> pd.DataFrame:
    """One row per included visit: `subject, visit, role, days, group`, then a column per measure and score.

    A measure is that of both sides if the study has it, else the mean of left and right; the index is always that of
    the visits. Missing values are NaN. The name of a score that is also a measure has the suffix " (score)".
    """
    visits: Any = study.visits[study.visits["included"]]
    table = visits[[*_KEY, "role", "days", "group", INDEX]]
    if visits[INDEX].isna().all():
        table = table.drop(columns=INDEX)
    measures: Any = study.measures[study.measures["measure"] != INDEX]
    sided = measures[measures["side"] != "both"].groupby([*_KEY, "measure"], sort=False)["value"]
    both = measures[measures["side"] == "both"].set_index([*_KEY, "measure"])["value"]
    # One leg alone has no mean of both.
    means = sided.mean()[sided.count() == 2]
    wide = both.combine_first(means).unstack()
    order = [m for m in (*MEASURES, *dict.fromkeys(measures["measure"])) if m in wide]
    table = table.merge(wide[list(dict.fromkeys(order))].reset_index(), on=_KEY, how="left")
    scores: Any = study.scores
    marks = scores.pivot(index=_KEY, columns="instrument", values="value")
    marks = marks[[i for i in study.instruments["instrument"] if i in marks]]
    marks = marks.rename(columns={i: score_column(study, i) for i in marks})
    return table.merge(marks.reset_index(), on=_KEY, how="left")


def score_column(study: StudyData, instrument: str) -> str:
    """Column of a score in `visit_table`."""
    taken = {INDEX, *study.measures["measure"]}
    return f"{instrument} (score)" if instrument in taken else instrument


def of_scores(study: StudyData, column: str) -> dict[str, Any]:
    """Score -> value of a column of `instruments`."""
    values = zip(study.instruments["instrument"], study.instruments[column], strict=True)
    return {score_column(study, instrument): value for instrument, value in values}


def plan(study: StudyData, change_from: str = "", change_to: str = "", change_group: str = "") -> Plan:
    """Plan the comparisons of a study; arguments of "" are taken from its description, or follow from its visits.

    Raises `PblError` USAGE: a role or group that no included visit has. STUDY_INVALID: no included visit.
    """
    table: Any = visit_table(study)
    if not len(table):
        raise PblError(
            "STUDY_INVALID",
            found="no visit that counts",
            expected="one at least",
            next_step="see the reasons in visits.csv",
            key="visits",
        )
    days = table.groupby("role", sort=False)["days"].median()
    first = {role: role not in FIRST_ROLES for role in days.index}
    roles = tuple(sorted(days.index, key=lambda r: (np.nan_to_num(days[r], nan=1e9), first[r])))
    given = study.description
    start = _known(change_from or given.change_from or roles[0], roles, "role")
    end = _known(change_to or given.change_to or (roles[-1] if len(roles) > 1 else ""), (*roles, ""), "role")
    if start == end:
        raise PblError("USAGE", found=f"change from {start} to {end}", expected="two roles", next_step="name another")
    both = table[table["role"].isin([start, end])].groupby(["group", "subject"]).size()
    names = sorted(set(table["group"]))
    paired = {g: int((both.loc[g] == 2).sum()) if g in both.index.get_level_values(0) else 0 for g in names}
    group = _known(change_group or given.change_group or max(names, key=lambda g: paired[g]), tuple(names), "group")
    scores = tuple(c for i in study.instruments["instrument"] if (c := score_column(study, i)) in table)
    fixed = {*_KEY, "role", "days", "group", *scores}
    there = dict.fromkeys(study.curves["variable"])
    angles = tuple(a for a in dict.fromkeys((*ANGLES, *FOOT_ANGLES, *PELVIS_ANGLES, *there)) if a in there)
    measures = tuple(c for c in table.columns if c not in fixed)
    return Plan(roles, (group, *(g for g in names if g != group)), measures, scores, angles, start, end, group)


def _known(name: str, names: tuple[str, ...], what: str) -> str:
    if name in names:
        return name
    raise PblError(
        "USAGE",
        found=f"{what} {name!r}",
        expected=f"one of {', '.join(n for n in names if n)}",
        next_step="pass a name of visits.csv (visits that count)",
    )


def at_role(table: pd.DataFrame, role: str, column: str, group: str = "") -> pd.Series:
    """Known values of a column at the visit of a role, by subject."""
    frame: Any = table
    rows = frame[(frame["role"] == role) & ((frame["group"] == group) | (group == ""))]
    return rows.set_index("subject")[column].dropna()


def pairs(table: pd.DataFrame, to_compare: Plan, column: str) -> pd.DataFrame:
    """`pre, post` of a column by subject, for the persons of the changing group who have both."""
    group = to_compare.change_group
    pre, post = (at_role(table, r, column, group) for r in (to_compare.change_from, to_compare.change_to))
    return pd.concat({"pre": pre, "post": post}, axis=1, join="inner")


def mean_curves(study: StudyData, angle: str) -> pd.DataFrame:
    """(included visits, 101) mean of the sides of a visit, by subject, role and group; NaN where one is unknown."""
    curves: Any = study.curves[study.curves["variable"] == angle]
    visits: Any = study.visits[study.visits["included"]]
    rows = visits[[*_KEY, "role", "group"]].merge(curves, on=_KEY, how="left")
    keys = [rows["subject"], rows["role"], rows["group"]]
    points = list(CURVE_POINTS)
    unknown = rows[points].isna().groupby(keys, sort=False).any()
    # The tables have only curves without unknown points; the curve of one leg alone is not the mean of both.
    one_sided = rows["side"].groupby(keys, sort=False).nunique() < curves["side"].nunique()
    return rows[points].groupby(keys, sort=False).mean().mask(unknown.apply(lambda c: c | one_sided))


def cycle_values(study: StudyData, to_compare: Plan, measure: str) -> pd.DataFrame:
    """`subject, value` of the cycles of one visit per person, in order: that of `change_from`, else the first included
    one."""
    visits: Any = study.visits[study.visits["included"]]
    order = {r: i for i, r in enumerate([to_compare.change_from, *to_compare.roles])}
    cycles: Any = study.cycles[study.cycles["measure"] == measure]
    rows = cycles.merge(visits.assign(rank=visits["role"].map(order).astype(float))[[*_KEY, "rank"]], on=_KEY)
    rows = rows[rows["rank"] == rows.groupby("subject")["rank"].transform("min")]
    return rows.sort_values(["subject", "cycle", "side"])[["subject", "value"]].dropna()
