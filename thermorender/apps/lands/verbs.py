"""Verbs that make scenes: from terrain, and from a seed."""

from pathlib import Path
from typing import Annotated, Any

import typer

from thermorender import defaults, files
from thermorender.cli.options import SCENE_NAMES
from thermorender.cli.terminal import output_option, progress, warn
from thermorender.errors import ThermorenderError

NewFolder = Annotated[
    Path, output_option("-o", "--output", help="Folder to make for the scene.", check=files.check_new_folder)
]


def import_terrain(
    elevation: Annotated[Path, typer.Argument(help="GeoTIFF of heights in metres or the unit it declares, or LAS.")],
    output: NewFolder,
    orthophoto: Annotated[
        Path | None, typer.Argument(help="GeoTIFF in colour; without one the ground has its material's colour.")
    ] = None,
    max_vertices: Annotated[int, typer.Option(help="Most posts of the mesh.")] = 4_000_000,
    max_texels: Annotated[int, typer.Option(help="Most texels along a side of the texture.")] = 8192,
    height_reference: Annotated[
        str | None, typer.Option(help="ellipsoid or geoid; default: as the CRS says.")
    ] = None,
    geoid_undulation_m: Annotated[float | None, typer.Option(help="Geoid above ellipsoid there [m].")] = None,
    model: Annotated[str, typer.Option(help="Learned map, without a weather.")] = defaults.TEMPERATURE_MAP,
    material: Annotated[
        str, typer.Option(help="Material of the ground; with a weather and an orthophoto, of unknown texels.")
    ] = "soil_loam",
    sky_temperature: Annotated[
        float | None, typer.Option(help="[K]; default: the weather's sky, or 255 without one.")
    ] = None,
    fill: Annotated[bool, typer.Option("--fill", help="Fill small gaps in the heights from around.")] = False,
    bands: Annotated[
        str | None, typer.Option(help="RED,GREEN,BLUE: numbers of the orthophoto's bands; default: as it declares.")
    ] = None,
    colour_range: Annotated[
        str | None, typer.Option(help="BLACK,WHITE: values of an orthophoto of other than 8 bits.")
    ] = None,
    collar: Annotated[
        int, typer.Option(help="Leave out borders of the orthophoto within these levels of black or white.")
    ] = 0,
    weather: Annotated[
        Path | None, typer.Option(help="Station CSV, EPW or TMY3 file for a heat balance at --time.")
    ] = None,
    time: Annotated[str | None, typer.Option(help="Date and hour with their zone, 2018-07-28T14:30Z.")] = None,
    known: Annotated[
        Path | None, typer.Option(help="GeoJSON of OpenStreetMap shapes that restrict the materials inside them; with "
                                  "--three-d the outlines of buildings.")
    ] = None,
    three_d: Annotated[
        bool, typer.Option("--three-d", help="Make a mesh: walls below the roofs, porous trees; posts of 1 m or less.")
    ] = False,
    ground: Annotated[
        Path | None, typer.Option(help="With --three-d: GeoTIFF of the ground's heights; default: filtered.")
    ] = None,
    wall: Annotated[
        list[str] | None, typer.Option(help="With --three-d: material of walls, or KIND=MATERIAL of the buildings with "
                                       "the tag building=KIND; may be repeated.")
    ] = None,
    building_class: Annotated[
        int | None, typer.Option(help="With --three-d: number of buildings, where --known is a raster of classes.")
    ] = None,
    copies: Annotated[
        bool, typer.Option("--copies", help="With --three-d and --weather: trees are copies of at most 16 typical "
                           "ones, for woods of thousands of trees.")
    ] = False,
) -> None:  # fmt: skip
    """Make a scene from an elevation model and an orthophoto, or from an elevation model alone."""
    from thermorender.apps.lands.import_terrain import import_terrain as run
    from thermorender.apps.lands.solids.importing import ThreeD
    from thermorender.numbers import parse_numbers
    from thermorender.sensor.camera import load_camera

    if height_reference not in (None, "ellipsoid", "geoid"):
        raise ThermorenderError(f"--height-reference={height_reference!r} is not allowed; give ellipsoid or geoid")
    if not three_d and (ground is not None or wall or building_class is not None or copies):
        raise ThermorenderError(
            "--ground, --wall, --building-class and --copies are for scenes in three dimensions; give --three-d too"
        )
    solids = ThreeD(ground, *_walls(wall or []), building_class, copies) if three_d else None
    chosen = [int(value) for value in parse_numbers("--bands", bands, ("RED", "GREEN", "BLUE"))] if bands else None
    ends = parse_numbers("--colour-range", colour_range, ("BLACK", "WHITE")) if colour_range else None
    summary = run(elevation, orthophoto, output, max_vertices, max_texels, height_reference, geoid_undulation_m, model,
                  material, sky_temperature, fill, chosen, ends, collar, weather, time, known, solids)  # fmt: skip
    typer.echo(f"{output}: {summary['posts'][1]}×{summary['posts'][0]} posts of {summary['post_m']:.3g} m, "
               f"{summary['texels'][1]}×{summary['texels'][0]} texels of {summary['texel_m']:.3g} m; "
               f"{summary['share_without_height']:.1%} without height, "
               + (f"{summary['share_filled']:.1%} filled, " if fill else "") +
               (f"{summary['share_without_colour']:.1%} without colour; " if orthophoto else "no orthophoto; ") +
               f"heights above the {summary['height_reference']}"
               + ("" if summary["height_reference_stated"] else
                  " (assumed, as the CRS does not say; --height-reference geoid changes it)"))  # fmt: skip
    warn(_of_import(summary, collar, colour_range is not None))
    for note in summary["known"]:
        typer.echo(note)
    if solids:
        typer.echo(_solid_words(summary, solids.wall))
    typer.echo(_temperatures(weather, time, model, material, orthophoto is not None))
    typer.echo(
        f"flight.csv flies along the middle, {summary['flight_m']:.0f} m above the ground; a texel covers one pixel of "
        f"the {defaults.CAMERA} from {summary['texel_m'] * load_camera(defaults.CAMERA).focal_length_px:.0f} m"
    )


