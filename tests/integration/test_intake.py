"""The contract of registration: whatever names a recording, it is registered once, for one person, with its plans."""

from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_schemas import fit, gait, gdi, keypoints, kinetics, lab, session, tracking, video
from pbl_schemas.intake import LaboratoryMarkers, Methods, SeveralCameras, VisitRecord, ingest, register
from pbl_schemas.intake.recording_sheet import ingest_sheet
from pbl_schemas.intake.registration import resolve
from research.benchmarks.many_recordings import archived, register_many
from tests.command import Done, pbl
from tests.rows import everything_but_refreshes, outcomes

from . import chain, test_markers, test_rigs
from .drop import codes, look

#: Registers the files for a visit; returns "registered", "known" or the code of the error.
Adapter = Callable[[list[Path], VisitRecord], str]


def single(found: Sequence[str]) -> str:
    """The one outcome of all files."""
    (one,) = set(found)
    return one


def printed(done: Done) -> str:
    """The outcome that `pbl ingest` printed."""
    return done.error_code or ("registered" if " registered (" in done.out else "known")


def by_ingest(paths: list[Path], visit: VisitRecord) -> str:
    return single(outcomes(ingest(paths, visit)))


def by_command(paths: list[Path], visit: VisitRecord) -> str:
    return printed(pbl("ingest", *paths, "--subject", visit.subject, "--session", visit.session_label))


def by_name(paths: list[Path], visit: VisitRecord) -> str:
    """The name of a copy states the person."""
    pattern, named = "(?P<subject>.*)=.*", [p.with_name(f"{visit.subject}={p.name}") for p in paths]
    for path, copy in zip(paths, named, strict=True):
        copy.write_bytes(path.read_bytes())
    return printed(pbl("ingest", *named, "--session", visit.session_label, "--name-pattern", pattern))


def by_sheet(paths: list[Path], visit: VisitRecord) -> str:
    sheet = paths[0].parent / "visits.csv"
    rows = (f"{p.name},{visit.subject},{visit.session_label}" for p in paths)
    sheet.write_text("\n".join(("file,subject,visit", *rows)))
    found = ingest_sheet(sheet)
    return single([e.code for e in found.errors] or ["registered" if x.changes else "known" for x in found.lines])


def by_drop_folder(paths: list[Path], visit: VisitRecord) -> str:
    drop, archive = paths[0].parent / "uploads", paths[0].parent / "archive"
    folder = drop / visit.subject / visit.session_label
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        (folder / path.name).write_bytes(path.read_bytes())
    look(drop, archive)
    taken = look(drop, archive)
    return single([*codes(taken).values()] or ["registered" if taken.registered else "known"])


def by_archive(paths: list[Path], visit: VisitRecord) -> str:
    try:
        done = register_many(archived(str(p), sha256_of(p), p.stat().st_size, visit) for p in 2 * paths)
    except PblError as error:
        return error.code
    return "registered" if done["registered"] else "known"


def by_rig(paths: list[Path], visit: VisitRecord) -> str:
    return single(outcomes(register([SeveralCameras(paths, paths[0].parent / "rig.toml", visit)])))


def by_markers(paths: list[Path], visit: VisitRecord) -> str:
    return single(outcomes(register([LaboratoryMarkers(p, visit) for p in paths])))


def one_video(folder: Path) -> list[Path]:
    return [chain.small_video(folder, "walk", n=30)]


def views(folder: Path) -> list[Path]:
    test_rigs.calibration(folder / "rig.toml")
    return test_rigs.rig_videos(folder, n=30)


def markers(folder: Path) -> list[Path]:
    return [test_markers.recording(folder / "walk.npz", seconds=4.0)]


ADAPTERS = {
    "function": (by_ingest, one_video),
    "command": (by_command, one_video),
    "file name": (by_name, one_video),
    "sheet": (by_sheet, one_video),
    "drop folder": (by_drop_folder, one_video),
    "archive": (by_archive, one_video),
    "rig": (by_rig, views),
    "markers": (by_markers, markers),
}


def planned() -> dict[str, set[tuple]]:
    """Methods in the selections and plans."""
    tables = (tracking.TrackingSelection, keypoints.KeypointSelection, fit.FitPlan, fit.MarkerPlan, gait.GaitPlan)
    rows = {t.__name__: t().to_dicts() for t in (*tables, gdi.GdiPlan, kinetics.KineticsPlan)}
    return {
        name: {tuple(v for k, v in sorted(r.items()) if k not in ("video_id", "session_id")) for r in found}
        for name, found in rows.items()
    }


def expected_plans(of_markers: bool) -> dict[str, set[tuple]]:
    """Those of the default methods."""
    of = resolve(Methods(), of_markers)
    after = {"GaitPlan": {(of["gait_method"],)}, "GdiPlan": {(of["gdi_method"], of["norm"])}}
    after |= {"KineticsPlan": {(of["kinetics_method"],)}}
    if of_markers:
        none: dict[str, set[tuple]] = {name: set() for name in ("TrackingSelection", "KeypointSelection", "FitPlan")}
        return {**none, "MarkerPlan": {(of["fit_method"],)}, **after}
    return {
        "TrackingSelection": {(of["subject_method"], of["tracking_method"])},
        "KeypointSelection": {(of["keypoint_method"], of["tracking_method"])},
        "FitPlan": {(of["fit_method"], of["keypoint_method"])},
        "MarkerPlan": set(),
        **after,
    }


@pytest.mark.parametrize("name", ADAPTERS)
def test_a_recording_is_registered_once_for_one_person_with_its_plans(tables: None, tmp_path: Path, name: str):
    adapter, make = ADAPTERS[name]
    paths, visit = make(tmp_path), VisitRecord("P001", "2026-03-01")
    # A code that could be a name is refused before anything is written.
    try:
        refused = adapter(paths, VisitRecord("Jane Doe", "2026-03-01"))
    except PblError as error:
        refused = error.code
    assert refused == "USAGE"
    assert len(video.Video()) == len(session.Session()) == len(lab.Subject()) == 0
    assert adapter(paths, visit) == "registered"
    rows = (video.Video * session.Session.proj("subject", "session_label", "session_date")).to_dicts()
    assert {(r["subject"], r["session_label"], str(r["session_date"])) for r in rows} == {
        ("P001", "2026-03-01", "2026-03-01")
    }
    assert sorted(r["video_sha256"] for r in rows) == sorted(map(sha256_of, paths))
    assert {r["activity"] for r in rows} == {"walking"}
    assert {r["camera_motion"] for r in rows} == {{"rig": "one of several", "markers": "none"}.get(name, "static")}
    assert (lab.Subject & {"subject": "P001"}).fetch1("population") == "unknown"
    assert planned() == expected_plans(name == "markers")
    # The same again changes nothing.
    before = everything_but_refreshes()
    assert adapter(paths, visit) == "known"
    assert everything_but_refreshes() == before
    # The same bytes cannot be another person's.
    assert adapter(paths, VisitRecord("P002", "2026-03-01")) == "VIDEO_DUPLICATE"
    assert everything_but_refreshes() == before
