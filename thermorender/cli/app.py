"""The command line: one verb per job; it parses, calls and prints."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from thermorender import defaults, files
from thermorender.cli.camera import fit_camera
from thermorender.cli.maps import dataset, evaluate, prepare, train, translate
from thermorender.cli.materials import app as materials
from thermorender.cli.process import run as run_app
from thermorender.cli.terminal import Time, at_time, named, output_option, progress, split, table
from thermorender.cli.terminal import air as parse_air
from thermorender.errors import ThermorenderError

app = typer.Typer(
    help="Long-wave infrared frames of terrain flights, radiometrically true, in kelvin.",
    add_completion=False,
    pretty_exceptions_enable=False,
    # Markup would take units such as [m] for its own and swallow them, here and in all verbs below.
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

app.add_typer(materials, name="materials")
app.command("fit-camera")(fit_camera)
app.command()(prepare)
app.command()(dataset)
app.command()(train)
app.command()(evaluate)
app.command()(translate)

SCENE_NAMES = ", ".join(defaults.SCENES)
Pose = Annotated[
    str, typer.Option(help="E,N,U,YAW,PITCH,ROLL: metres in the local frame, degrees; pitch −90 looks down.")
]
LocalUp = Annotated[bool, typer.Option("--local-up", help="U is the local up coordinate, not metres above the ground.")]
SceneName = Annotated[str, typer.Argument(help=f"Scene folder, or the name of a shipped one: {SCENE_NAMES}.")]
Out = Annotated[Path, output_option("-o", "--output", help="Folder for the results.")]
NewFolder = Annotated[
    Path, output_option("-o", "--output", help="Folder to make for the scene.", check=files.check_new_folder)
]
NewResults = Annotated[
    Path, output_option("-o", "--output", help="New folder for the results.", check=files.check_new_folder)
]
Seed = Annotated[int, typer.Option(help="Seed of the sensor's noise.")]
Quality = Annotated[str, typer.Option(help="fast, standard or high: how finely pixels and light are sampled.")]
Tolerance = Annotated[float, typer.Option(help="Error allowed to the spectral nodes [mK].")]
Rays = Annotated[int | None, typer.Option(help="Rays per face for the light between surfaces, not the quality's.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
Products = Annotated[
    str, typer.Option(help="Comma-separated: exr, truth, error, counts, counts-tiff, radiometric, display, video, "
                           "visible.")
]
Display = Annotated[str, typer.Option(help="linear, plateau or local: how counts become 8 bits.")]
Palette = Annotated[str, typer.Option(help="white-hot, black-hot or ironbow.")]
Thermography = Annotated[
    str | None,
    typer.Option(help="Settings of thermography software, e.g. emissivity=0.95,reflected_c=-20,air_c=15,humidity=0.5,"
                 "distance_m=100: what it then reads goes into EXR and radiometric."),
]  # fmt: skip
Air = Annotated[
    str | None,
    typer.Option(help="Standard atmosphere in place of the scene's own sky: midlatitude-summer, or with an aerosol "
                 "tropical,rural-23km."),
]  # fmt: skip
Temperature = Annotated[
    str | None, typer.Option(help="Learned map that gives the temperatures in place of the scene's own source.")
]
RangeC = Annotated[str | None, typer.Option(help="COLD,WARM: °C of intensity 0 and 1 of a learned map.")]
TrajectoryFiles = Annotated[
    list[Path] | None,
    typer.Option("--trajectory", help="Log in CSV; repeat for logs in several files. Default: the scene's flight.csv."),
]
Format = Annotated[
    str | None, typer.Option("--format", help="Columns of the log: dji-gimbal, rocket-firm, px4, or a TOML file.")
]
AnchorText = Annotated[
    str | None, typer.Option(help="E,N,U,HEADING: re-base the log there [m, m, m above ground, deg].")
]
Duplicates = Annotated[
    str,
    typer.Option(help="Samples of one time: refuse, spread (evenly, within the last digit that the log's clock shows) "
                 "or first (keep that one)."),
]  # fmt: skip
ClockOffset = Annotated[float, typer.Option(help="Added to the log's times [s].")]
Mount = Annotated[str | None, typer.Option(help="YAW,PITCH,ROLL of the camera on the vehicle [deg].")]
LeverArm = Annotated[
    str, typer.Option(help="FORWARD,RIGHT,DOWN: the camera's position on the vehicle [m].")
]
Start = Annotated[float | None, typer.Option(help="First time to fly [s].")]
Stop = Annotated[float | None, typer.Option(help="Last time to fly [s].")]
Below = Annotated[bool, typer.Option("--allow-below-ground", help="Fly even where the path is under the terrain.")]


@app.callback()
def _options(debug: Annotated[bool, typer.Option("--debug", help="Show the traceback of an error.")] = False):
    """Take options that stand before the verb; `main` reads --debug by itself."""


@app.command()
def doctor(
    install: Annotated[bool, typer.Option("--install", help="Install a missing LLVM runtime with apt.")] = False,
):
    """Tell what works on this machine and how to mend what does not."""
    from thermorender.cli.doctor import examine
    from thermorender.render.variant import install_llvm

    if install:
        typer.echo(install_llvm())
    rows, healthy = examine()
    table(("", "", "to mend"), rows)
    if not healthy:
        raise ThermorenderError("no back end renders on this machine; mend the rows above")


@app.command("import-terrain")
def import_terrain(
    elevation: Annotated[Path, typer.Argument(help="GeoTIFF of heights [m].")],
    orthophoto: Annotated[Path, typer.Argument(help="GeoTIFF, RGB in 8 bits.")],
    output: NewFolder,
    max_vertices: Annotated[int, typer.Option(help="Most posts of the mesh.")] = 4_000_000,
    max_texels: Annotated[int, typer.Option(help="Most texels along a side of the texture.")] = 8192,
    height_reference: Annotated[
        str | None, typer.Option(help="ellipsoid or geoid; default: what the CRS says.")
    ] = None,
    geoid_undulation_m: Annotated[float | None, typer.Option(help="Geoid above ellipsoid there [m].")] = None,
    model: Annotated[str, typer.Option(help="Learned map for the temperatures.")] = defaults.TEMPERATURE_MAP,
    material: Annotated[str, typer.Option(help="Material of the ground.")] = "soil_loam",
    sky_temperature: Annotated[float, typer.Option(help="[K]")] = 255.0,
    fill: Annotated[bool, typer.Option("--fill", help="Fill islands of missing heights from around.")] = False,
):
    """Make a scene from an elevation model and an orthophoto."""
    from thermorender.scene.import_terrain import import_terrain as run

    if height_reference not in (None, "ellipsoid", "geoid"):
        raise ThermorenderError(f"--height-reference={height_reference!r} is not allowed; give ellipsoid or geoid")
    summary = run(elevation, orthophoto, output, max_vertices, max_texels, height_reference, geoid_undulation_m, model,
                  material, sky_temperature, fill)  # fmt: skip
    typer.echo(f"{output}: {summary['posts'][1]}×{summary['posts'][0]} posts of {summary['post_m']:.3g} m, "
               f"{summary['texels'][1]}×{summary['texels'][0]} texels of {summary['texel_m']:.3g} m; "
               f"{summary['share_without_height']:.1%} without height, "
               + (f"{summary['share_filled']:.1%} filled, " if fill else "") +
               f"{summary['share_without_colour']:.1%} without colour; "
               f"heights above the {summary['height_reference']}")  # fmt: skip


@app.command("make-scene")
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
        typer.Option(help="Draws date, hour, snow, cloud, wind and air from a seed; what is given stays as given."),
    ] = None,
):
    """Make a procedural scene from a seed, under a weather, with known temperatures."""
    from thermorender.campaign import worlds
    from thermorender.synthetic.worlds import make, weather_of

    weather = weather_of(
        kind, weather_seed, time=time, air_low_c=air_low_c, air_high_c=air_high_c, humidity=humidity,
        wind_m_s=wind_m_s, cloud=cloud, snow_depth_m=snow_depth_m,
    )  # fmt: skip
    with progress() as tell:
        tell("making the landscape", 0.0)
        folder = worlds.write(make(kind, seed, size_m, texel_m, post_m, weather=weather), output, progress=tell)
    typer.echo(str(folder))


@app.command()
def plan(scene: SceneName, quality: Quality = "standard", rays: Rays = None, tolerance_mk: Tolerance = 5.0,
         air: Air = None, time: Time = None):  # fmt: skip
    """Print what rendering a scene needs, what is left out, and the error in mK that allows it."""
    from thermorender.render.plan import make_plan
    from thermorender.sensor.exposure import plan_row

    loaded = _scene(scene, None, None, air, time)
    if not loaded.warmed:
        # What is needed depends on the temperatures.
        with progress() as tell:
            loaded = _renderer(loaded, quality, rays, tolerance_mk, 0, "auto", tell).scene
    typer.echo(str(loaded))
    rows = make_plan(loaded, quality, rays=rays, tolerance_mk=tolerance_mk).rows()
    table(("item", "in", "why"), [*rows, plan_row(loaded.camera)])


@app.command()
def render(
    scene: SceneName,
    output: Out,
    pose: Pose = "0,0,120,0,-90,0",
    local_up: LocalUp = False,
    time: Time = None,
    products: Products = "exr,truth,counts,display",
    display: Display = "linear",
    palette: Palette = "white-hot",
    thermography: Thermography = None,
    temperature: Temperature = None,
    range_c: RangeC = None,
    air: Air = None,
    seed: Seed = 0,
    engine: Annotated[
        str, typer.Option(help="renderer, or reference: slow path tracing by stock Mitsuba.")
    ] = "renderer",
    paths: Annotated[int, typer.Option(help="Paths per pixel of the reference engine.")] = 64,
    quality: Quality = "standard",
    rays: Rays = None,
    tolerance_mk: Tolerance = 5.0,
    device: Device = "auto",
):
    """Render one frame."""
    from thermorender.output import products as frame_files
    from thermorender.output.photograph import photograph
    from thermorender.output.record import made_by, record, weather_of

    if engine not in ("renderer", "reference"):
        raise ThermorenderError(f"--engine={engine!r} is unknown; give renderer or reference")
    if paths < 1:
        raise ThermorenderError(f"--paths={paths} is not allowed; give at least 1 path per pixel")
    if (output / "flight.json").exists():
        raise ThermorenderError(f"{output} holds a flight, whose first frame would be overwritten; give another folder")
    display_settings, settings = _display_settings(display, palette), _thermography_settings(thermography)
    wanted = frame_files.check(split(products), settings)
    numbers = _pose_numbers(pose)
    with progress() as tell:
        loaded = _scene(scene, temperature, range_c, air, time)
        wanted = frame_files.check(wanted, settings, loaded.camera)
        world_from_camera = _pose(loaded, pose, numbers, local_up)
        renderer = _renderer(loaded, quality, rays, tolerance_mk, seed, device, tell)
        with files.output_folder(output) as folder:
            if engine == "renderer":
                frame = renderer.frame(world_from_camera)
            else:
                from thermorender.render.reference import frame as reference_frame

                frame = reference_frame(
                    renderer, world_from_camera, paths, progress=lambda share: tell("tracing paths", share)
                )
            display_settings = replace(display_settings, tails_percent=frame.camera.agc_tails_percent)
            written = frame_files.write(
                folder, frame, wanted, display_settings.image(frame.counts)[1], settings,
                lambda camera: photograph(renderer, frame.pose, camera=camera)[0],
            )  # fmt: skip
            files.write_json(folder / "frame_000000.json", record(frame) | weather_of(renderer.scene) | made_by())
    _tell_cache(renderer)
    seen = frame.apparent_temperature
    typer.echo(f"apparent temperature {seen.min():.2f}–{seen.max():.2f} K, mean {seen.mean():.2f} K")
    for path in written.values():
        typer.echo(str(path))


@app.command()
def fly(
    scene: SceneName,
    output: Out,
    trajectory: TrajectoryFiles = None,
    format: Format = None,
    anchor: AnchorText = None,
    duplicates: Duplicates = "refuse",
    clock_offset_s: ClockOffset = 0.0,
    mount: Mount = None,
    lever_arm_m: LeverArm = "0,0,0",
    start_s: Start = None,
    stop_s: Stop = None,
    rate_hz: Annotated[float | None, typer.Option(help="Frames per second; default: the camera's.")] = None,
    time: Time = None,
    products: Products = "exr,truth,counts,display,video",
    display: Display = "linear",
    palette: Palette = "white-hot",
    agc_memory_s: Annotated[float, typer.Option(help="Time constant of the gain control; 0: none [s].")] = 0.0,
    thermography: Thermography = None,
    temperature: Temperature = None,
    range_c: RangeC = None,
    air: Air = None,
    allow_below_ground: Below = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue a stopped flight.")] = False,
    verify: Annotated[
        bool, typer.Option("--verify", help="Continue from the first frame whose files are not what was written.")
    ] = False,
    seed: Seed = 0,
    quality: Quality = "standard",
    rays: Rays = None,
    tolerance_mk: Tolerance = 5.0,
    device: Device = "auto",
):
    """Render the frames of a flight."""
    from thermorender.output import products as frame_files
    from thermorender.output.flight import fly as run

    display_settings = _display_settings(display, palette, agc_memory_s)
    settings = _thermography_settings(thermography)
    wanted = frame_files.check(split(products), settings)
    with progress() as tell:
        loaded = _scene(scene, temperature, range_c, air, time)
        path = _trajectory(loaded, trajectory, format, anchor, duplicates, clock_offset_s, mount, lever_arm_m)
        _above_ground(loaded, path, rate_hz, start_s, stop_s, allow_below_ground)
        renderer = _renderer(loaded, quality, rays, tolerance_mk, seed, device, tell)
        summary = run(
            renderer, path, output, rate_hz, wanted, start_s, stop_s, resume,
            lambda done, total: tell(f"frame {done} of {total}", done / total), display_settings, settings, tell,
            verify,
        )  # fmt: skip
    _tell_cache(renderer)
    typer.echo(f"{summary['frames']} frames, {summary['rendered']} rendered now, in {summary['folder']}")
    without = summary["frames_without_terrain"]
    if without:
        typer.echo(
            f"{without} of {summary['frames']} frames show no terrain; check the flight's position and angles, or "
            "move it with --anchor"
        )


@app.command()
def day(
    scene: SceneName,
    output: NewResults,
    pose: Pose = "0,0,120,0,-90,0",
    local_up: LocalUp = False,
    time: Annotated[
        str | None,
        typer.Option(help="Date of the local solar day, or an instant of it with its zone. Default: the scene's "
                     "weather.time."),
    ] = None,
    step_min: Annotated[int, typer.Option(help="Minutes between frames, a divisor of the day's 1440.")] = 60,
    products: Products = "exr,truth,counts,display,video",
    display: Display = "linear",
    palette: Palette = "white-hot",
    thermography: Thermography = None,
    air: Air = None,
    seed: Seed = 0,
    quality: Quality = "standard",
    rays: Rays = None,
    tolerance_mk: Tolerance = 5.0,
    device: Device = "auto",
):
    """Render one view over a day, on one display scale, with a curve of temperature per material."""
    from thermorender.output import products as frame_files
    from thermorender.output.day import day as run
    from thermorender.output.day import instant_of

    display_settings, settings = _display_settings(display, palette), _thermography_settings(thermography)
    wanted = frame_files.check(split(products), settings)
    numbers = _pose_numbers(pose)
    with progress() as tell:
        loaded = _scene(scene, None, None, air, time, instant_of)
        if loaded.told:
            _warn(loaded.told_map.texel_warning(loaded.surfaces[0].texel_m))
        rows = run(
            loaded, _pose(loaded, pose, numbers, local_up), output, step_min, wanted, display_settings, settings, tell,
            device, quality=quality, rays=rays, tolerance_mk=tolerance_mk, seed=seed,
        )  # fmt: skip
    first, last = rows[0]["time_utc"], rows[-1]["time_utc"]
    typer.echo(f"{len(rows)} frames from {first} to {last}, with day.csv and day.png in {output}")


@app.command()
def compare(
    scenes: Annotated[
        list[str], typer.Argument(help=f"Scene folders, or names of shipped ones: {SCENE_NAMES}. Those that share hour "
                                  "and weather serve each other as training part for refitted bounds.")
    ],
    output: NewResults,
    models: Annotated[str, typer.Option(help="Comma-separated learned maps: names, or .npz files.")] = ",".join(
        defaults.TEMPERATURE_MAPS
    ),
    oracle: Annotated[str | None, typer.Option(help="A map (.npz) that is shown the true material, too.")] = None,
    foreign: Annotated[
        list[str] | None,
        typer.Option(help="NAME=FOLDER with another program's frames, pose_0000.tif and so on, TIFFs that tell their "
                     "unit; in folders of the scenes' names where there are several. Repeat for more."),
    ] = None,
    dataset: Annotated[
        list[Path] | None,
        typer.Option(help="Data set that maps were trained on: the scenes are looked for in it. Repeat for more."),
    ] = None,
    methods: Annotated[
        str, typer.Option(help="Comma-separated: B, maps applied to photographs; C1 and C2, to the orthophoto and "
                          "rendered with true and with learned materials; D, E, means; F, the heat balance.")
    ] = "B,C1,C2,D,E,F",
    emissivity: Annotated[str, typer.Option(help="Emissivity map of C2.")] = defaults.EMISSIVITY_MAP,
    fallback: Annotated[
        str, typer.Option(help="Material of texels that this map does not know.")
    ] = defaults.FALLBACK_MATERIAL,
    trajectory: TrajectoryFiles = None,
    format: Format = None,
    anchor: AnchorText = None,
    duplicates: Duplicates = "refuse",
    clock_offset_s: ClockOffset = 0.0,
    mount: Mount = None,
    lever_arm_m: LeverArm = "0,0,0",
    start_s: Start = None,
    stop_s: Stop = None,
    rate_hz: Annotated[float, typer.Option(help="Poses per second of flight.")] = 1.0,
    arrays: Annotated[bool, typer.Option("--arrays", help="Keep the frames as .npz, apparent temperature.")] = False,
    air: Air = None,
    time: Time = None,
    allow_below_ground: Below = False,
    seed: Seed = 0,
    quality: Quality = "standard",
    rays: Rays = None,
    tolerance_mk: Tolerance = 5.0,
    device: Device = "auto",
):  # fmt: skip
    """Hold learned 2D translation against the radiometric render of the same poses: a page, a table, pictures."""
    from thermorender.campaign.dataset import read_dataset
    from thermorender.compare.referee import findings, run
    from thermorender.compare.referee.methods import LETTERS, learned_materials

    letters = split(methods)
    if not letters or not set(letters) <= set(LETTERS):
        raise ThermorenderError(f"--methods={methods!r} is not allowed; give some of {', '.join(LETTERS)}")
    folders = dict(named(text, "--foreign", "NAME=FOLDER") for text in foreign or ())
    with progress() as tell:
        flights = []
        for name in scenes:
            loaded = _scene(name, None, None, air, time)
            path = _trajectory(loaded, trajectory, format, anchor, duplicates, clock_offset_s, mount, lever_arm_m)
            _above_ground(loaded, path, rate_hz, start_s, stop_s, allow_below_ground)
            flights.append(run.Flight.of(loaded, path, rate_hz, start_s, stop_s))
        options = run.Options(
            letters, oracle, folders, [read_dataset(one) for one in dataset or ()],
            learned_materials(emissivity, fallback), arrays, seed,
            {"quality": quality, "rays": rays, "tolerance_mk": tolerance_mk, "device": device},
        )  # fmt: skip
        summary = run.compare(flights, output, split(models), options, tell)
    rows = run.rows(summary)
    if rows:
        table(run.HEADER, rows)
    for title, grave, lines in findings.grouped(summary["findings"]):
        typer.echo(f"{title}:")
        for line in lines if grave else lines[:3]:
            typer.echo(f"  {line}")
        if not grave and len(lines) > 3:
            typer.echo(f"  and {len(lines) - 3} more in report.html")
    typer.echo(f"report.html, pixels.csv, comparison.json and pictures in {output}")


@app.command()
def bench(
    scenes: Annotated[list[str] | None, typer.Argument(help=f"Scenes; default: {defaults.SCENE}.")] = None,
    repeats: Annotated[int, typer.Option(help="Turns of each measurement.")] = 15,
    output: Annotated[
        Path | None, output_option("-o", "--output", help="JSON file for the result.", check=files.check_output_file)
    ] = None,
    air: Air = None,
    time: Time = None,
    device: Device = "auto",
):
    """Measure frames per second, their ratio to casting the rays alone, and the error of each quality."""
    from thermorender.compare import bench as run

    with progress() as tell:
        loaded = [at_time(name, time) for name in scenes or (defaults.SCENE,)]
        result = run.bench(loaded, repeats, tell, device=device, air=parse_air(air))
    table(run.HEADER, run.rows(result))
    for line in run.costs(result):
        typer.echo(line)
    if output:
        files.write_json(output, result)


@app.command()
def demo(
    output: Out = Path("out/demo"),
    device: Device = "auto",
):
    """Run the main job on the shipped heath: a flight towards the heated marker, and the comparison."""
    if (output / "flight" / "flight.json").exists():
        raise ThermorenderError(f"{output} already holds a demo; give another folder with -o, or remove it")
    fly(defaults.SCENE, output / "flight", rate_hz=4.0, device=device)
    compare([defaults.SCENE], output / "comparison", methods="B,C1,D", rate_hz=0.2, device=device)
    typer.echo(f"look at {output / 'flight' / 'flight.mp4'} and at {output / 'comparison' / 'report.html'}")


@app.command("map-materials")
def map_materials(
    scene: SceneName,
    output: Out,
    model: Annotated[str, typer.Option(help="Emissivity map: a file, or procedural.")] = defaults.EMISSIVITY_MAP,
    fallback: Annotated[
        str, typer.Option(help="Material that stands in for unknown texels.")
    ] = defaults.FALLBACK_MATERIAL,
    confidence: Annotated[
        float | None, typer.Option(help="A texel whose best material is less probable is unknown; "
                     "default: as in scene files, 0.35.")
    ] = None,
    without: Annotated[str, typer.Option(help="Comma-separated materials known not to occur.")] = "",
):
    """Write the materials a learned map sees in a scene's orthophoto, to inspect and correct by hand."""
    from thermorender.scene.load import scene_folder
    from thermorender.scene.material_map import write_map

    with progress() as tell, files.output_folder(output) as folder:
        written, shares = write_map(
            scene_folder(scene), folder, model, fallback, confidence, split(without),
            lambda share: tell("mapping the materials", share),
        )  # fmt: skip
    table(("material", "share"), [(name, f"{share:.1%}") for name, share in shares.items()])
    for path in written.values():
        typer.echo(str(path))


