"""What a server shows: one scene, its cameras and learned maps, and a renderer for each combination in use.

Everything here runs in the one thread that renders.
"""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from thermorender import Camera, Renderer, TemperatureMap
from thermorender.apps.link.messages import Open, name_bytes
from thermorender.apps.link.session import ServerSession
from thermorender.apps.link.wire import Product
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import load_model
from thermorender.versions import versions

# Most renderers of different cameras and maps; each holds its own light and textures.
MOST_RENDERERS = 16


@dataclass
class Stage:
    """A scene that sessions look at."""

    renderer: Renderer  # Of the scene with its own camera
    # {name: Camera} that a session may choose; the scene's own is always there
    cameras: Mapping[str, Camera] = field(default_factory=dict)
    # Learned maps that a session may choose, names or files; a file goes by its own name
    maps: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        own = self.renderer.scene.camera
        self.cameras = {own.name: own, **self.cameras}
        self._models: dict[str, tuple[str, TemperatureMap]] = {}
        for text in self.maps:
            model = load_model(text)
            self._models[model.name] = text, model
        for name in (*self.cameras, *self._models, *(item.name for item in self.renderer.scene.spec.objects)):
            name_bytes(name)
        self._made: dict[tuple[str, str], Renderer] = {(own.name, ""): self.renderer}

    @property
    def notes(self) -> list[str]:
        """Sentences on maps of another band than a camera's."""
        return [
            f"{note} than that of camera {camera.name}"
            for _, model in self._models.values()
            for camera in self.cameras.values()
            if (note := model.band_note(camera.band_um))
        ]

    def describe(self) -> dict[str, Any]:
        """Return what a client may want to know, as plain values."""
        scene = self.renderer.scene
        place = scene.frame
        return {
            "scene": scene.name,
            "camera": scene.camera.name,
            "cameras": {
                name: {
                    "width": each.width,
                    "height": each.height,
                    "frame_rate_hz": each.frame_rate_hz,
                    "focal_length_px": each.focal_length_px,
                }
                for name, each in self.cameras.items()
            },
            "maps": list(self._models),
            "objects": [item.name for item in scene.spec.objects],
            "dynamic_objects": [item.name for item in scene.tracked_objects],
            "materials": [material.name for material in scene.materials],
            "place": place and asdict(place),
            "time": None if scene.time is None else str(scene.time),
            "products": [str(product.name).lower() for product in Product],
            "versions": versions(),
        }

    def open(self, settings: Open) -> ServerSession:
        """Return a new session."""
        name = settings.camera or self.renderer.scene.camera.name
        if name not in self.cameras:
            raise ThermorenderError(
                f"camera {name!r} is not served; give one of {', '.join(self.cameras)}, or start the server with "
                "this camera"
            )
        if settings.method == "A":
            if settings.map:
                raise ThermorenderError(f"map {settings.map!r} has no use in method A; leave it out, or give B or C")
        elif settings.map not in self._models:
            raise ThermorenderError(
                f"map {settings.map!r} is not served; give one of {', '.join(self._models) or 'none'}, or start the "
                "server with this map"
            )
        if settings.attitude == "camera" and any((*settings.mount_deg, *settings.lever_arm_m)):
            raise ThermorenderError(
                "mount and lever arm belong to attitudes of a vehicle; give attitude body or angles, or leave them out"
            )
        if settings.position == "wgs84" and self.renderer.scene.frame is None:
            raise ThermorenderError(
                f"{self.renderer.scene.where} has no place on Earth; give positions of the kind enu"
            )
        renderer = self._renderer(name, settings.map if settings.method == "C" else "")
        model = self._models[settings.map][1] if settings.map else None
        return ServerSession(settings, renderer.with_seed(settings.seed), model)

    def _renderer(self, camera: str, model: str) -> Renderer:
        """The Renderer of a camera and of the map that gives the temperatures."""
        key = camera, model
        if key not in self._made:
            if len(self._made) >= MOST_RENDERERS:
                raise ThermorenderError(
                    f"{MOST_RENDERERS} combinations of camera and map are in use; use those, or start another server"
                )
            self._made[key] = self._translated(camera, model) if model else self._seen_by(camera)
        return self._made[key]

    def _seen_by(self, camera: str) -> Renderer:
        return self.renderer.seen_by(self.cameras[camera])

    def _translated(self, camera: str, model: str) -> Renderer:
        """The Renderer of method C, with the temperatures of the map also in objects."""
        from thermorender.apps.compare.methods import rendered

        reference = self._renderer(camera, "")
        text, loaded = self._models[model]
        return rendered(reference.scene, text, loaded, reference)[0].renderer
