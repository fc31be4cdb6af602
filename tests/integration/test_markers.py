"""Laboratory markers as recordings of a visit: beside the phone's video, never pooled with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import pbl_pipeline.fit
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import fit_session
from pbl_pipeline.keypoints import WorldMarkers
from pbl_pipeline.synthetic import observe_markers, plain_walk
from schemas import fit, gait, gdi, norms, video, views
from schemas.results import load_session
from schemas.why import why
from tests.command import pbl
from tests.walking_fit import CYCLE_S
from workers.populate import populate

from . import chain

SHIPPED = Path(pbl_pipeline.body.__file__).parent / "data" / "markers_mpi_inf_3dhp_17.csv"


def recording(path: Path, seconds: float = 8.0, marker_set: str = "bml_movi_87") -> Path:
    """The walk of the stand-in's fit of a video, as markers without noise."""
    time = np.arange(0, seconds, 1 / 30)
    walk = plain_walk(time, stride_s=CYCLE_S, speed_m_per_s=1.2, start_m=(6.0, -2.2), camera_height_m=0)
    observe_markers(walk, time, marker_set=marker_set, noise_m=0.0, drop_share=0.0).save(path)
    return path


def fit_either(trials, names, paramset=None, camera_motion="static", markers=None):
    """Markers are fitted by the library, videos by the stand-in."""
    if isinstance(trials[0], WorldMarkers):
        return fit_session(trials, names, paramset, camera_motion, markers)
    return chain.fit_session(trials, names, paramset, camera_motion)


@pytest.fixture
def fitted(tables: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pbl_pipeline.fit, "fit_session", fit_either)


def test_a_phone_and_a_laboratory_measure_the_same_walk(fitted: None, tmp_path: Path):
    visit = ("--subject", "P001", "--session", "2026-03-01")
    assert pbl("ingest", chain.small_video(tmp_path, "walk"), *visit).code == 0
    lab = recording(tmp_path / "lab.npz")
    said = pbl("ingest", "--markers", lab, *visit)
    assert said.code == 0, said
    assert "87 of 87 markers of bml_movi_87" in said.out
    populate()
    ids = {r["camera_motion"]: int(r["video_id"]) for r in video.Video().to_dicts()}
    assert video.VideoInfo().to_arrays("video_id").tolist() == [ids["static"]]
    # A set of its own, and an index of its own, whose only cycles are its own.
    found = {r["fit_method"]: r for r in views.session_summary().to_dict("records")}
    assert set(found) == {"blazepose-v2", "markers-v1"} and len(gdi.SessionGdi()) == 2
    used = {int(r["video_id"]): int(r["n_cycles_used"]) for r in gait.GaitCycle().to_dicts()}
    assert found["blazepose-v2"]["session_cycles"] == used[ids["static"]] > 0
    assert found["markers-v1"]["session_cycles"] == used[ids["none"]] > 0
    # The stand-in gives the video's movement exactly, so what differs is the error of the fit of the markers.
    phone, laboratory = (found[m]["session_gdi"] for m in ("blazepose-v2", "markers-v1"))
    assert laboratory == pytest.approx(phone, abs=1.0)
    assert found["markers-v1"]["session_cadence"] == pytest.approx(120 / CYCLE_S, rel=0.01)
    row = (fit.SessionFit.Trial & {"video_id": ids["none"]}).fetch1()
    assert row["trial_residual_3d"] < 0.5 and row["trial_residual_2d"] is None
    # What was computed is not planned again; the phone's report is of the phone, the markers have none.
    populate()
    assert len(fit.SessionFit()) == 2
    shown = load_session({"subject": "P001", "fit_method": "blazepose-v2"})
    assert [t.name for t in shown.trials] == ["walk"] and len(shown.fitted) == 1
    of_markers = load_session({"subject": "P001", "fit_method": "markers-v1"})
    assert [t.name for t in of_markers.trials] == ["lab"]
    with pytest.raises(PblError, match="USAGE"):
        _ = of_markers.fitted
    assert why(ids["none"]).verdict == "everything is computed"
    with pytest.raises(PblError, match="laboratory markers"):
        norms.build_norm("both", populations=(), subjects=("P001",))
