"""Small files that ask for much: refused with a code, within the memory that is stated."""

import errno
import gzip
import io
import json
import os
import time
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline import bounded
from pbl_pipeline.body import load_marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.files import fields_of, load_npz
from pbl_pipeline.gait import load_norm, read_lab_trial
from pbl_pipeline.gait.events import load_events
from pbl_pipeline.keypoints import Keypoints, WorldMarkers, read_trc
from pbl_pipeline.models import load_spec
from pbl_pipeline.validation import reference_of_bodies, reference_of_mot
from pbl_pipeline.video import load_camera, load_camera_poses, read_phone_log
from pbl_schemas.operations import backup
from tests import Faults
from tests.command import pbl
from tests.guard import guarded
from tests.inputs import keypoints, markers

#: What reading a file may take beyond what the process has: 1 GiB less the libraries.
MOST_MIB = 640


def refused(code: str, call: Callable[..., object], *arguments: object) -> str:
    with guarded() as peak, pytest.raises(PblError) as caught:
        call(*arguments)
    assert caught.value.code == code
    assert peak.grown_mib < MOST_MIB
    return caught.value.found


def zeros(path: Path, name: str, mib: int, method: int = zipfile.ZIP_DEFLATED) -> Path:
    """An archive (a new one, or one that is there) with a member of so many zeros, a thousandth of it as a file."""
    with zipfile.ZipFile(path, "a", method, compresslevel=1) as archive, archive.open(name, "w") as file:
        if name.endswith(".npy"):
            np.lib.format.write_array_header_1_0(
                file, {"descr": "|u1", "fortran_order": False, "shape": (mib * bounded.MIB,)}
            )
        for _ in range(mib):
            file.write(bytes(bounded.MIB))
    return path


def npz(path: Path, header: bytes, data: bytes = b"", name: str = "time_s") -> Path:
    start = b"\x93NUMPY\1\0" + len(header).to_bytes(2, "little") + header
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}.npy", start + data)
    return path


# --- arrays


def test_a_member_that_nobody_asked_for_is_not_unpacked(tmp_path: Path):
    markers().save(tmp_path / "m.npz")
    zeros(tmp_path / "m.npz", "extra.npy", 200)
    with guarded() as peak:
        found = WorldMarkers.load(tmp_path / "m.npz")
    assert found.names == markers().names
    assert peak.grown_mib < 50


def test_arrays_that_are_asked_for_have_a_limit(tmp_path: Path):
    large = zeros(tmp_path / "large.npz", "time_s.npy", 257)
    assert "at most" in refused("FILE_FORMAT", load_npz, large, ["time_s"])
    # Numbers of one byte become eight as soon as anybody computes with them.
    small = zeros(tmp_path / "small.npz", "time_s.npy", 60)
    assert "more than" in refused("FILE_FORMAT", load_npz, small, ["time_s"])
    many = tmp_path / "many.npz"
    for name in "abcdefgh":
        zeros(many, f"{name}.npy", 10)
    assert len(load_npz(many, "abc")) == 3
    refused("FILE_FORMAT", load_npz, many, "abcdefgh")


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (4611686018427387904,), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1, 0, 99999999999999999999), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (True,), }",
        b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        b"{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
        b"{'descr': '<M8[s]', 'fortran_order': False, 'shape': (1,), }",
        b"{'descr': '|V8', 'fortran_order': False, 'shape': (1,), }",
        b"{'descr': '<f99', 'fortran_order': False, 'shape': (1,), }",
        b"(" * 4000 + b")" * 4000,
        b"[" * 9000,
        b"-" * 9000 + b"1",
        b"{'descr': " + b"(" * 300 + b")" * 300 + b", 'fortran_order': False, 'shape': (1,), }",
        b"\xff\xfe\0",
        b"'",
        b"",
        b"1" * 9000,
    ],
)
def test_headers_of_arrays_that_make_no_sense(tmp_path: Path, header: bytes):
    refused("FILE_FORMAT", load_npz, npz(tmp_path / "a.npz", header, bytes(8)), ["time_s"])


def test_arrays_are_read_as_they_were_written(tmp_path: Path):
    rng = np.random.default_rng(0)
    given = {
        "plain": rng.random((4, 3)),
        "fortran": np.asfortranarray(rng.random((4, 3))),
        "turned": rng.random((4, 3)).T,
        "big": rng.random(5).astype(">f4"),
        "scalar": np.asarray(3),
        "text": np.asarray(["a", "bcd"]),
        "yes": np.array([True, False]),
        "nothing": np.zeros((0, 5), np.int16),
    }
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **given)
        back = load_npz(tmp_path / "a.npz", given)
        assert list(back) == list(given)
        for name, array in given.items():
            np.testing.assert_array_equal(back[name], array)
            assert back[name].dtype == array.dtype
            assert back[name].flags.writeable
    assert fields_of(tmp_path / "a.npz") == set(given)
    assert set(load_npz(tmp_path / "a.npz", ["big", "absent"])) == {"big"}


