"""What every table module shares: DataJoint behind our configuration, origin columns, method rows, coded errors, files.

Table modules import `dj` from here, so that the connection module has configured DataJoint before any table exists.
"""

from __future__ import annotations

import dataclasses
import datetime
import functools
import platform
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, TypeVarTuple, cast

import numpy as np

from pbl_pipeline import __version__
from pbl_pipeline.errors import CODES, PblError
from pbl_pipeline.paramset import Paramset

from . import connection as _connection  # noqa: F401  configures DataJoint before the import below

import datajoint  # isort: skip
from datajoint.errors import DuplicateError, LostConnectionError  # isort: skip
from datajoint.hash_registry import get_store_backend  # isort: skip

if TYPE_CHECKING:
    from pbl_pipeline.qc import Check

__all__ = [
    "DuplicateError",
    "LostConnectionError",
    "Origin",
    "computes",
    "dj",
    "method_columns",
    "origin_columns",
    "stored_file",
]

P = TypeVar("P")
Arguments = ParamSpec("Arguments")
Results = TypeVarTuple("Results")

#: DataJoint without its types: its metaclass lends classes the operators of queries, which no type checker can see.
dj: Any = datajoint

#: Longest texts that keep a whole coded error within the 2047 characters of a job's error_message.
_LIMITS = {"found": 600, "expected": 350, "next_step": 600, "key": 250}


# ------------------------------------------------------------------------------------------------ origin of a result
def origin_columns(prefix: str) -> str:
    """Definition lines that say where a result row comes from.

    The names carry the table's prefix, because DataJoint refuses joins of tables that share a secondary attribute.
    """
    return f"""
    {prefix}_code_version      : varchar(32)     # version of pbl-pipeline that computed the row
    {prefix}_method_hash=null  : char(16)        # hash of the frozen parameters, null where the stage has none
    {prefix}_model_sha256=null : char(64)        # SHA-256 of the model file, null where the stage has none
    {prefix}_host              : varchar(64)     # computer
    {prefix}_seconds           : float64         # (s) duration of the computation
    {prefix}_computed          : datetime        # when it ended, UTC
    index ({prefix}_computed)
    """


def check_columns(prefix: str) -> str:
    """Definition lines of a part table of quality checks; the names carry the prefix for the same reason."""
    return f"""
    -> master
    {prefix}_check           : varchar(64)       # name, with its unit
    ---
    {prefix}_check_outcome   : enum('PASS', 'WARN', 'EMPTY', 'NEEDS_CHOICE', 'FAIL')
    {prefix}_check_value=null     : float64      # in the unit (see {prefix}_check)
    {prefix}_check_threshold=null : float64      # in the unit (see {prefix}_check)
    {prefix}_check_advice    : varchar(1000)     # what to do about it
    """


def check_row(prefix: str, check: Check) -> dict[str, Any]:
    """A library `Check` as values of `check_columns(prefix)`."""
    return {
        f"{prefix}_check": check.check,
        f"{prefix}_check_outcome": check.outcome,
        f"{prefix}_check_value": number(check.value),
        f"{prefix}_check_threshold": number(check.threshold),
        f"{prefix}_check_advice": check.advice[:1000],
    }


def check_values(prefix: str, row: Mapping[str, Any]) -> tuple:
    """The arguments of the library's `Check` from a row of `check_columns(prefix)`."""
    return tuple(row[f"{prefix}_check{end}"] for end in ("", "_outcome", "_value", "_threshold", "_advice"))


@dataclasses.dataclass(frozen=True)
class Origin:
    """Version, host, duration and time of one computation."""

    code_version: str
    host: str
    seconds: float
    computed: datetime.datetime

    @classmethod
    def now(cls, seconds: float) -> Origin:
        """Of a computation that ended now, here, and took `seconds`."""
        return cls(__version__, platform.node()[:64], round(seconds, 3), utc_now())

    def row(self, prefix: str, *, method_hash: str | None = None, model_sha256: str | None = None) -> dict[str, Any]:
        """Values of `origin_columns(prefix)`."""
        return {
            f"{prefix}_code_version": self.code_version,
            f"{prefix}_method_hash": method_hash,
            f"{prefix}_model_sha256": model_sha256,
            f"{prefix}_host": self.host,
            f"{prefix}_seconds": self.seconds,
            f"{prefix}_computed": self.computed,
        }


