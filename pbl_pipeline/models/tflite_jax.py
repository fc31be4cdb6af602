"""A TensorFlow Lite model as a JAX function of a batch of pictures, for a GPU, which LiteRT does not use.

Only the operations of the networks here are supported; LiteRT computes models with others. On a CPU LiteRT is some
thirty times faster than XLA's program of the same model.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Float

from pbl_pipeline.errors import PblError

#: Values by the number of their tensor.
Values = dict[int, Any]
_SAME = 0  # of `Padding`
_ACTIVATIONS: dict[int, Callable[[Any], Any]] = {
    0: lambda x: x,
    1: jax.nn.relu,
    3: jax.nn.relu6,
}
_DTYPES = {0: np.float32, 1: np.float16, 2: np.int32}  # of `TensorType`


@dataclasses.dataclass(frozen=True)
class JaxModel:
    """A model with one float32 image input."""

    weights: dict[int, np.ndarray]  # by number of the tensor; an argument of `__call__`, not constants of its program
    image_shape: tuple[int, int, int]  # height, width, channels
    output_sizes: tuple[int, ...]  # numbers of elements of the outputs for one picture, in the order of `__call__`
    _steps: tuple[tuple[Callable[..., Any], tuple[int, ...], int], ...]
    _input: int
    _outputs: tuple[int, ...]

    def __call__(self, weights: Mapping[int, Any], images: Float[Array, "N H W 3"]) -> tuple[Float[Array, "N _"], ...]:
        """Return each output of the model, flattened, for each picture."""
        values: Values = dict(weights)
        values[self._input] = images
        for compute, inputs, output in self._steps:
            values[output] = compute(*(values[t] for t in inputs))
        return tuple(values[t].reshape(len(images), -1) for t in self._outputs)


def read_model(content: bytes) -> JaxModel:
    """Read the bytes of a `.tflite` file.

    Raises
    ------
    PblError
        MODEL_INVALID: the model has an operation, or a variant of one, that is not supported; the text names it.
    """
    from ai_edge_litert import schema_py_generated as schema

    model: Any = schema.ModelT.InitFromObj(schema.Model.GetRootAs(content, 0))
    names = {v: k for k, v in vars(schema.BuiltinOperator).items() if isinstance(v, int)}
    graph = model.subgraphs[0]
    constants = {i: a for i, t in enumerate(graph.tensors) if (a := _constant(t, model.buffers[t.buffer])) is not None}
    weights: dict[int, np.ndarray] = {}
    steps = []
    for op in graph.operators:
        code = model.operatorCodes[op.opcodeIndex]
        name = names[max(code.builtinCode, code.deprecatedBuiltinCode)]
        inputs = tuple(int(t) for t in op.inputs)
        if name in ("DENSIFY", "DEQUANTIZE") and inputs[0] in constants:
            constants[int(op.outputs[0])] = constants[inputs[0]].astype(np.float32)
            continue
        if name not in _OPERATIONS or len(op.outputs) != 1 or -1 in inputs:
            raise _unknown(name)
        fixed = [constants[t] for t in inputs if t in constants]
        shape = tuple(int(n) for n in graph.tensors[op.outputs[0]].shape)
        compute = _OPERATIONS[name](op.builtinOptions, fixed, shape)
        # Weights are arguments of the program; sizes and paddings are part of it.
        for t in inputs:
            if t in constants and constants[t].dtype == np.float32:
                weights[t] = constants[t]
        given = tuple(t for t in inputs if t not in constants or t in weights)
        steps.append((compute, given, int(op.outputs[0])))
    sizes = tuple(math.prod(int(n) for n in graph.tensors[t].shape) for t in graph.outputs)
    height, width, channels = (int(n) for n in graph.tensors[graph.inputs[0]].shape[1:])
    outputs = tuple(int(t) for t in graph.outputs)
    return JaxModel(weights, (height, width, channels), sizes, tuple(steps), int(graph.inputs[0]), outputs)


def _unknown(name: str) -> PblError:
    return PblError(
        "MODEL_INVALID",
        found=f"operation {name}",
        expected=f"one of {', '.join(_OPERATIONS)}, as the networks here use them",
        next_step="let LiteRT compute this model on the CPU (--device cpu)",
    )


# --- constants


def _constant(tensor: Any, buffer: Any) -> np.ndarray | None:
    """Values of a tensor in the file, dense; None for one that is computed."""
    if buffer.data is None or len(buffer.data) == 0:
        return None
    if tensor.type not in _DTYPES:
        raise _unknown(f"on a tensor of type {tensor.type}")
    values = np.frombuffer(bytes(bytearray(buffer.data)), _DTYPES[tensor.type])
    shape = tuple(int(n) for n in tensor.shape)
    return values.reshape(shape) if tensor.sparsity is None else _dense(values, shape, tensor.sparsity)


def _dense(values: np.ndarray, shape: tuple[int, ...], sparsity: Any) -> np.ndarray:
    """Return the dense array of TensorFlow Lite's sparse format: dimensions (those of blocks last) in
    `traversalOrder`, each with all indices or with listed ones (`arraySegments`, `arrayIndices`)."""
    n = len(shape)
    order = [int(d) for d in sparsity.traversalOrder]
    blocked = [] if sparsity.blockMap is None else [int(d) for d in sparsity.blockMap]
    #: Index along each traversed dimension of the entries found so far, one row per entry.
    rows = np.zeros((1, 0), int)
    sizes = {}
    for position, dimension in zip(order, sparsity.dimMetadata, strict=True):
        if dimension.format == 0:
            size = int(dimension.denseSize)
            index = np.tile(np.arange(size), len(rows))
            rows = np.column_stack([np.repeat(rows, size, axis=0), index])
        else:
            segments = np.asarray(dimension.arraySegments.values, int)
            rows = np.column_stack([np.repeat(rows, np.diff(segments), axis=0), dimension.arrayIndices.values])
            size = 0
        sizes[position] = size
    index = {position: rows[:, k] for k, position in enumerate(order)}
    for k, dimension in enumerate(blocked):
        index[dimension] = index[dimension] * sizes[n + k] + index[n + k]
    out = np.zeros(shape, values.dtype)
    out[tuple(index[d] for d in range(n))] = values[: len(rows)]
    return out


# --- operations: from options, constant inputs and the shape of the output for one picture to a function of the inputs


def _padding(options: Any) -> str:
    return "SAME" if options.padding == _SAME else "VALID"


def _activated(options: Any, compute: Callable[..., Any]) -> Callable[..., Any]:
    activation = _ACTIVATIONS.get(options.fusedActivationFunction if options else 0)
    if activation is None:
        raise _unknown(f"with the activation {options.fusedActivationFunction}")
    return lambda *inputs: activation(compute(*inputs))


def _convolution(options: Any, depthwise: bool) -> Callable[..., Any]:
    """Concatenated shifted pictures times one matrix; depthwise the sum of shifted pictures times their weights.

    NVIDIA's library has its own convolutions, but finds fast ones for float32 by trial (half a minute a network), and
    converts the order of axes before and after. These are a third faster, without a trial.
    """
    stride, dilation = (options.strideH, options.strideW), (options.dilationHFactor, options.dilationWFactor)

    def compute(x: Array, w: Array, bias: Array) -> Array:
        reach = [(n - 1) * d for n, d in zip(w.shape[1:3], dilation, strict=True)]
        around = lax.padtype_to_pads(x.shape[1:3], [r + 1 for r in reach], stride, _padding(options))
        x = jnp.pad(x, [(0, 0), *around, (0, 0)])
        last = [n - r for n, r in zip(x.shape[1:3], reach, strict=True)]
        places = itertools.product(*(range(0, r + 1, d) for r, d in zip(reach, dilation, strict=True)))
        parts = [x[:, i : i + last[0] : stride[0], j : j + last[1] : stride[1]] for i, j in places]
        # (1, H, W, channels) and (out, H, W, in) of TensorFlow Lite.
        if depthwise:
            y = functools.reduce(jnp.add, map(jnp.multiply, parts, w.reshape(len(parts), -1)))
        else:
            y = jnp.concatenate(parts, axis=-1) @ w.reshape(w.shape[0], -1).T
        return y + bias

    return _activated(options, compute)


def _depthwise(options: Any, fixed: Sequence[np.ndarray], shape: tuple[int, ...]) -> Callable[..., Any]:
    if options.depthMultiplier != 1:
        raise _unknown(f"DEPTHWISE_CONV_2D with {options.depthMultiplier} outputs a channel")
    return _convolution(options, depthwise=True)


def _pad(options: Any, fixed: Sequence[np.ndarray], shape: tuple[int, ...]) -> Callable[..., Any]:
    widths = fixed[0].tolist()
    return lambda x: jnp.pad(x, widths)


def _max_pool(options: Any, fixed: Sequence[np.ndarray], shape: tuple[int, ...]) -> Callable[..., Any]:
    window = (1, options.filterHeight, options.filterWidth, 1)
    stride = (1, options.strideH, options.strideW, 1)
    compute = lambda x: lax.reduce_window(x, -jnp.inf, lax.max, window, stride, _padding(options))  # noqa: E731
    return _activated(options, compute)


def _resize(options: Any, fixed: Sequence[np.ndarray], shape: tuple[int, ...]) -> Callable[..., Any]:
    if options.alignCorners or not options.halfPixelCenters:
        raise _unknown("RESIZE_BILINEAR without half-pixel centres")
    return lambda x: jax.image.resize(x, (x.shape[0], *shape[1:]), "bilinear", antialias=False)


def _depth_to_space(options: Any, fixed: Sequence[np.ndarray], shape: tuple[int, ...]) -> Callable[..., Any]:
    block = options.blockSize

    def compute(x: Array) -> Array:
        n, h, w, c = x.shape
        parts = x.reshape(n, h, w, block, block, c // block**2).transpose(0, 1, 3, 2, 4, 5)
        return parts.reshape(n, h * block, w * block, c // block**2)

    return compute


_Operation = Callable[[Any, Sequence[np.ndarray], tuple[int, ...]], Callable[..., Any]]
_OPERATIONS: dict[str, _Operation] = {
    "ADD": lambda options, fixed, shape: _activated(options, jnp.add),
    "CONCATENATION": lambda options, fixed, shape: _activated(options, lambda *x: jnp.concatenate(x, options.axis)),
    "CONV_2D": lambda options, fixed, shape: _convolution(options, depthwise=False),
    "DENSIFY": lambda options, fixed, shape: lambda x: x,
    "DEPTHWISE_CONV_2D": _depthwise,
    "DEPTH_TO_SPACE": _depth_to_space,
    "DEQUANTIZE": lambda options, fixed, shape: lambda x: x,
    "LOGISTIC": lambda options, fixed, shape: jax.nn.sigmoid,
    "MAX_POOL_2D": _max_pool,
    "PAD": _pad,
    "RELU": lambda options, fixed, shape: jax.nn.relu,
    "RESHAPE": lambda options, fixed, shape: lambda x: x.reshape(x.shape[0], *shape[1:]),
    "RESIZE_BILINEAR": _resize,
}
