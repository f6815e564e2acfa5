"""Thermal properties of a material: its top layer, the layer beneath, and its exchange of heat and water with the air.

`thermal/<name>.csv` has a row for each property with its value, one standard deviation and the source. A source that
begins with `chosen:` marks a value without a measurement and gives the reason for it.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.csv_tables import Fault, contained, parsed_number, read_table
from thermorender.physics.moisture import TEXTURES
from thermorender.schema import closest
from thermorender.units import ZERO_CELSIUS_K

THERMAL_COLUMNS = ("property", "value", "uncertainty", "source")
CHOSEN = "chosen:"
COVERS = ("bare", "leaves", "water", "snow")
# What may be beneath besides a material, with the conductance of its film: still indoor air, and moving outdoor air
# under a sheet: ISO 6946:2017, table 7 [W m⁻² K⁻¹]. The face above outdoor air in a well ventilated cavity or loft has
# the resistance of still air (6.9.4).
FILMS = {"inside": 1.0 / 0.13, "outside": 1.0 / 0.04, "ventilated": 1.0 / 0.13}
ENDS = tuple(FILMS)
# Soils whose moisture follows the weather: `physics.moisture.TEXTURES`.
SOILS = tuple(TEXTURES)

_DAY_S = 86400.0
_SHARE = "give a share, 0.3 for 30 %"
# Limits of every number and advice for values outside; wide enough for aerogel, gold, a forest and a deep lake.
NUMBERS = {
    "conductivity_w_m_k": (0.005, 450.0, "divide by 1000 if the value is in mW m⁻¹ K⁻¹"),
    "density_kg_m3": (20.0, 23000.0, "multiply by 1000 if the value is in g/cm³"),
    "specific_heat_j_kg_k": (100.0, 5000.0, "multiply by 1000 if the value is in kJ kg⁻¹ K⁻¹"),
    "thickness_m": (1e-5, 200.0, "give metres, or leave it empty for an unlimited layer"),
    "skin_conductance_w_m2_k": (0.1, 1000.0, "give W m⁻² K⁻¹, or leave it empty for a surface on its layer"),
    "roughness_m": (1e-7, 10.0, "give the momentum roughness length in metres, about a tenth of the height"),
    "heat_roughness_ratio": (0.0, 30.0, "give ln(z0/z0h)"),
    "surface_resistance_s_m": (0.0, 1e5, "give s/m, 0 for free water, or leave it empty for a dry material"),
    "wetness": (0.0, 1.0, _SHARE),
    "water_share": (0.0, 1.0, _SHARE),
    "attenuation_1_m": (0.01, 1e4, "give 1/m, or leave it empty for an opaque layer"),
    "melting_k": (150.0, 3700.0, f"values are kelvin, add {ZERO_CELSIUS_K} to °C, or leave it empty"),
}
OPTIONAL = ("thickness_m", "beneath", "skin_conductance_w_m2_k", "surface_resistance_s_m", "attenuation_1_m",
            "melting_k", "texture")  # fmt: skip
# In the order of a table.
PROPERTIES = ("cover", *list(NUMBERS)[:4], "beneath", *list(NUMBERS)[4:], "texture")

# Only metals, which are denser than this, conduct better than this (rock and ice: up to 8 W m⁻¹ K⁻¹).
_METAL_W_M_K, _METAL_KG_M3 = 20.0, 1700.0


@dataclass(frozen=True)
class Thermal:
    """Thermal properties of a material, as in its table."""

    cover: str  # Which laws of exchange apply: "bare", "leaves", "water" or "snow"
    # conductivity_w_m_k, density_kg_m3, specific_heat_j_kg_k: Of the layer at its usual moisture
    conductivity_w_m_k: float
    density_kg_m3: float
    specific_heat_j_kg_k: float
    roughness_m: float  # Momentum roughness length z0 of land covered with it [m]
    heat_roughness_ratio: float  # ln(z0/z0h), often written kB⁻¹ [1]
    wetness: float  # Usual moisture available to evaporation, 0…1
    water_share: float  # Freezable water [m³ per m³ of the layer]
    thickness_m: float | None = None  # Thickness of the layer [m]; None: unlimited
    # Material below the layer; "inside": indoor air through a film; "outside": outdoor air; "ventilated": outdoor air
    # in a ventilated cavity or loft; "": unlimited layer
    beneath: str = ""
    # Between the radiating surface and the top of the layer (leaves over ground); None: in contact
    skin_conductance_w_m2_k: float | None = None
    # Resistance to evaporation [s/m]: for leaves the minimum of the canopy, in full sun and well watered; 0 for free
    # water; None: only rain and dew on it evaporate
    surface_resistance_s_m: float | None = None
    attenuation_1_m: float | None = None  # Of sunlight inside the layer [1/m]; None: opaque
    melting_k: float | None = None  # Upper limit of the surface temperature [K]
    # Kind of soil, one of `SOILS`, whose moisture follows the weather's rain; "": moisture is always the usual one
    texture: str = ""
    # One standard deviation of each number, in its unit. Positive numbers are log-normal: roughness lengths are known
    # to a factor.
    uncertainty: dict[str, float] = field(default_factory=dict)
    source: dict[str, str] = field(default_factory=dict)  # Source of each value; "chosen: …" without a measurement
    # Properties of the material `beneath`, filled in by the library; None if there is none, or not yet looked up
    below: "Thermal | None" = None

    @property
    def heat_capacity_j_m3_k(self) -> float:
        """Heat capacity of the layer per volume, ρc [J m⁻³ K⁻¹]."""
        return self.density_kg_m3 * self.specific_heat_j_kg_k

    @property
    def inertia(self) -> float:
        """Thermal inertia of the layer, √(kρc) [J m⁻² K⁻¹ s^-½]."""
        return float(np.sqrt(self.conductivity_w_m_k * self.heat_capacity_j_m3_k))

    @property
    def diurnal_depth_m(self) -> float | None:
        """Depth at which the daily temperature wave is 1/e of that at the surface, √(k P / (π ρ c)) with P of 24 h [m].

        It is the periodic penetration depth of EN ISO 13786:2017. None for water, which is stirred.
        """
        if self.cover == "water":
            return None
        return float(np.sqrt(self.conductivity_w_m_k * _DAY_S / (np.pi * self.heat_capacity_j_m3_k)))

    @property
    def resistance_m2_k_w(self) -> float | None:
        """Thermal resistance of the layer, thickness over conductivity [m² K W⁻¹]; None for an unlimited layer, and for
        water, which is stirred.
        """
        if self.thickness_m is None or self.cover == "water":
            return None
        return self.thickness_m / self.conductivity_w_m_k

    @property
    def resistance_to_air_m2_k_w(self) -> float | None:
        """Thermal resistance from the radiating surface to the air behind the last layer, with that air's film
        [m² K W⁻¹]; None if an unlimited layer or water is below.
        """
        parts = [each.resistance_m2_k_w for each in self.layers]
        known = [each for each in parts if each is not None]
        if len(known) < len(parts):
            return None
        skin = 1.0 / self.skin_conductance_w_m2_k if self.skin_conductance_w_m2_k else 0.0
        return skin + sum(known) + 1.0 / FILMS[self.layers[-1].beneath]

    @property
    def chosen(self) -> tuple[str, ...]:
        """Names of the properties without a measured value."""
        return tuple(key for key in PROPERTIES if self.source.get(key, "").startswith(CHOSEN))

    @property
    def values(self) -> dict[str, Any]:
        """The properties by name, in the order of a table; None or "" for empty cells."""
        return {key: getattr(self, key) for key in PROPERTIES}

    @property
    def layers(self) -> tuple["Thermal", ...]:
        """All layers from the surface down; the last one is unlimited, or ends at one of `ENDS`."""
        if self.below is None and self.beneath not in ("", *ENDS):
            raise ThermorenderError(
                f"beneath={self.beneath!r} has not been looked up; take the material from load_library(folder), which "
                "knows every layer"
            )
        return (self, *(self.below.layers if self.below else ()))

    def __str__(self) -> str:
        width = max(map(len, PROPERTIES))
        lines = []
        for key, value in self.values.items():
            if value not in (None, ""):
                spread = f" ± {self.uncertainty[key]:g}" if key in self.uncertainty else ""
                text = f"{value:g}{spread}" if key in NUMBERS else value
                lines.append(f"{key:{width}}  {text:<18}  {self.source.get(key, '')}".rstrip())
        return "\n".join(lines)


def read_thermal(path: str | Path) -> Thermal:
    """Return the Thermal of a CSV table of property, value, uncertainty, source; a missing row is an empty value."""
    thermal, faults = parsed(read_table(path, THERMAL_COLUMNS))
    if thermal is None:
        row, sentence = faults[0]
        raise ThermorenderError(f"{path}{f', row {row}' if row else ''}: {sentence}")
    return thermal


def parsed(rows: Iterable[tuple[int, dict[str, str]]]) -> tuple[Thermal | None, list[Fault]]:
    """Return (Thermal or None, list of faults as (row or None, sentence)) of a table's rows (number, cells)."""
    values: dict[str, Any] = {}
    uncertainty: dict[str, float] = {}
    source: dict[str, str] = {}
    faults: list[Fault] = []
    for row, cells in rows:
        key, text, spread = cells["property"], cells["value"], cells["uncertainty"]
        if key not in PROPERTIES:
            near = closest(key, PROPERTIES)
            hint = f"did you mean {near[0]}? " if near else ""
            faults.append((row, f"property={key!r} is not known; {hint}write one of {', '.join(PROPERTIES)}"))
            continue
        if key in values:
            faults.append((row, f"property {key} is already in a row above; keep one of them"))
            continue
        values[key], fault = _value(key, text)
        if fault:
            faults.append((row, fault))
        if not text:
            continue
        source[key] = cells["source"]
        if not source[key].removeprefix(CHOSEN).strip():
            faults.append((row, f"source of {key} is empty; say where the value comes from, or begin with '{CHOSEN}' "
                           "and give the reason"))  # fmt: skip
        if key in NUMBERS:
            name, advice = f"uncertainty of {key}", "give one standard deviation in the value's unit"
            number, fault = parsed_number(name, spread, 0.0, 1e6, advice)
            uncertainty[key] = number or 0.0
            faults += [(row, fault)] if fault else []
    # A refused value is not missing, since its source is recorded.
    missing = [key for key in PROPERTIES if key not in OPTIONAL and key not in source]
    if missing:
        faults.append((None, f"lacks {', '.join(missing)}; add a row with value, uncertainty and source for each"))
    faults += [(None, sentence) for sentence in _contradictions(values, source)]
    if faults:
        return None, faults
    return Thermal(**values, uncertainty=uncertainty, source=source), []


