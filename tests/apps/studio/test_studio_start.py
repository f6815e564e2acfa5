"""The start page of the studio, driven as a user would, and what asks before unsaved edits are lost."""

import re
import signal
import subprocess
import sys
from contextlib import contextmanager
from urllib.parse import urlsplit

import numpy as np
import pytest
from studio_support import POSE, WAIT_MS, Page, serious

import thermorender as tr
from scenes import write_raster, write_terrain

# The address of a scene, whose query is what a tab shows.
SCENE = re.compile(r"/scene(\?|$)")
# Opening waits for the file "go".
SLOW = """
import pathlib, time
from thermorender.apps.studio import opening
made = opening.Renderer
def slow(*arguments, progress, **settings):
    while not pathlib.Path("go").exists():
        progress("tracing the light", 0.34)
        time.sleep(0.02)
    return made(*arguments, progress=progress, **settings)
opening.Renderer = slow
"""


# Writes how many sessions are in memory when the one before is closed.
ALIVE = """
import pathlib, weakref
from thermorender.apps.studio import opening
alive, made, given = weakref.WeakSet(), opening.Session, opening.give_memory_back
def session(*arguments):
    one = made(*arguments)
    alive.add(one)
    return one
def give():
    given()
    pathlib.Path("alive.txt").write_text(str(len(alive)))
opening.Session, opening.give_memory_back = session, give
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("THERMORENDER_CACHE", str(tmp_path / "cache"))


def path_of(page):
    """The path of the address that a page shows."""
    return urlsplit(page.url).path


class Terminal:
    """A studio in a terminal: the address that it prints, and what it says."""

    def __init__(self, process, folder):
        self.process, self._said = process, folder / "said.txt"
        self.address = re.search(r"open (\S+)", process.stdout.readline())[1]

    def said(self):
        return self._said.read_text("utf-8")

    def ctrl_c(self):
        self.process.send_signal(signal.SIGINT)


@contextmanager
def started(folder, *arguments, before=""):
    """Run `thermorender studio` in a folder after some Python; yield its Terminal."""
    code = f"{before}\nfrom thermorender.cli.app import main\nmain()"
    command = [sys.executable, "-c", code, "studio", "--port", "0", *map(str, arguments)]
    with open(folder / "said.txt", "w") as said, subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=said, text=True, cwd=folder
    ) as process:  # fmt: skip
        terminal = Terminal(process, folder)
        try:
            yield terminal
        finally:
            process.terminate()
            process.wait(20)
    assert "Traceback" not in terminal.said()


class Start:
    """A tab that begins with the studio's address."""

    def __init__(self, browser, address, **options):
        self.context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **options})
        self.page, self.errors = self.context.new_page(), []
        self.page.set_default_timeout(WAIT_MS)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address)

    def part(self, name):
        return self.page.get_by_test_id(name)

    def enter(self, name, text):
        self.part(name).fill(str(text))

    def open_folder(self, folder):
        self.enter("folder", folder)
        self.part("open-folder").click()

    def waits_for_scene(self):
        self.page.wait_for_selector("#frame[data-number]")
        assert path_of(self.page) == "/scene"


def edited(page):
    """Make an unsaved edit in a tab of the studio."""
    page.choose("grass_green")
    page.edited("emissivity", "0.8", pixel=False)


@pytest.mark.slow
def test_a_folder_is_opened_by_its_path_and_is_listed_afterwards(browser, tmp_path):
    folder = write_terrain(tmp_path / "tiny")
    with started(tmp_path) as terminal:
        tab = Start(browser, terminal.address)
        assert path_of(tab.page) == "/scenes"
        assert "true temperatures" in tab.part("scene-village").inner_text()
        tab.page.wait_for_function("() => document.querySelector('.scene img').naturalWidth > 100")
        assert not tab.page.get_by_text("Recent scenes").count()
        tab.open_folder(tmp_path / "nowhere")
        tab.part("fault-folder").filter(has_text="nowhere' does not exist; give a folder").wait_for()
        tab.open_folder(folder)
        tab.waits_for_scene()
        assert tab.page.title() == "tiny – thermorender studio"
        # The address is that of the scene for all tabs now, and the list is a link away.
        other = Start(browser, terminal.address)
        other.waits_for_scene()
        other.part("scenes").click()
        assert other.part("open").inner_text() == "tiny is open."
        assert str(folder) in other.part("scene-tiny").inner_text()
        other.part("scene-tiny").click()
        other.waits_for_scene()
        assert not tab.errors and not other.errors


