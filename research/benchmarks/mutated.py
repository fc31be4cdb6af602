"""Files of every kind that is read, with something wrong in them: python -m research.benchmarks.mutated

Each file is made from a sound one by changing bytes, cutting, repeating, and, by what it is, fields and numbers; then
it is read and used as the commands do, in a separate process that may take a minute a file. Printed, by kind: what
became of them, the longest time and the most memory. The command fails where the answer was no result and no code (an
unforeseen error), where a file took longer than a minute, or where the process was beyond 1 GiB.
`--kind KIND --first N --each 1 --here` repeats one, with its traceback.
"""

from __future__ import annotations

import collections
import dataclasses
import gzip
import hashlib
import io
import json
import multiprocessing
import random
import re
import shutil
import struct
import tempfile
import time
import traceback
import warnings
import zipfile
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import click
import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.paramset import canonical_json
from tests.guard import guarded

LONGEST_S, MOST_MIB = 60.0, 1024.0
#: Replacements of a number or text in a table.
_CELLS = (
    *("nan", "inf", "-inf", "-1", "0", "1e308", "-1e308", "1e400", "9" * 400, "1.5.2", "", "x", "\x00", "\x1b[2J"),
    *("\u202e", "1,1", "\t", '"', "0x7f", "__import__('os')", "\ud7ff", "4611686018427387904", "1e-320", "[", "true"),
)
#: Replacements of a value or an attribute in XML.
_XML_VALUES = (
    *("XFD1048576", "XFD499999", "A0", "ZZZZZZ1", "A99999999999", "-1", "1e400", "9" * 400, "nan", "", "x", "n", "s"),
    *("str", "b", "d", "e", "inlineStr", "0", "4294967296", "true", "\u202e", "&a;", "&#0;", "&amp;", "../../x", "1:1"),
)
#: Replacements of a value in JSON.
_VALUES: tuple[Callable[[], Any], ...] = (
    *(lambda v=v: v for v in (None, True, 0, -1, 1.5, 2**62, 10**305, 1e308, "", "x", "\x1b[2J", "a\nb", "\ud800")),
    *(lambda v=v: v for v in (float("nan"), float("inf"), float("-inf"), 1e-320)),
    *(list, dict, lambda: [[]], lambda: {"a": 1}, lambda: [1, [2]], lambda: [0.0] * 2000, lambda: "y" * 100_000),
    *(lambda: _nested(40), lambda: _nested(300), lambda: _nested(30)),
)


def _nested(depth: int) -> Any:
    value: Any = 1
    for i in range(depth):
        value = [value] if i % 2 else {"a": value}
    return value


# ------------------------------------------------------------------------------------------------------ what is changed
def of_bytes(data: bytes, draw: random.Random) -> bytes:
    """Bytes replaced, cut off, left out, repeated, exchanged, or large and small numbers in their place."""
    out = bytearray(data)
    for _ in range(draw.choice([1, 1, 2, 5, 30])):
        at = draw.randrange(len(out)) if out else 0
        what = draw.randrange(7)
        if what == 0 and out:
            out[at] = draw.randrange(256)
        elif what == 1 and draw.random() < 0.3:
            del out[at:]
        elif what == 2:
            del out[at : at + draw.choice([1, 2, 8, 100])]
        elif what == 3:
            out[at:at] = out[at : at + draw.choice([1, 16, 500])] * draw.choice([1, 3, 50])
        elif what == 4:
            out[at:at] = draw.randbytes(draw.choice([1, 8, 300]))
        else:
            # Half of the places are near the beginning, where the headers are.
            at = at if draw.random() < 0.5 else draw.randrange(min(len(out), 600) or 1)
            value = draw.choice([0, 1, 2**15, 2**16 - 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1])
            form = draw.choice([f"{order}{letter}" for order in "<>" for letter in "HIQfd"])
            limit = {"H": 2**16, "I": 2**32, "Q": 2**64}.get(form[1])
            packed = struct.pack(form, value % limit if limit else draw.choice([float(value), np.nan, -1e30, 1e-30]))
            out[at : at + len(packed)] = packed
    return bytes(out)


