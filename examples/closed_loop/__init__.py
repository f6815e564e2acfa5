"""Closed loops: a rocket in RocketPy and an aircraft in JSBSim steer by frames of `thermorender serve`."""
