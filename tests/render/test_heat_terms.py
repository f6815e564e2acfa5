"""Terms of the heat balance by texel: their sum, closed forms in the open, mixtures, places, and edits."""

from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import WEATHER, scene_object, write_balance
from thermorender.apps.lands.solids.plants import write_leaf_tables
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix, parts_of
from thermorender.physics import turbulence
from thermorender.physics.balance import TERMS
from thermorender.scene import open_ground

SIGMA = 5.670374419e-8
# Materials of `field` in stripes from west to east; the last one is a mixture of the first two.
SHARES = 0.3, 0.7
STOVE = scene_object("stove", [2, 2, 1], [0, -6, 0.5], temperature=330.0, material="paint_black")
DISC = scene_object("warm", [1.5, 1.5, 1], [0, 6, 1], temperature="balance", shape="disc", inner_heat_w=800.0)


def field(folder):
    """Level ground of grass, sand, asphalt and a mixture of grass and sand, 16 m wide."""
    scene, library = tr.load_scene(write_balance(folder, WEATHER, height=np.zeros((16, 16)))), load_library()
    grass, sand, road = (library[name] for name in ("grass_green", "sand_quartz", "asphalt"))
    number = np.repeat(np.arange(4, dtype=np.uint8)[None], 32, axis=0).repeat(8, axis=1)
    surface = replace(scene.surfaces[0], material=number)
    materials = grass, sand, road, mix(list(zip((grass, sand), SHARES, strict=True)))
    return scene.with_surfaces((surface,), materials).with_temperature("balance")


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return field(tmp_path_factory.mktemp("field") / "scene")


@pytest.fixture(scope="module")
def renderer(scene):
    return tr.Renderer(scene, rays=16, quality="fast", edits=True)


def at(scene, terms, stripe):
    """The terms in the middle of a stripe of `field`."""
    texel = np.ravel_multi_index((16, 8 * stripe + 4), scene.surfaces[0].material.shape)
    return {name: float(values[texel]) for name, values in terms.items()}


def test_terms_add_up_to_nothing(renderer):
    terms = renderer.heat_terms()
    assert tuple(terms) == TERMS and all(values.dtype == np.float32 for values in terms.values())
    # The surface's temperature is known to half an ulp, 1.5e-5 K, and 100 W m⁻² K⁻¹ leave it at most; each term of up
    # to 800 W m⁻² is rounded a few times to 3e-5.
    total = sum(values.astype(float) for values in terms.values())
    assert total.shape == (32 * 32,) and np.abs(total).max() < 100.0 * 1.5e-5 + len(TERMS) * 3 * 3e-5


def test_terms_of_level_ground_are_those_of_the_weather_and_of_its_temperature(scene, renderer):
    """Each term from its own equation, at the end of the last step and at its beginning five minutes before."""
    terms, step = renderer.heat_terms(), np.timedelta64(300, "s")
    before = tr.Renderer(scene.at(scene.time - step), rays=16, quality="fast").scene
    material = scene.materials[2]
    column = open_ground.columns([material], scene.weather, 0.0, open_ground.STATION_ROUGHNESS_M)
    emissivity, found = open_ground.broadband(material), []
    for each in (before, renderer.scene):
        air, kelvin = each.weather.at(each.time), float(each.surfaces[0].temperature[16, 20])
        sine = np.sin(np.radians(each.weather.sun(each.time)[1]))
        exchange, _ = turbulence.convection(
            np, kelvin, air.air_k, air.wind_m_s * column.wind_factor,
            turbulence.air_density(air.pressure_pa, air.air_k),
            column.ground.log_wind, column.ground.log_heat, column.ground.height_m,
        )  # fmt: skip
        found.append({
            "sunlight": material.solar_absorptance * (air.direct_w_m2 * sine + air.diffuse_w_m2),
            "longwave": emissivity * air.longwave_w_m2, "emission": -emissivity * SIGMA * kelvin**4,
            "sensible": -float(exchange[0] * (kelvin - air.air_k)), "latent": 0.0, "rain": 0.0, "melt": 0.0,
        })  # fmt: skip
    road = at(scene, terms, 2)
    for name, values in ((name, [float(each[name]) for each in found]) for name in found[0]):
        # A mean over the step lies between its ends; the air cools by height, a millikelvin.
        assert min(values) - 0.1 < road[name] < max(values) + 0.1, name
    assert found[0]["sunlight"] > 500.0 and abs(found[1]["emission"] - found[0]["emission"]) < 1.0


