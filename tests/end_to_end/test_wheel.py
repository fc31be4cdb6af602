"""The package as `pip install` brings it: what is in the wheel, and that it works away from the checkout.

`pbl run` of the installed wheel is in test_commands.py. What needs a gigabyte of downloads runs where it is asked for:
`pytest -m machine tests/end_to_end/test_wheel.py`.
"""

import json
import os
import re
import subprocess
import sys
import time
import zipfile
from pathlib import Path

import pytest

import pbl_pipeline
from pbl_pipeline.code_version import checked_out_commit
from tests.database import new_home, remove_home

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("pbl_pipeline", "schemas", "workers")

pytestmark = pytest.mark.slow


def run(words: list[object], folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | variables
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, cwd=folder, env=env, timeout=900)


def test_the_wheel_has_every_file_of_the_packages(wheel):
    files = {p.relative_to(ROOT).as_posix() for name in PACKAGES for p in (ROOT / name).rglob("*") if p.is_file()}
    files = {name for name in files if "__pycache__" not in name}
    assert len([name for name in files if not name.endswith(".py")]) > 40  # body, norms, templates, deploy
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
        commit = archive.read("pbl_pipeline/_commit.txt").decode().strip() if checked_out_commit(ROOT) else None
    assert files - inside == set()
    assert {name.split("/")[0] for name in inside if ".dist-info" not in name} == set(PACKAGES)
    assert commit == checked_out_commit(ROOT)


def test_it_is_declared_for_the_pythons_that_were_tried(wheel):
    with zipfile.ZipFile(wheel) as archive:
        name = next(n for n in archive.namelist() if n.endswith("METADATA"))
        text = archive.read(name).decode()
    assert "Requires-Python: >=3.11" in text
    assert re.findall(r"Python :: (3\.\d+)", text) == ["3.11", "3.12", "3.13"]


def test_the_installed_script_is_the_wheels(installed, tmp_path):
    done = run([installed / "bin" / "pbl", "--version"], tmp_path, PYTHONPATH=str(installed))
    said = rf"pbl, version {re.escape(pbl_pipeline.__version__)}\+g[0-9a-f]{{12}}(\.dirty)?\n"
    assert re.fullmatch(said, done.stdout), done.stdout + done.stderr
    where = "import pbl_pipeline, schemas, workers\nfor m in (pbl_pipeline, schemas, workers): print(m.__file__)"
    done = run([sys.executable, "-c", where], tmp_path, PYTHONPATH=str(installed))
    assert [Path(line).is_relative_to(installed) for line in done.stdout.splitlines()] == [True] * 3, done.stderr


@pytest.mark.machine
@pytest.mark.parametrize("python", ["python3.11", "python3.12", "python3.13"])
def test_an_empty_environment_to_the_first_report_by_one_command(wheel, tmp_path, python):
    """Nothing but Python, the wheel and what pip brings; empty cache, no database yet."""
    if run([python, "-c", "import venv, ensurepip"], tmp_path).returncode:
        pytest.skip(f"no {python} with venv on this machine")
    assert run([python, "-m", "venv", tmp_path / "env"], tmp_path).returncode == 0
    program = tmp_path / "env" / "bin"
    began = time.monotonic()
    done = run([program / "python", "-m", "pip", "install", "--quiet", wheel], tmp_path)
    assert done.returncode == 0, done.stderr
    fetched, home = time.monotonic(), new_home()
    try:
        done = run([program / "pbl", "demo"], tmp_path, PBL_HOME=str(home), PBL_CACHE=str(tmp_path / "cache"))
    finally:
        remove_home(home)
    took = f"{python}: installed in {fetched - began:.0f} s, demo {time.monotonic() - fetched:.0f} s"
    sys.stdout.write(took + "\n")  # `pytest -rP` shows it
    assert done.returncode == 0, done.stderr[-3000:]
    assert "</html>" in (tmp_path / "pbl_demo" / "report.html").read_text(encoding="utf-8")
    session = json.loads((tmp_path / "pbl_demo" / "metrics.json").read_text(encoding="utf-8"))["session"]
    assert session["cadence_steps_per_min"]["mean"] == pytest.approx(98, rel=0.025)  # by eye, see test_demo.py
