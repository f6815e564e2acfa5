"""Scenes that a studio opens, lists, imports and makes, without a browser."""

import json
import threading
import time

import numpy as np
import pytest
from rasterio.warp import transform
from studio_support import wait_for

import thermorender as tr
from scenes import write_hut, write_raster, write_terrain
from thermorender import defaults
from thermorender.apps.lands.import_settings import ImportSettings
from thermorender.apps.lands.import_terrain import import_terrain
from thermorender.apps.studio import labels, opening
from thermorender.apps.studio.forms import IMPORT, PRACTICE, about, completions, imported
from thermorender.apps.studio.opening import Studio
from thermorender.apps.studio.scene_list import listed, remember
from thermorender.apps.studio.session import Session
from thermorender.cache import cache_folder
from thermorender.errors import ThermorenderError
from thermorender.scene.raster import grid_of


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    """A cache folder of the test's own, with the file of recent scenes."""
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))
    return cache_folder("studio") / "recent.json"


@pytest.fixture
def studio():
    made = Studio("fast", "auto")
    yield made
    made.end()


class EndedError(Exception):
    """Raised to end an import."""


def no_report(what, share):
    pass


# --- lists ------------------------------------------------------------------------------------------------------


def test_recent_scenes_are_the_latest_first_and_those_that_cannot_be_read_are_left_out(tmp_path, cache):
    one, other, gone = (write_terrain(tmp_path / name) for name in ("one", "other", "gone"))
    for folder in (one, gone, other, one):
        assert remember(folder) is None
    (gone / "scene.toml").unlink()
    shipped, recent = listed()
    assert [each.folder.name for each in shipped] == list(defaults.SCENES)
    assert [each.folder for each in recent] == [one, other]
    (other / "scene.toml").write_text("[terrain]\nelevation = 7\n", "utf-8")
    assert [each.folder for each in listed()[1]] == [one]
    for number in range(20):
        remember(tmp_path / f"s{number}")
    assert len(json.loads(cache.read_text("utf-8"))) == 12


@pytest.mark.parametrize("text", [
    b"", b"{", b"\xff\xfe", b"7", b'{"a": 1}',
    b'[7, null, {"a": 1}, "relative", "/no\\u0000where", "/\\ud800"]', b"[" * 9999,
])  # fmt: skip
def test_a_damaged_file_of_recent_scenes_is_an_empty_list(tmp_path, cache, text):
    cache.parent.mkdir(parents=True)
    cache.write_bytes(text)
    assert listed()[1] == []
    folder = write_terrain(tmp_path / "one")
    assert remember(folder) is None
    assert [each.folder for each in listed()[1]] == [folder]


def test_recent_scenes_that_cannot_be_kept_are_a_sentence(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("", "utf-8")
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "file"))
    assert "recent scenes are not kept: " in remember(tmp_path / "one")


def test_a_listed_scene_says_its_size_and_source_of_temperatures_and_has_a_picture(tmp_path):
    import cv2

    colour = np.zeros((32, 32, 3), np.uint8) + np.uint8([200, 30, 40])
    remember(write_terrain(tmp_path / "one", colour=colour))
    remember(write_hut(tmp_path / "grey"))
    shipped, recent = listed()
    assert shipped[0].about == "400 × 400 m · true temperatures"
    (one,) = (each for each in recent if each.folder.name == "one")
    assert one.title == "tiny" and one.about == "16 × 16 m · temperatures of a raster"
    picture = cv2.imdecode(np.frombuffer(one.picture(), np.uint8), cv2.IMREAD_COLOR)
    np.testing.assert_allclose(picture.mean((0, 1)), [40, 30, 200], atol=6)  # JPEG
    assert len(shipped[0].picture()) > 2000


# --- forms ------------------------------------------------------------------------------------------------------


def texts(fields, **given):
    return {each.key: given.get(each.key, each.value) for each in fields}


