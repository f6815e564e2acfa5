"""What is put beside the reference: each method is one way to an infrared frame of a pose.

By letter: *B*, a learned map applied to the photograph of the pose, as the published 2D methods do. *C*, the same map
applied to the orthophoto, its apparent temperatures turned into kinetic ones, and that scene rendered: *C1* with the
true materials, *C2* with learned ones. *D*, one constant, and *E*, one temperature per material, both of thermal frames
of other lands in the same hour and weather. *F*, the heat balance of tables and the weather that is told. *O*, an
oracle: a map told the true material. Frames of another program stand under its own name.

No object's true temperature is given to B to O: their own comes from the map, by their colour, or else from the table
of their material. What knows more than a photograph says so in `knows`.

A map of intensities is asked three times: with the bounds that it brings, with bounds refitted to the campaign, and
calibrated by it, both under the campaign's sky.
"""

import hashlib
import time
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from thermorender.defaults import EMISSIVITY_MAP, FALLBACK_MATERIAL
from thermorender.errors import ThermorenderError
from thermorender.footage.radiometric_files import read_temperature
from thermorender.learned.apply import kinetic_from_map
from thermorender.learned.temperature_map import Inputs
from thermorender.physics.planck import band_radiance
from thermorender.render.heat.conditions import conditions
from thermorender.render.heat.relief import NAMES, mapped, reliefs
from thermorender.render.renderer import Renderer
from thermorender.scene.spec import EmissivitySpec, TemperatureSpec
from thermorender.scene.surface import scene_kelvin

LETTERS = ("B", "C1", "C2", "D", "E", "F")
OWN, REFITTED, CALIBRATED = "own", "refitted", "calibrated"
_THERMAL = "thermal frames of other lands"
_WORDS = {"terrain": "relief", "conditions": "hour and weather", "depth": "depth"}
# Side of the uniform picture by which a map is asked for an object's temperature: the multiple that networks take [px].
_PATCH_PX = 256


@dataclass
class Method:
    """One way to an infrared frame.

    Attributes
    ----------
    letter : str
        "B", "C1", "C2", "D", "E", "F", "O", "foreign".
    name : str
        Of the map, or what stands in its place.
    bounds : str or None
        Whose temperatures intensity 0 and 1 are, "own", "refitted" or "calibrated"; None where there are none.
    knows : str
        What it is told that a translation of a photograph is not.
    true_objects : bool
        Whether it is told the objects' true temperatures.
    model : TemperatureMap or None
    build : callable or None
        () → Renderer of the scene that is rendered.
    kelvin : dict of str to float
        Temperatures of the objects in that [K].
    paint : callable or None
        (view) → radiance, for those that are neither translated nor rendered.
    """

    letter: str
    name: str
    bounds: str | None = None
    knows: str = ""
    true_objects: bool = False
    model: Any = None
    build: Any = None
    kelvin: dict = field(default_factory=dict)
    paint: Any = None

    @property
    def label(self):
        """Its name in tables: letter, map, bounds, and what it knows of objects."""
        told = [f"{self.letter} {self.name}"]
        told += [self.bounds] if self.bounds in (REFITTED, CALIBRATED) else []
        told += ["true objects"] if self.true_objects else []
        return ", ".join(told)

    @cached_property
    def renderer(self):
        """The Renderer of a rendered method, until it is closed."""
        return self.build()

    def close(self):
        """Let go of the renderer, which holds a lit scene."""
        self.__dict__.pop("renderer", None)

    def clock(self):
        """Return a time [s] to take differences of, which goes on by what memory spares: as though it were alone."""
        return time.perf_counter() + getattr(getattr(self.model, "predictor", None), "spared_s", 0.0)

    @property
    def objects(self):
        """Temperatures of the dynamic objects, as `Renderer.frame` takes them."""
        tracked = [item.name for item in self.renderer.scene.tracked_objects]
        return {name: {"temperature_k": self.kelvin[name]} for name in tracked if name in self.kelvin}

    def radiance(self, view):
        """Return the band radiance (H, W) that it gives of a View [W m⁻² sr⁻¹]."""
        if self.build is not None:
            return self.renderer.radiance(view.pose, view.time_s, self.objects)
        if self.paint is not None:
            return self.paint(view)
        return self.model.radiance(Inputs(view.visible, view.texel_m))


