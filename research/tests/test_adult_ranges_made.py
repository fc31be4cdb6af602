"""The ranges of adults that ship are what the command builds."""

import json

import numpy as np
import pytest

from pbl_pipeline.gait import adult_ranges, normal_bands
from research.adult_ranges import OUT, build


def test_the_ranges_are_what_the_command_builds(shared_data):
    folder = shared_data / "real" / "motions" / "DavidR-CSIC_Proyecto_Modulo1_Human_motion_analysis"
    built = build(folder / "final_advanced_biomechanical_dataset.csv.gz")
    assert built == json.loads(OUT.read_text(encoding="utf-8"))
    shown = adult_ranges()
    assert (shown.n, shown.age) == (138, (21, 86))
    children = normal_bands()  # at the speed that they choose
    for angle, (mean, _) in shown.range_deg.items():
        assert mean == pytest.approx(np.ptp(children.curves[angle][0]), abs=6), angle
