"""Feet and heads that a picture cuts off, and pictures that are not looked at."""

import cv2
import numpy as np
import pytest

from pbl_pipeline import assets
from pbl_pipeline.keypoints.framing import FEET, HEAD, Framing, jpeg_size, read_picture
from pbl_pipeline.video import read_frames


def packed(image: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


@pytest.mark.slow
def test_cut_feet_and_a_cut_head_are_seen():
    """The woman of the demo, 380 px from eyes (y 542) to feet (y 921 to 933), in windows of the picture."""
    framing = Framing()
    for frame in read_frames(assets.fetch("demo_video"), start=110, stop=141):
        if frame.index not in (110, 120, 140):
            continue
        x = {110: 915, 120: 830, 140: 625}[frame.index]
        window = frame.image[:, x - 300 : x + 300]
        for low, high, cut in ((430, 980, ""), (430, 870, FEET), (430, 800, FEET), (529, 980, HEAD)):
            seen = read_picture(packed(window[low:high]))
            assert seen is not None
            assert framing.cut_off(seen) == cut, (frame.index, low, high)
    assert framing.cut_off(np.zeros((360, 640, 3), np.uint8)) is None


def test_only_small_jpegs_are_decoded():
    image = np.zeros((90, 160, 3), np.uint8)
    good = packed(image)
    assert jpeg_size(good) == (160, 90)
    assert read_picture(good) is not None
    at = good.index(b"\xff\xc0") + 5
    large = good[:at] + b"\xff\xff\xff\xff" + good[at + 4 :]  # says 65,535 px a side
    assert jpeg_size(large) == (65535, 65535)
    # Another segment than a table before the size, and progressive coding, which takes a hundred times as long to read.
    odd = good[:2] + b"\xff\x00\x00\x04ab" + good[2:]
    progressive = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    for content in (
        large,
        odd,
        progressive,
        b"",
        b"\xff\xd8",
        good[:20],
        cv2.imencode(".png", image)[1].tobytes(),
        b"\xff\xd8" * 50,
    ):
        assert read_picture(content) is None
