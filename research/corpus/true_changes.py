"""`python -m research.corpus.true_changes`: how much the true index changes between two walks of one tuning person.

No detector and no fit takes part: the walks are those of `research.corpus.passes` with the same options. The mean is
`pbl_pipeline.gait.measurement.USUAL_CHANGE`.
"""

from __future__ import annotations

import itertools

import click
import numpy as np

from pbl_pipeline.gait import find_cycles, load_norm, passes_of
from pbl_pipeline.gait.normative import DEFAULT_NORM, NormativeSet
from pbl_pipeline.progress import track
from research.corpus.passes import walks_of
from research.corpus.walks import Walk, is_held_out, synthetic_walk


def true_index(walk: Walk, norm: NormativeSet) -> float:
    """Return the index of the true scores, as `research.corpus.measurement.judged` takes it."""
    (seen,) = passes_of([c for c in find_cycles(walk.events, walk.fit()) if c.used], norm)
    return float(norm.index_of_scores(np.array(seen.scores)).mean())


@click.command(epilog="Example: python -m research.corpus.true_changes --people 80 --tuning 20 --impaired 2")
@click.option("--people", default=80, show_default=True, help="Synthetic people, half of them held out.")
@click.option("--tuning", default=20, show_default=True, help="Further synthetic people who are not held out.")
@click.option("--impaired", default=2, show_default=True, help="Walks of each person with an impairment.")
def main(people: int, tuning: int, impaired: int) -> None:
    """Print the mean and quantiles of the true changes."""
    norm = load_norm(DEFAULT_NORM)
    own = [w for _, *w in walks_of(people, tuning, None, impaired) if not is_held_out(f"synthetic {w[0]}")]
    found: dict[int, list[float]] = {}
    for seed, impairment, severity in track(own, "walks", unit="walk"):
        found.setdefault(seed, []).append(true_index(synthetic_walk(seed, impairment, severity), norm))
    by = np.abs([b - a for values in found.values() for a, b in itertools.combinations(values, 2)])
    at = ", ".join(f"{v:.1f}" for v in np.quantile(by, [0.1, 0.25, 0.5, 0.75, 0.9]))
    click.echo(f"{len(by)} changes of {len(found)} persons: {by.mean():.2f} points in the mean")
    click.echo(f"10, 25, 50, 75, 90 % of them are below {at}")


if __name__ == "__main__":
    main()
