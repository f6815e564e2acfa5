"""A terrain's temperatures from its heat balance: sun, shadow, surroundings, groups, blocks, instants."""

from dataclasses import replace

import numpy as np
import pytest

from scenes import WEATHER, write_balance
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix
from thermorender.physics import humidity
from thermorender.render.heat import simulation as heat
from thermorender.render.heat import steps, sun_on_columns
from thermorender.scene import open_ground
from thermorender.scene.deviations import Deviations
from thermorender.scene.load import load_scene

AT = np.datetime64("2018-07-28T12:00:00")
HOUR = np.timedelta64(3600, "s")


def scene_of(folder, **terrain):
    path = write_balance(folder, WEATHER, **terrain) / "scene.toml"
    path.write_text(path.read_text().replace("grass_green", "granite"))
    return load_scene(folder)


@pytest.fixture(scope="module")
def walled(tmp_path_factory):
    """Granite in the west and sand in the east, with a wall 6 m high across both, from west to east."""
    height = np.zeros((32, 32))
    height[14:16] = 6.0
    classes = np.repeat([[1] * 32 + [2] * 32], 64, axis=0)
    return scene_of(tmp_path_factory.mktemp("walled") / "scene", height=height, classes=classes)


@pytest.fixture(scope="module")
def day(walled):
    times = [AT + k * HOUR for k in range(-4, 9)]
    return times, [scene.surfaces[0].temperature for scene in heat.solved(walled, times)]


def test_shade_is_north_of_a_wall_at_noon_and_colder(walled, day):
    times, kelvin = day
    noon = kelvin[times.index(AT)]
    size = noon.shape[0] // 32
    sand = slice(24 * size, 30 * size)
    shaded, lit = noon[11 * size : 13 * size, sand], noon[18 * size : 26 * size, sand]
    # Sand loses some 600 W/m² of sun: 10 K and more at its thermal inertia.
    assert lit.mean() - shaded.mean() > 8.0


def test_thermal_crossover_matches_columns_in_the_open(walled, day):
    """Sand, warmer by day, becomes colder than granite within 20 minutes of the time for columns in the open."""
    times, kelvin = day
    size = kelvin[0].shape[0] // 32
    rows, west, east = slice(24 * size, 30 * size), slice(4 * size, 12 * size), slice(20 * size, 28 * size)
    contrast = np.array([values[rows, east].mean() - values[rows, west].mean() for values in kelvin])
    columns = open_ground.columns(walled.materials, walled.weather, 0.0, open_ground.STATION_ROUGHNESS_M)
    start = times[0] - 48 * HOUR
    state, _ = open_ground.settled(columns, walled.weather, start)
    names = [material.name for material in walled.materials]
    pair = np.array([names.index(name) for name in (walled.materials[1].name, walled.materials[0].name)])
    alone = []
    for at in times:
        state = open_ground.march(columns, walled.weather, state, start, at)[-1]
        alone.append(float(np.subtract(*state.surface_k[pair])))
        start = at

    def crossing(values):
        later = int(np.flatnonzero(np.asarray(values) < 0.0)[0])
        before, after = values[later - 1], values[later]
        return later - 1 + before / (before - after)

    assert contrast.max() > 3.0 and contrast.min() < 0.0
    assert crossing(contrast) == pytest.approx(crossing(alone), abs=20.0 / 60.0)


def each_alone(monkeypatch):
    def every(self, texels, parts, times_s, first_s):
        number = np.arange(len(parts.kind))
        return number, len(self.of_faces.kind) + number, {}

    monkeypatch.setattr(heat._Simulation, "_in_like_sun", every)


def test_texels_in_like_sun_share_a_column_within_30_mk(walled, monkeypatch):
    columns = []
    kept = heat._Simulation._in_like_sun

    def counted(self, texels, parts, times_s, first_s):
        found = kept(self, texels, parts, times_s, first_s)
        columns.append((len(found[0]), len(texels)))
        return found

    monkeypatch.setattr(heat._Simulation, "_in_like_sun", counted)
    shared = heat.solved(walled, [AT])[0].surfaces[0].temperature
    each_alone(monkeypatch)
    difference = shared - heat.solved(walled, [AT])[0].surfaces[0].temperature
    assert columns[0][0] < 0.6 * columns[0][1]
    # A share in steps of 1/64 errs by 1/128 of the sun's 25 K at most, and the air by 6.5 mK/m over a wall of 6 m.
    assert 0.0 < np.sqrt(np.mean(difference**2)) < 0.03 and abs(difference).max() < 0.25


