"""The figure of a day: kinetic temperature of each material over the local solar hour."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files
from thermorender.formats import label
from thermorender.units import ZERO_CELSIUS_K

# Okabe and Ito, Color Universal Design (2008): distinct for every kind of colour vision; black is for the air.
_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#CC79A7", "#F0E442")
_DASHES = ("-", "--", "-.", ":")


def figure(
    path: Path, name: str, rows: Sequence[dict[str, Any]], sun: tuple[NDArray[np.float64], NDArray[np.bool_]]
) -> None:
    """Write a PNG of the rows of `output.day.day`; `sun` is (solar hours (N,), whether it is up): night is shaded."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    materials = [key.removesuffix("_mean_k") for key in rows[0] if key.endswith("_mean_k") and key != "apparent_mean_k"]
    hours = np.array([row["solar_hour"] for row in rows])
    drawing = Figure(figsize=(9.0, 5.4), layout="constrained")
    FigureCanvasAgg(drawing)
    axis = drawing.subplots()
    axis.fill_between(sun[0], 0.0, 1.0, where=~sun[1], step="mid", transform=axis.get_xaxis_transform(), color="0.9",
                      linewidth=0, zorder=0)  # fmt: skip
    for number, material in enumerate(materials):
        colour, dash = _COLOURS[number % len(_COLOURS)], _DASHES[number // len(_COLOURS) % len(_DASHES)]
        low, mean, high = (np.array([row[f"{material}_{kind}_k"] for row in rows]) for kind in ("min", "mean", "max"))
        axis.plot(hours, mean, dash, color=colour, linewidth=1.8, label=label(material))
        if len(materials) <= 4:
            axis.fill_between(hours, low, high, color=colour, alpha=0.12, linewidth=0)
    axis.plot(hours, [row["air_k"] for row in rows], color="black", linewidth=1.2, linestyle=(0, (1, 1)), label="air")
    axis.plot(hours, [row["apparent_mean_k"] for row in rows], color="0.45", linewidth=1.2, linestyle=(0, (5, 1)),
              label="apparent, mean of the frame")  # fmt: skip
    axis.set(xlim=(0, 24), xlabel="mean solar time [h]", ylabel="kinetic temperature [K]",
             title=f"{label(name)}, day from {rows[0]['time_utc']}: mean over the terrain; grey: sun down")  # fmt: skip
    axis.set_xticks(range(0, 25, 3))
    axis.grid(alpha=0.3)
    celsius = axis.secondary_yaxis(
        "right",
        functions=(
            lambda kelvin: np.asarray(kelvin) - ZERO_CELSIUS_K,
            lambda celsius: np.asarray(celsius) + ZERO_CELSIUS_K,
        ),
    )
    celsius.set_ylabel("[°C]")
    drawing.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    with files.atomic(path) as part:
        drawing.savefig(part, dpi=120)
