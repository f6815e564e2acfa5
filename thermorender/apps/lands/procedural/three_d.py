"""Files of a procedural scene in three dimensions: lit textures, true temperatures, and the survey of it in a folder.

The survey is a scene of rasters: the highest surface under each texel, with its colour, material and true temperature.
So the same world exists twice, and the draped one can be judged against the other.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Scene, load_scene
from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.light import exposed, normals
from thermorender.apps.lands.procedural.noise import stream
from thermorender.apps.lands.procedural.procedural_scene import KINDS, SyntheticScene, painted, posts, scene_of
from thermorender.apps.lands.procedural.scene_files import flight_csv, scene_toml, write_declared, write_temperature
from thermorender.apps.lands.procedural.surroundings import SURROUNDINGS, Surroundings
from thermorender.apps.lands.procedural.truth import drawn
from thermorender.apps.lands.solids.plants import Bodies, write_bodies, write_leaf_tables
from thermorender.apps.lands.solids.textured_mesh import MESH, TexturedMesh, write_kelvin, write_meshes
from thermorender.errors import ThermorenderError
from thermorender.files import atomic_folder
from thermorender.formats import write_text
from thermorender.physics.geodesy import LocalFrame
from thermorender.physics.srgb import bytes_from_linear, linear_from_bytes
from thermorender.progress import Progress
from thermorender.render.daylight import daylight
from thermorender.render.from_above import from_above
from thermorender.render.geometry import Geometry
from thermorender.render.heat.simulation import solved
from thermorender.render.variant import activate
from thermorender.scene.crowns import PATCHES, QUARTERS, Crowns
from thermorender.scene.deviations import Deviations
from thermorender.scene.ground import Ground
from thermorender.scene.raster import Grid, lon_lat
from thermorender.scene.spec import WeatherSpec
from thermorender.scene.surface import Surface
from thermorender.units import ZERO_CELSIUS_K

# Folder of the survey in that of the scene.
SURVEY = "survey"
# Positions in a texel at which the survey looks, in texels from its middle; the first gives the material.
_LOOKS = ((0.0, 0.0), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))
GROUND, BUILDINGS, TRUNKS = "ground", "buildings", "trunks"
# Points of a side between which map positions are interpolated.
_LATTICE = 33
# What stands higher on the ground is no place for an object [m].
_LOW_M = 1.0
# Distance of the ground's posts in those of the survey, and its least [m]: walls and crowns are not in the ground, so
# that it is smooth.
_POSTS, _POST_M = 2.0, 2.0
# Side of the blocks of texels whose temperatures are solved together [texels].
_BLOCK = 2


@dataclass(frozen=True, eq=False)
class World:
    """A procedural scene in three dimensions, unlit."""

    scene: SyntheticScene  # Of the bare ground: its elevation, classes, deviations and weather
    meshes: tuple[TexturedMesh, ...]  # The ground first; coloured by albedo. Heights are above the ellipsoid.
    # (3, h, w) float32 normals of the texels of some of the meshes, by name, with relief that is not in the mesh
    normals: dict[str, NDArray[np.float32]]
    deviations: dict[str, Deviations]  # Of the texels of some of the meshes, by name
    # Crowns and hedges by shape and material; heights are above the ellipsoid
    plants: dict[tuple[str, str], Bodies]


def make_world(
    kind: str, seed: int = 0, size_m: float | None = None, texel_m: float | None = None, post_m: float | None = None,
    time: str | np.datetime64 | None = None, weather: WeatherSpec | None = None, again: int = 0,
) -> World:  # fmt: skip
    """Return a procedural scene in three dimensions; arguments, layout and seeds are those of `make`."""
    if weather is not None and weather.snow_depth_m:
        raise ThermorenderError(
            f"snow_depth_m={weather.snow_depth_m:g}: snow on walls and crowns is not modelled; give 0 (a weather "
            "drawn from a seed may have some), or make a draped scene"
        )
    made = painted(kind, seed, size_m, texel_m, post_m, time, weather, again, solid=True)
    canvas, solids = made.canvas, made.canvas.solids
    assert solids is not None
    normal = np.stack(normals(canvas.surface + canvas.relief, made.texel, steepest=1.3))
    ground, post = _ground(canvas, max(_POST_M, _POSTS * made.post))
    far = Surroundings(canvas, post, KINDS[kind].reach_m, float(canvas.surface.max()) + KINDS[kind].heights_m[1])
    KINDS[kind].around(far)
    meshes = [ground]
    if len(solids.quads):
        meshes.append(solids.quads.mesh(BUILDINGS))
    if solids.plants.trunks:
        meshes.append(solids.plants.mesh(TRUNKS))
    scene = scene_of(made)
    mirrored = {name: far.mirrored(values) for name, values in vars(scene.deviations).items()}
    return World(
        scene, (ground, *(_within(mesh, 0.5 * made.size) for mesh in meshes[1:]), far.mesh()),
        {GROUND: normal, SURROUNDINGS: far.normals()},
        {GROUND: scene.deviations, SURROUNDINGS: Deviations(**mirrored)},
        {key: each for key, each in solids.plants.bodies.items() if _inside(each, 0.5 * made.size)},
    )  # fmt: skip


def _inside(bodies: Bodies, half: float) -> bool:
    """Leave out bodies beyond the ground's edge; return whether any is left."""
    bodies.rows = bodies.rows[(np.abs(bodies.rows[:, :2]) <= half).all(axis=1)]
    return bool(len(bodies.rows))


