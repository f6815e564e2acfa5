"""What an import makes of its files: dataclasses that Python fills by name, and the command line by its options."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults
from thermorender.errors import ThermorenderError

# Material of walls that nothing else declares.
WALL = "brick_painted"


@dataclass(frozen=True)
class ImportSettings:
    """The limits, the levels, the colours and the temperatures of an imported scene."""

    max_vertices: Annotated[int, typer.Option(help="Most posts of the mesh.")] = 4_000_000
    max_texels: Annotated[int, typer.Option(help="Most texels along a side of the texture.")] = 8192
    texel_m: Annotated[
        float | None, typer.Option(help="Least side of a texel [m]; default: the orthophoto's pixels.")
    ] = None
    crs: Annotated[
        str | None, typer.Option(help="Coordinate reference system of files that declare none, such as EPSG:25833.")
    ] = None
    height_reference: Annotated[str | None, typer.Option(help="ellipsoid or geoid; default: as the CRS says.")] = None
    geoid_undulation_m: Annotated[float | None, typer.Option(help="Geoid above ellipsoid there [m].")] = None
    model: Annotated[str, typer.Option(help="Learned map, without a weather.")] = defaults.TEMPERATURE_MAP
    material: Annotated[
        str, typer.Option(help="Material of the ground; with a weather and an orthophoto, of unknown texels.")
    ] = "soil_loam"
    sky_temperature: Annotated[
        float | None, typer.Option(help="[K]; default: the weather's sky, or 255 without one.")
    ] = None
    fill: Annotated[bool, typer.Option("--fill", help="Fill small gaps in the heights from around.")] = False
    bands: Annotated[
        str | None, typer.Option(help="RED,GREEN,BLUE: numbers of the orthophoto's bands; default: as it declares.")
    ] = None
    colour_range: Annotated[
        str | None, typer.Option(help="BLACK,WHITE: values of an orthophoto of other than 8 bits.")
    ] = None
    collar: Annotated[
        int, typer.Option(help="Leave out borders of the orthophoto within these levels of black or white.")
    ] = 0
    weather: Annotated[
        Path | None, typer.Option(help="Station CSV, EPW or TMY3 file for a heat balance at --time.")
    ] = None
    time: Annotated[str | None, typer.Option(help="Date and hour with their zone, 2018-07-28T14:30Z.")] = None
    known: Annotated[
        Path | None, typer.Option(help="GeoJSON of OpenStreetMap shapes that restrict the materials inside them; with "
                                  "--three-d the outlines of buildings.")
    ] = None  # fmt: skip
    around: Annotated[
        str | None, typer.Option(help="LATITUDE,LONGITUDE,SIDE: only a square of the files [°, m], which may have any "
                                 "size.")
    ] = None  # fmt: skip
    far: Annotated[
        list[str] | None, typer.Option(help="DEM.tif or DEM.tif,ORTHO.tif of a wider area, for coarser ground around "
                                       "the scene; may be repeated, from the inner to the outer one.")
    ] = None  # fmt: skip


@dataclass(frozen=True)
class ThreeD:
    """How a surface model becomes a mesh with walls below its roofs and porous trees."""

    ground: Annotated[
        Path | None, typer.Option(help="With --three-d: GeoTIFF of the ground's heights; default: filtered.")
    ] = None
    wall: Annotated[
        list[str] | None, typer.Option(help="With --three-d: material of walls, or KIND=MATERIAL of the buildings with "
                                       "the tag building=KIND; may be repeated.")
    ] = None  # fmt: skip
    building_class: Annotated[
        int | None, typer.Option(help="With --three-d: number of buildings, where --known is a raster of classes.")
    ] = None

    def walls(self) -> tuple[str, dict[str, str]]:
        """Return (material of walls that the outlines do not declare, {value of the tag `building`: material})."""
        pairs = [each.split("=", 1) for each in self.wall or ()]
        usual = [each[0] for each in pairs if len(each) == 1]
        if len(usual) > 1:
            raise ThermorenderError(f"wall has the materials {', '.join(usual)}; give one, and others as KIND=MATERIAL")
        return usual[0] if usual else WALL, {each[0]: each[1] for each in pairs if len(each) == 2}
