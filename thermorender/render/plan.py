"""The plan of a scene: spectral nodes, bake, air and samples, each choice with its error in mK."""

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from thermorender.atmosphere.model import HIGHEST_CAMERA_M, LOWEST_M
from thermorender.errors import ThermorenderError
from thermorender.materials.extended import Assumption, assumptions
from thermorender.physics.band import quadrature
from thermorender.physics.planck import band_radiance, band_radiance_derivative, spectral_radiance
from thermorender.physics.sun import irradiance
from thermorender.render.pixels.sampling import STAGES
from thermorender.render.quality import Sampling
from thermorender.render.reflection.reflectance import ReflectanceTables, directional, make_tables
from thermorender.render.spectrum import REFERENCE_K, Envelope, Spectrum, kept_spectrum, make_spectrum
from thermorender.scene.crowns import Crowns
from thermorender.scene.instances import PATCHES, Instances
from thermorender.scene.scene import Scene


# Compared by identity: its spectrum holds arrays.
@dataclass(frozen=True, eq=False)
class Plan:
    """The choices for one scene."""

    band_um: tuple[float, float]  # (2,) floats
    sampling: Sampling
    spectrum: Spectrum  # Nodes at which light between surfaces is solved, and channels of a texel
    # Upper bound of the light reflected by diffuse surfaces, without sunlight: as if their whole surroundings were as
    # bright as the warmest of the scene's surfaces, sky and air [mK at 300 K]
    reflection_mk: float
    bake: bool  # Whether reflection is solved
    # coldest, warmest: Temperatures of the scene, its sky and surroundings [K]
    coldest: float
    warmest: float
    dynamic: int  # Number of objects with a track
    # Change of a surface of 300 K behind a kilometre of the scene's air [mK]; None without air
    air_mk: float | None
    # Upper bound of sunlight in the camera's band reflected by any diffuse surface, facing the sun above the air [mK
    # at 300 K]; None where the scene declares no sun
    sun_mk: float | None
    sun: bool  # Whether sunlight is included
    # Estimate from above of the effect of the angle of view on directional materials, up to 80° [mK at 300 K]; None
    # without such materials
    specular_mk: float | None
    specular: ReflectanceTables | None  # How such materials reflect; None where mirror rays are left out
    # Parts of the band where a material was not measured, and one standard deviation of the effect on a surface of
    # 300 K under the scene's sky [mK]
    assumed: tuple[tuple[Assumption, float], ...] = ()
    inferred: tuple[str, ...] = ()  # Parts of a mesh and objects whose shape nobody has seen
    # copies, bodies: Copies of bodies, and bodies that they are copies of
    copies: int = 0
    bodies: int = 0
    crowns: int = 0  # Bodies of leaves that light passes in part
    columns: int = 0  # Texels and faces whose heat balance is solved; 0 where temperatures come from elsewhere
    heated: int = 0  # Objects among them

    def __repr__(self) -> str:
        air = "no air" if self.air_mk is None else f"air in {self.spectrum.channels} channels"
        return (
            f"Plan({self.band_um[0]:g}–{self.band_um[1]:g} µm, {self.nodes} nodes, "
            f"{self.sampling.rays if self.bake else 0} rays per face, {self.sampling.samples} per pixel, tolerance "
            f"{self.sampling.tolerance_mk:g} mK, {air}, {self.coldest:.1f}–{self.warmest:.1f} K)"
        )

    def __str__(self) -> str:
        return "\n".join(["plan", *(f"  {item:<22}{value:<14}{why}" for item, value, why in self.rows())])

    @cached_property
    def radiance_per_mk(self) -> float:
        """Band radiance of a millikelvin at the reference temperature [W m⁻² sr⁻¹ mK⁻¹]."""
        return float(band_radiance_derivative(REFERENCE_K, *self.band_um)) * 1e-3

    @property
    def nodes(self) -> int:
        """Number of spectral nodes solved, 0 where reflection is left out."""
        return self.spectrum.nodes if self.bake else 0

    @property
    def beyond_tolerance(self) -> str | None:
        """A warning if the most spectral nodes err by more than the tolerance, else None."""
        error, tolerance = self.spectrum.nodes_mk, self.sampling.tolerance_mk
        if error <= tolerance:
            return None
        return (
            f"tolerance_mk={tolerance:g} is not reached with {self.nodes} spectral nodes: up to {error:.3g} mK remain, "
            f"which the error budget counts; --tolerance-mk {math.ceil(error)} accepts them"
        )

    def rows(self) -> list[tuple[str, str, str]]:
        """Return the plan as (item, in or out, reason) rows for a table."""
        needed = "in" if self.bake else "out"
        dynamic = ("dynamic objects", "out", "none has a track")
        if self.dynamic:
            dynamic = (dynamic[0], str(self.dynamic), "cast in their own frames; light by one bounce each way")
        nodes = f"error up to {self.spectrum.nodes_mk:.3g} mK on the scene's envelope"
        if self.beyond_tolerance:
            nodes += f", above the tolerance of {self.sampling.tolerance_mk:g} mK"
        edges = ("more rays at edges", "out", "edge_mk is infinite")
        if self.sampling.edge_mk < np.inf:
            edges = (edges[0], "in", f"up to {STAGES[-1]} where an edge's error exceeds {self.sampling.edge_mk:g} mK")
        return [
            ("emission", "in", f"full spectral integral per material, {self.coldest:.1f}–{self.warmest:.1f} K"),
            ("reflection", needed, f"adds at most {_kelvin(self.reflection_mk)} to a diffuse surface at 300 K"),
            ("spectral nodes", str(self.nodes), nodes),
            ("bake rays per face", str(self.sampling.rays if self.bake else 0), "sky visibility and inter-reflection"),
            ("rays per pixel", str(self.sampling.samples), "band radiance averaged, never temperature"),
            (
                "texture taps per ray",
                str(self.sampling.taps),
                "on the plane of the face hit; 16 in a pixel of many texels",
            ),
            edges,
            dynamic,
            *self._air_rows(),
            self._specular_row(),
            *self._assumed_rows(),
            *self._heat_rows(),
            *[(name, "inferred", "nobody has seen its shape; flagged in the truth mask") for name in self.inferred],
            *self._copies_rows(),
            *self._crowns_rows(),
        ]

    def _heat_rows(self) -> list[tuple[str, str, str]]:
        if not self.columns:
            return []
        objects = (
            "" if not self.heated else " and of 1 object" if self.heated == 1 else f" and of {self.heated} objects"
        )
        why = f"texels and faces of the terrain{objects}, whose heat balance is solved"
        return [("heat columns", str(self.columns), why)]

    def _copies_rows(self) -> list[tuple[str, str, str]]:
        if not self.copies:
            return []
        of = "1 body" if self.bodies == 1 else f"{self.bodies} bodies"
        why = f"of {of}; a copy has the light and temperatures of at most {PATCHES} groups of triangles"
        return [("copies", str(self.copies), f"{why}, whose scatter is in the bake's error")]

    def _crowns_rows(self) -> list[tuple[str, str, str]]:
        if not self.crowns:
            return []
        why = "bodies of leaves that light passes by Beer's law; a ray takes two more casts for each that it meets"
        return [("crowns", str(self.crowns), why)]

    def _assumed_rows(self) -> list[tuple[str, str, str]]:
        return [
            (
                one.material,
                "assumed",
                f"{one.limits_um[0]:g}–{one.limits_um[1]:g} µm, {one.share:.0%} of the band, from similar materials: "
                f"± {_kelvin(effect_mk)} at 300 K",
            )
            for one, effect_mk in self.assumed
        ]

    def _specular_row(self) -> tuple[str, str, str]:
        if self.specular_mk is None:
            return ("specular rays", "out", "every material is Lambertian")
        why = f"change directional materials by an estimated {_kelvin(self.specular_mk)}"
        if self.specular is None:
            return ("specular rays", "out", why)
        return ("specular rays", "in", f"{why}; error up to {self.specular.error_mk:.3g} mK on the envelope")

    def _air_rows(self) -> list[tuple[str, str, str]]:
        """Rows of the atmosphere."""
        if self.air_mk is None:
            return [("air", "out", "this scene declares none")]
        spectrum = self.spectrum
        why = f"a kilometre changes 300 K by {_kelvin(self.air_mk)}; error of the channels up to "
        sun = "this scene declares none"
        if self.sun_mk is not None:
            sun = "below the horizon"
            if self.sun_mk:
                sun = f"adds at most {_kelvin(self.sun_mk)} to a diffuse surface at 300 K"
        return [
            ("air", f"{spectrum.channels} channels", f"{why}{spectrum.channels_mk:.3g} mK"),
            ("air between surfaces", "out", "in reflected light; included in the light's error"),
            ("sun", "in" if self.sun else "out", sun),
        ]

    def as_dict(self) -> dict[str, Any]:
        """Return the plan as plain numbers, for the record beside each frame."""
        return {
            "band_um": list(self.band_um),
            "tolerance_mk": self.sampling.tolerance_mk,
            "nodes": self.nodes,
            "nodes_mk": round(self.spectrum.nodes_mk, 4),
            "reflection_mk": round(self.reflection_mk, 4),
            "bake_rays": self.sampling.rays if self.bake else 0,
            "samples": self.sampling.samples,
            "taps": self.sampling.taps,
            "edge_mk": self.sampling.edge_mk if self.sampling.edge_mk < np.inf else None,
            "channels": self.spectrum.channels,
            "channels_mk": round(self.spectrum.channels_mk, 4),
            "sun": self.sun,
            "specular": self.specular is not None,
        } | ({"assumed_mk": {one.material: round(effect, 4) for one, effect in self.assumed}} if self.assumed else {})


