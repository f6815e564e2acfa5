"""Columns of weather files: names, units and plausible values."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.physics import humidity, sky
from thermorender.units import ZERO_CELSIUS_K


class Column(NamedTuple):
    """A column's quantity and the conversion to its unit: (number + before) · scale + after."""

    quantity: str
    scale: float = 1.0
    after: float = 0.0
    before: float = 0.0


# ppfd is photosynthetic photon flux density.
COLUMNS = {
    "air_k": Column("air_k"),
    "air_c": Column("air_k", after=ZERO_CELSIUS_K),
    "air_f": Column("air_k", 5.0 / 9.0, before=459.67),
    "rh_percent": Column("rh", 0.01),
    "rh": Column("rh"),
    "vapour_pressure_pa": Column("vapour_pa"),
    "vapour_pressure_hpa": Column("vapour_pa", 100.0),
    "vapour_pressure_kpa": Column("vapour_pa", 1000.0),
    "vpd_pa": Column("deficit_pa"),
    "vpd_hpa": Column("deficit_pa", 100.0),
    "vpd_kpa": Column("deficit_pa", 1000.0),
    "dew_point_k": Column("dew_point_k"),
    "dew_point_c": Column("dew_point_k", after=ZERO_CELSIUS_K),
    "dew_point_f": Column("dew_point_k", 5.0 / 9.0, before=459.67),
    "wind_m_s": Column("wind_m_s"),
    "wind_km_h": Column("wind_m_s", 1.0 / 3.6),
    "wind_knots": Column("wind_m_s", 1852.0 / 3600.0),
    "wind_mph": Column("wind_m_s", 0.44704),
    "sw_down_w_m2": Column("global_w_m2"),
    "sw_direct_normal_w_m2": Column("direct_w_m2"),
    "sw_diffuse_w_m2": Column("diffuse_w_m2"),
    # 2.05 µmol of photosynthetic photons per joule of sunlight, ± 5 %: Meek and others, Agron. J. 76 (1984) 939.
    "ppfd_umol_m2_s": Column("ppfd_w_m2", 1.0 / 2.05),
    "lw_down_w_m2": Column("longwave_w_m2"),
    "cloud": Column("cloud"),
    "cloud_percent": Column("cloud", 0.01),
    "cloud_oktas": Column("cloud", 1.0 / 8.0),
    "cloud_tenths": Column("cloud", 0.1),
    "rain_mm": Column("rain_mm"),
    "rain_in": Column("rain_mm", 25.4),
    "rain_mm_h": Column("rain_mm_h"),
    "rain_total_mm": Column("rain_total_mm"),
    "rain_total_in": Column("rain_total_mm", 25.4),
    "pressure_pa": Column("pressure_pa"),
    "pressure_hpa": Column("pressure_pa", 100.0),
    "pressure_kpa": Column("pressure_pa", 1000.0),
    "snow_depth_m": Column("snow_m"),
    "snow_depth_cm": Column("snow_m", 0.01),
}
# Names that other programs use, in lower case with _ between words, by our name in the unit that they usually have:
# pvlib, NSRDB, PVGIS, Open-Meteo, the DWD, airports' reports, and the networks ICOS and FLUXNET.
_USUAL = {
    "air_c": "temp_air temperature air_temperature t_air ta tair temp temp_c t2m air_temp drybulb dry_bulb dry_bulb_c "
    "temperature_c air_temperature_c ta_f temperature_2m temperature_2m_c tt_tu",
    "air_f": "tmpf temp_f temperature_f temp_air_f air_temp_f air_temperature_f temperature_2m_f",
    "air_k": "temperature_k air_temperature_k",
    "rh_percent": "relative_humidity relative_humidity_percent humidity humidity_percent rhum relhum rh_f "
    "relative_humidity_2m rf_tu relh",
    "dew_point_c": "dew_point temp_dew dewpoint dewpoint_c dew_point_temperature dew_point_2m_c dwpt",
    "dew_point_f": "dwpf",
    "vpd_hpa": "vpd vpd_f",
    "wind_m_s": "wind_speed windspeed wind ws ws_f ws10m wspd wind_speed_m_s wind_speed_ms "
    "wind_speed_10m wind_speed_10m_m_s",
    "wind_km_h": "wind_speed_10m_km_h",
    "wind_knots": "sknt",
    "sw_down_w_m2": "ghi global_w_m2 ghi_w_m2 g_h global_horizontal global_radiation global_radiation_w_m2 sw_in "
    "sw_in_f rg rs shortwave_w_m2 solar_w_m2 solar_radiation solar_radiation_w_m2 swdown sw_down swin irradiance "
    "shortwave_radiation shortwave_radiation_w_m",
    "sw_direct_normal_w_m2": "dni dni_w_m2 gb_n direct_w_m2 direct_normal direct_normal_w_m2 "
    "direct_normal_irradiance direct_normal_irradiance_w_m",
    "sw_diffuse_w_m2": "dhi dhi_w_m2 gd_h diffuse_w_m2 diffuse_horizontal diffuse_radiation diffuse_radiation_w_m",
    "lw_down_w_m2": "lw_in lw_in_f ir_h longwave_w_m2 longwave_down_w_m2 lwdown lw_down lwin",
    "ppfd_umol_m2_s": "ppfd ppfd_in par",
    "cloud": "cloud_cover cloud_fraction clouds cloudiness",
    "rain_mm": "rain precipitation precipitation_mm precip precip_mm rainfall rainfall_mm prcp p_f",
    "rain_in": "rain_inch rain_inches rainfall_in rainfall_inch rainfall_inches precip_in precip_inch precip_inches "
    "precipitation_in precipitation_inch precipitation_inches prcp_in prcp_inch prcp_inches",
    "pressure_hpa": "pressure pressure_mbar air_pressure surface_pressure surface_pressure_hpa",
    "pressure_kpa": "pa pa_f",
    "pressure_pa": "sp",
    "snow_depth_m": "snow snow_depth snow_m",
    "snow_depth_cm": "snow_cm",
}
USUAL = {name: ours for ours, names in _USUAL.items() for name in names.split()}
# Marks of missing values in loggers' files.
MISSING_TEXTS = {"", "na", "n/a", "nan", "null", "none", "-", "m", "--"}
MISSING_NUMBERS = (-999.0, -999.9, -6999.0, -9999.0, -9999.9, -99999.0, -999999.0, 9999.0, 9999.9, 99999.0, 999999.0)

