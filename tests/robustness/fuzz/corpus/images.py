"""Rasters, pictures and videos."""

import io
import struct
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.robustness.fuzz.corpus.registry import reader
from thermorender.defaults import TEMPERATURE_MAPS


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


@reader("elevation", "elevation.tif", write_elevation)
def _elevation(path):
    from thermorender.scene.terrain import read_elevation

    height, _ = read_elevation(path)
    # Posts without data are holes.
    return height[~np.isnan(height)]


def write_colour(path):
    _write_raster(path, np.random.default_rng(0).integers(0, 255, (24, 24, 3)).astype(np.uint8))


@reader("orthophoto", "orthophoto.tif", write_colour)
def _orthophoto(path):
    from thermorender.scene.orthophoto import read_colour

    return read_colour(path)[0]


def _write_classes(path):
    _write_raster(path, np.random.default_rng(0).integers(1, 4, (24, 24)).astype(np.uint8))


@reader("classes", "classes.tif", _write_classes)
def _classes(path):
    from thermorender.scene.raster import read_classes

    return read_classes(path)[0]


def _write_counts(path):
    from thermorender.sensor.radiometric_files import write_tlinear

    write_tlinear(path, np.random.default_rng(0).uniform(280.0, 300.0, (24, 32)).astype(np.float32))


@reader("radiometric TIFF", "counts.tif", _write_counts)
def _counts(path):
    from thermorender.sensor.radiometric_files import read_temperature

    kelvin = read_temperature(path)
    return kelvin[~np.isnan(kelvin)]


def _write_exr(path):
    import OpenEXR

    channels = {"radiance": np.random.default_rng(0).uniform(30.0, 50.0, (24, 32)).astype(np.float32)}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, "thermorender": '{"index": 0}'}
    OpenEXR.File(header, channels).write(str(path))


@reader("EXR", "frame.exr", _write_exr)
def _exr(path):
    from thermorender.frame.exr import read_exr

    # Pixels are as in the file: without a surface they are NaN.
    return read_exr(path)[1]


def _write_picture(path):
    import cv2

    cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 255, (64, 80, 3)).astype(np.uint8))


@reader("picture", "picture.jpg", _write_picture)
def _picture(path):
    from thermorender.apps.training.pictures import read_visible

    return read_visible(path)


def flir_container(raw, pixels=None, overstated=0):
    """A container of FLIR with an image of raw values (H, W), whose bytes `pixels` replace, and a camera's block; its
    directory states `overstated` bytes too many.
    """
    camera = bytearray(0x340)
    for at, value in {
        0x20: 0.95, 0x24: 10.0, 0x28: 293.15, 0x2C: 293.15, 0x30: 293.15, 0x34: 1.0, 0x3C: 0.5, 0x58: 17096.5,
        0x5C: 1428.0, 0x60: 1.0, 0x70: 0.006569, 0x74: 0.01262, 0x78: -0.002276, 0x7C: -0.00667, 0x80: 1.9,
        0x90: 408.0, 0x94: 248.0, 0x30C: 0.0468,
    }.items():  # fmt: skip
        struct.pack_into(">f", camera, at, value)
    struct.pack_into(">i", camera, 0x308, -124)
    height, width = raw.shape
    image = struct.pack(">HHH", 3, width, height) + bytes(26)
    image += raw.astype(">u2").tobytes() if pixels is None else pixels
    records = [(0x01, image, 0), (0x20, bytes(camera), overstated)]
    body, entries, at = b"", b"", 64 + 32 * len(records)
    for kind, data, more in records:
        entries += struct.pack(">HHIIIIII", kind, 0, 0, 0, at + len(body), len(data) + more, 0, 0).ljust(32, b"\0")
        body += data
    head = b"FFF\0" + b"test".ljust(16, b"\0") + struct.pack(">III", 100, 64, len(records)) + bytes(32)
    return head + entries + body


def jpeg_ls(raw):
    """Raw values (H, W) as JPEG-LS, as in CSQ files."""
    import pillow_jpls  # noqa: F401  # Pillow writes JPEG-LS once it is imported.
    from PIL import Image

    memory = io.BytesIO()
    Image.fromarray(raw).save(memory, "JPEG-LS", spiff=None)
    return memory.getvalue()


def _raw(seed):
    return np.random.default_rng(seed).integers(15000, 16000, (8, 12)).astype(np.uint16)


def flir_jpeg(container):
    """The bytes of a radiometric JPEG with a container of FLIR, without a picture."""
    segment = b"FLIR\0\x01\0\0" + container
    return b"\xff\xd8\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + b"\xff\xd9"


def _write_flir(path):
    path.write_bytes(flir_jpeg(flir_container(_raw(0))))


@reader("FLIR JPEG", "picture.jpg", _write_flir)
def _flir(path):
    from thermorender.sensor.flir_jpeg import read_flir_jpeg

    found = read_flir_jpeg(path)
    # A signal below the formula's zero has no temperature.
    return found.planck, found.thermography, found.air


