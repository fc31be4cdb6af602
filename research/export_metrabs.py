"""Turn a published MeTRAbs checkpoint (PyTorch) into a model folder for `pbl models add`; see docs/metrabs.md.

Runs where MeTRAbs runs, not where PBL does: it needs torch, numpy, onnx, onnxscript and onnxruntime, and for the
published checkpoint MeTRAbs' own package. It imports nothing of PBL and may be copied alone, together with the table of
the marker set.

    python export_metrabs.py --model-dir metrabs_eff2l_384px_pytorch --name metrabs-l --licence "..." --out metrabs-l
"""

# torch and MeTRAbs are on the lab's machine, not here.
# pyright: reportMissingImports=false

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import pickle
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

OPSET = 18
MARKERS = Path(__file__).resolve().parents[1] / "pbl_pipeline" / "body" / "data" / "markers_bml_movi_87.csv"
#: How far the exported graph may be from the network: px of the crop and mm.
TOLERANCE_PX, TOLERANCE_MM = 0.05, 0.5
#: Ending that MeTRAbs gives the names of this skeleton among all its joints.
SUFFIX = "_bmlmovi"


class ExportError(Exception):
    """An error in words."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Export by the command line; 0 when the folder was written and checked."""
    parser = argparse.ArgumentParser(description="Turn a published MeTRAbs checkpoint into a model folder for PBL.")
    parser.add_argument("--model-dir", type=Path, required=True, help="the unpacked checkpoint")
    parser.add_argument("--out", type=Path, required=True, help="folder to write")
    parser.add_argument("--name", required=True, help="name of the model, such as metrabs-l")
    parser.add_argument("--licence", required=True, help="the model's licence, in the words of its publisher")
    parser.add_argument("--source", default="", help="where the checkpoint comes from (default: the folder's name)")
    parser.add_argument("--skeleton", default="bml_movi_87", help="which of MeTRAbs' skeletons")
    parser.add_argument(
        "--markers", type=Path, default=MARKERS, help="table of the marker set, with its names in order"
    )
    parser.add_argument("--rename", type=Path, help="CSV: MeTRAbs' name, the marker set's; for names that differ")
    options = parser.parse_args(arguments)
    try:
        network, side = load_published(options.model_dir)
        selection, names = skeleton_of(options.model_dir, options.skeleton)
        wanted = marker_names(options.markers)
        renamed = matched_names(names, wanted, read_rename(options.rename))
        export(
            network,
            side,
            selection[:, [renamed.index(w) for w in wanted]],
            wanted,
            options.out,
            name=options.name,
            licence=options.licence,
            source=options.source or f"MeTRAbs, {options.model_dir.name}",
            marker_set=options.markers.stem.removeprefix("markers_"),
        )
    except ExportError as error:
        print(f"not exported: {error}", file=sys.stderr)  # noqa: T201 - a separate program
        return 1
    print(f"{options.out}: now `pbl models add {options.out}`")  # noqa: T201 - as above
    return 0


def load_published(folder: Path) -> tuple[Any, int]:
    """The crop network of an unpacked checkpoint, with its weights, and the side of its crop in px."""
    try:
        import torch
        from metrabs_pytorch.backbones import efficientnet
        from metrabs_pytorch.models.metrabs import Metrabs
        from metrabs_pytorch.util import get_config
        from posepile.joint_info import JointInfo
    except ImportError as error:
        raise ExportError(f"{error}: run this where MeTRAbs' PyTorch code runs (docs/metrabs.md)") from error
    needed = ("config.yaml", "joint_info.npz", "ckpt.pt")
    absent = [n for n in needed if not (folder / n).is_file()]
    if absent:
        raise ExportError(f"{folder} lacks {', '.join(absent)}: name the unpacked checkpoint")
    config = get_config(str(folder / "config.yaml"))
    if config.affine_weights or config.transform_coords or config.predict_all_and_latents:
        raise ExportError("this checkpoint predicts latent points, which this program does not turn into joints")
    joints = np.load(folder / "joint_info.npz")
    body = getattr(efficientnet, f"efficientnet_v2_{config.efficientnet_size}")()
    network = Metrabs(
        torch.nn.Sequential(efficientnet.PreprocLayer(), body.features),
        JointInfo(joints["joint_names"], joints["joint_edges"]),
    )
    network.eval()
    side = int(config.proc_side)
    with torch.inference_mode():  # its last layer takes its size from what it is first shown
        network.heatmap_heads(network.backbone(torch.zeros(1, 3, side, side)))
    network.load_state_dict(torch.load(folder / "ckpt.pt", map_location="cpu", weights_only=True))
    return network, side


def skeleton_of(folder: Path, skeleton: str) -> tuple[np.ndarray, list[str]]:
    """Weights (raw joints, J) that make the points of a skeleton out of the network's joints, and their names."""
    with (folder / "skeleton_infos.pkl").open("rb") as file:
        infos = pickle.load(file)  # noqa: S301 - part of the checkpoint that the lab trusts enough to run
    if skeleton not in infos:
        raise ExportError(f"no skeleton {skeleton}; there are {', '.join(sorted(infos))}")
    transform = np.load(folder / "joint_transform_matrix.npy").astype(np.float32)
    names = [str(n) for n in infos[skeleton]["names"]]
    return transform[:, np.asarray(infos[skeleton]["indices"])], names


