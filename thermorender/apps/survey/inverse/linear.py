"""The unit of the solution: band radiance scaled to kelvin, in which a pixel is exactly a mean of texels."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from thermorender.physics.band import RadianceTable
from thermorender.physics.planck import band_radiance, band_radiance_derivative

Floats = NDArray[np.float64]
# Temperatures of surfaces [K]; other values are not those of a scene.
RANGE_K = (150.0, 700.0)


@dataclass(frozen=True)
class LinearKelvin:
    """Band radiance scaled to kelvin at a reference temperature, for temperatures in `RANGE_K`."""

    band_um: tuple[float, float]
    reference_k: float

    def of(self, kelvin: NDArray[np.floating]) -> Floats:
        """Return linear kelvin of temperatures [K]; NaN stays, and is given outside the range."""
        return self.of_radiance(self._table(kelvin))

    def of_radiance(self, radiance: NDArray[np.floating]) -> Floats:
        """Return linear kelvin of band radiances [W m⁻² sr⁻¹]."""
        zero = band_radiance(self.reference_k, *self.band_um)
        return self.reference_k + (np.asarray(radiance, np.float64) - zero) / self.slope

    def radiance(self, linear: Floats) -> Floats:
        """Return band radiances [W m⁻² sr⁻¹] of linear kelvin."""
        zero = band_radiance(self.reference_k, *self.band_um)
        return np.asarray(zero + (linear - self.reference_k) * self.slope)

    def kelvin(self, linear: Floats) -> Floats:
        """Return temperatures [K] of linear kelvin; NaN outside the range."""
        return self._table.inverse(self.radiance(linear))

    def kelvin_per_linear(self, kelvin: Floats) -> Floats:
        """Return the change of temperature with linear kelvin, at temperatures [K]."""
        return np.asarray((self.kelvin(self.of(kelvin) + 0.05) - self.kelvin(self.of(kelvin) - 0.05)) / 0.1)

    @cached_property
    def slope(self) -> float:
        """Band radiance per kelvin at the reference temperature."""
        return float(band_radiance_derivative(self.reference_k, *self.band_um))

    @cached_property
    def _table(self) -> RadianceTable:
        return RadianceTable.of(np.ones_like, *RANGE_K, *self.band_um)
