"""The session fit of both solvers, of a standing and a held phone, and of long walks: tables of research/reports.

    python -m research.benchmarks.fit --quick                # about a minute on two cores; few steps of implicit-adam
    python -m research.benchmarks.fit --json fit.json        # with the paper's 25,000 steps: hours on a CPU, use a GPU
    python -m research.benchmarks.fit --solver gauss-newton --trials 1 --motion static --batch 1,64
    python -m research.benchmarks.fit --long                 # one walk of 5,400 and of 10,800 frames: 3 and 6 minutes

The processes and figures are those of `pbl bench fit`; the people differ and vary (`research.walker`).
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from pathlib import Path

import click

from pbl_pipeline.bench import Case, Programs, Row, run_cases
from pbl_pipeline.bench.run import ERRORS, TIMES, Column, accuracy, meaning, method_name, notes, number, table
from pbl_pipeline.cli.bench import Numbers, keep
from research.benchmarks.fit_data import MOTIONS, WalkerData

#: The method that stands for a solver.
METHOD_OF = {"gauss-newton": "gauss-newton", "implicit-adam": "paper-2025"}
PROGRAMS = Programs("research.benchmarks.fit_data", "research.benchmarks.fit_case")
LONG = (5_400, 10_800)

COLUMNS: list[Column] = [
    ("method", method_name),
    ("trials", lambda r: str(r["data"]["n_trials"])),
    ("frames", lambda r: f"{r['data']['n_frames']:,}"),
    ("camera", lambda r: r["data"]["motion"]),
    ("batch", lambda r: str(r["batch"])),
    *TIMES,
    *ERRORS,
    ("camera deg", lambda r: number(accuracy(r, "camera_deg") if r["data"]["motion"] == "handheld" else None)),
    ("clock ms", lambda r: number(accuracy(r, "clock_ms") if r["data"]["motion"] == "handheld" else None, 1)),
    ("loss", lambda r: number(r.get("paper_loss"))),
]


def speed_cases(
    methods: Sequence[str],
    trials: Sequence[int],
    motions: Sequence[str],
    batches: Sequence[int],
    n_people: int,
    repeat: int,
    short_side_px: int = 1080,
) -> list[Case]:
    """Method x trials x camera x batch; batches of more than one only where a solver has them."""
    return [
        Case(m, WalkerData(n, b if b > 1 else n_people, 300, motion, short_side_px), b, repeat, motion)
        for m in methods
        for n in trials
        for motion in motions
        for b in batches
        if b == 1 or m == METHOD_OF["gauss-newton"]
    ]


def long_cases(methods: Sequence[str], motions: Sequence[str], short_side_px: int = 1080) -> list[Case]:
    """Six minutes of walking and half of it, one trial of one person."""
    return [
        Case(m, WalkerData(1, 1, n, motion, short_side_px), 1, 1, motion)
        for m in methods
        for motion in motions
        for n in LONG
    ]


def shorter(folder: Path, steps: int) -> str:
    """Write the method file of the paper's solver with other steps; return its path."""
    path = folder / f"adam-{steps}.json"
    path.write_text(json.dumps({"stage": "fit", "base": METHOD_OF["implicit-adam"], "steps": steps}), encoding="utf-8")
    return str(path)


def text(rows: Sequence[Row]) -> str:
    """Return the table of the rows, what did not pass, and what the columns mean."""
    parts = [table(rows, COLUMNS), *filter(None, map(notes, rows))]
    return "\n\n".join([*parts, meaning(rows, "loss: the paper's objective.")])


@click.command(epilog="Example: python -m research.benchmarks.fit --solver gauss-newton --batch 1,64")
@click.option("--quick", is_flag=True, help="Few rows, 500 steps of implicit-adam.")
@click.option("--solver", type=click.Choice(["all", *METHOD_OF]), default="all", show_default=True)
@click.option("--trials", type=Numbers(), default="1,10", show_default=True, help="Trials of a session.")
@click.option("--batch", type=Numbers(), default="1,16,64", show_default=True, help="Sessions at once (gauss-newton).")
@click.option("--motion", type=click.Choice(["all", *MOTIONS]), default="all", show_default=True, help="Of the camera.")
@click.option("--picture", type=click.IntRange(240, 8640), default=1080, show_default=True, help="Shorter side, px.")
@click.option("--seeds", type=click.IntRange(1), default=3, show_default=True, help="People; errors are means of them.")
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Warm runs; the best counts.")
@click.option("--adam-steps", type=click.IntRange(1), help="Steps of implicit-adam instead of the paper's 25,000.")
@click.option("--long", "long_", is_flag=True, help="Only one walk of 5,400 and of 10,800 frames.")
@click.option("--timeout-s", type=click.FloatRange(1), default=3600.0, show_default=True, help="Of one process.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write all figures there, after each row.")
def main(
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
    timeout_s: float,
    json_path: Path | None,
) -> None:
    """Time the session fit and compare its result with the truth. A case that fails is a row with its error's code."""
    motions = MOTIONS if motion == "all" else (motion,)
    with tempfile.TemporaryDirectory() as folder:
        steps = adam_steps or (500 if quick else None)
        of = METHOD_OF | ({"implicit-adam": shorter(Path(folder), steps)} if steps else {})
        methods = list(of.values()) if solver == "all" else [of[solver]]
        if long_:  # the slow solver and the second camera only where they are asked for
            few = methods[:1] if solver == "all" else methods
            cases = long_cases(few, MOTIONS[:1] if motion == "all" else motions, picture)
        elif quick:
            cases = speed_cases(methods, (1,), motions, (1,), 1, 1, picture)
        else:
            cases = speed_cases(methods, trials, motions, batch, seeds, repeat, picture)
        if not cases:
            raise click.UsageError("nothing to run: batches of more than one are fitted by gauss-newton only")
        rows = keep("fit", run_cases(cases, timeout_s, lambda what: click.echo(what, err=True), PROGRAMS), json_path)
        click.echo(text(rows))


if __name__ == "__main__":
    main()