def _walls(given: list[str]) -> tuple[str, dict[str, str]]:
    """(Usual material, {kind of building: material}) of --wall."""
    from thermorender.apps.lands.solids.importing import WALL

    pairs = [each.split("=", 1) for each in given]
    usual = [each[0] for each in pairs if len(each) == 1]
    if len(usual) > 1:
        raise ThermorenderError(
            f"--wall has the materials {', '.join(usual)}; give one, and others as --wall KIND=MATERIAL"
        )
    return usual[0] if usual else WALL, {each[0]: each[1] for each in pairs if len(each) == 2}


def _solid_words(summary: dict[str, Any], wall: str) -> str:
    """A sentence on what an import in three dimensions has found."""
    stated, unmatched = summary["stated_walls"], summary["unmatched"]
    words = [f"{summary['buildings']} buildings with walls of {wall}"
             + (f" ({stated} as their outlines declare)" if stated else "")
             + f", {summary['trees']} trees"
             + (f" as copies of {summary['kinds']} typical ones" if summary["kinds"] else "")
             + "; walls, trunks and leaves are inferred from heights"]  # fmt: skip
    if summary["flat_outlines"]:
        words.append(f"{summary['flat_outlines']} outlines left out, less than a third of each is high")
    if unmatched:
        listed = ", ".join(f"{count} {name}" for name, count in unmatched.items())
        words.append(f"declared walls without a match have the usual material or colour: {listed}")
    return "; ".join(words)


