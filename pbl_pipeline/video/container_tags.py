"""Tags that a phone wrote into a MOV or MP4, and missing ends of containers, read from the boxes without a decoder.

FFmpeg returns the metadata of the whole file, but not those of the video track, which name the lens, and of an edit
list it applies the cuts and ignores the speed. Layout: ISO/IEC 14496-12 (boxes, edit list 8.6.6) and Apple's QuickTime
File Format (`meta` with `keys` and `ilst`, well-known types of `data`).

In an incomplete copy the lengths at the front of the file point beyond its end: those of the boxes of MP4/MOV (ISO/IEC
14496-12, 4.2), the Segment element of Matroska/WebM (RFC 9559, 5.1; sizes RFC 8794, 4) and the RIFF chunk of AVI. Files
whose writer never knew the length (a live WebM, MPEG-TS) cannot be checked.
"""

from __future__ import annotations

import dataclasses
import io
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from pbl_pipeline.errors import said

#: Boxes that may be the first of an MP4 or MOV file.
_FIRST_BOXES = {b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp"}
#: Most boxes that are read of a file: an hour in fragments of one picture has some hundred thousand.
_MOST_BOXES = 1_000_000
_EBML, _SEGMENT = b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"


def family(path: Path) -> str | None:
    """ "mp4", "matroska", "avi" or None, by the first bytes of the file."""
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] in _FIRST_BOXES:
        return "mp4"
    if head[:4] == _EBML:
        return "matroska"
    if head[:4] == b"RIFF" and head[8:12] == b"AVI ":
        return "avi"
    return None


#: First bytes of photos, and brands of photos in boxes (ISO/IEC 23008-12, AV1 Image File Format).
_PHOTO_HEADS = {b"\xff\xd8\xff": "JPEG", b"\x89PNG": "PNG", b"II*\x00": "TIFF", b"MM\x00*": "TIFF"}
_PHOTO_BRANDS = {b"heic": "HEIC", b"heix": "HEIC", b"heim": "HEIC", b"heis": "HEIC", b"mif1": "HEIF", b"avif": "AVIF"}


def photo_format(path: Path) -> str | None:
    """Return the format of a photo ("HEIC", "JPEG", ...) by the first bytes of a file, None for other files."""
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return _PHOTO_BRANDS.get(head[8:12])
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WebP"
    return next((name for first, name in _PHOTO_HEADS.items() if head.startswith(first)), None)


def missing_end(path: Path) -> str | None:
    """Describe in one sentence what is missing at the end; None if the lengths add up (or the file states none)."""
    size = path.stat().st_size
    kind = family(path)
    with path.open("rb") as file:
        if kind == "mp4":
            return _mp4(file, size)
        if kind == "matroska":
            return _matroska(file, size)
        if kind == "avi":
            return _avi(file, size)
    return None


