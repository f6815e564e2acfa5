"""Procedural scenes: `make` generates a landscape from a seed, under a given weather.

The result declares relief, materials, hidden deviations from them, an orthophoto and a flight.
`thermorender.apps.lands.procedural.truth` solves its temperatures by the heat balance that every scene uses. Orthophoto
and temperature are both computed from the land, never one from the other.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender import units
from thermorender.apps.lands.procedural import heath, ridge, village
from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.deviations import deviations_of
from thermorender.apps.lands.procedural.light import incidence, normals, photograph, sky_view, sun_visibility
from thermorender.apps.lands.procedural.snow import lay_snow
from thermorender.apps.lands.procedural.solids import Solids
from thermorender.apps.lands.procedural.surroundings import Surroundings
from thermorender.apps.lands.procedural.weather import (
    LONGITUDE_DEG,
    balanced,
    conditions,
    drawn_weather,
    follows,
    sky_temperature,
    sun_of_photograph,
)
from thermorender.errors import ThermorenderError
from thermorender.physics.sun import position_at
from thermorender.scene.deviations import Deviations
from thermorender.scene.spec import WeatherSpec


class Kind(NamedTuple):
    """A kind of landscape: layout, default size and spacings [m], place, weather, title, flight heights [m]; in three
    dimensions its surroundings and their reach [m].
    """

    layout: Callable[[Canvas], tuple[list[dict[str, Any]], dict[str, NDArray[np.float64]]]]
    size_m: float
    texel_m: float
    post_m: float
    latitude_deg: float
    altitude_m: float
    weather: WeatherSpec
    title: str
    heights_m: tuple[float, float]
    around: Callable[[Surroundings], None]
    reach_m: float


KINDS = {
    "heath": Kind(
        heath.heath, 400.0, 0.25, 1.0, heath.LATITUDE_DEG, 112.0, heath.WEATHER,
        "Heath with sand, tracks, pine forest and fields", (30.0, 130.0), heath.around, 4000.0,
    ),
    "village": Kind(
        village.village, 320.0, 0.2, 0.5, village.LATITUDE_DEG, 134.0, village.WEATHER,
        "Village street with houses, gardens, a nursery and a pond", (30.0, 130.0), village.around, 4000.0,
    ),
    "ridge": Kind(
        ridge.ridge, 1600.0, 1.0, 4.0, ridge.LATITUDE_DEG, 1550.0, ridge.WEATHER,
        "Mountain ridge with rock, snow, alpine grass, spruces and a lake", (120.0, 500.0), ridge.around, 8000.0,
    ),
}  # fmt: skip

# Largest side of a raster [texels]; more exceeds an ordinary machine's memory during painting.
_MOST_TEXELS = 8000
# Largest side in multiples of the kind's default: trees and houses are placed one by one at any texel size.
_MOST_SIZES = 16


@dataclass(frozen=True)
class SyntheticScene:
    """A procedural scene before its temperatures are solved: rasters on one extent, row 0 in the north."""

    # kind, seed, title: Arguments of `make` and the kind's title
    kind: str
    seed: int
    title: str
    # size_m, texel_m, post_m: Sides of the square extent, a texel and an elevation cell [m]
    size_m: float
    texel_m: float
    post_m: float
    elevation: NDArray[np.float32]  # (P, P) float32 surface model [m above the ellipsoid]
    orthophoto: NDArray[np.uint8]  # (N, N, 3) uint8 sRGB
    classes: NDArray[np.uint8]  # (N, N) uint8 material of each texel; 0 means none and does not occur
    class_names: dict[int, str]  # Material of each value of `classes`
    deviations: Deviations  # Deviation of each texel from its material, known to the truth only
    weather: WeatherSpec  # A declared day, and the instant of the scene
    sky_temperature: float  # Temperature of a blackbody with the sky's radiance in a camera's band [K]
    # latitude_deg, longitude_deg: Centre [deg]
    latitude_deg: float
    longitude_deg: float
    epsg: int  # EPSG code of the map grid, a WGS 84 UTM zone
    corner: tuple[float, float]  # (2,) tuple map easting and northing of the north-west corner [m]
    sun: tuple[float, float]  # (2,) tuple azimuth and elevation of the sun in the orthophoto [deg]
    objects: tuple[dict[str, Any], ...]  # In the form of a scene file's [[object]] tables
    # Columns of the flight: time_s, east_m, north_m, above_ground_m, yaw_deg, gimbal_pitch_deg
    flight: dict[str, NDArray[np.float64]]


def weather_of(kind: str, weather_seed: int | None = None, **given: Any) -> WeatherSpec:
    """Return the WeatherSpec of a kind's default day, or one drawn from a seed, with the given keys replaced; None
    keeps a value. The land's altitude makes a drawn weather colder.
    """
    known = _kind(kind)
    if weather_seed is not None:
        _check_seed("weather_seed", weather_seed)
    weather = known.weather if weather_seed is None else drawn_weather(weather_seed, known.altitude_m)
    given = {key: value for key, value in given.items() if value is not None}
    if "time" in given:
        given["time"] = units.instant("time", given["time"])
    return replace(weather, **given)


def make(
    kind: str, seed: int = 0, size_m: float | None = None, texel_m: float | None = None, post_m: float | None = None,
    time: str | np.datetime64 | None = None, weather: WeatherSpec | None = None, again: int = 0,
) -> SyntheticScene:  # fmt: skip
    """Return a procedural scene; equal arguments give equal scenes. `texel_m` and `post_m` divide `size_m`, and post_m
    ≥ texel_m; with `again` above 0 the deviations are another draw for the same photograph.

    Land, materials and hidden fields depend on kind and seed only. The weather adds snow, changes the objects'
    temperatures and lights the orthophoto, which is taken at noon if the sun is below 10°; clouds soften shadows.
    """
    return scene_of(painted(kind, seed, size_m, texel_m, post_m, time, weather, again))


class Painted(NamedTuple):
    """A painted canvas with the arguments that it was painted by, checked and complete."""

    canvas: Canvas
    objects: list[dict[str, Any]]
    flight: dict[str, NDArray[np.float64]]
    deviations: Deviations
    kind: str
    seed: int
    size: float
    texel: float
    post: float
    weather: WeatherSpec


def painted(
    kind: str, seed: int, size_m: float | None, texel_m: float | None, post_m: float | None,
    time: str | np.datetime64 | None, weather: WeatherSpec | None, again: int = 0, solid: bool = False,
) -> Painted:  # fmt: skip
    """Return the Painted canvas of `make`; with `solid`, what stands on the ground is recorded and taken off it, and
    objects have temperatures that the heat balance solves.
    """
    known = _kind(kind)
    size = float(known.size_m if size_m is None else size_m)
    texel = float(known.texel_m if texel_m is None else texel_m)
    post = float(known.post_m if post_m is None else post_m)
    _check(seed, size, texel, post)
    if size > _MOST_SIZES * known.size_m:
        raise ThermorenderError(
            f"size_m={size:g} is more than the {_MOST_SIZES * known.size_m:g} m that a {kind} may have; give less"
        )
    weather = weather or known.weather
    if weather.air_high_c is None:
        raise ThermorenderError("the weather of a synthetic scene has no air_high_c; declare a day with it")
    if time is not None:
        weather = replace(weather, time=units.instant("time", time))
    # Invalid weather is refused before the slow generation of the landscape.
    now, usual = (_air_and_sun(day, known.latitude_deg, known.altitude_m) for day in (weather, known.weather))

    canvas = Canvas(seed, size, texel)
    if solid:
        canvas.solids = Solids(canvas)
    objects, flight = known.layout(canvas)
    if canvas.solids:
        canvas.solids.uncover()
    assert weather.air_low_c is not None  # `conditions` has refused a day without it
    lay_snow(canvas, weather.snow_depth_m or 0.0, weather.air_low_c)
    deviations = deviations_of(canvas, again)
    objects = balanced(objects) if solid else follows(objects, now, usual)
    return Painted(canvas, objects, flight, deviations, kind, seed, size, texel, post, weather)


def scene_of(made: Painted) -> SyntheticScene:
    """Return the SyntheticScene of a painted canvas, photographed from above."""
    canvas, objects, flight, deviations, kind, seed, size, texel, post, weather = made
    known = KINDS[kind]
    latitude = known.latitude_deg
    sun = sun_of_photograph(weather.time, latitude)
    surface = canvas.surface
    cosine = incidence(normals(surface + canvas.relief, texel, steepest=1.3), *sun)
    view = sky_view(surface, texel, reach_m=max(40.0, 0.25 * size))
    visible = sun_visibility(surface, texel, *sun)
    picture = photograph(canvas.albedo, visible, cosine, view, sun[1], seed, cloud=weather.cloud or 0.0)
    elevation = posts(surface, size, post)
    altitude = float(np.round(np.median(elevation)))
    return SyntheticScene(
        kind=kind, seed=int(seed), title=known.title, size_m=size, texel_m=texel, post_m=post, elevation=elevation,
        orthophoto=picture, classes=canvas.material, class_names=dict(canvas.names), deviations=deviations,
        weather=weather,
        sky_temperature=sky_temperature(weather, conditions(weather, latitude, altitude), altitude),
        latitude_deg=latitude, longitude_deg=LONGITUDE_DEG, epsg=32634, corner=_corner(latitude, LONGITUDE_DEG, size),
        sun=sun, objects=tuple(objects), flight=_flight_table(flight, elevation, size, post),
    )  # fmt: skip


def _kind(name: str) -> Kind:
    """Return the Kind of a name; refuse an unknown one."""
    if name not in KINDS:
        raise ThermorenderError(f"kind={name!r} is not a synthetic scene; choose one of {', '.join(KINDS)}")
    return KINDS[name]


def _air_and_sun(weather: WeatherSpec, latitude: float, altitude: float) -> tuple[float, float]:
    """Return (air temperature [K], sunlight on level ground [W m⁻²]) of a WeatherSpec at its instant."""
    found = conditions(weather, latitude, altitude)
    height = float(np.sin(np.radians(position_at(weather.time, latitude, LONGITUDE_DEG)[1])))
    return float(found.air_k), float(found.direct_w_m2 * max(height, 0.0) + found.diffuse_w_m2)


def _check(seed: int, size: float, texel: float, post: float) -> None:
    """Refuse a seed or sizes out of range, or sizes that do not divide each other."""
    _check_seed("seed", seed)
    for name, value in (("size_m", size), ("texel_m", texel), ("post_m", post)):
        if not (np.isfinite(value) and value > 0.0):
            raise ThermorenderError(f"{name}={value:g} must be a length in metres above 0")
    for name, value in (("texel_m", texel), ("post_m", post)):
        if abs(size / value - round(size / value)) > 1e-6:
            raise ThermorenderError(f"{name}={value:g} does not divide size_m={size:g}; choose lengths that do")
    if post < texel:
        raise ThermorenderError(
            f"post_m={post:g} is smaller than texel_m={texel:g}; an elevation cell holds at least one texel"
        )
    if not 64 <= round(size / texel) <= _MOST_TEXELS:
        raise ThermorenderError(
            f"size_m={size:g} at texel_m={texel:g} makes {round(size / texel)} texels a side; "
            f"64 to {_MOST_TEXELS} are allowed"
        )


def _check_seed(name: str, seed: int) -> None:
    if not 0 <= seed < 2**64 or int(seed) != seed:
        raise ThermorenderError(f"{name}={seed!r} must be a whole number of at least 0 and less than 2⁶⁴")


def posts(surface: NDArray[np.float32], size: float, post: float) -> NDArray[np.float32]:
    """Return the surface averaged over elevation cells, (P, P) float32 [m], on steps of 1/64 m."""
    import cv2

    count = round(size / post)
    mean = float(surface.mean())
    cells = cv2.resize(surface - np.float32(mean), (count, count), interpolation=cv2.INTER_AREA)
    # With steps of a power of two the last mantissa bits are zero, and the file compresses to half its size.
    return (np.round((cells.astype(np.float64) + mean) * 64.0) / 64.0).astype(np.float32)


def _corner(latitude: float, longitude: float, size: float) -> tuple[float, float]:
    """Return (easting, northing) [m] of the north-west corner of an extent centred on a whole metre."""
    from rasterio.warp import transform

    (east,), (north,) = transform("EPSG:4326", "EPSG:32634", [longitude], [latitude])
    return round(east) - 0.5 * size, round(north) + 0.5 * size


def _flight_table(
    flight: dict[str, NDArray[np.float64]], elevation: NDArray[np.float32], size: float, post: float
) -> dict[str, NDArray[np.float64]]:
    """Return the flight's columns, with heights above the surface model."""
    import cv2

    column = (flight["east_m"] + 0.5 * size) / post - 0.5
    row = (0.5 * size - flight["north_m"]) / post - 0.5
    below = cv2.remap(
        elevation, column.astype(np.float32)[None], row.astype(np.float32)[None], cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )[0]  # fmt: skip
    return {
        "time_s": flight["time_s"], "east_m": flight["east_m"], "north_m": flight["north_m"],
        "above_ground_m": flight["altitude_m"] - below, "yaw_deg": np.mod(flight["yaw_deg"], 360.0),
        "gimbal_pitch_deg": flight["gimbal_pitch_deg"],
    }  # fmt: skip
