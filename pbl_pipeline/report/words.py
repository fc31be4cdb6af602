"""Names, numbers and sentences of the report."""

from __future__ import annotations

from pbl_pipeline.qc import EMPTY, FAIL, NEEDS_CHOICE, PASS, WARN
from pbl_pipeline.words import capital

#: The measures of the tiles, before the GDI.
HEADLINES = ("cadence_steps_per_min", "stride_time_s", "stance_percent", "double_support_percent")

OUTCOME_WORDS = {
    PASS: "Passed",
    WARN: "Attention",
    EMPTY: "Nothing to measure",
    NEEDS_CHOICE: "Waits for a choice",
    FAIL: "Failed",
}
VERDICT_WORDS = {
    PASS: "Usable",
    WARN: "Usable with care",
    EMPTY: "No gait to measure",
    NEEDS_CHOICE: "A person has to be chosen",
    FAIL: "Not to be used",
}


def sentence(text: str) -> str:
    """Capitalise a text and end it with a full stop."""
    text = text.strip()
    return text and capital(text) + ("" if text[-1] in ".!?" else ".")


def plural(n: int, one: str) -> str:
    """ "1 recording", "2 recordings"."""
    return f"{n} {one}{'s' * (n != 1)}"


def size(n_bytes: int) -> str:
    """Bytes in decimal units."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:.1f} {unit}"
    return f"{n_bytes} bytes"
