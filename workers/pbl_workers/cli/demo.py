"""`pbl demo`: the demo recording through the whole chain, in the embedded database."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import click

from pbl_pipeline.cli.command_line import EXIT_INTERRUPTED
from pbl_pipeline.cli.options import LANGUAGE
from pbl_pipeline.errors import PblError

SUBJECT, SESSION, PROJECT = "DEMO", "sports2d-demo", "demo"


@click.command(epilog="Example: pbl demo --out pbl_demo")
@click.option("--out", type=click.Path(path_type=Path), default=Path("pbl_demo"), show_default=True)
@click.option("--visits", is_flag=True, help="Three drawn persons with two visits each, to look at the pages with.")
@click.option("--no-database", is_flag=True, help="On files alone, as `pbl run` does; needs no database server.")
@LANGUAGE
@click.pass_context
def demo(context: click.Context, out: Path, visits: bool, no_database: bool, language: str) -> None:
    """Set up what the default needs, put the demo recording through every table, show the rows and write the report.

    Safe to repeat: existing results are not computed again. The database is stopped at the end if it was not
    running before; the next command that needs it starts it again. With --visits synthetic markers (no film, no real
    person) go through the tables instead, for the lists, comparison, trend, letter, study and forces of `pbl web`.
    """
    if no_database and visits:
        raise PblError(
            "USAGE",
            found="--visits with --no-database",
            expected="one of them: the drawn visits are rows of the database",
            next_step="leave one out",
        )
    if no_database:
        from pbl_pipeline.cli.run import run

        files = _fetched()
        video, lens = files["demo_video"], files["demo_camera"]
        context.invoke(run, videos=(video,), camera=lens, out=out, subject=SUBJECT, language=language)
        return
    if os.environ.get("DJ_HOST"):
        raise PblError(
            "USAGE",
            found=f"DJ_HOST={os.environ['DJ_HOST']}",
            expected="no DJ_HOST: the demo works in the embedded database and leaves a lab's server alone",
            next_step="unset DJ_HOST, or use `pbl ingest` and `pbl populate` on your server",
        )
    from pbl_pipeline.files import check_out_folder
    from pbl_schemas.operations import embedded

    check_out_folder(out)
    begin = time.monotonic()
    _step(1, "database server" if visits else "models and the demo recording")
    embedded.prepare(say=click.echo)  # no files are fetched where there can be no server, and without them no database
    files = {} if visits else _fetched()
    was_running = embedded.status().running
    try:
        _run_visits(out) if visits else _run(files, out, language)
    finally:
        if not was_running:
            embedded.stop(say=click.echo, on_demand=True)
    click.echo(f"done in {time.monotonic() - begin:.0f} s")


def _fetched() -> dict[str, Path]:
    from pbl_pipeline import assets

    return {name: assets.fetch(name) for name in assets.needed()}


def _activated() -> None:
    import pbl_schemas
    from pbl_schemas import connection
    from pbl_schemas.operations import embedded

    _step(2, "database")
    embedded.start(say=click.echo)
    connection.connect()
    pbl_schemas.activate()


def _populated() -> None:
    from pbl_workers.cli.populate import summary
    from pbl_workers.populate import populate

    _step(4, "populate")
    run = populate()
    click.echo("\n".join(summary(run)))
    if run.interrupted:
        raise click.exceptions.Exit(EXIT_INTERRUPTED)
    _step(5, "result")


def _run_visits(out: Path) -> None:
    from pbl_schemas.reading import frames
    from pbl_workers.drawn_visits import PROJECT, register_drawn

    _activated()
    _step(3, "drawn visits")
    register_drawn(out)
    _populated()
    for row in frames.session_summary({"project": PROJECT}).to_dict("records"):
        click.echo(f"{row['subject']} {row['session_label']}: index {_number(row['session_gdi'], 1)}{_interval(row)}")
    click.echo(f"drawn, of no real person; the markers are in {out}")
    click.echo("look at them in a browser: pbl web")


def _run(files: dict[str, Path], out: Path, language: str) -> None:
    from pbl_schemas.intake import VisitRecord, ingest
    from pbl_schemas.reading import frames
    from pbl_schemas.reading.visits import write_visit

    for name, path in files.items():
        click.echo(f"{name}: {path}")
    _activated()
    _step(3, "ingest")
    visit = VisitRecord(SUBJECT, SESSION, PROJECT, camera_file=files["demo_camera"])
    for result in ingest([files["demo_video"]], visit):
        if result.error is not None:
            raise result.error
        click.echo(f"{result.status}: video_id {result.video_id}; {result.note}")
    _populated()
    here = {"subject": SUBJECT, "session_label": SESSION}
    paths = write_visit(here, out, language)
    summary_rows = frames.session_summary(here)
    click.echo(rows_text(summary_rows, frames.trial_summary(here)))
    click.echo()
    for path in paths:
        click.echo(path)
    visit = int(summary_rows["session_id"].iloc[0])
    click.echo("look further: `pbl status`, `pbl list`, and docs/tables.md for the tables")
    click.echo(f"open this visit in a browser: pbl web --visit {visit}")


def _step(number: int, title: str) -> None:
    click.secho(f"\n[{number}/5] {title}", bold=True)


def rows_text(sessions, trials) -> str:
    """The rows of a session and its trials as columns of text."""
    row = sessions.iloc[0]
    n = int(row["session_gdi_n"])
    lines = [
        ("subject, session", f"{row['subject']}, {row['session_label']}"),
        ("cadence", f"{_number(row['session_cadence'], 1)} steps/min"),
        ("stride time", f"{_number(row['session_stride_time'], 3)} s"),
        ("step time", f"{_number(row['session_step_time'], 3)} s"),
        ("stance", f"{_number(row['session_stance'], 1)} % of the stride"),
        ("double support", f"{_number(row['session_double_support'], 1)} % of the stride"),
        (
            "GDI of three angles",
            f"{_number(row['session_gdi'], 1)} (left {_number(row['session_gdi_left'], 1)}, "
            f"right {_number(row['session_gdi_right'], 1)}; {n} cycles){_interval(row)}",
        ),
        ("residuals of the fit", f"{row['fit_residual_2d']:.1f} px, {row['fit_residual_3d']:.1f} cm (median)"),
        ("QC", f"{row['qc_outcome']}: {row['qc_worst']}".rstrip(": ")),
    ]
    if row["session_status"] != "PASS":
        lines.append(("gait", f"{row['session_status']}: {row['session_reason']}"))
    text = "\n".join(f"{name:<22}{value}" for name, value in lines)
    columns = ["trial_name", "n_events", "n_cycles", "n_cycles_used", "cadence", "stride_time", "gdi"]
    return text + "\n\n" + trials[columns].to_string(index=False, float_format=lambda v: f"{v:.3g}")


def _interval(row: Any) -> str:
    from pbl_pipeline.gait import interval_90

    interval = interval_90(row["session_gdi"], row["session_gdi_sd"])
    return "" if interval is None else ", 90 % interval {:.0f} to {:.0f}".format(*interval)


def _number(value: float | None, digits: int) -> str:
    return "-" if value is None or value != value else f"{value:.{digits}f}"
