"""Build the normative set that ships: `python -m pbl_pipeline.gait.build_norm GDI_Calc_Fast_Data.mat`.

The file is the one published with the Gait Deviation Index (Schwartz & Rozumalski 2008, Gait & Posture 28:351-357):
`all_ctrl_gait_vectors` (459, 166), one column per control subject, nine angles x 51 points of the cycle in degrees.
"""

from __future__ import annotations

import hashlib
from pathlib import Path

import click
import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from pbl_pipeline.errors import PblError

from .normative import DEFAULT_NORM, NormativeSet, fit_norm

#: Order of the nine angles in a vector of 459 = 9 x 51, by our names ("foot_progression" has no curve here).
GILLETTE_ORDER = (
    "pelvis_tilt",
    "pelvis_obliquity",
    "pelvis_rotation",
    "hip_flexion",
    "hip_adduction",
    "hip_rotation",
    "knee_flexion",
    "ankle_dorsiflexion",
    "foot_progression",
)
THREE_ANGLES = ("hip_flexion", "hip_adduction", "knee_flexion")
POINTS = 51


def gillette_vectors(path: str | Path) -> np.ndarray:
    """The control vectors (166, 459) in degrees. Raises `PblError` NORM_INVALID where the file holds none."""
    try:
        vectors = np.asarray(loadmat(path)["all_ctrl_gait_vectors"], float).T
    except (OSError, ValueError, KeyError, NotImplementedError, MatReadError) as error:
        raise _not_gillette(path, f"{type(error).__name__}: {error}") from error
    if vectors.ndim != 2 or vectors.shape[1] != len(GILLETTE_ORDER) * POINTS:
        raise _not_gillette(path, f"vectors of shape {vectors.shape}")
    return vectors


def build_gillette(path: str | Path) -> NormativeSet:
    """The set `gillette-166-three-angles` from GDI_Calc_Fast_Data.mat. Raises `PblError` NORM_INVALID."""
    vectors = gillette_vectors(path)
    by_angle = dict(zip(GILLETTE_ORDER, np.split(vectors, len(GILLETTE_ORDER), axis=1), strict=True))
    phase = np.linspace(0.0, 100.0, POINTS)
    curves = {
        name: {"percent": phase, "mean_deg": v.mean(axis=0), "sd_deg": v.std(axis=0, ddof=1)}
        for name, v in by_angle.items()
    }
    return fit_norm(
        # 50 points at 0, 2, ..., 98 %: 100 % is the 0 % of the next cycle.
        np.hstack([by_angle[name][:, : POINTS - 1] for name in THREE_ANGLES]),
        name=DEFAULT_NORM,
        version=1,
        variables=THREE_ANGLES,
        percent=phase[: POINTS - 1],
        source="166 control subjects of Gillette Children's Specialty Healthcare, Schwartz & Rozumalski 2008, "
        "Gait & Posture 28:351-357; file GDI_Calc_Fast_Data.mat of github.com/peruvianox/WAAAG",
        licence="MIT (c) 2022 Ricky Pimentel",
        convention="laboratory model of Plug-in-Gait kind (skin markers), degrees, one vector a subject",
        curves=curves,
        source_sha256=hashlib.sha256(Path(path).read_bytes()).hexdigest(),
    )


def _not_gillette(path: str | Path, found: str) -> PblError:
    return PblError(
        "NORM_INVALID",
        found=found,
        expected=f"a MATLAB file with all_ctrl_gait_vectors ({len(GILLETTE_ORDER) * POINTS} x N)",
        next_step="pass GDI_Calc_Fast_Data.mat as published with the Gait Deviation Index",
        key=str(path),
    )


@click.command()
@click.argument("mat", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="JSON to write (default: into the package).")
def main(mat: Path, out: Path | None) -> None:
    """Fit the normative basis of three angles to the 166 controls in MAT and write it as JSON.

    Example: python -m pbl_pipeline.gait.build_norm GDI_Calc_Fast_Data.mat --out norm.json
    """
    try:
        norm = build_gillette(mat)
    except PblError as error:
        raise click.ClickException(error.text()) from error
    target = out or Path(__file__).parent / "normative" / "data" / f"{DEFAULT_NORM}.json"
    norm.save(target)
    click.echo(
        f"{target}: {norm.n} vectors, {len(norm.components)} components, "
        f"{100 * norm.explained_share:.2f} % of the variance, ln distance {norm.ln_mean:.6f} +- {norm.ln_sd:.6f}"
    )


if __name__ == "__main__":
    main()
