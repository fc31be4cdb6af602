"""The export script of docs/metrabs.md, with a randomly initialised network that has MeTRAbs' interface.

torch is not a dependency of the project: without it these tests skip. To run them, install torch, onnx and onnxscript
beside the project and `pytest -m needs_extra research/tests/test_export_metrabs.py`.
"""

import pickle
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from pbl_pipeline import models
from pbl_pipeline.body import marker_set
from research import export_metrabs
from research.export_metrabs import ExportError, export, matched_names

NAMES = list(marker_set("bml_movi_87").names)
SIDE, RAW = 64, 100


# --- names, without torch


def test_names_with_metrabs_ending_and_in_another_order():
    found = [f"{n.lower()}_bmlmovi" for n in reversed(NAMES)]
    assert matched_names(found, NAMES, {}) == NAMES[::-1]


def test_names_that_differ_are_not_guessed_by_their_order():
    found = ["pelv" if n == "mhip" else n for n in NAMES]
    with pytest.raises(ExportError, match=r"without a partner: pelv; the marker set's: mhip"):
        matched_names(found, NAMES, {})
    assert matched_names(found, NAMES, {"pelv": "mhip"}) == NAMES
    with pytest.raises(ExportError, match="twice: CHip"):
        matched_names(found, NAMES, {"pelv": "CHip"})
    with pytest.raises(ExportError, match="86 points"):
        matched_names(NAMES[:-1], NAMES, {})


def test_the_table_of_the_marker_set_is_read_without_the_project():
    assert export_metrabs.marker_names(export_metrabs.MARKERS) == NAMES


def test_without_metrabs_it_says_what_is_missing(tmp_path, capsys):
    arguments = ["--model-dir", str(tmp_path), "--out", str(tmp_path / "o"), "--name", "m", "--licence", "none"]
    assert export_metrabs.main(arguments) == 1
    assert "docs/metrabs.md" in capsys.readouterr().err


# --- with torch


@pytest.fixture
def torch() -> Any:
    pytest.importorskip("onnxscript", reason="torch and onnxscript are not dependencies of the project")
    return pytest.importorskip("torch", reason="torch is not a dependency of the project")


