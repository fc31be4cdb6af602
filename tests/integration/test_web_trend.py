"""All visits of a person in time, and the letter of a visit, in the review page."""

import itertools
import re
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import Difference
from pbl_schemas import fit, gait, gdi, session
from pbl_schemas.intake.records import set_condition
from pbl_schemas.reading import comparison, registered
from pbl_schemas.reading.trend import trend_of
from pbl_schemas.reading.visit_list import visits_of
from pbl_schemas.studies.visit_forms import enter_scores, scores_form
from pbl_workers.populate import populate
from tests import Environment, not_none
from tests.integration import web
from tests.integration.chain import small_video
from tests.rows import register

INDICES = {1: 80.0, 2: 85.0, 3: 95.0}


@pytest.fixture(scope="module")
def visits(module_tables: Path) -> None:
    """Visits 1 to 3 of P001 with indices of an sd of 3 and a minimal change of 6, 4 of P002, 5 and 6 of
    P003 who rises from a chair, at the second in two recordings, and 7 of P001 that is not computed."""
    days = (("P001", "2026-01-10"), ("P001", "2026-04-10"), ("P001", "2026-07-10"), ("P002", "2026-02-01"))
    for subject, day in days:
        register(small_video(module_tables, f"walk {day}"), subject=subject, session_label=day)
    chair = {"chair 1": "2026-01-20", "chair 2": "2026-05-20", "chair 3": "2026-05-20"}
    rising = [register(small_video(module_tables, n), subject="P003", session_label=d)[0] for n, d in chair.items()]
    for recording in rising:
        set_condition(recording, activity="sit_to_stand")
    populate()
    for recording, seconds in zip(rising, (14.0, 11.0, 10.0), strict=True):
        rows = gait.Spatiotemporal.Measure & {"video_id": recording, "measure": "five_rises_time_s"}
        gait.Spatiotemporal.Measure.update1(
            {**rows.keys()[0], "measure_mean": seconds, "measure_sd": 0.2, "measure_n": 5}
        )
    register(small_video(module_tables, "later"), session_label="2026-09-10")
    for number, index in INDICES.items():
        key = comparison.shown_visit(number).key
        row = {k: key[k] for k in gdi.SessionGdi.primary_key}
        gdi.SessionGdi.update1({**row, "session_gdi": index, "session_gdi_sd": 3.0, "session_gdi_minimal_change": 6.0})


def test_the_index_of_all_visits_with_what_is_more_than_chance(visits: None):
    found = trend_of(2)
    assert found == trend_of(1) == trend_of(7)
    assert (found.subject, [p.session_id for p in found.points]) == ("P001", [1, 2, 3])
    assert found.left_out == ("2026-09-10",)
    first, second, third = found.points
    assert [p.value for p in found.points] == list(INDICES.values())
    assert first.bounds == pytest.approx((80 - 1.645 * 3, 80 + 1.645 * 3), abs=0.01)
    assert (first.before, first.first) == (None, None)
    assert second.before is not None
    assert (second.before.by, second.before.sure) == (5.0, False)
    assert third.before is not None
    assert third.first is not None
    assert (third.before.by, third.before.sure, third.first.by, third.first.sure) == (10.0, True, 15.0, True)


def before(session_id: int, measure: str = "gdi") -> tuple[str, float] | None:
    """The visit before and the change since it in the list of changes, as the trend has it and, of the index, the list
    of visits."""
    of_person = {v.session_id: v for v in visits_of("P001")}
    rows = registered.changes({"subject": "P001"})
    rows = rows[(rows["visit"] == of_person[session_id].label) & (rows["measure"] == measure)]
    listed = next(zip(rows["before"], rows["change"], strict=True), None)
    (point,) = [p for p in trend_of(1, measure).points if p.session_id == session_id]
    assert (point.before and round(point.before.by, 3)) == (listed and listed[1])
    if measure == "gdi":
        trend = of_person[session_id].trend
        assert (trend and (of_person[trend.session_id].label, trend.change)) == listed
    return listed


