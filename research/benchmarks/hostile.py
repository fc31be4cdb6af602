"""A thousand inputs that were made to break something: python -m research.benchmarks.hostile

Damaged and lying video files under hostile names, and fuzzed sensor logs, through `ingest` and a real worker (probe
and tracking; nothing is a stand-in). Printed: what became of each kind. The command fails where a worker's process
died, a job met its time limit, or an input gave neither a row nor a coded error. It starts a separate database.
"""

from __future__ import annotations

import collections
import random
import struct
import time

import click

from pbl_pipeline.bench.detect import numbered
from tests.database import installation
from tests.integration import chain


def flipped(data: bytes, draw: random.Random) -> bytes:
    """Bytes of the header (all but the frames) at random places replaced."""
    out = bytearray(data)
    places = [i for i in range(len(out)) if not _in_frames(data, i)]
    for _ in range(draw.randint(1, 12)):
        out[draw.choice(places)] = draw.randrange(256)
    return bytes(out)


def _in_frames(data: bytes, place: int) -> bool:
    start = data.find(b"mdat")
    size = struct.unpack(">I", data[start - 4 : start])[0]
    return start + 4 <= place < start - 4 + size


def truncated(data: bytes, draw: random.Random) -> bytes:
    """Cut off anywhere."""
    return data[: draw.randrange(1, len(data))]


def frames_flipped(data: bytes, draw: random.Random) -> bytes:
    """Bytes of the frames replaced."""
    out = bytearray(data)
    start = data.find(b"mdat") + 4
    for _ in range(draw.randint(5, 200)):
        out[draw.randrange(start, len(out))] = draw.randrange(256)
    return bytes(out)


def overflowing(data: bytes, draw: random.Random) -> bytes:
    """A box's size, or a count, a time or a picture size in it, is the largest or smallest number there is."""
    out = bytearray(data)
    boxes = [
        b"moov",
        b"mvhd",
        b"tkhd",
        b"mdhd",
        b"stsz",
        b"stco",
        b"stts",
        b"stsc",
        b"elst",
        b"avc1",
        b"mdat",
        b"ftyp",
        b"ctts",
    ]
    at = [i for i in (data.find(b) for b in boxes) if i >= 4]
    place = draw.choice(at) + draw.choice([-4, 4, 8, 12, 16, 20, 24, 28, 32])
    value = draw.choice([2**32 - 1, 2**31, 2**31 - 1, 1, 0])
    out[place : place + 4] = struct.pack(">I", value)
    if draw.random() < 0.3:
        out[place + 4 : place + 12] = struct.pack(">Q", draw.choice([2**64 - 1, 2**63, 2**63 - 1]))
    return bytes(out)


def noise(data: bytes, draw: random.Random) -> bytes:
    """Nothing of a video but its beginning, or not even that."""
    return (data[:32] if draw.random() < 0.5 else b"") + draw.randbytes(draw.randint(1, 20000))


KINDS = {f.__name__: f for f in (flipped, truncated, frames_flipped, overflowing, noise)}
NAMES = (
    "..%2f..%2fetc%2fpasswd", "..\\..\\walk", "'; DROP TABLE video; --", "<img src=x onerror=alert(1)>",
    "walk\u202e4pm", "$(touch pwned)", "%s%s%n", "{key}", "a" * 200,
    "\u00e9\u4e2d\u6587", "CON", "-rf", "walk\n\tmp4", "null\u0001",
)  # fmt: skip


def fuzzed_log(draw: random.Random) -> bytes:
    """A sensor log with something wrong in it."""
    rows = [[f"{0.02 * i:.4f}", "1", "0", "0", "0"] for i in range(200)]
    for _ in range(draw.randint(1, 30)):
        row = draw.choice(rows)
        row[draw.randrange(len(row))] = draw.choice(
            [
                "nan",
                "inf",
                "-1e308",
                "1e400",
                "",
                "9" * 400,
                "__import__('os')",
                "0x7f",
                "\x00",
                "=1+1",
                "1,1",
                "\ud7ff",
            ]
        )
    if draw.random() < 0.2:
        rows.reverse()
    head = draw.choice(["time_s,qw,qx,qy,qz", "time_s,qx,qy,qz", "", "time_s;qw;qx;qy;qz", "\ufefftime_s,qw,qx,qy,qz"])
    text = "\n".join([head, *(",".join(r) for r in rows)]).encode("utf-8", "surrogatepass")
    return text if draw.random() < 0.8 else text[: draw.randrange(len(text))] + draw.randbytes(50)


@click.command()
@click.option("--inputs", default=1000, show_default=True)
@click.option("--seed", default=0, show_default=True)
def main(inputs: int, seed: int) -> None:
    """Make the inputs, put them through, count."""
    import pbl_schemas
    from pbl_schemas import tracking, video
    from pbl_schemas.intake import Sensors, VisitRecord, ingest
    from pbl_schemas.job_errors import error_code
    from pbl_schemas.jobs import jobs_of
    from pbl_workers.process import Options
    from pbl_workers.supervisor import Supervisor

    with installation() as home:
        pbl_schemas.activate()
        good = chain.small_video(home, "good", n=40).read_bytes()
        draw = random.Random(seed)
        refused: collections.Counter = collections.Counter()
        kind_of: dict[int, str] = {}
        start = time.monotonic()
        for i in range(inputs):
            kind = draw.choice([*KINDS, "log"])
            place = home / "in" / str(i)
            place.mkdir(parents=True)
            path = place / f"{draw.choice(NAMES)}{i}.mp4"
            sensors = []
            if kind == "log":
                path.write_bytes(numbered(good, i))
                log = place / draw.choice(["log.csv", "log.json", "log.zip"])
                log.write_bytes(fuzzed_log(draw))
                sensors = [Sensors(attitude=log)]
            else:
                path.write_bytes(KINDS[kind](good, draw))
            (result,) = ingest([path], VisitRecord(subject="P001", session_label=str(i)), files=sensors)
            if result.error is not None:
                refused[f"{kind}: refused, {result.error.code}"] += 1
            elif result.video_id is not None:
                kind_of[result.video_id] = kind
        click.echo(f"{inputs} inputs in {time.monotonic() - start:.0f} s, {sum(refused.values())} refused at the door")
        start = time.monotonic()
        options = Options(resource="cpu", processes=2, once=True, selftest=False, limit_factor=0.05)
        boss = Supervisor(options)
        code = boss.run()
        click.echo(f"worker: exit code {code}, {time.monotonic() - start:.0f} s")
        became: collections.Counter = collections.Counter(refused)
        undecided = 0
        bad = 0
        for video_id, kind in kind_of.items():
            key = {"video_id": video_id}
            errors = [
                error_code(str(message))
                for table in (video.VideoInfo, tracking.Tracking, tracking.SubjectChoice)
                for message in (jobs_of(table).errors & key).to_arrays("error_message")
            ]
            bad += sum(e in ("TIME_LIMIT", "WORKER_CRASH", "INTERNAL") for e in errors)
            if errors:
                became[f"{kind}: error row, {errors[0]}"] += 1
            elif len(video.VideoInfo & key):
                became[f"{kind}: decodes, goes on"] += 1
            else:
                undecided += 1
        for what, n in sorted(became.items()):
            click.echo(f"{n:>6}  {what}")
        restarts = boss.metrics.restarts._value.get()
        click.echo(
            f"processes that died: {restarts:g}; time limits, crashes, unforeseen errors: {bad}; undecided: {undecided}"
        )
        if code or restarts or bad or undecided:
            raise SystemExit(1)


if __name__ == "__main__":
    main()
