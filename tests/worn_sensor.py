"""A sensor that swings like a shank, and its log in the formats of `pbl_pipeline.sensors.formats`."""

from __future__ import annotations

import dataclasses
import io
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.spatial.transform import Rotation

G = 9.81


@dataclasses.dataclass
class Swing:
    """What a sensor measures at `hz` for `seconds`: times, rates and accelerations, rotations to a world."""

    seconds: float = 6.0
    hz: float = 100.0
    phase: float = 0.0

    def __post_init__(self) -> None:
        self.time = np.arange(int(self.seconds * self.hz)) / self.hz
        angle = 0.6 * np.sin(2 * np.pi * self.time + self.phase)
        turn = Rotation.from_euler("xyz", [0.3, -1.1, 0.7])
        self.turns = Rotation.from_rotvec(np.outer(angle, [0.2, 1.0, 0.1])) * turn
        between = (self.turns[:-1].inv() * self.turns[1:]).as_rotvec() * self.hz
        self.rate = np.concatenate([between, between[-1:]])
        bump = 0.8 * np.sin(2 * np.pi * 2 * self.time)[:, None]
        self.acceleration = self.turns.inv().apply([0.0, 0.0, G]) + bump

    @property
    def quat(self) -> np.ndarray:
        """Quaternions (T, 4), scalar first."""
        return self.turns.as_quat(scalar_first=True)

    def own(self) -> pd.DataFrame:
        """The table of the project's own CSV."""
        columns = {"time_s": self.time}
        for what, values, axes in (
            ("gyr", self.rate, "xyz"),
            ("acc", self.acceleration, "xyz"),
            ("quat", self.quat, "wxyz"),
        ):
            columns |= {f"{what}_{axis}": values[:, i] for i, axis in enumerate(axes)}
        return pd.DataFrame(columns)

    def write(self, path: Path, table: pd.DataFrame | None = None) -> Path:
        """Write the project's own CSV."""
        (self.own() if table is None else table).to_csv(path, index=False)
        return path


def xsens(swing: Swing, path: Path, separator: str = "\t", first: int = 65300, rate: bool = True) -> Path:
    """A file of MT Manager whose counter wraps."""
    mat = swing.turns.as_matrix().transpose(0, 2, 1).reshape(-1, 9)  # by columns
    names = ["PacketCounter", "SampleTimeFine", *(f"Acc_{a}" for a in "XYZ"), *(f"Gyr_{a}" for a in "XYZ")]
    names += [f"Mat[{r}][{c}]" for c in (1, 2, 3) for r in (1, 2, 3)]
    rows = np.hstack([swing.acceleration, swing.rate, mat])
    counter = (first + np.arange(len(rows))) % 2**16
    lines = [separator.join([f"{n:05d}", "", *(f"{x:.6f}" for x in row)]) for n, row in zip(counter, rows, strict=True)]
    head = ["// Start Time: Unknown", *(["// Update Rate: 100.0Hz"] if rate else []), "// Firmware Version: 4.0.2"]
    path.write_text("\n".join([*head, separator.join(names), *lines]) + "\n")
    return path


def dot(swing: Swing, path: Path, tag: str = "left", synced: str = "Synced", first: float = 2**32 - 1e6) -> Path:
    """A file of the Movella DOT app whose clock wraps."""
    table = pd.DataFrame({"PacketCounter": np.arange(len(swing.time)) + 1})
    table["SampleTimeFine"] = np.mod(np.round(first + 1e6 * swing.time), 2**32).astype(np.int64)
    for name, values in (("Acc", swing.acceleration), ("Gyr", np.degrees(swing.rate))):
        table[[f"{name}_{a}" for a in "XYZ"]] = values
    table[["Euler_X", "Euler_Y", "Euler_Z"]] = swing.turns.as_euler("ZYX", degrees=True)[:, ::-1]
    head = f"sep=,\nDeviceTag:,{tag},,,\nSyncStatus:,{synced}\nOutputRate:,100Hz\n"
    path.write_text(head + "StartTime: ,2021-08-20_20:21:13_804 GMT+8\n\n" + table.to_csv(index=False))
    return path


