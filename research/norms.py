"""Build the normative sets that ship: `python -m research.norms GDI_Calc_Fast_Data.mat`.

The file is the one published with the Gait Deviation Index (Schwartz & Rozumalski 2008, Gait & Posture 28:351-357):
`all_ctrl_gait_vectors` (459, 166), one column per control subject, nine angles x 51 points of the cycle in degrees;
`gait_features` (459, 15), the basis of the original index.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import click
import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from pbl_pipeline.errors import PblError
from pbl_pipeline.files import sha256_of
from pbl_pipeline.gait.normative import (
    BODY_ANGLES,
    DEFAULT_NORM,
    NINE_ANGLES,
    PLUG_IN_GAIT,
    THREE_ANGLES,
    NormativeSet,
    fit_norm,
    offset_deg,
)
from research.paths import PACKAGE

POINTS = 51


def gillette_vectors(path: str | Path) -> np.ndarray:
    """The control vectors (166, 459) in degrees. Raises `PblError` NORM_INVALID where the file holds none."""
    try:
        vectors = np.asarray(loadmat(path)["all_ctrl_gait_vectors"], float).T
    except (OSError, ValueError, KeyError, NotImplementedError, MatReadError) as error:
        raise _not_gillette(path, f"{type(error).__name__}: {error}") from error
    if vectors.ndim != 2 or vectors.shape[1] != len(NINE_ANGLES) * POINTS:
        raise _not_gillette(path, f"vectors of shape {vectors.shape}")
    return vectors


def build_gillette(path: str | Path) -> NormativeSet:
    """The set `gillette-166-three-angles` from GDI_Calc_Fast_Data.mat. Raises `PblError` NORM_INVALID."""
    return _three_angles(path, PLUG_IN_GAIT)


def build_body_angles(path: str | Path) -> NormativeSet:
    """The set `gillette-166-body-angles`: the same controls, their angles mapped to those of the fitted body."""
    return _three_angles(path, BODY_ANGLES)


def build_nine_angles(path: str | Path) -> NormativeSet:
    """The set `gillette-166-nine-angles`: the original index, its 15 published features and all nine angles.

    Raises `PblError` NORM_INVALID.
    """
    vectors = gillette_vectors(path)
    try:
        features = np.asarray(loadmat(path)["gait_features"], float).T
    except KeyError as error:
        raise _not_gillette(path, "no gait_features") from error
    if features.ndim != 2 or features.shape[1] != vectors.shape[1]:
        raise _not_gillette(path, f"features of shape {features.shape}")
    mean = vectors.mean(axis=0)
    spread = np.sum(((vectors - mean) @ features.T) ** 2, axis=0) / (len(vectors) - 1)
    fraction = float(spread.sum() / np.var(vectors, axis=0, ddof=1).sum())
    distance = np.log(np.linalg.norm((vectors - mean) @ features.T, axis=1))
    return NormativeSet(
        name="gillette-166-nine-angles",
        version=1,
        n=len(vectors),
        source=_SOURCE + "; with the 15 gait features published there",
        licence=_LICENCE,
        convention="laboratory model of Plug-in-Gait kind (skin markers), degrees, one vector a subject",
        variables=NINE_ANGLES,
        percent=_PHASE,
        mean_deg=mean,
        components=features,
        explained_variance=spread,
        explained_share=fraction,
        ln_mean=float(distance.mean()),
        ln_sd=float(distance.std(ddof=1)),
        curves=_curves(vectors, PLUG_IN_GAIT),
        source_sha256=sha256_of(path),
        angle_model=PLUG_IN_GAIT,
    )


#: Name of each set -> its function, and the significant digits of its file (None: all).
BUILDERS: dict[str, tuple[Callable[[str | Path], NormativeSet], int | None]] = {
    "gillette-166-three-angles": (build_gillette, 7),
    DEFAULT_NORM: (build_body_angles, 7),
    "gillette-166-nine-angles": (build_nine_angles, None),
}

_PHASE = np.linspace(0.0, 100.0, POINTS)
_SOURCE = (
    "166 control subjects of Gillette Children's Specialty Healthcare, Schwartz & Rozumalski 2008, "
    "Gait & Posture 28:351-357; file GDI_Calc_Fast_Data.mat of github.com/peruvianox/WAAAG"
)
_LICENCE = "MIT (c) 2022 Ricky Pimentel"


def _three_angles(path: str | Path, angle_model: str) -> NormativeSet:
    vectors = gillette_vectors(path)
    by_angle = dict(zip(NINE_ANGLES, np.split(vectors, len(NINE_ANGLES), axis=1), strict=True))
    mapped = angle_model != PLUG_IN_GAIT
    shift = offset_deg("hip_flexion", PLUG_IN_GAIT, angle_model)
    text = "laboratory model of Plug-in-Gait kind (skin markers), degrees, one vector a subject"
    if mapped:
        text += f"; mapped to the fitted body: {shift:+g} deg of hip flexion and pelvic tilt"
    return fit_norm(
        # 50 points at 0, 2, ..., 98 %: 100 % is the 0 % of the next cycle.
        np.hstack([by_angle[a][:, : POINTS - 1] + offset_deg(a, PLUG_IN_GAIT, angle_model) for a in THREE_ANGLES]),
        name=DEFAULT_NORM if mapped else "gillette-166-three-angles",
        version=1,
        variables=THREE_ANGLES,
        percent=_PHASE[: POINTS - 1],
        source=_SOURCE,
        licence=_LICENCE,
        convention=text,
        curves=_curves(vectors, angle_model),
        source_sha256=sha256_of(path),
        angle_model=angle_model,
        mapped_from=PLUG_IN_GAIT if mapped else "",
    )


def _curves(vectors: np.ndarray, angle_model: str) -> dict[str, dict[str, np.ndarray]]:
    by_angle = zip(NINE_ANGLES, np.split(vectors, len(NINE_ANGLES), axis=1), strict=True)
    return {
        name: {
            "percent": _PHASE,
            "mean_deg": v.mean(axis=0) + offset_deg(name, PLUG_IN_GAIT, angle_model),
            "sd_deg": v.std(axis=0, ddof=1),
        }
        for name, v in by_angle
    }


def _not_gillette(path: str | Path, found: str) -> PblError:
    return PblError(
        "NORM_INVALID",
        found=found,
        expected=f"a MATLAB file with all_ctrl_gait_vectors ({len(NINE_ANGLES) * POINTS} x N) and gait_features",
        next_step="pass GDI_Calc_Fast_Data.mat as published with the Gait Deviation Index",
        key=str(path),
    )


@click.command()
@click.argument("mat", type=click.Path(path_type=Path))
@click.option("--out", type=click.Path(path_type=Path), help="Folder to write to (default: into the package).")
def main(mat: Path, out: Path | None) -> None:
    """Build the sets of the 166 controls in MAT and write each as JSON.

    Example: python -m research.norms GDI_Calc_Fast_Data.mat --out norms
    """
    folder = out or PACKAGE / "gait" / "normative" / "data"
    folder.mkdir(parents=True, exist_ok=True)
    for name, (build, digits) in BUILDERS.items():
        try:
            norm = build(mat)
        except PblError as error:
            raise click.ClickException(error.text()) from error
        norm.save(folder / f"{name}.json", digits)
        click.echo(
            f"{name}: {norm.n} vectors, {len(norm.components)} components, "
            f"{100 * norm.explained_share:.2f} % of the variance, ln distance {norm.ln_mean:.6f} +- {norm.ln_sd:.6f}"
        )


if __name__ == "__main__":
    main()