@pytest.mark.slow
def test_opening_shows_its_share_in_all_tabs_and_can_be_cancelled(browser, tmp_path):
    folder = write_terrain(tmp_path / "tiny")
    with started(tmp_path, before=SLOW) as terminal:
        tab = Start(browser, terminal.address)
        tab.open_folder(folder)
        words = "Opening tiny – tracing the light: 34%"
        tab.part("work").filter(has_text=words).wait_for()
        assert float(tab.page.locator("progress").get_attribute("value")) == 0.34
        other = Start(browser, terminal.address)
        other.part("work").filter(has_text=words).wait_for()
        other.open_folder(folder)
        other.part("fault-folder").filter(has_text="Opening tiny is under way; wait until it ends").wait_for()
        other.part("cancel").click()
        tab.part("fault-folder").filter(has_text="Opening tiny was cancelled").wait_for()
        tab.part("work").wait_for(state="hidden")
        assert path_of(tab.page) == "/scenes"
        tab.open_folder(folder)
        tab.part("work").filter(has_text=words).wait_for()
        # A tab that asks for the scene meanwhile gets it, too; one that chose another page does not.
        late = Start(browser, terminal.address)
        late.part("cancel").wait_for()
        (tmp_path / "go").touch()
        for each in (tab, late):
            each.waits_for_scene()
        assert other.part("open").inner_text() == "tiny is open."
        assert not tab.errors and not other.errors


@pytest.mark.slow
def test_an_import_says_its_fault_at_the_field_and_opens_the_scene(browser, tmp_path):
    rng = np.random.default_rng(3)
    dem = write_raster(tmp_path / "dem.tif", rng.uniform(0.0, 2.0, (1, 32, 32)).astype(np.float32), crs=None)
    colour = rng.integers(40, 200, (3, 64, 64)).astype(np.uint8)
    photo = write_raster(tmp_path / "photo.tif", colour, 0.5, crs=None, photometric="RGB")
    with started(tmp_path) as terminal:
        tab = Start(browser, terminal.address)

        def fault_at(field, text):
            tab.part("import").click()
            label = tab.page.locator(".q-field", has=tab.part(f"import-{field}"))
            label.locator(".q-field__messages").filter(has_text=text).wait_for()
            assert tab.page.locator(".q-field--error").count() == 1

        fault_at("elevation", "elevation is empty; give the path of a GeoTIFF of heights")
        tab.enter("import-elevation", dem)
        tab.enter("import-orthophoto", photo)
        tab.enter("import-output", tmp_path)
        fault_at("output", "exists and is not empty; give a new folder")
        tab.enter("import-output", "made")
        assert not tab.part("import-crs").is_visible()
        fault_at("elevation", "dem.tif has no coordinate reference system (CRS)")
        tab.part("import-crs").wait_for()
        tab.enter("import-crs", "mine")
        fault_at("crs", "crs='mine' is not a coordinate reference system")
        tab.enter("import-crs", "EPSG:32634")
        tab.enter("import-texel_m", "1")
        tab.part("import").click()
        tab.waits_for_scene()
        assert tab.page.title() == "made – thermorender studio"
        tab.part("scenes").click()
        tab.part("open").filter(has_text="temperatures of the imported terrain are a placeholder").wait_for()
        assert not tab.errors
    assert tr.load_scene(tmp_path / "made").surfaces[0].material.shape == (32, 32)


@pytest.mark.slow
def test_a_practice_scene_is_made_and_opened(browser, tmp_path):
    with started(tmp_path) as terminal:
        tab = Start(browser, terminal.address)
        tab.enter("practice-size_m", "40.25")
        tab.enter("practice-output", "heath")
        tab.part("practice").click()
        field = tab.page.locator(".q-field", has=tab.part("practice-size_m"))
        field.get_by_text("does not divide size_m=40.25; choose lengths that do").wait_for()
        tab.enter("practice-size_m", "40")
        tab.part("practice").click()
        tab.page.wait_for_url(SCENE, timeout=6 * WAIT_MS)
        tab.waits_for_scene()
    assert (tmp_path / "heath" / "scene.toml").is_file()


