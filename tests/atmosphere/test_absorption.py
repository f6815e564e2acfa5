"""User-supplied absorption data: against Elsasser's band summed line by line, against small steps, and damaged files.

Elsasser's band has lines of equal strength at equal distances, broadened by pressure (Elsasser 1938,
doi:10.1103/PhysRev.54.126). The cross section at a fraction x of the distance is s sinh β / (cosh β − cos 2πx), with β
= 2π γ p / distance. The order of wavelengths is the same at every pressure, so its k-distribution is exact and known
without sorting: g = 2x.
"""

import air_by_steps
import numpy as np
import pytest
import trimesh

import thermorender as tr
from scenes import write_mesh
from thermorender.atmosphere.absorption import from_absorption, read_absorption
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import BOLTZMANN, band_radiance, band_radiance_derivative, brightness_temperature

BANDS = np.array([[7.5, 9.0], [9.0, 11.0], [11.0, 13.5]])
# Lines of each band: mean cross section at 296 K [cm²], and half width at 1000 hPa in units of the distance.
STRENGTH, WIDTH = (3e-22, 4e-23, 1e-21), (0.15, 0.1, 0.2)
PPM = {"vapour": 8000.0, "haze": 2.0}
GREY = 2e-20
POINTS = 16
PRESSURE, WARM = np.geomspace(100.0, 1100.0, 49), np.linspace(200.0, 320.0, 41)
LEVELS = np.array([(0, 1013.25, 288.15), (1e3, 898.74, 281.65), (3e3, 701.08, 268.65), (9e3, 307.42, 229.65)])


def line(band, x, pressure, temperature):
    """Cross section of a band's vapour at fractions x of the line distance [cm²]."""
    beta = 2.0 * np.pi * WIDTH[band] * pressure / 1000.0
    return STRENGTH[band] * (296.0 / temperature) ** 1.5 * np.sinh(beta) / (np.cosh(beta) - np.cos(2.0 * np.pi * x))


def arrays():
    node, weight = np.polynomial.legendre.leggauss(POINTS)
    x = 0.25 * (node + 1.0)
    section = np.empty((2, 3, POINTS, len(PRESSURE), len(WARM)))
    for band in range(3):
        section[0, band] = line(band, x[:, None, None], PRESSURE[:, None], WARM)
    section[1] = GREY
    return {
        "gas": np.array(["vapour", "haze"]), "lower_um": BANDS[:, 0], "upper_um": BANDS[:, 1],
        "weight": np.tile(0.5 * weight, (3, 1)), "pressure_hpa": PRESSURE, "temperature": WARM,
        "cross_section_cm2": section,
    }  # fmt: skip


def written(folder, levels=LEVELS, **changes):
    """(file of absorption data, file of a profile) in a folder."""
    values = {name: value for name, value in {**arrays(), **changes}.items() if value is not None}
    np.savez(folder / "k.npz", **values)
    rows = [f"{z},{p},{t},{PPM['haze']},{PPM['vapour']}" for z, p, t in levels]
    (folder / "air.csv").write_text("altitude_m,pressure_hpa,temperature_k,haze_ppm,vapour_ppm\n" + "\n".join(rows))
    return folder / "k.npz", folder / "air.csv"


def line_by_line(altitude, distance, behind):
    """Radiance of a black wall behind a path, summed over wavelengths and the 4000 steps between its points."""
    pressure = np.exp(np.interp(altitude, LEVELS[:, 0], np.log(LEVELS[:, 1])))
    temperature = np.interp(altitude, LEVELS[:, 0], LEVELS[:, 2])
    number = 100.0 * pressure / (BOLTZMANN * temperature)
    x, total = (np.arange(400) + 0.5) / 800.0, 0.0
    for band, limits in enumerate(BANDS):
        vapour = line(band, x[:, None], pressure, temperature)
        extinction = 1e-4 * 1e-6 * number * (PPM["vapour"] * vapour + PPM["haze"] * GREY)
        steps = 0.5 * (extinction[:, 1:] + extinction[:, :-1]) * np.diff(distance)
        passed = np.exp(-np.concatenate([np.zeros((len(x), 1)), np.cumsum(steps, axis=1)], axis=1))
        source = band_radiance(temperature, *limits)
        light = (0.5 * (source[1:] + source[:-1]) * -np.diff(passed, axis=1)).sum(axis=1)
        total += (light + passed[:, -1] * band_radiance(behind, *limits)).mean()
    return total


@pytest.mark.parametrize("camera_m", [50.0, 1000.0, 8000.0])
@pytest.mark.parametrize("wall_k", [268.0, 308.0])
def test_radiance_from_above_equals_the_sum_over_lines_and_steps(tmp_path, camera_m, wall_k):
    air = from_absorption(*written(tmp_path)).in_band(7.5, 13.5)
    assert air.nodes == 3 * POINTS
    passed, added = air.path(camera_m, 0.0, camera_m)
    found = passed @ air.planck(wall_k) + added.sum()
    exact = line_by_line(*(camera_m * np.linspace(1.0, 0.0, 4001), camera_m * np.linspace(0.0, 1.0, 4001)), wall_k)
    error = brightness_temperature(found, 7.5, 13.5) - brightness_temperature(exact, 7.5, 13.5)
    # The interpolation over 49 pressures and 3 K steps leaves 0.35 mK; 97 pressures and 32 points leave 0.33 mK.
    assert abs(error) < 1e-3, error
    assert passed.mean() < 0.7


