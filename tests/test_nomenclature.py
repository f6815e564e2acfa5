"""Every name of docs/nomenclature.md occurs in the code of its room."""

import ast
import functools
import re
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "docs"))
import architecture

PAGE = architecture.DRAWING.with_name("nomenclature.md").read_text(encoding="utf-8")
CONVENTIONS, *ROOMS = re.split(r"^## ", PAGE, flags=re.M)[1:]
ROOM_TEXT = {text.split("\n", 1)[0]: text for text in ROOMS}


@functools.cache
def names_of(room=None):
    """(identifiers of a room's code, with texts that are keys; "Class.member" of its classes); of all rooms if None."""
    modules = architecture.modules().items()
    parts = [names_in(path) for module, path in modules if room in (None, architecture.room_of(module))]
    return tuple(set().union(*names) for names in zip(*parts, strict=True))


@functools.cache
def names_in(path):
    found, members = set(), set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        for field in ("name", "id", "arg", "attr"):
            found.add(getattr(node, field, None))
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and node.value.isidentifier():
            found.add(node.value)
        if isinstance(node, ast.ClassDef):
            own = [
                each.targets[0] if isinstance(each, ast.Assign) else getattr(each, "target", each) for each in node.body
            ]
            members |= {f"{node.name}.{getattr(each, 'id', getattr(each, 'name', None))}" for each in own}
    return found - {None}, members


def unknown(text, room=None):
    """The names in backticks of a text that do not occur in the room's code; "_ending" matches any name's ending."""
    found, members = names_of(room)
    every, _ = names_of()
    for name in re.findall(r"`([^`]+)`", text):
        if name == "(H, W)" or name == "(4, 4)":
            continue
        if name.startswith("_"):
            known = any(each.endswith(name) for each in every)
        else:
            known = name in (members if "." in name else found)
        if not known:
            yield name


def rows(text):
    """The cells of the tables in a text, without their headers."""
    lines = re.findall(r"^\| (.+) \|$", text, flags=re.M)
    return [line.split(" | ") for line in lines if not line.startswith(("symbol |", "letter in"))]


def test_names_in_the_conventions_exist():
    assert list(unknown(CONVENTIONS)) == []


@pytest.mark.parametrize("room", ROOM_TEXT)
def test_names_occur_in_the_code_of_their_room(room):
    assert room in architecture.CORE or f"apps.{room}" in architecture.APPS
    table = rows(ROOM_TEXT[room])
    assert table and all(len(cells) == 4 and all(cells) for cells in table), table
    assert [name for _, name, _, _ in table for name in unknown(name, room)] == []
    assert [name for _, _, _, meaning in table for name in unknown(meaning)] == []
    listed = [name for _, cell, _, _ in table for name in re.findall(r"`([^`]+)`", cell)]
    assert len(listed) == len(set(listed)), "a name is listed twice"
