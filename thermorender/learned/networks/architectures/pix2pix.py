"""The generator of pix2pix: a U-Net that halves its square down to one pixel.

Isola et al., Image-to-Image Translation with Conditional Adversarial Networks, CVPR 2017, arXiv:1611.07004, appendix
6.1. Encoder C64-C128-C256-C512-C512-C512-C512-C512, decoder CD512-CD512-CD512-C512-C256-C128-C64. C is convolution,
batch norm and ReLU; CD also has 50 % dropout. All convolutions are 4×4 with stride 2, with skip connections at each
level.

With seven levels and without biases, it is the generator of Nhu's program (`recipes`): encoder
C64-C128-C256-C512-C512-C512-C512, down to four pixels, and decoder CD512-CD512-CD512-C256-C128-C64.
"""

import torch
from torch import nn

# 256 = 2⁸ pixels shrink to one.
LEVELS = 8
# Decoder levels with dropout, from the outermost, which is 0.
_DROPPED = (4, 5, 6)
_DROPOUT = 0.5
_SLOPE = 0.2
# Standard deviation of initial weights, and of batch norm's initial scales around 1.
_SPREAD = 0.02


def initialised(net: nn.Module) -> nn.Module:
    """Return a network with weights drawn as published: normal with standard deviation 0.02, biases 0."""
    for layer in net.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.normal_(layer.weight, 0.0, _SPREAD)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, nn.BatchNorm2d):
            nn.init.normal_(layer.weight, 1.0, _SPREAD)
    return net


class UNet256(nn.Module):
    """The generator, for pictures whose sides are multiples of 2**levels pixels; its output is from −1 to 1.

    `width` is the number of channels of the outermost level; 64 as published, with 54.41 million parameters. `biased`
    gives the last convolution a bias.
    """

    def __init__(self, channels: int = 3, width: int = 64, levels: int = LEVELS, biased: bool = True) -> None:
        super().__init__()
        widths = [width * min(2**level, 8) for level in range(levels)]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for level, out in enumerate(widths):
            outermost, innermost = level == 0, level == levels - 1
            before = channels if outermost else widths[level - 1]
            inside = out if innermost else 2 * out
            # The innermost level's single pixel has no statistics in a batch of one.
            normed = not (outermost or innermost)
            self.down.append(nn.Sequential(
                *([] if outermost else [nn.LeakyReLU(_SLOPE)]),
                nn.Conv2d(before, out, 4, 2, 1, bias=False),
                *([nn.BatchNorm2d(out)] if normed else []),
            ))  # fmt: skip
            self.up.append(nn.Sequential(
                nn.ReLU(),
                nn.ConvTranspose2d(inside, 1 if outermost else before, 4, 2, 1, bias=outermost and biased),
                *([] if outermost else [nn.BatchNorm2d(before)]),
                *([nn.Dropout(_DROPOUT)] if level in _DROPPED else []),
            ))  # fmt: skip
        initialised(self)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (n, 1, h, w) of (n, channels, h, w)."""
        kept = []
        for layer in self.down:
            x = layer(x)
            kept.append(x)
        x = self.up[-1](kept.pop())
        for layer in reversed(self.up[:-1]):
            x = layer(torch.cat([kept.pop(), x], dim=1))
        return torch.tanh(x)
