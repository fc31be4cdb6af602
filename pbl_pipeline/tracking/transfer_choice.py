"""A decision about one tracking of a video, carried to another tracking of it: numbers are new, people are the same."""

from __future__ import annotations

import dataclasses

import numpy as np

from pbl_pipeline.methods import Method
from pbl_pipeline.models import box_iou
from pbl_pipeline.paramset import Paramset

from .subject_choice import choose_subject
from .types import PersonTrack, SubjectChoice, Tracking
from .walker_score import SubjectParams

#: Mean overlap (intersection over union) of the body boxes, over the frames in which either is in view, from which two
#: tracks may be of one person.
SAME_OVERLAP = 0.4


def same_person(decided: Tracking, person_id: int, tracking: Tracking) -> int | None:
    """Number in `tracking` of the person `person_id` of `decided`, both of the same video; None if no match is certain.

    Each must be the other's best match: where she was not found, the one beside her is not taken for her.
    """
    if len(decided.time_s) != len(tracking.time_s) or not tracking.persons:
        return None
    there = next(p for p in decided.persons if p.person_id == person_id)
    best = max(tracking.persons, key=lambda p: _overlap(there, p))
    back = max(decided.persons, key=lambda p: _overlap(p, best))
    return best.person_id if back is there and _overlap(there, best) >= SAME_OVERLAP else None


def carried_choice(
    decided: Tracking,
    person_id: int,
    method: str,
    tracking: Tracking,
    params: Method[SubjectParams] | Paramset | SubjectParams | str | None = None,
) -> SubjectChoice:
    """The choice in `tracking` after somebody chose `person_id` by hand in `decided`, another tracking (by `method`).

    It is the same person (status CHOSEN). If no match is certain, somebody has to choose again: what the automatic
    choice would say is not what somebody decided. `params` as for `choose_subject`.
    """
    found = same_person(decided, person_id, tracking)
    if found is not None:
        reason = f"Person {found} is the one whom somebody chose by hand in the tracking {method}."
        return dataclasses.replace(choose_subject(tracking, params, found), status="CHOSEN", reason=reason)
    choice = choose_subject(tracking, params)
    if choice.person_id is None:
        return choice
    reason = (
        f"In the tracking {method} person {person_id} was chosen by hand, whom nobody here surely is. A person has to "
        "choose again."
    )
    return dataclasses.replace(choice, status="NEEDS_CHOICE", person_id=None, reason=reason)


def _overlap(a: PersonTrack, b: PersonTrack) -> float:
    """Mean intersection over union of the boxes over the frames in which one of the two is in view, 0 where one only
    is."""
    here, there = a.box_px.astype(np.float64), b.box_px.astype(np.float64)
    in_here, in_there = np.isfinite(here).all(axis=1), np.isfinite(there).all(axis=1)
    both, n = in_here & in_there, int((in_here | in_there).sum())
    return float(box_iou(here[both], there[both]).sum()) / max(n, 1)
