"""Dynamic objects: position, heading and temperature over time."""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, shortened
from thermorender.formats import csv_rows, read_text
from thermorender.physics.geodesy import FARTHEST_M
from thermorender.scene import footing
from thermorender.scene.spec import ObjectSpec
from thermorender.scene.surface import Surface, scene_kelvin
from thermorender.units import Number

COLUMNS = ("east_m", "north_m", "above_ground_m", "yaw_deg", "temperature_k")

# Largest values of a track and their unit: beyond, differences lose their digits or overflow.
_LIMITS = {
    **dict.fromkeys(COLUMNS[:3], (FARTHEST_M, "metres")),
    "yaw_deg": (1e6, "degrees"),
    "time_s": (1e12, "seconds"),
    "scale": (1e3, "a factor"),
}


@dataclass(frozen=True, eq=False)
class TrackedObject:
    """An object with a track."""

    item: ObjectSpec  # The object in the scene file; its values are used for columns that the track leaves out
    # In the object's own frame: x right, y ahead, z up, the middle of its base at the origin
    surfaces: tuple[Surface, ...]
    lift_m: float  # Added to the stated height of its base, so that a disc is not in the ground [m]
    time_s: NDArray[np.float64]  # (n,) float64 rising [s]
    columns: Mapping[str, NDArray[np.float64]]  # {name of COLUMNS: (n,) float64}
    # {column: (n,) float64} of the copies of an object with instances, from `read_places`
    places: Mapping[str, NDArray[np.float64]] | None = None
    inner_1_m2: tuple[float, ...] = ()  # Share of its inner heat on a square metre of each of `surfaces` [m⁻²]

    @property
    def name(self) -> str:
        """The object's name."""
        return self.item.name

    def at(self, time_s: float, **given: Number) -> dict[str, float]:
        """Return {column: value} at a time [s], linear between rows, constant beyond the ends, or as `given`."""
        for name, value in given.items():
            if name not in COLUMNS:
                raise ThermorenderError(f"object {self.name!r} has no {name!r} to set; give {', '.join(COLUMNS)}")
            try:
                finite = np.isfinite(float(value))
            except (TypeError, ValueError):
                finite = False
            if not finite:
                raise ThermorenderError(
                    f"object {self.name!r}: {name}={shortened(repr(value))} is not allowed; give a finite number"
                )
        if "temperature_k" in given:
            scene_kelvin(f"object {self.name!r}: temperature_k", given["temperature_k"])
        item = self.item
        values = dict(zip(COLUMNS, (*item.position, item.yaw_deg, item.kelvin), strict=True))
        values |= {name: float(np.interp(time_s, self.time_s, column)) for name, column in self.columns.items()}
        return values | {name: float(value) for name, value in given.items()}

    def temperatures(self) -> tuple[float, float]:
        """Return the coldest and warmest temperature of the track [K]."""
        found = self.columns.get("temperature_k", np.array([self.item.kelvin]))
        return float(found.min()), float(found.max())

    def stations(self, most: int = 100) -> list[dict[str, float]]:
        """Return values as by `at` along the track, an object's length apart; empty if there are more than `most`."""
        extent = float(np.ptp(self._corner, axis=0).max())
        position = np.column_stack([self.columns.get(name, np.zeros(len(self.time_s))) for name in COLUMNS[:3]])
        distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(position, axis=0), axis=1))])
        count = int(np.ceil(distance[-1] / extent)) + 1
        if count > most:
            return []
        # Where the object does not move, use the first time.
        keep = np.concatenate([[True], np.diff(distance) > 0.0])
        return [self.at(t) for t in np.interp(np.linspace(0.0, distance[-1], count), distance[keep], self.time_s[keep])]

    @cached_property
    def _corner(self) -> NDArray[np.float64]:
        """Vertices in the object's own frame, (V, 3) [m]."""
        return np.concatenate([surface.vertices for surface in self.surfaces])

    @cached_property
    def _foot(self) -> NDArray[np.float64]:
        return footing.footprint(self._corner)

    def world_from_own(self, values: Mapping[str, float], ground: footing.Height) -> NDArray[np.float64]:
        """Return world_from_object (4, 4) for values as by `at`; `ground` maps (east, north) to terrain height [m].

        On the slope of the ground, the height above it counts along its normal, so that parts of a body stay together.
        """
        east, north = values["east_m"], values["north_m"]
        height = float(ground(east, north))
        if not np.isfinite(height):
            raise ThermorenderError(
                f"object {self.name!r} is at {east:g} m east, {north:g} m north, where there is no terrain; "
                "give a position on the terrain"
            )
        heading = np.radians(values["yaw_deg"])
        matrix = np.eye(4)
        # The heading is clockwise from north, and the object's y axis points along it.
        matrix[:2, :2] = [[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]]
        matrix[:3, 3] = east, north, height
        above, upright = values["above_ground_m"], self.item.upright
        if upright is None:
            upright = footing.upright(self._corner, above)
        slope = None if upright else footing.resting(self._foot, matrix, ground, above)
        if slope is None:
            matrix[2, 3] = height + above + self.lift_m
            return matrix
        matrix = matrix @ slope
        matrix[:3, 3] += (above + self.lift_m) * matrix[:3, 2]
        return matrix


