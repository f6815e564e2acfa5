"""A campaign rendered: pairs of visible and thermal pictures of procedural lands, with the truth behind them.

A *world* is a land of a seed under a weather of another, at some hours of one day. Its true temperatures stray from
what tables and station tell (`campaign.worlds`), so that whoever predicts knows as much as outdoors. Views look
straight down, aslant, and ahead with sky in the picture. The thermal picture is what the camera reads; beside it lies,
per pixel, what is really there, what a heat balance with table values predicts of the same view, and the relief.

Worlds of training, validation and test have different lands and different weathers. Each is one shard, so a campaign
can be stopped anywhere and continued.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermorender import defaults
from thermorender.atmosphere.declared import declared_air
from thermorender.campaign.dataset import Entry, ThermalScale, Writer, packed, read_dataset
from thermorender.campaign.worlds import drawn
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.output.photograph import sky_of, with_sky
from thermorender.render.heat.conditions import conditions
from thermorender.scene.load import load_scene
from thermorender.sensor.camera import load_camera
from thermorender.sensor.readout import radiance_from_counts
from thermorender.synthetic.files import write_declared
from thermorender.synthetic.noise import stream
from thermorender.synthetic.weather import atmosphere
from thermorender.synthetic.worlds import KINDS, make, weather_of
from thermorender.trajectory.path import pose
from thermorender.units import utc_text

# Sides of a world's texels and posts in those of its kind, and how many texels a side has: a quarter of the kind's own
# ground at 1.6 times its texel is a tenth of the work.
COARSER, SIDE_TEXELS = 1.6, 500
# Views ahead are from so much lower, as the land ends at its edge.
AHEAD = 0.4
# Views of an hour, in turn: name, lowest and highest pitch [deg].
VIEWS = (
    ("nadir", -90.0, -80.0), ("oblique", -60.0, -35.0), ("forward", -16.0, -4.0), ("nadir", -90.0, -80.0),
    ("oblique", -60.0, -35.0), ("forward", -16.0, -4.0), ("oblique", -75.0, -45.0),
)  # fmt: skip
# One test world out of so many is drawn once more, for the error that nobody can avoid.
_REDRAWN_ONE_IN = 2
MOST_VIEWS = 10
# What the truth may err by for the spectrum's nodes and channels [mK]: less than half of the camera's noise. Weathers
# that are drawn are more than 64 nodes tell to 5 mK.
_TOLERANCE_MK = 20.0


@dataclass(frozen=True)
class World:
    """A land under a weather."""

    name: str
    kind: str
    seed: int
    weather_seed: int
    part: str
    redrawn: bool


def worlds(train=60, validation=6, test=12, seed=0, kinds=tuple(KINDS)):
    """Return the Worlds of a campaign: as many of each part, kinds in turn, every land and weather once.

    Raises
    ------
    ThermorenderError
        Fewer than one world, or an unknown kind.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise ThermorenderError(f"kind={kind!r} is not a synthetic scene; choose of {', '.join(KINDS)}")
    if min(train, validation, test) < 0 or train + validation + test < 1 or not kinds:
        raise ThermorenderError(f"{train}, {validation}, {test} worlds make no campaign; give one world at least")
    made = []
    for part, count in (("train", train), ("validation", validation), ("test", test)):
        for number in range(count):
            kind, own = kinds[number % len(kinds)], 1_000_000 * (seed + 1) + len(made)
            redrawn = part == "test" and number // len(kinds) % _REDRAWN_ONE_IN == 0
            # Parts are mixed, so that a campaign that is not whole yet has something of each.
            made.append(((number + 0.5) / count, World(f"{kind}-{own}", kind, own, own + 500_000, part, redrawn)))
    return [world for _, world in sorted(made, key=lambda each: each[0])]


def render_campaign(
    folder, of, hours=3, views=9, camera=defaults.CAMERA, resume=False, progress=None, turn=(0, 1)
):  # fmt: skip
    """Render Worlds into a data set; return the Dataset.

    Parameters
    ----------
    folder : path
    of : sequence of World
    hours : int
        Instants of each world's day, evenly spread over 24 h from one that the weather's seed draws.
    views : int
        Pairs of each instant, 1 … 10.
    camera : str
    resume : bool
        Continue a campaign of the same settings.
    progress : callable, optional
        Called with (what, share done).
    turn : (k, n)
        Of several processes on one folder, that which takes every n-th world from number k on.

    Raises
    ------
    ThermorenderError
        A number out of range, or a folder that cannot be used.
    """
    if not (1 <= hours <= 24 and 1 <= views <= MOST_VIEWS):
        raise ThermorenderError(f"hours={hours}, views={views} are not allowed; give 1…24 and 1…{MOST_VIEWS}")
    from thermorender.render.heat.relief import NAMES

    model = load_camera(camera, "camera")
    zero, top = radiance_from_counts(np.array([0.0, 2.0**model.bits - 1]), model)
    scale = ThermalScale("radiance", float((top - zero) / (2.0**model.bits - 1)), float(zero), None, model.band_um)
    card = {
        "name": Path(folder).name, "origin": "rendered", "licence": "MIT", "camera": camera,
        "band_um": list(model.band_um), "materials": sorted(load_library()), "terrain": list(NAMES),
        "hours": hours, "views": views, "coarser": COARSER, "side_texels": SIDE_TEXELS,
        "worlds": [vars(each) for each in of],
    }  # fmt: skip
    writer, tell = Writer(folder, card, scale, resume), progress or (lambda what, share: None)
    mine = list(of)[turn[0] :: turn[1]]
    for number, world in enumerate(mine):
        if not writer.has(world.name):
            told = lambda what, share, n=number: tell(f"{mine[n].name}: {what}", (n + share) / len(mine))  # noqa: E731
            writer.shard(world.name, _pairs(world, hours, views, camera, card["materials"], told))
    return read_dataset(folder)


