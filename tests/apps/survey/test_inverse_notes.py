"""What a reconstruction says where frames, poses, references and settings contradict each other."""

import re
from dataclasses import replace
from shutil import copytree
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.ndimage import gaussian_filter

import thermorender as tr
from thermorender.apps.lands.procedural.procedural_scene import make
from thermorender.apps.lands.procedural.truth import write
from thermorender.apps.survey.inverse import level, products
from thermorender.apps.survey.inverse.frames import Survey
from thermorender.apps.survey.inverse.kinetic import unknowns
from thermorender.apps.survey.inverse.level import Reference, read_references
from thermorender.apps.survey.inverse.linear import LinearKelvin
from thermorender.apps.survey.inverse.normal import Prior, Sums, footprint
from thermorender.apps.survey.inverse.notes import Level, notes_of
from thermorender.apps.survey.inverse.poses import PoseError, deviation, moved, registered
from thermorender.apps.survey.inverse.reconstruct import reconstruct
from thermorender.apps.survey.inverse.shutter import Shutters
from thermorender.apps.survey.inverse.solve import Settings, State
from thermorender.apps.survey.inverse.spread import Draws, Spread
from thermorender.apps.survey.inverse.weights import Viewer
from thermorender.errors import ThermorenderError
from thermorender.frame.picture import draw
from thermorender.physics.planck import brightness_temperature
from thermorender.render.renderer import Renderer
from thermorender.sensor.camera import load_camera

pytestmark = pytest.mark.usefixtures("short_heat")

COUNT = 8
POND = Reference("pond", 0.0, 0.0, 1.0, 290.0, 0.1)
STEADY = Shutters(np.zeros(0, np.intp), np.zeros(COUNT), 0.0, 0.0)


def settled(poses=None, **changes):
    """Arguments of `notes_of` for frames that fit their map, with changes of State and Spread."""
    given = np.tile(np.eye(4), (COUNT, 1, 1))
    given[1::2, :2, :2] *= -1.0
    rng = np.random.default_rng(0)
    kelvin = rng.normal(290.0, 2.0, (COUNT, 6, 8)).astype(np.float32)
    survey = Survey(tuple(f"f{number}" for number in range(COUNT)), ("",) * COUNT, kelvin, given)
    blank = np.zeros((2, 2))
    state = State(blank, blank[0], np.zeros(COUNT), np.zeros((COUNT, 2)), 0.0, blank[0], blank,
                  given if poses is None else poses, 0.07, 1.0, 5)  # fmt: skip
    spread = Spread(blank, 1.0, 0.0, 0.0, blank.astype(np.int32), blank, np.full(COUNT, 0.1))
    state = replace(state, **{name: value for name, value in changes.items() if hasattr(state, name)})
    spread = replace(spread, **{name: value for name, value in changes.items() if hasattr(spread, name)})
    return survey, state, spread


def said(level_of=None, pixel_m=0.1, times=("",) * COUNT, **changes):
    """The notes on frames of `settled`, in one text."""
    survey, state, spread = settled(**changes)
    found = level_of or Level(0.0, [("pond", 0.0)], [POND], STEADY)
    noon = np.datetime64("2021-07-01T12:00:00")
    return " ".join(notes_of(replace(survey, times=times), [], state, spread, Settings(), pixel_m, found, noon))


def at(number, value, rest=0.0):
    line = np.full(COUNT, rest)
    line[number] = value
    return line


def test_frames_that_fit_their_map_have_no_note():
    # A frame that begins with a warm camera, a real residual, and moves of single frames are usual.
    poses = settled()[0].poses.copy()
    poses[3] = moved(poses[3], np.array([5.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert said(poses=poses, offsets=at(4, 8.0), noise_k=0.2, frames=at(2, 0.32, 0.1)) == ""


def test_a_misfit_below_a_kelvin_is_stated_with_its_causes():
    assert re.search(r"pixels differ from the map by 0\.50 K, 7\.1 times the noise", said(noise_k=0.5))


def test_shutters_and_what_they_set_are_stated():
    shutters = Shutters(np.array([2, 5]), np.zeros(COUNT), 6.3, -3.4)
    text = said(Level(-3.4, [], [], shutters))
    assert re.search(r"closed before f2, f5: offsets jump by 6\.3 K.*moves by -3\.4 K", text)
    # A reference fixes the level, whatever the shutter says.
    assert re.search(r"closed before f2, f5.*drift_k", said(Level(0.0, [("pond", 0.0)], [POND], shutters)))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"noise_k": 1.4}, "the frames differ from the map by 1.40 K, "),
        ({"frames": at(2, 0.9, 0.1)}, "1 frames differ from the map 3 times as much as others, by up to 0.90 K: f2;"),
        ({"offsets": at(5, 300.0)}, "1 frames have another level than the others, by up to 300.0 K, .*: f5;"),
        ({"pixel_m": 0.4}, r"texels of 0\.25 m are smaller than a pixel on the ground, 0\.4 m.*texel_m=0\.6 "),
    ],
)
def test_frames_that_contradict_the_map_are_stated(changes, words):
    assert re.search(words, said(**changes))


