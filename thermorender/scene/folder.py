"""The content of a scene folder before any edit: terrain, orthophoto, classes, objects and materials."""

import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError, ThermorenderWarning, shortened
from thermorender.materials import library as material_tables
from thermorender.materials.material import Material
from thermorender.physics.geodesy import FARTHEST_M, LocalFrame
from thermorender.scene import far_ground, map_view, terrain
from thermorender.scene.crowns import COLUMNS, KELVIN
from thermorender.scene.drape import (
    Drape,
    classes_on,
    coarser,
    mixed_classes_on,
    on_ground,
    refuse_unnamed,
    require_overlap,
)
from thermorender.scene.far_ground import GroundPlan
from thermorender.scene.georeference import datum_heights, place_of
from thermorender.scene.instances import read_places
from thermorender.scene.map_view import MapView
from thermorender.scene.meshes import mesh
from thermorender.scene.meshes.axes import object_doubts, terrain_doubts, vector_area
from thermorender.scene.orthophoto import read_colour
from thermorender.scene.raster import Grid, grid_of, on_map, onto, read_classes
from thermorender.scene.sources import Classes, Colours, Heights, rasters_of
from thermorender.scene.spec import FarSpec, ObjectSpec, SceneSpec
from thermorender.scene.surface import FILLED, Surface, bare, scene_kelvin
from thermorender.scene.textures import Texture, areas, named, onto_texels, stating, texel_size_m
from thermorender.scene.tracks import TrackedObject, read_columns, read_track
from thermorender.scene.world import World, WorldGround, world_of


@dataclass(frozen=True, eq=False)
class SceneFiles:
    """The content of a scene folder."""

    frame: LocalFrame | None
    # The terrain, not refined yet: the parts of a mesh, then raster ground; materials and temperatures are placeholders
    ground: tuple[Surface, ...]
    textures: tuple[Texture, ...]  # Of each part of a mesh
    drapes: tuple[Drape, ...]  # Of each raster ground
    library: Mapping[str, Material]
    objects: tuple[TrackedObject, ...] = ()  # Every object, in its own frame; one without a track has one row
    world: World | None = None  # The tiled ground of which `ground` is an overview

    @property
    def grid(self) -> Grid | None:
        """Map grid of the terrain's texels; None for a mesh."""
        return None if self.textures else self.drapes[0].grid

    @property
    def near(self) -> tuple[Surface, ...]:
        """The terrain without far ground."""
        return tuple(surface for surface in self.ground if not surface.far)

    @cached_property
    def map_view(self) -> MapView | None:
        """The terrain without far ground as a map shows it; None for a mesh without [frame], and for one of walls and
        leaves only."""
        if self.grid is not None:
            return map_view.of_raster(self.grid)
        place = place_of(self.frame, None)
        return None if place is None else map_view.of_mesh(self.near, self.textures, place)


def read_files(spec: SceneSpec, where: str) -> SceneFiles:
    """Return the SceneFiles of a scene file."""
    own = spec.folder / "materials"
    library = material_tables.load_library(own if own.is_dir() else None)
    inside = None
    if spec.terrain.tiles:
        world = _world(spec, where, library)
        parts = replace(of_ground(world, world.overview()), world=world)
    elif spec.terrain.elevation:
        parts, inside = _raster_terrain(spec, where, library)
    else:
        parts = _mesh_terrain(spec, where, library)
        inside = far_ground.of_mesh(parts.ground) if spec.terrain.far else None
    if inside is not None:
        parts = _with_far(spec, parts, inside, where)
    files = replace(parts, objects=tuple(_object(item, spec.folder, where) for item in spec.objects))
    for doubt in _doubts(spec, files):
        warnings.warn(f"{where}: {doubt}", ThermorenderWarning, stacklevel=3)
    return files


def of_ground(world: World, ground: WorldGround) -> SceneFiles:
    """Return the SceneFiles of a part of a tiled ground."""
    return SceneFiles(ground.frame, ground.surfaces, (), ground.drapes, world.library)


def _world(spec: SceneSpec, where: str, library: Mapping[str, Material]) -> World:
    tiles = spec.terrain.tiles
    assert tiles is not None
    added_m = spec.terrain.geoid_undulation_m or 0.0 if spec.terrain.height_reference == "geoid" else None
    colours = Colours(rasters_of(tiles.orthophoto)) if tiles.orthophoto else None
    crs = None if colours is None else colours.extent.crs
    classes = Classes(rasters_of(tiles.classes), crs) if tiles.classes else None
    crs = classes.extent.crs if crs is None and classes is not None else crs
    return world_of(
        Heights(rasters_of(tiles.elevation), added_m, crs), colours, classes,
        spec.emissivity.classes, library, where, LocalFrame(*spec.frame) if spec.frame else None,
    )  # fmt: skip


