"""Thermography: the camera's formula, its corrections, and files of temperature that thermography software reads."""

import io
import json
import struct
import warnings
from dataclasses import replace

import numpy as np
import pytest
from support import shared_data

from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import load_camera
from thermorender.sensor.flir_jpeg import read_flir_jpeg
from thermorender.sensor.radiometric_files import read_temperature, write_tlinear
from thermorender.sensor.radiometry import (
    AirModel,
    PlanckConstants,
    ThermographySettings,
    camera_constants,
    fitted_constants,
    thermography_temperature,
    water_vapour,
)
from thermorender.sensor.thermal_files import read_thermal_image

CAMERA = load_camera("zenmuse-xt2")
# A FLIR SC660, the default of many programs, and a DJI Zenmuse XT.
SC660 = PlanckConstants(r1=21106.77, b=1501.0, f=1.0, o=-7340.0, r2=0.012545258)
XT = PlanckConstants(r1=17096.453, b=1428.0, f=1.0, o=-342.0, r2=0.046642166)


@pytest.mark.parametrize("planck", [SC660, XT])
def test_formula_is_its_own_inverse(planck):
    temperature = np.linspace(230.0, 420.0, 96).reshape(8, 12)
    np.testing.assert_allclose(planck.temperature(planck.signal(temperature)), temperature, rtol=1e-12)
    assert np.isnan(planck.temperature(-planck.o - 1.0)) and np.isnan(planck.temperature([np.nan]))[0]


def test_fit_of_the_flat_band():
    # The best fit of the four constants to 7.5–13.5 µm is off by 72 mK over 233–423 K.
    temperature = np.linspace(233.15, 423.15, 1901)
    radiance = band_radiance(temperature, 7.5, 13.5)
    error = fitted_constants((7.5, 13.5), 233.15, 423.15).temperature(radiance) - temperature
    assert np.abs(error).max() < 0.0725
    inside = (temperature > 248.15) & (temperature < 408.15)
    error = camera_constants(CAMERA).temperature(radiance[inside]) - temperature[inside]
    assert np.abs(error).max() < 0.0345


def test_constants_resemble_those_of_a_real_camera():
    # B of a Zenmuse XT, which has the same core as the XT2: 1428 K.
    assert camera_constants(CAMERA).b == pytest.approx(XT.b, rel=0.01)


def test_saturated_vapour_against_the_steam_tables():
    # g m⁻³, from IAPWS saturation pressure: p / (461.5 T).
    for celsius, density in ((0, 4.85), (10, 9.40), (20, 17.29), (30, 30.36), (40, 51.1)):
        assert water_vapour(celsius, 1.0) == pytest.approx(density, rel=0.03)
        assert water_vapour(celsius, 0.25) == pytest.approx(0.25 * water_vapour(celsius, 1.0))


def test_air_model():
    air = AirModel()
    # Dry air: ω = 0 leaves X exp(−α₁√d) + (1−X) exp(−α₂√d); at 100 m by hand 1.9·0.93642 − 0.9·0.88144.
    assert air.transmittance(20.0, 0.0, 100.0) == pytest.approx(0.98590, abs=2e-5)
    assert air.transmittance(20.0, 0.5, 0.0) == 1.0
    damp = [air.transmittance(30.0, humidity, 200.0) for humidity in (0.0, 0.3, 0.6, 0.9)]
    assert np.diff(damp).max() < 0.0
    assert np.diff([air.transmittance(15.0, 0.5, d) for d in (1.0, 10.0, 100.0, 1000.0)]).max() < 0.0


def test_settings_without_attenuation_change_nothing():
    signal = camera_constants(CAMERA).signal(np.linspace(250.0, 400.0, 50))
    np.testing.assert_allclose(
        thermography_temperature(signal, camera_constants(CAMERA), ThermographySettings()),
        np.linspace(250.0, 400.0, 50),
        rtol=1e-12,
    )