def _within(mesh: TexturedMesh, half: float) -> TexturedMesh:
    """A TexturedMesh without the faces beyond the ground's edge."""
    inside = (np.abs(mesh.vertices[mesh.faces].mean(axis=1)[:, :2]) <= half).all(axis=1)
    return replace(mesh, faces=mesh.faces[inside], uv=mesh.uv[inside])


def _ground(canvas: Canvas, post_m: float) -> tuple[TexturedMesh, NDArray[np.float64]]:
    """The ground as a TexturedMesh of cells of about `post_m`, and the heights of its posts (K + 1, K + 1) [m], means
    around them.
    """
    import cv2

    surface, size = canvas.surface, canvas.size
    count = max(2, round(size / post_m))
    cells = cv2.resize(surface - surface.mean(), (count, count), interpolation=cv2.INTER_AREA)
    around = np.pad(cells, 1, "edge").astype(np.float64)
    post = 0.25 * (around[:-1, :-1] + around[:-1, 1:] + around[1:, :-1] + around[1:, 1:]) + float(surface.mean())
    line = np.arange(count + 1) / count
    u, v = np.meshgrid(line, line)
    vertices = np.stack([(u - 0.5) * size, (0.5 - v) * size, post], axis=-1).reshape(-1, 3)
    index = np.arange((count + 1) ** 2).reshape(count + 1, count + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]))
    faces = np.concatenate([np.stack([a, c, d], axis=-1), np.stack([a, d, b], axis=-1)])
    uv = np.stack([u.ravel(), v.ravel()], axis=-1)[faces].astype(np.float32)
    colour = bytes_from_linear(np.clip(canvas.albedo, 0.0, 1.0))
    return TexturedMesh(GROUND, vertices, faces, uv, colour, canvas.material), post


def write(world: World, directory: str | Path, overwrite: bool = False, progress: Progress | None = None) -> Path:
    """Write a World as a scene with its true temperatures, and its survey as a scene in `survey`; return the folder."""
    scene, frame, meshes = world.scene, _frame(world.scene), _on_frame(world)
    heights = Ground(meshes), Ground(meshes[:1])  # type: ignore[arg-type]
    scene = replace(scene, objects=_standing(scene.objects, heights))
    flight = scene.flight
    up = flight["above_ground_m"] + heights[1](flight["east_m"], flight["north_m"])
    flight = {("up_m" if key == "above_ground_m" else key): value for key, value in flight.items()} | {"up_m": up}
    with atomic_folder(directory, overwrite) as draft:
        write_leaf_tables(draft)
        planted = replace(scene, objects=(*scene.objects, *write_bodies(draft, world.plants, frame.height_m)))
        tables = _declare(draft, planted, frame, meshes, known=False)
        loaded = load_scene(draft)
        geometry = Geometry(activate(), loaded.surfaces)
        # Other objects are those of the survey too: neither they nor their shadows are in its rasters, but for the
        # little sky that they hide, which is traced once for all.
        crowns = [surface for surface in loaded.surfaces if isinstance(surface.instances, Crowns)]
        terrain = Geometry(activate(), [*loaded.surfaces[: loaded.terrain_count], *crowns])
        meshes = _lit(loaded, terrain, meshes, world, geometry)
        kelvin, warm_k, leaves = _true_kelvin(loaded, geometry, world, progress)
        kept = {item["name"] for item in scene.objects}
        seen = replace(world.scene, objects=tuple(item for item in world.scene.objects if item["name"] in kept))
        scene, seen = (replace(each, objects=_solved(each.objects, warm_k)) for each in (scene, seen))
        for bodies in world.plants.values():
            bodies.kelvin = leaves[bodies.name]
        scene = replace(scene, objects=(*scene.objects, *write_bodies(draft, world.plants, frame.height_m)))
        for table, mesh in zip(tables, meshes, strict=True):
            table["temperature"] = f"{mesh.name}_kelvin.tif"
            write_kelvin(draft / table["temperature"], kelvin[mesh.name])
        _declare(draft, scene, frame, meshes, known=True)
        write_text(draft / "flight.csv", flight_csv(flight))
        colour = _by_surface(loaded, {mesh.name: mesh.colour.reshape(-1, 3) for mesh in meshes})
        warm = _by_surface(loaded, {name: values.ravel() for name, values in kelvin.items()})
        colour = np.concatenate([colour, *(each.colour.reshape(-1, 3) for each in crowns)])
        warm = np.concatenate([warm, *(_texels(leaves[each.name.split(":")[0]], each) for each in crowns)])
        (draft / SURVEY).mkdir()
        write_survey(seen, frame, terrain, draft / SURVEY, loaded, colour, warm)
        write_text(draft / SURVEY / "flight.csv", flight_csv(flight))
    return Path(directory)


