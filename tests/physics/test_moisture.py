"""Water in the ground: reference evapotranspiration, the bucket, snow by degree days, and what they do to columns."""

from dataclasses import replace

import numpy as np
import pytest

from scenes import write_balance
from thermorender.materials.library import load_library
from thermorender.materials.shifted import shifted
from thermorender.physics import moisture, snow
from thermorender.scene import open_ground
from thermorender.scene.load import load_scene
from thermorender.scene.weathered_ground import in_weather, leaf_notes, lying_snow, parted, season, water_of
from thermorender.weather.series import Conditions, Weather
from validation.heat.sites import carried

LIBRARY = load_library()
NAMES = ("soil_arid", "soil_loam", "soil_dark", "sand_quartz", "grass_green", "grass_dry", "heath_shrub")
HOUR = np.timedelta64(3600, "s")


def weather_of(start, days, **series):
    """A Weather of hourly rows: clear days of 30 ± 10 °C of dry air at 40° N."""
    time = np.datetime64(start, "s") + HOUR * np.arange(24 * days + 1)
    hour = (time - time.astype("M8[D]")) / HOUR
    day = np.maximum(np.sin(np.pi * (hour - 6.0) / 12.0), 0.0)
    own = {
        "air_k": 303.0 + 10.0 * np.sin(np.pi * (hour - 9.0) / 12.0), "vapour_pa": 600.0, "wind_m_s": 3.0,
        "direct_w_m2": 850.0 * (day > 0.0), "diffuse_w_m2": 90.0 * day, "longwave_w_m2": 330.0, "rain_mm_h": 0.0,
        "pressure_pa": 95000.0, "snow_m": 0.0,
    }  # fmt: skip
    own = {name: np.broadcast_to(np.asarray(value, float), time.shape) for name, value in (own | series).items()}
    return Weather(time=time, latitude_deg=40.0, longitude_deg=0.0, altitude_m=500.0, **own)


def only(count, at, value):
    """Zeros but for one entry."""
    found = np.zeros(count)
    found[at] = value
    return found


def in_kpa(celsius):
    """FAO-56, eq. 11."""
    return 0.6108 * np.exp(17.27 * celsius / (celsius + 237.3))


@pytest.mark.parametrize(
    ("high", "low", "vapour_kpa", "wind", "net_mj", "pressure_kpa", "expected"),
    [
        # FAO-56, example 17: Bangkok in April, net radiation less heat into soil; example 18: Uccle on 6 July.
        (34.8, 25.6, 2.85, 2.0, 14.33 - 0.14, 101.3, 5.72),
        (21.5, 12.3, 1.409, 2.078, 13.28, 100.1, 3.88),
    ],
)
def test_reference_evapotranspiration_of_published_examples(
    high, low, vapour_kpa, wind, net_mj, pressure_kpa, expected
):
    saturated = 0.5 * (in_kpa(high) + in_kpa(low))
    found = moisture.reference_evapotranspiration(
        0.5 * (high + low), 1e3 * saturated, 1e3 * vapour_kpa, wind, net_mj / 0.0864, 1e3 * pressure_kpa
    )
    assert found == pytest.approx(expected, abs=0.02)


def test_wind_at_two_metres_of_a_published_example():
    """FAO-56, example 14: 3.2 m/s at 10 m are 2.4 m/s."""
    assert moisture.at_two_metres(3.2, 10.0) == pytest.approx(2.4, abs=0.05)


def test_water_of_published_soils():
    """FAO-56, example 35 (sandy loam), example 36 (three soils), and the ranges of table 19."""
    assert moisture.SoilTexture(0.23, 0.10, 0.4, 8.0, False).evaporable_mm == pytest.approx(18.0)
    for capacity, wilting, available in ((0.15, 0.06, 90.0), (0.32, 0.15, 170.0), (0.35, 0.23, 120.0)):
        assert moisture.SoilTexture(capacity, wilting, 0.4, 8.0, False).available_mm == pytest.approx(available)
    table = {"sand": (2, 7, 6, 12), "loamy_sand": (4, 8, 9, 14), "sandy_loam": (6, 10, 15, 20), "loam": (8, 10, 16, 22),
             "silt_loam": (8, 11, 18, 25), "clay": (8, 12, 22, 29)}  # fmt: skip
    for name, (ready, most_ready, total, most) in table.items():
        texture = moisture.TEXTURES[name]
        assert ready <= texture.ready_mm <= most_ready and total <= texture.evaporable_mm <= most


