"""How pelvis and hip angles are defined, and how one definition is mapped to the other."""

from __future__ import annotations

import numpy as np

from pbl_pipeline.errors import PblError

#: Angles of the fitted body: the pelvis' forward axis is level in neutral standing, because Delp's frame of the pelvis
#: (OpenSim's) has its frontal plane through the anterior spines and the pubic symphysis.
BODY_ANGLES = "pbl_body"
#: Angles of a laboratory marker model of Plug-in-Gait kind: the pelvis' forward axis runs from the posterior to the
#: anterior spines and falls forward in neutral standing.
PLUG_IN_GAIT = "plug_in_gait"
ANGLE_MODELS: dict[str, str] = {
    BODY_ANGLES: "the fitted OpenSim body: pelvis level in neutral standing",
    PLUG_IN_GAIT: "laboratory marker model of Plug-in-Gait kind: pelvis axis from the posterior to the anterior spines",
}

#: Slope of the line between the spines in the pelvis frame of the body (deg). In neutral standing that frame is level,
#: and walking controls of the marker model have a mean pelvic tilt of 12 (Schwartz 2008: 11.0 to 11.6 up to free speed;
#: the 166 controls of Gillette: 12). Two OpenSim experts' solutions of two walks and a laboratory's of a third have a
#: mean tilt of -3 to 0 and a hip flexion that is 11 less than those controls' (docs/measures.md).
PELVIS_SLOPE_DEG = 12.0
#: What the marker model's angle has more than the body's (deg). Both models turn the pelvis about its lateral axis
#: first and measure hip flexion about that axis, so another slope adds a constant to hip flexion and leaves hip
#: adduction and rotation as they are; of the pelvis' angles it changes the tilt. (Exactly so only where obliquity and
#: rotation are zero; where both are 10 deg the tilt is 0.1 deg off, obliquity and rotation change by 2.3 deg.)
OFFSET_DEG = {"hip_flexion": PELVIS_SLOPE_DEG, "pelvis_tilt": PELVIS_SLOPE_DEG}


def offset_deg(angle: str, source: str, target: str) -> float:
    """What to add to an angle of the model `source` to have that of `target`. Raises `PblError` NORM_INVALID."""
    for model in (source, target):
        if model not in ANGLE_MODELS:
            raise PblError(
                "NORM_INVALID",
                found=f"angles of the model {model!r}",
                expected=f"one of {', '.join(ANGLE_MODELS)}",
                next_step="name one of these as the angle model of the set",
            )
    per_model = {PLUG_IN_GAIT: OFFSET_DEG.get(angle, 0.0), BODY_ANGLES: 0.0}
    return per_model[target] - per_model[source]


def check_degrees(values: np.ndarray, about: str) -> None:
    """Refuse angles that cannot be degrees of a gait cycle: all within 2 pi (radians), or beyond a full turn.

    In degrees every gait cycle has larger values: a knee bends by 15 and more in swing, a hip by 20. NaN are ignored.

    Raises `PblError` ANGLE_UNITS.
    """
    known = np.asarray(values, float)
    known = known[np.isfinite(known)]
    if not len(known):
        return
    largest = float(np.abs(known).max())
    if 2 * np.pi < largest <= 360.0:
        return
    kind = "radians" if largest <= 2 * np.pi else "degrees that were converted twice, or another unit"
    raise PblError(
        "ANGLE_UNITS",
        found=f"angles of at most {largest:.3g} in a gait cycle: {kind}",
        expected="degrees, with some value beyond 6.3 and none beyond 360",
        next_step="write the angles in degrees",
        key=about,
    )
