"""A day: one view at each step of a local solar day, all frames on one display scale, and a curve per material.

The folder appears when the day is finished: a stop leaves nothing.
"""

import csv
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.errors import ThermorenderError
from thermorender.frame.record import record
from thermorender.materials.mixture import parts_of
from thermorender.output import products as product_files
from thermorender.output.day_figure import figure
from thermorender.output.provenance import made_by, weather_of
from thermorender.output.video import write_video
from thermorender.render.flight.timed import solved_in_parts
from thermorender.scene.surface import FILLED
from thermorender.sensor.display import DisplaySettings
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.units import instant, utc_text

if TYPE_CHECKING:
    from thermorender.frame import Frame
    from thermorender.materials.material import Material
    from thermorender.scene.scene import Scene

DEFAULT = ("exr", "truth", "counts", "display", "video")
# Frames of the video per second.
RATE_HZ = 8.0
_DAY_MIN = 24 * 60
# Materials with columns of their own.
_MOST_MATERIALS = 8


def solar_midnight(time: np.datetime64, longitude_deg: float) -> np.datetime64:
    """Return the start of the local solar day of an instant, datetime64[s] UTC.

    In mean solar time, UTC + longitude/15° h. Apparent solar time differs by up to 17 minutes over the year.
    """
    east = np.timedelta64(round(longitude_deg * 240.0), "s")
    return (time + east).astype("datetime64[D]").astype("datetime64[s]") - east


def instant_of(scene: "Scene", text: str) -> np.datetime64:
    """Return an instant of the local solar day that a text names, a date or an instant, at a scene's longitude."""
    if not re.fullmatch(r"\d{4}-\d\d-\d\d", text):
        return instant("time", text)
    longitude = scene.frame.longitude_deg if scene.frame else 0.0
    return instant("time", f"{text}T12:00Z") - np.timedelta64(round(longitude * 240.0), "s")


def day(
    scene: "Scene", pose: NDArray[np.float64], folder: str | PathLike[str], step_min: int = 60,
    products: Sequence[str] = DEFAULT, display: DisplaySettings | None = None,
    thermography: ThermographySettings | None = None, progress: Callable[[str, float], object] | None = None,
    device: str = "auto", **settings: Any,
) -> list[dict[str, Any]]:  # fmt: skip
    """Render one view over the local solar day of a scene's time into a folder; return its table.

    Parameters
    ----------
    scene : Scene
        With the temperatures of a heat balance.
    pose : (4, 4) array
        world_from_camera.
    folder : path
        New; receives the frames' products, `day.mp4`, `day.csv`, `day.png`, `day.json` and `frames.jsonl`.
    step_min : int
        Minutes between frames, 5 to 720, a divisor of the day's 1440; the first frame is at mean solar midnight.
    products : sequence of str
        As for a flight.
    display : DisplaySettings, optional
        How counts become display images, with one measure over all frames of the day.
    thermography : ThermographySettings, optional
        As for a flight.
    progress : callable, optional
        Called with (what, share done).
    device : {"auto", "cpu", "cuda"}
    **settings
        Passed to Renderer.

    Returns
    -------
    list of dict
        The rows of `day.csv`: solar_hour [h], time_utc, sun_elevation_deg, air_k, apparent_mean_k of the frame, and
        for the eight materials with the most texels of the terrain NAME_mean_k, NAME_min_k, NAME_max_k over them,
        visible or not. A mix of materials counts as its largest part, and the remaining materials are "others".

    Raises
    ------
    ThermorenderError
        A scene without heat balance, a step out of range, weather that does not cover the whole day, or a folder in
        use.
    """
    products = product_files.check(products, thermography)
    if "visible" in products:
        raise ThermorenderError("product 'visible' shows one hour, so a day cannot have it; leave it out")
    display = replace(display or DisplaySettings(), tails_percent=scene.camera.agc_tails_percent)
    times = _times(scene, step_min)
    report = progress or (lambda what, share: None)
    single = [product for product in products if product not in ("display", "video")]
    with files.atomic_folder(folder) as out:
        rows, counts = [], []
        for frame, row in day_frames(scene, pose, step_min, report, device, **settings):
            product_files.write(out, frame, single, None, thermography)
            formats.append_json(out / "frames.jsonl", record(frame))
            counts.append(frame.counts)
            rows.append(row)
        if "display" in products:
            _show(out, display, np.stack(counts), "video" in products)
        _write_table(out / "day.csv", rows)
        figure(out / "day.png", scene.name, rows, _sun_up(scene, times[0]))
        about = {
            "scene": scene.name,
            "camera": scene.camera.name,
            "materials": [material.name for material in scene.materials],
            "time": utc_text(times[0]),
            "step_min": step_min,
            **weather_of(scene),
            **made_by(),
        }
        formats.write_json(out / "day.json", about)
    return rows