def make_plan(scene: Scene, sampling: Sampling | None = None, kept: "tuple[Plan, Scene] | None" = None) -> Plan:
    """Return the Plan of a scene; of standard quality without a Sampling. `kept` is (Plan, Scene) before an edit of
    materials or temperatures, whose nodes and channels stay, whatever their error."""
    sampling = sampling or Sampling.of()
    scene.refuse_disagreement()
    scene.refuse_unsolved()
    band = scene.camera.band_um
    envelope = _envelope(scene)
    coldest, warmest = min(envelope.temperatures), max(envelope.temperatures)
    wavelength, weight = quadrature(*band)
    reflectance = np.array([1.0 - material.emissivity_at(wavelength) for material in scene.materials])
    per_mk = band_radiance_derivative(REFERENCE_K, *band) * 1e-3
    # With air the sky may be warmer than all surfaces, but not than the warmest air.
    brightest = max([warmest, *([] if scene.air is None else [scene.air.temperature.max()])])
    reflection_mk = float((reflectance @ (spectral_radiance(wavelength, brightest) * weight)).max() / per_mk)
    bake = reflection_mk > 0.1 * sampling.tolerance_mk
    air_mk = sun_mk = None
    if scene.air is not None:
        refuse_surfaces(scene)
        below = scene.altitude_m
        passed, added = (values[0] for values in scene.air.path(below, below, [1000.0]))
        arrives = passed @ scene.air.planck(REFERENCE_K) + added.sum()
        air_mk = abs(float(arrives - band_radiance(REFERENCE_K, *band))) / per_mk
    if scene.sun is not None:
        height = np.sin(np.radians(scene.sun.elevation_deg))
        light = irradiance(wavelength) / np.pi * (height > 0.0)
        sun_mk = float((reflectance @ (light * weight)).max() / per_mk)
        # Mirrors show its image, however little it adds to diffuse light.
        mirrors = sun_mk > 0.0 and bool(directional(scene.materials))
        if mirrors or sun_mk > 0.1 * sampling.tolerance_mk:
            envelope = replace(envelope, sun_cosine=float(height), glint=mirrors)
    spectrum = None
    if kept is not None and bake and kept[0].bake:
        spectrum = kept_spectrum(kept[0].spectrum, kept[1].materials, scene.materials, envelope)
    if spectrum is None:
        spectrum = make_spectrum(scene.materials, envelope, sampling.tolerance_mk, bake)
    specular = make_tables(scene, spectrum, envelope)
    bodies = [surface.instances for surface in scene.surfaces]
    copies = [each for each in bodies if isinstance(each, Instances)]
    solved = scene.surfaces[: scene.solved_count] if scene.balanced else ()
    return Plan(
        band_um=band,
        sampling=sampling,
        spectrum=spectrum,
        reflection_mk=reflection_mk,
        bake=bake,
        coldest=coldest,
        warmest=warmest,
        dynamic=len(scene.tracked_objects),
        air_mk=air_mk,
        sun_mk=sun_mk,
        sun=envelope.sun_cosine is not None,
        specular_mk=specular.effect_mk if specular else None,
        specular=specular if specular and specular.effect_mk > 0.1 * sampling.tolerance_mk else None,
        assumed=_assumed(scene, per_mk),
        inferred=(
            *(one.name for one in scene.spec.surfaces if one.inferred),
            *(one.name for one in scene.spec.objects if one.inferred),
        ),
        copies=sum(map(len, copies)),
        bodies=len(copies),
        crowns=sum(len(each) for each in bodies if isinstance(each, Crowns)),
        columns=sum(surface.material.size + len(surface.faces) for surface in solved),
        heated=len({each.name.split(":")[0] for each in solved[scene.terrain_count :]}),
    )


