"""Tables of a study for the page: the paper's Table 2 and SRM table, and others."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline import words
from pbl_pipeline.latex import tex_escape
from pbl_pipeline.stats import CurveTest
from pbl_pipeline.study import StudyData
from pbl_pipeline.words import ANGLES, FOOT_ANGLES, MEASURES, PELVIS_ANGLES, TASKS, role_words

from .results import ALPHA, StudyResults, reason
from .visit_values import INDEX, Plan, of_scores

GAIT, SCORES = "Gait measures", "Clinical scores"
_MINUS = "\N{MINUS SIGN}"
_NONE = "\N{EN DASH}"
_INDICES = {INDEX: "GDI", "gps_deg": "Gait Profile Score"}
#: Note of tables with stars; the family of tests follows.
_STARS = "* p < 0.05 after Holm's correction for the tests of"


@dataclasses.dataclass(frozen=True)
class PageTable:
    """A table as shown on the page."""

    name: str  # stem of its files
    title: str
    note: str  # how to read it
    body: pd.DataFrame  # texts; its columns may have two levels
    messages: tuple[tuple[str, str], ...] = ()  # reasons for cells without a number: (mark of the cells, text)

    def head(self) -> list[list[tuple[str, int]]]:
        """Rows of the head: (text, columns that it spans)."""
        rows = []
        for level in range(self.body.columns.nlevels):
            cells: list[tuple[str, int]] = []
            for text in map(str, self.body.columns.get_level_values(level)):
                if cells and text and cells[-1][0] == text and level + 1 < self.body.columns.nlevels:
                    cells[-1] = (text, cells[-1][1] + 1)
                else:
                    cells.append((text, 1))
            rows.append(cells)
        return rows

    def latex(self, footer: str) -> str:
        """Return LaTeX for the booktabs package."""
        notes = " ".join(f"{mark}: {text}." for mark, text in self.messages)
        text: str = self.body.replace(_MINUS, "-", regex=True).to_latex(
            index=False,
            escape=True,
            multicolumn_format="c",
            caption=tex_escape(f"{self.title}. {self.note} {notes} {footer}".replace(_MINUS, "-")),
            label=f"tab:study_{self.name}",
            column_format="l" * _labels(self.body) + "r" * (self.body.shape[1] - _labels(self.body)),
        )
        return text


class _Marks:
    """Reasons for cells without a number, each once."""

    def __init__(self) -> None:
        self.found: dict[str, str] = {}

    def __call__(self, message: str) -> str:
        """Return the text of a cell that has no number for this reason."""
        mark = self.found.setdefault(message, chr(ord("a") + len(self.found) % 26))
        return f"{_NONE} ({mark})"

    def messages(self) -> tuple[tuple[str, str], ...]:
        return tuple((mark, text) for text, mark in self.found.items())


def _labels(body: pd.DataFrame) -> int:
    """Number of columns of texts at the left."""
    head = [str(c[-1] if isinstance(c, tuple) else c) for c in body.columns]
    return sum(
        c in ("", "Measure", "Group", "Visit", "Score", "Persons", "Of", "Kind", "By", "A", "B", "Test")
        for c in head[:5]
    )


def title_of(study: StudyData, name: str) -> str:
    """Title of a measure, score or angle, with its unit."""
    unit, short = unit_of(study, name), short_of(name)
    return f"{short} ({unit})" if unit and not short.endswith(f"({unit})") else short


def short_of(name: str) -> str:
    """Title without the unit, unless the unit distinguishes it from another, as in 10MWT_s and 10MWT_m_per_s."""
    names = MEASURES | TASKS | ANGLES | FOOT_ANGLES | PELVIS_ANGLES
    if name in names:
        return names[name][0]
    if name in _INDICES:
        return _INDICES[name]
    stem = words.without_unit(name)
    return stem.replace("_", " ") + (f" ({words.unit_of(name)})" if stem != name else "")


def unit_of(study: StudyData, name: str) -> str:
    """Unit as in the study."""
    for frame, column in ((study.measures, "measure"), (study.curves, "variable")):
        rows: Any = frame[frame[column] == name]
        if len(rows):
            return str(rows["unit"].iloc[0])
    return of_scores(study, "unit").get(name, "")


def number(value: float, digits: int) -> str:
    """Format a number with fixed decimals and a true minus; "" for NaN."""
    return "" if not math.isfinite(value) else f"{value:.{digits}f}".replace("-", _MINUS)


def digits_of(values: Any) -> int:
    """Number of decimals that show three digits of typical values."""
    known = np.abs(np.asarray(values, float))
    known = known[np.isfinite(known)]
    size = float(np.median(known)) if len(known) else 1.0
    return int(np.clip(2 - math.floor(math.log10(size)), 0, 4)) if size > 0 else 2


def p_text(p: float) -> str:
    """Format p with two digits, or as "< 0.001"."""
    if not math.isfinite(p):
        return ""
    return f"{p:.2g}" if p >= 0.001 else "< 0.001"


def p_said(row: Any) -> str:
    """Write p of a test and p corrected, as in "p < 0.001, Holm 0.012"."""
    text = p_text(row["p"])
    return f"p {'' if text.startswith('<') else '= '}{text}, Holm {p_text(row['p_holm'])}"


def estimate(row: Any, marks: _Marks, digits: int = 2, star: bool = False) -> str:
    """Format a row with `value, low, high, code, message` as `0.84 (0.81 to 0.86)`, with a star for `p_holm` < 0.05."""
    if row["code"]:
        return marks(row["message"])
    limits = f"({number(row['low'], digits)} to {number(row['high'], digits)})"
    shown = limits if math.isfinite(row["low"]) else "(no interval)"
    return f"{number(row['value'], digits)} {shown}{'*' if star and row['p_holm'] < ALPHA else ''}"


def all_tables(study: StudyData, results: StudyResults) -> dict[str, PageTable]:
    """Make the tables of the report, by name."""
    made = (
        flow(results),
        table2(results),
        srm_table(study, results),
        by_visit(study, results),
        repeatability(study, results),
        validity(results),
        groups(results),
        phases(results),
    )
    return {t.name: t for t in made}


#: Head of a column -> the text of its cell in a row of results.
_Columns = dict[str, Callable[[dict[Any, Any]], str]]


def _table(name: str, title: str, note: str, frame: pd.DataFrame, columns: _Columns, marks: _Marks) -> PageTable:
    rows = [{head: text(r) for head, text in columns.items()} for r in frame.to_dict("records")]
    return PageTable(name, title, note, pd.DataFrame(rows, columns=list(columns)), marks.messages())


def flow(results: StudyResults) -> PageTable:
    columns: _Columns = {
        "Group": lambda r: str(r["group"]),
        "Visit": lambda r: role_words(r["role"]),
        "Persons of the group": lambda r: str(r["persons"]),
        "No visit": lambda r: str(r["persons"] - r["took_place"]),
        "Took place": lambda r: str(r["took_place"]),
        "Left out": lambda r: str(r["excluded"]),
        "Count": lambda r: str(r["counted"]),
        "Of them without index": lambda r: str(r["without_index"]),
        "Why left out": lambda r: str(r["reasons"]),
    }
    note = "Visits by group. Excluded visits are not counted below."
    return _table("flow", "Participant flow", note, results.flow, columns, _Marks())


def table2(results: StudyResults) -> PageTable:
    """The paper's Table 2: repeatability over cycles, correlation with the scores, effect size of change."""
    plan, marks = results.plan, _Marks()
    rows: list[dict[Any, str]] = []
    # All, and the changing group if that is not the same.
    persons_of = {s: list(dict.fromkeys(rows["persons"])) for s, rows in results.validity.groupby("score")}
    for kind, names in ((SCORES, plan.scores), (GAIT, plan.measures)):
        for i, name in enumerate(names):
            row: dict[Any, str] = {("", ""): "" if i else kind, (" ", "Measure"): short_of(name)}
            for icc_kind, head in (("2,1", "ICC2"), ("2,k", "ICC2k")):
                found = _one(results.repeatability, name=name, of="cycles", kind=icc_kind)
                row["Repeatability", head] = _NONE if found is None else estimate(found, marks)
            for score, persons in ((s, p) for s in plan.scores for p in persons_of.get(s, ("all",))):
                found = _one(results.validity, name=name, score=score, persons=persons)
                text = _NONE
                if found is not None:
                    star = "*" if found["p_holm"] < ALPHA else ""
                    text = marks(found["message"]) if found["code"] else number(found["value"], 2) + star
                several = len(persons_of.get(score, ())) > 1
                row["Validity", f"r {short_of(score)}" + f", {persons}" * several] = text
            found = _one(results.change, name=name, statistic="effect_size")
            row["Responsiveness", "Effect size"] = _NONE if found is None else estimate(found, marks, star=True)
            rows.append(row)
    body = pd.DataFrame(rows)
    body.columns = pd.MultiIndex.from_tuples(list(body.columns))
    note = (
        "ICC of cycles (Shrout & Fleiss 2,1 and 2,k), one visit per person, with 95 % interval. r: Spearman for "
        f"ordinal scores, else Pearson, persons with both values at the visit {role_words(plan.change_from)}; over all "
        "it also holds the difference between groups. Effect size: Wilcoxon's with bootstrap interval, "
        f"{plan.change_group}, {_when(plan)}. {_STARS} the same persons, or of the effect sizes."
    )
    return PageTable("table2", "Reliability, validity and responsiveness", note, body, marks.messages())


