"""A compact network: all convolutions at a quarter of the resolution and below, kelvin and their spread in one pass.

Blocks of 4×4 pixels become channels of a residual U-Net, and channels become pixels again. With relief and weather, the
output is added to a mixture, with shares per pixel, of the heat balance's typical temperatures and a linear base, with
which training starts. Without normalisation over the picture, a part cut at multiples of 16 pixels gives the same
result as the whole, except within the reach of the convolutions.
"""

from typing import Any

import torch
from torch import nn
from torch.nn import functional

BLOCK = 4
# Residual blocks of each level of the encoder; the decoder has one per level.
_BLOCKS = (2, 2, 2)
_WIDER = (1, 2, 4)
# Dilation of the deepest block, which gives a receptive field of about 250 pixels.
_DILATION = 4
# Sides of its input are multiples of this [pixels].
MULTIPLE = BLOCK * 2 ** (len(_WIDER) - 1)
# Initial logit of the last temperature's share; those of the others are 0.
_BEGINNING = 4.0
# Logarithm of the least and greatest spread, in units of the target's scale.
_LOG_SPREAD = (-6.0, 4.0)


class Compact(nn.Module):
    """The network, of `width` channels at a quarter of the resolution.

    The last `mixed` planes of the input are the temperatures to mix; training starts with the very last.
    """

    def __init__(self, channels: int, width: int, mixed: int = 0) -> None:
        super().__init__()
        self.mixed = mixed
        widths = [width * each for each in _WIDER]
        self.entry = nn.Conv2d(channels * BLOCK**2, width, 3, padding=1)
        down = [
            nn.ModuleList(_PreActivationBlock(n) for _ in range(blocks))
            for n, blocks in zip(widths, _BLOCKS, strict=True)
        ]
        down[-1][-1] = _PreActivationBlock(widths[-1], _DILATION)
        self.down = nn.ModuleList(down)
        self.narrow = nn.ModuleList(
            nn.Conv2d(before, after, 2, 2) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        self.wide = nn.ModuleList(
            nn.Conv2d(after, 4 * before, 1) for before, after in zip(widths[:-1], widths[1:], strict=True)
        )
        self.up = nn.ModuleList(_PreActivationBlock(n) for n in widths[:-1])
        # For each pixel the offset and the mixture's shares; and the logarithm of the spread.
        self.exit = nn.Conv2d(width, (1 + mixed) * BLOCK**2, 3, padding=1)
        self.doubt = nn.Conv2d(width, BLOCK**2, 3, padding=1)
        for layer in (self.exit, self.doubt):
            assert layer.bias is not None
            nn.init.zeros_(layer.bias)
            nn.init.normal_(layer.weight, 0.0, 1e-3)
        if mixed:
            assert self.exit.bias is not None
            nn.init.constant_(self.exit.bias[-(BLOCK**2) :], _BEGINNING)

    def forward(self, planes: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return (mean, logarithm of the spread), (n, 1, h, w) each, of (n, channels, h, w)."""
        x = self.entry(functional.pixel_unshuffle(planes, BLOCK))
        kept = []
        blocks: Any
        for level, blocks in enumerate(self.down):
            if level:
                kept.append(x)
                x = self.narrow[level - 1](x)
            for block in blocks:
                x = block(x)
        for level in reversed(range(len(self.up))):
            x = functional.pixel_shuffle(self.wide[level](x), 2) + kept.pop()
            x = self.up[level](x)
        # Detached: the spread does not influence the features.
        spread = functional.pixel_shuffle(self.doubt(x.detach()), BLOCK).float().clamp(*_LOG_SPREAD)
        x = functional.pixel_shuffle(self.exit(x), BLOCK).float()
        mean = x[:, :1]
        if self.mixed:
            shares = torch.softmax(x[:, 1:], dim=1)
            mean = mean + (shares * planes[:, -self.mixed :].float()).sum(dim=1, keepdim=True)
        return mean, spread


class _PreActivationBlock(nn.Module):
    """x plus two convolutions of it."""

    def __init__(self, width: int, dilation: int = 1) -> None:
        super().__init__()
        self.first, self.second = (nn.Conv2d(width, width, 3, padding=dilation, dilation=dilation) for _ in range(2))
        # It starts as the identity, so that deep networks train well.
        for parameter in self.second.parameters():
            nn.init.zeros_(parameter)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (n, width, h, w) of the same shape."""
        return x + self.second(functional.silu(self.first(functional.silu(x))))
