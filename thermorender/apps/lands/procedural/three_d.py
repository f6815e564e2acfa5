"""Files of a procedural scene in three dimensions: lit textures, true temperatures, and the survey of it in a folder.

The survey is a scene of rasters: the highest surface under each texel, with its colour, material and true temperature.
So the same world exists twice, and the draped one can be judged against the other.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.light import exposed
from thermorender.apps.lands.procedural.noise import stream
from thermorender.apps.lands.procedural.procedural_scene import SyntheticScene, posts
from thermorender.apps.lands.procedural.scene_files import flight_csv, scene_toml, write_declared, write_temperature
from thermorender.apps.lands.procedural.truth import drawn
from thermorender.apps.lands.procedural.world import World
from thermorender.apps.lands.solids.plants import write_leaf_tables
from thermorender.apps.lands.solids.skin import MESH, Skin, write_kelvin, write_skins
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
from thermorender.scene.deviations import Deviations
from thermorender.scene.ground import Ground
from thermorender.scene.load import load_scene
from thermorender.scene.raster import Grid, lon_lat
from thermorender.scene.scene import Scene
from thermorender.scene.surface import Surface
from thermorender.units import ZERO_CELSIUS_K

# Folder of the survey in that of the scene.
SURVEY = "survey"
# Positions in a texel at which the survey looks, in texels from its middle; the first gives the material.
_LOOKS = ((0.0, 0.0), (-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25))


def write(world: World, directory: str | Path, overwrite: bool = False, progress: Progress | None = None) -> Path:
    """Write a World as a scene with its true temperatures, and its survey as a scene in `survey`; return the folder."""
    scene, frame, skins = world.scene, _frame(world.scene), _on_frame(world)
    heights = Ground(skins), Ground(skins[:1])  # type: ignore[arg-type]
    scene = replace(scene, objects=tuple(_standing(item, heights) for item in scene.objects))
    flight = scene.flight
    up = flight["above_ground_m"] + heights[1](flight["east_m"], flight["north_m"])
    flight = {("up_m" if key == "above_ground_m" else key): value for key, value in flight.items()} | {"up_m": up}
    with atomic_folder(directory, overwrite) as draft:
        write_leaf_tables(draft)
        tables = _declare(draft, scene, frame, skins, known=False)
        loaded = load_scene(draft)
        geometry = Geometry(activate(), loaded.surfaces)
        # Objects are those of the survey too: neither they nor their shadows are in its rasters.
        terrain = Geometry(activate(), loaded.surfaces[: loaded.terrain_count])
        skins = _lit(loaded, terrain, skins, world)
        kelvin = _true_kelvin(loaded, geometry, scene, progress)
        for table, skin in zip(tables, skins, strict=True):
            table["temperature"] = f"{skin.name}_kelvin.tif"
            write_kelvin(draft / table["temperature"], kelvin[skin.name])
        _declare(draft, scene, frame, skins, known=True)
        write_text(draft / "flight.csv", flight_csv(flight))
        colour = _by_surface(loaded, {skin.name: skin.colour.reshape(-1, 3) for skin in skins})
        warm = _by_surface(loaded, {name: values.ravel() for name, values in kelvin.items()})
        (draft / SURVEY).mkdir()
        write_survey(world.scene, frame, terrain, draft / SURVEY, loaded, colour, warm)
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


def _on_frame(world: World) -> list[Skin]:
    """The skins with heights above the local frame's origin."""
    down = np.array([0.0, 0.0, _frame(world.scene).height_m])
    return [replace(skin, vertices=skin.vertices - down) for skin in world.skins]


def _standing(item: dict[str, Any], heights: tuple[Ground, Ground]) -> dict[str, Any]:
    """An object on the ground, though the scene stands objects on the highest surface below them, such as a crown."""
    east, north, up = item["position"]
    highest, ground = (each(east, north) for each in heights)
    return {**item, "position": [east, north, up + float(ground - highest)]}


