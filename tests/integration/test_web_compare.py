"""Comparing in the review page: curves, measures, changes; what is no comparison; videos in step in a browser."""

import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.filming import Difference
from pbl_pipeline.gait import IMPORTANT_CHANGE, MEASURES_REMAIN, chances, change_sd
from pbl_schemas import fit, gait, gdi, keypoints, qc, study, video
from pbl_schemas.reading import comparison, frames, registered
from pbl_schemas.rows import delete_below
from pbl_workers.populate import populate
from pbl_workers.web.compare import charts_of, without
from tests import Faults, not_none, until
from tests.integration import chain, web
from tests.integration.chain import small_video
from tests.rows import copies, register, remove_copy

#: What the legs' angles of the second visit are of those of the first.
LESS = 0.8


@pytest.fixture(scope="module")
def visits(module_tables: Path, module_patch: pytest.MonkeyPatch) -> None:
    """Visits 1 and 2 of P001, the second with smaller angles, 3 of P002, and 4 of P001 without a result."""

    def smaller(trials: Any, names: Any, *args: Any, **more: Any):
        found = chain.fit_session(trials, names, *args, **more)
        by = LESS if "2026-04-10" in names[0] else 1.0
        fits = (dataclasses.replace(t, qpos=np.hstack([t.qpos[:, :6], by * t.qpos[:, 6:]])) for t in found.trials)
        return dataclasses.replace(found, trials=tuple(fits))

    chain.replace(module_patch, fit_session=smaller)
    for subject, day in (("P001", "2026-01-10"), ("P001", "2026-04-10"), ("P002", "2026-02-01")):
        register(small_video(module_tables, f"walk {day}"), subject=subject, session_label=day)
    populate()
    register(small_video(module_tables, "later"), session_label="2026-09-10")
    for number, index in ((1, 80.0), (2, 86.0), (3, 95.0)):
        key = comparison.shown_visit(number).key
        row = {k: key[k] for k in gdi.SessionGdi.primary_key}
        values = {"session_gdi": index, "session_gdi_sd": 3.0, "session_gdi_minimal_change": 5.0 + number}
        gdi.SessionGdi.update1({**row, **values})
    study.ClinicalScore.insert(
        {"session_id": i, "instrument": n, "score_value": v}
        for i, n, v in ((1, "mJOA", 12), (2, "mJOA", 15), (1, "BBS", 44), (2, "mJOA-LE", 4))
    )


def test_changes_against_the_reference(visits: None):
    found = comparison.compare([(2, None), (1, None), (4, None)])
    assert [c.about.row.session_id for c in found.compared] == [1, 2, 4]  # by day
    first, second, without = found.compared
    assert (first.change, first.changes) == (None, {})
    assert second.change is not None
    assert (second.change.by, second.change.sure) == (6.0, False)  # the larger of 6 and 7 is not reached
    sd = change_sd((6.0, 7.0), (3.0, 3.0))
    assert (second.change.real, second.change.important) == chances(6.0, sd, IMPORTANT_CHANGE)
    knee = lambda c: c.curves[(c.curves["angle"] == "knee_flexion") & (c.curves["side"] == "left")]["mean_deg"]  # noqa: E731
    np.testing.assert_allclose(knee(second), LESS * knee(first), atol=0.7)
    name = "stride_time_s"
    values = [c.about.measures[name][0] for c in (first, second)]
    assert second.changes[name].by == not_none(values[1]).mean - not_none(values[0]).mean
    assert second.changes[name].sure is None  # no figure says what is more than chance
    assert (second.scores["mJOA"].change, second.scores["mJOA"].important) == (3.0, True)  # its minimal change is 2
    assert second.scores["mJOA-LE"].change is None  # the reference has none
    assert (without.about.result, without.cycles, without.change) == (None, (), None)
    assert len(without.curves) == 0
    turned = comparison.compare([(1, None), (2, None)], (2, None))
    assert turned.reference == 1
    assert not_none(turned.compared[0].change).by == -6.0
    gdi.SessionGdi.update1({k: first.about.key[k] for k in gdi.SessionGdi.primary_key} | {"session_gdi": 79.0})
    again = not_none(comparison.compare([(1, None), (2, None)]).compared[1].change)
    assert (again.by, again.sure) == (7.0, True)
    gdi.SessionGdi.update1({k: first.about.key[k] for k in gdi.SessionGdi.primary_key} | {"session_gdi": 80.0})


