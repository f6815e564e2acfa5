"""Views and poses as texts: what the address of the page brings back, and what it leaves out."""

import shlex
from dataclasses import replace
from urllib.parse import parse_qsl

import numpy as np
import pytest
from studio_support import POSE

import thermorender as tr
from scenes import WEATHER, write_balance, write_terrain
from thermorender.apps.studio.address import query_of, view_at
from thermorender.apps.studio.exports import command, commands
from thermorender.apps.studio.session import Session
from thermorender.apps.studio.view import Pose, View, parsed_hour
from thermorender.cli.options import ViewOptions
from thermorender.errors import ThermorenderError


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    return tr.load_scene(write_terrain(tmp_path_factory.mktemp("address") / "tiny"))


@pytest.fixture(scope="module")
def first(scene):
    return View(Pose.typed(POSE, scene))


@pytest.mark.parametrize(
    ("query", "changes"),
    [
        ({"show": "net"}, {}),
        ({"show": "learned"}, {}),
        ({"show": "none such"}, {}),
        ({"plan": "1", "show": "apparent"}, {"plan": True, "layer": "kinetic"}),
        ({"plan": "1"}, {"plan": True, "layer": "kinetic"}),
        ({"plan": "1", "show": "emissivity"}, {"plan": True, "layer": "emissivity"}),
        ({"t": "nan"}, {}),
        ({"t": "inf"}, {}),
        ({"t": "1_0"}, {}),
        ({"t": "2.5"}, {"time_s": 2.5}),
        ({"range": "5,1"}, {}),
        ({"range": "nan,1"}, {}),
        ({"range": "290,300"}, {"limits": (290.0, 300.0)}),
        ({"range": "290,"}, {"limits": (290.0, None)}),
        ({"range": ",300"}, {"limits": (None, 300.0)}),
        ({"range": ","}, {}),
        ({"range": "290,290.0000001"}, {}),
        ({"palette": "none such"}, {}),
        ({"pose": "0,0"}, {}),
        ({"pose": "0,0,-5,0,-90,0"}, {}),
        ({"against": "hour 99"}, {}),
        ({"against": "hour 1.2.3"}, {}),
        ({"against": "hour -3"}, {}),
        ({"against": "hour 24.0"}, {"against": "hour 24"}),
        ({"against": "version x"}, {}),
        ({"against": "saved", "slider": "1"}, {"against": "saved", "slider": True}),
    ],
)
def test_what_an_address_states_wrongly_or_a_scene_lacks_is_as_in_the_first_view(scene, first, query, changes):
    assert view_at(query, scene, first, learned=False) == replace(first, **changes)


def test_layers_of_a_heat_balance_and_of_a_learned_map_are_shown_where_they_are_known(scene, first, tmp_path):
    balance = tr.load_scene(write_balance(tmp_path / "balance", WEATHER))
    assert view_at({"show": "net"}, balance, first, learned=False).layer == "net"
    assert view_at({"show": "learned"}, scene, first, learned=True).layer == "learned"


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"plan": True, "layer": "kinetic", "against": "saved", "slider": True},
        {"layer": "error", "limits": (1.0, 20.5), "palette": "viridis", "time_s": 1.5},
        {"limits": (None, 20.5)},
        {"against": "version 12"},
        {"against": "hour 4.5"},
    ],
)
def test_an_address_brings_the_whole_view_back_and_one_that_lacks_a_key_takes_it_away(scene, first, changes):
    view = replace(first, **changes)
    query = dict(parse_qsl(query_of(view, scene, "grass_green")))
    assert view_at(query, scene, first, learned=False) == view
    # As the browser's Back does, from this view to the address of the first one.
    before = dict(parse_qsl(query_of(first, scene, "grass_green")))
    assert view_at(before, scene, first, learned=False) == first


def test_a_pose_outside_the_terrain_is_typed_as_it_is_shown_and_rendered_alike_elsewhere(scene, tmp_path):
    pose = Pose.typed(POSE, scene)
    for _ in range(12):
        pose = pose.orbited(17.0, 3.0, 1.6, scene)
    assert not np.isfinite(scene.ground(pose.east, pose.north))
    again = Pose.typed(pose.text(scene), scene)
    np.testing.assert_allclose(again.matrix(), pose.matrix(), atol=0.11)
    # The lines of code and the command have the same pose.
    session, view = Session(tr.Renderer(scene, "fast"), "fast"), View(again)
    numbers = commands(session, view)[0].split("tr.pose(")[1].split(")")[0].split(",")
    np.testing.assert_allclose(tr.pose(*map(float, numbers)), again.matrix(), atol=0.11)
    line = shlex.split(command(session, view))
    text = next(each for each in line if each.startswith("--pose=")).removeprefix("--pose=")
    np.testing.assert_allclose(ViewOptions(text, "--local-up" in line).over(scene), again.matrix(), atol=0.11)


def test_a_pose_far_outside_the_terrain_or_under_it_is_refused(scene):
    for text, sentence in (
        ("0,90000,10,0,-45,0", "is 89.99 km outside the terrain; give an E,N within 20 km of it"),
        ("0,0,-3,0,-45,0", "is 3 m under the terrain"),
        ("0,90,-3,0,-45,0", "is 3 m under the terrain"),
    ):
        with pytest.raises(ThermorenderError, match=sentence):
            Pose.typed(text, scene)


@pytest.mark.parametrize("text", ["", "noon", "99", "-3", "nan", "1_0", "24.01"])
def test_an_hour_is_a_number_from_0_to_24(text):
    assert parsed_hour("24") == 24.0 and parsed_hour(" 4.5") == 4.5
    with pytest.raises(ThermorenderError, match="is not a solar hour; give a number from 0 to 24"):
        parsed_hour(text)
