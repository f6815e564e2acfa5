"""The client in Python: a connection to a server, and its sessions.

Only NumPy is imported, so that a simulator's process stays light.
"""

import json
import select
import socket
import struct
import time
from collections import deque
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.apps.link.access import checked_token, found_token_file, read_token
from thermorender.apps.link.messages import Open, Opened, Reply, Request
from thermorender.apps.link.wire import (
    DEFAULT_PORT,
    HEADER,
    Code,
    Head,
    LinkError,
    Product,
    Type,
    error_of,
    head_of,
    message,
)
from thermorender.errors import ThermorenderError, shortened


def connect(
    host: str = "127.0.0.1", port: int = DEFAULT_PORT, token: str | None = None,
    token_path: str | PathLike[str] | None = None, timeout_s: float = 120.0, wait_s: float = 0.0,
) -> "Client":  # fmt: skip
    """Return a connection to a running `thermorender serve`.

    Parameters
    ----------
    host, port : str, int
        As the server printed them.
    token : str, optional
        64 hexadecimal digits. By default they are read from a file.
    token_path : path, optional
        The server's token file; by default that of a server of the same user, address and port on this machine.
    timeout_s : float
        Longest wait for a reply [s].
    wait_s : float
        How long to wait for a server that is being started [s].

    Raises
    ------
    ThermorenderError
        Nothing listens there, or the token cannot be read. LinkError: the server refuses the token.
    """
    if token is not None:
        checked_token(token)
    end = time.monotonic() + wait_s
    while True:
        try:
            return _connected(host, port, token, token_path, timeout_s)
        except ThermorenderError as error:
            # A server that has just started replaces the token of one that was killed.
            refused = isinstance(error, LinkError) and (error.code != Code.ACCESS or token is not None)
            if refused or time.monotonic() >= end:
                raise
        time.sleep(0.1)


def _connected(
    host: str, port: int, token: str | None, token_path: str | PathLike[str] | None, timeout_s: float
) -> "Client":
    try:
        connection = socket.create_connection((host, port), timeout_s)
    except (OSError, OverflowError, UnicodeError) as error:
        raise ThermorenderError(
            f"{host} port {port} cannot be reached ({error}); start `thermorender serve SCENE`, or give the host and "
            "port that it printed"
        ) from None
    try:
        if token is None:
            address = str(connection.getpeername()[0])
            return Client(connection, read_token(token_path or found_token_file(address, port)))
        return Client(connection, token)
    except BaseException:
        connection.close()
        raise


