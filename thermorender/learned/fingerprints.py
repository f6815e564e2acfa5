"""Fingerprints of training pictures, by which copies and parts of them are found in other pictures.

A fingerprint is a coarse grid of `BYTES` bytes with one bit per cell: whether it is brighter than its surroundings. A
picture is compared at every position, mirrored and turned by multiples of 90°, at every scale at which it covers a
fifth of the training picture or more. `validation.leaks` measures the rates of detections and false detections.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Size of a fingerprint: two bytes for rows and columns of the grid, and the bits of its cells.
BYTES = 192
_CELLS = 8 * (BYTES - 2)
# Most training pictures stored in a map, evenly spaced over all: 98 kB.
MOST_PICTURES = 512
# A picture shows a training picture where their agreement exceeds this many standard deviations of chance. Chosen on
# `validation.leaks`.
LEAST_AGREEMENT = 9.4
# Standard deviation of the surroundings of a cell [cells].
_AROUND = 1.0
# Spacing of the compared scales, and the smallest and largest share of a training picture's area.
_STEP, _SMALLEST, _LARGEST = 1.06, 0.17, 1.1
# Shifts of a picture within a cell, down and right; cells by which it may exceed the training picture.
_SHIFTS = ((0.0, 0.0), (0.0, 0.5), (0.5, 0.0), (0.5, 0.5))
_BEYOND = 2
# Longest side of the compared pictures [px], samples per cell side, noise of their brightness [levels].
_SIDE, _SAMPLES, _NOISE = 384, 4, 0.5
# Added to the square of each difference, which is 1 at most.
_FLOOR = 0.01
# Products of pictures and fingerprints at once.
_PICTURES_AT_ONCE, _KNOWN_AT_ONCE = 16, 32


@dataclass(frozen=True, eq=False)
class Fingerprints:
    """Fingerprints of the pictures that a map was trained on."""

    rows: NDArray[np.uint8]  # (n, BYTES) uint8 rows and columns of each grid, then its bits, row by row
    pictures: int  # Number of training pictures, of which n are stored

    def __post_init__(self) -> None:
        rows = self.rows
        if rows.dtype != np.uint8 or rows.ndim != 2 or rows.shape[1] != BYTES or not len(rows):
            raise ValueError(f"fingerprints are not rows of {BYTES} bytes")
        cells = rows[:, 0].astype(int) * rows[:, 1]
        if len(rows) > self.pictures or not ((cells > 0) & (cells <= _CELLS)).all():
            raise ValueError("fingerprints do not fit their number of pictures or cells")

    def __len__(self) -> int:
        return len(self.rows)


@dataclass(frozen=True)
class Seen:
    """A training picture that a picture shows: its number in the map's file, and the agreement [std of chance]."""

    index: int
    agreement: float


def fingerprints_of(pictures: Iterable[NDArray[np.uint8]], count: int) -> Fingerprints:
    """Return the Fingerprints of pictures, each (h, w, 3) uint8, that stand for `count` training pictures."""
    return Fingerprints(np.stack([_fingerprint(rgb) for rgb in pictures]), count)


def stored_numbers(count: int) -> list[int]:
    """Return the numbers of the training pictures that a map stores, evenly spaced among `count`."""
    return [int(k) for k in np.unique(np.linspace(0, count - 1, min(count, MOST_PICTURES)).round())]


def search(
    known: Fingerprints, pictures: Iterable[NDArray[np.uint8]], progress: Callable[[int], object] | None = None
) -> list[Seen | None]:
    """Return the training picture (Seen) that each picture, (h, w, 3) uint8, shows, or None.

    `pictures` is read in groups; `progress` is called with the number of pictures done.
    """
    found: list[Seen | None] = []
    for group in _groups(pictures):
        best = agreements(known, group)
        for row in best:
            index = int(row.argmax())
            found.append(Seen(index, float(row[index])) if row[index] >= LEAST_AGREEMENT else None)
        if progress:
            progress(len(found))
    return found


