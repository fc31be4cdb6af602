"""Method parameters as frozen, hashed data, which make a result reproducible.

A method row in the database is one `Paramset`. It is never edited: other parameters are another row.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Mapping
from typing import Any, TypeVar

import cattrs
import numpy as np

P = TypeVar("P")
_LATER = "later"


@dataclasses.dataclass(frozen=True)
class Paramset:
    """Name, version and parameters of one method of one stage (`methods.STAGES`), as a row stores them."""

    stage: str
    name: str
    version: int
    params: Mapping[str, Any]

    @classmethod
    def of(cls, stage: str, name: str, version: int, params: Any) -> Paramset:
        """From a frozen parameter dataclass; fields of `later` only where they differ from their default."""
        return cls(stage, name, version, _plain(params))

    def to(self, cls: type[P]) -> P:
        """The parameter dataclass again, the inverse of `of`, also after the parameters went through JSON.

        Parameters that are left out have their defaults. Raises `ValueError` for parameters that `cls` lacks, and for
        values of another type.
        """
        return structured(self.params, cls)

    @property
    def key(self) -> str:
        """Short readable key: `<name>-v<version>`."""
        return f"{self.name}-v{self.version}"

    @property
    def canonical_json(self) -> str:
        """The parameters as JSON with sorted keys and no spaces: equal parameters, equal text."""
        return canonical_json(self.params)

    @functools.cached_property
    def hash(self) -> str:
        """First 16 hex digits of the SHA-256 over stage, name, version and canonical JSON."""
        text = "\n".join([self.stage, self.name, str(self.version), self.canonical_json])
        return hashlib.sha256(text.encode()).hexdigest()[:16]


def later(default: Any) -> Any:
    """A field that was added to parameters after methods with them had shipped. It is left out at its default, which
    must be what the methods did before, so that their hashes stay."""
    return dataclasses.field(default=default, metadata={_LATER: True})


def _plain(params: Any) -> dict[str, Any]:
    out = dataclasses.asdict(params)
    for field in dataclasses.fields(params):
        value = getattr(params, field.name)
        if field.metadata.get(_LATER) and value == field.default:
            del out[field.name]
        elif dataclasses.is_dataclass(value):
            out[field.name] = _plain(value)
    return out


def structured(values: Any, cls: type[P]) -> P:
    """A frozen dataclass from plain values, such as those of JSON. Raises `ValueError` as `Paramset.to`."""
    try:
        return _CONVERTER.structure(values, cls)
    except cattrs.BaseValidationError as error:
        raise ValueError("; ".join(cattrs.transform_error(error, format_exception=_reason))) from error


def canonical_json(value: Any) -> str:
    """JSON text that is the same for equal values (sorted keys, no spaces, no NaN)."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def _exactly(value: Any, kind: type) -> Any:
    """Return `value` if it has this type already; an int passes for a float, as people and databases write 1.0 as 1."""
    wanted = (int, float) if kind is float else kind
    if not isinstance(value, wanted) or (isinstance(value, bool) and kind is not bool):
        raise TypeError(f"{value!r} is not of type {kind.__name__}")
    return kind(value)


def _reason(error: BaseException, kind: type | None) -> str:
    """Return the fault of one value, for `cattrs.transform_error`, which adds its path."""
    return str(error) if isinstance(error, TypeError) else cattrs.v.format_exception(error, kind)


#: cattrs alone would turn "0.1" into 0.1 and 1.5 into 1.
_CONVERTER = cattrs.Converter(forbid_extra_keys=True)
for _kind in (bool, int, float, str):
    _CONVERTER.register_structure_hook(_kind, _exactly)
_CONVERTER.register_structure_hook(np.ndarray, lambda value, _: np.asarray(value, float))
