"""The files of a virtual mosaic (.vrt), where it only puts rasters beside one another, as `gdalbuildvrt` does."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.formats import xml_root
from thermorender.scene.raster import FORMATS, opened

# Elements of a source that leave its values as they are.
_PLAIN = ("SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect", "NODATA", "OpenOptions")
# Share of a pixel by which a file's corners may be apart from those in the mosaic.
_APART = 0.01
# GDAL's names of NumPy's types.
_TYPES = {"uint8": "Byte", "int8": "Int8", "uint16": "UInt16", "int16": "Int16", "uint32": "UInt32", "int32": "Int32",
          "float32": "Float32", "float64": "Float64"}  # fmt: skip


def files_of_mosaic(path: Path) -> list[Path]:
    """Return the rasters of a virtual mosaic, in its order; refuse one that says more than where they lie."""
    from rasterio.errors import CRSError

    root = xml_root(path, "a VRT", "make the mosaic again")
    try:
        return _files(path, root)
    except ThermorenderError:
        raise
    except (CRSError, ValueError, LookupError, ArithmeticError) as error:
        _refuse(path, f"is damaged ({error})")


def _files(path: Path, root: ElementTree.Element) -> list[Path]:
    if root.tag != "VRTDataset" or root.get("subClass"):
        _refuse(path, f"is of the kind {root.get('subClass') or root.tag}")
    bands = root.findall("VRTRasterBand")
    if root.find("MaskBand") is not None or any(band.find("MaskBand") is not None for band in bands):
        _refuse(path, "has a mask of its own")
    found = dict[Path, set[str]]()
    for band in bands:
        if band.get("subClass"):
            _refuse(path, f"has a band of the kind {band.get('subClass')}")
        for source in _sources(path, band):
            file = _file_of(path, source)
            _refuse_changes(path, root, band, source, file)
            found.setdefault(file, set()).add(band.get("band", "1"))
    if not found:
        _refuse(path, "names no raster")
    for file, numbers in found.items():
        with opened(file, any_size=True) as own:
            if len(numbers) != own.count:
                _refuse(path, f"takes {len(numbers)} of the {own.count} bands of {file.name}")
    return list(found)


def _sources(path: Path, band: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Yield the sources of a band."""
    for each in band:
        if each.tag in ("SimpleSource", "ComplexSource"):
            yield each
        elif each.tag.endswith("Source"):
            _refuse(path, f"has a {each.tag}")


def _file_of(path: Path, source: ElementTree.Element) -> Path:
    """The file of a source."""
    name = source.find("SourceFilename")
    if name is None or not name.text:
        _refuse(path, "has a source without a name")
    file = Path(name.text)
    file = path.parent / file if name.get("relativeToVRT") == "1" else file
    if not file.is_file():
        raise ThermorenderError(
            f"{path} names {name.text}, which is not a file on disk; make the mosaic again of files on disk"
        )
    if file.suffix.lower() not in FORMATS:
        _refuse(path, f"names {name.text}, which is not of {', '.join(FORMATS)}")
    return file


def _refuse_changes(
    path: Path, root: ElementTree.Element, band: ElementTree.Element, source: ElementTree.Element, file: Path
) -> None:  # fmt: skip
    """Refuse a source that has another place or other values than its file."""
    from rasterio.crs import CRS

    changing = [each.tag for each in source if each.tag not in _PLAIN]
    if changing:
        _refuse(path, f"changes {file.name} by {changing[0]}")
    if source.findtext("SourceBand", "1") != band.get("band", "1"):
        _refuse(path, f"takes band {source.findtext('SourceBand')} of {file.name} as band {band.get('band')}")
    number, crs = int(band.get("band", "1")) - 1, root.findtext("SRS")
    with opened(file, any_size=True) as own:
        if crs and CRS.from_string(crs) != own.crs:
            _refuse(path, f"states another CRS than {file.name} has")
        if not _in_place(root, source, own):
            _refuse(path, f"moves, cuts or turns {file.name}")
        known = {
            "NODATA": own.nodatavals[number], "NoDataValue": own.nodatavals[number], "Scale": own.scales[number],
            "Offset": own.offsets[number], "UnitType": own.units[number], "ColorInterp": own.colorinterp[number].name,
        }  # fmt: skip
        kind = _TYPES.get(own.dtypes[number])
    if band.get("dataType", "Byte") != kind:
        _refuse(path, f"states the type {band.get('dataType', 'Byte')} where {file.name} has {kind}")
    for name, value in known.items():
        for stated in (source.findtext(name), band.findtext(name)):
            if stated is not None and not _equal(stated.strip(), value):
                _refuse(path, f"states {name} = {stated.strip()} where {file.name} has {value}")


def _in_place(root: ElementTree.Element, source: ElementTree.Element, own: Any) -> bool:
    """Whether the whole of an open file lies in the mosaic where it lies by itself."""
    whole = source.find("SrcRect")
    if whole is not None and _rectangle(whole).tolist() != [0.0, 0.0, own.width, own.height]:
        return False
    x, a, b, y, d, e = (float(each) for each in root.findtext("GeoTransform", "").split(","))
    place = source.find("DstRect")
    left, top, width, height = (
        np.array([0.0, 0.0, float(root.get("rasterXSize", "nan")), float(root.get("rasterYSize", "nan"))])
        if place is None
        else _rectangle(place)
    )
    share = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    column, row = (share * [width, height] + [left, top]).T
    there = np.stack([x + a * column + b * row, y + d * column + e * row])
    column, row = (share * [own.width, own.height]).T
    t = own.transform
    here = np.stack([t.c + t.a * column + t.b * row, t.f + t.d * column + t.e * row])
    return bool((np.abs(there - here) < _APART * np.hypot(t.a, t.d)).all())


def _rectangle(element: ElementTree.Element) -> NDArray[np.float64]:
    """Left, top, width and height."""
    return np.array([float(element.get(name, "nan")) for name in ("xOff", "yOff", "xSize", "ySize")])


def _equal(stated: str, value: float | str | None) -> bool:
    """Whether a text states a value; NaN is NaN."""
    try:
        number = float(stated)
    except ValueError:
        return stated.lower() == (value or "")
    if not isinstance(value, int | float):
        return False
    return number == value or abs(number - value) <= 1e-6 * abs(value) or (number != number and value != value)


def _refuse(path: Path, why: str) -> NoReturn:
    raise ThermorenderError(f"{path} {why}, and only rasters beside one another are taken; give their folder instead")