def _frame(scene: SyntheticScene) -> LocalFrame:
    """The LocalFrame at the middle of a scene's extent."""
    x, y = scene.corner[0] + 0.5 * scene.size_m, scene.corner[1] - 0.5 * scene.size_m
    (longitude,), (latitude,) = lon_lat(_grid(scene), np.array([x]), np.array([y]))
    return LocalFrame(float(latitude), float(longitude), float(np.round(np.median(scene.elevation))))


def _place(frame: LocalFrame) -> dict[str, float]:
    """The table [frame] of a LocalFrame."""
    return {"latitude_deg": frame.latitude_deg, "longitude_deg": frame.longitude_deg, "height_m": frame.height_m}


def _grid(scene: SyntheticScene) -> Grid:
    from rasterio import Affine
    from rasterio.crs import CRS

    side = len(scene.classes)
    transform = Affine(scene.texel_m, 0.0, scene.corner[0], 0.0, -scene.texel_m, scene.corner[1])
    return Grid(CRS.from_epsg(scene.epsg), transform, side, side)


def _on_frame(world: World) -> list[TexturedMesh]:
    """The meshes with heights above the local frame's origin."""
    down = np.array([0.0, 0.0, _frame(world.scene).height_m])
    return [replace(mesh, vertices=mesh.vertices - down) for mesh in world.meshes]


def _standing(items: Sequence[dict[str, Any]], heights: tuple[Ground, Ground]) -> tuple[dict[str, Any], ...]:
    """Objects on the ground, though the scene stands objects on the highest surface below them. Those within a
    building, as in a small cut of a land, are left out with all their parts, "car_1" with "car_1_roof".
    """
    raised = []
    for item in items:
        highest, ground = (float(each(*item["position"][:2])) for each in heights)
        raised.append(highest - ground)
    whole = lambda item: re.sub(r"(?<=[a-z\d])_[a-z]+$", "", item["name"])  # noqa: E731
    within = {whole(item) for item, over in zip(items, raised, strict=True) if over > _LOW_M}
    return tuple(
        {**item, "position": [*item["position"][:2], item["position"][2] - over]}
        for item, over in zip(items, raised, strict=True) if whole(item) not in within
    )  # fmt: skip


def _declare(
    folder: Path, scene: SyntheticScene, frame: LocalFrame, meshes: list[TexturedMesh], known: bool
) -> list[dict[str, Any]]:
    """Write mesh, classes and scene.toml; return the [[surface]] tables."""
    tables = write_meshes(folder, meshes, photographs=True)
    if known:
        tables = [{**table, "temperature": f"{table['name']}_kelvin.tif"} for table in tables]
    assert scene.weather.air_high_c is not None
    air = {"source": "constant", "value": round(scene.weather.air_high_c + ZERO_CELSIUS_K, 2)}
    solid = {
        "terrain": {"mesh": MESH}, "temperature": air if known else {"source": "balance"}, "frame": _place(frame),
        "emissivity": {"source": "material", "material": scene.class_names[1], "classes": scene.class_names},
        "truth": {"temperature": True} if known else None, "surface": tables,
    }  # fmt: skip
    write_text(folder / "scene.toml", scene_toml(scene, known, solid))
    return tables


