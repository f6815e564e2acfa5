"""A camera file from the footage of a real camera: its noise, fixed pattern, blur and gain control.

The optics of a base camera convert the frames' temperatures to camera keys; its other keys are kept. NETD and other
noise keys are stated for a lossless lens at 300 K, the blur for a lens of known diffraction.
"""

import re
import textwrap
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera, defaults, load_camera
from thermorender.apps.survey.footage.edge_width import edge_widths, sharpest, width_through
from thermorender.apps.survey.footage.field_statistics import Field, vignetting
from thermorender.apps.survey.footage.noise_statistics import FLAT, Noise, Spectra, noise_of
from thermorender.errors import ThermorenderError
from thermorender.files import atomic, check_output_file
from thermorender.physics.planck import band_radiance_derivative
from thermorender.schema import read_toml, toml_line, toml_value
from thermorender.sensor.camera import model_path
from thermorender.sensor.noise import NETD_REFERENCE_K
from thermorender.sensor.optics import relative_illumination
from thermorender.sensor.psf import otf
from thermorender.sensor.thermal_files import (
    SUFFIXES,
    ThermalFrame,
    ThermalImage,
    files_of,
    sequence_hint,
    thermal_frames,
    thermal_images,
)
from thermorender.units import ZERO_CELSIUS_K, kelvin

# Number of frames, evenly spaced, in which edges are searched.
_EDGE_FRAMES = 12
# A frame with more distinct values than these does not come directly from a converter.
_MOST_LEVELS = 20000
# Keys of the base camera on which the measured values depend.
_OPTICS = ("f_number", "netd_f_number", "lens_transmittance", "band_um", "focal_length_mm", "pixel_pitch_um",
           "illumination_exponent", "vignetting", "frame_rate_hz", "gain", "sigma_t_mk")  # fmt: skip
# Ratio to the base camera's noise above which low gain is likely: low gain has about four times that of high gain.
_LOW_GAIN = 2.5
# Largest useful uncertainty of vignetting, and how far above its range a camera may read [K].
_WORST_VIGNETTING, _BEYOND_K = 0.1, 5.0


@dataclass(frozen=True)
class Estimate:
    """A key of a camera file: its value or values, their uncertainty (one standard deviation) and how it was found."""

    value: float | tuple[float, ...]
    uncertainty: float
    how: str

    @property
    def rounded(self) -> float | list[float]:
        """The value, or list of values, to four digits, as in a camera file."""
        return [_rounded(value) for value in self.value] if isinstance(self.value, tuple) else _rounded(self.value)

    @property
    def number(self) -> float:
        """The value of a key that has one."""
        assert not isinstance(self.value, tuple)
        return self.value

    @property
    def text(self) -> str:
        """`rounded` as TOML."""
        return toml_value(self.rounded)


def _rounded(value: float) -> float:
    return float(f"{value:.4g}")


def footage(paths: Iterable[str | PathLike[str]]) -> list[ThermalFrame]:
    """Return the frames in files, sequences and folders, sorted by name within a folder."""
    files = []
    for path in map(Path, paths):
        if path.is_dir():
            files += files_of(path)
        elif not path.is_file():
            raise ThermorenderError(f"{path} does not exist; give frames or folders of frames")
        else:
            files.append(path)
    if not files:
        hint = sequence_hint(item for path in map(Path, paths) if path.is_dir() for item in path.iterdir())
        raise ThermorenderError(f"no frames ({', '.join(SUFFIXES)}) in {', '.join(map(str, paths))}{hint}")
    return thermal_frames(files)


def images_of(frames: Sequence[ThermalFrame], scale: tuple[float, float] | None) -> Iterator[ThermalImage]:
    """Yield the frames' temperatures at the camera: its noise is defined before any correction for surface and air."""
    return thermal_images(frames, scale, "nothing")


