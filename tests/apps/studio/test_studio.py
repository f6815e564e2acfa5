"""The material studio, driven as a user would: a real browser on a tiny scene."""

import re
import shutil
import socket
import sys
from urllib.error import HTTPError
from urllib.request import Request, urlopen

import numpy as np
import pytest
from studio_support import POSE, WAIT_MS, Page, serious, served

import thermorender as tr
from scenes import scene_object, write_terrain
from thermorender.apps.studio.session import Session


def kelvin(folder, **materials):
    """Apparent temperature of the test's view by the public interface, (H, W) [K]."""
    scene = tr.load_scene(folder)
    scene = scene.with_material(materials) if materials else scene
    numbers = [float(number) for number in POSE.split(",")]
    return tr.Renderer(scene, "fast").frame(scene.pose(*numbers)).apparent_temperature


def test_an_edit_changes_the_pixel_as_the_public_interface_does(page, folder):
    column, row = 200, 250
    page.click_pixel(column, row)
    assert page.figure("Material").inner_text() == "grass_green"
    before = page.apparent()
    page.choose("grass_green")
    page.edited("emissivity", "0.8")
    change = kelvin(folder, grass_green=0.8)[row, column] - kelvin(folder)[row, column]
    assert abs(change) > 0.5
    assert page.apparent() - before == pytest.approx(change, abs=1e-3)
    # The words below the picture follow the edit, too.
    below = page.part("hover").filter(has_text=f"{page.apparent():.2f} K apparent · grass_green")
    below.wait_for(timeout=WAIT_MS)


def test_edits_in_quick_succession_are_all_made(page):
    """The text of an edit, such as 0.83 for 0.830, must not replace what is typed meanwhile."""
    page.choose("sand_quartz")
    typed = [f"{0.8 + 0.01 * k:.3f}" for k in range(1, 13)]
    for text in typed:
        page.enter("emissivity", text)
    page.settled()
    assert page.part("field-emissivity").input_value() == typed[-1]
    page.part("edits").click()
    named = page.page.get_by_text("sand_quartz: grey emissivity 0.8")
    named.first.wait_for(timeout=WAIT_MS)
    listed = named.all_inner_texts()
    assert [each.split()[-1] for each in reversed(listed)] == [each for each in typed if each.startswith("0.8")]
    page.page.keyboard.press("Escape")


def test_a_refused_value_has_the_sentence_of_the_command_line(page, call, folder, tmp_path):
    page.choose("sand_quartz")
    for key, text in (("emissivity", "1.5"), ("solar_absorptance", "70"), ("conductivity_w_m_k", "900")):
        settings = ("materials", "copy", "sand_quartz", "mine", "--into", tmp_path / "m", "--set", f"{key}={text}")
        status, _, error = call(*settings)
        assert status == 2
        if key == "conductivity_w_m_k":
            page.page.get_by_role("tab", name="Thermal").click()
        page.part(f"field-{key}").fill(text)
        shown = page.page.locator(".q-field__messages:visible").filter(has_text=f"{key}={text}")
        shown.wait_for(timeout=WAIT_MS)
        sentence = shown.inner_text()
        assert sentence in " ".join(error.split())
        assert re.search(rf"^{key}={text} is not within .*; \w+", sentence)
    page.enter("conductivity_w_m_k", "900")
    page.page.wait_for_timeout(200)
    assert page.version == 0 or not page.part("undo").is_enabled()


@pytest.mark.slow
def test_undo_and_redo_bring_values_and_pictures_back(page):
    page.click_pixel(200, 250)
    page.choose("grass_green")
    before, first = page.apparent(), page.version
    page.edited("emissivity", "0.7")
    changed = page.apparent()
    later = page.version
    for button, value, text, version in (("undo", before, "", first), ("redo", changed, "0.7", later)):
        page.part(button).click()
        # The version of a state is its own, and undo brings it back.
        page.settled(version)
        page.figures_of(version)
        assert page.apparent() == pytest.approx(value, abs=2e-3)  # the solution's own tolerance, and a digit shown
        assert page.part("field-emissivity").input_value() == text
    # The keyboard undoes and redoes too, unless text is being typed.
    for keys, version in (("Control+z", first), ("Control+Shift+z", later), ("Control+z", first)):
        page.page.keyboard.press(keys)
        page.settled(version)


