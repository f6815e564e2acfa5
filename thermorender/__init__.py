"""thermorender: long-wave infrared frames of terrain flights, radiometrically true, in kelvin.

    import thermorender as tr
    scene = tr.load_scene("heath")
    frame = tr.Renderer(scene).frame(tr.pose(0, 0, 120, pitch_deg=-90))
    frame.apparent_temperature  # (512, 640) float32 [K]

Importing the package is light; Mitsuba is loaded with the first Renderer.
"""

from importlib import import_module

_PUBLIC = {
    "Frame": "thermorender.frame",
    "Renderer": "thermorender.render.renderer",
    "Scene": "thermorender.scene.load",
    "ThermorenderError": "thermorender.errors",
    "Trajectory": "thermorender.trajectory",
    "fly": "thermorender.flight",
    "load_scene": "thermorender.scene.load",
    "pose": "thermorender.trajectory.path",
    "read_trajectory": "thermorender.trajectory",
}
__all__ = list(_PUBLIC)


def __getattr__(name):
    if name not in _PUBLIC:
        raise AttributeError(f"module 'thermorender' has no attribute {name!r}")
    return getattr(import_module(_PUBLIC[name]), name)


def __dir__():
    return sorted([*globals(), *_PUBLIC])