def _declare(
    folder: Path, scene: SyntheticScene, frame: LocalFrame, skins: list[Skin], known: bool
) -> list[dict[str, Any]]:
    """Write mesh, classes and scene.toml; return the [[surface]] tables."""
    tables = write_skins(folder, skins)
    if known:
        tables = [{**table, "temperature": f"{table['name']}_kelvin.tif"} for table in tables]
    assert scene.weather.air_high_c is not None
    air = {"source": "constant", "value": round(scene.weather.air_high_c + ZERO_CELSIUS_K, 2)}
    solid = {
        "terrain": {"mesh": MESH}, "temperature": air if known else {"source": "balance"}, "frame": _place(frame),
        "emissivity": {"source": "material", "material": scene.class_names[1], "classes": scene.class_names},
        "truth": None, "surface": tables,
    }  # fmt: skip
    write_text(folder / "scene.toml", scene_toml(scene, known, solid))
    return tables


def _name(surface: Surface) -> str:
    return surface.name.split(":")[1]


def _by_surface(loaded: Scene, values: dict[str, NDArray[Any]]) -> NDArray[Any]:
    """Values of skins, by name, one after another in the order of the scene's terrain."""
    return np.concatenate([values[_name(surface)] for surface in loaded.surfaces[: loaded.terrain_count]])


def _split(loaded: Scene, values: NDArray[Any]) -> dict[str, NDArray[Any]]:
    """{name: (h, w, ...)} of flat values in the order of the scene's terrain."""
    terrain = loaded.surfaces[: loaded.terrain_count]
    ends = np.cumsum([surface.material.size for surface in terrain])
    parts = np.split(values[: ends[-1]], ends[:-1])
    return {_name(s): part.reshape(*s.material.shape, *part.shape[1:]) for s, part in zip(terrain, parts, strict=True)}


def _lit(loaded: Scene, geometry: Geometry, skins: list[Skin], world: World) -> list[Skin]:
    """The skins with the colours of a photograph: lit by sun and sky, exposed as the orthophoto of a 2.5-D scene."""
    scene = world.scene
    bare = {skin.name: np.full((skin.classes.size, 3), np.nan, np.float32) for skin in skins}
    bare[skins[0].name] = np.moveaxis(world.ground_normal, 0, -1).reshape(-1, 3)
    light = daylight(geometry, loaded.terrain_count, scene.sun, _by_surface(loaded, bare))
    albedo = linear_from_bytes(_by_surface(loaded, {skin.name: skin.colour.reshape(-1, 3) for skin in skins}))
    shot = exposed(albedo, light.cosine, light.sky, scene.sun[1], scene.weather.cloud or 0.0)
    lit = _split(loaded, np.where(light.shown[:, None], bytes_from_linear(shot), bytes_from_linear(albedo)))
    return [replace(skin, colour=lit[skin.name]) for skin in skins]


def _true_kelvin(
    loaded: Scene, geometry: Geometry, scene: SyntheticScene, progress: Progress | None
) -> dict[str, NDArray[np.float32]]:
    """{skin: (h, w) [K]}: the true temperatures, from drawn properties as in 2.5-D."""
    assert loaded.time is not None
    true, exchange = drawn(loaded, scene.kind, scene.seed)
    sizes = {_name(surface): surface.material.size for surface in loaded.surfaces[: loaded.terrain_count]}
    fields = {}
    for name, values in vars(scene.deviations).items():
        own = {skin: np.ones(size, np.float32) for skin, size in sizes.items()} | {"ground": np.ravel(values)}
        fields[name] = _by_surface(loaded, own)
    fields["exchange"] = np.float32(exchange) * fields["exchange"]
    found = solved(true, [loaded.time], geometry, progress, Deviations(**fields))[0]
    kelvin = np.concatenate([surface.temperature.ravel() for surface in found.surfaces[: found.terrain_count]])
    return _split(loaded, kelvin)


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
    material = np.concatenate([surface.material.ravel() for surface in loaded.surfaces[: loaded.terrain_count]])
    height = shot = warm = 0.0  # type: Any
    for number, (across, down) in enumerate(_LOOKS):
        column, row = np.meshgrid(*(np.arange(grid.width) + 0.5 + shift for shift in (across, down)))
        longitude, latitude = lon_lat(grid, *(each.ravel() for each in grid.to_map(column, row)))
        place = frame.enu_from_geodetic(latitude, longitude, np.full(longitude.size, frame.height_m))
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
    write_temperature(seen, folder, (warm / count).reshape(shape), 1)
    # By default the frame has the median height of the raster, which the world's frame has not.
    write_text(folder / "scene.toml", scene_toml(seen, other={"frame": _place(frame)}))
