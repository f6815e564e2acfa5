"""Training step of each family of networks.

A learner holds its networks and optimisers by name. At invalid pixels a discriminator sees the generator's own output.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, ClassVar

import torch
from torch import nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel

from thermorender.apps.training.networks.discriminators import PatchDiscriminator, ScaledDiscriminators
from thermorender.apps.training.networks.perception import Perception
from thermorender.learned.networks.architectures.pix2pixhd import ResidualGenerator
from thermorender.learned.networks.building import CYCLE_HALVINGS, LEVELS, net_of
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.recipes import Recipe

# Exponent of the mean of weights: with 8, about the last tenth of the steps counts.
_POWER = 8.0
# Width of the published discriminators.
_JUDGE = 64


Optimiser = Callable[[Iterable[nn.Parameter]], torch.optim.Optimizer]


class Batch:
    """Crops as tensors: planes (n, c, h, w), target and valid (n, 1, h, w), encoded."""

    def __init__(self, planes: torch.Tensor, target: torch.Tensor, valid: torch.Tensor) -> None:
        self.planes, self.target, self.valid = planes, target, valid

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        """Return the mean of (n, 1, h, w) values over valid pixels."""
        return (values * self.valid).sum() / self.valid.sum().clamp(min=1.0)


class Learner(ABC):
    """Base class of all learners."""

    # Parts that each optimiser updates.
    MOVED: ClassVar[dict[str, tuple[str, ...]]] = {"net": ("net",)}

    def __init__(
        self, net: nn.Module, others: dict[str, nn.Module], optimiser: Optimiser, weight: float
    ) -> None:  # fmt: skip
        self.net = net  # The network to train
        self.applied = net  # The network to apply after training
        self.weight = weight  # Weight of the second loss; the first has 1
        self.parts = {"net": net, **others}  # All networks of the training
        self.optimisers = {
            name: optimiser([each for part in parts for each in self.parts[part].parameters()])
            for name, parts in self.MOVED.items()
        }

    @abstractmethod
    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step on a Batch; return {name: loss}."""

    def descend(self, name: str, loss: torch.Tensor) -> None:
        """Take a step of one optimiser."""
        optimiser = self.optimisers[name]
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        _shared_gradients(optimiser)
        self.limit()
        optimiser.step()

    def limit(self) -> None:  # noqa: B027 - most learners have no limit
        """Limit the gradients of a step."""

    def forward(self, batch: Batch) -> torch.Tensor:
        """Return the encoded translation of a Batch, (n, 1, h, w)."""
        found: torch.Tensor = self.net(batch.planes)
        return found.float()


def _shared_gradients(optimiser: torch.optim.Optimizer) -> None:
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
    """A single network, by mean squared error."""

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step."""
        loss = batch.mean((self.forward(batch) - batch.target) ** 2)
        self.descend("net", loss)
        return {"mse": loss}


class Classes(Regression):
    """Grey levels as classes, by binary cross-entropy of each."""

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step."""
        level = (batch.target.clamp(0.0, 1.0) * (LEVELS - 1)).round().long()
        score = self.net(batch.planes).float()
        # softplus(score) for wrong classes, and softplus(−score) = softplus(score) − score for the right one.
        every = functional.softplus(score).sum(dim=1, keepdim=True) - score.gather(1, level)
        loss = batch.mean(every / LEVELS)
        self.descend("net", loss)
        return {"bce": loss}


class Adversarial(Learner):
    """pix2pix: a generator, and a discriminator that sees both picture and translation.

    The generator's loss is the cross-entropy of being judged real plus `weight` times the mean absolute error; the
    discriminator's loss is halved.
    """

    MOVED: ClassVar = {"net": ("net",), "discriminator": ("discriminator",)}

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step of the discriminator, then of the generator."""
        made = self.forward(batch)
        against = self.judge(batch, made.detach())
        return {**self.fool(batch, made, 1.0), "discriminator": against}

    def judge(self, batch: Batch, made: torch.Tensor) -> torch.Tensor:
        """Take a step of the discriminator on translations of a Batch; return its loss."""
        real = torch.where(batch.valid > 0.0, batch.target, made)
        judged = self.parts["discriminator"]
        against = 0.5 * (self.against(judged, batch, real, 1.0) + self.against(judged, batch, made, 0.0))
        self.descend("discriminator", against)
        return against

    def fool(self, batch: Batch, made: torch.Tensor, count: torch.Tensor | float) -> dict[str, torch.Tensor]:
        """Take a step of the generator, whose absolute error counts as `count` times its mean; return {name: loss}."""
        judged = self.parts["discriminator"].requires_grad_(False)
        error = batch.mean((made - batch.target).abs())
        fooled = self.against(judged, batch, made, 1.0)
        self.descend("net", fooled + self.weight * count * error)
        judged.requires_grad_(True)
        return {"l1": error, "gan": fooled}

    @staticmethod
    def against(discriminator: nn.Module, batch: Batch, thermal: torch.Tensor, real: float) -> torch.Tensor:
        """Return the cross-entropy of the discriminator's judgement for the label `real`, 0 or 1."""
        judged = discriminator(torch.cat([batch.planes, thermal], dim=1)).float()
        return functional.binary_cross_entropy_with_logits(judged, torch.full_like(judged, real))


