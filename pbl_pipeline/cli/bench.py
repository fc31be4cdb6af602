"""`pbl bench`: timings and accuracy as a table and as JSON."""

from __future__ import annotations

import dataclasses
import json
from datetime import UTC, datetime
from pathlib import Path

import click


class _Numbers(click.ParamType):
    """Whole numbers with commas between them."""

    name = "N,N"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        try:
            numbers = tuple(dict.fromkeys(int(x) for x in str(value).split(",")))
        except ValueError:
            numbers = ()
        if not numbers or min(numbers) < 1:
            self.fail(f"{value!r} is no list of whole numbers from 1, such as 1,10", param, ctx)
        return numbers


@click.group(epilog="Example: pbl bench fit --quick")
def bench() -> None:
    """Measure how fast, how lean and how accurate the pipeline is on this machine.

    Example: pbl bench fit --quick --json bench.json
    """


@bench.command(epilog="Example: pbl bench fit --solver gauss-newton --trials 1 --motion static --batch 1,64")
@click.option("--quick", is_flag=True, help="About a minute on two cores: few rows, few steps of implicit-adam.")
@click.option(
    "--solver",
    type=click.Choice(["all", "gauss-newton", "implicit-adam"]),
    default="all",
    show_default=True,
    help="--long and --robust take gauss-newton for all: ask for the other one by name.",
)
@click.option("--trials", type=_Numbers(), default="1,10", show_default=True, help="Trials of a session.")
@click.option("--batch", type=_Numbers(), default="1,16,64", show_default=True, help="Sessions at once (gauss-newton).")
@click.option(
    "--motion",
    type=click.Choice(["all", "static", "handheld"]),
    default="all",
    show_default=True,
    help="Of the camera; --long and --robust take static for all.",
)
@click.option(
    "--picture",
    type=click.IntRange(240, 8640),
    default=1080,
    show_default=True,
    help="Shorter side of the picture, px; its noise grows with it.",
)
@click.option("--seeds", type=click.IntRange(1), default=3, show_default=True, help="People; errors are means of them.")
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Warm runs; the best counts.")
@click.option("--adam-steps", type=click.IntRange(1), help="Steps of implicit-adam instead of the paper's 25,000.")
@click.option("--long", "long_", is_flag=True, help="Only: one walk of 5,400 and of 10,800 frames.")
@click.option("--robust", is_flag=True, help="Only: outliers, a marker never seen, a second with nothing seen.")
@click.option("--timeout-s", type=click.FloatRange(1), default=3600.0, show_default=True, help="Of one process.")
@click.option(
    "--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file, after each row."
)
def fit(
    quick: bool,
    solver: str,
    trials: tuple[int, ...],
    batch: tuple[int, ...],
    motion: str,
    picture: int,
    seeds: int,
    repeat: int,
    adam_steps: int | None,
    long_: bool,
    robust: bool,
    timeout_s: float,
    json_path: Path | None,
) -> None:
    """Time the session fit on a synthetic walker whose angles are known, and compare the result with them.

    What is measured, and how, is in docs/benchmarks.md. A case that fails is a row with the code of its error.
    """
    from pbl_pipeline import __version__
    from pbl_pipeline import bench as b
    from pbl_pipeline.files import check_out_file

    if json_path is not None:
        check_out_file(json_path)
    solvers = b.SOLVERS if solver == "all" else (solver,)
    motions = b.MOTIONS if motion == "all" else (motion,)
    cases = []
    if quick:
        cases += b.quick_cases(solvers, adam_steps or 500)
    elif not (long_ or robust):
        cases += b.speed_cases(solvers, trials, motions, batch, seeds, repeat, adam_steps)
    # Where no solver or camera was asked for, the slow solver and the second camera are left out of these.
    few, still = (("gauss-newton",) if solver == "all" else solvers), (("static",) if motion == "all" else motions)
    if long_:
        cases += b.long_cases(few, still, 1, adam_steps)
    if robust:
        cases += b.robust_cases(few, still, 1 if quick else seeds, 1, adam_steps)
    if not cases:
        raise click.UsageError("nothing to run: batches of more than one are fitted by gauss-newton only")

    cases = [dataclasses.replace(c, data=dataclasses.replace(c.data, short_side_px=picture)) for c in cases]
    rows: list[b.Row] = []
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    for row in b.run_cases(cases, timeout_s, note=lambda what: click.echo(what, err=True)):
        rows.append(row)
        if json_path is not None:  # after each row: a run of hours may be interrupted
            content = {"benchmark": "fit", "version": __version__, "time_utc": begun, "rows": rows}
            json_path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    click.echo(b.text(rows))


@bench.command(epilog="Example: pbl bench detect walk.mp4 --minutes 10 --json detect.json")
@click.argument("video", required=False, type=click.Path(path_type=Path, readable=False))
@click.option(
    "--minutes", type=click.FloatRange(0, 600, min_open=True), help="Repeat the video until it lasts so long."
)
@click.option(
    "--person",
    type=click.IntRange(1),
    help="ID of the person; else the subject, or the longest in view.",
)
@click.option("--keypoints", multiple=True, metavar="NAME", help="Keypoint method; repeat it to compare several.")
@click.option("--repeat", type=click.IntRange(1), help="Runs; the fastest counts. Default: 3, with --minutes 1.")
@click.option("--timeout-s", type=click.FloatRange(1), default=7200.0, show_default=True, help="Of the measurement.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file.")
def detect(
    video: Path | None,
    minutes: float | None,
    person: int | None,
    keypoints: tuple[str, ...],
    repeat: int | None,
    timeout_s: float,
    json_path: Path | None,
) -> None:
    """Time decoding, tracking and keypoints of VIDEO; without one, of the demo recording at 1920x1080.

    What is measured, and how, is in docs/benchmarks.md.
    """
    from pbl_pipeline import __version__
    from pbl_pipeline import bench as b
    from pbl_pipeline.files import check_out_file

    if json_path is not None:
        check_out_file(json_path)
    begun = datetime.now(UTC).isoformat(timespec="seconds")
    runs = repeat or (3 if minutes is None else 1)
    rows: list[b.Row] = []
    for row in b.run_detect(video, minutes, person, runs, timeout_s, lambda w: click.echo(w, err=True), keypoints):
        rows.append(row)
        if json_path is not None:
            content = {"benchmark": "detect", "version": __version__, "time_utc": begun, "rows": rows}
            json_path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    click.echo("\n\n".join(b.detect_text(row) for row in rows))
    if any("error" in row for row in rows):
        raise SystemExit(1)
