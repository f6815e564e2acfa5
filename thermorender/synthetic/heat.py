"""Surface temperature of a synthetic scene: a surface energy balance marched from sunrise to the picture's hour.

Every texel absorbs sun and sky, radiates, is cooled by the air and by evaporation, and exchanges heat with
what lies beneath it. Nothing here sees a colour.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.physics import sun
from thermorender.physics.heat import STEFAN_BOLTZMANN, march_hours, step
from thermorender.synthetic.light import incidence, normals, sky_view, sun_visibility
from thermorender.synthetic.noise import fractal_noise, smooth_noise, stream
from thermorender.units import ZERO_CELSIUS_K


@dataclass(frozen=True)
class Thermal:
    """How a material takes part in the balance.

    Parameters
    ----------
    absorptance : float
        Share of sunlight absorbed (1 − solar albedo).
    inertia : float
        Thermal inertia √(kρc) [J m⁻² K⁻¹ s^-1/2]; small for leaves and thin roofs.
    exchange : float
        Convective exchange relative to a smooth plate: leaves stand in the wind.
    wetness : float
        Evaporation relative to a free water surface, 0…1.
    """

    absorptance: float
    inertia: float
    exchange: float
    wetness: float


# Albedos: Oke, Boundary Layer Climates (2nd ed. 1987), tables 1.1 and 8.2. Thermal inertia of soils, rock,
# water and building materials: the same, tables 2.1 and 7.4. Exchange and wetness are chosen such that midday
# temperatures above air agree with the same book's chapters 3 and 4.
THERMAL = {
    "grass_green": Thermal(0.77, 420.0, 1.7, 0.34),
    "grass_dry": Thermal(0.76, 330.0, 1.4, 0.10),
    "heath_shrub": Thermal(0.86, 360.0, 2.1, 0.15),
    "conifer": Thermal(0.89, 260.0, 3.6, 0.16),
    "broadleaf": Thermal(0.81, 260.0, 3.2, 0.30),
    "leaf_litter": Thermal(0.82, 380.0, 1.1, 0.10),
    "bark": Thermal(0.80, 400.0, 2.0, 0.02),
    "soil_loam": Thermal(0.79, 1050.0, 1.0, 0.12),
    "soil_dark": Thermal(0.88, 1100.0, 1.0, 0.16),
    "sand_quartz": Thermal(0.64, 650.0, 1.0, 0.02),
    "granite": Thermal(0.72, 2200.0, 1.2, 0.02),
    "limestone": Thermal(0.60, 1800.0, 1.2, 0.02),
    "asphalt": Thermal(0.91, 1300.0, 1.0, 0.0),
    "concrete": Thermal(0.66, 1700.0, 1.0, 0.01),
    "roof_shingle": Thermal(0.84, 620.0, 1.2, 0.0),
    "roof_slate": Thermal(0.88, 800.0, 1.2, 0.0),
    "roof_rubber": Thermal(0.90, 480.0, 1.1, 0.0),
    "glass": Thermal(0.72, 520.0, 1.8, 0.0),
    "wood": Thermal(0.70, 480.0, 1.2, 0.02),
    "water": Thermal(0.92, 14000.0, 0.9, 0.9),
    "snow": Thermal(0.28, 550.0, 0.8, 0.5),
}


@dataclass(frozen=True)
class Weather:
    """A clear day: what the balance needs besides the surface.

    Parameters
    ----------
    latitude_deg, declination_deg : float
        Of the site and of the sun [deg].
    solar_hour : float
        Time of the picture, apparent solar time [h], any.
    air_low, air_high : float
        Air temperature at dawn and in mid-afternoon at the scene's median height [K].
    sky_temperature : float
        Temperature of the blackbody with the sky's down-welling long-wave [K].
    vapour_pa : float
        Water vapour pressure of the air [Pa].
    wind_m_s : float
        Wind speed [m/s].
    """

    latitude_deg: float
    declination_deg: float
    solar_hour: float
    air_low: float
    air_high: float
    sky_temperature: float
    vapour_pa: float
    wind_m_s: float

    def air(self, hour):
        """Return the air temperature at a solar hour [K]: a cosine with its crest at 15 h."""
        swing = 0.5 * (self.air_high - self.air_low)
        return self.air_high - swing + swing * np.cos(2.0 * np.pi * (hour - 15.0) / 24.0)

    def sun(self, hour):
        """Return (azimuth, elevation) of the sun at a solar hour [deg]."""
        return sun.position(self.latitude_deg, self.declination_deg, hour)


def surface_temperature(
    surface, texel_m, material, names, weather, seed, wetness=None, interior=None, relief=None
):
    """Return (temperature [K], light) of a scene, (H, W) float32 and a dict of (H, W) fields.

    Parameters
    ----------
    surface : (H, W) float32
        Surface model at texel detail [m].
    texel_m : float
        Side of a texel [m].
    material : (H, W) uint8
        Class value of each texel.
    names : dict of int to str
        Material of each class value, from `THERMAL`.
    weather : Weather
    seed : int
        Of the random fields of moisture, cover and ground.
    wetness : (H, W) float32, optional
        Added to the material's wetness (hollows, shores).
    interior : (H, W) float32, optional
        Temperature of the layer beneath where it is known (a house, a lake) [K]; NaN elsewhere.
    relief : (H, W) float32, optional
        Small-scale relief that is lit but casts no shadow of its own [m].

    Returns
    -------
    light : dict
        "visible", "cosine", "view": sun visibility, cosine of incidence and sky view at the picture's time.
    """
    shape = surface.shape
    table = np.zeros((256, 4), np.float32)
    for value, name in names.items():
        t = THERMAL[name]
        table[value] = t.absorptance, t.inertia, t.exchange, t.wetness
    absorptance, inertia, exchange, wet = (table[:, k][material] for k in range(4))

    # Ground and cover vary within a class, unseen by a camera: moisture and density in patches, and roughly
    # from texel to texel.
    generator = stream(seed, "heat")
    patch = fractal_noise(generator, shape, texel_m, 48.0, octaves=4, gain=0.6)
    cover = fractal_noise(generator, shape, texel_m, 9.0, octaves=3, gain=0.6)
    rough = smooth_noise(generator, shape, texel_m, max(1.2, 3.0 * texel_m))
    exchange = exchange * np.float32(5.7 + 3.8 * weather.wind_m_s)
    exchange *= np.exp(np.float32(0.16) * cover + np.float32(0.07) * rough)
    wet = wet * np.exp(np.float32(0.45) * patch + np.float32(0.25) * cover)
    if wetness is not None:
        wet = wet + wetness
    wet = np.clip(wet, 0.0, 1.0)
    inertia = inertia * np.exp(np.float32(0.14) * patch - np.float32(0.10) * cover)
    absorptance = np.clip(
        absorptance * (1.0 + np.float32(0.03) * cover - np.float32(0.015) * rough), 0.05, 0.97
    )

    # Air cools by 6.5 K per kilometre of height (ICAO standard atmosphere).
    lapse = np.float32(-0.0065) * (surface - np.float32(np.median(surface)))
    deep = np.float32(weather.air(9.0) + 1.5) + np.float32(0.8) * lapse + np.float32(0.5) * patch
    if interior is not None:
        deep = np.where(np.isnan(interior), deep, interior).astype(np.float32)
    view = sky_view(surface, texel_m, reach_m=max(40.0, 0.25 * texel_m * max(shape)))
    normal = normals(surface if relief is None else surface + relief, texel_m)
    sky = STEFAN_BOLTZMANN * weather.sky_temperature**4

    times = march_hours(weather.latitude_deg, weather.declination_deg, weather.solar_hour)
    snow = np.isin(material, [v for v, n in names.items() if n in ("snow", "ice")])
    # At sunrise the surface has lost the night's net radiation: dry, open ground lies below the air.
    temperature = (np.float32(weather.air_low - 1.0) + lapse) * 0.75 + 0.25 * deep - np.float32(1.5) * view
    water = inertia > 5000.0
    temperature = np.where(water, deep, temperature).astype(np.float32)
    for begin, end in zip(times[:-1], times[1:], strict=True):
        air = np.float32(weather.air(end)) + lapse
        azimuth, elevation = weather.sun(end)
        direct, diffuse = sun.clear_sky(elevation)
        visible = sun_visibility(surface, texel_m, azimuth, elevation)
        cosine = incidence(normal, azimuth, elevation)
        # Light that the surroundings reflect fills what the sky does not (their albedo about 0.2).
        level = direct * np.sin(np.radians(max(elevation, 0.0)))
        spread = diffuse * view + np.float32(0.2 * 0.5 * (level + diffuse)) * (1.0 - view)
        absorbed = absorptance * (np.float32(direct) * visible * cosine + spread)
        longwave = np.float32(sky) * view + np.float32(STEFAN_BOLTZMANN) * (1.0 - view) * air**4
        temperature = step(
            temperature,
            3600.0 * (end - begin),
            absorbed,
            longwave,
            exchange,
            wet,
            air,
            weather.vapour_pa,
            inertia,
            deep,
        )
        # Melting snow stays at the melting point and takes the rest of the heat as melt.
        temperature = np.where(snow, np.minimum(temperature, np.float32(ZERO_CELSIUS_K)), temperature)
    return temperature, {"visible": visible, "cosine": cosine, "view": view}
