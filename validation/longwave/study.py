"""The sky's long-wave irradiance against pyrgeometers.

Modelled: as weather without a long-wave column models it, from air, vapour and the deficit of sunlight. The measured
column is withheld. Spectral: the sky that `Atmosphere` gets from the measured long-wave, integrated over the table's
wavelengths, with a black sky at air temperature beyond them. It should return what was measured.

Column: the flux that RRTMGP's g points give for the clear column of air that the weather near the ground shapes, on
rows with next to no cloud, beside what is modelled for a clear sky.
"""

from pathlib import Path

import numpy as np

from thermorender.atmosphere.from_weather import NearGround, from_weather
from thermorender.formats import write_text
from thermorender.physics import sky
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.scene.stages import air_in_weather
from thermorender.versions import versions
from thermorender.weather.complete import complete
from tools.rrtmgp import files
from tools.rrtmgp.fluxes import downward
from validation.heat.sites import measured, read_sites

SITES = tuple(Path(__file__).parents[1] / "heat" / name for name in ("sites.toml", "held_out.toml"))
HEADER = ("site", "part", "rows", "measured", "bias", "MAE", "RMS [W/m²]")
# Effective cloud below which a sky counts as clear, and elevation of the sun that parts day from night [deg].
_CLEAR, _EDGE_DEG = 0.2, 3.0
# Rows of a site whose spectral sky is integrated, and nodes of the integral over the cosine of the zenith angle.
_SKIES, _COSINES = 24, 6
# Effective cloud and sun's elevation [deg] of rows whose column is computed, and rows of a site by day and by night.
_NO_CLOUD, _HIGH_DEG, _COLUMNS = 0.05, 10.0, 30
_PARTS = ("all", "day, clear", "day, cloudy", "night, clear", "night, cloudy")


def run(sites, folders, progress=None, spread=map, gases=None):
    """Return the errors of the modelled and of the spectral sky at each site with a pyrgeometer, as plain numbers.

    Parameters
    ----------
    sites : sequence of path
        Files such as `validation/heat/sites.toml`.
    folders : sequence of path
        Folders of the tables; sites without a table, or without a long-wave column, are left out.
    progress : callable, optional
        Called with (step, share done).
    spread : callable
        (do, units) → do(unit) of each site, in order.
    gases : path, optional
        RRTMGP's file `rrtmgp-gas-lw-g256.nc`, for the flux of columns.

    Returns
    -------
    dict
        versions, missing (names of sites), and sites: {name: {title, modelled: {part: {rows, measured, bias, mae,
        rms}}, spectral: {"clear" or "clouded": {rows, bias, rms, limited}}, column: {"day" or "night": {rows, measured,
        bias, rms, modelled_bias, modelled_rms}}}} in W/m², column with `gases` only; `limited` is the share of rows
        whose long-wave is beyond what the clouds and the vapour of the air may be.
    """
    report = progress or (lambda step, share: None)
    declared = [(site, Path(folder).absolute(), gases) for path in sites for site in read_sites(path)
                for folder in folders if (Path(folder) / site.file).is_file()]  # fmt: skip
    result = {"versions": versions(), "sites": {}, "missing": []}
    for number, ((site, *_), found) in enumerate(zip(declared, spread(_of_site, declared), strict=True), 1):
        report(f"site {site.name}", number / len(declared))
        if found is None:
            result["missing"].append(site.name)
        else:
            result["sites"][site.name] = found
    return result


def _of_site(unit):
    """Return the errors at a (site, folder, gases), None where it has no pyrgeometer."""
    site, folder, gases = unit
    weather = measured(site, folder).weather
    # A sum of sunlight and long-wave is not a pyrgeometer.
    if site.radiation or any(note.startswith("Long-wave is missing") for note in weather.notes):
        return None
    found = {"title": site.title, "modelled": errors_of_model(weather), "spectral": errors_of_spectrum(weather)}
    return found | ({"column": errors_of_column(weather, files.read(gases))} if gases else {})


