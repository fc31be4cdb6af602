"""A visit written to its folder and read back: equal in every field, and so are its exports.

The report and the pages of both: tests/integration/test_visit_contract.py."""

import dataclasses
import functools
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.export import FORMATS
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.gait import (
    EVENT_METHODS,
    GDI_METHODS,
    GILLETTE_MODEL,
    MEASURES,
    Condition,
    GaitCycle,
    GaitParams,
    Gdi,
    gait_metrics,
)
from pbl_pipeline.pipeline import measured
from pbl_pipeline.qc import FAIL, PASS, WARN, Check
from pbl_pipeline.report.page import page_of
from pbl_pipeline.tracking import SubjectChoice
from pbl_pipeline.video import Camera, VideoInfo
from pbl_pipeline.visit import Recording, Visit, load_visit, save_visit, visit_of_fits
from tests import not_none
from tests.command import pbl
from tests.exported import keypoints_of, marked_fit
from tests.same_visit import ROUNDED, as_stored, assert_same, assert_same_exports, fields, leaves
from tests.unit.visits import solution_of, video_of
from tests.walking_fit import walking_fit

FPS = 30.0
FIT_CHECKS = (Check("residual_3d_cm", WARN, 7.123456789, 6.0, "look at the overlay"), Check("scale", PASS, None, None))
CHOICE = SubjectChoice("CHOSEN", 2, 0.9, None, float("nan"), {1: float("nan"), 2: 0.9}, "person 2 walks")
NOBODY = SubjectChoice("NO_PERSON", None, float("nan"), None, float("nan"), {}, "nobody was found")
METHODS = {"Tracking": "rtmdet-v1", "Keypoints": "blazepose-v2", "Fit": "gauss-newton-v4"}


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
    return dataclasses.replace(marked_fit(n_frames=120), name=name, qpos=walking_fit(n_frames=120, walks=False).qpos)


def slow_motion(name: str, time_s: np.ndarray) -> VideoInfo:
    """A video with a check that FAILs, of the recording."""
    day, notes = "2026-03-01T10:00:00Z", ("two stamps repeat",)
    return video_of(name, time_s, duration_s=float("nan"), recorded_utc=day, notes=notes, capture_fps=240.0)


def visit_of(*fits: TrialFit, left_out: tuple[Recording, ...] = (), **fields: Any) -> Visit:
    """A visit of filmed recordings, fitted but not measured."""
    recordings = tuple(
        Recording.of(
            f.name,
            f,
            keypoints_of(f),
            path=Path(f"/somewhere/secret/{f.name}.mp4"),
            video=slow_motion(f.name, f.time_s),
            choice=CHOICE,
            condition=Condition("walking", "self_selected"),
        )
        for f in fits
    )
    whose = {"subject": "P017", "label": "before surgery", "date": "2026-03-01", "methods": METHODS}
    return Visit((*recordings, *left_out), solution_of(fits[0]), FIT_CHECKS, **whose | fields)


def dark() -> Recording:
    video = slow_motion("dark", np.arange(50) / FPS)
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


def recording_of(visit: Visit, name: str) -> Recording:
    return next(r for r in visit.recordings if r.name == name)


@functools.cache
def visit_called(name: str) -> Visit:
    return VISITS[name]()


@pytest.fixture(scope="module", params=VISITS)
def visit(request: pytest.FixtureRequest) -> Visit:
    return visit_called(request.param)


