"""Uses of accepted inputs: frames of a small scene with the input, and pictures through maps.

Each use takes the path of a damaged file that its reader has accepted, and returns arrays that must be finite. It may
still refuse, in one sentence, what a file alone does not show: a track beside the terrain, for example.
"""

import re
import shutil
from functools import lru_cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from tests.robustness.fuzz.corpus import READERS
from tests.robustness.fuzz.corpus.tables import DJI, of_tape7
from thermorender.defaults import TEMPERATURE_MAPS

_WEATHER = """[weather]
time = "2018-07-29T12:00:00Z"
air_low_c = 12.0
air_high_c = 25.0
humidity = 0.6
wind_m_s = 2.0
cloud = 0.2
"""
_STATION = '[weather]\ntime = "2018-07-29T12:00:00Z"\nfile = "weather.csv"\n'
_YEAR = '[weather]\ntime = "2018-07-29T12:00:00Z"\nepw = "year.{}"\n'
_RASTERS = 'elevation = "elevation.tif"\northophoto = "orthophoto.tif"\n'
_BALANCE = 'source = "balance"\n'
_WARM, _GREY = 'source = "constant"\nvalue = 290.0\n', 'source = "constant"\nvalue = 0.95\n'


def _load(folder, terrain=_RASTERS, temperature=_WARM, emissivity=_GREY, around="[sky]\ntemperature = 250\n", more=""):
    """The Scene of a scene file with these tables in a folder, which gets rasters if it has none."""
    from thermorender.scene.load import load_scene

    folder = Path(folder)
    for name in ("elevation", "orthophoto"):
        reader = READERS[name]
        if not (folder / reader.file).exists():
            reader.make(folder)
    text = f"[terrain]\n{terrain}[temperature]\n{temperature}[emissivity]\n{emissivity}{around}{more}"
    (folder / "scene.toml").write_text(text)
    return load_scene(folder)


@lru_cache
def _base():
    with TemporaryDirectory() as folder:
        return _load(folder)


def _frame(scene, pose=None):
    """Radiance, truth and counts of the frame of a scene from above, or from a pose."""
    from thermorender.render.renderer import Renderer
    from thermorender.trajectory.path import pose as pose_of

    frame = Renderer(scene, "fast", rays=4, device="cpu").frame(
        pose_of(0.5, 0.5, 30.0, pitch_deg=-80.0) if pose is None else pose
    )
    truth = frame.truth
    hit = truth["material"] != 255
    found = [truth[name][hit] for name in ("kinetic_temperature", "emissivity", "depth", "position")]
    return frame.radiance, frame.counts, frame.apparent_temperature, *found


def _in_library(path, directional):
    """A frame of ground with a spectrum from the scene's own library."""
    library = path.parent / "materials"
    (library / "spectra").mkdir(parents=True, exist_ok=True)
    (library / "spectra" / "tried.csv").write_bytes(path.read_bytes())
    row = {"name": "tried", "title": "tried", "colour_r": 99, "colour_g": 99, "colour_b": 99, "solar_absorptance": 0.7,
           "directional": directional, "temperature_k": 300, "samples": 1, "source": "made", "citation": "none",
           "licence": "none", "note": ""}  # fmt: skip
    (library / "index.csv").write_text(f"{','.join(row)}\n{','.join(map(str, row.values()))}\n")
    return _frame(_load(path.parent, emissivity=_of("tried")))


def _of(material):
    return f'source = "material"\nmaterial = "{material}"\n'


def _sample(path, **more):
    from thermorender.apps.material_tables.from_samples import import_files

    origin = {} if path.suffix == ".txt" else {"source": "made", "citation": "none", "licence": "none"}
    import_files([path], path.parent / "materials", "tried", solar_absorptance=0.7, replace=True, **origin, **more)
    return _frame(_load(path.parent, emissivity=_of("tried")))


def _thermal(path):
    thermal = path.parent / "materials" / "thermal"
    thermal.mkdir(parents=True, exist_ok=True)
    (thermal / "asphalt.csv").write_bytes(path.read_bytes())
    return _frame(_load(path.parent, temperature=_BALANCE, emissivity=_of("asphalt"), more=_WEATHER))


def _flown(path, **more):
    """A frame from the middle of a flight."""
    from thermorender.trajectory.path import Anchor
    from thermorender.trajectory.readers import read_trajectory

    flight = read_trajectory(path, anchor=Anchor(0.5, 0.5, 30.0, 0.0), **more)
    return _frame(_base(), flight.pose(float(np.mean(flight.span_s))))


def _mapped(path):
    log = path.with_name("log.csv")
    log.write_text(DJI)
    return _flown(log, format=path)


def _along(path, read):
    """A frame from the middle of a log, at the reader's pose."""
    return _frame(_base(), read(path)[1])


def _through(path, air='file = "air.npz"\n'):
    """A frame through an atmosphere, by a camera of the same band."""
    camera = READERS["camera"]
    camera.make(path.parent)
    table = path.with_name(camera.file)
    table.write_text(re.sub("band_um = .*", "band_um = [9.0, 10.0]", table.read_text()))
    return _shown(path, around=f"[atmosphere]\n{air}", more='[camera]\nmodel = "camera.toml"\n')


