"""Which lens of which phone recorded a video, and the calibration of one that serves all its recordings.

A phone stores pictures as its sensor lies, however it is held, and states by the rotation flag how a player has to turn
them. So a lens that was measured in portrait serves in landscape as well, turned by the difference of the two flags. It
does not serve another size of the stored picture, another rate of frames or another focal length in the file: there the
phone reads another part of its sensor, or zooms.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeGuard

from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError

from .camera import load_camera
from .file_facts import probe
from .presets import quarter_turn
from .types import Camera, FirstPicture, VideoInfo

#: Rates (1/s) at which phones read their sensor; a recording belongs to the nearest (24 and 25 to 30, 50 to 60).
RATES = (30, 60, 120, 240)
#: Figures of 35 mm film that differ by more (mm) are different lenses or zooms.
_SAME_FOCAL_MM = 0.5


@dataclasses.dataclass(frozen=True)
class PhoneLens:
    """A lens as its recordings name it.

    make, model, lens: texts of the file, "" where it has none. stored_px: width and height before the rotation flag is
    applied. rate: the nearest of `RATES`. focal_35mm: of the same view on 35 mm film (mm), None if not stated.
    """

    make: str
    model: str
    lens: str
    stored_px: tuple[int, int]
    rate: int
    focal_35mm: float | None = None

    def same_focal(self, focal_35mm: float | None) -> bool:
        """Whether this figure is not another than the lens's; one that is not known is none."""
        known = self.focal_35mm is not None and focal_35mm is not None
        return not known or abs(self.focal_35mm - focal_35mm) <= _SAME_FOCAL_MM  # type: ignore[operator]

    @property
    def name(self) -> str:
        """Make, model and lens; phones begin the lens's name with the model."""
        model = "" if self.lens.startswith(self.model) else self.model
        return " ".join(n for n in (self.make, model, self.lens) if n)

    def text(self) -> str:
        """In words."""
        return f"{self.name}, {self.stored_px[0]}x{self.stored_px[1]} px as stored, about {self.rate} frames a second"


def phone_lens(video: VideoInfo) -> PhoneLens | None:
    """The lens that recorded a probed video; None where the file names no model, or has no rate of frames."""
    rate = video.capture_fps or video.fps
    if not video.model or not math.isfinite(rate) or rate <= 0:
        return None
    stored = _stored(video.width_px, video.height_px, video.rotation_deg)
    nearest = min(RATES, key=lambda r: abs(math.log(r / rate)))
    return PhoneLens(video.make or "", video.model, video.lens or "", stored, nearest, video.focal_35mm)