@pytest.mark.parametrize("planck", [SC660, XT, camera_constants(CAMERA)])
def test_true_settings_give_the_true_temperature(planck):
    # A grey surface seen through air and a window; the signal is summed by hand.
    settings = ThermographySettings(
        emissivity=0.8, reflected_c=-30.0, air_c=12.0, humidity=0.7, distance_m=120.0, window_c=25.0,
        window_transmittance=0.9,
    )  # fmt: skip
    surface = np.linspace(270.0, 340.0, 8)
    tau = AirModel().transmittance(12.0, 0.7, 120.0)
    leaving = 0.8 * planck.signal(surface) + 0.2 * planck.signal(243.15)
    signal = 0.9 * (tau * leaving + (1 - tau) * planck.signal(285.15)) + 0.1 * planck.signal(298.15)
    np.testing.assert_allclose(thermography_temperature(signal, planck, settings), surface, rtol=1e-11)


def test_errors_of_a_wrong_setting_in_kelvin():
    # A surface of 300 K, ε = 0.95 under a sky of 250 K, read with ε = 1: independent of the formula, by Planck's law.
    radiance = 0.95 * band_radiance(300.0, 7.5, 13.5) + 0.05 * band_radiance(250.0, 7.5, 13.5)
    seen = brightness_temperature(radiance, 7.5, 13.5)
    planck = camera_constants(CAMERA)
    assert thermography_temperature(radiance, planck, ThermographySettings()) == pytest.approx(seen, abs=0.035)
    right = ThermographySettings(emissivity=0.95, reflected_c=250.0 - 273.15)
    assert thermography_temperature(radiance, planck, right) == pytest.approx(300.0, abs=0.05)
    assert 300.0 - seen > 1.5


