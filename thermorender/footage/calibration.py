"""A camera file from the footage of a real camera: its noise, its fixed pattern, its blur, its gain control.

The frames are temperatures as the camera tells them. What is read from them is turned into the keys of a camera file
by the optics of a base camera, whose other keys are kept: NETD and its relatives are stated for a lossless lens at
300 K, the blur for a lens whose diffraction is known.
"""

import re
import textwrap
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.errors import ThermorenderError
from thermorender.files import atomic, check_output_file
from thermorender.footage.edge_width import edge_widths, sharpest, width_through
from thermorender.footage.field_statistics import Field, vignetting
from thermorender.footage.flir_jpeg import read_flir_jpeg
from thermorender.footage.noise_statistics import FLAT, Spectra, noise_of
from thermorender.footage.radiometric_files import FLIR_JPEG, SUFFIXES, read_temperature
from thermorender.physics.planck import band_radiance_derivative
from thermorender.schema import read_toml, toml_line, toml_value
from thermorender.sensor.camera import load_camera, model_path
from thermorender.sensor.noise import NETD_REFERENCE_K
from thermorender.sensor.optics import relative_illumination
from thermorender.sensor.psf import otf
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.units import ZERO_CELSIUS_K, kelvin

# Edges are looked for in so many of the frames, evenly spread.
_EDGE_FRAMES = 12
# More values than these in a frame are those of a calculation, not of a converter.
_MOST_LEVELS = 20000
# Keys of the base camera that go into the measured ones.
_OPTICS = ("f_number", "netd_f_number", "lens_transmittance", "band_um", "focal_length_mm", "pixel_pitch_um",
           "illumination_exponent", "vignetting", "frame_rate_hz", "gain", "sigma_t_mk")  # fmt: skip
_COMMENT = {"initial_indent": "# ", "subsequent_indent": "# "}
# Noise over the base camera's from which on low gain is likely: low gain has some four times that of high gain.
_LOW_GAIN = 2.5
# Largest uncertainty of vignetting that tells something, and how far above its range a camera may read [K].
_WORST_VIGNETTING, _BEYOND_K = 0.1, 5.0


@dataclass(frozen=True)
class Estimate:
    """A key of a camera file: its value or values, their uncertainty (one standard deviation) and how it was found."""

    value: float | tuple
    uncertainty: float
    how: str

    @property
    def rounded(self):
        """The value, or list of values, to four digits, as a camera file has it."""
        values = [float(f"{value:.4g}") for value in np.atleast_1d(self.value)]
        return values if isinstance(self.value, tuple) else values[0]

    @property
    def text(self):
        """`rounded` as TOML writes it."""
        return toml_value(self.rounded)


def frame_files(paths):
    """Return the frames of files and folders, in the order of their names within a folder.

    Raises
    ------
    ThermorenderError
        A path that does not exist, a file of another kind, or no frame at all.
    """
    files = []
    for path in map(Path, paths):
        if path.is_dir():
            files += sorted(item for item in path.iterdir() if item.suffix.lower() in SUFFIXES)
        elif not path.is_file():
            raise ThermorenderError(f"{path} does not exist; give frames or folders of frames")
        else:
            files.append(path)
    if not files:
        raise ThermorenderError(f"no frames ({', '.join(SUFFIXES)}) in {', '.join(map(str, paths))}")
    return files


