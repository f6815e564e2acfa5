"""What a scene needs and what it does not: spectral nodes, bake, samples; each choice with its bound in mK.

Emission is tabulated per material with the full spectral integral, so it needs no nodes. Reflection couples the
reflectance of one surface with the spectrum of its surroundings; it is solved at nodes, as few as keep its error
below the tolerance on the scene's own materials and temperatures. A node is a set of wavelengths, not necessarily
neighbours, at which every material of the scene has nearly the same reflectance and its light nearly the same
colour: Ward's clustering (1963, doi:10.1080/01621459.1963.10500845) of a fine quadrature finds them.
"""

from dataclasses import dataclass

import numpy as np

from thermorender.errors import ThermorenderError
from thermorender.physics.band import quadrature
from thermorender.physics.planck import band_radiance_derivative, brightness_temperature, spectral_radiance
from thermorender.render.sampling import PATTERNS, STAGES

# Rays per pixel, texture places per ray, and the error from which on an edge pixel gets more rays [mK].
QUALITIES = {"fast": (1, 2, 500.0), "standard": (1, 4, 140.0), "high": (4, 4, 25.0)}
MOST_NODES = 64
# How much the light's colour (ln of warm over cold Planck spectra) counts beside reflectance; found on the shipped
# scenes, where 0.03 … 0.3 need about as many nodes.
_COLOUR_WEIGHT = 0.1
REFERENCE_K = 300.0


@dataclass(frozen=True)
class Plan:
    """The choices for one scene.

    Attributes
    ----------
    band_um : (2,) floats
    node_weight : (N, W) float64
        Quadrature weights of the wavelengths in each node [µm]; zero for those in another node.
    wavelength_um : (W,) float64
    emissivity : (M, N) float64
        Planck-weighted emissivity of each material in each node.
    nodes_mk : float
        Worst error of the nodes on this scene's envelope [mK].
    reflection_mk : float
        Most that reflection can change any pixel's apparent temperature [mK].
    bake : bool
        Whether reflection is solved at all.
    rays : int
        Rays per face of the bake.
    samples, taps : int
        Rays per pixel, and places per ray at which the texture is read.
    edge_mk : float
        Error of a pixel that shows an edge from which on it gets more rays [mK]; infinite: never.
    coldest, warmest : float
        Temperatures of the scene, its sky and surroundings [K].
    moving : int
        Objects with a track.
    """

    band_um: tuple
    node_weight: np.ndarray
    wavelength_um: np.ndarray
    emissivity: np.ndarray
    nodes_mk: float
    reflection_mk: float
    bake: bool
    rays: int
    samples: int
    taps: int
    edge_mk: float
    coldest: float
    warmest: float
    moving: int = 0

    @property
    def nodes(self):
        """Number of spectral nodes."""
        return len(self.node_weight)

    def node_radiance(self, temperature):
        """Return blackbody radiance of each node, (len(temperature), N) [W m⁻² sr⁻¹]."""
        temperature = np.asarray(temperature, dtype=np.float64)
        return spectral_radiance(self.wavelength_um, temperature[:, None]) @ self.node_weight.T

    def rows(self):
        """Return the plan as (item, in or out, why) rows for a table."""
        needed = "in" if self.bake else "out"
        moving = ("moving objects", "out", "none has a track")
        if self.moving:
            moving = (moving[0], str(self.moving), "cast in their own frames; their light by one bounce each way")
        edges = ("more rays at edges", "out", "edge_mk is infinite")
        if self.edge_mk < np.inf:
            edges = (edges[0], "in", f"up to {STAGES[-1]} where one surface hides another and errs {self.edge_mk:g} mK")
        return [
            ("emission", "in", f"full spectral integral per material, {self.coldest:.1f}–{self.warmest:.1f} K"),
            ("reflection", needed, f"changes a pixel by at most {_kelvin(self.reflection_mk)}"),
            ("spectral nodes", str(self.nodes if self.bake else 0), f"worst error {self.nodes_mk:.3g} mK"),
            ("bake rays per face", str(self.rays if self.bake else 0), "sky visibility and inter-reflection"),
            ("rays per pixel", str(self.samples), "band radiance averaged, never temperature"),
            ("texture places per ray", str(self.taps), "on the plane of the face that is hit"),
            edges,
            moving,
            ("air", "out", "this scene declares none"),
            ("specular rays", "out", "every material is Lambertian"),
        ]

    def as_dict(self):
        """Return the plan as plain numbers, for the record beside each frame."""
        return {
            "band_um": list(self.band_um),
            "nodes": self.nodes if self.bake else 0,
            "nodes_mk": round(self.nodes_mk, 4),
            "reflection_mk": round(self.reflection_mk, 4),
            "bake_rays": self.rays if self.bake else 0,
            "samples": self.samples,
            "taps": self.taps,
            "edge_mk": self.edge_mk if self.edge_mk < np.inf else None,
        }


