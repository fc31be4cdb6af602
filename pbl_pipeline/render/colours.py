"""Colours shared by overlay and report. Blue and vermilion of Okabe and Ito (2008) differ for every colour vision."""

from __future__ import annotations

#: side -> "#rrggbb". Left is the warm colour, as in most gait laboratories.
SIDE_COLOUR: dict[str, str] = {"right": "#0072b2", "left": "#d55e00", "middle": "#8a8f98"}


def bgr(colour: str) -> tuple[int, int, int]:
    """OpenCV's order of a "#rrggbb" colour."""
    value = int(colour.lstrip("#"), 16)
    return value & 255, (value >> 8) & 255, value >> 16


def side_of(name: str) -> str:
    """ "right", "left" or "middle" of a body part, joint or capsule by its OpenSim name (`femur_r`, `femur_r_2`)."""
    parts = name.lower().split("_")[1:]
    if "r" in parts or "right" in name.lower().split("_"):
        return "right"
    if "l" in parts or "left" in name.lower().split("_"):
        return "left"
    return "middle"
