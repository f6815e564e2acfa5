"""A live view: the frames that a server answers, as motion JPEG for a browser or a player.

It listens on this machine only. The address holds a token of its own, other than that of the link.
"""

import hmac
import secrets
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from thermorender.link.bridges.listener import HOST, LocalListener

_BOUNDARY = "frame"
_MOST_VIEWERS, _LEAST_S, _REPEAT_S, _TIMEOUT_S, _QUALITY = 8, 0.03, 2.0, 10.0, 85


class View(LocalListener):
    """Shows frames to viewers; without a viewer nothing is encoded.

    Parameters
    ----------
    port : int
        To listen on; 0 chooses a free one.

    Attributes
    ----------
    address : str
        For a browser, VLC, ffplay, or OpenCV.
    """

    def __init__(self, port: int) -> None:
        self._token = secrets.token_urlsafe(24)
        self._news, self._jpeg, self._count, self._viewers = threading.Condition(), b"", 0, 0
        self._shown_s, self._ended = 0.0, False
        view = self

        class Handler(BaseHTTPRequestHandler):
            timeout = _TIMEOUT_S

            def do_GET(self) -> None:
                view._answer(self)

            def log_message(self, *_: Any) -> None:
                """Write nothing: the path holds the token."""

        super().__init__(ThreadingHTTPServer, Handler, port, "the live view", "--view")
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

    def _answer(self, request: BaseHTTPRequestHandler) -> None:
        """Send frames until the viewer leaves."""
        if not hmac.compare_digest(request.path.encode(), f"/{self._token}/live.mjpg".encode()):
            request.send_error(404, "Give the address that the server printed")
            return
        with self._news:
            if self._viewers >= _MOST_VIEWERS:
                request.send_error(503, f"{_MOST_VIEWERS} viewers look; close one")
                return
            self._viewers += 1
        try:
            request.send_response(200)
            request.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY}")
            request.send_header("Cache-Control", "no-store")
            request.end_headers()
            self._stream(request)
        except OSError:
            return
        finally:
            with self._news:
                self._viewers -= 1

    def _stream(self, request: BaseHTTPRequestHandler) -> None:
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
                head = f"--{_BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                request.wfile.write(head.encode() + data + b"\r\n")
