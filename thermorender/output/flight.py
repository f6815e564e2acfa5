"""A flight: timed poses to frames on disk, in an order that can be stopped anywhere and resumed.

A frame counts as done when its line stands in `frames.jsonl`; the line is appended when its files are on the disk under
their final names, and tells their sizes and checksums, and its own. `flight.json` holds everything the bytes depend on,
so a resume that would not give the same bytes is refused, and at the end how many frames show no terrain. What the
sensor's pixels remember is kept in two files, written in turn, until the flight is done; where it is lost, a resume
takes the frames before once more to have it again. Temperatures of a heat balance go with the flight's time; see
`thermorender.output.timed`.
"""

import itertools
import json
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files
from thermorender.errors import ThermorenderError
from thermorender.frame import Frame
from thermorender.output import products as product_files
from thermorender.output.photograph import photograph
from thermorender.output.record import made_by, record, weather_of
from thermorender.output.timed import STEP_S, TimedRenderer
from thermorender.output.video import write_video
from thermorender.scene.parts.tracks import TrackedObject
from thermorender.scene.scene import Scene
from thermorender.sensor.chain import sensor_of
from thermorender.sensor.display import DisplaySettings
from thermorender.sensor.exposure import Exposure
from thermorender.sensor.movers import Mover
from thermorender.sensor.radiometry import ThermographySettings
from thermorender.trajectory.path import Trajectory
from thermorender.units import utc_text

if TYPE_CHECKING:
    # It brings Mitsuba, which whoever has a renderer has loaded.
    from thermorender.render.renderer import Renderer

# So many corners of each surface are looked for in a picture before its truth is computed, which takes as long as it.
_CORNERS = 4096
# What the display's gain control remembers from one frame to the next.
_Memory = NDArray[Any] | None
# Of what each digest is, for whoever is told that it differs.
_DIGESTED = {
    "scene_digest": ", of the scene with its files, air and temperatures",
    "path_digest": ", of the trajectory with its anchor, mount, lever arm and clock offset",
}


def fly(
    renderer: "Renderer",
    trajectory: Trajectory,
    folder: str | PathLike[str],
    rate_hz: float | None = None,
    products: Sequence[str] = product_files.DEFAULT,
    start_s: float | None = None,
    stop_s: float | None = None,
    resume: bool = False,
    progress: Callable[[int, int], object] | None = None,
    display: DisplaySettings | None = None,
    thermography: ThermographySettings | None = None,
    marching: Callable[[str, float], object] | None = None,
    verify: bool = False,
) -> dict[str, Any]:
    """Render a flight into a folder and return its summary.

    The scene's own time is that of the trajectory's first sample. Temperatures of a heat balance are followed in steps
    of `thermorender.output.timed.STEP_S`.

    Parameters
    ----------
    renderer : Renderer
    trajectory : Trajectory
    folder : path
        Output folder; empty or absent unless `resume`.
    rate_hz : float, optional
        Frames per second; the camera's own where None.
    products : sequence of str
        Some of exr, truth, counts, counts-tiff, radiometric, display, video.
    start_s, stop_s : float, optional
        Part of the trajectory's time to fly [s].
    resume : bool
        Continue a stopped flight of the same settings, from the first frame whose line is not as it was written, or
        whose files are not there in their size.
    progress : callable, optional
        Called with (frames done, frames in all).
    display : DisplaySettings, optional
        How the display shows the counts; linear and white-hot where None. Its tails are the camera's.
    thermography : ThermographySettings, optional
        For the product radiometric and the EXR: what thermography software then reads.
    marching : callable, optional
        Called with (what, share done) while a heat balance is marched.
    verify : bool
        As `resume`, but from the first frame whose files are not what was written, by their checksums.

    Returns
    -------
    dict
        frames (in all), rendered (now), frames_without_terrain, folder, first and last time.

    Raises
    ------
    ThermorenderError
        Unknown products, a folder that is in use (by another process too), cannot be written or is moved meanwhile, a
        resume with other settings, weather that ends before the flight, or a camera above the range of the air or above
        its clouds.
    """
    products = product_files.check(products, thermography, renderer.scene.camera)
    display = replace(display or DisplaySettings(), tails_percent=renderer.scene.camera.agc_tails_percent)
    rate = renderer.scene.camera.frame_rate_hz if rate_hz is None else float(rate_hz)
    times = trajectory.frame_times(rate, start_s, stop_s)
    poses = trajectory.sampled(times).poses()
    renderer.refuse_camera(poses[:, :3, 3])
    timed = TimedRenderer(renderer, *trajectory.span_s, marching)
    start = timed.time(trajectory.span_s[0])
    settings = {
        "scene": renderer.scene.name,
        "scene_digest": renderer.scene.digest(),
        "camera": renderer.scene.camera.name,
        "seed": renderer.seed,
        "plan": renderer.plan.as_dict(),
        "rate_hz": rate,
        "frames": len(times),
        "first_time_s": float(times[0]),
        "last_time_s": float(times[-1]),
        "time": None if start is None else utc_text(start),
        **({"temperature_step_s": STEP_S} if renderer.scene.temperature_state.weather_driven else {}),
        **weather_of(renderer.scene),
        # Between frames too: the sensor remembers what it saw there.
        "path_digest": _digest(poses, trajectory.time_s, trajectory.position, trajectory.quaternion),
        "products": list(products),
        "display": asdict(display) | {"tails_percent": list(display.tails_percent)},
        "thermography": thermography and asdict(thermography),
        **made_by(),
    }
    exposure = _exposure(timed, renderer, trajectory, 1.0 / rate)
    with files.output_folder(folder) as out, files.in_use(out):
        terrain = _done(out, settings, products, resume or verify, verify)
        done, agc, place = len(terrain), None, os.stat(out)

        def take(index: int, agc: _Memory) -> tuple[Frame, _Memory, Any]:
            frame = _taken(timed, exposure, poses[index], float(times[index]), index)
            return frame, *(display.image(frame.counts, agc, 1.0 / rate) if "display" in products else (None, None))

        if 0 < done < len(times):
            agc = _restored(out, exposure, done, take)
        for index in range(done, len(times)):
            frame, agc, image = take(index, agc)
            _refuse_moved(out, place)
            # Only now, so that a mistake that shows with the first frame leaves nothing behind.
            if not (out / "flight.json").exists():
                files.write_json(out / "flight.json", settings)
            written = product_files.write(out, frame, products, image, thermography, _photographer(renderer, frame))
            files.on_disk(*written.values(), _save_state(out, exposure, agc, index))
            terrain.append(_shows_terrain(renderer.scene, frame))
            told = record(frame) | timed.record(frame.time_s) | {"shows_terrain": terrain[-1]}
            told["files"] = {path.name: [path.stat().st_size, files.checksum(path)] for path in written.values()}
            files.append_json(out / "frames.jsonl", files.sealed(told))
            if progress:
                progress(index + 1, len(times))
        _refuse_moved(out, place)
        for path in _state_files(out):
            path.unlink(missing_ok=True)
        if "video" in products:
            images = [product_files.paths(out, index, ("display",))["display"] for index in range(len(times))]
            write_video(out / "flight.mp4", images, rate)
        without = terrain.count(False)
        files.write_json(out / "flight.json", settings | {"frames_without_terrain": without})
    return {
        "frames": len(times),
        "rendered": len(times) - done,
        "frames_without_terrain": without,
        "folder": str(out),
        "first_time_s": float(times[0]),
        "last_time_s": float(times[-1]),
    }


