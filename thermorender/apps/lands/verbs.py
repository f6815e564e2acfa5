"""Verbs that make scenes: from terrain, and from a seed."""

from pathlib import Path
from typing import Annotated, Any

import typer

from thermorender import defaults, files
from thermorender.apps.lands.import_settings import ImportSettings, ThreeD
from thermorender.cli.options import SCENE_NAMES, flat
from thermorender.cli.terminal import output_option, progress, warn
from thermorender.errors import ThermorenderError

NewFolder = Annotated[
    Path, output_option("-o", "--output", help="Folder to make for the scene.", check=files.check_new_folder)
]


@flat
def import_terrain(
    elevation: Annotated[
        Path, typer.Argument(help="GeoTIFF of heights in metres or the unit it declares, or LAS; with --tiles also a "
                             "folder or a VRT.")
    ],
    output: NewFolder,
    orthophoto: Annotated[
        Path | None, typer.Argument(help="GeoTIFF in colour; without one the ground has its material's colour.")
    ] = None,
    *,
    settings: ImportSettings,
    three_d: Annotated[
        bool, typer.Option("--three-d", help="Make a mesh: walls below the roofs, porous trees; posts of 1 m or less.")
    ] = False,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="Leave the rasters as they are, of any size or in folders; flights read "
                           "the tiles that they see.")
    ] = False,
    solids: ThreeD,
) -> None:  # fmt: skip
    """Make a scene from an elevation model and an orthophoto, or from an elevation model alone."""
    from thermorender import load_camera
    from thermorender.apps.lands.import_terrain import import_terrain as run

    if not three_d and solids != ThreeD():
        raise ThermorenderError(
            "--ground, --wall and --building-class are for scenes in three dimensions; give --three-d too"
        )
    if tiles:
        _of_tiles(elevation, orthophoto, output, settings, three_d)
        return
    with progress() as report:
        summary = run(elevation, orthophoto, output, settings, solids if three_d else None, report)
    typer.echo(f"{output}: {summary['posts'][1]}×{summary['posts'][0]} posts of {summary['post_m']:.3g} m, "
               f"{summary['texels'][1]}×{summary['texels'][0]} texels of {summary['texel_m']:.3g} m; "
               f"{summary['share_without_height']:.1%} without height, "
               + (f"{summary['share_filled']:.1%} filled, " if settings.fill else "") +
               (f"{summary['share_without_colour']:.1%} without colour; " if orthophoto else "no orthophoto; ") +
               f"heights above the {summary['height_reference']}"
               + ("" if summary["height_reference_stated"] else
                  " (assumed, as the CRS does not say; --height-reference geoid changes it)"))  # fmt: skip
    for number, (count, post_m, coloured) in enumerate(summary["far"], 1):
        typer.echo(f"far ground {number}: {count[1]}×{count[0]} posts of {post_m:.3g} m, "
                   + ("with an orthophoto" if coloured else "with the material of unknown texels"))  # fmt: skip
    warn(_of_import(summary, settings))
    for note in summary["known"]:
        typer.echo(note)
    if three_d:
        typer.echo(_solid_words(summary, solids.walls()[0]))
    typer.echo(_temperatures(settings, orthophoto is not None, three_d))
    typer.echo(
        f"flight.csv flies along the middle, {summary['flight_m']:.0f} m above the ground; a texel covers one pixel of "
        f"the {defaults.CAMERA} from {summary['texel_m'] * load_camera(defaults.CAMERA).focal_length_px:.0f} m"
    )


