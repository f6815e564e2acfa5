"""What surveys bring: binary logs, point clouds, poses and lenses of photogrammetry, outlines of buildings."""

import json
import struct
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np

from tests.robustness.fuzz.corpus.images import _write_raster, write_colour
from tests.robustness.fuzz.corpus.registry import reader
from tests.robustness.fuzz.corpus.tables import of_log
from thermorender.physics.geodesy import LocalFrame

# --- binary logs ------------------------------------------------------------------------------------------------


def _write_ulog(path):
    """Position, attitude and gimbal of eight samples: ULog File Format of PX4, version 1."""
    body = b""

    def add(kind, data):
        nonlocal body
        body += struct.pack("<HB", len(data), ord(kind)) + data

    fields = {
        "vehicle_local_position": "uint64_t timestamp;double x;double y;double z;double ref_lat;double ref_lon;"
        "bool xy_valid;bool z_valid;bool xy_global;",
        "vehicle_attitude": "uint64_t timestamp;double[4] q;",
        "gimbal_device_attitude_status": "uint64_t timestamp;double[4] q;uint16_t device_flags;",
    }
    for name, types in fields.items():
        add("F", f"{name}:{types}".encode())
    for number, name in enumerate(fields):
        add("A", struct.pack("<BH", 0, number) + name.encode())
    for k in range(8):
        time, half = 10**5 * (k + 1), 0.05 * k
        add("D", struct.pack("<HQ5d3?", 0, time, 2.0 * k, 1.0, -40.0, 47.0, 8.0, True, True, True))
        add("D", struct.pack("<HQ4d", 1, time, np.cos(half), 0.0, 0.0, np.sin(half)))
        add("D", struct.pack("<HQ4dH", 2, time, np.cos(0.3), 0.0, -np.sin(0.3), 0.0, 32))
    path.write_bytes(b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 1000) + body)


@reader("ULog", "log.ulg", _write_ulog)
def _ulog(path):
    return of_log(path, "ulog")


def _write_dataflash(path):
    """Position, attitude and mount of eight samples, each type of message declared by FMT."""
    kinds = {
        128: ("FMT", "BBnNZ", "Type,Length,Name,Format,Columns", 89),
        130: ("POS", "QLLff", "TimeUS,Lat,Lng,Alt,RelHomeAlt", 27),
        131: ("ATT", "Qfff", "TimeUS,Roll,Pitch,Yaw", 23),
        132: ("MNT", "QBfff", "TimeUS,I,Roll,Pitch,YawE", 24),
    }
    body = b"".join(
        b"\xa3\x95\x80" + struct.pack("<BB4s16s64s", kind, size, name.encode(), form.encode(), columns.encode())
        for kind, (name, form, columns, size) in kinds.items()
    )
    for k in range(8):
        for kind, row in (
            (130, struct.pack("<Qiiff", k * 10**6, 470000000 + 100 * k, 80000000, 500, 40)),
            (131, struct.pack("<Qfff", k * 10**6, 0, 0, 90)),
            (132, struct.pack("<QBfff", k * 10**6, 0, 0, -30, 180)),
        ):
            body += b"\xa3\x95" + bytes([kind]) + row
    path.write_bytes(body)


@reader("dataflash", "log.bin", _write_dataflash)
def _dataflash(path):
    return of_log(path, "ardupilot")


def _write_bag(path):
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kinds = store.types
    name = "geometry_msgs/msg/PoseStamped"
    folder = path.parent / "bag"
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as bag:
        topic = bag.add_connection("/pose", name, typestore=store)
        for k in range(6):
            message = kinds[name](
                kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](k, 0), "map"),
                kinds["geometry_msgs/msg/Pose"](
                    kinds["geometry_msgs/msg/Point"](1.0 * k, 2.0, 40.0),
                    kinds["geometry_msgs/msg/Quaternion"](0.0, 0.6, 0.0, 0.8),
                ),
            )
            bag.write(topic, k * 10**9, store.serialize_cdr(message, name))
    (folder / "bag.mcap").rename(path)


@reader("ROS bag", "flight.mcap", _write_bag)
def _bag(path):
    return of_log(path, "rosbag")


# --- logs with a mapping of the user ----------------------------------------------------------------------------

