"""Frames as geotagged radiometric TIFFs, which photogrammetric software takes as the photographs of a survey; and maps.

The tags are those that OpenDroneMap 3.6 (opendm/photo.py, https://github.com/OpenDroneMap/ODM) and OpenSfM 0.5.2
(opensfm/exif.py, https://github.com/mapillary/OpenSfM) read:

- Position: the GPS tags.
- Focal length: EXIF focal length and pixels per centimetre. A 35 mm equivalent would take precedence, but EXIF rounds
  it to whole millimetres, so it is left out.
- Angles: the XMP attributes Camera:Yaw, Camera:Pitch and Camera:Roll, where pitch 0 looks down. OpenDroneMap prefers
  attributes of drone-dji, where pitch −90 looks down, and converts them only if the make is DJI. So the angles of
  drone-dji are XML elements: both programs skip these, and ExifTool reads them.
"""

import math
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from thermorender import files
from thermorender.apps.export.exr_frames import exr_frames
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.frame.orthoimage import orthorectified
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene.georeference import Place
from thermorender.trajectory.rotations import BODY_FROM_CAMERA, angles_from_rotation, ecef_from_ned
from thermorender.versions import versions

# Kelvin of one count.
STEP_K = 0.01
# Bands that end below are mid-wave [µm].
_MIDWAVE_UM = 6.0
# Axes of a camera that looks down, with the top of its image ahead, in body axes.
_BODY_FROM_NADIR = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_NAMESPACES = {
    "rdf": "http://www.w3.org/1999/02/22-rdf-syntax-ns#",
    "Camera": "http://pix4d.com/camera/1.0/",
    "drone-dji": "http://www.dji.com/drone-dji/1.0/",
}


def geotiff(folder: str | PathLike[str], output: str | PathLike[str], float32: bool = False) -> int:
    """Write the frames of a folder as geotagged TIFFs of apparent temperature, and return their number.

    Parameters
    ----------
    folder : path
        Of `render`, `fly` or `day`, with EXR files; the scene has a place on Earth.
    output : path
        Folder for frame_NNNNNN.tif.
    float32 : bool
        Write kelvin as float32 instead of counts of 0.01 K as uint16.

    Notes
    -----
    Tags hold make, model, focal length, pixels per centimetre of the sensor, f-number, instant (UTC, where the scene
    has one) and position in WGS 84; the altitude is above the ellipsoid. XMP holds Camera:Yaw, Camera:Pitch and
    Camera:Roll (pitch 0 looks down), drone-dji:GimbalYawDegree, GimbalPitchDegree (−90 looks down) and
    GimbalRollDegree, all from true north at the camera, and principal point, focal length [mm] and distortion (k1, k2,
    k3, p1, p2). GDAL's tags state scale, unit and no data.

    Raises
    ------
    ThermorenderError
        A folder without frames, a scene without a place, or a temperature that uint16 cannot hold.
    """
    count = 0
    with files.output_folder(output) as out:
        for number, channels, about in exr_frames(folder, ("apparent_temperature",), ("lens", "place")):
            _refuse_nowhere(folder, about)
            kelvin = channels["apparent_temperature"]
            if not float32 and (hottest := float(np.nanmax(kelvin))) > 65535 * STEP_K:
                raise ThermorenderError(
                    f"frame {number} of {folder} reaches {hottest:.0f} K, and counts of 0.01 K end at "
                    f"{65535 * STEP_K:.2f} K; set float32"
                )
            with files.atomic(out / f"frame_{number:06d}.tif") as part:
                _write(part, kelvin, about, float32)
            count += 1
    return count


