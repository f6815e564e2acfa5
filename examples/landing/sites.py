"""Landing sites: procedural worlds with a heated marker, and the conditions that vary between runs."""

from dataclasses import dataclass, replace

import numpy as np

from thermorender import defaults
from thermorender.apps.lands.procedural.procedural_scene import make, weather_of
from thermorender.apps.lands.procedural.truth import write
from thermorender.scene.load import load_scene

# Name and width [m] of the marker, a black disc, and the name of the worlds' own marker, which is removed.
MARKER, MARKER_M, _OTHER = "landing_marker", 0.5, "marker"
# Kinds of land and hazes alternate over the worlds.
KINDS = defaults.SCENES[:2]
WORLDS, _FIRST_SEED = 8, 401
HAZES = (None, "rural-23km", "rural-5km", "maritime-23km")
_AIR = "midlatitude-summer"
# Sides of the terrain, of a texel and of a height post [m].
SIZES = dict(zip(KINDS, ((96.0, 0.25, 1.0), (96.0, 0.25, 0.5)), strict=True))
# Range of the marker's temperature over all runs [K].
_RANGE_K = (240.0, 380.0)
# The marker is placed on the flattest ground within this distance of the middle, over this radius [m].
_AROUND_M, _EVEN_M = 12.0, 1.5
START_M = 40.0


@dataclass(frozen=True)
class Conditions:
    """The conditions of one run.

    Attributes
    ----------
    world : int
    offset_m : (2,) tuple of float
        Offset of the start from the marker, east and north [m].
    wind_m_s : (2,) tuple of float
        Mean wind, east and north [m/s].
    contrast_k : float
        Contrast of the marker to the ground around it [K].
    noise : float
        Factor on the camera's NETD.
    """

    world: int
    offset_m: tuple
    wind_m_s: tuple
    contrast_k: float
    noise: float


def conditions_of(run):
    """Return the Conditions of a run (int), the same for every kind of frames."""
    rng = np.random.default_rng([8404, run])
    (bearing, blowing), distance = rng.uniform(0.0, 2.0 * np.pi, 2), rng.uniform(2.0, 9.0)
    speed, contrast = rng.uniform(0.0, 9.0), np.exp(rng.uniform(np.log(2.0), np.log(40.0)))
    noise = np.exp(rng.uniform(0.0, np.log(4.0)))

    def towards(length, angle):
        return (float(length * np.sin(angle)), float(length * np.cos(angle)))

    return Conditions(run % WORLDS, towards(distance, bearing), towards(speed, blowing), float(contrast), float(noise))


def world(number, folder, sizes=None):
    """Return the Scene of a world with its marker; its folder is made if it is missing.

    Parameters
    ----------
    number : int
    folder : Path
    sizes : dict, optional
        Replaces SIZES.
    """
    if not folder.is_dir():
        kind = KINDS[number % len(KINDS)]
        size, texel, post = (sizes or SIZES)[kind]
        made = make(kind, _FIRST_SEED + number, size, texel, post, weather=weather_of(kind, number))
        # Cars and houses may mislead the vehicle, but a second marker would make the task ambiguous.
        write(replace(made, objects=tuple(item for item in made.objects if item["name"] != _OTHER)), folder)
    scene = load_scene(folder)
    east, north = _even_place(scene)
    if MARKER not in (item.name for item in scene.spec.objects):
        coldest, warmest = _RANGE_K
        (folder / "marker.csv").write_text(f"time_s,temperature_k\n0,{coldest:g}\n3600,{warmest:g}\n")
        with open(folder / "scene.toml", "a", encoding="utf-8") as file:
            file.write(
                f'\n[[object]]\nname = "{MARKER}"\nshape = "disc"\nsize = [{MARKER_M}, {MARKER_M}, 0.05]\n'
                f'position = [{east:.2f}, {north:.2f}, 0.02]\ntemperature = 300.0\nmaterial = "paint_black"\n'
                'colour = [44, 42, 40]\ntrack = "marker.csv"\n'
            )
        scene = load_scene(folder)
    haze = HAZES[(number // len(KINDS)) % len(HAZES)]
    return scene if haze is None else scene.with_air(_AIR, haze)


def _even_place(scene):
    """Return east and north of the flattest ground near the middle [m]."""
    ring = [(0.0, 0.0), *((_EVEN_M * np.sin(a), _EVEN_M * np.cos(a)) for a in np.linspace(0.0, 2.0 * np.pi, 9)[:-1])]
    steps = np.arange(-_AROUND_M, _AROUND_M + 1.0)
    places = [(float(east), float(north)) for east in steps for north in steps]
    uneven = [np.ptp([scene.ground(east + x, north + y) for x, y in ring]) for east, north in places]
    return places[int(np.argmin(uneven))]


def ground_around(scene, east, north):
    """Return the mean temperature of the terrain within `_EVEN_M` of a place [K]."""
    first = scene.surfaces[0]
    rows, columns = first.material.shape
    low, high = first.vertices.min(axis=0), first.vertices.max(axis=0)
    x = low[0] + (np.arange(columns) + 0.5) / columns * (high[0] - low[0])
    y = high[1] - (np.arange(rows) + 0.5) / rows * (high[1] - low[1])
    near = np.hypot(x[None] - east, y[:, None] - north) <= _EVEN_M
    return float(first.temperature[near].mean(dtype=np.float64))
