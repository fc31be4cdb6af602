"""The processes that own the GPU for detection: `python -m pbl_pipeline.models.gpu_server networks|decoder ADDRESS`.

Each connection begins with a line of JSON, answered by one.

- A network: its `NetworkSpec`; then the file of memory for `AT_ONCE` pictures, and for each picture a byte that says
  where in it the picture is, answered with the network's outputs as float32 in the order of these bytes. The pictures
  that wait on all connections of a network are one batch. Each network has one batch size, so that one program is
  compiled for it; a batch that is not full is padded, and a picture's result does not depend on the others.
- A reader of videos: `DECODING`; then the file of its memory, and for each video a line of JSON and its packets. The
  pictures are written into that memory, and the answer is a line with their stamps.

Decoder and networks are two processes: XLA records its calls in graphs, to start many at once, and a call of the
decoder in the same process, of whatever thread, makes the recording fail.
"""

from __future__ import annotations

import itertools
import json
import os
import selectors
import socket
import sys
import threading
import time
from collections import defaultdict, deque
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from pbl_pipeline.errors import PblError

from .gpu_address import DECODER
from .network import AT_ONCE, DECODING, NetworkSpec, batches, receive_line, send_line, shared_memory
from .nvdec import Nvdec
from .tflite import LiteModel, read_network

#: Pictures in one call of a network, and the least if the GPU's memory does not suffice.
BATCH, LEAST_BATCH = 16, 4
#: Time without connections (s) after which the process ends.
IDLE_S = 60.0
#: Time for a client to send what it begins a connection with, and to take its answers (s); then it is dropped.
CLIENT_S = 10.0
#: Largest difference from LiteRT, as a fraction of the largest value of an output, that is taken for rounding.
MOST_DIFFERENCE = 1e-3
#: Number of networks that use the device at a time, and of videos that are decoded.
_NETWORKS_AT_ONCE, _VIDEOS_AT_ONCE = 2, 8


class Program:
    """A network compiled for the device, checked against LiteRT on one picture.

    Raises
    ------
    PblError
        ASSET_CHECKSUM; MODEL_INVALID: an operation that is not known.
    RuntimeError
        The device is not a GPU and `any_device` is False, has no room, or computes other values than LiteRT.
    """

    def __init__(self, spec: NetworkSpec, any_device: bool = False, batch: int = BATCH) -> None:
        import jax

        from .tflite_jax import read_model

        model = read_model(read_network(spec.path, spec.sha256, spec.outputs))
        device = jax.devices()[0]
        if device.platform != "gpu" and not any_device:
            raise RuntimeError(f"JAX finds no GPU, only {device.device_kind}")
        self.image_shape, self.batch, self.device = model.image_shape, batch, device.device_kind
        picture = np.random.default_rng(0).integers(0, 256, self.image_shape, np.uint8)
        expected = spec.decoded(LiteModel(spec.path, spec.sha256, spec.outputs)(spec.entered(picture)))
        self.sizes = tuple(expected)
        self._weights = jax.device_put(model.weights)
        scale, offset = np.float32(spec.scale), np.float32(spec.offset)

        def outputs(weights: Any, images: Any) -> Any:
            # Factors rounded to ten bits (TensorFloat-32) are a third faster here, but points then differ by 4 px of
            # 256 in poor pictures, so that results would depend on the device.
            with jax.default_matmul_precision("highest"):
                values = model(weights, images.astype(np.float32) * scale + offset)
                found = dict(zip(model.output_sizes, values, strict=True))
                found = jax.vmap(lambda one: spec.decoded(one, jax.numpy))(found)
                return jax.numpy.concatenate([found[size] for size in self.sizes], axis=1)

        self._run = jax.jit(outputs)
        self._check(picture, expected)

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Return the outputs (N, sum of sizes) of pictures (N, H, W, 3) uint8."""
        while True:
            try:
                parts = [self._run(self._weights, part) for part in batches(images, self.batch)]
                return np.concatenate([np.asarray(p) for p in parts])[: len(images)]
            except RuntimeError as error:
                if "RESOURCE_EXHAUSTED" not in str(error) or self.batch <= LEAST_BATCH:
                    raise
                self.batch //= 2

    def _check(self, picture: np.ndarray, expected: dict[int, np.ndarray]) -> None:
        got = np.split(self(picture[None])[0], np.cumsum(self.sizes)[:-1])
        for size, values in zip(self.sizes, got, strict=True):
            wanted = expected[size].ravel()
            off = float(np.max(np.abs(values - wanted)) / max(float(np.max(np.abs(wanted))), 1.0))
            if not off < MOST_DIFFERENCE:
                raise RuntimeError(f"the GPU's output of {size} numbers is {off:.2g} from LiteRT's")


class _Served:
    """A network, and the pictures that wait for it: when each came, its connection, and where it lies."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.images = np.zeros((program.batch, *program.image_shape), np.uint8)
        self.waiting = deque[tuple[float, socket.socket, np.ndarray]]()
        self.computes = False
        self.answers = threading.Lock()  # those of one batch after those of the one before

    def waited_s(self) -> float:
        """Time that the pictures of the next batch have waited, in all."""
        now = time.monotonic()
        return sum(now - came for came, *_ in itertools.islice(self.waiting, len(self.images)))


