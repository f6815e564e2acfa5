"""A scene in words: one line for `repr`, a short table with sizes, units and ranges for `str`."""

import base64
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.materials.mixture import Mixture
from thermorender.scene.spec import WEATHER
from thermorender.units import utc_text

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene

# Longer side of a picture of the terrain, at most [px].
_PICTURE_PX = 240
# Largest number of names in a line; the rest is counted.
_MOST_NAMES = 12


def line_of(scene: "Scene") -> str:
    """Return one line on a scene: name, size, temperatures, sky and camera."""
    texels = sum(surface.material.size for surface in scene.surfaces)
    camera, folder = scene.camera, scene.spec.folder.name
    return (
        f"Scene({folder!r}, {texels} texels of {scene.main_surface.texel_m:.3g} m, {_temperature(scene)}, "
        f"{_sky(scene)}, {camera.name} {camera.width}×{camera.height})"
    )


def table_of(scene: "Scene") -> str:
    """Return a short table on a scene, a line for each of its parts."""
    frame, camera, spec = scene.frame, scene.camera, scene.spec
    faces = sum(len(surface.faces) for surface in scene.surfaces)
    texels = sum(surface.material.size for surface in scene.surfaces)
    lines = [
        f"{spec.folder.name}: {spec.title}",
        f"  mesh          {faces} triangles, {texels} texels of {scene.main_surface.texel_m:.3g} m",
        f"  temperature   {spec.temperature.source}, {_temperature(scene)}",
        f"  materials     {_materials(scene)}",
        f"  sky           {_sky(scene, True)}",
        f"  objects       {_listed([_counted(item.name, scene) for item in spec.objects])}",
        f"  camera        {camera.name}, {camera.width}×{camera.height}",
    ]
    if frame:
        lines.insert(2, f"  origin        {frame.latitude_deg:.6f}°, {frame.longitude_deg:.6f}°, "
                        f"{frame.height_m:g} m above the ellipsoid")  # fmt: skip
    return "\n".join(lines)


def _counted(name: str, scene: "Scene") -> str:
    """The name of an object, with the number of its copies or crowns."""
    for surface in scene.surfaces:
        if surface.instances is not None and surface.name.split(":")[0] == name:
            return f"{name} ({surface.instances})"
    return name


def html_of(scene: "Scene") -> str:
    """Return the table as HTML, with the terrain from above where the scene has a map."""
    table = f"<pre>{escape(table_of(scene))}</pre>"
    if scene.grid is None:
        return table
    import cv2

    colour = scene.main_surface.colour
    step = -(-max(colour.shape) // _PICTURE_PX)
    data = cv2.imencode(".png", np.ascontiguousarray(colour[::step, ::step, ::-1]))[1].tobytes()
    picture = f'<img alt="the terrain from above" src="data:image/png;base64,{base64.b64encode(data).decode()}">'
    return f'<div style="display:flex;gap:1em;align-items:flex-start">{picture}{table}</div>'


def _temperature(scene: "Scene") -> str:
    state = scene.temperature_state
    when = "" if scene.time is None else utc_text(scene.time)
    if not state.solved:
        return f"to be solved for {when}"
    terrain = [surface.temperature for surface in scene.near_ground]
    low, high = min(values.min() for values in terrain), max(values.max() for values in terrain)
    return f"{low:.1f}–{high:.1f} K" + (f" at {when}" if state.weather_driven else "")


def _sky(scene: "Scene", long: bool = False) -> str:
    if scene.air is None:
        kelvin = scene.spec.sky_temperature
        return "no sky" if kelvin is None else f"{kelvin:g} K" if long else f"sky of {kelvin:g} K"
    altitude_m = scene.altitude_m
    if long:
        of = "of the weather: " if scene.spec.atmosphere and scene.spec.atmosphere.standard == WEATHER else "that of "
        return f"{of}{scene.air}, {altitude_m:.0f} m above sea level"
    return f"air, {altitude_m:.0f} m above sea level"


def _materials(scene: "Scene") -> str:
    materials, report = scene.materials, scene.emissivity_report
    pure = [material.name for material in materials if not isinstance(material, Mixture)]
    mixes = len(materials) - len(pure)
    words = _listed(pure) + (f" and {mixes} mixes of them" if mixes else "")
    if report:
        words += (
            f"; read from colour by {report['model']!r}, {report['share_unknown']:.1%} unknown and taken for "
            f"{report['fallback']}"
        )
        if "mean_std" in report:
            words += f"; emissivity ± {report['mean_std']:.3f} on average, {report['share_uncertain']:.1%} flagged"
    return words


def _listed(names: list[Any]) -> str:
    more = len(names) - _MOST_NAMES
    return (", ".join(names[:_MOST_NAMES]) or "none") + (f" and {more} more" if more > 0 else "")
