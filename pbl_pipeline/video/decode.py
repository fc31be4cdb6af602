"""One pass over the frames of a video file, shared by `probe` and `read_frames` so that both count the same frames.

A frame counts if it decodes and its presentation time is later than the one before it. Frames that an edit list cuts
away do not count (a player does not show them), whatever the header announces. At the end `Decoder` compares the
decoded frames with the announcement of the container: a recording that lost its end, or pictures in its middle, raises
an error instead of passing as a shorter one.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
from av.container import InputContainer
from av.error import FFmpegError

from pbl_pipeline.errors import PblError, said
from pbl_pipeline.resources import cores, keep_large_blocks

from .coded_units import is_damaged
from .container_tags import family, missing_end, photo_format

#: Containers that phones, cameras and converters write. Pictures, texts and playlists (which could name other files)
#: are not videos even where FFmpeg would open them.
_CONTAINERS = "mov,matroska,avi,mpegts,mpeg,asf,flv,ogg,mxf,ivf,h264,hevc"
#: FFmpeg's names of the containers whose length counts from 0, wherever the first stamp is: fragments of MP4, Matroska.
_FROM_ZERO = ("mov", "matroska")
#: Errors that reading a file can raise. Memory: a header with wrong sizes asks for more than there is, or this machine
#: has too little (`check_memory`).
FFMPEG_ERRORS = (FFmpegError, MemoryError)
#: Memory that every video that is read here can be decoded in (bytes).
_ENOUGH = 1 << 30
#: Largest decoded picture (bytes): 4K in 10 bits, 5.3K in 8. A decoder keeps up to 16 reference pictures, and one for
#: each thread; 16 of 5.3K with 5 threads take 760 MiB.
_MAX_PICTURE, _MAX_IN_THREADS = 26 << 20, 128 << 20
#: More threads cost memory and gain nothing.
_MAX_THREADS = 8
#: Most pixels of a picture, in the format with the fewest bytes for each (8 bits, colour at half the resolution).
_MAX_PIXELS = {"max_pixels": str(_MAX_PICTURE * 2 // 3)}
#: A header that is not UTF-8 is read all the same: av 18 has to be told so, 19 has no such argument.
_TEXTS: Any = {"metadata_errors": "replace"} if int(av.__version__.partition(".")[0]) < 19 else {}
_OPTIONS = {"format_whitelist": _CONTAINERS, "protocol_whitelist": "file", **_MAX_PIXELS}

#: Fraction of frames whose stamp may repeat or run backwards and be left out; more means the stamps cannot be trusted.
_MAX_UNORDERED = 0.01

_EXPECTED = "an MP4, MOV, WebM, MKV or AVI video as the phone recorded it"
_COPY_AGAIN = "copy the file from the phone or camera again and compare the sizes in bytes"


def check_file(path: str | Path, whole: bool = False) -> Path:
    """The path, if it is a file with bytes in it. `whole`: read all of them, so that a disk that fails is not taken for
    a recording that is damaged.

    Raises `PblError` VIDEO_MISSING, VIDEO_EMPTY.
    """
    path = Path(path)
    if not os.path.isfile(path):  # not Path.is_file: that raises where a folder on the way may not be entered
        raise PblError(
            "VIDEO_MISSING",
            found="a folder of that name" if os.path.isdir(path) else "no file of that name",
            expected="the path of a video file",
            next_step="check the spelling and that the disk is mounted",
            key=path,
        )
    try:
        with path.open("rb") as file:
            first = file.read(1)
            while whole and file.read(1 << 20):
                pass
    except OSError as error:
        raise PblError(
            "VIDEO_MISSING",
            found=said("the file cannot be read ({why})", why=_words(error)),
            expected="a file that this account may read",
            next_step="change the file's permissions or copy it to one of your folders",
            key=path,
        ) from error
    if not first:
        raise PblError("VIDEO_EMPTY", found="0 bytes", expected=_EXPECTED, next_step=_COPY_AGAIN, key=path)
    return path


class Decoder:
    """Iterate over `(pts, frame)` once; `time_base` converts a stamp to seconds, `notes` are complete at the end.

    With `exact`, threads share one frame instead of taking one each, so that damage is certain to be seen: FFmpeg's
    H.264 decoder otherwise returns a frame before another thread has found the damage in it (measured: with two frame
    threads a third of the runs missed a broken last picture). Frames and stamps of an intact file are the same.

    FFmpeg also decodes most damaged pictures silently, so that packets are looked at as well (`coded_units`).
    """

    def __init__(self, path: Path, threads: int | None = None, exact: bool = False) -> None:
        keep_large_blocks(False)
        self.path = path
        self.notes: list[str] = []
        self._exact = exact
        self.container = _open(path)
        self.stream = self._pick_stream()
        self.stream.thread_type = "SLICE" if exact else "AUTO"
        room = max(1, _MAX_IN_THREADS // max(1, _picture_bytes(self.stream)))
        self.stream.codec_context.thread_count = min(threads or min(cores(), _MAX_THREADS), room)
        self.stream.codec_context.options = _MAX_PIXELS  # also refuses pictures that are larger than announced
        self.time_base = Fraction(self.stream.time_base or Fraction(1, av.time_base))
        #: Its pictures in order, where the GPU has decoded them; the packets are then only counted.
        self.pictures: list[av.VideoFrame] | None = None
        self.n_frames = 0
        self._first_pts: int | None = None
        self._last_pts: int | None = None
        self._size: tuple[int, int] | None = None
        self._n_unordered = self._n_damaged = self._n_damaged_at_start = self._n_without_pts = 0
        self._n_packets = self._n_hidden = 0
        self._max_packet_pts: int | None = None
        self._last_packet_corrupt = self._last_frame_corrupt = False
        self._end_s = 0.0
        self._demux_error: str | None = None

    def __enter__(self) -> Decoder:
        return self

    def __exit__(self, *_: object) -> None:
        self.container.close()

    @property
    def n_announced(self) -> int:
        """Frames that the header announces; 0 if it does not."""
        return self.stream.frames

    def __iter__(self) -> Iterator[tuple[int, av.VideoFrame]]:
        for frame in self._frames():
            pts = self._accept(frame)
            if pts is not None:
                yield pts, frame
        self._check()

    def _frames(self) -> Iterator[av.VideoFrame]:
        for packet in self._packets():
            if self.pictures is not None:
                continue
            try:
                frames = self.stream.decode(packet)
            except FFMPEG_ERRORS as error:
                check_memory(error, self.path)
                # Before the first picture this is a recording whose start an editor cut off: nothing is lost.
                if self.n_frames:
                    self._n_damaged += 1
                else:
                    self._n_damaged_at_start += 1
                continue
            yield from frames
        yield from self.pictures or []

    def packet_stamps(self) -> list[int]:
        """Stamps of the pictures in the order of the file, without decoding; to be called instead of iterating."""
        stamps = [p.dts if p.pts is None else p.pts for p in self._packets() if p.size and not p.is_discard]
        return [s for s in stamps if s is not None]

    def _packets(self) -> Iterator[av.Packet]:
        """Every packet of the video stream; those of the other streams only show the length of the file."""
        packets = self.container.demux()
        while True:
            try:
                packet = next(packets, None)
            except FFMPEG_ERRORS as error:
                check_memory(error, self.path)
                self._demux_error = _words(error)
                packet = None
            if packet is None:
                break
            if packet.size and packet.pts is not None and packet.time_base is not None:
                self._end_s = max(self._end_s, float((packet.pts + (packet.duration or 0)) * packet.time_base))
            if packet.stream.index != self.stream.index:
                continue
            if packet.size:
                self._n_packets += 1
                self._n_damaged += self._exact and is_damaged(self.stream.codec_context, bytes(packet))
                # A corrupt packet counts as damage when another follows it; the last one is a lost end.
                self._n_damaged += self._last_packet_corrupt
                self._last_packet_corrupt = packet.is_corrupt
                if packet.is_discard:
                    self._n_hidden += 1
                elif packet.pts is not None:
                    self._max_packet_pts = max(packet.pts, self._max_packet_pts or packet.pts)
            yield packet
        if self._demux_error is not None:
            # The demuxer's own flush packet never came: ask for the frames the decoder still holds.
            flush = av.Packet()
            flush.stream = self.stream
            yield flush

    def _accept(self, frame: av.VideoFrame) -> int | None:
        """Return the frame's stamp if it counts, else None."""
        self._last_frame_corrupt = frame.is_corrupt
        if frame.is_corrupt:  # parts of the picture are guessed by the decoder
            self._n_damaged += 1
        pts = frame.pts
        if pts is None:  # AVI has no presentation stamps; its decoding stamps are the frame numbers
            pts = frame.dts
            self._n_without_pts += 1
        if pts is None:
            raise self._time_stamp_error("a frame without a time stamp")
        if self._last_pts is not None and pts <= self._last_pts:
            self._n_unordered += 1
            return None
        size = (frame.width, frame.height)
        if self._size is not None and size != self._size:
            (w, h), n = self._size, self.n_frames
            raise PblError(
                "VIDEO_DAMAGED",
                found=said(
                    "the picture is {w}x{h} px, but {w2}x{h2} px from frame {n} on",
                    w=w,
                    h=h,
                    w2=size[0],
                    h2=size[1],
                    n=n,
                ),
                expected="one picture size for the whole recording",
                next_step="cut the recording where the size changes and process the pieces as separate videos",
                key=self.path,
            )
        self._size = size
        if self._first_pts is None:
            self._first_pts = pts
        self._last_pts = pts
        self.n_frames += 1
        return pts

    # --- the end of the pass

    def _check(self) -> None:
        lost = self._lost_end() if self.n_frames else missing_end(self.path)
        if lost is not None or self._n_damaged or not self.n_frames:
            check_file(self.path, whole=True)
        if lost is not None:
            raise PblError(
                "VIDEO_TRUNCATED",
                found=said(
                    "{n} frames ({s:.2f} s) decode, but {lost}",
                    n=self.n_frames,
                    s=self._seconds(self._last_pts),
                    lost=lost,
                ),
                expected="a recording that is whole to its end",
                next_step=_COPY_AGAIN + "; if the original is cut too, save the part that plays as a new file "
                '("ffmpeg -i cut.mp4 -c:v libx264 part.mp4") and process that',
                key=self.path,
            )
        if self.n_frames == 0:
            raise PblError(
                "VIDEO_NO_FRAMES",
                found=said("0 frames of {n} packets decode", n=self._n_packets),
                expected="at least one frame that decodes",
                next_step=_COPY_AGAIN + "; if it does not play elsewhere either, it has to be recorded again",
                key=self.path,
            )
        if self._n_damaged:
            raise PblError(
                "VIDEO_DAMAGED",
                found=said(
                    "{n} pictures inside the recording do not decode cleanly ({all} do)",
                    n=self._n_damaged,
                    all=self.n_frames,
                ),
                expected="a recording without damaged pictures (those after one are drawn from it)",
                next_step=_COPY_AGAIN + "; if the original is damaged too, cut out an undamaged part",
                key=self.path,
            )
        if self._n_unordered > _MAX_UNORDERED * self.n_frames:
            n_all = self.n_frames + self._n_unordered
            raise self._time_stamp_error(
                said("{n} of {all} frames repeat a stamp or run backwards", n=self._n_unordered, all=n_all)
            )
        self._note()

    def _seconds(self, pts: int | None) -> float:
        """Time after the first frame; 0 for no stamp."""
        return 0.0 if pts is None or self._first_pts is None else float((pts - self._first_pts) * self.time_base)

    def _lost_end(self) -> str | None:
        lost = missing_end(self.path)
        if lost is not None:
            return lost
        if self._demux_error is not None:
            return said("reading stops there: {why}", why=self._demux_error)
        if self._last_packet_corrupt:
            return said("the last packet of the file is incomplete")
        if self._last_frame_corrupt:
            return said("the last picture is incomplete")
        beyond_s = self._seconds(self._max_packet_pts) - self._seconds(self._last_pts)
        if self._max_packet_pts is not None and beyond_s > 0:
            return said("the pictures of the last {s:.2f} s do not decode", s=beyond_s)
        if self._n_packets < self.n_announced:
            # An edit list also leaves out packets beyond its end; without it every packet of the file comes.
            try:
                n_stored = _count_packets(self.path, self.stream.index)
            except FFMPEG_ERRORS as error:
                check_memory(error, self.path)
                return said(
                    "the container announces {n} frames and cannot be read for them: {why}",
                    n=self.n_announced,
                    why=_words(error),
                )
            if n_stored < self.n_announced:
                return said("the container announces {n} frames and holds {all}", n=self.n_announced, all=n_stored)
            self._n_hidden = n_stored - self.n_frames
        if not self.n_announced and self.container.duration is not None:
            # Only without an announced count: the length may be rounded, or that of another stream.
            start_s = (self.container.start_time or 0) / av.time_base
            if self.container.format.name.startswith(_FROM_ZERO):
                start_s = min(start_s, 0.0)
            missing_s = self.container.duration / av.time_base - (self._end_s - start_s)
            if missing_s > 0.5:
                return f"the container announces {missing_s:.2f} s more"
        return None

    def _note(self) -> None:
        if self._n_hidden:
            self.notes.append(f"{self._n_hidden} frames are hidden by the file's edit list and do not count")
        if self._n_damaged_at_start:
            self.notes.append(
                f"{self._n_damaged_at_start} packets before the first picture do not decode and do not count"
            )
        if self._n_unordered:
            self.notes.append(f"{self._n_unordered} frames whose time stamp repeats or runs backwards do not count")
        if self._n_without_pts:
            self.notes.append(f"{self._n_without_pts} frames have no presentation stamp: their decoding stamp is used")

    def _time_stamp_error(self, found: str) -> PblError:
        return PblError(
            "VIDEO_TIMESTAMPS",
            found=found,
            expected="a presentation time for each frame, each later than the one before",
            next_step="use the file the camera wrote; a converter that keeps time stamps writes MP4 or MKV",
            key=self.path,
        )

    def _pick_stream(self) -> av.VideoStream:
        """The stream with the largest picture: phones store a preview beside it."""
        found = [
            stream
            for stream in self.container.streams.video
            if stream.codec_context is not None and not stream.disposition & stream.disposition.__class__.attached_pic
        ]
        if found:
            stream = max(found, key=lambda s: s.codec_context.width * s.codec_context.height)
            self._check_size(stream)
            if len(found) > 1:
                size = f"{stream.codec_context.width}x{stream.codec_context.height} px"
                self.notes.append(f"{len(found)} video streams: the one with the largest picture is used ({size})")
            return stream
        kinds = sorted({s.type for s in self.container.streams})
        unknown = any(s.type == "video" and s.codec_context is None for s in self.container.streams)
        self.container.close()
        raise PblError(
            "VIDEO_NOT_A_VIDEO",
            found="a video stream that no decoder here reads"
            if unknown
            else said("a file without a video stream, with {kinds}", kinds=", ".join(kinds) or "-"),
            expected=_EXPECTED,
            next_step="choose the file that holds the pictures; convert it to MP4 (H.264) if its codec is unusual",
            key=self.path,
        )

    def _check_size(self, stream: av.VideoStream) -> None:
        """Refuse pictures beyond `_MAX_PICTURE` before the first is decoded."""
        size = _picture_bytes(stream)
        if size <= _MAX_PICTURE:
            return
        self.container.close()
        raise PblError(
            "VIDEO_TOO_LARGE",
            found=said(
                "pictures of {w}x{h} px ({size} MiB each)",
                w=stream.codec_context.width,
                h=stream.codec_context.height,
                size=size >> 20,
            ),
            expected=f"at most {_MAX_PICTURE >> 20} MiB each: 4K in 10 bits, 5.3K in 8",
            next_step='make it smaller ("ffmpeg -i large.mp4 -vf scale=3840:-2 small.mp4")',
            key=self.path,
        )


