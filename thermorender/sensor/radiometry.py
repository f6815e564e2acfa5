"""The reading of thermography software: the camera's temperature formula, with corrections for surface and air.

A radiometric camera converts its signal S to kelvin by T = B / ln(R1 / (R2 (S + O)) + F), a Planck-like curve fitted
at the factory. The software first subtracts the radiation that does not come from the surface: the reflection of the
surroundings (emissivity, reflected temperature), and the emission of the air and of a window before the lens. It
assumes one emissivity, one distance and one air for the whole image, so it is wrong where the truth differs.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance, band_radiance_derivative
from thermorender.schema import Where, checked, key, number, read
from thermorender.sensor.camera import Camera
from thermorender.sensor.readout import radiance_from_counts
from thermorender.units import ZERO_CELSIUS_K

# Bands of long-wave cameras [µm], for which the constants of an `AirModel` were fitted.
_AIR_UM = (7.0, 15.0)


@dataclass(frozen=True)
class PlanckConstants:
    """Constants of a camera's temperature formula, with FLIR's names.

    Attributes
    ----------
    r1, r2, o : float
        In units of the signal (r1) or of one (r2); o is added to the signal.
    b : float
        [K]
    f : float
    """

    r1: float
    b: float
    f: float
    o: float
    r2: float = 1.0

    def temperature(self, signal: ArrayLike) -> NDArray[np.float64]:
        """Return the temperature [K] of a blackbody with this signal; NaN below the formula's zero."""
        signal = np.asarray(signal, np.float64) + self.o
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = self.r1 / (self.r2 * signal) + self.f
            return np.where((signal > 0.0) & (ratio > 1.0), self.b / np.log(ratio), np.nan)[()]

    def signal(self, temperature: ArrayLike) -> NDArray[np.float64]:
        """Return the signal of a blackbody at a temperature [K]; the inverse of `temperature`."""
        return self.r1 / (self.r2 * (np.exp(self.b / np.asarray(temperature, np.float64)) - self.f)) - self.o


@dataclass(frozen=True)
class AirModel:
    """Constants of FLIR's transmittance of air; nearly every radiometric JPEG holds the defaults.

    Notes
    -----
    τ = X exp(−√d (α₁ + β₁ √ω)) + (1 − X) exp(−√d (α₂ + β₂ √ω)), with d in metres and the density of water vapour
    ω in g m⁻³. Minkina & Dudzik, Infrared Thermography: Errors and Uncertainties, Wiley 2009,
    doi:10.1002/9780470682234, appendix on the ThermaCAM model.
    """

    alpha1: float = 0.006569
    alpha2: float = 0.012620
    beta1: float = -0.002276
    beta2: float = -0.006670
    x: float = 1.9

    def transmittance(self, air_c: float, humidity: float, distance_m: float) -> float:
        """Return the transmittance that the software assumes, between 0 and 1.

        Parameters
        ----------
        air_c : float
            Temperature of the air [°C].
        humidity : float
            Relative humidity, 0 … 1.
        distance_m : float
            Between camera and surface [m].
        """
        root, path = np.sqrt(water_vapour(air_c, humidity)), np.sqrt(distance_m)
        first = np.exp(-path * (self.alpha1 + self.beta1 * root))
        second = np.exp(-path * (self.alpha2 + self.beta2 * root))
        # In very humid air the exponents change sign and the formula leaves 0 … 1.
        return float(np.clip(self.x * first + (1.0 - self.x) * second, 0.0, 1.0))


def water_vapour(air_c: ArrayLike, humidity: float) -> NDArray[np.float64]:
    """Return the density of water vapour [g m⁻³] of air at a temperature [°C] and relative humidity (0 … 1).

    Notes
    -----
    The cubic of the same source as `AirModel`; within 3 % of saturated vapour from −10 to 40 °C.
    """
    t = np.asarray(air_c, np.float64)
    return humidity * np.exp(1.5587 + t * (6.939e-2 + t * (-2.7816e-4 + t * 6.8455e-7)))


@dataclass(frozen=True)
class ThermographySettings:
    """Settings of thermography software for surface, air and window; the defaults correct nothing.

    Attributes
    ----------
    emissivity : float
        Of every surface, above 0, up to 1.
    reflected_c : float
        Apparent temperature of the surroundings that surfaces reflect [°C].
    air_c : float
        Temperature of the air [°C].
    humidity : float
        Relative, 0 … 1.
    distance_m : float
        To every surface [m].
    window_c, window_transmittance : float
        A window before the lens: its temperature [°C] and transmittance.
    """

    emissivity: float = key(number(1e-3, 1.0), 1.0)
    reflected_c: float = key(number(-ZERO_CELSIUS_K + 1.0, 5000.0), 20.0)
    air_c: float = key(number(-100.0, 100.0), 20.0)
    humidity: float = key(number(0.0, 1.0), 0.5)
    distance_m: float = key(number(0.0, 1e6), 0.0)
    window_c: float = key(number(-100.0, 1000.0), 20.0)
    window_transmittance: float = key(number(1e-3, 1.0), 1.0)

    def __post_init__(self) -> None:
        checked(self, "thermography")

    @classmethod
    def parse(cls, text: str) -> "ThermographySettings":
        """Return the settings in a text such as "emissivity=0.95,air_c=15,distance_m=100"."""
        where, values = Where("thermography"), dict[str, float | str]()
        for part in filter(None, (part.strip() for part in text.split(","))):
            name, _, value = (piece.strip() for piece in part.partition("="))
            if name in values:
                raise where.error(f"key {name!r} is given twice; give it once")
            try:
                values[name] = float(value)
            except ValueError:
                values[name] = value
        return read(cls, values, where)


