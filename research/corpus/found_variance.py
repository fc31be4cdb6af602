"""`python -m research.corpus.found_variance`: which part of its stated variance a measurement model expects to find.

Gains are drawn towards 1 (`RIDGE`), so what is left of them is in the errors, which therefore depend on the true
scores: their covariance is exactly RIDGE (gain - 1). The squared length of least-squares scores exceeds that of the
true ones by less than their variance, in the mean. No walk is needed: all of it follows from the model.
"""

from __future__ import annotations

import click
import numpy as np
import pandas as pd

from pbl_pipeline.gait.events import LEFT, RIGHT
from pbl_pipeline.gait.measurement import MeasurementModel, Pass, _joint, load_model, model_names

#: The leg behind the other in each pass, by kind of session.
SESSIONS = {
    "one, from a side": (LEFT,),
    "one, from front or back": ("",),
    "both sides": (LEFT, RIGHT),
    "both sides twice": (LEFT, RIGHT) * 2,
    "sides, front, back": (LEFT, RIGHT, "", ""),
}


def found_variance(model: MeasurementModel, legs: tuple[str, ...]) -> tuple[float, float]:
    """Return the sum of the variances (deg^2) of least-squares scores of such passes, and the mean of their squared
    length less that of the true ones."""
    unseen, cycles = np.zeros(len(model.mean) // 2), round(model.n_cycles)
    _, gain, slip, error, *_ = _joint(model, [Pass((unseen, unseen), (cycles, cycles), leg) for leg in legs])
    weighed = np.linalg.solve(error, gain)
    covariance = np.linalg.inv(gain.T @ weighed)
    stated = float(np.trace(covariance))
    return stated, stated + 2.0 * float(np.trace(covariance @ weighed.T @ slip))


@click.command(epilog="Example: python -m research.corpus.found_variance")
def main() -> None:
    """Print both, and the fraction, of each model that ships and kind of session."""
    rows = []
    for name in model_names():
        for kind, legs in SESSIONS.items():
            stated, found = found_variance(load_model(name), legs)
            rows.append({"model": name, "passes": kind, "stated": stated, "longer": found, "fraction": found / stated})
    click.echo(pd.DataFrame(rows).to_string(index=False, formatters={"fraction": "{:.2f}".format}, float_format="%.0f"))


if __name__ == "__main__":
    main()
