"""Sensor logs of recording apps: read, turned to the camera, and brought to the video's clock."""

import dataclasses
import json
import zipfile

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from pbl_pipeline.fit import check_trial
from pbl_pipeline.gait import feet_from_keypoints
from pbl_pipeline.keypoints import visibility
from pbl_pipeline.synthetic import plain_walk
from pbl_pipeline.video import Attitude, load_attitude, probe, read_phone_log
from pbl_pipeline.video.attitude import held_deg
from pbl_pipeline.video.clock import match_pictures
from tests import refused
from tests.inputs import csv_log
from tests.inputs import video_info as video
from tests.phone_film import EPOCH_NS, as_json, as_zip, device_quat, film, hand, sensor_logger
from tests.walker import observe

BEGIN_S, SECONDS = 3.25, 6.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return sensor_logger(tmp_path_factory.mktemp("capture") / "log", 12.0)


@pytest.fixture(scope="module")
def info(tmp_path_factory):
    return probe(film(tmp_path_factory.mktemp("film") / "walk.mov", BEGIN_S, SECONDS))


def recorded(info, seconds: float, zone_h: float = 0.0):
    """The video with a time of recording `seconds` after the log's beginning, rounded to seconds as files have it."""
    when = int(EPOCH_NS / 1e9 + seconds) + int(3600 * zone_h)
    text = str(np.datetime64(when, "s")) + "Z"
    return dataclasses.replace(info, recorded_utc=text)


def worst_deg(attitude: Attitude, begin_s: float = BEGIN_S, until_s: float = SECONDS) -> float:
    """Largest angle between the log on the video's clock and how the camera was turned when it filmed."""
    at = np.arange(0.0, until_s, 0.05)
    found = Slerp(attitude.time_s, Rotation.from_quat(attitude.quat_wxyz, scalar_first=True))(at)
    return float(np.degrees((found.inv() * hand(begin_s + at)).magnitude().max()))


def edited(folder, tmp_path, change):
    """A copy of the folder whose rows of Orientation.csv went through `change`."""
    copy = tmp_path / "edited"
    copy.mkdir()
    for file in folder.iterdir():
        (copy / file.name).write_bytes(file.read_bytes())
    head, *rows = (folder / "Orientation.csv").read_text().splitlines()
    (copy / "Orientation.csv").write_text("\n".join([head, *change(rows)]) + "\n")
    return copy


# --- what is read


def test_the_exports_hold_the_same(folder):
    logs = [read_phone_log(p) for p in (folder, as_zip(folder), as_json(folder), folder / "Orientation.csv")]
    assert [log.form for log in logs] == [f"Sensor Logger {f}" for f in ("folder", "zip", "JSON", "CSV")]
    for log in logs:
        np.testing.assert_array_equal(log.time_s, logs[0].time_s)
        np.testing.assert_allclose(log.quat_wxyz, logs[0].quat_wxyz)
        assert log.start_utc_s == pytest.approx(EPOCH_NS / 1e9 + 0.013, abs=1e-6)
        assert (log.frame, log.rotation_deg, log.clock) == ("device", None, "utc")
        assert log.rate_hz == pytest.approx(100, rel=1e-3)
    for log in logs[:3]:
        assert set(log.sensors) == {"gravity", "gyroscope"}
        np.testing.assert_allclose(log.sensors["gyroscope"].xyz[0], [0.2, 0.1, 0.0])
        assert log.device == "A phone ios"
    assert not logs[3].sensors


def test_a_real_row_of_an_android_phone(tmp_path):
    """As published with a tool for such exports; its roll, pitch and azimuth are what the matrix says."""
    row = "-0.49317896366119385,-0.10824661701917648,0.21374563872814178,0.8362834453582764,0.033629775047302246"
    path = tmp_path / "Orientation.csv"
    lines = [f"{1718030736912338000 + 10_000_000 * k},{0.11 + 0.01 * k},{row},-0.4828145205974579,1.07" for k in (0, 1)]
    path.write_text("time,seconds_elapsed,qz,qy,qx,qw,roll,pitch,yaw\n" + "\n".join(lines) + "\n")
    matrix = Rotation.from_quat(read_phone_log(path).quat_wxyz[0], scalar_first=True).as_matrix()
    # Android's getOrientation, of a matrix that turns device into world.
    assert np.arcsin(-matrix[2, 1]) == pytest.approx(-0.4828145, abs=1e-5)
    assert np.arctan2(-matrix[2, 0], matrix[2, 2]) == pytest.approx(0.0336298, abs=1e-5)
    assert np.arctan2(matrix[0, 1], matrix[1, 1]) == pytest.approx(1.0739440, abs=1e-5)
    turned_back = path.read_text().replace("0.8362834453582764", "-0.8362834453582764")
    path.write_text(turned_back)
    assert "pitch" in refused("PHONE_LOG", read_phone_log, path).found