def main():
    """Run the command line of thermorender."""
    run_app(app)


def _pose_numbers(text):
    from thermorender.trajectory import parse_numbers

    return parse_numbers("--pose", text, ("E", "N", "U", "YAW", "PITCH", "ROLL"))


def _pose(scene, text, numbers, local_up):
    from thermorender.trajectory.path import pose

    east, north, up, *angles = numbers
    if not local_up:
        ground = float(scene.ground(east, north))
        if ground != ground:
            raise ThermorenderError(f"--pose={text!r} lies off the terrain; move it, or give --local-up")
        if up < 0.0:
            raise ThermorenderError(
                f"--pose={text!r} lies {-up:.6g} m under the terrain; give U in metres above the ground, or --local-up"
            )
        up += ground
    return pose(east, north, up, *angles)


def _scene(name, temperature, range_c, air=None, time=None, *read_time):
    from thermorender.scene.spec import TemperatureSpec

    source = None
    if temperature:
        source = TemperatureSpec(source="learned", model=temperature, range_c=_range(range_c))
    elif range_c:
        needed = f"add --temperature {defaults.TEMPERATURE_MAP}"
        raise ThermorenderError(f"--range-c={range_c!r} needs a learned map; {needed}")
    loaded = at_time(name, time, *read_time, temperature=source)
    if air is not None:
        loaded = loaded.with_air(*parse_air(air))
    for note in loaded.weather_notes if loaded.marched else ():
        typer.echo(f"weather: {note}")
    _tell_maps(loaded)
    told = loaded.emissivity_report
    if told:
        typer.echo(
            f"{told['model']}: {told['share_unknown']:.1%} of the texels are of unknown material and taken for "
            f"{told['fallback']}"
        )
    return loaded


