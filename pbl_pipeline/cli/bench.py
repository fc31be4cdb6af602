"""`pbl bench`: timings and accuracy as a table and as JSON."""

from __future__ import annotations

import json
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path

import click

from pbl_pipeline.bench import METHOD, Row

from .command_line import Commands


class Numbers(click.ParamType):
    """Whole numbers, separated by commas."""

    name = "N,N"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(dict.fromkeys(int(x) for x in str(value).split(",")))
        except ValueError:
            numbers = ()
        if not numbers or min(numbers) < 1:
            self.fail(f"{value!r} is not a list of whole numbers from 1, such as 1,10", param, ctx)
        return numbers


class _BenchCommands(Commands):
    entries = "pbl.bench"


@click.group(cls=_BenchCommands, epilog="Example: pbl bench fit --quick")
def bench() -> None:
    """Measure time, memory and error of the pipeline on this machine.

    Example: pbl bench fit --quick --json bench.json
    """


@bench.command(epilog="Example: pbl bench fit --trials 1 --batch 1,64")
@click.option("--quick", is_flag=True, help="One session of one trial, fitted once warm: a minute on two cores.")
@click.option("--method", default=METHOD, show_default=True, metavar="NAME", help="Fit method, or a JSON file of one.")
@click.option("--trials", type=Numbers(), default="1,10", show_default=True, help="Trials of a session.")
@click.option("--batch", type=Numbers(), default="1,16,64", show_default=True, help="Sessions at once.")
@click.option("--seeds", type=click.IntRange(1), default=3, show_default=True, help="People; errors are means of them.")
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Warm runs; the best counts.")
@click.option("--timeout-s", type=click.FloatRange(1), default=3600.0, show_default=True, help="Of one process.")
@click.option(
    "--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file, after each row."
)
def fit(
    quick: bool,
    method: str,
    trials: tuple[int, ...],
    batch: tuple[int, ...],
    seeds: int,
    repeat: int,
    timeout_s: float,
    json_path: Path | None,
) -> None:
    """Time the session fit on a synthetic walker whose angles are known, and compare the result with them.

    docs/benchmarks.md describes the measurements. A case that fails is a row with the code of its error.
    """
    from pbl_pipeline import bench as b

    cases = b.fit_cases(method, (1,), (1,), 1, 1) if quick else b.fit_cases(method, trials, batch, seeds, repeat)
    rows = keep("fit", b.run_cases(cases, timeout_s, note=lambda what: click.echo(what, err=True)), json_path)
    click.echo(b.fit_text(rows))


@bench.command(epilog="Example: pbl bench detect walk.mp4 --repeat 1 --json detect.json")
@click.argument("video", required=False, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--person",
    type=click.IntRange(1),
    help="ID of the person; else the subject, or the longest in view.",
)
@click.option("--keypoints", multiple=True, metavar="NAME", help="Keypoint method; repeat it to compare several.")
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Runs; the fastest counts.")
@click.option("--timeout-s", type=click.FloatRange(1), default=7200.0, show_default=True, help="Of the measurement.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file.")
def detect(
    video: Path | None,
    person: int | None,
    keypoints: tuple[str, ...],
    repeat: int,
    timeout_s: float,
    json_path: Path | None,
) -> None:
    """Time decoding, tracking and keypoints of VIDEO; without one, of the demo recording at 1920x1080.

    docs/benchmarks.md describes the measurements.
    """
    from pbl_pipeline import bench as b

    found = b.run_detect(video, person, repeat, timeout_s, lambda w: click.echo(w, err=True), keypoints)
    rows = keep("detect", found, json_path)
    click.echo("\n\n".join(b.detect_text(row) for row in rows))
    if any("error" in row for row in rows):
        raise SystemExit(1)


def keep(benchmark: str, rows: Iterable[Row], path: Path | None) -> list[Row]:
    """Collect the rows of a benchmark and write them to `path` after each one: a run of hours may be interrupted.

    Raises `PblError` FILE_UNWRITABLE before the first one is asked for.
    """
    from pbl_pipeline.code_version import code_version
    from pbl_pipeline.files import check_out_file

    if path is not None:
        check_out_file(path)
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    kept: list[Row] = []
    for row in rows:
        kept.append(row)
        if path is not None:
            content = {"benchmark": benchmark, "version": code_version(), "time_utc": begun, "rows": kept}
            path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    return kept