def make_network(torch: Any, n_points: int = RAW) -> Any:
    """A small random network with MeTRAbs' interface: a backbone of stride 32, heat maps in 2D and 3D, soft-argmax."""

    class Heads(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.depth = 4
            self.final = torch.nn.LazyConv2d(n_points * (1 + self.depth), 1)

        def forward(self, features: Any) -> tuple[Any, Any]:
            x = self.final(features)
            flat, deep = x[:, :n_points], x[:, n_points:]
            n, _, h, w = x.shape
            flat = torch.softmax(flat.reshape(n, n_points, h * w), dim=2).reshape(n, n_points, h, w)
            deep = deep.reshape(n, self.depth, n_points, h, w).transpose(1, 2)
            deep = torch.softmax(deep.reshape(n, n_points, -1), dim=2).reshape(deep.shape)
            xs, ys, zs = (torch.linspace(0.0, 1.0, k) for k in (w, h, self.depth))
            last = SIDE - 32
            coords2d = torch.stack([(flat.sum(2) * xs).sum(2), (flat.sum(3) * ys).sum(2)], dim=2) * last + 16
            x3, y3 = (deep.sum((2, 3)) * xs).sum(2), (deep.sum((2, 4)) * ys).sum(2)
            z3 = (deep.sum((3, 4)) * zs).sum(2)
            return coords2d, torch.stack([x3, y3, z3], dim=2) * 2200.0

    class Network(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            layers = []
            for a, b in ((3, 8), (8, 16), (16, 16), (16, 24), (24, 32)):
                layers += [torch.nn.Conv2d(a, b, 3, 2, 1), torch.nn.BatchNorm2d(b), torch.nn.SiLU()]
            self.backbone = torch.nn.Sequential(*layers)
            self.heatmap_heads = Heads()

        def forward(self, inputs: Any) -> Any:
            return self.heatmap_heads(self.backbone(inputs[0]))

    torch.manual_seed(0)
    network = Network().eval()
    network((torch.zeros(1, 3, SIDE, SIDE), None))
    # As made, all pictures look alike to it.
    network.heatmap_heads.final.weight.data *= 500
    return network


def random_selection() -> np.ndarray:
    """80 joints as they are and 7 means of two."""
    selection = np.zeros((RAW, 87), np.float32)
    for j in range(80):
        selection[j + 3, j] = 1
    for j in range(80, 87):
        selection[[j, j + 13], j] = [0.25, 0.75]
    return selection


@pytest.mark.needs_extra
def test_the_folder_is_a_model_that_computes_what_the_network_does(torch, tmp_path, monkeypatch):
    network, selection = make_network(torch), random_selection()
    folder = export(
        network,
        SIDE,
        selection,
        NAMES,
        tmp_path / "m",
        name="metrabs-random",
        licence="a test",
        source="random",
        marker_set="bml_movi_87",
    )
    monkeypatch.setenv("PBL_MODELS", str(tmp_path / "models"))
    spec, model = models.add(folder)
    assert spec.marker_set == "bml_movi_87"
    assert model.fixed_batch is None
    crops = np.random.default_rng(0).integers(0, 256, (3, SIDE, SIDE, 3), np.uint8)
    image = torch.from_numpy(np.ascontiguousarray(crops[..., ::-1].transpose(0, 3, 1, 2)).astype(np.float32) / 255)
    with torch.inference_mode():
        raw2d, raw3d = (r.numpy() for r in network((image, None)))
    got = model(crops)
    np.testing.assert_allclose(got["coords2d"], np.einsum("nrk,rj->njk", raw2d, selection), atol=0.01)
    np.testing.assert_allclose(got["coords3d"], np.einsum("nrk,rj->njk", raw3d, selection), atol=0.1)
    # It tells the pictures apart, so the comparison means something.
    assert np.median(np.ptp(got["coords3d"], axis=0)) > 10
    assert np.median(np.ptp(got["coords2d"], axis=0)) > 0.2


@pytest.mark.needs_extra
def test_weights_that_do_not_add_up(torch, tmp_path):
    with pytest.raises(ExportError, match="add up"):
        export(
            make_network(torch),
            SIDE,
            2 * random_selection(),
            NAMES,
            tmp_path,
            name="m",
            licence="l",
            source="s",
            marker_set="bml_movi_87",
        )


@pytest.mark.needs_extra
def test_the_whole_program_on_a_folder_like_the_published_one(torch, tmp_path, monkeypatch):
    """MeTRAbs' package is replaced by modules of the same names that make the random network."""
    network = make_network(torch)
    folder = tmp_path / "checkpoint"
    folder.mkdir()
    torch.save(network.state_dict(), folder / "ckpt.pt")
    (folder / "config.yaml").write_text("proc_side: 64\n")
    np.savez(folder / "joint_info.npz", joint_names=np.arange(RAW).astype(str), joint_edges=np.zeros((1, 2), int))
    order = np.random.default_rng(1).permutation(87)
    all_joints = np.concatenate([np.zeros((RAW, 5), np.float32), random_selection()], axis=1)
    np.save(folder / "joint_transform_matrix.npy", all_joints)
    infos = {"bml_movi_87": {"indices": list(order + 5), "names": [f"{NAMES[i]}_bmlmovi" for i in order]}}
    (folder / "skeleton_infos.pkl").write_bytes(pickle.dumps(infos))
    config = SimpleNamespace(
        affine_weights=None,
        transform_coords=False,
        predict_all_and_latents=False,
        efficientnet_size="s",
        proc_side=SIDE,
    )

    class Metrabs:
        def __new__(cls, backbone: Any, joint_info: Any) -> Any:
            fresh = make_network(torch)
            for parameter in fresh.parameters():
                parameter.data.zero_()  # so that the weights are those of the checkpoint
            return fresh

    for module, content in {
        "metrabs_pytorch": {},
        "metrabs_pytorch.backbones": {},
        "metrabs_pytorch.backbones.efficientnet": {
            "efficientnet_v2_s": lambda: SimpleNamespace(features=torch.nn.Identity()),
            "PreprocLayer": torch.nn.Identity,
        },
        "metrabs_pytorch.models": {},
        "metrabs_pytorch.models.metrabs": {"Metrabs": Metrabs},
        "metrabs_pytorch.util": {"get_config": lambda path: config},
        "posepile": {},
        "posepile.joint_info": {"JointInfo": lambda names, edges: None},
    }.items():
        made = ModuleType(module)
        made.__dict__.update(content)
        monkeypatch.setitem(sys.modules, module, made)
        if "." in module:
            parent, name = module.rsplit(".", 1)
            setattr(sys.modules[parent], name, made)
    out = tmp_path / "metrabs-s"
    arguments = ["--model-dir", folder, "--out", out, "--name", "metrabs-s", "--licence", "a test"]
    assert export_metrabs.main([str(a) for a in arguments]) == 0
    model = models.OnnxModel(out, "cpu")
    # The skeleton has another order than the marker set: the points are put into the set's.
    crops = np.random.default_rng(2).integers(0, 256, (1, SIDE, SIDE, 3), np.uint8)
    image = torch.from_numpy(np.ascontiguousarray(crops[..., ::-1].transpose(0, 3, 1, 2)).astype(np.float32) / 255)
    with torch.inference_mode():
        _, raw3d = (r.numpy() for r in network((image, None)))
    wanted = np.einsum("nrk,rj->njk", raw3d, random_selection())
    np.testing.assert_allclose(model(crops)["coords3d"], wanted, atol=0.1)
    assert list(model.spec.joint_names) == NAMES
    assert Path(out / "model.json").is_file()