def _tell_maps(scene):
    """Print what learned maps of a scene's temperatures have to tell."""
    for model, report in scene.report.items():
        typer.echo(
            f"{model}: {report['share_outside_0_1']:.1%} of the intensities lie outside 0…1, "
            f"{report['share_fallback']:.1%} of the texels fall back to their material's temperature"
        )
        _warn(report["warning"])


def _warn(sentence):
    if sentence:
        typer.echo(f"warning: {sentence}", err=True)


def _display_settings(mode, palette, memory_s=0.0):
    from thermorender.sensor.display import DisplaySettings

    return DisplaySettings(mode, palette, memory_s)


def _thermography_settings(text):
    from thermorender.sensor.radiometry import ThermographySettings

    return ThermographySettings.parse(text) if text else None


def _renderer(scene, quality, rays, tolerance_mk, seed, device, tell):
    from thermorender.render.renderer import Renderer

    made = Renderer(scene, quality, rays=rays, tolerance_mk=tolerance_mk, seed=seed, device=device, progress=tell)
    if scene.told and not scene.warmed:
        # Only now the map has been asked.
        _tell_maps(made.scene)
    return made


def _tell_cache(renderer):
    if renderer.baked.cache_note:
        typer.echo(f"note: {renderer.baked.cache_note}", err=True)


