"""Schemas of settings files: TOML tables read into frozen dataclasses, every key checked.

A dataclass describes one table. Its keys are the fields declared with `key`. The *reader* of a key converts the TOML
value, or refuses it in one sentence that names file, key, value and what is allowed. An undeclared key is an error.
Rules about several keys belong in a method `check(where, given)` of the dataclass.

A key's name ends in its unit (`row_time_us`); messages take the unit from there.
"""

import difflib
import json
import os
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import MISSING, dataclass, field, fields, make_dataclass, replace
from numbers import Integral, Real
from pathlib import Path
from typing import Any, NoReturn, TypeVar, cast

from thermorender.errors import ThermorenderError, shortened
from thermorender.paths import inside

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

_UNITS = {"um": "µm", "mm": "mm", "m": "m", "km": "km", "k": "K", "mk": "mK", "mk_per_k": "mK per K", "c": "°C",
          "hz": "Hz", "px": "px", "s": "s", "ms": "ms", "us": "µs", "deg": "deg", "percent": "%",
          "m_s": "m/s", "w": "W"}  # fmt: skip


@dataclass(frozen=True)
class Where:
    """A position in a settings file, for messages."""

    file: object  # Start of the messages
    folder: Path | None = None  # Folder that files named in the settings must be in
    key: str = ""  # Dotted; empty for the outermost table
    top: str = ""  # Name of the outermost table in a sentence; may be empty

    def __str__(self) -> str:
        return f"{self.file}: {self.key or self.top}"

    def of(self, key: object) -> "Where":
        """Return the position of a key of this table."""
        return replace(self, key=f"{self.key}.{key}" if self.key else str(key))

    def error(self, sentence: str) -> ThermorenderError:
        """Return an error that begins with the file."""
        return ThermorenderError(f"{self.file}: {sentence}")

    def refuse(self, value: object, allowed: str) -> NoReturn:
        """Raise the error that this key's value is not allowed."""
        try:
            shown = repr(value)
        except ValueError:  # a whole number too long for Python to write
            shown = "a number of thousands of digits"
        raise self.error(f"{self.key or self.top}={shortened(shown)} is not allowed; give {allowed}")

    def exactly_one(self, given: Iterable[str], keys: Iterable[str], why: str = "") -> str:
        """Return the one of `keys` that is given; raise if none or several are, with the reason `why` in brackets."""
        found = [key for key in keys if key in given]
        if len(found) != 1:
            count = f"{' and '.join(found) or 'none'} {'are' if len(found) > 1 else 'is'} given"
            table = self.key or self.top
            raise self.error(f"{table} needs exactly one of {', '.join(keys)}{why and f' ({why})'}, but {count}")
        return found[0]


Reader = Callable[[Any, Where], Any]
_Table = TypeVar("_Table")


def unit_of(key: str, before: str = " ") -> str:
    """Return the unit at the end of a key's name, after the text `before`; "" for a name without unit."""
    name = key.rpartition(".")[2]
    ends = [end for end in _UNITS if name.endswith(f"_{end}")]
    return before + _UNITS[max(ends, key=len)] if ends else ""


def closest(name: object, known: Iterable[object], count: int = 1, cutoff: float = 0.6) -> list[str]:
    """Return up to `count` known names like `name`, nearest first; `cutoff` is the least similarity, 0…1."""
    return difflib.get_close_matches(str(name), list(map(str, known)), n=count, cutoff=cutoff)


def did_you_mean(name: object, known: Iterable[object]) -> str:
    """Return "did you mean 'x' in µm? " or "", for a message that then lists what is allowed."""
    return "".join(f"did you mean {near!r}{unit_of(near, ' in ')}? " for near in closest(name, known))


# Tables


def key(read: Reader, default: Any = MISSING, name: str | None = None) -> Any:
    """Return the dataclass field of a key, which `read` converts from (value, Where); without default it is required.

    `name` is the key's name in the file, if it differs from the field's.
    """
    kept = {"default": default} if default.__hash__ else {"default_factory": lambda: copy(default)}
    return field(**kept, metadata={"read": read, "name": name})


def read(cls: type[_Table], raw: object, where: Where, **more: Any) -> _Table:
    """Return a dataclass of a table's values, every key checked; `more` are values of fields that are not keys."""
    if not isinstance(raw, dict):
        where.refuse(raw, "a table")
    rows = {item.metadata["name"] or item.name: item for item in fields(cast(Any, cls)) if "read" in item.metadata}
    within = where.key or where.top
    within = f" in {within}" if within else ""
    for name in raw:
        if name not in rows:
            hint = did_you_mean(name, rows)
            raise where.error(f"unknown key {name!r}{within}; {hint}allowed are {', '.join(rows)}")
    values = dict(more)
    for name, item in rows.items():
        if name in raw:
            values[item.name] = item.metadata["read"](raw[name], where.of(name))
        elif item.default is MISSING and item.default_factory is MISSING:
            raise where.error(f"key {name!r} is missing{within}; add it{unit_of(name, ' in ')}")
    found = cls(**values)
    if hasattr(found, "check"):
        found.check(where, raw)
    return found


