"""Squares cut from the examples of a Task, in an order that the seed and their number alone decide.

A picture that was read is cut several times, and the squares of some pictures are mixed, so that reading costs little
and neighbours in the order differ. Crop number k is the same however training came there, which is what lets it be
resumed.
"""

import hashlib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.temperature_map import Inputs

# Pixels of the squares that are cut from a picture when it is read, and of those of several that are mixed.
_CUT_PIXELS, _MIXED_PIXELS = 1 << 19, 1 << 25
# Training pictures that tell one data set from another, about.
_LOOKED_AT = 16
# A square is drawn anew, up to so many times, where less than this of it is valid.
_LEAST_VALID, _DRAWS = 0.3, 4


@dataclass(frozen=True, eq=False)
class Crop:
    """A square of a picture.

    Attributes
    ----------
    inputs : Inputs
    target : (side, side) float32
        Intensity, or kelvin above the air; 0 where it is not valid.
    valid : (side, side) bool
    """

    inputs: Inputs
    target: np.ndarray
    valid: np.ndarray


class Crops:
    """The crops of a Task.

    Parameters
    ----------
    task : Task
    side : int
        [pixels]
    above_air : bool
        Whether the target is kelvin above the air, instead of intensity.
    """

    def __init__(self, task, side, above_air):
        self.task, self.side, self.above_air = task, side, above_air
        count = len(task.examples)
        held = task.held_out if task.held_out is not None else np.arange(count) % 10 == 9
        self.train, self.held = np.flatnonzero(~held), np.flatnonzero(held)
        if not len(self.train) or not len(self.held):
            raise ThermorenderError(
                f"{count} pairs are too few to train a network and to tell when it is best; give 10 at least"
            )
        self._cuts, self._mixed = max(1, _CUT_PIXELS // (side * side)), _MIXED_PIXELS // _CUT_PIXELS
        self._pool, self._blocks = ThreadPoolExecutor(1), {}

    def close(self):
        """Read no further."""
        self._pool.shutdown(cancel_futures=True)

    def digest(self, validation):
        """Return a fingerprint (hex) of the crops of `validation`, and of some of the training pictures."""
        found = hashlib.blake2b(digest_size=16)
        for crop in validation:
            found.update(crop.inputs.rgb.tobytes() + crop.target.tobytes() + crop.valid.tobytes())
        for number in self.train[:: max(len(self.train) // _LOOKED_AT, 1)]:
            inputs, target, _ = self.read(number)
            found.update(inputs.rgb.tobytes() + target.tobytes())
        return found.hexdigest()

    def batch(self, first, size):
        """Return crops number `first` to `first + size` of the endless order, a list of Crop."""
        return [self._of(number) for number in range(first, first + size)]

    def validation(self):
        """Return a crop of each held-out example, the same each time."""
        return [self._cut(self.read(k), np.random.default_rng([self.task.seed, 1, k])) for k in self.held]

    def _of(self, number):
        block, within = divmod(number, self._mixed * self._cuts)
        # The next block is read while the second half of one is learned from.
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
        return self._cut(pictures[picture].result(), generator, mirrored=True)

    def _read_at(self, place):
        """What stands at a place of the order of pictures, each of which comes once in every epoch."""
        epoch, within = divmod(place, len(self.train))
        order = np.random.default_rng([self.task.seed, 2, epoch]).permutation(len(self.train))
        inputs, target, valid = self.read(self.train[order[within]])
        # In half precision, as data sets hold them: many pictures wait at a time.
        terrain = {name: np.asarray(plane, np.float16) for name, plane in inputs.terrain.items()}
        return replace(inputs, terrain=terrain), target, valid

    def read(self, number):
        """Return (Inputs, target (h, w) float32, valid (h, w) bool) of an example."""
        example = self.task.examples[int(number)]
        if self.above_air:
            if "air_k" not in example.inputs.conditions:
                raise ThermorenderError(
                    f"pair number {number} lacks the condition air_k, which others have; leave it out, or tell its air"
                )
            target = self.task.temperature[example.values] - example.inputs.conditions["air_k"]
        else:
            target = self.task.intensity[example.values]
        # Where a value stands for no temperature, as below zero radiance, there is nothing to learn.
        valid = example.valid & np.isfinite(target)
        return example.inputs, np.where(valid, target, 0.0).astype(np.float32), valid

    def _cut(self, read, generator, mirrored=False):
        inputs, target, valid = read
        lacking = [max(self.side - n, 0) for n in valid.shape]
        for _ in range(_DRAWS):
            top, left = (int(generator.integers(n + less - self.side + 1)) for n, less in zip(valid.shape, lacking,
                                                                                              strict=True))  # fmt: skip
            here = np.s_[top : top + self.side, left : left + self.side]
            if valid[here].mean() >= _LEAST_VALID:
                break
        step = -1 if mirrored and generator.random() < 0.5 else 1

        def part(plane, mode="constant"):
            plane = plane[here][:, ::step]
            if plane.shape[:2] != (self.side, self.side):
                # A picture smaller than the square stands in its corner, its edges repeated.
                around = [(0, self.side - n) for n in plane.shape[:2]] + [(0, 0)] * (plane.ndim - 2)
                plane = np.pad(plane, around, mode)
            return np.ascontiguousarray(plane)

        terrain = {name: part(plane, "edge").astype(np.float16) for name, plane in inputs.terrain.items()}
        depth = None if inputs.depth is None else part(inputs.depth, "edge")
        cut = Inputs(part(inputs.rgb, "edge"), inputs.texel_m, terrain, inputs.conditions, depth)
        return Crop(cut, part(target), part(valid))
