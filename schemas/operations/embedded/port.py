"""The address the server listens on: the loopback and a port that is free."""

from __future__ import annotations

import random
import socket

from pbl_pipeline.errors import PblError

HOST = "127.0.0.1"
#: Ports to choose from: below the range that systems hand out to outgoing connections.
PORTS = range(13306, 30000)


def port_free(port: int) -> bool:
    """True when a server could listen on `port` now."""
    with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
        # As the server does, so that connections of its last life that have not timed out do not count.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError:
            return False
        return True


def free_port() -> int:
    """A random free port, so that several databases on one machine rarely collide.

    Raises `PblError` DB_UNAVAILABLE when 200 tries find none.
    """
    for port in random.sample(PORTS, 200):
        if port_free(port):
            return port
    raise PblError(
        "DB_UNAVAILABLE",
        found=f"200 ports between {PORTS.start} and {PORTS.stop} were tried and all are taken",
        expected="a free port on 127.0.0.1",
        next_step="see what listens there: ss -ltn",
    )
