"""One sound file of each kind that is read, and what the commands do with it: for `mutated`."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np

from pbl_pipeline.body import joint_angles, load_body, load_marker_set
from pbl_pipeline.files import sha256_of
from tests.inputs import CALIBRATION, csv_log
from tests.walking_fit import walking_fit

N, FPS = 90, 30.0
SIZE_PX = (1920, 1080)


@functools.cache
def _fit():
    body = load_body()
    return walking_fit(body.joint_names, body.sha256, n_frames=N, fps=FPS)


@functools.cache
def _synthetic():
    from pbl_pipeline.synthetic import SynthSpec, synthesise

    return synthesise(SynthSpec(seconds=3.0, marker_set="blazepose_33", camera="panned"))


# --------------------------------------------------------------------------------------------------------------- videos
def video(path: Path) -> None:
    from tests.videos import constant_rate, numbered_frames, write_video

    codec = {".mp4": "libx264", ".webm": "libvpx", ".avi": "mpeg4"}[path.suffix]
    write_video(
        path, numbered_frames(12), constant_rate(12), codec, ticks_per_s=30 if path.suffix == ".avi" else 90_000
    )


def phone_video(path: Path) -> None:
    from tests.quicktime import MILLISECONDS, edit_list, insert, meta
    from tests.videos import constant_rate, numbered_frames, write_video

    write_video(
        path, numbered_frames(12), constant_rate(12), rotation_deg=90, b_frames=2, container_options=MILLISECONDS
    )
    tags = {"com.apple.quicktime.camera.focal_length.35mm_equivalent": 27, "com.apple.quicktime.camera.lens_model": "x"}
    insert(path, of_track=meta(tags), of_file=meta({"com.apple.quicktime.model": "iPhone 13"}))
    insert(path, of_track=edit_list([(400, 0, 1.0)]))


def use_video(path: Path) -> None:
    from pbl_pipeline.video import check_timing, find_camera, phone_lens, probe, read_first, read_frames

    read_first(path)
    info = probe(path)
    check_timing(info)
    phone_lens(info)
    find_camera(info)
    for frame in read_frames(path, step=5):
        assert frame.image.shape[:2] == (info.height_px, info.width_px)


# ------------------------------------------------------------------------------------------------ keypoints and markers
def keypoints(path: Path) -> None:
    _synthetic().keypoints.save(path)


def use_keypoints(path: Path) -> None:
    from pbl_pipeline.fit import check_trial
    from pbl_pipeline.gait import detect_events, feet_from_keypoints
    from pbl_pipeline.keypoints import Keypoints, check_keypoints, visibility

    found = Keypoints.load(path)
    check_keypoints(found)
    visibility(found)
    check_trial(found, "walk")
    _pack(found)
    detect_events(feet_from_keypoints(found), "zeni-2008")


def _pack(trial: Any) -> None:
    """Prepare a fit up to its solution."""
    from pbl_pipeline.fit import METHODS
    from pbl_pipeline.fit.session import make_session

    motion = "handheld" if getattr(trial, "phone_time_s", None) is not None else "static"
    make_session([trial], ["walk"], METHODS.find(None).params, [motion])


def markers(path: Path) -> None:
    from pbl_pipeline.body import marker_set
    from pbl_pipeline.keypoints import WorldMarkers

    truth = _synthetic().truth
    seen = np.ones(truth.markers_world_m.shape[:2])
    WorldMarkers(truth.time_s, marker_set("blazepose_33").names, "blazepose_33", truth.markers_world_m, seen).save(path)


def use_markers(path: Path) -> None:
    from pbl_pipeline.fit import check_trial
    from pbl_pipeline.gait import detect_events, feet_from_markers
    from pbl_pipeline.keypoints import WorldMarkers

    seen = WorldMarkers.load(path)
    check_trial(seen, "walk", "markers")
    _pack(seen)
    feet = feet_from_markers(seen.time_s, seen.names, seen.marker_set, seen.xyz_world_m, seen.confidence)
    detect_events(feet, "oconnor-2007")


def trc(path: Path) -> None:
    rows = []
    for i in range(60):
        points = [100.0 + i, 900.0, 200.0, 110.0 + i, 1600.0, 210.0]
        rows.append("\t".join(map(str, [i + 1, round(i / 100, 2), *points])))
    from tests.inputs import trc_text

    path.write_text(trc_text(rows))


def use_trc(path: Path) -> None:
    from pbl_pipeline.keypoints import WorldMarkers

    WorldMarkers.from_trc(path, "lab").select(["Hip", "Head"])


def pose_table(path: Path) -> None:
    seen = _synthetic().keypoints
    values = np.concatenate([seen.xy_px, seen.confidence[..., None]], axis=2).reshape(len(seen.time_s), -1)
    columns = [("dlc", n, c) for n in seen.names for c in ("x", "y", "likelihood")]
    heads = [",".join([h, *(c[i] for c in columns)]) for i, h in enumerate(("scorer", "bodyparts", "coords"))]
    rows = [",".join([str(t), *("" if np.isnan(v) else f"{v:.2f}" for v in row)]) for t, row in enumerate(values)]
    path.write_text("\n".join([*heads, *rows]) + "\n")


def use_poses(path: Path) -> None:
    from pbl_pipeline.fit import RecordingFacts, read_keypoints

    read_keypoints(path, RecordingFacts(rate_hz=FPS, size_px=_synthetic().keypoints.image_size_px))


def marker_set(path: Path) -> None:
    names = ["name,body,x,y,z,weight_3d", *(f"m{i},{b},0.01,0.0{i},0,1" for i, b in enumerate(["pelvis", "femur_r"]))]
    path.write_text("\n".join(["# a table", *names]) + "\n")


def use_marker_set(path: Path) -> None:
    load_marker_set(path)


# ------------------------------------------------------------------------------------------- fits, truths, references
def fit(path: Path) -> None:
    _fit().save(path)


def use_fit(path: Path) -> None:
    from pbl_pipeline.export import write_angles_csv
    from pbl_pipeline.fit import TrialFit
    from pbl_pipeline.gait import gait_metrics
    from pbl_pipeline.validation import compare

    found = TrialFit.load(path)
    metrics = gait_metrics([found])
    metrics.table()
    metrics.save(path.with_suffix(".json"))
    write_angles_csv(found, path.with_suffix(".csv"))
    compare(found, _reference())
    use_reference(path)


def truth(path: Path) -> None:
    _synthetic().truth.save(path)


@functools.cache
def _reference():
    from pbl_pipeline.validation import QPOS, Reference

    found = _fit()
    angles = joint_angles(found.joint_names, found.qpos)
    kept = {n: angles[n] for n in ("knee_flexion_r", "knee_flexion_l", "hip_flexion_r", "pelvis_tilt")}
    return Reference("walk", "synthetic", QPOS, found.time_s, kept, np.zeros((N, 3)))


def reference(path: Path) -> None:
    _reference().save(path)


def use_reference(path: Path) -> None:
    from pbl_pipeline.validation import QPOS, compare
    from pbl_schemas.intake.references import read_reference

    found = read_reference(path)
    if found.convention == QPOS:
        compare(_fit(), found)


def mot(path: Path) -> None:
    names = ["time", "knee_angle_r", "knee_angle_l", "hip_flexion_r", "pelvis_tx", "pelvis_ty", "pelvis_tz"]
    rows = [[i / FPS, -20 - 15 * np.sin(i), -20 + 15 * np.sin(i), 5.0, i / FPS, 0.9, 0.0] for i in range(N)]
    lines = [
        "Coordinates",
        "inDegrees=yes",
        "endheader",
        " ".join(names),
        *(" ".join(f"{v:.4f}" for v in r) for r in rows),
    ]
    path.write_text("\n".join(lines) + "\n")


def bodies(path: Path) -> None:
    import gzip

    names = ("pelvis", "femur_r", "tibia_r", "talus_r", "calcn_r", "femur_l", "tibia_l", "talus_l", "calcn_l", "torso")
    one = {"rotation": [[0.1, 0.2, 0.01 * i] for i in range(N)], "translation": [[0.0, 1.0, i / FPS] for i in range(N)]}
    text = json.dumps({"time": [i / FPS for i in range(N)], "bodies": dict.fromkeys(names, one)})
    path.write_bytes(gzip.compress(text.encode()) if path.suffix == ".gz" else text.encode())


# ------------------------------------------------------------------------------------------------------- laboratories
def c3d(path: Path) -> None:
    import gzip
    import io

    import c3d as package

    from pbl_pipeline.gait import PLUG_IN_GAIT_POINTS

    points = dict.fromkeys(side + p for p, _ in PLUG_IN_GAIT_POINTS.values() for side in "LR")
    places = {"ASI": (100, 950), "HEE": (-50, 50), "TOE": (150, 40), "KNE": (50, 500), "ANK": (0, 100)}
    names = [*points, *(side + m for m in places for side in "LR")]
    writer = package.Writer(point_rate=100.0, analog_rate=100.0)
    writer.set_point_labels(names)
    for i in range(120):
        frame = np.zeros((len(names), 5))
        frame[:, :3] = 20 + 15 * np.sin(i / 15 + np.arange(3 * len(names)).reshape(-1, 3))
        for k, n in enumerate(names):
            if n[1:] in places:
                x, z = places[n[1:]]
                swing = 250 * np.sin(i / 17 + (np.pi if n[0] == "L" else 0)) * (z < 600)
                frame[k, :3] = [x + 12 * i + swing, 100 if n[0] == "L" else -100, z]
        writer.add_frames([(frame, np.zeros((0, 1)))])
    out = io.BytesIO()
    writer.write(out)
    path.write_bytes(gzip.compress(out.getvalue()) if path.suffix == ".gz" else out.getvalue())


def use_c3d(path: Path) -> None:
    from pbl_pipeline.gait import GILLETTE_MODEL, detect_events, gait_metrics, read_lab_feet, read_lab_trial

    detect_events(read_lab_feet(path), "zeni-2008")
    gait_metrics([read_lab_trial(path, method="zeni-2008")], model=GILLETTE_MODEL)


def events(path: Path) -> None:
    rows = [f"{i / 4:.3f},{'left' if i % 2 else 'right'},foot_{'down' if i % 4 < 2 else 'up'},0.9" for i in range(20)]
    path.write_text("\n".join(["time_s,side,event,probability", *rows]) + "\n")


def use_events(path: Path) -> None:
    from pbl_pipeline.gait import load_events

    load_events(path)


# --------------------------------------------------------------------------------------------------- cameras and phones
def camera(path: Path) -> None:
    content = {
        "camera_matrix": [[1500, 0, 960], [0, 1500, 540], [0, 0, 1]],
        "distortion": [0.1, -0.2, 0.001, 0.001, 0.05],
        "image_size_px": list(SIZE_PX),
        "focal_sd_px": 3.0,
        "phone": {"make": "Apple", "model": "iPhone 13", "lens": "back", "focal_35mm": 27.0, "rate": 30},
        "video": {"name": "a.mov", "sha256": "0" * 64, "rotation_deg": 90},
    }
    path.write_text(json.dumps(content))


def use_camera(path: Path) -> None:
    from pbl_pipeline.video import FirstPicture, calibrated_camera, load_camera, load_lens_calibration

    load_camera(path, SIZE_PX)
    load_lens_calibration(path)
    calibrated_camera(path, FirstPicture("a.mov", 1080, 1920, 0, "Apple", "iPhone 13", "back", 27.0))


def cameras(path: Path) -> None:
    path.write_text(CALIBRATION)


def use_cameras(path: Path) -> None:
    from pbl_pipeline.keypoints import cameras_of_files
    from pbl_pipeline.video import load_camera, load_camera_poses

    load_camera_poses(path)
    cameras_of_files(["walk.cam_01", "walk.cam_02"], path)
    load_camera(path, (1000, 1000), "cam_01")


def log(path: Path) -> None:
    csv_log(path, [0.5, -0.5, 0.5, -0.5], {"ax": 0.0, "ay": 9.81, "az": 0.0, "start_utc": "2026-03-01T09:15:30Z"}, n=60)


def log_json(path: Path) -> None:
    time_s = [round(0.02 * i, 3) for i in range(60)]
    content = {name: [value] * 60 for name, value in zip(("qw", "qx", "qy", "qz"), (0.5, -0.5, 0.5, -0.5), strict=True)}
    gravity = {"time_s": time_s, "x": [0.0] * 60, "y": [9.81] * 60, "z": [0.0] * 60}
    more = {"frame": "camera", "start_utc": "2026-03-01T09:15:30Z", "phone": {"make": "A", "model": "B"}}
    path.write_text(json.dumps({"time_s": time_s, **content, "accelerometer": gravity, **more}))


def sensor_logger(path: Path) -> None:
    import tempfile

    from tests.phone_film import as_zip
    from tests.phone_film import sensor_logger as export

    with tempfile.TemporaryDirectory() as folder:
        as_zip(export(Path(folder) / "walk", 0.6)).replace(path)


def use_log(path: Path) -> None:
    from pbl_pipeline.video import load_attitude

    load_attitude(path)


# ------------------------------------------------------------------------------------------------- parameters and norms
def params(path: Path) -> None:
    path.write_text(json.dumps({"base": "blazepose", "max_iterations": 20, "cost": {"weight_2d": 0.05}}))


def use_params(path: Path) -> None:
    from pbl_pipeline.cli.options import fit_paramset

    method = fit_paramset(None, str(path))
    assert method.hash
    method.paramset.canonical_json.encode()


def norm(path: Path) -> None:
    from pbl_pipeline.gait import load_norm

    load_norm().save(path)


def use_norm(path: Path) -> None:
    from pbl_pipeline.gait import gait_metrics, load_norm

    metrics = gait_metrics([_fit()], load_norm(str(path)))
    metrics.table()


def session(path: Path) -> None:
    from pbl_pipeline.qc import WARN, Check
    from pbl_pipeline.visit import Recording, Solution, Visit, save_visit

    fit, trace = _fit(), np.array([[0.0, 99.0], [100.0, 9.0]])
    solution = Solution(fit.solver, fit.params_hash, 7, True, fit.scale, trace, 31.2, 12.0, "cpu")
    check = Check("residual_3d_cm", WARN, 7.0, 6.0, "see")
    folder = path.parent / "visit"
    save_visit(Visit((Recording.of(fit.name, fit),), solution, (check,)), folder)
    (folder / "session.json").replace(path)


def use_session(path: Path) -> None:
    from pbl_pipeline.pipeline import measured
    from pbl_pipeline.visit import save_visit, visit_of_fits

    if path.name != "session.json":
        path = path.rename(path.with_name("session.json"))
    fit = path.with_name(f"{_fit().name}.fit.npz")
    _fit().save(fit)
    visit = measured(visit_of_fits([fit], measures=False))
    save_visit(visit, path.parent / "again")


def model(path: Path) -> None:
    from tests import dot_models

    folder = dot_models.write(path.parent / "dots", _graph(), dot_models.spec("crop3d", (64, 64)))
    path.write_bytes((folder / "model.json").read_bytes())


@functools.cache
def _graph():
    from tests import dot_models

    return dot_models.crop3d(dot_models.person(), (64, 64))


def use_model(path: Path) -> None:
    from pbl_pipeline.models import load_spec

    folder = path.parent / "spec"
    folder.mkdir(exist_ok=True)
    (folder / "model.json").write_bytes(path.read_bytes())
    load_spec(folder)


# --------------------------------------------------------------------------------------------- sheets, studies, backups
ROWS = [
    ["subject", "visit", "date", "role", "mJOA", "TUG", "note"],
    *(
        [f"P{i:03}", "pre", f"2026-01-{i + 1:02}", "pre", 12 + i % 5, 9.25, "a, b" if i % 3 else None]
        for i in range(20)
    ),
]


def workbook(path: Path) -> None:
    import datetime

    from openpyxl import Workbook

    made = Workbook()
    page = made.active
    assert page is not None
    for row in ROWS:
        page.append([datetime.date.fromisoformat(c) if str(c).startswith("2026-") else c for c in row])
    made.create_sheet("scores").append(["subject", "visit"])
    made.save(path)


def sheet(path: Path) -> None:
    import csv

    with path.open("w", newline="") as file:
        csv.writer(file, delimiter=";" if "semi" in path.name else ",", lineterminator="\n").writerows(ROWS)


def use_sheets(path: Path) -> None:
    """Read sheets in this process, whose memory is measured; the commands read a workbook in another one with
    limits."""
    from unittest import mock

    from pbl_pipeline.errors import PblError
    from pbl_schemas.intake import sheets

    def here(function: Any, *args: Any, **_: object) -> object:
        return function(*args)

    with mock.patch.object(sheets, "limited", here):
        found = sheets.read_sheets(path)
    for page in found:
        page.plain_names()
        for row in page.rows:
            for column in row.cells:
                for read in (sheets.date_of, lambda r, c: sheets.number_of(r, c, r.cells[c])):
                    try:
                        read(row, column)
                    except PblError as error:
                        error.text().encode()


def _study_file(path: Path, name: str) -> None:
    from pbl_pipeline.study import write_study
    from tests.unit.test_study_folder import small_study

    folder = path.parent / "sound-study"
    write_study(small_study(), folder)
    about = json.loads((folder / "study.json").read_text())
    del about["files"]
    (folder / "study.json").write_text(json.dumps(about))
    path.write_bytes((folder / name).read_bytes())


def study_visits(path: Path) -> None:
    _study_file(path, "visits.csv")


def study_scores(path: Path) -> None:
    _study_file(path, "scores.csv")


def study_about(path: Path) -> None:
    _study_file(path, "study.json")


def use_study(path: Path) -> None:
    import shutil

    from pbl_pipeline.study import content_hash, data_dictionary, deidentified, read_study, write_study

    folder = path.parent / "study"
    shutil.copytree(path.parent / "sound-study", folder, dirs_exist_ok=True)
    name = path.name.removeprefix("sound-").removeprefix("study.") if path.suffix == ".csv" else "study.json"
    (folder / name).write_bytes(path.read_bytes())
    study = read_study(folder)
    content_hash(study)
    data_dictionary(study)
    write_study(deidentified(study)[0], path.parent / "again")


def manifest(path: Path) -> None:
    from pbl_schemas.operations import backup

    content = {"format": backup.FORMAT, "created": "2026-01-01", "server": "x", "prefix": "pbl", "rows": {"a": 1}}
    path.write_text(json.dumps(content | {"store": True, "n_files": 0, "n_bytes": 0, "sha256": {}}))


def use_manifest(path: Path) -> None:
    from pbl_schemas.operations import backup

    folder = path.parent / "backup"
    folder.mkdir(exist_ok=True)
    (folder / "manifest.json").write_bytes(path.read_bytes())
    backup.check(folder)


def listing(path: Path) -> None:
    path.write_text("".join(f"{'0' * 63}{i}  pbl/walk_{i}.npz\n" for i in range(9)))


def use_listing(path: Path) -> None:
    """The files of a backup by their checksums; none of them is there."""
    from pbl_pipeline.errors import PblError
    from pbl_schemas.operations import backup

    folder = path.parent / "listed"
    folder.mkdir(exist_ok=True)
    (folder / "store.sha256").write_bytes(path.read_bytes())
    manifest(folder / "manifest.json")
    about = json.loads((folder / "manifest.json").read_text())
    about["sha256"] = {"store.sha256": sha256_of(folder / "store.sha256")}
    (folder / "manifest.json").write_text(json.dumps(about))
    try:
        backup.check(folder)
    except PblError as error:
        if "9 files are missing" not in error.found:
            raise


def forgotten(path: Path) -> None:
    ids = {"videos": [1, 2], "sessions": [1], "sha256": ["0" * 64]}
    path.write_text(json.dumps({"subject": "P001", "ids": ids, "state": "begun", "files": ["a/b.npz"], "videos": []}))


def use_forgotten(path: Path) -> None:
    from pbl_pipeline import settings
    from pbl_schemas.operations import forget

    with settings_at(path.parent):
        place = settings.home_dir() / "forgotten" / "P001.json"
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes(path.read_bytes())
        forget.read_manifest("P001")


def settings_at(folder: Path) -> Any:
    """PBL_HOME and PBL_MODELS in a folder."""
    from unittest import mock

    return mock.patch.dict("os.environ", PBL_HOME=str(folder / "home"), PBL_MODELS=str(folder / "models"))


def server(path: Path) -> None:
    path.write_text(json.dumps({"port": 3307, "pid": 1, "version": "10.11.6", "prefixes": ["pbl"], "on_demand": False}))


def use_server(path: Path) -> None:
    from pbl_schemas.operations import embedded
    from pbl_schemas.operations.embedded.folder import Credentials

    folder = embedded.Folder(path.parent / "db")
    folder.data.mkdir(parents=True, exist_ok=True)
    folder.write_credentials(Credentials("a" * 20, "b" * 20))
    folder.state_file.write_bytes(path.read_bytes())
    embedded.status(folder)
    folder.write_state(port=3308)


def accounts(path: Path) -> None:
    from pbl_workers.web.accounts import Accounts

    Accounts(path).add("a.first", ["reader"], "correct horse battery")


def use_accounts(path: Path) -> None:
    from pbl_workers.web.accounts import Accounts

    path.chmod(0o600)
    found = Accounts(path)
    for account in found.all().values():
        found.check(account.name, "wrong horse battery")


# ------------------------------------------------------------------------- what is made of results, and made of a video
def metrics(path: Path) -> None:
    from pbl_pipeline.gait import gait_metrics

    gait_metrics([_fit()]).save(path)


def use_metrics(path: Path) -> None:
    from pbl_pipeline.validation.bridge import folder_values

    folder = path.parent / "visits" / "one"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").write_bytes(path.read_bytes())
    folder_values(folder.parent)


@functools.cache
def _kinetics():
    """With forces: of a walk whose vertical is measured."""
    import dataclasses

    from pbl_pipeline.gait import gait_metrics
    from pbl_pipeline.kinetics import METHODS, visit_kinetics

    body = load_body()
    fit = walking_fit(body.joint_names, body.sha256, n_frames=240, start_m=(6.0, -4.5, -0.2))
    sd = np.full_like(fit.qpos, 0.01)
    fit = dataclasses.replace(fit, orientation_source="measured: phone", qpos_sd=sd, height_m=1.8)
    return visit_kinetics([fit], gait_metrics([fit]).trials, METHODS.find(), mass_kg=70.0)


def kinetics(path: Path) -> None:
    from pbl_pipeline.visit import save_kinetics

    folder = path.parent / "sound-kinetics"
    folder.mkdir(exist_ok=True)
    written = save_kinetics(_kinetics(), folder)
    path.write_bytes(next(p for p in written if p.suffix == path.suffix).read_bytes())


def use_kinetics(path: Path) -> None:
    import shutil

    from pbl_pipeline.visit import load_kinetics

    folder = path.parent / "kinetics"
    shutil.copytree(path.parent / "sound-kinetics", folder, dirs_exist_ok=True)
    next(folder.glob(f"*kinetics{path.suffix}")).write_bytes(path.read_bytes())
    load_kinetics(folder, [_fit().name])


def tracking(path: Path) -> None:
    from pbl_pipeline.tracking import PersonTrack, Tracking

    box = np.tile([10.0, 10.0, 90.0, 200.0], (N, 1))
    people = tuple(PersonTrack(i, box, box, np.ones(N), np.ones(N, bool)) for i in range(2))
    Tracking(np.arange(N) / FPS, SIZE_PX, people, "blazepose", "0" * 64).save(path)


def use_tracking(path: Path) -> None:
    """Read tracks as a file of the store."""
    from types import SimpleNamespace
    from unittest import mock

    from pbl_pipeline.tracking import Tracking
    from pbl_schemas import stored_files

    local = SimpleNamespace(protocol="file")
    with (
        mock.patch.object(stored_files, "backend_of", return_value=local),
        mock.patch.object(stored_files, "full_path", lambda _, name: str(path.parent / name)),
        stored_files.stored_file({"path": path.name, "store": "pbl"}) as file,
    ):
        Tracking.load(file, SIZE_PX, "blazepose", "0" * 64)


def participants(path: Path) -> None:
    path.write_text("participant_id\tage\tsex\n" + "".join(f"sub-P{i:03}\t{40 + i}\tF\n" for i in range(9)))


def use_participants(path: Path) -> None:
    from pbl_pipeline.export.bids import Labels, bids_files

    folder = path.parent / "dataset"
    folder.mkdir(exist_ok=True)
    (folder / "participants.tsv").write_bytes(path.read_bytes())
    bids_files([], {}, Labels("P100", "1"), folder)


def method(path: Path) -> None:
    path.write_text(json.dumps({"stage": "tracking", "name": "of-a-lab", "base": "blazepose-tiles", "min_hits": 4}))


def use_method(path: Path) -> None:
    from pbl_pipeline.method_file import read_method

    assert read_method(path).hash


def board(path: Path) -> None:
    from pbl_pipeline.video import Board
    from tests.board_video import film, varied_poses
    from tests.videos import constant_rate, write_video

    size, matrix = (320, 180), np.array([[236.0, 0, 158], [0, 237, 92], [0, 0, 1]])
    lens = np.array([0.12, -0.3, 0.001, -0.0008, 0.2])
    chart = Board("checkerboard", (9, 6), 30.0)
    frames = [f for f in film(chart, matrix, lens, size, varied_poses(chart, matrix, size, 24)) for _ in range(2)]
    write_video(path, frames, constant_rate(len(frames), 10), crf=22)


def use_board(path: Path) -> None:
    from pbl_pipeline.errors import PblError
    from pbl_pipeline.video import Board, calibrate_video

    try:
        calibrate_video(path, Board("checkerboard", (9, 6), 30.0))
    except PblError as error:
        if not (path.name.startswith("sound-") and error.code.startswith("CALIBRATION_")):  # of a small picture
            raise


def use_deidentified(path: Path) -> None:
    from pbl_pipeline.deidentify import Heads, deidentify
    from pbl_pipeline.deidentify.types import Head
    from pbl_pipeline.video import probe

    info = probe(path)
    n, size = info.n_frames, (info.width_px, info.height_px)
    box = np.tile([0.0, 0.0, 50.0, 60.0], (n, 1))
    head = Head(np.tile([40.0, 30.0, 10.0], (n, 1)), np.ones(n, np.uint8), box)
    heads = Heads(info.time_s, size, (head,))
    deidentify(path, path.with_name("covered.mp4"), heads=heads, keep=["device", "time", "place"], overwrite=True)


def graph(path: Path) -> None:
    path.write_bytes(_graph().SerializeToString())


def use_graph(path: Path) -> None:
    """With the checksum of what it is: a model whose publisher made it so."""
    import hashlib

    from pbl_pipeline.models import registry
    from tests import dot_models

    folder = path.parent / "graph"
    data = path.read_bytes()
    fields = {**dot_models.spec("crop3d", (64, 64)), "sha256": hashlib.sha256(data).hexdigest()}
    dot_models.write(folder, _graph(), fields)
    (folder / "model.onnx").write_bytes(data)
    with settings_at(path.parent):
        registry.add(folder, replace=True)


def archive(path: Path) -> None:
    import tarfile
    import zipfile

    from tests import dot_models

    folder = dot_models.write(path.parent / "dots", _graph(), dot_models.spec("crop3d", (64, 64)))
    files = sorted(folder.iterdir())
    if path.suffix == ".zip":
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
            for file in files:
                packed.write(file, f"dots/{file.name}")
    else:
        with tarfile.open(path, "w:gz") as packed:
            for file in files:
                packed.add(file, f"dots/{file.name}")


def use_archive(path: Path) -> None:
    from pbl_pipeline.models import registry

    with settings_at(path.parent):
        registry.add(path, replace=True)


def form(path: Path) -> None:
    head = 'Content-Disposition: form-data; name="{}"{}\r\n\r\n{}\r\n'
    fields = [head.format(n, "", v) for n, v in (("subject", "P001"), ("session", "2026-01-01"), ("seen", "1"))]
    fields.append(head.format("video", '; filename="walk.mp4"\r\nContent-Type: video/mp4', "x" * 5000))
    path.write_bytes("".join(f"--line\r\n{f}" for f in fields).encode() + b"--line--\r\n")


def use_form(path: Path) -> None:
    """Read a form as the page does while it arrives; a form that it refuses has the code USAGE here."""
    import asyncio
    from concurrent.futures import ThreadPoolExecutor

    from starlette.requests import Request

    from pbl_pipeline.errors import PblError
    from pbl_workers.web.access import Refused
    from pbl_workers.web.multipart import parts

    data = path.read_bytes()
    pieces = [data[i : i + 700] for i in range(0, len(data), 700)] or [b""]

    async def receive() -> dict[str, Any]:
        return {"type": "http.request", "body": pieces.pop(0), "more_body": bool(pieces)}

    async def read() -> int:
        headers = [(b"content-type", b"multipart/form-data; boundary=line")]
        request = Request({"type": "http", "method": "POST", "headers": headers}, receive)
        return sum([len(p) if isinstance(p, bytes) else 1 async for p in parts(request)])

    try:
        with ThreadPoolExecutor(1) as thread:  # the thread of a test may have an event loop that runs
            thread.submit(asyncio.run, read()).result()
    except Refused as error:
        raise PblError("USAGE", found=str(error), expected="a form", next_step="send it again") from error
