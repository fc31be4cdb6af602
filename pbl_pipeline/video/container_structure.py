"""What a container's own lengths say about its end, read from the file's bytes without a decoder.

A copy that broke off leaves the lengths at the front of the file pointing beyond its end. That holds for the boxes of
MP4/MOV (ISO/IEC 14496-12, 4.2), the Segment element of Matroska/WebM (RFC 9559, 5.1; sizes RFC 8794, 4) and the RIFF
chunk of AVI. It says nothing about a file whose writer never knew its length (a live WebM, MPEG-TS).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

#: Boxes that may be the first of an MP4 or MOV file.
_FIRST_BOXES = {b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot", b"styp"}
#: Boxes of a file that are looked at: an hour in fragments of one picture has some hundred thousand.
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
    """Return the format of a photo ("HEIC", "JPEG", ...) by the first bytes of a file, None for what is no photo."""
    with path.open("rb") as file:
        head = file.read(12)
    if head[4:8] == b"ftyp":
        return _PHOTO_BRANDS.get(head[8:12])
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return "WebP"
    return next((name for first, name in _PHOTO_HEADS.items() if head.startswith(first)), None)


def missing_end(path: Path) -> str | None:
    """One sentence on what the file lacks at its end, or None when its lengths add up (or it has none)."""
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
    """Name, place, length and head of the boxes of an MP4 of `size` bytes; ends where a length makes no sense, and
    after `_MOST_BOXES`."""
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
            return f"the '{name.decode()}' box ends at byte {at + length}, the file at {size}"
    if b"moov" not in boxes:
        return "the index of the recording (the 'moov' box) is not in the file"
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
