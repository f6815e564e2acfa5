"""Sites with measured surface temperatures: their files, the measurements read from them, and the published figures."""

import json

import numpy as np
import pytest
from support import shared_data, slow

from thermorender.errors import ThermorenderError
from thermorender.materials.library import load_library
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.scene import open_ground
from validation.heat import study as heat
from validation.heat.sites import measured, modelled, read_sites

SITES = heat.SITES
HEAD = """[[site]]
name = "made"
title = "Made"
file = "made.csv"
latitude_deg = 50.0
longitude_deg = 10.0
altitude_m = 300.0
"""


def site_of(folder, text, rows=49, step_min=30, **columns):
    """A Site with its own file: a clear day over a column of numbers."""
    time = np.datetime64("2020-06-20T00:00", "s") + np.arange(rows) * np.timedelta64(60 * step_min, "s")
    own = {"air_c": np.full(rows, 15.0), "rh_percent": np.full(rows, 60.0), "wind_m_s": np.full(rows, 3.0),
           "lw_down_w_m2": np.full(rows, 330.0), **columns}  # fmt: skip
    lines = [",".join(["time_utc", *own])]
    lines += [",".join([f"{at}Z", *(f"{values[k]:.6f}" for values in own.values())]) for k, at in enumerate(time)]
    (folder / "made.csv").write_text("\n".join(lines) + "\n")
    (folder / "sites.toml").write_text(HEAD + text)
    return read_sites(folder / "sites.toml")[0]


def test_sites_of_the_project_name_materials_with_thermal_properties():
    library = load_library()
    sites = read_sites(SITES)
    assert len({site.name for site in sites}) == len(sites) >= 11
    for site in sites:
        assert all(library[name].thermal for name, _ in site.cover)


def test_upwelling_longwave_becomes_a_temperature(tmp_path):
    """ε σ T⁴ + (1 − ε) L gives back exactly T."""
    kelvin, emissivity = 300.0, 0.95
    up = np.full(49, emissivity * STEFAN_BOLTZMANN * kelvin**4 + (1.0 - emissivity) * 330.0)
    site = site_of(tmp_path, 'cover = [["asphalt", 1.0]]\nlongwave_up = "up"\nemissivity = 0.95\n', up=up)
    assert measured(site, tmp_path).observed_k == pytest.approx(np.full(49, kelvin), abs=1e-4)


@pytest.mark.slow
def test_model_that_equals_the_measurement_has_no_error(tmp_path):
    text = 'cover = [["asphalt", 0.5], ["soil_loam", 0.5]]\nsurface = "surface_c"\n'
    site = site_of(tmp_path, text, surface_c=np.zeros(49))
    own = modelled(measured(site, tmp_path))
    site = site_of(tmp_path, text, surface_c=own - 273.15)
    study = heat.run(tmp_path / "sites.toml", tmp_path)
    assert study["sites"]["made"]["scores"]["balance"]["day"]["rms"] < 1e-5
    assert study["sites"]["made"]["scores"]["air"]["day"]["rms"] > 1.0
    assert study["missing"] == []


@pytest.mark.slow
def test_temperature_of_a_mixed_cover_is_between_those_of_its_parts(tmp_path):
    parts = [
        modelled(measured(site_of(tmp_path, f'cover = {cover}\nsurface = "air_c"\n'), tmp_path))
        for cover in ('[["asphalt", 1.0]]', '[["grass_green", 1.0]]', '[["asphalt", 0.3], ["grass_green", 0.7]]')
    ]
    assert (np.minimum(*parts[:2]) < parts[2]).all() and (parts[2] < np.maximum(*parts[:2])).all()


def test_errors_are_parted_by_sun_and_sky(tmp_path):
    """A model 1 K too warm under clear skies and 2 K too cold under clouds is found so at each height of the sun."""
    overcast = np.arange(49) % 2 == 1
    longwave = np.where(overcast, STEFAN_BOLTZMANN * 288.15**4, 300.0)
    text = 'cover = [["asphalt", 1.0]]\nsurface = "surface_c"\n'
    site = site_of(tmp_path, text, surface_c=np.full(49, 20.0), lw_down_w_m2=longwave)
    found = measured(site, tmp_path)
    parts = heat.where(found, found.observed_k + np.where(overcast, -2.0, 1.0))
    assert set(parts) == set(heat.CONDITIONS)
    assert sum(part["rows"] for part in parts.values()) == (np.abs(found.elevation_deg) > 3.0).sum()
    for name, part in parts.items():
        assert part["bias"] == pytest.approx(1.0 if name.endswith("clear") else -2.0)
        assert part["mae"] == abs(part["bias"])


