"""False alarms of `pbl_pipeline.stats.curve_test`: how often it finds a phase without a difference.

    python -m research.benchmarks.curve_alarms
    python -m research.benchmarks.curve_alarms --studies 1000 --only unequal

Smooth curves of 101 points: a person's own curve plus as much variation from cycle to cycle; 1,000 permutations a
study, alpha 0.05. Prints the percentage of studies with a significant phase and its standard error.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import click
import numpy as np
from scipy.ndimage import gaussian_filter1d

from pbl_pipeline.stats import CURVE_METHODS, CurveTest, curve_test

#: One simulated study: method, permutations, generator -> the test.
Study = Callable[[str, int, np.random.Generator], CurveTest]


def smooth(g: np.random.Generator, n: int, points: int = 101) -> np.ndarray:
    """(n, points) smooth random curves of standard deviation 1."""
    curves = gaussian_filter1d(g.normal(size=(n, points + 40)), 5.0, axis=1)[:, 20:-20]
    return curves * np.sqrt(2 * np.sqrt(np.pi) * 5.0)


def walks(g: np.random.Generator, own: np.ndarray, fewest: int, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Curves of `fewest` to `most` cycles of each person with the curve `own` (n, P), and whose each is."""
    persons = np.repeat(np.arange(len(own)), g.integers(fewest, most + 1, len(own)))
    return own[persons] + smooth(g, len(persons), own.shape[1]), persons


def paired(
    method: str, permutations: int, g: np.random.Generator, n: int, pre: tuple[int, int], post: tuple[int, int]
) -> CurveTest:
    """n persons, the same before and after, with so many cycles."""
    own = smooth(g, n)
    (a, of_a), (b, of_b) = walks(g, own, *pre), walks(g, own, *post)
    seed = int(g.integers(2**31))
    return curve_test(
        a, b, paired=True, persons_a=of_a, persons_b=of_b, method=method, n_permutations=permutations, seed=seed
    )


def unpaired(
    method: str, permutations: int, g: np.random.Generator, cycles_a: tuple[int, int], cycles_b: tuple[int, int]
) -> CurveTest:
    """Groups of 60 and 20 persons of one population with so many cycles."""
    (a, of_a), (b, of_b) = walks(g, smooth(g, 60), *cycles_a), walks(g, smooth(g, 20), *cycles_b)
    seed = int(g.integers(2**31))
    return curve_test(
        a, b, paired=False, persons_a=of_a, persons_b=of_b + 60, method=method, n_permutations=permutations, seed=seed
    )


CASES: dict[str, Study] = {
    "paired, 60 persons": partial(paired, n=60, pre=(1, 1), post=(1, 1)),
    "paired, 17 persons, unequal repeats 1 to 20": partial(paired, n=17, pre=(1, 20), post=(1, 20)),
    "paired, 60 persons, unequal repeats 1 to 3 before, 5 to 20 after": partial(paired, n=60, pre=(1, 3), post=(5, 20)),
    "unpaired": partial(unpaired, cycles_a=(1, 1), cycles_b=(1, 1)),
    "unpaired, unequal repeats 1 to 20": partial(unpaired, cycles_a=(1, 20), cycles_b=(1, 20)),
    "unpaired, unequal repeats 1 to 3 and 10 to 20": partial(unpaired, cycles_a=(1, 3), cycles_b=(10, 20)),
    "unpaired, unequal repeats 10 to 20 and 1 to 3": partial(unpaired, cycles_a=(10, 20), cycles_b=(1, 3)),
}


def alarms(study: Study, method: str, studies: int, seed: int, permutations: int = 1000) -> float:
    """Fraction of studies with a significant phase."""
    generator = np.random.default_rng(seed)
    return float(np.mean([bool(study(method, permutations, generator).phases) for _ in range(studies)]))


@click.command(help=__doc__)
@click.option("--studies", default=4000, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--only", default="", help="only cases whose name holds this")
def main(studies: int, seed: int, only: str) -> None:
    for name, study in CASES.items():
        for method in CURVE_METHODS:
            if only in name:
                rate = alarms(study, method, studies, seed)
                error = np.sqrt(rate * (1 - rate) / studies)
                click.echo(f"{name:64s} {method:8s} {100 * rate:5.2f} % (+- {100 * error:.2f})")


if __name__ == "__main__":
    main()
