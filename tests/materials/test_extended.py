"""Materials not measured over the whole band: predictions against tables that were, and their use in scenes."""

from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import CAMERA, NARROW, write_terrain
from thermorender.errors import ThermorenderError
from thermorender.materials import extended
from thermorender.materials.extended import assumptions, missing, within_band
from thermorender.materials.library import load_library
from thermorender.materials.material import grey
from thermorender.render.plan import make_plan

BAND = (7.5, 13.5)
LIBRARY = load_library()
COMPLETE = [
    each
    for each in LIBRARY.values()
    if not missing(each, BAND) and each.directional == "lambertian" and not each.gaps_um
]


def cut(material, lower, upper):
    """The material as if it had been measured over lower…upper only."""
    inside = (material.wavelength_um > lower) & (material.wavelength_um < upper)
    wavelength = np.concatenate([[lower], material.wavelength_um[inside], [upper]])
    emissivity = np.interp(wavelength, material.wavelength_um, material.emissivity)
    return replace(material, wavelength_um=wavelength, emissivity=emissivity, emissivity_std=0.0 * wavelength)


@pytest.mark.parametrize(("lower", "upper"), [(8.0, 13.5), (7.5, 12.5), (8.0, 13.0)])
def test_measured_spectra_are_predicted_within_the_stated_error(lower, upper):
    errors, stated = [], []
    for material in COMPLETE:
        made = within_band(cut(material, lower, upper), BAND, LIBRARY, "here")
        errors.append(made.band_emissivity(*BAND, 300.0) - material.band_emissivity(*BAND, 300.0))
        stated.append(sum(one.emissivity_std for one in assumptions(made, BAND)))
    ratio = np.abs(errors) / stated
    assert len(errors) > 40 and np.sqrt(np.mean(np.square(errors))) < 0.0013
    assert np.mean(ratio < 1.0) > 0.85 and ratio.max() < 2.0


def test_the_measured_part_stays(tmp_path):
    tarmac = LIBRARY["tarmac"]
    made = within_band(tarmac, BAND, LIBRARY, "here")
    np.testing.assert_array_equal(made.emissivity_at(tarmac.wavelength_um), tarmac.emissivity)
    assert made.assumed_um == ((7.5, 8.0),) and made.wavelength_um[0] == 7.5
    (one,) = assumptions(made, BAND)
    # The share of 7.5–8 µm in the blackbody radiance of 7.5–13.5 µm at 300 K.
    assert one.share == pytest.approx(0.0789, abs=2e-4) and assumptions(made, (8.0, 12.0)) == []
    assert within_band(LIBRARY["asphalt"], BAND, LIBRARY, "here") is LIBRARY["asphalt"]


def test_all_shipped_materials_can_be_used_in_the_default_band():
    for material in LIBRARY.values():
        assert not missing(within_band(material, BAND, LIBRARY, "here"), BAND), material.name


def test_what_cannot_be_assumed_is_refused():
    half = cut(LIBRARY["asphalt"], 9.0, 13.5)
    with pytest.raises(ThermorenderError, match=r"here: material 'asphalt' was asked .* measured over 9–13.5 µm only"):
        within_band(half, BAND, LIBRARY, "here")
    alone = {"tarmac": LIBRARY["tarmac"], "grey": grey("grey", 0.9)}
    with pytest.raises(
        ThermorenderError, match=r"lacks 8% of the band 7\.5–13\.5 µm, and the library has no materials"
    ):
        within_band(LIBRARY["tarmac"], BAND, alone, "here")


@pytest.mark.parametrize("band", [(3.7, 4.8), (3.1, 4.8)])
def test_nothing_is_assumed_in_the_mid_wave(band):
    """At either end, however small the missing share."""
    asphalt, lower = LIBRARY["asphalt"], band[0] + 0.05
    for material, covered in ((LIBRARY["tarmac"], "8–14"), (cut(asphalt, lower, 14.0), f"{lower:g}–14"),
                              (cut(asphalt, 3.0, 4.75), "3–4.75")):  # fmt: skip
        words = rf"'{material.name}' was asked .* {band[0]}–4.8 µm but was measured over {covered} µm only; choose"
        with pytest.raises(ThermorenderError, match=words):
            within_band(material, band, LIBRARY, "here")
    assert within_band(asphalt, band, LIBRARY, "here") is asphalt


def test_in_sunlight_the_mid_wave_is_predicted_worse(monkeypatch):
    """The figures for which nothing is assumed there."""
    monkeypatch.setattr(extended, "SHORTEST_ASSUMED_UM", 0.0)
    band, errors = (3.7, 4.8), []
    known = [each for each in LIBRARY.values() if not missing(each, band) and each.directional == "lambertian"]
    for material in known:
        made = within_band(cut(material, 4.0, 4.8), band, LIBRARY, "here")
        errors.append([made.band_emissivity(*band, t) - material.band_emissivity(*band, t) for t in (300.0, 5778.0)])
    rms = np.sqrt(np.mean(np.square(errors), axis=0))
    assert len(known) == 58 and rms == pytest.approx([0.0015, 0.0050], abs=5e-5)
    assert np.abs(errors).max() == pytest.approx(0.017, abs=5e-4)


def test_a_scene_states_what_it_assumes(tmp_path):
    scene = tr.load_scene(write_terrain(tmp_path / "tiny")).with_camera(CAMERA)
    paved = scene.with_material(grass_green="tarmac")
    assert "assumed" not in str(make_plan(scene)) and "assumed_mk" not in make_plan(scene).as_dict()
    plan = make_plan(paved)
    assert "tarmac" in str(plan) and "7.5–8 µm, 8% of the band, from similar materials: ± " in str(plan)
    # 0.0017 of a contrast of 300 K with 260 K; a unit of emissivity is about 30 K.
    assert 30.0 < plan.as_dict()["assumed_mk"]["tarmac"] < 80.0
    # Another band needs no assumption, and back again the same one.
    narrow = paved.with_camera(NARROW)
    assert make_plan(narrow).assumed == () and narrow.with_camera(CAMERA).digest() == paved.digest()
    assert scene.with_camera(NARROW).with_material(grass_green="tarmac").digest() == narrow.digest()
