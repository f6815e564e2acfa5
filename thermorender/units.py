"""Units at the border: temperatures are kelvin inside, and values that look like °C are refused."""

import numpy as np

from thermorender.errors import ThermorenderError

ZERO_CELSIUS_K = 273.15

# No surface, sky or air of a scene is colder than this in the thermal band, and nearly every °C value
# is below it, so the check catches the commonest mistake: °C given as kelvin.
LOWEST_KELVIN = 100.0


def kelvin(name, temperature, allow_zero=False):
    """Return `temperature` unchanged [K] after refusing values that cannot be a scene's kelvin.

    Parameters
    ----------
    name : str
        What the value is called where the user wrote it, for the message.
    temperature : float or array
        Kelvin; NaN marks "no value" in arrays and passes there, not in a single value.
    allow_zero : bool
        Accept exactly 0 K, which radiates nothing (a cold space outside a cavity).

    Raises
    ------
    ThermorenderError
        A value is below 100 K (most likely °C) or infinite.
    """
    values = np.asarray(temperature, dtype=np.float64)
    bad = (values < LOWEST_KELVIN) | np.isinf(values) | (np.isnan(values) & (values.ndim == 0))
    if allow_zero:
        bad &= values != 0.0
    if bad.any():
        worst = values[bad].min() if values.ndim else float(values)
        raise ThermorenderError(
            f"{name}={worst:g} is below {LOWEST_KELVIN:g} K or not finite; "
            f"values are kelvin, add {ZERO_CELSIUS_K} to °C"
        )
    return temperature
