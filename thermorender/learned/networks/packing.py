"""Weights of a network on file in few bits: each tensor as coarse as the change of the network's output allows.

A large tensor is kept as whole multiples of one step, Huffman coded. With equal steps everywhere the tensors that the
output hardly depends on would take as many bits as those that decide it. So each tensor's share of the error is
measured, and steps are chosen that make the file smallest for a given error: that is where every weight, whichever
tensor it is of, adds as much (reverse water-filling: Cover & Thomas, Elements of Information Theory, 10.3.3).
"""

import zlib

import numpy as np

# Smaller tensors stay in half precision: they hold a hundredth of the weights.
_LEAST_SIZE = 2000
# Codes are −127…127, or in two bytes where a tensor needs finer steps.
_MOST = {1: 127, 2: 32767}
# Bytes that codes may unpack to: the largest network of full width, in two bytes a weight.
_MOST_BYTES = 1 << 29
# Part of a tensor's standard deviation that its influence is measured with, and rounds of the search for the steps.
_TRIAL, _DOUBLINGS, _HALVINGS = 0.1, 6, 7


def coarsest_steps(state, give, allowed):
    """Return ({name: step} of the large tensors of a network, as coarse as a change of its output allows, shift).

    Coarse weights shift the whole output, too: by `shift`, which whoever applies the network takes off again.

    Parameters
    ----------
    state : dict of str to float array
        Its weights.
    give : callable
        What the network gives for some pictures with other weights: {name: array} → array.
    allowed : float
        Greatest mean absolute change of what it gives, the shift taken off, in its unit.
    """
    whole, relative = give(state), {}
    for name, values in state.items():
        if values.ndim > 1 and values.size >= _LEAST_SIZE and np.ptp(values) > 0.0:
            step = _TRIAL * float(values.std())
            change = np.sqrt(np.mean((give(state | {name: _rounded(values, step)}) - whole) ** 2))
            relative[name] = step * np.sqrt(values.size) / max(float(change), 1e-9 * allowed)

    def steps(scale):
        # No coarser than a tensor's greatest weight, which then is its only one, and none finer than two bytes hold.
        limits = {name: np.abs(state[name]).max() for name in relative}
        return {name: float(np.float32(np.clip(scale * relative[name], limits[name] / _MOST[2], limits[name])))
                for name in relative}  # fmt: skip

    def changes(scale):
        changed = {name: _rounded(state[name], step) for name, step in steps(scale).items()}
        found = give(state | changed) - whole
        return found - found.mean(), float(found.mean())

    def fits(scale):
        return np.mean(np.abs(changes(scale)[0])) <= allowed

    # Where errors add up as those of independent tensors do, this is about the scale.
    low, high = 0.0, 2.0 * allowed / np.sqrt(sum(state[name].size for name in relative) or 1)
    for _ in range(_DOUBLINGS):
        if not fits(high):
            break
        low, high = high, 2.0 * high
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return steps(low), changes(low)[1]


def _rounded(values, step):
    return (np.rint(values / step) * step).astype(np.float32)


def packed(state, steps):
    """Return (codes, table) of the tensors that have a step: (n,) uint8, and what `unpacked` needs besides."""
    found, table = [], []
    for name, step in steps.items():
        codes = np.rint(state[name] / np.float32(step)).astype(np.int16)
        size = 1 if np.abs(codes).max() <= _MOST[1] else 2
        # Bytes of one place after the other: those above are nearly all alike.
        found.append(codes.astype(f"<i{size}").reshape(-1, 1).view(np.uint8).T.tobytes())
        table.append([name, list(codes.shape), size, step])
    press = zlib.compressobj(9, zlib.DEFLATED, -15, 9, zlib.Z_HUFFMAN_ONLY)
    return np.frombuffer(press.compress(b"".join(found)) + press.flush(), np.uint8), table


def unpacked(codes, table):
    """Return {name: float32 array} of `packed`.

    Raises
    ------
    ValueError
        The table is none, or does not belong to the codes.
    """
    sizes = []
    for name, shape, size, step in table:
        if not (isinstance(name, str) and size in _MOST and isinstance(step, float) and 0.0 < step < np.inf):
            raise ValueError("its table of weights is none")
        if not all(type(length) is int and 0 < length < 1 << 24 for length in shape):
            raise ValueError("its table of weights is none")
        sizes.append(size * int(np.prod([float(length) for length in shape])))
    if sum(sizes) > _MOST_BYTES:
        raise ValueError("its table of weights is of more than a network holds")
    press = zlib.decompressobj(-15)
    data = press.decompress(codes.tobytes(), sum(sizes) + 1)
    if len(data) != sum(sizes):
        raise ValueError("its weights are not those of its table")
    found, start = {}, 0
    for (name, shape, size, step), length in zip(table, sizes, strict=True):
        each = np.frombuffer(data, np.uint8, length, start).reshape(size, -1).T
        found[name] = np.ascontiguousarray(each).view(f"<i{size}").reshape(shape) * np.float32(step)
        start += length
    return found
