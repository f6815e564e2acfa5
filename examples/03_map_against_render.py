"""Train a map from colour to temperature on pictures of one land, and compare it with the render of another."""

import subprocess
import sys
from pathlib import Path

import numpy as np

import thermorender as tr


def thermorender(text):
    """Run one command line."""
    subprocess.run([sys.executable, "-m", "thermorender", *text.split()], check=True)


# Pairs of a photograph and a thermal picture, from a flight over one land.
if not Path("pairs").exists():
    thermorender("make-scene heath --draped --seed 4 --size-m 40 --texel-m 0.2 -o land4")
    thermorender("fly land4 --stop-s 1 --rate-hz 4 --products visible,radiometric -o pictures")
    thermorender("prepare pictures pictures --visible *_visible.png --thermal *_radiometric.tif --split train -o pairs")
if not Path("mine.npz").exists():
    thermorender("train correlation-9to1 pairs -o mine.npz")

# Another land, which the map has not seen.
if not Path("land5").exists():
    thermorender("make-scene heath --draped --seed 5 --size-m 40 --texel-m 0.2 -o land5")
scene = tr.load_scene("land5")
pose = scene.pose(0, 0, 30, pitch_deg=-90)
truth = tr.Renderer(scene, quality="fast")
# The same land, its temperatures from the map.
mapped = tr.Renderer(scene.with_temperature("mine.npz"), quality="fast", like=truth)
error = mapped.frame(pose).apparent_temperature - truth.frame(pose).apparent_temperature
print(f"mean error {error.mean():+.2f} K, mean absolute error {np.abs(error).mean():.2f} K")
