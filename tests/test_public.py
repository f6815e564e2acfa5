"""The public names: the package's exports, what type checkers see, and what `make lint` checks are the same."""

import ast
import re
import sys
from importlib import import_module, metadata
from pathlib import Path

import pytest

import thermorender as tr
from thermorender.cli import registry

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(tr.__file__).parent


def test_type_checkers_see_the_exported_names():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    seen = {alias.asname: node.module for node in imports for alias in node.names if alias.asname == alias.name}
    assert set(seen) == set(tr.__all__)
    for name, home in seen.items():
        assert getattr(tr, name) is getattr(import_module(home), name)
        assert getattr(tr, name).__name__.rpartition(".")[2] == name


def test_the_nouns_of_the_field_are_public():
    nouns = {"Atmosphere", "Camera", "Frame", "Material", "Scene", "TemperatureMap", "Trajectory", "Weather"}
    verbs = {"compare", "fly", "load_camera", "load_scene", "load_trajectory", "pose"}
    assert nouns | verbs | {"Renderer"} <= set(tr.__all__)
    assert all(callable(getattr(tr, name)) for name in tr.__all__ if name != "link")
    assert {"connect", "Product"} <= set(tr.link.__all__)


def test_the_modules_of_all_public_names_are_checked():
    with open(ROOT / "pyproject.toml", "rb") as file:
        checked = tomllib.load(file)["tool"]["mypy"]["files"]
    assert all((ROOT / name).exists() for name in checked)
    found = [getattr(tr, name) for name in tr.__all__]
    homes = [sys.modules[each.__module__] if hasattr(each, "__module__") else each for each in found]
    modules = {Path(home.__file__).relative_to(ROOT) for home in homes}
    for module in modules:
        assert any(module.is_relative_to(name) for name in checked), module


def test_the_version_is_that_of_the_installed_package():
    assert tr.__version__ == metadata.version("thermorender")
    assert "__version__" in dir(tr)
    with pytest.raises(AttributeError, match="module 'thermorender' has no attribute '__author__'"):
        tr.__author__  # noqa: B018


def test_the_package_declares_its_types():
    assert (PACKAGE / "py.typed").is_file()


# --- the README ---------------------------------------------------------------------------------------------

README = (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_verbs_of_the_readme_exist_with_their_options():
    commands = {name: registry.command(name) for name in registry.verbs()}
    listed = set()
    for row in re.findall(r"^\| (`thermorender .*)\|$", README, flags=re.M):
        words = re.findall(r"`([^`]+)`", row.split(" | ")[0])
        verb, *rest = words[0].split()[1:]
        listed.add(verb)
        group = getattr(commands[verb], "commands", None)
        # A row with a group's name alone is that of the group itself.
        if group and rest:
            below = {rest[0], *(word.split()[0] for word in words[1:])}
            assert below <= set(group), verb
            within = [group[name] for name in below]
        else:
            within = [commands[verb]]
        known = {option for command in within for parameter in command.params for option in parameter.opts}
        assert set(re.findall(r"(?<![\w-])--?[a-z][\w-]*", row)) <= known, row
    assert {"render", "fly", "compare"} <= listed
