"""The thermal range of frames as MAVLink: CAMERA_THERMAL_RANGE, over UDP.

The message (277 of MAVLink's common set) holds the highest and the lowest temperature of an image [°C] and where they
are, as shares of its width and height. Here these are apparent temperatures without noise. A heartbeat of a camera goes
with them once a second. MAVLink is neither encrypted nor signed here: send it to this machine, or in a network that you
trust.
"""

import re
import socket
import time
from typing import Any

import numpy as np

from thermorender import Frame
from thermorender.errors import ThermorenderError, shortened
from thermorender.units import ZERO_CELSIUS_K

SYSTEM, COMPONENT = 1, 100
_HEARTBEAT_S = 1.0


class ThermalRange:
    """Sends the range of each frame that a server answers to an address such as udpout:HOST:PORT."""

    def __init__(self, address: str) -> None:
        found = re.fullmatch(r"udpout:([^:\s]+):(\d{1,5})", address)
        if found is None or not 0 < int(found[2]) < 65536:
            raise ThermorenderError(
                f"mavlink={shortened(repr(address))} is not allowed; give udpout:HOST:PORT, e.g. udpout:127.0.0.1:14550"
            )
        try:
            from pymavlink.dialects.v20 import common
        except ImportError:
            raise ThermorenderError(
                "mavlink needs pymavlink, which is not installed; run `pip install 'thermorender[mavlink]'`"
            ) from None
        try:
            self._to = socket.gethostbyname(found[1]), int(found[2])
        except OSError:
            raise ThermorenderError(f"mavlink: host {found[1]!r} is not known; give its address") from None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._common, self._beat_s = common, -np.inf
        self._mavlink: Any = common.MAVLink(self, srcSystem=SYSTEM, srcComponent=COMPONENT)

    def stop(self) -> None:
        """Close the socket."""
        self._socket.close()

    def write(self, data: bytes) -> None:
        """Send the bytes of a message; nobody needs to listen."""
        try:
            self._socket.sendto(bytes(data), self._to)
        except OSError:
            return

    def show(self, number: int, session: Any) -> None:
        """Send the range of the last frame of a session: its number is that of the stream."""
        if session.last is None:
            return
        if time.monotonic() >= self._beat_s + _HEARTBEAT_S:
            self._beat_s = time.monotonic()
            common = self._common
            self._mavlink.heartbeat_send(common.MAV_TYPE_CAMERA, common.MAV_AUTOPILOT_INVALID, 0, 0, 0)
        values = range_of(session.last)
        stamp = round(1e3 * session.last.time_s) % (1 << 32)
        self._mavlink.camera_thermal_range_send(stamp, 1 + (number - 1) % 255, 0, *values)


def range_of(frame: Frame) -> list[float]:
    """Return the highest temperature [°C], its place across and down (0 to 1), and the same of the lowest."""
    kelvin = frame.apparent_temperature
    values = []
    for at in (int(np.argmax(kelvin)), int(np.argmin(kelvin))):
        row, column = np.unravel_index(at, kelvin.shape)
        place = (column + 0.5) / kelvin.shape[1], (row + 0.5) / kelvin.shape[0]
        values += [float(kelvin[row, column]) - ZERO_CELSIUS_K, *map(float, place)]
    return values
