"""Figure of the study of heat: measured and modelled surface temperature at every site."""

import numpy as np

from thermorender import files
from thermorender.units import ZERO_CELSIUS_K

# Length of the drawn part of a record [h].
_SHOWN_H = 96.0
_COLOURS = {"measured": "black", "balance": "#0072B2", "force–restore": "#E69F00", "sinusoid": "#009E73", "air": "0.6"}


def figure(path, result):
    """Draw the last days of each site's record."""
    from matplotlib.figure import Figure

    sites = result["sites"]
    across = 3
    down = -(-len(sites) // across)
    drawing = Figure(figsize=(15, 3.3 * down), layout="constrained")
    all_axes = np.atleast_1d(drawing.subplots(down, across)).ravel()
    for axes, (name, site) in zip(all_axes, sites.items(), strict=False):
        series = site["series"]
        time = np.array(series["time"], "datetime64[s]")
        hour = (time - time[-1]) / np.timedelta64(3600, "s")
        part = hour >= max(hour[0], -_SHOWN_H)
        hour = hour[part] - hour[part][0]
        dark = np.array(series["elevation_deg"])[part] < 0.0
        axes.fill_between(hour, 0, 1, where=dark, transform=axes.get_xaxis_transform(), color="0.93", lw=0)
        for label, colour in _COLOURS.items():
            values = np.array(series[label], dtype=float)[part] - ZERO_CELSIUS_K
            axes.plot(hour, values, color=colour, lw=1.6 if label in ("measured", "balance") else 0.9, label=label)
        score = site["scores"]["balance"]
        errors = [score[part]["mae"] for part in ("day", "night")]
        shown = " / ".join(f"{error:.2f}" if np.isfinite(error) else "–" for error in errors)
        axes.set(title=f"{site['title']}\nMAE {shown} K", ylabel="°C")
        axes.set_xlabel(f"hours since {time[part][0]}Z")
        axes.title.set_fontsize(9)
        axes.grid(alpha=0.3)
        if name == next(iter(sites)):
            axes.legend(fontsize=7)
    for axes in all_axes[len(sites) :]:
        axes.set_visible(False)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=80, metadata={"Software": None})
