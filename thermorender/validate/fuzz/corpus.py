"""A small whole file for each reader of the package, and the reader: what damaged files are made from."""

import json
import struct
from collections.abc import Callable
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np

from thermorender.paths import data_folder


@dataclass(frozen=True)
class Reader:
    """A reader of files.

    Attributes
    ----------
    file : str
        Name of the file it is fed with.
    make : callable
        Folder → None; writes that file, whole, and what it needs beside it.
    read : callable
        Path → what was read, of which all numbers must be finite.
    """

    file: str
    make: Callable[[Path], None]
    read: Callable[[Path], object]


READERS: dict[str, Reader] = {}


def _reader(name, file, source):
    """Register a reader: `source` is a function of the path that makes the file, its text, or a shipped file."""

    def register(read):
        def make(folder):
            path = folder / file
            if callable(source):
                source(path)
            else:
                path.write_bytes(source.read_bytes() if hasattr(source, "read_bytes") else source.encode())

        READERS[name] = Reader(file, make, read)
        return read

    return register


_PACKAGE, _MATERIALS = resources.files("thermorender"), data_folder("materials")


# --- settings ---------------------------------------------------------------------------------------------------


@_reader("camera", "camera.toml", _PACKAGE / "sensor" / "cameras" / "zenmuse-xt2-9mm.toml")
def _camera(path):
    from thermorender.sensor.camera import load_camera

    camera = load_camera(path)
    return camera, camera.directions(np.array([[0.5, 0.5]]))


_SCENE = """title = "small"
[terrain]
elevation = "elevation.tif"
orthophoto = "orthophoto.tif"
[temperature]
source = "constant"
value = 290.0
[emissivity]
source = "constant"
value = 0.95
[camera]
model = "zenmuse-xt2"
[atmosphere]
standard = "us-1976"
aerosol = "rural-23km"
[[object]]
name = "plate"
shape = "disc"
size = [2.0, 2.0, 0.1]
position = [0.3, 0.2, 0.05]
temperature = 360.0
material = "paint_black"
"""


@_reader("trajectory mapping", "mapping.toml", _PACKAGE / "trajectory" / "formats" / "dji-gimbal.toml")
def _mapping(path):
    from thermorender.trajectory.mapping import load_mapping

    return load_mapping(str(path))


@_reader("rig", "rig.json", json.dumps({
    "format": 1, "visible_shape": [96, 128], "thermal_shape": [64, 80], "scale": 1.5, "aspect": 1.0,
    "shift_px": [1.0, -2.0], "rotation_deg": 0.5, "k1": -0.01,
}))  # fmt: skip
def _rig(path):
    from thermorender.campaign.registration.rig import load_rig

    return load_rig(path)


@_reader("split", "split.json", json.dumps({"train": ["a", "b"], "validation": ["c"], "test": ["d"]}))
def _split(path):
    from thermorender.campaign.splits import read_split

    return read_split(path)


# --- tables -----------------------------------------------------------------------------------------------------


_FLIGHT = "time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg\n" + "".join(
    f"{0.5 * k:.3f},{4.0 + k:.3f},{-14.0 + 2 * k:.3f},119.4,{359.0 + k:.3f},-45.0,0.1\n" for k in range(12)
)


@_reader("trajectory", "flight.csv", _FLIGHT)
def _trajectory(path):
    from thermorender.trajectory.readers import read_trajectory

    path = read_trajectory(path)
    return path, path.pose(float(np.mean(path.span_s)))


@_reader("track", "track.csv", "time_s,east_m,north_m,yaw_deg,temperature_k\n0,0,0,0,300\n1,2,0,10,310\n2,3,1,20,305\n")
def _track(path):
    from thermorender.scene.tracks import read_track

    return read_track(path)


_SOUNDING = "altitude_m,pressure_hpa,temperature_k,relative_humidity_percent\n" + "".join(
    f"{500 * k},{1013.25 * (1 - 0.0065 * 500 * k / 288.15) ** 5.2559:.2f},{288.15 - 3.25 * k:.2f},{60 - 2 * k}\n"
    for k in range(12)
)


@_reader("sounding", "profile.csv", _SOUNDING)
def _profile(path):
    from thermorender.atmosphere.profile import from_profile

    air = from_profile(path)
    return air, air.transmittance(0.0, 100.0, 500.0)


@_reader("emissivity", "material.csv", _MATERIALS / "spectra" / "asphalt.csv")
def _emissivity(path):
    from thermorender.materials.files import read_emissivity

    found = read_emissivity(path)
    # Where no spread is known its column is empty.
    return {key: value for key, value in found.items() if key != "emissivity_std"}


