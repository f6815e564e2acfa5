"""The spectrum of a material: its chart as options of ECharts, points that are dragged, and files that a page sends."""

from typing import Any

import numpy as np

from thermorender import Material
from thermorender.apps.material_tables.edit import share, with_spectrum, with_spectrum_of
from thermorender.errors import ThermorenderError
from thermorender.files import scratch_folder

# Longest body of a request: a spectrum file is far shorter.
MOST_BYTES = 2_000_000
# A laboratory's spectrum has some thousand rows; more would hold the page up.
_MOST_ROWS = 20_000
# Limits of a table that is drawn and dragged [µm].
_SHOWN_UM = (2.5, 16.0)
_GRID_UM = 0.25

# Number of the series whose points are dragged, and how many of them there are.
HANDLES, _MOST_HANDLES = 0, 24
_COLOUR, _SAVED, _OTHER, _BAND = "#0b6377", "#8a6d3b", "#8a1f6d", "rgba(240, 190, 80, 0.22)"
_ANGLES = np.arange(0.0, 88.0, 2.0)


def options(
    material: Material, saved: Material | None, other: Material | None, band_um: tuple[float, float]
) -> dict[str, Any]:  # fmt: skip
    """Return the options of a chart of emissivity against wavelength.

    The first series holds the handles; the others are the spectrum, its spread, the saved spectrum where it differs,
    and another one that was laid over it.
    """
    axis = _axis(material)
    value = material.emissivity_at(axis)
    std = np.interp(axis, material.wavelength_um, np.nan_to_num(material.emissivity_std))
    low = min(float((value - std).min()), *_curve(saved)[1], *_curve(other)[1], 1.0)
    low = max(0.0, np.floor(10.0 * low - 0.5) / 10.0)
    handles = axis if axis.size <= _MOST_HANDLES else np.linspace(axis[0], axis[-1], _MOST_HANDLES)
    free = material.directional == "lambertian"
    area = [[{"xAxis": band_um[0], "name": "camera's band"}, {"xAxis": band_um[1]}]]
    series: list[dict[str, Any]] = [
        {
            "type": "scatter", "name": "handles", "symbolSize": 9 if free else 0, "z": 5, "silent": not free,
            "data": _pairs(handles, material.emissivity_at(handles)) if free else [],
            "itemStyle": {"color": "#ffffff", "borderColor": _COLOUR, "borderWidth": 2}, "cursor": "ns-resize",
        },
        {
            "type": "line", "name": "emissivity", "showSymbol": False, "data": _pairs(axis, value),
            "lineStyle": {"color": _COLOUR, "width": 2}, "itemStyle": {"color": _COLOUR},
            "markArea": {"silent": True, "data": area, "itemStyle": {"color": _BAND},
                         "label": {"color": "#5c4a12", "position": "insideTop", "fontSize": 11}},
        },
        _line("lower", axis, value - std, {"stack": "spread", "lineStyle": {"opacity": 0}}),
        _line("spread", axis, 2.0 * std, {"stack": "spread", "lineStyle": {"opacity": 0},
                                          "areaStyle": {"color": _COLOUR, "opacity": 0.15}}),
        _line("overlay", *_curve(other), {"lineStyle": {"color": _OTHER, "width": 1.5}}),
        _line("saved", *_curve(saved), {"lineStyle": {"color": _SAVED, "type": "dashed", "width": 1.5}}),
    ]  # fmt: skip
    x = {"min": float(axis[0]), "max": float(axis[-1]), "name": "wavelength [µm]"}
    return chart(x, {"min": float(low), "max": 1.0}, series)


