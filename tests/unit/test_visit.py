"""A visit written to its folder and read back: equal in every field, and so are its report and its exports."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.export import FORMATS, ExportOptions, write_export
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import (
    EVENT_METHODS,
    GDI_METHODS,
    GILLETTE_MODEL,
    Condition,
    GaitCycle,
    GaitEvent,
    GaitParams,
    Gdi,
    Measure,
    MovementProfile,
)
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.pipeline import measured
from pbl_pipeline.qc import FAIL, PASS, WARN, Check
from pbl_pipeline.report._page import page_of
from pbl_pipeline.tracking import SubjectChoice
from pbl_pipeline.video import Camera, VideoInfo
from pbl_pipeline.visit import Recording, Solution, Visit, load_visit, save_visit
from tests.exported import marked_fit
from tests.unit.visits import solution_of
from tests.walking_fit import walking_fit

FPS = 30.0
FIT_CHECKS = (Check("residual_3d_cm", WARN, 7.123456789, 6.0, "look at the overlay"), Check("scale", PASS, None, None))
CHOICE = SubjectChoice("CHOSEN", 2, 0.9, None, float("nan"), {1: float("nan"), 2: 0.9}, "person 2 walks")
NOBODY = SubjectChoice("NO_PERSON", None, float("nan"), None, float("nan"), {}, "nobody was found")
METHODS = {"Tracking": "rtmdet-v1", "Keypoints": "blazepose-v2", "Fit": "gauss-newton-v4"}

#: What the rounding in the files of a visit changes at most, by the class that holds the number: metrics.json rounds a
#: measure to 4 decimals, index and profile to 3; events.csv times to 4 and probabilities to 3; session.json seconds to
#: 3, scale and loss to 5. Everything else comes back as it was (curves as float32).
ROUNDED = {Measure: 5.1e-5, Gdi: 5.1e-4, MovementProfile: 5.1e-4, GaitEvent: 5.1e-4, Solution: 5.1e-4}


# -------------------------------------------------------------------------------------------------------------- visits
def walk(name: str, *, n: int = 200, hidden: slice | None = None, seed: int = 0) -> TrialFit:
    """A walk with markers, of which the fit knows how sure it is; hidden: frames without a pose."""
    fit = marked_fit(n_frames=n, seen=(4, n - 3), seed=seed)
    qpos, sd = fit.qpos.copy(), np.full_like(fit.qpos, 0.03)
    if hidden is not None:
        qpos[hidden] = np.nan
    sd[np.isnan(qpos)] = np.nan
    return dataclasses.replace(fit, name=name, qpos=qpos, qpos_sd=sd)


def stand(name: str) -> TrialFit:
    body = load_body()
    fit = walking_fit(body.joint_names, body.sha256, n_frames=120, walks=False, name=name)
    return dataclasses.replace(marked_fit(n_frames=120), name=name, qpos=fit.qpos)


def keypoints_of(fit: TrialFit) -> Keypoints:
    rng, (n, j) = np.random.default_rng(1), fit.markers_world_m.shape[:2]
    return Keypoints(
        time_s=fit.time_s,
        names=fit.marker_names,
        marker_set=fit.marker_set,
        xy_px=rng.uniform(0, 300, (n, j, 2)).astype(np.float32),
        xyz_cam_m=np.full((n, j, 3), np.nan),
        root_relative=True,
        confidence=rng.uniform(0.3, 1.0, (n, j)).astype(np.float32),
        image_size_px=(640, 360),
        camera=Camera(fit.camera.matrix, np.zeros(5), "guess: a test"),
        box_px=np.zeros((n, 4)),
        origin="a detector, licence Apache-2.0",
    )


def video_of(name: str, time_s: np.ndarray) -> VideoInfo:
    return VideoInfo(
        path=f"/somewhere/secret/{name}.mp4",
        sha256="ab" * 32,
        size_bytes=3_456_789,
        container="mp4",
        codec="h264",
        pixel_format="yuv420p",
        width_px=640,
        height_px=360,
        rotation_deg=90,
        time_s=time_s,
        fps=FPS,
        duration_s=float("nan"),
        n_frames=len(time_s),
        n_frames_announced=len(time_s),
        variable_frame_rate=False,
        recorded_utc="2026-03-01T10:00:00Z",
        make="Acme",
        model=None,
        notes=("two stamps repeat",),
        capture_fps=240.0,  # slow motion: a check that FAILs, of the recording
    )


def visit_of(*fits: TrialFit, left_out: tuple[Recording, ...] = (), **fields: Any) -> Visit:
    """A visit of filmed recordings, fitted but not measured."""
    recordings = tuple(
        Recording.of(
            f.name,
            f,
            keypoints_of(f),
            path=Path(f"/somewhere/secret/{f.name}.mp4"),
            video=video_of(f.name, f.time_s),
            choice=CHOICE,
            condition=Condition("walking", "self_selected"),
        )
        for f in fits
    )
    whose = {"subject": "P017", "label": "before surgery", "date": "2026-03-01", "methods": METHODS}
    return Visit((*recordings, *left_out), solution_of(fits[0]), FIT_CHECKS, **whose | fields)


def dark() -> Recording:
    video = video_of("dark", np.arange(50) / FPS)
    return Recording("dark", Path(video.path), video, NOBODY, problem="TRACK_NO_PERSON: nobody was found")


def of_markers(fit: TrialFit) -> Visit:
    """As of a laboratory's markers: no video, no keypoints, no camera."""
    camera = Camera(np.full((3, 3), np.nan), np.full(5, np.nan), "none: markers")
    nothing = {"phone_quat_wxyz": np.full_like(fit.phone_quat_wxyz, np.nan), "camera_position_m": np.full(3, np.nan)}
    fit = dataclasses.replace(
        fit,
        camera=camera,
        image_size_px=(0, 0),
        residual_2d_px=np.full_like(fit.residual_2d_px, np.nan),
        orientation_source="measured: calibration",
        **nothing,
    )
    return Visit((Recording.of(fit.name, fit),), solution_of(fit, converged=None), FIT_CHECKS, kind="markers")


