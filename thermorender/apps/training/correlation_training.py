"""Training of a Correlation: least squares of thermal intensity on k × k colours, in one pass.

Normal equations are summed exactly. Colours are bytes and the target is split into bytes, so every product is an
integer below 2¹⁶. A sum of 256 is below 2²⁴, exact in single precision and in any order. Blocks of 256 are then
summed in double precision, exact up to 2⁵³. The condition number of the 3 × 3 equations on photographs is about 1e7:
single precision throughout would cost 0.01 in a coefficient.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from thermorender.apps.training.task import Example, Task
from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.rows import at_texel

# Terms of a sum that is exact in single precision: 256 × 255² is below 2²⁴.
_BLOCK = 256
# Bytes that the target's intensity is split into: 1e-12 of its range.
_BYTES = 5
# Directions whose eigenvalue is below this share of the largest one are undetermined.
_DEPENDENT = 1e-10
# Pictures in the queue for threads, which bounds memory.
_AT_ONCE = 16
# Rows and columns of one matrix product. OpenBLAS would split a larger one among its own threads, which slow down the
# threads that already work on other pictures.
_TILE = 32
# Most neighbourhoods that are copied at a time.
_MOST_PICKED = 16 * _BLOCK


def fit_correlation(task: Task, size: int) -> Correlation:
    """Return the Correlation of size × size colours that fits a Task best; the size is odd.

    Options: `intercept`, bool (the published form has none); `penalty`, weight of the squared coefficients added to the
    mean squared error, for colours in 0…1; `above_air`, bool, to learn kelvin above the air instead of intensity.
    """
    above_air = task.options.get("above_air", False)
    table, n = _Table(task.temperature if above_air else task.intensity), 3 * size * size
    normal = np.zeros((n + 2, n + 2))
    waiting: list[Future[np.ndarray]] = []
    # Matrix products release the interpreter, so threads share the work.
    with ThreadPoolExecutor() as pool:
        for done, example in enumerate(task.examples, 1):
            less = _air_k(example) if above_air else 0.0
            waiting.append(pool.submit(_equations, _at_texel(example, task.texel_m), size, table, less))
            if len(waiting) == _AT_ONCE:
                normal += waiting.pop(0).result()
                task.progress("summing the normal equations", done / len(task.examples))
        for each in waiting:
            normal += each.result()
    if normal[n, n] == 0.0:
        raise ThermorenderError(
            f"no picture has a valid neighbourhood of {size} × {size} pixels; give larger pictures, or a smaller "
            "neighbourhood"
        )
    found = solved(normal, size, task.options.get("intercept", False), task.options.get("penalty", 0.0))
    return replace(found, above_air=above_air)


def _at_texel(example: Example, texel_m: float | None) -> Example:
    """An Example at a ground sampling distance [m]; thermal values are codes, so they keep the nearest."""
    import cv2

    inputs = at_texel(example.inputs, texel_m)
    size = inputs.rgb.shape[1::-1]
    if inputs is example.inputs:
        return example
    values, valid = (
        cv2.resize(np.asarray(each), size, interpolation=cv2.INTER_NEAREST_EXACT)
        for each in (example.values, example.valid.astype(np.uint8))
    )
    return Example(inputs, values, valid > 0)


def _air_k(example: Example) -> float:
    """Air temperature of an example [K]."""
    if "air_k" not in example.inputs.conditions:
        raise ThermorenderError(
            "above_air=true needs the air's temperature of every pair, but one lacks it; give a data set with weather, "
            "or leave above_air out"
        )
    return example.inputs.conditions["air_k"]


def solved(normal: np.ndarray, size: int, intercept: bool, penalty: float) -> Correlation:
    """Return the Correlation that solves normal equations, (n + 2, n + 2) as by `_equations`, n = 3 size²."""
    n = 3 * size * size
    count = normal[n, n]
    used = np.arange(n + 1 if intercept else n)
    scale = np.where(used < n, 255.0, 1.0)
    left = np.triu(normal[np.ix_(used, used)]) / count / np.outer(scale, scale)
    left += np.triu(left, 1).T
    right = normal[used, n + 1] / count / scale
    left[np.arange(n), np.arange(n)] += penalty
    values, vectors = np.linalg.eigh(left)
    if values[0] <= _DEPENDENT * values[-1]:
        kept = int((values > _DEPENDENT * values[-1]).sum())
        raise ThermorenderError(
            f"the pictures determine only {kept} of {len(used)} coefficients, for example because they are grey; give "
            "coloured pictures, or --set penalty=1e-6"
        )
    found = vectors @ ((vectors.T @ right) / values)
    # One step of iterative refinement, against rounding in the eigenvectors.
    found += vectors @ ((vectors.T @ (right - left @ found)) / values)
    return Correlation(found[:n].reshape(size, size, 3), float(found[n]) if intercept else 0.0)


class _Table:
    """Table of each pixel value's intensity, split into bytes; `zero` is the intensity of all bytes 0."""

    def __init__(self, intensity: np.ndarray) -> None:
        self.zero, high = float(intensity.min()), float(intensity.max())
        step = max(high - self.zero, 1e-300) / (256.0**_BYTES - 1.0)
        self._whole = np.rint((intensity - self.zero) / step).astype("<u8")
        self._weights = step * 256.0 ** np.arange(_BYTES)

    def bytes(self, values: np.ndarray) -> np.ndarray:
        """Bytes of values, (..., _BYTES) uint8."""
        return np.asarray(self._whole.take(values))[..., None].view(np.uint8)[..., :_BYTES]

    def joined(self, sums: np.ndarray) -> np.ndarray:
        """Sums of 1 and of the intensity above `zero`, (..., 2), from sums of 1 and of each byte, (..., 1 + _BYTES)."""
        return np.stack([sums[..., 0], sums[..., 1:] @ self._weights], axis=-1)


