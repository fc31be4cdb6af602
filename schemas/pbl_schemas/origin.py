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
from pbl_pipeline.records import column, definition, record, stored, to_row

from .job_errors import fitted, internal
from .rows import utc_now

Arguments = ParamSpec("Arguments")
Results = TypeVarTuple("Results")


def origin_columns(prefix: str) -> str:
    """Return the definition lines for the origin of a result row.

    The names carry the table's prefix, because DataJoint refuses joins of tables that share a secondary attribute.
    """
    return f"{definition(Origin, prefix)}\nindex ({prefix}_computed)"


@record(kw_only=True)
class Origin:
    """Version, method, model, host, duration and end of one computation. ended: by `time.monotonic`."""

    code_version: str = column(
        "{}_code_version", "version and commit of pbl-pipeline that computed the row", "varchar(64)"
    )
    method_hash: str | None = column(
        "{}_method_hash", "hash of the frozen parameters, null where the stage has none", "char(16)", default=None
    )
    model_sha256: str | None = column(
        "{}_model_sha256", "SHA-256 of the model file, null where the stage has none", "char(64)", default=None
    )
    host: str = column("{}_host", "computer", "varchar(64)", cut=True)
    seconds: float = column("{}_seconds", "(s) duration of the computation")
    ended: float

    @property
    @stored("{}_computed", "when it ended, UTC", "datetime")
    def computed(self) -> datetime.datetime:
        """Moment of the end by the server's clock."""
        return utc_now() - datetime.timedelta(seconds=round(time.monotonic() - self.ended))

    @classmethod
    def now(cls, seconds: float) -> Origin:
        """Return the origin of a computation that ended here and now after `seconds`."""
        about = {"code_version": code_version(), "host": platform.node()}
        return cls(**about, seconds=round(seconds, 3), ended=time.monotonic())

    def row(self, prefix: str, *, method_hash: str | None = None, model_sha256: str | None = None) -> dict[str, Any]:
        """Return the values of `origin_columns(prefix)`."""
        return to_row(dataclasses.replace(self, method_hash=method_hash, model_sha256=model_sha256), prefix)


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
