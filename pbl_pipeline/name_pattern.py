"""Subject, session, pace and activity in the names of files (`pbl ingest --name-pattern`)."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from pbl_pipeline.errors import PblError
from pbl_pipeline.limited import LimitExceeded, limited

#: Names of the groups of a pattern, each once.
GROUPS = ("subject", "session", "pace", "activity")
#: Time (s, the start of a process included) and memory (bytes) to match all names.
LONGEST_S, _MOST_BYTES = 20.0, 2**28


def read_names(text: str, paths: Sequence[Path]) -> tuple[tuple[str, ...], list[dict[str, str] | None]]:
    """Return the groups of a pattern, and for each file a dict from group to its text in the whole name without suffix:
    empty groups are left out, and the dict is None if the name does not fit.

    The pattern is a regular expression of Python with named groups. Some take years for a short name, so they are
    matched in a process with limits.

    Raises `PblError` USAGE for an invalid regular expression, one without named groups, with others than `GROUPS`, or
    one that takes more than `LONGEST_S`.
    """
    try:
        return limited(_matched, text, [p.stem for p in paths], seconds=LONGEST_S, n_bytes=_MOST_BYTES, returns=True)
    except LimitExceeded as error:
        raise _no_pattern(f"{text[:200]!r} takes too much: {error}") from error


def unfit(text: str, path: Path) -> PblError:
    """Return the error USAGE of a file whose name does not fit the pattern."""
    return PblError(
        "USAGE",
        found=f"the name {ascii(path.stem)[:100]}",
        expected=f"one that fits the whole name pattern {text[:200]}",
        next_step="rename the file, correct the pattern, or ingest the file in a separate call",
        key=ascii(str(path)),
    )


def _matched(text: str, stems: Sequence[str]) -> tuple[tuple[str, ...], list[dict[str, str] | None]]:
    pattern = _compiled(text)
    found = [pattern.fullmatch(stem) for stem in stems]
    stated = [None if m is None else {name: said for name, said in m.groupdict().items() if said} for m in found]
    return tuple(pattern.groupindex), stated


def _compiled(text: str) -> re.Pattern[str]:
    try:
        pattern = re.compile(text)
    except (re.error, OverflowError, RecursionError) as error:
        raise _no_pattern(f"{text[:200]!r}: {error}") from error
    if not pattern.groupindex:
        raise _no_pattern(f"{text[:200]!r} without named groups")
    if unknown := sorted(set(pattern.groupindex) - set(GROUPS)):
        raise _no_pattern(f"{text[:200]!r} with the groups {', '.join(unknown)[:200]}")
    return pattern


def _no_pattern(found: str) -> PblError:
    return PblError(
        "USAGE",
        found=f"name pattern {found}",
        expected=f"a regular expression with groups (?P<NAME>...) of the names {', '.join(GROUPS)}",
        next_step="for P017_fast_2.mp4 for example: --name-pattern '(?P<subject>[^_]+)_(?P<pace>[^_]+)_.*'",
    )
