"""Point clouds in LAS and LAZ: surface, ground and buildings, and what their headers declare."""

import struct

import laspy
import numpy as np
import pytest
from rasterio.crs import CRS

import thermorender as tr
from thermorender.apps.lands.import_settings import ThreeD
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.lands.solids import clouds
from thermorender.apps.lands.solids.clouds import read_cloud
from thermorender.errors import ThermorenderError

LEFT, BOTTOM, SIDE = 500000.0, 5780000.0, 40.0


def written(path, wkt="EPSG:32634", scale=0.001, format_=6, metre=1.0, dense=4.0, extra=()):
    """Write ground at 20 m, a house of 14 by 10 m and 6 m high in its middle; `metre` is in units of the file.

    `extra` are further points (x, y, z, class, withheld).
    """
    random = np.random.default_rng(1)
    x, y = random.uniform(0.0, SIDE, (2, int(dense * SIDE**2)))
    x[:4], y[:4] = (0.0, 0.0, SIDE, SIDE), (0.0, SIDE, 0.0, SIDE)
    house = (np.abs(x - 20.0) < 7.0) & (np.abs(y - 20.0) < 5.0)
    rows = np.column_stack([x, y, np.where(house, 26.0, 20.0), np.where(house, 6, 2), 0 * x])
    rows = np.concatenate([rows, np.reshape(extra, (-1, 5))])
    header = laspy.LasHeader(point_format=format_, version="1.4" if format_ > 5 else "1.2")
    header.scales, header.offsets = [scale] * 3, [LEFT * metre, BOTTOM * metre, 0.0]
    if wkt:
        header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(CRS.from_user_input(wkt).to_wkt()))
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = ((rows[:, k] + start) * metre for k, start in ((0, LEFT), (1, BOTTOM), (2, 0.0)))
    cloud.classification, cloud.withheld = rows[:, 3].astype(np.uint8), rows[:, 4].astype(bool)
    cloud.write(str(path))
    return path


@pytest.mark.parametrize("name", ["c.las", "c.laz"])
def test_a_cloud_is_a_scene_with_the_house_of_its_classes(tmp_path, name):
    """A withheld bird and noise of class 7 are left out; the ground is that of class 2, also below the house."""
    extra = [(10, 10, 90, 1, 1), (12, 30, -50, 7, 0)]
    cloud = read_cloud(written(tmp_path / name, extra=extra))
    assert np.nanmax(cloud.surface) == pytest.approx(26.0) and np.nanmin(cloud.surface) == pytest.approx(20.0)
    assert np.isfinite(cloud.surface).mean() > 0.999
    assert cloud.notes == (f"{name}: 1 points left out, withheld", f"{name}: 1 points left out, noise")
    assert cloud.building.mean() == pytest.approx(140.0 / SIDE**2, rel=0.1)
    made = import_terrain(tmp_path / name, None, tmp_path / "s", three_d=ThreeD())
    assert made["buildings"] == 1 and made["trees"] == 0 and made["known"][:2] == cloud.notes
    scene = tr.load_scene(tmp_path / "s")
    roof = next(surface for surface in scene.surfaces if surface.name.endswith("roofs"))
    ground = next(surface for surface in scene.surfaces if surface.name.endswith("ground"))
    assert roof.vertices[:, 2] + scene.frame.height_m == pytest.approx(26.0, abs=0.02)
    assert ground.vertices[:, 2] + scene.frame.height_m == pytest.approx(20.0, abs=0.02)


def test_feet_are_read_where_the_crs_declares_them_and_refused_where_it_does_not(tmp_path):
    """EPSG:2263 is in US survey feet; with NAVD88 in the same feet, EPSG:6360, heights are known."""
    feet = 3937.0 / 1200.0
    with pytest.raises(
        ThermorenderError, match="does not declare the unit of its heights, and its map is in US survey"
    ):
        read_cloud(written(tmp_path / "h.las", "EPSG:2263", metre=feet))
    cloud = read_cloud(written(tmp_path / "v.las", "EPSG:2263+6360", metre=feet))
    assert np.nanmax(cloud.surface) == pytest.approx(26.0, abs=0.001)
    step = cloud.grid.transform.a * 1200.0 / 3937.0
    assert 0.1 <= step <= 1.0 and cloud.grid.width * step == pytest.approx(SIDE, abs=step)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"wkt": ""}, "declares no CRS by an EPSG number or WKT; state it with `pdal translate"),
        ({"wkt": "EPSG:4326"}, "not on a map; project it"),
        ({"dense": 0.01, "extra": ()}, r"has no usable point \(left out: 16 withheld\)"),
    ],
)
def test_wrong_clouds(tmp_path, change, words):
    path = written(tmp_path / "c.las", **change)
    if "dense" in change:
        cloud = laspy.read(str(path))
        cloud.withheld = np.ones(len(cloud.points), bool)
        cloud.write(str(path))
    with pytest.raises(ThermorenderError, match=words):
        read_cloud(path)


