"""Meshes of a user's surface model: ground, roofs as the model has them, walls below their edges, and porous trees.

Walls, trunks and the places of leaves are inferred: no survey from above sees them.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender import Material
from thermorender.apps.lands.solids import detection
from thermorender.apps.lands.solids.borders import OPEN, Loop, borders
from thermorender.apps.lands.solids.facades import COLOURS, DOOR, GLASS, MATERIALS, Wall, facade, wall_of
from thermorender.apps.lands.solids.plants import Bodies
from thermorender.apps.lands.solids.quads import Quads
from thermorender.apps.lands.solids.roof_steps import cut_at_steps, without_courtyards
from thermorender.apps.lands.solids.textured_mesh import TexturedMesh
from thermorender.apps.lands.solids.trees import plants_of
from thermorender.errors import ThermorenderError
from thermorender.physics.geodesy import LocalFrame
from thermorender.physics.srgb import linear_from_bytes
from thermorender.scene import terrain
from thermorender.scene.mapped_cover import MappedCover
from thermorender.scene.raster import Grid, lon_lat
from thermorender.scene.surface import fill, nearest_valid

GROUND, ROOFS, WALLS, TRUNKS = "ground", "roofs", "walls", "trunks"
INFERRED = (WALLS, TRUNKS)
BARK = "bark"
# Material of roofs where no orthophoto says more.
ROOF = "roof_tile_clay"
_TEXEL_M, _BELOW_M = 0.3, 0.5
# A ground of more posts than this gets fewer where its heights change by no more than these, in the root mean square
# and at most [m]; walls begin deeper.
_MANY_POSTS, _SMOOTH_M, _SMOOTH_MOST_M = 1 << 19, 0.03, 0.25
# Largest distance of posts in which roofs differ from crowns [m].
_FINE_M = 1.2
# Lower steps between roofs of adjoining buildings have no wall [m].
_STEP_M = 0.05
# Roofs are those of posts this far inside the outline; nearer ones are mixed with the street [posts].
_WITHIN = 0.8
# A building stands if this share of its outline is high: of one of 5 by 5 m, drawn 2 m off both ways, (3/5)² is.
# Smaller ones need a single post.
_LEAST_HIGH = 1.0 / 3.0
# Triangles of roofs are larger than this in the plan, in squares of posts.
_LEAST_PLAN = 0.02
# The tallest tree known has 116 m; higher are birds, clouds and errors of a survey [m].
_TALLEST_M = 120.0
_LEAF_COLOUR = (72, 96, 48)


@dataclass(frozen=True, eq=False)
class CityModel:
    """Meshes with their class names, and what was found."""

    meshes: tuple[TexturedMesh, ...]
    classes: dict[int, str]
    frame: LocalFrame
    buildings: int
    flat_outlines: int  # Outlines left out, as less than a third of their posts is of a roof
    trees: int
    stated_walls: int  # Buildings whose outlines declare the material or colour of their walls
    unmatched: dict[str, int]  # Declared materials and colours without a match, with their counts
    plants: dict[tuple[str, str], Bodies] = field(default_factory=dict)  # Crowns, by shape and material
    notes: tuple[str, ...] = ()  # On the files it was made from, one sentence each
    cover: MappedCover | None = None  # What the file of outlines says on materials, too
    found: tuple[detection.Outline, ...] = ()  # Outlines of buildings that no file states


@dataclass(frozen=True)
class Walls:
    """Materials of walls: the usual one, and those by the value of the tag `building`."""

    usual: str
    by_kind: Mapping[str, str] = field(default_factory=dict)


class _Local:
    """Local coordinates of positions on the posts' grid."""

    def __init__(self, grid: Grid, frame: LocalFrame) -> None:
        self.grid, self.frame = grid, frame

    def __call__(self, column: Any, row: Any, height: Any) -> NDArray[np.float64]:
        """Return points (n, 3) of columns and rows at heights above the ellipsoid."""
        x, y = self.grid.to_map(np.asarray(column, np.float64), np.asarray(row, np.float64))
        longitude, latitude = lon_lat(self.grid, np.ravel(x), np.ravel(y))
        level = np.broadcast_to(np.asarray(height, np.float64), longitude.shape)
        place: NDArray[np.float64] = self.frame.enu_from_geodetic(latitude, longitude, level)
        return place


