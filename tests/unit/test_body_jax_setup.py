"""Compiled programs are kept, other people's settings are honoured, and importing prints nothing."""

import os
import subprocess
import sys
from pathlib import Path

import jax
import jaxlib.version
import pytest

from pbl_pipeline import jax_setup

pytestmark = pytest.mark.slow

SHOW = (
    "import pbl_pipeline.body, jax\n"
    "from pbl_pipeline import jax_setup\n"
    "jax_setup.configure()\n"
    "jax_setup.import_mjx()\n"
    "c = jax.config\n"
    "print(c.jax_compilation_cache_dir, c.jax_persistent_cache_min_compile_time_secs,\n"
    "      c.jax_persistent_cache_min_entry_size_bytes, jax.numpy.zeros(1).dtype, sep='|')\n"
)


def _run(cache: Path, code: str = SHOW, **extra: str) -> str:
    env = {k: v for k, v in os.environ.items() if not k.startswith("JAX_")}
    env |= {"PBL_CACHE": str(cache), "JAX_PLATFORMS": "cpu", **extra}
    done = subprocess.run([sys.executable, "-c", code], env=env, capture_output=True, text=True, check=True)
    return done.stdout


def test_cache_is_in_the_users_cache_folder_and_import_is_quiet(tmp_path):
    assert _run(tmp_path) == f"{tmp_path / 'jax'}|0.3|-1|float32\n"


def test_the_environment_wins(tmp_path):
    theirs = tmp_path / "theirs"
    out = _run(tmp_path, JAX_COMPILATION_CACHE_DIR=str(theirs), JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="2")
    assert out == f"{theirs}|2.0|-1|float32\n"
    assert not (tmp_path / "jax").exists()


def test_a_compiled_program_is_written(tmp_path):
    code = (
        "from pbl_pipeline.body import *\nimport numpy as np\n"
        "body_poses(load_body(), np.zeros(40), np.ones(8))[0].block_until_ready()\n"
    )
    # However fast this machine compiles it.
    _run(tmp_path, code, JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS="0")
    assert any((tmp_path / "jax").iterdir())


def test_only_the_known_lines_are_dropped():
    assert jax_setup._is_absent_warp("Failed to import warp: No module named 'warp'\n")
    assert jax_setup._is_absent_warp("Failed to import mujoco_warp: No module named 'warp'\n")
    assert not jax_setup._is_absent_warp("Failed to import warp: libcuda.so.1 not found\n")


def test_load_body_may_be_called_first_inside_a_trace():
    from pbl_pipeline.body import model

    def height(x):
        return x + model.load_body.__wrapped__().mjx_model_and_data[0].body_pos[1, 2]

    assert jax.jit(height)(0.0) == jax.numpy.float32(0.975)


@pytest.mark.parametrize("gpu", [False, True])
def test_the_installed_library_knows_its_flags(gpu: bool):
    """A library ends the process at a flag that it does not know. Those of GPUs are only read here, by that of CPUs."""
    flags = " ".join(jax_setup.known_flags(jaxlib.version.__version__, gpu))
    assert _run(Path(os.devnull), "import jax; print(jax.numpy.zeros(1))", XLA_FLAGS=flags) == "[0.]\n"


def test_a_release_that_was_not_tried_gets_no_flag():
    for gpu in (False, True):
        assert not jax_setup.known_flags("99.0", gpu)
        assert jax_setup.known_flags("0.10.2", gpu)