@pytest.mark.parametrize(("sentence", "key"), [
    ("/a/dem.tif has no coordinate reference system (CRS); assign one, or give crs to an import", "elevation"),
    ("/a/dem.tif.png is empty where /a/dem.tif is; give an orthophoto of the same area", "orthophoto"),
    ("/a/dem exists and is not empty; give a new folder", "output"),
    ("crs='x' is not a coordinate reference system; give its EPSG code", "crs"),
    ("weather=/a/w.csv needs the scene's instant; give time, such as 2018-07-28T14:30Z", "weather"),
    ("/a/w.csv row 3: the pressure is not a number", "weather"),
    ("elevation is empty; give the path of a GeoTIFF of heights", "elevation"),
    ("this machine does not have enough memory", ""),
    ("/b/a/dem.tif is odd", ""),
])  # fmt: skip
def test_a_fault_is_about_the_field_whose_name_or_path_comes_first(sentence, key):
    given = texts(IMPORT, elevation="/a/dem.tif", orthophoto="/a/dem.tif.png", output="/a/dem", weather="/a/w.csv")
    assert about(sentence, given) == key


def test_a_form_without_a_path_or_with_a_wrong_number_is_one_sentence(tmp_path):
    for given, sentence in (
        ({}, "elevation is empty; give the path of a GeoTIFF of heights"),
        ({"elevation": "/a.tif"}, "output is empty; give the path of a folder to make"),
        ({"elevation": "/a.tif", "output": "/b", "texel_m": "fine"}, "texel_m='fine' is not a number; give metres"),
        ({"elevation": "~nobody-of-this-name/a.tif", "output": "/b"}, "names the folder of an unknown user"),
    ):
        with pytest.raises(ThermorenderError, match=sentence):
            imported(texts(IMPORT, **given), no_report)


def test_a_path_is_completed_by_what_is_on_this_machine(tmp_path):
    for name in ("dem.tif", "demo.csv", ".hidden"):
        (tmp_path / name).write_text("", "utf-8")
    (tmp_path / "den").mkdir()
    assert completions(f"{tmp_path}/de", False) == [f"{tmp_path}/dem.tif", f"{tmp_path}/demo.csv", f"{tmp_path}/den/"]
    assert completions(f"{tmp_path}/de", True) == [f"{tmp_path}/den/"]
    assert completions(f"{tmp_path}/", True) == [f"{tmp_path}/den/"]
    assert completions("/nowhere/", False) == completions("", True) == completions("\0/", True) == []


# --- imports ----------------------------------------------------------------------------------------------------


def rasters(folder, **options):
    """An elevation model of 1 m posts and an orthophoto of 0.5 m texels."""
    rng = np.random.default_rng(3)
    colour = rng.integers(40, 200, (3, 64, 64)).astype(np.uint8)
    return (
        write_raster(folder / "dem.tif", rng.uniform(100.0, 102.0, (1, 32, 32)).astype(np.float32), **options),
        write_raster(folder / "photo.tif", colour, 0.5, photometric="RGB", **options),
    )


@pytest.mark.parametrize(("texel_m", "made_m"), [(None, 0.5), (0.1, 0.5), (1.0, 1.0)])
def test_texels_of_an_import_are_not_smaller_than_asked(tmp_path, texel_m, made_m):
    made = import_terrain(*rasters(tmp_path), tmp_path / "s", ImportSettings(texel_m=texel_m))
    assert made["texel_m"] == pytest.approx(made_m)
    assert grid_of(tmp_path / "s" / "orthophoto.tif").transform.a == pytest.approx(made_m)


def test_files_without_a_crs_are_imported_in_that_of_the_settings(tmp_path):
    paths = rasters(tmp_path, crs=None)
    with pytest.raises(ThermorenderError, match=r"dem\.tif has no coordinate .* or give crs to an import"):
        import_terrain(*paths, tmp_path / "s")
    with pytest.raises(ThermorenderError, match="crs='fine' is not a coordinate reference system; give its EPSG code"):
        import_terrain(*paths, tmp_path / "s", ImportSettings(crs="fine"))
    import_terrain(*paths, tmp_path / "s", ImportSettings(crs="EPSG:25833"))
    for name in ("elevation.tif", "orthophoto.tif"):
        assert grid_of(tmp_path / "s" / name).crs.to_epsg() == 25833
    # Files that declare one keep it.
    (tmp_path / "declared").mkdir()
    import_terrain(*rasters(tmp_path / "declared"), tmp_path / "t", ImportSettings(crs="EPSG:25833"))
    assert grid_of(tmp_path / "t" / "elevation.tif").crs.to_epsg() == 32634
    # A square of them, around their middle.
    (longitude,), (latitude,) = transform("EPSG:32634", "EPSG:4326", [500016.0], [5779984.0])
    around = ImportSettings(crs="EPSG:32634", around=f"{latitude},{longitude},10")
    assert import_terrain(*paths, tmp_path / "u", around)["posts"] == [10, 10]


