"""A compact network: all convolutions at a quarter of the resolution and below, kelvin and their spread in one pass.

Blocks of 4×4 pixels become channels, so nothing is lost and sixteen times fewer places are worked on; a U-Net of
residual blocks runs there, and its last channels become pixels again. Where relief and weather are known, what it gives
is added to a mixture of temperatures whose shares it chooses for each pixel: those of typical materials, as the heat
balance has them here, and that of a linear map, with which it begins. There is no norm over the picture, so a part of
it that is cut at multiples of 16 pixels gives the same as the whole, but for the reach of the convolutions.
"""

import torch
from torch import nn
from torch.nn import functional

BLOCK = 4
# Residual blocks of each level on the way down; on the way up there is one.
_BLOCKS = (2, 2, 2)
_WIDER = (1, 2, 4)
# Of the last block at the bottom, so that a pixel sees about 250 around it.
_DILATION = 4
# Sides that it takes are multiples of this [pixels].
MULTIPLE = BLOCK * 2 ** (len(_WIDER) - 1)
# The last temperature's share to begin with is that of this logit, the others' 0.
_BEGINNING = 4.0
# Logarithm of the least and greatest spread, in units of the target's scale.
_LOG_SPREAD = (-6.0, 4.0)


class Compact(nn.Module):
    """The network.

    Parameters
    ----------
    channels : int
        Of the picture, and of the planes that are given with it.
    width : int
        Channels at a quarter of the resolution.
    mixed : int
        Temperatures whose mixture is added, the last of the planes; 0: none. It begins with the very last.
    """

    def __init__(self, channels, width, mixed=0):
        super().__init__()
        self.mixed = mixed
        widths = [width * each for each in _WIDER]
        self.entry = nn.Conv2d(channels * BLOCK**2, width, 3, padding=1)
        self.down = nn.ModuleList(
            nn.ModuleList(_Residual(n) for _ in range(blocks))
            for n, blocks in zip(widths, _BLOCKS, strict=True)
        )
        self.down[-1][-1] = _Residual(widths[-1], _DILATION)
        self.narrow = nn.ModuleList(
            nn.Conv2d(before, after, 2, 2) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        self.wide = nn.ModuleList(
            nn.Conv2d(after, 4 * before, 1) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        self.up = nn.ModuleList(_Residual(n) for n in widths[:-1])
        # Of each pixel: what is added and the shares of the mixture; and the logarithm of the spread.
        self.exit = nn.Conv2d(width, (1 + mixed) * BLOCK**2, 3, padding=1)
        self.doubt = nn.Conv2d(width, BLOCK**2, 3, padding=1)
        for layer in (self.exit, self.doubt):
            nn.init.zeros_(layer.bias)
            nn.init.normal_(layer.weight, 0.0, 1e-3)
        if mixed:
            nn.init.constant_(self.exit.bias[-(BLOCK**2) :], _BEGINNING)

    def forward(self, planes):
        """Return (mean, logarithm of the spread), (n, 1, h, w) each, of (n, channels, h, w)."""
        x = self.entry(functional.pixel_unshuffle(planes, BLOCK))
        kept = []
        for level, blocks in enumerate(self.down):
            if level:
                kept.append(x)
                x = self.narrow[level - 1](x)
            for block in blocks:
                x = block(x)
        for level in reversed(range(len(self.up))):
            x = functional.pixel_shuffle(self.wide[level](x), 2) + kept.pop()
            x = self.up[level](x)
        # How much it doubts is read from what it sees, and has no say in what it looks at.
        spread = functional.pixel_shuffle(self.doubt(x.detach()), BLOCK).float().clamp(*_LOG_SPREAD)
        x = functional.pixel_shuffle(self.exit(x), BLOCK).float()
        mean = x[:, :1]
        if self.mixed:
            shares = torch.softmax(x[:, 1:], dim=1)
            mean = mean + (shares * planes[:, -self.mixed :].float()).sum(dim=1, keepdim=True)
        return mean, spread


class _Residual(nn.Module):
    """x + what two convolutions make of it."""

    def __init__(self, width, dilation=1):
        super().__init__()
        self.first, self.second = (nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation) for _ in range(2))
        # It begins as nothing, so that depth costs no care.
        nn.init.zeros_(self.second.weight)
        nn.init.zeros_(self.second.bias)

    def forward(self, x):
        return x + self.second(functional.silu(self.first(functional.silu(x))))
