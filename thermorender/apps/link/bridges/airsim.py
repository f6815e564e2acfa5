"""AirSim's calls: thermal frames for its Python clients `airsim` and `cosysairsim`, unchanged.

A subset of AirSim's interface over MessagePack-RPC: poses of vehicles, and images of the types Scene, DepthPlanar,
Segmentation and Infrared. The bridge is a client of the link. AirSim's interface has no authentication: the bridge
listens on this machine only.

AirSim's world is north, east, down from the scene's origin: x is the scene's north, y its east, z the negative of its
up. A quaternion rotates the vehicle's axes (x forward, y right, z down) to these. The camera looks along the vehicle's
x axis. The calls carry no time: a frame is taken 0.1 s after the one before, by a camera that stood still since then:
pixels do not remember an earlier pose.
"""

import contextlib
import math
import socket
import socketserver
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.link.bridges.listener import HOST, LocalListener
from thermorender.apps.link.client import Client, Session, connect
from thermorender.apps.link.messages import Reply
from thermorender.errors import ThermorenderError, shortened

DEFAULT_PORT = 41451
SCENE, DEPTH_PLANAR, SEGMENTATION, INFRARED = 0, 1, 5, 7
# {number of AirSim's image type: product of the link as numbers, as a picture}
TYPES: dict[int, tuple[str, str]] = {
    SCENE: ("", "visible"), DEPTH_PLANAR: ("depth", ""), SEGMENTATION: ("segmentation", "segmentation"),
    INFRARED: ("temperature", "display"),
}  # fmt: skip
# Names of the scene's own camera; other names are those of `serve --camera`.
OWN_CAMERA = ("", "0", "front_center")
STEP_S = 0.1
# Version of the interface: that of cosysairsim; clients of version 1, airsim's, are served, too.
_SERVER, _LEAST_CLIENT = 4, 1
_MOST_VEHICLES, _MOST_IMAGES, _MOST_BYTES, _MOST_CONNECTIONS = 64, 16, 1 << 20, 16
# Letters of the name of a vehicle.
_LONGEST_NAME = 255
# Elements of an array or map of a call.
_MOST_PARTS = 64
# Sessions of the link that all calls may hold: half of the link's, so that those who hold its token find room.
_MOST_SESSIONS = 32
# A connection or session without a call for so long makes room for a new one [s].
_IDLE_S = 5.0


@dataclass(eq=False)
class Held:
    """A session of the link for one camera of one vehicle, on a connection of its own: any thread may end it."""

    time_s: float  # Of its next frame
    session: Session | None = None
    called_s: float = math.inf  # When its last call ended; infinite during one
    ended: bool = False

    def close(self) -> None:
        """End the session and its connection."""
        if self.session is not None:
            with contextlib.suppress(ThermorenderError, OSError):
                self.session.close()
            self.session.client.close()


