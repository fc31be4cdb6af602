"""Forces and joint moments in the tables: what they are computed from, and what makes them pending again."""

from pathlib import Path

import pytest

import pbl_pipeline.fit
import pbl_pipeline.kinetics
from pbl_pipeline.errors import PblError
from pbl_pipeline.kinetics import MEASURES, METHODS, REASONS, TOO_UNCERTAIN, Kinetics
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.visit import Visit
from pbl_schemas import capture, gait, gdi, kinetics, load_visit, session
from pbl_schemas.intake import Methods, VisitRecord, ingest
from pbl_schemas.intake.records import set_condition
from pbl_schemas.method_rows import insert_methods
from pbl_schemas.reading import frames
from pbl_schemas.reading.status import pipeline_status
from pbl_schemas.reading.visit_progress import visit_progress
from pbl_schemas.reading.why import why
from pbl_schemas.rows import delete_below, utc_now
from pbl_schemas.studies import visit_forms
from pbl_schemas.studies.study_sheets import import_sheets
from pbl_workers.populate import Run, populate
from tests import Faults, StandIn, not_none
from tests.command import pbl
from tests.integration import chain, web
from tests.rows import register

VISIT = {"subject": "P001", "session_label": "2026-01-10"}


@pytest.fixture
def upright(tables: None, stand_in: StandIn) -> None:
    stand_in(fit_session=chain.fit_upright)


@pytest.fixture
def walk(upright: None, tmp_path: Path) -> Path:
    """The video of a computed visit, a person of 70 kg."""
    video = chain.small_video(tmp_path, "walk")
    register(video, session_label="2026-01-10", mass_kg=70.0)
    populate()
    return video


def done(run: Run) -> dict[str, int]:
    return {t.table: t.done for t in run.tables if t.done}


def found() -> Kinetics:
    return not_none(load_visit(VISIT).kinetics)


def correct(**values: str) -> tuple[str, ...]:
    changed, errors = visit_forms.correct_facts(1, values, "A. First", visit_forms.facts_form(1).seen)
    assert errors == {}
    return changed


def state_aid(folder: Path, aid: str) -> None:
    sheet = folder / "visits.csv"
    sheet.write_text(f"subject,visit,role,assistive_device\nP001,2026-01-10,baseline,{aid}\n")
    assert import_sheets([sheet]).done


def test_rows_say_what_forces_were_computed_from(walk: Path):
    row = kinetics.Kinetics.fetch1()
    assert (row["forces_status"], row["forces_code"], row["forces_reason"]) == ("PASS", "", "")
    assert (row["forces_mass"], row["forces_aid"]) == (70.0, "")
    assert row["kinetics_method"] == METHODS.find().key
    assert row["forces_method_hash"] == METHODS.find().hash
    assert row["session_id"] == 1
    assert 0 < row["forces_residual"] < 1
    measures = {r["force_measure"]: r for r in kinetics.Kinetics.Measure.to_dicts()}
    assert measures.keys() == set(MEASURES)
    impulse = measures["vertical_impulse_bw_s"]
    assert impulse["force_left"] < 2
    assert impulse["force_sd"] > 0
    power = measures["ankle_push_off_power_w_per_kg"]
    assert (power["force_mean"], power["force_n"]) == (None, 0)
    assert power["force_missing"] == TOO_UNCERTAIN
    # Every cycle has a row, with a column for each measure, and the visit's mean is that of its used ones.
    names = set(kinetics.Kinetics.Cycle.heading.names)
    assert set(MEASURES) == names - set(kinetics.Kinetics.Cycle.primary_key) - {"forces_missing"}
    of_cycles = (kinetics.Kinetics.Cycle * gait.GaitCycle.Cycle).to_dicts()
    assert len(of_cycles) == len(gait.GaitCycle.Cycle())
    used = [r["vertical_impulse_bw_s"] for r in of_cycles if r["cycle_used"] and r["cycle_side"] == "left"]
    known = [v for v in used if v is not None]
    assert known
    assert impulse["force_left"] == pytest.approx(sum(known) / len(known))
    checks = {r["forces_check"] for r in kinetics.Kinetics.Check.to_dicts()}
    assert checks == {"kinetics_residual", "kinetics_scale", "legs_seen_alike"}


def test_without_a_mass_forces_are_per_body_weight(upright: None, tmp_path: Path):
    video = chain.small_video(tmp_path, "walk")
    register(video, session_label="2026-01-10")
    populate()
    assert found().mass_kg is None
    before = found().measures
    assert before
    # Another statement of a known file adds the mass, as it does a height.
    again = pbl("ingest", video, "--subject", "P001", "--session", "2026-01-10", "--mass-kg", "68.5")
    assert again.code == 0, again
    assert "body mass of the visit is 68.5 kg now" in again.out
    assert done(populate()) == {"Kinetics": 1}
    assert (found().mass_kg, found().measures) == (68.5, before)


