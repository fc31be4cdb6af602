"""`model.json`: input and output of a model, validated (docs/models.md)."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.paramset import canonical_json

SPEC_FILE, GRAPH_FILE = "model.json", "model.onnx"
#: Kind -> its required outputs.
KINDS: dict[str, tuple[str, ...]] = {
    "crop3d": ("coords2d", "coords3d"),
    "simcc": ("simcc_x", "simcc_y"),
    "heatmap": ("heatmap",),
    "person_detector": ("boxes",),
}
#: Kinds that detect people, not points: they have no marker set.
WITHOUT_POINTS = ("person_detector",)
_NAME = re.compile(r"[a-z0-9][a-z0-9._-]{0,39}")
_SHA256 = re.compile(r"[0-9a-f]{64}")
#: Most characters of the text of a licence or a source.
_LONGEST = 500
_REQUIRED = ("name", "kind", "sha256", "licence", "source", "input", "outputs")
_POINTS = ("marker_set", "joint_names")
_OPTIONAL_POINTS = ("mirror_pairs", "pixel_origin", "box_margin", "simcc_split")
_OPTIONAL = ("comment",)
_INPUT = ("name", "width", "height", "layout", "colour", "mean", "std")
#: Fields that do not affect results; the others are hashed into the method's parameters.
_WORDS = ("name", "licence", "source", "comment")
#: Marks of the sides (left, right) at the beginning or the end of a name.
_SIDES = (("left", "right"), ("Left", "Right"), ("LEFT", "RIGHT"), ("l", "r"), ("L", "R"))
#: MODEL_INVALID about a file of a model.
model_invalid = functools.partial(
    PblError, "MODEL_INVALID", next_step="correct the model's folder as docs/models.md describes it, and add it again"
)


@dataclasses.dataclass(frozen=True)
class ModelInput:
    """Input picture of a model; value = (v - mean) / std with v from 0 to 255."""

    name: str  # of the graph's input
    width: int  # px, as the height
    height: int
    layout: str  # "NCHW" or "NHWC"
    colour: str  # "RGB" or "BGR"
    mean: tuple[float, float, float]  # of each channel in that order
    std: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class ModelSpec:
    """One model."""

    name: str
    #: "crop3d": `coords2d` (N, J, 2) px of the crop and `coords3d` (N, J, 3) mm in the axes of the crop's camera (x
    #: right, y down, z forward), up to one common shift. "simcc": `simcc_x` (N, J, width * split), `simcc_y` likewise.
    #: "heatmap": `heatmap` (N, J, h, w). "person_detector": `boxes` (N, cells, 5 + classes), YOLOX's rows; it has no
    #: marker set and no joint names.
    kind: str
    sha256: str  # of `model.onnx`
    licence: str
    source: str
    input: ModelInput
    outputs: Mapping[str, str]  # role (above) -> name in the graph
    marker_set: str
    joint_names: tuple[str, ...]
    mirror: tuple[int, ...]  # (J,) index of each point in a mirrored picture
    pixel_origin: str  # of coordinates in the crop: "centre" of the first pixel, or its "edge"
    box_margin: float  # size of the crop over that of the person's box (the region of interest)
    simcc_split: float
    spec_sha256: str  # of all fields that affect a result, without names and licences


def load_spec(folder: str | Path) -> ModelSpec:
    """Read `model.json` of a model's folder. `OnnxModel` checks that `model.onnx` agrees with it.

    Raises `PblError` MODEL_MISSING: no such folder or file. MODEL_INVALID: not JSON, a field missing, unknown or of a
    wrong kind. MARKER_SET_UNKNOWN: the joint names are not those of the marker set of the body that is named.
    """
    path = Path(folder) / SPEC_FILE
    with os_errors_as(
        "MODEL_MISSING",
        f"a folder with {GRAPH_FILE} and {SPEC_FILE}",
        "docs/models.md describes the folder of a model",
        path,
    ):
        try:
            content = read_json(path)
        except ValueError as error:
            raise model_invalid(f"not JSON ({error})", "a JSON object", key=path) from error
    if not isinstance(content, dict):
        raise model_invalid("no named fields", "a JSON object", key=path)
    return parse_spec(content, path)


def parse_spec(content: Mapping[str, Any], path: str | Path) -> ModelSpec:
    """Parse the fields of `model.json`; `path` is named in errors. Raises as `load_spec`."""
    points = content.get("kind") not in WITHOUT_POINTS
    required = (*_REQUIRED, *(_POINTS if points else ()))
    _fields(path, "", content, required, (*(_OPTIONAL_POINTS if points else ()), *_OPTIONAL))
    name = _text(path, content, "name")
    if not _NAME.fullmatch(name):
        raise model_invalid(f"name {name!r}", "small letters, digits, '.', '_' and '-', at most 40", key=path)
    kind = _text(path, content, "kind")
    if kind not in KINDS:
        raise model_invalid(f"kind {kind!r}", f"one of {', '.join(KINDS)}", key=path)
    sha256 = _text(path, content, "sha256").lower()
    if not _SHA256.fullmatch(sha256):
        raise model_invalid(f"sha256 {sha256[:80]!r}", f"the 64 hex digits of the SHA-256 of {GRAPH_FILE}", key=path)
    outputs = content["outputs"]
    if not isinstance(outputs, dict) or set(outputs) != set(KINDS[kind]) or not _all_text(outputs.values()):
        raise model_invalid(f"outputs {outputs!r}", f"the graph's names of {', '.join(KINDS[kind])}", key=path)
    names = content.get("joint_names", [])
    if not isinstance(names, list) or bool(names) != points or not _all_text(names) or len(set(names)) != len(names):
        raise model_invalid(
            "joint_names: not a list of names, all different", "a name for each point, in order", key=path
        )
    markers = _text(path, content, "marker_set") if points else ""
    if len(markers) > 32:
        raise model_invalid(f"marker_set of {len(markers)} characters", "at most 32", key=path)
    if points:
        _check_marker_set(markers, names)
    origin = content.get("pixel_origin", "centre")
    if origin not in ("centre", "edge"):
        raise model_invalid(f"pixel_origin {origin!r}", "'centre' or 'edge'", key=path)
    hashed = {k: v for k, v in content.items() if k not in _WORDS}
    return ModelSpec(
        name=name,
        kind=kind,
        sha256=sha256,
        licence=_text(path, content, "licence"),
        source=_text(path, content, "source"),
        input=_input(path, content["input"]),
        outputs=dict(outputs),
        marker_set=markers,
        joint_names=tuple(names),
        mirror=_mirror(path, names, content.get("mirror_pairs")),
        pixel_origin=origin,
        box_margin=_number(path, content, "box_margin", 1.0, 0.5, 4.0),
        simcc_split=_number(path, content, "simcc_split", 2.0, 0.25, 16.0),
        spec_sha256=hashlib.sha256(canonical_json(hashed).encode()).hexdigest(),
    )


def mirror_pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Pairs (left, right) of names that are equal but for left/right or l/r, in either case, at one end."""
    known, pairs = set(names), []
    for name in names:
        for left, right in _SIDES:
            others = []
            if name.startswith(left):
                others.append(right + name[len(left) :])
            if len(left) > 1 and name.endswith(left):
                others.append(name[: -len(left)] + right)
            found = next((o for o in others if o in known), None)
            if found:
                pairs.append((name, found))
                break
    return pairs


