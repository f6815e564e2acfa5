"""One step of each learner against a few lines written here, and the perceptual loss."""

import copy

import pytest
import torch
from torch import nn
from torch.nn import functional
from training_support import WIDTH

from thermorender.apps.training.networks import learners
from thermorender.apps.training.networks.learners import learner_of
from thermorender.apps.training.networks.perception import Perception
from thermorender.errors import ThermorenderError
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.recipes import recipe_of


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