def other_pace(visit: Visit) -> Visit:
    """The visit whose last fitted recording is walked fast."""
    last = dataclasses.replace(visit.recordings[-1], condition=Condition("walking", "fast"))
    return dataclasses.replace(visit, recordings=(*visit.recordings[:-1], last))


ZENI = GaitParams(events=EVENT_METHODS.find("zeni-2008").paramset)
NINE_ANGLES = GaitParams(gdi=GDI_METHODS.find(GILLETTE_MODEL).params)
FAILED = (Check("residual_3d_cm", FAIL, 21.0, 6.0, "the body does not lie on the person"),)
VISITS: dict[str, Callable[[], Visit]] = {
    "one trial": lambda: measured(visit_of(walk("walk"))),
    "two trials": lambda: measured(visit_of(walk("walk"), walk("back", seed=9))),
    "two bouts": lambda: measured(visit_of(walk("walk", n=420, hidden=slice(190, 240)))),
    "curves missing": lambda: measured(visit_of(walk("walk", n=260, hidden=slice(120, 125)))),
    "one left out": lambda: measured(visit_of(walk("walk"), left_out=(dark(),))),
    "one stands": lambda: measured(visit_of(walk("walk"), stand("stand"))),
    "no gait": lambda: measured(visit_of(stand("stand"))),
    "another pace": lambda: measured(other_pace(visit_of(walk("walk"), walk("fast", seed=3)))),
    "no pace that counts": lambda: measured(other_pace(visit_of(walk("fast")))),
    "another norm": lambda: measured(visit_of(walk("walk")), norm="gillette-166-three-angles"),
    "another event method": lambda: measured(visit_of(walk("walk")), ZENI),
    "nine angles": lambda: measured(visit_of(walk("walk")), NINE_ANGLES, norm="gillette-166-nine-angles"),
    "a fit that failed": lambda: measured(dataclasses.replace(visit_of(walk("walk")), fit_checks=FAILED)),
    "markers": lambda: measured(of_markers(walk("walk"))),
}


@pytest.fixture(scope="module", params=VISITS)
def visit(request: pytest.FixtureRequest) -> Visit:
    return VISITS[request.param]()


