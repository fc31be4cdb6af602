"""The commands on files, one after the other on a short clip, and their files against docs/files.md.

In a process that finds nothing of POSIX (tests/without_posix.py): what they write is what other systems would get."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest

from pbl_pipeline.body import load_body
from pbl_pipeline.gait import MEASURES
from tests.without_posix import ENCODING, each, pbl

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs" / "files.md"
EXPORTS = ("trc", "mot", "osim", "csv")


@pytest.fixture(scope="module")
def here(walking: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder in which the commands wrote, and what the last one printed."""
    here = tmp_path_factory.mktemp("files")
    keypoints, out, fit = here / "walking.keypoints.npz", here / "new folder", here / "new folder" / "walking.fit.npz"
    done = each(
        ("detect", walking, "--out", keypoints),
        ("fit", keypoints, "--out", out),
        ("events", fit, "--out", here / "made" / "walking.events.csv"),
        ("events", keypoints, "--out", here / "e.csv"),
        ("gait", fit, "--out", here / "metrics.json"),
        ("export", fit, *(w for name in EXPORTS for w in ("--to", name)), "--out", here / "exports"),
    )
    assert [d.err for d in done if d.code] == []
    assert "CHOSEN" in done[0].out
    (here / "exported").write_text(done[-1].out)
    return here


@pytest.fixture
def fitted(here: Path) -> Path:
    return here / "new folder" / "walking.fit.npz"


def section(title: str) -> str:
    """The part of docs/files.md under a heading."""
    return DOCS.read_text().split(f"## `{title}`\n")[1].split("\n## ")[0]


def documented(title: str) -> dict[str, tuple[str, ...]]:
    """Field -> shape as written, of a table in docs/files.md."""
    fields: dict[str, tuple[str, ...]] = {}
    for names, shapes in re.findall(r"^\| (`[^|]+)\|([^|]*)\|", section(title), re.MULTILINE):
        each = re.findall(r"`(\w+)`", names)
        # A row of several fields has a shape for each, in order, between commas outside parentheses; or one for all.
        written = [part.strip() for part in re.split(r",(?![^(]*\))", shapes)]
        assert len(written) in (1, len(each)), names
        for name, shape in zip(each, written if len(written) > 1 else written * len(each), strict=True):
            fields[name] = tuple(n.strip() for n in shape.strip("()").split(",") if n.strip() not in ("", "text"))
    return fields


def check_fields(path: Path, title: str, sizes: dict[str, int], optional: tuple[str, ...] = ()) -> set[str]:
    """Compare an .npz with the page; returns the names in the file."""
    with np.load(path, allow_pickle=False) as f:
        data = {k: f[k] for k in f.files}
    fields, known = documented(title), dict(sizes)
    assert set(fields) - set(optional) <= set(data)
    for name, shape in fields.items():
        if name in data and shape:
            assert data[name].ndim == len(shape), name
            for n, found in zip(shape, data[name].shape, strict=True):
                # A letter that no test gives is the same wherever it stands.
                assert found == (int(n) if n.isdecimal() and n not in sizes else known.setdefault(n, found)), name
    return set(data) - set(fields)


def test_keypoints_are_as_described(here):
    detected = here / "walking.keypoints.npz"
    sizes = {"T": 90, "J": 33}
    optional = ("phone_time_s", "phone_quat_wxyz", "phone_clock_sd_s", "xyz_world_m", "origin", "frame")
    undocumented = check_fields(detected, "<name>.keypoints.npz", sizes, optional)
    assert undocumented <= {"root_relative"}  # named in the row of xyz_cam_m
    with np.load(detected) as f:
        assert f["time_s"][0] == 0
        np.testing.assert_allclose(np.diff(f["time_s"]), 1 / 30, atol=1e-3)
        assert f["image_size_px"].tolist() == [1200, 600]
        missing = np.isnan(f["xy_px"][..., 0])
        assert np.all(f["confidence"][missing] == 0)
        assert np.all((f["confidence"] >= 0) & (f["confidence"] <= 1))
        # Camera frame: y points down. The ankles are below the nose, by most of a body's height.
        names = f["names"].tolist()
        down = f["xyz_cam_m"][:, names.index("left_ankle"), 1] - f["xyz_cam_m"][:, names.index("nose"), 1]
        assert 1.2 < np.nanmedian(down) < 1.8


def test_the_fit_is_as_described(fitted):
    assert not check_fields(fitted, "<name>.fit.npz", {"T": 90, "J": 33, "40": 40}, ("sensors", "depth", "frame"))
    with np.load(fitted) as f:
        assert tuple(f["joint_names"].tolist()) == load_body().joint_names
        assert str(f["body_sha256"]) == load_body().sha256
        # One camera that does not turn, at the origin; her walk tells its vertical, a few degrees from a level one.
        quat = f["phone_quat_wxyz"]
        np.testing.assert_array_equal(quat, np.tile(quat[0], (90, 1)))
        assert np.degrees(2 * np.arccos(abs(quat[0] @ [0.5, -0.5, 0.5, -0.5]))) < 10
        assert f["camera_position_m"].tolist() == [0, 0, 0]
        assert str(f["orientation_source"]) == "estimated: gait"
        assert np.isnan(f["phone_clock_offset_s"])
        assert np.all(np.isfinite(f["qpos_sd"]) == np.isfinite(f["qpos"]))
        # World: z up, origin at the camera. She is some metres in front of it, her feet below her head.
        names = f["marker_names"].tolist()
        head, ankle = (f["markers_world_m"][:, names.index(n)] for n in ("nose", "left_ankle"))
        assert np.nanmin(head[:, 0]) > 2
        assert 1.2 < np.nanmedian(head[:, 2] - ankle[:, 2]) < 1.8
        # She walks to the left of the picture, which is world +y.
        assert np.nanmax(head[:, 1]) - np.nanmin(head[:, 1]) > 2
        assert head[np.isfinite(head[:, 1])][-1, 1] > head[np.isfinite(head[:, 1])][0, 1]


