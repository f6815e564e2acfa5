"""Train a map from colour to temperature on a small data set, and compare it with the render of another land."""

import subprocess
from pathlib import Path

import numpy as np

import thermorender as tr


def thermorender(text):
    """Run one command line."""
    subprocess.run(["thermorender", *text.split()], check=True)


if not Path("pairs").exists():
    thermorender("dataset --train 1 --validation 0 --test 1 --kinds heath --hours 1 --views 2 -o pairs")
if not Path("mine.npz").exists():
    thermorender("train correlation-9to1 pairs -o mine.npz")
if not Path("land").exists():
    thermorender("make-scene heath --seed 5 --size-m 40 --texel-m 0.2 -o land")

scene = tr.load_scene("land")
pose = tr.pose(0, 0, 30 + scene.ground(0, 0), pitch_deg=-90)
truth = tr.Renderer(scene, quality="fast")
# The same land, its temperatures from the map.
mapped = tr.Renderer(scene.with_temperature("mine.npz"), quality="fast", like=truth)
error = mapped.frame(pose).apparent_temperature - truth.frame(pose).apparent_temperature
print(f"mean error {error.mean():+.2f} K, mean absolute error {np.abs(error).mean():.2f} K")