def of_text(text: str, draw: random.Random, between: str) -> str:
    """Cells and lines replaced, left out, repeated, exchanged."""
    lines = text.split("\n")
    for _ in range(draw.choice([1, 1, 2, 6])):
        i = draw.randrange(min(len(lines), draw.choice([6, len(lines)])))
        cells = lines[i].split(between) if between else lines[i].split()
        j = draw.randrange(len(cells)) if cells else 0
        what = draw.randrange(7)
        if what <= 2 and cells:
            cells[j] = draw.choice(_CELLS)
        elif what == 3 and cells:
            del cells[j]
        elif what == 4:
            cells = cells * draw.choice([2, 40])
        elif what == 5:
            lines[i : i + 1] = [lines[i]] * draw.choice([0, 2, 3, 2000])
            continue
        else:
            k = draw.randrange(len(lines))
            lines[i], lines[k] = lines[k], lines[i]
            continue
        lines[i] = (between or " ").join(cells)
    return "\n".join(lines)


def of_json(content: Any, draw: random.Random) -> Any:
    """Some values, wherever they stand, replaced, left out or repeated."""
    content = json.loads(json.dumps(content))
    for _ in range(draw.choice([1, 1, 2, 4])):
        places = list(_places(content))
        if not places:
            break
        # Fields as often as the thousands of numbers in the lists.
        fields = [p for p in places if isinstance(p[1], str)]
        inner, key = draw.choice(fields if fields and draw.random() < 0.7 else places)
        what = draw.random()
        if what < 0.7:
            inner[key] = draw.choice(_VALUES)()
        elif what < 0.85:
            del inner[key]
        elif isinstance(inner, list):
            inner[key:key] = [inner[key]] * draw.choice([1, 50])
        else:
            inner[str(key) + draw.choice(["", " ", "\x07", "2"])] = inner[key]
    return content


def _places(content: Any) -> Iterator[tuple[Any, Any]]:
    keys = list(content) if isinstance(content, dict) else range(len(content)) if isinstance(content, list) else ()
    for key in keys:
        yield content, key
        yield from _places(content[key])


