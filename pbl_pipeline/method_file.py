"""A custom method from a JSON file: a registered one with other parameters (docs/files.md)."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pbl_pipeline.bounded import read_json
from pbl_pipeline.errors import PblError
from pbl_pipeline.methods import STAGES, Method, P, Stage, of_stage
from pbl_pipeline.paramset import Paramset

_NAME = re.compile(r"[a-z0-9][a-z0-9-]{1,31}")
#: Keys of the file that are not parameters.
_ABOUT = ("stage", "name", "base")


def read_method(path: Path, base: str | None = None, new_name: bool = True) -> Method[Any]:
    """Read the method that a file describes, as version 1: `stage` (default: fit), `name` (default: that of the file),
    `base`, the method whose parameters are changed (default: `base`, else the stage's default), and the changes, group
    by group. `new_name`: refuse a name that cannot be registered.

    Raises `PblError` FILE_MISSING, FILE_FORMAT: no such file or JSON object, an unknown stage, base or parameter, a
    value of another type, a name that ships or is not valid.
    """
    try:
        found = read_json(path)
        if not isinstance(found, dict):
            raise TypeError("not an object")
        about = {key: found.pop(key) for key in _ABOUT if key in found}
        if odd := [key for key, value in about.items() if not isinstance(value, str)]:
            raise TypeError(f"{odd[0]} is not a text")
        stage, name = about.get("stage", "fit"), about.get("name", path.stem)
        if stage not in STAGES:
            raise KeyError(f"stage {stage!r}; known: {', '.join(STAGES)}")
        methods = of_stage(stage)
        base = str(about.get("base", base or methods.default))
        before = methods.registered(base)
        if before is None:
            raise KeyError(f"base {base!r}; known: {', '.join(methods)}")
        if found.get(methods.kind, before.family.name) != before.family.name:
            raise ValueError(f"{methods.kind} {found[methods.kind]!r}, but {base} is of {before.family.name}")
        if new_name and (not _NAME.fullmatch(name) or name in methods):
            raise ValueError(f"name {name!r}: 2 to 32 small letters, digits and hyphens, and no name that ships")
        return changed(before, name, found)
    except FileNotFoundError as error:
        raise PblError(
            "FILE_MISSING", found="no such file", expected="a JSON file", next_step="check the path", key=path
        ) from error
    except (OSError, ValueError, TypeError, KeyError, OverflowError) as error:
        raise PblError(
            "FILE_FORMAT",
            found=f"{type(error).__name__}: {error}",
            expected='a JSON object such as {"stage": "fit", "base": "blazepose", "max_iterations": 60} with some of '
            f"the parameters of {base or 'a method'}",
            next_step="correct the file; docs/files.md describes it",
            key=path,
        ) from error


def named_or_file(stage: Stage[P], given: str | None, base: str | None = None) -> Method[P]:
    """The method of a stage by its name or by the path of a JSON file of changes (to `base` unless the file names
    another); None for the default.

    Raises `PblError` SOLVER_UNKNOWN; what `read_method` raises; FILE_FORMAT for a method of another stage.
    """
    is_file = given is not None and (given.endswith(".json") or Path(given).is_file())
    if given is None or not is_file or stage.registered(given) is not None:
        return stage.find(given)
    method = read_method(Path(given), base, new_name=False)
    if method.stage != stage.name:
        raise PblError(
            "FILE_FORMAT",
            found=f"a method of stage {method.stage!r}",
            expected=f'"stage": "{stage.name}"',
            next_step="name it in the file, or give the file to the other option",
            key=given,
        )
    return method


def changed(before: Method[Any], name: str, changes: Mapping[str, Any]) -> Method[Any]:
    """A method with other parameters under a name, as version 1. `changes` are laid over the old ones, group by group.

    Raises `ValueError` for parameters that the method lacks and values that cannot be.
    """
    params = _merge(dataclasses.asdict(before.params), changes, before.stage)
    merged = Paramset(before.stage, name, 1, params)
    return of_stage(before.stage).make(name, 1, merged.to(before.family.params), before.family)


def _merge(base: Mapping[str, Any], changes: Mapping[str, Any], stage: str) -> dict[str, Any]:
    for name, value in changes.items():
        _check_number(name, value, stage)
    groups = {k: v for k, v in changes.items() if isinstance(v, dict) and isinstance(base.get(k), dict)}
    return {**base, **changes, **{k: _merge(base[k], v, stage) for k, v in groups.items()}}


def _check_number(name: str, value: object, stage: str) -> None:
    """Refuse numbers that are not finite and, of the fit, negative ones and counts below 1. The parameters' class
    checks the types."""
    if not isinstance(value, (int, float)):
        return
    least = -math.inf if stage != "fit" else 1 if name in ("steps", "samples_per_trial", "max_iterations") else 0
    if not (least <= value and math.isfinite(value)):
        raise ValueError(
            f"{name} = {value}; expected a finite number" + (f", {least} or more" if stage == "fit" else "")
        )
