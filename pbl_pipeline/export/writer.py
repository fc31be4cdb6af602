"""Writes a visit in the formats of other programs: all that can be wrong is found before the first file."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import json
import os
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.body import Body, load_body
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.extras import needed
from pbl_pipeline.files import check_no_link, check_out_folder, complete_file, one_process
from pbl_pipeline.fit import METHODS, TrialFit
from pbl_pipeline.gait import EVENT_METHODS, GDI_METHODS, TrialMetrics
from pbl_pipeline.methods import Stage
from pbl_pipeline.names import check_label
from pbl_pipeline.qc import Check, failed
from pbl_pipeline.visit import Visit

from .bids import Labels, bids_files, check_labels
from .c3d import check_c3d, write_c3d
from .columns import dictionary, write_csv, write_parquet
from .ground import check_forces, on_floor, taken_off, write_forces, write_mot
from .keypoints_csv import write_keypoints_csv
from .osim import write_osim, write_trc
from .plug_in_gait import NAMES
from .trial import ExportTrial, wanted_markers, with_body_points
from .visit_tables import session_tables

_input = functools.partial(PblError, "EXPORT_INPUT")


def origin_of(trial: ExportTrial, body: Body) -> dict[str, str]:
    """Name to text, plain ASCII without line ends: how the trial was computed, for headers and `export.json`."""
    fit, source = trial.fit, trial.methods
    lines = {
        "software": f"pbl-pipeline {code_version()}",
        "model": f"{body.name} version {body.version} (sha256 {fit.body_sha256[:12]})",
        "marker_set": fit.marker_set,
        "fit_method": source.get("Fit") or fit_method(fit),
        "fit_parameters": fit.params_hash,
        "vertical": fit.orientation_source,
    }
    if trial.measured is not None:
        events = trial.measured.events
        by_hand = ", corrected by hand" if events.corrected else ""
        lines["event_method"] = _named(EVENT_METHODS, events.method, events.params_hash) + by_hand
        gdi = trial.measured.gdi
        lines["index_method"] = f"{_named(GDI_METHODS, gdi.model, gdi.params_hash)}, norm {gdi.norm}"
    if trial.keypoints is not None and trial.keypoints.origin:
        lines["keypoints_by"] = trial.keypoints.origin
    for stage in ("Tracking", "Keypoints"):
        if stage in source:
            lines[f"{stage.lower()}_method"] = source[stage]
    if trial.fitted_with:
        lines["fitted_with"] = trial.fitted_with
    return {k: one_line(v) for k, v in lines.items()}


def fit_method(fit: TrialFit) -> str:
    """Solver and paramset of a fit, the paramset by its name if this version has it."""
    named = next((m.key for m in METHODS.values() if m.hash == fit.params_hash), "")
    return f"{fit.solver}, {named}" if named else f"{fit.solver}, parameters {fit.params_hash}"


def _named(stage: Stage[Any], name: str, sha: str) -> str:
    """Return a method by its key if this version has it, else by its name and hash."""
    return next((m.key for m in stage.values() if m.hash == sha), f"{name} ({sha})")


def one_line(text: str) -> str:
    """Convert a text to one line of ASCII for a header."""
    return " ".join(text.encode("ascii", "replace").decode().split())


def summary(trial: ExportTrial) -> Mapping[str, object]:
    """Numbers of the trial's frames, for `export.json`."""
    time = np.asarray(trial.fit.time_s, float)
    return {"frames": len(time), "frames_with_a_pose": int(trial.known.sum()), "seconds": float(time[-1] - time[0])}


