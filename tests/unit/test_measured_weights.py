"""Weights of a detector's points by the residuals of a first solution."""

from types import SimpleNamespace

import numpy as np
import pytest

from pbl_pipeline.body import load_body, marker_positions
from pbl_pipeline.fit import METHODS
from pbl_pipeline.fit.measured_weights import MOST, with_measured_weights
from pbl_pipeline.fit.params import GaussNewtonParams, Params
from pbl_pipeline.fit.per_frame import start_of
from pbl_pipeline.fit.session import make_session
from pbl_pipeline.fit.weights import Weights
from research.walker.observe import observe
from research.walker.walk import walk_qpos

TIME_S = np.arange(40) / 30
_OF_METHOD = METHODS["blazepose-measured"].params
assert isinstance(_OF_METHOD, GaussNewtonParams)
PARAMS = _OF_METHOD


@pytest.fixture(scope="module")
def session():
    seen = observe(walk_qpos(TIME_S, seed=1), TIME_S, marker_set="blazepose_33", noise=None)
    return make_session([seen.keypoints], ["walk"], PARAMS)


def weighed(session, params: Params = PARAMS, **points):
    """Factors of `c_2d` and `c_3d` of each marker, where points are moved by `points` off the fitted ones."""
    p, start = session.problem, start_of(session)
    body, table = load_body(), p.points
    x = np.array(marker_positions(body, table, start.qpos, np.ones(8), np.zeros((len(table.body_index), 3))))
    markers = p.split(x)[0]
    x_cam = np.einsum("fji,fmj->fmi", p.R_nc[:, 0], markers - p.p_nc[:, 0, None])
    focal, middle = p.camera_matrix[:, 0, [0, 1], [0, 1]], p.camera_matrix[:, 0, :2, 2]
    p.xy_px[:, 0] = focal[:, None] * x_cam[..., :2] / x_cam[..., 2:] + middle[:, None]
    p.x_cam[:, 0] = x_cam
    for name, (at, off) in points.items():
        getattr(p, name)[at] += off
    found = SimpleNamespace(end=SimpleNamespace(state=start), x=x)
    new = with_measured_weights(p, Weights.of(body, params), found)  # type: ignore[arg-type]
    seen = [np.asarray(c) > 0 for c in (p.c_2d, p.c_3d)]
    pairs = ((new.c_2d, p.c_2d, seen[0]), (new.c_3d, p.c_3d, seen[1]))
    return [np.max(np.where(s, after / np.where(s, before, 1), 0)[:, 0], axis=0) for after, before, s in pairs]


def test_a_point_counts_by_the_median_of_its_residuals(session):
    names = list(session.markers.names)
    knee, ankle = names.index("left_knee"), names.index("left_ankle")
    one = np.array([3.0, 4.0]) / 5 * PARAMS.points_px
    by_px, by_cm = weighed(session, xy_px=((slice(None), 0, knee), one), x_cam=((slice(None), 0, ankle, 1), 0.2))
    assert by_px[knee] == pytest.approx(1 / (1 + 1 / MOST), rel=1e-3)
    assert by_px[ankle] == pytest.approx(MOST, rel=1e-2)
    # Without the mean of twelve points with 3D, 20 cm are 18.3 there and 1.7 elsewhere.
    assert by_cm[ankle] == pytest.approx(1.5**2 / ((20 * 11 / 12) ** 2 + 1.5**2 / MOST), rel=0.05)
    assert by_cm[knee] == pytest.approx(1.5**2 / ((20 / 12) ** 2 + 1.5**2 / MOST), rel=0.05)


def test_frames_in_which_a_point_was_confused_do_not_count(session):
    knee = list(session.markers.names).index("left_knee")
    by_px, _ = weighed(session, xy_px=((slice(0, 15), 0, knee), 80.0))
    assert by_px[knee] == pytest.approx(MOST, rel=1e-2)


def test_the_default_weighs_all_alike(session):
    by_px, by_cm = weighed(session, METHODS["blazepose"].params, xy_px=((slice(None), 0, 3), 50.0))
    assert set(np.unique(by_px)) <= {0.0, 1.0} >= set(np.unique(by_cm))
