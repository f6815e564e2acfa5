"""Spectral nodes and channels: how few numbers represent the spectrum of a scene, and the error of that in mK.

*Points* are a fine quadrature of the camera's band; with air, every wavelength occurs once for each absorption term of
its sub-band. *Nodes* are sets of points, not necessarily neighbours, at which light between surfaces is solved. Within
a node reflectances, the light's colour and the air's transmittance are nearly constant. Ward's clustering (1963,
doi:10.1080/01621459.1963.10500845) finds them. *Channels* are stored in texels: without air the band radiance; with air
the principal components of all spectra of the scene behind all paths, whose weighted sum is the radiance.

Emission is integrated over all points and needs no nodes. Reflection couples the reflectance of one surface with the
spectrum of its surroundings. Its nodes are as few as keep the error below the tolerance for the light in the scene's
envelope, a list of spectra: these errors are the largest on that list, not bounds for all light of a scene. They are in
mK at the brightness of the light, or at 300 K where it is colder.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from thermorender.atmosphere.model import Atmosphere
from thermorender.materials.material import Material
from thermorender.materials.mixture import Mixture, spectra_of
from thermorender.physics import sun
from thermorender.physics.band import Emissivity, RadianceTable, quadrature
from thermorender.physics.planck import (
    Floats,
    band_radiance_derivative,
    kelvin_per_radiance,
    spectral_radiance,
)

MOST_NODES = 64
MOST_CHANNELS = 8
REFERENCE_K = 300.0
# Regularisation of the fit of reflected light towards the mean, and number of paths on which its error is measured.
_RIDGE = 1e-4
_JUDGED_PATHS = 48
# Weight of the light's colour (ln of warm over cold Planck spectra) relative to reflectance; on the shipped scenes
# 0.03 … 0.3 need about as many nodes.
_COLOUR_WEIGHT = 0.1
# Size of the sun's image among what channels represent [mK]. It is brighter by orders of magnitude: a tolerance of 5 mK
# is a thousandth of it.
_GLINT_MK = 5000.0
# Tables of materials are piecewise linear with knots every 0.05 µm.
_PANEL_UM = 0.05
# Directions of the sky, and of paths from cameras, from straight up or down to grazing.
_SKY_COSINES = (1.0, 0.5, 0.2, 0.05)
_PATH_COSINES = (1.0, 0.7, 0.4, 0.2, 0.1, 0.03)
_LONGEST_PATH_M = 1e5
# Temperatures handled at a time.
_CHUNK = 256


@dataclass(frozen=True)
class Points:
    """Fine quadrature of a band."""

    wavelength_um: Floats  # (Q,)
    weight: Floats  # (Q,) [µm]
    air: Atmosphere | None
    node: NDArray[np.integer]  # (Q,) the air's node of each point; zeros without air

    @classmethod
    def of(cls, band_um: tuple[float, float], air: Atmosphere | None = None) -> "Points":
        """Return the points of a band, for an Atmosphere in it or for none."""
        if air is None:
            wavelength, weight = quadrature(*band_um)
            return cls(wavelength, weight, None, np.zeros(len(weight), dtype=int))
        parts = [
            quadrature(low, high, int(np.ceil((high - low) / _PANEL_UM - 1e-9)))
            for low, high in zip(air.lower_um, air.upper_um, strict=True)
        ]
        node = np.repeat(np.arange(air.nodes), [len(part[0]) for part in parts])
        wavelength, weight = (np.concatenate(part) for part in zip(*parts, strict=True))
        return cls(wavelength, weight, air, node)

    def planck(self, temperature: ArrayLike) -> Floats:
        """Return a blackbody's radiance at each point, including the weight, (..., Q) [W m⁻² sr⁻¹]."""
        temperature = np.asarray(temperature, dtype=np.float64)
        radiance = spectral_radiance(self.wavelength_um, temperature[..., None]) * self.weight
        return radiance if self.air is None else radiance * self.air.shares(temperature)[..., self.node]

    @cached_property
    def _inside(self) -> Floats:
        """Share of each point in its node's light."""
        black = self.planck(REFERENCE_K)
        return black / np.bincount(self.node, black)[self.node]

    def sunlight(self, at_m: float, cos_zenith: float) -> Floats:
        """Return the sun's irradiance at each point, (Q,) [W m⁻²], through the air above an altitude and normal to its
        rays."""
        assert self.air is not None
        middle = 0.5 * (self.air.lower_um.min() + self.air.upper_um.max())
        share = (1.0 - self.air.cloud_fraction) * self.air.shares(sun.brightness_temperature(middle))
        passed = share * self.air.sun_transmittance(at_m, cos_zenith)
        return sun.irradiance(self.wavelength_um) * self.weight * passed[self.node]

    def spread(self, radiance: Floats) -> Floats:
        """Return radiance of the air's nodes, (..., n), spread over the points as a blackbody's is, (..., Q)."""
        return radiance[..., self.node] * self._inside


