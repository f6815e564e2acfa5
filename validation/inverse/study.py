"""Maps from rendered frames against their truth: error, calibration and run time by setting."""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import uniform_filter

from thermorender.apps.survey.inverse.frames import Survey
from thermorender.apps.survey.inverse.kinetic import light_of
from thermorender.apps.survey.inverse.level import Reference
from thermorender.apps.survey.inverse.linear import LinearKelvin
from thermorender.apps.survey.inverse.poses import PoseError
from thermorender.apps.survey.inverse.reconstruct import reconstruct
from thermorender.apps.survey.inverse.run import aligned
from thermorender.apps.survey.inverse.solve import Settings
from thermorender.apps.survey.inverse.weights import Lattice, Viewer, moved, taps_of
from thermorender.physics.planck import brightness_temperature
from thermorender.render.renderer import Renderer
from thermorender.scene.load import load_scene
from thermorender.scene.spec import TemperatureSpec
from thermorender.sensor.camera import load_camera
from thermorender.sensor.psf import blur_of, blurred
from validation.inverse import rivals

# Errors of the simulated survey: noise, offsets, fixed pattern and vignetting [K]; poses [m], [deg].
NOISE_K, OFFSET_K, PATTERN_K, VIGNETTE_K = 0.072, 0.5, 0.05, 0.8
ERROR = PoseError(1.0, 0.7)
# Frames of each line, lines, steps along and across [m], height [m]: overlaps of 72 % and 63 %.
_ALONG, _LINES, _STEP_M, _GAP_M, _HEIGHT_M, _OBLIQUE = 9, 5, 18.7, 31.0, 100.0, 6
# Cases with another prior, or with a disc of known temperature.
FLAT, REFERENCE = "orthophoto alone", "one reference"
_DISC_M, _KNOWN_K = 2.0, 0.05
HEADER = ("case", "frames", "texel [m]", "taps", "rounds", "MAE [K]", "plain mean [K]", "held out [K]", "ground [m]",
          "offsets [mK]", "level [K]", "within σ", "within 2σ", "CPU [s]")  # fmt: skip