def _trajectory(scene, files, format, anchor, duplicates, clock_offset_s, mount, lever_arm_m):
    from thermorender.trajectory import parse_anchor, parse_lever_arm, parse_mount, read_trajectory

    own = scene.spec.folder / "flight.csv"
    if not files and not own.exists():
        raise ThermorenderError(f"{own} does not exist, and no other log is given; add --trajectory LOG.csv")
    files = files or [own]
    return read_trajectory(
        files,
        frame=scene.frame,
        ground=scene.ground,
        geoid_undulation_m=scene.geoid_undulation_m,
        format=format,
        anchor=parse_anchor(anchor) if anchor else None,
        clock_offset_s=clock_offset_s,
        mount=parse_mount(mount) if mount else None,
        lever_arm_m=parse_lever_arm(lever_arm_m),
        duplicates=duplicates,
    )


def _above_ground(scene, path, rate_hz, start_s, stop_s, allowed):
    from thermorender.trajectory import check_above_ground

    rate_hz = scene.camera.frame_rate_hz if rate_hz is None else rate_hz
    if not allowed:
        check_above_ground(path.sampled(path.frame_times(rate_hz, start_s, stop_s)), scene.ground)


def _range(text):
    from thermorender.trajectory import parse_numbers

    return parse_numbers("--range-c", text, ("COLD", "WARM")) if text else None