class Summed(Adversarial):
    """As Nhu's program: two generator steps per discriminator step, and absolute errors summed over 256² pixels."""

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step of the discriminator, then two of the generator."""
        with torch.no_grad():
            made = self.forward(batch)
        against, fooled = self.judge(batch, made), {}
        for _ in range(2):
            fooled = self.fool(batch, self.forward(batch), batch.valid.sum())
        return {**fooled, "discriminator": against}


class Scaled(Learner):
    """A generator and discriminators at several scales, by least squares and feature matching: pix2pixHD."""

    MOVED: ClassVar = {"net": ("net",), "discriminator": ("discriminator",)}
    perceived: Perception | None = None  # Perceptual loss, with the weight of feature matching

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step of the generator, then of the discriminators."""
        made = self.forward(batch)
        real = torch.where(batch.valid > 0.0, batch.target, made.detach())
        judges = self.parts["discriminator"].requires_grad_(False)
        seen = self._features(batch, made)
        with torch.no_grad():
            wanted = self._features(batch, real)
        fooled = _squares(seen, 1.0)
        # All layers but the judgement, averaged over scales.
        alike = sum(
            (a.float() - b.float()).abs().mean() / len(seen)
            for scale, other in zip(seen, wanted, strict=True) for a, b in zip(scale[:-1], other[:-1], strict=True)
        )  # fmt: skip
        loss = fooled + self.weight * alike
        losses = {"gan": fooled, "features": alike}
        if self.perceived is not None:
            losses["vgg"] = self.perceived(made, real)
            loss = loss + self.weight * losses["vgg"]
        self.descend("net", loss)
        judges.requires_grad_(True)
        against = 0.5 * sum(_squares(self._features(batch, each), truth)
                            for each, truth in ((real, 1.0), (made.detach(), 0.0)))  # fmt: skip
        self.descend("discriminator", against)
        return losses | {"discriminator": against, "l1": batch.mean((made.detach() - batch.target).abs())}

    def _features(self, batch: Batch, thermal: torch.Tensor) -> list[list[torch.Tensor]]:
        judges: Any = self.parts["discriminator"]
        found: list[list[torch.Tensor]] = judges.features(torch.cat([batch.planes, thermal], dim=1))
        return found


def _squares(scales: list[list[torch.Tensor]], real: float) -> Any:
    """Sum over scales of the mean squared difference between judgements and a label."""
    return sum(((each[-1].float() - real) ** 2).mean() for each in scales)


