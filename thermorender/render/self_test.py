"""The installed package against closed forms, in kelvin and in seconds: `thermorender doctor --self-test`.

Planck's law and its inverse, an isothermal enclosure, a grey plate under a uniform sky, a spherical cavity with a hole,
and the counts of every shipped camera.
"""

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from thermorender.defaults import BAND_UM
from thermorender.frame import apparent_temperature
from thermorender.physics.planck import band_radiance, brightness_temperature
from thermorender.sensor.camera import camera_names, load_camera
from thermorender.sensor.detector import absorbed_power
from thermorender.sensor.optics import detector_irradiance
from thermorender.sensor.readout import digitised, radiance_from_counts

if TYPE_CHECKING:
    import trimesh

HEADER = ("closed form", "expected [K]", "found [K]", "allowed [K]", "")
# Band [µm], temperature [K], band radiance [W m⁻² sr⁻¹] and its derivative [W m⁻² sr⁻¹ K⁻¹]: the series of Planck's law
# summed in 40 digits with the constants of the SI.
_PLANCK = (
    (BAND_UM, 220.0, 10.255757295291089, 0.287857),
    (BAND_UM, 300.0, 55.491611367800534, 0.882489),
    (BAND_UM, 1000.0, 2253.4268487414751, 4.41883),
    ((3.0, 5.0), 300.0, 1.8659562081616895, 0.0676983),
    ((3.0, 5.0), 400.0, 29.847341493356399, 0.633793),
)
_PLANCK_K = 1e-6
# Single precision of a sum over spectral nodes, 2⁻²⁴ of 300 K and some ten roundings, is 0.2 mK.
_ARITHMETIC_K = 1e-3
# Share of the cavity's area that is open. The mean over the view has the error of its rays and that of a polyhedron in
# place of a sphere, some millikelvins each; a missing reflection would be kelvins.
_OPEN, _CAVITY_K = 0.1, 0.02
_WALL_K, _SKY_K = 300.0, 250.0
# A wrong count is tens of millikelvins.
_COUNTS_K = 1e-3


@dataclass(frozen=True)
class Check:
    """A found value beside its closed form."""

    name: str
    # expected_k, found_k, allowed_k: Value by the closed form, value found, and largest allowed difference [K]
    expected_k: float
    found_k: float
    allowed_k: float

    @property
    def passed(self) -> bool:
        """Whether the difference is allowed; NaN is not."""
        return bool(abs(self.found_k - self.expected_k) <= self.allowed_k)

    @property
    def row(self) -> tuple[str, ...]:
        """The check as text under `HEADER`."""
        verdict = "ok" if self.passed else "FAILED"
        return self.name, f"{self.expected_k:.6f}", f"{self.found_k:.6f}", f"{self.allowed_k:g}", verdict


def run(progress: Callable[[str, float], object] | None = None, device: str = "auto") -> list[Check]:
    """Return the Checks of the installed package; `progress` is called with (what, share done)."""
    parts = (("Planck's law", _planck()), ("counts", _counts()), ("rendered scenes", _rendered(device)))
    found: list[Check] = []
    for number, (what, checks) in enumerate(parts):
        if progress:
            progress(what, number / len(parts))
        found += checks
    return found


def _planck() -> Iterator[Check]:
    for band, temperature, radiance, slope in _PLANCK:
        name = f"{band[0]:g}–{band[1]:g} µm at {temperature:g} K"
        found = temperature + (float(band_radiance(temperature, *band)) - radiance) / slope
        yield Check(f"Planck's law, {name}", temperature, found, _PLANCK_K)
        inverse = float(brightness_temperature(radiance, *band))
        yield Check(f"its inverse, {name}", temperature, inverse, _PLANCK_K)


def _counts() -> Iterator[Check]:
    """Counts → radiance → counts of each shipped camera: the temperatures of the worst of a thousand counts."""
    for name in camera_names():
        camera = load_camera(name)
        counts = np.linspace(0.0, 2**camera.bits - 1.0, 1000).astype(np.uint16)
        radiance = radiance_from_counts(counts, camera)
        power = absorbed_power(detector_irradiance(radiance, camera.f_number, camera.lens_transmittance), camera)
        again = digitised(power.astype(np.float32), camera)
        pair = [brightness_temperature(radiance_from_counts(each, camera), *camera.band_um) for each in (counts, again)]
        expected, found = _worst(*pair)
        yield Check(f"counts to radiance to counts, {name}", expected, found, _COUNTS_K)


