"""Stability of air: none and far too much of it, paths of a millimetre and across a country, clouds and space."""

from dataclasses import replace
from functools import cache

import numpy as np

from tests.robustness.cases import Found, case
from thermorender.atmosphere.model import HIGHEST_CAMERA_M, Atmosphere
from thermorender.atmosphere.rays import EARTH_RADIUS_M, TOP_M, horizon_cos_zenith
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature

KELVIN, ROUNDING_K = 290.0, 1e-5
# Air of one temperature, and of one that falls to this at the top of its path.
_WALL_K, _COLD_K, _PATH_M = 310.0, 225.0, 1e4


@cache
def isothermal(kelvin=KELVIN):
    """Hazy tropical air of one temperature all the way up, in the camera's band."""
    air = Atmosphere.standard("tropical", "rural-5km").in_band(*BAND_UM)
    return replace(air, temperature=np.full_like(air.temperature, kelvin))


def even(absorption, top_k=KELVIN, scale_m=np.inf):
    """Grey air whose temperature changes linearly up to 10 km; of one density or an exponentially falling one [m⁻¹]."""
    levels = np.array([0.0, _PATH_M, TOP_M])
    return Atmosphere(
        lower_um=np.array([BAND_UM[0]]), upper_um=np.array([BAND_UM[1]]), weight=np.ones(1), tilt=np.zeros(1),
        altitude_m=levels, temperature=np.array([KELVIN, top_k, top_k]), density=np.exp(-levels / scale_m)[None],
        absorption=np.array([[absorption]]),
    )  # fmt: skip


def seen(air, wall_k, *path):
    """Apparent temperature of a black wall at the end of a path [K]."""
    transmittance, radiance = air.path(*path)
    return float(brightness_temperature((transmittance * air.planck(wall_k) + radiance).sum(), *BAND_UM))


def refused(job, words):
    """Found of a job that must be refused in a sentence with these words: 0 K, or NaN, which fails."""
    try:
        job()
    except ThermorenderError as error:
        return Found(0.0 if words in str(error) else np.nan, 0.0, 0.0)
    return Found(np.nan, 0.0, 0.0)


@case("air", "isothermal air before a wall as warm, path of {:g} m", (1e-3, 2.0, 100.0, 1e4, 1e5, 5e5))
def path(range_m):
    """τ B + L_path = B, level at 20 km. An ulp of single precision, 6e-8, times L over dL/dT, 70 K, is 4e-6 K."""
    return Found(seen(isothermal(), KELVIN, 2e4, 2e4, range_m), KELVIN, ROUNDING_K)


@case("air", "isothermal air, path {}", ("that grazes the ground, from 10 km to 10 km",
      "from the ground straight up to 30 km", "along the horizon of 2 m"))  # fmt: skip
def grazing(which):
    """As above: τ B + L_path = B; the first is 714 km long and touches sea level, as a chord of the Earth does."""
    reach = np.sqrt(1e4 * (2.0 * EARTH_RADIUS_M + 1e4))
    ends = {"that": (1e4, 1e4, 2.0 * reach), "from": (0.0, 3e4, 3e4),
            "along": (2.0, 0.0, np.sqrt(2.0 * (2.0 * EARTH_RADIUS_M + 2.0)))}  # fmt: skip
    return Found(seen(isothermal(), KELVIN, *ends[which.partition(" ")[0]]), KELVIN, ROUNDING_K)


@case("air", "black wall of 310 K through {:g} m of air of 290 K", (0.0, 1e-6))
def near(range_m):
    """There is no air between: the wall is seen as it is."""
    return Found(seen(isothermal(), _WALL_K, 1000.0, 1000.0, range_m), _WALL_K, ROUNDING_K)


@case("air", "black wall of 310 K behind even air of 290 K, optical depth {:g}",
      (0.0, 1e-12, 1e-9, 1e-3, 1.0, 30.0, 50.0, 1e4))  # fmt: skip
def depth(thick):
    """e^(−d) B(310 K) + (1 − e^(−d)) B(290 K), level over a kilometre."""
    wall, air = band_radiance(np.array([_WALL_K, KELVIN]), *BAND_UM)
    expected = brightness_temperature(np.exp(-thick) * wall - np.expm1(-thick) * air, *BAND_UM)
    return Found(seen(even(thick / 1e3), _WALL_K, 1000.0, 1000.0, 1e3), float(expected), ROUNDING_K)


