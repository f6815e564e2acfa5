"""Readers of well-formed files with arbitrary content: documents with exchanged values, keys and lists, and tables
with arbitrary cells. Hypothesis shrinks an input that breaks a reader.

Damage byte by byte is in test_fuzz.py.
"""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.robustness.fuzz import run as fuzz
from tests.robustness.fuzz.corpus import READERS
from thermorender.schema import read_toml, toml_text

DOCUMENTS = [name for name, each in READERS.items() if each.file.endswith((".toml", ".json", ".geojson", ".gltf"))
             and not name.startswith(("flight", "translation"))]  # fmt: skip
TABLES = [name for name, each in READERS.items() if each.file.endswith(".csv")]

NUMBERS = st.one_of(
    st.floats(), st.integers(), st.sampled_from([0, -1, 1e308, -1e308, 1e-320, 2**63, -(2**70), 10**400, 1e6, 255, 256])
)
WORDS = st.one_of(st.text(max_size=8), st.sampled_from(["", "nan", "../x", "a\nb", "\u202e", "x" * 5000, "1", "🜁"]))
VALUES = st.recursive(
    st.one_of(NUMBERS, WORDS, st.booleans(), st.none()),
    lambda inner: st.one_of(st.lists(inner, max_size=4), st.dictionaries(WORDS, inner, max_size=3)),
    max_leaves=6,
)


def places(value, path=()):
    """The paths of all values in a document."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in items:
        yield (*path, key)
        yield from places(each, (*path, key))


@st.composite
def changed(draw, whole):
    """The document with up to three of its values exchanged, removed, doubled or joined by another."""
    document = json.loads(json.dumps(whole))
    for _ in range(draw(st.integers(1, 3))):
        paths = list(places(document))
        if not paths:
            break
        *above, key = draw(st.sampled_from(paths))
        parent = document
        for step in above:
            parent = parent[step]
        match draw(st.sampled_from(["value", "value", "kin", "without", "another"])):
            case "value":
                parent[key] = draw(VALUES)
            case "kin":
                # A value that is valid in another place.
                other = document
                for step in draw(st.sampled_from(paths)):
                    other = other[step]
                parent[key] = json.loads(json.dumps(other))
            case "without":
                del parent[key]
            case "another" if isinstance(parent, dict):
                parent[draw(WORDS)] = draw(VALUES)
            case "another":
                parent.insert(key, draw(VALUES))
    return document


@st.composite
def rearranged(draw, whole):
    """The table with cells, columns and rows exchanged."""
    rows = [line.split(",") for line in whole.splitlines()]
    cells = st.one_of(NUMBERS.map(str), WORDS, st.sampled_from([cell for row in rows for cell in row]))
    for _ in range(draw(st.integers(1, 4))):
        row = draw(st.integers(0, len(rows) - 1))
        column = draw(st.integers(0, max(len(rows[row]) - 1, 0)))
        match draw(st.sampled_from(["cell", "cell", "column", "row", "short"])):
            case "cell" if rows[row]:
                rows[row][column] = draw(cells)
            case "column":
                value = draw(cells)
                for each in rows[1:]:
                    each[column : column + 1] = [value]
            case "row":
                rows.insert(row, [draw(cells) for _ in rows[0]])
            case _:
                del rows[row][column:]
    mark = draw(st.sampled_from([",", ",", ",", ";", "\t"]))
    return "\n".join(mark.join(row) for row in rows)


@pytest.mark.parametrize("name", DOCUMENTS)
def test_documents_with_arbitrary_content_are_refused_or_read(name, tmp_path):
    reader = READERS[name]
    reader.make(tmp_path)
    path = tmp_path / reader.file
    toml = path.suffix == ".toml"
    whole = read_toml(path) if toml else json.loads(path.read_text(encoding="utf-8"))

    @given(changed(whole))
    def check(document):
        try:
            path.write_text(toml_text(document) if toml else json.dumps(document), encoding="utf-8")
        except (OverflowError, TypeError, ValueError):
            # Words that are not Unicode, numbers without a text form, and values that TOML cannot express.
            return
        fuzz.check(name, path)

    check()


@pytest.mark.parametrize("name", TABLES)
def test_tables_with_arbitrary_content_are_refused_or_read(name, tmp_path):
    reader = READERS[name]
    reader.make(tmp_path)
    path = tmp_path / reader.file

    @given(rearranged(path.read_text(encoding="utf-8")))
    def check(text):
        path.write_bytes(text.encode(errors="surrogatepass"))
        fuzz.check(name, path)

    check()
