"""Materials from RGB: features, the network's arithmetic, tiles, unknown texels, palettes, training, scenes, files."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import rasterio
import trimesh
from support import slow

import thermorender as tr
from scenes import write_mesh, write_raster, write_terrain
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.training import emissivity_adaptation as adaptation
from thermorender.apps.training.emissivity_adaptation import adapted
from thermorender.apps.training.emissivity_training import Labelled, fitted_spread, train
from thermorender.apps.training.material_training import band_emissivity_of, labelled_scene, train_on
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity import mapping as learned
from thermorender.learned.emissivity.features import NAMES, NEAR, features
from thermorender.learned.emissivity.land_cover import GROUPS, group_of, levelling, shares_of
from thermorender.learned.emissivity.mapping import EmissivityMap, load_map, map_materials, save_map, to_grid
from thermorender.learned.pixel_features import lab
from thermorender.materials.library import load_library
from thermorender.materials.material import grey
from thermorender.materials.mixture import Mixture, largest_part, mix, palette, parts_of, uncertainties
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.render.pixels.budget import emissivity_mk
from thermorender.scene.material_map import UNKNOWN_CLASS, Picture, learned_materials, write_map
from thermorender.scene.spec import EmissivitySpec
from thermorender.scene.surface import FILLED, UNKNOWN
from validation.emissivity import study as validation

# Three materials in stripes: mean colour and noise of each.
STRIPES = {
    "grass_green": ((70, 110, 50), 14.0),
    "asphalt": ((105, 104, 102), 3.0),
    "sand_quartz": ((200, 180, 140), 6.0),
}
# Their colours are so far apart that a texel may be wrong only beside the two borders, where windows see both: one
# texel on either side, in 144 columns.
RIGHT = 1.0 - 4.0 / 144.0
EMISSIVITY = band_emissivity_of()
PATCH = (slice(50, 78), slice(150, 178))  # in the scene's middle stripe
SMALL = {"village": (110.0, 0.25, 0.5)}


def striped(seed, rows=96, columns=144):
    """(rgb, number 1…3) of a picture with a stripe of each material."""
    generator = np.random.default_rng(seed)
    number = np.repeat(np.arange(1, 4, dtype=np.uint8), columns // 3)[None].repeat(rows, axis=0)
    rgb = np.empty((rows, columns, 3))
    for value, (colour, noise) in enumerate(STRIPES.values(), 1):
        here = number == value
        rgb[here] = np.array(colour) + noise * generator.standard_normal((here.sum(), 1))
    return np.clip(rgb, 0, 255).astype(np.uint8), number


@pytest.fixture(scope="module")
def model():
    names = dict(enumerate(STRIPES, 1))
    pictures = [Labelled(*striped(seed), names, 0.5, f"stripes {seed}") for seed in (1, 2)]
    return train(pictures, 0.5, "stripes", EMISSIVITY, seed=3)[0]


@pytest.fixture
def scene(tmp_path, model):
    """Folder of a striped scene with a magenta patch and learned materials."""
    rgb, number = striped(7, 128, 288)
    rgb[PATCH] = (255, 0, 255)
    folder = write_terrain(tmp_path / "stripes", np.zeros((64, 144)), classes=number, colour=rgb)
    save_map(model, folder / "own.npz")
    learned_source(folder)
    return folder


def learned_source(folder, text='model = "own.npz"\nfallback = "granite"\n'):
    whole = (folder / "scene.toml").read_text(encoding="utf-8")
    start, end = whole.index("[emissivity]"), whole.index("[sky]")
    (folder / "scene.toml").write_text(f'{whole[:start]}[emissivity]\nsource = "learned"\n{text}{whole[end:]}', "utf-8")


def test_lab_matches_published_values():
    # Lindbloom's calculator, sRGB with its own D65 white: red, green, blue, white, black.
    bytes_ = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 255], [0, 0, 0]], np.uint8)
    published = [[53.24, 80.09, 67.20], [87.73, -86.18, 83.18], [32.30, 79.19, -107.86], [100, 0, 0], [0, 0, 0]]
    # The calculator's white is (0.9505, 1, 1.0888); the one here has more digits.
    assert lab(bytes_) == pytest.approx(np.array(published), abs=0.06)


def test_features_respond_to_texture_and_direction():
    generator = np.random.default_rng(0)
    flat = np.full((96, 96, 3), 120, np.uint8)
    rough = np.clip(120 + 20 * generator.standard_normal((96, 96, 1)), 0, 255).astype(np.uint8).repeat(3, axis=2)
    furrows = (120 + 30 * np.sin(np.arange(96) * 1.2)).astype(np.uint8)[None, :, None].repeat(96, 0).repeat(3, 2)
    of = {name: {key: features(image)[48, 48, NAMES.index(key)] for key in ("L spread 4", "gradient", "coherence")}
          for name, image in (("flat", flat), ("rough", rough), ("furrows", furrows))}  # fmt: skip
    assert of["flat"]["L spread 4"] == pytest.approx(0.0, abs=1e-2) and of["flat"]["gradient"] < 1e-3
    # 20 bytes of noise are 8 of lightness at this grey: d L*/d byte = 0.40. The Gaussian window of 4 texels holds 4π 4²
    # = 201 of them, which give a spread to 1/√402: three times 5 %.
    assert np.expm1(of["rough"]["L spread 4"]) == pytest.approx(8.0, rel=0.15)
    assert of["furrows"]["coherence"] > 0.9 > 0.4 > of["rough"]["coherence"]


def test_probabilities_match_scikit_learn():
    from sklearn.neural_network import MLPClassifier

    generator = np.random.default_rng(1)
    x = generator.normal(size=(400, len(NAMES)))
    y = (x[:, 0] + x[:, 1] ** 2 > 1).astype(int) + (x[:, 2] > 0.5)
    mean, scale = np.float32(x.mean(axis=0)), np.float32(x.std(axis=0))
    network = MLPClassifier((7, 5), max_iter=60, tol=1.0, n_iter_no_change=60, random_state=0)
    with pytest.warns(match="Maximum iterations"):
        network.fit((x - mean) / scale, y)
    layers = tuple(map(tuple, zip(network.coefs_, network.intercepts_, strict=True)))
    # A second network that knows one material halves the probabilities of the others.
    sure = ((np.zeros((len(NAMES), 3), np.float32), np.array([-60.0, 0.0, -60.0], np.float32)),)
    centres = generator.normal(size=(9, len(NEAR)))
    own = EmissivityMap("own", ("a", "b", "c"), 0.5, mean, scale, (layers, sure), centres, 2.0, {})
    found, novelty = own.probabilities(x)
    expected = 0.5 * (network.predict_proba((x - mean) / scale) + np.array([0.0, 1.0, 0.0]))
    assert found == pytest.approx(expected, abs=1e-6)
    away = np.linalg.norm(((x - mean) / scale)[:, None, NEAR] - centres, axis=-1).min(axis=1)
    assert novelty == pytest.approx(away / 2.0, rel=1e-4)


@pytest.mark.slow
def test_training_with_two_materials():
    rgb, number = striped(1)
    number[number == 3] = 0
    two, confusion = train([Labelled(rgb, number, {1: "grass_green", 2: "asphalt"}, 0.5, "x")], 0.5, "two", EMISSIVITY)
    assert two.networks[0][-1][1].shape == (2,)
    assert np.trace(confusion) / confusion.sum() > 0.98
    mapped = map_materials(two, rgb, 0.5)
    assert (mapped.index[:, :40, 0] == two.materials.index("grass_green")).mean() > 0.97
    assert mapped.share[..., 2].max() == 0.0


@pytest.mark.slow
def test_untested_materials_are_reported(tmp_path, capsys, monkeypatch):
    """A single small patch of asphalt is in a training block, so the accuracy is that of grass alone."""
    rgb, number = striped(1)
    labels = np.where(number == 1, 1, 0).astype(np.uint8)
    labels[50:60, 60:70] = 2
    names = {1: "grass_green", 2: "asphalt"}
    # With this seed, the patch's only block is not held out.
    few = Labelled(rgb, labels, names, 0.5, "few labels")
    partly, confusion = train([few], 0.5, "partly", EMISSIVITY, seed=0)
    assert confusion[0].sum() > 0 and confusion[1].sum() == 0, confusion
    untested = partly.about["not_tested"]
    assert untested.startswith("asphalt, of which no texel was held out; ")
    assert f"{np.mean(labels == 0):.0%} of the ground, which has no label" in untested
    only = np.where((number == 1) & (np.indices(number.shape).max(axis=0) < 24), 1, labels // 2 * 2).astype(np.uint8)
    nothing, confusion = train([replace(few, material=only)], 0.5, "nothing", EMISSIVITY, seed=0)
    assert confusion.sum() == 0 and nothing.about["held_out_accuracy"] is None
    assert nothing.about["not_tested"].startswith("grass_green, asphalt, of which no texel")
    whole, _ = train(
        [Labelled(rgb, number, dict(enumerate(STRIPES, 1)), 0.5, "all labelled")], 0.5, "whole", EMISSIVITY
    )
    assert "not_tested" not in whole.about
    save_map(partly, tmp_path / "partly.npz")
    assert load_map(tmp_path / "partly.npz").about["not_tested"] == untested

    from thermorender.apps.training import material_training
    from thermorender.apps.training import verbs as cli

    for model, warned in ((partly, True), (whole, False)):
        size = len(model.materials)
        monkeypatch.setattr(material_training, "train_on", lambda *a, m=model, n=size, **_: (m, np.eye(n, dtype=int)))
        cli.train("emissivity", output=tmp_path / "m.npz")
        printed = capsys.readouterr()
        assert ("warning: not tested: asphalt, of which no texel" in printed.err) == warned, printed.err


def test_unseen_picture_is_mapped_correctly(model):
    rgb, number = striped(11)
    mapped = map_materials(model, rgb, 0.5)
    named = np.array(model.materials)[mapped.index[..., 0]]
    assert (named == np.array(["", *STRIPES])[number]).mean() > RIGHT
    assert mapped.share.sum(axis=-1) == pytest.approx(np.ones(rgb.shape[:2]), abs=1e-5)
    assert (np.diff(mapped.share, axis=-1) <= 0.0).all()
    assert model.about["held_out_accuracy"] > 0.95 and model.about["trained_on"] == "stripes 1; stripes 2"


@pytest.mark.slow
def test_same_seed_gives_the_same_map():
    names = dict(enumerate(STRIPES, 1))
    picture = Labelled(*striped(1, 48, 72), names, 0.5, "stripes")
    one, two, other = (train([picture], 0.5, "m", EMISSIVITY, augmentations=1, seed=seed)[0] for seed in (0, 0, 1))
    assert all((a == b).all() for a, b in zip(one.networks[0][0], two.networks[0][0], strict=True))
    assert (one.networks[0][0][0] != other.networks[0][0][0]).any()


@pytest.mark.parametrize("axes", [(0, 1, 2), (1, 0, 2)])
def test_tiles_leave_no_seams(model, monkeypatch, axes):
    # A trained map is sure of these stripes whatever the wide windows show; a random one depends on every feature.
    generator = np.random.default_rng(0)
    heedful = replace(
        model, networks=(((np.float32(generator.normal(0.0, 0.3, (len(NAMES), 3))), np.zeros(3, np.float32)),),)
    )
    # Stripes meet 12 texels before one tile ends, and 24 before the end of the next.
    rgb = striped(5, 40, 732)[0].transpose(axes)
    monkeypatch.setattr(learned, "_TILE_TEXELS", 256)
    found = np.empty((3, *rgb.shape[:2]))

    def keep(rows, columns, probabilities):
        found[:, rows, columns] = probabilities

    mapped = map_materials(heedful, rgb, 0.5, keep=keep)
    whole, novelty = heedful.probabilities(features(rgb).reshape(-1, len(NAMES)))
    assert found.reshape(3, -1).transpose() == pytest.approx(whole, abs=2e-4)
    best = np.where(novelty <= 1.0, whole.max(axis=-1), 0.0).reshape(rgb.shape[:2])
    # A texel at the threshold may be on either side of it.
    assert (np.abs(mapped.confidence - best) > 2e-3).mean() < 1e-4


@pytest.mark.parametrize("factor", [2, 5])
def test_finer_orthophoto_is_resampled_to_the_maps_own_grid(model, factor):
    rgb, _ = striped(11)
    fine = rgb.repeat(factor, axis=0).repeat(factor, axis=1)
    coarse = map_materials(model, rgb, 0.5)
    mapped = map_materials(model, fine, 0.5 / factor)
    assert mapped.confidence.shape == fine.shape[:2]
    middle = slice(factor // 2, None, factor)
    same = mapped.index[middle, middle, 0] == coarse.index[..., 0]
    assert same.mean() > 0.97
    if factor % 2:  # nothing is interpolated at the centre of a texel
        assert mapped.confidence[middle, middle] == pytest.approx(coarse.confidence, abs=2e-2)


def test_too_coarse_orthophoto_is_refused(model):
    with pytest.raises(ThermorenderError, match=r"texels of 6 m, but emissivity map 'stripes' was trained at 0.5 m"):
        map_materials(model, np.zeros((8, 8, 3), np.uint8), 6.0)


def test_coarsest_nominal_texels_are_taken(model):
    """Texels of 1.25 m are 1.2505 m on the ground at the middle of a UTM zone."""
    assert to_grid(np.zeros((4, 4, 3), np.uint8), 1.2505, model).shape == (10, 10, 3)


def test_materials_without_data_in_the_band_are_named_at_once():
    library = load_library()
    picture = Picture(np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), bool), 0.5)
    source = EmissivitySpec("learned", model="procedural", fallback="soil_loam")
    with pytest.raises(
        ThermorenderError, match=r"of the 26 materials .* do not cover .* 8–14 µm; leave them"
    ) as caught:
        learned_materials(source, library, [picture], (8.0, 14.0), "scene.toml")
    found = json.loads(re.search(r"emissivity.without = (\[.*?\])", str(caught.value)).group(1))
    fewer = replace(source, without=tuple(found))
    assert learned_materials(fewer, library, [picture], (8.0, 14.0), "scene.toml")[3]["share_unknown"] <= 1.0
    with pytest.raises(
        ThermorenderError, match=r"2–5 µm; give the scene tables that cover it, or another emissivity.s"
    ):
        learned_materials(source, library, [picture], (2.0, 5.0), "scene.toml")


def test_scene_of_the_fallback_alone_states_no_deviation():
    picture = Picture(np.zeros((2, 2, 3), np.uint8), np.ones((2, 2), bool), 0.5)
    source = EmissivitySpec("learned", model="procedural", fallback="soil_loam", confidence=1.0)
    report = learned_materials(source, load_library(), [picture], (7.5, 13.5), "scene.toml")[3]
    assert report["share_unknown"] == 1.0 and "mean_std" not in report


def test_unseen_colours_are_unknown(model):
    rgb, _ = striped(11)
    rgb[30:60, 60:90] = (255, 0, 255)
    confidence = map_materials(model, rgb, 0.5).confidence
    assert (confidence[34:56, 64:86] == 0.0).all()
    assert (confidence[:, :30] > 0.35).mean() > 0.97


def test_excluded_materials_get_no_probability(model):
    rgb, _ = striped(11)
    described = features(rgb).reshape(-1, len(NAMES))
    fewer = model.without(["asphalt"])
    kept = [k for k, name in enumerate(model.materials) if name != "asphalt"]
    whole, part = model.probabilities(described)[0].astype(float), fewer.probabilities(described)[0]
    sure = whole[:, kept].sum(axis=-1) > 1e-3
    assert part[sure] == pytest.approx((whole[:, kept] / whole[:, kept].sum(axis=-1, keepdims=True))[sure], abs=1e-3)
    with pytest.raises(ThermorenderError, match="does not have the material 'snow' to leave out; it has"):
        model.without(["snow"])
    with pytest.raises(ThermorenderError, match="has 1 materials left without asphalt, sand_quartz; keep two"):
        model.without(["asphalt", "sand_quartz"])


def test_map_is_read_as_it_was_written(model, tmp_path):
    save_map(model, tmp_path / "m.npz")
    again = load_map(tmp_path / "m.npz")
    rgb, _ = striped(4)
    assert (map_materials(again, rgb, 0.5).share == map_materials(model, rgb, 0.5).share).all()
    assert (again.materials, again.about, again.texel_m) == (model.materials, model.about, model.texel_m)
    assert "RGB → 3 materials at 0.5 m" in str(again)


def test_more_materials_than_a_class_raster_can_hold_are_refused(model, tmp_path):
    """255 means unknown and 0 no label, so a map may distinguish 254 materials."""
    for count in (254, 255):
        first = model.networks[0][:-1]
        last = (np.zeros((len(model.networks[0][-1][0]), count), np.float32), np.zeros(count, np.float32))
        names = tuple(f"m{number}" for number in range(count))
        many = replace(model, materials=names, networks=((*first, last),), groups=(), share=(), own=(), outputs=())
        save_map(many, tmp_path / f"{count}.npz")
    assert len(load_map(tmp_path / "254.npz").materials) == 254
    with pytest.raises(ThermorenderError, match=r"255.npz is not .*has 255 materials, not 2…254"):
        load_map(tmp_path / "255.npz")
    rgb, number = np.zeros((16, 32, 3), np.uint8), 1 + np.arange(512).reshape(16, 32) % 200
    pictures = [
        Labelled(rgb, number.astype(np.uint8), {k: f"{which}{k}" for k in range(1, 201)}, 0.5, which) for which in "ab"
    ]
    with pytest.raises(ThermorenderError, match="a, b name 400 materials, but an emissivity map has 2…254"):
        train(pictures, 0.5, "many", lambda name: 0.9)


@pytest.mark.parametrize(
    "damage", ["cut", "pickle", "text", "shape", "nan", "twice", "no centres", "outputs", "spread"]
)
def test_file_that_is_not_a_map_is_refused(model, tmp_path, damage):
    path = tmp_path / "m.npz"
    save_map(model, path)
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-400])
    elif damage == "pickle":
        np.savez(path, head=np.array({"format": 1}, dtype=object))
    elif damage == "text":
        path.write_text("hello")
    elif damage == "twice":
        save_map(replace(model, materials=("grass_green",) * 3), path)
    elif damage == "no centres":
        save_map(replace(model, centres=model.centres[:0]), path)
    elif damage == "outputs":
        save_map(replace(model, outputs=(0, 0, 0)), path)
    elif damage == "spread":
        save_map(replace(model, spread=(1.0, 1e30)), path)
    elif damage == "shape":
        save_map(replace(model, materials=("grass_green",)), path)
    else:
        save_map(replace(model, mean=model.mean * np.float32(np.nan)), path)
    with pytest.raises(ThermorenderError, match=r"m\.npz is not an emissivity map \(.+\); make one with"):
        load_map(path)


def test_missing_map_error_names_the_shipped_one():
    with pytest.raises(ThermorenderError, match=r"map 'nowhere.npz' does not exist; give a file .* procedural"):
        load_map("nowhere.npz")


def test_mixture_emissivity_is_the_mean_of_its_parts():
    library = load_library()
    parts = [(library["sand_quartz"], 0.25), (library["snow"], 0.75)]
    mixed = mix(parts)
    wavelength = np.linspace(7.5, 13.5, 777)
    wanted = 0.25 * parts[0][0].emissivity_at(wavelength) + 0.75 * parts[1][0].emissivity_at(wavelength)
    # Linear between the rows of both tables.
    assert mixed.emissivity_at(wavelength) == pytest.approx(wanted, abs=1e-12)
    assert mixed.name == "0.25 sand_quartz + 0.75 snow" and mix([(library["snow"], 1.0)]) is library["snow"]
    with pytest.raises(ThermorenderError, match="was measured over"):
        mixed.emissivity_at(200.0)


def test_palette_preserves_the_emissivity_of_every_mix():
    library = load_library()
    own = [library[name] for name in ("sand_quartz", "snow", "paint_metallic", "grass_green")]
    generator = np.random.default_rng(2)
    share = np.sort(generator.dirichlet((0.6, 0.6, 0.6), (60, 80)), axis=-1)[..., ::-1]
    index = np.argsort(generator.random((60, 80, 4)), axis=-1)[..., :3].astype(np.uint8)
    index[0, 0], share[0, 0] = (3, 0, 1), (1.0, 0.0, 0.0)

    def probability(index, share):
        every = np.zeros((*index.shape[:2], 4))
        np.put_along_axis(every, index.astype(np.int64), share, axis=-1)
        return np.rint(255.0 * every).astype(np.uint8)

    for most in (200, 30):
        number, made, error = palette(index, share, probability(index, share), own, (7.5, 13.5), most)
        assert len(made) <= most and number.max() < len(made)
        spectrum = np.linspace(7.5, 13.5, 48)
        mean = np.array([material.emissivity_at(spectrum).mean() for material in own])
        got = np.array([material.emissivity_at(spectrum).mean() for material in made])[number]
        change = np.abs(got - (share * mean[index]).sum(axis=-1))
        # Probabilities are rounded to 1/255.
        assert error["largest"] == pytest.approx(change.max(), abs=0.004)
        assert error["mean"] == pytest.approx(change.mean(), abs=0.002)
        if most == 200:
            assert parts_of(made[number[0, 0]]) == ((own[3], 1.0),)
            # Half an eighth for each of two shares, between materials no further apart than these.
            assert error["largest"] < 0.125 * np.ptp(mean) and error["mean"] < 0.02
    one_way, other_way = np.zeros((1, 1, 3), np.uint8), np.zeros((1, 1, 3), np.uint8)
    one_way[..., :2], other_way[..., :2] = (0, 1), (1, 0)
    half = np.array([[[0.5, 0.5, 0.0]]])
    twice, half = np.hstack([one_way, other_way]), half.repeat(2, axis=1)
    both = palette(twice, half, probability(one_way, half[:, :1]).repeat(2, axis=1), own, (7.5, 13.5), 200)
    assert len(both[1]) == 1


def test_mixture_of_possible_materials_has_their_mean_and_spread():
    library = load_library()
    pairs = [(library["sand_quartz"], 0.2), (library["snow"], 0.5), (library["paint_metallic"], 0.3)]
    mixed = mix([(library["snow"], 1.0)], pairs)
    wavelength = np.linspace(7.5, 13.5, 50)
    spectra = np.array([material.emissivity_at(wavelength) for material, _ in pairs])
    mean = np.array([0.2, 0.5, 0.3]) @ spectra
    assert mixed.emissivity_at(wavelength) == pytest.approx(mean, abs=1e-6)
    between = np.sqrt(np.array([0.2, 0.5, 0.3]) @ (spectra.mean(axis=1) - mean.mean()) ** 2)
    # Their own spread is below 0.02; Planck's weights differ little from equal ones.
    assert between - 0.001 <= mixed.band_emissivity_std(7.5, 13.5, 300.0) < between + 0.02
    assert mixed.parts == ((library["snow"], 1.0),)


def test_spectra_that_cross_do_not_make_the_band_emissivity_uncertain():
    """Two materials of about the same band emissivity: the deviation is that of the band's mean."""
    edges = np.array([7.0, 10.4999, 10.5001, 14.0])
    base = load_library()["snow"]
    one, other = (
        replace(base, name=name, wavelength_um=edges, emissivity=np.array(values), emissivity_std=np.full(4, 0.003))
        for name, values in (("falls", [0.98, 0.98, 0.78, 0.78]), ("rises", [0.78, 0.78, 0.98, 0.98]))
    )
    pairs = [(one, 0.5), (other, 0.5)]
    mixed = mix(pairs[:1], pairs)
    values = [float(each.band_emissivity(7.5, 13.5, 300.0)) for each, _ in pairs]
    expected = np.hypot(0.5 * (values[0] - values[1]), 0.003)
    assert mixed.band_emissivity_std(7.5, 13.5, 300.0) == pytest.approx(expected, abs=1e-5)
    assert expected < 0.01


