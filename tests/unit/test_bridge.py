"""The bridge between versions: shifts with their intervals, and the comparisons that a change touches."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from pbl_pipeline.errors import PblError
from pbl_pipeline.validation import bridge as bridge_module
from pbl_pipeline.validation import bridge_pairs, bridge_table, folder_values, touched
from tests.command import pbl

OLD, NEW = {"a": 90.0, "b": 80.0, "c": 101.0, "d": 70.0}, {"a": 92.0, "b": 83.0, "c": 100.0, "e": 50.0}


def visits(folder: Path, values: dict[str, float]) -> Path:
    """The metrics.json of visits with an index and a cadence ten higher; the speed is not known."""
    for name, index in values.items():
        (folder / name).mkdir(parents=True)
        session = {"gdi": {"mean": index}, "cadence_steps_per_min": {"mean": index + 10.0}, "speed_m_per_s": None}
        (folder / name / "metrics.json").write_text(json.dumps({"session": session}))
    return folder


def test_the_shift_is_students_of_the_visits_that_both_have(tmp_path: Path):
    pairs = bridge_pairs(folder_values(visits(tmp_path / "old", OLD)), folder_values(visits(tmp_path / "new", NEW)))
    shift = np.array([2.0, 3.0, -1.0])
    assert sorted(pairs.loc[pairs["measure"] == "gdi", "shift"]) == sorted(shift)
    table = bridge_table(pairs, ("old", "new"))
    low, high = stats.t.interval(0.95, 2, loc=shift.mean(), scale=stats.sem(shift))
    found = {c: table.cell("gdi", c).value for c in table.columns}
    assert found == pytest.approx(
        {"mean": shift.mean(), "low": low, "high": high, "sd": shift.std(ddof=1), "largest": 3}
    )
    assert table.rows == ("gdi", "cadence_steps_per_min")
    assert table.cell("gdi", "mean").n == 3


def test_folders_by_the_command(tmp_path: Path):
    old, new = visits(tmp_path / "old", OLD), visits(tmp_path / "new", NEW)
    done = pbl("validate", "bridge", old, new, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert "gdi" in done.out
    pairs = pd.read_csv(tmp_path / "out" / "pairs.csv")
    assert len(pairs) == 6
    assert (tmp_path / "out" / "bridge.tex").exists()


def test_what_cannot_be_bridged(tmp_path: Path):
    old = folder_values(visits(tmp_path / "old", {"a": 90.0}))
    with pytest.raises(PblError, match=r"^STATS_INPUT: "):
        bridge_table(bridge_pairs(old, old), ("x", "y"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(PblError, match=r"^FILE_MISSING: "):
        folder_values(tmp_path / "empty")
    with pytest.raises(PblError, match=r"^SOLVER_UNKNOWN: "):
        bridge_module.refit_bridge_set("blazepose-v1", tmp_path)
    assert pbl("validate", "bridge", "blazepose").code == 2


def test_comparisons_that_a_change_touches():
    rows = [
        ("P1", "v1", True, False),
        ("P1", "v2", False, True),  # against v1: across
        ("P1", "v3", True, True),  # against v2: both by the new one
        ("P1", "v4", True, False),  # against v3: by the old one alone
        ("P2", "v1", True, False),  # another person
    ]
    found = touched(pd.DataFrame(rows, columns=["subject", "visit", "old", "new"]))
    assert found.to_records(index=False).tolist() == [("P1", "v1", "v2", "across"), ("P1", "v3", "v4", "old")]


@pytest.mark.long
@pytest.mark.slow
def test_the_frozen_set_by_two_methods_of_events(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    first = dict(list(bridge_module.BRIDGE_SET.items())[:3])
    monkeypatch.setattr(bridge_module, "BRIDGE_SET", first)
    done = pbl("validate", "bridge", "phase-transformer", "zeni-2008", "--keep", tmp_path)
    assert done.code == 0, done.err
    for method in ("phase-transformer", "zeni-2008"):
        assert {p.parent.name for p in (tmp_path / method).rglob("metrics.json")} == set(first)
    values = [folder_values(tmp_path / m) for m in ("phase-transformer", "zeni-2008")]
    table = bridge_table(bridge_pairs(*values), ("a", "b"))
    # By Zeni's extrema stance comes out longer on fits (docs/measures.md).
    assert table.cell("stance_percent", "mean").value > 2.0
