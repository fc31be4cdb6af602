"""The fitted movement of a recording as a browser takes it: curves and events as JSON, the body as numbers."""

from __future__ import annotations

import dataclasses
import json
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.visit import Recording

#: Steps of a metre, of a body's quaternion and of the camera's in which poses are sent: a millimetre; a half step of a
#: quaternion is 0.01 deg, of the camera's 0.2 px at a focal length of 1,500 px.
METRE_STEPS, TURN_STEPS, CAMERA_STEPS = 1000, 4096, 8192
#: Steps of a pixel in which detected points are sent, and how far from the picture's corner one may be, in its longer
#: sides.
POINT_STEPS, _FAR = 2, 2.0


@dataclasses.dataclass(frozen=True)
class Movement:
    """Data of a recording's page: `movement_json`, the numbers of `body_json`, `points_bytes`."""

    movement: bytes
    body: bytes
    points: bytes

    @classmethod
    def of(cls, found: Recording) -> Movement:
        """Return all three. Raises as they do."""
        body, numbers = body_json(found)
        return cls(movement_json(found, body), numbers, points_bytes(found))


def movement_json(found: Recording, body: dict[str, Any]) -> bytes:
    """Times, joint angles with their 90 % half widths (deg), events, stance, and where a side is uncertain, as JSON.

    `time` (T) s; `curves`: name, by side `value` and `half` (T) deg, null where unknown; `events`: time, side, kind,
    probability; `stance` and `uncertain`: by side, spans (from, to) in s; `body`: that of `body_json`; `points`: how
    many there are.
    """
    from pbl_pipeline.gait import interval_90, leg_angles, leg_angles_sd
    from pbl_pipeline.render import stance_spans, uncertain_sides
    from pbl_pipeline.runs import runs
    from pbl_pipeline.words import ANGLES

    fit, events = _fit(found), found.events.events if found.events else ()
    one = interval_90(0.0, 1.0)
    assert one is not None
    angles, sd = leg_angles(fit), leg_angles_sd(fit)
    far = [(c.far_leg, c.start_s, c.end_s) for c in found.cycles if c.far_leg]
    unsure = uncertain_sides(fit.time_s, far, found.keypoints, sd)
    curves = [
        {
            "name": title,
            **{
                side: {"value": _listed(angles[side][name]), "half": _listed(one[1] * sd[side][name])}
                for side in ("left", "right")
                if name in angles[side]
            },
        }
        for name, (title, _) in ANGLES.items()
    ]
    out: dict[str, Any] = {
        "time": [round(float(t), 5) for t in fit.time_s],
        "size": [int(v) for v in fit.image_size_px],
        "curves": [c for c in curves if len(c) > 1],
        "events": [[round(e.time_s, 4), e.side, e.event, round(e.probability, 3)] for e in events],
        "stance": {s: stance_spans(events, s) for s in ("left", "right")},
        "uncertain": {
            side: [(float(fit.time_s[r][0]), float(fit.time_s[r][-1])) for r in runs(mask)]
            for side, mask in unsure.items()
        },
        "body": body,
        "points": 0 if found.keypoints is None else len(found.keypoints.names),
    }
    return json.dumps(out, allow_nan=False, separators=(",", ":")).encode()


