"""The heat balance and simpler methods with the same weather against measured surface temperatures.

Each site is simulated with properties from tables. For comparison: the same with one parameter fitted to the site,
which shows the effect of knowing it; force–restore as the synthetic scenes once used it; a sinusoid for each kind of
cover, as in SOLWEIG; and the air temperature.
"""

import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics import heat as force_restore
from thermorender.physics import sky
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.units import ZERO_CELSIUS_K
from validation.heat.sites import measured, modelled, read_sites

METHODS = ("balance", "one fitted", "force–restore", "sinusoid", "air")
HEADER = ("site", "method", "day bias", "MAE", "RMS [K]", "night bias", "MAE", "RMS [K]", "aim, MAE")
SITES = Path(__file__).with_name("sites.toml")
# Elevation of the sun above which it is day; night is below minus this [deg].
_EDGE_DEG = 3.0
_FACTORS = (0.25, 0.5, 2.0, 4.0)
# The fitted parameter by cover: conductivity of ground, moisture of leaves.
_FITTED = {"bare": "conductivity_w_m_k", "snow": "conductivity_w_m_k", "water": "roughness_m", "leaves": "wetness"}
# Absorptance, thermal inertia [J m⁻² K⁻¹ s^-½], exchange over that of a smooth plate, wetness.
_FORCE_RESTORE = {
    "grass_green": (0.77, 420.0, 1.7, 0.34), "grass_dry": (0.76, 330.0, 1.4, 0.10), "conifer": (0.89, 260.0, 3.6, 0.16),
    "heath_shrub": (0.86, 360.0, 2.1, 0.15), "soil_dark": (0.88, 1100.0, 1.0, 0.16),
    "soil_loam": (0.79, 1050.0, 1.0, 0.12), "soil_arid": (0.79, 1050.0, 1.0, 0.12),
    "granite_paving": (0.66, 1700.0, 1.0, 0.01), "asphalt": (0.91, 1300.0, 1.0, 0.0),
    "water": (0.92, 14000.0, 0.9, 0.9), "snow": (0.28, 550.0, 0.8, 0.5),
}  # fmt: skip
# Slope with the sun's highest elevation [K/deg], constant [K], hour of the maximum: SOLWEIG's classes cobble, asphalt,
# grass, bare soil and water, Lindberg, Onomura & Grimmond, Int. J. Biometeorol. 60 (2016) 1439, table 1.
_SINUSOID = {
    "granite_paving": (0.37, -3.41, 15.0), "asphalt": (0.58, -9.78, 15.0), "grass_green": (0.21, -3.38, 14.0),
    "soil_arid": (0.33, -3.01, 14.0), "water": (0.0, 0.0, 12.0),
}  # fmt: skip
# Covers without values of their own: force–restore takes those of the first, the sinusoid those of the second. For the
# sinusoid trees, shrubs and dry grass are grass, other ground is bare soil, and snow and ice follow the air. Roofs,
# walls and glass are asphalt.
_LIKE = {
    "conifer": ("conifer", "grass_green"), "grass_dry": ("grass_dry", "grass_green"),
    "heath_shrub": ("heath_shrub", "grass_green"), "broadleaf": ("conifer", "grass_green"),
    "soil_dark": ("soil_dark", "soil_arid"), "soil_loam": ("soil_loam", "soil_arid"), "snow": ("snow", "water"),
    "ice": ("snow", "water"), "roof_felt": ("asphalt", "asphalt"), "roof_tile_loft": ("asphalt", "asphalt"),
    "metal_painted": ("asphalt", "asphalt"), "brick_clay": ("asphalt", "asphalt"), "glass": ("asphalt", "asphalt"),
}  # fmt: skip
CONDITIONS = tuple(f"{part}, {kind}" for part in ("high sun", "low sun", "night") for kind in ("clear", "cloudy"))
# Sites, layers and time steps of the study of run time, and the settings that serve as truth.
_COST_SITES, _COST_LAYERS, _COST_STEPS_S = ("grass", "desert", "square"), (6, 8, 12, 16), (300.0, 900.0, 1800.0, 3600.0)
_FINE = {"layers": 24, "step_s": 60.0}


