"""The section through a material's layers: a drawing to scale, and its words."""

import math
from collections.abc import Sequence

from thermorender.materials.thermal import FILMS, Thermal

# Height of the words of a layer, beside which it is drawn; width of the drawing and of the layers in it [px].
ROW_PX = 44
_WIDTH_PX, _LAYER_PX = 96, 48
# Least height of a layer, least height of one that is drawn with a break, and height of an unlimited one [px].
_LEAST_PX, _BROKEN_PX, _UNLIMITED_PX = 6.0, 34.0, 38.0
_AIR = {
    "inside": "Room air", "outside": "Outdoor air", "ventilated": "Outdoor air in a cavity or loft",
}  # fmt: skip


def metres(value: float) -> str:
    """Return a thickness in mm below 0.1 m, else in m."""
    return f"{1e3 * value:.3g} mm" if value < 0.1 else f"{value:.3g} m"


def words(layer: Thermal) -> tuple[str, str]:
    """Return (thickness, conductivity and resistance) of a layer."""
    thickness = "unlimited" if layer.thickness_m is None else metres(layer.thickness_m)
    resistance = layer.resistance_m2_k_w
    stirred = ", stirred" if layer.cover == "water" else ""
    known = "" if resistance is None else f" · R {resistance:.3g} m² K W⁻¹"
    return thickness, f"{layer.conductivity_w_m_k:.3g} W m⁻¹ K⁻¹{stirred}{known}"


def behind(end: str, inside_c: float | None) -> str:
    """Return what is behind the last layer in words, with the scene's temperature of rooms [°C] if it has one; "" where
    that is unlimited.
    """
    air = f", {inside_c:g} °C" if end == "inside" and inside_c is not None else ""
    return f"{_AIR[end]}{air} · film R {1.0 / FILMS[end]:.2g} m² K W⁻¹" if end else ""


def totals(surface: Thermal) -> list[tuple[str, str]]:
    """Return figures of a stack of layers, (name, value with unit)."""
    depth, resistance, skin = (
        surface.diurnal_depth_m, surface.resistance_to_air_m2_k_w, surface.skin_conductance_w_m2_k
    )  # fmt: skip
    return [
        ("Thermal inertia, surface layer", f"{surface.inertia:.0f} J m⁻² K⁻¹ s^−½"),
        *([] if depth is None else [("Penetration depth, 24 h", metres(depth))]),
        *([] if resistance is None else [("R to the air behind, with its film", f"{resistance:.3g} m² K W⁻¹")]),
        *([("Skin conductance of the cover", f"{skin:g} W m⁻² K⁻¹")] if skin else []),
    ]


def heights(thickness_m: Sequence[float], space_px: float) -> tuple[list[tuple[float, bool]], float]:
    """Return ([(height [px], whether the layer has a break)], scale [px/m]) of layers that fill a space at most.

    All are to scale where the thinnest can be seen so; else thick ones are shortened by a break.
    """
    if not thickness_m:
        return [], 0.0
    scale = space_px / sum(thickness_m)
    if scale * min(thickness_m) >= _LEAST_PX:
        return [(scale * each, False) for each in thickness_m], scale
    scale, most = _LEAST_PX / min(thickness_m), 0.0
    for count in range(1, len(thickness_m) + 1):
        # The thickest so many share what the others leave.
        thin = sorted(thickness_m)[:-count]
        most = max(_BROKEN_PX, (space_px - scale * sum(thin)) / count)
        if not thin or scale * thin[-1] <= most:
            break
    return [(min(scale * each, most), scale * each > most) for each in thickness_m], scale


def drawing(layers: Sequence[Thermal], chosen: int) -> str:
    """Return the section as SVG, with lines to the rows of words at its right; colours are those of `studio.css`."""
    end = layers[-1].beneath
    rows = len(layers) + bool(end)
    height = ROW_PX * rows
    limited = [each.thickness_m for each in layers if each.thickness_m is not None]
    below_px = 24.0 if end else _UNLIMITED_PX
    sizes, scale = heights(limited, height - below_px - 12.0)
    sizes += [(_UNLIMITED_PX, True)] * (len(layers) - len(limited))
    top, parts, middles = 6.0, [], []
    for k, (size, broken) in enumerate(sizes):
        kind = f"layer{' chosen' if k == chosen else ''}{' odd' if k % 2 else ''}"
        parts.append(f'<rect class="{kind}" data-depth="{k}" y="{top:.1f}" width="{_LAYER_PX}" height="{size:.1f}"/>')
        if broken:
            at = top + (size - 8.0 if layers[k].thickness_m is None else 0.5 * size)
            parts.append(f'<path class="break" d="{_wave(at - 2.5)}{_wave(at + 2.5)}"/>')
        middles.append(top + 0.5 * size)
        top += size
    if end:
        parts.append(f'<rect class="air" y="{top:.1f}" width="{_LAYER_PX}" height="18"/>')
        middles.append(top + 9.0)
    parts += [
        f'<polyline class="lead" points="{_LAYER_PX},{at:.1f} {_LAYER_PX + 16},{ROW_PX * (k + 0.5):.1f} '
        f'{_WIDTH_PX},{ROW_PX * (k + 0.5):.1f}"/>'
        for k, at in enumerate(middles)
    ]
    parts.append(f'<line class="surface" x2="{_LAYER_PX}" y1="6" y2="6"/>')
    return (
        f'<svg class="section" width="{_WIDTH_PX}" height="{height}" viewBox="0 0 {_WIDTH_PX} {height}" '
        f'aria-hidden="true">{"".join(parts)}{_bar(scale, sizes, height)}</svg>'
    )


def _wave(at: float) -> str:
    """A wavy line across a layer."""
    step = _LAYER_PX / 4.0
    return f"M0,{at:.1f}" + "".join(f"q{step / 2:.1f},{-5 if k % 2 else 5} {step:.1f},0" for k in range(4))


def _bar(scale: float, sizes: Sequence[tuple[float, bool]], height: float) -> str:
    """A bar of a round length beside the layers, unless no layer is to scale."""
    if not scale or all(broken for _, broken in sizes):
        return ""
    power = 10.0 ** math.floor(math.log10(40.0 / scale))
    length = max(each for each in (power, 2.0 * power, 5.0 * power) if each * scale <= 40.0)
    size, left = length * scale, _LAYER_PX + 5
    return (
        f'<path class="bar" d="M{left - 3},{height - 2:.1f}h6M{left},{height - 2:.1f}v{-size:.1f}m-3,0h6"/>'
        f'<text class="bar" x="{left + 6}" y="{height - 3:.1f}">{metres(length)}</text>'
    )
