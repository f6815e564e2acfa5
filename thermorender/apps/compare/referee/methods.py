"""The methods that are compared with the reference: each makes an infrared frame of a pose.

By letter: *B*, a learned map applied to the photograph of the pose, as in the published 2D methods. *C*, the same map
applied to the orthophoto, its apparent temperatures converted to kinetic ones, and that scene rendered: *C1* with true
materials, *C2* with learned ones. *D*, one constant, and *E*, one temperature per material, both from thermal frames
of other lands in the same hour and weather. *F*, the heat balance with table properties and the scene's weather. *P*,
a privileged map: one that takes the true material as input. Frames of another program go under that program's name.

B to P do not know the objects' true temperatures: these come from the map, by colour, or from the table of the
material. `knows` lists what a method knows beyond a photograph.

A map of intensities is used three times: with its own bounds, with bounds refitted to the campaign, and with a
calibration from the campaign; the last two under the campaign's sky.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.referee.predictors import Calibrated, Remembered
from thermorender.apps.compare.referee.training import Training
from thermorender.apps.compare.referee.views import View
from thermorender.apps.compare.words import counted
from thermorender.defaults import EMISSIVITY_MAP, FALLBACK_MATERIAL
from thermorender.errors import ThermorenderError
from thermorender.learned.apply import kinetic_from_map
from thermorender.learned.temperature_map import Inputs, TemperatureMap
from thermorender.physics.planck import band_radiance
from thermorender.render.heat.conditions import conditions
from thermorender.render.heat.relief import NAMES, mapped, reliefs
from thermorender.render.renderer import Renderer
from thermorender.scene.scene import Scene
from thermorender.scene.spec import EmissivitySpec, TemperatureSpec
from thermorender.scene.surface import scene_kelvin
from thermorender.sensor.radiometric_files import read_temperature

Settings = Mapping[str, Any]

LETTERS = ("B", "C1", "C2", "D", "E", "F")
OWN, REFITTED, CALIBRATED = "own", "refitted", "calibrated"
# Label of the D that takes each frame's mean from the reference.
OWN_MEAN = "D the frame's own mean"
THERMAL = "thermal frames of other lands"
_WORDS = {"terrain": "relief", "conditions": "hour and weather", "depth": "depth"}
# Side of the uniform picture that a map translates for an object's temperature; networks take multiples of it [px].
_PATCH_PX = 256


@dataclass
class Method:
    """One way to make an infrared frame."""

    letter: str  # "B", "C1", "C2", "D", "E", "F", "P", "foreign"
    name: str  # Name of the map, or of the method where there is no map
    # Source of the temperatures of intensity 0 and 1: "own", "refitted" or "calibrated"; None without intensities
    bounds: str | None = None
    knows: str = ""  # Its knowledge beyond a photograph
    true_objects: bool = False  # Whether it knows the objects' true temperatures
    model: TemperatureMap | None = None
    build: Callable[[], Renderer] | None = None  # () → Renderer, for rendered methods
    kelvin: dict[str, float] = field(default_factory=dict)  # Temperatures of the objects in the rendered scene [K]
    # (view) → radiance, for methods that are neither translated nor rendered
    paint: Callable[[View], NDArray[np.floating]] | None = None

    @property
    def label(self) -> str:
        """Its name in tables: letter, map, bounds, and whether it knows the objects."""
        parts = [f"{self.letter} {self.name}"]
        if self.bounds in (REFITTED, CALIBRATED):
            parts.append(str(self.bounds))
        if self.true_objects:
            parts.append("true objects")
        return ", ".join(parts)

    @cached_property
    def renderer(self) -> Renderer:
        """The Renderer of a rendered method, until it is closed."""
        assert self.build is not None
        return self.build()

    def close(self) -> None:
        """Release the renderer and its lit scene."""
        self.__dict__.pop("renderer", None)

    def __getstate__(self) -> dict[str, Any]:
        # Its renderer is built again where it is used.
        return {name: value for name, value in vars(self).items() if name != "renderer"}

    def clock(self) -> float:
        """Return a clock [s] for differences that adds the time saved by remembered predictions."""
        return perf_counter() + float(getattr(getattr(self.model, "predictor", None), "spared_s", 0.0))

    @property
    def objects(self) -> dict[str, dict[str, float]]:
        """Temperatures of the dynamic objects, as `Renderer.frame` takes them."""
        tracked = [item.name for item in self.renderer.scene.tracked_objects]
        return {name: {"temperature_k": self.kelvin[name]} for name in tracked if name in self.kelvin}

    def radiance(self, view: View) -> NDArray[np.floating]:
        """Return its band radiance of a View, (H, W) [W m⁻² sr⁻¹]."""
        if self.build is not None:
            return self.renderer.radiance(view.pose, view.time_s, self.objects)
        if self.paint is not None:
            return self.paint(view)
        assert self.model is not None
        return self.model.radiance(Inputs(view.visible, view.texel_m))


def translated(model: TemperatureMap, campaign: Training | None = None, sky_k: float | None = None) -> list[Method]:
    """Return the B methods of a map: with its own bounds, and with those of the campaign under its sky [K]."""
    model = replace(model, predictor=Remembered(model.predictor, most=1))
    return [Method("B", model.name, bounds, _knows(bounds), model=at)
            for bounds, at, _ in _variants(model, campaign, sky_k)]  # fmt: skip


_Variant = tuple[str | None, TemperatureMap, tuple[float, float] | None]


def _variants(model: TemperatureMap, campaign: Training | None, sky_k: float | None) -> list[_Variant]:
    """Return [(bounds, the map with them, their °C or None)], the best last."""
    if model.predictor.above_air:
        return [(None, model, None)]
    found: list[_Variant] = [(OWN, model, None)]
    if campaign is not None:
        # A campaign comes with the sky of its scene.
        at = replace(model.ranged(campaign.bounds_c), sky_temperature=sky_k)  # type: ignore[arg-type]
        found.append((REFITTED, at, campaign.bounds_c))
        if model.name in campaign.calibrations:
            zero, slope = campaign.calibrations[model.name]
            # As intensities of the campaign's range, which limits the plausible temperatures.
            first = float(at.intensity(zero))
            line = Calibrated(model.predictor, first, float(at.intensity(zero + slope)) - first)
            found.append((CALIBRATED, replace(at, predictor=line), campaign.bounds_c))
    return found


def _knows(bounds: str | None, *more: str) -> str:
    """Return what a method knows, in words."""
    return ", ".join([*more, *([THERMAL] if bounds in (REFITTED, CALIBRATED) else [])])


def rendered(
    scene: Scene,
    text: str,
    model: TemperatureMap,
    reference: Renderer,
    campaign: Training | None = None,
    true_materials: bool = True,
    learned: Scene | None = None,
    settings: Settings | None = None,
) -> list[Method]:
    """Return the C methods of a map in a scene: C1 with all bounds and once with true objects, C2 with the best bounds.

    Parameters
    ----------
    scene : Scene
    text : str
        The map's name or file.
    model : TemperatureMap
    reference : Renderer
        Renderer of the same surfaces.
    campaign : Training, optional
    true_materials : bool
        Whether to include C1.
    learned : Scene, optional
        The scene with learned materials, for C2.
    settings : dict, optional
        Keywords of Renderer.

    Notes
    -----
    A method renders nothing before its `renderer` is used.
    """
    needs = [_WORDS[name] for name in model.needs]

    def method(
        variant: _Variant, letter: str, cold: Scene, knows: Sequence[str], kelvin: dict[str, float], objects: bool
    ) -> Method:
        bounds, at, limits = variant
        source = TemperatureSpec(source="learned", model=str(text), range_c=limits)

        def build() -> Renderer:
            solved = cold.with_temperature(source, at).with_objects(kelvin)
            return Renderer(solved, like=reference, **(settings or {}))

        return Method(letter, model.name, bounds, _knows(bounds, *knows, *needs), objects, at, build, kelvin)

    found = []
    for variant in _variants(replace(model, predictor=Remembered(model.predictor)), campaign, scene.sky_temperature):
        kelvin = object_temperatures(scene, variant[1], reference)
        if true_materials:
            found.append(method(variant, "C1", scene, ("the materials",), kelvin, False))
    if true_materials and scene.spec.objects:
        found.append(method(variant, "C1", scene, ("the materials", "the objects"), {}, True))
    if learned is not None:
        found.append(method(variant, "C2", learned, (), kelvin, False))
    return found


def balanced(scene: Scene, reference: Renderer, settings: Settings | None = None) -> Method:
    """Return the method F of a scene: its heat balance with table properties."""
    kelvin = _table_temperatures(scene)

    def build() -> Renderer:
        asked = scene.with_sun(None).with_temperature("balance").with_objects(kelvin)
        return Renderer(asked, like=reference, **(settings or {}))

    return Method("F", "heat balance of tables", None, "the materials, hour and weather, relief", build=build,
                  kelvin=kelvin)  # fmt: skip


def privileged(
    scene: Scene, text: str, model: TemperatureMap, reference: Renderer, settings: Settings | None = None
) -> Method:
    """Return the method P of a scene: a map that also takes the material of each texel as input."""
    kelvin, time = _table_temperatures(scene), scene.time
    assert time is not None  # the caller has a scene with [weather]

    def build() -> Renderer:
        asked = scene.with_sun(None).with_temperature(TemperatureSpec(source="learned", model=str(text)), model)
        (solved,) = mapped(asked.with_objects(kelvin), [time], reference.baked.geometry, material=True)
        return Renderer(solved, like=reference, **(settings or {}))

    knows = _knows(None, "the materials", *(_WORDS[name] for name in model.needs))
    return Method("P", model.name, None, knows, model=model, build=build, kelvin=kelvin)


def painted(training: Training | None, band_um: tuple[float, float]) -> list[Method]:
    """Return the methods D and E of a Training, and a D that takes each frame's mean from the reference."""

    def own_mean(view: View) -> NDArray[np.floating]:
        assert view.truth_radiance is not None
        ground = view.truth_radiance[view.known & (view.object < 0)]
        return np.full(view.known.shape, ground.mean(dtype=np.float64) if ground.size else np.nan)

    found = [Method("D", OWN_MEAN.removeprefix("D "), None, "the reference's mean", paint=own_mean)]
    if training is None:
        return found
    radiance = band_radiance(training.mean_k, *band_um)

    def constant(view: View) -> NDArray[np.floating]:
        return np.full(view.known.shape, radiance)

    def per_material(view: View) -> NDArray[np.floating]:
        names = view.material_names
        kelvin = [training.material_k.get(name, training.mean_k) for name in names]
        table = band_radiance(np.array([*kelvin, training.mean_k]), *band_um)
        return table[np.minimum(view.material, len(names))]

    return [Method("D", "constant", None, THERMAL, paint=constant),
            Method("E", "mean per material", None, f"the materials, {THERMAL}", paint=per_material),
            *found]  # fmt: skip


