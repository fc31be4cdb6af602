"""Names of the recordings of a session, all different: files and rows are told apart by them."""

from __future__ import annotations

from collections.abc import Sequence


def distinct(stems: Sequence[str], numbers: Sequence[int]) -> list[str]:
    """A name for each stem: the stem itself, with its number where stems repeat or a name is taken already."""
    taken = {s for s in stems if stems.count(s) == 1}
    names = []
    for stem, number in zip(stems, numbers, strict=True):
        name = stem
        if stems.count(stem) > 1:
            name = f"{stem}-{number}"
            while name in taken:
                name += f"-{number}"
            taken.add(name)
        names.append(name)
    return names
