"""A reconstruction from files to files: what the command `reconstruct` does."""

import hashlib
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from thermorender import Camera, Scene, ThermorenderError, files, formats, load_camera, load_scene
from thermorender.apps.survey.footage.lens_files import read_lens
from thermorender.apps.survey.inverse import products
from thermorender.apps.survey.inverse.adjustment import Adjusted, adjusted, adjusted_from, arrays_of
from thermorender.apps.survey.inverse.frames import Place, Survey, frame_files, places_of, read_frames
from thermorender.apps.survey.inverse.level import read_references
from thermorender.apps.survey.inverse.matches import View
from thermorender.apps.survey.inverse.notes import adjustment_notes
from thermorender.apps.survey.inverse.own_ground import between, level_scene, relief_scene, stated_camera
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.inverse.poses import PoseError
from thermorender.apps.survey.inverse.reconstruct import ADJUSTED, Progress, reconstruct
from thermorender.apps.survey.inverse.relief import Relief
from thermorender.apps.survey.inverse.solve import Settings

# Folder of the scene that is made for frames without one.
GROUND = "ground"
# Standard deviations of poses: of a drone's GPS and gimbal, and of RTK, whose antenna and clock are not the camera's.
_GPS, _RTK = PoseError(1.0, 0.7), PoseError(0.1, 0.7)
# Standard deviations of the ground about level ground, and about a surface model [m].
_RELIEF_M, _SURFACE_M = 3.0, 0.3
# Side of a texel of the map, without a scene [pixels on the ground].
_TEXEL_PX = 1.25
# Posts of a scene's ground for an adjustment along a frame's footprint, and most along all.
_POSTS, _MOST_POSTS = 400, 4000


class _OtherFolder(ThermorenderError):
    """A folder holds another reconstruction."""


@dataclass(frozen=True)
class Inputs:
    """The arguments of `reconstruct` on the command line."""

    frames: tuple[Path, ...]  # Files or folders
    scene: str | None = None  # Folder or name; None: level ground around the frames, with the relief that they show
    poses: Path | None = None  # File of poses; the frames' own tags by default
    camera: str | None = None
    texel_m: float | None = None
    pose_error: tuple[float, float] | None = None  # (2,) floats [m], [deg]; None: as the frames' receiver has it
    above_ground_m: float | None = None  # Of the first frame
    references: Path | None = None
    scale: tuple[float, float] | None = None  # (2,) floats (kelvin per count, kelvin of count 0)
    lens: Path | None = None  # File of a lens, in place of that of the poses or of the fit


