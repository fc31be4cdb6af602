"""The units of the cost: results do not depend on the size of the picture, nor on whom a detector assumes."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.fit import METHODS, CostParams, fit_session
from pbl_pipeline.fit.units import (
    CROP,
    CROP_OF_BOX,
    CROP_SIZE,
    FILE,
    PAPER,
    body_metres,
    box_side_px,
    check_units,
    crop_px,
    pixel_px,
)
from pbl_pipeline.keypoints import Keypoints
from research.benchmarks.picture_size import multiplied
from research.walker.observe import observe
from research.walker.walk import person, walk_qpos
from tests import refused

TIME_S = np.arange(60) / 30


def seen(marker_set: str = "blazepose_33", **options) -> Keypoints:
    scale, offset = person(3, marker_set)
    qpos = walk_qpos(TIME_S, 3)
    return observe(
        qpos, TIME_S, marker_set=marker_set, scale=scale, site_offset_m=offset, seed=3, view="oblique", **options
    ).keypoints


# --- what a pixel is


def test_a_pixel_is_that_of_the_file_or_of_the_papers_picture_or_of_the_crop():
    k = dataclasses.replace(seen(), crop_px=np.full(60, 512.0))
    assert k.image_size_px == (1080, 1920)
    np.testing.assert_array_equal(pixel_px(k, FILE), 1.0)
    np.testing.assert_array_equal(pixel_px(k, PAPER), 1.0)
    np.testing.assert_array_equal(pixel_px(multiplied(k, 2.0), PAPER), 2.0)
    np.testing.assert_array_equal(pixel_px(k, CROP), 512 / CROP_SIZE)


def test_frames_without_a_crop_have_what_lies_between_their_neighbours():
    side = np.where(np.arange(60) % 2 == 0, 400.0 + np.arange(60), np.nan)
    found = crop_px(dataclasses.replace(seen(), crop_px=side))
    np.testing.assert_allclose(found[1:-1], 400.0 + np.arange(60)[1:-1])


@pytest.mark.parametrize("stated", [None, np.full(60, np.nan)])
def test_the_crop_of_keypoints_of_other_programs_is_that_of_their_box(stated):
    """As many times the box of the points as on the recordings, whatever a few gross points do."""
    k = dataclasses.replace(seen(noise=None), crop_px=stated)
    height = np.nanpercentile(k.xy_px[..., 1], 95, axis=1) - np.nanpercentile(k.xy_px[..., 1], 5, axis=1)
    np.testing.assert_allclose(crop_px(k), CROP_OF_BOX * height, rtol=0.08)
    xy = k.xy_px.copy()
    xy[:, 0] += 5_000.0
    np.testing.assert_allclose(crop_px(dataclasses.replace(k, xy_px=xy)), crop_px(k), rtol=0.15)


def test_the_box_is_between_numpys_percentiles_of_the_points_seen():
    k = seen()
    rng = np.random.default_rng(0)
    k = dataclasses.replace(
        k, confidence=np.where(rng.random(k.confidence.shape) < 0.5, 0.0, k.confidence), time_s=40 * k.time_s
    )
    points = np.where(k.confidence[..., None] > 0, k.xy_px, np.nan)
    low, high = np.nanpercentile(points, (5, 95), axis=1)
    np.testing.assert_allclose(box_side_px(k), np.max(high - low, axis=1), rtol=1e-5)  # frames too far apart to smooth


def test_points_that_say_nothing_of_the_size_leave_the_pictures():
    k = seen()
    nothing = dataclasses.replace(k, xy_px=np.full_like(k.xy_px, np.nan), confidence=np.zeros_like(k.confidence))
    np.testing.assert_array_equal(crop_px(nothing), 1920.0)
    together = dataclasses.replace(k, xy_px=np.full_like(k.xy_px, 7.0))
    np.testing.assert_array_equal(crop_px(together), 1920.0)


@pytest.mark.parametrize(("field", "value"), [("pixel", "4K"), ("metre", "yard")])
def test_an_unknown_unit_is_refused(field, value):
    cost = dataclasses.replace(CostParams(), **{field: value})
    refused("FIT_INPUT", check_units, cost)
    params = dataclasses.replace(METHODS["blazepose"].params, cost=cost)
    assert value in refused("FIT_INPUT", fit_session, [seen()], ["a"], params).text()


def test_a_crop_of_no_size_is_refused():
    assert "crop_px" in refused("FILE_FORMAT", dataclasses.replace, seen(), crop_px=np.full(60, 0.0)).text()


def test_the_crop_is_kept_in_the_file(tmp_path):
    side = np.linspace(300, 400, 60)
    dataclasses.replace(seen(), crop_px=side).save(tmp_path / "a.npz")
    again = Keypoints.load(tmp_path / "a.npz")
    np.testing.assert_allclose(np.asarray(again.crop_px), side, rtol=1e-6)
    assert again.assumed == ()


def test_a_matrix_of_another_picture_is_refused():
    """That of a picture of 2160 x 3840 with points of 1080 x 1920."""
    k = seen()
    error = refused("CAMERA_INVALID", dataclasses.replace, k, camera=multiplied(k, 2.0).camera)
    assert "2158x3838" in error.text()


# --- what becomes of a fit


@pytest.fixture(scope="module")
def fitted():
    return fit_session([seen()], ["a"], "blazepose")


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.25, 3.0])
def test_a_change_of_the_pixel_changes_nothing(fitted, factor):
    other = fit_session([multiplied(seen(), factor)], ["a"], "blazepose").trials[0]
    own = fitted.trials[0]
    assert np.rad2deg(np.nanmax(np.abs(other.qpos - own.qpos)[:, 6:])) < 0.05
    np.testing.assert_allclose(other.qpos_sd, own.qpos_sd, rtol=0.01)
    # What people read stays in pixels of the file.
    np.testing.assert_allclose(other.residual_2d_px, factor * own.residual_2d_px, rtol=1e-3, atol=factor * 1e-2)


@pytest.mark.long
@pytest.mark.slow
def test_the_paper_in_a_picture_of_another_size_means_the_same():
    few = dataclasses.replace(METHODS["paper-2025"].params, steps=200, hidden=(32,), n_skip=1)
    own, other = (fit_session([k], ["a"], few).trials[0] for k in (seen(), multiplied(seen(), 2.0)))
    np.testing.assert_allclose(other.qpos, own.qpos, atol=1e-3)
    old = dataclasses.replace(few, cost=dataclasses.replace(few.cost, pixel=FILE))
    changed = fit_session([multiplied(seen(), 2.0)], ["a"], old).trials[0]
    assert np.nanmax(np.abs(changed.qpos - own.qpos)) > 1e-3


@pytest.mark.slow
def test_a_detector_that_assumes_a_taller_person_gives_the_same_angles(fitted):
    k = seen()
    taller = dataclasses.replace(k, xyz_cam_m=1.3 * k.xyz_cam_m)
    found = fit_session([taller], ["a"], "blazepose")
    own, other = fitted.trials[0], found.trials[0]
    assert np.rad2deg(np.nanmax(np.abs(other.qpos - own.qpos)[:, 6:])) < 0.05
    np.testing.assert_allclose(other.scale, 1.3 * own.scale, rtol=1e-3)
    np.testing.assert_allclose(other.residual_3d_m, 1.3 * own.residual_3d_m, rtol=0.01, atol=1e-4)
    cm = [next(c.value for c in f.qc if c.check == "residual_3d_cm") for f in (fitted, found)]
    assert cm[1] == pytest.approx(cm[0], rel=1e-2)


def test_metres_are_those_of_the_body():
    body, markers = load_body(), marker_set("blazepose_33")
    exact = observe(np.zeros((5, 40)), TIME_S[:5], marker_set="blazepose_33", view="frontal", noise=None).keypoints
    x, c = exact.xyz_cam_m[:, None], exact.confidence[:, None]
    own = body_metres(body, markers, [x], [c])
    assert own == pytest.approx(1.0, abs=0.05)
    assert body_metres(body, markers, [2.0 * x], [c]) == pytest.approx(own / 2)
    assert body_metres(body, markers, [x], [np.zeros_like(c)]) == 1.0
    assert body_metres(body, markers, [np.zeros_like(x)], [np.ones_like(c)]) == 1.0