# Lowest and highest value of a quantity, and the advice for values outside.
_RANGES = {
    "air_k": (180.0, 333.0, "air of 180…333 K (−93…60 °C); a column's name ends in its unit: air_c, air_k or air_f"),
    "dew_point_k": (150.0, 313.0, "a dew point of 150…313 K; the name ends in the unit: dew_point_c, _k or _f"),
    "rh": (0.0, 1.15, "a relative humidity of 0…115 % in rh_percent, or of 0…1.15 in rh"),
    "vapour_pa": (0.0, 7000.0, "a vapour pressure of 0…7000 Pa; the name ends in the unit: _pa, _hpa or _kpa"),
    "deficit_pa": (-100.0, 15000.0, "a deficit of 0…15000 Pa; the name ends in the unit: _pa, _hpa or _kpa"),
    "wind_m_s": (0.0, 80.0, "a wind of 0…80 m/s; leave the cell empty if it was not measured"),
    "global_w_m2": (-30.0, 1800.0, "a short-wave irradiance of 0…1800 W/m² (−30 at night is a sensor's offset)"),
    "direct_w_m2": (-30.0, 1420.0, "direct sun of 0…1420 W/m²; it has 1420 above the atmosphere"),
    "diffuse_w_m2": (-30.0, 1200.0, "diffuse short-wave of 0…1200 W/m²"),
    "ppfd_w_m2": (-30.0, 1800.0, "photons of 0…3700 µmol m⁻² s⁻¹"),
    "longwave_w_m2": (60.0, 600.0, "long-wave down of 60…600 W/m², the sky's and not the balance with the ground's"),
    "cloud": (0.0, 1.0, "a share of the sky: cloud 0…1, cloud_percent 0…100, cloud_oktas 0…8 or cloud_tenths 0…10"),
    "rain_mm": (0.0, 400.0, "rain of 0…400 mm in an interval"),
    "rain_mm_h": (0.0, 2500.0, "rain of 0…2500 mm/h"),
    "rain_total_mm": (0.0, 1e6, "a total of rain, not below 0 mm"),
    "pressure_pa": (30e3, 110e3, "a pressure of 30000…110000 Pa; the name ends in the unit: _pa, _hpa or _kpa"),
    "snow_m": (-0.1, 20.0, "snow of 0…20 m; write snow_depth_cm if the numbers are centimetres"),
}
# Range of the brightest global light (quantile 0.98) relative to Haurwitz' clear sky, J. Meteorol. 2 (1945) 154.
_CLEAR_SHARES = (0.6, 1.4)
# Elevation of a sun that direct light is judged by [deg]; by how much two pyranometers differ at zero (ISO 9060:2018,
# class B [W m⁻²]) and as a share; uncertainty of the diffuse share by Erbs' split (`sky.split_global`).
_HIGH_DEG, _PYRANOMETERS_W_M2, _PYRANOMETERS, _SPLIT = 10.0, 21.0, 0.05, 0.1
# Range of the median pressure relative to the standard atmosphere's, by weather and air temperature.
_PRESSURE_SHARES = (0.86, 1.06)