def apdm(sensors: dict[str, Swing], path: Path, layout: str = "new") -> Path:
    """A file of APDM with several sensors; layout: "new" (Format=7) or "old"."""
    first = next(iter(sensors.values()))
    blank = np.zeros((len(first.time), 3))
    if layout == "new":
        head = [["Format=7"], ["Time"], [""]]
        columns = [np.round(1_550_879_504_438_281 + 1e6 * first.time)[:, None]]
        for i, (name, s) in enumerate(sensors.items()):
            head[0] += [str(5000 + i), "", "", name, *[""] * 10]
            head[1] += [
                "Accelerometer",
                "",
                "",
                "Gyroscope",
                "",
                "",
                "Magnetometer",
                "",
                "",
                "Barometer",
                "Orientation",
                "",
                "",
                "",
            ]
            head[2] += [*"XYZ" * 3, "", "S", *"XYZ"]
            columns += [s.acceleration, s.rate, blank, blank[:, :1], s.quat]
        body = np.hstack(columns)
        text = "\n".join(",".join(f"{x:.0f}" if i == 0 else f"{x:.6f}" for i, x in enumerate(row)) for row in body)
        path.write_text("\n".join(",".join(h) for h in head) + "\n" + text + "\n")
        return path
    names, units, columns = ["Time"], ["s"], [first.time[:, None]]
    for name, s in sensors.items():
        for what, unit, axes, values in (
            ("Acceleration", "m/s^2", ["X", "Y", "Z"], s.acceleration),
            ("Angular Velocity", "rad/s", ["X", "Y", "Z"], s.rate),
            ("Orientation", "", ["Scalar", "X", "Y", "Z"], s.quat),
        ):
            names += [f"{name}/{what}/{a}" for a in axes]
            units += [unit] * len(axes)
            columns.append(values)
    out = io.StringIO()
    np.savetxt(out, np.hstack(columns), "%.6f", ",")
    path.write_text(f"Test Name:,Walk,,\nSample Rate:,100,Hz,\n{','.join(names)}\n{','.join(units)}\n{out.getvalue()}")
    return path


def opensense(sensors: dict[str, Swing], path: Path) -> Path:
    """A .sto of orientations."""
    first = next(iter(sensors.values()))
    lines = [
        "DataRate=100.0",
        "DataType=Quaternion",
        "version=3",
        "OpenSimVersion=4.5",
        "endheader",
        "\t".join(["time", *sensors]),
    ]
    for i, t in enumerate(first.time):
        lines.append("\t".join([f"{t:.4f}", *(",".join(f"{q:.7f}" for q in s.quat[i]) for s in sensors.values())]))
    path.write_text("\n".join(lines) + "\n")
    return path


def shimmer(swing: Swing, path: Path, gyro: str = "deg/s") -> Path:
    """A file of Consensys with both accelerometers."""
    table = pd.DataFrame({"S_Timestamp_Unix_CAL": 1.7e12 + 1e3 * swing.time})
    narrow = np.clip(swing.acceleration, -5, 5)
    for name, values in (("Accel_LN", narrow), ("Accel_WR", swing.acceleration), ("Gyro", np.degrees(swing.rate))):
        table[[f"S_{name}_{a}_CAL" for a in "XYZ"]] = values
    units = ["ms", *["m/(s^2)"] * 6, *[gyro] * 3]
    lines = table.to_csv(index=False, sep="\t").split("\n", 1)
    path.write_text('"sep=\\t"\n' + lines[0] + "\t\n" + "\t".join(units) + "\t\n" + lines[1])
    return path


def wrist(swing: Swing, path: Path, ios: bool = True) -> Path:
    """`WristMotion.csv` of Sensor Logger: in g and with gravity downwards (iOS), or standardised."""
    sign, scale = (-1, 1 / 9.80665) if ios else (1, 1.0)
    gravity = swing.turns.inv().apply([0.0, 0.0, G])
    table = pd.DataFrame({"time": np.int64(1_719_102_681_000_000_000) + np.round(1e9 * swing.time).astype(np.int64)})
    table["seconds_elapsed"] = swing.time
    for name, values in (
        ("rotationRate", swing.rate),
        ("gravity", sign * scale * gravity),
        ("acceleration", sign * scale * (swing.acceleration - gravity)),
    ):
        table[[f"{name}{a}" for a in "XYZ"]] = values
    table[[f"quaternion{a}" for a in "WXYZ"]] = swing.quat
    table.iloc[np.r_[50:100, 0:50, 100 : len(table)]].to_csv(path, index=False)  # in batches
    return path
