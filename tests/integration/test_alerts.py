"""Each alert rule on the metrics that a worker prints, and how regular work ended, as an operator sees them."""

import json
import operator
import os
import platform
import re
import shutil
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml
from prometheus_client import CollectorRegistry, generate_latest
from prometheus_client.parser import text_string_to_metric_families

from pbl_pipeline import settings
from pbl_schemas import connection, video, worker
from pbl_workers import heartbeat, metrics
from tests import Environment, Limits, Machine, until
from tests.command import pbl, program

from .jobs import beat, queued

RULES = Path(__file__).parents[2] / "workers" / "deploy" / "alerts.yml"
#: All of the expressions that the rules use: an aggregate of a metric with one label, and a comparison.
TERM = re.compile(r'(?:(min|absent)\()?(\w+)(?:\{(\w+)="(\w+)"\})?\)?(?: (<|>|==) (\d+))?')
COMPARE = {"<": operator.lt, ">": operator.gt, "==": operator.eq}
_PROMTOOL = shutil.which("promtool")


class Printed:
    """The figures of the installation for a registry of Prometheus."""

    def collect(self) -> Iterator[Any]:
        server = connection.another()
        yield from metrics.figures(server)
        yield from metrics.machine_figures()
        server.close()


class Sample(NamedTuple):
    name: str
    labels: dict[str, str]
    value: float


def samples(figures: Any = None) -> list[Sample]:
    registry = CollectorRegistry()
    registry.register(figures or Printed())
    families = text_string_to_metric_families(generate_latest(registry).decode())
    return [Sample(s.name, s.labels, s.value) for family in families for s in family.samples]


def holds(expression: str, found: list[Sample]) -> bool:
    """Whether an expression of a rule has a result; that of Prometheus itself where its `promtool` is installed."""
    by_us = False
    for text in expression.split(" or "):
        term = TERM.fullmatch(text)
        assert term is not None, text
        how, name, label, wanted, compare, number = term.groups()
        values = [s.value for s in found if s.name == name and (label is None or s.labels[label] == wanted)]
        if how == "absent":
            by_us |= not values
        else:
            values = values and [min(values)] if how == "min" else values
            by_us |= any(COMPARE[compare](v, float(number)) for v in values)
    return by_us


def firing(figures: Any = None) -> set[str]:
    found = samples(figures)
    rules = yaml.safe_load(RULES.read_text())["groups"][0]["rules"]
    out = {rule["alert"] for rule in rules if holds(rule["expr"], found)}
    if _PROMTOOL is not None:
        assert out == {rule["alert"] for rule in rules if _by_promtool(rule["expr"], found)}
    return out


def _by_promtool(expression: str, found: list[Sample]) -> bool:
    series = [
        {
            "series": f"{s.name}{{{','.join(f'{k}={json.dumps(v)}' for k, v in s.labels.items())}}}",
            "values": str(s.value),
        }
        for s in found
    ]
    asked = {"expr": f"(count({expression}) > bool 0) or vector(0)", "eval_time": "0m"}
    test = {
        "tests": [
            {"input_series": series, "promql_expr_test": [asked | {"exp_samples": [{"labels": "{}", "value": 1}]}]}
        ]
    }
    path = settings.home_dir() / "promtool.yml"
    path.write_text(json.dumps(test))
    done = subprocess.run([str(_PROMTOOL), "test", "rules", str(path)], capture_output=True, text=True, check=False)
    assert done.returncode == 0 or "got:" in done.stderr + done.stdout, done.stderr + done.stdout
    return done.returncode == 0


def later(seconds: float, column: str = "worker_seen", where: str = "worker_resource='cron'") -> None:
    """Let so much time pass for rows of `Worker`."""
    connection.connect().query(
        f"UPDATE {worker.Worker.full_table_name} SET {column} = {column} - INTERVAL {seconds} SECOND WHERE {where}"
    )