def fit_camera(
    paths: Iterable[str | PathLike[str]], base: str | PathLike[str] = defaults.CAMERA,
    scale: tuple[float, float] | None = None, progress: Callable[[float], object] | None = None,
) -> dict[str, Estimate]:  # fmt: skip
    """Return {key of a camera file: Estimate} from a camera's frames: TIFFs, radiometric JPEGs or sequences.

    `scale` is (kelvin per count, kelvin of count 0) of TIFFs that declare none.
    """
    camera, frames = load_camera(base, "base camera"), footage(paths)
    if camera.well_electrons:
        raise ThermorenderError(
            f"base camera {camera.name} has a photon detector, whose noise grows with the signal; give a microbolometer"
        )
    shape = camera.height, camera.width
    spectra, field = Spectra(shape, 1.0 / relative_illumination(camera).astype(np.float64)), Field(shape)
    kept, steps, means, tails = _gathered(frames, scale, camera, spectra, field, progress)
    noise, step_k, scene_k = noise_of(spectra), float(np.median(steps)), float(np.mean(means))
    _refuse_unfit(frames, noise, spectra, step_k)
    found = _rims_key(spectra, noise, camera) if len(frames) > 1 else {}
    rims = found.get("vignetting")
    if rims and abs(rims.number - camera.vignetting) > 3.0 * rims.uncertainty:
        # The noise was estimated with the illumination of the base camera.
        camera = replace(camera, vignetting=_rounded(rims.number))
        spectra.gain = 1.0 / relative_illumination(camera).astype(np.float64)
        noise = noise_of(spectra)
    found |= _field_keys(field, noise, camera, scene_k, step_k)
    sigma_t = found["sigma_t_mk"].number if "sigma_t_mk" in found else camera.sigma_t_mk
    found = _noise_keys(noise, camera, scene_k, step_k, len(frames), sigma_t) | found
    everywhere = noise.pixel[0] * np.sqrt((spectra.gain**2).mean())
    blur = _blur_key(kept, np.hypot(everywhere, noise.fixed_pixel[0] if noise.fixed_pixel else 0.0), camera)
    return found | blur | _display_key(np.array(tails))


