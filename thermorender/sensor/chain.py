"""The camera from end to end: a radiance image to counts, in physical order.

`OPTICS` is what happens before a pixel warms up, `READOUT` what happens after it; between them stands the pixel's
response (`thermorender.sensor.detector`), which links frames and is kept by whoever makes a sequence of them. A
single frame is that of a camera at rest.

A flat-field correction makes the image of an even scene even: the signal of each pixel is divided by how much light
reaches it, and what the case itself sends is taken off as it was when the shutter was last closed. Noise arises
before that, so it grows towards the corners as the light falls; what the correction leaves does not. The shutter
stands behind the lens, so it takes off nothing of what the lens itself adds. Effects that a camera's file does not name
take no time.
"""

from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.sensor import noise, readout
from thermorender.sensor.camera import Camera
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import case_share, detector_irradiance, narcissus_ring, relative_illumination
from thermorender.sensor.psf import blur_of, blurred
from thermorender.sensor.wander import Wander
from thermorender.units import ZERO_CELSIUS_K


@dataclass(frozen=True)
class Moment:
    """When an image is taken.

    Attributes
    ----------
    index : int
        Number of the frame; with the seed it decides the noise.
    correction : int
        Number of the flat-field correction in force; with the seed it decides the fixed pattern.
    case_k, corrected_k : float
        Temperature of the case now, and when the correction was made [K].
    frozen : bool
        Whether the shutter is closed, so that the last image stands.
    time_s, corrected_s : float
        Since the camera was started, now and when the correction was made [s]; with the seed they decide what wanders.
    """

    index: int
    correction: int
    case_k: float
    corrected_k: float
    frozen: bool = False
    time_s: float = 0.0
    corrected_s: float = 0.0

    @property
    def drift_k(self):
        """How much the case has warmed since the correction [K]."""
        return self.case_k - self.corrected_k


def at_rest(camera, index=0):
    """Return the Moment of a frame taken right after a flat-field correction."""
    case_k = camera.case_temperature_c + ZERO_CELSIUS_K
    return Moment(index, 0, case_k, case_k)


def in_sequence(camera, index, elapsed_s):
    """Return the Moment of a frame `elapsed_s` [s] after the camera was started with a flat-field correction.

    The case warms by `case_rise_k` exponentially. Corrections follow at fixed intervals and freeze the image.
    """
    interval, frozen = camera.ffc_interval_s, False
    # The small share of a frame keeps one that falls on a correction from slipping before it.
    correction = int((elapsed_s + 1e-6) / interval) if interval else 0
    since = elapsed_s - correction * interval
    frozen = correction > 0 and since + 1e-6 < camera.ffc_duration_s

    def case_k(time_s):
        rise = -np.expm1(-time_s / camera.case_time_constant_s) * camera.case_rise_k
        return float(camera.case_temperature_c + ZERO_CELSIUS_K + rise)

    corrected_s = correction * interval
    # One that falls on a correction is at it, and not before it.
    time_s = max(float(elapsed_s), corrected_s)
    return Moment(index, correction, case_k(elapsed_s), case_k(corrected_s), frozen, time_s, corrected_s)


