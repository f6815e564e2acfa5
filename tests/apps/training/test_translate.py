"""Pictures and videos translated by learned maps: counts, file types, damaged files, continued runs."""

import json
import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from thermorender.apps.training import translate as module
from thermorender.apps.training.translate import Translation, read_picture, translate
from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import MODELS, Inputs, TemperatureMap, save_map
from thermorender.physics.planck import brightness_temperature
from thermorender.sensor.radiometric_files import read_temperature

ONE, NINE = MODELS["fok-1to1"], MODELS["fok-9to1"]


def photograph(height=40, width=50, seed=0):
    """A smooth coloured picture, (h, w, 3) uint8."""
    import cv2

    coarse = np.random.default_rng(seed).integers(40, 200, (5, 6, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)


def write(path, rgb):
    from PIL import Image

    Image.fromarray(rgb).save(path)
    return path


def shown(path):
    import cv2

    return cv2.imread(str(path), cv2.IMREAD_UNCHANGED)


@pytest.mark.parametrize("texel_m", [None, 0.07, 0.157, 0.4])
@pytest.mark.parametrize("model", [ONE, NINE], ids=lambda model: model.name)
def test_counts_are_the_nearest_of_the_exact_temperature_also_in_strips(model, texel_m, monkeypatch):
    rgb = photograph()
    exact = brightness_temperature(model.radiance(Inputs(rgb, texel_m)), *model.band_um)
    expected = np.rint(np.nan_to_num(exact) / 0.04)
    assert np.array_equal(Translation(model, texel_m).counts(rgb), expected)
    monkeypatch.setattr(module, "_STRIP", 50)
    assert np.array_equal(Translation(model, texel_m).counts(rgb), expected)


def test_a_picture_becomes_kelvin_and_a_preview_on_the_maps_scale(tmp_path):
    rgb = photograph()
    summary = translate(ONE, [write(tmp_path / "a.png", rgb)], tmp_path / "out")
    assert summary == {"done": 1, "passed over": 0, "failed": {}, "warnings": []}
    kelvin = read_temperature(tmp_path / "out" / "a.tif")
    intensity = rgb / 255.0 @ np.array([1.750, 0.236, -1.033])
    exact = brightness_temperature(ONE.radiance(Inputs(rgb)), 7.5, 13.5)
    assert np.abs(kelvin - exact).max() <= 0.02 + 1e-9
    grey = shown(tmp_path / "out" / "a.png")
    # 14 and 24 °C are black and white, whatever else the picture contains.
    assert np.abs(grey - np.clip((exact - 287.15) / 10.0, 0.0, 1.0) * 255.0).max() <= 1.1
    line = json.loads((tmp_path / "out" / "translated.jsonl").read_text())
    assert line["share_outside_0_1"] == pytest.approx(np.mean((intensity < 0) | (intensity > 1)), abs=0.005)
    record = json.loads((tmp_path / "out" / "translate.json").read_text())
    assert record["model"]["name"] == "fok-1to1" and record["kelvin_per_count"] == 0.04
    assert "numpy" in record["versions"]


# --- file types -------------------------------------------------------------------------------------------------


def test_all_picture_types_are_converted_to_rgb(tmp_path):
    from PIL import Image

    rgb = photograph()
    image = Image.fromarray(rgb)

    def same(name, kind, expected=rgb, most=0, **options):
        kind.save(tmp_path / name, **options)
        found, known = read_picture(tmp_path / name)
        assert found.shape == expected.shape and found.dtype == np.uint8 and known is None
        assert np.abs(found.astype(int) - expected).max() <= most, name

    same("rgb.tif", image)
    same("rgb.bmp", image)
    same("cmyk.tif", image.convert("CMYK"), most=1)
    same("cmyk.jpg", image.convert("CMYK"), most=12, quality=98)
    grey = np.asarray(image.convert("L"))
    same("grey.png", Image.fromarray(grey), np.repeat(grey[..., None], 3, -1))
    palette = image.quantize(16)
    same("palette.png", palette, np.asarray(palette.convert("RGB")))
    # Two pictures in one file, as drones write them.
    same("two.jpg", image, most=12, format="MPO", save_all=True, append_images=[image.rotate(90)], quality=98)
    exif = Image.Exif()
    exif[0x0112] = 6  # to be rotated by a quarter turn to the right
    same("turned.png", image, np.rot90(rgb, -1), exif=exif)


def test_16_bit_colour_is_scaled_and_16_bit_grey_refused(tmp_path):
    import cv2

    deep = photograph().astype(np.uint16) * 257
    for name in ("deep.png", "deep.tif"):
        cv2.imwrite(str(tmp_path / name), deep[..., ::-1])
        assert np.array_equal(read_picture(tmp_path / name)[0], photograph())
    for name in ("grey.png", "grey.tif"):
        cv2.imwrite(str(tmp_path / name), deep[..., 0])
        with pytest.raises(ThermorenderError, match=r"is grey in 16 bits or more .*; give the photograph"):
            read_picture(tmp_path / name)


def test_transparent_pixels_have_no_temperature(tmp_path):
    rgb = photograph()
    alpha = np.full(rgb.shape[:2], 255, np.uint8)
    alpha[:7] = 0
    translate(ONE, [write(tmp_path / "a.png", np.dstack([rgb, alpha]))], tmp_path / "out")
    kelvin = read_temperature(tmp_path / "out" / "a.tif")
    assert np.isnan(kelvin[:7]).all() and (kelvin[7:] > 200.0).all()


def test_a_map_without_a_temperature_for_any_pixel_is_named(tmp_path):
    class Nowhere:
        needs, above_air = (), False

        def predict(self, inputs, texel_m):
            return np.full(inputs.rgb.shape[:2], np.nan)

        def header(self):
            return {}

        arrays = header

    write(tmp_path / "a.png", photograph())
    made = translate(replace(NINE, predictor=Nowhere()), [tmp_path / "a.png"], tmp_path / "out")
    assert made["failed"] and "gets no temperature anywhere" in str(made["failed"])
    assert not list((tmp_path / "out").glob("a*"))


def test_more_pixels_than_pillow_takes_are_refused(tmp_path, monkeypatch):
    from PIL import Image

    path = write(tmp_path / "a.png", photograph())
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 900)
    with pytest.raises(ThermorenderError, match="has more than 0 million pixels; cut it into pieces"):
        read_picture(path)