def translated(model, campaign=None, sky_k=None):
    """Return the B methods of a map: as it is, and where the campaign's Training is given as that has it, under its sky
    [K]."""
    model = replace(model, predictor=Remembered(model.predictor, most=1))
    return [Method("B", model.name, bounds, _told(bounds), model=at)
            for bounds, at, _ in _ways(model, campaign, sky_k)]  # fmt: skip


def _ways(model, campaign, sky_k):
    """[(bounds, the map with them, their °C or None)]: the best last."""
    if model.predictor.above_air:
        return [(None, model, None)]
    found = [(OWN, model, None)]
    if campaign is not None:
        at = replace(model.ranged(campaign.bounds_c), sky_temperature=sky_k)
        found.append((REFITTED, at, tuple(campaign.bounds_c)))
        if model.name in campaign.calibrations:
            zero, slope = campaign.calibrations[model.name]
            # In intensities of the campaign's range, which says what is believed of a surface.
            first = float(at.intensity(zero))
            line = Calibrated(model.predictor, first, float(at.intensity(zero + slope)) - first)
            found.append((CALIBRATED, replace(at, predictor=line), tuple(campaign.bounds_c)))
    return found


def _told(bounds, *more):
    """What a method knows, in words."""
    return ", ".join([*filter(None, more), *([_THERMAL] if bounds in (REFITTED, CALIBRATED) else [])])


class Calibrated:
    """A map's predictor with its intensities put on a straight line: `first` where it says 0, `slope` more where 1.

    Parameters
    ----------
    predictor : Remembered
    first, slope : float
    """

    needs, above_air = (), False

    def __init__(self, predictor, first, slope):
        self._predictor, self._line = predictor, (first, slope)
        self.arrays = predictor.arrays

    @property
    def spared_s(self):
        """As of `Remembered`."""
        return self._predictor.spared_s

    def header(self):
        """Return what tells it apart from the predictor alone."""
        return {**self._predictor.header(), "calibrated": self._line}

    def predict(self, inputs, texel_m):
        """Return intensities of an Inputs, (h, w) float64."""
        first, slope = self._line
        return first + slope * self._predictor.predict(inputs, texel_m)


class Remembered:
    """A map's predictor that translates a picture once, whatever bounds and materials it is asked with.

    Parameters
    ----------
    predictor : object
        Of a TemperatureMap.
    most : int, optional
        So many pictures are kept, the last ones; all by default.

    Attributes
    ----------
    spared_s : float
        What would have been spent without memory, less what remembering costs [s].
    """

    def __init__(self, predictor, most=None):
        self.needs, self.above_air = predictor.needs, predictor.above_air
        self.header, self.arrays = predictor.header, predictor.arrays
        self.spared_s = 0.0
        self._predictor, self._most, self._kept = predictor, most, {}

    def predict(self, inputs, texel_m):
        """Return what the predictor says of an Inputs, (h, w) float64."""
        began = time.perf_counter()
        key = _content(inputs)
        self.spared_s -= time.perf_counter() - began
        if key in self._kept:
            found, seconds = self._kept[key]
            self.spared_s += seconds
            return found
        began = time.perf_counter()
        found = self._predictor.predict(inputs, texel_m)
        self._kept[key] = found, time.perf_counter() - began
        if self._most and len(self._kept) > self._most:
            self._kept.pop(next(iter(self._kept)))
        return found


def _content(inputs):
    """A fingerprint of an Inputs."""
    state = hashlib.blake2b(digest_size=16)
    planes = {"rgb": inputs.rgb, "depth": inputs.depth, **inputs.terrain}
    plain = {name: values.shape for name, values in planes.items() if values is not None}
    state.update(repr((plain, inputs.texel_m, inputs.conditions)).encode())
    for name in plain:
        state.update(np.ascontiguousarray(planes[name]).data)
    return state.digest()