def city_model(
    height: NDArray[np.float64], grid: Grid, post_m: float, ground: NDArray[np.float64] | None,
    known: Sequence[detection.Outline] | None, picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None,
    ground_colour: Sequence[int], walls: Walls, library: Mapping[str, Material], seed: int = 0,
) -> CityModel:  # fmt: skip
    """Return the CityModel of a surface model (h, w) [m above the ellipsoid], NaN where missing. Without `ground`, a
    terrain model on the same grid, or `known` outlines of buildings, both are found from heights. In posts of 1.2 m or
    less, buildings that `known` lacks are found from heights, too. `picture` is an
    orthophoto (rgb, valid, Grid), and `ground_colour` sRGB without one.
    """
    if known is None and post_m > _FINE_M:
        raise ThermorenderError(
            f"the surface model has posts {post_m:.3g} m apart, and buildings are found by height in posts of "
            f"{_FINE_M} m or less; give a finer model (or more max_vertices, if they thin it), or the buildings' "
            "outlines as known"
        )
    green = detection.is_green(*picture, grid) if picture else None
    bare = (detection.ground_below(height, post_m, green) if ground is None
            else detection.ground_given(ground, height, post_m, green))  # fmt: skip
    unstated: list[detection.Outline] = []
    if known is None:
        outlines = detection.outlines_by_height(height, bare, post_m, green)
    else:
        outlines = without_courtyards(known, height, bare, post_m)
        if post_m <= _FINE_M:
            # Maps are incomplete: a roof that nobody has drawn is no tree.
            unstated = detection.outlines_by_height(height, bare, post_m, green, detection.inside(known, grid))
            outlines = [*outlines, *unstated]
    body = detection.inside(outlines, grid)
    frame = terrain.frame_of(bare, grid)
    at, draw = _Local(grid, frame), np.random.default_rng(seed)
    texels = picture[2] if picture else grid
    tree_cells = _dilated(body, max(1, round(1.0 / post_m)))
    crowns = detection.trees_in(height - bare, tree_cells, post_m)
    trees = [tree for tree in crowns if tree.height_m <= _TALLEST_M]
    notes = []
    if len(trees) < len(crowns):
        notes.append(
            f"{len(crowns) - len(trees)} peaks more than {_TALLEST_M:.0f} m above the ground are not trees: left out"
        )
    if unstated:
        notes.append(
            f"{len(unstated)} smooth, high parts outside of all outlines are taken as buildings, with walls of the "
            "usual kind"
        )
    covered = np.isfinite(height) & (height - bare > detection.LEAST_M)
    smooth, apart = _coarser(bare, grid)
    if apart is not grid:
        notes.append(
            f"the ground has posts {post_m * (grid.width - 1) / (apart.width - 1):.2g} m apart, as heights "
            f"between them change by {_SMOOTH_M:g} m or less (RMS)"
        )
    meshes = [_ground(smooth, grid, apart, frame, texels, picture, covered, ground_colour)]
    high = [each for each in outlines if _stands(each, height, bare, post_m)]
    flat = len(outlines) - len(high)
    high, level = cut_at_steps(high, height, bare, post_m)
    roofs, quads, built = _Roofs(grid, texels), Quads(_TEXEL_M), {}
    for index, loops in enumerate(borders(high, height.shape, post_m)):
        if loops:
            built[index] = _raised(loops, level, bare, at, roofs, post_m)
    names = {1: walls.usual, 2: GLASS, 3: DOOR, 4: BARK}
    stated, unmatched = _all_walls(quads, high, built, walls, names, library, draw)
    if roofs.faces:
        meshes.append(roofs.mesh(picture, library[ROOF].colour))
    if len(quads):
        meshes.append(quads.mesh(WALLS))
    plants = plants_of(trees, height, bare, at, post_m, _numbers(names)[BARK], _colours(picture, grid))
    if plants.trunks:
        meshes.append(plants.mesh(TRUNKS))
    buildings = len({high[k].building for k in built})
    found = tuple(each for each in (outlines if known is None else unstated) if _stands(each, height, bare, post_m))
    return CityModel(tuple(meshes), names, frame, buildings, flat, len(trees), stated, unmatched, plants.bodies,
                    tuple(notes), found=found)  # fmt: skip