@case("air", "air that cools by 6.5 K/km, seen from 9 km, optical depth {:g}", (0.0, 1e-6, 1.0, 100.0, 1e4))
def lapse(thick):
    """Black ground of 310 K. ∫ B(T(x)) d e^(−dx) dx by Gauss and Legendre over the first 40 mean free paths.

    The model's steps, with light as a parabola in each, may leave at most a millikelvin.
    """
    node, weight = np.polynomial.legendre.leggauss(200)
    end, camera_m = min(1.0, 40.0 / max(thick, 1.0)), 9e3
    x = 0.5 * end * (node + 1.0)
    warm = KELVIN - (KELVIN - _COLD_K) / _PATH_M * camera_m * (1.0 - x)
    air = band_radiance(warm, *BAND_UM) @ (thick * np.exp(-thick * x) * weight) * 0.5 * end
    expected = float(brightness_temperature(air + np.exp(-thick) * band_radiance(_WALL_K, *BAND_UM), *BAND_UM))
    return Found(seen(even(thick / camera_m, _COLD_K), _WALL_K, camera_m, 0.0, camera_m), expected, 1e-3)


@case("air", "isothermal sky and space as warm, from {:g} m, from the horizon to straight up", (0.0, 120.0, 1e4, 3e4))
def directions(at_m):
    """L_sky + τ B = B in every direction, including the horizon and directions next to level; the worst of nine."""
    air = isothermal()
    lowest = float(horizon_cos_zenith(at_m))
    cosine = np.array([lowest, 0.5 * lowest, -1e-9 if at_m else 0.0, 0.0, 1e-9, 1e-3, 0.1, 0.7, 1.0])
    total = air.sky_radiance(at_m, cosine) + air.sun_transmittance(at_m, cosine) * air.planck(KELVIN)
    kelvin = brightness_temperature(total.sum(axis=-1), *BAND_UM)
    return Found(float(kelvin[np.argmax(np.abs(kelvin - KELVIN))]), KELVIN, ROUNDING_K)


@case("air", "ground of 310 K under air of 290 K, straight down from {:g} km", (30.0, 100.0))
def above(camera_km):
    """An optical depth of 1 that falls by e in 2 km: the same from any height above. Depth to 1e-4 of it, of 20 K."""
    wall, air = band_radiance(np.array([_WALL_K, KELVIN]), *BAND_UM)
    expected = float(brightness_temperature(np.exp(-1.0) * wall + (1.0 - np.exp(-1.0)) * air, *BAND_UM))
    found = seen(even(1.0 / 2e3, scale_m=2e3), _WALL_K, 1e3 * camera_km, 0.0, 1e3 * camera_km)
    return Found(found, expected, 1e-4 * np.exp(-1.0) * (_WALL_K - KELVIN))


@case("air", "camera above the air's range is refused")
def space():
    """Refused, not answered with an empty sky."""
    return refused(lambda: isothermal().sky_radiance(HIGHEST_CAMERA_M + 1.0, 1.0), "out of range")


@case("air", "sky a millimetre below a closed cloud")
def below_cloud():
    """The base is black and fills every direction; a millimetre of lapse is 7e-6 K."""
    air = Atmosphere.standard("tropical").in_band(*BAND_UM).clouded(1.0, 2500.0)
    base = float(air.air_temperature(2500.0))
    kelvin = brightness_temperature(air.sky_radiance(2500.0 - 1e-3, [0.0, 0.01, 1.0]).sum(axis=-1), *BAND_UM)
    return Found(float(kelvin[np.argmax(np.abs(kelvin - base))]), base, ROUNDING_K)


@case("air", "{} a cloud is refused", ("camera within", "ground behind"))
def in_cloud(which):
    """Refused: neither clear air nor a guess."""
    air = isothermal().clouded(0.5, 1000.0)
    ends = (1000.1, 0.0) if which == "camera within" else (0.0, 1500.0)
    return refused(lambda: air.path(*ends, 2000.0), "above the cloud base")


@case("air", "mirror facing a mirror 10 m away, all of 290 K, in air of depth {:g} per metre", (1e-3, 0.1, 10.0))
def mirrors(absorption):
    """In an isothermal enclosure with deep air as sky, mirrors look black too; 1 mK and the stated error."""
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.budget.scenes import box, level
    from validation.made_scenes import in_memory

    floor = level(100.0, np.zeros((1, 1), int), np.full((1, 1), KELVIN))
    roof = box("roof", (0.0, 0.0), (100.0, 100.0, 1.0), KELVIN)
    roof = replace(roof, vertices=roof.vertices + np.array([0.0, 0.0, 10.0]))
    gold = load_library()["gold_polished"]
    scene = in_memory("mirrors", (floor, roof), (gold, gold), surroundings=KELVIN, terrain_count=1)
    scene = scene.with_air(even(absorption))
    renderer = Renderer(scene, rays=64, device="cpu")
    kelvin = brightness_temperature(renderer.radiance(pose(0.0, 0.0, 5.0, pitch_deg=-80.0)), *BAND_UM)
    spectrum, worst = renderer.plan.spectrum, float(kelvin.flat[np.argmax(np.abs(kelvin - KELVIN))])
    stated = renderer.plan.specular.error_mk + spectrum.channels_mk
    slope = float(band_radiance_derivative(300.0, *BAND_UM) / band_radiance_derivative(KELVIN, *BAND_UM))
    return Found(worst, KELVIN, 1e-3 * (1.0 + slope * stated))
