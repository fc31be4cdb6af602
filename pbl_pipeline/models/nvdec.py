"""The video decoder of an NVIDIA GPU (NVDEC), called in the driver's two libraries.

FFmpeg can use it too, but does not ask how a picture was decoded: damage would go unnoticed. Structures and functions:
NVIDIA Video Codec SDK 12, `cuviddec.h` and `nvcuvid.h`; CUDA 12 driver API, `cuda.h`.
"""

from __future__ import annotations

import contextlib
import ctypes
from collections.abc import Iterable, Iterator
from ctypes import POINTER, byref, c_int, c_longlong, c_short, c_size_t, c_ubyte, c_uint, c_ulong, c_ulonglong, c_void_p
from typing import Any

import numpy as np

#: NVIDIA's numbers of FFmpeg's codecs.
CODECS = {"h264": 4, "hevc": 8}
#: Pictures that are decoded ahead of the one that is shown, so that the decoder does not wait for its copy.
_AHEAD = 4
_YUV_420, _WEAVE, _BY_DECODER = 1, 0, 4
_HAS_STAMP, _IS_PICTURE, _IS_END = 2, 8, 1
_SUCCESS = 2  # cuvidDecodeStatus_Success
_HOST, _DEVICE = 1, 2
#: A waiting thread does not use a core: CU_CTX_SCHED_BLOCKING_SYNC, CU_EVENT_BLOCKING_SYNC.
_BLOCKING, _WAITS_ASLEEP, _UNTIMED = 4, 1, 2
_OWN_ORDER, _ALL_CONTEXTS = 1, 1  # CU_STREAM_NON_BLOCKING, CU_MEMHOSTREGISTER_PORTABLE


class _Format(ctypes.Structure):
    """CUVIDEOFORMAT as far as it is used."""

    _fields_ = (
        ("codec", c_int),
        ("rate", c_uint * 2),
        ("progressive", c_ubyte),
        ("luma_bits_over_8", c_ubyte),
        ("chroma_bits_over_8", c_ubyte),
        ("surfaces", c_ubyte),
        ("width", c_uint),
        ("height", c_uint),
        ("shown", c_int * 4),  # left, top, right, bottom
        ("chroma", c_int),
    )


class _ToCreate(ctypes.Structure):
    """CUVIDDECODECREATEINFO."""

    _fields_ = (
        ("width", c_ulong),
        ("height", c_ulong),
        ("surfaces", c_ulong),
        ("codec", c_int),
        ("chroma", c_int),
        ("flags", c_ulong),
        ("bits_over_8", c_ulong),
        ("intra_only", c_ulong),
        ("most_width", c_ulong),
        ("most_height", c_ulong),
        ("reserved", c_ulong),
        ("shown", c_short * 4),
        ("format", c_int),
        ("deinterlacing", c_int),
        ("target_width", c_ulong),
        ("target_height", c_ulong),
        ("output_surfaces", c_ulong),
        ("lock", c_void_p),
        ("target", c_short * 4),
        ("reserved2", c_ulong * 5),
    )


class _Shown(ctypes.Structure):
    """CUVIDPARSERDISPINFO."""

    _fields_ = (
        ("index", c_int),
        ("progressive", c_int),
        ("top_field_first", c_int),
        ("repeat_first_field", c_int),
        ("stamp", c_longlong),
    )


class _Packet(ctypes.Structure):
    """CUVIDSOURCEDATAPACKET."""

    _fields_ = (("flags", c_ulong), ("size", c_ulong), ("data", c_void_p), ("stamp", c_longlong))


class _ToMap(ctypes.Structure):
    """CUVIDPROCPARAMS."""

    _fields_ = (
        ("progressive", c_int),
        ("fields", c_int * 3),
        ("reserved", c_uint * 2),
        ("raw", c_ulonglong * 4),
        ("stream", c_void_p),
        ("reserved2", c_uint * 46),
        ("reserved3", c_void_p * 2),
    )


class _Status(ctypes.Structure):
    """CUVIDGETDECODESTATUS."""

    _fields_ = (("status", c_int), ("reserved", c_uint * 31), ("reserved2", c_void_p * 8))


class _Place(ctypes.Structure):
    """Source or destination of `_Copy`."""

    _fields_ = (
        ("x", c_size_t),
        ("y", c_size_t),
        ("type", c_int),
        ("host", c_void_p),
        ("device", c_ulonglong),
        ("array", c_void_p),
        ("pitch", c_size_t),
    )


