"""The database that comes with the project: a private MariaDB server in a separate folder, not a system service.

`start()` gets the server when it is absent, creates the folder on first use and leaves a process running that
listens on 127.0.0.1 only; `stop()` ends it; `status()` looks and changes nothing. Only MariaDB is started here: a
MySQL 8 server is used by naming it in DJ_HOST, DJ_PORT, DJ_USER and DJ_PASS.
"""

from .binaries import Binaries, find_server, get_server
from .folder import ADMIN_USER, APP_USER, HOST, Credentials, Folder
from .process import admin
from .server import Status, allow_prefix, grant, not_running, prepare, start, starts_on_demand, status, stop