def _gathered(
    frames: Sequence[ThermalFrame], scale: tuple[float, float] | None, camera: Camera, spectra: Spectra, field: Field,
    progress: Callable[[float], object] | None,
) -> tuple[list[NDArray[Any]], list[float], list[float], list[tuple[float, float]]]:  # fmt: skip
    """Add frames to `spectra` and `field`; (some of the frames, steps [K], means [K], saturated shares [%])."""
    kept: list[NDArray[Any]] = []
    steps: list[float] = []
    means: list[float] = []
    tails: list[tuple[float, float]] = []
    every = max(len(frames) // _EDGE_FRAMES, 1)
    for number, found in enumerate(images_of(frames, scale)):
        image, path = found.kelvin, found.frame.path
        if image.shape != spectra.shape:
            raise ThermorenderError(
                f"{path} is {image.shape[1]}×{image.shape[0]} pixels and the base camera {camera.name} "
                f"{camera.width}×{camera.height}; give a base camera of that size"
            )
        _refuse_beyond(path, image, camera)
        cut_off = _cut_off(image)
        spectra.add(image, cut_off)
        field.add(np.where(np.isfinite(image), image, np.nanmean(image)), cut_off)
        steps.append(_step(image))
        means.append(float(np.nanmean(image[~cut_off])))
        tails += [] if found.saturated is None else [found.saturated]
        if number % every == 0:
            kept.append(image)
        if progress:
            progress((number + 1) / len(frames))
    return kept, steps, means, tails


def _refuse_unfit(frames: Sequence[ThermalFrame], noise: Noise, spectra: Spectra, step_k: float) -> None:
    """Refuse frames without noise, and a flat-field correction between frames of a static camera."""
    if noise.pixel[0] <= 0.0:
        raise ThermorenderError(
            f"the frames hold no noise: pixels that show the same are equal, in steps of {step_k * 1e3:.0f} mK; give "
            "frames as the camera makes them, in finer steps and before any smoothing"
        )
    if noise.static and spectra.corrected():
        first = spectra.corrected()[0]
        raise ThermorenderError(
            f"the fixed pattern changes from {frames[first - 1].label} to {frames[first].label}, as by a flat-field "
            "correction; give frames between two of them"
        )


def not_measured(base: str | PathLike[str], estimates: dict[str, Estimate]) -> list[str]:
    """Return sentences that list the keys which a fitted camera file has from its base."""
    given = {key: value for key, value in read_toml(model_path(base)).items() if key not in estimates}
    optics = [f"{key} = {toml_value(given.pop(key))}" for key in _OPTICS if key in given]
    name = model_path(base).stem
    sentences = [f"Not measured but taken from {name}, which the fitted numbers depend on: {', '.join(optics)}."]
    return sentences + ([f"Not measured, as in {name}: {', '.join(given)}."] if given else [])


def write_camera(path: str | PathLike[str], base: str | PathLike[str], estimates: dict[str, Estimate]) -> None:
    """Write the file of the base camera with the estimated keys, each with its uncertainty and method."""
    check_output_file(path, (".toml",))
    text = model_path(base).read_text(encoding="utf-8")
    notes = ["Fitted to footage, where a key says so.", *not_measured(base, estimates)]
    wrapped = (line for each in notes for line in textwrap.wrap(each, 116))
    text = "".join(f"# {line}\n" for line in wrapped) + text
    for key, estimate in estimates.items():
        line = toml_line(key, estimate.rounded, f"fitted, ± {estimate.uncertainty:.2g}: {estimate.how}")
        text, replaced = re.subn(rf"(?m)^{key}\s*=.*$", lambda _, line=line: line, text)  # type: ignore[misc]
        if not replaced:
            text = f"{text.rstrip()}\n{line}\n"
    with atomic(path) as part:
        part.write_text(text, encoding="utf-8")
        load_camera(part)


def noise_scale(camera: Camera, scene_k: float) -> float:
    """Return the ratio of the noise at the centre of frames of a scene [K] to the noise in a camera file: dL/dT at 300
    K over that at the scene's temperature, times (4F² + 1) / ((4F₀² + 1) τ) of the lens.
    """
    slope = band_radiance_derivative(np.array([NETD_REFERENCE_K, scene_k]), *camera.band_um)
    lens = (4.0 * camera.f_number**2 + 1.0) / (4.0 * camera.netd_f_number**2 + 1.0) / camera.lens_transmittance
    return float(slope[0] / slope[1] * lens)


def _noise_keys(
    noise: Noise, camera: Camera, scene_k: float, step_k: float, frames: int, sigma_t_mk: float
) -> dict[str, Estimate]:
    """Estimates of the noise of pixels, rows and columns, as keys of a camera file."""
    scale = noise_scale(camera, scene_k)
    # Quantisation is not noise of the detector; it adds step²/12 if the noise spans a step.
    pixel = np.sqrt(max(noise.pixel[0] ** 2 - step_k**2 / 12.0, 0.0))
    parts = [(pixel, noise.pixel[1]), noise.row, noise.column]
    row, column = (value / scale * 1e3 for value, _ in parts[1:])
    whole = np.sqrt(sum(value**2 for value, _ in parts))
    error = np.sqrt(sum((value * uncertainty) ** 2 for value, uncertainty in parts)) / max(whole, 1e-9)
    netd = np.hypot(whole / scale * 1e3, sigma_t_mk)
    name = "low_gain_netd_mk" if camera.gain == "low" and camera.low_gain_netd_mk else "netd_mk"
    seen = f"{whole * 1e3:.0f} mK at the centre of frames at {scene_k:.0f} K"
    steps = f", without steps of {step_k * 1e3:.0f} mK" if step_k > 0.0 else ""
    if camera.gain == "high" and netd > _LOW_GAIN * camera.netd_mk:
        steps += f"; {netd / camera.netd_mk:.1f} times the base's: low gain is likely"
    if frames == 1:
        return {name: Estimate(netd, error / scale * 1e3, f"{seen}, one frame: holds the fixed pattern{steps}")}
    how, lines = "finest detail of the flattest tenth of blocks", "; too high where the scene has such lines"
    if noise.static:
        how, lines = "differences of frames of a static camera", ""
    if noise.lively:
        how, lines = "of a changing scene, the tenth of blocks that changes least", "; too high as the scene changes"
    # A moving camera hides a correction.
    unseen = "" if noise.static else "; too low where a flat-field correction fell between them"
    found = {
        name: Estimate(netd, error / scale * 1e3, f"{seen}, {how}{steps}"),
        "sigma_tv_mk": Estimate(row, noise.row[1] / scale * 1e3, f"rows, new in each frame{lines}"),
        "sigma_th_mk": Estimate(column, noise.column[1] / scale * 1e3, f"columns, new in each frame{lines}"),
    }
    for key, uncertain, what in (
        ("sigma_v_mk", noise.fixed_row, "rows"),
        ("sigma_h_mk", noise.fixed_column, "columns"),
        ("sigma_vh_mk", noise.fixed_pixel, "single pixels"),
    ):
        assert uncertain is not None  # of several frames
        value, uncertainty = uncertain
        how = f"{what}, the same in all {frames} frames{unseen}"
        found[key] = Estimate(value / scale * 1e3, uncertainty / scale * 1e3, how)
    return found


def _rims_key(spectra: Spectra, noise: Noise, camera: Camera) -> dict[str, Estimate]:
    """{vignetting: Estimate} from the growth of noise towards the corners; empty if uncertain by more than a tenth."""
    light, half = (relative_illumination(replace(camera, vignetting=value)).astype(float) for value in (0.0, 0.5))
    rims = 2.0 * (1.0 - half / light)
    if noise.static:
        found = vignetting(spectra.changes, FLAT if noise.lively else 1.0, light, rims, 0.0)
    else:
        assert noise.fixed_pixel is not None  # of several frames
        found = vignetting(spectra.blocks, FLAT, light, rims, noise.fixed_pixel[0] ** 2)
    if found is None or found[1] > _WORST_VIGNETTING:
        return {}
    how = f"growth of noise towards the corners beside illumination_exponent = {camera.illumination_exponent:g}"
    return {"vignetting": Estimate(*found, how)}


def _field_keys(field: Field, noise: Noise, camera: Camera, scene_k: float, step_k: float) -> dict[str, Estimate]:
    """Estimates from the whole image: the drift of the scale of a static camera, or the shading of a moving one."""
    found: dict[str, Estimate] = {}
    replaced = field.replaced(np.sqrt(max(noise.pixel[0] ** 2 - step_k**2 / 12.0, 0.0)), step_k)
    if replaced:
        share, uncertainty = replaced
        found["bad_pixels"] = Estimate(min(share, 0.05), uncertainty, "pixels that are the mean of their neighbours")
    if noise.static:
        parts = zip(
            (noise.pixel, noise.row, noise.column), (field.shape[0] * field.shape[1], *field.shape), strict=True
        )
        known_k = float(np.linalg.norm([sigma / np.sqrt(n) for (sigma, _), n in parts]))
        drift = field.wander(camera.frame_rate_hz, known_k)
        # At the centre of frames, where noise of the detector is amplified least.
        scale = 1e3 / noise_scale(camera, scene_k) * float(np.median(relative_illumination(camera)))
        at = f"noise in the levels of frames, {camera.frame_rate_hz:g} a second as for the base camera"
        if drift:
            (white, error), (wander, wander_error) = drift
            found["sigma_t_mk"] = Estimate(white * scale, error * scale, f"white {at}")
            found["scale_drift_mk"] = Estimate(wander * scale, wander_error * scale, f"1/f {at}")
        return found
    shading = field.shading()
    if shading:
        slope = band_radiance_derivative(np.array([scene_k, NETD_REFERENCE_K]), *camera.band_um)
        scale = 1e3 * float(slope[0] / slope[1])
        how = "smooth part of the mean frame; too high where all views have the same gradient"
        found["shading_mk"] = Estimate(shading[0] * scale, shading[1] * scale, how)
        found["shading_mk_per_k"] = Estimate(0.0, 0.0, "included in shading_mk, at the camera's temperature")
    return found


def _refuse_beyond(path: Path, image: NDArray[Any], camera: Camera) -> None:
    """Refuse temperatures that are not kelvin, such as those of a scale in °C, and those above the camera's range."""
    # The median, since dead pixels may read 0.
    kelvin(f"the median temperature of {path}", float(np.nanmedian(image)))
    warmest, limit = float(np.nanmax(image)), camera.count_range_k[1]
    # Converters round, and cameras read a little beyond.
    if warmest > limit + _BEYOND_K:
        key = 'gain = "low", if it was taken so, or its own range_c' if camera.gain == "high" else "its own range"
        raise ThermorenderError(
            f"{path} holds {warmest - ZERO_CELSIUS_K:.0f} °C, and {camera.gain} gain of the base camera {camera.name} "
            f"ends at {limit - ZERO_CELSIUS_K:.0f} °C; give a base camera file with {key}"
        )


def _cut_off(image: NDArray[Any]) -> NDArray[np.bool_]:
    """Where pixels are at an end of their range, (H, W) bool: many have the same value, and few the next one."""
    found = np.zeros(image.shape, bool)
    values, counts = np.unique(image[np.isfinite(image)], return_counts=True)
    if len(values) < 2:
        return found
    for end, beside in ((0, 1), (-1, -2)):
        if counts[end] > 4 * counts[beside] + 32:
            found |= image == values[end]
    return found


def _blur_key(images: Sequence[NDArray[Any]], noise_k: float, camera: Camera) -> dict[str, Estimate]:
    """{blur_sigma_px: Estimate} from the sharpest edges; empty if there are too few."""
    from scipy.optimize import brentq

    widths = np.concatenate([edge_widths(image, noise_k) for image in images])
    found = sharpest(widths)
    if found is None:
        return {}
    width, uncertainty = found

    def excess(sigma: float, wanted: float) -> float:
        model = replace(camera, blur_sigma_px=sigma)
        return width_through(lambda frequency: otf(model, frequency) * np.sinc(frequency)) - wanted

    def sigma_of(wanted: float) -> float:
        if excess(0.0, wanted) >= 0.0:
            return 0.0
        return brentq(excess, 0.0, 5.0, args=(wanted,), xtol=1e-3) if excess(5.0, wanted) > 0.0 else 5.0

    value, low, high = (sigma_of(max(width + k * uncertainty, 0.0)) for k in (0, -1, 1))
    how = f"sharpest of {len(widths)} edges, {width:.2f} ± {uncertainty:.2f} px in total; too high where edges are soft"
    return {"blur_sigma_px": Estimate(value, 0.5 * (high - low), how)}


def _display_key(tails: NDArray[Any]) -> dict[str, Estimate]:
    """{agc_tails_percent: Estimate} from the colour scales in files of FLIR; empty without any."""
    if not len(tails):
        return {}
    middle = tuple(float(value) for value in np.minimum(np.median(tails, axis=0), 49.0))
    spread = float(np.median(np.abs(tails - middle)))
    return {"agc_tails_percent": Estimate(middle, spread, f"outside the colour scale of {len(tails)} pictures")}


def _step(image: NDArray[Any]) -> float:
    """The step between neighbouring values in a frame [K]; 0 if the values do not come from a converter."""
    values = np.unique(image[np.isfinite(image)])
    return float(np.median(np.diff(values))) if 1 < values.size < _MOST_LEVELS else 0.0
