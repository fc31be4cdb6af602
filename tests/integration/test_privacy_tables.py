"""De-identified copies of registered videos: made where the setting asks for it, shown where it says so, and removed
with their person."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import pbl_schemas
from pbl_pipeline.deidentify import Head, Heads
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.video import VideoInfo, probe
from pbl_schemas import jobs, privacy
from pbl_schemas.operations.forget import forget
from pbl_schemas.reading.status import pipeline_status
from pbl_schemas.reading.why import why
from pbl_schemas.stored_files import file_ref, stored_file
from pbl_workers.populate import populate
from tests import Environment, StandIn
from tests.rows import register, remove_all
from tests.videos import constant_rate, numbered_frames, write_video

N = 12


def find_heads(video: Path, params: object, info: VideoInfo) -> Heads:
    """Stands in for the networks: a head that is held in two frames, or none where the file is called nobody."""
    circle = np.tile(np.array([40.0, 30.0, 12.0]), (N, 1))
    source = np.full(N, 1, np.uint8)
    source[3:5] = 5
    box = np.full((N, 4), np.nan)
    head = Head(circle, source, box, np.zeros((N, 33, 2), np.float32), ())
    return Heads(info.time_s, (info.width_px, info.height_px), () if video.stem == "nobody" else (head,))


@pytest.fixture
def tables(database: Path, stand_in: StandIn) -> Iterator[None]:
    pbl_schemas.activate()
    stand_in(find_heads=find_heads)
    jobs.keys_of.made.pop(privacy.Deidentified, None)
    yield
    remove_all()
    jobs.keys_of.made.pop(privacy.Deidentified, None)  # made once for a process, whose setting does not change


def films(folder: Path, *names: str) -> list[Path]:
    return [
        write_video(folder / f"{name}.mp4", (np.roll(f, i, 1) for f in numbered_frames(N)), constant_rate(N) ** 1.1)
        for i, name in enumerate(names)
    ]


def shown(video_id: int) -> Path | None:
    with privacy.shown(video_id) as path:
        return path


def test_without_the_setting_there_are_no_copies_and_recordings_are_shown_as_they_are(tables, tmp_path: Path):
    (video_id,) = register(*films(tmp_path, "walk"))
    run = populate(["VideoInfo", "Deidentified"])
    assert {t.table: t.done for t in run.tables} == {"VideoInfo": 1, "Deidentified": 0}
    assert {t.table: t.pending for t in pipeline_status().tables}["Deidentified"] == 0
    assert shown(video_id) is None


def test_copies_lie_in_the_store_with_the_frames_to_look_at(tables, tmp_path: Path, environment: Environment):
    environment(PBL_DEIDENTIFY="pixelate")
    paths = films(tmp_path, "walk", "nobody")
    walk, nobody = register(*paths)
    with pytest.raises(PblError, match="pbl populate") as missing:
        shown(walk)
    assert missing.value.code == "DB_NOT_FOUND"
    run = populate(["VideoInfo", "Deidentified"])
    assert {t.table: t.done for t in run.tables} == {"VideoInfo": 2, "Deidentified": 2}

    row = (privacy.Deidentified & {"video_id": walk}).fetch1()
    assert (row["deidentified_how"], row["deidentified_status"]) == ("pixelate", "REVIEW")
    assert row["deidentified_ranges"] == [{"first": 3, "last": 4, "why": ["held"]}]
    assert (row["deidentified_heads"], row["deidentified_uncertain"]) == (1, 2)
    with stored_file(file_ref(row["deidentified_file"])) as path:
        assert sha256_of(path) == row["deidentified_sha256"]
        info = probe(path)
    np.testing.assert_allclose(info.time_s, probe(paths[0]).time_s, atol=1 / 90_000)
    assert shown(walk) == path

    assert (privacy.Deidentified & {"video_id": nobody}).fetch1("deidentified_status") == "NO_HEAD"
    with pytest.raises(PblError, match=r"^HEAD_NOT_FOUND: "):
        shown(nobody)
    (empty,) = [e for e in pipeline_status().empty if e.table == "Deidentified"]
    assert "no head was found" in str(empty)
    assert "Deidentified" in {s.table for s in why(walk).steps}

    environment(PBL_DEIDENTIFY="skeleton")
    with pytest.raises(PblError, match="reprocess"):
        shown(walk)

    forget("P001")
    assert not privacy.Deidentified()
    assert not path.exists()


def test_a_worker_without_the_setting_says_so(tables, tmp_path: Path, monkeypatch, environment: Environment):
    """The machine that queued the job had it, the one that took it has not."""
    environment(PBL_DEIDENTIFY="blur")
    register(*films(tmp_path, "walk"))
    populate(["VideoInfo"])
    jobs.keys_of.made.pop(privacy.Deidentified, None)
    source = privacy.Deidentified().key_source
    monkeypatch.setattr(privacy.Deidentified, "key_source", property(lambda _: source))
    environment(PBL_DEIDENTIFY="")
    run = populate(["Deidentified"])
    assert {t.table: t.errors for t in run.tables} == {"Deidentified": {"USAGE": 1}}


def test_another_word_is_refused(tables, environment):
    environment(PBL_DEIDENTIFY="mosaic")
    with pytest.raises(PblError, match=r"^USAGE: "):
        _ = privacy.Deidentified().key_source