def test_ground_gains_heat_at_noon_and_gives_it_back_at_night(scene, renderer):
    night = renderer.solved_for(scene.at("2018-07-28T02:00Z"))
    for stripe in range(4):
        noon, dark = at(scene, renderer.heat_terms(), stripe), at(scene, night.heat_terms(), stripe)
        assert noon["conduction"] < -20.0 and dark["conduction"] > 20.0
        assert dark["sunlight"] == 0.0 < noon["sunlight"] and noon["latent"] <= 0.0


def test_a_mixture_has_the_mean_of_its_parts_by_area(scene, renderer):
    terms = renderer.heat_terms()
    grass, sand, mixed = (at(scene, terms, stripe) for stripe in (0, 1, 3))
    for name in TERMS:
        wanted = SHARES[0] * grass[name] + SHARES[1] * sand[name]
        # Level ground beside other ground: columns of parts are those of the materials alone.
        assert mixed[name] == pytest.approx(wanted, abs=5e-3), name
    assert abs(grass["emission"] - sand["emission"]) > 10.0


def test_terms_are_numbered_as_hits_and_texels_and_unknown_where_a_temperature_is_stated(tmp_path):
    scene = tr.load_scene(write_balance(tmp_path / "scene", WEATHER + DISC + STOVE))
    renderer = tr.Renderer(scene, rays=16, quality="fast", edits=True)
    terms, pose = renderer.heat_terms(), scene.pose(0.0, 0.0, 30.0, pitch_deg=-90.0)
    number, terrain = renderer.texels(pose, static=True), renderer.texels(pose)
    truth = renderer.frame(pose).truth
    shown = {name: truth["object"] == index for index, name in enumerate(renderer.frame(pose).objects, start=1)}
    ground = terrain >= 0
    np.testing.assert_array_equal(number[ground], terrain[ground])
    assert ground.any() and shown["warm"].any() and shown["stove"].any() and not ground[shown["warm"]].any()
    emission = terms["emission"][number]
    assert np.isnan(emission[shown["stove"]]).all() and np.isfinite(emission[ground | shown["warm"]]).all()
    kelvin = np.concatenate([surface.temperature.ravel() for surface in renderer.scene.surfaces])
    paint = open_ground.broadband(load_library()["paint_black"])
    warm = number[shown["warm"]]
    # The last step is five minutes long, in which a thin sheet in the sun moves by some tenths of a kelvin.
    np.testing.assert_allclose(terms["emission"][warm], -paint * SIGMA * kelvin[warm] ** 4.0, atol=3.0)
    # The engine's 800 W on 1.77 m² less what the film of 25 W m⁻² K⁻¹ gives to the air behind.
    air = renderer.scene.weather.at(renderer.scene.time).air_k
    wanted = 800.0 / (32.0 * np.sin(2.0 * np.pi / 64.0) * 0.75**2) - 25.0 * (kelvin[warm] - air)
    np.testing.assert_allclose(terms["conduction"][warm], wanted, atol=10.0)
    down = np.tile([0.0, 0.0, -1.0], (2, 1))
    distance, hit = renderer.hits([[0.0, 6.0, 5.0], [0.0, -6.0, 5.0]], down)
    # The disc is 1 m above the ground and 2 cm thick; the stove's middle is half a metre above it.
    assert distance == pytest.approx([3.98, 3.5], abs=1e-4)
    assert hit[0] in warm and np.isnan(terms["rain"][hit[1]])


