"""The C3D format by its own rules: parameters, frames, points and event labels of a file.

`c3d` (py-c3d) decodes single parameters and the number formats of Intel, DEC and MIPS. Its reader is not used: it
refuses numbers of the header that repeat a parameter, returns no frame of 65,535 or more, and counts the high word of
the first frame as 65,535. ezc3d hides frames after the 65,535th and cannot read back more than 255 events (findings/).
"""

from __future__ import annotations

import io
import itertools
import math
import re
import struct
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from pbl_pipeline.assumptions import Origin
from pbl_pipeline.bounded import count_rows
from pbl_pipeline.results.events import FOOT_DOWN, FOOT_UP, GaitEvent

_BLOCK = 512
#: Header and counts have 16 bits: a larger number is cut to this or counted from 0 again.
_WORD = 65536
_SIDES = {"l": "left", "left": "left", "r": "right", "right": "right"}
_MEANINGS = {
    FOOT_DOWN: "footstrike heelstrike initialcontact footcontact heelcontact footon footdown touchdown fs hs ic",
    FOOT_UP: "footoff toeoff footup liftoff fo to",
}
_WORDS = {word: event for event, words in _MEANINGS.items() for word in words.split()}
#: A label in small letters without spaces: the side may be before or after.
_LABEL = re.compile(rf"(left|right|l|r)?({'|'.join(_WORDS)})(left|right|l|r)?")


