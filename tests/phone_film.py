"""Films a far scene with a phone that is held by hand, and writes what apps log meanwhile."""

import csv
import json
import zipfile
from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from pbl_pipeline.video import camera_in_device
from tests.inputs import LEVEL
from tests.videos import write_video

SIZE, FOCAL, FPS = (144, 256), 190.0, 30.0
#: Seconds since 1970 at which the log begins.
EPOCH_NS = 1_772_356_530_000_000_000


def hand(time_s: np.ndarray, seed: int = 4, deg: float = 1.5) -> Rotation:
    """R_nc of a level camera with the trembling and slow sway of a hand, at any times (s)."""
    rng = np.random.default_rng(seed)
    rates, phases = rng.uniform(0.3, 3.0, (3, 6)), rng.uniform(0, 2 * np.pi, (3, 6))
    sizes = deg / np.sqrt(6) / np.maximum(rates, 0.7)
    angles = np.sum(sizes[..., None] * np.sin(2 * np.pi * rates[..., None] * time_s + phases[..., None]), axis=1)
    return Rotation.from_quat(LEVEL, scalar_first=True) * Rotation.from_rotvec(angles.T, degrees=True)


def film(path: Path, begin_s: float, seconds: float, rotation_deg: int = 90, moving: bool = True, **options) -> Path:
    """A video of `hand` from `begin_s` on, in which somebody dark walks through the picture."""
    rng = np.random.default_rng(1)
    wide = 5
    scene = cv2.GaussianBlur(rng.integers(0, 255, (SIZE[1] * wide, SIZE[0] * wide)).astype(np.uint8), (0, 0), 5)
    scene = cv2.normalize(scene, None, 20, 235, cv2.NORM_MINMAX)  # type: ignore[call-overload]
    middle = np.array(SIZE) / 2 - 0.5
    camera = np.array([[FOCAL, 0, middle[0]], [0, FOCAL, middle[1]], [0, 0, 1]])
    back = np.array([[FOCAL, 0, SIZE[0] * wide / 2], [0, FOCAL, SIZE[1] * wide / 2], [0, 0, 1]])
    times = np.arange(round(seconds * FPS)) / FPS
    turns = hand(begin_s + (times if moving else 0 * times))
    straight = Rotation.from_quat(LEVEL, scalar_first=True)

    def frames():
        for t, turn in zip(times, turns, strict=True):
            # A far point seen along `ray` in the picture lies along R_ref^-1 R_nc ray in the scene.
            to_scene = back @ (straight.inv() * turn).as_matrix() @ np.linalg.inv(camera)
            picture = cv2.warpPerspective(scene, to_scene, SIZE, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            x = int(20 + 100 * t / times[-1])
            cv2.rectangle(picture, (x, 90), (x + 22, 200), 15, -1)
            yield cv2.merge([picture] * 3)

    return write_video(path, frames(), times, rotation_deg=rotation_deg, crf=20, **options)


def device_quat(turns: Rotation, turned_deg: float = 0.0) -> np.ndarray:
    """(P, 4) device to world, w first, of a phone whose camera is turned so and which was turned from portrait."""
    return (turns * camera_in_device(turned_deg).inv()).as_quat(scalar_first=True)


def sensor_logger(
    folder: Path, seconds: float, turned_deg: float = 0.0, begin_s: float = 0.0, rate: float = 100.0
) -> Path:
    """The folder that Sensor Logger exports: Orientation, Gravity (iOS: downwards), Gyroscope, Metadata."""
    folder.mkdir(parents=True, exist_ok=True)
    elapsed = 0.013 + np.arange(round(seconds * rate)) / rate
    ns = EPOCH_NS + np.round(elapsed * 1e9).astype(np.int64)
    quat = device_quat(hand(begin_s + elapsed), turned_deg)
    matrix = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    pitch = np.arcsin(matrix[:, 2, 1])
    rows = [
        [n, f"{e:.6f}", *(f"{q:.9f}" for q in (z, y, x, w)), 0.0, f"{p:.9f}", 0.0]
        for n, e, (w, x, y, z), p in zip(ns, elapsed, quat, pitch, strict=True)
    ]
    _csv(folder / "Orientation.csv", "time,seconds_elapsed,qz,qy,qx,qw,roll,pitch,yaw", rows)
    down = -9.80665 * matrix[:, 2, :]
    _csv(
        folder / "Gravity.csv",
        "time,seconds_elapsed,z,y,x",
        [[n, e, *g[::-1]] for n, e, g in zip(ns, elapsed, down, strict=True)],
    )
    _csv(
        folder / "Gyroscope.csv",
        "time,seconds_elapsed,z,y,x",
        [[n, e, 0.0, 0.1, 0.2] for n, e in zip(ns, elapsed, strict=True)],
    )
    _csv(
        folder / "Metadata.csv",
        "version,device name,recording epoch time,platform",
        [[3, "A phone", EPOCH_NS // 10**6, "ios"]],
    )
    return folder


def as_zip(folder: Path) -> Path:
    path = folder.with_suffix(".zip")
    with zipfile.ZipFile(path, "w") as archive:
        for file in folder.iterdir():
            archive.write(file, f"2026-03-01_09-15-30/{file.name}")
    return path


def as_json(folder: Path) -> Path:
    rows = []
    for file in sorted(folder.glob("*.csv")):
        with file.open() as lines:
            rows += [{"sensor": file.stem, **row} for row in csv.DictReader(lines)]
    path = folder.with_suffix(".json")
    path.write_text(json.dumps(rows))
    return path


def _csv(path: Path, head: str, rows: list) -> None:
    path.write_text("\n".join([head, *(",".join(map(str, r)) for r in rows)]) + "\n")