def run(sites, folder, progress=None, spread=map):
    """Return the scores of every method at every site, the time series, and error against run time, as a dict.

    Parameters
    ----------
    sites : path
        A file such as `validation/heat/sites.toml`.
    folder : path
        Folder of the measured tables; sites without a table are left out and named under "missing".
    progress : callable, optional
        Called with (step, share done).
    spread : callable
        (do, units) → do(unit) of each site, in order.
    """
    report = progress or (lambda step, share: None)
    declared = read_sites(sites)
    for site in declared:
        for name, _ in site.cover:
            if _like(name)[0] not in _FORCE_RESTORE or _like(name)[1] not in _SINUSOID:
                known = sorted({*_LIKE, *(each for each in _FORCE_RESTORE if each in _SINUSOID)})
                raise ThermorenderError(
                    f"{sites}, site {site.name!r}: cover={name!r} has no values for force–restore and the sinusoid; "
                    f"give a cover among {', '.join(known)}"
                )
    there = [site for site in declared if (Path(folder) / site.file).is_file()]
    result = {"sites": {}, "missing": [site.name for site in declared if site not in there]}
    for site, found in zip(there, spread(partial(_of_site, Path(folder).absolute()), there), strict=True):
        result["sites"][site.name] = found
        report(f"site {site.name}", len(result["sites"]) / len(there))
    chosen = [site for site in there if site.name in _COST_SITES]
    result["cost"] = _cost([measured(site, folder) for site in chosen], lambda share: report("run time", share))
    report("run time", 1.0)
    return result


def rows(result):
    """Return the rows of the table under HEADER."""
    found = []
    for name, site in result["sites"].items():
        for method, score in site["scores"].items():
            aim = site["aim_k"] if method == "balance" else None
            cells = [f"{score[part][key]:+.2f}" if key == "bias" else f"{score[part][key]:.2f}"
                     for part in ("day", "night") for key in ("bias", "mae", "rms")]  # fmt: skip
            cells = ["" if "nan" in cell else cell for cell in cells]
            found.append((name, method, *cells, "" if aim is None else f"{aim[0]:g} / {aim[1]:g}"))
    return found


def _of_site(folder, site):
    found = measured(site, folder)
    begin = time.perf_counter()
    own = modelled(found)
    seconds = time.perf_counter() - begin
    names = [name for name, _ in found.site.cover]
    # Long records take minutes; half-hour steps suffice to find the best factor. Nothing is fitted to held-out sites,
    # those without an aim.
    coarse = 1800.0 if len(own) > 3000 else None
    factors = _FACTORS if found.site.aim_k else ()
    fitted = min(
        ((own, 1.0), *((modelled(found, coarse, edit=_scaled(factor)), factor) for factor in factors)),
        key=lambda pair: _rms(found, pair[0]),
    )
    series = {
        "balance": own,
        **({"one fitted": fitted[0]} if factors else {}),
        "force–restore": _mixed(found, lambda name: _force_restored(found, name)),
        "sinusoid": _mixed(found, lambda name: _sinusoid(found, name)),
        "air": found.weather.air_k.copy(),
    }
    series = {name: _without_offset(found, values) for name, values in series.items()}
    return {
        "title": found.site.title, "cover": names, "aim_k": found.site.aim_k, "seconds": seconds,
        "start": "measured below the ground" if found.begin_k is not None else "first day repeated",
        "scored_from": str(found.weather.time[found.scored][0]), "scored": int(found.scored.sum()),
        "without_offset": found.site.without_offset,
        "fitted_factor": fitted[1] if factors else None, "notes": list(found.weather.notes),
        "scores": {name: scores_of(found, values) for name, values in series.items()},
        "where": where(found, series["balance"]),
        "series": {
            "time": [str(at) for at in found.weather.time], "measured": found.observed_k.tolist(),
            "elevation_deg": found.elevation_deg.tolist(),
            **{name: values.tolist() for name, values in series.items()},
        },
    }  # fmt: skip


def _scaled(factor):
    """Return a function that multiplies the fitted parameter of a material."""

    def edit(material):
        thermal = material.known_thermal()
        name = _FITTED[thermal.cover]
        value = getattr(thermal, name) * factor
        return replace(material, thermal=replace(thermal, **{name: min(value, 1.0) if name == "wetness" else value}))

    return edit