def _assumed(scene: Scene, per_mk: float) -> tuple[tuple[Assumption, float], ...]:
    """Assumptions on the scene's materials, each with its effect [mK at 300 K]."""
    band = scene.camera.band_um
    contrast = abs(float(band_radiance(REFERENCE_K, *band) - band_radiance(scene.sky_temperature, *band)))
    found = [one for material in scene.materials for one in assumptions(material, band)]
    return tuple((one, one.emissivity_std * contrast / float(per_mk)) for one in found)


def refuse_surfaces(scene: Scene) -> None:
    """Raise for surfaces of a scene outside the range of its air."""
    if scene.air is None:
        return
    low, high = _altitudes_m(scene)
    if low < LOWEST_M or high > HIGHEST_CAMERA_M:
        raise ThermorenderError(
            f"{scene.where}: surfaces are at {low:.7g} … {high:.7g} m above sea level, outside the range of the air; "
            f"give −{-LOWEST_M:.0f} … {HIGHEST_CAMERA_M:.0f} m by the terrain's heights or altitude_m of [atmosphere]"
        )


def _altitudes_m(scene: Scene) -> tuple[float, float]:
    """Altitudes of the lowest and the highest surface above sea level [m]."""
    height = [float(limit(surface.heights_m())) for surface in scene.surfaces for limit in (np.min, np.max)]
    return scene.altitude_m + min(height), scene.altitude_m + max(height)


