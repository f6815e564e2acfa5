"""The material studio, driven as a user would: a real browser on a tiny scene."""

import re
import shutil
import subprocess
import sys
from contextlib import contextmanager

import numpy as np
import pytest

import thermorender as tr
from scenes import write_terrain

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
).split()
POSE = "0,-6,10,0,-55,0"
WAIT_MS = 20_000


@contextmanager
def served(folder, *options):
    """Run `thermorender studio` of a scene on a free port; yield the address that it prints."""
    command = [sys.executable, "-m", "thermorender", "studio", str(folder), "--port", "0", f"--pose={POSE}", *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            yield re.search(r"open (\S+)", process.stdout.readline())[1]
        finally:
            process.terminate()
            process.wait(20)


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("needs Chromium (Debian: chromium)")
    playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    pytest.importorskip("nicegui", reason="needs thermorender[studio]")
    with playwright.sync_playwright() as started:
        made = started.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield made
        made.close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    rows, columns = np.mgrid[:32, :32]
    classes = np.where(columns < 16, 1, 2)
    return write_terrain(
        tmp_path_factory.mktemp("studio") / "tiny", classes=classes, temperature=290.0 + 0.2 * (rows + columns)
    )


@pytest.fixture(scope="module")
def address(folder, browser):
    with served(folder) as found:
        yield found


class Page:
    """A tab of the studio."""

    def __init__(self, browser, address):
        self.context = browser.new_context(viewport={"width": 1280, "height": 800})
        self.page = self.context.new_page()
        self.outside, self.errors = [], []
        host = address.split("/")[2]
        self.page.on("request", lambda each: self.outside.append(each.url) if host not in each.url else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address)
        self.settled()

    def part(self, name):
        return self.page.get_by_test_id(name)

    @property
    def version(self):
        return int(self.part("version").inner_text().split()[1])

    def settled(self, version=None):
        """Wait until the picture shows a version exactly; return the number of that version."""
        version = self.version if version is None else version
        self.page.wait_for_function(
            "v => document.getElementById('frame').dataset.version == v && "
            "document.querySelector('[data-testid=state]').innerText == 'exact'", arg=version, timeout=WAIT_MS,
        )  # fmt: skip
        return version

    def click_pixel(self, column, row):
        box = self.part("frame").bounding_box()
        self.part("frame").click(
            position={"x": (column + 0.5) * box["width"] / 640, "y": (row + 0.5) * box["height"] / 512}
        )

    def figure(self, key):
        return self.page.locator(f'[data-key="{key}"]')

    def apparent(self):
        """The apparent temperature of the clicked pixel [K]."""
        return float(self.figure("Apparent temperature").inner_text().split()[0])

    def choose(self, name):
        self.page.locator(f'tr[data-name="{name}"]').click()
        self.page.wait_for_function(
            "name => document.querySelector('[data-testid=title]').innerText == name", arg=name, timeout=WAIT_MS
        )

    def enter(self, key, text):
        """Type into a field of the chosen material and confirm."""
        field = self.part(f"field-{key}")
        field.fill(text)
        field.press("Enter")

    def edited(self, key, text):
        """Edit a field, and wait for the picture and the clicked pixel of the new version."""
        version = self.version
        self.enter(key, text)
        self.settled(version + 1)
        self.part("figures").and_(self.page.locator(f'[data-version="{version + 1}"]')).wait_for(timeout=WAIT_MS)


@pytest.fixture
def page(browser, address):
    made = Page(browser, address)
    yield made
    while made.part("undo").is_enabled():
        before = made.version
        made.part("undo").click()
        made.settled(before + 1)
    made.context.close()
    assert not made.outside and not made.errors


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
