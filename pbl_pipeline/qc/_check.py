"""One check and its outcome, and the order of the checks of a stage."""

from __future__ import annotations

from collections.abc import Iterable

from pbl_pipeline.records import column, record

PASS, WARN, EMPTY, NEEDS_CHOICE, FAIL = "PASS", "WARN", "EMPTY", "NEEDS_CHOICE", "FAIL"
#: From best to worst. EMPTY: ran well, nothing to produce. NEEDS_CHOICE: waits for a person.
OUTCOMES = (PASS, WARN, EMPTY, NEEDS_CHOICE, FAIL)
#: Type of a column that holds one.
OUTCOME_TYPE = f"enum({', '.join(map(repr, OUTCOMES))})"
#: Name of the check that leaves out all cycles of a recording until a person accepts it, although it failed.
CADENCE = "cadence_plausible"


@record
class Check:
    """A named check. `value` and `threshold` are in the unit that `check` names; None if none applies."""

    check: str = column("{}_check", "name, with its unit", "varchar(64)", key=True)
    outcome: str = column("{}_check_outcome", type=OUTCOME_TYPE)
    value: float | None = column("{}_check_value", "in the unit (see {}_check)")
    threshold: float | None = column("{}_check_threshold", "in the unit (see {}_check)")
    advice: str = column("{}_check_advice", "what to do about it", "varchar(1000)", cut=True, default="")

    def __post_init__(self) -> None:
        if self.outcome not in OUTCOMES:
            raise ValueError(f"outcome {self.outcome!r} is not one of {OUTCOMES}")


def warn_if(bad: object, check: str, value: float | None, threshold: float | None, advice: str) -> Check:
    """Return a check that warns with `advice` if `bad`, else passes."""
    return Check(check, WARN if bad else PASS, value, threshold, advice if bad else "")


def worst(checks: Iterable[Check]) -> str:
    """The worst outcome; PASS without checks."""
    return max((c.outcome for c in checks), key=OUTCOMES.index, default=PASS)


def in_session(outcome: str, measured: bool, counts: bool = True) -> str:
    """Return a recording's outcome as it counts for its session: EMPTY (no gait, no index), and FAIL of a recording
    without a cycle that counts (not `counts`), are only warnings if the session has measures."""
    return WARN if measured and (outcome == EMPTY or (outcome == FAIL and not counts)) else outcome


def failed(fit_checks: Iterable[Check]) -> tuple[str, ...]:
    """Names of the checks that FAIL: nothing is measured on a fit with one of them.

    One rule for files and tables: if the body does not lie on the person, the gait cycles of the fit are not used.
    """
    return tuple(c.check for c in fit_checks if c.outcome == FAIL)


#: Names of the checks of fit, events, cycles and index, in the order in which they are made.
ORDER = (
    "residual_2d_share_of_body_height",
    "residual_3d_cm",
    "share_of_frames_with_whole_person",
    "joints_at_their_limit",
    "iterations",
    "loss_fall_over_second_half",
    "scale_furthest_from_1",
    "body_height_stated",
    "camera_intrinsics_measured",
    "camera_orientation_known",
    "vertical_from_body",
    "pelvis_turn_without_3d_deg",
    "facing_without_3d_deg",
    "keypoints_fields_assumed",
    "joints_not_observed",
    "sitting_trials_without_augmented_pelvis",
    "phone_clock_offset_s",
    "sensors_on_another_segment",
    "sensor_misfit_sd",
    "sensor_slip_sd",
    "sensor_share_dropped",
    "sensor_bias",
    "sensor_rate",
    "sensor_wall_clock_s",
    "depth_distance_ratio",
    "depth_share_used",
    "depth_share_on_person",
    "depth_misfit_sd",
    "input_assumptions",
    "walking",
    "double_support_present",
    "event_order_breaks",
    "legs_seen",
    "turning",
    "heading_agreement",
    "events_by_hand",
    "cycles_used",
    "cycles_of_odd_length",
    "cycles_of_odd_curves",
    "legs_seen_alike",
    CADENCE,
    "lengths_scale",
    "norm_convention",
    "gdi_cycles",
    "gdi_explained",
    "passes_agree",
)
_PLACE = {name: i for i, name in enumerate(ORDER)}


def in_order(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Return the checks of one stage in the order in which they were made; unknown ones last, in the given order."""
    return tuple(sorted(checks, key=lambda c: _PLACE.get(c.check, len(ORDER))))
