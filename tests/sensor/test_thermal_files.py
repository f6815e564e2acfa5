"""The registry of thermal files: kinds by content, frames of sequences, what a caller asks for, and what is refused.

The readers were compared with other decoders and the published formula: `docs/reference/checks.md`.
"""

import shutil
import struct
import sys
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from support import write_dji_jpeg

import thermorender as tr
from tests.robustness.fuzz.corpus import READERS
from tests.robustness.fuzz.corpus.images import flir_container, flir_jpeg, jpeg_ls
from thermorender.apps.survey.footage.calibration import footage, images_of
from thermorender.apps.survey.inverse.frames import frame_files, places_of, read_frames
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.training import pictures
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.sensor import thermal_files
from thermorender.sensor.flir_jpeg import flir_image
from thermorender.sensor.flir_sequence import frame_extents
from thermorender.sensor.radiometric_files import write_tlinear
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.sensor.thermal_files import (
    files_of,
    is_radiometric,
    read_thermal_image,
    thermal_frames,
    thermal_images,
)


def raw(seed=0):
    return np.random.default_rng(seed).integers(15000, 16000, (24, 32)).astype(np.uint16)


def containers(count=3):
    return [flir_container(raw(seed)) for seed in range(count)]


def made(kind, folder, name):
    """A file of the fuzzed reader `kind`, under another name."""
    READERS[kind].make(folder)
    return (folder / READERS[kind].file).rename(folder / name)


def preview(path):
    Image.fromarray(np.random.default_rng(0).integers(0, 256, (40, 48), np.uint8)).save(path, "JPEG")
    return path


@pytest.mark.parametrize(
    ("kind", "found"),
    [("radiometric TIFF", "TIFF"), ("FLIR JPEG", "FLIR"), ("FLIR SEQ", "sequence"), ("FLIR CSQ", "sequence"),
     ("InfiRay IRG", "IRG"), ("picture", "picture")],
)  # fmt: skip
@pytest.mark.parametrize("name", ["a.tif", "a.jpg", "a.irg", "a.seq", "a"])
def test_the_content_decides_the_kind_and_not_the_suffix(tmp_path, kind, found, name):
    (frame, *_) = thermal_frames([made(kind, tmp_path, name)])
    assert frame.kind == found


def test_dji_is_told_from_flir_by_its_segments(tmp_path):
    (frame,) = thermal_frames([write_dji_jpeg(tmp_path / "a.jpg")])
    assert frame.kind == "DJI" and is_radiometric(frame.path)
    # Other makers have such segments too.
    frame.path.write_bytes(frame.path.read_bytes().replace(b"DJI", b"ABC"))
    assert not is_radiometric(frame.path)


def test_a_file_that_begins_as_one_of_infiray_by_chance_is_none(tmp_path):
    (tmp_path / "a.bin").write_bytes(b"\xca\xac\x80\0" + bytes(300))
    assert not is_radiometric(tmp_path / "a.bin")


@pytest.mark.parametrize(("name", "words"), [
    ("a.npy", r"unknown kind; give one of \.tif"), ("a.ats", "only FLIR's own programs read, so export it as SEQ"),
    ("a.fcf", "FLIR Research Studio"), ("a.sfmov", "FLIR Research Studio"),
])  # fmt: skip
def test_files_of_other_kinds_are_refused_with_the_program_that_converts_them(tmp_path, name, words):
    # A container of FLIR inside does not make it a sequence.
    (tmp_path / name).write_bytes(flir_container(raw()) if name != "a.npy" else b"\x93NUMPY")
    with pytest.raises(ThermorenderError, match=words):
        read_thermal_image(tmp_path / name)


def test_frames_of_a_sequence_are_named_by_number_and_equal_their_containers(tmp_path):
    parts = containers()
    (tmp_path / "walk.seq").write_bytes(b"".join(parts))
    frames = thermal_frames([tmp_path / "walk.seq"])
    assert [frame.name for frame in frames] == ["walk_000001", "walk_000002", "walk_000003"]
    assert [frame.label for frame in frames] == [frame.name for frame in frames]
    for seed, (image, part) in enumerate(zip(thermal_images(frames), parts, strict=True)):
        alone = flir_image(part)
        np.testing.assert_array_equal(alone.raw, raw(seed))
        np.testing.assert_array_equal(image.kelvin, alone.temperature())


