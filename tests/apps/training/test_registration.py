"""Rigs estimated from pictures with a known mapping, and those of real cameras."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support import shared_data
from training_support import TRUE, land, pair, position

from thermorender.apps.training.registration import alignment, levels
from thermorender.apps.training.registration import fit as registration
from thermorender.apps.training.registration.gradient_directions import directions
from thermorender.apps.training.registration.rig import Rig, load_rig, parameters_of, save_rig, warped, write_overlay
from thermorender.errors import ThermorenderError

# Square pixels with the two pictures' scale, rounded like published values.
FIELDS = (
    tuple(2.0 * np.degrees(np.arctan([200 / 500, 150 / 500]))), tuple(2.0 * np.degrees(np.arctan([64 / 220, 48 / 220])))
)  # fmt: skip


def frames(count, rig=TRUE, **changed):
    made = {k: changed.get(f"f{k}") or pair(k, rig) for k in range(count)}
    return [(f"f{k}", lambda k=k: made[k]) for k in made]


def apart(first, second):
    """Root mean square distance of two rigs over the frame [thermal px]."""
    height, width = first.thermal_shape
    column, row = np.meshgrid(np.arange(0.5, width, 5), np.arange(0.5, height, 5))
    away = np.subtract(position(first, column, row), position(second, column, row))
    return float(np.sqrt((away**2).sum(axis=0).mean()) / first.scale)


@pytest.fixture(scope="module")
def found():
    """A rig from ten frames, two of which are misaligned."""
    wrong = {"f3": pair(3, moved=(9.0, 4.0)), "f7": (pair(7)[0], pair(70)[1])}
    return registration.calibrate(frames(10, **wrong), FIELDS)


def test_a_known_rig_is_recovered(found):
    assert apart(TRUE, found) < 0.06
    assert found.k1 == pytest.approx(TRUE.k1, abs=0.01) and found.aspect == 1.0
    assert found.rotation_deg == pytest.approx(TRUE.rotation_deg, abs=0.1)


def test_misaligned_frames_are_left_out(found):
    assert set(found.rejected) == {"f3", "f7"} and "px from the others" in found.rejected["f3"]
    good = [score for name, score in found.frames.items() if name not in found.rejected]
    assert max(found.frames["f3"], found.frames["f7"]) < 0.5 * min(good)
    assert found.score == pytest.approx(np.mean(good)) and abs(found.score_unrelated) < 0.1 * found.score


def test_standard_errors_match_the_scatter_over_other_frames():
    rigs = [
        registration.calibrate([(str(k), lambda k=k: pair(k)) for k in range(start, start + 5)], FIELDS)
        for start in (20, 30)
    ]
    wrong = np.array([(rig.rotation_deg - TRUE.rotation_deg, rig.k1 - TRUE.k1, apart(TRUE, rig)) for rig in rigs])
    stated = np.array([[rig.errors[key] for key in ("rotation_deg", "k1", "position_px")] for rig in rigs])
    ratio = np.sqrt((wrong**2).mean(axis=0) / (stated**2).mean(axis=0))
    assert (ratio > 0.3).all() and (ratio < 3.0).all(), ratio


def test_a_rig_is_found_without_fields_of_view_and_with_unequal_sides():
    true = replace(TRUE, aspect=1.04, scale=2.6)
    assert apart(true, registration.calibrate(frames(3, true), resized=True)) < 0.3


def test_unrelated_pictures_are_refused():
    pictures = [(f"f{k}", lambda k=k: (pair(k)[0], pair(90 + k)[1])) for k in range(4)]
    with pytest.raises(ThermorenderError, match=r"agree on one rig|has a score of 0.0"):
        registration.calibrate(pictures, FIELDS)


def test_frames_of_another_size_and_none_are_refused():
    other = (np.zeros((300, 400, 3), np.uint8), np.zeros((64, 80)))
    with pytest.raises(ThermorenderError, match="'f1' has pictures of 400×300 and 80×64 pixels, others of"):
        registration.calibrate(frames(2, f1=other), FIELDS)
    with pytest.raises(ThermorenderError, match="at least one pair of pictures, got none"):
        registration.calibrate([])
    with pytest.raises(ThermorenderError, match="'f' has a side of 40 pixels; a rig needs pictures of at least 48"):
        registration.calibrate([("f", lambda: (np.zeros((300, 400, 3), np.uint8), np.zeros((40, 60))))])


def test_pictures_without_detail_are_refused():
    flat = np.full((96, 128, 3), 80, np.uint8)
    with pytest.raises(ThermorenderError, match=r"has a score of 0.000"):
        registration.calibrate([("f", lambda: (flat, np.full((96, 128), np.nan)))], ((45, 37), (45, 37)))


def test_scale_of_published_fields_of_view():
    found = levels.scale_of_fields(((57.12, 42.44), (45.0, 37.0)), (3000, 4000), (512, 640))
    lengths = [2000 / np.tan(np.radians(28.56)), 1500 / np.tan(np.radians(21.22)),
               320 / np.tan(np.radians(22.5)), 256 / np.tan(np.radians(18.5))]  # fmt: skip
    assert found == pytest.approx(np.sqrt(lengths[0] * lengths[1] / lengths[2] / lengths[3]))


def test_directions_do_not_depend_on_the_sign_of_contrast():
    image = land(np.random.default_rng(1), (60, 80))
    np.testing.assert_allclose(directions(image), directions(1.0 - image), atol=5e-3)
    slope = directions(np.tile(np.arange(40.0), (30, 1)))
    # A slope to the right is on the real axis; a slope downwards is opposite to it.
    assert np.allclose(slope[10:20, 10:30], 0.5, atol=1e-3)
    assert np.allclose(directions(np.tile(np.arange(40.0), (30, 1)).T)[10:30, 10:20], -0.5, atol=1e-3)


def test_directions_turn_with_the_picture():
    rig = Rig((200, 200), (100, 100), scale=1.0, rotation_deg=12.0, shift_px=(4.0, 2.0), k1=0.0)
    visible = np.repeat(np.uint8(255 * land(np.random.default_rng(2), (200, 200)))[..., None], 3, axis=-1)
    seen = warped(visible, rig)[0][..., 0].astype(np.float32)
    parameters = parameters_of(rig)
    pictures = [levels.Frame("f", visible[..., 0].astype(np.float32), seen)]
    level = levels.level_of(pictures, (rig.visible_shape, rig.thermal_shape), 1.0, 1.0, 1.0)
    (turned,), inside = alignment.sample(level, parameters, level.x, level.y)
    inside &= alignment.within_borders(inside.shape)
    agreement = np.vdot(level.thermal[0][inside], turned[inside])
    assert abs(np.degrees(np.angle(agreement))) < 1.0
    assert alignment.scores_of(level, parameters)[0] > 0.95


def test_a_warped_picture_equals_the_thermal_cameras_view():
    rig = Rig((300, 400), (90, 120), scale=2.7, rotation_deg=5.0, shift_px=(60.0, -20.0), k1=0.1, aspect=1.05)
    row, column = np.mgrid[0:300, 0:400]
    ramp = np.stack([column * 0.6, row * 0.8, np.full((300, 400), 7.0)], axis=-1)
    seen, valid = warped(np.uint8(np.rint(ramp)), rig)
    x, y = position(rig, *np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5))
    assert (valid == ((x > 1) & (y > 1) & (x < 399) & (y < 299))).mean() > 0.98
    assert 0.5 < valid.mean() < 0.99
    inner = valid & (x > 5) & (y > 5) & (x < 395) & (y < 295)
    for band, expected in ((0, 0.6 * (x - 0.5)), (1, 0.8 * (y - 0.5))):
        wrong = (seen[..., band] - expected)[inner]
        # Rounded three times; an offset of half a pixel would give 0.3.
        assert np.abs(wrong).max() < 1.6 and abs(wrong.mean()) < 0.1
    assert (seen[~valid] == 0).all()
    half, _ = warped(np.uint8(np.rint(ramp)), rig, (45, 60))
    assert half.shape == (45, 60, 3)
    left, top, columns, _ = rig.crop
    assert left <= max(x.min(), 0) and left + columns >= min(x.max(), 400) and top <= max(y.min(), 0)
    with pytest.raises(ThermorenderError, match="is 40×30 pixels and the rig's 400×300"):
        warped(np.zeros((30, 40, 3), np.uint8), rig)


def test_a_rig_survives_its_file(tmp_path, found):
    import cv2

    save_rig(found, tmp_path / "rig.json")
    assert load_rig(tmp_path / "rig.json") == found
    assert "± " in str(found) and "8 of 10 frames" in str(found)
    write_overlay(tmp_path / "overlay.png", *pair(0), found)
    assert cv2.imread(str(tmp_path / "overlay.png")).shape == (96, 256, 3)


@pytest.mark.parametrize(
    "change",
    [
        {"scale": "wide"}, {"scale": -1.0}, {"k1": None}, {"shift_px": [1.0]}, {"format": 9}, {"lens": 1},
        {"scale": 1e200}, {"k1": 1e200}, {"aspect": True}, {"visible_shape": [1.5, 2]}, {"shift_px": "ab"},
        {"errors": 1.5}, {"errors": {"k1": "small"}}, {"score": "high"}, {"score_unrelated": [0.1]}, {"frames": [1]},
        {"frames": {"a": None}}, {"rejected": {"a": 1}}, {"score": float("nan")},
    ],
)  # fmt: skip
def test_a_file_that_is_not_a_rig_is_refused(change, tmp_path):
    save_rig(TRUE, tmp_path / "rig.json")
    values = json.loads((tmp_path / "rig.json").read_text("utf-8")) | change
    (tmp_path / "rig.json").write_text(json.dumps(values), "utf-8")
    with pytest.raises(ThermorenderError, match="is not a rig of format 1"):
        load_rig(tmp_path / "rig.json")


def test_real_aligned_pairs_give_the_identity():
    import cv2

    folder = shared_data("pairs/flame3/sycan_m30t")
    names = sorted(path.name[:5] for path in folder.glob("*_thermal_degC.tif"))

    def read(name):
        thermal = cv2.imread(str(folder / f"{name}_thermal_degC.tif"), cv2.IMREAD_UNCHANGED)
        visible = cv2.imread(str(folder / f"{name}_rgb_aligned.png"))
        # Half the size is enough, and faster.
        return cv2.resize(visible, (320, 256), interpolation=cv2.INTER_AREA), cv2.resize(thermal, (320, 256))

    rig = registration.calibrate([(name, lambda name=name: read(name)) for name in names], ((45, 37), (45, 37)))
    assert apart(Rig((256, 320), (256, 320), 1.0, 0.0, (0.0, 0.0), 0.0), rig) < 1.0
    assert rig.score > 3.0 * rig.score_unrelated
