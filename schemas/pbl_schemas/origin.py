"""Origin of a result row: version, method, model, host, duration, time."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import platform
import time
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVarTuple, cast

from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError

from .job_errors import fitted, internal
from .rows import utc_now

Arguments = ParamSpec("Arguments")
Results = TypeVarTuple("Results")


def origin_columns(prefix: str) -> str:
    """Return the definition lines for the origin of a result row.

    The names carry the table's prefix, because DataJoint refuses joins of tables that share a secondary attribute.
    """
    return f"""
    {prefix}_code_version      : varchar(64)     # version and commit of pbl-pipeline that computed the row
    {prefix}_method_hash=null  : char(16)        # hash of the frozen parameters, null where the stage has none
    {prefix}_model_sha256=null : char(64)        # SHA-256 of the model file, null where the stage has none
    {prefix}_host              : varchar(64)     # computer
    {prefix}_seconds           : float64         # (s) duration of the computation
    {prefix}_computed          : datetime        # when it ended, UTC
    index ({prefix}_computed)
    """


@dataclasses.dataclass(frozen=True)
class Origin:
    """Version, host, duration and end of one computation. ended: by `time.monotonic`."""

    code_version: str
    host: str
    seconds: float
    ended: float

    @classmethod
    def now(cls, seconds: float) -> Origin:
        """Return the origin of a computation that ended here and now after `seconds`."""
        return cls(code_version(), platform.node()[:64], round(seconds, 3), time.monotonic())

    def row(self, prefix: str, *, method_hash: str | None = None, model_sha256: str | None = None) -> dict[str, Any]:
        """Values of `origin_columns(prefix)`, the time by the server's clock."""
        computed = utc_now() - datetime.timedelta(seconds=round(time.monotonic() - self.ended))
        return {
            f"{prefix}_code_version": self.code_version,
            f"{prefix}_method_hash": method_hash,
            f"{prefix}_model_sha256": model_sha256,
            f"{prefix}_host": self.host,
            f"{prefix}_seconds": self.seconds,
            f"{prefix}_computed": computed,
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
            raise fitted(error, key) from error
        except Exception as error:
            raise internal(error, type(table).__name__, key) from error
        return (*result, Origin.now(time.monotonic() - start))

    return wrapper
