"""Faults around the material studio: odd requests, edits in quick succession, saves, and labels of a map."""

import asyncio
import json
import shlex
import threading
import time

import numpy as np
import pytest
from studio_support import wait_for

import thermorender as tr
from scenes import write_hut, write_terrain
from thermorender.apps.studio import labels
from thermorender.apps.studio.exports import commands
from thermorender.apps.studio.session import History, Session
from thermorender.apps.studio.spectrum import read_spectrum
from thermorender.apps.studio.view import Pose, View
from thermorender.errors import ThermorenderError
from thermorender.render.renderer import Renderer


@pytest.fixture
def folder(tmp_path):
    return write_hut(tmp_path / "tiny scene")


@pytest.fixture
def session(folder):
    made = Session(tr.Renderer(tr.load_scene(folder), "fast"), "fast")
    yield made
    made.close()


def emissive(name, value):
    """An edit that sets a flat emissivity."""
    return lambda document: document.with_text(name, "emissivity", value)


def status_of(headers):
    """The status that the guard of a studio at 127.0.0.1:8000 answers; its token is "secret"."""
    pytest.importorskip("nicegui", reason="needs thermorender[studio]")
    from thermorender.apps.studio.app import Guard

    answers = []

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200})

    async def send(message):
        answers.append(message)

    scope = {
        "type": "http",
        "query_string": b"",
        "headers": [(key.encode(), value.encode("latin-1")) for key, value in headers.items()],
    }
    asyncio.run(Guard(app, "secret", "127.0.0.1", 8000)(scope, None, send))
    return answers[0]["status"]


def test_cookies_of_other_programs_do_not_hide_the_token():
    own, host = "thermorender_studio_8000=secret", "127.0.0.1:8000"
    for other in ('prefs={"a": 1, "b": "x"}', "a[b]=c", "x y=z", "=", 'open="', "thermorender_studio_9=secret"):
        assert status_of({"host": host, "cookie": f"{other}; {own}"}) == 200
        assert status_of({"host": host, "cookie": f"{own}; {other}"}) == 200
        assert status_of({"host": host, "cookie": other}) == 403


def test_broken_addresses_are_refused():
    cookie = {"cookie": "thermorender_studio_8000=secret"}
    for host in ("[::1", "[", "", "::", "127.0.0.1.example:8000", "user@127.0.0.1:8000"):
        assert status_of({"host": host, **cookie}) == 403
    for origin in ("http://[", "null", "", "ftp://127.0.0.1:8000", "http://127.0.0.1:8000.example"):
        assert status_of({"host": "127.0.0.1:8000", "origin": origin, **cookie}) == 403
    assert status_of({"host": "127.0.0.1:8000", "origin": "http://127.0.0.1:8000", **cookie}) == 200
    assert status_of({"host": "127.0.0.1", "origin": "http://127.0.0.1", **cookie}) == 200  # a browser, of port 80


def test_a_tab_need_not_wait_for_its_own_edits(session):
    first = session.document
    history = History(first)

    def edit(version, value, by):
        history.edit(version, value, emissive("asphalt", value), print, by)

    edit(0, "0.5", "a")
    edit(0, "0.6", "a")
    history.step(0, -1, "a")
    history.step(1, -1, "a")
    assert history.document is first and history.version == 0
    # Another tab that saw version 1 has missed the way back from it.
    with pytest.raises(ThermorenderError, match="another tab has changed the tables since"):
        edit(1, "0.7", "b")
    edit(0, "0.7", "b")
    for version in (1, 2):
        with pytest.raises(ThermorenderError, match="another tab has changed the tables since"):
            edit(version, "0.8", "a")
    edit(3, "0.8", "a")
    edit(3, "0.9", "a")
    assert history.version == 5


def test_undo_brings_the_number_of_a_version_back_and_a_new_edit_has_a_new_one(session):
    history = session.history
    for version, value in ((0, "0.5"), (1, "0.6")):
        session.edit(version, value, emissive("asphalt", value))
    documents = [history.document_of(version) for version in (0, 1, 2)]
    assert [(version, what, steps) for version, what, steps in history.entries] == [
        (0, "", -2), (1, "0.5", -1), (2, "0.6", 0)
    ]  # fmt: skip
    session.step(2, -2)
    assert history.version == 0 and history.document is documents[0]
    session.step(0, 2)
    assert history.version == 2 and history.document is documents[2]
    assert not session.step(2, 1)
    session.step(2, -1)
    session.edit(1, "0.7", emissive("asphalt", "0.7"))
    assert [version for version, _, _ in history.entries] == [0, 1, 3]
    with pytest.raises(ThermorenderError, match="version 2 is no longer there"):
        history.document_of(2)


