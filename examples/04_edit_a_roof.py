"""Copy a material, halve its emissivity, and print by how many kelvins the roofs of a village change."""

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

import thermorender as tr
from thermorender.materials.library import load_library

if not Path("village60").exists():
    command = "make-scene village --draped --seed 1 --size-m 60 --texel-m 0.25 -o village60"
    subprocess.run([sys.executable, "-m", "thermorender", *command.split()], check=True)

slate = load_library()["roof_slate"]
coated = replace(slate, name="roof_coated", title="Slate with a coating", emissivity=0.5 * slate.emissivity)

scene = tr.load_scene("village60")
pose = scene.pose(0, 0, 60, pitch_deg=-90)
before = tr.Renderer(scene, quality="fast")
after = tr.Renderer(scene.with_material(roof_slate=coated), quality="fast", like=before)
change = after.frame(pose).apparent_temperature - before.frame(pose).apparent_temperature

names = [material.name for material in scene.materials]
roof = before.frame(pose).truth["material"] == names.index("roof_slate")
print(f"slate roofs: {change[roof].mean():+.1f} K on average, over {roof.mean():.0%} of the picture")
print(f"the rest: {np.abs(change[~roof]).mean():.2f} K on average, by light that the roofs reflect")