# --- videos -----------------------------------------------------------------------------------------------------


def video(path, frames=12, height=48, width=64):
    import cv2

    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (width, height))
    for k in range(frames):
        writer.write(np.roll(photograph(height, width), k, axis=1)[..., ::-1].copy())
    writer.release()
    return path


@pytest.mark.parametrize("suffix", [".avi", ".mp4"])
def test_a_video_becomes_a_video_with_its_frames(suffix, tmp_path):
    import cv2

    path = video(tmp_path / "flight.avi")
    path = path.rename(path.with_suffix(suffix))  # the content counts, not the name
    summary = translate(ONE, [path], tmp_path / "out", palette="ironbow", frames=True)
    assert summary["done"] == 1 and not summary["failed"]
    found = sorted((tmp_path / "out" / "flight_frames").iterdir())
    assert [each.name for each in found[:3]] == ["000000.png", "000000.tif", "000001.png"] and len(found) == 24
    kelvin = read_temperature(tmp_path / "out" / "flight_frames" / "000011.tif")
    exact = brightness_temperature(ONE.radiance(Inputs(np.roll(photograph(48, 64), 11, axis=1))), 7.5, 13.5)
    # The source is compressed.
    assert np.abs(kelvin - exact).mean() < 0.5
    reader = cv2.VideoCapture(str(tmp_path / "out" / f"flight{suffix}"))
    read = [reader.read() for _ in range(13)]
    assert [whole for whole, _ in read] == [True] * 12 + [False] and reader.get(cv2.CAP_PROP_FPS) == 10.0
    last = shown(tmp_path / "out" / "flight_frames" / "000011.png").astype(int)
    assert np.abs(read[11][1].astype(int) - last).mean() < 12


