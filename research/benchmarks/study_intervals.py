"""Coverage of the intervals of `pbl_pipeline.stats`, in simulated cohorts of 60 patients and 20 controls.

    python -m research.benchmarks.study_intervals
    python -m research.benchmarks.study_intervals --studies 4000 --only icc

Three visits of each person, of whom 15 % miss each of the later two where it says "drop-outs"; person sd 8, visit sd 4
(points of an index). What begins with "cohort" is of whole studies of `research.cohort`, with its drop-outs and
excluded visits. Prints for each statistic its truth and the percentage of studies whose 95 % interval holds it.
"""

from __future__ import annotations

from collections.abc import Callable

import click
import numpy as np
from scipy import stats

from pbl_pipeline.stats import (
    ICC_INTERVALS,
    Estimate,
    bland_altman,
    cohens_dz,
    correlation,
    effect_size,
    hedges_g,
    icc,
    mann_whitney,
    ratings_table,
    srm,
)
from research.cohort import DROP_OUT, INDEX, MEASURES, SCORES, Drawn, cycles_of, draw, score_truth

PERSON_SD, VISIT_SD, RELIABILITY = INDEX.person_sd, INDEX.visit_sd, INDEX.icc
#: Mean change of the patients from the first visit to the later ones, and sd of their true change.
CHANGE, CHANGE_SD, SRM = INDEX.change, INDEX.change_sd, INDEX.srm
#: One simulated study: its interval.
Study = Callable[[np.random.Generator], Estimate]


def visits(g: np.random.Generator, n: int, dropouts: bool, shift: np.ndarray) -> np.ndarray:
    """(n, 3) scores with a `shift` (3,) of the visits; NaN where a person missed a later visit."""
    table = g.normal(0, PERSON_SD, (n, 1)) + shift + g.normal(0, VISIT_SD, (n, 3))
    if dropouts:
        table[:, 1:][g.random((n, 2)) < DROP_OUT] = np.nan
    return table


def cycles(g: np.random.Generator) -> np.ndarray:
    """(80, 30) scores of 3 to 30 cycles per person."""
    table = g.normal(0, PERSON_SD, (80, 1)) + g.normal(0, VISIT_SD, (80, 30))
    table[np.arange(30) >= g.integers(3, 31, (80, 1))] = np.nan
    return table


def pairs(g: np.random.Generator, n: int, r: float) -> tuple[np.ndarray, np.ndarray]:
    """Two measures of n persons with correlation r."""
    x = g.normal(size=n)
    return x, r * x + np.sqrt(1 - r**2) * g.normal(size=n)


def change(g: np.random.Generator, n: int) -> np.ndarray:
    """(n,) changes of patients."""
    return g.normal(CHANGE, np.hypot(CHANGE_SD, np.sqrt(2) * VISIT_SD), n)


#: A score of 0 to 18 points with a ceiling, from a standard normal measure.
ordinal = SCORES["mJOA"].of


def _spearman_of_scores(r: float) -> float:
    x, y = pairs(np.random.default_rng(0), 2_000_000, r)
    return float(np.corrcoef(stats.rankdata(x), stats.rankdata(ordinal(y)))[0, 1])


def _repeated(g: np.random.Generator, r: float) -> Estimate:
    """Three visits of 60 patients whose two measures go together within a person, not over persons."""
    x, y = pairs(g, 180, r)
    person = np.repeat(np.arange(60), 3)
    return correlation(x + g.normal(0, 3, 60)[person], y + g.normal(0, 3, 60)[person], "repeated", person)


def _agreement(g: np.random.Generator, n: int, which: str) -> Estimate:
    return getattr(bland_altman(g.normal(1, 3, n), np.zeros(n)), which)


def _cohort_change(g: np.random.Generator, name: str) -> Estimate:
    """SRM of the cohort's patients from the first to the last visit."""
    drawn = draw(g)
    values = drawn.scores[name] if name in drawn.scores else drawn.measures[name]
    both = drawn.patient & drawn.counts[:, 0] & drawn.counts[:, 2]
    return srm(values[both, 0], values[both, 2])


def _cohort_correlation(g: np.random.Generator, score: str) -> Estimate:
    """Return the correlation of the index with a score, of patients at the first visit."""
    drawn = draw(g)
    there = drawn.patient & drawn.counts[:, 0]
    kind = "spearman" if SCORES[score].ordinal else "pearson"
    return correlation(drawn.measures["gdi"][there, 0], drawn.scores[score][there, 0], kind)


def _cohort_visits(g: np.random.Generator, name: str, kind: str, interval: str) -> Estimate:
    """ICC of the visits of the controls."""
    drawn = draw(g)
    table = np.where(drawn.counts, drawn.measures[name], np.nan)[~drawn.patient]
    return icc(table[np.isfinite(table).any(axis=1)], kind, interval=interval)


def _cohort_cycles(g: np.random.Generator, name: str) -> Estimate:
    """ICC of one cycle, patients at the first visit."""
    drawn: Drawn = draw(g)
    there = np.flatnonzero(drawn.patient & drawn.counts[:, 0])
    row, values = cycles_of(name, drawn.measures[name][there, 0], drawn.n_cycles[there, 0], g)
    return icc(ratings_table(values, row), "1,1")


