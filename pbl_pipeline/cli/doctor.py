"""`pbl doctor`: check of the installation and its devices, with next steps for missing parts."""

from __future__ import annotations

import ctypes.util
import dataclasses
import os
import platform
import re
import shutil
import socket
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from typing import TYPE_CHECKING

import click

from pbl_pipeline import assets, settings
from pbl_pipeline.code_version import code_version
from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import cores
from pbl_pipeline.temporary import new_folder

if TYPE_CHECKING:
    from pbl_pipeline.visit import Visit

OK, NOTE, MISSING, WRONG = "ok", "note", "missing", "wrong"
#: What the default methods measure in the demo recording, and how far another machine may be off.
REFERENCE = {"index": 97.93, "double support": 21.99, "cadence": 97.87}
MOST_OFF = 0.05

#: Free space (GB) below which a session of videos will not fit.
_MIN_FREE_GB = 2.0
#: How long a database server may take to greet (s).
_ANSWER_S = 4.0
#: Folders where distributions install the server, which is often not on a user's PATH.
_SERVER_PLACES = ("/usr/sbin", "/usr/local/sbin", "/usr/libexec", "/opt/homebrew/bin", "/usr/local/bin")


@dataclasses.dataclass(frozen=True)
class Finding:
    """One line of the table."""

    what: str
    state: str  # "ok", "note" (works, but read it), "missing" or "wrong" (with a next step)
    detail: str
    next_step: str = ""


@click.command()
@click.option("--fetch", is_flag=True, help="First fetch the model and demo files that are missing.")
@click.option("--self-check", is_flag=True, help="Then measure the demo recording and compare the results with those "
              "of other machines (a minute).")  # fmt: skip
def doctor(fetch: bool, self_check: bool) -> None:
    """Show what is installed, which device is used, and how to get missing parts.

    Exits with code 0 if everything that the default chain needs is there, else 1. Changes nothing without --fetch.

    Example: pbl doctor --fetch
    """
    failed = _fetch_missing() if fetch else {}
    found = examine(failed)
    _print(found)
    missing = [f for f in found if f.state == MISSING]
    summary = f"{len(missing)} missing: {', '.join(f.what for f in missing)}" if missing else "Nothing is missing."
    click.echo(f"\n{summary}")
    if self_check and not missing:
        measured = _self_check()
        _print([measured])
        missing = [measured] if measured.state == WRONG else []
    sys.exit(1 if missing else 0)


def examine(fetch_errors: dict[str, PblError] | None = None) -> list[Finding]:
    """Collect all findings, in the order of printing. `fetch_errors`: asset -> why it could not be fetched just now."""
    return [
        *(_python(), *_packages()),
        _loads("JAX device", _jax_device, "pip install --upgrade jax jaxlib"),
        _loads("MuJoCo", _mujoco, "pip install --force-reinstall --no-deps mujoco mujoco-core mujoco-studio"),
        _loads("compile cache", _jax_cache, "pip install --upgrade jax mujoco-mjx"),
        _loads("LiteRT", _litert, "pip install ai-edge-litert"),
        _loads("ONNX runtime", _onnx, "pip install onnxruntime, or correct PBL_ONNX_DEVICE"),
        _loads("video codecs", _codecs, "pip install av"),
        *(_database(), *_assets(fetch_errors or {}), *_models()),
        _folder("cache folder", settings.cache_dir, "PBL_CACHE"),
        _folder("home folder", settings.home_dir, "PBL_HOME"),
    ]


def _print(found: list[Finding]) -> None:
    colours = {OK: "green", NOTE: "yellow", MISSING: "red", WRONG: "red"}
    width = max(len(f.what) for f in found)
    for f in found:
        click.echo(f"{f.what:<{width}}  {click.style(f'{f.state:<7}', fg=colours[f.state])}  {f.detail}")
        if f.next_step:
            click.echo(f"{'':<{width}}           next: {f.next_step}")


def _digits(visit: Visit) -> dict[str, float]:
    """Return what `REFERENCE` holds, of a visit; NaN for what is not known."""
    assert visit.measures is not None
    found = {"index": visit.measures.gdi.mean}
    for what, name in (("double support", "double_support_percent"), ("cadence", "cadence_steps_per_min")):
        measure = visit.measures.spatiotemporal.measures[name]
        found[what] = None if measure is None else measure.mean
    return {what: float("nan") if value is None else float(value) for what, value in found.items()}


def _self_check() -> Finding:
    """Measure the demo recording from the file to the index. Raises the `PblError`s of `run_visit`."""
    from pbl_pipeline.pipeline import run_visit

    with new_folder() as folder:
        visit, _ = run_visit([assets.fetch("demo_video")], folder, assets.fetch("demo_camera"))
    found = _digits(visit)
    detail = ", ".join(f"{what} {value:.2f} (elsewhere {REFERENCE[what]:.2f})" for what, value in found.items())
    if all(abs(value - REFERENCE[what]) <= MOST_OFF for what, value in found.items()):
        return Finding("self-check", OK, detail)
    advice = (
        "do not measure with it; PBL_ONNX_DEVICE=cpu JAX_PLATFORMS=cpu tells if a GPU is at fault; report the table"
    )
    return Finding("self-check", WRONG, detail, advice)


