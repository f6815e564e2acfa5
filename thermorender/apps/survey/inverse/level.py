"""The common level of map and offsets, fixed by places of known kinetic temperature such as water or a marker.

The scene's emissivity and reflected light make them comparable with the map.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.inverse.kinetic import Light, apparent_of
from thermorender.apps.survey.inverse.linear import RANGE_K, LinearKelvin
from thermorender.apps.survey.inverse.weights import Lattice
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.trajectory.tables import rows_of
from thermorender.units import kelvin

if TYPE_CHECKING:
    from thermorender import Renderer

Floats = NDArray[np.float64]
_LOCAL, _GEODETIC, _REST = ("east_m", "north_m"), ("lat_deg", "lon_deg"), ("radius_m", "kelvin", "std_k")


@dataclass(frozen=True)
class Reference:
    """A disc of terrain with a known kinetic temperature [K], and its standard deviation."""

    name: str
    east_m: float
    north_m: float
    radius_m: float
    kelvin: float
    std_k: float


def read_references(path: Path, frame: LocalFrame | None) -> list[Reference]:
    """Return the References of a CSV with the columns name, radius_m, kelvin, std_k, and east_m, north_m or lat_deg,
    lon_deg, which need the frame of the scene."""
    head, rows = rows_of(path)
    pairs = [pair for pair in (_LOCAL, _GEODETIC) if all(name in head for name in pair)]
    if len(pairs) != 1 or any(name not in head for name in ("name", *_REST)):
        raise ThermorenderError(
            f"{path} has the columns {', '.join(head)}; give name, {', '.join(_LOCAL)} or {', '.join(_GEODETIC)}, "
            f"{', '.join(_REST)}"
        )
    if pairs[0] is _GEODETIC and frame is None:
        raise ThermorenderError(f"{path} has latitudes, which need a place of the scene; add [frame] to it")
    found: list[Reference] = []
    for where, row in rows:
        values = []
        for name in (*pairs[0], *_REST):
            try:
                values.append(float(row[name]))
            except (TypeError, ValueError):
                values.append(np.nan)
            if not np.isfinite(values[-1]) or (name in ("radius_m", "std_k") and values[-1] <= 0.0):
                raise ThermorenderError(f"{where}: {name}={row[name]!r} is not allowed; give a number, "
                                        "above 0 for radius_m and std_k")  # fmt: skip
        kelvin(f"{where}: kelvin", values[3])
        if not RANGE_K[0] <= values[3] <= RANGE_K[1]:
            raise ThermorenderError(
                f"{where}: kelvin={values[3]:g} is not the temperature of ground; give {RANGE_K[0]:g} to "
                f"{RANGE_K[1]:g} K, or leave the reference out"
            )
        # A row that is there twice would count twice.
        if row["name"] in {each.name for each in found}:
            raise ThermorenderError(f"{where}: name={row['name']!r} is given twice; name each reference once")
        if pairs[0] is _GEODETIC:
            assert frame is not None
            if not (abs(values[0]) <= 90.0 and abs(values[1]) <= 360.0):
                raise ThermorenderError(
                    f"{where}: lat_deg={values[0]:g}, lon_deg={values[1]:g} is not a place; give degrees"
                )
            values[:2] = frame.enu_from_geodetic(values[0], values[1], frame.height_m)[:2].tolist()
        found.append(Reference(row["name"], *values))
    return found


def shift_of(
    references: list[Reference], values: Floats, std: Floats, seen: NDArray[np.bool_], light: Light,
    renderer: "Renderer", lattice: Lattice, linear: LinearKelvin,
) -> tuple[float, float, list[tuple[str, float]]]:  # fmt: skip
    """Return (shift of the map's level [linear kelvin], its standard deviation, [(name, residual after it), …]).

    Birge's ratio widens the standard deviation of references that differ by more than their own.
    """
    position = _positions(renderer, lattice)
    misses, variances = [], []
    for each in references:
        row, column = position(each.east_m, each.north_m)
        i, j = np.mgrid[: values.shape[0], : values.shape[1]]
        inside = seen & (np.hypot(i - row, j - column) <= max(each.radius_m / lattice.texel_m, 0.71))
        if not inside.any():
            raise _unseen(each)
        known = [
            apparent_of(each.kelvin, int(number), float(reflected), renderer, linear)
            for number, reflected in zip(light.material[inside], light.reflected[inside], strict=True)
        ]
        misses.append(float(np.mean(known) - values[inside].mean()))
        # Errors of neighbouring texels are taken as common.
        variances.append(each.std_k**2 + float(np.mean(std[inside] ** 2)))
    weight = 1.0 / np.array(variances)
    shift = float(weight @ np.array(misses) / weight.sum())
    rest = np.array(misses) - shift
    ratio = max(1.0, float(weight @ rest**2) / (len(rest) - 1)) if len(rest) > 1 else 1.0
    residuals = [(each.name, float(miss)) for each, miss in zip(references, rest, strict=True)]
    return shift, float(np.sqrt(ratio / weight.sum())), residuals


def check_places(references: Sequence[Reference], renderer: "Renderer", lattice: Lattice) -> None:
    """Raise if a reference is not on the map; that costs nothing before the solution."""
    position = _positions(renderer, lattice)
    for each in references:
        place = position(each.east_m, each.north_m)
        beyond = max(each.radius_m / lattice.texel_m, 0.71)
        if not all(-beyond <= at <= side - 1.0 + beyond for at, side in zip(place, lattice.shape, strict=True)):
            raise _unseen(each)


def _unseen(reference: Reference) -> ThermorenderError:
    return ThermorenderError(
        f"reference {reference.name!r} at east_m={reference.east_m:g}, north_m={reference.north_m:g} is on no texel "
        "that the frames show; correct its position, or leave it out"
    )


def _positions(renderer: "Renderer", lattice: Lattice) -> Callable[[float, float], tuple[float, float]]:
    """A function (east, north) → (row, column) on the map, by the scene's place."""
    from thermorender.scene.georeference import place_of

    scene = renderer.scene
    place = place_of(scene.frame, scene.grid)
    assert place is not None

    def position(east: float, north: float) -> tuple[float, float]:
        up = float(scene.ground(east, north))
        x, y = place.to_map(np.array([[east, north, up if np.isfinite(up) else 0.0]]))
        column, row = lattice.grid.to_pixel(x[0], y[0])
        return float(row) - 0.5, float(column) - 0.5

    return position
