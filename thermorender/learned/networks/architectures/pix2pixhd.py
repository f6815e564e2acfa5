"""The global generator of pix2pixHD: residual blocks between halvings and doublings.

Wang et al., High-Resolution Image Synthesis and Semantic Manipulation with Conditional GANs, CVPR 2018,
arXiv:1711.11585, section 3.2 and appendix: generator c7s1-64, d128, d256, d512, d1024, nine residual blocks R1024,
u512, u256, u128, u64, c7s1; all with instance norm. With two halvings and R256 it is CycleGAN's generator (Zhu et al.,
ICCV 2017, arXiv:1703.10593, appendix 7.2).
"""

import torch
from torch import nn

from thermorender.learned.networks.architectures.pix2pix import initialised

BLOCKS = 9


class ResidualGenerator(nn.Module):
    """The generator, for pictures whose sides are multiples of 2**halvings pixels; its output is from −1 to 1.

    A width of 64 with four halvings is pix2pixHD's global generator, 182.4 million parameters; 64 with two is
    CycleGAN's, 11.4 million.
    """

    def __init__(self, channels: int = 3, width: int = 64, halvings: int = 4, out: int = 1) -> None:
        super().__init__()
        norm = nn.InstanceNorm2d
        layers: list[nn.Module] = [nn.ReflectionPad2d(3), nn.Conv2d(channels, width, 7), norm(width), nn.ReLU()]
        for level in range(halvings):
            n = width * 2**level
            layers += [nn.Conv2d(n, 2 * n, 3, 2, 1), norm(2 * n), nn.ReLU()]
        layers += [_Residual(width * 2**halvings) for _ in range(BLOCKS)]
        for level in reversed(range(halvings)):
            n = width * 2**level
            layers += [nn.ConvTranspose2d(2 * n, n, 3, 2, 1, output_padding=1), norm(n), nn.ReLU()]
        layers += [nn.ReflectionPad2d(3), nn.Conv2d(width, out, 7)]
        self.layers = initialised(nn.Sequential(*layers))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (n, out, h, w) of (n, channels, h, w)."""
        return torch.tanh(self.layers(x))


class _Residual(nn.Module):
    """x plus two normalised convolutions of it."""

    def __init__(self, width: int) -> None:
        super().__init__()
        first, second = (
            (nn.ReflectionPad2d(1), nn.Conv2d(width, width, 3), nn.InstanceNorm2d(width)) for _ in range(2)
        )
        self.layers = nn.Sequential(*first, nn.ReLU(), *second)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Return (n, width, h, w) of the same shape."""
        found: torch.Tensor = x + self.layers(x)
        return found