@pytest.mark.parametrize(("before", "after", "important"), [(10, 12, False), (12, 14, True), (15, 16, True)])
def test_the_important_change_of_mjoa_depends_on_the_score_before(visits: None, before, after, important):
    (instrument,) = (study.ClinicalInstrument & {"instrument": "mJOA"}).to_dicts()
    assert comparison._score(after, before, instrument) == comparison.Score(after, after - before, important)


def test_results_in_doubt_are_not_judged(visits: None):
    one, other = comparison.shown_visit(1).results[0], comparison.shown_visit(2).results[0]
    said = chances(6.0, change_sd((7.0, 6.0), (3.0, 3.0)), IMPORTANT_CHANGE)
    assert comparison.change_since(other, one) == comparison.Change(6.0, False, 7.0, (), *said)
    doubtful = comparison.Change(6.0, None, differs=(Difference("checks"),))
    for doubt in ({"outcome": "FAIL"}, {"worst": ("legs_seen_alike", "cadence_plausible")}):
        assert comparison.change_since(dataclasses.replace(other, **doubt), one) == doubtful
        assert comparison.change_since(other, dataclasses.replace(one, **doubt)) == doubtful
    unknown = comparison.Change(6.0, None, differs=(Difference("error"),))
    assert comparison.change_since(dataclasses.replace(other, minimal_change=None), one) == unknown
    assert comparison.change_since(dataclasses.replace(other, index=None), one) is None


@pytest.fixture
def from_other_sides(visits: None) -> Iterator[None]:
    """The first visit seen from the left, the second from the right."""
    rows = {n: (gait.GaitCycle.Cycle & comparison.shown_visit(n).key).keys() for n in (1, 2)}
    for number, far in ((1, "right"), (2, "left")):
        for row in rows[number]:
            gait.GaitCycle.Cycle.update1({**row, "cycle_far_leg": far})
    yield
    for row in rows[1] + rows[2]:
        gait.GaitCycle.Cycle.update1({**row, "cycle_far_leg": None})


def test_visits_filmed_from_other_sides(from_other_sides: None):
    found = comparison.compare([(1, None), (2, None)])
    change = not_none(found.compared[1].change)
    assert change.least == pytest.approx(1.645 * np.hypot(3, 3), abs=0.01)
    assert change.differs == (Difference("view", ("right",), ("left",)),)
    assert change.sure is False
    assert [c.far_leg for c in found.compared] == ["right", "left"]
    knee = next(c for c in charts_of(found, ["a", "b"]) if c.title == "Knee flexion")
    assert knee.far == {"left": [1], "right": [0]}
    lines = [
        [float(o) for o in re.findall(r'<g fill="none"[^>]*opacity="([\d.]+)"', str(knee.sides[s]))] for s in knee.sides
    ]
    assert lines == [[1.0, 0.4], [0.4, 1.0]]
    page = web.client().get("/compare?v=1&v=2").text
    assert "filmed from other sides (right, before: left)" in page
    assert "compare neither a side nor its curves" in page
    assert page.count("2026-01-10 faint: this leg was behind the other") == 9  # under each curve, in print as well
    assert "more than chance</b>" not in page
    german = web.client().get("/compare?v=1&v=2", headers={"accept-language": "de"}).text
    assert "von anderen Seiten gefilmt (rechts, zuvor: links)" in german


def test_a_visit_with_an_aid_is_not_judged(visits: None):
    study.Visit.insert1({"session_id": 2, "visit_role": "3_months", "assistive_device": "Cane & <b>"})
    try:
        change = not_none(comparison.compare([(1, None), (2, None)]).compared[1].change)
        assert (change.sure, [d.what for d in change.differs]) == (None, ["aid"])
        page = web.client().get("/compare?v=1&v=2").text
        assert page.count("other walking aid (cane &amp; &lt;b&gt;, before: not stated)") == 1  # not in each row
        assert "+6.0: cannot be judged</span>" in page
        assert "can change the values as much as the person did" in page
        visit = web.client().get("/visits/2").text
        assert "+6.0 since 2026-01-10: cannot be judged: other walking aid" in visit
        german = web.client().get("/compare?v=1&v=2", headers={"accept-language": "de"}).text
        assert german.count("2026-04-10: andere Gehhilfe (cane") == german.count("andere Gehhilfe") == 1
    finally:
        (study.Visit & {"session_id": 2}).delete(prompt=False)


