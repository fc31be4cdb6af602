"""Connections to the page: clients that send a request too slowly or do not take the answer keep none of them."""

from __future__ import annotations

import asyncio
from ipaddress import IPv4Network, IPv6Network, ip_address
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

#: Seconds in which a whole request, head and body, has to be here, counted from its first byte (the first also from the
#: connection); and in which some of an answer has to be taken: a browser that plays a video stops reading when it has
#: enough, and asks again for the rest.
REQUEST_S, TAKE_S = 10.0, 120.0
#: Seconds without a byte after which an upload (`more_time`) is given up, and those in which all of it has to be here.
STALL_S, UPLOAD_S = 30.0, 7200.0
#: Name in the scope of a request of the function `Connection.more_time`.
MORE_TIME = "pbl.more_time"
#: Seconds that a client has to take an answer that ended before its request did: a connection that is closed with
#: bytes unread may lose the answer.
LINGER_S = 1.0


class Connection(H11Protocol):
    """uvicorn's protocol with these limits, at most `per_address` connections of one address (None: any number), and
    none but from `only_from` where that is set: a proxy in front."""

    per_address: int | None = None
    only_from: IPv4Network | IPv6Network | None = None

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._until = 0.0  # when the time of an upload ends; 0 for other requests
        self._over = False  # the answer ended before the request: what still comes is not read

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request."""
        super().connection_made(transport)
        if self.only_from is not None and not (self.client and ip_address(self.client[0]) in self.only_from):
            transport.abort()
            return
        mine = [c for c in self.connections if isinstance(c, H11Protocol) and c.client and self.client]
        if self.per_address and sum(c.client[0] == self.client[0] for c in mine) > self.per_address:  # type: ignore[index]
            transport.abort()
            return
        self._abort_after("request", REQUEST_S)

    def data_received(self, data: bytes) -> None:
        """Read more of a request, whose time ends when all of it is here."""
        if not self._over:
            super().data_received(data)
            if self.scope is not None:
                self.scope.setdefault(MORE_TIME, self.more_time)  # type: ignore[typeddict-item]
            self._time_request()

    def more_time(self) -> None:
        """Give the request that is being read the time of an upload. For an address whose sender has its right."""
        if self.conn.their_state is h11.SEND_BODY:
            self._until = self.loop.time() + UPLOAD_S
            self._abort_after("request", STALL_S)

    def on_response_complete(self) -> None:
        """Close the connection where the answer ended before the request; else go on with the next."""
        self._over = self.conn.their_state is h11.SEND_BODY
        super().on_response_complete()
        if self._over and not self.transport.is_closing():
            self._unset_keepalive_if_required()
            if self.transport.can_write_eof():
                self.transport.write_eof()
            self._abort_after("request", LINGER_S)
        elif self.conn.their_state is h11.SEND_BODY:  # of the next request, which came along with this one
            self._time_request()

    def pause_writing(self) -> None:
        """The client takes nothing at the moment."""
        super().pause_writing()  # type: ignore[misc]
        self._abort_after("answer", TAKE_S)

    def resume_writing(self) -> None:
        """It took something."""
        super().resume_writing()  # type: ignore[misc]
        self._end("answer")

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for any more."""
        self._end("request")
        self._end("answer")
        super().connection_lost(exc)

    def _time_request(self) -> None:
        if self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
            self._end("request")
            self._until = 0.0
        elif self._until and not self.transport.is_closing():
            self._abort_after("request", min(STALL_S, max(0.0, self._until - self.loop.time())))
        elif "request" not in self._timers and not self.transport.is_closing():
            self._abort_after("request", REQUEST_S)

    def _abort_after(self, name: str, seconds: float) -> None:
        self._end(name)
        self._timers[name] = self.loop.call_later(seconds, self.transport.abort)

    def _end(self, name: str) -> None:
        timer = self._timers.pop(name, None)
        if timer is not None:
            timer.cancel()
