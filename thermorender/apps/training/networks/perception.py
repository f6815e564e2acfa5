"""Perceptual loss of pix2pixHD: the difference of two pictures in the features of a classification network.

Johnson et al., ECCV 2016, arXiv:1603.08155, with the layers and weights of pix2pixHD (Wang et al., arXiv:1711.11585,
section 3.3): relu1_1 to relu5_1 of VGG-19 by 1/32, 1/16, 1/8, 1/4 and 1. The network's weights are not shipped.
"""

import torch
from torch import nn

from thermorender.errors import ThermorenderError
from thermorender.files import PathLike

# Channels of VGG-19's convolutions up to relu5_1; 0 is a pooling.
_LAYERS = (64, 64, 0, 128, 128, 0, 256, 256, 256, 256, 0, 512, 512, 512, 512, 0, 512)
# {index of a compared layer: its weight}.
_COMPARED = {1: 1.0 / 32.0, 6: 1.0 / 16.0, 11: 1.0 / 8.0, 20: 1.0 / 4.0, 29: 1.0}


class Perception(nn.Module):
    """The loss, from a safetensors file of VGG-19's weights with torchvision's names, such as features.0.weight."""

    def __init__(self, path: PathLike) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        before = 3
        for width in _LAYERS:
            layers += [nn.Conv2d(before, width, 3, padding=1), nn.ReLU()] if width else [nn.MaxPool2d(2)]
            before = width or before
        self.features = nn.Sequential(*layers)
        try:
            from safetensors.torch import load_file

            kept = load_file(path)
            self.load_state_dict({name: kept[name] for name in self.state_dict()})
        # A wrong file can raise many kinds of errors in safetensors and PyTorch.
        except Exception as error:
            raise ThermorenderError(
                f"vgg={path} holds no weights of VGG-19 ({' '.join(str(error).split())[:120]}); give a safetensors "
                "file with torchvision's names, or leave the option out"
            ) from None
        self.requires_grad_(False)

    def forward(self, found: torch.Tensor, wanted: torch.Tensor) -> torch.Tensor:
        """Return the loss of (n, 1, h, w) pictures in −1…1."""
        both = torch.cat([found, wanted]).expand(-1, 3, -1, -1)
        loss = torch.zeros((), device=found.device)
        for number, layer in enumerate(self.features):
            both = layer(both)
            if number in _COMPARED:
                a, b = both.float().chunk(2)
                loss = loss + _COMPARED[number] * (a - b.detach()).abs().mean()
        return loss
