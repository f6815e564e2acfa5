"""Frames and orthoimages as xarray objects, with coordinates, units and the coordinate reference system."""

import json
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.frame.record import UNITS, header
from thermorender.frame.save import images
from thermorender.scene import surface

if TYPE_CHECKING:
    import xarray as xr

    from thermorender.frame.frame import Frame
    from thermorender.frame.orthoimage import Orthoimage

# Meaning of each flag of the truth's mask, in the order of their bits.
_FLAGS = "SURFACE FILLED FALLBACK SATURATED BACKGROUND UNKNOWN UNMOVED BEHIND"


def _xarray() -> Any:
    try:
        import xarray
    except ImportError:
        raise ThermorenderError(
            "to_xarray needs xarray, which is not installed; install it with: pip install 'thermorender[xarray]'"
        ) from None
    return xarray


def _crs_attributes(crs: Any) -> dict[str, str]:
    # As the CF conventions and rioxarray name them.
    return {"crs_wkt": crs.to_wkt(), "spatial_ref": crs.to_wkt()}


def of_orthoimage(image: "Orthoimage") -> "xr.DataArray":
    """Return the DataArray of an Orthoimage."""
    x, _ = image.grid.to_map(np.arange(image.grid.width) + 0.5, 0.0)
    _, y = image.grid.to_map(0.0, np.arange(image.grid.height) + 0.5)
    unit = "degrees" if image.grid.crs.is_geographic else image.grid.crs.linear_units
    array: xr.DataArray = _xarray().DataArray(
        image.kelvin, dims=("y", "x"), name="apparent_temperature",
        coords={
            "x": ("x", x, {"units": unit}),
            "y": ("y", y, {"units": unit}),
            "spatial_ref": ((), 0, _crs_attributes(image.grid.crs)),
        },
        attrs={"units": "K", "grid_mapping": "spatial_ref"},
    )  # fmt: skip
    return array


def of_frame(frame: "Frame") -> "xr.Dataset":
    """Return the Dataset of a Frame."""
    xarray = _xarray()
    found, variables = images(frame), dict[str, Any]()
    position = found.pop("truth.position").astype(np.float64)
    for name, values in found.items():
        attributes: dict[str, Any] = {"units": UNITS.get(name, "1")}
        if name == "truth.material":
            # Words without spaces, as CF has them: mixtures are "0.5 grass + 0.5 sand".
            attributes["flag_meanings"] = " ".join(name.replace(" ", "_") for name in frame.materials)
        if name == "truth.mask":
            attributes |= {"flag_meanings": _FLAGS.lower(), "flag_masks": [getattr(surface, f) for f in _FLAGS.split()]}
        variables[name.removeprefix("truth.")] = (("y", "x"), values, attributes)
    height, width = frame.radiance.shape
    coordinates: dict[str, Any] = {
        "x": ("x", np.arange(width) + 0.5, {"units": "px", "long_name": "column of the pixel's middle"}),
        "y": ("y", np.arange(height) + 0.5, {"units": "px", "long_name": "row of the pixel's middle"}),
    }
    for number, name in enumerate(("east", "north", "up")):
        about = {"units": "m", "long_name": f"{name} in the scene's local frame"}
        coordinates[name] = (("y", "x"), position[..., number], about)
    if frame.place is not None:
        seen = np.isfinite(position).all(axis=-1)
        on_map = np.full((2, height, width), np.nan)
        on_map[:, seen] = frame.place.to_map(position[seen])
        unit = "degrees" if frame.place.crs.is_geographic else frame.place.crs.linear_units
        for name, values in zip(("map_x", "map_y"), on_map, strict=True):
            coordinates[name] = (("y", "x"), values, {"units": unit, "grid_mapping": "spatial_ref"})
        coordinates["spatial_ref"] = ((), 0, _crs_attributes(frame.place.crs))
    record: dict[str, Any] = {"camera": frame.camera.name, "time_s": frame.time_s, "record": json.dumps(header(frame))}
    data: xr.Dataset = xarray.Dataset(variables, coordinates, record)
    return data