#: Format -> ending of the file of one trial, "" for those of the visit.
FORMATS: Mapping[str, str] = {
    "trc": ".trc",
    "mot": ".mot",
    "forces": ".forces.mot",
    "osim": ".osim",
    "c3d": ".c3d",
    "dlc": ".dlc.csv",
    "csv": "",
    "parquet": "",
    "bids": "",
}
#: Formats that need events, cycles and measures.
GAIT_FORMATS = frozenset({"forces", "c3d", "csv", "parquet", "bids"})
#: Formats of programs of gait laboratories: heights count from the floor; names are ASCII, in some programs also paths.
_OF_LABORATORIES = ("trc", "mot", "forces", "osim", "c3d")
#: Characters that OpenSim refuses in the name of a component.
_NOT_IN_OPENSIM = frozenset(" \t/\\*+")
_LONGEST_NAME = 64


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """Options of an export."""

    name: str = ""  # in headers (C3D's subject, titles); "": nothing that identifies a person
    number_trials: bool = False  # name the trials trial_1, trial_2, ... instead of by their recordings
    body_points: bool = True  # three further markers on every body in `.trc` and `.osim`
    allow_failed: bool = False  # also export a fit with a failed check
    overwrite: bool = False  # write into a folder with files
    names: str = ""  # of the points of a C3D: "plug-in-gait" for that model's; "": the fitted markers
    #: Folder of the data set and labels of the visit for `bids`; None: one of the visit alone, in the folder `bids`.
    bids: tuple[Path, Labels] | None = None


def check_export(formats: Sequence[str], out: Path, options: ExportOptions) -> None:
    """Check the formats, their packages, the folder and the name before anything is read.

    Raises `PblError` USAGE, PACKAGE_MISSING, FILE_UNWRITABLE.
    """
    if unknown := [f for f in formats if f not in FORMATS] or ([] if formats else ["nothing"]):
        raise PblError(
            "USAGE",
            found=f"--to {', '.join(unknown)}",
            expected=f"one or several of {', '.join(FORMATS)}",
            next_step="pass --to once for each format",
        )
    if options.names and (options.names != NAMES or "c3d" not in formats):
        raise PblError(
            "USAGE",
            found=f"--names {options.names} with --to {', '.join(formats)}",
            expected=f"--names {NAMES} with --to c3d",
            next_step="add --to c3d, or leave out --names: the other formats have the fitted markers",
        )
    check_label("--name", options.name, _LONGEST_NAME)
    if not options.name.isascii():
        raise PblError(
            "USAGE",
            found=f"--name {options.name!r}",
            expected="letters of ASCII: the headers of TRC, MOT and C3D hold no others",
            next_step="spell the name without accents, or use a code",
        )
    if "c3d" in formats:
        needed("ezc3d", "writing C3D files")
    if "parquet" in formats:
        needed("pyarrow", "writing Parquet files")
    check_out_folder(out)
    if not options.overwrite and out.is_dir() and any(out.iterdir()):
        raise PblError(
            "FILE_UNWRITABLE",
            found="a folder that has files in it",
            expected="a new or empty folder",
            next_step="pass another --out, or --overwrite to replace the files of an earlier export",
            key=str(out),
        )


