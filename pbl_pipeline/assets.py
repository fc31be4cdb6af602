"""Model and demo files that are too large for the package: fetched once, checked, kept in the user's cache.

Each file travels inside a public package, which its registry's client downloads (`packages.py`): pinned version,
platform and SHA-256. Only the named files are taken out, and every use checks them against their own SHA-256.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import shutil
import subprocess
import threading
import tomllib
from collections.abc import Iterator
from pathlib import Path

from pbl_pipeline.temporary import new_folder

from . import npm_by_pip, progress, settings
from .errors import PblError
from .files import one_process, sha256_of
from .packages import CLIENTS, Package
from .shipped import shipped_text

#: Longest that a download may take (s); the largest package has 51 MB.
_TIMEOUT_S = 1200.0


@dataclasses.dataclass(frozen=True)
class Asset:
    """One file of a package, with its licence and where it comes from.

    `optional`: neither the default methods nor the demo need it. `file`: the name it is kept under; empty: its own.
    """

    name: str
    what: str
    package: Package
    member: str
    sha256: str
    size_bytes: int
    licence: str
    source: str
    optional: bool = False
    file: str = ""

    @property
    def path(self) -> Path:
        """Path of the file on this machine, present or not."""
        return folder() / (self.file or Path(self.member).name)


def _listed() -> dict[str, Asset]:
    content = tomllib.loads(shipped_text("assets.toml"))
    packages: dict[str, Package] = {}
    for name, given in content["packages"].items():
        if "pip_options" in given:
            given["pip_options"] = tuple(given["pip_options"])
        packages[name] = CLIENTS[given.pop("client")](**given)
    assets = [Asset(**{**given, "package": packages[given["package"]]}) for given in content["assets"]]
    return {asset.name: asset for asset in assets}


#: Every asset by name, optional ones included (`needed`); they stand in assets.toml.
ASSETS = _listed()


def needed() -> list[str]:
    """Names of the assets that the default methods and the demo use."""
    return [name for name, asset in ASSETS.items() if not asset.optional]


def folder() -> Path:
    """Folder of the assets: `assets` in the user's cache folder (PBL_CACHE), created when absent.

    Raises `PblError` ASSET_MISSING: the folder cannot be made.
    """
    try:
        path = settings.cache_dir() / "assets"
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(f"the cache folder cannot be written ({error})") from error
    return path


def fetch(name: str) -> Path:
    """The checked file of an asset, fetched on first use (and again when its bytes have changed).

    Several processes may ask at once. A package that lies in `folder()` under its own name is used without network.

    Raises
    ------
    PblError
        ASSET_MISSING: it is not here and cannot be fetched (PBL_OFFLINE, no network, no pip or npm, no space).
        ASSET_CHECKSUM: the file that was downloaded, or placed in the folder, is not the pinned one.
    KeyError
        No asset has that name.
    """
    asset = ASSETS[name]
    if _is_pinned(asset.path, asset.sha256):
        return asset.path
    try:
        # Others wait. Without file locks each process fetches, which is slower but as safe.
        with one_process(folder() / ".lock"):
            if not _is_pinned(asset.path, asset.sha256):  # another process may have fetched it meanwhile
                _bring(asset)
    except OSError as error:
        raise _unwritable(f"the cache folder cannot be written ({error})") from error
    return asset.path


def status() -> dict[str, str]:
    """State of every asset on this machine by name: "ok", "missing" or "changed" (other bytes than pinned); fetches
    nothing."""
    found = {}
    for name, asset in ASSETS.items():
        found[name] = "missing"
        if asset.path.is_file():
            found[name] = "ok" if _is_pinned(asset.path, asset.sha256) else "changed"
    return found


def _bring(asset: Asset) -> None:
    package, here = asset.package, folder() / asset.package.filename
    if here.is_file():
        _check_package(here, package, f"delete {here}, or replace it by the file that this makes: {package.remedy()}")
        _extract(here, package)
        return
    if settings.offline():
        state = "other bytes than pinned, and" if asset.path.is_file() else "not on this machine, and"
        raise _missing(asset, f"{asset.path} is {state} PBL_OFFLINE forbids fetching")
    with new_folder(folder()) as temporary:
        path = _download(asset, temporary)
        again = "try again; if it stays so, the registry or mirror in use does not serve the public file"
        _check_package(path, package, again)
        _extract(path, package)


def _download(asset: Asset, into: Path) -> Path:
    package = asset.package
    if absent := package.absent():
        raise _missing(asset, absent)
    # The client has the file twice for a moment.
    needed = 2 * package.size_bytes + sum(a.size_bytes for a in ASSETS.values() if a.package is package)
    needed += npm_by_pip.SIZE_BYTES if npm_by_pip.__name__ in package.command(into) else 0
    if (free := shutil.disk_usage(into).free) < needed:
        raise _unwritable(f"{free / 1e6:.0f} MB are free in {folder()}, {package.requirement} needs {needed / 1e6:.0f}")
    # The client collects the download in a temporary folder: placed here, its growth is the progress.
    scratch = into / "scratch"
    scratch.mkdir()
    with _watch(into, f"fetching {package.requirement}", package.size_bytes):
        try:
            done = subprocess.run(
                package.command(into),
                env=os.environ | package.environment(scratch),
                stdin=subprocess.DEVNULL,
                capture_output=True,
                text=True,
                timeout=_TIMEOUT_S,
                check=False,
            )
        except subprocess.TimeoutExpired as error:
            raise _missing(asset, f"no answer from the package registry within {_TIMEOUT_S:.0f} s") from error
    path = into / package.filename
    if done.returncode != 0 or not path.is_file():
        raise _missing(asset, f"{package.requirement} could not be downloaded: {package.reason(done)}")
    return path


def _extract(path: Path, package: Package) -> None:
    """Take all assets of a checked package out of it; each appears complete or not at all."""
    for asset in ASSETS.values():
        if asset.package is not package or _is_pinned(asset.path, asset.sha256):
            continue
        data = package.read(path, asset.member)
        found = hashlib.sha256(data).hexdigest()
        if found != asset.sha256:
            raise _checksum(f"{asset.member} in {path.name}", found, asset.sha256, "report this: the pins disagree")
        with new_folder(asset.path.parent) as temporary:
            part = temporary / asset.path.name
            part.write_bytes(data)
            part.chmod(0o644)  # readable for the account a worker runs under
            part.replace(asset.path)


def _check_package(path: Path, package: Package, next_step: str) -> None:
    found = sha256_of(path)
    if found != package.sha256:
        raise _checksum(package.filename, found, package.sha256, next_step)


def _is_pinned(path: Path, sha256: str) -> bool:
    if not path.is_file():
        return False
    state = path.stat()
    return _sha256_of_state(path, state.st_ino, state.st_size, state.st_mtime_ns) == sha256


@functools.lru_cache(64)
def _sha256_of_state(path: Path, *_state: int) -> str:
    """Return the hash of a file in this state: of a network it takes 50 ms, and each video asks."""
    return sha256_of(path)


def _missing(asset: Asset, found: str) -> PblError:
    return PblError(
        "ASSET_MISSING",
        found=found,
        expected=f"{asset.what}, from the {asset.package.kind} {asset.package.requirement} ({asset.licence})",
        next_step=f"with network, run this again; without, run `{asset.package.remedy()}` on a machine that has it and "
        f"copy {asset.package.filename} into {folder()} (or set PBL_CACHE to a folder whose assets/ holds the files)",
        key=asset.name,
    )


def _unwritable(found: str) -> PblError:
    return PblError(
        "ASSET_MISSING",
        found=found,
        expected="a folder for model and demo files with 450 MB free",
        next_step="set PBL_CACHE to a folder of your own with free space",
    )


def _checksum(what: str, found: str, expected: str, next_step: str) -> PblError:
    return PblError(
        "ASSET_CHECKSUM", found=f"SHA-256 {found}", expected=f"SHA-256 {expected}", next_step=next_step, key=what
    )


@contextlib.contextmanager
def _watch(path: Path, label: str, size_bytes: int) -> Iterator[None]:
    """Draw how many bytes of `size_bytes` have come into a folder."""
    over = threading.Event()
    with progress.bar(label, total=round(size_bytes / 1e6), unit="MB") as update:

        def look() -> None:
            drawn = 0
            while not over.wait(0.3):
                with contextlib.suppress(OSError):  # the client removes its own files and folders meanwhile
                    largest = max((file.stat().st_size for file in path.rglob("*")), default=0)
                    come = min(round(largest / 1e6), round(size_bytes / 1e6))
                    update(max(come - drawn, 0))
                    drawn = max(come, drawn)

        watcher = threading.Thread(target=look, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()