@dataclass(frozen=True)
class Spectrum:
    """Nodes and channels of one scene."""

    points: Points
    label: NDArray[np.integer]  # (Q,) node of each point
    emissivity: Floats  # (M, N) Planck-weighted, of each material in each node
    reflected: Floats  # (M, K, N) share of each node's light that each material reflects into each channel
    share: Floats  # (K, N) of each node's light in each channel
    basis: Floats  # (K, n) share of each of the air's nodes in each channel; ones without air
    # (n, K) matrix from a path's transmittance in the air's nodes to the weights of the channels behind it.
    solver: Floats
    # Largest error of the nodes in reflected light, over the envelope's light and some of its paths [mK].
    nodes_mk: float
    channels_mk: float  # the same of the channels in radiance of surfaces, over all paths; 0 without air
    envelope: "Envelope"  # of the scene
    unmixed: "Spectrum | None" = None  # of the parts of mixtures, as by `_pure`; None without mixtures

    @property
    def nodes(self) -> int:
        """Number of nodes N."""
        return self.emissivity.shape[1]

    @property
    def channels(self) -> int:
        """Number of channels K."""
        return len(self.basis)

    def gathered(self, values: Floats) -> Floats:
        """Return sums of (..., Q) values over the points of each node, (..., N)."""
        return _gathered(values, self.label)

    def black(self, temperature: ArrayLike) -> Floats:
        """Return blackbody radiance of each node, (n, N) [W m⁻² sr⁻¹], at temperatures (n,)."""
        temperature = np.asarray(temperature, dtype=np.float64)
        parts = np.split(temperature, range(_CHUNK, len(temperature), _CHUNK))
        return np.concatenate([self.gathered(self.points.planck(part)) for part in parts])

    def of_air(self, radiance: Floats) -> Floats:
        """Return radiance of the air's nodes, (..., n), as radiance of the spectral nodes, (..., N)."""
        return self.gathered(self.points.spread(radiance))

    def of(self, other: "Spectrum") -> Floats:
        """Return a matrix (N', N) that converts radiance at another spectrum's nodes to these, approximately. The light
        of each node is spread as a blackbody's; between different points, the total is."""
        label = other.label if len(other.label) == len(self.label) else np.zeros(len(self.label), int)
        black = self.points.planck(REFERENCE_K)
        shares = np.zeros((int(label.max()) + 1, self.nodes))
        np.add.at(shares, (label, self.label), black / np.bincount(label, black)[label])
        return shares if label is other.label else np.repeat(shares, other.nodes, axis=0)

    def emitted(
        self, emissivity: Emissivity, coldest: float, warmest: float, band_um: tuple[float, float]
    ) -> tuple[Floats, Floats]:
        """Return (temperatures (G,) [K], channels (G, K) [W m⁻² sr⁻¹]) of a material, to interpolate as in
        `RadianceTable.of`."""
        air = self.points.air
        if air is None:
            table = RadianceTable.of(emissivity, coldest, warmest, *band_um)
            return table.temperature, table.radiance[:, None]
        grid = RadianceTable.grid(coldest, warmest)
        bands, band_of = np.unique(np.stack([air.lower_um, air.upper_um], axis=1), axis=0, return_inverse=True)
        ratio = [RadianceTable.ratio(emissivity, coldest, warmest, *band) for band in bands.tolist()]
        nodes = air.planck(grid) * np.stack(ratio, axis=1)[:, band_of.reshape(-1)]
        return grid, nodes @ self.basis.T

    def emitted_at(self, emissivity: Emissivity, temperature: float, band_um: tuple[float, float]) -> Floats:
        """Return the channels (K,) emitted by a material at one temperature [W m⁻² sr⁻¹]."""
        grid, table = self.emitted(emissivity, temperature, temperature, band_um)
        return np.array([np.interp(temperature, grid, channel) for channel in table.T])


