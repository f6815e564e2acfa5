"""Per-texel deviations from tabulated properties: on the device as for columns in the open; wrong fields refused."""

import numpy as np
import pytest
from heat_support import short_simulations

from scenes import WEATHER, write_balance
from thermorender.errors import ThermorenderError
from thermorender.physics import balance
from thermorender.scene import open_ground
from thermorender.scene.deviations import Deviations
from thermorender.scene.load import load_scene
from thermorender.scene.weathered_ground import in_weather

AT = np.datetime64("2018-07-28T12:00:00")
NAMES = ("reflectance", "wetness", "exchange", "inertia")
FACTORS = {"reflectance": 1.4, "wetness": 2.0, "exchange": 0.7, "inertia": 1.5}


@pytest.fixture(scope="module")
def level(tmp_path_factory):
    """A level terrain: grass in the west, sand in the east, so large that its edge is out of sight."""
    classes = np.repeat([[1] * 16 + [2] * 16], 32, axis=0)
    folder = write_balance(tmp_path_factory.mktemp("level") / "scene", WEATHER, classes=classes)
    return load_scene(folder)


def fields(shape, **factors):
    one = np.ones(shape, np.float32)
    return Deviations(**{name: one * np.float32(factors.get(name, 1.0)) for name in NAMES})


@pytest.mark.slow
def test_deviations_match_columns_in_the_open(level):
    """Each factor changes both materials as it changes a column simulated with NumPy, to 0.02 K.

    The two simulations differ in their steps, which affects all alike, and in single precision (1 mK,
    test_heat_device.py).
    """
    from thermorender.render.heat.simulation import solved

    names = [material.name for material in level.materials]
    materials = in_weather(level.materials, level.weather, AT)
    columns = open_ground.columns(materials, level.weather, station_roughness_m=open_ground.STATION_ROUGHNESS_M)
    start = AT - np.timedelta64(48, "h")
    begin, _ = open_ground.settled(columns, level.weather, start)

    def in_the_open(own):
        return balance.seen_k(open_ground.march(own, level.weather, begin, start, AT)[-1], own.ground)

    def on_the_device(deviations):
        (terrain,) = solved(level, [AT], deviations=deviations)[0].surfaces
        return np.array([np.median(terrain.temperature[terrain.material == k]) for k in range(len(names))])

    shape = level.surfaces[0].material.shape
    plain, table = on_the_device(None), in_the_open(columns)
    assert (on_the_device(fields(shape)) == plain).all()
    for name, factor in FACTORS.items():
        ground, absorptance = columns.ground, columns.absorptance
        if name == "reflectance":
            absorptance = 1.0 - factor * (1.0 - absorptance)
        elif name == "wetness":
            ground = ground._replace(wetness=np.minimum(factor * ground.wetness, 1.0))
        elif name == "exchange":
            ground = ground._replace(log_heat=ground.log_heat / factor)
        else:
            ground = ground._replace(
                capacity=[factor * c for c in ground.capacity], conductance=[factor * c for c in ground.conductance]
            )
        own = open_ground.Columns(
            ground, absorptance, columns.wind_factor, columns.indoors, columns.node_m, columns.snow_m
        )
        expected = in_the_open(own) - table
        found = on_the_device(fields(shape, **{name: factor})) - plain
        print(name, expected, found)
        assert np.abs(expected).max() > 0.4, "the factor is felt"
        assert found == pytest.approx(expected, abs=0.02)


def test_only_texels_with_deviations_change(level):
    from thermorender.render.heat.simulation import solved

    wet = np.ones(level.surfaces[0].material.shape, np.float32)
    wet[:8, :8] = 3.0
    one = np.ones_like(wet)
    with short_simulations():
        plain, moved = (
            solved(level, [AT], deviations=deviations)[0].surfaces[0].temperature
            for deviations in (None, Deviations(one, wet, one, one))
        )
    assert (plain - moved)[:8, :8].min() > 0.5
    # Their lower long-wave emission reaches nothing: level ground does not see itself.
    assert np.abs(plain - moved)[10:].max() < 0.01


@pytest.mark.parametrize(
    ("field", "words"),
    [
        (np.ones((3, 3)), "deviations.inertia has 9 texels and the terrain 1024; give one factor for each"),
        (np.zeros((32, 32)), "deviations.inertia holds a factor not above 0; 1 leaves a texel as it is"),
        (np.full((32, 32), np.nan), "deviations.inertia holds a factor not above 0"),
    ],
)
def test_wrong_fields_are_refused(field, words):
    one = np.ones((32, 32))
    with pytest.raises(ThermorenderError, match=words):
        Deviations(one, one, one, field).columns(1024)