def test_a_map_averages_the_uncertainties_that_its_mixtures_state(model):
    """`EmissivityMap.moments` and `Mixture` compute the same deviations in two ways."""
    library = load_library()
    names = ("granite", "soil_loam", "roof_slate", "roof_tile_clay", "water")
    own = replace(
        model, materials=names, groups=tuple(map(group_of, names)), share=shares_of(names), own=(0.2,) * 5,
        networks=(((np.zeros((len(NAMES), 5), np.float32), np.zeros(5, np.float32)),),), spread=(0.8, 1.3), outputs=(),
    )  # fmt: skip
    probability = np.array([0.1, 0.3, 0.2, 0.3, 0.1])
    mixed = mix(
        [(library["granite"], 1.0)], [(library[n], p) for n, p in zip(names, probability, strict=True)],
        own.doubt(names),
    )  # fmt: skip
    band = (7.5, 13.5, 300.0)
    value = np.array([float(library[name].band_emissivity(*band)) for name in names])
    mean, mean_std, std = (float(each) for each in own.moments(probability, value))
    assert mean == pytest.approx(float(mixed.band_emissivity(*band)), abs=1e-6)
    assert mixed.band_emissivity_mean_std(*band) == pytest.approx(mean_std, rel=1e-5)
    # By hand: bare land, roofs and water, whose means are uncertain by 0.010, 0.010 and 0.002.
    weight = np.array([0.4, 0.5, 0.1])
    group = np.array([probability[k] @ value[k] / w for k, w in zip(([0, 1], [2, 3], [4]), weight, strict=True)])
    unsure = weight @ [0.010, 0.010, 0.002]
    assert mean_std == pytest.approx(np.hypot(0.8 * np.sqrt(weight @ (group - mean) ** 2), unsure), rel=1e-4)
    # Samples of a material differ too, which the map does not know.
    samples = [np.nan_to_num(library[name].band_emissivity_std(*band)) for name in names]
    spread = 1.3 * np.sqrt(probability @ ((value - mean) ** 2 + np.square(samples)))
    whole = np.hypot(spread, unsure)
    assert mixed.band_emissivity_std(*band) == pytest.approx(whole, rel=1e-4) and std < whole


