"""Rasters of a point cloud in a LAS or LAZ file: the highest surface, and the ground and buildings of its classes."""

import os
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid, lon_lat
from thermorender.scene.surface import MOST_TEXELS, fill, nearest_valid
from thermorender.scene.terrain import METRES, metres_of_heights

SUFFIXES = (".las", ".laz")
# Classes of the ASPRS LAS specification 1.4, tables 9 and 17: noise low and high, ground, buildings, and overlap.
_NOISE, _GROUND, _BUILDING, _OVERLAP = (7, 18), 2, 6, 12
# Classes of point formats from 6 on, table 17: wires with their towers, bridges, and what hangs over the ground. Walls
# or crowns below them would be wrong.
_OVERHEAD = {"wires": (13, 14, 15, 16), "bridges": (17,), "overhead structures": (19,)}
# Points in a post on average, and limits of a post's side [m]; posts this near to a point get its height.
_IN_POST, _POST_M, _NEAR = 2.0, (0.1, 1.0), 2.0
_AT_ONCE = 2_000_000
# Most posts for each point, which are then ten posts apart, and posts that few points may have.
_SPARSE, _SMALL = 100, 1 << 22
# Most bytes of the points of a chunk of LAZ; usual ones have 50 000 points.
_CHUNK_BYTES = 1 << 30
# The record of LASzip.
_LASZIP = 22204
# GeoTIFF 1.1, requirement classes for keys: CRS of the map, geographic CRS, unit of the map, vertical CRS, and unit of
# heights.
_PROJECTED, _GEOGRAPHIC, _MAP_UNIT, _VERTICAL, _VERTICAL_UNIT = 3072, 2048, 3076, 4096, 4099
_OWN = 32767
_UNITS = {9001: "m", 9002: "ft", 9003: "us-ft"}
# Vertical codes of GeoTIFF 1.0 (section 6.3.4.2), which have no unit of their own, as EPSG codes by unit.
_OLD_VERTICAL = {
    (5101, "m"): 5701, (5102, "m"): 7968, (5102, "us-ft"): 5702, (5103, "m"): 5703, (5103, "ft"): 8228,
    (5103, "us-ft"): 6360, (5104, "m"): 5736, (5105, "m"): 5705, (5106, "m"): 5706,
}  # fmt: skip
_STATE = "state it with `pdal translate IN OUT --writers.las.a_srs=EPSG:MAP+HEIGHTS`, such as EPSG:32633+5773"


@dataclass(frozen=True, eq=False)
class Cloud:
    """Rasters of a point cloud on one Grid."""

    surface: NDArray[np.float64]  # (h, w) float64 height of the highest point [m], NaN far from any
    # (h, w) float64 mean height of points of class 2 [m], NaN without one; None where the file has no such class
    ground: NDArray[np.float64] | None
    # (h, w) bool whether most points are of class 6; None where the file has no such class
    building: NDArray[np.bool_] | None
    grid: Grid
    notes: tuple[str, ...]  # What was left out, one sentence each


def read_cloud(path: Path) -> Cloud:
    """Return the Cloud of a file without withheld points, noise, wires, bridges, and the overlap of flight lines."""
    try:
        import laspy
    except ImportError:
        raise ThermorenderError(
            f"{path} needs laspy, which is not installed; run `pip install 'thermorender[clouds]'`"
        ) from None
    if not os.path.isfile(path):
        raise ThermorenderError(f"{path} does not exist; give a LAS or LAZ file")
    _check_counts(path)
    with _named(path):
        file = laspy.open(str(path))
    with file:
        return _rasters(path, file)