# --- archives


def test_archives_that_unpack_to_much(tmp_path: Path):
    log = zeros(tmp_path / "log.zip", "walk/Orientation.csv", 64)
    assert log.stat().st_size < bounded.MIB
    assert "64 MiB" in refused("PHONE_LOG", read_phone_log, log)
    other = zeros(tmp_path / "bz.zip", "Orientation.csv", 1, zipfile.ZIP_BZIP2)
    assert "packed" in refused("PHONE_LOG", read_phone_log, other)


def test_an_archive_with_a_directory_of_many(tmp_path: Path):
    size = 30_000 * 47
    record = b"PK\5\6" + bytes(8) + size.to_bytes(4, "little") + bytes(6)
    data = bytes(size) + record
    (tmp_path / "many.zip").write_bytes(data)
    assert "directory" in refused("PHONE_LOG", read_phone_log, tmp_path / "many.zip")
    # A record that names another one, for archives above 4 GiB, is not followed.
    (tmp_path / "far.zip").write_bytes(b"PK\6\7" + bytes(16) + b"PK\5\6" + bytes(18))
    refused("PHONE_LOG", read_phone_log, tmp_path / "far.zip")


def test_a_member_shorter_or_longer_than_the_directory_names(tmp_path: Path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("Orientation.csv", "x" * 1000)
    data = (tmp_path / "a.zip").read_bytes()
    at = data.rfind(b"PK\1\2") + 24
    for n in (10, 10_000, 2**32 - 2):
        (tmp_path / "b.zip").write_bytes(data[:at] + n.to_bytes(4, "little") + data[at + 4 :])
        refused("PHONE_LOG", read_phone_log, tmp_path / "b.zip")


def test_gzip(tmp_path: Path):
    packed = gzip.compress(bytes(200 * bounded.MIB), 1)
    for name, code, read in (
        ("a.json.gz", "FILE_FORMAT", reference_of_bodies),
        ("a.c3d.gz", "FILE_FORMAT", read_lab_trial),
    ):
        (tmp_path / name).write_bytes(packed)
        assert "more than" in refused(code, read, tmp_path / name)
        (tmp_path / name).write_bytes(gzip.compress(b"{}")[:-6])
        refused(code, read, tmp_path / name)


# --- text


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("deep", "[" * 100_000),
        ("deep", "[" * 40 + "]" * 40),
        ("deep", '{"a":' * 40 + "1" + "}" * 40),
        ("lists", "[" + "[]," * 2_000_000 + "1]"),
        ("digits", '{"time": [' + "9" * 400 + "]}"),
        ("MiB", "[" + " " * (33 * bounded.MIB) + "]"),
        ("surrogates", '{"time": "\\ud800"}'),
        ("surrogates", '{"\\udfff": 1}'),
    ],
)
def test_json(tmp_path: Path, words: str, text: str):
    path = tmp_path / "a.json"
    path.write_text(text)
    with guarded() as peak, pytest.raises(ValueError, match=words):
        bounded.read_json(path)
    assert peak.grown_mib < MOST_MIB


