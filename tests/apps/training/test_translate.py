"""Pictures and videos translated by learned maps: counts, file types, damaged files, continued runs."""

import json
import math
import os
import sys
from dataclasses import replace

import numpy as np
import pytest

from thermorender.apps.training import translate as module
from thermorender.apps.training.anchoring import anchor_of
from thermorender.apps.training.training_pictures import search_in_files
from thermorender.apps.training.translate import Translation, read_picture, translate
from thermorender.errors import ThermorenderError
from thermorender.learned.anchor import MapAnchor, anchored_to_known
from thermorender.learned.temperature_map import MODELS, Inputs, TemperatureMap, save_map
from thermorender.learned.training_level import TrainingLevel
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
    expected = np.rint(np.clip(exact, 287.15, 297.15) / 0.04)
    whole, facts = Translation(model, texel_m).translated(rgb)
    assert np.array_equal(whole, expected)
    monkeypatch.setattr(module, "_STRIP", 50)
    strips, again = Translation(model, texel_m).translated(rgb)
    assert np.array_equal(strips, expected) and again == facts


def test_a_picture_becomes_kelvin_and_a_preview_on_the_maps_scale(tmp_path):
    rgb = photograph()
    summary = translate(ONE, [write(tmp_path / "a.png", rgb)], tmp_path / "out")
    assert {**summary, "notes": []} == {"done": 1, "passed over": 0, "failed": {}, "notes": [], "warnings": []}
    assert summary["notes"] == ["the ground sampling distance of the pictures is not stated: the map's 0.157 m is "
                                "assumed"]  # fmt: skip
    kelvin = read_temperature(tmp_path / "out" / "a.tif")
    intensity = rgb / 255.0 @ np.array([1.750, 0.236, -1.033])
    exact = np.clip(brightness_temperature(ONE.radiance(Inputs(rgb)), 7.5, 13.5), 287.15, 297.15)
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
    radiance = ONE.radiance(Inputs(np.roll(photograph(48, 64), 11, axis=1)))
    exact = brightness_temperature(ONE.limited(radiance), 7.5, 13.5)
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
    # OpenCV would abort the process, for an anchor and for a search too.
    write(tmp_path / "good.png", photograph())
    model = replace(ONE, level=LEVEL)
    assert anchor_of("air=280.5", model, [tmp_path]) == anchor_of("air=280.5", model, [tmp_path / "good.png"])
    assert search_in_files(ONE, [path]).line


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
    assert np.array_equal(shown(tmp_path / "out" / "a.tif"), Translation(ONE).translated(other)[0])
    names = {each.name for each in (tmp_path / "out").iterdir()}
    assert names == {"a.tif", "a.png", "translate.json", "translated.jsonl"}


def test_a_map_changed_between_runs_is_refused(tmp_path, call):
    path = write(tmp_path / "a.png", photograph())
    save_map(ONE, tmp_path / "map.npz")
    assert call("translate", tmp_path / "map.npz", path, "-o", tmp_path / "out")[0] == 0
    assert np.array_equal(shown(tmp_path / "out" / "a.tif"), Translation(ONE).translated(photograph())[0])
    save_map(replace(NINE, name=ONE.name, method=ONE.method), tmp_path / "map.npz")
    status, _, errors = call("translate", tmp_path / "map.npz", path, "-o", tmp_path / "out", "--resume")
    assert status == 2 and "translate.json was made with another model" in errors


def test_another_range_and_texel_give_a_warning(tmp_path, call):
    path = write(tmp_path / "a.png", photograph())
    status, _, errors = call(
        "translate", "fok-9to1", path, "-o", tmp_path / "out", "--texel-m", "0.5", "--range-c", "0,40"
    )
    assert status == 0 and errors.startswith("warning: learned map 'fok-9to1' was trained at 0.0785–0.157 m a pixel")
    ranged = NINE.ranged((0.0, 40.0))
    exact = brightness_temperature(ranged.limited(ranged.radiance(Inputs(photograph(), 0.5))), 7.5, 13.5)
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


