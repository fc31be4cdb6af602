"""TensorFlow Lite models, loaded with a checked hash and only the outputs that are used.

BlazePose's landmark networks also return heat maps, which take a hundredth (heavy) or a tenth (full) of the time of
the points, and a silhouette of 256 x 256 pixels: a tenth or four tenths. The runtime computes every output of the file,
so the file is rewritten with fewer; the rest is computed from the same weights in the same order, bit for bit.
"""

from __future__ import annotations

import functools
import hashlib
import os
import struct
import tempfile
import threading
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import cores

#: Places of fields in the table of a graph.
_OUTPUTS, _OPERATORS = 8, 10


def keep_outputs(model: bytes, sizes: Collection[int]) -> bytes:
    """Reduce a model to the outputs whose number of elements is one of `sizes`, and the operations that they need.

    Raises
    ------
    ValueError
        The model has no output of one of the sizes.
    """
    from ai_edge_litert import schema_py_generated as schema

    content = bytearray(model)
    root = schema.Model.GetRootAs(content, 0)
    graph: Any = root.Subgraphs(0)
    made: list[int] = graph.OutputsAsNumpy().tolist()
    size_of = {t: int(np.prod(graph.Tensors(t).ShapeAsNumpy())) for t in made}
    absent = set(sizes) - set(size_of.values())
    if absent:
        raise ValueError(f"no output of {sorted(absent)} elements; the model's have {sorted(size_of.values())}")
    outputs = [t for t in made if size_of[t] in sizes]
    operators = [graph.Operators(i) for i in range(graph.OperatorsLength())]
    made_by = {t: number for number, op in enumerate(operators) for t in op.OutputsAsNumpy().tolist()}
    needed: set[int] = set()
    open_tensors = outputs.copy()
    while open_tensors:
        number = made_by.get(open_tensors.pop())
        if number is not None and number not in needed:
            needed.add(number)
            open_tensors += [t for t in operators[number].InputsAsNumpy().tolist() if t >= 0]
    # In place: unpacking and packing the file takes a hundred megabytes and longer than loading it.
    at = graph._tab.Vector(graph._tab.Offset(_OPERATORS))
    places = [operators[n]._tab.Pos - at - 4 * i for i, n in enumerate(sorted(needed))]  # counted from each entry
    for field, values in ((_OPERATORS, places), (_OUTPUTS, outputs)):
        at = graph._tab.Vector(graph._tab.Offset(field))
        struct.pack_into(f"<{1 + len(values)}I", content, at - 4, len(values), *values)
    return bytes(content)


def read_network(path: str | Path, sha256: str, outputs: Collection[int] | None = None) -> bytes:
    """Return the bytes of a network's file with the wanted outputs (None: all); those of the last networks stay in
    memory. Raises `PblError` ASSET_CHECKSUM: the file has another hash."""
    return _read_network(path, Path(path).stat().st_mtime_ns, sha256, None if outputs is None else tuple(outputs))


@functools.lru_cache(maxsize=4)
def _read_network(path: str | Path, _changed_ns: int, sha256: str, outputs: tuple[int, ...] | None) -> bytes:
    content = Path(path).read_bytes()
    found = hashlib.sha256(content).hexdigest()
    if found != sha256:
        raise PblError(
            "ASSET_CHECKSUM",
            found=f"SHA-256 {found}",
            expected=f"SHA-256 {sha256}",
            next_step="delete the file and run the command again so that it is fetched anew",
            key=path,
        )
    return content if outputs is None else keep_outputs(content, outputs)


_STDERR = 2
_lock = threading.Lock()
_done: set[bytes] = set()


@contextmanager
def without_notice(words: bytes) -> Iterator[None]:
    """Suppress lines with these words on the standard error, the first time in a process that the block is entered;
    other lines are written after the block. For a library that prints a notice once and has no setting for it."""
    with _lock:
        first = words not in _done
        _done.add(words)
    if not first:
        yield
        return
    with tempfile.TemporaryFile() as kept:
        before = os.dup(_STDERR)
        os.dup2(kept.fileno(), _STDERR)
        try:
            yield
        finally:
            os.dup2(before, _STDERR)
            os.close(before)
            kept.seek(0)
            os.write(_STDERR, b"".join(line for line in kept if words not in line))


#: Two threads are fastest for these small models. Not a method parameter.
NUM_THREADS = 2


class LiteModel:
    """A loaded .tflite model with one float32 image input. Not to be shared by threads.

    `outputs`: numbers of elements of the wanted outputs (None: all); the others are not computed (`keep_outputs`).
    `num_threads`: of one call; with several models in parallel, one each is fastest.

    Raises `PblError` ASSET_CHECKSUM if the file is not the pinned one: results name the model by its hash.
    """

    def __init__(
        self,
        path: str | Path,
        sha256: str,
        outputs: Collection[int] | None = None,
        num_threads: int = NUM_THREADS,
    ) -> None:
        content = read_network(path, sha256, outputs)
        self.sha256 = sha256
        # Not at the top: commands that only fit or read results do not wait for the runtime.
        from ai_edge_litert.interpreter import Interpreter

        with without_notice(b"XNNPACK delegate"):
            self._interpreter = Interpreter(model_content=content, num_threads=min(num_threads, cores()))
            self._interpreter.allocate_tensors()
        self._input = self._interpreter.get_input_details()[0]["index"]
        self._outputs = self._interpreter.get_output_details()

    def __call__(self, image: np.ndarray) -> dict[int, np.ndarray]:
        """Run on `image` (H, W, 3) float32, channels RGB. Outputs keyed by their number of elements."""
        self._interpreter.set_tensor(self._input, image[None])
        self._interpreter.invoke()
        results = (self._interpreter.get_tensor(o["index"]) for o in self._outputs)
        # The exported output names are meaningless ("Identity_3"), their sizes are not.
        return {r.size: r for r in results}