def _refuse_moved(folder: Path, before: os.stat_result) -> None:
    """Refuse to go on in another folder than the one that was begun in: files would be lost, and locks kept apart."""
    try:
        same = os.path.samestat(os.stat(folder), before)
    except OSError:
        same = False
    if not same:
        raise ThermorenderError(
            f"{folder} was removed, moved or replaced while it was flown into; continue with --resume where it is now, "
            "or start again"
        )


def _whole(path: Path, known: tuple[int, str], verify: bool) -> bool:
    """Whether a file is there as its frame's record has it: by its size, and if asked for by its checksum."""
    size, checksum = known
    return path.exists() and path.stat().st_size == size and (not verify or files.checksum(path) == checksum)


def _done(folder: Path, settings: dict[str, Any], products: Sequence[str], resume: bool, verify: bool) -> list[bool]:
    """Return whether each frame already done shows terrain, after checking the folder and comparing `flight.json`."""
    described, lines = folder / "flight.json", folder / "frames.jsonl"
    if not resume:
        if described.exists() or lines.exists():
            raise ThermorenderError(
                f"{folder} already holds a flight; give another folder, or --resume to continue that one"
            )
        other = next(folder.glob("frame_*"), None)
        if other:
            raise ThermorenderError(
                f"{folder} already holds {other.name}, which a flight would overwrite; give another folder"
            )
        return []
    files.remove_parts(folder)
    if not described.exists():
        if lines.exists():
            raise ThermorenderError(
                f"{described} is missing beside frames.jsonl; start the flight again in another folder"
            )
        return []
    try:
        before = json.loads(described.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        before = None
    if not isinstance(before, dict):
        raise ThermorenderError(f"{described} is damaged; start the flight again in another folder")
    for key, value in settings.items():
        was = before.get(key)
        if was != value:
            if isinstance(was, dict) and isinstance(value, dict):
                inner = next(name for name in was | value if was.get(name, ...) != value.get(name, ...))
                key, was, value = f"{key}.{inner}", was.get(inner), value.get(inner)
            raise ThermorenderError(
                f"{described} was flown with {key}={was!r}, now {key}={value!r}{_DIGESTED.get(key, '')}; resume with "
                "the same settings or give another folder"
            )
    kept, terrain = [], []
    text = lines.read_text(encoding="utf-8", errors="replace") if lines.exists() else ""
    for number, line in enumerate(text.splitlines()):
        try:
            stored = files.unsealed(json.loads(line))
            index, shows, known = stored["index"], stored["shows_terrain"], stored["files"]
            images = product_files.paths(folder, number, products).values()
            if index != number or not all(_whole(path, known[path.name], verify) for path in images):
                break
        except (ValueError, KeyError, TypeError):
            break
        kept.append(json.dumps(files.sealed(stored)))
        terrain.append(shows)
    files.write_text(lines, "".join(line + "\n" for line in kept))
    return terrain


def _shows_terrain(scene: Scene, frame: Frame) -> bool:
    """Whether a pixel of a frame shows the scene: told by corners of its faces near the axis, else by the truth."""
    camera = frame.camera
    edges = np.array([[0.5, 0.0], [0.5, 1.0], [0.0, 0.5], [1.0, 0.5]]) * (camera.width, camera.height)
    # Within this slope of the axis all directions are in the picture.
    slope = np.linalg.norm(camera.directions(edges), axis=-1).min()
    for surface in scene.surfaces[: scene.terrain_count]:
        corner = surface.vertices[surface.faces[:: 1 + len(surface.faces) // _CORNERS, 0]]
        x, y, z = ((corner - frame.pose[:3, 3]) @ frame.pose[:3, :3]).T
        if ((z > 0.0) & (np.hypot(x, y) < slope * z)).any():
            return True
    return bool(np.isfinite(frame.truth["depth"]).any())


def _exposure(timed: TimedRenderer, renderer: "Renderer", trajectory: Trajectory, interval_s: float) -> Exposure:
    """The Exposure of a flight: the sensor with what it keeps from frame to frame."""
    scene = renderer.scene
    first, last = trajectory.span_s
    def pose_at(time_s: float) -> NDArray[np.float64]:
        return trajectory.pose(min(max(time_s, first), last))

    return Exposure(
        sensor_of(scene.camera, renderer.seed),
        lambda time_s, camera, lit_s: timed.at(time_s).radiance(pose_at(time_s), time_s, camera=camera, lit_s=lit_s),
        pose_at,
        renderer.depth,
        interval_s,
        movers=[_mover(tracked, scene) for tracked in scene.tracked_objects],
    )


def _mover(tracked: TrackedObject, scene: Scene) -> Mover:
    """An object with a track, as the sensor follows it."""
    corner = np.concatenate([surface.vertices for surface in tracked.surfaces]).astype(np.float64)
    box = np.array(list(itertools.product(*zip(corner.min(axis=0), corner.max(axis=0), strict=True))))

    def corners_at(time_s: float) -> NDArray[np.float64]:
        pose = tracked.world_from_own(tracked.at(time_s), scene.ground)
        return box @ pose[:3, :3].T + pose[:3, 3]

    return Mover(corners_at, lambda time_s: tracked.at(time_s)["temperature_k"], tracked.time_s)


def _taken(timed: TimedRenderer, exposure: Exposure, pose: NDArray[np.float64], time_s: float, index: int) -> Frame:
    """One frame of the flight at its own time, with what its sensor reads."""
    frame = timed.at(time_s).frame(pose, time_s=time_s, index=index)
    frame = replace(frame, time=timed.time(time_s))
    return frame.with_reading(*exposure.read(index, time_s, frame.radiance))


def _photographer(renderer: "Renderer", frame: Frame) -> Callable[[Any], NDArray[np.uint8]]:
    """What gives the photograph of a frame's pose by a Camera."""
    return lambda camera: photograph(renderer, frame.pose, frame.time_s, camera=camera)[0]


def _state_files(folder: Path) -> tuple[Path, Path]:
    """The files that hold the sensor's state after frames of even and of odd number."""
    return folder / "sensor_even.npz", folder / "sensor_odd.npz"


def _save_state(folder: Path, exposure: Exposure, agc: _Memory, index: int) -> Path:
    """Keep the state of sensor and display beside the frame's line: two files in turn, so that one is always whole."""
    state, path = exposure.state() | ({} if agc is None else {"agc": agc}), _state_files(folder)[index % 2]
    files.write_arrays(path, index, state)
    return path


def _restored(
    folder: Path, exposure: Exposure, done: int, take: Callable[[int, _Memory], tuple[Frame, _Memory, Any]]
) -> _Memory:
    """Bring the sensor to where it was after `done` frames, from its file or by taking them again; the display's state.

    `take` is called with a frame's index and the display's state, and returns the frame and the state after it.
    """
    last = done - 1
    arrays = files.read_arrays(_state_files(folder)[last % 2], last)
    if arrays is not None:
        agc = arrays.pop("agc", None)
        exposure.restore(arrays)
        return agc
    agc = None
    for index in range(done):
        _, agc, _ = take(index, agc)
    return agc


def _digest(*arrays: NDArray[Any]) -> str:
    import hashlib

    state = hashlib.blake2b(digest_size=16)
    for array in arrays:
        state.update(np.ascontiguousarray(array).tobytes())
    return state.hexdigest()