def test_a_damaged_cloud_is_one_sentence(tmp_path):
    path = written(tmp_path / "c.laz")
    path.write_bytes(path.read_bytes()[:-5000])
    with pytest.raises(ThermorenderError, match=r"c\.laz cannot be read as a point cloud"):
        read_cloud(path)


def test_wires_and_bridges_are_neither_crowns_nor_houses(tmp_path):
    """Point formats from 6 on have classes for them; in earlier ones these numbers are reserved, and points stay."""
    over = [(x, 5, 35, 14, 0) for x in np.arange(2.0, 38.0, 0.2)] + [(x, 34, 28, 17, 0) for x in np.arange(2, 38, 0.2)]
    cloud = read_cloud(written(tmp_path / "c.las", extra=over))
    assert np.nanmax(cloud.surface) == pytest.approx(26.0)
    assert cloud.notes == ("c.las: 180 points left out, wires", "c.las: 180 points left out, bridges")
    made = import_terrain(tmp_path / "c.las", None, tmp_path / "s", three_d=ThreeD())
    assert (made["buildings"], made["trees"]) == (1, 0)
    old = read_cloud(written(tmp_path / "old.las", format_=3, extra=over))
    assert np.nanmax(old.surface) == pytest.approx(35.0) and old.notes == ()


@pytest.mark.parametrize(("up_m", "trees"), [(110.0, 1), (480.0, 0)])
def test_a_bird_higher_than_any_tree_is_no_tree(tmp_path, up_m, trees):
    """One return in the sky had a crown of 10 000 m² of leaves below it."""
    high = [(33 + x, 36 + y, 20 + up_m, 1, 0) for x in (0.0, 0.8, 1.6) for y in (0.0, 0.8, 1.6)]
    made = import_terrain(written(tmp_path / "c.las", extra=high), None, tmp_path / "s", three_d=ThreeD())
    assert (made["buildings"], made["trees"]) == (1, trees)
    words = ("1 peaks more than 120 m above the ground are not trees: left out",)
    assert made["known"] == (() if trees else words)


def test_a_crs_after_the_points_is_read(tmp_path):
    """LAS 1.4 has extended records after the points."""
    cloud = laspy.read(str(written(tmp_path / "c.las")))
    cloud.evlrs = laspy.vlrs.vlrlist.VLRList()
    cloud.evlrs.append(cloud.header.vlrs.pop(0))
    cloud.write(str(tmp_path / "e.las"))
    with laspy.open(str(tmp_path / "e.las")) as file:
        assert not file.header.vlrs
    assert read_cloud(tmp_path / "e.las").grid.crs == CRS.from_epsg(32634)


def keyed(path, keys, **options):
    """Write a cloud whose CRS is stated by GeoTIFF keys [(key, value), …]."""
    cloud = laspy.read(str(written(path, wkt="", format_=3, **options)))
    directory = laspy.vlrs.known.GeoKeyDirectoryVlr()
    numbers = [1, 1, 0, len(keys), *(v for key, value in sorted(keys) for v in (key, 0, 1, value))]
    directory.parse_record_data(np.array(numbers, "<u2").tobytes())
    cloud.header.vlrs.append(directory)
    cloud.write(str(path))


@pytest.mark.parametrize(("unit", "refused"), [(9001, False), (9003, True), (9002, True), (None, False)])
def test_keys_of_another_unit_than_the_maps_are_refused(tmp_path, unit, refused):
    keyed(tmp_path / "k.las", [(3072, 32634), (4099, 9001)] + ([(3076, unit)] if unit else []))
    if refused:
        with pytest.raises(ThermorenderError, match=r"contradicts itself: its map is in (us-)?ft by the key of units"):
            read_cloud(tmp_path / "k.las")
    else:
        assert np.nanmax(read_cloud(tmp_path / "k.las").surface) == pytest.approx(26.0)


