"""`pbl worker`: run queued jobs until stopped."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

from pbl_workers.registry import DETECTOR, FIT, GROUPS

if TYPE_CHECKING:
    from pbl_workers.process import Options


class Processes(click.ParamType):
    """A number of processes, or `auto`."""

    name = "number|auto"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int | str:
        """Return the number, or "auto"."""
        return "auto" if value == "auto" else click.IntRange(1, 256).convert(value, param, ctx)


@click.command()
@click.option(
    "--resource",
    type=click.Choice(list(GROUPS)),
    default="all",
    show_default=True,
    help="What this machine serves: cpu is everything but the fit, gpu the fit.",
)
@click.option(
    "--processes", type=Processes(),
    help="Working processes, which divide the cores among them; auto: as many as cores and memory allow (1 core, or "
    "half of one where a GPU detects, and 4 GB each; of the fit alone one for each GPU). Default: one for each GPU "
    "where the fit is served, else 1.",
)  # fmt: skip
@click.option(
    "--batch",
    type=click.IntRange(1, 256),
    help="Fits reserved together by a process (default: 128 with a GPU, else 1).",
)
@click.option("--once", is_flag=True, help="End when no job is left.")
@click.option("--max-jobs", type=click.IntRange(min=1), help="End a process after so many jobs.")
@click.option(
    "--grace", "grace_s", type=click.FloatRange(min=0), default=60.0, show_default=True,
    help="After SIGTERM, seconds for the running job; then it is put back into the queue.",
)  # fmt: skip
@click.option(
    "--limit-factor", type=click.FloatRange(min=0.001), default=1.0, show_default=True,
    help="Multiplies the time limits of the tables.",
)  # fmt: skip
@click.option(
    "--no-phones", is_flag=True,
    help="Do without the process that takes only recordings of phones; also where detection is not served, or --once.",
)  # fmt: skip
@click.option("--metrics-port", type=click.IntRange(1, 65535), help="Serve Prometheus metrics on this port.")
@click.option("--metrics-host", default="127.0.0.1", show_default=True, help="Address of the metrics.")
@click.option("--no-selftest", is_flag=True, help="Skip the known jobs that each process does first.")
def worker(
    resource: str,
    processes: int | str | None,
    batch: int | None,
    once: bool,
    max_jobs: int | None,
    grace_s: float,
    limit_factor: float,
    no_phones: bool,
    metrics_port: int | None,
    metrics_host: str,
    no_selftest: bool,
) -> None:
    """Runs continuously and takes jobs from all queues; start as many as you like, on any machine.

    SIGTERM or Ctrl-C ends it: the running job is finished within --grace, or put back. A job that crashes its process
    is tried again and becomes an error row the third time; a job beyond its time limit becomes one immediately. Logs
    are JSON lines on stderr.

    \b
    Example: pbl worker --processes auto
    Example: pbl worker --resource gpu --batch 32 --metrics-port 9108
    """
    import pbl_schemas
    from pbl_schemas import connection
    from pbl_workers.log import to_stderr
    from pbl_workers.supervisor import Supervisor

    pbl_schemas.activate(methods=False)  # reports a wrong address or login here, not in a process that is started again
    to_stderr()
    options = options_of(
        resource,
        processes,
        batch,
        once=once,
        max_jobs=max_jobs,
        grace_s=grace_s,
        limit_factor=limit_factor,
        selftest=not no_selftest,
        phones=not (no_phones or once) and DETECTOR in GROUPS[resource],
    )
    supervisor = Supervisor(options)
    if metrics_port is not None:
        supervisor.metrics.serve(metrics_port, metrics_host, connection.another)
    raise click.exceptions.Exit(supervisor.run())


def options_of(resource: str, processes: int | str | None, batch: int | None = None, **others: Any) -> Options:
    """Options of a worker on this machine. processes, batch: as given on the command line."""
    from pbl_pipeline.resources import given_gpus, processes_at_once
    from pbl_workers.process import Options

    gpus = given_gpus() if FIT in GROUPS[resource] else ()
    if processes == "auto":
        from pbl_pipeline.models import gpu_wanted

        detects = DETECTOR in GROUPS[resource]
        room = processes_at_once(detects and gpu_wanted())
        processes = len(gpus) if gpus and not detects else max(len(gpus), room)
    return Options(
        resource=resource,
        processes=int(processes or len(gpus) or 1),
        # Among so many sessions are enough of one size to be solved together.
        batch=batch or (128 if gpus else 1),
        gpus=gpus,
        **others,
    )
