"""The benchmark's data on disk: made by a process of its own, read by those that are measured.

`python -m pbl_pipeline.bench._data FOLDER JSON` writes one session after the other; files are keypoints.npz as the
commands read them, and truth.npz beside them.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .plan import FPS, MARKER_SET, NEVER_SEEN, OUTLIER_SHARE, UNSEEN_S, Data

if TYPE_CHECKING:
    from pbl_pipeline.keypoints import Keypoints


@dataclasses.dataclass(frozen=True)
class Truth:
    """Of one trial: qpos (T, 40), R_nc (T, 3, 3), the phone's clock against the video's (s; NaN without a log)."""

    qpos: np.ndarray
    R_nc: np.ndarray
    clock_offset_s: float


def write(folder: Path, data: Data) -> None:
    """Write all sessions. The number of a session is the person's seed; its trial k walks with seed 1000 k + number."""
    from pbl_pipeline.synthetic import PHONE_CAMERA, PHONE_SIZE_PX, Noise, observe, person, resized, walk_qpos

    time_s = np.arange(data.n_frames) / FPS
    camera, size = resized(PHONE_CAMERA, PHONE_SIZE_PX, data.short_side_px)
    noise = Noise(outlier_share=OUTLIER_SHARE) if data.trouble in ("outliers", "all") else Noise()
    never_seen = (NEVER_SEEN,) if data.trouble in ("marker", "all") else ()
    unseen_s = (UNSEEN_S,) if data.trouble in ("span", "all") else ()
    for session in range(data.n_sessions):
        scale, offset = person(session, MARKER_SET)
        for trial in range(data.n_trials):
            seed = 1000 * trial + session
            qpos = walk_qpos(time_s, seed, path="eight" if data.n_frames > 900 else None)
            seen = observe(
                qpos,
                time_s,
                marker_set=MARKER_SET,
                scale=scale,
                site_offset_m=offset,
                noise=noise,
                seed=seed,
                camera_motion=data.motion,
                camera=camera,
                image_size_px=size,
                never_seen=never_seen,
                unseen_s=unseen_s,
            )
            place = _place(folder, session, trial)
            place.mkdir(parents=True)
            seen.keypoints.save(place / "keypoints.npz")
            np.savez(place / "truth.npz", qpos=qpos, R_nc=seen.R_nc, clock_offset_s=seen.clock_offset_s)


def read(folder: Path, data: Data, session: int) -> tuple[list[Keypoints], list[Truth]]:
    """Keypoints and truth of the trials of one session."""
    from pbl_pipeline.keypoints import Keypoints

    keypoints, truth = [], []
    for trial in range(data.n_trials):
        place = _place(folder, session, trial)
        keypoints.append(Keypoints.load(place / "keypoints.npz"))
        with np.load(place / "truth.npz") as f:
            truth.append(Truth(f["qpos"], f["R_nc"], float(f["clock_offset_s"])))
    return keypoints, truth


def _place(folder: Path, session: int, trial: int) -> Path:
    return folder / f"session{session:03d}" / f"trial{trial:02d}"


def main() -> None:
    """Entry of the process."""
    write(Path(sys.argv[1]), Data(**json.loads(sys.argv[2])))


if __name__ == "__main__":
    main()
