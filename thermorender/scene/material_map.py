"""Materials of a scene from its orthophoto: a learned emissivity map applied, or written as files for correction."""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import files, formats
from thermorender.defaults import EMISSIVITY_MAP, FALLBACK_MATERIAL
from thermorender.errors import ThermorenderError
from thermorender.learned.emissivity import elevation
from thermorender.learned.emissivity.mapping import EmissivityMap, Evidence, load_map, map_materials
from thermorender.learned.pixel_features import lab
from thermorender.materials import library as material_tables
from thermorender.materials.extended import within_band
from thermorender.materials.material import Material
from thermorender.materials.mixture import palette
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene import terrain
from thermorender.scene.map_view import MapView
from thermorender.scene.mapped_cover import MappedCover, read_mapped_cover
from thermorender.scene.orthophoto import read_colour
from thermorender.scene.raster import Grid, grid_of, onto
from thermorender.scene.spec import EmissivitySpec, SceneSpec, read_scene
from thermorender.scene.surface import fill, nearest_valid
from thermorender.scene.weathered_ground import is_snow

# Of the 255 material numbers of a texel; the rest is for objects.
_MOST_MIXES = 200
# Class number that `map-materials` writes for unknown texels.
UNKNOWN_CLASS = 255
# Temperature for which band means are taken [K].
_REFERENCE_K = 300.0
_UNKNOWN_COLOUR, _OTHER_COLOUR = (255, 0, 255), (204, 204, 204)
# Entries of the picture's legend, in addition to the one of all others.
_MOST_NAMED = 10
_Colour = tuple[int, ...]
# Distance in CIELAB from which colours of a legend are easy to distinguish.
_DISTINCT = 20.0


@dataclass(frozen=True, eq=False)
class Context:
    """What a scene knows of its ground beside the orthophoto, or beside the textures of a mesh."""

    case: NDArray[np.uint8] | None  # (h, w) uint8 cases of `elevation.case_of`, where heights tell materials apart
    known: MappedCover | None
    notes: tuple[str, ...]  # What is used and what is not, one sentence each

    def onto(self, view: MapView, number: int) -> "Context":
        """Return the Context, without notes, of the texels of a surface that a map shows; none is known of others."""
        case = None if self.case is None else view.onto(number, self.case)
        known = None if self.known is None else replace(self.known, number=view.onto(number, self.known.number))
        return Context(case, known, ())

    def evidence(self, materials: Sequence[str]) -> list[Evidence]:
        """Return the Evidence on materials by name."""
        found = [] if self.case is None else [elevation.evidence(self.case, materials)]
        return found if self.known is None else [*found, self.known.evidence(materials)]


@dataclass(frozen=True, eq=False)
class Picture:
    """A photograph of ground: an orthophoto or the texture of a mesh."""

    colour: NDArray[np.uint8]  # (h, w, 3) uint8 sRGB, holes filled
    valid: NDArray[np.bool_]  # (h, w) bool false where holes were filled, and where no ground shows the texel
    texel_m: float
    context: Context | None = None  # Of a picture on a map
    name: str = "the picture"  # For messages


def context_of(
    source: EmissivitySpec, height: NDArray[np.float64], height_grid: Grid, texels: Grid, texel_m: float,
    walls: bool = False,
) -> Context:  # fmt: skip
    """Return the Context of an orthophoto: of heights (h, w) [m] on a Grid of the same CRS, and of `source.known`.

    With `walls` a building's material is that of its walls.
    """
    known = read_mapped_cover(source.known, texels, texel_m, walls) if source.known else None
    case, why = None, "emissivity.heights is false"
    if source.heights:
        post_m = texel_m * float(np.sqrt(abs(height_grid.transform.determinant / texels.transform.determinant)))
        above, slope, why = elevation.seen(height, post_m)
    note = f"heights are not used: {why}"
    if not why:
        high_m = elevation.HEIGHTS_M[1]
        case = elevation.case_of(*(onto(each, height_grid, texels, "bilinear") for each in (above, slope)))
        note = (
            f"heights above the ground and slopes weigh the materials; {(above > high_m).mean():.0%} of the surface "
            f"stands more than {high_m:g} m above it"
        )
    return Context(case, known, (note, *(known.notes if known else ())))


