"""The lens of the phone that recorded a video, and its calibration: measured, from the file, or published.

A phone stores pictures as its sensor lies, however it is held; the rotation flag states how a player has to turn them.
So a calibration measured in portrait also holds in landscape, turned by the difference of the two flags. It does not
hold for another size of the stored picture, frame rate or focal length in the file: then the phone reads another part
of its sensor, or zooms.

The published calibrations of phones' main cameras (`data/phone_cameras.json`, made by `research/phone_cameras.py`) hold
for the upright portrait picture of video of 720 or 2160 lines. Video of 16:9 uses the full width of the sensor's longer
side, so a recording of another size is taken as the same view scaled by its longer side, and one of another shape as
cropped (or widened) about the middle along the shorter side. The crop of a phone's stabilisation is not published; it
makes the focal length longer.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import math
import re
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np

from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError, said
from pbl_pipeline.results.video_facts import FirstPicture, VideoInfo

from .camera import guess_camera, load_camera, scaled_matrix
from .file_facts import probe
from .types import Camera

#: Standard deviation of a preset's focal length as a fraction of it, our estimate. The two recording formats that are
#: published of one phone differ by 1.2 % (iPhone 11) and 0.1 % (iPhone 12 Pro); the rest allows for the crop of
#: stabilised video, which the calibrated recordings did not have.
PRESET_REL_SD = 0.04
#: Lenses of a shorter physical focal length (mm) are front or ultra-wide cameras; the presets are of main cameras.
_SHORTEST_MAIN_MM = 3.0
_nameless = functools.partial(
    PblError,
    "CAMERA_INVALID",
    expected="the name of the phone, in the camera file of `pbl calibrate` or in an original recording (--like)",
    next_step="calibrate again with an original of the phone, pass --like RECORDING, or pass --camera with each "
    "video; converted copies lose the name",
)


def preset_camera(video: VideoInfo) -> Camera | None:
    """Published intrinsics of the phone that `video.model` names (Apple's name or identifier); None if there are none,
    or if `video.lens` is not its main camera."""
    known = presets()
    name = _plain(video.model)
    models = [m for m, n in known["names"].items() if name in (_plain(m), _plain(n))]
    cameras = [c for c in known["cameras"] if set(models) & set(c["models"])]
    if not cameras or not _is_main(video.lens):
        return None
    long_side = max(video.width_px, video.height_px)
    camera = min(cameras, key=lambda c: abs(math.log(max(c["size_px"]) / long_side)))
    (fx, fy), (cx, cy) = camera["focal_px"], camera["centre_px"]
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    distortion = np.array(camera["distortion"])
    width, height = camera["size_px"]
    for _ in range(_quarters(video)):
        matrix, distortion = quarter_turn(matrix, distortion, width)
        width, height = height, width
    factor = long_side / max(width, height)
    matrix = scaled_matrix(matrix, factor)
    matrix[0, 2] += (video.width_px - factor * width) / 2  # cut or widened about the middle
    matrix[1, 2] += (video.height_px - factor * height) / 2
    focal = (matrix[0, 0] + matrix[1, 1]) / 2
    same = f", from {camera['size_px'][0]}x{camera['size_px'][1]} px" if factor != 1 else ""
    cut = "" if abs(width * factor - video.width_px) + abs(height * factor - video.height_px) <= 2 else ", cut to shape"
    source = (
        f"preset: main camera of the {known['names'][models[0]]}, calibrated by OpenCap{same}{cut} "
        f"(focal length {focal:.0f} px +- {100 * PRESET_REL_SD:.0f} %; the phone's stabilisation may crop)"
    )
    return Camera(matrix, distortion, source, PRESET_REL_SD)


@functools.cache
def presets() -> dict[str, Any]:
    """Content of the data file: `source`, `names` (identifier to name), `cameras`."""
    return json.loads((files("pbl_pipeline.video") / "data" / "phone_cameras.json").read_text(encoding="utf-8"))


def quarter_turn(matrix: np.ndarray, distortion: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Intrinsics (3, 3) and (5,) after the picture, `width` px wide, is turned counter-clockwise by 90 degrees.

    A point (x, y) moves to (y, width - 1 - x); the tangential coefficients are swapped as the axes are.
    """
    k1, k2, p1, p2, k3 = distortion
    turned = np.array(
        [[matrix[1, 1], 0.0, matrix[1, 2]], [0.0, matrix[0, 0], width - 1 - matrix[0, 2]], [0.0, 0.0, 1.0]]
    )
    return turned, np.array([k1, k2, -p2, p1, k3])


def _quarters(video: VideoInfo) -> int:
    """Quarter turns (counter-clockwise) from the portrait picture to the recording's.

    The sensor lies along the phone: stored pictures are turned by 90 deg in portrait, by 0 or 180 in landscape, by 270
    on the phone's head. A flag that does not fit the shape is that of a copy whose pictures were turned.
    """
    portrait = video.width_px <= video.height_px
    if (video.rotation_deg in (90, 270)) != portrait:
        return 0 if portrait else 1
    return (90 - video.rotation_deg) // 90 % 4


def _is_main(lens: str | None) -> bool:
    if not lens:
        return True
    glass = re.search(r"([\d.]+)\s*mm", lens)
    short = glass is not None and float(glass[1]) < _SHORTEST_MAIN_MM
    return not short and not any(word in lens.lower() for word in ("front", "ultra", "tele"))


def _plain(text: str | None) -> str:
    return re.sub(r"\s+", " ", (text or "").strip()).casefold()


#: Rates (1/s) at which phones read their sensor; a recording has the nearest (24 and 25 to 30, 50 to 60).
RATES = (30, 60, 120, 240)
#: Focal lengths on 35 mm film that differ by more (mm) are of different lenses or zooms.
_SAME_FOCAL_MM = 0.5


@dataclasses.dataclass(frozen=True)
class PhoneLens:
    """A lens as its recordings describe it."""

    make: str  # these three: texts of the file, "" if it has none
    model: str
    lens: str
    stored_px: tuple[int, int]  # width and height before the rotation flag is applied
    rate: int  # the nearest of `RATES`
    focal_35mm: float | None = None  # focal length (mm) of the same view on 35 mm film, None if not stated

    def same_focal(self, focal_35mm: float | None) -> bool:
        """True if the focal length agrees with the lens's, or one of the two is not known."""
        known = self.focal_35mm is not None and focal_35mm is not None
        return not known or abs(self.focal_35mm - focal_35mm) <= _SAME_FOCAL_MM  # type: ignore[operator]

    @property
    def name(self) -> str:
        """Make, model and lens; the model is left out if the lens's name begins with it."""
        model = "" if self.lens.startswith(self.model) else self.model
        return " ".join(n for n in (self.make, model, self.lens) if n)

    def text(self) -> str:
        """Description in words."""
        return f"{self.name}, {self.stored_px[0]}x{self.stored_px[1]} px as stored, about {self.rate} frames a second"


def phone_lens(video: VideoInfo) -> PhoneLens | None:
    """Return the lens that recorded a probed video; None if the file names no model, or has no frame rate."""
    rate = video.capture_fps or video.fps
    if not video.model or not math.isfinite(rate) or rate <= 0:
        return None
    stored = _stored(video.width_px, video.height_px, video.rotation_deg)
    nearest = min(RATES, key=lambda r: abs(math.log(r / rate)))
    return PhoneLens(video.make or "", video.model, video.lens or "", stored, nearest, video.focal_35mm)


def turned_camera(camera: Camera, size_px: tuple[int, int], turn_deg: int) -> Camera:
    """Intrinsics after turning the picture of `size_px` (width, height) clockwise by 0, 90, 180 or 270 deg."""
    matrix, distortion, (width, height) = camera.matrix, camera.distortion, size_px
    for _ in range(-turn_deg // 90 % 4):  # counter-clockwise
        matrix, distortion = quarter_turn(matrix, distortion, width)
        width, height = height, width
    return dataclasses.replace(camera, matrix=matrix, distortion=distortion)


@dataclasses.dataclass(frozen=True)
class LensCalibration:
    """A calibration of a phone's lens."""

    lens: PhoneLens
    camera: Camera  # for the upright picture
    size_px: tuple[int, int]  # width and height of the upright picture
    rotation_deg: int  # rotation flag of the calibration video


def load_lens_calibration(path: str | Path, like: str | Path | None = None) -> LensCalibration:
    """Read a camera file and the phone that it belongs to.

    A file of `pbl calibrate` names the phone; for another file it is that of the recording `like`, whose upright
    picture must then be the calibrated one.

    Raises `PblError` CAMERA_INVALID: as `load_camera`, and a file or recording that does not name the phone's model.
    The VIDEO_ codes.
    """
    path = Path(path)
    if like is not None:
        info = probe(like)
        lens = phone_lens(info)
        if lens is None:
            raise _nameless("a recording that does not name the phone's model", key=like)
        size, rotation = (info.width_px, info.height_px), info.rotation_deg
    else:
        lens, size, rotation = _read(path)
    return LensCalibration(lens, load_camera(path, size), size, rotation)


def calibrated_camera(file: str | Path, video: FirstPicture) -> Camera:
    """Return the intrinsics in a calibration file, for the upright picture of a video.

    If the file states the rotation flag (`pbl calibrate` does) and the video has the other format (portrait,
    landscape), they are turned by the difference of the two flags; otherwise the other format is refused.

    Raises `PblError` CAMERA_INVALID: as `load_camera`, and a calibration of another phone, lens or zoom than the
    video's, where both state it.
    """
    content = _content(Path(file))
    _check_same_phone(content, video)
    turn = _turn_between(content, video)
    size = _stored(video.width_px, video.height_px, turn)  # before it is turned
    camera = load_camera(file, size)
    if turn:
        camera = dataclasses.replace(camera, source=f"{camera.source}, turned by {turn} deg")
    return turned_camera(camera, size, turn)


def _turn_between(content: Mapping[str, Any], video: FirstPicture) -> int:
    """Angle (deg, clockwise) from the calibrated picture to the video's. Flags that differ by a quarter turn in
    pictures of one format are those of a copy whose pictures were turned."""
    filmed, size = content.get("video"), content.get("image_size_px")
    measured = filmed.get("rotation_deg") if isinstance(filmed, Mapping) else None
    if measured not in (0, 90, 180, 270) or not _whole(size):
        return 0
    turn = (video.rotation_deg - measured) % 360
    other_format = (size[0] > size[1]) != (video.width_px > video.height_px)
    return turn if other_format == (turn in (90, 270)) else 0


def _whole(size: object) -> TypeGuard[list[int]]:
    return isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) for n in size)


