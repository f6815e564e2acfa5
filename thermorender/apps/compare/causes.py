"""Causes of a method's error: the set that best explains it, from the added fits of all poses.

Offset, contrast, shift, blur, zoom and materials have one size in all poses. An offset that changes from pose to pose
is removed before they are fitted, and is a cause itself. Frames are clipped if the reference, clipped at one
temperature, explains them so much better.

The score of a set is log(mean square residual) + p · number of causes; the lowest wins. So each cause must reduce the
remaining square error by a factor of exp(p). Its size must also differ from zero significantly, with standard errors
from the scatter between pieces of ground (Liang & Zeger 1986, doi:10.1093/biomet/73.1.13). `python -m
validation.referee` calibrates both limits to the rate of false detections.
"""

import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import chain, combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare import emissivities
from thermorender.apps.compare.pose_fit import BASE, WIDTH, Free, Pair, PoseFit, fit, zoom_of
from thermorender.apps.compare.registration import ALIKE
from thermorender.apps.compare.view import View, evenly
from thermorender.scene.scene import Scene

# A cause explains at least this share of the square error that is left without it, and its size differs from zero at
# this level of significance, divided by the number of causes tested.
SHARE, LEVEL = 2.0 / 3.0, 0.01
# Errors below this are sampling noise of the renders [K].
_FLOOR_K = 0.02
# Least sizes that are reported: offset [K], gain, shift [px], standard deviation of the blur [px], zoom, offset of a
# material [K], emissivity, standard deviation of the offsets of poses [K].
LEAST = {"offset": 0.1, "contrast": 0.03, "shift": 0.25, "blur": 0.5, "zoom": 0.002, "material": 0.3,
         "emissivity": 0.015, "drift": 0.1}  # fmt: skip
# Shares of a pose's ground that a clipped picture may show, and most pixels that are tried.
_CLIPPED, _TRIED = np.geomspace(0.005, 0.5, 24), 8000
# If the emissivity would leave 0…1 by more than this, the error has another cause.
_BEYOND = 0.02
# An emissivity fitted beside an offset on the material differs from that fitted alone by less than this many standard
# errors, or by less than this share of it: the sky's occlusion and the air are not in the model.
_APART, _APART_SHARE = 2.0, 0.25
# Most materials that are named.
_MOST_MATERIALS = 3
# Largest number of poses that are fitted per scene and in total; each scene gets at least one.
_POSES, _ALL = 4, 12
# Pieces of ground along a picture's larger side.
_PIECES = 7
# Largest distance to another material at which a pixel may show both [px].
_MOST_REACH_PX = 30

# A cause: ("offset" | "contrast" | "shift" | "blur" | "zoom", "") or ("material" | "emissivity", name).
Cause = tuple[str, str]


@dataclass(frozen=True)
class Named:
    """A cause that explains more than its rivals."""

    cause: Cause  # (2,) tuple kind, and the material or ""
    # size, error: (n,) tuple size and standard error: kelvin; gain minus 1; pixels right and down; variance [px²];
    # emissivity
    size: tuple[float, ...]
    error: tuple[float, ...]
    share: float  # Share of the square error left without it that it explains


@dataclass(frozen=True)
class Clipped:
    """A pose's fit to the reference clipped at a temperature, as a method with a limited range shows it."""

    fit: PoseFit
    level_k: float  # Temperature of the method's picture at which it is clipped [K]
    share: float  # Share of the ground beyond