def test_a_texel_is_at_least_as_uncertain_as_the_mean_and_certain_ground_differs_between_places(model):
    library = load_library()
    names = ("granite", "soil_loam", "roof_slate")
    own = replace(
        model, materials=names, groups=tuple(map(group_of, names)), share=shares_of(names), own=(0.2,) * 3, outputs=(),
        networks=(((np.zeros((len(NAMES), 3), np.float32), np.zeros(3, np.float32)),),), spread=(3.0, 0.2),
    )  # fmt: skip
    probability, band = np.array([0.1, 0.5, 0.4]), (7.5, 13.5, 300.0)
    mixed = mix(
        [(library["granite"], 1.0)], [(library[n], p) for n, p in zip(names, probability, strict=True)],
        own.doubt(names),
    )  # fmt: skip
    texel, mean = uncertainties(mixed, *band)
    assert texel == mean > 0.03
    value = np.array([float(library[name].band_emissivity(*band)) for name in names])
    assert own.moments(probability, value)[1:] == pytest.approx((mean, mean), rel=1e-4)
    # One sample, and several.
    assert uncertainties(library["gold_polished"], *band) == (0.010, 0.010)
    assert uncertainties(library["broadleaf"], *band) == (library["broadleaf"].band_emissivity_std(*band), 0.010)