def test_level_path_equals_elsassers_integral(tmp_path):
    """At one pressure and temperature T = ∫ e^(−k(x) u) dx, here over 10⁵ points of the lines; paths up to 3 km."""
    alike = np.array([(0.0, 1000.0, 290.0), (500.0, 1000.0 * np.exp(-500.0 / 8487.0), 290.0)])
    air = from_absorption(*written(tmp_path, alike))
    x = (np.arange(100_000) + 0.5) / 2e5
    for metres in (1.0, 100.0, 3000.0):
        through = air.weight * air.transmittance(0.0, 0.0, metres)
        for band in range(3):
            number = 1e-4 * 1000.0 / (BOLTZMANN * 290.0) * 100.0 * metres * 1e-6
            depth = number * (PPM["vapour"] * line(band, x, 1000.0, 290.0) + PPM["haze"] * GREY)
            # A 3 km chord dips by 0.15 m, 2e-5 of the density; interpolating k adds 1e-5.
            assert through[band * POINTS : (band + 1) * POINTS].sum() == pytest.approx(np.exp(-depth).mean(), abs=2e-5)


def test_absorption_model_against_a_thousand_steps(tmp_path):
    air = from_absorption(*written(tmp_path)).in_band(7.5, 13.5)
    for path in ((120.0, 0.0, 500.0), (8000.0, 0.0, 2e4), (10.0, 9000.0, 1.2e4), (500.0, 500.0, 2e4)):
        passed, light = air_by_steps.between(air, *path)
        through, emitted = air.path(*path)
        assert np.abs(through - passed).max() < 3e-5
        assert abs((emitted - light).sum()) / band_radiance_derivative(285.0, 7.5, 13.5) < 10e-3, path


def scene(folder, more="", temperature=305.0):
    """A black plane under the user's air, from the files in a folder."""
    h = 400.0
    mesh = trimesh.Trimesh([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]], [[0, 1, 2], [0, 2, 3]])
    write_mesh(folder, mesh, temperature, 1.0)
    text = (folder / "scene.toml").read_text()
    own = f'[atmosphere]\nprofile = "air.csv"\nabsorption = "k.npz"\n{more}'
    (folder / "scene.toml").write_text(text.replace("[sky]\ntemperature = 250.0\n", own))
    return folder


