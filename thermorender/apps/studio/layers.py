"""What a picture shows: values of the pixels of a view, by the camera or straight from above, and their statistics."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Frame, Renderer
from thermorender.apps.studio.view import View
from thermorender.errors import ThermorenderError
from thermorender.scene.surface import Surface

if TYPE_CHECKING:
    from thermorender import Scene
    from thermorender.sensor.camera import Camera

# Number of no material, as in `Frame.truth`.
NOTHING = 255
# Temperature for band emissivities [K].
BAND_K = 300.0
# Height of the rays of a plan above the highest point [m].
_ABOVE_M = 10.0


@dataclass(frozen=True)
class Layer:
    """A quantity that a picture may show."""

    title: str
    unit: str = ""  # "K", "mK", "W/m²" or "" for a number; of a layer of values
    channel: str = ""  # its name in an EXR; "" for a layer without values
    # Where it is there: by the camera, from above
    camera: bool = True
    plan: bool = True
    signed: bool = False  # whether zero is the middle of the colours
    terms: tuple[str, ...] = ()  # names in `Renderer.heat_terms` that it adds up


LAYERS = {
    "apparent": Layer("Apparent temperature", "K", "apparent_temperature", plan=False),
    "kinetic": Layer("Kinetic temperature", "K", "kinetic_temperature"),
    "emissivity": Layer("Emissivity in the band", "", "emissivity"),
    "error": Layer("Estimated error of the rendering", "mK", "error", plan=False),
    "net": Layer("Net radiation", "W/m²", "net_radiation", signed=True, terms=("sunlight", "longwave", "emission")),
    **{
        name: Layer(title, "W/m²", f"heat_{name}", signed=True, terms=(name,))
        for name, title in (
            ("sunlight", "Sunlight absorbed"),
            ("longwave", "Long-wave absorbed"),
            ("emission", "Long-wave emitted"),
            ("sensible", "Convection"),
            ("latent", "Evaporation"),
            ("conduction", "Conduction"),
            ("rain", "Rain"),
            ("melt", "Melting"),
        )
    },
    "display": Layer("Camera display", plan=False),
    "photograph": Layer("Photograph"),
    "materials": Layer("Material map"),
    "learned": Layer("Learned materials"),
    "uncertainty": Layer("Standard deviation of the learned emissivity", "", "emissivity_std"),
}


def layers_of(scene: "Scene", plan: bool, learned: bool) -> dict[str, str]:
    """Return the titles of the layers of a scene by the camera, or from above; `learned` where a map is known."""
    driven = scene.temperature_state.weather_driven
    return {
        key: about.title for key, about in LAYERS.items()
        if (about.plan if plan else about.camera) and (driven or not about.terms)
        and (learned or key not in ("learned", "uncertainty"))
    }  # fmt: skip


def unit_text(unit: str) -> str:
    """Return a unit as a part of a name: "K", "mK", "w_m2" or "1"."""
    return {"W/m²": "w_m2", "": "1"}.get(unit, unit.lower())


@dataclass(frozen=True)
class Learned:
    """A map of the ground that labels gave, on the texels of the first surface."""

    best: NDArray[np.uint8]  # (h, w) number of the most probable material
    names: tuple[str, ...]  # of those numbers
    std: NDArray[np.float32]  # (h, w) standard deviation of the emissivity
    words: str  # what it found


@dataclass(frozen=True, eq=False)
class Plan:
    """The highest texels under the pixels of a view straight from above; north is up."""

    texels: NDArray[np.int64]  # (H, W) over the static surfaces; −1 for none
    position: NDArray[np.float32]  # (H, W, 3) local [m]; NaN for none
    pixel_m: float

    @classmethod
    def of(cls, renderer: Renderer, view: View, camera: "Camera") -> "Plan":
        """Return the Plan around the point in the middle of a view, about as wide as what the camera sees there."""
        east, north, width = plan_window(view, camera)
        pixel_m = width / camera.width
        x, y = plan_places(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5, east, north, pixel_m, camera)
        e, n = (each.ravel() for each in np.meshgrid(x, y))
        top = top_of(renderer) + _ABOVE_M
        down = np.broadcast_to([0.0, 0.0, -1.0], (len(e), 3))
        distance, texel = renderer.hits(np.stack([e, n, np.full(len(e), top)], axis=-1), down)
        position = np.stack([e, n, top - np.where(np.isfinite(distance), distance, np.nan)], axis=-1)
        position[texel < 0] = np.nan
        shape = camera.height, camera.width
        return cls(texel.reshape(shape), position.reshape(*shape, 3).astype(np.float32), pixel_m)


def top_of(renderer: Renderer) -> float:
    """Return the height of the highest vertex [m]."""
    return max(float(surface.vertices[:, 2].max()) for surface in renderer.scene.surfaces)


def plan_window(view: View, camera: "Camera") -> tuple[float, float, float]:
    """Return (east, north of the middle, width) of a plan [m]."""
    middle = view.pose.matrix()[:3, 3] + view.pose.distance_m * view.pose.matrix()[:3, 2]
    width = 2.0 * view.pose.distance_m * np.tan(np.radians(camera.field_of_view_deg[0]) / 2.0)
    return float(middle[0]), float(middle[1]), float(width)


def plan_places(
    column: NDArray[Any], row: NDArray[Any], east: float, north: float, pixel_m: float, camera: "Camera"
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return (east, north) of places in the picture of a plan [m]."""
    return east + (column - 0.5 * camera.width) * pixel_m, north - (row - 0.5 * camera.height) * pixel_m


