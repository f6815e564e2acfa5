"""Names of a scene's objects, and their numbers in images."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.scene.scene import Scene


def object_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of a scene's objects, static ones first."""
    return tuple(dict.fromkeys(_owners(scene)[scene.terrain_count :]))


def objects_of_surfaces(scene: Scene) -> NDArray[np.uint32]:
    """Return the number of each surface's object, from 1 in the order of `object_names`; terrain is 0, moving objects
    are last."""
    owner, number = _owners(scene), {name: k for k, name in enumerate(object_names(scene), start=1)}
    return np.array([0 if k < scene.terrain_count else number[name] for k, name in enumerate(owner)], np.uint32)


def object_numbers(scene: Scene, valid: NDArray[np.bool_], texel: NDArray[Any]) -> NDArray[np.uint32]:
    """Return the number of each pixel's object, 0 for none; `valid` and `texel` are from `truth.pixel_middles`."""
    moving = [surface for tracked in scene.tracked_objects for surface in tracked.surfaces]
    ends = np.cumsum([surface.material.size for surface in (*scene.surfaces, *moving)])
    surface = np.minimum(np.searchsorted(ends, texel, side="right"), len(ends) - 1)
    return np.where(valid, objects_of_surfaces(scene)[surface], np.uint32(0))


def _owners(scene: Scene) -> list[str]:
    """The name of the object or terrain that each surface belongs to, those of moving objects last."""
    moving = [surface for tracked in scene.tracked_objects for surface in tracked.surfaces]
    return [surface.name.split(":")[0] for surface in (*scene.surfaces, *moving)]