def test_the_bytes_that_begin_a_frame_may_occur_inside_its_pixels(tmp_path):
    values = raw()
    values[3, 4:6] = np.frombuffer(b"FFF\0", ">u2")
    parts = [flir_container(values), *containers(2)]
    assert parts[0].count(b"FFF\0") == 2
    (tmp_path / "a.seq").write_bytes(b"".join(parts))
    assert [length for _, length in frame_extents(tmp_path / "a.seq")] == [len(part) for part in parts]
    assert next(thermal_images(thermal_frames([tmp_path / "a.seq"]))).kelvin.shape == (24, 32)


def test_frames_in_jpeg_ls_are_those_of_plain_values_and_the_last_may_state_four_bytes_too_many(tmp_path):
    for number, over in enumerate((0, 4)):
        parts = [flir_container(raw(seed), jpeg_ls(raw(seed)), over * (seed == 2)) for seed in range(3)]
        (tmp_path / f"{number}.csq").write_bytes(b"".join(parts))
        images = list(thermal_images(thermal_frames([tmp_path / f"{number}.csq"])))
        for seed, image in enumerate(images):
            np.testing.assert_array_equal(image.kelvin, flir_image(flir_container(raw(seed))).temperature())
        assert len(images) == 3


@pytest.mark.parametrize(
    ("data", "words"),
    [(b"".join(containers())[:-5], r"frame 3: it states \d+ bytes, and \d+ are left"),
     (b"".join(containers(2)) + b"FFF", "frame 3: the FLIR data do not begin with FFF"),
     (b"".join(containers(2)) + bytes(100), "frame 3: the FLIR data do not begin with FFF"),
     (b"FFF\0", "frame 1: the FLIR data do not begin with FFF"),
     (lambda: flir_container(raw(), b"\xff\xd8\xff\xf7" + bytes(90)), "frame 1: the JPEG-LS inside cannot be read"),
     (lambda: flir_container(raw(), jpeg_ls(raw()[:9])), "frame 1: the JPEG-LS inside is 32×9"),
     (lambda: flir_container(raw(), jpeg_ls(raw())[:-200]), "frame 1: the JPEG-LS inside cannot be read"),
     # The size in its header is 60000×60000.
     (lambda: flir_container(raw(), b"".join((jpeg_ls(raw())[:7], 2 * b"\xea\x60", jpeg_ls(raw())[11:]))),
      "frame 1: .* Image size"),
     (flir_container(raw(), overstated=1 << 31), "frame 1: it states 2147")],
)  # fmt: skip
def test_a_sequence_that_is_not_whole_names_its_frame(tmp_path, data, words):
    (tmp_path / "a.seq").write_bytes(data() if callable(data) else data)
    with pytest.raises(ThermorenderError, match=r"a\.seq is not a whole sequence of FLIR: " + words):
        list(thermal_images(thermal_frames([tmp_path / "a.seq"])))


def test_frames_of_a_sequence_are_read_one_at_a_time(tmp_path, monkeypatch):
    (tmp_path / "a.seq").write_bytes(b"".join(containers(5)))
    read = thermal_files.read_flir_frame
    numbers = []
    monkeypatch.setattr(
        thermal_files,
        "read_flir_frame",
        lambda path, number, extent: numbers.append(number) or read(path, number, extent),
    )
    images = thermal_images(thermal_frames([tmp_path / "a.seq"]))
    assert not numbers
    for count in range(1, 6):
        next(images)
        assert numbers == list(range(count))


def test_a_reader_of_one_frame_refuses_a_sequence_of_several(tmp_path):
    (tmp_path / "a.seq").write_bytes(b"".join(containers()))
    with pytest.raises(ThermorenderError, match=r"a\.seq is a sequence of 3 frames; give a file of one"):
        read_thermal_image(tmp_path / "a.seq")
    with pytest.raises(ThermorenderError, match=r"a\.seq is a sequence, of which no frame has a picture of its name"):
        pictures.matched(tmp_path, tmp_path)


@pytest.mark.parametrize("kind", ["FLIR JPEG", "FLIR SEQ"])
def test_the_caller_says_what_flirs_settings_correct(tmp_path, kind):
    (frame, *_) = thermal_frames([made(kind, tmp_path, "a")])
    found = flir_image(flir_container(np.random.default_rng(0).integers(15000, 16000, (8, 12)).astype(np.uint16)))
    stored = found.thermography
    for correction, settings in (
        ("nothing", ThermographySettings()), ("air", replace(stored, emissivity=1.0)), ("surface and air", stored),
    ):  # fmt: skip
        (image,) = thermal_images([frame], correction=correction)
        assert (image.corrected, image.settings) == (correction, stored)
        np.testing.assert_array_equal(image.kelvin, found.temperature(settings))
    with pytest.raises(ThermorenderError, match="contains its calibration; leave out the scale"):
        next(thermal_images([frame], scale=(0.04, 0.0)))