@pytest.fixture(scope="module")
def folder(visit: Visit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("visit") / "P017"
    save_visit(visit, out)
    return out


@pytest.fixture(scope="module")
def two() -> Visit:
    return visit_called("two trials")


@pytest.fixture
def saved(two: Visit, tmp_path: Path) -> Path:
    """The folder of a visit of two trials, to be changed."""
    save_visit(two, tmp_path / "P017")
    return tmp_path / "P017"


# ---------------------------------------------------------------------------------------------------------- round trip
def test_a_visit_comes_back_from_its_folder(visit: Visit, folder: Path) -> None:
    loaded = load_visit(folder)
    assert loaded.lacks == ()
    assert_same(as_stored(visit), loaded)
    assert loaded.judged == loaded.measures


def test_the_visits_of_these_tests_have_what_is_to_come_back() -> None:
    """Else the comparison of a round trip compares nothing."""

    def cycles(name: str) -> tuple[GaitCycle, ...]:
        return visit_called(name).recordings[0].cycles

    one = visit_called("one trial")
    assert one.measures is not None
    assert one.measures.gdi.sd is not None
    assert one.measures.gdi.profile is not None
    assert all(c.curves and c.curves_sd for c in one.recordings[0].cycles)
    assert {c.check for c in one.checks} >= {"time_stretch", "residual_3d_cm", "scale"}
    assert {c.bout for c in cycles("two bouts")} == {0, 1}
    assert any(c.curves_missing for c in cycles("curves missing"))
    assert any(c.curves for c in cycles("curves missing"))
    for name, status in {"no gait": "EMPTY", "a fit that failed": "EMPTY", "one stands": "PASS"}.items():
        assert not_none(visit_called(name).measures).status == status
    fast = not_none(visit_called("another pace").measures)
    assert [t.pooled for t in fast.trials] == [True, False]
    assert not_none(not_none(visit_called("nine angles").measures).gdi.profile).gps is not None


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


@pytest.mark.parametrize("name", ["two trials", "markers"])
def test_every_export_of_the_loaded_visit_is_the_same(name: str, tmp_path: Path) -> None:
    pytest.importorskip("ezc3d")
    pytest.importorskip("pyarrow")
    visit = visit_called(name)
    save_visit(visit, tmp_path / "P017")
    formats = [f for f in FORMATS if f != "forces" and (f != "dlc" or visit.kind != "markers")]
    assert_same_exports(visit, load_visit(tmp_path / "P017"), formats, tmp_path)


# -------------------------------------------------------------------------------- the methods that made the files
def tables_of(folder: Path) -> dict[str, pd.DataFrame]:
    return {p.stem: pd.read_csv(p, keep_default_na=False, na_values=[""]) for p in folder.glob("*.csv")}


def exported(out: Path, *fits: Path, to: str = "csv") -> Path:
    done = pbl("export", *fits, "--to", to, "--out", out)
    assert done.code == 0, done.err
    return out


@pytest.mark.parametrize("how", ["run", "fit"])
def test_an_export_of_files_has_the_methods_that_made_them(how: str, tmp_path: Path) -> None:
    """What metrics.json says is what is exported: not the measures of the default methods."""
    fit = walk("walk")
    visit = visit_of(fit, methods=METHODS)
    save_visit(measured(visit) if how == "run" else visit, tmp_path)
    path, methods = tmp_path / "walk.fit.npz", ("--norm", "gillette-166-three-angles", "--method", "zeni-2008")
    done = pbl("gait", path, "--out", tmp_path / "metrics.json", *methods)
    assert done.code == 0, done.err
    content = json.loads((tmp_path / "metrics.json").read_text())["session"]
    out = exported(tmp_path / "out", path)
    tables = tables_of(out)
    wide = tables["measures_wide"].set_index("scope").loc["session"]
    assert wide["gdi_mean"] == pytest.approx(content["gdi"]["mean"], abs=1e-6)
    for name in ("stance_percent", "stride_time_s", "double_support_percent"):
        assert wide[f"{name}_mean"] == pytest.approx(content[name]["mean"], abs=1e-6)
        assert wide[f"{name}_left"] == pytest.approx(content[name]["left"], abs=1e-6)
    default = gait_metrics([fit])
    stance = default.spatiotemporal["stance_percent"]
    assert stance is not None
    # The two are far enough apart for this test to see the one for the other.
    assert abs(not_none(default.gdi.mean) - content["gdi"]["mean"]) > 0.5
    assert abs(stance.mean - content["stance_percent"]["mean"]) > 0.5
    about = json.loads((out / "export.json").read_text())["trials"]["walk"]
    assert about["event_method"].startswith("zeni-2008")
    assert "gillette-166-three-angles" in about["index_method"]


def test_events_are_exported_as_the_files_have_them(tmp_path: Path) -> None:
    save_visit(visit_of(walk("walk")), tmp_path)
    path = tmp_path / "walk.fit.npz"
    assert pbl("gait", path, "--out", tmp_path / "metrics.json", "--method", "zeni-2008").code == 0
    stored = pd.read_csv(tmp_path / "walk.events.csv")
    found = tables_of(exported(tmp_path / "out", path))["events"]
    np.testing.assert_allclose(found.time_s, stored.time_s, atol=1e-9)
    assert list(found.event) == list(stored.event)
    assert list(found.side) == list(stored.side)
    other = gait_metrics([walk("walk")]).trials[0].events.events
    assert len(other) != len(stored) or np.abs(np.array([e.time_s for e in other]) - stored.time_s).max() > 0.01


def test_some_fits_of_a_visit_are_exported_with_their_own_measures(two: Visit, saved: Path, tmp_path: Path) -> None:
    """The measures of the visit are of all of its trials, so there is no row of it."""
    both = tables_of(exported(tmp_path / "both", saved / "walk.fit.npz", saved / "back.fit.npz"))
    out = exported(tmp_path / "one", saved / "back.fit.npz")
    one = tables_of(out)
    assert set(both["measures_wide"].scope) == {"session", "trial"}
    assert list(one["measures_wide"].scope) == ["trial"]
    assert set(one["measures_long"].scope) == {"trial"}
    for name in ("events", *(f"{of}_{form}" for of in ("measures", "cycles", "curves") for form in ("wide", "long"))):
        own: Any = both[name][both[name].trial == "back"].reset_index(drop=True)
        pd.testing.assert_frame_equal(one[name], own, obj=name)
    # What is known of the whole visit holds for some of its trials.
    about = json.loads((out / "export.json").read_text())["trials"]["back"]
    assert about["fitted_with"] == "0.1.0+gabc"
    assert about["tracking_method"] == METHODS["Tracking"]
    part = visit_of_fits([saved / "back.fit.npz"])
    assert (part.subject, part.label, part.fit_checks) == (two.subject, two.label, two.fit_checks)
    assert part.measures is None


def test_fits_of_several_folders_have_their_own_measures(two: Visit, tmp_path: Path) -> None:
    for name in ("a", "b"):
        save_visit(measured(visit_of(walk("walk", seed=ord(name))), ZENI), tmp_path / name)
    found = visit_of_fits([tmp_path / n / "walk.fit.npz" for n in "ab"])
    assert [r.name for r in found.recordings] == ["walk-1", "walk-2"]
    assert [r.measured.events.method for r in found.recordings if r.measured] == ["zeni-2008"] * 2
    assert (found.measures, found.subject) == (None, "-")
    assert found.fit_checks == FIT_CHECKS


def test_pbl_gait_beside_the_fits_makes_a_whole_folder(tmp_path: Path) -> None:
    """`pbl fit`, then `pbl gait`: events, cycles and measures belong together, and the visit lacks nothing."""
    save_visit(visit_of(walk("walk"), walk("back", seed=9)), tmp_path)
    assert load_visit(tmp_path).lacks == (
        "no metrics.json: `pbl gait *.fit.npz --out metrics.json` in its folder writes it",
    )
    fits = [tmp_path / f"{n}.fit.npz" for n in ("walk", "back")]
    assert pbl("gait", *fits, "--out", tmp_path / "metrics.json").code == 0
    found = load_visit(tmp_path)
    assert found.lacks == ()
    assert not_none(found.measures).trials == tuple(r.measured for r in found.fitted)
    expected = measured(visit_of(walk("walk"), walk("back", seed=9)))
    assert_same([r.cycles for r in expected.fitted], [r.cycles for r in found.fitted])
    # Elsewhere it writes metrics.json alone.
    (tmp_path / "other").mkdir()
    assert pbl("gait", *fits, "--out", tmp_path / "other" / "metrics.json", "--method", "zeni-2008").code == 0
    assert [p.name for p in (tmp_path / "other").iterdir()] == ["metrics.json"]
    assert_same(found, load_visit(tmp_path))


# ------------------------------------------------------------------------------------------------------------ bad input
def changed(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def make_old(folder: Path) -> None:
    """The files as version 0.1 wrote them before visits were read back (commit 2e66321)."""

    def of_part(part: dict[str, Any]) -> None:
        del part["cycles"]["steps"]
        for name in ("n_left", "n_right", "params_hash"):
            del part["gdi"][name]

    def of_metrics(content: dict[str, Any]) -> None:
        of_part(content["session"])
        del content["session"]["qc_before_gait"]
        for trial in content["trials"]:
            of_part(trial)
            del trial["events"], trial["gait_cycles"], trial["pooled"], trial["gdi"]["cycles"]

    changed(folder / "metrics.json", of_metrics)
    changed(folder / "session.json", lambda content: (content.pop("visit"), content.pop("result")))
    for path in folder.glob("*.cycles.npz"):
        path.unlink()


def test_a_folder_of_an_older_version_is_read_and_says_what_it_lacks(two: Visit, saved: Path) -> None:
    make_old(saved)
    found = load_visit(saved)
    again = "`pbl gait *.fit.npz --out metrics.json` in its folder writes it"
    assert found.lacks == (
        "facts of the videos, the subject and the methods: `pbl run` again",
        f"no walk.cycles.npz: {again}",
        f"no back.cycles.npz: {again}",
    )
    assert (found.subject, found.methods) == ("-", {})
    assert_same(dataclasses.replace(not_none(two.solution), result=None), found.solution)
    assert [(r.name, r.video, r.choice, r.cycles) for r in found.fitted] == [
        ("walk", None, None, ()),
        ("back", None, None, ()),
    ]
    assert found.measures is not None
    assert two.judged is not None
    assert found.measures.outcome == two.judged.outcome
    assert found.measures.checks == tuple(dict.fromkeys(two.judged.checks))
    assert_same(two.judged.spatiotemporal.measures, found.measures.spatiotemporal.measures)
    assert found.measures.gdi.mean == pytest.approx(two.judged.gdi.mean, abs=ROUNDED[Gdi])
    for recording, before in zip(found.fitted, two.fitted, strict=True):
        events = [dataclasses.replace(e, bout=0) for e in not_none(before.events).events]
        assert_same(tuple(events), not_none(recording.measured).events.events)
        assert_same(before.fit, recording.fit)
    page = dict(leaves(page_of(found, {}, "Visit")))
    assert page["/measures/0/mean"] == dict(leaves(page_of(two, {}, "Visit")))["/measures/0/mean"]


def test_tables_of_an_older_folder_are_refused_until_its_cycles_are_there(saved: Path, tmp_path: Path) -> None:
    """Recomputed silently they would be by the default methods; without cycles they would look complete."""
    make_old(saved)
    fits = [saved / "walk.fit.npz", saved / "back.fit.npz"]
    for formats in ("csv", "parquet"):
        done = pbl("export", *fits, "--to", formats, "--out", tmp_path / "out")
        assert done.error_code == "EXPORT_INPUT", done.err
        assert "gait cycles" in done.err
        assert "pbl gait *.fit.npz --out metrics.json" in done.err
        assert not (tmp_path / "out").exists()
    exported(tmp_path / "mot", *fits, to="mot")  # needs no gait
    assert pbl("gait", *fits, "--out", saved / "metrics.json", "--method", "zeni-2008").code == 0
    found = tables_of(exported(tmp_path / "out", *fits))
    assert set(found["cycles_wide"].trial) == {"walk", "back"}
    assert len(found["curves_wide"]) == 51 * len(found["cycles_wide"])


def test_the_events_of_an_older_folder_are_enough_for_c3d(two: Visit, saved: Path, tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    make_old(saved)
    out = exported(tmp_path / "out", saved / "walk.fit.npz", to="c3d")
    group = ezc3d.c3d(str(out / "walk" / "walk.c3d"))["parameters"]["EVENT"]
    times = [e.time_s for e in not_none(two.recordings[0].events).events]
    np.testing.assert_allclose(group["TIMES"]["value"][1], times, atol=1e-4)
    (saved / "walk.events.csv").unlink()
    done = pbl("export", saved / "walk.fit.npz", "--to", "c3d", "--out", tmp_path / "none")
    assert done.error_code == "EXPORT_INPUT"
    assert "gait events" in done.err


@pytest.mark.parametrize(
    ("file", "lacks", "gone"),
    [
        ("metrics.json", "no metrics.json: `pbl gait", "measures"),
        ("back.events.csv", "no back.events.csv: `pbl gait", "events"),
        ("back.cycles.npz", "no back.cycles.npz: `pbl gait", "curves"),
        ("back.keypoints.npz", "no back.keypoints.npz: `pbl run` again", "keypoints"),
        ("back.fit.npz", "no back.fit.npz: `pbl run` again", "fit"),
    ],
)
def test_a_folder_half_written_shows_what_is_there(two: Visit, saved: Path, file: str, lacks: str, gone: str) -> None:
    (saved / file).unlink()
    found = load_visit(saved)
    (lack,) = found.lacks
    assert lack.startswith(lacks)
    walked = recording_of(found, "walk")
    assert_same(fields(recording_of(as_stored(two), "walk"))["fit"], walked.fit)
    assert_same(keypoints_of(walk("walk")), walked.keypoints)
    assert [r.name for r in found.fitted] == (["walk"] if gone == "fit" else ["walk", "back"])
    assert (found.measures is None) is (gone == "measures")
    if gone in ("measures", "fit"):
        assert {c.check for c in found.checks} >= {"residual_3d_cm"}
        return
    back = recording_of(found, "back")
    assert (back.keypoints is None) is (gone == "keypoints")
    assert (back.events is not None and back.events.events == ()) is (gone == "events")
    assert [bool(c.curves) for c in back.cycles] == [gone != "curves"] * len(recording_of(two, "back").cycles)
    assert page_of(found, {}, "Visit")["measures"]


@pytest.mark.parametrize(("file", "what"), [("back.events.csv", "gait events"), ("back.cycles.npz", "gait cycles")])
def test_tables_without_what_a_half_written_folder_lacks_are_refused(
    saved: Path, tmp_path: Path, file: str, what: str
) -> None:
    (saved / file).unlink()
    done = pbl("export", saved / "walk.fit.npz", saved / "back.fit.npz", "--to", "csv", "--out", tmp_path / "out")
    assert done.error_code == "EXPORT_INPUT"
    assert what in done.err


@pytest.mark.parametrize("file", ["session.json", "metrics.json", "walk.events.csv", "walk.cycles.npz"])
@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"null", b'{"trials": [1]}', b"PK\x03\x04", b"\xff\xfe"])
def test_a_damaged_file_is_a_coded_error_that_names_it(saved: Path, file: str, content: bytes) -> None:
    (saved / file).write_bytes(content)
    with pytest.raises(PblError, match="FILE_FORMAT") as caught:
        load_visit(saved)
    assert caught.value.key == str(saved / file)


def test_a_folder_without_a_visit_is_a_coded_error(tmp_path: Path) -> None:
    with pytest.raises(PblError, match="FILE_MISSING") as caught:
        load_visit(tmp_path)
    assert caught.value.key == str(tmp_path / "session.json")


@pytest.mark.slow
@pytest.mark.parametrize("file", ["session.json", "metrics.json"])
def test_a_value_of_another_type_never_ends_without_a_code(tmp_path: Path, file: str) -> None:
    """Each place of the file with three of these values: what is read is shown, or the error is coded."""
    save_visit(visit_called("one left out"), tmp_path)
    path, refused = tmp_path / file, 0
    content = json.loads(path.read_text())
    # One of the values that lists and measures have alike.
    places = {re.sub(r"/\d+", "/#", re.sub("|".join(MEASURES), "#", where)): where for where, _ in leaves(content)}
    assert len(places) > 60
    values = ("words", None, -1, [3], {"a": 1}, True)
    for i, where in enumerate(places.values()):
        *above, last = [int(k) if k.isdigit() else k for k in where.split("/")[1:]]
        for j in range(i, i + 3):
            value = values[j % len(values)]
            damaged = json.loads(json.dumps(content))
            functools.reduce(lambda part, key: part[key], above, damaged)[last] = value
            path.write_text(json.dumps(damaged))
            try:
                found = load_visit(tmp_path)
                assert not_none(found.measures).table()
                if i == j:  # a page takes ten times as long
                    page_of(found, {}, "Visit")
            except PblError:
                refused += 1
            except Exception as error:
                raise AssertionError(f"{where} = {value!r}: {type(error).__name__}: {error}") from error
    assert refused > len(places)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "1e999"])