def test_a_common_move_of_all_frames_is_stated():
    poses = np.array([moved(pose, np.array([0.1, 0.0, -2.9, 0.0, 0.0, 0.0])) for pose in settled()[0].poses])
    assert "the frames moved together by +0.10 m east, +0.00 m north and -2.90 m up" in said(poses=poses)


@pytest.mark.parametrize(
    ("time", "fits"),
    [("2021:07:01 23:30:00", True), ("2021-07-01T14:10:00+02:00", True), ("2021-07-01T09:30Z", True), ("7 s", True),
     ("2018:07:01 12:00:00", False), ("2021:06:30 21:00:00", False), ("2021-07-01T12:00:00+05:30", False)],
)  # fmt: skip
def test_frames_of_another_time_than_the_scene_s_weather_are_stated(time, fits):
    text = said(times=(time,) * COUNT)
    assert (text == "") is fits
    if not fits:
        assert text.startswith(
            f"the times of the frames, such as {time}, are not that of the scene's weather, 2021-07-01T"
        )


def test_references_that_contradict_each_other_or_the_camera_are_stated():
    pair = [POND, replace(POND, name="road")]
    assert said(Level(1.0, [("pond", 0.2), ("road", -0.2)], pair, STEADY)) == ""
    text = said(Level(17.0, [("pond", -15.3), ("road", 22.9)], pair, STEADY))
    assert "contradict each other beyond their standard deviations (pond -15.30 K, road +22.90 K)" in text
    assert "shift all temperatures by +17.0 K, more than calibrated cameras are off" in text


@pytest.fixture(scope="module")
def found(tmp_path_factory):
    """A Reconstruction of two frames over a small heath."""
    folder = tmp_path_factory.mktemp("notes") / "heath"
    write(make("heath", 3, size_m=64.0, texel_m=1.0, post_m=4.0), folder, temperature_every=1)
    full = load_camera("zenmuse-xt2")
    scene = tr.load_scene(folder).with_camera(
        replace(full, width=80, height=64, pixel_pitch_um=8.0 * full.pixel_pitch_um)
    )
    renderer = Renderer(scene, quality="fast")
    poses = np.array([scene.pose(0.0, 0.0, 40.0, yaw_deg=yaw, pitch_deg=-90.0) for yaw in (0.0, 180.0)])
    radiance = np.array([renderer.radiance(pose) for pose in poses], np.float64)
    kelvin = brightness_temperature(radiance, *scene.camera.band_um).astype(np.float32)
    survey = Survey(("a", "b"), ("", ""), kelvin, poses)
    return reconstruct(scene, survey, settings=Settings(texel_m=1.0, rounds=2, pose_error=PoseError(0.0, 0.0)))


WEATHER_CSV = "time,air_c,rh_percent,wind_m_s\n" + "".join(f"2021-07-01T{hour:02d}:00Z,30,50,3\n" for hour in range(24))
WEATHER = '[weather]\nfile = "sky.csv"\ntime = "2021-07-01T12:00Z"\n'
SKY, ATMOSPHERE = "[sky]\ntemperature = 255.0\n", '[atmosphere]\nstandard = "tropical"\n'


def of_sky(found, tmp_path, tables):
    """(Notes on the sky of the fixture's scene with other tables of light, its sky [K])."""
    source = found.renderer.scene.spec.folder
    text = (source / "scene.toml").read_text()
    kept = [part for part in re.split(r"^(?=\[)", text, flags=re.M)
            if not part.startswith(("[sky]", "[weather]", "[atmosphere]", "[sun]"))]  # fmt: skip
    copytree(source, tmp_path / "scene")
    (tmp_path / "scene" / "sky.csv").write_text(WEATHER_CSV)
    (tmp_path / "scene" / "scene.toml").write_text("".join(kept) + "\n" + tables)
    scene = tr.load_scene(tmp_path / "scene")
    linear = LinearKelvin(scene.camera.band_um, 300.0)
    notes = unknowns(SimpleNamespace(scene=scene), found.light.material, linear)
    return [note for note in notes if "sky of" in note], scene.sky_temperature


@pytest.mark.parametrize(
    ("tables", "advice", "followed"),
    [
        (SKY, "give the scene [weather] and leave out [sky], or replace [sky] by [atmosphere]", (WEATHER, ATMOSPHERE)),
        (SKY + WEATHER, "leave out [sky], so that the scene's [weather] gives it, or replace [sky] by [atmosphere]",
         (WEATHER, WEATHER + ATMOSPHERE)),
    ],
)  # fmt: skip
def test_a_sky_of_one_temperature_is_named_until_its_advice_is_followed(found, tmp_path, tables, advice, followed):
    (note,), kelvin = of_sky(found, tmp_path / "before", tables)
    assert kelvin == 255.0 and "the reflected sky of 255 K is [sky] of the scene" in note
    assert note.endswith(f"; {advice}")
    for number, each in enumerate(followed):
        notes, kelvin = of_sky(found, tmp_path / str(number), each)
        assert notes == [] and abs(kelvin - 255.0) > 1.0


