"""Commands where no module and no name of POSIX is to be had; the chain on files so is in test_commands.py."""

import os
import subprocess
import sys

import pytest

from tests.without_posix import ABSENT_MODULES, ABSENT_NAMES, ROOT, pbl

PROBE = """
import tests.without_posix as without
without.install()
exec('import os, sys\\nassert not hasattr(os, "geteuid") and os.getpid() > 0', {'__name__': 'pbl_schemas.x'})
exec('import os, pwd; os.geteuid()', {'__name__': 'another'})
try:
    exec('import pwd', {'__name__': 'pbl_schemas.x'})
except ModuleNotFoundError:
    print('absent')
"""


def test_the_stand_in_takes_away_what_is_there():
    """The names are spelled as this system has them; a module of ours does not get them, one of others does."""
    assert [name for name in ABSENT_NAMES if not hasattr(os, name)] == []
    assert [name for name in ABSENT_MODULES if name not in sys.stdlib_module_names] == []
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, cwd=ROOT, check=False)
    assert done.stdout == "absent\n", done.stderr


@pytest.mark.slow
def test_every_command_is_found_without_posix():
    done = pbl("--help")
    assert done.code == 0, done.err[-2000:]
    for name in ("run", "report", "populate"):
        assert f"\n  {name} " in done.out


@pytest.mark.slow
def test_the_database_says_at_once_that_it_is_not_for_this_system(tmp_path):
    done = pbl("db", "start", variables={"PBL_HOME": str(tmp_path / "home")})
    assert (done.code, done.error_code) == (1, "DB_UNAVAILABLE")
    for way in ("docker compose", "DJ_HOST", "pbl run"):
        assert way in done.err
    assert not (tmp_path / "home").exists()
