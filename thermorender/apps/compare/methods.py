"""The methods that are compared: each makes the apparent temperature of a View.

A learned map is applied to the photograph of the pose, as in the published 2D methods, or to the orthophoto, converted
to kinetic temperature and rendered, with true or with learned materials. A constant and one temperature per material
come from thermal frames of other lands in the same hour and weather. The heat balance has table properties and the
scene's weather. A privileged map takes the true material as input. Foreign frames go under their program's name.
`knows` lists inputs beyond a photograph.

Object temperatures come from the map, by colour, or from the material's table. A map of intensities is used with
its own bounds, with bounds refitted to the campaign, and calibrated to it; the last two under the campaign's sky.

A new method is a function of a `Given`, which yields its Methods, and sentences on it or on why it is left out, and a
line in `OF_MAPS` or `OF_SCENES`.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare.foreign import Foreign
from thermorender.apps.compare.predictors import Calibrated, Remembered
from thermorender.apps.compare.training import Training
from thermorender.apps.compare.view import Image, View
from thermorender.defaults import EMISSIVITY_MAP, FALLBACK_MATERIAL
from thermorender.errors import ThermorenderError
from thermorender.frame import apparent_temperature
from thermorender.learned.apply import InBand, kinetic_from_map
from thermorender.learned.even import EVEN_PX
from thermorender.learned.temperature_map import Inputs, TemperatureMap
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.progress import Progress
from thermorender.render.heat.conditions import conditions
from thermorender.render.heat.relief import NAMES, mapped, reliefs
from thermorender.render.renderer import Renderer
from thermorender.render.tiled.tiled_renderer import renderer_of
from thermorender.scene.scene import Scene
from thermorender.scene.spec import EmissivitySpec, TemperatureSpec

OWN, REFITTED, CALIBRATED = "own", "refitted", "calibrated"
PHOTOGRAPH, TRUE_MATERIALS, LEARNED_MATERIALS = "photograph", "true-materials", "learned-materials"
CONSTANT, PER_MATERIAL, FRAME_MEAN, BALANCE = "constant", "per-material", "frame-mean", "balance"
PRIVILEGED, FOREIGN = "privileged", "foreign"
# Uses of a map, with which it competes with a constant of the hour, and methods without a pattern of their own.
MAPPED, FLAT = (PHOTOGRAPH, TRUE_MATERIALS, LEARNED_MATERIALS, PRIVILEGED), (CONSTANT, PER_MATERIAL, FRAME_MEAN)
# Labels of a map's uses; all other methods are called by their names.
LABELS = {
    PHOTOGRAPH: "{} on the photograph", TRUE_MATERIALS: "{} as kelvin, true materials",
    LEARNED_MATERIALS: "{} as kelvin, learned materials",
}  # fmt: skip
# Names of the constant of the hour, and of the constant that takes each frame's mean from the reference.
A_CONSTANT, OWN_MEAN = "a constant", "the frame's own mean"
THERMAL = "thermal frames of other lands"
_WORDS = {"terrain": "relief", "conditions": "hour and weather", "depth": "depth"}


@dataclass
class Method:
    """One way to make an infrared picture of a View."""

    kind: str  # A key of `OF_MAPS` or `OF_SCENES`; in an evaluation "map", "privileged", "baseline", "floor", "foreign"
    name: str  # Name of the map, or of the method where there is no map
    # Source of the temperatures of intensity 0 and 1: "own", "refitted" or "calibrated"; None without intensities
    bounds: str | None = None
    knows: str = ""  # Its knowledge beyond a photograph
    true_objects: bool = False  # Whether it knows the objects' true temperatures
    model: TemperatureMap | None = None
    build: Callable[[], Renderer] | None = None  # () → Renderer, for rendered methods
    kelvin: dict[str, float] = field(default_factory=dict)  # Temperatures of the objects in the rendered scene [K]
    # (view) → (H, W) apparent temperature [K], None where it has none, for methods neither translated nor rendered
    function: Callable[[View], Image | None] | None = None

    @property
    def label(self) -> str:
        """Its name in tables: the map and its use, bounds, and whether it knows the objects."""
        parts = [LABELS.get(self.kind, "{}").format(self.name)]
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

    def temperature(self, view: View) -> Image | None:
        """Return its apparent temperature of a View, (H, W) [K], or None where it has none."""
        if self.function is not None:
            return self.function(view)
        return apparent_temperature(self.radiance(view), view.band_um)

    def radiance(self, view: View) -> Image:
        """Return its band radiance of a View, (H, W) [W m⁻² sr⁻¹]."""
        if self.build is not None:
            assert view.pose is not None
            return self.renderer.radiance(view.pose, view.time_s, self.objects)
        if self.function is None:
            assert self.model is not None
            return self.model.radiance(Inputs(view.visible, view.texel_m), view.band_um)
        kelvin = self.function(view)
        assert kelvin is not None
        # Pictures of few levels are common, and the integral over the band is slow.
        levels, at = np.unique(kelvin, return_inverse=True)
        return band_radiance(levels, *view.band_um)[at].reshape(kelvin.shape)


@dataclass
class Given:
    """What the methods of a scene are made of."""

    scene: Scene
    reference: Renderer  # At the true temperatures, or of the scene as it is if they are unknown
    has_truth: bool
    campaign: Training | None
    learned: Scene | None  # The scene with learned materials
    privileged: tuple[str, TemperatureMap] | None
    foreign: Sequence[Foreign]
    report: Progress

    @property
    def weathered(self) -> bool:
        """Whether the scene has an hour and weather."""
        return self.scene.spec.weather is not None and self.scene.frame is not None


def methods_of(
    kinds: Collection[str], maps: Sequence[tuple[str, TemperatureMap]], given: Given
) -> tuple[list[Method], list[str]]:
    """Return (the Methods of a scene of these kinds and of (name or file, map), sentences on them and others)."""
    check_kinds(kinds)
    made: list[Method | str] = []
    for text, model in maps:
        given.report(f"preparing {model.name}", 0.0)
        if model.needs and not given.weathered:
            raise ThermorenderError(
                f"{given.scene.where}: learned map {model.name!r} takes hour and weather as input, but this scene has "
                "none; add [weather], or leave the map out"
            )
        if model.needs and given.scene.world is not None:
            raise given.scene.not_on_tiles(f"learned map {model.name!r}, which takes {' and '.join(model.needs)},")
        once = replace(model, predictor=Remembered(model.predictor))
        for kind, of_map in OF_MAPS.items():
            if kind in kinds:
                made += of_map(given, text, once)
    for kind, of_scene in OF_SCENES.items():
        if kind in kinds or kind in _ALWAYS:
            made += of_scene(given)
    return ([each for each in made if isinstance(each, Method)],
            list(dict.fromkeys(each for each in made if isinstance(each, str))))  # fmt: skip


def check_kinds(kinds: Collection[str]) -> None:
    """Refuse unknown kinds of methods."""
    known = chosen_kinds()
    if not set(kinds) <= set(known):
        raise ThermorenderError(f"--methods={','.join(kinds)!r} is not allowed; give some of {', '.join(known)}")


def translated(model: TemperatureMap, campaign: Training | None = None, sky_k: float | None = None) -> list[Method]:
    """Return a map on the photograph: with its own bounds, and with those of the campaign under its sky [K]."""
    plain = model.predictor.plain if isinstance(model.predictor, Remembered) else model.predictor
    model = replace(model, predictor=Remembered(plain, most=1))
    return [Method(PHOTOGRAPH, model.name, bounds, _knows(bounds), model=at)
            for bounds, at, _ in _variants(model, campaign, sky_k)]  # fmt: skip


def _photographs(given: Given, text: str, model: TemperatureMap) -> Iterator[Method | str]:
    if model.needs:
        yield (f"{LABELS[PHOTOGRAPH].format(model.name)} is left out: the map also takes {' and '.join(model.needs)} "
               "as input, which a photograph does not give.")  # fmt: skip
    else:
        yield from translated(model, given.campaign, _sky_of(given.scene, model, given.campaign))
        note = model.band_note(given.scene.camera.band_um)
        if note:
            yield (f"{note[:1].upper()}{note[1:]} than the camera's of {given.scene.name}. On the photograph, they are "
                   "taken as those of the camera's.")  # fmt: skip


def _true_materials(given: Given, text: str, model: TemperatureMap) -> Iterator[Method | str]:
    yield from rendered(given.scene, text, model, given.reference, given.campaign)


def _learned_materials(given: Given, text: str, model: TemperatureMap) -> Iterator[Method | str]:
    if given.learned is None:
        why = "without an orthophoto" if given.scene.world is None else "on tiles"
        yield f"Maps as kelvin, learned materials, are left out of {given.scene.name}: {why}, none can be learned."
    else:
        yield from rendered(given.scene, text, model, given.reference, given.campaign, False, given.learned)


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


def _sky_of(scene: Scene, model: TemperatureMap, campaign: Training | None) -> float | None:
    """Return a scene's sky in a map's band [K], None where no campaign asks for it."""
    return None if campaign is None else scene.sky_temperature_in(model.band_um)


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
) -> list[Method]:
    """Return a map as kelvin in a scene: true materials with all bounds and once with true objects, learned materials
    with the best bounds.

    `text` is the map's name or file, `model` the map, `reference` a Renderer of the same surfaces, whose sampling the
    methods share. `learned` is the scene with learned materials, None to leave them out. A method renders nothing
    before its `renderer` is used.
    """
    if not isinstance(model.predictor, Remembered):
        model = replace(model, predictor=Remembered(model.predictor))
    needs = [_WORDS[name] for name in model.needs]

    def method(
        variant: _Variant, kind: str, cold: Scene, knows: Sequence[str], kelvin: dict[str, float], objects: bool
    ) -> Method:
        bounds, at, limits = variant
        source = TemperatureSpec(source="learned", model=str(text), range_c=limits)

        def build() -> Renderer:
            solved = cold.with_temperature(source, at).with_objects(kelvin)
            return _rendered_like(reference, solved)

        return Method(kind, model.name, bounds, _knows(bounds, *knows, *needs), objects, at, build, kelvin)

    found = []
    variants = _variants(model, campaign, _sky_of(scene, model, campaign))
    for variant in variants if true_materials else variants[-1:]:
        kelvin = object_temperatures(scene, variant[1], reference)
        if true_materials:
            found.append(method(variant, TRUE_MATERIALS, scene, ("the materials",), kelvin, False))
    if true_materials and scene.spec.objects:
        found.append(method(variant, TRUE_MATERIALS, scene, ("the materials", "the objects"), {}, True))
    if learned is not None:
        found.append(method(variant, LEARNED_MATERIALS, learned, (), kelvin, False))
    return found


def _rendered_like(reference: Renderer, scene: Scene) -> Renderer:
    """The Renderer of a scene with the surfaces and the sampling of a reference."""
    return renderer_of(scene, reference, **reference.plan.sampling.settings())


def _balance(given: Given) -> Iterator[Method | str]:
    scene = given.scene
    if not given.has_truth:
        return
    left_out = f"The heat balance of tables is left out of {scene.name}: "
    if scene.balanced or not given.weathered:
        why = "the reference is that heat balance" if scene.balanced else "the scene has no [weather]"
        yield f"{left_out}{why}."
        return
    given.report("solving the heat balance of tables", 0.0)
    kelvin = _table_temperatures(scene)

    def build() -> Renderer:
        asked = scene.with_sun(None).with_temperature("balance").with_objects(kelvin)
        return _rendered_like(given.reference, asked)

    method = Method(BALANCE, "heat balance of tables", None, "the materials, hour and weather, relief", build=build,
                    kelvin=kelvin)  # fmt: skip
    try:
        # Solved here, so that a failure leaves out this method only.
        _ = method.renderer
    except ThermorenderError as error:
        yield f"{left_out}{error}"
        return
    yield method


def _privileged(given: Given) -> Iterator[Method | str]:
    if given.privileged is None:
        return
    scene, (text, model) = given.scene, given.privileged
    time = scene.time
    if scene.world is not None or not given.weathered or time is None:
        why = "the scene has no [weather]" if scene.world is None else "its ground is in tiles"
        yield f"The privileged map {model.name} is left out of {scene.name}: {why}."
        return
    kelvin = _table_temperatures(scene)

    def build() -> Renderer:
        asked = scene.with_sun(None).with_temperature(TemperatureSpec(source="learned", model=str(text)), model)
        (solved,) = mapped(asked.with_objects(kelvin), [time], given.reference.baked.geometry, material=True)
        return _rendered_like(given.reference, solved)

    knows = _knows(None, "the materials", *(_WORDS[name] for name in model.needs))
    yield Method(PRIVILEGED, model.name, None, knows, model=model, build=build, kelvin=kelvin)


def constant(mean_k: float) -> Callable[[View], Image]:
    """Return the function of a constant [K]."""
    return lambda view: np.full(view.known.shape, mean_k)


def own_mean(view: View) -> Image:
    """Return the mean of a View's reference on ground everywhere, (H, W) [K]: of radiance where that is known."""
    ground, truth = view.ground, view.truth
    assert truth is not None
    if not ground.any():
        return np.full(truth.shape, np.nan)
    if view.truth_radiance is None:
        return np.full(truth.shape, truth[ground].mean(dtype=np.float64))
    mean = view.truth_radiance[ground].mean(dtype=np.float64)
    return np.full(truth.shape, brightness_temperature(float(mean), *view.band_um))