@pytest.mark.slow
def test_a_dragged_point_changes_the_spectrum_and_the_pixel(page):
    page.click_pixel(200, 250)
    page.choose("grass_green")
    before, band = page.apparent(), float(page.part("band").inner_text().split()[0])
    version = page.version
    # The eleventh handle, in the camera's band, moved down by a fifth of the axis.
    x, y = page.page.evaluate(
        """() => {
            const element = document.querySelector('[data-testid=spectrum]'), box = element.getBoundingClientRect();
            const chart = getElement(Number(element.id.slice(1))).chart;
            const at = chart.convertToPixel({seriesIndex: 0}, chart.getOption().series[0].data[11]);
            return [box.left + at[0], box.top + at[1]];
        }"""
    )
    page.page.mouse.move(x, y)
    page.page.mouse.down()
    page.page.mouse.move(x, y + 15, steps=3)
    page.page.mouse.move(x, y + 30, steps=3)
    page.page.mouse.up()
    page.figures_of(page.after(version))
    assert float(page.part("band").inner_text().split()[0]) < band - 0.002
    assert page.apparent() < before - 0.02
    page.part("undo").click()
    page.settled(version)
    assert float(page.part("band").inner_text().split()[0]) == band


@pytest.mark.slow
def test_a_class_and_a_painted_area_get_another_material(page, folder):
    page.click_pixel(200, 250)
    version = page.version
    page.page.get_by_role("tab", name="Cover").click()
    choice = page.part("class-1")
    choice.fill("snow")
    page.page.get_by_role("option", name="snow", exact=True).click()
    page.figures_of(page.after(version))
    assert page.figure("Material").inner_text() == "snow"
    scene = tr.load_scene(folder).with_material({1: "snow"})
    expected = tr.Renderer(scene, "fast").frame(scene.pose(*map(float, POSE.split(",")))).apparent_temperature[250, 200]
    assert page.apparent() == pytest.approx(expected, abs=2e-3)
    # From above, a click on the eastern half fills it.
    page.seen_from("From above")
    page.show("Material map")
    page.choose_of_all("water")
    page.tool("This area")
    version = page.version
    page.click_pixel(500, 256)
    version = page.after(version)
    assert page.page.locator('tr[data-name="water"]').inner_text().split()[2] == "50.0"
    # With the keyboard alone, the western one.
    page.part("frame").focus()
    for key in ["ArrowLeft"] * 15 + ["Enter"]:
        page.page.keyboard.press(key)
    page.after(version)
    assert page.page.locator('tr[data-name="water"]').inner_text().split()[2] == "100.0"
    assert page.part("legend").inner_text() == "water"
    page.tool("Look")
    page.seen_from("Camera")
    page.show("Apparent temperature")


@pytest.mark.slow
def test_axe_finds_no_serious_violation_on_any_tab(page):
    page.click_pixel(200, 250)
    page.figures_of(page.version)
    found = {}

    def look(where):
        found.update({(where, rule): nodes for rule, nodes in serious(page).items()})

    for tab in ("Optical", "Thermal", "Cover", "Labels", "Files"):
        page.page.get_by_role("tab", name=tab).click()
        look(tab)
    page.part("colours").click()
    look("colours")
    page.page.keyboard.press("Escape")
    page.part("against").click()
    page.page.get_by_role("option", name="the saved scene").click()
    page.part("compare-as").get_by_text("Split").click()
    page.page.wait_for_timeout(1000)
    look("slider")
    page.seen_from("From above")
    page.show("Material map")
    look("from above")
    assert not found


@pytest.mark.slow
def test_a_tab_with_outdated_values_is_refused_and_refreshed(page, browser, address):
    page.choose("grass_green")
    other = Page(browser, address)
    other.choose("grass_green")
    version = page.version
    # The other tab edits while this one's connection is down.
    page.context.set_offline(True)
    other.edited("solar_absorptance", "0.5", pixel=False)
    page.enter("solar_absorptance", "0.6")
    page.context.set_offline(False)
    page.page.get_by_text("another tab has changed the tables since").first.wait_for(timeout=WAIT_MS)
    page.after(version)
    assert page.part("field-solar_absorptance").input_value() == "0.5"
    # Reconnected, it edits again, and the other tab follows.
    page.edited("solar_absorptance", "0.6", pixel=False)
    other.settled(page.version)
    assert other.part("field-solar_absorptance").input_value() == "0.6"
    other.context.close()


