"""Lines of sight through LOWTRAN7, as band radiances: a second opinion on the shipped atmospheres.

`python -m tools.lowtran` writes them beside its table. Their altitudes and angles are random.
"""

import numpy as np

from thermorender.atmosphere import air_column, lowtran
from thermorender.files import atomic
from thermorender.physics.planck import spectral_radiance
from tools.lowtran.spectra import (
    CAMERA_BANDS,
    CONTRAST_K,
    offset_air,
    run_all,
    standard_levels,
    water_g_m3,
)

# LOWTRAN evaluates the water continuum at the mean temperature of a layer, which in its standard layers of 1 km is
# wrong by up to 1 K (80 mK of a path's light); so the standard atmospheres are given to it on finer levels [km]. Not
# between 2 and 3 km, where the standard levels say how the aerosol of the ground fades into that above.
_LEVELS_KM = (*np.arange(0.0, 2.0, 0.25), 2, 3, 3.5, 4, 4.5, 5, 5.5, *range(6, 13), 14, 17, 20, 25, 30, 40, 50, 70, 100)


def fine_air(levels, model, temperature_offset_k, humidity_factor, haze):
    """Return the lowtran.Air of a standard model on finer levels, warmer and moister as `Atmosphere.standard`."""
    altitude = 1e3 * np.array(_LEVELS_KM)
    fine = lowtran.Levels(
        altitude,
        air_column.exponential(altitude, levels.altitude_m, levels.pressure_hpa[None])[0],
        np.interp(altitude, levels.altitude_m, levels.temperature),
        air_column.exponential(altitude, levels.altitude_m, levels.density),
    )
    water = air_column.exponential(altitude, levels.altitude_m, water_g_m3(levels)[None])[0]
    return offset_air(fine, water, model, temperature_offset_k, humidity_factor, haze=haze)


def held_out_paths(count, seed):
    """Return (count, 3) held-out lines of sight: from_m, to_m (0: to space), zenith angle [degrees]; all random.

    In turn they end on the ground, end at another height above or below, and look at the sky from up to 5 km. Camera
    altitudes are 1 m to 30 km, even in their logarithm; directions are even in the cosine of the zenith angle, from
    the vertical to 3° from the level or as near as still meets the target's height.
    """
    random = np.random.Generator(np.random.Philox(seed))
    rows = []
    for number in range(count):
        at, to = (float(10.0 ** random.uniform(0.0, np.log10(3e4))) for _ in range(2))
        if number % 3 == 0:
            at, to = max(at, 20.0), 1.0
        elif number % 3 == 1:
            at = at if abs(at - to) > 20.0 else to + 200.0
        else:
            at, to = float(random.uniform(1.0, 5e3)), 0.0
        # Cosine to the level at which a ray from above passes just below the target.
        level = 1.1 * np.sqrt(2.0 * max(at - to, 0.0) / 6.371e6) if to else 0.0
        cosine = random.uniform(max(np.cos(np.radians(87.0)), level), 1.0)
        downward = 0.0 < to < at
        zenith = 180.0 - np.degrees(np.arccos(cosine)) if downward else np.degrees(np.arccos(cosine))
        rows.append((round(at, 1), round(to, 1), round(float(zenith), 3)))
    return np.array(rows)


def line_of_sight(air, from_m, to_m, zenith_deg, temperature_at, contrasts=(CONTRAST_K, -CONTRAST_K), points=80):
    """Return {camera band: (radiance of a target per contrast …, its transmittance)} from LOWTRAN's spectra.

    The path's own light is Planck's law summed over `points` steps of LOWTRAN's transmittance from the camera;
    the target is a blackbody warmer than its air by each contrast. To space (`to_m` = 0) it is absent.
    """
    top = to_m or 99999.0
    # Steps grow in proportion to the distance from the camera and to that from the lower end, from 300 m on.
    fine = np.linspace(from_m, top, 20001)
    crowding = 1.0 / (300.0 + np.abs(fine - from_m)) + 1.0 / (300.0 + fine - min(from_m, top))
    total = np.concatenate([[0.0], np.cumsum(0.5 * (crowding[1:] + crowding[:-1]))])
    altitude = np.interp(np.linspace(0.0, total[-1], points + 1)[1:], total, fine)
    altitude[-1] = top
    runs = run_all([(air, from_m, float(z), zenith_deg, None) for z in altitude])
    through = np.stack([np.ones_like(runs[0].transmittance), *(run.transmittance for run in runs)])
    temperature = temperature_at(np.r_[from_m, altitude])
    result = {}
    for band in CAMERA_BANDS:
        fine = np.linspace(1e4 / band[1], 1e4 / band[0], 3001)
        step = np.gradient(fine)
        step[[0, -1]] *= 0.5
        # Per wavenumber: B dλ = B λ² / 1e4 dν.
        wavelength = 1e4 / fine
        step = step * wavelength**2 / 1e4
        passed = np.stack([np.interp(fine, runs[0].wavenumber, row) for row in through])
        source = spectral_radiance(wavelength, temperature[:, None])
        air_light = source[0] - source[-1] * passed[-1] + np.sum(np.diff(source, axis=0) * _mean(passed), axis=0)
        if to_m == 0.0:
            result[band] = np.array([air_light @ step, passed[-1] @ step / step.sum()])
            continue
        targets = [spectral_radiance(wavelength, temperature[-1] + contrast) for contrast in contrasts]
        planck = source[-1] * step
        result[band] = np.array(
            [*((air_light + passed[-1] * target) @ step for target in targets), passed[-1] @ planck / planck.sum()]
        )
    return result


def _mean(passed):
    """Mean transmittance over each step, exact where optical depth is linear in the source."""
    before, after = passed[:-1], passed[1:]
    depth = np.log(np.maximum(before, 1e-300) / np.maximum(after, 1e-300))
    thin = depth < 1e-6
    return np.where(thin, before, (before - after) / np.where(thin, 1.0, depth))


def make_reference(path, per_case=6, seed=2024):
    """Write held-out spectra as band radiances: of every atmosphere with every aerosol, and of offset atmospheres.

    Arrays: `case` (P, 2) model and aerosol numbers, `offset` (P, 2), `path` (P, 3) from `held_out_paths`, `value`
    (P, bands, 3) radiance of a target 20 K above and below its air and transmittance; of the sky, radiance first.
    """
    levels = standard_levels()
    cases = [(model, haze, 0.0, 1.0) for model in range(6) for haze in range(5)]
    cases += [(model, 0, *offset) for model in range(6) for offset in ((8.0, 1.4), (-8.0, 0.6))]
    paths = held_out_paths(per_case * len(cases), seed)
    value = np.full((len(paths), len(CAMERA_BANDS), 3), np.nan)
    for number, row in enumerate(paths):
        model, haze, warmer, moister = cases[number // per_case]
        own = levels[model + 1]
        kind = list(lowtran.AEROSOLS.values())[haze]
        air = fine_air(own, model + 1, warmer, moister, kind)
        warm = own.temperature + warmer
        found = line_of_sight(air, *row, lambda z, own=own, warm=warm: np.interp(z, own.altitude_m, warm))
        for band, numbers in enumerate(found.values()):
            value[number, band, : len(numbers)] = numbers
    case = np.repeat(np.array(cases), per_case, axis=0)
    with atomic(path) as part, open(part, "wb") as file:
        np.savez_compressed(
            file, case=np.int8(case[:, :2]), offset=case[:, 2:], path=np.float32(paths), value=np.float32(value)
        )
