"""Statements in the names of files (`pbl ingest --name-pattern`)."""

from __future__ import annotations

import re
from pathlib import Path

from pbl_pipeline.errors import PblError

#: Names of the groups of a pattern, each once.
GROUPS = ("subject", "session", "pace", "activity")


def compiled(text: str) -> re.Pattern[str]:
    """The pattern (a regular expression of Python with named groups) for a file's name without its suffix.

    Raises
    ------
    PblError
        USAGE for an invalid regular expression, one without named groups, or with others than `GROUPS`.
    """
    try:
        pattern = re.compile(text)
    except re.error as error:
        raise _no_pattern(f"{text!r}: {error}") from error
    if not pattern.groupindex:
        raise _no_pattern(f"{text!r} without named groups")
    if unknown := sorted(set(pattern.groupindex) - set(GROUPS)):
        raise _no_pattern(f"{text!r} with the groups {', '.join(unknown)}")
    return pattern


def _no_pattern(found: str) -> PblError:
    return PblError(
        "USAGE",
        found=f"name pattern {found}",
        expected=f"a regular expression with groups (?P<NAME>...) of the names {', '.join(GROUPS)}",
        next_step="for P017_fast_2.mp4 for example: --name-pattern '(?P<subject>[^_]+)_(?P<pace>[^_]+)_.*'",
    )


def read_name(pattern: re.Pattern[str], path: Path) -> dict[str, str]:
    """Group -> what the file's whole name says, without groups that took no part or are empty.

    Raises
    ------
    PblError
        USAGE where the name does not fit the pattern.
    """
    match = pattern.fullmatch(path.stem)
    if match is None:
        raise PblError(
            "USAGE",
            found=f"the name {ascii(path.stem)[:100]}",
            expected=f"one that fits the whole name pattern {pattern.pattern}",
            next_step="rename the file, correct the pattern, or ingest the file in a separate call",
            key=ascii(str(path)),
        )
    return {name: text for name, text in match.groupdict().items() if text}
