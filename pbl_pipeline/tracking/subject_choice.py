"""Choice of the person to measure: by a method, by hand with contact sheets, or as decided for another tracking."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import Method
from pbl_pipeline.models import box_iou
from pbl_pipeline.paramset import Paramset
from pbl_pipeline.results import PersonTrack, SubjectChoice
from pbl_pipeline.video import read_frames

from .methods import SUBJECT_METHODS
from .types import Tracking
from .walker_score import MOST_LISTED, SubjectParams

#: Width of one picture in the sheet (px), least and largest number of pictures, pictures side by side.
_WIDTH, _LEAST, _MOST, _COLUMNS = 640, 4, 9, 3
_JPEG_QUALITY = 85
_COLOURS = ((80, 220, 80), (60, 120, 255), (255, 160, 40), (220, 80, 220), (60, 220, 255), (200, 200, 200))


def contact_sheet(video_path: str | Path, tracking: Tracking, persons: Sequence[int]) -> np.ndarray:
    """Draw a few frames in order of time (H, W, 3) uint8 BGR, all of `persons` boxed and numbered.

    `persons` in order of interest: the frame that shows each best, for as many as there is room, then frames spread
    over the video in which most of them are in view.

    Raises `ValueError` if no one was tracked, and the `PblError`s of `video.read_frames`.
    """
    people = [p for k in persons for p in tracking.persons if p.person_id == k]
    if not people:
        raise ValueError("a contact sheet needs at least one person")
    moments = _moments(people, tracking)
    frames = read_frames(video_path, start=min(moments), stop=max(moments) + 1)
    cells = [_cell(f.image, people, tracking, f.index) for f in frames if f.index in moments]
    columns = min(math.ceil(math.sqrt(len(cells))), _COLUMNS)
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    rows = [np.hstack(cells[i : i + columns]) for i in range(0, len(cells), columns)]
    return np.vstack(rows)


def contact_sheet_jpeg(video_path: str | Path, tracking: Tracking, choice: SubjectChoice) -> bytes:
    """Encode the `contact_sheet` of all people, those with the best scores first, as JPEG. Raises as it."""
    ranked = sorted(choice.scores, key=lambda k: -choice.scores[k])
    return _encoded(contact_sheet(video_path, tracking, ranked), ".jpg")


def save_contact_sheet(
    video_path: str | Path, tracking: Tracking, out_path: str | Path, persons: Sequence[int]
) -> Path:
    """Write the `contact_sheet` as PNG or JPEG, by the suffix of `out_path`.

    Raises as `contact_sheet`, and OSError if the file cannot be written.
    """
    path = Path(out_path)
    suffix = ".png" if path.suffix.lower() == ".png" else ".jpg"
    path.write_bytes(_encoded(contact_sheet(video_path, tracking, persons), suffix))
    return path


def _encoded(sheet: np.ndarray, suffix: str) -> bytes:
    options = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY] if suffix == ".jpg" else []
    done, data = cv2.imencode(suffix, sheet, options)
    if not done:
        raise OSError(f"a picture of {sheet.shape[1]}x{sheet.shape[0]} px could not be encoded as {suffix}")
    return data.tobytes()


def _moments(people: Sequence[PersonTrack], tracking: Tracking) -> set[int]:
    """Frame numbers: the best of each person, then some in the middle of the longest stretches without one."""
    chosen = {_best_frame(p, tracking.image_size_px) for p in people[:_MOST]}
    in_view = np.sum([np.isfinite(p.box_px[:, 0]) for p in people], axis=0)
    n = len(tracking.time_s)
    while len(chosen) < min(_LEAST, n):
        edges = [-1, *sorted(chosen), n]
        gaps = [(b - a, a) for a, b in itertools.pairwise(edges) if b - a > 1]
        length, start = max(gaps)
        # In the inner third of the gap, where most people are in view.
        inner = np.arange(start + 1 + (length - 1) // 3, start + length - (length - 1) // 3)
        chosen.add(int(inner[np.argmax(in_view[inner])]))
    return chosen


def _best_frame(person: PersonTrack, size: tuple[int, int]) -> int:
    """Frame that shows the person best: with a high score, and not cut by the picture's edge."""
    box = person.box_px
    inside = np.all((box > 1) & (box < np.array([*size, *size]) - 1), axis=1)
    return int(np.argmax(np.where(np.isfinite(box[:, 0]), person.score + inside, -1.0)))