@pytest.mark.slow
def test_text_being_typed_stays_while_another_tab_edits(browser, tmp_path):
    hut = scene_object("hut", [3.0, 3.0, 3.0], [0.0, 0.0, 1.5], material="asphalt", temperature=305.0)
    folder = write_terrain(tmp_path / "hut", classes=np.ones((32, 32)), extra=hut)
    with served(folder) as address:
        first, other = Page(browser, address), Page(browser, address)
        material = first.part("title").inner_text()

        def edited(key, text):
            other.edited(key, text, pixel=False)
            first.settled(other.version)

        field = first.part("field-solar_absorptance")
        field.fill("0.6")
        # Another property, and then the same one.
        for key in ("temperature_k", "solar_absorptance"):
            edited(key, "0.5" if key == "solar_absorptance" else "300")
            assert field.input_value() == "0.6"
        first.page.get_by_text(f"solar_absorptance of {material} is now 0.5").wait_for(timeout=WAIT_MS)
        # Leaving the field makes the edit, and undo takes it back.
        first.part("undo").click()
        first.has_value(field, "0.5")
        first.settled(2)
        first.page.get_by_role("tab", name="Cover").click()
        field = first.part("kelvin-hut")
        field.fill("29")
        edited("temperature_k", "301")
        other.part("duplicate").click()
        other.part("accept").click()
        other.settled(5)
        first.settled(5)
        assert field.input_value() == "29"
        field.press_sequentially("1")
        field.press("Enter")
        first.settled(6)
        first.part("undo").click()
        first.has_value(field, "305")
        first.settled(5)
        assert not first.errors and not other.errors


@pytest.mark.slow
def test_a_tab_names_the_version_of_the_values_that_it_shows(page, browser, address):
    """An edit that follows another tab's at once would otherwise replace a value that nobody has seen."""
    other = Page(browser, address)
    for each in (page, other):
        each.choose("grass_green")
    for text in ("0.31", "0.32", "0.33"):
        version = page.version
        other.enter("solar_absorptance", text)
        shown = page.page.wait_for_function(
            "v => studio.version > v && document.querySelector('[data-testid=field-solar_absorptance]').value",
            arg=version, polling=2, timeout=WAIT_MS,
        )  # fmt: skip
        assert shown.json_value() == text
        page.after(version)
    other.context.close()


def test_what_comes_from_elsewhere_is_refused(address):
    root, token = address.split("?token=")
    port = root.split(":")[-1].strip("/")
    cookie = {"Cookie": f"thermorender_studio_{port}={token}"}
    assert answer_of(Request(root, headers=cookie))[0] == 200
    cases = [
        ({}, "the token is missing or wrong"),
        ({"Cookie": f"thermorender_studio_{port}=wrong"}, "the token is missing or wrong"),
        ({**cookie, "Host": "evil.example"}, "host 'evil.example' is not the studio's"),
        ({**cookie, "Host": f"evil.example:{port}"}, "is not the studio's"),
        ({**cookie, "Origin": "http://evil.example"}, "origin 'http://evil.example' is not the studio's page"),
        ({**cookie, "Origin": "null"}, "is not the studio's page"),
    ]
    for path in ("", "frame/x/1", "_nicegui_ws/socket.io/?EIO=4&transport=polling"):
        for headers, sentence in cases:
            status, text = answer_of(Request(root + path, headers=headers))
            assert status == 403 and sentence in text
    assert answer_of(Request(f"{root}?token=wrong"))[0] == 403
    assert status_of(int(port), "POST / HTTP/1.1", {**cookie, "Content-Length": "2000001"}) == 413
    opening = "GET /_nicegui_ws/socket.io/?EIO=4&transport=websocket HTTP/1.1"
    websocket = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
                 "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ=="}  # fmt: skip
    for headers, _ in cases:
        assert status_of(int(port), opening, websocket | headers) == 403
    assert status_of(int(port), opening, websocket | cookie) == 101


def answer_of(request):
    """(status, text) of the answer to a request."""
    try:
        with urlopen(request, timeout=20) as answer:
            return answer.status, answer.read().decode()
    except HTTPError as refused:
        with refused:
            return refused.code, refused.read().decode()


def status_of(port, line, headers):
    """The status of the answer to the head of a request."""
    text = "".join(f"{key}: {value}\r\n" for key, value in ({"Host": f"127.0.0.1:{port}"} | headers).items())
    with socket.create_connection(("127.0.0.1", port), timeout=20) as link:
        link.sendall(f"{line}\r\n{text}\r\n".encode())
        return int(link.recv(1024).split()[1])