def _pairs(world, hours, views, camera, materials, tell):
    """Give (Entry, files) of all pairs of a World."""
    from thermorender.render.geometry import Geometry
    from thermorender.render.heat.march import solved
    from thermorender.render.heat.relief import reliefs
    from thermorender.render.renderer import Renderer
    from thermorender.render.variant import activate

    tell("making the land", 0.0)
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
        hidden = replace(land.hidden, exchange=np.float32(exchange) * land.hidden.exchange)
        truths.append(solved(true, times, geometry, hidden=hidden))
    number = np.array([materials.index(each.name) for each in scene.materials], dtype=np.uint8)
    known, order, fields = None, 0, reliefs(scene, times, geometry)
    for hour, (land, time) in enumerate(zip(lands, times, strict=True)):
        tell("rendering", (hour + 0.5) / hours)
        spec = atmosphere(land.weather, scene.weather.at(time), scene.altitude_m)
        air = declared_air(spec, scene.camera.band_um, scene.name)
        sky_k, renderers = round(air.sky_temperature(scene.altitude_m), 2), []
        for source in (truths[0][hour], predicted[hour], *(each[hour] for each in truths[1:])):
            source = _under(source, air, land.orthophoto)
            renderers.append(Renderer(source, seed=world.seed, tolerance_mk=_TOLERANCE_MK, like=known))
            known = known or renderers[0]
        told = conditions(scene.weather, time)
        labels = {"kind": world.kind, "season": _season(time), "weather": _sky(land.weather)}
        for view in range(views):
            name, at = _view(world, hour, view, scene)
            entry, contents = _pair(renderers, at, order, fields[time], number, land.weather.cloud)
            place = scene.frame.latitude_deg, scene.frame.longitude_deg
            key = f"{world.name}-{hour}-{view}"
            yield replace(
                entry, key=key, part=world.part, parent=key, sequence=world.name, order=order, place=place,
                time=utc_text(time), sky_temperature=sky_k, conditions=told, labels={**labels, "view": name},
            ), contents  # fmt: skip
            order += 1


def _sizes(kind):
    """(side, texel, post) of a world [m]."""
    known = KINDS[kind]
    return SIDE_TEXELS * COARSER * known.texel_m, COARSER * known.texel_m, COARSER * known.post_m


def _lands(world, hours):
    """The land of a World, photographed at some hours of its day, and these instants."""
    weather = weather_of(world.kind, world.weather_seed)
    day = weather.time.astype("M8[D]").astype("M8[s]")
    minute = int((weather.time - day) / np.timedelta64(60, "s"))
    times = sorted(day + np.timedelta64((minute + 1440 * k // hours) % 1440, "m") for k in range(hours))
    return [make(world.kind, world.seed, *_sizes(world.kind), weather=replace(weather, time=t)) for t in times], times


def _loaded(land, camera):
    """The Scene of a land with its temperatures to be balanced, without objects: theirs are of no balance."""
    with tempfile.TemporaryDirectory() as folder:
        write_declared(replace(land, objects=()), Path(folder))
        scene = load_scene(folder)
    return scene.with_camera(load_camera(camera, "camera"))


def _under(scene, air, colour):
    """A solved scene under an air and in the colours of another photograph."""
    first, *rest = scene.surfaces
    made = scene.with_air(air).with_surfaces((replace(first, colour=colour), *rest))
    terrain = scene.surfaces[: scene.terrain_count]
    return made.with_solved_temperatures(scene.time, [surface.temperature for surface in terrain])


def _view(world, hour, view, scene):
    """(name of the view, pose) of a pair."""
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


def _pair(renderers, at, order, fields, number, cloud):
    """(Entry with what the picture tells, its files) of one view."""
    first = renderers[0]
    frame = first.frame(at, index=order)
    visible, covered = first.visible(at)
    truth, texel = frame.truth, first.texels(at)
    mask = truth["mask"]
    on_ground = texel >= 0
    sky = sky_of(mask)
    visible = with_sky(visible, sky, at, first.scene.camera, cloud)
    # Half precision: what relief and sun tell is not known better.
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


def _season(time):
    """Name of the meteorological season of an instant."""
    month = int(time.astype("M8[M]").astype(int)) % 12
    return ("winter", "winter", "spring", "spring", "spring", "summer", "summer", "summer", "autumn", "autumn",
            "autumn", "winter")[month]  # fmt: skip


def _sky(weather):
    """One word or two for a named day: snow, or clear, cloudy, overcast, and whether the wind is strong."""
    ground = "snow " if weather.snow_depth_m > 0.0 else ""
    sky = "clear" if weather.cloud < 0.25 else "cloudy" if weather.cloud < 0.75 else "overcast"
    return f"{ground}{sky}{' windy' if weather.wind_m_s > 5.0 else ''}"
