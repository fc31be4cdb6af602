"""Functions of the library that always answer the same, asked once for each input: tests share a few walks."""

import functools
import pickle
from collections.abc import Callable
from typing import ParamSpec, TypeVar

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