def _check_same_phone(content: Mapping[str, Any], video: FirstPicture) -> None:
    measured = content.get("phone")
    if not isinstance(measured, Mapping):
        return
    for name, what in (("make", ""), ("model", ""), ("lens", ""), ("focal_35mm", " mm on 35 mm film")):
        theirs, ours = measured.get(name), getattr(video, name)
        if not theirs or not ours:
            continue
        if name == "focal_35mm":
            same = isinstance(theirs, (int, float)) and abs(theirs - ours) <= _SAME_FOCAL_MM
        else:
            same = str(theirs).casefold() == str(ours).casefold()
        if not same:
            raise PblError(
                "CAMERA_INVALID",
                found=said(
                    "a calibration of {theirs}, and a video of {ours}", theirs=f"{theirs}{what}", ours=f"{ours}{what}"
                ),
                expected="the calibration of the lens that recorded the video",
                next_step="pass the calibration of that lens with --camera, or none",
                key=video.path,
            )


def about_phone(video: VideoInfo) -> dict[str, Any]:
    """Fields of a camera file about the video that it was measured with, for `load_lens_calibration`."""
    lens = phone_lens(video)
    return {
        "video": {"name": Path(video.path).name, "sha256": video.sha256, "rotation_deg": video.rotation_deg},
        "phone": {
            **{name: getattr(video, name) for name in ("make", "model", "lens", "focal_35mm")},
            "rate": None if lens is None else lens.rate,
        },
        "recorded_utc": video.recorded_utc,
    }


