"""Settings that users write: TOML and JSON."""

import json
from importlib import resources

import numpy as np

from tests.robustness.fuzz.corpus.images import write_colour, write_elevation
from tests.robustness.fuzz.corpus.registry import reader

_PACKAGE = resources.files("thermorender")


@reader("camera", "camera.toml", _PACKAGE / "sensor" / "cameras" / "zenmuse-xt2-9mm.toml")
def _camera(path):
    from thermorender.sensor.camera import load_camera

    camera = load_camera(path)
    return camera, camera.directions(np.array([[0.5, 0.5]]))


_SCENE = """title = "small"
[terrain]
elevation = "elevation.tif"
orthophoto = "orthophoto.tif"
[temperature]
source = "constant"
value = 290.0
[emissivity]
source = "constant"
value = 0.95
[camera]
model = "zenmuse-xt2"
[atmosphere]
standard = "us-1976"
aerosol = "rural-23km"
[[object]]
name = "plate"
shape = "disc"
size = [2.0, 2.0, 0.1]
position = [0.3, 0.2, 0.05]
temperature = 360.0
material = "paint_black"
"""


@reader("trajectory mapping", "mapping.toml", _PACKAGE / "trajectory" / "formats" / "dji-gimbal.toml")
def _mapping(path):
    from thermorender.trajectory.column_mapping import load_mapping

    return load_mapping(str(path))


@reader("rig", "rig.json", json.dumps({
    "format": 1, "visible_shape": [96, 128], "thermal_shape": [64, 80], "scale": 1.5, "aspect": 1.0,
    "shift_px": [1.0, -2.0], "rotation_deg": 0.5, "k1": -0.01,
}))  # fmt: skip
def _rig(path):
    from thermorender.apps.training.registration.rig import load_rig

    return load_rig(path)


@reader("split", "split.json", json.dumps({"train": ["a", "b"], "validation": ["c"], "test": ["d"]}))
def _split(path):
    from thermorender.apps.training.splits import read_split

    return read_split(path)


def _write_scene(path):
    path.write_text(_SCENE)
    write_elevation(path.with_name("elevation.tif"))
    write_colour(path.with_name("orthophoto.tif"))


@reader("scene", "scene.toml", _write_scene)
def _scene(path):
    from thermorender.scene.spec import read_scene

    return read_scene(path.parent)


def _polygon(name, left, right):
    ring = [[500000 + x, 5000000 - y] for x, y in ((left, 1), (right, 1), (right, 20), (left, 20), (left, 1))]
    return {"properties": {"material": name}, "geometry": {"type": "Polygon", "coordinates": [ring]}}


def _write_polygons(path):
    path.write_text(json.dumps({
        "type": "FeatureCollection", "crs": {"properties": {"name": "EPSG:32632"}},
        "features": [_polygon("grass_green", 2, 9), _polygon("asphalt", 12, 20)],
    }))  # fmt: skip
    write_colour(path.with_name("orthophoto.tif"))


@reader("polygons", "ground.geojson", _write_polygons)
def _polygons(path):
    from thermorender.apps.training.material_training import read_polygons
    from thermorender.scene.raster import grid_of

    return read_polygons(path, grid_of(path.with_name("orthophoto.tif")))


@reader("split table", "split.csv", "key,part\na,train\nb,train\nc,validation\nd,test\n")
def _split_table(path):
    return _split(path)
