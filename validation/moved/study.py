"""Maps trained at 14 h and used at other hours and weathers: moved, unmoved, offset, and the heat balance alone.

The scenes are procedural. The truth is a heat balance, too, but with other inputs than the prediction. For each scene
it draws every property of each material from its table's uncertainty, again with half the uncertainty for each of a few
patches of a class, a reflectance for each texel, and errors of wind, air and longwave. The prediction has the tables
and the declared weather.

There are two maps. One is a good thermal picture: the truth at 14 h, blurred by a texel, with errors of 1 K in patches
of 8 texels and of 0.5 K per texel. The other is a 9-to-1 correlation with an intercept, fitted by least squares to the
truth of another scene of the same kind at the same instant.
"""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.lands.procedural.truth import write
from thermorender.errors import ThermorenderError
from thermorender.materials.material import Material
from thermorender.materials.shifted import strayed
from thermorender.render.geometry import Geometry
from thermorender.render.heat.moved import Carried, balances, expected
from thermorender.render.heat.simulation import solved
from thermorender.render.variant import activate
from thermorender.scene.load import load_scene
from thermorender.scene.spec import TemperatureSpec, WeatherSpec
from thermorender.scene.surface import FILLED, UNMOVED

# Kinds with the sides of the terrain, of a texel and of a height post [m].
SIZES = dict(zip(defaults.SCENES, ((64.0, 0.5, 2.0), (64.0, 0.5, 1.0), (256.0, 2.0, 8.0)), strict=True))
_SUMMER = {"air_low_c": 11.0, "air_high_c": 23.0, "humidity": 0.7, "wind_m_s": 3.0, "cloud": 0.1}
_SPRING = {"air_low_c": 1.0, "air_high_c": 11.0, "humidity": 0.8, "wind_m_s": 4.0, "cloud": 0.3}
_OVERCAST = {"air_low_c": 13.0, "air_high_c": 18.0, "humidity": 0.85, "wind_m_s": 5.0, "cloud": 1.0}
# Name: (date, hour of mean solar time, weather).
TRAINED = ("2018-07-15", 14.0, _SUMMER)
CASES = {
    "14 h": TRAINED,
    "15 h": ("2018-07-15", 15.0, _SUMMER),
    "10 h": ("2018-07-15", 10.0, _SUMMER),
    "18 h": ("2018-07-15", 18.0, _SUMMER),
    "2 h": ("2018-07-15", 2.0, _SUMMER),
    "next day, 14 h": ("2018-07-16", 14.0, _SUMMER),
    "spring, 13 h": ("2018-04-05", 13.0, _SPRING),
    "overcast, 14 h": ("2018-07-20", 14.0, _OVERCAST),
}
MAPS = ("picture", "9-to-1")
METHODS = ("moved", "unmoved", "offset", "balance")
HEADER = ("map", "used at", *(f"{name} [K]" for name in METHODS), "stated [K]", "within 1σ", "within 2σ", "unmoved")
# Standard deviations of the truth in addition to those of its materials.
_PATCHES, _PATCH_TEXELS = 4, 12.0
_REFLECTANCE, _WIND, _AIR_K, _LONGWAVE_W_M2 = 0.1, 0.15, 0.3, 8.0
_BLUR, _ERROR_PATCH_TEXELS, _ERROR_K, _NOISE_K = 1.0, 8.0, 1.0, 0.5


def run(kinds=tuple(SIZES), seeds=(301,), cases=None, progress=None, device="auto", sizes=None):
    """Return the mean absolute errors of METHODS and the coverage of the stated uncertainty as a dict, per map and
    case, over all scenes and for each.

    Parameters
    ----------
    kinds : sequence of str
    seeds : sequence of int
        Seeds of the scenes; the 9-to-1 map is fitted on the scene of the next seed.
    cases : sequence of str, optional
        Some of CASES; all by default.
    progress : callable, optional
        Called with (step, share done).
    device : {"auto", "cpu", "cuda"}
    sizes : dict, optional
        Replaces SIZES.

    Raises
    ------
    ThermorenderError
        An unknown kind or case.
    """
    cases = tuple(CASES if cases is None else cases)
    for name, given, known in (("kind", kinds, SIZES), ("case", cases, CASES)):
        for one in given:
            if one not in known:
                raise ThermorenderError(f"{name}={one!r} is not part of this study; give one of {', '.join(known)}")
    mi = activate(device)
    report = progress or (lambda step, share: None)
    scenes, sums = {}, {}
    jobs = [(kind, seed) for seed in seeds for kind in kinds]
    for number, (kind, seed) in enumerate(jobs):
        own = lambda share, n=number: report("moving maps of procedural scenes", (n + share) / len(jobs))  # noqa: E731
        found = _scene_errors(mi, kind, seed, cases, (sizes or SIZES)[kind], own)
        scenes[f"{kind} {seed}"] = {key: _summary(values) for key, values in found.items()}
        for key, values in found.items():
            sums[key] = [*sums.get(key, []), values]
    every = {key: _summary({k: np.concatenate([v[k] for v in values]) for k in values[0]})
             for key, values in sums.items()}  # fmt: skip
    return {"trained": TRAINED, "cases": {name: CASES[name] for name in cases}, "seeds": list(seeds), "all": every,
            "scenes": scenes}  # fmt: skip


