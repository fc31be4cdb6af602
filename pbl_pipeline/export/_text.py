"""Numbers as text, a row or a column in one call: the time of an export is the time of formatting its numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


def rows(values: np.ndarray, formats: Sequence[str], separator: str, missing: str) -> list[str]:
    """One line for each row of (T, C) numbers; NaN is `missing`, -0.0 is 0."""
    line = separator.join(formats)
    values = np.asarray(values, float) + 0.0
    whole = np.sum(~np.isfinite(values), axis=1).tolist()
    out = []
    for row, unknown in zip(values.tolist(), whole, strict=True):
        if unknown:
            out.append(separator.join(f % v if v == v else missing for f, v in zip(formats, row, strict=True)))
        else:
            out.append(line % tuple(row))
    return out


def column(values: np.ndarray, form: str, missing: str = "") -> list[str]:
    """The text of each of (N,) numbers; NaN is `missing`, -0.0 is 0."""
    numbers = np.asarray(values, float) + 0.0
    missed = np.flatnonzero(np.isnan(numbers)).tolist()
    text = ((form + "\n") * len(numbers) % tuple(np.nan_to_num(numbers).tolist())).split("\n")
    for i in missed:
        text[i] = missing
    return text[:-1]
