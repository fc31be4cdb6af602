"""The embedded server and the connection to it, on servers of their own."""

import dataclasses
import json
import os
import signal
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pymysql
import pytest
from click.testing import CliRunner

from pbl_pipeline.errors import PblError
from pbl_schemas import connection
from pbl_schemas.cli.db import db
from pbl_schemas.operations import embedded
from pbl_schemas.operations.embedded import binaries, process, server
from pbl_schemas.operations.embedded.folder import UNPRIVILEGED, server_account
from tests import Environment, Machine, refused
from tests.command import PBL, program
from tests.database import new_home, remove_home

pytestmark = pytest.mark.database


@pytest.fixture(scope="module")
def home() -> Iterator[Path]:
    """A home of this module's own, for tests that stop and kill the server; every test finds it in any state."""
    path = new_home()
    yield path
    remove_home(path)


@pytest.fixture
def fresh() -> Iterator[Path]:
    """A home for one test, without a database."""
    path = new_home()
    yield path
    remove_home(path)


def folder(home: Path) -> embedded.Folder:
    return embedded.Folder(home / "db")


def environment(home: Path, **more: str) -> dict[str, str]:
    kept = {k: v for k, v in os.environ.items() if not k.startswith("DJ_") and k not in ("PBL_STORE", "PBL_DB_PREFIX")}
    return {**kept, "PBL_HOME": str(home), **more}


def pbl(home: Path, *arguments: str, **more: str) -> subprocess.CompletedProcess[str]:
    """Run a command of `pbl` in a process of its own."""
    env = environment(home, **more)
    return subprocess.run([*PBL, *arguments], capture_output=True, text=True, env=env, timeout=300, check=False)


def login(home: Path) -> pymysql.Connection:
    where = folder(home)
    password = where.credentials().app_password
    return pymysql.connect(host="127.0.0.1", port=where.state()["port"], user="pbl", password=password, autocommit=True)


def query(connection: pymysql.Connection, sql: str) -> tuple:
    with connection.cursor() as cursor:
        cursor.execute(sql)
        return tuple(cursor.fetchall())