@pytest.fixture(scope="module")
def folder(visit: Visit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("visit") / "P017"
    save_visit(visit, out)
    return out


@pytest.fixture(scope="module")
def two() -> Visit:
    return VISITS["two trials"]()


@pytest.fixture
def saved(two: Visit, tmp_path: Path) -> Path:
    """The folder of a visit of two trials, to be changed."""
    save_visit(two, tmp_path / "P017")
    return tmp_path / "P017"


# ----------------------------------------------------------------------------------------------------------- comparing
def as_stored(visit: Visit) -> Visit:
    """The visit without what its folder does not hold: paths, and the frames' times of a recording without a fit. Its
    measures are judged by the checks before them."""

    def stored(r: Recording) -> Recording:
        video = r.video
        if video is not None:
            time = video.time_s if r.fitted else np.full(video.n_frames, np.nan)
            video = dataclasses.replace(video, path=Path(video.path).name, time_s=time)
        return dataclasses.replace(r, path=None, video=video)

    judged = visit.judged
    return dataclasses.replace(visit, recordings=tuple(map(stored, visit.recordings)), measures=judged)


def fields(value: Any) -> dict[str, Any]:
    """The fields of a dataclass; of a recording what its functions load."""
    found = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if isinstance(value, Recording):
        loaded = {n.removeprefix("load_"): getattr(value, n.removeprefix("load_")) for n in found if "load_" in n}
        return {n: v for n, v in found.items() if "load_" not in n} | loaded
    return found


def assert_same(a: Any, b: Any, where: str = "visit", atol: float = 0.0) -> None:
    """Compare two values field by field, with what the rounding of the files allows (`ROUNDED`)."""
    if dataclasses.is_dataclass(a):
        assert type(a) is type(b), where
        one, other = fields(a), fields(b)
        for name in one:
            assert_same(one[name], other[name], f"{where}.{name}", ROUNDED.get(type(a), 0.0))
    elif isinstance(a, Mapping):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}[{key!r}]", atol)
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (one, other) in enumerate(zip(a, b, strict=True)):
            assert_same(one, other, f"{where}[{i}]", atol)
    elif isinstance(a, np.ndarray) and a.dtype.kind in "fiub":
        np.testing.assert_allclose(b, a, rtol=1e-6, atol=atol, err_msg=where)
    elif isinstance(a, float) and isinstance(b, float):
        assert b == pytest.approx(a, rel=0, abs=atol, nan_ok=True), where
    else:
        assert a == b, where


def assert_same_text(a: object, b: object, where: str) -> None:
    """Compare two texts, and each number in them up to one unit of its last digit."""
    number = r"\d+(?:\.\d+)?"
    assert re.sub(number, "#", str(a)) == re.sub(number, "#", str(b)), where
    for one, other in zip(re.findall(number, str(a)), re.findall(number, str(b)), strict=True):
        decimals = len(one.partition(".")[2])
        assert float(other) == pytest.approx(float(one), rel=0, abs=1.01 * 10.0**-decimals), where


