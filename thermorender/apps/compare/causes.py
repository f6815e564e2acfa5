"""Causes of a method's error: the set that best explains it, from the added fits of all poses.

The score of a set is log(mean square residual) + p · number of causes; the lowest wins. So each cause must reduce the
remaining square error by a factor of exp(p). Its size must also differ from zero significantly, with standard errors
from the scatter between pieces of ground (Liang & Zeger 1986, doi:10.1093/biomet/73.1.13). `python -m
validation.referee` calibrates both limits to the rate of false detections.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import chain, combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.compare import emissivities
from thermorender.apps.compare.pose_fit import BASE, WIDTH, Pair, PoseFit, fit
from thermorender.apps.compare.registration import ALIKE
from thermorender.apps.compare.view import View, evenly
from thermorender.scene.scene import Scene

# A cause explains at least this share of the square error that is left without it, and its size differs from zero at
# this level of significance, divided by the number of causes tested.
SHARE, LEVEL = 2.0 / 3.0, 0.01
# Errors below this are sampling noise of the renders [K].
_FLOOR_K = 0.02
# Least sizes that are reported: offset [K], gain, shift [px], standard deviation of the blur [px], offset of a
# material [K], emissivity.
LEAST = {"offset": 0.1, "contrast": 0.03, "shift": 0.25, "blur": 0.5, "material": 0.3, "emissivity": 0.015}
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

# A cause: ("offset" | "contrast" | "shift" | "blur", "") or ("material" | "emissivity", name).
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


@dataclass
class Causes:
    """Fits of a method's poses, and the true band emissivity of each material."""

    fits: list[PoseFit] = field(default_factory=list)
    emissivity: dict[str, float] = field(default_factory=dict)
    share: float = SHARE  # As `SHARE`
    level: float = LEVEL  # As `LEVEL`

    def summary(self) -> dict[str, Any] | None:
        """Return {"fit": values and errors with all base causes, "named": list of causes}, as plain numbers."""
        if not self.fits:
            return None
        pooled = _Pooled(self)
        named = pooled.named()
        base = [(name, "") for name in BASE]
        whole = pooled.sizes(base)
        fitted = {name: {"size": list(size), "error": list(error)} for (name, _), (size, error) in whole.items()}
        return {
            "fit": fitted, "resembles": pooled.resembles(), "residual_k": pooled.residual_k(base),
            "named": [{"kind": each.cause[0], "material": each.cause[1], "size": list(each.size),
                       "error": list(each.error), "share": each.share} for each in named],
        }  # fmt: skip


class _Pooled:
    """The normal equations of all poses, by piece of ground, in common columns."""

    def __init__(self, causes: Causes) -> None:
        self._causes, fits = causes, causes.fits
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
        count = np.array([each.equations[True, True].matrix[:, 0, 0].sum() for each in self._causes.fits])
        self._drift = drift - count @ drift / count.sum()
        self._drift_k2 = float(count @ self._drift**2 / count.sum())
        for name in ("_sums", "_totals"):
            self.__dict__.pop(name, None)

    @cached_property
    def _sums(self) -> dict[tuple[bool, bool], tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]]:
        """The rows (matrix, right, square) of all pieces in common columns, by whether shift and blur are free."""
        fits, size = self._causes.fits, WIDTH + 2 * len(self.materials)
        keys = set(chain.from_iterable(each.equations for each in fits))
        found = {}
        for key in keys:
            count = len(self._cells)
            matrix, right, square = np.zeros((count, size, size)), np.zeros((count, size)), np.zeros(count)
            first = 0
            for each, drift in zip(fits, self._drift, strict=True):
                own = each.at(*key)
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
        return float(self._sums[True, True][0][:, 0, 0].sum())

    def _pose_offsets(self, chosen: Sequence[Cause]) -> NDArray[np.float64]:
        """Return the mean error of each pose that causes leave [K]."""
        matrix, right, _ = self._sums[self._key(chosen)]
        at, poses = self._columns(chosen), len(self._causes.fits)
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

    def _key(self, chosen: Sequence[Cause]) -> tuple[bool, bool]:
        key = ("shift", "") in chosen, ("blur", "") in chosen
        return key if key in self._sums else (True, True)

    @cached_property
    def _totals(self) -> dict[tuple[bool, bool], tuple[NDArray[np.float64], NDArray[np.float64], float]]:
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

        tests = len(BASE) + 1 + 2 * len(self.materials)
        freedom = max(len(np.unique(self._cells)) - 1, 2)
        return float(stdtrit(freedom, 1.0 - 0.5 * self._causes.level / tests))

    def named(self) -> list[Named]:
        """Return the causes that explain more than their rivals, the largest share first."""
        chosen = self._best_set()
        while chosen:
            sizes = self.sizes(chosen)
            wrong = [each for each in chosen if not self._holds(each, *sizes[each], chosen)]
            if not wrong:
                break
            # The least certain one leaves, and the rest is tried again.
            chosen = [each for each in chosen if each != min(wrong, key=lambda each: self._share(each, chosen))]
        chosen = [self._said(each, chosen) for each in chosen]
        found = [Named(each, *size, self._share(each, chosen)) for each, size in self.sizes(chosen).items()] if chosen \
            else []  # fmt: skip
        return sorted(found, key=lambda each: -each.share)

    def _best_set(self) -> list[Cause]:
        base = [(name, "") for name in BASE]
        subsets = [list(each) for size in range(len(base) + 1) for each in combinations(base, size)]
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
        return size > 0.0 or other < 1.0 - max(LEAST["contrast"], self._quantile() * wide)

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
        self, causes: Causes, view: View, image: NDArray[np.floating], at: tuple[float, float, float, float] | None
    ) -> None:
        """Add the fit of a View to a method's Causes if this pose is fitted.

        `image` (H, W) is the method's apparent temperature [K], `at` its shift as of `registration.peak`.
        """
        if view.index not in self._chosen or view.truth is None:
            return
        band_um = self._scene.camera.band_um
        if self._index != view.index:
            self._index, self._cell, self._pure = view.index, self._cells(view), self._of_one_material(view)
        change = emissivities.change_k(view, self._emissivity, image, self._scene.sky_temperature, band_um)
        pair = Pair(image, view.truth, view.ground, view.known, view.material, view.material_names, change, self._cell,
                    self._pure)  # fmt: skip
        found = fit(pair, at[:2] if at is not None and abs(at[2]) >= ALIKE else (0.0, 0.0))
        if found is not None:
            causes.fits.append(found)
            causes.emissivity |= self._known

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


def _solution(matrix: NDArray[np.float64], right: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the solution of normal equations; directions without information are zero."""
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-12))
    found = np.linalg.lstsq(matrix / np.outer(scale, scale), right / scale, rcond=1e-10)[0] / scale
    solution: NDArray[np.float64] = found
    return solution
