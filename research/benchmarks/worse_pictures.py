"""Tolerance for dark, blurred and small pictures: recordings made worse, and how far the detected points move.

    python -m research.benchmarks.worse_pictures                    # walk, demo, cam01
    python -m research.benchmarks.worse_pictures --clip demo        # needs the demo recording only
    python -m research.benchmarks.worse_pictures --clip demo --index  # darkened files through the whole chain

The others are `../shared/data/real`'s walk and cam01 (README there: source and licence). Each is tracked once, then
its frames are made worse on the way to the landmark network, along the same track and crops. Prints, for each change:
what `check_keypoints` measures of the picture and how it judges, the median way of the points against the clean
recording in % of the trunk, and the shares of points that moved by more than 20 % of it or were not found any more. The
thresholds of `keypoints/quality_checks.py` were read from this table (research/reports).

`--index` prints another table: of each clip, darkened as a file and detected by the default methods, the brightness,
how the check judges it, and the index.
"""

from __future__ import annotations

import dataclasses
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest import mock

import click
import cv2
import numpy as np

from pbl_pipeline import assets
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS as FIT_METHODS
from pbl_pipeline.keypoints import METHODS as KEYPOINT_METHODS
from pbl_pipeline.keypoints import KeypointParams, Keypoints, check_keypoints, detect_keypoints
from pbl_pipeline.keypoints import detect as detection
from pbl_pipeline.tracking import PersonTrack, choose_subject, track_people
from pbl_pipeline.video import Frame, guess_camera, probe, read_frames
from research.benchmarks.picture_size import fitted, index_of
from research.clip_keypoints import clip_keypoints
from research.paths import SHARED
from tests.videos import write_video

CLIPS = {
    "walk": SHARED / "real" / "video_mocap" / "walk" / "video.mp4",
    "demo": None,
    **{f"cam{i:02d}": SHARED / "real" / "multiview" / f"cam{i:02d}.mp4" for i in range(1, 5)},
}
#: Sensor noise (standard deviation in grey levels) that stays where light goes.
NOISE = 2.0
LIGHT = (0.5, 0.25, 0.12, 0.06, 0.03)
#: Of those, the ones in which people are still found; between them a threshold is looked for.
LIGHT_INDEX = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.12)
#: Shares of the body's height: length of a blur along x, standard deviation of a blur in all directions.
MOTION, FOCUS = (0.02, 0.04, 0.08, 0.12, 0.2), (0.005, 0.01, 0.02, 0.04)
#: Body heights in px.
HEIGHTS_PX = (400, 200, 120, 80, 50, 30)
#: A point that moves further than this share of the trunk is lost.
LOST = 0.2


@dataclasses.dataclass(frozen=True)
class Change:
    """A name and what is done to a frame, (H, W, 3) uint8 to the same; `shrink` by how much the person gets smaller."""

    name: str
    apply: Callable[[np.ndarray], np.ndarray]
    shrink: float = 1.0


def darkened(gain: float) -> Callable[[np.ndarray], np.ndarray]:
    """Return what multiplies a frame's light and adds the sensor's noise."""
    rng = np.random.default_rng(0)
    return lambda i: np.clip(np.rint(i * gain + rng.normal(0, NOISE, i.shape)), 0, 255).astype(np.uint8)


def changes(body_px: float) -> Iterator[Change]:
    """All changes for a person of that height, the clean picture first."""

    def smaller(scale: float) -> Callable[[np.ndarray], np.ndarray]:
        def apply(image: np.ndarray) -> np.ndarray:
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            return cv2.resize(small, image.shape[1::-1], interpolation=cv2.INTER_LINEAR)

        return apply

    yield Change("clean", lambda i: i)
    for gain in LIGHT:
        yield Change(f"light x {gain:g}", darkened(gain))
    for share in MOTION:
        length = max(1, round(share * body_px))
        yield Change(f"blur along x {share:.0%}", lambda i, n=length: cv2.blur(i, (n, 1)))
    for share in FOCUS:
        yield Change(f"focus sd {share:.1%}", lambda i, s=share * body_px: cv2.GaussianBlur(i, (0, 0), s))
    for height in HEIGHTS_PX:
        if height < body_px:
            yield Change(f"body of {height} px", smaller(height / body_px), height / body_px)


