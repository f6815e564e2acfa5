"""Who imports what: the rooms' borders, and how little a light use loads."""

import ast
import subprocess
import sys
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

PACKAGE = Path(__file__).resolve().parents[1] / "thermorender"
OWNER = {"mitsuba": "render", "drjit": "render", "torch": "learned"}
PURE = {"numpy", "thermorender"}


def imports(path):
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield node.module or ""


def room(path):
    parts = path.relative_to(PACKAGE).parts
    return parts[0] if len(parts) > 1 else path.stem


def test_libraries_stay_in_their_room():
    for path in PACKAGE.rglob("*.py"):
        for name in imports(path):
            owner = OWNER.get(name.split(".")[0])
            assert owner in (None, room(path)), f"{path} imports {name}, which belongs to {owner}/"


def test_physics_is_pure():
    allowed = PURE | {"dataclasses"}
    for path in (PACKAGE / "physics").glob("*.py"):
        for name in imports(path):
            assert name.split(".")[0] in allowed, f"{path} imports {name}"
            assert not name.startswith("thermorender.") or name.split(".")[1] in ("physics", "errors", "units"), path


def modules(path):
    """Names of the package's own modules that a file imports anywhere, `from package import module` too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            inner = [f"{node.module}.{alias.name}" for alias in node.names]
            found = [name for name in inner if (PACKAGE.parent / name.replace(".", "/")).with_suffix(".py").exists()]
            yield from found or [node.module]


def test_the_air_stands_on_physics_and_runs_in_no_circle():
    below = {"errors", "units", "paths", "versions", "files", "schema", "physics", "atmosphere"}
    graph = {}
    for path in (PACKAGE / "atmosphere").rglob("*.py"):
        name = "thermorender." + ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        graph[name] = {other for other in modules(path) if other.startswith("thermorender.")}
        assert {other.split(".")[1] for other in graph[name]} <= below, f"{path} reaches forward"
    assert len(graph) > 10
    for other in graph.values():
        other &= graph.keys()
    # Raises CycleError, which names the circle.
    tuple(TopologicalSorter(graph).static_order())


def test_data_flow_has_one_direction():
    order = ["physics", "atmosphere", "sensor", "learned", "scene", "render", "validate"]
    for path in PACKAGE.rglob("*.py"):
        here = room(path)
        if here not in order:
            continue
        for name in imports(path):
            parts = name.split(".")
            if parts[0] == "thermorender" and len(parts) > 1 and parts[1] in order:
                assert order.index(parts[1]) <= order.index(here), f"{path} reaches forward into {name}"


@pytest.mark.parametrize(
    ("code", "absent"),
    [
        (
            "import thermorender, thermorender.cli",
            ("mitsuba", "drjit", "torch", "rasterio", "scipy", "cv2", "matplotlib", "trimesh"),
        ),
        ("import thermorender as tr; tr.load_scene('heath')", ("mitsuba", "drjit", "torch", "matplotlib")),
        ("import thermorender as tr; tr.Renderer(tr.load_scene('heath'), rays=1)", ("torch", "matplotlib")),
    ],
)
def test_light_use_loads_little(code, absent):
    check = (
        f"import sys\n{code}\nfound = [name for name in {absent!r} if name in sys.modules]\n"
        "sys.exit(str(found) if found else 0)"
    )
    run = subprocess.run([sys.executable, "-c", check], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
