"""DeepLabCut's tables of results, .csv or .h5, of one animal or several; LightningPose and movement write them as well.

Columns have three or four levels: scorer, (individuals,) bodyparts, coords (x, y, likelihood). The index is the number
of the frame.
"""

from __future__ import annotations

import io
import pickletools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.bounded import count_cells, count_rows, read_text
from pbl_pipeline.csv_cells import unquoted
from pbl_pipeline.errors import os_errors_as

from .h5_arrays import array_of, texts_of
from .poses import Poses, bad_file, every_frame

_LEVELS = {3: ("scorer", "bodyparts", "coords"), 4: ("scorer", "individuals", "bodyparts", "coords")}
_ONE = "individual"


def read_dlc_csv(path: Path) -> Poses:
    """Read a .csv. See `read_poses`."""
    with os_errors_as("FILE_MISSING", "a table of DeepLabCut", "check the path, and that you may read the file", path):
        try:
            text = read_text(path)
            lines = text.splitlines()
            head = tuple(line.partition(",")[0].strip('"') for line in lines[:4])
            levels = next((n for n, names in _LEVELS.items() if head[:n] == names), 0)
            if not levels:
                raise ValueError(f"lines that begin with {', '.join(head)}"[:200])
            count_rows(len(lines))
            count_cells(len(lines) * (1 + lines[0].count(",")), 1 + lines[0].count(","))
            import pandas as pd  # not at the top: `pbl run` reads no such file

            table = pd.read_csv(io.StringIO(text), header=list(range(levels)), index_col=0)
            values, index = table.to_numpy(float), table.index.to_numpy()
        except ValueError as error:
            raise bad_file(str(error)[:200], "a .csv of DeepLabCut: scorer, bodyparts, coords", key=path) from error
    return _poses(path, [tuple(unquoted(str(n)) for n in column) for column in table.columns], index, values)


def read_dlc_h5(path: Path, file: Any) -> Poses:
    """Read an open .h5, which pandas wrote in its form "table" or "fixed". Names of columns are pickled in the first;
    their texts are taken in order, and nothing is unpickled."""
    group = next((file[k] for k in file if "pandas_type" in file[k].attrs), None)
    if group is None:
        raise bad_file(
            f"{', '.join(file) or 'nothing'}", "tracks and node_names of SLEAP, or a table of DeepLabCut", key=path
        )
    columns, blocks = [], []
    if "table" in group:
        table = array_of(group["table"])
        index = table["index"]
        for name in [n for n in table.dtype.names or () if n.startswith("values_block_")]:
            blocks.append(table[name].reshape(len(table), -1))
            columns += _columns(_texts(bytes(group["table"].attrs[f"{name}_kind"])), blocks[-1].shape[1])
    else:
        index = array_of(group["axis1"])
        for i in range(sum(k.endswith("_values") for k in group)):
            levels = sum(k.startswith(f"block{i}_items_level") for k in group)
            texts = [texts_of(group[f"block{i}_items_level{k}"]) for k in range(levels)]
            codes = [array_of(group[f"block{i}_items_label{k}"]) for k in range(levels)]
            columns += [tuple(t[c] for t, c in zip(texts, row, strict=True)) for row in zip(*codes, strict=True)]
            blocks.append(array_of(group[f"block{i}_values"]))
    return _poses(path, columns, index, np.concatenate(blocks, axis=1).astype(float))


def _texts(pickled: bytes) -> list[str]:
    """Texts of a pickled list of tuples, in order."""
    texts, memo, last = [], {}, ""
    for code, value, _ in pickletools.genops(pickled):
        if code.name.endswith("UNICODE"):
            texts.append(value)
            last = value
        elif code.name in ("PUT", "BINPUT", "LONG_BINPUT"):
            memo[value] = last
        elif code.name == "MEMOIZE":
            memo[len(memo)] = last
        elif code.name in ("GET", "BINGET", "LONG_BINGET"):
            texts.append(memo[value])
        elif code.name != "MARK":
            last = ""
    return texts


def _columns(texts: Sequence[str], n: int) -> list[tuple[str, ...]]:
    levels = len(texts) // max(n, 1)
    if len(texts) != levels * n:
        raise ValueError(f"{len(texts)} texts for {n} columns")
    return list(zip(*[iter(texts)] * levels, strict=True))


def _poses(path: Path, columns: Sequence[tuple[str, ...]], index: np.ndarray, values: np.ndarray) -> Poses:
    if {len(c) for c in columns} - set(_LEVELS) or len(set(columns)) < len(columns):
        raise bad_file(
            "columns of other levels, or twice", "scorer, individuals (if several), bodyparts, coords", key=path
        )
    found = {(c[1] if len(c) == 4 else _ONE, *c[-2:]): i for i, c in enumerate(columns)}
    if {c for _, _, c in found} != {"x", "y", "likelihood"}:
        raise bad_file(f"coords {', '.join(sorted({c for _, _, c in found}))}", "x, y and likelihood", key=path)
    if not len(index) or index.dtype.kind not in "iu" or index[0] < 0 or (np.diff(index) <= 0).any():
        raise bad_file("rows that are not numbered by frame", "results of a video, 0, 1, 2, ...", key=path)
    people, names = (tuple(dict.fromkeys(c[k] for c in found)) for k in (0, 1))
    points = np.full((len(people), len(names), 3, len(index)), np.nan)
    for p, person in enumerate(people):
        for j, name in enumerate(names):
            for k, coord in enumerate(("x", "y", "likelihood")):
                if (person, name, coord) in found:
                    points[p, j, k] = values[:, found[person, name, coord]]
    frame, points = every_frame(index, np.moveaxis(points, 3, 0))
    points = np.moveaxis(points, 0, 1)
    return Poses("DeepLabCut", frame, people, names, points[..., :2], points[..., 2])
