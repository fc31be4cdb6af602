"""Why a cycle is not used: facts, and the sentence made from them."""

from __future__ import annotations

import pytest

from pbl_pipeline.gait import Exclusion, GaitCycle


def cycle(exclusion: Exclusion) -> GaitCycle:
    return GaitCycle("t", 0, 0, "left", 0.0, 0.1, 0.5, 0.6, 1.0, exclusion=exclusion)


@pytest.mark.parametrize(
    ("exclusion", "text"),
    [
        (Exclusion(), ""),
        (Exclusion(first_step=True), "first step of the bout"),
        (
            Exclusion(last_step=True, length_ratio=1.5),
            "last step of the bout and 1.50 times the typical stride",
        ),
        (
            Exclusion(length_ratio=1.4, length_unproven=True),
            "1.40 times the typical stride, without feet that show whether a step was missed",
        ),
        (Exclusion(curve_distance_deg=24.6, n_curves=8), "25 deg from the median curves of 8 cycles"),
        (
            Exclusion(last_step=True, failed_checks=("cadence_plausible",)),
            "the cadence is unusual for walking, and no one has accepted it",
        ),
        (Exclusion(first_step=True, failed_checks=("scale", "jumps")), "the fit failed its check scale, jumps"),
    ],
)
def test_the_sentence_and_whether_the_cycle_counts(exclusion: Exclusion, text: str):
    assert cycle(exclusion).excluded == text
    assert cycle(exclusion).used == (text == "")


def test_each_reason_is_a_fact_of_its_own():
    """They were read out of the sentence: a check called "from the median curves" would have been odd curves."""
    found = cycle(Exclusion(failed_checks=("times the typical stride from the median curves",)))
    assert (found.odd_length, found.odd_curves, found.check_failed) == (False, False, True)
    found = cycle(Exclusion(length_ratio=0.5, curve_distance_deg=9.0, n_curves=6))
    assert (found.odd_length, found.odd_curves, found.check_failed) == (True, True, False)