def _value(key: str, text: str) -> tuple[Any, str]:
    """(A property's value or None, sentence on its fault or "")."""
    if key == "beneath":
        return text, ""
    if not text:
        return "" if key == "texture" else None, ""
    if key == "texture":
        fault = f"texture={text!r} is not known; write one of {', '.join(SOILS)}, or leave it empty"
        return (text, "") if text in SOILS else (None, fault)
    if key == "cover":
        fault = f"cover={text!r} is not known; write {', '.join(COVERS[:-1])} or {COVERS[-1]}"
        return (text, "") if text in COVERS else (None, fault)
    return parsed_number(key, text, *NUMBERS[key])


def _contradictions(values: Mapping[str, Any], given: Mapping[str, str]) -> Iterator[str]:
    """Yield sentences on values that contradict each other; `given` holds the keys with a value, refused ones too."""
    beneath, conductivity, density = (values.get(key) for key in ("beneath", "conductivity_w_m_k", "density_kg_m3"))
    if "thickness_m" in given and not beneath:
        yield ("thickness_m has nothing beneath; name the material there, or inside, outside or "
               "ventilated, or leave the thickness empty for an unlimited layer")  # fmt: skip
    if beneath and "thickness_m" not in given:
        yield f"beneath={beneath!r} is given without thickness_m; give the layer's thickness, or leave beneath empty"
    if conductivity and density and conductivity > _METAL_W_M_K and density < _METAL_KG_M3:
        yield (f"conductivity_w_m_k={conductivity:g} is that of a metal, at density_kg_m3={density:g}; divide it by "
               "1000 if it is in mW m⁻¹ K⁻¹, or correct the density")  # fmt: skip
    if values.get("cover") == "snow" and "melting_k" not in given:
        yield f"melting_k of a snow cover is missing; write {ZERO_CELSIUS_K} for snow or ice"