class Foreign:
    """Frames of another program for the same poses: a folder of `pose_0000.tif` and so on, TIFFs that declare a unit.

    Parameters
    ----------
    name : str
    folder : Path

    Raises
    ------
    ThermorenderError
        No folder.
    """

    def __init__(self, name: str, folder: Path) -> None:
        if not folder.is_dir():
            raise ThermorenderError(
                f"--foreign {name}={folder} is not a folder; give a folder with pose_0000.tif and so on"
            )
        self.name, self.folder = name, folder

    def check(self, scene_name: str, count: int, several: bool, shape: tuple[int, int]) -> None:
        """Refuse a folder that lacks a pose's frame, or whose frames have a wrong size or implausible temperatures.

        Parameters
        ----------
        scene_name : str
        count : int
            Number of poses of the scene.
        several : bool
            Whether there are other scenes: the frames of each are then in a folder with the scene's name.
        shape : (2,) tuple of int
            Rows and columns of the camera.
        """
        for index in range(count):
            path = self.path(scene_name, index)
            if not path.is_file() or (several and path.parent == self.folder):
                raise ThermorenderError(
                    f"--foreign {self.name}={self.folder} lacks {path.name} for scene {scene_name!r}; give a "
                    f"temperature TIFF of each of the scene's {counted(count, 'pose')}, in a folder with the scene's "
                    "name where there are several scenes"
                )
            kelvin = self._read(path, shape)
            if np.isfinite(kelvin).any():
                # Refuses degrees Celsius declared as kelvin.
                scene_kelvin(f"median of {path}", float(np.nanmedian(kelvin)))

    def path(self, scene_name: str, index: int) -> Path:
        """Return the path of a pose's frame."""
        own = self.folder / scene_name
        return (own if own.is_dir() else self.folder) / f"pose_{index:04d}.tif"

    def method(self, scene_name: str, band_um: tuple[float, float]) -> Method:
        """Return the Method for a scene."""

        def paint(view: View) -> NDArray[np.floating]:
            height, width = view.known.shape
            return band_radiance(self._read(self.path(scene_name, view.index), (height, width)), *band_um)

        return Method("foreign", self.name, None, "", paint=paint)

    def _read(self, path: Path, shape: tuple[int, int]) -> NDArray[np.floating]:
        kelvin: NDArray[np.floating] = read_temperature(path)
        if kelvin.shape != shape:
            height, width = shape
            raise ThermorenderError(
                f"{path} has {kelvin.shape[1]}×{kelvin.shape[0]} pixels, but the camera has {width}×{height}; give "
                "frames of that size"
            )
        return kelvin


