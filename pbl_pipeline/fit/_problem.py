"""A session as arrays: validated keypoints of all trials, padded to one shape."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from pbl_pipeline.body import Body, MarkerSet, load_body, marker_positions, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.video import Camera, viewing_ray

from ._params import ViewParams
from ._view import SEEN_SHARE, blind_runs, bridge_gaps, longest_run_s, whole_person_in_view

#: R_nc of a level camera that looks along world +x: columns are the camera's x (right), y (down), z (forward).
LEVEL_CAMERA_R_NC = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

#: Frames are padded to a multiple of this, so that sessions of like length share a compiled program.
FRAME_BUCKET = 64


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Observations:
    """What was seen, padded to (N trials, T frames, J markers). Padding and unused frames have weight 0."""

    time_s: Float[Array, "N T"]
    xy_px: Float[Array, "N T J 2"]
    x_cam: Float[Array, "N T J 3"]
    c: Float[Array, "N T J"]
    frame_weight: Float[Array, "N T"]
    R_nc: Float[Array, "N 3 3"]
    camera_matrix: Float[Array, "N 3 3"]


class FitModel:
    """Body and marker set as one hashable value: a static argument of compiled functions, equal when they are."""

    def __init__(self, body: Body, markers: MarkerSet) -> None:
        self.body, self.markers = body, markers
        tables = np.asarray(markers.position_m).tobytes(), np.asarray(markers.weight_3d).tobytes()
        self._key = (body.sha256, tuple(markers.names), *tables)

    def __hash__(self) -> int:
        return hash(self._key)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, FitModel) and other._key == self._key

    def positions(
        self, qpos: Float[ArrayLike, "*n 40"], scale: Float[ArrayLike, " 8"], site_offset_m: Float[ArrayLike, "J 3"]
    ) -> Float[Array, "*n J 3"]:
        """Markers in the world (m), compiled once per shape."""
        f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
        return _positions(self, f32(qpos), f32(scale), f32(site_offset_m))


@functools.partial(jax.jit, static_argnames="model")
def _positions(model: FitModel, qpos: Array, scale: Array, site_offset_m: Array) -> Array:
    return marker_positions(model.body, model.markers, qpos, scale, site_offset_m)


@dataclasses.dataclass(frozen=True)
class Session:
    """One session to fit. `used` holds for each trial the (T_i,) frames that count, unpadded."""

    model: FitModel
    names: tuple[str, ...]
    trials: tuple[Keypoints, ...]
    used: tuple[np.ndarray, ...]
    in_view_share: tuple[float, ...]
    obs: Observations


def make_session(trials: Sequence[Keypoints], names: Sequence[str], view: ViewParams) -> Session:
    """Validate the trials of one session and pack them.

    Raises
    ------
    PblError
        FIT_INPUT (no trial, too few frames in view, time stamps out of order, nothing seen, values not finite where
        confidence is positive), MARKER_SET_UNKNOWN.
    """
    if not trials or len(trials) != len(names):
        raise _input_error(f"{len(trials)} trials and {len(names)} names", "at least one trial and a name for each")
    sets = {t.marker_set for t in trials}
    if len(sets) > 1:
        raise _input_error(f"marker sets {sorted(sets)}", "one marker set for all trials of a session")
    body, markers = load_body(), marker_set(trials[0].marker_set)
    used, shares = [], []
    for trial, name in zip(trials, names, strict=True):
        u, share = check_trial(trial, name, view)
        used.append(u)
        shares.append(share)
    n_frames = max(len(t.time_s) for t in trials)
    n_frames += -n_frames % FRAME_BUCKET
    packed = [_pack(t, u, n_frames) for t, u in zip(trials, used, strict=True)]
    obs = jax.tree.map(lambda *a: jnp.stack([jnp.asarray(x, jnp.float32) for x in a]), *packed)
    return Session(FitModel(body, markers), tuple(names), tuple(trials), tuple(used), tuple(shares), obs)


def check_trial(trial: Keypoints, name: str, view: ViewParams) -> tuple[np.ndarray, float]:
    """Which frames (T,) bool of a trial a fit would use, and the share of frames with the whole person in view.

    Raises `PblError` FIT_INPUT or MARKER_SET_UNKNOWN where the trial cannot be fitted.
    """
    markers = marker_set(trial.marker_set)
    markers.check_names(trial.names)
    step = np.diff(trial.time_s)
    if len(trial.time_s) < 2 or not np.all(np.isfinite(trial.time_s)) or np.any(step <= 0):
        bad = int(np.sum(~(step > 0)))
        raise _input_error(
            f"trial {name}: {len(trial.time_s)} time stamps, {bad} of the steps not positive",
            "at least two, finite and strictly increasing",
            name,
        )
    seen = trial.confidence > 0
    if not np.all(np.isfinite(trial.xy_px[seen])) or not np.all(np.isfinite(trial.xyz_cam_m[seen])):
        raise _input_error(f"trial {name}: NaN or infinite points with confidence above 0", "confidence 0 there", name)
    in_view = whole_person_in_view(trial, view.min_confidence)
    used = bridge_gaps(in_view, trial.time_s, view.max_gap_s)
    used &= ~blind_runs(np.mean(seen, axis=1) >= SEEN_SHARE, trial.time_s, view.max_blind_s)
    longest = longest_run_s(used, trial.time_s)
    if longest < view.min_in_view_s:
        raise _input_error(
            f"trial {name}: the whole person is in view for {longest:.2f} s at a stretch",
            f"at least {view.min_in_view_s:.1f} s",
            name,
            "film so that head and feet stay in the picture for a few steps, or pick another person with --person",
        )
    return used, float(np.mean(in_view))


def _pack(trial: Keypoints, used: np.ndarray, n_frames: int) -> Observations:
    c = np.where(used[:, None], trial.confidence, 0.0)
    seen = c > 0
    xy = undistort_px(np.where(seen[..., None], trial.xy_px, 0.0), trial.camera)
    x_cam = np.where(seen[..., None], trial.xyz_cam_m, 0.0)
    pad = n_frames - len(used)

    def padded(a: np.ndarray) -> np.ndarray:
        return np.pad(a, [(0, pad)] + [(0, 0)] * (a.ndim - 1), mode="edge" if a.ndim == 1 else "constant")

    return Observations(
        time_s=padded(trial.time_s - trial.time_s[0]),  # type: ignore[arg-type]
        xy_px=padded(xy),  # type: ignore[arg-type]
        x_cam=padded(x_cam),  # type: ignore[arg-type]
        c=padded(c),  # type: ignore[arg-type]
        frame_weight=np.pad(used.astype(float), (0, pad)),  # type: ignore[arg-type]
        R_nc=LEVEL_CAMERA_R_NC,  # type: ignore[arg-type]
        camera_matrix=trial.camera.matrix,  # type: ignore[arg-type]
    )


def undistort_px(xy_px: np.ndarray, camera: Camera) -> np.ndarray:
    """(T, J, 2) pixels of an ideal pinhole camera with the same matrix."""
    if not np.any(camera.distortion):
        return xy_px
    pinhole = viewing_ray(xy_px.reshape(-1, 2), camera) @ np.asarray(camera.matrix, np.float64).T
    return pinhole[:, :2].reshape(xy_px.shape)


def _input_error(found: str, expected: str, key: str | None = None, next_step: str = "") -> PblError:
    return PblError(
        "FIT_INPUT",
        found=found,
        expected=expected,
        next_step=next_step or "look at the keypoints file (docs/files.md) and detect again",
        key=key,
    )
