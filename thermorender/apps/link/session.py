"""A session: one camera of one vehicle, with its path and the state of its sensor, from request to reply.

It holds no physics: frames come from `LiveFrames`, as a flight takes them, and translations from the learned map.
"""

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Frame, Renderer, Scene, TemperatureMap, Trajectory
from thermorender.apps.link.messages import Open, Opened, Request, reply_bytes, reply_head, target_rows
from thermorender.apps.link.wire import ALL_PRODUCTS, Product
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import Inputs
from thermorender.output.photograph import photograph
from thermorender.physics.band import radiance_in_band
from thermorender.physics.planck import band_radiance
from thermorender.render.flight.live import LiveFrames
from thermorender.render.flight.timed import TimedRenderer
from thermorender.trajectory.readers import enu_from_ned_at, of_vehicle
from thermorender.trajectory.rotations import rotation_from_angles

# Highest place whose distance from the scene is worth computing [m].
_HIGHEST_M = 1e6


class ServerSession:
    """One camera of one vehicle: a Renderer with its camera, temperatures and seed, and the map of methods B and C."""

    def __init__(self, settings: Open, renderer: Renderer, model: TemperatureMap | None = None) -> None:
        self.settings, self.renderer, self.model = settings, renderer, model
        self.last: Frame | None = None
        how = settings.rate_hz or None, settings.audit, settings.below_ground
        self.frames: LiveFrames[Renderer]
        if settings.method == "B":
            assert model is not None
            self.frames = TranslatedFrames(renderer, model, *how)
        else:
            self.frames = LiveFrames(renderer, *how)
        camera = renderer.scene.camera
        unknown = (float("nan"), float("nan"))
        self.opened = Opened(
            camera.width, camera.height, self.frames.rate_hz, self.frames.half_readout_s, self.frames.ahead_s,
            camera.time_constant_s, camera.band_um, camera.bits, unknown if model is None else model.range_k,
        )  # fmt: skip

    def __repr__(self) -> str:
        return f"ServerSession({self.settings.method}, {self.frames!r})"

    @property
    def most_bytes(self) -> int:
        """Length of the longest reply."""
        targets = len(self.renderer.scene.spec.objects)
        return reply_bytes(ALL_PRODUCTS, self.opened.width, self.opened.height, targets)

    def add(self, request: Request) -> None:
        """Add what a replaced request gives to the path and to the objects."""
        self.frames.add(request.time_s, self._path(request.poses) if len(request.poses) else None, request.objects)

    def answer(self, requests: Sequence[Request], arrived_s: float, added: int = 0) -> list[Any]:
        """Return the payload of a reply, as a list of buffers, to the last of some requests. Earlier ones, which the
        last replaces, only add to the path and to the objects, like the `added` before them; `arrived_s` is on the
        clock of `time.perf_counter` [s].
        """
        start, request = time.perf_counter(), requests[-1]
        frame = self._frame(requests)
        products = [
            np.ascontiguousarray(image(self, frame)) for product, image in _IMAGES.items() if request.products & product
        ]
        rows = target_rows(frame.targets if request.products & Product.TARGETS else {})
        budget = frame.budget_mk or {}
        errors = budget.get("total", float("nan")), budget.get("image", float("nan"))
        frozen = bool(frame.plan.get("sensor", {}).get("frozen"))
        done = time.perf_counter()
        head = reply_head(
            frame.time_s, frame.seed, frame.index, errors, done - arrived_s, done - start, request.products,
            frame.radiance.shape, added + len(requests) - 1, frozen, len(rows),
        )  # fmt: skip
        return [head, *products, rows.tobytes()]

    def _frame(self, requests: Sequence[Request]) -> Frame:
        request = requests[-1]
        if request.picture is not None:
            self._check_picture(request.picture)
        elif request.texel_m:
            raise ThermorenderError(
                f"texel_m={request.texel_m:g} is that of a picture, and the request has none; leave it out, or give one"
            )
        poses = np.concatenate([each.poses for each in requests])
        path = self._path(poses) if len(poses) else None
        objects = [each for one in requests for each in one.objects]
        reading = bool(request.products & (Product.COUNTS | Product.DISPLAY))
        if isinstance(self.frames, TranslatedFrames):
            self.frames.picture, self.frames.texel_m = request.picture, request.texel_m or None
        self.last = self.frames.take(request.time_s, path, objects, reading)
        return self.last

    def _check_picture(self, picture: NDArray[np.uint8]) -> None:
        if self.settings.method != "B":
            raise ThermorenderError(
                f"the picture has no use in method {self.settings.method}; leave it out, or open a session of method B"
            )
        wanted, (height, width) = self.opened, picture.shape[:2]
        if (height, width) != (wanted.height, wanted.width):
            raise ThermorenderError(
                f"the picture has {width} × {height} pixels; resize it to those of the session's camera, "
                f"{wanted.width} × {wanted.height}"
            )

    def _path(self, poses: NDArray[np.float64]) -> Trajectory:
        """The camera's path of poses as they arrived, by the conventions of flight logs."""
        settings, frame = self.settings, self.renderer.scene.frame
        time_s, position, attitude = poses[:, 0], poses[:, 1:4], poses[:, 4:]
        if settings.position == "wgs84":
            position = _local(self.renderer.scene, position)
        if settings.attitude == "camera":
            return Trajectory(time_s, position, attitude)
        if settings.attitude == "angles":
            if attitude[:, 3].any():
                raise ThermorenderError(
                    f"attitude {attitude[0].tolist()} has a fourth number; give yaw, pitch, roll in degrees, and 0"
                )
            ned_from_body = rotation_from_angles(*attitude[:, :3].T)
        else:
            # It refuses quaternions that are not unit ones.
            ned_from_body = Trajectory(time_s, position, attitude).rotation
        enu_from_ned = enu_from_ned_at(position, frame if settings.position == "wgs84" else None)
        # In the order of `read_trajectory`, for the same bits.
        ned_from_optical = ned_from_body * rotation_from_angles(*settings.mount_deg)
        return of_vehicle(
            time_s, position, enu_from_ned * ned_from_body, enu_from_ned * ned_from_optical,
            np.asarray(settings.lever_arm_m),
        )  # fmt: skip


