"""The corpus as plain arrays: scenes made on the spot by a seed, and solved motions from a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from ._augment import SOURCE
from ._scenes import scene
from ._sequence import Sequence

#: Points are stored in units of this (m), relative to the middle of the hips.
UNIT_M = 1e-4
#: Every so many-th sequence is held out of training.
HELD_OUT_EVERY = 20


@dataclasses.dataclass(frozen=True, eq=False)
class Corpus:
    """Sequences end to end. `points` (N, 6, 2, 3) int16; `phase` (N, 4) turns; `walks` (N,); of each sequence `start`,
    `length` (frames), `kind`. Phases are kept within one turn of each sequence's start to stay exact in float32."""

    points: np.ndarray
    phase: np.ndarray
    walks: np.ndarray
    start: np.ndarray
    length: np.ndarray
    kind: np.ndarray

    def part(self, held_out: bool) -> np.ndarray:
        """Numbers of the sequences that are held out, or of the others."""
        number = np.arange(len(self.start))
        return number[(number % HELD_OUT_EVERY == 0) == held_out]


def pack(sequences: Iterable[Sequence]) -> Corpus:
    """Sequences as arrays; those shorter than a window's source are left out."""
    points, phase, walks, kind, length = [], [], [], [], []
    for s in sequences:
        if len(s.xyz_m) < SOURCE:
            continue
        middle = s.xyz_m[:, 0].mean(axis=1, keepdims=True)[:, None]
        points.append(np.clip(np.round((s.xyz_m - middle) / UNIT_M), -32767, 32767).astype(np.int16))
        p, w = s.phases()
        phase.append(p.astype(np.float32))
        walks.append(w)
        kind.append(s.kind)
        length.append(len(w))
    ends = np.cumsum(length)
    return Corpus(
        np.concatenate(points),
        np.concatenate(phase),
        np.concatenate(walks),
        ends - np.array(length),
        np.array(length),
        np.array(kind),
    )


def join(*parts: Corpus) -> Corpus:
    """Several corpora as one."""
    shift = np.concatenate([[0], np.cumsum([len(p.walks) for p in parts])[:-1]])
    return Corpus(
        *(np.concatenate([getattr(p, f) for p in parts]) for f in ("points", "phase", "walks")),
        start=np.concatenate([p.start + s for p, s in zip(parts, shift, strict=True)]),
        length=np.concatenate([p.length for p in parts]),
        kind=np.concatenate([p.kind for p in parts]),
    )


def make(one: Callable[[int], Sequence], seeds: range, workers: int, say: Callable[[str], None]) -> Corpus:
    """Sequences `one(seed)` of all seeds, by several processes where there is more than one worker."""
    done: list[Sequence] = []
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for i, sequence in enumerate(pool.map(one, seeds, chunksize=16), 1):
            done.append(sequence)
            if i % 1000 == 0 or i == len(seeds):
                say(f"corpus: {i} of {len(seeds)} sequences")
    return pack(done)


def scenes(seed: int, count: int, workers: int, say: Callable[[str], None]) -> Corpus:
    """`count` scenes; another `seed` gives others."""
    first = 1_000_000 * (seed + 1)
    return make(scene, range(first, first + count), workers, say)


def save(path: str | Path, corpus: Corpus) -> None:
    """Write a corpus (npz)."""
    arrays = {f.name: getattr(corpus, f.name) for f in dataclasses.fields(Corpus)}
    # From frame to frame points move little: differences, which wrap around as int16 do, compress to half the size.
    arrays["points"] = np.diff(corpus.points, axis=0, prepend=np.zeros_like(corpus.points[:1]))
    np.savez_compressed(path, **arrays)


def load(path: str | Path) -> Corpus:
    """Read what `save` wrote."""
    with np.load(path, allow_pickle=False) as f:
        arrays = {field.name: f[field.name] for field in dataclasses.fields(Corpus)}
    arrays["points"] = np.cumsum(arrays["points"], axis=0, dtype=np.int16)
    return Corpus(**arrays)
