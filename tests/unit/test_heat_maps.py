"""Points refined by heat maps: synthetic peaks, the same rule in NumPy and JAX, and the real networks."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pbl_pipeline.keypoints import METHODS
from pbl_pipeline.keypoints.blazepose import CROP_MARGIN, INPUT_SIZE, N_ALL
from pbl_pipeline.models.heat_maps import CELL_PX, SIDE, decoded, refined
from pbl_pipeline.video import cut_image
from tests.unit.test_blazepose import CAMERA, asset, frames, region

__all__ = ["frames"]
SD = METHODS["blazepose-heavy"].params.window_cells
GRID = np.arange(SIDE)


def peak(x: float, y: float, height: float = 0.9, sd: float = 1.0) -> np.ndarray:
    """Logits (SIDE, SIDE, 1) of a Gaussian peak at a place in cells, on a black map."""
    values = height * np.exp(-((GRID - x) ** 2 + (GRID[:, None] - y) ** 2) / (2 * sd**2))
    values = np.clip(values, 1e-7, 1 - 1e-7)
    return np.log(values / (1 - values)).astype(np.float32)[..., None]


def at(x: float, y: float) -> np.ndarray:
    """A point (1, 2) in px of the picture at a place in cells."""
    return np.array([[x, y]], np.float32) * np.float32(CELL_PX)


def test_point_is_drawn_to_a_high_peak_and_stays_at_a_low_one():
    (high,) = refined(at(30, 20), peak(32, 19, 1.0), SD)
    np.testing.assert_allclose(high, at(32, 19)[0], atol=1.5)
    (low,) = refined(at(30, 20), peak(32, 19, 0.05), SD)
    assert np.abs(low - at(30, 20)[0]).max() < 0.5
    # Nor from one side of the map to the other.
    np.testing.assert_allclose(refined(at(1, 20), peak(62, 20), SD), at(1, 20), atol=1e-3)


@pytest.mark.parametrize("moved", ["peak", "point"])
@pytest.mark.parametrize("start", [26.0, SIDE - 12.0])
def test_no_jump_where_a_border_of_cells_is_crossed(moved: str, start: float):
    """Also where a peak enters the window, and where the window meets the border of the map."""
    along = start + np.arange(0, 16, 0.01)
    other = start + 7
    found = [
        refined(at(other, 20), peak(s, 20.3), SD) if moved == "peak" else refined(at(s, 20), peak(other, 20.3), SD)
        for s in along
    ]
    points = np.concatenate(found)
    # A hundredth of a cell is 0.04 px, and a jump of a cell would be 4.
    assert np.abs(np.diff(points, axis=0)).max() < 0.2
    assert np.ptp(points[:, 0]) > 10


@pytest.mark.parametrize("where", [(30, 30), (0, 0), (63, 0), (-0.49, 63.5), (-40, 90), (1e6, -1e6)])
@pytest.mark.parametrize("logit", [-200.0, -20.0, 20.0, 200.0])
def test_any_point_on_an_even_map_is_finite_and_hardly_moves_on_a_black_one(where: tuple[float, float], logit: float):
    with np.errstate(all="raise", under="ignore"):
        found = refined(at(*where), np.full((SIDE, SIDE, 1), logit, np.float32), SD)
    assert np.isfinite(found).all()
    if logit < 0 or not -8 < where[0] < 72:
        np.testing.assert_allclose(found, at(*where), atol=1e-3)


def test_numpy_and_jax_refine_alike_in_a_batch():
    rng = np.random.default_rng(0)
    maps = rng.normal(-4, 3, (3, SIDE, SIDE, N_ALL)).astype(np.float32)
    rows = rng.uniform(-20, 276, (3, N_ALL, 5)).astype(np.float32)
    outputs = {5 * N_ALL: rows.reshape(3, -1), 1: np.ones((3, 1), np.float32), maps[0].size: maps.reshape(3, -1)}
    found = jax.jit(jax.vmap(lambda one: decoded(one, SD, jnp)))(outputs)
    for i in range(3):
        expected = decoded({size: v[i] for size, v in outputs.items()}, SD)
        assert set(expected) == set(found) == {5 * N_ALL, 1}
        for size, values in expected.items():
            np.testing.assert_allclose(found[size][i], values, atol=2e-3)
        np.testing.assert_array_equal(expected[5 * N_ALL].reshape(-1, 5)[:, 2:], rows[i, :, 2:])


@pytest.mark.parametrize("name", ["blazepose-33", "blazepose-heavy"])
def test_maps_of_the_networks_lie_where_their_points_do(name: str, frames: dict[int, np.ndarray]):
    """In a picture and in its mirror image: with the centres of the cells half a cell further, the two would be 4 px
    of the crop apart."""
    for network in ("blazepose_landmarks", "blazepose_landmarks_heavy"):
        asset(network)
    method = METHODS[name]
    plain, refining = (
        method.function(dataclasses.replace(method.params, window_cells=cells))
        for cells in (0.0, method.params.window_cells)
    )
    apart, moved = [], []
    for number, image in frames.items():
        roi = region(number)
        crop, px = cut_image(image, *plain.crop_of(roi)), roi[2] * CROP_MARGIN / INPUT_SIZE
        own, mirrored = (refining.detect_once(crop, roi, CAMERA, mirrored=m).xy_px / px for m in (False, True))
        apart.append(own - mirrored)
        moved.append(own - plain.detect_once(crop, roi, CAMERA).xy_px / px)
    assert np.abs(np.median(apart, axis=(0, 1))).max() < 1
    assert np.abs(np.median(moved, axis=(0, 1))).max() < 1
    assert np.abs(moved).max() > 2


@pytest.mark.parametrize("x", [0.0, 884.0, -2000.0])
def test_black_pictures_and_people_at_the_border_have_finite_points(x: float, frames: dict[int, np.ndarray]):
    asset("blazepose_landmarks")
    method = METHODS["blazepose-33"]
    refining = method.function(method.params)
    for image in (frames[100], np.zeros_like(frames[100])):
        for roi in ([x, 715.0, 440.0, 0.0], [x, 715.0, 60.0, 1.0]):
            person = refining.detect(image, np.array(roi), CAMERA)
            assert np.isfinite(person.xy_px).all()
            assert np.isfinite(person.xyz_cam_m).all()
            assert np.all((person.confidence >= 0) & (person.confidence <= 1))
