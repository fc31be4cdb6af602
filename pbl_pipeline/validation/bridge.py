"""Shift of index and measures by a change of version or method: the same recordings by both, in pairs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.gait import EVENT_METHODS, GDI_METHODS, MEASURES, GaitParams, gait_metrics
from pbl_pipeline.methods import Method, Stage
from pbl_pipeline.synthetic import Impairment, SynthSpec, synthesise
from pbl_pipeline.visit import Recording, Visit, save_visit, solution_of
from pbl_pipeline.visit.files import METRICS, file_of_visit

from .write import Cell, Table

#: Measure of a frame of values that is the index.
INDEX = "gdi"
#: Recordings that both sides of a bridge refit: frozen, so that two versions see the same points.
BRIDGE_SET: Mapping[str, SynthSpec] = {
    f"{name}_{view}_{seed}": SynthSpec(
        seed=seed,
        impairments=() if name == "healthy" else (Impairment(name, 0.7),),
        view=view,
        camera="panned" if view == "sagittal" else "static",
        seconds=8.0,
        marker_set="blazepose_33",
        noise="memory",
    )
    for seed, (name, view) in enumerate(
        (name, view)
        for name in ("healthy", "crouch", "stiff_knee", "short_steps", "weakness")
        for view in ("sagittal", "frontal")
    )
}


def refit_bridge_set(name: str, folder: Path, done: Callable[[], object] = lambda: None) -> None:
    """Fit and measure the recordings of `BRIDGE_SET` by the default methods but one, and write each visit into a
    separate folder below `folder`, which another version can then be compared with.

    Raises `PblError` SOLVER_UNKNOWN for a name that no method has, and what fitting and measuring raise.
    """
    from pbl_pipeline.fit import METHODS, default_fit, fit_session

    stage, method = _method(name, {"fit": METHODS, "gait": EVENT_METHODS, "gdi": GDI_METHODS})
    for recording, spec in BRIDGE_SET.items():
        keypoints = synthesise(spec).keypoints
        fit = method if stage == "fit" else METHODS[default_fit((keypoints.marker_set, keypoints.root_relative))]
        session = fit_session([keypoints], [recording], fit, "static" if spec.camera == "static" else "handheld")
        params = GaitParams(
            **({"events": method.paramset} if stage == "gait" else {}),
            gdi=GDI_METHODS.find(method if stage == "gdi" else None).params,
        )
        index = method if stage == "gdi" else None
        measured = gait_metrics(session.trials, params=params, fit_checks=session.qc, model=index)
        recordings = (Recording.of(recording, session.trials[0]).with_measured(measured.trials[0]),)
        visit = Visit(recordings, solution_of(session), session.qc, methods={"Fit": fit.key}, measures=measured)
        save_visit(visit, folder / recording)
        done()


def _method(name: str, stages: Mapping[str, Stage[Any]]) -> tuple[str, Method[Any]]:
    for stage, methods in stages.items():
        if method := methods.registered(name):
            return stage, method
    known = [m.key for methods in stages.values() for m in methods.values()]
    raise PblError(
        "SOLVER_UNKNOWN",
        found=f"{name!r}, neither a folder nor a method",
        expected=f"a folder of visits, or one of {', '.join(known)}",
        next_step="an older version of a method is in an older version of pbl: run the command there with --keep, and "
        "name the folder here",
        key=name,
    )


def folder_values(folder: Path) -> pd.DataFrame:
    """Return the index and the means of the measures of each visit in or below a folder, as `subject` (empty),
    `visit` (its folder), `measure`, `value`.

    Raises `PblError` FILE_MISSING without a `METRICS`, FILE_FORMAT for one that cannot be read.
    """
    rows = []
    for path in sorted(folder.rglob(METRICS)):
        name = path.parent.relative_to(folder).as_posix()
        with file_of_visit(path):
            session = read_json(path)["session"]
            found = {m: session.get(m) for m in (INDEX, *MEASURES)}
            rows += [("", name, m, float(v["mean"])) for m, v in found.items() if v and v.get("mean") is not None]
    if not rows:
        raise PblError(
            "FILE_MISSING",
            found=f"no {METRICS} with measures",
            expected="a folder of visits as `pbl run` or `pbl validate bridge --keep` writes it",
            next_step="name such a folder, or a method",
            key=str(folder),
        )
    return pd.DataFrame(rows, columns=["subject", "visit", "measure", "value"])


def bridge_pairs(old: pd.DataFrame, new: pd.DataFrame) -> pd.DataFrame:
    """Return the values that both have, as columns `old` and `new`, with their difference `shift`."""
    both = old.merge(new, on=["subject", "visit", "measure"], suffixes=("_old", "_new"))
    both = both.rename(columns={"value_old": "old", "value_new": "new"})
    return both.assign(shift=both["new"] - both["old"])


def bridge_table(pairs: pd.DataFrame, names: tuple[str, str]) -> Table:
    """Return the shift of index and measures: mean with its 95 % interval (Student), standard deviation, and the
    largest by size.

    Raises `PblError` STATS_INPUT where fewer than two visits have both.
    """
    cells: dict[tuple[str, str], Cell] = {}
    for measure in (INDEX, *MEASURES):
        values = pairs.loc[pairs["measure"] == measure, "shift"].to_numpy(float)
        if (n := len(values)) < 2:
            continue
        mean, sd = float(values.mean()), float(values.std(ddof=1))
        half = float(stdtrit(n - 1, 0.975)) * sd / np.sqrt(n)
        largest = float(values[np.abs(values).argmax()])
        row = {"mean": mean, "low": mean - half, "high": mean + half, "sd": sd, "largest": largest}
        cells |= {(measure, column): Cell(value, n=n) for column, value in row.items()}
    if not cells:
        raise PblError(
            "STATS_INPUT",
            found=f"{pairs['visit'].nunique()} visits with results by both",
            expected="at least 2",
            next_step="compute the visits by the other method, or name folders of the same recordings",
        )
    return Table(
        "bridge",
        f"Shift of index and measures, {names[1]} minus {names[0]}",
        cells,
        "The same recordings by both. Mean with its 95 % interval (Student's t), standard deviation, largest shift.",
        {m: 1 if m == INDEX or m.endswith(("_percent", "_min")) else 3 for m, _ in cells},
    )


def touched(visits: pd.DataFrame) -> pd.DataFrame:
    """Return the pairs of successive visits of a person that a change of method touches.

    Returns `subject, before, visit, what`: "across" where the one has only a result by the old and the other only one
    by the new, which cannot be compared; "old" where both have only old ones, which compare with each other but not
    with later visits.

    Parameters
    ----------
    visits
        One row per visit with a result by either, in the order of their days: `subject`, `visit`, and whether it has
        one by `old` and by `new`.
    """
    rows = []
    for subject, own in visits.groupby("subject", sort=False):
        records = own.to_dict("records")
        for a, b in itertools.pairwise(records):
            alike = (a["old"] and b["old"], a["new"] and b["new"])
            if not any(alike):
                rows.append((subject, a["visit"], b["visit"], "across"))
            elif not alike[1]:
                rows.append((subject, a["visit"], b["visit"], "old"))
    return pd.DataFrame(rows, columns=["subject", "before", "visit", "what"])
