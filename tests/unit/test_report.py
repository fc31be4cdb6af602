"""The report page: what stands in it, that it is whole and asks for nothing, and pages of visits that went wrong."""

import dataclasses
import re
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.charts import cycle_chart, nice_ticks
from pbl_pipeline.code_version import code_version
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import GaitMetrics, far_leg_of, gait_metrics, load_norm, normal_bands
from pbl_pipeline.qc import EMPTY, FAIL, NEEDS_CHOICE, PASS, WARN, Check
from pbl_pipeline.report import Picture, write_report
from pbl_pipeline.report.curves import cycle_curves
from pbl_pipeline.report.words import plural, sentence, size
from pbl_pipeline.texts import LANGUAGES, catalogue, library_words
from pbl_pipeline.tracking import SubjectChoice
from pbl_pipeline.visit import Recording, Visit
from pbl_pipeline.words import check_words, number, significant
from tests import not_none
from tests.html_page import Page, commands_in
from tests.unit.visits import solution_of, video_of
from tests.walking_fit import walking_fit

N, FPS = 200, 30.0
EVIL = "<script>alert(1)</script>&\"'"
VIDEO = video_of("walk", np.arange(N) / FPS, duration_s=N / FPS, recorded_utc="2026-11-20T10:00:00Z", model="Phone 9")
CHOICE = SubjectChoice("CHOSEN", 2, 0.9, 1, 0.2, {1: 0.2, 2: 0.9}, "person 2 walks through the picture")
FIT_CHECKS = (Check("residual_3d_cm", PASS, 3.1, 6.0),)
PICTURES = {"walk": tuple(Picture(i, i / FPS, np.full((90, 120, 3), i, np.uint8)) for i in (30, 90, 150))}


def _visit(*recordings: Recording, measures: GaitMetrics | None = None) -> Visit:
    """A visit of these recordings, fitted where one of them is."""
    fits = tuple(r.fit for r in recordings if r.fit is not None)
    visit = Visit(
        recordings,
        solution_of(fits[0]) if fits else None,
        FIT_CHECKS if fits else (),
        subject="S-014",
        date="2026-11-20",
        methods={"Keypoints": "blazepose-v2"},
    )
    return visit if measures is None else visit.with_measures(measures)


@pytest.fixture(scope="module")
def walk() -> TrialFit:
    return walking_fit(n_frames=N, seen=(10, 190), speed_m_s=0.5)  # her feet slide


@pytest.fixture(scope="module")
def stand() -> TrialFit:
    return walking_fit(n_frames=N, walks=False, name="stand")


@pytest.fixture(scope="module")
def measured(walk: TrialFit) -> GaitMetrics:
    return gait_metrics([walk])


@pytest.fixture(scope="module")
def visit(walk: TrialFit, measured: GaitMetrics) -> Visit:
    return _visit(Recording.of("walk", walk, video=VIDEO, choice=CHOICE), measures=measured)


def _written(visit: Visit, path: Path, title: str = "Visit 1") -> Path:
    return write_report(path, visit, PICTURES, title)


def _page(visit: Visit, folder: Path) -> Page:
    page = Page(_written(visit, folder / "report.html").read_text(encoding="utf-8"))
    assert page.problems == []
    return page


def test_page_is_whole_and_asks_for_nothing(visit: Visit, tmp_path: Path) -> None:
    path = _written(visit, tmp_path / "new" / "report.html")
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.problems == []
    assert text.startswith("<!doctype html>")
    assert page.all("html")[0]["lang"] == "en"
    for tag, attributes in page.tags:
        assert tag not in ("script", "link", "iframe", "object", "embed", "base", "form")
        for name, value in attributes.items():
            assert name not in ("href", "srcset", "action", "background", "xlink:href"), tag
            assert not name.startswith("on"), name
            if name == "src":
                assert (value or "").startswith("data:image/")
    assert not re.search(r"url\(|@import", text)
    assert path.stat().st_size < 3_000_000
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