def test_shares_beyond_the_colour_scale_are_those_of_the_raw_values(tmp_path):
    data = bytearray(flir_container(raw()))
    # The middle and the width of the scale in the camera's block, the last record.
    struct.pack_into(">H", data, len(data) - 0x340 + 0x338, 15400)
    struct.pack_into(">i", data, len(data) - 0x340 + 0x33C, 600)
    (tmp_path / "a.jpg").write_bytes(flir_jpeg(bytes(data)))
    expected = 100.0 * (raw() < 15100).mean(), 100.0 * (raw() > 15700).mean()
    assert read_thermal_image(tmp_path / "a.jpg").saturated == pytest.approx(expected)


def test_training_pictures_are_read_before_any_correction(tmp_path):
    (tmp_path / "a.jpg").write_bytes(flir_jpeg(flir_container(raw() - np.uint16(12000))))
    found, alone = (
        pictures.read_thermal(tmp_path / "a.jpg"),
        read_thermal_image(tmp_path / "a.jpg", correction="nothing"),
    )
    assert np.abs(found.values * 0.01 - alone.kelvin).max() < 0.0051
    # The corrections of the file move it by more.
    assert np.abs(read_thermal_image(tmp_path / "a.jpg").kelvin - alone.kelvin).min() > 0.01


def test_what_was_removed_from_a_tiff_is_unknown(tmp_path):
    write_tlinear(tmp_path / "a.tif", np.full((4, 5), 290.0))
    image = read_thermal_image(tmp_path / "a.tif")
    assert (image.corrected, image.settings, image.saturated, image.words) == ("unknown", None, None, "")
    assert image.kelvin == pytest.approx(np.full((4, 5), 290.0))


def test_files_of_infiray_are_their_counts_in_sixteenths_of_a_kelvin(tmp_path):
    import infiray_irg

    path = made("InfiRay IRG", tmp_path, "a.irg")
    image = read_thermal_image(path)
    counts = np.frombuffer(path.read_bytes(), "<u2", 12 * 16, 128 + 12 * 16).reshape(12, 16)
    np.testing.assert_allclose(image.kelvin, counts / 16.0, rtol=1e-12)
    assert image.corrected == "unknown"
    assert image.words == f"files of InfiRay were read by infiray-irg {infiray_irg.__version__}"
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(ThermorenderError, match=r"a\.irg is not a whole IRG file: File is truncated"):
        read_thermal_image(path)


def test_files_of_infiray_are_read_for_training(tmp_path):
    READERS["InfiRay IRG"].make(tmp_path)
    path = tmp_path / READERS["InfiRay IRG"].file
    head, body = path.read_bytes()[:128], path.read_bytes()[128:]
    # 12×16 pixels are too few there.
    values = np.tile(np.frombuffer(body, "<u2", 192, 192).reshape(12, 16), (2, 2))
    sizes = struct.pack("<IHH", 768, 24, 32)
    path.write_bytes(head[:4] + sizes + head[12:] + bytes(768) + values.tobytes())
    found = pictures.read_thermal(path)
    assert found.unit == "kelvin" and np.abs(found.values * 0.01 - values / 16.0).max() < 0.0051


@pytest.mark.parametrize(("kind", "package"), [("FLIR CSQ", "pillow_jpls"), ("InfiRay IRG", "infiray_irg")])
def test_without_its_package_a_file_names_what_to_install(tmp_path, monkeypatch, kind, package):
    path = made(kind, tmp_path, "a")
    monkeypatch.setitem(sys.modules, package, None)
    name = package.replace("_", "-")
    with pytest.raises(ThermorenderError, match=rf"{name}, which is not .*pip install 'thermorender\[thermal-files\]'"):
        next(thermal_images(thermal_frames([path])))


def folder_of(tmp_path, *kinds):
    folder = tmp_path / "frames"
    folder.mkdir()
    for kind in kinds:
        made(kind, folder, "DJI_0001_T.JPG" if kind == "FLIR JPEG" else "DJI_0001_T.tif")
    return folder


