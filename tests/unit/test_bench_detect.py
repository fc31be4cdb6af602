"""`pbl bench detect`: its clips, its memory figure, and the command on a short video."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from pbl_pipeline import assets
from pbl_pipeline.bench import detect_text
from pbl_pipeline.bench.detect_case import growth
from pbl_pipeline.cli.bench import bench
from pbl_pipeline.video import probe, read_frames
from research.benchmarks.longer_video import repeated
from tests.unit.test_blazepose import asset
from tests.videos import constant_rate, numbered_frames, write_video


@pytest.mark.parametrize("b_frames", [0, 2])
def test_a_repeated_video_has_the_same_pictures_again_at_even_steps(tmp_path, b_frames):
    source = write_video(tmp_path / "a.mp4", numbered_frames(20), constant_rate(20), b_frames=b_frames)
    info = probe(repeated(source, tmp_path / "b.mp4", 2.0))
    assert info.n_frames == 60
    np.testing.assert_allclose(np.diff(info.time_s), 1 / 30, atol=2e-4)
    assert not info.notes
    first = [f.image for f in read_frames(source)]
    for frame in read_frames(tmp_path / "b.mp4"):
        np.testing.assert_array_equal(frame.image, first[frame.index % 20])


def test_growth_of_memory():
    assert growth(np.full(10, 1e9)) is None
    assert growth(np.full(100, 1e9)) == 0
    assert growth(np.concatenate([[0, 1e8], np.full(98, 1e9)])) == 0  # while the models are loaded
    assert (growth(np.linspace(0, 1e9, 101)) or 0) > 3e8


@pytest.mark.long
@pytest.mark.slow
def test_the_command_on_a_short_video(tmp_path):
    for name in ("blazepose_detector", "blazepose_landmarks_heavy"):
        asset(name)
    images = [f.image[400:, 1000:1768] for f in read_frames(assets.fetch("demo_video"), start=60, stop=100)]
    video = write_video(tmp_path / "v.mp4", images, constant_rate(40))
    args = ["detect", str(video), "--repeat", "1", "--person", "1", "--json", str(tmp_path / "d.json")]
    result = CliRunner().invoke(bench, args)
    assert result.exit_code == 0, result.output
    content = json.loads((tmp_path / "d.json").read_text())
    row = content["rows"][0]
    assert content["benchmark"] == "detect"
    assert (row["frames"], row["width_px"], row["height_px"], row["codec"]) == (40, 768, 594, "h264")
    assert list(row["stages"]) == ["decode", "tracking", "keypoints"]
    assert row["seconds"] == pytest.approx(sum(s["seconds"] for s in row["stages"].values()))
    assert row["frames_in_view"] >= 30
    assert 5e7 < row["host_bytes"] < 4e9
    for stage in row["stages"]:
        assert stage in result.output
    assert "40 frames in 1.3 s" in result.output


@pytest.mark.slow
def test_a_failure_is_told(tmp_path):
    (tmp_path / "v.mp4").write_bytes(b"no video")
    result = CliRunner().invoke(bench, ["detect", str(tmp_path / "v.mp4")])
    assert result.exit_code == 1
    assert "VIDEO_NOT_A_VIDEO" in result.output
    assert detect_text({"label": "x", "error": "over 3 s"}) == "x: over 3 s"
