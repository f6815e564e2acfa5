"""True temperatures of procedural scenes: a heat balance with properties drawn around the tables' values.

A predictor knows the tables and the station's weather; the truth deviates from them. Per scene, the thermal properties
and absorptance of every material, the convection law and the indoor air are drawn from their uncertainty. Each texel
also has hidden moisture, cover and roughness. All draws belong to the landscape's seed: another hour or weather has
the same ground.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermorender import Scene, load_scene
from thermorender.apps.lands.procedural.noise import stream
from thermorender.apps.lands.procedural.procedural_scene import SyntheticScene
from thermorender.apps.lands.procedural.scene_files import refuse_every, write_declared, write_temperature
from thermorender.files import atomic_folder
from thermorender.materials.shifted import strayed
from thermorender.materials.thermal import Thermal
from thermorender.progress import Progress

# Standard deviation of the logarithm of the heat transfer coefficient. Chosen, within the spread of the laws collected
# by Palyvos, Appl. Therm. Eng. 28 (2008) 801, doi:10.1016/j.applthermaleng.2007.12.005.
CONVECTION_SPREAD = 0.2
# Standard deviation of the indoor air temperature [K]. Chosen: heated rooms have 16…24 °C.
INSIDE_SPREAD_K = 2.0


def write(
    scene: SyntheticScene, directory: str | Path, overwrite: bool = False, temperature_every: int = 2,
    progress: Progress | None = None,
) -> Path:  # fmt: skip
    """Write a procedural scene: rasters with its true temperature, scene.toml and flight.csv; return the folder. A
    stored temperature is the mean of `temperature_every` texels a side.

    The scene file uses the truth (`source = "raster"`) and holds the weather of its solution, so that `source =
    "balance"` predicts the same scene from tables.
    """
    refuse_every(scene, temperature_every)
    with atomic_folder(directory, overwrite) as draft:
        write_declared(scene, draft)
        temperature = true_temperature(load_scene(draft), scene, progress)
        write_temperature(scene, draft, temperature, temperature_every)
    return Path(directory)


def true_temperature(loaded: Scene, scene: SyntheticScene, progress: Progress | None = None) -> NDArray[np.float32]:
    """Return the true temperature of the terrain of a scene at its time, (H, W) float32 [K]; `loaded` is its files with
    temperature.source="balance".
    """
    from thermorender.render.heat.simulation import solved

    assert loaded.time is not None
    true, exchange = drawn(loaded, scene.kind, scene.seed)
    deviations = replace(scene.deviations, exchange=np.float32(exchange) * scene.deviations.exchange)
    return solved(true, [loaded.time], progress=progress, deviations=deviations)[0].surfaces[0].temperature


def drawn(scene: Scene, kind: str, seed: int, again: int = 0) -> tuple[Scene, float]:
    """Return (the scene with materials and indoor air drawn from their uncertainty, factor on the convection).

    Another `again` is another draw for the same land. Positive numbers are log-normal with their standard deviation,
    shares at most 1, all within the limits of a table; solar absorptance is normal within 0.02…0.98; zero stays zero.
    A material beneath several others is drawn once.
    """
    beneath: dict[str, Thermal] = {}
    what = f"{kind}{f' {again}' if again else ''}"

    def varied(name: str, thermal: Thermal) -> Thermal:
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
    assert scene.spec.weather is not None
    inside_c = scene.spec.weather.inside_c + float(law.normal(0.0, INSIDE_SPREAD_K))
    return scene.with_weather(inside_c=inside_c).with_surfaces(materials=materials), exchange
