"""Stability of radiance: Planck's law and its inverse, light in cavities, terrain far from the origin."""

from dataclasses import replace
from itertools import product

import numpy as np

from tests.robustness.air import refused
from tests.robustness.cases import Found, case
from thermorender.defaults import BAND_UM
from thermorender.materials.material import grey
from thermorender.materials.mixture import mix
from thermorender.physics.band import emitted_radiance, kinetic_temperature, reflected_radiance
from thermorender.physics.planck import (
    C2,
    STEFAN_BOLTZMANN,
    band_radiance,
    band_radiance_derivative,
    brightness_temperature,
    spectral_radiance,
)

# Some ulp of radiance: the allowed error of its integral over the 64 terms of its sum.
ROUNDING = 64.0 * np.finfo(float).eps
# A line, the camera's band and nearly the whole spectrum [µm].
_WHOLE = (1e-3, 10.0), (10.0, 1e7)
_LAWS = [(kelvin, band) for kelvin in (2.0, 10.0, 100.0, 300.0, 3000.0, 1e4)
         for band in ((10.0, 10.000001), BAND_UM, (1e-3, 1e7))] + [(1.0, (1e-3, 1e7))]  # fmt: skip


def _kelvin(radiance):
    return float(brightness_temperature(radiance, *BAND_UM))


@case("light", "Planck's law and back, {0[0]:g} K, {0[1][0]:g} to {0[1][1]:.8g} µm", _LAWS)
def there_and_back(law):
    """An error of radiance δL/L gives T δL / (dL/dT); δL here is its rounding."""
    kelvin, band = law
    radiance = band_radiance(kelvin, *band)
    allowed = (np.spacing(radiance) + ROUNDING * radiance) / band_radiance_derivative(kelvin, *band)
    return Found(float(brightness_temperature(radiance, *band)), kelvin, float(allowed))


@case("light", "Planck's law and back, 1 K in the camera's band, whose radiance float64 does not hold")
def too_faint():
    """0, and inverted 0 K; the tolerance is the temperature of the smallest float."""
    return Found(brightness_temperature(band_radiance(1.0, *BAND_UM), *BAND_UM), 1.0, _kelvin(5e-324))


@case("light", "Planck's law and back, in single precision, {:g} K", (100.0, 300.0, 3000.0, 10000.0))
def single_precision(kelvin):
    """Half an ulp of radiance, 2⁻²⁴ of it."""
    radiance = band_radiance(kelvin, *BAND_UM)
    allowed = 2.0**-24 * radiance / band_radiance_derivative(kelvin, *BAND_UM)
    return Found(_kelvin(np.float32(radiance)), kelvin, float(allowed))


@case("light", "blackbody of a radiance of {:.0e} W m⁻² sr⁻¹, and back", (0.0, 1e-320, 1e-300, 1.0, 1e300))
def any_radiance(radiance):
    """Error of radiance, as kelvin. The tolerance is its ulp, 64 ulp of the inversion's logarithm, and that of e⁻ˣ.

    For 1e-320 that is 2000 ulp, and 400 of its e⁻ˣ.
    """
    kelvin = brightness_temperature(radiance, *BAND_UM)
    if not radiance:
        return Found(kelvin, 0.0, 0.0)
    slope = band_radiance_derivative(kelvin, *BAND_UM)
    least = np.spacing(0.0) / np.exp(-C2 / (BAND_UM[1] * kelvin))
    allowed = np.spacing(radiance) + (max(1.0, -np.log(radiance)) * ROUNDING + least) * radiance
    return Found(float((band_radiance(kelvin, *BAND_UM) - radiance) / slope), 0.0, float(allowed / slope))


@case("light", "a band of 1 pm against the line in its middle, {:g} K", (3.0, 300.0, 10000.0))
def line(kelvin):
    """Its radiance is the line's times its width: nothing cancels. With x = c₂/(λT), e⁻ˣ has x ulp error, and curves.

    The mean over a width w is off by (x w/λ)²/24.
    """
    band = 10.0, 10.0 + 1e-6
    middle, width = 0.5 * (band[0] + band[1]), band[1] - band[0]
    slope = band_radiance_derivative(kelvin, *band)
    x = max(5.0, C2 / (10.0 * kelvin))
    radiance = band_radiance(kelvin, *band)
    off = radiance - width * spectral_radiance(middle, kelvin)
    return Found(float(off / slope), 0.0, float((x * ROUNDING + (1e-7 * x) ** 2 / 24.0) * radiance / slope))


