"""A picture of the people found, boxed and numbered, for the person who has to choose."""

from __future__ import annotations

import math
from pathlib import Path

import cv2
import numpy as np

from pbl_pipeline.video import read_frames

from ._types import Tracking

#: Width of one frame in the sheet, px.
_WIDTH = 640
_COLOURS = ((80, 220, 80), (60, 120, 255), (255, 160, 40), (220, 80, 220), (60, 220, 255), (200, 200, 200))


def save_contact_sheet(video_path: str | Path, tracking: Tracking, out_path: str | Path) -> Path:
    """Write a PNG with one frame per person, in which her box is thick and everybody's number stands at the box.

    Raises `ValueError` when nobody was tracked, OSError when the file cannot be written.
    """
    if not tracking.persons:
        raise ValueError("a contact sheet needs at least one person")
    shown = {p.person_id: _best_frame(p.box_px, p.score, tracking.image_size_px) for p in tracking.persons}
    wanted = set(shown.values())
    images = {}
    for frame in read_frames(video_path, start=min(wanted), stop=max(wanted) + 1):
        if frame.index in wanted:
            images[frame.index] = frame.image
    cells = [_cell(images[shown[p.person_id]], tracking, p.person_id, shown[p.person_id]) for p in tracking.persons]
    columns = min(len(cells), 3)
    cells += [np.zeros_like(cells[0])] * (-len(cells) % columns)
    rows = [np.hstack(cells[i * columns : (i + 1) * columns]) for i in range(math.ceil(len(cells) / columns))]
    done, data = cv2.imencode(".png", np.vstack(rows))
    if not done:
        raise OSError(f"the picture {out_path} could not be encoded")
    Path(out_path).write_bytes(data.tobytes())
    return Path(out_path)


def _best_frame(box: np.ndarray, score: np.ndarray, size: tuple[int, int]) -> int:
    """The frame in which the person is seen best: surely, and not cut by the picture's edge."""
    inside = np.all((box > 1) & (box < np.array([*size, *size]) - 1), axis=1)
    return int(np.argmax(np.where(np.isfinite(box[:, 0]), score + inside, -1.0)))


def _cell(image: np.ndarray, tracking: Tracking, person_id: int, frame: int) -> np.ndarray:
    scale = _WIDTH / image.shape[1]
    cell = cv2.resize(image, (_WIDTH, max(round(image.shape[0] * scale), 1)), interpolation=cv2.INTER_AREA)
    for p in tracking.persons:
        if not np.isfinite(p.box_px[frame, 0]):
            continue
        x0, y0, x1, y1 = (round(float(v) * scale) for v in p.box_px[frame])
        colour = _COLOURS[(p.person_id - 1) % len(_COLOURS)]
        cv2.rectangle(cell, (x0, y0), (x1, y1), colour, 4 if p.person_id == person_id else 1)
        cv2.putText(cell, str(p.person_id), (x0 + 4, y0 + 28), cv2.FONT_HERSHEY_SIMPLEX, 0.9, colour, 2, cv2.LINE_AA)
    label = f"person {person_id} at {tracking.time_s[frame]:.2f} s"
    cv2.rectangle(cell, (0, cell.shape[0] - 34), (230, cell.shape[0]), (0, 0, 0), -1)
    cv2.putText(cell, label, (8, cell.shape[0] - 10), cv2.FONT_HERSHEY_SIMPLEX, 0.7, (255, 255, 255), 1, cv2.LINE_AA)
    return cell