def _envelope(scene: Scene) -> Envelope:
    """The Envelope of a scene."""
    terrain, static = scene.surfaces[: scene.terrain_count], scene.surfaces[scene.terrain_count :]
    ground = [float(limit(surface.temperature)) for surface in terrain for limit in (np.min, np.max)]
    own: dict[int, list[float]] = {}
    for surface in static:
        for material in np.unique(surface.material):
            own.setdefault(int(material), []).extend(surface.temperature[surface.material == material].ravel())
    for tracked in scene.tracked_objects:
        for surface in tracked.surfaces:
            own.setdefault(int(surface.material.flat[0]), []).extend(tracked.temperatures())
    extremes = {material: {float(min(values)), float(max(values))} for material, values in own.items()}
    objects = [(material, temperature) for material, both in extremes.items() for temperature in sorted(both)]
    return Envelope(
        band_um=scene.camera.band_um,
        ground=(min(ground), max(ground)),
        objects=objects,
        sky_temperature=scene.spec.sky_temperature,
        surroundings_temperature=scene.surroundings_temperature,
        air=scene.air,
        altitude_m=_altitudes_m(scene),
    )


def _kelvin(millikelvin: float) -> str:
    return f"{millikelvin * 1e-3:.3g} K" if millikelvin >= 1e3 else f"{millikelvin:.3g} mK"