def test_model_starts_from_measured_soil_temperatures(tmp_path):
    soil = 'soil = [[0.05, "a_c"], [1.0, "b_c"]]\n'
    text = 'cover = [["soil_loam", 1.0]]\nsurface = "air_c"\n' + soil
    warm, cold = (
        modelled(measured(site_of(tmp_path, text, a_c=np.full(49, t), b_c=np.full(49, t)), tmp_path))
        for t in (25.0, 5.0)
    )
    assert warm[0] - cold[0] == pytest.approx(20.0)
    assert (warm > cold).all()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('cover = [["asphalt", 1.0]]\n', "needs exactly one of longwave_up, surface, water"),
        ('cover = [["asphalt", 0.7]]\nsurface = "air_c"\n', "shares that add up to 1, not to 0.7"),
        ('cover = ["asphalt"]\nsurface = "air_c"\n', "a list of pairs"),
    ],
)
def test_inconsistent_site_is_refused(tmp_path, text, words):
    with pytest.raises(ThermorenderError, match=words):
        site_of(tmp_path, text)


def test_sensors_inside_the_cover_are_refused(tmp_path):
    """Where the logarithm of height over roughness is not positive, heat would flow the wrong way."""
    text = 'cover = [["conifer", 1.0]]\nsurface = "surface_c"\nair_height_m = 0.5\nwind_height_m = 2.0\n'
    found = measured(site_of(tmp_path, text, surface_c=np.zeros(49)), tmp_path)
    with pytest.raises(ThermorenderError, match=r"air_height_m=0.5, wind_height_m=2 are too low over conifer"):
        modelled(found)


def test_missing_columns_tables_and_materials_are_refused(tmp_path):
    site = site_of(tmp_path, 'cover = [["asphalt", 1.0]]\nsurface = "ground_c"\n')
    with pytest.raises(ThermorenderError, match=r"made.csv has no column 'ground_c'; row 1 names time_utc, air_c"):
        measured(site, tmp_path)
    with pytest.raises(ThermorenderError, match=r"made.csv does not exist; give the folder of made.csv"):
        measured(site, tmp_path / "elsewhere")
    site = site_of(tmp_path, 'cover = [["asfalt", 1.0]]\nsurface = "air_c"\n')
    with pytest.raises(ThermorenderError, match="site 'made': cover='asfalt' is not a material"):
        modelled(measured(site, tmp_path))


def test_repeated_day_converges():
    """Columns of all kinds end a repeated day as they began it, to 0.1 K."""
    from thermorender.weather.named_day import named_day

    at = np.datetime64("2018-07-28T12:00:00")
    weather = named_day(at, (52.0, 21.0, 100.0), air_low_c=12.0, air_high_c=24.0, humidity_low=0.8, wind_m_s=2.5,
                        cloud=0.1)  # fmt: skip
    library = load_library()
    names = ("asphalt", "grass_green", "sand_quartz", "conifer", "granite", "roof_slate", "water", "aluminium_sheet")
    columns = open_ground.columns([library[name] for name in names], weather, 0.0, 0.03)
    state, change = open_ground.settled(columns, weather, weather.time[0])
    later = open_ground.march(columns, weather, state, weather.time[0], weather.time[0] + np.timedelta64(1, "D"))[-1]
    print(change, later.surface_k - state.surface_k)
    assert np.abs(later.surface_k - state.surface_k).max() < 0.15


@pytest.mark.parametrize("name", ["grass", "square", *slow("desert", "lake")])
def test_published_figures_match_the_code(name):
    """Compared with `validation/heat/heat.json`, to its rounding and to other processors' arithmetic."""
    stated = json.loads((SITES.parent / "heat.json").read_text())["sites"][name]["scores"]["balance"]
    site = next(site for site in read_sites(SITES) if site.name == name)
    shared_data(f"weather/{site.file}")
    found = measured(site, shared_data("weather"))
    scores = heat.scores_of(found, modelled(found))
    for part in ("day", "night"):
        assert scores[part]["mae"] == pytest.approx(stated[part]["mae"], abs=2e-3, nan_ok=True)


def test_measurements_are_read_like_the_weather(tmp_path):
    """−9999 is not a temperature, and times may have an offset."""
    surface = np.full(49, 20.0)
    surface[7] = -9999.0
    site = site_of(tmp_path, 'cover = [["asphalt", 1.0]]\nsurface = "surface_c"\n', surface_c=surface)
    found = measured(site, tmp_path)
    assert np.flatnonzero(~found.scored).tolist() == [7] and found.observed_k[8] == pytest.approx(293.15)
    path = tmp_path / "made.csv"
    text = path.read_text().replace("time_utc", "time").replace("Z,", "+02:00,")
    path.write_text(text)
    east = measured(site, tmp_path)
    assert (found.weather.time - east.weather.time == np.timedelta64(2, "h")).all()
    assert np.array_equal(east.observed_k, found.observed_k, equal_nan=True)
