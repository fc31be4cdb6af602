"""All formats, and the one of a file."""

from __future__ import annotations

from pathlib import Path

from pbl_pipeline.errors import PblError

from . import apdm, movella_dot, opensense, own, sensor_logger, shimmer, xsens
from .samples import Samples, log_error, opened, unknown_error

FORMATS = (
    xsens.FORMAT,
    apdm.NEW,
    apdm.OLD,
    opensense.FORMAT,
    own.FORMAT,
    sensor_logger.FORMAT,
    shimmer.FORMAT,
    movella_dot.FORMAT,
)


def read_samples(path: Path, rate_hz: float | None = None, called: str | None = None) -> list[Samples]:
    """The sensors in a file, whose format is found by its content.

    `rate_hz`: for a file that does not state its own; `called`: name of the file of which this one is a copy.

    Raises `PblError` FILE_MISSING, FILE_FORMAT (no known format), SENSOR_LOG.
    """
    file, form = opened(path, rate_hz, called), ""
    try:
        found = next((f for f in FORMATS if f.knows(file)), None)
        if found is None:
            raise unknown_error("a file of no known format", ", ".join(f.name for f in FORMATS), key=called or path)
        form = found.name
        return list(found.reads(file))
    except PblError as error:
        if error.code != "PHONE_LOG":
            raise
        raise log_error(error.found, error.expected, key=called or path) from error
    except (ValueError, LookupError) as error:
        found = f"{form}: {type(error).__name__}: {error}"[:300]
        raise file.refuse(found, "a whole file as the program writes it") from error
