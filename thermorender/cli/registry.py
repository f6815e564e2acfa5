"""Verbs by name: those of the core, and those that each package in `thermorender.apps` registers.

A package is found by its folder, so that the core names no application. Its modules are imported when a verb is called
or its help is shown.
"""

from functools import cache
from importlib import import_module
from pkgutil import iter_modules
from types import ModuleType
from typing import Any

import typer
from typer.core import TyperGroup

from thermorender import apps
from thermorender.cli.help import Command
from thermorender.errors import ThermorenderError

# Verb → "module:function" within `thermorender.cli`; a function's docstring is its help.
CORE = {
    "plan": "scenes:plan", "render": "render:render", "fly": "render:fly", "day": "render:day",
    "map-materials": "scenes:map_materials", "doctor": "doctor:doctor", "cache": "cached:cache",
}  # fmt: skip
# Place of the core's verbs in the help; that of an application is its own `RANK`.
_RANK = 20


@cache
def applications() -> tuple[ModuleType, ...]:
    """The packages in `thermorender.apps`, by name."""
    return tuple(import_module(f"{apps.__name__}.{found.name}") for found in iter_modules(apps.__path__))


@cache
def verbs() -> dict[str, str]:
    """Verb → "package.module:name", in the order of the work: by the `RANK` of who registers them."""
    parts = [(_RANK, "thermorender.cli", CORE)]
    parts += [(each.RANK, each.__name__, each.VERBS) for each in applications() if hasattr(each, "VERBS")]
    found: dict[str, str] = {}
    for _, package, named in sorted(parts, key=lambda part: part[0]):
        for name, place in named.items():
            assert name not in found, f"two parts register the verb {name}"
            found[name] = f"{package}.{place}"
    return found


@cache
def command(name: str) -> Any:
    """The parser of a verb, or of a group of verbs, a `Command` of click, or of the one inside typer."""
    module, _, attribute = verbs()[name].partition(":")
    found = getattr(import_module(module), attribute)
    if not isinstance(found, typer.Typer):
        verb, found = found, typer.Typer(add_completion=False, rich_markup_mode=None)
        found.command(name, cls=Command)(verb)
    made = typer.main.get_command(found)
    made.name = name
    return made


class Verbs(TyperGroup):
    """The group of all verbs, each made when it is called."""

    def list_commands(self, ctx: Any) -> list[str]:
        """All names, for the help."""
        return list(verbs())

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """The verb of a name, or None."""
        return command(cmd_name) if cmd_name in verbs() else None


def provided(what: str) -> Any:
    """The module that an application provides under a name, such as "workers"; an error where none does."""
    for application in applications():
        place = getattr(application, "PROVIDES", {}).get(what)
        if place:
            return import_module(f"{application.__name__}.{place}")
    raise ThermorenderError(f"no application in thermorender.apps provides {what!r}; install the whole package")
