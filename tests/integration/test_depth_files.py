"""Depth recordings in the tables: each is part of the fit of its visit, which is computed anew with or without it."""

import dataclasses
import errno
import os
import tempfile
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline import depth
from pbl_pipeline.depth import DepthFile, sha256_of_recording
from pbl_pipeline.files import sha256_of
from pbl_pipeline.fit import session_fit
from pbl_pipeline.synthetic import SynthSpec, synthesise
from pbl_pipeline.visit.files import visit_facts
from pbl_schemas import fit, load_visit, video
from pbl_schemas.intake import Sensors, VisitRecord, ingest, registration
from pbl_schemas.job_errors import stored_error
from pbl_schemas.reading.visit_list import results_of
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers.populate import populate
from research.walker.depths import depth_recording
from tests import StandIn, not_none
from tests.command import pbl
from tests.integration import chain
from tests.integration.test_tables import errors
from tests.rows import late_fit
from tests.unit.test_depth import write

pytestmark = pytest.mark.usefixtures("tables")


def ingested(*args: object) -> str:
    told = pbl("ingest", *args, "--subject", "P001")
    assert told.code == 0, told.err
    return told.out


def fitted() -> tuple[float, list[tuple[str, str]]]:
    """Scale of the fit that is pending, and the recordings behind it."""
    assert len(fit.SessionFit()) == 0
    assert not errors(populate())
    rows = fit.SessionFit.Depth.to_dicts(order_by="video_id")
    return fit.SessionFit.fetch1("fit_scale")[0], [(r["depths_name"], r["depths_sha256"]) for r in rows]


def test_a_depth_recording_is_part_of_the_fit_of_its_visit(tmp_path: Path):
    one, two = (chain.small_video(tmp_path, name) for name in ("a", "b"))
    folder = chain.depth_pictures(tmp_path / "depth")
    sha256 = sha256_of_recording(folder)
    ingested(one, two)
    assert fitted() == (1.0, [])
    given = f"0.001={folder}"
    assert "deleted: 1 of `pbl_fit`.`__session_fit`" in ingested(one, "--depth", given)
    row = video.DepthVideo.fetch1()
    assert (row["depth_name"], row["depth_sha256"], row["depth_scale"]) == ("depth", sha256, 0.001)
    assert fitted() == (3.0, [("depth", sha256)])
    found = fit.SessionFit.Depth.fetch1()
    assert (found["depths_used"], found["depths_distance"], found["depths_metre"]) == (0.6, 0.93, 3.0)
    # The visit names it as `pbl run` does.
    visit = load_visit({"subject": "P001"})
    depths = visit_facts(visit)["depths"]
    assert {name: (d["name"], d["sha256"]) for name, d in depths.items()} == {"a": ("depth", sha256)}
    (filmed,) = (r.filming for of in results_of([1]).values() for r in of)
    assert filmed == visit.filming
    assert visit.filming.height == ("depths",)
    # The same again changes nothing, another scale and another video do.
    assert "nothing was inserted" in ingested(one, "--depth", given)
    assert len(fit.SessionFit()) == 1
    assert "was replaced" in ingested(one, "--depth", f"0.0005={folder}")
    assert fitted() == (1.5, [("depth", sha256)])
    ingested(one, two, "--depth", "none", "--depth", f"0.001={folder}")
    assert [int(v) for v in video.DepthVideo.to_arrays("video_id")] == [2]
    assert fitted() == (3.0, [("depth", sha256)])
    assert fit.SessionFit.Depth.fetch1("video_id") == 2
    assert "the depth recording was removed" in ingested(two, "--depth", "none")
    assert fitted() == (1.0, [])
    assert len(video.DepthVideo()) == 0


def test_a_recording_that_cannot_be_read_deletes_nothing(tmp_path: Path):
    pytest.importorskip("lzfse")
    one, folder = chain.small_video(tmp_path, "a"), chain.depth_pictures(tmp_path / "depth")
    (tmp_path / "broken.r3d").write_bytes(b"no zip")
    (tmp_path / "walk\u202efdp").symlink_to(folder)
    ingested(one, "--depth", f"0.001={folder}")
    fitted()
    for given, code, found in (
        (folder, "DEPTH_FILE", "no recording of Stray Scanner"),
        (f"0={folder}", "DEPTH_FILE", "a scale of 0 m"),
        (f"0.001={one}", "DEPTH_FILE", "no folder or zip"),
        (f"0.001={tmp_path / 'broken.r3d'}", "DEPTH_FILE", "a scale for a file"),
        (tmp_path / "broken.r3d", "DEPTH_FILE", "no recording of Record3D"),
        (f"0.001={tmp_path / 'walk'}\u202efdp", "USAGE", "depth recording"),
    ):
        told = pbl("ingest", one, "--subject", "P001", "--depth", given)
        assert (told.code, told.error_code) == (1, code), given
        assert found in told.err
    assert len(fit.SessionFit()) == len(video.DepthVideo()) == 1