def test_a_clip_without_a_cycle_that_counts_changes_nothing(visits: None):
    """It has another size of picture, another pace, and fails a check; its visit stays comparable and is not failed."""
    before = comparison.compare([(1, None), (2, None)]).compared[1]
    own = {k: before.about.key[k] for k in gait.GaitEvents.primary_key if k != "video_id"}
    (good,) = (int(v) for v in (fit.FitSet.Video & own).to_arrays("video_id"))
    copies(good, 1, 700)
    number = good + 701
    server, clip, points = gait.GaitCycle.connection, {"video_id": number}, keypoints.Keypoints.Check
    try:
        for table, change in (
            (gait.GaitCycle.Cycle, "cycle_used = 0"),
            (gait.GaitCycle, "n_cycles_used = 0"),
            (video.VideoInfo, "width = 640, height = 360"),
            (keypoints.Keypoints, "camera_kind = 'file'"),
            (points, "keypoints_check_outcome = 'FAIL'"),
        ):
            server.query(f"UPDATE {table.full_table_name} SET {change} WHERE video_id = {number}")
        video.Pace.insert1({**clip, "pace": "fast"}, replace=True)
        assert len(points & clip & "keypoints_check_outcome = 'FAIL'") > 0
        delete_below(qc.SessionQc(), (qc.SessionQc & own).keys())
        qc.SessionQc.populate(own)
        after = comparison.compare([(1, None), (2, None)]).compared[1]
        assert (after.differs, after.change) == (before.differs, before.change)
        assert not_none(after.about.result).filming == not_none(before.about.result).filming
        assert not_none(after.about.result).outcome == "WARN"
        server.query(f"UPDATE {gait.GaitCycle.full_table_name} SET n_cycles_used = 1 WHERE video_id = {number}")
        delete_below(qc.SessionQc(), (qc.SessionQc & own).keys())
        qc.SessionQc.populate(own)
        assert not_none(comparison.shown_visit(2).result).outcome == "FAIL"  # of one that counts
    finally:
        remove_copy(number)
        delete_below(qc.SessionQc(), (qc.SessionQc & own).keys())
        qc.SessionQc.populate(own)


def test_a_visit_with_a_stated_height_is_not_judged(visits: None):
    key = {k: comparison.shown_visit(2).key[k] for k in fit.SessionFit.primary_key}
    before = (fit.SessionFit & key).fetch1("fit_height")
    fit.SessionFit.update1({**key, "fit_height": 1.7})
    try:
        change = not_none(comparison.compare([(1, None), (2, None)]).compared[1].change)
        assert (change.sure, change.differs) == (None, (Difference("height", ("stated",), ("not_stated",)),))
    finally:
        fit.SessionFit.update1({**key, "fit_height": before})


def test_measures_say_that_their_interval_is_the_spread_of_cycles(visits: None):
    page = web.client().get("/compare?v=1&v=2").text
    found = comparison.compare([(1, None), (2, None)]).compared[1]
    n = sum(m is not None for m, _ in found.about.measures.values())
    assert (page.count("interval: spread of the cycles only"), n > 10) == (1, True)  # of all rows
    assert page.count(": cannot be judged</span>") == len(found.changes) > 0


def test_measures_that_no_visit_has_are_named_once_by_their_reason():
    def side(**measures: tuple[object, str]) -> SimpleNamespace:
        return SimpleNamespace(about=SimpleNamespace(all_measures=measures))

    task, known = "no trial of walking", (1.0, "")
    found = SimpleNamespace(
        compared=[
            side(cadence_steps_per_min=(None, task), step_time_s=(None, task), stance_percent=known),
            side(cadence_steps_per_min=(None, task), step_time_s=(None, "one step"), stance_percent=(None, task)),
        ]
    )
    assert without(found) == {(task,): ["cadence_steps_per_min"], (task, "one step"): ["step_time_s"]}  # pyright: ignore[reportArgumentType]


