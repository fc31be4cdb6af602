"""The paper's tables from error rows: what stands in them, what stays empty, and the files."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitCycle, find_cycles
from pbl_pipeline.gait.events import GaitEvent
from pbl_pipeline.validation import (
    COLUMNS,
    CURVE_COLUMNS,
    INDEX_COLUMNS,
    JointError,
    KinematicErrors,
    TrialErrors,
    cycle_curves,
    error_frame,
    html,
    index_agreement,
    index_pairs,
    latex,
    median_niqr,
    paper_figures,
    paper_tables,
    print_tables,
    reference_of_fit,
    save_curves,
    write_tables,
)
from tests import SHARED
from tests.html_page import Page
from tests.walking_fit import foot_events, walking_fit

PAPER = SHARED.parent / "paper" / "pbl_paper.tex.txt"
MEDIAN, MEAN, RTE = "Median Absolute Error (deg)", "Mean Absolute Error (deg)", "RTE (cm)"


def _joint(name: str, error: float, n: int = 50) -> JointError:
    return JointError(name, n, error, error + 1, 0.5, 1.0, 1.2, 0.9, 0.8)


def _trial(
    trial: str,
    errors: dict[str, float],
    *,
    median: float = 3.0,
    rte_m: float = 0.05,
    view: tuple[str, str] = ("front", "front"),
    residual_px: float = 4.0,
    **about: str,
) -> TrialErrors:
    joints = tuple(_joint(j, e) for j, e in errors.items())
    found = KinematicErrors(
        lag_s=0.01,
        n=50,
        joints=joints,
        median_abs_deg=median,
        rte_m=rte_m,
        view_right=view[0],
        view_left=view[1],
        residual_2d_px=residual_px,
        residual_3d_cm=1.0,
    )
    of = {"dataset": "lab", "subject": "s1", "population": "healthy", "activity": "walk", "camera": "handheld"}
    return TrialErrors(errors=found, trial=trial, **(of | about))


# --- numbers


def test_niqr_of_a_known_sample():
    """Quartiles of 1..9 are 3 and 7."""
    assert median_niqr([9, 1, 8, 2, 7, 3, 6, 4, 5, np.nan]) == pytest.approx((5, 4 * 0.7413))
    assert median_niqr([2.0])[0] == 2.0
    assert np.isnan(median_niqr([2.0])[1])
    assert np.all(np.isnan(median_niqr([])))


def test_niqr_is_the_sd_of_a_normal_sample():
    sample = np.random.default_rng(0).normal(3, 2, 200_000)
    assert median_niqr(sample) == pytest.approx((3, 2), abs=0.02)


# --- the frame


def test_one_row_per_trial_and_joint():
    frame = error_frame(
        [_trial("a", {"knee_flexion_r": 2.0, "neck_bending": 1.0}, view=("ipsilateral", "contralateral"))]
    )
    assert list(frame.columns) == list(COLUMNS)
    assert list(frame["joint"]) == ["knee_flexion", "neck_bending"]
    assert list(frame["side"]) == ["r", ""]
    assert list(frame["view"]) == ["ipsilateral", "lateral"]
    assert list(frame["median_abs_deg"]) == [2.0, 1.0]
    assert set(frame["trial_median_abs_deg"]) == {3.0}


def test_several_cameras_have_no_view():
    assert set(error_frame([_trial("a", {"knee_flexion_l": 2.0}, camera="several")])["view"]) == {""}


# --- the tables


def test_an_empty_frame_gives_empty_tables_with_the_papers_figures():
    tables = paper_tables(error_frame([]))
    for table in tables.values():
        assert set(table.cells) == {(r, c) for r in table.rows for c in table.columns}
        assert all(cell.n == 0 and np.isnan(cell.value) and np.isnan(cell.spread) for cell in table.cells.values())
        assert table.text()
    assert tables["summary"].cell(MEDIAN, "MMMC handheld").paper == "2.79 (0.86)"
    assert tables["summary"].ours(MEDIAN, "MMMC handheld") == ""


def test_a_frame_with_one_row():
    tables = paper_tables(error_frame([_trial("a", {"knee_flexion_r": 2.0})]))
    cell = tables["joints_by_dataset"].cell("Knee Flexion", "lab handheld")
    assert (cell.value, cell.n, cell.paper) == (2.0, 1, "")
    assert np.isnan(cell.spread)
    assert tables["joints_by_dataset"].ours("Knee Flexion", "lab handheld") == "2.00"
    assert tables["joints_by_dataset"].cell("Hip Flexion", "lab handheld").n == 0
    assert tables["residuals"].cell("2D residual (px)", "Pearson r").n == 0
    assert tables["summary"].ours("Joints compared", "lab handheld") == "1"  # a table keeps its decimals


def test_the_summary_by_hand():
    rows = [
        _trial("a", {"knee_flexion_r": 2.0, "pelvis_tilt": 4.0, "elbow_flex_r": 90.0}, median=1.0, rte_m=0.02),
        _trial("b", {"knee_flexion_r": 4.0}, median=2.0, rte_m=float("nan")),
        _trial("c", {"knee_flexion_r": 6.0}, median=6.0, rte_m=0.04),
        _trial("d", {"knee_flexion_r": 1.0}, median=9.0, dataset="MMMC", camera="static"),
    ]
    table = paper_tables(error_frame(rows))["summary"]
    assert table.columns == ("lab handheld", "MMMC handheld", "MMMC static", "BML-MoVi static")
    median = table.cell(MEDIAN, "lab handheld")
    assert (median.value, median.n) == (2.0, 3)
    assert median.spread == pytest.approx(0.7413 * (4.0 - 1.5))
    # Mean over OpenCap's joints (not the elbow), each 1 above its median here: (3 + 5) / 2, 5, 7.
    assert table.cell(MEAN, "lab handheld").value == pytest.approx(5.0)
    assert (table.cell(RTE, "lab handheld").value, table.cell(RTE, "lab handheld").n) == (pytest.approx(3.0), 2)
    assert table.cell("Joints compared", "lab handheld").value == 1  # a knows two of the paper's, b and c one
    beside = table.cell(MEDIAN, "MMMC static")
    assert (beside.value, beside.n, beside.paper) == (9.0, 1, "2.96 (0.78)")


def test_both_sides_count_as_values_of_one_trial():
    table = paper_tables(error_frame([_trial("a", {"knee_flexion_r": 2.0, "knee_flexion_l": 5.0})]))[
        "joints_by_dataset"
    ]
    assert (table.cell("Knee Flexion", "lab handheld").value, table.cell("Knee Flexion", "lab handheld").n) == (3.5, 1)


def test_populations_and_activities_meet_the_papers_names():
    rows = [
        _trial("a", {"knee_flexion_r": 2.0}, median=2.0, population="healthy", activity="Walk"),
        _trial("b", {"knee_flexion_r": 3.0}, median=3.0, population="Neurologic", activity="timed up and go"),
        _trial("c", {"knee_flexion_r": 3.0}, median=5.0, population="stiff knee", activity="squat"),
    ]
    tables = paper_tables(error_frame(rows))
    by_population, by_activity = tables["by_population"], tables["by_activity"]
    assert by_population.columns == ("stiff knee", "control", "neurological", "LLPU", "pediatric", "All")
    assert [by_population.cell(MEDIAN, c).value for c in by_population.columns[:3]] == [5.0, 2.0, 3.0]
    assert by_population.cell(MEDIAN, "neurological").paper == "3.32 (0.92)"
    assert (by_population.cell(MEDIAN, "All").value, by_population.cell(MEDIAN, "All").n) == (3.0, 3)
    assert by_population.cell("Mean Absolute Error, walking (deg)", "control").n == 1
    assert by_population.cell("Mean Absolute Error, walking (deg)", "neurological").n == 0
    assert [by_activity.cell(MEDIAN, c).n for c in ("squat", "walking", "TUG", "FSST")] == [1, 1, 1, 0]


def test_residuals_against_errors_by_pearson():
    px, error = [3.0, 4.0, 6.0, 5.0, 9.0], [2.0, 2.5, 2.4, 3.5, 4.0]
    rows = [_trial(f"{p}", {"knee_flexion_r": e}, median=e, residual_px=p) for p, e in zip(px, error, strict=True)]
    table = paper_tables(error_frame(rows))["residuals"]
    r, p = table.cell("2D residual (px)", "Pearson r"), table.cell("2D residual (px)", "p")
    wanted = float(np.corrcoef(px, error)[0, 1])
    assert (r.value, r.n, r.paper) == (pytest.approx(wanted), 5, "0.35")
    # r * sqrt((n - 2) / (1 - r^2)) follows Student's t with n - 2 degrees of freedom.
    assert p.value == pytest.approx(2 * stats.t.sf(wanted * np.sqrt(3 / (1 - wanted**2)), 3))
    assert table.cell("2D residual (px)", "median").value == 5.0
    assert table.cell("3D residual (cm)", "Pearson r").n == 0  # all equal: no correlation, not 0


def test_views_and_their_test():
    rows = []
    for i in range(6):
        rows.append(_trial(f"f{i}", {"knee_flexion_r": 4.0 + i / 10, "hip_adduction_r": 1.0 + i / 10}))
        side = ("ipsilateral", "contralateral")
        rows.append(_trial(f"s{i}", {"knee_flexion_r": 3.0 + i / 10, "hip_adduction_r": 2.0 + i / 10}, view=side))
    tables = paper_tables(error_frame(rows))
    assert tables["by_view"].cell("Knee Flexion", "front").value == pytest.approx(4.25)
    assert tables["by_view"].cell("Knee Flexion", "ipsilateral").value == pytest.approx(3.25)
    assert tables["by_view"].cell("Knee Flexion", "contralateral").n == 0
    test = tables["view_tests"]
    knee, adduction = test.rows[1], test.rows[2]
    assert test.cell(knee, "difference (deg)").value == pytest.approx(1.0)
    assert test.cell(adduction, "difference (deg)").value == pytest.approx(1.0)
    assert test.cell(knee, "p").value == pytest.approx(1 / 924)  # all of 6 below all of 6: 1 of 12 over 6 orders
    assert (test.cell(knee, "p").n, test.cell(knee, "p").paper) == (12, "<0.005")
    assert test.cell(test.rows[0], "p").n == 0


def test_normality_of_both_levels():
    """Within: a share of trials; between: scipy's p of the trials' medians."""
    g = np.random.default_rng(0)
    medians = g.lognormal(1, 1, 30)
    rows = [_trial(f"t{i}", {"knee_flexion_r": m}, median=m) for i, m in enumerate(medians)]
    p = [0.001] * 12 + [0.5] * 15 + [float("nan")] * 3
    rows = [
        replace(r, errors=replace(r.errors, joints=tuple(replace(j, normal_p=v) for j in r.errors.joints)))
        for r, v in zip(rows, p, strict=True)
    ]
    table = paper_tables(error_frame(rows))["normality"]
    within, between = table.columns
    assert table.cell("Knee Flexion", within).value == pytest.approx(12 / 27)
    assert table.cell("Knee Flexion", within).n == 27
    for row in ("Knee Flexion", "All"):
        assert table.cell(row, between).value == pytest.approx(stats.shapiro(medians).pvalue)
        assert table.cell(row, between).value < 0.05
    assert table.cell("Hip Flexion", between).n == 0


def _indices(n: int, seed: int = 0) -> pd.DataFrame:
    g = np.random.default_rng(seed)
    true = g.normal(85, 10, n)
    rows = []
    for i, value in enumerate(true):
        about = {"subject": f"P{i // 2:02}", "session_label": f"visit {i}", "session_id": i, "method": "paper-2025-v1"}
        for kind, sd in (("single", 5.0), ("rig", 1.0)):
            rows.append(
                {**about, "kind": kind, "norm": f"our-{kind}-v1", "norm_kind": kind, "index": g.normal(value, sd)}
            )
            rows.append({**about, "kind": kind, "norm": "gillette-166-body-angles-v1", "norm_kind": "", "index": 0.0})
    return pd.DataFrame(rows, columns=list(INDEX_COLUMNS))


def test_the_index_of_one_camera_against_several():
    frame = _indices(40)
    frame = frame.loc[~((frame["session_id"] == 3) & (frame["kind"] == "rig"))]  # a visit with one kind alone
    pairs = index_pairs(frame.sample(frac=1, random_state=0))
    assert pairs["session_label"].tolist() == [f"visit {2 * i}" for i in range(20)]  # the first of each person
    assert set(pairs["single_norm"]) == {"our-single-v1"}
    table = index_agreement(pairs)
    (row,) = table.rows
    assert table.cell(row, "r").value == pytest.approx(np.corrcoef(pairs["single"], pairs["rig"])[0, 1])
    assert table.cell(row, "r").paper == "0.85"
    assert table.cell(row, "bias").value == pytest.approx((pairs["single"] - pairs["rig"]).mean())
    assert "each of 20 persons" in table.note
    twice = pd.concat([frame, frame.assign(method="pbl-2025-three-angles-v5")])
    with pytest.raises(PblError, match="several indices"):
        index_pairs(twice)
    assert index_pairs(frame.assign(norm_kind="")).empty


def test_a_joint_never_compared_is_no_value():
    row = _trial("a", {})
    nothing = JointError("knee_flexion_r", 0, *[float("nan")] * 7)
    row = TrialErrors(**{**vars(row), "errors": KinematicErrors(**{**vars(row.errors), "joints": (nothing,)})})
    tables = paper_tables(error_frame([row]))
    assert tables["joints_by_dataset"].cell("Knee Flexion", "lab handheld").n == 0
    assert tables["summary"].cell("Joints compared", "lab handheld").value == 0
    assert tables["summary"].cell(MEAN, "lab handheld").n == 0


def test_a_trial_against_two_references_is_two_comparisons():
    rows = [_trial("a", {"knee_flexion_r": 2.0}, median=2.0), _trial("a", {"knee_flexion_r": 3.0}, median=3.0)]
    assert paper_tables(error_frame(rows))["summary"].cell(MEDIAN, "lab handheld").n == 2


def test_a_frame_without_its_columns_is_refused():
    with pytest.raises(PblError, match="rte_m"):
        paper_tables(error_frame([]).drop(columns="rte_m"))


def test_methods_stand_apart():
    rows = [
        _trial("a", {"knee_flexion_r": 2.0}, median=2.0, detector="blazepose", solver="gauss-newton"),
        _trial("a", {"knee_flexion_r": 3.0}, median=4.0, detector="blazepose", solver="paper-2025"),
    ]
    table = paper_tables(error_frame(rows))["by_method"]
    assert table.rows == ("blazepose, gauss-newton", "blazepose, paper-2025")
    assert [table.cell(r, MEDIAN).value for r in table.rows] == [2.0, 4.0]


# --- the paper's figures


def test_every_figure_of_the_paper_stands_in_a_cell():
    """A figure whose row or column is spelt otherwise would silently be left out."""
    tables = paper_tables(error_frame([]))
    shown = 0
    for name, table in tables.items():
        for row, cells in paper_figures().get(name, {}).get("cells", {}).items():
            for column, text in cells.items():
                assert table.cell(row, column).paper == text, (name, row, column)
                shown += 1
    assert shown == 9 + 45 + 60 + 10 + 11 + 6 + 4


def test_the_papers_figures_are_the_papers():
    if not PAPER.is_file():
        pytest.skip("the paper's text is absent")
    text = PAPER.read_text(encoding="utf-8").replace("\\", "")
    for name, table in paper_figures().items():
        if name == "source":
            continue
        for row, cells in table["cells"].items():
            for figure in cells.values():
                plain = figure.removeprefix("<").removesuffix(" (nIQR)")
                if re.fullmatch(r"[\d.]+( \([\d. ]+\))?", plain):
                    assert plain in text or plain == "1971", (name, row, figure)
    row = next(line for line in text.splitlines() if line.startswith("Knee Flexion & 3.77"))
    assert "4.36 (1.48)" in row


# --- files


EVIL = "<script>alert(1)</script> & 50 % {_}"


def test_the_page_is_whole_escaped_and_asks_for_nothing():
    tables = paper_tables(error_frame([_trial("a", {"knee_flexion_r": 2.0}, dataset=EVIL, population=EVIL)]))
    page = Page(html(tables))
    assert page.problems == page.all("script") == []
    assert [v for _, a in page.tags for k, v in a.items() if k in ("src", "href") and not str(v).startswith("#")] == []
    assert "2.79 (0.86)" in html(tables)
    assert "No trial of ours has a value" in html(paper_tables(error_frame([])))


def test_latex_is_escaped_and_its_columns_count():
    tables = paper_tables(error_frame([_trial("a", {"knee_flexion_r": 2.0}, dataset=EVIL)]))
    for table in tables.values():
        text = latex(table)
        assert not re.search(
            r"(?<!\\)[%#_$~^]",
            text.replace(f"pbl_{table.name}", "").replace("$<$", "").replace("$>$", "").replace("$|$", ""),
        )
        columns = re.findall(r"\\begin\{tabular\}\{(l r*|lr*)\}", text)[0]
        for line in text.split(r"\midrule")[1].split(r"\bottomrule")[0].strip().splitlines():
            assert line.endswith(r" \\")
            assert len(re.findall(r"(?<!\\)&", line)) == len(columns) - 1
        assert text.count("{") == text.count("}")
    assert r"2.00 {[1]} & {[0]} & 4.05 (1.70) & {[0]} & 3.92 (2.12)" in latex(tables["joints_by_dataset"])


def test_the_files_hold_the_cells(tmp_path: Path):
    tables = paper_tables(error_frame([_trial("a", {"knee_flexion_r": 2.0}), _trial("b", {"knee_flexion_r": 3.0})]))
    paths = write_tables(tables, tmp_path / "new" / "folder")
    assert len(paths) == 2 * len(tables) + 1
    assert paths[-1].name == "index.html"
    with (tmp_path / "new" / "folder" / "joints_by_dataset.csv").open() as file:
        rows = {(r["row"], r["column"]): r for r in csv.DictReader(file)}
    ours = rows["Knee Flexion", "lab handheld"]
    assert (float(ours["value"]), int(ours["n"])) == (2.5, 2)
    empty = rows["Knee Flexion", "MMMC static"]
    assert (empty["value"], empty["n"], empty["paper"]) == ("", "0", "3.92 (2.12)")
    assert empty["paper_where"].startswith("Supplementary Table 1")


def test_what_is_printed(capsys: pytest.CaptureFixture[str]):
    print_tables(paper_tables(error_frame([_trial("a", {"knee_flexion_r": 2.0})])))
    text = capsys.readouterr().out
    assert "2.00 [1]" in text
    assert "2.79 (0.86)" in text
    assert re.search(r"without a value of ours: .*view_tests", text)


# --- curves


@pytest.fixture(scope="module")
def walk() -> tuple[TrialFit, tuple[GaitCycle, ...]]:
    """A walk and its cycles."""
    fit = walking_fit(load_body().joint_names, "x", n_frames=240)
    events = [GaitEvent(t, side, event, 1.0, 0) for t, side, event in foot_events(7.5, 0.1)]
    return fit, find_cycles(events, fit)


def test_curves_of_fit_and_reference_are_pairs(walk, tmp_path: Path):
    """The reference's clock is 40 ms behind, its knees bend 3 degrees more: the pairs differ by just that."""
    fit, cycles = walk
    truth = reference_of_fit(fit, "x")
    angles = {k: v + 3.0 * k.startswith("knee") for k, v in truth.angles_deg.items()}
    truth = replace(truth, time_s=truth.time_s - 0.04, angles_deg=angles)
    frame = cycle_curves(fit, truth, cycles)
    used = [c for c in cycles if c.used]
    assert len(used) >= 6
    assert list(frame.columns) == list(CURVE_COLUMNS)
    knees = frame[frame["joint"] == "knee_flexion"]
    assert len(knees) == 101 * len(used)
    np.testing.assert_allclose(knees["reference_deg"] - knees["fit_deg"], 3.0, atol=0.3)
    assert np.max(knees["fit_deg"]) > 50
    assert not set(frame["joint"]) & {"pelvis_tilt", "pelvis_list", "pelvis_rotation"}
    assert {"lumbar_extension", "hip_flexion"} <= set(frame["joint"])

    with np.load(save_curves(frame, tmp_path / "curves.npz")) as data:
        a, b = data["knee_flexion_fit"], data["knee_flexion_reference"]
        assert a.shape == b.shape == (len(used), 101)
        assert len(set(data["knee_flexion_cycle"])) == len(used)
        np.testing.assert_array_equal(a[0], np.asarray(knees["fit_deg"])[:101])
        assert data["percent"][[0, -1]].tolist() == [0, 100]


def test_cycles_with_holes_give_no_pair(walk):
    fit, cycles = walk
    truth = reference_of_fit(fit, "x")
    holed = {k: np.where((fit.time_s > 3.0) & (fit.time_s < 3.3), np.nan, v) for k, v in truth.angles_deg.items()}
    frame = cycle_curves(fit, replace(truth, angles_deg=holed), cycles)
    there = set(frame["cycle"])
    hit = {c.number for c in cycles if c.used and c.start_s < 3.3 and c.end_s > 3.0}
    assert hit
    assert there == {c.number for c in cycles if c.used} - hit
    empty = cycle_curves(fit, truth, [])
    assert list(empty.columns) == list(CURVE_COLUMNS)
    assert isinstance(empty, pd.DataFrame)
    assert empty.empty
