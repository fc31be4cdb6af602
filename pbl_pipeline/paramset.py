"""Method parameters as frozen, hashed data: what makes a result reproducible.

A method row in the database is one `Paramset`. It is never edited: other parameters are another row.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from typing import Any


@dataclasses.dataclass(frozen=True)
class Paramset:
    """Name, version and parameters of one method of one stage ("tracking", "keypoints", "fit", "gait", "gdi")."""

    stage: str
    name: str
    version: int
    params: Mapping[str, Any]

    @classmethod
    def of(cls, stage: str, name: str, version: int, params: Any) -> Paramset:
        """From a frozen parameter dataclass."""
        return cls(stage, name, version, dataclasses.asdict(params))

    @property
    def canonical_json(self) -> str:
        """The parameters as JSON with sorted keys and no spaces: equal parameters, equal text."""
        return canonical_json(self.params)

    @property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 over stage, name, version and canonical JSON."""
        text = "\n".join([self.stage, self.name, str(self.version), self.canonical_json])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def canonical_json(value: Any) -> str:
    """JSON text that is the same for equal values (sorted keys, no spaces, no NaN)."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)
