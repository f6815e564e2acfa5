"""The versions of Mitsuba and Dr.Jit that the package admits, and the differences between them."""

import importlib.metadata
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from packaging.requirements import Requirement

import thermorender as tr
from scenes import scene_object, write_terrain
from thermorender.render.variant import activate

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"


def test_only_tested_versions_are_admitted():
    listed = tomllib.loads(PROJECT.read_text("utf-8"))["project"]["dependencies"]
    admitted = {requirement.name: requirement.specifier for requirement in map(Requirement, listed)}
    # 3.7.0 lacks UInt8; 3.10 renames vertex_positions and changes mi.Mesh(...).
    found = [v for v in ("3.7.0", "3.7.1", "3.8.0", "3.9.1", "3.10.0", "4.0.0") if v in admitted["mitsuba"]]
    assert found == ["3.7.1", "3.8.0", "3.9.1"]
    # Each Mitsuba requires the exact Dr.Jit it was built with, so pinning one pins both.
    (drjit,) = (r for r in map(Requirement, importlib.metadata.requires("mitsuba")) if r.name == "drjit")
    assert [clause.operator for clause in drjit.specifier] == ["=="]
    assert importlib.metadata.version("drjit") in drjit.specifier & admitted["drjit"]
    assert importlib.metadata.version("mitsuba") in admitted["mitsuba"]


def propagating(dr, name):
    """Dr.Jit's function as of 1.5: a NaN operand gives NaN."""
    original = getattr(dr, name)

    def function(*values):
        result = original(*values)
        if not dr.is_float_v(result):
            return result
        bad = sum((dr.select(dr.isnan(value), 1, 0) for value in values), 0)
        return dr.select(bad > 0, np.nan, result)

    return function


def ignoring(dr, name):
    """Dr.Jit's function up to 1.4: a NaN operand is ignored."""
    original = getattr(dr, name)

    def function(first, *others):
        result = original(first, *others)
        if not dr.is_float_v(result):
            return result
        if name == "clip":
            return dr.select(dr.isnan(first), others[1], result)
        return dr.select(dr.isnan(first), others[0], dr.select(dr.isnan(others[0]), first, result))

    return function


@pytest.mark.slow
@pytest.mark.parametrize("air", [False, True])
def test_frames_do_not_depend_on_how_minimum_and_clip_treat_nan(tmp_path, monkeypatch, air):
    """Dr.Jit 1.5 propagates NaN, earlier versions ignore it; both must give the same bytes.

    NaN does occur: a ray without a hit has an infinite distance, and so a position of ∞ − ∞. The picture contains sky,
    edges, mirrors, a moving object, and air; light is traced again for each version.
    """
    import drjit as dr

    activate()
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=1.0)
    folder = tmp_path / "s"
    extra = "".join(
        scene_object(name, position=[east, 2, 1.5], material=material, **more)
        for name, east, material, more in (
            ("ball", 0, "paint_black", {"file": "ball.ply"}),
            ("plate", -3, "gold_polished", {"size": [2, 1, 2]}),
            ("car", 3, "gold_polished", {"size": [1, 1, 1], "track": "t.csv"}),
        )
    )
    if air:
        extra += "[sun]\nelevation_deg = 40\nazimuth_deg = 180\n"
    write_terrain(folder, height=np.random.default_rng(2).uniform(0, 2, (16, 16)), extra=extra)
    mesh.export(folder / "ball.ply")
    (folder / "t.csv").write_text("time_s,east_m\n0,3\n")
    if air:
        path = folder / "scene.toml"
        text = path.read_text().replace("[sky]\ntemperature = 260.0", '[atmosphere]\nstandard = "tropical"')
        path.write_text(text)
    scene = tr.load_scene(folder)
    frames = []
    for number, change in enumerate((None, propagating, ignoring)):
        monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / f"cache{number}"))
        with monkeypatch.context() as patch:
            for name in ("minimum", "maximum", "clip") if change else ():
                patch.setattr(dr, name, change(dr, name))
            if change:
                nan = dr.clip(activate().Float(np.nan), 0.0, 1.0)[0]
                assert np.isnan(nan) == (change is propagating)
            frames.append(tr.Renderer(scene, rays=16).frame(tr.pose(0, -9, 4, pitch_deg=-8)))
    assert np.isfinite(frames[0].radiance).all()
    depth = frames[0].truth["depth"]
    assert 0.1 < np.isfinite(depth).mean() < 0.9
    for frame in frames[1:]:
        assert frame.radiance.tobytes() == frames[0].radiance.tobytes()
        for name, image in frames[0].truth.items():
            assert frame.truth[name].tobytes() == image.tobytes(), name
        assert frame.targets == frames[0].targets and frame.budget_mk == frames[0].budget_mk
