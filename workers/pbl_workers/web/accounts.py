"""Accounts of people who sign in with a password, where the page serves more than this machine.

Passwords are hashed with `hashlib.scrypt` of the standard library instead of argon2-cffi: both need memory for each
guess, and the latter would be an addition, since existing accounts need scrypt.

They are in a file of the machine that serves the page, readable by its account alone, and not in a table: a backup, a
slice, an analyst's account of the database never have them, and a database that was broken into opens no page.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import datetime
import functools
import hashlib
import hmac
import json
import os
import re
import secrets
import time
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

from pbl_pipeline import settings
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import one_process
from pbl_schemas.operations.folders import private_folder, write_json

from .access import RIGHTS
from .connections import customer

#: Cost of scrypt: 2^17 blocks of 8 x 128 byte, one after the other. A guess takes 128 MiB and some tenths of a second
#: (OWASP Password Storage Cheat Sheet). scrypt is the memory-hard hash of Python's own library.
LOG_N, R, P = 17, 8, 1
#: Fewest and most characters of a password (NIST SP 800-63B asks for 15 where it is the only factor).
SHORTEST, LONGEST = 15, 256
#: Passwords that are compared at a time (each takes 128 MiB). As many may wait for it as there are connections: a limit
#: of those would let a flood of wrong ones refuse the right one.
AT_ONCE = 2
_NAME = re.compile(r"[\w.@-][\w.@ -]{0,62}[\w.@-]|[\w.@-]")
#: A password as `hashed` stores it, with a cost of at most 2^19 blocks of memory.
_HASH = re.compile(rf"scrypt\$([1-9]|1\d)\${R}\${P}\$[\w+/]{{22}}==\$[\w+/]{{43}}=", re.ASCII)
_refused = functools.partial(PblError, "WEB_ACCOUNT")


@dataclasses.dataclass(frozen=True)
class Account:
    """A person who may sign in. changed: when password or roles were last, by which a session knows its end."""

    name: str
    roles: tuple[str, ...]
    password: str
    changed: str


class Accounts:
    """The accounts of a file (default: `web/accounts.json` in PBL_HOME), read again whenever it was changed."""

    def __init__(self, path: Path | None = None) -> None:
        self.path = path or settings.home_dir() / "web" / "accounts.json"
        self._read: tuple[Any, dict[str, Account]] = (None, {})

    def all(self) -> dict[str, Account]:
        """The accounts by name. Raises `PblError` WEB_ACCOUNT for a file that is damaged or that others may read."""
        try:
            about = self.path.stat()
        except FileNotFoundError:
            return {}
        stamp = (about.st_mtime_ns, about.st_size, about.st_ino, about.st_mode)
        if self._read[0] != stamp:
            if os.name == "posix" and about.st_mode & 0o077:
                mode = f"{self.path}: mode {about.st_mode & 0o777:o}"
                raise _refused(mode, "its account alone may read it", f"chmod 600 {self.path}")
            try:
                found = json.loads(self.path.read_text("utf-8"))["accounts"]
                known = {n: Account(n, tuple(a["roles"]), a["password"], a["changed"]) for n, a in found.items()}
                for one in known.values():
                    if not (
                        set(one.roles) <= set(RIGHTS) and _HASH.fullmatch(one.password) and one.changed.isprintable()
                    ):
                        raise ValueError("another content")
            except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
                raise _refused(
                    f"{self.path}: {type(error).__name__}",
                    "accounts as `pbl web account` writes them",
                    "restore the file, or remove it and add the accounts again",
                ) from error
            self._read = (stamp, known)
        return self._read[1]

    def add(self, name: str, roles: Sequence[str], password: str) -> None:
        """Add an account. Raises `PblError` WEB_ACCOUNT: an existing or invalid name, an unknown role, a weak
        password."""
        if not _NAME.fullmatch(name):
            raise _refused(
                f"the name {name!r}", "1 to 64 letters, digits, and . @ - _ or blanks within", "choose another"
            )
        if not roles or not set(roles) <= set(RIGHTS):
            raise _refused(
                f"roles {', '.join(roles) or 'none'}", f"some of {', '.join(RIGHTS)}", "name them with --role"
            )
        with self._changing() as known:
            if name in known:
                raise _refused(
                    f"an account {name!r}",
                    "a name without an account",
                    "`pbl web account password` changes its password",
                )
            known[name] = Account(name, tuple(dict.fromkeys(roles)), hashed(password), _now())

    def set_password(self, name: str, password: str) -> None:
        """Change a password; sessions of the account end. Raises `PblError` WEB_ACCOUNT as `add`."""
        with self._changing() as known:
            known[name] = dataclasses.replace(self._named(known, name), password=hashed(password), changed=_now())

    def remove(self, name: str) -> None:
        """Remove an account; its sessions end. Raises `PblError` WEB_ACCOUNT if there is none."""
        with self._changing() as known:
            del known[self._named(known, name).name]

    def check(self, name: str, password: str) -> Account | None:
        """Return the account if the password is right. Takes as long for an unknown name."""
        account = self.all().get(name)
        # A hash that no password has takes as long to compare.
        right = matches(password, _stored(b"0" * 16, b"0" * 16) if account is None else account.password)
        return account if right else None

    def current(self, name: str, changed: str) -> bool:
        """Return whether an account is unchanged since a session was opened; False if the file cannot be read."""
        try:
            account = self.all().get(name)
        except PblError:  # who signs in then is told
            return False
        return account is not None and account.changed == changed

    @contextlib.contextmanager
    def _changing(self) -> Iterator[dict[str, Account]]:
        private_folder(self.path.parent)
        with one_process(self.path.with_suffix(".lock")):
            known = dict(self.all())
            yield known
            rows = {a.name: {"roles": a.roles, "password": a.password, "changed": a.changed} for a in known.values()}
            write_json(self.path, {"accounts": rows})

    @staticmethod
    def _named(known: dict[str, Account], name: str) -> Account:
        if name not in known:
            raise _refused(f"no account {name!r}", "an existing account", "`pbl web account list` prints them")
        return known[name]


def hashed(password: str) -> str:
    """A salted hash of a password, with what it takes to compare another one with it. Raises `PblError` WEB_ACCOUNT for
    one that is too short or long. The password is in no error."""
    if not SHORTEST <= len(password) <= LONGEST:
        raise _refused(
            f"a password of {len(password)} characters",
            f"{SHORTEST} to {LONGEST}",
            "choose a longer one, such as five words",
        )
    salt = secrets.token_bytes(16)
    return _stored(salt, _key(password, salt, LOG_N))


def _stored(salt: bytes, key: bytes) -> str:
    return f"scrypt${LOG_N}${R}${P}${base64.b64encode(salt).decode()}${base64.b64encode(key).decode()}"


def matches(password: str, stored: str) -> bool:
    """Return whether a hash is that of a password."""
    _, log_n, _, _, salt, key = stored.split("$")
    found = _key(password[: 4 * LONGEST], base64.b64decode(salt), int(log_n))
    return hmac.compare_digest(found, base64.b64decode(key))


def _key(password: str, salt: bytes, log_n: int) -> bytes:
    # The same letters however a keyboard composes them.
    text = unicodedata.normalize("NFKC", password).encode("utf-8", "surrogatepass")
    return hashlib.scrypt(text, salt=salt, n=2**log_n, r=R, p=P, maxmem=256 * 2**log_n * R, dklen=32)


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat()


@dataclasses.dataclass
class _Failures:
    n: int
    last: float


class Attempts:
    """Slows down guessing: after some failures of an account or an address the next attempt has to wait, each time
    twice as long: an account for a minute at most, an address for a quarter of an hour. An hour without a failure
    clears them. The wait of an account holds for addresses that failed as often themselves: guesses from elsewhere do
    not lock its owner out.
    """

    #: By kind: failures that cost nothing, and the longest wait (s).
    LIMITS: ClassVar = {"account": (3, 60.0), "address": (12, 900.0)}
    #: Seconds after which failures are forgotten, and how many accounts and addresses are remembered.
    FORGOTTEN_S, MOST = 3600.0, 10_000

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._failures: dict[tuple[str, str], _Failures] = {}

    def wait_s(self, account: str, address: str) -> float:
        """Seconds until an attempt of an account from an address may be made; 0: now."""
        of_account, of_address = self._keys(account, address)
        found, now = self._failures.get(of_address), self._clock()
        guessed = found is not None and found.n >= self.LIMITS["account"][0] and now - found.last < self.FORGOTTEN_S
        return max(self._wait(of_address), self._wait(of_account) if guessed else 0.0)

    def failed(self, account: str, address: str) -> None:
        """Count a failure. An attempt counts as one before its password is compared: many at once gain no tries."""
        now = self._clock()
        for key in self._keys(account, address):
            found = self._failures.pop(key, None)
            n = found.n if found is not None and now - found.last < self.FORGOTTEN_S else 0
            self._failures[key] = _Failures(n + 1, now)
        while len(self._failures) > self.MOST:  # the longest ago first
            self._failures.pop(next(iter(self._failures)))

    def succeeded(self, account: str, address: str) -> None:
        """Forget the failures of the account, and the one that this attempt counted of the address: who has an account
        of her own gets no more guesses at others by it."""
        of_account, of_address = self._keys(account, address)
        self._failures.pop(of_account, None)
        if of_address in self._failures:
            self._failures[of_address].n -= 1

    def _wait(self, key: tuple[str, str]) -> float:
        found = self._failures.get(key)
        free, most = self.LIMITS[key[0]]
        if found is None or found.n < free:
            return 0.0
        after = min(2.0 ** min(found.n - free, 20), most)
        return max(0.0, found.last + after - self._clock())

    @staticmethod
    def _keys(account: str, address: str) -> tuple[tuple[str, str], tuple[str, str]]:
        with contextlib.suppress(ValueError):
            address = customer(address)
        return ("account", hashlib.sha256(account.encode(errors="replace")).hexdigest()), ("address", address)