def test_reductions_at_their_ends_and_in_the_middle():
    loam = moisture.TEXTURES["loam"]
    assert moisture.evaporates(loam, [0.0, 9.0, 14.0, 19.0]) == pytest.approx([1.0, 1.0, 0.5, 0.0])
    # 40 % of the available water is drawn under stress.
    assert moisture.transpires(loam, [0.0, 78.0, 104.0, 130.0]) == pytest.approx([1.0, 1.0, 0.5, 0.0])


@pytest.mark.parametrize("leaves", [False, True])
@pytest.mark.parametrize("name", list(moisture.TEXTURES))
def test_bucket_conserves_water(name, leaves):
    texture, generator = moisture.TEXTURES[name], np.random.default_rng(1)
    bucket = first = moisture.filled(texture, 0.5 * texture.capacity)
    rain = np.where(generator.random(400) < 0.2, generator.exponential(20.0, 400), 0.0)
    gone = 0.0
    for wet, reference in zip(rain, generator.uniform(0.0, 9.0, 400), strict=True):
        bucket, evaporated, drained = moisture.after_day(texture, bucket, wet, reference, leaves)
        assert 0.0 <= bucket.surface_mm <= texture.evaporable_mm and bucket.roots_mm >= 0.0
        assert evaporated >= 0.0 and drained >= 0.0
        gone += evaporated + drained
    assert first.roots_mm - bucket.roots_mm == pytest.approx(rain.sum() - gone, abs=1e-9)


def test_bare_soil_stops_to_evaporate_and_leaves_to_transpire():
    loam = moisture.TEXTURES["loam"]
    for leaves, most in ((False, loam.evaporable_mm), (True, loam.available_mm)):
        bucket, days = moisture.filled(loam, 0.25), []
        for _ in range(400):
            bucket, evaporated, _ = moisture.after_day(loam, bucket, 0.0, 8.0, leaves)
            days.append(evaporated)
        assert days[0] > 5.0 and days[-1] < 0.05
        assert most - 1e-9 <= sum(days) <= loam.available_mm + loam.evaporable_mm


def test_kersten_numbers_and_dry_soil():
    """Johansen: fine soil from 10 % saturated on, coarse from 5 %; quartz sand of 1600 kg/m³ conducts 0.2 … 0.3 dry."""
    loam, sand = moisture.TEXTURES["loam"], moisture.TEXTURES["sand"]
    assert moisture.kersten(loam, [0.0, 0.04, 0.4, 0.6]) == pytest.approx([0.0, 0.0, 1.0, 1.0])
    assert moisture.kersten(sand, [0.0, 0.04, 0.4]) == pytest.approx([0.0, 0.3, 1.0])
    assert moisture.conductivity(sand, [0.0, 0.4], 1600.0) == pytest.approx([0.237, 2.2], abs=1e-3)


@pytest.mark.parametrize(("saturation", "wetness"), [(0.3, 0.052), (0.4, 0.079), (1.0, 1.0)])
def test_resistance_of_moist_soil_agrees_with_the_tables(saturation, wetness):
    loam = moisture.TEXTURES["loam"]
    found = moisture.resistance(loam, 0.4 * saturation, 0.0)
    assert 54.0 / found == pytest.approx(wetness, rel=0.02)
    assert moisture.resistance(loam, 0.06, 19.0) > 8000.0


# Snow


