"""A function that takes too long or too much is ended; what it raises arrives."""

from __future__ import annotations

import os
import time

import pytest

from pbl_pipeline.limited import LimitExceeded, limited


@pytest.mark.parametrize(
    ("function", "argument", "said"),
    [
        (time.sleep, 600.0, "more than 3 s"),
        (bytearray, 2**31, "more than 256 MiB of memory"),
        (os._exit, 3, "ended with code 3"),
    ],
    ids=["time", "memory", "death"],
)
def test_what_takes_too_much_is_ended(function, argument, said: str):
    begun = time.monotonic()
    with pytest.raises(LimitExceeded, match=said):
        limited(function, argument, seconds=3.0 if function is time.sleep else 300.0, n_bytes=2**28)
    assert time.monotonic() - begun < 300.0


def test_what_is_raised_there_is_raised_here():
    with pytest.raises(ValueError, match="invalid literal"):
        limited(int, "x", seconds=60.0, n_bytes=2**28)
    assert limited(int, "1", seconds=60.0, n_bytes=2**28) is None
    assert limited(int, "1", seconds=60.0, n_bytes=2**28, returns=True) == 1
