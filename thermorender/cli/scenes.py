"""Verbs that inspect scenes: their materials, their plan."""

from typing import Annotated

import typer

from thermorender import defaults, files
from thermorender.cli.options import SamplingOptions, SceneName, SceneOptions, flat
from thermorender.cli.terminal import Results, progress, split, table


def map_materials(
    scene: SceneName,
    output: Results,
    model: Annotated[
        str | None, typer.Option(help="Emissivity map: a file, or procedural. Default: the scene's, else procedural.")
    ] = None,
    fallback: Annotated[
        str | None, typer.Option(help=f"Material of unknown texels. Default: the scene's, else "
                                 f"{defaults.FALLBACK_MATERIAL}.")
    ] = None,
    confidence: Annotated[
        float | None, typer.Option(help="Texels with a less probable best material are unknown; default: the scene's.")
    ] = None,
    without: Annotated[
        str, typer.Option(help="Comma-separated materials that do not occur, besides those that the scene leaves out.")
    ] = "",
) -> None:  # fmt: skip
    """Write the materials that a learned map finds in a scene's orthophoto, to inspect and correct by hand."""
    from thermorender.scene.load import scene_folder
    from thermorender.scene.material_map import write_map

    with progress() as report, files.output_folder(output) as folder:

        def mapped(share: float) -> None:
            report("mapping the materials", share)

        written, shares, notes = write_map(
            scene_folder(scene), folder, model, fallback, confidence, split(without), mapped
        )
    for note in notes:
        typer.echo(note)
    table(("material", "share"), [(name, f"{share:.1%}") for name, share in shares.items()])
    for path in written.values():
        typer.echo(str(path))


@flat
def plan(scene: SceneName, *, sampling: SamplingOptions, situation: SceneOptions) -> None:
    """Print the rendering steps of a scene, which are skipped, and what each skipped step costs in mK."""
    from thermorender.render.plan import make_plan
    from thermorender.render.quality import Sampling
    from thermorender.sensor.schedule import plan_row

    with progress() as report:
        loaded = situation.load(scene, progress=report)
        if loaded.temperature_state.solved:
            report("choosing the spectral nodes", 0.0)
            made = make_plan(loaded, Sampling.of(**sampling.settings()))
        else:
            # The plan depends on the temperatures.
            renderer = sampling.renderer(loaded, 0, "auto", report)
            loaded, made = renderer.scene, renderer.plan
    typer.echo(str(loaded))
    table(("item", "in", "why"), [*made.rows(), plan_row(loaded.camera)])