@_reader("refractive index", "index.csv", "wavelength_um,n,k\n" + "".join(
    f"{7 + 0.5 * k},{1.2 + 0.01 * k},{0.05 + 0.02 * k}\n" for k in range(16)
))  # fmt: skip
def _refractive(path):
    from thermorender.materials.files import read_refractive_index

    found = read_refractive_index(path, 0.0)
    return {key: value for key, value in found.items() if key != "emissivity_std"}


@_reader("emissivity by angle", "angles.csv", "wavelength_um,at_0,at_30,at_60,at_90\n" + "".join(
    f"{7 + k},0.95,0.94,0.9,0.0\n" for k in range(8)
))  # fmt: skip
def _angles(path):
    from thermorender.materials.files import read_angles

    found = read_angles(path)
    return {key: value for key, value in found.items() if key != "emissivity_std"}


@_reader("thermal properties", "thermal.csv", _MATERIALS / "thermal" / "asphalt.csv")
def _thermal(path):
    from thermorender.materials.thermal import read_thermal

    thermal = read_thermal(path)
    return [value for value in vars(thermal).values() if isinstance(value, float) and not np.isnan(value)]


@_reader("sample", "sample.csv", "wavelength_um,emissivity_percent\n" + "".join(
    f"{7 + 0.25 * k:.2f},{94 + k % 3}\n" for k in range(30)
))  # fmt: skip
def _sample(path):
    from thermorender.materials.samples import read_sample

    return read_sample(path)


_ECOSTRESS = (
    "Name: Sand\nType: Soil\nClass: Entisol\nWavelength Range: All\nOrigin: here\nMeasurement: Directional (10 Degree) "
    "Hemispherical Reflectance\nFirst Column: X\nSecond Column: Y\nX Units: Wavelength (micrometers)\n"
    "Y Units: Reflectance (percent)\nFirst X Value: 14\nLast X Value: 0.4\nNumber of X Values: 120\n\n"
) + "".join(f"{14.0 - 0.115 * k:.4f}\t{5 + k % 7:.3f}\n" for k in range(118))


@_reader("ECOSTRESS", "sample.txt", _ECOSTRESS)
def _ecostress(path):
    from thermorender.materials.samples import read_sample

    return read_sample(path)


_STATION = "time_utc,air_c,relative_humidity_percent,wind_m_s,global_w_m2,pressure_hpa\n" + "".join(
    f"2018-07-{28 + k // 24:02d}T{k % 24:02d}:30Z,{18 + 6 * np.sin((k - 9) / 3.8):.1f},55,2.5,"
    f"{max(0.0, 800 * np.sin((k % 24 - 5) / 4.8)) if 5 < k % 24 < 20 else 0:.0f},1013\n"
    for k in range(72)
)


@_reader("weather", "weather.csv", _STATION)
def _weather(path):
    from thermorender.weather.station import read_station

    return read_station(path, 49.0, 8.0, 120.0)


# --- arrays and models ------------------------------------------------------------------------------------------


def _write_air(path):
    from thermorender.atmosphere.model import Atmosphere

    Atmosphere.standard("us-1976").in_band(9.0, 10.0).save(path)


@_reader("atmosphere", "air.npz", _write_air)
def _air(path):
    from thermorender.atmosphere.model import Atmosphere

    air = Atmosphere.load(path)
    return air.transmittance(0.0, 50.0, 100.0), air.path_radiance(0.0, 50.0, 100.0)


def _of_map(path):
    from thermorender.learned.temperature_map import load_map

    return load_map(path)


for _name in ("correlation+", "palette", "trees"):
    _reader(f"map {_name}", "map.npz", _PACKAGE / "learned" / "maps" / f"procedural-{_name}.npz")(_of_map)


@_reader("emissivity map", "map.npz", _PACKAGE / "learned" / "emissivity_procedural.npz")
def _emissivity_map(path):
    from thermorender.learned.emissivity import load_map

    return load_map(path)


# --- images and meshes ------------------------------------------------------------------------------------------


def _write_raster(path, values, **more):
    import rasterio

    values = np.atleast_3d(values).transpose(2, 0, 1) if values.ndim == 3 else values[None]
    count, height, width = values.shape
    transform = rasterio.Affine(1.0, 0.0, 500000.0, 0.0, -1.0, 5000000.0)
    with rasterio.open(
        path, "w", driver="GTiff", width=width, height=height, count=count, dtype=values.dtype.name, crs="EPSG:32632",
        transform=transform, **more,
    ) as file:  # fmt: skip
        file.write(values)


def write_elevation(path):
    _write_raster(path, np.random.default_rng(0).uniform(0.0, 3.0, (24, 24)).astype(np.float32), nodata=-9999.0)