def servers_of(home: Path) -> list[int]:
    """Process numbers of all servers that have this home's data folder open, looked up independently of our files."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                words = (entry / "cmdline").read_text().split("\0")
            except OSError:
                continue
            if words[0].endswith("mariadbd") and f"--datadir={home}/db/data" in words:
                found.append(int(entry.name))
    return found


# ---------------------------------------------------------------- start and stop


def test_two_starts_at_once_give_one_server(home: Path):
    embedded.stop(folder=folder(home))
    both = [
        subprocess.Popen([*PBL, "db", "start"], env=environment(home), stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for _ in range(2)
    ]
    said = [process.communicate(timeout=300)[0].decode() for process in both]
    assert [process.returncode for process in both] == [0, 0], said
    assert len(servers_of(home)) == 1
    assert sum("already" in text for text in said) == 1
    # The commands have ended, the server has not, and it is in a session of its own: no terminal takes it along.
    now = embedded.status(folder(home))
    assert now.running
    assert servers_of(home) == [now.pid]
    assert os.getsid(now.pid or 0) == now.pid


def test_start_and_stop_can_be_repeated(home: Path):
    first = embedded.start(folder=folder(home))
    second = embedded.start(folder=folder(home))
    assert (first.pid, first.port) == (second.pid, second.port)
    assert embedded.stop(folder=folder(home)) is True
    assert servers_of(home) == []
    assert embedded.stop(folder=folder(home)) is False
    third = embedded.start(folder=folder(home))
    assert third.port == first.port
    assert third.pid != first.pid


def test_after_the_demo_any_command_starts_the_server_and_after_a_stop_none(home: Path):
    embedded.start(folder=folder(home))
    embedded.stop(folder=folder(home), on_demand=True)
    assert servers_of(home) == []
    assert not embedded.status(folder(home)).running  # a look does not start it
    done = pbl(home, "list", "subjects")
    assert done.returncode == 0, done.stderr
    assert len(servers_of(home)) == 1
    embedded.stop(folder=folder(home))
    assert "DB_NOT_RUNNING" in pbl(home, "list", "subjects").stderr
    assert servers_of(home) == []


def test_kill_9_loses_no_committed_row(home: Path):
    embedded.start(folder=folder(home))
    with login(home) as connection:
        query(connection, "CREATE DATABASE IF NOT EXISTS pbl_kill")
        query(connection, "CREATE OR REPLACE TABLE pbl_kill.t (i INT PRIMARY KEY)")
        for i in range(200):
            query(connection, f"INSERT INTO pbl_kill.t VALUES ({i})")
        query(connection, "START TRANSACTION")
        query(connection, "INSERT INTO pbl_kill.t VALUES (999)")
        os.kill(servers_of(home)[0], signal.SIGKILL)
    while servers_of(home):
        time.sleep(0.01)
    assert not embedded.status(folder(home)).running
    done = pbl(home, "db", "start")
    assert done.returncode == 0, done.stderr
    with login(home) as connection:
        assert query(connection, "SELECT COUNT(*), MAX(i) FROM pbl_kill.t") == ((200, 199),)


def test_a_recycled_process_number_is_not_taken_for_the_server(home: Path):
    embedded.stop(folder=folder(home))
    folder(home).write_state(pid=os.getpid())
    assert embedded.status(folder(home)).pid is None
    assert embedded.stop(folder=folder(home)) is False
    assert embedded.start(folder=folder(home)).running


def test_another_port_when_the_stored_one_is_taken(home: Path):
    port = embedded.start(folder=folder(home)).port
    embedded.stop(folder=folder(home))
    with socket.create_server(("127.0.0.1", port or 0)):
        now = embedded.start(folder=folder(home))
    assert now.running
    assert now.port != port


def test_a_long_path_is_no_obstacle(fresh: Path):
    # A socket's path may have 107 bytes; the folder's alone has more here.
    deep = embedded.Folder(fresh / ("long-" * 30) / "db")
    assert embedded.start(folder=deep).running
    embedded.stop(folder=deep)


def test_a_server_that_cannot_start_says_why(fresh: Path):
    where = folder(fresh)
    embedded.start(folder=where)
    embedded.stop(folder=where)
    (where.data / "ibdata1").write_bytes(b"not a tablespace")
    with pytest.raises(PblError, match="DB_UNAVAILABLE") as caught:
        embedded.start(folder=where)
    assert "InnoDB" in caught.value.found  # the server's own words
    assert "server.log" in caught.value.next_step


def test_too_little_space_is_said_before_anything_is_written(fresh: Path, machine: Machine):
    machine(free_bytes=30_000_000)
    with pytest.raises(PblError, match="DB_UNAVAILABLE") as caught:
        embedded.start(folder=folder(fresh))
    assert caught.value.found.startswith("30 MB")
    assert not folder(fresh).path.exists()


def test_a_set_up_that_ended_half_way_is_begun_again(fresh: Path, monkeypatch: pytest.MonkeyPatch):
    """A full disk leaves nothing behind; the remains of a killed process are replaced."""
    where, real = folder(fresh), server.get_server()
    half = 'for a in "$@"; do case $a in --datadir=*) echo half > "${a#*=}/ibdata1";; esac; done\n'
    full = program(fresh, "install", f'{half}echo "[ERROR] Errcode: 28 No space left on device"; exit 1\n')
    monkeypatch.setattr(server, "get_server", lambda say: dataclasses.replace(real, install_db=full))
    error = refused("DB_UNAVAILABLE", embedded.start, folder=where)
    assert "No space left on device" in error.found
    assert not where.initialised()
    assert not where.data.exists()
    monkeypatch.undo()
    where.data.mkdir()
    (where.data / "ibdata1").write_text("half")
    assert embedded.start(folder=where).running


@pytest.mark.parametrize(
    ("line", "advice"),
    [
        ("[ERROR] InnoDB: preallocating 268435456 bytes for file ./ib_logfile101 failed with error 28", "disk is full"),
        ('[ERROR] mariadbd: Error writing file (Errcode: 28 "No space left on device")', "disk is full"),
        ('[ERROR] Can\'t create test file (Errcode: 13 "Permission denied")', "another user"),
        ("[ERROR] InnoDB: Unable to lock ./ibdata1 error: 11", "another server"),
        ("[ERROR] InnoDB: Page corrupted", "server.log"),
    ],
)
def test_the_log_is_read_for_advice(tmp_path: Path, line: str, advice: str):
    where = embedded.Folder(tmp_path)
    where.run.mkdir()
    where.log.write_text(f"2026-11-20 [Note] Starting MariaDB as process 128\n{line}\n")
    assert advice in process._advice(where)


# ---------------------------------------------------------------- who may do what


def test_no_login_without_a_password(database: Path):
    where = folder(database)
    state = where.state()
    with pymysql.connect(
        host="127.0.0.1", port=state["port"], user="pbl_admin", password=where.credentials().admin_password
    ) as admin:
        accounts = query(admin, "SELECT User, Host, Priv FROM mysql.global_priv")
    by_name = {(user, host): json.loads(priv) for user, host, priv in accounts}
    assert set(by_name) - {("PUBLIC", "")} == {
        ("mariadb.sys", "localhost"),
        ("pbl", "127.0.0.1"),
        ("pbl_admin", "127.0.0.1"),
    }
    assert by_name["mariadb.sys", "localhost"]["account_locked"] is True
    for name in (("pbl", "127.0.0.1"), ("pbl_admin", "127.0.0.1")):
        assert len(by_name[name]["authentication_string"]) > 20
    where_from = [{"host": "127.0.0.1", "port": state["port"]}, {"unix_socket": os.path.relpath(where.run / "s.sock")}]
    for address in where_from:
        for user in ("root", "pbl", "pbl_admin", "mariadb.sys", "somebody"):
            with pytest.raises(pymysql.err.OperationalError) as caught:
                pymysql.connect(**address, user=user, password="")
            assert caught.value.args[0] in (1045, 1130, 1698, 4151), caught.value  # refused, not unreachable


def test_the_application_sees_its_own_schemas_only(database: Path):
    with login(database) as connection:
        query(connection, "CREATE DATABASE pbl_mine")
        query(connection, "DROP DATABASE pbl_mine")
        for forbidden in (
            "SELECT * FROM mysql.global_priv",
            "CREATE DATABASE other_mine",
            "CREATE DATABASE pblxmine",  # the underscore of the pattern is not a wildcard
            "SHUTDOWN",
        ):
            with pytest.raises((pymysql.err.OperationalError, pymysql.err.ProgrammingError)) as caught:
                query(connection, forbidden)
            assert caught.value.args[0] in (1044, 1142, 1227)


def test_another_prefix_is_granted_and_a_bad_one_refused(database: Path):
    embedded.allow_prefix("lab2", folder(database))
    with login(database) as connection:
        query(connection, "CREATE DATABASE lab2_video")
        query(connection, "DROP DATABASE lab2_video")
    with pytest.raises(PblError, match="USAGE"):
        embedded.allow_prefix("x`; DROP", folder(database))


def test_it_listens_on_the_loopback_only(database: Path):
    port = folder(database).state()["port"]
    listening = []
    for table in ("tcp", "tcp6"):
        for line in (Path("/proc/net") / table).read_text().splitlines()[1:]:
            local, state = line.split()[1], line.split()[3]
            address, hex_port = local.split(":")
            if state == "0A" and int(hex_port, 16) == port:  # 0A: LISTEN
                listening.append(address)
    assert listening == ["0100007F"]  # 127.0.0.1, low byte first


def test_passwords_stay_in_one_closed_file(database: Path):
    where = folder(database)
    assert stat.S_IMODE(where.credentials_file.stat().st_mode) == 0o600
    assert stat.S_IMODE(where.data.stat().st_mode) == 0o700
    secrets = (where.credentials().app_password, where.credentials().admin_password)
    assert len(set(secrets)) == 2
    pid = embedded.status(where).pid
    seen = [Path(f"/proc/{pid}/cmdline").read_bytes(), where.state_file.read_bytes(), where.log.read_bytes()]
    assert not any(secret.encode() in text for secret in secrets for text in seen)


def test_the_server_is_not_root(database: Path):
    pid = embedded.status(folder(database)).pid
    uids = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("Uid:"))
    assert "0" not in uids.split()[1:]


@pytest.mark.skipif(os.geteuid() != 0, reason="only root drops to another account")
def test_a_folder_the_server_cannot_enter_is_named(fresh: Path):
    closed = fresh / "closed"
    closed.mkdir(mode=0o700)
    done = pbl(closed / "home", "db", "start")
    assert done.returncode == 1
    assert "DB_UNAVAILABLE" in done.stderr
    assert f"'nobody', which the database server runs as, cannot enter {closed}\n" in done.stderr.replace(
        "mysql", "nobody"
    )
    assert "PBL_HOME" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.skipif(os.geteuid() != 0, reason="only root drops to another account")
@pytest.mark.parametrize("umask", [0o000, 0o077], ids=oct)
def test_the_server_enters_its_folder_and_nobody_else_writes_there_under_any_umask(fresh: Path, umask: int):
    deeper, before = embedded.Folder(fresh / "deeper/db"), os.umask(umask)
    try:
        deeper.create(server_account(deeper.data))
        modes = [stat.S_IMODE(p.stat().st_mode) for p in (deeper.path.parent, deeper.path, deeper.data)]
        assert modes == [0o755, 0o755, 0o700]
    finally:
        os.umask(before)


def test_root_leaves_a_database_with_its_owner(tmp_path: Path):
    data = tmp_path / "data"
    assert server_account(data).name in UNPRIVILEGED
    data.mkdir()
    os.chown(data, 12345, 12345)
    assert server_account(data).uid == 12345


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path):
    tmp_path.chmod(0o500)
    with pytest.raises(PblError, match="DB_UNAVAILABLE"):
        embedded.start(folder=embedded.Folder(tmp_path / "db"))


# ---------------------------------------------------------------- getting the server


@pytest.fixture
def without_server(environment: Environment, machine: Machine) -> Callable[..., None]:
    """Makes this machine look like one without MariaDB, whose apt is the script `apt` ("": it has none)."""

    def take_away(home: Path, apt: str = "") -> None:
        (home / "bin").mkdir()
        for name in ("apt-get", "dpkg", "env", "sudo") if apt else ():
            program(home / "bin", name, apt)
        environment(PBL_HOME=home, PATH=home / "bin")
        machine(servers=False)

    return take_away


def test_no_server_and_no_apt_points_to_docker(without_server: Callable[..., None], tmp_path: Path):
    without_server(tmp_path)
    with pytest.raises(PblError, match="DB_UNAVAILABLE") as caught:
        embedded.get_server()
    assert "no apt" in caught.value.found
    assert "docker compose" in caught.value.next_step


def test_offline_fetches_nothing(without_server: Callable[..., None], environment: Environment, tmp_path: Path):
    without_server(tmp_path, "exit 1\n")
    environment(PBL_OFFLINE="1")
    with pytest.raises(PblError, match="PBL_OFFLINE"):
        embedded.get_server()


def test_what_apt_says_reaches_the_reader(without_server: Callable[..., None], tmp_path: Path):
    refusal = "E: Unable to locate package mariadb-server-core"
    without_server(tmp_path, f"echo Reading package lists...\necho '{refusal}' >&2\nexit 100\n")
    said: list[str] = []
    with pytest.raises(PblError, match="Unable to locate package") as caught:
        embedded.get_server(said.append)
    assert caught.value.code == "DB_UNAVAILABLE"
    assert any("MariaDB" in line for line in said)
    assert not (tmp_path / "server").exists()
    assert not (tmp_path / "server.tmp").exists()


def test_an_unpacked_server_is_found_with_its_libraries(without_server: Callable[..., None], tmp_path: Path):
    without_server(tmp_path)
    library = tmp_path / "server/usr/lib/x86_64-linux-gnu/liburing.so.2"
    for path in (tmp_path / "server/usr/sbin/mariadbd", tmp_path / "server/usr/bin/mariadb-install-db", library):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch(mode=0o755)
    found = embedded.find_server()
    assert found is not None
    assert found.basedir == tmp_path / "server/usr"
    assert found.environment()["LD_LIBRARY_PATH"] == str(library.parent)


def test_the_servers_environment_holds_none_of_ours(environment: Environment):
    environment(DJ_PASS="secret")
    assert "secret" not in embedded.Binaries(Path("a"), Path("b"), Path("c")).environment().values()
    assert binaries.PACKAGES == ("mariadb-server-core", "mariadb-client-core")


# ---------------------------------------------------------------- the connection

CONNECT = "from pbl_schemas import connection; c = connection.connect(); print('user', c.get_user()); "


def python(home: Path, code: str, **more: str) -> tuple[subprocess.CompletedProcess[str], float]:
    """Run code in a process of its own with an error of ours as text, and say how many seconds it took once the tables
    were imported; DataJoint keeps one connection a process."""
    frame = """