class _Networks:
    """Networks and their connections.

    Two networks use the device at a time, so that the pictures and results of one are copied while another computes.
    The next one is that whose pictures have waited longest, in all: of a network with few, more accumulate, while a
    call for one of them would take the device as long as a full one.
    """

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()  # each connection with its network and its memory
        self._changed = threading.Condition()
        self._served = list[_Served]()
        self._computing = 0
        for work in (self._collect, *[self._compute] * 2 * _NETWORKS_AT_ONCE):
            threading.Thread(target=work, daemon=True).start()

    @property
    def n_connections(self) -> int:
        return len(self._selector.get_map() or ())

    def served(self, program: Program) -> _Served:
        """Return a new network."""
        with self._changed:
            self._served.append(_Served(program))
            return self._served[-1]

    def add(self, connection: socket.socket, served: _Served, memory: np.ndarray) -> None:
        pictures = memory.reshape(-1, *served.program.image_shape)
        self._selector.register(connection, selectors.EVENT_READ, (connection, served, pictures))

    def close(self) -> None:
        """End all connections."""
        for connection, *_ in [key.data for key in self._selector.get_map().values()]:
            self._drop(connection)

    def _collect(self) -> None:
        """Note which pictures wait; they stay where they are until they are answered."""
        while True:
            for key, _ in self._selector.select(1.0):
                connection, served, pictures = key.data
                places = _places(connection)
                if not places or max(places) >= len(pictures):
                    self._drop(connection)
                    continue
                now = time.monotonic()
                with self._changed:
                    served.waiting.extend((now, connection, pictures[place]) for place in places)
                    if self._computing < _NETWORKS_AT_ONCE and not served.computes:
                        self._changed.notify()

    def _drop(self, connection: socket.socket) -> None:
        try:
            self._selector.unregister(connection)
            connection.close()
        except (KeyError, OSError, ValueError):  # already closed
            return

    def _next(self) -> _Served | None:
        if self._computing == _NETWORKS_AT_ONCE:
            return None
        ready = [s for s in self._served if s.waiting and not s.computes]
        return max(ready, key=_Served.waited_s, default=None)

    def _compute(self) -> None:
        while True:
            with self._changed:
                while (served := self._next()) is None:
                    self._changed.wait()
                taken = [served.waiting.popleft() for _ in range(min(len(served.waiting), len(served.images)))]
                self._computing, served.computes = self._computing + 1, True
            try:
                for image, (_, _, picture) in zip(served.images, taken, strict=False):
                    image[:] = picture
                found = served.program(served.images)
            except Exception as error:  # noqa: BLE001 - the GPU failed: the clients fall back to LiteRT
                sys.stderr.write(f"the GPU does not compute: {error}\n")
                sys.stderr.flush()
                os._exit(1)
            with served.answers:
                with self._changed:
                    self._computing, served.computes = self._computing - 1, False
                    self._changed.notify()
                rows = defaultdict[socket.socket, list[int]](list)
                for row, (_, owner, _) in enumerate(taken):
                    rows[owner].append(row)
                for owner, of_owner in rows.items():
                    try:
                        owner.sendall(found[of_owner].data)
                    except (OSError, ValueError):  # it ended, or takes no answers
                        self._drop(owner)


def _places(connection: socket.socket) -> bytes:
    """Return where the pictures are that a connection has sent; nothing if it ended."""
    try:
        return connection.recv(AT_ONCE)
    except OSError:
        return b""