def test_page_shows_the_measures(visit: Visit, measured: GaitMetrics, tmp_path: Path) -> None:
    page = _page(visit, tmp_path)
    values = measured.spatiotemporal
    cadence, stride, stance = (
        not_none(values[k]) for k in ("cadence_steps_per_min", "stride_time_s", "stance_percent")
    )
    assert cadence.mean == pytest.approx(120 / 1.1, abs=2)  # the walker's own cadence
    for words in (
        "Visit 1",
        "S-014",
        "2026-11-20",
        f"{cadence.mean:.1f} steps/min",
        f"{stride.mean:.2f} s",
        f"Left {not_none(stance.left):.1f}",
        f"n {stance.n}",
        "Double support",
        "GDI of three angles",
        "Speed Not known: the standing foot slides",
        "CV",
        "Asymmetry",
        "How far each angle is from the mean curve",
        "matched by cadence",
        "person 2 walks through the picture".capitalize(),
        "ab" * 32,
        "walk.mp4",
        "Acme Phone 9",
        measured.params_hash,
        f"pbl-pipeline {code_version()}",
        "Keypoints blazepose-v2",
        "not the original",
        "Kalman smoother",
    ):
        assert words in page.text, words
    assert "/somewhere/secret" not in page.text  # a file's name is provenance, a folder of the laboratory is not


def test_residuals_of_one_name_stand_once(visit: Visit, tmp_path: Path) -> None:
    """Share of the height and distance in space are those of the checks, which the text does not compute otherwise."""
    text = _page(visit, tmp_path).text
    assert re.search(r"It lies [\d.]+ px \(median\) from the points detected in the picture", text)
    assert not re.search(r"[\d.]+ cm \(median\)|% of the person's height", text)
    assert "Residual 3D (cm)" in text


def test_gdi_is_always_named_with_its_three_angles(visit: Visit, tmp_path: Path) -> None:
    text = _page(visit, tmp_path).text
    matches = list(re.finditer(r"\bGDI\b", text))
    assert matches
    for match in matches:
        follows = text[match.end() : match.end() + 20]
        # Checks and hashes carry the index in their identifiers.
        assert follows.startswith((" of three angles", " cycles", " explained", "_Calc", " with 100")), follows


def test_charts_and_pictures_have_words(visit: Visit, tmp_path: Path) -> None:
    page = _page(visit, tmp_path)
    labels = [a.get("aria-label") or "" for a in page.all("svg") if a.get("role") == "img"]
    # 9 angles over the cycle, the index, the contacts, 5 angles over time
    assert len(labels) == 9 + 1 + 1 + 5
    assert all(len(label) > 20 for label in labels)
    assert any(re.match(r"Knee flexion .* left \d+ to \d+°, right \d+ to \d+°", label) for label in labels)
    images = page.all("img")
    assert len(images) == 3
    assert all("Frame" in (a["alt"] or "") for a in images)
    assert all(a.get("scope") in ("col", "row") for a in page.all("th"))


def test_names_are_escaped_everywhere(visit: Visit, walk: TrialFit, tmp_path: Path) -> None:
    fit = dataclasses.replace(walk, name=EVIL, camera=dataclasses.replace(walk.camera, source=EVIL))
    choice = dataclasses.replace(CHOICE, reason=EVIL)
    path = f"/somewhere/secret/{EVIL.replace('/', '')}"
    video = dataclasses.replace(VIDEO, path=path, model=EVIL, recorded_utc=EVIL)
    recording = Recording.of(EVIL, fit, choice=choice, video=video, problem=EVIL)
    whole = _visit(recording, measures=gait_metrics([fit]).with_checks([Check(EVIL, WARN, None, None, EVIL)]))
    evil = dataclasses.replace(
        whole,
        subject=EVIL,
        date=EVIL,
        solution=dataclasses.replace(not_none(whole.solution), solver=EVIL, device=EVIL),
        methods={EVIL: EVIL},
    )
    path = _written(evil, tmp_path / "report.html", EVIL)
    text = path.read_text(encoding="utf-8")
    page = Page(text)
    assert page.problems == []
    assert "<script" not in text
    assert page.text.count(EVIL) > 10


