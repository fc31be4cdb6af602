#!/usr/bin/env bash
# DataJoint's Connection.is_connected stays True after the server has gone.
#
# Seen 2026-11-28: datajoint 2.3.5, pymysql 1.2.4, against the pure Python server mysql-mimic 3.0.5.
# Behaviour: the property asks the adapter for a ping and ignores its answer; the adapter returns False where the driver
#   raises. So it is True for any connection that was once open, also after a query has failed.
# Matters: a worker that waits for its database by this property never notices an outage. Send a query instead.

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
    connection = datajoint.Connection("127.0.0.1", "root", "", port, use_tls=False)
    print("server runs: is_connected", connection.is_connected)
print("server gone: is_connected", connection.is_connected)
print("server gone: the adapter's ping", connection.adapter.ping(connection._conn))
try:
    connection.query("SELECT 1", reconnect=False)
    print("a query works")
except Exception as error:
    print("a query raises", type(error).__name__)
print("after that: is_connected", connection.is_connected)
PY
expect <<'SEEN'
server runs: is_connected True
server gone: is_connected True
server gone: the adapter's ping False
a query raises LostConnectionError
after that: is_connected True
SEEN
