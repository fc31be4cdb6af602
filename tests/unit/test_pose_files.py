"""2D keypoints of other programs: each format read to the same keypoints, what they lack, and what is refused."""

import csv
import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pbl_pipeline.body import load_body, marker_set
from pbl_pipeline.errors import PblError
from pbl_pipeline.fit import METHODS, RecordingFacts, read_keypoints
from pbl_pipeline.fit.lever_arms import OPEN_RAD, with_marker_places
from pbl_pipeline.fit.session import make_session
from pbl_pipeline.keypoints import Keypoints, WorldMarkers
from pbl_pipeline.keypoints.pose_files import read_poses
from pbl_pipeline.synthetic import plain_walk
from tests import Machine
from tests.command import pbl
from tests.videos import write_video
from tests.walker import CAMERA, SIZE, observe

HALPE = marker_set("halpe_26")
BODY_25 = (
    *(
        "nose",
        "neck",
        "right_shoulder",
        "right_elbow",
        "right_wrist",
        "left_shoulder",
        "left_elbow",
        "left_wrist",
        "hip",
    ),
    *("right_hip", "right_knee", "right_ankle", "left_hip", "left_knee", "left_ankle"),
    *("right_eye", "left_eye", "right_ear", "left_ear"),
    *("left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel"),
)
PARAMS = METHODS.find().params
WHOLE_BODY = (*HALPE.names[:17], *BODY_25[19:])
RATE, WIDTH, HEIGHT = 30.0, *SIZE
ALL = RecordingFacts(rate_hz=RATE, size_px=SIZE)


@functools.cache
def walk() -> Keypoints:
    """A walk from the side, with an empty frame, a missing point, and different confidences."""
    time = np.arange(90) / RATE
    seen = observe(plain_walk(time, stride_s=1.1, speed_m_per_s=1.2, start_m=(6.0, -1.8)), time, "halpe_26")
    confidence = np.random.default_rng(0).uniform(0.6, 1.0, seen.confidence.shape) * (seen.confidence > 0)
    confidence[20] = confidence[5, 3] = 0.0
    xy = np.where((confidence > 0)[..., None], seen.xy_px, np.nan)
    return dataclasses.replace(seen, xy_px=xy, confidence=confidence, xyz_cam_m=np.full_like(seen.xyz_cam_m, np.nan))


def points(names: tuple[str, ...] = HALPE.names) -> np.ndarray:
    """(T, J, 3) x, y, confidence of the walk, NaN where missing."""
    at = [HALPE.names.index(n) for n in names]
    return np.concatenate([walk().xy_px[:, at], walk().confidence[:, at, None]], axis=2)


def beside(px: float) -> np.ndarray:
    """The walk of another person, so many pixels to the right."""
    return np.add(points(), [px, 0.0, 0.0])


def openpose(folder: Path, *people: np.ndarray, first: int = 0, ids: tuple[int, ...] = ()) -> Path:
    """OpenPose's folder: missing is 0, 0, 0; a frame in which a person has no point lacks the person."""
    folder.mkdir()
    for t in range(len(people[0])):
        shown = [(i, np.where(p[t, :, 2:] > 0, p[t], 0.0)) for i, p in enumerate(people) if (p[t, :, 2] > 0).any()]
        shown = shown[:: 1 if t % 2 else -1]  # in any order
        content = [
            {"person_id": [ids[i] if ids else -1], "pose_keypoints_2d": p.ravel().tolist(), "face_keypoints_2d": []}
            for i, p in shown
        ]
        file = folder / f"walk_{first + t:012d}_keypoints.json"
        file.write_text(json.dumps({"version": 1.3, "people": content}))
    return folder


def dlc_columns(people: tuple[str, ...], names: tuple[str, ...]) -> list[tuple[str, ...]]:
    return [
        ("DLC_resnet50", *([p] if p else []), n, c) for p in people for n in names for c in ("x", "y", "likelihood")
    ]


def dlc_csv(path: Path, *people: np.ndarray, names: tuple[str, ...] = HALPE.names) -> Path:
    """DeepLabCut's table: empty where an individual is missing, else a likelihood near 0."""
    called = ("",) if len(people) == 1 else tuple(f"ind{i + 1}" for i in range(len(people)))
    columns = dlc_columns(called, names)
    levels = ("scorer", "bodyparts", "coords") if len(people) == 1 else ("scorer", "individuals", "bodyparts", "coords")
    table = np.concatenate([p.reshape(len(p), -1) for p in people], axis=1)
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerows([level, *(c[i] for c in columns)] for i, level in enumerate(levels))
        rows.writerows([t, *("" if np.isnan(v) else repr(float(v)) for v in row)] for t, row in enumerate(table))
    return path


