"""Procedural scenes with known temperature: `make` grows one from a seed, `write` makes it a scene folder.

The true temperature comes from a surface energy balance (`procedural.heat`) on materials, relief, shadows and
moisture; the orthophoto is a photograph of the same land. Neither is computed from the other.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.synthetic.canvas import Canvas
from thermorender.synthetic.files import write_scene
from thermorender.synthetic.heat import surface_temperature
from thermorender.synthetic.heath import heath
from thermorender.synthetic.light import incidence, normals, photograph
from thermorender.synthetic.ridge import ridge
from thermorender.synthetic.village import village

# Kind: layout function, default size, texel and post spacing [m], and what it shows.
KINDS = {
    "heath": (heath, 400.0, 0.25, 1.0, "Heath with sand, tracks, pine forest and fields"),
    "village": (village, 320.0, 0.2, 0.5, "Village street with houses, gardens, a nursery and a pond"),
    "ridge": (ridge, 1600.0, 1.0, 4.0, "Mountain ridge with rock, snow, alpine grass, spruces and a lake"),
}

# Largest raster a scene may have: more does not fit an ordinary machine's memory while it is painted.
_MOST_TEXELS = 8000
# Largest side in terms of the kind's own: trees and houses are placed one by one, whatever the texel.
_MOST_SIZES = 16


@dataclass(frozen=True)
class SyntheticScene:
    """A procedural scene: rasters on one extent, row 0 in the north.

    Attributes
    ----------
    kind, seed, title : str, int, str
        What it was made from.
    size_m, texel_m, post_m : float
        Side of the square extent, of a texel and of an elevation cell [m].
    elevation : (P, P) float32
        Surface model [m above the ellipsoid].
    orthophoto : (N, N, 3) uint8
        sRGB.
    classes : (N, N) uint8
        Material of each texel; 0 stands for none and does not occur.
    class_names : dict of int to str
        Material of each value of `classes`.
    temperature : (N, N) float32
        True kinetic surface temperature [K].
    sky_temperature : float
        Of the blackbody sky under which the land warmed [K].
    latitude_deg, longitude_deg : float
        Of the centre [deg].
    epsg : int
        Code of the map grid, a WGS 84 UTM zone.
    corner : (2,) tuple of float
        Map easting and northing of the north-west corner [m].
    sun : (2,) tuple of float
        Azimuth and elevation of the sun [deg].
    objects : tuple of dict
        In the form of a scene file's [[object]] tables.
    flight : dict of str to (K,) float64
        Columns of the flight: time_s, east_m, north_m, above_ground_m, yaw_deg, gimbal_pitch_deg.
    """

    kind: str
    seed: int
    title: str
    size_m: float
    texel_m: float
    post_m: float
    elevation: np.ndarray
    orthophoto: np.ndarray
    classes: np.ndarray
    class_names: dict
    temperature: np.ndarray
    sky_temperature: float
    latitude_deg: float
    longitude_deg: float
    epsg: int
    corner: tuple
    sun: tuple
    objects: tuple
    flight: dict


def make(kind, seed=0, size_m=None, texel_m=None, post_m=None):
    """Return a procedural scene; the same arguments give the same scene.

    Parameters
    ----------
    kind : str
        One of `KINDS`.
    seed : int
        0 … 2⁶⁴−1; another seed makes another landscape.
    size_m : float, optional
        Side of the square extent [m]; the kind's own by default.
    texel_m, post_m : float, optional
        Side of an orthophoto texel and of an elevation cell [m]; both must divide the size, and a cell is not
        smaller than a texel.

    Raises
    ------
    ThermorenderError
        The kind is unknown, the seed or the size out of range, or the sizes do not fit each other.
    """
    if kind not in KINDS:
        raise ThermorenderError(f"kind={kind!r} is not a synthetic scene; choose one of {', '.join(KINDS)}")
    layout, default_size, default_texel, default_post, title = KINDS[kind]
    size = float(default_size if size_m is None else size_m)
    texel = float(default_texel if texel_m is None else texel_m)
    post = float(default_post if post_m is None else post_m)
    _check(seed, size, texel, post)
    if size > _MOST_SIZES * default_size:
        raise ThermorenderError(
            f"size_m={size:g} is more than the {_MOST_SIZES * default_size:g} m that a {kind} may have; give less"
        )

    canvas = Canvas(seed, size, texel)
    weather, objects, flight = layout(canvas)
    temperature, light = surface_temperature(
        canvas.surface,
        texel,
        canvas.material,
        canvas.names,
        weather,
        seed,
        wetness=canvas.wetness,
        interior=canvas.interior,
        # Grains and leaf tips share their heat with their neighbours; their light they do not.
        relief=0.6 * canvas.relief,
    )
    sun = weather.sun(weather.solar_hour)
    cosine = incidence(normals(canvas.surface + canvas.relief, texel, steepest=1.3), *sun)
    picture = photograph(canvas.albedo, light["visible"], cosine, light["view"], sun[1], seed)
    elevation = _posts(canvas.surface, size, post)
    longitude = 21.0  # the central meridian of zone 34: grid north is true north
    corner = _corner(weather.latitude_deg, longitude, size)
    return SyntheticScene(
        kind=kind,
        seed=int(seed),
        title=title,
        size_m=size,
        texel_m=texel,
        post_m=post,
        elevation=elevation,
        orthophoto=picture,
        classes=canvas.material,
        class_names=dict(canvas.names),
        temperature=temperature,
        sky_temperature=weather.sky_temperature,
        latitude_deg=weather.latitude_deg,
        longitude_deg=longitude,
        epsg=32634,
        corner=corner,
        sun=sun,
        objects=tuple(objects),
        flight=_flight_table(flight, elevation, size, post),
    )


def write(scene, directory, overwrite=False, temperature_every=2):
    """Return the folder written for a scene: rasters, scene.toml and flight.csv.

    The folder is built beside its path under a temporary name and then renamed, so it is never half there.

    Parameters
    ----------
    scene : SyntheticScene
    directory : path
        Folder to make.
    overwrite : bool
        Replace a folder that already holds something.
    temperature_every : int
        Orthophoto texels to a side of one texel of the stored temperature, which is their mean.

    Raises
    ------
    ThermorenderError
        The folder exists and is not empty, and `overwrite` is false, or `temperature_every` does not divide
        the grid.
    """
    return write_scene(scene, directory, overwrite, temperature_every)


def _check(seed, size, texel, post):
    """Refuse sizes that do not fit each other."""
    if not 0 <= seed < 2**64 or int(seed) != seed:
        raise ThermorenderError(f"seed={seed!r} must be a whole number of at least 0 and less than 2⁶⁴")
    for name, value in (("size_m", size), ("texel_m", texel), ("post_m", post)):
        if not (np.isfinite(value) and value > 0.0):
            raise ThermorenderError(f"{name}={value:g} must be a length in metres above 0")
    for name, value in (("texel_m", texel), ("post_m", post)):
        if abs(size / value - round(size / value)) > 1e-6:
            raise ThermorenderError(
                f"{name}={value:g} does not divide size_m={size:g}; choose lengths that do"
            )
    if post < texel:
        raise ThermorenderError(
            f"post_m={post:g} is smaller than texel_m={texel:g}; an elevation cell holds at least one texel"
        )
    if not 64 <= round(size / texel) <= _MOST_TEXELS:
        raise ThermorenderError(
            f"size_m={size:g} at texel_m={texel:g} makes {round(size / texel)} texels a side; "
            f"64 to {_MOST_TEXELS} are allowed"
        )


def _posts(surface, size, post):
    """Return the surface averaged over elevation cells, (P, P) float32 [m], on steps of 1/64 m."""
    import cv2

    count = round(size / post)
    mean = float(surface.mean())
    cells = cv2.resize(surface - np.float32(mean), (count, count), interpolation=cv2.INTER_AREA)
    # Steps of a power of two leave the float's last bits zero: the file compresses to half.
    return (np.round((cells.astype(np.float64) + mean) * 64.0) / 64.0).astype(np.float32)


def _corner(latitude, longitude, size):
    """Return (easting, northing) [m] of the north-west corner of an extent centred on a whole metre."""
    from rasterio.warp import transform

    (east,), (north,) = transform("EPSG:4326", "EPSG:32634", [longitude], [latitude])
    return round(east) - 0.5 * size, round(north) + 0.5 * size


def _flight_table(flight, elevation, size, post):
    """Return the flight's columns, its altitudes given above the surface model beneath it."""
    import cv2

    column = (flight["east_m"] + 0.5 * size) / post - 0.5
    row = (0.5 * size - flight["north_m"]) / post - 0.5
    below = cv2.remap(
        elevation,
        column.astype(np.float32)[None],
        row.astype(np.float32)[None],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )[0]
    return {
        "time_s": flight["time_s"],
        "east_m": flight["east_m"],
        "north_m": flight["north_m"],
        "above_ground_m": flight["altitude_m"] - below,
        "yaw_deg": np.mod(flight["yaw_deg"], 360.0),
        "gimbal_pitch_deg": flight["gimbal_pitch_deg"],
    }
