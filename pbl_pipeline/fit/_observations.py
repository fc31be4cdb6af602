"""What was seen in a session, as arrays on the device: the frames of all trials one after another.

Frames, markers and trials are padded to a few sizes, so that a worker compiles a handful of programs. Padding has
weight 0 everywhere and never changes a result. On a GPU the sizes are fewer: there a program takes ten seconds to
compile and many sessions of one size are solved in little more time than one, while on a CPU each padded frame counts.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import gaussian_filter1d

from ._rotation import quat_wxyz, rotation_matrices

#: Sizes to which markers are padded; larger sets are padded to a multiple of 64.
MARKER_SIZES = (24, 40, 64, 96, 128)
#: Fewest frames of a program, in all trials together; and on a GPU fewest frames, trials and samples of the phone.
MIN_FRAMES = 64
COARSE_FRAMES, COARSE_TRIALS, COARSE_SAMPLES = 256, 4, 2048
#: Points of the soles (`solvers/_contact.py`).
SOLE_POINTS = 4
#: Frame interval (s) for which second differences are stated: 30 Hz.
FRAME_S = 1 / 30


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observations:
    """F frames of all trials, V views, J markers, N trials; P samples of the phone's orientation per trial.

    time_s counts from each trial's first frame; `trial` is the number of a frame's trial; `weight` is 1 for a frame
    that counts and 0 for others. Confidences are 0 where nothing was seen; values there are finite and do not count.
    `xy_px` are pixels of an ideal pinhole camera (undistorted). `bend` holds the weights of the frames before, at and
    after a frame in the second difference there (per 1/30 s squared), 0 where it is not formed. `contact`: how surely
    each of S points of the soles stands (0 to 1), 0 until a first solution tells. `sample_*`: the phone's orientation
    R_nc as quaternions at a fixed interval, from `sample_start_s` on; there where `has_phone` is 1.
    """

    time_s: Float[Array, " F"]
    trial: Int[Array, " F"]
    weight: Float[Array, " F"]
    x_cam: Float[Array, "F V J 3"]
    c_3d: Float[Array, "F V J"]
    xy_px: Float[Array, "F V J 2"]
    c_2d: Float[Array, "F V J"]
    x_world: Float[Array, "F J 3"]
    c_world: Float[Array, "F J"]
    R_nc: Float[Array, "F V 3 3"]
    p_nc: Float[Array, "F V 3"]
    camera_matrix: Float[Array, "F V 3 3"]
    bend: Float[Array, "F 3"]
    n_markers: Float[Array, ""]
    n_views: Float[Array, ""]
    contact: Float[Array, "F S"]
    has_phone: Float[Array, " N"]
    sample_quat_wxyz: Float[Array, "N P 4"]
    sample_start_s: Float[Array, " N"]
    sample_step_s: Float[Array, ""]


@dataclasses.dataclass(frozen=True)
class TrialArrays:
    """One trial before padding (NumPy, float64): T frames, V views, J markers. Fields as in `Observations`.

    `used` (T,) bool: frames that count. phone_time_s (P,) on the video's clock, phone_quat_wxyz (P, 4): orientation of
    the one camera where it moves, else None.
    """

    time_s: np.ndarray
    used: np.ndarray
    x_cam: np.ndarray
    c_3d: np.ndarray
    xy_px: np.ndarray
    c_2d: np.ndarray
    x_world: np.ndarray
    c_world: np.ndarray
    R_nc: np.ndarray
    p_nc: np.ndarray
    camera_matrix: np.ndarray
    phone_time_s: np.ndarray | None = None
    phone_quat_wxyz: np.ndarray | None = None


#: Interval (s) of the phone's orientation as the solvers see it, and how far beyond the trial it is kept (s): the
#: largest offset between the two clocks.
SAMPLE_S, CLOCK_RANGE_S = 0.01, 0.5
#: Width (s, standard deviation) over which the phone's orientation is averaged. Interpolated as it is, its noise is
#: least half way between two samples, and the clock's offset would lock to those places. A hand's 3 Hz lose 7 %.
SMOOTH_S = 0.02


def pad_frames(n: int, coarse: bool = False) -> int:
    """The size to which `n` frames are padded: 64, 96, 128, 192, 256, 384 ...; `coarse`: 256 or more of these."""
    size = COARSE_FRAMES if coarse else MIN_FRAMES
    while size < n:
        size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
    return size


def pad_samples(n: int, coarse: bool = False) -> int:
    """The size to which `n` samples of the phone's orientation are padded."""
    return max(COARSE_SAMPLES, power_of_2(n)) if coarse else pad_frames(n)


