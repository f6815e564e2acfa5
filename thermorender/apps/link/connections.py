"""What a server keeps for each connection, and the limits of it."""

import asyncio
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Protocol

from thermorender.apps.link.messages import Open, Opened, Request
from thermorender.apps.link.wire import Head


@dataclass(frozen=True)
class Limits:
    """Limits of a server."""

    connections: int = 256  # At once
    sessions: int = 64  # Open at once, of all connections
    waiting: int = 8  # Messages of one connection that are not answered yet; the server reads no more before
    memory_bytes: int = 512 << 20  # Of requests and replies in hand
    sent_bytes: int = 4 << 20  # Of a connection's replies that the system keeps until the client takes them
    # hello_s, message_s, reply_s: Time for the first message, for a message once it has begun, and for a client to
    # take a reply [s]
    hello_s: float = 5.0
    message_s: float = 10.0
    reply_s: float = 30.0
    # Of the requests that one later request may replace: poses, values of objects, and one for each
    samples: int = 16_384


DEFAULT_LIMITS = Limits()


class Shown(Protocol):
    """A session, as the server needs it: `thermorender.apps.link.session.ServerSession`."""

    opened: Opened

    @property
    def most_bytes(self) -> int:
        """Length of the longest reply."""

    def add(self, request: Request) -> None:
        """Add what a replaced request gives to the path."""

    def answer(self, requests: list[Request], arrived_s: float, added: int = 0) -> list[Any]:
        """Return the payload of a reply to the last request, which also replaced the `added` ones."""


class Stages(Protocol):
    """What the server shows: `thermorender.apps.link.stage.Stage`."""

    def describe(self) -> dict[str, Any]:
        """Return plain values for WELCOME."""

    def open(self, settings: Open) -> Shown:
        """Return a new session."""


@dataclass(eq=False)
class Peer:
    """One connection."""

    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    sessions: dict[int, "Seat"] = field(default_factory=dict)
    outbox: deque[tuple[list[Any], int, int]] = field(default_factory=deque)
    wake: asyncio.Event = field(default_factory=asyncio.Event)
    # Set when a request is answered.
    room: asyncio.Event = field(default_factory=asyncio.Event)
    waiting: int = 0
    # When the client must have done its next step; None if it need not do anything.
    deadline_s: float | None = None
    # It has given the token.
    greeted: bool = False
    closed: bool = False
    # A reply could not be sent.
    lost: bool = False

    async def made_room(self) -> None:
        """Wait until a request is answered; ConnectionError if the client takes no more replies."""
        self.room.clear()
        if self.lost:
            raise ConnectionError
        await self.room.wait()


@dataclass(eq=False)
class Seat:
    """The place of a session on a connection: empty until the thread that renders has opened it."""

    shown: Shown | None = None
    reply_bytes: int = 0
    # The newest request, if it may be replaced and waits.
    latest: "Job | None" = None


@dataclass(eq=False)
class Job:
    """Work for the thread that renders: an OPEN with its settings, a CLOSE, or requests for a frame.

    `head` is that of the last request, and `replaced` holds those of the others.
    """

    client: Peer
    head: Head
    session: Seat
    settings: Open | None = None
    requests: list[Request] = field(default_factory=list)
    replaced: list[Head] = field(default_factory=list)
    samples: int = 0
    arrived_s: float = 0.0
    held: int = 0
    closes: bool = False
