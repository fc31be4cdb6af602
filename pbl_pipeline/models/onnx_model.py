"""Loaded ONNX models, checked against their `model.json` by the hash, the graph and one run on a black picture."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.errors import PblError, os_errors_as
from pbl_pipeline.resources import cores

from .devices import asked_device, device_of, providers_for, unavailable
from .gpu_address import gpu_number
from .network import batches
from .spec import GRAPH_FILE, SPEC_FILE, WITHOUT_POINTS, ModelSpec, load_spec, model_invalid

_DTYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}


class OnnxModel:
    """A model's folder, loaded. Not to be shared by threads.

    Raises `PblError` MODEL_MISSING, MODEL_INVALID (also an opset or operator that the runtime does not support, another
    name or shape of an input or output, another number of points), MODEL_CHECKSUM, MARKER_SET_UNKNOWN,
    DEVICE_UNAVAILABLE, USAGE.

    Attributes
    ----------
    spec
        Content of `model.json`.
    device
        "cpu" or "cuda".
    note
        Reason why it is not the expected device, or "".
    """

    def __init__(self, folder: str | Path, device: str | None = None) -> None:
        self.folder = Path(folder)
        self.spec = load_spec(folder)
        self._path = self.folder / GRAPH_FILE
        data = check_graph_file(self.folder, self.spec)
        providers = providers_for(device)
        # Not at the top: commands that only fit or read results do not wait for the runtime.
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = cores()
        options.log_severity_level = 4  # its messages are raised below
        try:
            options_of = [{"device_id": gpu_number()} if p.startswith("CUDA") else {} for p in providers]
            self._session = onnxruntime.InferenceSession(
                data, options, providers=providers, provider_options=options_of
            )
        except Exception as error:
            if asked_device(device) == "cuda" and "CUDA" in str(error):
                raise unavailable(_reason(error)) from error
            raise model_invalid(
                _reason(error), "a graph that the installed onnxruntime loads", key=self._path
            ) from error
        self.device = device_of(self._session.get_providers())
        self.note = ""
        if asked_device(device) == "cuda" and self.device != "cuda":
            raise unavailable("the CUDA provider is installed but does not start (driver, CUDA or cuDNN)")
        if len(providers) > 1 and self.device == "cpu":
            self.note = "the CUDA provider is installed but does not start, so the CPU computes"
        self._outputs = [self.spec.outputs[role] for role in self.spec.outputs]
        self._dtype, self.fixed_batch = self._check_names()
        black = np.zeros((1, self.spec.input.height, self.spec.input.width, 3), np.uint8)
        try:
            got = self(black)
        except Exception as error:
            raise model_invalid(
                f"it does not run: {_reason(error)}", "a graph that computes", key=self._path
            ) from error
        self._check_shapes(got)

    def __call__(self, crops: np.ndarray, gamma: np.ndarray | None = None) -> dict[str, np.ndarray]:
        """Outputs by role, float32, for `crops` (N, H, W, 3) uint8 BGR; `gamma` (N,) is applied to each on 0..1.

        A graph with a fixed batch is called several times if necessary.
        """
        inputs = self._inputs(crops, gamma)
        parts: list[Any] = [
            self._session.run(self._outputs, {self.spec.input.name: part})
            for part in batches(inputs, self.fixed_batch or len(inputs))
        ]
        joined = (np.concatenate(p)[: len(inputs)].astype(np.float32) for p in zip(*parts, strict=True))
        return dict(zip(self.spec.outputs, joined, strict=True))

    def _inputs(self, crops: np.ndarray, gamma: np.ndarray | None) -> np.ndarray:
        """The crops as input of the graph, by a table of the 256 values for each crop and channel."""
        entry = self.spec.input
        levels = np.arange(256) / 255.0
        gammas = np.ones(len(crops)) if gamma is None else np.asarray(gamma, float)
        table = 255.0 * levels[None] ** gammas[:, None]  # (N, 256)
        out = np.empty((len(crops), 3, entry.height, entry.width), self._dtype)
        for n, crop in enumerate(crops):
            for c in range(3):
                channel = c if entry.colour == "BGR" else 2 - c
                value = ((table[n] - entry.mean[c]) / entry.std[c]).astype(self._dtype)
                np.take(value, crop[:, :, channel], out=out[n, c], mode="clip")
        return out if entry.layout == "NCHW" else np.ascontiguousarray(out.transpose(0, 2, 3, 1))

    def _check_names(self) -> tuple[Any, int | None]:
        """Type of the input and its fixed batch (None: any)."""
        entry = self.spec.input
        inputs = {i.name: i for i in self._session.get_inputs()}
        outputs = [o.name for o in self._session.get_outputs()]
        lacking = [n for n in self._outputs if n not in outputs]
        if lacking:
            raise self._wrong(f"no output {', '.join(lacking)} (it has {', '.join(outputs)})", "every output it names")
        if list(inputs) != [entry.name]:
            raise self._wrong(f"inputs {', '.join(inputs)}", f"one input, {entry.name}")
        found = inputs[entry.name]
        if found.type not in _DTYPES:
            raise self._wrong(f"an input of type {found.type}", f"one of {', '.join(_DTYPES)}")
        wanted = (3, entry.height, entry.width) if entry.layout == "NCHW" else (entry.height, entry.width, 3)
        shape = list(found.shape)
        fits = len(shape) == 4 and all(not isinstance(s, int) or s == w for s, w in zip(shape[1:], wanted, strict=True))
        if not fits:
            raise self._wrong(f"an input of shape {shape}", f"(N, {', '.join(map(str, wanted))}), {entry.layout}")
        return _DTYPES[found.type], shape[0] if isinstance(shape[0], int) else None

    def _check_shapes(self, got: dict[str, np.ndarray]) -> None:
        n, entry = len(self.spec.joint_names), self.spec.input
        if self.spec.kind in WITHOUT_POINTS:
            return  # the detector checks the rows
        along = {"simcc_x": entry.width, "simcc_y": entry.height}
        for role, array in got.items():
            if role in ("coords2d", "coords3d"):
                wanted: tuple[int | str, ...] = (1, n, 2 if role == "coords2d" else 3)
            elif role in along:
                wanted = (1, n, round(along[role] * self.spec.simcc_split))
            else:
                wanted = (1, n, "h", "w")
            fits = array.ndim == len(wanted) and all(
                w == s or isinstance(w, str) for w, s in zip(wanted, array.shape, strict=True)
            )
            if not fits:
                expected = f"({', '.join(map(str, wanted))}): {n} points ({self.spec.marker_set})"
                raise self._wrong(f"{self.spec.outputs[role]} of shape {array.shape}", expected)

    def _wrong(self, found: str, expected: str) -> PblError:
        return model_invalid(found, f"{expected}, as its model.json says", key=self._path)


def check_frozen(spec: ModelSpec, sha256: str, spec_sha256: str) -> None:
    """Compare a registered model with the hashes of its graph and `model.json` that a method has.

    Raises `PblError` MODEL_CHECKSUM.
    """
    for what, stated, found in (("graph", sha256, spec.sha256), (SPEC_FILE, spec_sha256, spec.spec_sha256)):
        if stated != found:
            raise PblError(
                "MODEL_CHECKSUM",
                found=f"the {what} of the registered model has SHA-256 {found}",
                expected=f"SHA-256 {stated}, with which the method was made",
                next_step="add the model that the method was made with, or use the method of the model that is "
                "registered now",
                key=spec.name,
            )


def check_graph_file(folder: str | Path, spec: ModelSpec) -> bytes:
    """Read `model.onnx`. Raises `PblError` MODEL_MISSING, MODEL_CHECKSUM."""
    path = Path(folder) / GRAPH_FILE
    with os_errors_as("MODEL_MISSING", f"{GRAPH_FILE} beside model.json", "copy the whole folder again", path):
        data = path.read_bytes()
    found = hashlib.sha256(data).hexdigest()
    if found != spec.sha256:
        raise PblError(
            "MODEL_CHECKSUM",
            found=f"SHA-256 {found}",
            expected=f"SHA-256 {spec.sha256}, as its model.json says",
            next_step="copy the model again; where the file is right, correct sha256 in model.json and add it anew",
            key=str(path),
        )
    return data


#: Place in the source of onnxruntime, with the function's types, before its reason.
_PLACE = re.compile(r"/\S+:\d+ .*?\) (?=[A-Z])")


def _reason(error: Exception) -> str:
    """Return an error of onnxruntime in one line of bounded length. Its reason is at the end."""
    text = _PLACE.sub("", " ".join(str(error).split()), count=1) or type(error).__name__
    return text if len(text) <= 500 else f"... {text[-500:]}"