def test_unknown_ground_has_both_uncertainties_in_the_budget(scene):
    learned_source(scene, 'model = "own.npz"\nfallback = "granite"\nconfidence = 0.999\n')
    frame = tr.Renderer(tr.load_scene(scene), rays=4, samples=4).frame(straight_down(60.0))
    ground = np.isfinite(frame.truth["kinetic_temperature"])
    for name in ("emissivity_std", "emissivity_mean_std"):
        assert (frame.truth[name][ground] > 0.0).all(), name
    assert frame.budget_mk["emissivity"] >= frame.budget_mk["emissivity_mean"] > 0.0


def test_spread_is_fitted_to_maps_that_are_too_sure(model):
    """Labels follow other probabilities than those stated: the factor makes 68 % of the errors lie within it."""
    generator = np.random.default_rng(4)
    names = tuple(f"m{number}" for number in range(60))
    own = replace(
        model, materials=names, groups=(), share=(), own=(), outputs=(), spread=(1.0, 1.0),
        networks=(((np.zeros((len(NAMES), 60), np.float32), np.zeros(60, np.float32)),),),
    )  # fmt: skip
    emissivity = np.linspace(0.7, 0.999, 60)
    centre = generator.uniform(0.8, 0.9, (20_000, 1))
    near = np.exp(-0.5 * ((emissivity - centre) / 0.02) ** 2)
    stated = near / near.sum(axis=1, keepdims=True)
    truth = np.abs(emissivity - centre - 0.04 * generator.standard_normal(centre.shape)).argmin(axis=1)
    factors = fitted_spread(own, [(stated, truth)], emissivity)
    assert factors[0] == pytest.approx(2.0, rel=0.03)
    # Samples of a material differ by 0.01.
    assert factors[1] == pytest.approx(2.0 * 0.02 / np.hypot(0.02, 0.01), rel=0.03)


def test_land_cover_replaces_shares_within_groups_only():
    names = ("granite", "soil_loam", "roof_slate", "gold")
    matrix = levelling(tuple(map(group_of, names)), shares_of(names), (0.25, 0.25, 1.0, 0.0))
    probability = np.array([0.5, 0.1, 0.3, 0.1])
    found = probability @ matrix
    rock = GROUPS["bare land"].shares["granite"] / sum(GROUPS["bare land"].shares[n] for n in names[:2])
    assert found == pytest.approx([0.25 * 0.5 + 0.75 * 0.6 * rock, 0.25 * 0.1 + 0.75 * 0.6 * (1 - rock), 0.3, 0.1])


@pytest.mark.parametrize(
    ("group", "mean"),
    # Means of the samples of the libraries, by cover: soils 0.961, gravel, rock and sand of inhabited deserts; roofs of
    # tile 0.936, shingle 0.959, concrete 0.939, membrane 0.945, slate 0.916, painted metal 0.937 and 4 % bare metal.
    [("bare land", 0.951), ("paved", 0.944), ("roof", 0.931), ("vegetation", 0.966), ("water", 0.985), ("snow", 0.986)],
)
def test_shares_of_the_land_cover_give_the_mean_emissivity_of_many_samples(group, mean):
    shares = GROUPS[group].shares
    assert sum(shares.values()) == pytest.approx(1.0)
    found = sum(share * EMISSIVITY(name) for name, share in shares.items())
    assert abs(found - mean) < max(GROUPS[group].mean_std, 0.002), found


