"""Why a gait cycle takes no part in the measures, as facts; the sentence is made from them."""

from __future__ import annotations

import dataclasses

#: Name of the check that leaves out all cycles of a recording until a person accepts it.
CADENCE = "cadence_plausible"


@dataclasses.dataclass(frozen=True)
class Exclusion:
    """Reasons against a cycle; none where it is used.

    `first_step`, `last_step`: it touches the first or last step of its walking bout. `length_ratio`: its length over
    the typical stride's, where that is odd and the feet do not show one stride; `length_unproven`: they are not known,
    so that it may be one. `curve_distance_deg`: how far its curves are from the median curves of the `n_curves` cycles
    of its side, where that is far. `failed_checks`: checks of the fit that FAIL, or `CADENCE`.
    """

    first_step: bool = False
    last_step: bool = False
    length_ratio: float | None = None
    length_unproven: bool = False
    curve_distance_deg: float | None = None
    n_curves: int | None = None
    failed_checks: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        """Whether there is a reason."""
        return self != Exclusion()

    @property
    def text(self) -> str:
        """The reasons in words, empty where there is none. A check that failed is reason enough."""
        if CADENCE in self.failed_checks:
            return "the cadence is unusual for walking, and no one has accepted it"
        if self.failed_checks:
            return f"the fit failed its check {', '.join(self.failed_checks)}"
        reasons = ["first step of the bout"] if self.first_step else []
        reasons += ["last step of the bout"] if self.last_step else []
        if self.length_ratio is not None:
            unproven = ", without feet that show whether a step was missed" if self.length_unproven else ""
            reasons.append(f"{self.length_ratio:.2f} times the typical stride{unproven}")
        if self.curve_distance_deg is not None:
            reasons.append(f"{self.curve_distance_deg:.0f} deg from the median curves of {self.n_curves} cycles")
        return " and ".join(reasons)
