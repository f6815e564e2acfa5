"""Data sets made from folders of pictures: `thermorender prepare`, its readers, bounds, crops and shifts."""

import json
import shutil
import struct
import warnings
import zlib

import cv2
import numpy as np
import pytest
from support import shared_data, write_dji_jpeg
from training_support import TRUE, pair

from thermorender.apps.training import bounds, map_training, pictures
from thermorender.apps.training.cut import Cut, moved, piece
from thermorender.apps.training.dataset import ThermalScale, read_dataset
from thermorender.apps.training.registration.rig import Rig, save_rig
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.sensor.radiometric_files import orientation, write_tlinear


@pytest.fixture(autouse=True)
def no_figure(monkeypatch, request):
    """Drawing takes longer than everything else, so only one test draws."""
    if "pictures_are_kept" not in request.node.name:
        monkeypatch.setattr(bounds, "figure", lambda path, *_: path.write_bytes(b""))


def folders(path, count=8, shape=(40, 48), thermal=None, colour=True):
    """Folders of pictures seq<K>_<number>.png, and their pictures {name: (visible, thermal)}."""
    rng = np.random.default_rng(3)
    made = {}
    for folder in ("visible", "thermal"):
        (path / folder).mkdir(parents=True)
    for number in range(count):
        name = f"seq{number // 2}_{number:03d}"
        visible = rng.integers(0, 256, (*shape, 3), np.uint8)
        values = rng.normal(12000, 900, shape).astype(np.uint16) if thermal is None else thermal(rng, shape)
        cv2.imwrite(str(path / "visible" / f"{name}.png"), visible if colour else visible[..., 0])
        cv2.imwrite(str(path / "thermal" / f"{name}.png"), values)
        made[name] = visible[..., ::-1], values
    return made


def write_floats(path, values):
    """A TIFF of floats without a unit."""
    import rasterio

    profile = {"driver": "GTiff", "height": values.shape[0], "width": values.shape[1], "count": 1, "dtype": "float32"}
    with rasterio.open(path, "w", transform=rasterio.Affine.scale(2), **profile) as file:
        file.write(values.astype(np.float32), 1)


def prepared(call, path, *options, out="set", status=0):
    found = call("prepare", path / "visible", path / "thermal", "-o", path / out, *options)
    assert found[0] == status, found
    return found[1] if status == 0 else found[2]


# --- whole data sets --------------------------------------------------------------------------------------------


def test_pictures_are_kept_as_they_are_and_scaled_by_the_training_part(tmp_path, call):
    made = folders(tmp_path)
    report = prepared(call, tmp_path, "--texel-m", "0.15", "--licence", "CC0", "--split", "sequence")
    found = read_dataset(tmp_path / "set")
    assert len(found) == 8 and {entry.sequence for entry in found.entries} == {"seq0", "seq1", "seq2", "seq3"}
    for each in found.pairs():
        visible, thermal = made[each.entry.key]
        assert (each.visible == visible).all() and (each.thermal == thermal).all() and each.valid.all()
        assert each.entry.texel_m == 0.15 and each.entry.order == int(each.entry.key[-3:]) % 2
    values = np.concatenate([each.thermal.ravel() for each in found.of("train").pairs()])
    first, third = np.percentile(values, (25, 75))
    low, high = 2.5 * first - 1.5 * third, 2.5 * third - 1.5 * first
    assert found.scale.unit == "intensity" and found.scale.range_c == (14.0, 24.0)
    np.testing.assert_allclose(np.array([low, high]) * found.scale.step + found.scale.zero, (0.0, 1.0), atol=1e-9)
    share = ((values < low) | (values > high)).mean()
    assert f"bounds {low:g} and {high:g}, {share:.2%} of the values outside" in report
    assert found.card["licence"] == "CC0" and found.card["bounds"]["first_quartile"] == first
    assert (tmp_path / "set" / "histogram.png").stat().st_size > 1000


def test_a_data_set_can_consist_of_test_pairs_only(tmp_path, call):
    made = folders(tmp_path, count=2)
    prepared(call, tmp_path, "--split", "test")
    found = read_dataset(tmp_path / "set")
    assert [entry.part for entry in found.entries] == ["test"] * 2
    # Without training pictures the scale is that of all pictures.
    first, third = np.percentile(np.stack([thermal for _, thermal in made.values()]), (25, 75))
    assert (2.5 * first - 1.5 * third) * found.scale.step + found.scale.zero == pytest.approx(0.0, abs=1e-9)


