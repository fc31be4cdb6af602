"""Build the joint ranges of adults that ship: `python -m research.adult_ranges FILE.csv.gz`.

The file has one row a person: 138 able-bodied adults who walk at the speed that they choose, with the range of the mean
stride of hip, knee and ankle in the sagittal plane (Plug-in Gait). A constant that tells two models apart leaves a
range as it is. Curves are not in it, so it makes no bands and no norm.
"""

from __future__ import annotations

import json
from pathlib import Path

import click
import pandas as pd

from pbl_pipeline.files import sha256_of
from research.paths import PACKAGE

#: Our angle -> column (deg).
COLUMNS = {"hip_flexion": "Hip_ROM", "knee_flexion": "Knee_ROM", "ankle_dorsiflexion": "Ankle_ROM"}
OUT = PACKAGE / "gait" / "normative" / "curves" / "adult_ranges.json"


def build(path: Path) -> dict:
    """Return the ranges as a JSON object."""
    people = pd.read_csv(path)
    columns = {angle: people[column].to_numpy(float) for angle, column in COLUMNS.items()}
    age, speed = people["Age"].to_numpy(int), people["AvgSpeed_mps"].to_numpy(float)
    return {
        "name": "adults-138",
        "source": "138 able-bodied adults of Van Criekinge et al. 2023, as tabulated in "
        "DavidR-CSIC/Proyecto_Modulo1_Human_motion_analysis at commit d4d1ae7",
        "licence": "CC BY 4.0 (the source's); mean and standard deviation of its figures",
        "source_sha256": sha256_of(path),
        "n": len(people),
        "age": [int(age.min()), int(age.max())],
        "speed_m_per_s": [round(float(speed.mean()), 2), round(float(speed.std(ddof=1)), 2)],
        "range_deg": {a: [round(float(v.mean()), 1), round(float(v.std(ddof=1)), 1)] for a, v in columns.items()},
    }


@click.command()
@click.argument("path", type=click.Path(path_type=Path, exists=True))
def main(path: Path) -> None:
    """Write the file that ships."""
    OUT.write_text(json.dumps(build(path), indent=1) + "\n", encoding="utf-8")
    click.echo(f"written: {OUT}")


if __name__ == "__main__":
    main()
