"""From an empty database to two visits compared, in a Chromium, with nothing typed into a terminal. The stages that
need a model's weights are stand-ins; with `-m long` all stages run, on the demo recording."""

from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import gdi, lab, session, video
from pbl_schemas.reading import comparison
from pbl_schemas.review import Decision
from pbl_workers.on_request import compute_visit
from tests import Environment
from tests.integration import compute_target, web
from tests.integration.chain import small_video
from tests.unit.test_blazepose import asset


@pytest.fixture(params=["stand-ins", pytest.param("real", marks=[pytest.mark.long, pytest.mark.slow])])
def real(request: pytest.FixtureRequest) -> bool:
    return request.param == "real"


@pytest.fixture
def clips(real: bool, tmp_path: Path) -> list[Path]:
    if real:
        found = asset("demo_video")
        again = tmp_path / "again.mp4"  # other bytes, the same pictures
        again.write_bytes(found.read_bytes() + b"\0\0\0\x08free")
        return [found, again]
    return [small_video(tmp_path, "walk"), small_video(tmp_path, "again", n=238)]


@pytest.fixture
def place(
    real: bool, declared: None, tables: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: Environment
) -> None:
    if real:
        monkeypatch.undo()  # the stand-ins of `tables`
    environment(PBL_ARCHIVE=tmp_path / "archive", PBL_TEST_HOLD=tmp_path / "hold")


def test_from_an_empty_database_to_two_visits_compared(place: None, real: bool, chromium: Any, clips: list[Path]):
    assert not len(lab.Subject())
    wait = 600_000
    target = compute_visit if real else compute_target.compute
    with web.shown(chromium, name="A. First", target=target, locale="en", accept_downloads=True) as page:
        for label, role, clip in (("2026-01-10", "baseline", clips[0]), ("2026-04-10", "3_months", clips[1])):
            page.goto("/visits")
            page.get_by_role("link", name="New visit").click()
            page.get_by_label("Code of the person").fill("P001")
            page.get_by_label("Label of the visit").fill(label)
            page.get_by_label("Role of the visit").fill(role)
            page.get_by_label("Body height").fill("1,72")
            page.get_by_role("button", name="Register the visit").click()
            page.get_by_role("link", name="Add recordings from this computer").click()
            page.get_by_label("Videos").set_input_files(clip)
            page.get_by_role("button", name="Send").click()
            page.get_by_role("button", name="Compute now").click(timeout=wait)
            page.wait_for_selector(".headline .big", timeout=wait)  # the page loads itself when it is done
        page.get_by_role("link", name="Person and circumstances").click()
        page.get_by_label("Body mass").fill("71,5")
        page.get_by_role("button", name="Save").click()
        page.wait_for_selector("input[name=v] >> nth=1")
        boxes = page.locator("input[name=v]")
        for box in boxes.all():
            box.check()
        page.get_by_role("button", name="Compare").click()
        page.wait_for_url("**/compare?**")
        text = page.locator("main").inner_text()
        assert "2026-01-10" in text
        assert "2026-04-10" in text
    assert len(gdi.SessionGdi()) == len(video.Video()) == 2
    visits = session.Session.to_arrays("session_id", order_by="session_id").tolist()
    found = comparison.compare([(i, None) for i in visits]).compared
    first, second = (c.about.result.index for c in found if c.about.result is not None)
    assert first is not None
    assert second == pytest.approx(first, abs=1.0)
    assert found[1].change is not None
    assert found[1].change.sure is not True  # the same walk twice
    if real:
        assert 80 < first < 120
        assert found[1].change.sure is False
    assert lab.Subject.fetch1("subject_height") == 1.72
    kinds = [str(k) for k in Decision().to_arrays("decision_what")]
    assert sorted(kinds) == ["height", "mass", "recording", "recording", "visit", "visit"]
