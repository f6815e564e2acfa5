"""Training of an emissivity map on scenes with a class raster or labelled polygons, or on procedural ones."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.training.emissivity_training import Labelled, train
from thermorender.defaults import BAND_UM
from thermorender.errors import ThermorenderError, shortened
from thermorender.learned.emissivity.mapping import MOST_MATERIALS, EmissivityMap
from thermorender.materials import library as material_tables
from thermorender.progress import Progress
from thermorender.scene.material_map import UNKNOWN_CLASS, orthophoto_of
from thermorender.scene.patch import name_of, read_features, texels_of
from thermorender.scene.raster import Grid, grid_of, onto, read_classes
from thermorender.scene.spec import read_scene

# Seeds of the shipped map's training scenes.
PROCEDURAL_SEEDS = (101, 102, 103)
DEFAULT_TEXEL_M = 0.5
# Versions of each scene, and made lands of each kind, that the shipped map is trained on besides.
_VERSIONS, _MADE = 2, 16
# What the shipped map's networks decide of a material's share in its group. Chosen on labelled pictures of four places:
# 0.1 to 0.3 are as good there; with 1 it errs twice as much on bare land.
_OWN = 0.2


def train_on(
    folders: Sequence[str | Path] = (), polygons: str | Path | Mapping[str, Any] | None = None, name: str = "map",
    texel_m: float | None = None, augmentations: int | None = None, seed: int = 0,
    progress: Progress | None = None,
) -> tuple[EmissivityMap, NDArray[np.int64]]:  # fmt: skip
    """Return (EmissivityMap, confusion (C, C) int64) trained on scene folders; on procedural scenes without any.

    `polygons` is GeoJSON, a path or its contents, in place of the class raster of a single scene. `texel_m` is the
    ground sampling distance [m], by default 0.5 or the coarsest orthophoto's. `augmentations` of each orthophoto are by
    default 0 for given scenes and 1 for procedural ones. `progress` takes (task, share done). Confusion counts held-out
    texels by true material in rows and most probable one in columns. The same seed and library versions give the same
    map.
    """
    from thermorender.scene.load import scene_folder

    if polygons and len(folders) != 1:
        raise ThermorenderError(
            f"--labels={name_of(polygons)!r} belongs to one scene, but {len(folders)} are given; give one"
        )
    if texel_m is not None and not 0.01 <= texel_m <= 1000.0:
        raise ThermorenderError(f"--texel-m={texel_m:g} is not allowed; give 0.01…1000 m")
    if folders:
        given = [labelled_scene(scene_folder(folder), polygons) for folder in folders]
        labelled: Iterable[Labelled] = given
        texel_m = texel_m or max(DEFAULT_TEXEL_M, *(item.texel_m for item in given))
        augmentations = 0 if augmentations is None else augmentations
    else:
        labelled = varied(PROCEDURAL_SEEDS, seed)
        texel_m, augmentations = texel_m or DEFAULT_TEXEL_M, 1 if augmentations is None else augmentations
    if not 0 <= augmentations <= 20:
        raise ThermorenderError(f"augmentations={augmentations} is not allowed; give 0…20")
    own = 1.0 if folders else _OWN
    return train(labelled, texel_m, name, band_emissivity_of(folders), augmentations, seed, progress, own)


def band_emissivity_of(folders: Sequence[str | Path] = ()) -> Callable[[str], float]:
    """Return a function (material of library or scenes) → emissivity at 300 K over the measured part of 7.5–13.5 µm."""
    own = [Path(folder) / "materials" for folder in folders]
    library = material_tables.load_library()
    for folder in own:
        library = library | (material_tables.load_library(folder) if folder.is_dir() else {})

    def found(name: str) -> float:
        material = material_tables.find(library, name, "the labels")
        low, high = (limit(pair) for limit, pair in zip((max, min), zip(BAND_UM, material.valid_range_um, strict=True),
                                                        strict=True))  # fmt: skip
        return float(material.band_emissivity(low, high, 300.0))

    return found


def adapted_to(
    folder: str | Path, model: str | Path, polygons: str | Path | None = None, name: str = "map", seed: int = 0
) -> EmissivityMap:
    """Return an EmissivityMap for a scene, the map of a name or file updated by its class raster or polygons."""
    from thermorender.apps.training.emissivity_adaptation import adapted
    from thermorender.learned.emissivity.mapping import load_map
    from thermorender.scene.load import scene_folder

    own = scene_folder(folder)
    return adapted(load_map(model), labelled_scene(own, polygons), name, band_emissivity_of([own]), seed)


def labelled_scene(folder: str | Path, polygons: str | Path | Mapping[str, Any] | None = None) -> Labelled:
    """Return the Labelled of a scene: its orthophoto with labels from a GeoJSON, else from its class raster.

    Polygons have a property "material", in WGS 84 or the "crs" member; later ones cover earlier ones.
    """
    spec = read_scene(folder)
    picture = orthophoto_of(spec)
    grid = picture.grid
    where, unused = spec.folder / "scene.toml", ""
    library = material_tables.load_library(spec.folder / "materials" if (spec.folder / "materials").is_dir() else None)
    if polygons:
        material, names, unused = read_polygons(polygons, grid)
        source = f"{Path(name_of(polygons)).name} on {spec.folder.name}"
    elif spec.emissivity.source == "classes":
        raster = spec.emissivity.raster
        assert raster is not None
        numbers = onto(read_classes(raster), grid_of(raster), grid, "nearest")
        material, names = numbers.astype(np.uint8), dict(spec.emissivity.classes)
        named = np.isin(np.arange(256), list(names))
        material = np.where(named[material] & (material != UNKNOWN_CLASS), material, 0).astype(np.uint8)
        source = f"{raster.name} of {spec.folder.name}"
    else:
        raise ThermorenderError(
            f"{where} has no class raster to train on (emissivity.source={spec.emissivity.source!r}); give polygons "
            "with --labels, or a raster with emissivity.source='classes'"
        )
    for name in names.values():
        material_tables.find(library, name, name_of(polygons or where))
    known = np.where(picture.valid, material, 0).astype(np.uint8)
    return Labelled(picture.colour, known, names, picture.texel_m, source, unused=unused)


def procedural(seeds: Iterable[int]) -> Iterator[Labelled]:
    """Yield the Labelled of a procedural scene of every kind and seed."""
    from thermorender.apps.lands.procedural.procedural_scene import KINDS, make

    for seed in seeds:
        for kind in KINDS:
            scene = make(kind, seed)
            yield Labelled(
                scene.orthophoto,
                scene.classes,
                scene.class_names,
                scene.texel_m,
                f"procedural {kind} seed {seed}",
                kind,
            )


def varied(seeds: Iterable[int], seed: int) -> Iterator[Labelled]:
    """Yield the procedural scenes, versions of each with other colours and cover, and made lands of each kind."""
    from thermorender.apps.training.made_land import MAKERS, made_land
    from thermorender.apps.training.varied_land import versions

    generator = np.random.Generator(np.random.Philox(seed))
    for item in procedural(seeds):
        yield item
        yield from versions(item, _VERSIONS, generator)
    for kind in MAKERS:
        for number in range(_MADE):
            yield made_land(kind, number)


def read_polygons(
    given: str | Path | Mapping[str, Any], grid: Grid
) -> tuple[NDArray[np.uint8], dict[int, str], str]:  # fmt: skip
    """Return (material number (h, w) uint8, {number: name}, notes) of GeoJSON polygons on a Grid; 0 outside.

    The notes are a sentence on polygons that label no texel, or "".
    """
    (features, crs), path = read_features(given), name_of(given)
    names: list[str] = []
    burnt, empty = np.zeros((grid.height, grid.width), np.uint8), []
    for number, feature in enumerate(features, 1):
        try:
            geometry, name = feature["geometry"], feature["properties"]["material"]
            if geometry["type"] not in ("Polygon", "MultiPolygon") or not isinstance(name, str):
                raise ValueError
        except Exception:  # whatever stands in place of a feature
            raise ThermorenderError(
                f"{path}, feature {number} is not a polygon with a property 'material'; name the material of each "
                "polygon"
            ) from None
        names += [name] if name not in names else []
        part, inside = texels_of(geometry, crs, grid, f"{path}, feature {number}")
        if inside.any():
            burnt[part][inside] = min(names.index(name) + 1, 255)
        else:
            empty.append(f"{number} ({name})")
    if not 0 < len(names) <= MOST_MATERIALS:
        raise ThermorenderError(f"{path} names {len(names)} materials; label polygons of 2…{MOST_MATERIALS} materials")
    if not burnt.any():
        raise ThermorenderError(
            f"{path} covers no texel of {grid.name}; its coordinates must be longitude and latitude unless a 'crs' "
            "member names another CRS; export it again"
        )
    unused = ""
    if empty:
        unused = (
            f"{len(empty)} of the {len(features)} polygons of {Path(path).name} label no texel, because they are "
            f"outside the picture or smaller than a texel: {shortened(', '.join(empty), 200)}"
        )
    return burnt, dict(enumerate(names, 1)), unused
