"""The air that follows the weather, made from the lowest level of a sounding alone, against the whole sounding.

The sky is compared in the camera's band, and a ground of 300 K seen from above. Beside it stands a standard atmosphere
that somebody might declare instead. The long-wave is modelled for a clear sky, so that no measurement helps.
"""

import re
from datetime import datetime
from functools import partial
from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.atmosphere.from_weather import NearGround, from_weather
from thermorender.atmosphere.model import Atmosphere
from thermorender.atmosphere.profile import from_profile, read_profile
from thermorender.errors import ThermorenderError
from thermorender.physics.humidity import saturation_pressure
from thermorender.physics.sky import longwave
from thermorender.versions import versions

GROUND_K, HEIGHTS_M = 300.0, (120.0, 1000.0, 3000.0)
DECLARED = "midlatitude-summer"
HEADER = ("sounding", "air [K]", "sky [K]", "weather", DECLARED, *(f"from {height:g} m" for height in HEIGHTS_M),
          *(f"{DECLARED}, {height:g} m" for height in HEIGHTS_M))  # fmt: skip
_TITLE = re.compile(r"([^<>\n]+?) Observations at (\d\d)Z (\d\d \w{3} \d{4})")
_LATITUDE = re.compile(r"Station latitude: *(-?[\d.]+)")


def run(files, band_um=defaults.BAND_UM, progress=None, spread=map):
    """Return the errors of the air of the weather at each sounding, as plain numbers.

    Parameters
    ----------
    files : sequence of path
        Soundings in the University of Wyoming's text format, with the heading and the station's latitude.
    band_um : (2,) floats
    progress : callable, optional
        Called with (step, share done).
    spread : callable
        (do, units) → do(unit) of each sounding, in order.

    Returns
    -------
    dict
        band_um, ground_k, declared, versions, and soundings: [{title, air_k, sky_k, weather: {sky_k, ground_k},
        declared: {sky_k, ground_k}}], errors against the whole sounding [K], ground_k by height.
    """
    report = progress or (lambda step, share: None)
    found = []
    for path, errors in zip(
        files, spread(partial(_errors, band_um), [Path(each).absolute() for each in files]), strict=True
    ):
        found.append(errors)
        report(path.name, len(found) / len(files))
    return {"band_um": list(band_um), "ground_k": GROUND_K, "heights_m": list(HEIGHTS_M), "declared": DECLARED,
            "versions": versions(), "soundings": found}  # fmt: skip


def _errors(band_um, path):
    text = path.read_text(encoding="utf-8", errors="replace")
    title, latitude = _TITLE.search(text), _LATITUDE.search(text)
    if not (title and latitude):
        raise ThermorenderError(
            f"{path}: no heading or station latitude; give a sounding in the University of Wyoming's text format"
        )
    time = np.datetime64(datetime.strptime(f"{title[3]} {title[2]}", "%d %b %Y %H"), "s")
    altitude, pressure, temperature, humidity = (each[0] for each in read_profile(path))
    vapour = float(humidity / 100.0 * saturation_pressure(np.float64(temperature)))
    near = NearGround(float(temperature), vapour, 100.0 * float(pressure),
                      float(longwave(np.float64(temperature), np.float64(vapour), 0.0)))  # fmt: skip
    true = from_profile(path).in_band(*band_um)
    weather = from_weather(near, float(latitude[1]), float(altitude), time).in_band(*band_um)
    declared = Atmosphere.standard(DECLARED).in_band(*band_um)
    sky, seen = true.sky_temperature(altitude), [_seen(true, altitude, height) for height in HEIGHTS_M]
    result = {"title": f"{title[1].strip()}, {title[2]}Z {title[3]}", "air_k": float(temperature), "sky_k": sky}
    for name, air in (("weather", weather), ("declared", declared)):
        ground = [_seen(air, altitude, height) - own for height, own in zip(HEIGHTS_M, seen, strict=True)]
        result[name] = {"sky_k": air.sky_temperature(altitude) - sky, "ground_k": ground}
    return result


def _seen(air, altitude_m, height_m):
    """Apparent temperature of the ground from a height above it [K]."""
    passed, added = air.path(altitude_m + height_m, altitude_m, height_m)
    kelvin = np.linspace(200.0, 340.0, 1401)
    return float(np.interp((air.planck(GROUND_K) * passed + added).sum(), air.planck(kelvin).sum(axis=-1), kelvin))


def rows(result):
    """Return a result of `run` as table rows of text under `HEADER`, the root mean squares last."""
    errors = [
        [each["weather"]["sky_k"], each["declared"]["sky_k"], *each["weather"]["ground_k"],
         *each["declared"]["ground_k"]]
        for each in result["soundings"]
    ]  # fmt: skip
    table = [
        (each["title"], f"{each['air_k']:.1f}", f"{each['sky_k']:.1f}", *(f"{value:+.2f}" for value in row))
        for each, row in zip(result["soundings"], errors, strict=True)
    ]
    square = np.sqrt(np.mean(np.square(errors), axis=0))
    return [*table, ("root mean square", "", "", *(f"{value:.2f}" for value in square))]
