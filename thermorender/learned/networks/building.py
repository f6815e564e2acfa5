"""Building of a recipe's network, and what its output means."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import nn

from thermorender.learned.networks.architectures.compact import Compact
from thermorender.learned.networks.architectures.keras_unet import KerasUNet
from thermorender.learned.networks.architectures.pix2pix import UNet256
from thermorender.learned.networks.architectures.pix2pixhd import ResidualGenerator
from thermorender.learned.networks.architectures.plain import Autoencoder, Dense

if TYPE_CHECKING:
    from thermorender.learned.networks.encoding import Encoding
    from thermorender.learned.networks.recipes import Recipe

# Grey levels of `unet-classes`.
LEVELS = 256
# CycleGAN's generator has two halvings, pix2pixHD's four.
CYCLE_HALVINGS = 2
_NETS: dict[str, Callable[[Encoding, int], nn.Module]] = {
    "autoencoder": lambda encoding, width: Autoencoder(encoding.channels, width),
    "dense": lambda encoding, width: Dense(encoding.channels, width),
    "keras_unet": lambda encoding, width: KerasUNet(encoding.channels, width),
    "keras_unet_classes": lambda encoding, width: KerasUNet(encoding.channels, width, LEVELS),
    "unet256": lambda encoding, width: UNet256(encoding.channels, width),
    "unet256_seven": lambda encoding, width: UNet256(encoding.channels, width, levels=7, biased=False),
    "pix2pixhd": lambda encoding, width: ResidualGenerator(encoding.channels, width),
    "cyclegan": lambda encoding, width: ResidualGenerator(encoding.channels, width, CYCLE_HALVINGS),
    "compact": lambda encoding, width: Compact(encoding.channels, width, encoding.mixed),
}


def net_of(recipe: Recipe, encoding: Encoding, width: int) -> nn.Module:
    """Return the network that a Recipe trains and applies, with initial weights."""
    return _NETS[recipe.net](encoding, width)


def predicted(recipe: Recipe, net: nn.Module, planes: torch.Tensor) -> torch.Tensor:
    """Return the encoded translation of planes (n, c, h, w): (n, 1, h, w), or (n, 2, h, w) with standard deviation."""
    found = net(planes)
    if recipe.learner == "classes":
        # The likeliest grey level, 0…1.
        return found.argmax(dim=1, keepdim=True).float() / (LEVELS - 1)
    if recipe.learner == "robust":
        mean, spread = found
        # The Laplace distribution of scale b has standard deviation √2 b.
        return torch.cat([mean, torch.exp(spread) * 2.0**0.5], dim=1)
    return found.float()