@_reader("elevation", "elevation.tif", write_elevation)
def _elevation(path):
    from thermorender.scene.terrain import read_elevation

    height, _ = read_elevation(path)
    # Posts without data are holes.
    return height[~np.isnan(height)]


def write_colour(path):
    _write_raster(path, np.random.default_rng(0).integers(0, 255, (24, 24, 3)).astype(np.uint8))


@_reader("orthophoto", "orthophoto.tif", write_colour)
def _orthophoto(path):
    from thermorender.scene.raster import read_colour

    return read_colour(path)[0]


def _write_scene(path):
    path.write_text(_SCENE)
    write_elevation(path.with_name("elevation.tif"))
    write_colour(path.with_name("orthophoto.tif"))


@_reader("scene", "scene.toml", _write_scene)
def _scene(path):
    from thermorender.scene.spec import read_scene

    return read_scene(path.parent)


def _write_classes(path):
    _write_raster(path, np.random.default_rng(0).integers(1, 4, (24, 24)).astype(np.uint8))


@_reader("classes", "classes.tif", _write_classes)
def _classes(path):
    from thermorender.scene.raster import read_classes

    return read_classes(path)[0]


def _write_counts(path):
    from thermorender.footage.radiometric_files import write_tlinear

    write_tlinear(path, np.random.default_rng(0).uniform(280.0, 300.0, (24, 32)).astype(np.float32))


@_reader("radiometric TIFF", "counts.tif", _write_counts)
def _counts(path):
    from thermorender.footage.radiometric_files import read_temperature

    kelvin = read_temperature(path)
    return kelvin[~np.isnan(kelvin)]


def _write_exr(path):
    import OpenEXR

    channels = {"radiance": np.random.default_rng(0).uniform(30.0, 50.0, (24, 32)).astype(np.float32)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "thermorender": '{"index": 0}'}
    OpenEXR.File(header, channels).write(str(path))


@_reader("EXR", "frame.exr", _write_exr)
def _exr(path):
    from thermorender.output.exr import read_exr

    # Pixels are as the file has them: without surface they are NaN.
    return read_exr(path)[1]


def _write_picture(path):
    import cv2

    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (64, 80, 3)).astype(np.uint8))


@_reader("picture", "picture.jpg", _write_picture)
def _picture(path):
    from thermorender.campaign.pictures import read_visible

    return read_visible(path)


def _write_flir(path):
    camera = bytearray(0x340)
    for at, value in {
        0x20: 0.95, 0x24: 10.0, 0x28: 293.15, 0x2C: 293.15, 0x30: 293.15, 0x34: 1.0, 0x3C: 0.5, 0x58: 17096.5,
        0x5C: 1428.0, 0x60: 1.0, 0x70: 0.006569, 0x74: 0.01262, 0x78: -0.002276, 0x7C: -0.00667, 0x80: 1.9,
        0x90: 408.0, 0x94: 248.0, 0x30C: 0.0468,
    }.items():  # fmt: skip
        struct.pack_into(">f", camera, at, value)
    struct.pack_into(">i", camera, 0x308, -124)
    raw = struct.pack(">HHH", 3, 12, 8) + bytes(26)
    raw += np.random.default_rng(0).integers(15000, 16000, (8, 12)).astype(">u2").tobytes()
    records = [(0x01, raw), (0x20, bytes(camera))]
    body, entries, at = b"", b"", 64 + 32 * len(records)
    for kind, data in records:
        entries += struct.pack(">HHIIIIII", kind, 0, 0, 0, at + len(body), len(data), 0, 0).ljust(32, b"\0")
        body += data
    container = b"FFF\0" + b"test".ljust(16, b"\0") + struct.pack(">III", 100, 64, len(records)) + bytes(32) + entries
    segment = b"FLIR\0\x01\0\0" + container + body
    path.write_bytes(b"\xff\xd8\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + b"\xff\xd9")


@_reader("FLIR JPEG", "picture.jpg", _write_flir)
def _flir(path):
    from thermorender.footage.flir_jpeg import read_flir_jpeg

    found = read_flir_jpeg(path)
    # A signal below the formula's zero has no temperature.
    return found.planck, found.thermography, found.air


def _body():
    import trimesh

    body = trimesh.creation.box((4.0, 3.0, 2.0)).subdivide()
    body.visual = trimesh.visual.TextureVisuals(uv=body.vertices[:, :2] / 8.0 + 0.5)
    return body


def _of_mesh(path):
    from thermorender.scene.mesh import load

    return load(path, path.parent)


for _name in ("ply", "obj", "glb"):
    _reader(f"mesh {_name}", f"model.{_name}", lambda path: _body().export(path))(_of_mesh)
