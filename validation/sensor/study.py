"""Cost and error of the sensor model's approximations: instants and renders of a moving view, kernel sizes of the lens.

The lag is compared with 64 renders per time constant, with each row of a frame read at its own time. The blur is
compared with the transfer function itself, applied to the image's cosine series. A lens blurs before the pixels sample,
but the chain blurs afterwards; finer images show the resulting aliasing. Times are measured in the same process as a
Gaussian filter of SciPy, which is the unit for the whole chain.
"""

import time
from collections import deque
from dataclasses import replace

import numpy as np

from thermorender import files, formats
from thermorender.apps.compare.bench import views
from thermorender.apps.compare.machine import machine
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.render.renderer import Renderer
from thermorender.scene.scene import Scene
from thermorender.sensor import exposure, psf
from thermorender.sensor.chain import Sensor, at_rest, in_sequence
from thermorender.sensor.detector import advanced, read_rows, row_delays, steady
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.readout import radiance_from_counts
from thermorender.sensor.schedule import MEMORY
from thermorender.trajectory.path import pose
from thermorender.versions import versions
from validation.drapes import KINDS, load_drape
from validation.sensor.figure import figure, pictures, table

# Speed [m/s], roll about the optical axis [deg/s], height [m], pitch [deg].
FLIGHTS = {
    "rocket, down": (204.0, 360.0, 100.0, -90.0),
    "rocket, 45°": (204.0, 360.0, 100.0, -45.0),
    "drone, down": (10.0, 0.0, 120.0, -90.0),
    "drone, low": (10.0, 0.0, 30.0, -90.0),
}
RATE_HZ = 30.0
REFERENCE = 64
# Tolerance of instants [mK] and motion between renders [px]; 0: every instant is rendered.
SETTINGS = ((10.0, 20.0), (10.0, 80.0), (10.0, 40.0), (10.0, 10.0), (100.0, 20.0), (30.0, 20.0), (1000.0, 0.0),
            (300.0, 0.0), (100.0, 0.0), (30.0, 0.0), (10.0, 0.0))  # fmt: skip
KERNELS = ((3, 0), (5, 0), (7, 0), (9, 0), (3, 5), (5, 5), (7, 5), (9, 5))
# Subpixels per pixel of the images that are blurred before sampling, side of their central part, and width of its rim
# that is left out because the blur mirrors it [px].
FINER, MIDDLE_PX, RIM_PX = 4, 256, 16
# Sides of square targets on uniform ground [px], their contrast [K], subpixels per pixel, and places per pixel and
# direction.
TARGETS_PX, TARGET_K, DRAWN, PLACES = (0.5, 1.0, 1.5, 2.0, 3.0), 30.0, 16, 4
# A pixel is smooth if its value changes by less than this within a time constant [K].
SMOOTH_K = 1.0


def sensor(folder, scene=KINDS[0], flights=tuple(FLIGHTS), device="auto", progress=None):
    """Measure the sensor model, write `sensor.json`, `sensor.md` and figures to a folder, and return the result.

    Parameters
    ----------
    folder : path
    scene : str or Scene
        Scene folder, name of a shipped scene, or a scene in memory.
    flights : sequence of str
        Some of `FLIGHTS`.
    device : {"auto", "cpu", "cuda"}
    progress : callable, optional
        Called with (step, share done).

    Returns
    -------
    dict
        machine, versions, scene, camera; lag: {flight: [{lag_mk, render_px, instants, renders, ms, smooth_mk, all_mk,
        estimate_mk}, …]}, lag_mk None for a single image without memory; blur: [{fine, coarse, ms, error_mk,
        predicted}]; aliasing: {views: [{view, aliasing_mk, worst_mk, chain_mk}], targets: [{side_px, contrast_mk,
        peak_mk, error_mk, worst_mk}]}; chain: {standing_ms, subpixel_ms, gaussian_ms, standing_ratio, subpixel_ratio}.
        smooth_mk is over smooth pixels (see SMOOTH_K). aliasing_mk is the error of blurring after sampling with the
        transfer function itself, chain_mk with the chain's kernels. For a target, error_mk is that of its brightest
        pixel over places within a pixel, and worst_mk the largest error of any pixel.
    """
    unknown = [name for name in flights if name not in FLIGHTS]
    if unknown:
        raise ThermorenderError(f"flight {unknown[0]!r} is unknown; give some of {', '.join(FLIGHTS)}")
    report = progress or (lambda step, share: None)
    loaded = scene if isinstance(scene, Scene) else load_drape(scene)
    renderer = Renderer(loaded, device=device)
    of = Sensor(loaded.camera, renderer.seed)
    lags, seen = {}, {}
    for number, name in enumerate(flights):
        report(name, number / (len(flights) + 1))
        lags[name], seen[name] = _lag(renderer, of, FLIGHTS[name])
    report("blur and chain", len(flights) / (len(flights) + 1))
    result = {
        "machine": machine(),
        "versions": versions(),
        "scene": loaded.name,
        "camera": loaded.camera.name,
        "lag": lags,
        "blur": _blur(renderer, loaded.camera),
        "aliasing": {"views": _aliasing(renderer, loaded.camera), "targets": small_targets(loaded.camera)},
        "chain": _chain(renderer, of),
    }
    with files.output_folder(folder) as folder:
        formats.write_json(folder / "sensor.json", result)
        table(folder / "sensor.md", result)
        figure(folder / "sensor.png", result)
        pictures(folder / "effects.png", _effects(renderer, of, seen))
    report("measured", 1.0)
    return result


