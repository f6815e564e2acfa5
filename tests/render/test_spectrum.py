"""Spectral nodes of scenes with many mixed materials or very cold texels behind air, against the fine quadrature."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from thermorender.atmosphere.model import Atmosphere
from thermorender.errors import ThermorenderWarning
from thermorender.materials.library import load_library
from thermorender.materials.mixture import mix
from thermorender.physics.planck import band_radiance_derivative
from thermorender.render import spectrum
from thermorender.render.plan import make_plan
from thermorender.render.spectrum import REFERENCE_K, Envelope, Points, make_spectrum
from validation.made_scenes import in_memory, terrain

BAND = (7.5, 13.5)
TOLERANCE_MK = 5.0
LIBRARY = load_library()
STONES = ("granite", "roof_slate", "limestone", "wood", "roof_shingle")


def mixtures(count):
    """Return `count` Mixtures of three stones each, in eighths, and a metal."""
    random = np.random.Generator(np.random.Philox(1))
    made = []
    for _ in range(count):
        names = random.choice(STONES, 3, replace=False)
        made.append(mix([(LIBRARY[name], share / 8) for name, share in zip(names, (5, 2, 1), strict=True)]))
    return [*made, LIBRARY["paint_metallic"]]


def envelope(ground, objects=()):
    air = Atmosphere.standard("subarctic-winter").in_band(*BAND)
    return Envelope(BAND, ground, list(objects), None, 280.0, air, (130.0, 155.0))


def largest_error_mk(found, materials, scene):
    """Return the largest error in light reflected by these materials, over the scene's light, summed at all points."""
    points = Points.of(BAND, scene.air)
    spectra = np.array([material.emissivity_at(points.wavelength_um) for material in materials])
    outside, ground, objects = scene.sources(points)
    exact = scene.light(spectra, outside, ground, objects)
    solved = scene.light(found.emissivity, *(found.gathered(part) for part in (outside, ground, objects)))
    per_mk, worst = 1e-3 * band_radiance_derivative(REFERENCE_K, *BAND), 0.0
    passed = scene.paths()[::9] @ found.solver
    for own, reflected in zip(1.0 - spectra, found.reflected, strict=True):
        channels = np.stack([(exact * own * row[points.node]).sum(axis=1) for row in found.basis])
        worst = max(worst, float(np.abs(passed @ (channels - reflected @ solved.T)).max()) / per_mk)
    return worst


def test_many_mixed_materials_need_no_more_nodes_than_their_parts():
    materials = mixtures(20)
    scene = envelope((288.0, 300.0), [(20, 299.5)])
    parts = [*(LIBRARY[name] for name in STONES), materials[-1]]
    found = make_spectrum(materials, scene, TOLERANCE_MK, True)
    assert found.nodes == make_spectrum(parts, replace(scene, objects=[(5, 299.5)]), TOLERANCE_MK, True).nodes
    assert found.emissivity.shape[0] == found.reflected.shape[0] == len(materials)
    assert largest_error_mk(found, materials, scene) <= found.nodes_mk <= TOLERANCE_MK


def test_a_texel_of_100_k_does_not_prevent_the_default_tolerance():
    materials = [
        LIBRARY[name] for name in ("grass_green", "concrete", "glass", "roof_slate", "water", "paint_metallic")
    ]
    scene = envelope((108.0, 299.0), [(5, 299.5)])
    found = make_spectrum(materials, scene, TOLERANCE_MK, True)
    warm = make_spectrum(materials, replace(scene, ground=(288.0, 299.0)), TOLERANCE_MK, True)
    assert found.nodes <= 1.5 * warm.nodes
    # All light is colder than 300 K, where an error is counted at 300 K.
    assert largest_error_mk(found, materials, scene) <= 1.001 * found.nodes_mk <= TOLERANCE_MK


@pytest.mark.slow
def test_frame_of_mixed_materials_and_a_cold_texel_agrees_with_many_nodes(monkeypatch):
    rough = terrain(400, 40, side_m=60.0)
    random = np.random.Generator(np.random.Philox(2))
    materials = mixtures(30)
    kinds = random.integers(0, len(materials), rough.surfaces[0].material.shape).astype(np.uint8)
    kelvin = random.uniform(285.0, 320.0, kinds.shape).astype(np.float32)
    kelvin[7, 7] = 108.0
    surface = replace(rough.surfaces[0], material=kinds, temperature=kelvin)
    scene = in_memory("mixed", (surface,), materials).with_air("tropical")
    own = tr.Renderer(scene, rays=64)
    monkeypatch.setattr(spectrum, "MOST_NODES", 400)
    fine = tr.Renderer(scene, rays=64, tolerance_mk=0.05)
    assert own.plan.nodes < 40 < fine.plan.nodes and make_plan(scene).sampling.tolerance_mk == TOLERANCE_MK
    pose = tr.pose(0, 0, 60, pitch_deg=-90)
    change = (own.radiance(pose) - fine.radiance(pose)) / own.plan.radiance_per_mk
    budget = own.frame(pose).budget_mk
    assert np.sqrt(np.mean(change**2)) < np.hypot(budget["nodes"], budget["air"])
    assert np.abs(change).max() < TOLERANCE_MK + budget["air"]