def model_of(
    source: EmissivitySpec, library: Mapping[str, Material], where: str, no_snow: str = ""
) -> tuple[EmissivityMap, tuple[str, ...]]:
    """Return (EmissivityMap of a source "learned" without what does not occur, sentences on what weather excludes)."""
    assert source.model is not None
    whole = load_map(source.model)
    model = whole.without(source.without).with_shares(source.shares)
    for name in source.present:
        if name not in whole.materials:
            raise ThermorenderError(
                f"{where}: emissivity.present names {name!r}, which emissivity map {model.name!r} does not have; "
                f"it has {', '.join(model.materials)}"
            )
    snowy = [name for name in model.materials if name in library and is_snow(library[name])]
    excluded = [name for name in snowy if no_snow and name not in source.present]
    if not excluded or len(excluded) > len(model.materials) - 2:
        return model, ()
    return model.without(excluded), (f"{', '.join(excluded)} left out: {no_snow}",)


def learned_materials(
    source: EmissivitySpec, library: Mapping[str, Material], pictures: Sequence[Picture],
    band_um: tuple[float, float], where: str, no_snow: str = "",
) -> tuple[list[NDArray[np.uint8]], list[Material], list[NDArray[np.bool_]], dict[str, Any]]:  # fmt: skip
    """Return (numbers (h, w) uint8, materials and mixes, unknown (h, w) bool, report) of a terrain's pictures.

    All pictures share the materials; numbers and unknown have an array for each. A texel is unknown where the fallback,
    the last material, is used, or where its emissivity's standard deviation exceeds `source.most_std`. `no_snow` is the
    reason why no snow lies there, or "".
    """
    assert source.fallback is not None
    model, notes = model_of(source, library, where, no_snow)
    of = f"emissivity map {model.name!r}"
    contexts = [one.context for one in pictures if one.context]
    known = [one.known for one in contexts if one.known]
    names = list(dict.fromkeys([*model.materials, *(name for one in known for name in one.beyond(model.materials))]))
    own = _in_band([material_tables.find(library, name, of) for name in names], library, band_um, of, where)
    fallback = material_tables.find(library, source.fallback, f"{where}: emissivity.fallback")
    index, share, probability, confidence = _mapped(model, pictures, names)
    valid = np.concatenate([one.valid.ravel() for one in pictures])
    unknown = valid & (confidence < source.confidence)
    # Pictures of a scene have the same cases, or none of them has any.
    group = np.concatenate([one.number.ravel() for one in known]) if known else None
    number, used, error = palette(index, share, probability, own, band_um, _MOST_MIXES, group, model.doubt(names))
    number[unknown] = len(used)
    # The fallback is not learned.
    std = np.array([*(one.band_emissivity_std(*band_um, _REFERENCE_K) for one in used), 0.0])[number]
    doubtful = valid & (std > source.most_std)
    report = {
        "model": model.name,
        "fallback": fallback.name,
        "share_unknown": float(unknown.sum() / valid.sum()),
        "share_uncertain": float(doubtful.sum() / valid.sum()),
        "mean_confidence": float(confidence[valid].mean()),
        "palette_mean": error["mean"],
        "palette_largest": error["largest"],
        "texel_m": max(one.texel_m for one in pictures),
        "trained_texel_m": model.texel_m,
        "context": (*notes, *(note for one in contexts for note in one.notes)),
    }
    if (valid & ~unknown).any():
        report["mean_std"] = float(np.nanmean(std[valid & ~unknown]))
    ends = np.cumsum([one.valid.size for one in pictures])[:-1]

    def apart(values: NDArray[Any]) -> list[NDArray[Any]]:
        return [part.reshape(one.valid.shape) for part, one in zip(np.split(values, ends), pictures, strict=True)]

    return apart(number), [*used, fallback], apart(unknown | doubtful), report


