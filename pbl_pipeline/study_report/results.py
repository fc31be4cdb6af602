"""Statistics of a study as long tables: one row per number, with its interval, or the code of the reason why not."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd
from scipy import stats as distributions

from pbl_pipeline.errors import PblError
from pbl_pipeline.stats import (
    CurveTest,
    adjust,
    compare_groups,
    correlation,
    curve_test,
    hedges_g,
    icc,
    niqr,
    ratings_table,
    srm,
    wilcoxon,
)
from pbl_pipeline.study import StudyData, classes_of

from .visit_values import INDEX, Plan, at_role, cycle_values, mean_curves, of_scores, pairs, visit_table

#: Two-sided level of significance (the paper, Statistics).
ALPHA = 0.05
#: Columns of the tables of `StudyResults`.
_INTERVAL, _WHY = ("value", "low", "high"), ("code", "message")
COLUMNS = {
    "by_visit": ["name", "group", "role", "n", "mean", "low", "high", "sd", "median", "niqr"],
    "repeatability": ["name", "of", "group", "kind", *_INTERVAL, "sem", "mdc90", "mdc95", "n", "k", *_WHY],
    "validity": ["name", "score", "persons", "kind", *_INTERVAL, "p", "p_holm", "n", *_WHY],
    "change": ["name", "n", "statistic", *_INTERVAL, "p", "p_holm", *_WHY],
    "groups": ["name", "by", "a", "b", "test", "statistic", "p", "p_holm", "g", "g_low", "g_high", "n_a", "n_b", *_WHY],
}


@dataclasses.dataclass(frozen=True)
class CurveResult:
    """A comparison of mean curves of an angle."""

    angle: str  # name
    comparison: str  # "change", or two names
    test: CurveTest | PblError  # the test, or the reason why there is none
    left_out: int  # persons whose curves have unknown points
    a: np.ndarray  # (N, 101) curves of the persons tested; of "change" those after
    b: np.ndarray  # (M, 101) likewise; of "change" those before
    names: tuple[str, str]  # of a and b


@dataclasses.dataclass(frozen=True)
class StudyResults:
    """All statistics of a report; every frame is long, `code` and `message` are "" if there is a value."""

    plan: Plan  # what was compared
    table: pd.DataFrame  # `visit_table` of the study
    flow: pd.DataFrame  # persons and visits by group and role, with the reasons why visits do not count
    by_visit: pd.DataFrame  # mean with Student's interval
    repeatability: pd.DataFrame  # of the cycles of one visit, and of visits
    validity: pd.DataFrame  # correlation with scores at the visit `change_from`
    change: pd.DataFrame  # a row per name and statistic: "mean", "srm", "effect_size"
    groups: pd.DataFrame  # groups, and classes of a score, at `change_from`
    curves: tuple[CurveResult, ...]  # one per angle and comparison


def study_results(study: StudyData, to_compare: Plan, permutations: int = 10_000) -> StudyResults:
    """Compute all statistics of a study. Those that the values do not support have the code STATS_INPUT."""
    table = visit_table(study)
    return StudyResults(
        to_compare,
        table,
        flow_table(study, to_compare),
        visit_means(table, to_compare),
        repeatability(study, to_compare, table),
        validity(study, to_compare, table),
        change(to_compare, table),
        group_differences(study, to_compare, table),
        tuple(curve_results(study, to_compare, permutations)),
    )


def _tried(function: Callable[..., Any], *values: Any, **options: Any) -> tuple[Any, dict[str, str]]:
    """Return the result of a function with empty `code` and `message`; or None and those of its error."""
    try:
        return function(*values, **options), {"code": "", "message": ""}
    except PblError as error:
        return None, {"code": error.code, "message": reason(error)}


def reason(error: PblError) -> str:
    """Return the reason of a missing statistic; for too few values, one per person, the number of persons needed."""
    least = re.fullmatch(r"at least (\d+)(?: subjects)?", error.expected)
    return f"at least {least[1]} persons needed" if least else f"{error.found}; expected {error.expected}"


def _fields(found: object | None, *names: str) -> dict[str, Any]:
    """Fields of a result as columns of a row; empty without a result, so that the frame has NaN."""
    return {} if found is None else {name: getattr(found, name) for name in names}


def flow_table(study: StudyData, to_compare: Plan) -> pd.DataFrame:
    """Participant flow by group and role; `reasons` as "reason (n); ...". `persons` is that of the whole group."""
    visits: Any = study.visits
    roles = [*to_compare.roles, *(r for r in dict.fromkeys(visits["role"]) if r not in to_compare.roles)]
    names = [*to_compare.groups, *(g for g in sorted(set(visits["group"])) if g not in to_compare.groups)]
    rows = []
    for group in names:
        of_group = visits[visits["group"] == group]
        for role in roles:
            own = of_group[of_group["role"] == role]
            out = own[~own["included"]]
            counts = out["reason"].value_counts()
            rows.append(
                {
                    "group": group,
                    "role": role,
                    "persons": of_group["subject"].nunique(),
                    "took_place": len(own),
                    "excluded": len(out),
                    "counted": len(own) - len(out),
                    "without_index": int(own.loc[own["included"], INDEX].isna().sum()),
                    "reasons": "; ".join(f"{reason} ({n})" for reason, n in counts.items()),
                }
            )
    return pd.DataFrame(rows)


def visit_means(table: pd.DataFrame, to_compare: Plan) -> pd.DataFrame:
    """Mean with its 95 % interval (Student's t), standard deviation, median and nIQR, by measure, group and role."""
    rows = []
    names = (*to_compare.measures, *to_compare.scores)
    for name, group, role in itertools.product(names, to_compare.groups, to_compare.roles):
        values = at_role(table, role, name, group).to_numpy(float)
        if len(values):
            rows.append({"name": name, "group": group, "role": role, "n": len(values), **summary(values)})
    return pd.DataFrame(rows, columns=COLUMNS["by_visit"])


def summary(values: np.ndarray) -> dict[str, float]:
    """`mean, low, high` (Student's 95 % interval), `sd, median, niqr` of (N,) values; one value has only mean and
    median, the others are NaN."""
    n, mean = len(values), float(values.mean())
    sd = float(values.std(ddof=1)) if n > 1 else np.nan
    half = float(distributions.t.isf(0.025, n - 1)) * sd / np.sqrt(n) if n > 1 else np.nan
    return {
        "mean": mean,
        "low": mean - half,
        "high": mean + half,
        "sd": sd,
        "median": float(np.median(values)),
        "niqr": niqr(values) if n > 1 else np.nan,
    }


def repeatability(study: StudyData, to_compare: Plan, table: pd.DataFrame) -> pd.DataFrame:
    """ICC, SEM and minimal detectable change, from the cycles of one visit and from visits.

    Of cycles: "2,1" and "2,k" of all persons (the paper's Table 2) and "1,1" (docs/statistics.md, Which ICC). Of
    visits, by group: "2,1" with the generalized interval, and "3,1", which leaves out a shift that all persons share.
    In a group that changes, persons who change differently count as error in both.
    """
    rows: list[dict[str, Any]] = []

    def add(name: str, of: str, kind: str, group: str, ratings: Callable[[], Any], interval: str) -> None:
        found, why = _tried(lambda: icc(ratings(), kind, interval=interval))
        values = _fields(found, *_INTERVAL, "sem", "mdc90", "mdc95", "n", "k")
        rows.append({"name": name, "of": of, "group": group, "kind": kind, **values, **why})

    for name in to_compare.measures:
        cycles = cycle_values(study, to_compare, name)
        for kind in ("2,1", "2,k", "1,1") if len(cycles) else ():
            add(name, "cycles", kind, "all", lambda c=cycles: ratings_table(c["value"], c["subject"]), "f")
    for name in (*to_compare.measures, *to_compare.scores):
        for group in to_compare.groups:
            own: Any = table[table["group"] == group]
            wide = own.pivot(index="subject", columns="role", values=name).dropna(how="all").dropna(axis=1, how="all")
            if len(wide):
                for kind, interval in (("2,1", "generalized"), ("3,1", "f")):
                    add(name, "visits", kind, group, lambda w=wide: w.to_numpy(float), interval)
    return pd.DataFrame(rows, columns=COLUMNS["repeatability"])


def validity(study: StudyData, to_compare: Plan, table: pd.DataFrame) -> pd.DataFrame:
    """Correlation of each measure with each score at the visit `change_from`: all persons who have both, and the
    changing group if that is not all of them. Spearman for ordinal scores, else Pearson (the paper, Statistics)."""
    ordinal = of_scores(study, "ordinal")
    at: Any = table[table["role"] == to_compare.change_from]
    rows = []
    for name, score in itertools.product(to_compare.measures, to_compare.scores):
        both = at.dropna(subset=[name, score])
        own = both[both["group"] == to_compare.change_group]
        parts = {"all": both} if len(own) in (0, len(both)) else {"all": both, to_compare.change_group: own}
        for persons, part in parts.items():
            kind = "spearman" if ordinal[score] else "pearson"
            found, why = _tried(correlation, part[name], part[score], kind)
            about = {"name": name, "score": score, "persons": persons, "kind": kind, "n": len(part)}
            rows.append({**about, **_fields(found, *_INTERVAL, "p"), **why})
    return _corrected(pd.DataFrame(rows, columns=COLUMNS["validity"]), "persons")


def change(to_compare: Plan, table: pd.DataFrame, resamples: int = 10_000) -> pd.DataFrame:
    """Change of the changing group by measure and score: "mean" (Student's interval), "srm" (jackknife; the paper,
    Statistics) and "effect_size" (Wilcoxon; the paper, Responsiveness), each over the persons with both visits."""
    rows = []
    for name in (*to_compare.measures, *to_compare.scores):
        both = pairs(table, to_compare, name)
        pre, post = both["pre"].to_numpy(float), both["post"].to_numpy(float)
        shared = {"name": name, "n": len(both)}
        moved, why_moved = _tried(srm, pre, post)
        mean = summary(post - pre) if moved is not None else {}
        middle = {"value": mean["mean"], "low": mean["low"], "high": mean["high"]} if mean else {}
        rows.append({**shared, "statistic": "mean", **middle, **why_moved})
        rows.append({**shared, "statistic": "srm", **_fields(moved, *_INTERVAL, "p"), **why_moved})
        tested, why = _tried(wilcoxon, pre, post, n_resamples=resamples)
        effect = _fields(tested and tested.effect, *_INTERVAL) | _fields(tested, "p")
        rows.append({**shared, "statistic": "effect_size", **effect, **why})
    return _corrected(pd.DataFrame(rows, columns=COLUMNS["change"]), "statistic")


def group_differences(study: StudyData, to_compare: Plan, table: pd.DataFrame) -> pd.DataFrame:
    """Compare each measure between groups, and between neighbouring classes of a score, at the visit `change_from`, by
    the paper's test (Statistics) and Hedges' g."""
    at: Any = table[table["role"] == to_compare.change_from]
    kinds = {"group": at["group"]} | score_classes(study, to_compare, at)
    rows = []
    for by, labels in kinds.items():
        names = list(to_compare.groups) if by == "group" else list(labels.cat.categories)
        others = itertools.combinations(names, 2) if by == "group" else itertools.pairwise(names)
        for name, (a, b) in itertools.product(to_compare.measures, others):
            x, y = (at.loc[labels == v, name].dropna().to_numpy(float) for v in (a, b))
            if not len(x) or not len(y):
                continue
            test, why = _tried(compare_groups, x, y)
            size, _ = _tried(hedges_g, x, y)
            row = {"name": name, "by": by, "a": a, "b": b, "test": "", "n_a": len(x), "n_b": len(y), **why}
            if test is not None:
                row |= {"test": test.name, "statistic": test.statistic, "p": test.p}
            if test is not None and size is not None:
                row |= {"g": size.value, "g_low": size.low, "g_high": size.high}
            rows.append(row)
    return _corrected(pd.DataFrame(rows, columns=COLUMNS["groups"]), "by")


def _corrected(tests: pd.DataFrame, family: str) -> pd.DataFrame:
    """Add `p_holm`: p corrected (Holm) for the tests with the same value in the column `family`."""
    known: Any = tests[tests["p"].notna()]
    for _, of_family in known.groupby(family):
        tests.loc[of_family.index, "p_holm"] = adjust(of_family["p"])
    return tests


def score_classes(study: StudyData, to_compare: Plan, table: Any) -> dict[str, Any]:
    """Score -> class of each row of a table, in order from the lowest, of the scores that have classes."""
    found = {}
    for score, text in of_scores(study, "classes").items():
        classes = classes_of(text)
        if len(classes) > 1 and score in to_compare.scores:
            edges = [v for v, _ in classes]
            found[score] = pd.cut(table[score], [*edges, np.inf], right=False, labels=[w for _, w in classes])
    return found


def curve_results(study: StudyData, to_compare: Plan, permutations: int = 10_000) -> list[CurveResult]:
    """Compare the curves of each angle: the changing group before and after (paired), and with other groups before."""
    found = []
    for angle in to_compare.angles:
        curves = mean_curves(study, angle)

        def of(role: str, group: str, curves: pd.DataFrame = curves) -> pd.DataFrame:
            frame: Any = curves
            rows = (frame.index.get_level_values("role") == role) & (frame.index.get_level_values("group") == group)
            return frame[rows].droplevel(["role", "group"])

        start, own = to_compare.change_from, to_compare.change_group
        before, after = of(start, own), of(to_compare.change_to, own)
        both = before.index.intersection(after.index)
        found.append(
            _compared(angle, "change", after.loc[both], before.loc[both], (to_compare.change_to, start), permutations)
        )
        for group in to_compare.groups[1:]:
            other = of(start, group)
            if len(other):
                found.append(_compared(angle, f"{own} and {group}", before, other, (own, group), permutations))
    return found


def _compared(
    angle: str,
    comparison: str,
    a: pd.DataFrame,
    b: pd.DataFrame,
    names: tuple[str, str],
    permutations: int,
) -> CurveResult:
    paired = comparison == "change"
    known_a, known_b = (np.isfinite(x.to_numpy(float)).all(axis=1) for x in (a, b))
    if paired:
        known_a = known_b = known_a & known_b
    x, y = a.to_numpy(float)[known_a], b.to_numpy(float)[known_b]
    left_out = int((~known_a).sum()) + (0 if paired else int((~known_b).sum()))
    try:
        test: CurveTest | PblError = curve_test(x, y, paired=paired, alpha=ALPHA, n_permutations=permutations)
    except PblError as error:
        test = error
    return CurveResult(angle, comparison, test, left_out, x, y, names)
