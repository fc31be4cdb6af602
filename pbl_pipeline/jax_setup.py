"""JAX and MJX as this project uses them: compiled programs kept on disk, single precision, no noise on import."""

from __future__ import annotations

import contextlib
import functools
import importlib.util
import io
import os
import sys
import threading
import warnings
from typing import Any

import jax
import jaxlib.version

from pbl_pipeline import settings

#: Programs that compile faster than this are not worth a file.
MIN_COMPILE_SECONDS = 0.3
#: Flags of XLA (see `configure`), and the releases of jaxlib on which they were run: a library ends the process at a
#: flag that it does not know, so other releases are given none.
GPU_FLAGS = ("--xla_gpu_autotune_level=0", "--xla_gpu_enable_triton_gemm=false")
GPU_RELEASES = ("0.10.2", "0.11.2", "0.12.0.1")
CPU_FLAGS = ("--xla_cpu_use_fusion_emitters=false",)
CPU_RELEASES = ("0.10.2",)  # 0.11.1 and later do not know it


@functools.cache
def configure() -> None:
    """Set JAX up for the fit and the networks of detection. Call before the first array; idempotent.

    Compiled programs are kept in `jax/` of the user's cache folder. JAX's own settings win: those of
    `JAX_COMPILATION_CACHE_DIR` and `JAX_PERSISTENT_CACHE_*`, those that a program made in `jax.config` before, and XLA
    flags that are set. Precision stays JAX's default, float32.
    """
    # JAX makes its options attributes at run time, which a type checker cannot see.
    if jax.config.jax_compilation_cache_dir is None:  # pyright: ignore[reportAttributeAccessIssue]
        try:
            folder = settings.cache_dir() / "jax"
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            # A cache only saves time: with a read-only home the work goes on, with a warning.
            warnings.warn(f"compiled programs are not kept, every start compiles anew: {error}", stacklevel=2)
        else:
            jax.config.update("jax_compilation_cache_dir", str(folder))
    _default("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    # -1 keeps small programs too; the limit is meant for file systems on which small files are slow.
    _default("jax_persistent_cache_min_entry_size_bytes", -1)
    # On a GPU, XLA tries many forms of each matrix product. Handed to NVIDIA's library instead, the many small products
    # here are as fast without any trial (H200, a batch of 64: 0.52 s and 6 s of compiling; tried: 0.52 s and 33 s;
    # neither: 0.98 s and 14 s). The networks have no convolutions (`models.tflite_jax`), which would need the trials.
    # On a CPU, XLA's newer compiler of fused operations takes longer, and its programs are not faster
    # (research/reports). Read when the first device is asked for.
    for flag in known_flags(jaxlib.version.__version__, importlib.util.find_spec("jax_plugins") is not None):
        given = os.environ.get("XLA_FLAGS", "")
        if flag.partition("=")[0] not in given:
            os.environ["XLA_FLAGS"] = f"{given} {flag}".strip()
    jax.monitoring.register_event_duration_secs_listener(_count_compilation)


def known_flags(release: str, gpu: bool) -> tuple[str, ...]:
    """Return the flags that were run on this release of jaxlib, with a plugin for GPUs or without one."""
    if gpu:
        return GPU_FLAGS if release in GPU_RELEASES else ()
    return CPU_FLAGS if release in CPU_RELEASES else ()


_COMPILED = {"seconds": 0.0}


def _count_compilation(event: str, duration_secs: float, **_: object) -> None:
    if event.startswith("/jax/core/compile/"):
        _COMPILED["seconds"] += duration_secs


def compile_seconds() -> float:
    """Seconds this process has spent so far on tracing programs and on compiling or loading them."""
    return _COMPILED["seconds"]


def _default(option: str, value: float) -> None:
    if option.upper() not in os.environ:
        jax.config.update(option, value)


_importing = threading.Lock()


def import_mjx() -> Any:
    """Return the module of MuJoCo's kinematics in JAX, imported where it is needed: by one solver.

    Without NVIDIA's optional warp it prints two lines on stdout, which would end up in the output of a command. Only
    those lines are dropped; everything else that is printed meanwhile is passed on.
    """
    with _importing:  # of two threads that redirect the output, the last one to end would restore the other's
        if "mujoco.mjx" in sys.modules:
            return sys.modules["mujoco.mjx"]
        printed = io.StringIO()
        try:
            with contextlib.redirect_stdout(printed):
                return importlib.import_module("mujoco.mjx")
        finally:
            for line in printed.getvalue().splitlines(keepends=True):
                if not _is_absent_warp(line):
                    sys.stdout.write(line)


def _is_absent_warp(line: str) -> bool:
    return line.startswith("Failed to import ") and line.rstrip().endswith("No module named 'warp'")
