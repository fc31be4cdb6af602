"""SLEAP's analysis .h5: points of each track, NaN where missing, with a score of each point."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .h5_arrays import array_of, texts_of
from .poses import Poses, bad_file

_DIMS = ("track", "xy", "node", "frame")


def read_sleap(path: Path, file: Any) -> Poses:
    """Read an open analysis file. See `read_poses`.

    SLEAP writes `tracks` in the order of `_DIMS` or its reverse, sleap-io in any order, which it states as `dims`. Row
    0 is the video's first frame. A point that a person placed has no score.
    """
    names, tracks = texts_of(file["node_names"]), file["tracks"]
    dims = _DIMS[::-1] if tracks.shape[1:3] == (len(names), 2) else _DIMS
    xy = _ordered(tracks, dims, ("track", "frame", "node", "xy"))
    if xy.shape[2:] != (len(names), 2):
        raise bad_file(f"tracks of shape {tracks.shape}", f"{len(names)} nodes of 2 coordinates", key=path)
    confidence = np.full(xy.shape[:3], np.nan)
    if "point_scores" in file:
        confidence = _ordered(file["point_scores"], [d for d in dims if d != "xy"], ("track", "frame", "node"))
    people = texts_of(file["track_names"]) if "track_names" in file else ()
    people = people if len(people) == len(xy) else tuple(str(i) for i in range(1, len(xy) + 1))
    return Poses("SLEAP analysis", np.arange(xy.shape[1]), people, names, xy, confidence)


def _ordered(data: Any, dims: Sequence[str], wanted: Sequence[str]) -> np.ndarray:
    """Values with their axes in another order than `dims`, or than they state themselves."""
    dims = json.loads(data.attrs["dims"]) if "dims" in data.attrs else list(dims)
    return np.transpose(array_of(data).astype(float), [dims.index(d) for d in wanted])