def ground(folder: str | PathLike[str], output: str | PathLike[str], metres: float) -> int:
    """Write the frames of a folder on the scene's map, as `Frame.orthorectified`, and return their number.

    Parameters
    ----------
    folder : path
        Of `render`, `fly` or `day`, with EXR files that hold the truth.
    output : path
        Folder for frame_NNNNNN_ground.tif. Frames without a surface are left out.
    metres : float
        Size of a map pixel [m]. Pixels of all frames lie on one lattice.

    Raises
    ------
    ThermorenderError
        A folder without frames or truth, a scene without a place, or a size that is not allowed.
    """
    from rasterio.crs import CRS

    count, axes = 0, [f"truth.position.{axis}" for axis in "xyz"]
    with files.output_folder(output) as out:
        for number, channels, about in exr_frames(folder, ("radiance", *axes), ("lens", "place")):
            _refuse_nowhere(folder, about)
            position = np.stack([channels[name] for name in axes], axis=-1)
            if not np.isfinite(position).any():
                continue
            place = Place(_frame(about), CRS.from_string(about["place"]["crs"]))
            kelvin_of = partial(apparent_temperature, band_um=about["lens"]["band_um"])
            made = orthorectified(channels["radiance"], position, place, metres, kelvin_of)
            made.save(out / f"frame_{number:06d}_ground.tif")
            count += 1
    return count


def _refuse_nowhere(folder: str | PathLike[str], about: dict[str, Any]) -> None:
    if about["place"] is None:
        raise ThermorenderError(
            f"{folder} shows a scene without a place on Earth; add [frame] with latitude_deg, longitude_deg and "
            "height_m to its scene.toml and render it again"
        )


def _write(path: Path, kelvin: NDArray[np.float32], about: dict[str, Any], float32: bool) -> None:
    from PIL import Image
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    if float32:
        image, scale, none = Image.fromarray(kelvin.astype(np.float32)), "kelvin", "nan"
    else:
        counts = np.rint(np.nan_to_num(kelvin.astype(np.float64)) / STEP_K).astype(np.uint16)
        image, scale, none = Image.fromarray(counts), f"counts of {STEP_K} K from 0 K", "0"
    tags = ImageFileDirectory_v2()
    for number, value in _tags(about, f"apparent temperature, {scale}; no data: {none}").items():
        tags[number] = value
    step = {"SCALE": (1 if float32 else STEP_K, "scale"), "OFFSET": (0, "offset"), "UNITTYPE": ("K", "unittype")}
    items = (f'<Item name="{k}" sample="0" role="{role}">{value}</Item>' for k, (value, role) in step.items())
    tags[42112], tags[42113] = f"<GDALMetadata>{''.join(items)}</GDALMetadata>", none
    tags.tagtype[700] = 1
    tags[700] = _xmp(about).encode()
    with open(path, "wb") as file:
        image.save(file, format="TIFF", tiffinfo=tags)


def _tags(about: dict[str, Any], description: str) -> dict[int, Any]:
    """TIFF, EXIF and GPS tags of a frame, {number: value}; dictionaries are directories of their own."""
    lens, (latitude, longitude, height) = about["lens"], _position(about)
    per_cm = _ratio(1e4 / lens["pixel_pitch_um"])
    exif: dict[int, Any] = {
        33437: _ratio(lens["f_number"]), 36864: b"0232", 37386: _ratio(lens["focal_length_mm"]),
        40962: lens["width"], 40963: lens["height"], 41486: per_cm, 41487: per_cm, 41488: 3,
    }  # fmt: skip
    gps: dict[int, Any] = {
        0: b"\x02\x03\x00\x00", 1: "N" if latitude >= 0.0 else "S", 2: _degrees(latitude),
        3: "E" if longitude >= 0.0 else "W", 4: _degrees(longitude),
        5: b"\x00" if height >= 0.0 else b"\x01", 6: _ratio(abs(height)), 18: "WGS-84",
    }  # fmt: skip
    if about["time"]:
        date, _, clock = about["time"].rstrip("Z").partition("T")
        hour, minute, second = clock.split(":")
        whole, _, fraction = second.partition(".")
        stamp = f"{date.replace('-', ':')} {hour}:{minute}:{whole}"
        exif |= {36867: stamp, 36881: "+00:00", 37521: fraction or "0"}
        gps |= {7: (_ratio(float(hour)), _ratio(float(minute)), _ratio(float(second))), 29: date.replace("-", ":")}
    return {
        270: description, 271: "thermorender", 272: about["camera"], 274: 1,
        305: f"thermorender {versions()['thermorender']}", 34665: exif, 34853: gps,
    }  # fmt: skip