def test_angles_are_as_described(fitted):
    with (fitted.parent / "walking.angles.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    extra = ["knee_flexion_r", "knee_flexion_l"]
    assert [h for h in header if h not in extra] == ["time_s", *load_body().joint_names]
    assert set(extra) < set(header)
    assert len(rows) == 90
    with np.load(fitted) as f:
        middle = f["qpos"][45, f["joint_names"].tolist().index("knee_angle_r")]
    row = dict(zip(header, rows[45], strict=True))
    assert float(row["knee_angle_r"]) == pytest.approx(np.degrees(middle), abs=0.01)
    assert abs(float(row["knee_flexion_r"])) == pytest.approx(abs(np.degrees(middle)), abs=0.01)


def test_session_json_is_as_described(fitted):
    content = json.loads((fitted.parent / "session.json").read_text())
    described = section("session.json")
    assert content["trials"] == ["walking"]
    for word, key in {"solver": "solver", "hash": "params_hash", "scale": "scale", "device": "device"}.items():
        assert word in described
        assert content[key]
    assert (content["converged"], content["result"] in ("small_step", "small_gain")) == (True, True)
    assert content["loss_trace"][-1][0] == content["iterations"] > 1
    assert content["orientation_source"] == {"walking": "estimated: gait"}
    assert content["phone_clock_offset_s"] == {"walking": None}
    assert not [name for name in content if name not in described]
    assert content["seconds"] > 0
    assert all({"check", "outcome", "value", "threshold", "advice"} <= set(c) for c in content["qc"])


def test_events_of_the_fit_are_as_described(here):
    header, *rows = (here / "made" / "walking.events.csv").read_text().splitlines()
    assert re.search(r"`time_s, side \(left\|right\), event \(foot_down\|foot_up\), probability`", DOCS.read_text())
    assert header == "time_s,side,event,probability"
    downs = [r.split(",") for r in rows if ",foot_down," in r]
    # By eye, frames of this clip: left 4, right 23, left 41, right 60, left 78.
    assert [r[1] for r in downs] == ["left", "right", "left", "right", "left"]
    np.testing.assert_allclose([float(r[0]) for r in downs], np.array([4, 23, 41, 60, 78]) / 30, atol=0.1)
    assert all(r[1] in ("left", "right") and 0 <= float(r[3]) <= 1 for r in downs)


def test_events_of_the_keypoints_too(here):
    assert (here / "e.csv").read_text().count("foot_down") in (4, 5)


def test_metrics_are_as_described(here):
    content = json.loads((here / "metrics.json").read_text())
    measures = re.findall(r"`(\w+_(?:per_min|s|percent|per_s|m))`", section("metrics.json"))[:14]
    assert measures == list(MEASURES)
    for part in (content["session"], *content["trials"]):
        for name in measures:
            if part[name] is None:
                assert part["reasons"][name]
            else:
                assert {"left", "right", "mean", "sd", "n"} <= set(part[name])
        assert {"left", "right", "mean", "n", "norm"} <= set(part["gdi"])
        assert part["gdi"]["mean"] is not None or part["reasons"]["gdi"]
    assert all({"check", "outcome", "value", "threshold", "advice"} <= set(c) for c in content["session"]["qc"])
    # Three seconds of her walk: 98 steps/min by eye over the whole recording.
    assert content["session"]["cadence_steps_per_min"]["mean"] == pytest.approx(98, rel=0.06)


def test_the_fit_is_exported(here):
    paths = [Path(line) for line in (here / "exported").read_text().splitlines()]
    assert {f".{name}" for name in EXPORTS} <= {path.suffix for path in paths}
    assert all(path.is_relative_to(here / "exports") and path.stat().st_size for path in paths)


@pytest.mark.long
def test_run_of_the_installed_wheel_does_the_same_in_one(installed, fitted, walking, tmp_path):
    out = tmp_path / "Měření, früh"  # a letter that the encoding of the output lacks
    done = pbl("run", walking, "--out", out, "--subject", "P017", packages=installed)
    assert done.code == 0, done.err
    ends = ("keypoints.npz", "fit.npz", "angles.csv", "events.csv", "cycles.npz", "kinetics.npz", "overlay.mp4")
    written = {"report.html", "metrics.json", "kinetics.json", "session.json", *(f"walking.{end}" for end in ends)}
    assert {p.name for p in out.iterdir()} == written
    assert all(_shown(out / name) in done.out for name in written)
    assert "P017" in (out / "report.html").read_text()
    with np.load(fitted) as one, np.load(out / "walking.fit.npz") as other:
        assert str(one["params_hash"]) == str(other["params_hash"])
        np.testing.assert_allclose(one["qpos"], other["qpos"], atol=1e-4)


def _shown(path: Path) -> str:
    return str(path).encode(ENCODING, "backslashreplace").decode(ENCODING)