def _lag(renderer, of, flight):
    """Return errors and times of a flight's settings, and (single image, reference) of its frame in band radiance."""
    camera, path = of.camera, _flight(renderer, flight)

    def radiance_at(time_s, camera=None, lit_s=None, rim=None):
        return renderer.radiance(path(time_s), camera=camera, only=rim)

    now = radiance_at(0.0)
    expected, span = _reference(of, radiance_at, row_delays(camera, 1.0 / RATE_HZ))
    per_mk = band_radiance_derivative(300.0, *camera.band_um) * 1e-3
    none, one = of.power_law(at_rest(camera))
    smooth = span / per_mk < 1e3 * SMOOTH_K

    def errors(image):
        square = ((image - expected) / per_mk) ** 2
        return {
            "smooth_mk": float(np.sqrt(square[smooth].mean())) if smooth.any() else None,
            "all_mk": float(np.sqrt(square.mean())),
        }

    single = of.blurred(now)
    records = [
        {
            "lag_mk": None, "render_px": None, "instants": 1, "renders": 1,
            "ms": _ms(lambda: of.blurred(now)), **errors(single), "estimate_mk": None,
        }
    ]  # fmt: skip
    for lag_mk, render_px in SETTINGS:
        taken = Exposure(of, radiance_at, path, renderer.depth, 1.0 / RATE_HZ, render_px, lag_mk)
        start = time.perf_counter()
        signal, how = taken.signal(at_rest(camera), 0.0, now)
        ms = 1e3 * (time.perf_counter() - start)
        if any((how["instants"], how["renders"]) == (record["instants"], record["renders"]) for record in records):
            # For a slow flight, several settings give the same renders.
            continue
        records.append(
            {
                "lag_mk": lag_mk, "render_px": render_px, "instants": how["instants"],
                "renders": how["renders"], "ms": ms, **errors((signal - none) / one), "estimate_mk": how["lag_mk"],
            }
        )  # fmt: skip
    for record in records:
        record["motion_px"], record["smooth_share"] = how["motion_px"], float(smooth.mean())
    return records, (single, expected)


def _reference(of, radiance_at, delays):
    """Return band radiance of a frame with `REFERENCE` renders per time constant, and its range within the last one."""
    tau = of.camera.time_constant_s
    first = int(np.floor((delays[0] / tau - MEMORY) * REFERENCE))
    last = int(np.ceil(delays[-1] / tau * REFERENCE))
    out, span = (np.empty((of.camera.height, of.camera.width), np.float32) for _ in range(2))
    state, done, latest = None, 0, deque(maxlen=REFERENCE + 1)
    for number in range(first, last + 1):
        time_s = number / REFERENCE * tau
        image = of.blurred(radiance_at(time_s))
        latest.append(image)
        state = state or steady(time_s, image)
        until = np.searchsorted(delays, time_s, "right")
        if until > done:
            rows = slice(done, until)
            read_rows(state, time_s, image, delays[rows], rows, tau, out)
            past = np.array([before[rows] for before in latest])
            span[rows] = past.max(axis=0) - past.min(axis=0)
            done = until
        state = advanced(state, time_s, image, tau)
    return out, span