def body_json(found: Recording) -> tuple[dict[str, Any], bytes]:
    """The fitted body and the camera as the page's script draws them (`static/body.js`).

    Raises `PblError` FILE_FORMAT for a fit of another body model than the installed one, and for movement that cannot
    be sent.

    Returns
    -------
    dict
        `sides` of the B bodies as letters (l, r, m), `legs`: indices of those of a leg, `parent`, `offset` (m, in the
        parent's frame), `capsules` (body, start x y z, end x y z, radius; m, in the body's frame), `floor` and `start`
        (m: height of the floor, where the root is in the first known frame), `known`: runs of frames (first, last) with
        a pose, and `steps`. `camera`: `lens` (fx, fy, cx, cy px), `distortion` (k1, k2, p1, p2, k3), `turning` (squared
        radius up to which that is a lens), `near` and `position` (m), `known`; null if there is no camera.
    bytes
        Channels (C, T): root x, y, z relative to `start`, four of each body's quaternion (w, x, y, z), four of the
        camera's, in steps. Of each channel second differences, first the low bytes of all, then the high bytes: that
        packs to a third. Frames without a pose repeat the one before.
    """
    from pbl_pipeline.render import NEAR_M, body_track, without_jumps
    from pbl_pipeline.runs import ranges
    from pbl_pipeline.video import turning_radius2

    fit = _fit(found)
    track = body_track(fit)
    t = len(track.root_m)
    known = _finite(track.quat_wxyz) & _finite(track.root_m)
    quat, position = np.asarray(fit.phone_quat_wxyz, float), np.asarray(fit.camera_position_m, float)
    aimed = _finite(quat) & bool(np.isfinite(position).all() and np.isfinite(fit.camera.matrix).all())
    turning = turning_radius2(fit.camera) if aimed.any() else np.inf
    start = track.root_m[np.argmax(known)] if known.any() else np.zeros(3)
    channels = np.concatenate(
        [
            METRE_STEPS * _held(track.root_m - start, known),
            TURN_STEPS * _held(track.quat_wxyz.reshape(t, -1), known),
            CAMERA_STEPS * _held(without_jumps(quat / np.linalg.norm(quat, axis=1, keepdims=True)), aimed),
        ],
        axis=1,
    )
    shapes, m = track.shapes, np.asarray(fit.camera.matrix, float)
    capsules = np.concatenate([shapes.start, shapes.end, shapes.radius_m[:, None]], axis=1)
    body: dict[str, Any] = {
        "sides": "".join(side[0] for side in track.sides),
        "legs": np.flatnonzero(track.leg).tolist(),
        "parent": [int(p) for p in track.parent],
        "offset": np.round(track.offset_m, 6).tolist(),
        "capsules": [[int(b), *np.round(c, 6).tolist()] for b, c in zip(shapes.body, capsules, strict=True)],
        "floor": round(track.floor_m, 4) if np.isfinite(track.floor_m) else None,
        "start": np.round(start, 6).tolist(),
        "known": ranges(known),
        "steps": {"metre": METRE_STEPS, "turn": TURN_STEPS, "camera": CAMERA_STEPS},
        "camera": {
            "lens": [float(v) for v in (m[0, 0], m[1, 1], m[0, 2], m[1, 2])],
            "distortion": [float(v) for v in fit.camera.distortion],
            "turning": turning if np.isfinite(turning) else None,
            "near": NEAR_M,
            "position": position.tolist(),
            "known": ranges(aimed),
        }
        if aimed.any()
        else None,
    }
    return body, _packed(np.rint(channels).astype(np.int64).T, fit.name)


def points_bytes(found: Recording) -> bytes:
    """The detected points: channels (2 J, T) x, y in half pixels, packed as those of `body_json`, then their confidence
    (J, T) in 255ths as bytes, 0 if a point is not known. Empty if the fit is of markers."""
    points = found.keypoints
    if points is None or len(points.time_s) != len(_fit(found).time_s):
        return b""
    xy, confidence = np.asarray(points.xy_px, float), np.asarray(points.confidence, float)
    known = np.isfinite(xy).all(axis=2) & (np.abs(xy) < _FAR * max(points.image_size_px)).all(axis=2) & (confidence > 0)
    held = np.stack([_held(xy[:, j], known[:, j]) for j in range(xy.shape[1])], axis=1)
    channels = np.rint(POINT_STEPS * held).astype(np.int64).reshape(len(xy), -1).T
    shares = np.rint(255 * np.where(known, np.clip(confidence, 0, 1), 0)).astype(np.uint8)
    # A point that is known does not become unknown by rounding.
    shares[known & (shares == 0)] = 1
    return _packed(channels, _fit(found).name) + shares.T.tobytes()


def _fit(found: Recording) -> TrialFit:
    assert found.fit is not None  # only fitted recordings are asked for
    return found.fit


def _packed(channels: np.ndarray, name: str) -> bytes:
    """Second differences of (C, T) whole numbers as bytes: low ones, then high ones."""
    changes = channels.copy()
    changes[:, 1:] -= channels[:, :-1]
    again = changes.copy()
    again[:, 2:] -= changes[:, 1:-1]
    if np.abs(again).max(initial=0) > 32767:
        found = "a body that is metres away from one frame to the next"
        next_step = "look at the checks of the fit; fit the recording again"
        raise PblError("FILE_FORMAT", found, "the movement of a person", next_step, key=name)
    return again.astype("<i2").view(np.uint8).reshape(-1, 2).T.tobytes()


def _held(values: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Rows (T, N), those that are not known as the known one before, the first ones as the first known; else 0."""
    if not known.any():
        return np.zeros(values.shape)
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), np.argmax(known)))
    return values[last]


def _finite(values: np.ndarray) -> np.ndarray:
    return np.asarray(np.isfinite(values).all(axis=tuple(range(1, values.ndim))), bool)


def _listed(values: np.ndarray) -> list[float | None]:
    return [round(float(v), 2) if np.isfinite(v) else None for v in values]