@pytest.mark.parametrize(("day", "latitude", "melt"), [
    ("2018-12-21", 50.0, 1.4), ("2018-06-20", 50.0, 6.9), ("2018-12-21", -40.0, 6.9), ("2018-03-22", 50.0, 4.15),
])  # fmt: skip
def test_snow_stays_in_frost_and_melts_by_season(day, latitude, melt):
    """24 mm at −5 °C stay; a day of 2 °C melts twice the factor; all water arrives in time."""
    time = np.datetime64(day, "s") - 24 * HOUR + HOUR * np.arange(73)
    air_k = 273.15 + np.concatenate([np.full(24, -5.0), np.full(24, 2.0), np.full(25, -5.0)])
    rain = np.where(np.arange(73) < 24, 1.0, 0.0)
    snow, arrives = moisture.snow_water(time, latitude, air_k, rain)
    fallen = float(rain @ moisture.intervals_s(time)) / 3600.0
    assert snow[23] == pytest.approx(fallen) and fallen == pytest.approx(23.5)
    assert snow[-1] == pytest.approx(fallen - 2.0 * melt, abs=0.05)
    assert arrives.sum() + snow[-1] == pytest.approx(fallen, abs=1e-9) and (arrives >= -1e-12).all()


def test_without_frost_no_snow():
    time = np.datetime64("2018-07-01", "s") + HOUR * np.arange(5)
    snow, arrives = moisture.snow_water(time, 50.0, np.full(5, 290.0), np.full(5, 2.0))
    assert not snow.any() and arrives.sum() == pytest.approx(8.0)


# Ground in a weather


def test_ground_without_rain_or_texture_stays_as_its_table_says():
    dry, wet = (weather_of("2018-06-01", 3, rain_mm_h=only(73, 5, fell)) for fell in (0.0, 4.0))
    bare = [LIBRARY[name] for name in NAMES if LIBRARY[name].thermal.cover == "bare"]
    assert not dry.knows_rain and all(a is b for a, b in zip(in_weather(bare, dry, dry.time[-1]), bare, strict=True))
    others = [LIBRARY[name] for name in ("asphalt", "water", "granite", "snow")]
    assert all(a is b for a, b in zip(in_weather(others, wet, wet.time[-1]), others, strict=True))
    assert all(LIBRARY[name].thermal.texture for name in NAMES)


def test_frost_and_dry_air_close_leaves():
    """The season is the mean index of 21 days; without rain, dry air stands for dry soil."""
    # 21 days of which the last 7 have frost, at −2 °C and below; days at 40° north are longer than 11 h.
    frost = weather_of("2018-06-01", 28)
    air = np.where(frost.time < frost.time[-1] - 7 * 24 * HOUR, 293.0, 270.0)
    frost = replace(frost, air_k=air, vapour_pa=np.full(air.size, 400.0))
    assert season(frost, frost.time[-1]).green == pytest.approx(14.0 / 21.0, abs=0.05)
    leaves = [LIBRARY[name] for name in ("grass_green", "broadleaf")]
    # Air of 20 °C and 400 Pa lacks 1940 Pa of 4100 … 900 Pa, and air of 35 °C more than that.
    for kelvin, expected in ((293.15, (4100.0 - 1939.0) / 3200.0), (308.15, 0.0)):
        warm = replace(frost, air_k=np.full(air.size, kelvin))
        assert season(warm, warm.time[-1]) == pytest.approx((1.0, expected), abs=3e-3)
        for before, after in zip(leaves, in_weather(leaves, warm, warm.time[-1]), strict=True):
            assert after.thermal.wetness == pytest.approx(expected * before.thermal.wetness, abs=3e-3)


def test_notes_say_what_leaves_transpire_and_when_the_air_is_as_near():
    grass, road = [LIBRARY["grass_green"]], [LIBRARY["asphalt"]]
    summer = weather_of("2018-06-01", 28, air_k=293.15, vapour_pa=1500.0, longwave_w_m2=330.0)
    noon, midnight = summer.time[-13], summer.time[-1]
    assert leaf_notes(grass, summer, noon) == () == leaf_notes(grass, summer, midnight)
    # Overcast, the sky is nearly black at the air's temperature: 419 W/m².
    dull = replace(summer, longwave_w_m2=np.full(summer.time.size, 410.0))
    assert leaf_notes(grass, dull, noon) == () == leaf_notes(road, dull, midnight)
    (note,) = leaf_notes(grass, dull, midnight)
    assert "on cloudy nights the air's temperature is as near to that of leaves" in note
    winter = replace(summer, air_k=np.full(summer.time.size, 271.15), vapour_pa=np.full(summer.time.size, 300.0))
    (note,) = leaf_notes(grass, winter, noon)
    assert "leaves transpire 0.00 of what they do in season, by frost, short days, and dry air where no rain" in note