def _blur(renderer, camera):
    """Return error and time of each pair of kernels, on two views of the scene."""
    images = [renderer.radiance(view) for view in views(renderer.scene).values()]
    per_mk = band_radiance_derivative(300.0, *camera.band_um) * 1e-3
    table = np.linspace(0.0, np.sqrt(0.5), 4000)
    transfer = psf.otf(camera, table)
    expected = [psf.filtered(image, lambda frequency: np.interp(frequency, table, transfer)) for image in images]
    records = []
    for fine, coarse in ((1, 0), *KERNELS):
        blur = psf.blur_of(camera, fine, coarse) if fine > 1 else None
        square = [np.mean((psf.blurred(a, blur) - b) ** 2) for a, b in zip(images, expected, strict=True)]
        records.append(
            {
                "fine": fine, "coarse": coarse, "ms": _ms(lambda blur=blur: psf.blurred(images[0], blur)),
                "error_mk": float(np.sqrt(np.mean(square)) / per_mk), "predicted": blur and blur.error,
            }
        )  # fmt: skip
    return records


def _aliasing(renderer, camera):
    """Return the error of blurring after sampling in the middle of two views of the scene."""
    across, along = (0.5 * (n - min(MIDDLE_PX, n)) for n in (camera.width, camera.height))
    rows, columns = slice(int(along), int(camera.height - along)), slice(int(across), int(camera.width - across))
    fine = finer(camera.part(rows, columns), FINER)
    per_mk = band_radiance_derivative(300.0, *camera.band_um) * 1e-3
    inner = (slice(RIM_PX, -RIM_PX),) * 2
    records = []
    for view, at in views(renderer.scene).items():
        expected, after, image = blurred_before_and_after(renderer.radiance(at, camera=fine), camera, FINER)
        error = (after - expected)[inner] / per_mk
        kernels = (psf.blurred(image.astype(np.float32), psf.blur_of(camera)) - expected)[inner] / per_mk
        records.append(
            {
                "view": view, "aliasing_mk": float(np.sqrt(np.mean(error**2))),
                "worst_mk": float(np.abs(error).max()), "chain_mk": float(np.sqrt(np.mean(kernels**2))),
            }
        )  # fmt: skip
    return records


def small_targets(camera):
    """Return the error of blurring after sampling on squares of a few pixels, at several places within a pixel."""
    dark, bright = band_radiance(np.array([300.0, 300.0 + TARGET_K]), *camera.band_um)
    per_mk = band_radiance_derivative(300.0, *camera.band_um) * 1e-3
    records = []
    for side in TARGETS_PX:
        peaks, errors, worst = [], [], 0.0
        for place in np.ndindex(PLACES, PLACES):
            down, right = (covered(12.0 + index / PLACES, side, 28) for index in place)
            expected, after, _ = blurred_before_and_after((bright - dark) * np.outer(down, right), camera, DRAWN)
            peaks.append(expected.max() / per_mk)
            errors.append((after.max() - expected.max()) / per_mk)
            worst = max(worst, float(np.abs(after - expected).max() / per_mk))
        records.append(
            {
                "side_px": side, "contrast_mk": float((bright - dark) / per_mk), "peak_mk": float(np.mean(peaks)),
                "error_mk": float(np.sqrt(np.mean(np.square(errors)))), "worst_mk": worst,
            }
        )  # fmt: skip
    return records


def finer(camera, times):
    """Return the Camera of the same view with `times` × `times` pixels per pixel."""
    offset = tuple(times * part for part in camera.principal_offset_px)
    return replace(
        camera, width=times * camera.width, height=times * camera.height, principal_offset_px=offset,
        pixel_pitch_um=camera.pixel_pitch_um / times,
    )  # fmt: skip