class Sensor:
    """One camera with one seed: what stays the same from frame to frame.

    Parameters
    ----------
    camera : Camera
    seed : int

    Attributes
    ----------
    illumination : (H, W) float32
        As by `relative_illumination`.
    """

    def __init__(self, camera: Camera, seed: int):
        self.camera, self.seed = camera, seed
        self.blur = None
        if camera.diffraction or camera.defocus_um or camera.blur_sigma_px:
            self.blur = blur_of(camera)
        self.illumination = relative_illumination(camera)
        self._pattern = (None, None)

    @cached_property
    def residual_responsivity(self):
        """How far the correction's gain lies off, over it, (H, W) float32; None where it does not."""
        return noise.residual_responsivity(self.camera, self.seed) if any(self.camera.responsivity_percent) else None

    @cached_property
    def flat_field_gain(self):
        """Gain of the flat-field correction: 1 over the illumination and what that lies off, (H, W) float32."""
        gain = 1.0 / self.illumination
        return gain if self.residual_responsivity is None else gain * (1.0 + self.residual_responsivity)

    @cached_property
    def irradiance_gain(self):
        """Irradiance by scene radiance, (H, W) float32 [sr]."""
        camera = self.camera
        on_axis = detector_irradiance(1.0, camera.f_number, camera.lens_transmittance)
        return np.float32(on_axis) * self.illumination

    @cached_property
    def case_share(self):
        """Share of what each pixel sees that is lens and housing, (H, W) float32."""
        return case_share(self.camera, self.illumination)

    @cached_property
    def stray(self):
        """Irradiance of narcissus ring and shading at the start, (H, W) float32 [W m⁻²]; None without them."""
        camera = self.camera
        if not (camera.narcissus_mk or camera.shading_mk):
            return None
        return self._irradiance_of(camera.narcissus_mk * narcissus_ring(camera) + camera.shading_mk * self._shading)

    @cached_property
    def stray_growth(self):
        """Growth of the shading with the case's temperature, (H, W) float32 [W m⁻² K⁻¹]."""
        return self._irradiance_of(self.camera.shading_mk_per_k * self._shading)

    @cached_property
    def _shading(self):
        """Shape of the shading as it is read after the flat-field correction, times the illumination, (H, W)."""
        shape = self.camera.height, self.camera.width
        return noise.smooth_field(shape, self.seed, noise.SHADING) * self.illumination

    def _irradiance_of(self, difference_mk):
        """Irradiance of apparent temperatures over 300 K, as the camera's lens would pass them, float32 [W m⁻²]."""
        camera = self.camera
        radiance = 1e-3 * band_radiance_derivative(noise.NETD_REFERENCE_K, *camera.band_um)
        per_mk = detector_irradiance(radiance, camera.f_number, camera.lens_transmittance)
        return np.float32(per_mk) * np.asarray(difference_mk, np.float32)

    @cached_property
    def drift(self):
        """Growth of the fixed pattern with the case's temperature, (H, W) float32 [W/K]."""
        return noise.drift_pattern(self.camera, self.seed)

    @cached_property
    def replacement(self):
        """(bad pixels (n,), their good neighbours (n, 8), and these neighbours' weights (n, 8) float32)."""
        return _replacement(noise.bad_pixels(self.camera, self.seed), self.camera.height, self.camera.width)

    @cached_property
    def wander(self):
        """The Wander of what changes from one flat-field correction to the next."""
        return Wander(self.camera, self.seed)

    def pattern(self, moment):
        """Return the fixed pattern that a flat-field correction leaves, (H, W) float32 [W].

        Pixels whose gain lies off are right at the shutter's own temperature.
        """
        made = moment.correction, moment.corrected_k
        if self._pattern[0] != made:
            pattern = noise.fixed_pattern(self.camera, self.seed, moment.correction)
            if self.residual_responsivity is not None:
                pattern -= np.float32(self._shutter_power(moment.corrected_k)) * self.residual_responsivity
            self._pattern = (made, pattern)
        return self._pattern[1]

    def _shutter_power(self, kelvin):
        """Absorbed power of a shutter as if it were a scene, in the middle of the image [W]."""
        camera = self.camera
        radiance = band_radiance(kelvin, *camera.band_um)
        return absorbed_power(detector_irradiance(radiance, camera.f_number, camera.lens_transmittance), camera)

    def blurred(self, radiance):
        """Return a radiance image as the lens blurs it, (H, W) float32: the first stage alone."""
        return point_spread(np.asarray(radiance, np.float32), self, None)

    def power(self, radiance, moment, blurred=False):
        """Return the absorbed power of a radiance image, (H, W) float32 [W]; with `blurred`, of a blurred one."""
        return _through(OPTICS[blurred:], np.array(radiance, np.float32), self, moment)

    def power_law(self, moment):
        """Return (power without a scene [W], power by its radiance, blurred [W m² sr W⁻¹]), (H, W) float32 each."""
        none, one = (np.full(self.illumination.shape, value, np.float32) for value in (0.0, 1.0))
        none, one = (self.power(image, moment, blurred=True) for image in (none, one))
        return none, one - none

    def counts(self, signal, moment):
        """Return the counts of a signal [W] that the pixels have warmed up to, (H, W) uint16."""
        return _through(READOUT, signal.copy(), self, moment)

    def counts_at_rest(self, radiance, index=0):
        """Return the counts of a camera at rest, right after a flat-field correction, (H, W) uint16."""
        moment = at_rest(self.camera, index)
        return _through(READOUT, self.power(radiance, moment), self, moment)


