"""Connections to the page: slow clients keep none of them, and those who hold the most make room for others."""

from __future__ import annotations

import asyncio
import ssl
from collections import Counter
from ipaddress import IPv4Network, IPv6Address, IPv6Network, ip_address
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

#: Seconds in which a whole request, head and body, has to be here, counted from its first byte (the first from the
#: connection, with the handshake of TLS); and in which some of an answer has to be taken: a browser that plays a video
#: stops reading when it has enough, and asks again for the rest.
REQUEST_S, TAKE_S = 10.0, 120.0
#: Seconds without a byte after which an upload (`more_time`) is given up, and those in which all of it has to be here.
STALL_S, UPLOAD_S = 30.0, 7200.0
#: Name in the scope of a request of the function `Connection.more_time`.
MORE_TIME = "pbl.more_time"
#: Seconds that a client has to take an answer that ended before its request did: a connection that is closed with
#: bytes unread may lose the answer.
LINGER_S = 1.0


def customer(address: str) -> str:
    """Return the IPv4 address, also of one written as IPv6; of IPv6 the /64 network, all of which one customer has.
    Raises ValueError if the text is not an address."""
    at = ip_address(address)
    if isinstance(at, IPv6Address):
        return str(at.ipv4_mapped or IPv6Address(int(at) >> 64 << 64))
    return address


class Connection(H11Protocol):
    """uvicorn's protocol with these limits, at most `per_address` connections of one address or IPv6 network (None: any
    number), and none but from `only_from` where that is set: a proxy in front. `tls`: speaks TLS by this context.

    The handshake is done here, so that a connection counts and has its time from its first moment; a server that is
    given the context hears of it when the handshake has ended.

    When all connections are taken, a new one closes one of the address that holds the most, so that a few addresses
    cannot keep others out. Behind a proxy all have its address, and the proxy has to limit them.
    """

    per_address: int | None = None
    only_from: IPv4Network | IPv6Network | None = None
    tls: ssl.SSLContext | None = None

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._until = 0.0  # when the time of an upload ends; 0 for other requests
        self._over = False  # the answer ended before the request: what still comes is not read
        self._made_at = self.loop.time()
        self._customer = ""
        self._shakes_hands: asyncio.Task[None] | None = None
        self._early = b""  # of a request, before the transport is there that its answer needs

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Begin to wait for a request."""
        super().connection_made(transport)
        if self.only_from is not None and not (self.client and ip_address(self.client[0]) in self.only_from):
            transport.abort()
            return
        if self.per_address is not None:
            self._customer = customer(self.client[0]) if self.client else ""
            others = [c for c in self.connections if isinstance(c, Connection) and c is not self]
            if sum(c._customer == self._customer for c in others) >= self.per_address:
                transport.abort()
                return
            if self.limit_concurrency is not None and len(others) >= self.limit_concurrency - 1:
                self._make_room(others)
                self.limit_concurrency += 1  # the request of the one that was closed may not have ended yet
        self._abort_after("request", REQUEST_S)
        if self.tls is not None:
            self._shakes_hands = self.loop.create_task(self._shake_hands(transport, self.tls))

    async def _shake_hands(self, transport: asyncio.Transport, context: ssl.SSLContext) -> None:
        try:
            secure = await self.loop.start_tls(transport, self, context, server_side=True)
        except OSError as error:
            self.connection_lost(error)
            return
        self._shakes_hands = None
        if secure is None or secure.is_closing():
            self.connection_lost(None)
            return
        super().connection_made(secure)
        if self._early:
            self.data_received(self._early)

    def data_received(self, data: bytes) -> None:
        """Read more of a request, whose time ends when all of it is here."""
        if self._shakes_hands is not None:
            self._early += data
        elif not self._over:
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
        """Start a timer: the client takes nothing at the moment."""
        super().pause_writing()  # type: ignore[misc]
        self._abort_after("answer", TAKE_S)

    def resume_writing(self) -> None:
        """Stop the timer: the client took something."""
        super().resume_writing()  # type: ignore[misc]
        self._end("answer")

    def connection_lost(self, exc: Exception | None) -> None:
        self._end("request")
        self._end("answer")
        super().connection_lost(exc)

    def _make_room(self, others: list[Connection]) -> None:
        """Close a connection of the address that has the most: rather one that waits for its client than one that is
        being answered, and of these the oldest."""
        ((most, _),) = Counter(c._customer for c in others).most_common(1)
        closed = min((c for c in others if c._customer == most), key=lambda c: (not c._waits, c._made_at))
        self.connections.discard(closed)  # it stops counting now, not when it is closed
        closed.transport.abort()

    @property
    def _waits(self) -> bool:
        """The next step is the client's: to send a request, or to take an answer."""
        return bool(self._timers) or self.cycle is None or self.cycle.response_complete

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