def test_our_own_schema(tmp_path):
    times = [0.0, 0.01, 0.02]
    w, x, y, z = np.tile([0.7071, 0.7071, 0, 0], (3, 1)).T.tolist()
    content = {
        "start_utc": "2026-03-01T10:15:30.250+01:00",
        "frame": "device",
        "rotation_deg": 0,
        "phone": {"make": "Samsung", "model": "SM-G950F"},
        "orientation": {"time_s": times, "qw": w, "qx": x, "qy": y, "qz": z},
        "accelerometer": {"time_s": [0.0, 0.02], "x": [0, 0], "y": [9.81, 9.8], "z": [0.1, 0]},
        "magnetometer": {"time_s": [0.01], "x": [20], "y": [-30], "z": [5]},
    }
    (tmp_path / "log.json").write_text(json.dumps(content))
    log = read_phone_log(tmp_path / "log.json")
    assert (log.clock, log.device, log.rotation_deg) == ("utc", "Samsung SM-G950F", 0)
    assert log.start_utc_s == pytest.approx(1772356530.25)
    assert {n: s.xyz.shape for n, s in log.sensors.items()} == {"accelerometer": (2, 3), "magnetometer": (1, 3)}
    lines = ["time_s,qw,qx,qy,qz,frame,ax,ay,az,start_utc"]
    lines += [
        f"{t},0.7071,0.7071,0,0,device,{a},2026-03-01T09:15:30.25Z"
        for t, a in zip(times, (",,", "0,9.8,0", ",,"), strict=True)
    ]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    table = read_phone_log(tmp_path / "log.csv")
    np.testing.assert_allclose(table.quat_wxyz, log.quat_wxyz)
    assert table.start_utc_s == log.start_utc_s
    np.testing.assert_allclose(table.sensors["accelerometer"].time_s, [0.01])


@pytest.mark.parametrize("utc", ["yesterday", "2026-03-01T09:15:30"])
def test_a_start_that_is_no_moment(tmp_path, utc):
    path = csv_log(tmp_path / "a.csv", [0.7071, 0.7071, 0, 0], {"frame": "device", "start_utc": utc})
    assert "start_utc" in refused("PHONE_LOG", read_phone_log, path).found


def test_gravity_that_contradicts_the_orientation(tmp_path, folder):
    text = (folder / "Gravity.csv").read_text().splitlines()
    swapped = [text[0], *(",".join([*(c := r.split(","))[:2], c[3], c[2], c[4]]) for r in text[1:])]
    copy = edited(folder, tmp_path, lambda rows: rows)
    (copy / "Gravity.csv").write_text("\n".join(swapped))
    assert "accelerometer" in refused("PHONE_LOG", read_phone_log, copy).found


def test_broken_exports(tmp_path, folder):
    empty = tmp_path / "empty"
    empty.mkdir()
    assert "no orientation" in refused("PHONE_LOG", read_phone_log, empty).found
    (tmp_path / "a.zip").write_bytes(b"PK no zip")
    refused("PHONE_LOG", read_phone_log, tmp_path / "a.zip")
    for text in ('[{"sensor": "Orientation", "time": "x"', '[{"sensor":' * 20_000, '{"a":' * 20_000):
        (tmp_path / "b.json").write_text(text)
        refused("PHONE_LOG", read_phone_log, tmp_path / "b.json")
    refused("FILE_MISSING", read_phone_log, tmp_path / "none.zip")