def srm_table(study: StudyData, results: StudyResults) -> PageTable:
    """The paper's SRM table, with the mean change."""
    plan, marks = results.plan, _Marks()
    rows = []
    for kind, names in ((SCORES, plan.scores), (GAIT, plan.measures)):
        for i, name in enumerate(names):
            srm, mean, ranks = (_one(results.change, name=name, statistic=s) for s in ("srm", "mean", "effect_size"))
            if srm is None or mean is None or ranks is None:
                continue
            digits = digits_of([mean["value"], mean["low"], mean["high"]])
            rows.append(
                {
                    "": "" if i else kind,
                    "Measure": title_of(study, name),
                    "SRM": estimate(srm, marks, star=True),
                    "p, jackknife": p_text(srm["p"]),
                    "Holm": p_text(srm["p_holm"]),
                    "p, Wilcoxon": p_text(ranks["p"]),
                    "Holm, Wilcoxon": p_text(ranks["p_holm"]),
                    "Mean change": estimate(mean, marks, digits),
                    "Persons": str(srm["n"]),
                }
            )
    note = (
        f"Standardised response mean (mean change / its standard deviation) with the jackknife's 95 % interval; "
        f"{plan.change_group}, {_when(plan)}, persons with both visits. {_STARS} a column. p: the jackknife's t test "
        "asks if the mean change, in units of its spread, differs from 0, and a few large changes decide it; "
        "Wilcoxon's signed-rank test weighs changes by their rank. They can differ much for skewed changes and few "
        "persons: report the one that the protocol names."
    )
    heads = ["", "Measure", "SRM", "p, jackknife", "Holm", "p, Wilcoxon", "Holm, Wilcoxon", "Mean change", "Persons"]
    body = pd.DataFrame(rows, columns=heads)
    return PageTable("srm", "Standardised response mean", note, body, marks.messages())


