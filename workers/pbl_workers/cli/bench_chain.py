"""`pbl bench chain`: whole recordings through tables and workers, and what very many would cost on such machines."""

from __future__ import annotations

import dataclasses
import json
import os
from collections import defaultdict
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import click

from pbl_pipeline.cli.bench import keep
from pbl_pipeline.errors import PblError

from .worker import Processes, options_of

#: Numbers of recordings whose cost is printed.
MANY = (1_000, 100_000, 1_000_000)


@dataclasses.dataclass(frozen=True)
class Measured:
    """Recordings computed one after another by the processes of one worker, from the first report to the last one.
    processor_s: of these processes. jobs_s: time of the jobs by table, with the other processes running.
    original_bytes: of the recordings; result_bytes: of store and tables."""

    videos: int
    video_s: float
    processes: int
    gpus: int
    seconds: float
    processor_s: float
    original_bytes: int
    result_bytes: int
    jobs_s: dict[str, float]
    #: Stage, what is done, and its processor time (s) in all processes; empty unless asked for.
    profile: list[tuple[str, str, float]] = dataclasses.field(default_factory=list)


@click.command(epilog="Example: pbl bench chain walk.mp4 --videos 32 --processes 2")
@click.argument("video", required=False, type=click.Path(path_type=Path, readable=False))
@click.option("--videos", type=click.IntRange(1), help="Recordings that are timed; default: 4 for each process.")
@click.option("--processes", type=Processes(), default="auto", show_default=True, help="As for `pbl worker`.")
@click.option("--machines", type=click.IntRange(1), default=1, show_default=True, help="For how many is the cost.")
@click.option("--seconds", type=click.FloatRange(0.1), help="Length of the recordings that the cost is for.")
@click.option("--profile", is_flag=True, help="Also print the processor time by stage and by what is done (Linux).")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write all figures to this file.")
def chain(
    video: Path | None,
    videos: int | None,
    processes: int | str,
    machines: int,
    seconds: float | None,
    profile: bool,
    json_path: Path | None,
) -> None:
    """Put copies of VIDEO through all tables with `pbl worker`, and print what many recordings cost.

    Without VIDEO the demo recording at 1920x1080. Works in a separate database, which is removed. A first round, of
    two recordings for each process, compiles and is not counted. The cost is taken as proportional to the length.
    """
    from pbl_pipeline.files import check_out_file
    from pbl_pipeline.resources import cores
    from pbl_pipeline.temporary import new_folder
    from pbl_pipeline.video import check_file

    if json_path is not None:
        check_out_file(json_path)
    if video is not None:
        check_file(video)  # raises what is wrong with the file before anything is measured
    options = options_of("all", processes, once=True, selftest=False)
    with new_folder() as folder:
        found = _measure(folder, video, videos or 4 * options.processes, options, profile)
    keep("chain", [{"cores": cores(), **dataclasses.asdict(found)}], json_path)
    click.echo(text(found, cores(), seconds or found.video_s, machines))


def text(found: Measured, cores: int, video_s: float, machines: int) -> str:
    """The rate and the parts of what was measured, and the cost of `MANY` recordings of `video_s` on `machines`."""
    from pbl_pipeline.bench.run import number, table

    n, scale = found.videos, video_s / found.video_s
    where = f"{cores} cores, {f'GPUs: {found.gpus}, ' if found.gpus else ''}{found.processes} processes"
    jobs = sorted(found.jobs_s.items(), key=lambda j: -j[1])
    whole = sum(found.jobs_s.values())
    parts = table(
        [{"table": name, "s": s / n, "share": 100 * s / whole} for name, s in jobs],
        [
            ("table", lambda r: r["table"]),
            ("s a recording", lambda r: number(r["s"], 3)),
            ("%", lambda r: number(r["share"], 1)),
        ],
    )
    cost = table(
        [{"n": many, "h": many * scale / n / 3600} for many in MANY],
        [
            (f"recordings of {video_s:.3g} s", lambda r: f"{r['n']:,}"),
            ("hours", lambda r: number(r["h"] * found.seconds / machines, 1)),
            ("processor hours", lambda r: number(r["h"] * found.processor_s, 1)),
            ("GPU hours", lambda r: number(r["h"] * found.seconds * found.gpus, 1) if found.gpus else "-"),
            ("originals GB", lambda r: number(r["n"] * scale * found.original_bytes / n / 1e9, 1)),
            ("results GB", lambda r: number(r["n"] * scale * found.result_bytes / n / 1e9, 1)),
        ],
    )
    rate = f"{n} recordings of {found.video_s:.3g} s in {found.seconds:.0f} s: {n / found.seconds:.3g} a second"
    such = "one such machine" if machines == 1 else f"{machines} such machines"
    processor = f"{found.processor_s / n:.3g} s of processor time each"
    return "\n\n".join([f"{where}: {rate}, {processor}", parts, *profile_text(found), f"{such}:\n{cost}"])


