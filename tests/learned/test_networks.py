"""Networks: size and receptive field, encoding of their inputs, and their application to pictures of any size."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn
from training_support import WIDTH, map_of, network, picture

from thermorender.apps.training.networks.discriminators import PatchDiscriminator, ScaledDiscriminators
from thermorender.apps.training.networks.learners import learner_of
from thermorender.errors import ThermorenderError
from thermorender.learned.linear import grounds
from thermorender.learned.networks import tiles
from thermorender.learned.networks.architectures.compact import Compact
from thermorender.learned.networks.architectures.keras_unet import KerasUNet
from thermorender.learned.networks.architectures.pix2pix import UNet256
from thermorender.learned.networks.architectures.pix2pixhd import ResidualGenerator
from thermorender.learned.networks.architectures.plain import Dense
from thermorender.learned.networks.building import net_of, predicted
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.predictor import Network
from thermorender.learned.networks.recipes import RECIPES, recipe_of
from thermorender.learned.rows import ExtraInputs
from thermorender.learned.temperature_map import Inputs, load_map, save_map

# Every recipe, and the alternative architectures that a recipe may have.
NAMES = (*RECIPES, "unet:autoencoder", "unet:dense")


def size(net):
    return sum(parameter.numel() for parameter in net.parameters())


# --- architectures ----------------------------------------------------------------------------------------------


def test_sizes_equal_the_published_architectures():
    """Counted for one thermal channel; the authors' programs have three, a few thousand weights more."""
    # Only counted, so no weights are drawn.
    with torch.device("meta"):
        assert size(UNet256()) / 1e6 == pytest.approx(54.41, abs=0.005)
        assert size(PatchDiscriminator()) / 1e6 == pytest.approx(2.77, abs=0.005)
        assert size(PatchDiscriminator(6)) == 2_768_705
        assert size(ResidualGenerator()) / 1e6 == pytest.approx(182.4, abs=0.05)
        assert size(ScaledDiscriminators()) / 1e6 == pytest.approx(5.5, abs=0.05)
        assert size(ResidualGenerator(3, 64, 2, 3)) == 11_378_179
        assert size(Compact(3, RECIPES["compact"].width)) / 1e6 == pytest.approx(5.0, abs=0.3)
        assert size(Dense()) == (3 * 64 * 64 + 1) * 1024 + (1024 + 1) * 64 * 64
        # Of the page that documents it, with its three classes: 2 055 203 to train, 3 776 running means and variances.
        keras = KerasUNet(out=3)
        assert size(keras) == 2_055_203
        assert sum(each.numel() for name, each in keras.named_buffers() if "running" in name) == 3_776


def test_the_satellite_program_is_a_unet_of_seven_levels_with_skips():
    """Nhu's program has 41.83 million parameters with three output channels; it has no biases."""
    recipe = recipe_of("unet-gan")
    with torch.device("meta"):
        net = net_of(recipe, Encoding(), 64)
        judge = learner_of(recipe, Encoding(), 64, 2e-4).parts["discriminator"]
    widths = [3, 64, 128, 256, 512, 512, 512, 512]
    down = sum(16 * a * b for a, b in zip(widths[:-1], widths[1:], strict=True)) + 2 * sum(widths[2:7])
    inside = [2 * n for n in widths[1:7]] + [512]
    up = sum(16 * a * b for a, b in zip(inside, [1, *widths[1:7]], strict=True)) + 2 * sum(widths[1:7])
    assert size(net) == down + up
    assert size(judge) == 16 * (4 * 64 + 64 * 128 + 128 * 256 + 256 * 512 + 512) + 2 * (128 + 256 + 512)
    assert not any(each.bias is not None for part in (net, judge) for each in part.modules()
                   if isinstance(each, nn.Conv2d | nn.ConvTranspose2d))  # fmt: skip
    dropped = [any(isinstance(each, nn.Dropout) for each in level) for level in net.up]
    assert dropped == [False] * 4 + [True] * 3


def test_skips_of_the_satellite_program_and_none_in_the_keras_variant():
    """A change of the picture finer than the bottleneck is still in the translation, or is not."""
    seen = {}
    for name in ("unet-gan", "unet-gan-keras"):
        torch.manual_seed(0)
        net = net_of(recipe_of(name), Encoding(), WIDTH).eval()
        innermost = net.down[-1]
        innermost.register_forward_hook(lambda module, given, found: torch.zeros_like(found))
        one, other = (net(torch.randn(1, 3, 128, 128)) for _ in range(2))
        seen[name] = float((one - other).detach().abs().max())
    assert seen["unet-gan"] > 1e-4 and seen["unet-gan-keras"] == 0.0