def _read(path: Path) -> tuple[PhoneLens, tuple[int, int], int]:
    content = _content(path)
    if not content:
        load_camera(path, (1, 1))  # raises the error, unless it is a TOML
        raise _nameless("a camera file that names no phone", key=path)
    phone, video = content.get("phone"), content.get("video")
    if not isinstance(phone, Mapping) or not isinstance(video, Mapping) or not phone.get("model"):
        raise _nameless("a camera file that does not name the phone's model", key=path)
    rate, rotation, focal = phone.get("rate"), video.get("rotation_deg"), phone.get("focal_35mm")
    size = content.get("image_size_px")
    if rate not in RATES or rotation not in (0, 90, 180, 270) or not _whole(size):
        raise _nameless("a camera file without the phone's frame rate, rotation flag or size", key=path)
    names = [str(phone.get(n) or "") for n in ("make", "model", "lens")]
    width, height = int(size[0]), int(size[1])  # type: ignore[index]
    stored = _stored(width, height, rotation)
    film = float(focal) if isinstance(focal, (int, float)) and not isinstance(focal, bool) and focal > 0 else None
    return PhoneLens(names[0], names[1], names[2], stored, rate, film), (width, height), rotation


def _content(path: Path) -> dict[str, Any]:
    """Fields of a JSON file; empty if it is not one."""
    try:
        content = read_json(path)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _stored(width: int, height: int, rotation_deg: int) -> tuple[int, int]:
    return (height, width) if rotation_deg in (90, 270) else (width, height)


