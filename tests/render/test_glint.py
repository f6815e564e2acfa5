"""The sun in mirrors: its disc in a smooth one, and its spread image in rough water against facets drawn at random."""

from dataclasses import replace

import air_by_steps
import numpy as np
import pytest

import thermorender as tr
from scenes import plane, scene_object, write_mesh
from thermorender.physics import sun
from thermorender.physics.fresnel import smooth_emissivity
from thermorender.physics.planck import spectral_radiance
from thermorender.render.plan import make_plan
from thermorender.render.reflection.device_tables import _masking
from thermorender.render.variant import activate
from thermorender.sensor.camera import load_camera

AIR = '[atmosphere]\nstandard = "midlatitude-summer"\n'
SUN = "[sun]\nelevation_deg = {}\nazimuth_deg = 0.0\n"
# Slopes that are drawn, to either side.
_AROUND = 0.02
DISC_RAD = np.sqrt(sun.SOLID_ANGLE_SR / np.pi)


BANDS = pytest.mark.parametrize("camera", ["zenmuse-xt2", "neutrino-lc"])


def water(folder, material, elevation_deg, extra="", camera="zenmuse-xt2", air=AIR):
    """The frames' differences, with and without the sun, of level water: a function of the pose, and the lit Scene."""
    renderers = []
    for name, more in (("dark", ""), ("lit", SUN.format(elevation_deg))):
        write_mesh(folder / name, plane(4000.0), 290.0, extra=more + extra)
        path = folder / name / "scene.toml"
        text = path.read_text().replace(
            'source = "constant"\nvalue = 0.9', f'source = "material"\nmaterial = "{material}"'
        )
        path.write_text(text.replace("[sky]\ntemperature = 250.0\n", air))
        renderers.append(tr.Renderer(tr.load_scene(folder / name).with_camera(camera), samples=4))
    return lambda pose: renderers[1].radiance(pose) - renderers[0].radiance(pose), renderers[1].scene


def refractive_index(scene, wavelength):
    """(n, k) at wavelengths of the scene's first material, as tabulated."""
    rows = np.loadtxt(scene.materials[0].table.splitlines(), delimiter=",", skiprows=1)
    return [np.interp(wavelength, rows[:, 0], rows[:, column]) for column in (1, 2)]


def image_of_the_sun(scene, elevation_deg, height_m, cosine, incidence):
    """Radiance of the disc [W m⁻² sr⁻¹] that a facet reflects at a cosine of incidence, through the air up to a camera
    that looks down at `cosine`: summed over nodes and wavelengths."""
    air, total = scene.air, 0.0
    down, _ = air_by_steps.outward(air, 0.0, np.sin(np.radians(elevation_deg)))
    up, _ = air_by_steps.between(air, height_m, 0.0, height_m / cosine)
    for lower, upper in sorted({*zip(air.lower_um, air.upper_um, strict=True)}):
        node, weight = np.polynomial.legendre.leggauss(32)
        wavelength, weight = lower + 0.5 * (upper - lower) * (1.0 + node), 0.5 * (upper - lower) * weight
        n, k = refractive_index(scene, wavelength)
        bright = spectral_radiance(wavelength, sun.brightness_temperature(wavelength)) * weight
        own = air.lower_um == lower
        share = air_by_steps.planck(air, 5500.0)[0, own]
        passed = (down * up)[own] @ share / share.sum()
        total += passed * bright @ (1.0 - smooth_emissivity(incidence, n, k))
    return float(total)