_MAPPING = """sort_by_time = true
[time]
column = ["t_ms", "time"]
scale = 0.001
[columns]
lat_deg = "Latitude"
lon_deg = "Longitude"
above_takeoff_m = { column = "Height [ft]", scale = 0.3048 }
yaw_deg = "Heading"
gimbal_yaw_deg = { column = "pan", optional = true }
gimbal_pitch_deg = "tilt"
[gimbal]
relative_to = "body"
"""


def _write_own_log(path):
    path.with_name("mapping.toml").write_text(_MAPPING)
    path.write_text("t_ms;Latitude;Longitude;Height [ft];Heading;pan;tilt;note\n" + "".join(
        f"{500 * k};47,{1000 + k};8,5;{120 + k},5;{90 + k};{k % 3};-50;\"a; {k}\"\n" for k in range(9)
    ))  # fmt: skip


@reader("log with a mapping", "own.csv", _write_own_log)
def _own_log(path):
    return of_log(path, path.with_name("mapping.toml"))


# --- point clouds and outlines ----------------------------------------------------------------------------------


def _write_cloud(path):
    import laspy
    from rasterio.crs import CRS

    random = np.random.default_rng(1)
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.01] * 3, [500000.0, 5000000.0, 0.0]
    header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(CRS.from_epsg(32632).to_wkt()))
    cloud = laspy.LasData(header)
    x, y = random.uniform(0.0, 8.0, (2, 60))
    cloud.x, cloud.y, cloud.z = 500000.0 + x, 5000000.0 + y, 20.0 + (x > 4.0)
    cloud.classification = np.where(x > 4.0, 6, 2).astype(np.uint8)
    cloud.write(str(path))


def _cloud(path):
    from thermorender.apps.lands.solids.clouds import read_cloud

    found = read_cloud(path)
    return found.surface[~np.isnan(found.surface)]


reader("cloud LAS", "cloud.las", _write_cloud)(_cloud)
reader("cloud LAZ", "cloud.laz", _write_cloud)(_cloud)

_HOUSE = [[500002 + x, 4999998 - y] for x, y in ((0, 0), (9, 0), (9, 8), (0, 8), (0, 0))]
_HOUSES = {
    "type": "FeatureCollection",
    "crs": {"type": "name", "properties": {"name": "EPSG:32632"}},
    "features": [
        {"type": "Feature", "properties": {"building": "yes", "building:levels": "2", "roof:shape": "gabled"},
         "geometry": {"type": "Polygon", "coordinates": [_HOUSE]}},
        {"type": "Feature", "properties": {"building:part": "yes", "height": "7 m", "min_height": "3"},
         "geometry": {"type": "MultiPolygon", "coordinates": [[[[x, y + 1] for x, y in _HOUSE]]]}},
        {"type": "Feature", "properties": {"other_tags": '"natural"=>"water","width"=>"3 m"'},
         "geometry": {"type": "LineString", "coordinates": [[500002, 4999990], [500020, 4999980]]}},
        {"type": "Feature", "properties": {"leisure": "swimming_pool"},
         "geometry": {"type": "GeometryCollection", "geometries": [
             {"type": "Polygon", "coordinates": [[[x + 9, y - 9] for x, y in _HOUSE]]}]}},
    ],
}  # fmt: skip


def _write_houses(path):
    write_colour(path.with_name("orthophoto.tif"))
    path.write_text(json.dumps(_HOUSES))


@cache
def _grid(raster):
    """The grid of an orthophoto, read once."""
    from thermorender.scene.raster import grid_of

    return grid_of(raster)


@reader("outlines", "houses.geojson", _write_houses)
def _outlines(path):
    from thermorender.apps.lands.solids.outlines import outlines_in

    return [outline.rings for outline in outlines_in(path, _grid(path.with_name("orthophoto.tif")))[0]]


@reader("mapped cover", "houses.geojson", _write_houses)
def _mapped(path):
    from thermorender.scene.mapped_cover import read_mapped_cover

    return read_mapped_cover(path, _grid(path.with_name("orthophoto.tif")), 1.0).number


# --- poses and lenses of photogrammetry -------------------------------------------------------------------------

_SCENE = SimpleNamespace(frame=LocalFrame(47.0, 8.0, 400.0), where="scene.toml")


def _poses(path):
    from thermorender.apps.survey.inverse.pose_files import read_poses

    return [(place.horizontal, place.height_m, place.rotation.as_matrix()) for place in read_poses(path).values()]