def test_stated_shares_of_a_group_are_taken(model):
    shipped = load_map("procedural")
    stated = shipped.with_shares({"granite": 0.5})
    share = dict(zip(stated.materials, stated.share, strict=True))
    bare = {name: share[name] for name, group in zip(stated.materials, stated.groups, strict=True)
            if group == "bare land"}  # fmt: skip
    assert share["granite"] == 0.5 and sum(bare.values()) == pytest.approx(1.0)
    assert share["soil_loam"] / share["sand_quartz"] == pytest.approx(4.2)
    with pytest.raises(
        ThermorenderError, match=r"shares soil_loam=0.6, granite=0.7 of the group 'bare land' sum to 1.3"
    ):
        shipped.with_shares({"granite": 0.7, "soil_loam": 0.6})
    with pytest.raises(ThermorenderError, match=r"shares water=0.5 of the group 'water' sum to 0.5; give .* to 1"):
        shipped.with_shares({"water": 0.5})
    with pytest.raises(ThermorenderError, match="does not have the material 'gold' to give a share"):
        shipped.with_shares({"gold": 0.5})
    with pytest.raises(ThermorenderError, match=r"labels decide which paved it is in .* out the shares of asphalt"):
        model.with_shares({"asphalt": 0.5})


def test_four_polygons_adapt_a_map_to_other_colours(model):
    """The stripes' colours are exchanged; the map is wrong there until polygons correct it."""
    rgb, number = striped(5)
    swapped = rgb[:, ::-1].copy()
    squares = np.zeros_like(number)
    for row in (10, 60):
        for column, value in ((12, 1), (66, 2), (116, 3)):
            squares[row : row + 16, column : column + 16] = value
    names = dict(enumerate(STRIPES, 1))
    picture = Labelled(swapped, squares, names, 0.5, "exchanged stripes")
    new = adapted(model, picture, "new", EMISSIVITY)
    before, after = (map_materials(each, swapped, 0.5) for each in (model, new))
    right = [np.mean(np.array(each.materials)[mapped.index[..., 0]] == np.array(list(STRIPES))[number - 1])
             for each, mapped in ((model, before), (new, after))]  # fmt: skip
    assert right[0] < 0.4 and right[1] > 0.95
    assert new.about["adapted_from"] == "stripes" and "6 polygons" in new.about["adapted_to"]
    granite = adapted(model, replace(picture, names={1: "granite", 2: "asphalt", 3: "sand_quartz"}), "g", EMISSIVITY)
    assert granite.materials == (*model.materials, "granite")
    found = map_materials(granite, swapped, 0.5).index[:, 10:40, 0]
    assert (np.array(granite.materials)[found] == "granite").mean() > 0.9
    few = np.where(np.arange(96)[:, None] < 40, squares, 0).astype(np.uint8)
    with pytest.raises(ThermorenderError, match="has 3 polygons, but 4 or more can update a map; add some"):
        adapted(model, replace(picture, material=few), "few", EMISSIVITY)
    one = np.uint8(squares > 0)
    with pytest.raises(ThermorenderError, match=r"has polygons of .* only, but a map is updated by those of two"):
        adapted(model, replace(picture, material=one), "one", EMISSIVITY)


def test_a_map_of_a_scene_with_one_material_and_another_is_updated(model):
    """A network that saw one material has the layers of the others."""
    rgb, number = striped(1)
    names = dict(enumerate(STRIPES, 1))
    pictures = [
        Labelled(rgb, number, names, 0.5, "all"),
        Labelled(rgb, np.uint8(number == 2), {1: "asphalt"}, 0.5, "one"),
    ]
    both = train(pictures, 0.5, "both", EMISSIVITY)[0]
    only = both.networks[1]
    assert [weight.shape for weight, _ in only] == [weight.shape for weight, _ in both.networks[0]]
    value = replace(both, networks=(only,)).probabilities(features(rgb).reshape(-1, len(NAMES)))[0]
    assert value[:, both.materials.index("asphalt")].min() > 1.0 - 1e-6
    rows, columns = np.indices(number.shape)
    squares = np.where((rows % 48 < 16) & (columns % 24 < 16), number, 0).astype(np.uint8)
    new = adapted(both, Labelled(rgb, squares, names, 0.5, "squares"), "new", EMISSIVITY)
    found = np.array(new.materials)[map_materials(new, rgb, 0.5).index[..., 0]]
    assert (found == np.array(list(STRIPES))[number - 1]).mean() > 0.95


def test_many_polygons_share_the_texels_of_an_update(model, monkeypatch):
    rgb, number = striped(5)
    rows, columns = np.indices(number.shape)
    squares = np.where((rows % 8 < 6) & (columns % 8 < 6), number, 0).astype(np.uint8)
    picture = Labelled(rgb, squares, dict(enumerate(STRIPES, 1)), 0.5, "many")
    used = []
    fitted = adaptation._fitted
    monkeypatch.setattr(adaptation, "_MOST_TEXELS", 600)
    monkeypatch.setattr(adaptation, "_fitted", lambda *given: used.append(len(given[1])) or fitted(*given))
    new = adapted(model, picture, "new", EMISSIVITY)
    assert max(used) <= 600 and len(new.centres) > len(model.centres) + 200


def test_uncertain_emissivity_is_in_the_budget_and_flagged(scene):
    softer = load_map(scene / "own.npz")
    layers = softer.networks[0]
    layers = (*layers[:-1], (layers[-1][0] / 3.0, layers[-1][1] / 3.0))
    save_map(replace(softer, networks=(layers,)), scene / "own.npz")
    learned_source(scene, 'model = "own.npz"\nfallback = "granite"\nmost_std = 1e-6\n')
    loaded = tr.load_scene(scene)
    report = loaded.emissivity_report
    surface = loaded.surfaces[0]
    std = np.array([each.band_emissivity_std(*loaded.camera.band_um, 300.0) for each in loaded.materials])
    # The last material is the fallback, which is not learned; single materials have no spread between materials.
    spread = np.append(std[:-1] > 1e-6, False)[surface.material]
    assert 0.1 < report["share_uncertain"] == pytest.approx(spread.mean())
    assert report["share_unknown"] == pytest.approx(((surface.flags & UNKNOWN > 0) & ~spread).mean())
    assert (surface.flags[spread] & UNKNOWN > 0).all()
    frame = tr.Renderer(loaded, rays=4, samples=4).frame(loaded.pose(0, 0, 60, pitch_deg=-90))
    std, kelvin = frame.truth["emissivity_std"].astype(float), frame.truth["kinetic_temperature"].astype(float)
    shown = np.isfinite(std)
    # Central difference of the seen radiance in emissivity, in mK at 300 K.
    band = loaded.camera.band_um
    per_mk = band_radiance(300.0005, *band) - band_radiance(299.9995, *band)
    contrast = np.abs(band_radiance(kelvin[shown], *band) - band_radiance(loaded.sky_temperature, *band))
    expected = np.sqrt(np.mean((std[shown] * contrast / per_mk) ** 2))
    assert frame.budget_mk["emissivity"] == pytest.approx(expected, rel=1e-3) and expected > 1.0
    parts = [
        value
        for cause, value in frame.budget_mk.items()
        if cause not in ("total", "image", "emissivity", "emissivity_mean")
    ]
    assert frame.budget_mk["total"] == pytest.approx(np.sqrt(np.sum(np.square(parts))))


