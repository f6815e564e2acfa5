"""thermorender: thermal infrared frames of terrain flights, radiometrically true, in kelvin.

    import thermorender as tr
    scene = tr.load_scene("heath")
    frame = tr.Renderer(scene).frame(scene.pose(0, 0, 120, look_at=(0, 0, 0)))
    frame.apparent_temperature  # (512, 640) float32 [K]
    frame.show()

Importing the package is light; Mitsuba is loaded with the first Renderer. `__version__` is read from the metadata of
the installed package.
"""

from importlib import import_module
from typing import TYPE_CHECKING

_PUBLIC = {
    "Atmosphere": "thermorender.atmosphere.model",
    "BakedScene": "thermorender.render.baked",
    "Camera": "thermorender.sensor.camera",
    "FlightOptions": "thermorender.output.flight",
    "Frame": "thermorender.frame",
    "Material": "thermorender.materials.material",
    "Renderer": "thermorender.render.renderer",
    "Scene": "thermorender.scene.scene",
    "TemperatureMap": "thermorender.learned.temperature_map",
    "TiledRenderer": "thermorender.render.tiled.tiled_renderer",
    "ThermorenderError": "thermorender.errors",
    "Trajectory": "thermorender.trajectory",
    "Weather": "thermorender.weather.series",
    "compare": "thermorender.apps.compare.comparison",
    "fly": "thermorender.output.flight",
    "link": "thermorender.apps",
    "load_camera": "thermorender.sensor.camera",
    "load_scene": "thermorender.scene.load",
    "load_trajectory": "thermorender.scene.load",
    "pose": "thermorender.trajectory.path",
}
__all__ = list(_PUBLIC)


if TYPE_CHECKING:
    # The same names for type checkers and editors; with a __getattr__ they would accept any name.
    __version__: str
    from thermorender.apps import link as link
    from thermorender.apps.compare.comparison import compare as compare
    from thermorender.atmosphere.model import Atmosphere as Atmosphere
    from thermorender.errors import ThermorenderError as ThermorenderError
    from thermorender.frame import Frame as Frame
    from thermorender.learned.temperature_map import TemperatureMap as TemperatureMap
    from thermorender.materials.material import Material as Material
    from thermorender.output.flight import FlightOptions as FlightOptions
    from thermorender.output.flight import fly as fly
    from thermorender.render.baked import BakedScene as BakedScene
    from thermorender.render.renderer import Renderer as Renderer
    from thermorender.render.tiled.tiled_renderer import TiledRenderer as TiledRenderer
    from thermorender.scene.load import load_scene as load_scene
    from thermorender.scene.load import load_trajectory as load_trajectory
    from thermorender.scene.scene import Scene as Scene
    from thermorender.sensor.camera import Camera as Camera
    from thermorender.sensor.camera import load_camera as load_camera
    from thermorender.trajectory import Trajectory as Trajectory
    from thermorender.trajectory.path import pose as pose
    from thermorender.weather.series import Weather as Weather
else:

    def __getattr__(name):
        if name == "__version__":
            from thermorender.versions import version_of

            return version_of("thermorender")
        if name not in _PUBLIC:
            raise AttributeError(f"module 'thermorender' has no attribute {name!r}")
        home = import_module(_PUBLIC[name])
        return import_module(f"{home.__name__}.{name}") if name == "link" else getattr(home, name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_PUBLIC, "__version__"])