def test_training_settings_are_those_of_their_sources():
    nhu, keras, pix2pix = (recipe_of(name) for name in ("unet-gan", "unet-gan-keras", "pix2pix"))
    for recipe in (nhu, keras, pix2pix):
        assert (recipe.optimiser, recipe.rate, recipe.betas, recipe.weight) == ("adam", 2e-4, (0.5, 0.999), 100.0)
        assert recipe.target == (0.5, 0.5)
    assert (nhu.batch, nhu.schedule, nhu.learner, nhu.side) == (1, "constant", "summed", 256)
    assert (keras.batch, keras.schedule, keras.learner, keras.net) == (4, "halfway", "adversarial", "keras_unet")
    assert (pix2pix.batch, pix2pix.schedule, pix2pix.all_options["jitter"]) == (1, "halfway", 286)
    assert "jitter" not in nhu.all_options and "jitter" not in RECIPES["pix2pixhd"].all_options
    # 98 000 epochs of 4000 pairs, or as many steps.
    assert (nhu.published_crops, nhu.published_steps, nhu.crops) == (392_000_000, 98_000, 98_000)
    assert pix2pix.published_steps is None


@pytest.mark.parametrize("name", NAMES)
def test_every_network_returns_a_picture_of_the_input_size(name):
    recipe = recipe_of(*name.split(":"))
    net = net_of(recipe, Encoding(), WIDTH).eval()
    side = max(recipe.side, recipe.multiple)
    # Convolutional networks take other sides, too.
    other = side if recipe.net == "dense" else side + recipe.multiple
    for planes in (torch.zeros(2, 3, side, side), torch.ones(1, 3, side, other)):
        found = predicted(recipe, net, planes)
        assert found.shape == (len(planes), 2 if recipe.learner == "robust" else 1, *planes.shape[2:])
        assert torch.isfinite(found).all()
        if recipe.net in ("unet256", "pix2pixhd", "cyclegan"):
            assert found.abs().max() <= 1.0


def test_the_discriminator_sees_70_pixels():
    net = PatchDiscriminator(4, WIDTH).eval()
    picture = torch.zeros(1, 4, 256, 256, requires_grad=True)
    net(picture)[0, 0, 15, 15].backward()
    seen = picture.grad.abs().sum(dim=(0, 1)) > 0.0
    rows, columns = torch.where(seen)
    assert rows.max() - rows.min() + 1 == 70 and columns.max() - columns.min() + 1 == 70


def test_the_compact_network_starts_as_its_last_plane():
    """With zero weights it returns its last plane, except for the share e⁻⁴ of each other temperature."""
    net = Compact(5, 8, mixed=2)
    nn.init.zeros_(net.exit.weight)
    nn.init.zeros_(net.doubt.weight)
    planes = torch.randn(1, 5, 32, 48)
    mean, spread = net(planes)
    rest = np.exp(-4.0) / (1.0 + np.exp(-4.0))
    wanted = planes[:, -2:-1] * rest + planes[:, -1:] * (1.0 - rest)
    assert torch.allclose(mean, wanted, atol=1e-6) and spread.abs().max() == 0.0


# --- encoding -------------------------------------------------------------------------------------------------


def test_encoding_of_a_picture():
    rgb = np.array([[[0, 255, 51]]], np.uint8)
    found = Encoding().planes(Inputs(rgb))
    assert found[:, 0, 0] == pytest.approx([-1.0, 1.0, -0.6], abs=1e-6)
    depth = np.array([[np.nan]], np.float32)
    encoding = Encoding(depth=True)
    assert encoding.channels == 5 and "depth" in encoding.needs
    assert encoding.planes(Inputs(rgb, depth=depth))[3:, 0, 0].tolist() == [0.0, 0.0]
    near = encoding.planes(Inputs(rgb, depth=np.full((1, 1), 100.0 * np.e, np.float32)))[3:, 0, 0]
    assert near == pytest.approx([1.0, 1.0], abs=1e-6)


def test_typical_material_planes_equal_those_of_the_linear_map():
    names = ("sunlight",)
    conditions = {"air_k": 290.0, "direct_w_m2": 500.0, "diffuse_w_m2": 100.0, "sun_elevation_deg": 40.0,
                  "open_water": -1.0, "shade_water": -2.0, "open_asphalt": 20.0, "shade_asphalt": 3.0}  # fmt: skip
    terrain = {"sunlight": np.float32([[0.0, 421.4], [np.nan, 200.0]])}
    extra = ExtraInputs(names, tuple(sorted(conditions)))
    encoding = Encoding(extra, False, 2.0, 4.0)
    planes = encoding.planes(Inputs(np.zeros((2, 2, 3), np.uint8), 0.2, terrain, conditions))
    assert encoding.mixed == 2 and len(planes) == encoding.channels == 3 + 1 + 1 + 2
    wanted = [plane for name, plane in grounds({**terrain, **conditions}, extra) if name.startswith("as ")]
    assert np.allclose(planes[-2:] * 4.0 + 2.0, wanted, atol=1e-4)
    # In full sunlight that of open ground, without sunlight that of shade.
    assert planes[-2, 0] * 4.0 + 2.0 == pytest.approx([3.0, 20.0], abs=0.1)