def sleap(path: Path, *people: np.ndarray, reverse: bool = False) -> Path:
    h5py = pytest.importorskip("h5py")
    tracks = np.stack([np.moveaxis(p[..., :2], (0, 1, 2), (2, 1, 0)) for p in people])
    scores = np.stack([p[..., 2].T for p in people])
    with h5py.File(path, "w") as file:
        file["node_names"] = np.array(HALPE.names, "S")
        file["track_names"] = np.array([f"track_{i}" for i in range(len(people))], "S") if len(people) > 1 else []
        file["tracks"], file["point_scores"] = (tracks.T, scores.T) if reverse else (tracks, scores)
    return path


def dlc_h5_fixed(path: Path) -> Path:
    """As pandas writes it in the form "fixed" (movement, DeepLabCut's refined tracks)."""
    h5py = pytest.importorskip("h5py")
    columns = dlc_columns(("",), HALPE.names)
    with h5py.File(path, "w") as file:
        group = file.create_group("df_with_missing")
        group.attrs["pandas_type"] = b"frame"
        group["axis1"], group["block0_values"] = np.arange(90), points().reshape(90, -1)
        for i in range(3):
            texts = sorted({c[i] for c in columns})
            group[f"block0_items_level{i}"] = np.array(texts, "S")
            group[f"block0_items_label{i}"] = np.array([texts.index(c[i]) for c in columns], np.int8)
    return path


def dlc_h5_table(path: Path) -> Path:
    """As pandas writes it in the form "table" (DeepLabCut's results of a video): names as a pickle of protocol 0."""
    import pickle

    h5py = pytest.importorskip("h5py")
    table = np.zeros(90, [("index", "<i8"), ("values_block_0", "<f8", (78,))])
    table["index"], table["values_block_0"] = np.arange(90), points().reshape(90, -1)
    with h5py.File(path, "w") as file:
        group = file.create_group("tracks")
        group.attrs["pandas_type"] = b"frame_table"
        data = group.create_dataset("table", data=table)
        data.attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(dlc_columns(("",), HALPE.names), 0))
    return path


def trc(path: Path, xy: np.ndarray, first: int = 0) -> Path:
    """As Sports2D writes it: metres in the header, pixels, y down, z 0, empty cells."""
    names = [{n: o for o, n in HALPE.also.items()}[n] for n in HALPE.names]
    n, j = xy.shape[:2]
    cells = np.concatenate([xy, np.zeros((n, j, 1))], axis=2).reshape(n, -1)
    lines = [
        f"PathFileType\t4\t(X/Y/Z)\t{path}",
        "DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames",
        f"30\t30\t{n}\t{j}\tm\t30\t0\t{n}",
        "Frame#\tTime\t" + "\t\t\t".join(names) + "\t\t\t",
        "\t\t" + "\t".join(f"X{i}\tY{i}\tZ{i}" for i in range(1, j + 1)),
    ]
    for t, row in enumerate(cells):
        numbers = "\t".join("" if np.isnan(v) else repr(float(v)) for v in row)
        lines.append(f"{t}\t{(first + t) / RATE!r}\t{numbers}")
    path.write_text("\n".join(lines) + "\n")
    return path


FORMATS: dict[str, Callable[[Path], Path]] = {
    "BODY_25": lambda p: openpose(p / "json", points(BODY_25)),
    "Halpe": lambda p: openpose(p / "json", points(), first=1000),
    "COCO": lambda p: openpose(p / "json", points(HALPE.names[:17])),
    "whole body": lambda p: openpose(p / "json", np.pad(points(WHOLE_BODY), ((0, 0), (0, 110), (0, 0)))),
    "csv": lambda p: dlc_csv(p / "walkDLC.csv", points()),
    "csv of several": lambda p: dlc_csv(p / "walkDLC.csv", np.full_like(points(), np.nan), points()),
    "h5 fixed": lambda p: dlc_h5_fixed(p / "walkDLC.h5"),
    "h5 table": lambda p: dlc_h5_table(p / "walkDLC.h5"),
    "SLEAP": lambda p: sleap(p / "walk.analysis.h5", points()),
    "SLEAP, reversed": lambda p: sleap(p / "walk.analysis.h5", points(), reverse=True),
    "trc": lambda p: trc(p / "walk_Sports2D_px_person00.trc", walk().xy_px),
}


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_is_read_to_the_same_keypoints(tmp_path: Path, name: str):
    found, text = read_keypoints(FORMATS[name](tmp_path), ALL)
    has = np.isin(
        HALPE.names, {"BODY_25": BODY_25, "COCO": HALPE.names[:17], "whole body": WHOLE_BODY}.get(name, HALPE.names)
    )
    assert found.names == HALPE.names
    assert found.marker_set == "halpe_26"
    assert f"{has.sum()} of 26 points of halpe_26" in text
    start = 1000 / RATE if name == "Halpe" else 0.0
    assert found.time_s - start == pytest.approx(walk().time_s, abs=1e-9)
    assert found.xy_px[:, has] == pytest.approx(walk().xy_px[:, has], abs=1e-6, nan_ok=True)
    confidence = np.sign(walk().confidence) if name == "trc" else walk().confidence
    assert found.confidence == pytest.approx(confidence * has, abs=1e-6)
    assert np.isnan(found.xyz_cam_m).all()
    assert found.image_size_px == SIZE
    assert found.camera.source.startswith("guess")


