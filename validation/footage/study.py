"""Statistics of simulated and of real frames: power spectra, parts of the noise, noise over the field.

The scenes differ, so only effects of the camera are compared: the frequency above which noise exceeds the scene, noise
of rows and columns, fixed-pattern noise, and the growth of noise towards the corners. Two cameras are simulated: the
one in the camera file, and the one that `fit-camera` fits to the same footage.
"""

from dataclasses import asdict
from pathlib import Path

import numpy as np

from thermorender import defaults, formats
from thermorender.apps.survey.footage.calibration import (
    fit_camera,
    footage,
    images_of,
    noise_scale,
    write_camera,
)
from thermorender.apps.survey.footage.noise_statistics import Spectra, block_means, block_powers, noise_of
from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance
from thermorender.sensor.camera import load_camera
from thermorender.sensor.chain import Sensor
from thermorender.sensor.optics import relative_illumination
from thermorender.sensor.readout import radiance_from_counts
from validation.drapes import KINDS, load_drape
from validation.footage.figure import figure

HEADER = ("frames", "pixel [mK]", "row", "column", "fixed pixel", "fixed row", "fixed column")
_PARTS = ("pixel", "row", "column", "fixed_pixel", "fixed_row", "fixed_column")
# Number of simulated frames, their height above the ground, and their largest distance from the middle of the scene
# [m]. At this height a texel of the shipped scenes is at most as large as a pixel.
_FRAMES, _HEIGHT_M, _AWAY_M = 12, 200.0, 60.0
_RINGS = 6


def compare(paths, output, base=defaults.CAMERA, scale=None, scene=KINDS[0], name="footage", seed=0,
            progress=None, **options):  # fmt: skip
    """Write `name`.json, `name`.png and `name`.toml of a camera's footage and its simulations; return the JSON result.

    Parameters
    ----------
    paths : sequence of paths
        Real frames, or folders of them.
    output : path
        Folder.
    base : str or path
        Camera model of the footage.
    scale : (2,) floats, optional
        (kelvin per count, kelvin at count 0) of TIFFs that declare none.
    scene : str
        Scene of the simulated frames, seen from above.
    seed : int
    progress : callable, optional
        Called with (step, share done).
    **options
        Keywords of Renderer.
    """
    report = progress or (lambda step, share: None)
    camera, frames = load_camera(base, "base camera"), footage(paths)
    found = fit_camera(paths, base, scale, lambda share: report("reading the footage", share))
    fitted_path = Path(output) / f"{name}.toml"
    write_camera(fitted_path, base, found)
    sides = {
        "real": (image.kelvin for image in images_of(frames, scale)),
        "simulated, as the file has it": None,
        "simulated, fitted": None,
    }
    radiance = views_of(scene, camera, seed, report, options)
    for side, model in zip(list(sides)[1:], (camera, load_camera(fitted_path)), strict=True):
        sides[side] = _readings(radiance, model, seed)
    statistics = {side: _statistics(images, camera) for side, images in sides.items()}
    estimates = {key: asdict(estimate) for key, estimate in found.items()}
    result = {"camera": camera.name, "scene": scene, "estimates": estimates, "sides": statistics}
    formats.write_json(Path(output) / f"{name}.json", result)
    figure(Path(output) / f"{name}.png", statistics, name)
    return result


def rows(result):
    """Return the parts of the noise of each side, in the units of a camera file, as table rows under `HEADER`."""
    found = []
    for side, own in result["sides"].items():
        parts = ("—" if own["noise_mk"][p] is None else "{:.1f} ± {:.1f}".format(*own["noise_mk"][p]) for p in _PARTS)
        found.append((f"{side}: {own['frames']}", *parts))
    return found


