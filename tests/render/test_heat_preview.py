"""Temperatures after an edit, to first order: their error is what they state, against the solution of the edit."""

from dataclasses import replace

import numpy as np
import pytest
from support import slow

import thermorender as tr
from scenes import WEATHER, scene_object, write_balance
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix
from thermorender.render.heat import simulation as heat
from thermorender.render.heat.sun_on_columns import Sun
from thermorender.scene.load import load_scene


@pytest.fixture(scope="module")
def yard(tmp_path_factory):
    """Grass, sand, asphalt and a mixture of grass and sand in squares, with a wall 6 m high across all of them."""
    height = np.zeros((32, 32))
    height[14:16] = 6.0
    folder = write_balance(tmp_path_factory.mktemp("yard") / "scene", WEATHER, height=height)
    scene, library = load_scene(folder), load_library()
    grass, sand, road = (library[name] for name in ("grass_green", "sand_quartz", "asphalt"))
    number = np.repeat(np.repeat(np.array([[0, 1], [2, 3]], np.int16), 32, axis=0), 32, axis=1)
    surface = replace(scene.surfaces[0], material=number)
    materials = grass, sand, road, mix([(grass, 0.5), (sand, 0.5)])
    return scene.with_surfaces((surface,), materials).with_temperature("balance")


@pytest.fixture(scope="module")
def renderer(yard):
    made = tr.Renderer(yard, rays=16, quality="fast", edits=True)
    assert len(made._heat.record.light) == len(made._heat.record.steps) > 80
    return made


def kelvin(scene):
    return np.concatenate([surface.temperature.ravel() for surface in scene.surfaces[: scene.solved_count]])


def with_materials(scene, **changed):
    """The scene with other materials in place of some, by their number as a name: _2 is asphalt."""
    own = [changed.get(f"_{number}", material) for number, material in enumerate(scene.materials)]
    return scene.with_surfaces(scene.surfaces, own).with_temperature("balance")


def asphalt(scene, **changed):
    return with_materials(scene, _2=replace(scene.materials[2], name="asphalt_2", **changed))


EDITS = {
    "dark asphalt becomes light": lambda scene: asphalt(scene, solar_absorptance=0.4),
    "asphalt emits half": lambda scene: asphalt(scene, emissivity=0.5 * scene.materials[2].emissivity),
    "asphalt becomes concrete": lambda scene: with_materials(scene, _2=load_library()["concrete"]),
    "a thinner layer": lambda scene: asphalt(scene, thermal=replace(scene.materials[2].thermal, thickness_m=0.02)),
    "a mixture becomes one of its parts": lambda scene: with_materials(scene, _3=scene.materials[1]),
    "wind": lambda scene: scene.with_weather(wind_m_s=6.0),
}


def test_an_edit_that_changes_nothing_moves_no_temperature(renderer):
    found = renderer._heat.preview(asphalt(renderer.scene))
    # Columns before and after are solved side by side, by the same operations.
    np.testing.assert_array_equal(kelvin(found), kelvin(renderer.scene))
    assert found.temperature_state.preview_k == pytest.approx((0.005, 0.015))


@pytest.mark.parametrize("name", [*list(EDITS)[:1], *slow(*list(EDITS)[1:])])
def test_previewed_temperatures_err_less_than_is_stated_and_a_fiftieth_of_the_change(renderer, name):
    scene = EDITS[name](renderer.scene)
    found, (exact,) = renderer._heat.preview(scene), heat.solved(scene, [scene.time])
    error, change = kelvin(found) - kelvin(exact), kelvin(exact) - kelvin(renderer.scene)
    rms = np.sqrt((error**2).mean())
    stated = found.temperature_state.preview_k
    assert rms < stated[0] and np.abs(error).max() < stated[1]
    # Without the change of the light it is a fortieth to a twentieth.
    assert rms < 0.02 * np.sqrt((change**2).mean()) and stated[0] < 0.3