@pytest.mark.slow
def test_shared_columns_differ_little(walled, monkeypatch):
    """Texels of one face and material share a column until four hours before: at most 0.1 K RMS."""
    shared = heat.solved(walled, [AT])[0].surfaces[0].temperature
    each_alone(monkeypatch)
    monkeypatch.setattr(heat, "_OWN_S", 1e9)
    each = heat.solved(walled, [AT])[0].surfaces[0].temperature
    difference = shared - each
    print("rms", np.sqrt(np.mean(difference**2)), "worst", np.abs(difference).max())
    assert 0.0 < np.sqrt(np.mean(difference**2)) < 0.1


@pytest.mark.slow
def test_shared_columns_and_long_steps_differ_little_where_properties_vary(walled, monkeypatch):
    """Wetness, exchange and inertia of each texel on its own, against quarter hours without sharing: 0.15 K RMS."""
    size = walled.surfaces[0].material.size
    random = np.random.default_rng(5)
    fields = [np.exp(0.2 * random.standard_normal(size)).astype(np.float32) for _ in range(4)]
    varied = Deviations(fields[0] ** 0.3, *fields[1:])
    shared = heat.solved(walled, [AT], deviations=varied)[0].surfaces[0].temperature
    monkeypatch.setattr(heat, "_OWN_S", 1e9)
    monkeypatch.setattr(steps, "_STEPS_S", ((3600.0, 300.0), (np.inf, 900.0)))
    each = heat.solved(walled, [AT], deviations=varied)[0].surfaces[0].temperature
    difference = shared - each
    print("rms", np.sqrt(np.mean(difference**2)), "mean", difference.mean(), "worst", np.abs(difference).max())
    assert 0.0 < np.sqrt(np.mean(difference**2)) < 0.15 and abs(difference.mean()) < 0.03
    # What varies within a triangle is seen: it is not the mean's temperature.
    assert np.std(each - heat.solved(walled, [AT])[0].surfaces[0].temperature) > 0.5


@pytest.mark.slow
def test_sun_between_the_ends_of_steps_differs_little_from_short_steps(walled, monkeypatch):
    kelvin = heat.solved(walled, [AT])[0].surfaces[0].temperature
    minute = ((3600.0, 60.0), (4 * 3600.0, 180.0), (24 * 3600.0, 900.0), (np.inf, 3600.0))
    monkeypatch.setattr(steps, "_STEPS_S", minute)
    error = kelvin - heat.solved(walled, [AT])[0].surfaces[0].temperature
    # Few texels see the edge of a shadow pass: 2 mK in the mean, 24 mK RMS.
    assert abs(error.mean()) < 0.004 and np.sqrt(np.mean(error**2)) < 0.04 and abs(error).max() < 1.5


def test_the_sun_is_tested_once_a_step_and_serves_the_day_after(walled, monkeypatch):
    tested = []
    share = sun_on_columns.sun_share

    def counted(geometry, point, normal, towards, active):
        tested.append(len(np.array(point.x)))
        return share(geometry, point, normal, towards, active)

    monkeypatch.setattr(sun_on_columns, "sun_share", counted)
    heat.solved(walled, [AT])
    start = AT - np.timedelta64(48, "h")
    ends = [0.0, *(at + seconds for at, seconds in steps.steps_to(start, [AT]))]
    up = [end for end in ends if walled.weather.sun(start + np.timedelta64(round(end), "s"))[1] > 0.0]
    late = [end for end in up if end >= 44 * 3600.0]
    early = {round(end) % 86400 for end in up if end <= 44 * 3600.0}
    # Texels alone, at the ends of the last steps, find those in like sun; faces alone are left to test then. These are
    # also tested for the light of the last two half hours, whose middle is beyond a step.
    faces, shared, texels, own = sorted(set(tested))
    found = [tested.count(columns) for columns in (faces, shared, texels, own)]
    assert found == [2 + len(late) - 1, len(early), len(late) - 1, 1]


