"""What stands in a picture and below it: pixels without a value, points of the scene, and differences."""

import csv
import io
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from studio_support import wait_for

import thermorender as tr
from scenes import WEATHER, write_balance
from thermorender.apps.studio.cards import Point, below, hovered
from thermorender.apps.studio.exports import exported
from thermorender.apps.studio.layers import Plan, Shot, layers_of
from thermorender.apps.studio.pictures import MaterialColours, Picture, figure_of, picture_of, table
from thermorender.apps.studio.session import Session
from thermorender.apps.studio.view import Pose, View

# The ground and the sky.
LOW = "0,-7,3,0,-5,0"


@pytest.fixture(scope="module")
def renderers(tmp_path_factory):
    """Renderers of a scene with a heat balance, and of the same with asphalt for grass."""
    scene = tr.load_scene(write_balance(tmp_path_factory.mktemp("cards") / "balance", WEATHER))
    return [tr.Renderer(each, "fast", edits=True) for each in (scene, scene.with_material(grass_green="asphalt"))]


def shot(renderer, pose, layer, plan=False, other=None):
    view = View(Pose.typed(pose, renderer.scene), plan=plan, layer=layer, against="saved" if other else "")
    beside = None if other is None else shot(other, pose, layer, plan)
    if plan:
        return Shot(view, renderer, None, Plan.of(renderer, view, renderer.scene.camera), other=beside)
    return Shot(view, renderer, renderer.frame(view.pose.matrix()), None, other=beside)


def pictured(made):
    blank = Picture(1, 3, "exact", True, made.view)
    return picture_of(made, "the saved scene", blank, MaterialColours())


@pytest.mark.parametrize("plan", [False, True])
def test_pixels_without_a_value_have_colours_that_no_value_has_in_pictures_and_in_their_files(renderers, plan):
    pose = "0,-7,60,0,-60,0" if plan else LOW
    some = 0
    for layer in layers_of(renderers[0].scene, plan, learned=False):
        for other in (None, renderers[1]):
            made = shot(renderers[0], pose, layer, plan, other)
            picture = pictured(made)
            if picture.values is None or picture.unit == "level":
                continue
            nothing = ~np.isfinite(picture.values)
            some, last = some + bool(nothing.any()), picture
            assert nothing.any() == (layer != "apparent"), layer
            image = Image.open(io.BytesIO(picture.data))
            levels, shown = np.asarray(image), np.asarray(image.convert("RGB"))
            assert (levels[nothing] >= 254).all() and (levels[~nothing] < 254).all()
            colours = {tuple(each) for each in shown[nothing].tolist()}
            assert len(colours) == (2 if nothing.any() else 0)
            assert not colours & {tuple(each) for each in table(picture.palette).tolist()}
            assert ("hatched" in picture.notes) == bool(nothing.any())
    assert some > 10
    # In the file, too; the last picture has pixels without a value.
    file = np.asarray(Image.open(io.BytesIO(figure_of(last, "title", "png"))).convert("RGB")).reshape(-1, 3)
    assert colours <= {tuple(each) for each in np.unique(file, axis=0).tolist()}


def test_a_picked_point_stays_on_its_surface_and_says_when_it_is_out_of_view(renderers):
    made = shot(renderers[0], "0,-6,10,0,-55,0", "kinetic")
    point = Point.at(made, (200, 250))
    moved = shot(renderers[0], "1,-6,10,0,-55,0", "kinetic")
    column, row = point.pixel_in(moved)
    assert column < 200 - 20 and abs(row - 250) <= 2
    np.testing.assert_allclose(moved.position[row, column], point.position, atol=0.05)
    areas, colours = {}, MaterialColours()
    told = below(moved, pictured(moved), point, [replace(point, name="1")], None, areas, colours)
    assert dict(told["figures"])["Pixel"] == f"column {column}, row {row}"
    assert [mark[2] for mark in told["marks"]] == ["1", ""] and told["probes"][0][1] == "sand_quartz"
    away = shot(renderers[0], "0,-6,10,180,-55,0", "kinetic")
    told = below(away, pictured(away), point, [replace(point, name="1")], None, areas, colours)
    assert told["figures"] == [["Pixel", "the picked point is not in view"]]
    assert told["probes"][0][1] == "not in view" and not told["marks"]
    # The sky is no surface: its pixel counts in the same view only.
    sky = Point.at(shot(renderers[0], LOW, "apparent"), (320, 20))
    assert sky.texel == -1 and sky.pixel_in(moved) is None
    assert sky.pixel_in(shot(renderers[0], LOW, "kinetic")) == (320, 20)


def test_a_difference_is_called_one_and_the_figures_of_both_states_stand_side_by_side(renderers):
    made = shot(renderers[0], "0,-6,10,0,-55,0", "apparent", other=renderers[1])
    row, column = np.argwhere(made.material == made.names.index("grass_green"))[9000]
    picture, point = pictured(made), Point.at(made, (int(column), int(row)))
    told = below(made, picture, point, [], None, {}, MaterialColours())
    rows = {row[0]: row[1:] for row in told["figures"]}
    both = [float(each.split()[0]) for each in rows["Apparent temperature"]]
    assert both == pytest.approx(
        [each.frame.apparent_temperature[row, column] for each in (made, made.other)], abs=6e-4
    )
    assert rows["Difference"][0] == f"{both[0] - both[1]:.2f} K".replace("-", "−")
    assert "difference" in hovered(made, picture, (int(column), int(row)))
    assert told["sides"] == ["version 3", "the saved scene"]
    heat = {row[0]: row[1:] for row in told["heat"]}
    assert len(heat["Long-wave emitted"]) == 2 and heat["Long-wave emitted"][0] != heat["Long-wave emitted"][1]


