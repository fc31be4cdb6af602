"""Values of a page as JSON: what a program reads where a person reads the page."""

from __future__ import annotations

import dataclasses
import datetime
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pbl_pipeline.errors import PblError
from pbl_pipeline.visit import Recording, Visit, recording_facts, visit_facts
from schemas.reading.shown import ShownVisit

#: The folders of an absolute path in a text.
_FOLDERS = re.compile(r"(?<![\w:/.])/(?:[^\s/'\"]+/)+(?=[^\s/'\"])")


def plain(value: Any) -> Any:
    """Return a value of a template as plain JSON.

    A visit is what its session.json and metrics.json hold, which may load its arrays; a recording is its facts and
    events; a frame is a list of its rows. Numbers that are not finite are null. Of a path, alone or in a text, only the
    file's name is kept. Arrays are left out.
    """
    if isinstance(value, Visit):
        judged = value.judged
        return plain({**visit_facts(value), "metrics": None if judged is None else judged.to_dict()})
    if isinstance(value, Recording):
        events = [] if value.events is None else [dataclasses.asdict(e) for e in value.events.events]
        return plain({**recording_facts(value), "events": events})
    if isinstance(value, PblError):
        return plain({k: str(getattr(value, k) or "") for k in ("code", "found", "expected", "next_step", "key")})
    if isinstance(value, pd.DataFrame):
        return plain(value.to_dict("records"))
    if isinstance(value, ShownVisit):
        own = {f.name: getattr(value, f.name) for f in dataclasses.fields(value) if f.name != "load_visit"}
        return plain({**own, "visit": value.visit})
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(v) for v in value]
    if isinstance(value, datetime.date | datetime.datetime):
        return value.isoformat()
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, str):
        return _FOLDERS.sub("", value)
    if value is None or isinstance(value, int | bool):
        return value
    return value.name if isinstance(value, Path) else None