@pytest.mark.parametrize("kelvin", [250.0, *slow(300.0), 400.0])
def test_the_effect_of_an_uncertain_emissivity_is_that_of_rendering_another(tmp_path, kelvin):
    """Level ground under a uniform sky, rendered with an emissivity of 0.9 and of 0.93, without air."""
    radiance = []
    ground = trimesh.Trimesh(20.0 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]), [[0, 1, 2], [0, 2, 3]])
    for value in (0.9, 0.93):
        path = write_mesh(tmp_path / f"ground {value}", ground, kelvin, value, sky=260.0)
        renderer = tr.Renderer(tr.load_scene(path), rays=64)
        frame = renderer.frame(tr.pose(0, 0, 10, pitch_deg=-90))
        radiance.append(frame.radiance.astype(np.float64))
    stated = 0.03 * emissivity_mk(renderer.baked, frame.truth)
    seen = np.abs(radiance[1] - radiance[0]) / renderer.plan.radiance_per_mk
    assert seen.mean() > 100.0
    # Rounding of float32 radiance, 6e-8 of 100 K and more, is below 0.05 mK.
    assert np.abs(stated - seen)[np.isfinite(stated)].max() < 0.05 + 1e-4 * seen.mean()


def test_scene_takes_its_materials_from_its_orthophoto(scene):
    loaded = tr.load_scene(scene)
    surface, names = loaded.surfaces[0], [material.name for material in loaded.materials]
    found = np.array([*map(largest_part, names)])[surface.material]
    assert (found[:, :80] == "grass_green").mean() > 0.9
    assert (found[:, 106:130] == "asphalt").mean() > 0.9
    assert (found[:, 200:] == "sand_quartz").mean() > 0.9
    unknown = (surface.flags & UNKNOWN) > 0
    assert unknown[PATCH].all() and (found[unknown] == "granite").all()
    assert unknown[:, :80].mean() < 0.02
    assert loaded.emissivity_report["share_unknown"] == pytest.approx(unknown.mean())
    assert "unknown and taken for granite" in str(loaded)


def test_confidence_and_without_are_applied(scene):
    learned_source(scene, 'model = "own.npz"\nfallback = "granite"\nconfidence = 1.0\n')
    strict = tr.load_scene(scene).emissivity_report["share_unknown"]
    learned_source(scene, 'model = "own.npz"\nfallback = "granite"\nconfidence = 0.01\nwithout = ["asphalt"]\n')
    loose = tr.load_scene(scene)
    assert strict > 2.0 * loose.emissivity_report["share_unknown"]
    assert not any("asphalt" in material.name for material in loose.materials)


def test_a_scene_states_the_shares_of_its_ground(scene):
    emissivity = {}
    for stated in ("", "shares = {granite = 0.9}\n"):
        learned_source(scene, f'model = "procedural"\nfallback = "granite"\nconfidence = 1e-6\n{stated}')
        loaded = tr.load_scene(scene)
        value = np.array([float(each.band_emissivity(7.5, 13.5, 300.0)) for each in loaded.materials])
        emissivity[stated] = value[loaded.surfaces[0].material]
    # The sand's texels are bare land above all, which is granite now.
    assert (emissivity["shares = {granite = 0.9}\n"] - emissivity[""])[:, 220:].mean() < -0.02
    learned_source(scene, 'model = "procedural"\nfallback = "granite"\nshares = {granite = 1.2}\n')
    with pytest.raises(ThermorenderError, match=r"emissivity.shares.granite=1.2 is not allowed"):
        tr.load_scene(scene)


@pytest.mark.slow
def test_indistinguishable_materials_are_mixed(scene):
    # One in four of the sand's texels is labelled asphalt, so colour cannot separate them.
    rgb, number = striped(1)
    number[(number == 3) & (np.random.default_rng(0).random(number.shape) < 0.25)] = 2
    save_map(
        train([Labelled(rgb, number, dict(enumerate(STRIPES, 1)), 0.5, "x")], 0.5, "x", EMISSIVITY)[0],
        scene / "own.npz",
    )
    text = (scene / "scene.toml").read_text(encoding="utf-8")
    table = "[temperature.materials]\nasphalt = 320.0\ngrass_green = 290.0\nsand_quartz = 300.0"
    text = text.replace('source = "raster"\nraster = "temperature.tif"', f'source = "material"\n{table}', 1)
    (scene / "scene.toml").write_text(text, encoding="utf-8")
    loaded = tr.load_scene(scene)
    kelvin = {"asphalt": 320.0, "grass_green": 290.0, "sand_quartz": 300.0}
    surface = loaded.surfaces[0]
    asphalt = np.zeros(len(loaded.materials))
    for number, material in enumerate(loaded.materials):
        here = surface.material == number
        if isinstance(material, Mixture) and here.any():
            shares = {part.name: share for part, share in material.parts}
            assert sum(shares.values()) == 1.0
            wanted = sum(share * kelvin[name] for name, share in shares.items())
            assert surface.temperature[here] == pytest.approx(np.full(here.sum(), wanted), abs=1e-3)
            asphalt[number] = shares.get("asphalt", 0.0)
    # Training draws materials by the square root of their area. Asphalt has 5/12 of all texels and sand 3/12, so of a
    # quarter a fifth is left. The palette's eighths round it by a sixteenth at most.
    drawn = 0.25 / np.sqrt(5 / 12), 0.75 / np.sqrt(3 / 12)
    share = asphalt[surface.material[:, 220:260]].mean()
    assert share == pytest.approx(drawn[0] / sum(drawn), abs=1 / 16)
    assert f"and {sum(isinstance(m, Mixture) for m in loaded.materials)} mixes of them" in str(loaded)


def test_unknown_texels_are_flagged_in_the_truth_of_a_frame(scene):
    loaded = tr.load_scene(scene)
    frame = tr.Renderer(loaded, "fast", rays=4).frame(straight_down(60.0))
    mask, material = frame.truth["mask"], frame.truth["material"]
    unknown = (mask & UNKNOWN) > 0
    assert 0.005 < unknown.mean() < 0.3
    names = np.array([material.name for material in loaded.materials])
    assert (names[material[unknown]] == "granite").all()


def straight_down(up):
    pose = np.eye(4)
    pose[:3, :3] = np.diag([1.0, -1.0, -1.0])
    pose[2, 3] = up
    return pose


def test_empty_borders_stay_filled_and_do_not_count_as_unknown(scene):
    rgb, _ = striped(7, 128, 288)
    rgb[:, 240:] = 0
    write_raster(scene / "orthophoto.tif", np.moveaxis(rgb, -1, 0), 0.5, photometric="RGB")
    loaded = tr.load_scene(scene)
    flags = loaded.surfaces[0].flags
    assert ((flags[:, 240:] & FILLED) > 0).all() and not (flags[:, 240:] & UNKNOWN).any()
    assert loaded.emissivity_report["share_unknown"] == pytest.approx((flags[:, :240] & UNKNOWN > 0).mean())


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('model = "own.npz"\n', "emissivity.fallback is missing; source='learned' needs it"),
        ('fallback = "granite"\n', "emissivity.model is missing; source='learned' needs it"),
        ('model = "lost.npz"\nfallback = "granite"\n', "emissivity.model='lost.npz' does not exist"),
        ('model = "scene.toml"\nfallback = "granite"\n', "scene.toml is not an emissivity map"),
        ('model = "own.npz"\nfallback = "granit"\n', "fallback uses material 'granit'.* closest are granite"),
        ('model = "own.npz"\nfallback = "granite"\nconfidence = 1.5\n', "emissivity.confidence=1.5 is not allowed"),
        ('model = "own.npz"\nfallback = "granite"\nwithout = "snow"\n', "without='snow' is not allowed; give a list"),
        ('model = "own.npz"\nfallback = "granite"\nwithout = ["snow"]\n', "material 'snow' to leave out"),
    ],
)  # fmt: skip
def test_wrong_scene_files_are_refused(scene, text, words):
    learned_source(scene, text)
    with pytest.raises(ThermorenderError, match=words):
        tr.load_scene(scene)