@case("light", "all wavelengths against Stefan and Boltzmann, {:g} K", (1.0, 10.0, 300.0, 10000.0))
def whole_spectrum(kelvin):
    """π L = σ T⁴, to a part in 10⁹: the light beyond 1 nm and 10 m."""
    total = sum(band_radiance(kelvin, *band) for band in _WHOLE)
    return Found(float((np.pi * total / STEFAN_BOLTZMANN) ** 0.25), kelvin, 0.25e-9 * kelvin)


@case("light", "slope over all wavelengths against Stefan and Boltzmann, {:g} K", (1.0, 300.0, 10000.0))
def whole_slope(kelvin):
    """π dL/dT = 4 σ T³, as the temperature that has this slope."""
    total = sum(band_radiance_derivative(kelvin, *band) for band in _WHOLE)
    return Found(float((np.pi * total / (4.0 * STEFAN_BOLTZMANN)) ** (1.0 / 3.0)), kelvin, 1e-9 / 3.0 * kelvin)


@case("light", "kinetic temperature behind a reflected sky, emissivity {:g}", (0.98, 0.5, 0.2))
def inversion(emissivity):
    """A grey surface of 300 K under a sky of 250 K; the table's inverse is accurate to 1 mK of radiance."""

    def same(wavelength_um):
        return np.full(np.shape(wavelength_um), emissivity)

    seen = emitted_radiance(same, 300.0, *BAND_UM) + reflected_radiance(same, 250.0, *BAND_UM)
    return Found(float(kinetic_temperature(seen, same, 250.0, BAND_UM, (200.0, 400.0))), 300.0, 1e-3 / emissivity)


@case("light", "level ground of 300 K under a sky of 255 K, emissivity {:g}", (0.0, 1e-6, 1e-3, 0.5, 1.0))
def plane(emissivity):
    """ε B(T) + (1 − ε) B(T_sky); the solver's tolerance is 1 mK; in single precision."""
    return _plane(grey("ground", emissivity), emissivity)


@case("light", "level ground of 300 K under a sky of 255 K, a quarter a mirror's emissivity of 0, the rest black")
def mixture():
    """A mix has its mean emissivity by area."""
    return _plane(mix([(grey("dark", 1.0), 0.75), (grey("bright", 0.0), 0.25)]), 0.75)


def _plane(material, emissivity):
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.budget.scenes import level
    from validation.made_scenes import in_memory

    ground = level(200.0, np.zeros((1, 1), int), np.full((1, 1), 300.0))
    scene = in_memory("plane", (ground,), (material,), sky=255.0, surroundings=280.0)
    image = Renderer(scene, rays=64, tolerance_mk=1.0, device="cpu").radiance(pose(0.0, 0.0, 30.0, pitch_deg=-90.0))
    black, sky = band_radiance(np.array([300.0, 255.0]), *BAND_UM)
    expected = emissivity * black + (1.0 - emissivity) * sky
    worst = image.flat[np.argmax(np.abs(image - expected))]
    return Found(_kelvin(float(worst)), _kelvin(expected), 1e-3)


@case("light", "closed cavity of 300 K, emissivity {:g}", (0.9, 0.1, 0.001, 1e-6))
def closed(emissivity):
    """A wall of any emissivity looks black; the solver's tolerance is 1 mK; 0.001 takes thousands of bounces."""
    from validation.cavity import measure

    return Found(300.0 + 1e-3 * measure("closed", 0.0, emissivity, 16, "cpu")["error_mk"], 300.0, 1e-3)


@case("light", "closed cavity of emissivity 0 is refused")
def closed_mirror():
    """The mirror's own temperature is not visible."""
    from validation.cavity import measure

    with np.errstate(invalid="ignore"):
        return refused(lambda: measure("closed", 0.0, 0.0, 16, "cpu"), "never leaves")


@case("light", "cavity with {0[0]:g} of its wall open to 250 K, emissivity {0[1]:g}",
      list(product((0.1, 1e-3), (0.9, 0.1, 0.001))))  # fmt: skip