def _position(about: dict[str, Any]) -> tuple[float, float, float]:
    """(latitude, longitude [deg], height above the ellipsoid [m]) of the camera."""
    latitude, longitude, height = _frame(about).geodetic_from_enu(np.array(about["world_from_camera"])[:3, 3])
    return float(latitude), float(longitude), float(height)


def _frame(about: dict[str, Any]) -> LocalFrame:
    return LocalFrame(*(about["place"][name] for name in ("latitude_deg", "longitude_deg", "height_m")))


def _xmp(about: dict[str, Any]) -> str:
    """The XMP packet of a frame, in one line: OpenSfM cannot read it with line ends."""
    latitude, longitude, height = _position(about)
    ecef_from_camera = _frame(about).enu_from_ecef_rotation.T @ np.array(about["world_from_camera"])[:3, :3]
    ned_from_camera = ecef_from_ned(latitude, longitude).inv() * Rotation.from_matrix(ecef_from_camera)
    nadir = angles_from_rotation(ned_from_camera * Rotation.from_matrix(_BODY_FROM_NADIR).inv())
    gimbal = angles_from_rotation(ned_from_camera * Rotation.from_matrix(BODY_FROM_CAMERA).inv())
    lens, pitch_mm = about["lens"], about["lens"]["pixel_pitch_um"] * 1e-3
    middle = (
        0.5 * lens[side] + off for side, off in zip(("width", "height"), lens["principal_offset_px"], strict=True)
    )
    k1, k2, p1, p2, k3 = lens["distortion"]
    camera = {
        **dict(zip(("Yaw", "Pitch", "Roll"), (f"{round(angle, 7) + 0.0:.7f}" for angle in nadir), strict=True)),
        "BandName": "LWIR" if lens["band_um"][1] > _MIDWAVE_UM else "MWIR",
        "HorizCS": "EPSG:4326", "VertCS": "ellipsoidal",
        "PerspectiveFocalLength": f"{lens['focal_length_mm']:.9g}",
        "PrincipalPoint": ",".join(f"{value * pitch_mm:.9g}" for value in middle),
        "PerspectiveDistortion": ",".join(f"{value:.9g}" for value in (k1, k2, k3, p1, p2)),
    }  # fmt: skip
    drone = dict(zip(("GimbalYawDegree", "GimbalPitchDegree", "GimbalRollDegree"), gimbal, strict=True))
    drone["AbsoluteAltitude"] = height
    spaces = " ".join(f'xmlns:{name}="{address}"' for name, address in _NAMESPACES.items())
    attributes = " ".join(f"Camera:{name}={quoteattr(value)}" for name, value in camera.items())
    elements = "".join(
        f"<drone-dji:{name}>{round(value, 7) + 0.0:+.7f}</drone-dji:{name}>" for name, value in drone.items()
    )
    return (
        f'<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF {spaces}><rdf:Description rdf:about="" {attributes}>{elements}'
        "</rdf:Description></rdf:RDF></x:xmpmeta>"
    )


def _ratio(value: float) -> Any:
    """An EXIF rational of a number from 0 on, with as many decimals as fit into its 32 bits, up to 7."""
    from PIL.TiffImagePlugin import IFDRational

    decimals = 7 if value == 0.0 else max(0, min(7, 8 - math.floor(math.log10(value))))
    return IFDRational(round(value * 10**decimals), 10**decimals)


def _degrees(value: float) -> tuple[Any, Any, Any]:
    """Degrees, minutes and seconds of an angle, as EXIF rationals; the seconds to 1e-7."""
    minutes, rest = divmod(round(abs(value) * 3600e7), 60 * 10**7)
    degrees, minutes = divmod(minutes, 60)
    return _ratio(degrees), _ratio(minutes), _ratio(rest * 1e-7)
