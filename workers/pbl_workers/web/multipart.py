"""Forms with files (multipart/form-data), read while they arrive."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import AsyncIterator

from starlette.requests import ClientDisconnect, Request

from .access import Refused

#: Longest head of a part (byte); most parts of a form.
_HEAD, _PARTS = 4096, 60
_BOUNDARY = re.compile(r'multipart/form-data;.*?boundary="?([\x21\x23-\x7e]{1,70}?)"?\s*(?:;|$)', re.I)
_NAME, _FILE = re.compile(r'[;\s]name="([^"]*)"', re.I), re.compile(r'[;\s]filename="([^"]*)"', re.I)


@dataclasses.dataclass(frozen=True)
class Part:
    """The beginning of a field of a form; file: the name of its file, None for a text."""

    name: str
    file: str | None


def is_multipart(request: Request) -> bool:
    """Return whether the body of a request is such a form."""
    return _BOUNDARY.match(request.headers.get("content-type", "")) is not None


async def parts(request: Request) -> AsyncIterator[Part | bytes]:
    """Yield each part of a form, and then its bytes in pieces as they arrive. Raises `Refused` "form" for a body that
    is broken off or not such a form."""
    found = _BOUNDARY.match(request.headers.get("content-type", ""))
    if found is None:
        raise Refused("form")
    mark = b"\r\n--" + found[1].encode()
    kept, in_head, n = bytearray(b"\r\n"), False, 0
    try:
        async for piece in request.stream():
            kept += piece
            while True:
                if in_head:
                    if kept.startswith(b"--"):
                        return
                    end = kept.find(b"\r\n\r\n")
                    if (len(kept) if end < 0 else end) > _HEAD or (n := n + (end >= 0)) > _PARTS:
                        raise Refused("form")
                    if end < 0:
                        break
                    yield _part(bytes(kept[:end]))
                    del kept[: end + 4]
                    in_head = False
                at = kept.find(mark)
                ready = at if at >= 0 else max(0, len(kept) - len(mark))
                if n and ready:  # what stands before the first part is of no part
                    yield bytes(kept[:ready])
                del kept[: ready + (len(mark) if at >= 0 else 0)]
                if at < 0:
                    break
                in_head = True
    except ClientDisconnect:
        raise Refused("form") from None
    raise Refused("form")


def _part(head: bytes) -> Part:
    try:
        text = head.decode()
    except UnicodeDecodeError:
        raise Refused("form") from None
    line = next((one for one in text.split("\r\n") if one.lower().startswith("content-disposition:")), "")
    name, file = _NAME.search(line), _FILE.search(line)
    if name is None:
        raise Refused("form")
    return Part(name[1], file[1] if file else None)