def _doubts(spec: SceneSpec, files: SceneFiles) -> Iterator[str]:
    """Sentences on meshes that look as if they were in another frame or unit."""
    ends = [each(surface.vertices, axis=0) for surface in files.near for each in (np.min, np.max)]
    extent = np.ptp(ends, axis=0)
    if spec.terrain.mesh:
        path = spec.terrain.mesh
        facing = np.sum([vector_area(surface.vertices, surface.faces) for surface in files.near], axis=0)
        yield from terrain_doubts(f"the mesh {path.name}", extent, facing, spec.terrain.axes, mesh.up_of(path))
    for one in files.objects:
        if one.item.file:
            above_m = float(one.columns.get("above_ground_m", np.array(one.item.position[2])).min())
            what, own = f"object {one.name!r}", mesh.up_of(one.item.file)
            triangles = np.concatenate([surface.vertices[surface.faces] for surface in one.surfaces])
            if one.places is not None:
                above_m += float(np.median(one.places["above_ground_m"]))
                triangles = triangles * np.median(one.places["scale"])
            yield from object_doubts(what, triangles, one.item.axes, own, above_m, float(extent.max()))


def _heights(
    path: Path, reference: str, spec: SceneSpec
) -> tuple[NDArray[np.float64], Grid]:  # fmt: skip
    """(heights above the ellipsoid (h, w) [m], their Grid) of an elevation raster."""
    height, grid = terrain.read_elevation(path)
    return height + (spec.terrain.geoid_undulation_m or 0.0 if reference == "geoid" else datum_heights(grid)), grid


def _raster_terrain(
    spec: SceneSpec, where: str, library: Mapping[str, Material]
) -> tuple[SceneFiles, GroundPlan | None]:  # fmt: skip
    """(SceneFiles of a raster terrain, its GroundPlan where far ground lies around it)."""
    source = spec.terrain
    assert source.elevation is not None
    height, grid = _heights(source.elevation, source.height_reference, spec)
    height, made = terrain.filled(height) if source.fill else (height, None)
    frame = LocalFrame(*spec.frame) if spec.frame else terrain.frame_of(height, grid)
    texels = _texel_grid(spec, grid)
    _require_alike(texels, grid)
    try:
        vertices, faces, uv = terrain.mesh(height, grid, frame, texels)
    except MemoryError:
        raise ThermorenderError(
            f"{source.elevation} has {grid.width}×{grid.height} posts, too many for this machine's memory; "
            "thin it with `thermorender import-terrain --max-vertices`"
        ) from None
    away = np.linalg.norm(vertices, axis=-1).min()
    if away > FARTHEST_M:
        raise ThermorenderError(
            f"{where}: frame is {away / 1e3:.0f} km from {grid.name}; give a position on it, or leave [frame] out"
        )
    if not source.orthophoto and spec.emissivity.source == "learned":
        raise ThermorenderError(
            f"{where}: emissivity.source='learned' reads materials from an orthophoto; add terrain.orthophoto"
        )
    surface = bare("terrain", vertices, faces, uv, (texels.height, texels.width), terrain.texel_size_m(texels, frame))
    drape = _drape(source.orthophoto, height, grid, texels)
    if made is not None:
        drape = replace(drape, filled=onto(made.astype(np.float32), grid, texels, "max") == 1.0)
    if spec.emissivity.source == "classes":
        assert spec.emissivity.raster is not None
        classes = classes_on(spec.emissivity.raster, spec.emissivity.classes, texels, where)
        drape = replace(drape, classes=classes, classes_file=spec.emissivity.raster)
    inside = far_ground.of_raster(vertices, height, grid, frame) if source.far else None
    return SceneFiles(frame, (surface,), (), (drape,), library), inside


def _require_alike(texels: Grid, grid: Grid) -> None:
    """Refuse rasters of another map or area than their elevation's."""
    if texels.crs != grid.crs:
        raise ThermorenderError(
            f"{texels.name} has CRS {texels.crs.to_string()} but {grid.name} has {grid.crs.to_string()}; convert both "
            "with `thermorender import-terrain`"
        )
    require_overlap(texels, grid)