@pytest.mark.parametrize("mass", ["4", "0.07", "700", "nan"])
def test_a_mass_that_no_person_has_is_refused(tables: None, tmp_path: Path, mass: str):
    video = chain.small_video(tmp_path, "walk")
    assert pbl("ingest", video, "--subject", "P001", "--mass-kg", mass).error_code == "FIT_INPUT"
    assert len(session.Session()) == 0


def test_a_corrected_mass_makes_forces_pending_again(walk: Path):
    before, computed = found(), gdi.SessionGdi.fetch1("session_gdi_computed")
    assert correct(mass_kg="70.0") == ()
    assert len(kinetics.Kinetics()) == 1
    assert correct(mass_kg="82,5") == ("mass_kg",)
    assert len(kinetics.Kinetics()) == len(kinetics.Kinetics.Trial()) == 0
    visit = load_visit(VISIT)
    assert visit.kinetics is None
    assert visit.measures is not None
    assert done(populate()) == {"Kinetics": 1}
    assert (found().mass_kg, found().measures) == (82.5, before.measures)
    assert gdi.SessionGdi.fetch1("session_gdi_computed") == computed
    assert correct(mass_kg="") == ("mass_kg",)
    populate()
    assert found().mass_kg is None


def test_an_aid_refuses_forces_until_it_is_corrected(walk: Path, tmp_path: Path):
    state_aid(tmp_path, "cane")
    assert len(kinetics.Kinetics()) == 0
    assert done(populate()) == {"Kinetics": 1}
    assert kinetics.Kinetics.fetch1("forces_status", "forces_code", "forces_aid") == ("EMPTY", "AID", "cane")
    refused = found()
    assert (refused.code, refused.reason, dict(refused.measures)) == ("AID", REASONS["AID"], {})
    assert {t.reason for t in refused.trials} == {REASONS["AID"]}
    assert REASONS["AID"] in web.client().get("/visits/1").text
    exported = pbl("export", "--subject", "P001", "--to", "forces", "--out", tmp_path / "out")
    assert exported.error_code == "EXPORT_INPUT"
    steps = {s.table: s for s in why(1).steps}
    assert (steps["Kinetics"].what, steps["Kinetics"].note) == ("empty", REASONS["AID"])
    assert why(1).verdict == "everything is computed"
    # The same statement deletes nothing.
    state_aid(tmp_path, "cane")
    assert len(kinetics.Kinetics()) == 1
    assert correct(assistive_device="none") == ("assistive_device",)
    populate()
    assert found().measures


def test_an_aid_that_the_phone_states_counts_where_the_visit_states_none(walk: Path, tmp_path: Path):
    capture.PhoneLink.insert1(
        {
            "phone_link": 1,
            "session_id": 1,
            "link_key_sha256": "0" * 64,
            "link_by": "A. First",
            "link_created": utc_now(),
            "link_expires": utc_now(),
        }
    )
    capture.PhoneRecording.insert1(
        {
            "phone_recording": 1,
            "session_id": 1,
            "phone_link": 1,
            "video_id": 1,
            "phone_sha256": "0" * 64,
            "phone_video_size": 1,
            "phone_log_size": 0,
            "phone_about": {"aid": "walker"},
            "phone_state": capture.RECEIVED,
            "phone_created": utc_now(),
        }
    )
    delete_below(kinetics.Kinetics, kinetics.Kinetics.keys())
    populate()
    assert kinetics.Kinetics.fetch1("forces_code", "forces_aid") == ("AID", "walker")
    state_aid(tmp_path, "none")
    populate()
    assert kinetics.Kinetics.fetch1("forces_code", "forces_aid") == ("", "none")


def test_a_job_that_fails_leaves_the_rest_of_the_visit(upright: None, tmp_path: Path, faults: Faults):
    broken = PblError("FIT_INPUT", found="a broken motion", expected="another", next_step="fit again")
    faults(pbl_pipeline.kinetics, "visit_kinetics", broken)
    register(chain.small_video(tmp_path, "walk"), session_label="2026-01-10")
    run = populate()
    assert {t.table: dict(t.errors) for t in run.tables if t.errors} == {"Kinetics": {"FIT_INPUT": 1}}
    (row,) = pipeline_status().errors
    assert (row.table, row.code, row.next_step) == ("Kinetics", "FIT_INPUT", "fit again")
    visit = load_visit(VISIT)
    assert visit.kinetics is None
    assert not_none(visit.measures).gdi.mean is not None
    assert [f.table for f in visit_progress(1).failed] == ["Kinetics"]
    assert "a broken motion" in why(1).verdict
    page = web.client().get("/visits/1").text
    assert "Forces and joint moments: a broken motion" in page
    assert "<h2>Forces and joint moments</h2>" not in page
    assert done(populate(retry_errors=True)) == {"Kinetics": 1}
    assert found().measures


