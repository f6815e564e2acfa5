"""The map: the orthophoto with the materials over it, and areas that a hand gives another material."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.errors import ThermorenderError
from thermorender.files import reported
from thermorender.scene.raster import Grid
from thermorender.studio.document import Document, Painted
from thermorender.studio.fields import scratch_folder
from thermorender.studio.pictures import Legend, colours_of_materials, hexadecimal, jpeg, legend_of, table

if TYPE_CHECKING:
    from thermorender.scene.scene import Scene
    from thermorender.studio.session import Session

_LEAST_PIXELS, _MOST_PIXELS = 1000, 2000
_MOST_CORNERS = 5000
_UNCERTAIN = "inferno"


@dataclass(frozen=True, eq=False)
class Label:
    """An area whose material is known, as a GeoJSON geometry."""

    geometry: dict[str, Any]
    material: str


@dataclass(frozen=True, eq=False)
class Learned:
    """What a map learned from labels says of the orthophoto.

    Attributes
    ----------
    photograph : (h, w, 3) uint8
        sRGB.
    layers : dict of str to (h, w, 3) uint8
        Colours of the most probable material, "learned", and of the emissivity's standard deviation, "uncertainty".
    words : dict of str to str
        What each layer shows.
    legends : dict of str to Legend
    """

    photograph: NDArray[np.uint8]
    layers: dict[str, NDArray[np.uint8]]
    words: dict[str, str]
    legends: dict[str, Legend]


def legend(session: "Session", layer: str) -> Legend:
    """Return the legend of a layer of the map."""
    if session.learned is not None and layer in session.learned.legends:
        return session.learned.legends[layer]
    scene = session.scene
    return legend_of(scene.surfaces[0].material, [each.name for each in scene.materials])


def map_picture(session: "Session", percent: int, layer: str) -> bytes:
    """Return a JPEG of the orthophoto under a layer's colours, which cover `percent` of it."""
    import cv2

    ground, learned = session.scene.surfaces[0], session.learned
    photograph, colours = ground.colour, colours_of_materials()[ground.material]
    if learned is not None and layer in learned.layers:
        photograph, colours = learned.photograph, learned.layers[layer]
    share = min(max(percent, 0), 100) / 100.0
    mixed: Any = cv2.addWeighted(np.ascontiguousarray(photograph), 1.0 - share, colours, share, 0.0)
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
    x, y = grid.to_map(points[:, 0] * grid.width, points[:, 1] * grid.height)
    ring = np.column_stack([x, y]).tolist()
    return {"type": "Polygon", "coordinates": [[*ring, ring[0]]]}


def painted(session: "Session", geometry: dict[str, Any], material: str, document: Document) -> Document:
    """Return a Document with an area of another material; its file goes into the session's own folder."""
    grid = session.base.grid
    assert grid is not None
    folder = Path(session.areas.name)
    with reported(folder):
        path = folder / f"area-{len(list(folder.iterdir())) + 1}.geojson"
        path.write_text(labels_text(grid, [Label(geometry, material)]), encoding="utf-8")
    return document.with_area(Painted(path, material))


def labels_text(grid: Grid, labels: Sequence[Label]) -> str:
    """Return areas as a GeoJSON file, which `thermorender train emissivity --labels` reads."""
    crs = {"type": "name", "properties": {"name": grid.crs.to_string()}}
    features = [{"type": "Feature", "geometry": each.geometry, "properties": {"material": each.material}}
                for each in labels]  # fmt: skip
    return json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}, indent=1)


def outlines(grid: Grid, labels: Sequence[Label]) -> list[list[list[float]]]:
    """Return the outer ring of each label as shares of the map's width and height."""
    rings = [np.asarray(each.geometry["coordinates"][0], np.float64) for each in labels]
    places = [np.column_stack(grid.to_pixel(ring[:, 0], ring[:, 1])) / (grid.width, grid.height) for ring in rings]
    return [place.round(5).tolist() for place in places]


def learned_from(session: "Session", progress: Callable[[str, float], None]) -> Learned:
    """Return the map that the session's labels give on the scene as saved; `progress` may raise to end the training.

    Raises
    ------
    ThermorenderError
        As `thermorender.campaign.material_training.train_on`.
    """
    from thermorender.campaign.material_training import band_emissivity_of, train_on
    from thermorender.learned.emissivity.mapping import map_materials
    from thermorender.scene.material_map import orthophoto_of

    refuse_without_map(session.base)
    assert session.base.grid is not None
    folder = session.base.spec.folder
    with scratch_folder() as scratch:
        path = Path(scratch, "labels.geojson")
        path.write_text(labels_text(session.base.grid, session.labels), encoding="utf-8")
        try:
            model, _ = train_on([folder], path, "studio", progress=progress)
        except ThermorenderError as error:
            raise ThermorenderError(_on_map(str(error), path)) from None
    picture = orthophoto_of(session.base.spec)
    found = map_materials(
        model, picture.colour, picture.texel_m, lambda share: progress("mapping the materials", share)
    )
    emissivity_of = band_emissivity_of([folder])
    of_material = np.array([emissivity_of(name) for name in model.materials], np.float32)
    share = found.probability / np.maximum(found.probability.sum(axis=-1, keepdims=True, dtype=np.float32), 1.0)
    mean = share @ of_material
    std = np.sqrt(np.maximum(share @ of_material**2 - mean**2, 0.0))
    # Materials of the scene keep the colours of the other layer; those beyond it get the next ones.
    names = list(dict.fromkeys([*(each.name for each in session.base.materials), *model.materials]))
    number = np.array([names.index(name) for name in model.materials])
    colours, most = colours_of_materials()[number], max(float(std.max()), 1e-3)
    best = found.index[..., 0]
    covers = np.bincount(best.ravel(), minlength=len(model.materials)) / best.size
    accuracy = model.about["held_out_accuracy"]
    tested = "not tested: no block was held out" if accuracy is None else f"{accuracy:.0%} of held-out texels right"
    shown = ", ".join(f"{name} {part:.0%}" for name, part in zip(model.materials, covers, strict=True))
    words = {
        "learned": f"Most probable: {shown}; {tested}",
        "uncertainty": f"Standard deviation of the emissivity: mean {std.mean():.4f}",
    }
    scale = table(_UNCERTAIN)
    layers = {"learned": colours[best], "uncertainty": scale[np.uint8(255.0 * std / most)]}
    steps = ((f"{share * most:.4f}", hexadecimal(scale[int(255 * share)])) for share in (0.0, 0.25, 0.5, 0.75, 1.0))
    legends = {"learned": legend_of(number.astype(np.uint8)[best], names), "uncertainty": tuple(steps)}
    return Learned(picture.colour, layers, words, legends)


def _on_map(sentence: str, path: Path) -> str:
    """A sentence on a file of labels, of the map that they were drawn on."""
    return sentence.replace(str(path), "the map").replace(path.name, "the map").replace("polygons", "areas")


def _texel(scene: "Scene", x: float, y: float) -> tuple[int, int]:
    height, width = scene.surfaces[0].material.shape
    return int(np.clip(y * height, 0, height - 1)), int(np.clip(x * width, 0, width - 1))