def _mapped(
    model: EmissivityMap, pictures: Sequence[Picture], names: Sequence[str]
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any]]:
    """(index, share, probability, confidence) of `Mapped` for all texels of pictures, (T, …), one after another."""
    found = [
        map_materials(model, one.colour, one.texel_m, name=one.name,
                      evidence=one.context.evidence(names) if one.context else ())
        for one in pictures
    ]  # fmt: skip

    def together(arrays: Iterable[NDArray[Any]]) -> NDArray[Any]:
        return np.concatenate([values.reshape(-1, *values.shape[2:]) for values in arrays])

    return (
        together(one.index for one in found), together(one.share for one in found),
        together(one.probability for one in found), together(one.confidence for one in found),
    )  # fmt: skip


def _in_band(
    materials: Sequence[Material], library: Mapping[str, Material], band_um: tuple[float, float], of: str, where: str
) -> list[Material]:
    """Materials of a map that cover a band; ThermorenderError names all those that do not."""
    found, missing = [], []
    for material in materials:
        try:
            found.append(within_band(material, band_um, library, where))
        except ThermorenderError:
            missing.append(material.name)
    if missing:
        advice = (
            f"leave them out with emissivity.without = {json.dumps(missing, ensure_ascii=False)}, or give the scene "
            "tables that cover it"
            if len(found) >= 2
            else "give the scene tables that cover it, or another emissivity.source"
        )
        raise ThermorenderError(
            f"{where}: the tables of {len(missing)} of the {len(materials)} materials of {of} do not cover the "
            f"camera's band {band_um[0]:g}–{band_um[1]:g} µm; {advice}"
        )
    return found


@dataclass(frozen=True, eq=False)
class Orthophoto:
    """A scene's orthophoto: colour without holes, where it is valid, texels, heights and their Grid, and the frame."""

    colour: NDArray[np.uint8]
    valid: NDArray[np.bool_]
    grid: Grid
    texel_m: float
    height: NDArray[np.float64]
    height_grid: Grid
    frame: LocalFrame


def orthophoto_of(spec: SceneSpec) -> Orthophoto:
    """Return the Orthophoto of a scene."""
    source = spec.terrain
    if source.mesh:
        raise ThermorenderError(
            f"{spec.folder / 'scene.toml'} is a mesh, whose textures are not on a map; give "
            "emissivity.source='learned' to use its materials at once, or class rasters of its textures"
        )
    if not (source.elevation and source.orthophoto):
        raise ThermorenderError(
            f"{spec.folder / 'scene.toml'} has no terrain.orthophoto beside terrain.elevation; materials are read "
            "from an orthophoto, so add one"
        )
    rgb, valid = read_colour(source.orthophoto)
    if not valid.any():
        raise ThermorenderError(f"{source.orthophoto} is empty: every texel is masked; give another orthophoto")
    grid = grid_of(source.orthophoto)
    height, height_grid = terrain.read_elevation(source.elevation)
    frame = LocalFrame(*spec.frame) if spec.frame else terrain.frame_of(height, height_grid)
    filled = rgb if valid.all() else fill(rgb, nearest_valid(valid))
    return Orthophoto(filled, valid, grid, terrain.texel_size_m(grid, frame), height, height_grid, frame)