def test_settings_are_read_from_text():
    read = ThermographySettings.parse("emissivity=0.95, air_c=-5,distance_m=1e2")
    assert read == ThermographySettings(0.95, air_c=-5.0, distance_m=100.0)
    for text, words in (
        ("emisivity=0.9", "thermography: unknown key 'emisivity'; did you mean 'emissivity'"),
        ("emissivity=1.2", "emissivity=1.2 is not allowed; give a number 0.001…1"),
        ("emissivity=nan", "emissivity=nan is not allowed; give a number 0.001…1"),
        ("humidity=50", "humidity=50.0 is not allowed; give a number 0…1"),
        ("air_c=warm", "air_c='warm' is not allowed; give a number -100…100 °C"),
        ("air_c=1,air_c=2", "'air_c' is given twice"),
        ("distance_m", "distance_m='' is not allowed; give a number 0…1e.06 m"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            ThermographySettings.parse(text)
    with pytest.raises(ThermorenderError, match=r"distance_m=1e.06 leaves"):
        thermography_temperature(1.0, SC660, ThermographySettings(distance_m=1e6))


def test_radiometric_tiff_is_read_by_common_tools(tmp_path):
    import cv2
    import rasterio
    from PIL import Image

    temperature = np.linspace(220.0, 500.0, 48 * 64).reshape(48, 64)
    temperature[0, 0] = np.nan
    write_tlinear(tmp_path / "a.tif", temperature)
    counts = np.where(np.isnan(temperature), 0, temperature / 0.04)
    with Image.open(tmp_path / "a.tif") as image:
        by_pil = np.asarray(image)
    by_cv2 = cv2.imread(str(tmp_path / "a.tif"), cv2.IMREAD_UNCHANGED)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(tmp_path / "a.tif") as file:
            by_rasterio, unit = file.read(1), file.units[0]
            assert (file.scales[0], file.offsets[0], unit) == (0.04, 0.0, "K")
    for read in (by_pil, by_cv2, by_rasterio):
        assert read.dtype == np.uint16 and np.abs(read - counts).max() <= 0.5 + 1e-9
    back = read_temperature(tmp_path / "a.tif")
    assert np.nanmax(np.abs(back - temperature)) <= 0.02 + 1e-9


def test_a_missing_scale_is_refused(tmp_path):
    from PIL import Image

    Image.fromarray(np.full((4, 4), 7500, np.uint16)).save(tmp_path / "a.tif")
    with pytest.raises(ThermorenderError, match="does not declare the unit of its counts; state kelvin per count"):
        read_temperature(tmp_path / "a.tif")
    assert read_temperature(tmp_path / "a.tif", (0.04, 0.0))[0, 0] == pytest.approx(300.0)
    assert read_temperature(tmp_path / "a.tif", (0.001, 273.15))[0, 0] == pytest.approx(280.65)
    Image.fromarray(np.zeros((4, 4, 3), np.uint8)).save(tmp_path / "b.tif")
    (tmp_path / "c.tif").write_bytes((tmp_path / "a.tif").read_bytes()[:60])
    for name, words in (
        ("b.tif", "has 3 bands"),
        ("c.tif", "cannot be read as TIFF"),
        ("d.tif", "does not exist"),
        ("e.npy", "unknown kind"),
    ):
        with pytest.raises(ThermorenderError, match=words):
            read_thermal_image(tmp_path / name, (0.04, 0.0))


def test_a_margin_of_zeros_in_degrees_celsius_is_no_data(tmp_path):
    import tifffile

    celsius = np.random.default_rng(3).uniform(12.0, 30.0, (40, 60))
    for name, step, kind in (("tenths", 0.1, np.uint16), ("floats", 1.0, np.float32)):
        for where, low, blank in (("margin", 0.0, True), ("winter", -20.0, False)):
            counts = ((celsius + low) / step).astype(np.int16 if low else kind)
            counts[:, 50:] = 0
            tifffile.imwrite(tmp_path / f"{name}{where}.tif", counts)
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always", ThermorenderWarning)
                found = read_temperature(tmp_path / f"{name}{where}.tif", (step, 273.15))
            assert np.isnan(found[:, 50:]).all() == blank and np.isfinite(found[:, :50]).all()
            assert np.abs(found[:, :50] - celsius[:, :50] - low - 273.15).max() <= max(step, 1e-4 if not low else 1.0)
            assert [str(one.message)[:34] for one in caught] == ["pixels of exactly 273.15 K, which "] * blank


@pytest.mark.parametrize("value", [-9999.0, 0.0, 50.0, 255.0, 655.35, 65535.0])
def test_a_margin_of_one_value_in_kelvin_is_no_data_with_a_note(tmp_path, value):
    import tifffile

    kelvin = np.random.default_rng(3).uniform(285.0, 300.0, (40, 60))
    kelvin[:, 50:] = value
    tifffile.imwrite(tmp_path / "a.tif", kelvin.astype(np.float32))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", ThermorenderWarning)
        found = read_temperature(tmp_path / "a.tif", (1.0, 0.0))
    # A sky of one temperature may be as cold as 255 K.
    kept = value == 255.0
    assert np.isnan(found[:, 50:]).all() == (not kept)
    assert [str(one.message).split(",")[0] for one in caught] == [f"pixels of exactly {value:g} K"] * (not kept)
    np.testing.assert_allclose(found[:, :50], kelvin[:, :50], rtol=1e-6)


def test_impossible_temperatures_are_no_data_with_a_note(tmp_path):
    """A margin that a resampling blended with the ground has no common value."""
    import tifffile

    kelvin = np.random.default_rng(3).uniform(285.0, 300.0, (40, 60))
    kelvin[:, 50:] = np.linspace(3.0, 99.0, 400).reshape(40, 10)
    kelvin[0, :2] = 2000.0, np.inf
    tifffile.imwrite(tmp_path / "a.tif", kelvin.astype(np.float32))
    with pytest.warns(ThermorenderWarning, match="pixels outside 100…1500 K are taken for no data"):
        found = read_temperature(tmp_path / "a.tif", (1.0, 0.0))
    assert np.isnan(found[:, 50:]).all() and np.isnan(found[0, :2]).all() and np.isfinite(found[1:, :50]).all()
    # Infinity is no temperature where a wrong scale makes all others impossible, either.
    assert not np.isinf(read_temperature(tmp_path / "a.tif", (100.0, 0.0))).any()


def test_a_unit_that_is_no_text_is_refused(tmp_path):
    write_tlinear(tmp_path / "a.tif", np.full((4, 4), 300.0))
    whole = (tmp_path / "a.tif").read_bytes()
    assert whole.count(b">K<") == 1
    (tmp_path / "a.tif").write_bytes(whole.replace(b">K<", b">\xc3<"))
    with pytest.raises(ThermorenderError, match="cannot be read as TIFF: 'utf-8' codec can't decode"):
        read_temperature(tmp_path / "a.tif")


def test_a_verb_without_scale_is_not_told_to_give_one(tmp_path):
    import tifffile

    tifffile.imwrite(tmp_path / "a.tif", np.arange(28000, 30400, dtype=np.uint16).reshape(40, 60))
    tifffile.imwrite(tmp_path / "b.tif", np.zeros((4, 4), np.uint8))
    edit = r"`gdal_edit.py -scale 0.01 -offset 0 -units K "
    with pytest.raises(ThermorenderError, match=f"counts; state kelvin per count .* in the file, .*{edit}"):
        read_temperature(tmp_path / "a.tif")
    with pytest.raises(
        ThermorenderError, match=f"counts, perhaps 0.01 K or 0.001 °C; declare it in the file, for .*{edit}"
    ):
        read_temperature(tmp_path / "a.tif", takes_scale=False)
    with pytest.raises(ThermorenderError, match=r"give the radiometric file$"):
        read_temperature(tmp_path / "b.tif", takes_scale=False)


# Ends of the colour scale that the cameras printed into the pictures themselves [°C], read by eye.
PRINTED = {
    "16 - Man_in_water_-_IR_image.jpg": (4.0, 10.8),
    "17 - Solar_halo_thermal.jpg": (-32.0, 0.0),
    "18 - Steam_Train_Valves_Thermal_Image.jpg": (34.1, 186.4),
    "22 - Thermogramme_infiltrométrie.jpg": (11.8, 17.2),
    "24 - Thermographie_photovoltaique.jpg": (-5.5, 12.6),
    "IR_2412.jpg": (22.9, 30.2),
}


@pytest.mark.parametrize("name", PRINTED)
def test_formula_and_settings_of_real_cameras_reproduce_the_printed_scale(name):
    """Only numbers from the files: constants, the thermography settings, raw values at the scale's ends."""
    stored = json.loads(shared_data("flir/settings.json").read_text(encoding="utf-8"))[name]
    kinds = {"planck": PlanckConstants, "thermography": ThermographySettings, "air": AirModel}
    settings = [kind(**stored[part]) for part, kind in kinds.items()]
    ends = thermography_temperature(np.array(stored["scale_raw"]), *settings)
    # Printed to 0.1 °C.
    np.testing.assert_allclose(ends - 273.15, PRINTED[name], atol=0.0501)


@pytest.mark.parametrize("name", PRINTED)
def test_readings_equal_those_the_camera_printed(name):
    picture = read_flir_jpeg(shared_data(f"pairs/flir_rjpeg_samples/{name}"))
    signal = np.array(picture.camera["scale_raw"])
    ends = thermography_temperature(signal, picture.planck, picture.thermography, picture.air)
    # Printed to 0.1 °C.
    np.testing.assert_allclose(ends - 273.15, PRINTED[name], atol=0.0501)


def test_printed_spot_and_mean():
    # "Punkt 21.1 °C" and "19.0 °F" at the middle, "Avg. 28.1" in a box whose corners are drawn at these pixels.
    folder = "pairs/flir_rjpeg_samples/"
    for name, printed in (("10 - IR_Fussbodenheizung.jpg", 21.1), ("05 - Aqua_Tower_thermal_image.jpg", -13.0 / 1.8)):
        celsius = read_thermal_image(shared_data(folder + name)).kelvin - 273.15
        rows, columns = (slice(n // 2 - 1, n // 2 + 1) for n in celsius.shape)
        assert np.abs(celsius[rows, columns] - printed).min() < 0.05
        assert np.abs(celsius[rows, columns] - printed).max() < 0.6
    celsius = read_thermal_image(shared_data(folder + "IR_2412.jpg")).kelvin - 273.15
    assert celsius[158:321, 211:427].mean() == pytest.approx(28.1, abs=0.05)


# Sum of the raw values, and those of the first and last pixel, as flyr 5.1.0 reads them.
FLYR = {
    "05 - Aqua_Tower_thermal_image.jpg": (408705676, 7045, 12854),
    "18 - Steam_Train_Valves_Thermal_Image.jpg": (3018619400, 7264, 8393),
    "23 - Thermographie_de_rue.jpg": (296900876, 15472, 15289),
    "26 - Windmill_Thermal_Image.jpg": (1348798052, 15829, 17139),
    "IR_2412.jpg": (5805881680, 18090, 18999),
    "QUEROB1_EINBRGB_BWWG4662.JPG": (2618035669, 8456, 8624),
}


@pytest.mark.parametrize("name", FLYR)
def test_raw_values_against_another_reader(name):
    raw = read_flir_jpeg(shared_data(f"pairs/flir_rjpeg_samples/{name}")).raw
    assert (int(raw.sum(dtype=np.int64)), int(raw[0, 0]), int(raw[-1, -1])) == FLYR[name]


@pytest.mark.parametrize("name", ["QUEROB1_EINBRGB_BWWG4662", "QUEROB1_EOUTTREERGB_HHYI3759"])
def test_temperatures_against_another_package(name):
    # Made by ThermalRaster (R) from the same files, for ε = 1 and no distance.
    import rasterio

    path = shared_data(f"pairs/flirone_trees/{name}_thermal_degC_eps1.tif")
    source = shared_data(f"pairs/flir_rjpeg_samples/{name}.JPG")
    ours = read_thermal_image(source, correction="nothing").kelvin - 273.15
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            np.testing.assert_allclose(ours, file.read(1), atol=1e-4)


def png(raw, order):
    """A 16-bit PNG of raw values; a little-endian camera stores them without swapping their bytes."""
    from PIL import Image

    memory = io.BytesIO()
    Image.fromarray(raw.byteswap() if order == "<" else raw).save(memory, "PNG")
    return memory.getvalue()


def fff(raw, order="<", size=None, records=2, pixels=None, pieces=1):
    """A radiometric JPEG written by hand: two records in one APP1 segment, or in several pieces in falling order."""
    height, width = size or raw.shape
    pixels = raw.astype(order + "u2").tobytes() if pixels is None else pixels
    picture = struct.pack(order + "HHH", 2, width, height).ljust(32, b"\0") + pixels
    block = bytearray(1100)
    struct.pack_into(order + "H", block, 0, 2)
    for offset, value in {
        0x20: 0.9, 0x24: 10.0, 0x28: 293.15, 0x2C: 283.15, 0x30: 293.15, 0x34: 1.0, 0x3C: 0.4, 0x58: SC660.r1,
        0x5C: SC660.b, 0x60: SC660.f, 0x70: 0.006569, 0x74: 0.01262, 0x78: -0.002276, 0x7C: -0.00667, 0x80: 1.9,
        0x90: 393.15, 0x94: 253.15, 0x30C: SC660.r2,
    }.items():  # fmt: skip
        struct.pack_into(order + "f", block, offset, value)
    struct.pack_into(order + "i", block, 0x308, int(SC660.o))
    head = b"FFF\0" + b"test".ljust(16, b"\0") + struct.pack(">III", 100, 64, records) + bytes(32)
    start = 64 + 32 * 2
    directory = b""
    for kind, body in ((1, picture), (0x20, bytes(block))):
        directory += struct.pack(">HHIIIIIII", kind, 2, 100, 0, start, len(body), 0, 0, 0).ljust(32, b"\0")
        start += len(body)
    whole, segments = head + directory + picture + bytes(block), b""
    size = -(-len(whole) // pieces)
    for k in reversed(range(pieces)):
        data = b"FLIR\0\x01" + bytes([k, pieces - 1]) + whole[k * size : (k + 1) * size]
        segments += b"\xff\xe1" + struct.pack(">H", len(data) + 2) + data
    return b"\xff\xd8" + segments + b"\xff\xd9"


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize("pieces", [1, 3])
@pytest.mark.parametrize("order", "<>")
def test_a_file_written_by_hand(order, pieces, compressed, tmp_path):
    raw = np.arange(17000, 17000 + 12 * 16, dtype=np.uint16).reshape(12, 16)
    pixels = png(raw, order) if compressed else None
    (tmp_path / "a.jpg").write_bytes(fff(raw, order, pixels=pixels, pieces=pieces))
    picture = read_flir_jpeg(tmp_path / "a.jpg")
    np.testing.assert_array_equal(picture.raw, raw)
    assert picture.thermography.emissivity == pytest.approx(0.9)
    assert picture.thermography.air_c == pytest.approx(10.0, abs=1e-4)
    np.testing.assert_allclose(picture.temperature(ThermographySettings()), SC660.temperature(raw), atol=1e-3)
    np.testing.assert_array_equal(read_thermal_image(tmp_path / "a.jpg").kelvin, picture.temperature())
    assert replace(picture.thermography, emissivity=1.0) != picture.thermography


def test_damaged_files_are_refused_in_one_sentence(tmp_path):
    whole = fff(np.full((12, 16), 17000, np.uint16))
    path = tmp_path / "a.jpg"
    rng = np.random.default_rng(1)
    refusals = []
    for k in range(400):
        data = bytearray(whole)
        if k % 2:
            del data[int(rng.integers(2, len(data))) :]
        else:
            for offset in rng.integers(0, 250, 3):
                data[offset] = int(rng.integers(0, 256))
        path.write_bytes(data)
        try:
            read_flir_jpeg(path)
        except ThermorenderError as error:
            refusals.append(str(error))
    assert len(refusals) > 200
    for message in refusals:
        assert message.startswith(f"{path} is not a whole FLIR radiometric JPEG: ")
        assert "\n" not in message
    raw = rng.integers(0, 1 << 16, (12, 16), dtype=np.uint16)
    for data, words in (
        (b"GIF89a", "it is not a JPEG"),
        (b"\xff\xd8\xff\xd9", "carries no FLIR data"),
        (fff(np.full((12, 16), 1, np.uint16), size=(4000, 4000)), "raw image has"),
        (fff(np.full((12, 16), 1, np.uint16), records=1), "holds no camera block"),
        (fff(raw, pixels=png(raw[:3, :4], ">")), "the PNG inside is 4×3"),
        (fff(raw, pixels=png(raw, ">")[:-60]), "the PNG inside cannot be read"),
        (fff(raw, pieces=3).replace(b"FLIR\0\x01\x01", b"XXXX\0\x01\x01"), "3 pieces of FLIR data and holds 2"),
    ):
        path.write_bytes(data)
        with pytest.raises(ThermorenderError, match=words):
            read_flir_jpeg(path)


def test_real_files_cut_short(tmp_path):
    source = shared_data("pairs/flir_rjpeg_samples/QUEROB1_EINBRGB_BWWG4662.JPG").read_bytes()
    rng = np.random.default_rng(2)
    for _ in range(25):
        data = bytearray(source)
        for offset in rng.integers(0, 400_000, 40):
            data[offset] ^= int(rng.integers(1, 256))
        (tmp_path / "a.jpg").write_bytes(data[: int(rng.integers(1000, len(data)))])
        with pytest.raises(ThermorenderError, match="not a whole FLIR radiometric JPEG"):
            read_flir_jpeg(tmp_path / "a.jpg")


def test_every_kind_of_camera_in_the_samples_is_read():
    # Plain, PNG with swapped bytes, big-endian PNG (07), an XT's container (thermal_only).
    folder = shared_data("pairs/flir_rjpeg_samples")
    files = sorted((*folder.glob("*.jp*g"), *folder.glob("*.JPG")))
    files.append(shared_data("pairs/thermal_only/eth_crops_xt/flight1/rjpeg/DJI_0003.jpg"))
    assert len(files) == 14
    for path in files:
        celsius = read_thermal_image(path).kelvin - 273.15
        assert np.isfinite(celsius).all() and -70 < celsius.min() < celsius.max() < 200, path.name
        # A wrong byte order turns neighbouring pixels into noise.
        assert np.median(np.abs(np.diff(celsius))) < 3.0, path.name
