# shellcheck shell=bash
# Sourced by every script here, first thing. Works in a temporary folder that is removed at the end.
#
#   install [--into NAME] PACKAGE==VERSION ...   a virtual environment NAME (`venv`) with these packages
#   observe NAME                                 run the Python script on standard input there; its output is what is seen;
#                                                with exit status 75 it could not do its work here
#   mimic_server                                 a server of MySQL's protocol for the next script: `mimic.running`
#   expect                                       compare what was seen with standard input; exits 0 or 1
#
# Exit codes: 0 behaves as described, 1 changed, 2 cannot run here.

set -euo pipefail
work=$(mktemp -d "${TMPDIR:-/tmp}/finding.XXXXXX")
trap 'rm -rf "$work"' EXIT
cd "$work"
: >seen
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_ROOT_USER_ACTION=ignore PYTHONWARNINGS=ignore PYTHONUTF8=1
unset PYTHONPATH PYTHONHOME VIRTUAL_ENV

cannot_run() {
  printf 'cannot run here: %s\n' "$1" >&2
  exit 2
}

install() {
  local name=venv
  if [[ $1 == --into ]]; then
    name=$2
    shift 2
  fi
  if [[ ! -x $name/bin/python ]]; then
    "${PYTHON:-python3}" -m venv "$name" >venv.log 2>&1 || cannot_run "no virtual environment with ${PYTHON:-python3}"
  fi
  "$name/bin/python" -m pip install --quiet --only-binary :all: "$@" >pip.log 2>&1 ||
    cannot_run "pip could not install $*: $(grep -m 1 '^ERROR' pip.log || echo 'no message')"
}

observe() {
  local name=$1 status=0
  cat >script.py
  "$name/bin/python" script.py >>seen 2>script.err || status=$?
  if ((status == 75)); then
    cannot_run "$(tail -n 1 script.err)"
  elif ((status)); then
    { printf 'the script ended with %s: ' "$status"; tail -n 1 script.err; } >>seen
  fi
}

# A server that answers every query with one row, written to server.py, and mimic.py with its start: `with running()`.
mimic_server() {
  cat >server.py <<'PY'
import asyncio, sys
from mysql_mimic import MysqlServer, Session

class One(Session):
    async def query(self, expression, sql, attrs):
        return [(1,)], ["one"]

    async def schema(self):
        return {}

async def main():
    server = MysqlServer(session_factory=One)
    await server.start_server(host="127.0.0.1", port=int(sys.argv[1]))
    print("ready", flush=True)
    await server.serve_forever()

asyncio.run(main())
PY
  cat >mimic.py <<'PY'
import contextlib, socket, subprocess, sys

@contextlib.contextmanager
def running():
    """Yield the port of a server that runs; it is killed at the end."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    server = subprocess.Popen([sys.executable, "server.py", str(port)], stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout.readline() == "ready\n"
        yield port
    finally:
        server.kill()
        server.wait()
PY
}

expect() {
  cat >expected
  if diff -u --label expected --label seen expected seen; then
    printf 'as described\n'
    exit 0
  fi
  exit 1
}
