"""The benchmark's data on disk: made by a separate process, read by those that are measured.

`python -m pbl_pipeline.bench.data FOLDER JSON` writes one session after the other; files are keypoints.npz as the
commands read them, and truth.npz beside them.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from .cases import FPS, MARKER_SET, Data

if TYPE_CHECKING:
    from pbl_pipeline.keypoints import Keypoints


def write(folder: Path, data: Data) -> None:
    """Write all sessions: the number of a session is the person's seed, its trials are walks on a treadmill."""
    from pbl_pipeline.body import marker_set
    from pbl_pipeline.synthetic import LEVEL_R_NC, PHONE_CAMERA, PHONE_SIZE_PX, Noise, film, physique, plain_walk

    time_s, markers = np.arange(data.n_frames) / FPS, marker_set(MARKER_SET)
    for session, trial, place in places(folder, data):
        scale, offset = physique(session, markers)
        rng = np.random.default_rng([1000 * trial + session, 41])
        qpos = plain_walk(
            time_s,
            stride_s=rng.uniform(1.0, 1.2),
            speed_m_per_s=0.0,
            heading_rad=rng.uniform(-np.pi, np.pi),
            start_m=(rng.uniform(4.5, 5.5), rng.uniform(-0.2, 0.2)),
        )
        seen = film(
            qpos,
            time_s,
            lambda t: np.tile(LEVEL_R_NC, (len(t), 1, 1)),
            markers=markers,
            scale=scale,
            site_offset_m=offset,
            noise=Noise(),
            rng=rng,
            camera=PHONE_CAMERA,
            image_size_px=PHONE_SIZE_PX,
            sensor=None,
            sensor_rng=rng,
            root_relative=True,
            only_in_picture=False,
        )
        seen.keypoints.save(place / "keypoints.npz")
        np.savez(place / "truth.npz", qpos=qpos)


def places(folder: Path, data: Data) -> Iterator[tuple[int, int, Path]]:
    """Make and return the folder of each trial: session, trial, `folder/session000/trial00`."""
    for session in range(data.n_sessions):
        for trial in range(data.n_trials):
            place = folder / f"session{session:03d}" / f"trial{trial:02d}"
            place.mkdir(parents=True)
            yield session, trial, place


def sessions(folder: Path) -> list[Path]:
    """Return the folders of the sessions, in the order of their numbers."""
    return sorted(folder.glob("session*"))


def read_keypoints(session: Path) -> list[Keypoints]:
    from pbl_pipeline.keypoints import Keypoints

    return [Keypoints.load(trial / "keypoints.npz") for trial in sorted(session.glob("trial*"))]


def read_truth(session: Path, field: str = "qpos") -> list[np.ndarray]:
    """Read a field of the truth of a session's trials: `qpos` (T, 40)."""
    found = []
    for trial in sorted(session.glob("trial*")):
        with np.load(trial / "truth.npz") as file:
            found.append(file[field])
    return found


if __name__ == "__main__":
    write(Path(sys.argv[1]), Data(**json.loads(sys.argv[2])))