def rendered(scene, text, model, reference, campaign=None, true_materials=True, learned=None, settings=None):
    """Return the C methods of a map in a scene: C1 of all bounds and once told the true objects, C2 of the best.

    Parameters
    ----------
    scene : Scene
    text : str
        The map's name or file.
    model : TemperatureMap
    reference : Renderer
        Of the same surfaces.
    campaign : Training, optional
    true_materials : bool
        Whether C1 is among them.
    learned : Scene, optional
        The same with learned materials, for C2.
    settings : dict, optional
        Passed to Renderer.

    Notes
    -----
    Nothing is rendered before a method's renderer is asked for.
    """
    made, settings = [], settings or {}
    needs = [_WORDS[name] for name in model.needs]

    def method(letter, cold, told, kelvin, true_objects=False):
        bounds, at, limits = way
        source = TemperatureSpec(source="learned", model=str(text), range_c=limits)

        def build():
            warm = cold.with_temperature(source, at).with_objects(kelvin)
            return Renderer(warm, like=reference, **settings)

        return Method(letter, model.name, bounds, _told(bounds, *told, *needs), true_objects, at, build, kelvin)

    for way in _ways(replace(model, predictor=Remembered(model.predictor)), campaign, scene.sky_temperature):
        kelvin = object_temperatures(scene, way[1], reference)
        if true_materials:
            made.append(method("C1", scene, ("the materials",), kelvin))
    if true_materials and scene.spec.objects:
        made.append(method("C1", scene, ("the materials", "the objects"), {}, true_objects=True))
    if learned is not None:
        made.append(method("C2", learned, (), kelvin))
    return made


def balanced(scene, reference, settings=None):
    """Return the method F of a scene: its heat balance with table values."""
    kelvin = {item.name: _own_temperature(scene, item) for item in scene.spec.objects}

    def build():
        asked = scene.with_sun(None).with_temperature("balance").with_objects(kelvin)
        return Renderer(asked, like=reference, **(settings or {}))

    return Method("F", "heat balance of tables", None, "the materials, hour and weather, relief", build=build,
                  kelvin=kelvin)  # fmt: skip


def oracle(scene, text, model, reference, settings=None):
    """Return the method O of a scene: a map that is shown the material of each texel, too."""
    kelvin = {item.name: _own_temperature(scene, item) for item in scene.spec.objects}

    def build():
        asked = scene.with_sun(None).with_temperature(TemperatureSpec(source="learned", model=str(text)), model)
        asked = asked.with_objects(kelvin)
        (solved,) = mapped(asked, [scene.time], reference.baked.geometry, material=True)
        return Renderer(solved, like=reference, **(settings or {}))

    told = _told(None, "the materials", *(_WORDS[name] for name in model.needs))
    return Method("O", model.name, None, told, model=model, build=build, kelvin=kelvin)


def painted(training, band_um):
    """Return the methods D and E of a Training; and the reference's own mean, which knows it."""

    def of_kelvin(kelvin):
        return band_radiance(kelvin, *band_um)

    def own_mean(view):
        ground = view.truth_radiance[view.known & (view.object < 0)]
        return np.full(view.known.shape, ground.mean(dtype=np.float64) if ground.size else np.nan)

    made = [Method("D", "the frame's own mean", None, "the reference's mean", paint=own_mean)]
    if training is not None:
        constant = of_kelvin(training.mean_k)
        made.insert(0, Method("D", "constant", None, _THERMAL, paint=lambda view: np.full(view.known.shape, constant)))

        def per_material(view):
            names = view.material_names
            kelvin = [training.material_k.get(name, training.mean_k) for name in names]
            table = of_kelvin(np.array([*kelvin, training.mean_k]))
            return table[np.minimum(view.material, len(names))]

        told = f"the materials, {_THERMAL}"
        made.insert(1, Method("E", "mean per material", None, told, paint=per_material))
    return made


