"""Clients in other languages get the frames that the Python client gets."""

import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
from link_support import TOKEN, connected, serving

import thermorender as tr
from scenes import coarse, write_terrain
from thermorender.apps.link.stage import Stage

EXAMPLES = Path(__file__).resolve().parents[3] / "examples" / "link"
COUNT = 5


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    scene = coarse(tr.load_scene(write_terrain(tmp_path_factory.mktemp("scene") / "tiny")), 16)
    with serving(Stage(tr.Renderer(scene, rays=4, samples=1))) as made:
        yield made


@pytest.fixture(scope="module")
def wanted(server):
    """The counts of the examples' flight, (COUNT, H, W)."""
    with connected(server) as client:
        session = client.open(seed=11, rate_hz=30.0)
        return np.array([session.frame(k / 30.0, (0, 0.5 * k / 30.0, 12, 0, 1, 0, 0)).counts for k in range(COUNT)])


@pytest.fixture
def token(tmp_path):
    (tmp_path / "token").write_text(TOKEN + "\n")
    return tmp_path / "token"


def test_client_in_c(server, wanted, token, tmp_path):
    source = EXAMPLES / "client.c"
    assert len(source.read_text(encoding="utf-8").splitlines()) < 150
    program = tmp_path / "client"
    strict = ["-std=c99", "-Wall", "-Wextra", "-Werror", "-O1"]
    compiler = shutil.which("cc") or pytest.skip("there is no C compiler")
    subprocess.run([compiler, *strict, "-o", program, source], check=True)
    given = [program, "127.0.0.1", str(server.port), token, str(COUNT), tmp_path / "last.pgm"]
    run = subprocess.run(given, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stderr
    lines = np.array([line.split() for line in run.stdout.splitlines()], float)
    np.testing.assert_allclose(lines, [(k, counts.mean()) for k, counts in enumerate(wanted)], atol=6e-4)
    image = cv2.imread(str(tmp_path / "last.pgm"), cv2.IMREAD_UNCHANGED)
    np.testing.assert_array_equal(image, wanted[-1])
    token.write_text("0" * 64)
    run = subprocess.run(given, capture_output=True, text=True, timeout=60)
    assert run.returncode == 2 and run.stderr.startswith("error: the token is wrong")


@pytest.mark.slow
def test_client_in_octave(server, wanted, token, tmp_path):
    octave = shutil.which("octave-cli") or pytest.skip("Octave is not installed")
    code = (
        f"pkg load instrument-control; cd('{EXAMPLES}'); "
        f"frames = client('127.0.0.1', {server.port}, '{token}', {COUNT}); "
        f"file = fopen('{tmp_path / 'frames'}', 'w'); fwrite(file, frames, 'uint16'); fclose(file); exit(0)"
    )
    run = subprocess.run([octave, "--no-gui", "--eval", code], capture_output=True, text=True, timeout=120)
    if "package instrument-control" in run.stderr and "not found" in run.stderr:
        pytest.skip("Octave lacks its package instrument-control")
    frames = np.fromfile(tmp_path / "frames", "<u2") if (tmp_path / "frames").exists() else run.stderr
    # Octave stores columns first.
    np.testing.assert_array_equal(frames.reshape(COUNT, wanted.shape[2], wanted.shape[1]).swapaxes(1, 2), wanted)
