"""Display: gain control by mode, its memory over a flight, palettes, and colour video."""

import cv2
import numpy as np
import pytest
from support import shared_data

from thermorender.errors import ThermorenderError
from thermorender.formats import write_image
from thermorender.output.video import write_video
from thermorender.sensor.display import MODES, DisplaySettings
from thermorender.sensor.palettes import PALETTES, palette

RNG = np.random.default_rng(3)
SCENE = np.clip(
    cv2.GaussianBlur(RNG.normal(size=(256, 320)), (0, 0), 6.0) * 20000 + RNG.normal(6000, 6, (256, 320)), 0, 16383
).astype(np.uint16)


def brute_force_equalisation(counts, plateau_share, steepest):
    """Level of every count in the image: histogram with capped counts and slope, remainder shared by both ends."""
    seen = {}
    for value in counts.ravel().tolist():
        seen[value] = seen.get(value, 0) + 1
    capped = {value: min(n, max(plateau_share * counts.size, 1.0)) for value, n in seen.items()}
    total = sum(capped.values())
    step = {value: min(255.0 * n / total, steepest) for value, n in capped.items()}
    level, levels = 0.5 * (255.0 - sum(step.values())), {}
    for value in sorted(step):
        levels[value] = level + 0.5 * step[value]
        level += step[value]
    return levels


@pytest.mark.parametrize("counts", [SCENE, np.full((64, 64), 5000, np.uint16) + np.arange(64, dtype=np.uint16)])
def test_plateau_against_brute_force(counts):
    shown = DisplaySettings("plateau").image(counts)[1]
    levels = brute_force_equalisation(counts, 150 / 327680, 255 / 64)
    expected = np.vectorize(levels.__getitem__)(counts)
    assert np.abs(shown - expected).max() <= 0.5 + 1e-9


def test_plateau_is_between_stretch_and_equalisation():
    # A large flat population and a ramp. Full equalisation gives the flat part its share of the pixels (a half) of the
    # levels; the plateau gives it no more than the ramp's own counts have.
    flat, ramp = np.full(160 * 320, 5000), np.linspace(6000, 7000, 96 * 320)
    counts = np.concatenate([flat, ramp]).reshape(256, 320).astype(np.uint16)
    shown = DisplaySettings("plateau").image(counts)[1]
    assert shown[-1, -1] - shown[160, 0] > 250 and shown[0, 0] < 2
    assert np.diff(shown.ravel().astype(int)).min() >= 0


def test_linear_stretches_between_the_tails():
    ramp = np.linspace(2000, 6000, 512 * 640).reshape(512, 640).astype(np.uint16)
    for tails in ((0.5, 0.5), (0.0, 10.0)):
        shown = DisplaySettings(tails_percent=tails).image(ramp)[1]
        assert shown.min() == 0 and shown.max() == 255 and (np.diff(shown.ravel().astype(int)) >= 0).all()
        # The ends on either side are rounded by half a level of 255.
        low, high = 2000 + 40 * tails[0], 6000 - 40 * tails[1]
        assert np.abs(shown - np.clip((ramp - low) / (high - low), 0, 1) * 255.0).max() < 0.6


def night_with_cars(share, sigma=30.0):
    """Ground of 3500 ± 30 counts, and a share of the pixels 3300 counts above it: 0.3 K and 33 K of a Zenmuse XT2."""
    counts = RNG.normal(3500, sigma, (512, 640))
    counts[:, : round(640 * share)] += 3300
    return np.clip(np.rint(counts), 0, 16383).astype(np.uint16)


@pytest.mark.parametrize("share", [0.01, 0.03, 0.08])
def test_a_few_warm_cars_leave_the_ground_at_night_half_of_the_levels_and_saturate(share):
    shown = DisplaySettings().image(night_with_cars(share))[1]
    ground, cars = shown[:, 60:], shown[:, : round(640 * share)]
    assert np.ptp(np.percentile(ground, [5, 95])) > 50 and ground.mean() > 40 and (cars == 255).all()


def test_more_than_a_tenth_and_tails_of_zero_and_ordinary_scenes_are_not_cut():
    for share, tails in ((0.15, (0.5, 0.5)), (0.03, (0.0, 0.0))):
        counts = night_with_cars(share)
        shown = DisplaySettings(tails_percent=tails).image(counts)[1]
        assert (shown == 255).mean() < 0.01
    # Half a percent on each side of a normal distribution is within 2.58 of its standard deviations.
    plain = DisplaySettings().measure(night_with_cars(0.0, 300.0))
    assert np.allclose((plain - 3500) / 300, [-2.5758, 2.5758], atol=0.03)


@pytest.mark.parametrize("mode", MODES)
def test_noise_on_a_flat_scene_is_not_amplified(mode):
    quiet = RNG.normal(5000, 2, (512, 640)).astype(np.uint16)
    # A spread of 2 counts at 255/64 levels each is 8 levels; CLAHE may triple the slope.
    assert DisplaySettings(mode).image(quiet)[1].std() < (8.5 if mode != "local" else 25.5)


