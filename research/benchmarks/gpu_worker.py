"""Sessions a second of `pbl worker --resource gpu`, and how busy the device is.

    python -m research.benchmarks.gpu_worker                                  # as `pbl worker --processes auto` fits
    python -m research.benchmarks.gpu_worker --batch 32,128 --processes 1,2   # what the options bring
    python -m research.benchmarks.gpu_worker --seconds 8                      # trials of one length: fewer programs
    python -m research.benchmarks.gpu_worker --sessions 4 --warm-up 2 --batch 2 --alike   # to try it on a CPU

A separate database holds sessions of one to three walks with their keypoints (the walker of `pbl synth`, a few walks
with new noise for each trial), as they lie there when detection is through. One worker fits all of them. The first ones
(`--warm-up`) let it compile and are not counted, nor are the last ones, which it has in hand when work runs out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import logging
import os
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from pbl_pipeline.cli.bench import Numbers
from tests.database import installation

if TYPE_CHECKING:
    from pbl_workers.process import Options

#: Trials that a session may have, and cameras.
TRIALS, CAMERAS = (1, 2, 3), ("static", "handheld")
#: Noise of a trial beside that of the walk it is made from.
JITTER_PX, JITTER_M = 1.0, 0.005
#: Priority of the sessions that let the worker compile: before all others.
FIRST = 1
#: Seconds between two readings of the device's own counter.
SAMPLE_S = 0.5
#: Batches that a process has at most: computed, waiting or being written.
IN_HAND = 3

#: When (`time.monotonic`), and percent of the time in which a kernel ran.
Reading = tuple[float, float]


# -------------------------------------------------------------------------------------------------------- the sessions
@dataclasses.dataclass(frozen=True)
class Plan:
    """One session: its trials' seconds and its camera."""

    seconds: tuple[float, ...]
    camera: str


def plans(n: int, seconds: Sequence[float], alike: bool, seed: int = 0) -> list[Plan]:
    """Sessions of chance sizes with trials that last one of `seconds`, or (`alike`) one trial of the first and a static
    camera."""
    if alike:
        return [Plan((seconds[0],), CAMERAS[0])] * n
    draw = np.random.default_rng(seed)
    return [
        Plan(tuple(map(float, draw.choice(seconds, size=draw.choice(TRIALS)))), str(draw.choice(CAMERAS)))
        for _ in range(n)
    ]


class Walks:
    """Keypoints of walks, each made once; every trial gets separate noise."""

    def __init__(self) -> None:
        self._made: dict[tuple, Any] = {}
        self._draw = np.random.default_rng(1)

    def trial(self, seconds: float, camera: str, person: int) -> Any:
        """Keypoints (BlazePose's 33 points) of one trial."""
        from pbl_pipeline.synthetic import SynthSpec, synthesise

        key = (seconds, camera, person)
        if key not in self._made:
            spec = SynthSpec(seed=person, seconds=seconds, camera=camera, ground="treadmill", marker_set="blazepose_33")
            self._made[key] = synthesise(spec).keypoints
        walk = self._made[key]
        return dataclasses.replace(
            walk,
            xy_px=walk.xy_px + self._draw.normal(0, JITTER_PX, walk.xy_px.shape),
            xyz_cam_m=walk.xyz_cam_m + self._draw.normal(0, JITTER_M, walk.xyz_cam_m.shape),
        )


def put_sessions(home: Path, sessions: Sequence[Plan]) -> None:
    """Register the sessions' videos and put the rows of all tables before SessionFit, as detection would leave them."""
    from pbl_schemas.intake import Methods, VisitRecord
    from research.benchmarks.many_recordings import archived, register_many

    recordings, trials = [], []
    walks = Walks()
    with tempfile.TemporaryDirectory(dir=home) as name:
        for i, session in enumerate(sessions):
            for seconds in session.seconds:
                number = len(recordings)
                sha256 = hashlib.sha256(f"{number}".encode()).hexdigest()
                visit = VisitRecord(f"S{i:05d}", "1", camera_motion=session.camera)
                recordings.append(archived(f"/recordings/{number}.mp4", sha256, 1, visit))
                keypoints = walks.trial(seconds, session.camera, person=i % 2)
                keypoints.save(Path(name) / f"{number}.npz")
                trials.append(keypoints)
        register_many(recordings, Methods())
        _insert_rows(Path(name), trials)