def test_a_folder_is_packed_once_and_outside_the_transaction(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """What is stored has the hash of its row, also where the folder changes meanwhile."""
    path, folder = chain.small_video(tmp_path, "a"), chain.depth_pictures(tmp_path / "depth")
    sha256, work = sha256_of_recording(folder), registration.keep_files

    def changed(*args, **named):
        (folder / "0.png").write_bytes(b"other pictures")
        return work(*args, **named)

    monkeypatch.setattr(registration, "keep_files", changed)
    ingested(path, "--depth", f"0.001={folder}")
    assert sha256_of_recording(folder) != sha256
    row = video.DepthVideo.fetch1()
    with stored_file(file_ref(row["depth_file"])) as kept:
        assert row["depth_sha256"] == sha256_of(kept) == sha256
        assert row["depth_size"] == kept.stat().st_size
    assert not list(Path(tempfile.gettempdir()).glob(f"pbl-tmp-{os.getpid()}-*/*.zip"))


@pytest.mark.parametrize(
    ("number", "code"), [(errno.ENOSPC, "STORE_FULL"), (errno.EACCES, "FILE_MISSING"), (errno.ENOENT, "FILE_MISSING")]
)
def test_a_folder_that_cannot_be_packed_stops_no_other_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, code: str
):
    paths = [chain.small_video(tmp_path, name) for name in ("a", "b")]
    bad, good = (chain.depth_pictures(tmp_path / name) for name in ("bad", "good"))
    pack = depth.pack

    def failing(folder: Path, copy: Path) -> Path:
        pack(folder, copy)
        if folder == bad:
            raise OSError(number, os.strerror(number), folder / "0.png")
        return copy

    monkeypatch.setattr(depth, "pack", failing)
    files = [Sensors(depth=DepthFile(folder, 0.001)) for folder in (bad, good)]
    refused, other = ingest(paths, VisitRecord("P001"), files=files)
    assert (not_none(refused.error).code, other.status) == (code, "registered")
    assert [str(name) for name in video.DepthVideo.to_arrays("depth_name")] == ["good"]
    assert not list(Path(tempfile.gettempdir()).glob(f"pbl-tmp-{os.getpid()}-*/*.zip"))


def test_a_wrong_recording_is_an_error_of_its_own_fit(tmp_path: Path):
    one, two = (chain.small_video(tmp_path, name) for name in ("a", "b"))
    empty = chain.depth_pictures(tmp_path / "zeros", 0.0)
    few = chain.depth_pictures(tmp_path / "few", n=3)
    assert pbl("ingest", two, "--subject", "P002").code == 0
    for given, found in (
        (f"0.001={empty}", "depths of 0 in all pictures"),
        (f"0.001={few}", "3 depth pictures for"),
    ):
        ingested(one, "--depth", given)
        assert errors(populate()) == {"SessionFit": {"DEPTH_FILE": 1}}
        (row,) = fit.SessionFit.jobs.errors.to_dicts()
        error = stored_error(row["error_message"])
        assert found in error.found
        assert error.expected
        assert "leave it out" in error.next_step
        assert error.key == Path(str(given).rpartition("=")[2]).name  # not its copy in the store
        assert len(fit.SessionFit()) == 1  # of the other person
    ingested(one, "--depth", "none")
    assert not errors(populate())
    assert len(fit.SessionFit()) == 2


def test_a_fit_without_the_depths_is_not_inserted_after_them(tmp_path: Path):
    path, folder = chain.small_video(tmp_path, "a"), chain.depth_pictures(tmp_path / "depth")
    ingested(path, "--depth", f"0.001={folder}")
    assert fitted()[0] == 3.0
    late_fit(video.DepthVideo, "depth recordings")
    assert fitted() == (1.0, [])


def test_files_of_another_kind_are_kept_and_not_read(tmp_path: Path):
    path, film = chain.small_video(tmp_path, "a"), tmp_path / "depth.mov"
    film.write_bytes(b"a film of depths")
    ingested(path)
    fitted()
    assert "kept and not read" in ingested(path, "--depth", film)
    assert not video.DepthVideo.fetch1("depth_read")
    assert len(fit.SessionFit()) == 1
    # As one that was registered before recordings were read.
    video.DepthVideo.update1({"video_id": 1, "depth_read": None})
    assert "nothing was inserted" in ingested(path, "--depth", film)
    assert not populate().did_something


@pytest.mark.long
@pytest.mark.slow
def test_a_real_fit_with_depths_has_their_metres(tmp_path: Path, stand_in: StandIn):
    """Pictures of the walker as 16-bit PNG, with a scale that is 1.1 times too large, through intake, store and fit."""
    made = synthesise(SynthSpec(view="frontal", seconds=1.5, marker_set="blazepose_33", seed=511))
    points, n = made.keypoints, len(made.truth.time_s)
    recording = depth_recording(made.truth, points, 511)
    pictures = [1000 * np.nan_to_num(depth) for depth, _ in recording.read(range(n))]
    folder = write(tmp_path / "depth", lambda i: pictures[i].clip(0, 65535).astype(np.uint16), n)

    def detect_keypoints(video_path, tracking, person_id, camera, params=None):
        return dataclasses.replace(points, time_s=tracking.time_s)

    stand_in(detect_keypoints=detect_keypoints, fit_session=session_fit.fit_session)
    path = chain.small_video(tmp_path, "a", n)
    ratios = list[float]()
    for given in ("none", f"0.0011={folder}"):
        ingested(path, "--depth", given)
        assert not errors(populate(["VideoInfo", "Tracking", "SubjectChoice", "Keypoints", "TrialInput", "SessionFit"]))
        (trial,) = load_visit({"subject": "P001"}).fitted
        found = not_none(trial.fit)
        hip = found.marker_names.index("left_hip")
        away = (np.linalg.norm(x[:, hip], axis=1) for x in (found.markers_world_m, made.truth.markers_world_m))
        ratios.append(float(np.nanmedian(np.divide(*away))))
    assert ratios == pytest.approx([1.0, 1.1], abs=0.02)
    row = fit.SessionFit.Depth.fetch1()
    assert row["depths_used"] > 0.3
    checks = {c["fit_check"] for c in fit.SessionFit.Check.to_dicts()}
    assert {"depth_distance_ratio", "depth_share_used", "depth_share_on_person", "depth_misfit_sd"} < checks
