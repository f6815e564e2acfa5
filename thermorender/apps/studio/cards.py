"""What stands below a picture: figures of the picked pixel and of kept points, origins of its radiance, its heat
balance, and the materials in view. Figures of what the view is compared with stand beside."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.studio.layers import LAYERS, Shot, statistics
from thermorender.apps.studio.pictures import MaterialColours, Picture, quantity
from thermorender.apps.studio.view import View
from thermorender.render.pixels.parts import PixelParts

# Parts of a pixel's radiance, in words.
_ORIGINS = {
    "emission": "Emission", "sky": "Reflected sky", "sun": "Reflected sun", "surroundings": "Reflected surroundings",
    "air": "Air in between", "background": "Background",
}  # fmt: skip
# Terms of a heat balance that are not worth a row [W/m²].
_LEAST_W_M2 = 0.05
Pixel = tuple[int, int]  # (column, row)


@dataclass(frozen=True)
class Point:
    """A point of the scene that was picked in a view."""

    name: str  # "" of one that is not kept
    view: View
    pixel: Pixel  # in that view
    position: NDArray[np.float64]  # local [m]; NaN on the sky
    texel: int  # of the static surfaces; −1 on a moving object or the sky

    @classmethod
    def at(cls, shot: Shot, pixel: Pixel, name: str = "") -> "Point | None":
        """Return the Point that a pixel shows; None outside the picture."""
        found = shot.figures(*pixel)
        if found is None:
            return None
        return cls(name, shot.view, pixel, np.array(found["position"], np.float64), found["texel"])

    def pixel_in(self, shot: Shot) -> Pixel | None:
        """Return the pixel that shows the point; None where it is hidden or outside the picture."""
        return self.pixel if self.view.place == shot.view.place else shot.pixel_of(self.position)


def hovered(shot: Shot, picture: Picture, pixel: Pixel) -> str:
    """Return the words about the pixel under the pointer; "" outside the picture."""
    found = shot.figures(*pixel)
    if found is None:
        return ""
    what = f" · {found['object'] or found['material']}" if found["material"] else " · no surface"
    if found["apparent_k"] is not None:
        words = f"{found['apparent_k']:.2f} K apparent"
    else:
        words = f"{found['kinetic_k']:.2f} K kinetic" if found["material"] else "nothing"
    value = _value_at(picture, pixel)
    if value is not None and (picture.difference or shot.view.layer not in ("apparent", "kinetic")):
        words += f" · {_shown_name(picture, shot.view).lower()} {value}"
    return words + what


def below(
    shot: Shot, picture: Picture, picked: Point | None, kept: Sequence[Point], parts: PixelParts | None,
    areas_m2: dict[str, float], colours: MaterialColours,
) -> dict[str, Any]:  # fmt: skip
    """Return what the page shows below a picture; `parts` are of the picked pixel."""
    told: dict[str, Any] = {"marks": [], "probes": [], "table": _table(shot, picture, areas_m2, colours)}
    told["sides"] = list(picture.sides or ())
    for point in kept:
        place = point.pixel_in(shot)
        found = None if place is None else shot.figures(*place)
        row = [point.name, (found["material"] or "none") if found else "not in view", *_kelvins(found)]
        told["probes"].append([*row, (_value_at(picture, place) or "") if place else ""])
        if place is not None:
            told["marks"].append([*_centre(place, shot), point.name])
    if picked is None:
        return told
    place = picked.pixel_in(shot)
    found = None if place is None else shot.figures(*place)
    if place is None or found is None:
        return {**told, "figures": [["Pixel", "the picked point is not in view"]]}
    told["marks"].append([*_centre(place, shot), ""])
    other = shot.other.figures(*place) if shot.other is not None else None
    told["figures"] = _figures(shot, picture, place, found, other, parts)
    told["parts"] = _part_rows(parts)
    told["heat"] = _heat_rows(shot.heat_at(*place), shot.other.heat_at(*place) if shot.other is not None else None)
    return told


def _figures(
    shot: Shot, picture: Picture, place: Pixel, found: dict[str, Any], other: dict[str, Any] | None,
    parts: PixelParts | None,
) -> list[list[str]]:  # fmt: skip
    """Rows of words, value, and the value of what the view is compared with."""

    def row(words: str, key: str, text: str) -> list[str]:
        both = [text.format(each[key]) if each[key] == each[key] else "none" for each in (found, other) if each]
        return [words, *both]

    rows = [["Pixel", f"column {place[0]}, row {place[1]}"]]
    if (value := _value_at(picture, place)) is not None and (
        picture.difference or shot.view.layer not in ("apparent", "kinetic")
    ):
        rows.append([_shown_name(picture, shot.view), value])
    if found["apparent_k"] is not None:
        rows += [
            row("Apparent temperature", "apparent_k", "{:.3f} K"),
            row("Radiance", "radiance", "{:.4f} W m⁻² sr⁻¹"),
        ]
    if not found["material"]:
        return [*rows, ["Surface", "none: sky, or ground beyond the scene"]]
    east, north, up = found["position"]
    return [
        *rows,
        row("Kinetic temperature", "kinetic_k", "{:.3f} K"),
        row("Band emissivity", "emissivity", "{:.4f}"),
        row("Material", "material", "{}"),
        *([["Object", found["object"]]] if found["object"] else []),
        *([["View angle", f"{parts.angle_deg:.1f}°"]] if parts and math.isfinite(parts.angle_deg) else []),
        ["Position E, N, up", f"{east:.1f}, {north:.1f}, {up:.1f} m"],
    ]


def _shown_name(picture: Picture, view: View) -> str:
    return "Difference" if picture.difference else LAYERS[view.layer].title


def _value_at(picture: Picture, place: Pixel) -> str | None:
    """The value that a picture shows at a pixel, with its unit; None without one."""
    if picture.values is None or picture.unit == "level":
        return None
    value = float(picture.values[place[1], place[0]])
    return quantity(value, picture.unit) if math.isfinite(value) else "none"


def _kelvins(found: dict[str, Any] | None) -> list[str]:
    """Apparent and kinetic temperature of a pixel in words."""
    if found is None:
        return ["", ""]
    apparent = found["apparent_k"]
    return ["" if apparent is None else f"{apparent:.2f} K", f"{found['kinetic_k']:.2f} K"]


def _centre(place: Pixel, shot: Shot) -> list[float]:
    """The middle of a pixel as shares of the picture."""
    height, width = shot.texels.shape
    return [(place[0] + 0.5) / width, (place[1] + 0.5) / height]


def _part_rows(parts: PixelParts | None) -> list[list[str]]:
    """Rows of the parts of a pixel's radiance: name, words, radiance, kelvins."""
    if parts is None:
        return []
    rows = []
    for name, part in parts.radiance.items():
        if part or parts.kelvin[name]:
            kelvins = quantity(round(parts.kelvin[name], 4) + 0.0, "K")
            rows.append([name, _ORIGINS.get(name, name), f"{round(part, 4) + 0.0:.4f}", kelvins])
    return rows