def write_export(visit: Visit, formats: Sequence[str], out: Path, options: ExportOptions | None = None) -> list[Path]:
    """Write the fitted recordings of a visit and return the paths, `export.json` last.

    `<recording>/<recording>.trc` and so on for each; the tables with their data dictionary and `export.json` in `out`.

    Raises `PblError` USAGE, PACKAGE_MISSING, FILE_UNWRITABLE (`check_export`, or a folder is a link); EXPORT_INPUT: a
    fit that failed, without one pose, of another body, measures whose events or cycles are missing, or names that a
    format cannot hold; MARKER_SET_UNKNOWN: the body lacks the fit's markers. Nothing is written then.
    """
    options = options or ExportOptions()
    formats = [f for f in FORMATS if f in formats] + [f for f in formats if f not in FORMATS]
    check_export(formats, out, options)
    trials = tuple(ExportTrial.of(r, visit) for r in visit.fitted)
    if options.number_trials:
        trials = tuple(dataclasses.replace(t, name=f"trial_{i}") for i, t in enumerate(trials, 1))
    _check_visit(trials, visit.fit_checks, formats, options)
    root, labels = options.bids or (out / "bids", Labels.of(options.name or "01", ""))
    if "bids" in formats:
        check_labels(root, labels, options.overwrite)
        check_no_link(root.parent, root / labels.folder / "motion")
    for trial in trials:
        check_no_link(out, out / trial.name)
    body, paths, about, grounds, origins = load_body(), [], {}, {}, {}
    for trial in trials:
        origin = origin_of(trial, body)
        if bad := failed(visit.fit_checks):
            origin["failed_checks"] = ", ".join(bad)
        origins[trial.name] = origin
        about[trial.name] = {**origin, **summary(trial)}
        folder = out / trial.name
        standing, headers = trial, origin
        if set(_OF_LABORATORIES) & set(formats):
            standing, ground = on_floor(trial)
            headers = {**origin, "ground": one_line(ground)}
            grounds[trial.name] = {"ground": ground}
        for ending, write in _writers(standing, formats, headers, options, taken_off(trial, standing)).items():
            folder.mkdir(parents=True, exist_ok=True)
            paths.append(_written(folder / f"{trial.name}{ending}", write))
    out.mkdir(parents=True, exist_ok=True)
    paths += _write_tables(trials, visit, formats, out, _common(about))
    if "bids" in formats:
        root.mkdir(parents=True, exist_ok=True)
        with one_process(root / ".participants.lock"):  # another export may add a participant
            for name, data in bids_files(trials, origins, labels, root).items():
                path = root / name
                path.parent.mkdir(parents=True, exist_ok=True)
                paths.append(_written(path, lambda part, data=data: part.write_bytes(data)))
    content = {
        "software": f"pbl-pipeline {code_version()}",
        "exported": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "formats": list(formats),
        "axes_and_units": "docs/export.md",
        "trials": {name: {**of_trial, **grounds.get(name, {})} for name, of_trial in about.items()},
        "files": sorted(Path(os.path.relpath(p, out)).as_posix() for p in paths),
    }
    text = json.dumps(content, indent=2, allow_nan=False) + "\n"
    return [*paths, _written(out / "export.json", lambda path: path.write_text(text, encoding="utf-8"))]


def _writers(
    trial: ExportTrial,
    formats: Sequence[str],
    origin: Mapping[str, str],
    options: ExportOptions,
    floor: np.ndarray,
) -> dict[str, Callable[[Path], object]]:
    """Ending of each file of one trial -> its writer; `floor` (T,): heights subtracted from the trial's."""
    name = options.name
    full = with_body_points(trial) if options.body_points and {"trc", "osim"} & set(formats) else trial
    every: dict[str, Callable[[Path], object]] = {
        "trc": lambda path: write_trc(full, path, name or "markers"),
        "mot": lambda path: write_mot(trial, path, origin, name or "coordinates"),
        "forces": lambda path: write_forces(trial, path, origin, name or "forces", floor),
        "osim": lambda path: write_osim(full, path, origin, name or "pbl_body"),
        "c3d": lambda path: write_c3d(trial, path, origin, name, options.names),
        "dlc": lambda path: write_keypoints_csv(trial, path),
    }
    return {FORMATS[f]: every[f] for f in formats if f in every}


def _write_tables(
    trials: Sequence[ExportTrial],
    visit: Visit,
    formats: Sequence[str],
    out: Path,
    about: Mapping[str, str],
) -> list[Path]:
    if not {"csv", "parquet"} & set(formats):
        return []
    tables, paths = session_tables(trials, visit.measures, visit.kinetics), []
    for table in tables:
        if "csv" in formats:
            paths.append(_written(out / f"{table.name}.csv", functools.partial(write_csv, table)))
        if "parquet" in formats:
            paths.append(_written(out / f"{table.name}.parquet", functools.partial(write_parquet, table, about=about)))
    return [*paths, _written(out / "data_dictionary.csv", functools.partial(write_csv, dictionary(tables)))]


def _written(path: Path, write: Callable[[Path], object]) -> Path:
    """Write a file that appears under its name when it is complete."""
    try:
        with complete_file(path) as part:
            write(part)
    except PblError as error:
        raise error.about(path.name) from error.__cause__
    return path


def _common(about: Mapping[str, Mapping[str, object]]) -> dict[str, str]:
    """Facts that all trials have in common, for the metadata of the tables."""
    first, *others = [{k: v for k, v in a.items() if isinstance(v, str)} for a in about.values()]
    return {k: v for k, v in first.items() if all(o.get(k) == v for o in others)}