def test_crops_come_from_their_parents_and_are_repeatable(tmp_path, call):
    made = folders(tmp_path)
    for out in ("set", "again"):
        prepared(call, tmp_path, "--crops", "4", "--crop-size", "16", "--split", "crop", "--seed", "5", out=out)
    found, again = read_dataset(tmp_path / "set"), read_dataset(tmp_path / "again")
    assert len(found) == 32 and len({entry.key for entry in found.entries}) == 32
    corners = set()
    for one, other in zip(found.pairs(), again.pairs(), strict=True):
        assert one.visible.shape == (16, 16, 3) and (one.thermal == other.thermal).all()
        visible, thermal = made[one.entry.parent]
        windows = np.lib.stride_tricks.sliding_window_view(thermal, (16, 16))
        places = [(r, c) for r in range(25) for c in range(33) if (windows[r, c] == one.thermal).all()]
        assert len(places) == 1
        row, column = places[0]
        assert (visible[row : row + 16, column : column + 16] == one.visible).all()
        corners |= set(places)
    assert len(corners) > 28
    # Some crops of each parent are for training, and only those count.
    values = np.concatenate([each.thermal.ravel() for each in found.of("train").pairs()])
    assert found.card["bounds"]["third_quartile"] == np.percentile(values, 75)
    assert len({entry.parent for entry in found.of("train").entries}) == 8


def test_corners_of_crops_are_uniform():
    image = np.arange(20 * 24).reshape(20, 24)
    cut = Cut(crops=1, size=16)
    rows, columns = np.divmod([piece(image, f"p{k}", cut, 0)[0, 0] for k in range(2000)], 24)
    for places, count in ((rows, 5), (columns, 9)):
        seen = np.bincount(places, minlength=count)
        assert seen.size == count
        # χ² of a uniform draw has count − 1 degrees of freedom; this is five standard deviations.
        chi = ((seen - 2000 / count) ** 2 / (2000 / count)).sum()
        assert chi < count - 1 + 5.0 * np.sqrt(2.0 * (count - 1))


def test_shifted_pairs_are_off_by_the_requested_distance(tmp_path, call):
    made = folders(tmp_path, shape=(60, 60))
    prepared(call, tmp_path, "--shift", "5")
    seen = set()
    for each in read_dataset(tmp_path / "set").pairs():
        thermal = made[each.entry.key][1]
        vectors = [(r, d) for r in range(-6, 7) for d in range(-6, 7)
                   if (np.roll(thermal, (d, r), (0, 1)) == each.thermal)[each.valid].all()]  # fmt: skip
        assert len(vectors) == 1 and abs(np.hypot(*vectors[0]) - 5.0) < 0.75
        right, down = vectors[0]
        assert each.valid.sum() == (60 - abs(right)) * (60 - abs(down))
        assert (each.visible == made[each.entry.key][0]).all()
        seen.add(vectors[0])
    assert len(seen) > 4
    values, valid = moved(np.ones((9, 9), np.uint8), np.eye(9) > 0, "p", Cut())
    assert values.all() and (valid == (np.eye(9) > 0)).all()


def test_temperatures_become_hundredths_of_kelvin(tmp_path, call):
    folders(tmp_path, 3)
    for path in (tmp_path / "thermal").iterdir():
        path.unlink()
    rng = np.random.default_rng(0)
    celsius = {f"seq{k // 2}_{k:03d}": rng.normal(12.0, 5.0, (40, 48)).astype(np.float32) for k in range(3)}
    celsius["seq0_000"][:2] = np.nan
    celsius["seq0_000"][2] = 600.0
    for name, values in list(celsius.items())[:2]:
        write_floats(tmp_path / "thermal" / f"{name}.tif", values)
    write_tlinear(tmp_path / "thermal" / "seq1_002.tif", celsius["seq1_002"] + 273.15)
    prepared(call, tmp_path, "--split", "crop")
    found = read_dataset(tmp_path / "set")
    assert found.scale == ThermalScale("kelvin", 0.01, 0.0)
    for each in found.pairs():
        valid = np.isfinite(celsius[each.entry.key]) & (celsius[each.entry.key] < 382.0)
        assert (each.valid == valid).all()
        # Half a step of this scale, plus that of the camera's 0.04 K.
        kelvin = each.thermal * 0.01
        assert np.abs(kelvin - 273.15 - celsius[each.entry.key])[valid].max() <= 0.0051 + 0.02
        assert np.isfinite(each.radiance).all()
    fail = prepared(call, tmp_path, "--range-c", "10,20", "--split", "crop", out="other", status=2)
    assert "these are temperatures; leave it out" in fail and not (tmp_path / "other").exists()