def top_boxes(file: BinaryIO, size: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Name, offset, length and length of the header of each box of an MP4 of `size` bytes; ends at an impossible length
    and after `_MOST_BOXES`."""
    at = 0
    for _ in range(_MOST_BOXES):
        if at + 8 > size:
            return
        file.seek(at)
        length, name = struct.unpack(">I4s", file.read(8))
        head = 8
        if length == 1:
            wide = file.read(8)
            length, head = (int.from_bytes(wide, "big"), 16) if len(wide) == 8 else (0, 16)
        elif length == 0:  # "to the end of the file"
            length = size - at
        if length < head:
            return
        yield name, at, length, head
        at += length


def _mp4(file: BinaryIO, size: int) -> str | None:
    boxes = set()
    for name, at, length, _ in top_boxes(file, size):
        boxes.add(name)
        # Only boxes that hold pictures or their index: some writers end with an odd, harmless metadata box.
        if at + length > size and name in (b"mdat", b"moov", b"moof"):
            return said(
                "the '{box}' box ends at byte {end}, the file at {size}", box=name.decode(), end=at + length, size=size
            )
    if b"moov" not in boxes:
        return said("the index of the recording (the 'moov' box) is not in the file")
    return None


def _matroska(file: BinaryIO, size: int) -> str | None:
    file.seek(4)
    length = _vint(file)
    if length is None:
        return "the file ends within its header"
    if file.tell() + length > size:
        return f"its header ends at byte {file.tell() + length}, the file at {size}"
    file.seek(length, 1)
    if file.read(4) != _SEGMENT:
        return "the file ends before its recording begins" if file.tell() >= size else None
    length = _vint(file)
    if length is not None and file.tell() + length > size:
        return f"the recording ends at byte {file.tell() + length}, the file at {size}"
    return None


def _vint(file: BinaryIO) -> int | None:
    """An EBML size; None for "unknown" (all ones) or at the end of the file."""
    first = file.read(1)
    if not first or first[0] == 0:
        return None
    n_bytes = 9 - first[0].bit_length()
    rest = file.read(n_bytes - 1)
    value = int.from_bytes(first + rest, "big") & ((1 << (7 * n_bytes)) - 1)
    return None if len(rest) < n_bytes - 1 or value == (1 << (7 * n_bytes)) - 1 else value


def _avi(file: BinaryIO, size: int) -> str | None:
    file.seek(4)
    end = 8 + struct.unpack("<I", file.read(4))[0]
    return f"the first RIFF chunk ends at byte {end}, the file at {size}" if end > size else None


#: An index larger than this is not read: hours of video have some MB.
_LARGEST_MOOV = 64 << 20
#: Most items of a file and edits of a track, and deepest nesting of boxes, that are read; phones write some dozens.
_MOST_ITEMS, _DEEPEST = 1000, 8
_CONTAINERS = (b"moov", b"trak", b"udta", b"edts", b"mdia")


@dataclasses.dataclass(frozen=True)
class Tags:
    """Metadata of a file and of its video track."""

    items: dict[str, str] = dataclasses.field(default_factory=dict)  # by name in lower case; the track's come first
    speeds: tuple[float, ...] = ()  # of the video track's edits, 1 as stored; without empty edits


def read_tags(path: Path) -> Tags:
    """Read the tags of a file; empty if it is not a MOV or MP4, or after the first box with an impossible length."""
    if family(path) != "mp4":
        return Tags()
    moov = _moov(path)
    items: dict[str, str] = {}
    tracks: dict[str, str] = {}
    speeds: tuple[float, ...] = ()
    for name, box in _boxes(moov):
        if name == b"trak":
            if not speeds and not tracks and _find(box, b"mdia", b"hdlr")[8:12] == b"vide":
                tracks, speeds = _items(box), _speeds(box)
        elif name == b"meta":
            items |= _meta(box)
        elif name == b"udta":
            items |= _items(box)
    return Tags(items | tracks, speeds)


def _moov(path: Path) -> memoryview:
    with path.open("rb") as file:
        for name, at, length, head in top_boxes(file, path.stat().st_size):
            if name == b"moov" and length <= _LARGEST_MOOV:
                file.seek(at + head)
                return memoryview(file.read(length - head))
    return memoryview(b"")


def _boxes(data: memoryview) -> Iterator[tuple[bytes, memoryview]]:
    """Names and contents of the boxes in `data`; ends at an impossible length."""
    for name, at, length, head in top_boxes(io.BytesIO(data), len(data)):
        if at + length > len(data):
            return
        yield name, data[at + head : at + length]


def _find(data: memoryview, *names: bytes) -> memoryview:
    """Content of the first box at this path; empty if there is none."""
    for wanted in names:
        data = next((box for name, box in _boxes(data) if name == wanted), data[:0])
    return data


def _items(data: memoryview, depth: int = _DEEPEST) -> dict[str, str]:
    """Items of all `meta` boxes in these containers, nested up to `depth`."""
    found: dict[str, str] = {}
    for name, box in _boxes(data):
        if name == b"meta":
            found |= _meta(box)
        elif name in _CONTAINERS and depth:
            found |= _items(box, depth - 1)
    return found


def _meta(box: memoryview) -> dict[str, str]:
    # ISO writes version and flags before the boxes, QuickTime does not.
    if box[4:8] != b"hdlr" and box[8:12] == b"hdlr":
        box = box[4:]
    keys, listed = _find(box, b"keys"), _find(box, b"ilst")
    names, at = [], 8
    while at + 8 <= len(keys) and len(names) < _MOST_ITEMS:
        (length,) = struct.unpack_from(">I", keys, at)
        if length < 8 or at + length > len(keys):
            break
        names.append(bytes(keys[at + 8 : at + length]).decode("utf-8", "replace"))
        at += length
    found = {}
    for number, item in _boxes(listed):
        index = int.from_bytes(number, "big")
        data = _find(item, b"data")
        if 1 <= index <= len(names) and len(data) > 8:
            value = _value(int.from_bytes(data[1:4], "big"), bytes(data[8:]))
            if value is not None:
                found[names[index - 1].lower()] = value
    return found


def _value(kind: int, raw: bytes) -> str | None:
    """Text of a value by its well-known type; None for the others (pictures, binary)."""
    if kind == 1:
        return raw.decode("utf-8", "replace").strip("\0").strip()
    if kind in (23, 24) and len(raw) == (4 if kind == 23 else 8):
        return f"{struct.unpack('>f' if kind == 23 else '>d', raw)[0]:.9g}"
    if kind in (21, 22, 65, 66, 67, 74, 75, 76, 77, 78) and len(raw) <= 8:
        return str(int.from_bytes(raw, "big", signed=kind in (21, 65, 66, 67, 74)))
    return None


def _speeds(trak: memoryview) -> tuple[float, ...]:
    table = _find(trak, b"edts", b"elst")
    if len(table) < 8:
        return ()
    layout = ">QqhH" if table[0] == 1 else ">IihH"
    size = struct.calcsize(layout)
    speeds = []
    for i in range(min(int.from_bytes(table[4:8], "big"), (len(table) - 8) // size, _MOST_ITEMS)):
        _, start, whole, part = struct.unpack_from(layout, table, 8 + i * size)
        if start >= 0:
            speeds.append(whole + part / 65536)
    return tuple(speeds)
