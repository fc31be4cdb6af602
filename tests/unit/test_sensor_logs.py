"""Logs of wearable sensors: each format, and bad input."""

import gzip
import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.signal import find_peaks
from scipy.spatial.transform import Rotation

from pbl_pipeline.cli.options import sensor_logs
from pbl_pipeline.errors import PblError
from pbl_pipeline.sensors import Given, SensorLog, check_day, given_sensors, named, read_given
from pbl_pipeline.sensors.given import segment_of
from tests import not_none, worn_sensor
from tests.worn_sensor import Swing


def read(*given: Any) -> tuple[SensorLog, ...]:
    return read_given([w for g in given for w in given_sensors(str(g))])


def refused(*given: Any) -> PblError:
    with pytest.raises(PblError) as caught:
        read(*given)
    return caught.value


def assert_is(log: SensorLog, swing: Swing) -> None:
    np.testing.assert_allclose(log.time, swing.time, atol=2e-6)
    for values, truth in ((log.rate, swing.rate), (log.acceleration, swing.acceleration)):
        assert values is not None
        np.testing.assert_allclose(values, truth, atol=2e-5)
    if log.orientation is not None:
        turned = Rotation.from_quat(log.orientation, scalar_first=True)
        assert (turned.inv() * swing.turns).magnitude().max() < 1e-4


