"""Plants as tables of turbid bodies: leaf area, extent and colour of what was planted, and tables in a scene."""

import numpy as np
import pytest

import thermorender as tr
from scenes import scene_object, write_terrain
from thermorender.apps.lands.solids import plants as made
from thermorender.apps.lands.solids.plants import Plants, write_bodies, write_leaf_tables
from thermorender.formats import read_text
from thermorender.physics.srgb import linear_from_bytes
from thermorender.scene.crowns import COLUMNS

CELL_M = 0.2
GREEN = np.array([40, 90, 20], np.uint8)


def ball(radius_m, up_m):
    """Columns (C, 4) of a ball on a grid of CELL_M."""
    line = np.arange(-radius_m, radius_m, CELL_M) + 0.5 * CELL_M
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    half = np.sqrt(np.maximum(radius_m**2 - x**2 - y**2, 0.0))
    return np.column_stack([x, y, up_m - half, up_m + half])


def strip(length_m, width_m, height_m, heading_deg):
    """Columns (C, 4) of a hedge through the origin on a grid of CELL_M."""
    line = np.arange(-0.5 * length_m, 0.5 * length_m, CELL_M)
    x, y = (each.ravel() for each in np.meshgrid(line, line))
    along, across = turned(np.column_stack([x, y]), heading_deg)
    on = (np.abs(along) < 0.5 * length_m) & (np.abs(across) < 0.5 * width_m)
    return np.column_stack([x[on], y[on], np.zeros(on.sum()), np.full(on.sum(), height_m)])


def turned(place, heading_deg):
    """Positions (n, 2) along a heading and to the right of it, (n,) each."""
    angle = np.radians(heading_deg)
    return place @ [np.sin(angle), np.cos(angle)], place @ [np.cos(angle), -np.sin(angle)]


def table(plants, shape):
    """{column: (n,)} of the only bodies of a shape."""
    (bodies,) = (each for (kind, _), each in plants.bodies.items() if kind == shape)
    return dict(zip(made._COLUMNS, bodies.rows.T, strict=True))


