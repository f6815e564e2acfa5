"""Drapes of the shipped landscapes for studies: rasters, which the path-traced reference renders too."""

from pathlib import Path

from thermorender import defaults, files
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.lands.procedural.truth import write
from thermorender.scene.load import load_scene

KINDS = defaults.SCENES
FOLDER = Path("out/drapes")


def load_drape(scene):
    """The Scene of `drape(scene)`."""
    return load_scene(drape(scene))


def drape(scene):
    """Path of the drape of a landscape by its name, as of `make-scene NAME --draped`; anything else is returned."""
    if scene not in KINDS:
        return scene
    folder = FOLDER / scene
    # Studies and tests run side by side.
    with files.in_use(files.make_folder(FOLDER), wait=True):
        if not folder.exists():
            write(make(scene), folder)
    return folder
