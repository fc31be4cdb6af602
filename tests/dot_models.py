"""Keypoint models without weights: ONNX graphs that see coloured dots, and pictures of dots at known 3D points.

A trained network names the sides by how a person stands, so a mirrored person has her sides exchanged. The graphs do
the same: both dots of a pair have one colour, and the left one is that further to the right in the picture, because the
person faces the camera. The distances of the points from the camera and one angle between two of them are constants of
the graph, as weights are: both stay what they are in every crop, whatever it is turned, scaled or mirrored.
"""

import dataclasses
import hashlib
import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

from pbl_pipeline.video import Camera

#: Marker -> colour, RGB. Two names: a pair, left and right.
DOTS: dict[tuple[str, ...], tuple[int, int, int]] = {
    ("head",): (1, 0, 0),
    ("base",): (0, 1, 0),
    ("left_shoulder", "right_shoulder"): (0, 0, 1),
    ("left_hip", "right_hip"): (1, 1, 0),
    ("left_knee", "right_knee"): (1, 0, 1),
    ("left_ankle", "right_ankle"): (0, 1, 1),
}
NAMES = tuple(n for names in DOTS for n in names)
GREY = 128
_FLOOR = 0.3
#: A person who faces the camera: x to her left seen from the camera (right in the picture), y down, z away (m).
_BODY_M = {
    "head": (0.02, -0.75, 0.05),
    "base": (-0.03, 1.0, -0.08),
    "left_shoulder": (0.2, -0.5, 0.12),
    "left_hip": (0.12, 0.02, -0.05),
    "left_knee": (0.14, 0.4, 0.1),
    "left_ankle": (0.22, 0.8, -0.1),
    "right_shoulder": (-0.19, -0.48, -0.1),
    "right_hip": (-0.12, 0.02, 0.05),
    "right_knee": (-0.14, 0.4, -0.1),
    "right_ankle": (-0.22, 0.82, 0.05),
}


def lens(width: int = 960, height: int = 720) -> Camera:
    """A wide, clearly distorted lens (barrel and tangential), principal point off the middle."""
    matrix = np.array([[700.0, 0, width / 2 + 9.3], [0, 705.0, height / 2 - 6.2], [0, 0, 1]])
    return Camera(matrix, np.array([-0.22, 0.07, 0.002, -0.0015, 0.0]), "test")


def person(at_m: tuple[float, float, float] = (-0.9, 0.15, 4.0), tilt_deg: float = 14.0) -> np.ndarray:
    """(J, 3) points in the frame of a camera that is tilted down and rolled by a third of that.

    Both points of a pair are equally far from the camera: the right one is moved along its ray.
    """
    pitch, roll = np.radians(tilt_deg), np.radians(tilt_deg / 3)
    tilt = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    turn = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    xyz = (np.array([_BODY_M[n] for n in NAMES])) @ (turn @ tilt).T + np.array(at_m)
    for j, name in enumerate(NAMES):
        if name.startswith("right_"):
            left = xyz[NAMES.index(name.replace("right", "left"))]
            xyz[j] *= np.linalg.norm(left) / np.linalg.norm(xyz[j])
    return xyz


def turned(xyz: np.ndarray, angle_rad: float) -> np.ndarray:
    """The points turned about the camera's vertical axis: every distance from the camera stays."""
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return xyz @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]).T


def project(xyz: np.ndarray, camera: Camera) -> np.ndarray:
    """(J, 2) px, by the lens equations of OpenCV's manual written out."""
    x, y = xyz[:, 0] / xyz[:, 2], xyz[:, 1] / xyz[:, 2]
    k1, k2, p1, p2, k3 = camera.distortion
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    yd = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    m = camera.matrix
    return np.stack([m[0, 0] * xd + m[0, 2], m[1, 1] * yd + m[1, 2]], axis=1)


def picture(xy_px: np.ndarray, size: tuple[int, int] = (960, 720), dot_px: float = 5.0) -> np.ndarray:
    """(H, W, 3) uint8 BGR: grey, with a soft dot (standard deviation `dot_px`) in its colour at each point (J, 2)."""
    width, height = size
    image = np.full((height, width, 3), float(GREY))
    colours = [rgb for names, rgb in DOTS.items() for _ in names]
    reach = int(5 * dot_px)
    for (u, v), rgb in zip(xy_px, colours, strict=True):
        x = np.arange(max(int(u) - reach, 0), min(int(u) + reach, width))
        y = np.arange(max(int(v) - reach, 0), min(int(v) + reach, height))[:, None]
        weight = np.exp(-((x - u) ** 2 + (y - v) ** 2) / (2 * dot_px**2))[..., None]
        part = image[y[:, :1], x[None]] if x.size and y.size else None
        if part is not None:
            image[y, x[None]] = part * (1 - weight) + 255.0 * np.array(rgb[::-1]) * weight
    return np.round(image).astype(np.uint8)