@pytest.mark.slow
def test_block_size_does_not_change_temperatures(walled, monkeypatch):
    whole = heat.solved(walled, [AT])[0].surfaces[0].temperature
    monkeypatch.setattr(heat, "_AT_ONCE", whole.size // 12)
    parts = heat.solved(walled, [AT])[0].surfaces[0].temperature
    # At the end of a block, texels that share a column have other positions in it.
    assert np.abs(parts - whole).mean() < 0.02


def test_instant_is_the_same_alone_and_among_others(walled, day):
    times, kelvin = day
    late = times[-1]
    alone = heat.solved(walled, [late])[0].surfaces[0].temperature
    # The simulation starts two days before this instant instead of before the first; a day later no difference is left.
    assert np.sqrt(np.mean((alone - kelvin[-1]) ** 2)) < 0.1


def test_first_instant_of_the_weather_can_be_requested(walled):
    """The first instant is the state the simulation starts from; later instants stay in order."""
    first = walled.weather.time[0]
    begin, later = (scene.surfaces[0].temperature for scene in heat.solved(walled, [first, first + HOUR]))
    alone = heat.solved(walled, [first + HOUR])[0].surfaces[0].temperature
    # Alone, texels of a face share a column: over the wall's 6 m the air differs by 0.04 K.
    assert np.abs(later - alone).max() < 0.05
    # It starts at noon in the open, where an hour changes almost nothing; shadows appear with the first steps.
    assert np.isfinite(begin).all() and np.median(np.abs(begin - later)) < 2.0


def test_air_above_the_station_is_drier_and_thinner(walled, monkeypatch):
    """A station 1000 m below equals one whose air was lifted here: 6.5 K/km, relative humidity, pressure."""
    up_m, night = 1000.0, np.datetime64("2018-07-28T02:00:00")
    here = walled.weather
    air = here.air_k - 0.0065 * up_m
    share = humidity.saturation_pressure(air) / humidity.saturation_pressure(here.air_k)
    thinner = humidity.standard_pressure(up_m) / humidity.standard_pressure(0.0)
    below = replace(here, altitude_m=here.altitude_m - up_m)
    brought = replace(here, air_k=air, vapour_pa=here.vapour_pa * share, pressure_pa=here.pressure_pa * thinner)
    both, settled = [], open_ground.settled
    # Both start alike, because deep layers would keep the difference.
    monkeypatch.setattr(open_ground, "settled", lambda columns, weather, *more: settled(columns, brought, *more))
    for weather in (below, brought):
        scene = walled.with_weather(weather)
        both.append([found.surfaces[0].temperature for found in heat.solved(scene, [night, AT])])
    # Both use Magnus' formula and the standard lapse rate; unadjusted vapour and pressure would make 1 K.
    assert max(np.abs(one - other).max() for one, other in zip(*both, strict=True)) < 0.1


@pytest.mark.slow
def test_mixture_emits_the_sum_of_its_parts(walled):
    """Polished metal emits almost nothing: the mix is the sum of ε T⁴ over the parts, not of T⁴."""
    library = load_library()
    parts = [(library[name], share) for name, share in (("aluminium_polished", 0.75), ("asphalt", 0.25))]
    terrain = walled.surfaces[0]
    night = np.datetime64("2018-07-28T02:00:00")

    def kelvin(material):
        surface = replace(terrain, material=np.zeros_like(terrain.material))
        scene = walled.with_surfaces((surface,), (material,))
        # In the open, far from the wall, where only the ground's own material matters.
        return float(heat.solved(scene, [night])[0].surfaces[0].temperature[-6:].mean())

    emits = np.array([share * open_ground.broadband(material) for material, share in parts])
    expected = (emits @ np.array([kelvin(material) for material, _ in parts]) ** 4 / emits.sum()) ** 0.25
    # Each part alone has another wall: 0.2 K.
    assert kelvin(mix(parts)) == pytest.approx(expected, abs=0.2)


def test_missing_snow_material_under_snow_is_reported(tmp_path):
    scene = scene_of(tmp_path / "snow")
    assert not any("m of snow" in note for note in scene.weather_notes)
    path = scene.spec.folder / "scene.toml"
    path.write_text(path.read_text().replace("cloud = 0.1\n", "cloud = 0.1\nsnow_depth_m = 0.3\n"))
    notes = load_scene(path.parent).weather_notes
    assert any("the weather has 0.3 m of snow, but no material of the scene is snow" in note for note in notes)


def test_terrain_that_faces_down_is_refused(walled):
    from dataclasses import replace

    (surface,) = walled.surfaces
    turned = replace(surface, faces=surface.faces[:, ::-1].copy(), uv=surface.uv[:, ::-1])
    turned = walled.with_surfaces((turned,))
    with pytest.raises(ThermorenderError, match=r"most of the terrain's faces point down.*counter-clockwise"):
        heat.solved(turned, [AT])


def test_unsettled_ground_is_reported(walled, monkeypatch):
    monkeypatch.setattr(open_ground, "_MOST_DAYS", 1)
    (scene,) = heat.solved(walled, [AT])
    assert any("did not settle before" in note for note in scene.weather_notes)


def test_dark_spots_in_vegetation_are_not_warmer(tmp_path):
    """`brightness` warms dark granite by kelvins, and leaves the shade between crowns as warm as the crowns."""
    classes = np.repeat([[1] * 16 + [2] * 16], 32, axis=0)
    colour = np.full((32, 32, 3), 150)
    colour[:16] = 60
    source = 'source = "balance"\nbrightness = true'
    folder = write_balance(
        tmp_path / "scene", WEATHER, source, height=np.zeros((16, 16)), classes=classes, colour=colour
    )
    path = folder / "scene.toml"
    path.write_text(path.read_text().replace("grass_green", "granite").replace("sand_quartz", "broadleaf"))
    scene = load_scene(folder)
    assert {material.name for material in scene.materials} == {"granite", "broadleaf"}
    (noon,) = heat.solved(scene, [AT])
    kelvin = noon.surfaces[0].temperature
    granite, leaves = ([half[2:14, part].mean() for half in (kelvin[:16], kelvin[16:])]
                       for part in (slice(2, 14), slice(18, 30)))  # fmt: skip
    assert granite[0] > granite[1] + 2.0
    assert leaves[0] == pytest.approx(leaves[1], abs=0.05)


def test_one_texel_stands_for_those_of_its_square_and_material():
    """Odd sides leave squares cut at the edges. Over many squares, all of their places stand equally often."""
    material = np.random.default_rng(3).integers(-1, 3, (11, 14)).astype(np.int16)
    first = heat._alike(material, 2)
    row, column = np.divmod(np.arange(material.size), 14)
    square = 100 * (row // 2) + column // 2
    assert (square[first] == square).all() and (material.ravel()[first] == material.ravel()).all()
    groups = {(one, number) for one, number in zip(square, material.ravel(), strict=True)}
    assert len(np.unique(first)) == len(groups) and (first[first] == first).all()
    place = np.unique(heat._alike(np.zeros((8, 12), np.int16), 2))
    assert np.bincount(2 * (place // 12 % 2) + place % 2).tolist() == [6, 6, 6, 6]


def test_squares_of_texels_have_the_mean_temperatures_of_their_texels(tmp_path):
    """Deviations differ from texel to texel on level ground, and only the differences within squares are lost."""
    scene = scene_of(tmp_path / "scene", height=np.zeros((8, 8)), classes=np.repeat([[1] * 32 + [2] * 32], 64, axis=0))
    random = np.random.default_rng(1)
    shape = scene.surfaces[0].material.shape
    factor = [np.exp(0.03 * random.standard_normal(shape)).astype(np.float32) for _ in range(4)]
    fine, coarse = (
        heat.solved(scene, [AT], deviations=Deviations(*factor), block=side)[0].surfaces[0].temperature
        for side in (1, 2)
    )
    four, one = (each.reshape(shape[0] // 2, 2, shape[1] // 2, 2) for each in (fine, coarse))
    assert np.ptp(one, axis=(1, 3)).max() == 0.0 and np.ptp(four, axis=(1, 3)).mean() > 0.3
    apart = 1e3 * (one - four).mean(axis=(1, 3))
    print(f"mean {apart.mean():.2f} mK, RMS {apart.std():.1f}, within squares {1e3 * np.std(one - four):.0f}")
    assert abs(apart.mean()) < 5.0 and apart.std() < 10.0
