"""Model folders: what `model.json` must say, what the graph must be, the registry, `pbl models`."""

import contextlib
import copy
import functools
import hashlib
import http.server
import json
import re
import shutil
import tarfile
import threading
import zipfile
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest

from pbl_pipeline import fit, models
from pbl_pipeline.body import MARKER_SETS, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.keypoints import METHODS, ModelKeypointParams
from pbl_pipeline.models import spec
from pbl_pipeline.paramset import Paramset
from tests import Environment, dot_models, refused
from tests.command import pbl
from tests.dot_models import changed


@functools.cache
def graph() -> onnx.ModelProto:
    return dot_models.crop3d(dot_models.person(), (64, 64))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return dot_models.write(tmp_path / "dots", graph(), dot_models.spec("crop3d", (64, 64)))


@pytest.fixture
def registry(tmp_path: Path, environment: Environment) -> Path:
    environment(PBL_MODELS=tmp_path / "models", PBL_ONNX_DEVICE=None)
    return tmp_path / "models"


# --- model.json


def test_a_sound_spec(folder):
    spec = models.load_spec(folder)
    assert spec.joint_names == dot_models.NAMES
    assert (spec.pixel_origin, spec.box_margin, spec.input.std) == ("centre", 1.0, (255.0, 255.0, 255.0))
    left, right = dot_models.NAMES.index("left_knee"), dot_models.NAMES.index("right_knee")
    assert spec.mirror[left] == right
    assert spec.mirror[right] == left
    assert spec.mirror[0] == 0
    assert sorted(spec.mirror) == list(range(10))


def test_what_is_no_number_of_the_result_does_not_change_the_hash(folder):
    before = models.load_spec(folder)
    assert models.load_spec(changed(folder, licence="other", comment="hello")).spec_sha256 == before.spec_sha256
    assert models.load_spec(changed(folder, box_margin=1.2)).spec_sha256 != before.spec_sha256


BAD_FIELDS = {
    "no licence": {"licence": None},
    "a field nobody knows": {"colour": "RGB"},
    "a name that is a path": {"name": "../dots"},
    "an unknown kind": {"kind": "crop4d"},
    "an output too few": {"outputs": {"coords2d": "coords2d"}},
    "a checksum that is none": {"sha256": "abc"},
    "a name twice": {"joint_names": [*dot_models.NAMES[:-1], "head"]},
    "an unknown origin of pixels": {"pixel_origin": "corner"},
    "a margin that is no number": {"box_margin": "1.2"},
    "a pair of nobody": {"mirror_pairs": [["left_hip", "tail"]]},
    "a point of both pairs": {"mirror_pairs": [["left_hip", "right_hip"], ["left_hip", "right_knee"]]},
    "a side without the other": {"mirror_pairs": [["left_hip", "right_hip"]]},
    "an input that is none": {"input": "image"},
    "a standard deviation of zero": {"input": dot_models.spec("crop3d")["input"] | {"std": [0, 1, 1]}},
    "a width of a half": {"input": dot_models.spec("crop3d")["input"] | {"width": 31.5}},
    "a layout of nobody": {"input": dot_models.spec("crop3d")["input"] | {"layout": "CHWN"}},
    "a marker set with a long name": {"marker_set": "x" * 40},
}


@pytest.mark.parametrize("what", BAD_FIELDS)
def test_a_spec_that_is_wrong_is_refused_by_code(folder, what):
    text = refused("MODEL_INVALID", models.load_spec, changed(folder, **BAD_FIELDS[what])).text()
    assert "docs/models.md" in text
    assert str(folder / "model.json") in text


@pytest.mark.parametrize("text", ["", "{", "[1]", "null"])
def test_a_spec_that_is_no_json_object(folder, text):
    (folder / "model.json").write_text(text)
    refused("MODEL_INVALID", models.load_spec, folder)


def test_names_of_a_marker_set_of_the_body_are_checked(folder):
    error = refused("MARKER_SET_UNKNOWN", models.load_spec, changed(folder, marker_set="halpe_26"))
    assert "left_big_toe" in error.text()


