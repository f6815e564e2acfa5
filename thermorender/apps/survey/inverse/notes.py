"""Sentences on a reconstruction: what its frames cannot show, and where they contradict each other or the user."""

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermorender.apps.survey.inverse.adjustment import Adjusted, deviations, lens_of
from thermorender.apps.survey.inverse.frames import Survey
from thermorender.apps.survey.inverse.level import Reference
from thermorender.apps.survey.inverse.poses import PoseError, deviation
from thermorender.apps.survey.inverse.shutter import Shutters
from thermorender.apps.survey.inverse.solve import Settings, State
from thermorender.apps.survey.inverse.spread import Spread
from thermorender.units import utc_text

Floats = NDArray[np.float64]
# Residuals above both, [K] and as share of the frames' contrast. Real frames at poses of photogrammetry leave 0.3 K.
# Over a simulated heath, structure within texels of 2 m leaves 0.7 K, and heights that are wrong by a third 1.4 K.
_UNLIKE_K, _UNLIKE = 1.0, 0.2
# Residuals beyond so many times the noise are said.
_MISFIT = 3.0
# A frame that fits worse than the median of the frames by this factor, and by this many times the noise.
_WORSE, _BEYOND_NOISE = 3.0, 5.0
# Offsets beyond so many prior standard deviations from the median, and so many of the frames' own.
_FAR_OFFSETS, _FAR_AMONG = 10.0, 6.0
# References and levels beyond so many standard deviations, and common moves of all frames.
_SIGMAS, _TOGETHER = 3.0, 2.0
# Smaller texels than this share of a pixel are noisier than the pixels.
_FINE = 0.8
# Hours by which times of frames may differ from that of the scene: without a zone, and with one.
_ANY_ZONE_H, _FLIGHT_H = 14.0, 3.0
_CLOCK = re.compile(r"(\d{4})[:-](\d\d)[:-](\d\d)[ T](\d\d:\d\d(?::\d\d)?)(?:\.\d+)?(Z|[+-]\d\d:?\d\d)?")
# Heights by the frames and by the scene that differ by more: standard deviations, and metres.
_HEIGHTS_OFF, _HEIGHTS_M = 4.0, 0.3
# Names in a sentence.
_MOST = 5


class Level(NamedTuple):
    """The common level: its shift [K], the references with their residuals, and the shutters."""

    shift_k: float
    residuals: Sequence[tuple[str, float]]
    references: Sequence[Reference]
    shutters: Shutters


def notes_of(
    survey: Survey, blind: Sequence[int], state: State, spread: Spread, settings: Settings, pixel_m: float,
    level: Level, time: np.datetime64 | None = None,
) -> list[str]:  # fmt: skip
    """Return sentences for the user on a solution.

    `blind` are numbers of frames without terrain, `pixel_m` the side of a pixel on the ground [m], 0 without terrain.
    """
    return [
        *_coverage(survey, blind, spread), *_misfits(survey, state, spread, settings),
        *_texels(settings, pixel_m), *_shutters(survey, level), *_level(level, settings), *_headings(survey),
        *_times(survey, time),
    ]  # fmt: skip


def adjustment_notes(
    survey: Survey, found: Adjusted, error: PoseError, fit_lens: bool, alone: bool
) -> list[str]:  # fmt: skip
    """Return sentences on the adjustment of frames; `alone` without a scene."""
    notes = []
    if found.doubt:
        notes.append(f"the lens stays that of the camera: {found.doubt}")
    if fit_lens and not found.doubt:
        (focal, right, down, k1, k2), std = lens_of(found.camera), found.lens_std
        notes.append(
            f"the lens is fitted to the frames: {focal:.1f} ± {std[0]:.1f} pixels of focal length, principal point "
            f"({right:+.1f} ± {std[1]:.1f}, {down:+.1f} ± {std[2]:.1f}) pixels from the middle, k1 = {k1:.3f} ± "
            f"{std[3]:.3f}, k2 = {k2:.3f} ± {std[4]:.3f}; the same points of two frames agree to "
            f"{found.residual_px:.2f} pixels"
        )
    known = found.heights[np.isfinite(found.heights)]
    if alone:
        relief = found.relief.up
        notes.append(
            f"the ground is level at the take-off, with the relief that the frames show at {known.size} points: "
            f"{relief.min():+.1f} to {relief.max():+.1f} m; its level is known to {np.median(found.height_std):.1f} m, "
            f"and trees and walls are smoothed to {found.ground.step_m:.2g} m"
        )
        notes.append(
            f"only the measured poses say where the map lies: to {found.pose_std[0]:.2f} m in the median, which the "
            "standard deviations of texels leave out"
        )
    elif known.size:
        away = 1.4826 * float(np.median(np.abs(known - np.median(known))))
        level = float(np.median(known))
        if abs(level) > max(_SIGMAS * float(np.median(found.height_std)), _HEIGHTS_M):
            notes.append(
                f"by the frames, the ground lies {level:+.2f} m above the scene's: heights of poses and scene "
                "count from different zeros, or the focal length is wrong"
            )
        if away > max(_HEIGHTS_OFF * float(np.median(found.height_std)), _HEIGHTS_M):
            notes.append(
                f"by the frames, heights of the ground differ from the scene's by {away:.2f} m, robust standard "
                "deviation; give a surface model of the day of the flight"
            )
    loose = np.flatnonzero(~found.held)
    if loose.size:
        notes.append(
            f"{loose.size} frames show too little that others show, so that only their measured poses hold them: "
            f"{_names(survey, loose)}"
        )
    steps = deviations(found.poses, survey.poses)
    for part, limit, unit, scale in (
        (slice(0, 3), error.position_m, "m", 1.0), (slice(3, 6), error.angle_deg, "°", np.degrees(1.0))
    ):  # fmt: skip
        moved = scale * np.linalg.norm(steps[:, part], axis=1)
        # Of three axes.
        far = np.flatnonzero(moved > _SIGMAS * np.sqrt(3.0) * limit)
        if far.size:
            notes.append(
                f"{far.size} frames are up to {moved.max():.1f} {unit} from their measured poses, which pose_error "
                f"states to {limit:g} {unit}: {_names(survey, far)}; their clock, heights or gimbal are wrong"
            )
    return notes


