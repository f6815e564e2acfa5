"""The camera from end to end: a radiance image to counts, in physical order.

`OPTICS` holds the stages before the pixel's response (`thermorender.sensor.detector`), `READOUT` those after. A single
frame is that of a camera at rest.

A flat-field correction divides the signal by its relative illumination and subtracts the emission of the case at the
last shutter. Noise arises before it and so grows towards the corners; its residual does not. The shutter is behind the
lens, so it does not correct what the lens adds. Effects without a key in the camera's file take no time.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import noise, photons, readout
from thermorender.sensor.camera import Camera, Image
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import case_share, detector_irradiance, narcissus_ring, relative_illumination
from thermorender.sensor.psf import Blur, blur_of, blurred
from thermorender.sensor.wander import Wander
from thermorender.units import ZERO_CELSIUS_K


@dataclass(frozen=True)
class Moment:
    """The state of the camera when an image is taken."""

    index: int  # Number of the frame; with the seed it determines the noise
    correction: int  # Number of the last flat-field correction; with the seed it determines the fixed pattern
    # case_k, corrected_k: Temperature of the case now, and at the correction [K]
    case_k: float
    corrected_k: float
    frozen: bool = False  # Whether the shutter is closed and the last image is repeated
    # time_s, corrected_s: Time since the start of the camera, now and at the correction [s]; with the seed they
    # determine the drift
    time_s: float = 0.0
    corrected_s: float = 0.0

    @property
    def drift_k(self) -> float:
        """Warming of the case since the correction [K]."""
        return self.case_k - self.corrected_k


def at_rest(camera: Camera, index: int = 0) -> Moment:
    """Return the Moment of a frame taken right after a flat-field correction."""
    case_k = camera.case_temperature_c + ZERO_CELSIUS_K
    return Moment(index, 0, case_k, case_k)


def in_sequence(camera: Camera, index: int, elapsed_s: float) -> Moment:
    """Return the Moment of a frame `elapsed_s` [s] after the start, at which the flat field was corrected.

    The case warms by `case_rise_k` exponentially. Corrections follow at fixed intervals and freeze the image.
    """
    interval = camera.ffc_interval_s
    # The small margin assigns a frame at the time of a correction to that correction despite rounding.
    correction = int((elapsed_s + 1e-6) / interval) if interval else 0
    since = elapsed_s - correction * interval
    frozen = correction > 0 and since + 1e-6 < camera.ffc_duration_s

    def case_k(time_s: float) -> float:
        rise = -np.expm1(-time_s / camera.case_time_constant_s) * camera.case_rise_k
        return float(camera.case_temperature_c + ZERO_CELSIUS_K + rise)

    corrected_s = correction * interval
    # The same margin: not before the correction.
    time_s = max(float(elapsed_s), corrected_s)
    return Moment(index, correction, case_k(elapsed_s), case_k(corrected_s), frozen, time_s, corrected_s)


class Sensor:
    """One camera with one seed: everything that is constant from frame to frame."""

    def __init__(self, camera: Camera, seed: int) -> None:
        self.camera, self.seed = camera, seed
        self.blur: Blur | None = None
        if camera.diffraction or camera.defocus_um or camera.blur_sigma_px:
            self.blur = blur_of(camera)
        self.illumination = relative_illumination(camera)
        self._pattern: tuple[tuple[int, float], Image] | None = None

    @cached_property
    def residual_responsivity(self) -> Image | None:
        """Relative error of the correction's gain, (H, W) float32; None without such an error."""
        return noise.residual_responsivity(self.camera, self.seed) if any(self.camera.responsivity_percent) else None

    @cached_property
    def flat_field_gain(self) -> Image:
        """Gain of the flat-field correction: 1 over the illumination, with its error, (H, W) float32."""
        gain = 1.0 / self.illumination
        return gain if self.residual_responsivity is None else gain * (1.0 + self.residual_responsivity)

    @cached_property
    def irradiance_gain(self) -> Image:
        """Irradiance over scene radiance, (H, W) float32 [sr]."""
        camera = self.camera
        on_axis = detector_irradiance(1.0, camera.f_number, camera.lens_transmittance)
        return np.float32(on_axis) * self.illumination

    @cached_property
    def case_share(self) -> Image:
        """Share of each pixel's hemisphere that is lens and housing, (H, W) float32."""
        return case_share(self.camera, self.illumination)

    @cached_property
    def stray(self) -> Image | None:
        """Irradiance of narcissus ring and shading at the start, (H, W) float32 [W m⁻²]; None without them."""
        camera = self.camera
        if not (camera.narcissus_mk or camera.shading_mk):
            return None
        return self._irradiance_of(camera.narcissus_mk * narcissus_ring(camera) + camera.shading_mk * self._shading)

    @cached_property
    def stray_growth(self) -> Image:
        """Growth of the shading with the case's temperature, (H, W) float32 [W m⁻² K⁻¹]."""
        return self._irradiance_of(self.camera.shading_mk_per_k * self._shading)

    @cached_property
    def _shading(self) -> Image:
        """Shape of the shading after the flat-field correction, times the illumination, (H, W)."""
        shape = self.camera.height, self.camera.width
        return noise.smooth_field(shape, self.seed, noise.SHADING) * self.illumination

    def _irradiance_of(self, difference_mk: ArrayLike) -> Image:
        """Irradiance behind the lens of apparent temperature differences at 300 K, float32 [W m⁻²]."""
        camera = self.camera
        radiance = 1e-3 * band_radiance_derivative(noise.NETD_REFERENCE_K, *camera.band_um)
        per_mk = detector_irradiance(radiance, camera.f_number, camera.lens_transmittance)
        return np.float32(per_mk) * np.asarray(difference_mk, np.float32)

    @cached_property
    def drift(self) -> Image:
        """Growth of the fixed pattern with the case's temperature, (H, W) float32 [W/K]."""
        return noise.drift_pattern(self.camera, self.seed)

    @cached_property
    def replacement(self) -> tuple[NDArray[np.int64], NDArray[np.int64], Image]:
        """(bad pixels (n,), their neighbours (n, 8), weights of the neighbours (n, 8) float32)."""
        return _replacement(noise.bad_pixels(self.camera, self.seed), self.camera.height, self.camera.width)

    @cached_property
    def wander(self) -> Wander:
        """The drift between flat-field corrections."""
        return Wander(self.camera, self.seed)

    def pattern(self, moment: Moment) -> Image:
        """Return the fixed pattern after a flat-field correction, (H, W) float32 [W], for gains set at the shutter."""
        made = moment.correction, moment.corrected_k
        if self._pattern is None or self._pattern[0] != made:
            pattern = noise.fixed_pattern(self.camera, self.seed, moment.correction)
            if self.residual_responsivity is not None:
                pattern -= np.float32(self._shutter_power(moment.corrected_k)) * self.residual_responsivity
            self._pattern = (made, pattern)
        return self._pattern[1]

    @cached_property
    def beyond_counts(self) -> float:
        """A power that stays above the highest count, corrected or averaged with its neighbours [W]."""
        return 1e3 * self._shutter_power(self.camera.count_range_k[1])

    def _shutter_power(self, temperature_k: float) -> float:
        """Absorbed power of the shutter, as if it were a scene, at the image centre [W]."""
        camera = self.camera
        radiance = band_radiance(temperature_k, *camera.band_um)
        return absorbed_power(detector_irradiance(radiance, camera.f_number, camera.lens_transmittance), camera)

    def blurred(self, radiance: ArrayLike) -> Image:
        """Return a radiance image blurred by the lens, (H, W) float32: the first stage alone."""
        return blurred(np.asarray(radiance, np.float32), self.blur)

    def power(self, radiance: ArrayLike, moment: Moment, blurred: bool = False) -> Image:
        """Return the absorbed power of a radiance image, (H, W) float32 [W]; with `blurred`, of a blurred one."""
        return _through(OPTICS[blurred:], np.array(radiance, np.float32), self, moment)

    def power_law(self, moment: Moment) -> tuple[Image, Image]:
        """Return (power without a scene [W], power over blurred radiance [W m² sr W⁻¹]), (H, W) float32 each."""
        images = (np.full(self.illumination.shape, value, np.float32) for value in (0.0, 1.0))
        none, one = (self.power(image, moment, blurred=True) for image in images)
        return none, one - none

    def counts(self, signal: Image, moment: Moment) -> NDArray[np.uint16]:
        """Return the counts of the pixels' signal [W], (H, W) uint16."""
        return _through(READOUT, signal.copy(), self, moment)

    def counts_at_rest(self, radiance: ArrayLike, index: int = 0) -> NDArray[np.uint16]:
        """Return the counts of a camera at rest, right after a flat-field correction, (H, W) uint16."""
        moment = at_rest(self.camera, index)
        return _through(READOUT, self.power(radiance, moment), self, moment)