@pytest.mark.slow
def test_unsaved_edits_are_asked_about_and_tabs_of_a_closed_scene_are_told(browser, tmp_path):
    one, two = (write_terrain(tmp_path / name) for name in ("one", "two"))
    with started(tmp_path, one, f"--pose={POSE}", before=ALIVE) as terminal:
        page = Page(browser, terminal.address)
        page.part("scenes").click()
        assert path_of(page.page) == "/scenes"
        page.part("back").click()
        page.settled()
        edited(page)
        page.part("scenes").click()
        page.page.get_by_text("one has unsaved edits. They stay until another scene is opened").wait_for()
        page.page.get_by_role("button", name="Stay").click()
        assert path_of(page.page) == "/scene"
        other = Page(browser, terminal.address)
        # The edits stay in another tab, so leaving this one loses nothing.
        page.page.wait_for_function("() => studio.unsaved === false")
        page.part("scenes").click()
        page.page.wait_for_url("**/scenes")
        assert page.part("open").inner_text() == "one is open, with unsaved edits."
        page.part("folder").fill(str(two))
        page.part("open-folder").click()
        page.page.get_by_text("one has unsaved edits, which are lost when another scene is opened").wait_for()
        page.page.get_by_role("button", name="Cancel").click()
        assert other.part("version").inner_text() == "version 1"
        page.part("open-folder").click()
        page.part("lose").click()
        page.page.wait_for_url(SCENE)
        other.page.wait_for_url("**/scenes?closed")
        assert other.part("told").inner_text() == "one is closed, as two was opened in its place"
        other.part("back").click()
        other.page.locator("#frame").wait_for()
        other.settled(0)
        assert other.page.title() == "two – thermorender studio"
        # Neither the tab that was sent here nor the one that left before keeps the scene that is closed.
        assert (tmp_path / "alive.txt").read_text("utf-8") == "0"
        assert not page.errors and not other.errors


@pytest.mark.slow
def test_ctrl_c_asks_once_for_unsaved_edits_and_tabs_are_told(browser, tmp_path):
    folder = write_terrain(tmp_path / "tiny")
    with started(tmp_path, folder) as terminal:
        page = Page(browser, terminal.address)
        edited(page)
        terminal.ctrl_c()
        question = "unsaved edits of tiny: press Ctrl-C again to end without saving\n"
        page.page.get_by_text("unsaved edits of tiny: the terminal ends the studio without saving").wait_for()
        assert terminal.said() == question
        # A later edit is asked about again.
        page.edited("emissivity", "0.7", pixel=False)
        terminal.ctrl_c()
        page.page.locator(".q-notification__badge").filter(has_text="2").wait_for()
        assert terminal.said() == 2 * question
        terminal.ctrl_c()
        page.page.get_by_text("the studio has ended; start it again in the terminal").wait_for()
        assert terminal.process.wait(20) == 0
        assert page.page.evaluate("studio.unsaved") is False
    assert not (folder / "materials").exists()


@pytest.mark.slow
def test_ctrl_c_without_unsaved_edits_and_another_signal_end_the_studio(browser, tmp_path):
    folder = write_terrain(tmp_path / "tiny")
    for number in (signal.SIGINT, signal.SIGTERM):
        with started(tmp_path, before=SLOW) as terminal:
            tab = Start(browser, terminal.address)
            tab.open_folder(folder)
            tab.part("work").filter(has_text="tracing the light").wait_for()
            terminal.process.send_signal(number)
            tab.page.get_by_text("the studio has ended").wait_for()
            assert terminal.process.wait(20) == 0
            assert terminal.said() == ""


@pytest.mark.slow
def test_the_browser_asks_before_the_last_tab_with_unsaved_edits_is_closed_and_no_other(browser, tmp_path):
    folder = write_terrain(tmp_path / "tiny")
    with started(tmp_path, folder) as terminal:
        page, other = Page(browser, terminal.address), Page(browser, terminal.address)

        def asks(tab):
            """Whether the browser asks before a tab closes; the tab stays where it does."""
            asked = []
            tab.page.once("dialog", lambda dialog: (asked.append(dialog.type), dialog.dismiss()))
            tab.page.close(run_before_unload=True)
            browser.contexts[0].pages[0].wait_for_timeout(500)
            return asked == ["beforeunload"]

        edited(page)
        assert not asks(other)
        page.page.wait_for_function("() => studio.unsaved === true")
        assert asks(page)
        page.part("undo").click()
        page.settled(0)
        page.page.wait_for_function("() => studio.unsaved === false")
        assert not asks(page)


@pytest.mark.slow
def test_axe_finds_no_serious_violation_and_no_part_is_cut_off(browser, tmp_path):
    looks = (1280, 800, "light"), (853, 533, "light"), (400, 700, "dark"), (1280, 800, "dark")
    with started(tmp_path, write_terrain(tmp_path / ("long_name_" * 8))) as terminal:
        for width, height, scheme in looks:
            tab = Start(browser, terminal.address, viewport={"width": width, "height": height}, color_scheme=scheme)
            tab.part("scenes").click()
            tab.part("more").click()
            tab.part("import").click()
            tab.page.locator(".q-field--error").wait_for()
            assert not serious(tab), (width, scheme)
            assert tab.page.evaluate("document.documentElement.scrollWidth") <= width
            dark = tab.page.evaluate("getComputedStyle(document.body).backgroundColor") == "rgb(19, 26, 33)"
            assert dark == (scheme == "dark")
            tab.context.close()
