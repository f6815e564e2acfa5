"""Terrain and meshes: posts at pixel centres, maps the right way up, faces that look up, holes."""

from types import SimpleNamespace

import numpy as np
import pytest
import rasterio
import trimesh
from rasterio.crs import CRS

from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene import terrain
from thermorender.scene.ground import Ground
from thermorender.scene.load import load_scene
from thermorender.scene.meshes.mesh import load, primitive
from thermorender.scene.raster import Grid
from thermorender.scene.surface import FILLED, fill, nearest_valid

UTM = CRS.from_epsg(32634)
# On the central meridian, where the grid's north is true north.
LEFT, TOP = 499990.0, 5780010.0
NORTH_UP = Grid(UTM, rasterio.Affine(2.0, 0.0, LEFT, 0.0, -2.0, TOP), 10, 10)
SOUTH_UP = Grid(UTM, rasterio.Affine(2.0, 0.0, LEFT, 0.0, 2.0, TOP - 20.0), 10, 10)
TEXELS = Grid(UTM, rasterio.Affine(0.5, 0.0, LEFT, 0.0, -0.5, TOP), 40, 40)
HEIGHT = np.full((10, 10), 100.0)


def normals(vertices, faces):
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def part(tmp_path, mesh, suffix):
    path = tmp_path / f"model.{suffix}"
    path.write_bytes(mesh.export(file_type=suffix))
    return load(path)[0]


def test_posts_are_at_pixel_centres():
    frame = terrain.frame_of(HEIGHT, NORTH_UP)
    vertices, _, _ = terrain.mesh(HEIGHT, NORTH_UP, frame, TEXELS)
    # The map's scale on its central meridian is 0.9996.
    np.testing.assert_allclose(vertices[0], [-9.0 / 0.9996, 9.0 / 0.9996, 0.0], atol=2e-3)
    np.testing.assert_allclose(vertices[-1], [9.0 / 0.9996, -9.0 / 0.9996, 0.0], atol=2e-3)


@pytest.mark.parametrize("grid", [NORTH_UP, SOUTH_UP])
def test_faces_point_up_and_map_to_their_texels(grid):
    frame = terrain.frame_of(HEIGHT, grid)
    vertices, faces, uv = terrain.mesh(HEIGHT, grid, frame, TEXELS)
    assert (normals(vertices, faces)[:, 2] > 0.0).all()
    # u runs east and v south over the 20 m of the texel map.
    position = vertices[faces][..., :2] * 0.9996
    np.testing.assert_allclose(uv, np.stack([0.5 + position[..., 0] / 20, 0.5 - position[..., 1] / 20], -1), atol=1e-4)


@pytest.mark.parametrize("post", [(3, 3), (3, 4), (4, 3), (4, 4)])
def test_a_missing_post_removes_its_four_cells(post):
    height = HEIGHT.copy()
    height[post] = np.nan
    _, faces, _ = terrain.mesh(height, NORTH_UP, LocalFrame(52.0, 21.0, 100.0), TEXELS)
    assert len(faces) == 2 * (81 - 4) and np.isfinite(height.ravel()[faces]).all()


def test_a_missing_post_is_not_lower_than_the_others():
    """It is in no face, but the air is computed for all heights between the scene's corners."""
    height = HEIGHT + 2000.0
    height[3, 3] = np.nan
    vertices, _, _ = terrain.mesh(height, NORTH_UP, LocalFrame(52.0, 21.0, 2100.0), TEXELS)
    assert np.ptp(vertices[:, 2]) < 0.1


