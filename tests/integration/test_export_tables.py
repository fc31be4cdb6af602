"""`pbl export --subject`: a visit of the tables, with what is stored and nothing computed anew."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.errors import PblError
from pbl_schemas import fit, gait, gdi, session
from pbl_schemas.intake import Methods, Sensors, VisitRecord, ingest
from pbl_schemas.reading import fitted_visit, list_fitted, load_visits
from pbl_schemas.reading import visits as reading_visits
from pbl_workers.populate import populate
from tests import Faults, Limits, StandIn
from tests.command import pbl
from tests.rows import register

from . import chain


def test_a_visit_of_the_tables(tables: None, tmp_path: Path, stand_in: StandIn, change_fits: Callable[..., None]):
    ezc3d = pytest.importorskip("ezc3d")
    change_fits(chain.with_all_markers)
    time = np.arange(-0.5, 9.0, 0.02)
    log = {"time_s": time, "qw": 0.5, "qx": -0.5, "qy": 0.5, "qz": -0.5, "ax": 0.0, "ay": 9.81, "az": time}
    pd.DataFrame(log).to_csv(tmp_path / "log.csv", index=False)
    paths = [chain.small_video(tmp_path, name) for name in ("Doe1", "Doe2")]
    for path, files in zip(paths, (Sensors(attitude=tmp_path / "log.csv"), Sensors()), strict=True):
        assert ingest([path], VisitRecord("P001", session_label="2026-03-01"), files=[files])[0].status == "registered"
    with pytest.raises(PblError, match="no finished fit"):
        fitted_visit({"subject": "P001"})
    populate()
    stand_in(detect_events=None)  # nothing is computed anew
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


def _files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_many_visits_are_each_as_alone(tables: None, tmp_path: Path, change_fits: Callable[..., None], limits: Limits):
    change_fits(chain.with_all_markers)
    visits = [("P001", "2026-03-01"), ("P001", "nach OP é"), ("P002", "2026-03-01"), ("P003", "2026-03-01")]
    for i, (subject, label) in enumerate(visits):
        register(chain.small_video(tmp_path, f"walk{i}"), subject=subject, session_label=label)
    register(chain.small_video(tmp_path, "nobody", people="nobody"), subject="P004", session_label="1")
    populate()
    limits(reading_visits, _TOGETHER=3)
    wanted = ("--to", "trc", "--to", "csv")
    done = pbl("export", "--all", *wanted, "--out", tmp_path / "all")
    assert done.code == 0, done.err
    assert done.out == f"4 of 4 visits in {tmp_path / 'all'}\n"
    assert {p.parent.relative_to(tmp_path / "all").as_posix() for p in (tmp_path / "all").rglob("export.json")} == {
        "P001/2026-03-01",
        "P001/nach OP _",
        "P002/2026-03-01",
        "P003/2026-03-01",
    }
    alone = pbl("export", "--subject", "P001", "--session", "nach OP é", *wanted, "--out", tmp_path / "alone")
    assert alone.code == 0, alone.err
    assert _files(tmp_path / "alone") == _files(tmp_path / "all" / "P001" / "nach OP _")
    several = pbl("export", "--subject", "P001", *wanted, "--out", tmp_path / "several")
    assert several.error_code == "USAGE"
    assert "2 visits match: session_label 2026-03-01, nach OP é" in several.err
    assert "add `--session 2026-03-01` or `--session nach OP é`" in several.err
    # One that cannot be exported does not hold up the others, and the exit status says that there was one.
    failed = fit.SessionFit & (session.Session & {"subject": "P001", "session_label": "2026-03-01"})
    check = {"fit_check": "residual_2d_px", "fit_check_outcome": "FAIL", "fit_check_advice": "look at the overlay"}
    fit.SessionFit.Check.insert1({**failed.keys()[0], **check})
    done = pbl("export", "--all", "--subject", "P001", *wanted, "--out", tmp_path / "one")
    assert done.code == 1
    assert done.out.startswith("1 of 2 visits")
    assert done.err.startswith("P001/2026-03-01: EXPORT_INPUT: a fit that failed its check residual_2d_px")
    assert len(list((tmp_path / "one").rglob("export.json"))) == 1


def test_many_visits_take_as_many_questions_as_one(tables: None, tmp_path: Path, faults: Faults):
    for i in range(3):
        register(chain.small_video(tmp_path, f"walk{i}"), subject=f"P00{i}")
    populate()
    listed = list_fitted({})
    asked = faults(fit.schema.connection, "query")
    assert len([s for _, s in load_visits(listed) if not isinstance(s, PblError)]) == 3
    three = len(asked)
    asked.clear()
    list(load_visits(listed[:1]))
    assert three == len(asked) > 10


def test_visits_that_are_not_there_or_are_ambiguous(tables: None, tmp_path: Path):
    out = ("--to", "mot", "--out", tmp_path / "out")
    assert pbl("export", "--all", *out).error_code == "DB_NOT_FOUND"
    assert pbl("export", "--slice", "paper", *out).error_code == "DB_NOT_FOUND"
    assert pbl("export", "--all", "--session", "1", *out).error_code == "USAGE"
    assert pbl("export", "--slice", "paper", "--subject", "P001", *out).error_code == "USAGE"
    path = chain.small_video(tmp_path, "walk")
    for method in ("blazepose", "gauss-newton"):
        ingest([path], VisitRecord("P001"), methods=Methods(fit=method))
    populate()
    ambiguous = pbl("export", "--all", *out)
    assert ambiguous.error_code == "USAGE"
    assert "fit_method blazepose-v" in ambiguous.err
    ambiguous = pbl("export", "--subject", "P001", *out)
    assert ambiguous.error_code == "USAGE"
    assert "2 fits match: fit_method blazepose-v" in ambiguous.err
    assert "or `--fit-method gauss-newton-v" in ambiguous.err
    assert pbl("export", "--all", "--fit-method", "gauss-newton", *out).code == 0
