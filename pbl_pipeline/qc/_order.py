"""The order of the checks of a stage, for a store that keeps them by their names."""

from __future__ import annotations

from collections.abc import Iterable

from ._check import Check

#: Names of the checks of fit, events, cycles and index as the functions that make them return them.
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
    "facing_without_3d_deg",
    "keypoints_fields_assumed",
    "joints_not_observed",
    "sitting_trials_without_augmented_pelvis",
    "phone_clock_offset_s",
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
    "cadence_plausible",
    "lengths_scale",
    "norm_convention",
    "gdi_cycles",
    "gdi_explained",
)
_PLACE = {name: i for i, name in enumerate(ORDER)}


def in_order(checks: Iterable[Check]) -> tuple[Check, ...]:
    """Return the checks of one stage in the order in which it made them; others after them, as they come."""
    return tuple(sorted(checks, key=lambda c: _PLACE.get(c.check, len(ORDER))))
