"""Least squares of thermal intensity on k × k colours, in one pass: the fit of a Correlation.

Normal equations are summed exactly. Colours are bytes and the target is cut into bytes, so every product is a whole
number below 2¹⁶, of which 256 add up to less than 2²⁴: single precision holds such sums exactly, in whatever order a
fast matrix product takes them. Blocks of 256 are then summed in double precision, exact up to 2⁵³. The condition of the
3 × 3 equations on photographs is about 1e7, so rounding matters: in single precision throughout it costs 0.01 in a
coefficient.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.learned.correlation import Correlation
from thermorender.learned.rows import at_texel
from thermorender.learned.training import Example

# Terms of a sum that single precision holds exactly: 255² of them stay below 2²⁴.
_BLOCK = 256
# Bytes that the target's intensity is cut into: 1e-12 of its range.
_BYTES = 5
# Columns that are multiplied at a time: larger products would each be shared among threads, which costs more than it
# brings where pictures are shared among them already.
_COLUMNS = 28
# Shares of the largest eigenvalue of the equations below which they do not tell a direction.
_DEPENDENT = 1e-10
# Pictures that wait for a thread, so that memory stays bounded.
_AT_ONCE = 16


def fit_correlation(task, size):
    """Return the Correlation of size × size colours that fits a Task best.

    Parameters
    ----------
    task : Task
        Options: intercept, bool (the published form has none); penalty, weight of the coefficients' squares beside the
        mean square error, for colours in 0…1; above_air, bool, to learn kelvin above the air instead of intensity.
    size : int
        Odd.

    Raises
    ------
    ThermorenderError
        Pictures smaller than the neighbourhood only, or colours that do not tell the coefficients apart.
    """
    above_air = task.options.get("above_air", False)
    table, n = _Table(task.temperature if above_air else task.intensity), 3 * size * size
    normal, waiting = np.zeros((n + 2, n + 2)), []
    # Matrix products release the interpreter, so threads share the work.
    with ThreadPoolExecutor() as pool:
        for done, example in enumerate(task.examples(), 1):
            less = _air_k(example) if above_air else 0.0
            waiting.append(pool.submit(_equations, _at_texel(example, task.texel_m), size, table, less))
            if len(waiting) == _AT_ONCE:
                normal += waiting.pop(0).result()
                task.progress("summing the normal equations", done / max(task.count, 1))
        for each in waiting:
            normal += each.result()
    if normal[n, n] == 0.0:
        raise ThermorenderError(
            f"no picture has a valid neighbourhood of {size} × {size} pixels; give larger pictures, or a smaller "
            "neighbourhood"
        )
    found = solved(normal, size, task.options.get("intercept", False), task.options.get("penalty", 0.0))
    return replace(found, above_air=above_air)


def _at_texel(example, texel_m):
    """An Example at a ground sampling distance [m]; thermal values, which stand for others, are picked, no means."""
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


def _air_k(example):
    """The air's temperature of an example [K]."""
    if "air_k" not in example.inputs.conditions:
        raise ThermorenderError(
            "above_air=true needs the air's temperature of every pair, and one has none; give a data set with weather, "
            "or leave it out"
        )
    return example.inputs.conditions["air_k"]


def solved(normal, size, intercept, penalty):
    """Return the Correlation of summed normal equations, (n + 2, n + 2) as by `_equations`, n = 3 size²."""
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
            f"the pictures tell {kept} of {len(used)} coefficients only, as where they are grey or of one colour; give "
            "coloured pictures, or --set penalty=1e-6"
        )
    found = vectors @ ((vectors.T @ right) / values)
    # Once more with what is left over, for the digits that the eigenvectors' rounding cost.
    found += vectors @ ((vectors.T @ (right - left @ found)) / values)
    return Correlation(found[:n].reshape(size, size, 3), float(found[n]) if intercept else 0.0)


class _Table:
    """The bytes of each value's intensity, (_BYTES, n) float32, with the intensity of all bytes 0 and of each step."""

    def __init__(self, intensity):
        self.zero, high = float(intensity.min()), float(intensity.max())
        self.step = max(high - self.zero, 1e-300) / (256.0**_BYTES - 1.0)
        whole = np.rint((intensity - self.zero) / self.step).astype(np.uint64)
        shifts = np.arange(_BYTES, dtype=np.uint64)[:, None] * np.uint64(8)
        self.bytes = ((whole >> shifts) & np.uint64(255)).astype(np.float32)


def _equations(example, size, table, less=0.0):
    """AᵀA and AᵀI of a picture, (n + 2, n + 2) float64, columns being n colours (row, column, channel), 1 and I.

    `less` is taken from all of I. What lies below the diagonal is not filled.
    """
    rgb, ring = example.inputs.rgb, size // 2
    rows, columns = (max(side - 2 * ring, 0) for side in rgb.shape[:2])
    n = 3 * size * size
    total = np.zeros((n + 2, n + 2))
    if not (rows and columns):
        return total
    inner = slice(ring, ring + rows), slice(ring, ring + columns)
    valid = example.valid
    if ring and not valid.all():
        import cv2

        valid = cv2.erode(valid.astype(np.uint8), np.ones((size, size), np.uint8), borderValue=1) > 0
    valid = valid[inner]
    if not valid.any():
        return total
    weights = table.step * 256.0 ** np.arange(_BYTES)
    channels = np.ascontiguousarray(rgb.transpose(2, 0, 1), dtype=np.float32)
    for first in range(0, columns, _BLOCK):
        # One row of the picture is one block of terms.
        wide = min(_BLOCK, columns - first)
        a = np.empty((rows, n + 1 + _BYTES, wide), dtype=np.float32)
        for k in range(n):
            row, column, channel = k // (3 * size), k // 3 % size, k % 3
            a[:, k] = channels[channel, row : row + rows, column + first : column + first + wide]
        a[:, n] = 1.0
        values = example.values[inner][:, first : first + wide]
        for byte in range(_BYTES):
            a[:, n + 1 + byte] = np.take(table.bytes[byte], values)
        here = valid[:, first : first + wide]
        if not here.all():
            a *= here[:, None]
        for left in range(0, n + 1, _COLUMNS):
            right = min(left + _COLUMNS, n + 1)
            # What lies below the diagonal is what lies above.
            for top in range(left, n + 1 + _BYTES, _COLUMNS + _BYTES + 1):
                to = min(top + _COLUMNS + _BYTES + 1, n + 1 + _BYTES)
                product = (a[:, left:right] @ a[:, top:to].transpose(0, 2, 1)).sum(axis=0, dtype=np.float64)
                known, of = min(to, n + 1) - top, max(top - n - 1, 0)
                if known > 0:
                    total[left:right, top : top + known] += product[:, :known]
                if to > n + 1:
                    total[left:right, n + 1] += product[:, max(known, 0) :] @ weights[of : of + to - max(top, n + 1)]
    total[: n + 1, n + 1] += (table.zero - less) * total[: n + 1, n]
    return total