def pad_markers(n: int) -> int:
    """The size to which `n` markers are padded."""
    return next((s for s in MARKER_SIZES if s >= n), -(-n // 64) * 64)


def pad_trials(n: int, coarse: bool = False) -> int:
    """The size to which `n` trials are padded: a power of 2."""
    return max(COARSE_TRIALS if coarse else 1, power_of_2(n))


def power_of_2(n: int) -> int:
    """The least power of 2 that is `n` or more."""
    return 1 << (n - 1).bit_length()


def bend_weights(time_s: np.ndarray, used: np.ndarray) -> np.ndarray:
    """(T, 3): weights of the frames before, at and after each in the second difference, per (1/30 s)^2.

    The second derivative of the parabola through three frames at any spacing. Formed between the first and the last
    frame that counts; frames in a gap between are carried by it.
    """
    out = np.zeros((len(time_s), 3))
    index = np.flatnonzero(used)
    if index.size == 0:
        return out
    t = np.arange(max(index[0], 0) + 1, index[-1])
    before, after = time_s[t] - time_s[t - 1], time_s[t + 1] - time_s[t]
    scale = 2 * FRAME_S**2 / (before + after)
    out[t] = np.stack([scale / before, -scale * (1 / before + 1 / after), scale / after], axis=1)
    return out


def pack(trials: Sequence[TrialArrays]) -> Observations:
    """All trials of a session as one `Observations`, still on the host."""
    coarse = jax.default_backend() != "cpu"
    total = sum(len(t.time_s) for t in trials)
    frames, markers = pad_frames(total, coarse) - total, pad_markers(trials[0].c_world.shape[1])
    n_markers = trials[0].c_world.shape[1]
    n = pad_trials(len(trials), coarse)

    def joined(field: str, marker_axis: int | None = None) -> np.ndarray:
        a = np.concatenate([getattr(t, field) for t in trials])
        widths = [(0, 0)] * a.ndim
        widths[0] = (0, frames)
        if marker_axis is not None:
            widths[marker_axis] = (0, markers - n_markers)
        return np.pad(a, widths, mode="constant" if marker_axis is not None else "edge")

    used = np.concatenate([t.used for t in trials])
    quats, starts = _phone_samples(trials, n, coarse)
    bend = np.concatenate([bend_weights(t.time_s, t.used) for t in trials])
    arrays = {
        "time_s": np.concatenate([t.time_s - t.time_s[0] for t in trials] + [np.zeros(frames)]),
        "weight": np.pad(used.astype(float), (0, frames)),
        "x_cam": joined("x_cam", 2),
        "c_3d": joined("c_3d", 2) * _padded(used, frames)[:, None, None],
        "xy_px": joined("xy_px", 2),
        "c_2d": joined("c_2d", 2) * _padded(used, frames)[:, None, None],
        "x_world": joined("x_world", 1),
        "c_world": joined("c_world", 1) * _padded(used, frames)[:, None],
        "R_nc": joined("R_nc"),
        "p_nc": joined("p_nc"),
        "camera_matrix": joined("camera_matrix"),
        "bend": np.pad(bend, [(0, frames), (0, 0)]),
        "contact": np.zeros((total + frames, SOLE_POINTS)),
        "n_markers": np.asarray(n_markers),
        "n_views": np.asarray(max(trials[0].c_3d.shape[1], 1)),
        "has_phone": np.pad([float(t.phone_time_s is not None) for t in trials], (0, n - len(trials))),
        "sample_quat_wxyz": quats,
        "sample_start_s": starts,
        "sample_step_s": np.asarray(SAMPLE_S),
    }
    number = np.concatenate([np.full(len(t.time_s), i) for i, t in enumerate(trials)])
    f32: dict[str, Any] = {k: np.asarray(v, np.float32) for k, v in arrays.items()}
    f32["trial"] = np.pad(number, (0, frames), mode="edge").astype(np.int32)
    return Observations(**f32)


def _padded(used: np.ndarray, frames: int) -> np.ndarray:
    return np.pad(used.astype(float), (0, frames))


def _phone_samples(trials: Sequence[TrialArrays], n: int, coarse: bool) -> tuple[np.ndarray, np.ndarray]:
    """Orientations (n, P, 4) every `SAMPLE_S` and the time (n,) of the first, on each trial's own clock."""
    moving = [i for i, t in enumerate(trials) if t.phone_time_s is not None]
    if not moving:
        return np.tile([1.0, 0, 0, 0], (n, 2, 1)), np.zeros(n)
    longest = max(t.time_s[-1] - t.time_s[0] for t in trials) + 2 * CLOCK_RANGE_S
    needed = int(np.ceil(longest / SAMPLE_S)) + 2
    out = np.tile([1.0, 0, 0, 0], (n, pad_samples(needed, coarse), 1))
    for i in moving:
        trial = trials[i]
        assert trial.phone_time_s is not None
        assert trial.phone_quat_wxyz is not None
        at = trial.time_s[0] - CLOCK_RANGE_S + SAMPLE_S * np.arange(needed)
        quat = quat_wxyz(rotation_matrices(trial.phone_time_s, trial.phone_quat_wxyz, at))
        smooth = gaussian_filter1d(quat, SMOOTH_S / SAMPLE_S, axis=0, mode="nearest")
        out[i, :needed] = smooth / np.linalg.norm(smooth, axis=1, keepdims=True)
        out[i, needed:] = out[i, needed - 1]
    return out, np.full(n, -CLOCK_RANGE_S)