# --- application ------------------------------------------------------------------------------------------------


def test_tiles_of_a_pointwise_network_equal_the_whole():
    planes = np.random.default_rng(0).normal(size=(3, 150, 333)).astype(np.float32)
    for side, overlap, margin in ((64, 16, 0), (64, 32, 8), (128, 1, 0), (256, 64, 4), (64, 48, 23)):
        found = tiles.stitched(lambda part: 2.0 * part[:1] + 1.0, planes, (side, side), overlap, margin)
        assert np.allclose(found, 2.0 * planes[:1] + 1.0, atol=1e-5)


def test_neighbouring_tiles_fade_into_each_other():
    """Tiles that disagree by 1: neighbouring pixels differ by no more than the window's steepest slope."""
    calls, planes = iter(range(100)), np.zeros((1, 64, 400), np.float32)
    found = tiles.stitched(lambda part: np.full((1, 64, 64), float(next(calls) % 2)), planes, (64, 64), 16, 0)
    assert 0.5 < np.ptp(found) <= 1.0
    assert np.abs(np.diff(found[0], axis=1)).max() < 1.6 * np.pi / 2.0 / 16.0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(1, 1), (37, 300), pytest.param((256, 256), marks=pytest.mark.slow)])
def test_pictures_of_any_size_and_colour(name, shape):
    predictor = network(name)
    for colour in ((0, 0, 0), (255, 255, 255), (128, 128, 128), (255, 0, 255)):
        found = map_of(predictor).radiance(Inputs(np.full((*shape, 3), colour, np.uint8), 0.2))
        assert found.shape == shape and np.isfinite(found).all()


def test_a_part_gives_the_same_result_as_the_whole(monkeypatch):
    """The compact network has a bounded receptive field, so a large picture has no seam where it is cut."""
    # oneDNN chooses its kernels by the width of the picture; on some CPUs they round by 4.5e-7 of the span differently.
    monkeypatch.setattr(torch.backends.mkldnn, "enabled", False)
    predictor = network("compact")
    generator = np.random.default_rng(4)
    # Weights large enough that distant pixels affect the result.
    for name, values in predictor.state.items():
        spread = 1.5 / np.sqrt(values[0].size) if values.ndim > 1 else 0.01
        predictor.state[name] = generator.normal(0.0, spread, values.shape).astype(np.float32)
    # Tiles with the smallest allowed overlap, and three tiles at rounded positions.
    side, margin = 2048, 288
    for width in (3456, 4620):
        rgb = picture(1, 128, width)
        whole = predictor.with_spread(Inputs(rgb, 0.2))[0]
        assert whole.std() > 1e-3
        for left in range(0, width - 700, 640):
            part = predictor.with_spread(Inputs(np.ascontiguousarray(rgb[:, left : left + side]), 0.2))[0]
            inside = slice(margin if left else 0, part.shape[1] - margin if left + side < width else None)
            off = np.abs(whole[:, left : left + side] - part)[:, inside]
            assert off.max() < 3e-7 * np.ptp(whole), (width, left)


def test_published_networks_normalise_each_square_separately():
    rgb = picture(1, 256, 256)
    safe, published = network("pix2pix"), network("pix2pix", published=True)
    one, other = (each.predict(Inputs(rgb, 0.2), 0.2) for each in (safe, published))
    assert np.abs(one - other).max() > 1e-3
    torch.manual_seed(5)
    assert np.array_equal(other, published.predict(Inputs(rgb, 0.2), 0.2))
    # Dropout drew from a separate generator.
    drawn = torch.rand(1)
    torch.manual_seed(5)
    assert drawn == torch.rand(1)
    # The statistics of the training do not depend on the picture.
    twice = np.concatenate([rgb, 255 - rgb], axis=1)
    assert np.allclose(safe.predict(Inputs(twice, 0.2), 0.2)[:, :100], one[:, :100], atol=0.2)


@pytest.mark.parametrize("written", [{}, {"architecture": "keras_unet"}, {"architecture": None}])
def test_a_file_of_the_former_unet_gan_is_the_keras_variant(written):
    torch.manual_seed(0)
    now = network("unet-gan-keras")
    header = {name: value for name, value in now.header().items() if name != "architecture"}
    again = Network.of(header | {"method": "unet-gan"} | written, now.arrays())
    assert again.method == "unet-gan-keras" and again.recipe == recipe_of("unet-gan-keras")
    inputs = Inputs(picture(1, 64, 64), 0.2)
    assert np.array_equal(*(each.predict(inputs, 0.2) for each in (again, Network.of(now.header(), now.arrays()))))
    new = network("unet-gan")
    assert Network.of(new.header(), new.arrays()).recipe == recipe_of("unet-gan")