def cohort_cases() -> dict[str, tuple[float, Study]]:
    """Statistics of whole studies of the cohort: name -> truth and study."""
    found: dict[str, tuple[float, Study]] = {}
    for name, m in MEASURES.items():
        found |= {
            f"cohort srm: {name}": (m.srm, lambda g, n=name: _cohort_change(g, n)),
            f"cohort icc 3,1 controls: {name}": (m.icc, lambda g, n=name: _cohort_visits(g, n, "3,1", "f")),
            f"cohort icc 2,1 generalized controls: {name}": (
                m.icc,
                lambda g, n=name: _cohort_visits(g, n, "2,1", "generalized"),
            ),
            f"cohort icc 1,1 cycles: {name}": (m.icc_cycle, lambda g, n=name: _cohort_cycles(g, n)),
        }
    for name in SCORES:
        truth = score_truth(name)
        found |= {
            f"cohort srm: {name}": (truth["srm"], lambda g, n=name: _cohort_change(g, n)),
            f"cohort correlation: gdi, {name}": (truth["correlation"], lambda g, n=name: _cohort_correlation(g, n)),
        }
    return found


def cases() -> dict[str, tuple[float, Study]]:
    """Statistics of one table: name -> truth and study."""
    found: dict[str, tuple[float, Study]] = {}
    fixed, none = np.array([0, CHANGE, CHANGE]), np.zeros(3)
    small_sd = 2.0
    with_visits = PERSON_SD**2 / (PERSON_SD**2 + VISIT_SD**2 + small_sd**2)
    for n in (80, 20):
        for dropouts in (False, True):
            words = f"{n} persons{', drop-outs' if dropouts else ''}"
            found |= {
                f"icc 1,1: {words}": (RELIABILITY, lambda g, n=n, d=dropouts: icc(visits(g, n, d, none), "1,1")),
                f"icc 2,1: {words}": (
                    with_visits,
                    lambda g, n=n, d=dropouts: icc(visits(g, n, d, g.normal(0, small_sd, 3)), "2,1"),
                ),
                f"icc 3,1: {words}": (RELIABILITY, lambda g, n=n, d=dropouts: icc(visits(g, n, d, fixed), "3,1")),
            }
    for visit_sd in (4.0, 8.0):
        for interval in ICC_INTERVALS:
            found[f"icc 2,1 {interval}: 80 persons, visits of sd {visit_sd:.0f}"] = (
                PERSON_SD**2 / (PERSON_SD**2 + VISIT_SD**2 + visit_sd**2),
                lambda g, i=interval, sd=visit_sd: icc(visits(g, 80, False, g.normal(0, sd, 3)), "2,1", interval=i),
            )
    found["icc 3,k: 80 persons"] = (
        3 * RELIABILITY / (1 + 2 * RELIABILITY),
        lambda g: icc(visits(g, 80, False, fixed), "3,k"),
    )
    found["icc 1,1: 80 persons, 3 to 30 cycles"] = (RELIABILITY, lambda g: icc(cycles(g), "1,1"))
    for n in (60, 45, 17):
        found |= {
            f"srm: {n} patients": (SRM, lambda g, n=n: srm(change(g, n))),
            f"cohens_dz: {n} patients": (SRM, lambda g, n=n: cohens_dz(change(g, n))),
            f"effect_size: {n} patients": (
                float(np.sqrt(3) / 2 * (2 * stats.norm.cdf(np.sqrt(2) * SRM) - 1)),
                lambda g, n=n: effect_size(change(g, n), n_resamples=1000, seed=int(g.integers(2**31))),
            ),
        }
    for n in (80, 60, 20):
        found |= {
            f"pearson: {n} persons, r 0.6": (0.6, lambda g, n=n: correlation(*pairs(g, n, 0.6))),
            f"spearman: {n} persons, r 0.6": (
                float(6 / np.pi * np.arcsin(0.3)),
                lambda g, n=n: correlation(*pairs(g, n, 0.6), "spearman"),
            ),
        }
    scores = _spearman_of_scores(0.5)

    def with_score(g: np.random.Generator) -> Estimate:
        x, y = pairs(g, 60, 0.5)
        return correlation(x, ordinal(y), "spearman")

    found["spearman: 60 patients, score of 18 points"] = (scores, with_score)
    found["repeated: 60 patients, 3 visits, r 0.5"] = (0.5, lambda g: _repeated(g, 0.5))
    for n in (60, 20):
        for which, truth in (("bias", 1.0), ("lower", 1 - 1.96 * 3), ("upper", 1 + 1.96 * 3)):
            found[f"bland_altman {which}: {n} pairs"] = (truth, lambda g, n=n, w=which: _agreement(g, n, w))
    found["mann_whitney: 60 and 20, 1 sd"] = (
        float(2 * stats.norm.cdf(1 / np.sqrt(2)) - 1),
        lambda g: mann_whitney(g.normal(1, 1, 60), g.normal(0, 1, 20)).rank_biserial,
    )
    found["hedges_g: 60 and 20, 1 sd"] = (1.0, lambda g: hedges_g(g.normal(1, 1, 60), g.normal(0, 1, 20)))
    return found


def held(truth: float, study: Study, studies: int, seed: int) -> float:
    """Fraction of studies whose interval holds the truth."""
    generator = np.random.default_rng(seed)
    intervals = [study(generator) for _ in range(studies)]
    return float(np.mean([e.low <= truth <= e.high for e in intervals]))


@click.command(help=__doc__)
@click.option("--studies", default=400, show_default=True)
@click.option("--seed", default=1, show_default=True)
@click.option("--only", default="", help="only statistics whose name holds this")
def main(studies: int, seed: int, only: str) -> None:
    for name, (truth, study) in (cases() | cohort_cases()).items():
        if only in name:
            click.echo(f"{name:52s} truth {truth:7.3f}  {100 * held(truth, study, studies, seed):6.2f} %")


if __name__ == "__main__":
    main()
