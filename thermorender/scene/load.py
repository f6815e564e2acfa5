"""A scene folder read into a Scene, and flight logs read over it."""

import os
from collections.abc import Iterable
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import Literal

from numpy.typing import ArrayLike

from thermorender.errors import ThermorenderError, shortened
from thermorender.paths import data_folder
from thermorender.scene.arguments import objects_under
from thermorender.scene.declared import Declared
from thermorender.scene.folder import read_files
from thermorender.scene.scene import Scene
from thermorender.scene.spec import read_scene
from thermorender.scene.temperature import learned_map
from thermorender.sensor.camera import load_camera
from thermorender.trajectory.path import Anchor, Trajectory
from thermorender.trajectory.readers import read_trajectory


def scene_folder(name: str | PathLike[str]) -> Path:
    """Return the folder of a scene given by path, or by the name of a shipped one.

    Raises
    ------
    ThermorenderError
        Neither exists; the message lists the shipped scenes.
    """
    path = Path(name)
    if os.path.isfile(path / "scene.toml") or path.name == "scene.toml":
        return path
    shipped = data_folder("scenes")
    found = {item.parent.relative_to(shipped).as_posix(): item.parent for item in shipped.rglob("scene.toml")}
    # A path, or a part of the user's own folder, is not taken for a shipped scene.
    own = str(name).startswith(".") or (len(path.parts) > 1 and os.path.lexists(path.parts[0]))
    if path.as_posix() in found and not own:
        return found[path.as_posix()]
    known = ", ".join(sorted(found))
    what = "holds no scene.toml" if os.path.isdir(path) else "is a file" if os.path.exists(path) else "does not exist"
    raise ThermorenderError(f"scene {str(name)!r} {what}; give a folder with a scene.toml or one of {known}")


def load_scene(name: str | PathLike[str]) -> Scene:
    """Return the Scene of a folder, or of a shipped scene by name.

    Parameters
    ----------
    name : path or str
        Folder holding `scene.toml`, or "village", "heath", "ridge"; "village/survey" and so on are their surveys from
        above, scenes of rasters.

    Raises
    ------
    ThermorenderError
        Anything in the scene file or the files it names that cannot be used, in one sentence.
    """
    spec = read_scene(scene_folder(name))
    where = str(spec.folder / "scene.toml")
    camera = load_camera(spec.camera, f"{where}: camera.model")
    declared = Declared(
        replace(spec, objects=objects_under(spec.temperature.source, spec.objects, spec)),
        camera,
        files=read_files(spec, where),
        time=spec.weather.time if spec.weather else None,
        place_altitude_m=spec.atmosphere.altitude_m if spec.atmosphere else None,
        last_sky=spec.sky_temperature,
        temperature_map=learned_map(spec.temperature),
        of_file=spec,
    )
    return Scene(declared)


def load_trajectory(
    paths: str | PathLike[str] | Iterable[str | PathLike[str]], scene: Scene, *,
    format: str | PathLike[str] | None = None, anchor: Anchor | None = None, clock_offset_s: float = 0.0,
    mount: ArrayLike | None = None, lever_arm_m: ArrayLike = (0.0, 0.0, 0.0), course: bool = False,
    duplicates: Literal["refuse", "spread", "first"] = "refuse",
) -> Trajectory:  # fmt: skip
    """Return the camera's Trajectory over a scene from one or several CSV files of a flight.

    Parameters
    ----------
    paths : path or list of paths
        One file, or several with different columns and their own times.
    scene : Scene
        Its place converts latitude and longitude, its ground and geoid convert heights.
    format, anchor, clock_offset_s, mount, lever_arm_m, course, duplicates
        As of `thermorender.trajectory.read_trajectory`.

    Raises
    ------
    ThermorenderError
        A file or an argument is invalid; for a log the message names file, row and column.
    """
    if not isinstance(scene, Scene):
        raise ThermorenderError(
            f"load_trajectory: scene={shortened(repr(scene))} is not a Scene; give what load_scene returns"
        )
    return read_trajectory(
        paths, frame=scene.frame, ground=scene.ground, geoid_undulation_m=scene.geoid_undulation_m, format=format,
        anchor=anchor, clock_offset_s=clock_offset_s, mount=mount, lever_arm_m=lever_arm_m, course=course,
        duplicates=duplicates,
    )  # fmt: skip