class Bridge(LocalListener):
    """Answers AirSim's calls with frames of a server; port 0 chooses a free one."""

    def __init__(self, port: int, link_port: int, token: str, link_host: str = HOST) -> None:
        _ = _msgpack()
        self._link = link_host, link_port, token
        # {vehicle: (its pose, calls of the connection that set it last)}, those last in use at the end.
        self._poses: dict[str, tuple[NDArray[np.float64], Calls]] = {}
        self._lock, self._held = threading.Lock(), list[Held]()
        # When the last call of each connection ended; infinite during one.
        self._called_s: dict[socket.socket, float] = {}
        bridge = self

        class Handler(socketserver.BaseRequestHandler):
            def handle(self) -> None:
                if bridge._admitted(self.request):
                    try:
                        with contextlib.suppress(OSError):
                            bridge._serve(self.request)
                    finally:
                        with bridge._lock:
                            bridge._called_s.pop(self.request, None)

        super().__init__(socketserver.ThreadingTCPServer, Handler, port, "AirSim's calls")

    def pose(self, vehicle: str) -> NDArray[np.float64]:
        """Return x, y, z [m] and quaternion w, x, y, z of a vehicle, (7,)."""
        with self._lock:
            if vehicle not in self._poses:
                return np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
            self._poses[vehicle] = found = self._poses.pop(vehicle)
            return found[0].copy()

    def set_pose(self, calls: "Calls", vehicle: str, pose: Any) -> None:
        """Move a vehicle by the calls of a connection; parts that are NaN stay."""
        if len(vehicle) > _LONGEST_NAME:
            raise ThermorenderError(
                f"the name of the vehicle has {len(vehicle)} letters; give one of up to {_LONGEST_NAME}"
            )
        given = np.array([*_values(pose, "position", "xyz"), *_values(pose, "orientation", "wxyz")])
        moved = self.pose(vehicle)
        for part in (slice(0, 3), slice(3, 7)):
            if not np.isnan(given[part]).any():
                moved[part] = given[part]
        length = np.linalg.norm(moved[3:])
        if not np.isfinite(moved).all() or not 0.9 < length < 1.1:
            raise ThermorenderError(
                f"pose {given.tolist()} is not allowed; give finite numbers in metres and a unit quaternion, or NaN to "
                "keep the position or the orientation"
            )
        moved[3:] /= length
        with self._lock:
            own = [name for name, (_, owner) in self._poses.items() if owner is calls]
            if vehicle not in own and len(own) >= _MOST_VEHICLES:
                raise ThermorenderError(
                    f"this connection has set the poses of {_MOST_VEHICLES} vehicles; use the name of one of them"
                )
            self._poses.pop(vehicle, None)
            left = [name for name, (_, owner) in self._poses.items() if owner.ended]
            for name in left[:-_MOST_VEHICLES]:
                del self._poses[name]
            self._poses[vehicle] = moved, calls

    def connected(self) -> Client:
        """Return a new connection to the link."""
        return connect(*self._link)

    def hold(self, time_s: float) -> Held:
        """Return room for a session that begins at a time [s]; the longest idle one is given up for it."""
        with self._lock:
            idle = None
            if len(self._held) >= _MOST_SESSIONS:
                idle = min(self._held, key=lambda each: each.called_s)
                if time.monotonic() - idle.called_s < _IDLE_S:
                    raise ThermorenderError(
                        f"{_MOST_SESSIONS} cameras of vehicles are in use by AirSim's calls; try again when one of "
                        f"them has had no call for {_IDLE_S:g} s"
                    )
                self._held.remove(idle)
                idle.ended = True
            held = Held(time_s)
            self._held.append(held)
        if idle is not None:
            idle.close()
        return held

    def keep(self, held: Held) -> bool:
        """Keep a session from being given up during a call; False if it was already."""
        with self._lock:
            held.called_s = math.inf
            return not held.ended

    def end(self, sessions: Iterable[Held]) -> None:
        """Give sessions back."""
        for held in sessions:
            with self._lock:
                held.ended = True
                self._held = [each for each in self._held if each is not held]
            held.close()

    def _admitted(self, connection: socket.socket) -> bool:
        """Whether there is room for a connection; the longest idle one is ended for it."""
        with self._lock:
            now = time.monotonic()
            if len(self._called_s) >= _MOST_CONNECTIONS:
                idle = min(self._called_s, key=lambda each: self._called_s[each])
                if now - self._called_s[idle] < _IDLE_S:
                    return False
                del self._called_s[idle]
                with contextlib.suppress(OSError):
                    idle.shutdown(socket.SHUT_RDWR)
            self._called_s[connection] = now
            return True

    def _called(self, connection: socket.socket, time_s: float) -> None:
        """State when the last call of a connection ended; one that was ended stays so."""
        with self._lock:
            if connection in self._called_s:
                self._called_s[connection] = time_s

    def _serve(self, connection: socket.socket) -> None:
        """Answer the calls of one connection until it ends, or sends something else."""
        msgpack = _msgpack()
        # The stated length of an array takes memory before its elements arrive, and arrays may be nested.
        unpacker = msgpack.Unpacker(
            raw=False, max_buffer_size=_MOST_BYTES, strict_map_key=False, max_array_len=_MOST_PARTS,
            max_map_len=_MOST_PARTS,
        )  # fmt: skip
        with contextlib.closing(Calls(self)) as calls:
            while data := connection.recv(1 << 16):
                try:
                    unpacker.feed(data)
                    messages = list(unpacker)
                except (ValueError, msgpack.UnpackException):
                    return
                for each in messages:
                    # A request is [0, number, method, arguments]; a notification [2, method, arguments] has no answer.
                    if not isinstance(each, list) or len(each) != 4 or each[0] != 0 or not isinstance(each[1], int):
                        return
                    self._called(connection, math.inf)
                    error, result = calls.answer(each[2], each[3])
                    connection.sendall(msgpack.packb([1, each[1], error, result], use_single_float=True))
                    self._called(connection, time.monotonic())


