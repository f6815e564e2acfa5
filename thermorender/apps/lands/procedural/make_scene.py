"""A procedural scene from a seed to its folder."""

from pathlib import Path

from thermorender.apps.lands.procedural import three_d, truth
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.progress import Progress
from thermorender.scene.spec import WeatherSpec


def make_scene(
    kind: str, folder: Path, seed: int = 0, size_m: float | None = None, texel_m: float | None = None,
    post_m: float | None = None, weather: WeatherSpec | None = None, draped: bool = False,
    progress: Progress = lambda what, share: None,
) -> Path:  # fmt: skip
    """Write a procedural scene with its true temperatures to a new folder, and return that.

    Arguments are those of `procedural_scene.make`; `draped` makes rasters alone. `progress` may raise to end the work,
    which then leaves nothing behind.
    """
    progress("making the landscape", 0.0)
    if draped:
        return truth.write(make(kind, seed, size_m, texel_m, post_m, weather=weather), folder, progress=progress)
    world = three_d.make_world(kind, seed, size_m, texel_m, post_m, weather=weather)
    return three_d.write(world, folder, progress=progress)