def test_days_without_rows_join_their_neighbours():
    """A gap of two days evaporates about as much as the days themselves; rain before it is not lost."""
    whole = weather_of("2018-06-01", 8, rain_mm_h=only(193, 5, 15.0))
    kept = np.r_[0:72, 120:193]
    series = {name: getattr(whole, name)[kept] for name in ("time", *Conditions._fields)}
    thermal = LIBRARY["soil_loam"].thermal
    full, gappy = (water_of(thermal, each, whole.time[-1]) for each in (whole, replace(whole, **series)))
    assert gappy.roots_mm == pytest.approx(full.roots_mm, abs=1.5)
    assert np.isfinite(gappy.surface_mm)


def test_uncertain_wetness_of_soil_outlives_the_weather():
    """A material shifted to be drier resists more, whatever the rain."""
    weather = weather_of("2018-06-01", 5, rain_mm_h=only(121, 5, 20.0))
    for name in ("soil_loam", "grass_green"):
        pair = [LIBRARY[name], shifted(LIBRARY[name], "wetness")]
        own, drier = (each.thermal for each in in_weather(pair, weather, weather.time[-1]))
        assert own.wetness == drier.wetness
        assert drier.surface_resistance_s_m > 1.2 * own.surface_resistance_s_m


@pytest.mark.parametrize("name", NAMES)
def test_layers_hold_the_water_of_the_bucket(name):
    """Depth times water of the surface layer is that of the bucket; wet soil conducts more, and dry soil less."""
    weather = weather_of("2018-06-01", 40, rain_mm_h=only(961, 5, 60.0))
    thermal = LIBRARY[name].thermal
    texture = moisture.TEXTURES[thermal.texture]
    seen = []
    for at in (weather.time[6], weather.time[-1]):
        found = in_weather([LIBRARY[name]], weather, at)[0].thermal
        bucket = water_of(thermal, weather, at)
        top = [each for each in found.layers if each.thickness_m][: len(found.layers) - 1]
        depth = sum(each.thickness_m for each in top)
        held = sum(each.thickness_m * each.water_share for each in top)
        assert depth == pytest.approx(moisture.SURFACE_M)
        assert 1e3 * held == pytest.approx(1e3 * texture.capacity * depth - bucket.surface_mm, abs=1e-9)
        assert 0.0 <= found.wetness <= 1.0
        seen.append(found)
    soaked, parched = seen
    assert parched.conductivity_w_m_k < soaked.conductivity_w_m_k and parched.wetness < soaked.wetness
    assert parched.conductivity_w_m_k < thermal.conductivity_w_m_k or name == "sand_quartz"


def test_dry_soil_is_hotter_at_noon_and_colder_at_dawn(monkeypatch):
    """After a dry month the surface's day is wider than with the table's moisture."""
    monkeypatch.setattr(open_ground, "LOOK_BACK", np.timedelta64(1, "D"))
    monkeypatch.setattr(open_ground, "_MOST_DAYS", 4)
    weather = weather_of("2018-06-01", 40, rain_mm_h=only(961, 5, 1.0))
    materials = [LIBRARY["soil_loam"], *in_weather([LIBRARY["soil_loam"]], weather, weather.time[-1])]
    columns = open_ground.columns(materials, weather)
    begin = weather.time[-1] - 24 * HOUR
    state, _ = open_ground.settled(columns, weather, begin)
    day = open_ground.march(columns, weather, state, begin, weather.time[-1], step_s=1800.0)
    seen = [state.surface_k for state in day]
    (coldest, colder), (hottest, hotter) = np.min(seen, axis=0), np.max(seen, axis=0)
    assert hotter > hottest + 3.0 and colder < coldest - 0.5


