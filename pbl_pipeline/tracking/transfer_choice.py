"""A decision about one tracking of a video, carried to another tracking of it: numbers are new, people are the same."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import Method
from pbl_pipeline.models import box_iou
from pbl_pipeline.paramset import Paramset

from .contact_sheets import save_contact_sheet
from .methods import SUBJECT_METHODS
from .types import PersonTrack, SubjectChoice, Tracking
from .walker_score import MOST_LISTED, SubjectParams

#: With fewer frames nobody can be followed, whoever is in the picture.
LEAST_FRAMES = 10
#: What to do where no person was found: she may be too small in the picture or too near.
FILM_THE_WHOLE_BODY = "film in light, from where the whole body is in the picture and fills much of its height"


def require_subject(choice: SubjectChoice, tracking: Tracking, video_path: str | Path, sheet: Path) -> int:
    """The chosen person's number. Where a person has to choose, the numbered people are drawn into `sheet` (PNG).

    Raises `PblError` TRACK_NO_PERSON or SUBJECT_NEEDS_CHOICE.
    """
    if choice.person_id is not None:
        return choice.person_id
    if choice.status == "NO_PERSON":
        raise _nobody(tracking, video_path)
    sheet.parent.mkdir(parents=True, exist_ok=True)
    ranked = sorted(choice.scores, key=lambda k: -choice.scores[k])
    save_contact_sheet(video_path, tracking, sheet, ranked)
    named = ", ".join(f"{k} (score {choice.scores[k]:.2f})" for k in ranked[:MOST_LISTED])
    named += f" and {len(ranked) - MOST_LISTED} others" if len(ranked) > MOST_LISTED else ""
    raise PblError(
        "SUBJECT_NEEDS_CHOICE",
        found=f"{len(tracking.persons)} people, none clearly the subject: person {named}",
        expected="one person who walks, is in view longer, or is larger than the others",
        next_step=f"look at {sheet} and call again with --person N, for example --person {ranked[0]}",
        key=str(video_path),
    )


def _nobody(tracking: Tracking, video_path: str | Path) -> PblError:
    n = len(tracking.time_s)
    if n < LEAST_FRAMES:
        return PblError(
            "TRACK_NO_PERSON",
            found=f"nobody can be followed in a video of {n} frame{'s' * (n != 1)}",
            expected="a recording of several steps",
            next_step="choose the recording itself, not a still picture or a preview of it",
            key=str(video_path),
        )
    return PblError(
        "TRACK_NO_PERSON",
        found="no person in any frame",
        expected="a person who takes at least about a fifth of the picture's height",
        next_step=FILM_THE_WHOLE_BODY,
        key=str(video_path),
    )


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
