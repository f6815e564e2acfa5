"""A surface of the scene: a triangle mesh and, per texel of its map, colour, material and kinetic temperature."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.rays import EARTH_RADIUS_M, MEAN_RADIUS_M
from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    from thermorender.scene.crowns import Crowns
    from thermorender.scene.instances import Instances
from thermorender.units import kelvin

# Flags of texels, and of the pixels that show them (the truth mask of a frame).
SURFACE = 1  # a surface of the scene is hit
FILLED = 2  # colour, material or height is unknown: filled from the nearest valid texel or the surrounding posts
FALLBACK = 4  # the source has no temperature: the nearest one, or the material's own where a learned map fails
SATURATED = 8  # the sensor's range is exceeded
BACKGROUND = 16  # no surface is hit below the horizon: the black background beyond the terrain
UNKNOWN = 32  # a class raster or a learned map does not know it (fallback material), or emissivity beyond most_std
UNMOVED = 64  # a map could not be moved to this instant, or is uninformative: the heat balance is used
BEHIND = 128  # a surface's back, with the front's light: a camera below ground or in a body, or flipped normals

# Pixels of a raster or texture, 23 170²: reading needs up to 30 bytes for each at once, which fits into 16 GB.
MOST_TEXELS = 2**29
# Materials of a scene: a texel stores its material's number in one byte, and 255 means "no surface".
MOST_MATERIALS = 255


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh with a texel map."""

    name: str
    vertices: NDArray[np.float64]  # (V, 3) float64 positions in the scene's local frame [m]
    faces: NDArray[np.int32]  # (F, 3) int32 vertex indices, counter-clockwise seen from outside
    # (F, 3, 2) float32 map coordinates of each face's corners, 0…1, u to the right and v down the image
    uv: NDArray[np.float32]
    colour: NDArray[np.uint8]  # (h, w, 3) uint8 sRGB of each texel
    material: NDArray[np.uint8]  # (h, w) uint8 index of each texel's material in `Scene.materials`
    temperature: NDArray[np.float32]  # (h, w) float32 kinetic temperature [K]
    flags: NDArray[np.uint8]  # (h, w) uint8 bitwise or of the flags of this module
    texel_m: float  # Side of a texel on the ground [m]
    # Copies of a body that rays meet, or crowns that they pass in part; the faces then stand for their patches
    instances: "Instances | Crowns | None" = None
    # (h, w) float32 standard deviation of the temperature within texels [K], of copies whose heat balance is solved
    scatter_k: NDArray[np.float32] | None = None
    # Heat that enters its sheet from within, of an object whose heat balance is solved [W m⁻²]
    inner_w_m2: float = 0.0
    far: bool = False  # Coarser ground around the scene, as of [terrain] far
    # (F,) uint32 numbers by which rays from the faces are drawn; None: those of the faces in the scene
    seeds: NDArray[np.uint32] | None = None
    joined: bool = False  # Ground whose border to other joined ground is no edge of anything

    def __post_init__(self) -> None:
        """Make the arrays read-only: a scene does not change, and what follows from them must not become stale."""
        for name in ("vertices", "faces", "uv", "colour", "material", "temperature", "flags"):
            values = np.asarray(getattr(self, name)).view()
            values.flags.writeable = False
            object.__setattr__(self, name, values)

    @property
    def on_round_earth(self) -> bool:
        """Whether it follows the Earth's curvature and refraction."""
        return self.far or self.joined

    def heights_m(self) -> NDArray[np.float64]:
        """Return the heights of the vertices above the level of the frame's origin, (V,) [m].

        Far ground and tiles follow the Earth's curvature and refraction; within a scene the level is a plane.
        """
        if not self.on_round_earth:
            return self.vertices[:, 2]
        return over_round_earth(self.vertices, EARTH_RADIUS_M)

    def copied(self) -> "Surface":
        """Return this surface with its own copies of the arrays, which nobody else can change."""
        own: dict[str, Any] = {k: np.array(v) for k, v in vars(self).items() if isinstance(v, np.ndarray)}
        return replace(self, **own)

    def __repr__(self) -> str:
        rows, columns = self.material.shape
        known = self.temperature[np.isfinite(self.temperature)]
        kelvin = f"{known.min():.1f}–{known.max():.1f} K" if known.size else "no temperature yet"
        what = f"{len(self.faces)} triangles" if self.instances is None else str(self.instances)
        return f"Surface({self.name!r}, {what}, {columns}×{rows} texels of {self.texel_m:.3g} m, {kelvin})"


def bare(
    name: str, vertices: NDArray[np.float64], faces: NDArray[np.int32], uv: NDArray[np.float32],
    shape: tuple[int, ...], texel_m: float,
) -> Surface:  # fmt: skip
    """Return a Surface whose colour, material and temperature are placeholders without memory of their own."""
    return Surface(
        name=name,
        vertices=vertices,
        faces=faces,
        uv=uv,
        colour=np.broadcast_to(np.uint8(0), (*shape, 3)),
        material=np.broadcast_to(np.uint8(0), shape),
        temperature=np.broadcast_to(np.float32(np.nan), shape),
        flags=np.full(shape, SURFACE, np.uint8),
        texel_m=texel_m,
    )


def over_round_earth(points: ArrayLike, radius_m: float = MEAN_RADIUS_M) -> NDArray[np.float64]:
    """Return the heights of local positions (..., 3) above the level of the origin over a round Earth [m]."""
    points = np.asarray(points, np.float64)
    return points[..., 2] + np.square(points[..., :2]).sum(axis=-1) * (0.5 / radius_m)


# Hotter than any flame: a higher value is a placeholder for "no data", or not a temperature.
HOTTEST_KELVIN = 3000.0
# Largest share of the terrain that a raster draped on it may leave open without a stated value for the rest.
MOST_OPEN = 0.01
_Kelvin = TypeVar("_Kelvin", bound=ArrayLike)


def open_share(missing: NDArray[np.bool_], on_ground: NDArray[np.bool_] | None) -> float:
    """Return the share of terrain texels (h, w) without a value; `on_ground` None means that all texels are terrain."""
    if on_ground is None:
        return float(missing.mean())
    return float((missing & on_ground).sum() / max(on_ground.sum(), 1))


def scene_kelvin(name: str, temperature: _Kelvin, allow_zero: bool = False) -> _Kelvin:
    """Return `temperature` [K] unchanged; refuses what no surface or sky has. Arguments as `units.kelvin`."""
    kelvin(name, temperature, allow_zero)
    highest = np.nanmax(np.asarray(temperature))
    if highest > HOTTEST_KELVIN:
        raise ThermorenderError(
            f"{name}={highest:g} is above {HOTTEST_KELVIN:g} K; "
            "give kelvin, and declare placeholders for missing data as nodata"
        )
    return temperature


def nearest_valid(valid: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the flat index of the nearest valid texel for every texel, (h, w) int; at least one must be valid."""
    from scipy.ndimage import distance_transform_edt

    rows, columns = distance_transform_edt(~valid, return_distances=False, return_indices=True)
    index: NDArray[np.intp] = rows * valid.shape[1] + columns
    return index


def fill(values: NDArray[Any], index: NDArray[np.intp]) -> NDArray[Any]:
    """Return `values`, (h, w) or (h, w, c), with every texel replaced by the one `nearest_valid` names."""
    return values.reshape(index.size, -1)[index.ravel()].reshape(values.shape)