def computes(make_compute: Callable[Arguments, tuple[*Results]]) -> Callable[Arguments, tuple[*Results, Origin]]:
    """Decorator of every `make_compute`: appends an `Origin` to its results and leaves only coded errors.

    A `PblError` keeps its code and next step but is cut to fit the job's error row (its full text stays in the error
    stack, as the cause). Anything else becomes INTERNAL: a table never shows a bare traceback as its message.
    """

    @functools.wraps(make_compute)
    def wrapper(*arguments: Arguments.args, **named: Arguments.kwargs) -> tuple[*Results, Origin]:
        start = time.monotonic()
        table, key = cast("tuple[Any, dict[str, Any]]", arguments[:2])
        try:
            result = make_compute(*arguments, **named)
        except PblError as error:
            raise _fitted(error, key) from error
        except Exception as error:
            raise PblError(
                "INTERNAL",
                found=_cut(f"{type(error).__name__}: {error}", _LIMITS["found"]),
                expected="a result or a coded error",
                next_step="report this with the error stack that `pbl status --json` prints",
                key=_cut(_key_text(table, key), _LIMITS["key"]),
            ) from error
        return (*result, Origin.now(time.monotonic() - start))

    return wrapper


def _fitted(error: PblError, key: Mapping[str, Any]) -> PblError:
    about = error.key if error.key is not None else ", ".join(f"{k}={v}" for k, v in key.items())
    return PblError(
        error.code,
        found=_cut(error.found, _LIMITS["found"]),
        expected=_cut(error.expected, _LIMITS["expected"]),
        next_step=_cut(error.next_step, _LIMITS["next_step"]),
        key=_cut(str(about), _LIMITS["key"]),
    )


def _key_text(table: Any, key: Mapping[str, Any]) -> str:
    return f"{type(table).__name__} " + ", ".join(f"{k}={v}" for k, v in key.items())


def _cut(text: str, limit: int) -> str:
    return text if len(text) <= limit else text[: limit - 4] + " ..."


def error_code(message: str) -> str:
    """The code of an error row's message, INTERNAL when it carries none (an error outside `make_compute`)."""
    head = message.removeprefix("PblError: ").split(":", 1)[0].strip()
    return head if head in CODES else "INTERNAL"


def error_next_step(message: str) -> str:
    """The next step an error row's message states, or how to report it. The last one: names stand before it, and the
    name of a file may hold a line that looks like one."""
    for line in reversed(message.splitlines()):
        if line.strip().startswith("next:"):
            return line.strip().removeprefix("next:").strip()
    return "report this with the error stack that `pbl status --json` prints"


def error_found(message: str) -> str:
    """What an error row's message found; the message itself when it is not a coded one."""
    for line in message.splitlines():
        if line.strip().startswith("found:"):
            return line.strip().removeprefix("found:").strip()
    return message.strip()


# ----------------------------------------------------------------------------------------------------- method rows
def method_columns(prefix: str) -> str:
    """Definition of a method table: one frozen paramset per row, `<name>-v<version>` as its readable short key."""
    return f"""
    {prefix}_method          : varchar(48)       # name and version, such as demo-v1
    ---
    {prefix}_method_name     : varchar(40)       # name without the version
    {prefix}_method_version  : int16             # counts up when parameters change
    {prefix}_params          : json              # every parameter
    {prefix}_method_sha      : char(16)          # hash over stage, name, version and parameters
    unique index ({prefix}_method_sha)
    """


