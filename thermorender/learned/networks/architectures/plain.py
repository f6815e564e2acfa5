"""The two networks that did not converge in the DLR study: an autoencoder and a fully connected network.

The study gives only their names. The autoencoder is the U-Net of pix2pix down to 16 pixels a side, without skip
connections; the other has one hidden layer of chosen size.
"""

from torch import Tensor, nn

from thermorender.learned.networks.architectures.pix2pix import initialised

HALVINGS = 4


class Autoencoder(nn.Module):
    """A convolutional autoencoder of outer `width` for sides that are multiples of 16 pixels; its output is linear."""

    def __init__(self, channels: int = 3, width: int = 64) -> None:
        super().__init__()
        widths = [channels, *(width * 2**level for level in range(HALVINGS))]
        layers = []
        for before, after in zip(widths[:-1], widths[1:], strict=True):
            layers += [nn.Conv2d(before, after, 4, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        for before, after in zip(widths[:1:-1], widths[-2:0:-1], strict=True):
            layers += [nn.ConvTranspose2d(before, after, 4, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        layers.append(nn.ConvTranspose2d(width, 1, 4, 2, 1))
        self.layers = initialised(nn.Sequential(*layers))

    def forward(self, x: Tensor) -> Tensor:
        """Return (n, 1, h, w) of (n, channels, h, w)."""
        return self.layers(x)


class Dense(nn.Module):
    """A fully connected network with one hidden layer, for squares of `side` pixels."""

    def __init__(self, channels: int = 3, hidden: int = 1024, side: int = 64) -> None:
        super().__init__()
        self.side = side
        pixels = side * side
        self.layers = nn.Sequential(nn.Linear(channels * pixels, hidden), nn.ReLU(), nn.Linear(hidden, pixels))

    def forward(self, x: Tensor) -> Tensor:
        """Return (n, 1, side, side) of (n, channels, side, side)."""
        return self.layers(x.flatten(1)).view(-1, 1, self.side, self.side)