import pathlib, sys, time
import pbl_schemas.connection
from pbl_pipeline.errors import PblError as E
begin = time.monotonic()
try:
    exec({!r})
except E as e:
    sys.exit(str(e))
finally:
    pathlib.Path({!r}).write_text(str(time.monotonic() - begin))
"""
    took = home / "took.txt"
    code = frame.format(code, str(took))
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env=environment(home, **more),
        timeout=300,
        check=False,
        cwd=home,
    )
    return done, float(took.read_text())


def test_not_running_is_said_quickly(home: Path):
    embedded.start(folder=folder(home))
    embedded.stop(folder=folder(home))
    done, seconds = python(home, CONNECT)
    assert done.returncode == 1
    assert "DB_NOT_RUNNING" in done.stderr
    assert "pbl db start" in done.stderr
    assert seconds < 5


def test_never_set_up_is_not_running(tmp_path: Path):
    done, _ = python(tmp_path, CONNECT)
    assert "DB_NOT_RUNNING" in done.stderr
    assert "pbl db start" in done.stderr


def test_a_server_that_keeps_silent_is_given_up(tmp_path: Path):
    assert connection.CONNECT_TIMEOUT_S <= 5.0
    impatient = f"from pbl_schemas import connection; connection.CONNECT_TIMEOUT_S = 1.0; {CONNECT}"
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = str(silent.getsockname()[1])
        done, seconds = python(tmp_path, impatient, DJ_HOST="127.0.0.1", DJ_PORT=port, DJ_USER="u", DJ_PASS="p")
    assert "DB_NOT_RUNNING" in done.stderr
    assert seconds < 10


def test_a_configured_server_is_used(database: Path, tmp_path: Path):
    """DJ_HOST leads to that server, and nothing is started in PBL_HOME."""
    tmp_path.chmod(0o755)
    port, password = str(folder(database).state()["port"]), folder(database).credentials().app_password
    dj = {"DJ_HOST": "127.0.0.1", "DJ_PORT": port, "DJ_USER": "pbl", "DJ_PASS": password}
    done, _ = python(tmp_path, CONNECT, **dj)
    assert done.stdout.strip() == "user pbl@127.0.0.1", done.stderr
    started = pbl(tmp_path, "db", "start", **dj)
    assert started.returncode == 0, started.stderr
    assert f"127.0.0.1:{port}" in started.stdout
    assert not (tmp_path / "db").exists()


def test_a_datajoint_json_nearby_changes_nothing(database: Path, tmp_path: Path):
    (tmp_path / "datajoint.json").write_text(json.dumps({"database.host": "elsewhere.invalid", "database.user": "x"}))
    code = f"import os; os.chdir({str(tmp_path)!r}); {CONNECT}"
    done, _ = python(database, code)
    assert done.stdout.strip() == "user pbl@127.0.0.1", done.stderr


TABLES = '''
import numpy as np
from pbl_schemas import connection
from pbl_schemas.operations import embedded
from pbl_schemas.connection import dj
schema = dj.Schema()
@schema
class A(dj.Manual):
    definition = """
    a : int32
    ---
    note=null : json
    """
@schema
class B(dj.Computed):
    definition = """
    -> A
    ---
    curve : <npy@arrays>
    packed : <blob@arrays>
    """
    def make(self, key):
        value = np.arange(12, dtype="float32").reshape(3, 4) * key["a"]
        self.insert1({**key, "curve": value, "packed": {"value": value}})
c = connection.connect()
connection.bind("shim", schema)
'''


def test_aggregation_json_and_arrays_work_on_mariadb(home: Path):
    """What DataJoint cannot do on MariaDB by itself, and the store of arrays in the running user's hands."""
    embedded.start(folder=folder(home))
    code = TABLES + (
        "A.insert([{'a': i, 'note': {'quote': chr(39) + chr(34) + chr(92), 'n': [i]}} for i in range(3)])\n"
        "B.populate()\n"
        "print([r['n'] for r in A.aggr(B, n='count(*)').to_dicts()])\n"
        "note = (A & 'a=2').fetch1('note')\n"
        "print(note == {'quote': chr(39) + chr(34) + chr(92), 'n': [2]})\n"
        "print(np.asarray((B & 'a=2').fetch1('curve')).tolist()[2])\n"
        "print((B & 'a=2').fetch1('packed')['value'].dtype, schema.database)\n"
        "schema.drop(prompt=False)\n"
    )
    done, _ = python(home, code)
    assert done.stdout.splitlines() == ["[1, 1, 1]", "True", "[16.0, 18.0, 20.0, 22.0]", "float32 pbl_shim"], (
        done.stderr
    )
    assert "not officially supported" not in done.stderr
    assert list((home / "store").rglob("*.npy"))


