"""Where a scene's surfaces lie: objects stood on the terrain, and triangles made finer beside them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.scene import crowns, instances
from thermorender.scene.drape import Drape
from thermorender.scene.folder import SceneFiles
from thermorender.scene.ground import Ground
from thermorender.scene.raster import Grid
from thermorender.scene.refine import TRACKED_SHARE, evened, refined
from thermorender.scene.seam import stitched
from thermorender.scene.surface import Surface
from thermorender.scene.textures import Texture, with_texel_per_face
from thermorender.scene.tracks import TrackedObject

# Columns of a track that an edit holds at one value, by the name of the object.
Held = Mapping[str, frozenset[str]]


class Placement(NamedTuple):
    """Where an object stands, and whether the heat balance solves its temperature."""

    name: str
    position: tuple[float, float, float]
    yaw_deg: float
    balanced: bool


@dataclass(frozen=True, eq=False)
class Shape:
    """Surfaces of a scene without what covers them."""

    frame: LocalFrame | None
    ground: tuple[Surface, ...]  # The terrain
    static: tuple[Surface, ...]  # Of objects without a track, in the scene's frame
    static_of: tuple[int, ...]  # Number of the object that each of `static` belongs to
    tracked: tuple[TrackedObject, ...]
    tracked_of: tuple[int, ...]  # Number of the object of each of `tracked`
    highest_m: float  # Highest vertex of terrain and objects, along their tracks too [m]
    # Of each part of a mesh, and of each raster ground, which follow them; empty for surfaces made in memory
    textures: tuple[Texture, ...] = ()
    drapes: tuple[Drape, ...] = ()
    balanced: int = 0  # Number of `static`, the first ones, whose temperatures the heat balance solves
    inner_1_m2: tuple[float, ...] = ()  # Share of its object's inner heat on a square metre of each of `static` [m⁻²]

    @property
    def grid(self) -> Grid | None:
        """Map grid of the texels of a raster terrain."""
        return self.drapes[0].grid if self.drapes and not self.textures else None

    def drape(self, number: int) -> Drape | None:
        """Return the Drape of a ground by its number; None for a part of a mesh, and for one made in memory."""
        own = number - len(self.textures)
        return self.drapes[own] if 0 <= own < len(self.drapes) else None


def shape_of(files: SceneFiles, placements: Sequence[Placement], held: Held, where: str) -> Shape:
    """Return the Shape of a scene's files with its objects where `placements` says."""
    ground = Ground(files.ground)
    posed = [_posed(part, place, held) for part, place in zip(files.objects, placements, strict=True)]
    # Those that the heat balance solves come first, copies last of them.
    still = [number for number, one in enumerate(posed) if not one.item.track]
    still.sort(key=lambda number: 1 + (posed[number].places is not None) if placements[number].balanced else 3)
    static, static_of, inner, balanced = list[Surface](), list[int](), list[float](), 0
    for number in still:
        one = posed[number]
        own = _copies(one, ground, where) if one.places else _placed(one, one.at(0.0), ground, where)
        static += own
        static_of += [number] * len(own)
        inner += one.inner_1_m2
        balanced += len(own) if placements[number].balanced else 0
    tracked_of = [number for number, one in enumerate(posed) if one.item.track]
    tracked = [posed[number] for number in tracked_of]
    along = [surface for one in tracked for values in one.stations()
             for surface in _placed(one, values, ground, where)]  # fmt: skip
    highest = max(float(surface.heights_m().max()) for surface in (*files.ground, *static, *along))
    # The light beside many copies is not resolved by finer ground: the budget has its error.
    bodies = [surface for surface in static if surface.instances is None]
    finer, done = refined(files.ground, bodies, along)
    whole = iter(done)
    static = [next(whole) if surface.instances is None else surface for surface in static]
    static = [
        with_texel_per_face(surface) if surface.instances is None and number < balanced else surface
        for number, surface in enumerate(static)
    ]
    near = [surface if surface.on_round_earth else evened(surface) for surface in finer]
    # Nothing cuts tiles, whose faces keep their numbers.
    for number, surface in enumerate(() if any(each.joined for each in near) else near):
        if surface.far:
            near[number] = stitched(surface, near[:number])
            near[:number] = [stitched(each, [near[number]]) for each in near[:number]]
    return Shape(
        frame=files.frame,
        ground=tuple(near),
        static=tuple(static),
        static_of=tuple(static_of),
        tracked=tuple(
            replace(one, surfaces=tuple(refined((), one.surfaces, own_share=TRACKED_SHARE)[1])) for one in tracked
        ),
        tracked_of=tuple(tracked_of),
        highest_m=highest,
        textures=files.textures,
        drapes=files.drapes,
        balanced=balanced,
        inner_1_m2=tuple(inner),
    )


def _placed(one: TrackedObject, values: Mapping[str, float], ground: Ground, where: str) -> list[Surface]:
    """The surfaces of an object in the scene's frame, at `values` as by `TrackedObject.at`."""
    try:
        matrix = one.world_from_own(values, ground)
    except ThermorenderError as error:
        raise ThermorenderError(f"{where}: {error}") from None
    return [replace(surface, vertices=surface.vertices @ matrix[:3, :3].T + matrix[:3, 3]) for surface in one.surfaces]


def _copies(one: TrackedObject, ground: Ground, where: str) -> list[Surface]:
    """The surfaces of copies or crowns: position and heading of the object are added to those of each."""
    assert one.places is not None
    item, row = one.item, one.places
    one_of = "crown" if item.leaf_area_1_m else "copy"
    east, north = row["east_m"] + item.position[0], row["north_m"] + item.position[1]
    height = ground(east, north)
    if not np.isfinite(height).all():
        off = int(np.argmin(np.isfinite(height)))
        mend = f"leave that row out of {item.instances}" if item.instances else "give another position"
        raise ThermorenderError(
            f"{where}: object {item.name!r} has a {one_of} at {east[off]:g} m east, {north[off]:g} m north, where "
            f"there is no terrain; {mend}"
        )
    top = row.get("height_m", max(float(surface.vertices[:, 2].max()) for surface in one.surfaces)) * row["scale"]
    top += row["above_ground_m"] + item.position[2] + one.lift_m
    # Heights in the local frame may be below a roof.
    if "up_m" not in row and (top <= 0.0).any():
        off = int(np.argmax(top <= 0.0))
        key = f"above_ground_m in {item.instances}" if item.instances else "the third number of its position"
        raise ThermorenderError(
            f"{where}: object {item.name!r} has a {one_of} at {east[off]:g} m east, {north[off]:g} m north whose top "
            f"is {-top[off]:g} m below the ground; give {key} in metres above the terrain"
        )
    up = row.get("up_m", height) + row["above_ground_m"] + item.position[2] + one.lift_m
    place = dict(row) | {
        "position": np.column_stack([east, north, up]),
        "yaw_deg": row["yaw_deg"] + item.yaw_deg,
    }
    if item.leaf_area_1_m:
        return [crowns.placed(surface, place, item.leaf_area_1_m, item.leaf_m) for surface in one.surfaces]
    place = {name: place[name] for name in ("position", "yaw_deg", "scale")}
    return [instances.placed(surface, place) for surface in one.surfaces]


def _posed(part: TrackedObject, place: Placement, held: Held) -> TrackedObject:
    """An object where it is placed now, its track without the columns that an edit holds."""
    fixed = held.get(place.name, frozenset())
    columns = {name: values for name, values in part.columns.items() if name not in fixed}
    return replace(part, item=replace(part.item, position=place.position, yaw_deg=place.yaw_deg), columns=columns)