class History(nn.Module):
    """Buffer of a generator's last pictures, one of which replaces a discriminator's input half of the time."""

    SIZE = 50
    pictures: torch.Tensor
    count: torch.Tensor

    def __init__(self, channels: int, side: int) -> None:
        super().__init__()
        self.register_buffer("pictures", torch.zeros(self.SIZE, channels, side, side))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    def forward(self, made: torch.Tensor) -> torch.Tensor:
        """Return a batch in which older pictures replace some of the new ones."""
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
    """CycleGAN: two inverse generators, each with a discriminator, trained without pairs.

    Photographs come from the first half of a batch, thermal pictures from the second half, which are other crops.
    """

    MOVED: ClassVar = {"net": ("net", "back"), "discriminators": ("photographs", "thermals")}

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step of the generators, then of the discriminators."""
        net, back, photographs, thermals = (self.parts[name] for name in ("net", "back", "photographs", "thermals"))
        half = len(batch.planes) // 2
        photograph, thermal, valid = batch.planes[:half], batch.target[half:], batch.valid[half:]
        judges = nn.ModuleList([photographs, thermals]).requires_grad_(False)
        made, drawn = net(photograph).float(), back(thermal).float()
        # Invalid thermal pixels do not count.
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
        self.descend("discriminators", torch.as_tensor(against))
        return {"cycle": cycle, "gan": fooled, "discriminator": torch.as_tensor(against)}


def _square(judged: torch.Tensor, real: float) -> torch.Tensor:
    """Mean squared difference between judgements and a label."""
    return ((judged.float() - real) ** 2).mean()


class Robust(Learner):
    """The compact network: absolute error of values and slopes, and a spread that is fitted to the remaining errors.

    The applied network has the mean of the weights over the last steps, which is more accurate than the weights of any
    single step.
    """

    # Weight of the slopes; values have 1.
    SLOPES = 0.5
    # Greatest gradient norm, for the spread's layer and for all others separately: the gradient of a spread that is far
    # too small is many times theirs.
    _MOST = 1.0

    def __init__(
        self, net: nn.Module, others: dict[str, nn.Module], optimiser: Optimiser, weight: float
    ) -> None:  # fmt: skip
        super().__init__(net, others, optimiser, weight)
        self._mean = self.parts["mean"] = AveragedModel(net, avg_fn=_recent)
        self.applied = self._mean.module

    def step(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Take a step."""
        mean, spread = self.net(batch.planes)
        error = mean - batch.target
        absolute = batch.mean(error.abs())
        slopes = _slope(error, batch.valid, 2) + _slope(error, batch.valid, 3)
        # Laplace likelihood of the detached errors: the spread does not influence the mean.
        likelihood = batch.mean(error.detach().abs() * torch.exp(-spread) + spread)
        self.descend("net", absolute + self.SLOPES * slopes + likelihood)
        return {"l1": absolute, "slopes": slopes, "likelihood": likelihood}

    def limit(self) -> None:
        """Limit the gradient norm of the spread's layer, and that of all others."""
        parameters = dict(self.net.named_parameters())
        for doubts in (True, False):
            some = [value for key, value in parameters.items() if key.startswith("doubt.") == doubts]
            nn.utils.clip_grad_norm_(some, self._MOST)

    def descend(self, name: str, loss: torch.Tensor) -> None:
        """Take a step of one optimiser, and update the mean of the weights."""
        super().descend(name, loss)
        self._mean.update_parameters(self.net)


def _recent(mean: torch.Tensor, weight: torch.Tensor, steps: torch.Tensor | int) -> torch.Tensor:
    """Mean of weights over the last steps, a fixed share of all: Karras et al., arXiv:2312.02696, eq. 1."""
    return mean + (weight - mean) * (1.0 - (1.0 - 1.0 / (steps + 1.0)) ** _POWER)


def _slope(error: torch.Tensor, valid: torch.Tensor, axis: int) -> torch.Tensor:
    """Mean absolute difference of valid neighbours along an axis."""
    n = valid.shape[axis]
    both = valid.narrow(axis, 1, n - 1) * valid.narrow(axis, 0, n - 1)
    return (error.diff(dim=axis).abs() * both).sum() / both.sum().clamp(min=1.0)


_OPTIMISERS = {"adam": torch.optim.Adam, "nadam": torch.optim.NAdam, "adamw": torch.optim.AdamW}
_KINDS: dict[str, type[Learner]] = {
    "regression": Regression, "classes": Classes, "adversarial": Adversarial, "summed": Summed, "scales": Scaled,
    "cycle": Cycle, "robust": Robust,
}  # fmt: skip


def learner_of(recipe: Recipe, encoding: Encoding, width: int, rate: float) -> Learner:
    """Return the Learner of a Recipe, with initial weights."""
    net, seen = net_of(recipe, encoding, width), encoding.channels
    kind = _KINDS[recipe.learner]
    others: dict[str, nn.Module] = {}
    # 64 with a generator of full width, and proportionally narrower with a narrower one.
    beside = max(8, _JUDGE * width // recipe.width)
    if issubclass(kind, Adversarial):
        others = {"discriminator": PatchDiscriminator(seen + 1, beside, biased=kind is not Summed)}
    elif kind is Scaled:
        others = {"discriminator": ScaledDiscriminators(seen + 1, beside)}
    elif kind is Cycle:
        judges = (PatchDiscriminator(n, beside, nn.InstanceNorm2d) for n in (seen, 1))
        back = ResidualGenerator(1, width, CYCLE_HALVINGS, seen)
        pasts = (History(n, recipe.side) for n in (seen, 1))
        names = ("photographs", "thermals", "past photographs", "past thermals")
        others = {"back": back, **dict(zip(names, [*judges, *pasts], strict=True))}
    optimiser = partial(_OPTIMISERS[recipe.optimiser], lr=rate, betas=recipe.betas)
    return kind(net, others, optimiser, recipe.weight)