def test_local_contrast_amplifies_faint_texture():
    # Two halves far apart, each with a texture of 12 counts that a global stretch shows within 3 levels.
    texture = np.tile(np.kron(np.indices((32, 20)).sum(axis=0) % 2, np.ones((4, 4))) * 24, (2, 4))[:256, :320]
    counts = (texture + np.where(np.arange(320) < 160, 4000, 6000)).astype(np.uint16)
    spread = {mode: DisplaySettings(mode).image(counts)[1][:, 40:120].std() for mode in MODES}
    assert spread["local"] > 1.8 * spread["linear"]
    whole = DisplaySettings("local").image(counts)[1].astype(float)
    assert whole[:, 200:].mean() > whole[:, :120].mean() + 40


@pytest.mark.parametrize("mode", MODES)
def test_memory_is_an_exponential_mean(mode):
    # After a jump of the scene the state approaches the new one as 1 − exp(−t/τ), for any number of frames.
    settings = DisplaySettings(mode, memory_s=0.5)
    before, after = SCENE, (SCENE + 700).astype(np.uint16)
    old, new = (MODES[mode][0](counts, (0.5, 0.5)) for counts in (before, after))
    for steps in (1, 9):
        state, _ = settings.image(before)
        np.testing.assert_array_equal(state, old)
        for _ in range(steps):
            state, _ = settings.image(after, state, 0.3 / steps)
        np.testing.assert_allclose(state, new + (old - new) * np.exp(-0.6), rtol=1e-12, atol=1e-9)
    np.testing.assert_array_equal(DisplaySettings(mode).image(after, old, 0.3)[0], new)


@pytest.mark.parametrize("mode", MODES)
def test_memory_continues_from_its_saved_state(mode, tmp_path):
    settings = DisplaySettings(mode, "ironbow", memory_s=1.0)
    frames = [(SCENE + 90 * k).astype(np.uint16) for k in range(4)]
    state, whole = None, []
    for counts in frames:
        state, image = settings.image(counts, state, 0.1)
        whole.append(image.tobytes())
        np.save(tmp_path / f"{len(whole)}.npy", state)
    _, again = settings.image(frames[3], np.load(tmp_path / "3.npy"), 0.1)
    assert again.tobytes() == whole[3] != whole[2]


def test_palettes():
    grey = np.arange(256)
    np.testing.assert_array_equal(palette("white-hot"), grey)
    np.testing.assert_array_equal(palette("black-hot"), 255 - grey)
    iron = palette("ironbow").astype(float)
    # Luma (Rec. 601) rises throughout, so no two temperatures look alike.
    assert np.diff(iron @ [0.299, 0.587, 0.114]).min() > 0.0
    assert iron[0].max() < 10 and iron[-1].tolist() == [255, 255, 255]
    shown = DisplaySettings(palette="ironbow").image(SCENE)[1]
    assert shown.shape == (*SCENE.shape, 3) and shown.dtype == np.uint8
    np.testing.assert_array_equal(shown, palette("ironbow")[DisplaySettings().image(SCENE)[1]])


def test_ironbow_against_a_cameras_stored_palette():
    # Record 0x22 of a radiometric JPEG: Y, Cr, Cb of its colours in studio range (Rec. 601).
    stored = np.loadtxt(shared_data("flir/iron_palette.csv"), delimiter=",", skiprows=1)
    y, cr, cb = ((stored - [16, 128, 128]) * [255 / 219, 255 / 224, 255 / 224]).T
    rgb = np.clip(np.stack([y + 1.402 * cr, y - 0.714136 * cr - 0.344136 * cb, y + 1.772 * cb], axis=-1), 0, 255)
    level = np.linspace(0, 255, len(rgb))
    ours = np.stack([np.interp(level, np.arange(256), channel) for channel in palette("ironbow").T], axis=-1)
    error = np.abs(ours - rgb)
    assert error.mean() < 3 and error[8:-8].max() < 16


def test_colour_video_preserves_colours(tmp_path):
    images = []
    for k, level in enumerate((30, 128, 230)):
        images.append(tmp_path / f"{k}.png")
        write_image(images[-1], np.full((64, 96, 3), palette("ironbow")[level]))
    write_video(tmp_path / "a.mp4", images, 5.0)
    video = cv2.VideoCapture(str(tmp_path / "a.mp4"))
    for level in (30, 128, 230):
        frame = video.read()[1][..., ::-1].reshape(-1, 3).mean(axis=0)
        # 8-bit Y'CbCr preserves the colours of a flat frame to a few levels.
        np.testing.assert_allclose(frame, palette("ironbow")[level], atol=6)


def test_wrong_names_are_refused():
    with pytest.raises(ThermorenderError, match="display mode 'clahe' is unknown; give one of linear, plateau, local"):
        DisplaySettings("clahe")
    with pytest.raises(ThermorenderError, match="palette 'hot' is unknown; give one of white-hot, black-hot, ironbow"):
        DisplaySettings(palette="hot")
    with pytest.raises(ThermorenderError, match="memory_s=-1 is not allowed"):
        DisplaySettings(memory_s=-1.0)
    assert set(PALETTES) == {"white-hot", "black-hot", "ironbow"}