def write_map(
    folder: Path | str, output: Path | str, model: str | None = None, fallback: str | None = None,
    confidence: float | None = None, without: Sequence[str] = (), progress: Callable[[float], None] | None = None,
) -> tuple[dict[str, Path], dict[str, float], tuple[str, ...]]:  # fmt: skip
    """Write class, probability and confidence rasters and a picture of a scene's materials to the folder `output`.

    Returns ({kind: path}, {class: share}, sentences on the context). Texels below `confidence` are unknown and get the
    material `fallback`; `without` names further materials of the map that do not occur. What is not given is the
    scene's, where its emissivity is learned. `progress` takes the share done.

    `classes.tif` holds material numbers (0 no image, 255 unknown) and `emissivity.toml` their table for a scene file.
    `probabilities.tif` has one band per material, in 1/255; `materials.png` shows orthophoto and classes side by side.
    """
    import rasterio
    from rasterio.windows import Window

    spec = read_scene(folder)
    own = (
        spec.emissivity
        if spec.emissivity.source == "learned"
        else EmissivitySpec("learned", model=EMISSIVITY_MAP, fallback=FALLBACK_MATERIAL)
    )
    confidence = own.confidence if confidence is None else confidence
    if not 0.0 <= confidence <= 1.0:
        raise ThermorenderError(f"confidence={confidence:g} is not allowed; give a number 0…1")
    fallback = fallback or own.fallback or FALLBACK_MATERIAL
    picture = orthophoto_of(spec)
    valid, grid = picture.valid, picture.grid
    library = material_tables.load_library(spec.folder / "materials" if (spec.folder / "materials").is_dir() else None)
    material_tables.find(library, fallback, "--fallback")
    if model not in (None, own.model):
        # What the scene states on materials is of its own map.
        own = replace(own, model=model, shares={}, without=(), present=())
    source = replace(own, fallback=fallback, without=tuple(dict.fromkeys([*own.without, *without])))
    emissivity_map, notes = model_of(source, library, str(spec.folder / "scene.toml"), _no_snow(spec, picture.frame))
    context = context_of(source, picture.height, picture.height_grid, grid, picture.texel_m)
    materials = [*emissivity_map.materials, *(context.known.beyond(emissivity_map.materials) if context.known else ())]
    output = Path(output)
    profile = {
        "driver": "GTiff", "height": grid.height, "width": grid.width, "crs": grid.crs, "transform": grid.transform,
        "dtype": "uint8", "compress": "deflate", "tiled": True,
    }  # fmt: skip
    paths = {
        name: output / f"{name}{end}"
        for name, end in (("classes", ".tif"), ("probabilities", ".tif"), ("confidence", ".tif"),
                          ("materials", ".png"), ("emissivity", ".toml"))
    }  # fmt: skip
    with (
        formats.atomic_raster(paths["probabilities"]) as part,
        rasterio.open(part, "w", count=len(materials), **profile) as file,
    ):
        file.descriptions = tuple(materials)
        file.scales = (1.0 / 255.0,) * len(materials)

        def keep(rows: slice, columns: slice, probabilities: NDArray[Any]) -> None:
            bands = np.where(valid[rows, columns], np.rint(255.0 * probabilities), 0.0).astype(np.uint8)
            file.write(bands, window=Window.from_slices(rows, columns))

        mapped = map_materials(
            emissivity_map, picture.colour, picture.texel_m, progress, keep, context.evidence(materials)
        )
    unknown = mapped.confidence < confidence
    classes = np.where(unknown, UNKNOWN_CLASS, mapped.index[..., 0] + 1)
    classes = np.where(valid, classes, 0).astype(np.uint8)
    numbered = enumerate(materials, 1)
    colours = _legend_colours({number: library[name] for number, name in numbered if name in library})
    with formats.atomic_raster(paths["classes"]) as part, rasterio.open(part, "w", count=1, **profile) as file:
        file.write(classes, 1)
        file.write_colormap(1, {0: (0, 0, 0, 0), UNKNOWN_CLASS: _UNKNOWN_COLOUR, **colours})
    with formats.atomic_raster(paths["confidence"]) as part, rasterio.open(part, "w", count=1, **profile) as file:
        file.write(np.where(valid, np.rint(255.0 * mapped.confidence), 0).astype(np.uint8), 1)
        file.scales = (1.0 / 255.0,)
    present = [int(value) for value in np.unique(classes[classes > 0])]
    names = {**dict(enumerate(materials, 1)), UNKNOWN_CLASS: fallback}
    lines = ["[emissivity]", 'source = "classes"', 'raster = "classes.tif"', "", "[emissivity.classes]"]
    for value in sorted({*present, *range(1, len(materials) + 1), UNKNOWN_CLASS}):
        lines.append(f'{value} = "{names[value]}"' + ("  # unknown" if value == UNKNOWN_CLASS else ""))
    formats.write_text(paths["emissivity"], "\n".join(lines) + "\n")
    share = np.bincount(classes.ravel(), minlength=256) / max(valid.sum(), 1)
    shown = {value: ("unknown" if value == UNKNOWN_CLASS else names[value], share[value]) for value in present}
    _picture(paths["materials"], np.where(valid[..., None], picture.colour, 255), classes, shown, colours)
    return paths, {name: float(part) for name, part in shown.values()}, (*notes, *context.notes)


