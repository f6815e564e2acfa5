"""How each family of networks takes one step of training, and what it gives when it is applied.

A learner holds its networks and optimisers by name, so that whoever saves, loads, watches or moves them need not know
which family they belong to. Pixels that are not valid count nowhere: a discriminator is shown the generator's own
there.
"""

from typing import ClassVar

import torch
from torch import nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel

# Of the mean of weights: with 8 about the last tenth of the steps counts.
_POWER = 8.0
# Grey levels of `unet-classes`.
LEVELS = 256


class Batch:
    """Crops as tensors: planes (n, c, h, w), target and valid (n, 1, h, w), encoded."""

    def __init__(self, planes, target, valid):
        self.planes, self.target, self.valid = planes, target, valid

    def mean(self, values):
        """Return the mean of (n, 1, h, w) values where they are valid."""
        return (values * self.valid).sum() / self.valid.sum().clamp(min=1.0)


class Learner:
    """What all learners share.

    Attributes
    ----------
    net : nn.Module
        What is trained.
    applied : nn.Module
        What is applied in the end: `net`, unless a learner says otherwise.
    parts : dict of str to nn.Module
        All networks that training needs, `net` as "net" among them.
    optimisers : dict of str to Optimizer
    weight : float
        Of the second loss beside the first.
    """

    # Which of the parts each optimiser moves.
    MOVED: ClassVar = {"net": ("net",)}

    def __init__(self, net, others, optimiser, weight):
        self.net, self.applied, self.weight = net, net, weight
        self.parts = {"net": net, **others}
        self.optimisers = {
            name: optimiser([each for part in parts for each in self.parts[part].parameters()])
            for name, parts in self.MOVED.items()
        }

    def descend(self, name, loss):
        """Let an optimiser take a step down a loss."""
        optimiser = self.optimisers[name]
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        _shared_gradients(optimiser)
        optimiser.step()

    def forward(self, batch):
        """Return the encoded translation of a Batch, (n, 1, h, w)."""
        return self.net(batch.planes).float()

    @staticmethod
    def predict(net, planes):
        """Return a network's translation, (n, 1, h, w), or that and its standard deviation, (n, 2, h, w): encoded."""
        return net(planes).float()


def _shared_gradients(optimiser):
    """Average the gradients over the processes of a data-parallel training."""
    distributed = torch.distributed
    if not (distributed.is_available() and distributed.is_initialized()):
        return
    for group in optimiser.param_groups:
        for parameter in group["params"]:
            if parameter.grad is not None:
                distributed.all_reduce(parameter.grad)
                parameter.grad /= distributed.get_world_size()


class Regression(Learner):
    """A network alone, by mean squared error."""

    def step(self, batch):
        """Take a step; return {name: loss}."""
        loss = batch.mean((self.forward(batch) - batch.target) ** 2)
        self.descend("net", loss)
        return {"mse": loss}


class Classes(Regression):
    """Grey levels as classes of their own, by binary cross-entropy of each."""

    def step(self, batch):
        """Take a step; return {name: loss}."""
        level = (batch.target.clamp(0.0, 1.0) * (LEVELS - 1)).round().long()
        score = self.net(batch.planes).float()
        # Of all classes but the right one softplus(score), of that one softplus(−score) = softplus(score) − score.
        every = functional.softplus(score).sum(dim=1, keepdim=True) - score.gather(1, level)
        loss = batch.mean(every / LEVELS)
        self.descend("net", loss)
        return {"bce": loss}

    @staticmethod
    def predict(net, planes):
        """Return the likeliest grey level, 0…1, (n, 1, h, w)."""
        return net(planes).argmax(dim=1, keepdim=True).float() / (LEVELS - 1)


