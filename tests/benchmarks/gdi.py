"""The original Gait Deviation Index on the gait cycles of eleven children, as a laboratory measured them.

    python -m tests.benchmarks.gdi
    python -m tests.benchmarks.gdi --events phase-transformer

Reads `../shared/data/real/gait_lab_c3d` (see the README there for source and licence): one walk of each child, angles
by Plug-in Gait, events labelled from force plates. Prints each child's index (`gillette-2008`), profile score and
cycles, the mean over the children, and the means of the index of three angles. `--events METHOD` finds the events
from the markers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.gait import EVENT_PARAMSETS, GaitMetrics, detect_events, gait_metrics, read_lab_trial
from tests.conftest import SHARED


def children(
    shared: Path, norm: str = "gillette-166-nine-angles", events: str = "labels"
) -> Iterator[tuple[str, GaitMetrics]]:
    """Name and measures of each child's walk."""
    for path in sorted((shared / "real" / "gait_lab_c3d").glob("Straight_*.c3d.gz")):
        trial = read_lab_trial(path)
        if events != "labels" and trial.feet is not None:
            trial = dataclasses.replace(trial, events=detect_events(trial.feet, events))
        yield trial.name.removeprefix("Straight_"), gait_metrics([trial], norm)


@click.command()
@click.option("--events", type=click.Choice(["labels", *EVENT_PARAMSETS]), default="labels", show_default=True)
def main(events: str) -> None:
    """Print index and profile score of each child, and their means."""
    click.echo(f"{'child':<12}{'cycles':>7}{'left':>8}{'right':>8}{'GDI':>8}{'GPS':>7}")
    for norm in ("gillette-166-nine-angles", "gillette-166-three-angles"):
        sessions, cycles = [], []
        for name, metrics in children(SHARED, norm, events):
            g = metrics.gdi
            if g.mean is None:
                click.echo(f"{name:<12}{g.n:>7}  {g.reason}")
                continue
            sessions.append(g.mean)
            cycles += [c.gdi for c in g.cycles]
            gps = g.profile.gps if g.profile is not None else None
            if gps is not None:
                click.echo(f"{name:<12}{g.n:>7}{g.left:>8.1f}{g.right:>8.1f}{g.mean:>8.1f}{gps:>7.1f}")
        for what, values in (("children", sessions), ("cycles", cycles)):
            mean, sd = np.mean(values), np.std(values, ddof=1)
            click.echo(f"{norm}: {mean:.1f}, sd {sd:.1f} over {len(values)} {what}")


if __name__ == "__main__":
    main()