@dataclass
class Causes:
    """Fits of a method's poses, and the true band emissivity of each material."""

    fits: list[PoseFit] = field(default_factory=list)
    # For each fit the same to a clipped reference, by +1 for a highest and −1 for a lowest temperature, where better
    clipped: list[dict[int, Clipped]] = field(default_factory=list)
    emissivity: dict[str, float] = field(default_factory=dict)
    share: float = SHARE  # As `SHARE`
    level: float = LEVEL  # As `LEVEL`

    def summary(self, said: Callable[[Named, float], bool] = lambda *_: True) -> dict[str, Any] | None:
        """Return the causes as plain values, None without fits.

        `said` (cause, share of the square error about the offset that the causes leave) refuses those not to be named.

        {"fit": values and errors with all base causes, "named": list of causes, "resembles", "unexplained": share of
        the square error that no named cause explains}.
        """
        if not self.fits:
            return None
        pooled = _Pooled(self, self.fits, said)
        whole = pooled.mean_square([])
        clipping: list[dict[str, Any]] = []
        for side in (1, -1):
            rival = self._clipped(side, said)
            if rival is None:
                continue
            own = rival.unexplained()
            share = 1.0 - own / pooled.unexplained()
            if share >= self.share:
                cut = [each[side] for each in self.clipped if side in each]
                level, beyond = (float(np.mean([getattr(each, name) for each in cut])) for name in ("level_k", "share"))
                spread = float(np.std([each.level_k for each in cut]))
                clipping = [{"kind": "clipping", "material": "", "size": [level, side * beyond],
                             "error": [spread, 0.0], "share": share}]  # fmt: skip
                pooled = rival
        base = pooled.base
        fitted = {name: {"size": list(size), "error": list(error)}
                  for (name, _), (size, error) in pooled.sizes(base).items()}  # fmt: skip
        named = [{"kind": each.cause[0], "material": each.cause[1], "size": list(each.size),
                  "error": list(each.error), "share": each.share} for each in pooled.named()]  # fmt: skip
        named += clipping
        return {
            "fit": fitted, "resembles": pooled.resembles(), "residual_k": pooled.residual_k(base), "named": named,
            "unexplained": min(pooled.unexplained() / whole, 1.0) if whole > 0.0 else 0.0,
        }  # fmt: skip

    def _clipped(self, side: int, said: Callable[[Named, float], bool]) -> "_Pooled | None":
        """Return the fits with the poses that look clipped, None if none does."""
        if not any(side in each for each in self.clipped):
            return None
        fits = [each[side].fit if side in each else own for own, each in zip(self.fits, self.clipped, strict=True)]
        return _Pooled(self, fits, said)


