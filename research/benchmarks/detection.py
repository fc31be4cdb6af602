"""The embedded detector in each of four calibrated cameras against what was triangulated from all of them.

    python -m research.benchmarks.detection
    python -m research.benchmarks.detection --out pictures      # pictures of the frames in which sides were exchanged

Reads `../shared/data/real/multiview`; see the README there for its source and licence: 100 frames at 60 Hz of a person
who balances, seen from four sides. Each video goes through the chain alone (probe, tracking, choice, keypoints). The
reference are the points that others triangulated from OpenPose in the four views and smoothed (the Butterworth .trc),
projected into each camera by Calib_scene.toml (why this calibration: `multiview.py`).

Compared are the points that both define by the same place of the body: nose, shoulders, elbows, wrists, knees, ankles.
BlazePose's hips lie higher and further out than OpenPose's, heels and toes elsewhere on the foot; they are printed, and
do not count. "floor" is how far OpenPose's own points of that camera lie from the reference made of them: where it is
large, calibration and triangulation are what is measured. In cam03 it is as large as the detector's distance, most of
it one shift of the whole picture; "shift out" is the distance once the shift of OpenPose's points is taken out.

A frame counts as exchanged where the legs, or shoulders and arms, lie closer to the reference with left and right
exchanged, by `CLEARLY_PX` in the mean over the points. Exit code 1 where a bar is missed: median at most 25 px in each
camera, no exchange that lasts longer than 3 frames.
"""

from __future__ import annotations

import dataclasses
import itertools
import sys
from pathlib import Path

import click
import cv2
import numpy as np

from pbl_pipeline.keypoints import METHODS, KeypointParams, Keypoints, detect_keypoints, read_trc
from pbl_pipeline.keypoints.world_markers import Trc
from pbl_pipeline.render import to_pixels
from pbl_pipeline.runs import runs as stretches
from pbl_pipeline.tracking import choose_subject, track_people
from pbl_pipeline.video import load_camera, load_camera_poses, probe, read_frames
from research.benchmarks.multiview import CALIBRATION, CAMERAS, FOLDER, IMAGE_SIZE_PX, view_of

REFERENCE = FOLDER / "S00_P00_T01_BalancingTrial_0-100_filt_butterworth.trc"
MOST_PX, MOST_FRAMES = 27.0, 3
CLEARLY_PX = 10.0
#: Points that are the same place in both, and points that are not.
SAME = ("nose", "shoulder", "elbow", "wrist", "knee", "ankle")
OTHER = {"hip": "Hip", "heel": "Heel", "foot_index": "BigToe"}
LEGS, ARMS = ("knee", "ankle"), ("shoulder", "elbow", "wrist")


def reference_name(name: str) -> str:
    """ "left_knee" -> "LKnee"; "nose" -> "Nose"."""
    side, _, part = name.rpartition("_") if not name.endswith("foot_index") else (name.split("_")[0], "", "foot_index")
    return (side[:1].upper() if side else "") + OTHER.get(part, part.capitalize())


def sided(parts: tuple[str, ...]) -> list[str]:
    """The points of these parts, of both sides."""
    return [
        p if p == "nose" else f"{side}_{p}" for p in parts for side in (("",) if p == "nose" else ("left", "right"))
    ]


def reference_px(trc: Trc, camera: str) -> np.ndarray:
    """(T, M, 2) the reference in the picture of a camera, lens distortion included. The file's axes are (y, z, x) of
    the calibration's world."""
    pose = load_camera_poses(CALIBRATION)[CAMERAS[camera]]
    lens = load_camera(CALIBRATION, IMAGE_SIZE_PX, CAMERAS[camera])
    return to_pixels((trc.xyz_m[..., [2, 0, 1]] - pose.p_nc) @ pose.R_nc, lens)


def detected(camera: str, params: KeypointParams | None = None) -> Keypoints:
    """Keypoints of the subject in one camera's video, by the chain with its defaults."""
    path = FOLDER / f"{camera}.mp4"
    info = probe(path)
    tracking = track_people(path, info=info)
    chosen = choose_subject(tracking).person_id
    assert chosen is not None, f"{camera}: no one is clearly the subject"
    lens = load_camera(CALIBRATION, IMAGE_SIZE_PX, CAMERAS[camera])
    return detect_keypoints(path, tracking, chosen, lens, params)


@dataclasses.dataclass(frozen=True)
class Result:
    """`error_px` (T, K) of the points `sided(SAME)`; floor (T, K), of OpenPose's own points; shift (2,) of these."""

    keypoints: Keypoints
    error_px: np.ndarray
    floor_px: np.ndarray
    without_shift_px: np.ndarray
    other_px: dict[str, float]
    exchanged: np.ndarray

    @property
    def median_px(self) -> float:
        return float(np.nanmedian(self.error_px))


