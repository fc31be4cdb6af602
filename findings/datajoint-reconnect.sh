#!/usr/bin/env bash
# A lost server is DataJoint's LostConnectionError without reconnection, and the driver's OperationalError with it.
#
# Seen 2026-11-29: datajoint 2.3.5, pymysql 1.2.4, against the pure Python server mysql-mimic 3.0.5.
# Behaviour: with `database.reconnect` (the default) a query that finds the server gone connects anew; if that fails, the
#   driver's error comes out as it is, no DataJointError. Without reconnection the same loss is LostConnectionError.
# Matters: `except LostConnectionError` or `except DataJointError` around a query misses the outage with the default
#   setting. Catch pymysql.err.OperationalError as well.

# shellcheck disable=SC1091 # _common.sh is checked by itself
source "$(dirname "${BASH_SOURCE[0]}")/_common.sh"

install datajoint==2.3.5 pymysql==1.2.4 mysql-mimic==3.0.5 sqlglot==30.30.0
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
observe venv <<'PY'
import logging, socket, subprocess, sys

with socket.socket() as free:
    free.bind(("127.0.0.1", 0))
    port = free.getsockname()[1]
server = subprocess.Popen([sys.executable, "server.py", str(port)], stdout=subprocess.PIPE, text=True)
try:
    assert server.stdout.readline() == "ready\n"
    import datajoint

    logging.disable()
    print("database.reconnect is", datajoint.config["database.reconnect"])
    first, second = (datajoint.Connection("127.0.0.1", "root", "", port, use_tls=False) for _ in range(2))
finally:
    server.kill()
    server.wait()
for connection, reconnect in ((first, False), (second, True)):
    try:
        connection.query("SELECT 1", reconnect=reconnect)
        print("a query works")
    except Exception as error:
        kind = f"{type(error).__module__.partition('.')[0]}'s {type(error).__name__}"
        print(f"reconnect={reconnect}: {kind}, a DataJointError: {isinstance(error, datajoint.DataJointError)}")
PY
expect <<'SEEN'
database.reconnect is True
reconnect=False: datajoint's LostConnectionError, a DataJointError: True
reconnect=True: pymysql's OperationalError, a DataJointError: False
SEEN
