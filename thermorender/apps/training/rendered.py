"""A rendered campaign: pairs of visible and thermal pictures of procedural landscapes, with ground truth.

A *world* is a landscape of one seed under the weather of another, at several hours of one day. Its true temperatures
deviate from tables and station data (`lands.procedural.truth`), as outdoors. Views are nadir, oblique, and forward with
sky. The thermal picture is the camera's reading; a pair also holds the truth, the heat balance's prediction from table
values, and the relief per pixel.

Parts have different landscapes and weathers. Each world is one shard, so a campaign can be resumed.
"""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thermorender import defaults
from thermorender.apps.lands.procedural.noise import stream
from thermorender.apps.lands.procedural.procedural_scene import KINDS, SyntheticScene, make, weather_of
from thermorender.apps.lands.procedural.scene_files import write_declared
from thermorender.apps.lands.procedural.truth import drawn
from thermorender.apps.lands.procedural.weather import atmosphere
from thermorender.apps.training.dataset import Dataset, Entry, ThermalScale, read_dataset
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.atmosphere.declared_air import declared_air
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.output.photograph import sky_of, with_sky
from thermorender.progress import Progress
from thermorender.render.heat.conditions import conditions
from thermorender.scene.load import load_scene
from thermorender.scene.scene import Scene
from thermorender.scene.spec import WeatherSpec
from thermorender.sensor.camera import load_camera
from thermorender.sensor.readout import radiance_from_counts
from thermorender.trajectory.path import pose
from thermorender.units import utc_text

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer

# Factor on the kind's texel and post spacing, and texels per side: a quarter of the kind's area at 1.6 times its texel
# is a tenth of the work.
COARSER, SIDE_TEXELS = 1.6, 500
# Factor on the height of forward views, because the land ends at its edge.
AHEAD = 0.4
# Views of an hour, in turn: name, lowest and highest pitch [deg].
VIEWS = (
    ("nadir", -90.0, -80.0), ("oblique", -60.0, -35.0), ("forward", -16.0, -4.0), ("nadir", -90.0, -80.0),
    ("oblique", -60.0, -35.0), ("forward", -16.0, -4.0), ("oblique", -75.0, -45.0),
)  # fmt: skip
# One in this many test worlds is drawn a second time, to measure the irreducible error.
_REDRAWN_ONE_IN = 2
MOST_VIEWS = 10
# Tolerated spectral error of the truth [mK]: less than half of the camera's noise. For drawn weathers 64 nodes do not
# reach 5 mK.
_TOLERANCE_MK = 20.0


@dataclass(frozen=True)
class World:
    """A landscape under a weather, at several hours of one day."""

    name: str
    kind: str
    seed: int
    weather_seed: int
    part: str
    redrawn: bool


def worlds(
    train: int = 60, validation: int = 6, test: int = 12, seed: int = 0, kinds: Sequence[str] = tuple(KINDS)
) -> list[World]:
    """Return the Worlds of a campaign: the given number per part, kinds in turn, every land and weather once."""
    for kind in kinds:
        if kind not in KINDS:
            raise ThermorenderError(f"kind={kind!r} is not a synthetic scene; choose one of {', '.join(KINDS)}")
    if min(train, validation, test) < 0 or train + validation + test < 1 or not kinds:
        raise ThermorenderError(f"{train}, {validation}, {test} worlds are not a campaign; give at least one world")
    made: list[tuple[float, World]] = []
    for part, count in (("train", train), ("validation", validation), ("test", test)):
        for number in range(count):
            kind, own = kinds[number % len(kinds)], 1_000_000 * (seed + 1) + len(made)
            redrawn = part == "test" and number // len(kinds) % _REDRAWN_ONE_IN == 0
            # Parts are interleaved, so that an incomplete campaign has some worlds of each.
            made.append(((number + 0.5) / count, World(f"{kind}-{own}", kind, own, own + 500_000, part, redrawn)))
    return [world for _, world in sorted(made, key=lambda each: each[0])]


