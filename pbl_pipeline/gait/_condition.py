"""What a person does in a trial, and at which pace: decides which trials the measures of a session pool."""

from __future__ import annotations

import dataclasses

from pbl_pipeline.names import check_label

#: Usual activities and paces; others are allowed.
ACTIVITIES = ("walking", "tug", "sit_to_stand", "fsst", "tandem", "standing", "stairs", "squat", "running")
PACES = ("self_selected", "fast", "slow", "dual_task")
SELF_SELECTED = "self_selected"
#: As the pace of a method: walking at any pace.
ANY_PACE = "any"
UNKNOWN = "unknown"
#: Words of an activity that is walking over the floor or a treadmill.
_WALKING = ("walk", "gait", "overground")


@dataclasses.dataclass(frozen=True)
class Condition:
    """Activity and pace of a trial. Unknown counts as walking, and as the pace that the person chose.

    Case, spaces and hyphens make no difference: "Sit-to-stand" is "sit_to_stand". Raises `PblError` USAGE for a label
    of more than 32 characters.
    """

    activity: str = UNKNOWN
    pace: str = UNKNOWN

    def __post_init__(self) -> None:
        for name in ("activity", "pace"):
            text = "_".join(str(getattr(self, name) or UNKNOWN).lower().replace("-", " ").replace("_", " ").split())
            check_label(name, text, 32)
            object.__setattr__(self, name, text or UNKNOWN)

    @property
    def walks(self) -> bool:
        """Whether the activity is walking."""
        return self.activity == UNKNOWN or any(word in self.activity for word in _WALKING)

    @property
    def pool(self) -> str:
        """The pace under which a method pools this trial; "" where it is no walking, which none pools."""
        if not self.walks:
            return ""
        return SELF_SELECTED if self.pace == UNKNOWN else self.pace

    def pooled(self, pace: str) -> bool:
        """Whether a method with this pace pools the trial."""
        return bool(self.pool) and pace in (ANY_PACE, self.pool)

    def __str__(self) -> str:
        return self.activity if self.pace == UNKNOWN else f"{self.activity}, {self.pace}"