@pytest.mark.parametrize(("file", "part"), [("session.json", ("qc",)), ("metrics.json", ("session", "qc"))])
def test_a_check_that_is_not_a_number_is_refused(saved: Path, file: str, part: tuple[str, ...], number: str) -> None:
    def set_value(content: Any) -> None:
        for key in (*part, 0):
            content = content[key]
        content["value"] = 123.25

    path = saved / file
    changed(path, set_value)
    path.write_text(path.read_text().replace("123.25", number))
    with pytest.raises(PblError, match="FILE_FORMAT") as caught:
        load_visit(saved)
    assert caught.value.key == str(path)


def test_measures_of_other_trials_are_refused(saved: Path, tmp_path: Path) -> None:
    done = pbl("gait", saved / "walk.fit.npz", "--out", saved / "metrics.json")  # of one of two
    assert done.code == 0, done.err
    with pytest.raises(PblError, match="FILE_FORMAT") as caught:
        load_visit(saved)
    assert "measures of walk" in caught.value.found
    assert "pbl gait *.fit.npz --out metrics.json" in caught.value.next_step
    exported(tmp_path / "out", saved / "back.fit.npz", to="mot")  # needs no measures
    fits = [saved / "walk.fit.npz", saved / "back.fit.npz"]
    assert pbl("gait", *fits, "--out", saved / "metrics.json").code == 0
    assert load_visit(saved).lacks == ()


