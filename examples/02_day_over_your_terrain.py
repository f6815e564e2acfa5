"""Make a scene of two GeoTIFFs, give it a day's weather, and print its temperature from night to afternoon.

Set ELEVATION and ORTHOPHOTO to your own files; the script makes a small land to start with.
"""

import subprocess
import sys
from pathlib import Path

import thermorender as tr


def thermorender(text):
    """Run one command line."""
    subprocess.run([sys.executable, "-m", "thermorender", *text.split()], check=True)


land = Path("land")
if not land.exists():
    thermorender(f"make-scene heath --draped --seed 3 --size-m 32 --texel-m 0.5 --post-m 1 -o {land}")
ELEVATION, ORTHOPHOTO = land / "elevation.tif", land / "orthophoto.tif"

mine = Path("mine")
if not mine.exists():
    thermorender(f"import-terrain {ELEVATION} {ORTHOPHOTO} --material grass_green -o {mine}")

# The heat balance gives the temperatures, under the weather of a named day.
scene = (
    tr.load_scene(mine)
    .with_weather(
        time="2018-07-28T03:00Z", air_low_c=9.0, air_high_c=22.0, humidity=0.6, wind_m_s=3.0, cloud=0.2, inside_c=20.0
    )
    .with_temperature("balance")
)  # fmt: skip
pose = scene.pose(0, 0, 25, pitch_deg=-90)
renderer = None
for hour in (3, 8, 13):
    # The traced light of the first renderer serves the others.
    renderer = tr.Renderer(scene.at(f"2018-07-28T{hour:02d}:00Z"), quality="fast", like=renderer)
    kelvin = renderer.frame(pose).apparent_temperature
    print(f"{hour:02d}:00 UTC: {kelvin.min():.1f} … {kelvin.max():.1f} K, mean {kelvin.mean():.1f} K")
