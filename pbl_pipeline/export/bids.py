"""Motion-BIDS: the trials of a visit as files of a data set of the Brain Imaging Data Structure (Jeung et al. 2024,
Scientific Data 11:716), which `bids-validator` accepts."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from pbl_pipeline.body import SLIDES, angle_of
from pbl_pipeline.bounded import read_text
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit.angles_file import angles_table
from pbl_pipeline.sampling import interval_of

from .columns import lines, number_cells
from .trial import ExportTrial
from .visit_tables import joint_sign

#: Version of the standard that the files follow.
BIDS_VERSION = "1.10.0"
#: Label of the tracking system in names of files.
TRACKSYS = "video"
_PARTICIPANTS = "participants.tsv"
_AXES = {"tx": "x", "ty": "y", "tz": "z"}


class Labels(NamedTuple):
    """Labels of a visit in names of files, letters and digits; `visit` is "" for a person's only visit."""

    participant: str = "01"
    visit: str = ""

    @classmethod
    def of(cls, participant: str, visit: str) -> Labels:
        """Return the labels of codes, without characters that labels cannot have."""
        return cls(*("".join(c for c in text if c.isascii() and c.isalnum()) for text in (participant, visit)))

    @property
    def folder(self) -> str:
        """Folder of the visit in the data set."""
        return f"sub-{self.participant}" + (f"/ses-{self.visit}" if self.visit else "")


class _Channel(NamedTuple):
    name: str
    component: str
    kind: str
    tracked_point: str
    units: str
    frame: str
    description: str
    values: np.ndarray


def bids_files(
    trials: Sequence[ExportTrial], origins: Mapping[str, Mapping[str, str]], labels: Labels, root: Path
) -> dict[str, bytes]:
    """Return the content of each file by its path in the data set.

    Raises `PblError` EXPORT_INPUT if no participant can be added to the participants.tsv of the data set.

    Parameters
    ----------
    origins
        Name of a trial -> its origin (`provenance.origin_of`).
    root
        Folder of the data set. An existing README, description and list of participants are kept.
    """
    out = {name: data for name, data in _of_data_set().items() if not os.path.lexists(root / name)}
    out[_PARTICIPANTS] = _with_participant(root / _PARTICIPANTS, f"sub-{labels.participant}")
    tasks = [_task(t) for t in trials]
    for i, (trial, task) in enumerate(zip(trials, tasks, strict=True)):
        entities = [*labels.folder.split("/"), f"task-{task}"]
        run = [f"run-{tasks[: i + 1].count(task)}"] if tasks.count(task) > 1 else []
        stem = f"{labels.folder}/motion/{'_'.join([*entities, f'tracksys-{TRACKSYS}', *run])}"
        channels = _channels(trial)
        values = np.column_stack([c.values for c in channels])
        cells = number_cells(values, 6)
        cells[~np.isfinite(values), :3] = np.frombuffer(b"n/a", np.uint8)
        out[f"{stem}_motion.tsv"] = lines([cells], "\t")
        out[f"{stem}_motion.json"] = _json(_about(trial, task, channels, origins[trial.name]))
        out[f"{stem}_channels.tsv"] = _tsv(
            ("name", "component", "type", "tracked_point", "units", "reference_frame", "description"),
            [c[:-1] for c in channels],
        )
        out[f"{stem}_channels.json"] = _json({"reference_frame": {"Levels": _frames(trial)}})
        if trial.measured is not None:
            events = f"{labels.folder}/motion/{'_'.join([*entities, *run])}_events"
            out[f"{events}.tsv"] = _events(trial)
            out[f"{events}.json"] = _json(_EVENTS)
    return out


def _with_participant(path: Path, participant: str) -> bytes:
    """Return the table of participants with a row for one of them, and its existing rows and columns."""
    if path.is_symlink():
        raise _no_table(path, "a link")
    try:
        lines = read_text(path).splitlines() if path.exists() else ["participant_id"]
    except (OSError, ValueError) as error:
        raise _no_table(path, str(error)) from error
    header, *rows = [line.split("\t") for line in lines if line.strip()] or [[""]]
    if header[0] != "participant_id":
        raise _no_table(path, f"a first column {header[0][:80]!r}")
    if participant not in (row[0] for row in rows):
        rows = sorted([*rows, [participant, *["n/a"] * (len(header) - 1)]])
    return _tsv(header, rows)


def _no_table(path: Path, found: str) -> PblError:
    return PblError(
        "EXPORT_INPUT",
        found=found,
        expected="a file, a table in UTF-8 with tabs between its columns, the first of them participant_id",
        next_step="correct the table, or pass another --out",
        key=str(path),
    )


def check_labels(root: Path, labels: Labels, overwrite: bool) -> None:
    """Raise `PblError` EXPORT_INPUT for a visit without a label, or whose folder already exists in the data set."""
    found = ""
    if not labels.participant:
        found = "a code without a letter or digit"
    elif not overwrite and (root / labels.folder).exists():
        found = f"two visits that are both {labels.folder} without their other characters"
    if found:
        raise PblError(
            "EXPORT_INPUT",
            found=found,
            expected="codes and labels of visits that differ in letters and digits of ASCII",
            next_step="export this visit apart from the other, with another --name",
            key=labels.folder,
        )


