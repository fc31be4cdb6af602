"""Calls of `pbl` that cannot work: each ends with a code on stderr and exit code 1 (2: wrong usage), no traceback."""

import errno
import os
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.synthetic import plain_walk
from tests.command import Done, pbl
from tests.videos import constant_rate, numbered_frames, write_video
from tests.walker import observe
from tests.walking_fit import walking_fit


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good and odd files, named as people name them."""
    folder = tmp_path_factory.mktemp("odd calls - é")
    write_video(folder / "a video.mp4", numbered_frames(40), constant_rate(40))
    (folder / "folder.mp4").mkdir()
    cv2.imwrite(str(folder / "p.jpg"), np.zeros((64, 64, 3), np.uint8))
    (folder / "p.jpg").rename(folder / "picture.mp4")
    (folder / "file").touch()
    time_s = np.arange(120) / 30
    observe(plain_walk(time_s), time_s).save(folder / "walk.keypoints.npz")
    body = load_body()
    walking_fit(body.joint_names, body.sha256, name="walk", n_frames=120).save(folder / "walk.fit.npz")
    _damaged(folder)
    for name, text in {
        "broken.json": '{"max_iterations": 3',
        "list.json": "[1]",
        "unknown.json": '{"steps": 3}',
        "other.toml": "[a]\n",
        "bad.toml": "a = [",
    }.items():
        (folder / name).write_text(text)
    return folder


def _damaged(folder: Path) -> None:
    np.save(folder / "array.npy", np.zeros(3))
    (folder / "array.npy").rename(folder / "array.npz")
    np.savez(folder / "other.npz", a=1)
    np.savez(folder / "objects.npz", a=np.array([{}], dtype=object))
    (folder / "text.npz").write_text("no zip")
    for kind in ("keypoints", "fit"):
        whole = (folder / f"walk.{kind}.npz").read_bytes()
        (folder / f"cut.{kind}.npz").write_bytes(whole[: len(whole) // 2])
        # Bytes changed within the first compressed array: the directory at the end is whole.
        (folder / f"flipped.{kind}.npz").write_bytes(whole[:200] + bytes(100) + whole[300:])
        with np.load(folder / f"walk.{kind}.npz") as f:
            fields = {k: f[k] for k in f.files}
        first = "xy_px" if kind == "keypoints" else "qpos"
        np.savez(folder / f"type.{kind}.npz", **{**fields, first: fields[first].astype(str)})
        np.savez(folder / f"shape.{kind}.npz", **{**fields, first: fields[first][:-1]})
        np.savez(folder / f"size.{kind}.npz", **{**fields, "image_size_px": np.array([3])})


def check(done: Done, code: str) -> None:
    assert (done.code, done.error_code) == (1, code), done.err
    assert "found:" in done.err
    assert "next:" in done.err
    assert "Traceback" not in done.out + done.err


DAMAGED = ["array.npz", "other.npz", "objects.npz", "text.npz", "file"]
OF_A_KIND = ["cut", "flipped", "type", "shape", "size"]


@pytest.mark.parametrize("command", ["fit", "events", "gait"])
def test_files_that_are_not_what_their_name_says(folder, tmp_path, command):
    kind = "keypoints" if command == "fit" else "fit"
    for name in [*DAMAGED, *(f"{c}.{kind}.npz" for c in OF_A_KIND), "a video.mp4"]:
        done = pbl(command, folder / name, "--out", tmp_path / "out")
        check(done, "FILE_FORMAT")
        assert not (tmp_path / "out").exists(), name
    check(pbl(command, folder / "not there.npz", "--out", tmp_path / "out"), "FILE_MISSING")
    # A folder may hold OpenPose's JSON.
    code = "FILE_FORMAT" if command == "fit" else "FILE_MISSING"
    check(pbl(command, folder / "folder.mp4", "--out", tmp_path / "out"), code)


def test_one_kind_of_file_for_another(folder, tmp_path):
    check(pbl("fit", folder / "walk.fit.npz", "--out", tmp_path / "o"), "FILE_FORMAT")
    check(pbl("gait", folder / "walk.keypoints.npz", "--out", tmp_path / "o"), "FILE_FORMAT")
    check(pbl("detect", folder / "walk.fit.npz", "--out", tmp_path / "o.npz"), "VIDEO_NOT_A_VIDEO")


@pytest.mark.parametrize("command", ["run", "detect"])
@pytest.mark.parametrize(
    ("video", "code"),
    [("folder.mp4", "VIDEO_MISSING"), ("picture.mp4", "VIDEO_NOT_A_VIDEO"), ("nicht - da.mp4", "VIDEO_MISSING")],
)
def test_videos_that_are_none(folder, tmp_path, command, video, code):
    check(pbl(command, folder / video, "--out", tmp_path / "o.npz"), code)


@pytest.mark.parametrize(
    "camera", ["other.toml", "bad.toml", "list.json", "not there.toml", "folder.mp4", "a video.mp4"]
)
def test_cameras_that_are_none(folder, tmp_path, camera):
    for command in ("run", "detect"):
        words = (command, folder / "a video.mp4", "--out", tmp_path / "o.npz", "--camera", folder / camera)
        check(pbl(*words), "CAMERA_INVALID")


@pytest.mark.parametrize(
    ("option", "value", "code"),
    [
        *(("--params", f"{n}.json", "FILE_FORMAT") for n in ("broken", "list", "unknown")),
        ("--params", "folder.mp4", "SOLVER_UNKNOWN"),
        ("--params", "no such paramset", "SOLVER_UNKNOWN"),
        ("--solver", "no such solver", "SOLVER_UNKNOWN"),
    ],
)
def test_parameters_that_are_none(folder, tmp_path, option, value, code):
    value = folder / value if (folder / value).exists() else value
    check(pbl("fit", folder / "walk.keypoints.npz", "--out", tmp_path / "o", option, value), code)
    check(pbl("run", folder / "a video.mp4", "--out", tmp_path / "o", option, value), code)


def test_names_that_are_none_are_said_before_the_work(folder, tmp_path, stand_in):
    stand_in(track_people=lambda *a, **k: pytest.fail("work was begun"))
    check(pbl("run", folder / "a video.mp4", "--out", tmp_path, "--norm", "nobody's"), "NORM_UNKNOWN")
    gait = ("gait", folder / "walk.fit.npz", "--out", tmp_path / "m.json")
    check(pbl(*gait, "--norm", "nobody's"), "NORM_UNKNOWN")
    check(pbl(*gait, "--norm", folder / "list.json"), "NORM_INVALID")
    check(pbl("events", folder / "walk.fit.npz", "--out", tmp_path / "e.csv", "--method", "x"), "SOLVER_UNKNOWN")


CALLS = {
    "run": ("a video.mp4",),
    "detect": ("a video.mp4",),
    "fit": ("walk.keypoints.npz",),
    "events": ("walk.fit.npz",),
    "gait": ("walk.fit.npz",),
}


@pytest.mark.parametrize("command", CALLS)
def test_places_that_cannot_be_written_are_said_before_the_work(folder, tmp_path, monkeypatch, command, stand_in):
    stand_in(track_people=lambda *a, **k: pytest.fail("work was begun"))
    files = [folder / f for f in CALLS[command]]
    check(pbl(command, *files, "--out", folder / "file" / "x.npz"), "FILE_UNWRITABLE")
    (tmp_path / "x.npz").mkdir()
    if command in ("detect", "events", "gait"):
        check(pbl(command, *files, "--out", tmp_path / "x.npz"), "FILE_UNWRITABLE")
    monkeypatch.setattr(os, "access", lambda *a, **k: False)
    check(pbl(command, *files, "--out", tmp_path / "new" / "x.npz"), "FILE_UNWRITABLE")
    assert not (tmp_path / "new").exists()


@pytest.mark.skipif(hasattr(os, "geteuid") and os.geteuid() == 0, reason="root may read and write everywhere")
def test_files_that_may_not_be_read(folder, tmp_path):
    (tmp_path / "closed.mp4").write_bytes((folder / "a video.mp4").read_bytes())
    (tmp_path / "closed.npz").write_bytes((folder / "walk.fit.npz").read_bytes())
    for file in tmp_path.iterdir():
        file.chmod(0)
    check(pbl("run", tmp_path / "closed.mp4", "--out", tmp_path / "o"), "VIDEO_MISSING")
    check(pbl("gait", tmp_path / "closed.npz", "--out", tmp_path / "m.json"), "FILE_MISSING")


# ------------------------------------------------------------------------------------- what the machine lacks
@pytest.mark.parametrize(
    "words",
    [
        ("populate",),
        ("status",),
        ("status", "--json"),
        ("choose", "1", "1"),
        ("ingest", "a video.mp4", "--subject", "P1"),
        ("report", "--subject", "P1", "--out", "o"),
        ("db", "status"),
    ],
    ids=lambda words: " ".join(words),
)
def test_without_a_database(environment, in_empty_folder, tmp_path, words):
    environment(PBL_HOME=tmp_path / "home")
    done = pbl(*words)
    check(done, "DB_NOT_RUNNING")
    assert "pbl db start" in done.err
    assert not (tmp_path / "home").exists() or not list((tmp_path / "home").rglob("credentials.json"))


def test_settings_that_cannot_be(environment, folder, tmp_path):
    environment(PBL_HOME=folder / "file")
    check(pbl("status"), "DB_UNAVAILABLE")
    check(pbl("db", "start"), "DB_UNAVAILABLE")
    environment(DJ_HOST="localhost:abc")
    check(pbl("demo", "--out", tmp_path), "USAGE")
    check(pbl("status"), "DB_REFUSED")
    environment(DJ_USER="u", DJ_PASS="p")
    check(pbl("status"), "USAGE")


@pytest.mark.parametrize("command", ["run", "detect"])
def test_without_the_models(environment, folder, tmp_path, command):
    environment(PBL_CACHE=tmp_path / "cache", PBL_OFFLINE="1")
    done = pbl(command, folder / "a video.mp4", "--out", tmp_path / "o.npz")
    check(done, "ASSET_MISSING")
    assert "pip download" in done.err
    assert "mediapipe==0.10.21" in done.err


# ---------------------------------------------------------------------------------------------- the unforeseen
def failing(error: BaseException):
    def fails(*_args, **_more):
        raise error

    return fails


def test_an_unforeseen_error_asks_to_be_reported(stand_in, folder, tmp_path):
    stand_in(detect_events=failing(ZeroDivisionError("somewhere deep")))
    words = ("events", folder / "walk.fit.npz", "--out", tmp_path / "e.csv")
    done = pbl(*words)
    check(done, "INTERNAL")
    assert "ZeroDivisionError: somewhere deep" in done.err
    assert re.search(r"at test_odd_calls\.py:\d+ in fails", done.err)
    assert "--debug" in done.err
    with_stack = pbl("--debug", *words)
    assert (with_stack.code, with_stack.error_code) == (1, "INTERNAL")
    assert "Traceback" in with_stack.err


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ImportError("No module named 'matplotlib'", name="matplotlib.axes"), "pip install 'pbl-pipeline[figures]'"),
        (ImportError("libmujoco.so: cannot open", name="mujoco"), "`pbl doctor`"),
        (ImportError("core bindings are missing"), "`pbl doctor`"),  # as raised by the package itself
    ],
)
def test_a_package_that_is_missing_or_broken_is_named(stand_in, folder, tmp_path, error, said):
    stand_in(detect_events=failing(error))
    done = pbl("events", folder / "walk.fit.npz", "--out", tmp_path / "e.csv")
    check(done, "PACKAGE_MISSING")
    assert str(error) in done.err
    assert said in done.err


def test_a_name_of_ours_that_is_missing_is_our_fault(stand_in, folder, tmp_path):
    error = ImportError("cannot import name 'x' from 'pbl_pipeline.gait'", name="pbl_pipeline.gait")
    stand_in(detect_events=failing(error))
    check(pbl("events", folder / "walk.fit.npz", "--out", tmp_path / "e.csv"), "INTERNAL")


def test_a_full_disk_is_named(stand_in, folder, tmp_path):
    full = OSError(errno.ENOSPC, "No space left on device", "walk.events.csv")
    stand_in(detect_events=failing(full))
    done = pbl("events", folder / "walk.fit.npz", "--out", tmp_path / "e.csv")
    check(done, "FILE_UNWRITABLE")
    assert "No space left" in done.err


@pytest.mark.parametrize("words", [("synth", "--out"), ("models", "add"), ("fit", "x.npz", "--out", "o", "--params")])
def test_a_name_too_long_is_wrong_usage(words):
    check(pbl(*words, "a" * 5000), "USAGE")


def test_an_interrupt_is_no_error(stand_in, folder, tmp_path):
    stand_in(detect_events=failing(KeyboardInterrupt()))
    done = pbl("events", folder / "walk.fit.npz", "--out", tmp_path / "e.csv")
    assert (done.code, done.error_code) == (130, "")
    assert "interrupted" in done.err


def test_wrong_usage_is_code_2_and_help_is_0():
    assert pbl("frobnicate").code == 2
    assert pbl("run").code == 2
    assert pbl("detect", "v.mp4", "--out", "o.npz", "--person", "-1").code == 2
    assert pbl("choose", "x", "1").code == 2
    assert pbl("run", "--help").code == 0
    assert pbl("--version").code == 0
    assert "pbl, version" in pbl("--version").out