def test_measures_with_an_error_have_a_probability_in_page_json_and_list(visits: None):
    rows = gdi.SessionGdi.Measure & {"session_measure": "cadence_steps_per_min"}
    keys = [k for k in rows.keys() if k["fit_set"] in {comparison.shown_visit(n).key["fit_set"] for n in (1, 2)}]  # noqa: SIM118
    known = {"session_measure_error": 0.3, "session_measure_minimal_change": 0.5}
    for key in keys:
        gdi.SessionGdi.Measure.update1({**key, **known})
    try:
        found = comparison.compare([(1, None), (2, None)]).compared[1]
        change = found.changes["cadence_steps_per_min"]
        sd = change_sd((0.5, 0.5), (0.3, 0.3), MEASURES_REMAIN)
        assert change.real == chances(change.by, sd).real
        assert (change.important, change.least) == (None, 0.5)
        index = not_none(found.change)
        page = web.client().get("/compare?v=1&v=2").text
        assert "probability of a true rise: " in page
        assert "by at least 5: " in page
        data = web.client().get("/compare.json?v=1&v=2").json()
        assert data["found"]["compared"][1]["change"]["real"] == pytest.approx(index.real)
        listed: Any = registered.changes({"subject": "P001"}).set_index("measure")
        assert listed.loc["gdi", "real"] == pytest.approx(index.real, abs=5e-4)
        assert listed.loc["gdi", "important"] == pytest.approx(not_none(index.important), abs=5e-4)
        assert listed.loc["cadence_steps_per_min", "least"] == 0.5
        assert listed.loc["stance_percent", "not_comparable"] == "error"
        assert registered.changes({"subject": "P002"}).empty  # one visit
        assert registered.changes(True, 2).equals(registered.changes().head(2))
    finally:
        for key in keys:
            gdi.SessionGdi.Measure.update1({**key, **dict.fromkeys(known)})


def test_the_interval_of_a_measure_is_students():
    from scipy import stats

    from pbl_pipeline.gait import Measure

    values = np.array([1.0, 1.1, 1.3, 0.9])
    plain = Measure(None, None, float(values.mean()), float(values.std(ddof=1)), 4)
    expected = stats.t.interval(0.9, 3, loc=values.mean(), scale=stats.sem(values))
    assert plain.interval == pytest.approx(expected)
    sided = dataclasses.replace(plain, variability=0.05)
    assert sided.interval == pytest.approx(stats.t.interval(0.9, 2, loc=values.mean(), scale=0.05 / 2))
    assert dataclasses.replace(plain, sd=None).interval is None
    assert dataclasses.replace(plain, n=1).interval is None


def test_the_page_has_curves_measures_and_videos_without_scripts(visits: None):
    browser = web.client()
    page = browser.get("/compare?v=1&v=2").text
    assert "Changes are against 2026-01-10" in page
    assert "+6.0: may be chance" in page
    assert "+3: at least the minimal important change" in page
    assert page.count('role="img"') == 18  # nine angles of two legs
    videos = re.findall(r'<video src="(/recordings/\d+/video)#t=([\d.]+),([\d.]+)"', page)
    assert len(videos) == 2
    assert all(float(a) < float(b) for _, a, b in videos)
    assert not re.search(r"<style|\sstyle=|<script(?![^>]*\ssrc=)", page)
    turned = browser.get("/compare?v=1&v=2&ref=2.0").text
    assert "Changes are against 2026-01-10" in turned  # "2.0" was not asked for
    assert "Changes are against 2026-04-10" in browser.get("/compare?v=1.0&v=2.0&ref=2.0").text
    assert "different people" in browser.get("/compare?v=1&v=3").text
    assert "This visit has no measures yet" in browser.get("/compare?v=1&v=4").text
    assert 'name="v" value="2" form="compare"' in browser.get("/visits/1").text
    assert "P001" not in "".join(re.findall(r'(?:href|src|action)="([^"]*)"', page))