def test_a_rig_registers_visible_pictures_to_thermal_ones(tmp_path, call):
    for folder in ("visible", "thermal"):
        (tmp_path / folder).mkdir()
    for k in range(3):
        visible, thermal = pair(k)
        cv2.imwrite(str(tmp_path / "visible" / f"DJI_{k:04d}_V.png"), visible[..., ::-1])
        cv2.imwrite(str(tmp_path / "thermal" / f"DJI_{k:04d}_T.png"), np.uint16(thermal * 100))
    options = ("--visible", "*_V.png", "--thermal", "*_T.png", "--scale", "0.01,0", "--split", "crop")
    report = prepared(call, tmp_path, *options, "--calibrate", "--fields-of-view", "43.6,33.4,32.4,24.6")
    assert "score 0." in report and (tmp_path / "set" / "overlay.png").exists()
    found = read_dataset(tmp_path / "set")
    assert found.scale.unit == "kelvin" and found.card["rig"]["scale"] == pytest.approx(TRUE.scale, abs=0.01)
    assert "DJI_0000_T.png=" in prepared(call, tmp_path, *options[:5], "0.01,-273.15", out="celsius", status=2)
    save_rig(TRUE, tmp_path / "true.json")
    prepared(call, tmp_path, *options, "--rig", tmp_path / "true.json", out="true")
    for one, other in zip(found.pairs(), read_dataset(tmp_path / "true").pairs(), strict=True):
        both = one.valid & other.valid
        assert both.mean() > 0.95
        assert np.abs(one.visible.astype(float) - other.visible)[both].mean() < 1.0
    kept = (tmp_path / "set" / "index.jsonl").read_bytes()
    overlay = (tmp_path / "set" / "overlay.png").read_bytes()
    # The state of a process that is killed after it has written the rig.
    (tmp_path / "set" / "overlay.png").unlink()
    prepared(call, tmp_path, *options, "--calibrate", "--fields-of-view", "43.6,33.4,32.4,24.6", "--resume")
    assert (tmp_path / "set" / "index.jsonl").read_bytes() == kept
    assert (tmp_path / "set" / "overlay.png").read_bytes() == overlay
    wrong = Rig((10, 10), (96, 128), 1.0, 0.0, (0.0, 0.0), 0.0)
    save_rig(wrong, tmp_path / "wrong.json")
    assert "unlike the rig; give another --rig" in prepared(
        call, tmp_path, *options, "--rig", tmp_path / "wrong.json", out="no", status=2
    )


def test_a_stopped_data_set_is_continued(tmp_path, call, monkeypatch):
    from thermorender.apps.training import prepare

    folders(tmp_path)
    monkeypatch.setattr(prepare, "_PER_SHARD", 3)
    prepared(call, tmp_path, out="whole")
    original, calls = prepare.packed, []

    def stops(*pictures):
        calls.append(1)
        if len(calls) == 5:
            raise ThermorenderError("the disk is full")
        return original(*pictures)

    monkeypatch.setattr(prepare, "packed", stops)
    assert "the disk is full" in prepared(call, tmp_path, status=2)
    assert len(read_dataset(tmp_path / "set")) == 3
    prepared(call, tmp_path, "--resume")
    for one, other in zip(*(read_dataset(tmp_path / name).pairs() for name in ("whole", "set")), strict=True):
        assert one.entry == other.entry and (one.thermal == other.thermal).all()
    assert "now" in prepared(call, tmp_path, "--resume", "--texel-m", "0.2", status=2)
    assert "not empty" in prepared(call, tmp_path, status=2)
    # Another picture of the same name and size.
    path = sorted((tmp_path / "visible").iterdir())[0]
    cv2.imwrite(str(path), 255 - cv2.imread(str(path)))
    assert "card.json has checksum=" in prepared(call, tmp_path, "--resume", status=2)


@pytest.mark.parametrize("left", ["shards", "part", "parts of all"])
def test_files_of_a_killed_process_are_continued_then_removed(left, tmp_path, call):
    folders(tmp_path)
    prepared(call, tmp_path, out="whole")
    whole = {path.name for path in (tmp_path / "whole").iterdir()}
    if left == "parts of all":
        prepared(call, tmp_path)
    (tmp_path / "set" / "shards").mkdir(parents=True, exist_ok=True)
    names = {"shards": (), "part": ("card",), "parts of all": ("trial", "card", "index", "histogram", "audit")}[left]
    for name in names:
        (tmp_path / "set" / f".{name}.0123abcd.part").write_bytes(b"half")
        (tmp_path / "set" / "shards" / ".000000.0123abcd.part.tar").write_bytes(b"half")
    prepared(call, tmp_path, "--resume")
    assert {path.name for path in (tmp_path / "set").iterdir()} == whole
    assert [path.name for path in (tmp_path / "set" / "shards").iterdir()] == ["000000.tar"]
    assert len(read_dataset(tmp_path / "set")) == len(read_dataset(tmp_path / "whole"))