def day_frames(
    scene: "Scene", pose: NDArray[np.float64], step_min: int = 60,
    progress: Callable[[str, float], object] | None = None, device: str = "auto", **settings: Any,
) -> "Iterator[tuple[Frame, dict[str, Any]]]":  # fmt: skip
    """Yield (Frame, row of the table) of each step of the local solar day; arguments and rows as of `day`."""
    times = _times(scene, step_min)
    report = progress or (lambda what, share: None)
    for index, frame, solved in _frames(scene, pose, times, report, device, settings):
        yield frame, {"solar_hour": index * step_min / 60.0, **_row(solved, frame)}
        report(f"frame {index + 1} of {len(times)}", (index + 1) / len(times))


def day_temperatures(
    scene: "Scene", step_min: int = 60, progress: Callable[[str, float], object] | None = None, device: str = "auto"
) -> "Iterator[tuple[Scene, dict[str, Any]]]":  # fmt: skip
    """Yield (the scene with its temperatures, row of the table without apparent_mean_k) of each step of the local solar
    day, without frames; arguments as of `day`."""
    times = _times(scene, step_min)
    for index, solved in enumerate(_solved(scene, times, progress or (lambda what, share: None), device)):
        yield solved, {"solar_hour": index * step_min / 60.0, **_row(solved)}


