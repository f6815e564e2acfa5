"""Draw the pictures of the studio's guide: docs/figures/studio-….png and studio-map-….png, in two sizes each, and
studio-start.png.

`python docs/studio_pictures.py` shows the start page, the shipped village and the guide's small one in a headless
Chromium. It needs playwright, Chromium and thermorender[studio,train].
"""

import os
import re
import shutil
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from playwright.sync_api import sync_playwright

FIGURES = Path(__file__).with_name("figures")
ARGUMENTS = ["--headless", "--no-sandbox", "--disable-gpu"]
SIZES = ((1280, 800), (1920, 1080))
WAIT_MS = 120_000
# A rubber roof of the village is then at the clicked place, a share of the picture's width and height.
POSE, PLACE = "0,-96,96,0,-45,0", (0.40, 0.60)
# The guide's scene, and labels on its map: material; left, top, right and bottom as shares of it.
SMALL = ("make-scene", "village", "--draped", "--size-m", "60", "--texel-m", "0.5")
# From above, so high that the picture is as high as the scene.
ABOVE = "0,0,89.6,0,-90,0"
LABELS = (
    ("grass_green", 0.25, 0.15, 0.30, 0.35), ("grass_green", 0.50, 0.87, 0.62, 0.97),
    ("soil_loam", 0.72, 0.60, 0.80, 0.80), ("soil_loam", 0.34, 0.66, 0.36, 0.80),
    ("water", 0.40, 0.18, 0.55, 0.30),
)  # fmt: skip


@contextmanager
def studio(*arguments, **variables):
    """Serve a scene, or the start page; yield the address."""
    command = [sys.executable, "-m", "thermorender", "studio", *arguments, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ | variables) as server:
        try:
            yield re.search(r"open (\S+)", server.stdout.readline())[1]
        finally:
            server.terminate()


def tabs(browser, address, name):
    """Yield (page, size) of a new tab for each size, and take its picture afterwards."""
    for width, height in SIZES:
        page = browser.new_page(viewport={"width": width, "height": height})
        page.set_default_timeout(WAIT_MS)
        page.goto(address)
        page.wait_for_selector("#frame[data-number]")
        yield page, width
        page.mouse.move(5, height - 5)
        page.wait_for_timeout(2500)
        page.screenshot(path=FIGURES / f"studio-{name}{width}.png")
        page.close()


def draw_start(browser, address):
    """Show the start page."""
    page = browser.new_page(viewport={"width": SIZES[0][0], "height": SIZES[0][1]})
    page.goto(address)
    page.wait_for_function("() => [...document.images].every(image => image.naturalWidth)")
    page.wait_for_timeout(1000)
    page.screenshot(path=FIGURES / "studio-start.png")
    page.close()


def draw_roof(browser, address):
    """Click a roof; in the larger picture also edit its emissivity, and show the difference."""
    for page, width in tabs(browser, address, ""):
        box = page.get_by_test_id("frame").bounding_box()
        page.mouse.click(box["x"] + PLACE[0] * box["width"], box["y"] + PLACE[1] * box["height"])
        name = page.locator('[data-key="Material"]').inner_text()
        page.get_by_test_id("title").filter(has_text=name).wait_for()
        if width == SIZES[1][0]:
            page.get_by_test_id("field-emissivity").fill("0.85")
            page.get_by_test_id("field-emissivity").press("Enter")
            page.wait_for_function("() => studio.picture.version === 1 && studio.picture.exact")
            choose(page, "against", "the saved scene")
            page.get_by_test_id("picture-title").filter(has_text="minus").wait_for()


def draw_map(browser, address):
    """Label areas from above, and train; show the materials, and in the larger picture the standard deviation."""
    for page, width in tabs(browser, address, "map-"):
        page.get_by_test_id("projection").get_by_text("From above").click()
        choose(page, "layer", "Material map")
        page.get_by_role("tab", name="Labels").click()
        page.get_by_test_id("picture-title").filter(has_text="Material map").wait_for()
        page.get_by_test_id("labelling").click()
        page.get_by_test_id("tool").get_by_text("Polygon").click()
        if width == SIZES[1][0]:
            page.get_by_test_id("train").click()
            page.get_by_test_id("notes").filter(has_text="Most probable").wait_for()
            choose(page, "layer", "Standard deviation of the learned emissivity")
            page.get_by_test_id("picture-title").filter(has_text="Standard deviation").wait_for()
            continue
        box = page.get_by_test_id("frame").bounding_box()
        page.get_by_test_id("scope").get_by_text("All").click()
        for count, (name, left, top, right, bottom) in enumerate(LABELS, start=1):
            page.get_by_test_id("search").fill(name)
            page.locator(f'tr[data-name="{name}"]').click()
            for x, y in ((left, top), (right, top), (right, bottom), (left, bottom)):
                # The map lies in the middle of the picture, and is as high as the picture.
                at = box["x"] + (0.5 + (x - 0.5) * box["height"] / box["width"]) * box["width"]
                click = page.mouse.dblclick if (x, y) == (left, bottom) else page.mouse.click
                click(at, box["y"] + y * box["height"])
            page.get_by_test_id("labels").filter(has_text=f"{count} labels").wait_for()
        page.get_by_test_id("search").fill("")


def choose(page, test, option):
    """Choose an option of a list."""
    page.get_by_test_id(test).click()
    page.get_by_role("option", name=option, exact=True).click()


def main():
    """Draw all pictures."""
    with sync_playwright() as started, TemporaryDirectory() as folder:
        browser = started.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        with studio(THERMORENDER_CACHE=folder) as address:
            draw_start(browser, address)
        with studio("village", f"--pose={POSE}") as address:
            draw_roof(browser, address)
        small = str(Path(folder, "small"))
        subprocess.run([sys.executable, "-m", "thermorender", *SMALL, "-o", small], check=True)
        with studio(small, f"--pose={ABOVE}") as address:
            draw_map(browser, address)
        browser.close()


if __name__ == "__main__":
    main()
