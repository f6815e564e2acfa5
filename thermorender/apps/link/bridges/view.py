"""A live view: the frames that a server answers, as motion JPEG or H.264 for a browser or a player.

It listens on this machine only. The address holds a token of its own, other than that of the link.
"""

import contextlib
import hmac
import secrets
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from thermorender.apps.link.bridges.listener import HOST, LocalListener

_BOUNDARY = "frame"
# From JPEGs as they come to H.264 in an MP4 of one fragment per frame.
_TO_H264 = (
    "-v quiet -probesize 32 -analyzeduration 0 -f mjpeg -use_wallclock_as_timestamps 1 -i - -an -c:v libx264 -preset "
    "ultrafast -tune zerolatency -g 30 -vf crop=trunc(iw/2)*2:trunc(ih/2)*2,format=yuv420p -fps_mode passthrough "
    "-movflags frag_every_frame+empty_moov+default_base_moof -f mp4 -"
).split()
_MOST_VIEWERS, _MOST_WAITING, _LEAST_S, _REPEAT_S, _TIMEOUT_S, _QUALITY = 8, 16, 0.03, 2.0, 10.0, 85


def _end(connection: socket.socket) -> None:
    with contextlib.suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)


class View(LocalListener):
    """Shows frames to viewers; without a viewer nothing is encoded."""

    def __init__(self, port: int) -> None:
        self._token = secrets.token_urlsafe(24)
        self._news, self._jpeg, self._count, self._viewers = threading.Condition(), b"", 0, 0
        self._shown_s, self._ended = 0.0, False
        # Connections that have not asked with the token yet; each is ended after a while, or makes room for a new one.
        self._waiting: dict[socket.socket, threading.Timer] = {}
        view = self

        class Handler(BaseHTTPRequestHandler):
            timeout = _TIMEOUT_S

            def setup(self) -> None:
                view._wait_for(self.request)
                super().setup()

            def finish(self) -> None:
                view._heard(self.request)
                with contextlib.suppress(OSError):  # the viewer has left
                    super().finish()

            def do_GET(self) -> None:
                view._answer(self)

            def log_message(self, *_: Any) -> None:
                """Write nothing: the path holds the token."""

        super().__init__(ThreadingHTTPServer, Handler, port, "the live view")
        # For a browser, VLC, ffplay or OpenCV; with live.mp4 in place of live.mjpg it is H.264.
        self.address = f"http://{HOST}:{self.port}/{self._token}/live.mjpg"

    def stop(self) -> None:
        """End listening."""
        with self._news:
            self._ended = True
            self._news.notify_all()
        super().stop()

    def show(self, number: int, session: Any) -> None:
        """Take the last frame of a session; of several sessions the view shows each frame in turn."""
        now = time.monotonic()
        if session.last is None or now < self._shown_s + _LEAST_S or (not self._viewers and self._jpeg):
            return
        import cv2

        image = session.last.display
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
        with self._news:
            self._jpeg, self._shown_s = data, now
            self._count += 1
            self._news.notify_all()

    def _wait_for(self, connection: socket.socket) -> None:
        """Expect a request within a while."""
        timer = threading.Timer(_TIMEOUT_S, _end, [connection])
        timer.daemon = True
        with self._news:
            # Taken out at once, so that connections which arrive together make each another one end.
            oldest = next(iter(self._waiting)) if len(self._waiting) >= _MOST_WAITING else None
            ended = None if oldest is None else self._waiting.pop(oldest)
            self._waiting[connection] = timer
        timer.start()
        if oldest is not None and ended is not None:
            ended.cancel()
            _end(oldest)

    def _heard(self, connection: socket.socket) -> None:
        """Expect no request any more."""
        with self._news:
            timer = self._waiting.pop(connection, None)
        if timer is not None:
            timer.cancel()

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        """Send frames until the viewer leaves."""
        name = "live.mp4" if request.path.endswith(".mp4") else "live.mjpg"
        if not hmac.compare_digest(request.path.encode(), f"/{self._token}/{name}".encode()):
            request.send_error(404, "Give the address that the server printed")
            return
        self._heard(request.request)
        with self._news:
            if self._viewers >= _MOST_VIEWERS:
                request.send_error(503, f"{_MOST_VIEWERS} viewers look; close one")
                return
            self._viewers += 1
        try:
            kind = "video/mp4" if name == "live.mp4" else f"multipart/x-mixed-replace; boundary={_BOUNDARY}"
            request.send_response(200)
            request.send_header("Content-Type", kind)
            request.send_header("Cache-Control", "no-store")
            request.end_headers()
            (self._h264 if name == "live.mp4" else self._mjpeg)(request)
        except OSError:
            return
        finally:
            with self._news:
                self._viewers -= 1

    def _frames(self) -> Iterator[bytes]:
        """Yield JPEGs, each the newest one, until the view ends."""
        seen = 0
        while True:
            with self._news:
                # The last frame is repeated, so that a viewer that has left is noticed.
                if self._count == seen and not self._ended:
                    self._news.wait(_REPEAT_S)
                if self._ended:
                    return
                data, seen = self._jpeg, self._count
            if data:
                yield data

    def _mjpeg(self, request: BaseHTTPRequestHandler) -> None:
        for data in self._frames():
            head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
            request.wfile.write(head.encode() + data + b"\r\n")

    def _h264(self, request: BaseHTTPRequestHandler) -> None:
        from imageio_ffmpeg import get_ffmpeg_exe

        pipe = subprocess.PIPE
        encoder = subprocess.Popen([get_ffmpeg_exe(), *_TO_H264], stdin=pipe, stdout=pipe, bufsize=0)
        assert encoder.stdin and encoder.stdout
        source, sink = encoder.stdout, encoder.stdin

        def pass_on() -> None:
            with contextlib.suppress(OSError):
                while data := source.read(1 << 16):
                    request.wfile.write(data)
            # The next frame finds the pipe closed.
            encoder.kill()

        reader = threading.Thread(target=pass_on, daemon=True)
        reader.start()
        try:
            for data in self._frames():
                sink.write(data)
        finally:
            encoder.kill()
            reader.join()
            sink.close()
            source.close()
            encoder.wait()
