"""Pictures that show the same by content: found through hash tables of local features, confirmed by registration.

Every picture is brought to a small grey one and described by ORB features (Rublee et al., ICCV 2011,
doi:10.1109/ICCV.2011.6126544), each 256 comparisons of brightness. Features that agree in 16 comparisons in a row vote
for each other's pictures, so nothing is compared with everything. The pictures with most votes are laid over each other
by the similarity that most of their features agree on, and are duplicates where their fine structure correlates there.
Brightness, compression, shifts, crops, scale and rotation change little of that; a mirrored copy is not found.

Measured on 42 photographs of roads and 30 procedural orthophotos: of copies compressed, made darker, blurred, shrunk to
a third, or shifted and cropped by 15 %, all are found; of crops that share 40 % or more of their area, 96 %; of those
that share a quarter, half. Unrelated pictures correlate with at most 0.28.
"""

from dataclasses import dataclass

import numpy as np

# Longest side of the small pictures, and their mean and standard deviation [px, levels].
SIDE, _MEAN, _SPREAD = 256, 128.0, 48.0
FEATURES = 200
# So many pictures with most votes are laid over each other.
CANDIDATES = 6
# A duplicate: matched features that agree on the similarity, share of the picture covered, correlation there.
LEAST_MATCHES, LEAST_OVERLAP, LEAST_CORRELATION = 8, 0.1, 0.4
# Features further apart than a quarter of their 256 comparisons do not match; those that do agree within this [px].
_MOST_BITS, _RESIDUAL_PX = 64, 2.5
_SCALES = (0.3, 3.0)
# Fine structure: between these standard deviations of a Gaussian [px]; below this its contrast is noise [levels].
_FINE_PX, _COARSE_PX, _NOISE = 0.8, 6.0, 2.0
# A bucket fuller than this tells nothing: at least, and as a multiple of the mean.
_FULL, _FULL_TIMES = 40, 8
_TESTS_AT_ONCE = 256


@dataclass(frozen=True, eq=False)
class Sketch:
    """What is kept of a picture.

    Attributes
    ----------
    grey : (h, w) uint8
        Small, of given mean and contrast.
    place : (n, 2) float32
        Of its features, column and row [px].
    bits : (n, 32) uint8
        Their comparisons.
    """

    grey: np.ndarray
    place: np.ndarray
    bits: np.ndarray


@dataclass(frozen=True)
class Match:
    """A picture that shows the same as another: its number, the share of that other it covers, their correlation."""

    index: int
    overlap: float
    correlation: float


def sketch(rgb):
    """Return the Sketch of a picture, (h, w, 3) uint8."""
    import cv2

    grey = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY).astype(np.float32)
    scale = SIDE / max(grey.shape)
    size = [max(round(side * scale), 1) for side in grey.shape[::-1]]
    grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR)
    grey = (grey - grey.mean()) * (_SPREAD / max(float(grey.std()), 1.0)) + _MEAN
    grey = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    detector = cv2.ORB_create(FEATURES, edgeThreshold=16, fastThreshold=7)
    points, bits = detector.detectAndCompute(grey, None)
    place = np.array([point.pt for point in points], np.float32).reshape(-1, 2)
    return Sketch(grey, place, np.zeros((0, 32), np.uint8) if bits is None else bits)


def find(wanted, known, progress=None):
    """Return, for each of the Sketches `wanted`, the best Match among the Sketches `known`, or None.

    Parameters
    ----------
    wanted, known : sequence of Sketch
    progress : callable, optional
        Called with the share done.
    """
    found, tables = [], _Tables(known)
    for start in range(0, len(wanted), _TESTS_AT_ONCE):
        some = wanted[start : start + _TESTS_AT_ONCE]
        for one, votes in zip(some, tables.votes(some), strict=True):
            nearest = [k for k in np.argsort(-votes, kind="stable")[:CANDIDATES] if votes[k]]
            matches = [match for k in nearest if (match := compared(one, known[k], int(k)))]
            found.append(max(matches, key=lambda match: match.overlap * match.correlation, default=None))
            if progress:
                progress(len(found) / len(wanted))
    return found


def compared(one, other, index=0):
    """Return the Match of a Sketch with another, whose number is `index`, or None where they do not show the same."""
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
    laid = cv2.warpAffine(other.grey, similarity, size)
    covered = cv2.warpAffine(np.ones(other.grey.shape, np.uint8), similarity, size, flags=cv2.INTER_NEAREST)
    overlap = float(covered.mean())
    # Away from the border, where the fine structure would be that of the border.
    covered = cv2.erode(covered, np.ones((9, 9), np.uint8), borderValue=0) > 0
    if overlap < LEAST_OVERLAP or not covered.any():
        return None
    correlation = float(np.corrcoef(_fine(one.grey)[covered], _fine(laid)[covered])[0, 1])
    return Match(index, overlap, correlation) if correlation >= LEAST_CORRELATION else None


def _fine(grey):
    """The fine structure of a picture, of equal contrast everywhere."""
    import cv2

    grey = grey.astype(np.float32)
    fine = cv2.GaussianBlur(grey, (0, 0), _FINE_PX) - cv2.GaussianBlur(grey, (0, 0), _COARSE_PX)
    return fine / np.sqrt(cv2.GaussianBlur(fine * fine, (0, 0), _COARSE_PX) + _NOISE**2)


class _Tables:
    """Hash tables of the features of Sketches: 16 of them, by 16 comparisons each."""

    def __init__(self, known):
        self.known = len(known)
        owner, words = _words(known)
        order = np.argsort(words, axis=0, kind="stable")
        self.words = np.take_along_axis(words, order, axis=0)
        self.owner = owner[order]
        self.full = max(_FULL, _FULL_TIMES * len(words) / 65536)

    def votes(self, wanted):
        """Return how often features of Sketches share a bucket with those of the known, (wanted, known) int."""
        owner, words = _words(wanted)
        votes = np.zeros(len(wanted) * self.known, np.int64)
        for table in range(words.shape[1]):
            first = np.searchsorted(self.words[:, table], words[:, table], "left")
            count = np.searchsorted(self.words[:, table], words[:, table], "right") - first
            count[count > self.full] = 0
            # first, first + 1, … of each bucket, one after another.
            inside = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
            votes += np.bincount(
                np.repeat(owner, count) * self.known + self.owner[inside, table], minlength=len(votes)
            )
        return votes.reshape(len(wanted), self.known)


def _words(sketches):
    """(number of the Sketch (n,), its comparisons in 16 words (n, 16) uint16) of all features."""
    bits = np.concatenate([np.zeros((0, 32), np.uint8), *(each.bits for each in sketches)])
    return np.repeat(np.arange(len(sketches)), [len(each.bits) for each in sketches]), bits.view(np.uint16)