def test_learned_materials_need_an_orthophoto(scene, tmp_path):
    text = (scene / "scene.toml").read_text(encoding="utf-8")
    (scene / "scene.toml").write_text(text.replace('orthophoto = "orthophoto.tif"\n', ""), encoding="utf-8")
    with pytest.raises(ThermorenderError, match=r"emissivity.source='learned' reads materials from an orthophoto"):
        tr.load_scene(scene)
    with pytest.raises(ThermorenderError, match=r"has no terrain.orthophoto beside terrain.elevation"):
        labelled_scene(scene)
    import trimesh

    folder = write_mesh(tmp_path / "mesh", trimesh.creation.box())
    learned_source(folder, 'model = "procedural"\nfallback = "granite"\n')
    with pytest.raises(ThermorenderError, match="reads materials from textures, and this mesh has none"):
        tr.load_scene(folder)


def test_map_materials_output_can_be_used_in_a_scene(scene, tmp_path, model):
    output = tmp_path / "out"
    output.mkdir()
    written, shares, _ = write_map(scene, output, scene / "own.npz", "granite")
    with rasterio.open(written["classes"]) as file:
        classes, colours = file.read(1), file.colormap(1)
    assert colours[UNKNOWN_CLASS][:3] == (255, 0, 255)
    table = np.array([colours[k][:3] for k in range(1, 4)], np.uint8)
    gaps = np.linalg.norm(lab(table)[:, None] - lab(table), axis=-1)[np.triu_indices(3, 1)]
    assert gaps.min() > 18.0
    assert (classes[PATCH] == UNKNOWN_CLASS).all()
    named = np.array(["none", *model.materials])[np.where(classes == UNKNOWN_CLASS, 0, classes)]
    assert (named[:, :80] == "grass_green").mean() > 0.97
    assert sum(shares.values()) == pytest.approx(1.0) and shares["unknown"] == (classes == UNKNOWN_CLASS).mean()
    with rasterio.open(written["probabilities"]) as file:
        assert file.descriptions == model.materials
        planes = file.read().astype(int)
    assert (np.abs(planes.sum(axis=0) - 255) <= 2).all()
    sure = (classes > 0) & (classes != UNKNOWN_CLASS)
    assert (planes.argmax(axis=0) + 1 == classes)[sure].mean() > 0.999
    with rasterio.open(written["confidence"]) as file:
        assert (file.read(1)[PATCH] == 0).all()
    assert written["materials"].stat().st_size > 5000
    # A scene that uses the written files has the same materials.
    text = (scene / "scene.toml").read_text(encoding="utf-8")
    start, end = text.index("[emissivity]"), text.index("[sky]")
    own = written["emissivity"].read_text(encoding="utf-8")
    (scene / "classes.tif").write_bytes(written["classes"].read_bytes())
    (scene / "scene.toml").write_text(text[:start] + own + text[end:], encoding="utf-8")
    loaded = tr.load_scene(scene)
    names = np.array([material.name for material in loaded.materials])[loaded.surfaces[0].material]
    assert (names == np.array([*model.materials, "granite"])[np.where(sure, classes.astype(int) - 1, 3)]).all()
    # Unknown texels are not used as labels.
    assert (labelled_scene(scene).material[~sure] == 0).all()


def test_map_materials_takes_what_the_scene_states(scene, tmp_path):
    learned_source(scene, 'model = "own.npz"\nfallback = "snow"\nwithout = ["asphalt"]\nconfidence = 0.98\n')
    (tmp_path / "out").mkdir()
    written, shares, _ = write_map(scene, tmp_path / "out")
    assert "asphalt" not in shares and shares["unknown"] > 0.01
    table = written["emissivity"].read_text(encoding="utf-8")
    assert '255 = "snow"' in table and '"sand_quartz"' in table
    # Another map may lack what the scene says of its own.
    learned_source(scene, 'model = "own.npz"\nfallback = "snow"\nwithout = ["sand_quartz"]\n')
    save_map(load_map(scene / "own.npz").without(["sand_quartz"]), tmp_path / "other.npz")
    (tmp_path / "other").mkdir()
    assert "asphalt" in write_map(scene, tmp_path / "other", str(tmp_path / "other.npz"))[1]


def polygons(path, shapes, crs="urn:ogc:def:crs:EPSG::32634", key="material"):
    features_ = [
        {"type": "Feature", "properties": {key: name},
         "geometry": {"type": "Polygon", "coordinates": [[*map(list, ring), list(ring[0])]]}}
        for name, ring in shapes
    ]  # fmt: skip
    content = {"type": "FeatureCollection", "features": features_}
    if crs:
        content["crs"] = {"type": "name", "properties": {"name": crs}}
    path.write_text(json.dumps(content), encoding="utf-8")
    return path


def boxes(offset=500000.0):
    """A box in each stripe of the scene, in map coordinates; texels are 0.5 m, the corner is at 5780000 north."""
    ring = lambda left, right: [(offset + x, 5780000.0 - y) for x, y in  # noqa: E731
                                ((left, 4), (right, 4), (right, 60), (left, 60))]  # fmt: skip
    return [("grass_green", ring(2, 40)), ("asphalt", ring(52, 70)), ("sand_quartz", ring(100, 140))]


def test_polygons_train_a_map(scene, tmp_path):
    path = polygons(tmp_path / "ground.geojson", boxes())
    labelled = labelled_scene(scene, path)
    assert labelled.names == {1: "grass_green", 2: "asphalt", 3: "sand_quartz"}
    # 38 m × 56 m and so on, in texels of 0.25 m².
    assert np.bincount(labelled.material.ravel()).tolist()[1:] == [8512, 4032, 8960]
    assert labelled.material[8, 4] == 1 and labelled.material[7, 4] == 0 and labelled.material[8, 3] == 0
    model, confusion = train_on([scene], path, "ground")
    assert np.trace(confusion) / confusion.sum() > 0.97 and "ground.geojson on stripes" in model.about["trained_on"]


def test_polygons_in_longitude_and_latitude_give_the_same_labels(scene, tmp_path):
    from rasterio.warp import transform

    there = [(name, list(zip(*transform("EPSG:32634", "OGC:CRS84", *zip(*ring, strict=True)), strict=True)))
             for name, ring in boxes()]  # fmt: skip
    degrees = labelled_scene(scene, polygons(tmp_path / "deg.geojson", there, crs=None))
    metres = labelled_scene(scene, polygons(tmp_path / "m.geojson", boxes()))
    assert (degrees.material != metres.material).mean() < 0.01


@pytest.mark.parametrize(
    ("make_file", "words"),
    [
        (lambda p: polygons(p, boxes(), key="class"), "feature 1 is not a polygon with a property 'material'"),
        (lambda p: polygons(p, boxes(100000.0)), "covers no texel of .*orthophoto.tif"),
        (lambda p: polygons(p, [("gras_green", boxes()[0][1])]), "uses material 'gras_green'.* closest are grass"),
        (lambda p: polygons(p, []), "names 0 materials; label polygons of 2…254 materials"),
        (lambda p: polygons(p, boxes()[:1]), "two or more materials, but .* has those of grass_green only; label more"),
        (lambda p: polygons(p, boxes(), crs="EPSG:nonsense"), "is not a GeoJSON FeatureCollection"),
        (lambda p: p.write_text('{"features": 1.5}'), r"FeatureCollection \(ValueError: features is 1.5, not a list\)"),
        (lambda p: p.write_text('{"features": ' + "[" * 100000), "FeatureCollection .*nested too deep"),
        (lambda p: p.write_text("[1, 2"), "is not a GeoJSON FeatureCollection"),
        (lambda p: p.write_text('{"features": [{"geometry": 1, "properties": {"material": "snow"}}]}'), "feature 1 is"),
        (lambda p: None, "labels.geojson cannot be read: No such file"),
    ],
)  # fmt: skip
def test_wrong_labels_are_refused(scene, tmp_path, make_file, words):
    path = tmp_path / "labels.geojson"
    make_file(path)
    with pytest.raises(ThermorenderError, match=words):
        train_on([scene], path)


