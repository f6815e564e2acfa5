"""HTTP connections of the studio: bounded in number, and in the time that a request may take to arrive."""

import asyncio
import itertools

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

# At once, with those of open pages.
MOST_CONNECTIONS = 128
# Time for a request to arrive as a whole, from the connection or its first byte on [s].
REQUEST_S = 10.0
_NUMBERS = itertools.count()


class Connection(H11Protocol):
    """An HTTP connection that ends where it brings half a request only, or makes room for a new one."""

    _late: asyncio.TimerHandle | None = None  # While a request has not arrived as a whole
    _number = 0  # Of the request; the loop's clock may give many connections one time

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Wait for the first request; the connection that waits longest is ended where too many are open."""
        super().connection_made(transport)
        self._expect()
        if len(self.connections) > MOST_CONNECTIONS:
            waiting = [each for each in self.connections if isinstance(each, Connection) and each._late]
            idle = min(waiting, key=lambda each: each._number)
            # Not counted from now on: connections that come in one go must not end the same one.
            self.connections.discard(idle)
            idle.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        """Wait for nothing more."""
        self._whole()
        super().connection_lost(exc)

    def data_received(self, data: bytes) -> None:
        """Take what has arrived."""
        super().data_received(data)
        state, is_websocket = self.conn.their_state, self.transport.get_protocol() is not self
        begun = state is h11.SEND_BODY or (state is h11.IDLE and self.conn.trailing_data[0])
        if begun and not is_websocket:
            self._expect()
        else:
            self._whole()

    def _expect(self) -> None:
        if self._late is None:
            self._late, self._number = self.loop.call_later(REQUEST_S, self.transport.abort), next(_NUMBERS)

    def _whole(self) -> None:
        if self._late:
            self._late.cancel()
            self._late = None