def _times(scene: "Scene", step_min: int) -> NDArray[np.datetime64]:
    """The instants of the day's frames."""
    if not scene.temperature_state.weather_driven or scene.time is None:
        raise ThermorenderError(
            f"{scene.where}: a day needs temperatures that follow the hour and [weather]; give the temperature "
            "'balance', or a map with [temperature.trained]"
        )
    if not (5 <= step_min <= 720 and _DAY_MIN % step_min == 0):
        raise ThermorenderError(
            f"step_min={step_min} is not allowed; give minutes from 5 to 720 that divide the day's {_DAY_MIN}, such as "
            "10, 30 or 60"
        )
    weather = scene.weather
    first = solar_midnight(scene.time, weather.longitude_deg)
    times = first + np.timedelta64(60 * step_min, "s") * np.arange(_DAY_MIN // step_min)
    if times[0] < weather.time[0] or times[-1] > weather.time[-1]:
        raise ThermorenderError(
            f"{scene.where}: the local solar day {utc_text(times[0])} to {utc_text(times[-1])} is not all inside its "
            f"weather, {utc_text(weather.time[0])} to {utc_text(weather.time[-1])}; give another time, or weather of "
            "the whole day"
        )
    return times


def _solved(
    scene: "Scene", times: NDArray[np.datetime64], report: Callable[[str, float], object], device: str
) -> "Iterator[Scene]":  # fmt: skip
    """Yield the scene with its temperatures at each instant."""
    # These import Mitsuba.
    from thermorender.render.geometry import Geometry
    from thermorender.render.variant import activate

    scene.refuse_tiles("a day")
    yield from solved_in_parts(scene, times, Geometry(activate(device), scene.surfaces), report)


def _frames(
    scene: "Scene", pose: NDArray[np.float64], times: NDArray[np.datetime64], report: Callable[[str, float], object],
    device: str, settings: dict[str, Any],
) -> "Iterator[tuple[int, Frame, Scene]]":  # fmt: skip
    """Yield (index, Frame, solved Scene) of each instant; the light is traced once."""
    from thermorender.render.quality import Sampling
    from thermorender.render.renderer import Renderer

    # Before the heat balance is solved, so that a wrong setting fails at once.
    Sampling.of(**{name: value for name, value in settings.items() if name != "seed"})
    baked, seed = None, settings.get("seed", 0)
    for index, solved in enumerate(_solved(scene, times, report, device)):
        if baked is None:
            renderer = Renderer(solved, progress=report, **{"device": device, **settings})
            baked = renderer.baked
        else:
            renderer = Renderer.of(baked.solved_for(solved), seed)
        yield index, renderer.frame(pose, index=index), solved


def _row(scene: "Scene", frame: "Frame | None" = None) -> dict[str, Any]:
    """The row of one instant in the day's table, without its hour; without a frame nothing is apparent."""
    time = scene.time
    assert time is not None  # Solved at an instant.
    _, elevation = scene.weather.sun(time)
    row: dict[str, Any] = {
        "time_utc": utc_text(time),
        "sun_elevation_deg": float(elevation),
        "air_k": float(scene.weather.at(time).air_k),
    }
    if frame is not None:
        row["apparent_mean_k"] = float(frame.apparent_temperature.mean(dtype=np.float64))
    terrain = scene.near_ground
    known = [(surface.flags & FILLED) == 0 for surface in terrain]
    material = np.concatenate([one.material[here] for one, here in zip(terrain, known, strict=True)])
    kelvin = np.concatenate([one.temperature[here] for one, here in zip(terrain, known, strict=True)])
    for name, numbers in _largest(scene.materials, material).items():
        own = kelvin[np.isin(material, numbers)]
        row[f"{name}_mean_k"] = float(own.mean(dtype=np.float64))
        row[f"{name}_min_k"], row[f"{name}_max_k"] = float(own.min()), float(own.max())
    return row


def _largest(materials: "Sequence[Material]", texels: NDArray[np.uint8]) -> dict[str, list[int]]:
    """{name: numbers} of the materials with the most texels, and of the others; a mix counts as its largest part."""
    count = np.bincount(texels, minlength=len(materials))
    groups: dict[str, list[int]] = {}
    for number in np.flatnonzero(count):
        main, _ = max(parts_of(materials[int(number)]), key=lambda part: part[1])
        groups.setdefault(main.name, []).append(int(number))
    ordered = sorted(groups, key=lambda name: -int(count[groups[name]].sum()))
    found = {name: groups[name] for name in ordered[:_MOST_MATERIALS]}
    others = [number for name in ordered[_MOST_MATERIALS:] for number in groups[name]]
    return {**found, "others": others} if others else found


def _show(folder: Path, display: DisplaySettings, counts: NDArray[np.uint16], video: bool) -> None:
    """Write the display images of counts (N, H, W), with one measure of all, and their video."""
    measured = display.measure(counts)
    images = [product_files.paths(folder, index, ("display",))["display"] for index in range(len(counts))]
    for path, one in zip(images, counts, strict=True):
        formats.write_image(path, display.shown(one, measured))
    if video:
        write_video(folder / "day.mp4", images, RATE_HZ)


def _write_table(path: Path, rows: list[dict[str, Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(rows[0])
        for row in rows:
            writer.writerow([f"{value:.3f}" if isinstance(value, float) else value for value in row.values()])


def _sun_up(scene: "Scene", midnight: np.datetime64) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(solar hours 0…24, whether the sun is above the horizon) every five minutes."""
    minutes = np.arange(0, _DAY_MIN + 1, 5)
    _, elevation = scene.weather.sun(midnight + minutes * np.timedelta64(60, "s"))
    return minutes / 60.0, np.asarray(elevation) > 0.0