def _rendered(device: str) -> Iterator[Check]:
    import trimesh

    from thermorender.trajectory.path import pose

    black, sky = (float(band_radiance(kelvin, *BAND_UM)) for kelvin in (_WALL_K, _SKY_K))
    room = trimesh.creation.box(extents=(4, 4, 4)).subdivide().subdivide()
    room.invert()
    for emissivity in (1.0, 0.9, 0.5, 0.05):
        # A leak would show a sky of 0 K.
        seen = _seen(room, emissivity, 0.0, np.eye(4), 64, device)
        name = f"isothermal enclosure, emissivity {emissivity:g}"
        yield Check(name, *_worst(np.full_like(seen, _WALL_K), seen), _ARITHMETIC_K)
    plate = trimesh.Trimesh([[-20, -20, 0], [20, -20, 0], [20, 20, 0], [-20, 20, 0]], [[0, 1, 2], [0, 2, 3]])
    for emissivity in (0.9, 0.5):
        expected = _kelvin(emissivity * black + (1.0 - emissivity) * sky)
        seen = _seen(plate, emissivity, _SKY_K, pose(0, 0, 5, pitch_deg=-90), 64, device)
        name = f"plate under a uniform sky, emissivity {emissivity:g}"
        yield Check(name, *_worst(np.full_like(seen, expected), seen), _ARITHMETIC_K)
    ball = trimesh.creation.icosphere(subdivisions=4)
    ball.invert()
    whole = ball.area
    ball.update_faces(ball.triangles_center[:, 2] < 1.0 - 2.0 * _OPEN)
    ball.remove_unreferenced_vertices()
    # The edge of the hole is jagged; the share of the missing area is what counts.
    hole = 1.0 - ball.area / whole
    for emissivity in (0.9, 0.5):
        # Every point of a sphere receives the same light, from the wall and through the hole.
        received = ((1 - hole) * emissivity * black + hole * sky) / (1 - (1 - emissivity) * (1 - hole))
        expected = _kelvin(emissivity * black + (1 - emissivity) * received)
        seen = _seen(ball, emissivity, _SKY_K, pose(0, 0, 0, pitch_deg=-90), 1024, device)
        yield Check(f"mean of a spherical cavity, emissivity {emissivity:g}", expected, float(seen.mean()), _CAVITY_K)


def _seen(
    mesh: "trimesh.Trimesh", emissivity: float, sky_k: float, pose: NDArray[np.float64], rays: int, device: str
) -> NDArray[np.float64]:
    """Apparent temperature of a mesh of 300 K under a sky, (H, W) [K]."""
    from thermorender.render.renderer import Renderer
    from thermorender.scene.load import load_scene

    with tempfile.TemporaryDirectory() as folder:
        mesh.export(Path(folder) / "mesh.ply")
        (Path(folder) / "scene.toml").write_text(
            f'[terrain]\nmesh = "mesh.ply"\n[temperature]\nsource = "constant"\nvalue = {_WALL_K}\n'
            f'[emissivity]\nsource = "constant"\nvalue = {emissivity}\n[sky]\ntemperature = {sky_k}\n',
            encoding="utf-8",
        )
        settings: dict[str, Any] = {"rays": rays, "tolerance_mk": 0.5, "device": device}
        radiance = Renderer(load_scene(folder), **settings).radiance(pose)
    return apparent_temperature(radiance, BAND_UM).astype(np.float64)


def _kelvin(radiance: float) -> float:
    return float(brightness_temperature(radiance, *BAND_UM))


def _worst(expected: NDArray[np.float64], found: NDArray[np.float64]) -> tuple[float, float]:
    """(expected, found) where they differ most; NaN counts as the largest difference."""
    where = np.unravel_index(np.argmax(np.nan_to_num(np.abs(found - expected), nan=np.inf)), found.shape)
    return float(expected[where]), float(found[where])