# --- the range and the sky of the training ------------------------------------------------------------------------


def under_a_sky(sky_k, **changes):
    """Equation 3 with a wide range, trained under a sky that is known."""
    return replace(ONE, range_k=(200.0, 320.0), sky_temperature=sky_k, about={"sky_assumed": False}, **changes)


def test_no_temperature_is_outside_of_the_range_or_below_the_sky_of_the_training(tmp_path, call):
    """Equation 3 has intensity −1.03 on blue and 1.99 on yellow: neither 0 K nor 389 K."""
    rgb = photograph()
    rgb[:20], rgb[20:24] = (0, 0, 255), (255, 255, 0)
    path = write(tmp_path / "a.png", rgb)
    for sky_k, coldest_k in ((255.0, 255.0), (190.0, 200.0)):
        out = tmp_path / f"{sky_k}"
        save_map(under_a_sky(sky_k), tmp_path / "map.npz")
        status, _, errors = call("translate", tmp_path / "map.npz", path, "-o", out)
        assert status == 0
        kelvin = read_temperature(out / "a.tif")
        assert np.abs(kelvin[:20] - coldest_k).max() <= 0.02 and np.abs(kelvin[20:24] - 320.0).max() <= 0.02
        assert kelvin.min() >= coldest_k - 0.02 and kelvin.max() <= 320.02
        line = json.loads((out / "translated.jsonl").read_text())
        # 24 of 40 rows, of which the blue ones have no temperature at all.
        assert line["share_outside_0_1"] >= 0.6 > line["share_extrapolated"] >= 0.5
        assert line["share_colder_than_sky"] >= 0.5
        assert "1 of 1 results have more than 1% of their pixels, a.png has 5" in errors
        assert "far outside -73.1…46.9 °C, the range of learned map" in errors
        assert f"colder than {sky_k - 273.15:.1f} °C, the sky of its training, which no surface under it is" in errors


def test_an_assumed_sky_and_a_stated_range_do_not_clip():
    """The sky of a map that records none, and a range colder than the sky."""
    assert replace(ONE, range_k=(200.0, 320.0)).limits_k == (200.0, 320.0)
    cold = under_a_sky(255.0).ranged((-60.0, -30.0))
    assert cold.limits_k == pytest.approx((213.15, 243.15)) and cold.sky_temperature == pytest.approx(213.15)
    assert replace(ONE, range_k=(200.0, 250.0), about={"sky_assumed": False}).limits_k == (200.0, 250.0)


def test_surfaces_of_a_scene_are_not_colder_than_their_sky():
    from thermorender.learned.apply import kinetic_from_map
    from thermorender.materials.material import grey

    # 200 K to 320 K: the darkest blue is at about 240 K apparent.
    model, rgb = under_a_sky(255.0), np.array([[[0, 0, 0], [200, 100, 50]]], np.uint8)
    apparent = brightness_temperature(model.radiance(Inputs(rgb)), *model.band_um)
    assert apparent[0, 0] < 250.0 < 270.0 < apparent[0, 1]
    kelvin, trusted, _ = kinetic_from_map(model, Inputs(rgb), np.zeros((1, 2), np.uint8), (grey("black", 1.0),))
    assert trusted.all() and kelvin[0, 0] == 255.0 and kelvin[0, 1] == pytest.approx(apparent[0, 1], abs=1e-3)
    # Under a colder sky that the caller states, the map's temperature stays.
    kelvin, *_ = kinetic_from_map(model, Inputs(rgb), np.zeros((1, 2), np.uint8), (grey("black", 1.0),), 190.0)
    assert kelvin[0, 0] == pytest.approx(apparent[0, 0], abs=1e-3)


