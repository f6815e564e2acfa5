"""Roofs and pavements: their layers against exact impedances and steady balances, and what their tables refer to."""

from dataclasses import replace

import numpy as np
import pytest

from thermorender.errors import ThermorenderError
from thermorender.materials.library import find, load_library
from thermorender.materials.thermal import table_text
from thermorender.physics import turbulence
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.scene import open_ground
from thermorender.units import ZERO_CELSIUS_K
from thermorender.weather.named_day import named_day

LIBRARY = load_library()
ROOFS = ("roof_tile_loft", "roof_flat_gravel", "roof_flat_membrane", "roof_metal_insulated")
ALL = (*ROOFS, "road_asphalt", "pavement_concrete")
# ISO 6946:2017, table 7: resistance of the films [m² K/W].
FILM = {"inside": 0.13, "ventilated": 0.13}


def hot_day():
    """15 July at 40° N: clear, 24 to 39 °C, 2 m/s."""
    return named_day(np.datetime64("2018-07-15T12:00:00"), (40.0, 0.0, 100.0), air_low_c=24.0, air_high_c=39.0,
                     humidity_low=0.6, wind_m_s=2.0, cloud=0.0)  # fmt: skip


def day_of(names, weather):
    """(columns, times, surface temperatures (N, M) [K]) of a day after settling."""
    made = open_ground.columns([LIBRARY[name] for name in names], weather, 0.0, open_ground.STATION_ROUGHNESS_M)
    start = weather.time[0]
    state, _ = open_ground.settled(made, weather, start)
    day = open_ground.march(made, weather, state, start, start + np.timedelta64(1, "D"))
    seen = [state.surface_k for state in day]
    return made, start + np.arange(1, len(seen) + 1) * np.timedelta64(900, "s"), np.array(seen)


def exact_impedance(name, period_s):
    """Surface temperature over flux of a material's slabs, by transfer matrices of each slab [m² K/W]."""
    layers = LIBRARY[name].known_thermal().layers
    s = 2j * np.pi / period_s
    end = layers[-1].beneath
    z = FILM.get(end)
    for layer in reversed(layers):
        own = 1.0 / (layer.inertia * np.sqrt(s))
        if layer.thickness_m is None:
            z = own
            continue
        turn = np.tanh(layer.thickness_m * np.sqrt(s * layer.heat_capacity_j_m3_k / layer.conductivity_w_m_k))
        z = own * (z + own * turn) / (own + z * turn)
    return z


@pytest.mark.parametrize("hours", [6.0, 24.0])
@pytest.mark.parametrize("name", ALL)
def test_layers_have_the_exact_impedance_of_their_slabs(name, hours):
    ground = open_ground.columns([LIBRARY[name]], hot_day(), 0.0, 0.03).ground
    capacity, conductance = (np.ravel(values) for values in (ground.capacity, ground.conductance))
    s = 2j * np.pi / (3600.0 * hours)
    admittance = conductance[-1]
    for own, above in zip(capacity[::-1], conductance[-2::-1], strict=True):
        admittance += s * own
        admittance = 1.0 / (1.0 / above + 1.0 / admittance)
    exact = exact_impedance(name, 3600.0 * hours)
    # A surface that exchanges 20 W m⁻² K⁻¹ with air and sky answers with h + 1/Z.
    assert abs((20.0 + admittance) / (20.0 + 1.0 / exact) - 1.0) < 0.02


def test_peak_of_tiles_over_a_loft_agrees_with_a_steady_balance():
    """Convection by ISO 6946:2017, annex C: 4 + 4 v W m⁻² K⁻¹."""
    weather = hot_day()
    _, times, seen = day_of(["roof_tile_loft", "roof_tile_clay"], weather)
    at = seen[:, 0].argmax()
    now, tile = weather.at(times[at]), LIBRARY["roof_tile_loft"]
    sun = now.direct_w_m2 * np.sin(np.radians(weather.sun(times[at])[1])) + now.diffuse_w_m2
    to_air = 4.0 + 4.0 * 2.0 + 1.0 / (0.018 / 1.0 + 0.13)
    t = np.linspace(300.0, 370.0, 70001)
    emissivity = open_ground.broadband(tile)
    gain = tile.solar_absorptance * sun + emissivity * (now.longwave_w_m2 - STEFAN_BOLTZMANN * t**4)
    by_hand = t[np.abs(gain - to_air * (t - now.air_k)).argmin()]
    assert 59.0 < by_hand - ZERO_CELSIUS_K < 65.0
    assert 59.0 < seen[at, 0] - ZERO_CELSIUS_K < 65.0
    # The tables of tiles before allow 36 W m⁻² K⁻¹ to the air below.
    assert seen[at, 0] > seen[:, 1].max() + 5.0


def test_insulated_roofs_are_almost_adiabatic():
    """Their peak is within 2.5 K of a steady balance without a flux inwards, with the model's own exchange."""
    weather = hot_day()
    names = ["roof_flat_membrane", "roof_metal_insulated"]
    made, times, seen = day_of(names, weather)
    for k, name in enumerate(names):
        at = seen[:, k].argmax()
        now, t = weather.at(times[at]), np.linspace(300.0, 380.0, 8001)
        sun = now.direct_w_m2 * np.sin(np.radians(weather.sun(times[at])[1])) + now.diffuse_w_m2
        density = turbulence.air_density(now.pressure_pa, now.air_k)
        own = [values[k] for values in (made.ground.log_wind, made.ground.log_heat, made.ground.height_m)]
        h, _ = turbulence.convection(np, t, now.air_k, now.wind_m_s * made.wind_factor[k], density, *own)
        gain = LIBRARY[name].solar_absorptance * sun
        gain += made.ground.emissivity[k] * (now.longwave_w_m2 - STEFAN_BOLTZMANN * t**4)
        steady = t[np.abs(gain - h * (t - now.air_k)).argmin()]
        assert steady - 2.5 < seen[at, k] <= steady, name


def test_tables_of_roofs_name_their_source():
    for name in ALL:
        for layer in LIBRARY[name].known_thermal().layers[:-1]:
            for key in ("conductivity_w_m_k", "density_kg_m3", "specific_heat_j_kg_k"):
                assert "ISO 10456" in layer.source[key], (name, key)


def test_a_table_of_a_layer_below_needs_no_material(tmp_path):
    with pytest.raises(ThermorenderError, match="'base_gravel', which the library does not hold"):
        find(LIBRARY, "base_gravel", "scene")
    (tmp_path / "thermal").mkdir()
    road = LIBRARY["road_asphalt"].known_thermal()
    (tmp_path / "thermal" / "asphalt.csv").write_text(table_text(replace(road, beneath="rubble")), "utf-8")
    (tmp_path / "thermal" / "rubble.csv").write_text(table_text(road.layers[1]), "utf-8")
    own = load_library(tmp_path)
    assert own["asphalt"].known_thermal().layers[1].conductivity_w_m_k == 2.0 and "rubble" not in own
    (tmp_path / "thermal" / "asphalt.csv").unlink()
    with pytest.raises(ThermorenderError, match=r"rubble.csv belongs to no material"):
        load_library(tmp_path)
