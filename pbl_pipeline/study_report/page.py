"""The report of a study: one page, and its figures and tables as files."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from pbl_pipeline.code_version import code_version
from pbl_pipeline.csv_cells import frame_to_csv
from pbl_pipeline.files import check_out_folder
from pbl_pipeline.shipped import shipped_page
from pbl_pipeline.stats import CurveTest, Estimate
from pbl_pipeline.study import StudyData, content_hash
from pbl_pipeline.words import role_words

from .figures import (
    AFTER,
    BEFORE,
    GROUP_COLOURS,
    Figure,
    colours_of,
    draw_curves,
    draw_forest,
    draw_groups,
    draw_means,
    draw_pairs,
    draw_scatter,
)
from .page_tables import all_tables, number, p_said, p_text, short_of, title_of
from .results import COLUMNS, StudyResults, reason, score_classes, study_results
from .statement import statement
from .visit_values import INDEX, of_scores, pairs, plan

PAGE = "report.html"


def write_study_report(
    study: StudyData,
    folder: str | Path,
    change_from: str = "",
    change_to: str = "",
    change_group: str = "",
    pdf: bool = True,
) -> list[Path]:
    """Write `report.html`, `figures/*.svg` and `*.pdf`, `tables/*.csv` and `*.tex`; return the paths, the page first.

    The page loads nothing from elsewhere. A statistic that the values do not support is replaced by the reason, in the
    CSV tables also by its code. `change_from`, `change_to` (roles) and `change_group` take precedence over those of the
    study's description. Without `pdf` the figures are SVG alone, in a third of the time.

    Raises `PblError` FILE_UNWRITABLE; USAGE, STUDY_INVALID as `plan`.
    """
    folder = Path(folder)
    check_out_folder(folder)
    results = study_results(study, plan(study, change_from, change_to, change_group))
    tables, sections = all_tables(study, results), _sections(study, results)
    stated = statement(study, results)
    tables[stated.name] = stated
    head = _head(study, results)
    source = f"Slice {head['slice']}; {head['n']}; values by {head['made_by']}; methods: {head['methods']}"
    footer = [source, f"Report by PBL pipeline {code_version()}; content {head['content']}"]
    for sub in ("figures", "tables"):
        (folder / sub).mkdir(parents=True, exist_ok=True)
    paths = [folder / PAGE]
    page = shipped_page("study_report/templates/report.html").render(
        head=head,
        tables=tables,
        sections=sections,
        plan=results.plan,
        role_words=role_words,
        formats="SVG and PDF" if pdf else "SVG",
    )
    paths[0].write_text(page, encoding="utf-8")
    for figure in (f for figures in sections.values() for f in figures):
        paths.append(folder / "figures" / f"{figure.name}.svg")
        paths[-1].write_text(figure.svg(footer), encoding="utf-8")
        if pdf:
            paths.append(paths[-1].with_suffix(".pdf"))
            paths[-1].write_bytes(figure.pdf(footer))
    for name, frame in _frames(results).items():
        paths.append(folder / "tables" / f"{name}.csv")
        paths[-1].write_bytes(frame_to_csv(frame, "%.8g").encode())
    paths.append(folder / "tables" / f"{stated.name}.csv")
    paths[-1].write_bytes(frame_to_csv(stated.body).encode())
    for table in tables.values():
        paths.append(folder / "tables" / f"{table.name}.tex")
        paths[-1].write_text(table.latex(". ".join(footer)), encoding="utf-8")
    return paths


def _head(study: StudyData, results: StudyResults) -> dict[str, str]:
    given, counted = study.description, results.table
    return {
        "name": given.name or "Study",
        "slice": f"{given.name or 'none'} {given.hash}".strip(),
        "content": content_hash(study),
        "n": _counts(len(set(counted["subject"])), len(counted)),
        "all": _counts(study.n_subjects, study.n_visits),
        "methods": "; ".join(f"{stage} {method}" for stage, method in given.methods.items()) or "not stated",
        "made_by": given.code_version or "unknown code",
        "code": code_version(),
        "event": given.event,
        "note": given.note,
    }


def _counts(persons: int, visits: int) -> str:
    return f"{persons} person{'s' * (persons != 1)}, {visits} visit{'s' * (visits != 1)}"


def _frames(results: StudyResults) -> dict[str, pd.DataFrame]:
    rows = []
    for c in results.curves:
        if isinstance(c.test, CurveTest):
            t = c.test
            who = {"variable": c.angle, "a": c.names[0], "b": c.names[1], "n_a": t.n_a, "n_b": t.n_b}
            points = {"percent": t.percent, "difference": t.difference, "t": t.t, "p": t.p}
            rows.append(pd.DataFrame(who | points))
    curve_columns = ["variable", "a", "b", "n_a", "n_b", "percent", "difference", "t", "p"]
    return {
        "visits": results.table,
        "flow": results.flow,
        **{name: getattr(results, name) for name in COLUMNS},
        "curve_tests": pd.concat(rows) if rows else pd.DataFrame(columns=curve_columns),
    }


def study_figures(study: StudyData, results: StudyResults) -> dict[str, Figure]:
    """Draw all figures of a report, by name; a notebook displays them."""
    return {f.name: f for figures in _sections(study, results).values() for f in figures}


def _sections(study: StudyData, results: StudyResults) -> dict[str, list[Figure]]:
    return {
        "paper": sorted(_paper_figures(study, results), key=lambda f: f.title[0]),
        "srm": list(_srm_figure(results)),
        "by_visit": list(_mean_figures(study, results)),
        "paired": list(_paired_figures(study, results)),
        "curves": list(_curve_figures(study, results, of_change=True)),
    }


def _paper_figures(study: StudyData, results: StudyResults) -> Iterator[Figure]:
    """Figures as the paper's figure 5: A curves of groups, B the index by class of a score, C over a continuous score,
    D by group, E over an ordinal score."""
    yield from _curve_figures(study, results, of_change=False)
    measure = INDEX if INDEX in results.plan.measures else next(iter(results.plan.measures), "")
    if not measure:
        return
    at: Any = results.table[results.table["role"] == results.plan.change_from]
    title = title_of(study, measure)
    where = f"visit {role_words(results.plan.change_from)}"
    for score, labels in score_classes(study, results.plan, at).items():
        by_class = {str(c): at.loc[labels == c, measure].dropna().to_numpy(float) for c in labels.cat.categories}
        if by_class := {c: v for c, v in by_class.items() if len(v)}:
            note = f"{where}; {_tests(results, measure, score)}"
            drawing = draw_groups(by_class, title)
            yield Figure(_file("5B", score), f"B  {title} by class of {short_of(score)}", note, drawing)
    ordinal = of_scores(study, "ordinal")
    colours = colours_of(results.plan.groups)
    for score in results.plan.scores:
        both = at.dropna(subset=[measure, score])
        own = {g: both[both["group"] == g] for g in results.plan.groups}
        parts = {g: (v[score].to_numpy(float), v[measure].to_numpy(float)) for g, v in own.items() if len(v)}
        if parts:
            letter = "E" if ordinal[score] else "C"
            key = {g: colours[g] for g in parts}
            drawing = draw_scatter(parts, (title_of(study, score), title), list(key.values()), not ordinal[score])
            note = f"{where}; {_correlations(results, measure, score)}"
            yield Figure(_file(f"5{letter}", score), f"{letter}  {title} and {short_of(score)}", note, drawing, key)
    values = {g: at.loc[at["group"] == g, measure].dropna().to_numpy(float) for g in results.plan.groups}
    values = {g: v for g, v in values.items() if len(v)}
    if len(values) > 1:
        note = f"{where}; {_tests(results, measure, 'group')}"
        yield Figure("5D_groups", f"D  {title} by group", note, draw_groups(values, title, colours))


def _correlations(results: StudyResults, measure: str, score: str) -> str:
    frame: Any = results.validity
    words = []
    for r in frame[(frame["name"] == measure) & (frame["score"] == score)].to_dict("records"):
        limits = f"{number(r['low'], 2)} to {number(r['high'], 2)}"
        found = r["message"] or f"{r['kind'].capitalize()} r = {number(r['value'], 2)} ({limits})"
        words.append(f"{r['persons']} (n {r['n']}): {found}")
    return "; ".join(words)


def _tests(results: StudyResults, measure: str, by: str) -> str:
    frame: Any = results.groups
    rows = frame[(frame["name"] == measure) & (frame["by"] == by)].to_dict("records")
    words = [f"{r['a']} and {r['b']}: " + (r["message"] or f"{r['test']}, {p_said(r)}") for r in rows]
    return "; ".join(words) or "one group only"


def _srm_figure(results: StudyResults) -> Iterator[Figure]:
    frame: Any = results.change
    found = frame[(frame["statistic"] == "srm") & (frame["code"] == "")]
    rows = [
        (
            f"{short_of(r['name'])} (n {r['n']})",
            GROUP_COLOURS[1 if r["name"] in results.plan.scores else 0],
            Estimate(r["value"], r["low"], r["high"], 0.95),
        )
        for r in found.to_dict("records")
    ]
    if rows:
        plan = results.plan
        when = f"{role_words(plan.change_from)} to {role_words(plan.change_to)}"
        note = f"{plan.change_group}, {when}; 95 % interval by the jackknife"
        colours = {"gait measures": GROUP_COLOURS[0], "clinical scores": GROUP_COLOURS[1]}
        title = "Standardised response mean of gait measures and clinical scores"
        yield Figure("srm", title, note, draw_forest(rows), colours)


def _mean_figures(study: StudyData, results: StudyResults) -> Iterator[Figure]:
    plan: Any = results.plan
    frame: Any = results.by_visit
    for name in (*plan.measures, *plan.scores):
        own = frame[frame["name"] == name]
        if len(own):
            groups = [g for g in plan.groups if g in set(own["group"])]
            counts = "; ".join(f"{g} n {', '.join(map(str, own.loc[own['group'] == g, 'n']))}" for g in groups)
            colours = {g: c for g, c in colours_of(plan.groups).items() if g in groups}
            drawing = draw_means(own, plan.roles, plan.groups, title_of(study, name))
            yield Figure(
                _file("visits", name), title_of(study, name), f"mean, 95 % interval; {counts}", drawing, colours
            )


def _paired_figures(study: StudyData, results: StudyResults) -> Iterator[Figure]:
    plan: Any = results.plan
    frame: Any = results.change
    for name in (*plan.measures, *plan.scores):
        both = pairs(results.table, plan, name)
        if not len(both):
            continue
        row = frame[(frame["name"] == name) & (frame["statistic"] == "effect_size")].iloc[0]
        test = row["message"] or f"Wilcoxon {p_said(row)}, r = {number(row['value'], 2)}"
        drawing = draw_pairs(both, (plan.change_from, plan.change_to), title_of(study, name))
        yield Figure(
            _file("paired", name), title_of(study, name), f"{plan.change_group}, n {len(both)}; {test}", drawing
        )


def _curve_figures(study: StudyData, results: StudyResults, of_change: bool) -> Iterator[Figure]:
    """Figures of curves, of the change or between groups, as the paper's figure 5 A."""
    groups = colours_of(results.plan.groups)
    for c in results.curves:
        if (c.comparison == "change") != of_change or not len(c.a) or not len(c.b):
            continue
        a, b = c.names
        title = title_of(study, c.angle)
        if of_change:
            a, b = role_words(a), role_words(b)
            colours, n = (BEFORE, AFTER), f"n {len(c.a)}"
            name, title = _file("curves", c.angle), f"{title}, {b} to {a}"
        else:
            colours, n = (groups[b], groups[a]), f"n {len(c.a)}, {len(c.b)}"
            name, title = _file("5A", f"{c.angle}_{b}"), f"A  {title}, {a} and {b}"
        if isinstance(c.test, CurveTest):
            spans = ", ".join(f"{x.first:.0f} to {x.last:.0f} %" for x in c.test.phases)
            test = f"differ at {spans}" if spans else f"differ nowhere (p {p_text(c.test.p_value)})"
        else:
            test = reason(c.test)
        left = f"; {c.left_out} left out for unknown points" if c.left_out else ""
        drawing = draw_curves(c, colours, title_of(study, c.angle))
        yield Figure(name, title, f"mean, one sd; {n}{left}; {test}", drawing, {b: colours[0], a: colours[1]})


def _file(prefix: str, name: str) -> str:
    return f"{prefix}_" + "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "-" for c in name)
