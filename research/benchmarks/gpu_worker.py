"""Utilisation of the device by `pbl worker --resource gpu`: figures of docs/operations.md.

    python -m research.benchmarks.gpu_worker                                  # 256 sessions, batches of 32
    python -m research.benchmarks.gpu_worker --batch 1,8,32 --json gpu.json   # what the size of a batch brings
    python -m research.benchmarks.gpu_worker --seconds 8                      # trials of one length: fewer programs
    python -m research.benchmarks.gpu_worker --sessions 4 --warm-up 2 --batch 2 --alike   # to try it on a CPU

A separate database holds sessions of one to three walks with their keypoints (the walker of `pbl synth`, a few walks
with new noise for each trial), as they lie there when detection is through. One worker fits all of them. The first ones
(`--warm-up`) let it compile and are not counted; what is compiled after them is said.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np

from research.benchmarks import gpu_worker_watch
from tests.database import installation

#: Trials that a session may have, and cameras.
TRIALS, CAMERAS = (1, 2, 3), ("static", "handheld")
#: Noise of a trial beside that of the walk it is made from.
JITTER_PX, JITTER_M = 1.0, 0.005
#: Priority of the sessions that let the worker compile: before all others.
FIRST = 1
#: Seconds between two readings of the device's own counter.
SAMPLE_S = 0.5
#: Parts of a batch's time, in the order of the pipeline: span of the notes and what it is.
PARTS = (
    ("claim", "reserve"),
    ("fetch_batch", "fetch rows"),
    ("loaded", "read keypoints"),
    ("make_session", "pack"),
    ("start_of", "start"),
    ("device", "device"),
    ("on_floor", "feet on the floor"),
    ("session_fit", "result, checks"),
    ("run", "fetch again, compare, insert"),
    ("make_insert", "of that: insert"),
    ("savez_compressed", "of that: compress arrays"),
)

#: Unit of computation: a batch, or one session alone.
COMPUTE = ("compute_batch", "make_compute")
#: Of the parts, what follows the computation.
AFTER = ("run", "make_insert", "savez_compressed")

Span = tuple[float, float]


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
    from research.benchmarks.many_recordings import archived, register_many
    from schemas.intake import Methods, VisitRecord

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
    from schemas import fit, keypoints, tracking, video
    from schemas.origin import Origin

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
    from schemas import fit
    from schemas.plan import plan_fit_sets
    from workers import queue

    plan_fit_sets()
    sets = fit.FitSelection * fit.FitSet.proj("session_id")
    keys = [{k: r[k] for k in fit.FitSelection.primary_key} for r in sets.to_dicts(order_by="session_id")]
    queue.fill(fit.SessionFit, keys[:warm_up], FIRST)
    queue.fill(fit.SessionFit, keys[warm_up:])
    return len(keys)


# ------------------------------------------------------------------------------------------------------------ one run
def run(batch: int, processes: int, folder: Path) -> list[dict[str, Any]]:
    """Have a worker fit what is queued; the device's own readings [(time, percent)] as spans named "smi"."""
    from workers.metrics import Metrics
    from workers.process import Options, given_gpus
    from workers.supervisor import Supervisor

    folder.mkdir()
    os.environ[gpu_worker_watch.NOTES] = str(folder)
    options = Options(resource="gpu", once=True, selftest=False, batch=batch, processes=processes, gpus=given_gpus())
    with device_readings() as readings:
        code = Supervisor(options, Metrics(), gpu_worker_watch.work).run()
    if code:
        raise SystemExit(code)
    spans = [json.loads(line) for path in folder.glob("*.jsonl") for line in path.read_text().splitlines()]
    smi = [{"name": "smi", "begin": t, "end": t, "n": percent} for t, percent in readings]
    return sorted([*spans, *smi], key=lambda s: s["begin"])


@contextlib.contextmanager
def device_readings() -> Iterator[list[tuple[float, float]]]:
    """(time, percent of the time in which a kernel ran) as `nvidia-smi` says, while the block runs; none without it."""
    readings: list[tuple[float, float]] = []
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


# --------------------------------------------------------------------------------------------------------- the figures
def union_s(spans: Sequence[Span], window: Span) -> float:
    """Seconds of the window in which at least one span is open."""
    total, end = 0.0, window[0]
    for a, b in sorted(spans):
        a, b = max(a, end), min(b, window[1])
        total += max(b - a, 0.0)
        end = max(end, b)
    return total


def windows(spans: Sequence[dict[str, Any]], warm_up: int) -> tuple[Span, Span]:
    """Return the time from the moment in which the last of the `warm_up` sessions is computed to the last call of the
    device ("under load": there would be another batch) and to the last row. Where nothing is warmed up, from the first
    batch on.

    Raises
    ------
    ValueError
        Nothing was computed after the warm-up.
    """
    computed = sorted((s["end"], s["begin"], s["n"]) for s in spans if s["name"] in COMPUTE)
    done, begin = 0, min((b for _, b, _ in computed), default=0.0)
    for end, _, n in computed:
        if done >= warm_up:
            break
        done, begin = done + n, end
    device = [s["end"] for s in spans if s["name"] == "device" and s["begin"] >= begin]
    rows = [s["end"] for s in spans if s["name"] == "run"]
    if not device:
        raise ValueError(f"nothing was computed after the first {warm_up} sessions: more --sessions, or less --warm-up")
    return (begin, max(device)), (begin, max(rows))