def test_edits_of_two_threads_do_not_lose_one_another(session):
    begun = threading.Event()

    def slow(document):
        begun.set()
        time.sleep(0.3)
        return document.with_text("asphalt", "emissivity", "0.5")

    thread = threading.Thread(target=session.edit, args=(0, "", slow, "a"))
    thread.start()
    assert begun.wait(30.0)
    with pytest.raises(ThermorenderError, match="another tab has changed the tables since"):
        session.edit(0, "", emissive("snow", "0.5"), "b")
    thread.join(30.0)
    assert session.history.version == 1
    assert session.document.library["asphalt"].emissivity.max() == 0.5


def test_edits_of_a_material_that_another_tab_deleted_are_one_sentence(session):
    session.edit(0, "copy", lambda document: document.duplicated("asphalt", "mine"))
    session.edit(1, "deleted", lambda document: document.without("mine"))
    for change in (
        emissive("mine", "0.5"),
        lambda document: document.duplicated("mine", "other"),
        lambda document: document.renamed("mine", "other"),
        lambda document: document.without("mine"),
    ):
        with pytest.raises(ThermorenderError, match="'mine' is no longer there, since it was deleted"):
            session.edit(2, "late", change)
    assert session.history.version == 2


def test_a_save_does_not_count_later_edits_as_saved(session):
    session.edit(0, "", emissive("grass_green", "0.8"))
    save = session.files.plan(session.document)
    session.edit(1, "", emissive("grass_green", "0.7"))
    with pytest.raises(ThermorenderError, match="nothing was written, so press Save again"):
        session.write(save)
    assert not (session.base.spec.folder / "materials").exists()
    session.write(session.files.plan(session.document))
    read = tr.load_scene(session.base.spec.folder)
    assert {each.name: each.emissivity.max() for each in read.materials}["grass_green"] == 0.7


def test_the_lines_without_the_page_name_or_repeat_all_edits(session):
    session.edit(0, "", lambda document: document.of_class(1, "snow"))
    session.edit(1, "", lambda document: document.of_object("hut", "granite", 301.25))
    view = View(Pose.typed("0,-6,10,0,-55,0", session.base))
    python, line = commands(session, view)
    found = {}
    exec(python.partition("renderer =")[0], found)
    for one, other in zip(found["scene"].surfaces, session.scene.surfaces, strict=True):
        np.testing.assert_array_equal(one.temperature, other.temperature)
        names = [np.array([each.name for each in of.materials]) for of in (found["scene"], session.scene)]
        np.testing.assert_array_equal(names[0][one.material], names[1][other.material])
    assert "hut" in line and "\nthermorender render " in line
    assert shlex.split(line.partition("\n")[2])[2] == str(session.base.spec.folder)


def test_a_fault_beside_a_solution_does_not_end_it(session, capfd):
    shown, renders = [], session.renders
    renders.start()

    def show(picture):
        shown.append(picture)
        if picture.data:
            raise RuntimeError("the page has gone")

    renders.look("tab", View(Pose.typed("0,-6,10,0,-55,0", session.base)), show)
    for version in range(3):
        session.edit(version, "", emissive("grass_green", f"0.{version}5"))
        renders.run(lambda: 1 / 0)
    wait_for(lambda: renders.light.version == 3 and renders.light.exact)
    assert renders.call(lambda: 7) == 7
    assert "ZeroDivisionError" in capfd.readouterr().err


def test_the_next_preview_does_not_wait_for_a_solution_and_only_the_latest_solution_is_shown(session, monkeypatch):
    shown, renders, going, begun = [], session.renders, threading.Event(), threading.Event()
    solved_for = Renderer.solved_for

    def slow(self, scene, progress=None):
        # A step of a solution that takes long.
        begun.set()
        assert going.wait(30.0)
        return solved_for(self, scene, progress)

    monkeypatch.setattr(Renderer, "solved_for", slow)
    renders.start()
    renders.look("tab", View(Pose.typed("0,-6,10,0,-55,0", session.base)), shown.append)
    try:
        session.edit(0, "", emissive("grass_green", "0.85"))
        assert begun.wait(30.0)
        session.edit(1, "", emissive("grass_green", "0.75"))
        wait_for(lambda: any(picture.version == 2 for picture in shown))
        assert renders.call(lambda: 7) == 7
        assert not any(picture.exact for picture in shown if picture.version)
    finally:
        going.set()
    wait_for(lambda: renders.light.exact and renders.light.version == 2)
    assert not any(picture.exact and picture.version == 1 for picture in shown)


