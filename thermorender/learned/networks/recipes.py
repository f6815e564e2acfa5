"""The networks by name, each with its hyper-parameters and their sources; no network is imported here.

- FOK: Generation of Artificial Infrared Camera Images for Visual Navigation Simulation, which trained pix2pix and
  pix2pixHD with "default training settings": those of Isola et al. (arXiv:1611.07004) and Wang et al.
  (arXiv:1711.11585), Adam of 2e-4 and β 0.5, 0.999, the rate constant over the first half of the epochs and falling to
  0 over the second, as in both papers' programs. Batch and epochs are its Table 2.
- DLR: Peinecke, Generating Simulated Infrared Sensor Images using Deep Learning Neural Networks, which names networks,
  losses, optimisers and epochs. Batch, rate and width are Keras' defaults or are marked as chosen.
- CycleGAN: Zhu et al. (arXiv:1703.10593).
- `compact` and `compact+`: this project's, their numbers chosen on validation pairs.

DLR's final network is, by its text, both its previous one, the Keras U-Net, and that of Nhu's program
(github.com/anh-nn01/Satellite-Imagery-to-Map-Translation-using-Pix2Pix-GAN-framework). `unet-gan-keras` is the former
with pix2pix' losses and rates. `unet-gan` is Nhu's: U-Net-256 with skip connections, batch 1, Adam of 2e-4 and β 0.5,
0.999, λ 100. Copies of its program add seven halvings, no biases, a constant rate, two generator steps per
discriminator step, and a summed L1. They apply the last epoch with dropout and batch statistics: `published=true`. They
scale pictures to 256², flipped up and down; here squares are cut, flipped left and right. Results:
`validation/networks`.

DLR's 98 000 epochs are probably steps of one pair: as epochs of 4000 pairs they would take more than a year at 10 crops
a second.

`pix2pixhd` trains without its default perceptual loss (VGG-19, ImageNet), whose weights are not shipped, unless the
option `vgg` names their file.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from thermorender.errors import ThermorenderError

# Crops of FOK's Table 2: 3511 pictures times epochs. DLR states "over 4000" pairs.
_FOK, _DLR = 3511, 4000
# Epochs, or rather steps, of DLR's network with a discriminator.
_DLR_STEPS = 98_000
_PIX2PIX_RATE, _PIX2PIX_BETAS = 2e-4, (0.5, 0.999)
# Side that the programs of pix2pix and CycleGAN enlarge a picture to, before they cut a square [pixels].
_JITTER = 286


@dataclass(frozen=True)
class Recipe:
    """How a network is built and trained."""

    net: str  # Its architecture, of `building`
    width: int  # Channels of its outermost level; of the architecture `dense`, the size of the hidden layer
    learner: str  # Its learner, of `building`
    optimiser: str
    rate: float  # To begin with
    # Of the rate: constant; constant and from the middle on falling to 0; risen over the first 10 %, then a cosine to
    # 0
    schedule: str
    batch: int
    crops: int  # Default number of training crops
    # Training crops of the study, its epochs times its pairs; None: not published
    published_crops: int | None = None
    published_steps: int | None = None  # Its training crops if its epochs are steps; None: they are not
    betas: tuple[float, float] = (0.9, 0.999)
    # (offset, scale) of the target's intensity: (0.5, 0.5) is −1…1; None: measured on the training pictures
    target: tuple[float, float] | None = (0.0, 1.0)
    side: int = 256  # Side of the training crops [pixels]; may be chosen for networks that take whole pictures
    whole: bool = False  # Whether it takes pictures of any size whole; else squares of `side`, blended
    multiple: int = 256  # Sides of its input are multiples of this [pixels]
    plus: bool = False  # Whether it takes relief, hour and weather as input
    weight: float = 0.0  # Weight of the second loss, λ in the papers; the first has 1
    options: dict[str, Any] = field(default_factory=dict)  # Options that not all recipes have, with their defaults

    @property
    def bounded(self) -> bool:
        """Whether its output is in −1…1."""
        return self.target == (0.5, 0.5)

    @property
    def least_batch(self) -> int:
        """Fewest crops of a step; in a cycle, half are photographs and half thermal pictures."""
        return 2 if self.learner == "cycle" else 1

    @property
    def all_options(self) -> dict[str, Any]:
        """Its options with their defaults."""
        common = {"width": self.width, "batch": self.batch, "crops": self.crops, "rate": self.rate, "every": 0,
                  "bf16": True, "tensorboard": False, "tolerance_mk": 0.0}  # fmt: skip
        side = {"side": self.side} if self.whole else {}
        return common | side | ({} if self.plus else {"depth": False}) | self.options


def _compact(plus: bool) -> Recipe:
    """The project's own Recipe, with relief, hour and weather or without."""
    return Recipe("compact", 72, "robust", "adamw", 2e-4 if plus else 5e-4, "cosine", 4, 100_000, None, target=None,
                  whole=True, multiple=16, plus=plus)  # fmt: skip