def fit_camera(paths, base=defaults.CAMERA, scale=None, progress=None):
    """Return what the frames of a camera tell of it, {key of a camera file: Estimate}.

    Parameters
    ----------
    paths : sequence of paths
        Frames, or folders of them: 16-bit TIFFs, or radiometric JPEGs.
    base : str or path
        Camera model whose optics stand for the real one's.
    scale : (2,) floats, optional
        (kelvin per count, kelvin of count 0) of TIFFs that declare none.
    progress : callable, optional
        Called with the share done.

    Raises
    ------
    ThermorenderError
        Frames that cannot be read, of different sizes, or of another size than the base camera's; that are warmer than
        the base camera's range, hold no noise, show a scene that changes everywhere, or, of a camera that stands, have
        a flat-field correction between them.
    """
    camera, files = load_camera(base, "base camera"), frame_files(paths)
    shape = camera.height, camera.width
    spectra, field = Spectra(shape, 1.0 / relative_illumination(camera).astype(np.float64)), Field(shape)
    kept, steps, means, tails = [], [], [], []
    every = max(len(files) // _EDGE_FRAMES, 1)
    for number, path in enumerate(files):
        image, saturated = read_frame(path, scale)
        if image.shape != shape:
            raise ThermorenderError(
                f"{path} is {image.shape[1]}×{image.shape[0]} pixels and the base camera {camera.name} "
                f"{camera.width}×{camera.height}; give a base camera of that size"
            )
        _refuse_beyond(path, image, camera)
        cut_off = _cut_off(image)
        spectra.add(image, cut_off)
        field.add(np.where(np.isfinite(image), image, np.nanmean(image)), cut_off)
        steps.append(_step(image))
        means.append(np.nanmean(image[~cut_off]))
        tails += saturated
        if number % every == 0:
            kept.append(image)
        if progress:
            progress((number + 1) / len(files))
    noise, step_k, scene_k = noise_of(spectra), float(np.median(steps)), float(np.mean(means))
    if noise.pixel[0] <= 0.0:
        raise ThermorenderError(
            f"the frames hold no noise: pixels that show the same are equal, in steps of {step_k * 1e3:.0f} mK; give "
            "frames as the camera makes them, in finer steps and before any smoothing"
        )
    if noise.static and spectra.corrected():
        first = spectra.corrected()[0]
        raise ThermorenderError(
            f"the fixed pattern changes from {files[first - 1].name} to {files[first].name}, as by a flat-field "
            "correction; give frames between two of them"
        )
    found = _rims_key(spectra, noise, camera) if len(files) > 1 else {}
    rims = found.get("vignetting")
    if rims and abs(rims.value - camera.vignetting) > 3.0 * rims.uncertainty:
        # Noise was taken for that of the base camera's light.
        camera = replace(camera, vignetting=rims.rounded)
        spectra.gain = 1.0 / relative_illumination(camera).astype(np.float64)
        noise = noise_of(spectra)
    found |= _field_keys(field, noise, camera, scene_k, step_k)
    sigma_t = found["sigma_t_mk"].value if "sigma_t_mk" in found else camera.sigma_t_mk
    found = _noise_keys(noise, camera, scene_k, step_k, len(files), sigma_t) | found
    everywhere = noise.pixel[0] * np.sqrt((spectra.gain**2).mean())
    blur = _blur_key(kept, np.hypot(everywhere, noise.fixed_pixel[0] if noise.fixed_pixel else 0.0), camera)
    return found | blur | _display_key(np.array(tails))


def not_measured(base, estimates):
    """Return what a fitted camera file has from its base, a list of sentences."""
    given = {key: value for key, value in read_toml(model_path(base)).items() if key not in estimates}
    optics = [f"{key} = {toml_value(given.pop(key))}" for key in _OPTICS if key in given]
    name = model_path(base).stem
    told = [f"Not measured but those of {name}, on which the fitted numbers rest: {', '.join(optics)}."]
    return told + ([f"Not measured, as in {name}: {', '.join(given)}."] if given else [])


def write_camera(path, base, estimates):
    """Write a camera file: the base camera's, with the estimated keys and how each was found.

    Raises
    ------
    ThermorenderError
        A name that does not end in .toml, or a file that cannot be written.
    """
    check_output_file(path, (".toml",))
    text = model_path(base).read_text(encoding="utf-8")
    told = ["Fitted to footage, where a key says so.", *not_measured(base, estimates)]
    text = "".join(f"{line}\n" for each in told for line in textwrap.wrap(each, 118, **_COMMENT)) + text
    for key, estimate in estimates.items():
        line = toml_line(key, estimate.rounded, f"fitted, ± {estimate.uncertainty:.2g}: {estimate.how}")
        text, replaced = re.subn(rf"(?m)^{key}\s*=.*$", lambda _, line=line: line, text)
        if not replaced:
            text = f"{text.rstrip()}\n{line}\n"
    with atomic(path) as part:
        part.write_text(text, encoding="utf-8")
        load_camera(part)


def noise_scale(camera, scene_k):
    """Return the noise seen in the middle of frames over the same as a camera file states it.

    Parameters
    ----------
    camera : Camera
    scene_k : float
        Apparent temperature of the scene [K].

    Notes
    -----
    dL/dT at 300 K over that at the scene's temperature, times (4F² + 1) / ((4F₀² + 1) τ) of the lens.
    """
    slope = band_radiance_derivative(np.array([NETD_REFERENCE_K, scene_k]), *camera.band_um)
    lens = (4.0 * camera.f_number**2 + 1.0) / (4.0 * camera.netd_f_number**2 + 1.0) / camera.lens_transmittance
    return float(slope[0] / slope[1] * lens)


def _noise_keys(noise, camera, scene_k, step_k, frames, sigma_t_mk):
    scale = noise_scale(camera, scene_k)
    # What the converter's steps add is not the detector's; it is even noise as long as the noise spans a step.
    pixel = np.sqrt(max(noise.pixel[0] ** 2 - step_k**2 / 12.0, 0.0))
    parts = [(pixel, noise.pixel[1]), noise.row, noise.column]
    row, column = (value / scale * 1e3 for value, _ in parts[1:])
    whole = np.sqrt(sum(value**2 for value, _ in parts))
    error = np.sqrt(sum((value * uncertainty) ** 2 for value, uncertainty in parts)) / max(whole, 1e-9)
    netd = np.hypot(whole / scale * 1e3, sigma_t_mk)
    name = "low_gain_netd_mk" if camera.gain == "low" and camera.low_gain_netd_mk else "netd_mk"
    seen = f"{whole * 1e3:.0f} mK in the middle of frames at {scene_k:.0f} K"
    steps = f", without steps of {step_k * 1e3:.0f} mK" if step_k > 0.0 else ""
    if camera.gain == "high" and netd > _LOW_GAIN * camera.netd_mk:
        steps += f"; {netd / camera.netd_mk:.1f} times the base's: low gain is likely"
    if frames == 1:
        return {name: Estimate(netd, error / scale * 1e3, f"{seen}, one frame: holds the fixed pattern{steps}")}
    how, lines = "finest detail of the flattest tenth of blocks", "; too high where the scene has such lines"
    if noise.static:
        how, lines = "differences of frames of a static camera", ""
    if noise.lively:
        how, lines = "the tenth of blocks in which a changing scene does so least", "; too high as the scene changes"
    # The scene of a moving camera hides it.
    unseen = "" if noise.static else "; too low where a flat-field correction fell between them"
    found = {
        name: Estimate(netd, error / scale * 1e3, f"{seen}, {how}{steps}"),
        "sigma_tv_mk": Estimate(row, noise.row[1] / scale * 1e3, f"rows, new in each frame{lines}"),
        "sigma_th_mk": Estimate(column, noise.column[1] / scale * 1e3, f"columns, new in each frame{lines}"),
    }
    for key, (value, uncertainty), what in (
        ("sigma_v_mk", noise.fixed_row, "rows"),
        ("sigma_h_mk", noise.fixed_column, "columns"),
        ("sigma_vh_mk", noise.fixed_pixel, "single pixels"),
    ):
        how = f"{what}, the same in all {frames} frames{unseen}"
        found[key] = Estimate(value / scale * 1e3, uncertainty / scale * 1e3, how)
    return found


def _rims_key(spectra, noise, camera):
    """{vignetting: Estimate} by the growth of noise towards the corners; empty where frames tell it to no tenth."""
    light, half = (relative_illumination(replace(camera, vignetting=value)).astype(float) for value in (0.0, 0.5))
    rims = 2.0 * (1.0 - half / light)
    if noise.static:
        told = vignetting(spectra.changes, FLAT if noise.lively else 1.0, light, rims, 0.0)
    else:
        told = vignetting(spectra.blocks, FLAT, light, rims, noise.fixed_pixel[0] ** 2)
    if told is None or told[1] > _WORST_VIGNETTING:
        return {}
    how = f"growth of noise towards the corners beside illumination_exponent = {camera.illumination_exponent:g}"
    return {"vignetting": Estimate(*told, how)}


def _field_keys(field, noise, camera, scene_k, step_k):
    """Estimates of the whole image: of a static camera how its scale wanders, of a moving one its shading."""
    found = {}
    replaced = field.replaced(np.sqrt(max(noise.pixel[0] ** 2 - step_k**2 / 12.0, 0.0)), step_k)
    if replaced:
        share, uncertainty = replaced
        found["bad_pixels"] = Estimate(min(share, 0.05), uncertainty, "pixels that are the mean of their neighbours")
    if noise.static:
        parts = zip((noise.pixel, noise.row, noise.column), (np.prod(field.shape), *field.shape), strict=True)
        told = field.wander(camera.frame_rate_hz, np.linalg.norm([sigma / np.sqrt(n) for (sigma, _), n in parts]))
        # As in the middle of frames, where what arises on the detector is raised least.
        scale = 1e3 / noise_scale(camera, scene_k) * float(np.median(relative_illumination(camera)))
        at = f"noise in the levels of frames, {camera.frame_rate_hz:g} a second as those of the base"
        if told:
            (white, error), (wander, wander_error) = told
            found["sigma_t_mk"] = Estimate(white * scale, error * scale, f"white {at}")
            found["scale_drift_mk"] = Estimate(wander * scale, wander_error * scale, f"1/f {at}")
        return found
    told = field.shading()
    if told:
        slope = band_radiance_derivative(np.array([scene_k, NETD_REFERENCE_K]), *camera.band_um)
        scale = 1e3 * float(slope[0] / slope[1])
        how = "smooth part of the mean frame; too high where all views have a gradient alike"
        found["shading_mk"] = Estimate(told[0] * scale, told[1] * scale, how)
        found["shading_mk_per_k"] = Estimate(0.0, 0.0, "in shading_mk, as warm as the camera was")
    return found


def _refuse_beyond(path, image, camera):
    """Refuse temperatures that are no kelvin, as of a scale in °C, and those that high gain cannot read."""
    # Dead pixels may be at nothing.
    kelvin(f"the median temperature of {path}", float(np.nanmedian(image)))
    warmest, limit = float(np.nanmax(image)), camera.count_range_k[1]
    # Converters round, and cameras read a little beyond.
    if warmest > limit + _BEYOND_K:
        mend = 'gain = "low", if it was taken so, or its own range_c' if camera.gain == "high" else "its own range"
        raise ThermorenderError(
            f"{path} holds {warmest - ZERO_CELSIUS_K:.0f} °C, and {camera.gain} gain of the base camera {camera.name} "
            f"ends at {limit - ZERO_CELSIUS_K:.0f} °C; give a base camera file with {mend}"
        )


def _cut_off(image):
    """Where pixels sit at an end of their range, (H, W) bool: many with the same value, and few with the one beside."""
    found = np.zeros(image.shape, bool)
    values, counts = np.unique(image[np.isfinite(image)], return_counts=True)
    if len(values) < 2:
        return found
    for end, beside in ((0, 1), (-1, -2)):
        if counts[end] > 4 * counts[beside] + 32:
            found |= image == values[end]
    return found


def _blur_key(images, noise_k, camera):
    """{blur_sigma_px: Estimate} by the sharpest edges; empty where there are too few."""
    from scipy.optimize import brentq

    widths = np.concatenate([edge_widths(image, noise_k) for image in images])
    found = sharpest(widths)
    if found is None:
        return {}
    width, uncertainty = found

    def excess(sigma, wanted):
        model = replace(camera, blur_sigma_px=sigma)
        return width_through(lambda frequency: otf(model, frequency) * np.sinc(frequency)) - wanted

    def sigma_of(wanted):
        if excess(0.0, wanted) >= 0.0:
            return 0.0
        return brentq(excess, 0.0, 5.0, args=(wanted,), xtol=1e-3) if excess(5.0, wanted) > 0.0 else 5.0

    value, low, high = (sigma_of(max(width + k * uncertainty, 0.0)) for k in (0, -1, 1))
    how = f"sharpest of {len(widths)} edges, {width:.2f} ± {uncertainty:.2f} px in all; too high where edges are soft"
    return {"blur_sigma_px": Estimate(value, 0.5 * (high - low), how)}


def read_frame(path, scale):
    """Return the apparent temperatures of a file, (H, W) [K], and what its display saturates.

    The latter is a list: shares of pixels below and above the colour scale [%], or nothing where none is stored.
    """
    if path.suffix.lower() not in FLIR_JPEG:
        return read_temperature(path, scale), []
    picture = read_flir_jpeg(path)
    ends = picture.camera["scale_raw"]
    tails = [] if ends is None else [(100.0 * (picture.raw < ends[0]).mean(), 100.0 * (picture.raw > ends[1]).mean())]
    # The camera's own noise is that before any correction for surface and air.
    return picture.temperature(ThermographySettings()), tails


def _display_key(tails):
    """{agc_tails_percent: Estimate} by the colour scales stored in radiometric JPEGs; empty without any."""
    if not len(tails):
        return {}
    middle = tuple(float(value) for value in np.minimum(np.median(tails, axis=0), 49.0))
    spread = float(np.median(np.abs(tails - middle)))
    return {"agc_tails_percent": Estimate(middle, spread, f"outside the colour scale of {len(tails)} pictures")}


def _step(image):
    """The step between neighbouring values in a frame [K]; 0 where values are not those of a converter."""
    values = np.unique(image[np.isfinite(image)])
    return float(np.median(np.diff(values))) if 1 < values.size < _MOST_LEVELS else 0.0