def checked(settings: Any, name: str) -> dict[str, Any]:
    """Return {field: value} of a dataclass made in code, checked by its readers; messages begin with `name`."""
    where = Where(name)
    rows = (item for item in fields(settings) if "read" in item.metadata)
    return {item.name: item.metadata["read"](getattr(settings, item.name), where.of(item.name)) for item in rows}


def every_field(value: Any, *without: str) -> str:
    """Return the text of a dataclass with all its fields but some, as `Camera(name='…', …)`, for fingerprints."""
    names = (item.name for item in fields(value) if item.name not in without)
    shown = ", ".join(f"{name}={getattr(value, name)!r}" for name in names)
    return f"{type(value).__qualname__}({shown})"


# Readers


def number(
    low: float = -float("inf"), high: float = float("inf"), above: bool = False, whole: bool = False, count: int = 1,
    ordered: bool = False, unit: str = "",
) -> Reader:  # fmt: skip
    """Return the reader of a finite number, low … high, or of a list of `count` numbers, which becomes a tuple.

    `above`: `low` itself is not allowed. `whole`: the value becomes an int instead of a float. `ordered`: the list must
    rise. `unit` is for the message, if the key's name does not end in it.
    """
    return _Number(low, high, above, whole, count, ordered, unit)


@dataclass(frozen=True)
class _Number:
    """The reader that `number` returns."""

    low: float
    high: float
    above: bool
    whole: bool
    count: int
    ordered: bool
    unit: str

    @property
    def words(self) -> str:
        """What is allowed, for a message."""
        low, high = self.low, self.high
        ends = f"{low:g}…{high:g}" if high < float("inf") else f"of at least {low:g}" if low > -float("inf") else ""
        if self.above:
            ends = f"above {low:g}" + (f" and up to {high:g}" if high < float("inf") else "")
        kind = f"{'' if ends else 'finite '}{'whole ' if self.whole else ''}number"
        several = f"a list of {self.count} {kind}s" if self.count > 1 else f"a {kind}"
        return f"{several}{ends and ' ' + ends}{self.unit and ' ' + self.unit}"

    def fits(self, value: Any) -> bool:
        """Return whether a value is a number of the range."""
        # The bound also refuses NaN, infinity and whole numbers beyond float64.
        if isinstance(value, bool) or not isinstance(value, Real):
            return False
        # NumPy's single precision has no 1e300 to compare with.
        number: Any = value if isinstance(value, (int, float)) else float(value)
        within = number > self.low if self.above else number >= self.low
        return bool(
            abs(number) < 1e300 and within and number <= self.high and (not self.whole or number == int(number))
        )

    def __call__(self, value: Any, where: Where) -> Any:
        values = value if self.count > 1 else [value]
        good = isinstance(values, (list, tuple)) and len(values) == self.count and all(map(self.fits, values))
        if not good or (self.ordered and any(a >= b for a, b in zip(values, values[1:], strict=False))):
            order = ", the lower value first" if self.ordered else ""
            where.refuse(value, f"{self.words}{unit_of(where.key)}{order}")
        read = tuple(map(int if self.whole else float, values))
        return read if self.count > 1 else read[0]


def choice(*allowed: Any) -> Reader:
    """Return the reader of a value that must be one of `allowed`."""
    names = ", ".join(str(one).lower() if isinstance(one, bool) else str(one) for one in allowed)

    def read_choice(value: Any, where: Where) -> Any:
        for one in allowed:
            if value == one and isinstance(value, bool) == isinstance(one, bool):
                return one
        where.refuse(value, f"one of {names}{unit_of(where.key)}")

    return read_choice


flag = choice(False, True)


def text(value: Any, where: Where) -> str:
    """Read a text that is not blank."""
    if not isinstance(value, str) or not value.strip():
        where.refuse(value, "a text")
    return value


def texts(value: Any, where: Where) -> tuple[str, ...]:
    """Read a list of texts."""
    if not isinstance(value, list):
        where.refuse(value, "a list of texts")
    return tuple(text(item, where) for item in value)


def file_inside(value: Any, where: Where) -> Path:
    """Read the name of a file inside the settings' folder; return its Path."""
    folder = where.folder or Path()
    try:
        path = Path(os.path.realpath(folder / text(value, where)))
        there = path.is_file()
    except ThermorenderError:
        raise
    except (OSError, ValueError):  # too long, or with a NUL in it
        where.refuse(value, "the name of a file")
    if not inside(path, folder):
        where.refuse(value, f"a path inside {where.top or 'the file'}'s folder")
    if not there:
        raise where.error(f"{where.key}={value!r} does not exist; give a file in {folder}")
    return path


class FrozenDict(dict[Any, Any]):
    """A dict of settings that cannot be changed."""

    def _refuse(self, *values: Any, **more: Any) -> NoReturn:
        raise ThermorenderError("these settings cannot be changed; make other ones and give those")

    __setitem__ = __delitem__ = __ior__ = update = pop = popitem = setdefault = clear = _refuse

    def __reduce__(self) -> tuple[Any, ...]:
        return FrozenDict, (dict(self),)


