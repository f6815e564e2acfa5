"""Temperatures of a scene at instants, by the source that its temperature state names."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from thermorender.scene.scene import Scene
from thermorender.scene.temperature_state import Conditional, Moved

if TYPE_CHECKING:
    # These import Mitsuba, which is loaded if there is a renderer.
    from thermorender.render.baked import Progress
    from thermorender.render.geometry import Geometry
    from thermorender.render.heat.known_light import Record


def solved_at(
    scene: Scene,
    times: "Sequence[np.datetime64]",
    geometry: "Geometry | None" = None,
    progress: "Progress | None" = None,
    records: "list[Record] | None" = None,
    known: "Record | None" = None,
) -> list[Scene]:
    """Return the scene with its temperatures solved at each of some instants, by `heat.simulation.solved`,
    `heat.moved.moved` or `heat.relief.mapped`, as the source of its temperature state. `records` and `known` are as of
    `solved`."""
    # Imported here, as other scenes do not need them.
    source = scene.temperature_state.source
    if isinstance(source, Conditional):
        from thermorender.render.heat.relief import mapped

        return mapped(scene, times, geometry, progress)
    if not isinstance(source, Moved):
        from thermorender.render.heat.simulation import solved

        return solved(scene, times, geometry, progress, records=records, known=known)
    from thermorender.render.heat.moved import moved

    return [each.scene for each in moved(scene, times, geometry, progress)]
