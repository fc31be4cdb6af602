"""A synthetic cohort with known true effects: 60 people with a degenerative spine and 20 controls, three visits each.

    python -m research.cohort --out spine_cohort
    python -m research.cohort --out large --patients 1500 --controls 500 --seed 3

Writes the folder of a study (docs/study.md) and `truth.csv`, what the statistics of such a study would be without
chance. Index, measures, scores and curves are drawn from the truth and an error model, without videos. All of it is a
function of the seed. `research/benchmarks/study_intervals.py` draws the same cohort.

A value of person i at visit v is mean + P_i + C_i (v > 0) + e_iv: P between persons, C the true change after surgery
(patients only), e between visits, of which a part is the mean of the cycles' own deviations. Persons and visits
deviate together in all measures and scores, by the correlations below. Every later visit is missed with one chance, and
a few visits do not count. Curves are the norm's (`gait.normative`) with a knee that bends less in the swing and gains
half of that back by surgery; nothing else in them changes.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click
import numpy as np
import pandas as pd
from scipy import stats

from pbl_pipeline.code_version import code_version
from pbl_pipeline.gait.normative import gait_norm
from pbl_pipeline.study import CURVE_PERCENT, CURVE_POINTS, StudyData, StudyDescription, write_study

ROLES = ("pre", "6_weeks", "6_months")
DAYS = ((-21, -1), (35, 49), (168, 196))
PATIENTS, CONTROLS = "degenerative spine", "control"
#: Chance that a person misses a later visit, and that a visit that took place does not count.
DROP_OUT, EXCLUDED = 0.15, 0.02
REASONS = ("another walking aid than at the first visit", "no complete gait cycle on the left")
#: Cycles of a visit: one of these numbers, equally often.
N_CYCLES = np.arange(12, 29, 2)


@dataclasses.dataclass(frozen=True)
class Measure:
    """A gait measure of the cohort, in its own unit.

    Attributes
    ----------
    patients, controls
        Mean at the first visit.
    person_sd, visit_sd, cycle_sd
        Between persons of a group, visits of a person (the cycles' part included), cycles of a visit.
    change, change_sd
        Of the patients' true change: mean, and standard deviation between persons.
    with_index
        Correlation of the persons' (and the visits') deviations with those of the index.
    """

    unit: str
    patients: float
    controls: float
    person_sd: float
    visit_sd: float
    cycle_sd: float
    change: float
    change_sd: float
    with_index: float

    @property
    def icc(self) -> float:
        """Reliability of one visit of unchanged persons."""
        return self.person_sd**2 / (self.person_sd**2 + self.visit_sd**2)

    @property
    def day_sd(self) -> float:
        """Between visits without what the mean of their cycles adds."""
        return float(np.sqrt(self.visit_sd**2 - self.cycle_sd**2 * (1 / N_CYCLES).mean()))

    @property
    def icc_cycle(self) -> float:
        """Reliability of one cycle, between the persons of a group at one visit."""
        between = self.person_sd**2 + self.day_sd**2
        return between / (between + self.cycle_sd**2)

    @property
    def srm(self) -> float:
        """Standardised response mean from the first visit to a later one."""
        return self.change / float(np.hypot(self.change_sd, np.sqrt(2) * self.visit_sd))


INDEX = Measure("", 82, 97, 8, 4, 7, 5, 6, 1.0)
MEASURES = {
    "gdi": INDEX,
    "cadence_steps_per_min": Measure("steps/min", 98, 112, 9, 4, 5, 3, 6, 0.5),
    "double_support_time_s": Measure("s", 0.42, 0.28, 0.08, 0.035, 0.06, -0.04, 0.05, -0.6),
    "speed_m_per_s": Measure("m/s", 0.95, 1.3, 0.18, 0.07, 0.06, 0.06, 0.1, 0.7),
}


@dataclasses.dataclass(frozen=True)
class Score:
    """A clinical score: mean + sd times a standard normal value that goes with the index, in steps and within bounds.

    `with_index` is that correlation at one visit; `change`, in units of sd, what patients gain, whatever their index.
    """

    unit: str
    mean: float
    sd: float
    step: float
    low: float
    high: float
    with_index: float
    change: float
    ordinal: bool
    mic: float
    source: str
    classes: str = ""

    def of(self, latent: np.ndarray) -> np.ndarray:
        """Return the scores of standard normal values, as the decimals that a file holds."""
        high = np.inf if np.isnan(self.high) else self.high
        scores = np.round((self.mean + self.sd * latent) / self.step) * self.step
        return np.clip(np.round(scores, 6), self.low, high)


MIC = "minimal important change: "
SCORES = {
    "mJOA": Score(
        "points", 14, 2.5, 1, 0, 18, 0.5, 0.2, True, 2.0, f"Benzel 1991; {MIC}Tetreault 2015",
        "0 severe; 12 moderate; 15 mild",
    ),
    "mJOA-LE": Score("points", 5, 1.2, 1, 0, 7, 0.5, 0.15, True, np.nan, "Benzel 1991"),
    "10MWT": Score("m/s", 1.0, 0.25, 0.01, 0, np.nan, 0.8, 0.25, False, 0.1, f"{MIC}Perera 2006"),
    "BBS": Score(
        "points", 44, 7, 1, 0, 56, 0.6, 0.2, True, np.nan, "Berg 1992",
        "0 high fall risk; 41 fall risk; 51 low fall risk",
    ),
}  # fmt: skip
#: Part of a score's own variance (what does not go with the index) that belongs to the person.
_OWN_PERSON = 0.8
#: Degrees by which the patients' knees bend less in the swing, the part that surgery gives back, and where.
KNEE_LOSS_DEG, KNEE_GAIN, KNEE_AT, KNEE_WIDTH = 10.0, 0.5, 70.0, 6.0
#: Angle -> deviation of persons and of visits (deg).
ANGLES = {
    "hip_flexion": (5.0, 1.5),
    "hip_adduction": (2.0, 0.8),
    "knee_flexion": (4.0, 1.5),
    "ankle_dorsiflexion": (3.0, 1.2),
}
#: Chance that a curve has a stretch without values.
HIDDEN = 0.01


@dataclasses.dataclass(frozen=True)
class Drawn:
    """One study. N persons, the patients first; V = 3 visits.

    Attributes
    ----------
    patient : (N,)
        Whether a patient.
    came, counts : (N, V)
        Which visits took place; which of them count.
    n_cycles : (N, V)
        Even numbers: as many of each side.
    measures
        Name -> (N, V) mean over the cycles, as measured.
    scores
        Name -> (N, V).
    """

    patient: np.ndarray
    came: np.ndarray
    counts: np.ndarray
    n_cycles: np.ndarray
    measures: dict[str, np.ndarray]
    scores: dict[str, np.ndarray]


def draw(g: np.random.Generator, n_patients: int = 60, n_controls: int = 20) -> Drawn:
    """One study of the cohort, without cycles and curves."""
    n = n_patients + n_controls
    shape = (n, len(ROLES))
    patient = np.arange(n) < n_patients
    later = np.arange(len(ROLES)) > 0
    came = ~(later & (g.random(shape) < DROP_OUT))
    counts = came & (g.random(shape) >= EXCLUDED)
    n_cycles = g.choice(N_CYCLES, shape)
    person, day = g.normal(size=(n, 1)), g.normal(size=shape)
    changes = patient[:, None] & later
    measures: dict[str, np.ndarray] = {}
    standing = np.zeros(shape)
    for name, m in MEASURES.items():
        rest = np.sqrt(1 - m.with_index**2)
        deviation = m.person_sd * (m.with_index * person + rest * g.normal(size=(n, 1)))
        deviation = deviation + m.day_sd * (m.with_index * day + rest * g.normal(size=shape))
        gain = (m.change + m.change_sd * g.normal(size=(n, 1))) * changes
        of_cycles = m.cycle_sd / np.sqrt(n_cycles) * g.normal(size=shape)
        measures[name] = np.where(patient, m.patients, m.controls)[:, None] + deviation + gain + of_cycles
        if name == "gdi":
            # Changes of the index at a visit that are not true ones are correlated with the scores.
            standing = (deviation + of_cycles) / np.hypot(m.person_sd, m.visit_sd)
    scores = {}
    for name, s in SCORES.items():
        own = np.sqrt(_OWN_PERSON) * g.normal(size=(n, 1)) + np.sqrt(1 - _OWN_PERSON) * g.normal(size=shape)
        latent = s.with_index * standing + np.sqrt(1 - s.with_index**2) * own + s.change * changes
        scores[name] = s.of(np.where(patient[:, None], latent, latent + 1.5))
    return Drawn(patient, came, counts, n_cycles, measures, scores)


def study_of(drawn: Drawn, g: np.random.Generator) -> StudyData:
    """The study as frames, with cycles and curves. Patients have all scores, controls the walking test alone."""
    person, visit = np.nonzero(drawn.came)
    n = len(person)
    low, high = np.array(DAYS).T
    counts = drawn.counts[person, visit]
    keys = pd.DataFrame(
        {
            "subject": [f"S{i + 1:0{max(3, len(str(len(drawn.patient))))}d}" for i in person],
            "visit": [f"V{v + 1}" for v in visit],
        }
    )
    n_cycles = drawn.n_cycles[person, visit]
    cycles, spread = _cycles(drawn, person, visit, keys, g)
    visits = keys.assign(
        role=np.array(ROLES)[visit],
        days=g.integers(low[visit], high[visit], endpoint=True),
        group=np.where(drawn.patient[person], PATIENTS, CONTROLS),
        included=counts,
        reason=np.where(counts, "", g.choice(REASONS, n)),
        gdi=drawn.measures["gdi"][person, visit],
        gdi_sd=INDEX.cycle_sd / np.sqrt(n_cycles),
        n_cycles=n_cycles,
    )
    measures = [
        keys.assign(
            side="both",
            measure=name,
            value=drawn.measures[name][person, visit],
            sd=spread[name],
            n_cycles=n_cycles,
            unit=m.unit,
        )
        for name, m in MEASURES.items()
        if name != "gdi"
    ]
    scored = {name: drawn.patient[person] | (name == "10MWT") for name in SCORES}
    scores = [
        keys.assign(instrument=name, value=drawn.scores[name][person, visit]).loc[scored[name]] for name in SCORES
    ]
    instruments = [
        {
            "instrument": name,
            "higher_is_better": True,
            **{k: getattr(s, k) for k in ("unit", "low", "high", "ordinal", "mic", "source", "classes")},
        }
        for name, s in SCORES.items()
    ]
    return StudyData(
        visits=visits,
        measures=pd.concat(measures),
        scores=pd.concat(scores),
        instruments=pd.DataFrame(instruments),
        cycles=cycles,
        curves=_curves(drawn, person, visit, keys, g),
        description=StudyDescription(
            name="synthetic spine cohort",
            methods={"all": "drawn from a known truth (research/cohort.py), no video"},
            code_version=code_version(),
            event="surgery",
            change_from=ROLES[0],
            change_to=ROLES[2],
            change_group=PATIENTS,
            note="Synthetic persons with known true effects, not data of people.",
        ),
    )


def _cycles(
    drawn: Drawn, person: np.ndarray, visit: np.ndarray, keys: pd.DataFrame, g: np.random.Generator
) -> tuple[pd.DataFrame, dict[str, np.ndarray]]:
    """Single cycles whose mean is the visit's value, and their standard deviation by visit."""
    n_cycles = drawn.n_cycles[person, visit]
    parts, spread = [], {}
    for name in MEASURES:
        mean = drawn.measures[name][person, visit]
        row, values = cycles_of(name, mean, n_cycles, g)
        number = np.arange(len(row)) - np.repeat(np.cumsum(n_cycles) - n_cycles, n_cycles)
        base = keys.iloc[row].assign(side=np.array(["left", "right"])[number % 2], cycle=number // 2 + 1)
        parts.append(base.assign(measure=name, value=values))
        spread[name] = np.sqrt(np.bincount(row, (values - mean[row]) ** 2) / (n_cycles - 1))
    return pd.concat(parts), spread


def cycles_of(
    name: str, mean: np.ndarray, n_cycles: np.ndarray, g: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """(C,) visit of each cycle, and its value, of (N,) visits of a measure; a visit's cycles have its `mean`."""
    row = np.repeat(np.arange(len(n_cycles)), n_cycles)
    own = MEASURES[name].cycle_sd * g.normal(size=len(row))
    own = own - (np.bincount(row, own) / n_cycles)[row]
    return row, mean[row] + own


def _curves(
    drawn: Drawn, person: np.ndarray, visit: np.ndarray, keys: pd.DataFrame, g: np.random.Generator
) -> pd.DataFrame:
    """Mean curves of both legs."""
    norm, phase = gait_norm(), 2 * np.pi * CURVE_PERCENT / 100
    waves = np.stack([f(k * phase) for k in (1, 2, 3) for f in (np.cos, np.sin)])
    patient = drawn.patient[person]
    # Slow walking at the patients' mean speed, free walking at the controls' (dimensionless, leg of 0.9 m).
    speeds = {
        group: getattr(MEASURES["speed_m_per_s"], group) / np.sqrt(9.81 * 0.9) for group in ("patients", "controls")
    }
    bump = np.exp(-0.5 * ((CURVE_PERCENT - KNEE_AT) / KNEE_WIDTH) ** 2)
    loss = KNEE_LOSS_DEG * patient * np.where(visit > 0, 1 - KNEE_GAIN, 1.0)
    parts = []
    for angle, (person_sd, visit_sd) in ANGLES.items():
        mean = np.where(
            patient[:, None], norm.curve(angle, phase, speeds["patients"]), norm.curve(angle, phase, speeds["controls"])
        )
        if angle == "knee_flexion":
            mean = mean - loss[:, None] * bump
        offset, shape = person_sd * 0.7, person_sd * 0.7 / np.sqrt(3)
        of_person = (
            offset * g.normal(size=(len(drawn.patient), 1)) + shape * g.normal(size=(len(drawn.patient), 6)) @ waves
        )
        for side in ("left", "right"):
            of_visit = (
                visit_sd * 0.7 * g.normal(size=(len(keys), 1)) + visit_sd * 0.4 * g.normal(size=(len(keys), 6)) @ waves
            )
            curves = mean + of_person[person] + of_visit
            for i in np.flatnonzero(g.random(len(keys)) < HIDDEN):
                start = int(g.integers(0, 80))
                curves[i, start : start + 15] = np.nan
            rows = keys.assign(side=side, variable=angle, unit="deg", n_cycles=drawn.n_cycles[person, visit] // 2)
            parts.append(rows.join(pd.DataFrame(curves, columns=list(CURVE_POINTS))))
    return pd.concat(parts)


def cohort(seed: int = 0, n_patients: int = 60, n_controls: int = 20) -> StudyData:
    """One study of the cohort."""
    g = np.random.default_rng(seed)
    return study_of(draw(g, n_patients, n_controls), g)


def score_truth(name: str, n: int = 400_000) -> dict[str, float]:
    """Return for a score, from many persons: correlation with the index at the first visit, by ranks where it is
    ordinal, and SRM from the first to the last."""
    many = draw(np.random.default_rng(0), n, 0)
    x, y = many.measures["gdi"][:, 0], many.scores[name]
    if SCORES[name].ordinal:
        r = np.corrcoef(stats.rankdata(x), stats.rankdata(y[:, 0]))[0, 1]
    else:
        r = np.corrcoef(x, y[:, 0])[0, 1]
    change = y[:, -1] - y[:, 0]
    return {"correlation": float(r), "srm": float(change.mean() / change.std(ddof=1))}


def truth() -> pd.DataFrame:
    """Return the estimands of the statistics: `statistic, of, value`."""
    rows: list[tuple[str, str, float]] = []
    for name, m in MEASURES.items():
        rows += [
            ("SRM, patients, first to last visit", name, m.srm),
            ("ICC of one visit, controls", name, m.icc),
            ("ICC of one cycle at the first visit, patients", name, m.icc_cycle),
            ("mean change, patients", name, m.change),
        ]
    for name in SCORES:
        found = score_truth(name)
        rows += [
            ("correlation with gdi, patients, first visit", name, found["correlation"]),
            ("SRM, patients, first to last visit", name, found["srm"]),
        ]
    return pd.DataFrame(rows, columns=["statistic", "of", "value"])


@click.command(help=__doc__)
@click.option("--out", type=click.Path(path_type=Path), required=True, help="Folder of the study.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@click.option("--patients", type=click.IntRange(1), default=60, show_default=True)
@click.option("--controls", type=click.IntRange(0), default=20, show_default=True)
def main(out: Path, seed: int, patients: int, controls: int) -> None:
    study = cohort(seed, patients, controls)
    write_study(study, out)
    truth().to_csv(out / "truth.csv", index=False, float_format="%.4f", lineterminator="\n")
    click.echo(f"{out}: {study.n_subjects} persons, {study.n_visits} visits")


if __name__ == "__main__":
    main()
