"""Overlay of the fitted body on the recording: a video that browsers play, and single frames for the report."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from pbl_pipeline import progress
from pbl_pipeline.body import Body, capsules, load_body
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import complete_file
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.render.drawing import Strip, capsule_outline, draw_body, draw_keypoints, to_camera
from pbl_pipeline.video import Frame, read_frames, scaled_matrix, write_h264

if TYPE_CHECKING:
    from pbl_pipeline.gait import GaitEvent

_BLOCK = 64  # frames whose capsules are computed and kept at a time
_changed = functools.partial(
    PblError, "VIDEO_CHANGED", next_step="use the recording that the fit was made from, or run the chain on this one"
)


class _Painter:
    """Draws the body and keypoints of one trial into its frames, at any size of the picture."""

    def __init__(self, fit: TrialFit, keypoints: Keypoints | None) -> None:
        if keypoints is not None and len(keypoints.time_s) != len(fit.time_s):
            raise PblError(
                "FILE_FORMAT",
                found=f"{len(keypoints.time_s)} frames of keypoints for {len(fit.time_s)} fitted frames",
                expected="keypoints and fit of the same video",
                next_step="pass the keypoints.npz this fit was made from",
                key=fit.name,
            )
        body = load_body()
        check_body(fit, body)
        self.fit, self._keypoints = fit, keypoints
        self._known = _known(fit)
        self._body, self._block, self._capsules = body, -1, None

    def _pose(self, index: int) -> tuple[tuple[str, ...], np.ndarray, np.ndarray, np.ndarray]:
        """Body names, starts, ends and radii of the capsules in one frame; computed in blocks to limit the memory."""
        block, row = divmod(index, _BLOCK)
        if self._capsules is None or block != self._block:
            part = self.fit.qpos[block * _BLOCK : (block + 1) * _BLOCK]
            self._capsules, self._block = capsules(self._body, part, self.fit.scale), block
        c = self._capsules
        return c.body_names, c.start[row], c.end[row], c.radius_m

    def known(self, index: int) -> bool:
        return index < len(self._known) and bool(self._known[index])

    def box_px(self, index: int) -> np.ndarray | None:
        """x0, y0, x1, y1 around the drawn body in the full-size frame; None if nothing of it is drawn."""
        if not self.known(index):
            return None
        _, start_m, end_m, radius = self._pose(index)
        quat, position = self.fit.phone_quat_wxyz[index], self.fit.camera_position_m
        start, end = to_camera(start_m, quat, position), to_camera(end_m, quat, position)
        outlines = [capsule_outline(start[g], end[g], float(radius[g]), self.fit.camera) for g in range(len(radius))]
        points = [o for o in outlines if o is not None]
        if not points:
            return None
        every = np.concatenate(points)
        return np.concatenate([every.min(0), every.max(0)])

    def paint(self, image: np.ndarray, index: int) -> None:
        """Draw the state of frame `index` into `image` (any size, the whole frame), in place."""
        width, height = self.fit.image_size_px
        fx, fy = image.shape[1] / width, image.shape[0] / height
        if self.known(index):
            camera = dataclasses.replace(self.fit.camera, matrix=scaled_matrix(self.fit.camera.matrix, (fx, fy)))
            quat, position = self.fit.phone_quat_wxyz[index], self.fit.camera_position_m
            draw_body(image, *self._pose(index), quat, position, camera)
        if self._keypoints is not None and index < len(self._keypoints.time_s):
            xy = (np.asarray(self._keypoints.xy_px[index], float) + 0.5) * [fx, fy] - 0.5
            draw_keypoints(image, xy, self._keypoints.confidence[index])


def check_body(fit: TrialFit, body: Body) -> None:
    """Raise `PblError` FILE_FORMAT for a fit that was made with another body model than this one."""
    if fit.body_sha256 != body.sha256:
        raise PblError(
            "FILE_FORMAT",
            found=f"a fit made with the body model {fit.body_sha256[:12]}",
            expected=f"the installed body model {body.sha256[:12]} ({body.name} {body.version})",
            next_step="fit the trial again with this version, or install the version that made the fit",
            key=fit.name,
        )


def render_overlay(
    video_path: str | Path,
    fit: TrialFit,
    out_path: str | Path,
    keypoints: Keypoints | None = None,
    *,
    events: Sequence[GaitEvent] = (),
    max_side_px: int = 1280,
) -> Path:
    """Write the recording with the fitted body over it as H.264 in MP4, and return its path.

    Every frame of the video that the fit has is in the output at its own time stamp (variable frame rate is kept); one
    without a pose shows the bare picture. A strip below the picture shows the knee flexion of both sides, the foot
    contacts and the time. Memory does not grow with the length of the video.

    Raises `PblError` VIDEO_* if the video cannot be read; VIDEO_CHANGED if its frames are not those of the fit;
    FILE_FORMAT if the keypoints are of another video.

    Parameters
    ----------
    fit
        One trial; its frames are those of the video.
    out_path
        An .mp4 file; it appears under this name when it is complete.
    events
        Foot contacts of this trial, `GaitEvents.events`.
    max_side_px
        The picture is scaled down until its longer side is at most this.
    """
    out_path = Path(out_path)
    painter = _Painter(fit, keypoints)
    width, height = _even_size(fit.image_size_px, max_side_px)
    strip_height = 2 * max(40, round(0.08 * height))
    strip = Strip(fit, events, width, strip_height)
    out_path.parent.mkdir(parents=True, exist_ok=True)
    count = 0

    def pictures() -> Iterator[tuple[float, np.ndarray]]:
        nonlocal count
        frames = _frames(video_path, fit)
        for row, frame in progress.track(frames, f"overlay {fit.name}", total=len(fit.time_s)):
            picture = np.empty((height + strip_height, width, 3), np.uint8)
            same = frame.image.shape[:2] == (height, width)
            picture[:height] = frame.image if same else _resized(frame.image, (width, height))
            painter.paint(picture[:height], row)
            picture[height:] = strip.frame(frame.time_s)
            count += 1
            yield frame.time_s, picture

    with complete_file(out_path) as part:
        write_h264(part, pictures(), (width, height + strip_height), fit.time_s, crf=23)
        if count != len(fit.time_s):
            raise _changed(f"{count} frames", f"{len(fit.time_s)} frames, as when it was fitted", key=video_path)
    return out_path


def overlay_frames(
    video_path: str | Path | None,
    fit: TrialFit,
    indices: Sequence[int],
    keypoints: Keypoints | None = None,
    *,
    max_side_px: int = 1280,
    crop_to_body: bool = False,
) -> list[np.ndarray]:
    """Frames `indices` with the fitted body drawn, in this order: BGR pictures (H, W, 3) uint8. Without a video the
    body is drawn on white.

    `crop_to_body` crops each picture to the drawn person with a margin (4:3 if the frame allows it); a frame without a
    fit stays whole. The longer side is then scaled down to at most `max_side_px`.

    Raises `PblError` as `render_overlay`; USAGE if a frame does not exist.
    """
    wanted = sorted({int(i) for i in indices})
    if wanted and (wanted[0] < 0 or wanted[-1] >= len(fit.time_s)):
        raise PblError(
            "USAGE",
            found=f"frames {wanted}",
            expected=f"frames 0 to {len(fit.time_s) - 1}",
            next_step="ask for frames of this video",
            key=fit.name,
        )
    painter = _Painter(fit, keypoints)
    pictures: dict[int, np.ndarray] = {}
    for index, image in _images(video_path, fit, wanted):
        painter.paint(image, index)
        if crop_to_body and painter.known(index):
            image = _crop(image, painter.box_px(index))
        scale = max_side_px / max(image.shape[:2])
        if scale < 1:
            image = _resized(image, (round(image.shape[1] * scale), round(image.shape[0] * scale)))
        pictures[index] = np.ascontiguousarray(image)
    missing = [i for i in wanted if i not in pictures]
    if missing:
        raise _changed(f"no frame {missing[0]}", f"{len(fit.time_s)} frames, as when it was fitted", key=video_path)
    return [pictures[int(i)] for i in indices]


def _images(video_path: str | Path | None, fit: TrialFit, indices: Sequence[int]) -> Iterator[tuple[int, np.ndarray]]:
    if video_path is None:
        yield from ((i, np.full((*reversed(fit.image_size_px), 3), 255, np.uint8)) for i in indices)
    elif indices:
        for row, frame in _frames(video_path, fit, indices[-1]):
            if row in indices:
                yield row, frame.image.copy()


def report_indices(fit: TrialFit) -> list[int]:
    """Frames for the report: three of those with a known fit, or fewer, evenly spread, not at the very ends."""
    known = np.flatnonzero(_known(fit))
    if not len(known):
        return []
    picks = known[np.rint((np.arange(3) + 0.5) / 3 * (len(known) - 1)).astype(int)]
    return sorted({int(i) for i in picks})


def _known(fit: TrialFit) -> np.ndarray:
    """(T,) bool: frames whose pose and camera orientation are known."""
    state = np.concatenate([fit.qpos, fit.phone_quat_wxyz], axis=1)
    return np.asarray(np.isfinite(state).all(axis=1), bool)


def _even_size(size: tuple[int, int], max_side_px: int) -> tuple[int, int]:
    """Size scaled down to the longest side allowed, both sides even, as 4:2:0 colour requires."""
    scale = min(1.0, max_side_px / max(size))
    return max(2, 2 * round(size[0] * scale / 2)), max(2, 2 * round(size[1] * scale / 2))


def _resized(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    # Averaging areas is slow and needed only if pixels would be skipped.
    way = cv2.INTER_AREA if size[0] < 0.6 * image.shape[1] else cv2.INTER_LINEAR
    return cv2.resize(image, (max(1, size[0]), max(1, size[1])), interpolation=way)


def _crop(image: np.ndarray, box_px: np.ndarray | None) -> np.ndarray:
    """Part of the picture around the box: 4:3, the body four fifths of its height, within the picture."""
    if box_px is None:
        return image
    height, width = image.shape[:2]
    box = np.clip(box_px, 0, [width, height, width, height])
    if box[2] - box[0] < 2 or box[3] - box[1] < 2:
        return image
    h = min(max((box[3] - box[1]) / 0.8, (box[2] - box[0]) / 0.8 * 0.75), height)
    w = min(h * 4 / 3, width)
    x0 = round(float(np.clip((box[0] + box[2] - w) / 2, 0, width - w)))
    y0 = round(float(np.clip((box[1] + box[3] - h) / 2, 0, height - h)))
    return image[y0 : y0 + round(h), x0 : x0 + round(w)]


def _frames(video_path: str | Path, fit: TrialFit, last: int | None = None) -> Iterator[tuple[int, Frame]]:
    """Rows of the fit, until row `last`, and their frames. Raises `PblError` VIDEO_CHANGED."""
    number = fit.frame_numbers
    for frame in read_frames(video_path, stop=None if last is None else int(number[last]) + 1):
        size, was = (frame.image.shape[1], frame.image.shape[0]), tuple(fit.image_size_px)
        if size != was:
            raise _changed(f"a frame of {size} px", f"{was} px, as when it was fitted", key=video_path)
        if frame.index > number[-1]:
            expected = f"{int(number[-1]) + 1} frames, as when it was fitted"
            raise _changed(f"a frame {frame.index}", expected, key=video_path)
        row = int(np.searchsorted(number, frame.index))
        if number[row] == frame.index:
            yield row, frame
