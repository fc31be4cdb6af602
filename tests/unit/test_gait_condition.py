"""Which trials the measures of a session pool."""

from __future__ import annotations

import dataclasses

import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import GDI_METHODS, Condition, GaitParams, gait_metrics
from pbl_pipeline.methods import stored
from pbl_pipeline.paramset import Paramset
from tests.walking_fit import walking_fit


@pytest.mark.parametrize(
    ("activity", "pace", "pool"),
    [
        ("", "", "self_selected"),
        ("unknown", "unknown", "self_selected"),
        ("walking", "", "self_selected"),
        ("Overground walking", "Self-selected", "self_selected"),
        ("treadmill gait", "fast", "fast"),
        ("walking", "dual task", "dual_task"),
        ("TUG", "fast", ""),
        ("Sit-to-stand", "", ""),
        ("running", "fast", ""),
    ],
)
def test_what_is_pooled(activity: str, pace: str, pool: str):
    found = Condition(activity, pace)
    assert found.pool == pool
    assert [p for p in ("self_selected", "fast", "dual_task") if found.pooled(p)] == ([pool] if pool else [])
    assert found.pooled("any") == bool(pool)


def test_a_label_that_is_too_long():
    with pytest.raises(PblError, match="USAGE"):
        Condition("walking", "x" * 33)


@pytest.fixture(scope="module")
def trials():
    body = load_body()
    return [walking_fit(body.joint_names, body.sha256, name=n, n_frames=360) for n in ("a", "b", "c")]


def test_the_session_pools_walking_at_the_pace_of_the_method(trials: list):
    plain = gait_metrics(trials[:2])
    done = [Condition("walking"), Condition(), Condition("TUG")]
    mixed = gait_metrics(trials, conditions=done)
    assert [t.pooled for t in mixed.trials] == [True, True, False]
    assert mixed.spatiotemporal == plain.spatiotemporal
    assert (mixed.gdi, mixed.params_hash, len(mixed.cycles)) == (plain.gdi, plain.params_hash, len(plain.cycles))
    assert mixed.trials[2].gdi.mean is not None
    at_fast = dataclasses.replace(GDI_METHODS.find().params, pace="fast")
    fast = gait_metrics(trials, params=GaitParams(gdi=at_fast), conditions=[*done[:2], Condition("walking", "fast")])
    alone = gait_metrics(trials[2:], params=GaitParams(gdi=at_fast), conditions=[Condition(pace="fast")])
    assert fast.gdi.mean == alone.gdi.mean
    assert fast.spatiotemporal.n_cycles_used == alone.spatiotemporal.n_cycles_used > 0
    assert fast.params_hash != plain.params_hash


def test_no_trial_of_that_pace_says_which_there_are(trials: list):
    none = gait_metrics(trials[:2], conditions=[Condition("TUG"), Condition("walking", "fast")])
    assert (none.status, none.gdi.status, none.cycles) == ("EMPTY", "EMPTY", [])
    for reason in (none.reason, none.gdi.reason, none.spatiotemporal.reasons["cadence_steps_per_min"]):
        assert "'self_selected' (there are: tug; walking, fast)" in reason


@pytest.mark.parametrize("family", list(GDI_METHODS.families))
def test_a_method_of_ones_own_at_another_pace(trials: list, family: str):
    """Its row is read back, scores with the angles of its family, and its hash is the row's."""
    params = {"family": family, **GDI_METHODS[family].paramset.params, "pace": "any"}
    own = GDI_METHODS.of(Paramset("gdi", "any-pace", 1, params))
    p = own.paramset
    assert stored(stage="gdi", name=p.name, version=p.version, params=dict(p.params), sha=own.hash) == own
    assert own.params.pace == "any"
    done = gait_metrics(
        trials[:1], params=GaitParams(gdi=own.params), model=own, conditions=[Condition("walking", "fast")]
    )
    plain = gait_metrics(trials[:1], params=GaitParams(gdi=GDI_METHODS[family].params), model=family)
    assert (done.gdi.model, done.gdi.params_hash) == ("any-pace", own.hash)
    assert done.gdi.mean == plain.gdi.mean
