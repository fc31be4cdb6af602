"""Keypoint models as ONNX: a folder with graph and spec, the registry of this machine, sessions on CPU or CUDA."""

from ._device import DEVICES, asked_device, available_devices, providers_for
from ._onnx import OnnxModel
from ._registry import ModelStatus, add, find, is_registered, registered, remove, verify
from ._spec import KINDS, ModelInput, ModelSpec, load_spec, mirror_pairs, parse_spec

__all__ = [
    "DEVICES",
    "KINDS",
    "ModelInput",
    "ModelSpec",
    "ModelStatus",
    "OnnxModel",
    "add",
    "asked_device",
    "available_devices",
    "find",
    "is_registered",
    "load_spec",
    "mirror_pairs",
    "parse_spec",
    "providers_for",
    "registered",
    "remove",
    "verify",
]