@dataclass(eq=False)
class Shot:
    """A view of one rendered state of the scene, and what its pixels show."""

    view: View
    renderer: Renderer
    frame: Frame | None  # by the camera; None from above
    plan: Plan | None
    learned: Learned | None = None
    other: "Shot | None" = None  # the same view of what it is compared with
    _values: dict[str, NDArray[np.float32]] = field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """The materials, by their numbers."""
        return tuple(material.name for material in self.renderer.scene.materials)

    @cached_property
    def texels(self) -> NDArray[np.int64]:
        """The texel of the static surfaces at each pixel's middle, (H, W); −1 where there is none."""
        if self.plan is not None:
            return self.plan.texels
        assert self.frame is not None
        return self.renderer.texels(self.frame.pose, self.frame.time_s, static=True)

    @cached_property
    def position(self) -> NDArray[np.float32]:
        """The local point at each pixel's middle, (H, W, 3) [m]; NaN where there is none."""
        if self.plan is not None:
            return self.plan.position
        assert self.frame is not None
        found: NDArray[np.float32] = self.frame.truth["position"]
        return found

    @cached_property
    def material(self) -> NDArray[np.uint8]:
        """The number of the material at each pixel's middle, (H, W); `NOTHING` where there is none."""
        if self.frame is not None:
            return np.where(np.isfinite(self.frame.truth["depth"]), self.frame.truth["material"], np.uint8(NOTHING))
        return self._at(self._flat("material"), np.uint8(NOTHING))

    @cached_property
    def colour(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """(photograph (H, W, 3), whether a pixel has a colour (H, W))."""
        if self.frame is not None:
            return self.renderer.visible(self.frame.pose, time_s=self.frame.time_s)
        surfaces = self.renderer.scene.surfaces
        every = np.concatenate([surface.colour.reshape(-1, 3) for surface in surfaces])
        return every[np.maximum(self.texels, 0)], self.texels >= 0

    def shows(self, layer: str) -> str:
        """Return why a layer is not there in this view; "" where it is."""
        about = LAYERS[layer]
        if not (about.camera if self.plan is None else about.plan):
            return f"{about.title} is not shown {'by the camera' if self.plan is None else 'from above'}"
        if layer in ("learned", "uncertainty") and self.learned is None:
            return "no map is learned yet: label areas of two or more materials, and press Train"
        if about.terms and not self.renderer.scene.temperature_state.weather_driven:
            return 'this scene has no heat balance, so it has no heat fluxes; give it `temperature` source "balance"'
        return ""

    def values(self, layer: str) -> NDArray[np.float32]:
        """Return the values of a layer at the pixels, (H, W) float32 in its unit; NaN where there is none.

        Raises
        ------
        ThermorenderError
            The layer is not there in this view, has no values, or is not known before the exact solution.
        """
        if reason := self.shows(layer):
            raise ThermorenderError(reason)
        if layer not in self._values:
            self._values[layer] = self._found(layer).astype(np.float32)
        return self._values[layer]

    def _found(self, layer: str) -> NDArray[Any]:
        about, frame = LAYERS[layer], self.frame
        if about.terms:
            return self._at(np.sum([self._heat_terms()[name] for name in about.terms], axis=0), np.float32(np.nan))
        if layer == "uncertainty" and self.learned is not None:
            return self._on_ground(self.learned.std, np.float32(np.nan))
        if frame is not None and layer in ("apparent", "kinetic", "emissivity", "error"):
            if layer == "apparent":
                return frame.apparent_temperature
            if layer == "error" and frame.error_mk is not None:
                return frame.error_mk
            return frame.truth["kinetic_temperature" if layer == "kinetic" else "emissivity"]
        if layer == "kinetic":
            return self._at(self._flat("temperature"), np.float32(np.nan))
        if layer == "emissivity":
            scene = self.renderer.scene
            band = [_band_mean(each, scene.camera.band_um) for each in scene.materials]
            return np.array([*band, np.nan], np.float32)[np.minimum(self.material, len(band))]
        raise ThermorenderError(f"{about.title} has no values; show a layer with a bar")

    def _heat_terms(self) -> dict[str, NDArray[np.float32]]:
        found = self.renderer.heat_terms()
        if found is None:
            raise ThermorenderError("a preview has no terms of the heat balance; wait for the exact solution")
        return found

    def heat_at(self, column: int, row: int) -> dict[str, float]:
        """Return the terms of the heat balance at a pixel [W m⁻²]; empty where they are not solved or not known yet."""
        texel = int(self.texels[row, column])
        found = self.renderer.heat_terms() if self.renderer.scene.temperature_state.weather_driven else None
        if found is None or texel < 0:
            return {}
        values = {name: float(each[texel]) for name, each in found.items()}
        return values if np.isfinite(list(values.values())).all() else {}

    def learned_materials(self) -> NDArray[np.uint8]:
        """The numbers of the learned materials at the pixels, (H, W); `NOTHING` off the ground."""
        assert self.learned is not None
        return self._on_ground(self.learned.best, np.uint8(NOTHING))

    def _flat(self, name: str) -> NDArray[Any]:
        return np.concatenate([getattr(surface, name).ravel() for surface in self.renderer.scene.surfaces])

    def _at(self, flat: NDArray[Any], nothing: Any) -> NDArray[Any]:
        """Values of texels at the pixels."""
        inside = (self.texels >= 0) & (self.texels < len(flat))
        return np.where(inside, flat[np.where(inside, self.texels, 0)], nothing)

    def _on_ground(self, image: NDArray[Any], nothing: Any) -> NDArray[Any]:
        """Values of an image over the first surface at the pixels."""
        ground = self.renderer.scene.surfaces[0]
        return self._at(_onto(image, ground).ravel(), nothing)

    def pixel_of(self, point: NDArray[np.floating]) -> tuple[int, int] | None:
        """Return the (column, row) that shows a local point; None where it is hidden or outside the picture."""
        camera = self.renderer.scene.camera
        if self.plan is not None:
            east, north, _ = plan_window(self.view, camera)
            place = np.array([
                (point[0] - east) / self.plan.pixel_m + 0.5 * camera.width,
                (north - point[1]) / self.plan.pixel_m + 0.5 * camera.height,
            ])  # fmt: skip
            near = 2.0 * self.plan.pixel_m
        else:
            assert self.frame is not None
            local = (point - self.frame.pose[:3, 3]) @ self.frame.pose[:3, :3]
            place = camera.project(local)
            near = 4.0 * float(local[2]) / camera.focal_length_px
        if not np.isfinite(place).all() or not ((place >= 0) & (place < (camera.width, camera.height))).all():
            return None
        column, row = (int(each) for each in place)
        away = float(np.linalg.norm(self.position[row, column] - point))
        return (column, row) if away <= max(near, 0.1) else None

    def figures(self, column: int, row: int) -> dict[str, Any] | None:
        """Return what a pixel shows; None outside the picture."""
        height, width = self.texels.shape
        if not (0 <= column < width and 0 <= row < height):
            return None
        number, frame = int(self.material[row, column]), self.frame
        known = number != NOTHING
        thing = int(frame.truth["object"][row, column]) if frame is not None else 0
        return {
            "apparent_k": None if frame is None else float(frame.apparent_temperature[row, column]),
            "radiance": None if frame is None else float(frame.radiance[row, column]),
            "kinetic_k": float(self.values("kinetic")[row, column]),
            "emissivity": float(self.values("emissivity")[row, column]),
            "position": tuple(float(each) for each in self.position[row, column]),
            "material": self.names[number] if known and number < len(self.names) else "",
            "object": frame.objects[thing - 1] if frame is not None and thing else "",
            "texel": int(self.texels[row, column]),
        }


def _band_mean(material: Any, band_um: tuple[float, float]) -> float:
    try:
        return float(material.band_emissivity(*band_um, BAND_K))
    except ThermorenderError:
        return np.nan


def _onto(image: NDArray[Any], ground: Surface) -> NDArray[Any]:
    """An image over a surface on its texels, by the nearest."""
    rows, columns = ground.material.shape
    if image.shape == (rows, columns):
        return image
    row = (np.arange(rows) + 0.5) * image.shape[0] / rows
    column = (np.arange(columns) + 0.5) * image.shape[1] / columns
    return image[row.astype(int)[:, None], column.astype(int)]


@dataclass(frozen=True)
class Row:
    """A material in a picture."""

    name: str
    share: float  # of the pixels
    # Of what is shown; None where the layer has no values
    mean: float | None
    least: float | None
    greatest: float | None


def statistics(shot: Shot, values: NDArray[np.floating] | None = None) -> list[Row]:
    """Return a Row of each material in view, the largest first; `values` (H, W) replace those of the layer."""
    if values is None and LAYERS[shot.view.layer].channel:
        values = shot.values(shot.view.layer)
    rows = []
    for name in dict.fromkeys(shot.names):
        here = np.isin(shot.material, [number for number, each in enumerate(shot.names) if each == name])
        if not here.any():
            continue
        own = None if values is None else values[here]
        own = None if own is None else own[np.isfinite(own)]
        figures: tuple[float | None, ...] = (None, None, None)
        if own is not None and own.size:
            figures = float(own.mean(dtype=np.float64)), float(own.min()), float(own.max())
        rows.append(Row(name, float(here.mean()), *figures))
    return sorted(rows, key=lambda row: -row.share)
