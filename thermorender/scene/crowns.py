"""Crowns of leaves as turbid media: ellipsoids and boxes that light passes by Beer's law.

Leaves of all orientations let the share exp(−G a s) of the light along a path of s [m] through, with a leaf area
density of a [m²/m³, one side] and G = 1/2 (Ross 1981, doi:10.1007/978-94-009-8647-3). They are thin: both sides have
the same temperature. The rest of the package sees each crown as a few patches, of one texel each: its core and its
shell, of half of the volume each; of both the lower and the upper half; and of each of these quarters the sides of
leaves that face down and up. Leaves near the surface see more of the sky, and a camera sees them first.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.meshes.mesh import one_texel_each
from thermorender.scene.surface import Surface

Floats = NDArray[np.float64]

# Mean projection of leaves of all orientations, per area of one side.
PROJECTION = 0.5
# Quarters of a crown, 2 × shell + upper, and its patches, 2 × quarter + (sides that face up).
QUARTERS, PATCHES = 4, 8
# Least and largest leaf area density [m²/m³]: sparse grass, and more than any clipped hedge.
DENSITIES = (1e-3, 100.0)
# Side of a leaf, or of a tuft that sways as one, where nothing is stated [m].
LEAF_M = 0.1
# Further columns of a table of crowns: least and largest value, and unit.
COLUMNS = {
    "up_m": (-1e5, 1e5, "m in the local frame, instead of above_ground_m"),
    **dict.fromkeys(("width_m", "length_m", "height_m"), (1e-2, 1e3, "m")), "leaf_area_1_m": (*DENSITIES, "m²/m³"),
    **dict.fromkeys(("red", "green", "blue"), (0.0, 255.0, "of sRGB")),
}  # fmt: skip
# Columns of a table of leaf temperatures: the mean of the leaves in each quarter, and a leaf there in the sun [K].
_NAMES = ("core_lower", "core_upper", "shell_lower", "shell_upper")
KELVIN = (*(f"{name}_k" for name in _NAMES), *(f"{name}_sunlit_k" for name in _NAMES))
_SEED = 0x1EAF


@dataclass(frozen=True, eq=False)
class Crowns:
    """Turbid bodies of one shape."""

    box: bool  # A box; else an ellipsoid
    middle: Floats  # (n, 3) float64 in the scene's frame [m]
    half: Floats  # (n, 3) float64 half of the extents along the body's own axes [m]
    yaw_deg: Floats  # (n,) float64 heading of the y axis, clockwise from north
    density: Floats  # (n,) float64 area of one side of leaves per volume [m²/m³]
    leaf_m: float = LEAF_M  # Side of a leaf, which the stated error depends on [m]

    patches: ClassVar[int] = PATCHES

    def __len__(self) -> int:
        return len(self.middle)

    def __str__(self) -> str:
        return "1 crown" if len(self) == 1 else f"{len(self)} crowns"

    @property
    def volume(self) -> Floats:
        """Volume of each crown, (n,) [m³]."""
        found: Floats = (8.0 if self.box else 4.0 / 3.0 * np.pi) * self.half.prod(axis=1)
        return found

    @property
    def area(self) -> Floats:
        """Area of the sides of leaves of each patch, (n × PATCHES,) [m²]."""
        return np.repeat(self.density * self.volume / QUARTERS, PATCHES)

    @property
    def axes(self) -> Floats:
        """Columns are the crowns' own axes in the scene's frame, (n, 3, 3)."""
        heading = np.radians(self.yaw_deg)
        found = np.zeros((len(self), 3, 3))
        found[:, 0, 0] = found[:, 1, 1] = np.cos(heading)
        found[:, 0, 1], found[:, 1, 0] = np.sin(heading), -np.sin(heading)
        found[:, 2, 2] = 1.0
        return found

    def stand_ins(self) -> tuple[Floats, NDArray[np.int32]]:
        """Return (vertices, faces) of a triangle for each patch, which together reach to the corners of its box."""
        corner = np.array([
            [[x, -1.0, low], [-x, 1.0, low + 1.0], [0.0, 0.0, low + 0.5]] for low in (-1.0, 0.0) for x in (-1.0, 1.0)
        ])  # fmt: skip
        corner = np.concatenate([corner, corner])
        local = corner * self.half[:, None, None]
        vertices = np.einsum("nij,npkj->npki", self.axes, local) + self.middle[:, None, None]
        vertices = vertices.reshape(-1, 3)
        return vertices, np.arange(len(vertices), dtype=np.int32).reshape(-1, 3)

    def leaves(self, count: int) -> tuple[Floats, Floats]:
        """Return (points in the unit body, normals) of `count` leaves of each patch, (PATCHES, count, 3) each.

        Points are even over the volume of a part of a cube or ball of half-width 1, and normals over the directions of
        their side.
        """
        from scipy.stats import qmc

        # Even in each patch, and in random order: the directions of rays are Sobol' points too.
        random = np.random.Generator(np.random.Philox(_SEED))
        u = np.stack([random.permutation(qmc.Sobol(4, seed=random).random(count)) for _ in range(PATCHES)])
        patch = np.arange(PATCHES)
        # A body of s times the width has s³ of the volume.
        width = np.cbrt(0.5 * (u[..., 0] + (patch >= QUARTERS)[:, None]))
        if self.box:
            point = 2.0 * u[..., 1:4] - 1.0
            # On a side of the cube: the third number has chosen it, and is even again within that.
            side = np.minimum((3.0 * u[..., 3]).astype(int), 2)
            point[..., 2] = 2.0 * (3.0 * u[..., 3] - side) - 1.0
            place = np.arange(PATCHES)[:, None], np.arange(count), side
            point[place] = np.where(point[place] < 0.0, -1.0, 1.0)
        else:
            height, turn = 2.0 * u[..., 1] - 1.0, 2.0 * np.pi * u[..., 2]
            level = np.sqrt(1.0 - height**2)
            point = np.stack([level * np.cos(turn), level * np.sin(turn), height], axis=-1)
        point = width[..., None] * point
        point[..., 2] = np.abs(point[..., 2]) * np.where(patch // 2 % 2, 1.0, -1.0)[:, None]
        height, turn = random.random((2, PATCHES, count))
        level = np.sqrt(1.0 - height**2)
        normal = np.stack([level * np.cos(2.0 * np.pi * turn), level * np.sin(2.0 * np.pi * turn), height], axis=-1)
        normal *= np.where(patch % 2, 1.0, -1.0)[:, None, None]
        return point, normal


def placed(surface: Surface, place: Mapping[str, Floats], density_1_m: float, leaf_m: float = LEAF_M) -> Surface:
    """Return the Surface of crowns of the shape of `surface`, a box or ellipsoid on its base at the origin.

    `place` is {"position": (n, 3) of their bases [m], "yaw_deg": (n,), "scale": (n,)}, and may have "width_m",
    "length_m", "height_m" and "leaf_area_1_m" in place of the shape's extents and `density_1_m`, sRGB "red", "green"
    and "blue", and the columns of KELVIN, (n,) each.
    """
    extent, count = np.ptp(surface.vertices, axis=0), len(place["scale"])
    sides = zip(("width_m", "length_m", "height_m"), extent, strict=True)
    size = np.stack([place.get(name, np.full(count, each)) for name, each in sides], axis=-1)
    half = 0.5 * place["scale"][:, None] * size
    middle = place["position"] + half * [0.0, 0.0, 1.0]
    density = place.get("leaf_area_1_m", np.full(count, density_1_m))
    crowns = Crowns(surface.name.endswith(":box"), middle, half, place["yaw_deg"], density, leaf_m)
    vertices, faces = crowns.stand_ins()
    uv, shape = one_texel_each(len(faces))
    bands = zip(("red", "green", "blue"), surface.colour[0, 0], strict=True)
    own = np.stack([place.get(name, np.full(count, each)) for name, each in bands], axis=-1).round().astype(np.uint8)
    temperature, scatter = np.full(shape, surface.temperature.flat[0]), None
    if KELVIN[0] in place:
        quarters = np.repeat(np.stack([place[name] for name in KELVIN], axis=-1), 2, axis=1)
        mean, sunlit = quarters[:, :PATCHES].reshape(-1), quarters[:, PATCHES:].reshape(-1)
        temperature = np.resize(mean, shape).astype(np.float32)
        scatter = np.resize(np.maximum(sunlit - mean, 0.0), shape).astype(np.float32)
    return replace(
        surface, vertices=vertices, faces=faces, uv=uv, colour=np.resize(np.repeat(own, PATCHES, axis=0), (*shape, 3)),
        material=np.full(shape, surface.material.flat[0]), temperature=temperature, scatter_k=scatter,
        flags=np.full(shape, surface.flags.flat[0]), texel_m=float(np.sqrt(crowns.area.mean())), instances=crowns,
    )  # fmt: skip