def test_training_settings_are_checked(scene, tmp_path):
    with pytest.raises(ThermorenderError, match="belongs to one scene, but 0 are given"):
        train_on([], tmp_path / "labels.geojson")
    with pytest.raises(ThermorenderError, match="--texel-m=0 is not allowed"):
        train_on([scene], None, texel_m=0.0)
    with pytest.raises(ThermorenderError, match="augmentations=-1 is not allowed"):
        train_on([write_terrain(tmp_path / "classes")], augmentations=-1)
    with pytest.raises(ThermorenderError, match=r"has no class raster to train on \(emissivity.source='learned'\)"):
        train_on([scene])


def test_class_raster_trains_a_map(tmp_path):
    rgb, number = striped(3)
    folder = write_terrain(tmp_path / "classes", np.zeros((48, 72)), classes=np.minimum(number, 2), colour=rgb)
    model, confusion = train_on([folder], seed=1)
    assert set(model.materials) == {"grass_green", "sand_quartz"} and model.texel_m == pytest.approx(0.5, rel=1e-2)
    assert np.trace(confusion) / confusion.sum() > 0.9


def test_class_numbers_above_255_are_refused(tmp_path):
    classes = np.full((32, 32), 300, np.uint16)
    classes[:, 16:] = 2
    folder = write_terrain(tmp_path / "wide")
    write_raster(folder / "classes.tif", classes[None], 0.5)
    with pytest.raises(ThermorenderError, match=r"classes.tif holds 300, which is not a class number; give"):
        labelled_scene(folder)


def test_shipped_map_is_small_and_labelled():
    path = learned.SHIPPED["procedural"]
    assert Path(path).stat().st_size <= 2_000_000
    shipped = load_map("procedural")
    assert set(shipped.materials) <= set(load_library())
    assert shipped.name == "procedural" and "procedural village seed 101" in shipped.about["trained_on"]
    assert shipped.texel_m == 0.5 and shipped.about["split"].startswith("one block of 12 m in 5")


@pytest.mark.slow
def test_shipped_map_is_better_than_simpler_methods_on_unseen_land(monkeypatch):
    monkeypatch.setattr(validation, "make", lambda kind, seed: make(kind, seed, *SMALL[kind]))
    result = validation.evaluate("procedural", (11,), kinds=("village",))
    methods = result["all"]
    learned, likely = methods["learned, mean of all"], methods["learned, most probable"]
    assert learned["accuracy"] > methods["nearest colour"]["accuracy"] + 0.1
    # Nearest colour is told the true mean colour of each material here, and the land cover does not replace its shares.
    for other in ("commonest material", "fallback"):
        assert learned["emissivity_rms"] < methods[other]["emissivity_rms"], other
        assert likely["emissivity_mean"] < methods[other]["emissivity_mean"], other
        assert likely["mk_mean"] < methods[other]["mk_mean"], other
    # Heights of the surface model tell roofs and trees from the ground.
    heights = result["scenes"]["village 11"]["methods"]["learned, with heights"]
    assert heights["balanced"] > result["scenes"]["village 11"]["methods"]["learned, mean of all"]["balanced"] + 0.02
    assert heights["accuracy"] > learned["accuracy"] + 0.02
    assert heights["emissivity_mean"] < 0.9 * learned["emissivity_mean"]
    table = np.array(result["confusion"])
    assert table.sum() == 440 * 440 and len(result["materials"]) == table.shape[0] == table.shape[1] - 1
    right = sum(table[k, k] for k in range(len(table))) / table.sum()
    # Unknown texels count as wrong in the table, and as the fallback in the method.
    assert right == pytest.approx(learned["accuracy"], abs=0.02)


def test_evaluation_on_training_seeds_is_refused():
    with pytest.raises(ThermorenderError, match="seed=101 is a seed that 'procedural' was trained on; give another"):
        validation.evaluate("procedural", (101,))


def test_temperature_errors_match_those_of_grey_surfaces():
    temperature = np.array([[280.0, 300.0, 320.0]])
    judge = validation.Errors([grey("black", 1.0), grey("grey", 0.9)], temperature, 250.0)
    truth = np.zeros((1, 3), int)
    _, emissivity, kelvin = judge(truth, *validation.pure(truth + 1))
    band = (7.5, 13.5)
    wanted = brightness_temperature(0.9 * band_radiance(temperature, *band) + 0.1 * band_radiance(250.0, *band), *band)
    assert emissivity == pytest.approx([-0.1] * 3, abs=1e-6)
    # The tables' steps cause 45 µK of error.
    assert kelvin == pytest.approx((wanted - temperature)[0], abs=1e-4)
    half = np.array([[[0, 1]] * 3])
    _, emissivity, _ = judge(truth, half, np.full((1, 3, 2), 0.5))
    assert emissivity == pytest.approx([-0.05] * 3, abs=1e-6)


def test_train_and_map_commands(scene, tmp_path):
    from typer.testing import CliRunner

    from thermorender.cli.app import app

    def run(*arguments):
        return CliRunner().invoke(app, [*map(str, arguments)], catch_exceptions=True)

    path = polygons(tmp_path / "ground.geojson", boxes())
    done = run("train", "emissivity", scene, "--labels", path, "-o", tmp_path / "maps" / "ground.npz")
    assert done.exit_code == 0 and "ground: RGB → 3 materials at 0.5" in done.output, done.output
    assert load_map(tmp_path / "maps" / "ground.npz").name == "ground"
    done = run("map-materials", scene, "--model", tmp_path / "maps" / "ground.npz", "-o", tmp_path / "mapped")
    assert done.exit_code == 0 and "sand_quartz" in done.output, done.output
    assert len(list((tmp_path / "mapped").iterdir())) == 5
    failed = run("map-materials", scene, "--without", "snow", "-o", tmp_path / "none", "--model", scene / "own.npz")
    assert "material 'snow' to leave out" in str(failed.exception) and not (tmp_path / "none").exists()
    failed = run("map-materials", scene, "--confidence", "2", "-o", tmp_path / "none", "--model", scene / "own.npz")
    assert "confidence=2 is not allowed; give a number 0…1" in str(failed.exception)
    assert not (tmp_path / "none").exists()
    failed = run("train", "emissivity", scene, "-o", tmp_path / "none.txt")
    assert "give one that ends in .npz" in str(failed.exception) and not (tmp_path / "none.txt").exists()


def test_study_seeds_must_be_integers(tmp_path, call_module):
    status, _, errors = call_module("validation.emissivity", "--seeds", "one", "-o", tmp_path / "none")
    assert status == 2 and "--seeds='one' is not allowed" in errors


def test_spreads_of_materials_that_are_groups_are_those_of_a_draw(model):
    own = replace(model, materials=("a", "b", "c"), groups=(), share=(), own=(), outputs=(), spread=(1.0, 1.0))
    probability = np.array([[[255, 0, 0], [51, 204, 0], [0, 0, 0]]], np.uint8)
    mean, between, within, _ = own.spreads(probability, np.array([0.9, 0.4, 0.1]))
    np.testing.assert_allclose(mean, [[0.9, 0.2 * 0.9 + 0.8 * 0.4, 0.0]], atol=1e-6)
    np.testing.assert_allclose(within, [[0.0, 0.5 * np.sqrt(0.2 * 0.8), 0.0]], atol=3e-4)
    np.testing.assert_allclose(between, within, atol=3e-4)
    # Each material differs by 0.010 between places.
    np.testing.assert_allclose(
        own.moments(probability, np.array([0.9, 0.4, 0.1]))[1][0, :2], [0.01, 0.20025], atol=1e-4
    )