def of_arrays(arrays: dict[str, np.ndarray], draw: random.Random) -> dict[str, np.ndarray]:
    """Some arrays left out, of another shape, type or order, or with odd values."""
    out = dict(arrays)
    for _ in range(draw.choice([1, 1, 2, 3])):
        name = draw.choice(list(out))
        array = np.asarray(out[name])
        odd = draw.choice([np.nan, np.inf, -np.inf, 0, -1, 1e308, -1e308, 1e-320, 1e9])
        what = draw.randrange(13)
        if what == 0 and len(out) > 1:
            del out[name]
        elif what == 1:
            out[name] = array[:0] if array.ndim else np.zeros(0)
        elif what == 2:
            out[name] = array[None]
        elif what == 3:
            out[name] = array.ravel()
        elif what == 4:
            out[name] = array[: len(array) // 2] if array.ndim else np.asarray([array, array])
        elif what == 5:
            texts = array.dtype.kind in "US"
            out[name] = array.astype(draw.choice(["<U8"] if texts else ["<U8", "complex64", "bool", ">f4", "S4"]))
        elif what == 6:
            out[name] = array[::-1] if array.ndim else np.asarray(draw.choice(_CELLS))
        elif what == 7:
            out[name] = np.asarray(draw.choice(_CELLS))
        elif what == 8:
            out[name] = array.T
        elif what == 9 and array.dtype.kind == "U":
            out[name] = np.asarray([draw.choice(_CELLS) for _ in range(max(1, array.size))])[: max(1, array.size)]
        elif array.dtype.kind in "fi" and array.size:
            with np.errstate(all="ignore"):
                values = array.astype(np.float64).copy()
            if what == 10:
                values[...] = odd
            else:
                values.flat[draw.sample(range(array.size), min(array.size, draw.choice([1, 3, 100])))] = odd
            out[name] = values
    return out


# --------------------------------------------------------------------------------------------------------- what is read
@dataclasses.dataclass(frozen=True)
class Kind:
    """`name` of the file; `write` makes a sound one; `use` reads it as commands do; `change` of its content."""

    name: str
    write: Callable[[Path], object]
    use: Callable[[Path], object]
    change: Callable[[bytes, random.Random], bytes]


def _text(between: str) -> Callable[[bytes, random.Random], bytes]:
    def change(data: bytes, draw: random.Random) -> bytes:
        return of_text(data.decode(), draw, between).encode("utf-8", "surrogatepass")

    return change


def _xml(data: bytes, draw: random.Random) -> bytes:
    """Elements and values of XML replaced, left out, repeated, exchanged; sometimes a document type."""
    text = data.decode()
    for _ in range(draw.choice([1, 1, 2, 4])):
        tags = list(re.finditer(r"<[^<>]*>", text))
        values = list(re.finditer(r'(?<==")[^"<>]*(?=")|(?<=>)[^<>]+(?=<)', text))
        what = draw.randrange(5)
        if what <= 1 and values:
            at = draw.choice(values)
            text = text[: at.start()] + draw.choice(_XML_VALUES) + text[at.end() :]
        elif tags:
            at, other = draw.choice(tags), draw.choice(tags)
            new = {2: "", 3: at.group() * draw.choice([2, 50, 5000]), 4: other.group()}.get(what, at.group())
            text = text[: at.start()] + new + text[at.end() :]
    if draw.random() < 0.05:
        text = f'<!DOCTYPE x [<!ENTITY a "{"a" * 99}">]>{text}'
    return text.encode("utf-8", "surrogatepass")


def _json(data: bytes, draw: random.Random) -> bytes:
    return json.dumps(of_json(json.loads(data), draw)).encode()


def _signed_json(data: bytes, draw: random.Random) -> bytes:
    """A normative set with the checksum of what it holds now."""
    content = of_json(json.loads(data), draw)
    if isinstance(content, dict) and draw.random() < 0.8:
        content.pop("sha256", None)
        try:
            content["sha256"] = hashlib.sha256(canonical_json(content).encode()).hexdigest()
        except (ValueError, RecursionError):
            content["sha256"] = "0" * 64
    return json.dumps(content).encode()


def _npz(data: bytes, draw: random.Random) -> bytes:
    out = io.BytesIO()
    with np.load(io.BytesIO(data)) as f, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        changed: dict[str, Any] = of_arrays({k: f[k] for k in f.files}, draw)
        draw.choice([np.savez, np.savez_compressed])(out, **changed)
    if draw.random() < 0.05:  # zeros that were not requested, or were
        with zipfile.ZipFile(out, "a", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
            archive.writestr(draw.choice(["extra.npy", "qpos2.npy"]), bytes(50_000_000))
    return out.getvalue()


def _zip(
    change: Callable[[bytes, random.Random], bytes], share: float = 0.4
) -> Callable[[bytes, random.Random], bytes]:
    def changed(data: bytes, draw: random.Random) -> bytes:
        out = io.BytesIO()
        with zipfile.ZipFile(io.BytesIO(data)) as before, zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as after:
            for member in before.infolist():
                content = before.read(member)
                after.writestr(member.filename, change(content, draw) if draw.random() < share else content)
        return out.getvalue()

    return changed


def _gz(change: Callable[[bytes, random.Random], bytes]) -> Callable[[bytes, random.Random], bytes]:
    return lambda data, draw: gzip.compress(change(gzip.decompress(data), draw), 1)


def _nothing(data: bytes, draw: random.Random) -> bytes:
    return of_bytes(data, draw)


def kinds() -> list[Kind]:
    """Return all kinds; their readers are loaded here."""
    from research.benchmarks import mutated_files as m

    return [
        Kind("walk.mp4", m.video, m.use_video, _nothing),
        Kind("phone.mov", m.phone_video, m.use_video, _nothing),
        Kind("walk.webm", m.video, m.use_video, _nothing),
        Kind("walk.avi", m.video, m.use_video, _nothing),
        Kind("walk.keypoints.npz", m.keypoints, m.use_keypoints, _npz),
        Kind("lab.markers.npz", m.markers, m.use_markers, _npz),
        Kind("walk.fit.npz", m.fit, m.use_fit, _npz),
        Kind("walk.truth.npz", m.truth, m.use_reference, _npz),
        Kind("walk.reference.npz", m.reference, m.use_reference, _npz),
        Kind("lab.trc", m.trc, m.use_trc, _text("\t")),
        Kind("walkDLC.csv", m.pose_table, m.use_poses, _text(",")),
        Kind("walk.mot", m.mot, m.use_reference, _text("")),
        Kind("bodies.json", m.bodies, m.use_reference, _json),
        Kind("bodies.json.gz", m.bodies, m.use_reference, _gz(_json)),
        Kind("lab.c3d", m.c3d, m.use_c3d, _nothing),
        Kind("lab.c3d.gz", m.c3d, m.use_c3d, _gz(of_bytes)),
        Kind("camera.json", m.camera, m.use_camera, _json),
        Kind("cameras.toml", m.cameras, m.use_cameras, _text(",")),
        Kind("log.csv", m.log, m.use_log, _text(",")),
        Kind("log.json", m.log_json, m.use_log, _json),
        Kind("sensorlogger.zip", m.sensor_logger, m.use_log, _zip(_text(","))),
        Kind("events.csv", m.events, m.use_events, _text(",")),
        Kind("markers.csv", m.marker_set, m.use_marker_set, _text(",")),
        Kind("params.json", m.params, m.use_params, _json),
        Kind("norm.json", m.norm, m.use_norm, _signed_json),
        Kind("study.xlsx", m.workbook, m.use_sheets, _zip(_xml, 0.1)),
        Kind("visits.csv", m.sheet, m.use_sheets, _text(",")),
        Kind("semicolons.csv", m.sheet, m.use_sheets, _text(";")),
        Kind("study.visits.csv", m.study_visits, m.use_study, _text(",")),
        Kind("study.scores.csv", m.study_scores, m.use_study, _text(",")),
        Kind("study.json", m.study_about, m.use_study, _json),
        Kind("manifest.json", m.manifest, m.use_manifest, _json),
        Kind("session.json", m.session, m.use_session, _json),
        Kind("model.json", m.model, m.use_model, _json),
        Kind("model.onnx", m.graph, m.use_graph, _nothing),
        Kind("model.zip", m.archive, m.use_archive, _zip(of_bytes, 0.5)),
        Kind("model.tar.gz", m.archive, m.use_archive, _gz(of_bytes)),
        Kind("method.json", m.method, m.use_method, _json),
        Kind("store.sha256", m.listing, m.use_listing, _text("  ")),
        Kind("forgotten.json", m.forgotten, m.use_forgotten, _json),
        Kind("server.json", m.server, m.use_server, _json),
        Kind("accounts.json", m.accounts, m.use_accounts, _json),
        Kind("metrics.json", m.metrics, m.use_metrics, _json),
        Kind("kinetics.json", m.kinetics, m.use_kinetics, _json),
        Kind("walk.kinetics.npz", m.kinetics, m.use_kinetics, _npz),
        Kind("tracking.npz", m.tracking, m.use_tracking, _npz),
        Kind("participants.tsv", m.participants, m.use_participants, _text("\t")),
        Kind("board.mp4", m.board, m.use_board, _nothing),
        Kind("covered.mov", m.phone_video, m.use_deidentified, _nothing),
        Kind("form.bin", m.form, m.use_form, _nothing),
    ]


# ------------------------------------------------------------------------------------------------------ putting through
@dataclasses.dataclass(frozen=True)
class Outcome:
    """`what`: "taken", or a code; "!" before it where it must not be. `more` of an unforeseen error."""

    what: str
    seconds: float
    mib: float
    more: str = ""


def changed_file(kind: Kind, good: bytes, seed: int) -> bytes:
    """The content of file number `seed` of a kind."""
    draw = random.Random(f"{kind.name} {seed}")
    how = draw.random()
    if how < 0.35:
        return of_bytes(good, draw)
    data = kind.change(good, draw)
    return of_bytes(data, draw) if how > 0.92 else data


def put_through(kind: Kind, path: Path, here: bool = False) -> Outcome:
    """Read and use a file."""
    start, what, more = time.monotonic(), "taken", ""
    with guarded() as peak, warnings.catch_warnings(), np.errstate(all="ignore"):
        warnings.simplefilter("ignore")
        try:
            kind.use(path)
        except PblError as error:
            what = error.code if error.code != "INTERNAL" else "!INTERNAL"
            error.text().encode()
        except Exception as error:
            if here:
                raise
            what = "!INTERNAL"
            frame = traceback.extract_tb(error.__traceback__)[-1]
            ours = [f for f in traceback.extract_tb(error.__traceback__) if "pbl_pipeline" in f.filename]
            at = ours[-1] if ours else frame
            more = f"{type(error).__name__}: {str(error)[:80]} at {Path(at.filename).name}:{at.lineno}"
    seconds = time.monotonic() - start
    # A process that has run other tests is larger before it reads anything: what a file takes is what it grows by.
    if what[0] != "!" and peak.mib > MOST_MIB and peak.grown_mib > MOST_MIB / 2:
        what, more = "!MEMORY", f"{peak.mib:.0f} MiB"
    if what[0] != "!" and seconds > LONGEST_S:
        what, more = "!TIME", f"{seconds:.0f} s"
    return Outcome(what, seconds, peak.mib, more)


def outcomes(kind: Kind, seeds: Sequence[int], folder: Path, here: bool = False) -> Iterator[Outcome]:
    """Make the files one after another and put them through."""
    sound = folder / f"sound-{kind.name}"
    kind.write(sound)
    good = sound.read_bytes()
    kind.use(sound)  # or the benchmark itself is wrong
    for seed in seeds:
        path = folder / kind.name
        path.write_bytes(changed_file(kind, good, seed))
        yield put_through(kind, path, here)


def _child(name: str, seeds: Sequence[int], folder: Path, pipe: Connection) -> None:
    kind = next(k for k in kinds() if k.name == name)
    for outcome in outcomes(kind, seeds, folder):
        pipe.send(outcome)
    pipe.close()


def apart(name: str, seeds: Sequence[int]) -> list[Outcome]:
    """Outcomes from separate processes: one that dies or takes too long is an outcome and is replaced."""
    context, found = multiprocessing.get_context("spawn"), []
    while len(found) < len(seeds):
        folder = Path(tempfile.mkdtemp(prefix="mutated-"))
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_child, args=(name, seeds[len(found) :], folder, theirs))
        process.start()
        theirs.close()
        room = 10 * LONGEST_S  # the first waits for the libraries
        try:
            while len(found) < len(seeds):
                if not ours.poll(room):
                    found.append(Outcome("!TIME", LONGEST_S, 0.0, "ended"))
                    break
                found.append(ours.recv())
                room = 1.5 * LONGEST_S
        except EOFError:
            if len(found) < len(seeds):
                found.append(Outcome("!DIED", 0.0, 0.0, f"exit code {process.exitcode}"))
        process.kill()
        process.join()
        shutil.rmtree(folder, ignore_errors=True)
    return found


@click.command()
@click.option("--each", default=770, show_default=True, help="Files of each kind.")
@click.option("--first", default=0, show_default=True, help="Number of the first file.")
@click.option("--kind", "only", multiple=True, help="Only these kinds.")
@click.option("--here", is_flag=True, help="In this process, with the traceback of an unforeseen error.")
def main(each: int, first: int, only: tuple[str, ...], here: bool) -> None:
    """Make the files, put them through, count."""
    chosen = [k for k in kinds() if not only or k.name in only]
    seeds = range(first, first + each)
    bad = total = 0
    for kind in chosen:
        start = time.monotonic()
        if here:
            with tempfile.TemporaryDirectory(prefix="mutated-") as folder:
                found = list(outcomes(kind, seeds, Path(folder), here))
        else:
            found = apart(kind.name, seeds)
        counts = collections.Counter(o.what for o in found)
        wrong = [(seed, o) for seed, o in zip(seeds, found, strict=True) if o.what[0] == "!"]
        bad, total = bad + len(wrong), total + len(found)
        click.echo(
            f"{kind.name:20} {len(found):6} files {time.monotonic() - start:6.0f} s, longest "
            f"{max(o.seconds for o in found):5.1f} s, most {max(o.mib for o in found):5.0f} MiB; "
            + ", ".join(f"{what} {n}" for what, n in counts.most_common())
        )
        shown: set[str] = set()
        for seed, outcome in wrong:
            if outcome.more not in shown:
                click.echo(f"    {seed}: {outcome.what} {outcome.more}")
                shown.add(outcome.more)
    click.echo(f"{total} files of {len(chosen)} kinds, {bad} without a result or a code, too long or too large")
    if bad:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
