"""One visit, computed on files and by the tables: the same `Visit`, files, report, exports and pages.

The slow stages are the stand-ins of `chain`, the same for both. On files a visit of one camera is that of `pbl run`,
one of several cameras or of a laboratory's markers that of `pbl fit` and `pbl gait`.

The tolerances are stated once, in `tests.same_visit`: `ROUNDED`, the rounding of a visit's files, and `FLOAT32`, as
which the tables store movements. What only the tables know is left out in `of_both`.
"""

import dataclasses
import functools
import importlib.util
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pbl_pipeline.gait.metrics as metrics
from pbl_pipeline import pipeline
from pbl_pipeline.export import FORMATS
from pbl_pipeline.fit import METHODS, SessionFit, default_fit, points_of
from pbl_pipeline.gait import Condition, GaitEvent, Gdi, apply_correction
from pbl_pipeline.keypoints import MultiView
from pbl_pipeline.report.page import page_of
from pbl_pipeline.tracking import Tracking
from pbl_pipeline.video import VideoInfo, probe
from pbl_pipeline.visit import Recording, Visit, load_visit, save_visit, solution_of
from pbl_schemas import load_visit as load_from_tables
from pbl_schemas.decisions import event_corrections
from pbl_schemas.intake import Methods, ingest
from pbl_schemas.intake import VisitRecord as Whose
from pbl_workers.populate import populate
from pbl_workers.web import ResultsFolder
from tests import not_none
from tests.command import pbl
from tests.integration import chain, test_markers, test_rigs, web
from tests.rows import register, remove_all
from tests.same_visit import ROUNDED, as_stored, assert_same, assert_same_exports, assert_same_text, leaves

NORM = "gillette-166-three-angles"
MASS_KG = 70.0
MASS = ("--mass-kg", MASS_KG)


@dataclasses.dataclass(frozen=True)
class Both:
    """A visit, computed twice: its folder, and its visit in the tables."""

    folder: Path
    kind: str = "single"

    @functools.cached_property
    def of_files(self) -> Visit:
        return load_visit(self.folder)

    @functools.cached_property
    def of_tables(self) -> Visit:
        return load_from_tables({"subject": "P001", "fit_set_kind": self.kind})


def fit_session(
    trials: Any,
    names: Any,
    paramset: Any = None,
    camera_motion: str = "static",
    height_m: float | None = None,
    markers: Any = None,
) -> SessionFit:
    """The stand-in of the chain with the markers of the body, which exports need, and the parameters it was given."""
    return chain.with_all_markers(chain.fit_upright(trials, names, paramset, camera_motion, height_m))


def track_people(video_path: Any, params: object = None, info: VideoInfo | None = None) -> Tracking:
    """The stand-in of the chain in the pixels of the video, whose size the tables take for that of the boxes."""
    info = info or probe(video_path)
    found = chain.track_people(video_path, params, info)
    to_video = np.tile([info.width_px / found.image_size_px[0], info.height_px / found.image_size_px[1]], 2)
    persons = tuple(dataclasses.replace(p, box_px=p.box_px * to_video) for p in found.persons)
    return dataclasses.replace(found, image_size_px=(info.width_px, info.height_px), persons=persons)


# ----------------------------------------------------------------------------------------------------------- the visits
def run(videos: list[Path], out: Path, **options: Any) -> Both:
    """Compute videos on files, without overlay and report."""
    visit, _ = pipeline.run_visit(videos, out, mass_kg=MASS_KG, **options)
    save_visit(visit, out)
    return Both(out)


