"""What the end-to-end tests share: the demo recording and short clips of it."""

import subprocess
import sys
from pathlib import Path

import pytest

from pbl_pipeline import assets, settings
from pbl_pipeline.errors import PblError

from . import clips

ROOT = Path(__file__).resolve().parents[2]


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
def walking(demo_files: dict[str, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A good short video; its folder is only read."""
    return clips.walking(demo_files["demo_video"], tmp_path_factory.mktemp("videos") / "walking.mp4")


@pytest.fixture(scope="session")
def folder(demo_files: dict[str, Path], walking: Path) -> Path:
    """A folder as a clinic has it: the good video among bad ones. It is only read."""
    folder, demo = walking.parent, demo_files["demo_video"]
    clips.standing(demo, folder / "standing.mp4")
    clips.short(demo, folder / "short.mp4")
    clips.empty_scene(demo, folder / "niemand ist da, früh.mp4")
    clips.two_alike(demo, folder / "two.mp4")
    clips.truncated(folder / "walking.mp4", folder / "truncated.mp4")
    (folder / "copy of walking.mp4").write_bytes((folder / "walking.mp4").read_bytes())
    (folder / "notes.mp4").write_text("not a video")
    (folder / "nothing.mp4").touch()
    return folder


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    (made,) = folder.glob("*.whl")
    return made


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel installed by pip, to be put before the dependencies of this environment."""
    folder = tmp_path_factory.mktemp("installed")
    words = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", str(folder)]
    done = subprocess.run([*words, str(wheel)], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    return folder