def test_heights_follow_the_unit_of_band_and_vertical_crs(tmp_path):
    path = tmp_path / "dem.tif"
    us_foot = 1200.0 / 3937.0
    for crs, unit, expected in (
        ("EPSG:32634", "ft", 0.3048), ("EPSG:32634", "US survey foot", us_foot), ("EPSG:32634", "m", 1.0),
        ("EPSG:32634", None, 1.0), ("EPSG:32618+6360", None, us_foot), ("EPSG:2263+5703", None, 1.0),
        ("EPSG:2263", "ft", 0.3048), ("EPSG:4979", None, 1.0),
        ("EPSG:2263", None, "its map is in US survey foot"), ("EPSG:32618+5703", "ft", "contradicts itself"),
        ("EPSG:32634", "fathom", "heights in 'fathom'"), ("EPSG:32618+5715", None, "holds depths"),
    ):  # fmt: skip
        corner = (20.0, 50.0) if crs == "EPSG:4979" else (LEFT, TOP)
        transform = rasterio.Affine(1e-5 if corner[0] < 99.0 else 2.0, 0.0, corner[0], 0.0, -1e-5, corner[1])
        with rasterio.open(
            path, "w", driver="GTiff", count=1, dtype="float32", height=4, width=4, crs=crs, transform=transform,
        ) as file:  # fmt: skip
            file.write(np.array([[1000.0, 1000.0, 1000.0, -9999.0]] * 4, np.float32)[None])
            if unit:
                file.units = (unit,)
        if isinstance(expected, str):
            with pytest.raises(ThermorenderError, match=expected):
                terrain.read_elevation(path)
            continue
        height = terrain.read_elevation(path)[0]
        np.testing.assert_allclose(height[:, :3], 1000.0 * expected, rtol=1e-9)
        assert np.isnan(height[:, 3]).all()


def test_a_raster_that_runs_west_is_imported_like_one_that_runs_east(tmp_path):
    height = np.arange(100.0, dtype=np.float32).reshape(1, 10, 10)
    west = rasterio.Affine(-2.0, 0.0, LEFT + 20.0, 0.0, -2.0, TOP)
    for name, values, transform in (("east", height, NORTH_UP.transform), ("west", height[:, :, ::-1], west)):
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", count=1, dtype="float32", height=10, width=10, crs=UTM,
            transform=transform,
        ) as file:  # fmt: skip
            file.write(values)
    with rasterio.open(
        tmp_path / "o.tif", "w", driver="GTiff", count=3, dtype="uint8", height=40, width=40, crs=UTM,
        transform=TEXELS.transform,
    ) as file:  # fmt: skip
        file.write(np.full((3, 40, 40), 90, np.uint8))
    found = []
    for name in ("east", "west"):
        import_terrain(tmp_path / f"{name}.tif", tmp_path / "o.tif", tmp_path / name)
        found.append(terrain.read_elevation(tmp_path / name / "elevation.tif")[0])
    np.testing.assert_allclose(found[1], found[0], atol=1e-3)