def test_the_visit_before_is_one_everywhere(visits: None):
    def middle(**values: Any) -> None:
        gdi.SessionGdi.update1({k: key[k] for k in gdi.SessionGdi.primary_key} | values)

    key = comparison.shown_visit(2).key
    assert before(3) == ("2026-04-10", 10.0)
    assert before(1) is None
    one_set = {"fit_set": key["fit_set"]}
    try:  # the one in the middle was computed by another chain
        fit.FitSet.update1({**one_set, "fit_set_kind": fit.MARKERS})
        assert before(3) == ("2026-01-10", 15.0)
    finally:
        fit.FitSet.update1({**one_set, "fit_set_kind": fit.SINGLE})
    try:  # it has no index, and its other measures
        middle(session_gdi=None)
        assert before(3) == ("2026-01-10", 15.0)
        assert not_none(before(3, "stride_time_s"))[0] == "2026-04-10"
    finally:
        middle(session_gdi=INDICES[2])
    for number, day, order in ((2, "2026-07-10", (1, 2, 3)), (1, "2026-07-10", (2, 1, 3)), (3, None, (3, 1, 2))):
        was = (session.Session & {"session_id": number}).fetch1("session_date")
        try:  # of one day, in the order in which they were registered; without a day before all others
            session.Session.update1({"session_id": number, "session_date": day})
            labels = {v.session_id: v.label for v in visits_of("P001")}
            assert before(order[0]) is None
            for earlier, later in itertools.pairwise(order):
                assert before(later) == (labels[earlier], INDICES[later] - INDICES[earlier])
            assert "since None" not in web.client().get("/visits").text
        finally:
            session.Session.update1({"session_id": number, "session_date": was})


def test_a_measure_has_its_spread_and_no_verdict(visits: None):
    found = trend_of(1, "stride_time_s")
    about = not_none(comparison.shown_visit(2).measures["stride_time_s"][0])
    second = found.points[1]
    assert (second.value, second.bounds) == (about.mean, about.interval)
    assert (second.left, second.right) == (about.left, about.right)
    assert second.before is not None
    assert second.before.sure is None
    assert Difference("error") in second.before.differs
    for wrong, code in ((("nothing",), "USAGE"), ((), "DB_NOT_FOUND")):
        with pytest.raises(PblError, match=code):
            trend_of(1 if wrong else 99, *wrong)


def test_a_measure_whose_error_is_known_is_judged_as_in_compare(visits: None):
    sets = [{"fit_set": comparison.shown_visit(n).key["fit_set"]} for n in (1, 2)]
    keys = list((gdi.SessionGdi.Measure & sets & {"session_measure": "cadence_steps_per_min"}).keys())
    known = {"session_measure_error": 0.3, "session_measure_minimal_change": 0.5}
    try:
        for key in keys:
            gdi.SessionGdi.Measure.update1({**key, **known})
        second = trend_of(1, "cadence_steps_per_min").points[1]
        compared = comparison.compare([(1, None), (2, None)]).compared[1]
        assert second.before == compared.changes["cadence_steps_per_min"]
        assert second.before is not None
        assert (second.before.sure, second.before.least) == (abs(second.before.by) >= 0.5, 0.5)
    finally:
        for key in keys:
            gdi.SessionGdi.Measure.update1({**key, **dict.fromkeys(known)})


def test_times_of_a_task_are_compared_and_have_a_trend(visits: None):
    name = "sit_to_stand.five_rises_time_s"
    found = trend_of(5, name)
    assert [p.value for p in found.points] == [14.0, 10.5]  # of two recordings the mean
    change = not_none(found.points[1].before)
    assert (change.by, change.sure, change.differs) == (-3.5, None, (Difference("error"),))
    assert not any(m.startswith("tug") for m in found.measures)  # never done
    side = comparison.compare([(5, None), (6, None)]).compared[1]
    assert side.changes[name] == change
    browser = web.client()
    page = " ".join(browser.get("/compare?v=5&v=6").text.split())
    assert "Sit to stand: Time of five rises" in page
    assert '<span class="value">10.50</span>' in page
    assert page.count("interval: spread of the repetitions only") == 1
    page = browser.get(f"/visits/6/trend?measure={name}").text
    assert "14.00" in page
    assert "-3.50" in page.replace("\N{MINUS SIGN}", "-")
    assert "sit_to_stand" not in browser.get("/visits/1/trend").text