def test_truncated_videos_leave_no_output(tmp_path):
    path = video(tmp_path / "cut.avi", frames=30)
    data = bytearray(path.read_bytes())
    # Frames from the middle on are missing, but the header still lists them.
    path.write_bytes(data[: len(data) // 2])
    empty = tmp_path / "empty.mp4"
    empty.write_bytes(b"")
    summary = translate(ONE, [path, empty], tmp_path / "out", frames=True)
    assert "empty.mp4 cannot be read as a video" in summary["failed"][empty]
    assert "cut.avi" in summary["failed"][path] and summary["done"] == 0
    assert sorted(each.name for each in (tmp_path / "out").iterdir()) == ["translate.json"]


@pytest.mark.skipif(sys.platform != "linux", reason="makes a name of bytes")
def test_a_video_whose_name_is_not_unicode_is_reported(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff.avi")
    video(tmp_path / "a.avi", frames=2).rename(path)
    summary = translate(ONE, [path], tmp_path / "out")
    assert summary["failed"][path].endswith(r"\udcff.avi' is not valid Unicode; rename the video")


# --- many files -------------------------------------------------------------------------------------------------


def test_a_damaged_file_is_named_and_the_others_are_translated(tmp_path, call):
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("a.jpg", "b.jpg", "c.jpg", "d.png"):
        write(folder / name, photograph(seed=ord(name[0])))
    (folder / "b.jpg").write_bytes((folder / "b.jpg").read_bytes()[:600])
    (folder / "d.png").write_bytes(b"no picture")
    (folder / "notes.txt").write_text("not asked for")
    status, output, errors = call("translate", "fok-1to1", folder, "-o", tmp_path / "out")
    assert status == 2 and "2 translated, 2 failed, in " in output
    first, second = errors.strip().splitlines()
    assert "b.jpg cannot be read as a picture" in first and "d.png cannot be read as a picture" in second
    names = {each.name for each in (tmp_path / "out").iterdir()}
    assert names == {"a.tif", "a.png", "c.tif", "c.png", "translate.json", "translated.jsonl"}
    # Repaired and continued: the others are not touched, even after an interruption in the middle of a line.
    before = (tmp_path / "out" / "a.tif").stat().st_mtime_ns
    write(folder / "b.jpg", photograph(seed=9))
    (folder / "d.png").unlink()
    with open(tmp_path / "out" / "translated.jsonl", "a") as file:
        file.write('{"source": "x')
    status, output, errors = call("translate", "fok-1to1", folder, "-o", tmp_path / "out", "--resume")
    assert (status, errors) == (0, "") and "1 translated, 2 done before, in " in output
    assert (tmp_path / "out" / "a.tif").stat().st_mtime_ns == before
    assert len((tmp_path / "out" / "translated.jsonl").read_text().splitlines()) == 3


def test_files_of_a_killed_process_are_removed_and_a_changed_picture_is_translated_again(tmp_path, call):
    # Pictures with equal file sizes.
    path, other = write(tmp_path / "a.bmp", photograph()), photograph(seed=9)
    assert call("translate", "fok-1to1", path, "-o", tmp_path / "out")[0] == 0
    (tmp_path / "out" / ".clip.0123abcd.part.mp4").write_bytes(b"half")
    before = path.stat()
    write(path, other)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert path.stat().st_size == before.st_size
    status, output, _ = call("translate", "fok-1to1", path, "-o", tmp_path / "out", "--resume")
    assert status == 0 and output.startswith("1 translated, in ")
    assert np.array_equal(shown(tmp_path / "out" / "a.tif"), Translation(ONE).counts(other))
    names = {each.name for each in (tmp_path / "out").iterdir()}
    assert names == {"a.tif", "a.png", "translate.json", "translated.jsonl"}


def test_a_map_changed_between_runs_is_refused(tmp_path, call):
    path = write(tmp_path / "a.png", photograph())
    save_map(ONE, tmp_path / "map.npz")
    assert call("translate", tmp_path / "map.npz", path, "-o", tmp_path / "out")[0] == 0
    assert np.array_equal(shown(tmp_path / "out" / "a.tif"), Translation(ONE).counts(photograph()))
    save_map(replace(NINE, name=ONE.name, method=ONE.method), tmp_path / "map.npz")
    status, _, errors = call("translate", tmp_path / "map.npz", path, "-o", tmp_path / "out", "--resume")
    assert status == 2 and "translate.json was made with another model" in errors


def test_another_range_and_texel_give_a_warning(tmp_path, call):
    path = write(tmp_path / "a.png", photograph())
    status, _, errors = call(
        "translate", "fok-9to1", path, "-o", tmp_path / "out", "--texel-m", "0.5", "--range-c", "0,40"
    )
    assert status == 0 and errors.startswith("warning: learned map 'fok-9to1' was trained at 0.0785–0.157 m a pixel")
    exact = brightness_temperature(NINE.ranged((0.0, 40.0)).radiance(Inputs(photograph(), 0.5)), 7.5, 13.5)
    assert np.abs(read_temperature(tmp_path / "out" / "a.tif") - exact).max() <= 0.02 + 1e-9
    status, _, errors = call(
        "translate", "fok-9to1", path, "-o", tmp_path / "out", "--texel-m", "0.1", "--range-c", "0,40", "--resume"
    )
    assert status == 2 and "translate.json was made with another texel_m; continue with the same settings" in errors


class _Warm:
    """A predictor that requires the weather."""

    needs, above_air = ("conditions",), True


class _Plain:
    """A predictor that treats each pixel separately."""

    needs, above_air = (), False


def test_refusals(tmp_path):
    path = write(tmp_path / "a.png", photograph())

    def refused(words, *arguments, model=ONE, **options):
        with pytest.raises(ThermorenderError, match=words):
            translate(model, *arguments, **options)
        assert not (tmp_path / "out").exists()

    out = tmp_path / "out"
    warm = TemperatureMap("warm", "trees+", _Warm(), (280.0, 300.0), (7.5, 13.5), 0.1, (0.1, 0.2), "", 255.0, "")
    refused("'warm' needs hour and weather, which a picture alone does not have", [path], out, model=warm)
    refused("texel_m=50 is too far from the 0.157 m", [path], out, texel_m=50.0)
    refused("texel_m=nan is too far", [path], out, texel_m=float("nan"))
    refused("palette 'rainbow' is unknown", [path], out, palette="rainbow")
    refused("b.png does not exist", [tmp_path / "b.png"], out)
    (tmp_path / "empty").mkdir()
    refused("empty holds no picture or video", [tmp_path / "empty"], out)
    (tmp_path / "a.doc").write_text("")
    refused("a.doc is of unknown kind; give one of .jpg", [tmp_path / "a.doc"], out)
    other = write(tmp_path / "empty" / "a.jpg", photograph())
    refused("a.png and .*a.jpg would both be written as a.tif", [path, other], out)
    refused("a.png exists; give another folder", [path], tmp_path)
    refused("a.png exists; give another folder", [path], tmp_path, resume=True)


def test_pixels_without_a_temperature_are_marked_as_no_data(tmp_path):
    """Equation 3 is negative on saturated blue: NaN for readers, and part of the share outside."""
    rgb = photograph()
    rgb[:20] = (0, 0, 255)
    model = replace(ONE, range_k=(200.0, 320.0))
    summary = translate(model, [write(tmp_path / "a.png", rgb)], tmp_path / "out")
    kelvin = read_temperature(tmp_path / "out" / "a.tif")
    assert np.isnan(kelvin[:20]).all() and np.nanmin(kelvin) > 0.0
    line = json.loads((tmp_path / "out" / "translated.jsonl").read_text())
    assert line["share_extrapolated"] >= np.isnan(kelvin).mean() >= 0.5
    assert "pixels without a temperature are 0" in summary["warnings"][0]
