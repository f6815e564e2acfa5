"""Pictures of what `thermorender.validate.comparison` compares, one per pose and map."""

import numpy as np

from thermorender import files
from thermorender.units import ZERO_CELSIUS_K


def picture(path, visible, reference, name, pictures, time_s):
    """Visible, reference, what a map gives in its domains and their errors as one PNG with scales in °C."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(2, 3, figsize=(15, 8.6), layout="constrained")
    flat = reference[np.isfinite(reference)]
    low, high = np.percentile(flat, [1, 99]) - ZERO_CELSIUS_K
    axes[0, 0].imshow(visible)
    axes[0, 0].set_title(f"visible view, t = {time_s:.1f} s")
    shown = axes[1, 0].imshow(reference - ZERO_CELSIUS_K, cmap="inferno", vmin=low, vmax=high)
    axes[1, 0].set_title("reference: rendered from truth")
    figure.colorbar(shown, ax=axes[1, 0], label="apparent temperature [°C]", shrink=0.8)
    domains = [(row, domain) for row, domain in enumerate(("2D", "3D")) if f"{name} {domain}" in pictures]
    errors = np.concatenate([pictures[f"{name} {domain}"][1].ravel() for _, domain in domains])
    errors = errors[np.isfinite(errors)]
    limit = float(np.percentile(np.abs(errors), 98)) if errors.size else 1.0
    for row, domain in domains:
        seen, error = pictures[f"{name} {domain}"]
        what = "translation of the visible frame" if domain == "2D" else "render of the translated orthophoto"
        shown = axes[row, 1].imshow(seen - ZERO_CELSIUS_K, cmap="inferno", vmin=low, vmax=high)
        axes[row, 1].set_title(f"{name} {domain}: {what}")
        figure.colorbar(shown, ax=axes[row, 1], label="apparent temperature [°C]", shrink=0.8)
        shown = axes[row, 2].imshow(error, cmap="RdBu_r", vmin=-limit, vmax=limit)
        finite = error[np.isfinite(error)]
        figure.colorbar(shown, ax=axes[row, 2], label="error [°C]", shrink=0.8)
        if finite.size:
            axes[row, 2].set_title(f"error: mean {finite.mean():+.2f}, std {finite.std():.2f} °C")
    for axis in axes.ravel():
        axis.set_axis_off()
    with files.atomic(path) as part:
        figure.savefig(part, dpi=80)
    pyplot.close(figure)
