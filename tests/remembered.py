"""Functions of the library that always answer the same, asked once for each input: tests share a few walks."""

import functools
import hashlib
import os
import pickle
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, ParamSpec, TypeVar

import numpy as np

if TYPE_CHECKING:
    from pbl_pipeline.models import Network

P = ParamSpec("P")
T = TypeVar("T")


def remembered(function: Callable[P, T]) -> Callable[P, T]:
    """The function, called once in this process for equal arguments; each caller has its own copy of the answer."""
    answers: dict[bytes, bytes] = {}

    @functools.wraps(function)
    def asked(*args: P.args, **kwargs: P.kwargs) -> T:
        key = pickle.dumps((args, kwargs))
        if key not in answers:
            answers[key] = pickle.dumps(function(*args, **kwargs))
        return pickle.loads(answers[key])

    return asked


Look = Callable[["Network", np.ndarray], dict[int, np.ndarray]]


def points_kept_in(folder: Path, look: Look) -> Look:
    """`Network.__call__` of which the networks of points look at each crop once for all processes that share a folder.

    These are the slow ones, and their answers are small. A file appears whole or not at all, so no lock is needed."""

    def seen(network: "Network", image: np.ndarray) -> dict[int, np.ndarray]:
        if network._spec.outputs is None or network.on_gpu:
            return look(network, image)
        path = folder / hashlib.sha256(repr(network._spec).encode() + image.tobytes()).hexdigest()
        if not path.exists():
            with tempfile.NamedTemporaryFile(dir=folder, delete=False) as file:
                pickle.dump(look(network, image), file)
            os.replace(file.name, path)
        return pickle.loads(path.read_bytes())

    return seen