def thermography_temperature(
    signal: ArrayLike, planck: PlanckConstants, settings: ThermographySettings, air: AirModel | None = None
) -> NDArray[np.float64]:
    """Return the reading of thermography software, in the shape of `signal` [K]; NaN where the formula has no value.

    Parameters
    ----------
    signal : array
        In the units of `planck`: raw counts of a file, or band radiance [W m⁻² sr⁻¹] with `fitted_constants`.
    planck : PlanckConstants
    settings : ThermographySettings
    air : AirModel, optional

    Notes
    -----
    S = τ_w [τ (ε S(T) + (1−ε) S(T_refl)) + (1−τ) S(T_air)] + (1−τ_w) S(T_window), solved for T. The shares sum to
    one, so the constant O matters only in the formula itself.
    """
    tau = (air or AirModel()).transmittance(settings.air_c, settings.humidity, settings.distance_m)
    if tau < 1e-3:
        raise ThermorenderError(
            f"thermography: distance_m={settings.distance_m:g} leaves {tau:.1g} of the radiation; give a shorter one"
        )
    reflected, air_glow, window = (
        planck.signal(celsius + ZERO_CELSIUS_K) for celsius in (settings.reflected_c, settings.air_c, settings.window_c)
    )
    behind = (np.asarray(signal, np.float64) - (1.0 - settings.window_transmittance) * window) / (
        settings.window_transmittance
    )
    left = (behind - (1.0 - tau) * air_glow) / tau
    return planck.temperature((left - (1.0 - settings.emissivity) * reflected) / settings.emissivity)


def thermography_reading(
    counts: NDArray[np.uint16], camera: Camera, settings: ThermographySettings
) -> NDArray[np.float32]:
    """Return the reading of thermography software from a frame's counts, (H, W) float32 [K].

    Parameters
    ----------
    counts : (H, W) uint16
    camera : Camera
    settings : ThermographySettings
    """
    if settings.distance_m and not _AIR_UM[0] <= camera.band_um[0] < camera.band_um[1] <= _AIR_UM[1]:
        raise ThermorenderError(
            f"thermography: distance_m={settings.distance_m:g} asks for the air of FLIR's formula, which holds for "
            f"{_AIR_UM[0]:g}…{_AIR_UM[1]:g} µm, and camera {camera.name} sees {camera.band_um[0]:g}–"
            f"{camera.band_um[1]:g} µm; give distance_m=0"
        )
    # A table by count, since there are fewer counts than pixels.
    signal = radiance_from_counts(np.arange(int(counts.max()) + 1), camera)
    return thermography_temperature(signal, camera_constants(camera), settings).astype(np.float32)[counts]


def camera_constants(camera: Camera) -> PlanckConstants:
    """Return the PlanckConstants of a Camera, fitted to its band over the range of its gain."""
    return fitted_constants(tuple(camera.band_um), *camera.count_range_k)


@lru_cache(maxsize=32)
def fitted_constants(band_um: tuple[float, float], coldest: float, warmest: float) -> PlanckConstants:
    """Return the PlanckConstants of a flat band, with band radiance [W m⁻² sr⁻¹] as the signal.

    Parameters
    ----------
    band_um : (2,) tuple of floats
        Limits of the band [µm].
    coldest, warmest : float
        Span of the fit [K].

    Notes
    -----
    Least squares of the temperature error at 191 temperatures. The largest error over 7.5–13.5 µm is 72 mK for
    233–423 K, and 34 mK for the −25…135 °C of a high gain range. A camera's factory fit has similar errors.
    """
    from scipy.optimize import least_squares

    temperature = np.linspace(coldest, warmest, 191)
    radiance = band_radiance(temperature, *band_um)
    weight = 1.0 / band_radiance_derivative(temperature, *band_um)

    def linear(b: float, f: float) -> tuple[NDArray[Any], NDArray[Any]]:
        # R and O are linear, so they are solved for exactly at each b and f.
        basis = np.stack([1.0 / (np.exp(b / temperature) - f), -np.ones_like(temperature)], axis=-1)
        values = np.linalg.lstsq(basis * weight[:, None], radiance * weight, rcond=None)[0]
        return values, (basis @ values - radiance) * weight

    start = 14388.0 / (0.5 * sum(band_um)), 1.0
    found = least_squares(lambda p: linear(*p)[1], start, x_scale=(100.0, 1.0), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    (r, o), _ = linear(*found.x)
    return PlanckConstants(r1=float(r), b=float(found.x[0]), f=float(found.x[1]), o=float(o))
