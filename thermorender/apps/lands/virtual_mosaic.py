"""The files of a virtual mosaic (.vrt), where it only puts rasters beside one another, as `gdalbuildvrt` does."""

from collections.abc import Iterator
from pathlib import Path
from typing import NoReturn
from xml.etree import ElementTree

from thermorender.errors import ThermorenderError
from thermorender.formats import read_text
from thermorender.scene.raster import grid_of, opened

# Elements of a source that leave its values as they are.
_PLAIN = ("SourceFilename", "SourceBand", "SourceProperties", "SrcRect", "DstRect", "NODATA", "OpenOptions")
# Share of a pixel by which a file's place may differ from that in the mosaic.
_APART = 0.01


def files_of_mosaic(path: Path) -> list[Path]:
    """Return the rasters of a virtual mosaic, in its order; refuse one that changes their values or places."""
    text = read_text(path, "a VRT in UTF-8")
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        _refuse(path, "holds a document type definition")
    try:
        root = ElementTree.fromstring(text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        _refuse(path, f"cannot be read ({error})")
    if root.tag != "VRTDataset" or root.get("subClass"):
        _refuse(path, f"is of the kind {root.get('subClass') or root.tag}")
    corner = [float(each) for each in (root.findtext("GeoTransform") or "").split(",") if each.strip()]
    if len(corner) != 6:
        _refuse(path, "has no GeoTransform")
    stated = root.findtext("SRS")
    found = dict[Path, None]()
    for band in root.iterfind("VRTRasterBand"):
        if band.get("subClass"):
            _refuse(path, f"has a band of the kind {band.get('subClass')}")
        for source in _sources(path, band):
            file = _file_of(path, source, band.get("band", "1"), corner)
            _refuse_other_values(path, band, source, file, stated)
            found[file] = None
    if not found:
        _refuse(path, "names no raster")
    return list(found)


def _sources(path: Path, band: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Yield the sources of a band."""
    for each in band:
        if each.tag in ("SimpleSource", "ComplexSource"):
            yield each
        elif each.tag.endswith("Source"):
            _refuse(path, f"has a {each.tag}")


def _file_of(path: Path, source: ElementTree.Element, band: str, corner: list[float]) -> Path:
    """The file of a source that lies in the mosaic as by itself."""
    changing = [each.tag for each in source if each.tag not in _PLAIN]
    name = source.find("SourceFilename")
    if name is None or not name.text:
        _refuse(path, "has a source without a name")
    if changing:
        _refuse(path, f"changes {name.text} by {changing[0]}")
    if source.findtext("SourceBand", "1") != band:
        _refuse(path, f"takes band {source.findtext('SourceBand')} of {name.text} as band {band}")
    file = Path(name.text)
    file = path.parent / file if name.get("relativeToVRT") == "1" else file
    if not file.is_file():
        raise ThermorenderError(f"{path} names {name.text}, which does not exist; make the mosaic again")
    own, rectangle = grid_of(file, any_size=True), source.find("DstRect")
    if rectangle is not None:
        column, row, width, height = (float(rectangle.get(each, "nan")) for each in ("xOff", "yOff", "xSize", "ySize"))
        x, y = corner[0] + corner[1] * column, corner[3] + corner[5] * row
        size = own.width * own.transform.a / corner[1], own.height * own.transform.e / corner[5]
        apart = [(x - own.transform.c) / corner[1], (y - own.transform.f) / corner[5], width - size[0],
                 height - size[1]]  # fmt: skip
        if not all(abs(each) < _APART for each in apart):
            _refuse(path, f"moves or cuts {name.text}")
    return file


def _refuse_other_values(
    path: Path, band: ElementTree.Element, source: ElementTree.Element, file: Path, crs: str | None
) -> None:  # fmt: skip
    """Refuse another CRS, no-data value, scale, offset or unit than the file states itself."""
    from rasterio.crs import CRS

    number = int(source.findtext("SourceBand", "1")) - 1
    with opened(file, any_size=True) as own:
        if crs and CRS.from_string(crs) != own.crs:
            _refuse(path, f"states another CRS than {file.name} has")
        known = {"NODATA": own.nodatavals[number], "NoDataValue": own.nodatavals[number], "Scale": own.scales[number],
                 "Offset": own.offsets[number], "UnitType": own.units[number]}  # fmt: skip
    for name, value in known.items():
        for stated in (source.findtext(name), band.findtext(name)):
            if stated is not None and not _equal(stated.strip(), value):
                _refuse(path, f"states {name} = {stated.strip()} where {file.name} has {value}")


def _equal(stated: str, value: float | str | None) -> bool:
    """Whether a text states a value; NaN is NaN."""
    try:
        number = float(stated)
    except ValueError:
        return stated == (value or "")
    if not isinstance(value, int | float):
        return False
    return number == value or abs(number - value) <= 1e-6 * abs(value) or (number != number and value != value)


def _refuse(path: Path, why: str) -> NoReturn:
    raise ThermorenderError(f"{path} {why}, and only rasters beside one another are taken; give their folder instead")
