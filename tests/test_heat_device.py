"""The heat balance in Dr.Jit's single precision against NumPy's double precision, over two days."""

import numpy as np
import pytest
from test_heat_balance import COLUMNS, sunny

from thermorender.physics import balance
from thermorender.render.heat.simulation import _evaluate
from thermorender.render.heat.steps import Library
from thermorender.render.variant import activate


@pytest.mark.parametrize("name", COLUMNS)
def test_both_array_libraries_agree(name):
    """Surface temperatures over 48 h in 15-min steps within 2 mK; one ulp at 300 K is 0.03 mK."""
    import drjit as dr

    mi = activate("cpu")
    column, weather = COLUMNS[name]
    start_k, wind = weather.get("air_k", 290.0), np.array([0.0, 0.5, 3.0, 12.0])

    def single(value):
        if value is None:
            return None
        if isinstance(value, list):
            return [single(each) for each in value]
        return dr.opaque(mi.Float, value, len(wind)) if np.ndim(value) == 0 else mi.Float(value.astype(np.float32))

    both = []
    for xp, convert in ((np, np.asarray), (Library, single)):
        own = column if xp is np else balance.Ground(*(single(value) for value in column))
        begin = balance.at_rest(xp, [convert(np.full(len(wind), start_k))] * len(column.capacity), own)
        seen, state = [], begin
        for number in range(192):
            times = (900.0 * number + offset for offset in balance.stage_times(900.0))
            stages = [sunny(t, **(weather | {"wind_m_s": wind})) for t in times]
            if xp is Library:
                stages = [balance.Forcing(*(single(value) for value in stage)) for stage in stages]
            state, _ = balance.step(xp, state, own, *stages, 900.0)
            if xp is Library:
                _evaluate(state)
            seen.append(np.array(state.surface_k))
        both.append(np.array(seen, np.float64))
    error = np.abs(both[0] - both[1]).max()
    assert error < 2e-3
