"""Plot of materials' emissivity against wavelength with its spread, and against angle if it varies."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError
from thermorender.files import atomic, check_output_file
from thermorender.formats import label
from thermorender.materials.material import Material

# Plotted range besides the camera's band, that of long-wave infrared cameras; tables may cover more.
DRAWN_UM = (7.0, 14.0)
MOST_MATERIALS = 8


def plot(
    materials: Sequence[Material], path: str | Path, band_um: tuple[float, float] = BAND_UM, temperature: float = 300.0
) -> Path:
    """Write a PNG of the hemispherical emissivity of one to eight materials, ± one standard deviation; return its path.

    The axis covers 7–14 µm and the camera's band [µm], which is shaded. The legend has the band emissivity at a
    temperature [K]. For materials with an angular model, a second panel shows it against the angle from the normal.
    """
    path = Path(path)
    if not 1 <= len(materials) <= MOST_MATERIALS:
        raise ThermorenderError(
            f"{len(materials)} materials cannot be distinguished in one plot; give 1 to {MOST_MATERIALS}"
        )
    check_output_file(path, (".png",))
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    directional = [material for material in materials if material.emissivity_by_angle is not None]
    figure = Figure(figsize=(12.5 if directional else 8.0, 5.2), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2 if directional else 1, squeeze=False, width_ratios=[1.6, 1] if directional else [1])[0]
    axes[0].axvspan(*band_um, color="0.93", zorder=0)
    drawn = min(DRAWN_UM[0], band_um[0]), max(DRAWN_UM[1], band_um[1])
    lowest = 1.0
    for index, material in enumerate(materials):
        colour = f"C{index}"
        inside = (material.wavelength_um >= drawn[0]) & (material.wavelength_um <= drawn[1])
        wavelength, mean, std = (
            values[inside] for values in (material.wavelength_um, material.emissivity, material.emissivity_std)
        )
        for start, _ in material.gaps_um:
            after = np.searchsorted(wavelength, start, side="right")
            wavelength, mean, std = (np.insert(values, after, np.nan) for values in (wavelength, mean, std))
        axes[0].plot(wavelength, mean, color=colour, linewidth=1.6, label=_label(material, band_um, temperature))
        if np.isfinite(std).any():
            upper = np.minimum(mean + std, 1.0)
            axes[0].fill_between(wavelength, mean - std, upper, color=colour, alpha=0.2, linewidth=0)
        lowest = min(lowest, np.nanmin(np.where(np.isfinite(std), mean - std, mean)))
        if material.cosines is not None:
            angle = np.degrees(np.arccos(material.cosines))
            fine = np.union1d(angle, np.linspace(0.0, 90.0, 181))
            low, high = np.clip(band_um, *material.valid_range_um)
            if low < high:
                band = [material.band_emissivity(low, high, temperature, np.cos(np.radians(a))) for a in fine]
                axes[1].plot(fine, band, color=colour, linewidth=1.6)
    axes[0].set(
        xlim=drawn, ylim=(max(0.0, lowest - 0.02), 1.005), xlabel="wavelength [µm]", ylabel="emissivity [1]",
        title="hemispherical emissivity, mean ± standard deviation over samples",
    )  # fmt: skip
    axes[0].grid(alpha=0.3)
    figure.legend(
        loc="outside lower center", ncols=1 if len(materials) < 4 else 2, frameon=False, fontsize=9,
        title=f"grey: camera band {band_um[0]:g}–{band_um[1]:g} µm; ε over it at {temperature:g} K", title_fontsize=9,
    )  # fmt: skip
    if directional:
        axes[1].set(xlim=(0, 90), ylim=(0, 1.005), xlabel="angle from the normal [°]", ylabel="band emissivity [1]",
                    title="by direction")  # fmt: skip
        axes[1].set_xticks(range(0, 91, 15))
        axes[1].grid(alpha=0.3)
    with atomic(path) as part:
        figure.savefig(part, dpi=120)
    return path


def _label(material: Material, band_um: tuple[float, float], temperature: float) -> str:
    first, last = material.valid_range_um
    low, high = max(band_um[0], first), min(band_um[1], last)
    if (low, high) == tuple(band_um):
        return (
            f"{label(material.name)}: ε = {material.band_emissivity(low, high, temperature):.3f}, {_samples(material)}"
        )
    return f"{label(material.name)}: measured {first:g}–{last:g} µm only, {_samples(material)}"


def _samples(material: Material) -> str:
    if material.directional == "fresnel":
        return "from n and k"
    return "1 sample" if material.samples == 1 else f"{material.samples} samples"