def test_a_texel_outside_the_trained_range_is_resampled_to_its_end():
    predictor, sizes = network("compact"), []
    original = Encoding.planes
    rgb = picture(1, 64, 64)
    for texel_m, side in ((0.2, 64), (0.1, 64), (0.025, 16), (0.8, 128), (None, 64)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(Encoding, "planes", lambda self, inputs: (sizes.append(inputs.rgb.shape[0]),
                                                                    original(self, inputs))[1])  # fmt: skip
            assert predictor.predict(Inputs(rgb, texel_m), 0.2).shape == (64, 64)
        assert sizes[-1] == side


def test_a_file_keeps_the_network_to_half_precision(tmp_path):
    for name in NAMES:
        model = map_of(network(name))
        save_map(model, tmp_path / "n.npz")
        again = load_map(tmp_path / "n.npz")
        inputs = Inputs(picture(2, 64, 64), 0.2)
        one, other = model.radiance(inputs), again.radiance(inputs)
        # A weight is stored to 2⁻¹¹ of its value; afterwards another class may be slightly more likely.
        off = np.abs(one - other) > 0.02 * max(np.ptp(one), 0.5)
        assert off.mean() < (0.05 if name == "unet-classes" else 1e-9), name
        save_map(again, tmp_path / "again.npz")
        assert load_map(tmp_path / "again.npz").digest() == again.digest()


def test_weights_beyond_half_precision_keep_full_precision(tmp_path):
    model = map_of(network("unet"))
    for name, values in model.predictor.state.items():
        if name.endswith("running_var"):
            values[:] = 7e4
    save_map(model, tmp_path / "n.npz")
    again = load_map(tmp_path / "n.npz").predictor.state
    assert all((values == np.float32(7e4)).all() for name, values in again.items() if name.endswith("running_var"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda header, arrays: header.update(method="vgg"), "unknown method or width"),
        (lambda header, arrays: header.update(width=0), "unknown method or width"),
        (lambda header, arrays: header.update(width=8), "size mismatch"),
        (lambda header, arrays: header.update(texel_range_m=[0.4, 0.1]), "range of ground sampling distances"),
        (lambda header, arrays: header["encoding"].update(scale=0.0), "not finite"),
        (lambda header, arrays: header.update(width=16000), "size mismatch"),
        (lambda header, arrays: header.update(published="no"), "neither true nor false"),
        (lambda header, arrays: header.update(above_air=True), "does not take the air's temperature"),
        (lambda header, arrays: header["encoding"].update(scale=-1.0), "its scale is not above 0"),
        (lambda header, arrays: header["encoding"].update(offset=1e300), "too large"),
        (lambda header, arrays: header["encoding"].update(extra={"terrain": [], "conditions": [1]}), "has no name"),
        (lambda header, arrays: arrays.popitem(), "Missing key"),
        (lambda header, arrays: arrays.update(more=np.zeros(3)), "Unexpected key"),
        (lambda header, arrays: arrays.update({"entry.bias": np.full(4, 1e300)}), "not finite"),
        (lambda header, arrays: arrays.update({"entry.bias": np.full(4, 1j)}), "not finite"),
        (lambda header, arrays: arrays.update({"entry.bias": np.full(4, np.nan)}), "not finite"),
    ],
)
def test_a_damaged_network_is_refused(tmp_path, change, words):
    predictor = network("compact")
    header, arrays = predictor.header(), predictor.arrays()
    header["encoding"] = dict(header["encoding"])
    change(header, arrays)
    kept = type("Network", (), {"method": "compact", "header": lambda _: header, "arrays": lambda _: arrays})()
    save_map(map_of(kept), tmp_path / "n.npz")
    with pytest.raises(ThermorenderError, match=words):
        load_map(tmp_path / "n.npz")


def test_a_variance_below_0_is_refused(tmp_path):
    predictor = network("pix2pix")
    state = {name: values - 2.0 if name.endswith("running_var") else values for name, values in predictor.state.items()}
    save_map(map_of(replace(predictor, state=state)), tmp_path / "n.npz")
    with pytest.raises(ThermorenderError, match="a variance below 0"):
        load_map(tmp_path / "n.npz")


def test_without_pytorch_the_error_says_what_to_install(tmp_path, monkeypatch):
    import sys

    save_map(map_of(network("compact")), tmp_path / "n.npz")
    for name in [name for name in sys.modules if name.startswith("thermorender.learned.networks.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(ThermorenderError, match=r"needs torch; install it with: pip install .thermorender\[networks"):
        load_map(tmp_path / "n.npz")