def _check_counts(path: Path) -> None:
    """Refuse a file that is too short for the records that it counts: a library would read on or reserve memory.

    The public header block, variable length records of 54 bytes at least, extended ones of 60, and the table of chunks
    of LAZ: ASPRS, LAS Specification 1.4-R15, tables 3, 5 and 6.
    """
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(375)
        if len(head) < 227 or head[:4] != b"LASF":
            return  # the library refuses it
        if head[25] >= 4 and len(head) < 375:
            raise _short(path)
        header_size, points_at, records = struct.unpack_from("<HII", head, 94)
        counted = [(records, 54, min(points_at, size) - header_size)]
        if head[25] >= 4:
            begin, extended = struct.unpack_from("<QI", head, 235)
            counted.append((extended, 60, size - begin if extended else 0))
            for _ in range(extended if extended * 60 <= size - begin else 0):
                file.seek(begin + 20)
                (length,) = struct.unpack("<Q", file.read(8).ljust(8, b"\xff"))
                begin += 60 + length
                if begin > size:
                    raise _short(path)
        record, points = struct.unpack_from("<HI", head, 105)
        if head[25] >= 4:
            points = max(points, *struct.unpack_from("<Q", head, 247))
        if not head[104] & 0x80:
            counted.append((points, record, size - points_at))
        if head[104] & 0x80 and size >= points_at + 8:
            # LAZ: the point data begin with the place of the table of chunks; -1 where it is in the last bytes.
            file.seek(points_at)
            (table,) = struct.unpack("<q", file.read(8))
            if table == -1:
                file.seek(-8, os.SEEK_END)
                (table,) = struct.unpack("<q", file.read(8))
            if 0 <= table <= size - 8:
                file.seek(table + 4)
                (chunks,) = struct.unpack("<I", file.read(4))
                # A chunk has one byte of points at least.
                counted.append((chunks, 1, size - points_at))
    if any(number * least > max(room, 0) for number, least, room in counted):
        raise _short(path)
    if head[104] & 0x80:
        _check_chunks(path, size, points)


