"""Sample pictures of a training: photograph, truth, translation and error of validation crops, a row each."""

import numpy as np

from thermorender import formats

# Errors are shown from blue to red up to this [K]; truth and translation share a grey scale in each row.
ERROR_K = 10.0
_GAP = 4


def write(path, crops, true_k, found_k):
    """Write a PNG of crops with their true and translated temperatures, (side, side) [K] each; NaN is shown black."""
    rows = []
    for crop, true, found in zip(crops, true_k, found_k, strict=True):
        known = np.isfinite(true)
        low, high = np.percentile(true[known], (1.0, 99.0)) if known.any() else (0.0, 1.0)
        grey = [np.nan_to_num(np.clip((each - low) / max(high - low, 0.1), 0.0, 1.0)) for each in (true, found)]
        off = np.clip(np.nan_to_num((found - true) / ERROR_K), -1.0, 1.0)
        error = np.stack([1.0 + np.minimum(off, 0.0), 1.0 - np.abs(off), 1.0 - np.maximum(off, 0.0)], axis=-1)
        tiles = [crop.inputs.rgb, *(np.repeat(255.0 * each[..., None], 3, axis=-1) for each in grey), 255.0 * error]
        rows.append(np.concatenate([np.pad(np.uint8(tile), ((_GAP, 0), (_GAP, 0), (0, 0))) for tile in tiles], axis=1))
    formats.write_image(path, np.concatenate(rows))