def test_after_quick_edits_a_solution_waits_for_a_pause(session, monkeypatch):
    renders, begun = session.renders, []
    solved_for = Renderer.solved_for
    monkeypatch.setattr("thermorender.apps.studio.renders.PAUSE_S", 3600.0)

    def counted(self, scene, progress=None):
        begun.append(scene)
        while len(begun) == 1:
            time.sleep(0.01)
            progress("", 0.0)
        return solved_for(self, scene, progress)

    monkeypatch.setattr(Renderer, "solved_for", counted)
    renders.start()
    for version in range(2):
        session.edit(version, "", emissive("grass_green", f"0.{version}5"))
        wait_for(lambda k=version: renders.light.version == k + 1 and (begun or k))
    time.sleep(0.3)
    assert len(begun) == 1 and not renders.light.exact
    # The studio ends without it.
    renders.stop()
    assert not solves()


def test_a_full_disk_is_one_sentence_and_changes_no_file(session, monkeypatch, tmp_path):
    session.edit(0, "", emissive("grass_green", "0.8"))
    before = {path: path.read_bytes() for path in session.base.spec.folder.rglob("*") if path.is_file()}
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
    for act in (
        lambda: session.files.plan(session.document),
        lambda: read_spectrum("a.csv", b"wavelength_um,emissivity\n2,0.9\n20,0.9\n", session.document.library["snow"]),
    ):
        with pytest.raises(ThermorenderError, match=r"cannot be written: .*; check the folder"):
            act()
    assert session.history.version == 1
    assert {path: path.read_bytes() for path in session.base.spec.folder.rglob("*") if path.is_file()} == before


def labelled(session):
    """Label the middles of both halves of a terrain of rasters."""
    height, width = session.base.surfaces[0].material.shape
    texel = np.arange(height * width).reshape(height, width)
    for material, left in (("grass_green", 0.05), ("sand_quartz", 0.55)):
        rows, columns = (slice(*(round(side * share) for share in part)) for side, part in (
            (height, (0.05, 0.95)), (width, (left, left + 0.4)),
        ))  # fmt: skip
        geometry = labels.geometry_of(session.base, texel[rows, columns].ravel())
        session.labels.append([labels.labelled(each, material) for each in geometry])


def test_labels_of_the_ground_are_a_file_that_training_reads(session, folder, tmp_path):
    from thermorender.apps.training.material_training import labelled_scene

    labelled(session)
    features = [feature for each in session.labels for feature in each]
    made, path = labels.collection(session.base.grid, features), tmp_path / "labels.geojson"
    path.write_text(json.dumps(made), "utf-8")
    found = labelled_scene(folder, path)
    np.testing.assert_array_equal(found.material, labelled_scene(folder, made).material)
    names = np.array(["", *(found.names[number] for number in (1, 2))])[found.material]
    assert (names[5:27, 3:13] == "grass_green").all() and (names[5:27, 19:29] == "sand_quartz").all()
    assert (names[:, 15:17] == "").all()


@pytest.mark.slow
def test_a_map_learned_from_labels_shows_materials_and_their_uncertainty(tmp_path, monkeypatch):
    from thermorender.apps.training import emissivity_training as training

    monkeypatch.setattr(training, "_STEPS", 300)
    columns, random = np.mgrid[:128, :128][1], np.random.default_rng(1)
    colour = np.where((columns < 64)[..., None], (60, 120, 50), (200, 180, 140)) + random.integers(-8, 9, (128, 128, 3))
    made = write_terrain(
        tmp_path / "halves", height=np.zeros((64, 64)), classes=np.where(columns < 64, 1, 2), colour=colour
    )
    session = Session(tr.Renderer(tr.load_scene(made), "fast"), "fast")
    labelled(session)
    said = []
    learned = labels.learned_from(session, lambda what, share: said.append((what, share)))
    assert {what for what, _ in said} >= {"fitting the networks", "mapping the materials"}
    one, other = learned.best[64, [20, 108]]
    assert one != other
    assert (learned.best[64, [20, 108]] == session.base.surfaces[0].material[64, [20, 108]]).all()
    assert (learned.best[:, 4:54] == one).mean() > 0.95
    assert learned.std.shape == learned.best.shape and 0.0 < learned.std.mean() < 0.1
    assert learned.words.startswith("Most probable: grass_green ")

    def cancelled(what, share):
        raise ThermorenderError("cancelled")

    with pytest.raises(ThermorenderError, match=r"^cancelled$"):
        labels.learned_from(session, cancelled)
    session.close()