def test_snow_covers_open_ground_where_no_material_is_snow(monkeypatch):
    monkeypatch.setattr(open_ground, "_MOST_DAYS", 4)
    weather = weather_of("2018-01-10", 3, air_k=263.0, snow_m=0.2, direct_w_m2=0.0, longwave_w_m2=200.0)
    at = weather.time[-1]
    plain = [LIBRARY[name] for name in ("grass_green", "soil_loam", "asphalt")]
    pack = lying_snow(plain, weather, at)
    assert pack.depth_m == pytest.approx(0.2)
    assert lying_snow([*plain, LIBRARY["snow"]], weather, at).depth_m == 0.0
    assert lying_snow(plain, replace(weather, snow_m=np.full(weather.time.size, 5e-4)), at).depth_m == 0.0
    (grass, most), (soil, whole), (road, none) = (parted(each, pack)[0] for each in plain)
    # Niu and Yang (2007), eq. 4: tanh(d / 2.5 z₀), whole from 99 % on.
    assert (most, whole, none) == (1.0, 1.0, 0.0)
    thin = pack._replace(depth_m=0.02)
    assert [parted(each, thin)[0][1] for each in plain] == pytest.approx(
        [np.tanh(0.02 / 0.075), np.tanh(0.02 / 0.0075), 0.0], abs=0.01
    )
    assert road is plain[2] and grass.thermal.cover == soil.thermal.cover == "snow" and grass.name == "grass_green"
    assert grass.thermal.thickness_m == pytest.approx(0.2) and grass.thermal.layers[1].cover == "leaves"
    # Stalks stand above the same snow.
    stalks = parted(plain[0], thin)[1][0].thermal
    assert stalks.cover == "leaves" and stalks.thickness_m == 0.02 and stalks.wetness == 0.0
    assert stalks.conductivity_w_m_k == grass.thermal.conductivity_w_m_k and stalks.skin_conductance_w_m2_k == 10.0
    columns = open_ground.columns([grass, road], weather)
    assert columns.snow_m == pytest.approx([0.2, 0.0])
    # Ground below snow starts at 0 °C, and stays warmer than the air.
    state, _ = open_ground.settled(columns, weather, at)
    deep = np.argmax(columns.node_m[0] > 0.3)
    assert 268.0 < state.layers_k[deep][0] <= 273.15 and state.surface_k[0] < 263.0


def test_snow_ages_by_its_published_rates():
    """Douville, Royer and Mahfouf (1995): 0.008 a day in frost, a factor of exp(−0.24 t) in melt, new by 10 mm; Essery
    (2015): density towards 300 in frost and 500 kg/m³ in melt, by e in 200 h.
    """
    hour, first = np.full(240, 3600.0), snow.Pack(0.4, 250.0, 0.85)
    frost = snow.packs(hour, np.full(240, -5.0), np.full(240, 0.4), first)
    assert frost.albedo == pytest.approx(0.85 - 0.08) and frost.depth_m == 0.4
    assert frost.density_kg_m3 == pytest.approx(300.0 - 50.0 * np.exp(-1.2), rel=1e-3)
    melt = snow.packs(hour, np.full(240, 2.0), np.full(240, 0.4), first)
    assert melt.albedo == pytest.approx(0.5 + 0.35 * np.exp(-2.4))
    assert melt.density_kg_m3 == pytest.approx(500.0 - 250.0 * np.exp(-1.2), rel=1e-3)
    # 20 mm of depth, 5 mm of water, renew half of what the albedo has lost; any snow on bare ground is new.
    fallen = snow.packs(hour[:1], np.full(1, -5.0), np.full(1, 0.42), frost)
    before = frost.albedo - 0.008 / 24.0
    assert fallen.albedo == pytest.approx(0.5 * (before + 0.85))
    assert snow.packs(hour[:1], np.full(1, -5.0), np.full(1, 0.004), snow.Pack(0.0, 250.0, 0.5)).albedo == 0.85
    # Water is kept: depth times density.
    fell = np.cumsum(np.full(48, 0.5))
    depth = snow.depths(hour[:48], np.full(48, -5.0), fell)
    pack = snow.packs(hour[:48], np.full(48, -5.0), depth, snow.Pack(0.0, 250.0, 0.85))
    assert pack.depth_m * pack.density_kg_m3 == pytest.approx(24.0, rel=0.03)


