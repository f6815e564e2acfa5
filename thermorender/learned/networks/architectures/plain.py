"""The two networks that the DLR study found wanting: an autoencoder, and one that joins every pixel to every other.

Neither is specified there beyond its name. The autoencoder is the U-Net of pix2pix down to 16 pixels a side, without
the connections across; the other has one hidden layer, whose size is swept to show what it costs.
"""

from torch import nn

from thermorender.learned.networks.architectures.pix2pix import initialised

HALVINGS = 4


class Autoencoder(nn.Module):
    """Convolutions down to a narrow middle and back, for pictures whose sides are multiples of 16 pixels.

    Parameters
    ----------
    channels : int
        Of the input; the output has one, linear.
    width : int
        Channels of the outermost level.
    """

    def __init__(self, channels=3, width=64):
        super().__init__()
        widths = [channels, *(width * 2**level for level in range(HALVINGS))]
        layers = []
        for before, after in zip(widths[:-1], widths[1:], strict=True):
            layers += [nn.Conv2d(before, after, 4, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        for before, after in zip(widths[:1:-1], widths[-2:0:-1], strict=True):
            layers += [nn.ConvTranspose2d(before, after, 4, 2, 1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
        layers.append(nn.ConvTranspose2d(width, 1, 4, 2, 1))
        self.layers = initialised(nn.Sequential(*layers))

    def forward(self, x):
        """Return (n, 1, h, w) of (n, channels, h, w)."""
        return self.layers(x)


class Dense(nn.Module):
    """Every pixel joined to every other through one hidden layer, for squares of one size.

    Parameters
    ----------
    channels : int
    hidden : int
        Size of the hidden layer.
    side : int
        Of the square [pixels].
    """

    def __init__(self, channels=3, hidden=1024, side=64):
        super().__init__()
        self.side = side
        pixels = side * side
        self.layers = nn.Sequential(nn.Linear(channels * pixels, hidden), nn.ReLU(), nn.Linear(hidden, pixels))

    def forward(self, x):
        """Return (n, 1, side, side) of (n, channels, side, side)."""
        return self.layers(x.flatten(1)).view(-1, 1, self.side, self.side)
