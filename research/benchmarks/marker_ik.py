"""Two walks fitted from laboratory markers, against two experts' inverse kinematics of the same markers.

    python -m research.benchmarks.marker_ik
    python -m research.benchmarks.marker_ik --together --set cost.weight_offset_per_m2=13

Reads `../shared/data/real/marker_ik`; see the README there for its source and licence. The markers' places on the body
are `data/marker_ik.csv`. Prints, for each walk, the marker RMS and, for each angle and expert, the correlation r, the
constant offset and what is left without it. An expert's zero of an angle is a convention (the two differ by up to 10
degrees), its movement is not. Signs: hip as in the body, knee flexion positive; the experts' models (Rajagopal's)
have these signs, ours has a negative knee.
"""

from __future__ import annotations

import dataclasses
import sys
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.body import MarkerSet, load_marker_set
from pbl_pipeline.fit import METHODS, TrialFit, fit_session
from pbl_pipeline.keypoints import WorldMarkers
from research.benchmarks.real_clips import changed
from research.paths import SHARED

FOLDER = SHARED / "real" / "marker_ik"
TABLE = Path(__file__).parent / "data" / "marker_ik.csv"
WALKS = ("walking1", "walkingTI1")
EXPERTS = ("addbiomechanics", "opensim_manual")
#: The issue's bars are on these; the others are printed beside them.
JUDGED = ("hip_flexion_r", "hip_flexion_l", "knee_flexion_r", "knee_flexion_l")
ALSO = ("hip_adduction_r", "hip_adduction_l", "hip_rotation_r", "hip_rotation_l", "ankle_angle_r", "ankle_angle_l")
MAX_RMS_MM, MIN_R, MAX_SD_DEG = 15.0, 0.97, 4.0


def read_mot(path: Path) -> dict[str, np.ndarray]:
    """Columns of an OpenSim .mot by name, angles in degrees whatever the file has; `time` in s, translations in m."""
    lines = path.read_text().splitlines()
    end = next(i for i, line in enumerate(lines) if line.strip() == "endheader")
    degrees = any(line.replace(" ", "") == "inDegrees=yes" for line in lines[:end])
    names = lines[end + 1].split()
    values = np.array([[float(v) for v in line.split()] for line in lines[end + 2 :] if line.strip()])
    columns = dict(zip(names, values.T, strict=True))
    lengths = ("time", "_tx", "_ty", "_tz")
    return {n: v if degrees or n.endswith(lengths) else np.rad2deg(v) for n, v in columns.items()}


