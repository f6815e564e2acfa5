"""Faults around the material studio: odd requests, edits in quick succession, and what a save keeps of the files."""

import asyncio
import shlex
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

import thermorender as tr
from scenes import write_terrain
from thermorender.errors import ThermorenderError
from thermorender.paths import data_folder
from thermorender.render.renderer import Renderer
from thermorender.studio.access import Guard
from thermorender.studio.document import History
from thermorender.studio.fields import changed, read_spectrum
from thermorender.studio.view import Pose, View

HUT = """
# The hut of the owner's brother.
[[object]]
name = "hut"
shape = "box"
size = [3.0, 3.0, 3.0]
position = [0.0, 0.0, 1.5]
temperature = 305.0 # the stove's "on"
material = 'asphalt' # a felt roof's "bitumen"
"""


@pytest.fixture
def folder(tmp_path):
    columns = np.mgrid[:32, :32][1]
    return write_terrain(tmp_path / "tiny scene", classes=np.where(columns < 16, 1, 2), extra=HUT)


@pytest.fixture
def session(folder):
    from thermorender.studio.session import Session

    made = Session(tr.Renderer(tr.load_scene(folder), "fast"), "fast")
    yield made
    made.close()


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def saved(session):
    from thermorender.studio import saving

    saving.write(session, saving.planned(session))
    return tr.load_scene(session.base.spec.folder)


def status_of(headers):
    """The status that the guard of a studio at 127.0.0.1:8000 answers; its token is "secret"."""
    answers = []

    async def app(scope, receive, send):
        await send({"type": "http.response.start", "status": 200})

    async def send(message):
        answers.append(message)

    scope = {"type": "http", "headers": [(key.encode(), value.encode("latin-1")) for key, value in headers.items()]}
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


def test_a_tab_need_not_wait_for_its_own_edits(session):
    first = session.document
    history = History(first)

    def edit(version, value, by):
        history.edit(version, value, lambda document: changed(document, "asphalt", "emissivity", value), print, by)

    edit(0, "0.5", "a")
    edit(0, "0.6", "a")
    history.step(0, -1, "a")
    history.step(1, -1, "a")
    assert history.document is first and history.version == 4
    # Another tab has missed these edits, and then the first one those of the other.
    with pytest.raises(ThermorenderError, match="another tab has changed the tables since"):
        edit(0, "0.7", "b")
    edit(4, "0.7", "b")
    for version in (0, 3, 4):
        with pytest.raises(ThermorenderError, match="another tab has changed the tables since"):
            edit(version, "0.8", "a")
    edit(5, "0.8", "a")
    edit(5, "0.9", "a")
    assert history.version == 7


def test_edits_of_a_material_that_another_tab_deleted_are_one_sentence(session):
    session.edit(0, "copy", lambda document: document.duplicated("asphalt", "mine"))
    session.edit(1, "deleted", lambda document: document.without("mine"))
    for change in (
        lambda document: changed(document, "mine", "emissivity", "0.5"),
        lambda document: document.duplicated("mine", "other"),
        lambda document: document.renamed("mine", "other"),
        lambda document: document.without("mine"),
    ):
        with pytest.raises(ThermorenderError, match="'mine' is no longer there, since another tab"):
            session.edit(2, "late", change)
    assert session.history.version == 2


def test_a_save_does_not_count_later_edits_as_saved(session):
    from thermorender.studio import saving

    session.edit(0, "", lambda document: changed(document, "grass_green", "emissivity", "0.8"))
    save = saving.planned(session)
    session.edit(1, "", lambda document: changed(document, "grass_green", "emissivity", "0.7"))
    with pytest.raises(ThermorenderError, match="nothing was written, so press Save again"):
        saving.write(session, save)
    assert not (session.base.spec.folder / "materials").exists()
    assert {each.name: each.emissivity.max() for each in saved(session).materials}["grass_green"] == 0.7


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_a_save_keeps_comments_line_ends_and_digits(session, end):
    path = session.base.spec.folder / "scene.toml"
    text = path.read_text("utf-8").replace('1 = "grass_green"', '1 = "grass_green" # the owner\'s "lawn", # 7')
    path.write_bytes(b"\xef\xbb\xbf" + text.replace("\n", end).encode())
    session.reload(tr.load_scene(path.parent))
    session.edit(1, "", lambda document: document.of_class(1, "snow"))
    session.edit(2, "", lambda document: document.of_object("hut", "granite", 301.234567))
    scene = saved(session)
    assert scene.spec.objects[0].temperature == 301.234567 and scene.spec.objects[0].material == "granite"
    expected = text.replace('1 = "grass_green"', '1 = "snow"').replace("305.0", "301.234567")
    expected = expected.replace("'asphalt'", '"granite"')
    assert path.read_bytes() == b"\xef\xbb\xbf" + expected.replace("\n", end).encode()


