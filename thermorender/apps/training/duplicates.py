"""Pictures of the same content, found through hash tables of local features and confirmed by registration.

Small grey pictures are described by ORB features (Rublee et al., ICCV 2011, doi:10.1109/ICCV.2011.6126544) of 256 bits
each. Features that agree in 16 consecutive bits vote for each other's pictures. The pictures with most votes are
aligned by a similarity transform, and are duplicates if their fine structure correlates. Mirrored copies are found only
by the sketch of the mirrored picture; crops of a fifth of the area often need `learned.fingerprints`.

Of six procedural lands, at least five are found when halved, shrunk, turned, brightened, compressed or noisy, and none
is taken for another. Road scenes far apart in time are not taken for each other.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Longest side of the small pictures [px], their mean and standard deviation [levels].
SIDE, _MEAN, _SPREAD = 256, 128.0, 48.0
FEATURES = 200
# Number of pictures with most votes that are aligned.
CANDIDATES = 6
# Thresholds of a duplicate: matched features that agree on the similarity, share covered, correlation there.
LEAST_MATCHES, LEAST_OVERLAP, LEAST_CORRELATION = 8, 0.1, 0.4
# Matched features differ in at most a quarter of their 256 comparisons, and in position by this after alignment [px].
_MOST_BITS, _RESIDUAL_PX = 64, 2.5
_SCALES = (0.3, 3.0)
# Fine structure: between these standard deviations of a Gaussian [px]; below this its contrast is noise [levels].
_FINE_PX, _COARSE_PX, _NOISE = 0.8, 6.0, 2.0
# Fuller buckets are ignored: least limit, and limit as a multiple of the mean.
_FULL, _FULL_TIMES = 40, 8
_TESTS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Sketch:
    """Description of a picture."""

    grey: NDArray[np.uint8]  # (h, w) uint8 small picture of given mean and contrast
    place: NDArray[np.float32]  # (n, 2) float32 column and row of its features [px]
    bits: NDArray[np.uint8]  # (n, 32) uint8 comparisons of each feature


@dataclass(frozen=True)
class Match:
    """A picture with the same content as another: its index, the share of the other it covers, their correlation."""

    index: int
    overlap: float
    correlation: float


def sketch(rgb: NDArray[np.uint8]) -> Sketch:
    """Return the Sketch of a picture, (h, w, 3) uint8."""
    import cv2

    grey: np.ndarray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = SIDE / max(grey.shape)
    size = [max(round(side * scale), 1) for side in grey.shape[::-1]]
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    grey = (grey - grey.mean()) * (_SPREAD / max(float(grey.std()), 1.0)) + _MEAN
    small = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    detector: Any = cv2.ORB.create(FEATURES, edgeThreshold=16, fastThreshold=7)
    points, bits = detector.detectAndCompute(small, None)
    place = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    return Sketch(small, place, np.zeros((0, 32), np.uint8) if bits is None else bits)


def find(
    wanted: Sequence[Sketch], known: Sequence[Sketch], progress: Callable[[float], object] | None = None
) -> list[Match | None]:
    """Return the best Match of each Sketch in `wanted` among `known`, or None; `progress` takes the share done."""
    found: list[Match | None] = []
    tables = _Tables(known)
    for start in range(0, len(wanted), _TESTS_AT_ONCE):
        some = wanted[start : start + _TESTS_AT_ONCE]
        for one, votes in zip(some, tables.votes(some), strict=True):
            nearest = [k for k in np.argsort(-votes, kind="stable")[:CANDIDATES] if votes[k]]
            matches = [match for k in nearest if (match := compared(one, known[k], int(k)))]
            found.append(max(matches, key=lambda match: match.overlap * match.correlation, default=None))
            if progress:
                progress(len(found) / len(wanted))
    return found


def compared(one: Sketch, other: Sketch, index: int = 0) -> Match | None:
    """Return the Match of a Sketch with another, whose index is `index`, or None if the content differs."""
    import cv2

    if not len(one.bits) or not len(other.bits):
        return None
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(other.bits, one.bits)
    pairs = [pair for pair in pairs if pair.distance < _MOST_BITS]
    if len(pairs) < LEAST_MATCHES:
        return None
    there = other.place[[pair.queryIdx for pair in pairs]]
    here = one.place[[pair.trainIdx for pair in pairs]]
    similarity, agree = cv2.estimateAffinePartial2D(there, here, ransacReprojThreshold=_RESIDUAL_PX)
    if similarity is None or agree.sum() < LEAST_MATCHES:
        return None
    if not _SCALES[0] < np.hypot(*similarity[:, 0]) < _SCALES[1]:
        return None
    size = one.grey.shape[::-1]
    aligned = cv2.warpAffine(other.grey, similarity, size)
    covered: np.ndarray = cv2.warpAffine(np.ones(other.grey.shape, np.uint8), similarity, size, flags=cv2.INTER_NEAREST)
    overlap = float(covered.mean())
    # Without the border, whose edge would count as fine structure.
    covered = cv2.erode(covered, np.ones((9, 9), np.uint8), borderValue=0) > 0
    if overlap < LEAST_OVERLAP or not covered.any():
        return None
    correlation = float(np.corrcoef(_fine(one.grey)[covered], _fine(aligned)[covered])[0, 1])
    return Match(index, overlap, correlation) if correlation >= LEAST_CORRELATION else None


def _fine(grey: np.ndarray) -> np.ndarray:
    """A picture's fine structure, normalised to equal local contrast."""
    import cv2

    grey = grey.astype(np.float32)
    fine = cv2.GaussianBlur(grey, (0, 0), _FINE_PX) - cv2.GaussianBlur(grey, (0, 0), _COARSE_PX)
    return fine / np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), _COARSE_PX) + _NOISE**2)


class _Tables:
    """16 hash tables of the features of Sketches, each keyed by 16 comparisons."""

    def __init__(self, known: Sequence[Sketch]) -> None:
        self.known = len(known)
        owner, words = _words(known)
        order = np.argsort(words, axis=0, kind="stable")
        self.words = np.take_along_axis(words, order, axis=0)
        self.owner = owner[order]
        self.full = max(_FULL, _FULL_TIMES * len(words) / 65536)

    def votes(self, wanted: Sequence[Sketch]) -> np.ndarray:
        """Return how many features share a bucket with features of each known Sketch, (wanted, known) int."""
        owner, words = _words(wanted)
        votes = np.zeros(len(wanted) * self.known, np.int64)
        for table in range(words.shape[1]):
            first = np.searchsorted(self.words[:, table], words[:, table], "left")
            count = np.searchsorted(self.words[:, table], words[:, table], "right") - first
            count[count > self.full] = 0
            # first, first + 1, … of each bucket, one after another.
            inside = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
            votes += np.bincount(np.repeat(owner, count) * self.known + self.owner[inside, table], minlength=len(votes))
        return votes.reshape(len(wanted), self.known)


def _words(sketches: Sequence[Sketch]) -> tuple[np.ndarray, np.ndarray]:
    """(index of the Sketch (n,), comparisons as 16 words (n, 16) uint16) of all features."""
    bits = np.concatenate([np.zeros((0, 32), np.uint8), *(each.bits for each in sketches)])
    return np.repeat(np.arange(len(sketches)), [len(each.bits) for each in sketches]), bits.view(np.uint16)