def test_an_archive_with_wrong_bytes(folder, tmp_path):
    whole = tmp_path / "whole.zip"
    with zipfile.ZipFile(whole, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(folder / "Orientation.csv", "Orientation.csv")
        end = archive.start_dir
    data = np.frombuffer(whole.read_bytes(), np.uint8)
    for place in np.linspace(60, end - 8, 60).astype(int):  # within the packed rows
        spoiled = data.copy()
        spoiled[place : place + 4] ^= 0xFF
        (tmp_path / "spoiled.zip").write_bytes(spoiled.tobytes())
        refused("PHONE_LOG", read_phone_log, tmp_path / "spoiled.zip")


# --- stamps and quaternions


def test_a_repeated_row_is_left_out_and_said(tmp_path, folder):
    log = read_phone_log(edited(folder, tmp_path, lambda rows: [*rows[:5], rows[4], *rows[5:]]))
    assert len(log.time_s) == len(read_phone_log(folder).time_s)
    assert "1 repeated rows" in log.notes[0]


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (lambda rows: [r for r in rows for _ in range(2)], "repeat"),
        (lambda rows: rows[:50] + rows[20:30] + rows[50:], "backwards"),
        (
            lambda rows: [
                *rows[:9],
                ",".join([*rows[9].split(",")[:2], "0", "0", "0", "0", "0", "0", "0"]),
                *rows[10:],
            ],
            "length",
        ),
        (lambda rows: [*rows[:9], rows[9].replace(rows[9].split(",")[2], "one"), *rows[10:]], "qz"),
        (lambda rows: ["x" + rows[0], *rows[1:]], "time"),
        (lambda rows: rows[:1], "1 samples"),
    ],
    ids=["every stamp twice", "backwards", "zero", "text", "time", "one"],
)
def test_rows_that_cannot_be(tmp_path, folder, change, found):
    assert found in refused("PHONE_LOG", read_phone_log, edited(folder, tmp_path, change)).found


# --- how the phone was held


@pytest.mark.parametrize(
    ("size", "flag", "turned"),
    [
        ((720, 1280), 90, 0),
        ((1280, 720), 0, 270),  # top to the left: the sensor's own direction
        ((1280, 720), 180, 90),
        ((720, 1280), 270, 180),
        # Converted files, whose pictures were turned and the flag dropped.
        ((720, 1280), 0, 0),
        ((720, 1280), 0, 180),
        ((1280, 720), 0, 90),
    ],
)
def test_how_the_phone_was_held_is_seen(tmp_path, size, flag, turned):
    level = hand(np.arange(3.0))
    quat = device_quat(level, turned)
    probed = video(width_px=size[0], height_px=size[1], rotation_deg=flag)
    assert held_deg(probed, quat) == turned
    lines = ["time_s,qw,qx,qy,qz,frame", *(f"{t / 10},{','.join(map(str, q))},device" for t, q in enumerate(quat))]
    (tmp_path / "log.csv").write_text("\n".join(lines))
    found = Rotation.from_quat(load_attitude(tmp_path / "log.csv", probed).quat_wxyz, scalar_first=True)
    assert (found.inv() * level).magnitude().max() < 1e-9
    if flag:  # a log of the phone held in another way contradicts the flag
        other = dataclasses.replace(probed, rotation_deg=(flag + 90) % 360 or 360)
        assert "against gravity" in refused("PHONE_LOG", load_attitude, tmp_path / "log.csv", other).found


def test_the_front_camera_is_refused(folder, info):
    front = dataclasses.replace(info, lens="iPhone 13 front camera 2.71mm f/2.2")
    assert "front camera" in refused("PHONE_LOG", load_attitude, folder, front).found


# --- the clock


def test_the_pictures_tell_the_clock(folder, info):
    """The phone's own record of when it filmed is missing: the log's 12 s hold the video's 6 s from 3.25 s on."""
    log = load_attitude(folder, info)
    assert "by the pictures' movement" in log.source
    assert log.time_s[0] == pytest.approx(0.013 - BEGIN_S, abs=0.02)
    assert worst_deg(log) < 0.3


@pytest.mark.parametrize("ended", [False, True], ids=["beginning", "end"])
def test_the_time_of_recording_and_the_pictures(folder, info, ended):
    log = load_attitude(folder, recorded(info, BEGIN_S + (SECONDS if ended else 0)))
    assert "pictures" in log.source
    assert log.time_s[0] == pytest.approx(0.013 - BEGIN_S, abs=0.02)


