"""Temperatures as a TIFF of float32 kelvin, with a position on the map where there is one."""

from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.formats import atomic_raster


def write_kelvin(
    path: str | PathLike[str], kelvin: NDArray[np.float32], crs: Any = None, transform: Any = None,
    name: str = "apparent temperature", unit: str = "K",
) -> None:  # fmt: skip
    """Write (h, w) temperatures [K] as a TIFF that states their name and unit; NaN is declared as no data."""
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    profile = {
        "driver": "GTiff", "height": kelvin.shape[0], "width": kelvin.shape[1], "count": 1, "dtype": "float32",
        "nodata": np.nan, "compress": "deflate",
        # That of floats is a little smaller where temperatures are smooth, but fewer programs decode it.
        "predictor": 2,
    }  # fmt: skip
    if crs is not None:
        profile |= {"crs": crs, "transform": transform, "tiled": True}
    with warnings.catch_warnings():
        # The image of a camera has no place on the map.
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with atomic_raster(path) as part, rasterio.open(part, "w", **profile) as file:
            file.write(kelvin, 1)
            file.descriptions, file.units = (name,), (unit,)
