"""Recordings of the app Record3D (`.r3d`): a zip of pictures, depths (LZFSE, float32 metres) and confidences (LZFSE,
bytes 0 to 2). `metadata` is JSON: `dw`, `dh` and `w`, `h` (px) of the depth and colour pictures, `K` by columns of the
colour picture, `fps`, and `frameTimestamps` (s) of newer versions.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from pbl_pipeline import bounded
from pbl_pipeline.extras import needed

from .packed import Get, names_in, opened
from .recording import Depth, Pictures, depth_error

#: Bytes of a packed frame and of the metadata.
_MOST = bounded.MIB


def read_record3d(path: Path, size_px: tuple[int, int], called: Path | None = None) -> Depth:
    """Read a recording beside a video with pictures of this width and height; `called`: its name in errors. Raises
    `PblError` DEPTH_FILE; PACKAGE_MISSING without the extra `depth`."""
    shown = called or path
    lzfse = needed("lzfse", "the depths of Record3D")

    def read(frames: Iterable[int]) -> Iterator[Pictures]:
        with opened(path) as get:
            for i in frames:
                confidence = members[i].removesuffix("depth") + "conf"
                depth = picture(get, members[i], "<f4")
                yield depth, picture(get, confidence, np.uint8) if confidence in names else None

    def picture(get: Get, name: str, kind: str | type) -> np.ndarray:
        try:
            return np.frombuffer(lzfse.decompress(get(name, _MOST)), kind).reshape(height, width)
        except (OSError, ValueError, lzfse.error, *bounded.DAMAGED) as error:
            raise depth_error(f"{name}: {error}", f"{width}x{height} values", key=shown) from error

    try:
        names = set(names_in(path))
        with opened(path) as get:
            about = bounded.parse_json(get("metadata", _MOST).decode())
        numbers = {int(m[1]): n for n in names if (m := re.fullmatch(r"rgbd/(\d{1,9})\.depth", n))}
        width, height = int(about["dw"]), int(about["dh"])
        matrix = np.array(about["K"], float).reshape(3, 3).T
        matrix[:2] *= [[size_px[0] / about["w"]], [size_px[1] / about["h"]]]
        order = sorted(numbers)
        members = [numbers[i] for i in order]
        stamps = np.array(about.get("frameTimestamps") or np.arange(len(members)) / float(about["fps"]), float)
        if not members or stamps.ndim != 1 or order[-1] >= len(stamps):
            raise ValueError(f"{len(members)} depths up to {order[-1:]} and {np.shape(stamps)} times")
    except (OSError, ValueError, KeyError, TypeError, ZeroDivisionError, *bounded.DAMAGED) as error:
        raise depth_error(f"no recording of Record3D ({error})", "the .r3d that the app exports", key=shown) from error
    return Depth(shown, stamps[order] - stamps[0], size_px, matrix, None, read)