def check_values(where: object, column: str, values: NDArray[np.float64], rows: NDArray[np.int64]) -> None:
    """Refuse numbers (N,) of a column of `COLUMNS` outside the range of its quantity; NaN is allowed."""
    quantity, scale, after, before = COLUMNS[column]
    low, high, allowed = _RANGES[quantity]
    with np.errstate(invalid="ignore"):
        bad = (values < low) | (values > high)
    if bad.any():
        k = int(np.argmax(bad))
        raise ThermorenderError(
            f"{where}, row {rows[k]}: {column}={(values[k] - after) / scale - before:.6g} is not allowed; "
            f"give {allowed}"
        )
    most = np.nanmax(values, initial=-np.inf)
    if quantity == "rh" and scale == 0.01 and 0.0 < most <= 0.0101:
        raise ThermorenderError(
            f"{where}: {column} is {100.0 * most:g} at most, drier than any air; it looks like a fraction of 1, so "
            "rename the column to rh"
        )


def check_range(where: object, quantity: str, values: NDArray[np.float64]) -> None:
    """Refuse hourly values (N,) outside the range of a quantity, in its unit."""
    low, high, allowed = _RANGES[quantity]
    bad = (values < low) | (values > high)
    if bad.any():
        k = int(np.argmax(bad))
        raise ThermorenderError(f"{where}: {quantity}={values[k]:.6g} in hour {k + 1} is not allowed; give {allowed}")