def _of_tiles(
    elevation: Path, orthophoto: Path | None, output: Path, settings: ImportSettings, three_d: bool
) -> None:  # fmt: skip
    """Make a scene of tiles and say what it has."""
    from thermorender.apps.lands.import_tiles import import_tiles

    if three_d or orthophoto is None:
        why = "makes one mesh of its files" if three_d else "is missing: its pixels are the texels of tiles"
        raise ThermorenderError(
            f"--tiles: {'--three-d' if three_d else 'the orthophoto'} {why}; "
            + ("leave one of the two out" if three_d else "give one, or leave --tiles out")
        )
    made = import_tiles(elevation, orthophoto, output, settings)
    across, along = made["side_m"]
    typer.echo(f"{output}: {across / 1e3:.3g} × {along / 1e3:.3g} km, posts of {made['post_m']:.3g} m, texels of "
               f"{made['texel_m']:.3g} m, {made['levels']} levels of tiles; heights above the "
               f"{made['height_reference']}"
               + ("" if made["height_reference_stated"] else
                  " (assumed, as the CRS does not say; --height-reference geoid changes it)"))  # fmt: skip
    kind = (
        "a placeholder; give --weather FILE --time T for a heat balance"
        if settings.weather is None
        else (f"a heat balance at {settings.time}")
    )
    typer.echo(f"temperatures: {kind}; materials are {settings.material} everywhere until terrain.tiles.classes names "
               f"others; flight.csv flies over the middle, {made['flight_m']:.0f} m above the ground")  # fmt: skip


def _solid_words(summary: dict[str, Any], wall: str) -> str:
    """A sentence on what an import in three dimensions has found."""
    stated, unmatched = summary["stated_walls"], summary["unmatched"]
    words = [f"{summary['buildings']} buildings with walls of {wall}"
             + (f" ({stated} as their outlines declare)" if stated else "")
             + f", {summary['trees']} trees"
             + "; walls, trunks and leaves are inferred from heights"]  # fmt: skip
    if summary["flat_outlines"]:
        words.append(f"{summary['flat_outlines']} outlines left out, less than a third of each is high")
    if unmatched:
        listed = ", ".join(f"{count} {name}" for name, count in unmatched.items())
        words.append(f"declared walls without a match have the usual material or colour: {listed}")
    return "; ".join(words)


def _temperatures(settings: ImportSettings, pictured: bool, three_d: bool) -> str:
    """A sentence on the temperatures of an imported scene."""
    if settings.weather is None:
        source = (
            f"the learned map {settings.model!r}, which knows colour only" if pictured else "one for all of the ground"
        )
        return (
            f"temperatures are a placeholder, {source}: they are not those of this place at any hour; give --weather "
            "FILE --time T for a heat balance, or a raster of kelvin"
        )
    shown = "" if three_d else "; map-materials shows them"
    kind = f"read from the orthophoto{shown}" if pictured else f"{settings.material} everywhere"
    return f"temperatures: a heat balance at {settings.time}; materials are {kind}"


def _of_import(summary: dict[str, Any], settings: ImportSettings) -> str | None:
    """A sentence on the colours of an imported orthophoto that may be wrong, else None."""
    from thermorender.scene.orthophoto import COLLAR

    found = []
    if summary["share_collar"] and not settings.collar:
        found.append(f"{_percent(summary['share_collar'])} of the orthophoto is near black or white up to its edge and "
                     f"taken for ground; --collar={COLLAR} leaves it out")  # fmt: skip
    if settings.colour_range is not None and summary["share_clipped"]:
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
    draped: Annotated[
        bool, typer.Option("--draped", help="Rasters alone, a photograph over heights: no walls, no porous crowns.")
    ] = False,
) -> None:  # fmt: skip
    """Make a procedural scene from a seed, under a weather, with known temperatures; its survey from above in
    survey/.
    """
    from thermorender.apps.lands.procedural.make_scene import make_scene as run
    from thermorender.apps.lands.procedural.procedural_scene import weather_of

    weather = weather_of(
        kind, weather_seed, time=time, air_low_c=air_low_c, air_high_c=air_high_c, humidity=humidity,
        wind_m_s=wind_m_s, cloud=cloud, snow_depth_m=snow_depth_m,
    )  # fmt: skip
    with progress() as report:
        folder = run(kind, output, seed, size_m, texel_m, post_m, weather, draped, report)
    typer.echo(str(folder))
