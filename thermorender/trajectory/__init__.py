"""Trajectories: timed camera poses in a scene's local frame, read from flight logs."""

from thermorender.trajectory.path import (
    Anchor,
    Trajectory,
    check_above_ground,
    parse_anchor,
    parse_lever_arm,
    parse_mount,
)
from thermorender.trajectory.readers import read_trajectory

__all__ = [
    "Anchor",
    "Trajectory",
    "check_above_ground",
    "parse_anchor",
    "parse_lever_arm",
    "parse_mount",
    "read_trajectory",
]
