"""Processes of a machine with several GPUs spread over them, here stand-ins; one that disappears is replaced."""

import functools
import subprocess
import threading
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from pbl_pipeline.models import Network, gpu_address, gpu_server, network
from pbl_pipeline.models.gpu_server import Server
from pbl_pipeline.resources import VISIBLE_GPUS
from tests import Environment

PICTURE = np.ones((4, 4, 3), np.uint8)


class Sums:
    """A network without a file: the sum of a picture's bytes."""

    image_shape, sizes, batch, device = (4, 4, 3), [1], 4, "none"

    def __init__(self, *_: object) -> None: ...

    def __call__(self, images: np.ndarray) -> np.ndarray:
        return images.reshape(len(images), -1).sum(1, keepdims=True).astype(np.float32)


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, environment: Environment) -> Iterator[SimpleNamespace]:
    """Three GPUs: the servers that were started on each, and those on which none starts."""
    found = SimpleNamespace(servers=dict[str, Server](), gpu_at=dict[str, str](), dead=set[str](), started=list[str]())

    def start(command: list[str], env: dict[str, str], **_: object) -> SimpleNamespace:
        gpu = env[VISIBLE_GPUS]
        found.started.append(gpu)
        if gpu in found.dead:
            return SimpleNamespace(poll=lambda: 1, returncode=1)
        found.gpu_at[command[-1]] = gpu
        Path(command[-1]).unlink(missing_ok=True)
        server = found.servers[gpu] = Server(command[-1], any_device=True, idle_s=float("inf"))
        threading.Thread(target=server.run, daemon=True).start()
        return SimpleNamespace(poll=lambda: None)

    environment(**{VISIBLE_GPUS: "0, 1,2"})
    monkeypatch.setattr(gpu_address, "private_folder", lambda _: tmp_path)
    monkeypatch.setattr(gpu_address, "gpu_visible", lambda: True)
    monkeypatch.setattr(gpu_address, "_FAILED", {})
    monkeypatch.setattr(gpu_address, "subprocess", SimpleNamespace(Popen=start, DEVNULL=subprocess.DEVNULL))
    monkeypatch.setattr(gpu_server, "Program", Sums)
    monkeypatch.setattr(network, "LiteModel", lambda *_: lambda image: {1: image.sum()})
    monkeypatch.setattr(gpu_address, "_in_turn", functools.cache(gpu_address._in_turn.__wrapped__))
    yield found
    for server in found.servers.values():
        server.close()


def in_new_process() -> Network:
    """A network of another process than those before."""
    gpu_address._in_turn.cache_clear()
    return Network("sums", "", 1.0)


def gpu_of(machine: SimpleNamespace, asked: Network) -> str:
    """The GPU whose server holds the connection of a network."""
    assert asked._remote is not None, asked.note
    return machine.gpu_at[asked._remote._connection.getpeername()]


def test_processes_take_the_gpus_in_turn_each_with_a_server(machine: SimpleNamespace) -> None:
    networks = [in_new_process() for _ in range(7)]
    assert machine.started == ["0", "1", "2"]
    assert Counter(gpu_of(machine, n) for n in networks) == {"0": 3, "1": 2, "2": 2}
    assert [n(PICTURE)[1].item() for n in networks] == [48] * 7
    again = Network("sums", "", 1.0)
    assert gpu_of(machine, again) == gpu_of(machine, networks[-1]) == "0"
    assert gpu_address.gpu_number() == 0


def test_where_a_gpu_disappears_the_next_one_computes(machine: SimpleNamespace) -> None:
    first, second = in_new_process(), in_new_process()
    assert [n(PICTURE)[1].item() for n in (first, second)] == [48] * 2
    machine.dead.add("1")
    machine.servers["1"].close()
    address = next(at for at, gpu in machine.gpu_at.items() if gpu == "1")
    while gpu_address._listens(address):  # the thread that waits accepts one more
        pass
    assert second(PICTURE)[1] == 48
    assert not second.on_gpu
    following = [Network("sums", "", 1.0) for _ in range(3)]
    assert [gpu_of(machine, n) for n in following] == ["2"] * 3
    assert machine.started == ["0", "1", "1", "2"]  # the lost one is tried once
    assert gpu_of(machine, first) == "0"


def test_where_no_gpu_starts_the_cpu_computes_and_says_so(machine: SimpleNamespace) -> None:
    machine.dead |= {"0", "1", "2"}
    for _ in range(2):
        alone = in_new_process()
        assert alone(PICTURE)[1] == 48
        assert "the GPU process ended with 1" in alone.note
    assert machine.started == ["0", "1", "2"]