def test_the_video_gives_times_and_size(tmp_path: Path):
    pictures = (np.full((270, 480, 3), t, np.uint8) for t in range(95))
    video = write_video(tmp_path / "v.mp4", pictures, np.arange(95) / 29.97)
    found, _ = read_keypoints(trc(tmp_path / "walk_px.trc", walk().xy_px / 4, first=5), RecordingFacts(video=video))
    assert found.time_s == pytest.approx((5 + np.arange(90)) / 29.97, abs=1e-3)
    assert found.image_size_px == (480, 270)
    with pytest.raises(PblError, match="frames 6 to 95, v"):
        read_keypoints(openpose(tmp_path / "json", points(), first=6), RecordingFacts(video=video))
    with pytest.raises(PblError, match="a video together with a rate or a size"):
        read_keypoints(tmp_path / "json", RecordingFacts(video=video, rate_hz=RATE))


def test_missing_files_are_empty_frames_and_every_second_frame_is_half_the_rate(tmp_path: Path):
    folder = openpose(tmp_path / "json", points())
    for t in (3, 4, 50):
        (folder / f"walk_{t:012d}_keypoints.json").unlink()
    found, _ = read_keypoints(folder, ALL)
    assert len(found.time_s) == 90
    assert np.flatnonzero(~(found.confidence > 0).any(axis=1)).tolist() == [3, 4, 20, 50]
    for t in range(1, 90, 2):
        (folder / f"walk_{t:012d}_keypoints.json").unlink(missing_ok=True)
    assert np.diff(read_keypoints(folder, ALL)[0].time_s) == pytest.approx(2 / RATE)


def test_people_are_followed_though_their_order_changes(tmp_path: Path):
    other = beside(400.0)
    folder = openpose(tmp_path / "json", points(), other)
    with pytest.raises(PblError) as error:
        read_keypoints(folder, ALL)
    assert "people 1 (frames 0 to 89), 2 (frames 0 to 89)" in error.value.found
    both = [read_keypoints(folder, dataclasses.replace(ALL, size_px=(3000, 1080), person=p))[0].xy_px for p in "12"]
    assert sorted(float(np.nanmean(x[..., 0])) for x in both) == pytest.approx(
        [np.nanmean(p[..., 0]) for p in (points(), other)]
    )
    assert read_poses(openpose(tmp_path / "tracked", points(), other, ids=(7, 4)), RATE).people == ("4", "7")
    with pytest.raises(PblError, match="'9' is none"):
        read_keypoints(folder, dataclasses.replace(ALL, person="9"))


def test_a_passer_by_of_a_second_needs_no_choice(tmp_path: Path):
    short = beside(400.0)
    short[25:] = np.nan
    found, _ = read_keypoints(openpose(tmp_path / "json", points(), short), ALL)
    assert found.xy_px == pytest.approx(walk().xy_px, abs=1e-6, nan_ok=True)


def test_individuals_are_refused_by_name(tmp_path: Path):
    other = beside(40.0)
    file = dlc_csv(tmp_path / "a.csv", points(), other)
    with pytest.raises(PblError) as error:
        read_keypoints(file, ALL)
    assert error.value.code == "USAGE"
    assert error.value.found == "people ind1 (frames 0 to 89), ind2 (frames 0 to 89)"
    found, _ = read_keypoints(file, dataclasses.replace(ALL, person="ind2"))
    assert np.nanmean(found.xy_px[..., 0]) == pytest.approx(np.nanmean(other[..., 0]))


def changed(**changes: Any) -> RecordingFacts:
    return dataclasses.replace(ALL, **changes)