def test_edits_of_many_mixtures_under_air_are_previewed(tmp_path):
    """More than 128 materials, whose numbers twice do not fit into eight bits, and a sun that the air shows."""
    scene, library = load_scene(write_balance(tmp_path / "scene", WEATHER)), load_library()
    grass, sand = library["grass_green"], library["sand_quartz"]
    shares = np.linspace(0.1, 0.9, 200)

    def of(sand):
        return [mix([(grass, share), (sand, 1.0 - share)]) for share in shares]

    surface = scene.surfaces[0]
    number = np.resize(np.arange(len(shares), dtype=np.uint8), surface.material.shape)
    before = scene.with_surfaces((replace(surface, material=number),), of(sand)).with_temperature("balance")
    before = before.with_air("midlatitude-summer")
    made = tr.Renderer(before, rays=4, quality="fast", edits=True)
    light = replace(sand, name="sand_2", solar_absorptance=0.9)
    after = before.with_surfaces(None, of(light)).with_temperature("balance")
    found, (exact,) = made._heat.preview(after), heat.solved(after, [after.time])
    error, change = kelvin(found) - kelvin(exact), kelvin(exact) - kelvin(made.scene)
    rms = np.sqrt((error**2).mean())
    # Few texels of each material are drawn, so that the stated error is large.
    assert rms < 0.02 * np.sqrt((change**2).mean()) and rms < found.temperature_state.preview_k[0]
    # The light is previewed too: its spectral nodes stay.
    shown = made.preview_for(after)
    assert shown.plan.spectrum.label is made.plan.spectrum.label
    pose = before.pose(0.0, 0.0, 40.0, pitch_deg=-90.0)
    off = (shown.radiance(pose) - tr.Renderer(after, rays=4, quality="fast").radiance(pose)) / made.plan.radiance_per_mk
    assert np.sqrt((off**2).mean()) < shown.baked.errors_mk["preview_rms"]


def turned(scene):
    surface = replace(scene.surfaces[0], material=scene.surfaces[0].material[::-1])
    return scene.with_surfaces((surface,), scene.materials).with_temperature("balance")


@pytest.mark.parametrize(
    "change",
    [
        lambda scene: scene.with_weather(cloud=0.9),
        lambda scene: scene.at(scene.time - np.timedelta64(1, "h")),
        lambda scene: scene.with_weather(inside_c=5.0),
        turned,
    ],
)
def test_edits_of_the_sun_the_hour_and_the_places_of_materials_need_a_run(renderer, change):
    assert renderer._heat.preview(change(renderer.scene)) is None


def stove(tmp_path):
    """Sand and grass beside a hot box of stated kelvin, of which nothing is solved."""
    box = scene_object("stove", [6, 6, 4], [0, 0, 2], temperature=450.0, material="paint_black")
    return load_scene(write_balance(tmp_path / "scene", WEATHER + box, height=np.zeros((16, 16))))


def bright(tmp_path):
    """Ground whose reflectance follows the brightness of its texels."""
    source = 'source = "balance"\nbrightness = true'
    return load_scene(write_balance(tmp_path / "scene", WEATHER, source=source, height=np.zeros((16, 16))))


def clouded(scene):
    """The scene without direct sun in the five minutes before its instant, by the minute."""
    weather, minutes = scene.weather, scene.time - np.arange(0, 3600, 60).astype("timedelta64[s]")
    times = np.unique(np.concatenate([weather.time, minutes]))
    fine = replace(weather, time=times, **weather.at(times)._asdict())
    ago = (scene.time - times) / np.timedelta64(1, "s")
    return scene.with_weather(replace(fine, direct_w_m2=np.where((ago >= 0) & (ago < 300), 0.0, fine.direct_w_m2)))


def recoloured(scene):
    surface = scene.surfaces[0]
    return scene.with_surfaces((replace(surface, colour=255 - surface.colour),), scene.materials)


def from_the_day_before(scene):
    """The scene with weather that begins a day earlier."""
    weather = scene.weather
    times = np.concatenate([weather.time[:1] - np.timedelta64(1, "D"), weather.time])
    series = {name: np.concatenate([values[:1], values]) for name, values in weather.at(weather.time)._asdict().items()}
    return scene.with_weather(replace(weather, time=times, **series))


@pytest.mark.parametrize(
    ("made", "change"),
    [
        (stove, lambda scene: scene.with_material(stove="concrete")),
        (stove, lambda scene: scene.with_weather(replace(scene.weather, wind_height_m=2.0))),
        (stove, lambda scene: scene.with_weather(replace(scene.weather, air_height_m=10.0))),
        (stove, clouded),
        (stove, from_the_day_before),
        (bright, lambda scene: scene.with_material(grass_green="asphalt")),
        (bright, recoloured),
    ],
)
def test_edits_of_what_no_record_has_need_a_run(tmp_path, made, change):
    renderer = tr.Renderer(made(tmp_path), rays=4, quality="fast", edits=True)
    assert renderer._heat.preview(change(renderer.scene)) is None


@pytest.mark.parametrize("depth_m", [0.2, 10.0])
def test_a_preview_of_slow_columns_settles_as_a_run_does(tmp_path, depth_m):
    scene = load_scene(write_balance(tmp_path / "scene", WEATHER, height=np.zeros((8, 8))))
    scene = scene.with_material(grass_green="water")
    made = tr.Renderer(scene, rays=4, quality="fast", edits=True)
    water = next(each for each in scene.materials if each.name == "water")
    other = replace(water, name="water_2", thermal=replace(water.thermal, thickness_m=depth_m))
    own = [other if each is water else each for each in scene.materials]
    after = scene.with_surfaces(None, own).with_temperature("balance")
    found, (exact,) = made._heat.preview(after), heat.solved(after, [after.time])
    rms, most = found.temperature_state.preview_k
    error = kelvin(found) - kelvin(exact)
    assert np.sqrt((error**2).mean()) < rms and np.abs(error).max() < most


