"""Settings as tables: what is refused and in which words, and TOML written so that it reads back."""

import random
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from thermorender import schema
from thermorender.errors import ThermorenderError
from thermorender.schema import Where, key, number, read, read_toml, toml_line, toml_text

WHERE = Where("s.toml", top="the table")


@dataclass(frozen=True)
class Inner:
    name: str = key(schema.text)
    depth_m: float = key(number(0.0, 10.0, above=True), 1.0)


@dataclass(frozen=True, kw_only=True)
class Table:
    folder: str = "no key"
    width: int = key(number(1, 64, whole=True, unit="pixels"))
    range_c: tuple = key(number(-50.0, 50.0, count=2, ordered=True), (0.0, 1.0))
    size: tuple = key(number(0.0, above=True, count=3, unit="m"), (1.0, 1.0, 1.0))
    low: float = key(number(2.0), 2.0)
    free: float = key(number(), 0.0)
    mode: object = key(schema.choice("a", True, 40.0), "a")
    on: bool = key(schema.flag, False)
    tags: tuple = key(schema.texts, ())
    classes: dict = key(schema.mapping(number()), {})
    inner: Inner | None = key(schema.table(Inner), None)
    items: tuple = key(schema.tables(Inner), (), name="item")
    sky: float | None = key(schema.entry("temperature", number()), None)


def test_a_table_is_read_into_its_dataclass():
    raw = {"width": 8.0, "range_c": [1, 2], "tags": ["x"], "classes": {"4": 2}, "inner": {"name": "n"},
           "item": [{"name": "a", "depth_m": 3}, {"name": "b"}], "sky": {"temperature": 250}, "mode": 40}  # fmt: skip
    found = read(Table, raw, WHERE, folder="f")
    assert found == Table(
        folder="f", width=8, range_c=(1.0, 2.0), tags=("x",), classes={"4": 2.0}, inner=Inner("n"), mode=40.0,
        items=(Inner("a", 3.0), Inner("b")), sky=250.0,
    )  # fmt: skip
    assert isinstance(found.width, int) and isinstance(found.mode, float)
    # A table left out is its own each time.
    one, other = (read(Table, {"width": 1}, WHERE) for _ in range(2))
    assert one.classes == {} and one.classes is not other.classes


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({}, "s.toml: key 'width' is missing in the table; add it"),
        ({"widht": 1}, "s.toml: unknown key 'widht' in the table; did you mean 'width'? allowed are width, range_c, "),
        ({"widths": 1, "folder": 1}, "s.toml: unknown key 'widths' in the table; did you mean 'width'? allowed are "),
        ({"width": 1, "folder": 1}, "s.toml: unknown key 'folder' in the table; "),
        ({"width": 1, "%": 1}, "s.toml: unknown key '%' in the table; allowed are width, "),
        ({"width": 1, "inner": {"name": "n", "depth": 1}},
         "s.toml: unknown key 'depth' in inner; did you mean 'depth_m' in m? allowed are name, depth_m"),
        ({"width": 1, "inner": 3}, "s.toml: inner=3 is not allowed; give a table"),
        ({"width": 0}, "s.toml: width=0 is not allowed; give a whole number 1…64 pixels"),
        ({"width": 1.5}, "s.toml: width=1.5 is not allowed; give a whole number 1…64 pixels"),
        ({"width": True}, "s.toml: width=True is not allowed; give a whole number 1…64 pixels"),
        ({"width": "8"}, "s.toml: width='8' is not allowed; give a whole number 1…64 pixels"),
        ({"width": 16**5000}, "s.toml: width=a number of thousands of digits is not allowed; give a whole number"),
        ({"width": 1, "range_c": [2, 2]},
         "range_c=[2, 2] is not allowed; give a list of 2 numbers -50…50 °C, the lower value first"),
        ({"width": 1, "range_c": [2]}, "range_c=[2] is not allowed; give a list of 2 numbers -50…50 °C, the lower"),
        ({"width": 1, "size": [1, 0, 1]}, "size=[1, 0, 1] is not allowed; give a list of 3 numbers above 0 m"),
        ({"width": 1, "low": 1.9}, "low=1.9 is not allowed; give a number of at least 2"),
        ({"width": 1, "free": float("nan")}, "free=nan is not allowed; give a finite number"),
        ({"width": 1, "free": float("inf")}, "free=inf is not allowed; give a finite number"),
        ({"width": 1, "free": 10**400}, "is not allowed; give a finite number"),
        ({"width": 1, "mode": 1}, "mode=1 is not allowed; give one of a, true, 40.0"),
        ({"width": 1, "mode": []}, "mode=[] is not allowed; give one of a, true, 40.0"),
        ({"width": 1, "on": 1}, "on=1 is not allowed; give one of false, true"),
        ({"width": 1, "tags": "x"}, "tags='x' is not allowed; give a list of texts"),
        ({"width": 1, "tags": [" "]}, "tags=' ' is not allowed; give a text"),
        ({"width": 1, "classes": {}}, "classes={} is not allowed; give a table with at least one entry"),
        ({"width": 1, "classes": {"4": "x"}}, "classes.4='x' is not allowed; give a finite number"),
        ({"width": 1, "item": {}}, "item={} is not allowed; give tables headed [[item]]"),
        ({"width": 1, "item": [{"name": "a"}, {}]}, "key 'name' is missing in item 2; add it"),
        ({"width": 1, "item": [{"name": "a", "depth_m": 11}]},
         "item 'a'.depth_m=11 is not allowed; give a number above 0 and up to 10 m"),
        ({"width": 1, "sky": {}}, "key 'temperature' is missing in sky; add it"),
        ({"width": 1, "tags": 200 * "x"}, f"tags='{159 * 'x'}… is not allowed"),
    ],
)  # fmt: skip
def test_what_is_refused_says_file_key_value_and_what_is_allowed(raw, message):
    with pytest.raises(ThermorenderError) as caught:
        read(Table, raw, WHERE)
    assert message in str(caught.value) and str(caught.value).startswith("s.toml: ")
    assert "\n" not in str(caught.value)