def test_a_copy_of_a_material_that_emits_by_angle_is_saved(session):
    session.edit(0, "", lambda document: document.duplicated("glass_fresnel", "pane"))
    session.edit(1, "", lambda document: document.of_class(1, "pane"))
    first = {each.name: each for each in saved(session).materials}["pane"]
    session.edit(2, "", lambda document: document.renamed("pane", "window"))
    second = {each.name: each for each in saved(session).materials}["window"]
    glass = session.origin.library["glass_fresnel"]
    for cosine in (1.0, 0.3):
        wanted = glass.band_emissivity(7.5, 13.5, 300.0, cosine)
        assert [each.band_emissivity(7.5, 13.5, 300.0, cosine) for each in (first, second)] == [wanted, wanted]


def test_a_table_of_n_and_k_makes_a_material_emit_by_angle(session):
    own = session.document.library["glass"]
    table = (data_folder("materials") / "spectra" / "glass_fresnel.csv").read_bytes()
    with pytest.raises(
        ThermorenderError, match=r"nk\.csv is a table of n and k and has no sample 'A001'; leave it out"
    ):
        read_spectrum("nk.csv", table, own, "A001")
    with pytest.raises(ThermorenderError, match=r"^nk\.csv, row 2: k=-1 is not within .*k not negative"):
        read_spectrum("nk.csv", b"wavelength_um,n,k\n2,1.5,-1\n20,1.5,0.1\n", own)
    session.edit(0, "", lambda document: document.duplicated("glass", "pane"))
    session.edit(
        1, "", lambda document: document.with_material(*read_spectrum("nk.csv", table, document.library["pane"]))
    )
    session.edit(2, "", lambda document: document.of_class(1, "pane"))
    read = {each.name: each for each in saved(session).materials}["pane"]
    for cosine in (1.0, 0.3):
        wanted = session.document.library["glass_fresnel"].band_emissivity(7.5, 13.5, 300.0, cosine)
        for each in (session.document.library["pane"], read):
            assert each.band_emissivity(7.5, 13.5, 300.0, cosine) == wanted
    assert "n and k from nk.csv" in read.note
    with pytest.raises(ThermorenderError, match=r"pane emits by angle \(fresnel\); duplicate a Lambertian"):
        changed(session.document, "pane", "emissivity", "0.9")


def test_gaps_are_those_of_the_new_spectrum(session):
    old = replace(session.document.library["snow"], gaps_um=((8.0, 9.0),))
    assert read_spectrum("a.csv", b"wavelength_um,emissivity\n2,0.9\n9,0.8\n20,0.9\n", old)[0].gaps_um == ()


def test_the_lines_without_the_page_name_or_repeat_all_edits(session):
    from thermorender.studio import saving

    session.edit(0, "", lambda document: document.of_class(1, "snow"))
    session.edit(1, "", lambda document: document.of_object("hut", "granite", 301.25))
    view = View(Pose.typed("0,-6,10,0,-55,0", session.base))
    python, line = saving.commands(session, view)
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
        session.edit(version, "", lambda document, k=version: changed(document, "grass_green", "emissivity", f"0.{k}5"))
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
        session.edit(0, "", lambda document: changed(document, "grass_green", "emissivity", "0.85"))
        assert begun.wait(30.0)
        session.edit(1, "", lambda document: changed(document, "grass_green", "emissivity", "0.75"))
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
    monkeypatch.setattr("thermorender.studio.renders._PAUSE_S", 3600.0)

    def counted(self, scene, progress=None):
        begun.append(scene)
        while len(begun) == 1:
            time.sleep(0.01)
            progress("", 0.0)
        return solved_for(self, scene, progress)

    monkeypatch.setattr(Renderer, "solved_for", counted)
    renders.start()
    for version in range(2):
        session.edit(version, "", lambda document, k=version: changed(document, "grass_green", "emissivity", f"0.{k}5"))
        wait_for(lambda k=version: renders.light.version == k + 1 and (begun or k))
    time.sleep(0.3)
    assert len(begun) == 1 and not renders.light.exact
    # The studio ends without it.
    renders.stop()
    assert not renders._solver.is_alive()