def test_sequences_by_name_by_pattern_and_by_gaps(tmp_path, call):
    (tmp_path / "visible").mkdir()
    (tmp_path / "thermal").mkdir()
    rng = np.random.default_rng(0)
    for number in (8, 9, 10, 400, 405, 1200):
        for folder in ("visible", "thermal"):
            cv2.imwrite(str(tmp_path / folder / f"cam_{number}.png"), rng.integers(0, 99, (20, 20), np.uint8))
    wanted = {
        "--gap=50": ["cam_8"] * 3 + ["cam_400"] * 2 + ["cam_1200"],
        r"--sequence=_(\d)": ["8", "9", "1", "4", "4", "1"],
    }
    for k, (option, sequences) in enumerate(wanted.items()):
        prepared(call, tmp_path, option, "--split", "crop", out=f"set{k}")
        entries = read_dataset(tmp_path / f"set{k}").entries
        assert [entry.key for entry in entries] == ["cam_8", "cam_9", "cam_10", "cam_400", "cam_405", "cam_1200"]
        assert [entry.sequence for entry in entries] == sequences
    assert "does not match 'cam_8'" in prepared(call, tmp_path, "--sequence=x(.)", out="no", status=2)
    assert "is not a regular expression" in prepared(call, tmp_path, "--sequence=(", out="no", status=2)


# --- unusable input ---------------------------------------------------------------------------------------------


def spoil(path, kind):
    """Make one pair in the middle unusable; return the words expected in the error."""
    visible, thermal = path / "visible" / "seq1_003.png", path / "thermal" / "seq1_003.png"
    if kind == "alone":
        thermal.unlink()
        return "seq1_003: has no partner"
    if kind == "corrupt":
        thermal.write_bytes(thermal.read_bytes()[:60])
        return "seq1_003.png is not a readable picture"
    if kind == "empty":
        visible.write_bytes(b"")
        return "seq1_003.png is not a readable picture"
    if kind == "depth":
        cv2.imwrite(str(visible), np.zeros((40, 48, 3), np.uint16))
        return "has uint16 values; give 8-bit visible pictures"
    if kind == "equal":
        cv2.imwrite(str(thermal), np.full((40, 48), 77, np.uint16))
        return "is 77 in all pixels"
    if kind == "one pixel":
        cv2.imwrite(str(thermal), np.full((1, 1), 77, np.uint16))
        return "is 1×1 pixels; give pictures of at least 16"
    if kind == "colours":
        cv2.imwrite(str(thermal), np.random.default_rng(0).integers(0, 255, (40, 48, 3), np.uint8))
        return "in colours, whose palette cannot be undone"
    if kind == "size":
        cv2.imwrite(str(thermal), np.random.default_rng(0).integers(0, 255, (48, 40), np.uint16))
        return "have 48×40 and 40×48 pixels; give aligned ones, --rig or --calibrate"
    if kind == "nan":
        thermal.unlink()
        write_floats(thermal.with_suffix(".tif"), np.full((40, 48), np.nan))
        return "has no temperature between 0 and 655.35 K"
    raise AssertionError(kind)


@pytest.mark.parametrize("kind", ["alone", "corrupt", "empty", "depth", "equal", "one pixel", "colours", "size", "nan"])
def test_one_bad_pair_is_refused_by_name_or_left_out(kind, tmp_path, call):
    folders(tmp_path)
    words = spoil(tmp_path, kind)
    said = prepared(call, tmp_path, status=2)
    assert words in said and said.count("\n") == 1 and "1 of 8 names" in said and not (tmp_path / "set").exists()
    found = call("prepare", tmp_path / "visible", tmp_path / "thermal", "-o", tmp_path / "set", "--skip-bad",
                 "--split", "crop")  # fmt: skip
    assert found[0] == 0 and "left out: seq1_003" in found[2]
    dataset = read_dataset(tmp_path / "set")
    assert len(dataset) == 7 and list(dataset.card["left_out"]) == ["seq1_003"]


def test_kinds_of_thermal_pictures_are_not_mixed(tmp_path, call):
    folders(tmp_path)
    values = np.random.default_rng(0).integers(0, 255, (40, 48), np.uint8)
    cv2.imwrite(str(tmp_path / "thermal" / "seq1_003.png"), values)
    assert "several kinds: 7 of intensity in uint16 (e.g. seq0_000), 1 of intensity in uint8" in prepared(
        call, tmp_path, status=2
    )