@pytest.mark.parametrize("name", MARKER_SETS)
def test_pairs_told_by_the_names_are_mirror_images_on_the_body(name):
    """All points off the midline have a partner, and it lies on the other side of the body."""
    markers = marker_set(name)
    pairs = models.mirror_pairs(markers.names)
    place = dict(zip(markers.names, markers.position_m, strict=True))
    for left, right in pairs:
        np.testing.assert_allclose(place[left] * [1, 1, -1], place[right], atol=1e-9)
    paired = {n for p in pairs for n in p}
    assert len(paired) == 2 * len(pairs)
    # The published sites scatter about the midline by 2 cm.
    assert all(abs(place[n][2]) < 0.02 for n in set(markers.names) - paired)


ROOT = Path(__file__).resolve().parents[2]


def test_the_page_names_every_field_kind_and_role():
    text = (ROOT / "docs" / "models.md").read_text()
    table = text.split("| field of `model.json` |")[1].split("\n\n")[0]
    fields = {f for line in table.splitlines() for f in re.findall(r"`([a-z0-9_]+)`", line.split("|")[1])}
    known = {*spec._REQUIRED, *spec._POINTS, *spec._OPTIONAL_POINTS, *spec._OPTIONAL}
    assert fields == known
    assert all(f"`{n}`" in table for n in spec._INPUT)
    kinds = text.split("| kind | role |")[1].split("\n\n")[0]
    assert {k for line in kinds.splitlines() for k in re.findall(r"`([a-z0-9_]+)`", line.split("|")[1])} == set(
        models.KINDS
    )
    assert all(f"`{role}`" in kinds for roles in models.KINDS.values() for role in roles)


def test_the_example_of_the_page_is_a_sound_spec():
    text = (ROOT / "docs" / "models.md").read_text()
    content = json.loads(re.findall(r"```json\n(.*?)```", text, re.DOTALL)[0])
    spec = models.parse_spec(content | {"sha256": "0" * 64}, "docs/models.md")
    assert len(spec.joint_names) == 26
    assert sum(i != m for i, m in enumerate(spec.mirror)) == 22


# --- the graph


def test_a_sound_model_runs_for_any_batch(folder):
    model = models.OnnxModel(folder)
    assert (model.device, model.note, model.fixed_batch) == ("cpu", "", None)
    out = model(np.zeros((3, 64, 64, 3), np.uint8))
    assert {k: v.shape for k, v in out.items()} == {"coords2d": (3, 10, 2), "coords3d": (3, 10, 3)}


def test_a_graph_of_a_fixed_batch_is_called_as_often_as_it_takes(folder, tmp_path):
    fixed = copy.deepcopy(graph())
    for value in (*fixed.graph.input, *fixed.graph.output):
        value.type.tensor_type.shape.dim[0].dim_value = 2
    model = models.OnnxModel(dot_models.write(tmp_path / "fixed", fixed, dot_models.spec("crop3d", (64, 64))))
    crops = np.random.default_rng(0).integers(0, 256, (5, 64, 64, 3), np.uint8)
    assert model.fixed_batch == 2
    for role, array in models.OnnxModel(folder)(crops).items():
        np.testing.assert_allclose(model(crops)[role], array, rtol=1e-4, atol=1e-3)


def echo(folder: Path, layout: str, colour: str, **changes) -> Path:
    """A heatmap model of three points that returns its input: what the network gets to see."""
    shape = ["N", 3, 16, 24] if layout == "NCHW" else ["N", 16, 24, 3]
    node = onnx.helper.make_node("Transpose", ["image"], ["heatmap"], perm=[0, 3, 1, 2])
    if layout == "NCHW":
        node = onnx.helper.make_node("Identity", ["image"], ["heatmap"])
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph([node], "echo", [value("image", 1, shape)], [value("heatmap", 1, ["N", 3, 16, 24])])
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)])
    model.ir_version = 9
    entry = {"name": "image", "width": 24, "height": 16, "layout": layout, "colour": colour}
    entry |= {"mean": [10.0, 20.0, 30.0], "std": [2.0, 4.0, 8.0]}
    fields = dot_models.spec("heatmap", (24, 16), input=entry, joint_names=["a", "b", "c"], **changes)
    return dot_models.write(folder, model, fields)


