"""OpenPose's JSON: a file for each frame with all people, also as Pose2Sim and RTMLib write it.

A point is x, y, confidence, and 0, 0, 0 where it was not found (NaN by Pose2Sim). The order of the people changes from
frame to frame unless they were tracked (`person_id`). Their number of points says which ones they are, not their names.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import linear_sum_assignment

from pbl_pipeline.body import MarkerSet, marker_set
from pbl_pipeline.bounded import MAX_ARRAYS, count_rows, read_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.tracking import AssociationParams

from .poses import Poses, bad_file, every_frame

_NUMBER = re.compile(r"(\d+)(?:_keypoints)?$")
_ARMS_LEGS = ("neck", *(f"{s}_{p}" for s in ("right", "left") for p in ("shoulder", "elbow", "wrist")))
_LEG = ("hip", "knee", "ankle")
_FACE = ("right_eye", "left_eye", "right_ear", "left_ear")
_FEET = tuple(f"{s}_{p}" for s in ("left", "right") for p in ("big_toe", "small_toe", "heel"))
_BODY_25 = ("nose", *_ARMS_LEGS, "hip", *(f"{s}_{p}" for s in ("right", "left") for p in _LEG), *_FACE, *_FEET)
#: Of COCO's whole body 17 points of the body and 6 of the feet; face and hands follow.
_OF_133 = 23
_COCO_18 = tuple(n for n in _BODY_25 if n != "hip" and n not in _FEET)
#: Fewest points that two detections of a person share; largest distance of a middle (the hips', the neck) from where
#: the points of both sides place it, as a fraction of the trunk.
_SHARED, _MIDDLE = 3, 0.25


def read_openpose(folder: Path, rate_hz: float, table: MarkerSet | None = None) -> Poses:
    """Read a folder of frames. See `read_poses`."""
    files = sorted(folder.glob("*.json"))
    matches = [_NUMBER.search(f.stem) for f in files]
    numbers = np.array([int(m[1]) if m and len(m[1]) < 16 else -1 for m in matches], np.int64)
    if not files or (numbers < 0).any() or len(set(numbers)) < len(files):
        found = f"{len(files)} JSON files, {len(set(numbers[numbers >= 0]))} different numbers of frames in their names"
        expected = "a file for each frame of one recording, such as walk_000000000012_keypoints.json"
        raise bad_file(found, expected, key=folder)
    order = np.argsort(numbers)
    try:
        count_rows(len(files))
        frames = [_people(files[i]) for i in order]
        sizes = {len(points) for people in frames for _, points in people}
        if len(sizes) != 1:
            raise ValueError("no person in any frame" if not sizes else f"people of {sorted(sizes)} points")
        n = _OF_133 if sizes == {133} else min(sizes)
        tracks = _tracks(frames, numbers[order] / rate_hz)
        room = max(MAX_ARRAYS // (8 * 3 * n * len(frames)), 1)
        longest = sorted(sorted(tracks, key=lambda name: len(tracks[name]))[-room:], key=int)
        rows = [np.full((len(frames), n, 3), np.nan) for _ in longest]
        for row, name in zip(rows, longest, strict=True):
            row[[t for t, _ in tracks[name]]] = [points[:n] for _, points in tracks[name]]
        frame, *rows = every_frame(numbers[order], *rows)
    except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
        raise bad_file(str(error), "JSON of OpenPose with people of the same points", key=folder) from error
    points = np.stack(rows)
    found = np.where(np.isfinite(points), points, 0.0)
    return Poses("OpenPose JSON", frame, tuple(longest), _names(folder, found, table), found[..., :2], found[..., 2])


def _people(path: Path) -> list[tuple[int, np.ndarray]]:
    """Number, -1 where not tracked, and points (J, 3) of each person in a frame."""
    try:
        people = read_json(path)["people"]
        found = [(p.get("person_id", -1), np.array(p["pose_keypoints_2d"], float).reshape(-1, 3)) for p in people]
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise ValueError(f"{path.name}: no people with pose_keypoints_2d ({error})") from error
    return [(int(np.ravel(i)[0]), p) for i, p in found if np.nan_to_num(p)[:, 2:].any()]


def _tracks(
    frames: Sequence[list[tuple[int, np.ndarray]]], time_s: np.ndarray
) -> dict[str, list[tuple[int, np.ndarray]]]:
    """Rows and points of each person by name: the program's number, else numbered by first sight (one person if no
    frame has two)."""
    seen = [(t, i, points) for t, people in enumerate(frames) for i, points in people]
    if all(i >= 0 for _, i, _ in seen):
        return {str(i): [(t, p) for t, j, p in seen if j == i] for i in sorted({i for _, i, _ in seen})}
    if max(map(len, frames)) == 1:
        return {"1": [(t, p) for t, _, p in seen]}
    params, tracks = AssociationParams(), []
    for t, people in enumerate(frames):
        live = [track for track in tracks if time_s[t] - time_s[track[-1][0]] <= params.max_gap_s]
        gates = [params.gate + params.gate_per_s * (time_s[t] - time_s[track[-1][0]]) for track in live]
        cost = np.array([_apart(track[-1][1], p) for track in live for _, p in people])
        cost = cost.reshape(len(live), len(people))
        cost = np.where(cost <= np.reshape(gates, (-1, 1)), cost, 1e3)
        pairs = [(i, j) for i, j in zip(*linear_sum_assignment(cost), strict=True) if cost[i, j] < 1e3]
        for i, j in pairs:
            live[i].append((t, people[j][1]))
        tracks += [[(t, p)] for j, (_, p) in enumerate(people) if j not in {j for _, j in pairs}]
    return {str(i): track for i, track in enumerate(tracks, 1)}


def _apart(a: np.ndarray, b: np.ndarray) -> float:
    """Median distance of the points (J, 3) that both have, in sizes of the larger body."""
    both = (a[:, 2] > 0) & (b[:, 2] > 0)
    if both.sum() < _SHARED:
        return 1e3
    size = max(float(np.ptp(p[p[:, 2] > 0, :2], axis=0).max()) for p in (a, b))
    return float(np.median(np.linalg.norm(a[both, :2] - b[both, :2], axis=1))) / max(size, 1e-9)


def _names(folder: Path, points: np.ndarray, table: MarkerSet | None) -> tuple[str, ...]:
    """Names of points (P, T, J, 3) by their number."""
    halpe, n = marker_set("halpe_26").names, points.shape[2]
    orders = {17: halpe[:17], 18: _COCO_18, _OF_133: (*halpe[:17], *_FEET), 25: _BODY_25, 26: halpe}
    if table is not None and n == len(table):
        return table.names
    if n not in orders or (n == 25 and not _is_body_25(points.reshape(-1, n, 3))):
        found = f"{n} points" + " in another order than BODY_25's" * (n == 25)
        expected = "17 (COCO), 18 (OpenPose's COCO), 25 (BODY_25), 26 (Halpe) or 133 (COCO whole body)"
        next_step = "pass --marker-set with a set of these points in their order"
        raise PblError("FILE_FORMAT", found, expected, next_step, key=folder)
    return tuple(orders[n])


def _is_body_25(points: np.ndarray) -> bool:
    """True if the middle of the hips and the neck of points (N, 25, 3) lie there; BODY_25B has arms in their place."""
    xy = np.where(points[..., 2:] > 0, points[..., :2], np.nan)
    at = {name: xy[:, i] for i, name in enumerate(_BODY_25)}
    trunk = np.linalg.norm(at["neck"] - at["hip"], axis=1)
    for middle, part in (("hip", "hip"), ("neck", "shoulder")):
        off = np.linalg.norm(at[middle] - (at[f"left_{part}"] + at[f"right_{part}"]) / 2, axis=1) / trunk
        known = off[np.isfinite(off)]
        if len(known) and np.median(known) > _MIDDLE:
            return False
    return True