@pytest.mark.parametrize("separator", ["\t", ",", ";", " "])
def test_xsens(tmp_path: Path, separator: str):
    swing = Swing()
    path = worn_sensor.xsens(swing, tmp_path / "MT_1-000_00B42D4B.txt", separator)
    (log,) = read(f"shank_r={path}")
    assert_is(log, swing)
    assert (log.name, log.segment) == ("00B42D4B", "shank_r")
    (tmp_path / "packed_00B42D4B.txt.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert_is(read(f"shank_r={tmp_path / 'packed_00B42D4B.txt.gz'}")[0], swing)


def test_xsens_without_a_rate_takes_that_of_the_list(tmp_path: Path):
    path = worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt", rate=False)
    assert refused(f"shank_r={path}").code == "SENSOR_LOG"
    (tmp_path / "worn.toml").write_text(f'[shank_r]\nfile = "{path.name}"\nrate_hz = 100\n')
    (tmp_path / "worn.csv").write_text(f"segment,file,rate_hz\nshank_r,{path.name},100\n")
    for listed in ("worn.toml", "worn.csv"):
        assert_is(read(tmp_path / listed)[0], Swing())


def test_xsens_of_a_world_with_z_down_is_turned(tmp_path: Path):
    down = Swing()
    up, down.turns = down.turns, Rotation.from_euler("x", 180, degrees=True) * down.turns
    path = worn_sensor.xsens(down, tmp_path / "MT_1-000_00B42D4B.txt")
    assert "up is -z" in refused(f"shank_r={path}").next_step
    path.write_text("// Coordinate system: NED\n" + path.read_text())
    down.turns = up
    assert_is(read(f"shank_r={path}")[0], down)


def test_xsens_sensors_keep_the_clock_of_their_packets(tmp_path: Path):
    early, late = Swing(), Swing(seconds=5)
    for device, swing, first in (("00B42D4B", early, 100), ("00B42D4C", late, 150)):
        worn_sensor.xsens(swing, tmp_path / f"MT_1-000_{device}.txt", first=first)
    (tmp_path / "imu.xml").write_text(
        "<OpenSimDocument><XsensDataReaderSettings><trial_prefix>MT_1-000</trial_prefix><ExperimentalSensors>"
        + "".join(
            f'<ExperimentalSensor name="_{d}"><name_in_model>{n}</name_in_model></ExperimentalSensor>'
            for d, n in (("00B42D4B", "tibia_r_imu"), ("00B42D4C", "femur_r_imu"), ("00B42D4D", "torso_imu"))
        )
        + "</ExperimentalSensors></XsensDataReaderSettings></OpenSimDocument>"
    )
    shank, thigh = read(tmp_path / "imu.xml")
    assert (shank.segment, thigh.segment) == ("shank_r", "thigh_r")
    assert (shank.time[0], thigh.time[0]) == pytest.approx((0.0, 0.5))
    other = worn_sensor.xsens(Swing(phase=1), tmp_path / "MT_1-001_00B42D4E.txt", first=100)
    assert "different clocks" in refused(f"shank_r={other}", f"thigh_r={tmp_path / 'MT_1-000_00B42D4C.txt'}").found


def test_movella_dot(tmp_path: Path):
    swing = Swing()
    path = worn_sensor.dot(swing, tmp_path / "shank.csv")
    (log,) = read(f"shank_l={path}")
    assert_is(log, swing)
    assert log.name == "left"
    assert log.started_utc == pytest.approx(1629462073.804)
    apart = worn_sensor.dot(Swing(phase=1), tmp_path / "thigh.csv", "other", "Un-synced")
    assert "different clocks" in refused(f"shank_l={path}", f"thigh_l={apart}").found


@pytest.mark.parametrize("layout", ["new", "old"])
def test_apdm(tmp_path: Path, layout: str):
    sensors = {"Lumbar": Swing(phase=1), "Right Ankle": Swing(), "Chest": Swing(phase=2)}
    path = worn_sensor.apdm(sensors, tmp_path / "walk.csv", layout)
    pelvis, shank = read(path)
    assert (pelvis.segment, shank.segment) == ("pelvis", "shank_r")
    assert_is(pelvis, sensors["Lumbar"])
    assert_is(shank, sensors["Right Ankle"])
    (chest,) = read(f"pelvis={path}#Chest")
    assert_is(chest, sensors["Chest"])
    assert refused(f"thigh_r={path}").code == "USAGE"
    if layout == "old":
        path.write_text(path.read_text().replace("rad/s", "deg/s"))
        assert "in deg/s" in refused(path).found


def test_opensense_orientations(tmp_path: Path):
    path = worn_sensor.opensense({"pelvis_imu": Swing(phase=1), "tibia_r_imu": Swing()}, tmp_path / "walk.sto")
    pelvis, shank = read(path)
    assert (pelvis.segment, shank.segment, shank.rate, shank.acceleration) == ("pelvis", "shank_r", None, None)
    assert shank.orientation is not None
    assert (Rotation.from_quat(shank.orientation, scalar_first=True).inv() * Swing().turns).magnitude().max() < 1e-4
    assert "no angular rate" in shank.notes[0]


def test_shimmer_takes_the_wide_accelerometer(tmp_path: Path):
    (log,) = read(f"foot_r={worn_sensor.shimmer(Swing(), tmp_path / 'foot.csv')}")
    assert_is(log, Swing())
    assert log.started_utc == pytest.approx(1.7e9)
    assert "Gyro in mV" in refused(f"foot_r={worn_sensor.shimmer(Swing(), tmp_path / 'mV.csv', 'mV')}").found


@pytest.mark.parametrize("ios", [True, False])
def test_sensor_logger_of_a_watch(tmp_path: Path, ios: bool):
    path = worn_sensor.wrist(Swing(), tmp_path / "WristMotion.csv", ios)
    with zipfile.ZipFile(tmp_path / "export.zip", "w") as archive:
        archive.write(path, "WristMotion.csv")
    for given in (path, tmp_path / "export.zip"):
        assert_is(read(f"shank_r={given}")[0], Swing())


def test_own_csv(tmp_path: Path):
    swing = Swing()
    (log,) = read(f"shank_r={swing.write(tmp_path / 'a.csv')}")
    assert_is(log, swing)
    assert log.notes == ()
    table = swing.own().drop(columns=[f"quat_{a}" for a in "wxyz"])
    table["start_utc"] = "2026-03-01T09:15:30Z"
    (log,) = read(f"shank_r={swing.write(tmp_path / 'b.csv', table)}")
    assert_is(log, swing)
    assert log.started_utc == pytest.approx(1772356530.0)
    assert log.mounting is None
    check_day([log], {"walk": "2026-03-02T08:15:30Z", "other": None})
    with pytest.raises(PblError, match=r"3\.0 days from the video"):
        check_day([log], {"walk": "2026-03-04T09:15:36Z", "other": None})
    # A wrong clock of one video does not hold up the others.
    days = {"walk": "2026-03-04T09:15:36Z", "other": "2026-03-01T09:15:36Z"}
    assert check_day([log], days) == ["walk states a day 3.0 days from the log of the sensors"]
    stored = tmp_path / "imu.csv"
    stored.write_text("nothing\n")
    with pytest.raises(PblError) as of_copy:
        read_given([Given(stored, "shank_r", called="shank.csv")])
    assert str(of_copy.value.key) == "shank.csv"
    table["start_utc"] = "2026-03-01T09:15:30"
    assert "start_utc" in refused(f"shank_r={swing.write(tmp_path / 'c.csv', table)}").found


def test_a_stated_mounting(tmp_path: Path):
    swing = Swing()
    for wxyz, length in (([0.6, 0.8, 0.0, 0.0], "1"), ([0.6, 0.6, 0.6, 0.6], "1.2")):
        table = swing.own()
        table.loc[0, [f"mount_{a}" for a in "wxyz"]] = wxyz
        given = f"pelvis={swing.write(tmp_path / 'a.csv', table)}"
        if length == "1":
            np.testing.assert_allclose(not_none(read(given)[0].mounting), wxyz)
        else:
            assert f"a mounting of length {length}" in refused(given).found


def test_a_mounting_stated_in_a_list(tmp_path: Path):
    """Directions of two axes: the third follows; any other text is refused."""
    worn_sensor.xsens(Swing(), tmp_path / "MT_1-000_00B42D4B.txt")
    listed = tmp_path / "list.toml"
    row = '[pelvis]\nfile = "MT_1-000_00B42D4B.txt"\nmount = "%s"\n'
    for text, axes in (
        ("x up, z back", [[0, 0, -1], [1, 0, 0], [0, -1, 0]]),
        ("Y up X forward", np.eye(3)),
        ("z right; y down", [[-1, 0, 0], [0, -1, 0], [0, 0, 1]]),
    ):
        listed.write_text(row % text)
        turn = Rotation.from_quat(not_none(read(listed)[0].mounting), scalar_first=True)
        np.testing.assert_allclose(turn.as_matrix(), axes, atol=1e-9)
    for text in (
        "x up",
        "x up x back",
        "z up z back x left",
        "x up, y down",
        "x up, z behind",
        "x up, z back please",
        "x up, y back, z right",
    ):
        listed.write_text(row % text)
        with pytest.raises(PblError, match="a mount ") as wrong:
            read(listed)
        assert wrong.value.code == "USAGE"
    listed.write_text('[pelvis]\nfile = "a.csv"\nmount = ["x up", "z back"]\n')
    with pytest.raises(PblError, match="USAGE"):
        read(listed)
    sheet = tmp_path / "list.csv"
    sheet.write_text('segment,file,mount\npelvis,MT_1-000_00B42D4B.txt,"x up, z back"\n')
    assert given_sensors(str(sheet))[0].mount == "x up, z back"


GYR, ACC, QUAT = (
    [f"gyr_{a}" for a in "xyz"],
    [f"acc_{a}" for a in "xyz"],
    [f"quat_{a}" for a in "wxyz"],
)


def changed(table: pd.DataFrame, what: str) -> pd.DataFrame:
    """The table of a log with a fault."""
    n = len(table)
    quat = Rotation.from_quat(table[QUAT].to_numpy(), scalar_first=True)
    match what:
        case "degrees with orientation":
            table[GYR] = np.degrees(table[GYR])
        case "degrees alone":
            table[GYR] = np.degrees(table[GYR])
            table = table.drop(columns=QUAT)
        case "degrees of a person who sways":
            table[GYR] = np.degrees(table[GYR]) / 10
            table[QUAT] = 0.5  # without a turn
            table[ACC] = [9.81, 0, 0]
            table = table.drop(columns=QUAT)
        case "g":
            table[ACC] /= 9.81
        case "free acceleration":
            table[ACC] -= quat.inv().apply([0, 0, 9.81])
        case "no gyro":
            table = table.drop(columns=GYR + QUAT)
        case "inverse orientation":
            table[QUAT] = quat.inv().as_quat(scalar_first=True)
        case "upside down":
            table[ACC] *= -1
        case "y up":
            table[QUAT] = (Rotation.from_euler("x", -90, degrees=True) * quat).as_quat(scalar_first=True)
        case "not unit":
            table[QUAT] *= 2
        case "backward":
            table.loc[n // 2 :, "time_s"] -= 1
        case "repeated":
            table["time_s"] = np.repeat(table["time_s"].to_numpy()[::2], 2)
        case "milliseconds":
            table["time_s"] *= 1000
        case "saturated":
            table[GYR] = np.clip(table[GYR] * 3, -4.4, 4.4)
            table = table.drop(columns=QUAT)
        case "gyroscope off" | "an axis turned" | "gyroscope turned":
            table[GYR] *= {"gyroscope off": [0, 0, 0], "an axis turned": [1, -1, 1]}.get(what, [-1, -1, -1])
            table = table.drop(columns=QUAT)
        case "orientation missing":
            table.loc[n // 3 :, QUAT] = np.nan
        case "text":
            table = table.astype({"acc_x": object})
            table.loc[3, "acc_x"] = "n/a value"
    return table


@pytest.mark.parametrize(
    ("what", "found", "says"),
    [
        ("degrees with orientation", "as in deg/s", "pi / 180"),
        ("degrees alone", "as in deg/s", "pi / 180"),
        ("degrees of a person who sways", "as in deg/s", "pi / 180"),
        ("g", "as in g", "9.80665"),
        ("free acceleration", "without gravity", "with gravity"),
        ("no gyro", "not both an angular rate and an acceleration", "gyroscope"),
        ("inverse orientation", "orientation", "from the world to the sensor"),
        ("upside down", "180 deg off z", "up is -z"),
        ("y up", "90 deg off z", "up is y"),
        ("not unit", "quaternions of length 2", ""),
        ("backward", "1 of 600 stamps go back", ""),
        ("repeated", "300 of 600 stamps repeat", ""),
        ("milliseconds", "600 samples, 0.1 a second", ""),
        ("saturated", "the end of the sensor's range", "larger range"),
        ("text", "acc_x", ""),
        ("gyroscope off", "turn gravity by ", "that it was on"),
        ("an axis turned", "turn gravity by ", "signs"),
        ("gyroscope turned", "turn gravity by ", "signs"),
        ("orientation missing", "an orientation in 33% of the samples", ""),
    ],
)
def test_bad_input_is_named(tmp_path: Path, what: str, found: str, says: str):
    swing = Swing()
    error = refused(f"shank_r={swing.write(tmp_path / 'a.csv', changed(swing.own(), what))}")
    assert error.code == "SENSOR_LOG"
    assert found in error.found
    assert re.search(says, error.next_step)


def test_a_log_of_two_samples_is_no_failure_of_the_program(tmp_path: Path):
    """Also where both are at the end of the range, which three samples in a row show."""
    table = Swing().own().head(2)
    table[GYR] = 500.0
    log = Swing().write(tmp_path / "two.csv", table)
    assert "angular rates of up to" in str(refused(f"shank_r={log}").found)


def test_small_faults_are_left_out_and_said(tmp_path: Path):
    swing = Swing(seconds=20)
    table = swing.own()
    table.loc[[100, 200], "time_s"] = [0.99, np.nan]
    table.loc[300:305, GYR] = np.nan
    table[QUAT] = swing.quat
    table["gyr_x"] = 3 * table["gyr_x"]  # the axes of the rate are another thing than the orientation's
    table = table.drop(columns=QUAT)
    table.loc[500:504, "acc_x"] = 19.6
    (log,) = read(f"shank_r={swing.write(tmp_path / 'a.csv', table)}")
    assert len(log.time) == len(swing.time) - 2
    assert np.isnan(log.rate[np.isin(log.time, swing.time[300:306])]).all()  # type: ignore[index]
    assert np.isnan(log.acceleration[np.isin(log.time, swing.time[500:505])]).all()  # type: ignore[index]
    assert log.notes == (
        "1 repeated rows and 1 without a time were left out",
        "acceleration: 5 samples at the end of the sensor's range were left out",
    )


def test_a_heading_of_a_magnet_and_a_clock_that_drifts_are_said(tmp_path: Path):
    swing = Swing(seconds=20)
    wander = Rotation.from_euler("z", 20 * np.sin(0.4 * swing.time)[:, None], degrees=True)
    table = swing.own()
    table[QUAT] = (wander * swing.turns).as_quat(scalar_first=True)
    (log,) = read(f"shank_r={swing.write(tmp_path / 'a.csv', table)}")
    assert "wanders" in log.notes[0]
    swing.time = swing.time * (1 + 3e-4)
    (log,) = read(f"shank_r={worn_sensor.dot(swing, tmp_path / 'b.csv')}")
    assert "+300 ppm" in log.notes[0]
    swing.time = swing.time * 100 / 60
    assert (
        "100 a second, as the file states" in refused(f"shank_r={worn_sensor.dot(swing, tmp_path / 'c.csv')}").expected
    )


def test_a_sensor_or_a_segment_twice(tmp_path: Path):
    path = Swing().write(tmp_path / "a.csv")
    other = Swing(phase=1).write(tmp_path / "other.csv")
    assert "on shank_r: one of them twice" in refused(f"shank_r={path}", f"shank_r={other}").found
    assert "the sensor a on shank_l: one of them twice" in refused(f"shank_r={path}", f"shank_l={path}").found
    dead = Swing().own().drop(columns=QUAT).assign(**dict.fromkeys(GYR + ACC, 0.0))
    given = [f"shank_{side}={Swing().write(tmp_path / f'{side}.csv', dead)}" for side in "rl"]
    assert "accelerations of typically 0" in refused(*given).found
    assert "a sensor on knee" in refused(f"knee={path}").found
    assert refused(path).code == "USAGE"  # no name that says a segment
    assert refused(f"shank_r={tmp_path / 'none.csv'}").code == "FILE_MISSING"
    (tmp_path / "b.csv").write_text("frame,x,y\n1,2,3\n")
    assert "no known format" in refused(f"shank_r={tmp_path / 'b.csv'}").found


def test_logs_of_other_recordings(tmp_path: Path):
    late = Swing(phase=1).own()
    late["time_s"] += 5
    a, b = Swing().write(tmp_path / "a.csv"), Swing().write(tmp_path / "b.csv", late)
    assert "in common" in refused(f"shank_r={a}", f"thigh_r={b}").found


@pytest.mark.parametrize(
    ("name", "segment"),
    [
        ("Right Ankle", "shank_r"),
        ("tibia_l_imu", "shank_l"),
        ("Lumbar", "pelvis"),
        ("femur_r", "thigh_r"),
        ("calcn_l_imu", "foot_l"),
        ("RightLowerLeg", "shank_r"),
        ("LeftUpperLeg", "thigh_l"),
        ("RFoot", "foot_r"),
        ("torso_imu", None),
        ("Foot", None),
    ],
)
def test_segments_by_name(name: str, segment: str | None):
    assert segment_of(name) == segment


DOT = "\n\nPacketCounter,SampleTimeFine,Quat_W,Quat_X,Quat_Y,Quat_Z\n1,1,1,0,0,0\n2,16667,1,0,0,0\n"
QUATERNIONS = "\n".join(f"{i / 100},1,0,0,0,0" for i in range(99))


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("Format=7,x,y", "APDM"),
        ("Test Name:,x\n\nTime,Right Ankle/Acceleration/X\n", "APDM"),
        ("sep=,\nS_Timestamp_Unix_CAL,S_Gyro_X_CAL\n", "Shimmer"),
        ("StartTime:,2021-02-30_20:21:13_804 GMT+8" + DOT, "day"),
        ("OutputRate:,6.0.0Hz" + DOT, "6.0.0"),
        ("// Update Rate: .Hz\nPacketCounter\tAcc_X\n1\t2\n", "Xsens"),
        ("time_s,quat_w,quat_w,quat_x,quat_y,quat_z\n" + QUATERNIONS, "quat_w twice"),
        ("time_s,quat_w,quat_x,quat_y,quat_z\n" + QUATERNIONS, "more cells than names"),
        ("time_s" + ",c" * 20_000 + "\n", "16,384 columns"),
        ("time_s" + "," * 9000 + "\n" + "1\n" * 9000, "fewer cells"),
    ],
)
def test_a_broken_log_of_a_known_format_is_an_error(tmp_path: Path, text: str, found: str):
    path = tmp_path / "a.csv"
    path.write_text(text)
    error = refused(f"shank_r={path}")
    assert (error.code, found in error.found) == ("SENSOR_LOG", True)
    with pytest.raises(PblError, match="SENSOR_LOG"):  # nor is it kept unread
        named(Given(path))


def test_only_logs_of_no_known_format_or_segment_are_kept_unread(tmp_path: Path):
    for name, text in (("a.csv", ""), ("b.csv", "frame,x\n"), ("c.csv", Swing().own().to_csv(index=False))):
        (tmp_path / name).write_text(text)
        assert named(Given(tmp_path / name)) == [Given(tmp_path / name)]
    assert "an empty file" in refused(f"shank_r={tmp_path / 'a.csv'}").found


def test_counters_that_begin_again(tmp_path: Path):
    """Movella DOT's packets after 65,535; Xsens sensors that start on two sides of it."""
    swing = Swing()
    path = worn_sensor.dot(swing, tmp_path / "dot.csv")
    table = path.read_text().split("\n\n", 1)
    rows = [row.split(",", 1) for row in table[1].splitlines()]
    again = [f"{(65_400 + i) % 65_536},{row[1]}" for i, row in enumerate(rows[1:])]
    path.write_text("\n".join([table[0], "", ",".join(rows[0]), *again]))
    assert_is(read(f"shank_r={path}")[0], swing)
    early, late = (tmp_path / f"MT_1-000_00B42D4{d}.txt" for d in "BC")
    worn_sensor.xsens(swing, early, first=65_500)
    worn_sensor.xsens(Swing(phase=1), late, first=4)
    shank, thigh = read(f"shank_r={early}", f"thigh_r={late}")
    assert (shank.time[0], thigh.time[0]) == pytest.approx((0.0, 0.4))


def test_lists_with_semicolons_and_with_an_empty_last_cell(tmp_path: Path):
    path = tmp_path / "list.csv"
    for text in ("segment;file\nshank_r;a.csv\n", "segment,file,sensor\nshank_r,a.csv,,\n"):
        path.write_text(text)
        assert given_sensors(str(path)) == [Given(tmp_path / "a.csv", "shank_r")]


def test_a_list_that_names_no_file_is_refused(tmp_path: Path):
    """A fit without sensors would be a silent one."""
    for name, text, found in (
        ("a.toml", "", "no sensors"),
        ("a.csv", "segment,file\n", "no sensors"),
        ("b.csv", "segment,file\nshank_r\n", "a row without a file"),
        ("b.toml", 'shank_r = ""\n', "a row without a file"),
        ("c.toml", "shank_r = 3\n", "TypeError"),
    ):
        (tmp_path / name).write_text(text)
        with pytest.raises(PblError, match=found) as wrong:
            given_sensors(str(tmp_path / name))
        assert wrong.value.code == "FILE_FORMAT"


def test_no_sensors_on_the_command_line():
    assert sensor_logs(["none"]) == ()


def test_two_logs_of_rates_alone_are_not_one_twice(tmp_path: Path):
    a, b = (Swing(phase=p).own().drop(columns=ACC + QUAT) for p in (0, 1))
    paths = [Swing().write(tmp_path / n, t) for n, t in (("a.csv", a), ("b.csv", b))]
    assert "not both" in refused(f"shank_r={paths[0]}", f"thigh_r={paths[1]}").found


# ---------------------------------------------------------------------------------------------------------- real files
def test_every_real_file_is_read(shared_data: Path):
    folder = shared_data / "real" / "imu"
    n = 0
    for path in sorted((folder / "imu-formats").glob("[MTai]*.*")):
        if path.name.startswith("MT2022_ACC_00B"):
            with pytest.raises(PblError, match="not both"):  # nothing but accelerations
                read_given([Given(path, "shank_r", rate_hz=100.0)])
            continue
        names = ["Upper"] if "imuData" in path.name else ["Lumbar", "Right Ankle"] if "apdm" in path.name else [""]
        for name in names:
            (log,) = read_given([Given(path, "shank_r", name or None, 100.0)])
            assert np.isfinite(log.time).all()
            assert len(log.time) >= 3
            n += 1
    assert n == 14


def test_the_real_walk_has_its_knee_peaks_and_strides(shared_data: Path):
    logs = {x.segment: x for x in read(shared_data / "real" / "imu" / "opensense-walk" / "myIMUMappings.xml")}
    assert len(logs) == 7
    for side, peak, stride in (("r", 66, 1.38), ("l", 70, 1.46)):
        turns = []
        for segment in ("thigh", "shank"):
            log = logs[f"{segment}_{side}"]
            assert log.orientation is not None
            turns.append(Rotation.from_quat(log.orientation[:2432], scalar_first=True))
        relative = turns[0].inv() * turns[1]
        bend = np.degrees((relative[50].inv() * relative).as_rotvec())
        knee = bend @ np.linalg.svd(bend - bend.mean(axis=0), full_matrices=False)[2][0]
        knee = knee if knee.max() > -knee.min() else -knee
        peaks = find_peaks(knee, height=35, distance=60)[0]
        assert knee.max() == pytest.approx(peak, abs=1)
        assert np.median(np.diff(peaks)) / 100 == pytest.approx(stride, abs=0.02)


def test_the_real_foot_sensors_pass_as_own_csv(shared_data: Path, tmp_path: Path):
    table = pd.read_csv(shared_data / "real/imu/gaitmap-foot-mocap/imu_sample.csv.gz", header=[0, 1], index_col=0)
    for side in ("left", "right"):
        own = pd.DataFrame(table[f"{side}_sensor"])
        own.insert(0, "time_s", np.arange(len(own)) / 204.8)
        assert "as in deg/s" in refused(f"foot_{side[0]}={Swing().write(tmp_path / 'deg.csv', own)}").found
        own[GYR] = np.radians(own[GYR])
        (log,) = read(f"foot_{side[0]}={Swing().write(tmp_path / 'rad.csv', own)}")
        assert log.rate is not None
        assert np.isfinite(log.rate).all()