@pytest.mark.parametrize(
    ("limits", "expected"),
    [
        (None, lambda low, high: (low, high)),
        ((280.0, None), lambda low, high: (280.0, high)),
        ((None, 320.0), lambda low, high: (low, 320.0)),
        ((400.0, None), lambda low, high: (400.0, 400.0 + high - low)),
        ((None, 100.0), lambda low, high: (100.0 - high + low, 100.0)),
    ],
)
def test_an_end_of_the_colours_that_is_not_fixed_is_as_the_picture_needs(renderers, limits, expected):
    made = shot(renderers[0], "0,-6,10,0,-55,0", "kinetic")
    free = pictured(made).ends
    made = replace(made, view=replace(made.view, limits=limits))
    assert pictured(made).ends == pytest.approx(expected(*free))


def test_the_file_of_a_split_view_shows_both_halves_and_their_names(renderers):
    made = shot(renderers[0], "0,-6,10,0,-55,0", "kinetic", other=renderers[1])
    made = replace(made, view=replace(made.view, slider=True))
    picture = pictured(made)
    assert picture.sides == ("version 3", "the saved scene")
    text = figure_of(picture, "title", "svg").decode()
    assert text.count("<image") == 3  # both halves and the bar
    assert not np.array_equal(picture.levels, picture.other_levels)
    # Both have the bar's colours.
    low, high = picture.ends
    for state, levels in ((made, picture.levels), (made.other, picture.other_levels)):
        kelvin = state.values("kinetic")
        known = np.isfinite(kelvin)
        np.testing.assert_allclose(
            levels[known], np.clip(253 * (kelvin[known] - low) / (high - low), 0, 253), atol=0.51
        )


def test_a_table_and_the_values_of_a_difference_hold_the_difference_and_say_so(renderers):
    session = Session(renderers[0], "fast")
    shown = []
    session.renders.start()
    view = View(Pose.typed("0,-6,10,0,-55,0", session.base), layer="kinetic", against="hour 3")
    session.renders.look("tab", view, shown.append, session.reference("hour 3"))
    wait_for(lambda: shown)
    made, picture = session.renders.shown("tab")
    change = made.values("kinetic") - made.other.values("kinetic")
    data, name = exported(session, "tab", "table.csv", 0.5)
    assert name == "balance-kinetic-minus-hour-3-version-0.table.csv"
    rows = {row["material"]: row for row in csv.DictReader(io.StringIO(data.decode()))}
    own = change[(made.material == made.names.index("grass_green")) & np.isfinite(change)]
    assert float(rows["grass_green"]["difference_mean_k"]) == pytest.approx(own.mean(dtype=float), rel=1e-5)
    assert abs(own.mean(dtype=float)) > 3.0 and not {"mean_k", "least_k"} & set(rows["grass_green"])
    text = exported(session, "tab", "csv", 0.5)[0].decode()
    values = np.genfromtxt(io.StringIO(text), delimiter=",", comments="#")
    np.testing.assert_allclose(values, change, atol=1e-3)
    assert "# shown: Kinetic temperature, minus that of solar hour 3" in text
    assert f"# time_utc: {session.base.time}Z" in text
    # A click or stroke belongs to the picture that it was made on, while that is kept.
    first = picture.number
    for number in range(first + 1, first + 5):
        turned = replace(view, pose=Pose.typed(f"{0.1 * number},-6,10,0,-55,0", session.base))
        session.renders.look("tab", turned, shown.append, session.reference("hour 3"))
        wait_for(lambda number=number: shown[-1].number == number)
    assert session.renders.shown("tab")[1].number == first + 4
    assert session.renders.shown("tab", first + 2)[0].view.pose.east == pytest.approx(0.1 * (first + 2))
    assert session.renders.shown("tab", first) == (None, None)
    session.close()


def test_what_is_saved_is_compared_at_the_hour_that_is_shown_and_a_version_says_its_own(renderers):
    session = Session(renderers[0], "fast")
    time = session.at_hour(16.0)
    session.edit(0, "", lambda document: replace(document, time=time))
    scene, words = session.reference("saved")
    assert scene.time == time and words == "the saved scene"
    assert scene is session.reference("saved")[0]
    scene, words = session.reference("version 0")
    assert scene.time == session.base.time
    assert words == f"version 0 ({session.hour_text(session.history.document_of(0))})"
    session.edit(1, "", lambda document: document.with_text("grass_green", "emissivity", "0.8"))
    assert session.reference("version 1")[1] == "version 1"
    assert session.hour_text(session.document) == "solar hour 16:00"


def test_a_name_of_a_point_never_stands_for_another(renderers):
    session = Session(renderers[0], "fast")
    point = Point.at(shot(renderers[0], "0,-6,10,0,-55,0", "kinetic"), (200, 250))
    for _ in range(2):
        session.keep([*session.points, replace(point, name=session.next_name())])
    session.keep(session.points[1:])
    session.keep([*session.points, replace(point, name=session.next_name())])
    assert [each.name for each in session.points] == ["2", "3"]
