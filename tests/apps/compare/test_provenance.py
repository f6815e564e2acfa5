"""What a map was trained on."""

from types import SimpleNamespace

import numpy as np
import pytest
from compare_support import flight, kinds, uniform_map

import thermorender as tr
from scenes import write_terrain
from thermorender.apps.compare import (
    provenance,
)
from thermorender.apps.compare.comparison import Options, compare
from thermorender.learned.temperature_map import load_model
from thermorender.output.photograph import photograph


class _Pairs:
    """A substitute for a Dataset: a name and training pictures."""

    def __init__(self, name, pictures):

        self.card = {"name": name}
        self.entries = [SimpleNamespace(key=f"p{k}", part="train", picture=each) for k, each in enumerate(pictures)]

    def pair(self, entry, truth=True):

        return SimpleNamespace(visible=entry.picture)


@pytest.mark.slow
def test_a_map_that_has_seen_the_scene_is_found(tmp_path):
    rng = np.random.default_rng(8)
    colour = np.kron(rng.integers(30, 220, (32, 32, 3)), np.ones((4, 4, 1), int)).astype(np.uint8)
    folder = write_terrain(tmp_path / "seen", height=np.zeros((64, 64)), colour=colour, texel=0.5)
    flown = flight(folder, height=25.0, factor=1)
    renderer = tr.Renderer(flown.scene, rays=2)
    taken = [photograph(renderer, pose)[0] for pose in flown.poses]
    foreign = rng.integers(0, 255, (3, 512, 640, 3)).astype(np.uint8)
    leaky = uniform_map(tmp_path / "leaky.npz", 0.5, dataset={"name": "theirs"})
    fair = uniform_map(tmp_path / "fair.npz", 0.4, dataset={"name": "others"})
    unknown = uniform_map(tmp_path / "unknown.npz", 0.3)
    # The same name, but more training pictures: another data set.
    larger = uniform_map(tmp_path / "larger.npz", 0.2, dataset={"name": "others"}, pairs={"train": 36, "validation": 4})
    data = [_Pairs("theirs", [*foreign, taken[1]]), _Pairs("others", list(foreign))]
    options = Options(datasets=data, settings={"rays": 2})
    found = compare([flown], tmp_path / "c", [leaky, fair, unknown, larger], options)
    (text,) = {each["says"] for each in found["findings"] if each["kind"] == "leak"}
    assert text.startswith("training has seen seen: 3 of 3 photographs") and "'p3'" in text
    assert "leak" in kinds(found, "leaky on the photograph") and "leak" not in kinds(found, "fair on the photograph")
    assert (
        "what this map was trained on is unknown"
        in found["methods"]["unknown on the photograph"]["training"]["audited"]
    )
    assert found["methods"]["larger on the photograph"]["training"]["audited"].count(
        "not audited: it was trained on 40 pairs"
    )
    assert "3 photographs" in found["methods"]["fair on the photograph"]["training"]["audited"]


def test_provenance_is_read_from_the_file_of_a_map():
    model = load_model("procedural-palette")
    own = provenance.provenance_of(model)
    assert own.header["data set"] == "campaign" and own.header["pairs"]["train"] == 1620
    assert "not audited" in own.audited