def _verdict(page: Page) -> str:
    (verdict,) = [a for t, a in page.tags if t == "section" and "verdict" in (a.get("class") or "")]
    return (verdict.get("class") or "").split()[-1]


def test_verdict_is_the_worst_check(visit: Visit, tmp_path: Path) -> None:
    page = _page(visit, tmp_path)
    assert _verdict(page) == WARN
    assert "Usable with care" in page.text
    seen = Check("residual_2d_px", FAIL, 99.0, 9.0, "look at the overlay")
    page = _page(visit.with_measures(not_none(visit.measures).with_checks([*visit.checks, seen])), tmp_path)
    assert _verdict(page) == FAIL
    assert "Residual 2D (px): look at the overlay." in page.text


@pytest.mark.parametrize("language", LANGUAGES)
def test_what_names_an_option_on_the_command_line_is_said_otherwise(visit: Visit, tmp_path: Path, language) -> None:
    texts = [n.removeprefix("library.") for n in catalogue() if "library." in n[:8]]
    advised = [text.format(source="a guess") for text in texts if re.search(r" \(?--[a-z]", text)]
    assert len(advised) > 3
    named = ("camera_orientation_known", "lengths_scale", "camera_intrinsics_measured")
    checks = [Check(name, WARN, None, None, advice) for name, advice in zip(named, advised, strict=False)]
    asking = visit.with_measures(not_none(visit.measures).with_checks([*visit.checks, *checks]))
    page = write_report(tmp_path / "report.html", asking, PICTURES, "Visit 1", language).read_text("utf-8")
    assert not commands_in(page)
    for advice in advised[: len(named)]:
        told = library_words(language, advice)[1:].replace("'", "&#39;")
        assert page.count(told) == 2  # in the verdict and beside the check


def test_session_without_gait_says_so_and_draws_the_angles(stand: TrialFit, tmp_path: Path) -> None:
    metrics = gait_metrics([stand])
    assert metrics.status == EMPTY
    page = _page(_visit(Recording.of("stand", stand, video=VIDEO, choice=CHOICE), measures=metrics), tmp_path)
    assert _verdict(page) == EMPTY
    assert "No gait to measure" in page.text
    assert sentence(metrics.trials[0].reason) in page.text
    assert not [a for t, a in page.tags if t == "section" and a.get("class") == "tiles"]
    (details,) = page.all("details")
    assert "open" in details
    assert len([a for a in page.all("svg") if a.get("role") == "img"]) == 5


def test_one_recording_without_gait_does_not_empty_the_session(
    visit: Visit, walk: TrialFit, stand: TrialFit, tmp_path: Path
) -> None:
    metrics = gait_metrics([walk, stand])
    standing = Recording.of("stand", stand, video=dataclasses.replace(VIDEO, path="stand.mp4"), choice=CHOICE)
    page = _page(_visit(visit.recordings[0], standing, measures=metrics), tmp_path)
    assert _verdict(page) == WARN
    assert "steps/min" in page.text
    assert "No gait measures: " + metrics.trials[1].reason in page.text


def test_session_that_waits_for_a_choice(tmp_path: Path) -> None:
    choice = SubjectChoice("NEEDS_CHOICE", None, 0.5, 2, 0.48, {1: 0.5, 2: 0.48}, "two people walk alike")
    page = _page(_visit(Recording("walk", video=VIDEO, choice=choice)), tmp_path)
    assert _verdict(page) == NEEDS_CHOICE
    assert "two people walk alike" in page.text


def test_session_whose_chain_broke(tmp_path: Path) -> None:
    recording = Recording("walk", video=VIDEO, problem="TRACK_TOO_SHORT: in view for 0.4 s")
    page = _page(_visit(recording), tmp_path)
    assert _verdict(page) == FAIL
    assert "in view for 0.4 s" in page.text
    assert "steps/min" not in page.text