def marker_names(table: Path) -> list[str]:
    """The names of a marker set, in its order."""
    lines = [t for t in table.read_text(encoding="utf-8-sig").splitlines() if t.strip() and not t.startswith("#")]
    return [row["name"] for row in csv.DictReader(lines)]


def read_rename(path: Path | None) -> dict[str, str]:
    """MeTRAbs' name -> the marker set's."""
    if path is None:
        return {}
    with path.open(encoding="utf-8-sig", newline="") as file:
        return {row[0].strip(): row[1].strip() for row in csv.reader(file) if len(row) >= 2}


def matched_names(found: Sequence[str], wanted: Sequence[str], rename: dict[str, str]) -> list[str]:
    """The marker set's name of each point of the skeleton. Names that do not match are never guessed by their order."""
    plain = {w.lower(): w for w in wanted}
    out = []
    for name in found:
        bare = name.removesuffix(SUFFIX)
        out.append(rename.get(name) or rename.get(bare) or plain.get(bare.lower()) or "")
    unknown = [n for n, o in zip(found, out, strict=True) if not o]
    lacking = [w for w in wanted if w not in out]
    twice = sorted({o for o in out if o and out.count(o) > 1})
    if unknown or lacking or twice or len(out) != len(wanted):
        raise ExportError(
            f"{len(found)} points, the marker set has {len(wanted)}; "
            f"MeTRAbs' names without a partner: {', '.join(unknown) or 'none'}; "
            f"the marker set's: {', '.join(lacking) or 'none'}; twice: {', '.join(twice) or 'none'}. "
            "Look them up in both descriptions and pass the pairs with --rename"
        )
    return out


def export(
    network: Any,
    side: int,
    selection: np.ndarray,
    names: Sequence[str],
    out: Path,
    *,
    name: str,
    licence: str,
    source: str,
    marker_set: str,
) -> Path:
    """Write `model.onnx` and `model.json` and compare the graph with the network.

    `network.backbone(image)` takes (N, 3, side, side) RGB in 0..1; `network.heatmap_heads` makes of it points
    (N, raw, 2) in px of the crop and (N, raw, 3) in mm. `selection` (raw, J): each column adds up to 1. A column with
    one 1 takes a joint as it is; another one is a mean of joints, in the picture too, where that is right but for
    perspective.
    """
    import onnxruntime
    import torch

    sums = selection.sum(axis=0)
    if np.abs(sums - 1).max() > 1e-3:
        raise ExportError(f"weights of the skeleton add up to {sums.min():.3f} to {sums.max():.3f}, not to 1")

    class Crop(torch.nn.Module):
        """The network with the points of one skeleton only."""

        def __init__(self) -> None:
            super().__init__()
            self.backbone, self.heads = network.backbone, network.heatmap_heads
            self.register_buffer("selection", torch.from_numpy(np.ascontiguousarray(selection, np.float32)).T)

        def forward(self, image: Any) -> tuple[Any, Any]:
            coords2d, coords3d = self.heads(self.backbone(image))
            return torch.matmul(self.selection, coords2d), torch.matmul(self.selection, coords3d)

    crop = Crop().eval()
    out.mkdir(parents=True, exist_ok=True)
    path = out / "model.onnx"
    with warnings.catch_warnings(), torch.inference_mode():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            crop,
            (torch.rand(2, 3, side, side),),
            str(path),
            input_names=["image"],
            output_names=["coords2d", "coords3d"],
            dynamic_shapes={"image": {0: torch.export.Dim("N", min=1, max=4096)}},
            opset_version=OPSET,
            dynamo=True,
            external_data=False,
            verbose=False,
        )
    session = onnxruntime.InferenceSession(str(path), providers=["CPUExecutionProvider"])
    for n in (1, 3):
        image = torch.rand(n, 3, side, side, generator=torch.Generator().manual_seed(n))
        with torch.inference_mode():
            wanted = [w.numpy() for w in crop(image)]
        got = session.run(["coords2d", "coords3d"], {"image": image.numpy()})
        off = [float(np.abs(np.asarray(g) - w).max()) for g, w in zip(got, wanted, strict=True)]
        if not (off[0] <= TOLERANCE_PX and off[1] <= TOLERANCE_MM):
            path.unlink()
            raise ExportError(f"the graph differs from the network by {off[0]:.3f} px and {off[1]:.3f} mm")
    mixed = int(np.sum(selection.max(axis=0) < 0.999))
    spec = {
        "name": name,
        "kind": "crop3d",
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "licence": licence,
        "source": source,
        "input": {
            "name": "image",
            "width": side,
            "height": side,
            "layout": "NCHW",
            "colour": "RGB",
            "mean": [0, 0, 0],
            "std": [255, 255, 255],
        },
        "outputs": {"coords2d": "coords2d", "coords3d": "coords3d"},
        "marker_set": marker_set,
        "joint_names": list(names),
        "pixel_origin": "centre",
        "box_margin": 1.0,
        "comment": f"{mixed} of {selection.shape[1]} points are means of joints of the network",
    }
    (out / "model.json").write_text(json.dumps(spec, indent=2) + "\n")
    return out


if __name__ == "__main__":
    sys.exit(main())