def test_json_that_is_sound_is_read():
    content = {"name": "M\u00fcller \U0001f6b6", "list": [1, 2.5, None, True, {"a": []}], "big": 10**300}
    assert bounded.parse_json(json.dumps(content)) == content
    deep: object = 1
    for _ in range(bounded.MAX_DEPTH):
        deep = [deep]
    assert bounded.parse_json(json.dumps(deep)) == deep
    texts = ["[" * 99, '{"' * 99, '"[', "\\"]
    assert bounded.parse_json(json.dumps(texts)) == texts


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a":' * 33 + "1" + "}" * 33, "[" * 33 + '"'])
def test_nested_json_is_refused_before_it_is_parsed(text: str, faults: Faults):
    """The parser would nest its calls to Python's limit, where the destructors of other objects fail."""
    parsed = faults(json, "loads")
    with pytest.raises(ValueError, match="deep"):
        bounded.parse_json(text)
    assert not parsed


@pytest.mark.parametrize(
    ("piece", "n"), [('{"a":1},', 1_000_000), ('"ab",', 6_700_000), ("1.5,", 8_300_000), ('{"a":{}},', 500_000)]
)
def test_the_largest_json_takes_less_than_stated(piece: str, n: int):
    """An eighth of it, for the time."""
    text = "[" + piece * (n // 8) + "1]"
    with guarded() as peak:
        bounded.parse_json(text)
    assert peak.grown_mib < MOST_MIB / 8


def every_json_reader(path: Path) -> list[tuple[str, Callable[[], object]]]:
    return [
        ("CAMERA_INVALID", lambda: load_camera(path, (100, 100))),
        ("NORM_INVALID", lambda: load_norm(str(path))),
        ("FILE_FORMAT", lambda: reference_of_bodies(path)),
        ("PHONE_LOG", lambda: read_phone_log(path)),
    ]


@pytest.mark.parametrize("data", [b'{"a":' * 5000, b"{\xff}", b"[" * 300_000, b'{"matrix": 1' + b"0" * 5000 + b"}"])
def test_every_reader_of_json_refuses_with_its_code(tmp_path: Path, data: bytes):
    path = tmp_path / "a.json"
    path.write_bytes(data)
    for code, read in every_json_reader(path):
        refused(code, read)
    (tmp_path / "model.json").write_bytes(data)
    refused("MODEL_INVALID", load_spec, tmp_path)
    keypoints().save(tmp_path / "k.npz")
    done = pbl("fit", tmp_path / "k.npz", "--params", path, "--out", tmp_path / "out")
    assert done.error_code == "FILE_FORMAT"


def test_tables(tmp_path: Path):
    log = tmp_path / "log.csv"
    # As many names as rows: a dictionary for each row would have 10^11 cells.
    log.write_text("time_s,qw,qx,qy,qz," + ",".join(map(str, range(300_000))) + "\n0,1,0,0,0\n" * 300_000)
    refused("PHONE_LOG", read_phone_log, log)
    log.write_text("time_s,qw,qx,qy,qz\n" + "1\n" * 5_000_000)
    assert "rows" in refused("PHONE_LOG", read_phone_log, log)
    events = tmp_path / "events.csv"
    events.write_text("time_s,side,event,probability\n" + "1,left,foot_up,1\n" * 100_000)
    refused("FILE_FORMAT", load_events, events)
    motion = tmp_path / "a.mot"
    motion.write_text("inDegrees=yes\nendheader\ntime a\n" + "1 2\n" * 600_000)
    refused("FILE_FORMAT", reference_of_mot, motion)
    trc = tmp_path / "a.trc"
    trc.write_text("PathFileType\n" * 3_000_000)
    refused("FILE_FORMAT", read_trc, trc)


# --- what is no file


def test_a_pipe_is_refused_and_not_waited_for(tmp_path: Path):
    for name in ("k.npz", "a.json", "a.trc", "a.csv"):
        os.mkfifo(tmp_path / name)
    refused("FILE_MISSING", Keypoints.load, tmp_path / "k.npz")
    refused("FILE_MISSING", read_trc, tmp_path / "a.trc")
    refused("CAMERA_INVALID", load_camera, tmp_path / "a.json", (100, 100))
    refused("FILE_FORMAT", load_events, tmp_path / "a.csv")
    refused("FILE_MISSING", read_phone_log, tmp_path / "a.csv")


@pytest.mark.skipif(not Path("/proc/self/mem").exists(), reason="a regular file that cannot be read, of Linux")
def test_a_disk_that_fails_is_no_fault_of_a_file(tmp_path: Path):
    """Nothing at the first address: reading it is an error of input and output (EIO)."""
    for name in ("a.json", "a.zip", "k.npz", "a.trc", "a.csv", "a.xml"):
        (tmp_path / name).symlink_to("/proc/self/mem")
    readers: list[tuple[Callable[[Path], object], str]] = [
        *((lambda _, read=read: read(), "a.json") for _, read in every_json_reader(tmp_path / "a.json")),
        *((read_phone_log, name) for name in ("a.zip", "a.csv")),
        (Keypoints.load, "k.npz"),
        (load_events, "a.csv"),
        (load_marker_set, "a.xml"),
        (read_trc, "a.trc"),
    ]
    for read, name in readers:
        with pytest.raises(PblError) as caught:
            read(tmp_path / name)
        assert (caught.value.code, caught.value.final) == ("FILE_MISSING", False), name


@pytest.mark.parametrize("kind", ["archive", "directory"])
def test_a_disk_that_fails_within_an_archive_is_no_fault_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
):
    path = zeros(tmp_path / "log.zip", "Orientation.csv", 2)
    n_read = 0

    class Failing(io.BufferedReader):
        def read(self, size: int | None = -1, /) -> bytes:
            nonlocal n_read
            n_read += 1
            if n_read > (3 if kind == "archive" else 0):
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            return super().read(size)

    monkeypatch.setattr(bounded, "open", lambda p, *_, **__: Failing(io.FileIO(p)), raising=False)
    with pytest.raises(PblError) as caught:
        read_phone_log(path)
    assert (caught.value.code, n_read > 0) == ("FILE_MISSING", True)


def test_a_file_that_grows_while_it_is_read(tmp_path: Path):
    """What counts is what is read, not what the file had before."""
    path = tmp_path / "a.json.gz"
    buffer = io.BytesIO()
    with gzip.GzipFile(fileobj=buffer, mode="wb") as file:
        file.write(b"[" + b" " * 100)
    path.write_bytes(buffer.getvalue())
    with pytest.raises(ValueError, match="more than"):
        bounded.read_bytes(path, 50)
    assert len(bounded.read_bytes(path, 101)) == 101


@pytest.mark.parametrize(
    ("words", "text"),
    [
        ("deep", "a=" + "[" * 40 + "]" * 40),
        ("deep", "a=" + "[" * 8000 + "]" * 8000),
        ("deep", "[" + ".".join("a" * 40) + "]"),
        ("digits", "a=[0x" + "f" * 5000 + "]"),
        ("MiB", "a=1\n" * 20_000),
        ("integer string", "a=1" + "0" * 5000),
        pytest.param("deep", ".".join(["a"] * 12_000) + "=1", marks=pytest.mark.slow),
    ],
    ids=["nested", "very nested", "nested tables", "hexadecimal", "long", "digits", "a key of many parts"],
)
def test_toml(tmp_path: Path, words: str, text: str):
    path = tmp_path / "a.toml"
    path.write_text(text)
    start = time.monotonic()
    with guarded() as peak, pytest.raises(ValueError, match=words):
        bounded.read_toml(path)
    assert peak.grown_mib < MOST_MIB
    assert time.monotonic() - start < 50.0
    refused("CAMERA_INVALID", load_camera, path, (100, 100))
    refused("CAMERA_INVALID", load_camera_poses, path)


def test_a_million_columns(tmp_path: Path):
    million = ",".join(f"c{i}" for i in range(1_000_000))
    path = tmp_path / "a.csv"
    wide = f"time_s,side,event,probability,{million}\n" + "1,left,foot_up,1\n" * 20_000
    path.write_text(wide)
    refused("FILE_FORMAT", load_events, path)
    refused("PHONE_LOG", read_phone_log, path)
    path.write_text(f"name,body,x,y,z,{','.join('a' * 60_000)}\n" + "hip,pelvis,0,0,0\n" * 600)
    refused("FILE_FORMAT", load_marker_set, path)
    motion = tmp_path / "a.mot"
    motion.write_text(f"inDegrees=yes\nendheader\ntime {million.replace(',', ' ')}\n" + "1 2\n" * 1000)
    refused("FILE_FORMAT", reference_of_mot, motion)
    trc = tmp_path / "a.trc"
    names = million.replace(",", "\t\t\t")
    head = "PathFileType\t4\nDataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\n100\t100\t2\t1000000\tmm\n"
    trc.write_text(f"{head}Frame#\tTime\t{names}\n" + "1\t0\t1\t2\t3\n" * 1000)
    refused("FILE_FORMAT", read_trc, trc)


@pytest.mark.parametrize(
    "change",
    [
        {"sha256": [1]},
        {"sha256": None},
        {"n_files": "x"},
        {"n_files": None},
        {"n_files": float("inf")},
        {"rows": ...},
        {"prefix": ...},
        {"format": None},
    ],
    ids=str,
)
def test_a_manifest_of_a_backup_that_makes_no_sense(tmp_path: Path, change: dict[str, object]):
    sound = {"format": backup.FORMAT, "sha256": {}, "n_files": 0, "n_bytes": 0, "rows": {}, "store": True}
    content = sound | {"prefix": "pbl", "created": ""} | change
    path = tmp_path / "manifest.json"
    path.write_text(json.dumps({k: v for k, v in content.items() if v is not ...}))
    refused("BACKUP_INVALID", backup.check, tmp_path)
    path.write_text('{"a":' * 5000)
    refused("BACKUP_INVALID", backup.check, tmp_path)
    path.write_text("[]")
    refused("BACKUP_INVALID", backup.check, tmp_path)
