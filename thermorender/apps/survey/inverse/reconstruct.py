"""`reconstruct`: from a scene and the frames of a survey to a map of temperatures, step by step, resumable."""

import hashlib
import re
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Camera, Scene, files, formats
from thermorender.apps.survey.inverse import level
from thermorender.apps.survey.inverse.air import without_air
from thermorender.apps.survey.inverse.frames import Survey
from thermorender.apps.survey.inverse.kinetic import Light, kinetic_of, light_of, unknowns
from thermorender.apps.survey.inverse.linear import LinearKelvin
from thermorender.apps.survey.inverse.normal import Prior
from thermorender.apps.survey.inverse.notes import Level, instant, notes_of
from thermorender.apps.survey.inverse.shutter import Shutters, shutters_of
from thermorender.apps.survey.inverse.solve import Problem, Settings, State
from thermorender.apps.survey.inverse.spread import Spread
from thermorender.apps.survey.inverse.weights import (
    Lattice,
    Viewer,
    binned,
    binned_camera,
    reach_px,
    texel_means,
    window_of,
)
from thermorender.errors import ThermorenderError

if TYPE_CHECKING:
    from thermorender import Renderer

Floats = NDArray[np.float64]
Progress = Callable[[str, float], object]
STATE = "state.npz"
# The adjustment of lens and poses before it.
ADJUSTED = "adjusted.npz"
# Poses are wrong by up to so many standard deviations.
_REACH = 3.0
# What is left of the error of poses after an adjustment: single frames agree, and a strip may bend.
_LEFT = 1.0 / 3.0
# Texels along a pixel of the small images that find the window of the map, in the median.
_PIXEL_TEXELS = 2.0
# Rounds on all pixels, the last included; those before them take means of pixels.
_FULL = 2
# Files of states have a form of their own.
_FORM = 4


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The result for a scene and a survey.

    Attributes
    ----------
    survey : Survey
    camera : Camera
    settings : Settings
    lattice : Lattice
    apparent, apparent_std : (h, w) float64
        Apparent temperature and its standard deviation without the common level [K]; NaN where no frame shows a texel.
    kinetic, kinetic_std : (h, w) float64
        Kinetic temperature, in the same way; NaN also where it is not trusted. Its standard deviation includes that of
        the emissivity, where the material states one.
    views : (h, w) int32
        Frames that show each texel.
    residual : (h, w) float64
        Root mean square of the pixels' residuals [K].
    prior : (h, w) float64
        Apparent temperature before the frames [K].
    state : State
    spread : Spread
    level_k, level_std_k : float
        Shift of the common level by the references, otherwise by the frames after a shutter, otherwise 0; and the
        standard deviation of the level.
    shutters : Shutters
    references : list of (name, residual)
        Residuals of the references [K].
    notes : tuple of str
    renderer : Renderer
    light : Light
    """

    survey: Survey
    camera: Camera
    settings: Settings
    lattice: Lattice
    apparent: Floats
    apparent_std: Floats
    kinetic: Floats
    kinetic_std: Floats
    views: NDArray[np.int32]
    residual: Floats
    prior: Floats
    state: State
    spread: Spread
    level_k: float
    level_std_k: float
    shutters: Shutters
    references: list[tuple[str, float]]
    notes: tuple[str, ...]
    renderer: "Renderer"
    light: Light


def reconstruct(
    scene: Scene, survey: Survey, camera: Camera | None = None, settings: Settings | None = None,
    references: Sequence[level.Reference] = (), folder: str | PathLike[str] | None = None,
    progress: Progress | None = None,
) -> Reconstruction:  # fmt: skip
    """Return the Reconstruction of a scene's temperatures from the frames of a survey.

    Parameters
    ----------
    scene : Scene
        Terrain, materials and light; its temperatures are the prior.
    survey : Survey
    camera : Camera, optional
        That took the frames; the scene's by default.
    settings : Settings, optional
    references : sequence of Reference
        Places of known temperature, which fix the common level.
    folder : path, optional
        Keeps the state after each round in state.npz; a call with the same arguments continues from there.
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        Frames of another size than the camera's, terrain that no frame shows, or a folder of another reconstruction.
    """
    from thermorender import Renderer

    scene.refuse_tiles("a reconstruction")
    settings = settings or Settings()
    camera = camera or scene.camera
    height, width = survey.kelvin.shape[1:]
    if (camera.height, camera.width) != (height, width):
        raise ThermorenderError(
            f"frames have {width}×{height} pixels, and camera {camera.name} {camera.width}×{camera.height}; give the "
            "camera that took them"
        )
    renderer = Renderer(scene.with_camera(camera), quality="fast", progress=progress)
    survey = without_air(survey, camera, renderer)
    linear = LinearKelvin(camera.band_um, round(float(np.nanmedian(survey.kelvin)), 1))
    error = settings.pose_error if survey.stated is None else settings.pose_error.times(_LEFT)
    lattice, blind = _window(renderer, camera, survey.poses, settings)
    level.check_places(references, renderer, lattice)
    light = light_of(renderer, lattice, linear)
    images = np.stack([linear.of(image).astype(np.float32) for image in survey.kelvin])
    problem = Problem(renderer, camera, images, survey.poses, lattice, _prior(light, settings), settings, error)
    state = _solved(problem, _key(scene, survey, camera, settings), folder, progress)
    state, spread = problem.last_round(state, progress)
    shutters = shutters_of(state.offsets, _when(survey), np.isfinite(spread.frames))
    # Half of what a shutter takes away may be the camera's, half of it the ground's.
    shift, level_std = shutters.level_k, float(np.hypot(settings.level_k, 0.5 * shutters.fall_k))
    residuals, seen = list[tuple[str, float]](), spread.views > 0
    means = texel_means(state.map, lattice.scene_texels)
    if references:
        shift, level_std, residuals = level.shift_of(
            list(references), means, spread.std, seen, light, renderer, lattice, linear
        )
    state, means = replace(state, map=state.map + shift, offsets=state.offsets - shift), means + shift
    shutters = replace(shutters, drift=shutters.drift - shift)
    pixel_m = problem.reach / reach_px(camera) * lattice.texel_m
    found_level = Level(shift, residuals, references, shutters)
    notes = notes_of(survey, blind, state, spread, settings, pixel_m, found_level, scene.time)
    apparent = np.where(seen, linear.kelvin(means), np.nan)
    per_linear = linear.kelvin_per_linear(np.where(seen, apparent, linear.reference_k))
    found, change, by_emissivity, trusted = kinetic_of(np.where(seen, means, np.nan), light, renderer, linear)
    trusted &= seen
    return Reconstruction(
        survey, camera, settings, lattice, apparent, np.where(seen, spread.std * per_linear, np.nan),
        np.where(trusted, found, np.nan), np.where(trusted, np.hypot(spread.std * change, by_emissivity), np.nan),
        spread.views,
        np.where(seen, spread.residual, np.nan), linear.kelvin(light.apparent), state, spread, shift, level_std,
        shutters, residuals, (*survey.notes, *notes, *unknowns(renderer, light.material, linear)), renderer, light,
    )  # fmt: skip


def _when(survey: Survey) -> Floats:
    """When frames were taken, (F,): by their times, the last numbers of their names, or in order."""
    found = [instant(each) for each in survey.times]
    known = [each[0] for each in found if each is not None]
    if len(known) == len(found):
        return np.array([(each - min(known)) / np.timedelta64(1, "s") for each in known])
    numbers = [re.findall(r"\d+", name) for name in survey.names]
    if all(numbers) and len({int(each[-1]) for each in numbers}) == len(numbers):
        return np.array([float(each[-1]) for each in numbers])
    return np.arange(len(survey.names), dtype=float)


def _window(renderer: "Renderer", camera: Camera, poses: Floats, settings: Settings) -> tuple[Lattice, list[int]]:
    """As `window_of`."""
    whole = Lattice.of(renderer.scene, settings.texel_m)
    factor = max(1, camera.width // 80)
    height = float(np.median(poses[:, 2, 3])) - float(np.median(renderer.scene.surfaces[0].vertices[:, 2]))
    # Large pixels need texels that are not much smaller.
    pixel_m = factor * max(height, 0.0) / camera.focal_length_px
    larger = float(np.clip(np.ceil(pixel_m / (_PIXEL_TEXELS * settings.texel_m)), 1, factor))
    viewer = Viewer(renderer, binned_camera(camera, factor), Lattice.of(renderer.scene, larger * settings.texel_m))
    error = settings.pose_error
    margin = _REACH * (error.position_m + np.radians(error.angle_deg) * max(height, 0.0)) + 4.0 * settings.texel_m
    return window_of(whole, viewer, list(poses), margin)


def _prior(light: Light, settings: Settings) -> Prior:
    _, classes = np.unique(light.material, return_inverse=True)
    shape = light.apparent.shape
    precision = np.full(shape, 1.0 / settings.prior_k**2)
    return Prior(light.apparent, precision, classes.reshape(shape), 1.0 / settings.class_k**2)


def _key(scene: Scene, survey: Survey, camera: Camera, settings: Settings) -> dict[str, Any]:
    """What a state belongs to."""
    data = hashlib.sha256(np.ascontiguousarray(survey.kelvin).tobytes())
    data.update(survey.poses.tobytes())
    return {"form": _FORM, "frames": data.hexdigest(), "adjusted": survey.stated is not None,
            "scene": scene.with_camera(camera).digest(), "settings": asdict(settings)}  # fmt: skip


def _solved(
    problem: Problem, key: dict[str, Any], folder: str | PathLike[str] | None, progress: Progress | None
) -> State:  # fmt: skip
    """The State before the last round: from the folder's, where it has one."""
    settings = problem.settings
    small = _binned(problem) if problem.camera.width >= 320 else problem
    path = None if folder is None else Path(folder) / STATE
    state = None if path is None else _kept(path, key)
    if state is None:
        state = small.round(small.register(small.start(), progress=progress), False, progress)
        state = small.register(state, progress)
        _keep(path, key, state)
    while state.rounds < settings.rounds - 1:
        full = state.rounds >= settings.rounds - _FULL
        state = (
            problem.round(_whole(problem, state), progress=progress) if full else small.round(state, progress=progress)
        )
        _keep(path, key, state)
    return _whole(problem, state)


