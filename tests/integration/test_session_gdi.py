"""The measures of a visit are those of the cycles it stands beneath: the rows of its trials, each once and never older
ones."""

from pathlib import Path

import pytest

from pbl_schemas import fit, gait, gdi, qc
from pbl_schemas.reading.status import pipeline_status
from pbl_schemas.rows import delete_below
from pbl_workers import refresh
from pbl_workers.populate import populate
from tests import Faults
from tests.integration import chain
from tests.rows import register

BEFORE = ["VideoInfo", "Tracking", "SubjectChoice", "Keypoints", "TrialInput", "SessionFit"]
OF_TRIALS = ["GaitEvents", "GaitCycle", "Spatiotemporal", "GDI"]


@chain.computed_once
def visit(folder: Path) -> None:
    """A computed visit of two recordings, 1 and 2."""
    register(chain.small_video(folder, "a"), chain.small_video(folder, "b", n=250), session_label="2026-01-10")
    populate()


def done(*tables: str) -> dict[str, int]:
    return {t.table: t.done for t in populate(tables or None).tables if t.done}


def test_the_visit_pools_the_rows_of_its_trials(visit: None, faults: Faults):
    """Rows of another version of the code stand on the page: what is pooled is what stands there."""
    before = gdi.SessionGdi.fetch1()
    cycle = (gait.GaitCycle.Cycle & {"video_id": 1, "cycle_used": True}).to_dicts(order_by="cycle_no")[0]
    key = {k: cycle[k] for k in gait.GaitCycle.Cycle.primary_key}
    gait.GaitCycle.Cycle.update1({**key, "cycle_foot_up": cycle["cycle_foot_up"] + 0.1})
    delete_below(gdi.SessionGdi, gdi.SessionGdi.keys())

    from pbl_pipeline.fit import TrialFit

    faults(TrialFit, "load", AssertionError("the visit reads the rows of its trials, not the fit"))
    assert done("SessionGdi", "SessionQc") == {"SessionGdi": 1, "SessionQc": 1}
    after = gdi.SessionGdi.fetch1()
    stride = cycle["cycle_end"] - cycle["cycle_start"]
    pooled = (gdi.SessionGdi.Measure & {"session_measure": "stance_percent"}).fetch1("session_measure_n")
    assert after["session_stance"] - before["session_stance"] == pytest.approx(100 * 0.1 / stride / pooled)
    assert after["session_gdi"] == pytest.approx(before["session_gdi"])


def test_a_visit_waits_for_the_rows_of_every_trial(tables: None, tmp_path: Path):
    register(chain.small_video(tmp_path, "a"), chain.small_video(tmp_path, "b", n=250), session_label="2026-01-10")
    populate(BEFORE)
    populate(["GaitEvents", "GaitCycle"])
    populate(["Spatiotemporal"])
    populate(["GDI"], limit=1)
    assert (len(fit.SessionFit.Trial()), len(gdi.GDI())) == (2, 1)
    refresh.refresh(everything=True)
    assert len(gdi.SessionGdi().key_source) == 0
    populate(["GDI", "SessionGdi"])
    assert len(gdi.SessionGdi()) == 1
    # It refers to the rows of its trials.
    assert sorted(gdi.SessionGdi.Trial().to_arrays("video_id")) == [1, 2]


@pytest.mark.parametrize("table", OF_TRIALS)
def test_what_a_visit_pooled_takes_it_along(visit: None, table: str):
    """A row of a trial that is gone, or made anew, is never beneath a visit that was computed from another one."""
    one = next(t for t in (gait.GaitEvents, gait.GaitCycle, gait.Spatiotemporal, gdi.GDI) if t.__name__ == table)
    gone = delete_below(one, (one & {"video_id": 2}).keys())
    assert gone["`pbl_gdi`.`__session_gdi`"] == gone["`pbl_qc`.`__session_qc`"] == 1
    assert len(gdi.SessionGdi()) == len(qc.SessionQc()) == 0
    anew = dict.fromkeys(OF_TRIALS[OF_TRIALS.index(table) :], 1)
    if table == "Spatiotemporal":
        del anew["GDI"]
    assert done() == {**anew, "SessionGdi": 1, "SessionQc": 1, "Kinetics": 1}
    assert not pipeline_status().errors
    assert done() == {}