def render_campaign(
    folder: str | Path, of: Sequence[World], hours: int = 3, views: int = 9, camera: str = defaults.CAMERA,
    resume: bool = False, progress: Progress | None = None, turn: tuple[int, int] = (0, 1),
) -> Dataset:  # fmt: skip
    """Render Worlds into a data set; return the Dataset.

    `hours` are instants of each world's day, evenly spaced from a random hour; `views` are pairs per instant, 1…10.
    `turn` (k, n) renders every n-th world from index k, for n processes on one folder.
    """
    if not (1 <= hours <= 24 and 1 <= views <= MOST_VIEWS):
        raise ThermorenderError(f"hours={hours}, views={views} are not allowed; give 1…24 and 1…{MOST_VIEWS}")
    from thermorender.render.heat.relief import NAMES

    model = load_camera(camera, "camera")
    zero, top = radiance_from_counts(np.array([0.0, 2.0**model.bits - 1]), model)
    scale = ThermalScale("radiance", float((top - zero) / (2.0**model.bits - 1)), float(zero), None, model.band_um)
    card: dict[str, Any] = {
        "name": Path(folder).name, "origin": "rendered", "licence": "MIT", "camera": camera,
        "band_um": list(model.band_um), "materials": sorted(load_library()), "terrain": list(NAMES),
        "hours": hours, "views": views, "coarser": COARSER, "side_texels": SIDE_TEXELS,
        "worlds": [vars(each) for each in of],
    }  # fmt: skip
    writer, report_progress = Writer(folder, card, scale, resume), progress or (lambda task, fraction: None)
    mine = list(of)[turn[0] :: turn[1]]
    for number, world in enumerate(mine):
        if not writer.has(world.name):

            def of_world(task: str, fraction: float, number: int = number, name: str = world.name) -> None:
                report_progress(f"{name}: {task}", (number + fraction) / len(mine))

            writer.shard(world.name, _pairs(world, hours, views, camera, card["materials"], of_world))
    return read_dataset(folder)


def _pairs(
    world: World, hours: int, views: int, camera: str, materials: Sequence[str], report_progress: Progress
) -> Iterator[tuple[Entry, dict[str, bytes]]]:
    """Yield (Entry, files) of all pairs of a World."""
    from thermorender.render.geometry import Geometry
    from thermorender.render.heat.relief import reliefs
    from thermorender.render.heat.simulation import solved
    from thermorender.render.renderer import Renderer
    from thermorender.render.variant import activate

    report_progress("making the land", 0.0)
    lands, times = _lands(world, hours)
    scene = _loaded(lands[0], camera)
    geometry = Geometry(activate(), scene.surfaces)
    draws = [(lands[0], 0)]
    if world.redrawn:
        weather = lands[0].weather
        draws.append((make(world.kind, world.seed, *_sizes(world.kind), weather=weather, again=1), 1))
    predicted, truths = solved(scene, times, geometry), []
    for land, again in draws:
        true, exchange = drawn(scene, world.kind, world.seed, again)
        deviations = replace(land.deviations, exchange=np.float32(exchange) * land.deviations.exchange)
        truths.append(solved(true, times, geometry, deviations=deviations))
    number = np.array([materials.index(each.name) for each in scene.materials], dtype=np.uint8)
    known, order, fields = None, 0, reliefs(scene, times, geometry)
    for hour, (land, time) in enumerate(zip(lands, times, strict=True)):
        report_progress("rendering", (hour + 0.5) / hours)
        spec = atmosphere(land.weather, scene.weather.at(time), scene.altitude_m)
        air = declared_air(spec, scene.camera.band_um, scene.name)
        assert air is not None
        cloud = land.weather.cloud
        assert cloud is not None and scene.frame is not None
        sky_k, renderers = round(air.sky_temperature(scene.altitude_m), 2), []
        for source in (truths[0][hour], predicted[hour], *(each[hour] for each in truths[1:])):
            source = _under(source, air, land.orthophoto)
            renderers.append(Renderer(source, seed=world.seed, tolerance_mk=_TOLERANCE_MK, like=known))
            known = known or renderers[0]
        numbers = conditions(scene.weather, time)
        labels = {"kind": world.kind, "season": _season(time), "weather": _sky(land.weather)}
        for view in range(views):
            name, at = _view(world, hour, view, scene)
            entry, contents = _pair(renderers, at, order, fields[time], number, cloud)
            place = scene.frame.latitude_deg, scene.frame.longitude_deg
            key = f"{world.name}-{hour}-{view}"
            yield replace(
                entry, key=key, part=world.part, parent=key, sequence=world.name, order=order, place=place,
                time=utc_text(time), sky_temperature=sky_k, conditions=numbers, labels={**labels, "view": name},
            ), contents  # fmt: skip
            order += 1


def _sizes(kind: str) -> tuple[float, float, float]:
    """(side, texel, post) of a world [m]."""
    known = KINDS[kind]
    return SIDE_TEXELS * COARSER * known.texel_m, COARSER * known.texel_m, COARSER * known.post_m