def _mirror(path: str | Path, names: list[str], stated: Any) -> tuple[int, ...]:
    if stated is None:
        pairs = mirror_pairs(names)
    elif isinstance(stated, list) and all(isinstance(p, list) and len(p) == 2 and _all_text(p) for p in stated):
        pairs = [(a, b) for a, b in stated]
    else:
        raise model_invalid("mirror_pairs: not a list of pairs of names", "[[left, right], ...]", key=path)
    flat = [n for pair in pairs for n in pair]
    wrong = sorted({n for n in flat if n not in names or flat.count(n) > 1})
    if wrong:
        raise model_invalid(
            f"mirror_pairs with {', '.join(wrong)}", "names of joint_names, each once at most", key=path
        )
    out = list(range(len(names)))
    for left, right in pairs:
        i, j = names.index(left), names.index(right)
        out[i], out[j] = j, i
    lone = [n for i, n in enumerate(names) if out[i] == i and re.search("left|right", n.lower())]
    if lone:
        raise model_invalid(
            f"no other side of {', '.join(lone)}", "a pair for each, by name or in mirror_pairs", key=path
        )
    return tuple(out)


def _check_marker_set(markers: str, names: Sequence[str]) -> None:
    """Check the order of a marker set of the body; another set is the lab's own, and the fit asks for its table."""
    from pbl_pipeline.body import MARKER_SETS, marker_set

    if markers in MARKER_SETS:
        marker_set(markers).check_names(names)


def _input(path: str | Path, value: Any) -> ModelInput:
    if not isinstance(value, dict):
        raise model_invalid("input: no named fields", f"an object with {', '.join(_INPUT)}", key=path)
    _fields(path, "input.", value, _INPUT, ())
    layout, colour = _text(path, value, "layout"), _text(path, value, "colour")
    if layout not in ("NCHW", "NHWC") or colour not in ("RGB", "BGR"):
        raise model_invalid(f"input layout {layout!r}, colour {colour!r}", "NCHW or NHWC, RGB or BGR", key=path)
    for side in ("width", "height"):
        size = value[side]
        if not isinstance(size, int) or isinstance(size, bool) or not 16 <= size <= 4096:
            raise model_invalid(f"input {side} {size!r}", "a whole number of pixels, 16 to 4096", key=path)
    for field in ("mean", "std"):
        numbers = value[field]
        three = isinstance(numbers, list) and len(numbers) == 3 and all(_is_number(n) for n in numbers)
        if not three or (field == "std" and min(numbers) <= 0):
            raise model_invalid(
                f"input {field} {numbers!r}", "three numbers on the scale 0..255, std positive", key=path
            )
    mean, std = tuple(map(float, value["mean"])), tuple(map(float, value["std"]))
    name = _text(path, value, "name")
    return ModelInput(name, value["width"], value["height"], layout, colour, mean, std)  # type: ignore[arg-type]


def _fields(
    path: str | Path, where: str, content: Mapping[str, Any], required: Sequence[str], optional: Sequence[str]
) -> None:
    missing = [where + f for f in required if f not in content]
    unknown = [where + f for f in content if f not in (*required, *optional)]
    if missing or unknown:
        found = [f"no {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
        known = f"the fields {', '.join(required)}" + (f"; optional {', '.join(optional)}" if optional else "")
        raise model_invalid("; ".join(found), known, key=path)


def _text(path: str | Path, content: Mapping[str, Any], field: str) -> str:
    value = content[field]
    if not isinstance(value, str) or not value.strip() or len(value) > _LONGEST:
        raise model_invalid(f"{field} {str(value)[:80]!r}", f"a text of 1 to {_LONGEST} characters", key=path)
    return value.strip()


def _all_text(values: Any) -> bool:
    return all(isinstance(v, str) and v for v in values)


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and abs(value) < 1e6


def _number(path: str | Path, content: Mapping[str, Any], field: str, default: float, low: float, high: float) -> float:
    value = content.get(field, default)
    if not _is_number(value) or not low <= value <= high:
        raise model_invalid(f"{field} {value!r}", f"a number from {low:g} to {high:g}", key=path)
    return float(value)