def blurred_before_and_after(fine, camera, times):
    """Return (blurred on the fine grid and then sampled; sampled and then blurred; sampled) on the camera's pixels.

    Parameters
    ----------
    fine : (times·H, times·W) array
    camera : Camera
        Camera of the lens, whose transfer function is applied itself.
    times : int
    """
    table = np.linspace(0.0, times * np.sqrt(0.5), 4000)
    transfer = psf.otf(camera, table)

    def sampled(image):
        height, width = (n // times for n in image.shape)
        return image.reshape(height, times, width, times).mean(axis=(1, 3))

    pixels = sampled(np.asarray(fine, np.float64))
    before = psf.filtered(fine, lambda frequency: np.interp(times * frequency, table, transfer))
    after = psf.filtered(pixels, lambda frequency: np.interp(frequency, table, transfer))
    return sampled(before), after, pixels


def covered(start, side, count):
    """Return the share of each subpixel of `count` pixels in a line that a target covers, (DRAWN · count,)."""
    edge = np.arange(DRAWN * count + 1) / DRAWN
    return np.diff(np.clip(edge - start, 0.0, side)) * DRAWN


def _chain(renderer, of):
    """Return times from radiance to counts of a static camera and of a drone's, and over that of a Gaussian filter."""
    from scipy.ndimage import gaussian_filter

    flight = _flight(renderer, FLIGHTS["drone, down"])
    image = renderer.radiance(flight(0.0))
    # With the drift and pattern of a long flight.
    moment = in_sequence(of.camera, 900, 100.0)
    taken = exposure.Exposure(of, None, flight, renderer.depth, 1.0 / RATE_HZ)
    # In turns, so that a busy machine slows all of them alike.
    jobs = {
        "standing": lambda: of.counts(of.power(image, moment), moment),
        "subpixel": lambda: of.counts(taken.signal(moment, 0.0, image)[0], moment),
        "gaussian": lambda: gaussian_filter(image, 1.0),
    }
    seconds = {name: [] for name in jobs}
    for _ in range(31):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            seconds[name].append(time.perf_counter() - start)
    median = {f"{name}_ms": 1e3 * float(np.median(values[1:])) for name, values in seconds.items()}
    ratio = {f"{name}_ratio": median[f"{name}_ms"] / median["gaussian_ms"] for name in ("standing", "subpixel")}
    return median | ratio


def _flight(renderer, flight):
    """Return the function from time [s] to pose of a flight."""
    speed, roll, height_m, pitch = flight
    up_m = height_m + float(renderer.scene.ground(0.0, 0.0))
    return lambda time_s: pose(0.0, speed * time_s, up_m, 0.0, pitch, roll * time_s)


def _ms(job, repeats=25):
    """Return the median time of a job [ms]."""
    seconds = []
    for _ in range(repeats + 2):
        start = time.perf_counter()
        job()
        seconds.append(time.perf_counter() - start)
    return 1e3 * float(np.median(seconds[2:]))


def _effects(renderer, of, seen):
    """Return pictures of single effects, [(title, (H, W) array, unit)]."""
    camera, per_mk = of.camera, band_radiance_derivative(300.0, *of.camera.band_um) * 1e-3
    image = renderer.radiance(views(renderer.scene)["oblique"])
    found = [("as rendered", apparent_temperature(image, camera.band_um), "K")]
    found.append(("lens: blurred minus sharp", (of.blurred(image) - image) / per_mk, "mK"))
    for name, (single, expected) in seen.items():
        if name.startswith("rocket"):
            found += [(f"{name}: as read", apparent_temperature(expected, camera.band_um), "K")]
            found += [(f"{name}: as read minus one instant", (expected - single) / per_mk * 1e-3, "K")]
            break
    even = np.full(image.shape, band_radiance(300.0, *camera.band_um), np.float32)
    frames = np.array([of.counts_at_rest(even, index) for index in range(100)], np.float32)
    step = np.diff(radiance_from_counts(np.array([0, 1]), camera))[0]
    scale = step / per_mk
    found.append(("one frame of a uniform scene", (frames[1] - frames.mean()) * scale, "mK"))
    found.append(("mean of 100: the fixed pattern", (frames.mean(axis=0) - frames.mean()) * scale, "mK"))
    found.append(("deviation over 100: noise by pixel", frames.std(axis=0) * scale, "mK"))
    drifted = replace(at_rest(camera, 1), case_k=at_rest(camera).case_k + 3.0)
    later = of.counts(of.power(even, drifted), drifted).astype(np.float32)
    found.append(("3 K of case drift", (later - frames[1]) * scale, "mK"))
    return found