reader("poses", "poses.csv", "frame,lat_deg,lon_deg,alt_ellipsoid_m,omega_deg,phi_deg,kappa_deg,time\n" + "".join(
    f"DJI_{k}.JPG,47.{k:04d},8.0,{440 + k},{k},2,{30 + k},2024-05-01T10:00:0{k}Z\n" for k in range(5)
))(_poses)  # fmt: skip

_WGS84 = (
    'GEOGCS["WGS 84",DATUM["World Geodetic System 1984",SPHEROID["WGS 84",6378137,298.257223563,'
    'AUTHORITY["EPSG","7030"]],AUTHORITY["EPSG","6326"]],PRIMEM["Greenwich",0,AUTHORITY["EPSG","8901"]],'
    'UNIT["degree",0.01745329251994328,AUTHORITY["EPSG","9102"]],AUTHORITY["EPSG","4326"]]'
)
reader("poses of Metashape", "poses.txt", (
    f"# CoordinateSystem: {_WGS84}\n#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll,X_est,Y_est,Z_est,"
    "Yaw_est,Pitch_est,Roll_est\n"
) + "".join(f"DJI_{k}.JPG,8,47,440,{k},1,2,8.00{k},47.00{k},441,{k},1,2\n" for k in range(4)
) + "# Total Error\n")(_poses)  # fmt: skip

_CAMERA = {"projection_type": "brown", "width": 640, "height": 512, "focal_x": 1.2, "focal_y": 1.2, "k1": -0.1}
reader("poses of OpenSfM", "reconstruction.json", json.dumps([{
    "cameras": {"a": _CAMERA}, "reference_lla": {"latitude": 47.0, "longitude": 8.0, "altitude": 400.0},
    "shots": {f"DJI_{k}.JPG": {"camera": "a", "rotation": [3.0, 0.1 * k, 0.2], "translation": [1.0, 2.0, 40.0]}
              for k in range(3)},
}]))(_poses)  # fmt: skip


def _write_shots(path):
    from rasterio.crs import CRS
    from rasterio.warp import transform

    (x,), (y,) = transform(CRS.from_epsg(4326), CRS.from_epsg(32632), [8.0], [47.0])
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [{
        "type": "Feature", "geometry": {"type": "Point", "coordinates": [8.0, 47.0, 440.0]},
        "properties": {"filename": f"DJI_{k}.JPG", "focal": 0.9, "width": 640, "height": 512, "capture_time": 1e9,
                       "translation": [x, y, 440.0], "rotation": [3.0, 0.1 * k, 0.2]},
    } for k in range(3)]}))  # fmt: skip


reader("poses of OpenDroneMap", "shots.geojson", _write_shots)(_poses)


def _lens(path):
    from thermorender.apps.survey.footage.lens_files import read_lens

    return read_lens(path)


reader("lens of OpenDroneMap", "cameras.json", json.dumps({"a": _CAMERA}))(_lens)
reader("lens of Metashape", "lens.xml", (
    '<?xml version="1.0" encoding="UTF-8"?><calibration><projection>frame</projection><width>640</width>'
    "<height>512</height><f>760</f><cx>3.5</cx><cy>-2</cy><k1>-0.05</k1><k2>0.01</k2><p1>0.0001</p1></calibration>"
))(_lens)  # fmt: skip


# --- tags of pictures -------------------------------------------------------------------------------------------


def _write_tagged(path):
    from PIL import Image
    from PIL.TiffImagePlugin import IFDRational

    exif = Image.Exif()
    exif[274], exif[306] = 3, "2024:05:01 10:00:00"
    exif.get_ifd(0x8825).update({
        1: "N", 2: (IFDRational(47), IFDRational(0), IFDRational(3, 2)), 3: "E", 4: (8.0, 30.0, 1.5), 6: 440.0,
    })  # fmt: skip
    Image.fromarray(np.random.default_rng(0).integers(0, 255, (16, 20, 3)).astype(np.uint8)).save(path, exif=exif)


@reader("tags of a JPEG", "tagged.jpg", _write_tagged)
def _tags(path):
    from thermorender.apps.training.pictures import place_of
    from thermorender.sensor.radiometric_files import orientation

    return orientation(path), place_of(path) or ()


def _write_turned(path):
    _write_raster(path, np.random.default_rng(0).uniform(280.0, 300.0, (16, 20)).astype(np.float32))


@reader("tags of a TIFF", "tagged.tif", _write_turned)
def _tiff_tags(path):
    from thermorender.sensor.radiometric_files import orientation

    return orientation(Path(path))