def region(xy_px: np.ndarray) -> np.ndarray:
    """(4,) a body circle around the points."""
    low, high = xy_px.min(axis=0), xy_px.max(axis=0)
    return np.array([*(low + high) / 2, 1.15 * np.max(high - low), 0.05])


@dataclasses.dataclass
class Graph:
    """A graph under construction; names are made up."""

    nodes: list[Any] = dataclasses.field(default_factory=list)
    constants: list[Any] = dataclasses.field(default_factory=list)

    def const(self, value: Any, dtype: Any = np.float32) -> str:
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def __call__(self, op: str, *inputs: str, out: str = "", **attributes: Any) -> str:
        out = out or f"n{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, list(inputs), [out], **attributes))
        return out

    def one(self, value: str, i: int) -> str:
        """The part `i` of a value along its second axis."""
        return self("Slice", value, *(self.const([n], np.int64) for n in (i, i + 1, 1)))

    def build(self, inputs: list[Any], outputs: list[Any], opset: int = 17) -> onnx.ModelProto:
        graph = helper.make_graph(self.nodes, "dots", inputs, outputs, self.constants)
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", opset)])
        model.ir_version = 9
        onnx.checker.check_model(model)
        return model


def _dot_weights(g: Graph, size: tuple[int, int]) -> str:
    """(N, J, H, W): how much each pixel belongs to each dot."""
    width, height = size
    channels = [g.one("image", i) for i in range(3)]
    columns = g.const(np.tile(np.arange(width), (height, 1))[None, None])
    parts = []
    for names, rgb in DOTS.items():
        on = [c for c, v in zip(channels, rgb, strict=True) if v]
        off = [c for c, v in zip(channels, rgb, strict=True) if not v]
        colour = g("Sub", g("Min", *on), g("Max", *off))
        weight = g("Relu", g("Sub", colour, g.const(_FLOOR)))
        if len(names) == 1:
            parts.append(weight)
            continue
        right_of_middle = g("Cast", g("Greater", columns, _centroid(g, weight, columns)), to=TensorProto.FLOAT)
        left = g("Mul", weight, right_of_middle)
        parts += [left, g("Sub", weight, left)]
    return g("Concat", *parts, axis=1)


def _centroid(g: Graph, weight: str, coordinate: str) -> str:
    """(N, K, 1, 1) mean of a coordinate (1, 1, H, W) with the weights (N, K, H, W)."""
    total = g("Add", g("ReduceSum", weight, g.const([2, 3], np.int64), keepdims=1), g.const(1e-6))
    return g("Div", g("ReduceSum", g("Mul", weight, coordinate), g.const([2, 3], np.int64), keepdims=1), total)


def crop3d(
    xyz_m: np.ndarray,
    size: tuple[int, int] = (256, 256),
    drift_mm: dict[str, float] | None = None,
    origin_px: float = 0.0,
) -> onnx.ModelProto:
    """A crop model of the points (J, 3) in the camera's frame: `coords2d` px, `coords3d` mm in the crop's frame.

    `drift_mm`: a point's depth grows by so much times the grey of the background, which gamma changes: what a network
    that is not sure does. `origin_px`: where the centre of the first pixel is.
    """
    width, height = size
    g = Graph()
    weight = _dot_weights(g, size)
    columns = g.const(np.tile(np.arange(width), (height, 1))[None, None])
    rows = g.const(np.tile(np.arange(height)[:, None], (1, width))[None, None])
    xy = g("Concat", _centroid(g, weight, columns), _centroid(g, weight, rows), axis=3)
    xy = g("Squeeze", xy, g.const([2], np.int64))  # (N, J, 2)
    g("Add", xy, g.const([origin_px, origin_px]), out="coords2d")
    p = g("Sub", xy, g.const([(width - 1) / 2, (height - 1) / 2]))
    a, b = NAMES.index("head"), NAMES.index("base")
    norm = np.linalg.norm(xyz_m, axis=1)
    cos2 = float((xyz_m[a] @ xyz_m[b] / norm[a] / norm[b]) ** 2)
    p1, p2 = g.one(p, a), g.one(p, b)

    def dot(u: str, v: str) -> str:
        return g("ReduceSum", g("Mul", u, v), g.const([2], np.int64), keepdims=1)

    # Focal length f of the crop from the angle t between the two rays, F = f^2:
    # (1 - c2) F^2 + (2 a - c2 (b + d)) F + a^2 - c2 b d = 0, a = p1 p2, b = p1 p1, d = p2 p2, c2 = cos^2 t.
    ab, bb, dd = dot(p1, p2), dot(p1, p1), dot(p2, p2)
    c2, quad = g.const(cos2), g.const(1 - cos2)
    linear = g("Sub", g("Mul", g.const(2.0), ab), g("Mul", c2, g("Add", bb, dd)))
    last = g("Sub", g("Mul", ab, ab), g("Mul", c2, g("Mul", bb, dd)))
    under = g("Sub", g("Mul", linear, linear), g("Mul", g.const(4.0), g("Mul", quad, last)))
    root = g("Sqrt", g("Relu", under))
    big_f = g("Div", g("Sub", root, linear), g("Mul", g.const(2.0), quad))
    f = g("Sqrt", g("Max", big_f, g.const(1.0)))  # (N, 1, 1)
    depth = g("Mul", f, g.const(np.ones((1, len(NAMES), 1))))
    ray = g("Concat", p, depth, axis=2)
    length = g("Sqrt", g("ReduceSum", g("Mul", ray, ray), g.const([2], np.int64), keepdims=1))
    xyz = g("Mul", g("Div", ray, length), g.const(1000.0 * norm[None, :, None]))
    shift = np.zeros((1, len(NAMES), 3))
    for name, value in (drift_mm or {}).items():
        shift[0, NAMES.index(name), 2] = value
    grey = g("ReduceMax", g("Min", *(g.one("image", i) for i in range(3))), axes=[2, 3], keepdims=0)  # (N, 1)
    drift = g("Mul", g.const(shift), g("Unsqueeze", grey, g.const([2], np.int64)))
    # A network gives a shape, not a place: any shift may be added, another one in each picture.
    g("Add", g("Sub", xyz, g("ReduceMean", xyz, axes=[1], keepdims=1)), drift, out="coords3d")
    return g.build([_image(size)], [_floats("coords2d", len(NAMES), 2), _floats("coords3d", len(NAMES), 3)])


