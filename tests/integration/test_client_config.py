"""`pbl db config`: DataJoint alone, in the folder of the files, reaches the same database and the same store."""

import json
import os
import stat
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import pbl_schemas
from pbl_pipeline.errors import PblError
from pbl_schemas import connection
from pbl_schemas.datajoint_setup import dj
from pbl_schemas.operations import client_config
from pbl_schemas.store import further_stores
from tests import Environment
from tests.command import pbl
from tests.database import embedded_only

#: In a process that knows DataJoint and nothing of this project.
PLAIN = """
import sys
import datajoint as dj
own = dj.VirtualModule("own", "pbl_tried")
counted = own.Tried.aggr(own.Below, "curve", n="count(*)")
if repair := sys.argv[1]:
    try:
        counted.to_dicts()
    except Exception as error:
        print("without it:", error.args[0])
    exec(repair)
print("aggregated", counted.to_arrays("n").tolist())
print(own.Tried().fetch1("curve").load().tolist(), dj.config.safemode, dj.config.stores["far"]["secret_key"])
assert not [n for n in sys.modules if n.split(".")[0] in ("pbl_schemas", "pbl_pipeline")]
own.Tried().delete()
"""


@pytest.fixture
def stores(environment: Environment, database: Path, tmp_path: Path) -> None:
    """Stores of the lab's own, one with a key."""
    far = {"protocol": "s3", "endpoint": "s.example:9000", "bucket": "b", "location": "x", "access_key": "acc3ss"}
    raw = {"protocol": "file", "location": str(tmp_path / "raw")}
    environment(DJ_STORES=json.dumps({"default": "raw", "raw": raw, "far": {**far, "secret_key": "s3cret"}}))


@pytest.fixture
def tried(stores: None):
    """A table of the lab's own with a row."""
    pbl_schemas.activate()
    schema = dj.Schema("pbl_tried", connection=connection.connect())

    class Tried(dj.Manual):
        definition = """
        tried : int32
        ---
        curve : <npy@arrays>
        """

    table = schema(Tried)
    table.insert1({"tried": 1, "curve": np.arange(3.0)})

    class Below(dj.Manual):
        definition = """
        -> Tried
        below : int32
        """

    schema(Below, context={"Tried": Tried}).insert([(1, 1), (1, 2)])
    yield table
    schema.drop(prompt=False)
    connection.configure()


def test_plain_datajoint_connects_with_what_is_written(tried, tmp_path):
    out = tmp_path / "notebooks"
    done = pbl("db", "config", "--out", out)
    assert done.code == 0, done.err
    text = (out / "datajoint.json").read_text(encoding="utf-8")
    assert json.loads(text)["safemode"] is True
    secrets = {p.name: p.read_text(encoding="utf-8") for p in (out / ".secrets").iterdir()}
    assert {"database.user", "database.password", "stores.far.secret_key", ".gitignore"} <= secrets.keys()
    assert not [name for name, secret in secrets.items() if "password" in name or "key" in name if secret in text]
    assert stat.S_IMODE((out / ".secrets").stat().st_mode) == 0o700
    assert {stat.S_IMODE(p.stat().st_mode) for p in (out / ".secrets").iterdir()} == {0o600}
    assert str(out / ".secrets" / "database.password") in done.out

    below = out / "deeper"
    below.mkdir()
    env = {k: v for k, v in os.environ.items() if not k.startswith(("DJ_", "PBL_", "PYTHONPATH"))}
    asked = subprocess.run(
        [sys.executable, "-P", "-c", PLAIN, client_config.AGGREGATE if client_config.is_mariadb() else ""],
        cwd=below,
        env=env,
        capture_output=True,
        text=True,
        input="no\n",
        check=False,
    )
    assert "[0.0, 1.0, 2.0] True s3cret" in asked.stdout, asked.stderr
    assert "aggregated [2]" in asked.stdout
    assert ("without it: 1055" in asked.stdout) == client_config.is_mariadb()
    assert (client_config.AGGREGATE in done.out) == client_config.is_mariadb()
    assert "Commit deletes?" in asked.stdout  # safemode asks a person, who says no
    assert len(tried()) == 1


#: A schema of the user's own, in a process that knows DataJoint only.
OWN = """
import datajoint as dj
schema = dj.Schema("maria_b_mylab")

@schema
class Walk(dj.Manual):
    definition = "walk : int32"

Walk.insert1({"walk": 1})
print("rows", len(Walk()))
schema.drop(prompt=False)
try:
    dj.Schema("maria")
except dj.DataJointError as error:
    print(error)
"""


@embedded_only
def test_the_user_of_the_embedded_database_creates_schemas_of_the_users_own(database, tmp_path, environment):
    environment(LOGNAME="Maria.B")
    done = pbl("db", "config", "--out", tmp_path)
    assert "Your own schemas begin with maria_b_ or pbl_, such as dj.Schema('maria_b_mylab')" in done.out
    env = {k: v for k, v in os.environ.items() if not k.startswith(("DJ_", "PBL_", "PYTHONPATH"))}
    own = subprocess.run(
        [sys.executable, "-P", "-c", OWN], cwd=tmp_path, env=env, capture_output=True, text=True, check=False
    )
    assert "rows 1\n" in own.stdout, own.stderr
    assert "could not be created" in own.stdout


def test_files_that_are_there_are_left_unless_told(database, tmp_path):
    (tmp_path / "datajoint.json").write_text("{}", encoding="utf-8")
    done = pbl("db", "config", "--out", tmp_path)
    assert (done.code, done.error_code) == (1, "FILE_UNWRITABLE")
    assert (tmp_path / "datajoint.json").read_text(encoding="utf-8") == "{}"
    assert pbl("db", "config", "--out", tmp_path, "--overwrite").code == 0
    (tmp_path / ".secrets" / "another").write_text("kept", encoding="utf-8")
    assert pbl("db", "config", "--out", tmp_path, "--overwrite").code == 0
    assert (tmp_path / ".secrets" / "another").is_file()
    assert json.loads((tmp_path / "datajoint.json").read_text(encoding="utf-8"))["database.port"]


def test_a_labs_own_stores_stand_beside_ours(tried):
    assert set(dj.config.stores) == {"default", "raw", "far", connection.STORE}
    assert dj.config.stores["default"] == "raw"
    assert dj.config.stores[connection.STORE]["protocol"] == "file"


@pytest.mark.parametrize("value", ["[1]", "no json s3cret", '{"arrays": {"protocol": "file"}}'])
def test_stores_that_cannot_be_are_refused_without_their_keys(environment, value):
    environment(DJ_STORES=value)
    with pytest.raises(PblError, match="USAGE") as caught:
        further_stores(connection.STORE)
    assert "s3cret" not in caught.value.text()
