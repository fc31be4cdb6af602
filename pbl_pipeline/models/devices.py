"""Device of ONNX models: CPU or CUDA. A requested device that is not available is an error, or is reported."""

from __future__ import annotations

import functools
import os
from collections.abc import Sequence

from pbl_pipeline.errors import PblError

#: Devices that may be requested. "auto": CUDA if it works, else the CPU; the model states which.
DEVICES = ("auto", "cpu", "cuda")
_PROVIDERS = {"cpu": "CPUExecutionProvider", "cuda": "CUDAExecutionProvider"}
unavailable = functools.partial(
    PblError,
    "DEVICE_UNAVAILABLE",
    expected="onnxruntime with a CUDA execution provider that starts, because cuda was asked for",
    next_step="replace onnxruntime by onnxruntime-gpu and install the CUDA and cuDNN that it names, or ask for "
    "cpu or auto (--device, PBL_ONNX_DEVICE)",
    key="cuda",
)


def asked_device(device: str | None = None) -> str:
    """Return `device`, or PBL_ONNX_DEVICE, or "auto". Raises `PblError` USAGE for another word."""
    asked = (device or os.environ.get("PBL_ONNX_DEVICE") or "auto").lower()
    if asked not in DEVICES:
        raise PblError(
            "USAGE",
            found=f"device {asked!r}",
            expected=f"one of {', '.join(DEVICES)}",
            next_step="correct --device or PBL_ONNX_DEVICE",
        )
    return asked


def available_devices() -> tuple[str, ...]:
    """Devices of the installed onnxruntime, the fastest first. Loading a model may still fail for lack of a driver."""
    import onnxruntime

    there = set(onnxruntime.get_available_providers())
    return tuple(d for d in ("cuda", "cpu") if _PROVIDERS[d] in there)


def providers_for(device: str | None = None) -> list[str]:
    """Return the execution providers for a session.

    Raises `PblError` DEVICE_UNAVAILABLE: CUDA was asked for and the installed onnxruntime has none. USAGE: an unknown
    device.
    """
    asked, there = asked_device(device), available_devices()
    if asked == "auto":
        return [_PROVIDERS[d] for d in there]
    if asked not in there:
        raise unavailable(f"onnxruntime with {', '.join(there)} only")
    return [_PROVIDERS[asked]]


def device_of(providers: Sequence[str]) -> str:
    """Return the device that a session with these providers computes on."""
    return next((d for d, p in _PROVIDERS.items() if providers and providers[0] == p), "cpu")
