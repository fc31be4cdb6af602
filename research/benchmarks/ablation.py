"""Limits of the accuracy of the fit: one factor at a time against the benchmark's default, on synthetic walks.

    python -m research.benchmarks.ablation
    python -m research.benchmarks.ablation --seeds 4 --duration-s 6 --only camera --only "2D weight"
    python -m research.benchmarks.ablation --out results/ablation      # results/ablation.csv and .json

Every row has the same people, walks and random numbers as the default where it can (not another marker set or frame
rate), so rows are compared person by person. Errors are of the first trial of a session. The table is sorted by what
costs most; `+-` is the standard error of the change over people.

Columns: `all` and `main`: mean over joints of the median absolute error over frames, as in research/reports;
`bias`: mean over joints of the size of the mean error of a trial; `sd`: of the remainder; `bias share`: of
the mean square error; `RTE`: mean distance of the pelvis to its true path after rotation about the vertical and shift;
`in 90 %`: share of the samples within 1.645 standard deviations of the fit. `research/reports` says what was found.
"""

from __future__ import annotations

import csv
import json
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import scipy.linalg  # noqa: F401 - so that its BLAS is loaded when threads are limited
from threadpoolctl import threadpool_limits

from pbl_pipeline.bench.case import MAIN_JOINTS, PAPER_JOINTS
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import TrialFit, fit_sessions
from pbl_pipeline.results.measures import Z90
from pbl_pipeline.synthetic import pelvis_positions
from research.benchmarks.ablation_cases import DEFAULT, WALKS, Factor, WalkSource, factors, paramset_of, session

#: Walks on which nothing was tuned: the paramsets were tuned on 0 to 5 and their factors on 0 to 47 and 1000 to 1047.
FIRST_SEED = 100
FIGURES = ("all_deg", "main_deg", "bias_deg", "sd_deg", "bias_share", "rte_cm", "within_90")


def path_error_m(path_m: np.ndarray, true_m: np.ndarray) -> float:
    """Mean distance (m) of two paths (T, 3) after the rotation about z and the shift that bring them together best."""
    a, b = path_m - path_m.mean(axis=0), true_m - true_m.mean(axis=0)
    # Least squares of the level parts: the angle of the sum of conj(a) b as complex numbers.
    turn = np.angle(np.sum((a[:, 0] - 1j * a[:, 1]) * (b[:, 0] + 1j * b[:, 1])))
    c, s = np.cos(turn), np.sin(turn)
    turned = a @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    return float(np.mean(np.linalg.norm(turned - b, axis=1)))


def errors_of(fit: TrialFit, truth: np.ndarray) -> dict[str, Any]:
    """Errors of one trial against its true qpos (T, 40): by joint of the paper `median_deg`, `bias_deg`, `sd_deg`,
    `within_90`; `rte_cm`."""
    known = np.all(np.isfinite(fit.qpos), axis=1)
    columns = [fit.joint_names.index(n) for n in PAPER_JOINTS]
    error = np.rad2deg((fit.qpos - truth)[known][:, columns])
    sd = np.rad2deg(fit.qpos_sd[known][:, columns])
    each = {
        "median_deg": np.median(np.abs(error), axis=0),
        "bias_deg": error.mean(axis=0),
        "sd_deg": error.std(axis=0),
        "within_90": np.mean(np.abs(error) < Z90 * sd, axis=0),
    }
    out: dict[str, Any] = {k: dict(zip(PAPER_JOINTS, v.tolist(), strict=True)) for k, v in each.items()}
    out["rte_cm"] = 100 * path_error_m(pelvis_positions(fit.qpos[known]), pelvis_positions(truth[known]))
    return out


def figures_of(errors: Mapping[str, Any]) -> dict[str, float]:
    """`FIGURES` of one trial from its `errors_of`."""

    def over(key: str, joints: Sequence[str] = PAPER_JOINTS) -> np.ndarray:
        return np.array([errors[key][n] for n in joints])

    bias, sd = over("bias_deg"), over("sd_deg")
    return {
        "all_deg": float(over("median_deg").mean()),
        "main_deg": float(over("median_deg", MAIN_JOINTS).mean()),
        "bias_deg": float(np.abs(bias).mean()),
        "sd_deg": float(sd.mean()),
        "bias_share": float(np.sum(bias**2) / np.sum(bias**2 + sd**2)),
        "rte_cm": errors["rte_cm"],
        "within_90": float(over("within_90").mean()),
    }