def _whole(problem: Problem, state: State) -> State:
    """A State for all pixels: a fixed pattern of means of pixels is dropped."""
    shape = problem.images.shape[1:]
    return state if state.pattern.shape == shape else replace(state, pattern=np.zeros(shape))


def _binned(problem: Problem) -> Problem:
    images = np.stack([binned(image, 2) for image in problem.images]).astype(np.float32)
    camera = binned_camera(problem.camera, 2)
    return Problem(problem.viewer.renderer, camera, images, problem.poses, problem.viewer.lattice, problem.prior,
                   problem.settings, problem.error)  # fmt: skip


def _keep(path: Path | None, key: dict[str, Any], state: State) -> None:
    if path is not None:
        formats.write_arrays(path, key, {name: np.asarray(value) for name, value in vars(state).items()})


def _kept(path: Path, key: dict[str, Any]) -> State | None:
    if not path.exists():
        return None
    found = formats.read_arrays(path, key)
    if found is None:
        raise ThermorenderError(
            f"{path} belongs to other frames, poses or settings, to another scene or camera, or is damaged; give "
            f"another folder, or remove {path.parent} and all in it"
        )
    tilt_k, noise_k, alike_px = (float(found.pop(name)) for name in ("tilt_k", "noise_k", "alike_px"))
    rounds = int(found.pop("rounds"))
    return State(**found, tilt_k=tilt_k, noise_k=noise_k, alike_px=alike_px, rounds=rounds)


def check_folder(folder: str | PathLike[str]) -> None:
    """Raise unless a folder is new, empty, or that of a reconstruction, which may have been killed before its state."""
    path = Path(folder)
    if any((path / name).is_file() for name in (STATE, ADJUSTED)) or files.only_left_behind(path):
        return
    files.check_new_folder(path)
