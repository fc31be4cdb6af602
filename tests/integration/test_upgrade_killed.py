"""An upgrade over all migrations whose process is killed at random statements, and begun again, loses no number.

pytest -m long tests/integration/test_upgrade_killed.py -s         # minutes; prints the statements it was killed at
"""

import random
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest

from pbl_pipeline import settings
from pbl_schemas import connection, migrations
from tests.database import embedded_only, installation, keep, put_back
from tests.rows import everything

pytestmark = [pytest.mark.long, pytest.mark.database, embedded_only]

#: Statements at which the upgrade is killed; the longest time (s) from the statement's begin to the kill.
KILLS, LATEST_S = 20, 0.03
#: Tables with the times of an upgrade: DataJoint's log, and when a migration was applied.
NOTES = ("~log", "~migrations")


def target(*words: object) -> subprocess.CompletedProcess[str]:
    """Run the target in a separate process."""
    command = [sys.executable, "-m", "tests.integration.upgrade_target", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)


def state() -> dict[str, Any]:
    """Every row of every table, every column and every foreign key; the migrations by name."""
    rows: dict[str, Any] = {t: r for t, r in everything().items() if t.split(".")[1] not in NOTES}
    with closing(connection.plain_connection()) as server, server.cursor() as cursor:
        cursor.execute(
            "SELECT table_schema, table_name, column_name, column_type, is_nullable, column_default, column_key,"
            " column_comment FROM information_schema.columns WHERE table_schema LIKE 'pbl\\_%' ORDER BY 1, 2, 3"
        )
        rows["columns"] = cursor.fetchall()
        cursor.execute(
            "SELECT table_schema, table_name, column_name, referenced_table_schema, referenced_table_name,"
            " referenced_column_name FROM information_schema.key_column_usage WHERE table_schema LIKE 'pbl\\_%'"
            " ORDER BY 1, 2, 3, 4, 5, 6"
        )
        rows["keys"] = cursor.fetchall()
        cursor.execute("SELECT number, name FROM pbl_lab.`~migrations` ORDER BY 1")
        rows["migrations"] = cursor.fetchall()
    return rows


def test_an_upgrade_killed_at_random_statements_gives_the_same_numbers(tmp_path: Path):
    draw = random.Random(34)
    with installation() as home:
        assert settings.home_dir() == home
        built = target("build", tmp_path)
        assert built.returncode == 0, built.stderr[-3000:]
        keep(home, "old")
        whole = target("migrate")
        assert whole.returncode == 0, whole.stderr[-3000:]
        statements = whole.stdout.splitlines()
        assert len(statements) > 5 * KILLS
        wanted = state()
        assert wanted["migrations"] == tuple((m.number, m.name) for m in migrations.available())
        sys.stdout.write(f"\n{len(statements)} statements, {sum(map(len, wanted.values()))} rows, columns and keys\n")
        for at in sorted(draw.sample(range(1, len(statements) + 1), KILLS)):
            put_back(home, "old")
            after_s = draw.choice([0.0, draw.uniform(0.0, LATEST_S)])
            killed = target("migrate", at, after_s)
            assert killed.returncode == -signal.SIGKILL, killed.stderr[-3000:]
            done = target("migrate")
            assert done.returncode == 0, f"killed at {at}: {statements[at - 1]}\n{done.stderr[-3000:]}"
            found = state()
            assert {t for t in wanted.keys() | found.keys() if wanted.get(t) != found.get(t)} == set(), statements[
                at - 1
            ]
            again = len(done.stdout.splitlines())
            sys.stdout.write(
                f"killed {1000 * after_s:4.1f} ms into {at:3}, {again:3} left: {statements[at - 1][:80]}\n"
            )
            sys.stdout.flush()
