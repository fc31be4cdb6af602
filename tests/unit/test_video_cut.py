"""A region cut from the decoder's planes is that of the converted picture; what is fetched ahead comes as it is."""

import threading
import time

import av
import cv2
import numpy as np
import pytest
from av.video.reformatter import VideoReformatter

from pbl_pipeline.prefetch import prefetched
from pbl_pipeline.video import cut_image, read_frames
from pbl_pipeline.video.frames import Orientation, cut_planes
from tests import not_none
from tests.videos import constant_rate, write_video

#: Turned, 2.2 pixels a step, and partly beyond the picture.
MATRIX = np.array([[2.1, -0.6, -5.0], [0.6, 2.1, -15.0]])
SIZE = (60, 50)
SPACES = {"bt709": 1, "unspecified": 2, "bt601": 6, "bt2020": 9}


def smooth_picture(width: int, height: int) -> np.ndarray:
    """(height, width, 3) uint8 BGR with colours that change slowly, so that sampling decides nothing."""
    y, x = np.mgrid[0:height, 0:width]
    channels = [128 + 110 * np.sin(x / 31), 128 + 110 * np.sin(y / 37 + 1), 128 + 110 * np.cos((x + y) / 53)]
    return np.stack(channels, axis=-1).astype(np.uint8)


def decoded(picture: np.ndarray, pixel_format: str, space: str, full_range: bool) -> av.VideoFrame:
    """The picture as a decoder would give it."""
    given = av.VideoFrame.from_ndarray(picture, format="bgr24")
    frame = VideoReformatter().reformat(
        given, format=pixel_format, dst_colorspace=SPACES[space], dst_color_range=2 if full_range else 1
    )
    frame.colorspace, frame.color_range = SPACES[space], 2 if full_range else 1
    return frame


def well_inside(height: int, width: int) -> np.ndarray:
    """Which pixels of the region lie 4 or more pixels within the picture: at its edge one mixes with black."""
    mask = np.zeros((height, width), np.uint8)
    mask[4:-4, 4:-4] = 255
    inside = cut_image(mask, MATRIX, SIZE) == 255
    assert inside.sum() > 300
    return inside


def converted(frame: av.VideoFrame) -> np.ndarray:
    return VideoReformatter().reformat(frame, format="bgr24").to_ndarray()


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize(
    ("pixel_format", "full_range"),
    [
        ("yuv420p", False),
        ("yuv420p", True),
        ("yuvj420p", True),
        ("yuv422p", False),
        ("yuv444p", False),
        ("yuv420p10le", False),
        ("yuv422p10le", True),
    ],
)
def test_a_region_of_the_planes_is_that_of_the_picture(pixel_format, full_range, space):
    frame = decoded(smooth_picture(160, 120), pixel_format, space, full_range)
    region = not_none(cut_planes(frame, Orientation(), MATRIX, SIZE))
    expected = cut_image(converted(frame), MATRIX, SIZE)
    assert region.shape == expected.shape == (50, 60, 3)
    beyond = cut_image(np.full((120, 160), 255, np.uint8), MATRIX, SIZE)
    assert 0.05 < np.mean(beyond == 0) < 0.5  # some of it lies beyond the picture
    # Colour samples reach a pixel beyond the edge.
    assert not region[cv2.dilate(beyond, np.ones((3, 3))) == 0].any()
    inside = well_inside(120, 160)
    # The converter of the library rounds otherwise, and takes one colour for each pair of pixels.
    apart = np.abs(region[inside].astype(int) - expected[inside])
    assert apart.mean() < 2.0
    assert apart.max() <= 8


@pytest.mark.parametrize("flip_y", [False, True])
@pytest.mark.parametrize("flip_x", [False, True])
@pytest.mark.parametrize("transpose", [False, True])
def test_a_region_stands_upright(transpose, flip_x, flip_y):
    turn = Orientation(transpose, flip_x, flip_y)
    frame = decoded(smooth_picture(160, 120), "yuv444p", "bt601", False)
    region = not_none(cut_planes(frame, turn, MATRIX, SIZE))
    expected = cut_image(turn.apply(converted(frame)), MATRIX, SIZE)
    inside = well_inside(*((160, 120) if transpose else (120, 160)))
    apart = np.abs(region[inside].astype(int) - expected[inside])
    assert apart.mean() < 2.0
    assert apart.max() <= 8