def test_fit_without_a_known_frame_is_drawn_without_curves(stand: TrialFit, tmp_path: Path) -> None:
    unknown = dataclasses.replace(
        stand,
        qpos=np.full_like(stand.qpos, np.nan),
        residual_2d_px=np.full_like(stand.residual_2d_px, np.nan),
        residual_3d_m=np.full_like(stand.residual_3d_m, np.nan),
    )
    recording = Recording.of("stand", unknown, video=VIDEO, choice=CHOICE, problem="nobody was seen")
    page = _page(_visit(recording), tmp_path)
    assert "The body is fitted in no frame." in page.text


def test_the_leg_that_is_drawn_faint_is_the_one_of_the_sentence(measured: GaitMetrics) -> None:
    seen = next(c for c in measured.cycles if c.used and c.curves)
    # One cycle alone has curves, and it was not seen from the side as the others were.
    others = [dataclasses.replace(seen, far_leg=seen.side, curves={})] * 9
    cycles = [dataclasses.replace(seen, far_leg=""), *others]
    assert far_leg_of(cycles) == seen.side
    (drawn,) = cycle_curves(cycles, normal_bands(None), {"knee_flexion": ("Knee", "flexion")}, lambda title, _: title)
    assert 'opacity="0.4"' in drawn.picture


def test_norm_band_is_the_norm() -> None:
    norm = load_norm()
    curve = norm.curves["knee_flexion"]
    percent = np.linspace(0, 100, 51)
    flat = [np.full(51, 20.0)]
    svg = cycle_chart(
        "Knee", percent, {"left": flat, "right": []}, {"left": 60.0}, (percent, curve["mean_deg"], curve["sd_deg"])
    )
    band = np.array([p.split(",") for p in re.findall(r'<polygon points="([^"]+)"', svg)[0].split()], float)
    upper, lower = band[:51], band[51:][::-1]
    # The curve of 20 deg gives the scale: where the band's centre crosses it, the norm is 20 deg.
    lines = [np.array([p.split(",") for p in m.split()], float) for m in re.findall(r'<polyline points="([^"]+)"', svg)]
    y20 = lines[-1][0, 1]
    y0 = float(re.findall(r'y1="([\d.]+)" x2="[\d.]+" y2="[\d.]+" stroke="#b9bfc5"', svg)[0])
    per_degree = (y0 - y20) / 20
    np.testing.assert_allclose((y0 - (upper[:, 1] + lower[:, 1]) / 2) / per_degree, curve["mean_deg"], atol=0.3)
    np.testing.assert_allclose((lower[:, 1] - upper[:, 1]) / per_degree / 2, curve["sd_deg"], atol=0.3)


@pytest.mark.parametrize(
    ("low", "high", "ticks"),
    [
        (0, 70, [0, 20, 40, 60, 80]),
        (-13, 41, [-20, 0, 20, 40, 60]),
        (0, 7.6, [0, 2, 4, 6, 8]),
        (-0.3, 0.2, [-0.3, -0.2, -0.1, 0, 0.1, 0.2]),
    ],
)
def test_ticks_are_round_and_enclose(low: float, high: float, ticks: list[float]) -> None:
    assert nice_ticks(low, high) == pytest.approx(ticks)


def test_words() -> None:
    assert number(-3.456, 1) == "\N{MINUS SIGN}3.5"
    assert number(-0.01, 1) == "0.0"
    assert number(None, 1) == number(float("nan"), 2) == "\N{EN DASH}"
    assert significant(0.01234) == "0.0123"
    assert significant(1234.5) == "1234"
    assert significant(230.0) == "230"
    assert significant(0.5) == "0.5"
    assert significant(0.0) == "0"
    assert significant(None) == ""
    assert check_words("residual_3d_cm") == "Residual 3D (cm)"
    assert check_words("gdi_cycles") == "GDI cycles"
    assert plural(1, "cycle") == "1 cycle"
    assert plural(0, "cycle") == "0 cycles"
    assert size(999) == "999 bytes"
    assert size(3_456_789) == "3.5 MB"
