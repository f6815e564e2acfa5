"""The chart of a spectrum, as options of ECharts."""

from typing import Any

import numpy as np

from thermorender.materials.material import Material
from thermorender.studio.fields import SHOWN_UM

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
    return {
        "animation": False,
        "grid": {"left": 46, "right": 14, "top": 12, "bottom": 40},
        "xAxis": {"type": "value", "min": float(axis[0]), "max": float(axis[-1]), "name": "wavelength [µm]",
                  "nameLocation": "middle", "nameGap": 24, "splitLine": {"show": False}},
        "yAxis": {"type": "value", "min": float(low), "max": 1.0, "name": "", "splitNumber": 4},
        "tooltip": {"trigger": "axis", "valueFormatter": None, "confine": True, "show": False},
        "series": series,
    }  # fmt: skip


def by_angle(material: Material, band_um: tuple[float, float], kelvin: float) -> dict[str, Any]:
    """Return the options of a chart of band emissivity against the angle from the normal."""
    values = [float(material.band_emissivity(*band_um, kelvin, np.cos(np.radians(angle)))) for angle in _ANGLES]
    return {
        "animation": False,
        "grid": {"left": 46, "right": 14, "top": 12, "bottom": 40},
        "xAxis": {"type": "value", "min": 0, "max": 90, "interval": 30, "name": "angle from the normal [°]",
                  "nameLocation": "middle", "nameGap": 24, "splitLine": {"show": False}},
        "yAxis": {"type": "value", "min": float(np.floor(10.0 * min(values)) / 10.0), "max": 1.0, "splitNumber": 4},
        "series": [_line("emissivity", _ANGLES, np.array(values), {"lineStyle": {"color": _COLOUR, "width": 2}})],
    }  # fmt: skip


def _axis(material: Material) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The wavelengths at which a spectrum is drawn [µm]: those of its table and its ends within the shown range."""
    first, last = material.valid_range_um
    low, high = max(SHOWN_UM[0], first), min(SHOWN_UM[1], last)
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