def withheld(weather):
    """Return the long-wave (N,) [W m⁻²] modelled for a Weather as if it had no long-wave, and the cloud it assumes."""
    height = np.maximum(np.sin(np.radians(weather.sun(weather.time)[1])), 0.0)
    given = {"air_k": weather.air_k, "vapour_pa": weather.vapour_pa, "pressure_pa": weather.pressure_pa,
             "global_w_m2": weather.direct_w_m2 * height + weather.diffuse_w_m2}  # fmt: skip
    place = (weather.latitude_deg, weather.longitude_deg, weather.altitude_m)
    modelled = complete(weather.time, place, given).longwave_w_m2
    black = STEFAN_BOLTZMANN * weather.air_k**4
    clear = sky.longwave(weather.air_k, weather.vapour_pa, 0.0)
    return modelled, (modelled - clear) / (sky.CLOUD_EMISSIVITY * (black - clear))


def errors_of_model(weather):
    """Return {part: {rows, measured, bias, mae, rms}} of the modelled long-wave [W m⁻²]."""
    modelled, cloud = withheld(weather)
    elevation, error = weather.sun(weather.time)[1], modelled - weather.longwave_w_m2
    day, night, clear = elevation > _EDGE_DEG, elevation < -_EDGE_DEG, cloud < _CLEAR
    rows = (np.full(len(error), True), day & clear, day & ~clear, night & clear, night & ~clear)
    found = {}
    for part, here in zip(_PARTS, rows, strict=True):
        if here.any():
            e = error[here]
            found[part] = {"rows": int(here.sum()), "measured": float(weather.longwave_w_m2[here].mean()),
                           "bias": float(e.mean()), "mae": float(np.abs(e).mean()),
                           "rms": float(np.sqrt((e**2).mean()))}  # fmt: skip
    return found


def spectral_longwave(air, altitude_m, air_k):
    """Return the irradiance [W m⁻²] of an Atmosphere's sky on level ground, black beyond its wavelengths."""
    cosine, weight = np.polynomial.legendre.leggauss(_COSINES)
    cosine = 0.5 * (cosine + 1.0)
    shown = np.pi * (weight * cosine) @ air.sky_radiance(np.full(_COSINES, altitude_m), cosine).sum(axis=-1)
    return float(shown + STEFAN_BOLTZMANN * air_k**4 - np.pi * air.planck(air_k).sum())


def errors_of_spectrum(weather):
    """Return {"clear" or "clouded": {rows, bias, rms, limited}} of the spectral sky on rows spread over the series."""
    rows = np.unique(np.linspace(0, len(weather.time) - 1, _SKIES).astype(int))
    found = {}
    for row in rows:
        air = air_in_weather(weather, weather.time[row])
        near, black = float(weather.longwave_w_m2[row]), STEFAN_BOLTZMANN * float(weather.air_k[row]) ** 4
        shown = spectral_longwave(air, weather.altitude_m, float(weather.air_k[row]))
        kind = "clouded" if air.cloud_fraction else "clear"
        limited = air.cloud_fraction >= 1.0 or near >= black
        found.setdefault(kind, []).append((shown - near, limited))
    return {
        kind: {
            "rows": len(each),
            "bias": float(np.mean([error for error, _ in each])),
            "rms": float(np.sqrt(np.mean([error**2 for error, _ in each]))),
            "limited": float(np.mean([limited for _, limited in each])),
        }
        for kind, each in found.items()
    }