def leaves(value: Any, where: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of nested mappings and lists with its place."""
    parts = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list | tuple) else ()
    yield from ((where, value),) if not isinstance(value, Mapping | list | tuple) else ()
    for key, part in parts:
        yield from leaves(part, f"{where}/{key}")


# ---------------------------------------------------------------------------------------------------------- round trip
def test_a_visit_comes_back_from_its_folder(visit: Visit, folder: Path) -> None:
    loaded = load_visit(folder)
    assert loaded.lacks == ()
    assert_same(as_stored(visit), loaded)
    assert loaded.judged == loaded.measures


def test_the_visits_of_these_tests_have_what_is_to_come_back() -> None:
    """Else the comparison of a round trip compares nothing."""

    def cycles(name: str) -> tuple[GaitCycle, ...]:
        return VISITS[name]().recordings[0].cycles

    one = VISITS["one trial"]()
    assert one.measures is not None
    assert one.measures.gdi.sd is not None
    assert one.measures.gdi.profile is not None
    assert all(c.curves and c.curves_sd for c in one.recordings[0].cycles)
    assert {c.check for c in one.checks} >= {"time_stretch", "residual_3d_cm", "scale"}
    assert {c.bout for c in cycles("two bouts")} == {0, 1}
    assert any(c.curves_missing for c in cycles("curves missing"))
    assert any(c.curves for c in cycles("curves missing"))
    for name, status in {"no gait": "EMPTY", "a fit that failed": "EMPTY", "one stands": "PASS"}.items():
        measures = VISITS[name]().measures
        assert measures is not None
        assert measures.status == status
    fast = VISITS["another pace"]().measures
    assert fast is not None
    assert [t.pooled for t in fast.trials] == [True, False]
    nine = VISITS["nine angles"]().measures
    assert nine is not None
    assert nine.gdi.profile is not None
    assert nine.gdi.profile.gps is not None


def test_saved_again_it_is_the_same_files(folder: Path, tmp_path: Path) -> None:
    again = save_visit(load_visit(folder), tmp_path)
    assert sorted(p.name for p in again) == sorted(p.name for p in folder.iterdir())
    for path in again:
        before = folder / path.name
        if path.suffix == ".npz":
            with np.load(before) as a, np.load(path) as b:
                assert a.files == b.files
                for name in a.files:
                    np.testing.assert_array_equal(a[name], b[name], err_msg=f"{path.name} {name}")
        elif path.suffix == ".json":
            assert json.loads(path.read_text()) == json.loads(before.read_text())
        else:
            assert path.read_bytes() == before.read_bytes(), path.name


def test_files_name_no_folder(visit: Visit, folder: Path) -> None:
    """The name of a video is provenance, a folder of the laboratory is not."""
    assert [p.name for p in folder.iterdir() if b"secret" in p.read_bytes()] == []
    names = {f"{r.name}.mp4" for r in visit.recordings if r.video is not None}
    assert all(name in (folder / "session.json").read_text() for name in names)


def test_the_report_of_the_loaded_visit_is_the_same(visit: Visit, folder: Path) -> None:
    one, other = (list(leaves(page_of(v, {}, "Visit", None))) for v in (visit, load_visit(folder)))
    assert len(one) > 40
    assert [where for where, _ in one] == [where for where, _ in other]
    for (where, a), (_, b) in zip(one, other, strict=True):
        assert_same_text(a, b, where)


def test_every_export_of_the_loaded_visit_is_the_same(
    request: pytest.FixtureRequest, visit: Visit, folder: Path, tmp_path: Path
) -> None:
    """Measures of the tables up to the rounding of metrics.json, events up to that of events.csv; all else exactly."""
    ezc3d = pytest.importorskip("ezc3d")
    formats = [f for f in FORMATS if f != "dlc" or visit.kind != "markers"]
    options = ExportOptions(allow_failed=True)
    out = [tmp_path / "memory", tmp_path / "files"]
    files = [write_export(v, formats, o, options) for v, o in zip((visit, load_visit(folder)), out, strict=True)]
    assert [p.relative_to(out[0]) for p in files[0]] == [p.relative_to(out[1]) for p in files[1]]
    for one, other in zip(*files, strict=True):
        if one.parent == out[0] and one.suffix == ".csv":
            tables = [pd.read_csv(p, keep_default_na=False, na_values=[""]) for p in (one, other)]
            pd.testing.assert_frame_equal(*tables, rtol=0, atol=5.1e-4, obj=one.name)
        elif one.suffix == ".parquet":
            pd.testing.assert_frame_equal(
                pd.read_parquet(one), pd.read_parquet(other), rtol=0, atol=5.1e-4, check_categorical=False
            )
        elif one.suffix == ".c3d":
            a, b = (ezc3d.c3d(str(p)) for p in (one, other))
            for kind in ("points", "rotations", "analogs"):
                np.testing.assert_array_equal(a["data"][kind], b["data"][kind])
            events = [f["parameters"]["EVENT"] for f in (a, b)]
            assert events[0].keys() == events[1].keys()
            if "TIMES" in events[0]:
                np.testing.assert_allclose(*(e["TIMES"]["value"] for e in events), atol=1e-4)
                assert events[0]["LABELS"]["value"] == events[1]["LABELS"]["value"]
                assert events[0]["CONTEXTS"]["value"] == events[1]["CONTEXTS"]["value"]
        else:
            assert one.read_bytes() == other.read_bytes(), one.name