def _of_data_set() -> dict[str, bytes]:
    software = {"Name": "pbl-pipeline", "Version": code_version()}
    about: dict[str, Any] = {"Name": "Movement fitted to video", "BIDSVersion": BIDS_VERSION, "DatasetType": "raw"}
    about["GeneratedBy"] = [software]
    readme = (
        "Joint angles and marker positions of a body model that was fitted to videos by pbl-pipeline.\n"
        "Each angle has a channel with its standard deviation. Signs and axes: docs/export.md of pbl-pipeline.\n"
    )
    return {"dataset_description.json": _json(about), "README.md": readme.encode()}


def _task(trial: ExportTrial) -> str:
    return "".join(c for c in trial.activity if c.isascii() and c.isalnum()) or "unknown"


def _channels(trial: ExportTrial) -> list[_Channel]:
    """Time, each joint value with its standard deviation, and the markers; frames without a pose are NaN."""
    fit = trial.fit
    out = [_Channel("time", "n/a", "LATENCY", "n/a", "s", "n/a", "from the first frame", np.asarray(fit.time_s, float))]
    table, sd = angles_table(fit), np.asarray(fit.qpos_sd, float)
    column = {angle: i for i, f in enumerate(fit.joint_names) for angle in (f, angle_of(f)[0])}
    for name in table.columns[1:]:
        slide = name in SLIDES
        unit, scale = ("m", 1.0) if slide else ("deg", 180.0 / np.pi)
        component = _AXES[name[-2:]] if slide else "n/a"
        frame = "opensim" if slide else "n/a"
        values = np.where(trial.known, table[name].to_numpy(float), np.nan)
        about = f"positive: {joint_sign(name)}"
        out.append(_Channel(name, component, "POS" if slide else "JNTANG", name, unit, frame, about, values))
        spread = np.where(trial.known, scale * sd[:, column[name]], np.nan)
        about = f"standard deviation of {name}"
        out.append(_Channel(f"{name}_sd", component, "MISC", name, unit, frame, about, spread))
    for i, name in enumerate(fit.marker_names):
        point = "_".join(name.split())
        for j, axis in enumerate("xyz"):
            values = np.asarray(fit.markers_world_m, float)[:, i, j]
            out.append(_Channel(f"{point}_{axis}", axis, "POS", point, "m", "world", "fitted marker", values))
    return out


def _frames(trial: ExportTrial) -> dict[str, Any]:
    """Frames of reference. The heading is that of the camera at the start, or of the laboratory, not of the person."""
    shared = {"RotationRule": "right-hand", "RotationOrder": "n/a"}
    return {
        "world": {**shared, "SpatialAxes": "__U", "Description": f"z up; vertical {trial.fit.orientation_source}"},
        "opensim": {**shared, "SpatialAxes": "_U_", "Description": "(x, z, -y) of the world; from the body's rest"},
    }


def _about(trial: ExportTrial, task: str, channels: Sequence[_Channel], origin: Mapping[str, str]) -> dict[str, Any]:
    step = np.diff(np.asarray(trial.fit.time_s, float))
    kinds = [c.kind for c in channels]
    counts = {f"{k}ChannelCount": kinds.count(k) for k in ("POS", "JNTANG", "LATENCY", "MISC")}
    return {
        "TaskName": task,
        "SamplingFrequency": round(1.0 / interval_of(trial.fit.time_s), 6),
        "SamplingFrequencyEffective": round(float(1.0 / np.mean(step)), 6),
        "TrackingSystemName": TRACKSYS,
        "SoftwareVersions": origin["software"],
        "MissingValues": "n/a",
        "MotionChannelCount": len(channels),
        "TrackedPointsCount": len({c.tracked_point for c in channels} - {"n/a"}),
        **counts,
        "Origin": dict(origin),
    }


_EVENTS = {
    "trial_type": {
        "Description": "gait event",
        "Levels": {
            f"{side}_{kind}": f"{words} of the {side} foot"
            for side in ("left", "right")
            for kind, words in (("foot_down", "initial contact"), ("foot_up", "toe-off"))
        },
    },
    "probability": {"Description": "that the event is real, 0 to 1"},
}


def _events(trial: ExportTrial) -> bytes:
    assert trial.measured is not None
    rows = [
        (f"{e.time_s:.6f}", "0", f"{e.side}_{e.event}", f"{e.probability:.4f}")
        for e in sorted(trial.measured.events.events, key=lambda e: e.time_s)
    ]
    return _tsv(("onset", "duration", "trial_type", "probability"), rows)


def _tsv(header: Sequence[str], rows: Sequence[Sequence[str]]) -> bytes:
    return "".join("\t".join(row) + "\n" for row in (header, *rows)).encode()


def _json(content: Mapping[str, Any]) -> bytes:
    return (json.dumps(content, indent=2) + "\n").encode()
