"""Impairments of a walk, by name and severity."""

from __future__ import annotations

import dataclasses
import functools

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
        for field, (added, changed) in IMPAIRMENTS[i.name].items():
            more, factor = added * i.severity, 1 + changed * i.severity
            value = getattr(style, field)
            if isinstance(value, dict):
                value.update({side: value[side] * factor + more for side in i.letters})
            else:
                setattr(style, field, value * factor + more)
    return style


#: Effect of an impairment of severity 1 on fields of `Style`: what is added, and the fraction of change; of a field
#: with two sides, on those that are affected.
IMPAIRMENTS: dict[str, dict[str, tuple[float, float]]] = {
    "crouch": {"stance_knee": (32, 0), "stance_hip": (18, 0), "stance_ankle": (13, 0), "step_length": (0, -0.15)},
    "stiff_knee": {"swing_knee": (0, -0.7), "swing_abduction": (10, 0), "swing_hike": (5, 0), "step_length": (0, -0.1)},
    "drop_foot": {"swing_ankle": (-22, 0), "swing_hip": (12, 0), "swing_more_knee": (16, 0), "forefoot": (1, 0)},
    "short_steps": {"step_length": (0, -0.5), "cadence": (0, 0.05), "arm_swing": (0, -0.6)},
    "weakness": {
        "late_down": (0.06, 0),
        "swing_knee": (0, -0.35),
        "swing_ankle": (-8, 0),
        "swing_abduction": (5, 0),
        "swing_hike": (3, 0),
        "arm_swing": (0, -0.8),
        "elbow": (45, 0),
        "step_length": (0, -0.2),
        "cadence": (0, -0.12),
    },
    "trunk_sway": {"trunk_sway": (14, 0), "sway_m": (0.015, 0)},
    "widened_base": {"width_m": (0.16, 0), "sway_m": (0.02, 0), "step_length": (0, -0.1)},
}
#: Impairments that may be on one side, and those of them that are on the right side by default.
SIDED = ("crouch", "stiff_knee", "drop_foot", "weakness")
ONE_SIDE = ("stiff_knee", "drop_foot", "weakness")
