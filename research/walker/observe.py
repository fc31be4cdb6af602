"""Any motion as one phone sees it, from any view and with any camera."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import MarkerSet, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.synthetic import (
    PHONE_CAMERA,
    PHONE_SIZE_PX,
    VIEWS_DEG,
    Noise,
    PhoneSensor,
    Seen,
    pelvis_positions,
    sole_points,
)
from pbl_pipeline.synthetic.camera import CAMERAS, MIDDLE_M, NEAREST_M, PHONE_HEIGHT_M, HeldPhone, camera_turn
from pbl_pipeline.synthetic.observe import as_marker_set, film, hide
from pbl_pipeline.synthetic.plan import within
from pbl_pipeline.video import Camera, scaled_matrix
from research.walker.turns import facing, turned


def observe(
    qpos: Float[np.ndarray, "T 40"],
    time_s: Float[np.ndarray, " T"],
    *,
    view: str | float | None = None,
    distance_m: float | None = None,
    marker_set: str | MarkerSet = "bml_movi_87",
    scale: Float[np.ndarray, " 8"] | None = None,
    site_offset_m: Float[np.ndarray, "J 3"] | None = None,
    noise: Noise | None = None,
    seed: int = 0,
    camera_motion: str = "static",
    tilt_deg: tuple[float, float] = (0.0, 0.0),
    camera: Camera = PHONE_CAMERA,
    image_size_px: tuple[int, int] = PHONE_SIZE_PX,
    sensor: PhoneSensor | None = None,
    with_phone: bool | None = None,
    root_relative: bool = True,
    only_in_picture: bool = False,
    never_seen: Sequence[str] = (),
    unseen_s: Sequence[tuple[float, float]] = (),
) -> Seen:
    """Look at a walk with a phone at the world's origin.

    Parameters
    ----------
    qpos, time_s
        From `walk_qpos`, with the same camera height, or any motion (a recorded one, `research.corpus.motions`) with a
        `view`.
    view
        One of `VIEWS_DEG`, or such an angle (deg): the motion, wherever it was, is turned and moved so that the phone
        sees it from there, the phone about 1.2 m above the lowest point of its soles. None: the motion is where it is.
    distance_m
        With a view: from the phone to the middle of the way; None: 4.5 m. No motion comes nearer than 2.5 m.
    marker_set, scale, site_offset_m
        The detector's points and the person, as from `person`.
    noise
        Default: the benchmark's, `Noise()`.
    seed
        Of noise and hand. "static" and "handheld" with one seed have the same noise on the points (turned with the
        camera), the same outliers and the same missing points.
    camera_motion
        "static", "panned" (the phone turns to keep the walker in the picture) or "handheld" (with a hand's tremor).
    tilt_deg
        Of a static camera: up, then clockwise about its line of sight. A held phone looks at the pelvis.
    sensor, with_phone
        The phone's orientation log; None: with one where the phone is held.
    root_relative
        Points relative to the mean of the true ones, or with their true distance.
    only_in_picture
        Points outside of the picture are missing.
    never_seen
        Names of markers that are missing in every frame.
    unseen_s
        Times (from, to) in which nothing is seen.

    Raises
    ------
    PblError
        FIT_INPUT: no such camera motion or marker.
    """
    markers, noise, sensor = as_marker_set(marker_set), noise or Noise(), sensor or PhoneSensor()
    time_s = np.asarray(time_s, np.float64)
    unknown = sorted(set(never_seen) - set(markers.names))
    if unknown or camera_motion not in CAMERAS:
        raise PblError(
            "FIT_INPUT",
            found=f"camera motion {camera_motion!r}, markers that are not in the set: {', '.join(unknown) or 'none'}",
            expected="'static', 'panned' or 'handheld', and names of the marker set",
            next_step="correct the call",
        )
    if view is not None:
        qpos = stage(qpos, scale, view, seed, distance_m)
    points_rng, phone_rng = np.random.default_rng([seed, 4]), np.random.default_rng([seed, 5])
    if camera_motion != "static":
        tremor = 1.0 if camera_motion == "handheld" else 0.0
        R_nc_at = HeldPhone(phone_rng, time_s, pelvis_positions(qpos), tremor=tremor).R_nc
    else:
        fixed = camera_turn(*np.radians([0.0, *tilt_deg]))[0]

        def R_nc_at(time_s: np.ndarray) -> np.ndarray:
            return np.tile(fixed, (len(time_s), 1, 1))

    log = with_phone if with_phone is not None else camera_motion != "static"
    seen = film(
        qpos,
        time_s,
        R_nc_at,
        markers=markers,
        scale=scale,
        site_offset_m=site_offset_m,
        noise=noise,
        rng=points_rng,
        camera=camera,
        image_size_px=image_size_px,
        sensor=sensor if log else None,
        sensor_rng=phone_rng,
        root_relative=root_relative,
        only_in_picture=only_in_picture,
    )
    hidden = np.isin(markers.names, list(never_seen)) | _within(time_s, unseen_s)[:, None]
    return dataclasses.replace(seen, keypoints=hide(seen.keypoints, hidden))


def stage(
    qpos: Float[np.ndarray, "T 40"],
    scale: Float[np.ndarray, " 8"] | None,
    view: str | float,
    seed: int,
    distance_m: float | None = None,
) -> Float[np.ndarray, "T 40"]:
    """Any motion, where a phone at the origin that stands still sees it from a view, as `place` does with plans.

    The direction is that of the way, of the pelvis where a person stays; the floor is the lowest point of the soles.
    Raises `PblError` USAGE for an unknown view and for "follow", whose phone moves.
    """
    degrees = VIEWS_DEG.get(view) if isinstance(view, str) else view
    if degrees is None or view == "follow":
        known = ", ".join(v for v in VIEWS_DEG if v != "follow")
        raise PblError("USAGE", found=f"view {view!r}", expected=f"one of {known}", next_step="pass one of these")
    rng = np.random.default_rng([seed, 21])
    height, slant = within(rng, *PHONE_HEIGHT_M), np.radians(within(rng, 0.0, 3.0))
    body = load_body()
    column = [body.joint_names.index(f"pelvis_t{axis}") for axis in "xzy"]
    way = qpos[-1, column[:2]] - qpos[0, column[:2]]
    if np.linalg.norm(way) < 1.0:
        way = facing(qpos)[[0, 2]]
    out = turned(qpos, np.radians(degrees) + slant - np.arctan2(-way[1], way[0]))
    xy = out[:, column[:2]] * [1, -1]
    low, high = xy.min(axis=0), xy.max(axis=0)
    to = np.array([distance_m or MIDDLE_M, within(rng, 0.0, 0.1)]) - 0.5 * (low + high)
    to[0] = max(to[0], NEAREST_M - low[0])
    sole = min(s[..., 2].min() for s in sole_points(out, scale).values())
    out[:, column] += [to[0], -to[1], -height - sole]
    return out


def _within(time_s: np.ndarray, spans_s: Sequence[tuple[float, float]]) -> np.ndarray:
    inside = np.zeros(len(time_s), bool)
    for start, stop in spans_s:
        inside |= (time_s >= start) & (time_s < stop)
    return inside


def resized(camera: Camera, size_px: tuple[int, int], short_side_px: int) -> tuple[Camera, tuple[int, int]]:
    """The same camera with a picture of another size: its shorter side has so many pixels."""
    factor = short_side_px / min(size_px)
    width, height = (round(factor * side) for side in size_px)
    return dataclasses.replace(camera, matrix=scaled_matrix(camera.matrix, factor)), (width, height)


def zoomed(camera: Camera, factor: float) -> Camera:
    """The camera with a lens so many times as long."""
    matrix = camera.matrix.copy()
    matrix[[0, 1], [0, 1]] *= factor
    return dataclasses.replace(camera, matrix=matrix)
