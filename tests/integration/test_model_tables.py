"""A registered keypoint model through the tables: its method row, its keypoints, and what happens when it changes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import pbl_pipeline.tracking
import schemas
from pbl_pipeline import models
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.tracking import PersonTrack, Tracking
from pbl_pipeline.video import probe
from schemas import keypoints
from schemas.ingest import Methods, Visit, ingest
from schemas.method_rows import resolve_method
from schemas.stored_files import file_ref, stored_file
from tests import dot_models
from tests.rows import remove_all
from tests.videos import constant_rate, write_video
from workers.populate import populate

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
def tables(database: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Empty tables, a registry of its own, the people where they are."""
    schemas.activate()
    monkeypatch.setenv("PBL_MODELS", str(tmp_path / "models"))
    monkeypatch.setattr(pbl_pipeline.tracking, "track_people", track_people)
    yield
    remove_all()
    # Other tests count the method rows of the project.
    (keypoints.KeypointMethod & 'keypoint_method_name LIKE "dots-%"').delete(prompt=False)


def test_a_registered_model_is_a_method_of_the_tables(tables: None, tmp_path: Path):
    video = write_video(
        tmp_path / "dots.mp4", (dot_models.picture(p) for p in xy_px()), constant_rate(N), pixel_format="yuv444p", crf=8
    )
    lens = dot_models.lens()
    camera = tmp_path / "camera.json"
    fields = {"camera_matrix": lens.matrix.tolist(), "distortion": lens.distortion.tolist()}
    camera.write_text(json.dumps(fields | {"image_size_px": [960, 720]}))
    visit = Visit(subject="P001", camera_file=camera)
    with pytest.raises(PblError) as caught:
        ingest([video], visit, Methods(keypoint="dots-crop3d"))
    assert caught.value.code == "SOLVER_UNKNOWN"

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
    with stored_file(keypoints.Keypoints(), file_ref(row["keypoints_file"])) as path:
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
