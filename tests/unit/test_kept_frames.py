"""Pictures that are kept from `probe` for `read_frames`."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.video import frames, frames_kept, kept, probe, read_frames, release_frames
from tests.videos import constant_rate, numbered_frames, write_video


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_video(tmp_path / "a.mp4", numbered_frames(8), constant_rate(8), rotation_deg=90)


def pictures(path: Path) -> list[tuple[int, float, np.ndarray]]:
    return [(f.index, f.time_s, f.image) for f in read_frames(path, 1, 6, 2)]


def decodes(monkeypatch: pytest.MonkeyPatch, path: Path) -> bool:
    opened = []
    real = frames.Decoder
    with monkeypatch.context() as patch:
        patch.setattr(frames, "Decoder", lambda *a: opened.append(a) or real(*a))
        list(read_frames(path))
    return bool(opened)


def test_kept_pictures_are_those_of_the_file(monkeypatch: pytest.MonkeyPatch, video: Path) -> None:
    expected = pictures(video)
    with frames_kept():
        probe(video)
        found = pictures(video)
        assert not decodes(monkeypatch, video)
    for (i, at_s, image), (j, other_s, other) in zip(expected, found, strict=True):
        assert (i, at_s) == (j, other_s)
        np.testing.assert_array_equal(image, other)
    assert decodes(monkeypatch, video)


def test_nothing_is_kept_unless_asked_for(monkeypatch: pytest.MonkeyPatch, video: Path) -> None:
    probe(video)
    assert decodes(monkeypatch, video)


def test_another_file_and_a_changed_one_are_decoded(monkeypatch: pytest.MonkeyPatch, video: Path) -> None:
    other = video.with_name("b.mp4")
    shutil.copy(video, other)
    with frames_kept():
        probe(video)
        assert decodes(monkeypatch, other)
        other.replace(video)
        assert decodes(monkeypatch, video)


def test_a_released_one_and_one_without_room_are_decoded(monkeypatch: pytest.MonkeyPatch, video: Path) -> None:
    with frames_kept():
        probe(video)
        release_frames()
        assert decodes(monkeypatch, video)
        monkeypatch.setattr(kept, "share_of_memory", lambda: 2e5)
        probe(video)
        assert decodes(monkeypatch, video)