def _all_walls(
    quads: Quads, high: Sequence[detection.Outline], built: Mapping[int, "_Raised"], walls: Walls,
    names: dict[int, str], library: Mapping[str, Material], draw: np.random.Generator,
) -> tuple[int, dict[str, int]]:  # fmt: skip
    """Add the walls of all buildings, and their materials to `names`; return `stated_walls` and `unmatched`.

    Parts of a building that declare no other walls have one colour, and count once.
    """
    unmatched: dict[tuple[detection.Outline, str], str] = {}
    tints: dict[tuple[detection.Outline, Wall], NDArray[Any]] = {}
    stated = set()
    tops = {index: body.top_by_place() for index, body in built.items()}
    for index, raised in built.items():
        wall, without = wall_of(high[index].tags, walls.by_kind, walls.usual, library)
        building = high[index].building
        unmatched.update({(building, each): each for each in without})
        if _declared(high[index].tags) > len(without):
            stated.add(building)
        if wall.material not in names.values():
            names[len(names) + 1] = wall.material
        if (building, wall) not in tints:
            tint = linear_from_bytes(np.array(wall.colour or library[wall.material].colour, np.uint8))
            tints[building, wall] = tint if wall.colour else tint * np.exp(draw.normal(0.0, 0.12))
        paint = {"value": _numbers(names).__getitem__, "draw": draw, "material": wall.material,
                 "colour": tints[building, wall]}  # fmt: skip
        for loop, base, top in raised.parts():
            _walls(quads, loop, base, top, tops, paint)
    counts = Counter(unmatched.values())
    kinds = {each.tags.get("building") for each in high}
    counts.update({f"building={kind} of wall": 0 for kind in walls.by_kind if kind not in kinds})
    return len(stated), dict(counts)


def _numbers(names: dict[int, str]) -> dict[str, int]:
    """Class numbers by material; the first of several."""
    return {name: value for value, name in reversed(names.items())}


def _declared(tags: Mapping[str, str]) -> int:
    """Number of tags that declare the material or the colour of walls."""
    return sum(key in tags for key in (*MATERIALS, *COLOURS))


def _dilated(mask: NDArray[np.bool_], posts: int) -> NDArray[np.bool_]:
    from scipy.ndimage import binary_dilation

    grown: NDArray[np.bool_] = binary_dilation(mask, np.ones((3, 3)), iterations=posts)
    return grown


def _colours(
    picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, grid: Grid
) -> Callable[[NDArray[np.int64]], NDArray[np.float32]]:
    """A function of posts (n, 2) that returns the linear colour of their crowns, (n, 3)."""
    if picture is None:
        green = linear_from_bytes(np.array(_LEAF_COLOUR, np.uint8))
        return lambda posts: np.broadcast_to(green, (len(posts), 3))
    rgb, _, texels = picture
    light = linear_from_bytes(rgb)

    def at(posts: NDArray[np.int64]) -> NDArray[np.float32]:
        column, row = texels.to_pixel(*grid.to_map(posts[:, 1] + 0.5, posts[:, 0] + 0.5))
        inside = [np.clip(np.floor(v).astype(int), 0, n - 1) for v, n in ((row, len(rgb)), (column, rgb.shape[1]))]
        return light[inside[0], inside[1]]

    return at


