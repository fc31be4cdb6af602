"""`python -m research.corpus.drawn_changes PASSES`: probabilities of changes in the measurement model's own world.

Passes of the walks in PASSES are drawn from the model about their true scores, so nothing but the model's assumptions
on changes can make a stated probability wrong. Prints how often it holds, and with all changes equally likely.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from unittest import mock

import click
import numpy as np
import pandas as pd

from pbl_pipeline.gait import load_norm
from pbl_pipeline.gait.events import LEFT, RIGHT
from pbl_pipeline.gait.measurement import MeasurementModel, Pass, estimate, expected_index, load_model
from pbl_pipeline.gait.normative import DEFAULT_NORM, NormativeSet
from research.corpus.measurement import change_pairs, probability_table, read_passes

#: How often each person's errors are drawn.
DRAWS = 8
#: The leg behind in each pass, by kind of session.
SESSIONS = {"left": (RIGHT,), "front": ("",), "both sides": (LEFT, RIGHT)}


def drawn_visits(
    walks: Mapping[tuple[str, str, float], np.ndarray], model: MeasurementModel, norm: NormativeSet
) -> pd.DataFrame:
    """A row per session that is drawn, as of `research.corpus.measurement.judged`. `walks`: true scores (2, K) by
    person, condition and severity."""
    rng = np.random.default_rng(0)
    people: dict[str, tuple[np.ndarray, dict[str, np.ndarray]]] = {}

    def draw(covariance: np.ndarray) -> np.ndarray:
        return rng.multivariate_normal(np.zeros(len(covariance)), covariance, method="eigh", check_valid="ignore")

    rows = []
    for (person, condition, severity), true in walks.items():
        if person not in people:
            people[person] = draw(model.person), {leg: draw(v.view) for leg, v in model.views.items()}
        of_person, of_views = people[person]
        for kind, legs in SESSIONS.items():
            for visit in (0, 1):
                passes = []
                for leg in legs:
                    view = model.views[leg]
                    found = model.mean + view.bias + view.gain @ (true.ravel() - model.mean)
                    found += of_person + of_views[leg] + draw(view.anew)
                    left, right = found.reshape(2, -1)
                    passes.append(Pass((left, right), (round(model.n_cycles), round(model.n_cycles)), leg))
                index = expected_index(estimate(model, passes), norm, model.widening)
                rows.append(
                    {
                        "kind": kind,
                        "person": person,
                        "condition": condition,
                        "severity": severity,
                        "visit": visit,
                        "true": norm.index_of_scores(true).mean(),
                        "found": index.mean,
                        "sd": index.sd,
                        "sd_anew": index.sd_anew,
                    }
                )
    return pd.DataFrame(rows)


@click.command(epilog="Example: python -m research.corpus.drawn_changes passes")
@click.argument("folder", type=click.Path(path_type=Path, exists=True))
@click.option("--model", "name", default="blazepose-33", show_default=True, help="Measurement model.")
def main(folder: Path, name: str) -> None:
    """Print stated and found probabilities of changes between drawn passes of the walks in FOLDER."""
    norm = load_norm(DEFAULT_NORM)
    seen = read_passes(folder, norm)
    walks = {(f"{s.person} {i}", s.condition, s.severity): s.true for s in seen for i in range(DRAWS)}
    pairs = change_pairs(drawn_visits(walks, load_model(name), norm))
    changed = np.abs(pairs.loc[~pairs["unchanged"], "true"])
    click.echo(f"{len(walks) // DRAWS} walks, {len(changed)} changes of {changed.mean():.1f} points in the mean")
    click.echo(probability_table(pairs).to_string(index=False, float_format="%.2f"))
    with mock.patch("pbl_pipeline.gait.measurement.USUAL_CHANGE", 1e9):
        click.echo("\nall changes equally likely beforehand")
        click.echo(probability_table(pairs).to_string(index=False, float_format="%.2f"))


if __name__ == "__main__":
    main()
