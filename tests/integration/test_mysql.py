"""The tables on a real MySQL, fetched and started in a folder of its own: 20 minutes on two cores.

    pytest -m machine tests/integration/test_mysql.py

Most of it is the tests of the embedded database again, each file in a process of its own with the other server.
"""

import json
import multiprocessing
import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from pbl_schemas import connection, video
from pbl_schemas.intake import VisitRecord, ingest
from pbl_schemas.jobs import jobs_of
from pbl_schemas.operations.declare import declare_all
from pbl_workers import refresh
from pbl_workers.populate import populate
from tests import mysql
from tests.command import pbl
from tests.database import installation
from tests.rows import everything, register, remove_all

from . import chain, contention

ROOT = Path(__file__).resolve().parents[2]
#: Files of tests that pass on MySQL as they are: the chain and views, joins, accounts, backup, migrations.
FILES = (
    "test_tables.py",
    "test_joins.py",
    "test_client_config.py",
    "test_roles.py",
    "test_backup.py",
    "test_migrations.py",
    "test_catalog.py",
    "test_linking.py",
)

pytestmark = pytest.mark.machine


@pytest.fixture(scope="module")
def root() -> Path:
    """The unpacked server. Skips where it cannot be had."""
    try:
        return mysql.programs()
    except mysql.NoMySQL as error:
        pytest.skip(str(error))


def _environment(root: Path) -> dict[str, str]:
    own = {mysql.CHOICE: "mysql", mysql.ROOT: str(root), "PYTHONPATH": str(ROOT)}
    return {**{k: v for k, v in os.environ.items() if not k.startswith("DJ_")}, **own}


@pytest.fixture(scope="module")
def on_mysql(root: Path) -> Iterator[Path]:
    """All tables on a MySQL server; PBL_HOME."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(mysql.CHOICE, "mysql")
        patch.setenv(mysql.ROOT, str(root))
        with installation() as home:
            declare_all()
            yield home


@pytest.mark.parametrize("name", FILES)
def test_the_tests_of_tables_pass_on_mysql(root: Path, name: str):
    file = ROOT / "tests" / "integration" / name
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(file)]
    done = subprocess.run(command, env=_environment(root), cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-5000:]


def _values(rows: dict[str, list[tuple]]) -> dict[str, list[tuple]]:
    """Rows with their JSON read: MySQL sorts the keys of an object, by length first, and MariaDB keeps the text."""
    return {name: sorted((tuple(map(_value, row)) for row in found), key=str) for name, found in rows.items()}


def _value(value: Any) -> Any:
    text = value.decode() if isinstance(value, bytes) and value[:1] in (b"{", b"[") else value
    if isinstance(text, str) and text[:1] in ("{", "["):
        return json.dumps(json.loads(text), sort_keys=True)
    return value


def test_a_backup_of_mysql_is_restored_into_mariadb(
    on_mysql: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stand_ins: None
):
    ingest([chain.small_video(tmp_path, "walk")], VisitRecord(subject="P001", project="gait"))
    assert not [t for t in populate().tables if t.errors]
    version = str(connection.connect().query("SELECT VERSION()").fetchone()[0])
    before = everything()
    assert pbl("db", "backup", tmp_path / "backup").code == 0
    with monkeypatch.context() as patch:
        patch.delenv(mysql.CHOICE)
        with installation():
            restored = pbl("db", "restore", tmp_path / "backup")
            assert restored.code == 0, restored.err
            assert "MariaDB" in str(connection.connect().query("SELECT VERSION()").fetchone()[0])
            after = everything()
    connection.connect()
    assert "MariaDB" not in version
    assert before.keys() == after.keys()
    assert sum(map(len, before.values())) > 300
    assert _values(before) == _values(after)


def test_twenty_workers_share_a_queue(on_mysql: Path, tmp_path: Path):
    """Each job is done once, by one of twenty processes that ask at the same time."""
    remove_all()
    n = 100
    register(*(chain.small_video(tmp_path, f"walk{i}", n=8 + i) for i in range(n)))
    refresh.refresh()
    context = multiprocessing.get_context("spawn")
    gate, said = context.Barrier(20), context.Queue()
    workers = [context.Process(target=contention.work, args=(gate, said)) for _ in range(20)]
    for worker in workers:
        worker.start()
    done: Counter[int] = Counter()
    for _ in workers:
        done.update(said.get(timeout=300))
    for worker in workers:
        worker.join(60)
    assert [w.exitcode for w in workers] == [0] * 20
    assert sorted(done) == sorted(video.Video.to_arrays("video_id").tolist())
    assert set(done.values()) == {1}
    assert len(video.VideoInfo()) == n
    assert len(jobs_of(video.VideoInfo)) == 0


def test_a_minute_of_faults_loses_nothing(root: Path):
    """research/reports/2026-11-29_operations.md has ten minutes of the same."""
    command = [sys.executable, "-m", "research.benchmarks.chaos", "--minutes", "1", "--database", "mysql"]
    done = subprocess.run(command, env=_environment(root), cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