def _lands(world: World, hours: int) -> tuple[list[SyntheticScene], list[np.datetime64]]:
    """The land of a World photographed at several hours of its day, and these instants."""
    weather = weather_of(world.kind, world.weather_seed)
    day = weather.time.astype("M8[D]").astype("M8[s]")
    minute = int((weather.time - day) / np.timedelta64(60, "s"))
    times = sorted(day + np.timedelta64((minute + 1440 * k // hours) % 1440, "m") for k in range(hours))
    return [make(world.kind, world.seed, *_sizes(world.kind), weather=replace(weather, time=t)) for t in times], times


def _loaded(land: SyntheticScene, camera: str) -> Scene:
    """The Scene of a land for the heat balance; without objects, whose temperatures are declared."""
    with tempfile.TemporaryDirectory() as folder:
        write_declared(replace(land, objects=()), Path(folder))
        scene = load_scene(folder)
    return scene.with_camera(load_camera(camera, "camera"))


def _under(scene: Scene, air: Atmosphere, colour: np.ndarray) -> Scene:
    """A solved scene under another air, with the colours of another photograph."""
    first, *rest = scene.surfaces
    assert scene.time is not None
    made = scene.with_air(air).with_surfaces((replace(first, colour=colour), *rest))
    terrain = scene.surfaces[: scene.terrain_count]
    return made.with_solved_temperatures(scene.time, [surface.temperature for surface in terrain])


def _view(world: World, hour: int, view: int, scene: Scene) -> tuple[str, np.ndarray]:
    """(name of the view, camera pose) of a pair."""
    name, low, high = VIEWS[view % len(VIEWS)]
    g = stream(world.seed, f"view {hour} {view}")
    half = 0.5 * _sizes(world.kind)[0]
    least, most = np.log(KINDS[world.kind].heights_m)
    height = float(np.exp(g.uniform(least, most)))
    yaw, pitch = float(g.uniform(0.0, 360.0)), float(g.uniform(low, high))
    east, north = g.uniform(-0.4, 0.4, 2) * half
    if name == "oblique":
        # Looking across the land, from beyond its middle.
        east, north = east - 0.35 * half * np.sin(np.radians(yaw)), north - 0.35 * half * np.cos(np.radians(yaw))
    if name == "forward":
        # From an edge, with all of the land ahead.
        aside, height = g.uniform(-0.3, 0.3), AHEAD * height
        sine, cosine = np.sin(np.radians(yaw)), np.cos(np.radians(yaw))
        east, north = half * (aside * cosine - 0.85 * sine), half * (-aside * sine - 0.85 * cosine)
    limit = 0.95 * half
    east, north = (float(np.clip(value, -limit, limit)) for value in (east, north))
    return name, pose(east, north, float(scene.ground(east, north)) + height, yaw, pitch)


def _pair(
    renderers: Sequence["Renderer"], at: np.ndarray, order: int, fields: Mapping[str, np.ndarray], number: np.ndarray,
    cloud: float,
) -> tuple[Entry, dict[str, bytes]]:  # fmt: skip
    """(Entry with the picture's properties, its files) of one view."""
    first = renderers[0]
    frame = first.frame(at, index=order)
    visible, covered = first.visible(at)
    truth, texel = frame.truth, first.texels(at)
    mask = truth["mask"]
    on_ground = texel >= 0
    sky = sky_of(mask)
    visible = with_sky(visible, sky, at, first.scene.camera, cloud)
    # Half precision is enough for relief and sun.
    planes = {
        name: np.where(on_ground, values.ravel()[texel], np.nan).astype(np.float16) for name, values in fields.items()
    }
    material = np.where(on_ground, number[np.minimum(truth["material"], len(number) - 1)], 255).astype(np.uint8)
    images = {
        "radiance": frame.radiance, "kinetic": truth["kinetic_temperature"], "depth": truth["depth"], "mask": mask,
        "material": material, "balance": renderers[1].radiance(at), **planes,
    }  # fmt: skip
    if len(renderers) > 2:
        images["redrawn"] = renderers[2].radiance(at)
    camera = first.scene.camera
    near = truth["depth"][on_ground]
    texel_m = float(np.median(near) * camera.pixel_pitch_um * 1e-3 / camera.focal_length_mm) if near.size else None
    entry = Entry("", "train", "", "", order, frame.radiance.shape, texel_m)
    return entry, packed(visible, frame.counts, (on_ground & covered) | sky, images)


def _season(time: np.datetime64) -> str:
    """Name of the meteorological season of an instant."""
    month = int(time.astype("M8[M]").astype(int)) % 12
    return ("winter", "winter", "spring", "spring", "spring", "summer", "summer", "summer", "autumn", "autumn",
            "autumn", "winter")[month]  # fmt: skip


def _sky(weather: WeatherSpec) -> str:
    """Label of a named day: snow if any, then clear, cloudy or overcast, and windy if the wind is strong."""
    cloud, wind_m_s = weather.cloud, weather.wind_m_s
    assert cloud is not None and wind_m_s is not None
    ground = "snow " if weather.snow_depth_m else ""
    sky = "clear" if cloud < 0.25 else "cloudy" if cloud < 0.75 else "overcast"
    return f"{ground}{sky}{' windy' if wind_m_s > 5.0 else ''}"
