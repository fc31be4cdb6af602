"""One line of JSON per event on stderr, with the key of the job it is about."""

from __future__ import annotations

import json
import logging
import os
import platform
import sys
import time
from typing import Any

_FIELDS = "pbl_fields"


class JsonLines(logging.Formatter):
    """A record as one JSON object: time (UTC), level, event, host, pid, and the fields of `event`."""

    converter = time.gmtime

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "time": self.formatTime(record, "%Y-%m-%dT%H:%M:%S") + f".{int(record.msecs):03d}Z",
            "level": record.levelname,
            "event": record.getMessage(),
            "host": platform.node(),
            "pid": os.getpid(),
            **getattr(record, _FIELDS, {}),
        }
        if record.exc_info:
            line["stack"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)


def event(log: logging.Logger, level: int, what: str, job: Any = None, **fields: Any) -> None:
    """Log an event; the fields table and key come from `job`, a Claim. Empty fields are left out."""
    named = {} if job is None else {"table": job.table.__name__, "key": job.key}
    named |= {k: v for k, v in fields.items() if v not in ("", None)}
    log.log(level, what, extra={_FIELDS: named})


def to_stderr() -> None:
    """Send the events of this process to stderr, one JSON line each. Nothing else of the program logs there."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(JsonLines())
    root = logging.getLogger("pbl")
    root.handlers[:] = [handler]
    root.setLevel(logging.INFO)
    root.propagate = False
    # DataJoint would print every error row's text; the event and the row say it.
    logging.getLogger("datajoint").setLevel(logging.CRITICAL)
