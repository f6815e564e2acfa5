"""A studio that is served, and a tab of it in a real browser."""

import re
import shutil
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
ARGUMENTS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync"
).split()
POSE = "0,-6,10,0,-55,0"
WAIT_MS = 20_000


@contextmanager
def served(folder, before=""):
    """Run `thermorender studio` of a scene on a free port, after a line of Python; yield the address that it prints."""
    code = f"{before}\nfrom thermorender.cli.app import main\nmain()"
    command = [sys.executable, "-c", code, "studio", str(folder), "--port", "0", f"--pose={POSE}"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=folder) as process:
        try:
            yield re.search(r"open (\S+)", process.stdout.readline())[1]
        finally:
            process.terminate()
            process.wait(20)


class Page:
    """A tab of the studio."""

    def __init__(self, browser, address, **options):
        self.context = browser.new_context(**{"viewport": {"width": 1280, "height": 800}, **options})
        self.page = self.context.new_page()
        self.outside, self.errors = [], []
        host = address.split("/")[2]
        self.page.on("request", lambda each: self.outside.append(each.url) if host not in each.url else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(address)
        # Before the first picture, the page does not know its version.
        self.page.wait_for_function("() => studio.picture", timeout=WAIT_MS)
        self.settled()

    def part(self, name):
        return self.page.get_by_test_id(name)

    @property
    def version(self):
        return self.page.evaluate("studio.latest")

    def settled(self, version=None):
        """Wait until picture and tables show a version, by default the latest after all edits that were sent, and the
        picture is exact; return the number of that version.
        """
        self.page.wait_for_function(
            "given => { const frame = document.getElementById('frame'); if (!window.studio || !frame) return false; "
            "const v = given ?? studio.latest; return frame.dataset.version == v && studio.version == v && "
            "document.querySelector('[data-testid=state]').innerText == 'exact' && "
            "document.querySelector('[data-testid=version]').innerText == `version ${v}`; }",
            arg=version, timeout=WAIT_MS,
        )  # fmt: skip
        return self.version if version is None else version

    def after(self, version):
        """Wait until picture and tables show another version than this one; return its number."""
        self.page.wait_for_function("v => studio.latest != v", arg=version, timeout=WAIT_MS)
        return self.settled()

    def end(self):
        """Undo all edits and close the tab."""
        while before := self.version:
            self.part("undo").click()
            self.after(before)
        self.context.close()
        assert not self.outside and not self.errors

    def has_value(self, field, text):
        """Wait until a field has a text."""
        self.page.wait_for_function("([one, text]) => one.value == text", arg=[field.element_handle(), text])

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

    def choose_of_all(self, name):
        """Choose a material of the library, in use or not."""
        self.part("scope").get_by_text("All").click()
        self.part("search").fill(name)
        self.choose(name)
        self.part("search").fill("")

    def enter(self, key, text):
        """Type into a field of the chosen material and confirm."""
        field = self.part(f"field-{key}")
        field.fill(text)
        field.press("Enter")

    def show(self, layer):
        """Show a layer, once its picture is there."""
        number = self.number
        self.part("layer").click()
        self.page.get_by_role("option", name=layer, exact=True).click()
        self.later_than(number)

    def seen_from(self, side):
        """Show the view by the camera or from above."""
        number = self.number
        self.part("projection").get_by_text(side).click()
        self.later_than(number)

    @property
    def number(self):
        return self.page.evaluate("studio.picture.number")

    def later_than(self, number):
        self.page.wait_for_function("n => studio.picture.number > n", arg=number, timeout=WAIT_MS)

    def tool(self, name):
        self.part("tool").get_by_text(name, exact=True).click()
        self.page.wait_for_timeout(200)

    def figures_of(self, version):
        """Wait for the clicked pixel's figures of a version."""
        self.page.locator(f'[data-testid="figures"][data-version="{version}"]').wait_for(timeout=WAIT_MS)

    def edited(self, key, text, pixel=True):
        """Edit a field, and wait for the picture and, where one is clicked, for the pixel of the new version."""
        version = self.version
        self.enter(key, text)
        version = self.after(version)
        if pixel:
            self.figures_of(version)


def wait_for(condition, seconds=30.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "nothing happened"
        time.sleep(0.01)


def serious(page):
    """What axe finds serious in a page: the nodes by rule."""
    axe = pytest.importorskip("axe_playwright_python.base", reason="needs axe-playwright-python")
    page.page.evaluate(axe.AXE_FILE_PATH.read_text("utf-8"))
    page.page.wait_for_timeout(500)
    return {
        each["id"]: [node["html"][:200] for node in each["nodes"]]
        for each in page.page.evaluate("axe.run()")["violations"]
        if each["impact"] in ("serious", "critical")
    }
