"""`pbl gait`: all gait measures of a session."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline.errors import PblError

if TYPE_CHECKING:
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.gait import LabTrial
    from pbl_pipeline.qc import Check

METHOD_HELP = "Event method, such as phase-transformer, zeni-2008 or oconnor-2007."
_EPILOG = """\b
Example: pbl gait out/walk1.fit.npz out/walk2.fit.npz --out out/metrics.json
Example: pbl gait lab/walk1.c3d lab/walk2.c3d --out lab/metrics.json"""


@click.command(epilog=_EPILOG)
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path, readable=False))
@click.option("--out", type=click.Path(path_type=Path), required=True, help="metrics.json to write.")
@click.option(
    "--index",
    help="pbl-2025-three-angles (default of fits) or gillette-2008 (nine angles; default of C3D files).",
)
@click.option("--norm", help="Normative set of the index: a name, or a .json file (`pbl norm list`).")
@click.option("--method", default="phase-transformer", show_default=True, help=METHOD_HELP)
@click.option(
    "--events",
    "event_files",
    multiple=True,
    type=click.Path(path_type=Path),
    help="events.csv of `pbl events` for C3D files, once for each in their order (default: the labels in the file, "
    "else by --method).",
)
def gait(
    files: tuple[Path, ...],
    out: Path,
    index: str | None,
    norm: str | None,
    method: str,
    event_files: tuple[Path, ...],
) -> None:
    """Events, cycles, spatiotemporal measures and GDI of one session.

    FILES are fits (fit.npz of `pbl fit`), or a laboratory's recordings (C3D with the nine angles of Plug-in Gait).
    Measures that cannot be trusted are null with a reason. Whether a fit lies on the person stands in the session.json
    that `pbl fit` wrote beside it: without that it is not known.
    """
    from pbl_pipeline import progress
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.gait import EVENT_METHODS, GDI_METHODS, GILLETTE_MODEL, GaitParams, gait_metrics

    check_out_file(out)
    laboratory = [is_c3d(path) for path in files]
    if any(laboratory) and not all(laboratory):
        raise _usage("fits and C3D files together", "one kind of file in a session")
    if event_files and (not all(laboratory) or len(event_files) != len(files)):
        raise _usage(f"{len(event_files)} --events for {len(files)} files", "C3D files, and one --events for each")
    if index is None:
        index = GILLETTE_MODEL if all(laboratory) else None
    params = GaitParams(events=EVENT_METHODS.find(method).paramset, gdi=GDI_METHODS.find(index).params)
    given = event_files or (None,) * len(files)
    pairs = progress.track(list(zip(files, given, strict=True)), "read files", unit="trial")
    trials = [_read(path, events, method) for path, events in pairs]
    of_fit = () if all(laboratory) else fit_checks(files, trials)
    metrics = gait_metrics(trials, norm, params, of_fit, model=index).with_checks(of_fit)
    metrics.save(out)
    click.echo(metrics.table())
    click.echo(f"written: {out}")


def is_c3d(path: Path) -> bool:
    """Whether a file is a laboratory's recording, by its name; it may be gzipped."""
    return path.name.lower().removesuffix(".gz").endswith(".c3d")


def _read(path: Path, events: Path | None, method: str) -> TrialFit | LabTrial:
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.gait import read_lab_trial

    return read_lab_trial(path, events, method) if is_c3d(path) else TrialFit.load(path)


def fit_checks(paths: Sequence[Path], trials: Sequence[TrialFit | LabTrial]) -> tuple[Check, ...]:
    """Checks of the fits from the `session.json` beside each, each once; a WARN where one of them has none.

    A file counts where it names the trial and has the paramset of its fit. Raises `PblError` FILE_FORMAT for one that
    `pbl fit` did not write.
    """
    from pbl_pipeline.bounded import read_json
    from pbl_pipeline.paramset import structured
    from pbl_pipeline.qc import WARN, Check

    found: dict[Path, tuple[list[str], str, list[Check]]] = {}
    for path in {p.parent / "session.json" for p in paths}:
        if not path.is_file():
            continue
        try:
            content = read_json(path)
            names, params_hash = list(content["trials"]), str(content["params_hash"])
            checks = [structured(c, Check) for c in content["qc"]]
            if not all(v is None or math.isfinite(v) for c in checks for v in (c.value, c.threshold)):
                raise ValueError("a check whose value is not finite")
            found[path] = names, params_hash, checks
        except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
            raise PblError(
                "FILE_FORMAT",
                found=f"{type(error).__name__}: {error}",
                expected="the session.json that `pbl fit` wrote with the fits beside it",
                next_step="fit again, or move the file away: then the checks of the fit are not known",
                key=str(path),
            ) from error
    checks, unknown = [], []
    for path, trial in zip(paths, trials, strict=True):
        names, params_hash, own = found.get(path.parent / "session.json", ((), "", ()))
        if trial.name in names and getattr(trial, "params_hash", None) == params_hash:
            checks += own
        else:
            unknown.append(trial.name)
    if unknown:
        advice = (
            f"no session.json of {', '.join(unknown)} lies beside the fit: whether the body lies on the person is not "
            "known; look at what `pbl fit` printed"
        )
        checks.append(Check("fit_checks_known", WARN, float(len(unknown)), 0.0, advice))
    return tuple(dict.fromkeys(checks))


def _usage(found: str, expected: str) -> PblError:
    return PblError("USAGE", found=found, expected=expected, next_step="see `pbl gait --help`")