def test_measures_of_an_earlier_fit_are_refused(two: Visit, saved: Path) -> None:
    """`pbl fit` again into the folder of `pbl run`: metrics.json is of the fit before."""
    fits = [r.fit for r in two.fitted if r.fit is not None]
    checks = (dataclasses.replace(FIT_CHECKS[0], value=5.5), *FIT_CHECKS[1:])
    save_visit(Visit(tuple(Recording.of(f.name, f) for f in fits), solution_of(fits[0]), checks), saved)
    with pytest.raises(PblError, match="FILE_FORMAT") as caught:
        load_visit(saved)
    assert "another fit" in caught.value.found
    assert "residual_3d_cm" in caught.value.found
    assert load_visit(saved, measures=False).fit_checks == checks
    assert pbl("gait", *sorted(saved.glob("*.fit.npz"), reverse=True), "--out", saved / "metrics.json").code == 0
    assert set(checks) <= set(not_none(load_visit(saved).measures).before)


def test_measures_of_other_recordings_do_not_make_a_visit(two: Visit) -> None:
    for others in ([stand("stand")], [walk("back"), walk("walk")], [walk("walk")]):
        with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
            two.with_measures(gait_metrics(others))


@pytest.mark.parametrize("change", [{"params_hash": "of another fit"}, {"trials": ["another"]}])
def test_a_session_file_of_another_fit_says_nothing_of_this_one(saved: Path, change: dict[str, Any]) -> None:
    changed(saved / "session.json", lambda content: content.update(change))
    found = visit_of_fits([saved / "walk.fit.npz"], measures=False)
    (check,) = found.fit_checks
    assert (check.check, check.outcome, check.value) == ("fit_checks_known", WARN, 1.0)
    assert "no session.json of walk" in check.advice
    assert (found.solution, found.subject, found.recordings[0].measured) == (None, "-", None)
    assert found.recordings[0].keypoints is not None


