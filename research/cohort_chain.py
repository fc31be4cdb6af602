"""A few persons of a cohort through the whole chain: `python -m research.cohort_chain --out FILE.csv`.

`research/cohort.py` draws a visit's index from its truth and an error. Here the walk itself is made, seen as BlazePose
sees it, fitted, its events found and its index computed: patients whose knees are stiff before surgery and less so
after it, and controls who do not change. Each visit has separate errors. Prints, by visit, the index of the true
motion, the one that was found with its standard deviation, and whether a change since the first visit is larger than
the least that can be told; then the error's mean and standard deviation, and that between visits beside the cohort's.
All of it is a function of the persons.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import SessionInput, fit_sessions
from pbl_pipeline.gait import find_cycles, gait_metrics, score_gdi
from research.cohort import CONTROLS, INDEX, PATIENTS, ROLES
from research.corpus.walks import Case, synthetic_walk

IMPAIRMENT = "stiff_knee"
#: Of the patients' impairment at the visits, and how each visit is filmed.
SEVERITIES = (0.8, 0.6, 0.4)
FILMED = (("oblique", "static"), ("oblique", "handheld"), ("sagittal", "static"))


def cases(each: int) -> list[tuple[str, str, Case]]:
    """(group, role, visit) of `each` patients and as many controls."""
    found = []
    for seed in range(2 * each):
        group = (PATIENTS, CONTROLS)[seed // each]
        for role, severity, (view, camera) in zip(ROLES, SEVERITIES, FILMED, strict=True):
            walk = synthetic_walk(seed, IMPAIRMENT, severity) if group == PATIENTS else synthetic_walk(seed)
            found.append((group, role, Case(walk, view, camera, "blazepose")))
    return found


def measured(visits: list[tuple[str, str, Case]]) -> pd.DataFrame:
    """A row by visit: `subject, group, role, gdi_true, gdi, gdi_sd, changed, problem`."""
    sessions = [SessionInput([case.keypoints()], [case.walk.person], case.camera) for _, _, case in visits]
    rows: list[dict[str, Any]] = []
    for (group, role, case), fit in zip(visits, fit_sessions(sessions), strict=True):
        truth = score_gdi(find_cycles(case.walk.events, case.walk.fit())).mean
        row = {"subject": case.walk.person, "group": group, "role": role, "gdi_true": truth}
        if isinstance(fit, PblError):
            rows.append({**row, "problem": fit.code})
            continue
        index = gait_metrics(fit.trials, fit_checks=fit.qc).gdi
        first = next((r for r in rows if r["subject"] == row["subject"] and r["role"] == ROLES[0]), None)
        least = index.minimal_change
        told = "" if first is None or least is None else str(bool(abs(index.mean - first["gdi"]) > least))
        rows.append({**row, "gdi": index.mean, "gdi_sd": index.sd, "changed": told, "problem": ""})
    return pd.DataFrame(rows)


@click.command(help=__doc__)
@click.option("--each", type=click.IntRange(1), default=2, show_default=True, help="Patients, and as many controls.")
@click.option("--out", type=click.Path(path_type=Path), help="CSV file to write.")
def main(each: int, out: Path | None) -> None:
    found = measured(cases(each))
    click.echo(found.round(1).to_string(index=False))
    error: Any = found["gdi"] - found["gdi_true"]
    of_person = error.groupby(found["subject"])
    click.echo(
        f"error: mean {error.mean():.1f}, sd {error.std():.1f}, between visits of a person "
        f"{np.sqrt(of_person.var().mean()):.1f} (drawn cohort: {INDEX.visit_sd:g})"
    )
    if out is not None:
        found.to_csv(out, index=False, lineterminator="\n")


if __name__ == "__main__":
    main()