def errors_of_column(weather, tables):
    """Return {"day" or "night": {rows, measured, bias, rms, modelled_bias, modelled_rms}} of clear columns [W m⁻²]."""
    _, cloud = withheld(weather)
    elevation, found = weather.sun(weather.time)[1], {}
    for part, here in (("day", elevation > _HIGH_DEG), ("night", elevation < -_EDGE_DEG)):
        chosen = np.flatnonzero((cloud < _NO_CLOUD) & here)
        if not chosen.size:
            continue
        chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _COLUMNS).astype(int))]
        measured = weather.longwave_w_m2[chosen]
        modelled = sky.longwave(weather.air_k[chosen], weather.vapour_pa[chosen], 0.0) - measured
        own = np.array([clear_flux(weather, row, tables) for row in chosen]) - measured
        found[part] = {"rows": len(chosen), "measured": float(measured.mean()), "bias": float(own.mean()),
                       "rms": float(np.sqrt((own**2).mean())), "modelled_bias": float(modelled.mean()),
                       "modelled_rms": float(np.sqrt((modelled**2).mean()))}  # fmt: skip
    return found


def clear_flux(weather, row, tables):
    """Return the downward flux [W m⁻²] of the clear column of air that the weather of a row shapes."""
    near = (float(weather.air_k[row]), float(weather.vapour_pa[row]), float(weather.pressure_pa[row]))
    longwave = float(sky.longwave(np.array(near[0]), np.array(near[1]), 0.0))
    made = from_weather(NearGround(*near, longwave), weather.latitude_deg, weather.altitude_m, weather.time[row],
                        cloud_fraction=0.0).column  # fmt: skip
    above = slice(int(np.searchsorted(made.altitude_m, max(weather.altitude_m, 0.0) - 1e-6)), None)
    mixing = {gas: share[above][::-1] / (1.0 + made.mixing["h2o"][above][::-1]) for gas, share in made.mixing.items()}
    layers = {gas: 0.5 * (share[1:] + share[:-1]) for gas, share in mixing.items()}
    return downward(tables, made.pressure_pa[above][::-1], made.temperature[above][::-1], layers)


def rows(result):
    """Return the rows of the table under HEADER."""
    found = []
    for name, site in result["sites"].items():
        for part, of in site["modelled"].items():
            found.append((name, part, str(of["rows"]), f"{of['measured']:.0f}", f"{of['bias']:+.1f}",
                          f"{of['mae']:.1f}", f"{of['rms']:.1f}"))  # fmt: skip
        for kind, of in site["spectral"].items():
            found.append((name, f"spectral, {kind}", str(of["rows"]), "", f"{of['bias']:+.1f}", "", f"{of['rms']:.1f}"))
        for part, of in site.get("column", {}).items():
            for kind, before in (("column", ""), ("modelled for the same rows", "modelled_")):
                found.append((name, f"{kind}, clear {part}", str(of["rows"]), f"{of['measured']:.0f}",
                              f"{of[before + 'bias']:+.1f}", "", f"{of[before + 'rms']:.1f}"))  # fmt: skip
    return found


def page(path, result):
    """Write the study as a Markdown page."""
    lines = [
        "# The sky's long-wave against pyrgeometers",
        "",
        "Errors [W/m²] of the long-wave that is modelled where the weather has none, minus the measurement. A sky is",
        "clear if the deficit of sunlight says less than 0.2 of cloud; at night the deficit is interpolated.",
        "",
        "Spectral: the camera's sky made from the measured long-wave, integrated over 7–14.5 µm and black beyond,",
        "minus the measurement, on rows spread over the series.",
        "",
        "Column: the flux by all of RRTMGP's g points of the clear column that the weather near the ground shapes.",
        "",
        "| " + " | ".join(HEADER) + " |",
        "|" + "---|" * len(HEADER),
        *("| " + " | ".join(row) + " |" for row in rows(result)),
    ]
    if result.get("earlier"):
        lines += ["", f"Of an earlier run, as the tables were not at hand: {', '.join(result['earlier'])}."]
    if result["missing"]:
        lines += ["", f"Without a pyrgeometer: {', '.join(result['missing'])}."]
    write_text(path, "\n".join(lines) + "\n")
