"""The shapes a body is drawn with: capsules and ellipsoids in metres, in the body's frame (x forward, y up, z right).

Sized from the segment lengths and from the marker sites, which lie about 1 cm outside the skin. Looks only.
"""

from __future__ import annotations

import dataclasses

RGBA = "0.55 0.68 0.85 1"
Vec3 = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Shape:
    """A capsule from `start` to `end` with its radius in `size`; without `end` an ellipsoid about `start`."""

    name: str
    start: Vec3
    end: Vec3 | None
    size: tuple[float, ...]


def _capsule(name: str, start: Vec3, end: Vec3, radius: float) -> Shape:
    return Shape(name, start, end, (radius,))


def _ellipsoid(name: str, centre: Vec3, half_axes: Vec3) -> Shape:
    return Shape(name, centre, None, half_axes)


#: body without its side -> shapes of the right side. Names get the side as a suffix.
SHAPES: dict[str, tuple[Shape, ...]] = {
    "pelvis": (_ellipsoid("hips", (-0.10, -0.02, 0.0), (0.105, 0.10, 0.162)),),
    "femur": (
        _capsule("thigh", (-0.004, -0.06, 0.008), (-0.002, -0.19, 0.004), 0.071),
        _capsule("lower_thigh", (0.0, -0.17, 0.0), (0.0, -0.355, 0.0), 0.058),
    ),
    "tibia": (
        _capsule("calf", (-0.014, -0.09, 0.002), (-0.012, -0.20, 0.002), 0.047),
        _capsule("shank", (0.0, -0.02, 0.0), (-0.004, -0.45, 0.003), 0.040),
    ),
    "talus": (_capsule("ankle", (-0.005, 0.025, 0.003), (-0.005, -0.005, 0.003), 0.036),),
    "calcn": (
        _capsule("heel", (0.015, 0.017, 0.0), (0.06, 0.025, 0.0), 0.032),
        _capsule("midfoot", (0.05, 0.022, -0.004), (0.18, 0.012, -0.008), 0.028),
        _capsule("outer_foot", (0.05, 0.012, 0.008), (0.17, 0.005, 0.022), 0.022),
    ),
    "toes": (
        _capsule("inner_toes", (0.0, 0.008, -0.016), (0.045, 0.004, -0.016), 0.018),
        _capsule("outer_toes", (-0.01, 0.004, 0.018), (0.025, 0.002, 0.016), 0.016),
    ),
    "torso": (
        _ellipsoid("abdomen", (0.015, 0.05, 0.0), (0.105, 0.18, 0.138)),
        _ellipsoid("chest", (0.005, 0.26, 0.0), (0.112, 0.19, 0.148)),
        _capsule("shoulders", (-0.015, 0.385, -0.145), (-0.015, 0.385, 0.145), 0.050),
        _capsule("neck", (-0.008, 0.42, 0.0), (0.008, 0.57, 0.0), 0.056),
    ),
    "head": (
        _ellipsoid("skull", (0.025, 0.085, 0.0), (0.10, 0.112, 0.077)),
        _capsule("nose", (0.115, 0.066, 0.0), (0.135, 0.052, 0.0), 0.011),
    ),
    "humerus": (
        _capsule("upper_arm", (0.0, -0.01, 0.0), (0.004, -0.15, -0.004), 0.045),
        _capsule("lower_upper_arm", (0.004, -0.15, -0.004), (0.014, -0.325, -0.010), 0.039),
    ),
    "ulna": (_capsule("ulna_side", (0.0, -0.005, 0.0), (-0.018, -0.25, 0.022), 0.025),),
    "radius": (
        _capsule("forearm", (0.0, -0.02, -0.010), (-0.003, -0.10, -0.004), 0.035),
        _capsule("radius_side", (-0.003, -0.10, 0.0), (-0.0098, -0.25, 0.015), 0.026),
    ),
    "hand": (
        _ellipsoid("palm", (0.0, -0.05, 0.002), (0.017, 0.052, 0.042)),
        _ellipsoid("fingers", (0.005, -0.13, 0.002), (0.013, 0.058, 0.036)),
        _capsule("thumb", (0.003, -0.025, 0.028), (0.011, -0.085, 0.044), 0.011),
    ),
}


def mirrored(shape: Shape) -> Shape:
    """The same shape on the left: z changes sign."""

    def flip(p: Vec3) -> Vec3:
        return (p[0], p[1], -p[2] if p[2] else 0.0)

    return dataclasses.replace(shape, start=flip(shape.start), end=shape.end and flip(shape.end))