@pytest.mark.parametrize("mixed", [False, True])
def test_every_texel_emits_by_its_own_temperature(tmp_path, mixed):
    """Leaves in crowns have their quarter's mean, not the sunlit leaf's; mixtures the mean by area."""
    folder = tmp_path / "scene"
    folder.mkdir()
    (folder / "trees.csv").write_text("east_m,north_m,above_ground_m\n-3,2,1\n3,1.5,0.2\n", encoding="utf-8")
    write_leaf_tables(folder)
    trees = scene_object("trees", [4, 4, 4], shape="sphere", instances="trees.csv", leaf_area_1_m=1.2,
                         material="broadleaf", temperature="balance")  # fmt: skip
    scene = tr.load_scene(write_balance(folder, WEATHER + trees))
    if mixed:
        library = load_library()
        leaves = mix([(scene.materials[-1], 0.4), (library["grass_dry"], 0.6)])
        ground = mix([(library["sand_quartz"], 0.5), (library["asphalt"], 0.5)])
        scene = scene.with_material(trees=leaves, sand_quartz=ground)
    renderer = tr.Renderer(scene, rays=16, quality="fast", edits=True)
    terms, solved = renderer.heat_terms(), renderer.scene
    kelvin, kind, scatter = (
        np.concatenate([np.ravel(each) for each in values])
        for values in zip(*((one.temperature, one.material, 0.0 * one.temperature if one.scatter_k is None else
                             one.scatter_k) for one in solved.surfaces), strict=True)
    )  # fmt: skip
    emissivity = np.array([
        sum(share * open_ground.broadband(part) for part, share in parts_of(each)) for each in solved.materials
    ])  # fmt: skip
    off = terms["emission"] + emissivity[kind] * SIGMA * kelvin.astype(float) ** 4
    # A texel without a face has temperature and terms of the nearest one, whatever its material.
    covered = renderer._heat.record.row >= 0
    crown = scatter > 0.0
    # Over the last step of five minutes the middle of the day changes by 0.1 K, but at the borders of shadows; a kelvin
    # is 6 W m⁻².
    assert covered.mean() > 0.85 and np.quantile(np.abs(off[covered]), 0.9) < 1.0 and np.abs(off[crown]).max() < 1.0
    assert crown.sum() > 10 and 6.0 * scatter.max() > 5.0
    assert np.abs(sum(terms.values())).max() < 0.01


def lighter(scene):
    road = replace(scene.materials[2], name="asphalt_2", solar_absorptance=0.5)
    own = [road if each is scene.materials[2] else each for each in scene.materials]
    return scene.with_surfaces(None, own).with_temperature("balance")


def test_previews_have_no_terms_and_solutions_have_their_own(scene, renderer):
    edit = lighter(scene)
    shown = renderer.preview_for(edit)
    assert "preview" in shown.baked.errors_mk and shown.heat_terms() is None
    fresh = tr.Renderer(edit, rays=16, quality="fast", edits=True)
    wanted = fresh.heat_terms()
    assert at(scene, wanted, 2)["sunlight"] < at(scene, renderer.heat_terms(), 2)["sunlight"] - 100.0
    like = tr.Renderer(edit, rays=16, quality="fast", like=shown, edits=True)
    for found in (renderer.solved_for(edit), shown.solved_for(edit), like):
        assert set(found.baked.errors_mk) == set(renderer.baked.errors_mk)
        for name, values in found.heat_terms().items():
            np.testing.assert_array_equal(values, wanted[name])
    # The exact solution keeps what the next preview begins from, and undo has the terms of before.
    assert "preview" in renderer.solved_for(edit).preview_for(scene).baked.errors_mk
    assert renderer.solved_for(renderer.scene).heat_terms() is not None


def test_renderers_without_a_record_and_scenes_without_a_balance_say_what_to_do(scene, renderer):
    with pytest.raises(ThermorenderError, match=r"Renderer\(scene, edits=True\)"):
        tr.Renderer(scene, rays=16, quality="fast").heat_terms()
    with pytest.raises(ThermorenderError, match=r"source = 'balance' in \[temperature\]"):
        tr.Renderer(scene.with_temperature(290.0), rays=16, quality="fast", edits=True).heat_terms()
