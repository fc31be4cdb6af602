"""How a body was fitted, for the visits of tests whose fits no solver made, and its video, which no one filmed."""

from typing import Any

import numpy as np

from pbl_pipeline.fit import TrialFit
from pbl_pipeline.video import VideoInfo
from pbl_pipeline.visit import Solution
from tests.inputs import video_info


def solution_of(fit: TrialFit, **changes: Any) -> Solution:
    """Return a solution with the solver, parameters and scale of this fit."""
    of_fit = {"solver": fit.solver, "params_hash": fit.params_hash, "scale": np.asarray(fit.scale)}
    how = {"iterations": 7, "converged": True, "result": "small_gain"}
    how |= {"loss_trace": np.array([[0.0, 99.0], [100.0, 9.0]])}
    when = {"seconds": 31.2, "compile_seconds": 12.0, "device": "cpu", "software": "0.1.0+gabc"}
    return Solution(**of_fit | how | when | changes)


def video_of(name: str, time_s: np.ndarray, **changes: Any) -> VideoInfo:
    """Return facts of a video of 640 x 360 px with these time stamps, in a folder that no page may name."""
    facts = {"sha256": "ab" * 32, "size_bytes": 3_456_789, "container": "mp4", "width_px": 640, "height_px": 360}
    where = {"path": f"/somewhere/secret/{name}.mp4", "make": "Acme"}
    return video_info(**facts | where | {"time_s": time_s} | changes)