@pytest.mark.parametrize("wrong", [0.0, -1.0, np.inf, np.nan])
def test_texels_without_a_length_are_refused(tmp_path, wrong):
    with pytest.raises(ThermorenderError, match=r"texel_m=.* is not a length; give metres above 0"):
        import_terrain(*rasters(tmp_path), tmp_path / "s", ImportSettings(texel_m=wrong))


def test_an_import_reports_rising_shares_and_leaves_nothing_where_it_is_ended(tmp_path):
    shares = []
    paths = rasters(tmp_path)
    import_terrain(*paths, tmp_path / "s", progress=lambda what, share: shares.append(share))
    assert shares == sorted(shares) and len(shares) > 5 and (shares[0], shares[-1]) == (0.0, 1.0)
    for end in shares[:-1]:

        def ended(what, share, end=end):
            if share >= end:
                raise EndedError

        with pytest.raises(EndedError):
            import_terrain(*paths, tmp_path / "t", progress=ended)
        assert {path.name for path in tmp_path.iterdir()} == {"dem.tif", "photo.tif", "s"}


# --- the scene that is open -------------------------------------------------------------------------------------


def test_a_session_is_unsaved_until_its_edits_are_written_or_undone(tmp_path):
    session = Session(tr.Renderer(tr.load_scene(write_hut(tmp_path / "hut")), "fast"), "fast")
    texels = session.renders.renderer.region(16 * 32 + 24)
    area = labels.collection(session.base.grid, [
        labels.labelled(each, "snow") for each in labels.geometry_of(session.base, texels)
    ])  # fmt: skip
    for change in (
        lambda document: document.with_text("grass_green", "emissivity", "0.8"),
        lambda document: document.of_class(1, "snow"),
        lambda document: document.of_object("hut", kelvin=301.0),
        lambda document: document.with_area(area, "snow"),
        lambda document: document.duplicated("snow", "mine"),
    ):
        assert not session.unsaved
        session.edit(session.history.version, "", change)
        assert session.unsaved
        session.step(session.history.version, -1)
    assert not session.unsaved
    session.edit(session.history.version, "", lambda document: document.of_class(1, "snow"))
    session.write(session.files.plan(session.document))
    assert not session.unsaved
    session.step(session.history.version, -1)
    assert session.unsaved
    session.close()


def test_another_scene_closes_the_one_before_and_one_that_cannot_be_read_does_not(tmp_path, studio):
    one, other = (write_terrain(tmp_path / name) for name in ("one", "other"))
    left = []
    studio.leave = lambda: left.append(studio.told)
    studio.begin_opening(one, "folder")
    wait_for(lambda: studio.work.ended)
    first = studio.session
    assert first.base.spec.folder == one and not left
    studio.begin_opening(tmp_path / "nowhere", "folder")
    wait_for(lambda: studio.work.ended)
    assert "nowhere' does not exist; give a folder with a scene.toml" in studio.work.fault
    assert studio.session is first
    studio.begin_opening(other, "folder")
    wait_for(lambda: studio.work.ended)
    assert studio.session.base.spec.folder == other and left == ["one is closed, as other was opened in its place"]
    assert not first.renders._thread.is_alive()
    assert [each.folder for each in listed()[1]] == [other, one]


