"""A comparison over ground in tiles."""

import numpy as np
import pytest
from compare_support import DOWN
from tiled_support import write_in_one_piece, write_tiled

import thermorender as tr
from scenes import narrow
from thermorender.apps.compare.comparison import Options, compare
from thermorender.apps.compare.view import Flight
from thermorender.scene import world as worlds


@pytest.mark.slow
def test_a_map_differs_from_its_render_over_tiles_as_over_the_same_rasters_in_one_piece(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(worlds, "TEXELS", 64)
    folder = write_tiled(tmp_path / "scene")
    found = []
    for place in (folder, write_in_one_piece(folder, tmp_path / "plain")):
        path = tr.Trajectory(np.arange(2.0), np.array([[0.0, 0.0, 40.0], [8.0, 4.0, 40.0]]), np.array([DOWN] * 2))
        flight = Flight.of(narrow(tr.load_scene(place)), path, 1.0)
        out = compare([flight], tmp_path / f"{place.name}_out", ["fok-9to1"], Options(settings={"rays": 32}))
        found.append((out["notes"], out["scenes"][0]["terms"], out["scenes"][0]["differences"][0]))
    (notes, terms, tiled), (*_, plain) = found
    assert (
        (tiled["one"], tiled["other"])
        == (plain["one"], plain["other"])
        == ("fok-9to1 on the photograph", "fok-9to1 as kelvin, true materials")
    )
    assert not terms and any("its ground is in tiles" in note for note in notes)
    assert any("learned materials, are left out of scene: on tiles" in note for note in notes)
    # Frames of both scenes have their origins half a post apart; both differences are of about 1.5 K (RMS).
    assert tiled["mae_k"] > 1.0
    for name in ("me_k", "mae_k", "sd_k"):
        assert abs(tiled[name] - plain[name]) < 0.005