def _cell(image: np.ndarray, people: Sequence[PersonTrack], tracking: Tracking, frame: int) -> np.ndarray:
    scale = _WIDTH / tracking.image_size_px[0]
    cell = cv2.resize(image, (_WIDTH, max(round(tracking.image_size_px[1] * scale), 1)), interpolation=cv2.INTER_AREA)
    for p in sorted(people, key=lambda p: p.person_id):
        if not np.isfinite(p.box_px[frame, 0]):
            continue
        x0, y0, x1, y1 = (round(float(v) * scale) for v in p.box_px[frame])
        colour = _COLOURS[(p.person_id - 1) % len(_COLOURS)]
        cv2.rectangle(cell, (x0, y0), (x1, y1), colour, 3 if _best_frame(p, tracking.image_size_px) == frame else 2)
        _label(cell, str(p.person_id), (x0, y0), 0.9, colour)
    _label(cell, f"{tracking.time_s[frame]:.2f} s", (0, cell.shape[0] - 30), 0.7, (255, 255, 255))
    return cell


def _label(cell: np.ndarray, text: str, corner: tuple[int, int], size: float, colour: tuple[int, int, int]) -> None:
    """Text on a black field whose upper left corner is `corner`, moved into the picture."""
    (width, height), below = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, size, 2)
    x = int(np.clip(corner[0], 0, max(cell.shape[1] - width - 8, 0)))
    y = int(np.clip(corner[1], 0, max(cell.shape[0] - height - below - 8, 0)))
    cv2.rectangle(cell, (x, y), (x + width + 8, y + height + below + 6), (0, 0, 0), -1)
    cv2.putText(cell, text, (x + 4, y + height + 4), cv2.FONT_HERSHEY_SIMPLEX, size, colour, 2, cv2.LINE_AA)


#: Least number of frames in which a person can be followed.
LEAST_FRAMES = 10
#: Advice if no person was found: one may be too small in the picture or too near.
FILM_THE_WHOLE_BODY = "film in light, from where the whole body is in the picture and fills much of its height"


def require_subject(choice: SubjectChoice, tracking: Tracking, video_path: str | Path, sheet: Path) -> int:
    """Return the chosen person's number. If a person has to choose, the numbered people are drawn into `sheet` (PNG).

    Raises `PblError` TRACK_NO_PERSON or SUBJECT_NEEDS_CHOICE.
    """
    if choice.person_id is not None:
        return choice.person_id
    if choice.status == "NO_PERSON":
        raise _no_person(tracking, video_path)
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


def _no_person(tracking: Tracking, video_path: str | Path) -> PblError:
    n = len(tracking.time_s)
    if n < LEAST_FRAMES:
        return PblError(
            "TRACK_NO_PERSON",
            found=f"no one can be followed in a video of {n} frame{'s' * (n != 1)}",
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
    """Choose the person to measure. `params` as for `SUBJECT_METHODS.find`; `override` is the person's number chosen by
    hand, which takes precedence (status MANUAL).

    Raises `PblError` SUBJECT_UNKNOWN_PERSON if the override is not among the persons, SOLVER_UNKNOWN.
    """
    method = SUBJECT_METHODS.find(params)
    return method.function(tracking, method.params, override)


#: Least mean overlap (intersection over union) of the body boxes of one person in two trackings, over the frames in
#: which either is in view.
SAME_OVERLAP = 0.4


def same_person(decided: Tracking, person_id: int, tracking: Tracking) -> int | None:
    """Number in `tracking` of the person `person_id` of `decided`, both of the same video; None if no match is certain.

    Each must be the other's best match: if the person was not found, the one next to her must not be taken for her.
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
    """Carry a choice by hand, `person_id` in `decided` (a tracking by `method`), over to another `tracking`.

    The same person is chosen (status CHOSEN). If no match is certain, a person has to choose again, as the automatic
    choice may differ from the decision. `params` as for `choose_subject`.
    """
    found = same_person(decided, person_id, tracking)
    if found is not None:
        reason = f"Person {found} was recognised: chosen by hand in the tracking {method}."
        return dataclasses.replace(choose_subject(tracking, params, found), status="CHOSEN", reason=reason)
    choice = choose_subject(tracking, params)
    if choice.person_id is None:
        return choice
    reason = (
        f"Person {person_id} of the tracking {method} was chosen by hand and cannot be recognised for "
        "certain here. Choose the person again."
    )
    return dataclasses.replace(choice, status="NEEDS_CHOICE", person_id=None, reason=reason)


def _overlap(a: PersonTrack, b: PersonTrack) -> float:
    """Mean intersection over union of the boxes over the frames in which at least one of the two is in view; 0 in
    frames with only one."""
    here, there = a.box_px.astype(np.float64), b.box_px.astype(np.float64)
    in_here, in_there = np.isfinite(here).all(axis=1), np.isfinite(there).all(axis=1)
    both, n = in_here & in_there, int((in_here | in_there).sum())
    return float(box_iou(here[both], there[both]).sum()) / max(n, 1)