class _Copy(ctypes.Structure):
    """CUDA_MEMCPY2D."""

    _fields_ = (("source", _Place), ("to", _Place), ("row_bytes", c_size_t), ("rows", c_size_t))


_OnSequence = ctypes.CFUNCTYPE(c_int, c_void_p, POINTER(_Format))
_OnDecode = ctypes.CFUNCTYPE(c_int, c_void_p, c_void_p)
_OnShow = ctypes.CFUNCTYPE(c_int, c_void_p, POINTER(_Shown))


class _Parser(ctypes.Structure):
    """CUVIDPARSERPARAMS."""

    _fields_ = (
        ("codec", c_int),
        ("surfaces", c_uint),
        ("clock", c_uint),
        ("error_threshold", c_uint),
        ("ahead", c_uint),
        ("annex_b", c_uint),
        ("reserved", c_uint * 4),
        ("user", c_void_p),
        ("on_sequence", _OnSequence),
        ("on_decode", _OnDecode),
        ("on_show", _OnShow),
        ("reserved2", c_void_p * 7),
        ("more", c_void_p),
    )


class Nvdec:
    """The first GPU's decoder. Threads may decode at once, each a video.

    Raises RuntimeError where a library, the GPU or its decoder is missing.
    """

    def __init__(self) -> None:
        try:
            self._cuda, self._video = ctypes.CDLL("libcuda.so.1"), ctypes.CDLL("libnvcuvid.so.1")
        except OSError as error:
            raise RuntimeError(str(error)) from error
        self._context = c_void_p()
        self._call("cuInit", c_uint(0))
        self._call("cuDevicePrimaryCtxSetFlags_v2", c_int(0), c_uint(_BLOCKING))
        self._call("cuDevicePrimaryCtxRetain", byref(self._context), c_int(0))

    @contextlib.contextmanager
    def pinned(self, memory: np.ndarray) -> Iterator[None]:
        """Let the GPU write into memory of this process directly, within this block."""
        at = c_void_p(memory.ctypes.data)
        self._call("cuCtxSetCurrent", self._context)
        self._call("cuMemHostRegister_v2", at, c_size_t(memory.nbytes), c_uint(_ALL_CONTEXTS))
        try:
            yield
        finally:
            self._call("cuMemHostUnregister", at)

    def decode(
        self, codec: str, size_px: tuple[int, int], packets: Iterable[tuple[int, bytes]], into: np.ndarray
    ) -> list[int]:
        """Decode a progressive video of 8 bits with colour at half the resolution; return the stamps of its pictures.

        Parameters
        ----------
        codec
            Of `CODECS`.
        size_px
            Width and height that are shown, both even.
        packets
            Stamp and bytes (Annex B, in a piece for each picture), in the order of the file.
        into
            (N, H * 3 / 2, W) uint8, C-contiguous and pinned: brightness, then pairs of blue and red difference, of
            each picture in the order of showing.

        Raises
        ------
        RuntimeError
            Any picture does not decode without an error; more pictures than `into` has; another kind of video.
        """
        self._call("cuCtxSetCurrent", self._context)
        with contextlib.closing(_Decoding(self._call, codec, size_px, into)) as decoding:
            return decoding.run(packets)

    def _call(self, name: str, *arguments: Any) -> None:
        library = self._video if name.startswith("cuvid") else self._cuda
        result = getattr(library, name)(*arguments)
        if result:
            raise RuntimeError(f"{name} returns {result}")


