"""Pictures that are let go go back to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

from pbl_pipeline.resources import return_large_blocks

#: After the first picture was freed: does the next one lie in the heap, where it leaves a hole?
PROGRAM = """
import sys
import numpy as np
from pbl_pipeline.resources import return_large_blocks

if sys.argv[1] == "fixed":
    assert return_large_blocks()
first = np.ones(6_220_800, np.uint8)
del first
place = np.ones(6_220_800, np.uint8).ctypes.data
heap = next(line for line in open("/proc/self/maps") if line.rstrip().endswith("[heap]")).split()[0].split("-")
print(int(heap[0], 16) <= place < int(heap[1], 16))
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="the C library's limit is that of Linux")
def test_pictures_are_kept_out_of_the_heap():
    if not return_large_blocks():
        pytest.skip("another C library than glibc")

    def in_heap(how: str) -> str:
        done = subprocess.run([sys.executable, "-c", PROGRAM, how], capture_output=True, text=True, check=True)
        return done.stdout.strip()

    assert (in_heap("free"), in_heap("fixed")) == ("True", "False")