def test_a_log_on_the_videos_clock_is_not_moved(tmp_path, info):
    path = csv_log(tmp_path / "a.csv", [0.7071, 0.7071, 0, 0], {"frame": "device"}, begin_s=10.0)
    late = dataclasses.replace(info, time_s=np.arange(400) / 30)
    np.testing.assert_allclose(load_attitude(path, late).time_s, [10, 10.02, 10.04])
    # The stamps of a sensor that counts from the phone's start, or in milliseconds.
    error = refused("PHONE_LOG", load_attitude, path, info)
    assert error.found == "a log from 10 to 10.04 s, without start_utc"
    assert "start_utc" in error.next_step


@pytest.mark.parametrize("late_s", [0.0, 0.043, -0.2])
def test_the_pictures_bring_a_log_that_is_nearly_on_the_videos_clock(tmp_path, info, late_s):
    at = np.arange(-0.5, SECONDS + 0.5, 0.01)
    quat = dict(zip(("qw", "qx", "qy", "qz"), device_quat(hand(BEGIN_S + at)).T.tolist(), strict=True))
    log = {"frame": "device", "clock": "pictures", "time_s": (at + late_s).tolist(), **quat}
    (path := tmp_path / "log.json").write_text(json.dumps(log))
    moved = load_attitude(path, info)
    assert moved.time_s[0] == pytest.approx(at[0], abs=0.004)
    assert moved.clock_sd_s == 0.005
    assert "by the pictures' movement" in moved.source
    path.write_text(json.dumps(log | {"clock": "video"}))
    stays = load_attitude(path, info)
    assert stays.time_s[0] == at[0] + late_s
    assert np.isnan(stays.clock_sd_s)
    path.write_text(json.dumps(log | {"clock": "sun"}))
    assert "sun" in refused("PHONE_LOG", load_attitude, path, info).found


def test_a_log_in_another_time_zone(tmp_path, folder, info):
    """The pictures tell that it is the right log; of one that moves otherwise the zone is named."""
    log = load_attitude(folder, recorded(info, BEGIN_S, zone_h=-5.5))
    assert "5.5 h from the time of recording in the file" in log.source
    assert worst_deg(log) < 0.3
    other = sensor_logger(tmp_path / "other", 12.0, begin_s=100.0)
    error = refused("PHONE_LOG", load_attitude, other, recorded(info, BEGIN_S, zone_h=-5.5))
    assert "5.5 h apart" in error.next_step
    assert "UTC" in error.found


@pytest.mark.slow
def test_a_log_of_another_day(tmp_path, folder, info):
    """A converted file states when it was converted."""
    assert "3.0 days from" in load_attitude(folder, recorded(info, BEGIN_S + 3 * 86400)).source
    other = sensor_logger(tmp_path / "other", 12.0, begin_s=100.0)
    error = refused("PHONE_LOG", load_attitude, other, recorded(info, BEGIN_S + 3 * 86400))
    assert "apart" not in error.next_step


def test_a_log_shorter_than_the_video(tmp_path, info):
    short = sensor_logger(tmp_path / "short", 3.0, begin_s=BEGIN_S)
    assert "a log of 3.0 s" in refused("PHONE_LOG", load_attitude, short, info).found
    refused("PHONE_LOG", load_attitude, short, recorded(info, 0.0))


def test_a_log_that_covers_half_the_trial_is_left_out_of_the_session():
    walk = observe(plain_walk(np.arange(120) / 30), np.arange(120) / 30)
    quat = hand(np.arange(41) / 10).as_quat(scalar_first=True)
    whole = dataclasses.replace(walk, phone_time_s=np.arange(41) / 10, phone_quat_wxyz=quat)
    used = check_trial(whole, "walk").used
    assert used.all()
    half = dataclasses.replace(walk, phone_time_s=np.arange(21) / 10, phone_quat_wxyz=quat[:21])
    assert "from 0.00 to 2.00 s" in refused("PHONE_LOG", check_trial, half, "walk").found