def _name(surface: Surface) -> str:
    return surface.name.split(":")[1]


def _by_surface(loaded: Scene, values: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Values of meshes, by name, one after another in the order of the scene's terrain."""
    return np.concatenate([values[_name(surface)] for surface in loaded.surfaces[: loaded.terrain_count]])


def _split(loaded: Scene, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """{name: (h, w, ...)} of flat values in the order of the scene's terrain."""
    terrain = loaded.surfaces[: loaded.terrain_count]
    ends = np.cumsum([surface.material.size for surface in terrain])
    parts = np.split(values[: ends[-1]], ends[:-1])
    return {_name(s): part.reshape(*s.material.shape, *part.shape[1:]) for s, part in zip(terrain, parts, strict=True)}


def _lit(
    loaded: Scene, geometry: Geometry, meshes: list[TexturedMesh], world: World, around: Geometry
) -> list[TexturedMesh]:
    """The meshes with the colours of a photograph: lit by sun and sky, exposed as the orthophoto of a 2.5-D scene."""
    scene = world.scene
    normal = {mesh.name: np.full((mesh.classes.size, 3), np.nan, np.float32) for mesh in meshes}
    normal |= {name: np.moveaxis(values, 0, -1).reshape(-1, 3) for name, values in world.normals.items()}
    light = daylight(geometry, loaded.terrain_count, scene.sun, _by_surface(loaded, normal), around)
    albedo = linear_from_bytes(_by_surface(loaded, {mesh.name: mesh.colour.reshape(-1, 3) for mesh in meshes}))
    shot = exposed(albedo, light.cosine, light.sky, scene.sun[1], scene.weather.cloud or 0.0)
    lit = _split(loaded, np.where(light.shown[:, None], bytes_from_linear(shot), bytes_from_linear(albedo)))
    return [replace(mesh, colour=lit[mesh.name]) for mesh in meshes]


def _true_kelvin(
    loaded: Scene, geometry: Geometry, world: World, progress: Progress | None
) -> tuple[dict[str, NDArray[np.float32]], dict[str, float], dict[str, NDArray[np.float64]]]:
    """({mesh: (h, w) [K]}, {object: [K]}, {object of crowns: (n, 8) columns of KELVIN}): the true temperatures, from
    drawn properties as in 2.5-D, and mean ones of solid objects.
    """
    assert loaded.time is not None
    true, exchange = drawn(loaded, world.scene.kind, world.scene.seed)
    sizes = {_name(surface): surface.material.size for surface in loaded.surfaces[: loaded.terrain_count]}
    bodies = loaded.surfaces[loaded.terrain_count : loaded.solved_count]
    fields = {}
    for name in vars(world.scene.deviations):
        own = {mesh: np.ones(size, np.float32) for mesh, size in sizes.items()}
        own |= {mesh: np.ravel(getattr(values, name)) for mesh, values in world.deviations.items()}
        # Objects are as their tables say.
        objects = [np.ones(each.material.size, np.float32) for each in bodies]
        fields[name] = np.concatenate([_by_surface(loaded, own), *objects])
    fields["exchange"] = np.float32(exchange) * fields["exchange"]
    found = solved(true, [loaded.time], geometry, progress, Deviations(**fields), _BLOCK)[0]
    kelvin = np.concatenate([surface.temperature.ravel() for surface in found.surfaces[: found.terrain_count]])
    leaves = {}
    for surface in found.surfaces:
        if isinstance(surface.instances, Crowns):
            assert surface.scatter_k is not None
            count = PATCHES * len(surface.instances)
            mean, more = (each.reshape(-1)[:count].reshape(-1, QUARTERS, 2).mean(axis=2)
                          for each in (surface.temperature, surface.scatter_k))  # fmt: skip
            leaves[surface.name.split(":")[0]] = np.column_stack([mean, mean + more]).astype(np.float64)
    return _split(loaded, kelvin), _seen_k(found), leaves


def _texels(kelvin: NDArray[np.float64], crowns: Surface) -> NDArray[np.float64]:
    """Mean temperatures of leaves, (n, 8) columns of KELVIN, on the texels of crowns."""
    return np.resize(np.repeat(kelvin[:, :QUARTERS], 2, axis=1).reshape(-1), crowns.material.size)


def _seen_k(scene: Scene) -> dict[str, float]:
    """{object: temperature [K] of a blackbody with its mean emission}, over its faces by how much sky is above each."""
    sums: dict[str, NDArray[np.float64]] = {}
    for body in scene.surfaces[scene.terrain_count : scene.solved_count]:
        if body.instances is not None:
            continue
        corner = body.vertices[body.faces]
        across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
        # Area times the view factor of the sky, (1 + cos) / 2, of a face in the open.
        share = np.linalg.norm(across, axis=1) + across[:, 2]
        # Each face has a texel of its own.
        emitted = share @ body.temperature.ravel()[: len(share)].astype(np.float64) ** 4
        name = body.name.split(":")[0]
        sums[name] = sums.get(name, np.zeros(2)) + (emitted, share.sum())
    return {name: float((emitted / share) ** 0.25) for name, (emitted, share) in sums.items()}


def _solved(objects: Sequence[dict[str, Any]], kelvin: dict[str, float]) -> tuple[dict[str, Any], ...]:
    """[[object]] tables with solved temperatures."""
    known = []
    for item in objects:
        if item["name"] in kelvin:
            item = {**item, "temperature": round(kelvin[item["name"]], 1), "follows_balance": True}
        known.append(item)
    return tuple(known)


def _positions(frame: LocalFrame, grid: Grid, across: float, down: float) -> NDArray[np.float64]:
    """Positions (n, 3) in a local frame [m] of the texels of a grid, moved by (`across`, `down`) from their middles.

    They are interpolated between those of 33² points, by parabolas.
    """
    from scipy.interpolate import RectBivariateSpline

    line = [np.linspace(0.0, count, _LATTICE) for count in (grid.height, grid.width)]
    row, column = np.meshgrid(*line, indexing="ij")
    longitude, latitude = lon_lat(grid, *(each.ravel() for each in grid.to_map(column, row)))
    known = frame.enu_from_geodetic(latitude, longitude, np.full(longitude.size, frame.height_m))
    at = np.arange(grid.height) + 0.5 + down, np.arange(grid.width) + 0.5 + across
    axes = (RectBivariateSpline(*line, axis.reshape(row.shape), kx=2, ky=2)(*at).ravel() for axis in known.T)
    return np.column_stack(list(axes))


def write_survey(
    scene: SyntheticScene, frame: LocalFrame, geometry: Geometry, folder: Path, loaded: Scene,
    colour: NDArray[np.uint8], kelvin: NDArray[np.floating],
) -> None:  # fmt: skip
    """Write what a survey from above sees as a scene of rasters, from colours (T, 3) and temperatures (T,) [K] of the
    terrain's texels.
    """
    grid, light = _grid(scene), linear_from_bytes(colour)
    numbers = {material.name: number for number, material in enumerate(loaded.materials)}
    value = np.zeros(256, np.uint8)
    for number, name in scene.class_names.items():
        if name in numbers:
            value[numbers[name]] = number
    material = np.concatenate([surface.material.ravel() for surface in geometry.surfaces])
    height = shot = warm = 0.0  # type: Any
    for number, (across, down) in enumerate(_LOOKS):
        place = _positions(frame, grid, across, down)
        up, texel = from_above(geometry, place[:, 0], place[:, 1])
        # Map and ground differ by the map's scale: at the edge the outermost ray may miss.
        missed = texel < 0
        if missed.any():
            edge = 0.5 * scene.size_m - 0.01
            near = np.clip(place[missed, :2], -edge, edge)
            up[missed], texel[missed] = from_above(geometry, near[:, 0], near[:, 1])
        if number == 0:
            classes = value[material[texel]]
        # The plane of the local frame lies above the ellipsoid's curve.
        height = height + up - place[:, 2]
        shot, warm = shot + light[texel], warm + kelvin[texel]
    count, shape = len(_LOOKS), (grid.height, grid.width)
    grain = 1.1 * stream(scene.seed, "survey").standard_normal((*shape, 1))
    picture = bytes_from_linear(shot / count).reshape(*shape, 3) + grain
    surface = (height / count + frame.height_m).reshape(shape).astype(np.float32)
    seen = replace(
        scene, elevation=posts(surface, scene.size_m, scene.post_m), classes=classes.reshape(shape),
        orthophoto=np.clip(picture + 0.5, 0, 255).astype(np.uint8),
    )  # fmt: skip
    write_declared(seen, folder)
    # As the truth in three dimensions.
    every = _BLOCK if grid.width % _BLOCK == 0 else 1
    write_temperature(seen, folder, (warm / count).reshape(shape), every)
    # By default the frame has the median height of the raster, which the world's frame has not.
    write_text(folder / "scene.toml", scene_toml(seen, other={"frame": _place(frame)}))
