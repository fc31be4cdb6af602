"""The package as `pip install` brings it: what wheel and source archive hold, and that it works elsewhere.

`pbl run` of the installed wheel is in test_commands.py. What needs a gigabyte of downloads runs where it is asked for:
`pytest -m machine tests/end_to_end/test_wheel.py`.
"""

import json
import os
import re
import subprocess
import sys
import tarfile
import time
import zipfile
from pathlib import Path

import pytest

import pbl_pipeline
from pbl_pipeline.code_version import checked_out_commit
from tests.database import new_home, remove_home

ROOT = Path(__file__).resolve().parents[2]
#: Installed packages and the folders that hold them.
PACKAGES = {"pbl_pipeline": ROOT, "pbl_schemas": ROOT / "schemas", "pbl_workers": ROOT / "workers"}
#: What a source archive has beside them; hatchling adds the last two.
BESIDE = {
    *("README.md", "LICENSE", "CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "SECURITY.md", "docker-compose.yml"),
    *("pyproject.toml", "hatch_build.py", "docs", "schemas", "workers", ".gitignore", "PKG-INFO"),
}

pytestmark = pytest.mark.slow


def run(words: list[object], folder: Path, **variables: str) -> subprocess.CompletedProcess[str]:
    env = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"} | variables
    return subprocess.run([str(w) for w in words], capture_output=True, text=True, cwd=folder, env=env, timeout=900)


def test_the_wheel_has_every_file_of_the_packages(wheel):
    found = [(at, p) for name, at in PACKAGES.items() for p in (at / name).rglob("*") if p.is_file()]
    files = {p.relative_to(at).as_posix() for at, p in found}
    files = {name for name in files if "__pycache__" not in name}
    assert len([name for name in files if not name.endswith(".py")]) > 40  # body, norms, templates
    with zipfile.ZipFile(wheel) as archive:
        inside = set(archive.namelist())
        commit = archive.read("pbl_pipeline/_commit.txt").decode().strip() if checked_out_commit(ROOT) else None
    assert files - inside == set()
    assert {name.split("/")[0] for name in inside if ".dist-info" not in name} == set(PACKAGES)
    assert commit == checked_out_commit(ROOT)


def test_the_source_archive_has_what_an_installation_needs_and_builds_the_same_wheel(wheel, tmp_path):
    build = [sys.executable, "-m", "hatchling", "build", "--directory", tmp_path, "--target"]
    done = run([*build, "sdist"], ROOT)
    assert done.returncode == 0, done.stderr
    (archive,) = tmp_path.glob("*.tar.gz")
    assert archive.stat().st_size < 5e6
    with tarfile.open(archive) as file:
        file.extractall(tmp_path, filter="data")
    source = archive.with_name(archive.name.removesuffix(".tar.gz"))
    assert {p.name for p in source.iterdir()} == BESIDE | {"pbl_pipeline"}
    assert not [p for p in source.rglob("*") if p.name == "__pycache__" or p.suffix in (".pyc", ".mp4", ".db")]
    done = run([*build, "wheel"], source)
    assert done.returncode == 0, done.stderr
    (again,) = tmp_path.glob("*.whl")
    assert contents(again) == contents(wheel)


def contents(wheel: Path) -> dict[str, bytes]:
    """The files of a wheel; RECORD lists their sums in the order in which they were added."""
    with zipfile.ZipFile(wheel) as archive:
        return {name: archive.read(name) for name in archive.namelist() if not name.endswith("/RECORD")}


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
    names = ", ".join(PACKAGES)
    where = f"import {names}\nfor m in ({names}): print(m.__file__)"
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
