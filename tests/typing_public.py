"""The public API as a user's type checker sees it: checked by `make lint` under mypy's strict rules, and never run.

Each line with a `type: ignore` is an error that mypy must find; where it finds none, the ignore itself is the error.
"""

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from typing_extensions import assert_type

import thermorender as tr


def frames() -> None:
    """Scene, renderer, frame."""
    scene = tr.load_scene("heath")
    assert_type(tr.load_scene(Path("scenes") / "heath"), tr.Scene)
    assert_type(scene.ground(0.0, -120), float)
    assert_type(scene.ground(np.zeros(3), np.zeros(3)), NDArray[np.float64])
    assert_type(scene.digest(), str)
    assert_type(scene.with_air("midlatitude-summer", aerosol="rural-23km"), tr.Scene)
    assert_type(scene.at("2018-07-28T14:30Z"), tr.Scene)
    assert_type(scene.at(np.datetime64("2018-07-28T14:30")).temperature_state.solved, bool)
    renderer = tr.Renderer(scene, quality="high", rays=16, progress=lambda what, share: print(what, f"{share:.0%}"))
    pose = tr.pose(0, -120, 120 + scene.ground(0, -120), pitch_deg=-45)
    assert_type(pose, NDArray[np.float64])
    assert_type(tr.pose(0, 0, 120, look_at=(0, 0, 0)), NDArray[np.float64])
    assert_type(scene.pose(0, 0, above_ground_m=120, pitch_deg=-90), NDArray[np.float64])
    number, place = np.float32(300.0), np.zeros(3)
    tr.pose(number, np.int64(0), 120, yaw_deg=number, look_at=place)
    scene.pose(number, np.int64(0), number, roll_deg=number, look_at=place)
    scene.with_temperature(number).with_sky(number, number).with_sun(number, number)
    scene.with_material(roof=number).with_material_in(place, number)
    assert_type(scene.with_material_at(scene.texels_in("roof.geojson"), "asphalt"), tr.Scene)
    scene.with_objects({"marker": number, "van": {"temperature_k": number}})
    renderer.frame(pose, objects={"marker": {"temperature_k": number}})
    frame = renderer.frame(pose, time_s=0.0, objects={"marker": {"temperature_k": 350.0}})
    assert_type(frame, tr.Frame)
    assert_type(frame.radiance, NDArray[np.float32])
    assert_type(frame.apparent_temperature, NDArray[np.float32])
    assert_type(frame.counts, NDArray[np.uint16])
    assert_type(frame.display, NDArray[np.uint8])
    assert_type(frame.truth["depth"], NDArray[Any])
    assert_type(frame.targets["marker"], dict[str, Any])
    assert_type(frame.budget_mk, dict[str, float] | None)
    assert_type(frame.camera.width, int)
    frame.save("frame.exr")
    assert_type(frame.orthorectified(0.25).kelvin, NDArray[np.float32])
    assert_type(frame.to_xarray(), xr.Dataset)
    assert_type(frame.orthorectified(0.25).to_xarray(), xr.DataArray)
    assert_type(renderer.radiance(pose, 1.0), NDArray[np.float32])
    assert_type(renderer.visible(pose, time_s=1.0), tuple[NDArray[np.uint8], NDArray[np.bool_]])

    scene.at(14.5)  # type: ignore[arg-type]
    tr.load_scene(7)  # type: ignore[arg-type]
    tr.Renderer("heath")  # type: ignore[arg-type]
    tr.Renderer(scene, quality="best")  # type: ignore[arg-type]
    tr.Renderer(scene, device="gpu")  # type: ignore[arg-type]
    tr.Renderer(scene, like=scene)  # type: ignore[arg-type]
    frame.orthorectified("0.25")  # type: ignore[arg-type]
    tr.pose("0", 0, 120)  # type: ignore[arg-type]
    renderer.frame(time_s=1.0)  # type: ignore[call-arg]
    renderer.frame(pose, objects={"marker": 350.0})  # type: ignore[dict-item]
    print(renderer.bake_mk)  # type: ignore[attr-defined]
    assert_type(scene.with_camera("tau2-640").with_sky(250.0).with_temperature("balance"), tr.Scene)
    scene.with_temperature(np.zeros((2, 2)))  # type: ignore[arg-type]
    scene.camera = scene.camera  # type: ignore[misc]
    frame.radiance = frame.radiance  # type: ignore[misc]
    print(frame.budget_mk["total"])  # type: ignore[index]
    print(tr.Rendererer)  # type: ignore[attr-defined]