def test_frame_through_user_supplied_air(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    written(folder)
    renderer = tr.Renderer(tr.load_scene(scene(folder)), rays=16)
    seen = renderer.frame(tr.pose(0, 0, 1000.0, pitch_deg=-90.0)).apparent_temperature[254:258, 318:322].mean()
    exact = line_by_line(*(1000.0 * np.linspace(1.0, 0.0, 4001), 1000.0 * np.linspace(0.0, 1.0, 4001)), 305.0)
    allowed = renderer.plan.spectrum.channels_mk * 1e-3 + 3e-3
    assert seen == pytest.approx(brightness_temperature(exact, 7.5, 13.5), abs=allowed) and seen < 304.0
    with pytest.raises(ThermorenderError, match=r"atmosphere.aerosol='rural'.*without absorption only"):
        tr.load_scene(scene(folder, 'aerosol = "rural"\n'))
    text = (folder / "scene.toml").read_text().replace('profile = "air.csv"\n', 'standard = "tropical"\n')
    (folder / "scene.toml").write_text(text.replace('aerosol = "rural"\n', ""))
    with pytest.raises(ThermorenderError, match=r"atmosphere.absorption=.* with profile only, not with standard"):
        tr.load_scene(folder)


def test_data_at_one_pressure_and_temperature_cover_no_other(tmp_path):
    level = np.array([(0.0, 1000.0, 290.0), (1.0, 999.9, 290.0)])
    one = arrays()["cross_section_cm2"][..., :1, :1]
    files = written(tmp_path, level, cross_section_cm2=one, pressure_hpa=[1000.0], temperature=[290.0])
    with pytest.raises(ThermorenderError, match=r"at 1 m pressure_hpa is 999.9, which absorption data .* do not cover"):
        from_absorption(*files)


def test_zero_cross_section_is_interpolated_linearly(tmp_path):
    section = arrays()["cross_section_cm2"][:1] * 0.0
    section[..., 1:] = 1e-22
    files = written(tmp_path, np.array([(0.0, 1000.0, 235.0), (1.0, 999.85, 235.0)]), cross_section_cm2=section,
                    gas=np.array(["vapour"]), temperature=230.0 + 10.0 * np.arange(len(WARM)))  # fmt: skip
    depth = -np.log(from_absorption(*files).transmittance(0.0, 0.0, 1000.0))
    expected = 1e-22 * 0.5 * PPM["vapour"] * 1e-6 * 1e-4 * 1000.0 / (BOLTZMANN * 235.0) * 1e5
    assert depth == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"weight": None}, "has no array weight; give an .npz file as docs/reference/file-formats.md describes it"),
        ({"weight": np.full((3, 16), 0.1)}, "weight sums to 1.6 over 7.5–9 µm; the sum must be 1"),
        ({"weight": np.full((3, 15), 1 / 15)}, r"cross_section_cm2 is .* but weight is \(3, 15\)"),
        ({"gas": np.array(["vapour", "vapour"])}, "gas holds 'vapour'; names must be unique"),
        ({"gas": np.array([1.0, 2.0])}, "gas is of type float64, but text is needed"),
        ({"gas": np.array(["vapour", None])}, "has no array gas|is not an .npz file"),
        ({"lower_um": BANDS[::-1, 0], "upper_um": BANDS[::-1, 1]}, "lower_um does not rise: 9 follows 11"),
        ({"upper_um": np.array([9.0, 10.9, 13.5])}, "are not contiguous sub-bands"),
        ({"pressure_hpa": PRESSURE[::-1]}, "pressure_hpa does not rise"),
        ({"pressure_hpa": PRESSURE * 1e3}, r"pressure_hpa holds 1\d{5}; allowed are 1e-09 … 100000"),
        ({"temperature": WARM - 273.15}, "temperature holds -73.15; allowed are 50 … 5000"),
        ({"cross_section_cm2": -arrays()["cross_section_cm2"]}, "cross_section_cm2 holds .*; it must not be negative"),
        ({"cross_section_cm2": np.nan * arrays()["cross_section_cm2"]}, "cross_section_cm2 holds nan; numbers must be"),
        ({"cross_section_cm2": 1e14 * arrays()["cross_section_cm2"]}, "but no molecule has more than 1e-10 cm²"),
        ({"temperature": WARM + 40.0}, "at .* m temperature is .*, which absorption data .* do not cover .240"),
    ],
)
def test_inconsistent_absorption_data_are_refused(tmp_path, changes, words):
    with pytest.raises(ThermorenderError, match=words) as caught:
        from_absorption(*written(tmp_path, **changes))
    assert "k.npz" in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ("0,1013.25,288.15,2,-1", "vapour_ppm=-1 is out of range; give parts per million of all molecules"),
        ("0,1013.25,288.15,2,2e6", r"vapour_ppm=2e\+06 is out of range"),
        ("0,1013.25,288.15,2,nan", "has a value that is not finite"),
        ("0,1013.25,15.0,2,8000", "temperature_k=15 is not an air temperature in kelvin"),
        ("0,1013.25,288.15,2", "is not a row of numbers; give 5 with"),
    ],
)
def test_profiles_of_gases_are_refused(tmp_path, row, words):
    data, path = written(tmp_path)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], row, *lines[2:]]))
    with pytest.raises(ThermorenderError, match=words):
        from_absorption(data, path)
    path.write_text("\n".join([lines[0].replace("vapour_ppm", "water_ppm"), *lines[1:]]))
    with pytest.raises(ThermorenderError, match=r"no column vapour_ppm; .* temperature_k, vap"):
        from_absorption(data, path)


def test_damaged_files_are_refused_in_one_sentence_or_read_correctly(tmp_path):
    """Flipped, cut and repeated bytes, and single values: no other exception, no warning, no NaN in the result."""
    random = np.random.default_rng(3)
    small = arrays()
    small["cross_section_cm2"] = small["cross_section_cm2"][..., ::16, ::20]
    small["pressure_hpa"], small["temperature"] = PRESSURE[::16], WARM[::20]
    path, csv = written(tmp_path, **small)
    whole, refused = path.read_bytes(), 0

    def tried():
        try:
            air = from_absorption(path, csv)
        except ThermorenderError as error:
            message = str(error)
        else:
            assert np.isfinite(air.path(1000.0, 0.0, 1000.0)).all()
            return 0
        assert "\n" not in message and len(message) < 500
        return 1

    for _ in range(250):
        data, at = bytearray(whole), random.integers(len(whole))
        kind = random.integers(3)
        if kind == 0:
            data[at] ^= 1 << random.integers(8)
        elif kind == 1:
            del data[at : at + random.integers(1, 2000)]
        else:
            data[at:at] = data[at // 2 : at // 2 + 40]
        path.write_bytes(data)
        refused += tried()
    # The zip checksums catch most damage; a flipped bit in a time stamp is harmless.
    assert refused > 200
    refused = 0
    numbers = [name for name in small if name != "gas"]
    for turn in range(300):
        name = numbers[turn % len(numbers)]
        value = np.array(small[name], dtype=float)
        value.flat[random.integers(value.size)] = random.choice([np.nan, np.inf, -np.inf, -1.0, 0.0, 1e300, 5e-324])
        np.savez(path, **{**small, name: value})
        refused += tried()
    assert refused > 200


def test_shipped_format_is_plain(tmp_path):
    path, _ = written(tmp_path)
    assert read_absorption(path)["gas"].tolist() == ["vapour", "haze"]
    with pytest.raises(ThermorenderError, match=r"absorption data .* cannot be read"):
        read_absorption(tmp_path / "none.npz")
