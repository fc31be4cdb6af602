"""Speed and memory of exporting visits.

    python -m research.benchmarks.export --visits 1000

A visit is a walk of 8 s (240 frames at 30 Hz, blazepose_33). For each one the fit is read from its file, and events,
cycles and measures are those of one computation before, as they come from the tables; `--measure` computes them for
each visit as `pbl export FIT.npz` does. Files are removed between visits, outside the time.
"""

from __future__ import annotations

import dataclasses
import resource
import shutil
import tempfile
import time
from pathlib import Path

import click
import numpy as np

from pbl_pipeline.export import FORMATS, write_export
from pbl_pipeline.fit import TrialFit
from pbl_pipeline.keypoints import Keypoints
from pbl_pipeline.pipeline import measured
from pbl_pipeline.visit import Held, Visit, visit_of_fits
from tests.exported import marked_fit


@click.command()
@click.option("--visits", default=1000, show_default=True, help="Visits of the long run.")
@click.option("--to", "formats", multiple=True, default=tuple(FORMATS), help="Formats of the long run; default all.")
@click.option("--measure", is_flag=True, help="Find events and measures of each visit.")
def main(visits: int, formats: tuple[str, ...], measure: bool) -> None:
    """Visits a second, processor time of each and memory (MiB) before and after."""
    with tempfile.TemporaryDirectory() as folder:
        path = _visit(Path(folder))
        known = measured(visit_of_fits([path]))
        click.echo(f"{'formats':<44}{'visits':>7}{'visits/s':>10}{'CPU ms':>9}{'MiB before':>12}{'after':>8}")
        for some in [*([f] for f in FORMATS), [f for f in FORMATS if f not in ("csv", "parquet")]]:
            _run(path, known, some, min(50, visits), measure)
        _run(path, known, list(formats), visits, measure)


def _run(path: Path, known: Visit, formats: list[str], visits: int, measure: bool) -> None:
    out, seconds = path.parent / "out", []
    cpu = before = 0.0
    for i in range(visits + 10):
        if i == 10:  # what is loaded and compiled once is
            seconds, cpu, before = [], time.process_time(), resident_mib()
        start = time.perf_counter()
        visit = measured(visit_of_fits([path])) if measure else _as_stored(path, known)
        write_export(visit, formats, out)
        seconds.append(time.perf_counter() - start)
        shutil.rmtree(out)
    cpu = 1e3 * (time.process_time() - cpu) / visits
    name = " ".join(formats)
    click.echo(f"{name:<44}{visits:>7}{1 / np.mean(seconds):>10.1f}{cpu:>9.1f}{before:>12.0f}{resident_mib():>8.0f}")


def _as_stored(path: Path, known: Visit) -> Visit:
    """The visit with its files read anew and the measures that were stored."""
    fit, points = Held(TrialFit.load(path)), Held(Keypoints.load(path.with_name("walk.keypoints.npz")))
    (recording,) = known.recordings
    recording = dataclasses.replace(recording, load_fit=fit, load_keypoints=points)
    return dataclasses.replace(known, recordings=(recording,))


def _visit(folder: Path) -> Path:
    fit = marked_fit(n_frames=240)
    n, j = fit.markers_world_m.shape[:2]
    fit.save(folder / "walk.fit.npz")
    Keypoints(
        time_s=fit.time_s,
        names=fit.marker_names,
        marker_set=fit.marker_set,
        xy_px=np.random.default_rng(0).uniform(0, 300, (n, j, 2)),
        xyz_cam_m=np.full((n, j, 3), np.nan),
        root_relative=True,
        confidence=np.full((n, j), 0.9),
        image_size_px=fit.image_size_px,
        camera=fit.camera,
        box_px=np.zeros((n, 4)),
    ).save(folder / "walk.keypoints.npz")
    return folder / "walk.fit.npz"


def resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


if __name__ == "__main__":
    main()