def read_columns(
    path: Path, needed: Sequence[str], others: Sequence[str], least: int = 0
) -> tuple[dict[str, NDArray[np.float64]], list[int]]:
    """Return ({column: (n,)}, number of each row in the file) of a CSV with a header and finite numbers.

    The file must have the columns `needed`, and at least `least` of `others`.
    """
    try:
        lines = csv_rows(read_text(path, "CSV UTF-8"), strict=False)
    except csv.Error as error:
        raise ThermorenderError(f"{path} is not CSV ({error}); save it as CSV UTF-8") from None
    numbers = [number for number, line in enumerate(lines, start=1) if any(line)]
    rows = [lines[number - 1] for number in numbers]
    header = [cell.strip() for cell in rows[0]] if rows else []
    allowed = (*needed, *others)
    odd = next((name for name in header if name not in allowed or header.count(name) > 1), None)
    if odd is not None or not set(needed) <= set(header) or len(header) < len(needed) + least or len(rows) < 2:
        more = ", another column" if least else ""
        what = f"has the column {odd!r}" if odd is not None else f"lacks {', '.join(needed)}{more} or rows of numbers"
        raise ThermorenderError(
            f"{path} {what}; give a header with {', '.join(needed)} and any of {', '.join(others)}, each once, "
            "separated by commas, and rows of numbers below it"
        )
    values = np.array([_finite(path, *row, len(header)) for row in zip(numbers[1:], rows[1:], strict=True)])
    columns = dict(zip(header, values.T.copy(), strict=True))
    for name, (most, unit) in _LIMITS.items():
        far = np.abs(columns.get(name, np.zeros(1))) > most
        if far.any():
            raise ThermorenderError(
                f"{path}: {name}={columns[name][far][0]:g} is out of range; give {unit}, up to {most:g}"
            )
    return columns, numbers[1:]


def _finite(path: Path, number: int, cells: list[str], columns: int) -> list[float]:
    """The finite numbers of a row, one for each column; `number` is the row's in the file."""
    try:
        values = [float(cell) for cell in cells]
    except ValueError:
        values = []
    if len(values) != columns or not np.isfinite(values).all():
        raise ThermorenderError(
            f"{path}, row {number}: {shortened(','.join(cells))!r} is not {columns} finite numbers; give a number for "
            "each column"
        )
    return values


def read_track(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Return (time_s (n,), {column: (n,)}) of a track: a CSV with `time_s` and any of COLUMNS."""
    columns, numbers = read_columns(path, ("time_s",), COLUMNS, 1)
    time_s = columns.pop("time_s")
    if (np.diff(time_s) <= 0.0).any():
        row = numbers[int(np.argmax(np.diff(time_s) <= 0.0)) + 1]
        raise ThermorenderError(f"{path}, row {row}: time_s does not rise; sort the rows and give each time once")
    if "yaw_deg" in columns:
        # Turn the shorter way between two rows.
        columns["yaw_deg"] = np.unwrap(columns["yaw_deg"], period=360.0)
    for value in columns.get("temperature_k", ()):
        scene_kelvin(f"{path}: temperature_k", value)
    return time_s, columns
