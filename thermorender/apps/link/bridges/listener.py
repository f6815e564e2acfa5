"""What bridges listen with: a server on this machine only, with a thread for each connection."""

import socketserver
import threading
from typing import Any

from thermorender.errors import ThermorenderError

HOST = "127.0.0.1"


class LocalListener:
    """A server on 127.0.0.1 in a thread of its own; port 0 chooses a free one. `what` names it in messages."""

    def __init__(self, kind: type[Any], handler: type[Any], port: int, what: str) -> None:
        # Of many connections at once, those beyond the queue would be tried again after a second or more.
        own = {"allow_reuse_address": True, "daemon_threads": True, "request_queue_size": 256}
        listener = type("Listener", (kind,), own)
        try:
            self._listener: socketserver.TCPServer = listener((HOST, port), handler)
        except OSError as error:
            raise ThermorenderError(
                f"port {port} for {what} cannot be listened on ({error.strerror or error}); give another port, or "
                "stop the program that uses it"
            ) from None
        self.port = int(self._listener.server_address[1])
        self._thread = threading.Thread(target=self._listener.serve_forever, name=what, daemon=True)

    def start(self) -> None:
        """Listen, in a thread."""
        self._thread.start()

    def stop(self) -> None:
        """End listening."""
        self._listener.shutdown()
        self._listener.server_close()
