"""Networks: size and receptive field, one step of each against a few lines written here, and their training crops."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn
from torch.nn import functional

from thermorender.apps.training.networks.perception import Perception
from thermorender.errors import ThermorenderError
from thermorender.learned.networks import learners, tiles
from thermorender.learned.networks.architectures.compact import Compact
from thermorender.learned.networks.architectures.keras_unet import KerasUNet
from thermorender.learned.networks.architectures.pix2pix import PatchDiscriminator, UNet256
from thermorender.learned.networks.architectures.pix2pixhd import ResidualGenerator, ScaledDiscriminators
from thermorender.learned.networks.architectures.plain import Dense
from thermorender.learned.networks.building import kind_of, learner_of, net_of
from thermorender.learned.networks.crops import Crops
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.predictor import Network, state_of
from thermorender.learned.networks.recipes import RECIPES, recipe_of
from thermorender.learned.temperature_map import Inputs, TemperatureMap, load_map, save_map
from thermorender.learned.training import Example, Task

# Thermal values are hundredths of a kelvin; intensities have a range of 280 K to 300 K.
TEMPERATURE = np.arange(40000) / 100.0
INTENSITY = (TEMPERATURE - 280.0) / 20.0
WIDTH = 4
# Every recipe, and the alternative architectures that a recipe may have.
NAMES = (*RECIPES, "unet:autoencoder", "unet:dense")


def size(net):
    return sum(parameter.numel() for parameter in net.parameters())


def picture(seed, height=96, width=128):
    import cv2

    coarse = np.random.default_rng(seed).integers(0, 256, (8, 9, 3), np.uint8)
    return cv2.resize(coarse, (width, height), interpolation=cv2.INTER_LINEAR)


def kelvin(rgb):
    """The true temperature of the test pictures: linear in colour, 281 K to 299 K."""
    return 290.0 + (rgb @ np.array([8.0, -5.0, 4.0]) - 900.0) / 250.0


def example(seed, valid=None, conditional=False, **sides):
    rgb = picture(seed, **sides)
    terrain = {"slope": np.full(rgb.shape[:2], 0.1 * seed, np.float32)} if conditional else {}
    conditions = {"air_k": 285.0 + seed % 3, "wind_m_s": 2.0} if conditional else {}
    values = np.rint(100.0 * kelvin(rgb)).astype(np.uint16)
    valid = np.ones(values.shape, bool) if valid is None else valid
    return Example(Inputs(rgb, 0.2, terrain, conditions), values, valid)


def task_of(method, examples, run=None, seed=3, progress=lambda what, share: None, resume=False, **options):
    recipe = recipe_of(*method.split(":"))
    small = {"side": 96} if recipe.whole else {}
    return Task(examples, INTENSITY, TEMPERATURE, seed, progress, recipe.all_options | small | options, 0.2, (0.2, 0.2),
                run=run, resume=resume)  # fmt: skip


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
        found = kind_of(recipe).predict(net, planes)
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


# --- one step ---------------------------------------------------------------------------------------------------


class Descent(torch.optim.SGD):
    """Plain gradient descent: a step is the learning rate times the gradient."""

    def __init__(self, parameters):
        super().__init__(parameters, lr=1e-2)


def learner_and_twin(name, discriminators=None):
    """A Learner of plain descent, a copy of its networks, and a batch."""
    torch.manual_seed(1)
    recipe = recipe_of(*name.split(":"))
    learner = learner_of(recipe, Encoding(), WIDTH, 1e-3)
    learner.optimisers = {
        key: Descent([each for part in parts for each in learner.parts[part].parameters()])
        for key, parts in learner.MOVED.items()
    }
    n, side = 2, recipe.side
    valid = torch.ones(n, 1, side, side)
    valid[:, :, : side // 4] = 0.0
    target = 2.0 * torch.rand(n, 1, side, side) - 1.0 if recipe.bounded else torch.rand(n, 1, side, side)
    batch = learners.Batch(torch.randn(n, 3, side, side), target * valid, valid)
    for part in learner.parts.values():
        part.train()
    return learner, copy.deepcopy(learner.parts), batch


def by_hand(part, loss):
    """{name: weight} after a step of descent."""
    slopes = torch.autograd.grad(loss, list(part.parameters()), retain_graph=True)
    return {name: (weight - 1e-2 * slope).detach()
            for (name, weight), slope in zip(part.named_parameters(), slopes, strict=True)}  # fmt: skip


def assert_same(part, wanted):
    for name, weight in part.named_parameters():
        assert torch.allclose(weight, wanted[name], rtol=1e-4, atol=1e-5), name


def masked(values, valid):
    return values[valid.bool()].mean()


@pytest.mark.parametrize("name", ["unet", "unet:dense", "unet:autoencoder"])
def test_a_step_of_regression(name):
    learner, twin, batch = learner_and_twin(name)
    net = twin["net"]
    wanted = by_hand(net, masked((net(batch.planes) - batch.target) ** 2, batch.valid))
    learner.step(batch)
    assert_same(learner.net, wanted)


@pytest.mark.slow
def test_a_step_of_classes():
    learner, twin, batch = learner_and_twin("unet-classes")
    net = twin["net"]
    level = torch.round(batch.target * 255.0).long()[:, 0]
    one_hot = functional.one_hot(level, 256).permute(0, 3, 1, 2).float()
    every = functional.binary_cross_entropy(torch.sigmoid(net(batch.planes)), one_hot, reduction="none")
    wanted = by_hand(net, masked(every.mean(dim=1, keepdim=True), batch.valid))
    learner.step(batch)
    assert_same(learner.net, wanted)


@pytest.mark.parametrize("name", ["pix2pix", "unet-gan-keras"])
def test_a_step_of_pix2pix(name):
    learner, twin, batch = learner_and_twin(name)
    net, judge = twin["net"], twin["discriminator"]
    torch.manual_seed(7)
    made = net(batch.planes)
    # Where nothing is known, both get the generator's own picture.
    real = torch.where(batch.valid.bool(), batch.target, made.detach())
    yes, no = (judge(torch.cat([batch.planes, each], 1)) for each in (real, made.detach()))
    loss = -0.5 * (torch.log(torch.sigmoid(yes)).mean() + torch.log(1.0 - torch.sigmoid(no)).mean())
    wanted = by_hand(judge, loss)
    after = copy.deepcopy(judge)
    after.load_state_dict(wanted, strict=False)
    fooled = -torch.log(torch.sigmoid(after(torch.cat([batch.planes, made], 1)))).mean()
    wanted_net = by_hand(net, fooled + 100.0 * masked((made - batch.target).abs(), batch.valid))
    torch.manual_seed(7)
    found = learner.step(batch)
    assert_same(learner.parts["discriminator"], wanted)
    assert_same(learner.net, wanted_net)
    assert float(found["discriminator"].detach()) == pytest.approx(float(loss.detach()), rel=1e-5)


def test_a_step_of_the_satellite_program():
    """One step of the discriminator, then two of the generator, each with its own dropout and the sum of errors."""
    learner, twin, batch = learner_and_twin("unet-gan")
    net, judge = twin["net"], twin["discriminator"]
    # So that two steps of plain descent on a sum stay small.
    learner.weight = 1e-4
    torch.manual_seed(7)
    with torch.no_grad():
        made = net(batch.planes)
    real = torch.where(batch.valid.bool(), batch.target, made)
    yes, no = (judge(torch.cat([batch.planes, each], 1)) for each in (real, made))
    loss = -0.5 * (torch.log(torch.sigmoid(yes)).mean() + torch.log(1.0 - torch.sigmoid(no)).mean())
    wanted = by_hand(judge, loss)
    judge.load_state_dict(wanted, strict=False)
    for _ in range(2):
        made = net(batch.planes)
        fooled = -torch.log(torch.sigmoid(judge(torch.cat([batch.planes, made], 1)))).mean()
        error = ((made - batch.target).abs() * batch.valid).sum()
        net.load_state_dict(by_hand(net, fooled + 1e-4 * error), strict=False)
    torch.manual_seed(7)
    found = learner.step(batch)
    assert_same(learner.parts["discriminator"], wanted)
    assert_same(learner.net, dict(net.named_parameters()))
    # The log has the mean, as that of the other networks.
    assert float(found["l1"].detach()) == pytest.approx(float(error.detach() / batch.valid.sum()), rel=1e-4)


def test_a_step_of_pix2pixhd():
    learner, twin, batch = learner_and_twin("pix2pixhd")
    net, judges = twin["net"], twin["discriminator"]

    def scales(thermal, of):
        whole = torch.cat([batch.planes, thermal], 1)
        half = functional.avg_pool2d(whole, 3, 2, 1, count_include_pad=False)
        return [judge.features(each) for judge, each in zip(of.scales, (whole, half), strict=True)]

    made = net(batch.planes)
    real = torch.where(batch.valid.bool(), batch.target, made.detach())
    yes, no = scales(real, judges), scales(made, judges)
    # From pix2pixHD's program: 4 over the number of compared layers, over the number of scales.
    layers = [both for one, other in zip(yes, no, strict=True) for both in zip(one[:-1], other[:-1], strict=True)]
    alike = sum((a.detach() - b).abs().mean() * (4.0 / 4.0) * 0.5 for a, b in layers)
    fooled = sum(((each[-1] - 1.0) ** 2).mean() for each in no)
    wanted_net = by_hand(net, fooled + 10.0 * alike)
    against = scales(made.detach(), judges)
    loss = 0.5 * sum(((a[-1] - 1.0) ** 2).mean() + (b[-1] ** 2).mean() for a, b in zip(yes, against, strict=True))
    wanted = by_hand(judges, loss)
    learner.step(batch)
    assert_same(learner.parts["discriminator"], wanted)
    assert_same(learner.net, wanted_net)


def test_a_step_of_cyclegan():
    learner, twin, batch = learner_and_twin("cyclegan")
    net, back, see, feel = (twin[name] for name in ("net", "back", "photographs", "thermals"))
    photograph, thermal, valid = batch.planes[:1], batch.target[1:], batch.valid[1:]
    made, drawn = net(photograph), back(thermal)
    again = net(drawn)
    cycle = (back(made) - photograph).abs().mean() + ((again - thermal).abs() * valid).mean()
    fooled = ((feel(made) - 1.0) ** 2).mean() + ((see(drawn) - 1.0) ** 2).mean()
    wanted = {name: by_hand(twin[name], fooled + 10.0 * cycle) for name in ("net", "back")}
    real = torch.where(valid.bool(), thermal, again.detach())
    against = {"thermals": (feel, real, made.detach()), "photographs": (see, photograph, drawn.detach())}
    for name, (judge, real, false) in against.items():
        wanted[name] = by_hand(judge, 0.5 * ((judge(real) - 1.0) ** 2).mean() + 0.5 * (judge(false) ** 2).mean())
    learner.step(batch)
    for name, weights in wanted.items():
        assert_same(learner.parts[name], weights)


def test_a_step_of_the_compact_network():
    learner, twin, batch = learner_and_twin("compact")
    net = twin["net"]
    # The spread is far too small and the weights are large, so both gradients are too long.
    for each in (net, learner.net):
        nn.init.constant_(each.doubt.bias, -4.0)
        nn.init.constant_(each.exit.weight, 0.1)
    mean, spread = net(batch.planes)
    error = mean - batch.target
    rows, columns = (batch.valid[:, :, 1:] * batch.valid[:, :, :-1], batch.valid[..., 1:] * batch.valid[..., :-1])
    slopes = masked((error[:, :, 1:] - error[:, :, :-1]).abs(), rows)
    slopes = slopes + masked((error[..., 1:] - error[..., :-1]).abs(), columns)
    # Minus the logarithm of Laplace's density, except for a constant.
    likelihood = masked(error.detach().abs() / torch.exp(spread) + spread, batch.valid)
    loss = masked(error.abs(), batch.valid) + 0.5 * slopes + likelihood
    # The uncertainty layer and the others are each limited to a step of bounded length.
    wanted = {}
    for doubt in (True, False):
        some = {name: each for name, each in net.named_parameters() if (name.split(".")[0] == "doubt") == doubt}
        slopes = torch.autograd.grad(loss, list(some.values()), retain_graph=True)
        length = torch.sqrt(sum((slope**2).sum() for slope in slopes))
        assert length > 1.0
        wanted |= {name: (weight - 1e-2 * slope / length).detach()
                   for (name, weight), slope in zip(some.items(), slopes, strict=True)}  # fmt: skip
    learner.step(batch)
    assert_same(learner.net, wanted)


def test_the_applied_compact_network_is_the_mean_of_its_last_weights():
    learner, _, batch = learner_and_twin("compact")
    seen = []
    for _ in range(40):
        learner.step(batch)
        seen.append(learner.net.exit.bias.detach().clone().double())
    # After step n the mean moves by 1 − (1 − 1/n)⁸ of the way: weight number k counts as (k⁸ − (k − 1)⁸) / n⁸.
    counts = torch.diff(torch.arange(41, dtype=torch.float64) ** 8) / 40.0**8
    wanted = sum(count * each for count, each in zip(counts, seen, strict=True))
    assert torch.allclose(learner.applied.exit.bias.double(), wanted, rtol=1e-4, atol=1e-7)
    assert not torch.allclose(learner.applied.exit.bias, learner.net.exit.bias, rtol=1e-3)


def test_the_history_is_shown_half_of_the_time():
    torch.manual_seed(2)
    history = learners.History(1, 2)
    # The first fifty are used as they come.
    for number in range(50):
        assert float(history(torch.full((1, 1, 2, 2), float(number))).mean()) == number
    shown = [float(history(torch.full((1, 1, 2, 2), 100.0 + number)).mean()) for number in range(400)]
    fresh = sum(each == 100.0 + number for number, each in enumerate(shown))
    # Four standard deviations of 400 draws.
    assert abs(fresh - 200) < 40 and len(set(shown)) == 400
    assert {"pictures", "count"} == set(history.state_dict())


def test_a_batch_without_a_valid_pixel_changes_nothing():
    learner, _, batch = learner_and_twin("unet")
    batch.valid = torch.zeros_like(batch.valid)
    before = copy.deepcopy(learner.net.state_dict())
    assert float(learner.step(batch)["mse"].detach()) == 0.0
    for name, weight in learner.net.named_parameters():
        assert torch.equal(weight, before[name]), name


def test_the_perceptual_loss_compares_the_named_layers(tmp_path):
    """With weights from a file: 0 for equal pictures, and the sum of five layers for unequal ones."""
    from safetensors.torch import save_file

    layers, before = [], 3
    for width in (64, 64, "M", 128, 128, "M", *[256] * 4, "M", *[512] * 4, "M", 512):
        layers += [nn.MaxPool2d(2)] if width == "M" else [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()]
        before = before if width == "M" else width
    vgg = nn.Sequential(*layers)
    save_file({f"features.{name}": value for name, value in vgg.state_dict().items()}, tmp_path / "vgg.safetensors")
    loss = Perception(tmp_path / "vgg.safetensors")
    one, other = torch.randn(2, 1, 1, 32, 32)
    assert float(loss(one, one).detach()) == 0.0
    wanted, x, y = 0.0, one.expand(-1, 3, -1, -1), other.expand(-1, 3, -1, -1)
    weights = {1: 1 / 32, 6: 1 / 16, 11: 1 / 8, 20: 1 / 4, 29: 1.0}
    for number, layer in enumerate(vgg):
        x, y = layer(x), layer(y)
        wanted += weights.get(number, 0.0) * float((x - y).abs().mean().detach())
    assert float(loss(one, other).detach()) == pytest.approx(wanted, rel=1e-5)
    with pytest.raises(ThermorenderError, match="holds no weights of VGG-19"):
        Perception(tmp_path / "none.safetensors")


# --- training crops and inputs ----------------------------------------------------------------------------------


def test_crops_depend_only_on_seed_and_number():
    examples = [example(seed) for seed in range(12)]
    first, again, other = (Crops(task_of("unet", examples, seed=seed), 64, False) for seed in (3, 3, 4))
    some = first.batch(0, 700)
    for number in (699, 5, 256, 0):
        (alone,) = again.batch(number, 1)
        assert np.array_equal(alone.inputs.rgb, some[number].inputs.rgb)
        assert np.array_equal(alone.target, some[number].target)
    assert any(not np.array_equal(a.inputs.rgb, b.inputs.rgb) for a, b in zip(some, other.batch(0, 20), strict=False))


def test_crops_of_both_pictures_show_the_same_and_are_mirrored():
    examples = [example(seed) for seed in range(12)]
    crops = Crops(task_of("unet", examples), 64, False)
    mirrored = 0
    for crop in crops.batch(0, 256):
        # Equal up to rounding: both were cut and mirrored in the same way.
        assert np.abs(280.0 + 20.0 * crop.target - kelvin(crop.inputs.rgb)).max() < 0.006 and crop.valid.all()
        mirrored += not any(_holds(each.inputs.rgb, crop.inputs.rgb) for each in examples)
    # One half, within four standard deviations of 256 draws.
    assert abs(mirrored - 128) < 32


def test_jitter_cuts_a_square_from_an_enlarged_crop():
    """The same of both pictures, at 286 : 256, and nothing of it in validation."""
    valid = np.ones((96, 128), bool)
    valid[:, :30] = False
    examples = [example(seed, valid) for seed in range(12)]
    whole, some = (Crops(task_of("pix2pix", examples), 64, False, jitter) for jitter in (64, 72))
    places = set()
    for before, after in zip(whole.batch(0, 64), some.batch(0, 64), strict=True):
        assert after.inputs.rgb.shape == (64, 64, 3) and after.inputs.texel_m == pytest.approx(0.2 * 64 / 72)
        # The picture varies by a few levels per pixel, the target is linear in it.
        off = np.abs(280.0 + 20.0 * after.target - kelvin(after.inputs.rgb))[after.valid]
        assert off.max() < 0.1 and after.valid.mean() > 0.2 and (after.target[~after.valid] == 0.0).all()
        larger = np.kron(before.inputs.rgb.astype(float), np.ones((9, 9, 1)))[4::8, 4::8]
        errors = {(top, left): np.abs(larger[top : top + 64, left : left + 64] - after.inputs.rgb).mean()
                  for top in range(9) for left in range(9)}  # fmt: skip
        places.add(min(errors, key=errors.get))
        assert min(errors.values()) < 4.0
    # 81 places are equally likely.
    assert len(places) > 30
    plain, jittered = whole.validation()[0], some.validation()[0]
    assert np.array_equal(plain.inputs.rgb, jittered.inputs.rgb)


def _holds(whole, part):
    """Whether a picture contains a square unchanged."""
    rows, columns = np.where((whole[: whole.shape[0] - 63, : whole.shape[1] - 63] == part[0, 0]).all(axis=-1))
    return any(np.array_equal(whole[r : r + 64, c : c + 64], part) for r, c in zip(rows, columns, strict=True))


def test_every_training_picture_is_used_and_held_out_ones_are_not():
    examples = [example(seed) for seed in range(40)]
    held = np.zeros(40, bool)
    held[[3, 17, 30]] = True
    crops = Crops(replace(task_of("unet", examples), held_out=held), 64, False)
    read = []
    original = crops.read
    crops.read = lambda number: (read.append(int(number)), original(number))[1]
    crops.batch(0, 512)
    crops.close()
    order = read[: len(crops.train)]
    assert sorted(order) == [k for k in range(40) if k not in (3, 17, 30)] and order != sorted(order)
    assert not {3, 17, 30} & set(read)
    read.clear()
    crops.validation()
    assert read == [3, 17, 30]


def test_invalid_and_missing_pixels_do_not_affect_training():
    valid = np.ones((96, 128), bool)
    valid[40:60] = False
    crops = Crops(task_of("unet", [example(seed, valid) for seed in range(12)]), 64, False)
    for crop in crops.batch(0, 30):
        assert (crop.target[~crop.valid] == 0.0).all() and np.isfinite(crop.target).all()
    # Smaller than a square: placed in its corner, with edges repeated and marked as not valid.
    crops = Crops(task_of("unet", [example(seed, height=40, width=50) for seed in range(12)]), 64, False)
    (crop,) = crops.batch(0, 1)
    assert crop.valid[:40, :50].all() and not crop.valid[40:].any() and not crop.valid[:, 50:].any()
    assert np.array_equal(crop.inputs.rgb[40:, :50], np.repeat(crop.inputs.rgb[39:40, :50], 24, axis=0))


def test_values_without_a_temperature_are_left_out():
    cold = replace(example(1), values=np.full((96, 128), 7, np.uint16))
    table = TEMPERATURE.copy()
    table[7] = np.nan
    task = replace(task_of("unet", [cold] * 12), temperature=table, intensity=(table - 280.0) / 20.0)
    (crop,) = Crops(task, 64, False).batch(0, 1)
    assert not crop.valid.any() and (crop.target == 0.0).all()


def test_too_few_pairs_are_refused():
    with pytest.raises(ThermorenderError, match="2 pairs are too few to train and validate"):
        Crops(task_of("unet", [example(0), example(1)]), 64, False)


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


def test_hour_and_weather_planes_are_scaled_to_about_one():
    examples = [example(seed, conditional=True) for seed in range(12)]
    crops = Crops(task_of("compact+", examples), 64, True)
    encoding = Encoding.measured(crops, False)
    # Kelvin above the air are measured from 0 and scaled by their root mean square over the training pictures.
    above = [kelvin(picture(seed)) - 285.0 - seed % 3 for seed in range(12) if seed % 10 != 9]
    assert encoding.offset == 0.0 and encoding.scale == pytest.approx(np.sqrt(np.mean(np.square(above))), rel=1e-3)
    assert encoding.extra.conditions == ("air_k", "wind_m_s")
    assert Encoding.of(encoding.header(), encoding.arrays()) == encoding


def test_typical_material_planes_equal_those_of_the_linear_map():
    from thermorender.learned.linear import grounds

    names = ("sunlight",)
    conditions = {"air_k": 290.0, "direct_w_m2": 500.0, "diffuse_w_m2": 100.0, "sun_elevation_deg": 40.0,
                  "open_water": -1.0, "shade_water": -2.0, "open_asphalt": 20.0, "shade_asphalt": 3.0}  # fmt: skip
    terrain = {"sunlight": np.float32([[0.0, 421.4], [np.nan, 200.0]])}
    from thermorender.learned.rows import ExtraInputs

    extra = ExtraInputs(names, tuple(sorted(conditions)))
    encoding = Encoding(extra, False, 2.0, 4.0)
    planes = encoding.planes(Inputs(np.zeros((2, 2, 3), np.uint8), 0.2, terrain, conditions))
    assert encoding.mixed == 2 and len(planes) == encoding.channels == 3 + 1 + 1 + 2
    wanted = [plane for name, plane in grounds({**terrain, **conditions}, extra) if name.startswith("as ")]
    assert np.allclose(planes[-2:] * 4.0 + 2.0, wanted, atol=1e-4)
    # In full sunlight that of open ground, without sunlight that of shade.
    assert planes[-2, 0] * 4.0 + 2.0 == pytest.approx([3.0, 20.0], abs=0.1)


# --- application ------------------------------------------------------------------------------------------------


def network(name, width=WIDTH, published=False, encoding=None, seed=0):
    torch.manual_seed(seed)
    encoding = encoding or Encoding(offset=0.5, scale=0.5)
    method, *architecture = name.split(":")
    net = net_of(recipe_of(method, *architecture), encoding, width)
    return Network(method, width, encoding, (0.1, 0.4), state_of(net), False, published, {}, *architecture)


def map_of(predictor):
    return TemperatureMap("n", predictor.method, predictor, (280.0, 300.0), (7.5, 13.5), 0.2, (0.1, 0.4), "boson-640",
                          260.0, "x")  # fmt: skip


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
@pytest.mark.parametrize("shape", [(1, 1), (37, 300), (256, 256)])
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