def _pan(path, at, decimal=".", between=","):
    """A log in the camera's frame that pans by 20 deg to and fro within 4 s."""
    turns = Rotation.from_euler("z", 20 * np.sin(2 * np.pi * at / 4)[:, None], degrees=True)
    quat = (turns * hand(np.zeros(1))).as_quat(scalar_first=True)
    rows = [between.join(f"{v:.6f}".replace(".", decimal) for v in (t, *q)) for t, q in zip(at, quat, strict=True)]
    path.write_text("\n".join([between.join(("time_s", "qw", "qx", "qy", "qz")), *rows]))
    return path


def test_a_hole_in_a_log_is_unknown_orientation(tmp_path):
    """Bridged, 3 s of a pan were up to 21.6 deg of wrong direction."""
    at = np.r_[np.arange(0, 1.5, 0.01), np.arange(2.5, 5, 0.01)]
    attitude = load_attitude(_pan(tmp_path / "a.csv", at), video(time_s=np.arange(130) / 30))
    assert "without samples for up to 1.0 s" in attitude.source
    walk = observe(plain_walk(np.arange(130) / 30), np.arange(130) / 30)
    missing = (walk.time_s > at[149]) & (walk.time_s < at[150])
    for k, lost in ((walk, False), (walk.with_attitude(attitude), missing)):
        used = check_trial(k, "walk").used
        np.testing.assert_array_equal(used, ~(missing & lost))
        assert ("not used: 1.5 to 2.5 s" in visibility(k).text()) == bool(np.any(lost))
        assert np.isnan(feet_from_keypoints(k).heel_m[missing]).all() == bool(np.any(lost))
    still = Attitude(attitude.time_s, np.tile(attitude.quat_wxyz[0], (len(at), 1)))
    assert check_trial(walk.with_attitude(still), "walk").used.all()  # a phone on a stand did not turn meanwhile


def test_a_log_of_one_sample_a_second_is_refused(tmp_path):
    slow = _pan(tmp_path / "a.csv", np.arange(8.0))
    assert "1 orientations a second" in refused("PHONE_LOG", read_phone_log, slow).found


def test_decimal_commas(tmp_path):
    at = np.arange(0, 2, 0.01)
    here, there = (read_phone_log(_pan(tmp_path / n, at, *how)) for n, how in (("a.csv", (",", ";")), ("b.csv", ())))
    np.testing.assert_array_equal(here.time_s, there.time_s)
    np.testing.assert_array_equal(here.quat_wxyz, there.quat_wxyz)


def test_an_archive_of_two_recordings_names_them(tmp_path, folder):
    with zipfile.ZipFile(tmp_path / "two.zip", "w") as archive:
        for name in ("walk1", "walk2"):
            archive.write(folder / "Orientation.csv", f"{name}/Orientation.csv")
    found = refused("PHONE_LOG", read_phone_log, tmp_path / "two.zip").found
    assert "walk1/Orientation.csv, walk2/Orientation.csv" in found


def test_a_phone_on_a_stand(tmp_path):
    """Pictures that do not move tell nothing, and need not."""
    still = probe(film(tmp_path / "still.mov", 0.0, 4.0, moving=False))
    folder = sensor_logger(tmp_path / "log", 8.0)
    rows = (folder / "Orientation.csv").read_text().splitlines()
    same = [rows[0], *(",".join([*r.split(",")[:2], *rows[1].split(",")[2:]]) for r in rows[1:])]
    (folder / "Orientation.csv").write_text("\n".join(same))
    (folder / "Gravity.csv").unlink()
    assert "stood still" in load_attitude(folder, still).source


@pytest.mark.slow
def test_a_log_of_another_hand_is_not_matched(tmp_path, info):
    """The same time, other movement: the time of recording alone does not do, where a log could lie in two places."""
    other = sensor_logger(tmp_path / "other", 30.0, begin_s=100.0)
    error = refused("PHONE_LOG", load_attitude, other, recorded(info, 15.0))
    assert "cannot be found" in error.found
    log = read_phone_log(other)
    turns = hand(100.013 + log.time_s).as_quat(scalar_first=True)
    match = match_pictures(log.time_s, turns, info, [(-24.0, 0.0)])
    assert not match.decides
