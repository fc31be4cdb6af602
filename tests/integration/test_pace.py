"""Activity and pace of a video decide which measures it is pooled in, and a person's height how long strides are; a
change computes anew what depends on it."""

from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import GDI_METHODS, TASK_MEASURES
from pbl_pipeline.paramset import Paramset
from pbl_schemas import fit, gait, gdi, load_visit, norms, session, video
from pbl_schemas.intake import Methods, VisitRecord, ingest
from pbl_schemas.intake.records import set_condition
from pbl_schemas.method_rows import insert_methods
from pbl_schemas.reading import frames
from pbl_schemas.reading.shown import shown_visit
from pbl_workers.populate import populate
from tests.command import pbl
from tests.rows import outcomes, register

from . import chain


def measured() -> dict[str, tuple[str, int]]:
    """Index -> status and used cycles of the visit."""
    rows = gdi.SessionGdi().to_dicts()
    return {r["gdi_method"]: (r["session_status"], int(r["session_cycles"])) for r in rows}


def test_only_walking_at_one_pace_is_pooled(tables: None, tmp_path: Path):
    slow, fast, tug = (chain.small_video(tmp_path, n, n=340 + i) for i, n in enumerate(("slow", "fast", "tug")))
    assert pbl("ingest", slow, "--subject", "P001").code == 0
    assert pbl("ingest", fast, "--subject", "P001", "--pace", "Fast").code == 0
    assert pbl("ingest", tug, "--subject", "P001", "--activity", "TUG").code == 0
    ids = {r["video_name"][:4]: int(r["video_id"]) for r in video.Video().to_dicts()}
    assert video.Pace().to_dicts() == [{"video_id": ids["fast"], "pace": "fast"}]
    at_fast = {"family": GDI_METHODS.find().name, **GDI_METHODS.find().paramset.params, "pace": "fast"}
    insert_methods(gdi.GdiModel, [GDI_METHODS.of(Paramset("gdi", "fast-walk", 1, at_fast))])
    try:
        assert outcomes(ingest([slow], VisitRecord("P001"), Methods(gdi="fast-walk"))) == ["updated"]
        populate()
        used = {r["video_id"]: int(r["n_cycles_used"]) for r in gait.GaitCycle().to_dicts()}
        plain = GDI_METHODS.find().key
        assert measured() == {plain: ("PASS", used[ids["slow"]]), "fast-walk-v1": ("PASS", used[ids["fast"]])}
        # Every trial has its own measures all the same.
        assert len(gait.Spatiotemporal & {"measures_status": "PASS"}) == 3
        assert len(gdi.GDI & {"gdi_status": "PASS"}) == 6
        shown = load_visit({"subject": "P001", "gdi_method": plain})
        assert shown.measures is not None
        assert [t.pooled for t in shown.measures.trials] == [True, False, False]
        assert shown.measures.gdi.n == shown.measures.gdi.n_left + shown.measures.gdi.n_right == used[ids["slow"]]
        curves = frames.cycle_curves({"gdi_method": plain})
        assert int(curves["n"].to_numpy().max()) <= used[ids["slow"]]
        # What is changed is computed anew, and nothing else is.
        events = gait.GaitEvents().to_arrays("events_computed", order_by="KEY")
        (result,) = ingest([fast], VisitRecord("P001", pace="self_selected"))
        assert "pace is self_selected now" in result.note
        assert not len(gdi.SessionGdi())
        populate()
        assert measured()[plain] == ("PASS", used[ids["slow"]] + used[ids["fast"]])
        assert measured()["fast-walk-v1"] == ("EMPTY", 0)
        assert "tug" in (gdi.SessionGdi & {"session_status": "EMPTY"}).fetch1("session_reason")
        np.testing.assert_array_equal(events, gait.GaitEvents().to_arrays("events_computed", order_by="KEY"))
    finally:
        (gdi.GdiModel & {"gdi_method": "fast-walk-v1"}).delete(prompt=False)


def test_a_change_that_pools_the_same_deletes_nothing(tables: None, tmp_path: Path):
    (number,) = register(chain.small_video(tmp_path, "walk"))
    populate()
    assert set_condition(number, pace="self selected") == ["pace is self_selected now"]
    assert set_condition(number, activity="overground walking") == ["activity is overground walking now"]
    assert set_condition(number, activity="overground walking", pace="self_selected") == []
    assert len(gdi.SessionGdi()) == 1
    with pytest.raises(PblError, match="DB_NOT_FOUND"):
        set_condition(number + 1, pace="fast")
    with pytest.raises(PblError, match="at the pace 'fast'"):
        norms.build_norm("fast-lab", populations=(), subjects=("P001",), pace="fast")


