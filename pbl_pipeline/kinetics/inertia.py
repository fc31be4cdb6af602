"""Masses, centres of mass and moments of inertia of the fitted body, per kilogram of the person.

De Leva 1996, J Biomech 29:1223-1230, table 4 (Zatsiorsky's scans of young adults, referred to joint centres), the mean
of women and men, because the chain does not ask for the sex. Lengths are those of the scaled body. Feet and hands have
de Leva's masses; how these are spread over their bodies is that of the model (Hamner, Seth & Delp 2010).
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from pbl_pipeline.body import Body


class _Segment(NamedTuple):
    """Mean of women and men: mass (fraction of the body's), centre of mass from the upper end, and radii of gyration
    about the sagittal (forward), longitudinal and transverse axis (fractions of the length)."""

    mass: float
    centre: float
    radii: tuple[float, float, float]


def _mean(female: tuple[float, ...], male: tuple[float, ...]) -> _Segment:
    mass, centre, sagittal, transverse, longitudinal = 0.5 * (np.array(female) + np.array(male))
    return _Segment(mass, centre, (sagittal, longitudinal, transverse))


# Columns of the paper's table: mass, centre, radii sagittal, transverse, longitudinal.
_HEAD = _mean((0.0668, 0.5894, 0.330, 0.359, 0.318), (0.0694, 0.5976, 0.362, 0.376, 0.312))
_UPPER_TRUNK = _mean((0.1545, 0.2077, 0.746, 0.502, 0.718), (0.1596, 0.2999, 0.716, 0.454, 0.659))
_MIDDLE_TRUNK = _mean((0.1465, 0.4512, 0.433, 0.354, 0.415), (0.1633, 0.4502, 0.482, 0.383, 0.468))
_LOWER_TRUNK = _mean((0.1247, 0.4920, 0.433, 0.402, 0.444), (0.1117, 0.6115, 0.615, 0.551, 0.587))
_UPPER_ARM = _mean((0.0255, 0.5754, 0.278, 0.260, 0.148), (0.0271, 0.5772, 0.285, 0.269, 0.158))
_FOREARM = _mean((0.0138, 0.4559, 0.261, 0.257, 0.094), (0.0162, 0.4574, 0.276, 0.265, 0.121))
_THIGH = _mean((0.1478, 0.3612, 0.369, 0.364, 0.162), (0.1416, 0.4095, 0.329, 0.329, 0.149))
_SHANK = _mean((0.0481, 0.4352, 0.267, 0.263, 0.092), (0.0433, 0.4395, 0.251, 0.246, 0.102))
_HAND_MASS, _FOOT_MASS = 0.5 * (0.0056 + 0.0061), 0.5 * (0.0129 + 0.0137)
#: Ends of the parts of the trunk on the line from the middle of the hips (0) to that of the shoulders (1): navel,
#: xiphoid process, suprasternal notch; lengths of the same paper, mean of women and men.
_NAVEL, _XIPHOID, _NOTCH = 0.324, 0.739, 1.048
#: Top of the head above the origin of the body `head`, which lies between the angles of the jaw (m, unscaled).
_VERTEX_M = 0.197


@dataclasses.dataclass(frozen=True)
class Inertia:
    """Of B bodies of a scaled body, per kilogram of the person.

    mass (B,) adds to 1; centre_m (B, 3) in the body's frame (x forward, y up, z right); moment_m2 (B, 3): about the
    axes of that frame through the centre of mass.
    """

    mass: Float[np.ndarray, " B"]
    centre_m: Float[np.ndarray, "B 3"]
    moment_m2: Float[np.ndarray, "B 3"]


def segment_inertia(body: Body, scale: Float[np.ndarray, " S"]) -> Inertia:
    """Return the inertia of the body with the multipliers `scale`; masses add to 1."""
    model, names = body.mj_model, body.body_names
    own = np.asarray(scale, np.float64)[body.scale_index]
    at = {n: own[body.parent_index[i]] * model.body_pos[i + 1] if i else np.zeros(3) for i, n in enumerate(names)}
    mass = np.array(model.body_mass[1:])
    centre = model.body_ipos[1:] * own[:, None]
    moment = model.body_inertia[1:] * (own**2 / mass)[:, None]  # per kilogram of the segment

    def put(name: str, start: np.ndarray, end: np.ndarray, *parts: tuple[_Segment, float, float]) -> None:
        """Set a body from parts, each a segment between two places on the line from `start` to `end`."""
        i, line = names.index(name), end - start
        whole = sum(s.mass for s, _, _ in parts)
        places = [a + s.centre * (b - a) for s, a, b in parts]
        middle = sum(s.mass * p for (s, _, _), p in zip(parts, places, strict=True)) / whole
        length = float(np.linalg.norm(line))
        total = np.zeros(3)
        for (s, a, b), place in zip(parts, places, strict=True):
            total += s.mass * ((np.array(s.radii) * abs(b - a)) ** 2 + np.array([1, 0, 1]) * (place - middle) ** 2)
        mass[i], centre[i], moment[i] = whole, start + middle * line, total / whole * length**2

    hips = 0.5 * (at["femur_l"] + at["femur_r"])
    shoulders = at["torso"] + 0.5 * (at["humerus_l"] + at["humerus_r"])
    put("pelvis", hips, shoulders, (_LOWER_TRUNK, _NAVEL, 0.0))
    here = at["torso"]
    put(
        "torso",
        hips - here,
        shoulders - here,
        (_MIDDLE_TRUNK, _XIPHOID, _NAVEL),
        (_UPPER_TRUNK, _NOTCH, _XIPHOID),
    )
    put("head", own[names.index("head")] * np.array([0.0, _VERTEX_M, 0.0]), np.zeros(3), (_HEAD, 0.0, 1.0))
    for side in "lr":
        put(f"femur_{side}", np.zeros(3), at[f"tibia_{side}"], (_THIGH, 0.0, 1.0))
        put(f"tibia_{side}", np.zeros(3), at[f"talus_{side}"], (_SHANK, 0.0, 1.0))
        put(f"humerus_{side}", np.zeros(3), at[f"ulna_{side}"], (_UPPER_ARM, 0.0, 1.0))
        elbow = -at[f"radius_{side}"]  # in the frame of the radius, which carries the whole forearm
        put(f"radius_{side}", elbow, at[f"hand_{side}"], (_FOREARM, 0.0, 1.0))
        mass[names.index(f"ulna_{side}")] = 0.0
        mass[names.index(f"hand_{side}")] = _HAND_MASS
        foot = [names.index(f"{n}_{side}") for n in ("talus", "calcn", "toes")]
        mass[foot] *= _FOOT_MASS / mass[foot].sum()
    mass /= mass.sum()
    return Inertia(mass, centre, mass[:, None] * moment)