RECIPES = {
    # Over 150 and over 400 epochs; Keras' rates of Adam and NAdam.
    "unet-classes": Recipe("keras_unet_classes", 32, "classes", "adam", 1e-3, "constant", 8, 100_000, _DLR * 150,
                           whole=True, multiple=16),
    "unet": Recipe("keras_unet", 32, "regression", "nadam", 1e-3, "constant", 8, 100_000, _DLR * 400, whole=True,
                   multiple=16, options={"architecture": "keras_unet"}),
    "unet-gan": Recipe("unet256_seven", 64, "summed", "adam", _PIX2PIX_RATE, "constant", 1, _DLR_STEPS,
                       _DLR * _DLR_STEPS, _DLR_STEPS, _PIX2PIX_BETAS, (0.5, 0.5), weight=100.0,
                       options={"published": False}),
    # Discriminator, losses and rates of pix2pix; the batch is chosen.
    "unet-gan-keras": Recipe("keras_unet", 32, "adversarial", "adam", _PIX2PIX_RATE, "halfway", 4, 100_000,
                             _DLR * _DLR_STEPS, _DLR_STEPS, _PIX2PIX_BETAS, (0.5, 0.5), whole=True, multiple=16,
                             weight=100.0),
    # FOK's other training, over 300 epochs: --set batch=25 --set crops=1053300. Its program enlarges a picture of 256²
    # to 286² and takes a square of 256² of that.
    "pix2pix": Recipe("unet256", 64, "adversarial", "adam", _PIX2PIX_RATE, "halfway", 1, _FOK * 200, _FOK * 200, None,
                      _PIX2PIX_BETAS, (0.5, 0.5), weight=100.0, options={"published": False, "jitter": _JITTER}),
    # λ 10 of feature matching, and of VGG's where its weights are given.
    "pix2pixhd": Recipe("pix2pixhd", 64, "scales", "adam", _PIX2PIX_RATE, "halfway", 1, _FOK * 200, _FOK * 200, None,
                        _PIX2PIX_BETAS, (0.5, 0.5), weight=10.0, options={"vgg": ""}),
    # λ 10 of the cycle; two crops make a batch of one unpaired photograph and thermal picture.
    "cyclegan": Recipe("cyclegan", 64, "cycle", "adam", _PIX2PIX_RATE, "halfway", 2, _FOK * 200, None, None,
                       _PIX2PIX_BETAS, (0.5, 0.5), weight=10.0, options={"jitter": _JITTER}),
    "compact": _compact(False),
    "compact+": _compact(True),
}  # fmt: skip

# What `unet` trains with --set architecture=. The others are two networks that DLR found not to converge; their numbers
# are chosen: --set architecture=autoencoder --set width=64, and
# --set architecture=dense --set width=1024 --set side=64 --set batch=32 --set rate=1e-4.
_ARCHITECTURES: dict[str, dict[str, Any]] = {
    "keras_unet": {},
    "autoencoder": {"net": "autoencoder"},
    "dense": {"net": "dense", "side": 64, "multiple": 64, "whole": False},
}


def recipe_of(method: str, architecture: str | None = None) -> Recipe:
    """Return the Recipe of a method, with another architecture where one is given."""
    recipe = RECIPES[method]
    if architecture in (None, recipe.net):
        return recipe
    if "architecture" not in recipe.options or architecture not in _ARCHITECTURES:
        known = ", ".join(_ARCHITECTURES) if "architecture" in recipe.options else recipe.net
        raise ThermorenderError(f"architecture={architecture!r} does not belong to {method!r}; give {known}")
    return replace(recipe, published_crops=None, **_ARCHITECTURES[architecture])


def method_of_file(header: Mapping[str, Any]) -> str:
    """Return the method of a map's file by its header; before 0.2.0, `unet-gan-keras` was called `unet-gan`."""
    old = header["method"] == "unet-gan" and header.get("architecture") in (None, "keras_unet")
    return "unet-gan-keras" if old else str(header["method"])
