"""DJI's radiometric JPEGs through the program that reads them: its settings, its faults, and what callers make of it.

A stand-in for the program writes the settings that it was given as temperatures. The program itself was compared with
DJI's own library: `docs/reference/checks.md`.
"""

import json
import sys

import numpy as np
import pytest
from support import write_dji_jpeg

import thermorender as tr
from thermorender.apps.survey.inverse.frames import frame_files, read_frames
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.training import pictures
from thermorender.errors import ThermorenderError
from thermorender.sensor import dji_jpeg
from thermorender.sensor.dji_jpeg import is_dji_jpeg, read_dji_jpeg
from thermorender.sensor.flir_jpeg import read_flir_jpeg
from thermorender.sensor.radiometric_files import read_temperature
from thermorender.sensor.radiometry import ThermographySettings

STORED = {"distance": 5.0, "humidity": 50.0, "emissivity": 0.95, "reflection": 25.0, "ambient_temp": 21.5}
RANGES = {"distance": [1.0, 25.0], "ambient_temp": None}
# Its first pixels are emissivity, distance, reflected and air temperature as given, then no data; the rest is 300 K.
PROGRAM = """#!{python}
import json, pathlib, sys
about = json.loads(pathlib.Path(__file__).with_name("about.json").read_text())
given = dict(part[2:].split("=", 1) for part in sys.argv if part.startswith("--") and "=" in part)
if sys.argv[1] == "--version":
    print("dji-thermal-cli 1.4.0")
elif sys.argv[1] == "list":
    print(about["list"])
elif about["refuses"] == given["distance"] or about["refuses"] == "all":
    print("[skip, refused: dirp: no usable range] IN.JPG")
elif about["refuses"] == "crash":
    sys.exit("Traceback: something broke")
else:
    import numpy as np
    import warnings
    warnings.simplefilter("ignore")
    import rasterio
    values = np.full((32, 40), 300.0, about["kind"])
    names = "emissivity", "distance", "reflected-temp", "ambient-temp"
    values[0, :4] = [float(given.get(name, "0")) for name in names]
    values[1, 0] = 0.0
    path = pathlib.Path(given["output-dir"]) / (pathlib.Path(given["input-dir"]).stem + "_temp_k.tiff")
    with rasterio.open(path, "w", driver="GTiff", width=40, height=32, count=1, dtype=about["kind"]) as file:
        file.write(values, 1)
"""


