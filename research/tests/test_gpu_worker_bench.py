"""The arithmetic of `research/benchmarks/gpu_worker.py` on spans made by hand."""

import pytest

from research.benchmarks.gpu_worker import figures


def span(name: str, begin: float, end: float, n: float = 1, compiling: float = 0.0) -> dict:
    return {"name": name, "begin": begin, "end": end, "n": n, "compiling": compiling}


#: A warm-up of two sessions (0 to 10 s, the device compiles), then two batches of two; the second is packed meanwhile.
SPANS = [
    span("fetch_batch", 0, 1, 2),
    span("compute_batch", 1, 10, 2),
    span("solve", 1, 10, 2),
    span("device", 1, 10, compiling=8.0),
    span("compute_batch", 9, 14, 2),
    span("solve", 10, 14, 2),
    span("device", 10, 14),
    span("run", 10, 11),
    span("run", 11, 12),
    span("compute_batch", 12, 20, 2),
    span("device", 15, 20, compiling=1.0),
    span("run", 14, 15),
    span("run", 15, 16),
    span("run", 20, 21),
    span("run", 21, 24),
    span("smi", 5, 5, 3),
    span("smi", 12, 12, 90),
    span("smi", 16, 16, 70),
    span("smi", 22, 22, 0),
]


def test_figures():
    found = figures(SPANS, 2)
    assert found["busy_share"] == pytest.approx((4 + 4) / 10)  # 5 s of the second call, less 1 s of compiling
    assert found["busy_share_to_last_row"] == pytest.approx(8 / 14)
    assert (found["smi_share"], found["smi_readings"]) == (0.8, 2)
    assert (found["sessions"], found["sessions_per_s"]) == (4, pytest.approx(4 / 14))
    assert found["sessions_per_solve"] == {"2": 1}
    assert found["compiling_seconds"] == 1.0
    assert found["warm_up_seconds"] == 10
    assert found["ms_per_session"]["device"] == pytest.approx(8000 / 4)
    assert found["ms_per_session"]["run"] == pytest.approx(1000 * (1 + 1 + 1 + 1 + 1 + 3) / 6)