def test_grey_visible_pictures_give_a_warning(tmp_path, call):
    folders(tmp_path, colour=False)
    status, _, errors = call("prepare", tmp_path / "visible", tmp_path / "thermal", "-o", tmp_path / "set")
    assert status == 0 and "8 of 8 visible pictures are grey" in errors and "penalty=1e-6" in errors


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--crops", "-1"), "--crops=-1"),
        (("--crops", "2", "--crop-size", "400"), "smaller than --crop-size 400"),
        (("--crop-size", "3"), "--crop-size=3"),
        (("--shift", "nan"), "--shift=nan"),
        (("--shift", "30"), "half the thermal picture or more"),
        (("--seed", "-2"), "--seed=-2"),
        (("--texel-m", "0"), "--texel-m=0"),
        (("--range-c", "24,14"), "--range-c=24,14"),
        (("--visible", "*.bmp"), "has no picture"),
        (("--visible", "?eq*.png"), "there are"),
        (("--visible", "*_00?.png"), "there are"),
        (("--rig", "none.json"), "none.json cannot be read"),
        (("--resized",), "add --calibrate"),
        (("--calibrate", "--fields-of-view", "57,42,45"), "has 3 values"),
        (("--calibrate", "--fields-of-view", "57,42,45,400"), "give degrees in 0…180"),
    ],
)
def test_impossible_settings_are_refused_in_one_sentence(options, words, tmp_path, call):
    folders(tmp_path)
    said = prepared(call, tmp_path, *options, status=2)
    assert words in said, said
    assert said.count("\n") == 1 and not (tmp_path / "set").exists()


def test_a_pattern_that_matches_a_name_twice_is_refused(tmp_path, call):
    folders(tmp_path, 2)
    cv2.imwrite(str(tmp_path / "visible" / "seq0_000.jpg"), np.zeros((40, 48, 3), np.uint8))
    assert "are both pair 'seq0_000' by pattern '*'" in prepared(call, tmp_path, status=2)


def test_a_folder_with_other_files_is_left_unchanged(tmp_path, call):
    folders(tmp_path)
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "notes.txt").write_text("mine")
    assert "not empty" in prepared(call, tmp_path, status=2)
    assert [each.name for each in (tmp_path / "set").iterdir()] == ["notes.txt"]


# --- parts ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [1, 2, 5, 1000, 4321])
def test_quantiles_are_those_of_all_values(size):
    rng = np.random.default_rng(size)
    histogram, values = bounds.Histogram(), []
    for _ in range(3):
        values.append(np.clip(rng.normal(30000, 40 * size, size), 0, 65535).astype(np.uint16))
        histogram.add(values[-1])
    for share in (0.0, 0.1, 0.25, 0.5, 0.75, 1.0):
        assert histogram.quantile(share) == pytest.approx(np.quantile(np.concatenate(values), share), abs=1e-9)


def test_bounds_without_contrast_or_pixels_are_refused():
    with pytest.raises(ThermorenderError, match="has no valid thermal pixel"):
        bounds.bounds_of(bounds.Histogram())
    histogram = bounds.Histogram()
    histogram.add(np.full(100, 7, np.uint8))
    with pytest.raises(ThermorenderError, match="are 7, so there are no bounds"):
        bounds.bounds_of(histogram)


def test_a_jpeg_cut_short_is_refused(tmp_path):
    image = np.random.default_rng(0).integers(0, 255, (60, 60, 3), np.uint8)
    cv2.imwrite(str(tmp_path / "a.jpg"), image)
    assert pictures.read_visible(tmp_path / "a.jpg")[0].shape == (60, 60, 3)
    (tmp_path / "a.jpg").write_bytes((tmp_path / "a.jpg").read_bytes()[:-400])
    with pytest.raises(ThermorenderError, match=r"a.jpg is a truncated JPEG"):
        pictures.read_visible(tmp_path / "a.jpg")


def test_a_place_is_read_from_exif(tmp_path):
    from PIL import Image

    exif = Image.Exif()
    exif[0x8825] = {1: "S", 2: (33.0, 30.0, 36.0), 3: "E", 4: (24.0, 15.0, 0.0)}
    Image.new("RGB", (20, 20)).save(tmp_path / "a.jpg", exif=exif)
    Image.new("RGB", (20, 20)).save(tmp_path / "b.jpg")
    assert pictures.place_of(tmp_path / "a.jpg") == (-33.51, 24.25)
    assert pictures.place_of(tmp_path / "b.jpg") is None