def test_distance_of_the_colours_from_training_is_stated(tmp_path):
    level = TrainingLevel(290.0, 5.0, 1.5, 285.0, (50.0, 0.0, 0.0), (10.0, 5.0, 5.0))
    # L of this grey is 53.6 and of black 0, and both have a = b = 0.
    for name, value in (("a", 128), ("b", 0)):
        write(tmp_path / f"{name}.png", np.full((6, 6, 3), value, np.uint8))
    summary = translate(replace(ONE, level=level, texel_m=None, texel_range_m=None), [tmp_path], tmp_path / "out")
    lines = [json.loads(line) for line in (tmp_path / "out" / "translated.jsonl").read_text().splitlines()]
    assert [line["colour_distance"] for line in lines] == pytest.approx([0.36 / 3**0.5, 5.0 / 3**0.5], abs=0.01)
    assert summary["notes"] == [
        "the ground sampling distance of learned map 'fok-1to1' is unknown: pictures are not resampled",
        "colours are 1.5 standard deviations of the training from its mean, 2.9 in b.png; those of its own pictures "
        "are 1",
    ]


# --- anchors ----------------------------------------------------------------------------------------------------

LEVEL = TrainingLevel(290.0, 5.0, 1.5, 285.0, (50.0, 0.0, 0.0), (10.0, 5.0, 5.0))


def anchored(call, folder, option, *more, status=0):
    """(apparent temperature without and with an anchor, output, errors) of one picture [K]."""
    save_map(replace(ONE, level=LEVEL), folder / "map.npz")
    path, found = write(folder / "a.png", photograph()), []
    for out, options in (("plain", ()), ("anchored", ("--anchor", option, *more))):
        given = call("translate", folder / "map.npz", path, "-o", folder / out, *options)
        found.append(read_temperature(folder / out / "a.tif") if (folder / out / "a.tif").exists() else None)
    assert given[0] == status, given
    return *found, *given[1:]


@pytest.mark.parametrize("option", ["air=280.5", "air=280.5K"])
def test_anchor_to_the_air_gives_the_ground_the_distance_from_it_that_it_had_in_training(tmp_path, call, option):
    """5 K above the air, and a contrast that explains a third of the variance within a training picture."""
    plain, found, output, _ = anchored(call, tmp_path, option)
    span = math.sqrt(1 / 3) * 1.5 / plain.std()
    assert found.mean() == pytest.approx(285.5, abs=0.03) and 0.2 < span < 0.9
    assert np.abs(found - 285.5 - span * (plain - plain.mean())).max() <= 0.04
    offset = 285.5 - span * plain.mean()
    assert f"anchor: temperatures are {span:.2f} times those of the map {offset:+.1f} K" in output
    record = json.loads((tmp_path / "anchored" / "translate.json").read_text())
    assert record["anchor"].pop("stated") == option
    assert record["anchor"] == pytest.approx({"offset_k": offset, "span": span}, rel=1e-3)
    # The 8-bit picture has the map's range from black to white, which is moved too.
    assert np.abs(shown(tmp_path / "plain" / "a.png").astype(int) - shown(tmp_path / "anchored" / "a.png")).max() <= 3


def test_anchor_does_not_widen_the_span_and_is_one_for_all_pictures(tmp_path):
    level = replace(LEVEL, kelvin_within=50.0)
    for seed in (0, 1):
        write(tmp_path / f"{seed}.png", photograph(seed=seed))
    exact = [brightness_temperature(ONE.limited(ONE.radiance(Inputs(photograph(seed=seed)))), 7.5, 13.5).mean()
             for seed in (0, 1)]  # fmt: skip
    found = anchor_of("air=280.5", replace(ONE, level=level), [tmp_path])
    assert found.span == 1.0 and found.offset_k == pytest.approx(285.5 - np.mean(exact), abs=0.01)