class Server:
    """Serves networks at an address until it is closed or has had no connection for `idle_s`."""

    def __init__(
        self,
        address: str,
        any_device: bool = False,
        idle_s: float = IDLE_S,
        batch: int = BATCH,
        decoder: Nvdec | None = None,
    ) -> None:
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(address)
        self._listener.listen(256)
        self._any_device, self._idle_s, self._batch = any_device, idle_s, batch
        self._served: dict[NetworkSpec, _Served] = {}
        self._locks: dict[NetworkSpec, threading.Lock] = {}
        self._networks = _Networks()
        self._decoder, self._decoding = decoder, threading.Semaphore(_VIDEOS_AT_ONCE)
        self._readers = set[socket.socket]()  # connections whose videos are decoded
        self._opening = 0
        # Programs of several networks compile in parallel.
        self._openers = ThreadPoolExecutor(16)

    def run(self) -> None:
        """Accept connections."""
        threading.Thread(target=self._watch, daemon=True).start()
        while True:
            try:
                connection, _ = self._listener.accept()
            except OSError:
                if self._listener.fileno() < 0:  # closed
                    return
                time.sleep(0.1)  # too many open files: others end
                continue
            self._openers.submit(self._open, connection)

    def close(self) -> None:
        """Accept no further connections and end those that are open."""
        self._listener.close()
        self._networks.close()

    def _open(self, connection: socket.socket) -> None:
        self._opening += 1
        try:
            connection.settimeout(CLIENT_S)
            given = json.loads(receive_line(connection))
            if given == DECODING:
                connection.settimeout(None)  # the next video may come late
                threading.Thread(target=self._read_videos, args=[connection], daemon=True).start()
                return
            outputs = None if given["outputs"] is None else tuple(given["outputs"])
            spec = NetworkSpec(**(given | {"outputs": outputs}))
            try:
                with self._locks.setdefault(spec, threading.Lock()):
                    if spec not in self._served:
                        self._served[spec] = self._networks.served(Program(spec, self._any_device, self._batch))
            except Exception as error:  # noqa: BLE001 - the client falls back to LiteRT and reports the reason
                lines = [error.short()] if isinstance(error, PblError) else str(error).strip().splitlines()
                send_line(connection, {"error": lines[0] if lines else type(error).__name__})
                connection.close()
                return
            served = self._served[spec]
            program = served.program
            shape = program.image_shape
            send_line(connection, {"device": program.device, "sizes": program.sizes, "shape": shape})
            self._networks.add(connection, served, shared_memory(connection))
        except Exception:  # noqa: BLE001 - it does not keep to the protocol, or has ended
            connection.close()
        finally:
            self._opening -= 1

    def _read_videos(self, connection: socket.socket) -> None:
        """Decode the videos of a process until it ends the connection."""
        self._readers.add(connection)
        try:
            with connection, connection.makefile("rb") as asked:
                if self._decoder is None:
                    send_line(connection, {"error": "the GPU has no decoder"})
                    return
                send_line(connection, {})
                memory = shared_memory(connection)
                with self._decoder.pinned(memory):
                    while line := asked.readline():
                        send_line(connection, self._decode(self._decoder, json.loads(line), asked, memory))
        except Exception as error:  # noqa: BLE001 - of the GPU or of the request: the reader falls back to FFmpeg
            sys.stderr.write(f"no further videos are decoded for a process: {error!r}\n")
        finally:
            self._readers.discard(connection)

    def _decode(self, decoder: Nvdec, asked: dict[str, Any], source: BinaryIO, memory: np.ndarray) -> dict[str, Any]:
        """Decode a video into the beginning of `memory`; return its answer."""
        packets = [(stamp, source.read(n)) for stamp, n in zip(asked["stamps"], asked["lengths"], strict=True)]
        n, (width, height) = len(packets), asked["size_px"]
        into = memory[: n * height * 3 // 2 * width].reshape(n, height * 3 // 2, width)
        try:
            with self._decoding:
                return {"stamps": decoder.decode(asked["codec"], (width, height), packets, into)}
        except RuntimeError as error:
            return {"error": str(error)}

    def _watch(self) -> None:
        """End the process when it is no longer used."""
        last = time.monotonic()
        while time.monotonic() - last < self._idle_s:
            time.sleep(min(1.0, self._idle_s / 4))
            if self._opening or self._readers or self._networks.n_connections:
                last = time.monotonic()
        self.close()
        os._exit(0)


def main() -> None:
    """Run the process. That of the networks ends at once if JAX finds no GPU."""
    what, address = sys.argv[1], Path(sys.argv[2])
    address.unlink(missing_ok=True)
    if what == DECODER:
        try:
            decoder = Nvdec()
        except RuntimeError as error:
            sys.stderr.write(f"videos are not decoded on the GPU: {error}\n")
            decoder = None
        Server(str(address), decoder=decoder).run()
        return
    from pbl_pipeline.jax_setup import configure

    configure()
    import jax

    device = jax.devices()[0]
    if device.platform != "gpu":
        raise SystemExit(f"JAX finds no GPU, only {device.device_kind}")
    Server(str(address)).run()


if __name__ == "__main__":
    main()