class Adversarial(Learner):
    """A generator and a discriminator that sees the picture beside its translation: pix2pix.

    Loss of the generator: cross-entropy of being taken for real, plus `weight` times the mean absolute error. That of
    the discriminator is halved, which slows it down beside the generator.
    """

    MOVED: ClassVar = {"net": ("net",), "discriminator": ("discriminator",)}

    def step(self, batch):
        """Take a step of the discriminator, then one of the generator; return {name: loss}."""
        made = self.forward(batch)
        real = torch.where(batch.valid > 0.0, batch.target, made.detach())
        judged = self.parts["discriminator"]
        against = 0.5 * (self.against(judged, batch, real, 1.0) + self.against(judged, batch, made.detach(), 0.0))
        self.descend("discriminator", against)
        judged.requires_grad_(False)
        error = batch.mean((made - batch.target).abs())
        fooled = self.against(judged, batch, made, 1.0)
        self.descend("net", fooled + self.weight * error)
        judged.requires_grad_(True)
        return {"l1": error, "gan": fooled, "discriminator": against}

    @staticmethod
    def against(discriminator, batch, thermal, real):
        """Return the cross-entropy of a judgement and what it should be."""
        judged = discriminator(torch.cat([batch.planes, thermal], dim=1)).float()
        return functional.binary_cross_entropy_with_logits(judged, torch.full_like(judged, real))


class Scaled(Learner):
    """A generator against discriminators at several scales, by least squares and by their features: pix2pixHD.

    Attributes
    ----------
    perceived : Perception or None
        Loss that is added, as much as the features'.
    """

    MOVED: ClassVar = {"net": ("net",), "discriminator": ("discriminator",)}
    perceived = None

    def step(self, batch):
        """Take a step of the generator, then one of the discriminators; return {name: loss}."""
        made = self.forward(batch)
        real = torch.where(batch.valid > 0.0, batch.target, made.detach())
        judges = self.parts["discriminator"].requires_grad_(False)
        seen = self._features(batch, made)
        with torch.no_grad():
            wanted = self._features(batch, real)
        fooled = _squares(seen, 1.0)
        # Every layer but the judgement, the mean over scales.
        alike = sum(
            (a.float() - b.float()).abs().mean() / len(seen)
            for scale, other in zip(seen, wanted, strict=True) for a, b in zip(scale[:-1], other[:-1], strict=True)
        )  # fmt: skip
        loss = fooled + self.weight * alike
        told = {"gan": fooled, "features": alike}
        if self.perceived is not None:
            told["vgg"] = self.perceived(made, real)
            loss = loss + self.weight * told["vgg"]
        self.descend("net", loss)
        judges.requires_grad_(True)
        against = 0.5 * sum(_squares(self._features(batch, each), truth)
                            for each, truth in ((real, 1.0), (made.detach(), 0.0)))  # fmt: skip
        self.descend("discriminator", against)
        return told | {"discriminator": against, "l1": batch.mean((made.detach() - batch.target).abs())}

    def _features(self, batch, thermal):
        return self.parts["discriminator"].features(torch.cat([batch.planes, thermal], dim=1))


def _squares(scales, real):
    return sum(((each[-1].float() - real) ** 2).mean() for each in scales)


class History(nn.Module):
    """The last pictures that a generator made: its discriminator is shown one of them half of the time.

    It is a part of the learner, so that a checkpoint keeps it.
    """

    SIZE = 50

    def __init__(self, channels, side):
        super().__init__()
        self.register_buffer("pictures", torch.zeros(self.SIZE, channels, side, side))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    def forward(self, made):
        """Return a batch of pictures, some of them older ones that the new take the place of."""
        shown = []
        for each in made.detach():
            if self.count < self.SIZE:
                self.pictures[self.count] = each
                self.count += 1
            elif torch.rand(()) < 0.5:
                place = int(torch.randint(self.SIZE, ()))
                older = self.pictures[place].clone()
                self.pictures[place] = each
                each = older
            shown.append(each)
        return torch.stack(shown)