def moved(found: Keypoints, clean: Keypoints) -> tuple[float, float, float]:
    """Median way of the points (share of the trunk), share that is lost, share not found; of those sure when clean."""
    names = clean.names
    ends = [
        np.mean([clean.xy_px[:, names.index(f"{side}_{end}")] for side in ("left", "right")], axis=0)
        for end in ("shoulder", "hip")
    ]
    trunk = float(np.nanmedian(np.linalg.norm(ends[0] - ends[1], axis=1)))
    way = (np.linalg.norm(found.xy_px - clean.xy_px, axis=-1) / trunk)[clean.confidence > 0.5]
    there = np.isfinite(way)
    if not there.any():
        return float("nan"), float("nan"), 1.0
    return float(np.median(way[there])), float(np.mean(way[there] > LOST)), float(np.mean(~there))


def run(name: str, path: Path) -> None:
    """Print the table of one clip."""
    info = probe(path)
    tracking = track_people(path, info=info)
    person = choose_subject(tracking).person_id
    assert person is not None
    track: PersonTrack = next(p for p in tracking.persons if p.person_id == person)
    box = track.box_px[np.isfinite(track.box_px).all(axis=1)]
    body_px = float(np.median(np.max(box[:, 2:] - box[:, :2], axis=1)))
    click.echo(f"\n{name}: a person of {body_px:.0f} px")
    click.echo(f"{'':22}{'bright':>8}{'detail':>8}{'height':>8}{'moved':>8}{'lost':>7}{'gone':>7}")
    clean: Keypoints | None = None
    for change in changes(body_px):

        def worse(*args, change: Change = change, **options) -> Iterator[Frame]:
            for frame in read_frames(*args, **options):
                image = change.apply(frame.image)
                yield Frame(frame.index, frame.time_s, lambda image=image: image)

        with mock.patch.object(detection, "read_frames", worse):
            found = detect_keypoints(path, tracking, person, guess_camera(info), KeypointParams())
        clean = clean or found
        way, lost, gone = moved(found, clean)
        checks = {c.check: c for c in check_keypoints(found)}
        cells = []
        for check, unit in (
            ("picture_brightness", 1.0),
            ("picture_detail_share", 100.0),
            ("body_height_px", change.shrink),
        ):
            c = checks.get(check)
            # The height is judged as it would be in a picture of that size.
            cells.append("       -" if c is None or c.value is None else f"{unit * c.value:7.1f}{_mark(c.outcome)}")
        click.echo(f"{change.name:22}{''.join(cells)}{100 * way:7.1f}%{100 * lost:6.0f}%{100 * gone:6.0f}%")


def index_in_the_dark(name: str, path: Path) -> None:
    """Print brightness and index of a clip in less and less light."""
    times = [f.time_s for f in read_frames(path)]
    click.echo(f"\n{name}\n{'':22}{'bright':>8}{'index':>8}")
    for gain in LIGHT_INDEX:
        with tempfile.TemporaryDirectory() as scratch:
            video, change = path, darkened(gain)
            if gain < 1:
                video = Path(scratch) / "video.mp4"
                write_video(video, (change(f.image) for f in read_frames(path)), times, crf=16)
            try:
                found = clip_keypoints(video, Path(scratch) / "people.png", KEYPOINT_METHODS.find())
                bright = next(c for c in check_keypoints(found) if c.check == "picture_brightness")
                cells = f"{bright.value:7.1f}{_mark(bright.outcome)}"
                cells += f"{index_of(fitted(name, found, FIT_METHODS.find())):8.1f}"
            except PblError as error:
                cells = error.code
        click.echo(f"light x {gain:<14g}{cells}")


def _mark(outcome: str) -> str:
    return {"PASS": " ", "WARN": "w", "FAIL": "F"}[outcome]


@click.command()
@click.option(
    "--clip",
    "clips",
    multiple=True,
    type=click.Choice(list(CLIPS)),
    default=["walk", "demo", "cam01"],
    show_default=True,
)
@click.option("--index", is_flag=True, help="Print the index of darkened files.")
def main(clips: tuple[str, ...], index: bool) -> None:
    """Print how the points of the clips move when the picture is made worse."""
    for name in clips:
        path = CLIPS[name] or Path(assets.fetch("demo_video"))
        if not path.exists():
            sys.exit(f"the recording is absent: {path}")
        (index_in_the_dark if index else run)(name, path)
    click.echo("\nw: WARN, F: FAIL (the height is not judged: the picture was made as large again as it was)")


if __name__ == "__main__":
    main()