def with_values(
    thermal: Thermal | None, settings: Mapping[str, str], source: str
) -> tuple[Thermal | None, list[str]]:  # fmt: skip
    """Return (Thermal or None, sentences on faults) of a table with other values, {property: text} and their source.

    An empty text removes the value. The uncertainty of a value stays; without one it is 0.
    """
    cells = {}
    for key in PROPERTIES:
        value = "" if thermal is None else thermal.values.get(key)
        cells[key] = {
            "property": key,
            "value": "" if value is None else f"{value:.9g}" if isinstance(value, float) else str(value),
            "uncertainty": "" if thermal is None else str(thermal.uncertainty.get(key, "")),
            "source": "" if thermal is None else thermal.source.get(key, ""),
        }
    for key, text in settings.items():
        cells[key] |= {"value": text, "source": source if text else ""}
        cells[key]["uncertainty"] = cells[key]["uncertainty"] or "0"
    made, faults = parsed([(0, one) for one in cells.values() if one["value"] or one["source"]])
    return made, [sentence for _, sentence in faults]


def table_text(thermal: Thermal) -> str:
    """Return the CSV text of a Thermal, one row per property with a value."""
    lines = [",".join(THERMAL_COLUMNS)]
    for key, value in thermal.values.items():
        if value not in (None, ""):
            number = f"{value:.9g}" if key in NUMBERS else value
            spread = f"{thermal.uncertainty[key]:.9g}" if key in thermal.uncertainty else ""
            quoted = '"' + thermal.source.get(key, "").replace('"', '""') + '"'
            lines.append(f"{key},{number},{spread},{quoted}")
    return "\n".join(lines) + "\n"