class Cycle(Learner):
    """Two generators that undo each other, each against a discriminator: CycleGAN, which needs no pairs.

    Photographs are the first half of a batch, thermal pictures the second half, of other crops.
    """

    MOVED: ClassVar = {"net": ("net", "back"), "discriminators": ("photographs", "thermals")}

    def step(self, batch):
        """Take a step of the generators, then one of the discriminators; return {name: loss}."""
        net, back, photographs, thermals = (self.parts[name] for name in ("net", "back", "photographs", "thermals"))
        half = len(batch.planes) // 2
        photograph, thermal, valid = batch.planes[:half], batch.target[half:], batch.valid[half:]
        judges = nn.ModuleList([photographs, thermals]).requires_grad_(False)
        made, drawn = net(photograph).float(), back(thermal).float()
        # Where a thermal picture holds nothing, neither is asked for anything.
        again = net(drawn).float()
        cycle = (back(made).float() - photograph).abs().mean() + ((again - thermal).abs() * valid).mean()
        fooled = _square(thermals(made), 1.0) + _square(photographs(drawn), 1.0)
        self.descend("net", fooled + self.weight * cycle)
        judges.requires_grad_(True)
        real = torch.where(valid > 0.0, thermal, again.detach())
        against = 0.5 * sum(
            _square(judge(true), 1.0) + _square(judge(self.parts[f"past {name}"](false)), 0.0)
            for name, judge, true, false in (
                ("thermals", thermals, real, made), ("photographs", photographs, photograph, drawn)
            )
        )  # fmt: skip
        self.descend("discriminators", against)
        return {"cycle": cycle, "gan": fooled, "discriminator": against}


def _square(judged, real):
    return ((judged.float() - real) ** 2).mean()


class Robust(Learner):
    """The compact network: absolute error of values and slopes, and a spread that is fitted to what errors remain.

    Applied is the mean of its weights over the last steps, which errs less than any one of them while the rate is high.
    """

    # Of the slopes beside the values.
    SLOPES = 0.5
    # Greatest length of a step's gradient, of the spread's layer and of all others: each alone, since where the spread
    # is far too small its gradient is many times theirs.
    _MOST = 1.0

    def __init__(self, net, others, optimiser, weight):
        super().__init__(net, others, optimiser, weight)
        self.parts["mean"] = AveragedModel(net, avg_fn=_recent)
        self.applied = self.parts["mean"].module

    def step(self, batch):
        """Take a step; return {name: loss}."""
        mean, spread = self.net(batch.planes)
        error = mean - batch.target
        absolute = batch.mean(error.abs())
        slopes = sum(_slope(error, batch.valid, axis) for axis in (2, 3))
        # Laplace's likelihood of the errors as they are: the spread does not pull at the mean.
        likelihood = batch.mean(error.detach().abs() * torch.exp(-spread) + spread)
        self.descend("net", absolute + self.SLOPES * slopes + likelihood)
        return {"l1": absolute, "slopes": slopes, "likelihood": likelihood}

    def descend(self, name, loss):
        """Let an optimiser take a step down a loss, of bounded length."""
        optimiser = self.optimisers[name]
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        _shared_gradients(optimiser)
        parameters = dict(self.net.named_parameters())
        for doubts in (True, False):
            some = [value for key, value in parameters.items() if key.startswith("doubt.") == doubts]
            nn.utils.clip_grad_norm_(some, self._MOST)
        optimiser.step()
        self.parts["mean"].update_parameters(self.net)

    @staticmethod
    def predict(net, planes):
        """Return the translation and its standard deviation, (n, 2, h, w)."""
        mean, spread = net(planes)
        # Laplace's law of scale b has the standard deviation √2 b.
        return torch.cat([mean, torch.exp(spread) * 2.0**0.5], dim=1)


def _recent(mean, weight, steps):
    """The mean of weights over the last steps, a fixed share of them all: Karras et al., arXiv:2312.02696, eq. 1."""
    return mean + (weight - mean) * (1.0 - (1.0 - 1.0 / (steps + 1.0)) ** _POWER)


def _slope(error, valid, axis):
    """Mean absolute difference of neighbours along an axis, where both are valid."""
    n = valid.shape[axis]
    both = valid.narrow(axis, 1, n - 1) * valid.narrow(axis, 0, n - 1)
    return (error.diff(dim=axis).abs() * both).sum() / both.sum().clamp(min=1.0)
