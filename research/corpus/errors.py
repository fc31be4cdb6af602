"""Errors of the index, the gait measures and the joint angles over a corpus of known walks."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.body import joint_angles, joint_angles_sd, load_body, stature_m
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import SessionFit, SessionInput, TrialFit, fit_sessions
from pbl_pipeline.gait import Z90, GaitCycle, GdiParams, find_cycles, gait_metrics, score_gdi, spatiotemporal
from pbl_pipeline.methods import Method
from pbl_pipeline.paramset import Paramset
from research.corpus.walks import HEALTHY, VIEWS, Case

#: Column -> measure of `gait.MEASURES`.
MEASURES = {
    "cadence": "cadence_steps_per_min",
    "stance": "stance_percent",
    "stride_m": "stride_length_m",
    "speed": "speed_m_per_s",
}
#: Angles whose errors are reported, per side.
ANGLES = ("hip_flexion", "hip_adduction", "hip_rotation", "knee_flexion", "ankle_angle")
#: Views of one session whose indices are averaged. From which side is chance: "one side" is either.
SESSIONS: dict[str, list[tuple[str, ...]]] = {
    "front": [("frontal",)],
    "back": [("rear",)],
    "front and back": [("frontal", "rear")],
    "one side": [("sagittal",), ("sagittal_right",)],
    "both sides": [("sagittal", "sagittal_right")],
    "all five": [VIEWS],
}
#: A mean true change of the index below this is too small for a fraction of it.
LEAST_CHANGE = 3.0
#: Properties that two visits of one person share.
_VISIT = ["person", "view", "camera"]


def corpus_errors(
    cases: Sequence[Case],
    method: Paramset | str | None = None,
    fit: Callable[..., Sequence[SessionFit | PblError]] = fit_sessions,
    heights: bool = False,
    index: Method[GdiParams] | str | None = None,
) -> pd.DataFrame:
    """Fit every case as a session, all at once, and compare with its truth: one row per case. `heights`:
    the fit is told how tall each person is. `index`: a method of `GDI_METHODS`, None for the default, of the
    truth and of the fit.

    Columns: what the case is; `error`, a code where the fit failed; index and measures of the truth (`gdi_true`,
    `cadence_true` ...), of the fit with the true events (`gdi`, with its `gdi_sd` and `gdi_minimal_change`) and with
    detected ones (`gdi_detected` and `gdi_detected_sd`, `cadence` ...); of each of `ANGLES`, over sides and trials:
    `_offset` (deg), `_sd` without it, `_ratio` of the ranges and `_in90`, the fraction of the samples that lie in their
    90 % intervals. NaN where there is none.

    Raises `PblError` SOLVER_UNKNOWN.
    """
    body = load_body()
    tall = {c.walk: stature_m(body, c.walk.scale) if heights else None for c in cases}
    sessions = [
        SessionInput([*found.values()], [f"case{i} {view}" for view in found], c.camera, height_m=tall[c.walk])
        for i, (c, found) in enumerate((c, c.trials()) for c in cases)
    ]
    fits = fit(sessions, method)
    # Several cases are of one walk.
    truths = {walk: walk.fit() for walk in dict.fromkeys(c.walk for c in cases)}
    measured = {walk: _measured(find_cycles(walk.events, truth), index) for walk, truth in truths.items()}
    return pd.DataFrame(
        [_row(c, truths[c.walk], measured[c.walk], result, index) for c, result in zip(cases, fits, strict=True)]
    )


def _row(
    case: Case,
    truth: TrialFit,
    measured: dict[str, float],
    result: SessionFit | PblError,
    index: Method[GdiParams] | str | None,
) -> dict[str, Any]:
    walk = case.walk
    row: dict[str, Any] = {
        "person": walk.person,
        "source": walk.source,
        "held_out": walk.held_out,
        "condition": walk.condition,
        "severity": walk.severity,
        "view": case.view,
        "camera": case.camera,
        "detector": case.detector,
        "error": result.code if isinstance(result, PblError) else "",
    }
    row |= {f"{k}_true": v for k, v in measured.items()}
    if isinstance(result, PblError):
        return row
    gdi = score_gdi([c for trial in result.trials for c in find_cycles(walk.events, trial)], model=index)
    row |= {
        "gdi": _number(gdi.mean),
        "gdi_sd": _number(gdi.sd),
        "gdi_minimal_change": _number(gdi.minimal_change),
    }
    metrics = gait_metrics(result.trials, fit_checks=result.qc, model=index)
    row |= {"gdi_detected": _number(metrics.gdi.mean), "gdi_detected_sd": _number(metrics.gdi.sd)}
    row |= {k: _value(metrics.spatiotemporal.measures.get(n)) for k, n in MEASURES.items()}
    return row | pd.DataFrame([_angle_errors(trial, truth) for trial in result.trials]).mean().to_dict()


def _measured(cycles: Sequence[GaitCycle], index: Method[GdiParams] | str | None) -> dict[str, float]:
    measures = spatiotemporal(cycles).measures
    return {"gdi": _number(score_gdi(cycles, model=index).mean)} | {
        k: _value(measures.get(n)) for k, n in MEASURES.items()
    }


def _value(measure: Any) -> float:
    return float("nan") if measure is None else float(measure.mean)


def _number(value: float | None) -> float:
    return float("nan") if value is None else float(value)


def _angle_errors(fit: TrialFit, truth: TrialFit) -> dict[str, float]:
    found, true = joint_angles(fit.joint_names, fit.qpos), joint_angles(truth.joint_names, truth.qpos)
    spread = joint_angles_sd(fit.joint_names, fit.qpos_sd)
    out = {}
    for angle in ANGLES:
        sides = []
        for side in "rl":
            name = f"{angle}_{side}"
            seen = np.isfinite(found[name])
            off = (found[name] - true[name])[seen]
            if len(off) < 10:
                continue
            a, b = (np.subtract(*np.percentile(x[name][seen], [97.5, 2.5])) for x in (found, true))
            inside = np.abs(off) <= Z90 * spread[name][seen]
            known = np.isfinite(spread[name][seen])
            in90 = float(inside[known].mean()) if known.any() else float("nan")
            sides.append((off.mean(), off.std(), a / b if b > 1 else np.nan, in90))
        for end, values in zip(("offset", "sd", "ratio", "in90"), np.transpose(sides), strict=False):
            out[f"{angle}_{end}"] = float(np.mean(values))
    return out


# ---- tables


def corpus_tables(errors: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """The tables of a report, by title."""
    return {
        "index: error by view (true events)": _by_group(errors, "gdi", "gdi_true"),
        "index: error by view (detected events)": _by_group(errors, "gdi_detected", "gdi_true"),
        **({} if (views := view_table(errors)).empty else {"index: mean of a walk's views": views}),
        "gait measures: error": measure_table(errors),
        "joint angles: error by view (deg)": angle_table(errors),
        "samples in their 90 % intervals": coverage_table(errors),
        "fraction of a true change of the index that survives": responsiveness(errors),
    }


def _groups(errors: pd.DataFrame) -> dict[str, Any]:
    """Name -> rows. (pandas' own types say less of a selection than this code needs.)"""
    groups: dict[str, Any] = {"all": errors}
    if len(set(errors["held_out"])) > 1:
        groups |= {"held out": errors[errors["held_out"]], "tuning": errors[~errors["held_out"]]}
    for column in ("source", "view", "camera"):
        groups |= {str(k): g for k, g in errors.groupby(column, sort=False)}
    return groups


def _by_group(errors: pd.DataFrame, found: str, true: str) -> pd.DataFrame:
    rows = []
    for name, group in _groups(errors).items():
        off, known = group[found] - group[true], group[[found, true]].dropna()
        rows.append(
            {
                "cases": name,
                "n": len(group),
                "none": int(group[found].isna().sum()),
                "true mean": group[true].mean(),
                "bias": off.mean(),
                "sd": off.std(),
                "rms": float(np.sqrt((off**2).mean())),
                "correlation": known.corr().iloc[0, 1] if len(known) > 2 else np.nan,
            }
        )
    return pd.DataFrame(rows)


def view_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Error of the mean of the indices of one walk from several views (`SESSIONS`), each by the first camera that saw
    it: over the walks that were seen so, and over those of the persons held out. A separate trial is made of each
    view: the walk is the same, the detector errs anew."""
    walk = ["held_out", "person", "condition", "severity"]
    off: Any = errors.assign(off=errors["gdi"] - errors["gdi_true"]).pivot_table(
        index=walk, columns="view", values="off", aggfunc="first"
    )
    rows = []
    for name, sets in SESSIONS.items():
        if not {v for views in sets for v in views} <= set(off.columns):
            continue
        means = pd.concat([off[list(views)].mean(axis=1, skipna=False) for views in sets]).dropna()
        held = means[means.index.get_level_values("held_out")]
        rows.append(
            {
                "views": name,
                "n": len(means),
                "bias": means.mean(),
                "sd": means.std(),
                "held out: n": len(held),
                "held out: bias": held.mean(),
                "held out: sd": held.std(),
            }
        )
    return pd.DataFrame(rows)


def measure_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Bias, standard deviation and correlation of the gait measures; the stride also as a ratio."""
    rows = []
    for name in MEASURES:
        known: Any = errors[[name, f"{name}_true"]].dropna()
        off = known[name] - known[f"{name}_true"]
        rows.append(
            {
                "measure": MEASURES[name],
                "n": len(known),
                "true mean": known[f"{name}_true"].mean(),
                "bias": off.mean(),
                "sd": off.std(),
                "ratio": (known[name] / known[f"{name}_true"]).median(),
                "correlation": known.corr().iloc[0, 1] if len(known) > 2 else np.nan,
            }
        )
    return pd.DataFrame(rows)


def angle_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Hip, knee and ankle by view: mean offset, its spread between cases, the rest within a case, ratio of ranges."""
    rows = []
    for name, group in _groups(errors).items():
        row: dict[str, Any] = {"cases": name}
        for angle, short in zip(ANGLES, ("hip", "add", "rot", "knee", "ankle"), strict=True):
            row[f"{short} off"] = group[f"{angle}_offset"].mean()
            row[f"{short} off sd"] = group[f"{angle}_offset"].std()
            row[f"{short} sd"] = group[f"{angle}_sd"].median()
            row[f"{short} range"] = group[f"{angle}_ratio"].median()
        rows.append(row)
    return pd.DataFrame(rows)


def coverage_table(errors: pd.DataFrame) -> pd.DataFrame:
    """Fraction of the samples of each angle, and of the cases' indices (with true and with detected events), inside of
    their 90 % intervals."""
    rows = []
    for name, group in _groups(errors).items():
        row = {"cases": name, **{angle: group[f"{angle}_in90"].mean() for angle in ANGLES}}
        for title, found in (("index", "gdi"), ("detected events", "gdi_detected")):
            known: Any = group[[found, "gdi_true", f"{found}_sd"]].dropna()
            row[title] = ((known[found] - known["gdi_true"]).abs() <= Z90 * known[f"{found}_sd"]).mean()
        rows.append({**row, "index sd": group["gdi_sd"].mean()})
    return pd.DataFrame(rows)


def responsiveness(errors: pd.DataFrame, found: str = "gdi", true: str = "gdi_true") -> pd.DataFrame:
    """Return the fraction of the change of the index between two visits of a person that is found, per impairment and
    over all.

    Two visits: healthy and impaired, or two severities, seen from the same view. The fraction is the sum of the changes
    found over the sum of the true ones, so that small changes do not dominate; NaN where the true mean change is below
    `LEAST_CHANGE`. `rms` is that of the error of a change, `se` the standard error of the fraction, `within` the
    fraction of the errors that are below the minimal change of the first visit's index.
    """
    synthetic: Any = errors[errors["source"] == "synthetic"]
    healthy = synthetic[synthetic["condition"] == HEALTHY]
    impaired = synthetic[synthetic["condition"] != HEALTHY]
    rows = []
    for name, own in [*impaired.groupby("condition", sort=False), ("all", impaired)]:
        low, high = own["severity"].min(), own["severity"].max()
        first, last = own[own["severity"] == low], own[own["severity"] == high]
        row: dict[str, Any] = {"impairment": name}
        for label, before, on in (
            (f"healthy to {high:g}", healthy, _VISIT),
            (f"{low:g} to {high:g}", first, [*_VISIT, "condition"]),
        ):
            both = before.merge(last, on=on, suffixes=("_before", "_after"))
            change = both[f"{found}_after"] - both[f"{found}_before"]
            real = both[f"{true}_after"] - both[f"{true}_before"]
            known = change.notna() & real.notna()
            n, total, off = int(known.sum()), float(real[known].sum()), (change - real)[known]
            enough = n > 0 and abs(total / n) >= LEAST_CHANGE
            row |= {
                f"{label}: n": n,
                f"{label}: true": real[known].mean(),
                f"{label}: survives": change[known].sum() / total if enough else np.nan,
                f"{label}: se": off.std() * np.sqrt(n) / abs(total) if enough else np.nan,
                f"{label}: rms": float(np.sqrt((off**2).mean())),
                f"{label}: within": (off.abs() <= both["gdi_minimal_change_before"][known]).mean(),
            }
        rows.append(row)
    return pd.DataFrame(rows)


def print_corpus(tables: dict[str, pd.DataFrame]) -> str:
    """The tables as text."""
    parts = [f"{title}\n{t.to_string(index=False, float_format=lambda v: f'{v:.2f}')}" for title, t in tables.items()]
    return "\n\n".join(parts)


def write_corpus(
    out: str | Path, errors: pd.DataFrame, tables: Mapping[str, pd.DataFrame], about: dict[str, Any]
) -> list[Path]:
    """Write `cases.csv`, a row per case, and `gdi.json`, their `corpus_tables` with what was run; returns the paths."""
    folder = Path(out)
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "cases.csv", folder / "gdi.json"]
    errors.to_csv(paths[0], index=False, float_format="%.5g")
    # Through JSON's own numbers: NaN is null.
    rows = {k: json.loads(str(t.to_json(orient="records"))) for k, t in tables.items()}
    paths[1].write_text(json.dumps({"about": about, "tables": rows}, indent=1) + "\n", encoding="utf-8")
    return paths