def test_corrected_and_deleted_cycles_take_their_forces_along(walk: Path):
    gone = delete_below(gait.GaitCycle, gait.GaitCycle.keys())
    assert gone["`pbl_kinetics`.`__kinetics`"] == 1
    assert done(populate())["Kinetics"] == 1


def test_forces_are_of_the_trials_that_the_index_pools(upright: None, tmp_path: Path):
    """The default index pools walks at the pace that the person chose, that of the paper all."""
    slow, fast = chain.small_video(tmp_path, "slow"), chain.small_video(tmp_path, "fast", n=210)
    register(slow, session_label="2026-01-10")
    register(fast, session_label="2026-01-10", pace="fast")
    for video in (slow, fast):
        ingest([video], VisitRecord("P001", "2026-01-10"), methods=Methods(gdi="paper-2025"))
    populate()
    n = {
        r["gdi_method"].split("-v")[0]: r["force_n"]
        for r in (kinetics.Kinetics.Measure & {"force_measure": "vertical_impulse_bw_s"}).to_dicts()
    }
    assert n.pop("paper-2025") > max(n.values()) > 0
    # A pace that is stated later pools another recording, and forces of it.
    (default,) = n
    delete = set_condition(2, pace="self_selected")
    assert any("kinetics" in text for text in delete), delete
    populate()
    own = not_none(load_visit({**VISIT, "gdi_method": default}).kinetics)
    assert own.measures["vertical_impulse_bw_s"].n > n[default]


def test_the_frame_of_forces_has_a_row_per_measure_with_its_interval(walk: Path):
    frame = frames.force_frame({"subject": "P001"}).set_index("force_measure")
    assert set(frame.index) == set(MEASURES)
    impulse, stored = frame.loc["vertical_impulse_bw_s"], found().measures["vertical_impulse_bw_s"]
    assert (impulse["force_low"], impulse["force_high"]) == pytest.approx(stored.interval)
    assert (impulse["subject"], impulse["kinetics_method"]) == ("P001", METHODS.find().key)
    power = frame.loc["ankle_push_off_power_w_per_kg"]
    assert power[["force_mean", "force_low", "force_high"]].isna().all()
    assert power["force_missing"] == TOO_UNCERTAIN
    assert len(frames.force_frame({"subject": "P002"})) == 0


def test_a_method_of_forces_is_chosen_at_ingest(upright: None, tmp_path: Path):
    video = chain.small_video(tmp_path, "walk")
    asked = ("ingest", video, "--subject", "P001", "--session", "2026-01-10", "--kinetics-method")
    assert pbl(*asked, "by-eye").error_code == "SOLVER_UNKNOWN"
    params = {"family": "newton-euler", **METHODS.find().paramset.params, "samples": 3}
    insert_methods(kinetics.KineticsMethod, [METHODS.of(Paramset("kinetics", "few", 1, params))])
    assert pbl(*asked, "few").code == 0
    assert kinetics.KineticsPlan.fetch1("kinetics_method") == "few-v1"


def test_visits_of_before_get_forces_on_request(upright: None, tmp_path: Path):
    register(chain.small_video(tmp_path, "walk"), session_label="2026-01-10")
    kinetics.KineticsPlan.delete(prompt=False)
    populate()
    assert len(kinetics.Kinetics()) == 0
    visit: Visit = load_visit(VISIT)
    assert visit.kinetics is None
    assert why(1).verdict == "everything is computed"
    asked = ("reprocess", "--table", "Kinetics", "--new-method", "newton-euler")
    assert "1 selections would be added" in pbl(*asked).out
    assert pbl(*asked, "--yes").code == 0
    populate()
    assert found().measures
    assert "nothing of Kinetics" in pbl(*asked).out


def test_the_page_of_a_visit_shows_forces_in_both_languages(walk: Path):
    browser = web.client()
    page = browser.get("/visits/1").text
    assert "Vertical force, peak of loading" in page
    assert "1 BW is 686 N." in page
    assert page.count("over the gait cycle, in BW") == 3
    about = browser.get("/visits/1.json").json()["forces"]["found"]
    impulse = found().measures["vertical_impulse_bw_s"]
    assert about["measures"]["vertical_impulse_bw_s"]["mean"] == pytest.approx(impulse.mean)
    german = browser.get("/visits/1", headers={"accept-language": "de"}).text
    assert "Vertikale Kraft, Spitze der Lastübernahme" in german.replace("\u00ad", "")
