"""Forces from markers against force plates (docs/kinetics.md): three walks of children outside the tuning set."""

import dataclasses

import numpy as np
import pytest

from pbl_pipeline.errors import PblError
from research.benchmarks import kinetics

HELD_OUT = ("HC030A05", "HC032A03", "HC050A11")


@pytest.fixture(scope="module")
def steps(shared_data) -> list[kinetics.Step]:
    walks = [kinetics.read_walk(kinetics.FOLDER / f"Straight_{name}.c3d.gz") for name in HELD_OUT]
    return [s for w in walks for s in kinetics.steps_of(w, kinetics.fit_walk(w), 6.0)]


@pytest.mark.long
def test_forces_meet_the_bars_on_held_out_children(steps: list[kinetics.Step]) -> None:
    assert not any(name.startswith(kinetics.TUNING) for name in HELD_OUT)
    assert len(steps) == 6
    errors = [kinetics.errors_of(s) for s in steps]
    mean = {name: float(np.mean([e[name] for e in errors])) for name in kinetics.BARS}
    print(mean)  # noqa: T201
    met = [n for n, bar in kinetics.BARS.items() if bar is not None and mean[n] <= bar]
    assert "vertical, single support (% BW)" in met
    assert "fore-aft, single support (% BW)" in met
    assert "centre of pressure fore-aft, single support (mm)" in met
    assert "knee flexion (Nm/kg)" in met
    # Missed over all held-out children (docs/kinetics.md): not to become worse.
    assert mean["fore-aft, stance (% BW)"] < 4.0
    assert mean["hip flexion (Nm/kg)"] < 0.35


@pytest.mark.long
def test_impulses_are_those_of_the_plates(steps: list[kinetics.Step]) -> None:
    for step in steps:
        for name, within in (("vertical_impulse_bw_s", 0.04), ("propulsion_impulse_bw_s", 0.012)):
            assert step.measured[name] == pytest.approx(step.true_measured[name], abs=within)


def test_plates_of_another_sign_or_unit_are_refused(shared_data) -> None:
    path = kinetics.FOLDER / "Straight_HC030A05.c3d.gz"
    plate = kinetics.read_walk(path).plates[0]
    for factor in (-1.0, 0.001, 9.81):
        wrong = dataclasses.replace(plate, force=factor * plate.force)
        with pytest.raises(PblError, match=r"^FILE_FORMAT: "):
            kinetics.check_plates(path, (wrong,))