def figures(spans: Sequence[dict[str, Any]], warm_up: int) -> dict[str, Any]:
    """The table of one run. Shares are of the time under load, and 1.0 is all of it."""
    load, whole = windows(spans, warm_up)

    def of(name: str, window: Span = load) -> list[dict[str, Any]]:
        return [s for s in spans if s["name"] == name and s["begin"] >= window[0] and s["end"] <= window[1]]

    # A call that compiles first: only what remains after it is the device's time.
    device = [(min(s["begin"] + s["compiling"], s["end"]), s["end"]) for s in spans if s["name"] == "device"]
    seconds = load[1] - load[0]
    smi = [s["n"] for s in of("smi")]
    solves = of("solve")
    # Counted where they end: some were begun before, as others are at the end of any time that one looks at.
    fitted = sum(s["n"] for s in spans if s["name"] in COMPUTE and s["end"] > whole[0])
    inserted = len(of("run", whole))
    first = min(s["begin"] for s in spans if s["name"] in ("fetch_batch", "run"))
    ms: dict[str, float] = {name: 1000 * sum(s["end"] - s["begin"] for s in of(name, whole)) for name, _ in PARTS}
    ms |= {"device": 1000 * union_s(device, whole)}
    ms["run"] -= 1000 * sum(s["end"] - s["begin"] for s in of("make_compute", whole))
    return {
        "sessions": fitted,
        "sessions_per_s": fitted / (whole[1] - whole[0]),
        "seconds": whole[1] - whole[0],
        "busy_share": union_s(device, load) / seconds,
        "busy_share_to_last_row": union_s(device, whole) / (whole[1] - whole[0]),
        "smi_share": float(np.mean(smi)) / 100 if smi else None,
        "smi_readings": len(smi),
        "warm_up_seconds": load[0] - first,
        "compiling_seconds": sum(s["compiling"] for s in of("device")),
        "sessions_per_solve": {str(k): v for k, v in sorted(_counts([s["n"] for s in solves]).items())},
        # Rows of the last sessions of the warm-up are written in the measured time as well.
        "ms_per_session": {k: v / (inserted if k in AFTER else fitted) for k, v in ms.items()},
    }


def _counts(values: Sequence[int]) -> dict[int, int]:
    return {v: values.count(v) for v in set(values)}


def lines(batch: int, processes: int, f: dict[str, Any]) -> list[str]:
    """The table of one run as text."""
    smi = "no nvidia-smi" if f["smi_share"] is None else f"{100 * f['smi_share']:.0f} % ({f['smi_readings']} readings)"
    solves = ", ".join(f"{n} of {k}" for k, n in f["sessions_per_solve"].items())
    return [
        f"batches of {batch}, processes {processes}",
        f"  {f['sessions']} sessions in {f['seconds']:.1f} s: {f['sessions_per_s']:.2f} sessions/s",
        f"  device computes {100 * f['busy_share']:.0f} % of the time to its last call (bar 80 %), "
        f"{100 * f['busy_share_to_last_row']:.0f} % of that to the last row",
        f"  utilization by nvidia-smi in the former {smi}",
        f"  before that: {f['warm_up_seconds']:.1f} s of warm-up; compiling in the measured time "
        f"{f['compiling_seconds']:.1f} s",
        f"  solves by their number of sessions: {solves}",
        "  ms per session, of all threads: " + ", ".join(f"{w} {f['ms_per_session'][n]:.1f}" for n, w in PARTS),
    ]


@click.command()
@click.option("--sessions", default=256, show_default=True, help="That are measured.")
@click.option("--warm-up", default=64, show_default=True, help="Sessions before them, so that programs are compiled.")
@click.option("--batch", "batches", default="32", show_default=True, help="Sessions that are reserved together; a,b,c.")
@click.option("--processes", default="1", show_default=True, help="Working processes, of all devices; a,b,c.")
@click.option("--seconds", default="5,7.5,10", show_default=True, help="That a trial may last; a,b,c.")
@click.option("--alike", is_flag=True, help="All sessions of one size: a single program.")
@click.option("--json", "json_path", type=click.Path(path_type=Path), help="Write the figures there.")
def main(
    sessions: int, warm_up: int, batches: str, processes: str, seconds: str, alike: bool, json_path: Path | None
) -> None:
    """Measure a worker that fits."""
    os.environ["JAX_PLATFORMS"] = "cpu"  # this process only makes the sessions: the device is the worker's
    import schemas
    from schemas import fit

    out = []
    with installation() as home:
        schemas.activate()
        logging.getLogger("datajoint").setLevel(logging.ERROR)
        begin = time.monotonic()
        put_sessions(home, plans(sessions + warm_up, [float(s) for s in seconds.split(",")], alike))
        click.echo(f"{sessions + warm_up} sessions registered in {time.monotonic() - begin:.0f} s")
        del os.environ["JAX_PLATFORMS"]
        for b in map(int, batches.split(",")):
            for p in map(int, processes.split(",")):
                queued = queue_fits(warm_up)
                spans = run(b, p, home / f"notes-{b}-{p}")
                device = (fit.SessionFit & "fit_seconds >= 0").to_arrays("compute_device")
                if len(device) != queued:
                    click.echo(f"{queued - len(device)} of {queued} sessions were not fitted", err=True)
                    sys.exit(1)
                found = {"batch": b, "processes": p, "device": str(device[0]), **figures(spans, warm_up)}
                click.echo("\n".join([f"device {found['device']}", *lines(b, p, found)]))
                out.append(found)
                if json_path is not None:
                    json_path.write_text(json.dumps(out, indent=1))
                fit.SessionFit.delete(prompt=False, part_integrity="cascade")


if __name__ == "__main__":
    main()