def test_what_begins_from_the_scene_of_a_preview_states_its_error(yard, renderer):
    shown = renderer.preview_for(EDITS["dark asphalt becomes light"](renderer.scene))
    rms, most = (1e3 * value for value in shown.scene.temperature_state.preview_k)
    for other in (tr.Renderer(shown.scene, rays=16, quality="fast"), renderer.solved_for(shown.scene)):
        assert other.baked.errors_mk["preview_rms"] == rms and other.baked.errors_mk["preview"] == most


def test_a_renderer_for_edits_like_one_without_keeps_a_record(yard, renderer):
    plain = tr.Renderer(yard, rays=16, quality="fast")
    assert tr.Renderer(yard, rays=16, quality="fast", like=plain, edits=True)._heat is not None


EXACT = {
    "absorptance": (EDITS["dark asphalt becomes light"], False),
    "wind": (EDITS["wind"], False),
    "places of materials": (turned, True),
    "the hour": (lambda scene: scene.at(scene.time - np.timedelta64(1, "h")), True),
}


@pytest.mark.parametrize("name", EXACT)
def test_an_exact_edit_tests_for_the_sun_where_its_columns_or_instants_moved_and_equals_a_fresh_run(
    renderer, monkeypatch, name
):
    edit, moves = EXACT[name]
    scene = edit(renderer.scene)
    (fresh,) = heat.solved(scene, [scene.time])
    tested, share = [], Sun.share
    monkeypatch.setattr(Sun, "share", lambda *given: tested.append(1) or share(*given))
    # The light between the faces is that of the record.
    monkeypatch.delattr("thermorender.render.heat.simulation._view_factors")
    exact = tr.Renderer(scene, rays=16, quality="fast", like=renderer, edits=True)
    assert bool(tested) == moves
    np.testing.assert_array_equal(kelvin(exact.scene), kelvin(fresh))
    # What a run did not need is not kept.
    kept = [set(each._heat.record.sun) for each in (renderer, exact)]
    assert moves or kept[0] == kept[1]


@pytest.mark.parametrize("hours", [-2, 1])
def test_an_edit_of_the_hour_of_even_ground_equals_a_fresh_run(tmp_path, hours):
    """The columns are the same at both hours, but are tested at other times: a share of all is none of faces alone."""
    scene = load_scene(write_balance(tmp_path / "even", WEATHER, height=np.zeros((8, 8))))
    made = tr.Renderer(scene, rays=4, quality="fast", edits=True)
    later = scene.at(scene.time + np.timedelta64(hours, "h"))
    (fresh,) = heat.solved(later, [later.time])
    exact = tr.Renderer(later, rays=4, quality="fast", like=made, edits=True)
    for found in (exact, made.preview_for(later)):
        np.testing.assert_array_equal(kelvin(found.scene), kelvin(fresh))


def test_a_frame_of_a_preview_states_an_error_above_its_own_and_a_renderer_without_it_solves(yard, renderer):
    scene = EDITS["dark asphalt becomes light"](renderer.scene)
    made, exact = renderer.preview_for(scene), tr.Renderer(scene, rays=16, quality="fast", like=renderer)
    assert not set(exact.baked.errors_mk) & {"preview", "preview_rms"}
    pose = yard.pose(0.0, 0.0, 40.0, pitch_deg=-90.0)
    frame = made.frame(pose)
    per_mk = made.plan.radiance_per_mk
    error = (frame.radiance - exact.radiance(pose)) / per_mk
    change = (exact.radiance(pose) - renderer.radiance(pose)) / per_mk
    rms = np.sqrt((error**2).mean())
    assert rms < 0.05 * np.sqrt((change**2).mean()) and rms < made.baked.errors_mk["preview_rms"]
    assert made.baked.errors_mk["preview"] > made.baked.errors_mk["preview_rms"] > 0.0
    assert frame.budget_mk["preview"] == made.baked.errors_mk["preview_rms"]
    # The next edit begins from the same run.
    assert "preview" in made.preview_for(EDITS["wind"](renderer.scene)).baked.errors_mk
    windy = EDITS["wind"](renderer.scene)
    np.testing.assert_array_equal(kelvin(exact.preview_for(windy).scene), kelvin(heat.solved(windy, [windy.time])[0]))
