"""Needs of each computed table: resource class, time limit, how many jobs it takes at once."""

from __future__ import annotations

import dataclasses
from typing import Any

from pbl_pipeline.errors import PblError
from pbl_schemas import computed_tables

#: Resource classes: reading video, neural detectors on video, the session fit, and everything that takes milliseconds.
DECODE, DETECTOR, FIT, LIGHT = "decode", "detector", "fit", "light"
#: Groups of resource classes that a machine can serve.
CLASSES = (DECODE, DETECTOR, FIT, LIGHT)
GROUPS: dict[str, tuple[str, ...]] = {"all": CLASSES, "cpu": (DECODE, DETECTOR, LIGHT), "gpu": (FIT,)}
GROUPS |= {name: (name,) for name in CLASSES}

#: Priority of a recording of a phone (the person is still there), of new work and of what is computed again: the lower
#: number is taken first.
FIRST, NEW, AGAIN = 1, 5, 8
#: A recording with more frames is long: ten minutes of detection at 20 frames/s.
LONG_FRAMES = 12_000
#: Priority of the jobs of a long recording: behind the short ones of its kind, ahead of the next kind.
LONG = {priority: priority + 1 for priority in (FIRST, NEW, AGAIN)}
_SHORT = {long: priority for priority, long in LONG.items()}


@dataclasses.dataclass(frozen=True)
class Stage:
    """Needs of one computed table. limit_s: after that a job is ended and becomes an error row. batch: jobs reserved
    at once: 1 where a job takes long, so that none waits behind it while other workers are idle."""

    resource: str
    limit_s: float
    batch: int


#: By the name of the table. Their order is not said here: `pbl_schemas.chain` reads it from the foreign keys.
STAGES: dict[str, Stage] = {
    "VideoInfo": Stage(DECODE, 1800.0, 1),  # its pictures are in memory for the stages that follow
    "Tracking": Stage(DETECTOR, 4 * 3600.0, 1),
    "SubjectChoice": Stage(LIGHT, 300.0, 16),
    "Keypoints": Stage(DETECTOR, 4 * 3600.0, 1),
    "TrialInput": Stage(LIGHT, 300.0, 16),
    "SessionFit": Stage(FIT, 4 * 3600.0, 1),
    "GaitEvents": Stage(LIGHT, 600.0, 16),
    "GaitCycle": Stage(LIGHT, 600.0, 16),
    "Spatiotemporal": Stage(LIGHT, 300.0, 16),
    "GDI": Stage(LIGHT, 300.0, 16),
    "SessionGdi": Stage(LIGHT, 600.0, 16),
    "SessionQc": Stage(LIGHT, 300.0, 16),
    "Kinetics": Stage(LIGHT, 600.0, 4),
    "KinematicError": Stage(LIGHT, 300.0, 16),
    "Deidentified": Stage(DETECTOR, 4 * 3600.0, 1),
}


def base_priority(priority: int) -> int:
    """The priority that a job would have if its recording were short."""
    return _SHORT.get(priority, priority)


def stage_of(table: Any) -> Stage:
    """The entry of a computed table (class or name)."""
    return STAGES[table if isinstance(table, str) else table.__name__]


def tables_of(resource: str) -> list[Any]:
    """The computed tables that a resource class or group serves, in the order of the chain."""
    return [t for t in computed_tables() if stage_of(t).resource in GROUPS[resource]]


def table_named(name: str) -> Any:
    """A computed table by its name, in any case of letters. Raises USAGE."""
    for table in computed_tables():
        if table.__name__.lower() == name.lower():
            return table
    raise PblError(
        "USAGE",
        found=f"no computed table {name}",
        expected="one of " + ", ".join(t.__name__ for t in computed_tables()),
        next_step="name one of these with --table",
    )
