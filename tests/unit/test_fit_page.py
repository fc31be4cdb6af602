"""docs/fit.md states the cost that is minimised: its table has the terms of the list, their parameters and unknowns."""

import dataclasses
import re
from pathlib import Path
from typing import Any

import jax
import pytest

from pbl_pipeline.fit import CostParams, GaussNewtonParams
from pbl_pipeline.fit.objective import PAPER, TERMS
from pbl_pipeline.fit.weights import Weights
from tests.unit.test_gauss_newton import PARAMS, at_state, away, small_session

pytestmark = pytest.mark.slow

PAGE = (Path(__file__).resolve().parents[2] / "docs/fit.md").read_text()
#: Parameters that become arrays before a term sees them.
OF_SMOOTHNESS = {"smooth_per_rad2", "smooth_per_m2", "smooth_up_per_m2"}
OF_ARRAYS = {"pose_prior_deg", "pose_prior", "scale_sd", "scale_sides_sd", *OF_SMOOTHNESS}


def rows() -> list[list[str]]:
    """The cells of the table of terms."""
    table = PAGE.split("## The terms")[1].split("\n\n## ")[0]
    lines = [line for line in table.splitlines() if line.startswith("| ")]
    return [[c.strip().replace("\\|", "|") for c in re.split(r"(?<!\\)\|", line)[1:-1]] for line in lines[1:]]


class Noted(dict):
    """Numbers of a paramset that note which are read."""

    def __init__(self, numbers: dict) -> None:
        super().__init__(numbers)
        self.read: set[str] = set()

    def __getitem__(self, name: str) -> Any:
        self.read.add(name)
        return super().__getitem__(name)


@pytest.fixture(scope="module")
def read() -> dict[str, set[str]]:
    """Term -> parameters that its value reads, where the problem has something for it."""
    params = dataclasses.replace(PARAMS, weight_pelvis=0.5)
    found: dict[str, set[str]] = {}
    for kind in ("moving floor pelvis detector sensors depths", "world"):
        session = small_session(kind)
        w, state = Weights.of(session.body, params), away(session, detector="detector" in kind)
        noted = {term.name: Noted(w.numbers) for term in TERMS}

        def values(session=session, w=w, state=state, noted=noted):
            at = at_state(session, w, state)
            return [t.value(at._replace(weights=dataclasses.replace(w, numbers=noted[t.name]))) for t in TERMS]

        jax.eval_shape(values)  # reading needs no numbers
        for name, numbers in noted.items():
            found[name] = found.get(name, set()) | numbers.read
    return found


def test_the_table_has_the_terms_of_the_list():
    assert [r[0] for r in rows()] == [t.name for t in TERMS]
    assert [r[4] for r in rows()] == [t.unknowns.value for t in TERMS]
    assert {t.name for t in PAPER} == {r[0] for r in rows()[:5]}


def test_the_table_names_the_parameters_that_a_term_reads(read):
    fields = {f.name for cls in (CostParams, GaussNewtonParams) for f in dataclasses.fields(cls)}
    for name, residual, weight, more, _ in rows():
        named = set(re.findall(r"`(\w+)`", weight + more))
        assert named <= fields
        assert named - OF_ARRAYS == read[name], (name, residual)
    of_terms = {n for n in fields if re.match("weight_|huber_|smooth_", n) or n in OF_ARRAYS}
    assert of_terms == of_terms & {n for r in rows() for n in re.findall(r"`(\w+)`", r[2] + r[3])}
