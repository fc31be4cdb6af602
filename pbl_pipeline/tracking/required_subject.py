"""The one person to measure, or the coded error that says why there is none."""

from __future__ import annotations

from pathlib import Path

from pbl_pipeline.errors import PblError

from .contact_sheets import save_contact_sheet
from .types import SubjectChoice, Tracking
from .walker_score import MOST_LISTED

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