def listed(stored=STORED, ranges=RANGES):
    return json.dumps([{"thermal": {"measurement_params": stored, "measurement_params_range": ranges}}])


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Put a stand-in for the program on the search path, which behaves as the given `about` says."""
    folder = tmp_path / "bin"
    folder.mkdir()

    def install(refuses="", text=None, kind="float32"):
        program = folder / dji_jpeg.PROGRAM
        program.write_text(PROGRAM.format(python=sys.executable))
        program.chmod(0o755)
        about = {"refuses": refuses, "list": listed() if text is None else text, "kind": kind}
        (folder / "about.json").write_text(json.dumps(about))

    monkeypatch.setenv("PATH", str(folder))
    return install


@pytest.fixture
def picture(tmp_path):
    return write_dji_jpeg(tmp_path / "--input-dir=x DJI_0001.JPG")


def test_a_file_is_read_as_a_blackbody_at_the_least_distance_with_the_air_of_the_file(picture, installed):
    installed()
    found = read_dji_jpeg(picture)
    assert list(found.kelvin[0, :4]) == [1.0, 1.0, 21.5, 21.5]
    assert np.isnan(found.kelvin[1, 0]) and (found.kelvin[2:] == 300.0).all()
    assert found.words == ("dji-thermal-cli 1.4.0, as a blackbody at 1 m, reflected and air 21.5 °C, humidity 50 %")


def test_a_camera_without_an_air_temperature_has_its_reflected_one(picture, installed):
    installed(text=listed({**STORED, "ambient_temp": None}))
    found = read_dji_jpeg(picture)
    # The program was given no temperature of the air: a 0, which is no data.
    assert found.kelvin[0, 2] == found.reflected_c == 25.0 and np.isnan(found.kelvin[0, 3])


def test_a_file_whose_calibration_begins_at_its_own_distance_is_read_at_that(picture, installed):
    installed(refuses="1.0")
    found = read_dji_jpeg(picture)
    assert found.distance_m == found.kelvin[0, 1] == 5.0


@pytest.mark.parametrize(
    ("about", "words"),
    [
        ({"refuses": "all"}, "it says .*no usable range"),
        ({"refuses": "crash"}, "it says 'Traceback: something broke'"),
        ({"text": "no list"}, "its list of settings cannot be read"),
        ({"text": "[{}]"}, "its list of settings cannot be read"),
        ({"text": "[1, 2]"}, "its list of settings cannot be read"),
        ({"text": listed({**STORED, "distance": "far"})}, "its list of settings cannot be read"),
        ({"text": listed().replace("5.0", "1e999")}, "its (settings are not finite|list of settings cannot be read)"),
        ({"text": listed({"humidity": 50.0})}, "it states no distance or no temperature"),
        ({"kind": "int16"}, "it wrote int16 in place of kelvin"),
    ],
)
def test_a_program_that_fails_is_named_with_what_it_says(picture, installed, about, words):
    installed(**about)
    with pytest.raises(ThermorenderError, match=f"DJI_0001.JPG is a radiometric JPEG of DJI that .* {words}"):
        read_dji_jpeg(picture)


def test_a_program_that_takes_too_long_is_ended(picture, installed, monkeypatch):
    installed()
    monkeypatch.setattr(dji_jpeg, "_LIMIT_S", 1e-3)
    with pytest.raises(ThermorenderError, match=r"it took more than 0\.001 s"):
        read_dji_jpeg(picture)


def test_without_the_program_every_reader_says_how_to_get_it(picture, installed):
    for reader in (read_dji_jpeg, read_temperature, pictures.read_thermal):
        with pytest.raises(ThermorenderError, match=r"pipx install dji-thermal-cli.*dji_irp -s IN.JPG -a measure"):
            reader(picture)
    with pytest.raises(ThermorenderError, match="is a radiometric JPEG of DJI, not of FLIR"):
        read_flir_jpeg(picture)


def test_readers_of_temperatures_and_of_training_pictures_read_it(picture, installed):
    installed()
    np.testing.assert_array_equal(read_temperature(picture), read_dji_jpeg(picture).kelvin)
    assert pictures.read_thermal(picture).unit == "kelvin"
    with pytest.raises(ThermorenderError, match="leave out the settings of thermography"):
        read_temperature(picture, None, ThermographySettings())
    with pytest.raises(ThermorenderError, match="contains its calibration; leave out the scale"):
        read_temperature(picture, (0.04, 0.0))


def test_other_files_are_not_of_dji(tmp_path):
    assert not is_dji_jpeg(tmp_path / "missing.jpg") and not is_dji_jpeg(tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8")
    assert not is_dji_jpeg(tmp_path / "a.jpg")


def test_frames_of_a_survey_are_read_with_their_air_and_say_how(tmp_path, installed):
    installed()
    folder = tmp_path / "frames"
    folder.mkdir()
    write_dji_jpeg(folder / "a.jpg")
    (tmp_path / "p.csv").write_text(
        "frame,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\na,0,0,40,0,-90,0\n"
    )
    scene = tr.load_scene("heath/survey")
    survey = read_frames(frame_files([folder]), read_poses(tmp_path / "p.csv", scene), scene)
    assert survey.air_removed == (False,)
    assert (survey.kelvin[0, 2:] == 300.0).all() and np.isnan(survey.kelvin[0, 0, :4]).all()
    (note,) = [each for each in survey.notes if "DJI" in each]
    assert note.startswith("1 radiometric JPEGs of DJI were read by dji-thermal-cli 1.4.0, as a blackbody at 1 m")
