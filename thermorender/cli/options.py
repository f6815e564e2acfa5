"""Options that verbs share, in groups: a dataclass per group, whose fields are flat options on the command line."""

import inspect
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from thermorender import defaults, timing
from thermorender.cli.terminal import Progress, ReadTime, Time, at_time, named, read_instant, split, warn
from thermorender.errors import ThermorenderError
from thermorender.timing import phase

if TYPE_CHECKING:
    from thermorender.render.renderer import Renderer
    from thermorender.scene.scene import Scene
    from thermorender.scene.spec import TemperatureSpec
    from thermorender.sensor.display import DisplaySettings
    from thermorender.sensor.radiometry import ThermographySettings
    from thermorender.trajectory import Trajectory

SCENE_NAMES = ", ".join(defaults.SCENES)
SceneName = Annotated[str, typer.Argument(help=f"Scene folder, or the name of a shipped scene: {SCENE_NAMES}.")]
Seed = Annotated[int, typer.Option(help="Seed of the sensor's noise.")]
Device = Annotated[str, typer.Option(help="auto, cpu or cuda.")]
Products = Annotated[
    str, typer.Option(help="Comma-separated: exr, truth, error, counts, counts-tiff, radiometric, display, video, "
                           "visible; of a flight also report: index.html and contact.png, and mcap: one file of ROS 2.")
]  # fmt: skip
Thermography = Annotated[
    str | None,
    typer.Option(help="Settings of thermography software, e.g. emissivity=0.95,reflected_c=-20,air_c=15,humidity=0.5,"
                 "distance_m=100: its reading goes into EXR and radiometric.", rich_help_panel="pictures"),
]  # fmt: skip
Air = Annotated[
    str | None,
    typer.Option(help="Standard atmosphere in place of the scene's own sky: midlatitude-summer, or with an aerosol "
                 "tropical,rural-23km.", rich_help_panel="scene"),
]  # fmt: skip
# Where a view is without --pose.
_POSE = "0,0,120,0,-90,0"