@pytest.fixture
def healthy(tables: None, tmp_path: Path, environment: Environment) -> Iterator[Path]:
    """An installation whose regular work ran and one worker lives; yields PBL_BACKUP."""
    environment(PBL_BACKUP=tmp_path / "backups")
    for name in ("refresh", "release", "disk", "backup"):
        done = pbl("cron", name, *(["--least-free", "0"] if name == "disk" else []))
        assert done.code == 0, done.err
    beat("alive", 0.0)
    yield tmp_path / "backups"
    worker.Worker.delete_quick()


def test_nothing_fires_where_all_is_well(healthy: Path, machine: Machine):
    machine(free_bytes=10**12)
    assert firing() == set()


def test_a_backup_that_fails_is_seen(healthy: Path):
    shutil.rmtree(healthy)
    healthy.write_text("the disk is not mounted")
    assert pbl("cron", "backup").code == 1
    assert "PblBackupFailed" in firing()
    shown = pbl("status").out
    assert re.search(r"cron backup: succeeded \d+ s ago; failed \d+ s ago \([A-Z_]+,", shown), shown
    assert re.search(r"cron backup +succeeded .* failed .* ago \([A-Z_]+,", pbl("cron", "summary").out)
    (row,) = [c for c in json.loads(pbl("status", "--json").out)["cron"] if c["name"] == "backup"]
    assert re.fullmatch("[A-Z_]+", row["failed"])  # no path, which may name a person


def test_a_backup_that_does_not_come_is_seen(healthy: Path):
    later(27 * 3600.0, "worker_stopped", "worker='cron backup'")
    assert "PblBackupFailed" in firing()
    with worker.installation_lock("backup", connection.another()):  # the last one still runs
        assert pbl("cron", "backup").code == 75
    assert "PblBackupFailed" in firing()
    worker.Worker.delete_quick()
    assert {"PblNoBackup", "PblCronDead", "PblNoWorker"} <= firing()


def test_a_dead_cron_is_seen(healthy: Path):
    later(1900.0)
    assert "PblCronDead" in firing()
    assert "cron release: succeeded" in pbl("status").out
    pbl("cron", "release")
    assert "PblCronDead" not in firing()
    later(22000.0, "worker_stopped", "worker='cron release'")
    assert "PblCronStuck" in firing()


def test_work_that_takes_long_is_not_dead(healthy: Path, limits: Limits):
    limits(heartbeat, PERIOD_S=0.05)
    later(1900.0)
    with heartbeat.cron_pass("backup", 75):
        until = time.monotonic() + 60.0
        while "PblCronDead" in firing() and time.monotonic() < until:
            time.sleep(0.05)
        assert "PblCronDead" not in firing()


def test_an_old_queue_a_full_disk_and_a_lost_worker_are_seen(healthy: Path, tmp_path: Path, machine: Machine):
    assert queued(tmp_path, video.VideoInfo)
    jobs = video.VideoInfo.jobs.full_table_name
    connection.connect().query(f"UPDATE {jobs} SET created_time = created_time - INTERVAL 25 HOUR")
    machine(free_bytes=10**9)
    beat("killed", 300.0)
    beat("of yesterday", 90000.0)
    assert firing() == {"PblQueueOld", "PblDiskFull", "PblWorkerLost"}
    assert "1 workers lost" in pbl("status").out
    later(300.0, where="worker='alive'")
    assert "PblNoWorker" in firing()


def test_a_database_that_is_away_is_seen(healthy: Path):
    def away() -> Any:
        raise OSError("no route to it")

    with closing(metrics._Installation(away)) as figures:
        assert "PblDatabaseDown" in firing(figures)


def test_workers_count_regular_work_not_as_workers(healthy: Path):
    shown = pbl("status").out
    assert "worker alive:1" in shown
    assert shown.count("\nworker ") == 1