def per_material(mean_k: float, material_k: Mapping[str, float]) -> Callable[[View], Image]:
    """Return the function of one temperature per material [K]; the mean where there is none."""

    def function(view: View) -> Image:
        table = np.full(256, mean_k)
        for number, name in enumerate(view.material_names):
            table[number] = material_k.get(name, mean_k)
        return table[view.material]

    return function


def _constant(given: Given) -> Iterator[Method | str]:
    if given.has_truth and given.campaign is not None:
        yield Method(CONSTANT, A_CONSTANT, None, THERMAL, function=constant(given.campaign.mean_k))


def _per_material(given: Given) -> Iterator[Method | str]:
    if given.has_truth and given.campaign is not None:
        function = per_material(given.campaign.mean_k, given.campaign.material_k)
        yield Method(PER_MATERIAL, "a mean per material", None, f"the materials, {THERMAL}", function=function)


def _own_mean(given: Given) -> Iterator[Method | str]:
    if given.has_truth:
        yield Method(FRAME_MEAN, OWN_MEAN, None, "the reference's mean", function=own_mean)


def _foreign(given: Given) -> Iterator[Method | str]:
    yield from (Method(FOREIGN, each.name, function=each.temperature) for each in given.foreign)


# Methods by kind: of each map, and of the scene.
OF_MAPS: dict[str, Callable[[Given, str, TemperatureMap], Iterable[Method | str]]] = {
    PHOTOGRAPH: _photographs, TRUE_MATERIALS: _true_materials, LEARNED_MATERIALS: _learned_materials,
}  # fmt: skip
OF_SCENES: dict[str, Callable[[Given], Iterable[Method | str]]] = {
    PRIVILEGED: _privileged, CONSTANT: _constant, PER_MATERIAL: _per_material, FRAME_MEAN: _own_mean,
    BALANCE: _balance, FOREIGN: _foreign,
}  # fmt: skip
# Chosen by their own arguments.
_ALWAYS = (PRIVILEGED, FOREIGN)