def test_exactly_one_of_several_keys():
    assert WHERE.exactly_one({"a": 1, "c": 2}, ("a", "b")) == "a"
    for given, words in (({}, "but none is given"), ({"a": 1, "b": 2}, "but a and b are given")):
        with pytest.raises(ThermorenderError, match=rf"s.toml: the table needs exactly one of a, b \(why\), {words}"):
            WHERE.exactly_one(given, ("a", "b"), "why")


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"a = 1\nb = \n", "x.toml is not valid TOML: .*line 2"),
        (b"a = 1\nb = 2\nc = '\xff'\n", "x.toml is not valid TOML: line 3 is not UTF-8; save it as UTF-8"),
        (b"a = 1\na = 2\n", "x.toml is not valid TOML: .*line 2"),
        (b"a = " + 5000 * b"9", "x.toml is not valid TOML: "),
        (b"a = " + 100_000 * b"[", "x.toml is not valid TOML: brackets are nested too deeply"),
    ],
)
def test_what_is_no_toml_names_file_and_line(tmp_path, data, words):
    (tmp_path / "x.toml").write_bytes(data)
    with pytest.raises(ThermorenderError, match=words) as caught:
        read_toml(tmp_path / "x.toml")
    assert "\n" not in str(caught.value)
    with pytest.raises(ThermorenderError, match=r"^mine is not valid TOML"):
        read_toml(tmp_path / "x.toml", "mine")


def test_a_byte_order_mark_is_passed_over(tmp_path):
    (tmp_path / "x.toml").write_bytes(b"\xef\xbb\xbfa = 1\n")
    assert read_toml(tmp_path / "x.toml") == {"a": 1}


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(ThermorenderError, match=re.escape(f"{tmp_path} cannot be read: Is a directory")):
        read_toml(tmp_path)
    with pytest.raises(ThermorenderError, match=r"none.toml cannot be read: No such file"):
        read_toml(tmp_path / "none.toml")


