"""The table of file kinds on the page of file formats names tests that exist, and every format that a reader takes."""

import re
from pathlib import Path

from thermorender.apps.lands.solids.clouds import SUFFIXES as CLOUDS
from thermorender.apps.training.translate import VIDEOS
from thermorender.scene.meshes.mesh import FORMATS
from thermorender.sensor.thermal_files import SUFFIXES

ROOT = Path(__file__).resolve().parents[1]
PAGE = (ROOT / "docs" / "reference" / "file-formats.md").read_text(encoding="utf-8")
TABLE = PAGE.split("## Kinds of files", 1)[1].split("\n## ", 1)[0]
ROWS = {cells[0]: cells for cells in re.findall(r"^\| (.+?) \| (.+?) \| (.+?) \| (.+?) \|$", TABLE, flags=re.M)[1:]}


def test_each_kind_names_the_tests_that_hold_it():
    kinds = "mesh, raster, point cloud, weather, log, air, spectrum, thermal picture, poses of frames"
    assert list(ROWS) == [*kinds.split(", "), "lenses of frames", "video"]
    for kind, *_, held in ROWS.values():
        files = re.findall(r"`(tests/[^`]+)`", held)
        assert files, kind
        assert [file for file in files if not (ROOT / file).is_file()] == []


def test_each_suffix_that_a_reader_takes_is_in_its_row():
    for kind, suffixes in (
        ("mesh", FORMATS),
        ("video", VIDEOS),
        ("thermal picture", SUFFIXES),
        ("point cloud", CLOUDS),
    ):
        same = {"jpg": "jpeg", "tif": "tiff"}
        for suffix in {same.get(one[1:], one[1:]) for one in suffixes}:
            assert re.search(rf"\b{suffix}\b", ROWS[kind][1], flags=re.I) or suffix in ROWS[kind][1].lower(), suffix