@BANDS
@pytest.mark.parametrize("elevation_deg", [25.0, 50.0])
def test_still_water_shows_the_disc_where_it_reflects_it(tmp_path, elevation_deg, camera):
    more, scene = water(tmp_path, "water_fresnel", elevation_deg, camera=camera)
    image = more(tr.pose(0, 0, 100.0, yaw_deg=0.0, pitch_deg=-elevation_deg))
    row, column = np.mgrid[: image.shape[0], : image.shape[1]] + 0.5
    local = scene.camera.directions(np.stack([column, row], axis=-1).reshape(-1, 2)).reshape(*image.shape, -1)
    # From the axis, on which the disc is.
    off = np.arctan(np.hypot(local[..., 0], local[..., 1]))
    pixel = 1.0 / scene.camera.focal_length_px
    inside, outside = off < DISC_RAD - 1.5 * pixel, off > DISC_RAD + 1.5 * pixel
    sine = np.sin(np.radians(elevation_deg))
    wanted = image_of_the_sun(scene, elevation_deg, 100.0, sine, sine)
    # Channels, and a table of 257 angles. By Fresnel's equations the reflectance changes by 0.7 % from row to row.
    assert inside.sum() > 10 and image[inside].mean() == pytest.approx(wanted, rel=4e-3)
    assert np.abs(image[inside] / wanted - 1.0).max() < 0.02
    # What is left is diffuse light of the sun on the surroundings: none.
    assert np.abs(image[outside]).max() < 1e-4 * wanted
    # All of the disc: its solid angle in pixels.
    assert image.sum() / wanted == pytest.approx(sun.SOLID_ANGLE_SR / pixel**2, rel=0.03)


@BANDS
@pytest.mark.parametrize(("elevation_deg", "pitch_deg"), [(50.0, -55.0), (35.0, -35.0), (60.0, -28.0)])
def test_rough_water_spreads_the_disc_as_facets_drawn_at_random(tmp_path, elevation_deg, pitch_deg, camera):
    _, scene = water(tmp_path, "water_breeze", elevation_deg, camera=camera)
    pose = tr.pose(0, 0, 100.0, yaw_deg=0.0, pitch_deg=pitch_deg)
    # A few millikelvins in the long wave, less than two plans may differ by.
    found = tr.Renderer(scene).parts_at(pose, [[256, 320]])[0].radiance["sun"]
    slope = scene.materials[0].rms_slope
    assert 0.1 < slope < 0.3
    random, towards = np.random.default_rng(5), sun.direction(elevation_deg, 0.0)
    seen = -pose[:3, 2]
    half = towards + seen
    half /= np.linalg.norm(half)
    # Slopes around those that reflect the sun to the camera, weighed by their density in the plane; light that meets a
    # facet is by the area that it shows to the sun.
    slopes = -half[:2] / half[2] + random.uniform(-_AROUND, _AROUND, (1_000_000, 2))
    density = np.exp(-(slopes**2).sum(axis=1) / slope**2) / (np.pi * slope**2)
    normal = np.column_stack([-slopes, np.ones(len(slopes))])
    met = density * (2.0 * _AROUND) ** 2 * (normal @ towards)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    incidence = normal @ towards
    reflected = 2.0 * incidence[:, None] * normal - towards
    near = (reflected @ seen > np.cos(0.012)) & (met > 0.0)
    assert np.abs(slopes[near] + half[:2] / half[2]).max() < 0.9 * _AROUND
    # Irradiance of the level plane in the cone, over its solid angle and the cosine of the view.
    share = met[near].sum() / len(slopes) / (2.0 * np.pi * (1.0 - np.cos(0.012))) / seen[2]
    error = 1.0 / np.sqrt(near.sum())
    disc = image_of_the_sun(scene, elevation_deg, 100.0, seen[2], float(half @ towards))
    wanted = disc * sun.SOLID_ANGLE_SR * share
    # The cone's width, and facets that hide one another: 1 % in these views.
    assert near.sum() > 10_000 and found == pytest.approx(wanted, rel=0.01 + 3.0 * error)


def test_a_roof_shades_the_image_of_the_sun(tmp_path):
    # Between the water at the middle of the view and the sun in the north, 20 m up.
    roof = scene_object("roof", [60, 20, 0.2], [0, 101.0, 20.0], 290.0)
    shaded, _ = water(tmp_path / "shaded", "water_breeze", 45.0, roof)
    free, _ = water(tmp_path / "free", "water_breeze", 45.0)
    pose = tr.pose(0, 0, 100.0, yaw_deg=0.0, pitch_deg=-50.0)
    # The water 84 m ahead, whose light would come through the roof.
    one, other = shaded(pose), free(pose)
    assert other[256, 320] > 0.0 and abs(one[256, 320]) < 0.02 * other[256, 320]
    assert one[500, 10] == pytest.approx(other[500, 10], rel=0.05)