def test_nodes_that_miss_the_tolerance_are_warned_of_and_counted_in_the_budget(monkeypatch):
    rough = terrain(300, 24, side_m=60.0)
    kinds = np.indices(rough.surfaces[0].material.shape).sum(axis=0) % len(STONES)
    surface = replace(rough.surfaces[0], material=kinds.astype(np.uint8))
    scene = in_memory("stones", (surface,), [LIBRARY[name] for name in STONES]).with_air("tropical")
    scene = scene.with_camera(replace(scene.camera, width=48, height=40))
    fine = tr.Renderer(scene, rays=32)
    assert fine.plan.nodes > 2 and fine.plan.beyond_tolerance is None
    monkeypatch.setattr(spectrum, "MOST_NODES", 2)
    with pytest.warns(
        ThermorenderWarning, match=r"^tolerance_mk=5 is not reached with 2 .*: up to .* mK remain"
    ) as caught:
        coarse = tr.Renderer(scene, rays=32)
    accepted = float(str(caught[0].message).partition("--tolerance-mk ")[2].split()[0])
    assert TOLERANCE_MK < coarse.plan.spectrum.nodes_mk <= accepted
    assert any("above the tolerance of 5 mK" in why for _, _, why in coarse.plan.rows())
    pose = tr.pose(0, 0, 60, pitch_deg=-90)
    change = (coarse.radiance(pose) - fine.radiance(pose)) / fine.plan.radiance_per_mk
    budget = coarse.frame(pose).budget_mk
    assert 0.0 < np.sqrt(np.mean(change**2)) < budget["nodes"] and budget["nodes"] >= coarse.plan.spectrum.nodes_mk
    with warnings.catch_warnings(action="error"):
        tr.Renderer(scene, rays=32, tolerance_mk=accepted)


@pytest.mark.parametrize("edit", ["one coloured", "all grey", "another order", "colder sky"])
def test_kept_nodes_state_the_error_of_edited_materials_and_of_light_from_them(edit):
    materials = [LIBRARY[name] for name in (*STONES, "paint_metallic")]
    scene = Envelope(BAND, (270.0, 298.0), [(5, 285.0)], 240.0, 280.0, None, (0.0, 10.0))
    before = make_spectrum(materials, scene, TOLERANCE_MK, True)
    edited, seen = list(materials), scene
    if edit == "one coloured":
        wavelength = np.linspace(7.0, 14.0, 71)
        narrow = np.clip(0.98 - np.exp(-(((wavelength - 8.2) / 0.3) ** 2)), 0.01, 1.0)
        edited[1] = replace(materials[1], name="narrow", wavelength_um=wavelength, emissivity=narrow)
    elif edit == "all grey":
        edited = [replace(each, emissivity=np.full_like(each.emissivity, 0.8)) for each in materials]
    elif edit == "another order":
        edited = materials[::-1]
    else:
        seen = replace(scene, sky_temperature=150.0)
    found = spectrum.kept_spectrum(before, materials, edited, seen)
    # Light of at most 300 K, where a millikelvin is that of 300 K.
    assert largest_error_mk(found, edited, seen) <= found.nodes_mk * (1.0 + 1e-6)
    assert (found.nodes_mk > before.nodes_mk) == (edit in ("one coloured", "colder sky"))
    assert np.array_equal(found.label, before.label) and found.envelope is seen


@pytest.mark.parametrize("edit", ["nothing", "a part", "warmer ground"])
def test_kept_nodes_state_the_error_of_edited_mixtures(edit):
    """Behind air: each part of a mixture is fitted, as in a new spectrum."""
    materials, scene = mixtures(20), envelope((288.0, 300.0), [(20, 299.5)])
    before = make_spectrum(materials, scene, TOLERANCE_MK, True)
    stone, edited, seen = LIBRARY["granite"], list(materials), scene
    if edit == "a part":
        other = replace(stone, name="other", emissivity=np.clip(1.3 * stone.emissivity - 0.2, 0.05, 1.0))
        edited = [
            mix([(other if part is stone else part, share) for part, share in each.parts]) for each in edited[:-1]
        ]
        edited.append(materials[-1])
    elif edit == "warmer ground":
        seen = replace(scene, ground=(288.0, 315.0))
    found = spectrum.kept_spectrum(before, materials, edited, seen)
    assert np.array_equal(found.label, before.label) and np.array_equal(found.basis, before.basis)
    assert largest_error_mk(found, edited, seen) <= found.nodes_mk * (1.0 + 1e-6)
    if edit == "nothing":
        np.testing.assert_array_equal(found.reflected, before.reflected)
        assert found.nodes_mk == before.nodes_mk
    # Mixtures that come or go have other parts.
    assert spectrum.kept_spectrum(before, materials, [stone, stone], seen) is None
