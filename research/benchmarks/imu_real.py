"""Real wearable sensors through the readers, the orientation and the alignment of the product.

    python -m research.benchmarks.imu_real FOLDER

FOLDER has the public recordings `opensense-walk` (Xsens on both legs; SimTK OpenSense, a walk without video) and
`gaitmap-foot-mocap` (gyroscopes on shoes that carry three markers; gaitmap's example data).

Prints the knee's largest angles between shank and thigh sensors, about its main axis and from the first pose, from the
orientation that the sensors state and from what VQF makes of rates and accelerations, where there are rates; and the
root mean square difference of a foot's gyroscope from the angular velocity of its markers.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import click
import numpy as np
import pandas as pd
from scipy.signal import butter, filtfilt, find_peaks
from scipy.spatial.transform import Rotation, Slerp

from pbl_pipeline.sensors import Given, SensorLog, given_sensors, read_given
from pbl_pipeline.sensors.orientation import SAMPLE_S, oriented, rate_of
from pbl_pipeline.sensors.start import wahba

GAITMAP_HZ, MOCAP_HZ = 204.8, 100.0


def knee(thigh: SensorLog, shank: SensorLog) -> tuple[float, float]:
    """Largest angle (deg) and time between two peaks (s) of the knee."""
    time = np.arange(0, min(thigh.time[-1], shank.time[-1]), 0.01)
    above, below = (Rotation.from_quat(oriented(x).at(time)[0], scalar_first=True) for x in (thigh, shank))
    bent = above.inv() * below
    turns = np.rad2deg((bent[50].inv() * bent).as_rotvec())
    angle = turns @ np.linalg.svd(turns - turns.mean(axis=0), full_matrices=False)[2][0]
    angle = angle if abs(angle.max()) > abs(angle.min()) else -angle
    peaks, _ = find_peaks(angle, height=35, distance=60)
    return float(angle.max()), float(np.median(np.diff(peaks)) / 100)


def foot(folder: Path, side: str) -> tuple[float, float]:
    """Root mean square of the difference of gyroscope and markers, and of the gyroscope (deg/s), below 10 Hz."""
    imu = pd.read_csv(folder / "imu_sample.csv.gz", header=[0, 1], index_col=0)[f"{side}_sensor"]
    markers = pd.read_csv(folder / "mocap_sample.csv.gz", header=[0, 1], index_col=0)
    places = np.stack(
        [np.asarray(markers[f"{side[0].upper()}_{m}"][list("xyz")]) for m in ("TOE", "FCC", "FM5")], axis=1
    )
    known = np.flatnonzero(np.isfinite(places).all(axis=(1, 2)))
    run = max(np.split(known, np.flatnonzero(np.diff(known) > 1) + 1), key=len)
    arms = places[run] - places[run].mean(axis=1, keepdims=True)
    turns = Rotation.concatenate([Rotation.align_vectors(a, arms[0])[0] for a in arms])
    time = run / MOCAP_HZ
    even = np.arange(time[0], time[-1], SAMPLE_S)
    ours = rate_of(Slerp(time, turns)(even).as_quat(scalar_first=True))
    at = np.arange(len(imu)) / GAITMAP_HZ
    own = pd.DataFrame({"time_s": at, **{f"gyr_{k}": np.deg2rad(imu[f"gyr_{k}"]) for k in "xyz"}})
    own = own.join(imu[[f"acc_{k}" for k in "xyz"]])
    with tempfile.TemporaryDirectory() as written:
        own.to_csv(path := Path(written) / f"{side}.csv", index=False)
        (log,) = read_given([Given(path, f"foot_{side[0]}")])
    sensor, best = oriented(log), (np.inf, 0.0)
    over, under = np.asarray(butter(4, 10 / 50))
    low = lambda x: filtfilt(over, under, x, axis=0)  # noqa: E731
    for lag in np.arange(-0.15, 0.151, 0.005):
        quat, known = sensor.at(even + lag)
        theirs = low(rate_of(quat))
        a, b = (x[known] - x[known].mean(axis=0) for x in (low(ours), theirs))
        error = a - b @ wahba([(a, b)]).T
        best = min(best, (float(np.sqrt((error**2).mean())), float(np.sqrt((b**2).mean()))))
    return float(np.rad2deg(best[0])), float(np.rad2deg(best[1]))


@click.command(help=(__doc__ or "").split("\n")[0])
@click.argument("folder", type=click.Path(exists=True, path_type=Path))
def main(folder: Path) -> None:
    logs = {log.segment: log for log in read_given(given_sensors(str(folder / "opensense-walk" / "myIMUMappings.xml")))}
    for side in "rl":
        most, stride = knee(logs[f"thigh_{side}"], logs[f"shank_{side}"])
        click.echo(f"knee {side}: largest {most:.1f} deg, stride {stride:.2f} s")
    for side in ("left", "right"):
        error, all_ = foot(folder / "gaitmap-foot-mocap", side)
        click.echo(f"foot {side}: {error:.0f} of {all_:.0f} deg/s")


if __name__ == "__main__":
    main()
