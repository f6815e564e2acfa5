"""DJI's radiometric JPEGs through the program that reads them: its settings, its faults, and what callers make of it.

A stand-in for the program writes the settings that it was given as temperatures. The program itself was compared with
DJI's own library: `docs/reference/checks.md`.
"""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from support import write_dji_jpeg

import thermorender as tr
from thermorender.apps.survey.inverse.frames import frame_files, read_frames
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.training import pictures
from thermorender.errors import ThermorenderError
from thermorender.sensor import dji_jpeg
from thermorender.sensor.dji_jpeg import read_dji_jpegs
from thermorender.sensor.thermal_files import read_thermal_image, thermal_frames, thermal_images

ROOT = Path(__file__).resolve().parents[2]
STORED = {"distance": 5.0, "humidity": 50.0, "emissivity": 0.95, "reflection": 25.0, "ambient_temp": 21.5}
RANGES = {"distance": [1.0, 25.0], "ambient_temp": None}
# The first pixels of its TIFFs are emissivity, distance, reflected and air temperature as given, then no data; the rest
# is 300 K, and the picture's length in kilobytes in the last pixel. It counts its calls in a file beside it.
PROGRAM = """#!{python}
import json, pathlib, sys
here = pathlib.Path(__file__).parent
about = json.loads((here / "about.json").read_text())
given = dict(part[2:].split("=", 1) for part in sys.argv if part.startswith("--") and "=" in part)
with open(here / "calls", "a") as calls:
    print(sys.argv[1], file=calls)
files = sorted(pathlib.Path(given["input-dir"]).iterdir()) if "input-dir" in given else []
if sys.argv[1] == "--version":
    print("dji-thermal-cli 1.4.0")
elif sys.argv[1] == "list":
    large = [file for file in files if file.stat().st_size > 10000]
    print(about["list"] or json.dumps(
        [{{"file": {{"name": file.name}}, "thermal": about["thermal"]}} for file in large]
    ))
elif about["refuses"] == "crash":
    sys.exit("Traceback: something broke")
else:
    import numpy as np
    import warnings
    warnings.simplefilter("ignore")
    import rasterio
    for file in files:
        if about["refuses"] in (given["distance"], "all") or file.name == about["refuses"]:
            print("[skip, refused: dirp: no usable range] " + file.name)
            continue
        values = np.full((32, 40), 300.0, about["kind"])
        names = "emissivity", "distance", "reflected-temp", "ambient-temp"
        values[0, :4] = [float(given.get(name, "0")) for name in names]
        values[1, 0] = 0.0
        values[-1, -1] = file.stat().st_size // 1000
        path = pathlib.Path(given["output-dir"]) / (file.stem + "_temp_k.tiff")
        path.parent.mkdir(exist_ok=True)
        with rasterio.open(path, "w", driver="GTiff", width=40, height=32, count=1, dtype=about["kind"]) as out:
            out.write(values, 1)
"""


