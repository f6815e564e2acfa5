"""Values of a TOML file changed line by line, so that its comments and its layout stay."""

import re
from itertools import pairwise

from thermorender.errors import ThermorenderError

# A line that assigns a string or a number.
_ASSIGNED = re.compile(r"""(?P<key>[^=]*=\s*)("(\\.|[^"\\])*"|'[^']*'|[^\s"'#]+)(?P<comment>\s*(#.*)?)""")


def stated(text: str, table: str, name: str | None, key: str, value: str | None) -> str:
    """Return the text of a scene file in which `key` of a table, given by its first line such as "[[object]]" and its
    name, has another value; None removes it. A name that the only table lacks is added.
    """
    lines = text.splitlines(keepends=True)
    bare = [line.split("#")[0].strip() for line in lines]
    for start, end in pairwise([*(k for k, line in enumerate(bare) if line.startswith("[")), len(lines)]):
        pairs = {k: tuple(part.strip("\"' ") for part in bare[k].partition("=")[::2]) for k in range(start + 1, end)}
        if bare[start] != table or (name is not None and ("name", name) not in pairs.values()):
            continue
        at = next((k for k, (known, _) in pairs.items() if known == key), None)
        if at is None and name is None:
            return "".join([*lines[: start + 1], f"{key} = {value}\n", *lines[start + 1 :]])
        if at is not None and value is None:
            return "".join([*lines[:at], *lines[at + 1 :]])
        if at is not None and (assigned := _ASSIGNED.fullmatch(lines[at].rstrip("\n"))):
            return "".join([*lines[:at], f"{assigned['key']}{value}{assigned['comment']}\n", *lines[at + 1 :]])
        break
    raise ThermorenderError(
        f"scene.toml does not state {key} of {name or table} on a line of its own, so it cannot be changed there; "
        f"write {key} = {value} there by hand and read the scene again"
    )