def _write_seq(path):
    path.write_bytes(b"".join(flir_container(_raw(seed)) for seed in range(3)))


def _write_csq(path):
    frames = [flir_container(raw, jpeg_ls(raw), 4 * (seed == 2)) for seed, raw in enumerate(map(_raw, range(3)))]
    path.write_bytes(b"".join(frames))


def _sequence(path):
    from thermorender.sensor.thermal_files import thermal_frames, thermal_images

    # A signal below the formula's zero has no temperature.
    return [image.kelvin[np.isfinite(image.kelvin)] for image in thermal_images(thermal_frames([path]))]


reader("FLIR SEQ", "sequence.seq", _write_seq)(_sequence)
reader("FLIR CSQ", "sequence.csq", _write_csq)(_sequence)


def _write_irg(path):
    celsius = np.random.default_rng(0).uniform(0.0, 40.0, (12, 16))
    head = struct.pack("<HH", 0xACCA, 128) + struct.pack("<IHHHHHHHIHHI", 192, 12, 16, 0, 0, 0, 0, 0, 0, 12, 16, 9500)
    head += struct.pack("<9IHHI", 2732, 2732, 10000, *([0] * 6), 0, 0, 1)
    counts = np.rint((celsius + 273.15) * 16.0).astype("<u2")
    path.write_bytes(head.ljust(126, b"\0") + b"\xac\xca" + bytes(192) + counts.tobytes())


reader("InfiRay IRG", "picture.irg", _write_irg)(_sequence)


def _write_temperatures(path):
    _write_raster(path, np.random.default_rng(0).uniform(285.0, 305.0, (24, 24)).astype(np.float32), nodata=-9999.0)


@reader("temperatures", "temperature.tif", _write_temperatures)
def _temperatures(path):
    from thermorender.scene.raster import read_band

    kelvin = read_band(path)
    # It may be unknown, or not a possible temperature: the code that puts it on a surface checks.
    return kelvin[np.isfinite(kelvin)]


def _write_sidecar(path):
    write_elevation(path.with_name("elevation.tif"))
    path.write_text(
        '<PAMDataset>\n  <GeoTransform>500000, 1, 0, 5000000, 0, -1</GeoTransform>\n  <PAMRasterBand band="1">\n'
        "    <NoDataValue>-9999</NoDataValue>\n    <Offset>0.5</Offset>\n    <Scale>1.25</Scale>\n"
        '    <Metadata>\n      <MDI key="STATISTICS_MAXIMUM">3</MDI>\n    </Metadata>\n'
        "  </PAMRasterBand>\n</PAMDataset>\n"
    )


@reader("file beside a raster", "elevation.tif.aux.xml", _write_sidecar)
def _sidecar(path):
    return _elevation(path.with_name("elevation.tif"))


def _write_thermal(path):
    import cv2

    cv2.imwrite(str(path), np.random.default_rng(0).integers(7000, 7600, (64, 80)).astype(np.uint16))


@reader("thermal picture", "picture.png", _write_thermal)
def _thermal(path):
    from thermorender.apps.training.pictures import read_thermal

    return read_thermal(path, (0.04, 0.0))


def _write_photograph(path):
    import cv2

    rgba = np.random.default_rng(0).integers(0, 255, (64, 80, 4)).astype(np.uint8)
    cv2.imwrite(str(path), rgba)


@reader("photograph", "photograph.png", _write_photograph)
def _photograph(path):
    from thermorender.apps.training.translate import read_picture

    return read_picture(path)


for _name in ("webp", "tif", "bmp", "jpg"):
    reader(f"photograph {_name}", f"photograph.{_name}", _write_photograph)(_photograph)


def _write_video(path):
    import cv2

    from thermorender.apps.training.translate import VIDEOS

    codec = cv2.VideoWriter_fourcc(*VIDEOS[path.suffix])
    writer, generator = cv2.VideoWriter(str(path), codec, 8.0, (64, 48)), np.random.default_rng(0)
    for _ in range(6):
        writer.write(np.repeat(np.repeat(generator.integers(0, 255, (6, 8, 3)).astype(np.uint8), 8, 0), 8, 1))
    writer.release()


def _translated(path):
    """Translate a video; raise the error with which it is refused."""
    from thermorender.apps.training.translate import UnreadableError, translate
    from thermorender.learned.temperature_map import load_model
    from thermorender.sensor.radiometric_files import read_temperature

    with TemporaryDirectory(dir=path.parent) as folder:
        report = translate(load_model(TEMPERATURE_MAPS[0]), [path], folder, frames=True)
        for sentence in report["failed"].values():
            raise UnreadableError(sentence)
        return [read_temperature(frame) for frame in Path(folder).rglob("*.tif")]


for _name in ("mp4", "avi"):
    reader(f"video {_name}", f"video.{_name}", _write_video)(_translated)
