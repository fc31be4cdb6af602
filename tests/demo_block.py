"""The block of README.md that shows what `make demo` prints, beside what it printed."""

import re

from . import pages

#: How far a number of README may be from that of another machine, by what follows it. Numbers that count something
#: (cycles, the 90 of the interval) are equal, all others are points of the index.
TOLERANCES = {"steps/min": 1.0, "s": 0.02, "% of the stride": 1.0, "px": 0.5, "cm": 0.5}
INDEX_TOLERANCE = 2.0
EXACT = ("cycles", "% interval")
_NUMBER = re.compile(r"(?<![\w.-])\d+(?:\.\d+)?(?!\w)")


def stated_tolerances() -> str:
    """The tolerances as README states them."""
    steps, seconds, percent, px, cm = (f"{value:g} {unit}" for unit, value in TOLERANCES.items())
    steps = steps.replace("1 steps", "1 step")
    return f"within {steps}, {seconds}, {percent}, {INDEX_TOLERANCE:g} points of the GDI, {px} and {cm}"


def in_readme() -> list[str]:
    """The lines of the block."""
    (block,) = (b for b in pages.blocks("README.md") if b.language == "text")
    return block.code.splitlines()


def printed_by_demo(stdout: str) -> list[str]:
    """The lines of the visit that `pbl demo` printed."""
    return stdout.partition("[5/5] result")[2].strip().split("\n\n")[0].splitlines()


def differences(readme: list[str], printed: list[str]) -> list[str]:
    """One text for each line that is missing, additional, or different by more than the tolerances."""
    found = []
    ours, theirs = ({line[:22].strip(): line[22:] for line in lines} for lines in (readme, printed))
    for name in [*ours, *(theirs.keys() - ours.keys())]:
        if name not in ours or name not in theirs:
            found.append(f"{name}: only {'printed' if name in theirs else 'in README'}")
        elif not _agree(ours[name], theirs[name]):
            found.append(f"{name}: {ours[name]!r} in README, {theirs[name]!r} printed")
    return found


def _agree(readme: str, printed: str) -> bool:
    if _NUMBER.sub("#", readme) != _NUMBER.sub("#", printed):
        return False
    pairs = zip(_NUMBER.finditer(readme), _NUMBER.finditer(printed), strict=True)
    return all(abs(float(a[0]) - float(b[0])) <= _tolerance(readme[a.end() :]) + 1e-9 for a, b in pairs)


def _tolerance(after: str) -> float:
    after = after.lstrip()
    if after.startswith(EXACT):
        return 0.0
    unit = max((u for u in TOLERANCES if re.match(rf"{re.escape(u)}(?!\w)", after)), key=len, default="")
    return TOLERANCES.get(unit, INDEX_TOLERANCE)