def _no_snow(spec: SceneSpec, frame: LocalFrame) -> str:
    """Why no snow lies on a scene's ground by its weather; "" if it may."""
    if spec.weather is None:
        return ""
    from thermorender.weather.declared_weather import declared_weather

    altitude_m = frame.height_m - (spec.terrain.geoid_undulation_m or 0.0)
    weather = declared_weather(spec.weather, frame.latitude_deg, frame.longitude_deg, altitude_m)
    return weather.why_no_snow(spec.weather.time)


def _legend_colours(materials: Mapping[int, Material]) -> dict[int, _Colour]:
    """{number: sRGB bytes}: each material's colour, made lighter, darker or more saturated if another has it."""
    import colour

    def srgb(value: Any) -> NDArray[np.float64]:
        return np.clip(colour.XYZ_to_sRGB(colour.Lab_to_XYZ(value)), 0.0, 1.0)

    taken: list[NDArray[Any]] = []
    found: dict[int, _Colour] = {}
    variants = [(light, full) for full in (1.6, 2.6, 0.8) for light in (0, 14, -14, 28, -28, 42)]
    for number, material in materials.items():
        own = lab(np.array(material.colour, dtype=np.uint8)).astype(np.float64)
        choice = [srgb(own * (1.0, full, full) + (light, 0.0, 0.0)) for light, full in variants]
        seen = [lab(np.uint8(np.rint(255.0 * c))) for c in choice]
        away = [min((float(np.linalg.norm(one - other)) for other in taken), default=np.inf) for one in seen]
        best = next((k for k, distance in enumerate(away) if distance >= _DISTINCT), int(np.argmax(away)))
        taken.append(seen[best])
        found[number] = tuple(int(v) for v in np.rint(255.0 * choice[best]))
    return found


def _picture(
    path: Path, rgb: NDArray[np.uint8], classes: NDArray[np.uint8], shown: Mapping[int, tuple[str, Any]],
    colours: Mapping[int, _Colour],
) -> None:  # fmt: skip
    """Write orthophoto and classes side by side with a legend of the largest shares; other classes have one colour."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.patches import Patch

    order = sorted(shown, key=lambda value: -shown[value][1])
    # One entry more than fits stays by itself.
    named, others = (order, []) if len(order) <= _MOST_NAMED + 1 else (order[:_MOST_NAMED], order[_MOST_NAMED:])
    table = np.full((256, 3), 255, dtype=np.uint8)
    table[others] = _OTHER_COLOUR
    for value in named:
        table[value] = colours.get(value, _UNKNOWN_COLOUR)
    step = max(1, -(-max(classes.shape) // 1400))
    figure = Figure(figsize=(15.0, 7.0), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    left.imshow(rgb[::step, ::step])
    right.imshow(table[classes[::step, ::step]], interpolation="nearest")
    for axes in (left, right):
        axes.set_axis_off()
    patches = [
        Patch(color=table[value] / 255.0, label=formats.label("{} {:.1%}".format(*shown[value]))) for value in named
    ]
    if others:
        share = sum(shown[value][1] for value in others)
        patches.append(Patch(color="0.8", label=f"{len(others)} others {share:.1%}"))
    figure.legend(handles=patches, loc="outside right center", frameon=False)
    with files.atomic(path) as part:
        figure.savefig(part, dpi=110)
