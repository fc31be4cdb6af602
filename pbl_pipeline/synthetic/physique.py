"""A person for `pbl synth`: size, positions of the markers, and length of the legs."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import SCALE_NAMES, MarkerSet, body_frames, load_body

from .plan import within

#: Standard deviations of the size: overall, of the segments against it, of the left against the right side; of a
#: marker's place on its body (m, each axis).
OVERALL_SD, SEGMENT_SD, SIDE_SD, SITE_SD_M = 0.05, 0.02, 0.005, 0.006


def physique(seed: int, markers: MarkerSet) -> tuple[Float[np.ndarray, " 8"], Float[np.ndarray, "J 3"]]:
    """Scale (8,) and marker offsets (J, 3) in m of a person.

    Left and right differ little: people whose legs differ by 5 % in length do not walk like healthy people.
    """
    rng = np.random.default_rng([seed, 11])
    overall = 1 + within(rng, 0.0, OVERALL_SD)
    segment = {name: within(rng, 0.0, SEGMENT_SD) for name in ("pelvis", "thigh", "leg_and_foot", "arm")}
    scale = np.full(len(SCALE_NAMES), overall)
    for i, name in enumerate(SCALE_NAMES):
        part = name.removeprefix("left_").removeprefix("right_")
        if part in segment:
            own = within(rng, 0.0, SIDE_SD) if part != name else 0.0
            scale[i] = overall + segment[part] + own
    return scale, rng.normal(0, SITE_SD_M, (len(markers), 3))


def leg_length_m(scale: Float[np.ndarray, " 8"]) -> float:
    """Height of the hip above the floor, standing upright, mean of both legs (m)."""
    body = load_body()
    names = body.body_names
    standing = body_frames(body, np.zeros((1, len(body.joint_names))), scale).position_m[0]
    at = {n: standing[names.index(n)] for n in ("femur_r", "calcn_r", "femur_l", "calcn_l")}
    sole = [SOLE_M * scale[body.scale_index[names.index(f"calcn_{s}")]] for s in "rl"]
    legs = [at[f"femur_{s}"][2] - at[f"calcn_{s}"][2] + h for s, h in zip("rl", sole, strict=True)]
    return float(np.mean(legs))


#: Height (m, unscaled) of the calcaneus' origin above the floor with the foot flat: the body stands at qpos = 0.
SOLE_M = 0.015
