"""A network of a TensorFlow Lite file with pictures as input: on the GPU if one is visible, else by LiteRT.

On the GPU one process for each machine and GPU owns the networks (`gpu_server`); every process that detects sends its
pictures there, so that pictures of many videos make up a batch. `PBL_ONNX_DEVICE` is used as for ONNX models: "cpu"
never uses the GPU, "auto" uses it if it works, "cuda" fails if a GPU is visible to JAX and does not compute. If none is
visible, LiteRT computes also with "cuda", which may be meant for an ONNX model.
"""

from __future__ import annotations

import dataclasses
import json
import mmap
import os
import queue
import socket
import threading
from collections import deque
from collections.abc import Collection
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import numpy as np

from . import gpu_address
from .devices import asked_device, unavailable
from .heat_maps import decoded
from .tflite import NUM_THREADS, LiteModel

#: First line of a connection to the process that owns the GPU whose videos are decoded; of others, a `NetworkSpec`.
DECODING = {"decoding": True}
#: Pictures of a process that the GPU process holds at once for a network; they keep it busy while others are cropped.
AT_ONCE = 16
#: Time to wait for an answer of the process that owns the GPU (s), which may compile; then the CPU computes.
PATIENCE_S = 120.0
#: Bytes of a line; that with the stamps of an hour has 2 MB.
_LONGEST_LINE = 1 << 24


@dataclasses.dataclass(frozen=True)
class NetworkSpec:
    """A network and its input."""

    path: str
    sha256: str
    outputs: tuple[int, ...] | None  # sizes of the wanted outputs, None: all
    scale: float  # the values 0 to 255 of a picture are multiplied by it
    offset: float = 0.0  # and added to it
    window_cells: float = 0.0  # of `heat_maps.decoded`; 0: the outputs as they are

    def entered(self, image: np.ndarray) -> np.ndarray:
        """Return a picture (H, W, 3) uint8 as input of the network, float32."""
        values = np.multiply(image, np.float32(self.scale), dtype=np.float32)
        return values + np.float32(self.offset) if self.offset else values

    def decoded(self, outputs: dict[int, Any], xp: Any = np) -> dict[int, Any]:
        """Return the network's outputs for one picture as the caller gets them."""
        return decoded(outputs, self.window_cells, xp) if self.window_cells else outputs


class Network:
    """A loaded network, called with a picture (H, W, 3) uint8 RGB; outputs are keyed by their number of elements.

    On the GPU several threads may call it at once (`side_by_side` of them use it fully), with LiteRT one at a time.

    Raises `PblError` ASSET_CHECKSUM: the file is not the pinned one. DEVICE_UNAVAILABLE: CUDA was requested, a GPU is
    visible, and it does not compute this network. USAGE: an unknown device.

    Attributes
    ----------
    sha256
        Of the file.
    device
        Name of the GPU, or "" for LiteRT on the CPU.
    note
        Reason why LiteRT computes although a GPU is visible, or "".
    """

    def __init__(
        self,
        path: str | Path,
        sha256: str,
        scale: float,
        offset: float = 0.0,
        outputs: Collection[int] | None = None,
        num_threads: int = NUM_THREADS,
        window_cells: float = 0.0,
    ) -> None:
        wanted = None if outputs is None else tuple(sorted(outputs))
        self._spec = NetworkSpec(str(Path(path).resolve()), sha256, wanted, scale, offset, window_cells)
        self._threads, self._lock = num_threads, threading.Lock()
        self.sha256, self.device, self.note = sha256, "", ""
        self._remote: _Remote | None = None
        self._lite: LiteModel | None = None
        if asked_device() == "cpu" or not gpu_address.gpu_visible():  # refuses unknown devices on every machine
            self._lite = self._load()
            return
        try:
            self._remote = _Remote(gpu_address.running_server(gpu_address.NETWORKS), self._spec)
            self.device = self._remote.device
        except (OSError, EOFError, RuntimeError) as error:
            self._fall_back(error)

    @property
    def on_gpu(self) -> bool:
        """True if the GPU computes."""
        return self._remote is not None

    @property
    def side_by_side(self) -> int:
        """Number of parallel calls that keep the device busy while pictures are cropped for others."""
        return AT_ONCE if self.on_gpu else 1

    def __call__(self, image: np.ndarray) -> dict[int, np.ndarray]:
        remote = self._remote
        if remote is not None:
            try:
                return remote(image)
            except (OSError, EOFError, RuntimeError) as error:
                with self._lock:
                    if self._remote is remote:
                        self._fall_back(error)
        with self._lock:
            assert self._lite is not None
            return self._spec.decoded(self._lite(self._spec.entered(image)))

    def _load(self) -> LiteModel:
        return LiteModel(self._spec.path, self.sha256, self._spec.outputs, self._threads)

    def _fall_back(self, error: BaseException) -> None:
        """Let LiteRT compute from now on. Raises `PblError` DEVICE_UNAVAILABLE if the GPU was requested."""
        found = str(error) or type(error).__name__
        if asked_device() == "cuda":
            raise unavailable(found) from error
        self._remote = None
        self._lite = self._load()
        self.note = f"on the CPU because the GPU does not compute it: {found}"[:300]


