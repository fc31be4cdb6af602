"""Method parameters as frozen, hashed data: what makes a result reproducible.

A method row in the database is one `Paramset`. It is never edited: other parameters are another row.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

P = TypeVar("P")


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

    def to(self, cls: type[P]) -> P:
        """The parameter dataclass again, the inverse of `of`, also after the parameters went through JSON.

        Raises `TypeError` or `KeyError` where they are not parameters of `cls`.
        """
        return _from_plain(cls, self.params)

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


def _from_plain(target: Any, value: Any) -> Any:
    """Undo what JSON does to a frozen dataclass: lists back to tuples, dicts to nested dataclasses, 1 to 1.0."""
    origin = typing.get_origin(target)
    if origin in (typing.Union, types.UnionType):
        if value is None:
            return None
        return _from_plain(next(a for a in typing.get_args(target) if a is not type(None)), value)
    if dataclasses.is_dataclass(target) and isinstance(target, type):
        hints = typing.get_type_hints(target)
        unknown = set(value) - {f.name for f in dataclasses.fields(target)}
        if unknown:
            raise TypeError(f"unknown parameters {sorted(unknown)}")
        return target(**{k: _from_plain(hints[k], v) for k, v in value.items()})
    if origin is tuple or target is tuple:
        args = typing.get_args(target)
        if len(args) == 2 and args[1] is Ellipsis:
            args = (args[0],) * len(value)
        return tuple(_from_plain(a, v) for a, v in zip(args or (Any,) * len(value), value, strict=True))
    if target is Any and isinstance(value, list):
        return tuple(_from_plain(Any, v) for v in value)
    if target is float and type(value) is int:
        return float(value)
    return value