@lru_cache(maxsize=4)
def sensor_of(camera: Camera, seed: int) -> Sensor:
    """Return the Sensor of a camera and seed, the same one each time."""
    return Sensor(camera, seed)


def point_spread(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Radiance blurred by the lens. The image already contains the pixel aperture."""
    return blurred(image, sensor.blur)


def irradiance(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Irradiance on the detector by the scene, which decreases towards the corners."""
    image *= sensor.irradiance_gain
    return image


def case_emission(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Add the uncompensated change of the emission of lens and case since the last correction."""
    camera = sensor.camera
    if camera.housing_residual and moment.drift_k:
        then, now = band_radiance(np.array([moment.corrected_k, moment.case_k]), *camera.band_um)
        image += np.float32(camera.housing_residual * np.pi * (now - then)) * sensor.case_share
    return image


def stray_light(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Add narcissus and shading of the lens; the shutter is behind it, so they are not corrected."""
    if sensor.stray is not None:
        image += sensor.stray
    risen_k = moment.case_k - sensor.camera.case_temperature_c - ZERO_CELSIUS_K
    if sensor.camera.shading_mk_per_k and risen_k:
        image += np.float32(risen_k) * sensor.stray_growth
    return image


def absorption(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Power on the pixels."""
    image *= np.float32(absorbed_power(1.0, sensor.camera))
    return image


def temporal_noise(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Add the noise that is new in each frame. A full well of a photon detector gets a power beyond all counts."""
    camera = sensor.camera
    if not camera.well_electrons:
        image += noise.temporal_noise(camera, sensor.seed, moment.index)
        return image
    electrons, per_watt, sigma = photons.collected(image, sensor.illumination, camera)
    added = noise.temporal_noise(camera, sensor.seed, moment.index, sigma.astype(np.float32))
    image += added
    image[electrons + added * per_watt >= camera.well_electrons] = sensor.beyond_counts
    return image


def wandering(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Add the drift since the correction: 1/f noise of pixels and of the whole scale, blinking pixels."""
    import cv2

    camera, span = sensor.camera, (moment.corrected_s, moment.time_s)
    if moment.time_s == moment.corrected_s:
        return image
    if camera.flicker_mk:
        for share, values in sensor.wander.flicker(*span):
            image = np.asarray(cv2.scaleAdd(values, share, image, dst=image), np.float32)
    if camera.scale_drift_mk:
        image += np.float32(sensor.wander.scale_drift(*span))
    if camera.blinking_pixels:
        image.reshape(-1)[sensor.wander.blinking_pixels] += sensor.wander.blinking(*span)
    return image


def flat_field(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Divide by the relative illumination of each pixel."""
    image *= sensor.flat_field_gain
    return image


def fixed_pattern(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Add the residual of the correction, and its drift since."""
    image += sensor.pattern(moment)
    if moment.drift_k:
        image += np.float32(moment.drift_k) * sensor.drift
    return image


def bad_pixels(image: Image, sensor: Sensor, moment: Moment) -> Image:
    """Replace dead and hot pixels by the mean of their good neighbours."""
    if sensor.camera.bad_pixels:
        bad, neighbours, weights = sensor.replacement
        flat = image.reshape(-1)
        flat[bad] = (flat[neighbours] * weights).sum(axis=1)
    return image


def analogue_to_digital(image: Image, sensor: Sensor, moment: Moment) -> NDArray[np.uint16]:
    """Counts, linear in irradiance."""
    return readout.digitised(image, sensor.camera)


def temperature_linear(image: NDArray[np.uint16], sensor: Sensor, moment: Moment) -> NDArray[np.uint16]:
    """Counts, linear in apparent temperature if the camera has this mode."""
    return readout.temperature_linear(image, sensor.camera)


# Stages (image, Sensor, Moment) → image, which may overwrite their argument.
Stage = Callable[[Any, Sensor, Moment], Any]
OPTICS: tuple[Stage, ...] = (point_spread, irradiance, case_emission, stray_light, absorption)
READOUT: tuple[Stage, ...] = (
    temporal_noise, wandering, flat_field, fixed_pattern, bad_pixels, analogue_to_digital, temperature_linear,
)  # fmt: skip


def _through(stages: Sequence[Stage], image: Any, sensor: Sensor, moment: Moment) -> Any:
    for stage in stages:
        image = stage(image, sensor, moment)
    return image


def _replacement(bad: NDArray[np.int64], height: int, width: int) -> tuple[NDArray[np.int64], NDArray[np.int64], Image]:
    """As `Sensor.replacement`."""
    row, column = np.divmod(bad, width)
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    rows, columns = row[:, None] + steps[:, 0], column[:, None] + steps[:, 1]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    neighbours = np.where(inside, rows * width + columns, 0)
    good = inside & ~np.isin(neighbours, bad)
    # A pixel with bad neighbours only takes their mean; at up to 5 % bad this is rare.
    weights = np.where(good.any(axis=1, keepdims=True), good, inside).astype(np.float32)
    return bad, neighbours, weights / weights.sum(axis=1, keepdims=True)