def views_of(scene, camera, seed, report, options):
    """Return band radiance of views straight down at positions and headings drawn from the seed."""
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose

    loaded = load_drape(scene).with_camera(camera)
    renderer = Renderer(loaded, seed=seed, progress=report, **options)
    rng = np.random.default_rng(seed)
    views = []
    for number in range(_FRAMES):
        east, north = rng.uniform(-_AWAY_M, _AWAY_M, 2)
        view = pose(east, north, _HEIGHT_M + float(loaded.ground(east, north)), rng.uniform(0.0, 360.0), -90.0, 0.0)
        views.append(renderer.frame(view, index=number).radiance)
        report("rendering", (number + 1) / _FRAMES)
    return views


def _readings(views, camera, seed):
    """Yield apparent temperatures that a camera at rest reads of views [K]."""
    grid = RadianceTable.grid(*camera.count_range_k)
    table = RadianceTable(grid, band_radiance(grid, *camera.band_um))
    sensor = Sensor(camera, seed)
    for index, view in enumerate(views):
        yield table.inverse(radiance_from_counts(sensor.counts_at_rest(view, index), camera))


def _statistics(images, camera):
    """Return the statistics of frames, as plain values."""
    gain = 1.0 / relative_illumination(camera).astype(np.float64)
    spectra, powers = Spectra((camera.height, camera.width), gain), []
    for image in images:
        spectra.add(image)
        powers.append(block_powers(np.where(np.isfinite(image), image, np.nanmean(image))))
    noise, mean_k = noise_of(spectra), float(spectra.image.mean())
    # Noise at one temperature and without the lens, as in a camera file; otherwise warm scenes would seem less noisy.
    scale = noise_scale(camera, mean_k)
    frequency, total, fixed = _radial(spectra)
    down, right = spectra.frequencies()
    half = camera.height // 2
    return {
        "frames": spectra.count,
        "mean_k": mean_k,
        "noise_mk": {part: _millikelvin(getattr(noise, part), scale) for part in _PARTS},
        "frequency": _short(frequency),
        "power": _short(total),
        "fixed_power": None if fixed is None else _short(fixed),
        "rows": _line(down[1:half, 0], spectra.total[1:half, 0]),
        "columns": _line(right[0, 1:-1], spectra.total[0, 1:-1]),
        "field": _field(np.array(powers) / scale**2, camera),
    }


def _millikelvin(part, scale):
    return None if part is None else _short(1e3 / scale * np.array(part))


def _short(values):
    return [float(f"{value:.4g}") for value in np.asarray(values)]


def _line(frequency, power):
    """Return means over eight neighbours, which smooths the lines."""
    frequency, power = (a[: a.size // 8 * 8].reshape(-1, 8).mean(axis=1) for a in (frequency, power))
    return {"frequency": _short(frequency), "power": _short(power)}


def _radial(spectra):
    """Return (mean frequency, total power, fixed power) of rings of frequencies off the axes."""
    down, right = spectra.frequencies()
    radius = np.hypot(down, right)
    edges = np.geomspace(0.01, 0.7, 45)
    rings = [spectra.off_axis(ring) for ring in zip(edges[:-1], edges[1:], strict=True)]
    rings = [ring for ring in rings if ring.any()]
    fixed = spectra.fixed
    return (
        np.array([radius[ring].mean() for ring in rings]),
        np.array([spectra.total[ring].mean() for ring in rings]),
        None if fixed is None else np.array([fixed[ring].mean() for ring in rings]),
    )


def _field(powers, camera):
    """Return the noise of the flattest blocks in rings around the image centre: {radius [share of corner's], mK}."""
    row, column = np.mgrid[: camera.height, : camera.width]
    off = np.hypot(row - 0.5 * camera.height, column - 0.5 * camera.width)
    off = block_means(off / off.max())
    edges = np.quantile(off, np.linspace(0.0, 1.0, _RINGS + 1))
    radius, noise = [], []
    for low, high in zip(edges[:-1], edges[1:], strict=True):
        ring = powers[:, (off >= low) & (off <= high)].reshape(-1, 2)
        flattest = np.argsort(ring[:, 0])[: max(len(ring) // 10, 4)]
        radius.append(0.5 * (low + high))
        noise.append(1e3 * np.sqrt(ring[flattest, 1].mean()))
    return {"radius": _short(radius), "noise_mk": _short(noise)}
