"""Data of `research.benchmarks.fit`: people who differ and vary, a standing or a held phone, pictures of any size.

    python -m research.benchmarks.fit_data FOLDER JSON

is the process that writes them, one session after the other, as `pbl_pipeline.bench.data` does.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import numpy as np

from pbl_pipeline.bench.cases import FPS, MARKER_SET, Data
from pbl_pipeline.bench.data import places
from pbl_pipeline.synthetic import PHONE_CAMERA, PHONE_SIZE_PX
from research.walker.observe import observe, resized
from research.walker.walk import person, walk_qpos

MOTIONS = ("static", "handheld")


@dataclasses.dataclass(frozen=True)
class WalkerData(Data):
    """Walks of `walk_qpos`, of a camera that stands or is held, in an upright picture of any size."""

    motion: str = "static"
    short_side_px: int = 1080


def write(folder: Path, data: WalkerData) -> None:
    """Write all sessions. The number of a session is the person's seed; its trial k walks with seed 1000 k + number."""
    time_s = np.arange(data.n_frames) / FPS
    camera, size = resized(PHONE_CAMERA, PHONE_SIZE_PX, data.short_side_px)
    for session, trial, place in places(folder, data):
        scale, offset = person(session, MARKER_SET)
        seed = 1000 * trial + session
        qpos = walk_qpos(time_s, seed, path="eight" if data.n_frames > 900 else None)
        seen = observe(
            qpos,
            time_s,
            marker_set=MARKER_SET,
            scale=scale,
            site_offset_m=offset,
            seed=seed,
            camera_motion=data.motion,
            camera=camera,
            image_size_px=size,
        )
        seen.keypoints.save(place / "keypoints.npz")
        np.savez(place / "truth.npz", qpos=qpos, R_nc=seen.R_nc, clock_offset_s=seen.clock_offset_s)


if __name__ == "__main__":
    write(Path(sys.argv[1]), WalkerData(**json.loads(sys.argv[2])))
