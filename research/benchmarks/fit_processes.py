"""Sessions a second of the fit, in one process or in several that share a GPU: figures of research/reports.

    python -m research.benchmarks.fit_processes
    python -m research.benchmarks.fit_processes --method blazepose --points blazepose_33 --processes 1,2,3
    python -m research.benchmarks.fit_processes --sessions 4 --repeat 1           # to try it on a CPU

Each session is another person's walk of 10 s (`pbl synth`), filmed by a phone on a stand. What is measured is
`fit_sessions` alone, all programs loaded; `gpu_worker` measures a worker with its tables.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import TYPE_CHECKING

import click

from pbl_pipeline.cli.bench import Numbers
from pbl_pipeline.errors import PblError
from pbl_pipeline.resources import cores

if TYPE_CHECKING:
    from pbl_pipeline.fit import SessionInput
    from pbl_pipeline.keypoints import Keypoints

#: Not fork: threads of the numerical libraries do not survive it.
SPAWN = multiprocessing.get_context("spawn")

_sessions: list[SessionInput] = []


def walk(points: str, person: int) -> Keypoints:
    """Keypoints of a marker set of a person's walk."""
    from pbl_pipeline.synthetic import SynthSpec, synthesise

    return synthesise(SynthSpec(seed=person, seconds=10.0, ground="treadmill", marker_set=points)).keypoints


def hold(walks: Sequence[Keypoints]) -> str:
    """Keep all sessions in this process, and return its device."""
    import jax

    from pbl_pipeline.fit import SessionInput

    _sessions.extend(SessionInput([w], ["walk"]) for w in walks)
    return jax.devices()[0].device_kind


def fit(method: str, first: int, step: int) -> None:
    """Fit every session of this process from a first one on. Raises the `PblError` of one that cannot be fitted."""
    from pbl_pipeline.fit import fit_sessions

    for found in fit_sessions(_sessions[first::step], method, threads=1 if step > 1 else None):
        if isinstance(found, PblError):
            raise found


@click.command()
@click.option("--method", default="gauss-newton", show_default=True, help="Fit method.")
@click.option("--points", default="bml_movi_87", show_default=True, help="Marker set.")
@click.option("--sessions", default=256, show_default=True)
@click.option("--processes", type=Numbers(), default="1,2", show_default=True, help="That share the device.")
@click.option("--repeat", type=click.IntRange(1), default=3, show_default=True, help="Warm runs; the best counts.")
def main(method: str, points: str, sessions: int, processes: tuple[int, ...], repeat: int) -> None:
    """Time the fit of many sessions."""
    os.environ |= {"JAX_PLATFORMS": "cpu", "XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
    with ProcessPoolExecutor(cores(), SPAWN) as makers:
        walks = list(makers.map(walk, [points] * sessions, range(sessions)))
    del os.environ["JAX_PLATFORMS"]
    with contextlib.ExitStack() as ended:
        pools = [ended.enter_context(ProcessPoolExecutor(1, SPAWN)) for _ in range(max(processes))]
        *_, device = [held.result() for held in [pool.submit(hold, walks) for pool in pools]]
        for n in processes:
            seconds = []
            for _ in range(1 + repeat):
                begin = time.perf_counter()
                for done in [pool.submit(fit, method, i, n) for i, pool in enumerate(pools[:n])]:
                    done.result()
                seconds.append(time.perf_counter() - begin)
            best = min(seconds[1:])  # the first one compiles
            click.echo(f"{device}, {method}, {points}, processes {n}: {best:.2f} s, {sessions / best:.1f} sessions/s")


if __name__ == "__main__":
    main()