def _coverage(survey: Survey, blind: Sequence[int], spread: Spread) -> list[str]:
    notes = []
    if blind:
        notes.append(f"{len(blind)} frames show nothing of the terrain and change nothing: {_names(survey, blind)}")
    if len(survey.names) - len(blind) == 1:
        notes.append("one frame shows the terrain: no other frame tests its offset, its pose and the lens, and the "
                     "standard deviations hold noise only")  # fmt: skip
    elif spread.groups > 1:
        notes.append(
            f"the frames are {spread.groups} groups that share no texel: the scene's own temperatures alone set the "
            "level of each group, and the standard deviations leave it out; fly lines that overlap"
        )
    return notes


def _misfits(survey: Survey, state: State, spread: Spread, settings: Settings) -> list[str]:
    """What does not fit the map: all frames, single ones, their offsets and tilts, and their common pose."""
    notes = []
    share = state.noise_k / max(contrast_k(survey.kelvin), 1e-9)
    if state.noise_k > _UNLIKE_K and share > _UNLIKE:
        notes.append(
            f"the frames differ from the map by {state.noise_k:.2f} K, {100.0 * share:.0f} % of their contrast, so the "
            "map and its standard deviations cannot be trusted: heights, angles, the focal length or the order of the "
            "frames are wrong, or texels are too large"
        )
    elif state.noise_k > _MISFIT * settings.noise_k:
        notes.append(
            f"pixels differ from the map by {state.noise_k:.2f} K, {state.noise_k / settings.noise_k:.1f} times the "
            "noise of a camera: poses, heights, structure within texels or changes of the ground; the standard "
            "deviations include it"
        )
    known = np.isfinite(spread.frames)
    usual = float(np.median(spread.frames[known])) if known.any() else 0.0
    worse = np.flatnonzero(known & (spread.frames > max(_WORSE * usual, _BEYOND_NOISE * settings.noise_k)))
    if worse.size:
        notes.append(
            f"{worse.size} frames differ from the map {_WORSE:g} times as much as others, by up to "
            f"{spread.frames[worse].max():.2f} K: {_names(survey, worse)}; check their poses, or leave them out"
        )
    away = np.abs(state.offsets - np.median(state.offsets[known])) if known.any() else np.zeros(0)
    far = max(_FAR_OFFSETS * settings.offset_k, _FAR_AMONG * 1.4826 * float(np.median(away[known]))) if away.size else 0
    apart = np.flatnonzero(known & (away > far)) if away.size else np.zeros(0, int)
    if apart.size:
        notes.append(
            f"{apart.size} frames have another level than the others, by up to {away[apart].max():.1f} K, which moves "
            f"the level of the map: {_names(survey, apart)}; correct their unit, or leave them out"
        )
    if state.tilt_k > 0.0:
        notes.append(
            f"from the middle to the edge, frames differ from the map by {state.tilt_k:.2f} K: the ground changed "
            "between passes, or the camera drifted; the map is a mean over the flight"
        )
    return [*notes, *_common_move(survey, state, settings)]


