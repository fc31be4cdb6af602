"""One place that loads a TensorFlow Lite model: hash checked, thread count fixed."""

from __future__ import annotations

import hashlib
from collections.abc import Collection
from pathlib import Path

import numpy as np

from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import cores

from .notices import without_notice
from .tflite_outputs import keep_outputs

#: Two threads are the sweet spot of these small models; more only waits. Not a method parameter.
NUM_THREADS = 2


class LiteModel:
    """A loaded .tflite model with one float32 image input. Not to be shared by threads.

    `outputs`: numbers of elements of the outputs that are wanted; the others are not computed (`keep_outputs`). None:
    all of them. `num_threads`: of one call; where several models work side by side, one each is fastest.

    Raises `PblError` ASSET_CHECKSUM when the file is not the pinned one: results name the model by its hash.
    """

    def __init__(
        self,
        path: str | Path,
        sha256: str,
        outputs: Collection[int] | None = None,
        num_threads: int = NUM_THREADS,
    ) -> None:
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
        self.sha256 = found
        # Here and not above: whoever only fits or reads results does not wait for the runtime.
        from ai_edge_litert.interpreter import Interpreter

        if outputs is not None:
            content = keep_outputs(content, outputs)
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
