"""Stability of the light solver: nearly perfect reflectors, its bound, its refusals; and errors against run time.

A random closed system models surfaces that each see 64 others, with known light.
"""

from dataclasses import replace
from functools import cache

import numpy as np

from tests.robustness.air import refused
from tests.robustness.cases import Found, case
from thermorender.defaults import BAND_UM
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render.light import radiosity, solver
from thermorender.render.light.environment import Sunlight, even

_FACES, _RAYS = 10_000, 32
_PER_K = float(band_radiance_derivative(300.0, *BAND_UM))


@cache
def closed():
    """A Transport of faces that see only each other, and no sky."""
    random = np.random.Generator(np.random.Philox(0))
    rows = [np.unique(random.integers(0, _FACES, _RAYS), return_counts=True) for _ in range(2 * _FACES)]
    start = np.concatenate([[0], np.cumsum([len(seen) for seen, _ in rows])])
    return radiosity.Transport(
        rays=_RAYS, start=start, seen=np.concatenate([seen for seen, _ in rows]).astype(np.int32),
        hits=np.concatenate([hits for _, hits in rows]).astype(np.uint16),
        up=np.zeros((_FACES, 2, radiosity.SKY_BINS), np.uint16), down=np.zeros((_FACES, 2), np.uint16),
        touching=np.zeros(0, np.uint32),
    )  # fmt: skip


@cache
def known(emissivity):
    """(light of 250 to 350 K on the faces (F, 1), reflectance (F, 1), the Environment that produces it).

    Light x is chosen first; then the external light it requires, x − K ρ x, in extended precision.
    """
    operator, random = closed().operator, np.random.Generator(np.random.Philox(1))
    exact = band_radiance(random.uniform(250.0, 350.0, (_FACES, 1)), *BAND_UM)
    rho = np.full((_FACES, 1), 1.0 - emissivity)
    light = exact.astype(np.longdouble) * rho
    reflected = np.add.reduceat(operator.data[:, None] * light[operator.indices], operator.indptr[:-1])
    nothing = even(np.zeros(1), np.zeros(1), _FACES)
    # Light of each face for itself, as a sun of radiance 1 gives it.
    own = Sunlight(np.array([0.0, 0.0, 1.0]), np.ones(1), (exact - reflected)[:, 0].astype(np.float64))
    return exact, rho, replace(nothing, sun=own)


def solved(emissivity, tolerance_k):
    """(largest error [K], bound [K]) of known light, solved to a tolerance [K]."""
    exact, rho, outside = known(emissivity)
    found = solver.solve(closed(), np.zeros((_FACES, 1)), rho, outside, tolerance_k * _PER_K)
    return float(np.abs(found.incident - exact).max()) / _PER_K, found.bound / _PER_K


@case("solver", "closed system, emissivity {:g}: its error by its bound", (0.5, 0.1, 1e-3, 1e-5, 1e-6))
def bound(emissivity):
    """‖(1 − K ρ)⁻¹‖∞ is 1/ε: up to a million. Allowed is the bound, plus that times an ulp of the incoming light."""
    error, stated = solved(emissivity, 1e-3)
    ulp = np.finfo(float).eps * band_radiance(350.0, *BAND_UM) / _PER_K
    return Found(error, 0.0, stated + ulp / emissivity)


@case("solver", "closed system, emissivity {:g}: its bound by the millikelvin asked for", (0.5, 1e-3, 1e-6))
def reached(emissivity):
    """The stated error is the requested tolerance."""
    return Found(solved(emissivity, 1e-3)[1], 0.0, 1e-3)


@case("solver", "{} is refused", ("a picokelvin of a system of emissivity 1e-6", "a system of emissivity 0"))
def refusal(which):
    """Rounding alone is a billionth of a kelvin times a million; without emissivity light grows without end."""
    asked = (1e-6, 1e-12, "does not converge") if "pico" in which else (0.0, 1e-3, "never leaves")
    return refused(lambda: solved(*asked[:2]), asked[2])


# --- error against run time: each time is that of the setting; the first of a kind prepares the others ----------


@case("solver", "closed system, emissivity 0.01, solved to {:g} K", (10.0, 1.0, 0.1, 1e-2, 1e-3, 1e-6, 1e-9))
def tolerance(asked_k):
    """The error is not above the requested tolerance."""
    return Found(solved(0.01, asked_k)[0], 0.0, asked_k)


@case("solver", "light in a bowl by {:d} rays per face", (16, 64, 256, 1024))
def rays_per_face(rays):
    """A sphere of emissivity 0.5, half of it open: RMS of its faces, by four standard errors of each face's share."""
    from validation.cavity import measure

    black, sky = band_radiance(np.array([300.0, 250.0]), *BAND_UM)
    # x = (1−s) (ε B + ρ x) + s S: its slope in s, for one face's rays, at constant x.
    received = (0.25 * black + 0.5 * sky) / 0.75
    noise = 0.5 * abs(0.5 * (black + received) - sky) * np.sqrt(0.25 / rays) / _PER_K
    return Found(1e-3 * measure("bowl", 0.5, 0.5, rays, "cpu")["error_mk"], 0.0, 4.0 * float(noise) + 1e-3)


@cache
def _hills():
    """(Renderer, pose, the image by 256 rays per pixel) of hills from 120 m, 160 × 128 pixels."""
    from thermorender.apps.compare.sampling_error import converged
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose
    from validation.made_scenes import terrain

    scene = terrain(20_000)
    camera = replace(scene.camera, width=160, height=128, pixel_pitch_um=68.0, f_number=5.0)
    renderer = Renderer(scene.with_camera(camera), device="cpu")
    view = pose(0.0, -120.0, 120.0, pitch_deg=-45.0)
    return renderer, view, converged(renderer, view)


@case("solver", "hills by {0[0]:d} rays per pixel, at edges to {0[1]:g} mK: error of a frame by what is stated",
      ((1, 500.0), (1, 150.0), (1, 24.0), (4, 24.0), (16, 8.0)))  # fmt: skip
def rays_per_pixel(setting):
    """RMS over pixels that show ground, against 256 rays per pixel."""
    from thermorender.render.renderer import Renderer

    prepared, view, finest = _hills()
    renderer = Renderer(prepared.scene, samples=setting[0], edge_mk=setting[1], device="cpu", like=prepared)
    frame = renderer.frame(view)
    off = (frame.radiance - finest)[np.isfinite(frame.error_mk)]
    found = float(np.sqrt(np.mean(np.square(off, dtype=np.float64)))) / renderer.plan.radiance_per_mk
    return Found(1e-3 * found, 0.0, 1e-3 * frame.budget_mk["sampling"])