def agreements(known: Fingerprints, pictures: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
    """Return the best agreement of each picture with each fingerprint, (pictures, known) float32.

    It is the sum of differences at set bits minus that at others, over its standard deviation for random bits.
    """
    best = np.zeros((len(pictures), len(known)), np.float32)
    greys = [_grey(rgb) for rgb in pictures]
    shapes = np.array([grey.shape for grey in greys])
    for shape in np.unique(shapes, axis=0):
        own = np.flatnonzero((shapes == shape).all(axis=1))
        for grids in _grids([greys[k] for k in own]):
            for turned in _turned(grids):
                for number, cells in _fields(known):
                    best[np.ix_(own, number)] = np.maximum(best[np.ix_(own, number)], _best(turned, cells))
    return best


def _groups(pictures: Iterable[NDArray[np.uint8]]) -> Iterator[list[NDArray[np.uint8]]]:
    """Yield pictures in groups that are compared at once."""
    group: list[NDArray[np.uint8]] = []
    for rgb in pictures:
        group.append(rgb)
        if len(group) == _PICTURES_AT_ONCE:
            yield group
            group = []
    if group:
        yield group


def _fingerprint(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture's fingerprint, (BYTES,) uint8."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    height, width = grey.shape
    side = np.sqrt(height * width / _CELLS)
    # A picture much longer than wide has a row of square cells at most.
    rows, columns = (int(np.clip(length // side, 1, 255)) for length in (height, width))
    rows, columns = min(rows, _CELLS // columns), min(columns, _CELLS // rows)
    cells = cv2.resize(grey, (columns, rows), interpolation=cv2.INTER_AREA)
    bits = np.packbits((cells >= _around(cells)).ravel())
    return np.concatenate([[rows, columns], bits, np.zeros(BYTES - 2 - bits.size)]).astype(np.uint8)


def _around(cells: np.ndarray) -> np.ndarray:
    """Mean of a cell's surroundings, with the cell."""
    import cv2

    return cv2.GaussianBlur(cells, (0, 0), _AROUND, borderType=cv2.BORDER_REFLECT_101)


def _grey(rgb: np.ndarray) -> np.ndarray:
    """A picture as a grey one of `_SIDE` pixels, float32."""
    import cv2

    grey: np.ndarray = cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = _SIDE / max(grey.shape)
    size = [max(round(side * scale), 1) for side in grey.shape[::-1]]
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    return cv2.GaussianBlur(grey, (0, 0), 1.0)


def _grids(greys: Sequence[np.ndarray]) -> Iterator[np.ndarray]:
    """Differences of cells from their surroundings at each scale, (pictures, shifts, rows, columns) float32 each."""
    import cv2

    height, width = greys[0].shape
    share = _SMALLEST
    while share < _LARGEST:
        side = np.sqrt(height * width / (share * _CELLS))
        rows, columns = (int(length / side - 0.5) for length in (height, width))
        share *= _STEP**2
        if min(rows, columns) < 2:
            continue
        step, found = side / _SAMPLES, []
        for grey in greys:
            for shift in _SHIFTS:
                top, left = (k * side + 0.5 * step - 0.5 for k in shift)
                sampled = cv2.warpAffine(
                    grey, np.array([[step, 0.0, left], [0.0, step, top]]), (columns * _SAMPLES, rows * _SAMPLES),
                    flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderMode=cv2.BORDER_REPLICATE,
                )  # fmt: skip
                cells = cv2.resize(sampled, (columns, rows), interpolation=cv2.INTER_AREA)
                fine = cells - _around(cells)
                # Strong edges count little more than faint structure.
                local = cv2.GaussianBlur(fine * fine, (0, 0), 2.0 * _AROUND)
                found.append(np.tanh(fine / np.sqrt(local + _NOISE**2)))
        yield np.reshape(found, (len(greys), len(_SHIFTS), rows, columns)).astype(np.float32)


def _turned(grids: np.ndarray) -> list[np.ndarray]:
    """Grids mirrored and turned, (pictures, variants, rows, columns) for either shape."""
    upright = [grids, grids[..., ::-1], grids[..., ::-1, :], grids[..., ::-1, ::-1]]
    across = [each.swapaxes(-1, -2) for each in upright]
    if grids.shape[-2] == grids.shape[-1]:
        return [np.concatenate(upright + across, axis=1)]
    return [np.concatenate(upright, axis=1), np.concatenate(across, axis=1)]


def _fields(known: Fingerprints) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(numbers, cells (n, rows, columns) float32 of ±1) of the fingerprints of each shape."""
    shapes = known.rows[:, :2]
    for rows, columns in np.unique(shapes, axis=0).astype(int):
        numbers = np.flatnonzero((shapes == (rows, columns)).all(axis=1))
        for start in range(0, len(numbers), _KNOWN_AT_ONCE):
            some = numbers[start : start + _KNOWN_AT_ONCE]
            bits = np.unpackbits(known.rows[some, 2:], axis=1)[:, : rows * columns]
            yield some, bits.reshape(-1, rows, columns).astype(np.float32) * 2.0 - 1.0


def _best(turned: np.ndarray, cells: np.ndarray) -> np.ndarray | float:
    """Best agreement over variants and positions, (pictures, n)."""
    rows, columns = turned.shape[-2:]
    around = ((0, 0), (_BEYOND, _BEYOND), (_BEYOND, _BEYOND))
    padded, mask = np.pad(cells, around), np.pad(np.ones_like(cells[:1]), around)
    if rows > padded.shape[1] or columns > padded.shape[2]:
        return 0.0
    flat = turned.reshape(-1, rows * columns).T
    windows, inside = (
        np.lib.stride_tricks.sliding_window_view(each, (rows, columns), (1, 2)).reshape(-1, rows * columns)
        for each in (padded, mask)
    )
    # The floor keeps flat pictures from agreeing by rounding.
    spread = np.sqrt(inside @ (flat * flat + _FLOOR))
    agreement = (windows @ flat).reshape(len(cells), *spread.shape)
    agreement /= spread
    return np.asarray(agreement.max(axis=1).reshape(len(cells), len(turned), -1).max(axis=2).T)
