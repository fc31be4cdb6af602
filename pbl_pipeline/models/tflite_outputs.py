"""A TensorFlow Lite model without the branches that nobody asks for.

BlazePose's landmark network also draws a silhouette of 256 x 256 and a heatmap for every point. Those two branches are
a seventh of its multiplications and, because they work on large maps, half of its time. The runtime computes every
output that the file names, so the file is rewritten with fewer; what is left is computed from the same weights in the
same order, bit for bit.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import numpy as np

_FILE_IDENTIFIER = b"TFL3"


def keep_outputs(model: bytes, sizes: Collection[int]) -> bytes:
    """The same model with only those outputs whose number of elements is one of `sizes`, and what they need.

    Raises
    ------
    ValueError
        The model has no output of one of the sizes.
    """
    import flatbuffers
    from ai_edge_litert import schema_py_generated as schema

    content: Any = schema.ModelT.InitFromObj(schema.Model.GetRootAs(model, 0))
    graph = content.subgraphs[0]
    size_of = {int(t): int(np.prod(graph.tensors[t].shape)) for t in graph.outputs}
    absent = set(sizes) - set(size_of.values())
    if absent:
        raise ValueError(f"no output of {sorted(absent)} elements; the model's have {sorted(size_of.values())}")
    graph.outputs = [t for t in graph.outputs if size_of[int(t)] in sizes]
    made_by = {int(t): number for number, op in enumerate(graph.operators) for t in op.outputs}
    needed: set[int] = set()
    open_tensors = [int(t) for t in graph.outputs]
    while open_tensors:
        number = made_by.get(open_tensors.pop())
        if number is not None and number not in needed:
            needed.add(number)
            open_tensors += [int(t) for t in graph.operators[number].inputs if t >= 0]
    graph.operators = [op for number, op in enumerate(graph.operators) if number in needed]
    # Signatures name the outputs that are gone; nothing here calls a model by its signature.
    content.signatureDefs = None
    builder = flatbuffers.Builder(len(model))
    builder.Finish(content.Pack(builder), _FILE_IDENTIFIER)
    return bytes(builder.Output())