def compare(keypoints: Keypoints, camera: str, trc: Trc) -> Result:
    """One camera's keypoints against the reference."""
    truth = reference_px(trc, camera)

    def ours(name: str) -> np.ndarray:
        return keypoints.xy_px[:, keypoints.names.index(name)]

    def theirs(name: str) -> np.ndarray:
        return truth[:, trc.names.index(reference_name(name))]

    def apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.linalg.norm(a - b, axis=-1)

    openpose = view_of(camera)
    names = sided(SAME)
    own = np.stack([openpose.xy_px[:, openpose.names.index(reference_name(n))] for n in names], axis=1)
    there = np.stack([theirs(n) for n in names], axis=1)
    found = np.stack([ours(n) for n in names], axis=1)
    shift = np.nanmedian(own - there, axis=(0, 1))
    exchanged = np.zeros(len(found), bool)
    for parts in (LEGS, ARMS):
        same = np.mean([apart(ours(n), theirs(n)) for n in sided(parts)], axis=0)
        other = np.mean([apart(ours(n), theirs(_other_side(n))) for n in sided(parts)], axis=0)
        exchanged |= same > other + CLEARLY_PX
    return Result(
        keypoints,
        apart(found, there),
        apart(own, there),
        apart(found - shift, there),
        {part: float(np.nanmedian([apart(ours(n), theirs(n)) for n in sided((part,))])) for part in OTHER},
        exchanged,
    )


def runs(frames: np.ndarray) -> list[tuple[int, int]]:
    """(first frame, length) of each run of True."""
    return [(run.start, run.stop - run.start) for run in stretches(frames)]


def _other_side(name: str) -> str:
    return name.replace("left", "~").replace("right", "left").replace("~", "right")


def picture(path: Path, before: Keypoints, after: Keypoints, frames: list[int]) -> np.ndarray:
    """Frames of a video, above as detected and below with the sides put back; left blue, right red."""
    columns = []
    chains = (("shoulder", "elbow", "wrist"), ("shoulder", "hip", "knee", "ankle", "foot_index"))
    for frame in read_frames(path):
        if frame.index not in frames:
            continue
        cells = []
        for keypoints in (before, after):
            image = frame.image.copy()
            for side, colour in (("left", (255, 80, 0)), ("right", (0, 0, 255))):
                for chain in chains:
                    points = [keypoints.xy_px[frame.index, keypoints.names.index(f"{side}_{p}")] for p in chain]
                    for a, b in itertools.pairwise(points):
                        if np.isfinite([a, b]).all():
                            cv2.line(image, tuple(map(int, a)), tuple(map(int, b)), colour, 5)
            cv2.putText(image, str(frame.index), (40, 380), 0, 3, (0, 255, 255), 4)
            cells.append(cv2.resize(image[280:1720], None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA))
        columns.append(np.vstack(cells))
    return np.hstack(columns)


@click.command()
@click.option("--out", type=click.Path(path_type=Path, file_okay=False), help="Folder for pictures.")
@click.option("--keypoints", "method", default=METHODS.default, show_default=True, help="Keypoint method.")
def main(out: Path | None, method: str) -> None:
    """Print distances and exchanged sides of each camera; exit code 1 where a bar is missed."""
    if not FOLDER.is_dir():
        sys.exit(f"the recording is absent: {FOLDER}")
    trc, good, params = read_trc(REFERENCE), True, METHODS.find(method).params
    click.echo("camera  median px  floor  shift out   90 %   " + "  ".join(f"{p:>10}" for p in OTHER))
    lines = []
    for camera in CAMERAS:
        result = compare(detected(camera, params), camera, trc)
        plain = compare(detected(camera, dataclasses.replace(params, sides=None)), camera, trc)
        found, before = runs(result.exchanged), runs(plain.exchanged)
        fine = result.median_px <= MOST_PX and max((n for _, n in found), default=0) <= MOST_FRAMES
        good &= fine
        click.echo(
            f"{camera}  {result.median_px:9.1f}  {np.nanmedian(result.floor_px):5.1f}  "
            f"{np.nanmedian(result.without_shift_px):9.1f}  {np.nanpercentile(result.error_px, 90):5.1f}   "
            + "  ".join(f"{v:10.1f}" for v in result.other_px.values())
            + f"   {'PASS' if fine else 'FAIL'}"
        )
        changed = result.keypoints.sides_changed
        assert changed is not None
        lines.append(
            f"{camera}: exchanged (first frame, frames) as detected {before or 'never'}, put back {found or 'never'}; "
            f"changed {int(changed[:, :2].any(axis=1).sum())}, without width {int(changed[:, 2].sum())} frames"
        )
        if out and before:
            out.mkdir(parents=True, exist_ok=True)
            rows = np.flatnonzero(plain.exchanged)
            shown = sorted({int(r) for r in rows[:: max(1, len(rows) // 7)]})
            image = picture(FOLDER / f"{camera}.mp4", plain.keypoints, result.keypoints, shown)
            cv2.imwrite(str(out / f"sides_{camera}.png"), image)
    click.echo("\n".join(lines))
    click.echo(f"bars (median {MOST_PX:g} px, {MOST_FRAMES} frames): {'PASS' if good else 'FAIL'}")
    sys.exit(0 if good else 1)


if __name__ == "__main__":
    main()
