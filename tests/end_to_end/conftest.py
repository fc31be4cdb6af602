"""What the end-to-end tests share: the demo recording and short clips of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from pbl_pipeline import assets, settings
from pbl_pipeline.errors import PblError

from . import clips


@pytest.fixture(scope="session")
def demo_files() -> dict[str, Path]:
    """The assets of chain and demo. Without network these tests skip only where PBL_OFFLINE says that this is meant."""
    try:
        return {name: assets.fetch(name) for name in assets.needed()}
    except PblError as error:
        if settings.offline() and error.code == "ASSET_MISSING":
            pytest.skip(f"PBL_OFFLINE is set and {error.key} is not in the cache")
        raise


@pytest.fixture(scope="session")
def folder(demo_files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as a clinic has it: one good video among bad ones. Nobody writes into it."""
    folder, demo = tmp_path_factory.mktemp("videos"), demo_files["demo_video"]
    clips.walking(demo, folder / "walking.mp4")
    clips.standing(demo, folder / "standing.mp4")
    clips.short(demo, folder / "short.mp4")
    clips.empty_scene(demo, folder / "niemand ist da, früh.mp4")
    clips.two_alike(demo, folder / "two.mp4")
    clips.truncated(folder / "walking.mp4", folder / "truncated.mp4")
    (folder / "copy of walking.mp4").write_bytes((folder / "walking.mp4").read_bytes())
    (folder / "notes.mp4").write_text("not a video")
    (folder / "nothing.mp4").touch()
    return folder