def turned_camera(camera: Camera, size_px: tuple[int, int], turn_deg: int) -> Camera:
    """The intrinsics after the picture of `size_px` (width, height) is turned clockwise by 0, 90, 180 or 270 deg."""
    matrix, distortion, (width, height) = camera.matrix, camera.distortion, size_px
    for _ in range(-turn_deg // 90 % 4):  # counter-clockwise
        matrix, distortion = quarter_turn(matrix, distortion, width)
        width, height = height, width
    return dataclasses.replace(camera, matrix=matrix, distortion=distortion)


@dataclasses.dataclass(frozen=True)
class LensCalibration:
    """A calibration of a phone's lens: `camera` for the upright picture of `size_px` (width, height), which was stored
    turned by `rotation_deg` (the flag of the calibration video)."""

    lens: PhoneLens
    camera: Camera
    size_px: tuple[int, int]
    rotation_deg: int


def load_lens_calibration(path: str | Path, like: str | Path | None = None) -> LensCalibration:
    """A camera file together with the phone that it is of.

    The phone stands in a file of `pbl calibrate`; of another file it is that of the recording `like`, whose upright
    picture the calibration then must be of.

    Raises `PblError` CAMERA_INVALID: what `load_camera` refuses, and a file or recording that does not name the phone's
    model. The VIDEO_ codes.
    """
    path = Path(path)
    if like is not None:
        info = probe(like)
        lens = phone_lens(info)
        if lens is None:
            raise _nameless(like, "a recording that does not name the phone's model")
        size, rotation = (info.width_px, info.height_px), info.rotation_deg
    else:
        lens, size, rotation = _read(path)
    return LensCalibration(lens, load_camera(path, size), size, rotation)


def calibrated_camera(file: str | Path, video: VideoInfo | FirstPicture) -> Camera:
    """The intrinsics in a calibration file, for the upright picture of a video.

    Where the file says how the phone was held (`pbl calibrate` does) and the video is of the other format, they are
    turned by the difference of the two rotation flags. What does not fit without being turned is else refused.

    Raises `PblError` CAMERA_INVALID: as `load_camera`, and a calibration of another phone, lens or zoom than the
    video's; what one of them does not say is no difference.
    """
    content = _content(Path(file))
    _check_same_phone(content, video)
    turn = _turn_between(content, video)
    size = _stored(video.width_px, video.height_px, turn)  # before it is turned
    camera = load_camera(file, size)
    if turn:
        camera = dataclasses.replace(camera, source=f"{camera.source}, turned by {turn} deg")
    return turned_camera(camera, size, turn)


def _turn_between(content: Mapping[str, Any], video: VideoInfo | FirstPicture) -> int:
    """How far (deg, clockwise) the calibrated picture has to be turned to be the video's. Flags that differ by a
    quarter in pictures of one format are those of a copy whose pictures were turned."""
    filmed, size = content.get("video"), content.get("image_size_px")
    measured = filmed.get("rotation_deg") if isinstance(filmed, Mapping) else None
    if measured not in (0, 90, 180, 270) or not _whole(size):
        return 0
    turn = (video.rotation_deg - measured) % 360
    other_format = (size[0] > size[1]) != (video.width_px > video.height_px)
    return turn if other_format == (turn in (90, 270)) else 0


def _whole(size: object) -> TypeGuard[list[int]]:
    return isinstance(size, list) and len(size) == 2 and all(isinstance(n, int) for n in size)


def _check_same_phone(content: Mapping[str, Any], video: VideoInfo | FirstPicture) -> None:
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
                found=f"a calibration of {theirs}{what}, and a video of {ours}{what}",
                expected="the calibration of the lens that recorded the video",
                next_step="pass the calibration of that lens with --camera, or none",
                key=video.path,
            )


def about_phone(video: VideoInfo) -> dict[str, Any]:
    """What a camera file says of the video that it was measured with, for `load_lens_calibration`."""
    lens = phone_lens(video)
    return {
        "video": {"name": Path(video.path).name, "sha256": video.sha256, "rotation_deg": video.rotation_deg},
        "phone": {
            "make": video.make,
            "model": video.model,
            "lens": video.lens,
            "focal_35mm": video.focal_35mm,
            "rate": None if lens is None else lens.rate,
        },
        "recorded_utc": video.recorded_utc,
    }


def _read(path: Path) -> tuple[PhoneLens, tuple[int, int], int]:
    content = _content(path)
    if not content:
        load_camera(path, (1, 1))  # says what is wrong with it, unless it is a TOML
        raise _nameless(path, "a camera file that names no phone")
    phone, video = content.get("phone"), content.get("video")
    if not isinstance(phone, Mapping) or not isinstance(video, Mapping) or not phone.get("model"):
        raise _nameless(path, "a camera file that does not name the phone's model")
    rate, rotation, focal = phone.get("rate"), video.get("rotation_deg"), phone.get("focal_35mm")
    size = content.get("image_size_px")
    if rate not in RATES or rotation not in (0, 90, 180, 270) or not _whole(size):
        raise _nameless(path, "a camera file without the phone's rate of frames, rotation flag or size")
    names = [str(phone.get(n) or "") for n in ("make", "model", "lens")]
    width, height = int(size[0]), int(size[1])  # type: ignore[index]
    stored = _stored(width, height, rotation)
    film = float(focal) if isinstance(focal, (int, float)) and not isinstance(focal, bool) and focal > 0 else None
    return PhoneLens(names[0], names[1], names[2], stored, rate, film), (width, height), rotation


def _content(path: Path) -> dict[str, Any]:
    """The fields of a JSON file; none where it is no such file."""
    try:
        content = read_json(path)
    except (OSError, ValueError):
        return {}
    return content if isinstance(content, dict) else {}


def _stored(width: int, height: int, rotation_deg: int) -> tuple[int, int]:
    return (height, width) if rotation_deg in (90, 270) else (width, height)


def _nameless(path: str | Path, found: str) -> PblError:
    return PblError(
        "CAMERA_INVALID",
        found=found,
        expected="a phone that is named: by the camera file of `pbl calibrate`, or by an original recording (--like)",
        next_step="calibrate again with an original of the phone, pass --like RECORDING, or pass --camera with each "
        "video; converted copies lose the name",
        key=path,
    )
