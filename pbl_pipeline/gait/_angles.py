"""Joint and pelvis angles of gait analysis, per side, in degrees and with their signs."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results.cycles import BODY_ANGLES
from pbl_pipeline.results.events import LEFT, RIGHT, SIDES

from .motion import BodyPoses, FootTrajectories, feet_from_fit, trial_poses

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit

#: name -> unit, direction of the positive sign. All are per side.
ANGLE_NAMES: dict[str, str] = {
    "hip_flexion": "deg, flexion positive",
    "hip_adduction": "deg, adduction positive",
    "hip_rotation": "deg, internal rotation positive",
    "knee_flexion": "deg, flexion positive (OpenSim's knee_angle with the sign turned)",
    "ankle_dorsiflexion": "deg, dorsiflexion positive (ankle_angle)",
    "pelvis_tilt": "deg, anterior tilt positive, against the horizontal in the walking direction",
    "pelvis_obliquity": "deg, the side in question up positive",
    "pelvis_rotation": "deg, the side in question ahead positive, against the walking direction",
    "foot_progression": "deg, toes in positive: heel to toe, seen from above, against the walking direction",
}


@dataclasses.dataclass(frozen=True)
class AngleSeries:
    """Angles over a trial: `time_s` (T,), `left` and `right` map `ANGLE_NAMES` to (T,) degrees, NaN where unseen.

    `angle_model`: definition of pelvis and hip (`normative.ANGLE_MODELS`). `sd` maps sides to names to the standard
    deviation (T,) deg of the angles whose uncertainty is known.
    """

    time_s: np.ndarray
    left: dict[str, np.ndarray]
    right: dict[str, np.ndarray]
    angle_model: str = BODY_ANGLES
    sd: dict[str, dict[str, np.ndarray]] = dataclasses.field(default_factory=dict)

    def of_side(self, side: str) -> dict[str, np.ndarray]:
        return self.right if side == RIGHT else self.left


#: Angles of a leg -> angles of the body (`body.joint_angles`), without the side.
LEG_ANGLES = {
    "hip_flexion": "hip_flexion",
    "hip_adduction": "hip_adduction",
    "hip_rotation": "hip_rotation",
    "knee_flexion": "knee_flexion",
    "ankle_dorsiflexion": "ankle_angle",
}


def leg_angles(fit: TrialFit) -> dict[str, dict[str, np.ndarray]]:
    """Side -> name -> (T,) degrees: the body's own angles of hip, knee and ankle; those that the fit's body has, NaN
    if not observed."""
    from pbl_pipeline.body import joint_angles  # JAX loads only where a fit is read

    return legs_of(joint_angles(fit.joint_names, fit.observed_qpos))


def leg_angles_sd(fit: TrialFit) -> dict[str, dict[str, np.ndarray]]:
    """The standard deviation (deg) of each of `leg_angles`, NaN where the fit has none."""
    from pbl_pipeline.body import joint_angles_sd

    return legs_of(joint_angles_sd(fit.joint_names, fit.qpos_sd))


def legs_of(angles: Mapping[str, np.ndarray]) -> dict[str, dict[str, np.ndarray]]:
    """Side -> name -> the angles of that leg, of angles by the names of the body (`body.joint_angles`)."""
    return {
        side: {ours: angles[f"{own}_{side[0]}"] for ours, own in LEG_ANGLES.items() if f"{own}_{side[0]}" in angles}
        for side in SIDES
    }


def angle_series(fit: TrialFit, poses: BodyPoses | None = None) -> AngleSeries:
    """Angles of a fit. Hip, knee and ankle are the model's own; the pelvis is decomposed anew (`pelvis_angles`).

    Raises `PblError` GAIT_INPUT (see `feet_from_fit`).
    """
    poses = poses or trial_poses(fit)
    series = series_of(leg_angles(fit), poses, feet_from_fit(fit, poses), leg_angles_sd(fit))
    for side, of_side in ((LEFT, series.left), (RIGHT, series.right)):
        hidden = [
            n for n in of_side if n.startswith("pelvis") and any(j.startswith("pelvis") for j in fit.not_observed)
        ]
        if not fit.not_observed.isdisjoint(f"{joint}_{side[0]}" for joint in ("ankle_angle", "subtalar_angle")):
            hidden.append("foot_progression")
        of_side.update((name, np.full(len(series.time_s), np.nan)) for name in hidden)
    return series


def series_of(
    legs: Mapping[str, Mapping[str, np.ndarray]],
    poses: BodyPoses,
    feet: FootTrajectories,
    sd: dict[str, dict[str, np.ndarray]] | None = None,
) -> AngleSeries:
    """Angles of both legs (side -> name -> (T,) degrees), and those of pelvis and feet of the poses against the way."""
    forward = feet.forward
    out = toes_out(feet.toe_m - feet.heel_m, forward)
    # The pelvis frame of the model is forward, up, right.
    tilt, obliquity, rotation = pelvis_angles(poses.rotation[:, poses.index("pelvis")], forward).T
    sides = {}
    for i, (side, sign) in enumerate(((LEFT, -1.0), (RIGHT, 1.0))):
        sides[side] = {
            **legs[side],
            "pelvis_tilt": tilt,
            "pelvis_obliquity": sign * obliquity,
            "pelvis_rotation": sign * rotation,
            "foot_progression": -out[:, i],
        }
    return AngleSeries(np.asarray(feet.time_s, float), sides[LEFT], sides[RIGHT], sd=sd or {})


#: Beyond the limits of the body's joints by this angle (deg) no joint of a person is for long.
_BEYOND_DEG = 30.0


def check_ranges(series: AngleSeries, name: str) -> None:
    """Check the angles of hip, knee and ankle (1st and 99th percentile) against the limits of the body's joints, and
    that knees bend in flexion. Raises `PblError` GAIT_INPUT."""
    from pbl_pipeline.body import joint_angles, load_body

    limits = legs_of(joint_angles(load_body().joint_names, load_body().joint_range_rad.T))
    for side in SIDES:
        for angle, values in series.of_side(side).items():
            known = values[np.isfinite(values)]
            if angle not in LEG_ANGLES or not len(known):
                continue
            low, high = np.percentile(known, [1, 99])
            least, most = sorted(limits[side][angle])
            least, most = least - _BEYOND_DEG, most + _BEYOND_DEG
            if low < least or high > most or (angle == "knee_flexion" and -low > max(high, _BEYOND_DEG)):
                raise PblError(
                    "GAIT_INPUT",
                    found=said(
                        "{angle}, {side}: {low:.0f} to {high:.0f} deg",
                        angle=said(angle.replace("_", " ")),
                        side=said(side),
                        low=low,
                        high=high,
                    ),
                    expected=f"{least:.0f} to {most:.0f} deg ({ANGLE_NAMES[angle]})",
                    next_step="correct sign and zero of this angle in the program that wrote it, and export again",
                    key=name,
                )


def pelvis_angles(R_world_pelvis: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Tilt, obliquity and rotation of the pelvis against the walking direction, in degrees.

    The model's pelvis_tilt, pelvis_list and pelvis_rotation are turned about the axes of the world and so mean tilt
    and obliquity only for a person who walks along world x. Here the orientation of the pelvis is taken in the frame of
    the walking direction (forward, up, right) and decomposed there in the same order (tilt, obliquity, rotation,
    body-fixed), so that the result does not depend on where the person walks.

    Returns (T, 3): tilt, anterior positive; obliquity, right side up positive; rotation, right side ahead positive.

    Parameters
    ----------
    R_world_pelvis
        (T, 3, 3), columns forward, up, right of the pelvis in a z-up world.
    forward
        (T, 3) unit horizontal heading.
    """
    up = np.broadcast_to([0.0, 0.0, 1.0], forward.shape)
    heading = np.stack([forward, up, np.cross(forward, up)], axis=-1)
    out = np.full(forward.shape, np.nan)
    seen = np.all(np.isfinite(R_world_pelvis), axis=(1, 2)) & np.all(np.isfinite(forward), axis=1)
    if np.any(seen):
        local = np.swapaxes(heading[seen], 1, 2) @ R_world_pelvis[seen]
        about_right, about_forward, about_up = Rotation.from_matrix(local).as_euler("ZXY", degrees=True).T
        # About +right the front rises (posterior tilt); about +forward the right side sinks; about +up it goes ahead.
        out[seen] = np.column_stack([-about_right, -about_forward, about_up])
    return out


def toes_out(heel_to_toe: np.ndarray, forward: np.ndarray) -> np.ndarray:
    """Angle (T, 2) deg by which each foot (T, 2, 3) [left, right] points outwards of `forward` (T, 3), from above."""
    up = np.array([0.0, 0.0, 1.0])
    right = np.cross(forward, up)
    aside = np.einsum("tsi,ti->ts", heel_to_toe, right) * np.array([-1.0, 1.0])
    ahead = np.einsum("tsi,ti->ts", heel_to_toe, forward)
    return np.degrees(np.arctan2(aside, ahead))
