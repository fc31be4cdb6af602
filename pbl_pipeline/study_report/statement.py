"""Statement of measurement error of a study: design, measurement, participants and reliability, in the order of COSMIN
(Gagnier et al. 2021, Qual Life Res 30:2197-2218) and STARD (Bossuyt et al. 2015, BMJ 351:h5527)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.code_version import code_version
from pbl_pipeline.study import StudyData, content_hash
from pbl_pipeline.words import role_words

from .page_tables import PageTable, digits_of, number, short_of, title_of
from .results import StudyResults
from .visit_values import of_scores

#: Columns of visits about the recordings (docs/study.md), and their names in the statement.
FILMED = {
    "views": "Filmed from",
    "cameras": "Calibration of the camera",
    "pictures": "Size of the picture",
    "height": "Body height",
    "assistive_device": "Walking aid",
    "orthosis": "Orthosis",
}
#: Columns of the numbers of videos, and of the reasons why some were left out, as "reason (n); ...".
VIDEOS, LEFT_OUT, WHY_LEFT_OUT = "videos", "videos_left_out", "videos_left_out_why"
_NOT_STATED = "not stated"


def statement(study: StudyData, results: StudyResults) -> PageTable:
    """Make the statement, in rows of section, item and text."""
    rows = [
        *(("Design", item, text) for item, text in _design(study, results)),
        *(("Measurement", item, text) for item, text in _measurement(study)),
        *(("Recordings and visits", item, text) for item, text in _excluded(study, results)),
        *(("Statistics", item, text) for item, text in _statistics(results)),
        *(("Reliability and error", item, text) for item, text in _errors(study, results)),
    ]
    note = (
        "In the order of the COSMIN reporting guideline and STARD. The authors add what the study's data do not state: "
        "how people were asked, where and by whom they were filmed."
    )
    body = pd.DataFrame(rows, columns=["Section", "Item", "Statement"])
    return PageTable("statement", "Statement of measurement error", note, body)


def _design(study: StudyData, results: StudyResults) -> Iterator[tuple[str, str]]:
    visits: Any = study.visits
    counted = visits[visits["included"]]
    yield (
        "Visits",
        ", ".join(map(role_words, results.plan.roles)) + (f"; days from {e}" if (e := study.description.event) else ""),
    )
    groups = counted.groupby("group")
    yield "Persons who count", "; ".join(f"{g}: {own['subject'].nunique()}" for g, own in groups)
    yield "Visits that count", "; ".join(f"{g}: {len(own)}" for g, own in groups)
    ages: Any = pd.to_numeric(counted.drop_duplicates("subject")["age"], errors="coerce") if "age" in counted else None
    known = None if ages is None else ages.dropna()
    yield "Age at the first visit", _spread(known, "years")
    days = counted.groupby("subject")["days"].agg(["min", "max", "count"])
    days = days[days["count"] > 1]
    yield "Days between first and last visit", _spread(days["max"] - days["min"], "d")


def _measurement(study: StudyData) -> Iterator[tuple[str, str]]:
    given, visits = study.description, study.visits
    counted: Any = visits[visits["included"]]
    yield "Methods", "; ".join(f"{stage} {method}" for stage, method in given.methods.items()) or _NOT_STATED
    yield "Versions", f"values by {given.code_version or 'unknown code'}; report by PBL pipeline {code_version()}"
    yield "Data", f"slice {given.name or 'none'} {given.hash}".strip() + f", content {content_hash(study)}"
    for column, item in FILMED.items():
        if column in counted:
            values = counted[column].fillna("").astype(str).str.strip()
            counts = Counter(v or _NOT_STATED for v in values)
            yield item, "; ".join(f"{value}: {n}" for value, n in counts.most_common())
    cycles = counted["n_cycles"].dropna()
    yield "Gait cycles of a visit", _spread(cycles, "")


def _excluded(study: StudyData, results: StudyResults) -> Iterator[tuple[str, str]]:
    visits: Any = study.visits
    if VIDEOS in visits:
        counts: Any = visits[[VIDEOS, LEFT_OUT]].apply(pd.to_numeric, errors="coerce").sum()
        total, left_out = map(int, counts)
        reasons: Counter[str] = Counter()
        for text in visits[WHY_LEFT_OUT].fillna("").astype(str):
            for reason, n in re.findall(r"(?:^|; )(.+?) \((\d+)\)(?=;|$)", text):
                reasons[reason] += int(n)
        yield "Videos left out", _share(left_out, total) + _reasons(reasons)
    else:
        yield "Videos left out", _NOT_STATED
    out = visits[~visits["included"]]
    yield "Visits left out", _share(len(out), len(visits)) + _reasons(Counter(out["reason"]))
    flow: Any = results.flow
    without = int(flow["without_index"].sum())
    yield "Visits that count without an index", _share(without, int(visits["included"].sum()))


def _statistics(results: StudyResults) -> Iterator[tuple[str, str]]:
    yield (
        "Reliability",
        "ICC(2,1) of visits, two-way random effects, absolute agreement, single visit, with its 95 % generalized "
        "interval; of the cycles of one visit ICC(2,1)",
    )
    yield (
        "Error",
        "SEM, root of the error variance of the ICC's model; minimal detectable change 1.96 sqrt(2) SEM (95 %)",
    )
    change = results.plan
    yield (
        "Assumption",
        f"persons do not change between visits; where they do ({change.change_group}, "
        f"{role_words(change.change_from)} to {role_words(change.change_to) or 'no other'}), that counts as error",
    )


def _errors(study: StudyData, results: StudyResults) -> Iterator[tuple[str, str]]:
    frame: Any = results.repeatability
    important = {score: f"{mic:g}" for score, mic in of_scores(study, "mic").items() if mic == mic}
    important |= {score: f"{c} (by value before)" for score, c in of_scores(study, "mic_classes").items() if c}
    for r in frame[frame["kind"] == "2,1"].to_dict("records"):
        item = f"{title_of(study, r['name'])}, {r['of']}, {r['group']}"
        if r["code"]:
            yield item, r["message"]
            continue
        digits = digits_of([r["sem"]])
        text = f"ICC {number(r['value'], 2)} ({number(r['low'], 2)} to {number(r['high'], 2)}); "
        text += f"SEM {number(r['sem'], digits)}; minimal detectable change {number(r['mdc95'], digits)} (95 %)"
        text += f"; n {r['n']:.0f}, k {r['k']:.1f}"
        if r["of"] == "visits" and r["name"] in important:
            text += f"; minimal important change {important[r['name']]}"
        yield item, text
    sd: Any = study.visits.loc[study.visits["included"], "gdi_sd"].dropna()
    if len(sd):
        low, middle, high = sd.quantile([0.25, 0.5, 0.75])
        text = f"median {number(middle, 1)} (quartiles {number(low, 1)} to {number(high, 1)}), {len(sd)} visits"
        yield f"{short_of('gdi')}: stated standard deviation of its error", text


def _spread(values: Any, unit: str) -> str:
    if values is None or not len(values):
        return _NOT_STATED
    digits = 0 if (np.asarray(values) % 1 == 0).all() else 1
    low, middle, high = (number(float(v), digits) for v in (values.min(), values.median(), values.max()))
    return f"median {middle} (range {low} to {high}) {unit}".rstrip() + f", n {len(values)}"


def _reasons(counts: Counter[str]) -> str:
    return "".join(f"; {reason} ({n})" for reason, n in counts.most_common())


def _share(part: int, whole: int) -> str:
    return f"{part} of {whole}" + (f" ({100 * part / whole:.0f} %)" if whole else "")