@dataclass(frozen=True)
class Envelope:
    """Range of temperatures and light of a scene."""

    band_um: tuple[float, float]
    ground: tuple[float, float]  # coldest and warmest temperature of the terrain [K]
    objects: list[tuple[int, float]]  # (material, temperature [K]), each material at its extremes
    sky_temperature: float | None  # of an isotropic sky [K]; None with air
    surroundings_temperature: float  # [K]
    air: Atmosphere | None
    altitude_m: tuple[float, float]  # of the lowest and the highest surface above sea level
    sun_cosine: float | None = None  # of the sun's zenith angle, where sunlight is included
    glint: bool = False  # whether mirrors show the sun

    @property
    def temperatures(self) -> list[float]:
        """All temperatures [K]."""
        skies = [] if self.sky_temperature is None else [self.sky_temperature]
        own = [temperature for _, temperature in self.objects]
        return [*self.ground, *own, *skies, self.surroundings_temperature]

    def sources(self, points: Points) -> tuple[Floats, Floats, Floats]:
        """Return emission at the points: (outside (n, Q), ground (2, Q), objects (t, Q)). Outside is the sky, sunlight
        with the sky on a face towards the sun, and surroundings; others are blackbodies at the ground's extreme and the
        objects' temperatures."""
        ground = _black(points, self.ground)
        objects = _black(points, [temperature for _, temperature in self.objects]) if self.objects else ground[:0]
        background = _black(points, [self.surroundings_temperature])
        if self.air is None:
            assert self.sky_temperature is not None
            return np.concatenate([_black(points, [self.sky_temperature]), background]), ground, objects
        at, cosine = np.meshgrid(self.altitude_m, _SKY_COSINES)
        sky = points.spread(self.air.sky_radiance(at.ravel(), cosine.ravel()))
        if self.sun_cosine is not None:
            lit = points.sunlight(self.altitude_m[0], self.sun_cosine) / np.pi
            sky = np.concatenate([sky, [sky[0] + lit]])
        return np.concatenate([sky, background]), ground, objects

    def light(self, emissivity: Floats, outside: Floats, ground: Floats, objects: Floats) -> Floats:
        """Return spectra that can fall on a surface of this scene, (n, X), from sources at points or at nodes: the
        outside; ground at its extremes, reflecting the outside or ground at its extremes; objects, reflecting the
        outside. Light reflected from objects is left out, as an object fills a small solid angle."""
        others = np.concatenate([ground, outside])
        light = [outside]
        for own in emissivity:
            light += [own * black + (1.0 - own) * others for black in ground]
        for (material, _), black in zip(self.objects, objects, strict=True):
            light.append(emissivity[material] * black + (1.0 - emissivity[material]) * outside)
        return np.concatenate(light)

    def paths(self) -> Floats:
        """Return transmittances (P, n) of paths from cameras at any height to the surfaces; the first has length 0."""
        if self.air is None:
            return np.ones((1, 1))
        low, high = self.altitude_m
        # The base of clouds may be less than a metre above the surfaces, or on them.
        room = max(self.air.ceiling_m - high, 0.0)
        height = np.minimum(np.geomspace(1.0, max(room, 2.0), 14), room)
        height, cosine, to = (a.ravel() for a in np.meshgrid(height, _PATH_COSINES, (low, high)))
        length = (high + height - to) / cosine
        kept = length <= _LONGEST_PATH_M
        passed = self.air.transmittance(high + height[kept], to[kept], length[kept])
        return np.concatenate([np.ones((1, self.air.nodes)), passed])


def make_spectrum(materials: Sequence[Material], envelope: Envelope, tolerance_mk: float, reflects: bool) -> Spectrum:
    """Return the Spectrum of a scene, with errors up to `tolerance_mk` on the envelope; one node unless it `reflects`,
    and at most MOST_NODES, whose error may be larger.
    A material's reflection of a node's light is not its mean reflectance in the node. It is a least-squares fit, over
    the envelope's light, to the reflection at the points, regularised towards the mean. This corrects most variation
    within a node and needs a third of the nodes."""
    points = Points.of(envelope.band_um, envelope.air)
    pure, shares = _pure(materials)
    spectra, envelope = spectra_at(points, pure), _of_pure(envelope, shares)
    case = _Case(points, spectra, envelope, envelope.paths())
    basis, solver, channels_mk = _channels(case, tolerance_mk)
    label = np.zeros(len(points.node), dtype=int)
    if not reflects:
        return _mixed(case.spectrum(label, basis, solver, channels_mk), shares)
    from scipy.cluster.hierarchy import fcluster, linkage

    tree, wanted = linkage(case.features(), "ward"), case.wanted(basis)
    for count in range(1, MOST_NODES + 1):
        found = case.spectrum(fcluster(tree, count, "maxclust") - 1, basis, solver, channels_mk, wanted)
        if found.nodes_mk <= tolerance_mk:
            break
    return _mixed(found, shares)


