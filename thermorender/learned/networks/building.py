"""Building of a recipe's networks and learner."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import torch
from torch import nn

from thermorender.learned.networks import learners
from thermorender.learned.networks.architectures.compact import Compact
from thermorender.learned.networks.architectures.keras_unet import KerasUNet
from thermorender.learned.networks.architectures.pix2pix import PatchDiscriminator, UNet256
from thermorender.learned.networks.architectures.pix2pixhd import ResidualGenerator, ScaledDiscriminators
from thermorender.learned.networks.architectures.plain import Autoencoder, Dense

if TYPE_CHECKING:
    from thermorender.learned.networks.encoding import Encoding
    from thermorender.learned.networks.recipes import Recipe

# Width of the published discriminators.
_JUDGE = 64
# CycleGAN's generator has two halvings, pix2pixHD's four.
_CYCLE_HALVINGS = 2
_NETS = {
    "autoencoder": lambda encoding, width: Autoencoder(encoding.channels, width),
    "dense": lambda encoding, width: Dense(encoding.channels, width),
    "keras_unet": lambda encoding, width: KerasUNet(encoding.channels, width),
    "keras_unet_classes": lambda encoding, width: KerasUNet(encoding.channels, width, learners.LEVELS),
    "unet256": lambda encoding, width: UNet256(encoding.channels, width),
    "unet256_seven": lambda encoding, width: UNet256(encoding.channels, width, levels=7, biased=False),
    "pix2pixhd": lambda encoding, width: ResidualGenerator(encoding.channels, width),
    "cyclegan": lambda encoding, width: ResidualGenerator(encoding.channels, width, _CYCLE_HALVINGS),
    "compact": lambda encoding, width: Compact(encoding.channels, width, encoding.mixed),
}
_OPTIMISERS = {"adam": torch.optim.Adam, "nadam": torch.optim.NAdam, "adamw": torch.optim.AdamW}
_KINDS = {
    "regression": learners.Regression, "classes": learners.Classes, "adversarial": learners.Adversarial,
    "summed": learners.Summed, "scales": learners.Scaled, "cycle": learners.Cycle, "robust": learners.Robust,
}  # fmt: skip


def kind_of(recipe: Recipe) -> type[learners.Learner]:
    """Return the class of a Recipe's Learner."""
    return _KINDS[recipe.learner]


def net_of(recipe: Recipe, encoding: Encoding, width: int) -> nn.Module:
    """Return the network that a Recipe trains and applies, with initial weights."""
    return _NETS[recipe.net](encoding, width)


def learner_of(recipe: Recipe, encoding: Encoding, width: int, rate: float) -> learners.Learner:
    """Return the Learner of a Recipe."""
    net, seen = net_of(recipe, encoding, width), encoding.channels
    kind, others = kind_of(recipe), {}
    # 64 with a generator of full width, and proportionally narrower with a narrower one.
    beside = max(8, _JUDGE * width // recipe.width)
    if issubclass(kind, learners.Adversarial):
        others = {"discriminator": PatchDiscriminator(seen + 1, beside, biased=kind is not learners.Summed)}
    elif kind is learners.Scaled:
        others = {"discriminator": ScaledDiscriminators(seen + 1, beside)}
    elif kind is learners.Cycle:
        judges = (PatchDiscriminator(n, beside, nn.InstanceNorm2d) for n in (seen, 1))
        back = ResidualGenerator(1, width, _CYCLE_HALVINGS, seen)
        pasts = (learners.History(n, recipe.side) for n in (seen, 1))
        names = ("photographs", "thermals", "past photographs", "past thermals")
        others = {"back": back, **dict(zip(names, (*judges, *pasts), strict=True))}
    return kind(net, others, partial(_OPTIMISERS[recipe.optimiser], lr=rate, betas=recipe.betas), recipe.weight)
