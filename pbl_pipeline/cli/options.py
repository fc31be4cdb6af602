"""Options that several commands share."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline.errors import PblError
from pbl_pipeline.names import whole_number
from pbl_pipeline.texts import LANGUAGES

if TYPE_CHECKING:
    from pbl_pipeline.depth import DepthFile
    from pbl_pipeline.fit import Params, Points
    from pbl_pipeline.keypoints import KeypointParams
    from pbl_pipeline.methods import Method
    from pbl_pipeline.sensors import SensorLog
    from pbl_pipeline.tracking import TrackingParams
    from pbl_pipeline.visit import Visit


#: Motions of the camera, for commands that fit.
CAMERA_MOTIONS = ("static", "handheld")
CAMERA_MOTION_HELP = "Default: handheld if the phone's orientation is known, else static."
HEIGHT = click.option(
    "--height-m", type=float, help="Measured body height, such as 1.72: lengths and speeds are scaled to it."
)
MASS = click.option(
    "--mass-kg", type=float, help="Measured body mass, such as 68.5: forces can then be shown in newtons."
)
IMU = click.option(
    "--imu",
    multiple=True,
    metavar="[SEGMENT=]FILE",
    help="Log of a wearable sensor, such as shank_r=FILE, or a list of sensors (docs/imu.md); of the whole visit; "
    "'none' for no sensors.",
)
DEPTH = click.option(
    "--depth",
    multiple=True,
    metavar="[SCALE=]FILE",
    help="Depth recording of a video (docs/depth.md), once for each, in their order, 'none' for one without; 16-bit "
    "pictures as 0.001=FOLDER, with the metres of one step.",
)
COMPARE = click.option(
    "--compare",
    "earlier",
    metavar="EARLIER",
    type=click.Path(path_type=Path),
    help="Folder (or session.json) of an earlier run of the same person: also states which measures changed.",
)
LANGUAGE = click.option(
    "--language", type=click.Choice(LANGUAGES), default=LANGUAGES[0], show_default=True, help="Of the report."
)

KEYPOINTS = click.option(
    "--keypoints", metavar="NAME", help="Keypoint method, such as blazepose-heavy, or a model of `pbl models list`."
)
DEVICE = click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda"]),
    help="Device of ONNX models (default: PBL_ONNX_DEVICE, else CUDA if it works).",
)
PEOPLE = click.option(
    "--people", metavar="NAME", help="Tracking method, such as blazepose-tiles, or a detector of `pbl models list`."
)


def sensor_logs(given: Sequence[str]) -> tuple[SensorLog, ...]:
    """Read the sensors of `--imu`, and print what was left out of them. Raises the `PblError`s of `read_given`."""
    from pbl_pipeline.sensors import given_sensors, read_given

    logs = read_given([one for text in given if text != "none" for one in given_sensors(text)])
    for log in logs:
        click.echo("; ".join((f"{log.segment}: sensor {log.name}, {log.time[-1] - log.time[0]:.0f} s", *log.notes)))
    return logs


def check_one_each(option: str, given: Sequence[object], n: int, next_step: str) -> None:
    """Raise `PblError` USAGE unless an option is given for none of n videos, or for each."""
    if given and len(given) != n:
        found = f"{len(given)} times {option} for {n} videos"
        raise PblError("USAGE", found, "none, or one for each video, in the same order", next_step)


def depth_files(given: Sequence[str], n: int) -> list[DepthFile | None]:
    """Recordings of `--depth` for each of n videos. Raises `PblError` USAGE: another number of them."""
    from pbl_pipeline.depth import DepthFile

    check_one_each("--depth", given, n, "name a recording for each video, 'none' for one without")
    return [None if text == "none" else DepthFile.of(text) for text in given] or [None] * n


def show_changes(visit: Visit, before: Visit, metrics: Path) -> None:
    """Print the changes of a visit since an earlier one, and add them to its metrics.json (docs/files.md).

    Raises `PblError` USAGE if other methods made it.
    """
    from pbl_pipeline.bounded import read_json
    from pbl_pipeline.change import visit_changes

    rows = visit_changes(visit, before)
    content = {**read_json(metrics), "changes": {"since": before.title, "measures": rows}}
    metrics.write_text(json.dumps(content, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    click.echo(f"changes since {before.title or 'the earlier visit'}")
    cells = [list(rows[0]), *([("" if v is None else str(v)) for v in row.values()] for row in rows)] if rows else []
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    for row in cells:
        click.echo("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())


def tracking_method(name: str | None) -> Method[TrackingParams]:
    """Return the tracking method of `--people`, and print its model's licence before it is used.

    Raises `PblError` SOLVER_UNKNOWN, MODEL_INVALID.
    """
    from pbl_pipeline.models import find, load_spec
    from pbl_pipeline.tracking import METHODS

    method = METHODS.find(name)
    if model := method.params.model:
        click.echo(f"people by the model {model}, licence: {load_spec(find(model)).licence}")
    return method


def keypoint_method(name: str | None, device: str | None) -> Method[KeypointParams]:
    """Return the keypoint method of `--keypoints`, and print its model's licence before it is used; ONNX models of this
    process run on `--device`.

    Raises `PblError` SOLVER_UNKNOWN, MODEL_INVALID, MARKER_SET_UNKNOWN, DEVICE_UNAVAILABLE.
    """
    from pbl_pipeline.keypoints import METHODS, ModelKeypointParams

    if device is not None:
        from pbl_pipeline.models import providers_for

        providers_for(device)
        os.environ["PBL_ONNX_DEVICE"] = device
    method = METHODS.find(name)
    if isinstance(method.params, ModelKeypointParams):
        model = method.params.model
        click.echo(f"keypoints by the model {model.name}, licence: {model.licence}")
    return method


class Person(click.ParamType):
    """`auto` (None) or the number of a person."""

    name = "auto|N"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int | None:
        if value is None or value == "auto" or isinstance(value, int):
            return value if isinstance(value, int) else None
        if (number := whole_number(str(value))) is not None:
            return number
        return self.fail(f"{value!r} is neither 'auto' nor the number of a person", param, ctx)


def fit_paramset(solver: str | None, params: str | None, points: Sequence[Points] = ()) -> Method[Params]:
    """Return the fit's method of `--solver` and `--params`; `points`: of the trials, for the default.

    `--params` is a name, or a JSON file of changes to the method in its key "base". Without either, and without "base",
    it is the default method; with `--solver` alone the default one of that solver.

    Raises `PblError` SOLVER_UNKNOWN (also for a method of another solver than `--solver`), FILE_MISSING, FILE_FORMAT.
    """
    from pbl_pipeline.fit import METHODS, default_fit
    from pbl_pipeline.method_file import named_or_file

    if solver is not None and solver not in METHODS.families:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"solver {solver!r}",
            expected=f"one of {', '.join(METHODS.families)}",
            next_step="pass one of these",
        )
    base = default_fit(*points, solver=solver)
    method = named_or_file(METHODS, params or base, base)
    if solver not in (None, method.family.name):
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"solver {solver} with paramset {method.name}",
            expected=f"{method.family.name}, the solver of {method.name}",
            next_step="leave out --solver, or name a paramset of that solver",
        )
    return method