def test_a_taken_port_and_a_missing_extra_are_one_sentence(call, folder, monkeypatch):
    pytest.importorskip("nicegui", reason="needs thermorender[studio]")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        status, _, error = call("studio", folder, "--port", port)
    assert status == 2
    assert f"address 127.0.0.1 port {port} cannot be listened on" in " ".join(error.split())
    monkeypatch.setitem(sys.modules, "nicegui", None)
    status, _, error = call("studio", folder)
    assert status == 2
    assert "pip install 'thermorender[studio]'" in " ".join(error.split())


@pytest.mark.slow
def test_save_writes_what_the_public_interface_reads_and_refuses_changed_files(browser, folder, tmp_path):
    own = tmp_path / "own"
    shutil.copytree(folder, own)
    with served(own) as address:
        page = Page(browser, address)
        page.choose("grass_green")
        page.edited("emissivity", "0.85", pixel=False)
        page.page.get_by_role("tab", name="Thermal").click()
        page.edited("wetness", "0.125", pixel=False)
        version = page.version
        page.page.get_by_role("tab", name="Cover").click()
        page.part("class-2").fill("snow")
        page.page.get_by_role("option", name="snow", exact=True).click()
        page.after(version)
        page.page.get_by_role("tab", name="Files").click()
        page.part("plan").click()
        shown = page.part("diff").filter(has_text="scene.toml")
        shown.wait_for(timeout=WAIT_MS)
        lines = shown.inner_text()
        assert re.search(r"grass_green  emissivity 0\.97\d\d → 0\.8500 .*wetness", lines)
        assert '−2 = "sand_quartz"' in lines and '+2 = "snow"' in lines
        assert not (own / "materials").exists()
        # A file that changes meanwhile is not overwritten.
        text = (own / "scene.toml").read_text("utf-8")
        (own / "scene.toml").write_text(text + "# later\n", "utf-8")
        page.part("save").click()
        page.part("diff").filter(has_text="has changed on disk since it was read").wait_for(timeout=WAIT_MS)
        assert not (own / "materials").exists()
        (own / "scene.toml").write_text(text, "utf-8")
        page.part("save").click()
        page.part("write").click()
        page.part("diff").filter(has_text="saved:").wait_for(timeout=WAIT_MS)
        saved = tr.load_scene(own)
        materials = {each.name: each for each in saved.materials}
        assert set(materials) == {"grass_green", "snow"}
        assert (materials["grass_green"].emissivity == 0.85).all()
        assert materials["grass_green"].thermal.wetness == 0.125
        source = materials["grass_green"].thermal.source["wetness"]
        assert source.startswith("chosen: edited by hand, before: ") and "before: chosen: edited" not in source
        # Reading again asks where edits are not saved. What is read shows as saved, and undo has nothing to take back.
        page.page.get_by_role("tab", name="Thermal").click()
        page.edited("wetness", "0.5", pixel=False)
        version = page.version
        page.page.get_by_role("tab", name="Files").click()
        page.part("reload").click()
        page.page.get_by_role("button", name="Cancel").click()
        assert page.settled() == version and page.part("undo").is_enabled()
        page.part("reload").click()
        page.part("lose").click()
        page.after(version)
        assert page.part("undo").is_disabled()
        page.page.get_by_role("tab", name="Thermal").click()
        assert page.part("field-wetness").input_value() == "0.125"
        assert not page.page.locator(".edited").count()
        page.context.close()


def test_painted_and_renamed_materials_are_saved_as_the_scene_reads_them(folder, tmp_path):
    own = tmp_path / "own"
    shutil.copytree(folder, own)
    before = {path: path.read_bytes() for path in own.rglob("*") if path.is_file()}
    session = Session(tr.Renderer(tr.load_scene(own), "fast"), "fast")

    def covers(scene):
        return [scene.materials[number].name for number in scene.surfaces[0].material[16, [8, 24]]]

    def saved():
        session.write(session.files.plan(session.document))
        scene = tr.load_scene(own)
        assert covers(scene) == covers(session.scene)
        return covers(scene)

    def painted(document):
        texels = session.renders.renderer.region(16 * 32 + 24)
        return document.with_texels(texels, "pond")

    session.edit(0, "", lambda document: document.duplicated("water", "pond"))
    session.edit(1, "", painted)
    assert saved() == ["grass_green", "pond"]
    session.edit(2, "", lambda document: document.renamed("pond", "lake"))
    assert saved() == ["grass_green", "lake"]
    assert sorted(path.name for path in (own / "materials" / "spectra").iterdir()) == ["lake.csv"]
    assert session.files.plan(session.document).files == {}
    session.step(3, -3)
    assert saved() == ["grass_green", "sand_quartz"]
    left = {path: path.read_bytes() for path in own.rglob("*") if path.is_file()}
    assert left.pop(own / "scene.toml") == before.pop(own / "scene.toml")
    assert {path: data for path, data in left.items() if path.suffix == ".csv"} == {}
    session.close()