def _picture_bytes(stream: av.VideoStream) -> int:
    """Bytes of a decoded picture as announced; those of 8 bits where the format is not known before decoding."""
    codec = stream.codec_context
    return codec.width * codec.height * (codec.format.padded_bits_per_pixel if codec.format is not None else 12) // 8


def _words(error: BaseException) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


def check_memory(error: BaseException, path: Path) -> None:
    """Raise `PblError` MACHINE_SHORT for an error of memory on a machine, or in a process, that has too little: it says
    nothing about the file."""
    if isinstance(error, MemoryError):
        try:
            bytearray(_ENOUGH)
        except MemoryError:
            raise PblError(
                "MACHINE_SHORT",
                found="no memory left to decode the video",
                expected=f"{_ENOUGH / 2**30:g} GiB for this process",
                next_step="try again; if it stays so, give the machine more memory, or fewer processes",
                key=path,
            ) from error


def _open(path: Path) -> InputContainer:
    photo = photo_format(path)
    if photo is not None:
        raise PblError(
            "VIDEO_NOT_A_VIDEO",
            found=said("a photo ({kind})", kind=photo),
            expected=_EXPECTED,
            next_step="film the person walking; of a Live Photo, share the video",
            key=path,
        )
    try:
        return av.open(str(path), options=_OPTIONS, **_TEXTS)
    except FFMPEG_ERRORS as error:
        check_memory(error, path)
        check_file(path, whole=True)
        lost = missing_end(path) if family(path) else None
        if lost is None:
            raise PblError(
                "VIDEO_NOT_A_VIDEO",
                found=said(
                    "no decoder recognises the file's {n} bytes ({why})", n=path.stat().st_size, why=_words(error)
                ),
                expected=_EXPECTED,
                next_step="check that it is the video itself, not a link, a preview or a text, and copy it again",
                key=path,
            ) from error
        raise PblError(
            "VIDEO_TRUNCATED",
            found=said("{lost}, so nothing of it can be read", lost=lost),
            expected="a recording that is whole to its end",
            next_step=_COPY_AGAIN + "; a recording that the phone itself could not finish (battery, storage) has to be "
            "repaired with a tool for that or recorded again",
            key=path,
        ) from error


def _count_packets(path: Path, index: int) -> int:
    """Packets of one stream that are whole, as stored, whatever an edit list says."""
    with av.open(str(path), options=_OPTIONS | {"ignore_editlist": "1"}, **_TEXTS) as container:
        return sum(1 for p in container.demux(container.streams[index]) if p.size and not p.is_corrupt)