def test_pictures_that_come_later_are_translated_with_the_line_of_the_first(tmp_path, call):
    (tmp_path / "p").mkdir()
    write(tmp_path / "p" / "0.png", photograph())
    begun = ("translate", "procedural-9to1", tmp_path / "p", "-o", tmp_path / "out", "--anchor", "air=288.2")
    assert call(*begun)[0] == 0
    record = (tmp_path / "out" / "translate.json").read_bytes()
    write(tmp_path / "p" / "1.png", 255 - photograph(seed=1))
    status, output, errors = call(*begun, "--resume")
    assert status == 0 and "1 translated, 1 done before" in output, errors
    assert (tmp_path / "out" / "translate.json").read_bytes() == record
    status, _, errors = call(*begun[:-1], "air=290", "--resume")
    assert status == 2 and "with another anchor" in errors


def test_anchor_takes_the_pictures_that_can_be_read_and_needs_one_with_temperatures(tmp_path):
    model = replace(ONE, level=LEVEL)
    write(tmp_path / "good.png", photograph())
    alone = anchor_of("air=280.5", model, [tmp_path])
    (tmp_path / "junk.png").write_bytes(b"no picture")
    assert anchor_of("air=280.5", model, [tmp_path]) == alone
    clear = np.dstack([photograph(), np.zeros((40, 50), np.uint8)])
    with pytest.raises(ThermorenderError, match="none of the 1 pictures that were tried has a pixel with a temperat"):
        anchor_of("air=280.5", model, [write(tmp_path / "clear.png", clear)])


@pytest.mark.parametrize("level", [LEVEL, None])
def test_one_known_temperature_sets_the_level(tmp_path, level):
    """Where the contrast of the training is unknown, the map's stays."""
    path = write(tmp_path / "a.png", photograph())
    (tmp_path / "known.csv").write_text("column,row,kelvin\n7,5,301.5\n")
    exact = brightness_temperature(ONE.limited(ONE.radiance(Inputs(photograph()))), 7.5, 13.5)
    found = anchor_of(str(tmp_path / "known.csv"), replace(ONE, level=level), [path])
    assert found.kelvin(exact[5, 7]) == pytest.approx(301.5, abs=0.021)
    assert found.span == pytest.approx(1.0 if level is None else math.sqrt(1 / 3) * 1.5 / exact.std(), rel=1e-3)


def test_several_known_temperatures_set_level_and_span(tmp_path, call):
    """By hand: least squares, with the prior of a map that explains a third of a picture's variance."""
    rows = [(7, 5, 301.5), (40, 30, 310.0), (20, 10, 290.0)]
    (tmp_path / "known.csv").write_text("column,row,kelvin\n" + "".join("{},{},{}\n".format(*row) for row in rows))
    plain, found, *_ = anchored(call, tmp_path, str(tmp_path / "known.csv"))
    mapped, known = np.array([plain[row, column] for column, row, _ in rows]), np.array([row[2] for row in rows])
    span = np.cov(mapped, known, ddof=0)[0, 1] * 3 / (mapped.var() * 3 + 2.0 * plain.var())
    assert span > 0.1
    assert np.abs(found - (known.mean() + span * (plain - mapped.mean()))).max() <= 0.06


def test_many_known_temperatures_outweigh_the_prior_and_opposite_ones_leave_a_constant():
    rng = np.random.default_rng(0)
    mapped = rng.normal(290.0, 3.0, 4000)
    many = anchored_to_known(ONE, 20.0 + 0.9 * mapped + rng.normal(0.0, 1.0, 4000), mapped, 3.0)
    assert many.span == pytest.approx(0.9, abs=0.01)
    assert anchored_to_known(ONE, 600.0 - mapped[:3], mapped[:3], 3.0) == MapAnchor(600.0 - mapped[:3].mean(), 0.0)
    # A picture of one temperature has no span, and not a number that is not finite.
    assert anchored_to_known(ONE, np.array([280.0, 290.0]), np.full(2, 290.0), 0.0) == MapAnchor(285.0, 0.0)