def _drape(orthophoto: Path | None, height: NDArray[np.float64], grid: Grid, texels: Grid) -> Drape:
    """The Drape of a raster ground without its classes."""
    colour = valid = None
    if orthophoto:
        colour, valid = read_colour(orthophoto)
        if not valid.any():
            raise ThermorenderError(f"{orthophoto} is empty: every texel is masked; give another orthophoto")
    kept = (height, grid) if orthophoto else None
    return Drape(texels, colour, valid, on_ground=on_ground(height, grid, texels), height=kept)


def _with_far(spec: SceneSpec, files: SceneFiles, inside: GroundPlan, where: str) -> SceneFiles:
    """Files with the far ground around those of the scene."""
    ground, drapes = list(files.ground), list(files.drapes)
    for number, one in enumerate(spec.terrain.far, 1):
        name = "far" if len(spec.terrain.far) == 1 else f"far {number}"
        # The plan of far ground has that of the ground inside.
        surface, drape, inside = _far(one, name, spec, files.frame, inside, where)
        ground.append(surface)
        drapes.append(drape)
    return replace(files, ground=tuple(ground), drapes=tuple(drapes))


def _far(
    one: FarSpec, name: str, spec: SceneSpec, frame: LocalFrame | None, inside: GroundPlan, where: str
) -> tuple[Surface, Drape, GroundPlan]:  # fmt: skip
    """(Surface, Drape, GroundPlan) of one far ground."""
    assert frame is not None
    own, reference = spec.terrain.height_reference, one.height_reference or spec.terrain.height_reference
    if reference != own and spec.terrain.geoid_undulation_m is None:
        raise ThermorenderError(
            f"{where}: heights of {name} ground are above the {reference}, and those of the scene above the {own}; "
            "give geoid_undulation_m in [terrain], the height of the geoid above the ellipsoid"
        )
    height, grid = _heights(one.elevation, reference, spec)
    finest = one.orthophoto or one.classes
    texels = grid if finest is None else grid_of(finest) if one.orthophoto else coarser(grid_of(finest))
    _require_alike(texels, grid)
    far_ground.refuse_finer(grid, terrain.texel_size_m(grid, frame), inside)
    (vertices, faces, uv), plan = far_ground.far_mesh(height, grid, frame, texels, inside)
    surface = bare(name, vertices, faces, uv, (texels.height, texels.width), terrain.texel_size_m(texels, frame))
    drape = _drape(one.orthophoto, height, grid, texels)
    if one.classes:
        numbers, mixed = mixed_classes_on(one.classes, spec.emissivity.classes, texels, where)
        drape = replace(drape, classes=numbers, mixed=mixed, classes_file=one.classes)
    return replace(surface, far=True), drape, plan


def _texel_grid(spec: SceneSpec, elevation_grid: Grid) -> Grid:
    """The finest description of the ground sets the texels: orthophoto, else classes, else temperature."""
    for path in (spec.terrain.orthophoto, spec.emissivity.raster, spec.temperature.raster):
        if path:
            return grid_of(path)
    return elevation_grid


def _mesh_terrain(spec: SceneSpec, where: str, library: Mapping[str, Material]) -> SceneFiles:
    assert spec.terrain.mesh is not None
    names = [one.name for one in spec.surfaces]
    parts = mesh.load(spec.terrain.mesh, spec.folder, names, spec.terrain.axes)
    ground = tuple(_part_surface(part) for part in parts)
    textures = tuple(Texture(part.names, part.texture) for part in parts)
    unseen = [one is not None and one.inferred for one in stating(textures, spec.surfaces, ("inferred",), where)]
    ground = tuple(_flagged(surface, inferred) for surface, inferred in zip(ground, unseen, strict=True))
    frame = LocalFrame(*spec.frame) if spec.frame else None
    files = SceneFiles(frame, ground, textures, (), library)
    return replace(files, textures=_with_classes(spec, files, where))


def _flagged(surface: Surface, inferred: bool | None) -> Surface:
    """A surface whose shape nobody has seen where it is `inferred`."""
    return replace(surface, flags=surface.flags | np.uint8(FILLED)) if inferred else surface


