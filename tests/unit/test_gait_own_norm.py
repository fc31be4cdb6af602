"""Normative sets from one's own cycles."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import (
    BODY_ANGLES,
    NINE_ANGLES,
    PLUG_IN_GAIT,
    THREE_ANGLES,
    Exclusion,
    GaitCycle,
    norm_from_cycles,
)
from tests.unit.test_gait_gdi import cycle, index_another_way, toy_vectors

ABOUT = {"name": "own", "version": 1, "source": "made up"}


def made(n: int = 80, people: int = 40, seed: int = 3) -> tuple[list[GaitCycle], list[str]]:
    vectors = toy_vectors(n, seed)
    return [cycle(v, ("left", "right")[i % 2], i) for i, v in enumerate(vectors)], [f"P{i % people}" for i in range(n)]


def test_it_is_the_set_of_their_vectors():
    cycles, people = made()
    norm, checks = norm_from_cycles(cycles, people, **ABOUT)
    others = toy_vectors(20, seed=9) + 4
    np.testing.assert_allclose(norm.index(others), index_another_way(toy_vectors(), others), atol=1e-8)
    assert (norm.n, norm.angle_model, norm.variables) == (80, BODY_ANGLES, THREE_ANGLES)
    assert "80 gait cycles of 40 people" in norm.convention
    assert [c.outcome for c in checks] == ["PASS", "PASS"]
    knee = np.array([c.curves["knee_flexion"] for c in cycles])
    np.testing.assert_allclose(norm.curves["knee_flexion"]["mean_deg"], knee.mean(axis=0))
    np.testing.assert_allclose(norm.curves["knee_flexion"]["sd_deg"], knee.std(axis=0, ddof=1))


def test_unused_cycles_do_not_count():
    cycles, people = made()
    bad = [
        dataclasses.replace(c, exclusion=Exclusion(first_step=True), curves={k: 3 * v for k, v in c.curves.items()})
        for c in cycles[:9]
    ]
    bare = [dataclasses.replace(c, curves={}) for c in cycles[:5]]
    norm, _ = norm_from_cycles([*cycles, *bad, *bare], [*people, *people[:14]], **ABOUT)
    same, _ = norm_from_cycles(cycles, people, **ABOUT)
    np.testing.assert_array_equal(norm.mean_deg, same.mean_deg)
    assert norm.n == 80


def test_few_people_and_one_who_walks_most_warn():
    cycles, _ = made()
    _, checks = norm_from_cycles(cycles, ["A"] * 60 + ["B"] * 20, **ABOUT)
    assert {c.check: (c.outcome, c.value) for c in checks} == {
        "norm_people": ("WARN", 2.0),
        "norm_share_of_one_person": ("WARN", 0.75),
    }


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda c, p: (c[:29], p[:29], {}), "29 usable cycles"),
        (lambda c, p: (c[:35], p[:35], {"n_components": 36}), "35 vectors for 36 components"),
        (lambda c, p: ([*c[:-1], dataclasses.replace(c[-1], angle_model=PLUG_IN_GAIT)], p, {}), "several ways"),
        (lambda c, p: (c, p, {"pooled": [dataclasses.replace(c[-1], angle_model=PLUG_IN_GAIT)]}), "several ways"),
        (lambda c, p: (c, p, {"variables": ("knee_flexion",)}), "angles knee_flexion"),
        (lambda c, p: (c, p, {"variables": NINE_ANGLES}), "0 usable cycles of 80"),
    ],
)
def test_what_makes_no_norm(change, found):
    cycles, people, more = change(*made())
    with pytest.raises(PblError, match="NORM_INVALID") as caught:
        norm_from_cycles(cycles, people, **ABOUT, **more)
    assert found in caught.value.found