def method_key(paramset: Paramset) -> str:
    """Short readable key of a paramset: `<name>-v<version>`."""
    return f"{paramset.name}-v{paramset.version}"


def insert_methods(table: Any, prefix: str, paramsets: Mapping[str, Paramset]) -> None:
    """Insert the paramsets that the method table lacks. A row is never edited.

    Raises
    ------
    PblError
        FILE_FORMAT when code holds other parameters under a name and version that the table already knows.
    """
    for paramset in paramsets.values():
        row = {
            f"{prefix}_method": method_key(paramset),
            f"{prefix}_method_name": paramset.name,
            f"{prefix}_method_version": paramset.version,
            f"{prefix}_params": plain(paramset.params),
            f"{prefix}_method_sha": paramset.hash,
        }
        known = (table & {f"{prefix}_method": row[f"{prefix}_method"]}).proj(f"{prefix}_method_sha").to_dicts()
        if not known:
            table.insert1(row, skip_duplicates=True)
        elif known[0][f"{prefix}_method_sha"] != paramset.hash:
            raise PblError(
                "FILE_FORMAT",
                found=f"other parameters under the name {method_key(paramset)} than the database holds",
                expected="a method that never changes once it has a name and version",
                next_step="give the changed parameters a new version in PARAMSETS",
                key=table.full_table_name,
            )


def resolve_method(table: Any, prefix: str, name: str) -> str:
    """Key of a method named by key (`demo-v1`) or by name (`demo`: its newest version). Raises SOLVER_UNKNOWN."""
    # Of one version the shorter key first: a migration may have put an old row aside as `demo-v1-<hash>`.
    rows = table.proj(f"{prefix}_method_name", f"{prefix}_method_version").to_dicts(
        order_by=[f"{prefix}_method_version DESC", f"{prefix}_method"]
    )
    for row in rows:
        if name in (row[f"{prefix}_method"], row[f"{prefix}_method_name"]):
            return row[f"{prefix}_method"]
    raise PblError(
        "SOLVER_UNKNOWN",
        found=f"no {prefix} method {name!r}",
        expected="one of " + ", ".join(sorted({r[f"{prefix}_method_name"] for r in rows})),
        next_step="choose one of the names above",
    )


def method_of_model(table: Any, prefix: str, found: Paramset) -> str:
    """Key of the method of a registered model, which becomes one when it is first asked for. Other parameters (another
    graph or `model.json`) under the same name are its next version."""
    rows = (table & {f"{prefix}_method_name": found.name}).to_dicts(order_by=f"{prefix}_method_version")
    versions = [row[f"{prefix}_method_version"] for row in rows]
    for version in versions:
        known = dataclasses.replace(found, version=version)
        if table & {f"{prefix}_method_sha": known.hash}:
            return method_key(known)
    new = dataclasses.replace(found, version=max(versions, default=0) + 1)
    insert_methods(table, prefix, {new.name: new})
    return method_key(new)


def method_arguments(table: Any, prefix: str, stage: str, method: str) -> dict[str, Any]:
    """A method row as the arguments of `rebuild_params`: what `make_fetch` hands on."""
    row = (table & {f"{prefix}_method": method}).fetch1()
    return {
        "stage": stage,
        "name": row[f"{prefix}_method_name"],
        "version": row[f"{prefix}_method_version"],
        "params": row[f"{prefix}_params"],
        "sha": row[f"{prefix}_method_sha"],
    }


def stored_paramset(method: Mapping[str, Any]) -> Paramset:
    """The `Paramset` of a method row (`method_arguments`), checked against its hash. Raises SOLVER_UNKNOWN."""
    paramset = Paramset(method["stage"], method["name"], method["version"], method["params"])
    if paramset.hash != method["sha"]:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"method {method_key(paramset)} with hash {method['sha']}, whose parameters hash to {paramset.hash}",
            expected="a method row that nobody edited",
            next_step="restore the method table from the backup",
        )
    return paramset