@lru_cache(maxsize=4)
def sensor_of(camera, seed):
    """Return the Sensor of a camera and seed, the same one each time."""
    return Sensor(camera, seed)


def point_spread(image, sensor, moment):
    """Radiance as the lens blurs it. The pixels' own area is in the image already."""
    return blurred(image, sensor.blur)


def irradiance(image, sensor, moment):
    """Irradiance on the detector by the scene, less towards the corners."""
    image *= sensor.irradiance_gain
    return image


def case_emission(image, sensor, moment):
    """Add what lens and case send, as far as it has changed since the shutter was closed and is not compensated."""
    camera = sensor.camera
    if camera.housing_residual and moment.drift_k:
        then, now = band_radiance(np.array([moment.corrected_k, moment.case_k]), *camera.band_um)
        image += np.float32(camera.housing_residual * np.pi * (now - then)) * sensor.case_share
    return image


def stray_light(image, sensor, moment):
    """Add narcissus and shading of the lens; the shutter stands behind it, so they are not corrected."""
    if sensor.stray is not None:
        image += sensor.stray
    risen_k = moment.case_k - sensor.camera.case_temperature_c - ZERO_CELSIUS_K
    if sensor.camera.shading_mk_per_k and risen_k:
        image += np.float32(risen_k) * sensor.stray_growth
    return image


def absorption(image, sensor, moment):
    """Power that heats the pixels."""
    image *= np.float32(absorbed_power(1.0, sensor.camera))
    return image


def temporal_noise(image, sensor, moment):
    """Add what is new in each frame."""
    image += noise.temporal_noise(sensor.camera, sensor.seed, moment.index)
    return image


def wandering(image, sensor, moment):
    """Add what has wandered since the correction: 1/f noise of pixels and of the whole scale, pixels that blink."""
    import cv2

    camera, span = sensor.camera, (moment.corrected_s, moment.time_s)
    if moment.time_s == moment.corrected_s:
        return image
    if camera.flicker_mk:
        for share, values in sensor.wander.flicker(*span):
            image = cv2.scaleAdd(values, share, image, dst=image)
    if camera.scale_drift_mk:
        image += np.float32(sensor.wander.scale_drift(*span))
    if camera.blinking_pixels:
        image.reshape(-1)[sensor.wander.blinking_pixels] += sensor.wander.blinking(*span)
    return image


def flat_field(image, sensor, moment):
    """Divide by how much light reaches each pixel."""
    image *= sensor.flat_field_gain
    return image


def fixed_pattern(image, sensor, moment):
    """Add what the correction left, and what has drifted since."""
    image += sensor.pattern(moment)
    if moment.drift_k:
        image += np.float32(moment.drift_k) * sensor.drift
    return image


def bad_pixels(image, sensor, moment):
    """Put the mean of the good neighbours where a pixel is dead or hot."""
    if sensor.camera.bad_pixels:
        bad, neighbours, weights = sensor.replacement
        flat = image.reshape(-1)
        flat[bad] = (flat[neighbours] * weights).sum(axis=1)
    return image


def analogue_to_digital(image, sensor, moment):
    """Counts, linear in irradiance."""
    return readout.digitised(image, sensor.camera)


def temperature_linear(image, sensor, moment):
    """Counts, linear in apparent temperature where the camera says so."""
    return readout.temperature_linear(image, sensor.camera)


OPTICS = (point_spread, irradiance, case_emission, stray_light, absorption)
READOUT = (
    temporal_noise, wandering, flat_field, fixed_pattern, bad_pixels, analogue_to_digital, temperature_linear,
)  # fmt: skip


def _through(stages, image, sensor, moment):
    for stage in stages:
        image = stage(image, sensor, moment)
    return image


def _replacement(bad, height, width):
    row, column = np.divmod(bad, width)
    steps = np.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j])
    rows, columns = row[:, None] + steps[:, 0], column[:, None] + steps[:, 1]
    inside = (rows >= 0) & (rows < height) & (columns >= 0) & (columns < width)
    neighbours = np.where(inside, rows * width + columns, 0)
    good = inside & ~np.isin(neighbours, bad)
    # A pixel walled in by bad ones takes their mean; at up to 5 % bad this is rare.
    weights = np.where(good.any(axis=1, keepdims=True), good, inside).astype(np.float32)
    return bad, neighbours, weights / weights.sum(axis=1, keepdims=True)