@pytest.mark.parametrize("degrees", [20, 45, 160])
def test_rotated_rasters_are_imported_whole(tmp_path, degrees):
    """The outermost corners are not the first and the last, and the rectangle around the raster is larger than it."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    for name, bands, scale in (("e", np.full((1, 64, 64), 50, np.float32), 1.0),
                               ("o", np.full((3, 128, 128), 90, np.uint8), 0.5)):  # fmt: skip
        transform = rasterio.Affine(scale * c, scale * s, LEFT, scale * s, -scale * c, TOP)
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", count=len(bands), dtype=bands.dtype, height=bands.shape[1],
            width=bands.shape[2], crs=UTM, transform=transform,
        ) as file:  # fmt: skip
            file.write(bands)
    report = import_terrain(tmp_path / "e.tif", tmp_path / "o.tif", tmp_path / "s")
    assert report["post_m"] == pytest.approx(1.0) and report["texel_m"] == pytest.approx(0.5)
    # 4096 posts, minus those at the rim.
    assert (1.0 - report["share_without_height"]) * np.prod(report["posts"]) == pytest.approx(4096.0, rel=0.05)
    across, along = np.array([0, c, s, c + s]), np.array([0, s, -c, s - c])
    bounds = terrain.read_elevation(tmp_path / "e.tif")[1].bounds
    assert bounds[::2] == pytest.approx((LEFT + 64 * across.min(), LEFT + 64 * across.max()))
    assert bounds[1::2] == pytest.approx((TOP + 64 * along.min(), TOP + 64 * along.max()))


def test_import_fills_islands_but_not_edges(tmp_path, call):
    """A slope continues through an island; a gap at the edge stays a hole; texels of filled cells are flagged."""
    row, column = np.mgrid[:10, :10]
    height = 100.0 + 0.5 * column - 0.25 * row
    shown = height.copy()
    shown[4:7, 3:6] = shown[:3, 8:] = np.nan
    for name, bands, grid in (("e", shown[None].astype(np.float32), NORTH_UP), ("o", np.full((3, 40, 40), 90), TEXELS)):
        kind = "float32" if name == "e" else "uint8"
        with rasterio.open(
            tmp_path / f"{name}.tif", "w", driver="GTiff", count=len(bands), dtype=kind, height=grid.height,
            width=grid.width, crs=UTM, transform=grid.transform,
        ) as file:  # fmt: skip
            file.write(bands.astype(kind))
    status, output, _ = call("import-terrain", tmp_path / "e.tif", tmp_path / "o.tif", "--fill", "-o", tmp_path / "s")
    assert status == 0 and "6.0% without height, 9.0% filled" in output
    found, made = terrain.filled(terrain.read_elevation(tmp_path / "s" / "elevation.tif")[0])
    np.testing.assert_allclose(found, np.where(np.isnan(shown) & (column > 7), np.nan, height), atol=1e-5)
    assert made[3:8, 2:7].all() and made.sum() == 25
    scene = load_scene(tmp_path / "s")
    flagged = (scene.surfaces[0].flags & FILLED) > 0
    assert flagged[12:32, 8:28].all() and flagged.sum() == 400
    assert np.isfinite(scene.ground(-1.0, -1.0)) and np.isnan(scene.ground(8.5, 8.5))


@pytest.mark.parametrize(
    ("keywords", "words"),
    [
        ({"height_reference": "sea"}, "height_reference='sea' is not allowed; give ellipsoid or geoid"),
        ({"material": "granit"}, "granit"),
        # Measured over 3.2–12.5 µm, which scenes accept: the next fault is named.
        ({"material": "aluminium_sheet"}, r"none\.tif does not exist"),
    ],
)
def test_import_refuses_scenes_that_could_not_be_loaded(tmp_path, keywords, words):
    with pytest.raises(ThermorenderError, match=words):
        import_terrain(tmp_path / "none.tif", tmp_path / "none.tif", tmp_path / "s", ImportSettings(**keywords))


def test_undeclared_placeholders_are_not_heights(tmp_path):
    height = np.full((1, 4, 4), 50.0, np.float32)
    height[0, 0] = -9999.0, 3.4e38, np.nan, 8848.0
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", count=1, dtype="float32", height=4, width=4, crs=UTM,
        transform=NORTH_UP.transform,
    ) as file:  # fmt: skip
        file.write(height)
    found, _ = terrain.read_elevation(tmp_path / "dem.tif")
    assert np.isnan(found[0, :3]).all() and found[0, 3] == 8848.0 and (found[1:] == 50.0).all()
    with pytest.raises(ThermorenderError, match="no cell with four valid posts"):
        terrain.mesh(np.where(np.eye(10) > 0, np.nan, np.nan), NORTH_UP, LocalFrame(52.0, 21.0, 0.0), TEXELS)


def test_side_of_a_texel():
    frame = terrain.frame_of(HEIGHT, NORTH_UP)
    assert terrain.texel_size_m(TEXELS, frame) == pytest.approx(0.5 / 0.9996, rel=1e-4)


def test_primitives_fill_their_size_on_their_base():
    for shape, size, low, high in (
        ("disc", (2.0, 2.0, 1.0), (-1, -1, 0), (1, 1, 0)),
        ("box", (1.0, 2.0, 3.0), (-0.5, -1, 0), (0.5, 1, 3)),
        ("sphere", (1.0, 2.0, 3.0), (-0.5, -1, 0), (0.5, 1, 3)),
    ):
        vertices, faces = primitive(shape, size)
        np.testing.assert_allclose(vertices.min(axis=0), low, atol=0.01 * max(size), err_msg=shape)
        np.testing.assert_allclose(vertices.max(axis=0), high, atol=0.01 * max(size), err_msg=shape)
        outward = vertices[faces].mean(axis=1) - [0, 0, high[2] / 2 if high[2] else -1]
        assert (np.einsum("ij,ij->i", normals(vertices, faces), outward) > 0.0).all(), shape


def test_glb_is_turned_from_y_up_and_its_image_is_the_right_way_up(tmp_path):
    from PIL import Image

    corners = [[0, 0, 0], [4, 0, 0], [4, 3, 0]]
    image = Image.new("RGB", (4, 4))
    image.putpixel((0, 3), (255, 0, 0))
    square = trimesh.Trimesh(corners, [[0, 1, 2]], process=False)
    # Lower left corner of the image at the first corner: trimesh's v points up.
    square.visual = trimesh.visual.TextureVisuals(
        uv=np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9]]),
        material=trimesh.visual.material.PBRMaterial(name="p", baseColorTexture=image),
    )
    found = part(tmp_path, square, "glb")
    np.testing.assert_allclose(found.vertices[found.faces[0]], [[0, 0, 0], [4, 0, 0], [4, 0, 3]], atol=1e-6)
    column, row = np.floor(found.uv[0, 0] * 4).astype(int)
    assert found.colour[row, column].tolist() == [255, 0, 0]


@pytest.mark.parametrize("suffix", ["obj", "ply", "glb"])
@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_corner_that_is_not_finite_is_refused_in_each_form(tmp_path, suffix, value):
    """If it were left out, its faces would be missing."""
    corners = np.array([[-5.0, 5, 0], [5, 5, 0], [5, -5, 0], [-5, -5, 0]])
    corners[0, 0] = value
    data = trimesh.Trimesh(corners, [[0, 3, 1], [1, 3, 2]], process=False).export(file_type=suffix)
    path = tmp_path / f"model.{suffix}"
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    with pytest.raises(ThermorenderError, match="has a vertex that is not finite"):
        load(path)


def test_a_mirrored_part_still_faces_outward(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(trimesh.creation.box(), transform=np.diag([-1.0, 1.0, 1.0, 1.0]))
    found = part(tmp_path, scene, "glb")
    outward = found.vertices[found.faces].mean(axis=1)
    assert (np.einsum("ij,ij->i", normals(found.vertices, found.faces), outward) > 0.0).all()


def test_ground_of_a_mesh_with_vertical_walls():
    box = trimesh.creation.box(extents=(4.0, 4.0, 2.0))
    surface = SimpleNamespace(vertices=np.array(box.vertices), faces=np.array(box.faces, dtype=np.int32))
    # Top of the box, above its wall, and beside it; warnings are errors.
    np.testing.assert_allclose(Ground((surface,))(np.array([0.5, 2.0, 9.0]), np.zeros(3)), [1.0, 1.0, np.nan])


def test_holes_take_the_nearest_known_texel():
    rng = np.random.default_rng(0)
    valid = rng.random((17, 23)) < 0.1
    known, position = np.argwhere(valid), np.argwhere(np.ones_like(valid))
    found = np.column_stack(np.unravel_index(nearest_valid(valid).ravel(), valid.shape))
    assert valid[tuple(found.T)].all()
    least = np.linalg.norm(position[:, None] - known, axis=-1).min(axis=1)
    np.testing.assert_allclose(np.linalg.norm(position - found, axis=1), least)
    colour = rng.integers(0, 255, (17, 23, 3))
    np.testing.assert_array_equal(fill(colour, nearest_valid(valid)).reshape(-1, 3), colour[tuple(found.T)])