def test_a_long_pasted_text_is_refused_at_once(session):
    rows = "".join(f"{8.0 + 1e-6 * k:.6f},0.9\n" for k in range(20_001))
    with pytest.raises(ThermorenderError, match="pasted text has 20002 rows, more than the 20000 of the finest"):
        read_spectrum("pasted text", f"wavelength_um,emissivity\n{rows}".encode(), session.document.library["snow"])


@pytest.mark.parametrize(("turn", "zoom"), [((0.0, 0.0), 0.5), ((30.0, 0.0), 1.0), ((-20.0, -10.0), 1.0)])
def test_an_orbit_keeps_the_point_in_the_middle_of_the_picture(session, turn, zoom):
    pose = Pose.typed("0,-6,10,0,-55,0", session.base)
    turned = pose.orbited(*turn, zoom, session.base)
    middle, after = (each.matrix()[:3, 3] + each.distance_m * each.matrix()[:3, 2] for each in (pose, turned))
    np.testing.assert_allclose(after, middle, atol=1e-9)
    assert middle[2] == pytest.approx(session.base.ground(*middle[:2]), abs=1e-3)
    assert turned.distance_m == pytest.approx(zoom * pose.distance_m)
    assert (turned.yaw_deg, turned.pitch_deg) == pytest.approx(
        ((pose.yaw_deg + turn[0]) % 360.0, pose.pitch_deg + turn[1])
    )
    moved = pose.moved(0.1, 0.0, session.base)
    assert (moved.east - pose.east, moved.north - pose.north) == pytest.approx((-0.1 * pose.distance_m, 0.0))


def solves():
    """Whether a solution is under way."""
    return any(thread.name == "studio solves" for thread in threading.enumerate())


def slow_reference(monkeypatch):
    """Solutions of what differences are to wait for the first Event that is returned, and note their scenes in the
    list; the second Event is set when one has begun.
    """
    solved_for, going, solved, begun = Renderer.solved_for, threading.Event(), [], threading.Event()

    def slow(self, scene, progress=None):
        if threading.current_thread().name == "studio renders":
            begun.set()
            while not going.is_set():
                time.sleep(0.01)
                progress("", 0.0)
            solved.append(scene)
        return solved_for(self, scene, progress)

    monkeypatch.setattr(Renderer, "solved_for", slow)
    return going, solved, begun


def test_a_view_that_needs_a_solution_is_not_shown_after_a_later_view(session, monkeypatch):
    going, solved, begun = slow_reference(monkeypatch)
    renders, shown = session.renders, []
    one, two = (View(Pose.typed(pose, session.base)) for pose in ("0,-6,10,0,-55,0", "2,-6,10,0,-55,0"))
    renders.start()
    renders.look("tab", one, shown.append, (session.base.with_material(grass_green=0.5), "another"))
    assert begun.wait(30.0)
    renders.look("tab", two, shown.append)
    wait_for(lambda: shown)
    going.set()
    # The first view is dropped, with its solution, before a job.
    assert renders.call(lambda: 7) == 7
    assert [picture.number for picture in shown] == [1] and solved == []
    assert renders.fetch("tab") is shown[0]
    np.testing.assert_array_equal(renders.shown("tab")[0].frame.pose, two.pose.matrix())


def test_two_tabs_that_compare_with_the_same_scene_share_a_solution_and_a_later_scene_counts(session, monkeypatch):
    going, solved, begun = slow_reference(monkeypatch)
    renders, shown = session.renders, []
    view = View(Pose.typed("0,-6,10,0,-55,0", session.base))
    first, later = (session.base.with_material(grass_green=value) for value in (0.6, 0.5))
    renders.start()
    for tab in ("one", "two"):
        renders.look(tab, view, shown.append, (first, "another"))
    assert begun.wait(30.0)
    for tab in ("one", "two"):
        renders.look(tab, view, shown.append, (later, "a later one"))
    wait_for(lambda: not renders._waiting)
    going.set()
    wait_for(lambda: len(shown) >= 2 and not renders._waiting)
    assert renders.call(lambda: 7) == 7
    assert solved == [later]
    assert all(picture.title.endswith("minus that of a later one") for picture in shown)