def test_a_map_whose_unit_has_no_length_is_refused(tmp_path):
    path = written(tmp_path / "a.las")
    whole = path.read_bytes()
    assert whole.count(b'UNIT["metre",1') == 1
    path.write_bytes(whole.replace(b'UNIT["metre",1', b'UNIT["metre",0'))
    with pytest.raises(ThermorenderError, match="has a map whose unit is 0 m; state it with"):
        read_cloud(path)


@pytest.mark.parametrize(("map_", "level", "unit", "metre"), [
    (32634, 5103, 9001, 1.0), (2903, 5103, 9003, 3937.0 / 1200.0), (2903, 5102, 9003, 3937.0 / 1200.0),
    (32634, 5105, 9001, 1.0),
])  # fmt: skip
def test_vertical_codes_of_the_first_geotiff_have_the_unit_of_its_keys(tmp_path, map_, level, unit, metre):
    """5103 is NAVD 88 there, and no CRS of EPSG; the ridge of 26 m is 85.3 US survey feet high."""
    keyed(tmp_path / "k.las", [(3072, map_), (3076, unit), (4096, level), (4099, unit)], metre=metre)
    assert np.nanmax(read_cloud(tmp_path / "k.las").surface) == pytest.approx(26.0, abs=0.001)


@pytest.mark.parametrize("shift", [0.004, -0.004, 1e-9])
def test_bounds_of_a_header_may_be_rounded(tmp_path, shift):
    """A projected header keeps all digits of its bounds where points have steps of 10 mm."""
    path = written(tmp_path / "c.las", scale=0.01)
    expected = read_cloud(path)
    data = bytearray(path.read_bytes())
    for at in (179, 187, 195, 203):  # max x, min x, max y, min y
        (bound,) = struct.unpack_from("<d", data, at)
        struct.pack_into("<d", data, at, bound + shift)
    path.write_bytes(data)
    found = read_cloud(path)
    assert np.nanmax(found.surface) == pytest.approx(26.0) and np.nanmin(found.surface) == pytest.approx(20.0)
    assert found.building.mean() == pytest.approx(expected.building.mean(), abs=0.02)
    for at, bound in ((179, LEFT), (187, LEFT - 40.0)):
        struct.pack_into("<d", data, at, bound)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="has points outside of the bounds in its header"):
        read_cloud(path)


def test_a_few_stray_points_of_buildings_do_not_hide_the_house(tmp_path):
    """Many tiles have a handful of points of class 6; the roof became a crown."""
    cloud = laspy.read(str(written(tmp_path / "c.las")))
    kind = np.array(cloud.classification)
    kind[np.flatnonzero(kind == 6)[8:]] = 1
    cloud.classification = kind
    cloud.write(str(tmp_path / "s.las"))
    made = import_terrain(tmp_path / "s.las", None, tmp_path / "s", three_d=ThreeD())
    assert (made["buildings"], made["trees"]) == (1, 0)


def test_overlap_of_flight_lines_is_left_out(tmp_path):
    """Point formats up to 5 have a class for it, later ones a flag."""
    old = read_cloud(written(tmp_path / "old.las", format_=3, extra=[(5, 5, 40, 12, 0)]))
    path = written(tmp_path / "new.las", extra=[(5, 5, 40, 1, 0)])
    cloud = laspy.read(str(path))
    flag = np.zeros(len(cloud.points), bool)
    flag[-1] = True
    cloud.overlap = flag
    cloud.write(str(path))
    for found in (old, read_cloud(path)):
        assert np.nanmax(found.surface) == pytest.approx(26.0) and "overlap" in found.notes[0]


@pytest.mark.parametrize(("at", "form", "value"), [(100, "<I", 2**32 - 1), (107, "<I", 2**31), (247, "<Q", 10**12)])
def test_records_that_a_file_has_no_bytes_for_are_refused_before_they_are_read(tmp_path, at, form, value):
    """Variable length records, points and points of LAS 1.4; the library would read on for hours."""
    path = written(tmp_path / "a.las")
    data = bytearray(path.read_bytes())
    assert data[25] == 4
    struct.pack_into(form, data, at, value)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


def test_a_header_cut_short_is_refused_before_its_records_are_read(tmp_path):
    """249 bytes of LAS 1.4 state the number of extended records, and the library looks for each of them."""
    path = written(tmp_path / "a.las")
    data = bytearray(path.read_bytes()[:249])
    struct.pack_into("<I", data, 243, 2**32 - 1)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