def profile_text(found: Measured) -> list[str]:
    """The table of the profile, if there is one: seconds of processor time a recording, by stage and kind."""
    from pbl_pipeline.bench.run import number, table

    if not found.profile:
        return []
    sums = defaultdict[tuple[str, str], float](float)  # by stage and kind, each of them or "all"
    for stage, kind, seconds in found.profile:
        for where in ((stage, kind), (stage, "all"), ("all", kind), ("all", "all")):
            sums[where] += seconds / found.videos
    stages = sorted({s for s, _ in sums} - {"all"}, key=lambda stage: -sums[stage, "all"])
    kinds = sorted({k for _, k in sums} - {"all"}, key=lambda kind: -sums["all", kind])
    rows = [{"stage": stage} for stage in (*stages, "all")]
    shown = lambda value: number(value) if value >= 0.005 else ""  # noqa: E731
    columns = [(k, lambda row, k=k: shown(sums[row["stage"], k])) for k in (*kinds, "all")]
    return [table(rows, [("s a recording", lambda row: row["stage"]), *columns])]


def _measure(folder: Path, video: Path | None, n: int, options: Any, profile: bool = False) -> Measured:
    from pbl_pipeline.bench.detect import demo_clip
    from pbl_pipeline.video import probe

    folder.chmod(0o755)  # root's server runs as another account
    for name in ("DJ_HOST", "DJ_PORT", "DJ_USER", "DJ_PASS", "DJ_PASS_FILE", "PBL_STORE", "PBL_DB_PREFIX"):
        os.environ.pop(name, None)
    os.environ["PBL_HOME"] = str(folder)
    import pbl_schemas
    from pbl_schemas import connection
    from pbl_schemas.operations import embedded

    film = (video or demo_clip(folder / "demo1080.mp4")).read_bytes()
    embedded.start(folder=embedded.Folder(folder / "db"))
    try:
        connection.connect()
        pbl_schemas.activate()
        first = 2 * options.processes
        _compute(_registered(folder, film, 0, first), options)
        before = _stored(folder)
        copies = _registered(folder, film, first, n)
        if profile:
            (folder / "profile").mkdir()
            options = dataclasses.replace(options, profile=str(folder / "profile"))
        seconds, processor_s, jobs_s = _compute(copies, options)
        return Measured(
            videos=n,
            video_s=probe(copies[0]).duration_s,
            processes=options.processes,
            gpus=len(options.gpus),
            seconds=seconds,
            processor_s=processor_s,
            original_bytes=n * len(film),
            result_bytes=_stored(folder) - before,
            jobs_s=jobs_s,
            profile=[row for p in (folder / "profile").glob("*.json") for row in json.loads(p.read_text("utf-8"))],
        )
    finally:
        embedded.stop(folder=embedded.Folder(folder / "db"))


def _registered(folder: Path, film: bytes, first: int, n: int) -> list[Path]:
    """Register `n` recordings of a visit each, with the same pictures in other bytes."""
    from pbl_pipeline.bench.detect import numbered
    from pbl_schemas.intake import VisitRecord, ingest

    paths = []
    for number in range(first, first + n):
        path = folder / f"walk{number:07d}.mp4"
        path.write_bytes(numbered(film, number))
        (result,) = ingest([path], VisitRecord(f"S{number:07d}", "1"))
        if result.error is not None:
            raise result.error
        paths.append(path)
    return paths


def _compute(recordings: Sequence[Path], options: Any) -> tuple[float, float, dict[str, float]]:
    """Work until nothing is left; return the seconds from the first report to the last one, processor time, and time of
    the jobs by table. Raises the `PblError` of a failed job, and INTERNAL if recordings have no index."""
    from pbl_pipeline.temporary import new_folder
    from pbl_schemas import gdi
    from pbl_workers.metrics import KeptReports
    from pbl_workers.supervisor import Supervisor

    metrics, had = KeptReports(), len(gdi.SessionGdi())
    with new_folder() as spent:
        Supervisor(options, metrics, target=partial(_timed, spent)).run()
        processor_s = sum(float(p.read_text("utf-8")) for p in spent.iterdir())
    outcomes = [outcome for _, _, outcome in metrics.reports if outcome is not None]
    failed = [outcome for outcome in outcomes if outcome.code]
    jobs_s: dict[str, float] = defaultdict(float)
    for outcome in outcomes:
        jobs_s[outcome.job.table.__name__] += outcome.seconds
    if failed or len(gdi.SessionGdi()) < had + len(recordings):
        raise PblError(
            failed[0].code if failed else "INTERNAL",
            found=failed[0].text if failed else f"an index of {len(gdi.SessionGdi()) - had} of {len(recordings)}",
            expected="a recording whose index can be computed",
            next_step="try it alone with `pbl run`",
        )
    return metrics.reports[-1][0] - metrics.reports[0][0], processor_s, dict(jobs_s)


def _timed(folder: Path, options: Any, pipe: Any) -> None:
    """`work`, whose processor time is written to a file of `folder`."""
    from pbl_workers.process import work

    try:
        work(options, pipe)
    finally:
        (folder / str(os.getpid())).write_text(str(sum(os.times()[:4])), encoding="utf-8")


def _stored(folder: Path) -> int:
    """Return the bytes of the store and the tables."""
    from pbl_schemas import connection

    rows = connection.connect().query(
        "SELECT COALESCE(SUM(data_length + index_length), 0) FROM information_schema.tables WHERE engine = 'InnoDB'"
    )
    return int(rows.fetchone()[0]) + sum(p.stat().st_size for p in (folder / "store").rglob("*") if p.is_file())