def rows(result):
    """Return the comparison over all scenes as table rows of text under HEADER."""
    return [
        (*key.split(": "), *(f"{one['mae_k'][name]:.2f}" for name in METHODS), f"{one['stated_k']:.2f}",
         f"{one['within_1_sigma']:.0%}", f"{one['within_2_sigma']:.0%}", f"{one['share_unmoved']:.1%}")
        for key, one in result["all"].items()
    ]  # fmt: skip


def _scene_errors(mi, kind, seed, cases, size, report):
    """Return {"map: case": {method: errors, "std": …, "unmoved": …}} over the texels of a scene."""
    scene = _loaded(kind, seed, size)
    geometry = Geometry(mi, scene.surfaces)
    rng = np.random.default_rng([seed, 7])
    hidden = _Hidden(scene, rng)
    days = {}
    for name in cases:
        days.setdefault((CASES[name][0], str(CASES[name][2])), []).append(name)
    at = {name: _instant(scene, CASES[name]) for name in cases}
    there = _asked(scene, TRAINED)
    steps, done = 2 * len(days) + 4, 0
    before = expected(there, [there.time], geometry)[0]
    own_truth = hidden.solved([there.time], there, geometry)[0]
    maps = {"picture": _picture(own_truth, rng), "9-to-1": _nine(mi, kind, seed + 1, size, scene)}
    found = {}
    for names in days.values():
        here = _asked(scene, CASES[names[0]])
        times = [at[name] for name in names]
        truths = hidden.solved(times, here, geometry)
        after = expected(here, times, geometry)
        done += 2
        report((4 + done) / steps)
        for key, (kelvin, error_k) in maps.items():
            spec = TemperatureSpec(source="raster", trained=there.spec.weather, map_error_k=error_k)
            mapped = here.with_temperature(spec, kelvin=(kelvin,))
            base, trained = balances(mapped)
            carried = Carried(mapped, trained, base, before)
            for name, truth, expects in zip(names, truths, after, strict=True):
                found[f"{key}: {name}"] = _errors(carried.to(at[name], expects), truth, kelvin, before, expects, scene)
    return {f"{key}: {name}": found[f"{key}: {name}"] for key in MAPS for name in cases}


def _errors(moved, truth, kelvin, before, expects, scene):
    known = (scene.surfaces[0].flags & FILLED) == 0
    surface, expected_k = moved.scene.surfaces[0], expects.kelvin.reshape(truth.shape)
    shift = float((expects.kelvin - before.kelvin).mean(dtype=np.float64))
    guesses = {"moved": surface.temperature, "unmoved": kelvin, "offset": kelvin + shift, "balance": expected_k}
    errors = {name: (guess - truth)[known] for name, guess in guesses.items()}
    return errors | {"std": moved.std_k[0][known], "unmoved_share": (surface.flags[known] & UNMOVED) > 0}


def _summary(values):
    away = np.abs(values["moved"]) / np.maximum(values["std"], 1e-6)
    return {
        "texels": int(away.size),
        "mae_k": {name: round(float(np.abs(values[name]).mean(dtype=np.float64)), 3) for name in METHODS},
        "bias_k": {name: round(float(values[name].mean(dtype=np.float64)), 3) for name in METHODS},
        "stated_k": round(float(values["std"].mean(dtype=np.float64)), 3),
        "within_1_sigma": round(float((away <= 1.0).mean()), 4),
        "within_2_sigma": round(float((away <= 2.0).mean()), 4),
        "share_unmoved": round(float(values["unmoved_share"].mean()), 4),
    }


def _loaded(kind, seed, size):
    with tempfile.TemporaryDirectory() as folder:
        return load_scene(write(make(kind, seed, *size), Path(folder) / f"{kind}_{seed}"))


def _instant(scene, case):
    date, hour, _ = case
    east_h = scene.frame.longitude_deg / 15.0
    return np.datetime64(f"{date}T00:00:00", "s") + np.timedelta64(round(3600.0 * (hour - east_h)), "s")


def _asked(scene, case):
    """Return the scene with the heat balance of a case."""
    weather = WeatherSpec(time=_instant(scene, case), **case[2])
    return scene.with_weather(weather).with_temperature("balance")