def test_tags_are_read_of_pictures_of_any_size(tmp_path):
    """A header of 20000 × 20000 pixels, which Pillow refuses to open; the tags are before the pixels."""
    from PIL import Image

    exif = Image.Exif()
    exif[274], exif[0x8825] = 3, {1: "S", 2: (33.0, 30.0, 36.0), 3: "E", 4: (24.0, 15.0, 0.0)}
    path = tmp_path / "a.png"
    Image.new("L", (8, 8)).save(path, exif=exif)
    data = bytearray(path.read_bytes())
    data[16:24] = struct.pack(">II", 20000, 20000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    path.write_bytes(data)
    assert pictures.place_of(path) == (-33.51, 24.25) and orientation(path) == 3


def test_kelvin_floats_without_a_unit_are_refused(tmp_path):
    import rasterio

    write_floats(tmp_path / "a.tif", np.linspace(280, 300, 400).reshape(20, 20))
    with pytest.raises(ThermorenderError, match="has floats around 290 without a unit"):
        pictures.read_thermal(tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif", "r+") as file:
        file.units = ("K",)
    found = pictures.read_thermal(tmp_path / "a.tif")
    assert found.unit == "kelvin" and found.values[0, 0] == 28000 and found.values[-1, -1] == 30000


def test_radiometric_jpegs_are_apparent_temperatures():
    from thermorender.sensor.flir_jpeg import read_flir_jpeg
    from thermorender.sensor.radiometry import ThermographySettings

    path = next(iter(sorted(shared_data("pairs/flir_rjpeg_samples").glob("*.jpg"))))
    found = pictures.read_thermal(path)
    kelvin = read_flir_jpeg(path).temperature(ThermographySettings())
    assert found.unit == "kelvin" and np.abs(found.values * 0.01 - kelvin)[found.valid].max() < 0.0051


def test_real_pairs_become_a_data_set(tmp_path, call):
    folder = shared_data("pairs/flirone_trees")
    status, _, errors = call(
        "prepare", folder, folder, "-o", tmp_path / "set", "--visible", "*_rgb_aligned.jpg", "--thermal",
        "*_thermal_degC_eps1.tif", "--split", "crop", "--crops", "1",
    )  # fmt: skip
    assert status == 0, errors
    found = read_dataset(tmp_path / "set")
    assert len(found) == 6 and found.scale.unit == "kelvin"
    name = found.entries[0].parent
    celsius = cv2.imread(str(folder / f"{name}_thermal_degC_eps1.tif"), cv2.IMREAD_UNCHANGED)
    assert found.pair(found.entries[0]).thermal.mean() * 0.01 - 273.15 == pytest.approx(celsius.mean(), abs=6.0)


# --- integer temperatures, and files of other makers --------------------------------------------------------------


def integers(path, kelvin, step, zero, kind):
    """A TIFF of counts without a scale; returns the temperatures that it holds."""
    import rasterio

    counts = np.rint((kelvin - zero) / step).astype(kind)
    profile = {"driver": "GTiff", "height": counts.shape[0], "width": counts.shape[1], "count": 1, "dtype": kind}
    with rasterio.open(path, "w", transform=rasterio.Affine.scale(2), **profile) as file:
        file.write(counts, 1)
    return counts * step + zero


@pytest.mark.parametrize(
    "kind, step, zero",
    [("int16", 0.1, 273.15), ("int16", 0.01, 273.15), ("uint16", 0.1, 273.15), ("uint16", 0.01, 0.0),
     ("uint16", 0.1, 0.0), ("int32", 0.01, 0.0)],
)  # fmt: skip
def test_integer_temperatures_follow_the_stated_scale_and_are_asked_about(tmp_path, kind, step, zero):
    from thermorender.sensor.radiometric_files import read_temperature

    kelvin = np.random.default_rng(0).uniform(278.0, 315.0, (40, 48))
    expected = integers(tmp_path / "a.tif", kelvin, step, zero, kind)
    option = f"scale={step:g},{zero:g} for counts of "
    for reader in (pictures.read_thermal, read_temperature):
        with pytest.raises(ThermorenderError, match=option):
            reader(tmp_path / "a.tif")
    found = pictures.read_thermal(tmp_path / "a.tif", (step, zero))
    assert found.unit == "kelvin" and found.valid.all()
    np.testing.assert_allclose(found.values * 0.01, expected, atol=0.0051)
    np.testing.assert_allclose(read_temperature(tmp_path / "a.tif", (step, zero)), expected, rtol=1e-9)
    if kind == "uint16":
        assert pictures.read_thermal(tmp_path / "a.tif", intensity=True).unit == "intensity"


def test_below_zero_is_read_from_signed_counts(tmp_path):
    kelvin = np.linspace(250.0, 290.0, 40 * 48).reshape(40, 48)
    expected = integers(tmp_path / "a.tif", kelvin, 0.1, 273.15, "int16")
    found = pictures.read_thermal(tmp_path / "a.tif", (0.1, 273.15))
    np.testing.assert_allclose(found.values * 0.01, expected, atol=0.0051)


def test_counts_that_are_no_temperatures_stay_intensities(tmp_path):
    """Stretched pictures, bytes in 16 bits, and raw counts of a FLIR core."""
    rng = np.random.default_rng(0)
    for values in (rng.integers(0, 65536, (40, 48)), rng.integers(0, 256, (40, 48)), rng.normal(12000, 900, (40, 48))):
        integers(tmp_path / "a.tif", values, 1.0, 0.0, "uint16")
        assert pictures.read_thermal(tmp_path / "a.tif").unit == "intensity"


def test_intensities_that_look_like_temperatures_need_a_range(tmp_path, call):
    folders(tmp_path, thermal=lambda rng, shape: rng.uniform(28000, 31000, shape).astype(np.uint16))
    assert "give --range-c=COLD,WARM if they are intensities" in prepared(call, tmp_path, status=2)
    assert "intensity" in prepared(call, tmp_path, "--range-c=5,30", "--split=train")
    assert "kelvin" in prepared(call, tmp_path, "--scale=0.01,0", "--split=train", out="kelvin")


@pytest.mark.parametrize("units, expected", [("degF", 288.15), ("K", 59.0 + 273.15), (None, 59.0 + 273.15)])
def test_scale_tags_and_units_of_a_tiff_are_followed(tmp_path, units, expected):
    import rasterio

    base = np.array(59.0 if units != "K" else expected)
    values = np.rint((base + np.linspace(-1.0, 1.0, 40 * 48).reshape(40, 48)) * 10.0).astype(np.int16)
    profile = {"driver": "GTiff", "height": 40, "width": 48, "count": 1, "dtype": "int16"}
    with rasterio.open(tmp_path / "a.tif", "w", transform=rasterio.Affine.scale(2), **profile) as file:
        file.write(values, 1)
        file.scales, file.units = (0.1,), (units or "",)
    found = pictures.read_thermal(tmp_path / "a.tif")
    assert found.values.mean() * 0.01 == pytest.approx(expected, abs=0.01)


def test_files_of_other_makers_name_the_tool_that_converts_them(tmp_path):
    from thermorender.apps.survey.footage.calibration import footage

    radiometric = write_dji_jpeg(tmp_path / "radiometric.jpg").read_bytes()
    # The same with the camera's name and without the signal.
    (tmp_path / "plain.jpg").write_bytes(radiometric.replace(b"\xff\xe3", b"\xff\xe4"))
    assert pictures.read_thermal(tmp_path / "plain.jpg").unit == "intensity"
    with pytest.raises(ThermorenderError, match=r"radiometric JPEG of DJI.*dji_irp -s IN.JPG -a measure"):
        pictures.read_thermal(tmp_path / "radiometric.jpg")
    (tmp_path / "seq").mkdir()
    (tmp_path / "seq" / "a.ats").write_bytes(b"FFF\0")
    for reader in (lambda path: footage([path]), lambda path: pictures.matched(path, path)):
        with pytest.raises(
            ThermorenderError, match=r"a\.ats is a sequence that only FLIR's own .* FLIR Research Studio"
        ):
            reader(tmp_path / "seq")


@pytest.mark.parametrize("value", range(1, 9))
def test_pictures_are_turned_by_their_orientation_as_for_a_translation(tmp_path, value):
    from PIL import Image

    from thermorender.apps.training.translate import read_picture

    rgb = np.kron(np.random.default_rng(1).integers(0, 256, (5, 7, 3), np.uint8), np.ones((8, 8, 1), np.uint8))
    tags = Image.Exif()
    tags[274] = value
    for name, more in (("a.jpg", {"quality": 100}), ("a.png", {}), ("a.tif", {})):
        Image.fromarray(rgb).save(tmp_path / name, exif=tags, **more)
        ours, theirs = pictures.read_visible(tmp_path / name)[0], read_picture(tmp_path / name)[0]
        assert ours.shape == theirs.shape and np.abs(ours.astype(int) - theirs).max() <= 8


def test_pairs_of_different_orientations_are_named(tmp_path, call):
    from PIL import Image

    folders(tmp_path)
    for path in (tmp_path / "visible").iterdir():
        tags = Image.Exif()
        tags[274] = 3
        Image.open(path).save(path, exif=tags)
    _, _, errors = call("prepare", tmp_path / "visible", tmp_path / "thermal", "-o", tmp_path / "set")
    assert "visible and thermal picture of 8 pairs state different orientations" in errors


@pytest.mark.parametrize("value", [0, 255, 65535])
def test_a_margin_does_not_hide_the_unit_of_counts(tmp_path, call, value):
    """Hundredths of a kelvin with a margin are asked about; with their scale or a range the margin is no data."""

    def thermal(rng, shape):
        counts = rng.uniform(28500, 30000, shape).astype(np.uint16)
        counts[:, -8:] = value
        return counts

    folders(tmp_path, thermal=thermal)
    errors = prepared(call, tmp_path, status=2)
    assert "which look like scale=0.01,0 for counts of 0.01 K; or give --range-c=" in errors
    for option, unit, scale in (("--scale=0.01,0", "kelvin", (0.01, 0.0)), ("--range-c=5,30", "intensity", None)):
        with warnings.catch_warnings():
            warnings.simplefilter("always", ThermorenderWarning)
            status, _, errors = call(
                "prepare", tmp_path / "visible", tmp_path / "thermal", "-o", tmp_path / unit, option, "--split=train"
            )
        assert status == 0 and errors.count("note:") == errors.count(f"{value} in the file") == 1
        found = pictures.read_thermal(tmp_path / "thermal" / "seq0_000.png", scale, intensity=scale is None)
        assert found.unit == unit and not found.valid[:, -8:].any() and found.valid[:, :-8].all()


def test_a_spot_that_saturates_the_detector_stays_a_temperature(tmp_path):
    """A fire above the range of 16 bits, blurred by optics, and a hot plate with a sharp outline inside the picture."""
    kelvin = np.random.default_rng(2).uniform(285.0, 300.0, (60, 80))
    row, column = np.mgrid[:60, :80]
    fire = np.minimum(kelvin + 800.0 * np.exp(-((row - 5.0) ** 2 + (column - 40.0) ** 2) / 300.0), 655.35)
    plate = np.where(np.hypot(row - 30, column - 40) < 9, 480.0, kelvin)
    for picture in (fire, plate):
        assert (picture == picture.max()).mean() > 0.02
        expected = integers(tmp_path / "a.tif", picture, 0.01, 0.0, np.uint16)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = pictures.read_thermal(tmp_path / "a.tif", (0.01, 0.0))
        assert found.valid.all()
        np.testing.assert_allclose(found.values * 0.01, expected, atol=0.0051)


# --- the error on pictures left out -------------------------------------------------------------------------------


def trained(call, path):
    """What `train` says of the pictures left out, beside its own error."""
    status, output, errors = call("train", "correlation-1to1", path / "set", "-o", path / "map.npz")
    assert status == 0 and "own error" in output
    return errors


def test_train_names_validation_crops_of_training_pictures_and_its_advice_works(tmp_path, call, monkeypatch):
    monkeypatch.setattr(map_training, "_FEW_PAIRS", 1)
    folders(tmp_path)
    crops = ("--crops", "4", "--crop-size", "16", "--seed", "5")
    prepared(call, tmp_path, *crops, "--split", "crop")
    errors = trained(call, tmp_path)
    assert "pictures left out have a sibling in training, such as seq" in errors
    assert "their error measures memory, not new pictures" in errors and "`prepare --split sequence`" in errors
    shutil.rmtree(tmp_path / "set")
    prepared(call, tmp_path, *crops, "--split", "sequence")
    assert "left out" not in trained(call, tmp_path)


def test_train_names_copies_of_training_pictures_among_those_left_out(tmp_path, call, monkeypatch):
    """Smoothed noise is known again when it is brighter; other noise is not."""
    rng, parts = np.random.default_rng(8), {"train": [], "validation": []}
    for folder in ("visible", "thermal"):
        (tmp_path / folder).mkdir()
    for number in range(8):
        blurred = cv2.GaussianBlur(rng.normal(0.0, 1.0, (192, 256, 3)), (0, 0), 2.0)
        visible = np.clip(110.0 + 500.0 * blurred, 0, 255).astype(np.uint8)
        for name, shift in ((f"a{number}", 0), (f"b{number}", 12)):
            if name in ("b1", "b2", "b3", "a4", "a5", "a6", "a7"):
                continue
            cv2.imwrite(str(tmp_path / "visible" / f"{name}.png"), cv2.add(visible, (shift,) * 4))
            thermal = rng.normal(12000, 900, visible.shape[:2]).astype(np.uint16)
            cv2.imwrite(str(tmp_path / "thermal" / f"{name}.png"), thermal)
            parts["train" if name[0] == "a" else "validation"].append(name)
    split = tmp_path / "split.json"
    split.write_text(json.dumps(parts))
    prepared(call, tmp_path, "--split", split)
    # Few pictures are cross-validated: a0 and b0 are each left out once.
    errors = trained(call, tmp_path)
    assert "2 of 9 pictures left out have a picture that shows the same in training, such as " in errors
    monkeypatch.setattr(map_training, "_FEW_PAIRS", 1)
    errors = trained(call, tmp_path)
    assert "1 of 5 pictures left out have a picture that shows the same in training, such as b0 – a0: " in errors
    assert "leave the copies out" in errors
    parts["validation"].remove("b0")
    split.write_text(json.dumps(parts))
    status, _, errors = call("train", "correlation-1to1", tmp_path / "set", "-o", tmp_path / "m.npz", "--split", split)
    assert status == 0 and "left out" not in errors