class _Decoding:
    """One video in `Nvdec.decode`. An error of a callback ends the parser's call and is raised after it."""

    def __init__(self, call: Any, codec: str, size_px: tuple[int, int], into: np.ndarray) -> None:
        self._call, self._codec, self._size, self._into = call, CODECS[codec], size_px, into
        self._decoder, self._stream, self._copied, self._parser = c_void_p(), c_void_p(), c_void_p(), c_void_p()
        self._coded = 0, 0, 0  # width, height, surfaces
        self._stamps: list[int] = []
        self._error: Exception | None = None
        call("cuStreamCreate", byref(self._stream), c_uint(_OWN_ORDER))
        call("cuEventCreate", byref(self._copied), c_uint(_WAITS_ASLEEP | _UNTIMED))
        # Kept here: the parser holds their addresses only.
        self._callbacks = (
            _OnSequence(lambda _, at: self._guarded(self._begin, at.contents)),
            _OnDecode(lambda _, at: self._guarded(self._decode, at)),
            _OnShow(lambda _, at: self._guarded(self._show, at.contents) if at else 1),
        )
        wanted = _Parser(self._codec, 1, 0, 0, _AHEAD)
        wanted.on_sequence, wanted.on_decode, wanted.on_show = self._callbacks
        call("cuvidCreateVideoParser", byref(self._parser), byref(wanted))

    def run(self, packets: Iterable[tuple[int, bytes]]) -> list[int]:
        for stamp, data in packets:
            at = ctypes.cast(ctypes.c_char_p(data), c_void_p)
            self._parse(_Packet(_HAS_STAMP | _IS_PICTURE, len(data), at, stamp))
        self._parse(_Packet(_IS_END, 0, None, 0))
        return self._stamps

    def close(self) -> None:
        if self._parser:
            self._call("cuvidDestroyVideoParser", self._parser)
        if self._decoder:
            self._call("cuvidDestroyDecoder", self._decoder)
        self._call("cuEventDestroy_v2", self._copied)
        self._call("cuStreamDestroy_v2", self._stream)
        self._callbacks = ()  # they refer to this object

    def _parse(self, packet: _Packet) -> None:
        try:
            self._call("cuvidParseVideoData", self._parser, byref(packet))
        finally:
            if self._error is not None:
                raise self._error

    def _guarded(self, step: Any, argument: Any) -> int:
        if self._error is None:
            try:
                return step(argument)
            except Exception as error:  # noqa: BLE001 - may not leave a callback; `_parse` raises it
                self._error = error
        return 0

    def _begin(self, found: _Format) -> int:
        """Create the decoder; return how many surfaces it has."""
        left, top, right, bottom = found.shown
        kind = (found.codec, found.chroma, found.luma_bits_over_8, found.chroma_bits_over_8, found.progressive)
        if kind != (self._codec, _YUV_420, 0, 0, 1) or (left, top, right, bottom) != (0, 0, *self._size):
            raise RuntimeError(f"a video of another kind: {kind}, {left, top, right, bottom}")
        surfaces, coded = found.surfaces + _AHEAD + 1, (found.width, found.height, found.surfaces)
        if self._decoder:
            if coded != self._coded:
                raise RuntimeError(f"{coded} after {self._coded}")
            return surfaces
        self._coded = coded
        wanted = _ToCreate(found.width, found.height, surfaces, found.codec, found.chroma, _BY_DECODER)
        wanted.most_width = wanted.target_width = found.width
        wanted.most_height = wanted.target_height = found.height
        wanted.shown[2], wanted.shown[3] = found.width, found.height
        wanted.deinterlacing, wanted.output_surfaces = _WEAVE, 2
        self._call("cuvidCreateDecoder", byref(self._decoder), byref(wanted))
        return surfaces

    def _decode(self, picture: int) -> int:
        self._call("cuvidDecodePicture", self._decoder, c_void_p(picture))
        return 1

    def _show(self, shown: _Shown) -> int:
        """Copy a picture."""
        if len(self._stamps) >= len(self._into):
            raise RuntimeError(f"more than {len(self._into)} pictures")
        wanted, surface, pitch = _ToMap(progressive=1, stream=self._stream.value), c_ulonglong(), c_uint()
        wanted.fields[0] = shown.repeat_first_field + 1
        self._call("cuvidMapVideoFrame64", self._decoder, shown.index, byref(surface), byref(pitch), byref(wanted))
        try:
            width, height = self._size
            to = self._into[len(self._stamps)]
            coded_height = self._coded[1] + self._coded[1] % 2
            for first, at, rows in ((0, 0, height), (coded_height, height, height // 2)):
                source = _Place(type=_DEVICE, device=surface.value + first * pitch.value, pitch=pitch.value)
                copy = _Copy(source, _Place(type=_HOST, host=to[at:].ctypes.data, pitch=width), width, rows)
                self._call("cuMemcpy2DAsync_v2", byref(copy), self._stream)
            self._call("cuEventRecord", self._copied, self._stream)
            self._call("cuEventSynchronize", self._copied)
            status = _Status()
            self._call("cuvidGetDecodeStatus", self._decoder, shown.index, byref(status))
        finally:
            self._call("cuvidUnmapVideoFrame64", self._decoder, surface)
        if status.status != _SUCCESS:
            raise RuntimeError(f"picture {len(self._stamps)} decodes with status {status.status}")
        self._stamps.append(shown.stamp)
        return 1
