"""A drawn cohort of 80 people through the tables: its report is the same from the cohort, a slice and a folder.

Its visits have no recordings. Each is registered as a recording of markers, and the tables' own makes write what the
library returns for it, where its events, cycles, measures and index are replaced by those that were drawn.
"""

from __future__ import annotations

import dataclasses
import datetime
import re
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

import pbl_pipeline.fit
import pbl_pipeline.gait
from pbl_pipeline.gait import GaitCycle, GaitEvents, Gdi, GdiCycle, Lengths, Measure, SessionMetrics, Spatiotemporal
from pbl_pipeline.gait.cycle_measures import MEASURES
from pbl_pipeline.keypoints import WorldMarkers
from pbl_pipeline.qc import EMPTY, PASS
from pbl_pipeline.study import CURVE_PERCENT, CURVE_POINTS, StudyData, read_study, write_study
from pbl_pipeline.study_report import all_tables, plan, study_figures, study_results
from pbl_schemas.intake import LaboratoryMarkers, VisitRecord, register
from pbl_schemas.studies import slices
from pbl_schemas.studies.study_sheets import import_sheets
from pbl_workers.populate import populate
from research import cohort as made

from . import chain
from .test_markers import recording

pytestmark = pytest.mark.long

KEY = ["subject", "visit"]
SURGERY = datetime.date(2025, 6, 1)
#: Scores of the cohort by their names in the tables.
INSTRUMENTS = {"10MWT": "10MWT_m_per_s"}
STRIDE_S = 1.1
_NUMBER = r"-?\d+(?:\.\d+)?"
INDEX_OF = {"visits": [], "measures": ["measure"], "cycles": ["side", "cycle"], "scores": ["instrument"]}


class Drawn:
    """The drawn results of each visit, by the name of its recording, as the functions of the library return them."""

    def __init__(self, study: StudyData) -> None:
        self.visits = {"_".join((v["subject"], v["visit"])): v for v in study.visits.to_dict("records")}
        self._of: dict[str, dict[str, Any]] = {
            frame: {"_".join(key): rows for key, rows in getattr(study, frame).groupby(KEY)}
            for frame in ("measures", "cycles", "curves")
        }

    def events(self, *_: Any, **__: Any) -> GaitEvents:
        return GaitEvents(PASS, (), "", "drawn", "", "drawn")

    def cycles(self, _: Any, trial: Any, **__: Any) -> tuple[GaitCycle, ...]:
        if not self.visits[trial.name]["included"]:
            return ()
        curves: dict[str, dict[str, np.ndarray]] = {"left": {}, "right": {}}
        for row in self._of["curves"][trial.name].to_dict("records"):
            curves[row["side"]][row["variable"]] = np.array([row[p] for p in CURVE_POINTS[::2]])
        return tuple(
            GaitCycle(
                trial.name, i, 0, row["side"], *(i + STRIDE_S * np.array([0, 0.1, 0.5, 0.6, 1.0])).tolist(),
                curves=curves[row["side"]], lengths=Lengths(missing="drawn"),
            )
            for i, row in enumerate(self._index_of_cycles(trial.name))
        )  # fmt: skip

    def measures(self, cycles: Any) -> Spatiotemporal:
        name = cycles[0].trial if cycles else ""
        found: dict[str, Measure | None] = dict.fromkeys(MEASURES)
        for r in self._of["measures"][name].to_dict("records") if cycles else ():
            found[r["measure"]] = Measure(None, None, r["value"], r["sd"], int(r["n_cycles"]))
        status, reason = (PASS, "") if cycles else (EMPTY, "no cycles")
        return Spatiotemporal(status, reason, found, {}, len(cycles), len(cycles), len(cycles))

    def index(self, cycles: Any, norm: Any, *_: Any, **__: Any) -> Gdi:
        if not cycles:
            return Gdi(EMPTY, "no cycles", None, None, None, 0, 0, 0, norm.name, "gdi", "", (), ())
        name = cycles[0].trial
        visit, half = self.visits[name], len(cycles) // 2
        own = tuple(
            GdiCycle(name, i, row["side"], row["value"], 0.0, 1.0) for i, row in enumerate(self._index_of_cycles(name))
        )
        return Gdi(
            PASS, "", None, None, visit["gdi"], len(own), half, half, norm.name, "gdi", "", own, (), sd=visit["gdi_sd"]
        )

    def pooled(self, trials: Any, norm: Any, *_: Any, **__: Any) -> SessionMetrics:
        (trial,) = trials
        measures = self.measures(trial.cycles)
        reason = self.visits[trial.name]["reason"]
        return SessionMetrics(measures.status, reason, measures, self.index(trial.cycles, norm), (), "drawn")

    def _index_of_cycles(self, name: str) -> list[dict[str, Any]]:
        cycles = self._of["cycles"][name]
        return cycles[cycles["measure"] == "gdi"].to_dict("records")