def test_bound_tables_follow_a_restarted_server(home: Path):
    embedded.start(folder=folder(home))
    code = TABLES + (
        "A.insert1({'a': 1})\n"
        "embedded.stop()\n"
        "folder = embedded.Folder.default()\n"
        "old = folder.state()['port']\n"
        "folder.write_state(port=old + 1)\n"
        "embedded.start()\n"
        "again = connection.connect()\n"
        "print(again is c, len(A()), again.conn_info['port'] != old)\n"
        "print(A.aggr(B, n='count(packed)').to_dicts())\n"  # the repairs hold on the new connection too
        "schema.drop(prompt=False)\n"
    )
    done, _ = python(home, code)
    assert done.stdout.splitlines() == ["True 1 True", "[{'a': 1, 'n': 0}]"], done.stderr
    assert "Warning" not in done.stderr


def test_keys_differ_by_case_and_large_arrays_fit(home: Path):
    embedded.start(folder=folder(home))
    with login(home) as connection:
        query(connection, "CREATE DATABASE IF NOT EXISTS pbl_size")
        query(connection, "CREATE OR REPLACE TABLE pbl_size.t (k VARCHAR(8) PRIMARY KEY, b LONGBLOB)")
        with connection.cursor() as cursor:
            cursor.execute(
                "INSERT INTO pbl_size.t VALUES ('a', %s), ('A', ''), ('\u00e9\U0001f6b6', '')", (b"x" * 12_000_000,)
            )
        assert query(connection, "SELECT COUNT(*), MAX(LENGTH(b)) FROM pbl_size.t") == ((3, 12_000_000),)
        query(connection, "DROP DATABASE pbl_size")


# ---------------------------------------------------------------- the command


def test_status_tells_whether_it_answers(home: Path):
    embedded.start(folder=folder(home))
    done = pbl(home, "db", "status", "--json")
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["running"] is True
    assert told["pid"] == servers_of(home)[0]
    assert told["host"] == "127.0.0.1"
    assert "MariaDB" in told["version"]
    assert {"uptime_s", "data_mb", "port", "folder"} <= set(told)
    assert pbl(home, "db", "stop").returncode == 0
    done = pbl(home, "db", "status", "--json")
    assert done.returncode == 1
    assert json.loads(done.stdout)["running"] is False
    assert "DB_NOT_RUNNING" in done.stderr
    assert "pbl db start" in done.stderr
    assert pbl(home, "db", "stop").returncode == 0


def test_each_command_has_an_example():
    for name, command in db.commands.items():
        done = CliRunner().invoke(command, ["--help"])
        assert done.exit_code == 0
        assert f"Example: pbl db {name}" in done.output
