"""Variants of a recording that mean nothing: what they do to the picture."""

import numpy as np
import pytest

from research.benchmarks.same_walk import VARIANTS, encoded
from tests.videos import write_video

IMAGE = np.random.default_rng(0).integers(0, 255, (90, 160, 3), np.uint8)


@pytest.mark.parametrize(
    ("variant", "shape"),
    [
        ("as it is", (90, 160, 3)),
        ("mirrored", (90, 160, 3)),
        ("half size", (44, 80, 3)),
        ("a tenth", (90, 160, 3)),
        ("cropped", (82, 136, 3)),
    ],
)
def test_variants_of_a_picture(variant: str, shape: tuple[int, ...]):
    changed = VARIANTS[variant](IMAGE)
    assert changed.shape == shape
    assert changed.flags.c_contiguous
    if variant == "mirrored":
        np.testing.assert_array_equal(changed[:, 0], IMAGE[:, -1])
    if variant == "cropped":
        np.testing.assert_array_equal(changed[0, 0], IMAGE[4, 12])


def test_a_tenth_of_the_bytes(tmp_path):
    """Noise that moves: much to leave out."""
    rng = np.random.default_rng(1)
    images = rng.integers(0, 255, (12, 96, 128, 3), np.uint8)
    video = write_video(tmp_path / "own.mp4", images, np.arange(12) / 30, crf=10)
    small = encoded(video, "a tenth", tmp_path / "small.mp4")
    assert small.stat().st_size <= 0.1 * video.stat().st_size