def _coarser(bare: NDArray[np.float64], grid: Grid) -> tuple[NDArray[np.float64], Grid]:
    """(Heights of a ground of many posts, their Grid), with posts two to four times as far apart where heights are
    nearly linear between; outermost posts stay."""
    from scipy.interpolate import RectBivariateSpline

    if bare.size <= _MANY_POSTS or min(bare.shape) < 3 or not np.isfinite(bare).all():
        return bare, grid
    every = [np.arange(count, dtype=np.float64) for count in bare.shape]
    heights = RectBivariateSpline(*every, bare, kx=1, ky=1)
    for step in (4, 3, 2):
        some = [np.linspace(0.0, each[-1], int(np.ceil(each[-1] / step)) + 1) for each in every]
        coarse = heights(*some)
        off = RectBivariateSpline(*some, coarse, kx=1, ky=1)(*every) - bare
        if np.sqrt(np.mean(off**2)) <= _SMOOTH_M and np.abs(off).max() <= _SMOOTH_MOST_M:
            # The middle of the first pixel stays.
            t, down, across = grid.transform, some[0][1], some[1][1]
            x, y = grid.to_map(0.5 - 0.5 * across, 0.5 - 0.5 * down)
            to_map = type(t)(t.a * across, t.b * down, x, t.d * across, t.e * down, y)
            return coarse, replace(grid, transform=to_map, height=coarse.shape[0], width=coarse.shape[1])
    return bare, grid


def _ground(
    bare: NDArray[np.float64], grid: Grid, apart: Grid, frame: LocalFrame, texels: Grid,
    picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, covered: NDArray[np.bool_],
    plain: Sequence[int],
) -> TexturedMesh:  # fmt: skip
    """The terrain below all objects, with posts of the grid `apart`; what they hide, on `grid`, has the colour of the
    nearest open ground."""
    from thermorender.scene.raster import onto

    vertices, faces, uv = terrain.mesh(bare, apart, frame, texels)
    # Posts beyond the last texel would repeat the texture.
    uv, shape = np.clip(uv, 0.0, 1.0), (texels.height, texels.width)
    colour = np.broadcast_to(np.array(plain, np.uint8), (*shape, 3))
    if picture is not None:
        open_ground = picture[1] & (onto(covered.astype(np.float32), grid, texels, "nearest") != 1.0)
        colour = fill(picture[0], nearest_valid(open_ground)) if open_ground.any() else picture[0]
    return TexturedMesh(GROUND, vertices, faces.astype(np.int64), uv, colour, np.zeros(shape, np.uint8))


class _Roofs:
    """Roofs under construction: triangles between posts, mapped by the texels' grid."""

    def __init__(self, grid: Grid, texels: Grid) -> None:
        self.grid, self.texels = grid, texels
        self._parts: list[tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]] = []
        self.faces = 0

    def add(self, pixel: NDArray[np.float64], point: NDArray[np.float64], faces: NDArray[np.int64]) -> None:
        """Add triangles between points (n, 3), whose (column, row) on the posts' grid are `pixel`."""
        column, row = self.texels.to_pixel(*self.grid.to_map(*pixel.T))
        uv = np.column_stack([column / self.texels.width, row / self.texels.height])
        self._parts.append((point, faces, np.clip(uv, 0.0, 1.0)))
        self.faces += len(faces)

    def mesh(
        self, picture: tuple[NDArray[np.uint8], NDArray[np.bool_], Grid] | None, plain: Sequence[int]
    ) -> TexturedMesh:
        """Return all roofs as one TexturedMesh, with the orthophoto or a plain colour."""
        shape = self.texels.height, self.texels.width
        colour = np.broadcast_to(np.array(plain, np.uint8), (*shape, 3)) if picture is None else picture[0]
        first = np.cumsum([0, *(len(part[0]) for part in self._parts)])
        faces = np.concatenate([part[1] + start for part, start in zip(self._parts, first, strict=False)])
        uv = np.concatenate([part[2] for part in self._parts])[faces].astype(np.float32)
        return TexturedMesh(ROOFS, np.concatenate([part[0] for part in self._parts]), faces, uv, colour,
                    np.zeros(shape, np.uint8))  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Raised:
    """Borders of a building with their local points at the eaves and at the foot of the walls, (n, 3) each."""

    loops: Sequence[Loop]
    base: NDArray[np.float64]
    top: NDArray[np.float64]

    def parts(self) -> Iterator[tuple[Loop, NDArray[np.float64], NDArray[np.float64]]]:
        """Yield (loop, base, top) of each loop."""
        ends = np.cumsum([len(each.point) for each in self.loops])[:-1]
        yield from zip(self.loops, np.split(self.base, ends), np.split(self.top, ends), strict=True)

    def top_by_place(self) -> dict[tuple[float, float], float]:
        """Height of the eaves at each point of the borders."""
        point = np.concatenate([each.point for each in self.loops])
        return {_place(each): float(up) for each, up in zip(point, self.top[:, 2], strict=True)}


