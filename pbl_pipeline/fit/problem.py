"""A session as arrays: the observations in the frames of all trials, one after another, and the points fitted to them.

Frames, markers and trials are padded to a few sizes, so that a worker compiles a handful of programs. Padding has
weight 0 everywhere and never changes a result. On a GPU the sizes are fewer: there a program takes ten seconds to
compile and many sessions of one size are solved in little more time than one, while on a CPU each padded frame counts.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.body import Body, MarkerSet

from .rotations import quat_wxyz, rotation_matrices

#: Sizes to which markers are padded; larger sets are padded to a multiple of 64.
MARKER_SIZES = (24, 40, 64, 96, 128)
#: Fewest frames of a program, in all trials together; and on a GPU fewest frames, trials and samples of the phone.
MIN_FRAMES = 64
COARSE_FRAMES, COARSE_TRIALS, COARSE_SAMPLES = 256, 4, 2048
#: Points of the soles: heel and ball of the right foot, then of the left (body; m in its frame), under the lowest
#: places of the body's capsules there. A body without feet has none.
SOLES = tuple((f"calcn_{side}", place) for side in ("r", "l") for place in ((0.015, -0.015, 0.0), (0.175, -0.016, 0.0)))
#: Ends of the body's axis: the head, the heels.
ENDS = tuple((name, (0.0, 0.0, 0.0)) for name in ("head", "calcn_r", "calcn_l"))
#: Frame interval (s) for which second differences are stated: 30 Hz.
FRAME_S = 1 / 30


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PointTable:
    """Points fixed to bodies, as arrays, so that one compiled program serves every marker set of the same padded size:
    J markers, then the soles, then the ends of the body's axis."""

    body_index: Int[Array, " P"]
    position_m: Float[Array, "P 3"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Wearables:
    """What m wearable sensors measured in the recordings, and where the fit of their unknowns starts.

    `quat_wxyz`: rotations M of each, its axes to its own world, P samples at a fixed interval (`SAMPLE_S`) from
    `CLOCK_RANGE_S` before the first frame of the trial on, at the start of the clock. `turned`: their integral (s) from
    the middle of the trial to a frame, by which an error of the rate turns M in the sensor's world. `count`: 1 in
    frames that were measured; `follows`: correlation of the error there with that of the next frame, 0 if that was not.
    `mount`, `world`: start of the rotations from sensor to segment and from a sensor's world to that of a trial.
    `mount_sd_deg`: most that the standard deviation of that is;
    `sd_rad`: of a sensor on its segment; `bias_sd_rad_s`: of its gyroscope; `level_sd_rad`: of the vertical of a
    sensor's world; `tilt_sd_rad`: of that of a trial's world, 0 where it was measured. `middle_s`: of the trials;
    `clock_s`: start of the clock. `dispersion`: of the keypoints (`Linearised`).
    """

    body_index: Int[Array, " m"]
    quat_wxyz: Float[Array, "N m P 4"]
    turned: Float[Array, "F m 3 3"]
    count: Float[Array, "F m"]
    follows: Float[Array, "F m"]
    mount: Float[Array, "m 4"]
    mount_sd_deg: Float[Array, " m"]
    world: Float[Array, "N m 4"]
    sd_rad: Float[Array, " m"]
    bias_sd_rad_s: Float[Array, " m"]
    level_sd_rad: Float[Array, "N m"]
    tilt_sd_rad: Float[Array, " N"]
    middle_s: Float[Array, " N"]
    clock_s: Float[Array, " N"]
    dispersion: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Wearing:
    """Unknowns of m sensors, all 0 at the start (`Wearables`): `mount` and `world`, rotation vectors from the left of
    the two rotations; `bias` (rad/s, sensor's axes), how much faster the gyroscope is than it turns; `clock`, the
    sensors' clock less its start (s) and how much it gains in a minute (s)."""

    mount: Float[Array, "m 3"]
    world: Float[Array, "N m 3"]
    bias: Float[Array, "m 3"]
    clock: Float[Array, "N 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Depths:
    """Depths at the markers as a depth camera measured them, along the axis of the camera of the video.

    `depth_m`: of the surface there, and `count`: 1 where it counts; `skin_m`: the surface's depth less the marker's, by
    the body's shapes; `offset_sd_m`: of its error on each marker; `dispersion`: of the keypoints (`Linearised`).
    """

    depth_m: Float[Array, "F J"]
    count: Float[Array, "F J"]
    skin_m: Float[Array, "F J"]
    offset_sd_m: Float[Array, " J"]
    dispersion: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Surface:
    """Unknowns of a session with depths: `offset_m`, how much further away the surface is at each marker than the
    body's shapes say; `metre`, metres of the fit in one of the depths."""

    offset_m: Float[Array, " J"]
    metre: Float[Array, ""]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Problem:
    """F frames of all trials, V views, J markers, N trials; M samples of the phone's orientation per trial. W is J
    where markers were measured in the world, which have no views, and 0 otherwise.

    `points`: the fitted ones; `weight_3d`: of each marker, as in `MarkerSet`. time_s counts from each trial's first
    frame; `trial` is the number of a frame's trial; `weight` is 1 for a frame that counts and 0 for others. `c_*` are
    confidences over the numbers of markers and views, so that a sum over both is the paper's mean; 0 where nothing was
    seen, where values are finite and do not count. `xy_px` and `camera_matrix` are of an ideal pinhole camera
    (undistorted), in the pixels of the cost, which are `pixel_px` pixels of the file (`units.py`). `bend`
    holds the weights of the frames before, at and after a frame in the second difference there (per 1/30 s squared), 0
    where it is not formed; `rate` is 1/30 s over the time to the next frame of the trial, 0 where there is none.
    `contact`: certainty (0 to 1) that each of the soles' points stands, 0 before a first solution; `pelvis`: tilt and
    list of the pelvis (rad) by the marker augmenter, and `c_pelvis`, 1 where it has them. `sample_*`: the phone's
    orientation R_nc as quaternions at a fixed interval, from `sample_start_s` on; valid where `has_phone` is 1.
    `clock_sd_s`: of its clock's offset if the log states it, else 0.
    M is 0 if no camera of the session turns.
    """

    points: PointTable
    weight_3d: Float[Array, " J"]
    time_s: Float[Array, " F"]
    trial: Int[Array, " F"]
    weight: Float[Array, " F"]
    x_cam: Float[Array, "F V J 3"]
    c_3d: Float[Array, "F V J"]
    xy_px: Float[Array, "F V J 2"]
    c_2d: Float[Array, "F V J"]
    x_world: Float[Array, "F W 3"]
    c_world: Float[Array, "F W"]
    R_nc: Float[Array, "F V 3 3"]
    p_nc: Float[Array, "F V 3"]
    camera_matrix: Float[Array, "F V 3 3"]
    pixel_px: Float[Array, "F V"]
    bend: Float[Array, "F 3"]
    rate: Float[Array, " F"]
    contact: Float[Array, "F P"]
    pelvis: Float[Array, "F 2"]
    c_pelvis: Float[Array, " F"]
    has_phone: Float[Array, " N"]
    clock_sd_s: Float[Array, " N"]
    sample_quat_wxyz: Float[Array, "N M 4"]
    sample_start_s: Float[Array, " N"]
    sample_step_s: Float[Array, ""]
    wearables: Wearables | None = None
    depths: Depths | None = None

    @property
    def moving(self) -> bool:
        """True if a camera turns and its orientation was measured."""
        return self.sample_quat_wxyz.shape[-2] > 0

    def split(self, x: Any) -> tuple[Any, Any, Any]:
        """Markers, soles and ends of the body's axis among the points (..., P, 3)."""
        j, p = self.weight_3d.shape[-1], self.contact.shape[-1]
        return x[..., :j, :], x[..., j : j + p, :], x[..., j + p :, :]

    def point_offsets(self, site_offset_m: Float[Array, "J 3"]) -> Float[Array, "P 3"]:
        """Offsets of all points: those of the markers, 0 for the others."""
        return jnp.pad(site_offset_m, [(0, self.points.position_m.shape[-2] - site_offset_m.shape[-2]), (0, 0)])


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class State:
    """The unknowns of a session at F frames. `s`: the paper's scale parameters; `clock_s`: sensor time minus video time
    of each trial; `floor`: its height (m) and slopes along the world's x and y, of each trial.

    Constant errors of a detector's 3D points over a trial, if the paramset has them (D is N, else 0): `lean`, the
    rotation (rotation vector in rad, camera axes) that sets them upright, and `depth_m`, the correction of each
    marker's depth.
    """

    qpos: Float[Array, "F Q"]
    R_nc: Float[Array, "F V 3 3"]
    s: Float[Array, " S"]
    site_offset_m: Float[Array, "J 3"]
    clock_s: Float[Array, " N"]
    floor: Float[Array, "N 3"]
    lean: Float[Array, "D 3"] = dataclasses.field(default_factory=lambda: jnp.zeros((0, 3)))
    depth_m: Float[Array, "D J"] = dataclasses.field(default_factory=lambda: jnp.zeros((0, 0)))
    wearing: Wearing | None = None
    surface: Surface | None = None


@dataclasses.dataclass(frozen=True)
class TrialArrays:
    """One trial before padding (NumPy, float64): T frames, V views, J markers. Fields as in `Problem`, but `c_*` are
    plain confidences, `xy_px` and `camera_matrix` in pixels of the file.

    `used` (T,) bool: frames that count. phone_time_s (P,) on the video's clock, phone_quat_wxyz (P, 4): orientation of
    the one camera where it moves, else None; `phone_clock_sd_s` as in `Keypoints`.
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
    pixel_px: np.ndarray
    phone_time_s: np.ndarray | None = None
    phone_quat_wxyz: np.ndarray | None = None
    phone_clock_sd_s: float = math.nan


#: Interval (s) of the phone's orientation as the solvers see it, and its margin beyond the trial (s): the largest
#: offset between the two clocks.
SAMPLE_S, CLOCK_RANGE_S = 0.01, 0.5
#: Width (s, standard deviation) over which the phone's orientation is averaged. Without it, interpolated noise is least
#: half way between two samples, and the clock's offset would lock to those places. A hand's 3 Hz lose 7 %.
SMOOTH_S = 0.02


def pad_frames(n: int, coarse: bool = False) -> int:
    """The size to which `n` frames are padded: 64, 96, 128, 192, 256, 384 ...; `coarse`: 256, 320, 384, 448, 512, then
    768 and more of these."""
    if coarse and n <= 2 * COARSE_FRAMES:
        return max(COARSE_FRAMES, -(-n // MIN_FRAMES) * MIN_FRAMES)
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
    """The size to which `n` trials are padded: a power of 2. One stays one: three more would double the unknowns that
    its frames share where the paramset has a detector's errors for each."""
    return max(COARSE_TRIALS if coarse and n > 1 else 1, power_of_2(n))


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
    t = np.arange(index[0] + 1, index[-1])
    before, after = time_s[t] - time_s[t - 1], time_s[t + 1] - time_s[t]
    scale = 2 * FRAME_S**2 / (before + after)
    out[t] = np.stack([scale / before, -scale * (1 / before + 1 / after), scale / after], axis=1)
    return out


@functools.lru_cache(16)
def point_table(body: Body, markers: MarkerSet, size: int) -> PointTable:
    """A marker set padded to `size` rows, then the soles and the ends of the axis of a body that has them."""
    places = [p for p in (*SOLES, *ENDS) if p[0] in body.body_names]
    pad = size - len(markers)
    index = np.pad(markers.body_index, (0, pad)), [body.body_names.index(name) for name, _ in places]
    place = np.pad(markers.position_m, [(0, pad), (0, 0)]), np.reshape([p for _, p in places], (-1, 3))
    arrays: Any = np.concatenate(index).astype(np.int32), np.concatenate(place).astype(np.float32)
    return PointTable(*arrays)


def pack(trials: Sequence[TrialArrays], body: Body, markers: MarkerSet) -> Problem:
    """All trials of a session as one `Problem`, still on the host."""
    coarse = jax.default_backend() != "cpu"
    frames, n_markers = pad_frames(sum(len(t.time_s) for t in trials), coarse), len(markers)
    size, n = pad_markers(n_markers), pad_trials(len(trials), coarse)
    per_view = n_markers * max(trials[0].c_3d.shape[1], 1)

    def rows(of: Callable[[TrialArrays], np.ndarray], marker_axis: int = 0, edge: bool = False) -> np.ndarray:
        whole = np.concatenate([of(t) for t in trials])
        shape = [frames, *whole.shape[1:]]
        if marker_axis and shape[marker_axis]:
            shape[marker_axis] = size
        out = np.zeros(shape, np.float32)
        out[tuple(map(slice, whole.shape))] = whole
        if edge:
            out[len(whole) :] = out[len(whole) - 1]
        return out

    def confidence(t: TrialArrays, c: np.ndarray) -> np.ndarray:
        return c * (t.used / per_view).reshape(-1, *[1] * (c.ndim - 1))

    quats, starts = _phone_samples(trials, n, coarse)
    soles = sum(name in body.body_names for name, _ in SOLES)
    arrays: dict[str, Any] = {
        "weight_3d": np.pad(markers.weight_3d, (0, size - n_markers)),
        "time_s": rows(lambda t: t.time_s - t.time_s[0]),
        "weight": rows(lambda t: t.used),
        "x_cam": rows(lambda t: t.x_cam, 2),
        "c_3d": rows(lambda t: confidence(t, t.c_3d), 2),
        "xy_px": rows(lambda t: t.xy_px / t.pixel_px[..., None, None], 2),
        "c_2d": rows(lambda t: confidence(t, t.c_2d), 2),
        "x_world": rows(lambda t: t.x_world, 1),
        "c_world": rows(lambda t: confidence(t, t.c_world), 1),
        "R_nc": rows(lambda t: t.R_nc, edge=True),
        "p_nc": rows(lambda t: t.p_nc, edge=True),
        "camera_matrix": rows(_matrix_of_cost, edge=True),
        "pixel_px": rows(lambda t: t.pixel_px, edge=True),
        "bend": rows(lambda t: bend_weights(t.time_s, t.used)),
        "rate": rows(lambda t: np.append(FRAME_S / np.diff(t.time_s), 0.0)),
        "contact": np.zeros((frames, soles)),
        "pelvis": np.zeros((frames, 2)),
        "c_pelvis": np.zeros(frames),
        "has_phone": np.pad([t.phone_time_s is not None for t in trials], (0, n - len(trials))),
        "clock_sd_s": np.pad(np.nan_to_num([t.phone_clock_sd_s for t in trials]), (0, n - len(trials))),
        "sample_quat_wxyz": quats,
        "sample_start_s": starts,
        "sample_step_s": np.asarray(SAMPLE_S),
    }
    arrays = {k: np.asarray(v, np.float32) for k, v in arrays.items()}
    lengths = [len(t.time_s) for t in trials]
    lengths[-1] += frames - sum(lengths)  # padding belongs to the last trial
    arrays["trial"] = np.repeat(np.arange(len(trials), dtype=np.int32), lengths)
    return Problem(points=point_table(body, markers, size), **arrays)


def _matrix_of_cost(trial: TrialArrays) -> np.ndarray:
    """(T, V, 3, 3): the cameras' matrices in the pixels of the cost."""
    matrix = trial.camera_matrix.copy()
    matrix[..., :2, :] /= trial.pixel_px[..., None, None]
    return matrix


def _phone_samples(trials: Sequence[TrialArrays], n: int, coarse: bool) -> tuple[np.ndarray, np.ndarray]:
    """Orientations (n, P, 4) every `SAMPLE_S` and the time (n,) of the first, on each trial's own clock."""
    moving = [i for i, t in enumerate(trials) if t.phone_time_s is not None]
    if not moving:
        return np.zeros((n, 0, 4)), np.zeros(n)
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


#: Fields of `Problem` with one row per frame that a keypoint's cost depends on.
PER_FRAME = (
    *("weight", "trial", "x_cam", "c_3d", "xy_px", "c_2d", "x_world", "c_world", "R_nc", "p_nc"),
    *("camera_matrix", "pixel_px"),
)
DEPTHS_PER_FRAME = ("depth_m", "count", "skin_m")


def frames_at(p: Problem, index: Int[Array, " K"]) -> Problem:
    """The keypoints and cameras of some frames, by their numbers; other fields are left as they are."""
    take = lambda a: a.at[index].get(mode="promise_in_bounds")  # noqa: E731
    rows = {k: take(getattr(p, k)) for k in PER_FRAME}
    if p.depths is not None:
        rows["depths"] = dataclasses.replace(p.depths, **{k: take(getattr(p.depths, k)) for k in DEPTHS_PER_FRAME})
    return dataclasses.replace(p, **rows)


def pixels_alone(problem: Problem) -> bool:
    """True if one camera without 3D points is the only observation."""
    none = lambda c: not np.any(np.asarray(c) > 0)  # noqa: E731
    return none(problem.c_3d) and none(problem.c_world) and problem.c_2d.shape[1] == 1