def open_cavity(setting):
    """Closed form of the sphere; four standard errors of the open share s that the rays of all faces estimate.

    With emissivity ε and N rays s has an error of √(s(1−s)/N), the radiance its slope in s times that; plus 1 mK
    for the solver.
    """
    from validation.cavity import measure

    share, emissivity = setting
    found = measure("open", share, emissivity, 64, "cpu")["mean_mk"]
    black, sky = band_radiance(300.0, *BAND_UM), band_radiance(250.0, *BAND_UM)

    def wall(s):
        received = ((1 - s) * emissivity * black + s * sky) / (1 - (1 - emissivity) * (1 - s))
        return emissivity * black + (1 - emissivity) * received

    rays = 64 * 5120 * (1.0 - share)
    noise = 4.0 * np.sqrt(share * (1.0 - share) / rays) * abs(wall(1.005 * share) - wall(0.995 * share))
    noise /= 0.01 * share
    return Found(1e-3 * found, 0.0, float(noise / band_radiance_derivative(300.0, *BAND_UM)) + 1e-3)


@case("light", "cavity of 3000 K and emissivity 0.5, closed by a black wall of 100 K: {}", ("the wall", "the cavity"))
def fire_and_ice(which):
    """The wall is black and shows none of the cavity's light, a million times its own; the cavity loses that light.

    x = ((1−s) ε B₁ + s B₂) / (1 − (1−ε)(1−s)) of a sphere; four standard errors of s, and an ulp of single precision.
    """
    import trimesh

    from tests.robustness.geometry import mesh
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.made_scenes import in_memory

    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.invert()
    wall = ball.triangles_center[:, 2] < -0.8
    hot, cold = (
        replace(mesh(ball.vertices, ball.faces[part], kelvin=((kelvin,),), name=name),
                material=np.full((1, 1), number, np.uint8))
        for number, (name, part, kelvin) in enumerate((("cavity", ~wall, 3000.0), ("wall", wall, 100.0)))
    )  # fmt: skip
    scene = in_memory("fire", (hot, cold), (grey("cavity", 0.5), grey("wall", 1.0)), sky=250.0, surroundings=250.0)
    looks = pose(0.0, 0.0, 0.0, pitch_deg=-90.0 if which == "the wall" else 90.0)
    image = Renderer(scene, rays=64, tolerance_mk=1.0, device="cpu").radiance(looks)
    fire, ice = band_radiance(np.array([3000.0, 100.0]), *BAND_UM)
    if which == "the wall":
        allowed = 2.0**-23 * ice / band_radiance_derivative(100.0, *BAND_UM)
        return Found(_kelvin(float(image.max())), 100.0, float(allowed))
    share = float(ball.area_faces[wall].sum() / ball.area)

    def seen(s):
        return 0.5 * (fire + ((1.0 - s) * 0.5 * fire + s * ice) / (1.0 - 0.5 * (1.0 - s)))

    expected, noise = seen(share), 4.0 * np.sqrt(share * (1.0 - share) / (64 * 5120))
    allowed = _kelvin(expected) - _kelvin(seen(share + noise))
    return Found(_kelvin(image.mean(dtype=np.float64)), _kelvin(expected), allowed)


@case("light", "terrain {:g} km from the origin, straight down", (5.0, 50.0))
def far_away(kilometres):
    """Black ground compared with the same at the origin, RMS of a frame.

    Single precision moves camera and hits by an ulp each: two ulp over a texel, times the contrast of neighbours.
    """
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.made_scenes import terrain

    scene = terrain(20_000)
    black = tuple(grey(f"black {number}", 1.0) for number in range(len(scene.materials)))
    camera = replace(scene.camera, width=160, height=128, pixel_pitch_um=68.0, f_number=5.0)
    images = []
    for away in (0.0, 1e3 * kilometres):
        (surface,) = scene.surfaces
        moved = replace(surface, vertices=surface.vertices + np.array([away, away, 0.0]))
        here = scene.with_surfaces((moved,), black).with_camera(camera)
        image = Renderer(here, rays=64, device="cpu").radiance(pose(away, away, 120.0, pitch_deg=-90.0))
        images.append(image.astype(np.float64))
    error = np.sqrt(((images[1] - images[0]) ** 2).mean()) / band_radiance_derivative(300.0, *BAND_UM)
    contrast = np.sqrt((np.diff(surface.temperature.astype(np.float64), axis=1) ** 2).mean())
    shift = 2.0 * float(np.spacing(np.float32(1e3 * kilometres))) / surface.texel_m
    return Found(float(error), 0.0, float(shift * contrast))