def _heat_rows(terms: dict[str, float], other: dict[str, float] | None) -> list[list[str]]:
    """Rows of the terms of a heat balance in words, in that compared with, too, and their sum."""
    states = [each for each in (terms, other) if each is not None]
    if not terms:
        return []
    rows = [
        [LAYERS[name].title, *(quantity(each[name], "W/m²") if each else "" for each in states)]
        for name in terms
        if any(abs(each.get(name, 0.0)) >= _LEAST_W_M2 for each in states)
    ]
    return [*rows, ["Sum", *(quantity(sum(each.values()), "W/m²") if each else "" for each in states)]]


def _table(
    shot: Shot, picture: Picture, areas_m2: dict[str, float], colours: MaterialColours
) -> list[list[str]]:  # fmt: skip
    """Rows of the materials in view: name, colour, share of the pixels, mean, extremes, area from above."""
    values = picture.values if picture.unit != "level" else None
    shown: list[list[str]] = []
    for row in statistics(shot, values):
        figures = ["" if each is None else quantity(each, picture.unit) for each in (row.mean, row.least, row.greatest)]
        area = areas_m2.get(row.name)
        area_text = "" if area is None else f"{area:.4g} m²"
        shown.append([row.name, colours.of(row.name), f"{row.share:.1%}", *figures, area_text])
    return shown
