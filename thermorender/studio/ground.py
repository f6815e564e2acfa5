"""The map: the orthophoto with the materials over it, and areas that a hand gives another material."""

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.files import reported
from thermorender.studio.document import Document, Painted
from thermorender.studio.pictures import colours_of_materials, jpeg

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene
    from thermorender.studio.session import Session

_LEAST_PIXELS, _MOST_PIXELS = 1000, 2000
_MOST_CORNERS = 5000


def map_picture(scene: "Scene", percent: int) -> bytes:
    """Return a JPEG of the orthophoto under the materials' colours, which cover `percent` of it."""
    import cv2

    ground = scene.surfaces[0]
    share = min(max(percent, 0), 100) / 100.0
    colours = colours_of_materials()[ground.material]
    mixed: Any = cv2.addWeighted(np.ascontiguousarray(ground.colour), 1.0 - share, colours, share, 0.0)
    # A small map is enlarged, so that its texels can be hit.
    scale = float(np.clip(1.0, _LEAST_PIXELS / max(mixed.shape[:2]), _MOST_PIXELS / max(mixed.shape[:2])))
    if scale != 1.0:
        how = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_NEAREST
        mixed = cv2.resize(mixed, None, fx=scale, fy=scale, interpolation=how)
    return jpeg(mixed)


def refuse_without_map(scene: "Scene") -> None:
    """Raise unless the scene's terrain is an elevation raster with a place."""
    if scene.grid is None or scene.frame is None:
        raise ThermorenderError(
            f"{scene.name} has no map, as its terrain is a mesh; assign materials to its classes and objects"
        )


def material_at(scene: "Scene", x: float, y: float) -> str:
    """Return the material at a place of the map, by shares of its width and height."""
    number = scene.surfaces[0].material[_texel(scene, x, y)]
    return scene.materials[int(number)].name


def filled(scene: "Scene", x: float, y: float) -> dict[str, Any]:
    """Return the connected area of one material around a place of the map, as a GeoJSON geometry."""
    import cv2
    from rasterio.features import shapes

    number, texel = scene.surfaces[0].material, _texel(scene, x, y)
    _, parts = cv2.connectedComponents((number == number[texel]).astype(np.uint8), connectivity=4)
    mask: NDArray[np.bool_] = parts == parts[texel]
    assert scene.grid is not None
    geometry: dict[str, Any] = next(
        shape for shape, _ in shapes(mask.astype(np.uint8), mask=mask, transform=scene.grid.transform)
    )
    return geometry


def polygon(scene: "Scene", corners: Any) -> dict[str, Any]:
    """Return the polygon of corners on the map, by shares of its width and height, as a GeoJSON geometry."""
    points = np.asarray(corners, np.float64)
    if (
        points.ndim != 2
        or points.shape[1] != 2
        or not 3 <= len(points) <= _MOST_CORNERS
        or not np.isfinite(points).all()
    ):
        raise ThermorenderError(f"an area needs 3 … {_MOST_CORNERS} corners on the map; draw it again")
    grid = scene.grid
    assert grid is not None
    x, y = grid.transform * (points[:, 0] * grid.width, points[:, 1] * grid.height)
    ring = np.column_stack([x, y]).tolist()
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}


def painted(session: "Session", geometry: dict[str, Any], material: str, document: Document) -> Document:
    """Return a Document with an area of another material; its file goes into the session's own folder."""
    grid = session.base.grid
    assert grid is not None
    crs = {"type": "name", "properties": {"name": grid.crs.to_string()}}
    feature = {"type": "Feature", "geometry": geometry, "properties": {"material": material}}
    folder = Path(session.areas.name)
    with reported(folder):
        path = folder / f"area-{len(list(folder.iterdir())) + 1}.geojson"
        path.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": [feature]}), encoding="utf-8")
    return document.with_area(Painted(path, material))


def _texel(scene: "Scene", x: float, y: float) -> tuple[int, int]:
    height, width = scene.surfaces[0].material.shape
    return int(np.clip(y * height, 0, height - 1)), int(np.clip(x * width, 0, width - 1))
