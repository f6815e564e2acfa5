"""What `import-terrain --three-d` adds: the solids of a surface model, and their files in the scene's folder."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.materials.library import find, load_library
from thermorender.scene.raster import Grid, onto
from thermorender.scene.solids.imported import INFERRED, PLANTS, ROOF, ROOFS, WALLS, Imported, imported
from thermorender.scene.solids.plants import write_leaf_tables
from thermorender.scene.solids.skin import MESH, write_skins
from thermorender.scene.terrain import read_elevation

WALL = "brick_painted"


@dataclass(frozen=True)
class ThreeD:
    """How a surface model becomes solids.

    Attributes
    ----------
    ground : path or None
        Raster of the ground's heights below all objects; None: a filter finds it.
    wall : str
        Material of all walls.
    """

    ground: Path | None = None
    wall: str = WALL

    def made(
        self, height: NDArray[np.float64], grid: Grid, post_m: float, undulation_m: float, known: Path | None,
        picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, material: str,
    ) -> Imported:  # fmt: skip
        """Return the Imported world of heights above the geoid or ellipsoid; `undulation_m` lies between [m]."""
        library = load_library()
        find(library, self.wall, "wall").known_thermal()
        bare = None
        if self.ground is not None:
            lower, own = read_elevation(self.ground)
            bare = onto(lower.astype(np.float64), own, grid, "bilinear")
            if not np.isfinite(bare).any():
                raise ThermorenderError(f"{self.ground} does not overlap the surface model; give one of the same area")
            bare = bare + undulation_m
        colour = library[material].colour
        return imported(height + undulation_m, grid, post_m, bare, known, picture, colour, self.wall, library)


def write_solid(folder: Path, solid: Imported, tables: dict[str, Any]) -> dict[str, Any]:
    """Write the mesh, its class rasters and the leaves' thermal tables; return the tables of scene.toml."""
    write_leaf_tables(folder)
    learned = tables["emissivity"]["source"] == "learned"
    surfaces = []
    for table in write_skins(folder, [skin for skin in solid.skins if skin.name in (WALLS, PLANTS)], solid.skins):
        surfaces.append(table | ({"inferred": True} if table["name"] in INFERRED else {}))
    if not learned and any(skin.name == ROOFS for skin in solid.skins):
        surfaces.append({"name": ROOFS, "material": ROOF})
    frame = solid.frame
    place = {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg, "height_m": frame.height_m}
    return tables | {
        "terrain": {"mesh": MESH}, "frame": place, "surface": surfaces,
        "emissivity": tables["emissivity"] | {"classes": solid.classes},
    }  # fmt: skip