def test_known_temperatures_name_their_picture_where_there_are_several(tmp_path):
    for name, seed in (("a", 0), ("b", 1)):
        write(tmp_path / f"{name}.png", photograph(seed=seed))
    known = tmp_path / "known.csv"
    known.write_text("picture,column,row,kelvin\nb.png,7,5,301.5\n")
    exact = brightness_temperature(ONE.limited(ONE.radiance(Inputs(photograph(seed=1)))), 7.5, 13.5)
    found = anchor_of(str(known), ONE, [tmp_path / "a.png", tmp_path / "b.png"])
    assert found.span == 1.0 and found.offset_k == pytest.approx(301.5 - exact[5, 7], abs=0.021)
    known.write_text("column,row,kelvin\n7,5,301.5\n")
    with pytest.raises(ThermorenderError, match="no column 'picture', and 2 pictures are translated; add that column"):
        anchor_of(str(known), ONE, [tmp_path / "a.png", tmp_path / "b.png"])


def test_known_temperatures_of_a_video_are_those_of_its_first_frame(tmp_path):
    path = video(tmp_path / "flight.avi")
    (tmp_path / "known.csv").write_text("column,row,kelvin\n7,5,301.5\n")
    exact = brightness_temperature(ONE.limited(ONE.radiance(Inputs(photograph(48, 64)))), 7.5, 13.5)
    # The source is compressed.
    assert anchor_of(str(tmp_path / "known.csv"), ONE, [path]).offset_k == pytest.approx(301.5 - exact[5, 7], abs=1.0)


@pytest.mark.parametrize(
    ("option", "rows", "words"),
    [
        ("air=15", None, "air=15 is below"),
        ("air=warm", None, "'warm' is not a number; give air=KELVIN"),
        ("water=290", None, "anchor='water=290' is not known; give air=KELVIN"),
        ("air=2882", None, "air=2882 is not allowed; give at most 350 K"),
        ("{}", "column,row,kelvin\n1,2,99999\n", "kelvin=99999 is not allowed; give at most 2621.4 K"),
        ("{}", "column,row,kelvin\n1,2,290\n1,2,300\n", "column=1, row=2 is stated twice; give each pixel once"),
        ("{}", "column,row\n1,2\n", "has the columns column, row; give column, row, kelvin"),
        ("{}", "column,row,kelvin\n50,2,290\n", "column=50, row=2 is outside of a.png; give 0…49 and 0…39"),
        ("{}", "column,row,kelvin\n-1,2,290\n", "column=-1, row=2 is outside of a.png"),
        ("{}", "column,row,kelvin\n1,2,17\n", "values are kelvin"),
        ("{}", "column,row,kelvin\n1,2,\n", "kelvin='' is not allowed; give a number"),
        ("{}", "picture,column,row,kelvin\nc.png,1,2,290\n", "picture='c.png' is not translated; give a.png"),
    ],
)
def test_wrong_anchors_are_refused(tmp_path, call, option, rows, words):
    if rows:
        (tmp_path / "known.csv").write_text(rows)
    _, found, _, errors = anchored(call, tmp_path, option.format(tmp_path / "known.csv"), status=2)
    assert found is None and words in errors and len(errors.strip().splitlines()) == 1, errors
    assert not (tmp_path / "anchored").exists()


def test_an_air_that_the_map_knows_or_whose_training_is_unknown_is_refused():
    with pytest.raises(ThermorenderError, match="air temperature of the training, which learned map 'fok-1to1' does"):
        anchor_of("air=290", ONE, [])
    warm = TemperatureMap("warm", "trees+", _Warm(), (280.0, 300.0), (7.5, 13.5), 0.1, (0.1, 0.2), "", 255.0, "")
    with pytest.raises(ThermorenderError, match="'warm', which takes the air's temperature as input; leave it out"):
        anchor_of("air=290", warm, [])
