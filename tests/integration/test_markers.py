"""Laboratory markers as recordings of a visit: beside the phone's video, never pooled with it."""

from pathlib import Path

import numpy as np
import pytest

import pbl_pipeline.body
import pbl_pipeline.fit
from pbl_pipeline.body import marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS
from pbl_pipeline.keypoints import WorldMarkers
from pbl_pipeline.synthetic import plain_walk
from pbl_schemas import fit, gait, gdi, load_visit, norms, video
from pbl_schemas.intake import LaboratoryMarkers, Registered, VisitRecord, ingest, register
from pbl_schemas.operations.forget import forget
from pbl_schemas.reading import frames
from pbl_schemas.reading.why import why
from pbl_schemas.studies import slices
from pbl_schemas.studies.study_sheets import import_sheets
from pbl_workers.populate import populate
from research.walker.views import observe_markers
from tests import StandIn
from tests.command import pbl
from tests.inputs import ROWS, trc_text
from tests.rows import outcomes
from tests.walking_fit import CYCLE_S

from . import chain

SHIPPED = Path(pbl_pipeline.body.__file__).parent / "data" / "markers_mpi_inf_3dhp_17.csv"


#: Keys of the methods of the fit that the two get where nobody names one.
PHONE, LAB = METHODS.find().key, METHODS.find("markers").key


def recording(path: Path, seconds: float = 8.0, marker_set: str = "bml_movi_87") -> Path:
    """The walk of the stand-in's fit of a video, as markers without noise."""
    time = np.arange(0, seconds, 1 / 30)
    walk = plain_walk(time, stride_s=CYCLE_S, speed_m_per_s=1.2, start_m=(6.0, -2.2), camera_height_m=0)
    observe_markers(walk, time, marker_set=marker_set, noise_m=0.0, drop_share=0.0).save(path)
    return path


def ingest_markers(path: Path, visit: VisitRecord, table: Path | None = None) -> Registered:
    """The outcome for one file."""
    (result,) = register([LaboratoryMarkers(path, visit, None if table is None else str(table))])
    return result


@pytest.fixture
def fitted(tables: None, stand_in: StandIn) -> None:
    stand_in(fit_session=chain.fit_either)


@pytest.mark.long
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
    found = {r["fit_method"]: r for r in frames.session_summary().to_dict("records")}
    assert set(found) == {PHONE, LAB}
    assert len(gdi.SessionGdi()) == 2
    used = {int(r["video_id"]): int(r["n_cycles_used"]) for r in gait.GaitCycle().to_dicts()}
    assert found[PHONE]["session_cycles"] == used[ids["static"]] > 0
    assert found[LAB]["session_cycles"] == used[ids["none"]] > 0
    # The stand-in gives the video's movement exactly, so what differs is the error of the fit of the markers, and what
    # the index takes back for the error that such a fit states, most where it is as high as here.
    phone, laboratory = (found[m]["session_gdi"] for m in (PHONE, LAB))
    assert laboratory == pytest.approx(phone, abs=1.5)
    assert found[LAB]["session_cadence"] == pytest.approx(120 / CYCLE_S, rel=0.01)
    row = (fit.SessionFit.Trial & {"video_id": ids["none"]}).fetch1()
    assert row["trial_residual_3d"] < 0.5
    assert row["trial_residual_2d"] is None
    # As docs/study.md says it.
    current = gdi.SessionGdi & (fit.FitSelection & {"fit_current": True})
    for kind, index in (("markers", laboratory), ("single", phone)):
        assert (current & (fit.FitSet & {"fit_set_kind": kind})).to_arrays("session_gdi").tolist() == [index]
    # What was computed is not planned again; the phone's report is of the phone; that of the markers has no pictures.
    populate()
    assert len(fit.SessionFit()) == 2
    shown = load_visit({"subject": "P001", "fit_method": PHONE})
    assert [r.name for r in shown.recordings] == ["walk"]
    assert len(shown.fitted) == 1
    of_lab = load_visit({"subject": "P001", "fit_method": LAB})
    assert [(r.name, r.fitted, r.keypoints, r.video) for r in of_lab.recordings] == [("lab", True, None, None)]
    assert why(ids["none"]).verdict == "everything is computed"
    report = pbl("report", "--subject", "P001", "--fit-method", LAB, "--out", tmp_path / "out")
    assert report.code == 0, report.err
    assert not (tmp_path / "out" / "lab.overlay.mp4").exists()
    assert "Recording lab" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    with pytest.raises(PblError, match="laboratory markers"):
        norms.build_norm("both", populations=(), subjects=("P001",))
    # A study is of the one chain or of the other.
    sheet = tmp_path / "visits.csv"
    sheet.write_text("subject,visit,date,role\nP001,2026-03-01,2026-03-01,baseline\n")
    assert import_sheets([sheet]).done
    with pytest.raises(PblError, match="laboratory markers"):
        slices.freeze("both")
    for name, method, index in (("phone", PHONE, phone), ("lab", LAB, laboratory)):
        assert slices.freeze(name, methods={"fit_method": method}).n_included == 1
        data = slices.study_data(name)
        assert data.visits["gdi"].tolist() == [index]
        assert ("keypoint_method" in data.description.methods) == (name == "phone")
        assert slices.changes(name) == []