def _temperatures(weather: Path | None, time: str | None, model: str, material: str, pictured: bool) -> str:
    """A sentence on the temperatures of an imported scene."""
    if weather is None:
        source = f"the learned map {model!r}, which knows colour only" if pictured else "one for all of the ground"
        return (
            f"temperatures are a placeholder, {source}: they are not those of this place at any hour; give --weather "
            "FILE --time T for a heat balance, or a raster of kelvin"
        )
    kind = "read from the orthophoto; map-materials shows them" if pictured else f"{material} everywhere"
    return f"temperatures: a heat balance at {time}; materials are {kind}"


def _of_import(summary: dict[str, Any], collar: int, scaled: bool) -> str | None:
    """A sentence on the colours of an imported orthophoto that may be wrong, else None."""
    from thermorender.scene.orthophoto import COLLAR

    found = []
    if summary["share_collar"] and not collar:
        found.append(f"{_percent(summary['share_collar'])} of the orthophoto is near black or white up to its edge and "
                     f"taken for ground; --collar={COLLAR} leaves it out")  # fmt: skip
    if scaled and summary["share_clipped"]:
        found.append(f"{_percent(summary['share_clipped'])} of the orthophoto is black or white in a band; "
                     "--colour-range sets these ends")  # fmt: skip
    return "; ".join(found) or None


def _percent(share: float) -> str:
    """Return a share above 0 in per cent, never as 0.0%."""
    return "less than 0.1%" if share < 0.001 else f"{share:.1%}"


def make_scene(
    kind: Annotated[str, typer.Argument(help=f"One of {SCENE_NAMES}.")],
    output: NewFolder,
    seed: Annotated[int, typer.Option(help="Another seed makes another landscape.")] = 0,
    size_m: Annotated[float | None, typer.Option(help="Side of the square [m].")] = None,
    texel_m: Annotated[float | None, typer.Option(help="Side of an orthophoto texel [m].")] = None,
    post_m: Annotated[float | None, typer.Option(help="Distance of elevation posts [m].")] = None,
    time: Annotated[
        str | None, typer.Option(help="Date and hour with their zone, 2018-07-28T14:30Z. Default: the kind's own.")
    ] = None,
    air_low_c: Annotated[float | None, typer.Option(help="The day's lowest air temperature [°C].")] = None,
    air_high_c: Annotated[float | None, typer.Option(help="The day's highest air temperature [°C].")] = None,
    humidity: Annotated[float | None, typer.Option(help="Relative, 0…1, at the lowest air temperature.")] = None,
    wind_m_s: Annotated[float | None, typer.Option(help="Wind at 10 m [m/s].")] = None,
    cloud: Annotated[float | None, typer.Option(help="Share of the sky, 0…1.")] = None,
    snow_depth_m: Annotated[float | None, typer.Option(help="Snow on the ground [m].")] = None,
    weather_seed: Annotated[
        int | None,
        typer.Option(help="Draws date, hour, snow, cloud, wind and air from a seed; options given here take "
                     "precedence."),
    ] = None,
    three_d: Annotated[
        bool, typer.Option("--three-d", help="With walls and porous crowns; a survey of them from above in survey/.")
    ] = False,
) -> None:  # fmt: skip
    """Make a procedural scene from a seed, under a weather, with known temperatures."""
    from thermorender.apps.lands.procedural.procedural_scene import make, weather_of
    from thermorender.apps.lands.procedural.truth import write

    weather = weather_of(
        kind, weather_seed, time=time, air_low_c=air_low_c, air_high_c=air_high_c, humidity=humidity,
        wind_m_s=wind_m_s, cloud=cloud, snow_depth_m=snow_depth_m,
    )  # fmt: skip
    with progress() as report:
        report("making the landscape", 0.0)
        if three_d:
            from thermorender.apps.lands.procedural.three_d import write as write_world
            from thermorender.apps.lands.procedural.world import make_world

            world = make_world(kind, seed, size_m, texel_m, post_m, weather=weather)
            folder = write_world(world, output, progress=report)
        else:
            folder = write(make(kind, seed, size_m, texel_m, post_m, weather=weather), output, progress=report)
    typer.echo(str(folder))