@pytest.mark.parametrize("layout", ["NCHW", "NHWC"])
@pytest.mark.parametrize("colour", ["RGB", "BGR"])
def test_what_the_network_sees(tmp_path, layout, colour):
    model = models.OnnxModel(echo(tmp_path, layout, colour))
    crops = np.random.default_rng(1).integers(0, 256, (2, 16, 24, 3), np.uint8)
    seen = model(crops, np.array([1.0, 0.6]))["heatmap"]
    for n, gamma in enumerate((1.0, 0.6)):
        value = 255.0 * (crops[n].astype(float) / 255) ** gamma
        ordered = value[..., ::-1] if colour == "RGB" else value
        wanted = (ordered - [10, 20, 30]) / [2, 4, 8]
        np.testing.assert_allclose(seen[n], wanted.transpose(2, 0, 1), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize(
    ("changes", "found"),
    [
        ({"outputs": {"coords2d": "xy", "coords3d": "coords3d"}}, "no output xy (it has coords2d, coords3d)"),
        ({"joint_names": [n for n in dot_models.NAMES if not n.endswith("knee")]}, "of shape (1, 10, 2)"),
        ({"input": dot_models.spec("crop3d", (96, 64))["input"]}, "an input of shape"),
        ({"input": dot_models.spec("crop3d", (64, 64))["input"] | {"name": "picture"}}, "inputs image"),
    ],
    ids=["output names", "joint count", "size of the picture", "input name"],
)
def test_a_graph_that_differs_from_its_spec(folder, changes, found):
    error = refused("MODEL_INVALID", models.OnnxModel, changed(folder, **changes))
    assert found in error.found
    assert "joint_names" not in changes or "8 points" in error.expected


def test_a_wrong_checksum(folder):
    error = refused("MODEL_CHECKSUM", models.OnnxModel, changed(folder, sha256="0" * 64))
    assert hashlib.sha256((folder / "model.onnx").read_bytes()).hexdigest() in error.found


def test_an_opset_the_runtime_does_not_know(tmp_path):
    new = copy.deepcopy(graph())
    new.opset_import[0].version = 9999
    folder = dot_models.write(tmp_path / "new", new, dot_models.spec("crop3d", (64, 64)))
    assert "onnxruntime loads" in refused("MODEL_INVALID", models.OnnxModel, folder).expected


@pytest.mark.parametrize(
    ("changes", "reasons"),
    [
        ({"ir_version": 99}, ("Unsupported model IR version: 99, max supported IR version",)),
        ({"opset": 99}, ("Opset 99 is under development", "Current official support for domain ai.onnx is till opset")),
        ({"op_type": "Nonesuch"}, ("No Op registered for Nonesuch",)),
    ],
)
def test_the_reason_of_the_runtime_is_stated_to_its_end(tmp_path, changes, reasons):
    new = copy.deepcopy(graph())
    new.ir_version = changes.get("ir_version", new.ir_version)
    new.opset_import[0].version = changes.get("opset", new.opset_import[0].version)
    new.graph.node[0].op_type = changes.get("op_type", new.graph.node[0].op_type)
    folder = dot_models.write(tmp_path / "new", new, dot_models.spec("crop3d", (64, 64)))
    found = refused("MODEL_INVALID", models.OnnxModel, folder).found
    assert all(reason in found for reason in reasons), found
    assert "onnxruntime_src" not in found
    assert len(found) < 550


def test_a_file_that_is_no_graph(tmp_path, folder):
    (folder / "model.onnx").write_bytes(b"not a graph")
    sha256 = hashlib.sha256(b"not a graph").hexdigest()
    refused("MODEL_INVALID", models.OnnxModel, changed(folder, sha256=sha256))


def test_no_graph_at_all(folder):
    (folder / "model.onnx").unlink()
    refused("MODEL_MISSING", models.OnnxModel, folder)
    refused("MODEL_MISSING", models.OnnxModel, folder / "nowhere")


# --- devices


def test_cuda_asked_for_and_absent_is_an_error(folder, monkeypatch, environment):
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: ["CPUExecutionProvider"])
    assert "onnxruntime-gpu" in refused("DEVICE_UNAVAILABLE", models.OnnxModel, folder, "cuda").next_step
    environment(PBL_ONNX_DEVICE="cuda")
    refused("DEVICE_UNAVAILABLE", models.OnnxModel, folder)
    environment(PBL_ONNX_DEVICE="tpu")
    refused("USAGE", models.OnnxModel, folder)