def tops_and_sides(rows, count=2000):
    """Points (n, count, 3) on the surfaces of ellipsoids."""
    way = np.random.default_rng(0).standard_normal((count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    half = 0.5 * np.column_stack([rows[name] for name in ("width_m", "length_m", "height_m")])
    local, heading = way * half[:, None], np.radians(rows["yaw_deg"])[:, None]
    east = local[..., 0] * np.cos(heading) + local[..., 1] * np.sin(heading)
    north = local[..., 1] * np.cos(heading) - local[..., 0] * np.sin(heading)
    base = np.column_stack([rows["east_m"], rows["north_m"], rows["up_m"] + half[:, 2]])
    return np.stack([east, north, local[..., 2]], axis=-1) + base[:, None]


@pytest.mark.parametrize(("radius_m", "lobes"), [(1.0, 1), (2.0, 7), (3.5, 16)])
def test_a_crown_has_the_leaf_area_of_its_columns_and_stays_within_them(radius_m, lobes):
    plants = Plants()
    plants.crown(ball(radius_m, 6.0), CELL_M, 1.2, np.full(3, 0.2), "broadleaf")
    rows = table(plants, "sphere")
    assert len(rows["up_m"]) == lobes
    volume = np.pi / 6.0 * rows["width_m"] * rows["length_m"] * rows["height_m"]
    # Of a ball of 1.2 m² of leaves per cubic metre.
    assert rows["leaf_area_1_m"] @ volume == pytest.approx(1.2 * 4.0 / 3.0 * np.pi * radius_m**3, rel=0.03)
    away = np.linalg.norm(tops_and_sides(rows) - [0.0, 0.0, 6.0], axis=-1)
    assert 0.75 * radius_m < away.max() < 1.12 * radius_m
    # On all sides of the middle.
    reach = tops_and_sides(rows).reshape(-1, 3) - [0.0, 0.0, 6.0]
    assert np.abs(reach.max(axis=0) + reach.min(axis=0)).max() < 0.25 * radius_m


def test_lobes_of_a_forest_are_larger_where_they_would_be_too_many(monkeypatch):
    """Two crowns of 113 and 14 m³, which have 16 and 3 lobes, share 8 in proportion to their volume."""
    monkeypatch.setattr(made, "_MOST_LOBES", 8)
    plants = Plants()
    for radius_m, east in ((3.0, 0.0), (1.5, 20.0)):
        column = ball(radius_m, 6.0) + [east, 0.0, 0.0, 0.0]
        plants.crown(column, CELL_M, 1.2, np.full(3, 0.2), "broadleaf")
    near = table(plants, "sphere")["east_m"] < 10.0
    assert (near.sum(), (~near).sum()) == (7, 1)


def test_fewer_lobes_have_the_same_leaf_area(monkeypatch):
    area = []
    for most in (1, 16):
        monkeypatch.setattr(made, "_MOST_LOBES", most)
        plants = Plants()
        plants.crown(ball(3.0, 6.0), CELL_M, 1.2, np.full(3, 0.2), "broadleaf")
        rows = table(plants, "sphere")
        assert len(rows["up_m"]) == most
        area.append(rows["leaf_area_1_m"] @ (rows["width_m"] * rows["length_m"] * rows["height_m"]))
    assert area[0] == pytest.approx(area[1])


@pytest.mark.parametrize("heading_deg", [0.0, 30.0, 90.0, 140.0])
def test_boxes_of_a_hedge_tile_its_length_and_have_its_leaf_area(heading_deg):
    plants = Plants()
    column = strip(11.0, 1.2, 1.5, heading_deg)
    plants.hedge(column, CELL_M, 4.0, linear_from_bytes(GREEN), "broadleaf")
    rows = table(plants, "box")
    assert len(rows["up_m"]) == 4
    turn = (rows["yaw_deg"] - heading_deg + 90.0) % 180.0 - 90.0
    assert np.abs(turn).max() < 1.0
    along, across = turned(np.column_stack([rows["east_m"], rows["north_m"]]), heading_deg)
    assert np.abs(across).max() < 0.1
    order = np.argsort(along)
    start, end = (along[order] + sign * 0.5 * rows["length_m"][order] for sign in (-1.0, 1.0))
    # One begins where the other ends, to less than a cell.
    assert np.abs(start[1:] - end[:-1]).max() < 0.8 * CELL_M
    assert [start[0], end[-1]] == pytest.approx([-5.5, 5.5], abs=CELL_M)
    assert rows["width_m"] == pytest.approx(np.full(4, 1.2), abs=CELL_M)
    np.testing.assert_allclose([rows["up_m"], rows["height_m"]], [[0.0] * 4, [1.5] * 4])
    area = rows["leaf_area_1_m"] @ (rows["width_m"] * rows["length_m"] * rows["height_m"])
    assert area == pytest.approx(4.0 * 11.0 * 1.2 * 1.5, rel=0.08)
    np.testing.assert_array_equal(np.column_stack([rows[name] for name in ("red", "green", "blue")]), [GREEN] * 4)


def test_columns_without_leaves_make_no_plant():
    plants = Plants()
    empty = np.array([[0.0, 0.0, 2.0, 2.0], [0.2, 0.0, 2.0, 1.0]])
    plants.crown(empty, CELL_M, 1.2, np.full(3, 0.2), "broadleaf")
    plants.hedge(empty, CELL_M, 4.0, np.full(3, 0.2), "broadleaf")
    assert not plants.bodies and not write_bodies(None, plants.bodies)


def test_trunks_of_a_forest_have_fewer_parts():
    """Of 9000 trunks one length of four sides each: 36,000 parts, of 1 trunk 18."""
    many, one = Plants(), Plants()
    for number in range(9000):
        many.trunk(float(number), 0.0, 0.0, 8.0, 0.2, np.full(3, 0.2), 1)
    one.trunk(0.0, 0.0, 0.0, 8.0, 0.2, np.full(3, 0.2), 1)
    assert [len(each.mesh("trunk").faces) for each in (many, one)] == [9000 * 4 * 2, 18 * 2]


def test_a_trunk_has_a_texel_for_each_side_of_each_length():
    """A gap of the crown then lights a part of the trunk, not a whole side."""
    plants = Plants()
    plants.trunk(2.0, 3.0, 1.0, 8.0, 0.2, np.full(3, 0.2), 1)
    mesh = plants.mesh("trunk")
    corner = mesh.vertices[mesh.faces]
    assert np.ptp(corner[..., 2], axis=1).max() < 3.0
    place, index = np.unique(mesh.uv.mean(axis=1), axis=0, return_inverse=True)
    assert len(place) == 6 * 3 and (np.bincount(index.ravel()) == 2).all()
    assert all(len(np.unique(mesh.faces[index.ravel() == part])) == 4 for part in range(len(place)))
    across = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    # Sides of a hexagonal frustum whose radius goes from 0.2 to 0.07 m: trapezia of the two edges.
    height = np.hypot(7.0, (0.2 - 0.07) * np.cos(np.pi / 6.0))
    assert 0.5 * np.linalg.norm(across, axis=1).sum() == pytest.approx(6.0 * 0.5 * (0.2 + 0.07) * height)
    assert ((corner.mean(axis=1) - [2.0, 3.0, 4.5])[:, :2] * across[:, :2]).sum(axis=1).min() > 0.0


def written(folder, kelvin=None, **options):
    """Write a flat scene with a crown of several lobes and a hedge; return (folder, plants)."""
    folder.mkdir()
    plants = Plants()
    plants.crown(ball(2.0, 4.0) + [3.0, 2.0, 100.0, 100.0], CELL_M, 1.2, linear_from_bytes(GREEN), "conifer")
    plants.hedge(strip(6.0, 0.8, 1.5, 90.0) + [-4.0, -5.0, 100.0, 100.0], CELL_M, 4.0, np.full(3, 0.2), "broadleaf")
    if kelvin is not None:
        plants.bodies["sphere", "conifer"].kelvin = kelvin
    tables = write_bodies(folder, plants.bodies, down_m=100.0, **options)
    write_terrain(folder, extra="".join(scene_object(**each) for each in tables))
    return folder, plants


def test_tables_of_plants_are_read_as_they_were_planted(tmp_path):
    folder, plants = written(tmp_path / "s", temperature=291.5)
    scene = tr.load_scene(folder)
    crown, hedge = (
        next(s for s in scene.surfaces if s.name.startswith(name)) for name in ("conifer_crowns", "broadleaf_hedges")
    )
    for surface, shape in ((crown, "sphere"), (hedge, "box")):
        rows, body = table(plants, shape), surface.instances
        assert body.box == (shape == "box") and len(body) == len(rows["up_m"]) > 1
        place = np.column_stack([rows["east_m"], rows["north_m"], rows["up_m"] - 100.0 + 0.5 * rows["height_m"]])
        # Written to centimetres.
        np.testing.assert_allclose(body.middle, place, atol=0.011)
        size = np.column_stack([rows[name] for name in ("width_m", "length_m", "height_m")])
        np.testing.assert_allclose(2.0 * body.half, size, atol=0.006)
        np.testing.assert_allclose(body.density, rows["leaf_area_1_m"], rtol=1e-3)
        assert (surface.temperature == np.float32(291.5)).all()
    np.testing.assert_array_equal(
        crown.colour.reshape(-1, 3), np.broadcast_to(GREEN, crown.colour.reshape(-1, 3).shape)
    )
    assert [scene.materials[s.material.flat[0]].name for s in (crown, hedge)] == ["conifer", "broadleaf"]


def test_temperatures_of_leaves_come_back_from_their_table(tmp_path):
    mean = 290.0 + 0.25 * np.arange(28.0).reshape(7, 4)
    kelvin = np.concatenate([mean, mean + [2.0, 3.0, 2.5, 4.0]], axis=1)
    folder, _ = written(tmp_path / "s", kelvin, temperature=291.5)
    surface = next(s for s in tr.load_scene(folder).surfaces if s.name.startswith("conifer_crowns"))
    mean, more = (each.reshape(-1)[:56].reshape(7, 4, 2) for each in (surface.temperature, surface.scatter_k))
    # Of the quarters; both sides of a leaf are equally warm.
    for side in range(2):
        np.testing.assert_allclose(mean[:, :, side], kelvin[:, :4], atol=0.006)
        np.testing.assert_allclose(more[:, :, side], kelvin[:, 4:] - kelvin[:, :4], atol=0.011)


def test_tables_of_leaves_and_columns_of_plants_are_those_that_a_scene_reads(tmp_path):
    folder, _ = written(tmp_path / "s", temperature=291.5)
    header = read_text(folder / "plants" / "conifer_crowns.csv.gz").splitlines()[0].split(",")
    assert set(COLUMNS) <= set(header)
    write_leaf_tables(folder)
    assert sorted(path.stem for path in (folder / "materials" / "thermal").iterdir()) == ["broadleaf", "conifer"]