class TranslatedFrames(LiveFrames[Renderer]):
    """Frames that a learned map makes of the visible view, or of the client's own picture."""

    def __init__(
        self, renderer: Renderer, model: TemperatureMap, rate_hz: float | None, audit: int, allow_below_ground: bool
    ) -> None:
        super().__init__(renderer, rate_hz, audit, allow_below_ground)
        if model.needs:
            # This raises the error that names the missing inputs.
            model.radiance(Inputs(np.zeros((1, 1, 3), np.uint8)))
        self.model = model
        # For the next frame, (H, W, 3) sRGB, with its ground sampling distance [m]; without them the photograph of its
        # pose, and the map's own.
        self.picture: NDArray[np.uint8] | None = None
        self.texel_m: float | None = None

    def made(
        self, timed: TimedRenderer[Renderer], time_s: float, pose: NDArray[np.float64], index: int, reading: bool
    ) -> Frame:
        """Return the translated frame; a camera at rest reads it."""
        renderer, objects, picture, texel_m = timed.at(time_s), self.objects_at(time_s), self.picture, self.texel_m
        if picture is None:
            picture, covered = photograph(renderer, pose, time_s, objects)
            depth = renderer.depth(pose)
            near = depth[covered & np.isfinite(depth)]
            texel_m = float(np.median(near)) / renderer.scene.camera.focal_length_px if near.size else None
        # Hot spots beyond the trained range keep their contrast, which a seeker follows.
        coldest = band_radiance(self.model.limits_k[0], *self.model.band_um)
        radiance = np.maximum(self.model.radiance(Inputs(picture, texel_m)), coldest)
        radiance = radiance_in_band(radiance, self.model.band_um, renderer.scene.camera.band_um).astype(np.float32)
        plan = {"method": "B", "map": self.model.name}
        return renderer.frame_of(radiance, pose, plan, time_s, index, objects)


def _local(scene: Scene, position: NDArray[np.float64]) -> NDArray[np.float64]:
    """Positions in the scene's frame, (n, 3) [m], of latitude, longitude [deg] and height above the ellipsoid [m]."""
    if scene.frame is None:
        raise ThermorenderError(f"{scene.where} has no place on Earth; give positions of the kind enu, or add [frame]")
    latitude, longitude, height = position.T
    wrong = (np.abs(latitude) > 90.0) | (longitude < -180.0) | (longitude > 360.0) | (np.abs(height) > _HIGHEST_M)
    if wrong.any():
        given = "{:g}°, longitude {:g}°, height {:g} m".format(*position[wrong][0])
        raise ThermorenderError(
            f"latitude {given} is not a place; latitudes are −90…90, longitudes −180…180 or 0…360, heights up to "
            f"{_HIGHEST_M:g}"
        )
    return scene.frame.enu_from_geodetic(latitude, longitude, height)


def _visible(session: ServerSession, frame: Frame) -> NDArray[np.uint8]:
    frames = session.frames
    if isinstance(frames, TranslatedFrames) and frames.picture is not None:
        return frames.picture
    return photograph(frames.renderer_at(frame.time_s), frame.pose, frame.time_s, frames.objects_at(frame.time_s))[0]


# {product: (session, frame) → its image}, in the order of the payload.
_IMAGES: dict[Product, Any] = {
    Product.COUNTS: lambda _, frame: frame.counts,
    Product.TEMPERATURE: lambda _, frame: frame.apparent_temperature,
    Product.DISPLAY: lambda _, frame: frame.display,
    Product.RADIANCE: lambda _, frame: frame.radiance,
    Product.DEPTH: lambda _, frame: frame.truth["depth"],
    Product.SEGMENTATION: lambda _, frame: frame.truth["object"],
    Product.MATERIAL: lambda _, frame: frame.truth["material"],
    Product.VISIBLE: _visible,
}