def test_another_pixel_format_is_converted_as_a_whole():
    frame = decoded(smooth_picture(160, 120), "nv12", "bt709", False)
    assert cut_planes(frame, Orientation(), MATRIX, SIZE) is None


@pytest.mark.parametrize("rotation", [0, 90])
def test_frames_of_a_file_are_cut_alike_before_and_after_conversion(tmp_path, rotation):
    # Of a width whose rows are padded in memory.
    picture = cv2.resize(smooth_picture(160, 120), (98, 66))
    path = write_video(tmp_path / "v.mp4", [picture] * 3, constant_rate(3), rotation_deg=rotation)
    for frame in read_frames(path):
        before = frame.cut(MATRIX, SIZE)
        whole = frame.image
        after = frame.cut(MATRIX, SIZE)
        assert whole.shape == (66, 98, 3)
        np.testing.assert_array_equal(after, cut_image(whole, MATRIX, SIZE))
        inside = well_inside(66, 98)
        assert np.abs(before[inside].astype(int) - after[inside]).mean() < 2.5


@pytest.mark.parametrize("step", [0.4, 1.0, 1.9, 2.0, 3.7, 7.3, 17.0])
def test_a_region_shows_the_places_it_was_asked_for_at_any_size(step):
    # A ramp has one value at each place, however much is averaged around it. The size is no multiple of the blocks.
    y, x = np.mgrid[0:1003, 0:1201]
    ramp = np.stack([x / 8, y / 8, (x + y) / 16], axis=-1).astype(np.float32)
    matrix = np.array([[0.96 * step, -0.28 * step, 420.0], [0.28 * step, 0.96 * step, 310.0]])
    region = cut_image(ramp, matrix, (31, 27))
    v, u = np.mgrid[0:27, 0:31]
    place = np.stack([u, v, np.ones_like(u)], axis=-1) @ matrix.T
    inside = np.all((place > 17) & (place < np.array([1201, 1003]) - 18), axis=-1)
    assert inside.sum() > 500
    expected = np.stack([place[..., 0] / 8, place[..., 1] / 8, place.sum(axis=-1) / 16], axis=-1)
    # warpAffine knows a place to 1/32 of a sample.
    np.testing.assert_allclose(region[inside], expected[inside], atol=max(step, 1.0) / 8 / 16)
    assert not region[np.any((place < -2 * step - 2) | (place > np.array([1201, 1003]) + 2 * step), axis=-1)].any()


def test_fine_patterns_become_their_mean():
    y, x = np.mgrid[0:600, 0:800]
    chess = np.repeat((255 * ((x + y) % 2))[..., None], 3, axis=2).astype(np.uint8)
    region = cut_image(chess, np.array([[8.0, 0.0, 40.0], [0.0, 8.0, 40.0]]), (60, 50))
    assert np.ptp(region) <= 1
    assert region.mean() == pytest.approx(127.5, abs=1)


def test_a_region_beyond_the_picture_is_black():
    picture = np.full((90, 120, 3), 200, np.uint8)
    for x in (-5000.0, 5000.0):
        assert not cut_image(picture, np.array([[4.0, 0.0, x], [0.0, 4.0, 0.0]]), (20, 20)).any()


def test_ahead_gives_all_in_order_and_then_the_error():
    def source():
        yield from range(20)
        raise OSError("the disk is gone")

    items = prefetched(source(), 3)
    assert [next(items) for _ in range(20)] == list(range(20))
    with pytest.raises(OSError, match="disk is gone"):
        next(items)


def test_ahead_works_while_nobody_asks_and_no_further_than_told():
    made = []

    def source():
        for i in range(100):
            made.append(i)
            yield i

    items = prefetched(source(), 3)
    assert next(items) == 0
    until = time.monotonic() + 60
    while len(made) < 5 and time.monotonic() < until:
        time.sleep(0.01)
    time.sleep(0.05)
    assert len(made) == 5  # one handed out, three ready, one that waits for room
    items.close()
    assert not any(t.name == "ahead" for t in threading.enumerate())
