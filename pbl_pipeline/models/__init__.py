"""Networks: BlazePose (tflite) and any as ONNX: folder with graph and spec, the registry, sessions on CPU or CUDA."""

from ._device import DEVICES, asked_device, available_devices, providers_for
from ._onnx import OnnxModel, check_frozen
from ._registry import ModelStatus, add, find, is_registered, registered, remove, verify
from ._ssd import SsdLayout, SsdModel, box_iou, suppress
from ._tflite import LiteModel
from .spec import KINDS, ModelInput, ModelSpec, load_spec, mirror_pairs, model_invalid, parse_spec

__all__ = [
    "DEVICES",
    "KINDS",
    "LiteModel",
    "ModelInput",
    "ModelSpec",
    "ModelStatus",
    "OnnxModel",
    "SsdLayout",
    "SsdModel",
    "add",
    "asked_device",
    "available_devices",
    "box_iou",
    "check_frozen",
    "find",
    "is_registered",
    "load_spec",
    "mirror_pairs",
    "model_invalid",
    "parse_spec",
    "providers_for",
    "registered",
    "remove",
    "suppress",
    "verify",
]
