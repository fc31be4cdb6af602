"""Choice of the person to measure by a named method."""

from __future__ import annotations

from pbl_pipeline.methods import Method
from pbl_pipeline.paramset import Paramset

from .methods import SUBJECT_METHODS
from .types import SubjectChoice, Tracking
from .walker_score import SubjectParams


def choose_subject(
    tracking: Tracking,
    params: Method[SubjectParams] | Paramset | SubjectParams | str | None = None,
    override: int | None = None,
) -> SubjectChoice:
    """Choose the person to measure. `params` is what `SUBJECT_METHODS.find` takes; `override` is a person's number that
    a human chose: it wins (status MANUAL).

    Raises `PblError` SUBJECT_UNKNOWN_PERSON when the override is not among the persons, SOLVER_UNKNOWN.
    """
    method = SUBJECT_METHODS.find(params)
    return method.function(tracking, method.params, override)
