"""The spectrum of a material: its chart as options of ECharts, points that are dragged, and files that a page sends."""

from typing import Any

import numpy as np

from thermorender import Material
from thermorender.apps.material_tables.edit import share, with_spectrum, with_spectrum_of
from thermorender.apps.material_tables.from_samples import SOLAR_RANGE_UM
from thermorender.errors import ThermorenderError
from thermorender.files import scratch_folder

# Longest body of a request: a spectrum file is far shorter.
MOST_BYTES = 2_000_000
# A laboratory's spectrum has some thousand rows; more would hold the page up.
_MOST_ROWS = 20_000
# Limits of a table that is drawn and dragged [µm].
_SHOWN_UM = (2.5, 16.0)
_GRID_UM = 0.25
# A row of a table this close to a point is that point [µm].
_CLOSE_UM = 0.002

# Number of the series whose points are dragged, and how many of them there are.
HANDLES, _MOST_HANDLES = 0, 24
_ANGLES = np.arange(0.0, 88.0, 2.0)
# Colours of charts on a light page and, by True, on a dark one.
COLOURS = {
    False: {
        "ink": "#1d2733", "soft": "#51606f", "line": "#d5dce3", "paper": "#ffffff", "accent": "#0b6377",
        "saved": "#8a6d3b", "other": "#8a1f6d", "band": "rgba(240, 190, 80, 0.22)", "band_ink": "#5c4a12",
    },
    True: {
        "ink": "#e4eaf0", "soft": "#a3b1bf", "line": "#3a4653", "paper": "#161d26", "accent": "#5cc4d8",
        "saved": "#d9b878", "other": "#e58cc8", "band": "rgba(240, 190, 80, 0.16)", "band_ink": "#e8cf8f",
    },
}  # fmt: skip


def options(
    material: Material, saved: Material | None, other: Material | None, band_um: tuple[float, float],
    solar: bool = False, dark: bool = False,
) -> dict[str, Any]:  # fmt: skip
    """Return the options of a chart of emissivity against wavelength.

    The first series holds the handles; the others are the spectrum, its standard deviation over the samples, the saved
    spectrum where it differs, and another one that was laid over it. `solar` draws the solar range, without handles.
    """
    colours, shown = COLOURS[dark], SOLAR_RANGE_UM if solar else _SHOWN_UM
    axis = _axis(material, shown)
    value = material.emissivity_at(axis)
    std = np.interp(axis, material.wavelength_um, np.nan_to_num(material.emissivity_std))
    curves = {"as saved": _curve(saved, shown), "laid over": _curve(other, shown)}
    low = min(float((value - std).min()), *(v for _, curve in curves.values() for v in curve), 1.0)
    low = max(0.0, np.floor(10.0 * low - 0.5) / 10.0)
    handles = axis if axis.size <= _MOST_HANDLES else np.linspace(axis[0], axis[-1], _MOST_HANDLES)
    free = material.directional == "lambertian" and not solar
    area = [] if solar else [[{"xAxis": band_um[0], "name": "camera's band"}, {"xAxis": band_um[1]}]]
    series: list[dict[str, Any]] = [
        {
            "type": "scatter", "name": "handles", "symbolSize": 9 if free else 0, "z": 5, "silent": not free,
            "data": _pairs(handles, material.emissivity_at(handles)) if free else [], "cursor": "ns-resize",
            "itemStyle": {"color": colours["paper"], "borderColor": colours["accent"], "borderWidth": 2},
        },
        {
            "type": "line", "name": "emissivity", "showSymbol": False, "data": _pairs(axis, value),
            "lineStyle": {"color": colours["accent"], "width": 2}, "itemStyle": {"color": colours["accent"]},
            "markArea": {"silent": True, "data": area, "itemStyle": {"color": colours["band"]},
                         "label": {"color": colours["band_ink"], "position": "insideBottom", "fontSize": 11}},
        },
        _line("lower", axis, value - std, {"stack": "spread", "lineStyle": {"opacity": 0}}),
        _line("spread", axis, 2.0 * std, {"stack": "spread", "lineStyle": {"opacity": 0},
                                          "areaStyle": {"color": colours["accent"], "opacity": 0.15}}),
        _line("laid over", *curves["laid over"], _of(colours["other"], 1.5)),
        _line("as saved", *curves["as saved"], _of(colours["saved"], 1.5, "dashed")),
    ]  # fmt: skip
    x = {"min": float(axis[0]), "max": float(axis[-1]), "name": "wavelength [µm]"}
    y = {"min": float(low), "max": 1.0, "name": "absorptance [1]" if solar else "emissivity [1]", **_TITLED}
    made = chart(x, y, series, top=24 if saved or other else 12, dark=dark)
    named = [name for name, curve in curves.items() if len(curve[0])]
    legend = {"top": 0, "data": ["emissivity", *named], "selectedMode": False, "textStyle": {"color": colours["ink"]}}
    return made | ({"legend": legend} if named else {})


