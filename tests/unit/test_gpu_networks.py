"""TensorFlow Lite graphs as JAX functions and the process that owns the GPU, here on the CPU: LiteRT's numbers."""

import dataclasses
import json
import os
import socket
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from pbl_pipeline import assets
from pbl_pipeline.keypoints import METHODS
from pbl_pipeline.models import LiteModel, Network, gpu_address, gpu_server, gpu_visible, network
from pbl_pipeline.models.gpu_server import Server
from pbl_pipeline.models.network import AT_ONCE, NetworkSpec, receive_line, share_memory
from pbl_pipeline.models.tflite import read_network
from pbl_pipeline.models.tflite_jax import read_model
from pbl_pipeline.video import read_frames
from research.benchmarks.many_videos import differences
from research.clip_keypoints import clip_keypoints
from tests import Environment, Machine, refused
from tests.videos import write_video

LANDMARKS, MAPS = (195, 117, 1), 64 * 64 * 39


def spec_of(name: str) -> NetworkSpec:
    asset = assets.ASSETS[name]
    outputs = LANDMARKS if "landmarks" in name else None
    scale, offset = (1 / 255, 0.0) if outputs else (2 / 255, -1.0)
    return NetworkSpec(str(assets.fetch(name)), asset.sha256, outputs, scale, offset)


def pictures(size: int, n: int) -> list[np.ndarray]:
    """Squares of the demo recording, RGB, around the woman who walks."""
    video = assets.fetch("demo_video")
    frames = [f.image for f in read_frames(video, 60, 60 + 20 * n, 20)]
    squares = [image[:, -image.shape[0] :] if image.shape[1] > image.shape[0] else image for image in frames]
    return [np.ascontiguousarray(cv2.resize(s, (size, size))[:, :, ::-1]) for s in squares]


@pytest.mark.slow
@pytest.mark.usefixtures("little_optimised")
@pytest.mark.parametrize(
    "name",
    [
        "blazepose_detector",
        pytest.param("blazepose_landmarks", marks=pytest.mark.long),
        pytest.param("blazepose_landmarks_heavy", marks=pytest.mark.long),
    ],
)
def test_jax_function_has_litert_s_numbers(name: str) -> None:
    spec = spec_of(name)
    model = read_model(read_network(spec.path, spec.sha256, spec.outputs))
    shown = [spec.entered(p) for p in pictures(model.image_shape[0], 2)]
    got = jax.jit(lambda weights, images: model(weights, images))(model.weights, jnp.stack(shown))
    lite = LiteModel(spec.path, spec.sha256, spec.outputs)
    for i, picture in enumerate(shown):
        expected = lite(picture)
        for size, values in zip(model.output_sizes, got, strict=True):
            # Of coordinates up to 256 px, logits and metres; float32 sums in another order.
            largest = max(float(np.abs(expected[size]).max()), 1.0)
            assert np.abs(np.asarray(values[i]) - expected[size].ravel()).max() < 1e-4 * largest


@pytest.mark.long
@pytest.mark.usefixtures("little_optimised")
def test_points_are_refined_in_the_program_as_by_litert() -> None:
    """No map leaves it."""
    spec = spec_of("blazepose_landmarks")
    spec = dataclasses.replace(spec, outputs=(*LANDMARKS, MAPS), window_cells=1.5)
    program = gpu_server.Program(spec, any_device=True, batch=2)
    assert sorted(program.sizes) == [1, 117, 195]
    shown = pictures(256, 2)
    lite = LiteModel(spec.path, spec.sha256, spec.outputs)
    for picture, row in zip(shown, program(np.array(shown)), strict=True):
        raw = lite(spec.entered(picture))
        got = dict(zip(program.sizes, np.split(row, np.cumsum(program.sizes)[:-1]), strict=True))
        for size, expected in spec.decoded(raw).items():
            assert np.abs(got[size] - expected.ravel()).max() < 0.02
        assert np.abs(got[195] - raw[195].ravel()).max() > 1  # px


def test_unknown_operation_is_named() -> None:
    from ai_edge_litert import schema_py_generated as schema

    spec = spec_of("blazepose_landmarks")
    content = schema.ModelT.InitFromObj(schema.Model.GetRootAs(read_network(spec.path, spec.sha256, spec.outputs), 0))
    assert content.operatorCodes is not None
    for code in content.operatorCodes:
        if code.builtinCode == schema.BuiltinOperator.LOGISTIC:
            code.builtinCode = code.deprecatedBuiltinCode = schema.BuiltinOperator.SOFTMAX
    import flatbuffers

    builder = flatbuffers.Builder(1 << 20)
    builder.Finish(content.Pack(builder), b"TFL3")
    assert refused("MODEL_INVALID", read_model, bytes(builder.Output())).found == "operation SOFTMAX"