def by_visit(study: StudyData, results: StudyResults) -> PageTable:
    """Mean, interval and spread by visit."""
    frame: Any = results.by_visit
    digits = {name: digits_of(own["mean"]) for name, own in frame.groupby("name")}

    def interval(r: dict[Any, Any]) -> str:
        limits = (number(r[k], digits[r["name"]]) for k in ("low", "high"))
        return " to ".join(limits) if math.isfinite(r["low"]) else "one person: none"

    columns: _Columns = {
        "Measure": lambda r: title_of(study, r["name"]) if r["first"] else "",
        "Group": lambda r: r["group"],
        "Visit": lambda r: role_words(r["role"]),
        "n": lambda r: str(r["n"]),
        "Mean": lambda r: number(r["mean"], digits[r["name"]]),
        "95 % interval": interval,
        "SD": lambda r: number(r["sd"], digits[r["name"]]),
        "Median": lambda r: number(r["median"], digits[r["name"]]),
        "nIQR": lambda r: number(r["niqr"], digits[r["name"]]),
    }
    note = "Student's interval of the mean; nIQR = IQR x 0.7413."
    rows = frame.assign(first=~frame["name"].duplicated())
    return _table("by_visit", "Measures by visit", note, rows, columns, _Marks())


def repeatability(study: StudyData, results: StudyResults) -> PageTable:
    marks = _Marks()
    note = (
        "SEM and minimal detectable change in the unit of the measure; n persons with k cycles or visits (harmonic "
        "mean). Visits: 2,1 counts a shift of all persons as error (generalized interval), 3,1 does not. Where persons "
        "change differently between visits, that counts as error."
    )
    columns: _Columns = {
        "Measure": lambda r: title_of(study, r["name"]),
        "Of": lambda r: r["of"],
        "Group": lambda r: r["group"],
        "Kind": lambda r: r["kind"],
        "ICC": lambda r: estimate(r, marks),
        "SEM": lambda r: number(r["sem"], digits_of([r["sem"]])),
        "MDC90": lambda r: number(r["mdc90"], digits_of([r["sem"]])),
        "MDC95": lambda r: number(r["mdc95"], digits_of([r["sem"]])),
        "n": lambda r: "" if r["code"] else f"{r['n']:.0f}",
        "k": lambda r: "" if r["code"] else f"{r['k']:.1f}",
    }
    return _table("repeatability", "Repeatability", note, results.repeatability, columns, marks)