def kept_spectrum(
    spectrum: Spectrum, before: Sequence[Material], materials: Sequence[Material], envelope: Envelope
) -> Spectrum | None:
    """Return the Spectrum of other materials with the nodes and channels of `spectrum`, whatever their error; None
    where mixtures come or go."""
    mixed = [any(isinstance(material, Mixture) for material in each) for each in (before, materials)]
    if not any(mixed):
        return _kept(spectrum, before, materials, envelope)
    if not all(mixed) or spectrum.unmixed is None:
        return None
    (old, _), (new, shares) = _pure(before), _pure(materials)
    return _mixed(_kept(spectrum.unmixed, old, new, _of_pure(envelope, shares)), shares)


def _kept(
    spectrum: Spectrum, before: Sequence[Material], materials: Sequence[Material], envelope: Envelope
) -> Spectrum:
    """As `kept_spectrum`, without mixtures."""
    points, paths, channels_mk = spectrum.points, envelope.paths(), 0.0
    spectra, old = (spectra_at(points, each) for each in (materials, before))
    fits = spectrum.label, spectrum.basis, spectrum.solver
    if envelope.air is not None:
        case = _Case(points, spectra, envelope, paths)
        channels_mk = _worst_mk(case, _shown(case), *fits[1:])
    found = [(kept, row) for kept, own in enumerate(spectra) for row in np.flatnonzero((old == own).all(axis=1))[:1]]
    kept, row = np.array(found, dtype=int).reshape(-1, 2).T
    reflected = np.zeros((len(spectra), *spectrum.reflected.shape[1:]))
    reflected[kept] = spectrum.reflected[row]
    # Only what new materials reflect, and what reflects their light, has another error; in other light all has.
    new, reach = np.setdiff1d(np.arange(len(spectra)), kept), spectrum.nodes_mk
    if envelope != spectrum.envelope:
        new, reach = np.arange(len(spectra)), 0.0
    if len(new):
        case = _Case(points, spectra[new], envelope, paths, spectra)
        made = case.spectrum(*fits, channels_mk, case.wanted(spectrum.basis))
        fresh = np.isin(new, kept, invert=True)
        reflected[new[fresh]], reach = made.reflected[fresh], max(reach, made.nodes_mk)
    objects = [(int(np.flatnonzero(new == m)[0]), kelvin) for m, kelvin in envelope.objects if m in new]
    case = _Case(points, spectra, replace(envelope, objects=objects), paths, spectra[new])
    made = case.spectrum(*fits, channels_mk, case.wanted(spectrum.basis), reflected)
    return replace(made, envelope=envelope, nodes_mk=max(reach, made.nodes_mk))


def spectra_at(points: Points, materials: Sequence[Material]) -> Floats:
    """Return the emissivity of each material at the points, (M, Q)."""
    return np.array([material.emissivity_at(points.wavelength_um) for material in materials])


def with_nodes(spectrum: Spectrum, materials: Sequence[Material], count: int) -> Spectrum:
    """Return a Spectrum with about `count` nodes, equal parts of its points by wavelength, to measure the time of
    nodes."""
    points = spectrum.points
    label = np.arange(len(points.node)) * min(count, len(points.node)) // len(points.node)
    emissivity, reflected, share = _means(points, spectra_at(points, materials), spectrum.basis, label)
    return replace(spectrum, label=label, emissivity=emissivity, reflected=reflected, share=share)


def _pure(materials: Sequence[Material]) -> tuple[list[Material], Floats]:
    """(the P materials that these are mixed of, fraction of each in every material (M, P)). A mixture emits and
    reflects the mean of its parts, so its error is at most the largest of theirs."""
    pure = list(dict.fromkeys(part for material in materials for part, _ in spectra_of(material)))
    shares = np.zeros((len(materials), len(pure)))
    for row, material in zip(shares, materials, strict=True):
        for part, share in spectra_of(material):
            row[pure.index(part)] += share
    return pure, shares


