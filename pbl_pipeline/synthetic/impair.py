"""Impairments of a walk, by name and severity."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable

from pbl_pipeline.errors import PblError

SIDES = ("right", "left", "both")
_unknown = functools.partial(PblError, "USAGE", next_step="correct it; docs/synth.md lists all")


@dataclasses.dataclass(frozen=True)
class Impairment:
    """Name (one of `IMPAIRMENTS`), severity 0..1, and the side it is on ("": the impairment's own)."""

    name: str
    severity: float
    side: str = ""

    def __post_init__(self) -> None:
        sides = SIDES if self.name in SIDED else ("both",)
        if self.name not in IMPAIRMENTS:
            raise _unknown(f"impairment {self.name!r}", f"one of {', '.join(IMPAIRMENTS)}")
        if not 0 <= self.severity <= 1:
            raise _unknown(f"severity {self.severity} of {self.name}", "a number from 0 (none) to 1")
        if self.side not in ("", *sides):
            raise _unknown(f"side {self.side!r} of {self.name}", f"one of {', '.join(sides)}")

    @classmethod
    def parse(cls, text: str) -> Impairment:
        """Parse "crouch:0.7" or "stiff_knee:0.7:left". Raises `PblError` USAGE."""
        name, _, rest = text.partition(":")
        severity, _, side = rest.partition(":")
        try:
            number = float(severity) if severity else 1.0
        except ValueError:
            raise _unknown(f"impairment {text!r}", "name:severity, such as crouch:0.7") from None
        return cls(name.replace("-", "_"), number, side)

    @property
    def letters(self) -> str:
        """Affected sides, as letters of the joints' names."""
        return {"right": "r", "left": "l", "both": "rl", "": "r" if self.name in ONE_SIDE else "rl"}[self.side]


@dataclasses.dataclass
class Style:
    """Changes of a walk by impairments; the defaults are a healthy walk. Pairs are {"r": ..., "l": ...}.

    All in degrees unless named otherwise. `stance_*` is added over the whole cycle, `swing_*` only around the middle of
    the swing. `swing_knee` multiplies the knee's flexion of the swing above that of the stance.
    """

    step_length: float = 1.0
    cadence: float = 1.0
    width_m: float = 0.0
    trunk_sway: float = 0.0
    sway_m: float = 0.0
    stance_hip: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    stance_knee: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    stance_ankle: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    swing_knee: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 1.0, "l": 1.0})
    swing_hip: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    swing_more_knee: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    swing_abduction: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    swing_hike: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    swing_ankle: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    forefoot: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    #: Delay of the initial contact as a fraction of the stride: a shorter stance of this side.
    late_down: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})
    arm_swing: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 1.0, "l": 1.0})
    elbow: dict[str, float] = dataclasses.field(default_factory=lambda: {"r": 0.0, "l": 0.0})


def style_of(impairments: tuple[Impairment, ...]) -> Style:
    """Combine impairments into a style, in their order."""
    style = Style()
    for i in impairments:
        IMPAIRMENTS[i.name](style, i.severity, i.letters)
    return style


def _crouch(style: Style, s: float, sides: str) -> None:
    for side in sides:
        style.stance_knee[side] += 32 * s
        style.stance_hip[side] += 18 * s
        style.stance_ankle[side] += 13 * s
    style.step_length *= 1 - 0.15 * s


def _stiff_knee(style: Style, s: float, sides: str) -> None:
    for side in sides:
        style.swing_knee[side] *= 1 - 0.7 * s
        style.swing_abduction[side] += 10 * s
        style.swing_hike[side] += 5 * s
    style.step_length *= 1 - 0.1 * s


def _drop_foot(style: Style, s: float, sides: str) -> None:
    for side in sides:
        style.swing_ankle[side] -= 22 * s
        style.swing_hip[side] += 12 * s
        style.swing_more_knee[side] += 16 * s
        style.forefoot[side] = max(style.forefoot[side], s)


def _short_steps(style: Style, s: float, sides: str) -> None:
    style.step_length *= 1 - 0.5 * s
    style.cadence *= 1 + 0.05 * s
    for side in sides:
        style.arm_swing[side] *= 1 - 0.6 * s


def _weakness(style: Style, s: float, sides: str) -> None:
    for side in sides:
        style.late_down[side] += 0.06 * s
        style.swing_knee[side] *= 1 - 0.35 * s
        style.swing_ankle[side] -= 8 * s
        style.swing_abduction[side] += 5 * s
        style.swing_hike[side] += 3 * s
        style.arm_swing[side] *= 1 - 0.8 * s
        style.elbow[side] += 45 * s
    style.step_length *= 1 - 0.2 * s
    style.cadence *= 1 - 0.12 * s


def _trunk_sway(style: Style, s: float, sides: str) -> None:
    style.trunk_sway += 14 * s
    style.sway_m += 0.015 * s


def _widened_base(style: Style, s: float, sides: str) -> None:
    style.width_m += 0.16 * s
    style.sway_m += 0.02 * s
    style.step_length *= 1 - 0.1 * s


IMPAIRMENTS: dict[str, Callable[[Style, float, str], None]] = {
    "crouch": _crouch,
    "stiff_knee": _stiff_knee,
    "drop_foot": _drop_foot,
    "short_steps": _short_steps,
    "weakness": _weakness,
    "trunk_sway": _trunk_sway,
    "widened_base": _widened_base,
}
#: Impairments that may be on one side, and those of them that are on the right side by default.
SIDED = ("crouch", "stiff_knee", "drop_foot", "weakness")
ONE_SIDE = ("stiff_knee", "drop_foot", "weakness")
