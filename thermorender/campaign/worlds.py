"""True temperatures of procedural scenes: the heat balance of a land whose properties are drawn, not the tables'.

Whoever predicts a scene knows the tables' values and the station's weather. Its truth strays from them: per scene the
thermal properties and the absorptance of every material, the law of convection and the air inside are drawn from their
uncertainty, and each texel has its hidden moisture, cover and roughness. All of that belongs to the landscape's seed:
another hour or weather meets the same ground.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np

from thermorender.files import atomic_folder
from thermorender.materials.shifted import strayed
from thermorender.scene.load import load_scene
from thermorender.synthetic.files import refuse_every, write_declared, write_temperature
from thermorender.synthetic.noise import stream

# Standard deviation of the logarithm of the exchange with the air. Chosen, inside the spread of the laws collected by
# Palyvos, Appl. Therm. Eng. 28 (2008) 801, doi:10.1016/j.applthermaleng.2007.12.005.
CONVECTION_SPREAD = 0.2
# Of the air inside buildings [K]. Chosen: heated rooms lie within 16…24 °C.
INSIDE_SPREAD_K = 2.0


def write(scene, directory, overwrite=False, temperature_every=2, progress=None):
    """Return the folder written for a procedural scene: rasters with its true temperature, scene.toml and flight.csv.

    The folder is built beside its path under a temporary name and then renamed, so it is never half there. The scene
    file shows the truth (`source = "raster"`) and holds the weather it was solved under, so that `source = "balance"`
    in its place predicts the same scene from tables.

    Parameters
    ----------
    scene : SyntheticScene
        From `synthetic.worlds.make`.
    directory : path
        Folder to make.
    overwrite : bool
        Replace a folder that already holds something.
    temperature_every : int
        Orthophoto texels to a side of one texel of the stored temperature, which is their mean.
    progress : callable, optional
        Called with (what, share done).

    Raises
    ------
    ThermorenderError
        The folder exists and is not empty, and `overwrite` is false, or `temperature_every` does not divide the grid.
    """
    refuse_every(scene, temperature_every)
    with atomic_folder(directory, overwrite) as draft:
        write_declared(scene, draft)
        temperature = true_temperature(load_scene(draft), scene, progress)
        write_temperature(scene, draft, temperature, temperature_every)
    return Path(directory)


def true_temperature(loaded, scene, progress=None):
    """Return the true temperature of a scene's terrain, (H, W) float32 [K], at its own time.

    Parameters
    ----------
    loaded : Scene
        Of the declared scene's files, with temperature.source="balance".
    scene : SyntheticScene
    """
    from thermorender.render.heat.march import solved

    true, exchange = drawn(loaded, scene.kind, scene.seed)
    hidden = replace(scene.hidden, exchange=np.float32(exchange) * scene.hidden.exchange)
    return solved(true, [loaded.time], progress=progress, hidden=hidden)[0].surfaces[0].temperature


def drawn(scene, kind, seed, again=0):
    """Return (the scene with materials and air inside drawn from their uncertainty, factor on the convection).

    Another `again` is another draw for the same land.

    Positive numbers are log-normal with their standard deviation, shares at most 1, all within the limits of a table;
    absorptance of sunlight is normal within 0.02…0.98; zero stays zero. A material that lies beneath another is drawn
    once.
    """
    beneath, what = {}, f"{kind}{f' {again}' if again else ''}"

    def varied(name, thermal):
        if name not in beneath:
            below = varied(thermal.beneath, thermal.below) if thermal.below else None
            beneath[name] = replace(strayed(thermal, stream(seed, f"truth of {what}: {name}")), below=below)
        return beneath[name]

    materials = []
    for material in scene.materials:
        thermal = varied(material.name, material.known_thermal())
        normal = stream(seed, f"true absorptance of {what}: {material.name}").standard_normal()
        absorptance = np.clip(material.solar_absorptance + material.solar_uncertainty * normal, 0.02, 0.98)
        materials.append(replace(material, thermal=thermal, solar_absorptance=float(absorptance)))
    law = stream(seed, f"truth of {what}")
    exchange = float(np.exp(law.normal(-0.5 * CONVECTION_SPREAD**2, CONVECTION_SPREAD)))
    inside_c = scene.spec.weather.inside_c + float(law.normal(0.0, INSIDE_SPREAD_K))
    return scene.with_weather(inside_c=inside_c).with_surfaces(materials=materials), exchange