# -------------------------------------------------------------------------------------------------------------- checks
def _check_visit(
    trials: Sequence[ExportTrial], fit_checks: Sequence[Check], formats: Sequence[str], options: ExportOptions
) -> None:
    if not trials:
        raise _input("no trial", "at least one fit", "pass the fit.npz files of a visit")
    if (checks := failed(fit_checks)) and not options.allow_failed:
        raise _input(
            f"a fit that failed its check {', '.join(checks)}: the body does not lie on the person",
            "a fit without a failed check",
            "look at the overlay and fit again, or pass --allow-failed: the files then name the failed checks",
            trials[0].name,
        )
    for trial in trials:
        try:
            _check_trial(trial, formats, options)
        except PblError as error:
            raise error.about(trial.name) from error.__cause__


def _check_trial(trial: ExportTrial, formats: Sequence[str], options: ExportOptions) -> None:
    fit, body = trial.fit, load_body()
    check_label("the name of a trial", trial.name, 255, least=1)
    if trial.name in (".", "..") or "/" in trial.name or "\\" in trial.name:
        raise _input("a name that is a path", "a name of a file", "rename the file, or pass --number-trials")
    if tuple(fit.joint_names) != body.joint_names or fit.body_sha256 != body.sha256:
        raise _input(
            f"a fit of the body {fit.body_sha256[:12]}",
            f"a fit of this version's body, {body.name} version {body.version} ({body.sha256[:12]})",
            "fit again with this version, or export with the version that made the fit",
        )
    if not np.isfinite(fit.time_s).all() or np.any(np.diff(fit.time_s) <= 0):
        raise _input("time stamps that are missing or do not increase", "frames in order of time", "fit again")
    if not trial.known.any():
        raise _input("a fit without one pose", "a person in at least some frames", "look at the keypoints; fit again")
    if {"trc", "c3d"} & set(formats) and not np.isfinite(fit.markers_world_m).any():
        raise _input("a fit without one marker", "fitted markers in at least some frames", "fit again with pbl fit")
    if "osim" in formats or ("trc" in formats and options.body_points):
        wanted_markers(trial)
    if "forces" in formats:
        check_forces(trial)
    if "c3d" in formats:
        check_c3d(trial, options.name, options.names)
    if GAIT_FORMATS & set(formats) and trial.measured is not None:
        _check_gait(trial.measured, formats)
    if ascii_only := [f for f in formats if f in _OF_LABORATORIES]:
        _check_names(trial, ascii_only)
    if "dlc" in formats and trial.keypoints is None:
        raise _input(
            "a fit without its keypoints",
            "the keypoints.npz of the trial beside the fit, named alike and with the same frames",
            "put the keypoints of `pbl detect` or `pbl run` beside the fit, or leave out --to dlc",
        )


def _check_gait(measured: TrialMetrics, formats: Sequence[str]) -> None:
    """Refuse measures whose events, or for tables whose cycles, are missing: the export would look complete."""
    n_cycles = measured.spatiotemporal.n_cycles_found
    cycles_whole = len(measured.cycles) == n_cycles and all(c.curves or c.curves_missing for c in measured.cycles)
    if n_cycles and not measured.events.events:
        missing = "gait events"
    elif not cycles_whole and {"csv", "parquet"} & set(formats):
        missing = "gait cycles"
    else:
        return
    raise _input(
        f"gait measures without the {missing} that they are made of, as in files of an older version",
        "metrics.json of this version, and beside each fit its events.csv and cycles.npz",
        "run `pbl gait *.fit.npz --out metrics.json` in their folder, with --norm, --index and --method as before, and "
        "export again",
    )


def _check_names(trial: ExportTrial, formats: Sequence[str]) -> None:
    if not trial.name.isascii():
        raise _input(
            f"the name {trial.name!r}",
            f"ASCII in the names of {', '.join(formats)} files: several of their readers open no others",
            "rename the files, or pass --number-trials; csv, parquet and dlc take any name",
        )
    odd = [n for n in trial.fit.marker_names if not n.isascii() or _NOT_IN_OPENSIM & set(n)]
    if odd:
        raise _input(
            f"the markers {', '.join(map(repr, odd[:5]))}",
            f"names of ASCII letters without spaces, / \\ * + in {', '.join(formats)}",
            "rename the markers in the table and fit again; csv, parquet and dlc take any name",
        )