def test_a_stated_height_reaches_the_fit_and_a_corrected_one_fits_anew(tables: None, tmp_path: Path):
    walk, other = (chain.small_video(tmp_path, n, n=300 + i) for i, n in enumerate(("walk", "other")))
    assert pbl("ingest", walk, "--subject", "P001").code == 0
    assert pbl("ingest", other, "--subject", "P002", "--height-m", "1.8").code == 0
    populate()
    told = {r["subject"]: r["fit_height"] for r in (fit.SessionFit * session.Session).to_dicts()}
    assert told == {"P001": None, "P002": 1.8}
    assert {r.fit.height_m for r in load_visit({"subject": "P002"}).fitted if r.fit is not None} == {1.8}
    refused = pbl("ingest", walk, "--subject", "P001", "--height-m", "172")
    assert (refused.code, "body height of 172 m" in refused.err) == (1, True)
    done = pbl("ingest", walk, "--subject", "P001", "--height-m", "1.72")
    assert "height of P001 is 1.72 m now; what was fitted without it was deleted: " in done.out
    assert [r["subject"] for r in (fit.SessionFit * session.Session).to_dicts()] == ["P002"]
    populate()
    assert (fit.SessionFit * session.Session & {"subject": "P001"}).fetch1("fit_height") == 1.72
    again = pbl("ingest", walk, "--subject", "P001", "--height-m", "1.72")
    assert "nothing was inserted" in again.out
    assert len(fit.SessionFit()) == 2


PATTERN = r"(?P<subject>P\d+)_(?:(?P<pace>[a-z]+)_)?\d"


def _files(folder: Path, *names: str) -> list[Path]:
    """Files that ingest takes: it decodes nothing."""
    for name in names:
        (folder / name).write_text(name)
    return [folder / name for name in names]


def test_the_file_name_states_subject_and_pace(tables: None, tmp_path: Path):
    files = _files(tmp_path, "P001_fast_1.mp4", "P002_slow_1.mp4", "P001_fast_2.mp4", "P001_3.mp4", "holiday.mp4")
    done = pbl("ingest", *files, "--session", "2026-03-01", "--name-pattern", PATTERN)
    assert (done.code, done.error_code) == (1, "USAGE")
    assert "holiday" in done.err
    rows = (video.Video * session.Session.proj("subject", "session_label")).to_dicts(order_by="video_name")
    stated = {r["video_name"]: (r["subject"], r["session_label"]) for r in rows}
    day = "2026-03-01"
    assert stated == {f.name: (f.name[:4], day) for f in files[:4]}
    paces = (video.Video.proj("video_name") * video.Pace).to_dicts()
    expected = {"P001_fast_1.mp4": "fast", "P001_fast_2.mp4": "fast", "P002_slow_1.mp4": "slow"}
    assert {r["video_name"]: r["pace"] for r in paces} == expected
    assert len(session.Session()) == 2


def test_session_and_activity_from_the_name(tables: None, tmp_path: Path):
    (file,) = _files(tmp_path, "2026-03-01 tug.mp4")
    assert pbl("ingest", file, "--subject", "P001", "--name-pattern", "(?P<session>.*) (?P<activity>.*)").code == 0
    (row,) = (video.Video * session.Session.proj("session_label")).to_dicts()
    assert (row["session_label"], row["activity"]) == ("2026-03-01", "tug")


@pytest.mark.parametrize(
    ("more", "code", "said"),
    [
        (["--name-pattern", "(?P<subject>.*"], 1, "missing )"),
        (["--name-pattern", ".*"], 1, "without named groups"),
        (["--name-pattern", "(?P<name>.*)"], 1, "with the groups name"),
        (["--name-pattern", "(?P<subject>.*)", "--subject", "P001"], 2, "state the same"),
        (["--name-pattern", "(?P<pace>.*)"], 2, "--subject"),
        ([], 2, "--subject"),
    ],
)
def test_a_pattern_that_cannot_be_read(tables: None, tmp_path: Path, more: list[str], code: int, said: str):
    done = pbl("ingest", *_files(tmp_path, "P001.mp4"), *more)
    assert done.code == code
    assert said in done.err
    assert not len(video.Video())


def test_a_task_has_its_measures_as_rows_and_a_changed_activity_computes_them_anew(tables: None, tmp_path: Path):
    path = chain.small_video(tmp_path, "chair")
    assert pbl("ingest", path, "--subject", "P001", "--activity", "Sit-to-stand").code == 0
    populate()
    number = int(video.Video().fetch1("video_id"))
    rows = {r["measure"]: r for r in gait.Spatiotemporal.Measure().to_dicts()}
    # The person of this video walks: the rises are counted, and there are none.
    assert rows["rise_count"]["measure_mean"] == 0.0
    assert rows["five_rises_time_s"]["measure_mean"] is None
    assert rows["five_rises_time_s"]["measure_missing"] == "five rises are needed, 0 were found"
    shown = load_visit({"subject": "P001"})
    assert shown.measures is not None
    assert list(shown.measures.trials[0].spatiotemporal.of_task) == list(TASK_MEASURES["sit_to_stand"])
    (of_task,) = shown_visit(int(session.Session().fetch1("session_id"))).tasks.values()
    assert list(of_task) == list(TASK_MEASURES["sit_to_stand"])
    changes = set_condition(number, activity="squat")
    assert any(change.startswith("measures of the task were deleted: ") for change in changes)
    assert not len(gait.Spatiotemporal())
    populate()
    names = set(gait.Spatiotemporal.Measure().to_arrays("measure"))
    assert set(TASK_MEASURES["squat"]) <= names
    assert "rise_count" not in names