@pytest.mark.parametrize("layer", range(9))
def test_layers_longer_than_their_chunk_are_refused(tmp_path, layer):
    """The decoder would reserve 4 GB for each."""
    path = written(tmp_path / "a.laz")
    data = bytearray(path.read_bytes())
    (points_at,) = struct.unpack_from("<I", data, 96)
    struct.pack_into("<I", data, points_at + 8 + 30 + 4 + 4 * layer, 0xF0000000)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


def test_a_chunk_of_more_points_than_memory_holds_is_refused(tmp_path):
    """The decoder would reserve 129 GB, and end the interpreter."""
    path = written(tmp_path / "a.laz")
    data = path.read_bytes()
    at = data.index(struct.pack("<H", 22204), 227) + 36 + 12
    assert struct.unpack_from("<I", data, at) == (50_000,)
    path.write_bytes(data[:at] + struct.pack("<I", 0xFFFFFF50) + data[at + 4 :])
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


@pytest.mark.parametrize("length", [1, 2**40, 2**63])
def test_extended_records_longer_than_their_file_are_refused(tmp_path, length):
    """The library would reserve the length that a record states."""
    path = written(tmp_path / "a.las")
    data = bytearray(path.read_bytes())
    struct.pack_into("<QI", data, 235, len(data), 1)
    path.write_bytes(data + struct.pack("<H16sHQ32s", 0, b"", 0, length, b""))
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


def test_compressed_points_without_a_record_of_their_chunks_are_refused(tmp_path):
    """Before rasters are made for the number of points in the header."""
    path = written(tmp_path / "a.laz")
    data = bytearray(path.read_bytes())
    struct.pack_into("<H", data, data.index(struct.pack("<H", 22204), 227), 22205)
    struct.pack_into("<Q", data, 247, 10**9)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="its points are compressed, but it has no LASzip record"):
        read_cloud(path)


@pytest.mark.parametrize("count", [60_000, 10**9])
def test_more_points_than_all_chunks_hold_are_refused(tmp_path, count):
    """Rasters of 10⁹ points would take 8 GB."""
    path = written(tmp_path / "a.laz")
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, 247, count)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


@pytest.mark.parametrize(("at", "value"), [(179, -1e308), (195, 0.0), (203, 1e30), (179, np.inf), (187, np.nan)])
def test_bounds_that_enclose_nothing_are_refused(tmp_path, at, value):
    """The largest and smallest x, and those of y, of the header."""
    path = written(tmp_path / "a.las")
    data = bytearray(path.read_bytes())
    struct.pack_into("<d", data, at, value)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="which enclose nothing; write it again"):
        read_cloud(path)


def test_compressed_points_of_another_size_than_the_headers_are_refused(tmp_path):
    """The library would reserve memory for bytes of each point that the compressed ones lack."""
    path = written(tmp_path / "a.laz")
    data = bytearray(path.read_bytes())
    (record,) = struct.unpack_from("<H", data, 105)
    struct.pack_into("<H", data, 105, record + 1024)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match=f"describes other points than those of {record + 1024} bytes"):
        read_cloud(path)


def test_points_too_few_for_a_surface_are_refused(tmp_path):
    path = written(tmp_path / "a.las")
    data = bytearray(path.read_bytes())
    # The largest x and y in the header.
    for at in (179, 195):
        (largest,) = struct.unpack_from("<d", data, at)
        struct.pack_into("<d", data, at, largest + 20_000.0)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match=r"has \d+ points on 20\d+×20\d+ posts of 1 m; they are too few"):
        read_cloud(path)


def test_a_table_of_chunks_longer_than_its_file_is_refused(tmp_path):
    """Its decoder would reserve memory for it, and end the interpreter."""
    path = written(tmp_path / "a.laz")
    data = bytearray(path.read_bytes())
    (points_at,) = struct.unpack_from("<I", data, 96)
    (table,) = struct.unpack_from("<q", data, points_at)
    struct.pack_into("<I", data, table + 4, 0xF0000000)
    path.write_bytes(data)
    with pytest.raises(ThermorenderError, match="counts more records than it has bytes for"):
        read_cloud(path)


def test_a_panic_of_the_decoder_is_a_sentence_and_an_interruption_stays(tmp_path):
    panic = type("PanicException", (BaseException,), {})
    with pytest.raises(ThermorenderError, match=r"cannot be read as a point cloud .PanicException: index"):
        with clouds._named(tmp_path / "a.laz"):
            raise panic("index out of bounds")
    with pytest.raises(KeyboardInterrupt), clouds._named(tmp_path / "a.laz"):
        raise KeyboardInterrupt
