"""A registered keypoint model through the tables: its method row, its keypoints, and what happens when it changes."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import pbl_schemas
from pbl_pipeline import methods, models
from pbl_pipeline.body import marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import EVENT_METHODS, EventParams
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.records import plain
from pbl_pipeline.tracking import PersonTrack, Tracking
from pbl_pipeline.video import probe
from pbl_schemas import fit, gait, gdi, keypoints, tracking
from pbl_schemas.intake import Methods, VisitRecord, ingest
from pbl_schemas.method_rows import insert_methods, resolve_method
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers import queue, requeue
from pbl_workers.populate import populate
from tests import Environment, StandIn, dot_models
from tests.rows import remove_all
from tests.videos import constant_rate, write_video

from . import chain

N = 36


def xy_px() -> np.ndarray:
    people = [dot_models.turned(dot_models.person(), a) for a in np.linspace(0.0, 0.4, N)]
    return np.stack([dot_models.project(x, dot_models.lens()) for x in people])


def track_people(video_path, params=None, info=None) -> Tracking:
    """Stands in for the people detector, which knows no dots: one person, where she is."""
    xy = xy_px()
    low, high = xy.min(axis=1), xy.max(axis=1)
    box = np.concatenate([low - 20, high + 20], axis=1)
    track = PersonTrack(1, box, np.full((N, 4), np.nan), np.full(N, 0.9), np.ones(N, bool))
    return Tracking((info or probe(video_path)).time_s, (960, 720), (track,), "by hand", "0" * 64)


@pytest.fixture
def tables(database: Path, stand_in: StandIn, environment: Environment, tmp_path: Path) -> Iterator[None]:
    """Empty tables, a registry of its own, the people where they are."""
    pbl_schemas.activate()
    environment(PBL_MODELS=tmp_path / "models")
    stand_in(track_people=track_people)
    yield
    remove_all()
    # Other tests count the method rows of the project.
    ours = " or ".join(f"keypoint_method_name LIKE '{n}%'" for n in ("dots-", *SEEN_BY))
    (keypoints.KeypointMethod & ours).delete(prompt=False)


def test_a_registered_model_is_a_method_of_the_tables(tables: None, tmp_path: Path):
    video = write_video(
        tmp_path / "dots.mp4", (dot_models.picture(p) for p in xy_px()), constant_rate(N), pixel_format="yuv444p", crf=8
    )
    lens = dot_models.lens()
    camera = tmp_path / "camera.json"
    fields = {"camera_matrix": lens.matrix.tolist(), "distortion": lens.distortion.tolist()}
    camera.write_text(json.dumps(fields | {"image_size_px": [960, 720]}))
    visit = VisitRecord(subject="P001", camera_file=camera)
    with pytest.raises(PblError, match=r"^SOLVER_UNKNOWN: "):
        ingest([video], visit, Methods(keypoint="dots-crop3d"))

    model = dot_models.crop3d(dot_models.person())
    folder = dot_models.write(tmp_path / "dots", model, dot_models.spec("crop3d"))
    spec, _ = models.add(folder)
    (result,) = ingest([video], visit, Methods(keypoint="dots-crop3d"))
    assert result.status == "registered"
    populate()
    row = (keypoints.Keypoints & {"video_id": result.video_id}).fetch1()
    assert row["keypoint_method"] == "dots-crop3d-v1"
    assert (row["marker_set"], row["n_points"], row["n_seen"]) == ("dots_10", 10, N)
    assert not row["root_relative"]
    assert row["keypoints_model_sha256"] == spec.sha256
    assert row["median_confidence"] == pytest.approx(0.95, abs=0.01)
    with stored_file(file_ref(row["keypoints_file"])) as path:
        stored = Keypoints.load(path)
    assert np.median(np.linalg.norm(stored.xy_px - xy_px(), axis=2)) < 0.5
    assert "licence: CC0-1.0" in stored.origin
    params = (keypoints.KeypointMethod & {"keypoint_method": "dots-crop3d-v1"}).fetch1("keypoint_params")
    assert params["model"]["licence"] == "CC0-1.0, a test"

    # The same model again is the same method; another one under the name is the next version.
    assert resolve_method(keypoints.KeypointMethod, "dots-crop3d") == "dots-crop3d-v1"
    dot_models.write(tmp_path / "dots", model, dot_models.spec("crop3d", box_margin=1.2))
    models.add(folder, replace=True)
    assert resolve_method(keypoints.KeypointMethod, "dots-crop3d") == "dots-crop3d-v2"
    # What names the old one is not computed with the new one.
    (keypoints.Keypoints & {"video_id": result.video_id}).delete(prompt=False)
    run = populate()
    assert {t.table: t.errors for t in run.tables if t.table == "Keypoints"} == {"Keypoints": {"MODEL_CHECKSUM": 1}}


def register_spec(folder: Path, kind: str, markers: str, name: str) -> None:
    """A model of these points, as far as planning asks: nobody runs it here."""
    names = list(marker_set(markers).names)
    fields = dot_models.spec(kind, (32, 32), name=name, marker_set=markers, joint_names=names) | {"sha256": "1" * 64}
    (folder / name).mkdir(parents=True)
    (folder / name / "model.json").write_text(json.dumps(fields))


def plans() -> set[tuple[str, str]]:
    return {(r["keypoint_method"], r["fit_method"]) for r in fit.FitPlan.to_dicts()}


def fitted() -> set[tuple[str, str]]:
    """Which keypoints the sets that are fitted now hold, and by which method."""
    current = fit.FitSet.Video * (fit.FitSelection & {"fit_current": True})
    return {(r["keypoint_method"], r["fit_method"]) for r in current.to_dicts()}


SEEN_BY = {
    "metrabs-87": ("crop3d", "bml_movi_87"),
    "flat-87": ("simcc", "bml_movi_87"),
    "few-17": ("crop3d", "mpi_inf_3dhp_17"),
}
BLAZEPOSE, GAUSS_NEWTON, MARKERS = (
    methods.of_stage("fit")[name].key for name in ("blazepose", "gauss-newton", "markers")
)
HEAVY = methods.of_stage("keypoints")["blazepose-heavy"].key
DEFAULT_FITS = {
    (HEAVY, BLAZEPOSE),
    ("metrabs-87-v1", GAUSS_NEWTON),
    ("flat-87-v1", BLAZEPOSE),
    ("few-17-v1", BLAZEPOSE),
}


def test_the_fit_that_suits_the_points_is_planned(tables: None, tmp_path: Path, stand_ins: None):
    """As `pbl run` chooses (tests/unit/test_models.py): of one visit each keypoint method has its own fit."""
    for name, (kind, markers) in SEEN_BY.items():
        register_spec(tmp_path / "models", kind, markers, name)
    path = chain.small_video(tmp_path, "walk")
    notes = [ingest([path], VisitRecord("P001"), Methods(keypoint=name))[0].note for name in SEEN_BY]
    assert "FitPlan" in notes[-1]
    ingest([chain.small_video(tmp_path, "again")], VisitRecord("P001"))
    assert plans() == DEFAULT_FITS
    populate()
    assert fitted() == DEFAULT_FITS
    assert len(fit.SessionFit()) == len(DEFAULT_FITS)
    # Who names a fit method means all keypoints of the visit, or those that are named with it.
    ingest([path], VisitRecord("P001"), Methods(keypoint="few-17", fit="paper-2025"))
    assert plans() == DEFAULT_FITS | {("few-17-v1", "paper-2025-v2")}
    ingest([path], VisitRecord("P001"), Methods(fit="markers"))
    assert {p for p in plans() if p[1] == MARKERS} == {(p[0], MARKERS) for p in DEFAULT_FITS}


def test_a_new_keypoint_method_for_all_comes_with_its_fit(tables: None, tmp_path: Path, stand_ins: None):
    register_spec(tmp_path / "models", "crop3d", "bml_movi_87", "metrabs-87")
    for subject in ("P001", "P002"):
        ingest([chain.small_video(tmp_path, subject)], VisitRecord(subject))
    for _ in requeue.carry_out(requeue.plan_new_method("Keypoints", "metrabs-87")):
        pass
    assert plans() == {(HEAVY, BLAZEPOSE), ("metrabs-87-v1", GAUSS_NEWTON)}
    assert len(fit.FitPlan()) == 4
    populate()
    assert fitted() == plans()


def test_own_parameters_under_a_name_of_their_own(tables: None, tmp_path: Path, stand_ins: None):
    """As docs/extending.md says: the row names its family, so the tables find its function."""
    ingest([chain.small_video(tmp_path, "walk")], VisitRecord("P001"))
    mine = EVENT_METHODS.make("mine", 1, EventParams(cutoff_hz=4.0))
    insert_methods(gait.GaitEventMethod, [mine])
    assert list(requeue.carry_out(requeue.plan_new_method("GaitEvents", "mine"))) == [1]
    populate()
    rows = {r["gait_method"]: r for r in gait.GaitEvents.to_dicts()}
    assert (rows["mine-v1"]["events_detector"], rows["mine-v1"]["events_method_hash"]) == ("mine", mine.hash)
    assert rows["mine-v1"]["n_events"] > 0
    remove_all()
    (gait.GaitEventMethod & {"gait_method": "mine-v1"}).delete(prompt=False)


def test_a_method_that_this_version_does_not_know_is_an_error_row(tables: None, tmp_path: Path, stand_ins: None):
    """Rows of a newer version: each stage ends with the code, at once."""
    ingest([chain.small_video(tmp_path, "walk")], VisitRecord("P001"))
    stages = {
        "Tracking": (tracking.TrackingMethod, {"detector": "newer"}),
        "SubjectChoice": (tracking.SubjectMethod, {"family": "newer"}),
        "Keypoints": (keypoints.KeypointMethod, {"detector": "newer"}),
        "TrialInput": (fit.FitMethod, {"solver": "newer"}),
        "GaitEvents": (gait.GaitEventMethod, {"family": "newer"}),
        "GDI": (gdi.GdiModel, {"family": "newer"}),
    }
    populate()
    tracked = tracking.TrackingSelection.fetch1()
    for name, (table, params) in stages.items():
        prefix = table.primary_key[0].removesuffix("_method")
        known = methods.of_stage(table.stage).find()
        newer = Paramset(table.stage, "newer", 1, plain(known.paramset.params) | params)
        row = {f"{prefix}_method_name": "newer", f"{prefix}_method_version": 1, f"{prefix}_params": newer.params}
        table.insert1({f"{prefix}_method": "newer-v1", **row, f"{prefix}_method_sha": newer.hash})
        if name == "SubjectChoice":
            tracking.TrackingSelection.update1({**tracked, "subject_method": "newer-v1"})
            tracking.SubjectChoice.delete(prompt=False, part_integrity="cascade")
        elif name == "Keypoints":  # whoever plans meets it before
            with pytest.raises(PblError, match="SOLVER_UNKNOWN"):
                requeue.plan_new_method(name, "newer")
            selection = keypoints.KeypointSelection.fetch1()
            keypoints.KeypointSelection.insert1({**selection, "keypoint_method": "newer-v1"})
        else:
            plan = requeue.plan_new_method("SessionFit" if name == "TrialInput" else name, "newer")
            assert list(requeue.carry_out(plan)) == [1]
        found = {t.table: t.errors for t in populate([name]).tables if t.errors}
        assert found == {name: {"SOLVER_UNKNOWN": 1}}
        if name == "SubjectChoice":
            tracking.TrackingSelection.update1(tracked)
            queue.reset(queue.errors_of(tracking.SubjectChoice, None, None))
            populate()
    remove_all()
    for table, _ in stages.values():
        prefix = table.primary_key[0].removesuffix("_method")
        (table & {f"{prefix}_method": "newer-v1"}).delete(prompt=False)
