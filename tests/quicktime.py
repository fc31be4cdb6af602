"""Write into a finished MOV or MP4 what phones put there and PyAV cannot: metadata of a track, an edit list."""

import struct
from collections.abc import Mapping
from pathlib import Path


def box(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), name) + content


def meta(items: Mapping[str, str | float], iso: bool = False) -> bytes:
    """A `meta` box of named items; floats are stored as float32, whole numbers as signed 32-bit."""
    keys = b"".join(struct.pack(">I4s", 8 + len(k), b"mdta") + k.encode() for k in items)
    listed = b""
    for number, value in enumerate(items.values(), 1):
        if isinstance(value, str):
            kind, raw = 1, value.encode()
        elif isinstance(value, int):
            kind, raw = 67, struct.pack(">i", value)
        else:
            kind, raw = 23, struct.pack(">f", value)
        data = box(b"data", struct.pack(">II", kind, 0) + raw)
        listed += struct.pack(">II", 8 + len(data), number) + data
    handler = box(b"hdlr", bytes(8) + b"mdta" + bytes(12))
    inside = handler + box(b"keys", struct.pack(">II", 0, len(items)) + keys) + box(b"ilst", listed)
    return box(b"meta", (bytes(4) if iso else b"") + inside)


#: Options of `videos.write_video` for a file that counts in milliseconds: FFmpeg 9 takes the scale of its tracks.
MILLISECONDS = {"movie_timescale": "1000"}


def edit_list(edits: list[tuple[int, int, float]]) -> bytes:
    """An `edts` box of (length in the file's time scale, start in the track's, speed); the file was written with
    `MILLISECONDS`."""
    rows = b"".join(struct.pack(">IihH", n, start, int(v), round(65536 * (v % 1))) for n, start, v in edits)
    return box(b"edts", box(b"elst", struct.pack(">II", 0, len(edits)) + rows))


def insert(path: Path, *, of_track: bytes = b"", of_file: bytes = b"") -> Path:
    """Put boxes into the first track and the index of `path`, whose index must be its last box."""
    data = path.read_bytes()
    at = _find(data, 0, len(data), b"moov")
    assert at + _length(data, at) == len(data), "the index has to be the last box, or places of pictures would move"
    track = _find(data, at + 8, len(data), b"trak")
    # An edit list goes before the media, as the standard orders the boxes; PyAV's own is taken out.
    own = _find(data, track + 8, track + _length(data, track), b"edts") if of_track[4:8] == b"edts" else -1
    cut = slice(own, own + _length(data, own)) if own >= 0 else slice(track, track)
    rest = data[track + 8 : max(cut.start, track + 8)] + data[max(cut.stop, track + 8) : track + _length(data, track)]
    split = rest.index(b"mdia") - 4
    trak = box(b"trak", rest[:split] + of_track + rest[split:])
    moov = box(b"moov", data[at + 8 : track] + trak + data[track + _length(data, track) :] + of_file)
    path.write_bytes(data[:at] + moov)
    return path


def _length(data: bytes, at: int) -> int:
    return struct.unpack_from(">I", data, at)[0]


def _find(data: bytes, at: int, end: int, name: bytes) -> int:
    while at < end:
        if data[at + 4 : at + 8] == name:
            return at
        at += _length(data, at)
    return -1
