"""The networks of pix2pix: a U-Net of as many halvings as its square has, and a discriminator that judges patches.

Isola et al., Image-to-Image Translation with Conditional Adversarial Networks, CVPR 2017, arXiv:1611.07004, appendix
6.1. Encoder C64-C128-C256-C512-C512-C512-C512-C512, decoder CD512-CD512-CD512-C512-C256-C128-C64, C being convolution,
batch norm and ReLU, CD the same with half of it dropped out; all convolutions are of 4×4 with stride 2, and each
level's output is handed to the decoder's. The discriminator C64-C128-C256-C512 sees 70×70 pixels at each place.
"""

import torch
from torch import nn

# 256 = 2⁸ pixels shrink to one.
LEVELS = 8
# Decoder levels that drop out, from the innermost but one outwards.
_DROPPED = 3
_DROPOUT = 0.5
_SLOPE = 0.2
# Standard deviation of the weights to begin with; that of batch norm's scales is about 1.
_SPREAD = 0.02


def initialised(net):
    """Return a network with weights drawn as published: normal, of standard deviation 0.02, and no bias."""
    for layer in net.modules():
        if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
            nn.init.normal_(layer.weight, 0.0, _SPREAD)
            if layer.bias is not None:
                nn.init.zeros_(layer.bias)
        elif isinstance(layer, nn.BatchNorm2d):
            nn.init.normal_(layer.weight, 1.0, _SPREAD)
    return net


class UNet256(nn.Module):
    """The generator, for pictures whose sides are multiples of 256 pixels.

    Parameters
    ----------
    channels : int
        Of the input; the output has one, from −1 to 1.
    width : int
        Channels of the outermost level; 64 as published, which makes 54.41 million parameters.
    """

    def __init__(self, channels=3, width=64):
        super().__init__()
        widths = [width * min(2**level, 8) for level in range(LEVELS)]
        self.down, self.up = nn.ModuleList(), nn.ModuleList()
        for level, out in enumerate(widths):
            outermost, innermost = level == 0, level == LEVELS - 1
            before = channels if outermost else widths[level - 1]
            inside = out if innermost else 2 * out
            # A batch of one has no statistics at the innermost level's single pixel.
            normed = not (outermost or innermost)
            self.down.append(nn.Sequential(
                *([] if outermost else [nn.LeakyReLU(_SLOPE)]),
                nn.Conv2d(before, out, 4, 2, 1, bias=False),
                *([nn.BatchNorm2d(out)] if normed else []),
            ))  # fmt: skip
            self.up.append(nn.Sequential(
                nn.ReLU(),
                nn.ConvTranspose2d(inside, 1 if outermost else before, 4, 2, 1, bias=outermost),
                *([] if outermost else [nn.BatchNorm2d(before)]),
                *([nn.Dropout(_DROPOUT)] if LEVELS - 1 - _DROPPED <= level < LEVELS - 1 else []),
            ))  # fmt: skip
        initialised(self)

    def forward(self, x):
        """Return (n, 1, h, w) of (n, channels, h, w)."""
        kept = []
        for layer in self.down:
            x = layer(x)
            kept.append(x)
        x = self.up[-1](kept.pop())
        for layer in reversed(self.up[:-1]):
            x = layer(torch.cat([kept.pop(), x], dim=1))
        return torch.tanh(x)


class PatchDiscriminator(nn.Module):
    """The 70×70 discriminator: of (n, channels, h, w) a number for each place, above 0 where it looks real.

    Parameters
    ----------
    channels : int
        Of the picture and its translation together.
    width : int
        64 as published, which makes 2.77 million parameters.
    norm : type of layer
        nn.BatchNorm2d in pix2pix, nn.InstanceNorm2d in its successors.
    padding : int
        Of every convolution: 1, and 2 in pix2pixHD.
    """

    def __init__(self, channels=4, width=64, norm=nn.BatchNorm2d, padding=1):
        super().__init__()
        widths = [channels, width, 2 * width, 4 * width, 8 * width, 1]
        # Instance norm, as used, has no offset of its own.
        biased = norm is not nn.BatchNorm2d
        self.layers = nn.ModuleList()
        for number, (before, after) in enumerate(zip(widths[:-1], widths[1:], strict=True)):
            first, last = number == 0, after == 1
            conv = nn.Conv2d(before, after, 4, 2 if number < 3 else 1, padding, bias=biased or first or last)
            between = [] if first or last else [norm(after)]
            self.layers.append(nn.Sequential(conv, *between, *([] if last else [nn.LeakyReLU(_SLOPE)])))
        initialised(self)

    def features(self, x):
        """Return the output of every layer, the judgement last."""
        found = []
        for layer in self.layers:
            x = layer(x)
            found.append(x)
        return found

    def forward(self, x):
        """Return the judgement, (n, 1, h', w')."""
        return self.features(x)[-1]