def mapping(read_value: Reader, read_key: Reader = lambda key, where: key) -> Reader:
    """Return the reader of a table with any keys, at least one; `read_key` takes (key, Where of the table)."""

    def read_mapping(value: Any, where: Where) -> Any:
        if not isinstance(value, dict) or not value:
            where.refuse(value, "a table with at least one entry")
        return FrozenDict({read_key(name, where): read_value(item, where.of(name)) for name, item in value.items()})

    return read_mapping


def table(cls: type) -> Reader:
    """Return the reader of a table into a dataclass."""
    return lambda value, where: read(cls, value, where)


def tables(cls: type) -> Reader:
    """Return the reader of tables headed [[key]] into a tuple of dataclasses; messages use each table's `name`."""

    def read_tables(value: Any, where: Where) -> tuple[Any, ...]:
        if not isinstance(value, list):
            where.refuse(value, f"tables headed [[{where.key}]]")
        names = (item.get("name", index) if isinstance(item, dict) else index for index, item in enumerate(value, 1))
        return tuple(
            read(cls, item, replace(where, key=f"{where.key} {name!r}"))
            for name, item in zip(names, value, strict=True)
        )

    return read_tables


def entry(name: str, read_value: Reader, default: Any = MISSING) -> Reader:
    """Return the reader of a table with a single key; the result is that key's value."""
    cls = make_dataclass("Entry", [(name, object, key(read_value, default))])
    return lambda value, where: getattr(read(cls, value, where), name)


# TOML


def read_toml(path: Any, name: str | None = None) -> dict[str, Any]:
    """Return the dict of a TOML file, with or without a byte order mark; messages begin with `name` or the path."""
    name = path if name is None else name
    try:
        data = path.read_bytes()
    except OSError as error:
        raise ThermorenderError(f"{name} cannot be read: {error.strerror}") from None
    return parse_toml(data, name)


def parse_toml(data: bytes, name: Any) -> dict[str, Any]:
    """Return the dict of the contents of a TOML file; messages begin with `name`, as of `read_toml`."""
    try:
        return tomllib.loads(data.decode("utf-8-sig"))
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        raise ThermorenderError(f"{name} is not valid TOML: line {line} is not UTF-8; save it as UTF-8") from None
    except RecursionError:
        raise ThermorenderError(f"{name} is not valid TOML: brackets are nested too deeply; close them") from None
    except ValueError as error:  # TOMLDecodeError, or a number too long for Python
        twice = "twice" in str(error) or "overwrite" in str(error)
        advice = "; leave one of the two out" if twice else ""
        raise ThermorenderError(f"{name} is not valid TOML: {error}{advice}") from None


def toml_text(values: Mapping[str, Any], comment: str = "") -> str:
    """Return the text of a TOML file with a comment at its top.

    A dict becomes a table, a list of dicts becomes tables headed [[key]], and None is left out.
    """
    lines = [f"# {_harmless(line)}".rstrip() for line in comment.split("\n")] if comment else []
    return "\n".join([*lines, *_table_lines(values, ())]).strip("\n") + "\n"


def toml_line(name: str, value: Any, comment: str = "") -> str:
    """Return the line of a key, with a comment at its end."""
    return f"{_toml_key(name)} = {toml_value(value)}" + (f"  # {_harmless(comment)}" if comment else "")


def toml_value(value: Any) -> str:
    """Return a value in TOML's notation."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (str, Path)):
        return _quoted(str(value))
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, dict):
        return "{" + ", ".join(toml_line(name, item) for name, item in value.items() if item is not None) + "}"
    if isinstance(value, Real):
        return repr(int(value) if isinstance(value, Integral) else float(value))
    raise TypeError(f"{value!r} has no form in TOML")


def _table_lines(values: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    plain, below = [], []
    for name, value in values.items():
        here = (*path, _toml_key(name))
        if isinstance(value, dict):
            below += ["", f"[{'.'.join(here)}]", *_table_lines(value, here)]
        elif isinstance(value, (list, tuple)) and value and all(isinstance(item, dict) for item in value):
            for item in value:
                below += ["", f"[[{'.'.join(here)}]]", *_table_lines(item, here)]
        elif value is not None:
            plain.append(toml_line(name, value))
    return plain + below


def _toml_key(name: object) -> str:
    return str(name) if re.fullmatch("[A-Za-z0-9_-]+", str(name)) else _quoted(str(name))


def _quoted(value: str) -> str:
    """A TOML basic string: JSON's escapes are valid in TOML, but JSON does not escape the delete character."""
    try:
        value.encode("utf-8")
    except UnicodeEncodeError:
        raise ThermorenderError(f"{value!r} is not valid Unicode and cannot be written to TOML; rename it") from None
    return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")


def _harmless(comment: str) -> str:
    """A one-line comment without the characters that TOML forbids in comments."""
    return re.sub("[\x00-\x1f\x7f\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", comment)
