"""The index of one camera against that of several cameras, each with the norm of its kind (the paper, Supplement)."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.stats import bland_altman, correlation

from .paper import paper_cells
from .table import Cell, Table

#: Columns of the indices: of a visit by one kind of recordings (`kind`: single, rig, markers) against a norm that was
#: built from cycles of `norm_kind`; "" for one that ships.
INDEX_COLUMNS = ("subject", "session_label", "session_id", "kind", "method", "norm", "norm_kind", "index")
#: Columns of the pairs: the index of one camera and of several, of one visit.
PAIR_COLUMNS = ("subject", "session_label", "single", "rig", "single_norm", "rig_norm")
_ROW = "GDI of one camera against several"


def index_pairs(indices: pd.DataFrame) -> pd.DataFrame:
    """Visits that have an index of one camera and one of several, each against a norm of its own kind, as pairs.

    Raises `PblError` USAGE: a visit has several such indices of one kind, by several methods or norms.

    Parameters
    ----------
    indices
        Rows with `INDEX_COLUMNS`. An index against a norm of another kind, or against one that ships, does not count.
    """
    own: Any = indices[(indices["kind"] == indices["norm_kind"]) & indices["index"].notna()]
    twice = own[own.duplicated(["session_id", "kind"], keep=False)]
    if len(twice):
        chains = sorted({f"{m}, {n}" for m, n in zip(twice["method"], twice["norm"], strict=True)})
        raise PblError(
            "USAGE",
            found=f"several indices of one kind for a visit: {'; '.join(chains[:6])}",
            expected="one index and one norm of each kind",
            next_step="name them: --where method=NAME, or --where norm=NAME for each kind",
        )
    columns = ["subject", "session_label", "session_id", "index", "norm"]
    kinds = [
        own.loc[own["kind"] == k, columns].rename(columns={"index": k, "norm": f"{k}_norm"}) for k in ("single", "rig")
    ]
    return kinds[0].merge(kinds[1], on=columns[:3])[list(PAIR_COLUMNS)]


def index_agreement(pairs: pd.DataFrame) -> Table:
    """Pearson's r, bias and limits of agreement of the index of one camera and of several.

    Raises `PblError` STATS_INPUT: fewer than four visits, or indices that are all the same.
    """
    one, several = (pairs[k].to_numpy(float) for k in ("single", "rig"))
    r, agreement, n = correlation(one, several), bland_altman(one, several), len(pairs)
    values = {
        "r": Cell(r.value, n=n, paper=paper_cells("index_agreement")[_ROW]["r"]),
        "r, low": Cell(r.low, n=n),
        "r, high": Cell(r.high, n=n),
        "bias": Cell(agreement.bias.value, n=n),
        "lower limit": Cell(agreement.lower.value, n=n),
        "upper limit": Cell(agreement.upper.value, n=n),
        "sd, one camera": Cell(float(np.std(one, ddof=1)), n=n),
        "sd, several": Cell(float(np.std(several, ddof=1)), n=n),
    }
    persons = pairs["subject"].nunique()
    norms = [", ".join(sorted(set(pairs[f"{k}_norm"]))) for k in ("single", "rig")]
    return Table(
        "index_agreement",
        "Index of one camera against several, each with a norm of its own kind",
        {(_ROW, column): cell for column, cell in values.items()},
        f"{n} visits of {persons} persons. Norms: {norms[0]} (one camera), {norms[1]} (several). Bias: one camera "
        "minus several; limits of agreement hold 95 % of the visits. r with its 95 % interval, which is too narrow "
        "where a person has several visits.",
        {column: 1 if column not in ("r", "r, low", "r, high") else 2 for column in values},
    )
