"""What stops an installation or a first run: each a coded error before anything is half done (docs/install.md).

Stand-ins for what tests as root cannot have: another Python, a full disk, a folder that may not be written.
"""

import os
import shutil
import subprocess
import sys
import tomllib
import types
from pathlib import Path

import pytest

from pbl_pipeline import assets, interpreter
from pbl_pipeline.errors import CODES
from pbl_schemas.operations.embedded import binaries, server
from tests import Limits, refused
from tests.command import PBL, pbl, program
from tests.source import ROOT
from tests.videos import constant_rate, numbered_frames, write_video

OLD, NARROW = "sys.version_info = (3, 10, 13, 'final', 0)", "struct.calcsize = lambda _: 4"


def python(folder: Path, name: str, what: str) -> Path:
    """A Python of this name that takes itself for another one."""
    site = folder / f"site-of-{name}"
    site.mkdir(parents=True)
    (site / "sitecustomize.py").write_text(f"import struct, sys\n{what}\n")
    return program(folder, name, f'PYTHONPATH={site} exec {sys.executable} "$@"\n')


# --- another Python


@pytest.mark.parametrize("what", [OLD, NARROW])
def test_no_command_begins_on_another_python(tmp_path, what):
    command = [python(tmp_path, "python3", what), *PBL[1:], "doctor"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith(f"PYTHON_UNSUPPORTED: {CODES['PYTHON_UNSUPPORTED'].meaning}\n  found:    Python 3.")
    assert ("3.10 of 64 bits" if what == OLD else "of 32 bits") in done.stderr
    assert "make demo PYTHON=" in done.stderr
    assert "Traceback" not in done.stderr
    assert done.stdout == ""


def test_the_oldest_python_is_that_of_the_package():
    stated = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["requires-python"]
    assert stated == ">=" + ".".join(map(str, interpreter.OLDEST))
    interpreter.require()


@pytest.fixture
def checkout(tmp_path, environment) -> Path:
    """A checkout with what `make` reads before it installs, and a PATH of stand-ins."""
    if shutil.which("make") is None:
        pytest.skip("no make")
    here, programs = tmp_path / "checkout", tmp_path / "bin"
    (here / "pbl_pipeline").mkdir(parents=True)
    programs.mkdir()
    for file in ("Makefile", "pyproject.toml", "pbl_pipeline/__init__.py", "pbl_pipeline/interpreter.py"):
        shutil.copy(ROOT / file, here / file)
    for lock in ("requirements.lock", "workers/deploy/requirements-cpu.lock"):
        (here / lock).parent.mkdir(parents=True, exist_ok=True)
        (here / lock).write_text("")
    for name in ("make", "df", "awk", "id"):  # no links: a stand-in that is written later would go into the real one
        program(programs, name, f'exec {shutil.which(name)} "$@"\n')
    environment(MAKEFLAGS=None, MFLAGS=None, MAKELEVEL=None, PYTHON=None, PATH=programs)
    return here


def make(checkout: Path, *arguments: str) -> str:
    """What a failed `make demo` printed. It made nothing."""
    before = sorted(checkout.rglob("*"))
    command = ["make", "demo", *arguments]
    done = subprocess.run(command, cwd=checkout, capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stdout
    assert sorted(checkout.rglob("*")) == before
    return done.stdout + done.stderr


def test_make_refuses_another_python_before_it_makes_anything(checkout):
    programs = checkout.parent / "bin"
    assert "PYTHON_UNSUPPORTED: there is no python3 on this machine" in make(checkout)
    python(programs, "python3", OLD)
    assert f"found:    Python 3.10 of 64 bits, {sys.executable}" in make(checkout)
    python(programs, "python3.11", NARROW)
    assert "found:    Python 3.10 of 64 bits" in make(checkout)
    assert "of 32 bits" in make(checkout, "PYTHON=python3.11")
    assert "there is no python9 on this machine" in make(checkout, "PYTHON=python9")


def test_make_takes_a_python_that_fits_and_refuses_an_environment_of_another(checkout):
    programs = checkout.parent / "bin"
    python(programs, "python3", OLD)
    python(programs, "python3.11", NARROW)
    python(programs, "python3.12", "")
    plan = subprocess.run(["make", "-n", "demo"], cwd=checkout, capture_output=True, text=True, check=True).stdout
    assert "python3.12 -m venv .venv" in plan
    (checkout / ".venv/bin").mkdir(parents=True)
    python(checkout / ".venv/bin", "python", OLD)
    assert "Python 3.10 of 64 bits" in make(checkout)


def test_make_without_venv_and_root_names_the_package(checkout):
    python(checkout.parent / "bin", "python3", "sys.modules['ensurepip'] = None")
    program(checkout.parent / "bin", "id", "echo 1000\n")
    printed = make(checkout)
    assert "PACKAGE_MISSING: python3 has no venv" in printed
    assert "apt-get install python3-venv" in printed


def test_make_refuses_a_full_disk(checkout):
    python(checkout.parent / "bin", "python3", "")
    program(checkout.parent / "bin", "awk", "echo 12\n")
    assert "FILE_UNWRITABLE: 12 MB are free on this disk, .venv needs 2500 MB" in make(checkout)


# --- the first run


@pytest.fixture
def machine(tmp_path, monkeypatch, environment, in_empty_folder, limits: Limits) -> Path:
    """An empty home and cache, a MariaDB that was never started, and no program that could fetch: `calls` notes those
    that are called."""
    programs = tmp_path / "bin"
    programs.mkdir()
    for name in ("pip", "npm", "apt-get", "dpkg", "sudo", "mariadbd", "mariadb-install-db"):
        program(programs, name, f'echo "{name} $*" >> {tmp_path / "calls"}; exit 1\n')
    pip = f'*"-m pip"*) echo "$*" >> {tmp_path / "calls"}; exit 1'  # glfw calls Python as well
    program(programs, "python", f'case "$*" in {pip};; *) exec {sys.executable} "$@";; esac\n')
    monkeypatch.setattr(sys, "executable", str(programs / "python"))
    limits(binaries, PLACES=())
    monkeypatch.setattr("pbl_pipeline.jax_setup.configure", lambda: None)
    environment(PATH=f"{programs}:/bin", PBL_HOME=tmp_path / "home", PBL_CACHE=tmp_path / "cache")
    environment(PBL_OFFLINE="1", DJ_HOST=None, PBL_STORE=None)
    return in_empty_folder


def without_mariadb(machine: Path) -> None:
    (machine / "bin/mariadbd").unlink()


def calls(machine: Path) -> str:
    file = machine / "calls"
    return file.read_text() if file.exists() else ""


def made(machine: Path) -> set[str]:
    return {p.name for p in machine.iterdir()} - {"bin", "cache", "calls", "walk.mp4"}


@pytest.mark.parametrize("how", [(), ("--no-database",)])
def test_the_demo_without_files_and_network_makes_nothing(machine, how):
    done = pbl("demo", *how)
    assert (done.code, done.error_code) == (1, "ASSET_MISSING"), done.err
    assert "PBL_OFFLINE forbids fetching" in done.err
    assert "pip download" in done.err
    assert (made(machine), calls(machine)) == (set(), "")
    assert not any((machine / "cache/assets").glob("[!.]*"))


def test_a_run_without_models_and_network_makes_nothing(machine):
    write_video(machine / "walk.mp4", numbered_frames(5), constant_rate(5))
    done = pbl("run", machine / "walk.mp4", "--out", "results")
    assert (done.code, done.error_code) == (1, "ASSET_MISSING"), done.err
    assert (made(machine), calls(machine)) == (set(), "")


def test_without_a_server_and_network_nothing_is_fetched_or_made(machine):
    without_mariadb(machine)
    done = pbl("demo")
    assert (done.code, done.error_code) == (1, "DB_UNAVAILABLE"), done.err
    assert "PBL_OFFLINE" in done.err
    assert (made(machine), calls(machine)) == (set(), "")
    assert not (machine / "cache").exists()


APT = {
    "no network": """E: Failed to fetch http://deb/InRelease  Temporary failure resolving 'deb'
E: Some index files failed to download.""",
    "a web page": """E: The repository 'http://deb InRelease' is not signed.
E: Failed to fetch http://deb/InRelease  Clearsigned file isn't valid, got 'NOSPLIT' (...)""",
}


@pytest.mark.parametrize(("case", "reason"), [("no network", "Temporary failure resolving"), ("a web page", "NOSPLIT")])
def test_apt_without_root_and_archive_is_told_before_anything_is_fetched(
    machine, monkeypatch, environment, case, reason
):
    without_mariadb(machine)
    (machine / "bin/printed").write_text(APT[case])
    update = f"*Error-Mode=any*update*) cat {machine / 'bin/printed'}"
    other = '*) echo "E: Unable to locate package mariadb"'
    program(machine / "bin", "apt-get", f'case "$*" in {update};; {other};; esac; exit 100\n')
    environment(PBL_OFFLINE=None)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    done = pbl("demo")
    assert (done.code, done.error_code) == (1, "DB_UNAVAILABLE"), done.err
    assert "sudo asks for a password" in done.out
    assert reason in done.err
    assert "pbl demo --no-database" in done.err
    assert not (machine / "cache").exists()
    assert not list((machine / "home").glob("server*"))
    assert not list((machine / "home/db/data").iterdir())
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    assert reason in (binaries.install(print) or "")


def test_a_home_or_cache_that_is_a_file_is_named_before_anything_is_made(machine, monkeypatch, environment):
    (machine / "walk.mp4").write_text("not a folder")
    environment(PBL_CACHE=machine / "walk.mp4")
    done = pbl("demo")
    assert (done.error_code, "set PBL_CACHE" in done.err) == ("ASSET_MISSING", True), done.err
    assert (made(machine), calls(machine)) == (set(), "")
    environment(PBL_CACHE=machine / "cache")
    for variable in ("PBL_HOME", "HOME"):
        environment(PBL_HOME=machine / "walk.mp4" if variable == "PBL_HOME" else "", HOME=machine / "walk.mp4")
        monkeypatch.setattr(os, "geteuid", lambda: 1000)  # root's home is another
        done = pbl("demo")
        assert (done.error_code, "set PBL_HOME" in done.err) == ("DB_UNAVAILABLE", True), done.err
        assert (made(machine), calls(machine)) == (set(), "")
    assert not (machine / "cache").exists()


def test_a_home_that_may_not_be_written_is_named_before_anything_is_made(machine, monkeypatch):
    monkeypatch.setattr(server.os, "access", lambda path, mode: Path(path) != machine)
    error = refused("DB_UNAVAILABLE", server.prepare)
    assert error.found == f"you may not write to {machine}"
    assert "set PBL_HOME" in error.next_step
    assert made(machine) == set()


def test_a_home_that_may_not_be_entered_is_named(machine, monkeypatch):
    """As of `su` without `-`: HOME is another user's."""
    real = os.stat

    def closed(path, *given, **named):
        if isinstance(path, (str, os.PathLike)) and str(machine / "home") in os.fspath(path):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, *given, **named)

    monkeypatch.setattr(os, "stat", closed)
    monkeypatch.setattr(Path, "read_text", lambda path, **_: closed(path))
    for command in ("start", "status"):
        done = pbl("db", command)
        assert done.error_code == ("DB_UNAVAILABLE" if command == "start" else "DB_NOT_RUNNING"), done.err
    assert "set PBL_HOME" in pbl("demo").err
    assert "no registered model" in pbl("models", "list").out  # of `pbl doctor` as well
    assert made(machine) == set()


def test_a_full_disk_is_told_before_any_work(machine, monkeypatch, environment):
    monkeypatch.setattr(shutil, "disk_usage", lambda _: types.SimpleNamespace(free=20_000_000))
    write_video(machine / "walk.mp4", numbered_frames(5), constant_rate(5))
    done = pbl("run", machine / "walk.mp4", "--out", "results")
    assert (done.error_code, "20 MB are free" in done.err) == ("FILE_UNWRITABLE", True), done.err
    refused("DB_UNAVAILABLE", server.prepare)
    environment(PBL_OFFLINE=None)
    error = refused("ASSET_MISSING", assets.fetch, "demo_video")
    assert "20 MB are free in" in error.found
    assert error.found.endswith("sports2d==0.8.34 needs 22")  # MB: the wheel twice, and its two files
    assert "PBL_CACHE" in error.next_step
    assert (made(machine), calls(machine)) == (set(), "")
