"""Discriminators of pix2pix and its successors, which judge translations in training.

pix2pix (arXiv:1611.07004, appendix 6.1): C64-C128-C256-C512, 4×4 convolutions, with a receptive field of 70×70 pixels.
pix2pixHD (arXiv:1711.11585, section 3.2): the same at two scales, with instance norm.
"""

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from thermorender.learned.networks.architectures.pix2pix import initialised

SCALES = 2
_SLOPE = 0.2


class PatchDiscriminator(nn.Module):
    """The 70×70 discriminator: for (n, channels, h, w) one number per place, above 0 where it looks real.

    `channels` counts picture and translation together. Width 64 is published, with 2.77 million parameters. Successors
    of pix2pix use nn.InstanceNorm2d; pix2pixHD pads by 2. `biased` adds a bias to convolutions without batch norm.
    """

    def __init__(
        self, channels: int = 4, width: int = 64, norm: type[nn.Module] = nn.BatchNorm2d, padding: int = 1,
        biased: bool = True,
    ) -> None:  # fmt: skip
        super().__init__()
        widths = [channels, width, 2 * width, 4 * width, 8 * width, 1]
        # Instance norm has no offset here.
        plain = norm is not nn.BatchNorm2d
        self.layers = nn.ModuleList()
        for number, (before, after) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            first, last = number == 0, after == 1
            conv = nn.Conv2d(
                before, after, 4, 2 if number < 3 else 1, padding, bias=biased and (plain or first or last)
            )
            between = [] if first or last else [norm(after)]
            self.layers.append(nn.Sequential(conv, *between, *([] if last else [nn.LeakyReLU(_SLOPE)])))
        initialised(self)

    def features(self, x: torch.Tensor) -> list[torch.Tensor]:
        """Return the output of every layer, the judgement last."""
        found = []
        for layer in self.layers:
            x = layer(x)
            found.append(x)
        return found

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return the judgement, (n, 1, h', w')."""
        return self.features(x)[-1]


class ScaledDiscriminators(nn.Module):
    """Patch discriminators of the picture at full and half size: 5.5 million parameters at width 64."""

    def __init__(self, channels: int = 4, width: int = 64) -> None:
        super().__init__()
        self.scales = nn.ModuleList(PatchDiscriminator(channels, width, nn.InstanceNorm2d, 2) for _ in range(SCALES))

    def features(self, x: torch.Tensor) -> list[list[torch.Tensor]]:
        """Return the output of every layer, for each scale."""
        found = []
        each: Any
        for each in self.scales:
            found.append(each.features(x))
            x = functional.avg_pool2d(x, 3, 2, 1, count_include_pad=False)
        return found