def test_a_video_that_is_gone_leaves_the_rest(visits: None, faults: Faults):
    from pbl_workers.web.source import Videos

    gone = PblError("VIDEO_MISSING", found="no file", expected="a video", next_step="bring it back")
    faults(Videos, "path", *[gone] * 9)
    page = web.client().get("/compare?v=1&v=2").text
    assert "VIDEO_MISSING" in page
    assert "<video" not in page
    assert 'role="img"' in page


@pytest.mark.parametrize(
    ("asked", "status"),
    [
        ("", 400),
        ("v=1", 400),
        ("v=1&v=1", 400),
        ("&".join(f"v={i}" for i in range(1, 8)), 400),
        ("v=1&v=999", 404),
        ("v=1&v=2.7", 404),
        ("v=1&v=99999999999", 404),
        ("v=1&v=-2", 404),
        ("v=1&v=2'--", 404),
        ("v=1&v=%3Cscript%3E", 404),
        ("v=1&v=2&ref=%3Cscript%3E", 200),
    ],
)
def test_what_cannot_be_compared(visits: None, asked: str, status: int):
    answer = web.client().get(f"/compare?{asked}")
    assert answer.status_code == status, answer.text
    assert "<script>" not in answer.text


def test_curves_that_are_drawn_are_those_of_the_tables(visits: None):
    found = comparison.compare([(1, None), (2, None)])
    frame = frames.cycle_curves({"session_id": 1})
    drawn = charts_of(found, ["a", "b"])
    knee = next(c for c in drawn if c.title == "Knee flexion")
    own = frame[(frame["angle"] == "knee_flexion") & (frame["side"] == "left")]["mean_deg"]
    assert f"a {own.min():.0f} to {own.max():.0f}\N{DEGREE SIGN}" in knee.sides["left"].replace("\N{MINUS SIGN}", "-")
    assert knee.sides["left"].count("<polyline") == 2
    assert knee.sides["left"].count("fill-opacity") == 2  # a band each


def test_videos_in_step_in_a_browser(visits: None, chromium: Any):
    with web.shown(chromium) as page:
        page.get_by_role("link", name="2026-01-10").first.click()
        page.get_by_label("Compare this visit: 2026-04-10").check()
        page.get_by_role("button", name="Compare the ticked visits").click()
        page.wait_for_selector(".together[data-ready]")
        assert page.url.endswith("/compare?v=2&v=1")
        # Two cycles of other lengths.
        page.locator("select.cycle").nth(1).select_option(index=0)
        lengths = page.evaluate("[...document.querySelectorAll('video')].map((v) => +v.dataset.end - +v.dataset.start)")
        assert min(lengths) > 0.5
        page.locator("#phase").fill("37")
        off = """() => [...document.querySelectorAll(".videos figure")].map((f) => {
          const v = f.querySelector("video"), c = f.querySelector("select").selectedOptions[0].dataset;
          const phase = +document.querySelector(".together").dataset.phase;
          return v.seeking ? 9 : (v.currentTime - +c.start) / (+c.end - +c.start) - phase; })"""
        until(lambda: page.evaluate(f"({off})().every((d) => Math.abs(d) < 0.002)"))
        assert page.locator("#phase-now").inner_text() == "37 %"
        line = page.locator(".phase-line").first
        assert float(line.get_attribute("x1")) == pytest.approx(36 + 0.37 * 236)
        page.locator("#phase-speed").select_option("0.5")
        page.get_by_role("button", name="Play").click()
        worst = page.evaluate(f"""() => new Promise((done) => {{
          const from = performance.now(), found = [];
          const look = () => {{
            if (performance.now() - from > 400) found.push(...({off})().filter((d) => d !== 9));
            if (performance.now() - from < 900) requestAnimationFrame(look); else done(found);
          }};
          look();
        }})""")
        assert len(worst) > 10
        assert float(np.median(np.abs(worst))) < 0.06
        page.get_by_role("button", name="Pause").click()
        until(lambda: page.evaluate("[...document.querySelectorAll('video')].every((v) => v.paused)"))
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
        # For the record: what is printed has curves and no buttons or videos.
        page.emulate_media(media="print")
        assert page.locator(".charts figure > svg").first.is_visible()
        assert not page.locator(".together").is_visible()
        assert not page.locator(".top").is_visible()
