"""Normative sets built from the tables: a new version each time, nothing registered ever changes."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbl_pipeline.gait
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import GaitMetrics
from pbl_schemas import fit, gait, gdi, lab, load_visit, norms, session
from pbl_schemas.intake import Methods, VisitRecord, ingest
from pbl_schemas.reading import frames
from pbl_workers.populate import populate
from tests import not_none
from tests.command import pbl
from tests.rows import outcomes, remove_all

from . import chain


@pytest.fixture(scope="module")
def walkers(module_tables: Path) -> Iterator[Path]:
    """Four healthy people and a patient, through the whole chain with stand-ins for the slow stages."""
    for i, name in enumerate(("C01", "C02", "C03", "C04", "P01")):
        path = chain.small_video(module_tables, f"walk{i}", n=340 + i)
        ingest([path], VisitRecord(name, population="patient" if name == "P01" else "healthy"))
    populate()
    assert len(gdi.SessionGdi()) == 5
    yield module_tables
    remove_all()
    (gdi.NormativeSet & "norm_query IS NOT NULL").delete(prompt=False)


def shipped() -> list[dict]:
    rows = (gdi.NormativeSet & "norm_query IS NULL").to_dicts(order_by="norm")
    return [{k: v for k, v in r.items() if k != "norm_file"} for r in rows]


def test_built_registered_and_used(walkers: Path):
    before = shipped()
    assert {r["norm_name"] for r in before} == set(pbl_pipeline.gait.norm_names())
    built = norms.build_norm("our-lab")
    assert (built.norm, built.new, built.n_people) == ("our-lab-v1", True, 4)
    healthy = session.Session & (lab.Subject & {"population": "healthy"})
    used = sum(int(n) for n in (gait.GaitCycle & (fit.FitSet & healthy)).to_arrays("n_cycles_used"))
    assert built.n_cycles == used >= 30
    row = (gdi.NormativeSet & {"norm": "our-lab-v1"}).to_dicts()[0]
    assert (row["norm_n"], row["norm_angle_model"], row["norm_name"]) == (used, "pbl_body", "our-lab")
    assert row["norm_query"]["subjects"] == ["C01", "C02", "C03", "C04"]
    assert row["norm_query"]["populations"] == ["healthy"]
    # The numbers are those of the library from the same cycles.
    again = norms.load_norm("our-lab")
    np.testing.assert_array_equal(again.mean_deg, built.set.mean_deg)
    assert again.sha256 == row["norm_sha256"]
    # The same cycles make no further version.
    assert (norms.build_norm("our-lab").norm, norms.build_norm("our-lab").new) == ("our-lab-v1", False)
    # Other cycles make one; the first and those that ship stay as they are.
    two = norms.build_norm("our-lab", ("healthy", "patient"))
    assert (two.norm, two.new, two.n_people) == ("our-lab-v2", True, 5)
    assert (gdi.NormativeSet & {"norm": "our-lab-v1"}).fetch1("norm_sha256") == row["norm_sha256"]
    assert shipped() == before
    pooled = norms.build_norm("our-lab", pooled_populations=("patient",))
    assert (pooled.norm, pooled.n_people, pooled.n_cycles) == ("our-lab-v3", 4, used)
    # A visit that is planned with the built set is scored with it, and its old result stays.
    old = (gdi.SessionGdi & _sets("P01")).fetch1("session_gdi", "norm")
    assert outcomes(ingest([walkers / "walk4.mp4"], VisitRecord("P01"), Methods(norm="our-lab-v1"))) == ["updated"]
    populate()
    rows = {r["norm"]: r for r in (gdi.SessionGdi & _sets("P01")).to_dicts()}
    assert set(rows) == {old[1], "our-lab-v1"}
    assert rows[old[1]]["session_gdi"] == pytest.approx(old[0])
    cycles = metrics_of({"subject": "P01", "norm": "our-lab-v1"}).trials[0].cycles
    scored = pbl_pipeline.gait.score_gdi(cycles, built.set)
    assert rows["our-lab-v1"]["session_gdi"] == pytest.approx(scored.mean, abs=1e-3)
    checks = gdi.SessionGdi.Check & _sets("P01") & {"norm": "our-lab-v1", "gdi_check": "norm_convention"}
    assert checks.fetch1("gdi_check_outcome") == "PASS"
    indices = frames.index_frame()
    kinds = dict(zip(indices["norm"], indices["norm_kind"], strict=True))
    assert (kinds["our-lab-v1"], kinds[old[1]]) == ("single", "")
    of_visit = indices[(indices["norm"] == "our-lab-v1") & (indices["subject"] == "P01")]
    assert of_visit["index"].tolist() == [pytest.approx(scored.mean, abs=1e-3)]
    assert "No visit has an index of one camera and one of several" in pbl("validate", "index").out


def metrics_of(restriction: dict[str, str]) -> GaitMetrics:
    return not_none(load_visit(restriction).measures)


def _sets(subject: str):
    return fit.FitSet & (session.Session & {"subject": subject})


def test_nine_angles_in_the_tables(walkers: Path):
    assert outcomes(ingest([walkers / "walk0.mp4"], VisitRecord("C01"), Methods(gdi="gillette-2008"))) == ["updated"]
    populate()
    found = (gdi.SessionGdi & _sets("C01") & {"gdi_method": "gillette-2008-v1"}).to_dicts()[0]
    assert found["norm"] == "gillette-166-nine-angles-v1"
    metrics = metrics_of({"subject": "C01", "gdi_method": "gillette-2008-v1"})
    fresh = pbl_pipeline.gait.score_gdi(metrics.trials[0].cycles, model="gillette-2008")
    assert found["session_gdi"] == pytest.approx(fresh.mean, abs=1e-3)
    assert fresh.profile is not None
    assert found["session_gps"] == pytest.approx(fresh.profile.gps, abs=1e-3)
    assert not_none(metrics.gdi.profile).left == pytest.approx(fresh.profile.left, abs=1e-3)
    assert (gdi.SessionGdi.Check & found & {"gdi_check": "norm_convention"}).fetch1("gdi_check_outcome") == "WARN"
    with pytest.raises(PblError, match="NORM_INVALID"):
        gdi.resolve("gillette-2008", "gillette-166-body-angles")


def test_what_cannot_be_built(walkers: Path):
    count = len(gdi.NormativeSet())
    refused: tuple[tuple[dict[str, Any], str], ...] = (
        ({"name": "Our Lab"}, "USAGE"),
        ({"name": "gillette-166-body-angles"}, "USAGE"),
        ({"name": "x1", "populations": ()}, "USAGE"),
        ({"name": "x1", "populations": ("martians",)}, "DB_NOT_FOUND"),
        ({"name": "x1", "subjects": ("C99",)}, "DB_NOT_FOUND"),
        ({"name": "x1", "restriction": {"fit_method": "none-v1"}}, "SOLVER_UNKNOWN"),
        ({"name": "x1", "populations": (), "subjects": ("C01",)}, "NORM_INVALID"),
    )
    for arguments, code in refused:
        with pytest.raises(PblError, match=f"^{code}: "):
            norms.build_norm(**arguments)
    assert len(gdi.NormativeSet()) == count


def test_curves_beside_the_bands(walkers: Path):
    frame = frames.cycle_curves({"subject": "C02"})
    assert set(frame["side"]) == {"left", "right"}
    assert set(frame["angle"]) == set(pbl_pipeline.gait.ANGLE_NAMES)
    assert len(frame) == 2 * 9 * 51
    knee = frame[(frame["angle"] == "knee_flexion") & (frame["side"] == "right")]
    cycles = [c for c in metrics_of({"subject": "C02"}).trials[0].cycles if c.used and c.side == "right"]
    np.testing.assert_allclose(knee["mean_deg"], np.mean([c.curves["knee_flexion"] for c in cycles], axis=0), atol=1e-4)
    assert set(knee["n"]) == {len(cycles)}
    assert set(frame["normal_matched"]) == {"speed"}  # the feet stand, so the speed is known
    assert 50 < float(np.max(np.asarray(knee["normal_mean_deg"]))) < 65
    assert len(frames.cycle_curves({"subject": "nobody"})) == 0


def test_the_command(walkers: Path, tmp_path: Path):
    built = pbl("norm", "build", "clinic", "--population", "healthy", "--source", "four walkers")
    assert built.code == 0, built.err
    assert "clinic-v1: registered" in built.out
    assert "WARN norm_people" in built.out
    assert "known already" in pbl("norm", "build", "clinic", "--source", "four walkers").out
    listed = pbl("norm", "list").out
    assert "clinic-v1" in listed
    assert "gillette-166-nine-angles-v1" in listed
    path = tmp_path / "clinic.json"
    assert "four walkers" in pbl("norm", "show", "clinic", "--out", path).out
    assert json.loads(path.read_text())["name"] == "clinic"
    assert pbl_pipeline.gait.load_norm(str(path)).sha256 == norms.load_norm("clinic").sha256
