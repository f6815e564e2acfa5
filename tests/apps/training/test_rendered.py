"""A rendered campaign: one small world against fresh renderers, its solved tables, its sky and its second draw."""

import json
from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from heat_support import short_simulations

from thermorender.apps.lands.procedural import deviations as deviations_module
from thermorender.apps.lands.procedural.canvas import Canvas
from thermorender.apps.lands.procedural.procedural_scene import KINDS, make
from thermorender.apps.lands.procedural.truth import drawn
from thermorender.apps.training import rendered
from thermorender.apps.training.dataset import read_dataset
from thermorender.atmosphere.rays import horizon_cos_zenith
from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.output.photograph import sky_colour
from thermorender.physics import srgb
from thermorender.render.heat import conditions as conditions_module
from thermorender.render.heat import simulation as heat
from thermorender.render.renderer import Renderer
from thermorender.sensor.camera import model_path

# A clear morning in August, with land in each view and sky in the last view.
WORLD = rendered.worlds(0, 0, 1, 6, ("heath",))[0]


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """(Dataset of one world of 100 × 100 texels in three views of 160 × 128 pixels, the arguments of each `_pair`)."""
    folder, seen, own = tmp_path_factory.mktemp("campaign"), [], rendered._pair
    text = model_path("boson-640").read_text(encoding="utf-8")
    for before, after in (("width = 640", "width = 160"), ("height = 512", "height = 128"), ("um = 12.0", "um = 48.0")):
        assert text.count(before) == 1
        text = text.replace(before, after)
    # Smooth fields over the image have their own tests, and would hide what is tested here.
    smooth = ("narcissus_mk", "shading_mk", "responsivity_percent")
    lines = [line for line in text.splitlines() if not line.startswith(smooth)]
    (folder / "small.toml").write_text("\n".join(lines), encoding="utf-8")

    def pair(*given):
        seen.append(SimpleNamespace(**dict(zip(NAMED, given, strict=True))))
        return own(*given)

    with pytest.MonkeyPatch.context() as patch, short_simulations():
        patch.setattr(rendered, "SIDE_TEXELS", 100)
        patch.setattr(rendered, "_pair", pair)
        for module in (rendered, conditions_module, deviations_module):
            patch.setattr(module, "load_library", cache(load_library))
        yield rendered.render_campaign(folder / "set", [WORLD], 1, 3, str(folder / "small.toml")), seen


NAMED = ("renderers", "at", "order", "fields", "number", "cloud")


def test_parts_share_no_lands_and_weathers():
    of = rendered.worlds(9, 3, 6, seed=2)
    assert [sum(each.part == part for each in of) for part in ("train", "validation", "test")] == [9, 3, 6]
    seeds = [seed for each in [*of, *rendered.worlds(9, 3, 6, seed=3)] for seed in (each.seed, each.weather_seed)]
    assert len(set(seeds)) == len(seeds) and len({each.name for each in of}) == 18
    for part in ("train", "validation", "test"):
        assert {each.kind for each in of if each.part == part} == set(KINDS)
    # Only test pairs are drawn again, some of each kind; a campaign stopped half-way has pairs of each part.
    again = [each for each in of if each.redrawn]
    assert {each.part for each in again} == {"test"} and {each.kind for each in again} == set(KINDS)
    assert {each.part for each in of[:9]} == {"train", "validation", "test"}


