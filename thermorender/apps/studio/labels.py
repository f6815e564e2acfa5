"""Areas of the ground whose material a hand states, to train a map on."""

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.studio.layers import Learned
from thermorender.errors import ThermorenderError
from thermorender.scene.raster import Grid

if TYPE_CHECKING:
    from thermorender import Scene
    from thermorender.apps.studio.session import Session


def grid_of(scene: "Scene") -> Grid:
    """Return the grid of a scene's map; ThermorenderError unless its terrain is an elevation raster with a place."""
    if scene.grid is None or scene.frame is None:
        raise ThermorenderError(
            f"{scene.name} has no orthophoto to learn from, as its terrain is a mesh; paint its materials instead"
        )
    return scene.grid


def geometry_of(scene: "Scene", texels: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Return GeoJSON polygons around texels of a raster terrain, in the coordinates of its map."""
    from rasterio.features import shapes

    grid = grid_of(scene)
    mask = np.zeros(grid.height * grid.width, np.uint8)
    mask[texels] = 1
    image = mask.reshape(grid.height, grid.width)
    return [dict(shape) for shape, _ in shapes(image, mask=image > 0, transform=grid.transform)]


def labelled(geometry: dict[str, Any], material: str) -> dict[str, Any]:
    """Return the GeoJSON feature of an area whose material is known."""
    return {"type": "Feature", "geometry": geometry, "properties": {"material": material}}


def collection(grid: Grid, labels: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return areas as GeoJSON, which `Scene.with_material_in` and `thermorender train emissivity --labels` read."""
    crs = {"type": "name", "properties": {"name": grid.crs.to_string()}}
    return {"type": "FeatureCollection", "name": "the map", "crs": crs, "features": list(labels)}


def learned_from(session: "Session", progress: Callable[[str, float], None]) -> Learned:
    """Return the map that the session's labels give on the scene as saved.

    `progress` may raise to end the training.
    """
    from thermorender.apps.training.material_training import band_emissivity_of, train_on
    from thermorender.learned.emissivity.mapping import map_materials
    from thermorender.scene.material_map import orthophoto_of

    features, folder = [one for each in session.labels for one in each], session.base.spec.folder
    labels = collection(grid_of(session.base), features)
    model, _ = train_on([folder], labels, "studio", progress=progress)
    picture = orthophoto_of(session.base.spec)
    found = map_materials(
        model, picture.colour, picture.texel_m, lambda share: progress("mapping the materials", share)
    )
    std = model.moments(found.probability, np.array([*map(band_emissivity_of([folder]), model.materials)]))[2]
    # Materials of the scene keep their colours; those beyond it get the next ones.
    names = list(dict.fromkeys([*(each.name for each in session.base.materials), *model.materials]))
    best = np.array([names.index(name) for name in model.materials], np.uint8)[found.index[..., 0]]
    covers = np.bincount(best.ravel(), minlength=len(names)) / best.size
    accuracy = model.about["held_out_accuracy"]
    tested = "not tested: no block was held out" if accuracy is None else f"{accuracy:.0%} of held-out texels right"
    shown = ", ".join(f"{name} {covers[names.index(name)]:.0%}" for name in model.materials)
    return Learned(best, tuple(names), std.astype(np.float32), f"Most probable: {shown}; {tested}")
