"""The bridge over the tables: visits by two methods, what compares across the change, and what an upgrade says."""

from pathlib import Path
from typing import Any

import pandas as pd
import pytest

from pbl_schemas import gait, gdi
from pbl_schemas.reading import comparison
from pbl_workers.populate import populate
from tests.command import pbl
from tests.integration.chain import small_video
from tests.rows import register

OLD, NEW = "zeni-2008-v1", "phase-transformer-v3"


@pytest.fixture(scope="module")
def visits(module_tables: Path) -> None:
    """Three visits of P001, all by the events of today; the first two by Zeni's as well, then the second by these alone
    as if it had been computed before."""
    for day in ("2026-01-10", "2026-04-10", "2026-07-10"):
        register(small_video(module_tables, f"walk {day}"), session_label=day)
    plans = (gait.GaitPlan & "session_id < 3").to_dicts()
    gait.GaitPlan.insert({**p, "gait_method": OLD} for p in plans)
    populate()


def test_the_shift_is_that_of_the_rows(visits: None, tmp_path: Path):
    done = pbl("validate", "bridge", OLD, NEW, "--tables", "--out", tmp_path)
    assert done.code == 0, done.err
    assert "0 successive visits of a person are compared across the change" in done.out
    pairs: Any = pd.read_csv(tmp_path / "pairs.csv")
    stance = pairs[pairs["measure"] == "stance_percent"].sort_values("visit")
    rows = gdi.SessionGdi.Measure * gdi.SessionGdi.proj("session_id") & {"session_measure": "stance_percent"}
    by = {
        m: (rows & {"gait_method": m} & "session_id < 3").to_arrays("session_measure_mean", order_by="session_id")
        for m in (OLD, NEW)
    }
    assert len(stance) == 2
    assert stance["shift"].to_numpy() == pytest.approx(by[NEW] - by[OLD])


def test_visits_across_the_change_are_listed(visits: None, tmp_path: Path):
    gone = (gdi.SessionGdi & {"session_id": 2, "gait_method": NEW}).keys()
    (gdi.SessionGdi & gone).delete(part_integrity="cascade", prompt=False)
    _, found = comparison.values_by(OLD, NEW)
    # The second by the old alone: the first has both, the third only the new.
    assert found.to_records(index=False).tolist() == [
        ("P001", "2026-01-10", "2026-04-10", "old"),
        ("P001", "2026-04-10", "2026-07-10", "across"),
    ]
    populate()


def test_keys_without_results_are_refused(visits: None):
    assert pbl("validate", "bridge", "blazepose-v1", NEW, "--tables").error_code == "SOLVER_UNKNOWN"


def test_an_upgrade_names_results_by_an_older_default(visits: None, monkeypatch: pytest.MonkeyPatch):
    assert comparison.changed_defaults() == []
    newer = "phase-transformer-v4"
    defaults = {**comparison.default_methods(), "gait_method": ("gait", "phase-transformer", newer)}
    monkeypatch.setattr(comparison, "default_methods", lambda: defaults)
    (line,) = comparison.changed_defaults()
    assert line.startswith(f"The default gait method is {newer}; 3 visits have results by {NEW}.")
    assert f"pbl validate bridge {NEW} {newer} --tables" in line
    assert line in pbl("db", "migrate", "--dry-run").out