def by_angle(material: Material, band_um: tuple[float, float], kelvin: float, dark: bool = False) -> dict[str, Any]:
    """Return the options of a chart of band emissivity against the angle from the normal."""
    values = [float(material.band_emissivity(*band_um, kelvin, np.cos(np.radians(angle)))) for angle in _ANGLES]
    x = {"min": 0, "max": 90, "interval": 30, "name": "angle from the normal [°]"}
    y = {"min": float(np.floor(10.0 * min(values)) / 10.0), "max": 1.0, "name": "band emissivity [1]", **_TITLED}
    return chart(x, y, [_line("emissivity", _ANGLES, values, _of(COLOURS[dark]["accent"], 2.0))], dark=dark)


# An axis title beside the axis.
_TITLED = {"nameLocation": "middle", "nameGap": 32}


def chart(
    x: dict[str, Any], y: dict[str, Any], series: list[dict[str, Any]], top: int = 12, dark: bool = False
) -> dict[str, Any]:  # fmt: skip
    """Return the options of a chart with two axes of values, and `top` pixels above it."""
    colours = COLOURS[dark]
    axis = {
        "type": "value", "nameTextStyle": {"color": colours["ink"]}, "axisLabel": {"color": colours["soft"]},
        "axisLine": {"lineStyle": {"color": colours["soft"]}},
    }  # fmt: skip
    return {
        "animation": False,
        "grid": {"left": 48, "right": 14, "top": top, "bottom": 40},
        "xAxis": {**axis, "nameLocation": "middle", "nameGap": 24, "splitLine": {"show": False}, **x},
        "yAxis": {**axis, "splitNumber": 4, "splitLine": {"lineStyle": {"color": colours["line"]}}, **y},
        "series": series,
    }


def reaches_sunlight(material: Material) -> bool:
    """Return whether a material's spectrum has a part in the solar range, 0.3–2.5 µm, that can be drawn."""
    return bool(np.count_nonzero(material.wavelength_um < SOLAR_RANGE_UM[1]))


def words(material: Material) -> tuple[str, str]:
    """Return (what the width of the curve is, the solar absorptance and where it comes from)."""
    spread = "one sample, so no standard deviation" if material.samples == 1 else "no standard deviation"
    spread = "from n and k, without a standard deviation" if material.directional == "fresnel" else spread
    if np.isfinite(material.emissivity_std).any():
        spread = f"shaded: ± one standard deviation over {material.samples} samples"
    assumed = ", assumed" if material.solar_absorptance_std is None else ""
    (low, high), first = SOLAR_RANGE_UM, material.valid_range_um[0]
    below = "" if first <= low else f"; no spectrum below {first:g} µm"
    solar = f"{material.solar_absorptance:.3g} ± {material.solar_uncertainty:.2g} (one standard deviation{assumed})"
    return spread, f"solar absorptance over {low:g}–{high:g} µm {solar}{below}"


def _axis(material: Material, shown_um: tuple[float, float]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The wavelengths at which a spectrum is drawn [µm]: those of its table and its ends within a range."""
    first, last = material.valid_range_um
    low, high = max(shown_um[0], first), min(shown_um[1], last)
    inside = material.wavelength_um[(material.wavelength_um > low) & (material.wavelength_um < high)]
    for start, end in material.gaps_um:
        inside = inside[(inside <= start) | (inside >= end)]
    return np.union1d(inside, [low, high])


def _curve(material: Material | None, shown_um: tuple[float, float]) -> tuple[Any, Any]:
    """Wavelengths and emissivity of a curve; empty without a material, or outside its spectrum."""
    if material is None or not (material.valid_range_um[0] < shown_um[1] and material.valid_range_um[1] > shown_um[0]):
        return (), ()
    axis = _axis(material, shown_um)
    return axis, material.emissivity_at(axis)


def _of(colour: str, width: float, kind: str = "solid") -> dict[str, Any]:
    """The style of a line, and of its sign in the legend."""
    return {"lineStyle": {"color": colour, "width": width, "type": kind}, "itemStyle": {"color": colour}}


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
    nearest = float(grid[np.argmin(np.abs(grid - wavelength_um))])
    if abs(nearest - wavelength_um) > _CLOSE_UM:
        material.emissivity_at(wavelength_um)
        nearest = round(wavelength_um, 4)
        grid = np.union1d(grid, [nearest])
    now = material.emissivity_at(grid)
    bell = np.exp(-0.5 * ((grid - nearest) / max(width_um, 1e-6)) ** 2)
    moved = np.clip(now + (emissivity - now[grid == nearest]) * bell, 0.0, 1.0)
    return with_spectrum(material, grid, np.round(moved, 6), f"emissivity_at_{nearest:.4g}_um={emissivity:.4g}")


def read_spectrum(
    name: str, data: bytes, material: Material, column: str | None = None
) -> tuple[Material, str]:  # fmt: skip
    """Return (a material with the spectrum in the contents of a file, what was read in words); the file's name, for
    messages, is not used as a path.
    """
    if (rows := data.count(b"\n")) > _MOST_ROWS:
        raise ThermorenderError(
            f"{name} has {rows} rows, more than the {_MOST_ROWS} of the finest spectra; give one spectrum, thinned out"
        )
    with scratch_folder() as folder:
        path = folder / ("spectrum.txt" if name.lower().endswith(".txt") else "spectrum.csv")
        path.write_bytes(data)
        return with_spectrum_of(material, path, column, name)