def _common_move(survey: Survey, state: State, settings: Settings) -> list[str]:
    """A note if the frames moved together by more than their stated error."""
    error = settings.pose_error
    if error.position_m == 0.0:
        return []
    steps = np.array([deviation(*pair)[:3] for pair in zip(state.poses, survey.measured, strict=True)])
    east, north, up = (float(each) for each in np.median(steps, axis=0))
    if max(abs(east), abs(north), abs(up)) <= _TOGETHER * error.position_m:
        return []
    return [
        f"the frames moved together by {east:+.2f} m east, {north:+.2f} m north and {up:+.2f} m up, more than "
        "twice pose_error: their heights, the scene's place or the focal length of the camera is wrong, or the "
        "frames are too few to hold their poses, which pose_error=0,0 keeps"
    ]


def _texels(settings: Settings, pixel_m: float) -> list[str]:
    if settings.texel_m >= _FINE * pixel_m:
        return []
    return [
        f"texels of {settings.texel_m:.3g} m are smaller than a pixel on the ground, {pixel_m:.3g} m, which amplifies "
        f"the noise; give texel_m={1.5 * pixel_m:.2g} for a map with less noise"
    ]


def _shutters(survey: Survey, level: Level) -> list[str]:
    after = level.shutters.after
    if not after.size:
        return []
    said = f"the shutter closed before {_names(survey, after)}: offsets jump by {level.shutters.fall_k:.1f} K there"
    if level.references:
        return [f"{said} and drift in between, which offsets.csv has as drift_k"]
    return [
        f"{said} and drift in between; the frames right after it set the common level, which this moves by "
        f"{level.shift_k:+.1f} K, and half of the jump is part of the level's standard deviation"
    ]


def _level(level: Level, settings: Settings) -> list[str]:
    if not level.references:
        return ["no reference fixes the common level: all temperatures may be off by one number, stated as level"]
    notes = []
    pairs = zip(level.residuals, level.references, strict=True)
    apart = [(name, rest) for (name, rest), each in pairs if abs(rest) > _SIGMAS * max(each.std_k, settings.noise_k)]
    if len(level.references) > 1 and apart:
        shown = ", ".join(f"{name} {rest:+.2f} K" for name, rest in apart[:_MOST])
        notes.append(
            f"the references contradict each other beyond their standard deviations ({shown}), which widens that of "
            "the level; check their temperatures and places, and leave wrong ones out"
        )
    if abs(level.shift_k) > _SIGMAS * settings.level_k:
        notes.append(
            f"the references shift all temperatures by {level.shift_k:+.1f} K, more than calibrated cameras are off; "
            "check the unit and the places of the references, and the scale of the frames"
        )
    return notes


def _headings(survey: Survey) -> list[str]:
    east = survey.poses[:, :2, 0]
    turned = np.degrees(np.arccos(np.clip(np.abs(east @ east[0]) / np.linalg.norm(east, axis=1).clip(1e-9), -1.0, 1.0)))
    opposite = (east @ east[0]).min() < 0.0
    if len(east) > 1 and turned.max() < 20.0 and not opposite:
        return [
            "all frames have nearly the same yaw: a tilt of the scene's temperatures, the shading of the lens and the "
            "offsets cannot be told apart; fly lines to and fro, or cross them"
        ]
    return []


def _times(survey: Survey, time: np.datetime64 | None) -> list[str]:
    """A note if no frame was taken at about the hour of the scene's weather."""
    found = [each for each in map(instant, survey.times) if each is not None]
    if time is None or not found:
        return []
    beyond = [abs((each - time) / np.timedelta64(3600, "s")) - allowed for each, allowed in found]
    if min(beyond) <= 0.0:
        return []
    first = next(each for each in survey.times if instant(each) is not None)
    return [
        f"the times of the frames, such as {first}, are not that of the scene's weather, {utc_text(time)}, from which "
        "the written scene moves to other hours; set weather.time in the scene's scene.toml to the hour of the flight"
    ]


def instant(text: str) -> tuple[np.datetime64, float] | None:
    """Return (instant of a frame as UTC, hours by which it may be wrong), or None for another form of time."""
    parts = _CLOCK.fullmatch(text)
    if parts is None:
        return None
    try:
        clock = np.datetime64(f"{parts[1]}-{parts[2]}-{parts[3]}T{parts[4]}", "s")
    except ValueError:
        return None
    zone = parts[5]
    if zone is None:
        return clock, _ANY_ZONE_H
    if zone != "Z":
        minutes = int(zone[1:3]) * 60 + int(zone[-2:])
        clock -= np.timedelta64(minutes if zone[0] == "+" else -minutes, "m")
    return clock, _FLIGHT_H


def contrast_k(kelvin: NDArray[np.floating]) -> float:
    """Return the robust standard deviation of the temperatures of a frame, in the median over frames (F, H, W) [K]."""
    found = [np.nanmedian(np.abs(image - np.nanmedian(image))) for image in kelvin]
    return 1.4826 * float(np.median(found))


def _names(survey: Survey, numbers: Sequence[int] | NDArray[np.intp]) -> str:
    return ", ".join(survey.names[int(number)] for number in numbers[:_MOST])
