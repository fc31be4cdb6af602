"""Options that several commands share."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline.errors import PblError

if TYPE_CHECKING:
    from pbl_pipeline.paramset import Paramset


class Person(click.ParamType):
    """`auto` (None) or the number of a person."""

    name = "auto|N"

    def convert(self, value: object, param: click.Parameter | None, ctx: click.Context | None) -> int | None:
        if value is None or value == "auto" or isinstance(value, int):
            return value if isinstance(value, int) else None
        if isinstance(value, str) and value.isdecimal():
            return int(value)
        return self.fail(f"{value!r} is neither 'auto' nor the number of a person", param, ctx)


def fit_paramset(solver: str, params: str | None) -> Paramset:
    """The paramset that `--solver` and `--params` (a name, or a JSON file of changes to the default) ask for.

    Raises `PblError` SOLVER_UNKNOWN, FILE_FORMAT.
    """
    from pbl_pipeline.fit import DEFAULT, PARAMSETS, SOLVERS, params_of
    from pbl_pipeline.paramset import Paramset

    if solver not in SOLVERS:
        raise _unknown(f"solver {solver!r}", SOLVERS)
    if params is None:
        return PARAMSETS[DEFAULT]
    if params in PARAMSETS:
        return PARAMSETS[params]
    path = Path(params)
    if not path.is_file():
        raise _unknown(f"paramset {params!r}, and no such file", tuple(PARAMSETS))
    base = PARAMSETS[DEFAULT]
    try:
        changes = json.loads(path.read_text())
        if not isinstance(changes, dict):
            raise TypeError("not an object")
        merged = _merge(dataclasses.asdict(params_of(base)), changes)
        return Paramset.of("fit", path.stem, 1, params_of(Paramset("fit", path.stem, 1, merged)))
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise PblError(
            "FILE_FORMAT",
            found=f"{type(error).__name__}: {error}",
            expected=f'a JSON object with some of the parameters of {DEFAULT}, such as {{"steps": 8000}}',
            next_step="correct the file",
            key=path,
        ) from error


def _merge(base: dict, changes: dict) -> dict:
    unknown = set(changes) - set(base)
    if unknown:
        raise KeyError(f"unknown parameters {sorted(unknown)}; known: {sorted(base)}")
    for name, value in changes.items():
        _check_kind(name, value, base[name])
    nested = {k: _merge(base[k], v) for k, v in changes.items() if isinstance(base[k], dict)}
    return {**base, **changes, **nested}


def _check_kind(name: str, value: object, default: object) -> None:
    """A value must be of its default's kind; numbers are finite and not negative, counts at least 1."""
    if isinstance(default, (dict, str, bool)):
        fits = isinstance(value, type(default))
    elif isinstance(default, (list, tuple)):
        fits = isinstance(value, list)
    elif isinstance(default, int):
        fits = (
            isinstance(value, int) and not isinstance(value, bool) and value >= (name in ("steps", "samples_per_trial"))
        )
    else:
        fits = isinstance(value, (int, float)) and not isinstance(value, bool) and 0 <= value < math.inf
    if not fits:
        raise ValueError(f"{name} = {json.dumps(value)}; the default is {json.dumps(default)}")


def _unknown(found: str, known: tuple[str, ...]) -> PblError:
    return PblError("SOLVER_UNKNOWN", found=found, expected=f"one of {', '.join(known)}", next_step="pass one of these")
