"""`pbl worker`: run queued jobs until stopped."""

from __future__ import annotations

import click

from workers.registry import GROUPS


@click.command()
@click.option(
    "--resource",
    type=click.Choice(list(GROUPS)),
    default="all",
    show_default=True,
    help="What this machine serves: cpu is everything but the fit, gpu the fit.",
)
@click.option("--processes", type=click.IntRange(1, 256), default=1, show_default=True, help="Working processes.")
@click.option(
    "--batch", type=click.IntRange(1, 256), help="Fits at once on one device (default: 32 with a GPU, else 1)."
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
@click.option("--metrics-port", type=click.IntRange(1, 65535), help="Serve Prometheus metrics on this port.")
@click.option("--metrics-host", default="127.0.0.1", show_default=True, help="Address of the metrics.")
@click.option("--no-selftest", is_flag=True, help="Skip the known jobs that each process does first.")
def worker(
    resource: str,
    processes: int,
    batch: int | None,
    once: bool,
    max_jobs: int | None,
    grace_s: float,
    limit_factor: float,
    metrics_port: int | None,
    metrics_host: str,
    no_selftest: bool,
) -> None:
    """Runs continuously and takes jobs from all queues; start as many as you like, on any machine.

    SIGTERM or Ctrl-C ends it: the running job is finished within --grace, or put back. A job that crashes its process
    is tried again and becomes an error row the third time; a job beyond its time limit becomes one at once. Logs are
    JSON lines on stderr.

    \b
    Example: pbl worker
    Example: pbl worker --resource gpu --batch 32 --metrics-port 9108
    """
    import schemas
    from schemas import connection
    from workers.log import to_stderr
    from workers.process import Options
    from workers.supervisor import Supervisor

    schemas.activate(methods=False)  # a wrong address or login is reported here, not by a process that is started again
    to_stderr()
    options = Options(
        resource=resource,
        processes=processes,
        batch=batch or default_batch(resource),
        once=once,
        max_jobs=max_jobs,
        grace_s=grace_s,
        limit_factor=limit_factor,
        selftest=not no_selftest,
    )
    supervisor = Supervisor(options)
    if metrics_port is not None:
        supervisor.metrics.serve(metrics_port, metrics_host, connection.another)
    raise click.exceptions.Exit(supervisor.run())


def default_batch(resource: str) -> int:
    """128 where a GPU fits, else 1: among so many are enough of one size to be solved together.

    Asked without loading the numerical library, which would take the device.
    """
    import shutil

    return 128 if "fit" in GROUPS[resource] and shutil.which("nvidia-smi") else 1