def test_a_solution_is_shown_while_a_long_job_goes_on(session, monkeypatch):
    renders, going, solving, ended = session.renders, threading.Event(), threading.Event(), threading.Event()
    solved_for = Renderer.solved_for

    def slow(self, scene, progress=None):
        solving.set()
        assert going.wait(30.0)
        return solved_for(self, scene, progress)

    monkeypatch.setattr(Renderer, "solved_for", slow)
    renders.start()
    session.edit(0, "", emissive("grass_green", "0.85"))
    assert solving.wait(30.0)

    def long(progress):
        going.set()
        while not ended.wait(0.01):
            progress("", 0.0)

    renders.later(long)
    try:
        wait_for(lambda: renders.light.exact and renders.light.version == 1)
    finally:
        ended.set()


def test_a_page_that_has_gone_does_not_end_the_thread_that_renders(session, capfd):
    renders = session.renders

    def show(picture):
        raise RuntimeError("the page has gone")

    renders.start()
    renders.look("tab", View(Pose.typed("0,-6,10,0,-55,0", session.base)), show)
    renders.later(lambda progress: 1 / 0)
    session.edit(0, "", emissive("grass_green", "0.85"))
    wait_for(lambda: renders.light.exact and renders.light.version == 1)
    assert renders.call(lambda: 7) == 7
    assert "the page has gone" in capfd.readouterr().err


def test_an_edit_during_a_preview_leaves_the_pause_before_the_next_solution(session, monkeypatch):
    renders, begun, previewing, going = session.renders, [], threading.Event(), threading.Event()
    preview_for = Renderer.preview_for
    monkeypatch.setattr("thermorender.apps.studio.renders.PAUSE_S", 3600.0)

    def slow(self, scene, progress=None):
        previewing.set()
        assert going.wait(30.0)
        return preview_for(self, scene, progress)

    monkeypatch.setattr(Renderer, "preview_for", slow)
    monkeypatch.setattr(Renderer, "solved_for", lambda self, scene, progress=None: begun.append(scene))
    renders.start()
    session.edit(0, "", emissive("grass_green", "0.85"))
    assert previewing.wait(30.0)
    session.edit(1, "", emissive("grass_green", "0.75"))
    going.set()
    wait_for(lambda: renders.light.version == 2)
    wait_for(solves)
    time.sleep(0.2)
    assert not begun


def test_a_fault_of_an_edit_names_the_version_of_the_edit(session, monkeypatch):
    """The page would otherwise wait for a picture of that version."""
    shown, renders = [], session.renders

    def refuses(self, scene, progress=None):
        raise ThermorenderError("it cannot be previewed")

    monkeypatch.setattr(Renderer, "preview_for", refuses)
    renders.start()
    renders.look("tab", View(Pose.typed("0,-6,10,0,-55,0", session.base)), shown.append)
    wait_for(lambda: shown)
    session.edit(0, "", emissive("grass_green", "0.85"))
    wait_for(lambda: len(shown) > 1)
    assert (shown[-1].notes, shown[-1].version, shown[-1].data) == ("it cannot be previewed", 1, b"")

    def fails(self, scene, progress=None):
        raise RuntimeError("it cannot be solved")

    monkeypatch.undo()
    monkeypatch.setattr(Renderer, "solved_for", fails)
    session.edit(1, "", emissive("grass_green", "0.75"))
    wait_for(lambda: shown[-1].notes.startswith("the studio failed here (RuntimeError)"))
    assert shown[-1].version == 2


def test_an_edit_that_would_change_the_faces_is_refused_with_what_to_do(session, monkeypatch):
    other = tr.load_scene("heath/survey")
    monkeypatch.setattr(session, "_scene_of", lambda document: other)
    with pytest.raises(ThermorenderError, match=r"changes the faces of the scene.*make it in scene\.toml, and open"):
        session.edit(0, "", emissive("grass_green", "0.85"))
    assert session.history.version == 0 and session.scene is session.base
