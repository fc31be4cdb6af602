"""What the process that computes a visit for the page runs in tests: the real one, behind stand-ins."""

import os
import signal
import time
from pathlib import Path

from pbl_workers.on_request import compute_visit


def compute(session_id: int, again: bool) -> None:
    """`compute_visit` with stand-ins. A file in the folder PBL_TEST_HOLD holds it up (`hold`) or kills it (`kill`)."""
    folder = Path(os.environ["PBL_TEST_HOLD"])
    if (folder / "kill").exists():
        os.kill(os.getpid(), signal.SIGKILL)
    while (folder / "hold").exists():
        time.sleep(0.05)
    import pytest

    from . import chain

    chain.install(pytest.MonkeyPatch())
    compute_visit(session_id, again)


def nothing(session_id: int, again: bool) -> None:
    """Compute nothing."""