def _insert_rows(folder: Path, trials: Sequence[Any]) -> None:
    from pbl_schemas import fit, keypoints, tracking, video
    from pbl_schemas.origin import Origin

    def origin(prefix: str) -> dict[str, Any]:
        return Origin.now(0.0).row(prefix)

    first = trials[0]
    np.savez(folder / "tracks.npz", time_s=first.time_s)
    chosen = (keypoints.KeypointSelection * fit.FitPlan * video.Video.proj("session_id")).to_dicts(order_by="video_id")
    rows: dict[Any, list[dict]] = {
        t: [] for t in (video.VideoInfo, tracking.Tracking, tracking.SubjectChoice, keypoints.Keypoints, fit.TrialInput)
    }
    probed = {"container": "mp4", "codec": "h264", "pixel_format": "yuv420p", "rotation": 0, "video_notes": []}
    for method, found in zip(chosen, trials, strict=True):
        size, n = found.image_size_px, len(found.time_s)
        key = {"video_id": method["video_id"]}
        frames = {"n_frames": n, "n_frames_announced": n, "variable_frame_rate": False, "frame_time": found.time_s}
        rows[video.VideoInfo].append(
            {**key, **probed, "width": size[0], "height": size[1], **frames, **origin("video_info")}
        )
        key = {**key, "tracking_method": method["tracking_method"]}
        rows[tracking.Tracking].append(
            {**key, "n_persons": 1, "detector": "recorded", "tracks": folder / "tracks.npz", **origin("tracking")}
        )
        choice = {"choice_status": "CHOSEN", "chosen_person_id": 1, "choice_scores": {}, "choice_reason": "recorded"}
        rows[tracking.SubjectChoice].append({**key, **choice, **origin("choice")})
        key = {**key, "keypoint_method": method["keypoint_method"]}
        rows[keypoints.Keypoints].append(
            {
                **key,
                "keypoints_person_id": 1,
                "marker_set": found.marker_set,
                "n_points": len(found.names),
                "root_relative": found.root_relative,
                "n_seen": n,
                "camera_kind": found.camera.kind,
                "camera_source": found.camera.source,
                "focal_length": found.camera.focal_px,
                "keypoints_file": folder / f"{len(rows[keypoints.Keypoints])}.npz",
                **origin("keypoints"),
            }
        )
        key = {**key, "fit_method": method["fit_method"]}
        rows[fit.TrialInput].append({**key, "in_view_share": 1.0, "n_used": n, **origin("trial_input")})
    for table, of_table in rows.items():
        table.insert(of_table, allow_direct_insert=True)


def queue_fits(warm_up: int) -> int:
    """Plan and queue the fits, the first `warm_up` sessions before all others; returns how many."""
    from pbl_schemas import fit
    from pbl_schemas.plan import plan_fit_sets
    from pbl_workers import queue

    plan_fit_sets()
    sets = fit.FitSelection * fit.FitSet.proj("session_id")
    keys = [{k: r[k] for k in fit.FitSelection.primary_key} for r in sets.to_dicts(order_by="session_id")]
    queue.fill(fit.SessionFit, keys[:warm_up], FIRST)
    queue.fill(fit.SessionFit, keys[warm_up:])
    return len(keys)


