"""Cells of tables for spreadsheets, which evaluate a text that begins like a formula.

`=HYPERLINK(...)` as the label of a visit or the name of a file must not be evaluated when a table is opened. Such texts
are written after an apostrophe, by which spreadsheets recognise a text; numbers stay numbers.
"""

from __future__ import annotations

import re
from typing import Any

#: What begins a formula (OWASP, CSV injection); those of full width as well.
_FORMULA = re.compile(r"[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")


def quoted(text: str) -> str:
    """Return a cell's text as it is written. `unquoted` is the way back."""
    return f"'{text}" if _computed(text) else text


def unquoted(text: str) -> str:
    """Return the text of a cell that `quoted` wrote."""
    return text[1:] if text.startswith("'") and _computed(text[1:]) else text


def frame_to_csv(frame: Any, digits: str | None = None) -> str:
    """Return a DataFrame as CSV without its index, texts and names of columns `quoted`.

    Parameters
    ----------
    digits
        Format of numbers, such as "%.8g".
    """
    return _mapped(frame, quoted).to_csv(index=False, float_format=digits, lineterminator="\n")


def unquoted_frame(frame: Any) -> Any:
    """Return a DataFrame that was read from what `frame_to_csv` wrote, with the texts that were given."""
    return _mapped(frame, unquoted)


def _mapped(frame: Any, change: Any) -> Any:
    out = frame.rename(columns=lambda name: change(name) if isinstance(name, str) else name)
    for i, dtype in enumerate(frame.dtypes):
        if dtype.kind not in "biufcmM":
            texts = [change(v) if isinstance(v, str) else v for v in frame.iloc[:, i]]
            kind = object if dtype.name == "category" else dtype  # changed categories are texts
            out.isetitem(i, type(frame.iloc[:, i])(texts, index=frame.index, dtype=kind))
    return out


def _computed(text: str) -> bool:
    bare = text.lstrip("'")
    if len(bare) < 2 or not _FORMULA.match(bare):
        return False
    try:
        float(bare)
    except ValueError:
        return True
    return False