class _Hidden:
    """The truth of a scene: drawn materials in patches, a reflectance of each texel, and weather with errors."""

    def __init__(self, scene, rng):
        surface = scene.surfaces[0]
        shape = surface.material.shape
        field = _smooth(rng, shape, _PATCH_TEXELS)
        patch = np.searchsorted(np.quantile(field, np.arange(1, _PATCHES) / _PATCHES), field)
        classes = [_drawn(material, rng, 1.0) for material in scene.materials]
        self.materials = tuple(_drawn(one, rng, 0.5) for one in classes for _ in range(_PATCHES))
        self.material = (surface.material.astype(np.int64) * _PATCHES + patch).astype(np.uint8)
        light = np.exp(_REFLECTANCE * _smooth(rng, shape, 2.0))
        # `brightness` derives the reflectance of texels within a class from their colour.
        grey = 255.0 * np.clip(0.2 * light, 0.0, 1.0) ** (1.0 / 2.2)
        self.colour = np.repeat(np.round(grey).astype(np.uint8)[..., None], 3, axis=2)
        self.wind, self.air_k, self.longwave = np.exp(_WIND * rng.normal()), _AIR_K * rng.normal(), rng.normal()

    def solved(self, times, here, geometry):
        """Return true temperatures at some instants [K], a list of (h, w) float32, under the weather of `here`."""
        surface = replace(here.surfaces[0], material=self.material, colour=self.colour)
        others = tuple(replace(s, material=(s.material * _PATCHES).astype(np.uint8)) for s in here.surfaces[1:])
        made = here.with_temperature(TemperatureSpec(source="balance", brightness=True))
        made, weather = made.with_surfaces((surface, *others), self.materials), here.weather
        made = made.with_weather(replace(
            weather, wind_m_s=weather.wind_m_s * self.wind, air_k=weather.air_k + self.air_k,
            longwave_w_m2=weather.longwave_w_m2 + _LONGWAVE_W_M2 * self.longwave,
        ))  # fmt: skip
        return [each.surfaces[0].temperature for each in solved(made, times, geometry)]


def _drawn(material: Material, rng, scale):
    """Return a material with properties drawn from `scale` times their uncertainties."""
    absorptance = material.solar_absorptance + scale * material.solar_uncertainty * rng.normal()
    return replace(
        material,
        solar_absorptance=float(np.clip(absorptance, 0.05, 0.97)),
        thermal=material.thermal and _drawn_thermal(material.thermal, rng, scale),
    )


def _drawn_thermal(thermal, rng, scale):
    below = thermal.below and _drawn_thermal(thermal.below, rng, scale)
    return replace(strayed(thermal, rng, scale), below=below)


def _picture(truth, rng):
    """Return (kelvin (h, w) float32, its RMS error [K]) of a thermal picture of the truth."""
    import cv2

    blurred = cv2.GaussianBlur(truth, (0, 0), _BLUR)
    patches = _ERROR_K * _smooth(rng, truth.shape, _ERROR_PATCH_TEXELS)
    kelvin = blurred + patches + _NOISE_K * rng.normal(size=truth.shape)
    return kelvin.astype(np.float32), float(np.sqrt(np.mean((kelvin - truth) ** 2)))


def _nine(mi, kind, seed, size, scene):
    """Return (kelvin (h, w) float32, its error [K]) of a 9-to-1 map fitted to the truth of another scene."""
    other = _loaded(kind, seed, size)
    there = _asked(other, TRAINED)
    hidden = _Hidden(other, np.random.default_rng([seed, 7]))
    truth = hidden.solved([there.time], there, Geometry(mi, other.surfaces))[0]
    inputs = _neighbourhoods(other.surfaces[0].colour)
    weights, *_ = np.linalg.lstsq(inputs, truth.ravel().astype(np.float64), rcond=None)
    error = float(np.std(inputs @ weights - truth.ravel()))
    shape = scene.surfaces[0].material.shape
    return (_neighbourhoods(scene.surfaces[0].colour) @ weights).reshape(shape).astype(np.float32), error


def _neighbourhoods(colour):
    """Return 3 × 3 × RGB around each texel, and 1, (h·w, 28) float64."""
    padded = np.pad(colour.astype(np.float64) / 255.0, ((1, 1), (1, 1), (0, 0)), mode="edge")
    h, w, _ = colour.shape
    parts = [padded[i : i + h, j : j + w].reshape(-1, 3) for i in range(3) for j in range(3)]
    return np.column_stack([*parts, np.ones(h * w)])


def _smooth(rng, shape, texels):
    """Return a normal field (h, w) of unit variance that is smooth over `texels` texels."""
    import cv2

    field = cv2.GaussianBlur(rng.normal(size=shape), (0, 0), texels, borderType=cv2.BORDER_REFLECT)
    return (field - field.mean()) / field.std()
