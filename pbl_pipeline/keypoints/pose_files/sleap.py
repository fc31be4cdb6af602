"""SLEAP's analysis .h5: points of each track, NaN where missing, with a score of each point."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .h5_arrays import array_of, texts_of
from .poses import Poses, bad_file


def read_sleap(path: Path, file: Any) -> Poses:
    """Read an open analysis file. See `read_poses`.

    SLEAP writes `tracks` as (track, 2, node, frame), or with its axes in reverse order; row 0 is the video's first
    frame. A point that a person placed has no score.
    """
    names, tracks = texts_of(file["node_names"]), array_of(file["tracks"]).astype(float)
    scores = array_of(file["point_scores"]).astype(float) if "point_scores" in file else None
    if tracks.ndim == 4 and tracks.shape[1:3] == (len(names), 2):
        tracks, scores = tracks.T, None if scores is None else scores.T
    if tracks.ndim != 4 or tracks.shape[1:3] != (2, len(names)):
        expected = f"shape (tracks, 2, {len(names)} nodes, frames), or the reverse"
        raise bad_file(f"tracks of shape {tracks.shape}", expected, key=path)
    xy = np.moveaxis(tracks, (1, 2, 3), (3, 2, 1))
    confidence = np.full(xy.shape[:3], np.nan) if scores is None else np.swapaxes(scores, 1, 2)
    people = texts_of(file["track_names"]) if "track_names" in file else ()
    people = people if len(people) == len(xy) else tuple(str(i) for i in range(1, len(xy) + 1))
    return Poses("SLEAP analysis", np.arange(xy.shape[1]), people, names, xy, confidence)