def _fetch_missing() -> dict[str, PblError]:
    failed: dict[str, PblError] = {}
    for name in assets.ASSETS:
        try:
            assets.fetch(name)
        except PblError as error:
            failed[name] = error
    return failed


# --- what is installed


def _python() -> Finding:
    what = f"{platform.python_version()} on {platform.system()} {platform.machine()}, {cores()} cores"
    return Finding("Python", OK, f"{what}; pbl-pipeline {code_version()}")


def _packages() -> Iterator[Finding]:
    """Find the packages that pyproject.toml requires, without the extras."""
    try:
        lines = requires("pbl-pipeline") or []
    except PackageNotFoundError:
        yield Finding("packages", MISSING, "pbl-pipeline itself is not installed", "pip install -e . in its folder")
        return
    there, absent = [], []
    for line in lines:
        name = re.match(r"[A-Za-z0-9._-]+", line)
        if name is None or "extra ==" in line:
            continue
        try:
            there.append(f"{name[0]} {version(name[0])}")
        except PackageNotFoundError:
            absent.append(line.split(";")[0].strip())
    for start in range(0, len(there), 5):
        yield Finding("packages" if start == 0 else "", OK, ", ".join(there[start : start + 5]))
    if absent:
        yield Finding("packages", MISSING, ", ".join(absent), f"pip install {' '.join(repr(a) for a in absent)}")


def _loads(what: str, check: Callable[[], Finding], next_step: str) -> Finding:
    """Return `check()`, or a finding for the error that a broken or missing installation raises."""
    try:
        return check()
    except (ImportError, OSError, RuntimeError, ValueError, PblError) as error:
        return Finding(what, MISSING, f"{type(error).__name__}: {error}".splitlines()[0], next_step)


def _jax_device() -> Finding:
    import jax

    devices = jax.devices()
    detail = f"{devices[0].platform}: {', '.join(sorted({d.device_kind for d in devices}))} ({len(devices)})"
    if devices[0].platform == "cpu" and (shutil.which("nvidia-smi") or ctypes.util.find_library("cuda")):
        return Finding("JAX device", NOTE, f"{detail}; an NVIDIA GPU is not used", "pip install 'pbl-pipeline[gpu]'")
    return Finding("JAX device", OK, detail)


def _mujoco() -> Finding:
    """Load it: an upgrade from version 3 with pip leaves parts of both, and nothing that pip checks."""
    import mujoco

    return Finding("MuJoCo", OK, mujoco.__version__)


def _jax_cache() -> Finding:
    import jax

    from pbl_pipeline import jax_setup

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # its warning is the finding below
        jax_setup.configure()
    jax_setup.import_mjx()
    folder = getattr(jax.config, "jax_compilation_cache_dir", None)
    if not folder:
        return Finding("compile cache", NOTE, "off: every start compiles anew", "make PBL_CACHE a writable folder")
    files = list(Path(folder).glob("*")) if Path(folder).is_dir() else []
    megabytes = sum(f.stat().st_size for f in files if f.is_file()) / 1e6
    return Finding("compile cache", OK, f"on: {folder} ({len(files)} files, {megabytes:.1f} MB)")


def _litert() -> Finding:
    from ai_edge_litert.interpreter import Interpreter

    detail = f"ai-edge-litert {version('ai-edge-litert')}"
    try:
        detector = assets.ASSETS["blazepose_detector"].path
    except PblError:  # no cache folder, which is another finding
        detector = None
    if detector is None or not detector.is_file():
        return Finding("LiteRT", OK, f"{detail}; not tried, no model here yet")
    model = Interpreter(model_path=str(detector), num_threads=1)
    model.allocate_tensors()
    shape = model.get_input_details()[0]["shape"].tolist()
    return Finding("LiteRT", OK, f"{detail}; loads the person detector, input {shape}")


def _onnx() -> Finding:
    """Check the execution providers of ONNX models, and which of them will be used."""
    import onnxruntime

    from pbl_pipeline import models

    there = models.available_devices()
    detail = f"{onnxruntime.__version__}: {', '.join(there)}"
    asked = models.asked_device()
    try:
        models.providers_for(asked)
    except PblError as error:
        return Finding("ONNX runtime", MISSING, f"{detail}; {asked} is requested", error.next_step)
    if "cuda" in there:
        return Finding("ONNX runtime", OK, f"{detail}; {asked}: `pbl models verify` checks that CUDA starts")
    if shutil.which("nvidia-smi") and asked != "cpu":
        remedy = "pip uninstall onnxruntime && pip install onnxruntime-gpu"
        return Finding("ONNX runtime", NOTE, f"{detail}; an NVIDIA GPU is not used, models run on the CPU", remedy)
    return Finding("ONNX runtime", OK, f"{detail}; models run on the CPU")