def expert_angles(path: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Time stamps (s) and the angles of `JUDGED` and `ALSO` in degrees, from a .mot of a model with Rajagopal's knee
    (positive in flexion)."""
    columns = read_mot(path)
    return columns["time"], {n: columns[n.replace("knee_flexion", "knee_angle")] for n in (*JUDGED, *ALSO)}


def fitted_angles(fit: TrialFit) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The same of a fit, for the frames that it knows."""
    known = np.isfinite(fit.qpos).all(axis=1)
    degrees = {n: np.rad2deg(fit.qpos[known, i]) for i, n in enumerate(fit.joint_names)}
    knees = {f"knee_flexion_{s}": -degrees[f"knee_angle_{s}"] for s in "rl"}
    return np.asarray(fit.time_s)[known], {n: (degrees | knees)[n] for n in (*JUDGED, *ALSO)}


@dataclasses.dataclass(frozen=True)
class Agreement:
    """Agreement of two curves: correlation, mean difference (deg) and the standard deviation of the difference
    (deg)."""

    r: float
    offset_deg: float
    sd_deg: float

    @property
    def passed(self) -> bool:
        return self.r >= MIN_R and self.sd_deg <= MAX_SD_DEG


def agreement(
    ours: tuple[np.ndarray, dict[str, np.ndarray]], theirs: tuple[np.ndarray, dict[str, np.ndarray]]
) -> dict[str, Agreement]:
    """Return the agreement of each angle, at our time stamps within theirs."""
    inside = (ours[0] >= theirs[0][0] - 1e-6) & (ours[0] <= theirs[0][-1] + 1e-6)
    found = {}
    for name, values in ours[1].items():
        other = np.interp(ours[0][inside], theirs[0], theirs[1][name])
        difference = values[inside] - other
        r = float(np.corrcoef(values[inside], other)[0, 1])
        found[name] = Agreement(r, float(np.mean(difference)), float(np.std(difference)))
    return found


def marker_table() -> MarkerSet:
    return load_marker_set(TABLE)


def markers_of(walk: str, markers: MarkerSet) -> WorldMarkers:
    """The walk's markers that the table has, in its order."""
    return WorldMarkers.from_trc(FOLDER / f"{walk}.trc", markers.name).select(markers.names)


def marker_rms_mm(fit: TrialFit, trial: WorldMarkers) -> float:
    """Root of the mean squared distance of fitted and recorded markers over all that were seen (mm)."""
    distance = np.linalg.norm(fit.markers_world_m - trial.xyz_world_m, axis=-1)
    return float(1000 * np.sqrt(np.nanmean(distance[trial.confidence > 0] ** 2)))


def report(fit: TrialFit, trial: WorldMarkers, walk: str) -> bool:
    """Print a walk's table; whether all bars are met."""
    rms = marker_rms_mm(fit, trial)
    scale = " ".join(f"{s:.2f}" for s in fit.scale)
    moved = 1000 * np.linalg.norm(fit.site_offset_m, axis=1)
    good = rms <= MAX_RMS_MM
    click.echo(f"\n{walk}: {fit.seconds:.1f} s, marker RMS {rms:.1f} mm (bar {MAX_RMS_MM:g}) {_mark(good)}")
    click.echo(f"  scale {scale}; marker offsets median {np.median(moved):.1f} mm, largest {moved.max():.1f} mm")
    click.echo(f"  {'':18}" + "".join(f"{e:>34}" for e in EXPERTS))
    click.echo(f"  {'':18}" + f"{'r':>10}{'offset':>9}{'sd deg':>9}{'':>6}" * len(EXPERTS))
    found = {e: agreement(fitted_angles(fit), expert_angles(FOLDER / f"{walk}_ik_{e}.mot")) for e in EXPERTS}
    for name in (*JUDGED, *ALSO):
        cells = ""
        for expert in EXPERTS:
            a = found[expert][name]
            mark = _mark(a.passed) if name in JUDGED else ""
            good &= a.passed or name not in JUDGED
            cells += f"{a.r:10.3f}{a.offset_deg:9.1f}{a.sd_deg:9.2f}{mark:>6}"
        click.echo(f"  {name:18}{cells}")
    return good


def _mark(good: bool) -> str:
    return "PASS" if good else "FAIL"


@click.command()
@click.option("--params", default="markers", show_default=True, help="Name of a paramset.")
@click.option("--set", "changes", multiple=True, help="A change to it, such as cost.weight_offset_per_m2=13.")
@click.option("--together", is_flag=True, help="Both walks as the trials of one session, with one body.")
def main(params: str, changes: tuple[str, ...], together: bool) -> None:
    """Print marker RMS and agreement with the experts; exit code 1 where a bar is missed."""
    if not FOLDER.is_dir():
        sys.exit(f"the recording is absent: {FOLDER}")
    paramset, markers = changed(METHODS[params], changes), marker_table()
    trials = {walk: markers_of(walk, markers) for walk in WALKS}
    groups = [WALKS] if together else [(walk,) for walk in WALKS]
    good = True
    for group in groups:
        session = fit_session([trials[w] for w in group], list(group), paramset, markers=markers)
        for walk, fit in zip(group, session.trials, strict=True):
            good &= report(fit, trials[walk], walk)
        for check in session.qc:
            if check.outcome != "PASS":
                click.echo(f"  {check.outcome} {check.check}: {check.advice}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