def rebuild_params(cls: type[P], params: Mapping[str, Any], stage: str, name: str, version: int, sha: str) -> P:
    """The parameter dataclass of a method row, checked against the row's hash.

    Raises
    ------
    PblError
        SOLVER_UNKNOWN when this version of the code no longer has these parameters.
    """
    try:
        value = Paramset(stage, name, version, params).to(cls)
        same = Paramset.of(stage, name, version, value).hash == sha
    except (TypeError, KeyError):
        same, value = False, None
    if not same or value is None:
        raise PblError(
            "SOLVER_UNKNOWN",
            found=f"method {name}-v{version} with hash {sha}, whose parameters this code does not understand",
            expected=f"parameters of {cls.__name__} of pbl-pipeline {__version__}",
            next_step="use the version of pbl-pipeline that wrote the method, or select a newer method",
        )
    return value


def plain(value: Any) -> Any:
    """Mappings and tuples as dicts and lists of plain numbers: what a json column takes."""
    if isinstance(value, Mapping):
        return {str(k): plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, np.generic):
        return value.item()
    return value


# ---------------------------------------------------------------------------------------------------- job tables
_jobs: dict[Any, Any] = {}


def jobs_of(table: Any) -> Any:
    """The job table of a computed table (class), made once: DataJoint reads every foreign key of the server for it."""
    if table not in _jobs:
        _jobs[table] = table.jobs
    return _jobs[table]


# ------------------------------------------------------------------------------------------------- files of a row
@contextmanager
def new_folder() -> Iterator[Path]:
    """A folder for a file that is about to enter the object store; gone afterwards."""
    with tempfile.TemporaryDirectory(prefix="pbl-") as folder:
        yield Path(folder)


@contextmanager
def stored_file(table: Any, ref: Mapping[str, Any]) -> Iterator[Path]:
    """Path to read an object of the store, from the dict that `file_ref` took from a row. Touches no database.

    A store in a folder gives the file itself; a remote one a copy that is removed afterwards.
    """
    backend = get_store_backend(ref.get("store"), config=table.connection._config)
    if backend.protocol == "file":
        path = Path(backend._full_path(ref["path"]))
        if not path.is_file():
            raise _lost(ref)
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="pbl-") as folder:
        path = Path(folder) / Path(ref["path"]).name
        if not backend.exists(ref["path"]):
            raise _lost(ref)
        backend.get_file(ref["path"], path)
        yield path


def file_ref(value: Any) -> dict[str, Any]:
    """A fetched `<object@...>` value as a small dict: what `make_fetch` may hand on (its fetch is hashed twice)."""
    return {"path": value.path, "store": value.store, "size": value.size}


def _lost(ref: Mapping[str, Any]) -> PblError:
    return PblError(
        "FILE_FORMAT",
        found=f"the object store has no {ref['path']}",
        expected="every file that a row of the database names",
        next_step="restore the object store from the backup, or delete the row so that it is computed again",
    )


# ---------------------------------------------------------------------------------------------- what is out of date
def delete_below(table: Any, keys: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Delete the rows with these keys and all that was computed from them, in one transaction.

    Returns table name to number of deleted rows, empty when there was nothing.
    """
    if not keys:
        return {}
    # As plain keys: a cascade from a restriction by subqueries fails in DataJoint 2.3.5 ("attribute not found").
    target = table & list(keys)
    counts = {name: n for name, n in dj.Diagram.cascade(target, part_integrity="cascade").counts().items() if n}
    target.delete(prompt=False, part_integrity="cascade")
    return counts


def utc_now() -> datetime.datetime:
    """Now in UTC, whole seconds, without zone: what a datetime column takes."""
    return datetime.datetime.now(datetime.UTC).replace(tzinfo=None, microsecond=0)


def number(value: Any) -> float | None:
    """A float for a nullable column: None where the value is missing or not finite."""
    if value is None:
        return None
    value = float(value)
    return value if np.isfinite(value) else None
