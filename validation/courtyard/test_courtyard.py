"""The study of a courtyard's walls: light on sensors in closed cases, and its table of weather."""

import numpy as np
import pytest

import thermorender as tr
from scenes import write_raster
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.errors import ThermorenderError
from thermorender.physics.planck import STEFAN_BOLTZMANN
from thermorender.render.geometry import Geometry
from thermorender.render.variant import activate
from thermorender.scene import open_ground
from validation.courtyard import study


@pytest.fixture(scope="module")
def yard(tmp_path_factory):
    """(Geometry, Scene) of a block of 30 m, 8 m high, around a courtyard of 10 m, all at 290 K."""
    folder = tmp_path_factory.mktemp("yard")
    column, row = np.meshgrid(*(np.arange(48) + 0.5 - 24.0,) * 2)
    away = np.maximum(np.abs(column), np.abs(row))
    height = np.where((away < 15.0) & (away > 5.0), 28.0, 20.0)
    write_raster(folder / "dsm.tif", height[None].astype(np.float32))
    write_raster(folder / "classes.tif", (height[None] > 25.0).astype(np.uint8))
    import_terrain(folder / "dsm.tif", None, folder / "s", ImportSettings(known=folder / "classes.tif"),
                   ThreeD(building_class=1))  # fmt: skip
    scene = tr.load_scene(folder / "s").with_temperature(290.0)
    return Geometry(activate(), scene.surfaces), scene


def test_a_courtyard_of_the_temperature_of_its_sky_is_black(yard):
    geometry, scene = yard
    black = STEFAN_BOLTZMANN * 290.0**4
    for axis in study.SENSORS.values():
        found = study.arriving(geometry, [scene], np.array([0.0, 0.0, 1.1]), np.array(axis, float), [black], 1024)
        assert found["total"] == pytest.approx([black], rel=1e-5)
        assert sum(found["shares"].values()) == pytest.approx(1.0)


def test_the_view_of_a_sensor_is_that_of_closed_forms(yard):
    """From the middle of the ground, 1.1 m up: the sky is the opening, 6.9 m above, of 10 m a side.

    Share of a rectangle a × b with a corner over a level element, at height c (Howell, view factor B-3):
    1/2π [A/√(1+A²) atan(B/√(1+A²)) + B/√(1+B²) atan(A/√(1+B²))], A = a/c, B = b/c; four of them.
    """
    geometry, scene = yard
    up = study.arriving(geometry, [scene], np.array([0.0, 0.0, 1.1]), np.array([0.0, 0.0, 1.0]), [0.0], 16384)
    a = 5.0 / 6.9
    expected = 4.0 / (2.0 * np.pi) * 2.0 * a / np.sqrt(1.0 + a * a) * np.arctan(a / np.sqrt(1.0 + a * a))
    assert up["shares"]["sky"] == pytest.approx(expected, abs=0.01)
    assert up["shares"]["walls"] + up["shares"]["roofs"] == pytest.approx(1.0 - expected, abs=0.01)
    # Walls before a black sky: what they emit, and reflections of it among them.
    emits = min(open_ground.broadband(m) for m in scene.materials)
    assert emits * STEFAN_BOLTZMANN * 290.0**4 < up["walls"][0] < STEFAN_BOLTZMANN * 290.0**4


def test_a_folder_without_the_site_is_refused(tmp_path):
    with pytest.raises(ThermorenderError, match=r"lacks DSM_KR\.tif, .* give the folder kronenhuset"):
        study.run(tmp_path)