class _Remote:
    """A connection to the process that owns the GPU, for one network; calls of several threads share it."""

    def __init__(self, address: str, spec: NetworkSpec) -> None:
        self._connection = socket.socket(socket.AF_UNIX)
        self._connection.settimeout(PATIENCE_S)
        self._connection.connect(address)
        send_line(self._connection, dataclasses.asdict(spec))
        reply = json.loads(receive_line(self._connection))
        if "error" in reply:
            raise RuntimeError(reply["error"])
        self.device, self._sizes = str(reply["device"]), [int(n) for n in reply["sizes"]]
        shape = (AT_ONCE, *reply["shape"])
        self._pictures = np.frombuffer(share_memory(self._connection, int(np.prod(shape))), np.uint8).reshape(shape)
        self._free = queue.SimpleQueue[int]()
        for place in range(AT_ONCE):
            self._free.put(place)
        self._sending = threading.Lock()
        self._waiting: deque[Future[np.ndarray]] = deque()
        self._broken: BaseException | None = None
        self._connection.settimeout(None)  # answers are waited for in `__call__`
        threading.Thread(target=self._listen, name="gpu-network", daemon=True).start()

    def __call__(self, image: np.ndarray) -> dict[int, np.ndarray]:
        future: Future[np.ndarray] = Future()
        place = self._free.get()
        try:
            self._pictures[place] = image
            with self._sending:
                if self._broken is not None:
                    raise self._broken
                self._waiting.append(future)
                self._connection.sendall(bytes([place]))
            try:
                reply = future.result(PATIENCE_S)
            except TimeoutError as error:
                self._connection.shutdown(socket.SHUT_RDWR)  # the other calls need not wait as long
                raise RuntimeError(f"the process that owns the GPU did not answer within {PATIENCE_S:g} s") from error
            parts = np.split(reply, np.cumsum(self._sizes)[:-1])
        finally:
            self._free.put(place)
        return dict(zip(self._sizes, parts, strict=True))

    def _listen(self) -> None:
        try:
            while receive(self._connection, reply := np.empty(sum(self._sizes), np.float32)):
                self._waiting.popleft().set_result(reply)
        except IndexError:  # an answer without a request
            pass
        with self._sending:
            self._broken = EOFError("the process that owns the GPU ended")
            while self._waiting:
                self._waiting.popleft().set_exception(self._broken)


def share_memory(connection: socket.socket, size: int) -> mmap.mmap:
    """Return new memory, which the other side of a connection gets by `shared_memory`."""
    file = os.memfd_create("pictures", os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    try:
        os.ftruncate(file, size)
        memory = mmap.mmap(file, size)
        # The kernel clears its pages now and here; the other process would do it for one connection after another.
        np.frombuffer(memory, np.uint8)[:: mmap.PAGESIZE] = 0
        socket.send_fds(connection, [b"m"], [file])
        return memory
    finally:
        os.close(file)


def shared_memory(connection: socket.socket) -> np.ndarray:
    """Return the memory (size,) uint8 that the other side shares and can no longer shorten. Raises ValueError, OSError:
    it sends no such memory."""
    import fcntl  # not on Windows

    _, (file,), _, _ = socket.recv_fds(connection, 1, 1)
    try:
        fcntl.fcntl(file, fcntl.F_ADD_SEALS, fcntl.F_SEAL_SHRINK)
        return np.frombuffer(mmap.mmap(file, 0), np.uint8)
    finally:
        os.close(file)


def batches(values: np.ndarray, size: int) -> list[np.ndarray]:
    """Split values (N, ...) into batches of `size`, the last one filled with zeros."""
    short = -len(values) % size
    if short:
        values = np.concatenate([values, np.zeros((short, *values.shape[1:]), values.dtype)])
    return [values[i : i + size] for i in range(0, len(values), size)]


def send_line(connection: socket.socket, value: object) -> None:
    """Send a value as one line of JSON."""
    connection.sendall(json.dumps(value).encode() + b"\n")


def receive_line(connection: socket.socket) -> bytes:
    """Return the next line, after which the other side waits. Raises EOFError if it has ended, ValueError for a line
    without an end."""
    line = b""
    while not line.endswith(b"\n"):
        part = connection.recv(1 << 16)
        if not part:
            raise EOFError("the process that owns the GPU ended")
        line += part
        if len(line) > _LONGEST_LINE:
            raise ValueError(f"a line of more than {_LONGEST_LINE} bytes")
    return line


def receive(connection: socket.socket, into: np.ndarray) -> bool:
    """Fill an array with received bytes; False if the other side ended before."""
    try:
        return connection.recv_into(into.data, into.nbytes, socket.MSG_WAITALL) == into.nbytes
    except OSError:
        return False