def test_numbers_out_of_range_leave_no_files(tmp_path):
    for arguments, words in (
        ({"kinds": ("moor",)}, "kind='moor' is not a synthetic scene; choose one of"),
        ({"train": 0, "validation": 0, "test": 0}, "0, 0, 0 worlds are not a campaign; give at least one world"),
        ({"train": -1}, "-1, 6, 12 worlds are not a campaign"),
        ({"kinds": ()}, "worlds are not a campaign"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            rendered.worlds(**arguments)
    for hours, views in ((0, 3), (25, 3), (3, 0), (3, 11)):
        with pytest.raises(ThermorenderError, match=f"hours={hours}, views={views} are not allowed; give 1…24 and 1…"):
            rendered.render_campaign(tmp_path / "set", [WORLD], hours, views)
    assert not (tmp_path / "set").exists()


@pytest.mark.slow
def test_the_verb_renders_the_requested_worlds(tmp_path, monkeypatch, call, campaign):
    asked = []
    monkeypatch.setattr(rendered, "render_campaign", lambda *given, **more: asked.append((given, more)) or campaign[0])
    words = ("--train", 2, "--validation", 0, "--test", 1, "--kinds", "heath", "--hours", 1, "--views", 3)
    status, output, errors = call("dataset", "-o", tmp_path / "d", *words, "--turn", "1,2", "--resume")
    assert status == 0 and output.startswith("3 pairs (0 train, 0 validation, 3 test) in"), errors
    ((given, more),) = asked
    assert given == (tmp_path / "d", rendered.worlds(2, 0, 1, 0, ["heath"]), 1, 3)
    assert more["resume"] is True and more["turn"] == (1, 2)
    status, _, errors = call("dataset", "-o", tmp_path / "e", "--turn", "2,2")
    assert status == 2 and "--turn='2,2' is not allowed; give K,N with K from 0 to N − 1" in errors


@pytest.mark.slow
def test_noise_free_radiance_equals_that_of_a_fresh_renderer(campaign):
    dataset, seen = campaign
    for number, name in enumerate(("radiance", "balance", "redrawn")):
        fresh = Renderer(seen[0].renderers[number].scene, tolerance_mk=rendered._TOLERANCE_MK)
        for entry, given in zip(dataset.entries, seen, strict=True):
            kept = dataset.pair(entry).truth[name]
            # Stored with 16 bits of mantissa.
            np.testing.assert_allclose(kept, fresh.radiance(given.at), rtol=2.0**-17)
    truth = dataset.pair(dataset.entries[0]).truth
    assert (truth["redrawn"] != truth["radiance"]).any()


def test_the_balance_is_solved_with_table_values(campaign):
    """The same as for a predictor: the land's files are loaded, its tables are unchanged, nothing is hidden."""
    dataset, seen = campaign
    lands, times = rendered._lands(WORLD, 1)
    scene = rendered._loaded(lands[0], dataset.card["camera"])
    (own,) = heat.solved(scene, times)
    (true, predicted, again) = (each.scene.surfaces[0].temperature for each in seen[0].renderers)
    np.testing.assert_array_equal(predicted, own.surfaces[0].temperature)
    # The hidden, drawn properties change the temperature by a few tenths of a kelvin to a few kelvin.
    for one, other in ((true, predicted), (again, predicted), (again, true)):
        assert 0.2 < np.abs(one - other).mean() < 8.0
    entry = dataset.entries[0]
    assert entry.conditions == conditions_module.conditions(scene.weather, times[0]) and entry.time == f"{times[0]}Z"
    at_camera = seen[0].renderers[0].scene.air.sky_temperature(scene.altitude_m)
    assert entry.sky_temperature == pytest.approx(at_camera, abs=0.006)


def test_counts_equal_the_radiance_except_for_noise_and_blur(campaign):
    """On even land: the median difference is within 50 mK, the spread one to three times the detector's noise.

    The noise is 40 mK per pixel over time; rows, columns and the fixed pattern add to it, and the land's own 30 mK.
    """
    dataset, seen = campaign
    camera = seen[0].renderers[0].scene.camera
    for entry in dataset.entries:
        pair = dataset.pair(entry)
        true = pair.truth["radiance"]
        around = np.stack([np.roll(true, (k, m), (0, 1)) for k in range(-3, 4) for m in range(-3, 4)])
        # A kelvin is about 0.7 W m⁻² sr⁻¹.
        even = np.ptp(around, axis=0) < 0.02
        even[:4] = even[-4:] = even[:, :4] = even[:, -4:] = False
        assert even.sum() > 300
        kelvin = (pair.radiance - true)[even] / 0.7
        assert abs(np.median(kelvin)) < 0.05 and 1.0 < 1000.0 * kelvin.std() / camera.netd_mk < 3.0


def test_pixels_of_sky_are_valid_and_of_its_colour(campaign):
    dataset, seen = campaign
    pair, given = dataset.pair(dataset.entries[2]), seen[2]
    sky = (pair.truth["mask"] & 17) == 0
    assert 0.1 < sky.mean() < 0.9 and pair.valid[sky].all()
    # A pinhole camera by hand, from the pixel pitch; the third row of the pose is up.
    camera = given.renderers[0].scene.camera
    row, column = np.mgrid[: camera.height, : camera.width] + 0.5
    pitch = camera.pixel_pitch_um * 1e-3 / camera.focal_length_mm
    ray = np.stack([(column - camera.width / 2) * pitch, (row - camera.height / 2) * pitch, np.ones(row.shape)], -1)
    sine = ray @ given.at[2, :3] / np.linalg.norm(ray, axis=-1)
    # The horizon of a round Earth, seen from some tens or hundreds of metres.
    scene = given.renderers[0].scene
    assert sine[sky].min() > float(horizon_cos_zenith(scene.altitude_m + given.at[2, 3])) - 1e-6
    expected = srgb.bytes_from_linear(sky_colour(sine, given.cloud))
    np.testing.assert_array_equal(pair.visible[sky], expected[sky])
    # Pixels that are not sky are land or nothing.
    assert not (pair.valid & ~sky & (pair.truth["material"] == 255)).any()


def test_the_days_sky():
    """Blue overhead and pale at the horizon; under clouds grey, and at the horizon a third as bright as overhead."""
    clear, grey = sky_colour(np.linspace(0.0, 1.0, 50)), sky_colour(np.linspace(0.0, 1.0, 50), 1.0)
    assert clear.shape == (50, 3) and clear.dtype == np.float32
    assert (np.diff(clear, axis=0) < 0.0).all()
    assert clear[-1, 2] / clear[-1, 0] > 3.0 and clear[0, 2] / clear[0, 0] < 1.5
    np.testing.assert_allclose(grey[-1] / grey[0], 3.0, rtol=1e-6)
    np.testing.assert_allclose(sky_colour(0.3, 0.25), 0.75 * sky_colour(0.3) + 0.25 * sky_colour(0.3, 1.0), rtol=1e-6)


def test_texels_are_those_under_the_pixels(campaign):
    """Against the positions in the frame's truth: a texel's centre is at most half its side away along either axis."""
    _, seen = campaign
    for given in seen:
        renderer = given.renderers[0]
        frame, texel = renderer.frame(given.at), renderer.texels(given.at)
        position, surface = frame.truth["position"], renderer.scene.surfaces[0]
        assert texel.dtype == np.int64 and ((texel >= 0) == np.isfinite(position[..., 0])).all()
        on = texel >= 0
        row, column = np.divmod(texel[on], surface.material.shape[1])
        half = 50.0 * surface.texel_m
        away = np.abs(np.stack([(column + 0.5) * surface.texel_m - half, half - (row + 0.5) * surface.texel_m], -1)
                      - position[on][:, :2])  # fmt: skip
        assert on.sum() > 1000 and away.max() < 0.5 * surface.texel_m * 1.01 + 0.01


def test_planes_equal_those_of_the_texels(campaign):
    dataset, seen = campaign
    for entry, given in zip(dataset.entries, seen, strict=True):
        pair, texel = dataset.pair(entry), given.renderers[0].texels(given.at)
        assert set(dataset.card["terrain"]) == set(given.fields) <= set(pair.truth)
        for name, values in given.fields.items():
            expected = np.where(texel >= 0, values.ravel()[texel], np.nan)
            np.testing.assert_allclose(pair.truth[name], expected, rtol=2.0**-10, atol=1e-7)
        terrain = given.renderers[0].scene.surfaces[0]
        names = np.array([each.name for each in given.renderers[0].scene.materials])[terrain.material.ravel()]
        listed = np.array([*dataset.card["materials"], *[""] * (256 - len(dataset.card["materials"]))])
        assert (listed[pair.truth["material"][texel >= 0]] == names[texel[texel >= 0]]).all()


def test_a_camera_is_never_under_ground_or_off_the_land(campaign, monkeypatch):
    _, seen = campaign
    scene = seen[0].renderers[0].scene
    names = [name for name, *_ in rendered.VIEWS]
    monkeypatch.setattr(rendered, "SIDE_TEXELS", 100)
    half = 0.5 * 100 * rendered.COARSER * KINDS["heath"].texel_m
    low, high = KINDS["heath"].heights_m
    poses = set()
    for seed in range(40):
        for view in range(rendered.MOST_VIEWS):
            world = SimpleNamespace(kind="heath", seed=seed)
            name, at = rendered._view(world, seed % 3, view, scene)
            assert name == names[view % len(names)]
            above = at[2, 3] - scene.ground(at[0, 3], at[1, 3])
            factor = rendered.AHEAD if name == "forward" else 1.0
            assert factor * low - 1e-6 <= above <= factor * high + 1e-6 and np.abs(at[:2, 3]).max() <= 0.95 * half
            pitch = np.degrees(np.arcsin(at[2, 2]))
            assert rendered.VIEWS[view % 7][1] - 1e-6 <= pitch <= rendered.VIEWS[view % 7][2] + 1e-6
            poses.add(tuple(at.ravel()))
    assert len(poses) == 400


# --- drawn again ------------------------------------------------------------------------------------------------


def test_a_second_draw_keeps_the_photograph(monkeypatch):
    """The photograph, its classes and heights stay bit for bit; the hidden properties differ."""
    monkeypatch.setattr(rendered, "SIDE_TEXELS", 100)
    kind = KINDS["village"]
    sizes = rendered.COARSER * np.array([100 * kind.texel_m, kind.texel_m, kind.post_m])
    first, second, third = (make("village", 5, *sizes, again=again) for again in (0, 1, 2))
    for name in ("orthophoto", "classes", "elevation"):
        assert np.array_equal(getattr(first, name), getattr(second, name)), name
    for name in ("reflectance", "wetness", "exchange", "inertia"):
        draws = [np.log(getattr(each.deviations, name)) for each in (first, second, third)]
        for one, other in ((0, 1), (0, 2), (1, 2)):
            assert np.abs(draws[one] - draws[other]).mean() > 0.05, name


def test_visible_moisture_stays_and_hidden_properties_are_drawn_again(monkeypatch):
    """Moisture, cover and roughness from the logarithms of the fields; the visible part from its effect on the picture.

    Each draw correlates with the visible part by 0.6, and so with the other draw by 0.36; cover and roughness do not
    correlate. Eight lands of (720 / 48)² patches give a correlation a standard deviation of 0.024.
    """

    monkeypatch.setattr(deviations_module, "load_library", cache(load_library))

    def of(seed, again, name):
        canvas = Canvas(seed, 720.0, 4.0)
        canvas.material[:] = canvas.value(name)
        canvas.albedo[:] = 0.5
        found = deviations_module.deviations_of(canvas, again)
        seen = np.log(canvas.albedo[..., 0] / 0.5) / (-0.15 if name == "soil_loam" else -0.10)
        soil = -0.44 / 3.0 if name == "soil_loam" else 0.0
        mixed = np.array([[0.0, 0.20, 0.09], [soil, -0.14, 0.07], [0.18, -0.13, 0.0]])
        logs = np.log(np.stack([found.exchange, found.reflectance, found.inertia]).astype(np.float64)).reshape(3, -1)
        return np.vstack([seen.ravel(), np.linalg.solve(mixed, logs)])

    for name in ("soil_loam", "grass_green"):
        total = []
        for seed in range(8):
            first, second = of(seed, 0, name), of(seed, 1, name)
            np.testing.assert_array_equal(first[0], second[0])
            total.append(np.corrcoef(np.vstack([first, second[1:]])))
            # As strong as before.
            assert second[1].std() == pytest.approx(first[1].std(), rel=0.35)
        seen, moist, cover, rough = np.mean(total, axis=0)[:4]
        assert seen[[1, 4]] == pytest.approx(0.6, abs=0.08) and moist[4] == pytest.approx(0.36, abs=0.08)
        others = [*seen[[2, 3, 5, 6]], *moist[[2, 3, 5, 6]], *cover[[4, 5, 6]], *rough[[4, 5, 6]]]
        np.testing.assert_allclose(others, 0.0, atol=0.08)


def test_materials_are_drawn_again(campaign):
    _, seen = campaign
    scene = seen[0].renderers[0].scene

    def numbers(again):
        made, exchange = drawn(scene, "heath", 3, again)
        rows = [(each.solar_absorptance, each.thermal.conductivity_w_m_k) for each in made.materials]
        return np.array([*np.ravel(rows), exchange, made.spec.weather.inside_c])

    first, same, second = numbers(0), numbers(0), numbers(1)
    assert (first == same).all() and (first != second).mean() > 0.9
    assert np.abs(np.log(second[-2])) < 5 * 0.2 and ((second[:-2:2] >= 0.02) & (second[:-2:2] <= 0.98)).all()


# --- continued --------------------------------------------------------------------------------------------------


def test_complete_worlds_are_not_rendered_again(campaign, monkeypatch):
    dataset, _ = campaign
    before = {path: path.read_bytes() for path in dataset.folder.rglob("*") if path.is_file()}
    monkeypatch.setattr(rendered, "make", lambda *_, **more: pytest.fail("a land was made again"))
    again = rendered.render_campaign(dataset.folder, [WORLD], 1, 3, dataset.card["camera"], resume=True)
    assert again.entries == dataset.entries
    assert {path: path.read_bytes() for path in dataset.folder.rglob("*") if path.is_file()} == before
    with pytest.raises(ThermorenderError, match=r"has views=3, now 2; continue with the same settings"):
        rendered.render_campaign(dataset.folder, [WORLD], 1, 2, dataset.card["camera"], resume=True)


def test_turns_and_an_interruption_skip_no_world(tmp_path, monkeypatch, campaign):
    """With stand-in pairs: each of several processes renders its own worlds; a stopped one continues later."""
    dataset, _ = campaign
    entry, done = dataset.entries[0], []
    pair = {"visible.png": b"v", "thermal.png": b"t"}

    def stand_in(world, *_):
        done.append(world.name)
        yield type(entry)(f"{world.name}-0-0", world.part, "", world.name, 0, (3, 4)), pair
        if len(done) == 3 and fails:
            raise KeyboardInterrupt

    monkeypatch.setattr(rendered, "_pairs", stand_in)
    of, fails = rendered.worlds(4, 1, 2), True
    with pytest.raises(KeyboardInterrupt):
        rendered.render_campaign(tmp_path / "set", of)
    assert len(read_dataset(tmp_path / "set")) == 2
    assert [path.name for path in (tmp_path / "set/shards").iterdir() if path.name.startswith(".")] == []
    fails = False
    for turn in ((1, 2), (0, 2)):
        rendered.render_campaign(tmp_path / "set", of, resume=True, turn=turn)
    assert sorted(done) == sorted([each.name for each in of] + [of[2].name])
    assert len(read_dataset(tmp_path / "set")) == 7
    card = json.loads((tmp_path / "set/card.json").read_text())
    assert card["worlds"] == [vars(each) for each in of] and card["materials"] == sorted(load_library())