@pytest.fixture(scope="module")
def drawn() -> StudyData:
    """The cohort with what tables hold: curves of 51 points in float32, of the single cycles the index alone."""
    study = made.cohort(seed=0)
    cycles: Any = study.cycles
    points = study.curves[list(CURVE_POINTS[::2])].to_numpy(np.float32).astype(float)
    curves = study.curves.copy()
    curves[list(CURVE_POINTS)] = [np.interp(CURVE_PERCENT, CURVE_PERCENT[::2], row) for row in points]
    # The tables refuse a part of the mJOA that its sum excludes: the other parts have 0 to 11 points.
    wide = study.scores.pivot(index=KEY, columns="instrument", values="value").rename(columns=INSTRUMENTS)
    wide["mJOA-LE"] = wide["mJOA-LE"].clip(wide["mJOA"] - 11, wide["mJOA"])
    scores = wide.melt(ignore_index=False).dropna().reset_index()
    instruments = study.instruments.assign(instrument=study.instruments["instrument"].replace(INSTRUMENTS))
    return dataclasses.replace(
        study, cycles=cycles[cycles["measure"] == "gdi"], curves=curves, scores=scores, instruments=instruments
    )


def sheet(study: StudyData) -> pd.DataFrame:
    """The visits and scores as a sheet of `pbl study import`."""
    visits = study.visits
    scores = study.scores.pivot(index=KEY, columns="instrument", values="value").reset_index()
    rows = visits[[*KEY, "role", "group"]].assign(
        date=[SURGERY + datetime.timedelta(days=int(d)) for d in visits["days"]],
        intervention_date=SURGERY,
        population=np.where(visits["group"] == made.CONTROLS, "healthy", "patient"),
        cohort="spine",
    )
    return rows.merge(scores, on=KEY, how="left")


@pytest.fixture(scope="module")
def from_tables(module_tables: Path, module_patch: pytest.MonkeyPatch, drawn: StudyData) -> StudyData:
    results = Drawn(drawn)
    chain.replace(module_patch, fit_session=lambda *a, markers=None, **k: chain.fit_session(*a, **k))
    for name, function in {
        "detect_events": results.events,
        "find_cycles": results.cycles,
        "spatiotemporal": results.measures,
        "score_gdi": results.index,
        "pool_trials": results.pooled,
    }.items():
        module_patch.setattr(pbl_pipeline.gait, name, function)
    walk = WorldMarkers.load(recording(module_tables / "walk.npz", seconds=2.0))
    recordings = []
    for i, (name, visit) in enumerate(results.visits.items()):
        path = module_tables / f"{name}.npz"
        dataclasses.replace(walk, time_s=walk.time_s + 1e-6 * i).save(path)  # other bytes
        recordings.append(LaboratoryMarkers(path, VisitRecord(visit["subject"], visit["visit"])))
    assert {r.status for r in register(recordings)} == {"registered"}
    path = module_tables / "visits.csv"
    sheet(drawn).to_csv(path, index=False)
    imported = import_sheets([path])
    assert imported.done, [x for x in imported.lines if x.errors or x.doubts][:5]
    run = populate(["SessionFit", "GaitEvents", "GaitCycle", "Spatiotemporal", "GDI", "SessionGdi"])
    assert not any(t.errors for t in run.tables)
    slices.freeze("spine", "spine", event="surgery")
    return slices.study_data("spine")


def _split(svg: str) -> tuple[list[str], list[float]]:
    """An SVG without its places and what is named by them, and the places."""
    svg = re.sub(r"\b[mp][0-9a-f]{10}\b", "", svg)
    return re.split(_NUMBER, svg), [float(n) for n in re.findall(_NUMBER, svg)]


def test_the_frames_are_those_that_were_drawn(from_tables: StudyData, drawn: StudyData):
    counts = drawn.visits.loc[drawn.visits["included"], KEY]
    assert len(counts) > 200
    for name in ("visits", "measures", "cycles", "scores"):
        ours, theirs = (
            getattr(s, name).merge(counts, on=KEY).set_index([*KEY, *INDEX_OF[name]]).sort_index()
            for s in (from_tables, drawn)
        )
        columns = [c for c in theirs if c not in ("unit", "cycle")]
        ours = ours[ours["measure"] == "gdi"] if name == "cycles" else ours
        pd.testing.assert_frame_equal(ours[columns], theirs[columns], check_dtype=False, obj=name)


def test_the_report_is_the_same_from_cohort_tables_and_folder(from_tables: StudyData, drawn: StudyData, tmp_path: Path):
    # The instruments are the laboratory's, and what a slice says of recordings and methods no drawn visit has.
    about = from_tables.visits.drop(columns=[c for c in drawn.visits if c not in KEY])
    own = dataclasses.replace(
        drawn,
        visits=drawn.visits.merge(about, on=KEY),
        instruments=from_tables.instruments,
        description=from_tables.description,
    )
    write_study(from_tables, tmp_path)
    expected = study_results(own, plan(own), permutations=500)
    assert expected.plan.measures == ("gdi", *(m for m in made.MEASURES if m != "gdi"))
    for other in (from_tables, read_study(tmp_path)):
        found = study_results(other, plan(other), permutations=500)
        assert found.plan == expected.plan
        shown = all_tables(other, found)
        for name, table in all_tables(own, expected).items():
            pd.testing.assert_frame_equal(shown[name].body, table.body, obj=name)
            assert shown[name].messages == table.messages
        figures = study_figures(other, found)
        for name, figure in study_figures(own, expected).items():
            (words, at), (expected_words, expected_at) = (_split(f.svg()) for f in (figures.pop(name), figure))
            assert words == expected_words, name
            np.testing.assert_allclose(at, expected_at, atol=1e-4, err_msg=name)  # px; a folder's numbers are rounded
        assert not figures
