"""Draw the front page's picture and the gallery: docs/figures/village.jpg and gallery-….jpg, from the shipped scenes.

`python docs/gallery_pictures.py` draws all; names of functions below draw some. Each solves the heat balance of a
scene for its hour and weather.
"""

import sys
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import matplotlib

matplotlib.use("agg")
import matplotlib.pyplot as plt
import numpy as np

import thermorender as tr
from thermorender.apps.lands.procedural.procedural_scene import make, weather_of
from thermorender.apps.lands.procedural.truth import write
from thermorender.output.photograph import photograph

FIGURES = Path(__file__).resolve().parent / "figures"
DAY = "2018-09-02"
# Shares of the pixels of surfaces below and above the scale [%].
ENDS = (0.5, 99.5)


@cache
def village(hour=None):
    """The Renderer of the shipped village at its own instant, or at another of its day by the heat balance."""
    scene = tr.load_scene("village")
    return tr.Renderer(scene if hour is None else followed(scene).at(f"{DAY}T{hour}Z"))


def followed(scene):
    """A scene whose temperatures, air and sky follow its hour and weather."""
    return scene.with_temperature("balance").with_air("weather")


def shown(axes, frame, label=True):
    """Draw apparent temperature in grey with a bar [K]; the sky is off the scale."""
    kelvin = frame.apparent_temperature
    low, high = np.percentile(kelvin[frame.truth["mask"] & 1 > 0], ENDS)
    image = axes.imshow(kelvin, cmap="inferno", vmin=low, vmax=high, interpolation="nearest")
    axes.set_axis_off()
    bar = axes.figure.colorbar(image, ax=axes, fraction=0.0385, pad=0.015)
    bar.ax.tick_params(labelsize=8)
    if label:
        bar.set_label("apparent temperature [K]", fontsize=8)


def front():
    """The village in the early afternoon and at dawn: photograph, apparent temperature, camera display."""
    pose = tr.pose(-70, -60, 38, look_at=(0, 5, 0))
    picture = plt.figure(figsize=(12, 4.9), dpi=100, layout="constrained")
    left, middle, right = picture.subfigures(1, 3, width_ratios=(5.75, 3.3, 2.95))
    axes = left.subplots()
    axes.imshow(photograph(village(), pose)[0])
    axes.set_title("photograph", fontsize=10)
    axes.set_axis_off()
    rows = zip(middle.subplots(2, 1), right.subplots(2, 1), (None, "04:10"), ("14:30", "dawn"), strict=True)
    for kelvin, display, hour, name in rows:
        frame = village(hour).frame(pose)
        shown(kelvin, frame, label=False)
        kelvin.set_title(f"{name}: apparent temperature [K]", fontsize=10)
        display.imshow(frame.display, cmap="gray", vmin=0, vmax=255)
        display.set_title("camera's display", fontsize=10)
        display.set_axis_off()
    save(picture, "village")


def save(picture, name):
    """Write a figure as JPEG."""
    path = FIGURES / f"{name}.jpg"
    picture.savefig(path, pil_kwargs={"quality": 88, "optimize": True})
    plt.close(picture)
    print(path.name, path.stat().st_size)


def one(name, frame):
    """Write a frame's apparent temperature as gallery-NAME.jpg."""
    picture, axes = plt.subplots(figsize=(7.2, 5.1), dpi=100, layout="constrained")
    shown(axes, frame)
    save(picture, f"gallery-{name}")


def noon():
    """Roofs, street, gardens and pond in the afternoon sun."""
    one("noon", village().frame(tr.pose(0, -90, 50, look_at=(0, 0, 0))))


def night():
    """Four hours after sunset, along the street."""
    one("night", village("22:00").frame(tr.pose(-110, -25, 22, look_at=(0, 10, 0))))


def metal():
    """Roofs of bare steel under the night sky."""
    dark = village("22:00").scene.with_material(roof_slate="steel_galvanised", roof_shingle="steel_galvanised")
    one("metal", tr.Renderer(dark).frame(tr.pose(60, -70, 30, look_at=(-10, 20, 2))))


def rain():
    """An afternoon of rain."""
    scene = followed(tr.load_scene("village")).with_weather(cloud=1.0, air_low_c=11.0, air_high_c=14.0)
    wet = scene.weather
    rain = np.where((wet.time > np.datetime64(f"{DAY}T06:00")), 2.0, 0.0)
    one("rain", tr.Renderer(scene.with_weather(replace(wet, rain_mm_h=rain))).frame(
        tr.pose(-70, -60, 38, look_at=(0, 5, 0))))  # fmt: skip


def river():
    """The pond as a smooth surface, which mirrors trees and sky."""
    scene = village().scene.with_material(water="water_fresnel")
    level = float(scene.ground(-19.0, 71.0))
    one("water", tr.Renderer(scene).frame(tr.pose(-19, 116, level + 10, look_at=(-19, 71, level))))


def fire():
    """The signal fire beside the hut on the ridge."""
    scene = tr.load_scene("ridge")
    level = float(scene.ground(-95.0, -220.0))
    one("fire", tr.Renderer(scene).frame(tr.pose(150, -430, level + 150, look_at=(-97, -219, level))))


def haze():
    """The heath at 10° below the horizon through air with a visibility of 5 km."""
    scene = tr.load_scene("heath").with_air("midlatitude-summer", "rural-5km")
    one("haze", tr.Renderer(scene).frame(scene.pose(0, -150, 60, pitch_deg=-10)))


def snow():
    """A winter day over a heath of rasters."""
    winter = {"time": "2018-01-17T11:00Z", "air_low_c": -12.0, "air_high_c": -3.0, "snow_depth_m": 0.3}
    with TemporaryDirectory() as folder:
        made = make("heath", size_m=200.0, weather=weather_of("heath", **winter))
        scene = tr.load_scene(write(made, Path(folder) / "snow"))
        one("snow", tr.Renderer(scene).frame(scene.pose(0, 0, 110, pitch_deg=-90)))


ALL = (front, noon, night, metal, rain, river, fire, haze, snow)

if __name__ == "__main__":
    for draw in [globals()[name] for name in sys.argv[1:]] or ALL:
        draw()