def _models() -> Iterator[Finding]:
    from pbl_pipeline import models

    for model in models.registered():
        if model.spec is None:
            assert model.error is not None
            found = f"{model.error.code}: {model.error.found}"
            yield Finding(f"model {model.name}", NOTE, found, model.error.next_step)
        else:
            yield Finding(f"model {model.name}", OK, f"{model.folder} ({model.spec.licence})")


def _codecs() -> Finding:
    import av
    from av.codec.codec import Codec, UnknownCodecError

    lacking = []
    for name in ("h264", "hevc", "vp9", "libx264"):
        try:
            Codec(name, "w" if name == "libx264" else "r")
        except UnknownCodecError:
            lacking.append(name)
    detail = f"PyAV {av.__version__}, libavcodec {'.'.join(map(str, av.library_versions['libavcodec']))}"
    if lacking:
        remedy = "pip install --force-reinstall --only-binary=av av"
        return Finding("video codecs", MISSING, f"{detail} lacks {', '.join(lacking)}", remedy)
    return Finding("video codecs", OK, f"{detail}: reads H.264, HEVC, VP9; writes H.264")


# --- what lies around it


def _database() -> Finding:
    """Check for a server program, or the server in DJ_HOST, without the tables: the library does not import them."""
    if os.environ.get("DJ_HOST"):
        return _server(os.environ["DJ_HOST"])
    unpacked = settings.home_dir() / "server" / "usr" / "sbin"
    places = os.pathsep.join([os.environ.get("PATH", os.defpath), *_SERVER_PLACES, str(unpacked)])
    server = shutil.which("mariadbd", path=places)
    if server:
        return Finding("database", OK, f"{server} (embedded; `pbl db status` shows whether it runs)")
    other = shutil.which("mysqld", path=places)
    found = f"{other} is MySQL, the embedded server is MariaDB" if other else "no MariaDB server program"
    return Finding(
        "database",
        MISSING,
        f"{found} (`pbl run`, `detect`, `fit`, `events` and `gait` work without)",
        "`pbl db init` installs it (apt), or set DJ_HOST to a running server",
    )


def _server(address: str) -> Finding:
    """Check that a database server greets at HOST or HOST:PORT; it ends the connection itself, without a login."""
    host, _, port = address.partition(":")
    try:
        with socket.create_connection((host, int(port or os.environ.get("DJ_PORT") or 3306)), _ANSWER_S) as server:
            server.settimeout(_ANSWER_S)
            greeting = server.recv(200)
    except (OSError, ValueError) as error:
        advice = "start the server, or correct DJ_HOST and DJ_PORT"
        return Finding("database", MISSING, f"DJ_HOST is {address}, which does not answer: {error}", advice)
    if greeting[4:5] != b"\n":  # the version of the protocol, 10; 255: a refusal with its reason
        text = greeting[7:].decode("utf-8", "replace") if greeting[4:5] == b"\xff" else "another program"
        advice = "correct DJ_HOST and DJ_PORT, or ask the server's administrator"
        return Finding("database", MISSING, f"DJ_HOST is {address}, which is no database server for us: {text}", advice)
    version = greeting[5:].split(b"\0")[0].decode("ascii", "replace")
    return Finding("database", OK, f"DJ_HOST is {address}, which answers ({version}); `pbl db status` tries the login")


def _assets(errors: dict[str, PblError]) -> Iterator[Finding]:
    try:
        states = assets.status()
    except PblError as error:
        yield Finding("assets", MISSING, error.found, error.next_step)
        return
    for name, found in states.items():
        asset = assets.ASSETS[name]
        state = NOTE if asset.optional else MISSING
        if found == "ok":
            yield Finding(name, OK, f"{asset.path} ({asset.licence})")
        elif (error := errors.get(name)) is not None:
            yield Finding(name, state, error.found, error.next_step)
        else:
            changed = f"{asset.path} has other bytes than pinned"
            detail = changed if found == "changed" else f"{asset.what}: not fetched yet"
            detail += ", not needed by the default methods" if asset.optional else ""
            size = asset.package.size_bytes / 1e6
            yield Finding(name, state, detail, f"`pbl doctor --fetch` ({size:.0f} MB from the package registry)")


def _folder(what: str, where: Callable[[], Path], variable: str) -> Finding:
    """Check that a folder is writable and has room. The home folder may not exist yet: then its parent is checked."""
    try:
        path = where()
        there = path
        while not there.exists():
            there = there.parent
        with tempfile.TemporaryFile(dir=there):
            pass
        free_gb = shutil.disk_usage(there).free / 1e9
    except OSError as error:
        return Finding(what, MISSING, f"cannot be written: {error}", f"set {variable} to one of your folders")
    later = "" if path.exists() else ", made on first use"
    detail = f"{path} (writable{later}, {free_gb:.0f} GB free)"
    if free_gb < _MIN_FREE_GB:
        return Finding(what, NOTE, detail, f"free some space, or set {variable} to a folder on a larger disk")
    return Finding(what, OK, detail)
