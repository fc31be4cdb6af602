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
mimic_server
observe venv <<'PY'
import logging
from mimic import running

with running() as port:
    import datajoint

    logging.disable()
    print("database.reconnect is", datajoint.config["database.reconnect"])
    first, second = (datajoint.Connection("127.0.0.1", "root", "", port, use_tls=False) for _ in range(2))
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