def object_temperatures(scene: Scene, model: TemperatureMap, reference: Renderer) -> dict[str, float]:
    """Return {object: kelvin} that a map predicts from the objects' colours, or the material's where it is unreliable.

    The map translates a uniform picture of the object's colour, as wide as networks need. A map with more inputs gets
    those of the texel under the object.
    """
    if not scene.spec.objects:
        return {}
    surfaces = {surface.name.split(":")[0]: surface for surface in scene.surfaces[scene.terrain_count :]}
    surfaces |= {item.name: item.surfaces[0] for item in scene.tracked_objects}
    planes: dict[str, NDArray[np.floating]] = {}
    weather: dict[str, float] = {}
    sky, found = None, {}
    if model.needs:
        time = scene.time
        assert time is not None  # a map with these needs is refused without [weather]
        weather, sky = conditions(scene.weather, time), scene.sky_temperature
        if "terrain" in model.needs:
            planes = reliefs(scene, [time], reference.baked.geometry)[time]
    for item in scene.spec.objects:
        surface = surfaces[item.name]
        patch = np.empty((_PATCH_PX, _PATCH_PX, 3), np.uint8)
        patch[:] = np.round(surface.colour.reshape(-1, 3).mean(axis=0))
        at = _texel_of(scene, item)
        terrain = {name: np.full(patch.shape[:2], planes[name].flat[at], np.float32) for name in NAMES if planes}
        material = np.full(patch.shape[:2], surface.material.flat[0])
        inputs = Inputs(patch, scene.surfaces[0].texel_m, terrain, weather)
        stand_in = weather["air_k"] if weather else None
        kelvin, *_ = kinetic_from_map(model, inputs, material, scene.materials, sky, stand_in)
        found[item.name] = float(kelvin[_PATCH_PX // 2, _PATCH_PX // 2])
    return found


def _texel_of(scene: Scene, item: Any) -> int:
    """Return the flat number of the terrain texel nearest to an object's position."""
    first = scene.surfaces[0]
    rows, columns = first.material.shape
    low, high = first.vertices.min(axis=0), first.vertices.max(axis=0)
    share = (np.array(item.position[:2]) - low[:2]) / np.maximum(high[:2] - low[:2], 1e-9)
    column, row = np.clip([share[0] * columns, (1.0 - share[1]) * rows], 0, [columns - 1, rows - 1]).astype(int)
    return int(row * columns + column)


def _table_temperatures(scene: Scene) -> dict[str, float]:
    """Return {object: table temperature of its material [K]}."""
    kelvin = {each.name: each.temperature for each in reversed(scene.materials)}
    return {item.name: kelvin[item.material] for item in scene.spec.objects}


def learned_materials(model: str = EMISSIVITY_MAP, fallback: str = FALLBACK_MATERIAL) -> EmissivitySpec:
    """Return the EmissivitySpec of a learned material map, with `fallback` for texels that the map does not know."""
    return EmissivitySpec(source="learned", model=model, fallback=fallback)
