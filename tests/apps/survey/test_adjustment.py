"""Lens, poses and relief from matches between frames."""

import numpy as np
import pytest
from survey_support import HILL_M, LENS, camera_of, flight, frame, hill, measured_poses

from thermorender.apps.survey.inverse.adjustment import (
    _Equations,
    adjusted,
    adjusted_from,
    arrays_of,
    deviations,
    lens_of,
    moved_all,
    with_lens,
)
from thermorender.apps.survey.inverse.matches import Matches, View, detailed, matched
from thermorender.apps.survey.inverse.poses import PoseError
from thermorender.apps.survey.inverse.relief import Relief
from thermorender.errors import ThermorenderError

ERROR = PoseError(0.3, 0.5)
FLAT = Relief(-500.0, -500.0, 1000.0, np.zeros((2, 2)))
NOMINAL = np.array([195.0, 0.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def frames():
    """(frames (F, H, W) with noise, true poses, measured poses); the position of one is 4 m off."""
    poses = flight()
    kelvin = np.array([frame(pose, LENS) for pose in poses])
    kelvin += np.random.default_rng(2).normal(0.0, 0.05, kelvin.shape).astype(np.float32)
    # The level of each frame is its own.
    kelvin += np.random.default_rng(3).normal(0.0, 3.0, (len(kelvin), 1, 1)).astype(np.float32)
    measured = measured_poses(poses, ERROR.position_m, ERROR.angle_deg)
    measured[4, :3, 3] += [3.0, -2.5, 0.0]
    return kelvin, poses, measured


@pytest.fixture(scope="module")
def found(frames):
    kelvin, _, measured = frames
    return adjusted(kelvin, camera_of(NOMINAL), measured, ERROR, FLAT, 3.0, True, True)


def ground_miss(camera, poses, truth, own):
    """Where frames put what they show on their own ground, less where it is on the hill, without what all frames have
    in common, (N, 2) [m]: shift, turn, tilt and scale, which only the measured poses tell."""
    pixel = np.stack(np.meshgrid(np.linspace(4.0, 156.0, 9), np.linspace(4.0, 124.0, 9)), axis=-1).reshape(-1, 2)
    every, pixel = np.repeat(np.arange(len(poses)), len(pixel)), np.tile(pixel, (len(poses), 1))
    ground = Relief.sampled(hill, np.array([-150.0, -150.0]), np.array([150.0, 150.0]), 0.5)
    point = View(camera_of(LENS), truth, ground).on_ground(every, pixel)[:, :2]
    miss = View(camera, poses, own).on_ground(every, pixel)[:, :2] - point
    common = np.stack([np.ones(len(point)), *point.T, point[:, 0] * point[:, 1], *point.T**2], axis=1)
    return miss - common @ np.linalg.lstsq(common, miss, rcond=None)[0]


def test_lens_and_poses_show_each_point_where_the_true_ones_do(frames, found):
    _, poses, measured = frames
    pixel_m = 60.0 / LENS[0]
    assert np.sqrt(np.mean(ground_miss(camera_of(NOMINAL), measured, poses, FLAT) ** 2)) > 1.5 * pixel_m
    # Heights are told to 0.24 m, which rays with a mean slope of 0.45 miss by 0.11 m; strips bend by as much again.
    assert np.sqrt(np.mean(ground_miss(found.camera, found.poses, poses, found.relief) ** 2)) < 0.16
    assert found.residual_px < 0.15


def test_distortion_is_found_within_its_standard_deviation(found):
    away = (lens_of(found.camera) - LENS) / found.lens_std
    # Five numbers within 4.5 standard deviations: one in 3000 draws is beyond.
    assert (np.abs(away) < 4.5).all(), away
    assert found.lens_std[3] < 0.02 < abs(LENS[3])


def test_the_relief_is_that_of_the_hill(found):
    nodes = found.nodes[np.isfinite(found.heights)]
    relief = found.relief(nodes[:, 0], nodes[:, 1])
    away = relief - hill(nodes[:, 0], nodes[:, 1])
    # A plane is the frames' common pose.
    plane = np.stack([np.ones(len(nodes)), *nodes.T], axis=1)
    away -= plane @ np.linalg.lstsq(plane, away, rcond=None)[0]
    assert np.std(away) < 0.08 * HILL_M
    assert np.ptp(relief) > 0.8 * HILL_M


def test_ground_below_the_take_off_does_not_become_a_shorter_lens():
    poses = flight(lines=2, along=5)
    low = np.array([frame(pose, LENS, lambda east, north: 0.0 * east - 5.0) for pose in poses])
    measured = measured_poses(poses, 0.1, 0.7)
    found = adjusted(low, camera_of(NOMINAL), measured, PoseError(0.1, 0.7), FLAT, 3.0, True, True)
    # Seen from above, focal length and height of the ground are one: both stay open within their standard deviations.
    assert abs(lens_of(found.camera)[0] - LENS[0]) < 3.0 * found.lens_std[0]
    level, std = float(np.nanmedian(found.relief.up)), float(np.median(found.height_std))
    assert abs(level + 5.0) < 3.0 * std and std > 1.0


def test_a_position_that_is_metres_off_comes_back(frames, found):
    _, poses, measured = frames
    moved = deviations(found.poses, poses)[:, :3] - np.median(deviations(found.poses, poses)[:, :3], axis=0)
    assert np.linalg.norm(measured[4, :3, 3] - poses[4, :3, 3]) > 3.0
    assert np.linalg.norm(moved[4]) < 1.0


def test_a_lens_that_is_given_stays(frames):
    kelvin, poses, measured = frames
    camera = camera_of(LENS)
    kept = adjusted(kelvin[:7], camera, measured[:7], ERROR, FLAT, 3.0, False, True)
    assert kept.camera is camera and not kept.lens_std.any()
    before, after = (deviations(each, poses[:7]) for each in (measured[:7], kept.poses))
    relative = [np.std(each - each.mean(axis=0), axis=0) for each in (before, after)]
    # Without what strip and lens have in common, angles and positions across the strip are smaller.
    assert (relative[1][:2] < relative[0][:2]).all()


def test_linearised_misses_are_differences_of_misses(frames):
    _, _, measured = frames
    ground = Relief.sampled(hill, np.array([-150.0, -150.0]), np.array([150.0, 150.0]), 5.0)
    view = View(camera_of(LENS), measured, ground)
    rng = np.random.default_rng(4)
    pixel = rng.uniform([20.0, 20.0], [140.0, 108.0], (40, 2))
    first, second = np.full(40, 1), np.full(40, 2)
    there = view.in_frame(second, view.on_ground(first, pixel))
    matches = Matches(first, second, np.arange(40), pixel, there, np.zeros((40, 2)))
    miss, slope, lift = _Equations(matches, len(measured), True).linearised(view)
    np.testing.assert_allclose(miss, 0.0, atol=1e-9)

    def shown(other):
        return other.in_frame(second, other.on_ground(first, pixel)) - there

    for axis in range(6):
        step = 1e-3 if axis < 3 else 1e-5
        for number, column in ((1, axis), (2, 6 + axis)):
            change = np.zeros((len(measured), 6))
            change[number, axis] = step
            made = shown(View(view.camera, moved_all(measured, change), ground)) / step
            # The ground is bilinear between posts of 5 m, a plane only to the curvature of the hill.
            np.testing.assert_allclose(slope[:, :, column], made, atol=0.02 * np.abs(made).max())
    for number, step in enumerate((0.1, 0.1, 0.1, 1e-4, 1e-4)):
        change = np.zeros(5)
        change[number] = step
        made = shown(View(with_lens(view.camera, change), measured, ground)) / step
        np.testing.assert_allclose(slope[:, :, 12 + number], made, atol=1e-3 * np.abs(made).max())
    raised = Relief(ground.west, ground.south, ground.step_m, ground.up + 0.05)
    np.testing.assert_allclose(lift, shown(View(view.camera, measured, raised)) / 0.05, atol=0.02)


def test_ghosts_that_all_frames_share_are_not_matched(frames):
    kelvin, _, _ = frames
    ghost = np.random.default_rng(5).normal(0.0, 8.0, kelvin.shape[1:]).astype(np.float32)
    np.testing.assert_allclose(detailed(kelvin + ghost), detailed(kelvin), atol=0.5)


def test_frames_without_common_ground_are_refused(frames):
    kelvin, _, measured = frames
    far = measured[:2].copy()
    far[1, 0, 3] += 1000.0
    with pytest.raises(ThermorenderError, match="no two frames show the same ground"):
        adjusted(kelvin[:2], camera_of(NOMINAL), far, ERROR, FLAT, 3.0)
    even = np.full_like(kelvin[:2], 290.0)
    with pytest.raises(ThermorenderError, match="no two frames show the same ground"):
        matched(detailed(even), View(camera_of(NOMINAL), measured[:2], FLAT), 0.5, 6)


def test_an_adjustment_is_the_same_after_it_was_kept(found):
    again = adjusted_from(arrays_of(found), camera_of(NOMINAL))
    np.testing.assert_allclose(lens_of(again.camera), lens_of(found.camera), rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(again.poses, found.poses)
    np.testing.assert_array_equal(again.relief.up, found.relief.up)
    assert again.residual_px == found.residual_px and again.held.all()