@pytest.mark.parametrize("kind", ["FLIR JPEG", "radiometric TIFF"])
def test_pictures_beside_radiometric_files_of_a_folder_are_left_out_and_counted(tmp_path, kind):
    folder = folder_of(tmp_path, kind)
    previews = [preview(folder / name) for name in ("DJI_0001_V.JPG", "DJI_0001_W.jpg", "DJI_0001_Z.jpeg")]
    if kind == "radiometric TIFF":
        # A preview of the same name.
        previews.append(preview(folder / "DJI_0001_T.jpg"))
    shutil.copy(previews[0], folder / "._hidden.jpg")
    for reader in (files_of, lambda folder: frame_files([folder]), lambda folder: footage([folder])):
        with pytest.warns(ThermorenderWarning, match=f"^{len(previews)} JPEGs of .* hold no temperatures and are left"):
            (found,) = reader(folder)
        assert getattr(found, "path", found).stem == "DJI_0001_T"


def test_a_picture_that_is_named_is_refused(tmp_path):
    folder = folder_of(tmp_path, "FLIR JPEG")
    path = preview(folder / "DJI_0001_V.JPG")
    files = frame_files([folder / "DJI_0001_T.JPG", path])
    with pytest.raises(
        ThermorenderError, match=r"DJI_0001_V\.JPG is a picture without temperatures; give the camera's"
    ):
        list(thermal_images(thermal_frames(files)))


def test_a_folder_of_pictures_alone_is_refused_by_the_first(tmp_path):
    folder = folder_of(tmp_path)
    preview(folder / "a.jpg")
    with pytest.raises(ThermorenderError, match=r"a\.jpg is a picture without temperatures"):
        list(images_of(footage([folder]), None))


POSES = "frame,east_m,north_m,above_ground_m,yaw_deg,pitch_deg,roll_deg\n"


def test_frames_of_a_sequence_have_poses_by_their_names_and_keep_their_air_removed(tmp_path):
    (tmp_path / "walk.seq").write_bytes(b"".join(flir_container(raw(seed) - np.uint16(12000)) for seed in range(4)))
    write_tlinear(tmp_path / "other.tif", 290.0 + np.arange(24 * 32).reshape(24, 32) / 100.0)
    names = "walk_000001", "walk_000003", "walk_000004", "other"
    (tmp_path / "p.csv").write_text(POSES + "".join(f"{name},{k},0,40,0,-90,0\n" for k, name in enumerate(names)))
    scene = tr.load_scene("heath/survey")
    files = frame_files([tmp_path / "walk.seq", tmp_path / "other.tif"])
    survey = read_frames(files, read_poses(tmp_path / "p.csv"), scene)
    assert survey.names == ("other", "walk_000001", "walk_000003", "walk_000004")
    assert survey.air_removed == (False, True, True, True)
    assert list(survey.poses[:, 0, 3]) == [3.0, 0.0, 1.0, 2.0]
    images = [image for image in thermal_images(thermal_frames(files), correction="air") if "2" not in image.frame.name]
    np.testing.assert_allclose(survey.kelvin, [image.kelvin for image in images], rtol=1e-7)
    assert "1 frames have no pose and are left out: walk_000002" in survey.notes
    assert any("files of FLIR correct the air by their own settings (distance 10 m" in note for note in survey.notes)
    with pytest.raises(ThermorenderError, match=r"walk\.seq .*give the poses in a file"):
        read_frames([tmp_path / "walk.seq"], places_of([tmp_path / "walk.seq"]), scene)


def test_frames_of_a_survey_are_held_once(tmp_path):
    rng = np.random.default_rng(0)
    values = (rng.integers(3000, 4000, (160, 200)).astype(np.uint16) for _ in range(60))
    (tmp_path / "walk.seq").write_bytes(b"".join(map(flir_container, values)))
    rows = (f"walk_{k + 1:06d},{k},0,40,0,-90,0\n" for k in range(60))
    (tmp_path / "p.csv").write_text(POSES + "".join(rows))
    scene = tr.load_scene("heath/survey")
    places = read_poses(tmp_path / "p.csv")
    # What a scene and its poses hold is made first.
    read_frames([tmp_path / "walk.seq"], {"walk_000001": places["walk_000001"]}, scene)
    tracemalloc.start()
    survey = read_frames([tmp_path / "walk.seq"], places, scene)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    # One frame in doubles, and what computes it, is a tenth of all in single precision.
    assert survey.kelvin.nbytes < most < 1.5 * survey.kelvin.nbytes