class _Pooled:
    """The normal equations of all poses, by piece of ground, in common columns."""

    def __init__(self, causes: Causes, fits: list[PoseFit], said: Callable[[Named, float], bool]) -> None:
        self._causes, self._fits, self._said_by = causes, fits, said
        self._most = max(each.most for each in fits)
        self.base: list[Cause] = [(name, "") for name in BASE if name != "zoom" or self._most[2]]
        self.materials = sorted({name for each in fits for name in each.materials})
        self._penalty = -np.log1p(-causes.share)
        self._cells = np.concatenate([each.cells for each in fits])
        self._pose = np.repeat(np.arange(len(fits)), [len(each.cells) for each in fits])
        # An offset of single poses is not an offset of all: it is removed from each. The first guess, of medians,
        # hardly depends on a material with a large error.
        middle = np.array([each.middle_k for each in fits])
        self._remove(middle - np.median(middle))
        self._remove(self._drift + self._pose_offsets(self._best_set()))

    def _remove(self, drift: NDArray[np.float64]) -> None:
        """Set the offset that is removed from each pose, with a mean of zero."""
        count = np.array([each.equations[each.most].matrix[:, 0, 0].sum() for each in self._fits])
        self._drift = drift - count @ drift / count.sum()
        self._drift_k2 = float(count @ self._drift**2 / count.sum())
        for name in ("_sums", "_totals"):
            self.__dict__.pop(name, None)

    @cached_property
    def _sums(self) -> dict[Free, tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """The rows (matrix, right, square) of all pieces in common columns, by what is free."""
        fits, size = self._fits, WIDTH + 2 * len(self.materials)
        keys = set(chain.from_iterable(each.equations for each in fits))
        found = {}
        for key in keys:
            count = len(self._cells)
            matrix, right, square = np.zeros((count, size, size)), np.zeros((count, size)), np.zeros(count)
            first = 0
            for each, drift in zip(fits, self._drift, strict=True):
                own = each.at(key)
                at = [*range(WIDTH), *(WIDTH + 2 * self.materials.index(name) + k for name in each.materials
                                       for k in (0, 1))]  # fmt: skip
                place = np.arange(first, first + len(each.cells))
                matrix[np.ix_(place, at, at)] = own.matrix
                right[np.ix_(place, at)] = own.right - drift * own.matrix[:, 0]
                square[place] = own.square - 2.0 * drift * own.right[:, 0] + drift**2 * own.matrix[:, 0, 0]
                first += len(each.cells)
            found[key] = matrix, right, square
        return found

    @property
    def _pixels(self) -> float:
        return float(self._sums[self._most][0][:, 0, 0].sum())

    def _pose_offsets(self, chosen: Sequence[Cause]) -> NDArray[np.float64]:
        """Return the mean error of each pose that causes leave [K]."""
        matrix, right, _ = self._sums[self._key(chosen)]
        at, poses = self._columns(chosen), len(self._fits)
        rest = right[:, 0] - matrix[:, 0][:, at] @ self._solved(chosen)
        return np.bincount(self._pose, rest, poses) / np.bincount(self._pose, matrix[:, 0, 0], poses)

    def _columns(self, chosen: Sequence[Cause]) -> list[int]:
        found: list[int] = []
        for kind, name in chosen:
            if kind in BASE:
                found += BASE[kind]
            else:
                found.append(WIDTH + 2 * self.materials.index(name) + (kind == "emissivity"))
        return found

    def _key(self, chosen: Sequence[Cause]) -> Free:
        key = ("shift", "") in chosen, ("blur", "") in chosen, ("zoom", "") in chosen
        return key if key in self._sums else self._most

    @cached_property
    def _totals(self) -> dict[Free, tuple[NDArray[np.float64], NDArray[np.float64], float]]:
        return {key: (matrix.sum(axis=0), right.sum(axis=0), float(square.sum()))
                for key, (matrix, right, square) in self._sums.items()}  # fmt: skip

    def _solved(self, chosen: Sequence[Cause]) -> NDArray[np.float64]:
        """Return the coefficients of the columns of causes."""
        at = self._columns(chosen)
        matrix, right, _ = self._totals[self._key(chosen)]
        return _solution(matrix[np.ix_(at, at)], right[at]) if at else np.zeros(0)

    def _residual(self, chosen: Sequence[Cause]) -> float:
        """Return the mean square residual with causes, plus the floor [K²]."""
        matrix, right, square = self._totals[self._key(chosen)]
        at = self._columns(chosen)
        explained = right[at] @ _solution(matrix[np.ix_(at, at)], right[at]) if at else 0.0
        return max(square - float(explained), 0.0) / self._pixels + _FLOOR_K**2

    def residual_k(self, chosen: Sequence[Cause]) -> float:
        """Return the root mean square residual with causes [K]."""
        return float(np.sqrt(max(self._residual(chosen) - _FLOOR_K**2, 0.0)))

    def mean_square(self, chosen: Sequence[Cause]) -> float:
        """Return the mean square error that causes leave, with that of the offsets of single poses [K²]."""
        return max(self._residual(chosen) - _FLOOR_K**2, 0.0) + self._drift_k2

    def unexplained(self) -> float:
        """Return the mean square error that no named cause explains, and at least the floor [K²]."""
        named = self.named()
        chosen = [each.cause for each in named if each.cause[0] != "drift"]
        found = self.mean_square(chosen) - (self._drift_k2 if len(chosen) < len(named) else 0.0)
        return max(found, _FLOOR_K**2)

    def sizes(self, chosen: Sequence[Cause]) -> dict[Cause, tuple[tuple[float, ...], tuple[float, ...]]]:
        """Return {cause: (sizes, standard errors)} of causes fitted together."""
        at = self._columns(chosen)
        matrix, right, _ = self._sums[self._key(chosen)]
        part, given = matrix[:, np.array(at)[:, None], np.array(at)], right[:, at]
        best = _solution(part.sum(axis=0), given.sum(axis=0))
        _, piece = np.unique(self._cells, return_inverse=True)
        count = int(piece.max()) + 1
        scores = np.zeros((count, len(at)))
        np.add.at(scores, piece, given - part @ best)
        inverse = np.linalg.pinv(part.sum(axis=0), hermitian=True)
        spread = inverse @ (scores.T @ scores) @ inverse * count / max(count - 1, 1)
        error = np.sqrt(np.maximum(np.diag(spread), 0.0))
        found, first = {}, 0
        for each in chosen:
            last = first + len(self._columns([each]))
            found[each] = tuple(best[first:last].tolist()), tuple(error[first:last].tolist())
            first = last
        return found

    def resembles(self) -> bool:
        """Whether the gain is significantly above zero."""
        (size, error) = self.sizes([("offset", ""), ("contrast", "")])["contrast", ""]
        return 1.0 + size[0] > self._quantile() * error[0]

    def _quantile(self) -> float:
        """Return the number of standard errors at the level of significance, of all causes tested."""
        from scipy.special import stdtrit

        tests = len(self.base) + 1 + 2 * len(self.materials)
        freedom = max(len(np.unique(self._cells)) - 1, 2)
        return float(stdtrit(freedom, 1.0 - 0.5 * self._causes.level / tests))

    def named(self) -> list[Named]:
        """Return the causes that explain more than their rivals, the largest share first."""
        constant = self._constant
        rest = self._residual([each.cause for each in constant]) / self._residual([("offset", "")])
        found = [each for each in (*constant, *self._changing()) if self._said_by(each, min(rest, 1.0))]
        return sorted(found, key=lambda each: -each.share)

    @cached_property
    def _constant(self) -> list[Named]:
        """The causes of one size in all poses."""
        chosen = self._best_set()
        while chosen:
            sizes = self.sizes(chosen)
            wrong = [each for each in chosen if not self._holds(each, *sizes[each], chosen)]
            if not wrong:
                break
            # The least certain one leaves, and the rest is tried again.
            chosen = [each for each in chosen if each != min(wrong, key=lambda each: self._share(each, chosen))]
        chosen = [self._said(each, chosen) for each in chosen]
        if not chosen:
            return []
        return [Named(each, *size, self._share(each, chosen)) for each, size in self.sizes(chosen).items()]

    def _changing(self) -> list[Named]:
        """Return the offset that changes from pose to pose, if it explains most of the error left without it."""
        chosen = [each.cause for each in self._constant]
        poses = len(self._fits)
        # About the mean, since the offset of all poses is another cause.
        share = self._drift_k2 / (self._drift_k2 + self._residual(chosen))
        if poses < 2 or self._drift_k2 < LEAST["drift"] ** 2 or share < self._causes.share:
            return []
        matrix, right, _ = self._sums[self._key(chosen)]
        at, pixels = self._columns(chosen), matrix[:, 0, 0]
        rest = right[:, 0] - matrix[:, 0][:, at] @ self._solved(chosen)
        count = np.bincount(self._pose, pixels, poses)
        about = rest - pixels * (np.bincount(self._pose, rest, poses) / count)[self._pose]
        pieces = np.bincount(self._pose, minlength=poses)
        error = np.sqrt(np.bincount(self._pose, about**2, poses) * pieces / np.maximum(pieces - 1, 1)) / count
        if not (np.abs(self._drift) > self._quantile() * error).any():
            return []
        return [Named(("drift", ""), tuple(self._drift.tolist()), tuple(error.tolist()), share)]

    def _best_set(self) -> list[Cause]:
        subsets = [list(each) for size in range(len(self.base) + 1) for each in combinations(self.base, size)]
        candidates = [(kind, name) for name in self.materials for kind in ("material", "emissivity")]
        materials: list[Cause] = []
        best, chosen = self._best_of(subsets, materials)
        while len(materials) < _MOST_MATERIALS:
            taken = {name for _, name in materials}
            tried = [(*self._best_of(subsets, [*materials, each]), each) for each in candidates
                     if each[1] not in taken and self._possible(each, materials)]  # fmt: skip
            if not tried:
                break
            score, more, each = min(tried, key=lambda entry: entry[0])
            if score >= best:
                break
            best, chosen, materials = score, more, [*materials, each]
        return chosen

    def _best_of(self, subsets: Sequence[list[Cause]], materials: list[Cause]) -> tuple[float, list[Cause]]:
        """Return (score, causes) of the best subset of base causes with these materials."""
        scored = [(np.log(self._residual([*each, *materials])) + self._penalty * (len(each) + len(materials)), each)
                  for each in subsets]  # fmt: skip
        score, each = min(scored, key=lambda entry: entry[0])
        return float(score), [*each, *materials]

    def _possible(self, cause: Cause, materials: list[Cause]) -> bool:
        """Return whether an emissivity would stay within 0…1."""
        if cause[0] != "emissivity":
            return True
        alone = [*materials, cause]
        change = self.sizes(alone)[cause][0][0]
        return -_BEYOND <= self._causes.emissivity[cause[1]] + change <= 1.0 + _BEYOND

    def _share(self, cause: Cause, chosen: Sequence[Cause]) -> float:
        """Return the share of the square error left without a cause that it explains."""
        without = self._residual([each for each in chosen if each != cause])
        if cause[0] == "offset":
            # An offset that differs from pose to pose is not one offset.
            size = self.sizes(chosen)[cause][0][0]
            return float(size**2 / (size**2 + self._residual(chosen) + self._drift_k2))
        return 1.0 - self._residual(chosen) / without

    def _holds(self, cause: Cause, size: tuple[float, ...], error: tuple[float, ...], chosen: Sequence[Cause]) -> bool:
        if cause[0] == "blur":
            # A picture sharper than the reference is not blurred.
            large = size[0] >= LEAST["blur"] ** 2
        else:
            large = max(abs(value) for value in size) >= LEAST[cause[0]]
        if cause[0] == "contrast" and not self._rescaled(size[0], error[0], chosen):
            return False
        sure = any(abs(value) > self._quantile() * own for value, own in zip(size, error, strict=True))
        return large and sure and self._share(cause, chosen) >= self._causes.share

    def _rescaled(self, size: float, error: float, chosen: Sequence[Cause]) -> bool:
        """Return whether the regression of the reference on the picture also shows a wrong contrast.

        Errors of the picture lower its slope on the reference; its true gain is between that slope and the inverse of
        the other.
        """
        matrix, right, square = self._totals[self._key(chosen)]
        others = self._columns([each for each in chosen if each[0] != "contrast"])
        # The picture itself, without the reference: a contrast of 0.
        column = BASE["contrast"][0]
        flat, own = right + matrix[:, column], square + 2.0 * right[column] + matrix[column, column]
        own -= float(flat[others] @ _solution(matrix[np.ix_(others, others)], flat[others])) if others else 0.0
        left = (self._residual(chosen) - _FLOOR_K**2) * self._pixels
        known = 1.0 - left / own if own > 0.0 else 0.0
        if known <= 0.0:
            return False
        other, wide = (1.0 + size) / known, error / known
        limit = 1.0 - max(LEAST["contrast"], self._quantile() * wide)
        drifts = self._drift_k2 >= self._causes.share * (self._drift_k2 + self._residual(chosen))
        # A line through all poses also tells the scale by their means, unless their offsets are a cause of their own.
        return size > 0.0 or (other < limit and (drifts or self._pooled_scale < limit))

    @cached_property
    def _pooled_scale(self) -> float:
        """The inverse slope of the reference on the picture over all poses, with the means of the poses."""
        key = next(iter(self._sums)) if (False, False, False) not in self._sums else (False, False, False)
        matrix, right, square = self._sums[key]
        drift = self._drift[self._pose]
        mean = np.array([each.mean_k for each in self._fits])
        about = (mean - mean.mean())[self._pose]
        n, x, y = matrix[:, 0, 0], matrix[:, 0, 1], right[:, 0] + drift * matrix[:, 0, 0]
        xx, xy = matrix[:, 1, 1], right[:, 1] + drift * matrix[:, 0, 1]
        yy = square + 2.0 * drift * right[:, 0] + drift**2 * matrix[:, 0, 0]
        # The reference is x + about, and the picture y more.
        true, seen = (x + n * about).sum(), (x + y + n * about).sum()
        both = (xx + xy + about * (2.0 * x + y + n * about)).sum() - true * seen / n.sum()
        own = (xx + 2.0 * xy + yy + about * (2.0 * (x + y) + n * about)).sum() - seen**2 / n.sum()
        return float(own / both) if both else np.inf

    def _said(self, cause: Cause, chosen: Sequence[Cause]) -> Cause:
        """Return the cause, or an offset on the material unless its emissivity explains significantly more.

        An emissivity changes warm ground more than cold ground. Fitted beside an offset, it must remain about the same.
        """
        kind, name = cause
        if kind != "emissivity":
            return cause
        rival = ("material", name)
        (alone,), _ = self.sizes(chosen)[cause]
        (beside,), (error,) = self.sizes([*chosen, rival])[cause]
        steady = abs(beside) > self._quantile() * error and abs(beside - alone) < max(
            _APART * error, _APART_SHARE * abs(alone)
        )
        return cause if steady and -_BEYOND <= self._causes.emissivity[name] + alone <= 1.0 + _BEYOND else rival


class Fitting:
    """The fits of one scene: some of its poses, in pieces of ground that all poses and scenes of a land share."""

    def __init__(self, scene: Scene, land: str, poses: int, scenes: int) -> None:
        self._scene, self._land = scene, zlib.crc32(land.encode()) & 0xFFFF
        self._chosen = set(evenly(poses, min(_POSES, max(1, _ALL // scenes))))
        self._emissivity = emissivities.band_emissivities(scene)
        self._known = {each.name: float(e) for each, e in zip(scene.materials, self._emissivity, strict=True)}
        self._side_m: float | None = None
        self._index = -1
        self._cell: NDArray[np.int64] = np.zeros((0, 0), np.int64)
        self._pure: NDArray[np.bool_] = np.zeros((0, 0), np.bool_)

    def add(
        self,
        causes: Causes,
        view: View,
        image: NDArray[np.floating],
        at: tuple[float, float, float, float] | None,
        zoomed: bool = False,
    ) -> None:
        """Add the fit of a View to a method's Causes if this pose is fitted.

        `image` (H, W) is the method's apparent temperature [K], `at` its shift as of `registration.peak`; `zoomed` says
        whether its field of view may be wrong.
        """
        if view.index not in self._chosen or view.truth is None:
            return
        band_um = self._scene.camera.band_um
        if self._index != view.index:
            self._index, self._cell, self._pure = view.index, self._cells(view), self._of_one_material(view)
        change = emissivities.change_k(view, self._emissivity, image, self._scene.sky_temperature, band_um)
        pair = Pair(image, view.truth, view.ground, view.known, view.material, view.material_names, change, self._cell,
                    self._pure)  # fmt: skip
        start, zoom = at[:2] if at is not None and abs(at[2]) >= ALIKE else (0.0, 0.0), None
        if zoomed:
            zoom, beside = zoom_of(image, view.truth, view.known)
            start = beside if abs(zoom) >= LEAST["zoom"] else start
            zoom = zoom if abs(zoom) >= LEAST["zoom"] else 0.0
        found = fit(pair, start, zoom=zoom)
        if found is None:
            return
        causes.fits.append(found)
        causes.emissivity |= self._known
        causes.clipped.append({})
        for side in (1, -1):
            cut = clipping(image[view.ground], view.truth[view.ground], side)
            if cut is not None:
                limit, level, share = cut
                truth = np.minimum(view.truth, limit) if side > 0 else np.maximum(view.truth, limit)
                own = fit(replace(pair, truth=truth.astype(np.float32)), start, zoom=zoom)
                if own is not None:
                    causes.clipped[-1][side] = Clipped(own, level, share)

    def _of_one_material(self, view: View) -> NDArray[np.bool_]:
        """Return the pixels that show a single material, (H, W): colours are interpolated between texels."""
        import cv2

        texel_m = self._scene.main_surface.texel_m or 0.0
        reach = int(np.clip(np.ceil(texel_m / view.texel_m if view.texel_m else 1.0), 1, _MOST_REACH_PX))
        sides = np.ones((2 * reach + 1,) * 2, np.uint8)
        found: NDArray[np.bool_] = cv2.erode(view.material, sides) == cv2.dilate(view.material, sides)
        return found

    def _cells(self, view: View) -> NDArray[np.int64]:
        """Return the number of the piece of ground of each pixel, (H, W)."""
        assert view.position is not None
        place = np.where(view.known[..., None], view.position[..., :2], np.float32(0.0)).astype(np.float64)
        if self._side_m is None:
            seen = view.position[view.known][:, :2]
            sides = np.ptp(np.percentile(seen, [2, 98], axis=0), axis=0) if len(seen) else np.ones(2)
            self._side_m = max(float(sides.max()) / _PIECES, 1e-3)
        number = np.floor(place / self._side_m).astype(np.int64) & 0xFFFFF
        found: NDArray[np.int64] = (self._land << 40) + (number[..., 0] << 20) + number[..., 1]
        return found


def clipping(seen: NDArray[np.floating], truth: NDArray[np.floating], side: int) -> tuple[float, float, float] | None:
    """Return (limit of the reference, of the picture [K], share beyond) of temperatures (n,) clipped on a side.

    `side` is 1 for a highest and −1 for a lowest temperature. None unless the clipped reference leaves a third of the
    square error about a line that the reference leaves.
    """
    here = np.isfinite(seen) & np.isfinite(truth)
    step = max(1, int(here.sum()) // _TRIED)
    s, t = (side * values[here][::step].astype(np.float64) for values in (seen, truth))
    if len(s) < 3 or not t.std() > 0.0:
        return None

    def left(x: NDArray[np.float64]) -> tuple[float, float, float]:
        """Return (square error, slope, zero) of the line through x and s."""
        about, own = x - x.mean(), s - s.mean()
        slope = float(about @ own) / max(float(about @ about), 1e-12)
        return float(own @ own - slope * (about @ own)), slope, float(s.mean() - slope * x.mean())

    limits = np.quantile(t, 1.0 - _CLIPPED)
    tried = [left(np.minimum(t, limit))[0] for limit in limits]
    best, found = int(np.argmin(tried)), (0.0, 0.0, 0.0)
    # The limit lies between its neighbours.
    ends = limits[max(best - 1, 0)], limits[min(best + 1, len(limits) - 1)]
    for limit in [*np.linspace(*ends, 21), limits[best]]:
        error, slope, zero = left(np.minimum(t, limit))
        if error <= min(tried):
            tried.append(error)
            found = limit, slope, zero
    if min(tried) > (1.0 - SHARE) * left(t)[0] or not found[1] > 0.0:
        return None
    limit, slope, zero = found
    return side * limit, side * (zero + slope * limit), float((t > limit).mean())


def _solution(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the solution of normal equations; directions without information are zero."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    found = np.linalg.lstsq(matrix / np.outer(scale, scale), right / scale, rcond=1e-10)[0] / scale
    solution: NDArray[np.float64] = found
    return solution
