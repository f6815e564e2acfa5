"""The studio's first view."""

from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("nicegui")

from thermorender.apps.studio.page import first_pose


def patch(half, cells):
    """A square of `cells`² pairs of triangles around the origin."""
    line = np.linspace(-half, half, cells + 1)
    east, north = np.meshgrid(line, line)
    index = np.arange((cells + 1) ** 2).reshape(cells + 1, cells + 1)
    a, b, c, d = (part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]))
    vertices = np.stack([east.ravel(), north.ravel(), 0.0 * east.ravel()], axis=-1)
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    return SimpleNamespace(vertices=vertices, faces=faces, texel_m=0.5 * half / cells)


def joined(one, other):
    """Two patches as one surface, with the texels of the first."""
    vertices = np.concatenate([one.vertices, other.vertices])
    faces = np.concatenate([one.faces, other.faces + len(one.vertices)])
    return SimpleNamespace(vertices=vertices, faces=faces, texel_m=one.texel_m)


@pytest.mark.parametrize("more", [[], [patch(4000.0, 20)], [joined(patch(50.0, 90), patch(4000.0, 8))]])
def test_the_first_view_is_of_the_land_that_has_most_faces(more):
    """A ring of a few large faces out to 4 km does not move the camera away from a square of 100 m."""
    surfaces = [*more, patch(50.0, 100), patch(9000.0, 200)]
    session = SimpleNamespace(base=SimpleNamespace(near_ground=surfaces[: len(more) + 1]))
    east, north, up, *angles = first_pose(session).split(",")
    assert (east, angles) == ("0", ["0", "-45", "0"])
    assert float(up) == -float(north) == pytest.approx(40.0, abs=5.0)