def chosen_kinds() -> tuple[str, ...]:
    """Return the kinds of methods that a comparison chooses from."""
    return tuple(kind for kind in (*OF_MAPS, *OF_SCENES) if kind not in _ALWAYS)


KINDS = chosen_kinds()


def object_temperatures(scene: Scene, model: TemperatureMap, reference: Renderer) -> dict[str, float]:
    """Return {object: kelvin} that a map predicts from the objects' colours, or the material's where it is unreliable.

    The map translates a uniform picture of the colour, with the other inputs of the texel under the object.
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
        assert time is not None and scene.spec.weather is not None  # else a map with these needs is refused
        weather = conditions(scene.weather, time, scene.spec.weather.inside_c)
        sky = scene.sky_temperature_in(model.band_um)
        if "terrain" in model.needs:
            planes = reliefs(scene, [time], reference.baked.geometry)[time]
    in_band = InBand(model, scene.materials, scene.where)
    for item in scene.spec.objects:
        surface = surfaces[item.name]
        patch = np.empty((EVEN_PX, EVEN_PX, 3), np.uint8)
        patch[:] = np.round(surface.colour.reshape(-1, 3).mean(axis=0))
        at = _texel_of(scene, item)
        terrain = {name: np.full(patch.shape[:2], planes[name].flat[at], np.float32) for name in NAMES if planes}
        material = np.full(patch.shape[:2], surface.material.flat[0])
        inputs = Inputs(patch, scene.main_surface.texel_m, terrain, weather)
        stand_in = weather["air_k"] if weather else None
        kelvin, *_ = kinetic_from_map(model, inputs, material, in_band, sky, stand_in)
        found[item.name] = float(kelvin[EVEN_PX // 2, EVEN_PX // 2])
    return found


def _texel_of(scene: Scene, item: Any) -> int:
    """Return the flat number of the terrain texel nearest to an object's position."""
    first = scene.main_surface
    rows, columns = first.material.shape
    low, high = first.vertices.min(axis=0), first.vertices.max(axis=0)
    share = (np.array(item.position[:2]) - low[:2]) / np.maximum(high[:2] - low[:2], 1e-9)
    column, row = np.clip([share[0] * columns, (1.0 - share[1]) * rows], 0, [columns - 1, rows - 1]).astype(int)
    return int(row * columns + column)


def _table_temperatures(scene: Scene) -> dict[str, float]:
    """Return {object: table temperature of its material [K]}."""
    kelvin = {each.name: each.temperature for each in reversed(scene.materials)}
    return {item.name: kelvin[item.material] for item in scene.spec.objects}


def learned_materials(model: str = EMISSIVITY_MAP) -> EmissivitySpec:
    """Return the EmissivitySpec of a learned material map, with the usual material where the map knows none."""
    return EmissivitySpec(source="learned", model=model, fallback=FALLBACK_MATERIAL)
