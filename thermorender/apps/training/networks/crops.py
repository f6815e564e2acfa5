"""Square crops of the examples of a Task, in an order that depends on the seed only, and the Encoding for them.

Each read picture gives several crops, shuffled with those of others. Crop k is always the same, so training resumes.
"""

import hashlib
from collections.abc import Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from thermorender.apps.training.task import Task
from thermorender.errors import ThermorenderError
from thermorender.learned.linear import Linear
from thermorender.learned.networks.encoding import Encoding
from thermorender.learned.rows import CLASSES, ExtraInputs
from thermorender.learned.temperature_map import Inputs

# Pixels that are cropped from a picture when it is read, and pixels of the crops that are shuffled together.
_CUT_PIXELS, _MIXED_PIXELS = 1 << 19, 1 << 25
# Approximate number of training pictures in a data set's checksum, and in the statistics of an Encoding.
_IN_CHECKSUM, _IN_STATISTICS = 16, 180
# Least scale of a target, in its unit.
_LEAST_SCALE = 1e-3
# A crop with a smaller valid share is drawn again, up to this number of draws.
_LEAST_VALID, _DRAWS = 0.3, 4


@dataclass(frozen=True, eq=False)
class Crop:
    """A square crop of a picture."""

    inputs: Inputs
    target: np.ndarray  # (side, side) float32 intensity, or kelvin above the air; 0 where it is not valid
    valid: np.ndarray  # (side, side) bool


# (Inputs, target (h, w) float32, valid (h, w) bool) of an example.
Read = tuple[Inputs, np.ndarray, np.ndarray]