class Calls:
    """The calls of one connection, with its sessions of the link."""

    def __init__(self, bridge: Bridge) -> None:
        self.bridge, self.ended = bridge, False
        self._sessions: dict[tuple[str, str], Held] = {}
        self._begin_s = 0.0  # Of new sessions: after the frames of those that were given up
        self._methods: dict[str, Callable[..., Any]] = {
            "ping": lambda: True, "getServerVersion": lambda: _SERVER,
            "getMinRequiredClientVersion": lambda: _LEAST_CLIENT,
            "simSetVehiclePose": self._set_pose, "simGetVehiclePose": lambda name="": _pose_of(bridge.pose(name)),
            "simGetImages": self._images, "simGetCameraInfo": self._camera_info,
        }  # fmt: skip

    def close(self) -> None:
        """Give the sessions back. The poses that the connection set stay until others need the room."""
        self.ended = True
        self.bridge.end(self._sessions.values())

    def answer(self, method: Any, arguments: Any) -> tuple[str | None, Any]:
        """Return (error or None, result) of a call."""
        if not isinstance(method, str) or method not in self._methods:
            name = shortened(repr(method)) if isinstance(method, str) else f"of type {type(method).__name__}"
            return f"method {name} is not served; call one of {', '.join(self._methods)}", None
        try:
            return None, self._methods[method](*arguments)
        except ThermorenderError as error:
            return str(error), None
        except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
            return f"the arguments of {method} are not those of AirSim ({shortened(str(error))}); see its client", None

    def _set_pose(self, pose: Any, ignore_collision: bool = True, vehicle: str = "") -> None:
        self.bridge.set_pose(self, str(vehicle), pose)

    def _images(self, requests: Any, vehicle: str = "", external: bool = False) -> list[dict[str, Any]]:
        if len(requests) > _MOST_IMAGES:
            raise ThermorenderError(f"{len(requests)} images are requested at once; request up to {_MOST_IMAGES}")
        wanted: dict[str, set[str]] = {}
        for each in requests:
            wanted.setdefault(str(each["camera_name"]), set()).add(_product(each))
        pose = self.bridge.pose(vehicle)
        frames = {camera: self._frame(vehicle, camera, pose, products) for camera, products in wanted.items()}
        return [self._response(each, frames[str(each["camera_name"])], pose) for each in requests]

    def _frame(self, vehicle: str, camera: str, pose: NDArray[np.float64], products: set[str]) -> Reply:
        north, east, down = pose[:3]
        place = [east, north, -down, *pose[3:]]
        with self._session(vehicle, camera) as held:
            assert held.session is not None
            time_s = held.time_s
            held.time_s += STEP_S
            # The camera moves right after the frame before, and then stands still.
            rows = [[time_s - 0.999 * STEP_S, *place], [time_s, *place]]
            return held.session.frame(time_s, path=rows, products=sorted(products))

    @contextlib.contextmanager
    def _session(self, vehicle: str, camera: str) -> Iterator[Held]:
        """The session of a vehicle's camera, opened where there is none or it was given up."""
        held = self._sessions.get((vehicle, camera))
        if held is None or not self.bridge.keep(held):
            held = self._sessions[vehicle, camera] = self._opened("" if camera in OWN_CAMERA else camera)
        try:
            yield held
        finally:
            held.called_s = time.monotonic()

    def _opened(self, camera: str) -> Held:
        for key, each in list(self._sessions.items()):
            if each.ended:
                self._begin_s = max(self._begin_s, each.time_s)
                del self._sessions[key]
        held = self.bridge.hold(self._begin_s)
        try:
            client = self.bridge.connected()
            try:
                held.session = client.open(camera, attitude="body", rate_hz=1.0 / STEP_S)
            except BaseException:
                client.close()
                raise
        except BaseException:
            self.bridge.end([held])
            raise
        return held

    def _response(self, request: dict[str, Any], reply: Reply, pose: NDArray[np.float64]) -> dict[str, Any]:
        product = _product(request)
        image = np.asarray(getattr(reply, product))
        floats, packed = bool(request["pixels_as_float"]), b""
        if not floats:
            packed = _encoded(_picture(product, image), bool(request["compress"]))
        where = _pose_of(pose)
        return {
            "image_data_uint8": packed,
            "image_data_float": image.astype(np.float32).ravel().tolist() if floats else [],
            "camera_name": request["camera_name"], "camera_position": where["position"],
            "camera_orientation": where["orientation"], "time_stamp": round(reply.time_s * 1e9), "message": "",
            "pixels_as_float": floats, "compress": bool(request["compress"]), "width": image.shape[1],
            "height": image.shape[0], "image_type": request["image_type"], "annotation_name": "",
        }  # fmt: skip

    def _camera_info(self, camera: str = "", vehicle: str = "", external: bool = False) -> dict[str, Any]:
        with self.bridge.connected() as client:
            server = client.server
        name = server["camera"] if camera in OWN_CAMERA else camera
        known = server["cameras"]
        if name not in known:
            raise ThermorenderError(
                f"camera {shortened(repr(name))} is not served; give 0 or one of {', '.join(known)}"
            )
        width, height, focal = (known[name][key] for key in ("width", "height", "focal_length_px"))
        # OpenGL's projection from camera axes to −1…1, without limits in depth.
        matrix = np.zeros((4, 4))
        matrix[0, 0], matrix[1, 1], matrix[2, 3], matrix[3, 2] = 2.0 * focal / width, 2.0 * focal / height, 1.0, -1.0
        return {
            "pose": _pose_of(self.bridge.pose(vehicle)), "fov": float(np.degrees(2.0 * np.arctan(0.5 * width / focal))),
            "proj_mat": {"matrix": matrix.tolist()},
        }  # fmt: skip