# ------------------------------------------------------------------------------------------------------------ one run
def run(options: Options) -> tuple[list[float], list[Reading]]:
    """Have a worker fit what is queued; when each job ended, and `device_readings`.

    Raises SystemExit where a session was not fitted.
    """
    from pbl_workers.metrics import KeptReports
    from pbl_workers.run_job import DONE
    from pbl_workers.supervisor import Supervisor

    metrics = KeptReports()
    with device_readings() as readings:
        code = Supervisor(options, metrics).run()
    ends = [(time_s, outcome) for time_s, _, outcome in metrics.reports if outcome is not None]
    failed = [outcome.text for _, outcome in ends if outcome.what != DONE]
    if code or failed:
        raise SystemExit(failed[0] if failed else code)
    return [time_s for time_s, _ in ends], readings


@contextlib.contextmanager
def device_readings() -> Iterator[list[Reading]]:
    """(time, percent of the time in which a kernel ran) as `nvidia-smi` says, while the block runs; none without it."""
    readings: list[Reading] = []
    command = ["nvidia-smi", "--query-gpu=utilization.gpu", "--format=csv,noheader,nounits"]
    command += ["--loop-ms", str(int(1000 * SAMPLE_S)), "--id", "0"]
    try:
        smi = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    except FileNotFoundError:
        yield readings
        return

    def read() -> None:
        for line in smi.stdout or ():
            if line.strip().isdecimal():
                readings.append((time.monotonic(), float(line)))

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    try:
        yield readings
    finally:
        smi.terminate()
        smi.wait()
        thread.join()


@click.command()
@click.option("--sessions", default=1024, show_default=True, help="That are measured.")
@click.option(
    "--warm-up",
    type=click.IntRange(min=1),
    default=512,
    show_default=True,
    help="Sessions before them, so that programs are compiled.",
)
@click.option("--batch", type=Numbers(), default="128", show_default=True, help="Sessions reserved together.")
@click.option("--processes", default="auto", show_default=True, help="Working processes, of all devices; a,b,c.")
@click.option("--seconds", default="5,7.5,10", show_default=True, help="That a trial may last; a,b,c.")
@click.option("--alike", is_flag=True, help="All sessions of one size: a single program.")
def main(sessions: int, warm_up: int, batch: tuple[int, ...], processes: str, seconds: str, alike: bool) -> None:
    """Measure a worker that fits."""
    os.environ["JAX_PLATFORMS"] = "cpu"  # this process only makes the sessions: the device is the worker's
    import pbl_schemas
    from pbl_schemas import fit
    from pbl_workers.cli.worker import options_of

    runs = [
        options_of("gpu", n if n == "auto" else int(n), size, once=True, selftest=False)
        for size in batch
        for n in processes.split(",")
    ]
    # So that no process runs out of work before the last of the measured ones is in its table.
    after = max(IN_HAND * o.batch * o.processes for o in runs)
    with installation() as home:
        pbl_schemas.activate()
        logging.getLogger("datajoint").setLevel(logging.ERROR)
        put_sessions(home, plans(warm_up + sessions + after, [float(s) for s in seconds.split(",")], alike))
        del os.environ["JAX_PLATFORMS"]
        for options in runs:
            queued = queue_fits(warm_up)
            started = time.monotonic()
            ends, readings = run(options)
            if len(ends) != queued:  # a process died with some in hand
                raise SystemExit(f"{queued - len(ends)} of {queued} sessions were not fitted at the first attempt")
            begin, end = ends[warm_up - 1], ends[warm_up + sessions - 1]
            busy = [percent for time_s, percent in readings if begin <= time_s <= end]
            device = (fit.SessionFit & "fit_seconds >= 0").to_arrays("compute_device")[0]
            click.echo(
                f"{device}: batches of {options.batch}, processes {options.processes}: "
                f"{sessions / (end - begin):.1f} sessions/s, the first {warm_up} {begin - started:.0f} s, device busy "
                + (f"{np.mean(busy):.0f} % (nvidia-smi)" if busy else "not known (no nvidia-smi)")
            )
            fit.SessionFit.delete(prompt=False, part_integrity="cascade")


if __name__ == "__main__":
    main()