def test_a_scene_that_is_edited_while_another_one_is_read_stays_open(tmp_path, studio, monkeypatch):
    one, other = (write_terrain(tmp_path / name) for name in ("one", "other"))
    studio.begin_opening(one, "folder")
    wait_for(lambda: studio.work.ended)
    first, going = studio.session, threading.Event()
    for made in (lambda document: document.of_class(1, "snow"), lambda document: document.of_class(2, "snow")):
        begun = threading.Event()

        def read(name, begun=begun):
            begun.set()
            assert going.wait(60.0)
            return tr.load_scene(name)

        monkeypatch.setattr(opening, "load_scene", read)
        studio.begin_opening(other, "folder")
        assert begun.wait(60.0)
        first.edit(first.history.version, "", made)
        going.set()
        wait_for(lambda: studio.work.ended)
        assert "one was edited meanwhile and is not saved, so it stays open; save it" in studio.work.fault
        assert studio.session is first
        going.clear()
    # Edits that were there when it began are lost, as the page has asked.
    going.set()
    studio.begin_opening(other, "folder")
    wait_for(lambda: studio.work.ended)
    assert studio.session.base.spec.folder == other


def test_work_is_cancelled_at_its_next_step_and_refuses_other_work_meanwhile(tmp_path, studio, monkeypatch):
    folder, begun = write_terrain(tmp_path / "one"), threading.Event()

    def endless(*arguments, progress, **settings):
        begun.set()
        while True:
            progress("tracing", 0.25)
            time.sleep(0.01)

    monkeypatch.setattr(opening, "Renderer", endless)
    studio.begin_opening(folder, "folder")
    assert begun.wait(60.0)
    wait_for(lambda: (studio.work.what, studio.work.share) == ("tracing", 0.25))
    with pytest.raises(ThermorenderError, match="Opening one is under way; wait until it ends, or cancel it"):
        studio.begin_form("practice", texts(PRACTICE))
    studio.cancel()
    wait_for(lambda: studio.work.ended)
    assert studio.session is None and studio.busy is None and not studio.work.fault
    # What renders later must not be cancelled by it, nor a scene that is open count as cancelled.
    monkeypatch.setattr(opening, "Renderer", tr.Renderer)
    monkeypatch.setattr(opening, "remember", lambda folder: studio.cancel())
    studio.begin_opening(folder, "folder")
    wait_for(lambda: studio.work.ended)
    assert studio.session is not None and not studio.work.cancelled
    studio.cancel()
    assert not studio.work.cancelled


def test_a_fault_of_the_studio_itself_is_a_sentence_and_the_next_scene_opens(tmp_path, studio, monkeypatch, capfd):
    folder = write_terrain(tmp_path / "one")
    with monkeypatch.context() as patch:
        patch.setattr(opening, "Renderer", lambda *arguments, **settings: 1 / 0)
        studio.begin_opening(folder, "folder")
        wait_for(lambda: studio.work.ended)
    assert studio.work.fault.startswith("the studio failed here (ZeroDivisionError)")
    assert "ZeroDivisionError" in capfd.readouterr().err
    studio.begin_opening(folder, "folder")
    wait_for(lambda: studio.work.ended)
    assert studio.session is not None


def test_an_imported_terrain_is_opened_with_what_is_doubtful_of_it(tmp_path, studio):
    dem, photo = rasters(tmp_path)
    form = texts(IMPORT, elevation=str(dem), orthophoto=str(photo), output=str(tmp_path / "made"))
    studio.begin_form("import", form)
    wait_for(lambda: studio.work.ended)
    assert not studio.work.fault
    assert studio.session.base.spec.folder == tmp_path / "made"
    assert any("temperatures of the imported terrain are a placeholder" in note for note in studio.notes)


def test_a_pose_of_no_scene_and_an_unknown_quality_are_one_sentence(call):
    pytest.importorskip("nicegui", reason="needs thermorender[studio]")
    for arguments, sentence in (
        (("--pose=0,0,9,0,-90,0",), "pose='0,0,9,0,-90,0' is of the first view of a scene; give the scene too"),
        (("--quality", "fine"), "quality='fine' is unknown; give one of fast, standard, high"),
    ):
        status, _, error = call("studio", *arguments)
        assert status == 2 and sentence in " ".join(error.split())