class C3dFile:
    """One C3D file in memory. `origin` lists what was assumed and left out; ValueError for a damaged or ambiguous file.

    `first_frame`, `n_frames`, `rate_hz`: the frames that the file holds. `labels`: the name of each point as written.
    """

    def __init__(self, data: bytes) -> None:
        import c3d

        self.origin = Origin()
        #: The person of the points that were taken, if their names state it.
        self.person = ""
        self._data = data
        start = _BLOCK * (data[0] - 1)
        if data[1] != 0x50 or start < _BLOCK:
            raise ValueError("no C3D header")
        self._types = c3d.DataTypes(data[start + 3])
        order = ">" if self._types.is_mips else "<"
        header = struct.unpack_from(f"{order}5H", data, 2)
        block, per_frame = struct.unpack_from(f"{order}2H", data, 16)
        scale, rate = self._floats(data[12:16] + data[20:24])
        self._parameters = self._read_parameters(start, _BLOCK * (block - 1), order)
        self.rate_hz = self._stated_twice("POINT:RATE", rate)
        if not 0 < self.rate_hz < math.inf:
            raise ValueError("no rate of frames")
        self._layout(header, scale, block, per_frame)
        self.labels = self.texts("POINT:LABELS")[: self._points]

    def _read_parameters(self, start: int, end: int, order: str) -> dict[str, list[bytes]]:
        """Records of the parameters by GROUP:NAME in capitals (their case has no meaning), up to the first frame."""
        end = end if end > start else start + _BLOCK * self._data[start + 2]
        groups: dict[int, str] = {}
        found: list[tuple[int, str, bytes]] = []
        at, step = start + 4, 1
        while step and at < min(end, len(self._data) - 4):
            length, group = struct.unpack_from("bb", self._data, at)
            if group == 0 or length == 0:
                break
            at += 2 + abs(length)
            name = self._types.decode_string(self._data[at - abs(length) : at]).strip().upper()
            (step,) = struct.unpack_from(f"{order}H", self._data, at)
            if group < 0:
                groups[-group] = name
            else:
                found.append((group, name, self._data[at + 2 : at + step if step else end]))
            at += step
        table: dict[str, list[bytes]] = {}
        for group, name, record in found:
            table.setdefault(f"{groups.get(group)}:{name}", []).append(record)
        return table

    def _get(self, key: str) -> Any:
        """A parameter, or None. One that is stated twice must have one value."""
        import c3d

        made = [c3d.Param(key, self._types, handle=io.BytesIO(record)) for record in self._parameters.get(key, ())]
        if any((p.bytes, p.dimensions) != (made[0].bytes, made[0].dimensions) for p in made):
            raise ValueError(f"the parameter {key} is stated {len(made)} times, with different values")
        return made[0] if made else None

    def _pieces(self, key: str) -> Iterator[Any]:
        """A parameter and its continuations: one holds 255 values, the next are in KEY2, KEY3 ..."""
        names = itertools.chain([key], (f"{key}{k}" for k in itertools.count(2)))
        return itertools.takewhile(lambda piece: piece is not None, map(self._get, names))

    def _floats(self, data: bytes) -> np.ndarray:
        if not self._types.is_dec:
            return np.frombuffer(data, self._types.float32).astype(float)
        # A DEC number has its two words exchanged and an exponent that is larger by 2.
        return np.frombuffer(data, "<u2").reshape(-1, 2)[:, ::-1].copy().view("<f4").ravel().astype(float) / 4

    def _numbers(self, piece: Any) -> np.ndarray:
        if piece.bytes_per_element == 4:
            return self._floats(piece.bytes)
        return np.frombuffer(piece.bytes, {1: np.uint8, 2: self._types.uint16}[piece.bytes_per_element]).astype(float)

    def numbers(self, key: str) -> np.ndarray:
        """All numbers of a parameter, whose first dimension runs fastest; none where it is absent."""
        piece = self._get(key)
        return self._numbers(piece) if piece else np.zeros(0)

    def number(self, key: str) -> float:
        """A number; one of two 16-bit words has the low word first. NaN where it is absent."""
        piece, values = self._get(key), self.numbers(key)
        if len(values) == 2 and piece.bytes_per_element == 2:
            return float(values[0] + _WORD * values[1])
        return float(values[0]) if len(values) else math.nan

    def texts(self, key: str) -> list[str]:
        """All texts of a parameter and of its continuations."""
        return [str(s).strip(" \0") for piece in self._pieces(key) for s in np.ravel(piece.string_array)]

    def _stated_twice(self, key: str, header: float) -> float:
        value = self.number(key)
        if not value > 0 or not header > 0 or math.isclose(value, header, rel_tol=1e-3):
            return value if value > 0 else header
        raise ValueError(f"{key} is {value:g}, and {header:g} in the header")

    def _layout(self, header: tuple[int, ...], scale: float, block: int, per_frame: int) -> None:
        """Place, size and number of the frames. Where header and parameters differ, the size of the file decides."""
        points, analog, first, last, _ = header
        scales = [s for s in (self.number("POINT:SCALE"), scale) if s != 0 and math.isfinite(s)]
        used, ratio = self.number("ANALOG:USED"), self.number("ANALOG:RATE") / self.rate_hz
        analogs = [used * n for n in (ratio, per_frame) if 0 <= used * n < _WORD] + [analog]
        analogs += [0] if math.isnan(used) else []
        begin, end = self.number("TRIAL:ACTUAL_START_FIELD"), self.number("TRIAL:ACTUAL_END_FIELD")
        stated = (end - begin + 1, *map(self.number, ("POINT:LONG_FRAMES", "POINT:FRAMES")), (last - first + 1) % _WORD)
        counts = [int(n) for n in stated if n >= 0]
        options = itertools.product(
            [int(n) for n in dict.fromkeys((self.number("POINT:USED"), points)) if n > 0],
            dict.fromkeys(round(n) for n in analogs),
            dict.fromkeys(2 if s > 0 else 4 for s in scales),
            [int(b) for b in dict.fromkeys((block, self.number("POINT:DATA_START"))) if b > 1],
        )
        fits = []
        for n_points, n_analog, word, at in options:
            size, held = word * (4 * n_points + n_analog), len(self._data) - _BLOCK * (at - 1)
            n = next((m for n in counts for m in _cut(n, held // size) if 0 <= held - m * size < _BLOCK), 0)
            fits.append((n, n_points, size, word, at, held // size))
        if not fits:
            raise ValueError("no points")
        n, self._points, self._size, self._bytes, at, held = next((f for f in fits if f[0]), fits[0])
        self._start = _BLOCK * (at - 1)
        if not n and len({f[2:4] for f in fits}) > 1 and _WORD - 1 not in counts:
            raise ValueError("header and parameters state frames of different sizes, and neither fills the file")
        if n in (0, _WORD - 1) and _WORD - 1 in (*counts, last):
            stop = self._start + held * self._size
            tail = self._data[max(self._start, stop - _BLOCK) : stop]
            n = held - (len(tail) - len(tail.rstrip(b"\0"))) // self._size
        self.n_frames = n or max(min(next(filter(None, counts), 0), held), 0)
        count_rows(self.n_frames)
        self._scale = 1.0 if self._bytes == 4 else self._stated_twice("POINT:SCALE", scale)
        self.first_frame = first
        if begin > 0:
            if end - begin + 1 == self.n_frames or (last - first + 1 - self.n_frames) % _WORD:
                self.first_frame = int(begin)
            elif begin != first:
                self.origin.assumed.append(f"first frame {first}, which fits the data; {begin:g} of TRIAL does not")

    def _words(self, first: int, shape: tuple[int, int]) -> np.ndarray:
        """Words (T, *shape) as they lie in the frames, from word `first` of each."""
        kind = {2: self._types.int16, 4: "<u4" if self._types.is_dec else self._types.float32}[self._bytes]
        steps = (self._size, shape[1] * self._bytes, self._bytes)
        return np.ndarray((self.n_frames, *shape), kind, self._data, self._start + first * self._bytes, steps)

    def _decoded(self, words: np.ndarray) -> np.ndarray:
        if self._types.is_dec and self._bytes == 4:
            return self._floats(words.tobytes()).reshape(words.shape)
        return words.astype(float)

    def analogs(self) -> np.ndarray:
        """Signed analog samples (T, samples per frame, channels) in the units of ANALOG:UNITS."""
        used = int(self.number("ANALOG:USED"))
        words = self._words(4 * self._points, ((self._size // self._bytes - 4 * self._points) // used, used))
        scale, offset = (self.numbers(f"ANALOG:{key}")[:used] for key in ("SCALE", "OFFSET"))
        return (self._decoded(words) - offset) * scale * self.number("ANALOG:GEN_SCALE")

    def points(self, columns: Collection[int]) -> np.ndarray:
        """Coordinates (T, P, 3) in the file's unit. NaN where a point is missing: its residual is negative, a number is
        not finite, or all four are 0."""
        values = self._decoded(self._words(0, (self._points, 4))[:, list(columns)])
        zeros = np.asarray(~values.any(axis=-1))
        if zeros.any():
            names = ", ".join(self.labels[c] for i, c in enumerate(columns) if zeros[:, i].any())
            self.origin.assumed.append(f"points of three zeros count as missing ({int(zeros.sum())} samples): {names}")
        missing = (values[..., 3] < 0) | ~np.isfinite(values).all(axis=-1) | zeros
        values[missing] = np.nan
        values *= self._scale
        return values[..., :3]

    def events(self) -> list[tuple[str, GaitEvent]]:
        """Initial contacts and toe-offs as (subject, event).

        A side is that of the context or of the label (RHS, Left Foot Strike); a General context has none. Events beyond
        EVENT:USED are deleted ones.
        """
        labels = self.texts("EVENT:LABELS")
        times = [row for piece in self._pieces("EVENT:TIMES") for row in self._minutes_seconds(piece)]
        used = self.number("EVENT:USED")
        if not labels or not times:
            return []
        n = len(labels) if math.isnan(used) else int(used)
        for key, there in (("LABELS", len(labels)), ("TIMES", len(times))):
            if there < n:
                raise ValueError(f"EVENT:{key} holds {there} of {n} events")
        if n < max(len(labels), len(times)):
            self.origin.assumed.append(f"events beyond EVENT:USED ({n}) are deleted ones and not used")
        contexts, subjects = (self.texts(f"EVENT:{key}") for key in ("CONTEXTS", "SUBJECTS"))
        found, ignored = [], []
        rows = itertools.zip_longest(labels[:n], times[:n], contexts[:n], subjects[:n], fillvalue="")
        for label, time, context, subject in rows:
            known = _LABEL.fullmatch(re.sub(r"[^a-z]", "", label.lower()))
            words = (*(known.group(1, 3) if known else ()), re.sub("[^a-z]|foot|leg|side", "", context.lower()))
            sides = {_SIDES[word] for word in words if word in _SIDES}
            if known is None or not sides:
                ignored.append(" ".join(s for s in (context, label) if s))
                continue
            if len(sides) > 1 or not np.isfinite(time).all():
                raise ValueError(f"an event {label!r} of the side {context!r} at {time[0]:g} min {time[1]:g} s")
            event = GaitEvent(float(time[0] * 60 + time[1]), sides.pop(), _WORDS[known.group(2)], 1.0)
            found.append((subject, event))
        if ignored:
            self.origin.assumed.append(
                f"event labels that are not used: {', '.join(map(repr, dict.fromkeys(ignored)))}"
            )
        return found

    def _minutes_seconds(self, piece: Any) -> np.ndarray:
        """Times (N, 2) of 2 x N numbers, of one row of 2N, or of N x 2."""
        values = self._numbers(piece)
        sizes = [d for d in piece.dimensions if d != 1]
        if len(values) % 2 or (len(sizes) > 1 and 2 not in sizes):
            raise ValueError(f"EVENT:TIMES of {'x'.join(map(str, piece.dimensions))} is not minutes and seconds")
        return values.reshape(2, -1).T if len(sizes) > 1 and sizes[0] != 2 else values.reshape(-1, 2)


def _cut(n: int, held: int) -> Iterator[int]:
    """A stated number of frames, and those of which 16 bits would leave this."""
    yield n
    if n < _WORD:
        yield from range(n + _WORD, held + 1, _WORD)