def _check_chunks(path: Path, size: int, counted: int) -> None:
    """Refuse chunks of compressed points, and layers of a chunk, for which the decoder would reserve too much memory,
    and fewer points in all chunks than the header `counted`.

    LASzip's record has the number of points of a chunk. In formats from 6 on, a chunk begins with one whole point and
    the number of points, then has a length for each layer. The record lists items (type, size, version): 10 is a point
    of 9 layers, 11 and 12 are colours, 14 is a layer for each byte.
    """
    with open(path, "rb") as file, _named(path):
        import lazrs

        head = file.read(375)
        header_size, points_at, records = struct.unpack_from("<HII", head, 94)
        (record,) = struct.unpack_from("<H", head, 105)
        file.seek(header_size)
        for _ in range(records):
            kind, length = struct.unpack_from("<HH", file.read(54), 18)
            body = file.read(length)
            if kind == _LASZIP:
                break
        else:
            raise ValueError("its points are compressed, but it has no LASzip record")
        (points,) = struct.unpack_from("<I", body.ljust(16, b"\0"), 12)
        # All bits mean chunks of any number of points, which the table of chunks has.
        if points != 0xFFFFFFFF and points * record > _CHUNK_BYTES:
            raise _short(path)
        items = [struct.unpack_from("<HH", body, 34 + 6 * k) for k in range((len(body) - 34) // 6)]
        if sum(length for _, length in items) != record:
            raise ValueError(f"its LASzip record describes other points than those of {record} bytes in the header")
        file.seek(points_at)
        table = lazrs.read_chunk_table(file, lazrs.LazVlr(body))
        if counted > (points * len(table) if points != 0xFFFFFFFF else sum(number for number, _ in table)):
            raise _short(path)
        if head[104] & 0x3F < 6:
            return
        layers = sum({10: 9, 11: 1, 12: 2, 13: 1, 14: length}.get(kind, 0) for kind, length in items)
        at = points_at + 8
        for _, length in table:
            file.seek(at + record + 4)
            lengths = np.frombuffer(file.read(4 * layers), "<u4")
            if at + length > size or lengths.sum(dtype=np.int64) > length:
                raise _short(path)
            at += length


def _short(path: Path) -> ThermorenderError:
    return ThermorenderError(
        f"{path} counts more records than it has bytes for; it is damaged, so copy it again or give another file"
    )


@contextmanager
def _named(path: Path) -> Iterator[None]:
    """Turn what laspy and its decoders raise for damaged files, of many types, into one sentence."""
    try:
        yield
    except ThermorenderError:
        raise
    except BaseException as error:
        # A panic of the LAZ decoder, which is written in Rust, is no Exception.
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":
            raise
        raise ThermorenderError(
            f"{path} cannot be read as a point cloud ({type(error).__name__}: {error}); give a whole LAS or LAZ file"
        ) from None


def _rasters(path: Path, file: Any) -> Cloud:
    header = file.header
    crs, factor = _crs_of(path, header)
    left, bottom, right, top = bounds = [float(v) for v in (*header.mins[:2], *header.maxs[:2])]
    if not (left <= right and bottom <= top and np.isfinite([right - left, top - bottom]).all()):
        raise ThermorenderError(
            f"{path} has the bounds {', '.join(f'{v:g}' for v in bounds)} (west, south, east, north) in its header, "
            "which enclose nothing; write it again, with `pdal translate IN OUT`"
        )
    lon_lat(Grid(crs, _upright(left, top, 1.0), 1, 1, str(path)), np.array([left, right]), np.array([bottom, top]))
    unit = float(crs.linear_units_factor[1])
    area = max((right - left) * (top - bottom), 1e-9)
    post = float(np.clip(np.sqrt(_IN_POST * area / max(header.point_count, 1)), _POST_M[0] / unit, _POST_M[1] / unit))
    columns, rows = (max(2, int(np.ceil((high - low) / post))) for low, high in ((left, right), (bottom, top)))
    if rows * columns > max(_SPARSE * header.point_count, _SMALL):
        raise ThermorenderError(
            f"{path} has {header.point_count} points on {columns}×{rows} posts of {post * unit:.3g} m; they are too "
            "few for a surface, so cut the file to where points are dense, with `pdal translate`, or give a whole one"
        )
    if rows * columns > MOST_TEXELS:
        raise ThermorenderError(
            f"{path} covers {columns}×{rows} posts; up to {MOST_TEXELS} are allowed, so cut it, with `pdal tile`"
        )
    grid = Grid(crs, _upright(left, top, post), rows, columns, str(path))
    highest = np.full(rows * columns, -np.inf)
    count, ground_count, building_count, ground = (np.zeros(rows * columns) for _ in range(4))
    left_out = dict.fromkeys(("withheld", "noise", "overlap", *_OVERHEAD), 0)
    for x, y, z, kind in _points(path, file, left_out):
        column, row = np.floor((x - left) / post).astype(int), np.floor((top - y) / post).astype(int)
        # Headers are rounded, and so are points.
        if not (np.isfinite(z).all() and (column >= -1).all() and (row >= -1).all()
                and (column <= columns).all() and (row <= rows).all()):  # fmt: skip
            raise ThermorenderError(
                f"{path} has points outside of the bounds in its header; write it again, with `pdal translate IN OUT`"
            )
        post_of = np.clip(row, 0, rows - 1) * columns + np.clip(column, 0, columns - 1)
        np.maximum.at(highest, post_of, z)
        count += np.bincount(post_of, minlength=count.size)
        below = kind == _GROUND
        ground_count += np.bincount(post_of[below], minlength=count.size)
        ground += np.bincount(post_of[below], z[below], minlength=count.size)
        building_count += np.bincount(post_of[kind == _BUILDING], minlength=count.size)
    if not count.any():
        words = ", ".join(f"{number} {what}" for what, number in left_out.items() if number) or "none"
        raise ThermorenderError(f"{path} has no usable point (left out: {words}); give another file")
    shape, known = (rows, columns), (count > 0).reshape(rows, columns)
    close = _close_to(known)
    surface = np.where(close, fill(highest.reshape(shape), nearest_valid(known)), np.nan) * factor
    bare = np.where(ground_count > 0, ground / np.maximum(ground_count, 1), np.nan).reshape(shape) * factor
    house = fill((building_count > 0.5 * count).reshape(shape), nearest_valid(known)) & close
    notes = tuple(f"{path.name}: {number} points left out, {what}" for what, number in left_out.items() if number)
    return Cloud(surface, bare if ground_count.any() else None, house if building_count.any() else None, grid, notes)


def _close_to(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    from scipy.ndimage import distance_transform_edt

    found: NDArray[np.bool_] = distance_transform_edt(~known) <= _NEAR
    return found


def _points(path: Path, file: Any, left_out: dict[str, int]) -> Iterator[tuple[NDArray[Any], ...]]:
    """Yield (x, y, z, class) of usable points in parts, and count the others."""
    chunks = file.chunk_iterator(_AT_ONCE)
    while True:
        with _named(path):
            part = next(chunks, None)
        if part is None:
            return
        kind = np.asarray(part.classification)
        unusable = {"withheld": np.asarray(part.withheld) != 0, "noise": np.isin(kind, _NOISE)}
        # Point formats up to 5 have a class of overlap, later ones a flag.
        overlap = getattr(part, "overlap", None)
        unusable["overlap"] = kind == _OVERLAP if overlap is None else np.asarray(overlap) != 0
        if overlap is not None:
            unusable |= {what: np.isin(kind, classes) for what, classes in _OVERHEAD.items()}
        keep = np.ones(len(kind), bool)
        for what, those in unusable.items():
            left_out[what] += int((those & keep).sum())
            keep &= ~those
        yield tuple(np.asarray(each)[keep] for each in (part.x, part.y, part.z, kind))


def _upright(left: float, top: float, side: float) -> Any:
    from rasterio import Affine

    return Affine(side, 0.0, left, 0.0, -side, top)


def _crs_of(path: Path, header: Any) -> tuple[Any, float]:
    """(CRS of the map, metres in the unit of heights) by a file's WKT or GeoTIFF keys."""
    import rasterio
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    unit = ""
    crs = None
    try:
        for record in (*header.vlrs, *(header.evlrs or ())):
            keys = {key.id: key.value_offset for key in getattr(record, "geo_keys", ())}
            if hasattr(record, "string") and record.record_id == 2112:
                with rasterio.Env():  # Within it, GDAL prints no error of its own
                    crs = CRS.from_wkt(record.string.rstrip("\0"))
                break
            if keys:
                unit = _UNITS.get(keys.get(_VERTICAL_UNIT, 0), "")
                code, level = keys.get(_PROJECTED, keys.get(_GEOGRAPHIC, 0)), keys.get(_VERTICAL, 0)
                level = _OLD_VERTICAL.get((level, unit), level)
                if code and code != _OWN:
                    compound = f"+{level}" if level and level != _OWN else ""
                    with rasterio.Env():
                        crs = CRS.from_user_input(f"EPSG:{code}{compound}")
                    _check_map_unit(path, crs, _UNITS.get(keys.get(_MAP_UNIT, 0)))
    except CRSError as error:
        raise ThermorenderError(f"{path} has a CRS that cannot be read ({error}); {_STATE}") from None
    if crs is None:
        raise ThermorenderError(f"{path} declares no CRS by an EPSG number or WKT; {_STATE}")
    if crs.is_projected and not crs.linear_units_factor[1] > 0.0:
        raise ThermorenderError(f"{path} has a map whose unit is {crs.linear_units_factor[1]:g} m; {_STATE}")
    if not crs.is_projected:
        raise ThermorenderError(
            f"{path} is in {crs.to_string()[:60]}, not on a map; project it, with "
            "`pdal translate IN OUT reprojection --filters.reprojection.out_srs=EPSG:MAP`"
        )
    return crs, metres_of_heights(path, crs, unit, _STATE)


def _check_map_unit(path: Path, crs: Any, unit: str | None) -> None:
    """Refuse a map whose keys state another unit than its CRS has; both feet are one to 2 in a million."""
    if unit is None or not crs.is_projected:
        return
    stated, own = METRES[unit], float(crs.linear_units_factor[1])
    if abs(stated / own - 1.0) > 1e-4:
        raise ThermorenderError(
            f"{path} contradicts itself: its map is in {unit} by the key of units, and in {crs.linear_units} by "
            f"{crs.to_string()[:60]}; {_STATE}"
        )
