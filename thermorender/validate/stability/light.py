"""Stability of radiance: Planck's law and its inverse, light in cavities, terrain far from the origin."""

from dataclasses import replace

import numpy as np

from thermorender.materials.library import grey
from thermorender.physics.band import emitted_radiance
from thermorender.physics.planck import band_radiance, band_radiance_derivative, brightness_temperature
from thermorender.physics.surface import kinetic_temperature, reflected_radiance
from thermorender.validate.stability.cases import Found, case

BAND = (7.5, 13.5)
# Some ulp of radiance: what its integral may err by in the 64 terms of its sum.
ROUNDING = 64.0 * np.finfo(float).eps


@case("light", "Planck's law and back, {:g} K", (2.0, 10.0, 100.0, 300.0, 3000.0, 10000.0))
def there_and_back(kelvin):
    """An error of radiance δL/L is one of T δL / (dL/dT), here for its rounding."""
    radiance = band_radiance(kelvin, *BAND)
    allowed = ROUNDING * radiance / band_radiance_derivative(kelvin, *BAND)
    return Found(float(brightness_temperature(radiance, *BAND)), kelvin, float(allowed))


@case("light", "all wavelengths against Stefan and Boltzmann, {:g} K", (10.0, 300.0, 10000.0))
def whole_spectrum(kelvin):
    """π L = σ T⁴, to a part in 10⁹: what lies beyond 1 nm and 10 m."""
    total = sum(band_radiance(kelvin, *band) for band in ((1e-3, 10.0), (10.0, 1e7)))
    return Found(float((np.pi * total / 5.670374419e-8) ** 0.25), kelvin, 0.25e-9 * kelvin)


@case("light", "kinetic temperature behind a reflected sky, emissivity {:g}", (0.98, 0.5, 0.2))
def inversion(emissivity):
    """A grey surface of 300 K under a sky of 250 K; the table's inverse is held to 1 mK of radiance."""

    def same(wavelength_um):
        return np.full(np.shape(wavelength_um), emissivity)

    seen = emitted_radiance(same, 300.0, *BAND) + reflected_radiance(same, 250.0, *BAND)
    return Found(float(kinetic_temperature(seen, same, 250.0, BAND, (200.0, 400.0))), 300.0, 1e-3 / emissivity)


@case("light", "closed cavity of 300 K, emissivity {:g}", (0.9, 0.1, 0.001))
def closed(emissivity):
    """A wall of any emissivity looks black; the solver is asked for 1 mK, where 0.001 needs thousands of bounces."""
    from thermorender.validate.cavity import measure

    return Found(300.0 + 1e-3 * measure("closed", 0.0, emissivity, 16, "cpu")["error_mk"], 300.0, 1e-3)


@case("light", "cavity with a tenth open to 250 K, emissivity {:g}", (0.9, 0.1, 0.001))
def open_cavity(emissivity):
    """Closed form of the sphere; four standard errors of the share s of 0.1 that the rays of all faces see open.

    With emissivity ε and N rays s errs by √(s(1−s)/N), the radiance by its slope in s times that; a millikelvin more
    for the solver.
    """
    from thermorender.validate.cavity import measure

    found = measure("open", 0.1, emissivity, 64, "cpu")["mean_mk"]
    black, sky = band_radiance(300.0, *BAND), band_radiance(250.0, *BAND)

    def wall(s):
        received = ((1 - s) * emissivity * black + s * sky) / (1 - (1 - emissivity) * (1 - s))
        return emissivity * black + (1 - emissivity) * received

    rays = 64 * 5120 * 0.9
    noise = 4.0 * np.sqrt(0.1 * 0.9 / rays) * abs(wall(0.1005) - wall(0.0995)) / 1e-3
    return Found(1e-3 * found, 0.0, float(noise / band_radiance_derivative(300.0, *BAND)) + 1e-3)


@case("light", "terrain {:g} km from the origin, straight down", (5.0, 50.0))
def far_away(kilometres):
    """Black ground beside the same at the origin, RMS of a frame.

    Single precision moves camera and hits by an ulp each: two of them over a texel, times the contrast of neighbours.
    """
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from thermorender.validate.bench import terrain

    scene = terrain(20_000)
    black = tuple(grey(f"black {number}", 1.0) for number in range(len(scene.materials)))
    camera = replace(scene.camera, width=160, height=128, pixel_pitch_um=68.0, f_number=5.0)
    images = []
    for away in (0.0, 1e3 * kilometres):
        (surface,) = scene.surfaces
        moved = replace(surface, vertices=surface.vertices + np.array([away, away, 0.0]))
        here = replace(scene, surfaces=(moved,), materials=black, camera=camera)
        image = Renderer(here, rays=64, device="cpu").radiance(pose(away, away, 120.0, pitch_deg=-90.0))
        images.append(image.astype(np.float64))
    error = np.sqrt(((images[1] - images[0]) ** 2).mean()) / band_radiance_derivative(300.0, *BAND)
    contrast = np.sqrt((np.diff(surface.temperature.astype(np.float64), axis=1) ** 2).mean())
    shift = 2.0 * float(np.spacing(np.float32(1e3 * kilometres))) / surface.texel_m
    return Found(float(error), 0.0, float(shift * contrast))
