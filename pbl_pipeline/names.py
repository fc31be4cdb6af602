"""Validation of what people type: names and labels, which have no control characters and are made distinct within a
session; body mass and height."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from unicodedata import category, normalize

from pbl_pipeline.errors import PblError

#: Control characters, invisible formatting characters (U+202E reverses what follows), halves of
#: letters (bytes that are not text), separators of lines and paragraphs.
_ODD = ("Cc", "Cf", "Cs", "Zl", "Zp")
#: Formatting characters that words need: joiners of Persian, Hindi and of combined emoji.
_JOINERS = "\u200c\u200d"
#: Letters and marks that are invisible.
_BLANK = "\u034f\u115f\u1160\u17b4\u17b5\u2800\u3164\uffa0"
#: Space characters, which are written as one space each.
_SPACES = re.compile("[ \u00a0\u1680\u2000-\u200a\u202f\u205f\u3000]+")
_NUMBER = re.compile(r"0|[1-9][0-9]{0,8}")


def is_plain(text: str) -> bool:
    """Return whether a text is one line, can be stored, and reads as it is printed."""
    return not any(c in _BLANK or (category(c) in _ODD and c not in _JOINERS) for c in text)


def normalised_label(text: str) -> str:
    """Return a label as it is stored and compared: NFC, no spaces at its ends, one space for several within it.

    Case and accents stay; control characters stay too, for `check_label` to refuse.
    """
    return normalize("NFC", _SPACES.sub(" ", text).strip(" "))


def shortened(text: str, longest: int) -> str:
    """Return a text in words of at most so many characters: of a longer one the first words, and an ellipsis."""
    if len(text) <= longest:
        return text
    room = max(0, longest - len(" ..."))
    words = text[: room + 1].rpartition(" ")[0]
    return f"{words if 2 * len(words) >= room else text[:room]} ..."[:longest]


def check_label(what: str, text: str, longest: int, least: int = 0) -> None:
    """Refuse a label with control characters, or of another length. `what` names it in the error.

    Raises `PblError` USAGE.
    """
    plain = is_plain(text)
    if plain and least <= len(text) <= longest:
        return
    raise PblError(
        "USAGE",
        found=f"{what} of {len(text)} characters" if plain else f"{what} {ascii(text)[:80]}",
        expected=f"{least} to {longest} characters" if plain else "one line without control or invisible characters",
        next_step="choose another one",
    )


def whole_number(text: str) -> int | None:
    """Return the number that a text is, None if it is not in its shortest form or has over nine digits."""
    return int(text) if _NUMBER.fullmatch(text) else None


def distinct(stems: Sequence[str], numbers: Sequence[int]) -> list[str]:
    """Return a name for each stem: the stem itself, with its number if stems repeat or the name is taken."""
    count = Counter(stems)
    taken = {s for s in stems if count[s] == 1}
    names = []
    for stem, number in zip(stems, numbers, strict=True):
        name = stem
        if count[stem] > 1:
            name = f"{stem}-{number}"
            while name in taken:
                name += f"-{number}"
            taken.add(name)
        names.append(name)
    return names


#: Masses (kg) of people who walk, with room to spare.
MASS_KG = (5.0, 400.0)
#: Heights (m) of people, the smallest walking child and the tallest adult with room to spare.
HEIGHT_M = (0.5, 2.6)


def check_mass(mass_kg: float | None) -> None:
    """Raise `PblError` FIT_INPUT unless it is the mass of a person in kilograms."""
    _check_size("mass", mass_kg, MASS_KG, "kg", "kilograms", 68.5)


def check_height(height_m: float | None) -> None:
    """Raise `PblError` FIT_INPUT unless it is the height of a person in metres."""
    _check_size("height", height_m, HEIGHT_M, "m", "metres", 1.72)


def _check_size(
    what: str, value: float | None, bounds: tuple[float, float], unit: str, units: str, such_as: float
) -> None:
    if value is not None and not bounds[0] <= value <= bounds[1]:
        found, expected = f"a body {what} of {value:g} {unit}", f"{units}, {bounds[0]:g} to {bounds[1]:g}"
        next_step = f"state the {what} in {units}, such as {such_as:g}, or leave it out"
        raise PblError("FIT_INPUT", found, expected, next_step)
