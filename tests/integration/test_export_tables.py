"""`pbl export --subject`: a visit of the tables, with what is stored and nothing computed anew."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import pbl_pipeline.fit
import pbl_pipeline.gait
from pbl_pipeline.body import marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import SessionFit
from schemas import gait, gdi
from schemas.export import session_of_tables
from schemas.ingest import Visit, ingest
from schemas.sensors import Sensors
from tests.command import pbl
from tests.exported import with_markers
from workers.populate import populate

from . import chain


def _fit_with_markers(trials, names, paramset=None, camera_motion="static") -> SessionFit:
    """The stand-in's fit with the markers of its set."""
    made, points = chain.fit_session(trials, names, paramset, camera_motion), marker_set("blazepose_33")
    more = {"marker_set": points.name, "marker_names": points.names, "site_offset_m": np.zeros((33, 3))}
    seen = {k: np.full((chain.N_FRAMES, 33), v) for k, v in (("residual_2d_px", 4.0), ("residual_3d_m", 0.03))}
    fits = tuple(with_markers(dataclasses.replace(t, **more, **seen)) for t in made.trials)
    return dataclasses.replace(made, trials=fits, site_offset_m=np.zeros((33, 3)))


def test_a_visit_of_the_tables(tables: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    ezc3d = pytest.importorskip("ezc3d")
    monkeypatch.setattr(pbl_pipeline.fit, "fit_session", _fit_with_markers)
    time = np.arange(-0.5, 9.0, 0.02)
    log = {"time_s": time, "qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5, "ax": 0.0, "ay": 9.81, "az": time}
    pd.DataFrame(log).to_csv(tmp_path / "log.csv", index=False)
    paths = [chain.small_video(tmp_path, name) for name in ("Doe1", "Doe2")]
    for path, files in zip(paths, (Sensors(attitude=tmp_path / "log.csv"), Sensors()), strict=True):
        assert ingest([path], Visit("P001", session_label="2026-03-01"), files=[files])[0].status == "registered"
    with pytest.raises(PblError, match="no finished fit"):
        session_of_tables({"subject": "P001"})
    populate()
    monkeypatch.setattr(pbl_pipeline.gait, "detect_events", None)  # nothing is computed anew
    formats = [word for f in ("trc", "mot", "osim", "c3d", "dlc", "csv") for word in ("--to", f)]
    visit = ("export", "--subject", "P001", "--session", "2026-03-01", *formats, "--number-trials")
    done = pbl(*visit, "--out", tmp_path / "out")
    assert done.code == 0, done.err
    assert len(done.out.splitlines()) == 2 * 5 + 10 + 1
    about = json.loads((tmp_path / "out" / "export.json").read_text())["trials"]
    assert set(about) == {"trial_1", "trial_2"}
    assert about["trial_1"]["event_method"] == gait.GaitEvents.to_arrays("gait_method")[0]
    assert about["trial_1"]["index_method"].startswith(gdi.GDI.to_arrays("gdi_method")[0])
    assert about["trial_1"]["fitted_with"].startswith("0.")
    stored = gait.GaitEvents.Event().to_dicts(order_by="video_id, event_no")
    events = pd.read_csv(tmp_path / "out" / "events.csv")
    assert len(stored) > 10
    np.testing.assert_allclose(events["time_s"], [float(e["event_time"]) for e in stored], atol=1e-6)
    first, second = (ezc3d.c3d(str(tmp_path / "out" / t / f"{t}.c3d")) for t in about)
    assert second["parameters"]["ANALOG"]["USED"]["value"][0] == 0
    labels = first["parameters"]["ANALOG"]["LABELS"]["value"]
    z = first["data"]["analogs"][0][labels.index("phone_accelerometer_z")]
    at = np.arange(len(z)) / first["parameters"]["ANALOG"]["RATE"]["value"][0]
    np.testing.assert_allclose(z, at, atol=1e-4)
    assert [p for p in (tmp_path / "out").rglob("*") if p.is_file() and b"Doe" in p.read_bytes()] == []
    assert pbl("export", "--subject", "P999", "--to", "mot", "--out", tmp_path / "b").error_code == "DB_NOT_FOUND"
