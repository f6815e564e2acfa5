"""Quantisation of a network's weights, as coarse as the change of its output allows.

Each tensor's share of the error is measured. Steps minimise the file for a given error, with equal error from each
weight (reverse water-filling: Cover & Thomas, Elements of Information Theory, 10.3.3).
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch

from thermorender.learned.networks.building import predicted
from thermorender.learned.networks.packing import MOST_CODE
from thermorender.learned.networks.predictor import Network, device

# Smaller tensors stay in half precision: they hold a hundredth of the weights.
_LEAST_SIZE = 2000
# Part of a tensor's standard deviation that its influence is measured with, and rounds of the search for the steps.
_TRIAL, _DOUBLINGS, _HALVINGS = 0.1, 6, 7

State = dict[str, np.ndarray]


def coarse(network: Network, planes: Sequence[torch.Tensor], allowed: float) -> Network:
    """Return a quantised Network; its encoded output of planes (n, channels, h, w) changes by `allowed` on average."""

    def give(state: State) -> np.ndarray:
        net = replace(network, state=state).net
        with torch.inference_mode():
            found = (predicted(network.recipe, net, each.to(device()))[:, 0].cpu().numpy().ravel() for each in planes)
            return np.concatenate(list(found))

    steps, shift = coarsest_steps(network.state, give, allowed)
    encoding = replace(network.encoding, offset=network.encoding.offset - network.encoding.scale * shift)
    return replace(network, encoding=encoding, steps=steps)


def coarsest_steps(
    state: State, give: Callable[[State], np.ndarray], allowed: float
) -> tuple[dict[str, float], float]:  # fmt: skip
    """Return ({name: step} of the large tensors of a network, shift of the whole output that they cause).

    `give` returns the output for other weights. Without the shift, its mean absolute change is at most `allowed`.
    """
    whole, relative = give(state), _relative_steps(state, give, allowed)

    def steps(scale: float) -> dict[str, float]:
        # No coarser than a tensor's greatest weight, which then is its only one, and none finer than two bytes hold.
        limits = {name: np.abs(state[name]).max() for name in relative}
        return {name: float(np.float32(np.clip(scale * relative[name], limits[name] / MOST_CODE[2], limits[name])))
                for name in relative}  # fmt: skip

    def changes(scale: float) -> tuple[np.ndarray, float]:
        changed = {name: _rounded(state[name], step) for name, step in steps(scale).items()}
        found = give(state | changed) - whole
        return found - found.mean(), float(found.mean())

    def fits(scale: float) -> bool:
        return bool(np.mean(np.abs(changes(scale)[0])) <= allowed)

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


def _relative_steps(state: State, give: Callable[[State], np.ndarray], allowed: float) -> dict[str, float]:
    """{name: step} of the large tensors, up to a common factor: each weight contributes equal error."""
    whole, found = give(state), {}
    for name, values in state.items():
        if values.ndim > 1 and values.size >= _LEAST_SIZE and np.ptp(values) > 0.0:
            step = _TRIAL * float(values.std())
            change = np.sqrt(np.mean((give(state | {name: _rounded(values, step)}) - whole) ** 2))
            found[name] = step * np.sqrt(values.size) / max(float(change), 1e-9 * allowed)
    return found


def _rounded(values: np.ndarray, step: float) -> np.ndarray:
    """Weights rounded to whole multiples of a step, float32."""
    return (np.rint(values / step) * step).astype(np.float32)
