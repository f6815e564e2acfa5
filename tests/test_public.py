"""The public names: what the package hands out, what type checkers see, and what `make lint` checks are the same."""

import ast
import sys
from pathlib import Path

import thermorender as tr

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = Path(tr.__file__).parent


def test_type_checkers_see_the_names_that_are_handed_out():
    tree = ast.parse((PACKAGE / "__init__.py").read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")
    seen = {alias.asname: node.module for node in block.body for alias in node.names if alias.asname == alias.name}
    assert seen == tr._PUBLIC
    for name in tr.__all__:
        assert getattr(tr, name).__name__ == name


def test_the_modules_of_all_public_names_are_checked():
    with open(ROOT / "pyproject.toml", "rb") as file:
        checked = tomllib.load(file)["tool"]["mypy"]["files"]
    assert all((ROOT / name).is_file() for name in checked)
    modules = {sys.modules[getattr(tr, name).__module__].__file__ for name in tr.__all__}
    assert {str(Path(path).relative_to(ROOT)) for path in modules} <= set(checked)


def test_the_package_says_that_it_has_types():
    assert (PACKAGE / "py.typed").is_file()