def test_conductivity_of_snow_agrees_with_the_tables():
    """Calonne et al. (2011) at the densities of the three snows."""
    for name in ("snow_fine", "snow_medium", "snow_coarse"):
        thermal = LIBRARY[name].thermal
        assert snow.conductivity(thermal.density_kg_m3) == pytest.approx(thermal.conductivity_w_m_k, abs=6e-4)


def test_a_state_keeps_its_depths_when_snow_falls(monkeypatch):
    monkeypatch.setattr(open_ground, "_MOST_DAYS", 2)
    weather = weather_of("2018-01-10", 3, air_k=268.0, snow_m=0.1)
    soil = [LIBRARY["soil_loam"], LIBRARY["asphalt"]]
    bare = open_ground.columns(soil, weather)
    state, _ = open_ground.settled(bare, weather, weather.time[-1])
    same = carried(state, bare, bare)
    assert np.allclose(same.layers_k, state.layers_k) and np.allclose(same.surface_k, state.surface_k)
    pack = lying_snow(soil, weather, weather.time[-1])
    white = open_ground.columns([parted(soil[0], pack)[0][0], soil[1]], weather)
    later = carried(state, bare, white)
    at = np.argmax(white.node_m[0] > 0.5)
    below = np.interp(white.node_m[0][at] - 0.1, bare.node_m[0], [each[0] for each in state.layers_k])
    assert later.layers_k[at][0] == pytest.approx(below, abs=1e-9)
    assert later.surface_k[0] <= 273.15 and later.surface_k[1] == state.surface_k[1]


def test_a_scene_lies_under_likely_snow_unless_it_states_none(tmp_path):
    """A station with rain in frost and no column of snow: the notes name the depth; the fields are then white."""
    time = np.datetime64("2018-01-10T00:00", "s") + HOUR * np.arange(73)
    rows = [f"{at}Z,-6.0,80,3.0,{2.0 if k < 12 else 0.0}" for k, at in enumerate(time)]
    text = "\n".join(["time_utc,air_c,rh_percent,wind_m_s,rain_mm", *rows]) + "\n"
    notes, depths = [], []
    for name, more in (("inferred", ""), ("none", "snow_depth_m = 0.0\n")):
        own = f'[weather]\ntime = 2018-01-12T12:00:00Z\nfile = "station.csv"\n{more}'
        folder = write_balance(tmp_path / name, own)
        (folder / "station.csv").write_text(text)
        scene = load_scene(folder)
        notes.append(" ".join(scene.weather_notes))
        depths.append(lying_snow(scene.materials, scene.weather, scene.time).depth_m)
    # 23 mm of water two days after they fell.
    assert 23.0 / 270.0 < depths[0] < 23.0 / 250.0 and depths[1] == 0.0
    assert "Snow on the ground is missing: up to 0.09" in notes[0] and "lays it on soil, grass and heath" in notes[0]
    assert "states no snow on the ground" in notes[1] and "0 m throughout" in notes[1]


@pytest.mark.slow
def test_a_scene_is_solved_under_likely_snow(tmp_path):
    """Under a sun of noon, snow on soil and grass stays frozen; ground that states no snow is above 0 °C."""
    from thermorender.render.heat import simulation

    time = np.datetime64("2018-03-09T00:00", "s") + HOUR * np.arange(97)
    rows = [f"{at}Z,-2.0,70,2.0,{2.0 if k < 12 else 0.0}" for k, at in enumerate(time)]
    text = "\n".join(["time_utc,air_c,rh_percent,wind_m_s,rain_mm", *rows]) + "\n"
    warmest = []
    for name, more in (("inferred", ""), ("none", "snow_depth_m = 0.0\n")):
        folder = write_balance(tmp_path / name, f'[weather]\ntime = 2018-03-12T12:00:00Z\nfile = "station.csv"\n{more}')
        (folder / "station.csv").write_text(text)
        scene = load_scene(folder)
        found = simulation.solved(scene, [scene.time])[0].surfaces[0].temperature
        warmest.append(float(found.max()))
    assert 260.0 < warmest[0] <= 273.16 and warmest[1] > 276.0