REFUSED: dict[str, tuple[Callable[[Path], Path], RecordingFacts, str, str]] = {
    "no rate": (FORMATS["csv"], changed(rate_hz=None), "USAGE", "no frame rate"),
    "no size": (FORMATS["csv"], changed(size_px=None), "USAGE", "no size of the picture"),
    "another rate than the file's": (FORMATS["trc"], changed(rate_hz=60.0), "USAGE", "60 frames a second, 30 in the"),
    "frame numbers as seconds": (FORMATS["csv"], changed(rate_hz=1.0), "FIT_INPUT", "1 s from frame to frame"),
    "a rate ten times too high": (FORMATS["csv"], changed(rate_hz=300.0), "FIT_INPUT", "strides of"),
    "a smaller picture": (
        FORMATS["csv"],
        changed(size_px=(1280, 720)),
        "FIT_INPUT",
        "of the points outside the picture",
    ),
    "y up": (
        lambda p: dlc_csv(p / "a.csv", points() * [1, -1, 1] + [0, HEIGHT - 1, 0]),
        ALL,
        "FIT_INPUT",
        "upside down: y points up",
    ),
    "negative y": (lambda p: dlc_csv(p / "a.csv", points() * [1, -1, 1]), ALL, "FIT_INPUT", "upside down: y points up"),
    "turned": (lambda p: dlc_csv(p / "a.csv", points()[..., [1, 0, 2]]), ALL, "FIT_INPUT", "turned by 90 deg"),
    "fractions": (
        lambda p: openpose(p / "json", points() / [WIDTH, HEIGHT, 1]),
        ALL,
        "FIT_INPUT",
        "a body of 0.",
    ),
    "unknown points": (
        lambda p: dlc_csv(p / "a.csv", points(), names=tuple(f"p{i}" for i in range(26))),
        ALL,
        "MARKER_SET_UNKNOWN",
        "points p0, p1",
    ),
    "points of another number": (
        lambda p: openpose(p / "json", points(HALPE.names[:16])),
        ALL,
        "FILE_FORMAT",
        "16 points",
    ),
    "BODY_25B unnamed": (
        lambda p: openpose(p / "json", points(tuple(n for n in HALPE.names if n != "hip"))),
        ALL,
        "FILE_FORMAT",
        "25 points in another order than BODY_25's",
    ),
    "an empty folder": (lambda p: p, ALL, "FILE_FORMAT", "0 JSON files"),
    "nobody": (lambda p: openpose(p / "json", np.full((5, 26, 3), 0.0)), ALL, "FILE_FORMAT", "no person in any frame"),
    "a csv of another kind": (
        lambda p: trc(p / "a.csv", walk().xy_px),
        ALL,
        "FILE_FORMAT",
        "lines that begin with PathFileType",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_refused(tmp_path: Path, name: str):
    write, recording, code, found = REFUSED[name]
    with pytest.raises(PblError) as error:
        read_keypoints(write(tmp_path), recording)
    assert error.value.code == code
    assert found in error.value.found
    assert error.value.next_step


def test_body_25b_needs_its_name(tmp_path: Path):
    table = marker_set("body25b")
    folder = openpose(tmp_path / "json", points(tuple(HALPE.also[n] for n in table.names)))
    found, _ = read_keypoints(folder, ALL, table)
    knee = table.names.index("LKnee")
    assert found.xy_px[:, knee] == pytest.approx(points(("left_knee",))[:, 0, :2], abs=1e-6, nan_ok=True)


def test_a_trc_of_pixels_is_no_trc_of_metres(tmp_path: Path):
    with pytest.raises(PblError) as error:
        WorldMarkers.from_trc(trc(tmp_path / "walk.trc", walk().xy_px), "halpe_26")
    assert "_px in the file's name" in error.value.expected


def test_arrays_in_another_order_are_packed_without_nan():
    """A view of a transposed array is a copy when it is reshaped."""
    seen = walk()
    turned = dataclasses.replace(
        seen, xy_px=np.asfortranarray(seen.xy_px), confidence=np.asfortranarray(seen.confidence)
    )
    arrays = make_session([turned], ["a"], PARAMS).arrays[0]
    assert np.isfinite(arrays.xy_px).all()


@dataclasses.dataclass
class Solved:
    qpos: np.ndarray
    qpos_sd: np.ndarray
    scale: np.ndarray


def test_an_ankle_without_a_point_on_the_foot_is_open():
    joints = list(load_body().joint_names)
    for n_points, is_open in ((26, False), (17, True)):
        confidence = walk().confidence * (np.arange(26) < n_points)
        xy = np.where(confidence[..., None] > 0, walk().xy_px, np.nan)
        session = make_session([dataclasses.replace(walk(), confidence=confidence, xy_px=xy)], ["a"], PARAMS)
        solved: Any = Solved(np.zeros((90, 40)), np.full((90, 40), 0.01), np.ones(8))
        sd = with_marker_places(session, solved, PARAMS).qpos_sd
        assert sd is not None
        assert (sd[0, joints.index("ankle_angle_r")] >= OPEN_RAD) == is_open
        assert sd[0, joints.index("knee_angle_r")] < OPEN_RAD


def test_an_h5_without_its_package_names_the_extra(tmp_path: Path, machine: Machine):
    (tmp_path / "a.h5").write_bytes(b"")
    machine(without=["h5py"])
    with pytest.raises(PblError, match=r"pbl-pipeline\[h5\]"):
        read_keypoints(tmp_path / "a.h5", ALL)


@pytest.mark.parametrize(
    ("options", "found"),
    [
        (("--video", "a.mp4", "--video", "b.mp4"), "--video 2 times, 1 files"),
        (("--fps", "-30"), "--fps -30"),
        (("--fps", "30", "--width", "640"), "no size of the picture"),
    ],
)
def test_options_that_do_not_fit(tmp_path: Path, options: tuple[str, ...], found: str):
    done = pbl("fit", dlc_csv(tmp_path / "a.csv", points()), "--out", tmp_path / "out", *options)
    assert done.error_code == "USAGE"
    assert found in done.err


@pytest.mark.needs_extra
@pytest.mark.parametrize("people", [1, 2])
def test_what_movement_writes_is_read(tmp_path: Path, people: int):
    load: Any = pytest.importorskip("movement.io.load_poses")
    save: Any = pytest.importorskip("movement.io.save_poses")
    position = np.stack([np.add(np.moveaxis(points()[..., :2], 1, 2), [[0], [i]]) for i in range(people)], axis=-1)
    confidence = np.stack([points()[..., 2]] * people, axis=-1)
    individuals, names = ["P017", "therapist"][:people], list(HALPE.names)
    poses = load.from_numpy(position, confidence, individual_names=individuals, keypoint_names=names, fps=RATE)
    for file in ("a.csv", "a.h5"):
        save.to_dlc_file(poses, tmp_path / file, split_individuals=False)
    save.to_sleap_analysis_file(poses, tmp_path / "b.h5")
    for file in ("a.csv", "a.h5", "b.h5"):
        found, _ = read_keypoints(tmp_path / file, dataclasses.replace(ALL, person="P017"))
        assert found.xy_px == pytest.approx(walk().xy_px, abs=1e-4, nan_ok=True)
        assert found.confidence == pytest.approx(walk().confidence, abs=1e-6)


@pytest.mark.long
def test_a_folder_of_openpose_becomes_angles_and_gait(tmp_path: Path):
    time = np.arange(180) / RATE
    truth = plain_walk(time, stride_s=1.1, speed_m_per_s=1.0, start_m=(7.0, -3.0))
    seen = observe(truth, time, "halpe_26")
    at = [HALPE.names.index(n) for n in BODY_25]
    openpose(tmp_path / "walk_json", np.concatenate([seen.xy_px, 0.9 * seen.confidence[..., None]], axis=2)[:, at])
    camera = {"camera_matrix": CAMERA.matrix.tolist(), "distortion": [0.0] * 5, "image_size_px": SIZE}
    (tmp_path / "camera.json").write_text(json.dumps(camera))
    size = ("--fps", RATE, "--width", WIDTH, "--height", HEIGHT, "--camera", tmp_path / "camera.json")
    done = pbl("fit", tmp_path / "walk_json", "--out", tmp_path / "out", *size)
    assert done.code == 0, done.err
    fit = np.load(tmp_path / "out" / "walk_json.fit.npz")
    joints = fit["joint_names"].tolist()
    for name in ("hip_flexion", "knee_angle", "ankle_angle"):
        for side in "rl":
            i = joints.index(f"{name}_{side}")
            assert np.degrees(np.nanmean(np.abs(fit["qpos"][:, i] - truth[:, i]))) < 3.5
    done = pbl("gait", tmp_path / "out" / "walk_json.fit.npz", "--out", tmp_path / "metrics.json")
    assert done.code == 0, done.err
    cadence = json.loads((tmp_path / "metrics.json").read_text())["session"]["cadence_steps_per_min"]
    assert cadence["mean"] == pytest.approx(120 / 1.1, rel=0.03)