def test_a_full_disk_is_one_sentence_and_changes_no_file(session, monkeypatch, tmp_path):
    from thermorender.studio import ground, saving
    from thermorender.studio.fields import read_spectrum

    session.edit(0, "", lambda document: changed(document, "grass_green", "emissivity", "0.8"))
    before = {path: path.read_bytes() for path in session.base.spec.folder.rglob("*") if path.is_file()}
    shape = ground.filled(session.scene, 0.75, 0.5)
    session.areas.cleanup()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
    for act in (
        lambda: saving.planned(session),
        lambda: read_spectrum("a.csv", b"wavelength_um,emissivity\n2,0.9\n20,0.9\n", session.document.library["snow"]),
        lambda: session.edit(1, "", lambda document: ground.painted(session, shape, "snow", document)),
    ):
        with pytest.raises(ThermorenderError, match=r"cannot be written: .*; check the folder"):
            act()
    assert session.history.version == 1
    assert {path: path.read_bytes() for path in session.base.spec.folder.rglob("*") if path.is_file()} == before


def test_names_longer_than_a_file_name_are_refused(session):
    with pytest.raises(ThermorenderError, match="use 1 … 100 letters"):
        session.document.duplicated("snow", "a" * 101)
    assert "a" * 100 in session.document.duplicated("snow", "a" * 100).library


def test_a_scene_still_loads_after_a_save_that_failed(session, monkeypatch):
    from thermorender.studio import saving

    session.edit(0, "", lambda document: changed(document, "grass_green", "emissivity", "0.8"))
    save = saving.planned(session)

    def full(path, data):
        path.parent.mkdir(parents=True, exist_ok=True)
        raise ThermorenderError("no space")

    with monkeypatch.context() as patched:
        patched.setattr("thermorender.materials.store._replace", full)
        with pytest.raises(ThermorenderError, match="no space"):
            saving.write(session, save)
    tr.load_scene(session.base.spec.folder)
    assert {each.name: each for each in saved(session).materials}["grass_green"].emissivity.max() == 0.8


def labelled(session):
    from thermorender.studio import ground

    scene = session.base
    for material, left in (("grass_green", 0.05), ("sand_quartz", 0.55)):
        corners = [[left, 0.05], [left + 0.4, 0.05], [left + 0.4, 0.95], [left, 0.95]]
        session.labels.append(ground.Label(ground.polygon(scene, corners), material))


def test_labels_of_the_map_are_a_file_that_training_reads(session, folder, tmp_path):
    from thermorender.campaign.material_training import labelled_scene
    from thermorender.studio import ground

    labelled(session)
    path = tmp_path / "labels.geojson"
    path.write_text(ground.labels_text(session.base.grid, session.labels), "utf-8")
    found = labelled_scene(folder, path)
    names = np.array(["", *(found.names[number] for number in (1, 2))])[found.material]
    assert (names[5:27, 3:13] == "grass_green").all() and (names[5:27, 19:29] == "sand_quartz").all()
    assert (names[:, 15:17] == "").all()
    left, right = (np.array(each) for each in ground.outlines(session.base.grid, session.labels))
    assert left.min(axis=0) == pytest.approx([0.05, 0.05]) and right.max(axis=0) == pytest.approx([0.95, 0.95])


@pytest.mark.slow
def test_a_map_learned_from_labels_shows_materials_and_their_uncertainty(tmp_path, monkeypatch):
    from thermorender.learned.emissivity import training
    from thermorender.studio import ground
    from thermorender.studio.session import Session

    monkeypatch.setattr(training, "_EPOCHS", 5)
    columns, random = np.mgrid[:128, :128][1], np.random.default_rng(1)
    colour = np.where((columns < 64)[..., None], (60, 120, 50), (200, 180, 140)) + random.integers(-8, 9, (128, 128, 3))
    made = write_terrain(
        tmp_path / "halves", height=np.zeros((64, 64)), classes=np.where(columns < 64, 1, 2), colour=colour
    )
    session = Session(tr.Renderer(tr.load_scene(made), "fast"), "fast")
    labelled(session)
    said = []
    learned = ground.learned_from(session, lambda what, share: said.append((what, share)))
    assert {what for what, _ in said} >= {"fitting the network", "mapping the materials"}
    one, other = learned.layers["learned"][64, 20], learned.layers["learned"][64, 108]
    assert (one != other).any()
    number = session.base.surfaces[0].material[64, [20, 108]]
    assert (np.array([one, other]) == ground.colours_of_materials()[number]).all()
    assert (learned.layers["learned"][:, 4:54] == one).all(axis=-1).mean() > 0.95
    assert "Standard deviation of the emissivity: mean 0.0" in learned.words["uncertainty"]
    session.learned = learned
    pictures = {ground.map_picture(session, 100, layer) for layer in ("materials", "learned", "uncertainty")}
    assert len(pictures) == 3

    def cancelled(what, share):
        raise ThermorenderError("cancelled")

    with pytest.raises(ThermorenderError, match=r"^cancelled$"):
        ground.learned_from(session, cancelled)
    session.close()