def baked_scenes() -> None:
    """Objects that are sent to another process or solved again."""
    renderer = tr.Renderer(tr.load_scene("heath"))
    baked = renderer.baked
    assert_type(baked, tr.BakedScene)
    assert_type(baked.errors_mk, dict[str, float])
    assert_type(baked.cache_note, str | None)
    assert_type(baked.texels, tuple[NDArray[np.float32], ...])
    again: tr.BakedScene = pickle.loads(pickle.dumps(baked))
    assert_type(tr.Renderer.of(again, seed=3), tr.Renderer)
    assert_type(baked.solved_for(tr.load_scene("heath").with_air("tropical")), tr.BakedScene)
    assert_type(baked.preview_for(tr.load_scene("heath").with_material(water=0.9)), tr.BakedScene)
    tr.Renderer(renderer.scene, like=renderer)
    assert_type(renderer.heat_terms(), dict[str, NDArray[np.float32]] | None)

    tr.Renderer.of(renderer.scene)  # type: ignore[arg-type]
    baked.solved_for("heath")  # type: ignore[arg-type]
    baked.plan = renderer.plan  # type: ignore[misc]


def flights() -> None:
    """Logs, trajectories, flights."""
    scene = tr.load_scene("heath")
    trajectory = tr.load_trajectory(["position.csv", Path("gimbal.csv")], scene, duplicates="spread")
    assert_type(trajectory, tr.Trajectory)
    assert_type(trajectory.span_s, tuple[float, float])
    assert_type(trajectory.sampled([0.0, 0.5]), tr.Trajectory)
    assert_type(trajectory.pose(0.5), NDArray[np.float64])
    assert_type(trajectory.poses(), NDArray[np.float64])
    assert_type(trajectory.frame_times(30, stop_s=1.0), NDArray[np.float64])
    assert_type(trajectory.anchored(0.0, np.float32(0.0), np.int32(90)), tr.Trajectory)
    tr.load_trajectory("flight.csv", scene, mount=np.zeros(3), lever_arm_m=np.zeros(3))
    assert_type(trajectory.above_ground(scene.ground), NDArray[np.float64])
    for frame in tr.Renderer(scene).frames(trajectory, rate_hz=4):
        assert_type(frame, tr.Frame)
    try:
        options = tr.FlightOptions(products=("exr", "counts"))
        summary = tr.fly(tr.Renderer(scene), trajectory, "out", options, resume=True)
    except tr.ThermorenderError as error:
        print(error)
    else:
        print(summary["frames"])

    assert_type(tr.compare([(scene, trajectory)], "out", ["fok-1to1"]), dict[str, Any])
    tr.load_trajectory("flight.csv", scene, anchor=(0, 0, 100, 0))  # type: ignore[arg-type]
    tr.load_trajectory("flight.csv", scene, duplicates="last")  # type: ignore[arg-type]
    trajectory.frame_times("30")  # type: ignore[arg-type]
    tr.fly(scene, trajectory, "out")  # type: ignore[arg-type]
    tr.fly(tr.Renderer(scene), "flight.csv", "out")  # type: ignore[arg-type]
    tr.FlightOptions(products=1)  # type: ignore[arg-type]
    tr.fly(tr.Renderer(scene), trajectory, "out", products=("exr",))  # type: ignore[call-arg]
