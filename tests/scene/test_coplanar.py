"""Notes on surfaces that lie in one plane."""

import numpy as np
import pytest

import thermorender as tr
from scenes import scene_object, write_terrain


def notes(folder, *objects, **terrain):
    tables = "".join(
        scene_object(name, size, place, kelvin, "asphalt", yaw_deg=yaw) for name, size, place, yaw, kelvin in objects
    )
    return tr.load_scene(write_terrain(folder, extra=tables, **terrain)).surface_notes


@pytest.mark.parametrize("yaw", [0.0, 20.0])
def test_overlapping_tops_at_one_height_are_named(tmp_path, yaw):
    found = notes(tmp_path / "s", ("a", [2, 2, 1], [0, 0, 0], 0.0, 310.0), ("b", [2, 2, 1], [1, 0.5, 0], yaw, 320.0))
    assert len(found) == 1 and "'a:box' and 'b:box'" in found[0] and "move one by 1 cm" in found[0]


def test_top_level_with_the_ground_is_named(tmp_path):
    found = notes(tmp_path / "s", ("slab", [2, 2, 1], [0.3, 0, -1.0], 0.0, 310.0))
    assert len(found) == 1 and "'terrain' and 'slab:box'" in found[0]
    assert not notes(tmp_path / "t", ("slab", [2, 2, 1], [0.3, 0, -0.99], 0.0, 310.0))


@pytest.mark.parametrize(
    ("place", "kelvin"), [([0, 0, 1], 320.0), ([2, 0, 0], 320.0), ([1, 0.5, 0], 310.0), ([9, 9, 0], 320.0)]
)
def test_bodies_that_stand_on_or_beside_each_other_or_look_alike_are_not(tmp_path, place, kelvin):
    assert not notes(
        tmp_path / "s", ("a", [2, 2, 1], [0, 0, 0], 0.0, 310.0), ("b", [2, 2, 1], place, 0.0, kelvin),
        height=np.zeros((32, 32)),
    )  # fmt: skip


def test_undersides_on_the_ground_are_not(tmp_path):
    two = ("a", [2, 2, 1], [0, 0, 0], 0.0, 310.0), ("b", [2, 2, 2], [1, 0.5, 0], 0.0, 320.0)
    assert not notes(tmp_path / "s", *two)


def test_an_object_that_only_faces_down_is_no_error(tmp_path):
    sheet = "v -1 -1 2\nv 1 -1 2\nv 1 1 2\nv -1 1 2\nf 1 4 3 2\n"
    folder = write_terrain(
        tmp_path / "s", extra=scene_object("sheet", file="sheet.obj", temperature=300.0, material="asphalt"),
    )  # fmt: skip
    (folder / "sheet.obj").write_text(sheet)
    assert tr.load_scene(folder).surface_notes == ()