def by_angle(material: Material, band_um: tuple[float, float], kelvin: float) -> dict[str, Any]:
    """Return the options of a chart of band emissivity against the angle from the normal."""
    values = [float(material.band_emissivity(*band_um, kelvin, np.cos(np.radians(angle)))) for angle in _ANGLES]
    x = {"min": 0, "max": 90, "interval": 30, "name": "angle from the normal [°]"}
    style = {"lineStyle": {"color": _COLOUR, "width": 2}}
    y = {"min": float(np.floor(10.0 * min(values)) / 10.0), "max": 1.0}
    return chart(x, y, [_line("emissivity", _ANGLES, values, style)])


def chart(x: dict[str, Any], y: dict[str, Any], series: list[dict[str, Any]], top: int = 12) -> dict[str, Any]:
    """Return the options of a chart with two axes of values, and `top` pixels above it."""
    return {
        "animation": False,
        "grid": {"left": 46, "right": 14, "top": top, "bottom": 40},
        "xAxis": {"type": "value", "nameLocation": "middle", "nameGap": 24, "splitLine": {"show": False}, **x},
        "yAxis": {"type": "value", "splitNumber": 4, **y},
        "series": series,
    }


def _axis(material: Material) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The wavelengths at which a spectrum is drawn [µm]: those of its table and its ends within the shown range."""
    first, last = material.valid_range_um
    low, high = max(_SHOWN_UM[0], first), min(_SHOWN_UM[1], last)
    inside = material.wavelength_um[(material.wavelength_um > low) & (material.wavelength_um < high)]
    for start, end in material.gaps_um:
        inside = inside[(inside <= start) | (inside >= end)]
    return np.union1d(inside, [low, high])


def _curve(material: Material | None) -> tuple[Any, Any]:
    """Wavelengths and emissivity of a curve; empty without a material."""
    return ((), ()) if material is None else (_axis(material), material.emissivity_at(_axis(material)))


def _pairs(x: Any, y: Any) -> list[list[float]]:
    return [[round(float(a), 4), round(float(b), 5)] for a, b in zip(x, y, strict=True)]


def _line(name: str, x: Any, y: Any, more: dict[str, Any]) -> dict[str, Any]:
    return {"type": "line", "name": name, "showSymbol": False, "silent": True, "data": _pairs(x, y)} | more


def dragged(material: Material, wavelength_um: float, emissivity: float, width_um: float) -> Material:
    """Return a Lambertian material whose spectrum passes through a point [µm, 1], with its surroundings moved along a
    bell curve of standard deviation `width_um`.
    """
    share(f"{emissivity:g}")
    grid = material.wavelength_um
    low, high = max(_SHOWN_UM[0], float(grid[0])), min(_SHOWN_UM[1], float(grid[-1]))
    # A coarse table, such as a grey one, gets rows that can follow.
    inner = grid[(grid >= low) & (grid <= high)]
    if inner.size < (high - low) / (2.0 * _GRID_UM):
        grid = np.union1d(grid, np.round(np.arange(low, high + 1e-9, _GRID_UM), 4))
    now = material.emissivity_at(grid)
    nearest = int(np.argmin(np.abs(grid - wavelength_um)))
    bell = np.exp(-0.5 * ((grid - grid[nearest]) / max(width_um, 1e-6)) ** 2)
    moved = np.clip(now + (emissivity - now[nearest]) * bell, 0.0, 1.0)
    return with_spectrum(material, grid, np.round(moved, 6), f"emissivity_at_{grid[nearest]:.4g}_um={emissivity:.4g}")


def read_spectrum(name: str, data: bytes, material: Material, column: str | None = None) -> Material:
    """Return a material with the spectrum in the contents of a file; its name, for messages, is not used as a path."""
    if (rows := data.count(b"\n")) > _MOST_ROWS:
        raise ThermorenderError(
            f"{name} has {rows} rows, more than the {_MOST_ROWS} of the finest spectra; give one spectrum, thinned out"
        )
    with scratch_folder() as folder:
        path = folder / ("spectrum.txt" if name.lower().endswith(".txt") else "spectrum.csv")
        path.write_bytes(data)
        return with_spectrum_of(material, path, column, name)