def thermal(stored=STORED, ranges=RANGES):
    return {"measurement_params": stored, "measurement_params_range": ranges}


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Put a stand-in for the program on the search path, which behaves as the given `about` says."""
    folder = tmp_path / "bin"
    folder.mkdir()

    def install(refuses="", listed="", kind="float32", settings=None):
        program = folder / dji_jpeg.PROGRAM
        program.write_text(PROGRAM.format(python=sys.executable))
        program.chmod(0o755)
        settings = thermal() if settings is None else settings
        about = {"refuses": refuses, "list": listed, "kind": kind, "thermal": settings}
        (folder / "about.json").write_text(json.dumps(about))

    monkeypatch.setenv("PATH", str(folder))
    return install


def calls(tmp_path):
    return (tmp_path / "bin" / "calls").read_text().split()


@pytest.fixture
def picture(tmp_path):
    return write_dji_jpeg(tmp_path / "--input-dir=x DJI_0001.JPG")


def test_a_file_is_read_as_a_blackbody_at_the_least_distance_with_the_air_of_the_file(picture, installed):
    installed()
    (found,) = read_dji_jpegs([picture])
    assert list(found.kelvin[0, :4]) == [1.0, 1.0, 21.5, 21.5]
    assert np.isnan(found.kelvin[1, 0]) and (found.kelvin[2:-1] == 300.0).all()
    assert found.words == "dji-thermal-cli 1.4.0, as a blackbody at 1 m, reflected and air 21.5 °C, humidity 50 %"


def test_the_temperature_of_the_air_can_be_stated(picture, installed):
    installed()
    (found,) = read_dji_jpegs([picture], 3.25)
    assert list(found.kelvin[0, :4]) == [1.0, 1.0, 3.25, 3.25] and "air 3.25 °C" in found.words


def test_a_camera_without_an_air_temperature_has_its_reflected_one(picture, installed):
    installed(settings=thermal({**STORED, "ambient_temp": None}))
    (found,) = read_dji_jpegs([picture])
    # The program was given no temperature of the air: a 0, which is no data.
    assert found.kelvin[0, 2] == found.reflected_c == 25.0 and np.isnan(found.kelvin[0, 3])


def test_a_file_whose_calibration_begins_at_its_own_distance_is_read_at_that(picture, installed):
    installed(refuses="1.0")
    (found,) = read_dji_jpegs([picture])
    assert found.distance_m == found.kelvin[0, 1] == 5.0


def several(tmp_path, count):
    """Radiometric JPEGs whose length tells them apart: the k-th has k kilobytes more."""
    files = [write_dji_jpeg(tmp_path / f"{k:02d}.jpg") for k in range(count)]
    for k, path in enumerate(files):
        path.write_bytes(path.read_bytes() + bytes(1000 * k))
    return files


def test_many_files_need_two_calls_for_each_32_and_come_in_their_order(tmp_path, installed):
    installed()
    files = several(tmp_path, 40)[::-1]
    found = list(read_dji_jpegs(files))
    assert [each.kelvin[-1, -1] for each in found] == [path.stat().st_size // 1000 for path in files]
    assert [call for call in calls(tmp_path) if call != "--version"] == ["list", "process"] * 2


def test_a_file_among_others_that_the_program_refuses_is_named(tmp_path, installed):
    installed(refuses="000001.jpg")
    files = several(tmp_path, 3)
    with pytest.raises(ThermorenderError, match=r"01\.jpg is a radiometric JPEG .*it says .*no usable range\] 000001"):
        list(read_dji_jpegs(files))
    installed()
    files[2].write_bytes(b"")
    with pytest.raises(ThermorenderError, match=r"02\.jpg .*: it does not list the file"):
        list(read_dji_jpegs(files))


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({"refuses": "all"}, "it says .*no usable range"),
        ({"refuses": "crash"}, "it says 'Traceback: something broke'"),
        ({"listed": "no list"}, "its list of settings cannot be read"),
        ({"listed": "[{}]"}, "its list of settings cannot be read"),
        ({"listed": "[1, 2]"}, "its list of settings cannot be read"),
        ({"settings": {}}, "its list of settings cannot be read"),
        ({"settings": thermal({**STORED, "distance": "far"})}, "its list of settings cannot be read"),
        ({"settings": thermal({**STORED, "distance": 1e999})}, "its (settings are not finite|list of settings cannot)"),
        ({"settings": thermal({"humidity": 50.0})}, "it states no distance or no temperature"),
        ({"kind": "int16"}, "it wrote int16 in place of kelvin"),
    ],
)
def test_a_program_that_fails_is_named_with_what_it_says(picture, installed, about, words):
    installed(**about)
    with pytest.raises(ThermorenderError, match=f"DJI_0001.JPG is a radiometric JPEG of DJI that .* {words}"):
        list(read_dji_jpegs([picture]))


def test_a_program_that_takes_too_long_is_ended(picture, installed, monkeypatch):
    installed()
    monkeypatch.setattr(dji_jpeg, "_LIMIT_S", 1e-3)
    with pytest.raises(ThermorenderError, match=r"it took more than 0\.001 s"):
        list(read_dji_jpegs([picture]))


def test_where_links_cannot_be_made_the_files_are_copied(picture, installed, monkeypatch):
    installed()

    def refused(*_):
        raise OSError("no right to make links")

    monkeypatch.setattr(Path, "symlink_to", refused)
    assert len(list(read_dji_jpegs([picture]))) == 1


def test_without_the_program_every_reader_says_how_to_get_it(picture, installed):
    for reader in (lambda path: list(read_dji_jpegs([path])), read_thermal_image, pictures.read_thermal):
        with pytest.raises(ThermorenderError, match=r"pipx install dji-thermal-cli.*dji_irp -s IN.JPG -a measure"):
            reader(picture)


def test_registry_and_training_pictures_read_it_before_any_correction(picture, installed):
    installed()
    (found,) = read_dji_jpegs([picture])
    (image,) = thermal_images(thermal_frames([picture]), correction="surface and air")
    np.testing.assert_array_equal(image.kelvin, found.kelvin)
    assert (image.corrected, image.settings, image.air_c) == ("nothing", None, 21.5)
    assert pictures.read_thermal(picture).unit == "kelvin"
    with pytest.raises(ThermorenderError, match="contains its calibration; leave out the scale"):
        read_thermal_image(picture, (0.04, 0.0))


POSES = "frame,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\na,0,0,40,0,-90,0\n"


@pytest.mark.parametrize("air", ["weather", "atmosphere", "file"])
def test_frames_of_a_survey_are_read_with_the_air_of_the_scene_and_say_so(tmp_path, installed, air):
    installed()
    folder = tmp_path / "frames"
    folder.mkdir()
    write_dji_jpeg(folder / "a.jpg")
    (tmp_path / "p.csv").write_text(POSES)
    expected = {"weather": 22.2876, "atmosphere": 294.2 - 273.15 - 4.5 * 0.112, "file": 21.5}[air]
    scene = tr.load_scene("heath/survey")
    if air != "weather":
        shutil.copytree(ROOT / "scenes" / "heath" / "survey", tmp_path / "dry")
        text = (tmp_path / "dry" / "scene.toml").read_text()
        text = re.sub(r"\[weather\].*?(?=\n\[)", "", text, flags=re.DOTALL)
        (tmp_path / "dry" / "scene.toml").write_text(text)
        scene = tr.load_scene(tmp_path / "dry")
        scene = scene.with_air("midlatitude-summer") if air == "atmosphere" else scene
    survey = read_frames(frame_files([folder]), read_poses(tmp_path / "p.csv"), scene)
    assert survey.air_removed == (False,)
    assert (survey.kelvin[0, 2:-1] == 300.0).all() and np.isnan(survey.kelvin[0, 0, :4]).all()
    read, moved = (each for each in survey.notes if "reading" in each or "DJI" in each)
    assert read.startswith("1 radiometric JPEGs of DJI were read by dji-thermal-cli 1.4.0, as a blackbody at 1 m")
    stated = float(re.search(r"reflected and air (\S+) °C", read)[1])
    # The standard atmosphere has 294.2 K at sea level and 289.7 K at 1 km; the scene is at 112 m.
    assert stated == pytest.approx(expected, abs=0.05)
    whose = "the files' own" if air == "file" else "that of the scene"
    assert f"in these readings is {whose}; another moves all of them by kelvins" in moved
