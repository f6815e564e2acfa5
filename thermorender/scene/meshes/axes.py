"""How the numbers of a mesh file are meant, where it does not say so, and doubts by its extents and faces."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

# Longest side of an object, and of a terrain, that need no doubt [m]: the shortest and the longest.
_OBJECT_M, _TERRAIN_M = (0.01, 100.0), (0.1, 20e3)
# Share of an object's height in the ground that needs no doubt.
_SUNK = 0.1
# Smallest share of its box that a terrain covers, as its faces look.
_FACING = 0.25
# Body whose faces look inwards: opening as a share of its area, and mean sine of their angles to the outward direction.
_OPEN, _INWARD = 0.3, -0.5
# A sheet is level if its vector area is at least this share of its area, downwards here.
_LEVEL = 0.7
# Faces whose corners are in memory at once.
_AT_ONCE = 1 << 20


@dataclass(frozen=True)
class Axes:
    """Up, unit and sense of the faces of a mesh file."""

    up: str | None = None  # The axis that points up, "y" or "z"; None: y for glTF and z for other formats
    scale_to_m: float = 1.0  # Metres in its unit of length
    flip: bool = False  # Whether its faces are clockwise seen from outside

    def turned(self, vertices: _Floats, own: str) -> _Floats:
        """Return vertices (V, 3) in metres and z up, of a file whose axis `own` points up, read as z up."""
        if self.up not in (None, own):
            sign = 1.0 if own == "z" else -1.0
            vertices = vertices[:, [0, 2, 1]] * [1.0, -sign, sign]
        return vertices if self.scale_to_m == 1.0 else vertices * self.scale_to_m


AS_STORED = Axes()


def terrain_doubts(what: str, extent: _Floats, facing: _Floats, axes: Axes, own: str) -> list[str]:
    """Return sentences on a terrain of an extent (3,) [m] and a `vector_area` (3,) [m²].

    `own` is the axis that points up in its format.
    """
    plan, side = extent[0] * extent[1], extent[0] * extent[2]
    found = []
    upright = abs(facing[1]) > 2.0 * _FACING * side or extent[1] < 0.5 * min(extent[0], extent[2])
    other = "y" if own == "z" else "z"
    if axes.up is None and abs(facing[2]) < 2.0 * _FACING * plan and upright and extent[2] > extent[1]:
        found.append(
            f"{what} is {extent[:2].min():.3g} m wide and {extent[2]:.3g} m high; it looks {other} up: write "
            f'up = "{other}" in [terrain], or up = "{own}" if it is right'
        )
    elif facing[2] < -_FACING * plan:
        found.append(f"{what} has faces that look down, whose backs a camera above it sees; {_flip(axes)} in [terrain]")
    if not _TERRAIN_M[0] <= extent.max() <= _TERRAIN_M[1]:
        found.append(
            f"{what} is {_length(extent.max())} long; write scale_to_m in [terrain], the metres in the file's unit"
        )
    return found


def object_doubts(
    what: str, triangles: _Floats, axes: Axes, own: str, above_ground_m: float, terrain_m: float
) -> list[str]:
    """Return sentences on an object's triangles (F, 3, 3) [m] whose origin is `above_ground_m` above the ground.

    `terrain_m` is the longest side of the terrain [m].
    """
    extent, low = np.ptp(triangles, axis=(0, 1)), triangles.min(axis=(0, 1))
    longest = float(extent.max())
    if longest > min(_OBJECT_M[1], terrain_m):
        unit, name = (0.01, "centimetres") if longest < 3e3 else (0.001, "millimetres")
        than = "" if longest > _OBJECT_M[1] else f", longer than the terrain of {terrain_m:.3g} m"
        return [
            f"{what} is {_length(longest)} long{than}; write scale_to_m = {unit * axes.scale_to_m:g} in its table if "
            f"the file is in {name}"
        ]
    if longest < _OBJECT_M[0]:
        return [f"{what} is {_length(longest)} long; write scale_to_m in its table, the metres in the file's unit"]
    found = []
    sunk = -(low[2] + above_ground_m)
    if -low[2] > _SUNK * extent[2] and sunk > _SUNK * extent[2]:
        # Of a body that was made with the other axis up, that axis begins at its foot.
        other, foot = ("y", low[1]) if own == "z" else ("z", -triangles[..., 1].max())
        lies = axes.up is None and abs(foot) < 0.05 * extent[1] and abs(2.0 * low[2] + extent[2]) < 0.1 * extent[2]
        why = f'it looks {other} up: write up = "{other}" in its table, or' if lies else "its file begins below 0 m:"
        found.append(
            f"{what} has {sunk:.3g} m of its {extent[2]:.3g} m in the ground; {why} raise it by {sunk:.3g} m (the "
            "third number of its position, or above_ground_m)"
        )
    facing = _wrong_way(triangles)
    if facing:
        found.append(f"{what} has faces that look {facing}, whose backs a camera sees; {_flip(axes)} in its table")
    return found


def _flip(axes: Axes) -> str:
    return "leave out flip = true" if axes.flip else "write flip = true"


def _length(metres: float) -> str:
    if metres < 0.1:
        return f"{1e3 * metres:.3g} mm"
    return f"{metres:.0f} m" if metres >= 100.0 else f"{metres:.3g} m"


def _across(triangles: _Floats) -> _Floats:
    """Areas times normals, (F, 3) [m²]."""
    found: _Floats = 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return found


def vector_area(vertices: _Floats, faces: NDArray[np.int32]) -> _Floats:
    """Return the vector area (3,) [m²]: zero for a closed body, the plan upward for any ground seen from above."""
    found = np.zeros(3)
    for first in range(0, len(faces), _AT_ONCE):
        found += _across(vertices[faces[first : first + _AT_ONCE]]).sum(axis=0)
    return found


def _wrong_way(triangles: _Floats) -> str:
    """Where the faces look: "inwards" in a nearly closed body, "down" in a level sheet; "" if where they should."""
    across = _across(triangles)
    area, whole = float(np.linalg.norm(across, axis=1).sum()), across.sum(axis=0)
    if np.linalg.norm(whole) > _OPEN * area:
        return "down" if whole[2] < -_LEVEL * area else ""
    outward = triangles.mean(axis=1) - 0.5 * (triangles.min(axis=(0, 1)) + triangles.max(axis=(0, 1)))
    along = np.einsum("fi,fi->f", across, outward)
    return "inwards" if along.sum() < _INWARD * np.abs(along).sum() else ""
