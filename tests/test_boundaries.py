"""Imports: rooms import only downwards, libraries stay with their owners, and light use loads little."""

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from support import slow

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))
import architecture

from thermorender import link

OWNERS = {"mitsuba": {"render"}, "drjit": {"render"}, "torch": {"learned", "apps.training"}}
ORDER = list(architecture.CORE)


def test_every_module_has_a_known_room():
    for module in architecture.modules():
        room = architecture.room_of(module)
        assert room is None or room in ORDER or room.removeprefix("apps.") in architecture.APPS, module


def test_libraries_stay_in_their_room():
    for module, path in architecture.modules().items():
        for name in architecture.imports(path):
            owners = OWNERS.get(name.split(".")[0])
            assert owners is None or architecture.room_of(module) in owners, f"{path} imports {name}, of {owners}"


def test_package_imports_nothing_from_the_checkout():
    for path in architecture.modules().values():
        tops = {name.split(".")[0] for name in architecture.imports(path)}
        assert not tops & {"validation", "tests", "examples", "tools"}, path


def test_physics_is_pure():
    allowed = {"numpy", "thermorender", "collections", "dataclasses", "functools", "itertools", "typing"}
    for module, path in architecture.modules().items():
        if architecture.room_of(module) == "physics":
            assert {name.split(".")[0] for name in architecture.imports(path)} <= allowed, path


def test_rooms_of_the_core_import_only_from_those_below():
    for here, there in architecture.room_imports():
        if here in ORDER and there in ORDER:
            assert ORDER.index(there) < ORDER.index(here), f"{here} imports {there}, which lies above it"


def test_the_core_imports_no_application_and_applications_only_public_names():
    assert architecture.crossings() == []


def test_users_page_lists_each_exported_name_once():
    page = architecture.USERS.read_text(encoding="utf-8")
    names = re.findall(r"^\.\. auto(?:class|function):: thermorender\.(\w+)$", page, flags=re.M)
    assert sorted(names) == sorted(set(architecture.exported()) - {"link"})
    listed = architecture.listed(architecture.USERS)
    assert {name for module, name in listed if module == "apps.link"} == set(link.__all__)


def test_users_page_lists_further_what_pages_and_examples_use_and_no_more():
    further = {(module, name) for module, name in architecture.listed(architecture.USERS) if module != "apps.link"}
    front = {(home, name) for name, home in architecture.exported().items()}
    assert further == architecture.used_by_scripts() - front


def test_applications_page_lists_further_what_applications_use_and_no_more():
    front = {(home, name) for name, home in architecture.exported().items()}
    known = front | architecture.listed(architecture.USERS)
    assert architecture.listed(architecture.APPLICATIONS) == set(architecture.used_by_applications()) - known


def test_module_and_class_names_of_the_core_are_unique():
    homes = defaultdict(set)
    for module, path in architecture.modules().items():
        if architecture.room_of(module) in ORDER:
            tree = ast.parse(path.read_text(encoding="utf-8"))
            classes = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)]
            for number, name in enumerate((path.stem, *(node.name for node in classes))):
                homes[name].add((module, number))
    del homes["__init__"]
    assert {name: found for name, found in homes.items() if len(found) > 1} == {}


def test_public_names_exist():
    known, names = architecture.modules(), {}
    for module, name in architecture.public_names():
        if f"{module}.{name}" not in known:
            names.setdefault(module, set()).add(name)
    for module, wanted in names.items():
        tree = ast.parse(known[module].read_text(encoding="utf-8"))
        found = {node.id for node in ast.walk(tree) if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)}
        found |= {node.name for node in tree.body if hasattr(node, "name")}
        found |= {alias.name for node in tree.body if isinstance(node, ast.ImportFrom) for alias in node.names}
        assert wanted <= found, module


def test_no_circular_imports():
    assert architecture.circles() == []


def test_drawing_matches_the_code():
    assert architecture.DRAWING.read_text(encoding="utf-8") == architecture.drawing(), (
        "docs/architecture.svg is out of date; run python docs/architecture.py"
    )


@pytest.mark.parametrize(
    ("source", "found"),
    [
        ("from thermorender import files", {"thermorender", "thermorender.files"}),
        ("def f():\n    from thermorender.render.plan import make_plan as m", {"thermorender.render.plan"}),
        ("import thermorender.sensor.camera as c, os", {"thermorender.sensor.camera", "os"}),
    ],
)
def test_every_form_of_import_is_found(source, found, tmp_path):
    (tmp_path / "m.py").write_text(source, encoding="utf-8")
    assert found <= architecture.imports(tmp_path / "m.py")


HEAVY = ("mitsuba", "drjit", "torch", "rasterio", "scipy", "cv2", "matplotlib", "trimesh")
# What a scene without a heat balance or a moved map does not need.
BALANCE = tuple(
    f"thermorender.{name}"
    for name in ("render.heat.simulation", "scene.open_ground", "physics.balance", "weather.station")
)
MOVED = ("thermorender.render.heat.moved", "thermorender.materials.shifted", "thermorender.render.heat.simulation")
HEATH = "import thermorender as tr; heath = tr.load_scene('heath/survey')"


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        ("import thermorender, thermorender.cli.app", HEAVY),
        ("import thermorender.apps.link", (*HEAVY, "typer")),
        (HEATH, ("mitsuba", "drjit", "torch", "matplotlib", "trimesh")),
        (f"from thermorender.render.renderer import Renderer; {HEATH}", BALANCE),
        *slow((f"{HEATH}; tr.Renderer(heath, rays=1)", ("torch", "matplotlib", *MOVED))),
    ],
)
def test_light_use_loads_few_libraries(code, absent):
    check = (
        f"import sys\n{code}\nfound = [name for name in {absent!r} if name in sys.modules]\n"
        "sys.exit(str(found) if found else 0)"
    )
    run = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