REAL_SESSION = onnxruntime.InferenceSession


class Falls:
    """A runtime with a CUDA provider whose sessions begin on the CPU, as onnxruntime does without a driver."""

    def __init__(self, *arguments, providers, provider_options, **more):
        assert providers[0] == "CUDAExecutionProvider"
        assert "device_id" in provider_options[0]
        self.inner = REAL_SESSION(*arguments, providers=["CPUExecutionProvider"], **more)

    def __getattr__(self, name):
        return getattr(self.inner, name)


def test_cuda_that_does_not_start_is_never_silent(folder, monkeypatch, environment):
    environment(PBL_ONNX_DEVICE=None)
    there = ["CUDAExecutionProvider", "CPUExecutionProvider"]
    monkeypatch.setattr(onnxruntime, "get_available_providers", lambda: there)
    monkeypatch.setattr(onnxruntime, "InferenceSession", Falls)
    assert "does not start" in refused("DEVICE_UNAVAILABLE", models.OnnxModel, folder, "cuda").found
    model = models.OnnxModel(folder, "auto")
    assert model.device == "cpu"
    assert "CUDA" in model.note


# --- the registry


def test_add_list_verify_remove(folder, registry):
    done = pbl("models", "add", folder)
    assert done.code == 0, done.err
    assert "CC0-1.0" in done.out
    assert "not a set of the body" in done.out
    assert sorted(p.name for p in (registry / "dots-crop3d").iterdir()) == ["model.json", "model.onnx"]
    listed = pbl("models", "list")
    assert "dots-crop3d: crop3d, 10 points" in listed.out
    assert "licence: CC0-1.0, a test" in listed.out
    assert "4 pairs" in listed.out
    assert "dots-crop3d: ok on cpu" in pbl("models", "verify").out
    assert pbl("models", "remove", "dots-crop3d").code == 0
    assert not (registry / "dots-crop3d").exists()
    assert pbl("models", "remove", "dots-crop3d").error_code == "MODEL_MISSING"
    assert "no registered model" in pbl("models", "list").out


def test_what_is_wrong_is_not_registered(folder, registry):
    assert pbl("models", "add", changed(folder, sha256="0" * 64)).error_code == "MODEL_CHECKSUM"
    assert not (registry / "dots-crop3d").exists()
    assert pbl("models", "add", folder / "nowhere.zip").error_code == "MODEL_MISSING"


def test_a_registered_model_that_changed_is_named(folder, registry):
    models.add(folder)
    with (registry / "dots-crop3d" / "model.onnx").open("ab") as file:
        file.write(b"\0")
    listed = pbl("models", "list")
    assert listed.code == 1
    assert "MODEL_CHECKSUM" in listed.out
    assert pbl("models", "verify", "dots-crop3d").error_code == "MODEL_CHECKSUM"
    # The others are looked at all the same.
    models.add(changed(folder, name="sound"))
    every = pbl("models", "verify")
    assert every.error_code == "MODEL_CHECKSUM"
    assert "dots-crop3d: MODEL_CHECKSUM" in every.out
    assert "sound: ok on cpu" in every.out