def test_recordings_of_a_table_of_ones_own(tables: None, tmp_path: Path, stand_in: StandIn):
    seen: list[tuple] = []

    def fit_markers(trials, names, paramset=None, camera_motion="static", markers=None):
        assert markers is not None
        seen.append((names, {type(t) for t in trials}, markers.name, markers.names))
        return chain.fit_session(trials, names, paramset)

    stand_in(fit_session=fit_markers)
    table = tmp_path / "our_lab.csv"
    table.write_text(SHIPPED.read_text())
    names = marker_set("mpi_inf_3dhp_17").names
    first, second, third = (recording(tmp_path / f"w{i}.npz", 8 + i, "mpi_inf_3dhp_17") for i in range(3))
    given = ("--subject", "P002", "--marker-set", table)
    assert pbl("ingest", "--markers", first, "--markers", second, *given).code == 0
    table.unlink()  # the store has its own
    populate()
    assert seen == [(["w0", "w1"], {WorldMarkers}, "our_lab", names)]
    # The same bytes again: nothing new; another pace and index: added.
    table.write_text(SHIPPED.read_text())
    again = ingest_markers(first, VisitRecord("P002"), table)
    assert (again.status, again.note.split("; ")[-1]) == ("known", "nothing was inserted")
    third_row = ingest_markers(third, VisitRecord("P002"), table)
    populate()
    assert [len(s[0]) for s in seen] == [2, 3]
    current = fit.FitSelection & {"fit_current": True}
    assert len(fit.FitSet.Video & current) == 3
    assert len(gdi.SessionGdi & current.proj()) == 1
    fast = ingest_markers(third, VisitRecord("P002", pace="fast"), table)
    assert (fast.status, fast.video_id) == ("updated", third_row.video_id)
    assert "what pooled it was deleted" in fast.note
    # Another set in the same session, and other uses of the same bytes, are refused.
    visit = VisitRecord("P002")
    with_other = ingest_markers(recording(tmp_path / "other.npz", 12), visit)
    assert outcomes([with_other, ingest_markers(first, visit), *ingest([first], visit)]) == ["USAGE"] * 3
    assert len(video.Video()) == 3
    rows = video.MarkerRecording().to_dicts()
    files = {r[column].path for r in rows for column in ("markers_file", "marker_table_file")}
    forgotten = forget("P002")
    assert forgotten.left == []
    assert len(files) == 6
    assert files <= set(forgotten.files)
    assert len(video.MarkerRecording()) == 0


def test_bad_files_are_refused(tables: None, tmp_path: Path):
    def code(text: str | bytes | None, *more: str, name: str = "walk.trc") -> str:
        path = tmp_path / name
        path.unlink(missing_ok=True)
        if text is not None:
            path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return pbl("ingest", "--subject", "P001", "--markers", path, *more).error_code

    shipped = ("--marker-set", "blazepose_33")
    assert code(None, *shipped) == "FILE_MISSING"
    assert code("", *shipped) == "FILE_FORMAT"
    assert code("no header", *shipped) == "FILE_FORMAT"
    assert code(trc_text(ROWS)) == "USAGE"  # nobody says where the markers sit
    assert code(trc_text(ROWS), *shipped) == "MARKER_SET_UNKNOWN"  # none of its names
    assert code(trc_text(ROWS, names="nose\t\t\tleft_hip\t\t"), *shipped) == "FIT_INPUT"  # two of 33, for 20 ms
    assert code(b"PK", name="walk.npz") == "FILE_FORMAT"
    assert code(trc_text(ROWS), "--marker-set", "no_such_set") == "MARKER_SET_UNKNOWN"
    assert code(trc_text(ROWS), *shipped, "--camera-motion", "handheld") == "USAGE"
    assert code(trc_text(ROWS), *shipped, "--keypoint-method", "blazepose-33") == "USAGE"
    assert pbl("ingest", "--subject", "P001").code == 2
    assert pbl("ingest", "--subject", "P001", tmp_path / "a.mp4", "--markers", tmp_path / "b.trc").code == 2
    assert len(video.Video()) == 0
