"""An import in three dimensions: the solids of a surface model, and their files in the scene's folder."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.import_settings import ThreeD
from thermorender.apps.lands.solids import detection
from thermorender.apps.lands.solids.city_model import INFERRED, ROOF, ROOFS, TRUNKS, WALLS, CityModel, Walls, city_model
from thermorender.apps.lands.solids.clouds import Cloud
from thermorender.apps.lands.solids.outlines import outlines_in, outlines_in_classes
from thermorender.apps.lands.solids.plants import write_bodies, write_leaf_tables
from thermorender.apps.lands.solids.textured_mesh import MESH, write_meshes
from thermorender.errors import ThermorenderError
from thermorender.learned.apply import kinetic_from_map
from thermorender.learned.even import even
from thermorender.learned.temperature_map import Inputs, load_model
from thermorender.materials.library import find, load_library
from thermorender.scene.crowns import KELVIN
from thermorender.scene.mapped_cover import read_mapped_cover
from thermorender.scene.raster import Grid, onto
from thermorender.scene.terrain import doubtful_zeros, filled, read_elevation, zero_of_heights


def solid_of(
    three_d: ThreeD, height: NDArray[np.float64], grid: Grid, post_m: float, above_m: float | NDArray[np.float64],
    known: Path | None,
    picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, material: str, crs: Any,
    cloud: Cloud | None = None,
) -> CityModel:  # fmt: skip
    """Return the CityModel world of heights above a zero that is `above_m` above the ellipsoid of WGS 84 [m].

    `crs` is that of the heights' file. The ground and the buildings of a cloud's classes are used where no file
    states them.
    """
    library = load_library()
    wall, wall_by_kind = three_d.walls()
    for name in (wall, *wall_by_kind.values()):
        find(library, name, "wall").known_thermal()
    bare: NDArray[np.float64] | None = None
    notes: tuple[str, ...] = ()
    if three_d.ground is not None:
        bare, notes = _terrain_model(three_d.ground, height, grid, post_m, crs)
        bare = bare + above_m
    elif cloud is not None and cloud.ground is not None:
        bare = onto(cloud.ground, cloud.grid, grid, "average") + above_m
    outlines, cover = None, None
    if known is not None:
        found, stated = _outlines(known, three_d.building_class, grid, picture is not None)
        outlines, notes = found or None, notes + stated
        if picture is not None and three_d.building_class is None:
            texel_m = float(np.sqrt(abs(picture[2].transform.determinant)))
            cover = read_mapped_cover(known, picture[2], texel_m, walls=True, required=outlines is None)
    if outlines is None and cloud is not None and cloud.building is not None:
        house = onto(cloud.building.astype(np.float32), cloud.grid, grid, "nearest") == 1.0
        # A few stray points are no statement on the others.
        outlines = detection.outlines_of(detection.large(house, post_m)) or None
    walls, colour = Walls(wall, wall_by_kind), library[material].colour
    solid = city_model(height + above_m, grid, post_m, bare, outlines, picture, colour, walls, library)
    return replace(solid, notes=notes + solid.notes, cover=cover)


def _outlines(
    known: Path, number: int | None, grid: Grid, others: bool
) -> tuple[list[detection.Outline], tuple[str, ...]]:
    """The outlines of a GeoJSON, or of a class of a raster, and sentences on what else the file states.

    `others` says whether shapes other than buildings have a use.
    """
    is_raster = known.suffix.lower() not in (".json", ".geojson")
    if is_raster and number is None:
        raise ThermorenderError(
            f"known={known} is not a GeoJSON; if it is a raster of classes, give building_class, the "
            "number of its buildings"
        )
    if number is None:
        return outlines_in(known, grid, others)
    if not is_raster:
        raise ThermorenderError(f"building_class={number} is for a raster, and {known} is a GeoJSON; leave it out")
    return outlines_in_classes(known, number, grid), ()


def _terrain_model(
    path: Path, height: NDArray[np.float64], grid: Grid, post_m: float, crs: Any
) -> tuple[NDArray[np.float64], tuple[str, ...]]:
    """(Heights of the ground on the grid of a surface model in a CRS, a sentence on posts beyond it)."""
    lower, own = read_elevation(path)
    bare = onto(lower.astype(np.float64), own, grid, "bilinear")
    if not np.isfinite(bare).any():
        raise ThermorenderError(f"{path} does not overlap the surface model; give one of the same area")
    zero, other = zero_of_heights(own.crs), zero_of_heights(crs)
    if None not in (zero, other) and zero != other:
        raise ThermorenderError(
            f"{path} counts heights from {zero!r} and the surface model from {other!r}; convert one of them, with "
            "`gdalwarp -s_srs EPSG:MAP+HEIGHTS -t_srs EPSG:MAP+HEIGHTS IN OUT`"
        )
    detection.check_levels(bare, height, post_m, declared=zero is not None and other is not None)
    whole, _ = filled(bare)
    beyond = float((~np.isfinite(whole))[np.isfinite(height)].mean())
    missing = f"{path.name} has no heights for {beyond:.1%} of the surface model; a filter estimates the ground there"
    return whole, (*doubtful_zeros(path, lower), *([missing] if beyond > 0.0 else []))


def write_solid(folder: Path, solid: CityModel, tables: dict[str, Any], leaf_k: float | None) -> dict[str, Any]:
    """Write the mesh, its class rasters, the crowns and the leaves' thermal tables; return the tables of scene.toml.
    Leaves have the temperature `leaf_k`, or that of a heat balance."""
    write_leaf_tables(folder)
    learned = tables["emissivity"]["source"] == "learned"
    surfaces = []
    for table in write_meshes(folder, [mesh for mesh in solid.meshes if mesh.name in (WALLS, TRUNKS)], solid.meshes):
        surfaces.append(table | ({"inferred": True} if table["name"] in INFERRED else {}))
    if not learned and any(mesh.name == ROOFS for mesh in solid.meshes):
        surfaces.append({"name": ROOFS, "material": ROOF})
    frame = solid.frame
    place = {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg, "height_m": frame.height_m}
    warm, source = "balance" if leaf_k is None else leaf_k, tables["temperature"]
    if source["source"] == "learned":
        _map_leaves(solid, source["model"])
    return tables | {
        "terrain": {"mesh": MESH}, "frame": place, "surface": surfaces,
        "emissivity": tables["emissivity"] | {"classes": solid.classes},
        "object": write_bodies(folder, solid.plants, temperature=warm, inferred=True) or None,
    }  # fmt: skip


def _map_leaves(solid: CityModel, model: str) -> None:
    """Give crowns the temperatures that a learned map has for even areas of their colours."""
    seen, known = even(load_model(model)), load_library()
    for bodies in solid.plants.values():
        rgb = bodies.rows[:, None, -3:].astype(np.uint8)
        kelvin, *_ = kinetic_from_map(seen, Inputs(rgb), np.zeros(rgb.shape[:2], np.uint8), [known[bodies.material]])
        bodies.kelvin = np.repeat(kelvin, len(KELVIN), axis=1)