def one_trial(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    video = chain.small_video(folder, "walk")
    register(video, session_label="2026-03-01", mass_kg=MASS_KG)
    populate()
    return run([video], folder / "out")


def two_trials(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    videos = [chain.small_video(folder, "walk"), chain.small_video(folder, "back", n=210)]
    register(*videos, session_label="2026-03-01", mass_kg=MASS_KG)
    populate()
    return run(videos, folder / "out")


def another_norm(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    video = chain.small_video(folder, "walk")
    ingest([video], Whose("P001", "2026-03-01", mass_kg=MASS_KG), methods=Methods(norm=NORM))
    populate()
    both = run([video], folder / "out", norm=NORM)
    assert not_none(both.of_tables.measures).gdi.norm == NORM
    return both


def corrected_event(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    """A person moves an event by 0.1 s; on files the chain is given the same correction."""
    both = one_trial(folder, patch)
    found = not_none(event_corrections.shown_events(1))
    events = [e[:3] for e in found.events]
    time, side, kind = events[6]
    event_corrections.save(1, [*events[:6], (time + 0.1, side, kind), *events[7:]], "A. First", found.state)
    populate()
    corrected = not_none(event_corrections.shown_events(1))
    by_hand = [GaitEvent(t, s, k, 1.0 if p is None else p) for t, s, k, p in not_none(corrected.hand)]
    detect = metrics.detect_events
    patch.setattr(metrics, "detect_events", lambda *args: apply_correction(detect(*args), by_hand, 1))
    both = run([folder / "walk.mp4"], both.folder)
    events = [v.recordings[0].events for v in (both.of_files, both.of_tables)]
    assert [e is not None and e.corrected for e in events] == [True, True]
    return both


def failed_recordings(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    """Beside a walk: a file that is not a video, one in which nobody is, and one in which a person must be chosen."""
    videos = [chain.small_video(folder, "walk"), folder / "notes.mp4"]
    videos[1].write_text("not a video")
    videos += [chain.small_video(folder, f"film{i}", people=who) for i, who in enumerate(("nobody", "two alike"))]
    register(*videos, session_label="2026-03-01", mass_kg=MASS_KG)
    populate()
    both = run(videos, folder / "out")
    assert len(both.of_files.left_out) == len(both.of_tables.left_out) == 3
    return both


def several_cameras(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    """On files fitted by the library: `pbl fit` names the trial after all cameras, the tables after the first."""
    videos = test_rigs.rig_videos(folder / "lab")
    toml = test_rigs.calibration(folder / "Calib.toml")
    chain.replace(patch, detect_keypoints=test_rigs.detect_keypoints)
    done = pbl("ingest", *videos, "--rig", toml, "--subject", "P001", "--session", "2026-03-01", *MASS)
    assert done.code == 0, done
    populate()
    seen = [test_rigs.detect_keypoints(v, track_people(v), 1, None) for v in videos]
    trial = MultiView.from_calibration(seen, toml, list(test_rigs.CAMERAS))
    method = METHODS.find(default_fit(*points_of([trial])))
    session = fit_session([trial], [test_rigs.CAMERAS[0]], method)
    recording = Recording.of(session.trials[0].name, session.trials[0])
    visit = Visit((recording,), solution_of(session), session.qc, kind="rig", methods={"Fit": method.key})
    save_visit(pipeline.measured(visit, mass_kg=MASS_KG), folder / "out")
    return Both(folder / "out", "rig")


def laboratory_markers(folder: Path, patch: pytest.MonkeyPatch) -> Both:
    lab = test_markers.recording(folder / "lab.npz")
    done = pbl("ingest", "--markers", lab, "--subject", "P001", "--session", "2026-03-01", *MASS)
    assert done.code == 0, done
    populate()
    out = folder / "out"
    assert pbl("fit", lab, "--marker-set", "bml_movi_87", "--out", out).code == 0
    assert pbl("gait", out / "lab.fit.npz", "--out", out / "metrics.json", *MASS).code == 0
    return Both(out, "markers")


CASES: dict[str, Callable[[Path, pytest.MonkeyPatch], Both]] = {
    f.__name__.replace("_", " "): f
    for f in (
        one_trial,
        two_trials,
        another_norm,
        corrected_event,
        failed_recordings,
        several_cameras,
        laboratory_markers,
    )
}


@pytest.fixture(scope="module", params=CASES)
def both(request: pytest.FixtureRequest, declared: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Both]:
    folder = tmp_path_factory.mktemp("contract")
    with pytest.MonkeyPatch.context() as patch:
        chain.install(patch)
        chain.replace(patch, fit_session=fit_session, track_people=track_people)
        yield CASES[request.param](folder, patch)
        remove_all()


def of_both(visit: Visit) -> Visit:
    """Return what files and tables have in common of a visit: not whose it is, when it was, what was done in a
    recording, the numbers of rows, and how long the fit took.

    A fit of several cameras or of markers knows neither videos nor the methods before it. What a log of the phone is
    read from is not compared.
    """
    from_fit = visit.kind != "single"

    def common(r: Recording) -> Recording:
        of_video: dict[str, Any] = {"video": None, "choice": None, "load_keypoints": None} if from_fit else {}
        return dataclasses.replace(r, number=None, condition=Condition(), load_log=None, **of_video)

    methods = {k: v for k, v in visit.methods.items() if k == "Fit" or not from_fit}
    changes = {"solution": dataclasses.replace(not_none(visit.solution), seconds=0.0), "methods": methods}
    whose: dict[str, Any] = {"subject": "-", "label": "", "date": "", "key": {}}
    return as_stored(dataclasses.replace(visit, recordings=tuple(map(common, visit.recordings)), **changes, **whose))


# ----------------------------------------------------------------------------------------------------- what is the same
def test_the_visit_is_the_same(both: Both) -> None:
    assert both.of_files.lacks == both.of_tables.lacks == ()
    assert not_none(both.of_tables.measures).gdi.mean is not None
    assert not_none(both.of_tables.kinetics).measures
    assert_same(of_both(both.of_tables), of_both(both.of_files))


def test_a_visit_of_the_tables_comes_back_from_its_folder(both: Both, tmp_path: Path) -> None:
    save_visit(both.of_tables, tmp_path)
    loaded = load_visit(tmp_path)
    assert loaded.lacks == ()
    numbers = {r.name: r.number for r in both.of_tables.recordings}
    recordings = tuple(dataclasses.replace(r, number=numbers[r.name]) for r in loaded.recordings)
    of_tables = as_stored(both.of_tables)
    without_log = tuple(dataclasses.replace(r, load_log=None) for r in of_tables.recordings)
    assert_same(
        dataclasses.replace(of_tables, recordings=without_log, key={}),
        dataclasses.replace(loaded, recordings=recordings),
    )


def test_the_report_is_the_same(both: Both) -> None:
    pages = [list(leaves(page_of(of_both(v), {}, "Visit"))) for v in (both.of_tables, both.of_files)]
    assert len(pages[0]) > 40
    assert [where for where, _ in pages[0]] == [where for where, _ in pages[1]]
    for (where, a), (_, b) in zip(*pages, strict=True):
        assert_same_text(a, b, where)


def test_exports_are_the_same(both: Both, tmp_path: Path) -> None:
    formats = [f for f in FORMATS if not (f == "dlc" and both.kind != "single")]
    for package, wanted in (("ezc3d", "c3d"), ("pyarrow", "parquet")):
        if importlib.util.find_spec(package) is None:
            formats.remove(wanted)
    assert_same_exports(of_both(both.of_tables), of_both(both.of_files), formats, tmp_path, float32=True)


def test_pages_are_the_same(both: Both) -> None:
    """As JSON, up to the rounding of the files, without what only the tables know."""
    browsers = [web.client("reader", folder=folder) for folder in (None, ResultsFolder(both.folder))]
    visits = [b.get("/visits/1.json").json()["about"] for b in browsers]
    of_tables, of_files = (common_of_visit(v, both.kind) for v in visits)
    assert_same(of_tables, of_files, "visit", ROUNDED[Gdi])
    assert all(bool(of_files["filming"][name]) == (both.kind == "single") for name in ("cameras", "pictures"))
    numbers = {r.name: r.number for r in both.of_tables.recordings}
    for recording in both.of_files.fitted:
        lead = numbers[recording.name]
        number = sorted(p.name for p in both.folder.glob("*.fit.npz")).index(f"{recording.name}.fit.npz") + 1
        pages = [f"/recordings/{n}" for n in (lead, number)]
        shown = [b.get(f"{p}.json").json()["about"] for b, p in zip(browsers, pages, strict=True)]
        assert shown[0]["recording"]["events"]
        of_tables, of_files = (common_of_recording(v, both.kind) for v in shown)
        assert_same(of_tables, of_files, recording.name, ROUNDED[Gdi])
        movement = [b.get(f"{p}/movement").json() for b, p in zip(browsers, pages, strict=True)]
        body = [b.get(f"{p}/body").content for b, p in zip(browsers, pages, strict=True)]
        assert body[0] == body[1]
        if both.kind == "single":  # without keypoints no frame is known as one in which a leg is hardly seen
            assert_same(movement[0], movement[1], "movement", ROUNDED[Gdi])


def common_of_visit(page: dict[str, Any], kind: str) -> dict[str, Any]:
    """Return what the pages of both sources show of a visit: of cameras and markers, of no stage before the fit."""
    visit, result = page["visit"], page["row"]["result"]
    metrics = visit.pop("metrics")
    facts = visit.pop("visit")
    found = {
        "result": {k: result[k] for k in ("kind", "status", "reason", "index", "sd", "minimal_change")},
        "fit": {k: v for k, v in visit.items() if k != "seconds"},
        "metrics": metrics,
        "kind": facts["kind"],
        "filming": page["results"][page["shown"]]["filming"],
    }
    if kind != "single":
        for name in ("qc", "qc_before_gait", "outcome"):
            del metrics["session"][name]
        return found
    # A recording that was left out is a check of files, and a line of the table of recordings.
    # Files have a check that two recordings have alike once.
    checks = {
        (name.partition(" (")[0], c["outcome"], None if c["value"] is None else round(c["value"], 2), c["advice"])
        for c in (c["check"] for c in page["checks"])
        if not (name := c["check"]).startswith("trial ")
    }
    recordings = [{k: r[k] for k in ("name", "problem", "video")} for r in facts["recordings"]]
    found |= {"methods": facts["methods"], "recordings": recordings, "outcome": result["outcome"]}
    return found | {"checks": sorted(checks, key=str)}


def common_of_recording(page: dict[str, Any], kind: str) -> dict[str, Any]:
    """Return what the pages of both sources show of a recording."""
    names = ("name", "events") if kind != "single" else ("name", "events", "video", "problem")
    facts = ("pictures", "duration_s", "n_frames", "width_px", "height_px") if kind == "single" else ("pictures",)
    return {k: page["recording"][k] for k in names} | {k: page[k] for k in facts}
