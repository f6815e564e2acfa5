"""Per-texel deviations of a terrain from the tabulated properties of its materials."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError


@dataclass(frozen=True, eq=False)
class Deviations:
    """Factors on what the tables give, per texel of the terrain: 1 is the table itself."""

    # (H, W) on the reflectance of sunlight; the absorptance that is left stays within 0.02…0.98
    reflectance: NDArray[np.float32]
    wetness: NDArray[np.float32]  # (H, W) on the moisture available to evaporation, up to 1
    exchange: NDArray[np.float32]  # (H, W) on the turbulent exchange with the air, where it is neutral
    inertia: NDArray[np.float32]  # (H, W) on the thermal inertia √(kρc): of all layers' capacities and conductances

    def columns(self, texels: int) -> NDArray[np.float32]:
        """Return (4, texels) float32: the factors in the order above, row by row of the terrain."""
        for name, values in vars(self).items():
            if np.size(values) != texels:
                raise ThermorenderError(
                    f"deviations.{name} has {np.size(values)} texels and the terrain {texels}; give one factor for each"
                )
            if not (np.isfinite(values).all() and np.min(values) > 0.0):
                raise ThermorenderError(f"deviations.{name} holds a factor not above 0; 1 leaves a texel as it is")
        return np.array([np.ravel(values) for values in vars(self).values()], dtype=np.float32)