def simcc(size: tuple[int, int] = (192, 256)) -> onnx.ModelProto:
    """Two profiles with two bins for each pixel, as RTMPose gives them."""
    g = Graph()
    weight = g("Div", _dot_weights(g, size), g.const(1 - _FLOOR))
    for name, axis, n in (("simcc_x", 2, size[0]), ("simcc_y", 3, size[1])):
        profile = g("ReduceMax", weight, axes=[axis], keepdims=0)
        # Each bin is a Gaussian mean of the pixels around it, as wide as the labels such a model is trained with.
        kernel = np.exp(-((np.arange(n)[:, None] - np.arange(2 * n) / 2) ** 2) / (2 * 1.5**2))
        g("MatMul", profile, g.const(kernel / kernel.sum(axis=0)), out=name)
    outputs = [_floats(name, len(NAMES), 2 * n) for name, n in zip(("simcc_x", "simcc_y"), size, strict=True)]
    return g.build([_image(size)], outputs)


def heatmap(size: tuple[int, int] = (192, 256), stride: int = 2) -> onnx.ModelProto:
    """Heat maps whose cells are means of `stride` x `stride` pixels."""
    g = Graph()
    weight = g("Div", _dot_weights(g, size), g.const(1 - _FLOOR))
    g("AveragePool", weight, kernel_shape=[stride, stride], strides=[stride, stride], out="heatmap")
    return g.build([_image(size)], [_floats("heatmap", len(NAMES), size[1] // stride, size[0] // stride)])


def _image(size: tuple[int, int]) -> Any:
    return _floats("image", 3, size[1], size[0])


def _floats(name: str, *shape: int) -> Any:
    """An input or output of float32 for any number of pictures."""
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", *shape])


def spec(kind: str, size: tuple[int, int] = (256, 256), **changes: Any) -> dict[str, Any]:
    """Fields of a `model.json` for these graphs; the checksum is added by `write`."""
    roles = {"crop3d": ("coords2d", "coords3d"), "simcc": ("simcc_x", "simcc_y"), "heatmap": ("heatmap",)}[kind]
    values: dict[str, Any] = {
        "name": f"dots-{kind}",
        "kind": kind,
        "licence": "CC0-1.0, a test",
        "source": "tests/dot_models.py",
        "input": {
            "name": "image",
            "width": size[0],
            "height": size[1],
            "layout": "NCHW",
            "colour": "RGB",
            "mean": [0, 0, 0],
            "std": [255, 255, 255],
        },
        "outputs": {role: role for role in roles},
        "marker_set": "dots_10",
        "joint_names": list(NAMES),
    }
    if kind == "heatmap":
        values["pixel_origin"] = "edge"
    return {**values, **changes}


def write(folder: Path, model: onnx.ModelProto, fields: dict[str, Any]) -> Path:
    """A model's folder: `model.onnx` and `model.json` with its checksum (unless `fields` has one)."""
    folder.mkdir(parents=True, exist_ok=True)
    data = model.SerializeToString()
    (folder / "model.onnx").write_bytes(data)
    content = {"sha256": hashlib.sha256(data).hexdigest(), **fields}
    (folder / "model.json").write_text(json.dumps(content, indent=2))
    return folder


def changed(folder: Path, **changes: Any) -> Path:
    """The folder with other fields in its `model.json`; None takes a field away."""
    path = folder / "model.json"
    content = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not None}))
    return folder
