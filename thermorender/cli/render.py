"""Verbs that render frames: one frame, a flight, a day."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from thermorender import defaults, files, formats
from thermorender.cli.options import (
    Air,
    Device,
    DisplayOptions,
    Products,
    SamplingOptions,
    SceneName,
    SceneOptions,
    Seed,
    TemperatureOptions,
    Thermography,
    TrajectoryOptions,
    ViewOptions,
    flat,
    parse_thermography,
    print_cache_note,
    profiled,
)
from thermorender.cli.terminal import NewResults, Results, output_option, progress, split, warn
from thermorender.cli.workers import ClusterOptions
from thermorender.errors import ThermorenderError
from thermorender.timing import phase, profile_entry

if TYPE_CHECKING:
    from thermorender.frame import Frame
    from thermorender.output.flight_pages.cost import Cost
    from thermorender.output.flight_pages.prospect import Prospect
    from thermorender.scene.scene import Scene

# A texel this many pixels wide makes a frame look blurred.
_COARSE_PX = 12.0


@profiled
@flat
def render(
    scene: SceneName,
    output: Results,
    *,
    view: ViewOptions,
    situation: SceneOptions,
    products: Products = "exr,truth,counts,display",
    look: DisplayOptions,
    thermography: Thermography = None,
    source: TemperatureOptions,
    seed: Seed = 0,
    engine: Annotated[
        str, typer.Option(help="renderer, or reference: slow path tracing by stock Mitsuba.")
    ] = "renderer",
    paths: Annotated[int, typer.Option(help="Paths per pixel of the reference engine.")] = 64,
    sampling: SamplingOptions,
    device: Device = "auto",
) -> None:
    """Render one frame."""
    with phase("imports"):
        from thermorender.frame.record import record
        from thermorender.output import products as frame_files
        from thermorender.output.photograph import photograph
        from thermorender.output.provenance import made_by, weather_of
        from thermorender.render.air import refuse_camera

    if engine not in ("renderer", "reference"):
        raise ThermorenderError(f"--engine={engine!r} is unknown; give renderer or reference")
    if paths < 1:
        raise ThermorenderError(f"--paths={paths} is not allowed; give at least 1 path per pixel")
    if (output / "flight.json").exists():
        raise ThermorenderError(f"{output} holds a flight, whose first frame would be overwritten; give another folder")
    display, settings = look.settings(), parse_thermography(thermography)
    wanted = frame_files.check(split(products), settings)
    # A wrong pose is refused before the scene is loaded.
    view.numbers()
    with progress() as report:
        loaded = situation.load(scene, source.source(), progress=report)
        wanted = frame_files.check(wanted, settings, loaded.camera)
        world_from_camera = view.over(loaded)
        refuse_camera(loaded, world_from_camera[:3, 3])
        renderer = sampling.renderer(loaded, seed, device, report)
        with files.output_folder(output) as folder:
            if engine == "renderer":
                with phase("frame: radiance"):
                    frame = renderer.frame(world_from_camera)
            else:
                from thermorender.render.reference import frame as reference_frame

                frame = reference_frame(
                    renderer, world_from_camera, paths, progress=lambda share: report("tracing paths", share)
                )
            display = replace(display, tails_percent=frame.camera.agc_tails_percent)
            with phase("frame: sensor, truth and files"):
                written = frame_files.write(
                    folder, frame, wanted, display.image(frame.counts)[1], settings,
                    lambda camera: photograph(renderer, frame.pose, camera=camera)[0],
                )  # fmt: skip
            about = {**record(frame), "materials": list(frame.materials), **weather_of(renderer.scene), **made_by()}
            formats.write_json(folder / "frame_000000.json", about | profile_entry())
    print_cache_note(renderer)
    seen = frame.apparent_temperature
    typer.echo(f"apparent temperature {seen.min():.2f}–{seen.max():.2f} K, mean {seen.mean():.2f} K")
    for path in (*written.values(), output / "frame_000000.json"):
        typer.echo(str(path))
    warn(_coarse(renderer.scene, frame))
    warn(_backs(frame))


def _backs(frame: "Frame") -> str | None:
    """A warning if most pixels with a surface see backs of faces, else None."""
    import numpy as np

    from thermorender.output.flight_pages.prospect import backs_warning
    from thermorender.scene.surface import BEHIND

    mask = frame.truth["mask"][np.isfinite(frame.truth["depth"])]
    return backs_warning(float(np.mean((mask & BEHIND) != 0)) if mask.size else 0.0)


def _coarse(scene: "Scene", frame: "Frame") -> str | None:
    """A warning if a texel of the terrain covers many pixels of the frame, else None."""
    import numpy as np

    depth = frame.truth["depth"]
    if not np.isfinite(depth).any():
        return None
    texel, focal = scene.texel_m, frame.camera.focal_length_px
    pixels = texel * focal / float(np.nanmedian(depth))
    if pixels < _COARSE_PX:
        return None
    return (
        f"a texel of {texel:.3g} m is {pixels:.0f} pixels wide in this frame, which looks blurred; fly at about "
        f"{texel * focal:.0f} m or higher, or give a finer orthophoto"
    )


@profiled
@flat
def fly(
    scene: SceneName,
    output: Annotated[
        Path | None, output_option("-o", "--output", help="Folder for the results; --preview can do without.")
    ] = None,
    *,
    log: TrajectoryOptions,
    rate_hz: Annotated[float | None, typer.Option(help="Frames per second; default: the camera's.")] = None,
    situation: SceneOptions,
    products: Products = "exr,truth,counts,display,video,report",
    look: DisplayOptions,
    agc_memory_s: Annotated[
        float, typer.Option(help="Time constant of the gain control; 0: none [s].", rich_help_panel="pictures")
    ] = 0.0,
    thermography: Thermography = None,
    audit: Annotated[
        int,
        typer.Option(
            help="Frames from one measurement of the error budget to the next; 1: every frame.", rich_help_panel="files"
        ),
    ] = defaults.AUDIT,
    exr_compression: Annotated[
        str,
        typer.Option(
            help="rle: fast; zip: a quarter smaller in five times the time; htj2k32: less than half the size in twice "
            "the time, for programs with OpenEXR 3.4 or later; none. All are lossless.",
            rich_help_panel="files",
        ),
    ] = defaults.EXR_COMPRESSION,
    source: TemperatureOptions,
    preview: Annotated[
        bool,
        typer.Option("--preview", help="Only report what the flight will show and cost; with -o also as preview.html."),
    ] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped flight.")] = False,
    verify: Annotated[
        bool,
        typer.Option(
            "--verify",
            help="Continue from the first frame whose files differ from those written.",
            rich_help_panel="files",
        ),
    ] = False,
    cluster: ClusterOptions,
    seed: Seed = 0,
    sampling: SamplingOptions,
    device: Device = "auto",
) -> None:
    """Render the frames of a flight."""
    with phase("imports"):
        from thermorender.output import products as frame_files
        from thermorender.output.flight import FlightOptions
        from thermorender.output.flight import fly as run
        from thermorender.output.flight_pages.flight_preview import preview as foresee
        from thermorender.output.resume import refuse_used

    if output is None and not preview:
        raise ThermorenderError("-o is missing; give the folder for the flight, or --preview to see what it will show")
    if preview and (resume or verify):
        raise ThermorenderError("--preview writes no frames; leave --resume and --verify out")
    cluster.refuse_with(preview, resume or verify)
    if output is not None and not (preview or resume or verify or cluster.frames):
        refuse_used(output)
    settings = parse_thermography(thermography)
    options = FlightOptions(
        rate_hz=rate_hz, start_s=log.start_s, stop_s=log.stop_s, display=look.settings(agc_memory_s),
        products=frame_files.check(split(products), settings, flight=True), thermography=settings,
        audit=audit, exr_compression=exr_compression,
    )  # fmt: skip
    with progress() as report:
        loaded = situation.load(scene, source.source(), progress=report)
        path = log.read(loaded, rate_hz)
        renderer = sampling.renderer(loaded, seed, device, report)
        if preview:
            for written in foresee(renderer, path, options, output, _print_outlook):
                typer.echo(str(written))
            return
        assert output is not None  # Only a preview needs none.
        if cluster.frames:
            typer.echo(cluster.part(renderer, path, output, options))
            return
        if cluster.cluster:
            summary = cluster.run(renderer, path, output, options, report, resume=resume, verify=verify)
        else:
            summary = run(
                renderer, path, output, options, resume=resume, verify=verify, heat_progress=report,
                outlook=_print_outlook,
                progress=lambda done, total: report(f"frame {done} of {total}", done / total),
            )  # fmt: skip
    print_cache_note(renderer)
    typer.echo(f"{summary['frames']} frames, {summary['rendered']} rendered now, in {summary['folder']}")
    if "report" in options.products:
        typer.echo(f"look at {output / 'index.html'}")
    without = summary["frames_without_terrain"]
    if without:
        typer.echo(
            f"{without} of {summary['frames']} frames show no terrain; point the camera with --mount, or move the "
            "flight with --anchor"
        )


def _print_outlook(outlook: "Prospect | Cost") -> None:
    """Print what a flight will show or cost."""
    for line in outlook.lines():
        typer.echo(line)
    warn(outlook.warning)


@flat
def day(
    scene: SceneName,
    output: NewResults,
    *,
    view: ViewOptions,
    time: Annotated[
        str | None,
        typer.Option(help="Date of the local solar day, or an instant of it with its zone. Default: the scene's "
                     "weather.time."),
    ] = None,
    step_min: Annotated[int, typer.Option(help="Minutes between frames, a divisor of the day's 1440.")] = 60,
    products: Products = "exr,truth,counts,display,video",
    look: DisplayOptions,
    thermography: Thermography = None,
    air: Air = None,
    source: TemperatureOptions,
    seed: Seed = 0,
    sampling: SamplingOptions,
    device: Device = "auto",
) -> None:  # fmt: skip
    """Render one view over a day, on one display scale, with a curve of temperature per material."""
    from thermorender.output import products as frame_files
    from thermorender.output.day import day as run
    from thermorender.output.day import instant_of

    display, settings = look.settings(), parse_thermography(thermography)
    wanted = frame_files.check(split(products), settings)
    view.numbers()
    with progress() as report:
        loaded = SceneOptions(time, air).load(scene, source.source(), instant_of, report)
        model = getattr(loaded.temperature_state.source, "model", None)
        if model is not None:
            warn(model.texel_warning(loaded.texel_m))
        rows = run(
            loaded, view.over(loaded), output, step_min, wanted, display, settings, report, device, seed=seed,
            **sampling.settings(),
        )  # fmt: skip
    first, last = rows[0]["time_utc"], rows[-1]["time_utc"]
    typer.echo(f"{len(rows)} frames from {first} to {last}, with day.csv and day.png in {output}")