def validity(results: StudyResults) -> PageTable:
    marks = _Marks()
    note = (
        f"At the visit {role_words(results.plan.change_from)}, with 95 % interval; p by Student's t. "
        f"{_STARS} the same persons."
    )
    columns: _Columns = {
        "Measure": lambda r: short_of(r["name"]),
        "Score": lambda r: short_of(r["score"]),
        "Persons": lambda r: r["persons"],
        "Kind": lambda r: r["kind"].capitalize(),
        "r": lambda r: estimate(r, marks, star=True),
        "p": lambda r: p_text(r["p"]),
        "p, Holm": lambda r: p_text(r["p_holm"]),
        "n": lambda r: str(r["n"]),
    }
    return _table("validity", "Correlation with clinical scores", note, results.validity, columns, marks)


def groups(results: StudyResults) -> PageTable:
    marks = _Marks()
    note = (
        f"At the visit {role_words(results.plan.change_from)}. Student's t where Shapiro-Wilk rejects neither group, "
        f"else Mann-Whitney U. {_STARS} the same By."
    )
    columns: _Columns = {
        "Measure": lambda r: short_of(r["name"]),
        "By": lambda r: r["by"],
        "A": lambda r: r["a"],
        "B": lambda r: r["b"],
        "Test": lambda r: r["test"],
        "Hedges' g (a - b)": lambda r: estimate(
            {**r, "value": r["g"], "low": r["g_low"], "high": r["g_high"]}, marks, star=True
        ),
        "p": lambda r: p_text(r["p"]),
        "p, Holm": lambda r: p_text(r["p_holm"]),
        "n": lambda r: f"{r['n_a']}, {r['n_b']}",
    }
    return _table("groups", "Differences between groups", note, results.groups, columns, marks)


def phases(results: StudyResults) -> PageTable:
    marks, rows = _Marks(), []
    for c in results.curves:
        row = {"Measure": short_of(c.angle), "Of": comparison_of(c)}
        test = c.test
        if not isinstance(test, CurveTest):
            rows.append({**row, "Phase (% of cycle)": marks(reason(test))})
            continue
        found = test.phases or (None,)
        for phase in found:
            inside = slice(None) if phase is None else (test.percent >= phase.first) & (test.percent <= phase.last)
            part = test.difference[inside]
            rows.append(
                {
                    **row,
                    "Phase (% of cycle)": "none" if phase is None else f"{phase.first:.0f} to {phase.last:.0f}",
                    "Largest difference (deg)": number(float(part[np.abs(part).argmax()]), 1),
                    "p": p_text(test.p_value if phase is None else phase.p),
                }
            )
        for r in rows[-len(found) :]:
            r["n"] = f"{test.n_a}" if test.paired else f"{test.n_a}, {test.n_b}"
            r["Left out"] = str(c.left_out)
    columns = ["Measure", "Of", "Phase (% of cycle)", "Largest difference (deg)", "p", "n", "Left out"]
    note = (
        "Permutation test over the gait cycle (max-t), p corrected for the cycle but not for the number of angles; "
        "left out: persons whose curves have unknown points."
    )
    body = pd.DataFrame([{c: r.get(c, "") for c in columns} for r in rows], columns=columns)
    return PageTable("phases", "Where curves differ", note, body, marks.messages())


def comparison_of(result: Any) -> str:
    """Names of the compared groups or roles, as a - b."""
    a, b = result.names
    if result.comparison == "change":
        a, b = role_words(a) or "none", role_words(b)
    return f"{a} {_MINUS} {b}"


def _when(plan: Plan) -> str:
    return f"{role_words(plan.change_from)} to {role_words(plan.change_to) or 'none'}"


def _one(frame: pd.DataFrame, **values: str) -> dict[str, Any] | None:
    found: Any = frame
    for column, value in values.items():
        found = found[found[column] == value]
    return found.iloc[0].to_dict() if len(found) else None
