"""A reconstruction from files to files: what the command `reconstruct` does."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from thermorender import files, load_camera, load_scene
from thermorender.apps.survey.footage.lens_files import read_lens
from thermorender.apps.survey.inverse import products
from thermorender.apps.survey.inverse.frames import frame_files, read_frames
from thermorender.apps.survey.inverse.level import read_references
from thermorender.apps.survey.inverse.pose_files import read_poses
from thermorender.apps.survey.inverse.poses import PoseError
from thermorender.apps.survey.inverse.reconstruct import Progress, reconstruct
from thermorender.apps.survey.inverse.solve import Settings


@dataclass(frozen=True)
class Inputs:
    """The arguments of `reconstruct` on the command line."""

    scene: str  # Folder or name
    frames: tuple[Path, ...]  # Files or folders
    poses: Path | None = None  # File of poses; the frames' own tags by default
    camera: str | None = None
    texel_m: float | None = None
    pose_error: tuple[float, float] = (1.0, 0.7)  # (2,) floats [m], [deg]
    above_ground_m: float | None = None  # Of the first frame
    references: Path | None = None
    scale: tuple[float, float] | None = None  # (2,) floats (kelvin per count, kelvin of count 0)
    lens: Path | None = None  # File of a lens, in place of that of the poses or the camera


def run(inputs: Inputs, folder: Path, progress: Progress | None = None) -> dict[str, Any]:
    """Write a reconstruction into a folder, with the state of each round to resume from, and return its record."""
    scene = load_scene(inputs.scene)
    camera = scene.camera if inputs.camera is None else load_camera(inputs.camera, "camera")
    places = None if inputs.poses is None else read_poses(inputs.poses, scene)
    survey = read_frames(frame_files(inputs.frames), places, scene, inputs.scale, inputs.above_ground_m)
    lens = survey.lens if inputs.lens is None else read_lens(inputs.lens)
    # A camera that the user names has the distortion that the poses lack.
    if lens is not None and not (lens.distortion is None and inputs.camera):
        camera, said = lens.applied(camera)
        survey = replace(survey, notes=(*survey.notes, said))
    references = read_references(inputs.references) if inputs.references else []
    texel_m = scene.main_surface.texel_m if inputs.texel_m is None else inputs.texel_m
    settings = Settings(texel_m=texel_m, pose_error=PoseError(*inputs.pose_error))
    with files.output_folder(folder) as out, files.in_use(out):
        files.remove_parts(out)
        found = reconstruct(scene, survey, camera, settings, references, out, progress)
        products.write(found, out)
        products.write_page(found, out)
    return products.record(found)