def make_plan(scene, quality="standard", samples=None, taps=None, edge_mk=None, rays=128, tolerance_mk=5.0):
    """Return the Plan of a scene.

    Parameters
    ----------
    scene : Scene
    quality : {"fast", "standard", "high"}
        Names the three numbers that follow.
    samples, taps : int, optional
        Rays per pixel and texture places per ray (1, 2, 4, 8 or 16) in place of the quality's own.
    edge_mk : float, optional
        Error from which on a pixel that shows an edge gets more rays [mK], in place of the quality's own; infinite:
        never.
    rays : int
        Rays per face for the bake.
    tolerance_mk : float
        Worst error allowed to the spectral nodes [mK]; reflection that changes no pixel by more than a tenth of
        it is left out.

    Raises
    ------
    ThermorenderError
        A setting out of range.
    """
    if quality not in QUALITIES:
        raise ThermorenderError(f"quality={quality!r} is unknown; give one of {', '.join(QUALITIES)}")
    given = (samples, taps, edge_mk)
    samples, taps, edge_mk = (a if b is None else b for a, b in zip(QUALITIES[quality], given, strict=True))
    for name, value in (("samples", samples), ("taps", taps)):
        if value not in PATTERNS:
            allowed = ", ".join(map(str, sorted(PATTERNS)))
            raise ThermorenderError(f"{name}={value} is not allowed; give one of {allowed}")
    if not edge_mk > 0.0:
        raise ThermorenderError(f"edge_mk={edge_mk:g} is not allowed; give a number of mK above 0, or inf for none")
    if not 1 <= rays <= 65536:
        raise ThermorenderError(f"rays={rays} is not allowed; give 1…65536 rays per face")
    if not tolerance_mk > 0.0:
        raise ThermorenderError(f"tolerance_mk={tolerance_mk:g} is not allowed; give a number of mK above 0")
    from scipy.cluster.hierarchy import linkage

    band = scene.camera.band_um
    terrain, objects = scene.surfaces[: scene.terrain_count], scene.surfaces[scene.terrain_count :]
    ground = [float(limit(surface.temperature)) for surface in terrain for limit in (np.min, np.max)]
    outside = [scene.spec.sky_temperature, scene.surroundings_temperature]
    things = [
        (int(material), float(limit(surface.temperature[surface.material == material])))
        for surface in objects
        for material in np.unique(surface.material)
        for limit in (np.min, np.max)
    ]
    things += [
        (int(surface.material.flat[0]), temperature)
        for mover in scene.movers
        for surface in mover.surfaces
        for temperature in mover.temperatures()
    ]
    every = [*ground, *outside, *(temperature for _, temperature in things)]
    coldest, warmest = min(every), max(every)
    wavelength, weight = quadrature(*band)
    spectra = np.array([material.emissivity_at(wavelength) for material in scene.materials])
    derivative = band_radiance_derivative(REFERENCE_K, *band)
    colour = np.log(spectral_radiance(wavelength, warmest) / spectral_radiance(wavelength, min(ground)))
    features = np.vstack([1.0 - spectra, _COLOUR_WEIGHT * (colour - colour.mean())]).T
    brightest = spectral_radiance(wavelength, warmest)
    reflection_mk = float(((1.0 - spectra) * brightest @ weight).max() / derivative * 1e3)
    bake = reflection_mk > 0.1 * tolerance_mk
    light = _light(spectra, wavelength, (min(ground), max(ground)), outside, things)
    exact = ((1.0 - spectra) * weight) @ light.T
    # A kelvin of apparent temperature, where the surface shows this light besides its own at its coldest.
    shown = exact + (spectra * weight) @ spectral_radiance(wavelength, min(ground))[:, None]
    per_kelvin = band_radiance_derivative(brightness_temperature(shown, *band), *band)
    tree = linkage(features, "ward")
    for count in range(1, MOST_NODES + 1) if bake else (1,):
        node_weight, emissivity = _nodes(tree, count, spectra, wavelength, weight)
        split = (1.0 - emissivity) @ (node_weight @ light.T)
        nodes_mk = float((np.abs(split - exact) / per_kelvin).max() * 1e3) if bake else 0.0
        if nodes_mk <= tolerance_mk:
            break
    else:
        raise ThermorenderError(
            f"tolerance_mk={tolerance_mk:g} is not reached with {MOST_NODES} spectral nodes ({nodes_mk:.3g} mK "
            "remain); give a larger tolerance"
        )
    return Plan(
        band_um=tuple(band),
        node_weight=node_weight,
        wavelength_um=wavelength,
        emissivity=emissivity,
        nodes_mk=nodes_mk,
        reflection_mk=reflection_mk,
        bake=bake,
        rays=rays,
        samples=samples,
        taps=taps,
        edge_mk=float(edge_mk),
        coldest=coldest,
        warmest=warmest,
        moving=len(scene.movers),
    )


def _kelvin(millikelvin):
    return f"{millikelvin * 1e-3:.3g} K" if millikelvin >= 1e3 else f"{millikelvin:.3g} mK"


def _nodes(tree, count, spectra, wavelength, weight):
    """(quadrature weights (N, W), Planck-weighted emissivity (M, N)) of at most `count` nodes."""
    from scipy.cluster.hierarchy import fcluster

    label = fcluster(tree, count, "maxclust") - 1
    node_weight = np.where(label == np.arange(label.max() + 1)[:, None], weight, 0.0)
    planck = node_weight * spectral_radiance(wavelength, REFERENCE_K)
    return node_weight, (spectra @ planck.T) / planck.sum(axis=1)


def _light(spectra, wavelength, ground, outside, things):
    """Spectra that can fall on a surface of this scene, (n, W).

    The outside; any material of the ground at its extremes, reflecting the outside or ground at its extremes; and
    objects (material, temperature), reflecting the outside. Light of an object off another surface is left out:
    it is weakened by the small solid angle of one seen from the other.
    """

    def black(temperature):
        return spectral_radiance(wavelength, temperature) if temperature > 0.0 else np.zeros_like(wavelength)

    light = [black(temperature) for temperature in outside]
    for emissivity in spectra:
        for own in ground:
            light += [emissivity * black(own) + (1.0 - emissivity) * black(other) for other in (*ground, *outside)]
    for material, own in set(things):
        light += [spectra[material] * black(own) + (1.0 - spectra[material]) * black(other) for other in outside]
    return np.array(light)
