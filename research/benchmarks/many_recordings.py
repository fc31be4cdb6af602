"""Registration of very many recordings whose bytes are stated, for measurements of large databases."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path

from pbl_schemas.intake.records import File, Methods, VisitRecord
from pbl_schemas.intake.registration import check_owner, registered, resolve, write
from pbl_schemas.intake.videos import OneCamera
from pbl_schemas.transactions import in_transaction

#: Recordings in one transaction.
CHUNK = 5000


def archived(path: str, sha256: str, size: int, visit: VisitRecord) -> OneCamera:
    """Return the record of a video whose SHA-256 and length (bytes) are known; it is not opened."""
    one = OneCamera(Path(path), visit)
    one.files = (File(Path(path), sha256, size),)
    return one


def register_many(recordings: Iterable[OneCamera], methods: Methods | None = None) -> Counter[str]:
    """Register videos with the methods they go through, some thousand in a transaction; those that are known stay as
    they are. Returns how many are "registered" and "known".

    The same bytes are registered once. Files of `archived` are not opened: what is wrong with one is found when it is
    computed.

    Raises
    ------
    PblError
        USAGE for a subject code that could be a name or a label too long; SOLVER_UNKNOWN, NORM_UNKNOWN;
        VIDEO_DUPLICATE where another subject has the same bytes (earlier transactions stay).
    """
    chosen = resolve(methods or Methods())
    out: Counter[str] = Counter()
    for chunk in _chunks(recordings):
        for one in chunk:
            one.visit.check(one.path)
        new = in_transaction(functools.partial(_write_new, chunk, chosen))
        out += Counter(registered=new, known=len(chunk) - new)
    return out


def _chunks(recordings: Iterable[OneCamera]) -> Iterator[list[OneCamera]]:
    rest = iter(recordings)
    while chunk := list(islice(rest, CHUNK)):
        yield chunk


def _write_new(chunk: Sequence[OneCamera], chosen: Mapping[str, str]) -> int:
    known = registered(file for one in chunk for file in one.files)
    for one in chunk:
        check_owner(one, known)
    new = {one.files[0].sha256: one for one in chunk if one.files[0].sha256 not in known}
    return len(write(list(new.values()), chosen)) if new else 0