def test_gpus_and_resting_processes_are_shown_of_live_workers(
    healthy: Path, tmp_path: Path, environment: Environment, limits: Limits
):
    shown = pbl("status").out
    assert "\nGPUs of alive: unknown\n" in shown
    limits(heartbeat, PERIOD_S=0.05)
    program(tmp_path, "nvidia-smi", "echo '0, 37, 1000, 2000'; echo '1, [N/A], 0, 2000'")
    environment(PATH=f"{tmp_path}:{os.environ['PATH']}")
    with heartbeat.Heartbeat(worker.SUPERVISOR) as beats:
        beats.doing("process 2 (GPU 1) starts again 8 s after it died")
        until(lambda: "starts again" in pbl("status").out)
        for command in (("status",), ("cron", "summary")):
            shown = " ".join(pbl(*command).out.replace(": ", " ").split())
            assert f"worker {platform.node()} process 2 (GPU 1) starts again 8 s after it died" in shown
            assert f"GPU 0 of {platform.node()} 37% busy, 1.0 of 2.1 GB used" in shown
            assert f"GPU 1 of {platform.node()} 0.0 of 2.1 GB used" in shown
        found = {m["host"]: m["gpus"] for m in json.loads(pbl("status", "--json").out)["machines"]}
        assert found["alive"] is None
        assert found[platform.node()][1] == {"gpu": "1", "used": 0.0, "size": 2000 * 2**20}
        assert [s.value for s in samples() if s.name == "pbl_workers"] == [1.0]  # a supervisor takes no job
        program(tmp_path, "nvidia-smi", "exit 9")
        until(lambda: f"GPUs of {platform.node()}: unknown" in pbl("status").out)
        environment(PATH=os.environ["PATH"].partition(":")[2])
        until(lambda: f" of {platform.node()}" not in pbl("status").out)
    assert platform.node() not in pbl("status").out


def test_figures_of_the_installation_sum_up_over_workers(healthy: Path, tmp_path: Path, limits: Limits):
    queued(tmp_path, video.VideoInfo)
    jobs = video.VideoInfo.jobs
    limits(metrics, READ_EVERY_S=0.2)
    with ExitStack() as stack:
        both = [stack.enter_context(closing(metrics._Installation(connection.another))) for _ in range(2)]

        def summed() -> tuple[int, float]:
            found = [f for one in both for f in one.collect()]
            up = sum(s.value for f in found if f.name == "pbl_database_up" for s in f.samples)
            mine = [s for f in found if f.name == "pbl_queue_jobs" for s in f.samples]
            return int(up), sum(s.value for s in mine if s.labels == {"table": "VideoInfo", "status": "pending"})

        until = time.monotonic() + 60.0
        while summed() != (2, 1.0) and time.monotonic() < until:
            time.sleep(0.05)
        assert len(jobs.pending) == 1
        seen = set()
        for _ in range(20):
            seen.add(summed())
            time.sleep(0.05)
        assert seen == {(2, 1.0)}
        # The one that shows them loses its connection: the other one does.
        holder = connection.connect().query(
            f"SELECT turn_connection FROM {worker.Turn.full_table_name} WHERE work='metrics'"
        )
        connection.connect().query(f"KILL {int(holder.fetchone()[0])}")
        until = time.monotonic() + 60.0
        while summed() != (2, 1.0) and time.monotonic() < until:
            time.sleep(0.05)
        assert summed() == (2, 1.0)


def test_errors_are_counted_by_code(healthy: Path, tmp_path: Path):
    queued(tmp_path, video.VideoInfo)
    jobs = video.VideoInfo.jobs.full_table_name
    connection.connect().query(f"UPDATE {jobs} SET status='error', error_message='VIDEO_DAMAGED: found: x: y'")
    (errors,) = [s for s in samples() if s.name == "pbl_queue_errors"]
    assert (errors.labels, errors.value) == ({"table": "VideoInfo", "code": "VIDEO_DAMAGED"}, 1.0)