def row_of(factor: Factor, errors: Mapping[int, Any], default: Mapping[int, Any]) -> dict[str, Any]:
    """One row from the errors by seed: the mean over people of each figure, and the change of `all` and `main` from
    the default with its standard error, over the people whom both could fit."""
    each = {s: figures_of(e) for s, e in errors.items()}
    other = {s: figures_of(e) for s, e in default.items()}
    row: dict[str, Any] = {"group": factor.group, "factor": factor.name, "people": len(each)}
    row |= {k: float(np.mean([e[k] for e in each.values()])) if each else float("nan") for k in FIGURES}
    both = sorted(set(each) & set(other))
    for k in ("all_deg", "main_deg"):
        change = np.array([each[s][k] - other[s][k] for s in both])
        row[f"change_{k}"] = float(change.mean()) if both else float("nan")
        row[f"change_{k}_se"] = float(change.std(ddof=1) / np.sqrt(len(both))) if len(both) > 1 else float("nan")
    row["joints"] = {
        k: {n: float(np.mean([np.abs(e[k][n]) for e in errors.values()])) for n in PAPER_JOINTS} if each else {}
        for k in ("median_deg", "bias_deg", "sd_deg", "within_90")
    }
    return row


def measured(factor: Factor, seeds: Sequence[int], duration_s: float, source: WalkSource) -> dict[int, Any]:
    """`errors_of` the first trial of each person that could be fitted."""
    made = [session(factor.setup, s, duration_s, source) for s in seeds]
    fits = fit_sessions([m[0] for m in made], paramset_of(factor.setup))
    out = {}
    for seed, (_, truth), fit in zip(seeds, made, fits, strict=True):
        if isinstance(fit, PblError):
            click.echo(f"  {factor.name}, person {seed}: {fit.code}", err=True)
        else:
            out[seed] = errors_of(fit.trials[0], truth[0])
    return out


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """The rows as text, the costliest first; the default stands where its change of 0 puts it."""
    head = f"{'group':9}{'factor':52}{'all':>7}{'change':>8}{'+-':>6}{'main':>7}{'bias':>7}{'sd':>7}"
    lines = [head + f"{'bias share':>12}{'RTE cm':>8}{'in 90 %':>9}{'people':>8}"]
    for r in sorted(rows, key=lambda r: -np.nan_to_num(r["change_all_deg"], nan=-99)):
        lines.append(
            f"{r['group']:9}{r['factor']:52}{r['all_deg']:7.2f}{r['change_all_deg']:+8.2f}{r['change_all_deg_se']:6.2f}"
            f"{r['main_deg']:7.2f}{r['bias_deg']:7.2f}{r['sd_deg']:7.2f}{r['bias_share']:12.0%}{r['rte_cm']:8.2f}"
            f"{r['within_90']:9.0%}{r['people']:8d}"
        )
    return "\n".join(lines)


def write(out: Path, rows: Sequence[Mapping[str, Any]], conditions: Mapping[str, Any]) -> None:
    """`out`.json with everything and `out`.csv without the joints."""
    out.parent.mkdir(parents=True, exist_ok=True)
    out.with_suffix(".json").write_text(json.dumps({**conditions, "rows": list(rows)}, indent=1))
    with out.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, [k for k in rows[0] if k != "joints"], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)


@click.command()
@click.option("--seeds", default=8, show_default=True, help="People.")
@click.option("--first-seed", default=FIRST_SEED, show_default=True)
@click.option("--duration-s", default=10.0, show_default=True, help="Of each walk.")
@click.option("--walks", default="walker", show_default=True, type=click.Choice(sorted(WALKS)))
@click.option("--only", multiple=True, help="Rows whose group or name has this in it; the default is always there.")
@click.option("--out", type=click.Path(path_type=Path), help="Write OUT.json and OUT.csv, anew after each row.")
def main(seeds: int, first_seed: int, duration_s: float, walks: str, only: tuple[str, ...], out: Path | None) -> None:
    """Fit all rows and print the table."""
    chosen = [f for f in factors() if not only or any(o in f"{f.group}: {f.name}" for o in only)]
    people = range(first_seed, first_seed + seeds)
    conditions = {"people": list(people), "duration_s": duration_s, "walks": walks}
    rows: list[dict[str, Any]] = []
    default: dict[int, Any] = {}
    with threadpool_limits(1):
        for i, factor in enumerate((DEFAULT, *chosen)):
            begin = time.perf_counter()
            errors = measured(factor, people, duration_s, WALKS[walks])
            default = default or errors
            rows.append(row_of(factor, errors, default))
            seconds = time.perf_counter() - begin
            click.echo(f"  {i}/{len(chosen)} {factor.name}: {rows[-1]['all_deg']:.2f} deg, {seconds:.0f} s", err=True)
            if out is not None:
                write(out, rows, conditions)
    click.echo(f"{seeds} people from seed {first_seed}, walks of {duration_s:g} s ({walks}); angles in degrees")
    click.echo(table(rows))


if __name__ == "__main__":
    main()