def test_the_sun_adds_to_the_part_of_the_sun(tmp_path):
    more, scene = water(tmp_path, "water_breeze", 50.0)
    pose = tr.pose(0, 0, 100.0, yaw_deg=0.0, pitch_deg=-50.0)
    found = tr.Renderer(scene).parts_at(pose, [[256, 320]])[0]
    assert float(found.radiance["sun"]) == pytest.approx(float(more(pose)[256, 320]), rel=0.02)


def test_a_plan_leaves_a_mirror_out_only_where_it_and_the_sun_in_it_do_not_matter(tmp_path):
    _, scene = water(tmp_path, "water_breeze", 50.0)
    lit, dark = make_plan(scene), make_plan(replace_sun(scene))
    assert lit.specular is not None and lit.specular.glint is not None and lit.sun
    assert dark.specular is None or dark.specular.glint is None


def replace_sun(scene):
    """The scene without its sun."""
    return tr.load_scene(scene.spec.folder.parent / "dark")


def test_pixels_wider_than_the_disc_show_all_of_its_light(tmp_path):
    """Pixels of 0.75°: light over the image against the disc's, in views that shift it by parts of a pixel."""
    wide = replace(load_camera("ideal"), width=64, height=48, focal_length_mm=1.3, pixel_pitch_um=17.0)
    more, scene = water(tmp_path, "water_fresnel", 40.0, camera=wide)
    sine, pixel = np.sin(np.radians(40.0)), 1.0 / wide.focal_length_px
    wanted = image_of_the_sun(scene, 40.0, 100.0, sine, sine) * sun.SOLID_ANGLE_SR
    for turn in (0.0, 0.2, 0.35, 0.5):
        image = more(tr.pose(0, 0, 100.0, yaw_deg=turn, pitch_deg=-40.0 + 0.7 * turn))
        assert 0.5 * wanted < image.sum() * pixel**2 < 1.6 * wanted, turn


@pytest.mark.parametrize("tolerance_mk", [5.0, 1000.0])
def test_a_loose_tolerance_keeps_the_image_of_the_sun(tmp_path, tolerance_mk):
    _, scene = water(tmp_path, "water_fresnel", 40.0)
    frame = tr.Renderer(scene, tolerance_mk=tolerance_mk).frame(tr.pose(0, 0, 100.0, yaw_deg=0.0, pitch_deg=-40.0))
    assert frame.apparent_temperature.max() > 400.0


@pytest.mark.parametrize("camera", ["zenmuse-xt2", "neutrino-lc"])
def test_haze_and_a_low_sun_leave_channels_that_show_it(tmp_path, camera):
    hazy = AIR.replace("midlatitude-summer", "tropical") + 'aerosol = "urban-5km"\n'
    more, scene = water(tmp_path, "water_fresnel", 12.0, camera=camera, air=hazy)
    image = more(tr.pose(0, 0, 20.0, yaw_deg=0.0, pitch_deg=-12.0))
    sine = np.sin(np.radians(12.0))
    assert image.max() == pytest.approx(image_of_the_sun(scene, 12.0, 20.0, sine, sine), rel=0.04)


def test_masking_leaves_facets_as_large_as_the_surface_looks():
    """Smith's masking from the areas of facets that face a direction: their sum over 1 + Λ is the surface's, cos θ."""
    mi = activate()
    slope, limit = 0.2, np.linspace(-1.5, 1.5, 600_001)
    density = np.exp(-((limit / slope) ** 2)) / (np.sqrt(np.pi) * slope)
    angles = np.radians([30.0, 70.0, 80.0, 85.0, 88.0])
    wanted = [np.trapezoid(np.maximum(np.cos(a) - limit * np.sin(a), 0.0) * density, limit) / np.cos(a) - 1.0
              for a in angles]  # fmt: skip
    found = np.array(_masking(mi.Float(np.cos(angles).astype(np.float32)), mi.Float(slope**2)))
    assert wanted[-1] > 0.9 and found == pytest.approx(wanted, rel=2e-3, abs=1e-5)