@pytest.mark.slow
def test_a_pasted_spectrum_replaces_that_of_a_copy(page):
    page.choose("grass_green")
    version = page.version
    page.part("duplicate").click()
    page.part("new-name").fill("meadow two")
    page.part("accept").click()
    page.page.get_by_text("'meadow two' is not a material name").first.wait_for(timeout=WAIT_MS)
    page.part("new-name").fill("meadow")
    page.part("accept").click()
    version = page.after(version)
    page.part("load").click()
    page.part("paste").fill("wavelength_um,emissivity\n2,0.9\n14,1.2\n")
    page.part("load-fault").filter(has_text="emissivity runs over 0.9–1.2, and 1 of 2 rows").wait_for(timeout=WAIT_MS)
    assert page.part("replace").is_disabled()
    rows = "".join(f"{2 + 1e-4 * k:.4f},0.9\n" for k in range(20_001))
    # Typing so many lines would take Chromium a minute.
    put = "(field, text) => { field.value = text; field.dispatchEvent(new Event('input')); }"
    page.part("paste").evaluate(put, f"wavelength_um,emissivity\n{rows}")
    page.part("load-fault").filter(has_text="pasted text has 20002 rows, more than the 20000").wait_for(timeout=WAIT_MS)
    page.part("paste").fill("wavelength_um,emissivity\n2,0.9\n14,0.9\n20,0.9\n")
    page.part("replace").click()
    page.after(version)
    assert page.part("band").inner_text().startswith("0.9000 ")


@pytest.mark.slow
def test_labels_train_a_map_and_cancel_ends_the_training(browser, tmp_path):
    columns, random = np.mgrid[:128, :128][1], np.random.default_rng(1)
    colour = np.where((columns < 64)[..., None], (60, 120, 50), (200, 180, 140)) + random.integers(-8, 9, (128, 128, 3))
    classes = np.where(columns < 64, 1, 2)
    folder = write_terrain(tmp_path / "halves", height=np.zeros((64, 64)), classes=classes, colour=colour)
    with served(folder, "from thermorender.apps.training import emissivity_training as t; t._STEPS = 1500") as address:
        page = Page(browser, address)
        page.seen_from("From above")
        page.page.get_by_role("tab", name="Labels").click()
        page.part("labelling").click()
        page.tool("Polygon")
        box = page.part("frame").bounding_box()
        for count, (name, left) in enumerate((("grass_green", 0.1), ("sand_quartz", 0.55)), start=1):
            page.choose(name)
            for at, (x, y) in enumerate([(0, 0.1), (0.35, 0.1), (0.35, 0.9), (0, 0.9)]):
                click = page.page.mouse.dblclick if at == 3 else page.page.mouse.click
                click(box["x"] + (left + x) * box["width"], box["y"] + y * box["height"])
            page.part("labels").filter(has_text=f"{count} labels, {count} materials").wait_for(timeout=WAIT_MS)
        page.part("train").click()
        page.part("cancel-training").click()
        page.page.get_by_text("the training was cancelled; press Train to begin again").wait_for(timeout=WAIT_MS)
        page.part("cancel-training").wait_for(state="hidden")
        page.part("train").click()
        words = re.compile(r"^Most probable: grass_green \d\d%, sand_quartz \d\d%")
        page.part("notes").filter(has_text=words).wait_for(timeout=3 * WAIT_MS)
        assert page.part("picture-title").inner_text() == "Learned materials, from above"
        assert sorted(page.part("legend").inner_text().split()) == ["grass_green", "sand_quartz"]
        assert not serious(page)
        page.show("Standard deviation of the learned emissivity")
        assert not serious(page)
        page.context.close()