def test_a_long_pasted_text_is_refused_at_once(session):
    rows = "".join(f"{8.0 + 1e-6 * k:.6f},0.9\n" for k in range(20_001))
    with pytest.raises(ThermorenderError, match="pasted text has 20002 rows, more than the 20000 of the finest"):
        read_spectrum("pasted text", f"wavelength_um,emissivity\n{rows}".encode(), session.document.library["snow"])


def test_a_new_name_is_not_saved_where_the_scene_names_the_old_one_elsewhere(folder):
    from thermorender.studio import saving
    from thermorender.studio.session import Session

    path = folder / "scene.toml"
    session = Session(tr.Renderer(tr.load_scene(folder), "fast"), "fast")
    session.edit(0, "", lambda document: document.duplicated("snow", "mine"))
    saved(session)
    session.close()
    text = path.read_text("utf-8")
    path.write_text(text.replace('raster = "classes.tif"', 'raster = "classes.tif"\nfallback = "mine"'), "utf-8")
    session = Session(tr.Renderer(tr.load_scene(folder), "fast"), "fast")
    session.edit(0, "", lambda document: document.renamed("mine", "yours"))
    with pytest.raises(ThermorenderError, match=r"scene\.toml names mine outside its classes and objects"):
        saving.planned(session)
    session.step(1, -1)
    session.edit(2, "", lambda document: document.duplicated("mine", "yours"))
    saved(session)
    assert sorted(each.name for each in (folder / "materials" / "spectra").iterdir()) == ["mine.csv", "yours.csv"]
    session.close()


def test_a_material_of_the_scene_is_deleted_where_nothing_uses_it(session, folder):
    def delete(name):
        session.edit(session.history.version, f"{name} deleted", lambda document: document.without(name))

    with pytest.raises(ThermorenderError, match="snow is a material of the shipped library, which stays"):
        delete("snow")
    session.edit(0, "", lambda document: document.duplicated("snow", "mine"))
    session.edit(1, "", lambda document: document.of_class(1, "mine"))
    saved(session)
    assert (folder / "materials" / "spectra" / "mine.csv").is_file()
    with pytest.raises(ThermorenderError, match="mine is the material of class 1; give that another one"):
        delete("mine")
    session.edit(2, "", lambda document: document.of_class(1, "grass_green"))
    delete("mine")
    assert "mine" not in {each.name for each in saved(session).materials}
    assert not (folder / "materials").exists()
    session.step(session.history.version, -1)
    assert "mine" in session.document.library


@pytest.mark.parametrize("text", ["1_0", "0.8_5", "٣", "０.９"])
def test_numbers_in_other_digits_are_refused_as_in_tables(session, text):
    for key in ("emissivity", "solar_absorptance", "conductivity_w_m_k"):
        with pytest.raises(ThermorenderError, match="is not a number"):
            changed(session.document, "grass_green", key, text)


def test_a_file_that_changed_while_the_light_was_traced_is_not_overwritten(folder):
    from thermorender.studio import saving
    from thermorender.studio.session import Session

    scene = tr.load_scene(folder)
    files = saving.snapshot(scene)
    path = folder / "scene.toml"
    path.write_text(path.read_text("utf-8") + "# by hand\n", "utf-8")
    session = Session(tr.Renderer(scene, "fast"), "fast", files)
    session.edit(0, "", lambda document: changed(document, "grass_green", "emissivity", "0.8"))
    with pytest.raises(ThermorenderError, match=r"scene\.toml has changed on disk since the studio read it"):
        saving.planned(session)
    session.close()