def test_the_page_of_the_trend(visits: None):
    browser = web.client()
    assert 'href="/visits/1/trend"' in browser.get("/visits/1").text
    assert "/trend" not in browser.get("/visits/4").text  # one visit is no trend
    page = browser.get("/visits/3/trend").text
    row = re.search(r'<tr class="here">.*?</tr>', page, re.DOTALL)
    assert row is not None, page[-3000:]
    assert "95.0" in row[0]
    assert "90\N{EN DASH}100" in row[0]
    assert "+10.0 <b>more than chance" in " ".join(row[0].split())
    assert page.count("<circle") == 3
    side = browser.get("/visits/3/trend?measure=step_time_s").text
    assert side.count("<circle") == 9  # left and right beside each
    assert "cannot be judged" in side
    assert browser.get("/visits/3/trend?measure=%3Cb%3E").status_code == 400
    assert browser.get("/visits/99/trend").status_code == 404
    told = browser.get("/visits/3/trend.json?measure=gdi").json()["found"]
    assert [p["value"] for p in told["points"]] == list(INDICES.values())
    assert told["points"][2]["before"]["sure"] is True


def test_every_page_with_an_index_says_once_of_whom_its_norm_is(visits: None):
    told = {
        "en": "with 166 typically developing children, an adult as well (there is no index of adults)",
        "de": "mit 166 Kindern ohne Auffälligkeiten, auch einen Erwachsenen (einen Index von Erwachsenen gibt es nicht",
    }
    browser = web.client()
    for page in ("/visits", "/visits/3", "/visits/3/letter", "/visits/3/trend", "/compare?v=1&v=3"):
        for language, children in told.items():
            shown = browser.get(page, headers={"accept-language": language}).text
            assert shown.count(children) == 1, (page, language)
    assert told["en"] not in browser.get("/visits/3/trend?measure=step_time_s").text


def test_the_letter_is_one_visit_on_a_page(visits: None):
    browser = web.client()
    page = " ".join(browser.get("/visits/3/letter?result=0").text.split())
    assert "Person: <b>P001</b>. Visit: <b>2026-07-10</b>" in page
    assert '<span class="big">95.0</span>' in page
    assert "+10.0 since 2026-04-10: more than chance" in page
    assert "Stride time" in page
    assert "Made on" in page
    assert "R. Viewer" in page
    assert page.count('<svg viewBox="0 0 280 200"') == 4
    assert "<form method" not in page.split("<main")[1]  # nothing to decide on paper
    assert "Clinical scores" not in page
    assert "no measures yet" in browser.get("/visits/7/letter").text


@pytest.mark.parametrize("language", ["en", "de"])
def test_the_letter_has_the_clinic_the_scores_a_comment_and_the_body(
    visits: None, language: str, environment: Environment
):
    environment(PBL_LETTER_HEAD="Clinic <North>; Station 1, 12345 Town")
    form = scores_form(2)
    enter_scores(2, form.values | {"role": "6_months", "mJOA": "14"}, "A", form.seen)
    browser = web.client()
    browser.headers["accept-language"] = language
    page = " ".join(browser.get("/visits/2/letter?result=0").text.split())
    assert '<p class="head">Clinic &lt;North&gt;<br>Station 1, 12345 Town</p>' in page
    assert page.count('<img src="data:image/jpeg;base64,') == 3  # the body of its recording, without the picture
    words = {
        "en": ("Letter for the record", "6 months", "mJOA 14", "Comment", "an adult as well"),
        "de": ("Messbericht für die Akte", "6 Monate", "mJOA 14", "Kommentar", "auch einen Erwachsenen"),
    }
    for word in words[language]:
        assert word in page, word
    assert not re.search("Befund|6_months|UTC", page)


def test_a_comment_is_printed_and_stays_on_the_page(visits: None, chromium: Any):
    with web.shown(chromium) as page:
        page.goto("/visits/3/letter?result=0")
        comment = page.get_by_role("textbox", name="Comment")
        page.emulate_media(media="print")
        assert not page.locator(".comment").is_visible()  # nothing was written
        page.emulate_media(media="screen")
        comment.fill("Walks with more confidence.")
        page.emulate_media(media="print")
        assert comment.is_visible()
        assert not page.locator(".print-hint").first.is_visible()
        assert page.evaluate("document.querySelector('.overview img').naturalWidth > 50")
        assert len(re.findall(rb"/Type\s*/Page\b", page.pdf(prefer_css_page_size=True))) == 1
