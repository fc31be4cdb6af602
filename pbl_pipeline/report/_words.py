"""Names, numbers and sentences as people read them."""

from __future__ import annotations

import math

from pbl_pipeline.qc import EMPTY, FAIL, NEEDS_CHOICE, PASS, WARN, Check

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
_UNITS = {"cm": "cm", "px": "px", "s": "s", "deg": "°", "percent": "%", "m": "m"}
_SPELLED = {"2d": "2D", "3d": "3D", "gdi": "GDI"}


def number(value: float | None, decimals: int) -> str:
    """The value with so many decimals and a real minus sign; an en dash where it is unknown."""
    if value is None or not math.isfinite(value):
        return "\N{EN DASH}"
    text = f"{value:.{decimals}f}"
    return (text.lstrip("-") if float(text) == 0 else text).replace("-", "\N{MINUS SIGN}")


def significant(value: float | None, digits: int = 3) -> str:
    """The value with so many significant digits, never in powers of ten; empty where there is none."""
    if value is None or not math.isfinite(value):
        return ""
    if value == 0:
        return "0"
    decimals = min(6, max(0, digits - 1 - math.floor(math.log10(abs(value)))))
    text = f"{value:.{decimals}f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text).replace("-", "\N{MINUS SIGN}")


def check_name(check: Check) -> str:
    """ "residual_3d_cm" -> "Residual 3D (cm)"."""
    words = check.check.split("_")
    unit = _UNITS.get(words[-1]) if len(words) > 1 else None
    words = [_SPELLED.get(w, w) for w in (words[:-1] if unit else words)]
    text = " ".join(words) + (f" ({unit})" if unit else "")
    return text[:1].upper() + text[1:]


def sentence(text: str) -> str:
    """The text with a capital at its start and a full stop at its end."""
    text = text.strip()
    return text and text[0].upper() + text[1:] + ("" if text[-1] in ".!?" else ".")


def plural(n: int, one: str, many: str | None = None) -> str:
    """ "1 recording", "2 recordings"."""
    return f"{n} {one if n == 1 else many or one + 's'}"


def size(n_bytes: int) -> str:
    """Bytes in decimal units."""
    for unit, factor in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if n_bytes >= factor:
            return f"{n_bytes / factor:.1f} {unit}"
    return f"{n_bytes} bytes"