def survey_poses(scene) -> np.ndarray:
    """Return poses of lines to and fro, and of a ring of oblique views, (51, 4, 4)."""
    poses = []
    for line in range(_LINES):
        for number in range(_ALONG):
            north = (number - _ALONG // 2) * _STEP_M * (1.0 if line % 2 == 0 else -1.0)
            east, yaw = (line - _LINES // 2) * _GAP_M, 180.0 * (line % 2)
            poses.append(scene.pose(east, north, _HEIGHT_M, yaw_deg=yaw, pitch_deg=-90.0))
    for number in range(_OBLIQUE):
        angle = 2.0 * np.pi * number / _OBLIQUE
        place = 70.0 * np.sin(angle), 70.0 * np.cos(angle)
        poses.append(scene.pose(*place, 0.9 * _HEIGHT_M, look_at=(0.0, 0.0, 0.0)))
    return np.array(poses)


class Simulated:
    """A scene, its frames with all errors of a survey, and the truth.

    Parameters
    ----------
    folder : path
        Scene whose temperatures are the truth; its heat balance is the prior.
    every : int
        Pixels of the camera in one of the simulation's, along a side.
    seed : int
    """

    def __init__(self, folder: Path, every: int = 2, seed: int = 3) -> None:
        full, rng = load_camera("zenmuse-xt2"), np.random.default_rng(seed)
        self.camera = replace(full, width=full.width // every, height=full.height // every,
                              pixel_pitch_um=full.pixel_pitch_um * every)  # fmt: skip
        self.scene = load_scene(folder).with_camera(self.camera)
        self.renderer = Renderer(self.scene)
        self.poses = survey_poses(self.scene)
        held = [moved(pose, np.array([6.0, 7.0, 5.0, 0.0, 0.0, 0.3])) for pose in self.poses[4:45:13]]
        self.held = np.array(held)
        clean, self.held_frames = (np.array([self._frame(pose) for pose in poses]) for poses in (self.poses, self.held))
        count, height, width = clean.shape
        row, column = np.mgrid[:height, :width] + 0.5
        radius = np.hypot(row - height / 2, column - width / 2) / np.hypot(height / 2, width / 2)
        self.offsets = rng.normal(0.0, OFFSET_K, count)
        lens = rng.normal(0.0, PATTERN_K, (height, width)) - VIGNETTE_K * radius**2 * (0.7 + 0.3 * radius**2)
        kelvin = clean + rng.normal(0.0, NOISE_K, clean.shape) + self.offsets[:, None, None] + lens
        steps = np.concatenate([rng.normal(0.0, ERROR.position_m, (count, 3)),
                                np.radians(rng.normal(0.0, ERROR.angle_deg, (count, 3)))], axis=1)  # fmt: skip
        measured = np.array([moved(pose, step) for pose, step in zip(self.poses, steps, strict=True)])
        names = tuple(f"frame_{number:03d}" for number in range(count))
        self.survey = Survey(names, ("",) * count, kelvin.astype(np.float32), measured)
        self.prior = self.scene.with_temperature("balance")

    def _frame(self, pose):
        radiance = blurred(self.renderer.radiance(pose), blur_of(self.camera))
        return brightness_temperature(radiance.astype(np.float64), *self.camera.band_um)

    def case(self, name: str, settings: Settings, every: int = 1) -> dict:
        """Return the errors of a reconstruction from every so many frames, as a row of `HEADER`."""
        chosen = slice(None, None, every)
        survey = Survey(self.survey.names[chosen], self.survey.times[chosen], self.survey.kelvin[chosen],
                        self.survey.poses[chosen])  # fmt: skip
        mean = TemperatureSpec(source="constant", value=round(float(np.nanmean(survey.kelvin)), 1))
        prior = self.scene.with_temperature(mean) if name.endswith(FLAT) else self.prior
        references = [self._disc()] if name.endswith(REFERENCE) else []
        start = time.process_time()
        # As the command does: the lens is fitted too.
        with tempfile.TemporaryDirectory() as out:
            survey, prior, camera = aligned(survey, prior, self.camera, settings.pose_error, True, False, Path(out))
        found = reconstruct(prior.with_camera(camera), survey, camera, settings, references)
        seconds = time.process_time() - start
        linear = LinearKelvin(self.camera.band_um, round(float(np.nanmedian(survey.kelvin)), 1))
        whole = Lattice.of(self.scene, settings.texel_m)
        rows, columns = (slice(at, at + side) for at, side in zip(
            (found.lattice.row, found.lattice.column), found.apparent.shape, strict=True))  # fmt: skip
        truth = linear.kelvin(light_of(self.renderer, whole, linear).apparent)[rows, columns]
        viewer = Viewer(found.renderer, self.camera, found.lattice)
        mean = rivals.plain_mean(viewer, survey.kelvin, survey.measured)
        seen = (found.views >= 3) & np.isfinite(found.apparent) & np.isfinite(mean)
        error, level = _levelled((found.apparent - truth)[seen])
        share = np.abs(error) / found.apparent_std[seen]
        row = {
            "case": name, "frames": len(survey.names), "texel_m": settings.texel_m, "taps": settings.taps,
            "rounds": settings.rounds, "mae_k": np.abs(error).mean(),
            "plain_k": np.abs(_levelled((mean - truth)[seen])[0]).mean(), "held_out_k": self._held_out(found, linear),
            "ground_m": _ground(viewer, Viewer(found.renderer, found.camera, found.lattice), found.state.poses,
                                self.poses[chosen]) * settings.texel_m,
            "offsets_mk": 1e3 * np.std(found.state.offsets - self.offsets[chosen]), "level_k": level,
            "within_1": (share < 1.0).mean(), "within_2": (share < 2.0).mean(), "seconds": seconds,
        }  # fmt: skip
        return {key: value if isinstance(value, (str, int)) else float(value) for key, value in row.items()}

    def _disc(self) -> Reference:
        """A disc of known temperature where the ground is most uniform, in the middle of what the frames show."""
        ground = self.scene.surfaces[0]
        kelvin = ground.temperature.astype(np.float64)
        side = 2 * round(_DISC_M / ground.texel_m) + 1
        mean, square = uniform_filter(kelvin, side), uniform_filter(kelvin**2, side)
        height, width = kelvin.shape
        inside = np.s_[height // 4 : 3 * height // 4, width // 4 : 3 * width // 4]
        row, column = np.unravel_index(np.argmin((square - mean**2)[inside]), kelvin[inside].shape)
        row, column = row + height // 4, column + width // 4
        east, north = (column + 0.5 - width / 2) * ground.texel_m, (height / 2 - row - 0.5) * ground.texel_m
        return Reference("disc", east, north, _DISC_M, float(mean[row, column]), _KNOWN_K)

    def _held_out(self, found, linear) -> float:
        """Root mean square of frames without errors that took no part, minus their predictions, without the level."""
        viewer = Viewer(found.renderer, self.camera, found.lattice)
        known = (found.views > 2).astype(float)
        misses = []
        for image, pose in zip(self.held_frames, self.held, strict=True):
            sight, measured = viewer.sight(pose), linear.of(image)
            miss = measured.ravel()[sight.pixel] - viewer.imaged(sight, found.state.map, taps_of(), measured)
            misses.append(_levelled(miss[sight.at(known) > 0.999])[0])
        return np.sqrt(np.mean(np.concatenate(misses) ** 2))


def _levelled(error):
    level = float(np.median(error))
    return error - level, level


def _ground(viewer: Viewer, found: Viewer, poses, truth) -> float:
    """Mean distance on the map between what pixels show by found poses and lens, and by the true ones [texels]."""
    away = []
    for pose, known in zip(poses, truth, strict=True):
        there, here = found.sight(pose), viewer.sight(known)
        _, one, other = np.intersect1d(there.pixel, here.pixel, return_indices=True)
        away.append(np.hypot(*(
            float(np.mean(a[one] - b[other])) for a, b in ((there.row, here.row), (there.column, here.column))
        )))  # fmt: skip
    return float(np.mean(away))


def rows(results: list[dict]) -> list[tuple]:
    """Return the rows of `HEADER`."""
    return [
        (each["case"], each["frames"], each["texel_m"], each["taps"], each["rounds"],
         *(f"{each[key]:.3f}" for key in ("mae_k", "plain_k", "held_out_k", "ground_m")), f"{each['offsets_mk']:.1f}",
         f"{each['level_k']:+.2f}", f"{each['within_1']:.1%}", f"{each['within_2']:.1%}", f"{each['seconds']:.0f}")
        for each in results
    ]  # fmt: skip
