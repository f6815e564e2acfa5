"""A trained network as a predictor: what a learned map applies to pictures of any size."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import nn

from thermorender.learned.networks import tiles
from thermorender.learned.networks.building import net_of, predicted
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.networks.packing import packed, unpacked
from thermorender.learned.networks.recipes import RECIPES, Recipe, method_of_file, recipe_of
from thermorender.learned.rows import at_shape
from thermorender.learned.temperature_map import Inputs

# Pictures are given whole up to this side, else in tiles of it, of whose overlap no more than the middle is taken: what
# lies further from a pixel than the margin does not reach it in the compact network [pixels].
_MOST_SIDE, _OVERLAP, _MARGIN = 2048, 640, 288
MOST_WIDTH = 1 << 14
# Greatest number in single precision; NaN is not below it.
_MOST = np.finfo(np.float32).max
_FLAGS = ("above_air", "published")
# PyTorch's counter of batches in batch norm, which the output does not depend on.
_COUNTED = "num_batches_tracked"


@dataclass(frozen=True, eq=False)
class Network:
    """A network of a recipe."""

    method: str  # Name of the recipe
    width: int
    encoding: Encoding
    # Finest and coarsest ground sampling distance it was trained at; others are resampled to the nearest [m]. None:
    # unknown
    texel_range_m: tuple[float, float] | None
    state: dict[str, np.ndarray]  # Its weights
    above_air: bool  # Whether it predicts kelvin above the air instead of intensity
    # Apply it as pix2pix was: the state of the last epoch, with the statistics of each square and dropout, drawn from
    # a fixed seed. Else the state of least validation error, with the statistics of the training and no dropout, so
    # that neighbouring squares agree.
    published: bool = False
    # Facts of its training: crops, seconds, curve; empty for a network from a file
    trained: dict[str, Any] = field(default_factory=dict)
    architecture: str | None = None  # That of the recipe, or another; None is the recipe's
    # Steps of tensors that the file holds as whole multiples of one; it holds the others in half precision
    steps: dict[str, float] = field(default_factory=dict)

    @cached_property
    def recipe(self) -> Recipe:
        """The Recipe that it was built by."""
        return recipe_of(self.method, self.architecture)

    @property
    def needs(self) -> tuple[str, ...]:
        """Names of the required fields of Inputs."""
        return self.encoding.needs

    @cached_property
    def net(self) -> nn.Module:
        """The network with its weights, on the device that it runs on."""
        # On the meta device, until the weights are known to fit its layers.
        with torch.device("meta"):
            net = net_of(self.recipe, self.encoding, self.width)
        weights = {name: torch.from_numpy(np.asarray(values, np.float32)) for name, values in self.state.items()}
        counted = [name for name in net.state_dict() if name.endswith(_COUNTED)]
        net.load_state_dict(weights | {name: torch.zeros((), dtype=torch.int64) for name in counted}, assign=True)
        net = net.to(device(), memory_format=torch.channels_last)  # type: ignore[call-overload]  # of PyTorch's stubs
        return net.requires_grad_(False).train(self.published)

    def predict(self, inputs: Inputs, texel_m: float | None) -> np.ndarray:
        """Return intensity or kelvin above the air, (h, w) float64."""
        return self.with_spread(inputs)[0]

    def with_spread(self, inputs: Inputs) -> tuple[np.ndarray, np.ndarray | None]:
        """Return (intensity or kelvin above the air, standard deviation of its error or None), (h, w) float64."""
        image = self.encoding.at_range(inputs, self.texel_range_m)
        found = self._applied(self.encoding.planes(image))
        mean, *spread = (at_shape(plane.astype(np.float64), inputs.rgb.shape[:2]) for plane in found)
        scale = self.encoding.scale
        return self.encoding.offset + scale * mean, scale * spread[0] if spread else None

    def _applied(self, planes: np.ndarray) -> np.ndarray:
        """The network's encoded output for a picture, (1 or 2, h, w)."""
        recipe, net = self.recipe, self.net

        def apply(part: np.ndarray) -> np.ndarray:
            given = torch.from_numpy(np.ascontiguousarray(part))[None].to(device(), memory_format=torch.channels_last)
            with torch.inference_mode():
                return np.asarray(predicted(recipe, net, given)[0].cpu().numpy())

        # Dropout has its own random state and does not change the caller's.
        with torch.random.fork_rng(enabled=self.published):
            if self.published:
                torch.manual_seed(0)
            return tiles.stitched(apply, planes, *_tiling(recipe, planes.shape[1:]))

    def joints(self, inputs: Inputs) -> tuple[np.ndarray, ...]:
        """Return (rows, columns) where tiles of a picture meet, float64 from its upper left corner [pixels]."""
        image = self.encoding.at_range(inputs, self.texel_range_m)
        shape, own = image.rgb.shape[:2], inputs.rgb.shape[:2]
        sides, overlap, _ = _tiling(self.recipe, shape)
        return tuple(tiles.joints(n, side, overlap) * length / n
                     for n, side, length in zip(shape, sides, own, strict=True))  # fmt: skip

    def header(self) -> dict[str, Any]:
        """Return its entries in the file's header."""
        return {
            "method": self.method, "architecture": self.recipe.net, "width": self.width,
            "encoding": self.encoding.header(), "texel_range_m": self.texel_range_m, "above_air": self.above_air,
            "published": self.published, "packed": self._packed[1] if self.steps else [],
        }  # fmt: skip

    @cached_property
    def _packed(self) -> tuple[np.ndarray, list[list[Any]]]:
        """(codes, table) of the tensors that have a step."""
        return packed(self.state, self.steps)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return its arrays in the file: weights in half precision, but for statistics and what that cannot hold."""
        found = self.encoding.arrays()
        if self.steps:
            found["packed"] = self._packed[0]
        for name, values in self.state.items():
            if name in self.steps:
                continue
            single = np.asarray(values, np.float32)
            fits = "running_" not in name and np.abs(single).max(initial=0.0) < np.finfo(np.float16).max
            found[name] = single.astype(np.float16) if fits else single
        return found

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> "Network":
        """Return the Network of `header` and `arrays`."""
        table = header.get("packed", [])
        if table:
            arrays = unpacked(arrays["packed"], table) | {name: arrays[name] for name in arrays if name != "packed"}
        method = method_of_file(header)
        if method not in RECIPES or type(header["width"]) is not int:
            raise ValueError("it is of an unknown method or width")
        if not 1 <= header["width"] <= MOST_WIDTH or not all(type(header[name]) is bool for name in _FLAGS):
            raise ValueError("it is of an unknown method or width, or its flags are neither true nor false")
        encoding, sampling = Encoding.of(header["encoding"], arrays), header["texel_range_m"]
        if sampling is not None:
            finest, coarsest = map(float, sampling)
            if not 0.0 < finest <= coarsest < np.inf:
                raise ValueError("its range of ground sampling distances does not rise from above 0")
            sampling = finest, coarsest
        if header["above_air"] and "air_k" not in encoding.extra.conditions:
            raise ValueError("it does not take the air's temperature as input")
        own = encoding.arrays()
        _refuse_unusable(arrays)
        found = cls(method, header["width"], encoding, sampling,
                    {name: values for name, values in arrays.items() if name not in own}, header["above_air"],
                    header["published"], architecture=header.get("architecture"),
                    steps={name: step for name, _, _, step in table})  # fmt: skip
        _ = found.net
        return found


def _refuse_unusable(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise ValueError if weights are not finite, or a variance is below 0."""
    for name, values in arrays.items():
        if values.dtype.kind != "f" or not np.abs(values).max(initial=0.0) < _MOST:
            raise ValueError("it has weights that are not finite")
        if name.endswith("running_var") and values.min(initial=0.0) < 0.0:
            raise ValueError("it has a variance below 0")


def _tiling(recipe: Recipe, shape: tuple[int, ...]) -> tuple[tuple[int, int], int, int]:
    """(sides, overlap, margin) of the tiles of a picture [pixels]."""
    if not recipe.whole:
        return (recipe.side, recipe.side), recipe.side // 4, recipe.side // 32
    tall, wide = (min(_MOST_SIDE, n + -n % recipe.multiple) for n in shape)
    return (tall, wide), _OVERLAP, _MARGIN


def state_of(net: nn.Module) -> dict[str, np.ndarray]:
    """Return the weights of a network as {name: array}."""
    return {name: value.detach().cpu().numpy() for name, value in net.state_dict().items()
            if not name.endswith(_COUNTED)}  # fmt: skip


def device() -> str:
    """Return the name of the device that networks run on."""
    return "cuda" if torch.cuda.is_available() else "cpu"