def _without_offset(found, values):
    return values - np.mean((values - found.observed_k)[found.scored]) if found.site.without_offset else values


def _rms(found, values):
    return float(np.sqrt(np.mean((_without_offset(found, values) - found.observed_k)[found.scored] ** 2)))


def scores_of(found, values):
    error, elevation = values - found.observed_k, found.elevation_deg
    parts = {"day": elevation > _EDGE_DEG, "night": elevation < -_EDGE_DEG}
    scores = {}
    for name, part in parts.items():
        here = error[part & found.scored]
        numbers = (here.mean(), np.abs(here).mean(), np.sqrt((here**2).mean())) if here.size else (np.nan,) * 3
        scores[name] = dict(zip(("bias", "mae", "rms"), map(float, numbers), strict=True))
    return scores


def where(found, values):
    """Return {condition: {rows, bias, mae}} of temperatures (N,) [K]: high and low sun and night, clear and cloudy.

    The sun is high above 0.7 of its highest elevation in the series. A sky is clear if its long-wave is that of less
    than 0.25 of cloud.
    """
    weather, elevation, error = found.weather, found.elevation_deg, values - found.observed_k
    black = STEFAN_BOLTZMANN * weather.air_k**4
    dark = sky.longwave(weather.air_k, weather.vapour_pa, 0.0)
    clear = weather.longwave_w_m2 < dark + 0.25 * sky.CLOUD_EMISSIVITY * (black - dark)
    high = elevation > max(0.7 * elevation.max(), _EDGE_DEG)
    parts = {"high sun": high, "low sun": (elevation > _EDGE_DEG) & ~high, "night": elevation < -_EDGE_DEG}
    found_parts = {}
    for part, rows in parts.items():
        for kind, of in (("clear", clear), ("cloudy", ~clear)):
            here = error[rows & of & found.scored]
            if here.size:
                found_parts[f"{part}, {kind}"] = {"rows": int(here.size), "bias": float(here.mean()),
                                                  "mae": float(np.abs(here).mean())}  # fmt: skip
    return found_parts


def _mixed(found, of):
    return sum(share * of(name) ** 4 for name, share in found.site.cover) ** 0.25


def _like(name):
    """Return the covers whose values force–restore and the sinusoid take for a cover."""
    kind = "snow" if name.startswith("snow") else name
    return _LIKE.get(kind, (kind, kind))


def _absorbed(found, absorptance):
    if found.absorbed is not None:
        return found.absorbed
    weather = found.weather
    sine = np.maximum(np.sin(np.radians(found.elevation_deg)), 0.0)
    return absorptance * (weather.direct_w_m2 * sine + weather.diffuse_w_m2)


def _force_restored(found, name):
    """Return surface temperature (N,) [K] by force–restore: h = 5.7 + 3.8 v, deep layer near the mean air."""
    absorptance, inertia, exchange, wet = _FORCE_RESTORE[_like(name)[0]]
    weather = found.weather
    second = (weather.time - weather.time[0]).astype(float)
    sun, deep = _absorbed(found, absorptance), weather.air_k.mean() + 1.5
    now, seen = np.array([weather.air_k[0]], np.float32), [weather.air_k[0]]
    single = lambda value: np.array([value], np.float32)  # noqa: E731
    for row in range(1, len(second)):
        h = exchange * (5.7 + 3.8 * weather.wind_m_s[row])
        now = force_restore.step(
            now, second[row] - second[row - 1], single(sun[row]), single(weather.longwave_w_m2[row]), single(h),
            single(wet), single(weather.air_k[row]), weather.vapour_pa[row], single(inertia), single(deep),
        )  # fmt: skip
        if _like(name)[0] == "snow":
            now = np.minimum(now, np.float32(ZERO_CELSIUS_K))
        seen.append(float(now[0]))
    return np.array(seen)