def run(inputs: Inputs, folder: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Write a reconstruction into a folder, with the state of each round to resume from, and return its record."""
    paths = frame_files(inputs.frames)
    places = places_of(paths) if inputs.poses is None else read_poses(inputs.poses)
    with (
        files.output_folder(folder) as out,
        files.in_use(out),
        tempfile.TemporaryDirectory() as made,
    ):
        files.remove_parts(out)
        scene, survey, camera = _read(inputs, paths, places, Path(made))
        if inputs.references:
            read_references(inputs.references, scene.frame)  # Its faults show before the work
        error, doubts = _error(inputs, list(places.values()))
        survey = replace(survey, notes=(*survey.notes, *doubts))
        lens = survey.lens if inputs.lens is None else read_lens(inputs.lens)
        # A camera that the user names has the distortion that the poses lack.
        stated = lens is not None and not (lens.distortion is None and inputs.camera)
        if lens is not None and stated:
            camera, said = lens.applied(camera)
            survey = replace(survey, notes=(*survey.notes, said))
        if error.position_m > 0.0 or error.angle_deg > 0.0:
            survey, scene, camera = aligned(survey, scene, camera, error, not stated, inputs.scene is None, out,
                                            progress)  # fmt: skip
        elif inputs.scene is None:
            scene = _kept_scene(scene, out)
        references = read_references(inputs.references, scene.frame) if inputs.references else []
        texel_m = _texel_m(inputs, scene, survey, camera) if inputs.texel_m is None else inputs.texel_m
        found = reconstruct(scene, survey, camera, Settings(texel_m=texel_m, pose_error=error), references, out,
                            progress)  # fmt: skip
        products.write(found, out)
        products.write_page(found, out)
    return products.record(found)


def _read(
    inputs: Inputs, paths: Sequence[Path], places: Mapping[str, Place], made: Path
) -> tuple[Scene, Survey, Camera]:  # fmt: skip
    """(scene, frames over it, camera); without a scene, level ground is made in a folder."""
    if inputs.scene is not None:
        scene = load_scene(inputs.scene)
        survey = read_frames(paths, places, scene, inputs.scale, inputs.above_ground_m)
        return scene, survey, scene.camera if inputs.camera is None else load_camera(inputs.camera, "camera")
    scene = level_scene(list(places.values()), inputs.above_ground_m, made / GROUND)
    survey = read_frames(paths, places, scene, inputs.scale, inputs.above_ground_m)
    if inputs.camera is not None:
        return scene, survey, load_camera(inputs.camera, "camera")
    camera, said = stated_camera(paths[0], survey.kelvin.shape[1:])
    return scene, replace(survey, notes=(*survey.notes, said)), camera


def _error(inputs: Inputs, places: Sequence[Place]) -> tuple[PoseError, list[str]]:
    """(standard deviations of the poses, as given or of the receiver that their tags state; sentences on them)."""
    if inputs.pose_error is not None:
        return PoseError(*inputs.pose_error), []
    fixed = sum(place.error_m is not None for place in places)
    if fixed == len(places):
        return _RTK, []
    other = len(places) - fixed
    said = f"{other} of {len(places)} frames have no position by RTK, so all are taken to {_GPS.position_m:g} m"
    return _GPS, [said] if fixed else []


def aligned(
    survey: Survey, scene: Scene, camera: Camera, error: PoseError, fit_lens: bool, alone: bool, out: Path,
    progress: Progress | None = None,
) -> tuple[Survey, Scene, Camera]:  # fmt: skip
    """Return (frames with adjusted poses, scene, camera with its lens); the folder `out` keeps the adjustment.

    Frames `alone` get a scene with the relief that they show, in that folder. Frames without matches stay as they are.
    """
    if (camera.height, camera.width) != survey.kelvin.shape[1:]:
        return survey, scene, camera  # `reconstruct` refuses it
    ground = _posts(scene, View(camera, survey.poses, partial(_up, scene)))
    try:
        found = _kept_adjustment(survey, camera, error, ground, fit_lens, alone, out, progress)
    except _OtherFolder:
        raise
    except ThermorenderError as fault:
        note = f"lens, poses and heights stay as they are before the map: {fault}"
        scene = _kept_scene(scene, out) if alone else scene
        return replace(survey, notes=(*survey.notes, note)), scene, camera
    notes = (*survey.notes, *adjustment_notes(survey, found, error, fit_lens, alone))
    poses, stated = found.poses, survey.poses
    if alone:
        relief = found.relief
        feet = View(found.camera, poses, relief).footprints()
        low, high = np.nanmin(feet[:, 0], axis=0), np.nanmax(feet[:, 1], axis=0)
        margin = 0.05 * (high - low).max()
        shutil.rmtree(out / GROUND, ignore_errors=True)
        own = relief_scene(scene, relief, low - margin, high + margin, relief.step_m, out / GROUND)
        assert scene.frame is not None and own.frame is not None
        poses, stated = (between(each, scene.frame, own.frame) for each in (poses, stated))
        scene = own
    return replace(survey, poses=poses, stated=stated, notes=notes), scene, found.camera


def _kept_adjustment(
    survey: Survey, camera: Camera, error: PoseError, ground: Relief, fit_lens: bool, alone: bool, out: Path,
    progress: Progress | None,
) -> Adjusted:  # fmt: skip
    """The Adjusted of frames, from the folder of a run that was stopped if it has it."""
    data = hashlib.sha256(np.ascontiguousarray(survey.kelvin).tobytes())
    for each in (survey.poses, ground.up):
        data.update(np.ascontiguousarray(each).tobytes())
    key = {"frames": data.hexdigest(), "camera": repr(camera), "error": asdict(error), "lens": fit_lens, "alone": alone}
    kept = formats.read_arrays(out / ADJUSTED, key)
    if kept is not None:
        return adjusted_from(kept, camera)
    if (out / ADJUSTED).exists():
        raise _OtherFolder(
            f"{out / ADJUSTED} belongs to other frames, poses or settings, or is damaged; give another folder, "
            f"or remove {out} and all in it"
        )
    found = adjusted(survey.kelvin, camera, survey.poses, error, ground, _RELIEF_M if alone else _SURFACE_M, fit_lens,
                     alone, progress)  # fmt: skip
    formats.write_arrays(out / ADJUSTED, key, arrays_of(found))
    return found


def _up(scene: Scene, east: Any, north: Any) -> Any:
    return np.asarray(scene.ground(east, north), np.float64)


def _posts(scene: Scene, view: View) -> Relief:
    """The scene's ground around the frames on posts."""
    feet = view.footprints()
    known = np.isfinite(feet).all(axis=(1, 2))
    if not known.any():
        place = view.poses[:, :2, 3]
        low, high = place.min(axis=0) - 1.0, place.max(axis=0) + 1.0
    else:
        low, high = feet[known, 0].min(axis=0), feet[known, 1].max(axis=0)
    margin = 0.2 * (high - low).max() + 5.0
    side = float(np.median((feet[known, 1] - feet[known, 0]).max(axis=1))) if known.any() else 1.0
    step_m = max(side / _POSTS, float((high - low).max()) / _MOST_POSTS, 0.05)
    return Relief.sampled(partial(_up, scene), low - margin, high + margin, step_m)


def _kept_scene(scene: Scene, out: Path) -> Scene:
    """A scene that was made for the frames, in their folder."""
    shutil.rmtree(out / GROUND, ignore_errors=True)
    shutil.copytree(scene.spec.folder, out / GROUND)
    return load_scene(out / GROUND)


def _texel_m(inputs: Inputs, scene: Scene, survey: Survey, camera: Camera) -> float:
    """Side of a texel: of the scene, or by the pixels on the ground."""
    if inputs.scene is not None:
        return float(scene.main_surface.texel_m)
    pixel_m = View(camera, survey.poses, partial(_up, scene)).cell_m()
    return float(f"{_TEXEL_PX * pixel_m:.2g}")