def _by_tape7(path):
    """A frame through the air of a tape7."""
    of_tape7(path).save(path.with_name("air.npz"))
    return _through(path)


def _indexed(path):
    """A frame of ground of the first material in a library's index."""
    from thermorender.materials.library import read_library

    library = path.parent / "materials"
    library.mkdir(exist_ok=True)
    shutil.copy(path, library)
    shutil.copytree(path.parent / "spectra", library / "spectra", dirs_exist_ok=True)
    return _frame(_load(path.parent, emissivity=_of(next(iter(read_library(library)), "asphalt"))))


def _selected(path):
    """A frame of ground of the first material in a selection of samples."""
    from thermorender.apps.material_tables.from_samples import read_selection
    from thermorender.materials.store import write_materials

    made = read_selection(path, [path.parent])
    write_materials(made, path.parent / "materials", replace=True)
    return _frame(_load(path.parent, emissivity=_of(made[0].name)))


def _whole_scene(path):
    from thermorender.scene.load import load_scene

    return _frame(load_scene(path.parent))


def _translated(path, read):
    from thermorender.learned.temperature_map import Inputs, load_model

    return (load_model(TEMPERATURE_MAPS[-1]).radiance(Inputs(read(path)[0])),)


def _by_network(path):
    """A photograph through a network."""
    from thermorender.learned.temperature_map import Inputs, load_map

    noise = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    return (load_map(path).radiance(Inputs(noise, 0.2)),)


def _shown(path, **tables):
    """A frame of the scene with these tables, which refer to the file."""
    return _frame(_load(path.parent, **tables))


_LEARNED = 'source = "learned"\nmodel = "map.npz"\n'
_CLASSES = 'source = "classes"\nraster = "classes.tif"\n[emissivity.classes]\n' + "".join(
    f'{number} = "{name}"\n' for number, name in enumerate(("grass_dry", "asphalt", "water"), 1)
)
_CAR = """[[object]]
name = "car"
shape = "box"
size = [2.0, 3.0, 1.5]
position = [0.0, 0.0, 0.75]
temperature = 320.0
material = "asphalt"
track = "track.csv"
"""

# By the name of the reader. Readers that are left out do not read parts of a scene.
USES = {
    "camera": partial(_shown, more='[camera]\nmodel = "camera.toml"\n'),
    "trajectory mapping": _mapped,
    "trajectory": _flown,
    "track": partial(_shown, more=_CAR),
    "sounding": partial(_shown, around='[atmosphere]\nprofile = "profile.csv"\n'),
    "emissivity": partial(_in_library, directional="lambertian"),
    "refractive index": partial(_in_library, directional="fresnel"),
    "emissivity by angle": partial(_in_library, directional="table"),
    "thermal properties": _thermal,
    "sample": _sample,
    "ECOSTRESS": _sample,
    "weather": partial(_shown, temperature=_BALANCE, emissivity=_of("asphalt"), more=_STATION),
    "atmosphere": _through,
    "map correlation+": partial(_shown, temperature=_LEARNED, emissivity=_of("asphalt"), more=_WEATHER),
    "map palette": partial(_shown, temperature=_LEARNED),
    "map trees": partial(_shown, temperature=_LEARNED),
    "emissivity map": partial(_shown, emissivity='source = "learned"\nmodel = "map.npz"\nfallback = "asphalt"\n'),
    "elevation": _shown,
    "orthophoto": partial(_shown, temperature=f'source = "learned"\nmodel = "{TEMPERATURE_MAPS[-1]}"\n'),
    "scene": _whole_scene,
    "classes": partial(_shown, emissivity=_CLASSES),
    **{
        f"mesh {kind}": partial(_shown, terrain=f'mesh = "model.{kind.split()[0]}"\n')
        for kind in ("ply", "obj", "glb", "glb painted", "gltf")
    },
    **{f"mesh's coat.{kind}": partial(_shown, terrain='mesh = "model.obj"\n') for kind in ("mtl", "png")},
    "DJI log": partial(_along, read=READERS["DJI log"].read),
    "PX4 log": partial(_along, read=READERS["PX4 log"].read),
    "rocket log": partial(_along, read=READERS["rocket log"].read),
    **dict.fromkeys(
        ("absorption data", "gas profile"),
        partial(_through, air='profile = "gases.csv"\nabsorption = "absorption.npz"\n'),
    ),
    "tape7": _by_tape7,
    "weather year EPW": partial(_shown, temperature=_BALANCE, emissivity=_of("asphalt"), more=_YEAR.format("epw")),
    "weather year TMY3": partial(_shown, temperature=_BALANCE, emissivity=_of("asphalt"), more=_YEAR.format("csv")),
    "material index": _indexed,
    "SLUM": partial(_sample, columns=["A001"]),
    "selection of samples": _selected,
    "temperatures": partial(_shown, temperature='source = "raster"\nraster = "temperature.tif"\n'),
    "file beside a raster": _shown,
    **{
        name: partial(_translated, read=READERS[name].read)
        for name in ("picture", *(f"photograph{kind}" for kind in ("", " webp", " tif", " bmp", " jpg")))
    },
    "map compact": _by_network,
    "map unet-gan-keras": _by_network,
}
