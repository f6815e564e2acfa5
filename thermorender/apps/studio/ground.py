"""The map: layers of colour over the orthophoto, and areas that a hand gives a material, to paint or to train on."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.studio.pictures import Legend, colours_of_materials, hexadecimal, legend_of, table
from thermorender.errors import ThermorenderError
from thermorender.formats import encoded_image
from thermorender.scene.raster import Grid

if TYPE_CHECKING:
    from thermorender import Scene
    from thermorender.apps.studio.session import Session

_LEAST_PIXELS, _MOST_PIXELS = 1000, 2000
_MOST_CORNERS = 5000
_UNCERTAIN = "inferno"
_HOW = "Fill: click a region. Polygon: click corners, double-click the last. Lasso: drag around."
_MISSING = "No map is learned yet: label areas of two or more materials, and press Train."


@dataclass(frozen=True, eq=False)
class Layer:
    """Colours over an orthophoto."""

    photograph: NDArray[np.uint8]  # (h, w, 3) uint8 sRGB
    level: NDArray[np.uint8]  # (h, w) uint8
    colours: NDArray[np.uint8]  # (256, 3) uint8 sRGB of each level
    words: str  # What they show
    legend: Legend


def layer_of(session: "Session", name: str) -> Layer:
    """Return a layer of the map, the materials for one that is not learned yet."""
    if name in session.learned:
        return session.learned[name]
    scene = session.scene
    ground, names = scene.surfaces[0], [each.name for each in scene.materials]
    words = _HOW if name == "materials" else _MISSING
    return Layer(ground.colour, ground.material, colours_of_materials(), words, legend_of(ground.material, names))


def map_picture(session: "Session", percent: int, name: str) -> bytes:
    """Return a JPEG of the orthophoto under a layer's colours, which cover `percent` of it."""
    import cv2

    layer, share = layer_of(session, name), min(max(percent, 0), 100) / 100.0
    photograph, colours = np.ascontiguousarray(layer.photograph), layer.colours[layer.level]
    mixed: Any = cv2.addWeighted(photograph, 1.0 - share, colours, share, 0.0)
    # A small map is enlarged, so that its texels can be hit.
    scale = float(np.clip(1.0, _LEAST_PIXELS / max(mixed.shape[:2]), _MOST_PIXELS / max(mixed.shape[:2])))
    if scale != 1.0:
        how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
        mixed = cv2.resize(mixed, None, fx=scale, fy=scale, interpolation=how)
    return encoded_image(".jpg", mixed)


def grid_of(scene: "Scene") -> Grid:
    """Return the grid of a scene's map; ThermorenderError unless its terrain is an elevation raster with a place."""
    if scene.grid is None or scene.frame is None:
        raise ThermorenderError(
            f"{scene.name} has no map, as its terrain is a mesh; assign materials to its classes and objects"
        )
    return scene.grid


def filled(scene: "Scene", x: float, y: float) -> dict[str, Any]:
    """Return the connected area of one material around a place of the map, as a GeoJSON geometry."""
    import cv2
    from rasterio.features import shapes

    number = scene.surfaces[0].material
    height, width = number.shape
    texel = int(np.clip(y * height, 0, height - 1)), int(np.clip(x * width, 0, width - 1))
    _, parts = cv2.connectedComponents((number == number[texel]).astype(np.uint8), connectivity=4)
    mask: Any = parts == parts[texel]
    found = shapes(mask.astype(np.uint8), mask=mask, transform=grid_of(scene).transform)
    return dict(next(shape for shape, _ in found))


def polygon(scene: "Scene", corners: Any) -> dict[str, Any]:
    """Return the polygon of corners on the map, by shares of its width and height, as a GeoJSON geometry."""
    points, grid = np.asarray(corners, np.float64), grid_of(scene)
    known = points.ndim == 2 and points.shape[1] == 2 and np.isfinite(points).all()
    if not known or not 3 <= len(points) <= _MOST_CORNERS:
        raise ThermorenderError(f"an area needs 3 … {_MOST_CORNERS} corners on the map; draw it again")
    x, y = grid.to_map(points[:, 0] * grid.width, points[:, 1] * grid.height)
    ring = np.column_stack([x, y]).tolist()
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}


def labelled(geometry: dict[str, Any], material: str) -> dict[str, Any]:
    """Return the GeoJSON feature of an area whose material is known."""
    return {"type": "Feature", "geometry": geometry, "properties": {"material": material}}


def collection(grid: Grid, labels: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return areas as GeoJSON, which `Scene.with_material_in` and `thermorender train emissivity --labels` read."""
    crs = {"type": "name", "properties": {"name": grid.crs.to_string()}}
    return {"type": "FeatureCollection", "name": "the map", "crs": crs, "features": list(labels)}


def outlines(grid: Grid, labels: Sequence[dict[str, Any]]) -> list[list[list[float]]]:
    """Return the outer ring of each label as shares of the map's width and height."""
    rings = [np.asarray(each["geometry"]["coordinates"][0], np.float64) for each in labels]
    places = [np.column_stack(grid.to_pixel(ring[:, 0], ring[:, 1])) / (grid.width, grid.height) for ring in rings]
    return [place.round(5).tolist() for place in places]


def learned_from(session: "Session", progress: Callable[[str, float], None]) -> dict[str, Layer]:
    """Return the layers of a map that the session's labels give on the scene as saved.

    `progress` may raise to end the training.
    """
    from thermorender.apps.training.material_training import band_emissivity_of, train_on
    from thermorender.learned.emissivity.mapping import map_materials
    from thermorender.scene.material_map import orthophoto_of

    labels, folder = collection(grid_of(session.base), session.labels), session.base.spec.folder
    model, _ = train_on([folder], labels, "studio", progress=progress)
    picture = orthophoto_of(session.base.spec)
    found = map_materials(
        model, picture.colour, picture.texel_m, lambda share: progress("mapping the materials", share)
    )
    std = model.moments(found.probability, np.array([*map(band_emissivity_of([folder]), model.materials)]))[2]
    # Materials of the scene keep the colours of the other layer; those beyond it get the next ones.
    names = list(dict.fromkeys([*(each.name for each in session.base.materials), *model.materials]))
    best = np.array([names.index(name) for name in model.materials], np.uint8)[found.index[..., 0]]
    covers = np.bincount(best.ravel(), minlength=len(names)) / best.size
    accuracy = model.about["held_out_accuracy"]
    tested = "not tested: no block was held out" if accuracy is None else f"{accuracy:.0%} of held-out texels right"
    shown = ", ".join(f"{name} {covers[names.index(name)]:.0%}" for name in model.materials)
    scale, most = table(_UNCERTAIN), max(float(std.max()), 1e-3)
    steps = ((f"{share * most:.4f}", hexadecimal(scale[int(255 * share)])) for share in (0.0, 0.25, 0.5, 0.75, 1.0))
    spread = f"Standard deviation of the emissivity: mean {std.mean():.4f}"
    words, level = f"Most probable: {shown}; {tested}", (255.0 * std / most).astype(np.uint8)
    return {
        "learned": Layer(picture.colour, best, colours_of_materials(), words, legend_of(best, names)),
        "uncertainty": Layer(picture.colour, level, scale, spread, tuple(steps)),
    }
