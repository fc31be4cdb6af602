"""Connections to the page: who sends a request too slowly, or does not take the answer, does not keep one of them."""

from __future__ import annotations

import asyncio
from ipaddress import IPv4Network, IPv6Network, ip_address
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

#: Seconds in which the head of a request has to be here, and in which some of an answer has to be taken: a browser
#: that plays a video stops reading when it has enough, and asks again for the rest.
HEAD_S, TAKE_S = 10.0, 120.0


class Connection(H11Protocol):
    """uvicorn's protocol with these two limits, at most `per_address` connections of one address (None: any number),
    and none but from `only_from` where that is set: a proxy in front."""

    per_address: int | None = None
    only_from: IPv4Network | IPv6Network | None = None

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self._head: asyncio.TimerHandle | None = None
        self._taken: asyncio.TimerHandle | None = None

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
        self._head = self.loop.call_later(HEAD_S, transport.abort)

    def data_received(self, data: bytes) -> None:
        """The wait ends with a whole head, and begins again with the first byte of the next."""
        super().data_received(data)
        if self.conn.their_state is not h11.IDLE:
            self._end("_head")
        elif self._head is None and not self.transport.is_closing():
            self._head = self.loop.call_later(HEAD_S, self.transport.abort)

    def pause_writing(self) -> None:
        """The client takes nothing at the moment."""
        super().pause_writing()  # type: ignore[misc]
        self._end("_taken")
        self._taken = self.loop.call_later(TAKE_S, self.transport.abort)

    def resume_writing(self) -> None:
        """It took something."""
        super().resume_writing()  # type: ignore[misc]
        self._end("_taken")

    def connection_lost(self, exc: Exception | None) -> None:
        """Nothing is waited for any more."""
        self._end("_head")
        self._end("_taken")
        super().connection_lost(exc)

    def _end(self, name: str) -> None:
        timer = getattr(self, name)
        if timer is not None:
            timer.cancel()
            setattr(self, name, None)