def _with_classes(spec: SceneSpec, files: SceneFiles, where: str) -> tuple[Texture, ...]:
    """The textures of a mesh with the class numbers of their rasters: those on a map, or in the pixels of one."""
    textures, raster = files.textures, spec.emissivity.raster
    own = stating(textures, spec.surfaces, ("material", "classes"), where)
    paths = [None if one is None else one.classes for one in own]
    rest = [k for k, one in enumerate(own) if one is None and textures[k].size]
    found = list(textures)
    classed = raster if spec.emissivity.source == "classes" else None
    map_view = files.map_view if classed and on_map(classed) else None
    if map_view is not None and classed is not None:
        numbers = classes_on(classed, spec.emissivity.classes, map_view.grid, where)
        for k in rest:
            shown = map_view.seen(k)
            if shown.any():
                found[k] = replace(textures[k], classes=map_view.onto(k, numbers), shown=shown)
    elif classed:
        if len(rest) != 1:
            listed = shortened(", ".join(repr(files.ground[k].name) for k in rest), 300) or "none"
            raise ThermorenderError(
                f"{where}: emissivity.raster is in the pixels of one texture, and the mesh has {len(rest)} textures "
                f"without another material ({listed}); give each its raster as classes in a [[surface]], or a raster "
                "with a CRS, which lies on the map"
            )
        paths[rest[0]] = classed
    for k, path in enumerate(paths):
        if path is not None:
            numbers = onto_texels(read_classes(path).astype(np.uint8), path, files.ground[k], textures[k])
            refuse_unnamed(numbers, path, spec.emissivity.classes, where)
            found[k] = replace(textures[k], classes=numbers, file=path)
    return tuple(found)


def _object(item: ObjectSpec, folder: Path, where: str) -> TrackedObject:
    """The TrackedObject of one object: its surfaces in its own frame, and its track; one row where it has none."""
    if item.shape:
        vertices, faces = mesh.primitive(item.shape, item.size)
        colour = np.array(item.colour, dtype=np.uint8).reshape(1, 1, 3)
        parts = [mesh.Part(item.shape, vertices, faces, np.full((len(faces), 3, 2), 0.5, np.float32), colour)]
    else:
        assert item.file is not None
        parts = mesh.load(item.file, folder, item.inner_heat_share, item.axes)
    # A disc is slightly above the ground, so that neither hides the other.
    lift = 0.02 if item.shape == "disc" else 0.0
    surfaces = tuple(
        _flagged(_part_surface(replace(part, name=f"{item.name}:{part.name}")), item.inferred) for part in parts
    )
    time_s, columns = read_track(item.track) if item.track else (np.zeros(1), {})
    places = read_places(item.instances, COLUMNS if item.leaf_area_1_m else {}) if item.instances else None
    if item.leaf_area_1_m and places is None:
        places = dict.fromkeys(("east_m", "north_m", "above_ground_m", "yaw_deg"), np.zeros(1)) | {"scale": np.ones(1)}
    if isinstance(item.temperature, Path):
        assert places is not None
        places |= _leaf_kelvin(item.temperature, len(places["scale"]))
    inner = _inner_shares(item, surfaces, [Texture(part.names) for part in parts], where)
    return TrackedObject(item, surfaces, lift, time_s, columns, places, inner)


def _leaf_kelvin(path: Path, rows: int) -> dict[str, NDArray[np.float64]]:
    """{column of KELVIN: (n,)} of a table of leaf temperatures, with a row for each crown."""
    columns, numbers = read_columns(path, KELVIN, ())
    if len(numbers) != rows:
        raise ThermorenderError(
            f"{path} has {len(numbers)} rows of temperatures for {rows} crowns; give one for each row of instances"
        )
    for name, values in columns.items():
        scene_kelvin(f"{path}: {name}", values)
    return columns


def _inner_shares(
    item: ObjectSpec, surfaces: Sequence[Surface], textures: Sequence[Texture], where: str
) -> tuple[float, ...]:
    """Share of an object's inner heat on a square metre of each of its surfaces [m⁻²]."""
    area = np.array([areas(surface).sum() for surface in surfaces])
    if not item.inner_heat_share:
        return tuple(np.full(len(area), 1.0 / area.sum()).tolist())
    names, part = list(item.inner_heat_share), np.array(list(item.inner_heat_share.values()))
    found = named(textures, names, where, f"inner_heat_share of object {item.name!r}: part", "")
    of = np.array([len(names) if number is None else number for number in found])
    per_m2 = np.append(part / part.sum() / np.maximum(np.bincount(of, area, len(names) + 1)[:-1], 1e-300), 0.0)
    return tuple(per_m2[of].tolist())


def _part_surface(part: mesh.Part) -> Surface:
    shape = part.colour.shape[:2]
    made = bare(part.name, part.vertices, part.faces, part.uv, shape, 1.0)
    return replace(made, colour=part.colour, texel_m=texel_size_m(made))
