"""The stated albedo of a terrain: solar absorptance of its bare materials, refusals, and its uncertainty in kelvin."""

import re

import numpy as np
import pytest
from PIL import Image

from scenes import WEATHER, scene_object, write_balance
from thermorender.errors import ThermorenderError
from thermorender.output.provenance import weather_of
from thermorender.scene import open_ground
from thermorender.scene.load import load_scene

pytestmark = pytest.mark.usefixtures("short_heat")

# A quarter of the terrain is sand, the rest grass or granite.
CLASSES = np.repeat([[1] * 48 + [2] * 16], 64, axis=0)


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """{material of three quarters: folder}"""
    made = {}
    for name in ("grass_green", "granite"):
        folder = write_balance(tmp_path_factory.mktemp(name) / "scene", WEATHER, height=np.zeros((32, 32)),
                               classes=CLASSES)  # fmt: skip
        path = folder / "scene.toml"
        path.write_text(path.read_text().replace("grass_green", name))
        made[name] = folder
    return made


@pytest.fixture(scope="module")
def rocky(folders):
    return load_scene(folders["granite"])


def reflected(scene):
    """Mean reflectance of the terrain's texels for sunlight."""
    absorbs = np.array([material.solar_absorptance for material in scene.materials])
    return float(1.0 - absorbs[scene.surfaces[0].material].mean())


@pytest.mark.parametrize("name", ["granite", "grass_green"])
def test_mean_reflectance_of_the_terrain_is_the_albedo(folders, name):
    scene = load_scene(folders[name])
    stated = scene.with_weather(albedo=0.28)
    assert reflected(scene) != pytest.approx(0.28, abs=0.02)
    assert reflected(stated) == pytest.approx(0.28, abs=1e-6)
    before, after = ({m.name: 1.0 - m.solar_absorptance for m in each.materials} for each in (scene, stated))
    other = next(each for each in before if each != name)
    if name == "grass_green":
        assert after[name] == before[name]
    else:
        # The contrast of bare materials stays.
        assert after[name] / before[name] == pytest.approx(after[other] / before[other])


def test_scene_file_and_python_mean_the_same(folders, rocky, tmp_path):
    path = folders["granite"] / "scene.toml"
    text = path.read_text()
    try:
        path.write_text(text.replace("[weather]", "[weather]\nalbedo = 0.3\nalbedo_std = 0.02"))
        stated = load_scene(folders["granite"])
    finally:
        path.write_text(text)
    assert stated.digest() == rocky.with_weather(albedo=0.3, albedo_std=0.02).digest()
    assert stated.digest() != rocky.digest()


def test_edits_keep_the_albedo_in_any_order(rocky):
    one = rocky.with_weather(albedo=0.3).with_material(granite="limestone")
    other = rocky.with_material(granite="limestone").with_weather(albedo=0.3)
    assert one.digest() == other.digest() and reflected(one) == pytest.approx(0.3, abs=1e-6)
    # A Weather in place of the file has no albedo of its own.
    assert reflected(one.with_weather(one.weather)) == pytest.approx(0.3, abs=1e-6)
    assert reflected(one.at("2018-07-28T09:00Z")) == pytest.approx(0.3, abs=1e-6)