class Crops:
    """The crops of a Task, of `side` pixels, cut from training crops enlarged to `jitter` pixels.

    The target is intensity, or with `above_air` kelvin above the air.
    """

    def __init__(self, task: Task, side: int, above_air: bool, jitter: int | None = None) -> None:
        self.task, self.side, self.above_air, self.jitter = task, side, above_air, jitter or side
        count = len(task.examples)
        held = task.held_out if task.held_out is not None else np.arange(count) % 10 == 9
        self.train, self.held = np.flatnonzero(~held), np.flatnonzero(held)
        if not len(self.train) or not len(self.held):
            raise ThermorenderError(f"{count} pairs are too few to train and validate a network; give 10 or more")
        self._cuts, self._mixed = max(1, _CUT_PIXELS // (side * side)), _MIXED_PIXELS // _CUT_PIXELS
        self._pool = ThreadPoolExecutor(1)
        # {number of a block: (order of its crops, its pictures)}
        self._blocks: dict[int, tuple[np.ndarray, list[Future[Read]]]] = {}

    def close(self) -> None:
        """Stop reading pictures."""
        self._pool.shutdown(cancel_futures=True)

    def digest(self, validation: Iterable[Crop]) -> str:
        """Return a checksum (hex) of the crops of `validation` and of some training pictures."""
        found = hashlib.blake2b(digest_size=16)
        for crop in validation:
            found.update(crop.inputs.rgb.tobytes() + crop.target.tobytes() + crop.valid.tobytes())
        for number in self.train[:: max(len(self.train) // _IN_CHECKSUM, 1)]:
            inputs, target, _ = self.read(number)
            found.update(inputs.rgb.tobytes() + target.tobytes())
        return found.hexdigest()

    def batch(self, first: int, size: int) -> list[Crop]:
        """Return `size` crops of the endless order, from number `first` on."""
        return [self._of(number) for number in range(first, first + size)]

    def validation(self) -> list[Crop]:
        """Return a crop of each held-out example, the same each time."""
        return [self._cut(self.read(k), np.random.default_rng([self.task.seed, 1, k])) for k in map(int, self.held)]

    def _of(self, number: int) -> Crop:
        """Crop of a number in the endless order."""
        block, within = divmod(number, self._mixed * self._cuts)
        # The next block is read during the second half of the current one.
        for each in (block, *([block + 1] if 2 * within >= self._mixed * self._cuts else [])):
            if each not in self._blocks:
                places = range(each * self._mixed, (each + 1) * self._mixed)
                order = np.random.default_rng([self.task.seed, 4, each]).permutation(self._mixed * self._cuts)
                self._blocks[each] = order, [self._pool.submit(self._read_at, place) for place in places]
        for each in [old for old in self._blocks if old < block]:
            del self._blocks[each]
        order, pictures = self._blocks[block]
        picture, cut = divmod(int(order[within]), self._cuts)
        generator = np.random.default_rng([self.task.seed, 3, block * self._mixed + picture, cut])
        return self._jittered(self._cut(pictures[picture].result(), generator, mirrored=True), generator)

    def _read_at(self, place: int) -> Read:
        """`read` the picture at a place of the endless order, in which each picture comes once per epoch."""
        epoch, within = divmod(place, len(self.train))
        order = np.random.default_rng([self.task.seed, 2, epoch]).permutation(len(self.train))
        inputs, target, valid = self.read(self.train[order[within]])
        # In half precision, as in data sets, because many pictures wait in memory.
        terrain = {name: np.asarray(plane, np.float16) for name, plane in inputs.terrain.items()}
        return replace(inputs, terrain=terrain), target, valid

    def read(self, number: int) -> Read:
        """Return (Inputs, target (h, w) float32, valid (h, w) bool) of an example."""
        example = self.task.examples[int(number)]
        if self.above_air:
            if "air_k" not in example.inputs.conditions:
                raise ThermorenderError(
                    f"pair number {number} lacks the condition air_k, which others have; remove the pair, or add its "
                    "air temperature"
                )
            target = self.task.temperature[example.values] - example.inputs.conditions["air_k"]
        else:
            target = self.task.intensity[example.values]
        # Values without a temperature (radiance below zero) are not learned from.
        valid = example.valid & np.isfinite(target)
        return example.inputs, np.where(valid, target, 0.0).astype(np.float32), valid

    def _jittered(self, crop: Crop, generator: np.random.Generator) -> Crop:
        """A square of `side` at a random place of an enlarged Crop."""
        if self.jitter == self.side:
            return crop
        import cv2

        top, left = map(int, generator.integers(self.jitter - self.side + 1, size=2))
        inputs, size = crop.inputs, (self.jitter, self.jitter)

        def part(plane: np.ndarray, how: int = cv2.INTER_NEAREST_EXACT) -> np.ndarray:
            whole = cv2.resize(plane, size, interpolation=how)
            return np.ascontiguousarray(whole[top : top + self.side, left : left + self.side])

        # A pixel is valid if all four by four pixels that it is interpolated from are.
        sure = part(cv2.erode(crop.valid.astype(np.uint8), np.ones((5, 5), np.uint8))).astype(bool)
        target = np.where(sure, part(crop.target, cv2.INTER_CUBIC), np.float32(0.0))
        terrain = {name: part(plane.astype(np.float32)).astype(np.float16) for name, plane in inputs.terrain.items()}
        texel_m = None if inputs.texel_m is None else inputs.texel_m * self.side / self.jitter
        depth = None if inputs.depth is None else part(inputs.depth.astype(np.float32))
        cut = Inputs(part(inputs.rgb, cv2.INTER_CUBIC), texel_m, terrain, inputs.conditions, depth)
        return Crop(cut, target, sure)

    def _cut(self, read: Read, generator: np.random.Generator, mirrored: bool = False) -> Crop:
        """Crop at a random place of an example where enough pixels are valid."""
        inputs, target, valid = read
        lacking = [max(self.side - n, 0) for n in valid.shape]
        for _ in range(_DRAWS):
            places = [
                int(generator.integers(n + less - self.side + 1)) for n, less in zip(valid.shape, lacking, strict=True)
            ]
            here = tuple(slice(place, place + self.side) for place in places)
            if valid[here].mean() >= _LEAST_VALID:
                break
        step = -1 if mirrored and generator.random() < 0.5 else 1

        def part(plane: np.ndarray, mode: Literal["constant", "edge"] = "constant") -> np.ndarray:
            plane = plane[here][:, ::step]
            if plane.shape[:2] != (self.side, self.side):
                # A smaller picture fills the crop's corner; its edges are repeated.
                around = [(0, self.side - n) for n in plane.shape[:2]] + [(0, 0)] * (plane.ndim - 2)
                plane = np.pad(plane, around, mode)
            return np.ascontiguousarray(plane)

        terrain = {name: part(plane, "edge").astype(np.float16) for name, plane in inputs.terrain.items()}
        depth = None if inputs.depth is None else part(inputs.depth, "edge")
        cut = Inputs(part(inputs.rgb, "edge"), inputs.texel_m, terrain, inputs.conditions, depth)
        return Crop(cut, part(target), part(valid))


def measured(
    crops: Crops, depth: bool, target: tuple[float, float] | None = None, base: Linear | None = None
) -> Encoding:  # fmt: skip
    """Return the Encoding for the examples of Crops, with all their terrain planes and conditions as input.

    `target` is (offset, scale), by default mean and standard deviation, or 0 and rms for kelvin above the air. `base`
    is a linear predictor whose kelvin become a plane.
    """
    first = ExtraInputs.of(crops.read(crops.train[0])[0])
    extra = ExtraInputs(tuple(name for name in first.terrain if name != CLASSES), first.conditions)
    sums = np.zeros(3)
    for k in crops.train[:: max(len(crops.train) // _IN_STATISTICS, 1)]:
        inputs, values, valid = crops.read(k)
        if depth and inputs.depth is None:
            raise ThermorenderError(
                "the pairs have no depth, which option depth=true takes as input; give a data set with depth, or leave "
                "the option out"
            )
        extra.check(inputs)
        learned = values[valid].astype(np.float64)
        sums += learned.size, learned.sum(), (learned**2).sum()
    if not sums[0]:
        raise ThermorenderError("no pair has a valid pixel to learn from; give pairs whose pictures overlap")
    if target is None:
        mean = 0.0 if crops.above_air else float(sums[1] / sums[0])
        target = mean, max(float(np.sqrt(max(sums[2] / sums[0] - mean**2, 0.0))), _LEAST_SCALE)
    offset, scale = map(float, target)
    return Encoding(extra, depth, offset, scale, base)