def read_thermals(directory: str | Path) -> dict[str, Thermal]:
    """Return {name: Thermal} of all tables in a materials folder's `thermal/`."""
    directory = Path(directory)
    tables = sorted((directory / "thermal").glob("*.csv"))
    return {path.stem: read_thermal(contained(path, directory)) for path in tables}


def beneath(thermals: Mapping[str, Thermal]) -> set[str]:
    """Return the names that `thermals` have beneath them."""
    return {thermal.beneath for thermal in thermals.values()}


def beneath_fault(name: str, thermals: Mapping[str, Thermal]) -> str | None:
    """Return a sentence if `thermals[name].beneath` has no table or leads in a circle, else None."""
    under, passed = thermals[name].beneath, [name]
    if under not in ("", *ENDS, *thermals):
        near = closest(under, thermals)
        hint = f"did you mean {near[0]}? " if near else ""
        return (f"beneath={under!r} is not a material with thermal properties; {hint}name one with a table, or write "
                f"{', '.join(ENDS[:-1])} or {ENDS[-1]}")  # fmt: skip
    while under in thermals and under not in passed:
        passed.append(under)
        under = thermals[under].beneath
    if under == name:
        return f"beneath leads in a circle, {' → '.join([*passed, name])}; leave the thickness of one of them empty"
    return None


def stacked(thermals: Mapping[str, Thermal], where: str | Path) -> dict[str, Thermal]:
    """Return {name: Thermal} with `below` set to the Thermal of the material beneath."""
    for name in thermals:
        if fault := beneath_fault(name, thermals):
            raise ThermorenderError(f"{Path(where) / 'thermal' / name}.csv: {fault}")

    def stack(name: str) -> Thermal:
        thermal = thermals[name]
        return replace(thermal, below=stack(thermal.beneath)) if thermal.beneath in thermals else thermal

    return {name: stack(name) for name in thermals}
