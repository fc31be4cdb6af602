"""A walk in a mirror: from the fit on, all results are those of the walk with the sides exchanged."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.body import SCALE_NAMES
from pbl_pipeline.fit import METHODS as FIT_METHODS
from pbl_pipeline.fit import TrialFit, default_fit
from pbl_pipeline.gait import GDI_METHODS, Measure, detect_events, feet_from_fit, gait_metrics
from pbl_pipeline.gait.events import METHODS
from pbl_pipeline.kinetics import MEASURES, visit_kinetics
from pbl_pipeline.kinetics import METHODS as KINETICS
from pbl_pipeline.kinetics.compute import HEALTHY_SD
from research.corpus.walks import synthetic_walk

OTHER = {"left": "right", "right": "left", "": ""}
#: Joints whose sign turns in a mirror; those of a side turn with their axes.
ODD = (
    "pelvis_tz",
    "pelvis_list",
    "pelvis_rotation",
    "lumbar_bending",
    "lumbar_rotation",
    "neck_bending",
    "neck_rotation",
)
#: Largest difference of a measure, in its unit; and of an event (s).
BAR, EVENT_BAR_S = 1e-3, 1e-5


def other(name: str) -> str:
    """The joint, or the group of bodies, of the other side."""
    first, _, rest = name.partition("_")
    swapped = {"_l": "_r", "_r": "_l"}.get(name[-2:])
    return f"{OTHER[first]}_{rest}" if first in OTHER else name if swapped is None else name[:-2] + swapped


def mirrored(fit: TrialFit) -> TrialFit:
    """The fit in a mirror along the way."""
    order = [fit.joint_names.index(other(n)) for n in fit.joint_names]
    return dataclasses.replace(
        fit,
        qpos=fit.qpos[:, order] * np.where(np.isin(fit.joint_names, ODD), -1.0, 1.0),
        qpos_sd=fit.qpos_sd[:, order],
        scale=fit.scale[[SCALE_NAMES.index(other(n)) for n in SCALE_NAMES]],
        camera_position_m=fit.camera_position_m * [1.0, -1.0, 1.0],
    )


@pytest.fixture(scope="module")
def walk() -> TrialFit:
    """A walk with one stiff knee and legs of two lengths, seen from the left, by the fit whose error was measured."""
    known = synthetic_walk(2, "stiff_knee", 0.8).fit()
    return dataclasses.replace(
        known,
        qpos_sd=np.full(known.qpos.shape, 0.05),
        scale=known.scale * np.where(np.char.startswith(SCALE_NAMES, "left"), 0.97, 1.0),
        camera_position_m=np.array([known.qpos[:, 0].mean(), 4.0, 1.0]),
        orientation_source="measured: phone",
        params_hash=FIT_METHODS[default_fit(("blazepose_33", True))].hash,
    )


def assert_mirrored(found: Mapping[str, Any], reflected: Mapping[str, Any], bar: float) -> None:
    """The measures of both are known alike and within `bar` of each other."""
    for name, m in found.items():
        r = reflected[name]
        assert (m is None) == (r is None), name
        if m is not None:
            one, two = (np.array([x.left, x.right, x.mean], float) for x in (m, r))
            np.testing.assert_allclose(two[[1, 0, 2]], one, atol=bar, err_msg=name)


def errors(measures: Sequence[Measure]) -> np.ndarray:
    """Their stated errors and minimal changes (M, 2)."""
    return np.array([(m.error_sd, m.minimal_change) for m in measures], float)


@pytest.mark.parametrize("method", METHODS)
def test_events_of_each_method(walk, method):
    found, reflected = (detect_events(feet_from_fit(f), method).events for f in (walk, mirrored(walk)))
    assert len(found) > 15
    swapped = [dataclasses.replace(e, side=OTHER[e.side]) for e in found]
    keys = [[(e.side, e.event, e.bout) for e in events] for events in (swapped, reflected)]
    assert keys[0] == keys[1]
    np.testing.assert_allclose([e.time_s for e in reflected], [e.time_s for e in found], atol=EVENT_BAR_S)


def test_measures_index_and_their_errors(walk):
    found, reflected = (gait_metrics([f]) for f in (walk, mirrored(walk)))
    assert [(OTHER[c.side], c.used, OTHER[c.far_leg]) for c in found.cycles] == [
        (c.side, c.used, c.far_leg) for c in reflected.cycles
    ]
    assert_mirrored(found.spatiotemporal.measures, reflected.spatiotemporal.measures, BAR)
    assert found.gdi.interval is not None
    assert_mirrored({"gdi": found.gdi}, {"gdi": reflected.gdi}, BAR)
    one, two = (errors([*filter(None, g.spatiotemporal.measures.values())]) for g in (found, reflected))
    assert np.isfinite(one).all()
    np.testing.assert_allclose(two, one, atol=BAR)
    one, two = ((g.gdi.sd, g.gdi.minimal_change) for g in (found, reflected))
    assert two == pytest.approx(one, abs=BAR)


@pytest.mark.parametrize("model", [m for m in GDI_METHODS if m != GDI_METHODS.default])
def test_every_other_index(walk, model):
    found, reflected = (gait_metrics([f], model=model).gdi for f in (walk, mirrored(walk)))
    assert found.mean is not None
    assert_mirrored({"gdi": found}, {"gdi": reflected}, BAR)


def test_forces(walk, monkeypatch):
    """But for the intervals, whose draws are not mirrored."""
    for name in MEASURES:
        monkeypatch.setitem(HEALTHY_SD, name, np.inf)
    method = KINETICS.make("custom", 1, dataclasses.replace(KINETICS.find().params, samples=2))
    found, reflected = (visit_kinetics([f], gait_metrics([f]).trials, method) for f in (walk, mirrored(walk)))
    assert len(found.measures) == len(MEASURES)
    assert_mirrored(found.measures, reflected.measures, BAR)