def back(tmp_path, values, comment=""):
    path = tmp_path / "back.toml"
    path.write_text(toml_text(values, comment), encoding="utf-8", newline="\n")
    return read_toml(path)


HOSTILE = [
    "", " ", '"', '\\', '\\"', "'", "\'\'\'", '"""', "a\nb", "a\r\nb", "\t", "# no comment", "[table]", "a = 1", "\x00",
    "\x1b[31m", "\x7f", "\x85", "\u2028", "\ufeff", "ß", "火", "\N{SNOWMAN}\N{COMBINING ACUTE ACCENT}", "\U0001f525",
    "\U0010ffff",    "\\u0041", "\\", "=", "a.b", "true", "1e3", "x" * 5000,
]  # fmt: skip


def test_hostile_texts_are_read_back_as_keys_and_as_values(tmp_path):
    spun = random.Random(5)
    any_text = [
        "".join(chr(spun.choice([spun.randrange(160), spun.randrange(0xD800), spun.randrange(0xE000, 0x110000)]))
                for _ in range(20))
        for _ in range(200)
    ]  # fmt: skip
    texts = HOSTILE + any_text
    values = {
        "plain": {str(k): value for k, value in enumerate(texts)},
        "keys": {value: k for k, value in enumerate(texts)},
        "list": texts,
        "rows": [{value: value} for value in texts[:20]],
        **{f"{value} table": {"below": {value: 1}} for value in texts},
    }
    assert back(tmp_path, values) == values
    for value in texts:
        assert back(tmp_path, {"a": 1}, f"from {value}") == {"a": 1}
        (tmp_path / "line.toml").write_text(toml_line(value, value, value), encoding="utf-8", newline="\n")
        assert read_toml(tmp_path / "line.toml") == {value: value}


def test_a_text_that_is_no_unicode_is_refused_as_a_value_and_marked_in_a_comment(tmp_path):
    with pytest.raises(ThermorenderError, match=r"'a\\udcff' is not valid Unicode"):
        toml_text({"a": "a\udcff"})
    assert back(tmp_path, {"a": 1}, "a\udcff") == {"a": 1}


def test_numbers_and_tables_are_read_back_with_their_kinds(tmp_path):
    values = {
        "whole": 3, "large": 2**62, "point": 3.0, "tiny": 5e-324, "huge": 1.7976931348623157e308, "minus": -0.1,
        "third": 1 / 3, "inf": float("inf"), "yes": True, "no": False, "list": [1, 2.5, [3, "x"]], "empty": [],
        "inline": [{"a": 1}, 2], "table": {"a": 1, "deeper": {"b": 2}, "none": {}}, "rows": [{"a": 1}, {"b": {"c": 2}}],
    }  # fmt: skip
    found = back(tmp_path, values)
    assert found == values
    assert [type(found[name]) for name in ("whole", "point", "yes")] == [int, float, bool]
    # NumPy's numbers and paths are written as what they stand for, None not at all.
    other = {"a": np.float32(0.5), "b": np.int64(3), "c": Path("x/y"), "d": (1, 2), "e": None, "f": np.float64(1 / 3)}
    assert back(tmp_path, other) == {"a": 0.5, "b": 3, "c": "x/y", "d": [1, 2], "f": 1 / 3}
    assert str(back(tmp_path, {"a": float("nan")})["a"]) == "nan"
    with pytest.raises(TypeError, match="has no form in TOML"):
        toml_text({"a": object()})


def test_a_table_of_plain_keys_looks_as_written_by_hand():
    values = {"title": "x", "terrain": {"mesh": "a.obj"}, "sky": {"temperature": 250.0}, "object": [{"name": "a"}]}
    assert toml_text(values, "Made by hand.\nTwice.") == (
        '# Made by hand.\n# Twice.\ntitle = "x"\n\n[terrain]\nmesh = "a.obj"\n\n[sky]\ntemperature = 250.0\n\n'
        '[[object]]\nname = "a"\n'
    )
    assert toml_line("netd_mk", 50.0, "fitted") == "netd_mk = 50.0  # fitted"
