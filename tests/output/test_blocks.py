"""Blocks of a flight: rendered in any order, taken over in order, to the bytes of one machine."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from support import contents, slow

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender.errors import ThermorenderError, ThermorenderWarning
from thermorender.output.blocks import FOLDER, join, usual_length
from thermorender.output.flight import Flight, FlightOptions, fly
from thermorender.output.flight_part import fly_part
from thermorender.sensor.display import DisplaySettings

PRODUCTS = ("exr", "counts", "display")


def renderer_of(folder, **camera):
    from dataclasses import replace

    scene = coarse(tr.load_scene(write_terrain(folder)), 8)
    scene = scene.with_camera(replace(scene.camera, **camera))
    return tr.Renderer(scene, rays=4, samples=1, seed=3)


def path_of(speed_m_s, seconds=1.0):
    time_s = np.linspace(0.0, seconds, 11)
    # The speed varies, so that the pixels' memory is computed in every way.
    east = -2.0 + speed_m_s * seconds * (time_s / seconds) ** 2
    position = np.stack([east, np.zeros(11), np.full(11, 12.0)], axis=1)
    return tr.Trajectory(time_s=time_s, position=position, quaternion=np.array([[0.0, 1.0, 0.0, 0.0]] * 11))


@pytest.fixture(scope="module")
def renderer(tmp_path_factory):
    return renderer_of(tmp_path_factory.mktemp("scene") / "tiny")


@pytest.mark.parametrize(("speed", "camera"), [
    *slow((0.1, {}), (6.0, {}), (40.0, {})), (3.0, {"ffc_interval_s": 0.4, "ffc_duration_s": 0.1}),
])  # fmt: skip
def test_parts_in_any_order_give_the_bytes_of_one_machine(renderer, tmp_path, speed, camera):
    renderer = renderer_of(tmp_path / "scene", **camera) if camera else renderer
    path, options = path_of(speed), FlightOptions(rate_hz=30.0, products=PRODUCTS)
    fly(renderer, path, tmp_path / "whole", options)
    for first, stop in ((13, 99), (0, 13)):
        fly_part(renderer, path, tmp_path / "parts", options, first, stop)
    assert not (tmp_path / "parts/frames.jsonl").exists()
    # Nothing is rendered to put them together.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Flight, "write_frames", None)
        assert fly(renderer, path, tmp_path / "parts", options, resume=True)["rendered"] == 0
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    assert fly(renderer, path, tmp_path / "parts", options, verify=True)["rendered"] == 0


def test_a_block_from_another_state_is_rendered_again(renderer, tmp_path, monkeypatch):
    path, options = path_of(40.0), FlightOptions(rate_hz=30.0, products=("counts",))
    fly(renderer, path, tmp_path / "whole", options)
    fly_part(renderer, path, tmp_path / "parts", options, 0, 10)
    fly_part(renderer, path, tmp_path / "parts", options, 20, 31)
    # Two frames are not enough for the last bit.
    with monkeypatch.context() as patch:
        patch.setattr("thermorender.render.flight.frames.forgotten_s", lambda camera: 0.06)
        fly_part(renderer, path, tmp_path / "parts", options, 10, 20)
    rendered = []
    write = Flight.write_frames

    def counted(self, folder, frames, *more):
        rendered.append(frames)
        write(self, folder, frames, *more)

    monkeypatch.setattr(Flight, "write_frames", counted)
    fly(renderer, path, tmp_path / "parts", options, resume=True)
    assert rendered == [range(10, 20)]
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


def test_half_a_count_is_kept_after_ten_time_constants(renderer):
    from thermorender.sensor.detector import forgotten_s, response_weights

    camera = renderer.scene.camera
    time_constant_s = camera.time_constant_ms * 1e-3
    assert 2**camera.bits * response_weights(10.4 * time_constant_s, time_constant_s)[0] < 0.5
    assert forgotten_s(camera) > 24 * np.log(2) * time_constant_s


def test_gaps_and_damaged_blocks_are_rendered(renderer, tmp_path):
    path, options = path_of(6.0), FlightOptions(rate_hz=30.0, products=("counts",))
    fly(renderer, path, tmp_path / "whole", options)
    for first, stop in ((5, 10), (15, 20), (20, 25)):
        fly_part(renderer, path, tmp_path / "parts", options, first, stop)
    record = tmp_path / "parts" / FOLDER / "000000015-000000020.json"
    record.write_text(record.read_text().replace("shows", "shown"))
    (tmp_path / "parts/frame_000022_counts.png").write_bytes(b"cut")
    fly(renderer, path, tmp_path / "parts", options, resume=True)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")
    assert not (tmp_path / "parts" / FOLDER).exists()


@pytest.mark.slow
def test_blocks_with_a_flipped_bit_are_not_copied(renderer, tmp_path):
    """Counts make display images that depend on the frames before; the EXR makes the MCAP."""
    path = path_of(40.0)
    display = DisplaySettings(memory_s=0.5)
    for products, copied in ((("display", "video"), "_counts.png"), (("exr", "mcap"), ".exr")):
        options, name = FlightOptions(rate_hz=10.0, products=products, display=display), products[1]
        fly(renderer, path, tmp_path / f"{name}-whole", options)
        for first, stop in ((0, 5), (5, 11)):
            fly_part(renderer, path, tmp_path / name, options, first, stop)
        damaged = tmp_path / name / f"frame_000007{copied}"
        data = bytearray(damaged.read_bytes())
        data[len(data) // 2] ^= 1
        damaged.write_bytes(data)
        with pytest.warns(ThermorenderWarning, match=f"frame_000007{copied} is missing or not as it was written"):
            fly(renderer, path, tmp_path / name, options, resume=True)
        assert contents(tmp_path / name) == contents(tmp_path / f"{name}-whole")


def test_parts_of_another_flight_are_refused(renderer, tmp_path):
    path, options = path_of(6.0), FlightOptions(rate_hz=4.0, products=("counts",))
    fly_part(renderer, path, tmp_path / "f", options, 0, 2)
    with pytest.raises(ThermorenderError, match=r"was flown with rate_hz=4.0, now rate_hz=8.0"):
        fly_part(renderer, path, tmp_path / "f", FlightOptions(rate_hz=8.0, products=("counts",)), 2, 4)
    with pytest.raises(ThermorenderError, match="frames=7:9 holds no frame of this flight; give numbers between 0"):
        fly_part(renderer, path, tmp_path / "f", options, 7, 9)
    # Another process wrote the file between two looks at the folder.
    flight = Flight(renderer, path, options, None)
    seen = iter([False, True])
    with pytest.MonkeyPatch.context() as patch:
        own = Path.exists
        patch.setattr(Path, "exists", lambda path: own(path) and (path.name != "flight.json" or next(seen, True)))
        join(tmp_path / "f", flight)
    (tmp_path / "other").mkdir()
    (tmp_path / "other/frame_000000.exr").touch()
    with pytest.raises(ThermorenderError, match=r"already holds frame_000000.exr"):
        fly_part(renderer, path, tmp_path / "other", options, 0, 2)


@pytest.mark.parametrize("products", [("counts", "display"), *slow((("display",),))])
def test_display_that_remembers_is_made_in_order(renderer, tmp_path, products):
    display = DisplaySettings(mode="plateau", palette="ironbow", memory_s=0.5)
    path, options = path_of(6.0, 0.4), FlightOptions(rate_hz=30.0, products=products, display=display)
    fly(renderer, path, tmp_path / "whole", options)
    for first, stop in ((9, 99), (0, 4)):
        fly_part(renderer, path, tmp_path / "parts", options, first, stop)
    fly(renderer, path, tmp_path / "parts", options, resume=True)
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


def test_blocks_are_much_longer_than_their_warm_up(renderer):
    for rate_hz in (9.0, 30.0, 200.0):
        flight = Flight(renderer, path_of(1.0, 20.0), FlightOptions(rate_hz=rate_hz, products=("counts",)), None)
        warm_up = 100 - flight.flown.warm_up(100)
        assert warm_up >= 0.33 * rate_hz * 0.9 and usual_length(flight) >= 10 * warm_up
        assert usual_length(flight) % flight.audit == 0
    assert json.dumps(flight.settings)
    assert flight.flown.warm_up(1) == 0


@pytest.mark.slow
def test_the_array_of_slurm_gives_the_bytes_of_one_machine(tmp_path, monkeypatch):
    page = (Path(__file__).parents[2] / "docs/guides/cluster.md").read_text(encoding="utf-8")
    script, after = re.findall(r"^```sh\n(#!/bin/sh\n#SBATCH.*?|job=.*?)^```$", page, flags=re.S | re.M)
    (resume,) = re.findall(r'--wrap "(.*)"', after)
    shared = tmp_path / "shared"
    write_terrain(shared / "scene")
    rows = [f"{time_s},{time_s},0,12,0,-90,0" for time_s in (0.0, 0.5)]
    log = "\n".join(["time_s,east_m,north_m,up_m,yaw_deg,pitch_deg,roll_deg", *rows])
    (shared / "scene/flight.csv").write_text(log)
    (tmp_path / "array.sh").write_text(script.replace("/shared", str(shared)).replace("10000", "2"))
    subprocess.run(["bash", "-n", tmp_path / "array.sh"], check=True)
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}:{os.environ['PATH']}")
    # In another order; a part beyond the flight is refused.
    for task, status in ((1, 0), (0, 0), (2, 0), (3, 2)):
        monkeypatch.setenv("SLURM_ARRAY_TASK_ID", str(task))
        run = subprocess.run(["sh", tmp_path / "array.sh"], capture_output=True, text=True)
        assert run.returncode == status, run.stderr
    joined = subprocess.run(resume.replace("/shared", str(shared)).split(), capture_output=True, text=True)
    assert joined.returncode == 0, joined.stderr
    whole = ["thermorender", "fly", shared / "scene", "-o", tmp_path / "whole"]
    subprocess.run(whole, check=True, capture_output=True)
    assert contents(shared / "flight") == contents(tmp_path / "whole")
