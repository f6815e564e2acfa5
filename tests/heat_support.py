"""Columns of ground and the hours that act on them, for tests of the heat balance."""

from contextlib import contextmanager

import numpy as np
import pytest

from thermorender.physics import balance
from thermorender.physics.conduction import LAYERS, Slab, layered

DAY = 86400.0
SOIL = Slab(np.inf, 1.0, 2e6)


def ground(layers, **changed):
    """Ground of one column that neither radiates nor evaporates."""
    own = {
        "emissivity": 0.0, "log_wind": 5.0, "log_heat": 7.0, "height_m": 2.0,
        "resistance": 1e30, "wetness": 1.0, "open_water": 0.0,
        "leaves": 0.0, "held": 0.0, "melting": 0.0, "capacity": list(layers.capacity),
        "conductance": list(layers.conductance),
    }  # fmt: skip
    own |= changed
    if own.get("water"):
        own.setdefault("room", [(balance.RETENTION if own["melting"] else 1.0) * water for water in own["water"]])
    return balance.ColumnProperties(**own)


def forcing(**changed):
    """A dark, calm hour in air so thin that it takes heat only through `turbulence.CALM_W_M2_K`."""
    own = {
        "absorbed": 0.0, "longwave": 0.0, "sunlight": 0.0, "air_k": 290.0, "vapour_pa": 0.0, "wind_m_s": 0.0,
        "pressure_pa": 1e-9, "rain_kg_m2_s": 0.0, "below_k": 290.0,
    }  # fmt: skip
    return balance.Forcing(**(own | changed))


def sunny(t, **changed):
    """A clear day: 600 W/m² absorbed at noon, air of 10 … 25 °C, wind, vapour."""
    phase = 2.0 * np.pi * t / DAY
    own = {
        "absorbed": 150.0 * (1.0 - np.cos(phase)) ** 2, "longwave": 320.0 - 20.0 * np.cos(phase),
        "sunlight": 200.0 * (1.0 - np.cos(phase)) ** 2, "air_k": 290.5 - 7.5 * np.cos(phase - 0.5),
        "vapour_pa": 1000.0, "wind_m_s": 4.0 - np.cos(phase), "pressure_pa": 1e5, "below_k": 293.0,
    }  # fmt: skip
    return forcing(**(own | changed))


MOIST = layered([Slab(np.inf, 1.5, 2.2e6, 0.3)])
SNOW = layered([Slab(0.3, 0.3, 6e5, 0.3), Slab(np.inf, 1.2, 2.2e6, 0.0)])
POND = layered([Slab(2.0, 0.57, 4.18e6, 0.0), Slab(np.inf, 1.0, 2.0e6)])
COLUMNS = {
    "dry soil": (ground(layered([SOIL]), emissivity=0.95), {}),
    "wet grass in rain": (ground(layered([SOIL], skin=20.0), emissivity=0.98, resistance=80.0, leaves=1.0, held=0.5),
                          {"rain_kg_m2_s": 1e-4}),
    "leaves with gaps in rain": (ground(layered([SOIL], skin=10.0), emissivity=0.98, resistance=80.0, leaves=1.0,
                                        held=0.5, gap=0.1), {"rain_kg_m2_s": 1e-4}),
    "soil that freezes and thaws": (ground(MOIST, emissivity=0.96, resistance=100.0, water=list(MOIST.water)),
                                    {"air_k": 272.0, "longwave": 230.0, "vapour_pa": 400.0}),
    "snow that melts and runs off": (ground(SNOW, emissivity=0.98, resistance=0.0, melting=1.0, water=list(SNOW.water)),
                                     {"air_k": 276.0, "vapour_pa": 600.0, "rain_kg_m2_s": 1e-4}),
    "pond lit inside": (ground(POND, emissivity=0.96, resistance=0.0, sun_share=list(0.45 / LAYERS * np.ones(LAYERS))),
                        {}),
}  # fmt: skip


@contextmanager
def short_simulations():
    """Let simulations start as late as they may, where their accuracy does not matter."""
    from thermorender.render.heat import simulation
    from thermorender.scene import open_ground

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulation, "_BEFORE_S", 6 * 3600.0)
        patch.setattr(open_ground, "LOOK_BACK", np.timedelta64(86400, "s"))
        patch.setattr(open_ground, "_MOST_DAYS", 2)
        yield
