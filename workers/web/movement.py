"""The fitted movement of a recording as a browser takes it: curves and events as JSON, the body as numbers."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from schemas.recording_page import RecordingFit

#: Steps of a pixel and of a metre's hundredth in which outlines are sent.
PIXEL_STEPS, DEPTH_STEPS = 4, 100
#: What stands for an unknown value among them.
UNKNOWN = -32768


def movement_json(found: RecordingFit) -> bytes:
    """Times, joint angles with their 90 % half widths (deg), events, stance, and where a side is uncertain, as JSON.

    `time` (T) s; `curves`: name, by side `value` and `half` (T) deg, null where unknown; `events`: time, side, kind,
    probability; `stance` and `uncertain`: by side, spans (from, to) in s.
    """
    from pbl_pipeline.gait import interval_90, leg_angles, leg_angles_sd
    from pbl_pipeline.render import stance_spans, uncertain_sides
    from pbl_pipeline.runs import runs
    from pbl_pipeline.words import ANGLES

    fit = found.fit
    one = interval_90(0.0, 1.0)
    assert one is not None
    angles, sd = leg_angles(fit), leg_angles_sd(fit)
    far = [(c.far_leg, c.start_s, c.end_s) for c in found.cycles if c.far_leg]
    unsure = uncertain_sides(fit.time_s, far, found.keypoints)
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
        "events": [[round(e.time_s, 4), e.side, e.event, round(e.probability, 3)] for e in found.events],
        "stance": {s: stance_spans(found.events, s) for s in ("left", "right")},
        "uncertain": {
            side: [(float(fit.time_s[r][0]), float(fit.time_s[r][-1])) for r in runs(mask)]
            for side, mask in unsure.items()
        },
        "steps": {"pixel": PIXEL_STEPS, "depth": DEPTH_STEPS, "unknown": UNKNOWN},
    }
    return json.dumps(out, allow_nan=False, separators=(",", ":")).encode()


def outlines(found: RecordingFit) -> tuple[str, bytes]:
    """The body's capsules: the side of each as a letter (l, r, m), and little-endian int16 (T, G, 7): x, y, radius of
    the two discs in `PIXEL_STEPS` of a pixel, depth in `DEPTH_STEPS` of a metre.

    Each frame but the first is what changed since the one before, counted round 2^16: that packs to a third.

    Raises
    ------
    PblError
        FILE_FORMAT for a fit of another body model than the installed one.
    """
    from pbl_pipeline.render import body_track

    track = body_track(found.fit)
    t, g = track.depth_m.shape
    values = np.concatenate(
        [PIXEL_STEPS * track.discs_px.reshape(t, g, 6), DEPTH_STEPS * track.depth_m[..., None]], axis=2
    )
    known = np.isfinite(values).all(axis=2) & (np.abs(values) < -UNKNOWN - 1).all(axis=2)
    whole = np.full(values.shape, UNKNOWN, np.int16)
    whole[known] = np.rint(values[known]).astype(np.int16)
    changes = whole.copy()
    changes[1:] -= whole[:-1]  # int16 counts round
    return "".join(side[0] for side in track.sides), changes.astype("<i2").tobytes()


def _listed(values: np.ndarray) -> list[float | None]:
    return [round(float(v), 2) if np.isfinite(v) else None for v in values]