def _place(point: NDArray[np.float64]) -> tuple[float, float]:
    return float(point[0]), float(point[1])


def _stands(outline: detection.Outline, height: NDArray[np.float64], bare: NDArray[np.float64], post_m: float) -> bool:
    """Whether enough of an outline is high; a tree over a building that is gone, or underground, is not."""
    _, inside, roof = _posts_inside(outline.rings, height, bare)
    least = _LEAST_HIGH if inside.sum() * post_m**2 >= detection.LEAST_AREA_M2 else 0.0
    return bool(roof.sum() > least * inside.sum())


def _posts_inside(
    rings: Sequence[detection.Ring], height: NDArray[np.float64], bare: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_], NDArray[np.bool_]]:
    """(posts (n, 2) as (column, row) around rings, which are inside and known, which of these are of a roof)."""
    rows, columns = height.shape
    corner = np.concatenate(list(rings))
    low, high = np.floor(corner.min(axis=0)).astype(int), np.ceil(corner.max(axis=0)).astype(int)
    column, row = np.meshgrid(np.arange(max(low[0], 0), min(high[0], columns)),
                              np.arange(max(low[1], 0), min(high[1], rows)))  # fmt: skip
    post = np.column_stack([column.ravel(), row.ravel()])
    level, ground = height[post[:, 1], post[:, 0]], bare[post[:, 1], post[:, 0]]
    inside = detection.even_odd(post + 0.5, rings) & np.isfinite(level)
    return post, inside, inside & (level - ground > detection.LEAST_M)


def _raised(
    loops: Sequence[Loop], height: NDArray[np.float64], bare: NDArray[np.float64], at: _Local, roofs: _Roofs,
    post_m: float,
) -> _Raised:  # fmt: skip
    """Add the roof within the borders of a building, and return their eaves."""
    from scipy.ndimage import median_filter
    from scipy.spatial import Delaunay, cKDTree

    rings = [each.point for each in loops]
    edge = np.concatenate(rings)
    post, _, roof = _posts_inside(rings, height, bare)
    if not roof.any():
        # Smaller buildings have all posts.
        post, roof = _nearest_post(edge, height, bare)
    middle, level = post + 0.5, height[post[:, 1], post[:, 0]]
    inner = roof & (cKDTree(edge).query(middle)[0] > _WITHIN)
    # A building narrower than two posts has no other than mixed ones.
    inner = inner if inner.any() else roof
    nearest = cKDTree(middle[inner]).query(edge)[1]
    # A median along each ring leaves corners of gables and no single peaks.
    borders_of = np.cumsum([len(each) for each in rings])[:-1]
    top = np.concatenate([median_filter(each, 5, mode="wrap") for each in np.split(level[inner][nearest], borders_of)])
    foot = np.nanmin(bare[post[:, 1], post[:, 0]])
    pixel = np.concatenate([edge, middle[inner]])
    point = at(pixel[:, 0], pixel[:, 1], np.concatenate([top, level[inner]]))
    triangle = Delaunay(pixel, qhull_options="QJ").simplices.astype(np.int64)
    triangle = triangle[detection.even_odd(pixel[triangle].mean(axis=1), rings)]
    across = np.cross(point[triangle[:, 1]] - point[triangle[:, 0]], point[triangle[:, 2]] - point[triangle[:, 0]])
    triangle[across[:, 2] < 0.0] = triangle[across[:, 2] < 0.0][:, ::-1]
    # Three points of one side of the outline are a triangle in its wall.
    roofs.add(pixel, point, triangle[np.abs(across[:, 2]) > _LEAST_PLAN * post_m**2])
    return _Raised(loops, at(edge[:, 0], edge[:, 1], foot - _BELOW_M), point[: len(edge)])


