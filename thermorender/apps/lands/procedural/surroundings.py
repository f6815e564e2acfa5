"""The land around a square, out to the horizon: a ring of cells that grow with distance.

The ring begins with the posts of the square's ground and with its mirror image; farther out a layout paints the
country. Its outer edge is higher than any flight, so that no view below the horizon passes over it.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.lands.procedural.canvas import Canvas, Painting
from thermorender.apps.lands.procedural.light import linear
from thermorender.apps.lands.procedural.noise import Values, smoothstep
from thermorender.apps.lands.solids.textured_mesh import TexturedMesh
from thermorender.physics.srgb import bytes_from_linear

SURROUNDINGS = "surroundings"
# Cells around the square, a multiple of 4; growth from one cell to the next farther one.
_SECTORS, _GROWTH = 192, 1.1
# Texels of a cell, towards the horizon and along it.
_ROWS, _COLUMNS = 6, 8
# Distance from the square's edge at which woods may begin [m]: closer by they would look like blocks.
_OPEN_M = 90.0
# Side of the lattice of noise, which repeats beyond it.
_LATTICE = 1024
# Side of the cells in which the mirror image is averaged [m].
_MIRROR_M = 2.0
# Roads wind by this much within this length [m].
_BEND_M, _WINDING_M = 30.0, 1100.0
# Width of the verges of roads in woods [m].
_VERGE_M = 2.5
# How far walls of woods lean back, per height. Upright ones point to the middle: rays from there would lie in them,
# and miss them.
_LEAN = 0.2

# A corner of a quadrilateral relative to its cell: ring and sector, 1 on top of the wood, row and column of the texel.
_Corner = tuple[float, float, float, float, float]


class Surroundings(Painting):
    """The surroundings of a canvas under construction, (rows, columns): row 0 at the square's edge, columns
    counter-clockwise along it from the south-west corner.
    """

    def __init__(self, canvas: Canvas, post: NDArray[np.float64], reach_m: float, skyline_m: float) -> None:
        """`post` (K + 1, K + 1) are the heights of the square's ground [m], row 0 in the north. The ring reaches to
        `reach_m` from the middle or farther, where it is at least as high as `skyline_m`.
        """
        half = 0.5 * canvas.size
        self.reach = max(reach_m, 3.0 * half)  # From the middle to the nearest points of the outer edge [m]
        count = int(np.ceil(np.log(self.reach / half) / np.log(_GROWTH)))
        super().__init__(canvas.seed, (_ROWS * count, _COLUMNS * _SECTORS), canvas.names)
        self._canvas, self._post = canvas, post
        # Side of the square, and the least height of the outer edge [m].
        self.size, self.skyline = canvas.size, skyline_m
        self._sides = half * np.geomspace(1.0, self.reach / half, count + 1)  # Half sides of the borders of cells [m]
        side = np.interp((np.arange(self.shape[0]) + 0.5) / _ROWS, np.arange(count + 1), self._sides)[:, None]
        # Texel centres relative to the middle of the square [m].
        plan = _around((np.arange(self.shape[1]) + 0.5) / self.shape[1])
        self.east, self.north = (np.asarray(side * axis, np.float32) for axis in plan)
        outside = [np.maximum(np.abs(axis) - np.float32(half), 0.0) for axis in (self.east, self.north)]
        self.away = np.hypot(*outside)  # Distance from the square's edge [m]
        # Sides of a texel along the horizon and on average [m], (rows, 1).
        self.across = (8.0 * side / self.shape[1]).astype(np.float32)
        self.texel = np.sqrt(self.across * np.gradient(side[:, 0])[:, None]).astype(np.float32)
        self.ground[...] = self._seen(post.astype(np.float32), np.arange(2) * canvas.size / (len(post) - 1))
        for channel in range(3):
            self.albedo[..., channel] = self.mirrored(canvas.albedo[..., channel])
        self.material[...] = self.mirrored(canvas.material)
        self._clear = np.zeros(self.shape, bool)  # Roads and their verges, on which no wood grows
        self._wooded = np.zeros((count, _SECTORS), bool)  # Cells that a wood covers
        self._canopy = np.zeros((count + 1, _SECTORS), np.float32)  # Its height at their corners [m]

    def mirrored(self, field: Values) -> Values:
        """Return a field of the canvas, (N, N), continued as in mirrors along its edges. Class values are those at the
        middle of a texel, other values means over cells of 2 m or more.
        """
        import cv2

        if field.dtype != np.uint8:
            count = max(1, round(self.size / max(_MIRROR_M, self._canvas.texel)))
            field = cv2.resize(field, (count, count), interpolation=cv2.INTER_AREA)
        step = self.size / len(field)
        return self._seen(field, np.array([0.5, 1.5]) * step)

    def _seen(self, field: Values, first: NDArray[np.float64]) -> Any:
        """A field whose first two columns are `first` [m] from the square's western edge, in mirrors."""
        import cv2

        half, step = 0.5 * self.size, first[1] - first[0]
        column, row = ((axis + half - first[0]) / step for axis in (self.east, -self.north))
        border = cv2.BORDER_REFLECT if first[0] else cv2.BORDER_REFLECT_101
        how = cv2.INTER_NEAREST if field.dtype == np.uint8 else cv2.INTER_LINEAR
        return cv2.remap(field, column.astype(np.float32), row.astype(np.float32), how, borderMode=border)

    def fractal(self, name: str, wavelength_m: float, octaves: int = 5, gain: float = 0.5) -> NDArray[np.float32]:
        """Return fractal noise as `Canvas.fractal`, without the octaves that texels average out."""
        import cv2

        generator, total = self.stream(f"far {name}"), np.zeros(self.shape, np.float32)
        power, amplitude = 0.0, 1.0
        for _ in range(octaves):
            side = min(_LATTICE, int(np.ceil(6.0 * self.reach / wavelength_m)) + 6)
            lattice = generator.standard_normal((side, side), dtype=np.float32)
            turn = generator.uniform(0.0, 2.0 * np.pi)
            c, s = 2.0 * np.cos(turn) / wavelength_m, 2.0 * np.sin(turn) / wavelength_m
            x, y = c * self.east - s * self.north, s * self.east + c * self.north
            x, y = (np.mod(each, side).astype(np.float32) for each in (x, y))
            found = cv2.remap(lattice, x, y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_WRAP)
            kept = smoothstep(1.0, 3.0, wavelength_m / self.texel)
            # Cubic interpolation of white noise keeps 0.80 of its standard deviation.
            total += np.float32(amplitude / 0.80) * kept * found
            power += amplitude**2
            amplitude *= gain
            wavelength_m *= 0.5
        return total / np.float32(np.sqrt(power))

    def beyond(self, width_m: float) -> Values:
        """Return the share of the country in the picture: 0 at the square's edge, 1 from about `width_m` on."""
        ragged = np.exp(0.5 * self.fractal("edge", 60.0, 4))
        return smoothstep(0.0, 1.0, self.away * ragged / width_m)

    def hills(self, rolling_m: float, wavelength_m: float) -> None:
        """Shape the ground: the mirror image, then rolling land, and hills on the horizon."""
        rolling = rolling_m * self.fractal("rolling", wavelength_m, 4, 0.45)
        level = float(np.median(self._post))
        whole = np.maximum(np.abs(self.east), np.abs(self.north)) / self.reach
        rise = self.skyline - level
        crest = smoothstep(0.35, 0.95, whole) * rise * (1.12 + 0.10 * self.fractal("hills", 0.5 * self.reach, 3, 0.4))
        share = smoothstep(0.0, 300.0, self.away)
        self.ground += share * (level + rolling - self.ground) + crest

    def woods(
        self, dense: Values, height_m: float, colours: Sequence[tuple[int, int, int]], material: str
    ) -> None:  # fmt: skip
        """Raise closed woods of a height, with a mix of sRGB colours, where `dense` is above 0 in most of a cell."""
        import cv2

        open_land = self._clear | (self.away * np.exp(0.3 * self.fractal("open", 90.0, 3)) < _OPEN_M)
        grown = (dense > 0.0) & ~open_land
        cells, _ = self._wooded.shape
        share = grown.reshape(cells, _ROWS, _SECTORS, _COLUMNS).mean(axis=(1, 3), dtype=np.float32)
        # The cells around decide with each: single cells, and single gaps, would be blocks.
        around = cv2.blur(_wrapped(share, 1), (3, 3))[:, 1:-1]
        # The innermost cells are those that join the posts of the square.
        self._wooded = (around > 0.5) & (share > 0.1) & (np.arange(cells)[:, None] > 0)
        stand = self.fractal("stands", 160.0, 5)
        rough = self.stream("far crowns").standard_normal(self._canopy.shape)
        self._canopy = (height_m * np.exp(0.08 * self._at_corners(stand) + 0.10 * rough)).astype(np.float32)
        mix = smoothstep(-1.0, 1.0, stand)[..., None]
        tone = linear(*colours[0]) + mix * (linear(*colours[1]) - linear(*colours[0]))
        shade = np.exp(0.22 * self.fractal("crown tone", 7.0, 3, 0.7) + 0.08 * self.fractal("clumps", 40.0, 3))
        wooded = np.repeat(np.repeat(self._wooded, _ROWS, axis=0), _COLUMNS, axis=1)
        self.paint(wooded * 1.0, 0.8 * tone * shade[..., None], material)

    def _at_corners(self, field: Values) -> Values:
        """Means of the texels around the corners of cells, (count + 1, sectors)."""
        rows = len(field)
        strip = _wrapped(field, _COLUMNS // 2).reshape(rows, _SECTORS + 1, _COLUMNS)
        along = strip.mean(axis=2)[:, :_SECTORS]
        outer = np.arange(0, rows + 1, _ROWS)
        return 0.5 * (along[np.maximum(outer - 1, 0)] + along[np.minimum(outer, rows - 1)])

    def plots(self, name: str, long_m: float, wide_m: float) -> tuple[NDArray[np.int64], Values]:
        """Return (number of the plot of land of each texel, distance to its border [m]); sizes are means [m]."""
        from scipy.spatial import KDTree

        g = self.stream(f"far {name}")
        turn = g.uniform(0.0, np.pi)
        bend = 0.25 * wide_m * self.fractal(f"{name} bend", 5.0 * wide_m, 2)
        u = (self.east * np.cos(turn) + self.north * np.sin(turn)) / long_m
        v = (self.north * np.cos(turn) - self.east * np.sin(turn) + bend) / wide_m
        low = np.floor([u.min(), v.min()]) - 1.0
        size = np.ceil([u.max(), v.max()]) + 2.0 - low
        seeds = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), -1).reshape(-1, 2) + low
        seeds += g.uniform(-0.35, 0.35, seeds.shape)
        near, number = KDTree(seeds).query(np.stack([u, v], -1), k=2)
        return number[..., 0], 0.5 * wide_m * (near[..., 1] - near[..., 0]).astype(np.float32)

    def continue_roads(self) -> None:
        """Paint the roads that leave the square, on to the horizon."""
        for number, road in enumerate(self._canvas.roads):
            for points in (road.points, road.points[::-1]):
                inside = np.flatnonzero((np.abs(points) < 0.5 * self.size).all(axis=1))
                if not len(inside) or inside[-1] + 1 >= len(points):
                    continue
                start, before = points[inside[-1]], points[max(inside[-1] - 3, 0)]
                ahead = (start - before) / np.linalg.norm(start - before)
                x, y = self.east - np.float32(start[0]), self.north - np.float32(start[1])
                along, off = x * ahead[0] + y * ahead[1], x * ahead[1] - y * ahead[0]
                bend = _BEND_M * (1.0 - np.cos(2.0 * np.pi * along / _WINDING_M)) * (-1.0) ** number
                # Part of a texel's width that the road covers.
                cover = np.clip((road.half_m + 0.5 * self.across - np.abs(off - bend)) / self.across, 0.0, 1.0)
                cover = np.minimum(cover, 2.0 * road.half_m / self.across) * (along > 0.0)
                self.paint(cover, road.colour, road.material)
                self._clear |= (np.abs(off - bend) < road.half_m + _VERGE_M) & (along > 0.0)

    def mesh(self) -> TexturedMesh:
        """Return the ring as a TexturedMesh."""
        count = len(self._sides) - 1
        height = self._at_corners(self.surface)[1:].astype(np.float64)
        height[-1] = np.maximum(height[-1], self.skyline)
        t = np.arange(_SECTORS) / _SECTORS
        plan = np.stack([self._sides[1:, None] * axis for axis in _around(t)], axis=-1)
        edge, s = self._edge()
        raised = height + self._canopy[1:]
        levels = ((plan, height), (plan + self._lean(plan), raised))
        rings = [np.concatenate([at, up[..., None]], axis=-1).reshape(-1, 3) for at, up in levels]
        # The innermost cells join the posts of the square.
        line, ring = np.append(s, 1.0), np.append(t, 1.0)
        zipped = _zipped(line, ring, len(line))
        number = np.concatenate([np.arange(len(line)) % len(s), len(s) + np.arange(_SECTORS + 1) % _SECTORS])
        place = np.concatenate([
            np.stack([line, 0.0 * line], axis=-1), np.stack([ring, 0.0 * ring + 1.0 / count], axis=-1)
        ])  # fmt: skip
        faces, uv = [number[zipped]], [place[zipped]]

        def quads(chosen: NDArray[np.bool_], corners: list[_Corner]) -> None:
            """Add a quadrilateral for each of the `chosen` cells (count, sectors) outside the innermost ones."""
            k, j = np.nonzero(chosen)
            k, j = k[k > 0, None], j[k > 0, None]
            ring, sector, top, row, column = np.array(corners).T
            vertex = len(s) + (k + ring - 1 + top * count) * _SECTORS + (j + sector) % _SECTORS
            at = np.stack([(j + column / _COLUMNS) / _SECTORS, (k + row / _ROWS) / count], axis=-1)
            for three in ([0, 1, 2], [0, 2, 3]):
                faces.append(vertex.astype(np.int64)[:, three])
                uv.append(at[:, three])

        wooded, r, c = self._wooded, _ROWS, _COLUMNS
        for top, chosen in ((0, ~wooded), (1, wooded)):
            quads(chosen, [(1, 0, top, r, 0), (1, 1, top, r, c), (0, 1, top, 0, c), (0, 0, top, 0, 0)])
        # Walls of the woods, towards the square, the horizon and both sides, show the texels beside them.
        low, high = 0.5, 1.5
        before, after = (np.roll(wooded, step, axis=1) for step in (1, -1))
        inner, outer = np.pad(wooded[:-1], ((1, 0), (0, 0))), np.pad(wooded[1:], ((0, 1), (0, 0)))
        quads(wooded & ~inner, [(0, 1, 0, low, c), (0, 0, 0, low, 0), (0, 0, 1, high, 0), (0, 1, 1, high, c)])
        below, above = r - low, r - high
        quads(wooded & ~outer, [(1, 0, 0, below, 0), (1, 1, 0, below, c), (1, 1, 1, above, c), (1, 0, 1, above, 0)])
        quads(wooded & ~before, [(0, 0, 0, 0, low), (1, 0, 0, r, low), (1, 0, 1, r, high), (0, 0, 1, 0, high)])
        below, above = c - low, c - high
        quads(wooded & ~after, [(1, 1, 0, r, below), (0, 1, 0, 0, below), (0, 1, 1, 0, above), (1, 1, 1, r, above)])
        colour = bytes_from_linear(np.clip(self.albedo, 0.0, 1.0))
        return TexturedMesh(
            SURROUNDINGS, np.concatenate([edge, *rings]), np.concatenate(faces),
            np.concatenate(uv).astype(np.float32), colour, self.material,
        )  # fmt: skip

    def _lean(self, plan: NDArray[np.float64]) -> NDArray[np.float64]:
        """Steps into the wood of the canopy's corners at `plan`, (count, sectors, 2) [m]; 0 within woods, and
        where two woods touch.
        """
        inner = np.concatenate([self._sides[0] / self._sides[1] * plan[:1], plan[:-1]])
        both = inner + plan
        middle = 0.25 * (both + np.roll(both, -1, axis=1))
        # The cells at both sides of a corner, nearer and farther; the last corners have nearer ones alone.
        far = np.minimum(np.arange(len(plan)) + 1, len(plan) - 1)
        nearer = ((self._wooded, middle), (np.roll(self._wooded, 1, axis=1), np.roll(middle, 1, axis=1)))
        cells = [each for wooded, at in nearer for each in ((wooded, at), (wooded[far], at[far]))]
        step = np.sum([wooded[..., None] * (at - plan) for wooded, at in cells], axis=0)
        a, b, c, d = (wooded for wooded, _ in cells)
        step[(a == d) & (b == c)] = 0.0
        length = np.linalg.norm(step, axis=-1, keepdims=True)
        return _LEAN * self._canopy[1:, :, None] * step / np.maximum(length, 1e-9)

    def _edge(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """(Posts along the edge of the square's ground (n, 3) [m], their places 0…1 along it)."""
        k = len(self._post) - 1
        t = np.arange(4 * k) / (4.0 * k)
        up = np.concatenate([
            self._post[-1, :-1], self._post[:0:-1, -1], self._post[0, :0:-1], self._post[:-1, 0],
        ])  # fmt: skip
        east, north = (0.5 * self.size * axis for axis in _around(t))
        return np.stack([east, north, up], axis=-1), t

    def slope(self) -> Values:
        """Return the slope of the surface, rise over run."""
        up = self.normals()[2]
        return np.sqrt(np.maximum(1.0 - up**2, 0.0)) / up

    def normals(self) -> NDArray[np.float32]:
        """Return unit normals of the texels (3, rows, columns), smooth over a cell."""
        import cv2

        wide = (_wrapped(each, 2 * _COLUMNS) for each in (self.east, self.north, self.surface))
        # All three coordinates are smoothed alike, so that a plane stays one.
        place = [cv2.blur(each, (_COLUMNS + 1, 2 * _ROWS + 1)) for each in wide]
        outward, along = (np.stack([np.gradient(each, axis=axis) for each in place]) for axis in (0, 1))
        normal = np.cross(outward, along, axis=0)[:, :, 2 * _COLUMNS : -2 * _COLUMNS]
        return (normal / np.linalg.norm(normal, axis=0)).astype(np.float32)


def _around(t: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(east, north) on the edge of a square of half side 1, counter-clockwise from the south-west corner at t = 0."""
    corner = np.arange(5) / 4.0
    return np.interp(t, corner, [-1, 1, 1, -1, -1]), np.interp(t, corner, [-1, -1, 1, 1, -1])


def _wrapped(field: Values, columns: int) -> Values:
    """A field continued by some columns at both ends, which adjoin."""
    return np.concatenate([field[:, -columns:], field, field[:, :columns]], axis=1)


def _zipped(inner: NDArray[np.float64], outer: NDArray[np.float64], first: int) -> NDArray[np.int64]:
    """Triangles (n, 3) between two lines of points at increasing places 0…1; numbers of the outer ones begin at
    `first`.
    """
    # Each edge of the inner line goes with the nearest outer point, and the outer edges fill the gaps.
    nearest = np.clip(np.round(0.5 * (inner[:-1] + inner[1:]) * (len(outer) - 1)), 0, len(outer) - 1).astype(np.int64)
    i = np.arange(len(inner) - 1)
    inside = np.stack([first + nearest, i + 1, i], axis=-1)
    j = np.arange(len(outer) - 1)
    # The inner point after all edges that go with the outer point j.
    apex = np.searchsorted(nearest, j, side="right")
    outside = np.stack([first + j, first + j + 1, apex], axis=-1)
    return np.concatenate([inside, outside])
