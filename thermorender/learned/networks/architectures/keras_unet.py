"""The U-Net of Keras' example for segmenting pictures of pets, which the DLR study used for infrared.

Chollet, Image segmentation with a U-Net-like architecture, keras.io/examples/vision/oxford_pets_image_segmentation
(2019, revised 2020): a strided convolution of 32, three levels of two separable convolutions (64, 128, 256) with
pooling and a residual, four levels of two transposed convolutions (256, 128, 64, 32) with upsampling and a residual.
There are no skip connections from encoder to decoder.
"""

import math
from collections.abc import Callable
from typing import Any

from torch import Tensor, nn

_DOWN = (2, 4, 8)
_UP = (8, 4, 2, 1)
# Keras' batch norm has momentum 0.99, PyTorch's 0.01.
_NORM: dict[str, Any] = {"momentum": 0.01, "eps": 1e-3}
# Keras' "same" padding for strides of two and even sides: right and bottom.
_SAME = (0, 1, 0, 1)
# Four halvings.
MULTIPLE = 16


class KerasUNet(nn.Module):
    """The network, for sides that are multiples of 16 pixels; its output is linear.

    `width` is the number of outermost channels, 32 as published: with 3 classes 2.06 million parameters.
    """

    def __init__(self, channels: int = 3, width: int = 32, out: int = 1) -> None:
        super().__init__()
        self.entry = nn.Sequential(
            nn.ZeroPad2d(_SAME), nn.Conv2d(channels, width, 3, 2), nn.BatchNorm2d(width, **_NORM), nn.ReLU()
        )
        before, self.down, self.up = width, nn.ModuleList(), nn.ModuleList()
        for n in (width * each for each in _DOWN):
            pool = nn.Sequential(nn.ConstantPad2d(_SAME, -math.inf), nn.MaxPool2d(3, 2))
            self.down.append(_Level(before, n, _separable, pool, nn.Conv2d(before, n, 1, 2)))
            before = n
        for n in (width * each for each in _UP):
            self.up.append(_Level(before, n, _transposed, nn.Upsample(scale_factor=2),
                                  nn.Sequential(nn.Upsample(scale_factor=2), nn.Conv2d(before, n, 1))))  # fmt: skip
            before = n
        self.exit = nn.Conv2d(before, out, 3, 1, 1)
        for layer in self.modules():
            # Keras' default.
            if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d):
                nn.init.xavier_uniform_(layer.weight)
                if layer.bias is not None:
                    nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor) -> Tensor:
        """Return (n, out, h, w) of (n, channels, h, w)."""
        x = self.entry(x)
        for level in (*self.down, *self.up):
            x = level(x)
        x = self.exit(x)
        return x


class _Level(nn.Module):
    """Two convolutions, resized, plus a residual."""

    def __init__(
        self, before: int, after: int, convolution: Callable[[int, int], tuple[nn.Module, ...]], resize: nn.Module,
        residual: nn.Module,
    ) -> None:  # fmt: skip
        super().__init__()
        self.layers = nn.Sequential(
            nn.ReLU(), *convolution(before, after), nn.BatchNorm2d(after, **_NORM),
            nn.ReLU(), *convolution(after, after), nn.BatchNorm2d(after, **_NORM), resize,
        )  # fmt: skip
        self.residual = residual

    def forward(self, x: Tensor) -> Tensor:
        """Return (n, after, h', w') of (n, before, h, w)."""
        found: Tensor = self.layers(x) + self.residual(x)
        return found


def _separable(before: int, after: int) -> tuple[nn.Module, ...]:
    return nn.Conv2d(before, before, 3, 1, 1, groups=before, bias=False), nn.Conv2d(before, after, 1)


def _transposed(before: int, after: int) -> tuple[nn.Module, ...]:
    return (nn.ConvTranspose2d(before, after, 3, 1, 1),)