def test_keypoints_of_another_recording_are_not_those_of_a_fit(saved: Path) -> None:
    keypoints_of(walk("walk", n=90)).save(saved / "walk.keypoints.npz")
    found = recording_of(load_visit(saved), "walk")
    assert found.keypoints is None
    assert found.video is not None
    assert np.isnan(found.video.time_s).all()
    assert found.video.n_frames == 200


def test_fits_alone_are_a_visit_without_checks(tmp_path: Path) -> None:
    walk("walk").save(tmp_path / "walk.fit.npz")
    found = visit_of_fits([tmp_path / "walk.fit.npz"])
    assert [c.check for c in found.fit_checks] == ["fit_checks_known"]
    assert [(r.name, r.fitted, r.keypoints, r.measured) for r in found.recordings] == [("walk", True, None, None)]


def test_a_visit_that_was_never_fitted_is_saved_and_read(tmp_path: Path) -> None:
    save_visit(Visit((dark(),), subject="P017", methods=METHODS), tmp_path)
    found = load_visit(tmp_path, measures=False)
    assert_same(as_stored(Visit((dark(),), subject="P017", methods=METHODS)), found)
    assert found.solution is None


def test_a_check_that_fails_in_a_recording_without_a_cycle_that_counts_is_a_warning(two: Visit):
    judged = not_none(two.judged)
    walk, back = judged.trials
    idle = dataclasses.replace(back, cycles=())
    for name, trials, outcome in (
        ("back", (walk, idle), WARN),
        ("walk", (walk, idle), FAIL),
        ("back", (walk, back), FAIL),
        ("back", (dataclasses.replace(walk, cycles=()), idle), FAIL),  # not known which counts
    ):
        failed = Check(f"feet_cut_share ({name})", FAIL, 0.4, 0.3, "step back")
        assert dataclasses.replace(judged, trials=trials, before=(failed,), qc=()).outcome == outcome, (name, trials)