def test_texels_of_a_mesh_count_by_their_area(tmp_path):
    """A texture of 128 texels, of which faces show the left half, on 400 m² beside one texel on 1600 m²."""
    corners = [(0, 0), (20, 0), (20, 20), (0, 20), (30, 0), (70, 0), (70, 40), (30, 40)]
    lines = [f"v {x} {y} 0" for x, y in corners] + [f"vt {u} {v}" for u, v in ((0, 0), (0.45, 0), (0.45, 1), (0, 1))]
    lines += ["usemtl ground", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4", "usemtl tiles", "f 5 6 7", "f 5 7 8"]
    (tmp_path / "m.obj").write_text("mtllib m.mtl\n" + "\n".join(lines) + "\n")
    (tmp_path / "m.mtl").write_text("newmtl ground\nmap_Kd t.png\nnewmtl tiles\nKd 0.6 0.2 0.1\n")
    Image.fromarray(np.full((16, 8, 3), 120, np.uint8)).save(tmp_path / "t.png")
    classes = np.repeat([[1] * 3 + [2] * 5], 16, axis=0).astype(np.uint8)
    Image.fromarray(classes).save(tmp_path / "classes.png")
    (tmp_path / "scene.toml").write_text(
        '[terrain]\nmesh = "m.obj"\n[temperature]\nsource = "balance"\n[emissivity]\nsource = "classes"\n'
        '[emissivity.classes]\n1 = "granite"\n2 = "sand_quartz"\n[[surface]]\nname = "t.png"\nclasses = "classes.png"\n'
        '[[surface]]\nname = "tiles"\nmaterial = "asphalt"\n[frame]\nlatitude_deg = 52.0\nlongitude_deg = 20.0\n'
        f"height_m = 100.0\n{WEATHER}albedo = 0.25\n"
    )
    scene = load_scene(tmp_path)
    share = {"granite": 300.0, "sand_quartz": 100.0, "asphalt": 1600.0}
    mean = sum(share[each.name] * (1.0 - each.solar_absorptance) for each in scene.materials) / 2000.0
    assert mean == pytest.approx(0.25, abs=1e-6)


def test_materials_of_objects_keep_their_table(folders):
    path = folders["granite"] / "scene.toml"
    text = path.read_text()
    box = scene_object("box", [2, 2, 2], [2.0, 2.0, 0.0], 300.0, "sand_gypsum")
    try:
        path.write_text(f"{text}\n{box}")
        scene = load_scene(folders["granite"])
    finally:
        path.write_text(text)
    before, after = (
        {m.name: m.solar_absorptance for m in s.materials} for s in (scene, scene.with_weather(albedo=0.5))
    )
    assert after["sand_gypsum"] == before["sand_gypsum"] and after["granite"] < before["granite"]


@pytest.mark.parametrize(
    ("name", "keys", "words"),
    [
        (
            "granite",
            {"albedo": 0.9},
            r"weather.albedo=0.9 is out of reach of .* give a value above 0.00 and up to 0\.\d+",
        ),
        ("grass_green", {"albedo": 0.1}, r"weather.albedo=0.1 is out of reach .* above 0\.1\d and up to"),
        ("granite", {"albedo": 1.4}, r"albedo=1.4 is not within 0.02…0.95|albedo.*0.02…0.95"),
        ("granite", {"albedo_std": 0.02}, "albedo_std=0.02 .* with albedo only"),
    ],
)
def test_albedo_out_of_reach_is_refused(folders, name, keys, words):
    with pytest.raises(ThermorenderError, match=words):
        load_scene(folders[name]).with_weather(**keys)


def test_albedo_without_bare_ground_is_refused(folders):
    scene = load_scene(folders["grass_green"]).with_material(sand_quartz="grass_dry")
    with pytest.raises(ThermorenderError, match="sets bare materials that reflect sunlight, and the terrain has none"):
        scene.with_weather(albedo=0.2)


def test_records_state_the_albedo_and_its_uncertainty(rocky):
    """The kelvin are those of an independent pair of columns with each its own absorptance."""
    scene = rocky.with_weather(albedo=0.3, albedo_std=0.04)
    note = next(note for note in weather_of(scene)["weather"]["notes"] if note.startswith("albedo"))
    kelvin = float(re.search(r"± 0.04 is ± ([\d.]+) K", note).group(1))
    found = []
    for albedo in (0.28, 0.32):
        other = rocky.with_weather(albedo=albedo)
        columns = open_ground.columns(other.materials, other.weather, 0.0, open_ground.STATION_ROUGHNESS_M)
        state, _ = open_ground.settled(columns, other.weather, other.time)
        names = [material.name for material in other.materials]
        found.append(
            0.75 * state.surface_k[names.index("granite")]
            + 0.25 * np.delete(state.surface_k, names.index("granite")).sum()
        )
    assert kelvin == pytest.approx(found[0] - found[1], abs=0.06) and kelvin > 0.5
    assert "its assumed ± 0.03" in rocky.with_weather(albedo=0.3).weather_notes[-1]
    assert not any("albedo" in note for note in rocky.weather_notes)