class Foreign:
    """Frames of another program for the same poses: a folder of `pose_0000.tif` and so on, which tell their unit.

    Parameters
    ----------
    name : str
    folder : Path

    Raises
    ------
    ThermorenderError
        No folder.
    """

    def __init__(self, name, folder):
        if not folder.is_dir():
            raise ThermorenderError(f"--foreign {name}={folder} is no folder; give one with pose_0000.tif and so on")
        self.name, self.folder = name, folder

    def check(self, scene_name, count, several, shape):
        """Refuse a folder that lacks a pose's frame, or whose frames cannot be judged.

        Parameters
        ----------
        scene_name : str
        count : int
            Poses of the scene.
        several : bool
            Whether there are other scenes: frames then lie in folders of the scenes' names.
        shape : (2,) tuple of int
            Rows and columns of the camera.
        """
        for index in range(count):
            path = self.path(scene_name, index)
            if not path.is_file() or (several and path.parent == self.folder):
                raise ThermorenderError(
                    f"--foreign {self.name}={self.folder} lacks {path.name} for scene {scene_name!r}; give a "
                    f"temperature TIFF of each of the {count} poses, in a folder of the scene's name where there are "
                    "several"
                )
            kelvin = self._read(path, shape)
            if np.isfinite(kelvin).any():
                # Degrees Celsius that call themselves kelvin.
                scene_kelvin(f"median of {path}", float(np.nanmedian(kelvin)))

    def path(self, scene_name, index):
        """Return the path of a pose's frame."""
        own = self.folder / scene_name
        return (own if own.is_dir() else self.folder) / f"pose_{index:04d}.tif"

    def method(self, scene_name, band_um):
        """Return it as a Method for a scene."""

        def paint(view):
            return band_radiance(self._read(self.path(scene_name, view.index), view.known.shape), *band_um)

        return Method("foreign", self.name, None, "", paint=paint)

    def _read(self, path, shape):
        kelvin = read_temperature(path)
        if kelvin.shape != shape:
            height, width = shape
            raise ThermorenderError(
                f"{path} has {kelvin.shape[1]}×{kelvin.shape[0]} pixels; the camera has {width}×{height}, give frames "
                "of that size"
            )
        return kelvin


def object_temperatures(scene, model, reference):
    """Return {object: kelvin} that a map gives objects by their colour, the material's own where it cannot be trusted.

    A picture of one colour is shown to the map, as wide as networks need; one that is told relief and hour is told
    those of the texel under the object.
    """
    if not scene.spec.objects:
        return {}
    surfaces = {surface.name.split(":")[0]: surface for surface in scene.surfaces[scene.terrain_count :]}
    surfaces |= {item.name: item.surfaces[0] for item in scene.tracked_objects}
    planes, told, sky, found = {}, {}, None, {}
    if model.needs:
        told, sky = conditions(scene.weather, scene.time), scene.sky_temperature
        if "terrain" in model.needs:
            planes = reliefs(scene, [scene.time], reference.baked.geometry)[scene.time]
    for item in scene.spec.objects:
        surface = surfaces[item.name]
        patch = np.empty((_PATCH_PX, _PATCH_PX, 3), np.uint8)
        patch[:] = np.round(surface.colour.reshape(-1, 3).mean(axis=0))
        at = _texel_of(scene, item)
        terrain = {name: np.full(patch.shape[:2], planes[name].flat[at], np.float32) for name in NAMES if planes}
        material = np.full(patch.shape[:2], surface.material.flat[0])
        inputs = Inputs(patch, scene.surfaces[0].texel_m, terrain, told)
        stand_in = told["air_k"] if told else None
        kelvin, *_ = kinetic_from_map(model, inputs, material, scene.materials, sky, stand_in)
        found[item.name] = float(kelvin[_PATCH_PX // 2, _PATCH_PX // 2])
    return found


def _texel_of(scene, item):
    """Flat number of the terrain's texel nearest to an object's place."""
    first = scene.surfaces[0]
    rows, columns = first.material.shape
    low, high = first.vertices.min(axis=0), first.vertices.max(axis=0)
    share = (np.array(item.position[:2]) - low[:2]) / np.maximum(high[:2] - low[:2], 1e-9)
    column, row = np.clip([share[0] * columns, (1.0 - share[1]) * rows], 0, [columns - 1, rows - 1]).astype(int)
    return int(row * columns + column)


def _own_temperature(scene, item):
    """The temperature that an object's material has by its table [K]."""
    return next(each.temperature for each in scene.materials if each.name == item.material)


def learned_materials(model=EMISSIVITY_MAP, fallback=FALLBACK_MATERIAL):
    """Return the EmissivitySpec of materials by a learned map, with the material of texels that it does not know."""
    return EmissivitySpec(source="learned", model=model, fallback=fallback)