def _equations(example: Example, size: int, table: _Table, less: float = 0.0) -> np.ndarray:
    """Return AᵀA and AᵀI of a picture, (n + 2, n + 2) float64, upper triangle; `less` is subtracted from I.

    The columns are n colours (row, column, channel), 1 and I.
    """
    ring, n = size // 2, 3 * size * size
    total = np.zeros((n + 2, n + 2))
    if min(example.valid.shape) <= 2 * ring:
        return total
    valid = example.valid
    if ring and not valid.all():
        import cv2

        valid = cv2.erode(valid.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=1) > 0
    rows, columns = (slice(ring, side - ring) for side in valid.shape)
    valid, values = valid[rows, columns], example.values[rows, columns]
    # Neighbourhoods share products of colours: all of them together cost less than half of them one by one.
    if 2 * np.count_nonzero(valid) > valid.size:
        total += _everywhere(example.inputs.rgb, values, size, table)
        total -= _picked(example.inputs.rgb, values, ~valid, size, table)
    else:
        total += _picked(example.inputs.rgb, values, valid, size, table)
    total[: n + 1, n + 1] += (table.zero - less) * total[: n + 1, n]
    return total


def _everywhere(rgb: np.ndarray, values: np.ndarray, size: int, table: _Table) -> np.ndarray:
    """Return `_equations` of all neighbourhoods, with the intensity counted from the table's zero.

    Each product of two picture rows is computed once and summed over the neighbourhoods that hold them.
    """
    rows, columns = values.shape
    height, wide, n = len(rgb), 3 * size, 3 * size * size
    lines, total = rgb.transpose(0, 2, 1), np.zeros((n + 2, n + 2))
    for first in range(0, columns, _BLOCK):
        count = min(_BLOCK, columns - first)
        # Each row's colours at all shifts along it; the rows added at the end are not used by any neighbourhood.
        a = np.zeros((height + size - 1, wide, count), dtype=np.float32)
        for shift in range(size):
            a[:height, 3 * shift : 3 * shift + 3] = lines[..., first + shift : first + shift + count]
        # Rows of a neighbourhood are consecutive, so each neighbourhood is a view of `a`.
        around = np.lib.stride_tricks.as_strided(a, (height, n, count), a.strides)
        products = _multiplied(a[:height], around.transpose(0, 2, 1))
        for above in range(size):
            left = slice(above * wide, (above + 1) * wide)
            here = products[above : above + rows, :, : n - left.start]
            total[left, left.start : n] += here.sum(axis=0, dtype=np.float64)
        target = np.empty((rows, 1 + _BYTES, count), dtype=np.float32)
        target[:, 0] = 1.0
        target[:, 1:] = table.bytes(values[:, first : first + count]).transpose(0, 2, 1)
        mixed = _multiplied(around[:rows], target.transpose(0, 2, 1))
        total[:n, n:] += table.joined(mixed.sum(axis=0, dtype=np.float64))
        total[n, n:] += table.joined(target.sum(axis=2).sum(axis=0, dtype=np.float64))
    return total


def _picked(rgb: np.ndarray, values: np.ndarray, picked: np.ndarray, size: int, table: _Table) -> np.ndarray:
    """`_everywhere` for some neighbourhoods only, `picked`, (rows, columns) bool."""
    n = 3 * size * size
    total = np.zeros((n + 2, n + 2))
    row, column = np.nonzero(picked)
    shifts = np.arange(size)
    for first in range(0, row.size, _MOST_PICKED):
        r, c = (each[first : first + _MOST_PICKED] for each in (row, column))
        a = np.zeros((-(-r.size // _BLOCK) * _BLOCK, n + 1 + _BYTES), dtype=np.float32)
        a[: r.size, :n] = rgb[r[:, None, None] + shifts[:, None], c[:, None, None] + shifts].reshape(r.size, n)
        a[: r.size, n] = 1.0
        a[: r.size, n + 1 :] = table.bytes(values[r, c])
        blocks = a.reshape(-1, _BLOCK, n + 1 + _BYTES)
        products = _multiplied(blocks[..., : n + 1].transpose(0, 2, 1), blocks).sum(axis=0, dtype=np.float64)
        total[: n + 1, :n] += products[:, :n]
        total[: n + 1, n:] += table.joined(products[:, n:])
    return total


def _multiplied(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Products of (blocks, m, terms) and (blocks, terms, n) float32, (blocks, m, n) float32."""
    found = np.empty((len(left), left.shape[1], right.shape[2]), np.float32)
    for top in range(0, left.shape[1], _TILE):
        for first in range(0, right.shape[2], _TILE):
            here = np.s_[:, top : top + _TILE, first : first + _TILE]
            np.matmul(left[:, top : top + _TILE], right[..., first : first + _TILE], out=found[here])
    return found
