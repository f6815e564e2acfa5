"""Geodetic coordinates against PROJ, and the Earth's curvature."""

import json
from types import SimpleNamespace

import numpy as np
import pytest
from rasterio.crs import CRS
from rasterio.warp import transform

from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame, ecef_from_geodetic, geodetic_from_ecef
from thermorender.scene.georeference import definition, pose_from_map


def test_ecef_against_proj():
    rng = np.random.default_rng(0)
    lat, lon, h = rng.uniform(-89, 89, 200), rng.uniform(-180, 180, 200), rng.uniform(-500, 30000, 200)
    x, y, z = transform(CRS.from_epsg(4979), CRS.from_epsg(4978), lon, lat, h)
    np.testing.assert_allclose(ecef_from_geodetic(lat, lon, h), np.stack([x, y, z], -1), atol=1e-7)
    back = geodetic_from_ecef(np.stack([x, y, z], -1))
    np.testing.assert_allclose(back[0], lat, atol=1e-11)
    np.testing.assert_allclose(back[1], lon, atol=1e-11)
    np.testing.assert_allclose(back[2], h, atol=1e-7)


def test_round_trip_and_curvature():
    frame = LocalFrame(45.0, 7.0, 300.0)
    spot = np.array([[1234.5, -987.0, 65.0], [80e3, 60e3, -500.0]])
    np.testing.assert_allclose(frame.enu_from_geodetic(*frame.geodetic_from_enu(spot)), spot, atol=1e-6)
    lat, lon, _ = frame.geodetic_from_enu(np.array([0.0, 100e3, 0.0]))
    assert frame.enu_from_geodetic(lat, lon, 300.0)[2] == pytest.approx(-785.0, abs=2.0)


def test_map_pose_is_rotated_by_the_grid_convergence():
    utm = CRS.from_epsg(32651)
    (x,), (y,) = transform(CRS.from_epsg(4326), utm, [120.95], [24.68])
    pose = np.eye(4)
    pose[:3, 3] = [x, y, 50.0]
    local = pose_from_map(LocalFrame(24.68, 120.95, 0.0), utm, pose)
    # Convergence of a spherical transverse Mercator grid: atan(tan(λ − λ₀) sin φ); the ellipsoid adds some 1e-7.
    convergence = np.arctan(np.tan(np.radians(120.95 - 123.0)) * np.sin(np.radians(24.68)))
    grid_north = local[:3, 1]
    # West of the central meridian grid north points west of true north.
    assert np.arctan2(grid_north[0], grid_north[1]) == pytest.approx(convergence, abs=1e-6)
    np.testing.assert_allclose(local[:3, 3], [0.0, 0.0, 50.0], atol=1e-3)


def test_a_coordinate_system_without_a_readable_definition_is_refused():
    # As of a damaged WKT, of which PROJ writes a code without quotes.
    crs = SimpleNamespace(to_dict=lambda projjson: json.loads('{"code": EPSG}'), to_string=lambda: "PROJCS[…]")
    with pytest.raises(ThermorenderError, match=r"coordinate system 'PROJCS.* is malformed; give the file one by its"):
        definition(crs)