def test_a_name_that_is_a_path_is_no_registered_model(folder, registry):
    models.add(folder)
    assert models.is_registered("dots-crop3d")
    assert (registry / "../dots" / "model.json").is_file()
    for name in ("../dots", str(folder), ".hidden"):
        assert not models.is_registered(name)
    refused("MODEL_MISSING", models.remove, "../dots")
    assert folder.is_dir()


def test_another_model_under_the_name(folder, registry):
    models.add(folder)
    models.add(folder)  # the same again: nothing changes
    changed(folder, box_margin=1.3)
    assert pbl("models", "add", folder).error_code == "USAGE"
    assert models.load_spec(registry / "dots-crop3d").box_margin == 1.0
    assert pbl("models", "add", folder, "--replace").code == 0
    assert models.load_spec(registry / "dots-crop3d").box_margin == 1.3
    assert [p.name for p in registry.iterdir()] == ["dots-crop3d"]


def packed(folder: Path, suffix: str) -> Path:
    """An archive of the model in this folder."""
    kind = {"zip": "zip", "tar.gz": "gztar", "tar.xz": "xztar"}[suffix]
    return Path(shutil.make_archive(str(folder / "packed"), kind, folder, "dots"))


@pytest.mark.parametrize("suffix", ["zip", "tar.gz"])
def test_add_from_an_archive(folder, registry, tmp_path, suffix):
    (folder / "extra.py").write_text("raise SystemExit")
    archive = packed(tmp_path, suffix)
    spec, _ = models.add(archive, hashlib.sha256(archive.read_bytes()).hexdigest())
    assert spec.name == "dots-crop3d"
    assert not (registry / "dots-crop3d" / "extra.py").exists()
    refused("MODEL_CHECKSUM", models.add, archive, "0" * 64)


def test_an_archive_cannot_write_elsewhere(folder, registry, tmp_path):
    """Only the files' own names count, whatever path an archive gives them."""
    archive = tmp_path / "evil.tar"
    with tarfile.open(archive, "w") as tar:
        for name in ("model.json", "model.onnx"):
            tar.add(folder / name, f"../../up/{name}")
    models.add(archive)
    assert not (tmp_path.parent / "up").exists()
    assert (registry / "dots-crop3d").is_dir()
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as two:
        two.write(folder / "model.json", "a/model.json")
        two.write(folder / "model.json", "b/model.json")
    assert "2 files" in refused("MODEL_INVALID", models.add, tmp_path / "two.zip").found
    (tmp_path / "none.zip").write_bytes(b"PK")
    refused("MODEL_INVALID", models.add, tmp_path / "none.zip")
    # The graph alone is no model.
    text = refused("MODEL_INVALID", models.add, folder / "model.onnx").text()
    assert "a folder with model.json" in text
    assert len(text.splitlines()) == 5


@pytest.mark.parametrize("suffix", ["zip", "tar.gz", "tar.xz"])
def test_an_archive_with_wrong_bytes(folder, registry, tmp_path, suffix):
    """Whatever is wrong inside, it has a code, and nothing of it is registered."""
    data = packed(tmp_path, suffix).read_bytes()
    for place in np.linspace(20, len(data) - 20, 40).astype(int):
        spoiled = bytearray(data)
        spoiled[place : place + 4] = bytes(255 - b for b in data[place : place + 4])
        (tmp_path / f"spoiled.{suffix}").write_bytes(spoiled)
        with contextlib.suppress(PblError):
            models.add(tmp_path / f"spoiled.{suffix}")
    assert {m.error for m in models.registered()} <= {None}


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass


def test_add_from_an_address(folder, registry, tmp_path, environment):
    environment(PBL_OFFLINE=None, no_proxy="127.0.0.1")
    archive = packed(tmp_path, "zip")
    sha256 = hashlib.sha256(archive.read_bytes()).hexdigest()
    handler = functools.partial(Quiet, directory=str(tmp_path))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        base = f"http://127.0.0.1:{server.server_address[1]}"
        try:
            assert pbl("models", "add", f"{base}/packed.zip").error_code == "USAGE"
            assert pbl("models", "add", f"{base}/packed.zip", "--sha256", "1" * 64).error_code == "MODEL_CHECKSUM"
            assert pbl("models", "add", f"{base}/gone.zip", "--sha256", sha256).error_code == "MODEL_MISSING"
            for address in ("http://127 0 0 1/a.zip", "http://[::1/a.zip", "https://"):
                assert pbl("models", "add", address, "--sha256", sha256).error_code == "MODEL_MISSING"
            assert pbl("models", "add", f"{base}/packed.zip", "--sha256", sha256).code == 0
            environment(PBL_OFFLINE="1")
            assert pbl("models", "add", f"{base}/packed.zip", "--sha256", sha256).error_code == "MODEL_MISSING"
        finally:
            server.shutdown()
    assert models.is_registered("dots-crop3d")


# --- methods


def test_a_registered_model_is_a_keypoint_method(folder, registry):
    refused("SOLVER_UNKNOWN", METHODS.find, "dots-crop3d")
    models.add(folder)
    method = METHODS.find("dots-crop3d")
    params = method.params
    assert isinstance(params, ModelKeypointParams)
    assert params.model.licence == "CC0-1.0, a test"
    assert params.model.n_augmentations == 10
    # What was measured with BlazePose is not said of another network.
    assert (params.confidence_curve, params.sides) == ("", None)
    assert params.model_sha256 == models.load_spec(folder).sha256
    # What a database hands back: JSON, numbers without their point.
    again = json.loads(
        method.paramset.canonical_json, parse_float=lambda t: int(float(t)) if float(t).is_integer() else float(t)
    )
    stored = Paramset(method.stage, method.name, method.version, again)
    assert METHODS.find(stored) == method


def test_another_graph_or_spec_is_another_method(folder, registry):
    models.add(folder)
    first = METHODS.find("dots-crop3d")
    models.add(changed(folder, pixel_origin="edge"), replace=True)
    second = METHODS.find("dots-crop3d")
    assert first.hash != second.hash
    models.add(changed(folder, pixel_origin="centre", comment="as before"), replace=True)
    assert METHODS.find("dots-crop3d").hash != second.hash


def still(kind: str, names: list[str]) -> onnx.ModelProto:
    """A model that gives the same points for every picture."""
    g = dot_models.Graph()
    zero = g("Mul", g("ReduceMean", "image", axes=[1, 2, 3], keepdims=0), g.const(0.0))
    zero = g("Unsqueeze", zero, g.const([1, 2], np.int64))
    shapes = {"coords2d": (1, len(names), 2), "coords3d": (1, len(names), 3)} if kind == "crop3d" else {}
    shapes = shapes or {"simcc_x": (1, len(names), 64), "simcc_y": (1, len(names), 64)}
    for role, shape in shapes.items():
        g("Add", zero, g.const(np.zeros(shape)), out=role)
    value = onnx.helper.make_tensor_value_info
    outputs = [value(role, 1, ["N", *shape[1:]]) for role, shape in shapes.items()]
    return g.build([value("image", 1, ["N", 3, 32, 32])], outputs)


@pytest.mark.parametrize(
    ("kind", "markers", "paramset"),
    [
        ("crop3d", "bml_movi_87", "gauss-newton"),
        ("crop3d", "mpi_inf_3dhp_17", fit.METHODS.default),
        ("simcc", "bml_movi_87", fit.METHODS.default),
    ],
)
def test_the_fit_that_suits_the_points(registry, tmp_path, kind, markers, paramset):
    names = list(marker_set(markers).names)
    fields = dot_models.spec(kind, (32, 32), name="still", marker_set=markers, joint_names=names)
    models.add(dot_models.write(tmp_path / "still", still(kind, names), fields))
    assert fit.default_fit(METHODS.find("still").params.points()) == paramset
    assert fit.default_fit(METHODS.find(None).params.points()) == fit.METHODS.default
