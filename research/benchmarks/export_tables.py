"""Speed and memory of exporting visits from the tables.

    python -m research.benchmarks.export_tables --visits 1000

A visit is a walk of 8 s in one video (240 frames at 30 Hz, blazepose_33), put through the whole chain with stand-ins
for detection and fit in an embedded database. The other visits are copies of its rows, each of a separate person;
they share its files in the store. `pbl export --all` is called in this process, as a person would call it.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path

import click
import pytest

from research.benchmarks.export import resident_mib
from tests.command import pbl
from tests.database import installation
from tests.integration import chain
from tests.rows import register

#: Columns that are another visit's in a copy: the value of visit number `s.seq`.
_OF_A_VISIT = {
    "subject": "CONCAT('S', s.seq)",
    "session_id": "t.session_id + s.seq",
    "video_id": "t.video_id + s.seq",
    "fit_set": "LPAD(s.seq, 16, '0')",
    "video_sha256": "SHA2(CONCAT(t.video_sha256, s.seq), 256)",
    "video_path": "CONCAT(t.video_path, s.seq)",
}


@click.command()
@click.option("--visits", multiple=True, type=int, default=(100, 1000), show_default=True)
@click.option("--to", "formats", multiple=True, default=("trc mot", "parquet", "csv"), show_default=True)
def main(visits: tuple[int, ...], formats: tuple[str, ...]) -> None:
    """Visits a second, processor time of each (without the database's), memory (MiB) before and at its peak."""
    with installation() as home, pytest.MonkeyPatch.context() as patch:
        _first(home, patch)
        click.echo(f"load {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores")
        click.echo(f"{'formats':<16}{'visits':>7}{'visits/s':>10}{'CPU ms':>9}{'MiB before':>12}{'peak':>8}")
        there = 1
        for some in formats:
            _run(some.split(), 1)  # loads what it needs
        for number in sorted(visits):
            copies(there, number)
            there = number
            for some in formats:
                _run(some.split(), number)


def _first(home: Path, patch: pytest.MonkeyPatch) -> None:
    """The visit whose rows are copied."""
    import pbl_schemas
    from pbl_workers.populate import populate

    pbl_schemas.activate()
    chain.install(patch)
    chain.change_fits(patch, chain.with_all_markers)
    register(chain.small_video(home, "walk"), subject="S0", session_label="1")
    populate()


def copies(first: int, last: int) -> None:
    """Copies of the visit's rows for the visits `range(first, last)`, in every table that knows a person or visit."""
    from pbl_schemas import fit, session
    from pbl_schemas.chain import tables

    query = session.Session.connection.query
    numbers = f"`{session.Session.database}`.`numbers`"
    query(f"CREATE OR REPLACE TEMPORARY TABLE {numbers} (seq INT PRIMARY KEY)")
    query(f"INSERT INTO {numbers} VALUES {','.join(f'({i})' for i in range(first, last))}")
    template = {"subject": "S0", "session_id": 1, "video_id": 1}
    template["fit_set"] = (fit.FitSet & {"session_id": 1}).fetch1("fit_set")
    for name, table in tables().items():
        columns = table.heading.names
        owner = next((n for n in template if n in columns), None)
        if owner is None or name.startswith("worker."):
            continue
        values = ",".join(_OF_A_VISIT.get(n, f"t.`{n}`") for n in columns)
        query(
            f"INSERT INTO {table.full_table_name} ({','.join(f'`{n}`' for n in columns)}) "
            f"SELECT {values} FROM {table.full_table_name} AS t JOIN {numbers} AS s WHERE t.`{owner}` = %s",
            args=(template[owner],),
        )


def _run(formats: list[str], visits: int) -> None:
    asked = [word for f in formats for word in ("--to", f)]
    with tempfile.TemporaryDirectory() as folder:
        before, cpu, start = resident_mib(), time.process_time(), time.perf_counter()
        _reset_peak()
        done = pbl("export", "--all", *asked, "--out", Path(folder) / "out")
        seconds, cpu = time.perf_counter() - start, time.process_time() - cpu
        assert done.code == 0, done.err
        made = len(list((Path(folder) / "out").glob("*/*/export.json")))
        assert made == visits, made
    name = " ".join(formats)
    click.echo(
        f"{name:<16}{visits:>7}{visits / seconds:>10.1f}{1e3 * cpu / visits:>9.1f}{before:>12.0f}{_peak_mib():>8.0f}"
    )


def _reset_peak() -> None:
    """The high-water mark of this process's memory begins again (Linux)."""
    Path("/proc/self/clear_refs").write_text("5")


def _peak_mib() -> float:
    line = next(x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


if __name__ == "__main__":
    main()
