"""Measured sites: weather and surface temperature, read as declared in a file of sites."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.physics import balance
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.scene import open_ground
from thermorender.scene.weathered_ground import in_weather, is_snow, lying_snow, parted, season
from thermorender.schema import Where, choice, flag, key, mapping, number, read, read_toml, tables, text
from thermorender.units import ZERO_CELSIUS_K, instant
from thermorender.weather.series import Conditions, Weather
from thermorender.weather.station import read_columns, read_station

_DAY_S = 86400
_GROUND_ALBEDO = 0.2


def _pairs(read_first, read_second):
    def read_pairs(value, where):
        if not isinstance(value, list) or not value or not all(isinstance(v, list) and len(v) == 2 for v in value):
            where.refuse(value, "a list of pairs")
        return tuple((read_first(a, where), read_second(b, where)) for a, b in value)

    return read_pairs


def _two(read_one):
    def read_two(value, where):
        if not isinstance(value, list) or len(value) != 2:
            where.refuse(value, "a list of two")
        return tuple(read_one(one, where) for one in value)

    return read_two


@dataclass(frozen=True, kw_only=True)
class Site:
    """A site: see the head of `validation/heat/sites.toml`.

    Attributes
    ----------
    canopy_m : float or None
        Height of the vegetation or buildings; the roughness length of the cover is a tenth of it (Garratt, The
        Atmospheric Boundary Layer (1992), section 4.1). None: the tables' values.
    wetness : float or None
        Moisture available to evaporation, in the classes of materials; None: the tables' values.
    depth_m : float or None
        Depth of water, or thickness of the uppermost layer.
    ends : str or None
        What is below the lowest layer, in place of the tables' ("inside", "outside" or "ventilated").
    absorptance : float or None
        Of sunlight; None: the tables'.
    plane : tuple of (tilt, azimuth clockwise from north) [deg] or None
        Of a surface that is not level: sunlight and long-wave are those of this plane above level ground that reflects
        a fifth of the sunlight and is as warm as the air.
    longwave_up, surface, water, below : str or None
        Column of the measurement: upwelling longwave [W m⁻²], infrared surface temperature [°C], temperature of the
        water's uppermost layer [°C], or temperature below the lowest layer [°C].
    emissivity : float or None
        Broadband emissivity for upwelling longwave; that of the cover where None.
    shortwave_up : str or None
        Column of the reflected sunlight, if it replaces the table's absorptance.
    sunlight : str or None
        Column of the sunlight on the surface, if it replaces that of the weather.
    radiation : tuple of two str or None
        Columns whose sum is absorbed sunlight and downwelling longwave.
    soil : tuple of (depth [m], column [°C])
        Measured soil temperatures; their first row is the initial state.
    start : str
        "settle": start in balance with the first day; "repeat": the same, and that day is also scored (one-day files).
    without_offset : bool
        Whether scores are without the mean error.
    aim_k : (2,) tuple or None
        Aimed mean absolute error by day and by night [K].
    """

    name: str = key(text)
    title: str = key(text)
    file: str = key(text)
    latitude_deg: float = key(number(-90.0, 90.0))
    longitude_deg: float = key(number(-180.0, 180.0))
    altitude_m: float = key(number(-500.0, 9000.0))
    air_height_m: float = key(number(0.1, 200.0), 2.0)
    wind_height_m: float = key(number(0.1, 200.0), 10.0)
    wind_m_s: float | None = key(number(0.0, 60.0), None)
    snow_depth_m: float | None = key(number(0.0, 30.0), None)
    canopy_m: float | None = key(number(0.0, 100.0, above=True), None)
    wetness: float | None = key(number(0.0, 1.0), None)
    depth_m: float | None = key(number(0.001, 200.0), None)
    ends: str | None = key(choice("inside", "outside", "ventilated"), None)
    absorptance: float | None = key(number(0.0, 1.0), None)
    plane: tuple | None = key(number(0.0, 360.0, count=2), None)
    cover: tuple = key(_pairs(text, number(0.0, 1.0, above=True)))
    longwave_up: str | None = key(text, None)
    surface: str | None = key(text, None)
    water: str | None = key(text, None)
    below: str | None = key(text, None)
    sunlight: str | None = key(text, None)
    emissivity: float | None = key(number(0.5, 1.0), None)
    shortwave_up: str | None = key(text, None)
    radiation: tuple | None = key(_two(text), None)
    soil: tuple = key(_pairs(number(0.0, 30.0), text), ())
    start: str = key(choice("settle", "repeat"), "settle")
    during: tuple | None = key(_two(lambda value, where: instant(where.key, value)), None)
    scored_after_h: float = key(number(0.0, 1e5), 0.0)
    names: dict = key(mapping(text), {})
    longest_gap_h: float = key(number(0.0, 1000.0), 3.0)
    without_offset: bool = key(flag, False)
    aim_k: tuple | None = key(number(0.0, 100.0, count=2), None)

    def check(self, where, given):
        """Refuse none or several measurements, and shares that do not add up to 1."""
        where.exactly_one(given, ("longwave_up", "surface", "water", "below"))
        total = sum(share for _, share in self.cover)
        if abs(total - 1.0) > 1e-6:
            where.of("cover").refuse(given["cover"], f"shares that add up to 1, not to {total:g}")


@dataclass(frozen=True)
class _File:
    sites: tuple = key(tables(Site), name="site")


@dataclass(frozen=True, eq=False)
class Measured:
    """A site with its weather and measurements.

    Attributes
    ----------
    site : Site
    weather : Weather
    absorbed : (N,) float64 or None
        Measured absorbed sunlight [W m⁻²].
    observed_k : (N,) float64
        Measured surface temperature [K]; NaN where missing.
    begin_k : (depths [m], temperatures [K]) or None
        Soil temperatures at the first row.
    scored : (N,) bool
    """

    site: Site
    weather: Weather
    absorbed: np.ndarray | None
    observed_k: np.ndarray
    begin_k: tuple | None
    scored: np.ndarray

    @property
    def elevation_deg(self):
        """Elevation of the sun at each instant, (N,)."""
        return self.weather.sun(self.weather.time)[1]


def read_sites(path):
    """Return the Sites of a file; see `validation/heat/sites.toml`."""
    path = Path(path)
    return read(_File, read_toml(path), Where(path, top="the file")).sites


def measured(site, folder):
    """Return the Measured of a site from its table in `folder`.

    Raises
    ------
    ThermorenderError
        A missing table or column.
    """
    path = Path(folder) / site.file
    if not path.is_file():
        raise ThermorenderError(f"{path} does not exist; give the folder of {site.file} with --data")
    weather = read_station(
        path, site.latitude_deg, site.longitude_deg, site.altitude_m, names=dict(site.names), during=site.during,
        longest_gap_h=site.longest_gap_h, wind_m_s=site.wind_m_s, snow_depth_m=site.snow_depth_m,
        air_height_m=site.air_height_m, wind_height_m=site.wind_height_m,
    )  # fmt: skip
    named = [site.longwave_up, site.surface, site.water, site.below, site.shortwave_up, site.sunlight]
    named += site.radiation or ()
    named = [name for name in [*named, *(name for _, name in site.soil)] if name]
    _, numbers = read_columns(path, named, during=site.during)
    column = numbers.__getitem__
    absorbed = None
    if site.shortwave_up:
        level = weather.direct_w_m2 * np.maximum(np.sin(np.radians(weather.sun(weather.time)[1])), 0.0)
        up = _whole(column(site.shortwave_up), weather.time)
        absorbed = np.maximum(level + weather.diffuse_w_m2 - np.maximum(up, 0.0), 0.0)
    if site.radiation:
        total = sum(_whole(column(name), weather.time) for name in site.radiation)
        # More than a black sky's is sunlight; a Weather refuses it as long-wave.
        longwave = np.minimum(total, STEFAN_BOLTZMANN * weather.air_k**4)
        absorbed, weather = total - longwave, replace(weather, longwave_w_m2=longwave)
    if site.plane:
        weather, absorbed = _on_plane(site, weather)
    if site.sunlight:
        absorbed = _absorbs(site) * np.maximum(_whole(column(site.sunlight), weather.time), 0.0)
    if site.longwave_up:
        e = site.emissivity or sum(share * open_ground.broadband(m) for m, share in _materials(site))
        emitted = column(site.longwave_up) - (1.0 - e) * weather.longwave_w_m2
        observed = (emitted / (e * STEFAN_BOLTZMANN)) ** 0.25
    else:
        observed = column(site.surface or site.water or site.below) + ZERO_CELSIUS_K
    begin = None
    if site.soil:
        begin = (
            np.array([depth for depth, _ in site.soil]),
            np.array([column(name)[0] + ZERO_CELSIUS_K for _, name in site.soil]),
        )
    after = (weather.time - weather.time[0]) / np.timedelta64(3600, "s") >= site.scored_after_h
    return Measured(site, weather, absorbed, observed, begin, after & np.isfinite(observed))


def _materials(site):
    library = load_library()
    for name, _ in site.cover:
        if name not in library:
            raise ThermorenderError(
                f"site {site.name!r}: cover={name!r} is not a material of the library; "
                "`thermorender materials list` prints the names"
            )
    return [(library[name], share) for name, share in site.cover]


def _absorbs(site):
    if site.absorptance is not None:
        return site.absorptance
    return sum(share * material.solar_absorptance for material, share in _materials(site))


def _on_plane(site, weather):
    """(Weather with the long-wave, absorbed sunlight (N,)) of a plane that is not level."""
    tilt, facing = np.radians(site.plane)
    azimuth, elevation = np.radians(weather.sun(weather.time))
    cosine = np.sin(elevation) * np.cos(tilt) + np.cos(elevation) * np.sin(tilt) * np.cos(azimuth - facing)
    sky = 0.5 * (1.0 + np.cos(tilt))
    level = weather.direct_w_m2 * np.maximum(np.sin(elevation), 0.0) + weather.diffuse_w_m2
    beam = np.where(elevation > 0.0, weather.direct_w_m2 * np.maximum(cosine, 0.0), 0.0)
    sunlight = beam + sky * weather.diffuse_w_m2 + (1.0 - sky) * _GROUND_ALBEDO * level
    longwave = sky * weather.longwave_w_m2 + (1.0 - sky) * STEFAN_BOLTZMANN * weather.air_k**4
    return replace(weather, longwave_w_m2=longwave), _absorbs(site) * sunlight


def _wet(material, wetness):
    return replace(material, thermal=replace(material.known_thermal(), wetness=wetness))


def _ended(thermal, end):
    """A Thermal whose lowest layer ends at `end`."""
    if thermal.below is None:
        return replace(thermal, beneath=end)
    return replace(thermal, below=_ended(thermal.below, end))


def _whole(values, time):
    """Return values with gaps interpolated in time."""
    second, known = (time - time[0]).astype(float), np.isfinite(values)
    return np.interp(second, second[known], values[known])


def modelled(found, step_s=None, layers=None, edit=None):
    """Return the surface temperature of a Measured by the heat balance at each of its instants, (N,) [K].

    For a mixed cover, the fourth root of the mean fourth power, weighted with share and emissivity; for water, the
    temperature of the first layer if that was measured.

    Parameters
    ----------
    found : Measured
    step_s : float, optional
        Longest step [s].
    layers : int, optional
    edit : callable, optional
        (Material) → Material, applied to each material.
    """
    site, weather = found.site, found.weather
    materials = _materials(site)
    rough = site.canopy_m and 0.1 * site.canopy_m
    own = {"roughness_m": rough, "wetness": site.wetness, "thickness_m": site.depth_m}
    own = {name: value for name, value in own.items() if value is not None}
    own |= {"texture": ""} if site.wetness is not None else {}
    materials = [(replace(m, thermal=replace(m.known_thermal(), **own)), share) for m, share in materials]
    if site.ends:
        materials = [(replace(m, thermal=_ended(m.known_thermal(), site.ends)), share) for m, share in materials]
    if site.absorptance is not None:
        materials = [(replace(m, solar_absorptance=site.absorptance), share) for m, share in materials]
    if edit:
        materials = [(edit(m), share) for m, share in materials]
    more = {} if layers is None else {"layers": layers}

    own, snowy = [material for material, _ in materials], bool(weather.snow_m.any())
    snowy &= not any(map(is_snow, own))

    def at(instant):
        present = in_weather(own, weather, instant)
        if site.wetness is not None:
            # A stated moisture stays, whatever the air tells of the soil.
            green = season(weather, instant).green
            present = [_wet(m, site.wetness * (green if m.known_thermal().cover == "leaves" else 1.0)) for m in present]
        parts = list(zip(present, (share for _, share in materials), strict=True))
        if snowy:
            # Each ground is in it with and without snow, at any time.
            pack = lying_snow(own, weather, instant)
            parts = [(part, share * of) for ground, share in parts for part, of in parted(ground, pack, always=True)]
        made = open_ground.columns(
            [part for part, _ in parts], weather, 0.0 if snowy else site.snow_depth_m or 0.0, **more
        )
        if any(m.known_thermal().cover == "bare" for m in own):
            # The cover states its bare ground: the rest has no gaps.
            made = replace(made, ground=made.ground._replace(gap=None))
        return made, [share for _, share in parts]

    step_s = step_s or open_ground.STEP_S
    series = _Drive(found, at)
    made = series.columns
    if found.begin_k is not None:
        depth, kelvin = found.begin_k
        known = np.isfinite(kelvin)
        state = balance.at_rest(np, list(np.interp(made.node_m.T, depth[known], kelvin[known])), made.ground)
        kelvin = series.simulate(state, step_s)
    else:
        state = series.settled(2.0 * step_s)
        kelvin = series.simulate(state, step_s)
    return ((kelvin**4 * series.emits).sum(axis=1) / series.emits.sum(axis=1)) ** 0.25


def carried(state, before, after):
    """Return a State of Columns `before` as that of Columns `after`, whose moisture and snow differ.

    Temperatures keep their depth below the ground. New snow has the surface's temperature, and is frozen.
    """
    depth = np.array(after.node_m) - (after.snow_m - before.snow_m)[:, None]
    old = np.concatenate([np.zeros((len(depth), 1)), before.node_m], axis=1)
    shown = np.array([state.surface_k, *state.layers_k]).T
    kelvin = [np.interp(*each) for each in zip(depth, old, shown, strict=True)]
    fresh = balance.at_rest(np, list(np.array(kelvin).T), after.ground)
    liquid = fresh.liquid
    if liquid is not None and state.liquid is not None:
        share = [now / np.maximum(water, 1e-9) for now, water in zip(state.liquid, before.ground.water, strict=True)]
        share = [np.interp(*each) for each in zip(depth, before.node_m, np.array(share).T, strict=True)]
        liquid = [
            np.minimum(part * water, room)
            for part, water, room in zip(np.array(share).T, after.ground.water, after.ground.room, strict=True)
        ]
    surface = np.where(after.ground.melting > 0.5, np.minimum(state.surface_k, ZERO_CELSIUS_K), state.surface_k)
    return fresh._replace(surface_k=surface, film=np.minimum(state.film, after.ground.held), liquid=liquid)


class _Drive:
    """Simulates the columns of a Measured under its weather, from row to row.

    `columns_at` returns the Columns of an instant and their shares of the ground; they change once a day.
    """

    def __init__(self, found, columns_at):
        self.found, self.columns_at = found, columns_at
        self.columns, self.shares = columns_at(found.weather.time[0])
        # Measured in a layer, not at the surface.
        self.layer = 0 if found.site.water else -1 if found.site.below else None

    def simulate(self, state, step_s, count=None):
        """Return temperatures (N, M) at each row, or at the first `count` rows; `emits` (N, M) are their weights."""
        weather = self.found.weather
        time, absorbed = weather.time[:count], self.found.absorbed
        second = (time - time[0]).astype(float)

        def shown(state):
            return balance.seen_k(state, self.columns.ground) if self.layer is None else state.layers_k[self.layer]

        self.states = [state]
        seen, emits = [shown(state)], [np.multiply(self.shares, self.columns.ground.emissivity)]
        light = None
        if absorbed is not None:
            light = lambda at: np.interp((at - time[0]) / np.timedelta64(1, "s"), second, absorbed[: len(second)])  # noqa: E731
        day = time[0]
        for begin, end in zip(time[:-1], time[1:], strict=True):
            if begin - day >= np.timedelta64(_DAY_S, "s"):
                before, day = self.columns, begin
                self.columns, self.shares = self.columns_at(begin)
                state = carried(state, before, self.columns)
            state = open_ground.march(self.columns, weather, state, begin, end, step_s=step_s, shortwave=light)[-1]
            self.states.append(state)
            seen.append(shown(state))
            emits.append(np.multiply(self.shares, self.columns.ground.emissivity))
        self.emits = np.array(emits)
        return np.array(seen)

    def settled(self, step_s):
        """Return the State at the first row after repeating the first day until it no longer changes.

        A file of less than a day is continued to the next day by linear interpolation.
        """
        day = self.found.weather.time[0] + np.timedelta64(_DAY_S, "s")
        if self.found.weather.time[-1] < day:
            return _Drive(_closed(self.found, day), self.columns_at).settled(step_s)
        weather = self.found.weather
        count = min(np.searchsorted(weather.time, day) + 1, len(weather.time))

        def again(state):
            self.simulate(state, step_s, count)
            return self.states

        return open_ground.settle(self.columns, weather.air_k[:count].mean(), again)[0]


def _closed(found, day):
    """Return a Measured with its first row repeated a day later."""
    weather = found.weather
    again = lambda values: np.append(values, values[0])  # noqa: E731
    series = {name: again(getattr(weather, name)) for name in Conditions._fields}
    absorbed = None if found.absorbed is None else again(found.absorbed)
    return replace(found, weather=replace(weather, time=np.append(weather.time, day), **series), absorbed=absorbed)