def flat(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Return a verb for typer: the fields of each keyword parameter that is a dataclass become separate options."""
    given = inspect.signature(verb).parameters.values()
    groups: dict[str, Any] = {
        parameter.name: parameter.annotation for parameter in given if is_dataclass(parameter.annotation)
    }
    parameters: list[inspect.Parameter] = []
    for parameter in given:
        if parameter.name in groups:
            parameters += [
                inspect.Parameter(field.name, parameter.kind, default=field.default, annotation=field.type)
                for field in fields(groups[parameter.name])
            ]
        else:
            parameters.append(parameter)

    def run(*arguments: Any, **options: Any) -> Any:
        for name, group in groups.items():
            known = [field.name for field in fields(group) if field.name in options]
            options[name] = group(**{each: options.pop(each) for each in known})
        return verb(*arguments, **options)

    run.__name__, run.__doc__ = verb.__name__, verb.__doc__
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]  # read by typer
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def profiled(verb: Callable[..., Any]) -> Callable[..., Any]:
    """Return a verb with the option --profile, which prints the PhaseTimes of its run to the error stream."""
    given = inspect.signature(verb)
    says = "Print the seconds of each phase to the error stream, and add them to the record."
    option = inspect.Parameter(
        "profile", inspect.Parameter.KEYWORD_ONLY, default=False,
        annotation=Annotated[bool, typer.Option("--profile", help=says, rich_help_panel="files")],
    )  # fmt: skip

    def run(*arguments: Any, profile: bool = False, **options: Any) -> Any:
        if not profile:
            return verb(*arguments, **options)
        with timing.profiled() as taken:
            verb(*arguments, **options)
        for line in taken.lines():
            typer.echo(line, err=True)

    run.__name__, run.__doc__ = verb.__name__, verb.__doc__
    run.__signature__ = given.replace(  # type: ignore[attr-defined]  # read by typer
        parameters=[*given.parameters.values(), option]
    )
    run.__annotations__ = {**verb.__annotations__, "profile": option.annotation}
    return run


@dataclass(frozen=True)
class SceneOptions:
    """The instant of a scene, and its air."""

    time: Time = None
    air: Air = None
    set: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            help="OBJECT.KEY=VALUE, e.g. marker.temperature_k=350; keys east_m, north_m, "
            "above_ground_m, yaw_deg, temperature_k (or balance), inner_heat_w. Repeat for more.",
        ),
    ] = None
    paint: Annotated[
        list[str] | None,
        typer.Option(
            "--paint",
            help="FILE.geojson=MATERIAL: another material within the polygons, or an emissivity; "
            "without =MATERIAL that of their property 'material'. Repeat for more.",
        ),
    ] = None

    @phase("scene")
    def load(
        self, name: str, temperature: "TemperatureSpec | None" = None, read_time: ReadTime = read_instant,
        progress: Progress = lambda what, share: None,
    ) -> "Scene":  # fmt: skip
        """Return the Scene of a folder or name; print notes on its weather and learned maps."""
        progress("loading the scene", 0.0)
        scene = at_time(name, self.time, read_time, temperature)
        if self.air is not None:
            scene = scene.with_air(*parse_air(self.air))
        for text in self.set or ():
            scene = scene.with_objects(parse_object(text))
        for text in self.paint or ():
            scene = scene.with_material_in(*parse_paint(text))
        progress("loading the scene", 1.0)
        if scene.temperature_state.weather_driven:
            for note in (_sun_of(scene), *scene.weather_notes):
                typer.echo(f"weather: {note}")
        warn(_one_material(scene))
        for note in (*scene.sky_notes, *scene.surface_notes):
            warn(note)
        print_map_reports(scene)
        report = scene.emissivity_report
        if report:
            typer.echo(
                f"{report['model']}: {report['share_unknown']:.1%} of the texels are of unknown material and taken for "
                f"{report['fallback']}"
            )
            for note in report.get("context", ()):
                typer.echo(f"{report['model']}: {note}")
            if "mean_std" in report:
                typer.echo(
                    f"{report['model']}: emissivity ± {report['mean_std']:.3f} on average; "
                    f"{report['share_uncertain']:.1%} of the texels are flagged, beyond emissivity.most_std"
                )
        return scene


def _sun_of(scene: "Scene") -> str:
    """The instant at the scene's place, and where the sun is."""
    from thermorender.physics.sun import solar_hour
    from thermorender.units import utc_text

    weather, time = scene.weather, scene.time
    assert time is not None
    hour = float(solar_hour(time, weather.longitude_deg))
    elevation = float(weather.sun(time)[1])
    minute = round(60.0 * hour) % 1440
    return (
        f"{utc_text(time)} is {minute // 60:02d}:{minute % 60:02d} in solar time, the sun {abs(elevation):.0f}° "
        f"{'above' if elevation > 0.0 else 'below'} the horizon"
    )


def _one_material(scene: "Scene") -> str | None:
    """A warning if one material covers the terrain of a heat balance, else None."""
    import numpy as np

    kinds = {int(number) for surface in scene.near_ground for number in np.unique(surface.material)}
    if not scene.balanced or len(kinds) > 1:
        return None
    return (
        f"{scene.materials[kinds.pop()].name} covers all of the terrain, so the heat balance shows only slope and "
        "shadow; give the ground its materials in [emissivity]"
    )


@dataclass(frozen=True)
class TemperatureOptions:
    """Another source of temperatures in place of the scene's own."""

    temperature: Annotated[
        str | None,
        typer.Option(
            help="Learned map that gives the temperatures in place of the scene's own source, or balance: the "
            "heat balance under the scene's weather."
        ),
    ] = None
    range_c: Annotated[
        str | None, typer.Option(help="COLD,WARM: °C of intensity 0 and 1 of a learned map.", rich_help_panel="scene")
    ] = None

    def source(self) -> "TemperatureSpec | None":
        """Return the source of temperatures; None for the scene's own."""
        from thermorender.numbers import parse_numbers
        from thermorender.scene.spec import BALANCE, TemperatureSpec

        if self.temperature == BALANCE and not self.range_c:
            return TemperatureSpec(source=BALANCE)
        if self.temperature and self.temperature != BALANCE:
            limits: Any = parse_numbers("--range-c", self.range_c, ("COLD", "WARM")) if self.range_c else None
            return TemperatureSpec(source="learned", model=self.temperature, range_c=limits)
        if self.range_c:
            raise ThermorenderError(
                f"--range-c={self.range_c!r} needs a learned map; add --temperature {defaults.TEMPERATURE_MAP}"
            )
        return None


@dataclass(frozen=True)
class ViewOptions:
    """The pose of a camera that does not move."""

    pose: Annotated[
        str, typer.Option(help="E,N,U,YAW,PITCH,ROLL: metres in the local frame, degrees; pitch −90 looks down.")
    ] = _POSE
    local_up: Annotated[
        bool, typer.Option("--local-up", help="U is the local up coordinate, not metres above the ground.")
    ] = False
    look_at: Annotated[
        str | None,
        typer.Option(help="E,N,U of a point in the middle of the image; --pose is then E,N,U without angles."),
    ] = None

    def numbers(self) -> tuple[tuple[float, ...], tuple[float, ...] | None]:
        """Return the numbers of --pose and of --look-at."""
        from thermorender.numbers import parse_numbers

        place = ("E", "N", "U")
        if self.look_at is None:
            return parse_numbers("--pose", self.pose, (*place, "YAW", "PITCH", "ROLL")), None
        given = "0,0,120" if self.pose == _POSE else self.pose
        return parse_numbers("--pose", given, place), parse_numbers("--look-at", self.look_at, place)

    def over(self, scene: "Scene") -> Any:
        """Return the pose over a scene, (4, 4) world_from_camera."""
        from thermorender.trajectory.path import pose

        (east, north, up, *angles), point = self.numbers()
        yaw, pitch, roll = angles or (0.0, 0.0, 0.0)
        if self.local_up:
            below = float(scene.ground(east, north)) - up
            if below > 0.0:
                warn(
                    f"--pose={self.pose!r} with --local-up is {below:.6g} m under the ground; leave --local-up out to "
                    "give U in metres above the ground"
                )
            return pose(east, north, up, yaw, pitch, roll, look_at=point)
        ground = float(scene.ground(east, north))
        if ground != ground:
            raise ThermorenderError(f"--pose={self.pose!r} is outside the terrain; move it, or give --local-up")
        if up < 0.0:
            raise ThermorenderError(
                f"--pose={self.pose!r} is {-up:.6g} m under the terrain; give U in metres above the ground, or "
                "--local-up"
            )
        return scene.pose(east, north, up, yaw, pitch, roll, look_at=point)


@dataclass(frozen=True)
class SamplingOptions:
    """How finely pixels, light and wavelengths are sampled."""

    quality: Annotated[str, typer.Option(help="Sampling: fast, standard or high.")] = "standard"
    rays: Annotated[
        int | None,
        typer.Option(
            help="Rays per face for the light between surfaces; default: the quality's.", rich_help_panel="sampling"
        ),
    ] = None
    tolerance_mk: Annotated[
        float, typer.Option(help="Allowed error of the spectral nodes [mK].", rich_help_panel="sampling")
    ] = 5.0

    def settings(self) -> dict[str, Any]:
        """Return the keywords of Renderer."""
        return asdict(self)

    @phase("renderer")
    def renderer(self, scene: "Scene", seed: int, device: str, progress: Progress) -> "Renderer":
        """Return the Renderer of a scene; print the reports of learned maps that ran only now."""
        with phase("imports"):
            from thermorender.render.tiled.tiled_renderer import renderer_of

        made = renderer_of(scene, **self.settings(), seed=seed, device=device, progress=progress)
        if not scene.temperature_state.solved and hasattr(scene.temperature_state.source, "model"):
            print_map_reports(made.scene)
        return made


@dataclass(frozen=True)
class DisplayOptions:
    """How counts become display images."""

    display: Annotated[
        str, typer.Option(help="linear, plateau or local: how counts become 8 bits.", rich_help_panel="pictures")
    ] = "linear"
    palette: Annotated[str, typer.Option(help="white-hot, black-hot or ironbow.", rich_help_panel="pictures")] = (
        "white-hot"
    )

    def settings(self, memory_s: float = 0.0) -> "DisplaySettings":
        """Return the DisplaySettings."""
        from thermorender.sensor.display import DisplaySettings

        return DisplaySettings(self.display, self.palette, memory_s)


@dataclass(frozen=True)
class TrajectoryOptions:
    """The log of a flight, how it is read, and the part that is flown."""

    trajectory: Annotated[
        list[Path] | None,
        typer.Option("--trajectory", help="Log; repeat for several files. Default: the scene's flight.csv."),
    ] = None
    format: Annotated[
        str | None,
        typer.Option("--format", help="Program that wrote the log: airdata, ardupilot, dji-gimbal, dji-srt, euroc, "
                     "gpx, kml, px4, rocket-firm, rosbag, tum, ulog, or a mapping of columns (TOML). Default: our own "
                     "CSV."),
    ] = None  # fmt: skip
    anchor: Annotated[
        str | None,
        typer.Option(
            help="E,N,U,HEADING: move the start of the log there [m, m, m above ground, deg].", rich_help_panel="log"
        ),
    ] = None
    duplicates: Annotated[
        str,
        typer.Option(help="Samples of the same time: refuse, spread (evenly, within the last digit of the log's clock) "
                     "or first (keep the first).", rich_help_panel="log"),
    ] = "refuse"  # fmt: skip
    clock_offset_s: Annotated[float, typer.Option(help="Added to the log's times [s].", rich_help_panel="log")] = 0.0
    mount: Annotated[
        str | None, typer.Option(help="YAW,PITCH,ROLL of the camera on the vehicle [deg].", rich_help_panel="log")
    ] = None
    lever_arm_m: Annotated[
        str, typer.Option(help="FORWARD,RIGHT,DOWN: the camera's position on the vehicle [m].", rich_help_panel="log")
    ] = "0,0,0"
    course: Annotated[
        bool,
        typer.Option(
            "--course", help="Turn a vehicle whose log has no yaw to its course over ground.", rich_help_panel="log"
        ),
    ] = False
    start_s: Annotated[float | None, typer.Option(help="First time to fly [s].")] = None
    stop_s: Annotated[float | None, typer.Option(help="Last time to fly [s].")] = None
    allow_below_ground: Annotated[
        bool,
        typer.Option(
            "--allow-below-ground", help="Fly even where the path is under the terrain.", rich_help_panel="log"
        ),
    ] = False

    @phase("trajectory")
    def read(self, scene: "Scene", rate_hz: float | None) -> "Trajectory":
        """Return the Trajectory over a scene, refused if it is below ground at a frame; print warnings on the log."""
        from thermorender.output.terrain_in_view import empty_frames_note
        from thermorender.render.air import refuse_camera
        from thermorender.render.flight.timed import refuse_late
        from thermorender.scene.load import load_trajectory
        from thermorender.trajectory import (
            check_above_ground,
            parse_anchor,
            parse_lever_arm,
            parse_mount,
        )

        own = scene.spec.folder / "flight.csv"
        if not self.trajectory and not own.exists():
            raise ThermorenderError(f"{own} does not exist, and no other log is given; add --trajectory LOG.csv")
        path = load_trajectory(
            self.trajectory or [own],
            scene,
            format=self.format,
            anchor=parse_anchor(self.anchor) if self.anchor else None,
            clock_offset_s=self.clock_offset_s,
            mount=parse_mount(self.mount) if self.mount else None,
            lever_arm_m=parse_lever_arm(self.lever_arm_m),
            course=self.course,
            duplicates=self.duplicates,  # type: ignore[arg-type]  # checked by load_trajectory
        )
        rate_hz = scene.camera.frame_rate_hz if rate_hz is None else rate_hz
        frames = path.sampled(path.frame_times(rate_hz, self.start_s, self.stop_s))
        if not self.allow_below_ground:
            check_above_ground(frames, scene.ground)
        # Refused before the temperatures are solved.
        refuse_camera(scene, frames.position)
        refuse_late(scene, path.span_s[1] - path.span_s[0])
        for note in path.notes:
            warn(note)
        warn(empty_frames_note(scene, frames.poses()))
        return path


def parse_air(text: str) -> tuple[str, ...]:
    """Return (standard atmosphere, aerosol) of an option --air."""
    parts = split(text)
    if len(parts) > 2:
        raise ThermorenderError(f"--air={text!r} has {len(parts)} parts; give ATMOSPHERE or ATMOSPHERE,AEROSOL")
    return parts or ("",)


def parse_object(text: str) -> dict[str, dict[str, Any]]:
    """Return {object: {key: value}} of an option --set."""
    place, value = named(text, "--set", "OBJECT.KEY=VALUE, such as marker.temperature_k=350")
    name, found, key = place.rpartition(".")
    if not (name and found and key):
        raise ThermorenderError(f"--set={text!r} is not allowed; give OBJECT.KEY=VALUE")
    return {name: {key: number_or_text(value)}}


def parse_paint(text: str) -> tuple[Any, ...]:
    """Return (file, material or None) of an option --paint."""
    path, found, material = text.rpartition("=")
    return (path, number_or_text(material)) if found else (text,)


def number_or_text(text: str) -> float | str:
    """Return the number of a text, or the text where it is none."""
    try:
        return float(text)
    except ValueError:
        return text


def parse_thermography(text: str | None) -> "ThermographySettings | None":
    """Return the settings of an option --thermography; None if it is not given."""
    from thermorender.sensor.radiometry import ThermographySettings

    return ThermographySettings.parse(text) if text else None


def print_map_reports(scene: "Scene") -> None:
    """Print the shares of a scene's texels outside the range of its learned maps, and the maps' warnings."""
    for model, report in scene.temperature_state.report.items():
        if "share_outside_0_1" not in report:  # a raster
            warn(f"{model}: {report['share_fallback']:.1%} of the terrain has no temperature there and is given "
                 f"{report['fallback']}")  # fmt: skip
            continue
        typer.echo(
            f"{model}: {report['share_outside_0_1']:.1%} of the intensities lie outside 0…1, "
            f"{report['share_fallback']:.1%} of the texels fall back to their material's temperature"
        )
        warn(report["warning"])


def print_cache_note(renderer: "Renderer") -> None:
    """Print why the light of a scene was not cached, if it was not."""
    if renderer.cache_note:
        typer.echo(f"note: {renderer.cache_note}", err=True)