def test_without_a_gpu_litert_computes() -> None:
    if gpu_visible():
        pytest.skip("a GPU is here")
    network = network_of("blazepose_detector")
    assert (network.on_gpu, network.device, network.note, network.side_by_side) == (False, "", "", 1)


def network_of(name: str) -> Network:
    spec = spec_of(name)
    return Network(spec.path, spec.sha256, spec.scale, spec.offset, spec.outputs)


@pytest.fixture
def server(tmp_path: Path, machine: Machine) -> Iterator[Server]:
    """A server on the CPU, found as that of a GPU is."""
    address = str(tmp_path / "gpu.sock")
    server = Server(address, any_device=True, idle_s=float("inf"), batch=4)
    threading.Thread(target=server.run, daemon=True).start()
    machine(gpu=address)
    yield server
    server.close()


@pytest.mark.slow
def test_pictures_of_many_videos_share_batches_and_get_their_own_answers(server: Server) -> None:
    shown = pictures(224, 3)
    lite = network_of("blazepose_detector")
    videos = [network_of("blazepose_detector") for _ in range(3)]
    assert all(v.on_gpu and v.device for v in videos)
    spec = spec_of("blazepose_detector")
    model = LiteModel(spec.path, spec.sha256)
    expected = [model(spec.entered(p)) for p in shown]
    with ThreadPoolExecutor(9) as threads:
        jobs = [(i, threads.submit(videos[i % 3], shown[i % 3])) for i in range(18)]
        for i, job in jobs:
            for size, values in job.result().items():
                assert np.allclose(values.ravel(), expected[i % 3][size].ravel(), atol=0.01)
    assert lite.note == ""


def test_where_the_gpu_goes_away_litert_goes_on_and_says_so(server: Server, environment: Environment) -> None:
    picture = pictures(224, 1)[0]
    network, asked = network_of("blazepose_detector"), network_of("blazepose_detector")
    before = network(picture)
    server.close()
    after = network(picture)
    assert not network.on_gpu
    assert "the GPU does not compute it" in network.note
    assert all(np.allclose(before[s].ravel(), after[s].ravel(), atol=0.01) for s in after)
    environment(PBL_ONNX_DEVICE="cuda")
    refused("DEVICE_UNAVAILABLE", asked, picture)