def check_light(
    where: object, column: str, values: NDArray[np.float64], elevation_deg: NDArray[np.float64], step_s: float,
    others: Mapping[str, NDArray[np.float64]] = MappingProxyType({}),
) -> None:  # fmt: skip
    """Refuse sunlight that never exceeds 5 W m⁻² with the sun above 20°, or whose maximum is unlike a clear sky's.

    NaN is allowed. Direct light may be as low as a tracker's noise where the global light in `others`, the file's
    quantities, implies no more. The brightest global light is judged over 300 hours or more of a sun above 30°.
    """
    most = np.nanmax(values)
    if (
        elevation_deg.max() > 20.0
        and most < 5.0
        and not ("direct" in column and (most <= 0.0 or _beam_left(others, elevation_deg) <= most))
    ):
        raise ThermorenderError(
            f"{where}: {column} is {most:g} W/m² at most although the sun rises to {elevation_deg.max():.0f}°; it "
            "looks like MJ or kW, or was not measured, so give W/m² or leave it out"
        )
    high = (elevation_deg > 30.0) & ~np.isnan(values)
    if column not in ("global_w_m2", "sw_down_w_m2") or high.sum() * step_s < 300 * 3600.0:
        return
    sine = np.sin(np.radians(elevation_deg[high]))
    share = np.quantile(values[high] / (1098.0 * sine * np.exp(-0.057 / sine)), 0.98)
    least, largest = _CLEAR_SHARES
    if not least <= share <= largest:
        raise ThermorenderError(
            f"{where}: {column} reaches {share:.2f} of a clear sky's light in its brightest hours, of which {least:g}…"
            f"{largest:g} are plausible; it looks like another unit, such as J/cm² or Wh in half an hour, or another "
            "quantity, so convert it to global W/m² or leave it out"
        )


def _beam_left(others: Mapping[str, NDArray[np.float64]], elevation_deg: NDArray[np.float64]) -> float:
    """Lower limit of the direct light [W m⁻²] in the brightest tenth of the day, from its global and diffuse light.

    Global less diffuse light, less the uncertainty of two pyranometers; without diffuse light, that of Erbs'
    correlation less three times its uncertainty. Diffuse light alone sets no limit: infinity.
    """
    if "global_w_m2" not in others:
        return np.inf
    high = elevation_deg > _HIGH_DEG
    sine, total = np.sin(np.radians(elevation_deg[high])), np.maximum(others["global_w_m2"][high], 0.0)
    if "diffuse_w_m2" in others:
        beam = (total - others["diffuse_w_m2"][high] - _PYRANOMETERS_W_M2 - _PYRANOMETERS * total) / sine
    else:
        beam = sky.split_global(total, elevation_deg[high], 1.0, np.inf)[0] - 3.0 * _SPLIT * total / sine
    return float(np.nanquantile(beam, 0.9))


def check_pressure(where: object, column: str, values: NDArray[np.float64], altitude_m: float) -> None:
    """Refuse a pressure that is implausible at this altitude. NaN is allowed."""
    shares = np.nanmedian(values) / humidity.standard_pressure(altitude_m)
    low, high = _PRESSURE_SHARES
    if not low <= shares <= high:
        raise ThermorenderError(
            f"{where}: {column} has the median {np.nanmedian(values):.0f} Pa, but air at {altitude_m:g} m has about "
            f"{humidity.standard_pressure(altitude_m):.0f} Pa; give the pressure of the station, not of sea level, in "
            "the unit of the column's name, and the station's altitude"
        )


def vapour_of(
    where: object, values: Mapping[str, NDArray[np.float64]], air_k: NDArray[np.float64], notes: list[str]
) -> NDArray[np.float64] | None:
    """Return the vapour pressure (N,) [Pa], at most saturated, or None without a humidity.

    It follows from the first of vapour_pa, dew_point_k, rh and deficit_pa in `values`; `notes` gets a note on values
    above saturation.
    """
    saturated = humidity.saturation_pressure(air_k)
    forms = {
        "vapour_pa": lambda value: value,
        "dew_point_k": humidity.saturation_pressure,
        "rh": lambda value: value * saturated,
        "deficit_pa": lambda value: saturated - value,
    }
    form = next((name for name in forms if name in values), None)
    if form is None:
        return None
    vapour = forms[form](values[form])
    share = vapour / saturated
    if np.nanmedian(share) < 0.02 or np.nanmedian(share) > 1.3:
        raise ThermorenderError(
            f"{where}: humidity ({form}) has a median of {100.0 * np.nanmedian(share):.2g} % of saturation at the "
            "air temperature, which is impossible; check the units in the columns' names"
        )
    above = int(np.sum(share > 1.0))
    if above:
        notes.append(f"{above} values of humidity above saturation over water are taken as saturated.")
    return np.clip(vapour, 1.0, saturated)
