"""Heights of rasters above the ellipsoid of their own datum, as heights above that of WGS 84."""

import numpy as np
import pytest
import rasterio
from rasterio import Affine
from rasterio.crs import CRS

from thermorender import load_scene
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.scene.georeference import datum_heights
from thermorender.scene.raster import Grid

# Bessel's ellipsoid, and its shift to WGS 84 in CH1903+ [m]; source: EPSG, transformation 1676.
BESSEL, FLATTENING, SHIFT = 6377397.155, 1.0 / 299.1528128, np.array([674.374, 15.056, 405.346])
WGS84, FLATTENING_WGS84 = 6378137.0, 1.0 / 298.257223563
PLACE = Affine(10.0, 0.0, 2507500.0, 0.0, -10.0, 1139300.0)


def ellipsoid_point(latitude, longitude, semi_major, flattening):
    """Earth-centred position of a point on an ellipsoid, (3,) [m]."""
    e2, sine = flattening * (2.0 - flattening), np.sin(latitude)
    radius = semi_major / np.sqrt(1.0 - e2 * sine**2)
    along = radius * np.cos(latitude)
    return np.array([along * np.cos(longitude), along * np.sin(longitude), radius * (1.0 - e2) * sine])


def test_bessels_ellipsoid_is_as_high_as_three_translations_have_it():
    grid = Grid(CRS.from_epsg(2056), PLACE, 20, 30)
    # The middle of the grid, on Bessel's ellipsoid; 1 m on the map is within 1e-7 rad here.
    latitude, longitude = np.radians(46.3988), np.radians(6.2372)
    point = ellipsoid_point(latitude, longitude, BESSEL, FLATTENING) + SHIFT
    normal = np.array([np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)])
    above = float((point - ellipsoid_point(latitude, longitude, WGS84, FLATTENING_WGS84)) @ normal)
    # Foot points differ by 130 m between the ellipsoids, which raise the point by less than their square over twice the
    # radius, 2 mm; the place is rounded to 10 m, which changes the height by 1 mm.
    assert datum_heights(grid)[10, 15] == pytest.approx(above, abs=0.02)
    assert 40.0 < above < 60.0


def test_datums_of_wgs84_have_exactly_no_difference():
    for code in (32651, 25833, 4326):
        transform = Affine(1e-4, 0.0, 13.0, 0.0, -1e-4, 52.0) if code == 4326 else PLACE
        assert not datum_heights(Grid(CRS.from_epsg(code), transform, 4, 6)).any()


def write_heights(path, crs, transform, level, shape=(24, 24)):
    with rasterio.open(path, "w", driver="GTiff", height=shape[0], width=shape[1], count=1, dtype="float32", crs=crs,
                       transform=transform) as file:  # fmt: skip
        file.write(np.full(shape, level, np.float32), 1)
    return path


def test_poses_and_terrain_of_one_map_have_heights_of_one_zero(tmp_path):
    elevation = write_heights(tmp_path / "dem.tif", "EPSG:2056", PLACE, 420.0)
    import_terrain(elevation, None, tmp_path / "field")
    scene = load_scene(tmp_path / "field")
    poses = tmp_path / "poses.txt"
    poses.write_text(
        f"# CoordinateSystem: {CRS.from_epsg(2056).to_wkt()}\n"
        "#Label,X_est,Y_est,Z_est,Yaw_est,Pitch_est,Roll_est\na.tif,2507620,1139180,460,10,0,0\n"
    )
    place = read_poses(poses)["a"]
    east, north, up = scene.frame.enu_from_geodetic(*place.horizontal, place.height_m)
    # Both are changed to WGS 84; the raster's change is interpolated over 240 m.
    assert up - scene.ground(east, north) == pytest.approx(40.0, abs=2e-3)
    assert scene.frame.height_m == pytest.approx(472.0, abs=1.0)


def test_geographic_heights_of_another_datum_are_changed_at_the_import(tmp_path):
    degrees = Affine(1e-4, 0.0, 6.23, 0.0, -1e-4, 46.40)
    for code, level in ((4150, 472.0), (4326, 420.0)):
        elevation = write_heights(tmp_path / f"{code}.tif", f"EPSG:{code}", degrees, 420.0)
        import_terrain(elevation, None, tmp_path / str(code))
        assert load_scene(tmp_path / str(code)).frame.height_m == pytest.approx(level, abs=1.0)
