"""Every Python example of the pages runs, on what its page supposes.

Those of docs/extending.md run in tests/unit/test_extending.py, of docs/add_table.md in test_linking.py, the notebooks
in tests/end_to_end/test_notebooks.py.
"""

import ast
import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.fit import TrialFit
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.study import write_study
from pbl_schemas import gait, gdi, study
from pbl_schemas.reading import frames
from pbl_workers.populate import populate
from research.cohort import cohort
from tests import pages
from tests.command import pbl
from tests.exported import marked_fit
from tests.rows import register
from tests.unit.test_blazepose import asset

from .chain import small_video

ELSEWHERE = {"docs/extending.md", "docs/add_table.md"}
RUN: set[tuple[str, int]] = set()


def example(page: str, number: int) -> Any:
    """Mark a test that runs this block."""
    RUN.add((page, number))
    return lambda test: test


def run(
    page: str, number: int, names: dict[str, Any] | None = None, **instead: int
) -> tuple[dict[str, Any], list[Any]]:
    """The names that a block leaves and the values of its expressions; `instead`: numbers that rows have here."""
    (code,) = (b.code for b in pages.python_blocks() if (b.page, b.number) == (page, number))
    found: dict[str, Any] = dict(names or {})
    tree, values = ast.parse(code), []
    for node in ast.walk(tree):
        if isinstance(node, ast.Dict):
            for i, key in enumerate(node.keys):
                if isinstance(key, ast.Constant) and key.value in instead:
                    node.values[i] = ast.copy_location(ast.Constant(instead[key.value]), node.values[i])
    for line in tree.body:
        if isinstance(line, ast.Expr):
            values.append(eval(compile(ast.Expression(line.value), page, "eval"), found))
        else:
            exec(compile(ast.Module([line], []), page, "exec"), found)
    return found, values


@pytest.fixture
def here(in_empty_folder: Path) -> Path:
    """An empty folder, and the working directory."""
    return in_empty_folder


@pytest.fixture
def visit(tables: None, tmp_path: Path) -> dict[str, Any]:
    """A visit of one video, computed: its keys."""
    (number,) = register(small_video(tmp_path, "walk"), session_label="2026-03-01")
    populate()
    return {"video_id": number, "session_id": int(frames.session_summary()["session_id"].item())}


@pytest.fixture
def without_its_method(tables: None) -> Iterator[None]:
    """Method rows outlive a test, and that of the example must not."""
    yield
    (gdi.GdiModel & {"gdi_method_name": "fast-walk"}).delete_quick()


@example("README.md", 0)
def test_a_row_per_visit(visit: dict[str, Any]):
    _, (_, summary) = run("README.md", 0)
    assert summary["subject"].tolist() == ["P001"]


@example("docs/tables.md", 0)
def test_results_of_chosen_visits_are_deleted_by_their_keys(visit: dict[str, Any]):
    """With the visit's own index, which was computed from them; every other result stays."""
    cycles = len(gait.GaitCycle())
    run("docs/tables.md", 0)
    assert (len(gdi.GDI()), len(gdi.SessionGdi())) == (0, 0)
    assert len(gait.GaitCycle()) == cycles > 0


@example("docs/settings.md", 0)
def test_rows_back_to_objects(visit: dict[str, Any]):
    _, (points, fit) = run("docs/settings.md", 0, video_id=visit["video_id"])
    assert (type(points), type(fit)) == (Keypoints, TrialFit)


@example("docs/study.md", 0)
def test_the_folder_of_a_study(here: Path):
    write_study(cohort(seed=0), "spine2026")
    names, (merged,) = run("docs/study.md", 0)
    assert set(merged["subject"]) <= set(names["study"].visits["subject"])
    assert {"gdi", "instrument", "value"} <= set(merged.columns)


@example("docs/study.md", 1)
def test_a_score_and_its_query(visit: dict[str, Any]):
    _, values = run("docs/study.md", 1, session_id=visit["session_id"])
    assert values[-1].empty  # 14 is not below 12
    assert study.ClinicalScore().to_arrays("score_value").tolist() == [14]


@example("docs/study.md", 2)
def test_results_by_kind_of_recording(visit: dict[str, Any]):
    names, _ = run("docs/study.md", 2)
    assert (len(names["laboratory"]), len(names["phone"])) == (0, 1)


@example("docs/study.md", 3)
def test_an_index_for_a_pace(without_its_method: None):
    run("docs/study.md", 3)
    assert (gdi.GdiModel & {"gdi_method": "fast-walk-v1"}).fetch1()["gdi_params"]["pace"] == "fast"


@example("docs/statistics.md", 0)
def test_statistics():
    rng = np.random.default_rng(0)
    person = rng.normal(90, 8, 12)
    visits = person[:, None] + rng.normal(0, 2, (12, 3))
    percent = np.linspace(0, 100, 51)
    knee = 30 + 25 * np.sin(percent / 100 * 2 * np.pi) + rng.normal(0, 1, (12, 51))
    bump = 10 * np.exp(-(((percent - 70) / 8) ** 2))
    people = [f"P{i}" for i in range(12)]
    names = {
        "visits": visits,
        "pre": person,
        "post": person + 5 + rng.normal(0, 2, 12),
        "index": person,
        "mjoa": np.round(person / 6),
        "knee_pre": knee,
        "knee_post": knee + bump + rng.normal(0, 1, (12, 51)),
        "of_pre": people,
        "of_post": people,
    }
    _, (icc, srm, correlation, phases) = run("docs/statistics.md", 0, names)
    assert 0.8 < icc < 1.0
    assert srm.low < srm.value < srm.high
    assert srm.p < 0.01
    assert correlation.value > 0.9
    assert any(p.first <= 70 <= p.last for p in phases)


@example("docs/validation.md", 0)
def test_a_fit_against_an_inverse_kinematics(here: Path):
    dataclasses.replace(marked_fit(), name="walk1").save(here / "walk1.fit.npz")
    assert pbl("export", "walk1.fit.npz", "--to", "mot", "--out", "opensim").code == 0
    (mot,) = here.glob("opensim/**/*.mot")
    mot.rename("walk1.mot")
    names, _ = run("docs/validation.md", 0)
    assert names["errors"].median_abs_deg < 0.01
    assert list(here.glob("accuracy/*.csv"))


@pytest.mark.slow
@example("docs/models.md", 0)
def test_anatomical_markers_of_a_fit(here: Path):
    for name in ("augmenter_network", "augmenter_mean", "augmenter_std"):
        asset(name)
    marked_fit().save(here / "walk.fit.npz")
    names, _ = run("docs/models.md", 0)
    assert names["markers"].xyz_world_m.shape == (len(names["fit"].time_s), 35, 3)


def test_every_example_is_run():
    assert {(b.page, b.number) for b in pages.python_blocks() if b.page not in ELSEWHERE} == RUN
