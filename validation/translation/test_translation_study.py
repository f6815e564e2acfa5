"""Cost of translation and steps at the borders of tiles, for maps and pictures with known steps."""

from types import SimpleNamespace

import numpy as np
import pytest
from compare_support import linear_map
from training_support import map_of, network, picture

from thermorender.apps.training.dataset import Entry, ThermalScale
from thermorender.apps.training.dataset_writer import Writer, packed
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.networks import tiles
from thermorender.learned.temperature_map import Inputs, save_map
from thermorender.physics.planck import band_radiance
from validation.translation import study as translation


def make_dataset(folder, shape, pairs=2):
    writer, members = Writer(folder, {"title": "a toy"}, ThermalScale("radiance", 0.002, 0.0)), []
    for number in range(pairs):
        visible, thermal = picture(number, *shape), np.full(shape, 20000, np.uint16)
        entry = Entry(f"p{number}", "test", f"p{number}", f"world{number}", 0, shape, 0.2)
        members.append((entry, packed(visible, thermal, np.ones(shape, bool), None)))
    writer.shard("all", members)
    return folder


def test_steps_are_summed_at_borders_and_elsewhere():
    temperature = 290.0 + np.repeat([0.1 * np.arange(600)], 300, axis=0)
    temperature[:, 256:] += 3.0
    sums = translation.steps_of(temperature, (np.array([], int), np.array([256])))
    # Across the line 3.1 K, from column to column 0.1 K, from row to row nothing.
    assert sums[0] == pytest.approx([300 * 3.1, 300])
    assert sums[1] == pytest.approx([300 * 598 * 0.1, 300 * 598 + 299 * 600])
    # Pixels without temperature do not count.
    temperature[7, 255] = np.nan
    assert translation.steps_of(temperature, ((), np.array([256])))[0] == pytest.approx([299 * 3.1, 299])


def test_tiles_have_equal_weights_at_their_borders():
    """Five tiles with one number each: the border is halfway between two numbers."""
    numbers = iter(range(100))
    length, side, overlap = 1000, 256, 64
    found = tiles.stitched(lambda part: np.full((1, *part.shape[1:]), float(next(numbers))),
                           np.zeros((1, side, length), np.float32), (side, side), overlap, 8)[0, 0]  # fmt: skip
    middles = tiles.joints(length, side, overlap)
    assert len(middles) == found.max() == 4
    # The centre of a pixel is at its number plus a half.
    halves = [np.interp(k + 0.5, found, np.arange(length) + 0.5) for k in range(4)]
    assert middles == pytest.approx(halves, abs=0.5)
    assert len(tiles.joints(256, 256, 64)) == 0


def test_borders_of_resampled_pictures_are_in_their_own_pixels():
    inputs = Inputs(picture(0, 600, 1000), 0.05)
    rows, columns = network("pix2pix").joints(inputs)
    # Applied at 0.1 m, its finest resolution: half as many pixels.
    own = network("pix2pix").joints(Inputs(picture(0, 300, 500), 0.1))
    assert rows == pytest.approx(2.0 * own[0]) and columns == pytest.approx(2.0 * own[1])


def test_steps_of_squares_of_known_temperatures():
    numbers = iter(range(4))

    def radiance(inputs):
        return band_radiance(np.full(inputs.rgb.shape[:2], 290.0 + next(numbers)), *BAND_UM)

    stand_in = SimpleNamespace(radiance=radiance, band_um=BAND_UM, method="none", predictor=None)
    steps = translation.steps_of(apparent_temperature(translation.side_by_side(stand_in, Inputs(picture(0, 520, 640))),
                                                    BAND_UM), (np.array([256]), np.array([256])))  # fmt: skip
    # Of squares 0, 1 above and 2, 3 below: 1 K from left to right, 2 K from above to below.
    assert steps == pytest.approx(np.array([[512 * 3.0, 1024], [0.0, 2 * 512 * 510]]), abs=0.1)


@pytest.mark.slow
def test_costs_and_border_steps_of_maps_are_measured(tmp_path):
    save_map(map_of(network("pix2pix")), tmp_path / "p.npz")
    save_map(linear_map(), tmp_path / "l.npz")
    data = make_dataset(tmp_path / "d", (520, 640))
    result = translation.run([str(tmp_path / "p.npz"), str(tmp_path / "l.npz")], data, None, 2)
    net, line = result["maps"].values()
    assert set(net["seams"]["pictures"]) == {"squares", "published", "applied"}
    # A map of single colours has no tiles, and its squares join without steps.
    assert set(line["seams"]["pictures"]) == {"squares"}
    assert line["seams"]["pictures"]["squares"][0] < 1.5 * line["seams"]["pictures"]["squares"][1]
    assert all(each["load_s"] > 0.0 and each["translate_s"] > 0.0 for each in (net, line))
    assert net["peak_mib"] is None or net["peak_mib"] > line["peak_mib"]
    assert len(translation.rows(result)) == 2 and all(len(row) == len(translation.HEADER)
                                                      for row in translation.rows(result))  # fmt: skip


def test_impossible_requests_are_refused(tmp_path):
    data = make_dataset(tmp_path / "d", (100, 120))
    with pytest.raises(ThermorenderError, match="no test pairs of 640×512 pixels or more"):
        translation.pictures_of(data, 3)
    with pytest.raises(ThermorenderError, match="pictures=0 is not allowed"):
        translation.run(["fok-1to1"], data, pictures=0)
    with pytest.raises(ThermorenderError, match="nowhere"):
        translation.run(["nowhere"], data)