def _mixed(spectrum: Spectrum, shares: Floats) -> Spectrum:
    """The Spectrum of mixtures from that of their parts."""
    reflected = np.einsum("mp,pkn->mkn", shares, spectrum.reflected)
    unmixed = None if len(shares) == shares.shape[1] and (shares == np.eye(len(shares))).all() else spectrum
    return replace(spectrum, emissivity=shares @ spectrum.emissivity, reflected=reflected, unmixed=unmixed)


def _of_pure(envelope: Envelope, shares: Floats) -> Envelope:
    """An Envelope whose objects are of the parts of their materials."""
    mixed = [(int(part), kelvin) for number, kelvin in envelope.objects for part in np.flatnonzero(shares[number])]
    return replace(envelope, objects=list(dict.fromkeys(mixed)))


class _Case:
    """A scene's envelope at the points: light, reflections, and radiance per mK; `spectra` reflect and `glowing`
    emit."""

    def __init__(
        self, points: Points, spectra: Floats, envelope: Envelope, passed: Floats, glowing: Floats | None = None
    ) -> None:
        self.points, self.spectra, self.envelope, self.passed = points, spectra, envelope, passed
        self.glowing = spectra if glowing is None else glowing
        self.black = points.planck(REFERENCE_K)
        self.sources = envelope.sources(points)
        self.light = envelope.light(self.glowing, *self.sources)

    @cached_property
    def per_mk(self) -> Floats:
        """Radiance per millikelvin of each surface at its coldest, reflecting each light, (M, L), by `_kelvin`."""
        coldest = self.sources[1][0]
        shown = (1.0 - self.spectra) @ self.light.T + (self.spectra @ coldest)[:, None]
        return 1e-3 / _kelvin(shown, self.envelope.band_um)

    def wanted(self, basis: Floats) -> Floats:
        """Reflection of each light by each material into each channel, (M, K, L)."""
        return np.stack([(1.0 - self.spectra) * row[self.points.node] @ self.light.T for row in basis], axis=1)

    def features(self) -> Floats:
        """Quantities that the points of one node should have in common, (Q, n)."""
        points, envelope, spectra = self.points, self.envelope, self.spectra
        warmest, coldest = max(envelope.temperatures), min(envelope.ground)
        colour = np.log(
            spectral_radiance(points.wavelength_um, warmest) / spectral_radiance(points.wavelength_um, coldest)
        )
        features = [*(1.0 - spectra), _COLOUR_WEIGHT * (colour - colour.mean())]
        if envelope.air is not None:
            # The sky counts by the share reflected. The air's transmittance has little effect.
            sky = self.sources[0][: len(_SKY_COSINES) * 2] / self.black
            features += [*((1.0 - spectra).mean(axis=1).max() * sky[[0, -1]])]
            if envelope.sun_cosine is not None:
                # By its logarithm, as sunlight exceeds a blackbody's light by orders of magnitude.
                lit = np.log1p(self.sources[0][-2] / self.black)
                features.append(_COLOUR_WEIGHT * (lit - lit.mean()))
        return np.stack(features, axis=1)

    def spectrum(
        self, label: NDArray[np.integer], basis: Floats, solver: Floats, channels_mk: float,
        wanted: Floats | None = None, known: Floats | None = None,
    ) -> Spectrum:  # fmt: skip
        """Return the Spectrum of nodes, with a fit to the reflections `wanted` where given; `known` replaces the
        fit."""
        emissivity, reflected, share = _means(self.points, self.spectra, basis, label)
        nodes_mk = 0.0
        if wanted is not None:
            # The bake solves for light at nodes, reflected with mean reflectances.
            glowing = _means(self.points, self.glowing, basis, label)[0]
            light = self.envelope.light(glowing, *(_gathered(source, label) for source in self.sources))
            if known is None:
                missing = (wanted - reflected @ light.T) / self.per_mk.min(axis=0)
                left, size, right = np.linalg.svd(light / self.per_mk.min(axis=0)[:, None], full_matrices=False)
                damped = size / (size**2 + (_RIDGE * size[0]) ** 2)
                known = reflected + missing @ left * damped @ right
            reflected = known
            left_over = (wanted - reflected @ light.T) / self.per_mk[:, None]
            weights = self.passed[:: max(1, len(self.passed) // _JUDGED_PATHS)] @ solver
            nodes_mk = float(np.abs(np.einsum("pk,mkl->pml", weights, left_over, optimize=True)).max())
        return Spectrum(
            self.points, label, emissivity, reflected, share, basis, solver, nodes_mk, channels_mk, self.envelope
        )  # fmt: skip


def _channels(case: _Case, tolerance_mk: float) -> tuple[Floats, Floats, float]:
    """(basis (K, n), solver (n, K), largest error [mK]) that represent the envelope's paths."""
    if case.envelope.air is None:
        return np.ones((1, 1)), np.ones((1, 1)), 0.0
    shown = _shown(case)
    square = shown.T @ shown
    size, axes = np.linalg.eigh(square)
    left, size, _ = np.linalg.svd(case.passed @ (axes * np.sqrt(np.maximum(size, 0.0))), full_matrices=False)
    for count in range(1, MOST_CHANNELS + 1):
        basis = np.linalg.lstsq(left[:, :count] * size[:count], case.passed, rcond=None)[0]
        # Scaled to the size of a radiance, to keep their digits in float32.
        basis /= np.abs(basis).max(axis=1, keepdims=True)
        solver = square @ basis.T @ np.linalg.pinv(basis @ square @ basis.T)
        worst = _worst_mk(case, shown, basis, solver)
        if worst <= tolerance_mk:
            break
    return basis, solver, worst


def _shown(case: _Case) -> Floats:
    """Radiance of surfaces in the air's nodes [mK]."""
    # Radiance of surfaces: each at the extremes of the ground, or at its own temperature, reflecting any light.
    ground, objects = case.sources[1:]
    own = [(m, black) for m in range(len(case.spectra)) for black in ground]
    own += [(m, black) for (m, _), black in zip(case.envelope.objects, objects, strict=True)]
    node = case.points.node
    reflected = [_gathered((1.0 - emissivity) * case.light, node) for emissivity in case.spectra]
    shown = np.concatenate([_gathered(case.spectra[m] * black, node) + reflected[m] for m, black in own])
    shown = np.asarray(shown * (1e3 * _kelvin(shown.sum(axis=1), case.envelope.band_um)[:, None]))
    if not case.envelope.glint:
        return shown
    assert case.envelope.sun_cosine is not None
    lit = _gathered(case.points.sunlight(case.envelope.altitude_m[0], case.envelope.sun_cosine), node)
    return np.concatenate([shown, [lit * (_GLINT_MK / lit.sum())]])


def _worst_mk(case: _Case, shown: Floats, basis: Floats, solver: Floats) -> float:
    """Largest error of channels in `shown` radiance behind the envelope's paths [mK]."""
    return float(np.abs((case.passed @ solver @ basis - case.passed) @ shown.T).max())


def _kelvin(radiance: Floats, band_um: tuple[float, float]) -> Floats:
    """d(brightness temperature)/d(band radiance) [K W⁻¹ m² sr]; below 300 K that of 300 K, as budgets are in mK at 300
    K."""
    coldest = 1.0 / band_radiance_derivative(REFERENCE_K, *band_um)
    return np.minimum(kelvin_per_radiance(radiance, *band_um), coldest)


def _means(points: Points, spectra: Floats, basis: Floats, label: NDArray[np.integer]) -> tuple[Floats, Floats, Floats]:
    """Planck-weighted (emissivity (M, N), reflected (M, K, N), share (K, N)) of nodes, as in `Spectrum`."""
    black = points.planck(REFERENCE_K)
    inside = black / np.bincount(label, black)[label]
    channels = basis[:, points.node] * inside
    reflected = _gathered((1.0 - spectra)[:, None] * channels, label)
    return _gathered(spectra * inside, label), reflected, _gathered(channels, label)


def _black(points: Points, temperatures: Sequence[float]) -> Floats:
    """Blackbody radiance at the points, (n, Q); zeros at 0 K."""
    return np.stack([points.planck(t) if t > 0.0 else np.zeros(len(points.node)) for t in temperatures])


def _gathered(values: Floats, label: NDArray[np.integer]) -> Floats:
    """Sums of (..., Q) values over the points of each node, (..., N)."""
    order = np.argsort(label, kind="stable")
    first = np.flatnonzero(np.diff(label[order], prepend=-1))
    return np.add.reduceat(values[..., order], first, axis=-1)
