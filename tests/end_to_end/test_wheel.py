"""The package as `pip install` brings it: what wheel and source archive hold, and that it works elsewhere.

`pbl run` of the installed wheel is in test_commands.py; `make test-newest` installs it into an empty environment.
"""

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

import pbl_pipeline
from pbl_pipeline.code_version import checked_out_commit

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


LAB = """
import importlib.metadata, schemas.ours, workers.ours
for group in ("pbl.commands", "pbl.bench", "pbl.study", "pbl.study_data"):
    for entry in importlib.metadata.entry_points(group=group):
        entry.load()
import pbl_schemas.stages, pbl_workers.web.app
pbl_schemas.stages.modules()
print(schemas.ours.NAME, workers.ours.NAME)
"""


@pytest.mark.parametrize("package", [True, False])
def test_a_laboratory_has_its_own_schemas_and_workers(installed, tmp_path, package):
    """With and without `__init__.py`, beside a notebook and on PYTHONPATH."""
    for name in ("schemas", "workers"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "ours.py").write_text(f"NAME = {name!r}\n")
        if package:
            (tmp_path / name / "__init__.py").touch()
    path = {"PYTHONPATH": f"{tmp_path}{os.pathsep}{installed}", "PBL_HOME": str(tmp_path / "home")}
    done = run([sys.executable, "-c", LAB], tmp_path, **path)
    assert (done.returncode, done.stdout) == (0, "schemas workers\n"), done.stderr[-3000:]
    done = run([installed / "bin" / "pbl", "status"], tmp_path, **path)
    assert (done.returncode, done.stderr.partition(":")[0]) == (1, "DB_NOT_RUNNING"), done.stderr