class Client:
    """A connection.

    Parameters
    ----------
    connection : socket
    token : str

    Attributes
    ----------
    server : dict
        What the server says of itself: scene, cameras, maps, objects, materials, place, time, products, versions.
    """

    def __init__(self, connection: socket.socket, token: str) -> None:
        self._socket, self._early, self._id = connection, deque[Reply | LinkError](), 0
        self._sessions = 0
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._send(Type.HELLO, 0, [token.encode("ascii")])
        _, payload = self._wait(Type.WELCOME, self._id)
        self.server: dict[str, Any] = json.loads(bytes(payload))

    def __repr__(self) -> str:
        return f"Client(scene {self.server['scene']!r}, cameras {', '.join(self.server['cameras'])})"

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection and its sessions."""
        self._socket.close()

    def open(
        self, camera: str = "", *, method: str = "A", map: str = "", seed: int = 0, position: str = "enu",
        attitude: str = "camera", mount_deg: Sequence[float] = (0.0, 0.0, 0.0),
        lever_arm_m: Sequence[float] = (0.0, 0.0, 0.0), rate_hz: float = 0.0, audit: int = 0,
        below_ground: bool = False,
    ) -> "Session":  # fmt: skip
        """Return a new session: one camera of one vehicle, with its own sensor.

        Parameters
        ----------
        camera : str
            One of `server["cameras"]`; by default the scene's.
        method : {"A", "B", "C"}
            A: rendered. B: the visible view, or the client's own picture, translated by a learned map. C: the map
            translates the orthophoto, and that scene is rendered.
        map : str
            One of `server["maps"]`, for B and C.
        seed : int
            Of the sensor's noise.
        position : {"enu", "wgs84"}
            Local east, north, up [m], or latitude, longitude [deg] and height above the ellipsoid [m].
        attitude : {"camera", "body", "angles"}
            camera: quaternion (w, x, y, z) from camera axes (x right, y down, z along the view) to east, north, up.
            body: quaternion from the vehicle's axes (forward, right, down) to north, east, down. angles: its yaw,
            pitch, roll [deg].
        mount_deg, lever_arm_m : (3,) floats
            Yaw, pitch, roll of the optical axis on the vehicle [deg]; forward, right, down of the camera [m].
        rate_hz : float
            Frames per second of the camera; 0: its own.
        audit : int
            Frames from one measurement of the error budget to the next; 0: the first frame only.
        below_ground : bool
            Take frames from under the terrain.
        """
        self._sessions += 1
        settings = Open(
            camera, map, method, position, attitude, below_ground, audit, seed, rate_hz, mount_deg, lever_arm_m
        )
        try:
            payload = settings.packed()
        except (struct.error, TypeError, UnicodeEncodeError) as error:
            raise ThermorenderError(f"the session's settings cannot be sent ({error}); see Client.open") from None
        number = self._send(Type.OPEN, self._sessions, [payload])
        _, reply = self._wait(Type.OPENED, number)
        return Session(self, self._sessions, settings, Opened.unpacked(bytes(reply)))

    def receive(self) -> Reply:
        """Return the next reply of any session.

        Raises
        ------
        LinkError
            The server's answer to a request is an error; `id` and `session` say to which.
        """
        found = self._early.popleft() if self._early else self._reply()
        if isinstance(found, LinkError):
            raise found
        return found

    def poll(self, wait_s: float = 0.0) -> Reply | None:
        """Return the next reply of any session, or None if none begins within a time [s]."""
        if not self._early and not select.select([self._socket], [], [], wait_s)[0]:
            return None
        return self.receive()

    def reply_to(self, number: int) -> Reply:
        """Return the reply to the request of an id; other replies are kept for `receive`."""
        kept: list[Reply | LinkError] = []
        try:
            while True:
                found = self._early.popleft() if self._early else self._reply()
                if found.id == number:
                    break
                kept.append(found)
        finally:
            self._early.extendleft(reversed(kept))
        if isinstance(found, LinkError):
            raise found
        return found

    def _send(self, kind: Type, session: int, parts: Iterable[Any]) -> int:
        """Send a message and return its id."""
        self._id += 1
        data = b"".join(message(kind, session, self._id, parts))
        try:
            self._socket.sendall(data)
        except OSError as error:
            raise _lost(error) from None
        return self._id

    def _message(self) -> tuple[Head, bytearray]:
        head = head_of(bytes(self._exactly(HEADER.size)))
        return head, self._exactly(head.length)

    def _exactly(self, count: int) -> bytearray:
        data = bytearray(count)
        view = memoryview(data)
        while view:
            try:
                got = self._socket.recv_into(view)
            except OSError as error:
                raise _lost(error) from None
            if not got:
                raise _lost("the server closed it")
            view = view[got:]
        return data

    def _reply(self) -> Reply | LinkError:
        head, payload = self._message()
        if head.type == Type.REPLY:
            return Reply.unpacked(head, payload)
        if head.type == Type.ERROR:
            return error_of(head, payload)
        raise ThermorenderError(f"the server sent {head.type.name} instead of a reply; use the matching versions")

    def _wait(self, kind: Type, number: int) -> tuple[Head, bytearray]:
        """The message of a type and id; replies that come before it are kept."""
        while True:
            head, payload = self._message()
            if head.type == kind and head.id == number:
                return head, payload
            if head.type == Type.ERROR:
                error = error_of(head, payload)
                if head.id in (number, 0):
                    raise error
                self._early.append(error)
            else:
                self._early.append(Reply.unpacked(head, payload))


class Session:
    """One camera of one vehicle; from `Client.open`.

    Attributes
    ----------
    client : Client
    number : int
        Of the session on its connection.
    settings : Open
    opened : Opened
        Size of the image, rate, half a read-out, band.
    """

    def __init__(self, client: Client, number: int, settings: Open, opened: Opened) -> None:
        self.client, self.number, self.settings, self.opened = client, number, settings, opened

    def __repr__(self) -> str:
        one = self.opened
        return f"Session({self.number}, method {self.settings.method}, {one.width}×{one.height}, {one.rate_hz:g} Hz)"

    def frame(self, time_s: float, pose: ArrayLike | None = None, **request: Any) -> Reply:
        """Return the frame of one time: the simulation waits for it.

        Parameters
        ----------
        time_s : float
            After that of the frame before [s].
        pose, **request
            As of `send`.

        Raises
        ------
        LinkError
            The server refuses a value, in one sentence; the session continues as before.
        """
        return self.client.reply_to(self.send(time_s, pose, **request))

    def send(
        self, time_s: float, pose: ArrayLike | None = None, *, path: Any = None,
        products: Iterable[str] = ("counts",), objects: "Objects | Sequence[Sample]" = (),
        picture: NDArray[np.uint8] | None = None, texel_m: float = 0.0, latest: bool = False,
    ) -> int:  # fmt: skip
        """Send a request and return its id; `Client.receive` returns the replies.

        Parameters
        ----------
        time_s : float
            Of the frame [s].
        pose : array, optional
            At that time: position (3) and attitude (4, or 3 angles) in a row, or for attitude camera the (4, 4) matrix
            world_from_camera.
        path : array or Trajectory, optional
            The next samples of the path instead of one pose: rows of time, position, attitude. Rows up to
            `opened.half_readout_s` beyond `time_s` let late rows of the image see the motion.
        products : iterable of str
            Some of `client.server["products"]`.
        objects : dict or sequence
            {dynamic object: {column: value}} at `time_s`, or (object, time [s], {column: value}) in a sequence.
            Columns are east_m, north_m, above_ground_m, yaw_deg, temperature_k.
        picture : (H, W, 3) uint8, optional
            The client's own photograph, for method B.
        texel_m : float
            Its ground sampling distance [m]; 0: the map's own.
        latest : bool
            A later request of this session may replace this one while it waits: the newest pose is rendered.
        """
        try:
            rows = self._rows(time_s, pose, path)
            given: Sequence[Sample] = (
                [(name, time_s, dict(values)) for name, values in objects.items()]
                if isinstance(objects, Mapping)
                else [(name, at, dict(values)) for name, at, values in objects]
            )
            request = Request(float(time_s), product_bits(products), latest, rows, given, picture, texel_m)
            parts = request.packed()
        except ThermorenderError:
            raise
        except (struct.error, TypeError, ValueError) as error:
            raise ThermorenderError(f"the request cannot be sent ({error}); see Session.send") from None
        return self.client._send(Type.REQUEST, self.number, parts)

    def close(self) -> None:
        """End the session; the server forgets its sensor."""
        self.client._wait(Type.CLOSED, self.client._send(Type.CLOSE, self.number, ()))

    def _rows(self, time_s: float, pose: ArrayLike | None, path: Any) -> NDArray[np.float64]:
        """Samples as the wire has them, (n, 8)."""
        if path is not None and pose is not None:
            raise ThermorenderError("pose and path are both given; give the pose as a row of the path")
        if path is None:
            if pose is None:
                return np.zeros((0, 8))
            one = np.asarray(pose, np.float64)
            if one.shape == (4, 4):
                self._refuse_unless_camera("pose of shape (4, 4)")
                one = _numbers(one)
            rows = np.concatenate([[time_s], one.ravel()])[None]
        elif hasattr(path, "quaternion"):
            self._refuse_unless_camera("path of the type Trajectory")
            rows = np.column_stack([path.time_s, path.position, path.quaternion])
        else:
            rows = np.atleast_2d(np.asarray(path, np.float64))
        angles = self.settings.attitude == "angles"
        if angles and rows.shape[1] == 7:
            rows = np.column_stack([rows, np.zeros(len(rows))])
        if rows.ndim != 2 or rows.shape[1] != 8:
            what = "3 angles" if angles else "a quaternion (4)"
            raise ThermorenderError(f"a pose has {rows.shape[-1] - 1} numbers; give a position (3) and {what}")
        return rows

    def _refuse_unless_camera(self, what: str) -> None:
        one = self.settings
        if (one.position, one.attitude) != ("enu", "camera"):
            raise ThermorenderError(
                f"a {what} holds a camera in east, north, up, and this session has position {one.position}, attitude "
                f"{one.attitude}; open one with enu and camera, or give rows of numbers"
            )


# (object, time [s], {column: value}), and {object: {column: value}}.
Sample = tuple[str, float, dict[str, float]]
Objects = Mapping[str, Mapping[str, float]]


def product_bits(names: Iterable[str]) -> int:
    """Return the bits of products."""
    bits = 0
    for name in (names,) if isinstance(names, str) else names:
        product = Product.__members__.get(str(name).upper())
        if product is None:
            known = ", ".join(str(each.name).lower() for each in Product)
            raise ThermorenderError(f"product {shortened(repr(name))} is unknown; give some of {known}")
        bits |= product
    return bits


def _numbers(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position and quaternion of a (4, 4) world_from_camera."""
    from scipy.spatial.transform import Rotation

    from thermorender.trajectory.rotations import checked_pose, wxyz

    pose = checked_pose(pose)
    return np.concatenate([pose[:3, 3], wxyz(Rotation.from_matrix(pose[:3, :3]))])


def _lost(why: object) -> LinkError:
    return LinkError(f"the connection to the server is lost ({why}); check that it runs, and connect again")
