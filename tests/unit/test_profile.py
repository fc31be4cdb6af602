"""Processor time by stage and kind is that of the process, whichever thread spends it."""

import json
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from pbl_pipeline.bench import profile
from pbl_pipeline.bench.profile import kind_of, profiled
from tests import Limits


def spend(seconds: float) -> None:
    """Use a thread's processor time for so long."""
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        sum(range(1000))


#: The same function as if it were of another file.
NETWORK: dict = {"spend": spend}
exec(compile("def compute(seconds):\n    spend(seconds)", "/x/pbl_pipeline/models/network.py", "exec"), NETWORK)


def frames(*stack: tuple[str, str]) -> Any:
    """Frames by their files and functions, the innermost first."""
    found = None
    for file, name in reversed(stack):
        found = SimpleNamespace(f_code=SimpleNamespace(co_filename=file, co_name=name), f_back=found)
    return found


@pytest.mark.parametrize(
    ("stack", "kind"),
    [
        ([("/a/numpy/core.py", "dot"), ("/a/pbl_pipeline/fit/lanes.py", "fetch")], "fit"),
        ([("/a/pbl_pipeline/video/frames.py", "cut"), ("/a/pbl_pipeline/keypoints/passes.py", "_detect")], "crops"),
        ([("/a/pbl_pipeline/video/frames.py", "read"), ("/a/pbl_schemas/video.py", "make_compute")], "decode"),
        ([("/a/x.py", "<module>"), ("<frozen importlib>", "f"), ("/a/pbl_pipeline/fit/a.py", "g")], "start, imports"),
        ([("/a/jax/_src/core.py", "lower_jaxpr_to_fun"), ("/a/pbl_pipeline/fit/a.py", "g")], "programs of JAX"),
        ([("/a/x.py", "f")], "other"),
        ([], "other"),
    ],
)  # fmt: skip
def test_the_innermost_frame_that_is_known_counts(stack: list[tuple[str, str]], kind: str) -> None:
    assert kind_of(frames(*stack)) == kind


def test_stages_and_threads_add_up_to_the_process(tmp_path: Path, limits: Limits) -> None:
    limits(profile, EVERY_S=0.005)
    began = time.process_time()
    with profiled(str(tmp_path)) as stage_is:
        stage_is("Keypoints")
        for _ in range(3):  # each may get the number of the one before
            thread = threading.Thread(target=NETWORK["compute"], args=(0.1,))
            thread.start()
            thread.join()
        stage_is("Kinetics")
        spend(0.2)
    spent = time.process_time() - began
    (file,) = tmp_path.iterdir()
    found = {(stage, kind): seconds for stage, kind, seconds in json.loads(file.read_text())}
    assert found["Keypoints", "networks"] == pytest.approx(0.3, abs=0.08)
    assert found["Kinetics", "other"] == pytest.approx(0.2, abs=0.08)
    assert sum(found.values()) - began == pytest.approx(spent, abs=0.08)
    assert min(found.values()) >= 0


def test_without_a_folder_nothing_is_sampled() -> None:
    n = threading.active_count()
    with profiled("") as stage_is:
        stage_is("Keypoints")
        assert threading.active_count() == n