def test_references_that_contradict_each_other_widen_the_level(found):
    linear = LinearKelvin(found.camera.band_um, round(float(np.nanmedian(found.survey.kelvin)), 1))
    seen = found.views > 0

    def shifted(*kelvin):
        references = [Reference(f"{k}", 2.0, 2.0, 2.0, each, 0.5) for k, each in enumerate(kelvin)]
        values = found.state.map
        return level.shift_of(
            references, values, 0.0 * values, seen, found.light, found.renderer, found.lattice, linear
        )

    one, alike, apart = (shifted(*kelvin)[1] for kelvin in ((300.0,), (300.0, 300.0), (295.0, 305.0)))
    assert one == pytest.approx(0.5)
    assert alike == pytest.approx(0.5 / np.sqrt(2.0))
    # Two values differ by d: the standard deviation of their mean is d/2. Emissivities make d a little less than 10 K.
    assert apart == pytest.approx(5.0, rel=0.1)


def test_a_reference_beyond_the_map_is_refused_before_the_solution(found):
    def progress(what, share):
        assert what != "solving the map"

    away = Reference("away", 500.0, 0.0, 1.0, 300.0, 0.1)
    with pytest.raises(ThermorenderError, match="reference 'away' at east_m=500, north_m=0 is on no texel"):
        reconstruct(found.renderer.scene, found.survey, settings=found.settings, references=[away], progress=progress)


@pytest.mark.parametrize(
    ("rows", "words"),
    [("a,0,5,1,900,0.1\n", "row 2: kelvin=900 is not the temperature of ground"),
     ("a,0,5,1,297,0.1\na,0,5,1,297,0.1\n", "row 3: name='a' is given twice")],
)  # fmt: skip
def test_references_that_cannot_be_or_count_twice_are_refused(tmp_path, rows, words):
    path = tmp_path / "r.csv"
    path.write_text("name,east_m,north_m,radius_m,kelvin,std_k\n" + rows)
    with pytest.raises(ThermorenderError, match=words):
        read_references(path, None)


def test_a_frame_of_few_pixels_with_a_value_keeps_its_pose(found):
    viewer = Viewer(found.renderer, found.camera, found.lattice)
    image, pose = np.full(found.survey.kelvin[0].shape, np.nan, np.float32), found.survey.poses[0]
    image[::8, ::8] = found.survey.kelvin[0, ::8, ::8]
    made = registered(viewer, found.state.map, image, pose, pose, PoseError(), search=False)
    np.testing.assert_array_equal(made, pose)


def test_a_frame_that_a_map_does_not_resemble_keeps_its_pose(found):
    viewer = Viewer(found.renderer, found.camera, found.lattice)
    image, pose = found.survey.kelvin[0], found.survey.poses[0]
    # As coarse as the frame, and not like it.
    other = gaussian_filter(np.random.default_rng(4).normal(size=found.lattice.shape), 2.0)
    steps = [
        deviation(registered(viewer, values, image, pose, pose, PoseError(), search=False), pose)
        for values in (other, found.state.map)
    ]
    assert not steps[0].any()
    assert steps[1].any()


def test_the_residual_of_a_frame_is_the_root_mean_square_over_its_pixels(found):
    sight = Viewer(found.renderer, found.camera, found.lattice).sight(found.survey.poses[0])
    count, seen = len(sight.pixel), footprint(sight)
    given = np.random.default_rng(1).normal(0.0, 0.3, count), np.ones(count), np.ones((1, count)), np.zeros((1, count))
    shape = found.lattice.shape
    draws = Draws(Prior(np.zeros(shape), np.ones(shape), np.zeros(shape, int), 1.0), 1, 1.0, np.zeros(64 * 80))
    draws.add(0, draws.of_frame(0, seen, sight.pixel, *given), Sums.of(seen, *given))
    assert draws.misfits == [pytest.approx(np.sqrt(np.mean(given[0] ** 2)), rel=1e-9)]


@pytest.mark.parametrize(("width_m", "metres"), [(4.0, 1.0), (43.0, 10.0), (80.0, 20.0), (199.0, 20.0), (900.0, 200.0)])
def test_the_scale_bar_of_a_map_has_the_length_that_it_states(width_m, metres):
    shape = Figure(figsize=(7.5, 5.0))
    draw(shape, np.zeros((30, 40)), "map", texel_m=width_m / 40)
    axes = shape.axes[0]
    (bar,) = axes.lines
    # In shares of the width of the picture.
    assert np.ptp(bar.get_xdata()) * width_m == pytest.approx(metres)
    assert [each.get_text() for each in axes.texts] == [f"{metres:g} m"]


def test_the_pictures_of_a_report_s_maps_have_a_scale_bar(found, tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(products, "png", lambda values, title, of, texel_m: drawn.update({title: texel_m}) or b"")
    text = products.write_page(found, tmp_path).read_text()
    assert drawn.pop("lens") is None
    assert len(drawn) == 6 and set(drawn.values()) == {found.lattice.texel_m}
    for rest in found.spread.frames:
        assert f"<td>{rest:.3f}</td>" in text
