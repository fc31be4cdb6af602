"""Logs of wearable sensors on a synthetic person: gyroscopes and accelerometers that wobble with the soft tissue.

The wobble is a stationary process with a memory of 0.15 s, as soft tissue's was on recorded walks with both markers and
sensors; the fit assumes the same, so results on these people say nothing of people whose sensors wobble otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from pbl_pipeline.body import body_frames, load_body
from pbl_pipeline.sensors.log import SEGMENTS, SensorLog
from pbl_pipeline.sensors.start import BODY_OF
from pbl_pipeline.synthetic import Truth

#: Standard deviation (deg, each axis) of the wobble, and its memory (s).
WOBBLE_DEG = {"pelvis": 2.0, "thigh": 2.7, "shank": 2.0, "foot": 2.5}
MEMORY_S = 0.15
#: Places on the segments (m, in the body's frame; of the right side).
PLACE_M = {
    "pelvis": (-0.12, 0.05, 0.0),
    "thigh": (0.0, -0.2, 0.08),
    "shank": (0.05, -0.15, 0.02),
    "foot": (0.12, 0.05, 0.0),
}
#: Time (s) in which a person at rest reaches the velocity at the beginning of a recording.
RAMP_S = 0.6
GRAVITY = np.array([0.0, 0.0, 9.81])


def worn(
    truth: Truth,
    seed: int,
    segments: Sequence[str] = SEGMENTS,
    wobble: float = 1.0,
    clock_s: float = 0.08,
    bias_deg_s: float = 1.0,
    mounting_deg: float | Mapping[str, float] = 180.0,
    rate_hz: float = 100.0,
    beyond_s: float = 0.15,
    rest_s: float = 5.0,
    slip: tuple[str, float, float] | None = None,
) -> tuple[tuple[SensorLog, ...], dict[str, Rotation]]:
    """The logs of sensors on a person, and how each sits on its segment (sensor to body).

    `clock_s`: the log's time at the video's time 0. `mounting_deg`: largest angle of a sensor to its segment's axes;
    180: any. `beyond_s`: how far the log goes on after the recording, and before it the other way about: `rest_s` of
    standing still, then a start in `RAMP_S`. `slip`: a sensor that turns on its
    segment about the segment's long axis: its segment, the time (s), the angle (deg).
    """
    rng, body = np.random.default_rng([seed, 77]), load_body()
    before = rest_s + RAMP_S if rest_s else beyond_s
    time = np.arange(truth.time_s[0] - before, truth.time_s[-1] + beyond_s, 1 / rate_hz)
    frames = body_frames(body, _from_rest(truth.time_s, truth.qpos, time, rest_s), truth.scale)
    path = _from_rest(truth.time_s, truth.phone_position_m, time, rest_s)
    logs, mounted = [], {}
    for segment in SEGMENTS:
        kind, index = segment.split("_")[0], body.body_names.index(BODY_OF[segment])
        noise = _memory(rng, len(time), rate_hz) * np.deg2rad(wobble * WOBBLE_DEG[kind])
        axis = rng.normal(size=3)
        most = mounting_deg if isinstance(mounting_deg, float | int) else mounting_deg.get(segment, 180.0)
        mount = Rotation.from_quat(np.random.RandomState(int(rng.integers(2**31))).normal(size=4))
        if most < 180:
            mount = Rotation.from_rotvec(np.deg2rad(most) * axis / np.linalg.norm(axis))
        bias, white = np.deg2rad(rng.normal(0, bias_deg_s, 3)), rng.normal(size=(2, len(time), 3))
        if segment not in segments:
            continue
        R = Rotation.from_matrix(frames.rotation[:, index]) * Rotation.from_rotvec(noise)
        if slip is not None and slip[0] == segment:
            done = np.clip((time - slip[1]) / 0.1, 0, 1)[:, None] * np.deg2rad(slip[2])
            R = R * Rotation.from_rotvec(done * [0.0, 1.0, 0.0])
        R = R * mount
        place = np.array(PLACE_M[kind]) * ([1, 1, -1] if segment.endswith("_l") else [1, 1, 1])
        x = frames.position_m[:, index] + np.einsum("tij,j->ti", frames.rotation[:, index], place) + path
        felt = R.inv().apply(np.gradient(np.gradient(x, time, axis=0), time, axis=0) + GRAVITY)
        rate = (R[:-2].inv() * R[2:]).as_rotvec() * rate_hz / 2
        rate = np.concatenate([rate[:1], rate, rate[-1:]])
        logs.append(
            SensorLog(
                name=segment,
                segment=segment,
                time=time + clock_s,
                rate=rate + bias + np.deg2rad(0.1) * white[0],
                acceleration=felt + 0.02 * white[1],
                orientation=None,
            )
        )
        mounted[segment] = mount
    return tuple(logs), mounted


def _from_rest(time: np.ndarray, x: np.ndarray, at: np.ndarray, rest_s: float) -> np.ndarray:
    """A path (T, ...) at other times; before its first time on from rest along its first velocity."""
    spline = CubicSpline(time, x)
    if not rest_s:
        return spline(at)
    # The integral of a speed that rises smoothly from 0 to 1 within `RAMP_S`.
    u = np.clip((at - time[0]) / RAMP_S + 1, 0.0, 1.0)
    way = RAMP_S * (u**3 - 0.5 * u**4 - 0.5)
    start = spline(time[0]) + way[:, None] * spline(time[0], 1)
    return np.where((at < time[0])[:, None], start, spline(np.maximum(at, time[0])))


def _memory(rng: np.random.Generator, n: int, rate_hz: float) -> np.ndarray:
    """A stationary process (n, 3) of variance 1."""
    keep = np.exp(-1 / rate_hz / MEMORY_S)
    out = rng.normal(size=(n, 3))
    for i in range(1, n):
        out[i] = keep * out[i - 1] + np.sqrt(1 - keep**2) * out[i]
    out = gaussian_filter1d(out, 0.015 * rate_hz, axis=0)
    return out / out.std(axis=0)