def _product(request: dict[str, Any]) -> str:
    """The link's product of an image request."""
    number, floats = request["image_type"], bool(request["pixels_as_float"])
    if number not in TYPES:
        raise ThermorenderError(
            f"image type {shortened(repr(number))} is not served; request 0 Scene, 1 DepthPlanar, 5 Segmentation or "
            "7 Infrared"
        )
    found = TYPES[number][0 if floats else 1]
    if not found:
        raise ThermorenderError(
            f"image type {number} is not served with pixels_as_float={floats}; request it with {not floats}"
        )
    return found


def _picture(product: str, image: NDArray[Any]) -> NDArray[np.uint8]:
    """The picture (H, W, 3) in the order blue, green, red."""
    if product == "visible":
        return image[..., ::-1]
    if product == "segmentation":
        # The number of the object: its lowest byte is red, the next green.
        return np.stack([(image >> bits) & 255 for bits in (16, 8, 0)], axis=-1).astype(np.uint8)
    return np.repeat(image[..., None], 3, axis=-1)


def _encoded(picture: NDArray[np.uint8], compress: bool) -> bytes:
    if not compress:
        return np.ascontiguousarray(picture).tobytes()
    import cv2

    return cv2.imencode(".png", picture)[1].tobytes()


def _values(pose: Any, part: str, axes: str) -> list[float]:
    return [float(pose[part][f"{axis}_val"]) for axis in axes]


def _pose_of(pose: NDArray[np.float64]) -> dict[str, Any]:
    position = {f"{axis}_val": float(value) for axis, value in zip("xyz", pose[:3], strict=True)}
    return {
        "position": position,
        "orientation": {f"{axis}_val": float(value) for axis, value in zip("wxyz", pose[3:], strict=True)},
    }


def _msgpack() -> Any:
    try:
        import msgpack
    except ImportError:
        raise ThermorenderError(
            "AirSim's calls need msgpack, which is not installed; run `pip install 'thermorender[airsim]'`"
        ) from None
    return msgpack
