"""The server: sockets in one thread, the renderer in another, and a bounded queue between them.

The thread that calls `Server.run` renders: one frame at a time, in the order in which requests arrived. All sockets
belong to an event loop in a second thread. Every quantity is bounded: connections, sessions, requests that wait, bytes
in memory, and the time that a message may take.
"""

import asyncio
import contextlib
import hmac
import json
import queue
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import Any

from thermorender.apps.link.access import listening
from thermorender.apps.link.connections import DEFAULT_LIMITS, Job, Limits, Peer, Seat, Shown, Stages
from thermorender.apps.link.messages import Open, Request, refuse_length
from thermorender.apps.link.wire import (
    DEFAULT_PORT,
    HEADER,
    TOKEN_BYTES,
    Code,
    Head,
    MalformedError,
    Type,
    error_message,
    head_of,
    message,
)
from thermorender.errors import ThermorenderError


class Server:
    """A server of one Stage; port 0 chooses a free one. Set `token` before `run` if clients must give one."""

    def __init__(
        self, stage: Stages, host: str = "127.0.0.1", port: int = DEFAULT_PORT, limits: Limits = DEFAULT_LIMITS
    ) -> None:
        self._stage, self.token, self._limits = stage, "", limits
        # Called with (number of the session, its ServerSession) after each answered frame, in the thread that renders.
        self.watchers: list[Callable[[int, Any], object]] = []
        self._welcome = json.dumps(stage.describe()).encode()
        self._jobs: queue.SimpleQueue[Job | None] = queue.SimpleQueue()
        self._lock = threading.Lock()
        self._clients: set[Peer] = set()
        self._sessions = self._held = self.answered = 0
        self._socket = listening(host, port)
        self.address, self.port = str(self._socket.getsockname()[0]), int(self._socket.getsockname()[1])
        self._loop, self._space, self._ended = asyncio.new_event_loop(), asyncio.Event(), asyncio.Event()
        self._thread = threading.Thread(target=self._sockets, name="link sockets", daemon=True)

    def run(self) -> None:
        """Serve until `stop` is called, or an exception such as KeyboardInterrupt is raised in this thread."""
        self._thread.start()
        try:
            while (job := self._jobs.get()) is not None:
                self._work(job)
                del job  # It holds its session, which may be closed by now.
        finally:
            with contextlib.suppress(RuntimeError):  # the loop has ended by an error
                self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join(10.0)

    @property
    def in_hand(self) -> tuple[int, int, int]:
        """Connections, sessions, and bytes of requests and replies that are kept now."""
        return len(self._clients), self._sessions, self._held

    def stop(self) -> None:
        """Let `run` return after the frame that it renders; any thread may call this."""
        self._jobs.put(None)

    # In the thread that renders.

    def _work(self, job: Job) -> None:
        """Do one job and send its reply; no error of a job ends the server."""
        head, framed = job.head, False
        try:
            if job.client.closed:
                parts = None
            elif job.closes:
                parts = message(Type.CLOSED, head.session, head.id)
            elif job.settings is not None:
                shown = self._stage.open(job.settings)
                job.session.shown, job.session.reply_bytes = shown, shown.most_bytes
                parts = message(Type.OPENED, head.session, head.id, [shown.opened.packed()])
            else:
                parts, framed = self._frame(job), True
        except ThermorenderError as error:
            parts = error_message(Code.REFUSED, str(error), job.head.session, job.head.id)
        except Exception as error:
            traceback.print_exc(file=sys.stderr)
            what = f"the server failed at this message ({type(error).__name__}); its log says where"
            parts = error_message(Code.INTERNAL, what, job.head.session, job.head.id)
        self._later(self._deliver, job, parts)
        if framed:
            self._watched(job)

    def _watched(self, job: Job) -> None:
        for watch in self.watchers:
            try:
                watch(job.head.session, job.session.shown)
            except Exception:
                traceback.print_exc(file=sys.stderr)

    def _frame(self, job: Job) -> list[Any]:
        with self._lock:
            if job.session.latest is job:
                job.session.latest = None
        shown = job.session.shown
        assert shown is not None
        try:
            payload = shown.answer(job.requests, job.arrived_s)
        except ThermorenderError:
            if not job.replaced:
                raise
            payload = shown.answer(job.requests[-1:], job.arrived_s, self._added(job, shown))
        self.answered += 1
        return message(Type.REPLY, job.head.session, job.head.id, payload)

    def _added(self, job: Job, shown: Shown) -> int:
        """Add the replaced requests of a job one by one and return their number; refuse those that are wrong."""
        added = 0
        for head, request in zip(job.replaced, job.requests, strict=False):
            try:
                shown.add(request)
                added += 1
            except ThermorenderError as error:
                self._later(self._refuse, job.client, head, str(error))
        return added

    def _later(self, call: Callable[..., object], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the loop has ended
            self._loop.call_soon_threadsafe(call, *arguments)

    # In the thread of the sockets.

    def _sockets(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._listen())
        finally:
            self._loop.close()
            self._jobs.put(None)

    async def _listen(self) -> None:
        server = await asyncio.start_server(self._connected, sock=self._socket, limit=1 << 20)
        watch = asyncio.ensure_future(self._watch())
        await self._ended.wait()
        server.close()
        watch.cancel()
        for client in list(self._clients):
            client.writer.transport.abort()
        others = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
        for task in others:
            task.cancel()
        await asyncio.gather(*others, return_exceptions=True)

    async def _watch(self) -> None:
        """Close connections whose client is late."""
        while True:
            await asyncio.sleep(min(self._limits.hello_s, self._limits.message_s, self._limits.reply_s) / 40.0)
            now = self._loop.time()
            for client in list(self._clients):
                if client.deadline_s is not None and now > client.deadline_s:
                    client.writer.transport.abort()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = Peer(reader, writer)
        transport = writer.transport
        transport.set_write_buffer_limits(0)
        own = writer.get_extra_info("socket")
        with contextlib.suppress(OSError):
            own.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            own.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            own.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, self._limits.sent_bytes)
        strangers = [each for each in self._clients if not each.greeted]
        if len(self._clients) >= self._limits.connections and strangers:
            # Who has no token cannot keep others out.
            oldest = min(strangers, key=lambda each: each.deadline_s or 0.0)
            oldest.writer.transport.abort()
            self._forget(oldest)
        if len(self._clients) >= self._limits.connections:
            self._last(client, Code.BUSY, f"{self._limits.connections} connections are open; close one, or wait")
            return
        self._clients.add(client)
        sender = asyncio.ensure_future(self._send(client))
        try:
            with contextlib.suppress(asyncio.IncompleteReadError):
                await self._hello(client)
                while True:
                    await self._message(client)
            # The client has sent all it will send, and may still read.
            client.deadline_s = None
            while client.waiting or client.outbox:
                await client.made_room()
            client.writer.close()
        except MalformedError as error:
            self._last(client, Code.MALFORMED, str(error))
        except PermissionError as error:
            self._last(client, Code.ACCESS, str(error))
        except (OSError, asyncio.CancelledError):
            transport.abort()
        finally:
            sender.cancel()
            self._forget(client)

    def _last(self, client: Peer, code: Code, text: str) -> None:
        """Send an error and end the connection."""
        client.writer.write(b"".join(error_message(code, text)))
        client.writer.close()
        # A client that does not read is not waited for.
        self._loop.call_later(self._limits.hello_s, client.writer.transport.abort)

    def _forget(self, client: Peer) -> None:
        client.closed = True
        self._clients.discard(client)
        self._sessions -= len(client.sessions)
        client.sessions.clear()
        for _, held, _ in client.outbox:
            self._release(held)
        client.outbox.clear()

    async def _hello(self, client: Peer) -> None:
        client.deadline_s = self._loop.time() + self._limits.hello_s
        head = head_of(await client.reader.readexactly(HEADER.size))
        if head.type != Type.HELLO or head.length != TOKEN_BYTES:
            raise PermissionError(f"the first message must be HELLO with a token of {TOKEN_BYTES} bytes")
        given = await client.reader.readexactly(head.length)
        if not hmac.compare_digest(given, self.token.encode("ascii")):
            raise PermissionError("the token is wrong; give the one in the file that the server printed")
        client.deadline_s, client.greeted = None, True
        self._reply(client, message(Type.WELCOME, 0, head.id, [self._welcome]))

    async def _message(self, client: Peer) -> None:
        """Read one message and pass it on."""
        first = await client.reader.readexactly(1)
        client.deadline_s = self._loop.time() + self._limits.message_s
        head = head_of(first + await client.reader.readexactly(HEADER.size - 1))
        refuse_length(head)
        # While the server makes the client wait, the client is not late.
        left_s = client.deadline_s - self._loop.time()
        client.deadline_s = None
        # The length of a session's replies is known once it is open.
        while (session := client.sessions.get(head.session)) is not None and session.shown is None:
            await client.made_room()
        held = head.length + (session.reply_bytes if session else 0)
        while max(client.waiting, len(client.outbox)) >= self._limits.waiting:
            await client.made_room()
        while self._held and self._held + held > self._limits.memory_bytes:
            self._space.clear()
            await self._space.wait()
        self._held += held
        try:
            client.deadline_s = self._loop.time() + left_s
            payload = await client.reader.readexactly(head.length)
            client.deadline_s = None
            kept = self._take(client, head, payload, held)
        except BaseException:
            self._release(held)
            raise
        if not kept:
            self._release(held)

    def _take(self, client: Peer, head: Head, payload: bytes, held: int) -> bool:
        """Pass a message on; return whether it stays in hand until it is answered."""
        try:
            if head.type == Type.OPEN:
                return self._open(client, head, Open.unpacked(payload), held)
            if head.type == Type.REQUEST:
                return self._request(client, head, Request.unpacked(payload), held)
            if head.type == Type.CLOSE:
                seat = self._known(client, head)
                del client.sessions[head.session]
                self._sessions -= 1
                # Behind the replies to the session's requests.
                self._put(Job(client, head, seat, closes=True, held=held))
                return True
            raise ThermorenderError("HELLO was already said; send OPEN, REQUEST or CLOSE")
        except _BusyError as error:
            self._reply(client, error_message(Code.BUSY, str(error), head.session, head.id))
        except ThermorenderError as error:
            self._reply(client, error_message(Code.REFUSED, str(error), head.session, head.id))
        return False

    def _open(self, client: Peer, head: Head, settings: Open, held: int) -> bool:
        if head.session in client.sessions:
            raise ThermorenderError(f"session {head.session} is open; give another number, or close it first")
        if self._sessions >= self._limits.sessions:
            raise _BusyError(f"{self._limits.sessions} sessions are open; close one, or wait")
        self._sessions += 1
        session = client.sessions[head.session] = Seat()
        self._put(Job(client, head, session, settings, held=held))
        return True

    def _request(self, client: Peer, head: Head, request: Request, held: int) -> bool:
        session, now = self._known(client, head), time.perf_counter()
        with self._lock:
            waits = session.latest
            if waits is not None and request.latest and waits.samples + request.samples <= self._limits.samples:
                # The older request only gives its part of the path.
                waits.requests[-1] = replace(waits.requests[-1], picture=None)
                waits.requests.append(request)
                waits.replaced.append(waits.head)
                waits.samples += request.samples
                waits.head, waits.arrived_s = head, now
                held, waits.held = waits.held, held
                self._release(held)
                return True
            job = Job(client, head, session, None, [request], samples=request.samples, arrived_s=now, held=held)
            session.latest = job if request.latest else None
        self._put(job)
        return True

    def _known(self, client: Peer, head: Head) -> Seat:
        if head.session not in client.sessions:
            raise ThermorenderError(f"session {head.session} is not open; send OPEN first")
        return client.sessions[head.session]

    def _put(self, job: Job) -> None:
        job.client.waiting += 1
        self._jobs.put(job)

    def _reply(self, client: Peer, parts: list[Any], held: int = 0, answers: int = 0) -> None:
        client.outbox.append((parts, held, answers))
        client.wake.set()

    def _refuse(self, client: Peer, head: Head, text: str) -> None:
        """Refuse a request that another has replaced."""
        if not client.closed:
            self._reply(client, error_message(Code.REFUSED, text, head.session, head.id))

    def _deliver(self, job: Job, parts: list[Any] | None) -> None:
        """Take the reply of a job."""
        client, session = job.client, job.session
        if job.settings is not None and session.shown is None:
            # It could not be opened.
            if client.sessions.get(job.head.session) is session:
                del client.sessions[job.head.session]
                self._sessions -= 1
        if client.closed or parts is None:
            self._release(job.held)
        else:
            self._reply(client, parts, job.held, 1)

    async def _send(self, client: Peer) -> None:
        """Send replies in their order."""
        while True:
            while client.outbox:
                parts, held, answers = client.outbox[0]
                late = self._loop.call_later(self._limits.reply_s, client.writer.transport.abort)
                try:
                    client.writer.write(b"".join(parts))
                    await client.writer.drain()
                except OSError:
                    # The reader may wait for room that this reply would have made.
                    client.lost = True
                    client.room.set()
                    return
                finally:
                    late.cancel()
                client.outbox.popleft()
                client.waiting -= answers
                client.room.set()
                self._release(held)
            client.wake.clear()
            await client.wake.wait()

    def _release(self, held: int) -> None:
        self._held -= held
        self._space.set()


class _BusyError(ThermorenderError):
    """A limit is reached for now."""