def _sinusoid(found, name):
    """Return surface temperature (N,) [K]: air temperature plus a sine over the day, reduced by clouds."""
    slope, constant, crest = _SINUSOID[_like(name)[1]]
    weather, elevation = found.weather, found.elevation_deg
    hour = (weather.time - weather.time.astype("datetime64[D]")).astype(float) / 3600.0
    hour = (hour + weather.longitude_deg / 15.0) % 24.0
    day = np.floor((weather.time - weather.time[0]).astype(float) / 86400.0).astype(int)
    added = np.zeros(len(hour))
    for number in np.unique(day):
        here = day == number
        up = here & (elevation > 0.0)
        if not up.any():
            continue
        rise = hour[up].min()
        swing = slope * elevation[here].max() + constant
        light = _absorbed(found, 1.0)[up]
        clear = np.clip(light / np.maximum(1100.0 * np.sin(np.radians(elevation[up])), 1.0), 0.0, 1.0)
        added[up] = swing * clear * np.sin(0.5 * np.pi * (hour[up] - rise) / max(crest - rise, 1.0))
    return weather.air_k + np.maximum(added, 0.0)


def _cost(sites, report):
    """Return error (RMS over sites) against run time: [{layers, step_s, seconds, error_k}]."""
    if not sites:
        return []
    fine = [modelled(found, **_FINE) for found in sites]
    found = []
    cases = [(layers, 900.0) for layers in _COST_LAYERS] + [(12, step) for step in _COST_STEPS_S if step != 900.0]
    for number, (layers, step_s) in enumerate(cases):
        report(number / len(cases))
        begin = time.perf_counter()
        runs = [modelled(site, step_s, layers) for site in sites]
        seconds = time.perf_counter() - begin
        square = np.mean([np.mean((own - best) ** 2) for own, best in zip(runs, fine, strict=True)])
        found.append({"layers": layers, "step_s": step_s, "seconds": seconds, "error_k": float(np.sqrt(square))})
    return found


def _beaten(result):
    """Sentences on the sites where a simpler method has a smaller mean absolute error than the balance."""
    for name, site in result["sites"].items():
        for part in ("day", "night"):
            own = site["scores"]["balance"][part]["mae"]
            # At night the sinusoid is the air temperature.
            for method in ("air", "force–restore", "sinusoid")[: 3 if part == "day" else 2]:
                other = site["scores"][method][part]["mae"]
                if other < own:
                    simple = {"air": "air temperature alone", "sinusoid": "a sinusoid"}.get(method, method)
                    yield f"{name} by {part}: {simple} has a smaller error, {other:.2f} K against {own:.2f} K."


def page(path, result):
    """Write the study as a Markdown page."""
    from thermorender.formats import write_text

    lines = ["# The heat balance against measured surface temperatures", ""]
    lines += ["Errors [K] of the model minus the measurement, by day (sun above 3°) and by night (below −3°).", ""]
    lines += ["| " + " | ".join(HEADER) + " |", "|" + "---|" * len(HEADER)]
    lines += ["| " + " | ".join(row) + " |" for row in rows(result)]
    lines += ["", *(f"- {sentence}" for sentence in _beaten(result))]
    lines += ["", "Bias / mean absolute error [K] of the balance by sun and sky, and the number of rows:", ""]
    lines += ["| site | " + " | ".join(CONDITIONS) + " |", "|---|" + "---|" * len(CONDITIONS)]
    for name, site in result["sites"].items():
        cells = [site["where"].get(condition) for condition in CONDITIONS]
        lines.append(f"| {name} | " + " | ".join(
            f"{c['bias']:+.1f} / {c['mae']:.1f} ({c['rows']})" if c else "" for c in cells) + " |")  # fmt: skip
    lines += ["", "| site | what | starts from | scored from | rows | notes |", "|---|---|---|---|---|---|"]
    for name, site in result["sites"].items():
        offset = " Its mean error is subtracted." if site["without_offset"] else ""
        lines.append(f"| {name} | {site['title']}: {', '.join(site['cover'])}.{offset} | {site['start']} | "
                     f"{site['scored_from']}Z | {site['scored']} | {' '.join(site['notes'])} |")  # fmt: skip
    lines += ["", "| layers | step [s] | run time of three sites [s] | error against 24 layers at 60 s [K] |"]
    lines += ["|---|---|---|---|"]
    lines += [f"| {c['layers']} | {c['step_s']:g} | {c['seconds']:.2f} | {c['error_k']:.3f} |" for c in result["cost"]]
    if result["missing"]:
        lines += ["", f"Left out, because their tables are missing: {', '.join(result['missing'])}."]
    write_text(path, "\n".join(lines) + "\n")