#: 35 mm film: width and diagonal of its frame (mm).
_FILM_WIDTH_MM, _FILM_DIAGONAL_MM = 36.0, math.hypot(36.0, 24.0)
#: Standard deviation of a focal length from the file's 35 mm equivalent, as a fraction of it: 2.3 % for its two
#: definitions, 1.1 % for its rounding to whole millimetres, and an allowance for a crop that it does not include. Of an
#: iPhone 13 it is 27 mm, that is 0.733 of the longer side; its published calibration has 0.732.
METADATA_REL_SD = 0.03


def find_camera(video: VideoInfo, file: str | Path | None = None) -> Camera:
    """Return the best known intrinsics of a probed video; `source` states their origin.

    In this order: the calibration `file`; the focal length that the phone wrote into the video; the published
    calibration of that model; a typical phone's (`guess_camera`).

    Raises `PblError` CAMERA_INVALID for a calibration that cannot be used (`calibrated_camera`).
    """
    if file is not None:
        return calibrated_camera(file, video)
    return metadata_camera(video) or preset_camera(video) or guess_camera(video)


def metadata_camera(video: VideoInfo) -> Camera | None:
    """Intrinsics from the file's focal length on 35 mm film (`focal_35mm`); None if it is missing or implausible.

    Two definitions are in use: the same angle of view along the diagonal (CIPA DCG-001), or along the longer side. In a
    picture of 16:9 the second is 5 % longer; their geometric mean is taken. The distortion is that of the phone's
    published calibration if its focal length agrees: then it is the same lens, not zoomed. Otherwise it is zero.
    """
    if video.focal_35mm is None or not 5 <= video.focal_35mm <= 500:
        return None
    long_side, diagonal = max(video.width_px, video.height_px), math.hypot(video.width_px, video.height_px)
    along, across = video.focal_35mm / _FILM_WIDTH_MM * long_side, video.focal_35mm / _FILM_DIAGONAL_MM * diagonal
    focal = math.sqrt(along * across)
    matrix = np.array([[focal, 0, (video.width_px - 1) / 2], [0, focal, (video.height_px - 1) / 2], [0, 0, 1]])
    camera = video.lens or " ".join(t for t in (video.make, video.model) if t)
    known = preset_camera(video)
    same = known is not None and abs(focal / known.focal_px - 1) <= 2 * math.hypot(METADATA_REL_SD, PRESET_REL_SD)
    distortion = known.distortion if known is not None and same else np.zeros(5)
    source = (
        f"metadata: {video.focal_35mm:g} mm on 35 mm film{f', {camera[:80]}' if camera else ''} (focal length "
        f"{focal:.0f} px +- {100 * METADATA_REL_SD:.0f} %, {'distortion of that model' if same else 'no distortion'})"
    )
    return Camera(matrix, distortion, source, METADATA_REL_SD)
