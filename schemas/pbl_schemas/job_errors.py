"""Coded errors in the error rows of jobs: what is written there, and what is read back."""

from __future__ import annotations

import errno
import json
import re
from collections.abc import Iterable, Mapping
from typing import Any

import pymysql

from pbl_pipeline.errors import CODERS, CODES, PblError, causes, said, said_of
from pbl_pipeline.names import shortened

from .datajoint_setup import AWAY, ERROR_MESSAGE_LENGTH, FULL, LIMIT_S, LONGER, REPEAT, TOO_LONG, LostConnectionError

#: Words of object stores for "full": MinIO, quotas.
_BUCKET_FULL = re.compile(r"StorageFull|QuotaExceeded|minimum free drive threshold")
#: A code at the beginning of a message, behind the name of the exception where DataJoint writes one.
_CODE = re.compile(r"(?:\w+: )?([A-Z_0-9]+):")
#: Longest parts that keep a coded error whole in a job's error_message, as DataJoint's own populate writes it.
_LIMITS = {"found": 600, "expected": 350, "next_step": 600, "key": 250}
_REPORT = "report this with the error stack that `pbl status --json` prints"


def fitted(error: PblError, key: Mapping[str, Any]) -> PblError:
    """Return the same error, cut to fit the job's error row, with the job's key where it has none."""
    about = error.key if error.key is not None else ", ".join(f"{k}={v}" for k, v in key.items())
    whole = {"found": error.found, "expected": error.expected, "next_step": error.next_step, "key": str(about)}
    return PblError(error.code, **{part: shortened(text, _LIMITS[part]) for part, text in whole.items()})


def store_full(error: BaseException) -> PblError | None:
    """STORE_FULL if an error says that the store has no room, or came from one that does."""
    for seen in causes(error):
        if getattr(seen, "errno", None) in (errno.ENOSPC, errno.EDQUOT) or _BUCKET_FULL.search(str(seen)):
            return PblError(
                "STORE_FULL",
                found=shortened(f"{type(seen).__name__}: {seen}", _LIMITS["found"]),
                expected="room for arrays and temporary files",
                next_step="free space, or give the store's disk or bucket more; jobs that met it go on by themselves",
            )
    return None


def of_server(error: Exception) -> PblError:
    """The coded error for what the driver or DataJoint raised of the database itself: DB_NOT_RUNNING only where it
    cannot be reached, else DB_REFUSED with the server's number and text."""
    first, text = (error.args[0], error.args[-1]) if error.args else (0, type(error).__name__)
    number = first if isinstance(first, int) else 0
    if isinstance(error, LostConnectionError) or number in AWAY:
        return PblError(
            "DB_NOT_RUNNING",
            found=said("the database went away while it was asked ({why})", why=text),
            expected="an answer",
            next_step="try again; if that fails: `pbl db status`, `pbl db start`",
        )
    steps = {
        REPEAT: "try again: another one held what this needed for too long",
        TOO_LONG: f"the server ends a query after {LIMIT_S} s: ask for less, such as one person (--subject)",
        LONGER: "write a shorter text for the column that is named above",
        FULL: "free space on the server's disk, or end its read-only mode; nothing was written",
    }
    return PblError(
        "DB_REFUSED",
        found=said("error {n} of the server: {why}", n=number, why=text),
        expected="a statement that the server executes; nothing was written",
        next_step=next((step for numbers, step in steps.items() if number in numbers), "report it with the whole text"),
    )


def of_database(error: BaseException) -> PblError | None:
    """The coded error for one that the driver or DataJoint raised, or that came from such a one; else None."""
    found = (e for e in causes(error) if isinstance(e, (pymysql.err.Error, LostConnectionError)))
    return next((of_server(e) for e in found if isinstance(e, Exception)), None)


CODERS.append(of_database)


def internal(error: BaseException, table: str, key: Mapping[str, Any]) -> PblError:
    """INTERNAL for an error without a code (STORE_FULL if the store is full): a table never shows a bare traceback
    as its message."""
    if (full := store_full(error)) is not None:
        return fitted(full, key)
    about = f"{table} " + ", ".join(f"{k}={v}" for k, v in key.items())
    return fitted(
        PblError("INTERNAL", f"{type(error).__name__}: {error}", "a result or a coded error", _REPORT, about), key
    )


def of_job(error: BaseException, table: str, key: Mapping[str, Any]) -> PblError:
    """Return the coded error of a job that failed, about its key where it names nothing itself."""
    return fitted(error, key) if isinstance(error, PblError) else internal(error, table, key)


def error_message(error: BaseException, table: str, key: Mapping[str, Any]) -> str:
    """Return the message of an error row: a code, always, and the parts of the error as JSON."""
    return as_text(of_job(error, table, key), ERROR_MESSAGE_LENGTH)


def as_text(error: PblError, longest: int) -> str:
    """Return an error for a column of so many characters, which `stored_error` reads; the longest parts are cut."""
    data = error.data()
    while len(text := f"{error.code}: {json.dumps(data, ensure_ascii=False)}") > longest:
        part = max(data, key=lambda name: len(json.dumps(data[name], ensure_ascii=False)))
        if isinstance(data[part], dict):
            data[part] = str(said_of(data[part]))
        else:
            data[part] = shortened(data[part], int(0.9 * len(data[part])))
    return text


def error_code(message: str) -> str:
    """The code of an error row's message; INTERNAL when it carries none (DataJoint's own populate wrote it)."""
    found = _CODE.match(message)
    return found[1] if found and found[1] in CODES else "INTERNAL"


def stored_error(message: str) -> PblError:
    """Return the error that a row's message holds: as `as_text` writes it, or the text of one, as earlier versions and
    DataJoint's own populate write it. INTERNAL, the whole message as found, for one that is not coded."""
    code, start = error_code(message), _CODE.match(message)
    rest = message[start.end() :].strip() if start else ""
    try:
        data = json.loads(rest) if rest.startswith("{") else None
    except ValueError:
        data = None
    if isinstance(data, dict):  # also of a code that another package declares, which is not loaded here
        found, expected, next_step = (said_of(data.get(name, "")) for name in ("found", "expected", "next_step"))
        return PblError(code, found, expected, next_step, data.get("key"))
    lines = [line.strip() for line in message.splitlines()]
    of_one_line = rest if start and start[1] == code and len(lines) == 1 else message.strip()
    # The last next step: names stand before it, and the name of a file may hold a line that looks like one.
    next_step = _stated("next:", reversed(lines), _REPORT)
    return PblError(code, _stated("found:", lines, of_one_line), _stated("expected:", lines, ""), next_step)


def _stated(word: str, lines: Iterable[str], otherwise: str) -> str:
    return next((line.removeprefix(word).strip() for line in lines if line.startswith(word)), otherwise)