def test_a_graph_that_the_reader_does_not_know_is_left_to_litert(
    server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    from pbl_pipeline.models import tflite_jax

    monkeypatch.delitem(tflite_jax._OPERATIONS, "DEPTH_TO_SPACE")
    network = network_of("blazepose_detector")
    assert not network.on_gpu
    assert "DEPTH_TO_SPACE" in network.note


class Sums:
    """A network without a file: the sum of a picture's bytes, and so many zeros that no socket holds 16 answers."""

    image_shape, sizes, batch, device = (4, 4, 3), [1, 100_000], 4, "none"
    go_on = threading.Event()

    def __init__(self, *_: object) -> None:
        self.go_on.set()

    def __call__(self, images: np.ndarray) -> np.ndarray:
        assert self.go_on.wait(60)
        found = np.zeros((len(images), sum(self.sizes)), np.float32)
        found[:, 0] = images.reshape(len(images), -1).sum(1)
        return found


SPEC = NetworkSpec("sums", "", None, 1.0)


@pytest.fixture
def sums(server: Server, monkeypatch: pytest.MonkeyPatch) -> str:
    """Address of the server with a stand-in for the network; clients and server are patient for a second."""
    monkeypatch.setattr(gpu_server, "Program", Sums)
    monkeypatch.setattr(gpu_server, "CLIENT_S", 1.0, raising=False)
    monkeypatch.setattr(network, "PATIENCE_S", 3.0, raising=False)
    return gpu_address.running_server(gpu_address.NETWORKS)


def opened(address: str, sent: bytes = b"") -> socket.socket:
    found = socket.socket(socket.AF_UNIX)
    found.connect(address)
    found.sendall(sent)
    return found


def connection(address: str, spec: object) -> socket.socket:
    return opened(address, json.dumps(spec).encode() + b"\n")


def joined(address: str, size: int = AT_ONCE * 48) -> socket.socket:
    """A client after its first lines; `size`: bytes of the memory that it shares."""
    found = connection(address, dataclasses.asdict(SPEC))
    receive_line(found)
    share_memory(found, size)
    return found


def shortened(address: str) -> socket.socket:
    """A client whose memory has become shorter than it was."""
    found = connection(address, dataclasses.asdict(SPEC))
    receive_line(found)
    file = os.memfd_create("pictures")
    os.ftruncate(file, AT_ONCE * 48)
    socket.send_fds(found, [b"m"], [file])
    found.settimeout(5.0)
    while found.recv(1):  # it is dropped before a picture is read
        pass
    return found


def asking(place: int, address: str, times: int = 1) -> socket.socket:
    found = joined(address)
    found.sendall(bytes([place]) * times)
    return found


BROKEN = {
    "a place that does not exist": lambda at: asking(200, at),
    "one place too far": lambda at: asking(AT_ONCE, at),
    "takes no answers": lambda at: asking(0, at, 64),
    "memory of another size": lambda at: joined(at, 100),
    "memory for no picture": lambda at: joined(at, 10),
    "shortened memory": shortened,
    "other lines": lambda at: [connection(at, given) for given in ([], 3, {"outputs": 5}, {}, {"outputs": None})],
    "says nothing": lambda at: [opened(at) for _ in range(20)],
    "half a line": lambda at: [opened(at, b"{") for _ in range(20)],
}


def test_a_gpu_that_is_too_small_computes_fewer_pictures_at_a_time() -> None:
    program: Any = object.__new__(gpu_server.Program)
    room = 4

    def run(_: object, images: np.ndarray) -> np.ndarray:
        if len(images) > room:
            raise RuntimeError("RESOURCE_EXHAUSTED: out of memory")
        return images[:, 0, 0, :1].astype(np.float32)

    program.batch, program._weights, program._run = 16, None, run
    pictures = np.arange(16, dtype=np.uint8)[:, None, None, None]
    assert program(pictures).ravel().tolist() == [*range(16)]
    assert program.batch == room
    room = 1
    with pytest.raises(RuntimeError, match="RESOURCE_EXHAUSTED"):  # then the CPU computes
        program(pictures)


@pytest.mark.parametrize("kind", BROKEN)
def test_a_broken_client_is_dropped_and_others_get_their_answers(sums: str, kind: str) -> None:
    healthy = network._Remote(sums, SPEC)
    picture = np.full((4, 4, 3), 7, np.uint8)
    broken = BROKEN[kind](sums)
    with ThreadPoolExecutor(20) as threads:
        jobs = [threads.submit(where, picture) for where in (healthy, network._Remote(sums, SPEC)) for _ in range(10)]
        assert [job.result(30)[1].item() for job in jobs] == [7 * 48] * 20
    del broken


def test_where_the_gpu_gives_no_answer_clients_go_on_on_the_cpu(sums: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Network, "_load", lambda _: lambda image: {1: image.sum()})
    asked = Network("sums", "", 1.0)
    Sums.go_on.clear()
    with ThreadPoolExecutor(40) as threads:  # more than the process takes at once
        jobs = [threads.submit(asked, np.ones((4, 4, 3), np.uint8)) for _ in range(40)]
        assert [job.result(30)[1] for job in jobs] == [48] * 40
    Sums.go_on.set()
    assert not asked.on_gpu
    assert "no" in asked.note


@pytest.mark.long
def test_keypoints_do_not_depend_on_what_computed_them(
    server: Server, tmp_path: Path, environment: Environment
) -> None:
    """Of a clip from the file on: rounding in an earlier stage moves no crop, so it stays rounding."""
    frames = [f.image for f in read_frames(assets.fetch("demo_video"), 60, 120)]
    video = write_video(tmp_path / "clip.mp4", frames, np.arange(len(frames)) / 30.0, crf=18)
    method = METHODS.find("blazepose-33")
    by_jax = clip_keypoints(video, tmp_path / "people.jpg", method)
    environment(PBL_ONNX_DEVICE="cpu")
    by_litert = clip_keypoints(video, tmp_path / "people.jpg", method)
    assert (by_jax.origin, by_litert.origin) == ("blazepose on cpu", "")
    for apart, median, most in zip(differences(by_jax, by_litert), (0.1, 1.0), (0.5, 4.0), strict=True):
        assert np.median(apart) < median
        assert np.percentile(apart, 99) < most