def _nearest_post(
    edge: NDArray[np.float64], height: NDArray[np.float64], bare: NDArray[np.float64]
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The post of a roof that is nearest to a border, as `_posts_inside` returns posts."""
    row, column = np.nonzero(np.isfinite(height) & (height - bare > detection.LEAST_M))
    k = int(np.argmin(((np.column_stack([column, row]) + 0.5 - edge.mean(axis=0)) ** 2).sum(axis=1)))
    return np.array([[column[k], row[k]]]), np.array([True])


def _walls(
    quads: Quads, loop: Loop, base: NDArray[np.float64], top: NDArray[np.float64],
    tops: Mapping[int, Mapping[tuple[float, float], float]], paint: dict[str, Any],
) -> None:  # fmt: skip
    """Add the walls below a border; windows run along each side of an outline.

    Where another building adjoins, the wall begins at its eaves: below them nobody sees it.
    """
    count = len(loop.point)
    eaves = top[:, 2] - base[:, 2] - _BELOW_M
    lowest: dict[int, float] = {}
    for first, side in enumerate(loop.side.tolist()):
        lowest[side] = min(lowest.get(side, np.inf), eaves[first], eaves[(first + 1) % count])
    for first in range(count):
        second = (first + 1) % count
        length = float(np.linalg.norm(base[second, :2] - base[first, :2]))
        share = abs(float(loop.along[first, 1] - loop.along[first, 0]))
        if length < 1e-3:
            continue
        other = tops.get(int(loop.beyond[first])) if loop.beyond[first] != OPEN else None
        wide = length / max(share, 1e-9)
        if other is None:
            tall = float(max(eaves[first], eaves[second]))
            if tall > 0.0:
                shade = facade(**paint, wide_m=wide, high_m=tall, below_m=_BELOW_M, part=tuple(loop.along[first]),
                               storeys_m=lowest[int(loop.side[first])])  # fmt: skip
                quads.add([base[first], base[second], top[second], top[first]], shade)
            continue
        low = [other.get(_place(loop.point[k]), float(base[k, 2])) for k in (first, second)]
        above = [float(top[k, 2]) - level for k, level in zip((first, second), low, strict=True)]
        if max(above) > _STEP_M:
            shade = facade(**paint, wide_m=wide, high_m=max(above), part=tuple(loop.along[first]))
            quads.add(_step(top[first], top[second], *low), shade)


def _step(
    a: NDArray[np.float64], b: NDArray[np.float64], low_a: float, low_b: float
) -> list[NDArray[np.float64]]:  # fmt: skip
    """Corners of the wall between eaves a–b and lower ones; a triangle where they cross."""
    foot_a, foot_b = np.append(a[:2], low_a), np.append(b[:2], low_b)
    over_a, over_b = a[2] - low_a, b[2] - low_b
    if min(over_a, over_b) < 0.0:
        crossing = a + (b - a) * over_a / (over_a - over_b)
        if over_a < 0.0:
            a = foot_a = crossing
        else:
            b = foot_b = crossing
    return [foot_a, foot_b, b, a]
