"""BlazePose's heavy network in MediaPipe's own pose solution and here, in turns on two cores: research/reports.

    python -m venv mp && mp/bin/pip install mediapipe==0.10.21
    python -m research.benchmarks.mediapipe_pose mp/bin/python [VIDEO]

Both go from the file to keypoints and give each frame to that network once. MediaPipe follows one person; here the file
is checked, everyone is tracked, one is chosen, a lighter network places the crops, and every second frame is mirrored.
Networks are loaded before the time that counts. MediaPipe's wheel is without the heavy network: it is copied there.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

#: Cores that both may use.
CORES = 2


def mediapipe_seconds(video: str) -> tuple[int, int, float]:
    """Return frames, those with a person, and seconds of MediaPipe's solution; run by the Python that has it."""
    import cv2
    import mediapipe  # pyright: ignore[reportMissingImports]

    shown = n = 0
    seconds = 0.0
    with mediapipe.solutions.pose.Pose(model_complexity=2) as pose:
        for _ in range(2):  # the first time loads
            begin, n, shown, film = time.perf_counter(), 0, 0, cv2.VideoCapture(video)
            while (read := film.read())[0]:
                shown += pose.process(cv2.cvtColor(read[1], cv2.COLOR_BGR2RGB)).pose_world_landmarks is not None
                n += 1
            seconds = time.perf_counter() - begin
    return n, shown, seconds


def main(python: str, video: str | None = None, rounds: int = 3) -> None:
    """Print frames a second of both, a line a round."""
    from pbl_pipeline import assets
    from pbl_pipeline.bench.detect import demo_clip
    from pbl_pipeline.temporary import new_folder

    os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:CORES])
    where = "import mediapipe, pathlib; print(pathlib.Path(mediapipe.__file__).parent / 'modules/pose_landmark')"
    folder = Path(subprocess.run([python, "-c", where], check=True, capture_output=True, text=True).stdout.strip())
    heavy = assets.fetch("blazepose_landmarks_heavy")
    shutil.copy(heavy, folder / heavy.name)
    with new_folder() as work:
        film, result = Path(video) if video else demo_clip(work / "clip.mp4"), work / "result.json"
        case = {"video": str(film), "person": None, "repeat": 2, "keypoints": "blazepose-heavy", "result": str(result)}
        for _ in range(rounds):
            theirs = subprocess.run([python, __file__, "-", film], check=True, capture_output=True, text=True).stdout
            n, shown, seconds = json.loads(theirs.splitlines()[-1])
            subprocess.run([sys.executable, "-m", "pbl_pipeline.bench.detect_case", json.dumps(case)], check=True)
            ours = json.loads(result.read_text())
            rates = n / seconds, ours["frames"] / ours["seconds"]
            print(  # noqa: T201
                f"MediaPipe {rates[0]:.1f} frames/s ({shown} of {n} with a person), here {rates[1]:.1f}"
                f" ({ours['frames_in_view']} of {ours['frames']}): {rates[1] / rates[0]:.2f} times"
            )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Frames a second of MediaPipe's own pose solution and here.")
    parser.add_argument("python", help="the Python that has mediapipe; - for this one, to measure it alone")
    parser.add_argument("video", nargs="?", help="default: the demo recording's walk at 1080p")
    asked = parser.parse_args()
    if asked.python == "-":
        print(json.dumps(mediapipe_seconds(asked.video)))  # noqa: T201
    else:
        main(asked.python, asked.video)
